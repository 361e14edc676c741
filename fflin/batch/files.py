"""Files with arrays of many rows: npz, and HDF5 whose arrays are read on demand.

An HDF5 file has a dataset for each array and two datasets of checksums. ``chunk_sha256`` has the
checksum of each chunk of rows, whose size is the attribute ``chunk``. ``sha256`` is the checksum of
those and of all other content.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fflin.base.errors import MissingPackageError
from fflin.base.record import CHECKSUM, DAMAGED, content_digest, verify_checksum
from fflin.base.validation import Array
from fflin.base.writing import check_ending, replacing

FORMATS = (".npz", ".h5")

# From this version on HDF5 has checksums of its own metadata, without which reading a damaged file
# can crash the process.
CHECKED = ("v108", "v108")

CHUNK_CHECKSUMS = f"chunk_{CHECKSUM}"
_CHUNK_BYTES = 2**22


def check_format(path: Path) -> None:
    """Raise if the file's ending is not a known format, or h5py is needed and not installed."""
    check_ending(path, FORMATS)
    if path.suffix == ".h5":
        hdf5()


def hdf5() -> Any:
    """Return h5py, or raise `MissingPackageError`."""
    try:
        import h5py
    except ImportError:
        raise MissingPackageError(
            "HDF5 files need h5py; install it with: pip install 'fflin[fast]'"
        ) from None
    return h5py


def is_constant(array: Array) -> bool:
    """Return whether all rows of an array are one row that is stored once."""
    return array.strides[0] == 0 and array.size > 0


def write_rows(
    path: Path, arrays: Mapping[str, Array], texts: Mapping[str, str], *, checksummed: bool
) -> None:
    """Write arrays of equally many rows, and texts; with their digests where `checksummed`."""
    check_format(path)
    constants = {key: value[0] for key, value in arrays.items() if is_constant(value)}
    varying = {key: value for key, value in arrays.items() if key not in constants}
    texts = {**texts, "constant": json.dumps(list(constants))}
    with replacing(path) as (new,):
        if path.suffix == ".npz":
            plain: dict[str, Any] = {**varying, **constants, **texts}
            if checksummed:
                plain[CHECKSUM] = content_digest(plain)
            with new.open("wb") as file:
                np.savez(file, **plain)
            return
        with hdf5().File(new, "w", libver=CHECKED) as file:
            for key, value in {**varying, **constants}.items():
                file.create_dataset(key, data=value)
            file.attrs.update(texts)
            if checksummed:
                count = len(next(iter(arrays.values())))
                row = sum(value.nbytes // count for value in varying.values())
                chunk = max(1, _CHUNK_BYTES // row)
                checksums = _chunk_checksums(varying, count, chunk)
                file.create_dataset(CHUNK_CHECKSUMS, data=checksums)
                file.create_dataset(
                    CHECKSUM, data=file_checksum(texts, chunk, checksums, constants)
                )
                file.attrs["chunk"] = chunk


def chunk_checksum(arrays: Mapping[str, Array]) -> bytes:
    """Return the SHA-256 of the rows of some points."""
    return bytes.fromhex(content_digest(arrays))


def _chunk_checksums(varying: Mapping[str, Array], count: int, chunk: int) -> NDArray[np.uint8]:
    """Return the SHA-256 (chunks, 32) of the rows of each chunk."""

    def checksum(start: int) -> bytes:
        return chunk_checksum({key: value[start : start + chunk] for key, value in varying.items()})

    # hashlib releases the interpreter's lock, so that threads hash at the same time.
    with ThreadPoolExecutor() as pool:
        checksums = b"".join(pool.map(checksum, range(0, count, chunk)))
    return np.frombuffer(checksums, np.uint8).reshape(-1, 32)


def file_checksum(
    texts: Mapping[str, str], chunk: int, checksums: Any, constants: Mapping[str, Array]
) -> NDArray[np.uint8]:
    """Return the SHA-256 (32,) of a file's content, with the checksums of its chunks of rows."""
    whole = content_digest({**texts, "chunk": chunk, CHUNK_CHECKSUMS: checksums, **constants})
    return np.frombuffer(bytes.fromhex(whole), np.uint8)


def read_rows(
    path: Path, *, verify: bool
) -> tuple[dict[str, Array], list[str], dict[str, str], bool]:
    """Return arrays, which of them are of one row for all, texts, and whether they are verified."""
    with path.open("rb") as file:
        zipped = file.read(2) == b"PK"
    if not zipped and path.suffix == ".npz":
        raise ValueError("it is not a zip archive")
    arrays, texts, verified = (_from_npz if zipped else _from_hdf5)(path, verify)
    return arrays, json.loads(texts["constant"]), texts, verified


def _from_npz(path: Path, verify: bool) -> tuple[dict[str, Array], dict[str, str], bool]:
    # Opened here, since NumPy does not close a file that it finds damaged.
    with path.open("rb") as handle, np.load(handle, allow_pickle=False) as file:
        entries = {key: file[key] for key in file.files}
    verified = verify and verify_checksum(entries)
    entries.pop(CHECKSUM, None)
    texts = {key: str(entries.pop(key)) for key in list(entries) if entries[key].dtype.kind == "U"}
    return entries, texts, verified


def _from_hdf5(path: Path, verify: bool) -> tuple[dict[str, Array], dict[str, str], bool]:
    with hdf5().File(path, "r") as file:
        texts = {key: str(value) for key, value in file.attrs.items() if isinstance(value, str)}
        arrays = {key: _mapped(path, file[key]) for key in file}
        chunk = int(file.attrs.get("chunk", 0))
    checksum, checksums = arrays.pop(CHECKSUM, None), arrays.pop(CHUNK_CHECKSUMS, None)
    if checksum is None or checksums is None or not verify:
        return arrays, texts, False
    constants = {key: arrays[key] for key in json.loads(texts["constant"])}
    varying = {key: value for key, value in arrays.items() if key not in constants}
    own = {key: value for key, value in texts.items() if key != "request"}
    whole = chunk > 0 and np.array_equal(checksum, file_checksum(own, chunk, checksums, constants))
    count = len(next(iter(varying.values())))
    if not whole or not np.array_equal(checksums, _chunk_checksums(varying, count, chunk)):
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
