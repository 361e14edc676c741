"""Errors that fflin raises; each message says what was given, what was expected, what to do."""

import re
from collections.abc import Iterable
from typing import Any


class FflinError(Exception):
    """Base of every error that a public call of fflin raises on purpose; reads as one line."""

    def __str__(self) -> str:
        text = " ".join(line.strip() for line in super().__str__().splitlines())
        # A name in a file may hold what commands the terminal.
        return re.sub(r"[\x00-\x1f\x7f-\x9f]", lambda found: repr(found[0])[1:-1], text)


class InputError(FflinError, ValueError):
    """An argument has a wrong size, type or value."""


class UnknownNameError(FflinError, LookupError):
    """A robot, joint or frame of that name does not exist."""


class FileError(FflinError, OSError):
    """A file cannot be read or written."""


class UrdfError(FflinError, ValueError):
    """A robot description is malformed or describes what cannot exist."""


class ModelError(FflinError, ValueError):
    """A model is not one free-flying tree of one-degree-of-freedom joints."""


class SingularInertiaError(FflinError, ArithmeticError):
    """The joint-space inertia matrix cannot be inverted."""


class ChartError(FflinError, ValueError):
    """The base is turned by pi from the reference, where the attitude chart ends."""


class EquilibriumError(FflinError, ValueError):
    """A point is no fixed point where one is needed, or no input makes it one."""


class StabilizabilityError(FflinError, ValueError):
    """The inputs cannot hold what does not settle by itself.

    Attributes
    ----------
    margin : Margin or None
        Distance from doubt of the decisions behind it; None where they were not made.
    """

    margin: Any = None


class DetectabilityError(FflinError, ValueError):
    """The outputs do not show what does not settle by itself.

    Attributes
    ----------
    margin : Margin or None
        Distance from doubt of the decisions behind it; None where they were not made.
    """

    margin: Any = None


class MissingPackageError(FflinError, ImportError):
    """An optional package is needed and not installed."""


class SweepError(FflinError, RuntimeError):
    """Some chunks of a sweep have no result.

    Attributes
    ----------
    failed : tuple
        (start, stop, reason) of each: its points, stop not among them.
    batch : LinearBatch or None
        The others, in order, where they are in memory.
    """

    def __init__(
        self, message: str, failed: tuple[tuple[int, int, str], ...] = (), batch: Any = None
    ) -> None:
        super().__init__(message)
        self.failed, self.batch = failed, batch


class FflinWarning(UserWarning):
    """Something about a robot that its user should know and that is no error."""


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
