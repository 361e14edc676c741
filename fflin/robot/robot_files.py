"""Robots from TOML files: a URDF with what acts on it, is watched of it and is known of it."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeAlias

from fflin.base.errors import FflinError, InputError, unknown
from fflin.base.names import stands_for_any
from fflin.base.toml_file import TomlFile, flat
from fflin.robot.catalog import find_robot
from fflin.robot.input_files import check_keys, is_number, is_vector, read_inputs
from fflin.robot.outputs import parse_output

if TYPE_CHECKING:
    from pathlib import Path

    from fflin.robot.robot import Robot


def is_text(value: Any) -> bool:
    """Whether a value is a name."""
    return isinstance(value, str) and value != ""


def _texts(value: Any) -> bool:
    return isinstance(value, list) and all(map(is_text, value))


def _numbers(value: Any) -> bool:
    return isinstance(value, dict) and all(map(is_number, value.values()))


def _ranges(value: Any) -> bool:
    return isinstance(value, dict) and all(
        is_number(x) or (isinstance(x, list) and len(x) == 2 and all(map(is_number, x)))
        for x in value.values()
    )


_Kind: TypeAlias = "tuple[str, Callable[[Any], bool]]"

_TEXT: _Kind = ("a text in quotes", is_text)
_LIST: _Kind = ('a list of names, ["a", "b"]', _texts)
_VECTOR: _Kind = ("three finite numbers, [x, y, z]", is_vector)
_TABLE: _Kind = ("a table of lines name = number", _numbers)
_PER_JOINT: _Kind = (
    "a table of lines joint = number, or a number for all joints",
    lambda value: is_number(value) or _numbers(value),
)

_KINDS: dict[str, _Kind] = {
    "urdf": _TEXT,
    "package_dirs": _LIST,
    "gravity": _VECTOR,
    "lock": (
        'a list of names, ["a", "b"], or a table {joint = number}',
        lambda value: _texts(value) or _numbers(value),
    ),
    "passive": _LIST,
    "outputs": _LIST,
    "stiffness": _PER_JOINT,
    "damping": (f'{_PER_JOINT[0]}, or "urdf"', lambda x: x == "urdf" or _PER_JOINT[1](x)),
    "rest": _TABLE,
    "limits": ("a table of lines name = number, or name = [least, largest]", _ranges),
}
_PARTS: dict[str, dict[str, _Kind]] = {
    "weights": {"rule": _TEXT, "q": _TABLE, "r": _TABLE, "bryson": _TABLE},
    "start": {"joints": _TABLE, "rpy": _VECTOR, "position": _VECTOR, "velocity": _TABLE},
}

# In the order in which they are given to the robot: names of inputs are known after the inputs.
_FIELDS = (
    *("passive", "inputs", "outputs", "stiffness", "damping", "rest", "gravity"),
    *("limits", "weights", "start"),
)


class RobotToml:
    """What a robot's TOML file says, checked as far as it can be without the robot.

    Attributes
    ----------
    found : RobotFile
        The URDF, under the name of the TOML file.
    lock : mapping
        {joint or pattern: value, or None at neutral}.
    package_dirs : tuple of Path
    """

    def __init__(self, path: Path, name: str) -> None:
        self._document = document = TomlFile(path)
        check_keys(document)
        if "urdf" not in document.record:
            raise InputError(
                f'{path}: holds inputs alone; add urdf = "my.urdf" above them, or give it to a '
                "robot, with --inputs or fflin.load_inputs"
            )
        given = {key: self._checked(key) for key in document.record if key != "input"}
        self._written = given | {"inputs": document.record.get("input")}
        lock, folders = given.pop("lock", {}), given.pop("package_dirs", [])
        self.lock: dict[str, float | None] = lock if isinstance(lock, dict) else dict.fromkeys(lock)
        self.package_dirs = tuple(path.parent / folder for folder in folders)
        with self.placed("urdf"):
            self.found = replace(find_robot(given.pop("urdf"), path.parent), name=name)
            if is_toml(self.found.path):
                raise InputError(f"urdf is {self.found.path}, expected a URDF or a robot's name")
        with self.placed("outputs"):
            if words := given.get("outputs"):
                given["outputs"] = [output for word in words for output in parse_output(word)]
        if "input" in document.record:
            given["inputs"] = read_inputs(document)
        self._fields = {key: given[key] for key in _FIELDS if key in given}

    def applied(self, robot: Robot) -> Robot:
        """Return the robot of the URDF with what the file says.

        Of joints that the file does not lock and that are locked nevertheless, it says nothing.
        """
        locked = [each.rpartition("=")[0] for each in robot.locked]
        gone = [name for name in locked if not any(stands_for_any(x, [name]) for x in self.lock)]
        for key, value in self._fields.items():
            with self.placed(key):
                self._check_unlocked(key, value)
                robot = robot.replace(**{key: _without(gone, robot.joint_names, value)})
        return robot

    @contextmanager
    def placed(self, key: str) -> Iterator[None]:
        """Put file and line in front of what is wrong about a key.

        Of the lock, where others lock joints too, about a joint that it names.
        """
        try:
            yield
        except FflinError as error:
            document, message = self._document, str(error)
            places = _places(self._written.get(key))
            quoted = [place for name, *place in places if f"'{name}'" in message]
            if key == "lock" and not quoted:
                raise
            table = "input" if key == "inputs" else key
            line = document.line(table, *(quoted[0] if quoted else ()))
            raise type(error)(f"{document.path}:{line}: {message}") from None

    def _check_unlocked(self, key: str, value: Any) -> None:
        names = value.get("joints", value) if isinstance(value, Mapping) else value
        for name in names if isinstance(names, list | dict) else ():
            if name in self.lock:
                line = self._document.line("lock")
                raise InputError(f"joint '{name}' is locked in line {line}; leave one out")

    def _checked(self, key: str) -> Any:
        """Return the value of a key, which is of the kind that is expected."""
        value, parts = self._document.record[key], _PARTS.get(key)
        if parts is None:
            return self._of_kind(_KINDS[key], value, key)
        if not isinstance(value, dict):
            shown = reprlib.repr(value)
            raise self._document.error(f"{key} is {shown}, expected a table [{key}]", key)
        for part in value:
            if part not in parts:
                raise self._document.unknown(unknown(f"key of [{key}]", part, parts), key, part)
        return {part: self._of_kind(parts[part], x, key, part) for part, x in value.items()}

    def _of_kind(self, kind: _Kind, value: Any, *place: str) -> Any:
        expected, right = kind
        if isinstance(value, dict):
            value = flat(value)
            wrong = [name for name, x in value.items() if not right({name: x})]
            place, value = ((*place, wrong[0]), value[wrong[0]]) if wrong else (place, value)
            if not wrong and right(value):
                return value
        elif right(value):
            return value
        shown = reprlib.repr(value)
        raise self._document.error(f"{'.'.join(place)} is {shown}, expected {expected}", *place)


def is_toml(path: Path) -> bool:
    """Whether a robot's description is a robot file."""
    return path.suffix.lower() == ".toml"


