"""What is watched of a robot: the outputs y of the linear model, in any mix and order.

Reference axes are those of the reference placement that the state is relative to. What a kind
measures, and its slopes, stand in `fflin.dynamics.output_kinds`.
"""

from dataclasses import dataclass, fields
from typing import ClassVar

from fflin.base.errors import InputError, unknown


@dataclass(frozen=True)
class Output:
    """What every kind of output says of itself."""

    # What it is called on a command line.
    WORD: ClassVar[str]
    # (name, unit) of each vector of three that it measures; empty where it is of states.
    VECTORS: ClassVar[tuple[tuple[str, str], ...]] = ()
    # Whether it depends on the accelerations, and so on the inputs.
    FEELS_ACCELERATION: ClassVar[bool] = False

    @property
    def frames(self) -> tuple[str, ...]:
        """The frames of the model that it measures, or measures from."""
        return ()

    @property
    def signals(self) -> list[tuple[str, str]]:
        """(name, unit) of each component, without those that are states."""
        prefix = "/".join(self.frames) + "." * bool(self.frames)
        return [(f"{prefix}{name}.{axis}", unit) for name, unit in self.VECTORS for axis in "xyz"]


@dataclass(frozen=True)
class FrameOutput(Output):
    """An output of frames of the model, on the base or on any link: its fields name them."""

    frame: str

    @property
    def frames(self) -> tuple[str, ...]:
        """The frames of the model that it measures, or measures from."""
        return tuple(getattr(self, item.name) for item in fields(self))


class FullState(Output):
    """Every state, under its own name, in the order and axes of the state.

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
    """Attitude q_b (3) [1] and position r_b (3) [m] of the base, the states.

    Examples
    --------
    >>> robot = fflin.load("cubesat", outputs=[fflin.BasePose()])
    >>> fflin.linearize(robot).output_names[:2]
    ('q_b.x', 'q_b.y')
    """

    WORD = "base"


@dataclass(frozen=True)
class JointOutput(Output):
    """An output of joints: all of them where none is named."""

    joints: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        # A string is a sequence of names of one letter each.
        if isinstance(self.joints, str):
            given = repr(self.joints)
            raise InputError(f"joints is {given}, expected a tuple of names, ({given},)")


class JointPositions(JointOutput):
    """Angles [rad] or lengths [m] of joints, the states.

    Parameters
    ----------
    joints : tuple of str, optional
        Independent joints, or patterns, in the order wanted; all of them, in state order, by
        default.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.JointPositions()])
    >>> fflin.linearize(robot).output_names
    ('q_m.joint_1', 'q_m.joint_2', 'q_m.joint_3')
    """

    WORD = "joints"


class JointVelocities(JointOutput):
    """Rates [rad/s] or [m/s] of joints, the states.

    Parameters
    ----------
    joints : tuple of str, optional
        Independent joints, or patterns, in the order wanted; all of them, in state order, by
        default.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.JointVelocities()])
    >>> fflin.linearize(robot).output_units
    ('rad/s', 'rad/s', 'rad/s')
    """

    WORD = "rates"


class FramePose(FrameOutput):
    """Pose of a frame of the model, on the base or on any link.

    Position (3) [m] of its origin relative to the reference, in reference axes, and rotation
    vector (3) [rad] from its attitude R* at the point of linearisation, log(R*^T R), in the
    frame's own axes: zero at the point.

    Parameters
    ----------
    frame : str

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.FramePose("hand")])
    >>> fflin.linearize(robot).output_names[:2]
    ('hand.position.x', 'hand.position.y')
    """

    WORD = "pose"
    VECTORS = (("position", "m"), ("rotation", "rad"))


class FrameVelocity(FrameOutput):
    """Velocity of a frame of the model, with the axes of the hybrid velocity of the base.

    Angular velocity (3) [rad/s] in the frame's own axes, and velocity (3) [m/s] of its origin,
    in reference axes: the rates of `FramePose` at the point, whatever the frame of the state.

    Parameters
    ----------
    frame : str

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.FrameVelocity("hand")])
    >>> fflin.linearize(robot).output_names[:2]
    ('hand.angular_velocity.x', 'hand.angular_velocity.y')
    """

    WORD = "velocity"
    VECTORS = (("angular_velocity", "rad/s"), ("velocity", "m/s"))


@dataclass(frozen=True)
class RelativePose(FrameOutput):
    """Pose of a frame as seen from another, wherever the base is.

    Position (3) [m] of its origin from that of the other, in the other's axes, and rotation vector
    (3) [rad] of the relative attitude from that at the point of linearisation, log(R*^T R), in
    the frame's own axes: zero at the point.

    Parameters
    ----------
    frame : str
    to : str
        The frame that sees it.

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
    """Position (3) [m] of the centre of mass relative to the reference, in reference axes.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.CenterOfMass()])
    >>> fflin.linearize(robot).output_names
    ('com.x', 'com.y', 'com.z')
    """

    WORD = "com"
    VECTORS = (("com", "m"),)


