"""Argument checks, which public functions make once at their start, and read-only arrays."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from fflin.base import html
from fflin.base.errors import InputError
from fflin.base.paragraphs import without_first_paragraph

if TYPE_CHECKING:
    from types import ModuleType

    import pinocchio as pin
    from numpy.typing import ArrayLike as ArrayLike
    from numpy.typing import NDArray

    Array = NDArray[np.floating[Any]]
    Complex = NDArray[np.complexfloating[Any]]
    Values = NDArray[np.inexact[Any]]  # real or complex
    Vector = Array  # one-dimensional
    Poles = Values  # one-dimensional
    Open = Array  # may have infinite entries
    Mask = NDArray[np.bool_]
    Indices = NDArray[np.intp]
else:
    # Importing numpy.typing would take a tenth of the start time of the command line.
    ArrayLike = object
    Array = Complex = Values = Vector = Poles = Open = Mask = Indices = np.ndarray

T = TypeVar("T")

# Logs and files often have six decimals. If the length of a quaternion or of a (cos, sin) pair
# differs from 1 by at most this value, the quaternion or pair is normalised. A larger difference
# counts as wrong input. The positions and rates of mimic joints have the same tolerance.
NORM_TOLERANCE = 1e-5

# A joint angle [rad] or rate [rad/s] of more than one rotation, or one rotation per second, may
# have been given in degrees, see `looks_like_degrees`.
ONE_ROTATION = 2.0 * math.pi

# Largest rounding error of the length of a normalised quaternion.
ROUND_OFF = 2.0 * float(np.finfo(float).eps)

NOT_VERIFIED = "not verified: the file has no sha256, so that damage cannot be detected"

# Largest number of things that one call makes, such as samples, robots or points.
MOST = 1_000_000

# Largest magnitude of a physical quantity, so that products of a few quantities do not overflow.
LARGEST = 1e50

# Native double precision. NumPy has only one object for this type, so `is` can replace `==`.
DOUBLE = np.dtype(np.float64)


def vector(name: str, value: object, size: int, of_what: str) -> Array:
    """Return a vector (size,) of finite native floats; a valid array is not copied."""
    # A finite sum shows that every entry is finite. Python's sum is faster than NumPy's for short
    # vectors, and does not warn if it overflows.
    if type(value) is np.ndarray and value.dtype is DOUBLE and value.shape == (size,):
        array: Array = value
        if math.isfinite(sum(array.tolist())):
            return array
    return shaped(name, value, (size,), f": {of_what}")


def shaped(name: str, value: object, shape: tuple[int, ...], hint: str = "") -> Array:
    """Return a new array of finite native floats with the given shape, or raise `InputError`."""
    array = as_double(name, value)
    if array.shape != shape:
        raise InputError(f"{name} has shape {array.shape}, expected {shape}{hint}")
    for at in np.argwhere(~np.isfinite(array))[:1].tolist():
        raise InputError(
            f"{name}{at} is {array[tuple(at)]}; every entry must be finite"
        )
    return array


def number(name: str, value: Any) -> float:
    """Return a finite float, or raise `InputError` that shows the given value."""
    refuse_masked(name, value)
    if isinstance(value, bool | np.bool_ | str):
        raise InputError(f"{name} is {value!r}, expected a number")
    try:
        result = float(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} is {value!r}, expected a number") from None
    if not math.isfinite(result):
        raise InputError(f"{name} is {result}, expected a finite number")
    return result


def positive(name: str, value: object, unit: str = "", hint: str = "") -> float:
    """Return a number above 0, or raise `InputError`."""
    checked = number(name, value)
    if checked <= 0.0:
        shown = f"{checked:g} {unit}".rstrip()
        raise InputError(f"{name} is {shown}, expected more than 0{hint}")
    return checked


def quantity(name: str, value: object, unit: str = "") -> float:
    """Return a number above 0 and up to `LARGEST`, or raise `InputError`."""
    checked = positive(name, value, unit)
    if checked > LARGEST:
        shown = f"{checked:g} {unit}".rstrip()
        raise InputError(f"{name} is {shown}, expected at most {LARGEST:g}")
    return checked


def share(name: str, value: object) -> float:
    """Return a fraction above 0 and below 1, or raise `InputError`."""
    fraction = number(name, value)
    if not 0.0 < fraction < 1.0:
        raise InputError(f"{name} is {fraction:g}, expected a fraction between 0 and 1")
    return fraction


def refuse_masked(name: str, value: object) -> None:
    """Raise `InputError` if an entry is masked, because NumPy may ignore the mask."""
    # Masked arrays can exist only if numpy.ma is loaded.
    ma: ModuleType | None = sys.modules.get("numpy.ma")
    if ma and isinstance(value, ma.MaskedArray) and ma.getmaskarray(value).any():
        raise InputError(
            f"{name} has masked entries; replace the masked entries by numbers"
        )


def instance(
    name: str, value: object, kind: type[T] | tuple[type[T], ...], expected: str
) -> T:
    """Return a value of the expected type, or raise `InputError` that shows the given type."""
    if not isinstance(value, kind):
        raise InputError(f"{name} has type {type(value).__name__}, expected {expected}")
    return value


def function(name: str, value: Callable[..., object], arguments: str) -> None:
    """Raise `InputError` if a callable cannot take `arguments`, such as "(t, q, v)"."""
    from inspect import signature

    try:
        expected = signature(value)
    except (TypeError, ValueError):  # some compiled functions have no signature
        return
    try:
        expected.bind(*arguments.split(","))
    except TypeError:
        raise InputError(
            f"{name} is a function of {expected}, expected a function of {arguments}"
        ) from None


def looks_like_degrees(value: float, least: float, largest: float) -> bool:
    """Return whether an angle [rad] or rate [rad/s] of a joint looks like degrees.

    This is so if its magnitude in radians exceeds `ONE_ROTATION`, it is beyond the limits `least`
    and `largest` of the joint, and in degrees it is neither. So a weight or a limit of 1000 rad,
    which stands for "any value", does not look like degrees. A missing limit of an angle is one
    rotation. A rate without a limit never looks like degrees; its limits are infinite.
    """

    def plausible(angle: float) -> bool:
        return abs(angle) <= ONE_ROTATION or least <= angle <= largest

    return not plausible(value) and plausible(math.radians(value))


def truth(name: str, value: object) -> bool:
    """Return True or False, or raise `InputError` if the value is neither a bool nor an integer."""
    return bool(instance(name, value, (bool, np.bool_, int), "True or False"))


def whole(name: str, value: object, least: int, largest: int = 2**63 - 1) -> int:
    """Return a whole number within limits, or raise `InputError` that shows the given value."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise InputError(
            f"{name} is {value!r}, expected a whole number of at least {least}"
        )
    if not least <= value <= largest:
        bound = f"of at least {least}" if value < least else f"of at most {largest:,}"
        raise InputError(f"{name} is {value}, expected a whole number {bound}")
    return int(value)


