"""Joints of a URDF, their mimic joints, and the tree that they form with the links."""

import math
import sys
from collections.abc import Callable
from typing import NamedTuple, TypeVar

from fflin.base.errors import unknown
from fflin.robot.urdf.links import (
    Link,
    Pose,
    read_link,
    read_pose,
    refuse_near_miss,
)
from fflin.robot.urdf.xml import Element, decimal, enumerated, named, quoted

# Degrees of freedom of each joint type.
FREEDOM = dict(fixed=0, revolute=1, continuous=1, prismatic=1, planar=3, floating=6)

# Value of a missing limit in the model.
UNLIMITED = sys.float_info.max

# An axis whose length is outside these bounds is an error in the file.
_SHORTEST_AXIS, _LONGEST_AXIS = 1e-6, 1e6

# urdfdom and Pinocchio's parser recurse along the tree, and take about 2.5 kB of stack per link.
_DEPTH_LIMIT = 1_000

# Most robots have fewer than 100 links. The limit bounds computing time and memory.
_LINK_LIMIT = 10_000


class Mimic(NamedTuple):
    """A joint that moves with another: value = multiplier * leader's value + offset."""

    leader: str
    multiplier: float  # [rad/rad, m/rad, ...]
    offset: float  # [rad|m]


class JointElement(NamedTuple):
    """One joint between two links, and the element that describes it."""

    name: str
    type: str
    parent: str
    child: str
    element: Element
    origin: Pose  # placement of the child's frame in the parent's frame
    axis: tuple[float, ...]  # in the child's frame; Pinocchio scales it to unit length
    limits: dict[str, float] | None  # given lower, upper, effort, velocity; None without <limit>
    damping: float  # [N m s/rad | N s/m]
    friction: float  # [N m | N]
    mimic: Mimic | None  # as in the file, where the leader may be a mimic joint too

    @property
    def freedom(self) -> int:
        """Number of degrees of freedom."""
        return FREEDOM[self.type]


def read_joint(element: Element) -> JointElement:
    """Read a <joint>, or raise `UrdfError` if it is invalid."""
    name = element.text("name", "a <joint>")
    of = f"joint {quoted(name)}"
    kind = element.text("type", of)
    if kind not in FREEDOM:
        raise element.error(f"{of} has the unknown type {quoted(kind)}; use {', '.join(FREEDOM)}")
    known = ("parent", "child", "origin", "axis", "limit", "dynamics", "mimic")
    refuse_near_miss(element, of, known)
    for child in element.children:
        if child.tag.endswith(":mimic"):
            raise child.error(f"<{child.tag}> in {of} is not known to URDF; write it as <mimic>")
    ends = {end: element.require(end, of) for end in ("parent", "child")}
    for found in ends.values():
        found.allow_only("link", of=of)
    parent, below = (ends[end].text("link", f"<{end}> of {of}") for end in ends)
    damping, friction = _dynamics(element, of, kind)
    origin, axis = read_pose(element, of), _axis(element, of, kind)
    limits, mimic = _limits(element, of, kind), _mimic(element, of)
    about = element, origin, axis, limits, damping, friction, mimic
    return JointElement(name, kind, parent, below, *about)


def _axis(element: Element, of: str, kind: str) -> tuple[float, ...]:
    found = element.find("axis", of)
    # Fixed joints need no axis, and exporters write zeros for it.
    if found is None or FREEDOM[kind] != 1:
        return (1.0, 0.0, 0.0)
    found.allow_only("xyz", of=of)
    axis = found.vector("xyz", f"<axis> of {of}", 3)
    length = math.hypot(*axis)
    if not _SHORTEST_AXIS <= length <= _LONGEST_AXIS:
        raise found.error(
            f"<axis> of {of} has length {length:g}; expected a direction, such as 0 0 1"
        )
    return axis


