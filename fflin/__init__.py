"""Linear models of free-floating robots: URDF in, checked A and B out."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from fflin.base.version import __version__

# Public name -> module. Each is imported when it is first asked for, so that a command which
# needs no dynamics does not pay for them.
_PUBLIC = {
    "Accelerometer": "robot.outputs",
    "Allocation": "control.policies",
    "BaseForce": "robot.inputs",
    "BasePose": "robot.outputs",
    "BaseTorque": "robot.inputs",
    "CenterOfMass": "robot.outputs",
    "Certificate": "linear.model",
    "ChartError": "base.errors",
    "Check": "linear.check",
    "Compensator": "control.kalman",
    "Controllability": "analysis.controllability",
    "DetectabilityError": "base.errors",
    "Equilibrium": "linear.equilibrium",
    "EquilibriumError": "base.errors",
    "Estimator": "control.kalman",
    "FflinError": "base.errors",
    "FflinWarning": "base.errors",
    "FileError": "base.errors",
    "FramePose": "robot.outputs",
    "FrameVelocity": "robot.outputs",
    "FullState": "robot.outputs",
    "Gain": "control.gain",
    "GainBatch": "batch.gains",
    "GainSchedule": "control.gain_schedule",
    "Gramians": "analysis.gramians",
    "Grid": "batch.configurations",
    "Gyroscope": "robot.outputs",
    "InputError": "base.errors",
    "JointPositions": "robot.outputs",
    "JointTorque": "robot.inputs",
    "JointVelocities": "robot.outputs",
    "LinearBatch": "batch.linear_batch",
    "LinearModel": "linear.model",
    "LinearTrajectory": "linear.linear_trajectory",
    "Linearizer": "linear.linearization",
    "MissingPackageError": "base.errors",
    "Mode": "analysis.modes",
    "ModelError": "base.errors",
    "Modes": "analysis.modes",
    "Momentum": "robot.outputs",
    "Motion": "simulation.motion",
    "Observability": "analysis.observability",
    "OutputFeedback": "control.output_feedback",
    "RandomConfigurations": "batch.configurations",
    "ReactionWheel": "robot.inputs",
    "RelativePose": "robot.outputs",
    "ReducedModel": "analysis.momentum",
    "Robot": "robot.robot",
    "ScheduledFeedback": "batch.gains",
    "SingularInertiaError": "base.errors",
    "StabilizabilityError": "base.errors",
    "StateFeedback": "control.policies",
    "StateMap": "dynamics.state",
    "SweepError": "base.errors",
    "Thruster": "robot.inputs",
    "Trajectory": "linear.trajectory",
    "TrajectoryFeedback": "control.policies",
    "UnknownNameError": "base.errors",
    "UrdfError": "base.errors",
    "Validity": "analysis.validity",
    "acceleration_lqr": "control.acceleration_lqr",
    "bryson": "control.weights",
    "check": "linear.check",
    "configuration": "dynamics.points",
    "controllability": "analysis.controllability",
    "effort": "dynamics.points",
    "equilibrium": "linear.equilibrium",
    "from_model": "robot.loading",
    "generalized_inertia": "analysis.momentum",
    "generalized_jacobian": "analysis.momentum",
    "gramians": "analysis.gramians",
    "grid": "batch.configurations",
    "kalman": "control.kalman",
    "linearize": "linear.linearization",
    "linearize_trajectory": "linear.linear_trajectory",
    "list_robots": "robot.catalog",
    "load": "robot.loading",
    "load_inputs": "robot.input_files",
    "lqg": "control.kalman",
    "lqr": "control.lqr",
    "lqr_batch": "batch.gains",
    "modes": "analysis.modes",
    "momentum_reduction": "analysis.momentum",
    "observability": "analysis.observability",
    "plot_matrices": "analysis.plots",
    "plot_motion": "simulation.motion",
    "plot_poles": "analysis.plots",
    "plot_validity": "analysis.plots",
    "random_configurations": "batch.configurations",
    "sampled_cost": "control.sampled_cost",
    "simulate": "simulation.simulate",
    "sweep": "batch.sweep",
    "tvlqr": "control.tvlqr",
    "validity": "analysis.validity",
    "velocity": "dynamics.points",
    "visualize": "view.visualize",
}

__all__ = sorted(_PUBLIC)  # noqa: PLE0605 - the table above is the one list of public names

if TYPE_CHECKING:
    from fflin.analysis.controllability import Controllability, controllability
    from fflin.analysis.gramians import Gramians, gramians
    from fflin.analysis.modes import Mode, Modes, modes
    from fflin.analysis.momentum import (
        ReducedModel,
        generalized_inertia,
        generalized_jacobian,
        momentum_reduction,
    )
    from fflin.analysis.observability import Observability, observability
    from fflin.analysis.plots import plot_matrices, plot_poles, plot_validity
    from fflin.analysis.validity import Validity, validity
    from fflin.base.errors import (
        ChartError,
        DetectabilityError,
        EquilibriumError,
        FflinError,
        FflinWarning,
        FileError,
        InputError,
        MissingPackageError,
        ModelError,
        SingularInertiaError,
        StabilizabilityError,
        SweepError,
        UnknownNameError,
        UrdfError,
    )
    from fflin.batch.configurations import Grid, RandomConfigurations, grid, random_configurations
    from fflin.batch.gains import GainBatch, ScheduledFeedback, lqr_batch
    from fflin.batch.linear_batch import LinearBatch
    from fflin.batch.sweep import sweep
    from fflin.control.acceleration_lqr import acceleration_lqr
    from fflin.control.gain import Gain
    from fflin.control.gain_schedule import GainSchedule
    from fflin.control.kalman import Compensator, Estimator, kalman, lqg
    from fflin.control.lqr import lqr
    from fflin.control.output_feedback import OutputFeedback
    from fflin.control.policies import Allocation, StateFeedback, TrajectoryFeedback
    from fflin.control.sampled_cost import sampled_cost
    from fflin.control.tvlqr import tvlqr
    from fflin.control.weights import bryson
    from fflin.dynamics.points import configuration, effort, velocity
    from fflin.dynamics.state import StateMap
    from fflin.linear.check import Check, check
    from fflin.linear.equilibrium import Equilibrium, equilibrium
    from fflin.linear.linear_trajectory import LinearTrajectory, linearize_trajectory
    from fflin.linear.linearization import Linearizer, linearize
    from fflin.linear.model import Certificate, LinearModel
    from fflin.linear.trajectory import Trajectory
    from fflin.robot.catalog import list_robots
    from fflin.robot.input_files import load_inputs
    from fflin.robot.inputs import BaseForce, BaseTorque, JointTorque, ReactionWheel, Thruster
    from fflin.robot.loading import from_model, load
    from fflin.robot.outputs import (
        Accelerometer,
        BasePose,
        CenterOfMass,
        FramePose,
        FrameVelocity,
        FullState,
        Gyroscope,
        JointPositions,
        JointVelocities,
        Momentum,
        RelativePose,
    )
    from fflin.robot.robot import Robot
    from fflin.simulation.motion import Motion, plot_motion
    from fflin.simulation.simulate import simulate
    from fflin.view.visualize import visualize


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'fflin' has no attribute '{name}'")
    value = getattr(import_module(f"fflin.{_PUBLIC[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
