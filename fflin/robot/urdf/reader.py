"""Reader of URDF and xacro files, which builds a Pinocchio model with a free-flyer root joint."""

import hashlib
import sys
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import pinocchio as pin

from fflin.base.errors import MissingPackageError, UrdfError
from fflin.base.process import import_path_without
from fflin.base.writing import read_file, remember
from fflin.robot.urdf.joints import (
    UNLIMITED,
    JointElement,
    Mimic,
    Urdf,
    counted_leaders,
    read_description,
    resolve_mimics,
)
from fflin.robot.urdf.links import INERTIA, Link, Pose, inertia_notes
from fflin.robot.urdf.xml import Element, enumerated, named, notes_of, parse

_SIZE_LIMIT = 64 * 2**20

# Up to this depth, the recursion of the parsers fits into the smallest stack of a thread, 512 kB.
_SHALLOW = 100
_STACK = 16 * 2**20

# Characters that must be escaped in values of attributes.
_ENTITIES = {ord(letter): f"&#{ord(letter)};" for letter in "&<>\"'\t\n\r"}

# Time limit of an expansion [s], since xacro's expressions and macros may not terminate.
XACRO_LIMIT = 60.0

# Path of the program that expands xacro. It is run as a file, because with -m or -c it could import
# modules from the working folder.
_CHILD = str(Path(__file__).with_name("xacro_child.py"))

# These elements do not affect the model, so a "${" inside them does not require xacro.
_IGNORED = {
    *("visual", "collision", "material", "gazebo", "transmission", "ros2_control"),
    *("sensor", "plugin", "safety_controller", "calibration"),
}


class Advice(NamedTuple):
    """Warning about joints that is dropped if a field of the robot names all of them."""

    field: str
    joints: tuple[str, ...]
    note: str


class Description(NamedTuple):
    """Content of a robot's file."""

    model: pin.Model  # free-flyer root joint, zero gravity; mimic joints move freely in it
    sha256: str  # digest of the file that was read, without files that a xacro includes
    mimics: dict[str, Mimic]  # {mimic joint: Mimic} with independent leaders
    damping: dict[str, float]  # {joint: value} of nonzero damping [N m s/rad | N s/m]
    meshes: tuple[str, ...]  # mesh files as written in the file; they are not read
    links: dict[str, Link]  # links with mass
    joints: tuple[str, ...]  # all joints in the order of the file
    notes: tuple[str, ...]  # warnings, one line each
    advice: tuple[Advice, ...] = ()  # warnings that fields of the robot may make unnecessary


def read_urdf(path: Path) -> Description:
    """Read a URDF or xacro file as a free-flying robot."""
    return describe(read_document(path), path)


def describe(document: bytes, path: Path) -> Description:
    """Read a URDF from the bytes of a file; `path` is its name in errors."""
    root = parse(document, str(path))
    notes: list[str] = []
    # Search for text that indicates xacro, or for characters that may encode such text.
    plain = document.replace(b"\0", b"")  # so that UTF-16 is searched too
    first = first_xacro(root) if any(x in plain for x in (b"xacro:", b"$", b"&#")) else None
    if path.suffix == ".xacro" or first:
        expanded, notes = expand(path, document, first)
        root = parse(expanded, f"{path} as expanded by xacro")
    urdf = read_description(root)
    mimics = resolve_mimics(urdf.joints)
    model = _build(urdf, path, counted_leaders(urdf.joints, mimics))
    notes += notes_of(root)
    notes += inertia_notes(urdf.links.values(), model, path.stem)
    moving = [joint for joint in urdf.joints.values() if joint.freedom]
    damping = {joint.name: joint.damping for joint in moving if joint.damping}
    return Description(
        model,
        hashlib.sha256(document).hexdigest(),
        mimics,
        damping,
        tuple({e.attributes.get("filename", "") for e in root.iterate() if e.tag == "mesh"}),
        links={name: link for name, link in urdf.links.items() if link.mass},
        joints=tuple(urdf.joints),
        notes=tuple(notes),
        advice=tuple(_advice(moving, path.stem)),
    )


def _advice(moving: list[JointElement], origin: str) -> Iterator[Advice]:
    """Yield warnings about dampers, friction and zero limits that the model ignores."""
    damped = tuple(joint.name for joint in moving if joint.damping)
    rubbing = tuple(joint.name for joint in moving if joint.friction)
    zero = {
        what: tuple(joint.name for joint in moving if (joint.limits or {}).get(what) == 0.0)
        for what in ("effort", "velocity")
    }
    if damped:
        yield Advice("damping", damped, f"{origin}: damping unused: {enumerated(damped)}")
    if rubbing:
        text = f"{origin}: Coulomb friction unused: {enumerated(rubbing)}"
        yield Advice("friction", rubbing, text)
    for joints in dict.fromkeys(filter(None, zero.values())):
        of = named("joint", joints) if len(joints) < 3 else f"{len(joints)} joints"
        limits = ", ".join(what for what, names in zero.items() if names == joints)
        text = f"{origin}: {limits} 0 of {of}: no limit (or passive)"
        yield Advice("passive", joints, text)


def read_document(path: Path) -> bytes:
    """Return the content of a URDF file, or raise `FileError`."""
    return read_file(path, "URDF", _SIZE_LIMIT)


