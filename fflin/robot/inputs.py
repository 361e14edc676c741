"""Inputs u of the linear model: forces and torques on a robot, in any combination and order."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, TypeAlias, cast

import numpy as np

from fflin.base.errors import InputError
from fflin.base.shown import shown_fields
from fflin.base.validation import Array, dimension, number, positive, truth

Vector3: TypeAlias = Sequence[float]

# Lower and upper limit; a missing limit is -inf or inf.
Range: TypeAlias = tuple[float, float]


@dataclass(frozen=True, repr=False)
class Input:
    """Base class of inputs, which checks their limits and names."""

    KEY: ClassVar[str]  # `type` in a TOML file
    # common name of all inputs of this class in weights and limits
    GROUP: ClassVar[str]
    UNIT: ClassVar[str] = "N m"
    ENTRIES: ClassVar[str] = " "
    PULLS: ClassVar[bool] = True

    # Upper limit in UNIT: one number, or three numbers for the entries of a torque or force on the
    # base.
    max: float | Vector3 | None = field(default=None, kw_only=True, repr=False)
    # Lower limit in UNIT; by default -max, or 0 for a thruster.
    min: float | Vector3 | None = field(default=None, kw_only=True, repr=False)
    # Time constant T [s] of the actuator: the force u_a that acts follows u_a' = (u - u_a) / T.
    lag: float | None = field(default=None, kw_only=True, repr=False)

    def __repr__(self) -> str:
        return shown_fields(self)

    def __post_init__(self) -> None:
        for name in ("frame", "joint", "name"):
            value = getattr(self, name, None)
            if value is not None and not (isinstance(value, str) and value):
                raise InputError(f"{self.KEY} {name} is {value!r}, expected a name")
        for name in ("max", "min"):
            value = getattr(self, name)
            label = f"{self.KEY} {name}"
            if value is None:
                continue
            if len(self.ENTRIES) > 1 and dimension(label, value):
                self._set(name, three_numbers(label, value))
            else:
                self._set(name, number(label, value))
        if self.lag is not None:
            self._set("lag", positive(f"{self.KEY} lag", self.lag, "s"))
        for least, largest in self.ranges:
            if not least <= largest or largest <= 0.0:
                raise InputError(
                    f"{self.KEY} min is {least:g} and max is {largest:g}, expected a max of more "
                    "than 0 and a min of at most max; leave out what is not limited"
                )

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    @property
    def ranges(self) -> tuple[Range, ...]:
        """Limits (least, largest) of each entry of the input; a missing limit is infinite."""
        upper = math.inf if self.max is None else self.max
        largest = np.broadcast_to(upper, len(self.ENTRIES))
        usual = -largest if self.PULLS else 0.0
        lower = usual if self.min is None else self.min
        least = np.broadcast_to(lower, len(largest))
        return tuple(zip(least.tolist(), largest.tolist(), strict=True))

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the model's frames on which this input is mounted."""
        return ()

    @property
    def actuator(self) -> str:
        """Properties of the actuator that are given, such as "on-off, lag 0.05 s"."""
        return f"lag {self.lag:g} s" if self.lag else ""


class BaseTorque(Input):
    """Torque tau_b (3,) [N m] on the base, in the axes that `frame` of `linearize` selects.

    Parameters
    ----------
    max, min : float or sequence of float (3,), optional
        Upper and lower limits [N m] of each entry; keyword only.
    lag : float, optional
        Time constant T [s] of the actuator, keyword only: the torque that acts follows the command
        u by ``d(u_a)/dt = (u - u_a) / T``. Every type of input accepts `max`, `min` and `lag`.
        Simulations contain the lag. `LinearModel.with_lags` adds it to a linear model.

    Examples
    --------
    >>> robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(max=0.01)])
    >>> fflin.linearize(robot).input_names
    ('tau_b.x', 'tau_b.y', 'tau_b.z')
    """

    KEY, GROUP, ENTRIES = "base_torque", "tau_b", "xyz"


class BaseForce(Input):
    """Force F_b (3,) [N] at the base origin, in the axes that `frame` of `linearize` selects.

    Parameters
    ----------
    max, min : float or sequence of float (3,), optional
        Upper and lower limits [N] of each entry; keyword only.

    Examples
    --------
    >>> robot = fflin.load("cubesat", inputs=[fflin.BaseForce()])
    >>> fflin.linearize(robot).input_units
    ('N', 'N', 'N')
    """

    KEY, GROUP, UNIT, ENTRIES = "base_force", "F_b", "N", "xyz"


