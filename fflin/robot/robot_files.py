"""Robot files: TOML files that name a URDF and give its inputs, outputs and other fields."""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from fflin.base.errors import InputError, UnknownNameError, unknown
from fflin.base.toml_file import TomlFile, flat
from fflin.robot.catalog import find_inputs, find_robot, folders
from fflin.robot.equipment.appendages import Appendage, FlexibleAppendage, Slosh
from fflin.robot.fields import FIELDS
from fflin.robot.inputs import KINDS, Input
from fflin.robot.welding import requested

if TYPE_CHECKING:
    from fflin.robot.robot import Robot

T = TypeVar("T")

# Fields that a TOML file writes as arrays of tables ([[input]]): {field: names of the arrays}.
_TABLES = {"inputs": ("input",), "appendages": ("flexible", "slosh")}

# Keys of a robot file, which the guide explains; a file without `urdf` contains only inputs.
KEYS = (
    *("urdf", "package_dirs", "lock"),
    *(table for tables in _TABLES.values() for table in tables),
    *(name for name in FIELDS if name not in _TABLES),
)

_TYPES = {kind.KEY: kind for kind in KINDS}


class RobotToml:
    """Content of a robot's TOML file, checked as far as possible without the robot."""

    def __init__(self, path: Path, name: str) -> None:
        self.document = document = TomlFile(path)
        check_keys(document)
        if "urdf" not in document.record:
            raise InputError(
                f'{path}: the key `urdf` is missing; add urdf = "my.urdf", or pass a file that '
                "contains only inputs with --inputs or fflin.load_inputs"
            )
        with document.located("urdf"):
            # The robot has the name of the TOML file, not of the URDF.
            self.found = find_robot(document.record["urdf"], path.parent)._replace(name=name)
            if self.found.path.suffix.lower() == ".toml":
                raise InputError(f"urdf is {self.found.path}, expected a URDF or a robot's name")
        with document.located("package_dirs"):
            self.package_dirs = folders(document.record.get("package_dirs", ()), path.parent)
        # Nested tables become names with dots, except for the parts of weights and states.
        values = {
            key: {part: _flat(x) for part, x in value.items()}
            if key in ("weights", "point", "target", "start") and isinstance(value, dict)
            else _flat(value)
            for key, value in document.record.items()
        }
        with document.located("lock"):
            self.lock = requested(values.get("lock", ()))
        self._fields = {key: value for key, value in values.items() if key in FIELDS}
        if "input" in document.record:
            self._fields["inputs"] = read_inputs(document)
        if appendages := _read_appendages(document):
            self._fields["appendages"] = appendages

    def applied(self, robot: Robot) -> Robot:
        """Return the robot with the file's fields."""
        for key in filter(self._fields.__contains__, FIELDS):
            tables = _TABLES.get(key, (key,))
            with self.document.located(next(x for x in tables if x in self.document.record)):
                robot = robot.replace(**{key: self._fields[key]})
        return robot


def _flat(value: object) -> object:
    return flat(value) if isinstance(value, dict) else value


def load_inputs(path: str | Path) -> tuple[Input, ...]:
    """Read the inputs of a robot from a TOML file.

    The file is an array of tables ``[[input]]``, one table per input, in the order of u. In each
    table, ``type`` selects the class of the input. The other keys are the parameters of this class:

    ==================  ===============  =========================================
    ``type``            class            keys
    ==================  ===============  =========================================
    ``base_torque``     `BaseTorque`     no other keys
    ``base_force``      `BaseForce`      no other keys
    ``joint_torque``    `JointTorque`    ``joint``
    ``thruster``        `Thruster`       ``frame``, ``position`` [m] and
                                         ``direction``; optional: ``name``,
                                         ``on_off``, ``least_impulse`` [N s]
    ``reaction_wheel``  `ReactionWheel`  ``axis``; optional: ``frame``, ``name``,
                                         and either ``inertia`` [kg m^2] with
                                         ``max_speed`` [rad/s], or ``momentum``
                                         [N m s]
    ==================  ===============  =========================================

    Every type also accepts ``max`` and ``min`` [N m | N], the largest and the smallest value of the
    input. For base inputs, each limit is one number, or three numbers. If ``min`` is omitted, it is
    -max, or 0 for a thruster. With ``on_off = true``, a thruster fires in pulses of ``max``.

    Parameters
    ----------
    path : str or Path
        Path of the file, or the name of a bundled file: ``"cubesat"`` or ``"servicer_7dof"``.

    Returns
    -------
    tuple of Input

    Raises
    ------
    FileError
        If the path is not a regular file, or the file cannot be read or is too large.
    UnknownNameError
        If a type or key is unknown; the message names the file and line.
    InputError
        If the file is not TOML, a key is missing or a value is wrong; the message names the file
        and line.

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

    gives the inputs
    ``(JointTorque("joint_1"), Thruster("base", (-0.9, 0, 0.65), (1, 0, 0), "nozzle"))``.

    >>> inputs = fflin.load_inputs("cubesat")  # bundled
    >>> len(inputs), inputs[-1].name
    (15, 'wheel_z')
    """
    document = TomlFile(find_inputs(path))
    check_keys(document)
    return read_inputs(document)


