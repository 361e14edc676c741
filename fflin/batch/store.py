"""The result of a sweep as it grows: in memory, or in a file that outlives a crash."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fflin.base.errors import FileError
from fflin.base.record import SEAL
from fflin.base.validation import Array
from fflin.base.writing import check_place, install, reason, reserve
from fflin.batch.files import CHECKED, CHUNK_SEALS, batch_seal, chunk_seal, hdf5
from fflin.batch.space import part_of


class MemoryStore:
    """Arrays in memory.

    Parameters
    ----------
    count, chunk : int
        Points, and points in a chunk.
    shapes : mapping
        Shape of each array for one point.
    """

    def __init__(self, count: int, chunk: int, shapes: Mapping[str, tuple[int, ...]]) -> None:
        self.names, self.chunk = tuple(shapes), chunk
        self.arrays = {key: np.empty((count, *shape)) for key, shape in shapes.items()}

    def finished(self, start: int, stop: int) -> bool:
        """Whether a chunk is there from before: none is."""
        return False

    def close(self) -> None:
        """Do nothing: memory needs no closing."""

    def place(self, start: int, stop: int) -> dict[str, Array]:
        """Return where the rows of a chunk are, to be written."""
        return {key: value[start:stop] for key, value in self.arrays.items()}

    def write(self, start: int, stop: int, arrays: Mapping[str, Array]) -> None:
        """Keep a finished chunk."""
        for key, rows in self.place(start, stop).items():
            if not np.may_share_memory(rows, arrays[key]):
                rows[:] = arrays[key]


class FileStore:
    """Arrays in an HDF5 file, NAME.part until it is whole.

    Their place in the file is fixed and reserved from the start, so that a crash in the middle of
    a chunk harms no other, and the disk does not fill up under it; a chunk counts as finished once
    its hash stands beside it.

    Parameters
    ----------
    path : Path
        Of the file as it will be called.
    request : str
        Hash of all that the result depends on.
    count, chunk : int
        Points, and points in a chunk.
    shapes : mapping
        Shape of each array for one point.
    constants : mapping
        Arrays that are the same at all points.
    texts : mapping
        Attributes of the file.

    Attributes
    ----------
    names : tuple of str
        Of the arrays.
    resumed : bool
        Whether a file of the same request was there.
    chunk : int
        Points in a chunk; of a file that was there its own.

    Raises
    ------
    FileError
        If the file cannot be written, or is one of another request.
    """

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
        self.path, self.part = path, part_of(path)
        self.chunk, self.names = chunk, tuple(shapes)
        self._constants, self._texts = constants, texts
        check_place(path)
        check_place(self.part)
        self.resumed = self.part.exists()
        h5py = hdf5()
        try:
            self._file = h5py.File(self.part, "r+" if self.resumed else "x", libver=CHECKED)
        except OSError as error:
            if self.resumed and "unable to lock" in str(error):
                raise FileError(f"{self.part} is in use by another run; wait for it") from None
            hint = "; remove it to begin anew" * self.resumed
            raise FileError(f"{self.part}: cannot be opened: {reason(error)}{hint}") from None
        if self.resumed:
            try:
                self._go_on(request)
            except BaseException:
                self.close()
                raise
            return
        try:
            for key, shape in shapes.items():
                _fixed(h5py, self._file, key, (count, *shape), np.float64)
            for key, value in constants.items():
                self._file.create_dataset(key, data=value)
            self._file[CHUNK_SEALS] = np.zeros((-(-count // chunk), 32), np.uint8)
            self._file[SEAL] = np.zeros(32, np.uint8)
            self._file.attrs.update({**texts, "chunk": chunk, "request": request})
            self._file.flush()
            reserve(self.part)
        except OSError as error:
            self.discard()
            raise FileError(f"{self.part}: cannot be written: {reason(error)}") from None

    def _go_on(self, request: str) -> None:
        with self._readable():
            found = self._file.attrs.get("request")
            self.chunk = int(self._file.attrs.get("chunk", self.chunk))
            if found == request:
                for key, value in self._constants.items():
                    if not np.array_equal(self._file[key][()], value):
                        raise ValueError(f"{key} is another")
                if any(self._file.attrs[key] != value for key, value in self._texts.items()):
                    raise ValueError("its names are others")
                if self._file[SEAL].shape != (32,):
                    raise ValueError("its digest is none")
        if found != request:
            raise FileError(
                f"{self.part} is what another sweep left behind; remove it, or choose another name"
            )

    @contextmanager
    def _readable(self) -> Iterator[None]:
        try:
            yield
        except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
            said = " ".join(str(error).split()).strip("'\"")
            raise FileError(f"{self.part} is damaged ({said}); remove it to begin anew") from None

    def finished(self, start: int, stop: int) -> bool:
        """Whether a chunk is there, and is what was written."""
        with self._readable():
            kept = self._file[CHUNK_SEALS][start // self.chunk]
            return bool(kept.any()) and kept.tobytes() == chunk_seal(
                {key: self._file[key][start:stop] for key in self.names}
            )

    def place(self, start: int, stop: int) -> None:
        """Return where the rows of a chunk are, to be written: nowhere in memory."""

    def write(self, start: int, stop: int, arrays: Mapping[str, Array]) -> None:
        """Keep a finished chunk."""
        try:
            for key in self.names:
                self._file[key][start:stop] = arrays[key]
            self._file.flush()
            seal = chunk_seal({key: arrays[key] for key in self.names})
            self._file[CHUNK_SEALS][start // self.chunk] = np.frombuffer(seal, np.uint8)
            self._file.flush()
        except OSError as error:
            raise FileError(f"{self.part}: cannot be written: {reason(error)}") from None

    def complete(self, *, keep_name: bool) -> None:
        """Add the hash of all and, unless the name is to be kept, take the target's place."""
        try:
            seals = self._file[CHUNK_SEALS][:]
            self._file[SEAL][:] = batch_seal(self._texts, self.chunk, seals, self._constants)
            self._file.close()
            if not keep_name:
                install(self.part, self.path)
        except FileError:
            raise
        except OSError as error:
            raise FileError(f"{self.path}: cannot be written: {reason(error)}") from None

    def discard(self) -> None:
        """Leave nothing behind."""
        self.close()
        self.part.unlink(missing_ok=True)

    def close(self) -> None:
        """Leave what there is for another run."""
        self._file.close()


def _fixed(h5py: Any, file: Any, name: str, shape: tuple[int, ...], dtype: Any) -> None:
    """Create a dataset whose place in the file is settled and that is not filled."""
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_layout(h5py.h5d.CONTIGUOUS)
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    properties.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    kind = h5py.h5t.py_create(np.dtype(dtype), logical=True)
    space = h5py.h5s.create_simple(shape)
    h5py.h5d.create(file.id, name.encode(), kind, space, properties)
