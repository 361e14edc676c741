"""From a checked description to the URDF that Pinocchio is given: what it needs and no more."""

from collections.abc import Collection, Iterator, Mapping

from fflin.robot.urdf.joints import UNLIMITED, JointElement
from fflin.robot.urdf.links import INERTIA, Link, Pose
from fflin.robot.urdf.tree import Urdf

_ENTITIES = {ord(letter): f"&#{ord(letter)};" for letter in "&<>\"'\t\n\r"}


def write_urdf(urdf: Urdf, counted: Collection[str] = ()) -> str:
    """Write what moves, to the last bit; `counted` joints are revolute, for their turns count."""
    # urdfdom reads quat_xyzw from version 1.1 on; 1.2 would require limits.
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
    """Write an attribute's value. The standard library's ways load far more than they do."""
    return f'"{text.translate(_ENTITIES)}"'
