"""Robot files: TOML files that name a URDF and give its inputs, outputs and other fields."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from fflin.base.errors import FflinError, InputError
from fflin.base.names import stands_for_any
from fflin.base.toml_file import TomlFile, flat
from fflin.robot.catalog import find_robot
from fflin.robot.fields import FIELDS
from fflin.robot.input_files import NAME, NUMBER, check_keys, read_inputs
from fflin.robot.outputs import parse_output

if TYPE_CHECKING:
    from pathlib import Path

    from fflin.robot.robot import Robot


# What holds names; all else holds numbers, but for what may be a word.
_OF_NAMES = ("urdf", "package_dirs", "lock", "passive", "outputs")
_WORDS = (["damping"], ["weights", "rule"], ["orbit", "body"])


class RobotToml:
    """Content of a robot's TOML file, checked as far as possible without the robot."""

    def __init__(self, path: Path, name: str) -> None:
        self._document = document = TomlFile(path)
        check_keys(document)
        if "urdf" not in document.record:
            raise InputError(
                f'{path}: the file holds inputs only; add urdf = "my.urdf" above them, or pass the '
                "file to a robot with --inputs or fflin.load_inputs"
            )
        given = {key: self._checked(key) for key in document.record if key != "input"}
        self._written = given | {"inputs": document.record.get("input")}
        lock, folders = given.pop("lock", {}), given.pop("package_dirs", [])
        # {joint or pattern: value, or None at neutral}.
        self.lock: dict[str, float | None] = lock if isinstance(lock, dict) else dict.fromkeys(lock)
        self.package_dirs = tuple(path.parent / folder for folder in folders)
        with self.placed("urdf"):
            # The URDF, under the name of the TOML file.
            self.found = find_robot(given.pop("urdf"), path.parent)._replace(name=name)
            if self.found.path.suffix.lower() == ".toml":
                raise InputError(f"urdf is {self.found.path}, expected a URDF or a robot's name")
        with self.placed("outputs"):
            if words := given.get("outputs"):
                given["outputs"] = [output for word in words for output in parse_output(word)]
        if "input" in document.record:
            given["inputs"] = read_inputs(document)
        self._fields = {key: given[key] for key in FIELDS if key in given}

    def applied(self, robot: Robot) -> Robot:
        """Return the robot of the URDF with what the file says, but of joints that others lock."""
        locked = [each.rpartition("=")[0] for each in robot.locked]
        gone = [name for name in locked if not any(stands_for_any(x, [name]) for x in self.lock)]
        for key, value in self._fields.items():
            with self.placed(key):
                self._check_unlocked(key, value)
                robot = robot.replace(**{key: _without(gone, robot.joint_names, value)})
        return robot

    @contextmanager
    def placed(self, key: str) -> Iterator[None]:
        """Put file and line in front of what is wrong about a key, of the lock if it names it."""
        try:
            yield
        except FflinError as error:
            document, message = self._document, str(error)
            places = _places(self._written.get(key))
            quoted = [
                place
                for name, *place in places
                if re.search(f"'{re.escape(name)}'| {re.escape(name)} is ", message)
            ]
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
                raise InputError(f"joint '{name}' is also locked in line {line}; remove one")

    def _checked(self, key: str) -> Any:
        """Return the value of a key, in which names stand for names and numbers for numbers."""
        value = self._document.record[key]
        if isinstance(value, dict):
            # The parts of these are tables of names, which may have dots.
            parts = value if key in ("weights", "start") else {"": value}
            parts = {part: flat(x) if isinstance(x, dict) else x for part, x in parts.items()}
            value = parts.get("", parts)
        named = key in _OF_NAMES and not (key == "lock" and isinstance(value, dict))
        right, expected = NAME if named else NUMBER
        no_table = named and isinstance(value, dict)
        for *place, leaf in [(key, value)] if no_table else _leaves(value, key):
            if not right(leaf) and not (isinstance(leaf, str) and place in _WORDS):
                shown = f"{'.'.join(place)} is {reprlib.repr(leaf)}, expected {expected}"
                raise self._document.error(shown, *place)
        return [value] if key in _OF_NAMES[1:] and isinstance(value, str) else value


def _leaves(value: Any, *place: str) -> Iterator[tuple[Any, ...]]:
    """Yield (*place, value) of all that is no table, and of the entries of its lists."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(inner, *place, key)
    elif isinstance(value, list):
        yield from ((*place, entry) for entry in value)
    else:
        yield (*place, value)


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
