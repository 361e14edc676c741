"""Linear models and trajectories on disk: npz, mat, json and csv.

A model in csv consists of several tables, for other programs. fflin does not read the tables. Each
matrix has a table with the names of the rows and columns. The states, the inputs and the outputs
have a table each. The table ``info`` contains all other entries.

A trajectory in csv is one table. If the trajectory is ``verified``, the last column contains the
same digest in every row. The digest is computed from the other columns. A digest in a separate line
would make the table unreadable for other programs.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import numpy as np
import pinocchio as pin

from fflin.base import record
from fflin.base.errors import FileError, InputError, listed, located, require_known
from fflin.base.record import Record, figure, figures, read_record, reading, text, texts
from fflin.base.validation import as_double, frozen, normalised, vector
from fflin.base.writing import (
    RECORDS,
    check_ending,
    csv_table,
    read_file,
    write_atomically,
)
from fflin.dynamics.coordinates import Frame, frame_of
from fflin.dynamics.state import Actuation, StateMap
from fflin.linear.optimality import Optimality

if TYPE_CHECKING:
    from fflin.base.validation import Array
    from fflin.linear.model import LinearModel
    from fflin.linear.trajectory import Trajectory
    from fflin.robot.robot import Robot

FORMATS = (*RECORDS, ".csv")

# Names of the residuals of a plan, in the order in which files contain them.
OPTIMALITY = tuple(item.name for item in fields(Optimality))

_SIGNALS = ("state", "input", "output")
# Arrays of a model in a file: {field: which names label each dimension}.
_ARRAYS: dict[str, tuple[str, ...]] = {
    "A": ("state", "state"),
    "B": ("state", "input"),
    "C": ("output", "state"),
    "D": ("output", "input"),
    "M": ("velocity", "velocity"),
    "x0": ("state",),
    "f0": ("state",),
    "u0": ("input",),
    "y0": ("output",),
    "q": ("coordinate",),
    "v": ("coordinate",),
    "reference": ("placement",),
    "drift": ("drift",),
    "limits": ("limit",),
    "delay": ("late",),
    "lag": ("late",),
    "output_lag": ("sensed",),
}
_NAMES = [f"{signal}_{field}" for field in ("names", "units") for signal in _SIGNALS]
_LISTS = (*_NAMES, "locked", "ignorable", "wheels", "limit_names", "added", "dependent")
# Lists and arrays that files of earlier versions lack.
_OPTIONAL = ("wheels", "added", "dependent", "delay", "lag", "output_lag")
_TEXTS = (
    "frame",
    "robot",
    "urdf_sha256",
    "fflin_version",
    "pinocchio_version",
    "weights",
)
_FIGURES = ("dt", "moving", "mean_motion")

_MATRICES = [key for key, dimensions in _ARRAYS.items() if len(dimensions) == 2]

T = TypeVar("T")


def record_of(lin: LinearModel) -> Record:
    """Return the entries of a model's file as {name: value}."""
    entries: Record = {
        "reference": lin.placement,
        "drift": np.zeros(0) if lin.drift is None else lin.drift,
        "limits": np.array(list(lin.limits.values())),
        "limit_names": list(lin.limits),
        "weights": json.dumps(dict(lin.weights)),
        "certificate": asdict(lin.certificate),
    }
    for key in (*_ARRAYS, *_LISTS, *_TEXTS, *_FIGURES):
        if key not in entries:
            value = getattr(lin, key)
            entries[key] = list(value) if key in _LISTS else value
    if lin.t is not None:
        entries["t"] = float(lin.t)
    return entries | {key: float(entries[key]) for key in _FIGURES}


def write_model(path: Path, entries: Record, *, checksummed: bool) -> None:
    """Write the entries of a model to a file; see `LinearModel.save`.

    If `checksummed` is True, the file also contains the digest of the entries, except in csv.
    """
    check_ending(path, FORMATS)
    if path.suffix != ".csv":
        record.write_record(path, entries, checksummed=checksummed)
        return
    record.require_finite(entries)
    names = {signal: entries[f"{signal}_names"] for signal in _SIGNALS}
    robot_states = names["state"][: len(names["state"]) - len(entries["added"])]
    names["velocity"] = robot_states[-len(entries["M"]) :]
    rest, tables = dict(entries), dict[str, list[list[object]]]()
    for key in _MATRICES:
        rows, columns = (names[dimension] for dimension in _ARRAYS[key])
        body = zip(rows, rest.pop(key).tolist(), strict=True)
        tables[key] = [["", *columns], *([name, *row] for name, row in body)]
    for signal in _SIGNALS:
        vectors = [
            key for key, dimensions in _ARRAYS.items() if dimensions == (signal,)
        ]
        keys = (f"{signal}_names", f"{signal}_units", *vectors)
        columns = [np.asarray(rest.pop(key)).tolist() for key in keys]
        lines = zip(*columns, strict=True)
        tables[f"{signal}s"] = [["name", "unit", *vectors], *map(list, lines)]
    tables["info"] = [["name", "value"]]
    for key, value in rest.items():
        plain = (
            value
            if key in (*_TEXTS, *_FIGURES, "t")
            else json.dumps(np.asarray(value).tolist())
        )
        tables["info"].append([key, plain])
    write_atomically(
        {_csv_path(path, key): csv_table(rows) for key, rows in tables.items()}
    )


