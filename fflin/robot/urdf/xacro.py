"""Xacro documents: distinguished from plain URDF, and expanded by the optional package xacrodoc."""

import sys
from itertools import chain
from pathlib import Path

from fflin.base.errors import MissingPackageError, UrdfError
from fflin.base.import_path import import_path_without
from fflin.base.writing import remember
from fflin.robot.urdf.xml import Element

# How long an expansion may take [s]; xacro's expressions and macros may be without end.
LIMIT = 60.0

# Run as a file: by a module's name or as a text it could import from the working folder.
_CHILD = str(Path(__file__).with_name("xacro_child.py"))

# What lies below these does not reach the model, so a "${" there is no reason to expand.
_IGNORED = {
    *("visual", "collision", "material", "gazebo", "transmission", "ros2_control"),
    *("sensor", "plugin", "safety_controller", "calibration"),
}


def first_xacro(root: Element) -> Element | None:
    """Return the first element that makes use of xacro; declaring its prefix does not count."""
    for element in chain([root], root.iterate(_IGNORED)):
        marked = any("${" in value or "$(" in value for value in element.attributes.values())
        if marked or element.tag.startswith("xacro:"):
            return element
    return None


def expand(path: Path, document: bytes, first: Element | None) -> tuple[bytes, list[str]]:
    """Return a xacro document as plain URDF, and what xacro said; `first` is for errors."""
    import json
    import subprocess
    from importlib.util import find_spec

    use = f", first used by <{first.tag}> in line {first.line}" if first else ""
    if not (find_spec("xacro") and find_spec("xacrodoc")):
        raise MissingPackageError(
            f"{path}: the file is written in xacro{use}, which needs another package; install it "
            "with: pip install 'fflin[xacro]'"
        )
    failed = f"{path}: xacro cannot expand the file{use}"
    child = [sys.executable, "-I", "-X", "utf8", "-W", "ignore", _CHILD]
    try:
        done = subprocess.run(
            [*child, str(path), str(LIMIT), *import_path_without("", path.parent)],
            input=document,
            capture_output=True,
            timeout=LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise UrdfError(
            f"{failed}: the expansion takes more than {LIMIT:g} s; look for a macro or an "
            "expression that never ends"
        ) from None
    said = done.stderr.decode(errors="replace").splitlines()
    if done.returncode:
        why = " ".join(said[-1:]) or f"its process ended with exit code {done.returncode}"
        raise UrdfError(f"{failed}: {why[:300]}")
    files, _, urdf = done.stdout.partition(b"\n")
    remember(*json.loads(files))
    return urdf, [f"{path.name}: {line}" for line in said if line]
