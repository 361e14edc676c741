"""Joints of a URDF, their mimic joints, and the tree that they form with the links."""

import math
import re
import sys
from collections.abc import Callable, Collection, Iterable
from graphlib import CycleError, TopologicalSorter
from typing import NamedTuple, TypeVar

from fflin.base.errors import require_known, unknown
from fflin.robot.urdf.links import (
    Link,
    Pose,
    bounded,
    bounded_length,
    bounded_number,
    read_link,
    read_pose,
    refuse_near_miss,
)
from fflin.robot.urdf.xml import Element, decimal, enumerated, named, quoted

# Degrees of freedom of the types of joint.
FREEDOM = dict(fixed=0, revolute=1, continuous=1, prismatic=1, planar=3, floating=6)
_AXIAL = ("revolute", "continuous", "prismatic", "planar")

# What a joint without a limit is limited to.
UNLIMITED = sys.float_info.max

# An axis this short or long is no direction that somebody meant to write.
_SHORTEST_AXIS, _LONGEST_AXIS = 1e-6, 1e6

# urdfdom and Pinocchio's parser recurse along the tree, about 2.5 kB of stack for each link.
_DEPTH_LIMIT = 1_000

# Pinocchio's time grows with the square of their number; these take some seconds.
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
    origin: Pose  # of the child's frame in the parent's
    axis: tuple[float, ...]  # in the child's frame; Pinocchio scales it to unit length
    limits: dict[str, float] | None  # lower, upper, effort, velocity as given; None without <limit>
    damping: float  # [N m s/rad | N s/m]
    friction: float  # [N m | N]
    mimic: Mimic | None  # as written: the leader may itself be a mimic

    @property
    def freedom(self) -> int:
        """Degrees of freedom."""
        return FREEDOM[self.type]


def read_joint(element: Element) -> JointElement:
    """Read a <joint>; raise `UrdfError` if something in it is wrong."""
    name = element.text("name", "a <joint>")
    of = f"joint {quoted(name)}"
    if name == "universe":
        raise element.error("a joint is named 'universe', Pinocchio's name of the world; rename it")
    kind = element.text("type", of)
    if kind not in FREEDOM:
        advice = "use three revolute joints" if kind == "spherical" else "correct it"
        raise element.error(
            f"{of} has the unknown type {quoted(kind)}; known: {', '.join(FREEDOM)}; {advice}"
        )
    known = ("parent", "child", "origin", "axis", "limit", "dynamics", "mimic")
    refuse_near_miss(element, of, known)
    for child in element.children:
        prefix, _, local = child.tag.rpartition(":")
        if prefix and local == "mimic":
            raise child.error(f"<{child.tag}> in {of} is not known to URDF; write it as <mimic>")
        if prefix and local == "rotor_inertia":
            child.note(f"<{child.tag}> of {of} is ignored: the model has no rotor inertia")
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
    axis: tuple[float, ...] = (1.0, 0.0, 0.0)
    # Exporters write a zero axis into fixed joints; it has no meaning there.
    if kind not in _AXIAL:
        return axis
    if found is not None:
        # Exporters write an rpy of zeros here, which turns nothing.
        turned = any(decimal(entry) != 0.0 for entry in found.attributes.get("rpy", "").split())
        found.allow_only("xyz", *(() if turned else ("rpy",)), of=of)
        axis = found.vector("xyz", f"<axis> of {of}", 3)
        length = math.hypot(*axis)
        if not _SHORTEST_AXIS <= length <= _LONGEST_AXIS:
            raise found.error(
                f"<axis> of {of} has length {length:g}; expected a direction, such as 0 0 1"
            )
    if kind == "planar" and (axis[0] or axis[1] or axis[2] < 0.0):
        raise element.error(
            f"{of} is planar with a normal other than z; rotate its <origin> so that "
            '<axis xyz="0 0 1"/> is the normal of the plane'
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
            f"lower limit {lower:g} of {of} exceeds its upper limit {upper:g}; the model has no "
            "position limits for it"
        )
        limits |= {"lower": -UNLIMITED, "upper": UNLIMITED}
    return limits


def _limit(found: Element, name: str, of: str) -> float:
    """Return one limit. They do not enter the linear model, so a wrong one is no error."""
    none = -UNLIMITED if name == "lower" else UNLIMITED
    text = found.attributes[name].strip()
    value = float(text) if re.fullmatch(r"[+-]?inf(inity)?", text.lower()) else decimal(text)
    least = -math.inf if name in ("lower", "upper") else 0.0
    # Written so that NaN, of what is no number, fails too.
    if not value >= least or value == -math.copysign(math.inf, none):
        expected = "a number" if least else "a number of 0 or more"
        found.note(
            f"limit {name} of {of} is {quoted(text)}, expected {expected}; the limit is ignored"
        )
        return none
    return none if math.isinf(value) else value


