"""Reader of MJCF files of MuJoCo: Pinocchio builds the model, and this module reads the rest.

The rest are the equality constraints, springs, gravity and motors of the file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import UrdfError
from fflin.base.tables import counted
from fflin.robot.constraints import Constraint, Spherical, Weld
from fflin.robot.inputs import BaseForce, BaseTorque, JointTorque
from fflin.robot.joints import ROOT
from fflin.robot.urdf.xml import Element, parse

_ROOT_JOINT = "root_joint"
_GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2], MuJoCo's default

# {element of MJCF: what fflin does not model}. Elements are counted wherever they are.
_IGNORED = {
    "tendon": "tendons",
    "contact": "contact pairs",
    "deformable": "deformable bodies",
    "composite": "composite bodies",
    "flexcomp": "flexible bodies",
    "plugin": "plugins",
    "keyframe": "keyframes",
    "sensor": "sensors",
}
_HELD = ("connect", "weld")  # equality constraints that fflin models


class Mjcf(NamedTuple):
    """Content of an MJCF file."""

    model: pin.Model  # free-flyer root joint, zero gravity
    sha256: str
    fields: dict[str, Any]  # fields of the robot, see `Robot.replace`
    notes: tuple[str, ...]  # warnings, one line each


def is_mjcf(document: bytes, path: Path) -> bool:
    """Return whether a file with the ending .xml contains MJCF."""
    return path.suffix.lower() == ".xml" and b"<mujoco" in document


def describe_mjcf(document: bytes, path: Path) -> Mjcf:
    """Read an MJCF file; `document` contains the bytes of the file at `path`."""
    origin = str(path)
    root = parse(document, origin)
    if any(_all(root, "include")):
        document = _with_includes(document, path)
        origin = f"{path} with its included files"
        root = parse(document, origin)
    if root.tag != "mujoco":
        raise root.error(
            "the root element is not <mujoco>; give a URDF or an MJCF file"
        )
    for element in root.iterate():
        if element.tag in ("attach", "replicate"):
            raise element.error(
                f"<{element.tag}> is not supported; save the model as one file with MuJoCo's "
                "mj_saveLastXML"
            )
    try:
        model = _built(document, root, path, read=origin == str(path))
    except (RuntimeError, ValueError, IndexError) as error:
        raise UrdfError(
            f"{path}: Pinocchio cannot build the model: {' '.join(str(error).split())[:300]}"
        ) from None
    model.name = root.attributes.get("model", "").strip() or path.stem
    fields: dict[str, Any] = {"gravity": _gravity(root)}
    at_start = _start(model)
    free = [
        i
        for i in range(1, model.njoints)
        if model.parents[i] == 0
        and model.joints[i].shortname() == "JointModelFreeFlyer"
    ]
    constraints: list[Constraint] = []
    if not free:
        model = _on_free_flyer(model)
        at_start = np.concatenate((pin.neutral(model)[:7], at_start))
        constraints.append(
            Weld(_ROOT_JOINT, placement=pin.SE3.Identity(), name="world")
        )
    constraints += _equalities(root, model, at_start)
    model.gravity.setZero()
    fields |= _springs(root, model)
    fields |= _inputs(root, model, floats=bool(free))
    fields["constraints"] = constraints
    notes = tuple(_notes(root, path))
    return Mjcf(model, hashlib.sha256(document).hexdigest(), fields, notes)


def _with_includes(document: bytes, path: Path) -> bytes:
    """Return a document in which each <include> is replaced by the content of its file.

    As in MuJoCo, the paths of files are relative to the folder of the main file, and no file is
    included twice.
    """
    from xml.etree import ElementTree

    included = {path.resolve()}

    def read(element: ElementTree.Element, origin: Path) -> ElementTree.Element:
        name = element.get("file", "")
        file = path.parent / name
        if not name:
            raise UrdfError(f"{origin}: <include> has no attribute file")
        if file.resolve() in included:
            raise UrdfError(f"{origin}: <include> includes the file '{name}' twice")
        included.add(file.resolve())
        try:
            content = file.read_bytes()
        except OSError as error:
            raise UrdfError(
                f"{origin}: <include> names the file '{name}', which cannot be read: "
                f"{error.strerror}"
            ) from None
        parse(content, str(file))  # raises an error with the line
        root = ElementTree.fromstring(content)
        expand(root, file)
        return root

    def expand(parent: ElementTree.Element, origin: Path) -> None:
        children = list[ElementTree.Element]()
        for child in parent:
            if child.tag == "include":
                children += read(child, origin)
            else:
                expand(child, origin)
                children.append(child)
        parent[:] = children

    root = ElementTree.fromstring(document)
    expand(root, path)
    for compiler in root.iter("compiler"):
        for key in ("meshdir", "assetdir"):
            if key in compiler.attrib:
                compiler.set(key, str(path.parent.resolve() / compiler.attrib[key]))
    expanded: bytes = ElementTree.tostring(root, encoding="utf-8")
    return expanded


def _built(document: bytes, root: Element, path: Path, *, read: bool) -> pin.Model:
    """Return Pinocchio's model of the document, which is the content of the file if `read` is true.

    Pinocchio reads only the first body of <worldbody>. Several bodies are put into one body.
    """
    bodies = [x for x in _children(root, "worldbody") if x.tag == "body"]
    if len(bodies) < 2 and read:
        return pin.buildModelFromMJCF(str(path))
    for body in bodies:
        for child in body.children:
            if child.tag == "freejoint" or child.attributes.get("type") == "free":
                raise child.error(
                    "a free joint in a file with several bodies in <worldbody>; a robot has one "
                    "free body, so remove the other ones"
                )
    if len(bodies) < 2:
        return _built_elsewhere(document, path)
    first = document.index(b"<body", document.index(b"<worldbody"))
    last = document.rindex(b"</worldbody")
    parts = (document[:first], document[first:last], document[last:])
    return _built_elsewhere(b'%s<body name="base">%s</body>%s' % parts, path)


def _built_elsewhere(document: bytes, path: Path) -> pin.Model:
    """Return Pinocchio's model of a document that is not the content of the file at `path`."""
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        file = Path(folder, path.name)
        file.write_bytes(document)
        return pin.buildModelFromMJCF(str(file))


