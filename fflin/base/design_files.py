"""Gains, schedules and estimators on disk: npz, mat and json, whole or not at all."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from dataclasses import MISSING, Field, fields
from pathlib import Path
from tokenize import TokenError
from typing import Any, TypeVar

import numpy as np

from fflin.base.design import Design
from fflin.base.errors import FileError, InputError
from fflin.base.writing import as_path, write_whole

FORMATS = (".npz", ".mat", ".json")

Kind = TypeVar("Kind", bound=Design)

_UNREADABLE = (
    *(KeyError, ValueError, TypeError, IndexError, AttributeError, EOFError, OverflowError),
    *(NotImplementedError, RecursionError, OSError, zlib.error, zipfile.BadZipFile, TokenError),
)


def check_design_format(path: Path) -> None:
    """Raise `FileError` where the ending of an output's name says no known format."""
    if path.suffix not in FORMATS:
        raise FileError(f"'{path}' ends in '{path.suffix}', expected one of {', '.join(FORMATS)}")


def save_design(design: Design, path: str | Path) -> None:
    """Write a frozen dataclass of arrays, names, texts and numbers; the key `kind` is its class.

    Raises
    ------
    FileError
        If the ending is no known one or the file cannot be written.
    InputError
        If a figure is not finite.
    """
    target = as_path(path)
    check_design_format(target)
    record: dict[str, Any] = {"kind": type(design).__name__}
    for field in fields(design):
        value = getattr(design, field.name)
        if isinstance(value, np.ndarray | float) and not np.isfinite(value).all():
            raise InputError(f"{field.name} has entries that are not finite; it is not saved")
        record[field.name] = list(value) if isinstance(value, tuple) else value
    write_whole({target: {".npz": _npz, ".mat": _mat, ".json": _json}[target.suffix](record)})


def load_design(cls: type[Kind], path: str | Path) -> Kind:
    """Read what `save_design` wrote.

    Raises
    ------
    FileError
        If the file cannot be read or is another thing.
    """
    source = as_path(path)
    check_design_format(source)
    reader = {".npz": _from_npz, ".mat": _from_mat, ".json": _from_json}[source.suffix]
    name = cls.__name__
    try:
        content = source.read_bytes()
    except OSError as error:
        raise FileError(f"{source}: cannot be read: {error.strerror or error}") from None
    try:
        record = reader(content)
        if _text(record["kind"]) != name:
            raise ValueError(f"it is a {_text(record['kind'])}")
        # What has a default came later than some files.
        told = [f for f in fields(cls) if f.name in record or f.default_factory is MISSING]
        return cls(**{field.name: _value(cls, field, record) for field in told})
    except _UNREADABLE as error:
        raise FileError(f"{source}: not a {name} saved by fflin ({error})") from None


def _value(cls: type[Design], field: Field[Any], record: dict[str, Any]) -> Any:
    """Return a field's value; its annotation says what it is."""
    raw, kind = record[field.name], str(field.type)
    if kind == "float":
        return float(np.asarray(raw).item())
    if kind == "str":
        return _text(raw)
    if kind.startswith("tuple"):
        return tuple(_text(entry) for entry in raw)
    if isinstance(raw, dict):
        raw = np.array(raw["real"]) + 1j * np.array(raw["imag"])
    array = np.asarray(raw)
    if array.dtype.kind not in "fiuc" or not np.isfinite(array).all():
        raise ValueError(f"{field.name} is not an array of finite numbers")
    array = array.astype(complex if array.dtype.kind == "c" else float)
    return array.ravel() if field.name in cls.VECTORS else array


def _text(raw: Any) -> str:
    array = np.asarray(raw)
    return str(array.item()) if array.size == 1 else "".join(map(str, array.ravel()))


def _npz(record: dict[str, Any]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **record)
    return buffer.getvalue()


def _from_npz(content: bytes) -> dict[str, Any]:
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        return {key: file[key] for key in file.files}


def _mat(record: dict[str, Any]) -> bytes:
    from scipy.io import savemat

    buffer = io.BytesIO()
    cells = {k: np.array(v, dtype=object) for k, v in record.items() if isinstance(v, list)}
    savemat(buffer, {**record, **cells}, oned_as="column")
    return buffer.getvalue()


def _from_mat(content: bytes) -> dict[str, Any]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        raw = loadmat(io.BytesIO(content))
    except (MatReadError, NotImplementedError) as error:
        raise ValueError(str(error)) from None
    return {
        key: [cell[0] if cell.size else "" for cell in value.ravel()]
        if value.dtype == object
        else value
        for key, value in raw.items()
        if not key.startswith("__")
    }


def _json(record: dict[str, Any]) -> bytes:
    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray) and value.dtype.kind == "c":
            return {"real": value.real.tolist(), "imag": value.imag.tolist()}
        return value.tolist() if isinstance(value, np.ndarray) else value

    lines = (f"{json.dumps(k)}: {json.dumps(plain(v), allow_nan=False)}" for k, v in record.items())
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()


def _from_json(content: bytes) -> dict[str, Any]:
    record: dict[str, Any] = json.loads(content)
    return record
