"""Robot files: TOML files that name a URDF and give its inputs, outputs and other fields."""

from __future__ import annotations

import reprlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields, replace
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fflin.base.errors import FflinError, InputError, UnknownNameError, unknown
from fflin.base.names import stands_for_any
from fflin.base.toml_file import NAME, NUMBER, NUMBERS, TRUTH, VECTOR, Kind, TomlFile, flat
from fflin.robot.catalog import find_inputs, find_robot
from fflin.robot.equipment.appendages import Appendage, FlexibleAppendage, Slosh
from fflin.robot.fields import FIELDS, Field
from fflin.robot.inputs import KINDS, Input, Vector3
from fflin.robot.outputs import parse_output

if TYPE_CHECKING:
    from fflin.robot.robot import Robot

# Fields that a file gives as arrays of tables.
_TABLES = {"inputs": ("input",), "appendages": ("flexible", "slosh")}

# The keys of a robot file; a file without `urdf` holds inputs alone. The guide has their meaning.
KEYS = {
    "urdf": Field(kind=NAME, table=None),
    "package_dirs": Field(kind=NAME, table=None),
    "lock": Field(kind=NAME),
    **{table: Field() for tables in _TABLES.values() for table in tables},
    **{name: field for name, field in FIELDS.items() if name not in _TABLES},
}

_TYPES = {kind.KEY: kind for kind in KINDS}
# The kind of value for each annotation of an input's parameters.
_KINDS: dict[Any, Kind] = {
    **dict.fromkeys((str, str | None), NAME),
    **dict.fromkeys((float, float | None), NUMBER),
    **{bool: TRUTH, Vector3: VECTOR, float | Vector3 | None: NUMBERS},
}


class RobotToml:
    """Content of a robot's TOML file, checked as far as possible without the robot."""

    def __init__(self, path: Path, name: str) -> None:
        self._document = document = TomlFile(path)
        check_keys(document)
        if "urdf" not in document.record:
            raise InputError(
                f'{path}: the file contains only inputs; add urdf = "my.urdf" above the inputs, or '
                "pass the file with --inputs or fflin.load_inputs"
            )
        tables = {key for keys in _TABLES.values() for key in keys}
        given = {key: self._checked(key) for key in document.record if key not in tables}
        lock, folders = given.pop("lock", {}), given.pop("package_dirs", [])
        # {joint or pattern: value, or None at neutral}.
        self.lock: dict[str, float | None] = lock if isinstance(lock, dict) else dict.fromkeys(lock)
        self.package_dirs = tuple(path.parent / folder for folder in folders)
        with document.located("urdf"):
            # The URDF, under the name of the TOML file.
            self.found = find_robot(given.pop("urdf"), path.parent)._replace(name=name)
            if self.found.path.suffix.lower() == ".toml":
                raise InputError(f"urdf is {self.found.path}, expected a URDF or a robot's name")
        with document.located("outputs"):
            if words := given.get("outputs"):
                given["outputs"] = [output for word in words for output in parse_output(word)]
        if "input" in document.record:
            given["inputs"] = read_inputs(document)
        if appendages := read_appendages(document):
            given["appendages"] = appendages
        self._fields = {key: given[key] for key in FIELDS if key in given}

    def applied(self, robot: Robot) -> Robot:
        """Return the robot with the file's fields, except those of joints that a caller locks."""
        locked = [each.rpartition("=")[0] for each in robot.locked]
        gone = [name for name in locked if not any(stands_for_any(x, [name]) for x in self.lock)]
        for key, value in self._fields.items():
            names = [name for name in _TABLES.get(key, (key,)) if name in self._document.record]
            with self._document.located(names[0]):
                self._check_unlocked(value)
                robot = robot.replace(**{key: _without(gone, robot.joint_names, value)})
        return robot

    @contextmanager
    def located_locks(self) -> Iterator[None]:
        """Put file and line in front of errors that name a joint that the file locks."""
        try:
            yield
        except FflinError as error:
            if not any(f"'{name}'" in str(error) for name in self.lock):
                raise
            with self._document.located("lock"):
                raise

    def _check_unlocked(self, value: Any) -> None:
        names = value.get("joints", value) if isinstance(value, Mapping) else value
        for name in names if isinstance(names, list | dict) else ():
            if name in self.lock:
                line = self._document.line("lock")
                raise InputError(
                    f"joint '{name}' is also locked in line {line}; remove the joint in one of the "
                    "two places"
                )

    def _checked(self, name: str) -> Any:
        """Return the value of a key, with flat tables: names in them may have dots."""
        key, value = KEYS[name], self._document.record[name]
        kind = key.kind
        if isinstance(value, dict):
            kind = key.table or kind
            parts = value if key.parts else {"": value}
            parts = {part: flat(x) if isinstance(x, dict) else x for part, x in parts.items()}
            value = parts if key.parts else parts[""]
        word = [name, key.word] if key.word else [name]
        for *place, leaf in _leaves(value, name) if key.table else _entries(value, name):
            if key.word is None or place != word or not isinstance(leaf, str):
                self._document.require(kind, leaf, *place)
        listed = isinstance(value, str) and kind is NAME and name != "urdf"
        return [value] if listed else value