def read_model(
    path: Path, certificate: Callable[..., T]
) -> tuple[dict[str, object], T]:
    """Read the fields and the certificate of a model from a file; see `LinearModel.load`."""
    with reading(path, "linear model"):
        entries, verified = read_record(path)
        lists = [key for key in _LISTS if key in entries or key not in _OPTIONAL]
        fields: dict[str, Any] = {key: texts(entries[key]) for key in lists}
        if "wheels" in fields:
            fields["_wheels"] = partial(given, fields.pop("wheels"))
        fields |= {key: text(entries[key]) for key in _TEXTS}
        fields |= {key: figure(entries[key]) for key in _FIGURES}
        if "t" in entries:
            fields["t"] = figure(entries["t"])
        if fields["frame"] not in get_args(Frame):
            raise ValueError(f"unknown frame '{fields['frame']}'")
        sizes = {signal: len(fields[f"{signal}_names"]) for signal in _SIGNALS}
        velocities = (sizes["state"] - len(fields.get("added", ()))) // 2
        sizes |= {"velocity": velocities, "coordinate": -1, "placement": 7}
        sizes["drift"] = sizes["state"] if np.size(entries["drift"]) else 0
        sizes["late"] = sizes["input"]
        sizes["sensed"] = sizes["output"]
        sizes["limit"] = len(limit_names := fields.pop("limit_names"))
        for key, dimensions in _ARRAYS.items():
            if key in _OPTIONAL and key not in entries:
                continue
            array = np.array(entries[key], dtype=float)
            if not np.isfinite(array).all():
                raise ValueError(f"{key} has entries that are not finite")
            fields[key] = frozen(
                array.reshape([sizes[dimension] for dimension in dimensions])
            )
        fields["weights"] = weights = json.loads(fields["weights"])
        if not isinstance(weights, dict) or not all(
            isinstance(x, dict | str) for x in weights.values()
        ):
            raise ValueError("its weights are not a table")
        drift, limits = fields.pop("drift"), fields.pop("limits").tolist()
        delays = fields.pop("delay", np.zeros(0))
        if delays.any():
            fields["_delays"] = tuple(delays.tolist())
        lags = fields.pop("lag", np.zeros(0))
        if lags.any():
            fields["_lags"] = tuple(lags.tolist())
        output_lags = fields.pop("output_lag", np.zeros(0))
        if output_lags.any():
            fields["_output_lags"] = tuple(output_lags.tolist())
        fields |= {
            "moving": bool(fields["moving"]),
            "verified": verified,
            "placement": frozen(record.unit_pose(fields.pop("reference"))),
            "drift": drift if drift.size else None,
            "_inertia": partial(given, fields.pop("M")),
            "_ignorable": partial(given, fields.pop("ignorable")),
            "_limits": partial(dict, dict(zip(limit_names, limits, strict=True))),
        }
        record.require_possible(fields)
        return fields, certificate(**figures(entries["certificate"]))


def given(value: T, _: object) -> T:
    """Return `value`; `partial(given, value)` replaces a function that computes it from a model."""
    return value


def foreign_table(path: Path) -> Path | None:
    """Return a file that saving a model would overwrite, although the file contains no model.

    `path` is the path NAME.csv to which the model is to be saved. Return None if no such file
    exists.
    """
    info = _csv_path(path, "info")
    if info.is_file() and b"\nurdf_sha256," in info.read_bytes():
        return None
    keys = (*_MATRICES, *(f"{signal}s" for signal in _SIGNALS), "info")
    tables = [_csv_path(path, key) for key in keys]
    return next(
        (table for table in tables if table.is_file() and table.stat().st_size), None
    )