def _build(urdf: Urdf, path: Path, counted: Collection[str]) -> pin.Model:
    root_joint = "root_joint"
    while root_joint in urdf.joints or root_joint in urdf.links:
        root_joint += "_"
    document = write_urdf(urdf, counted)
    try:
        model = _with_stack(
            urdf.depth,
            lambda: pin.buildModelFromXML(document, pin.JointModelFreeFlyer(), root_joint),
        )
    except (ValueError, RuntimeError) as error:
        raise UrdfError(
            f"{path}: Pinocchio cannot build the model: {' '.join(str(error).split())[:300]}"
        ) from None
    moving = {joint.name for joint in urdf.joints.values() if joint.freedom}
    if set(model.names) != {"universe", root_joint, *moving} or "universe" in moving:
        raise UrdfError(
            f"{path}: the joints that Pinocchio built differ from the joints in the file; rename "
            "joints with unusual names"
        )
    model.gravity.setZero()
    # File names may contain bytes that are not valid text.
    model.name = urdf.name or path.stem.encode(errors="backslashreplace").decode()
    return model


def _with_stack(depth: int, call: Callable[[], pin.Model]) -> pin.Model:
    """Call a function that recurses along the tree, in a thread with a large enough stack."""
    if depth <= _SHALLOW:
        return call()
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as other:
        usual = threading.stack_size(_STACK)
        try:
            built = other.submit(call)
        finally:
            threading.stack_size(usual)
        return built.result()


def write_urdf(urdf: Urdf, counted: Collection[str] = ()) -> str:
    """Return a URDF of links, inertias and joints with exact numbers.

    `counted` continuous joints become revolute, so that they count full turns.
    """
    # Version 1.1 is the first for which urdfdom reads quat_xyzw; 1.2 would require limits.
    lines = [f'<robot name={_quoted(urdf.name)} version="1.1">']
    for link in urdf.links.values():
        lines.extend(_link(link))
    for joint in urdf.joints.values():
        lines.extend(_joint(joint, joint.name in counted))
    lines.append("</robot>")
    return "\n".join(lines)


def _link(link: Link) -> Iterator[str]:
    yield f"<link name={_quoted(link.name)}>"
    if link.mass is not None:
        yield f'<inertial>{_origin(link.com)}<mass value="{link.mass!r}"/>'
        yield f"<inertia {_entries(dict(zip(INERTIA, link.inertia, strict=True)))}/></inertial>"
    yield "</link>"


def _joint(joint: JointElement, counted: bool) -> Iterator[str]:
    unbounded = {"lower": -UNLIMITED, "upper": UNLIMITED}
    if counted:
        joint = joint._replace(type="revolute", limits=(joint.limits or {}) | unbounded)
    yield f'<joint name={_quoted(joint.name)} type="{joint.type}">'
    yield f"<parent link={_quoted(joint.parent)}/><child link={_quoted(joint.child)}/>"
    yield _origin(joint.origin)
    if joint.freedom == 1:
        yield f'<axis xyz="{_numbers(joint.axis)}"/>'
        if joint.damping or joint.friction:
            yield f'<dynamics damping="{joint.damping!r}" friction="{joint.friction!r}"/>'
    if joint.type in ("revolute", "prismatic") or joint.limits:
        limits = unbounded if joint.limits is None else joint.limits
        yield f"<limit {_entries({'effort': UNLIMITED, 'velocity': UNLIMITED} | limits)}/>"
    yield "</joint>"


def _origin(pose: Pose) -> str:
    attitude = f'rpy="{_numbers(pose.rpy)}"'
    if pose.quaternion is not None:
        attitude = f'quat_xyzw="{_numbers(pose.quaternion)}"'
    return f'<origin xyz="{_numbers(pose.xyz)}" {attitude}/>'


def _entries(values: Mapping[str, float]) -> str:
    return " ".join(f'{name}="{value!r}"' for name, value in values.items())


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(repr(value) for value in values)


def _quoted(text: str) -> str:
    """Quote an attribute's value; the standard library's functions would load many modules."""
    return f'"{text.translate(_ENTITIES)}"'


def first_xacro(root: Element) -> Element | None:
    """Return the first element that uses xacro, or None; declaring the prefix is not a use."""
    for element in chain([root], root.iterate(_IGNORED)):
        marked = any("${" in value or "$(" in value for value in element.attributes.values())
        if marked or element.tag.startswith("xacro:"):
            return element
    return None


def expand(path: Path, document: bytes, first: Element | None) -> tuple[bytes, list[str]]:
    """Expand a xacro document to plain URDF, and return it with xacro's messages.

    `first` is the first element that uses xacro, for error messages.
    """
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
            [*child, str(path), str(XACRO_LIMIT), *import_path_without("", path.parent)],
            input=document,
            capture_output=True,
            timeout=XACRO_LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise UrdfError(
            f"{failed}: the expansion takes more than {XACRO_LIMIT:g} s; look for a macro or an "
            "expression that never ends"
        ) from None
    said = done.stderr.decode(errors="replace").splitlines()
    if done.returncode:
        why = " ".join(said[-1:]) or f"its process ended with exit code {done.returncode}"
        raise UrdfError(f"{failed}: {why[:300]}")
    files, _, urdf = done.stdout.partition(b"\n")
    remember(*json.loads(files))
    return urdf, [f"{path.name}: {line}" for line in said if line]
