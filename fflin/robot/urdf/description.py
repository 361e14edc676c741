"""Checks of a URDF's content: links, inertias, joints, mimic joints and the tree."""

import math
import sys
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import unknown
from fflin.base.validation import Array
from fflin.robot.urdf.xml import Element, decimal, enumerated, named, quoted

# Degrees of freedom of each joint type.
FREEDOM = dict(fixed=0, revolute=1, continuous=1, prismatic=1, planar=3, floating=6)

# Value that stands for a missing limit in the Pinocchio model.
UNLIMITED = sys.float_info.max

# Largest coordinate of an <origin>. In double precision, 1e8^2 + 1 equals 1e8^2. At a distance of
# 1e8 m, a link's moments of inertia would therefore be lost in the sum with mass * distance^2, and
# ABA would divide zero by zero.
_FARTHEST = 1e7  # [m]

# Tolerance of the length of a quaternion. It is large, because many files give only four digits.
_QUATERNION_SLACK = 1e-3

# An axis whose length is outside these bounds is an error in the file.
_SHORTEST_AXIS, _LONGEST_AXIS = 1e-6, 1e6

# Rounding can change a zero eigenvalue of an inertia to -1e-16 times the largest eigenvalue. The
# tolerance is larger than 1e-16, because CAD programs write fewer digits.
_NEGATIVE_SLACK = 1e-9

# CAD programs may give a point mass a small inertia of either sign, which is only a rounding error.
# A negative inertia counts as such an error if its magnitude is at most the mass times the square
# of this length.
_POINT = 1e-6  # [m]

# A link and all links that are fixed to it form one rigid body. A negative principal moment of the
# link is accepted if its magnitude is at most this fraction of the body's least principal moment.
# It then changes M by less than the rounding of published numbers does.
_LOST_IN_BODY = 1e-6

# Relative tolerance by which a principal moment may exceed the sum of the other two. For a flat
# plate, the moment is equal to this sum, and published numbers may have only three digits.
TRIANGLE_SLACK = 1e-3

# urdfdom and Pinocchio's parser recurse along the tree, and take about 2.5 kB of stack per link.
_DEPTH_LIMIT = 1_000

# Most robots have fewer than 100 links. The limit bounds computing time and memory.
_LINK_LIMIT = 10_000

# Attributes of <inertia>, which are the entries of the upper triangle of the matrix, row by row.
INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")

# Entries below the diagonal, which some programs also write, with the equal entries above it.
_BELOW_DIAGONAL = {"iyx": "ixy", "izx": "ixz", "izy": "iyz"}


class Pose(NamedTuple):
    """Placement of a frame in another frame, in the form in which the file gives it."""

    xyz: tuple[float, ...] = (0.0, 0.0, 0.0)  # [m]
    rpy: tuple[float, ...] = (0.0, 0.0, 0.0)  # roll, pitch, yaw about fixed axes [rad]
    # x y z w of unit length, in place of rpy
    quaternion: tuple[float, ...] | None = None

    @property
    def placement(self) -> pin.SE3:
        """Placement as a Pinocchio object."""
        if self.quaternion is not None:
            return pin.XYZQUATToSE3(np.array([*self.xyz, *self.quaternion]))
        return pin.SE3(pin.rpy.rpyToMatrix(*self.rpy), np.array(self.xyz))


class Link(NamedTuple):
    """Link of a URDF, and its XML element."""

    name: str
    element: Element
    mass: float | None = None  # [kg]; None without <inertial>
    com: Pose = Pose()  # centre of mass, and axes of the inertia
    inertia: Array = np.zeros((3, 3))  # [kg m^2] about the centre of mass


class Mimic(NamedTuple):
    """Rule of a mimic joint, whose position is ``multiplier * leader's position + offset``."""

    leader: str
    multiplier: float  # [rad/rad, m/rad, ...]
    offset: float  # [rad|m]


class JointElement(NamedTuple):
    """Joint of a URDF between two links, and its XML element."""

    name: str
    element: Element
    type: str
    parent: str
    child: str
    origin: Pose  # placement of the child's frame in the parent's frame
    mimic: Mimic | None  # as in the file, where the leader may be a mimic joint too
    axis: tuple[float, ...] = (1.0, 0.0, 0.0)  # in the child's frame, of any length
    # lower, upper, effort and velocity, if given
    limits: dict[str, float] | None = None
    damping: float = 0.0  # [N m s/rad | N s/m]
    friction: float = 0.0  # [N m | N]

    @property
    def freedom(self) -> int:
        """Number of degrees of freedom."""
        return FREEDOM[self.type]