def count(name: str, value: object, least: int = 1, largest: int = MOST) -> int:
    """Return the number of objects that a call makes, or raise `InputError`.

    The limit is checked before memory is allocated. If the container of the objects checks its own
    size, call `whole` instead.
    """
    return whole(name, value, least, largest)


def printable(name: str, value: object) -> str:
    """Return a name that files, tables and terminals can show, or raise `InputError`."""
    text = instance(name, value, str, "a string")
    if not text.strip() or not text.isprintable():
        raise InputError(f"{name} is {text!r}, expected a name of printable characters")
    return text


def by_name(name: str, value: object, of_what: str) -> Mapping[str, object]:
    """Return a mapping, or raise `InputError`; in the message, `of_what` is the noun for a key."""
    return instance(name, value, Mapping, f"{{{of_what}: value}}")


def untied(key: str, value: object) -> tuple[object, bool]:
    """Return a range, and whether all names that match `key` share one random value.

    The argument `value` is the range itself, or a mapping {"range": range, "tied": bool}.
    """
    if not isinstance(value, Mapping):
        return value, False
    if value.keys() != {"range", "tied"}:
        raise InputError(
            f"'{key}' is {value!r}, expected {{'range': 0.2, 'tied': True}}"
        )
    return value["range"], truth(f"tied of '{key}'", value["tied"])


def numbers(name: str, value: object, of_what: str, each: str) -> dict[str, float]:
    """Return {name: finite float} from a mapping; `each` is the noun for an entry in messages."""
    values = by_name(name, value, of_what)
    return {key: number(f"{each} '{key}'", entry) for key, entry in values.items()}


def dimension(name: str, value: object) -> int:
    """Return the number of dimensions of an array, or raise `InputError`."""
    return _as_array(name, value).ndim


def normalised(what: str, value: Array) -> Array:
    """Return a vector with length 1, such as a quaternion.

    If the length is 1 to machine precision, the vector is returned unchanged. Raise `InputError` if
    the length differs from 1 by more than `NORM_TOLERANCE`.
    """
    length = math.hypot(*value.tolist())
    error = abs(length - 1.0)
    if not error <= NORM_TOLERANCE:
        raise InputError(f"{what} has length {length:.9g}, expected 1; normalise it")
    if error <= ROUND_OFF:
        return value
    return value / length


