"""Checks that the links and joints of a URDF form one tree."""

from collections.abc import Callable, Collection, Iterable
from graphlib import CycleError, TopologicalSorter
from typing import NamedTuple, TypeVar

from fflin.base.errors import unknown
from fflin.robot.urdf.joints import JointElement, read_joint
from fflin.robot.urdf.links import Link, read_link, refuse_near_miss
from fflin.robot.urdf.xml import Element, enumerated, named, quoted

# urdfdom and Pinocchio's parser recurse along the tree, about 2.5 kB of stack for each link.
_DEPTH_LIMIT = 1_000

# Pinocchio's time grows with the square of their number; these take some seconds.
_LINK_LIMIT = 10_000

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
                f"this is the second {element.tag} named {quoted(part.name)}, the first is in line "
                f"{earlier.element.line}; rename one of them"
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
    """Return what hangs on joints, of links of which each comes after its parent."""
    for name in prune:
        if name not in joints:
            raise unknown("joint to prune", name, joints)
    dropped = {joints[name].child for name in prune}
    parents = {joint.child: joint.parent for joint in joints.values()}
    for name in links:
        if parents.get(name) in dropped:
            dropped.add(name)
    return dropped
