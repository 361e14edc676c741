"""Linear models on disk: npz, mat, json, and csv, a table for each matrix."""

from __future__ import annotations

import csv
import hashlib
import io
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fflin.base import record
from fflin.base.record import Record, figure, figures, text, texts
from fflin.base.writing import check_ending, read_file, write_whole

_MATRICES = ("A", "B", "C", "D", "M")
_VECTORS = ("f0", "x0", "u0", "y0", "q", "v", "reference")
_NAMES = (
    *("state_names", "input_names", "output_names"),
    *("state_units", "input_units", "output_units"),
)
_LISTS = (*_NAMES, "locked", "ignorable")
_LATER: Record = {"ignorable": (), "drift": ()}  # which files once had not
_TEXTS = ("frame", "robot", "urdf_sha256", "fflin_version", "pinocchio_version")
_CERTIFICATE = ("condition", "inertia_residual", "route_A", "route_B", "f0")

# Of csv, the last of which has the digest of all.
_TABLES = (*_MATRICES, "states", "inputs", "outputs", "point", "info")

FORMATS = (*record.FORMATS, ".csv")


def record_of(lin: Any) -> Record:
    """Return what a file holds of a `LinearModel`."""
    entries: Record = {key: getattr(lin, key) for key in (*_MATRICES, *_VECTORS[:-1])}
    entries["reference"] = lin.placement
    entries["drift"] = np.zeros(0) if lin.drift is None else lin.drift
    entries |= {key: list(getattr(lin, key)) for key in _LISTS}
    entries |= {key: getattr(lin, key) for key in _TEXTS}
    entries["dt"], entries["moving"] = float(lin.dt), float(lin.moving)
    entries["certificate"] = {key: getattr(lin.certificate, key) for key in _CERTIFICATE}
    return entries


def write_model(path: Path, entries: Record) -> None:
    """Write what `record_of` returns; see `LinearModel.save`."""
    check_ending(path, FORMATS)
    if path.suffix != ".csv":
        record.write_record(path, entries)
        return
    record.require_finite(entries)
    contents = {key: _csv_text(rows) for key, rows in _tables(entries).items()}
    contents["info"] += f"{record.SEAL},{_seal(contents)}\n".encode()
    write_whole({_csv_path(path, key): content for key, content in contents.items()})


def read_model(path: Path) -> tuple[dict[str, Any], dict[str, float]]:
    """Return the fields of a model, and its certificate; see `LinearModel.load`.

    Raises
    ------
    FileError
        If the file cannot be read, is damaged or is no model.
    """
    check_ending(path, FORMATS)
    with record.reading(path, "linear model"):
        entries, verified = _from_csv(path) if path.suffix == ".csv" else record.read_record(path)
        fields = _fields(_LATER | entries)
        certificate = {key: figures(entries["certificate"])[key] for key in _CERTIFICATE}
        return fields | {"verified": verified}, certificate