def _csv_path(path: Path, key: str) -> Path:
    return path.with_name(f"{path.stem}.{key}.csv")


def write_csv(path: Path, traj: Trajectory) -> None:
    """Write a trajectory as a csv table with named columns, for `Trajectory.load`."""
    names = [*trajectory_columns(traj), "hold", "frame"]
    constants: list[object] = [traj.hold, traj.frame]
    if traj.optimality is not None:
        names += OPTIMALITY
        constants += astuple(traj.optimality)
    rows = np.column_stack((traj.t, traj.q, traj.v, traj.u)).tolist()
    table = [names, *([*row, *constants] for row in rows)]
    content = csv_table(table)
    if traj.verified:
        digest = record.content_digest({"table": content})
        content = csv_table(
            [[*names, record.CHECKSUM], *([*row, digest] for row in table[1:])]
        )
    write_atomically({path: content})


def trajectory_columns(traj: Trajectory) -> list[str]:
    """Return the names of the columns t, q, v and u of a trajectory."""
    columns = [
        f"{name}[{i}]" for name in "qv" for i in range(getattr(traj, name).shape[1])
    ]
    return ["t", *columns, *Actuation(StateMap(traj.robot)).names]


def labels(names: Sequence[str], units: Sequence[str]) -> list[str]:
    """Return names with units, such as ``t [s]``; a dimensionless signal gets no unit."""
    pairs = zip(names, units, strict=True)
    return [name if unit in ("", "1") else f"{name} [{unit}]" for name, unit in pairs]


def write_table(path: Path, names: Sequence[str], rows: Array) -> None:
    """Write rows as a csv table with named columns."""
    write_atomically({path: csv_table([names, *rows.tolist()])})


def read(
    source: Path, robot: Robot, hold: str | None, frame: str | None
) -> dict[str, Any]:
    """Read the arguments of `Trajectory` from a file; see `Trajectory.load`.

    If `hold` or `frame` is given, the file's value is ignored.
    """
    check_ending(source, FORMATS)
    is_table = source.suffix == ".csv"
    with reading(source, "trajectory"):
        if is_table:
            state = StateMap(robot)
            signal_names = {*state.names, *Actuation(state).names}
            entries, verified = _columns(source, signal_names)
        else:
            entries, verified = read_record(source)
        # A .mat file may contain a single struct, whose fields are the entries.
        if len(entries) == 1:
            (entry,) = entries.values()
            if isinstance(entry, dict):
                entries = entry
    with located(str(source)):
        if is_table:
            entries = _entries(entries, robot)
        if not hold:
            hold = text(entries["hold"]) if "hold" in entries else None
        if not frame:
            frame = text(entries.get("frame", "local"))
        return arguments(entries, robot, hold, frame, verified)


def arguments(
    entries: Record, robot: Robot, hold: str | None, frame: str, verified: bool
) -> dict[str, Any]:
    """Return the arguments of `Trajectory` from the entries of a file.

    The file must contain t, u, and either x or both q and v.
    """
    states = "q" in entries and "v" in entries
    if not {"t", "u"} <= {*entries} or not (states or "x" in entries):
        entry_names = ", ".join(sorted(entries))
        raise FileError(
            f"the file has the entries {entry_names}; expected t, u, and either x or both q and v"
        )
    t = as_double("t", entries["t"]).ravel()
    pose = as_double("placement", entries.get("placement", [0, 0, 0, 0, 0, 0, 1.0]))
    pose = vector(
        "placement", pose.ravel(), 7, "a position and a quaternion x, y, z, w"
    )
    quaternion = normalised("the quaternion placement[3:7]", pose[3:])
    reference = pin.XYZQUATToSE3(np.concatenate((pose[:3], quaternion)))
    state = StateMap(robot, reference=reference, frame=frame_of(robot, frame))
    actuation, u = Actuation(state), as_double("u", entries["u"])
    if u.ndim == 1:
        u = u[:, None]
    if u.ndim != 2:
        raise InputError(
            f"u has shape {u.shape}, expected one row of inputs for each knot"
        )
    names = actuation.names
    file_names = texts(entries.get("input_names", actuation.names))
    if names != file_names or u.shape[-1] != len(names):
        lacking, other = (
            [n for n in a if n not in b]
            for a, b in ((names, file_names), (file_names, names))
        )
        details = ""
        if lacking:
            details += f"; it lacks the inputs {listed(lacking)}"
        if other:
            details += f"; it has the other inputs {listed(other)}"
        raise InputError(
            f"the file has {u.shape[-1]} inputs, expected one for each input of the robot, in the "
            f"order {listed(names)}{details}; load the robot with the inputs of the trajectory "
            "(--inputs)"
        )
    for columns in actuation.held:
        # Rotate base torques and forces from reference axes to world axes.
        u[:, columns] = u[:, columns] @ reference.rotation.T
    found_as: dict[str, object] = {"t": t, "u": u}
    found_as |= {"hold": hold, "frame": frame, "verified": verified}
    if "optimality" in entries:
        found_as["_optimality"] = _optimality(entries["optimality"])
    if states:
        return found_as | {name: entries[name] for name in "qv"}
    x = as_double("x", entries["x"])
    if x.ndim != 2 or x.shape[1] != state.nx:
        raise InputError(
            f"x has shape {x.shape}, expected (N, {state.nx}): a row of states for each knot"
        )
    _, q, v = state.points(x)
    return found_as | {"q": q, "v": v}


