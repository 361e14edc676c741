"""From a checked description to the URDF that Pinocchio is given: what it needs and no more."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace

from fflin.robot.urdf.joints import UNLIMITED, JointElement
from fflin.robot.urdf.links import Link, Pose
from fflin.robot.urdf.tree import Urdf


def write_urdf(urdf: Urdf, counted: Collection[str] = ()) -> str:
    """Write a description without visuals, collisions and extensions.

    Parameters
    ----------
    urdf : Urdf
    counted : collection of str
        Continuous joints whose whole turns count: written as revolute joints without bounds,
        for Pinocchio stores a continuous one as (cos, sin).

    Returns
    -------
    str
        Every number is the double that was read.
    """
    # urdfdom reads quat_xyzw from version 1.1 on; 1.2 would require limits.
    lines = [f'<robot name={_quoted(urdf.name)} version="1.1">']
    for link in urdf.links.values():
        lines.extend(_link(link))
    for joint in urdf.joints.values():
        lines.extend(_joint(_counting(joint) if joint.name in counted else joint))
    lines.append("</robot>")
    return "\n".join(lines)


def _link(link: Link) -> Iterator[str]:
    yield f"<link name={_quoted(link.name)}>"
    if link.mass is not None:
        entries = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        inertia = " ".join(
            f'{name}="{value!r}"' for name, value in zip(entries, link.inertia, strict=True)
        )
        yield f'<inertial>{_origin(link.com)}<mass value="{link.mass!r}"/>'
        yield f"<inertia {inertia}/></inertial>"
    yield "</link>"


def _counting(joint: JointElement) -> JointElement:
    """Return a continuous joint as a revolute one without bounds."""
    unbounded = {"lower": -UNLIMITED, "upper": UNLIMITED}
    return replace(joint, type="revolute", limits=(joint.limits or {}) | unbounded)


def _joint(joint: JointElement) -> Iterator[str]:
    yield f'<joint name={_quoted(joint.name)} type="{joint.type}">'
    yield f"<parent link={_quoted(joint.parent)}/><child link={_quoted(joint.child)}/>"
    yield _origin(joint.origin)
    if joint.freedom == 1:
        yield f'<axis xyz="{_numbers(joint.axis)}"/>'
        if joint.damping or joint.friction:
            yield f'<dynamics damping="{joint.damping!r}" friction="{joint.friction!r}"/>'
    if joint.type in ("revolute", "prismatic") or joint.limits:
        yield _limit(joint)
    yield "</joint>"


def _limit(joint: JointElement) -> str:
    limits = {"effort": UNLIMITED, "velocity": UNLIMITED}
    if joint.limits is None:
        limits |= {"lower": -UNLIMITED, "upper": UNLIMITED}
    limits |= joint.limits or {}
    entries = " ".join(f'{name}="{value!r}"' for name, value in limits.items())
    return f"<limit {entries}/>"


def _origin(pose: Pose) -> str:
    if pose.quaternion is not None:
        attitude = f'quat_xyzw="{_numbers(pose.quaternion)}"'
    else:
        attitude = f'rpy="{_numbers(pose.rpy)}"'
    return f'<origin xyz="{_numbers(pose.xyz)}" {attitude}/>'


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(repr(value) for value in values)


def _quoted(text: str) -> str:
    """Write an attribute's value. The standard library's writer loads its network client."""
    for character, entity in (("&", "&amp;"), ("<", "&lt;"), (">", "&gt;"), ('"', "&quot;")):
        text = text.replace(character, entity)
    for character in "\t\n\r":
        text = text.replace(character, f"&#{ord(character)};")
    return f'"{text}"'
