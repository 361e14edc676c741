"""What is watched of a robot: the outputs y of the linear model, in any mix and order.

Reference axes are those of the reference placement that the state is relative to.
"""

from dataclasses import dataclass
from typing import TypeAlias

from fflin.base.errors import InputError


@dataclass(frozen=True)
class FullState:
    """Every state, under its own name, in the order and axes of the state."""


@dataclass(frozen=True)
class BasePose:
    """Attitude q_b (3) [1] and position r_b (3) [m] of the base, the states."""


@dataclass(frozen=True)
class JointPositions:
    """Angles [rad] or lengths [m] of joints, the states.

    Parameters
    ----------
    joints : tuple of str, optional
        Independent joints, in the order wanted; all of them, in state order, by default.
    """

    joints: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        _check_joints(self.joints)


@dataclass(frozen=True)
class JointVelocities:
    """Rates [rad/s] or [m/s] of joints, the states.

    Parameters
    ----------
    joints : tuple of str, optional
        Independent joints, in the order wanted; all of them, in state order, by default.
    """

    joints: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        _check_joints(self.joints)


@dataclass(frozen=True)
class FramePose:
    """Pose of a frame of the model, on the base or on any link.

    Position (3) [m] of its origin relative to the reference, in reference axes, and rotation
    vector (3) [rad] from its attitude R* at the point of linearisation, log(R*^T R), in the
    frame's own axes: zero at the point.

    Parameters
    ----------
    frame : str
    """

    frame: str


@dataclass(frozen=True)
class FrameVelocity:
    """Velocity of a frame of the model, with the axes of the hybrid velocity of the base.

    Angular velocity (3) [rad/s] in the frame's own axes, and velocity (3) [m/s] of its origin,
    in reference axes: the rates of `FramePose` at the point, whatever the frame of the state.

    Parameters
    ----------
    frame : str
    """

    frame: str


@dataclass(frozen=True)
class CenterOfMass:
    """Position (3) [m] of the centre of mass relative to the reference, in reference axes."""


@dataclass(frozen=True)
class Momentum:
    """Momentum of the whole robot, in reference axes.

    Angular momentum (3) [N m s] about the centre of mass, that of every wheel included, and
    linear momentum (3) [N s].
    """


@dataclass(frozen=True)
class Gyroscope:
    """What a gyroscope measures: angular velocity (3) [rad/s] of a frame, in its own axes.

    Parameters
    ----------
    frame : str
    """

    frame: str


@dataclass(frozen=True)
class Accelerometer:
    """What an accelerometer measures: specific force (3) [m/s^2], in its own axes.

    The acceleration of the frame's origin less gravity: zero in free fall where nothing turns
    or pushes, and +g upwards where it stands still.

    Parameters
    ----------
    frame : str
    """

    frame: str


Output: TypeAlias = (
    FullState
    | BasePose
    | JointPositions
    | JointVelocities
    | FramePose
    | FrameVelocity
    | CenterOfMass
    | Momentum
    | Gyroscope
    | Accelerometer
)


def _check_joints(joints: tuple[str, ...] | None) -> None:
    # A string is a sequence of names of one letter each.
    if isinstance(joints, str):
        raise InputError(f"joints is {joints!r}, expected a tuple of names, ({joints!r},)")