def _optimality(entry: object) -> Optimality:
    """Return the residuals of a plan from the entry of a file."""
    values = as_double("optimality", entry).ravel()
    checked = vector("optimality", values, len(OPTIMALITY), ", ".join(OPTIMALITY))
    effort, stationarity, feasibility, complementarity, iterations = checked.tolist()
    return Optimality(
        effort, stationarity, feasibility, complementarity, int(iterations)
    )


def _columns(path: Path, known: set[str]) -> tuple[Record, bool]:
    """Return the columns of a csv as {name: texts}, and whether their digest was verified.

    Spaces around a cell are removed, except in the names `known`.
    """
    lines = csv.reader(
        io.StringIO(read_file(path, ".csv").decode("utf-8-sig"), newline="")
    )
    names, *rows = [line for line in lines if any(line)]
    header = [name if name in known else name.strip() for name in names]
    rows = [[cell.strip() for cell in row] for row in rows]
    if len({*header}) < len(header):
        raise ValueError("two of its columns have the same name")
    for number, row in enumerate(rows, 2):
        if len(row) != len(header):
            raise ValueError(
                f"row {number} has {len(row)} cells, the header has {len(header)}"
            )
    checksummed = header[-1] == record.CHECKSUM
    if checksummed:
        _, *digests = [line.pop() for line in (header, *rows)]
        if {*digests} != {record.content_digest({"table": csv_table([header, *rows])})}:
            raise ValueError(
                f"{record.DAMAGED}; to read it as it is, delete the column {record.CHECKSUM}"
            )
    return dict(zip(header, zip(*rows, strict=True), strict=True)), checksummed


def _entries(columns: Record, robot: Robot) -> Record:
    """Convert the named columns of a csv to the entries of a trajectory."""
    if "t [s]" in columns:
        raise FileError(
            "this table contains a motion, expected a trajectory; save motion.trajectory() in "
            f"its place, or save the motion as {', '.join(RECORDS[:-1])} or {RECORDS[-1]}"
        )
    state = StateMap(robot)
    inputs = Actuation(state).names
    rows = {
        key: [name for name in columns if name.startswith(f"{key}[")] for key in "qv"
    }
    if not any(rows.values()):
        rows = {"x": list(state.names)}
    rows["t"] = ["t"]
    known = [name for names in rows.values() for name in names]
    require_known("column", known, columns)
    constants = ("hold", "frame", *OPTIMALITY)
    require_known("state or input", columns, (*known, *inputs, *constants))
    entries: Record = {
        key: columns[key][0] for key in ("hold", "frame") if key in columns
    }
    if set(OPTIMALITY) <= set(columns):
        entries["optimality"] = [
            float(_numbers(name, columns[name])[0]) for name in OPTIMALITY
        ]
    acting = [name for name in inputs if name in columns]
    # If inputs are constant between knots, the last row may lack inputs, because no input acts
    # after the last knot.
    short = bool(acting) and not any(columns[name][-1] for name in acting)
    for key, names in rows.items():
        entries[key] = np.column_stack(
            [_numbers(name, columns[name]) for name in names]
        )
    u = np.zeros((len(columns["t"]) - short, len(inputs)))
    for name in acting:
        u[:, inputs.index(name)] = _numbers(name, columns[name][: len(u)])
    return entries | {"u": u}


def _numbers(name: str, cells: tuple[str, ...]) -> Array:
    try:
        values = np.array(cells, dtype=float)
    except ValueError as error:
        raise InputError(f"column {name}: {error}; expected numbers") from None
    return vector(f"column {name}", values, len(cells), "one for each row")
