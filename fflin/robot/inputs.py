"""What acts on a robot: the inputs u of the linear model, in any mix and order."""

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeAlias

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, dimension, number, refuse_masked, truth

Vector3: TypeAlias = Sequence[float]


@dataclass(frozen=True)
class Input:
    """What every kind of input says of itself."""

    KEY: ClassVar[str]  # its type in a TOML file
    GROUP: ClassVar[str]  # what its inputs are called together, in weights and limits
    UNIT: ClassVar[str] = "N m"
    ENTRIES: ClassVar[str] = " "
    PULLS: ClassVar[bool] = True

    # What it does not exceed, in its unit; one number, or three for torque and force on the base.
    max: float | Vector3 | None = field(default=None, kw_only=True, repr=False)
    # The least that it gives; by default -max, of a thruster 0.
    min: float | Vector3 | None = field(default=None, kw_only=True, repr=False)

    def __post_init__(self) -> None:
        for name in ("max", "min"):
            value, what = getattr(self, name), f"{self.KEY} {name}"
            if value is not None:
                several = len(self.ENTRIES) > 1 and dimension(what, value)
                self._set(name, three_numbers(what, value) if several else number(what, value))
        for least, largest in self.ranges:
            if largest <= 0.0:
                raise InputError(f"{self.KEY} max is {largest:g}, expected more than 0, or none")
            if least > largest:
                raise InputError(f"{self.KEY} min is {least:g}, more than its max of {largest:g}")

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """(least, largest) of each of its entries; infinite where there is no limit."""
        largest = np.broadcast_to(math.inf if self.max is None else self.max, len(self.ENTRIES))
        usual = -largest if self.PULLS else 0.0
        least = np.broadcast_to(usual if self.min is None else self.min, len(largest))
        return tuple(zip(least.tolist(), largest.tolist(), strict=True))

    @property
    def frames(self) -> tuple[str, ...]:
        """The frames of the model that it is fixed in."""
        frame: str | None = getattr(self, "frame", None)
        return () if frame is None else (frame,)

    def names(self, count: int) -> tuple[str, ...]:
        """Return the names of its entries in u, where it is the count-th of its kind."""
        return tuple(f"{self.GROUP}.{entry}" for entry in self.ENTRIES)


class WrenchInput(Input, ABC):
    """An input that pushes or turns a link by a wrench that is constant in a frame."""

    frame: str | None  # of the model, on the base or on any link; None is the base's root frame
    name: str | None

    def names(self, count: int) -> tuple[str, ...]:
        """Return its name in u; thruster_1, wheel_1 and so on where it has none of its own."""
        return (self.name or f"{self.KEY.rpartition('_')[2]}_{count}",)

    @property
    @abstractmethod
    def wrench(self) -> Array:
        """Force [N] and torque [N m] about the frame's origin (6,) of a unit, in the frame."""


class BaseTorque(Input):
    """Torque tau_b (3) [N m] on the base, in the axes that the velocity frame says.

    Parameters
    ----------
    max, min : float or sequence of float (3,), optional
        Limits [N m] of each of its entries, as for every input; by keyword.

    Examples
    --------
    >>> robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(max=0.01)])
    >>> fflin.linearize(robot).input_names
    ('tau_b.x', 'tau_b.y', 'tau_b.z')
    """

    KEY, GROUP, ENTRIES = "base_torque", "tau_b", "xyz"


class BaseForce(Input):
    """Force F_b (3) [N] at the base origin, in the axes that the velocity frame says.

    Parameters
    ----------
    max, min : float or sequence of float (3,), optional
        Limits [N] of each of its entries; by keyword.

    Examples
    --------
    >>> robot = fflin.load("cubesat", inputs=[fflin.BaseForce()])
    >>> fflin.linearize(robot).input_units
    ('N', 'N', 'N')
    """

    KEY, GROUP, UNIT, ENTRIES = "base_force", "F_b", "N", "xyz"


