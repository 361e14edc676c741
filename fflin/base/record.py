"""Records on disk: named arrays, strings, lists of strings, numbers, and groups of numbers.

Models, gains, schedules, filters and motions are saved as records. Any program that reads .npz,
.mat or .json can read them. A file normally contains a SHA-256 digest. If the content does not
match the digest, the file was damaged or edited, and is refused. The formats store the digest as
follows:

- .npz: the entry ``sha256`` is the digest of the other entries;
- .json: the entry ``sha256`` is the digest of the text before it;
- .mat: the text of the header contains the digest of everything after this text. The digest is
  verified before SciPy reads the file, because SciPy can crash on a damaged file.

A file without a digest is read without this check. The result is then not ``verified``, and it is
saved without a digest.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
import warnings
import zlib
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import MISSING, Field, dataclass, field, fields
from errno import ENOMEM
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from fflin.base import writing
from fflin.base.errors import FileError, InputError, MissingPackageError
from fflin.base.process import memory
from fflin.base.validation import Array, Result, normalised

CHECKSUM = "sha256"

Record = dict[str, Any]
Kind = TypeVar("Kind", bound="Design")

DAMAGED = f"its content does not match its {CHECKSUM}: the file was damaged or edited"

_BLOCK = 2**22
_LARGEST = 1e300
_JSON_CHECKSUM = re.compile(rb',\n"sha256": "([0-9a-f]{64})"\n}\n\Z')
# A file begins with a header, whose first part is a text. _MAT_COMPRESSED is the type of compressed
# elements.
_MAT_HEADER, _MAT_COMPRESSED = 128, 15
_MAT_TEXT, _MAT_CHECKSUM = 116, b"MATLAB 5.0 MAT-file, by fflin, sha256 "
# Matches the remains of a damaged header that contained a digest.
_MAT_NEARLY = re.compile(rb"[0-9a-f]{64}|, by fflin", re.IGNORECASE)


def write_record(
    path: Path, record: Mapping[str, object], *, checksummed: bool
) -> None:
    """Write a record in the format of the path's ending, with a digest if `checksummed`."""
    writing.check_ending(path, writing.RECORDS)
    require_finite(record)
    writing.write_atomically({path: CODECS[path.suffix][0](record, checksummed)})


def read_record(path: Path) -> tuple[Record, bool]:
    """Return the record of a file, and whether its digest was verified.

    Call this function inside `reading`, which converts errors to `FileError`.
    """
    # The shape of an array may differ from the saved shape, because .mat has no vectors and .json
    # has no empty matrices.
    writing.check_ending(path, writing.RECORDS)
    return CODECS[path.suffix][1](writing.read_file(path, path.suffix))


@contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """Turn errors into `FileError` in a ``with`` block that reads a file."""
    try:
        with warnings.catch_warnings():
            # SciPy may mistake a damaged .mat file for an older format, and then warns.
            warnings.simplefilter("ignore")
            yield
    except (FileError, MissingPackageError):
        raise
    except FileNotFoundError:
        raise FileError(f"{path}: No such file{writing.missing(path)}") from None
    except Exception as error:  # each decoder raises its own types of errors
        if isinstance(error, MemoryError) or getattr(error, "errno", None) == ENOMEM:
            raise FileError(
                f"{writing.shown(path)}: does not fit into memory"
            ) from None
        why = writing.reason(error)
        raise FileError(
            f"{writing.shown(path)}: not a {what} saved by fflin ({why})"
        ) from None


def require_finite(record: Mapping[str, object]) -> None:
    """Raise `InputError` if a value is not finite."""
    for key, value in record.items():
        if isinstance(value, dict):
            require_finite({f"{name} of {key}": entry for name, entry in value.items()})
        elif isinstance(value, np.ndarray | float) and not np.isfinite(value).all():
            raise InputError(f"{key} is not finite; only finite values can be saved")


def text(value: object) -> str:
    """Return a string from a record, or raise `InputError`."""
    if isinstance(value, str):
        return value
    return str(_single(value, "a text"))


def texts(value: object) -> tuple[str, ...]:
    """Return a list of strings from a record; a single string becomes a list of one."""
    items = value.tolist() if isinstance(value, np.ndarray) else value
    if isinstance(items, list | tuple):
        return tuple(map(text, items))
    return (text(items),)


def figure(value: object) -> float:
    """Return a number from a record, or raise `InputError`."""
    single = _single(value, "a number")
    try:
        return float(single)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{value!r} is in the place of a number") from None


def _single(value: object, expected: str) -> object:
    """Return the only entry of a value from a record, or raise `InputError`."""
    try:
        return np.asarray(value).item()
    except ValueError:  # several entries, none, or rows of different lengths
        raise InputError(f"{value!r} is in the place of {expected}") from None


