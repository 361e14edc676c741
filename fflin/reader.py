"""From a URDF file to a Pinocchio model with a free-flyer root."""

import hashlib
from pathlib import Path
from xml.parsers import expat

import pinocchio as pin

from fflin.errors import FileError, UrdfError

_SIZE_LIMIT = 64 * 2**20


def read_urdf(path: Path, prune: tuple[str, ...] = ()) -> tuple[pin.Model, str]:
    """Read a URDF as a robot that floats free.

    Parameters
    ----------
    path : Path
        The URDF.
    prune : tuple of str
        Joints to cut off with all that hangs on them.

    Returns
    -------
    model : pin.Model
        Free-flyer root joint, zero gravity.
    sha256 : str
        Hash of the file as it was read.

    Raises
    ------
    FileError
        If the file cannot be read.
    UrdfError
        If it is not a URDF that Pinocchio can build.
    """
    raw = _read(path)
    _check_well_formed(path, raw)
    try:
        model = pin.buildModelFromXML(raw.decode("utf-8-sig"), pin.JointModelFreeFlyer())
    except UnicodeDecodeError as error:
        raise UrdfError(f"{path}: not UTF-8 at byte {error.start}; save it as UTF-8") from None
    except ValueError as error:
        raise UrdfError(
            f"{path}: Pinocchio cannot build it: {' '.join(str(error).split())}"
        ) from None
    model.gravity.setZero()
    return model, hashlib.sha256(raw).hexdigest()


def _read(path: Path) -> bytes:
    try:
        if not path.is_file():
            kind = "a folder" if path.is_dir() else "not a regular file"
            raise FileError(f"{path}: {kind}; give the path of a URDF file")
        size = path.stat().st_size
        if size > _SIZE_LIMIT:
            raise FileError(f"{path}: {size} bytes; a URDF of at most {_SIZE_LIMIT} is read")
        return path.read_bytes()
    except FileError:
        raise
    except OSError as error:
        raise FileError(f"{path}: cannot be read: {error.strerror}") from None


def _check_well_formed(path: Path, raw: bytes) -> None:
    root: list[str] = []
    parser = expat.ParserCreate()
    parser.StartElementHandler = lambda tag, _: root.append(tag) if not root else None
    try:
        parser.Parse(raw, True)
    except expat.ExpatError as error:
        what = expat.errors.messages[error.code]
        raise UrdfError(f"{path}:{error.lineno}: not well-formed XML: {what}") from None
    if root != ["robot"]:
        raise UrdfError(f"{path}: the root element is <{root[0]}>, expected <robot>")
