"""Outputs y of the linear model: measured quantities of a robot, in any combination and order.

Reference axes are the axes of the reference placement. The state is relative to this placement. The
module `fflin.dynamics.outputs` computes the outputs and their derivatives.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import ClassVar, TypeAlias

from fflin.base.errors import InputError, require_known
from fflin.base.shown import shown_fields
from fflin.base.validation import number, positive
from fflin.robot.sensor_figures import BIAS_FIGURES, NOISE_FIGURES, checked_figure

# Standard deviation, or one figure of a data sheet such as {"angle_random_walk": 0.1}.
SensorError: TypeAlias = float | Mapping[str, float]


@dataclass(frozen=True, repr=False)
class Output:
    """Base class of outputs, with their names, units and properties of the sensor.

    Every output accepts these arguments, keyword only:

    - `sample` [s]: the sensor measures at t = 0, `sample`, 2 `sample`, ...; by default at each
      sample of the control law.
    - `delay` [s]: time from a measurement until the law receives it.
    - `lag` [s]: time constant T of the sensor, whose value y_s follows
      ``d(y_s)/dt = (y - y_s) / T``.
    - `noise`: standard deviation of the noise of each sample, in the unit of the output, or a
      figure of a data sheet as in `kalman`, such as ``{"angle_random_walk": 0.1}``.
    - `bias`: standard deviation of the change of the bias within 1 s, in the unit of the output, or
      a figure of a data sheet, such as ``{"bias_instability": 1.0}``.

    Simulations contain `sample`, `delay` and `lag`. Sampled laws that measure outputs also receive
    the noise and the bias, see `noise` of `simulate`. `kalman` uses `sample`, `delay`, `noise` and
    `bias`. `LinearModel.with_lags` adds the lags to a model.
    """

    # Name on the command line.
    WORD: ClassVar[str]
    # (name, unit) of each measured vector (3,); empty if the components of the output are states.
    VECTORS: ClassVar[tuple[tuple[str, str], ...]] = ()
    # Units of the components if they are states; empty if the units depend on the robot.
    UNITS: ClassVar[tuple[str, ...]] = ()
    # Whether the output depends on accelerations, and therefore on the inputs.
    FEELS_ACCELERATION: ClassVar[bool] = False

    sample: float | None = field(default=None, kw_only=True, repr=False)
    delay: float = field(default=0.0, kw_only=True, repr=False)
    lag: float | None = field(default=None, kw_only=True, repr=False)
    # Mappings have no hash.
    noise: SensorError | None = field(
        default=None, kw_only=True, repr=False, hash=False
    )
    bias: SensorError | None = field(default=None, kw_only=True, repr=False, hash=False)

    def __repr__(self) -> str:
        return shown_fields(self)

    def __post_init__(self) -> None:
        for name in ("sample", "lag"):
            if (value := getattr(self, name)) is not None:
                time = positive(f"{name} of {self.WORD}", value, "s")
                object.__setattr__(self, name, time)
        delay = number(f"delay of {self.WORD}", self.delay)
        if delay < 0.0:
            raise InputError(
                f"delay of {self.WORD} is {delay:g} s, expected at least 0"
            )
        object.__setattr__(self, "delay", delay)
        for name, figures in (("noise", NOISE_FIGURES), ("bias", BIAS_FIGURES)):
            value = getattr(self, name)
            if value is None:
                continue
            if isinstance(value, Mapping):
                units = [unit for _, unit in self.VECTORS] or self.UNITS
                checked_figure(f"'{name}' of {self.WORD}", value, units, figures)
                object.__setattr__(self, name, dict(value))
            else:
                given = positive(f"{name} of {self.WORD}", value)
                object.__setattr__(self, name, given)

    @property
    def sensor(self) -> str:
        """Properties of the sensor that are given, such as "sample 0.25 s, delay 0.2 s"."""
        times = {"sample": self.sample, "delay": self.delay, "lag": self.lag}
        parts = [f"{name} {time:g} s" for name, time in times.items() if time]
        for name in ("noise", "bias"):
            value = getattr(self, name)
            if isinstance(value, Mapping):
                figures = (f"{key} {size:g}" for key, size in value.items())
                parts.append(f"{name} {', '.join(figures)}")
            elif value is not None:
                parts.append(f"{name} {value:g}")
        return ", ".join(parts)

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the model's frames that the output depends on."""
        return tuple(
            getattr(self, name) for name in ("frame", "to") if hasattr(self, name)
        )

    @property
    def signals(self) -> list[tuple[str, str]]:
        """List with (name, unit) of each component; empty if the components are states."""
        prefix = "/".join(self.frames)
        if self.frames:
            prefix += "."
        return [
            (f"{prefix}{name}.{axis}", unit)
            for name, unit in self.VECTORS
            for axis in "xyz"
        ]


