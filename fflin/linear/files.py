"""Linear models on disk: npz, mat, json and csv, exact to the last bit, whole or not at all."""

import csv
import io
import json
import os
import zlib
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from fflin.base.errors import FileError, InputError
from fflin.base.writing import write_whole
from fflin.linear.model import Certificate, LinearModel

_MATRICES = ("A", "B", "C", "D", "M")
_VECTORS = ("f0", "x0", "u0", "y0", "q", "v", "reference")
_NAMES = (
    *("state_names", "input_names", "output_names"),
    *("state_units", "input_units", "output_units"),
)
_FIELDS = (*_NAMES, "locked")
_LISTS = (*_FIELDS, "ignorable")
_LATER: dict[str, Any] = {"ignorable": (), "drift": ()}  # which files once had not
_TEXTS = ("frame", "robot", "urdf_sha256", "fflin_version", "pinocchio_version")

FORMATS = (".npz", ".mat", ".json", ".csv")


def save_model(lin: LinearModel, path: Path, spare: Path | None = None) -> None:
    """Write a model and its certificate; see `LinearModel.save`.

    `spare` is a file that must not be overwritten, such as the robot's own.
    """
    check_format(path)
    if not all(np.isfinite(getattr(lin, key)).all() for key in (*_MATRICES, *_VECTORS[:-1])):
        raise InputError("the model has entries that are not finite; it is not saved")
    record: dict[str, Any] = {key: getattr(lin, key) for key in (*_MATRICES, *_VECTORS[:-1])}
    record["reference"] = lin._reference
    record["drift"] = np.zeros(0) if lin._drift is None else lin._drift
    record |= {key: list(getattr(lin, key)) for key in _LISTS}
    record |= {key: getattr(lin, key) for key in _TEXTS}
    record["dt"], record["moving"] = float(lin.dt), float(lin.moving)
    record["certificate"] = asdict(lin.certificate)
    encode: Callable[[Path, dict[str, Any]], dict[Path, bytes]] = {
        ".npz": _to_npz,
        ".mat": _to_mat,
        ".json": _to_json,
        ".csv": _to_csv,
    }[path.suffix]
    contents = encode(path, record)
    for target in contents:
        if spare and os.path.exists(spare) and os.path.realpath(target) == os.path.realpath(spare):
            raise FileError(f"{target} is the robot's own file; name another to write")
    write_whole(contents)


def load_model(path: Path) -> LinearModel:
    """Read a model that `save_model` wrote; see `LinearModel.load`."""
    check_format(path)
    decode = {".npz": _from_npz, ".mat": _from_mat, ".json": _from_json, ".csv": _from_csv}
    try:
        record = _LATER | decode[path.suffix](path)
        arrays = {key: np.array(record[key], dtype=float) for key in _VECTORS}
        sizes = {key: len(record[key]) for key in _NAMES[:3]}
        nx, nu, ny = sizes.values()
        for key, shape in zip("ABCD", ((nx, nx), (nx, nu), (ny, nx), (ny, nu)), strict=True):
            arrays[key] = np.array(record[key], dtype=float).reshape(shape)
        M = np.array(record["M"], dtype=float)
        M.setflags(write=False)
        reference = arrays.pop("reference")
        drift = np.array(record["drift"], dtype=float)
        ignorable = tuple(map(str, record["ignorable"]))
        named: dict[str, Any] = {key: tuple(map(str, record[key])) for key in _FIELDS}
        named |= {key: str(record[key]) for key in _TEXTS} | arrays
        _check_sizes(arrays, M, reference, drift, named)
        lin = LinearModel(
            **named,
            dt=float(record["dt"]),
            moving=bool(float(record["moving"])),
            _reference=reference,
            _inertia=partial(_given, M),
            _certify=partial(_given, None),
            _ignorable=partial(_given, ignorable),
            _drift=drift if drift.size else None,
        )
        certificate = Certificate(**{k: float(x) for k, x in record["certificate"].items()})
        return replace(lin, _certify=partial(_certified, certificate, lin.fingerprint))
    except FileNotFoundError:
        hint = "; a csv model is named NAME.csv, without the matrix" * (path.suffix == ".csv")
        raise FileError(f"{path}: cannot be read: No such file or directory{hint}") from None
    except OSError as error:
        raise FileError(f"{path}: cannot be read: {error.strerror or error}") from None
    except _UNREADABLE as error:
        raise FileError(f"{path}: not a linear model saved by fflin ({error})") from None