@dataclass(frozen=True)
class JointTorque(Input):
    """Torque [N m], or force [N], of the motor of one joint.

    Parameters
    ----------
    joint : str
        An independent joint. What mimics it is driven with it.
    max, min : float, optional
        Limits [N m | N] in place of the URDF's effort; by keyword.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", inputs=[fflin.JointTorque("joint_2")])
    >>> fflin.linearize(robot).input_names
    ('tau_m.joint_2',)
    """

    KEY, GROUP = "joint_torque", "tau_m"
    joint: str

    def names(self, count: int) -> tuple[str, ...]:
        """Return its name in u."""
        return (f"{self.GROUP}.{self.joint}",)


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
    max, min : float, optional
        Limits [N]; a thruster never pulls. By keyword, as what follows.
    on_off : bool
        Whether it knows `max` and nothing else: in `simulate` the command of a sample becomes a
        pulse of `max` for its share of the sample, in whole steps; what is left over is carried
        to the next sample, so that the impulse is right in the mean.
    least_impulse : float, optional
        [N s] of a sample, below which it does not fire; that is carried over too.

    Examples
    --------
    >>> nozzle = fflin.Thruster("base", position=(-0.9, 0, 0), direction=(1, 0, 0), max=22.0)
    >>> robot = fflin.load("servicer_7dof", inputs=[nozzle])
    >>> fflin.linearize(robot).input_names
    ('thruster_1',)
    """

    KEY, GROUP, UNIT, PULLS = "thruster", "thrust", "N", False
    frame: str
    position: Vector3
    direction: Vector3
    name: str | None = None
    on_off: bool = field(default=False, kw_only=True, repr=False)
    least_impulse: float | None = field(default=None, kw_only=True, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ranges[0][0] < 0.0:
            raise InputError(f"thruster min is {self.min}, expected 0 or more: it never pulls")
        if truth("thruster on_off", self.on_off) and (self.max is None or self.min):
            raise InputError("thruster on_off is set: it needs a max, which it pushes with, no min")
        if (impulse := self.least_impulse) is not None:
            self._set("least_impulse", _positive("thruster least_impulse", impulse, "N s"))
        self._set("position", three_numbers("thruster position", self.position))
        self._set("direction", _unit("thruster direction", self.direction, "where it pushes"))

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
    max, min : float, optional
        Limits [N m] of the motor's torque; by keyword, as what follows.
    max_speed : float, optional
        Largest speed [rad/s] relative to the carrier, either way, of a wheel with an inertia J:
        it stores up to J max_speed [N m s].

    Examples
    --------
    >>> wheel = fflin.ReactionWheel((0, 0, 1), inertia=1e-5, name="wheel_z")
    >>> robot = fflin.load("cubesat", inputs=[wheel])
    >>> lin = fflin.linearize(robot, v=fflin.velocity(robot, {"wheel_z": 500.0}))
    >>> lin.state_names[-1], lin.state_units[-1]
    ('qdot_m.wheel_z', 'rad/s')
    """

    KEY, GROUP = "reaction_wheel", "wheel"
    axis: Vector3
    frame: str | None = None
    inertia: float | None = None
    name: str | None = None
    momentum: float = 0.0
    max_speed: float | None = field(default=None, kw_only=True, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set("axis", _unit("wheel axis", self.axis, "what it turns about"))
        self._set("momentum", number("wheel momentum", self.momentum))
        if self.max_speed is not None:
            speed = _positive("wheel max_speed", self.max_speed, "rad/s")
            self._set("max_speed", speed)
            if self.inertia is None:
                raise InputError(
                    f"wheel max_speed is {speed:g} rad/s, but its speed is no state; give it an "
                    "inertia too"
                )
        if self.inertia is None:
            return
        hint = "; leave it out for a wheel of which only the momentum counts"
        inertia = _positive("wheel inertia", self.inertia, "kg m^2", hint)
        if self.momentum:
            raise InputError(
                "wheel momentum is given beside an inertia, with which its speed is a state; leave "
                "one out, and give the speed as a velocity of the point"
            )
        self._set("inertia", inertia)

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


def _positive(what: str, value: float, unit: str, hint: str = "") -> float:
    size = number(what, value)
    if size <= 0.0:
        raise InputError(f"{what} is {size:g} {unit}, expected more than 0{hint}")
    return size


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


def named_inputs(inputs: Sequence[Input]) -> list[tuple[Input, tuple[str, ...]]]:
    """Return inputs, each with the names of its entries in u."""
    seen: Counter[str] = Counter()
    found = []
    for item in inputs:
        seen[item.GROUP] += 1
        found.append((item, item.names(seen[item.GROUP])))
    return found


def named_wheels(inputs: Sequence[Input]) -> list[tuple[str, ReactionWheel]]:
    """Return the wheels among inputs, each with its name: wheel_1, wheel_2, ... by default."""
    found = named_inputs(inputs)
    return [(names[0], item) for item, names in found if isinstance(item, ReactionWheel)]
