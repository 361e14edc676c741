"""Trajectory files, also from other programs: npz, mat and json by entries, csv by columns.

The last column of a .csv file that fflin writes is ``sha256``, the digest of the other columns, the
same in every row. Programs that read the file by the names of its columns are not affected.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base import record
from fflin.base.errors import FflinError, FileError, InputError, unknown
from fflin.base.record import Record, read_record, reading, text
from fflin.base.validation import Array, as_double
from fflin.base.writing import check_ending, csv_table, read_file, write_atomically
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.state import StateMap
from fflin.robot.robot import Robot

FORMATS = (*record.FORMATS, ".csv")


def write_csv(path: Path, traj: Any) -> None:
    """Write named columns, as `Trajectory.load` reads them."""
    columns = [f"{name}[{i}]" for name in "qv" for i in range(getattr(traj, name).shape[1])]
    names = ["t", *columns, *Actuation(StateMap(traj.robot)).names, "hold", "frame"]
    rows = np.column_stack((traj.t, traj.q, traj.v, traj.u)).tolist()
    table = [names, *([*row, traj.hold, traj.frame] for row in rows)]
    if traj.verified:
        checksum = _digest(table)
        table = [[*names, record.CHECKSUM], *([*row, checksum] for row in table[1:])]
    write_atomically({path: csv_table(table)})


def labels(names: Sequence[str], units: Sequence[str]) -> list[str]:
    """Return the names with their units, such as ``t [s]``; none for a figure without dimension."""
    pairs = zip(names, units, strict=True)
    return [name if unit in ("", "1") else f"{name} [{unit}]" for name, unit in pairs]


def write_table(path: Path, names: Sequence[str], rows: Array) -> None:
    """Write named columns."""
    write_atomically({path: csv_table([names, *rows.tolist()])})


def read(source: Path, robot: Robot, hold: str | None, frame: str | None) -> dict[str, Any]:
    """Return the arguments of `Trajectory` from a file, see `Trajectory.load`."""
    check_ending(source, FORMATS)
    state = StateMap(robot)
    with reading(source, "trajectory"):
        table = source.suffix == ".csv"
        entries, verified = _columns(source) if table else read_record(source)
        if len(entries) == 1 and isinstance(struct := next(iter(entries.values())), dict):
            entries = struct  # of MATLAB
    try:
        entries = _entries(entries, state) if table else entries
        hold = hold or (text(entries["hold"]) if "hold" in entries else None)
        frame = frame or (text(entries["frame"]) if "frame" in entries else "local")
        return arguments(entries, robot, hold, frame, verified)
    except FflinError as error:
        raise type(error)(f"{source}: {error}") from None


def arguments(
    entries: Record, robot: Robot, hold: str | None, frame: Any, verified: bool
) -> dict[str, Any]:
    """Return the arguments of `Trajectory` from named entries: t, u, and q, v or x."""
    states = "q" in entries and "v" in entries
    if not {"t", "u"} <= {*entries} or not (states or "x" in entries):
        found = ", ".join(sorted(entries))
        raise FileError(
            f"the file has the entries {found}; expected t, u, and either x or both q and v"
        )
    reference = pin.XYZQUATToSE3(np.ravel(entries.get("placement", [0, 0, 0, 0, 0, 0, 1.0])))
    state = StateMap(robot, reference=reference, frame=frame)
    u = as_double("u", entries["u"])
    u = u[:, None] if u.ndim == 1 else u.copy()
    for columns in Actuation(state).held:
        # In the axes of the world, which those of the reference may not be.
        u[:, columns] = u[:, columns] @ reference.rotation.T
    found_as: dict[str, Any] = {"t": as_double("t", entries["t"]).ravel(), "u": u}
    found_as |= {"hold": hold, "frame": frame, "verified": verified}
    if states:
        return found_as | {name: entries[name] for name in "qv"}
    x = as_double("x", entries["x"])
    if x.ndim != 2 or x.shape[1] != state.nx:
        raise InputError(
            f"x has shape {x.shape}, expected (N, {state.nx}): a row of states for each knot"
        )
    q, v = map(np.array, zip(*map(state.to_pinocchio, x), strict=True))
    return found_as | {"q": q, "v": v}


def _digest(table: Sequence[Sequence[Any]]) -> str:
    """Return the digest of a table without its column of digests."""
    return record.content_digest({"table": csv_table(table)})


def _columns(path: Path) -> tuple[Record, bool]:
    """Return the columns of a csv by their names, as texts, and whether they are verified."""
    lines = csv.reader(io.StringIO(read_file(path, ".csv").decode("utf-8-sig"), newline=""))
    header, *rows = [[cell.strip() for cell in line] for line in lines if any(line)]
    if len({*header}) < len(header):
        raise ValueError("two of its columns have the same name")
    for number, row in enumerate(rows, 2):
        if len(row) != len(header):
            cells = f"row {number} has {len(row)} cells, the header has {len(header)}"
            raise ValueError(f"{cells}; separate them by commas")
    checksummed = header[-1] == record.CHECKSUM
    if checksummed:
        *header, _ = header
        found, rows = {row[-1] for row in rows}, [row[:-1] for row in rows]
        if found != {_digest([header, *rows])}:
            raise ValueError(
                f"{record.DAMAGED}; to read it as it is, delete the column {record.CHECKSUM}"
            )
    return dict(zip(header, zip(*rows, strict=True), strict=True)), checksummed


def _entries(columns: Record, state: StateMap) -> Record:
    """Return the entries that the named columns of a csv are."""
    rows = {name: [f"{name}[{i}]" for i in range(len(columns))] for name in "qv"}
    rows = {name: [each for each in names if each in columns] for name, names in rows.items()}
    rows = rows if any(rows.values()) else {"x": list(state.names)}
    rows["t"], inputs = ["t"], Actuation(state).names
    acting = {name: each for name in inputs for each in (f"u.{name}", name) if each in columns}
    known = [each for names in (*rows.values(), acting.values()) for each in names]
    wrong = next((name for name in columns if name not in {*known, "hold", "frame"}), None)
    if wrong is not None:
        raise unknown("state or input", wrong, dict.fromkeys((*known, *inputs)))
    missing = next((name for name in known if name not in columns), None)
    if missing is not None:
        raise unknown("column", missing, columns)
    entries: Record = {key: columns[key][0] for key in ("hold", "frame") if key in columns}
    count = len(columns["t"])
    # Of held inputs the last row may be empty.
    short = bool(acting) and not any(columns[name][-1] for name in acting.values())
    for key, names in rows.items():
        entries[key] = np.column_stack([_numbers(name, columns[name]) for name in names])
    u = np.zeros((count - short, len(inputs)))
    for name, column in acting.items():
        u[:, inputs.index(name)] = _numbers(column, columns[column][: len(u)])
    return entries | {"u": u}


def _numbers(name: str, cells: tuple[str, ...]) -> Array:
    for row, cell in enumerate(cells, 2):
        try:
            finite = math.isfinite(float(cell))
        except ValueError:
            finite = False
        if not finite:
            raise InputError(f"row {row} of column {name} is {cell!r}, expected a finite number")
    return np.array(cells, dtype=float)