@dataclass(frozen=True, repr=False)
class JointTorque(Input):
    """Torque [N m] or force [N] of the motor of one joint.

    Parameters
    ----------
    joint : str
        Name of an independent joint. The motor also drives the mimic joints of this joint.
    max, min : float, optional
        Upper and lower limits [N m | N], which replace the effort limit of the URDF; keyword only.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", inputs=[fflin.JointTorque("joint_2")])
    >>> fflin.linearize(robot).input_names
    ('tau_m.joint_2',)
    """

    KEY, GROUP = "joint_torque", "tau_m"
    joint: str


@dataclass(frozen=True, repr=False)
class Thruster(Input):
    """Force [N] of a thruster or rotor, with its point of action and direction fixed in a frame.

    Parameters
    ----------
    frame : str
        Frame of the model, on the base or on any link.
    position : sequence of float (3,)
        Point [m] at which the force acts, in the axes of `frame`.
    direction : sequence of float (3,)
        Direction of the force on the link (opposite to the exhaust), in the axes of `frame`. The
        vector may have any length except zero.
    name : str, optional
        Name of the input; thruster_1, thruster_2, ... by default.
    max, min : float, optional
        Upper and lower limits [N], which must be at least 0, because a thruster never pulls. These
        and all following parameters are keyword only.
    on_off : bool
        True if the thruster can only be off or produce the thrust `max`. In each sample, `simulate`
        then replaces the commanded thrust by one pulse of `max`, whose length is a whole number of
        steps. The difference from the commanded impulse is added to the command of the next sample,
        so that the mean impulse is correct.
    least_impulse : float, optional
        Smallest impulse [N s] that the thruster can produce in a sample. If the commanded impulse
        is smaller, the thruster does not fire, and this impulse is added to the command of the next
        sample.
    torque : float
        Reaction torque [N m] on the link for each newton of force, about the direction of the
        force; zero by default. For a propeller this is the drag torque, which is opposite to the
        rotation: it is negative for a propeller that turns by the right-hand rule about the force.
    isp : float, optional
        Specific impulse [s], with which the report of a simulation computes the propellant.

    Examples
    --------
    >>> nozzle = fflin.Thruster("base", position=(-0.9, 0, 0), direction=(1, 0, 0), max=22.0)
    >>> robot = fflin.load("servicer_7dof", inputs=[nozzle])
    >>> fflin.linearize(robot).input_names
    ('thruster_1',)
    >>> rotor = fflin.Thruster("base", (0.2, 0, 0), (0, 0, 1), "front", max=6.0, torque=-0.016)
    >>> rotor.wrench.tolist()
    [0.0, 0.0, 1.0, 0.0, -0.2, -0.016]
    """

    KEY, GROUP, UNIT, PULLS = "thruster", "thrust", "N", False
    frame: str
    position: Vector3
    direction: Vector3
    name: str | None = None
    on_off: bool = field(default=False, kw_only=True, repr=False)
    least_impulse: float | None = field(default=None, kw_only=True, repr=False)
    torque: float = field(default=0.0, kw_only=True, repr=False)
    isp: float | None = field(default=None, kw_only=True, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.isp is not None:
            self._set("isp", positive("thruster isp", self.isp, "s"))
        pulses = truth("thruster on_off", self.on_off)
        if self.ranges[0][0] < 0.0 or (pulses and (self.max is None or self.min)):
            raise InputError(
                f"thruster min is {self.min} and max is {self.max}, expected a min of 0 or more; "
                "an on_off thruster needs a max, the force of its pulses, and no min"
            )
        if (impulse := self.least_impulse) is not None:
            self._set(
                "least_impulse", positive("thruster least_impulse", impulse, "N s")
            )
        self._set("position", three_numbers("thruster position", self.position))
        self._set("direction", unit_vector("thruster direction", self.direction))
        self._set("torque", number("thruster torque", self.torque))

    @property
    def frames(self) -> tuple[str, ...]:
        """Name of the frame on which the thruster is mounted."""
        return (self.frame,)

    @property
    def actuator(self) -> str:
        """Pulses, specific impulse and lag of the thruster, if they are given."""
        parts = ["on-off"] if self.on_off else []
        if self.least_impulse is not None:
            parts.append(f"least impulse {self.least_impulse:g} N s")
        if self.isp is not None:
            parts.append(f"isp {self.isp:g} s")
        if self.lag:
            parts.append(f"lag {self.lag:g} s")
        return ", ".join(parts)

    @property
    def wrench(self) -> Array:
        """Force [N] and torque [N m] (6,) of a unit input, at the frame's origin in frame axes."""
        force = np.array(self.direction)
        return np.concatenate(
            (force, np.cross(self.position, force) + self.torque * force)
        )


@dataclass(frozen=True, repr=False)
class ReactionWheel(Input):
    r"""Motor torque [N m] of a balanced reaction wheel, whose axis is fixed on a link.

    The link that carries the wheel is called the carrier. The motor exerts the torque u about the
    axis a on the wheel, and the torque -u on the carrier. The motor's power is u times the speed of
    the wheel relative to the carrier. The carrier's mass and inertia in the URDF must include the
    wheel as if it were welded.

    If the wheel has an ``inertia`` J, the speed of the wheel is a state, because the wheel becomes
    an additional continuous joint of the robot with the wheel's name. In the state vector, this
    joint comes after all other joints on the carrier. The inertia J a a^T is transferred from the
    carrier to the wheel; the wheel's mass and transverse inertia stay with the carrier.

    If ``inertia`` is omitted, the wheel is modelled only by two torques on its carrier: the
    reaction -u a, and the gyroscopic torque :math:`-\omega \times h a` of the wheel's ``momentum``
    h, where :math:`\omega` is the angular velocity of the carrier. This model is the limit of a
    small and fast wheel: h stays constant even if u is nonzero, and J is part of the carrier's
    inertia.

    Parameters
    ----------
    axis : sequence of float (3,)
        Rotation axis a in the axes of `frame`. The vector may have any length except zero.
    frame : str, optional
        Frame of the model, on the base or on any link; by default the root frame of the base.
    inertia : float, optional
        Moment of inertia J [kg m^2] about the axis. The carrier must have a larger inertia about
        the same axis.
    name : str, optional
        Name of the input, and of the joint of a wheel with inertia; wheel_1, wheel_2, ... by
        default.
    momentum : float
        Constant angular momentum h [N m s] about the axis, relative to the carrier. Give `momentum`
        only if `inertia` is omitted.
    max, min : float, optional
        Upper and lower limits [N m] of the motor's torque. These and all following parameters are
        keyword only.
    max_speed : float, optional
        Largest speed [rad/s] relative to the carrier to which the motor accelerates the wheel, in
        both directions. Other inputs that rotate the carrier can drive the wheel beyond this speed.
        Give `max_speed` only for a wheel with inertia J, which then stores J max_speed [N m s].

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
        self._set("axis", unit_vector("wheel axis", self.axis))
        self._set("momentum", number("wheel momentum", self.momentum))
        if self.max_speed is not None:
            self._set("max_speed", positive("wheel max_speed", self.max_speed, "rad/s"))
        given = self.max_speed if self.inertia is None else self.momentum
        if given:
            raise InputError(
                f"wheel momentum is {self.momentum:g}, inertia is {self.inertia} and max_speed is "
                f"{self.max_speed}; give either an inertia, whose speed is a state, or a momentum"
            )
        if self.inertia is not None:
            hint = "; leave it out to model the wheel by its momentum alone"
            self._set(
                "inertia", positive("wheel inertia", self.inertia, "kg m^2", hint)
            )

    @property
    def frames(self) -> tuple[str, ...]:
        """Name of the frame on which the wheel is mounted; () for the root frame of the base."""
        if self.frame is None:
            return ()
        return (self.frame,)

    @property
    def wrench(self) -> Array:
        """Force [N] and torque [N m] (6,) of a unit input, at the frame's origin in frame axes."""
        return np.concatenate((np.zeros(3), -np.array(self.axis)))


@dataclass(frozen=True, repr=False)
class Magnetorquer(Input):
    r"""Magnetic dipole moment [A m^2] of a coil or rod, whose axis is fixed on a link.

    The moment m about the axis s exerts the torque :math:`m\, s \times b` on its link, with the
    magnetic flux density b at the origin of the orbital frame. So the robot needs an orbit with a
    magnetic field, see `CircularOrbit`. The torque never has a part along b. Linear models contain
    the field at t = 0, and must be about points at which the moments are zero.

    Parameters
    ----------
    axis : sequence of float (3,)
        Axis s in the axes of `frame`. The vector may have any length except zero.
    frame : str, optional
        Frame of the model, on the base or on any link; by default the root frame of the base.
    name : str, optional
        Name of the input; magnetorquer_1, magnetorquer_2, ... by default.
    max, min : float, optional
        Upper and lower limits [A m^2] of the moment; keyword only.

    Examples
    --------
    >>> orbit = fflin.CircularOrbit(500e3, inclination=1.7, field="dipole")
    >>> rods = [fflin.Magnetorquer(axis, max=0.2) for axis in np.eye(3)]
    >>> robot = fflin.load("cubesat", inputs=rods, orbit=orbit)
    >>> lin = fflin.linearize(robot)
    >>> lin.input_names[0], lin.input_units[0], int(np.linalg.matrix_rank(lin.B))
    ('magnetorquer_1', 'A m^2', 2)
    """

    KEY, GROUP, UNIT = "magnetorquer", "dipole", "A m^2"
    axis: Vector3
    frame: str | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set("axis", unit_vector("magnetorquer axis", self.axis))

    @property
    def frames(self) -> tuple[str, ...]:
        """Name of the frame on which the torquer is mounted; () for the root frame of the base."""
        if self.frame is None:
            return ()
        return (self.frame,)


KINDS: tuple[type[Input], ...] = (
    BaseTorque,
    BaseForce,
    JointTorque,
    Thruster,
    ReactionWheel,
    Magnetorquer,
)


def has_magnetorquers(inputs: Iterable[Input]) -> bool:
    """Return whether an input is a magnetorquer, so that the dynamics depend on time."""
    return any(isinstance(item, Magnetorquer) for item in inputs)


def three_numbers(what: str, value: object) -> tuple[float, float, float]:
    """Return three finite floats; raise `InputError` if the value is anything else."""
    try:
        x, y, z = (number(what, entry) for entry in cast("Iterable[object]", value))
    except (TypeError, ValueError):
        raise InputError(
            f"{what} is {value!r}, expected three finite numbers"
        ) from None
    return x, y, z


def unit_vector(what: str, value: object) -> tuple[float, float, float]:
    """Return a vector (3,) scaled to length 1; raise `InputError` if its length is zero."""
    x, y, z = three_numbers(what, value)
    length = math.hypot(x, y, z)
    if length == 0.0:
        raise InputError(f"{what} is zero; give a direction")
    return x / length, y / length, z / length


def named_inputs(inputs: Sequence[Input]) -> list[tuple[Input, tuple[str, ...]]]:
    """Return each input with the names of its entries in u, as (input, names).

    The default names are thruster_1, ..., wheel_1, ... and magnetorquer_1, ...
    """
    seen: Counter[str] = Counter()
    named = []
    for item in inputs:
        seen[item.GROUP] += 1
        if isinstance(item, Thruster | ReactionWheel | Magnetorquer):
            names = [item.name or f"{item.KEY.rpartition('_')[2]}_{seen[item.GROUP]}"]
        else:
            entries = [item.joint] if isinstance(item, JointTorque) else item.ENTRIES
            names = [f"{item.GROUP}.{entry}" for entry in entries]
        named.append((item, tuple(names)))
    return named


def lags_of(named: Iterable[tuple[Input, tuple[str, ...]]]) -> tuple[float, ...]:
    """Return the time constant [s] of each entry of u; 0 for an input without a lag.

    `named` contains each input with the names of its entries, as `named_inputs` returns them.
    """
    return tuple(item.lag or 0.0 for item, names in named for _ in names)


def named_wheels(inputs: Sequence[Input]) -> list[tuple[str, ReactionWheel]]:
    """Return (name, wheel) for each wheel among the inputs, with names as in `named_inputs`."""
    named = named_inputs(inputs)
    return [
        (names[0], item) for item, names in named if isinstance(item, ReactionWheel)
    ]
