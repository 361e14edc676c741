"""Linear models of free-floating robots: URDF in, checked A and B out."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from fflin.base.version import __version__

# Public names by what they are for, each row after its module. A name is imported when it is first
# asked for, so that a command which needs no dynamics does not pay for it.
_NAMES = {
    "Robots": (
        "robot.loading load from_model",
        "robot.catalog list_robots",
        "robot.robot Robot",
        "dynamics.points configuration velocity effort",
    ),
    "Inputs": (
        "robot.inputs BaseTorque BaseForce JointTorque Thruster ReactionWheel",
        "robot.input_files load_inputs",
    ),
    "Outputs": (
        "robot.outputs FullState JointPositions JointVelocities BasePose FramePose",
        "robot.outputs FrameVelocity RelativePose Gyroscope Accelerometer",
        "robot.outputs CenterOfMass Momentum",
    ),
    "Linear models": (
        "linear.linearization linearize Linearizer",
        "linear.model LinearModel Certificate",
        "dynamics.state StateMap",
        "linear.equilibrium equilibrium Equilibrium",
        "linear.trajectory Trajectory",
        "linear.linear_trajectory linearize_trajectory LinearTrajectory",
        "linear.check check Check",
    ),
    "Analysis": (
        "analysis.controllability controllability Controllability",
        "analysis.observability observability Observability",
        "analysis.gramians gramians Gramians",
        "analysis.modes modes Modes Mode",
        "analysis.momentum momentum_reduction ReducedModel generalized_inertia",
        "analysis.momentum generalized_jacobian",
        "analysis.validity validity Validity",
    ),
    "Control": (
        "control.lqr lqr",
        "control.weights bryson",
        "control.gain Gain",
        "control.acceleration_lqr acceleration_lqr",
        "control.sampled_cost sampled_cost",
        "control.tvlqr tvlqr",
        "control.gain_schedule GainSchedule",
        "control.kalman kalman Estimator lqg Compensator",
    ),
    "Policies": (
        "control.policies StateFeedback Allocation",
        "control.tracking TrajectoryFeedback",
        "control.output_feedback OutputFeedback",
        "batch.gains ScheduledFeedback",
    ),
    "Simulation": (
        "simulation.simulate simulate",
        "simulation.motion Motion",
        "view.visualize visualize",
    ),
    "Sweeps": (
        "batch.sweep sweep",
        "batch.linear_batch LinearBatch",
        "batch.gains lqr_batch GainBatch",
        "batch.configurations grid Grid random_configurations RandomConfigurations",
    ),
    "Figures": (
        "analysis.plots plot_matrices plot_check plot_modes plot_validity",
        "control.plots plot_poles plot_loops",
        "simulation.motion plot_motion",
    ),
    "Errors": (
        "base.errors FflinError InputError UnknownNameError FileError",
        "base.errors MissingPackageError ModelError UrdfError ChartError",
        "base.errors EquilibriumError SingularInertiaError StabilizabilityError",
        "base.errors DetectabilityError SweepError FflinWarning",
    ),
}
_PUBLIC = {
    name: module
    for rows in _NAMES.values()
    for module, *names in map(str.split, rows)
    for name in names
}

__doc__ = f"{__doc__}\n" + "\n".join(
    f"\n{title}\n    " + "\n    ".join(", ".join(row.split()[1:]) for row in rows)
    for title, rows in _NAMES.items()
)

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
    from fflin.analysis.plots import plot_check, plot_matrices, plot_modes, plot_validity
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
    from fflin.control.plots import plot_loops, plot_poles
    from fflin.control.policies import Allocation, StateFeedback
    from fflin.control.sampled_cost import sampled_cost
    from fflin.control.tracking import TrajectoryFeedback
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
