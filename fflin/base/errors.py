"""Errors that fflin raises; each message says what was given, what was expected, what to do."""

import re
from collections.abc import Iterable
from typing import Any

# Characters that end a line or command the terminal, names that are too long to be read, and how
# long a message may be. A part of a path is such a name, the path is not.
_CONTROL, _LONG_NAME = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029]"), re.compile(r"[^\s/\\]{100,}")
_LONGEST = 1000
# The line break of a message of another package that goes on with an indented line.
_INDENTED = re.compile(r"[ \t]*\r?\n[ \t]+")


def one_line(text: str) -> str:
    """Return a message in one line: what a name holds is escaped, and what is too long is cut."""
    text = _INDENTED.sub(" ", text)
    text = _CONTROL.sub(lambda found: repr(found[0])[1:-1], text)
    text = _LONG_NAME.sub(lambda found: _cut(found[0], 60), text)
    return text if len(text) <= _LONGEST else _cut(text, _LONGEST)


def _cut(text: str, size: int) -> str:
    """Return both ends of a text, about `size` characters."""
    return f"{text[: 2 * size // 3]}...{text[-size // 3 :]}"


class FflinError(Exception):
    """Base of every error that a public call of fflin raises on purpose; reads as one line.

    Examples
    --------
    >>> try:
    ...     fflin.load("ets_vi")
    ... except fflin.FflinError as error:
    ...     print(error)
    no robot named 'ets_vi'; did you mean ets_vii?
    """

    def __str__(self) -> str:
        return one_line(super().__str__())


class InputError(FflinError, ValueError):
    """An argument has a wrong size, type or value.

    Examples
    --------
    >>> fflin.linearize(fflin.load("cubesat"), q=[0.0])
    Traceback (most recent call last):
        ...
    fflin.base.errors.InputError: q has shape (1,), expected (7,): a configuration in ...
    """


class UnknownNameError(FflinError, LookupError):
    """A robot, joint or frame of that name does not exist.

    Examples
    --------
    >>> fflin.configuration(fflin.load("planar_detumble"), {"joint_9": 0.1})
    Traceback (most recent call last):
        ...
    fflin.base.errors.UnknownNameError: no joint named 'joint_9'; did you mean joint_3, ...
    """


class FileError(FflinError, OSError):
    """A file cannot be read or written.

    Examples
    --------
    >>> fflin.load("none.urdf")
    Traceback (most recent call last):
        ...
    fflin.base.errors.FileError: no file at 'none.urdf'; give a URDF's path or a name of `fflin ...
    """


class UrdfError(FflinError, ValueError):
    """A robot description is malformed or describes what cannot exist.

    Examples
    --------
    >>> from pathlib import Path
    >>> _ = Path("empty.urdf").write_text("<robot name='empty'/>")
    >>> fflin.load("empty.urdf")
    Traceback (most recent call last):
        ...
    fflin.base.errors.UrdfError: empty.urdf:1: <robot> has no <link>; add one
    """


class ModelError(FflinError, ValueError):
    """A model is not one free-flying tree of one-degree-of-freedom joints.

    Examples
    --------
    >>> import pinocchio as pin
    >>> fflin.from_model(pin.buildSampleModelManipulator())
    Traceback (most recent call last):
        ...
    fflin.base.errors.ModelError: 'model': the root joint is JointModelRX, expected ...
    """


class SingularInertiaError(FflinError, ArithmeticError):
    """The joint-space inertia matrix cannot be inverted.

    Examples
    --------
    >>> fflin.linearize(fflin.load("romeo"))
    Traceback (most recent call last):
        ...
    fflin.base.errors.SingularInertiaError: M of 'romeo' cannot be inverted at any ...
    """


class ChartError(FflinError, ValueError):
    """The base is turned by pi from the reference, where the attitude chart ends.

    Examples
    --------
    >>> import pinocchio as pin
    >>> robot = fflin.load("cubesat")
    >>> turned = pin.SE3(pin.rpy.rpyToMatrix(np.pi, 0.0, 0.0), np.zeros(3))
    >>> q = fflin.configuration(robot, base=turned)
    >>> fflin.linearize(robot, q, reference=pin.SE3.Identity())
    Traceback (most recent call last):
        ...
    fflin.base.errors.ChartError: the base is turned by 180 deg from the reference, where the ...
    """