def _fields(entries: Record) -> dict[str, Any]:
    fields: dict[str, Any] = {key: texts(entries[key]) for key in _LISTS}
    fields |= {key: text(entries[key]) for key in _TEXTS}
    sizes = nx, nu, ny = tuple(len(fields[key]) for key in _NAMES[:3])
    for key, size in zip(_NAMES[3:], sizes, strict=True):
        _check_size(key, len(fields[key]), size)
    shapes: dict[str, tuple[int, ...]] = {"A": (nx, nx), "B": (nx, nu), "C": (ny, nx)}
    shapes |= {"D": (ny, nu), "M": (nx // 2, nx // 2)}
    for key, shape in shapes.items():
        fields[key] = _numbers(key, entries[key]).reshape(shape)
    expected = {"f0": nx, "x0": nx, "u0": nu, "y0": ny, "reference": 7}
    for key in (*_VECTORS, "drift"):
        fields[key] = _numbers(key, entries[key]).reshape(-1)
        _check_size(key, fields[key].size, expected.get(key, fields[key].size))
    if fields["frame"] not in ("hybrid", "local", "world"):
        raise ValueError(f"unknown frame '{fields['frame']}'")
    M, drift = fields.pop("M"), fields.pop("drift")
    _check_size("drift", drift.size, nx if drift.size else 0)
    M.setflags(write=False)
    return fields | {
        "dt": figure(entries["dt"]),
        "moving": bool(figure(entries["moving"])),
        "_reference": fields.pop("reference"),
        "_drift": drift if drift.size else None,
        "_inertia": partial(_given, M),
        "_ignorable": partial(_given, fields.pop("ignorable")),
    }


def _numbers(key: str, raw: Any) -> Any:
    array = np.array(raw, dtype=float)
    if not np.isfinite(array).all():
        raise ValueError(f"{key} has entries that are not finite")
    return array


def _check_size(key: str, size: int, expected: int) -> None:
    if size != expected:
        raise ValueError(f"{key} has {size} entries, expected {expected}")


def _given(value: Any, _: object) -> Any:
    return value


# One table a matrix, named on its rows and columns; one for each of the signals, with units;
# one for the point in Pinocchio's own order; and one of everything that is a single figure.


def _tables(entries: Record) -> dict[str, list[list[Any]]]:
    states, inputs, outputs = (entries[key] for key in _NAMES[:3])
    velocities = states[-len(entries["M"]) :]
    named = {
        "A": (states, states),
        "B": (states, inputs),
        "C": (outputs, states),
        "D": (outputs, inputs),
        "M": (velocities, velocities),
    }
    tables: dict[str, list[list[Any]]] = {}
    for key, (left, top) in named.items():
        body = [[name, *row] for name, row in zip(left, entries[key].tolist(), strict=True)]
        tables[key] = [["", *top], *body]
    for title, unit, vectors in (
        ("state", "state_units", ("x0", "f0")),
        ("input", "input_units", ("u0",)),
        ("output", "output_units", ("y0",)),
    ):
        columns = [
            entries[f"{title}_names"],
            entries[unit],
            *(entries[k].tolist() for k in vectors),
        ]
        rows = map(list, zip(*columns, strict=True))
        tables[f"{title}s"] = [["name", "unit", *vectors], *rows]
    point = [
        [f"{key}[{i}]", x]
        for key in ("q", "v", "reference", "drift")
        for i, x in enumerate(entries[key].tolist())
    ]
    tables["point"] = [["name", "value"], *point]
    info = {key: entries[key] for key in (*_TEXTS, "dt", "moving")}
    info |= {key: ";".join(entries[key]) for key in ("locked", "ignorable")}
    info |= {f"certificate.{key}": value for key, value in entries["certificate"].items()}
    tables["info"] = [["name", "value"], *map(list, info.items())]
    return tables


def _seal(contents: dict[str, bytes]) -> str:
    digest = hashlib.sha256()
    for key in _TABLES:
        digest.update(f"{key} {len(contents[key])}\n".encode() + contents[key])
    return digest.hexdigest()


def _from_csv(path: Path) -> tuple[Record, bool]:
    if not _csv_path(path, "info").exists() and path.exists():
        raise ValueError("a csv model is named NAME.csv, without the matrix")
    contents = {key: read_file(_csv_path(path, key), ".csv") for key in _TABLES}
    body, mark, seal = contents["info"].rpartition(f"\n{record.SEAL},".encode())
    if mark:
        contents["info"] = body + b"\n"
        if seal != f"{_seal(contents)}\n".encode():
            raise ValueError(
                f"{record.DAMAGED}; without that line of the info table it is read as it is"
            )
    tables = {
        key: list(csv.reader(io.StringIO(content.decode(), newline="")))[1:]
        for key, content in contents.items()
    }
    entries: Record = {
        key: [[float(x) for x in row[1:]] for row in tables[key]] for key in _MATRICES
    }
    for title, vectors in (("state", ("x0", "f0")), ("input", ("u0",)), ("output", ("y0",))):
        columns = list(zip(*tables[f"{title}s"], strict=True)) or [()] * (2 + len(vectors))
        entries[f"{title}_names"], entries[f"{title}_units"] = columns[:2]
        for vector, column in zip(vectors, columns[2:], strict=True):
            entries[vector] = [float(x) for x in column]
    for key in ("q", "v", "reference", "drift"):
        entries[key] = [float(x) for name, x in tables["point"] if name.startswith(f"{key}[")]
    info = dict(tables["info"])
    prefix = "certificate."
    entries["certificate"] = {
        key.removeprefix(prefix): float(x) for key, x in info.items() if key.startswith(prefix)
    }
    for key in ("locked", "ignorable"):
        entries[key] = [entry for entry in info.get(key, "").split(";") if entry]
    return {**entries, **{key: info[key] for key in (*_TEXTS, "dt", "moving")}}, bool(mark)


def _csv_path(path: Path, key: str) -> Path:
    return path.with_name(f"{path.stem}.{key}.csv")


def _csv_text(rows: list[list[Any]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()
