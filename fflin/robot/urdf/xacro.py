"""Xacro: told from plain URDF, and expanded by the optional package xacrodoc."""

import contextlib
import ctypes
import os
import signal
import sys
from pathlib import Path

from fflin.base.errors import MissingPackageError, UrdfError
from fflin.base.writing import remember
from fflin.robot.urdf.xml import Element

# How long an expansion may take [s]; xacro's expressions and macros may be without end.
LIMIT = 60.0

# Of Linux, prctl.h: the signal that a process gets where the one that started it ends.
_PR_SET_PDEATHSIG = 1

# What lies below these does not reach the model, so a "${" there is no reason to expand.
_IGNORED = {
    *("visual", "collision", "material", "gazebo", "transmission", "ros2_control"),
    *("sensor", "plugin", "safety_controller", "calibration"),
}


def first_xacro(root: Element) -> Element | None:
    """Return the first element that makes use of xacro; declaring its prefix does not count."""
    stack = [root]
    while stack:
        element = stack.pop()
        if element.tag.startswith("xacro:"):
            return element
        if any("${" in value or "$(" in value for value in element.attributes.values()):
            return element
        stack.extend(child for child in element.children[::-1] if child.tag not in _IGNORED)
    return None


def expand(path: Path, document: bytes, first: Element | None) -> tuple[bytes, list[str]]:
    """Return a xacro document as plain URDF, and what xacro said; `first` is for errors."""
    import json
    import subprocess
    from importlib.util import find_spec

    use = f", first used by <{first.tag}> in line {first.line}" if first else ""
    if not (find_spec("xacro") and find_spec("xacrodoc")):
        raise MissingPackageError(
            f"{path}: is written in xacro{use}; pip install 'fflin[xacro]' to have it expanded"
        )
    failed = f"{path}: cannot be expanded by xacro{use}"
    try:
        # Python's packages are looked for where this process does.
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-m", __name__, str(path), str(LIMIT)],
            input=document,
            capture_output=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONUTF8": "1"},
            timeout=LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise UrdfError(
            f"{failed}: it takes more than {LIMIT:g} s; is there a macro or an expression "
            "without end?"
        ) from None
    said = done.stderr.decode(errors="replace").splitlines()
    if done.returncode:
        why = " ".join(said[-1:]) or f"its process ended with {done.returncode}"
        raise UrdfError(f"{failed}: {why[:300]}")
    files, _, urdf = done.stdout.partition(b"\n")
    remember(*json.loads(files))
    return urdf, [f"{path.name}: {line}" for line in said if line]


def _expand_here(path: Path, limit: float) -> None:
    """Expand stdin; write to stdout a line of JSON, the files that were read, and the document."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever started it ends it
    # It ends with who started it, or else in time, whatever it does.
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    import faulthandler
    import json

    faulthandler.dump_traceback_later(limit, exit=True)
    import xacro
    from xacrodoc import XacroDoc, packages

    document = sys.stdin.buffer.read().decode("utf-8-sig")
    try:
        with contextlib.redirect_stdout(sys.stderr):
            packages.walk_up_from(path)
            # Files to include are looked up from the one on top of xacro's stack.
            xacro.init_stacks(str(path))
            urdf = XacroDoc.from_string(
                document, resolve_packages=False, rootdir=path.parent
            ).to_urdf_string()
    except Exception as error:  # xacro evaluates Python expressions, which may raise anything
        sys.exit(" ".join(str(error).split()) or type(error).__name__)
    # Included documents and YAML files; one that is read twice is in the list twice.
    files = json.dumps(sorted(set(xacro.all_includes)))
    sys.stdout.buffer.write(f"{files}\n{urdf}".encode())


if __name__ == "__main__":
    _expand_here(Path(sys.argv[1]), float(sys.argv[2]))
