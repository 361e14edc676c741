"""Errors that fflin raises; each message gives the value, what is expected, and what to do."""

import re
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType

# _CONTROL matches control characters, which could break a line or control the terminal, and lone
# surrogates, which no encoding can print. Python reads a byte of a path that is not UTF-8 as a
# surrogate.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
# _LONG_NAME matches names that are too long to read; each part of a path counts as a name. _LONGEST
# is the largest length of a message.
_LONG_NAME = re.compile(r"[^\s/\\]{100,}")
_LONGEST = 1000
# Matches a line break before an indented line. Messages of other packages contain such line breaks.
_INDENTED = re.compile(r"[ \t]*\r?\n[ \t]+")


def one_line(text: str) -> str:
    """Return a message as one line: escape control characters and cut long text."""
    text = _INDENTED.sub(" ", text)
    text = _CONTROL.sub(lambda match: repr(match[0])[1:-1], text)
    text = _LONG_NAME.sub(lambda match: _cut(match[0], 60), text)
    if len(text) <= _LONGEST:
        return text
    return _cut(text, _LONGEST)


def _cut(text: str, size: int) -> str:
    """Shorten a text to its two ends, with about `size` characters in all."""
    return f"{text[: 2 * size // 3]}...{text[-size // 3 :]}"


class FflinError(Exception):
    """Base class of all errors that fflin defines. Each message is one line.

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
    """Error for an argument of the wrong size, type or value.

    Examples
    --------
    >>> fflin.linearize(fflin.load("cubesat"), q=[0.0])
    Traceback (most recent call last):
        ...
    fflin.base.errors.InputError: q has shape (1,), expected (7,): a configuration in ...
    """


class UnknownNameError(FflinError, LookupError):
    """Error for an unknown name, for example of a robot, joint or frame.

    Examples
    --------
    >>> fflin.configuration(fflin.load("planar_detumble"), {"joint_9": 0.1})
    Traceback (most recent call last):
        ...
    fflin.base.errors.UnknownNameError: no joint named 'joint_9'; did you mean joint_3, ...
    """


class FileError(FflinError, OSError):
    """Error for a file that cannot be read or written.

    Examples
    --------
    >>> fflin.load("none.urdf")
    Traceback (most recent call last):
        ...
    fflin.base.errors.FileError: no file at 'none.urdf' in the folder ...
    """


class UrdfError(FflinError, ValueError):
    """Error for a robot description that is malformed or physically impossible.

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
    """Error for a Pinocchio model that fflin cannot use.

    The model must be a single tree of one-degree-of-freedom joints on a free-flyer root joint. It
    must not be modified after the robot was created.

    Examples
    --------
    >>> import pinocchio as pin
    >>> fflin.from_model(pin.buildSampleModelManipulator())
    Traceback (most recent call last):
        ...
    fflin.base.errors.ModelError: 'model': the root joint is JointModelRX, expected ...
    """


class SingularInertiaError(FflinError, ArithmeticError):
    """Error for a joint-space inertia matrix that cannot be inverted.

    Examples
    --------
    >>> fflin.linearize(fflin.load("romeo"))
    Traceback (most recent call last):
        ...
    fflin.base.errors.SingularInertiaError: the mass matrix of 'romeo' is singular ...
    """


class ChartError(FflinError, ValueError):
    """Error for a base attitude 180 deg from the reference, where the attitude chart is singular.

    Examples
    --------
    >>> import pinocchio as pin
    >>> robot = fflin.load("cubesat")
    >>> turned = pin.SE3(pin.rpy.rpyToMatrix(np.pi, 0.0, 0.0), np.zeros(3))
    >>> q = fflin.configuration(robot, base=turned)
    >>> fflin.linearize(robot, q, reference=pin.SE3.Identity())
    Traceback (most recent call last):
        ...
    fflin.base.errors.ChartError: the base is rotated by 180 deg from the reference, where the ...
    """


class EquilibriumError(FflinError, ValueError):
    """Error for an operating point that is not an equilibrium, or where no inputs hold the robot.

    Examples
    --------
    >>> inputs = [fflin.BaseTorque(), fflin.JointTorque("*")]
    >>> robot = fflin.load("planar_detumble", gravity=(0, 0, -9.81), inputs=inputs)
    >>> fflin.lqr(fflin.linearize(robot))
    Traceback (most recent call last):
        ...
    fflin.base.errors.EquilibriumError: the point is not a fixed point: d v_b.z/dt = -9.81; ...
    """


class ConstraintError(FflinError, ValueError):
    """Error for a configuration or velocity that the constraints of a robot do not permit.

    Examples
    --------
    >>> import pinocchio as pin
    >>> held = fflin.Weld("base", placement=pin.SE3.Identity())
    >>> robot = fflin.load("cubesat", constraints=[held])
    >>> fflin.linearize(robot, fflin.configuration(robot, rpy=(5, 0, 0)))
    Traceback (most recent call last):
        ...
    fflin.base.errors.ConstraintError: q is off constraint 'base' by 0.0873 rad; close it ...
    """


