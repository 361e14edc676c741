"""Inputs from a TOML file."""

import reprlib
from collections.abc import Callable
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

from fflin.base.errors import InputError, unknown
from fflin.base.toml_file import TomlFile
from fflin.robot.catalog import find_inputs
from fflin.robot.fields import FIELDS
from fflin.robot.inputs import KINDS, Input

_TYPES = {kind.KEY: kind for kind in KINDS}

# The keys of a robot file; one that has no `urdf` holds inputs alone.
ROBOT_KEYS = ("urdf", "package_dirs", "lock", "input", *(x for x in FIELDS if x != "inputs"))


def is_number(value: Any) -> bool:
    """Whether a value of TOML is a finite number."""
    # The limit keeps lengths finite, and integers that are no floats out.
    return type(value) in (int, float) and abs(value) < 1e100


def _is_vector(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(map(is_number, value))


# What a value is to be, and how an error says so.
NAME = (lambda x: isinstance(x, str) and x != "", "a name in quotes")
NUMBER = (is_number, "a finite number")
_VECTOR = (_is_vector, "three finite numbers, [x, y, z]")
_EITHER = (lambda x: is_number(x) or _is_vector(x), "a finite number or three of them")
_EXPECTED: dict[str, tuple[Callable[[Any], bool], str]] = {
    **dict.fromkeys(("position", "direction", "axis"), _VECTOR),
    **dict.fromkeys(("inertia", "momentum", "max", "min", "max_speed", "least_impulse"), NUMBER),
    "on_off": (lambda x: isinstance(x, bool), "true or false"),
}


def load_inputs(path: str | Path) -> tuple[Input, ...]:
    """Read the inputs of a robot from a TOML file.

    The file is an array of tables ``[[input]]``, in the order of u. Each table has a ``type``
    and the keys of this type, which are the parameters of the class:

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
                        thruster 0. Base inputs take one number or three
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
    known, hint = (ROBOT_KEYS, "") if whole else (("input",), "; write [[input]]")
    for key in document.record:
        if key not in known:
            if not whole and key in ROBOT_KEYS:
                missing = 'has no key `urdf`; a robot file needs it: add urdf = "my.urdf"'
                raise InputError(f"{document.path}: {missing}")
            problem = unknown("key of a robot file" if whole else "table", key, known)
            raise document.unknown(f"{problem}{hint}", key)


def read_inputs(document: TomlFile) -> tuple[Input, ...]:
    """Return the inputs of a file, as `load_inputs` does."""
    tables = document.record.get("input", [])
    if not isinstance(tables, list) or not all(isinstance(x, dict) for x in tables):
        raise document.error("input is not an array of tables; write [[input]]", "input")
    if not tables:
        message = "the file holds no inputs; write [[input]] and its type below"
        raise InputError(f"{document.path}: {message}")
    inputs: list[Input] = []
    seen: dict[Input | str | None, int] = {}
    for index, table in enumerate(tables):
        item = _input(document, index, table)
        what = item.name if hasattr(item, "name") else replace(item, min=None, max=None)
        if what is not None and what in seen:
            shown = f"the name '{what}'" if isinstance(what, str) else what
            first = document.line("input", seen[what])
            message = f"{shown} is already given in line {first}; remove one"
            raise _error(document, message, index, "name")
        seen[what] = index
        inputs.append(item)
    return tuple(inputs)


def _error(document: TomlFile, message: str, index: int, *place: str) -> InputError:
    return document.error(f"input {index + 1}: {message}", "input", index, *place)


def _input(document: TomlFile, index: int, table: dict[str, Any]) -> Input:
    kind = table.get("type")
    if kind is None:
        near = [key for key in table if key.lower() == "type"]
        hint = f", but has '{near[0]}'" if near else ""
        message = f"has no key 'type'{hint}; set it to one of {', '.join(_TYPES)}"
        raise _error(document, message, index)
    if not isinstance(kind, str) or kind not in _TYPES:
        shown = kind if isinstance(kind, str) else reprlib.repr(kind)
        raise document.unknown(unknown("type of input", shown, _TYPES), "input", index, "type")
    by_keyword_last = sorted(fields(_TYPES[kind]), key=lambda field: field.kw_only is True)
    known = {field.name: field for field in by_keyword_last}
    values = {key: value for key, value in table.items() if key != "type"}
    for key, value in values.items():
        if key not in known:
            problem = unknown(f"key of a {kind}", key, ("type", *known))
            raise document.unknown(problem, "input", index, key)
        right, expected = _EXPECTED.get(key, NAME)
        if key in ("max", "min") and len(_TYPES[kind].ENTRIES) > 1:
            right, expected = _EITHER
        if not right(value):
            message = f"{key} is {reprlib.repr(value)}, expected {expected}"
            raise _error(document, message, index, key)
    for key, field in known.items():
        if field.default is MISSING and key not in values:
            raise _error(document, f"a {kind} needs the key '{key}'; add it", index)
    try:
        return _TYPES[kind](**values)
    except InputError as error:
        message = str(error)  # begins with what is wrong, "thruster direction is ..."
        wrong = [key for key in values if f" {key} is " in message]
        raise _error(document, message, index, *wrong[:1]) from None