def _places(value: Any, *place: str | int) -> Iterator[tuple[Any, ...]]:
    """Yield (name, *place) of each name in a value, the innermost first."""
    pairs: Any = value.items() if isinstance(value, dict) else ()
    if isinstance(value, list):
        pairs = enumerate(value)
    for key, inner in pairs:
        if isinstance(inner, dict | list):
            yield from _places(inner, *place, key)
        if isinstance(inner, str):
            yield (inner, *place, key)
        if isinstance(key, str):
            yield (key, *place, key)


def _without(gone: list[str], left: tuple[str, ...], value: Any) -> Any:
    """Return a field of a robot without what is of joints alone that are gone."""
    if isinstance(value, dict) and gone:
        kept = {key: x for key, x in value.items() if _kept(key, gone, left)}
        return {key: _without(gone, left, x) for key, x in kept.items()}
    if isinstance(value, list | tuple) and gone:
        return [x for x in value if _kept(getattr(x, "joint", x), gone, left)]
    return value


def _kept(key: Any, gone: list[str], left: tuple[str, ...]) -> bool:
    if not isinstance(key, str):
        return True
    of_gone, of_left = (
        [f"{group}.{joint}" for group in ("q_m", "qdot_m", "tau_m") for joint in joints]
        for joints in (gone, left)
    )
    return stands_for_any(key, of_left) or not stands_for_any(key, of_gone)