def _limits(element: Element, of: str, kind: str) -> dict[str, float] | None:
    found = element.find("limit", of)
    if found is None or FREEDOM[kind] != 1:
        return None
    names = ("lower", "upper", "effort", "velocity")
    limits = {name: _limit(found, name, of) for name in names if name in found.attributes}
    lower, upper = limits.get("lower", 0.0), limits.get("upper", 0.0)
    if lower > upper:
        found.note(
            f"lower limit {lower:g} of {of} exceeds its upper limit {upper:g}; both position "
            "limits are ignored"
        )
        limits |= {"lower": -UNLIMITED, "upper": UNLIMITED}
    return limits


def _limit(found: Element, name: str, of: str) -> float:
    """Return one limit; an invalid limit causes only a note, as models do not depend on limits."""
    value = decimal(found.attributes[name].strip())
    if math.isnan(value) or (value < 0.0 and name in ("effort", "velocity")):
        found.note(
            f"limit {name} of {of} is {quoted(found.attributes[name])}, expected a number (0 or "
            "more for effort and velocity); the limit is ignored"
        )
        value = -math.inf if name == "lower" else math.inf
    return max(-UNLIMITED, min(value, UNLIMITED))


def _dynamics(element: Element, of: str, kind: str) -> tuple[float, float]:
    found = element.find("dynamics", of)
    if found is None or FREEDOM[kind] != 1:
        return 0.0, 0.0
    found.allow_only("damping", "friction", of=of)
    damping, friction = (
        found.number(x, f"<dynamics> of {of}", 0.0) for x in ("damping", "friction")
    )
    if min(damping, friction) < 0.0:
        raise found.error(
            f"damping {damping:g} and friction {friction:g} of {of}: expected 0 or more; correct "
            "the negative value"
        )
    return damping, friction


def _mimic(element: Element, of: str) -> Mimic | None:
    found = element.find("mimic", of)
    if found is None:
        return None
    found.allow_only("joint", "multiplier", "offset", of=of)
    return Mimic(
        found.text("joint", f"<mimic> of {of}"),
        found.number("multiplier", f"<mimic> of {of}", 1.0),
        found.number("offset", f"<mimic> of {of}", 0.0),
    )


def resolve_mimics(joints: dict[str, JointElement]) -> dict[str, Mimic]:
    """Return {mimic joint: Mimic of an independent joint}, without fixed joints."""
    written = {name: joint.mimic for name, joint in joints.items() if joint.mimic and joint.freedom}
    resolved: dict[str, Mimic] = {}
    for name in written:
        chain = [name]
        while (follower := chain[-1]) in written and follower not in resolved:
            _check_mimic(joints[follower], written[follower], joints)
            leader = written[follower].leader
            if leader in chain:
                loop = [*chain[chain.index(leader) :], leader]
                raise joints[follower].element.error(
                    f"the mimic joints {enumerated(loop)} form a loop; remove the <mimic> of one "
                    "of them"
                )
            chain.append(leader)
        for follower in reversed(chain[:-1]):
            own = written[follower]
            above = resolved.get(own.leader, Mimic(own.leader, 1.0, 0.0))
            resolved[follower] = Mimic(
                above.leader,
                own.multiplier * above.multiplier,
                own.multiplier * above.offset + own.offset,
            )
    return {name: resolved[name] for name in written}


def counted_leaders(joints: dict[str, JointElement], mimics: dict[str, Mimic]) -> set[str]:
    """Return the continuous leaders for which a full turn leaves some mimic joint displaced."""
    return {
        mimic.leader
        for name, mimic in mimics.items()
        if joints[mimic.leader].type == "continuous"
        and not (joints[name].type == "continuous" and mimic.multiplier.is_integer())
    }


def _check_mimic(joint: JointElement, mimic: Mimic, joints: dict[str, JointElement]) -> None:
    if mimic.leader not in joints:
        error = unknown("joint", mimic.leader[:60], [name[:60] for name in joints])
        raise joint.element.error(
            f"joint {quoted(joint.name)} mimics a joint that does not exist: {error}"
        )
    for each in (joint, joints[mimic.leader]):
        if each.freedom != 1:
            raise joint.element.error(
                f"joint {quoted(joint.name)} mimics {quoted(mimic.leader)}, but "
                f"{quoted(each.name)} is {each.type}; both joints must have one degree of freedom"
            )