def _dynamics(element: Element, of: str, kind: str) -> tuple[float, float]:
    found = element.find("dynamics", of)
    if found is None or FREEDOM[kind] != 1:
        return 0.0, 0.0
    found.allow_only("damping", "friction", of=of)
    return _resistance(found, "damping", of), _resistance(found, "friction", of)


def _resistance(found: Element, name: str, of: str) -> float:
    if not found.attributes.get(name, "0").strip():
        found.note(f"{name} of {of} is empty; taken as 0")
        return 0.0
    value = bounded_number(found, name, of, 0.0)
    if value < 0.0:
        raise found.error(f"{name} of {of} is {value:g}, expected 0 or more; correct it")
    return value


def _mimic(element: Element, of: str) -> Mimic | None:
    found = element.find("mimic", of)
    if found is None:
        return None
    found.allow_only("joint", "multiplier", "offset", of=of)
    return Mimic(
        found.text("joint", f"<mimic> of {of}"),
        bounded_number(found, "multiplier", of, 1.0),
        bounded_number(found, "offset", of, 0.0),
    )


def resolve_mimics(joints: dict[str, JointElement]) -> dict[str, Mimic]:
    """Return {follower: Mimic of an independent joint}, none of fixed joints."""
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
                    if len(loop) > 2
                    else f"joint {quoted(name)} mimics itself; name another joint in its <mimic>"
                )
            chain.append(leader)
        for follower in reversed(chain[:-1]):
            own = written[follower]
            above = resolved.get(own.leader, Mimic(own.leader, 1.0, 0.0))
            element, of = joints[follower].element, f"joint {quoted(follower)}"
            limit = bounded_length if joints[follower].type == "prismatic" else bounded
            resolved[follower] = Mimic(
                above.leader,
                bounded(element, "multiplier", of, own.multiplier * above.multiplier),
                limit(element, "offset", of, own.multiplier * above.offset + own.offset),
            )
    return {name: resolved[name] for name in written}


def counted_leaders(joints: dict[str, JointElement], mimics: dict[str, Mimic]) -> set[str]:
    """Return the continuous leaders a whole turn of which moves a follower elsewhere."""
    return {
        mimic.leader
        for name, mimic in mimics.items()
        if joints[mimic.leader].type == "continuous"
        and not (joints[name].type == "continuous" and mimic.multiplier.is_integer())
    }


def _check_mimic(joint: JointElement, mimic: Mimic, joints: dict[str, JointElement]) -> None:
    if joint.freedom != 1:
        raise joint.element.error(
            f"joint {quoted(joint.name)} is {joint.type} and has a <mimic>; only a joint with one "
            "degree of freedom can mimic another"
        )
    if mimic.leader not in joints:
        error = unknown("joint", mimic.leader[:60], [name[:60] for name in joints])
        raise joint.element.error(
            f"joint {quoted(joint.name)} mimics a joint that does not exist: {error}"
        )
    leader = joints[mimic.leader]
    if leader.freedom != 1:
        raise joint.element.error(
            f"joint {quoted(joint.name)} mimics {quoted(leader.name)}, which is {leader.type}; "
            "name a joint with one degree of freedom"
        )


Part = TypeVar("Part", Link, JointElement)


class Urdf(NamedTuple):
    """Checked content of a URDF: the joints connect the links into one tree."""

    name: str  # empty where the file gives none
    links: dict[str, Link]  # by name, in the order of the file
    joints: dict[str, JointElement]
    depth: int  # number of links on the longest way from the root


def read_description(root: Element, prune: Collection[str] = ()) -> Urdf:
    """Check the elements of a URDF; joints in `prune` are cut off with all that hangs on them."""
    _check_root(root)
    links = _by_name(read_link, root.find_all("link"))
    if len(links) > _LINK_LIMIT:
        raise root.error(
            f"<robot> has {len(links)} links, expected at most {_LINK_LIMIT}; merge links that "
            "are fixed to each other"
        )
    if not links:
        raise root.error("<robot> has no <link>; add one")
    joints = _by_name(read_joint, root.find_all("joint"))
    depths = _check_tree(root, links, joints)
    if prune:
        dropped = _hanging_on(prune, depths, joints)
        joints = {n: joint for n, joint in joints.items() if joint.child not in dropped}
        links = {n: link for n, link in links.items() if n not in dropped}
    _drop_world(links, joints)
    depth = max(depths[name] for name in links)
    return Urdf(root.attributes.get("name", "").strip(), links, joints, depth)