class EquilibriumError(FflinError, ValueError):
    """A point is no fixed point where one is needed, or no input makes it one.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", gravity=(0, 0, -9.81))
    >>> fflin.lqr(fflin.linearize(robot))
    Traceback (most recent call last):
        ...
    fflin.base.errors.EquilibriumError: the point is not a fixed point: d v_b.z/dt = -9.81; ...
    """


class StabilizabilityError(FflinError, ValueError):
    """The inputs cannot hold what does not settle by itself.

    Attributes
    ----------
    margin : Margin or None
        Distance from doubt of the decisions behind it; None where they were not made.

    Examples
    --------
    >>> robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()])
    >>> fflin.lqr(fflin.linearize(robot))
    Traceback (most recent call last):
        ...
    fflin.base.errors.StabilizabilityError: the inputs cannot stabilise base position (linear ...
    """

    margin: Any = None


class DetectabilityError(FflinError, ValueError):
    """The outputs do not show what does not settle by itself.

    Attributes
    ----------
    margin : Margin or None
        Distance from doubt of the decisions behind it; None where they were not made.

    Examples
    --------
    >>> robot = fflin.load("cubesat", outputs=[fflin.Gyroscope("base")])
    >>> lin = fflin.linearize(robot)
    >>> fflin.kalman(lin, 1e-3, 1e-4)
    Traceback (most recent call last):
        ...
    fflin.base.errors.DetectabilityError: the outputs do not observe r_b.x, r_b.y, r_b.z ...
    """

    margin: Any = None


class MissingPackageError(FflinError, ImportError):
    """An optional package is needed and not installed.

    Examples
    --------
    >>> issubclass(fflin.MissingPackageError, ImportError)
    True
    """


class SweepError(FflinError, RuntimeError):
    """Some chunks of a sweep have no result.

    Attributes
    ----------
    failed : tuple
        (start, stop, reason) of each: its points, stop not among them.
    batch : LinearBatch or None
        The others, in order, where they are in memory.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> points = np.tile(robot.neutral(), (3, 1))
    >>> try:
    ...     batch = fflin.sweep(robot, points)
    ... except fflin.SweepError as error:
    ...     batch = error.batch  # of the chunks that went well
    >>> len(batch)
    3
    """

    def __init__(
        self, message: str, failed: tuple[tuple[int, int, str], ...] = (), batch: Any = None
    ) -> None:
        super().__init__(message)
        self.failed, self.batch = failed, batch


class FflinWarning(UserWarning):
    """Something about a robot that its user should know and that is no error.

    Examples
    --------
    >>> import warnings
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", fflin.FflinWarning)  # a doubtful URDF is refused
    ...     robot = fflin.load("cubesat")
    """

    def __str__(self) -> str:
        return one_line(super().__str__())


def listed(names: Iterable[str]) -> str:
    """Show names in a sentence: the first six, each once, and how many more there are."""
    names = list(dict.fromkeys(names))
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


def _visible(name: str) -> str:
    """Quote a name whose blanks at an end would not be seen."""
    return name if name == name.strip() else repr(name)


def unknown(kind: str, name: str, known: Iterable[str]) -> UnknownNameError:
    """Build the error for a name that does not exist, with the names that are near."""
    import difflib

    names = list(known)
    near = difflib.get_close_matches(str(name), names, n=5, cutoff=0.5)
    if near:
        hint = f"did you mean {', '.join(map(_visible, near))}?"
    elif not names:
        hint = "there are none"
    else:
        hint = f"there are: {', '.join(map(_visible, names[:12]))}"
        hint += f", ... ({len(names)} in all)" if len(names) > 12 else ""
    return UnknownNameError(f"no {kind} named '{name}'; {hint}")