class StabilizabilityError(FflinError, ValueError):
    """Error for modes that neither decay by themselves nor can be controlled by the inputs.

    Attributes
    ----------
    margin : Margin or None
        Certainty of the rank decisions that led to the error; None if no rank decision was needed.

    Examples
    --------
    >>> robot = fflin.load("cubesat", inputs=[fflin.BaseForce()])
    >>> fflin.lqr(fflin.linearize(robot))
    Traceback (most recent call last):
        ...
    fflin.base.errors.StabilizabilityError: the inputs cannot stabilise angular momentum ...
    """

    margin: object = None


class DetectabilityError(FflinError, ValueError):
    """Error for modes that neither decay by themselves nor can be observed from the outputs.

    Attributes
    ----------
    margin : Margin or None
        Certainty of the rank decisions that led to the error; None if no rank decision was needed.

    Examples
    --------
    >>> robot = fflin.load("cubesat", outputs=[fflin.Gyroscope("base")])
    >>> lin = fflin.linearize(robot)
    >>> fflin.kalman(lin, 1e-3, 1e-4)
    Traceback (most recent call last):
        ...
    fflin.base.errors.DetectabilityError: the outputs do not observe q_b.x, q_b.y, q_b.z, ...
    """

    margin: object = None


class MissingPackageError(FflinError, ImportError):
    """Error for an optional package that is needed but not installed.

    Examples
    --------
    >>> issubclass(fflin.MissingPackageError, ImportError)
    True
    """


class SweepError(FflinError, RuntimeError):
    """Error for a sweep in which some chunks of points have no result.

    Attributes
    ----------
    failed : tuple
        Tuple (start, stop, reason) for each failed chunk. The chunk contains the points start to
        stop - 1.
    batch : LinearBatch or None
        Results of the other chunks, in order; None if the sweep was written to a file.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> points = np.tile(robot.neutral(), (3, 1))
    >>> try:
    ...     batch = fflin.sweep(robot, points)
    ... except fflin.SweepError as error:
    ...     batch = error.batch  # the chunks that succeeded
    >>> len(batch)
    3
    """

    def __init__(
        self,
        message: str,
        failed: tuple[tuple[int, int, str], ...] = (),
        batch: object = None,
    ) -> None:
        super().__init__(message)
        self.failed, self.batch = failed, batch


class FflinWarning(UserWarning):
    """Warning about a condition that may affect a result but does not prevent it.

    Examples
    --------
    >>> import warnings
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", fflin.FflinWarning)  # a doubtful URDF is refused
    ...     robot = fflin.load("cubesat")
    """

    def __str__(self) -> str:
        return one_line(super().__str__())


@contextmanager
def located(where: str) -> Iterator[None]:
    """Put the text `where` before the message of every fflin error in a ``with`` block."""
    try:
        yield
    except FflinError as error:
        raise type(error)(f"{where}: {error}") from None


def listed(names: Iterable[str]) -> str:
    """Join names for a sentence: give the first six distinct names, and count the others."""
    names = list(dict.fromkeys(names))
    text = ", ".join(names[:6])
    if len(names) > 6:
        text += f" and {len(names) - 6} more"
    return text


def unknown(kind: str, name: str, known: Iterable[str]) -> UnknownNameError:
    """Build the error for an unknown name; its hint lists similar names, or the known names."""
    import difflib

    names = list(known)
    near = [
        known_name for known_name in names if known_name.lower() == str(name).lower()
    ]
    if not near:
        near = difflib.get_close_matches(str(name), names, n=5, cutoff=0.5)
    if near:
        hint = f"did you mean {', '.join(near)}?"
    elif not names:
        hint = "no such names exist"
    else:
        hint = f"known names: {', '.join(names[:12])}"
        if len(names) > 12:
            hint += f", ... ({len(names)} in all)"
    return UnknownNameError(f"no {kind} named '{name}'; {hint}")


def optional_package(name: str, needed: str, extra: str) -> ModuleType:
    """Import an optional package, or raise `MissingPackageError` with the command to install it."""
    try:
        return import_module(name)
    except ImportError:
        message = f"{needed}; install it with: pip install 'fflin[{extra}]'"
        raise MissingPackageError(message) from None


def require_known(kind: str, names: Iterable[str], known: Collection[str]) -> None:
    """Raise `UnknownNameError` for the first unknown name, if any."""
    for name in names:
        # Arrays cannot be compared with names, and lists are not keys.
        if not isinstance(name, str) or name not in known:
            raise unknown(kind, name, known)
