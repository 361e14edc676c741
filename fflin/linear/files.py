"""Linear models on disk: npz, mat, json, and csv with a table for each matrix."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from fflin.base import record
from fflin.base.record import Record, figure, figures, text, texts
from fflin.base.writing import check_ending, csv_table, read_file, write_atomically

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from fflin.base.validation import Array

# Of what the rows and columns of each matrix are, and the entries of each vector.
_MATRICES = {
    "A": ("state", "state"),
    "B": ("state", "input"),
    "C": ("output", "state"),
    "D": ("output", "input"),
    "M": ("velocity", "velocity"),
}
_VECTORS = {"x0": "state", "f0": "state", "u0": "input", "y0": "output"}
_SIGNALS = ("state", "input", "output")
_POINT = ("q", "v", "reference", "drift", "limits")
_LISTS = (
    *(f"{signal}_{what}" for what in ("names", "units") for signal in _SIGNALS),
    *("locked", "ignorable", "limit_names"),
)
# Which older files have not.
_LATER: Record = {"ignorable": (), "drift": (), "limit_names": (), "limits": ()}
_LATER |= {"weights": "{}", "mean_motion": 0.0}
_TEXTS = ("frame", "robot", "urdf_sha256", "fflin_version", "pinocchio_version", "weights")
_FIGURES = ("dt", "moving", "mean_motion")

# Of csv, the last of which has the digest of all.
_TABLES = (*_MATRICES, *(f"{signal}s" for signal in _SIGNALS), "point", "info")

T = TypeVar("T")

FORMATS = (*record.FORMATS, ".csv")


def record_of(lin: Any) -> Record:
    """Return the entries of a file for a `LinearModel`."""
    entries: Record = {key: getattr(lin, key) for key in (*_MATRICES, *_VECTORS, "q", "v")}
    entries["reference"] = lin.placement
    entries["drift"] = np.zeros(0) if lin.drift is None else lin.drift
    entries["limits"] = np.array(list(lin.limits.values()))
    entries |= {key: list(getattr(lin, key)) for key in _LISTS[:-1]}
    entries["limit_names"] = list(lin.limits)
    entries |= {key: getattr(lin, key) for key in _TEXTS[:-1]}
    entries["weights"] = json.dumps(dict(lin.weights))
    entries |= {key: float(getattr(lin, key)) for key in _FIGURES}
    entries["certificate"] = asdict(lin.certificate)
    return entries


def write_model(path: Path, entries: Record, *, checksummed: bool) -> None:
    """Write the record of a model, with its digest if `checksummed`; see `LinearModel.save`."""
    check_ending(path, FORMATS)
    if path.suffix != ".csv":
        record.write_record(path, entries, checksummed=checksummed)
        return
    record.require_finite(entries)
    contents = {key: csv_table(rows) for key, rows in _tables(entries).items()}
    if checksummed:
        contents["info"] += f"{record.CHECKSUM},{record.content_digest(contents)}\n".encode()
    write_atomically({_csv_path(path, key): content for key, content in contents.items()})


def read_model(path: Path, certificate: Callable[..., T]) -> tuple[dict[str, Any], T]:
    """Return the fields of a model, and its certificate; see `LinearModel.load`."""
    check_ending(path, FORMATS)
    with record.reading(path, "linear model"):
        entries, verified = _from_csv(path) if path.suffix == ".csv" else record.read_record(path)
        fields = _fields(_LATER | entries)
        return fields | {"verified": verified}, certificate(**figures(entries["certificate"]))


def _fields(entries: Record) -> dict[str, Any]:
    fields: dict[str, Any] = {key: texts(entries[key]) for key in _LISTS}
    fields |= {key: text(entries[key]) for key in _TEXTS}
    if fields["frame"] not in ("hybrid", "local", "world", "lvlh", "hill"):
        raise ValueError(f"unknown frame '{fields['frame']}'")
    sizes = {signal: len(fields[f"{signal}_names"]) for signal in _SIGNALS}
    sizes["velocity"] = sizes["state"] // 2
    for signal in _SIGNALS:
        _check_size(f"{signal}_units", len(fields[f"{signal}_units"]), sizes[signal])
    for key, (rows, columns) in _MATRICES.items():
        fields[key] = _numbers(key, entries[key]).reshape(sizes[rows], sizes[columns])
    for key in (*_VECTORS, *_POINT):
        fields[key] = _numbers(key, entries[key]).reshape(-1)
    for key, signal in _VECTORS.items():
        _check_size(key, fields[key].size, sizes[signal])
    reference, drift, M = (fields.pop(key) for key in ("reference", "drift", "M"))
    names, limits = fields.pop("limit_names"), fields.pop("limits")
    _check_size("limits", limits.size, len(names))
    _check_size("reference", reference.size, 7)
    _check_size("drift", drift.size, sizes["state"] if drift.size else 0)
    M.setflags(write=False)
    return fields | {
        "dt": figure(entries["dt"]),
        "mean_motion": figure(entries["mean_motion"]),
        "moving": bool(figure(entries["moving"])),
        "weights": _weights(fields.pop("weights")),
        "_reference": reference,
        "_drift": drift if drift.size else None,
        "_inertia": partial(given, M),
        "_ignorable": partial(given, fields.pop("ignorable")),
        "_limits": partial(dict, dict(zip(names, limits.tolist(), strict=True))),
    }


def _weights(written: str) -> dict[str, Any]:
    found = json.loads(written)
    if not isinstance(found, dict) or not all(isinstance(x, dict | str) for x in found.values()):
        raise ValueError("its weights are not a table")
    return found


def _numbers(key: str, raw: ArrayLike) -> Array:
    array = np.array(raw, dtype=float)
    if not np.isfinite(array).all():
        raise ValueError(f"{key} has entries that are not finite")
    return array


def _check_size(key: str, size: int, expected: int) -> None:
    if size != expected:
        raise ValueError(f"{key} has {size} entries, expected {expected}")


def given(value: Any, _: object) -> Any:
    """Return the content of a file for any kind of model."""
    return value


# One table a matrix, named on its rows and columns; one for each of the signals, with units;
# one for the point in Pinocchio's own order; and one of everything that is a single figure.


def _tables(entries: Record) -> dict[str, list[list[Any]]]:
    names = {signal: entries[f"{signal}_names"] for signal in _SIGNALS}
    names["velocity"] = names["state"][-len(entries["M"]) :]
    tables: dict[str, list[list[Any]]] = {}
    for key, (rows, columns) in _MATRICES.items():
        body = zip(names[rows], entries[key].tolist(), strict=True)
        tables[key] = [["", *names[columns]], *([name, *row] for name, row in body)]
    for signal in _SIGNALS:
        vectors = _vectors_of(signal)
        values = (entries[key].tolist() for key in vectors)
        lines = zip(names[signal], entries[f"{signal}_units"], *values, strict=True)
        tables[f"{signal}s"] = [["name", "unit", *vectors], *map(list, lines)]
    point = [[f"{key}[{i}]", x] for key in _POINT for i, x in enumerate(entries[key].tolist())]
    tables["point"] = [["name", "value"], *point]
    info = {key: entries[key] for key in (*_TEXTS, *_FIGURES)}
    info |= {key: ";".join(entries[key]) for key in _LISTS[-3:]}
    info |= {f"certificate.{key}": value for key, value in entries["certificate"].items()}
    tables["info"] = [["name", "value"], *map(list, info.items())]
    return tables


def _vectors_of(signal: str) -> list[str]:
    return [key for key, of in _VECTORS.items() if of == signal]


def _from_csv(path: Path) -> tuple[Record, bool]:
    if not _csv_path(path, "info").exists() and path.exists():
        raise ValueError("give the name NAME.csv without the matrix, not NAME.A.csv")
    contents = {key: read_file(_csv_path(path, key), ".csv") for key in _TABLES}
    body, mark, checksum = contents["info"].rpartition(f"\n{record.CHECKSUM},".encode())
    if mark:
        contents["info"] = body + b"\n"
        if checksum != f"{record.content_digest(contents)}\n".encode():
            raise ValueError(
                f"{record.DAMAGED}; to read it as it is, delete that line of the info table"
            )
    tables = {
        key: list(csv.reader(io.StringIO(content.decode(), newline="")))[1:]
        for key, content in contents.items()
    }
    entries: Record = {
        key: [[float(x) for x in row[1:]] for row in tables[key]] for key in _MATRICES
    }
    for signal in _SIGNALS:
        keys = (f"{signal}_names", f"{signal}_units", *_vectors_of(signal))
        columns = list(zip(*tables[f"{signal}s"], strict=True)) or [()] * len(keys)
        entries |= zip(keys, columns, strict=True)
    for key in _VECTORS:
        entries[key] = [float(x) for x in entries[key]]
    for key in _POINT:
        entries[key] = [float(x) for name, x in tables["point"] if name.startswith(f"{key}[")]
    info = dict(tables["info"])
    prefix = "certificate."
    entries["certificate"] = {
        key.removeprefix(prefix): float(x) for key, x in info.items() if key.startswith(prefix)
    }
    for key in _LISTS[-3:]:
        entries[key] = [entry for entry in info.get(key, "").split(";") if entry]
    return {
        **entries,
        **{key: info[key] for key in (*_TEXTS, *_FIGURES) if key in info},
    }, bool(mark)


def _csv_path(path: Path, key: str) -> Path:
    return path.with_name(f"{path.stem}.{key}.csv")
