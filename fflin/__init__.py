"""Linear models of free-floating robots: URDF in, checked A and B out."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# Public name -> module. Each is imported when it is first asked for, so that a command which
# needs no dynamics does not pay for them.
_PUBLIC = {
    "Accelerometer": "outputs",
    "BaseForce": "inputs",
    "BasePose": "outputs",
    "BaseTorque": "inputs",
    "CenterOfMass": "outputs",
    "Certificate": "linear_model",
    "ChartError": "errors",
    "Check": "verification",
    "FflinError": "errors",
    "FflinWarning": "errors",
    "FileError": "errors",
    "FramePose": "outputs",
    "FrameVelocity": "outputs",
    "FullState": "outputs",
    "Gyroscope": "outputs",
    "Grid": "configurations",
    "InputError": "errors",
    "JointPositions": "outputs",
    "JointTorque": "inputs",
    "JointVelocities": "outputs",
    "LinearBatch": "linear_batch",
    "LinearModel": "linear_model",
    "LinearTrajectory": "trajectory",
    "Linearizer": "linearization",
    "MissingPackageError": "errors",
    "ModelError": "errors",
    "Momentum": "outputs",
    "RandomConfigurations": "configurations",
    "Robot": "model",
    "SingularInertiaError": "errors",
    "StateMap": "state",
    "SweepError": "errors",
    "Thruster": "inputs",
    "UnknownNameError": "errors",
    "UrdfError": "errors",
    "check": "verification",
    "configuration": "model",
    "effort": "points",
    "from_model": "loading",
    "grid": "configurations",
    "linearize": "linearization",
    "linearize_trajectory": "trajectory",
    "list_robots": "robots",
    "load": "loading",
    "load_inputs": "input_files",
    "random_configurations": "configurations",
    "sweep": "sweeping",
    "velocity": "points",
}

__all__ = sorted(_PUBLIC)  # noqa: PLE0605 - the table above is the one list of public names

if TYPE_CHECKING:
    from fflin.configurations import Grid, RandomConfigurations, grid, random_configurations
    from fflin.errors import (
        ChartError,
        FflinError,
        FflinWarning,
        FileError,
        InputError,
        MissingPackageError,
        ModelError,
        SingularInertiaError,
        SweepError,
        UnknownNameError,
        UrdfError,
    )
    from fflin.input_files import load_inputs
    from fflin.inputs import BaseForce, BaseTorque, JointTorque, Thruster
    from fflin.linear_batch import LinearBatch
    from fflin.linear_model import Certificate, LinearModel
    from fflin.linearization import Linearizer, linearize
    from fflin.loading import from_model, load
    from fflin.model import Robot, configuration
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
    from fflin.robots import list_robots
    from fflin.state import StateMap
    from fflin.sweeping import sweep
    from fflin.trajectory import LinearTrajectory, linearize_trajectory
    from fflin.verification import Check, check


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'fflin' has no attribute '{name}'")
    value = getattr(import_module(f"fflin.{_PUBLIC[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