def read_link(name: str, element: Element) -> Link:
    """Read a <link>, or raise `UrdfError` if it is invalid."""
    element.refuse_near_miss("inertial")
    for misplaced in element.find_all("mass"):
        raise misplaced.error(
            f"<mass> is directly in {element.title}; put it into an <inertial>"
        )
    inertial = element.find("inertial")
    if inertial is None:
        return Link(name, element)
    inertial.refuse_near_miss("origin", "mass", "inertia")
    weight = inertial.require("mass", "value")
    inertia = inertial.require("inertia", *INERTIA, *_BELOW_DIAGONAL)
    for below, above in _BELOW_DIAGONAL.items():
        if below in inertia.attributes and inertia.number(below) != inertia.number(
            above
        ):
            raise inertia.error(
                f"{below} of {inertia.title} is {inertia.number(below):g}, but {above} is "
                f"{inertia.number(above):g}; an inertia is symmetric, so make them equal"
            )
    mass = weight.number("value")
    if mass < 0.0:
        raise weight.error(
            f"{weight.title} is {mass:g} kg, expected 0 or more; correct it"
        )
    xx, xy, xz, yy, yz, zz = map(inertia.number, INERTIA)
    tensor = np.array(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
    return Link(name, element, mass, read_pose(inertial), tensor)


def read_pose(element: Element) -> Pose:
    """Read the <origin> of an element; return the identity if the element has no <origin>."""
    origin = element.find("origin", "xyz", "rpy", "quat_xyzw")
    if origin is None:
        return Pose()
    given = origin.attributes
    xyz: tuple[float, ...] = (0.0, 0.0, 0.0)
    if "xyz" in given:
        xyz = origin.vector("xyz", 3)
    rpy: tuple[float, ...] = (0.0, 0.0, 0.0)
    if "rpy" in given:
        rpy = origin.vector("rpy", 3)
    if (longest := max(map(abs, xyz))) > _FARTHEST:
        raise origin.error(
            f"xyz of {origin.title} has an entry of {longest:g} m, expected at most "
            f"{_FARTHEST:g} m; correct it"
        )
    if "quat_xyzw" not in given:
        return Pose(xyz, rpy)
    if "rpy" in given:
        raise origin.error(
            f"{origin.title} has both rpy and quat_xyzw; keep one of them"
        )
    quaternion = origin.vector("quat_xyzw", 4)
    length = float(np.hypot.reduce(quaternion))
    if not abs(length - 1.0) <= _QUATERNION_SLACK:
        raise origin.error(
            f"quat_xyzw of {origin.title} has length {length:g}, expected 1"
        )
    return Pose(xyz, rpy, tuple(float(entry / length) for entry in quaternion))


def read_joint(name: str, element: Element) -> JointElement:
    """Read a <joint>, or raise `UrdfError` if it is invalid."""
    kind = element.text("type")
    title = element.title
    if kind not in FREEDOM:
        raise element.error(
            f"{title} has the unknown type {quoted(kind)}; use {', '.join(FREEDOM)}"
        )
    element.refuse_near_miss(
        "parent", "child", "origin", "axis", "limit", "dynamics", "mimic"
    )
    for child in element.children:
        if child.tag.endswith(":mimic"):
            raise child.error(
                f"<{child.tag}> in {title} is not known to URDF; write it as <mimic>"
            )
    parent, below = (
        element.require(end, "link").text("link") for end in ("parent", "child")
    )
    mimic = None
    if mimic_element := element.find("mimic", "joint", "multiplier", "offset"):
        numbers = (
            mimic_element.number("multiplier", 1.0),
            mimic_element.number("offset", 0.0),
        )
        mimic = Mimic(mimic_element.text("joint"), *numbers)
    joint = JointElement(name, element, kind, parent, below, read_pose(element), mimic)
    # Read the axis, dynamics and limits only of joints with one degree of freedom. Do not check the
    # axis of any other joint, because exporters may write an axis of zeros.
    if FREEDOM[kind] != 1:
        return joint
    if axis_element := element.find("axis", "xyz"):
        joint = joint._replace(axis=axis_element.vector("xyz", 3))
        length = math.hypot(*joint.axis)
        if not _SHORTEST_AXIS <= length <= _LONGEST_AXIS:
            raise axis_element.error(
                f"{axis_element.title} has length {length:g}, expected a direction such as 0 0 1"
            )
    if dynamics := element.find("dynamics", "damping", "friction"):
        damping, friction = (dynamics.number(x, 0.0) for x in ("damping", "friction"))
        if min(damping, friction) < 0.0:
            raise dynamics.error(
                f"damping {damping:g} and friction {friction:g} of {title}: expected 0 or more; "
                "correct the negative value"
            )
        joint = joint._replace(damping=damping, friction=friction)
    if limit_element := element.find("limit"):
        joint = joint._replace(limits=_limits(limit_element))
    return joint


def _limits(element: Element) -> dict[str, float]:
    """Return the limits of a <limit>; an invalid limit becomes infinite.

    An invalid limit causes only a note, because A and B do not depend on limits.
    """
    limits: dict[str, float] = {}
    for name in (
        x for x in ("lower", "upper", "effort", "velocity") if x in element.attributes
    ):
        written = element.attributes[name]
        value = decimal(written.strip())
        if math.isnan(value) or (value < 0.0 and name in ("effort", "velocity")):
            element.note(
                f"limit {name} of {element.owner} is {quoted(written)}, expected a number (0 or "
                "more for effort and velocity); the limit is ignored"
            )
            value = -math.inf if name == "lower" else math.inf
        limits[name] = max(-UNLIMITED, min(value, UNLIMITED))
    lower, upper = limits.get("lower", 0.0), limits.get("upper", 0.0)
    if lower > upper:
        element.note(
            f"lower limit {lower:g} of {element.owner} exceeds its upper limit {upper:g}; both "
            "position limits are ignored"
        )
        limits |= {"lower": -UNLIMITED, "upper": UNLIMITED}
    return limits


def resolve_mimics(joints: dict[str, JointElement]) -> dict[str, Mimic]:
    """Return {mimic joint: its rule relative to an independent joint}; omit fixed joints."""
    written = {
        name: joint.mimic
        for name, joint in joints.items()
        if joint.mimic and joint.freedom
    }
    resolved: dict[str, Mimic] = {}
    for name in written:
        chain = [name]
        while (follower := chain[-1]) in written and follower not in resolved:
            leader, element = written[follower].leader, joints[follower].element
            if leader not in joints:
                error = unknown("joint", leader[:60], [name[:60] for name in joints])
                raise element.error(
                    f"{element.title} mimics a joint that does not exist: {error}"
                )
            for joint_name in (follower, leader):
                if joints[joint_name].freedom != 1:
                    raise element.error(
                        f"{element.title} mimics {quoted(leader)}, but {quoted(joint_name)} is "
                        f"{joints[joint_name].type}; both joints must have one degree of freedom"
                    )
            if leader in chain:
                loop = [*chain[chain.index(leader) :], leader]
                raise element.error(
                    f"the mimic joints {enumerated(loop)} form a loop; remove the <mimic> of one "
                    "of them"
                )
            chain.append(leader)
        for follower in reversed(chain[:-1]):
            leader, multiplier, offset = written[follower]
            above = resolved.get(leader, Mimic(leader, 1.0, 0.0))
            resolved[follower] = Mimic(
                above.leader,
                multiplier * above.multiplier,
                multiplier * above.offset + offset,
            )
    return {name: resolved[name] for name in written}


def read_tree(root: Element) -> tuple[dict[str, Link], dict[str, JointElement]]:
    """Check the elements of a URDF; return its links and joints by name, in the file's order."""
    if root.tag != "robot":
        raise root.error(f"the root element is <{root.tag[:60]}>; expected <robot>")
    root.refuse_near_miss("link", "joint")
    # Refuse robots, links and joints in the wrong place. Recognise them by their children, because
    # extensions of URDF may use the same tags for elements with other children.
    typical_children = {
        "robot": {"link"},
        "link": {"inertial"},
        "joint": {"parent", "child"},
    }
    for child in root.children:
        candidates = list(child.iterate())
        # A <link> or <joint> directly in the root is in the right place, but a <robot> is not.
        if child.tag == "robot":
            candidates.insert(0, child)
        for inner in candidates:
            if inner.tag not in typical_children:
                continue
            inner_tags = {part.tag for part in inner.children}
            if typical_children[inner.tag].issubset(inner_tags):
                raise inner.error(
                    f"a <{inner.tag}> is inside a <{child.tag}>, where URDF ignores it; put "
                    f"{quoted(inner.attributes.get('name', ''))} directly into <robot>"
                )
    links = {
        name: read_link(name, element)
        for name, element in _by_name(root, "link").items()
    }
    if not links:
        raise root.error("<robot> has no <link>; add one")
    if len(links) > _LINK_LIMIT:
        raise root.error(
            f"<robot> has {len(links)} links, expected at most {_LINK_LIMIT}; merge links that are "
            "fixed to each other"
        )
    joints = {
        name: read_joint(name, element)
        for name, element in _by_name(root, "joint").items()
    }
    _check_tree(root, links, joints)
    return links, joints


def _by_name(root: Element, tag: str) -> dict[str, Element]:
    """Return {name: element} of the children with a tag; raise `UrdfError` for a repeated name."""
    elements: dict[str, Element] = {}
    for element in root.find_all(tag):
        name = element.text("name")
        if (earlier := elements.setdefault(name, element)) is not element:
            raise element.error(
                f"a second {tag} has the name {quoted(name)}, which is already used in line "
                f"{earlier.line}; rename one of them"
            )
    return elements


def _check_tree(
    root: Element, links: dict[str, Link], joints: dict[str, JointElement]
) -> None:
    """Raise `UrdfError` unless the joints connect the links into one tree that is not too deep."""
    above: dict[str, JointElement] = {}
    children: dict[str, list[str]] = {}
    for joint in joints.values():
        title = joint.element.title
        for end, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in links:
                error = unknown("link", name[:60], [link[:60] for link in links])
                raise joint.element.error(
                    f"the {end} of {title} does not exist: {error}"
                )
        if other := above.get(joint.child):
            raise joint.element.error(
                f"link {quoted(joint.child)} is the child of {title} and of {other.element.title} "
                f"in line {other.element.line}; a link can have only one parent, because URDF has "
                "no closed loops; remove one of these joints"
            )
        above[joint.child] = joint
        children.setdefault(joint.parent, []).append(joint.child)
    roots = [name for name in links if name not in above]
    if len(roots) > 1:
        raise links[roots[1]].element.error(
            f"the links form {len(roots)} separate trees, with roots {enumerated(roots)}; connect "
            "them by joints"
        )
    depth = 0
    level = roots
    while level:
        depth += 1
        for name in level:
            above.pop(name, None)
        level = [child for name in level for child in children.get(name, ())]
    loop = [*above.values()]  # no path leads from the root to these joints
    if loop:
        raise loop[0].element.error(
            f"{named('joint', [joint.name for joint in loop])} form a closed loop without a root; "
            "correct a parent or child in it"
        )
    if depth > _DEPTH_LIMIT:
        raise root.error(
            f"the tree is {depth} links deep, expected at most {_DEPTH_LIMIT}; merge links that "
            "are fixed to each other"
        )


def is_impossible(mass: float, moments: Sequence[float]) -> bool:
    """Return whether a principal moment [kg m^2] is too negative to be a rounding error.

    `moments` are sorted in increasing order.
    """
    # A negative moment counts as a rounding error in two cases: it is small compared with the
    # largest moment, or the body may be a point mass. If all mass is within the distance _POINT of
    # the centre of mass, no moment exceeds mass * _POINT^2.
    return moments[0] < -max(_NEGATIVE_SLACK * moments[-1], mass * _POINT**2)


def inertia_notes(links: Iterable[Link], model: pin.Model, origin: str) -> list[str]:
    """Return notes about unusual inertias.

    Raise `UrdfError` for a negative principal moment of a link, unless the moment is a rounding
    error, or negligible compared with the moments of the rigid body that contains the link.
    """
    unequal, weightless, negligible = [], [], []
    for link in links:
        least, middle, largest = np.linalg.eigvalsh(link.inertia).tolist()
        if is_impossible(link.mass or 0.0, (least, middle, largest)):
            joint = model.frames[
                model.getFrameId(link.name, pin.FrameType.BODY)
            ].parentJoint
            of_body = np.linalg.eigvalsh(model.inertias[joint].inertia)[0]
            if abs(least) > _LOST_IN_BODY * of_body:
                raise link.element.error(
                    f"the inertia of {link.element.title} has principal moments {least:.3g}, "
                    f"{middle:.3g}, {largest:.3g} kg m^2, expected 0 or more; correct ixx ... izz"
                )
            negligible.append(link.name)
        elif largest - middle - least > TRIANGLE_SLACK * abs(largest):
            unequal.append(link.name)
        if not link.mass and link.inertia.any():
            weightless.append(link.name)
    lost = (
        f"the inertia of {named('link', negligible)} has a negative principal moment, "
    )
    notes = (
        (negligible, f"{lost}negligible compared with the links it is fixed to"),
        # The largest principal moment of these links exceeds the sum of the other two.
        (unequal, f"unphysical inertia: {enumerated(unequal)}"),
        (weightless, f"inertia without mass: {named('link', weightless)}"),
    )
    return [f"{origin}: {text}" for names, text in notes if names]