@dataclass(frozen=True, repr=False)
class FrameOutput(Output):
    """Base class of outputs that depend on one or two frames on the base or on links."""

    frame: str


class FullState(Output):
    """Output of all states, with the same names, order and axes as in the state vector.

    Examples
    --------
    >>> robot = fflin.load("cubesat")
    >>> robot.outputs
    (FullState(),)
    >>> fflin.linearize(robot).C.shape
    (12, 12)
    """

    WORD = "state"


class BasePose(Output):
    """Output of the base pose, as in the state: attitude q_b (3,) [1] and position r_b (3,) [m].

    Examples
    --------
    >>> robot = fflin.load("cubesat", outputs=[fflin.BasePose()])
    >>> fflin.linearize(robot).output_names[:2]
    ('q_b.x', 'q_b.y')
    """

    WORD = "base"
    UNITS = "1", "m"


def _names(field: str, value: object, example: str) -> tuple[str, ...]:
    """Return a field as a tuple of names; a single name is a tuple of one."""
    names = [value] if isinstance(value, str) else value
    if isinstance(names, Sequence) and all(isinstance(name, str) for name in names):
        return tuple(names)
    raise InputError(f'{field} is {value!r}, expected names such as ["{example}"]')


@dataclass(frozen=True, repr=False)
class JointOutput(Output):
    """Base class of joint outputs, for chosen joints or by default for all joints."""

    joints: str | tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.joints is not None:
            object.__setattr__(self, "joints", _names("joints", self.joints, "wheel_*"))


class JointPositions(JointOutput):
    """Output of joint positions: angles [rad] or lengths [m].

    Parameters
    ----------
    joints : str or tuple of str, optional
        Names of independent joints, or patterns, in the order of the outputs. The default is all
        independent joints in state order.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.JointPositions()])
    >>> fflin.linearize(robot).output_names
    ('q_m.joint_1', 'q_m.joint_2', 'q_m.joint_3')
    """

    WORD = "joints"


class JointVelocities(JointOutput):
    """Output of joint velocities: angular [rad/s] or linear [m/s].

    Parameters
    ----------
    joints : str or tuple of str, optional
        Names of independent joints, or patterns, in the order of the outputs. The default is all
        independent joints in state order.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.JointVelocities()])
    >>> fflin.linearize(robot).output_units
    ('rad/s', 'rad/s', 'rad/s')
    """

    WORD = "rates"


class FramePose(FrameOutput):
    """Output of the pose of a frame, on the base or on any link.

    - Position (3,) [m] of the frame's origin relative to the reference, in reference axes.
    - Rotation vector (3,) [rad], log(R*^T R), in the frame's own axes. R is the frame's attitude,
      and R* is its attitude at the operating point. At this point, the rotation vector is zero.

    Parameters
    ----------
    frame : str
        Name of the measured frame.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.FramePose("hand")])
    >>> fflin.linearize(robot).output_names[:2]
    ('hand.position.x', 'hand.position.y')
    """

    WORD = "pose"
    VECTORS = (("position", "m"), ("rotation", "rad"))


class FrameVelocity(FrameOutput):
    """Output of the velocity of a frame, in the same axes as the "hybrid" base velocity.

    - Angular velocity (3,) [rad/s], in the frame's own axes.
    - Velocity (3,) [m/s] of the frame's origin, in reference axes.

    At the operating point, these outputs are the time derivatives of the `FramePose` outputs. The
    axes do not depend on the `frame` that is chosen for the base velocities in the state.

    Parameters
    ----------
    frame : str
        Name of the measured frame.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.FrameVelocity("hand")])
    >>> fflin.linearize(robot).output_names[:2]
    ('hand.angular_velocity.x', 'hand.angular_velocity.y')
    """

    WORD = "velocity"
    VECTORS = (("angular_velocity", "rad/s"), ("velocity", "m/s"))