def figures(value: object) -> dict[str, float]:
    """Return a group of numbers {name: number} from a record."""
    group = value if isinstance(value, dict) else json.loads(text(value))
    return {key: figure(x) for key, x in group.items()}


def content_digest(entries: Mapping[str, object]) -> str:
    """Return the SHA-256 of named arrays or bytes, including their names, types and shapes.

    The formats .npz and HDF5 use this digest. Each entry is split into blocks of 4 MiB. The digests
    of these blocks are hashed in place of the bytes of the entry.
    """
    digest = hashlib.sha256()
    with ThreadPoolExecutor() as pool:
        for key, value in sorted(entries.items()):
            raw = np.frombuffer(value, "u1") if isinstance(value, bytes) else value
            array = np.asarray(raw)
            digest.update(f"{key} {array.dtype.str} {array.shape}\n".encode())
            data = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
            blocks = [data[at : at + _BLOCK] for at in range(0, len(data), _BLOCK)]
            # hashlib releases the interpreter lock, so threads hash the blocks in parallel.
            run = pool.map if len(blocks) > 1 else map
            digest.update(
                b"".join(run(lambda block: hashlib.sha256(block).digest(), blocks))
            )
    return digest.hexdigest()


def _to_npz(record: Mapping[str, object], checksummed: bool) -> bytes:
    buffer = io.BytesIO()
    groups = {
        k: json.dumps(group) for k, group in record.items() if isinstance(group, dict)
    }
    plain: dict[str, Any] = {
        key: np.asarray(value) for key, value in {**record, **groups}.items()
    }
    if checksummed:
        plain[CHECKSUM] = content_digest(plain)
    np.savez(buffer, **plain)
    return buffer.getvalue()


def _from_npz(content: bytes) -> tuple[Record, bool]:
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        _require_room(sum(entry.file_size for entry in file.zip.infolist()))
        record = {key: file[key] for key in file.files}
    # The last 22 bytes of the archive contain the number of its entries. If a damaged length field
    # hides some entries, NumPy reads fewer entries than this number.
    end = content[-22:]
    if end[:4] == b"PK\5\6" and int.from_bytes(end[10:12], "little") != len(record):
        raise ValueError(DAMAGED)
    return record, verify_checksum(record)


def verify_checksum(record: Record) -> bool:
    """Remove the digest from .npz entries and verify it; return False if there is no digest."""
    checksum = record.pop(CHECKSUM, None)
    if checksum is not None and text(checksum) != content_digest(record):
        raise ValueError(DAMAGED)
    return checksum is not None


def _to_mat(record: Mapping[str, object], checksummed: bool) -> bytes:
    from scipy.io import savemat

    buffer = io.BytesIO()
    variables = dict(record)
    for name, value in record.items():
        # An array of objects becomes a cell array.
        if isinstance(value, list):
            variables[name] = np.array(value, dtype=object)
    savemat(buffer, variables, oned_as="column")
    # MATLAB ignores the text at the start of the header. Replace the text that SciPy writes, which
    # contains the date, so that equal records give equal files. The new text has room for a
    # checksum of the rest of the file.
    body = buffer.getvalue()[_MAT_TEXT:]
    text = b"MATLAB 5.0 MAT-file"
    if checksummed:
        text = _MAT_CHECKSUM + hashlib.sha256(body).hexdigest().encode()
    return text.ljust(_MAT_TEXT) + body


def _from_mat(content: bytes) -> tuple[Record, bool]:
    from scipy.io import loadmat

    checksummed = content.startswith(_MAT_CHECKSUM)
    if checksummed:
        checksum = content[len(_MAT_CHECKSUM) : _MAT_TEXT].rstrip().decode()
        if checksum != hashlib.sha256(content[_MAT_TEXT:]).hexdigest():
            raise ValueError(DAMAGED)
    elif _MAT_NEARLY.search(content[:_MAT_TEXT]):
        raise ValueError("its header was damaged or edited")
    if content[124:128] not in (b"\0\1IM", b"\1\0MI"):
        raise ValueError(
            f"{_other_format(content)}; save it with save -v7 (MATLAB and Octave)"
        )
    _require_room(_unpacked_size(content))
    with warnings.catch_warnings():
        # SciPy 1.18 announces another type of sparse matrices, which `_of_mat` reads too.
        warnings.simplefilter("ignore", DeprecationWarning)
        loaded = loadmat(io.BytesIO(content))
    record = {key: _of_mat(value) for key, value in loaded.items()}
    return {key: value for key, value in record.items() if key[:2] != "__"}, checksummed


def _other_format(content: bytes) -> str:
    """Describe a file with the ending .mat that is not of MATLAB's level 5."""
    if content[124:128] == b"\0\2IM":
        return "a MATLAB file of version 7.3"
    if content.startswith(b"\x89HDF"):
        return "an HDF5 file"
    if content.startswith((b"# Created by Octave", b"Octave-1")):
        return "a file of Octave's own format"
    return "not a MATLAB file of level 5"