class Momentum(Output):
    """Momentum of the whole robot, in reference axes.

    Angular momentum (3) [N m s] about the centre of mass, that of every wheel included, and
    linear momentum (3) [N s].

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.Momentum()])
    >>> fflin.linearize(robot).output_units
    ('N m s', 'N m s', 'N m s', 'N s', 'N s', 'N s')
    """

    WORD = "momentum"
    VECTORS = (("momentum.angular", "N m s"), ("momentum.linear", "N s"))


class Gyroscope(FrameOutput):
    """What a gyroscope measures: angular velocity (3) [rad/s] of a frame, in its own axes.

    Parameters
    ----------
    frame : str

    Examples
    --------
    >>> robot = fflin.load("cubesat", outputs=[fflin.Gyroscope("base")])
    >>> fflin.linearize(robot).output_units
    ('rad/s', 'rad/s', 'rad/s')
    """

    WORD = "gyroscope"
    VECTORS = (("gyroscope", "rad/s"),)


class Accelerometer(FrameOutput):
    """What an accelerometer measures: specific force (3) [m/s^2], in its own axes.

    The acceleration of the frame's origin less gravity: zero in free fall where nothing turns
    or pushes, and +g upwards where it stands still.

    Parameters
    ----------
    frame : str

    Examples
    --------
    >>> robot = fflin.load("cubesat", outputs=[fflin.Accelerometer("base")])
    >>> bool(fflin.linearize(robot).D.any())
    True
    """

    WORD = "accelerometer"
    VECTORS = (("acceleration", "m/s^2"),)
    FEELS_ACCELERATION = True


# In the order in which a command line lists them.
KINDS: tuple[type[Output], ...] = (
    *(FullState, BasePose, JointPositions, JointVelocities, CenterOfMass, Momentum),
    *(FramePose, FrameVelocity, RelativePose, Gyroscope, Accelerometer),
)


def parse_output(text: str) -> tuple[Output, ...]:
    """Read outputs as a command line has them: WORD, joints:NAME, pose:NAME, relative:NAME:TO."""
    word, colon, rest = text.partition(":")
    kinds = {kind.WORD: (kind,) for kind in KINDS} | {"frame": (FramePose, FrameVelocity)}
    if word not in kinds:
        raise unknown("output", word, tuple(kinds))
    kind = kinds[word][0]
    if rest and issubclass(kind, JointOutput):
        return (kind((rest,)),)
    if not issubclass(kind, FrameOutput):
        if colon:
            raise InputError(f"output '{text}' is of the whole robot; write {word}")
        return (kind(),)
    wanted = [item.name for item in fields(kind)]
    names = rest.split(":", len(wanted) - 1)
    if len(names) != len(wanted) or not all(names):
        form = ":".join((word, "NAME", *(name.upper() for name in wanted[1:])))
        missing = "no frame" if len(wanted) == 1 else "fewer than two frames"
        raise InputError(f"output '{text}' is of {missing}; write {form}")
    return tuple(kind(*names) for kind in kinds[word])
