"""Xacro: told from plain URDF, and expanded by the optional package xacrodoc."""

from __future__ import annotations

import contextlib
import io
import warnings
from pathlib import Path

from fflin.errors import MissingPackageError, UrdfError
from fflin.xml_tree import Element

# What lies below these does not reach the model, so a "${" there is no reason to expand.
_IGNORED = frozenset({"visual", "collision", "gazebo", "transmission", "ros2_control", "sensor"})


def uses_xacro(root: Element) -> bool:
    """Tell whether a document makes use of xacro; merely declaring its prefix does not count."""
    stack = [root]
    while stack:
        element = stack.pop()
        if element.tag.startswith("xacro:"):
            return True
        if any("${" in value or "$(" in value for value in element.attributes.values()):
            return True
        stack.extend(child for child in element.children if child.tag not in _IGNORED)
    return False


def expand(path: Path, document: bytes) -> tuple[bytes, list[str]]:
    """Expand a xacro document.

    Parameters
    ----------
    path : Path
        Where it lies; files that it includes are looked up from there.
    document : bytes
        What the file holds.

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
    said = io.StringIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the packages themselves, on import
        try:
            import xacro
            from xacrodoc import XacroDoc, packages
        except ImportError:
            raise MissingPackageError(
                f"{path}: is written in xacro; pip install 'fflin[xacro]' to have it expanded"
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
            raise UrdfError(f"{path}: xacro cannot expand it: {text[:300]}") from None
        finally:
            xacro.init_stacks(None)
    return urdf.encode(), [f"{path.name}: {line}" for line in said.getvalue().splitlines() if line]