def _entries(value: Any, *place: str) -> Iterator[tuple[Any, ...]]:
    """Yield (*place, value) of a value, or of the entries of a list."""
    yield from ((*place, entry) for entry in (value if isinstance(value, list) else [value]))


def _leaves(value: Any, *place: str) -> Iterator[tuple[Any, ...]]:
    """Yield (*place, value) of all values in nested tables, and of the entries of lists."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(inner, *place, key)
    else:
        yield from _entries(value, *place)


def _without(gone: list[str], left: tuple[str, ...], value: Any) -> Any:
    """Return a field of a robot without entries for removed joints."""
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


def load_inputs(path: str | Path) -> tuple[Input, ...]:
    """Read the inputs of a robot from a TOML file.

    The file is an array of tables ``[[input]]``, in the order of u. In each table,
    ``type`` selects the class of the input. The other keys are the parameters of this class:

    ==================  =========================================================
    ``type``            keys
    ==================  =========================================================
    ``base_torque``     none: `BaseTorque`
    ``base_force``      none: `BaseForce`
    ``joint_torque``    ``joint``: `JointTorque`
    ``thruster``        ``frame``, ``position`` [m], ``direction``; optional:
                        ``name``, ``on_off`` (true: pulses of ``max``),
                        ``least_impulse`` [N s]: `Thruster`
    ``reaction_wheel``  ``axis``; optional: ``frame``, ``name``, and either
                        ``inertia`` [kg m^2] with ``max_speed`` [rad/s] or
                        ``momentum`` [N m s]: `ReactionWheel`
    every type          optional: ``max`` and ``min`` [N m | N], the largest and
                        the least value. The default of ``min`` is -max, for a
                        thruster 0. For base inputs: one number, or three
    ==================  =========================================================

    Parameters
    ----------
    path : str or Path
        Path of the file, or the name of a bundled one: ``"cubesat"``, ``"servicer_7dof"``.

    Returns
    -------
    tuple of Input

    Raises
    ------
    FileError
        If the path is not a regular file, or the file cannot be read or is too large.
    UnknownNameError
        If there is no such type or key; the message names file and line.
    InputError
        If the file is not TOML, a key is missing, a value is wrong or an input is given twice;
        the message names file and line.

    Examples
    --------
    A file with this content ::

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

    >>> inputs = fflin.load_inputs("cubesat")  # bundled
    >>> len(inputs), inputs[-1].name
    (15, 'wheel_z')
    """
    document = TomlFile(find_inputs(path))
    check_keys(document)
    return read_inputs(document)


def check_keys(document: TomlFile) -> None:
    """Raise `UnknownNameError` if a file of inputs or a robot file has an unknown key."""
    whole = "urdf" in document.record
    known, hint = (tuple(KEYS), "") if whole else (("input",), "; write [[input]]")
    for key in document.record:
        if key not in known:
            if not whole and key in KEYS:
                missing = 'the key `urdf` of a robot file is missing; add urdf = "my.urdf"'
                raise InputError(f"{document.path}: {missing}")
            problem = unknown("key of a robot file" if whole else "table", key, known)
            raise document.error(UnknownNameError(f"{problem}{hint}"), key)


def read_inputs(document: TomlFile) -> tuple[Input, ...]:
    """Return the inputs of a file, as `load_inputs` does."""
    tables = _tables(document, "input")
    if not tables:
        message = "the file contains no inputs; add a table [[input]] with its type"
        raise InputError(f"{document.path}: {message}")
    inputs: list[Input] = []
    seen: dict[Input | str | None, int] = {}
    for index, table in enumerate(tables):
        item = _input(document, index, table)
        what = item.name if hasattr(item, "name") else replace(item, min=None, max=None)
        if what is not None and what in seen:
            shown = f"the name '{what}'" if isinstance(what, str) else what
            first = document.line("input", seen[what])
            message = (
                f"input {index + 1}: {shown} is already given in line {first}; remove one of the "
                "two"
            )
            raise document.error(message, "input", index, "name")
        seen[what] = index
        inputs.append(item)
    return tuple(inputs)


def read_appendages(document: TomlFile) -> list[Appendage]:
    """Return the flexible appendages and slosh of a robot file."""
    found: list[Appendage] = []
    for key, make, special in (
        ("flexible", FlexibleAppendage, FlexibleAppendage.from_nastran),
        ("slosh", Slosh, Slosh.cylinder),
    ):
        # Keys that only files of Nastran, or cylinders, have.
        alone = set(signature(special).parameters) - set(signature(make).parameters)
        for index, table in enumerate(_tables(document, key)):
            build: Any = special if alone & set(table) else make
            of, place = _entry(key, index, table), (key, index)
            hidden = {"inertia"} if build is special else {"inertia", "rigid"}
            required = {
                name: parameter.default is parameter.empty
                for name, parameter in signature(build).parameters.items()
                if name not in hidden
            }
            values = dict(table)
            for name in {"op4", "asm"} & set(values):
                document.require(NAME, values[name], *place, name, of=f"{of}{name}")
                values[name] = document.path.parent / values[name]
            also = (*required, *sorted(alone))
            found.append(_built(document, place, f"key of {key}", build, values, required, also))
    return found


def _tables(document: TomlFile, key: str) -> list[dict[str, Any]]:
    """Return an array of tables of a file, empty if there is none."""
    tables = document.record.get(key, [])
    if not isinstance(tables, list) or not all(isinstance(x, dict) for x in tables):
        raise document.error(f"{key} is not an array of tables; write [[{key}]]", key)
    return tables


def _built(
    document: TomlFile,
    place: tuple[str, int],
    what: str,
    build: Any,
    values: dict[str, Any],
    required: Mapping[str, bool],
    known: Iterable[str],
) -> Any:
    """Build the object of a table, with file and line in front of errors.

    `required` says of each key whether it must be given; `known` are the keys that a message lists.
    """
    of = _entry(*place, values)
    for name in values:
        if name not in required:
            raise document.error(unknown(what, name, dict.fromkeys(known)), *place, name)
    for name, needed in required.items():
        if needed and name not in values:
            raise document.error(f"{of}the key '{name}' is missing; add this key", *place)
    try:
        return build(**values)
    except FflinError as error:
        with document.located(*place):
            raise type(error)(f"{of}{error}") from None


def _entry(key: str, index: int, table: Mapping[str, Any]) -> str:
    """Return the beginning of a message about a table: its number, and its name if it has one."""
    name = table.get("name")
    return f"{key} {index + 1} ('{name}'): " if isinstance(name, str) else f"{key} {index + 1}: "


def _input(document: TomlFile, index: int, table: dict[str, Any]) -> Input:
    kind, of, place = table.get("type"), _entry("input", index, table), ("input", index)
    if kind is None:
        near = [key for key in table if key.lower() == "type"]
        hint = f", but there is a key '{near[0]}'" if near else ""
        message = f"{of}the key 'type' is missing{hint}; set 'type' to one of {', '.join(_TYPES)}"
        raise document.error(message, *place)
    if not isinstance(kind, str) or kind not in _TYPES:
        shown = kind if isinstance(kind, str) else reprlib.repr(kind)
        raise document.error(unknown("type of input", shown, _TYPES), *place, "type")
    by_keyword_last = sorted(fields(_TYPES[kind]), key=lambda field: field.kw_only is True)
    required = {field.name: field.default is MISSING for field in by_keyword_last}
    values = {key: value for key, value in table.items() if key != "type"}
    for field in by_keyword_last:
        if field.name in values:
            expected = _KINDS[field.type]
            if expected is NUMBERS and len(_TYPES[kind].ENTRIES) == 1:
                expected = NUMBER
            document.require(
                expected, values[field.name], *place, field.name, of=f"{of}{field.name}"
            )
    known = ("type", *required)
    built: Input = _built(
        document, place, f"key of a {kind}", _TYPES[kind], values, required, known
    )
    return built
