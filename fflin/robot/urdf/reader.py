"""Reader of URDF and xacro files, which builds a Pinocchio model with a free-flyer root joint."""

import hashlib
import json
import sys
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import (
    InputError,
    MissingPackageError,
    UrdfError,
    listed,
    require_known,
)
from fflin.base.process import import_path_without
from fflin.base.writing import remember
from fflin.robot.urdf import description
from fflin.robot.urdf.description import (
    INERTIA,
    UNLIMITED,
    JointElement,
    Link,
    Mimic,
    Pose,
)
from fflin.robot.urdf.xml import Element, enumerated, named, notes_of, parse

SIZE_LIMIT = 64 * 2**20  # bytes

# Stack size [bytes] of the thread in which urdfdom and Pinocchio recurse along the tree. The usual
# stack of a thread may have only 512 kB.
_STACK = 16 * 2**20

_UNBOUNDED = {"lower": -UNLIMITED, "upper": UNLIMITED}

NO_ARGUMENTS: Mapping[str, str] = MappingProxyType({})

# Characters that must be escaped in the values of XML attributes.
_ENTITIES = {ord(letter): f"&#{ord(letter)};" for letter in "&<>\"'\t\n\r"}

# Time limit [s] for the expansion of a xacro file, whose expressions and macros may never end.
XACRO_LIMIT = 60.0

# Path of the program that expands xacro. Python runs it as a file, because the option -m would
# first import fflin.
_CHILD = str(Path(__file__).with_name("xacro_child.py"))

# These elements do not affect the model, so a "${" inside them does not require xacro.
_IGNORED = {
    "visual",
    "collision",
    "material",
    "gazebo",
    "transmission",
    "ros2_control",
    "sensor",
    "plugin",
    "safety_controller",
    "calibration",
}


class Urdf(NamedTuple):
    """Checked content of a robot's file."""

    # free-flyer root joint, zero gravity; mimic joints move freely in it
    model: pin.Model
    sha256: str  # digest of the file and of the xacro arguments, without included files
    links: dict[str, Link]  # in the order of the file
    joints: dict[str, JointElement]
    mimics: dict[str, Mimic]  # {mimic joint: Mimic} with independent leaders
    meshes: set[str]  # mesh files as written in the file; they are not read
    notes: tuple[str, ...]  # warnings, one line each


def describe(
    document: bytes, path: Path, arguments: Mapping[str, str] = NO_ARGUMENTS
) -> Urdf:
    """Read a URDF or xacro file; `document` contains the bytes of the file at `path`.

    `arguments` are the values {name: text} of the arguments of a xacro file.
    """
    root, notes = plain_root(document, path, arguments)
    links, joints = description.read_tree(root)
    mimics = description.resolve_mimics(joints)
    # The position of a continuous joint does not count full turns, but the position of a revolute
    # joint does. Full turns of a leader must be counted if one full turn displaces its mimic joint.
    # In this case, make a continuous leader a revolute joint without limits.
    for name, (leader, multiplier, _) in mimics.items():
        turning = joints[leader].type == "continuous"
        if turning and not (
            joints[name].type == "continuous" and multiplier.is_integer()
        ):
            limits = (joints[leader].limits or {}) | _UNBOUNDED
            joints[leader] = joints[leader]._replace(type="revolute", limits=limits)
    root_joint = "root_joint"
    while root_joint in joints or root_joint in links:
        root_joint += "_"
    name = root.attributes.get("name", "").strip()
    clean, base = write_urdf(name, links, joints), pin.JointModelFreeFlyer()
    try:
        with ThreadPoolExecutor(1) as other:
            usual = threading.stack_size(_STACK)
            try:
                built = other.submit(pin.buildModelFromXML, clean, base, root_joint)
            finally:
                threading.stack_size(usual)
        model: pin.Model = built.result()
    except (ValueError, RuntimeError) as error:
        raise UrdfError(
            f"{path}: Pinocchio cannot build the model: {' '.join(str(error).split())[:300]}"
        ) from None
    names = {
        "universe",
        root_joint,
        *(joint.name for joint in joints.values() if joint.freedom),
    }
    if set(model.names) != names or len(names) != model.njoints:
        raise UrdfError(
            f"{path}: the joints that Pinocchio built differ from the joints in the file; rename "
            "joints with unusual names"
        )
    model.gravity.setZero()
    # File names may contain bytes that are not valid text. Escape these bytes.
    model.name = name or path.stem.encode(errors="backslashreplace").decode()
    notes += [
        *notes_of(root),
        *description.inertia_notes(links.values(), model, path.stem),
    ]
    meshes = {
        e.attributes.get("filename", "") for e in root.iterate() if e.tag == "mesh"
    }
    digest = hashlib.sha256(document)
    if arguments:
        digest.update(json.dumps(dict(arguments), sort_keys=True).encode())
    return Urdf(model, digest.hexdigest(), links, joints, mimics, meshes, tuple(notes))