def _unpacked_size(content: bytes) -> int:
    """Return the size [bytes] of a .mat file after decompression, or more than the memory.

    An element begins with its type and its size. Compressed elements are decompressed in pieces
    that are thrown away, and only until their size exceeds the memory.
    """
    order: Literal["little", "big"] = "little" if content[126:128] == b"IM" else "big"
    data = memoryview(content)
    at = _MAT_HEADER
    total = 0
    while at + 8 <= len(data):
        kind = int.from_bytes(data[at : at + 4], order)
        size = int.from_bytes(data[at + 4 : at + 8], order)
        body: bytes | memoryview = data[at + 8 : at + 8 + size]
        total += len(body)
        if kind == _MAT_COMPRESSED:
            unpacking = zlib.decompressobj()
            while body and total <= memory() and not unpacking.eof:
                total += len(unpacking.decompress(body, _BLOCK))
                body = unpacking.unconsumed_tail
        at += 8 + size
    return total


def _require_room(size: int) -> None:
    """Raise `MemoryError` before `size` bytes are unpacked, if they may not fit into memory."""
    # The arrays of a record are copied once while they are read.
    if 2 * size > memory():
        raise MemoryError


def _of_mat(value: Any) -> object:
    """Convert a MATLAB variable.

    Text becomes a str, cells or text rows a list, a struct a dict, and a sparse matrix an array.
    """
    import scipy.sparse as sp

    if sp.issparse(value):
        _require_room(8 * math.prod(value.shape))
        return value.toarray()
    if not isinstance(value, np.ndarray):
        return value
    if value.dtype.names:
        return {name: _of_mat(value[name].item()) for name in value.dtype.names}
    if value.dtype.kind == "U":
        return _text_of_mat(value)
    if value.dtype.kind == "O":
        return [_of_mat(cell) for cell in value.ravel(order="F")]
    return value


def _text_of_mat(value: Array) -> list[str] | str:
    """Return the rows of a MATLAB text, or a single string if it has at most one row."""
    rows = [str(row) for row in value.ravel()]
    if len(rows) > 1:
        return [row.rstrip() for row in rows]
    return "".join(rows)  # an empty text has no rows


def _to_json(record: Mapping[str, object], checksummed: bool) -> bytes:
    def plain(value: object) -> object:
        if isinstance(value, np.ndarray) and value.dtype.kind == "c":
            return {"real": value.real.tolist(), "imag": value.imag.tolist()}
        if isinstance(value, np.ndarray):
            return value.tolist()
        return value

    lines = (
        f"{json.dumps(k)}: {json.dumps(plain(v), allow_nan=False)}"
        for k, v in record.items()
    )
    body = ("{\n" + ",\n".join(lines)).encode()
    if checksummed:
        checksum = hashlib.sha256(body).hexdigest()
        body += f',\n"{CHECKSUM}": "{checksum}"'.encode()
    return body + b"\n}\n"


def _from_json(content: bytes) -> tuple[Record, bool]:
    checksum = _JSON_CHECKSUM.search(content[-100:])
    if checksum:
        body = content[: len(content) - len(checksum.group())]
        if hashlib.sha256(body).hexdigest().encode() != checksum.group(1):
            raise ValueError(
                f"{DAMAGED}; to read the file without this check, delete its last entry "
                f"{CHECKSUM}, with the comma before it"
            )
    record: Record = json.loads(content)
    if record.pop(CHECKSUM, None) is not None and not checksum:
        raise ValueError(
            f"its entry {CHECKSUM} is not written by fflin; delete this entry"
        )
    return record, bool(checksum)


# {ending: (writer, reader)} for each of `writing.RECORDS`
CODECS = {
    ".npz": (_to_npz, _from_npz),
    ".mat": (_to_mat, _from_mat),
    ".json": (_to_json, _from_json),
}


