"""Inputs from a TOML file."""

import re
import reprlib
import sys
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

from fflin.base.errors import FflinError, InputError, UnknownNameError, unknown
from fflin.base.writing import read_input
from fflin.robot.catalog import find_inputs
from fflin.robot.inputs import KINDS, Input

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_TYPES = {kind.KEY: kind for kind in KINDS}
_VECTORS = ("position", "direction", "axis")
_NUMBERS = ("inertia", "momentum", "max", "min", "max_speed", "least_impulse")

# Some 1,000 inputs.
_SIZE_LIMIT = 2**17

# The time for a dotted key grows with the square of its parts.
_DOTS_LIMIT = 1_000

# What may hold a line that looks like a key: strings of several lines. Those of one line and
# comments are found too, for they may hold the quotes of the former.
_TEXTS = re.compile(
    r'"""(?:\\.|[^\\])*?"""+'
    r"|'''.*?'''+"
    r'|"(?:\\.|[^"\\\n])*"'
    r"|'[^'\n]*'"
    r"|#[^\n]*",
    re.DOTALL,
)


def load_inputs(path: str | Path) -> tuple[Input, ...]:
    """Read the inputs of a robot from a TOML file.

    The file is an array of tables ``[[input]]``; their order is that of u. Each has a ``type``
    and the keys of that type, which are the parameters of the class:

    ==================  =========================================================
    ``type``            keys
    ==================  =========================================================
    ``base_torque``     none: `BaseTorque`
    ``base_force``      none: `BaseForce`
    ``joint_torque``    ``joint``: `JointTorque`
    ``thruster``        ``frame``, ``position`` [m], ``direction`` and, as
                        wanted, ``name``, ``on_off`` (true: pulses of ``max``),
                        ``least_impulse`` [N s]: `Thruster`
    ``reaction_wheel``  ``axis`` and, as wanted, ``frame``, ``inertia`` [kg m^2]
                        with ``max_speed`` [rad/s], or ``momentum`` [N m s],
                        ``name``: `ReactionWheel`
    all                 as wanted, ``max`` and ``min`` [N m | N]: the largest
                        and the least value; ``min`` is -max by default, 0 of a
                        thruster. For the base one number or three
    ==================  =========================================================

    Parameters
    ----------
    path : str or Path
        Of the file, or the name of a bundled one: ``"cubesat"``, ``"servicer_7dof"``.

    Returns
    -------
    tuple of Input

    Raises
    ------
    FileError
        If it is not a regular file that can be read, or too large.
    UnknownNameError
        If there is no such type or key; with file and line.
    InputError
        If the file is not TOML, a key is missing, a value is wrong or an input stands there
        twice; with file and line.

    Examples
    --------
    A file that holds ::

        [[input]]
        type = "joint_torque"
        joint = "joint_1"

        [[input]]
        type = "thruster"
        name = "nozzle"
        frame = "base"
        position = [-0.9, 0.0, 0.65]
        direction = [1, 0, 0]

    gives ``(JointTorque("joint_1"), Thruster("base", (-0.9, 0, 0.65), (1, 0, 0), "nozzle"))``.
    """
    document = _Document(find_inputs(path))
    inputs: list[Input] = []
    seen: dict[Input | str | None, int] = {}
    for index, table in enumerate(document.tables):
        item = _input(document, index, table)
        what = (
            getattr(item, "name", "")
            if hasattr(item, "name")
            else replace(item, min=None, max=None)
        )
        if what is not None and what in seen:
            shown = f"the name '{what}'" if isinstance(what, str) else what
            message = f"{shown} stands in line {document.line(seen[what])} already; take one out"
            raise document.error(index, "name", message)
        seen[what] = index
        inputs.append(item)
    return tuple(inputs)


