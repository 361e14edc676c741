"""What acts on a robot: the inputs u of the linear model, in any mix and order."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

from fflin.errors import InputError

Vector3: TypeAlias = Sequence[float]


@dataclass(frozen=True)
class BaseTorque:
    """Torque tau_b (3) [N m] on the base, in the axes that the velocity frame says."""


@dataclass(frozen=True)
class BaseForce:
    """Force F_b (3) [N] at the base origin, in the axes that the velocity frame says."""


@dataclass(frozen=True)
class JointTorque:
    """Torque [N m], or force [N], of the motor of one joint.

    Parameters
    ----------
    joint : str
        An independent joint. What mimics it is driven with it.
    """

    joint: str


@dataclass(frozen=True)
class Thruster:
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

    frame: str
    position: Vector3
    direction: Vector3
    name: str | None = None

    def __post_init__(self) -> None:
        for key in ("position", "direction"):
            object.__setattr__(self, key, three_numbers(f"thruster {key}", getattr(self, key)))
        length = math.hypot(*self.direction)
        if length == 0.0:
            raise InputError("thruster direction is zero; give where it pushes")
        object.__setattr__(self, "direction", tuple(x / length for x in self.direction))


Input: TypeAlias = BaseTorque | BaseForce | JointTorque | Thruster


def three_numbers(what: str, value: Vector3) -> tuple[float, float, float]:
    """Return three finite floats, or raise `InputError` that says what was given."""
    try:
        x, y, z = (float(entry) for entry in value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} is {value!r}, expected three numbers") from None
    if not math.isfinite(x + y + z):
        raise InputError(f"{what} is {value!r}, expected finite numbers")
    return x, y, z


def default_inputs(joint_names: Sequence[str]) -> tuple[Input, ...]:
    """Return one force for each degree of freedom: tau_b, F_b and every joint's."""
    return (BaseTorque(), BaseForce(), *(JointTorque(name) for name in joint_names))
