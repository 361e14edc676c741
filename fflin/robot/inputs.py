"""What acts on a robot: the inputs u of the linear model, in any mix and order."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, number, refuse_masked

Vector3: TypeAlias = Sequence[float]


@dataclass(frozen=True)
class Input:
    """What every kind of input says of itself.

    Attributes
    ----------
    KEY : str
        Its type in a TOML file; what has no name of its own is KEY_1, KEY_2, ...
    GROUP : str
        What its inputs are called together, in weights and limits.
    UNIT : str
    """

    KEY: ClassVar[str]
    GROUP: ClassVar[str]
    UNIT: ClassVar[str] = "N m"

    @property
    def frames(self) -> tuple[str, ...]:
        """The frames of the model that it is fixed in."""
        return ()


class WrenchInput(Input, ABC):
    """An input that pushes or turns a link by a wrench that is constant in a frame.

    Attributes
    ----------
    frame : str or None
        Frame of the model, on the base or on any link; None is the base's root frame.
    """

    frame: str | None

    @property
    def frames(self) -> tuple[str, ...]:
        """The frames of the model that it is fixed in."""
        return () if self.frame is None else (self.frame,)

    @property
    @abstractmethod
    def wrench(self) -> Array:
        """Force [N] and torque [N m] about the frame's origin (6,) of a unit, in the frame."""


@dataclass(frozen=True)
class BaseTorque(Input):
    """Torque tau_b (3) [N m] on the base, in the axes that the velocity frame says."""

    KEY, GROUP = "base_torque", "tau_b"


@dataclass(frozen=True)
class BaseForce(Input):
    """Force F_b (3) [N] at the base origin, in the axes that the velocity frame says."""

    KEY, GROUP, UNIT = "base_force", "F_b", "N"


@dataclass(frozen=True)
class JointTorque(Input):
    """Torque [N m], or force [N], of the motor of one joint.

    Parameters
    ----------
    joint : str
        An independent joint. What mimics it is driven with it.
    """

    KEY, GROUP = "joint_torque", "tau_m"
    joint: str


@dataclass(frozen=True)
class Thruster(WrenchInput):
    """Force [N] along a direction that is fixed in a frame, at a point fixed in that frame.

    Parameters
    ----------
    frame : str
        Frame of the model, on the base or on any link.
    position : sequence of float (3,)
        Where it pushes [m], in that frame.
    direction : sequence of float (3,)
        Along which the link is pushed, in that frame; of any length but zero.
    name : str, optional
        Name of the input; thruster_1, thruster_2, ... by default.
    """

    KEY, GROUP, UNIT = "thruster", "thrust", "N"
    frame: str
    position: Vector3
    direction: Vector3
    name: str | None = None

    def __post_init__(self) -> None:
        position = three_numbers("thruster position", self.position)
        object.__setattr__(self, "position", position)
        direction = _unit("thruster direction", self.direction, "where it pushes")
        object.__setattr__(self, "direction", direction)

    @property
    def wrench(self) -> Array:
        """Force [N] and torque [N m] about the frame's origin (6,) of a unit, in the frame."""
        return np.concatenate((self.direction, np.cross(self.position, self.direction)))


@dataclass(frozen=True)
class ReactionWheel(WrenchInput):
    r"""Motor torque [N m] of a balanced wheel that turns about an axis fixed on a link.

    The torque u acts on the wheel along the axis a, and -u on the link that carries it: its power
    is u times the speed of the wheel relative to that link. The carrier's mass and inertia in the
    URDF count the wheel, as if it were welded.

    With an ``inertia`` the speed of the wheel is a state: the robot has one more joint, a
    continuous one of the wheel's name, after all joints that hang on its carrier. J a a^T goes
    from the carrier's inertia to the wheel's; mass and transverse inertia stay where they are.

    Without, the wheel is no joint: it turns its carrier by -u a, and where it spins, by the
    gyroscopic torque :math:`-\omega \times h a` of its ``momentum`` h. That is the limit of a
    small and fast wheel: h is constant, also where u is not zero, and its carrier keeps J.

    Parameters
    ----------
    axis : sequence of float (3,)
        What it turns about, in that frame; of any length but zero.
    frame : str, optional
        Frame of the model, on the base or on any link; the base's root frame by default.
    inertia : float, optional
        J [kg m^2] about the axis. The carrier must have that much, and more.
    name : str, optional
        Name of the input, and of the joint if there is one; wheel_1, wheel_2, ... by default.
    momentum : float
        h [N m s] along the axis, relative to the carrier; of a wheel without inertia.
    """

    KEY, GROUP = "reaction_wheel", "wheel"
    axis: Vector3
    frame: str | None = None
    inertia: float | None = None
    name: str | None = None
    momentum: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "axis", _unit("wheel axis", self.axis, "what it turns about"))
        object.__setattr__(self, "momentum", number("wheel momentum", self.momentum))
        if self.inertia is None:
            return
        inertia = number("wheel inertia", self.inertia)
        if inertia <= 0.0:
            raise InputError(
                f"wheel inertia is {inertia:g} kg m^2, expected more than 0; leave it out for a "
                "wheel of which only the momentum counts"
            )
        if self.momentum:
            raise InputError(
                "wheel momentum is given beside an inertia, with which its speed is a state; leave "
                "one out, and give the speed as a velocity of the point"
            )
        object.__setattr__(self, "inertia", inertia)

    @property
    def wrench(self) -> Array:
        """Force [N] and torque [N m] about the frame's origin (6,) of a unit, in the frame."""
        return np.concatenate((np.zeros(3), -np.array(self.axis)))


KINDS: tuple[type[Input], ...] = (BaseTorque, BaseForce, JointTorque, Thruster, ReactionWheel)


def three_numbers(what: str, value: Vector3) -> tuple[float, float, float]:
    """Return three finite floats, or raise `InputError` that says what was given."""
    refuse_masked(what, value)
    try:
        x, y, z = (float(entry) for entry in value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} is {value!r}, expected three numbers") from None
    if not math.isfinite(x + y + z):
        raise InputError(f"{what} is {value!r}, expected finite numbers")
    return x, y, z


def _unit(what: str, value: Vector3, hint: str) -> tuple[float, float, float]:
    """Return three numbers scaled to length 1, or raise `InputError` where they are zero."""
    x, y, z = three_numbers(what, value)
    largest = max(abs(x), abs(y), abs(z))
    if largest == 0.0:
        raise InputError(f"{what} is zero; give {hint}")
    # Scaled first: squares of very large or small numbers are none.
    x, y, z = x / largest, y / largest, z / largest
    length = math.hypot(x, y, z)
    return x / length, y / length, z / length


def named_wheels(inputs: Sequence[Input]) -> list[tuple[str, ReactionWheel]]:
    """Return the wheels among inputs, each with its name: wheel_1, wheel_2, ... by default."""
    wheels = [item for item in inputs if isinstance(item, ReactionWheel)]
    return [(wheel.name or f"wheel_{k}", wheel) for k, wheel in enumerate(wheels, start=1)]


def default_inputs(joint_names: Sequence[str]) -> tuple[Input, ...]:
    """Return one force for each degree of freedom: tau_b, F_b and every joint's."""
    return (BaseTorque(), BaseForce(), *(JointTorque(name) for name in joint_names))
