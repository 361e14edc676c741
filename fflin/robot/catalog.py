"""Catalogue of robots: functions that find URDF files, mesh files and files of inputs."""

import os
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

from fflin.base.errors import FileError, InputError, require_known
from fflin.base.validation import instance
from fflin.base.writing import as_path, missing, shown


class RobotFile(NamedTuple):
    """Location of a robot's description."""

    name: str  # name in the catalogue, or stem of the file
    path: Path  # URDF, xacro or TOML file
    origin: str  # "fflin", "example-robot-data" or "file"
    package_dirs: tuple[Path, ...] = ()  # folders in which meshes are searched


def bundled_directory() -> Path:
    """Return the folder of the bundled robots, in an installed package or in a source checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "robots"
    if installed.is_dir():
        return installed
    return package.parent / "robots"


@cache
def _bundled() -> dict[str, RobotFile]:
    folder = bundled_directory()
    paths = {path.stem: path for path in folder.glob("*.urdf")}
    # A robot file of another name than its URDF, such as inspector_flexible.toml, is a robot of its
    # own. The file inspector.toml shares its name with a URDF, which `load("inspector")` reads.
    for path in folder.glob("*.toml"):
        paths.setdefault(path.stem, path)
    return {
        name: RobotFile(name, path, "fflin") for name, path in sorted(paths.items())
    }


@cache
def _example_robot_data() -> dict[str, RobotFile]:
    # Read only the class attributes of a loader, because creating the loader would load meshes.
    from example_robot_data.robots_loader import ROBOTS, getModelPath

    robot_files = {}
    for name, loader in ROBOTS.items():
        # The loader of talos_legs inherits the URDF of another robot, and removes joints in code.
        # Therefore talos_legs has no URDF of its own.
        if loader.urdf_filename and name != "talos_legs":
            inner = Path(loader.path, loader.urdf_subpath, loader.urdf_filename)
            root = Path(getModelPath(str(inner))).resolve()
            folders = (root.parents[1], root.parent)
            robot_files[name] = RobotFile(
                name, root / inner, "example-robot-data", folders
            )
    return robot_files


def list_robots() -> tuple[str, ...]:
    """Return all robot names that `load` accepts.

    The bundled robots come first, then the robots of the package example-robot-data.

    Returns
    -------
    tuple of str

    Examples
    --------
    >>> fflin.list_robots()[:3]
    ('astrobee_arm', 'berthed_stack', 'canadarm2')
    """
    return tuple({**_bundled(), **_example_robot_data()})


def find_robot(robot: str | Path, folder: str | Path = "") -> RobotFile:
    """Find a robot by its name, or by the path of its file; a relative path starts at `folder`.

    The name of a bundled robot takes precedence over a path, and the path of a file over a name in
    example-robot-data. The name of a bundled TOML file with its ending, such as "inspector.toml",
    is used only if no file has this path.
    """
    instance("robot", robot, (str, os.PathLike), "a robot name or a path")
    if isinstance(robot, str) and robot in _bundled():
        return _bundled()[robot]
    path, text = Path(folder, robot), str(robot)
    bundled = bundled_directory() / text
    if not os.path.exists(path) and bundled in bundled_directory().glob("*.toml"):
        path = bundled
    # For a name that is too long, `os.path.exists` returns False. `Path.exists` would raise an
    # error.
    if os.path.exists(path) and not (path.is_dir() and text in _example_robot_data()):
        # File names may contain bytes that are not valid text. Escape these bytes.
        name = path.stem.encode(errors="backslashreplace").decode()
        return RobotFile(name, path, "file", (path.resolve().parent,))
    if isinstance(robot, Path) or path.suffix or len(Path(robot).parts) != 1:
        hint = "; give the path of a URDF or a name that `fflin robots` lists"
        raise FileError(f"no file at '{shown(path)}'{missing(path, hint)}")
    require_known("robot", [text], list_robots())
    return _example_robot_data()[text]


def find_inputs(inputs: str | Path) -> Path:
    """Find a file of inputs by its name if the file is bundled, or otherwise by its path."""
    path, name = as_path(inputs), str(inputs)
    bundled = {file.stem: file for file in sorted(bundled_directory().glob("*.toml"))}
    if path.name == name and not path.suffix and not os.path.lexists(path):
        require_known("file or bundled set of inputs", [name], bundled)
    return bundled.get(name, path)


def folders(given: object, within: str | Path = "") -> tuple[Path, ...]:
    """Return the paths of one or several folders; relative paths start at the folder `within`."""
    listed = [given] if isinstance(given, str | os.PathLike) else given
    if not isinstance(listed, Sequence):
        raise InputError(f"package_dirs is {given!r}, expected a list of folders")
    return tuple(within / as_path(folder) for folder in listed)


def find_mesh(uri: str, urdf: Path, package_dirs: Sequence[Path]) -> Path | None:
    """Return the path of a mesh file, or None if the file does not exist.

    The `uri` of the mesh is package://NAME/PATH, file:///PATH or a path.
    """
    scheme, separator, rest = uri.partition("://")
    if not separator:
        candidates = [folder / uri for folder in (urdf.parent, *package_dirs)]
    elif scheme == "file":
        candidates = [Path(unquote(rest))]
    else:
        folders = (*package_dirs, *urdf.resolve().parents)
        inside = Path(*Path(rest).parts[1:])
        # Each of these folders may contain the folder NAME of the package, or may itself be the
        # folder of the package, possibly under another name.
        candidates = [folder / part for part in (rest, inside) for folder in folders]
    # For a name that is too long, `os.path.isfile` returns False. `Path.is_file` would raise an
    # error.
    return next((path for path in candidates if os.path.isfile(path)), None)
