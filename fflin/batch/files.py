"""Batches on disk: npz, and HDF5 whose arrays are read as they are used.

An HDF5 file has a dataset for each array, ``chunk_sha256`` of the rows of so many points as its
attribute ``chunk`` says, and ``sha256`` of all else and of those.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fflin.base.errors import MissingPackageError
from fflin.base.record import DAMAGED, SEAL, check_seal, content_digest, reading
from fflin.base.validation import Array
from fflin.base.writing import check_ending, replacing

FORMATS = (".npz", ".h5")

# From this version on HDF5 has checksums of its own metadata, without which reading a damaged file
# can crash the process.
CHECKED = ("v108", "v108")

CHUNK_SEALS = f"chunk_{SEAL}"
_CHUNK_BYTES = 2**22

# Fields of a batch that are texts or lists of texts; a file has them as one JSON document.
_TEXTS = (
    *("state_names", "input_names", "output_names"),
    *("state_units", "input_units", "output_units"),
    *("frame", "moving", "robot", "urdf_sha256", "locked", "fflin_version", "pinocchio_version"),
    "_ignorable",
)
_ARRAYS = ("A", "B_lower", "C", "D", "f0", "u0", "q", "v", "_root")
_MAYBE = ("_x0", "_y0", "_reference", "_drift")


def check_format(path: Path) -> None:
    """Raise where the ending says no known format, or h5py is needed and not installed."""
    check_ending(path, FORMATS)
    if path.suffix == ".h5":
        hdf5()


def hdf5() -> Any:
    """Return h5py.

    Raises
    ------
    MissingPackageError
        If it is not installed.
    """
    try:
        import h5py
    except ImportError:
        raise MissingPackageError(
            "HDF5 files need h5py; install it with: pip install 'fflin[fast]'"
        ) from None
    return h5py


def is_constant(array: Array) -> bool:
    """Whether all rows of an array of a batch are one row, held once."""
    return array.strides[0] == 0


def header(batch: Any, count: int) -> str:
    """Return what of a `LinearBatch` of so many points is text, as JSON."""
    texts = {key: getattr(batch, key) for key in _TEXTS}
    texts["_ignorable"] = batch[0].ignorable
    return json.dumps({**texts, "points": count, "columns": batch.columns})


def write_batch(path: Path, arrays: Mapping[str, Array], header: str, *, sealed: bool) -> None:
    """Write the arrays of a batch, with their digests where `sealed`; see `LinearBatch.save`."""
    check_format(path)
    constants = {key: value[0] for key, value in arrays.items() if is_constant(value)}
    varying = {key: value for key, value in arrays.items() if key not in constants}
    texts = {"header": header, "constant": json.dumps(list(constants))}
    with replacing(path) as (new,):
        if path.suffix == ".npz":
            plain: dict[str, Any] = {**varying, **constants, **texts}
            if sealed:
                plain[SEAL] = content_digest(plain)
            with new.open("wb") as file:
                np.savez(file, **plain)
            return
        with hdf5().File(new, "w", libver=CHECKED) as file:
            for key, value in {**varying, **constants}.items():
                file.create_dataset(key, data=value)
            file.attrs.update(texts)
            if sealed:
                count = len(arrays["q"])
                row = sum(value.nbytes // count for value in varying.values())
                chunk = max(1, _CHUNK_BYTES // row)
                seals = chunk_seals(varying, count, chunk)
                file.create_dataset(CHUNK_SEALS, data=seals)
                file.create_dataset(SEAL, data=batch_seal(texts, chunk, seals, constants))
                file.attrs["chunk"] = chunk


def chunk_seal(arrays: Mapping[str, Array]) -> bytes:
    """Return the SHA-256 of the rows of some points."""
    digest = hashlib.sha256()
    for _, rows in sorted(arrays.items()):
        digest.update(np.ascontiguousarray(rows).data)
    return digest.digest()


def chunk_seals(varying: Mapping[str, Array], count: int, chunk: int) -> NDArray[np.uint8]:
    """Return the SHA-256 (chunks, 32) of the rows of each chunk."""

    def seal(start: int) -> bytes:
        return chunk_seal({key: value[start : start + chunk] for key, value in varying.items()})

    # hashlib releases the interpreter's lock, so that threads hash at the same time.
    with ThreadPoolExecutor() as pool:
        seals = b"".join(pool.map(seal, range(0, count, chunk)))
    return np.frombuffer(seals, np.uint8).reshape(-1, 32)


def batch_seal(
    texts: Mapping[str, str], chunk: int, seals: Any, constants: Mapping[str, Array]
) -> NDArray[np.uint8]:
    """Return the SHA-256 (32,) of all of a file, its rows by those of their chunks."""
    whole = content_digest({**texts, "chunk": chunk, CHUNK_SEALS: seals, **constants})
    return np.frombuffer(bytes.fromhex(whole), np.uint8)


def read_batch(path: Path, *, verify: bool = True) -> dict[str, Any]:
    """Return the fields of a batch, but for its robot; see `LinearBatch.load`."""
    with reading(path, "batch"):
        with path.open("rb") as file:
            zipped = file.read(2) == b"PK"
        if not zipped and path.suffix == ".npz":
            raise ValueError("it is no zip archive")
        arrays, texts, verified = (_from_npz if zipped else _from_hdf5)(path, verify)
        constant = json.loads(texts["constant"])
        return {**_fields(arrays, json.loads(texts["header"]), constant), "verified": verified}


def _from_npz(path: Path, verify: bool) -> tuple[dict[str, Array], dict[str, str], bool]:
    # Opened here, since NumPy does not close a file that it finds damaged.
    with path.open("rb") as handle, np.load(handle, allow_pickle=False) as file:
        entries = {key: file[key] for key in file.files}
    verified = verify and check_seal(entries)
    entries.pop(SEAL, None)
    return entries, {key: str(entries.pop(key)) for key in ("header", "constant")}, verified


def _from_hdf5(path: Path, verify: bool) -> tuple[dict[str, Array], dict[str, str], bool]:
    with hdf5().File(path, "r") as file:
        texts = {key: str(file.attrs[key]) for key in ("header", "constant")}
        arrays = {key: _mapped(path, file[key]) for key in file}
        chunk = int(file.attrs.get("chunk", 0))
    seal, seals = arrays.pop(SEAL, None), arrays.pop(CHUNK_SEALS, None)
    if seal is None or seals is None or not verify:
        return arrays, texts, False
    constants = {key: arrays[key] for key in json.loads(texts["constant"])}
    varying = {key: value for key, value in arrays.items() if key not in constants}
    whole = chunk > 0 and np.array_equal(seal, batch_seal(texts, chunk, seals, constants))
    if not whole or not np.array_equal(seals, chunk_seals(varying, len(arrays["q"]), chunk)):
        raise ValueError(DAMAGED)
    return arrays, texts, True


def _mapped(path: Path, dataset: Any) -> Array:
    """Return a contiguous dataset as an array that is read as it is used."""
    offset = dataset.id.get_offset()
    if offset is None or not dataset.size:
        return np.asarray(dataset[()])
    result: Array = np.memmap(
        path, dtype=dataset.dtype, mode="r", offset=offset, shape=dataset.shape
    )
    return result


def _fields(
    arrays: dict[str, Array], record: dict[str, Any], constant: list[str]
) -> dict[str, Any]:
    count = int(record.pop("points"))
    columns = tuple((int(first), int(second)) for first, second in record.pop("columns"))
    rows: dict[str, Any] = {}
    for key in (*_ARRAYS, *_MAYBE):
        value = arrays[key] if key in _ARRAYS else arrays.get(key)
        if key in constant and value is not None:
            value = np.broadcast_to(value, (count, *value.shape))
        if value is not None and (value.dtype != np.float64 or len(value) != count):
            raise ValueError(f"{key} has {len(value)} rows of {value.dtype}, expected {count}")
        rows[key] = value
    texts: dict[str, Any] = {
        key: tuple(value) if isinstance(value := record[key], list) else value for key in _TEXTS
    }
    nx, nu, ny = (len(texts[f"{kind}_names"]) for kind in ("state", "input", "output"))
    shapes = {"A": (nx, nx), "B_lower": (nx // 2, nu), "C": (ny, nx), "D": (ny, nu), "f0": (nx,)}
    for key, shape in shapes.items():
        if rows[key].shape[1:] != shape:
            raise ValueError(f"{key} has shape {rows[key].shape[1:]} a point, expected {shape}")
    return {**rows, **texts, "columns": columns}