def placement(name: str, value: object) -> pin.SE3:
    """Return a copy of a placement with a normalised rotation, or raise `InputError`."""
    import pinocchio as pin

    given = instance(name, value, pin.SE3, "a pin.SE3 (placement)")
    if not np.isfinite(given.homogeneous).all():
        raise InputError(f"{name} has entries that are not finite")
    if not is_rotation(given.rotation):
        raise InputError(
            f"{name} is not a rotation matrix; expected R^T R = I and det R = 1"
        )
    return rotated(given)


def rotated(given: pin.SE3) -> pin.SE3:
    """Return a copy of a placement, whose matrix R is replaced by a rotation near to R."""
    import pinocchio as pin

    return pin.SE3(
        pin.Quaternion(given.rotation).normalized().matrix(), given.translation
    )


def is_rotation(R: Array) -> bool:
    """Return whether R (3, 3) is a rotation matrix within the tolerance of quaternions.

    The entries of R^T R are squared lengths and products, and change by at most twice as much as
    the lengths of the columns.
    """
    skewed = float(np.abs(R.T @ R - np.eye(3)).max())
    return skewed <= 2.0 * NORM_TOLERANCE and float(np.linalg.det(R)) > 0.0


def as_double(name: str, value: object) -> Array:
    """Return a new array of native floats; raise `InputError` if an entry is not a real number."""
    refuse_masked(name, value)
    array = _as_array(name, value)
    if array.ndim == 0 and array.dtype.kind == "O":
        kind = type(value).__name__
        raise InputError(f"{name} has type {kind}, expected real numbers")
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} contains {array.dtype} values, expected real numbers")
    return array.astype(np.float64)


def _as_array(name: str, value: object) -> NDArray[np.generic]:
    try:
        return np.asarray(value)
    except ValueError:
        raise InputError(
            f"{name} is not an array, because its rows differ in length"
        ) from None


class FrozenArrays:
    """Mixin that replaces writeable arrays in a frozen dataclass by read-only copies."""

    def __post_init__(self) -> None:
        for name, value in [*vars(self).items()]:
            if isinstance(value, np.ndarray) and value.flags.writeable:
                object.__setattr__(self, name, frozen(value.copy()))

    def __setstate__(self, state: dict[str, object]) -> None:
        # deepcopy and most pickle protocols create writeable arrays. Make these read-only again.
        for value in state.values():
            if isinstance(value, np.ndarray):
                frozen(value)
        vars(self).update(state)


class Result(FrozenArrays):
    """Mixin for results that can be saved in files; ``print`` shows the report of a result."""

    verified: bool
    # Attributes that have the name of an entry of `_TITLE` but another meaning.
    _untitled: ClassVar[frozenset[str]] = frozenset()

    def __repr__(self) -> str:
        """Return a title with the robot, the numbers of points and signals, and the accuracy."""
        shown = [
            key
            for key in _TITLE
            if key not in self._untitled and getattr(self, key, None) is not None
        ]
        parts = [_TITLE[key](getattr(self, key)) for key in shown]
        return f"{type(self).__name__}({', '.join(parts)})"

    def __str__(self) -> str:
        report = self._report()
        if not self.verified:
            report += f"\n{NOT_VERIFIED}"
        return report

    def _report(self) -> str:
        return repr(self)

    def _repr_html_(self) -> str:
        warning = "" if self.verified else html.paragraph(NOT_VERIFIED, "bad")
        return html.result_card(self, warning, *self._html_parts())

    def _html_parts(self) -> Sequence[str]:
        """Return the parts of the card in HTML."""
        report = without_first_paragraph(self._report(), repr(self))
        return (html.preformatted(report.lstrip("\n")),)


# Parts of the title of a result, as {attribute: function that formats its value}. Attributes that a
# result does not have are omitted from its title.
_TITLE: dict[str, Callable[[Any], str]] = {
    "robot": "'{}'".format,
    "__len__": lambda count: f"{count()} points",
    "t": lambda t: f"t={t:g} s" if isinstance(t, float) else f"knots={len(t)}",
    "parameters": lambda names: f"parameters={len(names)}",
    "state_names": lambda names: f"nx={len(names)}",
    "input_names": lambda names: f"nu={len(names)}",
    "output_names": lambda names: f"ny={len(names)}",
    "frame": "frame='{}'".format,
    "tool": "tool='{}'".format,
    "dt": lambda dt: f"dt={dt:g} s" if dt else "continuous",
    "margin": lambda margin: f"pole_margin={np.min(margin):.3g}",
    "residual": lambda residual: f"residual={np.max(residual):.1e}",
}


def frozen(array: Array) -> Array:
    """Make an array read-only and return it."""
    array.setflags(write=False)
    return array