Part = TypeVar("Part", Link, JointElement)


class Urdf(NamedTuple):
    """Checked content of a URDF: the joints connect the links into one tree."""

    name: str  # empty without a name in the file
    links: dict[str, Link]  # {name: link} in the order of the file
    joints: dict[str, JointElement]
    depth: int  # number of links on the longest path from the root


def read_description(root: Element) -> Urdf:
    """Check the elements of a URDF, and return its content."""
    _check_root(root)
    links = _by_name(read_link, root.find_all("link"))
    if not links:
        raise root.error("<robot> has no <link>; add one")
    if len(links) > _LINK_LIMIT:
        raise root.error(
            f"<robot> has {len(links)} links, expected at most {_LINK_LIMIT}; merge links that are "
            "fixed to each other"
        )
    joints = _by_name(read_joint, root.find_all("joint"))
    depth = _check_tree(root, links, joints)
    return Urdf(root.attributes.get("name", "").strip(), links, joints, depth)


def _check_root(root: Element) -> None:
    if root.tag != "robot":
        raise root.error(f"the root element is <{root.tag[:60]}>; expected <robot>")
    refuse_near_miss(root, "<robot>", ("link", "joint"))
    # Extensions of URDF have elements with these names too, but with other children. So nested
    # elements are recognised by their children.
    marks = {"robot": {"link"}, "link": {"inertial"}, "joint": {"parent", "child"}}
    for child in root.children:
        for inner in (child, *child.iterate()):
            nested = inner.tag == "robot" or inner is not child
            if nested and marks.get(inner.tag, {""}) <= {part.tag for part in inner.children}:
                raise inner.error(
                    f"a <{inner.tag}> is inside a <{child.tag}>, where URDF ignores it; put "
                    f"{quoted(inner.attributes.get('name', ''))} directly into <robot>"
                )


def _by_name(read: Callable[[Element], Part], elements: list[Element]) -> dict[str, Part]:
    parts: dict[str, Part] = {}
    for element in elements:
        part = read(element)
        earlier = parts.setdefault(part.name, part)
        if earlier is not part:
            raise element.error(
                f"a second {element.tag} has the name {quoted(part.name)}, which is already used "
                f"in line {earlier.element.line}; rename one of them"
            )
    return parts


def _check_tree(root: Element, links: dict[str, Link], joints: dict[str, JointElement]) -> int:
    """Check that the joints connect the links into one tree; return the tree's depth in links."""
    above: dict[str, JointElement] = {}
    for joint in joints.values():
        of = f"joint {quoted(joint.name)}"
        for end, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in links:
                error = unknown("link", name[:60], [link[:60] for link in links])
                raise joint.element.error(f"the {end} of {of} does not exist: {error}")
        if joint.child in above:
            other = above[joint.child]
            raise joint.element.error(
                f"link {quoted(joint.child)} is the child of {of} and of joint "
                f"{quoted(other.name)} in line {other.element.line}; a link can have only one "
                "parent, because URDF has no closed loops; remove one of these joints"
            )
        above[joint.child] = joint

    roots = [name for name in links if name not in above]
    if len(roots) > 1:
        raise links[roots[1]].element.error(
            f"the links form {len(roots)} separate trees, with roots {enumerated(roots)}; connect "
            "them by joints"
        )
    children: dict[str, list[str]] = {}
    for joint in joints.values():
        children.setdefault(joint.parent, []).append(joint.child)
    depth, level, reached = 0, roots, set[str]()
    while level:
        depth += 1
        reached.update(level)
        level = [child for name in level for child in children.get(name, ())]
    if loop := [joint for name, joint in above.items() if name not in reached]:
        raise loop[0].element.error(
            f"{named('joint', [joint.name for joint in loop])} form a closed loop without a root; "
            "correct a parent or child in it"
        )
    if depth > _DEPTH_LIMIT:
        raise root.error(
            f"the tree is {depth} links deep, expected at most {_DEPTH_LIMIT}; merge links that "
            "are fixed to each other"
        )
    return depth
