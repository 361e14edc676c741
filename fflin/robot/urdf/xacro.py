"""Xacro: told from plain URDF, and expanded by the optional package xacrodoc."""

from __future__ import annotations

import contextlib
import io
import warnings
from pathlib import Path

from fflin.base.errors import MissingPackageError, UrdfError
from fflin.robot.urdf.xml import Element

# What lies below these does not reach the model, so a "${" there is no reason to expand.
_IGNORED = frozenset(
    {
        *("visual", "collision", "material", "gazebo", "transmission", "ros2_control"),
        *("sensor", "plugin", "safety_controller", "calibration"),
    }
)


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
    """Expand a xacro document.

    Parameters
    ----------
    path : Path
        Where it lies; files that it includes are looked up from there.
    document : bytes
        What the file holds.
    first : Element or None
        Of `first_xacro`, for errors.

    Returns
    -------
    document : bytes
        Plain URDF.
    notes : list of str
        What xacro had to say, one entry a line.

    Raises
    ------
    MissingPackageError
        If xacrodoc is not installed.
    UrdfError
        If xacro cannot expand it.
    """
    use = f", first used by <{first.tag}> in line {first.line}" if first else ""
    said = io.StringIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the packages themselves, on import
        try:
            import xacro
            from xacrodoc import XacroDoc, packages
        except ImportError:
            raise MissingPackageError(
                f"{path}: is written in xacro{use}; pip install 'fflin[xacro]' to have it expanded"
            ) from None
        try:
            with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
                packages.walk_up_from(path)
                # Files to include are looked up from the one on top of xacro's stack.
                xacro.init_stacks(str(path))
                urdf = XacroDoc.from_string(
                    document.decode("utf-8-sig"), resolve_packages=False, rootdir=path.parent
                ).to_urdf_string()
        except Exception as error:  # xacro evaluates Python expressions, which may raise anything
            text = " ".join(str(error).split()) or type(error).__name__
            raise UrdfError(f"{path}: cannot be expanded by xacro{use}: {text[:300]}") from None
        finally:
            xacro.init_stacks(None)
    return urdf.encode(), [f"{path.name}: {line}" for line in said.getvalue().splitlines() if line]
