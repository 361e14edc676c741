"""Storage for the chunks of a sweep: in memory, or in a file from which it can resume."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fflin.base.errors import FileError, InputError
from fflin.base.record import CHECKSUM
from fflin.base.validation import Array
from fflin.base.writing import as_path, check_output_path, install, reason, reserve
from fflin.batch.files import (
    CHECKED,
    CHUNK_CHECKSUMS,
    check_format,
    chunk_checksum,
    file_checksum,
    hdf5,
)

# Allowance for what a file has besides its rows: names, constant arrays, digests [bytes].
_OVERHEAD = 2**16


class MemoryStore:
    """Arrays of `count` rows in memory, of these shapes each."""

    part = None  # there is no file

    def __init__(self, count: int, chunk: int, shapes: Mapping[str, tuple[int, ...]]) -> None:
        self.count, self.chunk, self.names = count, chunk, tuple(shapes)
        self.arrays = {key: np.empty((count, *shape)) for key, shape in shapes.items()}
        self._written: set[int] = set()

    def finished(self, start: int, stop: int) -> bool:
        """Return whether a chunk is in the file."""
        return start in self._written

    def read(self, stop: int) -> dict[str, Array]:
        """Return the rows before one."""
        return self.view(0, stop)

    def view(self, start: int, stop: int) -> dict[str, Array]:
        """Return where the rows of a chunk are, to be written."""
        return {key: value[start:stop] for key, value in self.arrays.items()}

    def write(self, start: int, stop: int, arrays: Mapping[str, Array]) -> None:
        """Keep a finished chunk."""
        for key, rows in self.view(start, stop).items():
            if not np.may_share_memory(rows, arrays[key]):
                rows[:] = arrays[key]
        self._written.add(start)

    def close(self) -> None:
        """Do nothing: memory needs no closing."""

    discard = close


class FileStore:
    """Arrays of `count` rows in an HDF5 file, NAME.part until it is whole."""

    def __init__(
        self,
        path: Path,
        request: str,
        count: int,
        chunk: int,
        shapes: Mapping[str, tuple[int, ...]],
        constants: Mapping[str, Array],
        texts: Mapping[str, str],
        what: str = "sweep",
    ) -> None:
        self.path, self.part, self.what = path, part_of(path), what
        self.count, self.chunk, self.names = count, chunk, tuple(shapes)
        self._constants, self._texts = constants, texts
        self.resumed = self.part.exists()
        try:
            mode = "r+" if self.resumed else "x"
            self._file = hdf5().File(self.part, mode, libver=CHECKED)
        except OSError as error:
            if self.resumed and "unable to lock" in str(error):
                raise FileError(
                    f"{self.part} is in use by another run; wait for it to end"
                ) from None
            hint = "; remove it to start again" * self.resumed
            raise FileError(f"{self.part}: cannot be opened: {reason(error)}{hint}") from None
        try:
            if self.resumed:
                self._go_on(request)
            else:
                self._begin(request, shapes)
        except BaseException:
            (self.close if self.resumed else self.discard)()
            raise

    def _begin(self, request: str, shapes: Mapping[str, tuple[int, ...]]) -> None:
        with self._writable():
            for key, shape in shapes.items():
                _reserve(self._file, key, (self.count, *shape))
            for key, value in self._constants.items():
                self._file.create_dataset(key, data=value)
            self._file[CHUNK_CHECKSUMS] = np.zeros((-(-self.count // self.chunk), 32), np.uint8)
            self._file[CHECKSUM] = np.zeros(32, np.uint8)
            self._file.attrs.update({**self._texts, "chunk": self.chunk, "request": request})
            self._file.flush()
            reserve(self.part)

    def _go_on(self, request: str) -> None:
        with self._readable():
            if self._file.attrs.get("request") != request:
                raise FileError(
                    f"{self.part} is the unfinished file of another {self.what}; remove it, or "
                    "choose another name"
                )
            self.chunk = int(self._file.attrs.get("chunk", self.chunk))
            for key, value in self._constants.items():
                if not np.array_equal(self._file[key][()], value):
                    raise ValueError(f"{key} differs")
            if any(self._file.attrs[key] != value for key, value in self._texts.items()):
                raise ValueError("its names differ")
            if self._file[CHECKSUM].shape != (32,):
                raise ValueError("it has no checksum")

    @contextmanager
    def _readable(self) -> Iterator[None]:
        try:
            yield
        except FileError:
            raise
        except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
            said = " ".join(str(error).split()).strip("'\"")
            raise FileError(f"{self.part} is damaged ({said}); remove it to start again") from None

    @contextmanager
    def _writable(self) -> Iterator[None]:
        try:
            yield
        except FileError:
            raise
        except OSError as error:
            raise FileError(f"{self.part}: cannot be written: {reason(error)}") from None

    def finished(self, start: int, stop: int) -> bool:
        """Return whether a chunk is in the file and matches its checksum."""
        with self._readable():
            kept = self._file[CHUNK_CHECKSUMS][start // self.chunk]
            return bool(kept.any()) and kept.tobytes() == chunk_checksum(
                {key: self._file[key][start:stop] for key in self.names}
            )

    def read(self, stop: int) -> dict[str, Array]:
        """Return the rows before one."""
        with self._readable():
            return {key: self._file[key][:stop] for key in self.names}

    def view(self, start: int, stop: int) -> None:
        """Return where the rows of a chunk are, to be written: nowhere in memory."""

    def write(self, start: int, stop: int, arrays: Mapping[str, Array]) -> None:
        """Keep a finished chunk."""
        with self._writable():
            for key in self.names:
                self._file[key][start:stop] = arrays[key]
            self._file.flush()
            checksum = chunk_checksum({key: arrays[key] for key in self.names})
            self._file[CHUNK_CHECKSUMS][start // self.chunk] = np.frombuffer(checksum, np.uint8)
            self._file.flush()

    def complete(self) -> None:
        """Add the hash of all and, where the target is HDF5 too, take its place."""
        with self._writable():
            checksums = self._file[CHUNK_CHECKSUMS][:]
            self._file[CHECKSUM][:] = file_checksum(
                self._texts, self.chunk, checksums, self._constants
            )
            self._file.close()
            if self.path.suffix == ".h5":
                install(self.part, self.path)

    def discard(self) -> None:
        """Leave nothing behind."""
        self.close()
        self.part.unlink(missing_ok=True)

    def close(self) -> None:
        """Leave what there is for another run."""
        self._file.close()


def _reserve(file: Any, name: str, shape: tuple[int, ...]) -> None:
    """Create a dataset of doubles with allocated space and without a fill value."""
    h5py = hdf5()
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_layout(h5py.h5d.CONTIGUOUS)
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    properties.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    kind, space = h5py.h5t.py_create(np.dtype(np.float64)), h5py.h5s.create_simple(shape)
    h5py.h5d.create(file.id, name.encode(), kind, space, properties)


def output_path(out: str | Path) -> Path:
    """Return where a batch can be written, or raise `FileError` or `MissingPackageError`."""
    path = as_path(out)
    check_format(path)
    check_output_path(path)
    check_output_path(part_of(path))
    return path


def part_of(path: Path) -> Path:
    """Return the path NAME.part of an unfinished result, next to the target of a link."""
    real = Path(os.path.realpath(path)) if os.path.islink(path) else path
    return real.with_name(real.name + ".part")


def check_room(count: int, size: int, path: Path | None, what: str = "points") -> None:
    """Raise if `count` points of `size` bytes in total do not fit into the file or memory."""
    said = f"{count:,} {what} need {readable(size)}"
    if path is None:
        if size > (memory := _memory()):
            raise InputError(
                f"{said}, but the machine has {readable(memory)} of memory; write them to a file "
                f"with out='NAME.h5', or choose fewer {what}"
            )
    # An unfinished file has reserved its room already.
    elif path.parent.is_dir() and not part_of(path).exists():
        # An .npz is made from the unfinished file.
        twice = path.suffix == ".npz"
        if size * (1 + twice) > (free := shutil.disk_usage(path.parent).free):
            needs = ", and writing .npz needs twice as much" * twice
            raise FileError(
                f"{said}{needs}, but only {readable(free)} are free in {path.parent}; free space, "
                f"or choose fewer {what}"
            )
        if size + _OVERHEAD > (most := _largest_file()):
            raise FileError(
                f"{said}, but files are limited to {readable(most)} (ulimit -f); raise the limit, "
                f"or choose fewer {what}"
            )


def readable(size: float) -> str:
    """Show a number of bytes."""
    for unit, scale in (("PB", 1e15), ("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if size >= scale:
            return f"{size / scale:,.1f} {unit}"
    return f"{size / 1e3:.1f} kB"


def _largest_file() -> float:
    try:
        import resource
    except ImportError:  # not on this system
        return float("inf")
    most = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return float("inf") if most == resource.RLIM_INFINITY else float(most)


def _memory() -> float:
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):  # not on this system
        return float("inf")