def plain_root(
    document: bytes, path: Path, arguments: Mapping[str, str] = NO_ARGUMENTS
) -> tuple[Element, list[str]]:
    """Parse a document, and expand it if it uses xacro; return its root and xacro's messages."""
    root = parse(document, str(path))
    # To save time, search the elements for xacro only if the document contains text that may belong
    # to xacro, or "&#", which may encode such text.
    text = document.replace(b"\0", b"")  # so that UTF-16 is searched too
    suspect = any(x in text for x in (b"xacro:", b"$", b"&#"))
    elements = chain([root], root.iterate(_IGNORED)) if suspect else ()
    first = next(filter(_uses_xacro, elements), None)
    if path.suffix != ".xacro" and not first:
        if arguments:
            raise InputError(
                f"xacro arguments are given ({listed(arguments)}), but {path} does not use xacro; "
                "remove them"
            )
        return root, []
    expanded, notes = _expand(path, document, first, arguments)
    return parse(expanded, f"{path} as expanded by xacro"), notes


def _uses_xacro(element: Element) -> bool:
    # The attribute xmlns:xacro only declares the prefix, and does not count as a use of xacro.
    return element.tag.startswith("xacro:") or any(
        "${" in value or "$(" in value for value in element.attributes.values()
    )


def ignored(
    joints: Mapping[str, JointElement], origin: str
) -> Iterator[tuple[str, tuple[str, ...], str]]:
    """Yield a warning (field, joints, text) for each property of joints that fflin ignores.

    The properties are damping, friction, and zero limits of effort or velocity. `field` is
    "damping", "friction" or "passive". The warning is unnecessary if the robot's field of this name
    contains all of these joints. A robot has no field "friction".
    """
    moving = [joint for joint in joints.values() if joint.freedom]
    for field, effect in (("damping", "damping"), ("friction", "Coulomb friction")):
        if names := tuple(joint.name for joint in moving if getattr(joint, field)):
            yield field, names, f"{origin}: {effect} unused: {enumerated(names)}"
    zero: dict[tuple[str, ...], list[str]] = {}
    for limit in ("effort", "velocity"):
        names = tuple(
            joint.name for joint in moving if (joint.limits or {}).get(limit) == 0.0
        )
        zero.setdefault(names, []).append(limit)
    for names, limits in zero.items():
        if names:
            affected = (
                named("joint", names) if len(names) < 3 else f"{len(names)} joints"
            )
            warning = (
                f"{origin}: {', '.join(limits)} 0 of {affected}: no limit (or passive)"
            )
            yield "passive", names, warning


def write_urdf(
    name: str, links: Mapping[str, Link], joints: Mapping[str, JointElement]
) -> str:
    """Return the text of a URDF with given links and joints, and with numbers in full precision."""
    parts = []
    for link in links.values():
        inertial = ""
        if link.mass is not None:
            entries = link.inertia[np.triu_indices(3)].tolist()
            inertia = _tag("inertia", dict(zip(INERTIA, entries, strict=True)))
            mass = _tag("mass", {"value": link.mass})
            inertial = _tag("inertial", {}, _origin(link.com) + mass + inertia)
        parts.append(_tag("link", {"name": link.name}, inertial))
    for joint in joints.values():
        kind = joint.type
        limits = _UNBOUNDED if joint.limits is None else joint.limits
        inside = _tag("parent", {"link": joint.parent}) + _tag(
            "child", {"link": joint.child}
        )
        inside += _origin(joint.origin) + _tag("axis", {"xyz": joint.axis})
        inside += _tag(
            "dynamics", {"damping": joint.damping, "friction": joint.friction}
        )
        if kind in ("revolute", "prismatic") or joint.limits:
            inside += _tag(
                "limit", {"effort": UNLIMITED, "velocity": UNLIMITED} | limits
            )
        parts.append(_tag("joint", {"name": joint.name, "type": kind}, inside))
    # urdfdom reads quat_xyzw only if the version of the URDF is 1.1 or higher. In version 1.2, the
    # lower and upper limits of revolute and prismatic joints would be mandatory.
    return _tag("robot", {"name": name, "version": "1.1"}, "\n".join(parts))


def _origin(pose: Pose) -> str:
    turned = {"quat_xyzw": pose.quaternion} if pose.quaternion else {"rpy": pose.rpy}
    return _tag("origin", {"xyz": pose.xyz} | turned)


def _tag(tag: str, attributes: Mapping[str, object], inside: str = "") -> str:
    """Return the text of an XML element.

    The XML writers of the standard library are not used, because they would load many modules.
    """
    text = f"<{tag}"
    for name, value in attributes.items():
        shown = " ".join(map(repr, value)) if isinstance(value, tuple) else str(value)
        text += f' {name}="{shown.translate(_ENTITIES)}"'
    return f"{text}>{inside}</{tag}>"


def _expand(
    path: Path, document: bytes, first: Element | None, arguments: Mapping[str, str]
) -> tuple[bytes, list[str]]:
    """Expand a xacro document, and return the plain URDF and xacro's messages.

    `first` is the first element that uses xacro, or None. It appears in error messages.
    """
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
            [
                *child,
                str(path),
                str(XACRO_LIMIT),
                json.dumps(dict(arguments)),
                *import_path_without("", path.parent),
            ],
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
    messages = done.stderr.decode(errors="replace").splitlines()
    if done.returncode:
        why = (
            " ".join(messages[-1:])
            or f"its process ended with exit code {done.returncode}"
        )
        raise UrdfError(f"{failed}: {why[:300]}")
    line, _, urdf = done.stdout.partition(b"\n")
    head = json.loads(line)
    remember(*head["files"])
    require_known(f"xacro argument of {path.name}", arguments, head["arguments"])
    return urdf, [f"{path.name}: {line}" for line in messages if line]