def _check_root(root: Element) -> None:
    if root.tag != "robot":
        raise root.error(f"the root element is <{root.tag[:60]}>; expected <robot>")
    version = root.attributes.get("version", "1.0")
    if version.strip().partition(".")[0] != "1":
        raise root.error(f"<robot> has version {quoted(version)}; expected 1.0, 1.1 or 1.2")
    refuse_near_miss(root, "<robot>", ("link", "joint"))
    parts = {"link": {"inertial"}, "joint": {"parent", "child"}}
    for child in root.children:
        if child.tag == "robot":
            raise child.error(
                "there is a <robot> inside <robot>; keep one <robot> with all links and joints"
            )
        direct = child.tag in parts
        for inner in child.children if direct else child.iterate():
            # Deeper down, what these names stand for tells itself by what it holds.
            tags = {part.tag for part in inner.children}
            if inner.tag in parts and (direct or tags >= parts[inner.tag]):
                raise inner.error(
                    f"<{inner.tag}> inside a <{child.tag}>, where URDF ignores it; put "
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


def _check_tree(
    root: Element, links: dict[str, Link], joints: dict[str, JointElement]
) -> dict[str, int]:
    """Check that the joints connect the links into one tree; return each link's depth."""
    above: dict[str, JointElement] = {}
    for joint in joints.values():
        of = f"joint {quoted(joint.name)}"
        for end, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in links:
                error = unknown("link", name[:60], [link[:60] for link in links])
                raise joint.element.error(f"the {end} of {of} does not exist: {error}")
        if joint.parent == joint.child:
            raise joint.element.error(
                f"{of} connects link {quoted(joint.child)} to itself; correct its parent or child"
            )
        if joint.child in above:
            other = above[joint.child]
            raise joint.element.error(
                f"link {quoted(joint.child)} is the child of {of} and of joint "
                f"{quoted(other.name)} in line {other.element.line}; a link can have only one "
                "parent, so remove one joint: URDF has no closed loops"
            )
        above[joint.child] = joint

    roots = [name for name in links if name not in above]
    if len(roots) > 1:
        raise links[roots[1]].element.error(
            f"the links form {len(roots)} separate trees, with roots {enumerated(roots)}; connect "
            "them by joints"
        )
    depths = dict.fromkeys(roots, 1)
    try:
        for name in TopologicalSorter(
            {x.child: [x.parent] for x in joints.values()}
        ).static_order():
            if name in above:
                depths[name] = depths[above[name].parent] + 1
    except CycleError as error:
        loop = [above[name] for name in error.args[1][:0:-1]]
        raise loop[0].element.error(
            f"{named('joint', [joint.name for joint in loop])} form a closed loop without a root; "
            "correct a parent or child in it"
        ) from None
    deepest = max(depths, key=depths.__getitem__)
    if depths[deepest] > _DEPTH_LIMIT:
        raise root.error(
            f"link {quoted(deepest)} is {depths[deepest]} links deep in the tree, expected at most "
            f"{_DEPTH_LIMIT}; merge links that are fixed to each other"
        )
    return depths


def _drop_world(links: dict[str, Link], joints: dict[str, JointElement]) -> None:
    """Drop a root that stands for the world: without mass and inertia, its one joint floating."""
    children = {joint.child for joint in joints.values()}
    root = next(link for name, link in links.items() if name not in children)
    hanging = [joint for joint in joints.values() if joint.parent == root.name]
    if len(hanging) != 1 or hanging[0].type != "floating" or root.mass or any(root.inertia):
        return
    first = hanging[0]
    first.element.note(
        f"floating joint {quoted(first.name)} and its massless link {quoted(root.name)} are left "
        f"out: the base, link {quoted(first.child)}, is free-floating without them"
    )
    del links[root.name], joints[first.name]


def _hanging_on(
    prune: Collection[str], links: Iterable[str], joints: dict[str, JointElement]
) -> set[str]:
    """Return all links below the joints to prune; `links` has parents first."""
    require_known("joint to prune", prune, joints)
    dropped = {joints[name].child for name in prune}
    parents = {joint.child: joint.parent for joint in joints.values()}
    for name in links:
        if parents.get(name) in dropped:
            dropped.add(name)
    return dropped