@dataclass(frozen=True, eq=False, repr=False)
class Design(Result):
    """Base class of results that can be saved and loaded; their arrays are read-only.

    Attributes
    ----------
    verified : bool
        True for a result computed in this session, or read from a file with a valid SHA-256 digest.
        False for a result read from a file without a digest, and for every result derived from it.
    """

    verified: bool = field(default=True, kw_only=True)

    def __init_subclass__(cls) -> None:
        # `_value` reads the type of a field from its annotation, which must therefore be a string.
        if not all(
            isinstance(kind, str)
            for kind in vars(cls).get("__annotations__", {}).values()
        ):
            raise TypeError(
                f"'{cls.__name__}' needs `from __future__ import annotations`"
            )

    def save(self, path: str | Path) -> None:
        """Write the result to a .npz, .mat or .json file; the file is written atomically.

        Raises
        ------
        FileError
            If the path has another ending or the file cannot be written.
        InputError
            If a value is not finite.
        """
        write_record(writing.as_path(path), record_of(self), checksummed=self.verified)

    @classmethod
    def _of(cls: type[Kind], *sources: object, **values: Any) -> Kind:
        """Return a result with the fields `values`.

        Each other field is copied from the first source that has it.
        """
        names = [item.name for item in fields(cls) if item.init]
        for source in sources:
            values = {
                key: getattr(source, key) for key in names if hasattr(source, key)
            } | values
        return cls(**values)

    @classmethod
    def load(cls: type[Kind], path: str | Path) -> Kind:
        """Read a file that `save` wrote; every value is restored bit for bit.

        Raises
        ------
        FileError
            If the file cannot be read, is damaged or holds another kind of result.
        """
        return cls._read(path)

    @classmethod
    def _read(cls: type[Kind], path: str | Path, **given: object) -> Kind:
        """Read a file as `load` does; `given` contains the fields that files do not store.

        Files of earlier versions may lack fields that have a default.
        """
        source = writing.as_path(path)
        name = cls.__name__
        with reading(source, name):
            record, verified = read_record(source)
            if text(record["kind"]) != name:
                raise ValueError(f"the file contains: {text(record['kind'])}")
            # A field with a default may be missing in a file of an older version.
            values = {
                item.name: _value(item, record[item.name])
                for item in _saved(cls)
                if item.name in record or _is_required(item)
            }
            require_possible(values, getattr(cls, "_SHAPES", ""))
            return cls(**given, **values, verified=verified)


def require_possible(values: Record, shapes: str = "") -> None:
    """Raise `ValueError` if values from a file are impossible or contradict each other.

    `shapes` states the dimensions of arrays, as in ``K:ux x0:x``. A letter stands for one length,
    which is the same wherever the letter occurs.
    """
    for key, value in values.items():
        least = 0.0 if key == "dt" else -_LARGEST
        if isinstance(value, float) and not least <= value <= _LARGEST:
            raise ValueError(f"{key} is {value:g}, which is not possible")
        if key.endswith("_units") and len(value) != len(
            values[key.replace("units", "names")]
        ):
            raise ValueError(
                f"the number of its {key} differs from the number of names"
            )
    lengths: dict[str, int] = {}
    for key, letters in (item.split(":") for item in shapes.split()):
        shape = np.shape(values[key])
        if tuple(map(lengths.setdefault, letters, shape)) != shape or len(shape) < len(
            letters
        ):
            raise ValueError(
                f"{key} has shape {shape}, which contradicts other entries"
            )


def unit_pose(values: Array) -> Array:
    """Return a pose from a file with a normalised quaternion, or raise `ValueError`."""
    if values.shape == (7,):
        with suppress(InputError):
            return np.concatenate(
                (values[:3], normalised("the quaternion", values[3:]))
            )
    raise ValueError("placement is not a position and a unit quaternion (7,)")


def record_of(design: Design) -> Record:
    """Return the record that represents a result in a file."""
    record: Record = {"kind": type(design).__name__}
    for item in _saved(type(design)):
        value = getattr(design, item.name)
        # JSON has no infinity, so the largest double replaces it
        if item.type == "Open":
            value = np.nan_to_num(value, nan=np.nan)
        if isinstance(value, tuple):
            value = list(value)
        record[item.name] = value
    return record


def _saved(cls: type[Design]) -> list[Field[object]]:
    """Return the fields of a result that its file contains."""
    saved = (
        item for item in fields(cls) if item.name != "verified" and item.name[0] != "_"
    )
    return [item for item in saved if item.type != "Robot"]


def _is_required(item: Field[object]) -> bool:
    """Return whether a field has no default."""
    return item.default is MISSING and item.default_factory is MISSING


def _value(item: Field[object], raw: object) -> Any:
    """Convert a value from a file to the type of its field's annotation."""
    for kind, of_kind in (("float", figure), ("str", text), ("tuple", texts)):
        if str(item.type).startswith(kind):
            return of_kind(raw)
    if isinstance(raw, dict):
        raw = np.array(raw["real"]) + 1j * np.array(raw["imag"])
    array = np.asarray(raw)
    kinds = "fiuc" if item.type == "Poles" else "fiu"
    if array.dtype.kind not in kinds or not np.isfinite(array).all():
        raise ValueError(f"{item.name} is not an array of finite numbers")
    dtype = complex if array.dtype.kind == "c" else float
    array = array.astype(dtype)
    if item.type == "Open":
        array = np.where(np.abs(array) > _LARGEST, np.copysign(np.inf, array), array)
    # MATLAB stores vectors as matrices.
    if item.type in ("Vector", "Poles"):
        array = array.ravel()
    if item.name == "placement":
        array = unit_pose(array)
    return array