@dataclass(frozen=True, repr=False)
class RelativePose(FrameOutput):
    """Output of the pose of one frame relative to another, independent of the base pose.

    - Position (3,) [m] of the origin of `frame` relative to the origin of `to`, in the axes of
      `to`.
    - Rotation vector (3,) [rad], log(R*^T R), in the axes of `frame`. R is the attitude of `frame`
      relative to `to`, and R* is this attitude at the operating point. At this point, the rotation
      vector is zero.

    Parameters
    ----------
    frame : str
        Name of the measured frame.
    to : str
        Name of the frame relative to which the pose of `frame` is measured.

    Examples
    --------
    >>> robot = fflin.load("servicer_7dof", outputs=[fflin.RelativePose("tool", "panel_left")])
    >>> len(fflin.linearize(robot).y0)
    6
    """

    WORD = "relative"
    VECTORS = (("position", "m"), ("rotation", "rad"))
    to: str


class CenterOfMass(Output):
    """Output of the centre of mass: position (3,) [m] in the axes of the reference.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.CenterOfMass()])
    >>> fflin.linearize(robot).output_names
    ('com.x', 'com.y', 'com.z')
    """

    WORD = "com"
    VECTORS = (("com", "m"),)


class Momentum(Output):
    """Output of the momentum of the whole robot, in reference axes.

    - Angular momentum (3,) [N m s] about the centre of mass, including all wheels.
    - Linear momentum (3,) [N s].

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.Momentum()])
    >>> fflin.linearize(robot).output_units
    ('N m s', 'N m s', 'N m s', 'N s', 'N s', 'N s')
    """

    WORD = "momentum"
    VECTORS = (("momentum.angular", "N m s"), ("momentum.linear", "N s"))


class StarTracker(Output):
    """Output of a star tracker: attitude q_b (3,) [1] of the base, as in the state.

    Parameters
    ----------
    sample : float, optional
        Time [s] between two measurements; by default, the sensor measures at each sample of the
        law. The first measurement is at t = 0. These and all following parameters are keyword only.
    delay : float
        Time [s] from a measurement until the law receives it.
    lag : float, optional
        Time constant [s] of the sensor.
    noise : float or mapping, optional
        Standard deviation of each measurement, in parts of a quaternion, or
        ``{"noise_equivalent_angle": x}`` with the standard deviation x of an angle in arc seconds.
    bias : float, optional
        Standard deviation of the change of the bias within 1 s.

    Examples
    --------
    >>> tracker = fflin.StarTracker(
    ...     sample=0.25, delay=0.2, noise={"noise_equivalent_angle": 10.0}
    ... )
    >>> robot = fflin.load("cubesat", outputs=[tracker])
    >>> fflin.linearize(robot).output_names
    ('q_b.x', 'q_b.y', 'q_b.z')
    """

    WORD = "star_tracker"
    UNITS = ("1",)


class Gyroscope(FrameOutput):
    """Output of a gyroscope: angular velocity (3,) [rad/s] of a frame, in the frame's own axes.

    Parameters
    ----------
    frame : str
        Frame in which the sensor is mounted.
    sample : float, optional
        Time [s] between two measurements, as for `StarTracker`. These and all following parameters
        are keyword only. Every output accepts them.
    delay : float
        Time [s] from a measurement until the law receives it.
    lag : float, optional
        Time constant [s] of the sensor.
    noise : float or mapping, optional
        Standard deviation of each measurement [rad/s], or ``{"angle_random_walk": x}`` with x in
        deg/sqrt(h).
    bias : float or mapping, optional
        Standard deviation of the change of the bias within 1 s [rad/s], or
        ``{"bias_instability": x}`` with x in deg/h, or ``{"rate_random_walk": x}`` with x in
        deg/h/sqrt(h). `kalman` then estimates the bias.

    Examples
    --------
    >>> robot = fflin.load("cubesat", outputs=[fflin.Gyroscope("base")])
    >>> fflin.linearize(robot).output_units
    ('rad/s', 'rad/s', 'rad/s')
    """

    WORD = "gyroscope"
    VECTORS = (("gyroscope", "rad/s"),)


