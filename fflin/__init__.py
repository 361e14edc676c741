"""Linear models of free-floating robots: URDF in, checked A and B out."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# Public name -> module. Each is imported when it is first asked for, so that a command which
# needs no dynamics does not pay for them.
_PUBLIC = {
    "Accelerometer": "outputs",
    "Allocation": "policies",
    "BaseForce": "inputs",
    "BasePose": "outputs",
    "BaseTorque": "inputs",
    "CenterOfMass": "outputs",
    "Certificate": "linear_model",
    "ChartError": "errors",
    "Check": "verification",
    "Compensator": "estimation",
    "Controllability": "structure",
    "DetectabilityError": "errors",
    "Equilibrium": "balance",
    "EquilibriumError": "errors",
    "Estimator": "estimation",
    "FflinError": "errors",
    "FflinWarning": "errors",
    "FileError": "errors",
    "FramePose": "outputs",
    "FrameVelocity": "outputs",
    "FullState": "outputs",
    "Gain": "regulator",
    "GainBatch": "gain_batches",
    "GainSchedule": "schedules",
    "Gramians": "gramian",
    "Grid": "configurations",
    "Gyroscope": "outputs",
    "InputError": "errors",
    "JointPositions": "outputs",
    "JointTorque": "inputs",
    "JointVelocities": "outputs",
    "LinearBatch": "linear_batch",
    "LinearModel": "linear_model",
    "LinearTrajectory": "trajectory",
    "Linearizer": "linearization",
    "MissingPackageError": "errors",
    "Mode": "eigenmodes",
    "ModelError": "errors",
    "Modes": "eigenmodes",
    "Momentum": "outputs",
    "Motion": "motion",
    "Observability": "observation",
    "OutputFeedback": "output_feedback",
    "RandomConfigurations": "configurations",
    "ReactionWheel": "inputs",
    "ReducedModel": "momentum",
    "Robot": "model",
    "ScheduledFeedback": "gain_batches",
    "SingularInertiaError": "errors",
    "StabilizabilityError": "errors",
    "StateFeedback": "policies",
    "StateMap": "state",
    "SweepError": "errors",
    "Thruster": "inputs",
    "TrajectoryFeedback": "policies",
    "UnknownNameError": "errors",
    "UrdfError": "errors",
    "Validity": "region",
    "acceleration_lqr": "acceleration",
    "bryson": "weights",
    "check": "verification",
    "configuration": "model",
    "controllability": "structure",
    "effort": "points",
    "equilibrium": "balance",
    "from_model": "loading",
    "generalized_inertia": "momentum",
    "generalized_jacobian": "momentum",
    "gramians": "gramian",
    "grid": "configurations",
    "kalman": "estimation",
    "linearize": "linearization",
    "linearize_trajectory": "trajectory",
    "list_robots": "robots",
    "load": "loading",
    "load_inputs": "input_files",
    "lqg": "estimation",
    "lqr": "regulator",
    "lqr_batch": "gain_batches",
    "modes": "eigenmodes",
    "momentum_reduction": "momentum",
    "observability": "observation",
    "plot_matrices": "model_plots",
    "plot_motion": "motion",
    "plot_poles": "model_plots",
    "plot_validity": "model_plots",
    "random_configurations": "configurations",
    "sampled_cost": "sampling",
    "simulate": "simulation",
    "sweep": "sweeping",
    "tvlqr": "schedules",
    "validity": "region",
    "velocity": "points",
    "visualize": "viewer",
}

__all__ = sorted(_PUBLIC)  # noqa: PLE0605 - the table above is the one list of public names

if TYPE_CHECKING:
    from fflin.acceleration import acceleration_lqr
    from fflin.balance import Equilibrium, equilibrium
    from fflin.configurations import Grid, RandomConfigurations, grid, random_configurations
    from fflin.eigenmodes import Mode, Modes, modes
    from fflin.errors import (
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
    from fflin.estimation import Compensator, Estimator, kalman, lqg
    from fflin.gain_batches import GainBatch, ScheduledFeedback, lqr_batch
    from fflin.gramian import Gramians, gramians
    from fflin.input_files import load_inputs
    from fflin.inputs import BaseForce, BaseTorque, JointTorque, ReactionWheel, Thruster
    from fflin.linear_batch import LinearBatch
    from fflin.linear_model import Certificate, LinearModel
    from fflin.linearization import Linearizer, linearize
    from fflin.loading import from_model, load
    from fflin.model import Robot, configuration
    from fflin.model_plots import plot_matrices, plot_poles, plot_validity
    from fflin.momentum import (
        ReducedModel,
        generalized_inertia,
        generalized_jacobian,
        momentum_reduction,
    )
    from fflin.motion import Motion, plot_motion
    from fflin.observation import Observability, observability
    from fflin.output_feedback import OutputFeedback
    from fflin.outputs import (
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
    )
    from fflin.points import effort, velocity
    from fflin.policies import Allocation, StateFeedback, TrajectoryFeedback
    from fflin.region import Validity, validity
    from fflin.regulator import Gain, lqr
    from fflin.robots import list_robots
    from fflin.sampling import sampled_cost
    from fflin.schedules import GainSchedule, tvlqr
    from fflin.simulation import simulate
    from fflin.state import StateMap
    from fflin.structure import Controllability, controllability
    from fflin.sweeping import sweep
    from fflin.trajectory import LinearTrajectory, linearize_trajectory
    from fflin.verification import Check, check
    from fflin.viewer import visualize
    from fflin.weights import bryson


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'fflin' has no attribute '{name}'")
    value = getattr(import_module(f"fflin.{_PUBLIC[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
