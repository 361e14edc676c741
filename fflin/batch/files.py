"""Batches on disk: npz, and HDF5 whose arrays are read as they are used."""

from __future__ import annotations

import json
import os
import tempfile
import zlib
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.base.errors import FileError, InputError, MissingPackageError
from fflin.base.validation import Array
from fflin.batch.linear_batch import LinearBatch, is_constant

if TYPE_CHECKING:
    from fflin.robot.robot import Robot

FORMATS = (".npz", ".h5")

# The version of HDF5 from which the file's own records have checksums: without them, a damaged
# file can take the process with it.
CHECKED = ("v108", "v108")

# Fields of a batch that are text or lists of it; they stand in the file as one JSON document.
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
    if path.suffix not in FORMATS:
        raise FileError(f"'{path}' ends in '{path.suffix}', expected one of {', '.join(FORMATS)}")
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


def header(batch: LinearBatch) -> str:
    """Return what of a batch is text, as JSON."""
    record = {key: getattr(batch, key) for key in _TEXTS}
    record["_ignorable"] = batch[0].ignorable
    return json.dumps({**record, "points": len(batch), "columns": batch._columns})


def save_batch(batch: LinearBatch, path: Path) -> None:
    """Write a batch; see `LinearBatch.save`."""
    check_format(path)
    if not len(batch):
        raise InputError("the batch has no points; there is nothing to save")
    arrays = batch._arrays()
    held = {key: value[0] if is_constant(value) else value for key, value in arrays.items()}
    constant = json.dumps([key for key, value in arrays.items() if is_constant(value)])
    texts = {"header": header(batch), "constant": constant}
    real = Path(os.path.realpath(path))
    temporary = None
    try:
        handle, name = tempfile.mkstemp(prefix=".fflin-", suffix=path.suffix, dir=real.parent)
        os.close(handle)
        temporary = Path(name)
        if path.suffix == ".npz":
            plain: dict[str, Any] = {**held, **texts}
            np.savez(temporary, **plain)
        else:
            with hdf5().File(temporary, "w", libver=CHECKED) as file:
                for key, value in held.items():
                    file.create_dataset(key, data=value)
                file.attrs.update(texts)
        os.chmod(temporary, 0o644)
        os.replace(temporary, real)
    except OSError as error:
        raise FileError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def load_batch(path: Path, robot: Robot | None = None, *, suffix: str | None = None) -> LinearBatch:
    """Read a batch; see `LinearBatch.load`. `suffix` tells the format where the name does not."""
    if suffix is None:
        check_format(path)
    try:
        arrays, texts = (_from_npz if (suffix or path.suffix) == ".npz" else _from_hdf5)(path)
        batch = _batch(arrays, json.loads(texts["header"]), json.loads(texts["constant"]), robot)
    except FileNotFoundError:
        raise FileError(f"{path}: cannot be read: No such file or directory") from None
    except InputError:
        raise
    except _UNREADABLE as error:
        raise FileError(f"{path}: not a batch saved by fflin ({error})") from None
    return batch


_UNREADABLE = (
    *(OSError, KeyError, ValueError, TypeError, IndexError, AttributeError, EOFError),
    *(OverflowError, RuntimeError, SyntaxError, zlib.error, TokenError),
)


def _from_npz(path: Path) -> tuple[dict[str, Array], dict[str, str]]:
    from zipfile import BadZipFile

    try:
        # Opened here, since NumPy leaves a damaged file open.
        with path.open("rb") as handle, np.load(handle, allow_pickle=False) as file:
            texts = {key: str(file[key]) for key in ("header", "constant")}
            return {key: file[key] for key in file.files if key not in texts}, texts
    except BadZipFile as error:
        raise ValueError(str(error)) from None


def _from_hdf5(path: Path) -> tuple[dict[str, Array], dict[str, str]]:
    with hdf5().File(path, "r") as file:
        texts = {key: str(file.attrs[key]) for key in ("header", "constant")}
        return {key: mapped(path, file[key]) for key in file}, texts


def mapped(path: Path, dataset: Any, mode: Any = "r") -> Array:
    """Return a contiguous dataset as an array that is read as it is used."""
    offset = dataset.id.get_offset()
    if offset is None or not dataset.size:
        return np.asarray(dataset[()])
    result: Array = np.memmap(
        path, dtype=dataset.dtype, mode=mode, offset=offset, shape=dataset.shape
    )
    return result


def _batch(
    arrays: dict[str, Array], record: dict[str, Any], constant: list[str], robot: Robot | None
) -> LinearBatch:
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
    if robot is not None and (robot.urdf_sha256, robot.locked, robot.joint_names) != (
        texts["urdf_sha256"],
        texts["locked"],
        tuple(name[4:] for name in texts["state_names"] if name.startswith("q_m.")),
    ):
        raise InputError(f"'{robot.name}' is not the robot that the batch is of")
    return LinearBatch(**rows, **texts, _columns=columns, _system=robot)