class Accelerometer(FrameOutput):
    """Output of an accelerometer: specific force (3,) [m/s^2] at a frame, in the frame's own axes.

    The specific force is the acceleration of the frame's origin minus the gravitational
    acceleration. It is zero in free fall without rotation and thrust. At rest under gravity, it is
    directed upwards with the magnitude g.

    Parameters
    ----------
    frame : str
        Frame in which the sensor is mounted.

    Examples
    --------
    >>> robot = fflin.load("cubesat", outputs=[fflin.Accelerometer("base")])
    >>> bool(fflin.linearize(robot).D.any())
    True
    """

    WORD = "accelerometer"
    VECTORS = (("acceleration", "m/s^2"),)
    FEELS_ACCELERATION = True


# Units {component: unit} of the wrench of a constraint.
FORCES = {
    f"{vector}.{axis}": unit
    for vector, unit in (("force", "N"), ("torque", "N m"))
    for axis in "xyz"
}


@dataclass(frozen=True, repr=False)
class ConstraintForce(Output):
    """Output of the force and torque that a constraint exerts on its `frame`, at its origin.

    The opposite wrench acts on the frame `to`. The axes are fixed to `to`, and are parallel to
    the axes of `frame` at its `placement`.

    - Force (3,) [N].
    - Torque (3,) [N m]. The torque of a `Spherical` is zero, and so is the torque of a `Hinge`
      about its axis.

    If constraints are redundant, some components are not determinate, because they depend on
    internal stresses. `linearize` refuses these components.

    Parameters
    ----------
    name : str
        Name of the constraint.
    components : str or tuple of str, optional
        Components, such as ``("force.x", "torque.z")``; all six by default.

    Examples
    --------
    >>> robot = fflin.load("cubesat", constraints=[fflin.Weld("base", name="clamp")])
    >>> lin = fflin.linearize(robot.replace(outputs=[fflin.ConstraintForce("clamp")]))
    >>> lin.output_names[0], bool(lin.D.any())
    ('clamp.force.x', True)
    """

    WORD = "force"
    FEELS_ACCELERATION = True

    name: str
    components: str | tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.components is not None:
            names = _names("components", self.components, "force.x")
            object.__setattr__(self, "components", names)
        require_known("component of a constraint force", self.chosen, FORCES)

    @property
    def chosen(self) -> tuple[str, ...]:
        """Names of the components, such as force.x."""
        if self.components is None:
            return tuple(FORCES)
        return _names("components", self.components, "force.x")

    @property
    def signals(self) -> list[tuple[str, str]]:
        """List with (name, unit) of each component."""
        return [(f"{self.name}.{item}", FORCES[item]) for item in self.chosen]


# The command line lists the outputs in this order.
KINDS: tuple[type[Output], ...] = (
    *(FullState, BasePose, StarTracker, JointPositions, JointVelocities),
    *(CenterOfMass, Momentum),
    *(FramePose, FrameVelocity, RelativePose, Gyroscope, Accelerometer),
    ConstraintForce,
)


def parse_output(text: str) -> tuple[Output, ...]:
    """Parse outputs from a text such as WORD, joints:NAME, pose:NAME or relative:NAME:TO.

    The text frame:NAME stands for the pose and the velocity of a frame.
    """
    word, colon, rest = text.partition(":")
    kinds = {kind.WORD: (kind,) for kind in KINDS} | {
        "frame": (FramePose, FrameVelocity)
    }
    require_known("output", [word], kinds)
    kind = kinds[word][0]
    if rest and issubclass(kind, JointOutput):
        return (kind((rest,)),)
    wanted = (
        [item.name for item in fields(kind) if not item.kw_only]
        if issubclass(kind, FrameOutput)
        else []
    )
    if kind is ConstraintForce:
        wanted = ["name"]
    names = rest.split(":", len(wanted) - 1) if colon else []
    if len(names) != len(wanted) or not all(names):
        places = ("NAME", *(name.upper() for name in wanted[1:]))
        form = ":".join((word, *places[: len(wanted)]))
        raise InputError(f"output '{text}' has too few or too many names; write {form}")
    return tuple(kind(*names) for kind in kinds[word])
