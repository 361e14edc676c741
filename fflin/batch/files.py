"""Storage of arrays with many rows: memory, .npz files, and HDF5 files that are read on demand.

An HDF5 file has one dataset per array. A file with checksums has two more datasets.
``chunk_sha256`` contains the checksum of each chunk of rows; the file attribute ``chunk`` is the
number of rows in a chunk. ``sha256`` contains one checksum of ``chunk_sha256``, ``chunk``, the
constant arrays, and all strings except ``request``.
"""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from fflin.base import writing
from fflin.base.errors import FileError, InputError, optional_package
from fflin.base.process import memory
from fflin.base.record import CHECKSUM, DAMAGED, content_digest, verify_checksum
from fflin.base.validation import Array

if TYPE_CHECKING:
    from types import ModuleType

    import h5py

FORMATS = (".npz", ".h5")

# From format version 1.8 on, HDF5 adds checksums to its own metadata. Without these checksums,
# reading a damaged file can crash the process.
CHECKED = ("v108", "v108")

CHUNK_CHECKSUMS = f"chunk_{CHECKSUM}"
_CHUNK_BYTES = 2**22

# Disk space that is reserved in an HDF5 file for names, constant arrays and checksums [bytes].
_OVERHEAD = 2**16


def hdf5() -> ModuleType:
    """Return h5py, or raise `MissingPackageError`."""
    h5py: ModuleType = optional_package("h5py", "HDF5 files need h5py", "fast")
    return h5py


def is_constant(array: Array) -> bool:
    """Return whether all rows of an array are views of one stored row."""
    return array.strides[0] == 0 and array.size > 0