def _gravity(root: Element) -> tuple[float, ...]:
    """Return the gravity [m/s^2] of the file; 0 0 -9.81 by default, as in MuJoCo."""
    for option in root.find_all("option"):
        if "gravity" in option.attributes:
            return option.vector("gravity", 3)
    return _GRAVITY


def _start(model: pin.Model) -> np.ndarray:
    """Return MuJoCo's initial configuration qpos0 (nq,)."""
    for entry in model.referenceConfigurations:
        if entry.key() == "qpos0":
            return np.array(entry.data())
    return np.array(pin.neutral(model))


def _on_free_flyer(fixed: pin.Model) -> pin.Model:
    """Return a model with a free-flyer base that contains the bodies fixed to the world.

    A base without mass gets 1 kg and 1 kg m^2, which have no effect, because it is welded.
    """
    base = pin.Model()
    base.name = fixed.name
    base.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), _ROOT_JOINT)
    index = base.addJointFrame(ROOT)
    model = pin.appendModel(base, fixed, index, pin.SE3.Identity())
    for joint in range(ROOT + 1, model.njoints):
        source = fixed.joints[fixed.getJointId(model.names[joint])]
        target = model.joints[joint]
        for count in range(target.nv):
            armature = fixed.armature[source.idx_v + count]
            model.armature[target.idx_v + count] = armature
    if not model.inertias[ROOT].mass:
        model.inertias[ROOT] = pin.Inertia(1.0, np.zeros(3), np.eye(3))
    return model