# What decoders raise at files that are not theirs, or are damaged.
_UNREADABLE = (
    *(KeyError, ValueError, TypeError, IndexError, AttributeError, EOFError, OverflowError),
    *(NotImplementedError, RecursionError, zlib.error, TokenError),
)


def _check_sizes(
    arrays: dict[str, Any], M: Any, reference: Any, drift: Any, named: dict[str, Any]
) -> None:
    nx, nu, ny = (len(named[key]) for key in _NAMES[:3])
    expected = {"f0": nx, "x0": nx, "u0": nu, "y0": ny}
    for key, size in expected.items():
        if arrays[key].shape != (size,):
            raise ValueError(f"{key} has shape {arrays[key].shape}, expected ({size},)")
    for key, size in zip(_NAMES[3:], (nx, nu, ny), strict=True):
        if len(named[key]) != size:
            raise ValueError(f"{key} has {len(named[key])} entries, expected {size}")
    if M.shape != (nx // 2, nx // 2) or reference.shape != (7,) or drift.shape not in ((0,), (nx,)):
        raise ValueError("M, the reference or the drift has a wrong shape")
    if named["frame"] not in ("hybrid", "local", "world"):
        raise ValueError(f"unknown frame '{named['frame']}'")
    if not all(np.isfinite(array).all() for array in (*arrays.values(), M, reference, drift)):
        raise ValueError("an entry is not finite")


def _given(value: Any, _: LinearModel) -> Any:
    return value


def _certified(certificate: Certificate, fingerprint: str, lin: LinearModel) -> Certificate:
    lin.require(fingerprint)
    return certificate


def check_format(path: Path) -> None:
    """Raise `FileError` where the ending of an output's name says no known format."""
    if path.suffix not in FORMATS:
        raise FileError(f"'{path}' ends in '{path.suffix}', expected one of {', '.join(FORMATS)}")


def _to_npz(path: Path, record: dict[str, Any]) -> dict[Path, bytes]:
    buffer = io.BytesIO()
    np.savez(buffer, **{**record, "certificate": json.dumps(record["certificate"])})
    return {path: buffer.getvalue()}


def _from_npz(path: Path) -> dict[str, Any]:
    from zipfile import BadZipFile

    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            record = {key: file[key] for key in file.files}
    except BadZipFile as error:
        raise ValueError(str(error)) from None
    for key in _LISTS:
        record[key] = record.get(key, np.zeros(0)).tolist()
    return {**record, "certificate": json.loads(str(record["certificate"]))}


def _to_mat(path: Path, record: dict[str, Any]) -> dict[Path, bytes]:
    from scipy.io import savemat

    buffer = io.BytesIO()
    cells = {key: np.array(record[key], dtype=object) for key in _LISTS}
    savemat(buffer, {**record, **cells}, oned_as="column")
    return {path: buffer.getvalue()}


def _from_mat(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        raw = loadmat(io.BytesIO(path.read_bytes()))
    except (MatReadError, NotImplementedError) as error:
        raise ValueError(str(error)) from None
    record: dict[str, Any] = {key: raw[key] for key in _MATRICES}
    record |= {key: raw[key].ravel() for key in (*_VECTORS, "drift") if key in raw}
    record |= {key: [str(cell[0]) for cell in raw[key].ravel()] for key in _LISTS if key in raw}
    record |= {key: "".join(raw[key]) for key in _TEXTS}
    record["dt"], record["moving"] = raw["dt"].item(), raw["moving"].item()
    struct = raw["certificate"][0, 0]
    record["certificate"] = {key: struct[key].item() for key in struct.dtype.names}
    return record


def _to_json(path: Path, record: dict[str, Any]) -> dict[Path, bytes]:
    plain = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in record.items()}
    lines = ",\n".join(
        f"{json.dumps(k)}: {json.dumps(v, allow_nan=False)}" for k, v in plain.items()
    )
    return {path: f"{{\n{lines}\n}}\n".encode()}


def _from_json(path: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return record


# One table a matrix, named on its rows and columns; one for each of the signals, with units;
# one for the point in Pinocchio's own order; and one of everything that is a single figure.


def _to_csv(path: Path, record: dict[str, Any]) -> dict[Path, bytes]:
    states, inputs, outputs = (record[key] for key in _NAMES[:3])
    velocities = states[-len(record["M"]) :]
    named = {
        "A": (states, states),
        "B": (states, inputs),
        "C": (outputs, states),
        "D": (outputs, inputs),
        "M": (velocities, velocities),
    }
    tables: dict[str, list[list[Any]]] = {}
    for key, (left, top) in named.items():
        body = [[name, *row] for name, row in zip(left, record[key].tolist(), strict=True)]
        tables[key] = [["", *top], *body]
    for title, unit, vectors in (
        ("state", "state_units", ("x0", "f0")),
        ("input", "input_units", ("u0",)),
        ("output", "output_units", ("y0",)),
    ):
        columns = [record[f"{title}_names"], record[unit], *(record[k].tolist() for k in vectors)]
        rows = map(list, zip(*columns, strict=True))
        tables[f"{title}s"] = [["name", "unit", *vectors], *rows]
    point = [
        [f"{key}[{i}]", x]
        for key in ("q", "v", "reference", "drift")
        for i, x in enumerate(record[key].tolist())
    ]
    tables["point"] = [["name", "value"], *point]
    info = {key: record[key] for key in (*_TEXTS, "dt", "moving")}
    info |= {key: ";".join(record[key]) for key in ("locked", "ignorable")}
    info |= {f"certificate.{key}": value for key, value in record["certificate"].items()}
    tables["info"] = [["name", "value"], *map(list, info.items())]
    return {_csv_path(path, key): _csv_text(rows) for key, rows in tables.items()}


def _from_csv(path: Path) -> dict[str, Any]:
    record: dict[str, Any] = {}
    for key in _MATRICES:
        _, *body = _csv_rows(path, key)
        record[key] = [[float(x) for x in row[1:]] for row in body]
    for title, vectors in (("state", ("x0", "f0")), ("input", ("u0",)), ("output", ("y0",))):
        _, *body = _csv_rows(path, f"{title}s")
        columns = list(zip(*body, strict=True))
        record[f"{title}_names"], record[f"{title}_units"] = columns[:2]
        for vector, column in zip(vectors, columns[2:], strict=True):
            record[vector] = [float(x) for x in column]
    _, *body = _csv_rows(path, "point")
    for key in ("q", "v", "reference", "drift"):
        record[key] = [float(x) for name, x in body if name.startswith(f"{key}[")]
    info = dict(_csv_rows(path, "info")[1:])
    prefix = "certificate."
    record["certificate"] = {
        key.removeprefix(prefix): float(x) for key, x in info.items() if key.startswith(prefix)
    }
    for key in ("locked", "ignorable"):
        record[key] = [entry for entry in info.get(key, "").split(";") if entry]
    return {**record, **{key: info[key] for key in (*_TEXTS, "dt", "moving")}}


def _csv_path(path: Path, key: str) -> Path:
    return path.with_name(f"{path.stem}.{key}.csv")


def _csv_text(rows: list[list[Any]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


def _csv_rows(path: Path, key: str) -> list[list[str]]:
    with _csv_path(path, key).open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file))