def write_rows(
    path: Path,
    arrays: Mapping[str, Array],
    texts: Mapping[str, str],
    *,
    checksummed: bool,
) -> None:
    """Write `arrays`, which have equal numbers of rows, and the strings `texts` to a file.

    If `checksummed` is true, the file also contains checksums.
    """
    writing.check_ending(path, FORMATS)
    constants = {key: value[0] for key, value in arrays.items() if is_constant(value)}
    varying = {key: value for key, value in arrays.items() if key not in constants}
    texts = {**texts, "constant": json.dumps(list(constants))}
    with writing.replacing(path) as (new,):
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
                row = sum(value[:1].nbytes for value in varying.values())
                file.attrs["chunk"] = chunk = max(1, _CHUNK_BYTES // row)
                checksums = _chunk_checksums(varying, chunk)
                file.create_dataset(CHUNK_CHECKSUMS, data=checksums)
                file.create_dataset(
                    CHECKSUM, data=file_checksum(texts, chunk, checksums, constants)
                )


def _checksum(entries: Mapping[str, object]) -> NDArray[np.uint8]:
    """Return the SHA-256 digest (32,) of arrays and strings."""
    return np.frombuffer(bytes.fromhex(content_digest(entries)), np.uint8)


def _chunk_checksums(varying: Mapping[str, Array], chunk: int) -> NDArray[np.uint8]:
    """Return the SHA-256 digest of each chunk of `chunk` rows, as an array (chunks, 32)."""

    def checksum(start: int) -> NDArray[np.uint8]:
        return _checksum(
            {key: value[start : start + chunk] for key, value in varying.items()}
        )

    # hashlib releases the interpreter lock, so threads hash the chunks in parallel.
    with ThreadPoolExecutor() as pool:
        starts = range(0, len(next(iter(varying.values()))), chunk)
        return np.array(list(pool.map(checksum, starts)))


def file_checksum(
    texts: Mapping[str, str],
    chunk: int,
    checksums: object,
    constants: Mapping[str, Array],
) -> NDArray[np.uint8]:
    """Return the SHA-256 digest (32,) of the strings, chunk size, chunk digests and constants."""
    return _checksum({**texts, "chunk": chunk, CHUNK_CHECKSUMS: checksums, **constants})


def read_rows(
    path: Path, *, verify: bool
) -> tuple[dict[str, Array], list[str], dict[str, str], bool]:
    """Read a file; return its arrays, the names of its constant arrays, its strings, and a flag.

    The flag is true if the checksums were verified. All rows of a constant array are the same. Only
    one of these rows is stored, and this row is returned in place of the array.
    """
    writing.check_ending(path, FORMATS)
    if path.suffix == ".npz":
        # The file is opened here, because NumPy does not close a file that it finds damaged.
        with path.open("rb") as handle, NpzFile(handle, allow_pickle=False) as entries:
            arrays = {key: entries[key] for key in entries.files}
        verified = verify and verify_checksum(arrays)
        arrays.pop(CHECKSUM, None)
        names = [key for key, value in arrays.items() if value.dtype.kind == "U"]
        texts = {key: str(arrays.pop(key)) for key in names}
        return arrays, json.loads(texts["constant"]), texts, verified
    with hdf5().File(path, "r") as file:
        texts = {
            key: str(value)
            for key, value in file.attrs.items()
            if isinstance(value, str)
        }
        arrays = {key: _mapped(path, file[key]) for key in file}
        chunk = int(file.attrs.get("chunk", 0))
    constant = json.loads(texts["constant"])
    checksum, checksums = arrays.pop(CHECKSUM, None), arrays.pop(CHUNK_CHECKSUMS, None)
    if checksum is None or checksums is None or not verify:
        return arrays, constant, texts, False
    constants = {key: arrays[key] for key in constant}
    varying = {key: value for key, value in arrays.items() if key not in constants}
    checked_texts = {key: value for key, value in texts.items() if key != "request"}
    if not (
        chunk > 0
        and np.array_equal(
            checksum, file_checksum(checked_texts, chunk, checksums, constants)
        )
        and np.array_equal(checksums, _chunk_checksums(varying, chunk))
    ):
        raise ValueError(DAMAGED)
    return arrays, constant, texts, True


def _mapped(path: Path, dataset: h5py.Dataset) -> Array:
    """Return a dataset as an array, which is memory-mapped if the data are contiguous."""
    offset = dataset.id.get_offset()
    if offset is None or not dataset.size:
        return np.asarray(dataset[()])
    result: Array = np.memmap(
        path, dtype=dataset.dtype, mode="r", offset=offset, shape=dataset.shape
    )
    return result


class MemoryStore:
    """Arrays of `count` rows in memory."""

    part = None  # there is no file

    def __init__(
        self,
        count: int,
        chunk: int,
        shapes: Mapping[str, tuple[int, ...]],
        given: Mapping[str, Array] | None = None,
    ) -> None:
        # The arrays in `given` are not copied.
        self.count = count
        self.chunk = chunk
        self.arrays = dict(given or {})
        self._finished = set[int]()  # first rows of the finished chunks
        try:
            if 8 * count * sum(map(math.prod, shapes.values())) > memory():
                raise MemoryError
            for key, shape in shapes.items():
                if key not in self.arrays:
                    self.arrays[key] = np.empty((count, *shape))
        except (MemoryError, ValueError):
            raise InputError(
                f"{count:,} rows do not fit into memory; write them to a file with "
                "out='NAME.h5', or choose fewer"
            ) from None

    def finished(self, start: int, stop: int) -> bool:
        """Return whether a chunk has been written."""
        return start in self._finished

    def read(self, stop: int) -> dict[str, Array]:
        """Return the rows before row `stop`."""
        return self.view(0, stop, self.arrays)

    def view(self, start: int, stop: int, names: Iterable[str]) -> dict[str, Array]:
        """Return views {name: rows of a chunk}, into which a job writes its results."""
        return {key: self.arrays[key][start:stop] for key in names}

    def write(self, start: int, stop: int, arrays: Mapping[str, Array]) -> None:
        """Save the rows and results of a finished chunk."""
        for key, rows in self.view(start, stop, self.arrays).items():
            if not np.may_share_memory(rows, arrays[key]):
                rows[:] = arrays[key]
        self._finished.add(start)

    def complete(self) -> dict[str, Array]:
        """Return all arrays."""
        return self.arrays

    def close(self) -> None:
        """Do nothing, because memory needs no closing."""

    discard = close


class FileStore:
    """Arrays of `count` rows in an HDF5 file, which is named NAME.part until it is complete."""

    def __init__(
        self,
        path: Path,
        request: str,
        count: int,
        chunk: int,
        shapes: Mapping[str, tuple[int, ...]],
        constants: Mapping[str, Array],
        texts: Mapping[str, str],
    ) -> None:
        self.path = path
        self.part = part_of(path)
        self.count = count
        self._shapes, self._constants = shapes, constants
        self._texts = {**texts, "constant": json.dumps(list(constants))}
        _remove_empty(self.part)
        self.resumed = self.part.exists()
        if self.resumed:
            with self._reported():
                self._file = hdf5().File(self.part, "r+", libver=CHECKED)
            try:
                with self._reported():
                    self._begin(request, chunk)
                    _reserve(self.part, self.part.stat().st_size)
            except BaseException:
                self.close()
                raise
            return
        # The file gets its name only when it is complete but for the results, and open. So a crash
        # leaves no half-made file of this name, and of several runs only one can begin it.
        new = self.part.with_name(f".fflin-{os.urandom(8).hex()}")
        try:
            with self._reported():
                _reserve(
                    new, 8 * count * sum(map(math.prod, shapes.values())) + _OVERHEAD
                )
                self._file = hdf5().File(new, "w", libver=CHECKED)
            try:
                with self._reported():
                    self._begin(request, chunk)
                    _reserve(new, new.stat().st_size)
                    self._name(new)
            except BaseException:
                self.close()
                raise
        finally:
            new.unlink(missing_ok=True)

    def _name(self, new: Path) -> None:
        """Give the new file its name NAME.part, unless another file has this name."""
        try:
            # fails if the name exists, even as a link to nothing
            os.link(new, self.part)
        except FileExistsError:
            raise FileError(
                f"{self.part} was begun by another run at the same time; wait for that run, or "
                "choose another name"
            ) from None
        except OSError:  # a file system without links
            os.rename(new, self.part)

    def _begin(self, request: str, chunk: int) -> None:
        attributes, create = self._file.attrs, self._file.require_dataset
        if self.resumed and attributes.get("request") != request:
            raise FileError(
                f"{self.part} is the unfinished file of another call; remove it, or choose "
                "another name"
            )
        self.chunk = int(attributes.get("chunk", chunk))
        if not self.resumed:
            properties = hdf5().h5p.create(hdf5().h5p.DATASET_CREATE)
            properties.set_alloc_time(hdf5().h5d.ALLOC_TIME_EARLY)
            properties.set_fill_time(hdf5().h5d.FILL_TIME_NEVER)
            for key, shape in self._shapes.items():
                whole = (self.count, *shape)
                self._file.create_dataset(key, whole, np.float64, dcpl=properties)
        for key, value in self._constants.items():
            create(key, value.shape, value.dtype)[...] = value
        create(CHUNK_CHECKSUMS, (-(-self.count // self.chunk), 32), np.uint8)
        create(CHECKSUM, (32,), np.uint8)
        attributes.update({**self._texts, "chunk": self.chunk, "request": request})
        self._file.flush()

    @contextmanager
    def _reported(self) -> Iterator[None]:
        """Raise `FileError` instead of the errors of HDF5."""
        try:
            yield
        except FileError:
            raise
        except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
            message = f"{self.part}: cannot be read or written: {writing.reason(error)}"
            if self.resumed and getattr(error, "errno", None) == errno.ENOSPC:
                message += "; free disk space, and make the same call again"
            elif self.resumed:
                message += "; if no other run uses it, remove it to start again"
            raise FileError(message) from None

    def finished(self, start: int, stop: int) -> bool:
        """Return whether a chunk is in the file and matches its checksum."""
        with self._reported():
            kept = self._file[CHUNK_CHECKSUMS][start // self.chunk]
            rows = {
                key: self._file[key][start:stop] for key in self._shapes if kept.any()
            }
            return bool(rows) and np.array_equal(kept, _checksum(rows))

    def read(self, stop: int) -> dict[str, Array]:
        """Return the rows before row `stop`."""
        with self._reported():
            return {key: self._file[key][:stop] for key in self._shapes}

    def view(self, start: int, stop: int, names: Iterable[str]) -> dict[str, Array]:
        """Return uninitialised arrays for a chunk's results; `write` copies them to the file."""
        return {key: np.empty((stop - start, *self._shapes[key])) for key in names}

    def write(self, start: int, stop: int, arrays: Mapping[str, Array]) -> None:
        """Save the rows and results of a finished chunk."""
        with self._reported():
            for key in self._shapes:
                self._file[key][start:stop] = arrays[key]
            self._file.flush()
            checksum = _checksum({key: arrays[key] for key in self._shapes})
            self._file[CHUNK_CHECKSUMS][start // self.chunk] = checksum
            self._file.flush()

    def complete(self) -> dict[str, Array]:
        """Add the checksum of the whole file, rename the file, and return its arrays."""
        with self._reported():
            checksums = self._file[CHUNK_CHECKSUMS][:]
            self._file[CHECKSUM][:] = file_checksum(
                self._texts, self.chunk, checksums, self._constants
            )
            self._file.close()
            writing.install(self.part, self.path)
        # The run has written or verified every chunk, so the checksums are not verified again.
        return read_rows(self.path, verify=False)[0]

    def discard(self) -> None:
        """Close and delete the unfinished file."""
        self.close()
        self.part.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the unfinished file; a later run can resume from it."""
        self._file.close()


def _reserve(path: Path, size: int) -> None:
    """Reserve `size` bytes of disk space for a file.

    The space is reserved because HDF5 can crash the process if the disk is full. Systems without
    `posix_fallocate` reserve no space.
    """
    with path.open("ab") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)


def _remove_empty(part: Path) -> None:
    """Remove an unfinished file of 0 bytes, which has no results."""
    with suppress(OSError):
        if part.stat().st_size == 0:
            part.unlink()


def require_room(path: Path, size: int) -> None:
    """Raise `FileError` if less than `size` bytes of the disk are free."""
    if size > (free := shutil.disk_usage(path.parent).free):
        raise FileError(
            f"{path} needs {size / 1e6:,.1f} MB, but only {free / 1e6:,.1f} MB are free; free "
            "space, or choose fewer rows"
        )


def output_path(out: str | Path) -> Path:
    """Return the path of an output file, or raise an error if the file cannot be written."""
    path = writing.as_path(out)
    writing.check_ending(path, FORMATS)
    if path.suffix == ".h5":
        hdf5()  # raises an error if h5py is not installed
    writing.check_output_path(path)
    part = part_of(path)
    writing.check_output_path(part)
    if os.path.islink(part):
        raise FileError(
            f"{part} is a link, expected no file or an unfinished one; remove the link"
        )
    return path


def part_of(path: Path) -> Path:
    """Return the path NAME.part of an unfinished file.

    If `path` is a symbolic link, NAME is the path of its target.
    """
    real = path
    if os.path.islink(path):
        real = Path(os.path.realpath(path))
    return real.with_name(real.name + ".part")