def _equalities(
    root: Element, model: pin.Model, at_start: np.ndarray
) -> Iterator[Constraint]:
    """Yield the constraints of the elements <connect> and <weld>."""
    data = model.createData()
    pin.framesForwardKinematics(model, data, at_start)
    for element in _children(root, "equality"):
        if element.tag in _HELD and element.attributes.get("active") != "false":
            yield _equality(element, model, data)


def _equality(element: Element, model: pin.Model, data: pin.Data) -> Constraint:
    """Return the constraint of one element; it may add the frame of an anchor to the model."""
    kind = Weld if element.tag == "weld" else Spherical
    key = "site" if "site1" in element.attributes else "body"
    first, second = (_frame(element, f"{key}{number}", model) for number in (1, 2))
    title = element.attributes.get("name", "").strip()
    title = title or "/".join(filter(None, (first, second)))
    if key == "site":
        return kind(second, first, placement=pin.SE3.Identity(), name=title)
    poses = [
        data.oMf[model.getFrameId(name)] if name else pin.SE3.Identity()
        for name in (first, second)
    ]
    apart = poses[0].actInv(poses[1])  # pose of body 2 in body 1
    if kind is Spherical:
        anchor = pin.SE3(np.eye(3), np.array(element.vector("anchor", 3)))
        if not second:
            return _at_anchor(model, first, anchor, poses[0] * anchor, None, title)
        return _at_anchor(model, second, apart.actInv(anchor), anchor, first, title)
    if "relpose" in element.attributes:
        values = np.array(element.vector("relpose", 7))
        if values[3:].any():
            x, y, z, w, i, j, k = values
            apart = pin.XYZQUATToSE3(np.array((x, y, z, i, j, k, w)))
    if not second:
        return Weld(first, placement=apart.inverse(), name=title)
    return Weld(second, first, placement=apart, name=title)


def _frame(element: Element, key: str, model: pin.Model) -> str:
    """Return the frame that an attribute names, or "" for the world."""
    name = element.attributes.get(key, "").strip()
    if name in ("", "world"):
        if key.endswith("1"):
            raise element.error(
                f"{key} is {name!r}, expected a moving body; swap the bodies"
            )
        return ""
    if not model.existFrame(name):
        raise element.error(f"{key} is '{name}', which the file does not define")
    return name


def _at_anchor(
    model: pin.Model,
    carrier: str,
    at: pin.SE3,
    placement: pin.SE3,
    to: str | None,
    title: str,
) -> Spherical:
    """Return a spherical constraint of a new frame at a pose `at` of the frame `carrier`."""
    frame = model.frames[model.getFrameId(carrier)]
    name = f"{title}_anchor"
    while model.existFrame(name):
        name += "_"
    pose = frame.placement * at
    parent = model.getFrameId(carrier)
    anchor = pin.Frame(name, frame.parentJoint, parent, pose, pin.FrameType.OP_FRAME)
    model.addFrame(anchor)
    return Spherical(name, to, placement=placement, name=title)


def _springs(root: Element, model: pin.Model) -> dict[str, Any]:
    """Return stiffness, rest positions and damping of the joints.

    Default classes set the damping, which Pinocchio reads, but not the stiffness.
    """
    fields: dict[str, dict[str, float]] = {"stiffness": {}, "rest": {}, "damping": {}}
    for joint in range(1, model.njoints):
        if model.joints[joint].nv == 1:
            value = float(model.damping[model.joints[joint].idx_v])
            if value:
                fields["damping"][model.names[joint]] = value
    degrees = not any(
        element.attributes.get("angle") == "radian"
        for element in root.find_all("compiler")
    )
    for element in _inside(root, "worldbody", "joint"):
        if not element.attributes.get("stiffness"):
            continue
        name = element.attributes.get("name", "").strip()
        if not model.existJointName(name):
            continue
        fields["stiffness"][name] = element.number("stiffness")
        rest = element.number("springref", 0.0)
        sliding = element.attributes.get("type") == "slide"
        fields["rest"][name] = np.radians(rest) if degrees and not sliding else rest
    return {key: value for key, value in fields.items() if value}