def check_keys(document: TomlFile) -> None:
    """Raise `UnknownNameError` if a file of inputs or a robot file has an unknown key."""
    for key in document.record:
        if key not in KEYS:
            raise document.error(unknown("key of a robot file", key, KEYS), key)


def read_inputs(document: TomlFile) -> tuple[Input, ...]:
    """Return the inputs of a file; see `load_inputs`."""
    inputs: list[Input] = []
    for index, table in enumerate(_tables(document, "input")):
        kind, values = str(table.get("type")), {**table}
        if "type" not in table:
            problem = f"input {index + 1}: the key 'type' is missing; set 'type' to one of "
            raise document.error(problem + ", ".join(_TYPES), "input", index)
        if kind not in _TYPES:
            problem = f"input {index + 1}: no valid 'type': {unknown('type', kind, _TYPES)}"
            raise document.error(UnknownNameError(problem), "input", index, "type")
        del values["type"]
        inputs.append(_built(document, ("input", index), _TYPES[kind], values))
    if not inputs:
        message = "the file contains no inputs; add a table [[input]] with its type"
        raise InputError(f"{document.path}: {message}")
    return tuple(inputs)


def _read_appendages(document: TomlFile) -> list[Appendage]:
    found: list[Appendage] = []
    for key, make, special in (
        ("flexible", FlexibleAppendage, FlexibleAppendage.from_nastran),
        ("slosh", Slosh, Slosh.cylinder),
    ):
        # These keys are valid only for a Nastran file, or only for a cylinder.
        alone = set(signature(special).parameters) - set(signature(make).parameters)
        for index, table in enumerate(_tables(document, key)):
            values = {**table}
            for name in {"op4", "asm"} & set(values):
                values[name] = document.path.parent / str(values[name])
            build: Callable[..., Appendage] = special if alone & set(values) else make
            found.append(_built(document, (key, index), build, values))
    return found


def _tables(document: TomlFile, key: str) -> list[dict[str, object]]:
    """Return an array of tables of a file, empty if there is none."""
    tables = document.record.get(key, [])
    if not isinstance(tables, list) or not all(isinstance(x, dict) for x in tables):
        raise document.error(f"{key} is not an array of tables; write [[{key}]]", key)
    return tables


def _built(
    document: TomlFile, table: tuple[str, int], build: Callable[..., T], values: dict[str, object]
) -> T:
    """Build an object from a table; errors begin with file and line."""
    of, parameters = f"{table[0]} {table[1] + 1}: ", dict(signature(build).parameters)
    if isinstance(name := values.get("name"), str):
        of = of.replace(":", f" ('{name}'):")
    if build is FlexibleAppendage:  # these parameters come only from Nastran files
        del parameters["inertia"], parameters["rigid"]
    for name in values:
        if name not in parameters:
            problem = f"{of}{unknown(f'key of {table[0]}', name, parameters)}"
            raise document.error(UnknownNameError(problem), *table, name)
    for name, parameter in parameters.items():
        if parameter.default is parameter.empty and name not in values:
            raise document.error(f"{of}the key '{name}' is missing; add this key", *table)
    with document.located(*table, of=of):
        return build(**values)