class _Document:
    """The tables of a file, and the lines on which they and their keys stand."""

    def __init__(self, path: Path) -> None:
        self._path = path
        content = read_input(path, "TOML", _SIZE_LIMIT)
        try:
            text = content.decode("utf-8-sig").replace("\r\n", "\n")
        except UnicodeDecodeError as error:
            line = content.count(b"\n", 0, error.start) + 1
            raise InputError(f"{path}:{line}: is not UTF-8 text; save it as UTF-8") from None
        for number, written in enumerate(text.split("\n"), start=1):
            if written.count(".") > _DOTS_LIMIT:
                raise InputError(f"{path}:{number}: has more than {_DOTS_LIMIT} dots; shorten it")
        try:
            record = tomllib.loads(text)
        except RecursionError:
            raise InputError(f"{path}: is nested too deeply; expected tables [[input]]") from None
        except ValueError as error:
            raise InputError(_explain(path, text, str(error))) from None
        self._lines = _TEXTS.sub(_blank, text).split("\n")
        self._starts = [
            number
            for number, line in enumerate(self._lines, start=1)
            if re.match(r"""\s*\[\[\s*(["']?)input\1\s*\]\]""", line)
        ]
        for key in record:
            if key != "input":
                line = self._find(key, 1, len(self._lines)) or 1
                problem = unknown("table", key, ["input"])
                raise UnknownNameError(f"{path}:{line}: {problem}; write [[input]]")
        tables = record.get("input", [])
        if not isinstance(tables, list) or not all(isinstance(x, dict) for x in tables):
            line = self._find("input", 1, len(self._lines)) or 1
            raise InputError(f"{path}:{line}: input is not an array of tables; write [[input]]")
        if not tables:
            raise InputError(f"{path}: holds no inputs; write [[input]] and below it its type")
        self.tables: list[dict[str, Any]] = tables

    def line(self, index: int, key: str | None = None) -> int:
        """Return the line of a key of a table, or that on which the table starts."""
        if index >= len(self._starts):  # tables written as values, input = [{...}, ...]
            return self._find("input", 1, len(self._lines)) or 1
        start, end = (*self._starts, len(self._lines) + 1)[index : index + 2]
        return (key is not None and self._find(key, start + 1, end - 1)) or start

    def error(self, index: int, key: str | None, message: str) -> InputError:
        """Build an error that says where a key, or its table where it has none, stands."""
        return InputError(f"{self._path}:{self.line(index, key)}: input {index + 1}: {message}")

    def unknown(self, index: int, key: str, problem: FflinError) -> UnknownNameError:
        """Build the same for a name that does not exist."""
        return UnknownNameError(f"{self._path}:{self.line(index, key)}: {problem}")

    def _find(self, key: str, first: int, last: int) -> int | None:
        # A key, a dotted one, or the header of a table below [[input]].
        header = r"""(?:\[+\s*(?:["']?input["']?\s*\.\s*)?)?"""
        pattern = re.compile(rf"""\s*{header}(["']?){re.escape(key)}\1\s*[.=\]]""")
        found = (n for n in range(first, last + 1) if pattern.match(self._lines[n - 1]))
        return next(found, None)


def _input(document: _Document, index: int, table: dict[str, Any]) -> Input:
    kind = table.get("type")
    if kind is None:
        near = [key for key in table if key.lower() == "type"]
        hint = f" ('{near[0]}' is not)" if near else ""
        raise document.error(
            index, None, f"has no key 'type'{hint}; give one of {', '.join(_TYPES)}"
        )
    if not isinstance(kind, str) or kind not in _TYPES:
        shown = kind if isinstance(kind, str) else reprlib.repr(kind)
        raise document.unknown(index, "type", unknown("type of input", shown, _TYPES))
    by_keyword_last = sorted(fields(_TYPES[kind]), key=lambda field: field.kw_only is True)
    known = {field.name: field for field in by_keyword_last}
    values = {key: value for key, value in table.items() if key != "type"}
    for key, value in values.items():
        if key not in known:
            raise document.unknown(index, key, unknown(f"key of a {kind}", key, ("type", *known)))
        right, expected = isinstance(value, str) and value != "", "a name in quotes"
        if key in _VECTORS:
            right, expected = _is_vector(value), "three finite numbers, [x, y, z]"
        elif key in _NUMBERS:
            right, expected = _is_number(value), "a finite number"
            if key in ("max", "min") and len(_TYPES[kind].ENTRIES) > 1:
                right, expected = right or _is_vector(value), "a finite number or three of them"
        elif key == "on_off":
            right, expected = isinstance(value, bool), "true or false"
        if not right:
            raise document.error(index, key, f"{key} is {reprlib.repr(value)}, expected {expected}")
    for key, field in known.items():
        if field.default is MISSING and key not in values:
            raise document.error(index, None, f"a {kind} needs the key '{key}'; add it")
    try:
        return _TYPES[kind](**values)
    except InputError as error:
        message = str(error)  # begins with what is wrong, "thruster direction is ..."
        wrong = next((key for key in values if f" {key} is " in message), None)
        raise document.error(index, wrong, message) from None


def _is_vector(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(map(_is_number, value))


def _is_number(value: Any) -> bool:
    # The limit keeps lengths finite, and integers that are no floats out.
    return type(value) in (int, float) and abs(value) < 1e100


def _explain(path: Path, text: str, problem: str) -> str:
    """Put the place that a TOML error names at its end in front of it."""
    found = re.fullmatch(r"(.*) \(at (?:line (\d+), column (\d+)|end of document)\)", problem)
    what, line, column = found.groups() if found else (problem, None, None)
    if line is None:
        place = f"{path}:{text.rstrip().count(chr(10)) + 1}" if found else str(path)
        return f"{place}: not TOML: {what}; mend it"
    return f"{path}:{line}: not TOML: {what} at column {column}; mend it there"


def _blank(found: re.Match[str]) -> str:
    # Keys may be quoted: what stands on one line is left, and is no line of its own.
    return found[0] if "\n" not in found[0] else "\n" * found[0].count("\n")