def _inputs(root: Element, model: pin.Model, *, floats: bool) -> dict[str, Any]:
    """Return the inputs and the joints without a motor.

    If the file has actuators, joints without an actuator are passive. The limits of a motor are its
    control range times its gear. A robot on a fixed base has no inputs on the base.
    """
    fields: dict[str, Any] = {}
    joints = {
        name
        for name in list(model.names)[1:]
        if model.joints[model.getJointId(name)].nv == 1
    }
    driven = dict[str, JointTorque]()
    for element in _children(root, "actuator"):
        name = element.attributes.get("joint", "").strip()
        if name not in joints:
            continue
        driven[name] = JointTorque(name)
        limited = element.attributes.get("ctrllimited") != "false"
        if element.tag == "motor" and limited and "ctrlrange" in element.attributes:
            gear = float(element.attributes.get("gear", "1").split()[0])
            ends = sorted(gear * x for x in element.vector("ctrlrange", 2))
            if ends[0] < ends[1]:
                driven[name] = JointTorque(name, min=ends[0], max=ends[1])
    if driven:
        passive = [name for name in model.names if name in joints - set(driven)]
        if passive:
            fields["passive"] = passive
    if not floats and joints:
        fields["inputs"] = list(driven.values()) or [JointTorque("*")]
    elif any(motor.max is not None for motor in driven.values()):
        motors = [driven[name] for name in model.names if name in driven]
        fields["inputs"] = [BaseTorque(), BaseForce(), *motors]
    return fields


def _notes(root: Element, path: Path) -> Iterator[str]:
    """Yield one warning that lists the content of the file that fflin does not model."""
    parts = [text for tag, text in _IGNORED.items() if any(_all(root, tag))]
    collides = (
        element.attributes.get("contype") != "0"
        or element.attributes.get("conaffinity") != "0"
        for element in _inside(root, "worldbody", "geom")
    )
    if any(collides):
        parts.insert(0, "contacts of geoms")
    others = [x for x in _children(root, "actuator") if x.tag != "motor"]
    if others:
        kinds = ", ".join(dict.fromkeys(x.tag for x in others))
        parts.append(f"{counted(len(others), 'actuator')} other than motors ({kinds})")
    unknown = [x for x in _children(root, "equality") if x.tag not in _HELD]
    if unknown:
        kinds = ", ".join(dict.fromkeys(x.tag for x in unknown))
        parts.append(f"equality constraints other than connect and weld ({kinds})")
    for key, text in (
        ("frictionloss", "Coulomb friction of joints"),
        ("stiffness", "stiffness in default classes"),
    ):
        elements = _all(root, "joint")
        if key == "stiffness":
            elements = _inside(root, "default", "joint")
        if any(x.attributes.get(key, "0") != "0" for x in elements):
            parts.append(text)
    motors = _inside(root, "default", "motor")
    if any({"gear", "ctrlrange"} & set(motor.attributes) for motor in motors):
        parts.append("gear and ctrlrange of motors in default classes")
    if parts:
        yield f"{path.name}: not modelled: {'; '.join(parts)}"


def _all(root: Element, tag: str) -> Iterator[Element]:
    return (element for element in root.iterate() if element.tag == tag)


def _children(root: Element, tag: str) -> Iterator[Element]:
    """Yield the children of all top-level elements with a tag."""
    for section in root.find_all(tag):
        yield from section.children


def _inside(root: Element, section: str, tag: str) -> Iterator[Element]:
    """Yield the elements with a tag at any depth of a top-level section."""
    for top in root.find_all(section):
        yield from (element for element in top.iterate() if element.tag == tag)
