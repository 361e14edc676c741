"""Mimic joints of a URDF: each resolved down to the independent joint that it follows."""

from __future__ import annotations

from fflin.base.errors import unknown
from fflin.robot.urdf.joints import JointElement, Mimic
from fflin.robot.urdf.links import bounded, bounded_length
from fflin.robot.urdf.xml import enumerated, quoted


def resolve_mimics(joints: dict[str, JointElement]) -> dict[str, Mimic]:
    """Return {follower: Mimic of an independent joint}, none of fixed joints."""
    written = {name: joint.mimic for name, joint in joints.items() if joint.mimic and joint.freedom}
    resolved: dict[str, Mimic] = {}
    for name in written:
        chain = [name]
        while (follower := chain[-1]) in written and follower not in resolved:
            _check(joints[follower], written[follower], joints)
            leader = written[follower].leader
            if leader in chain:
                loop = [*chain[chain.index(leader) :], leader]
                raise joints[follower].element.error(
                    f"the mimic joints {enumerated(loop)} follow each other in a circle; one of "
                    "them must be free"
                    if len(loop) > 2
                    else f"joint {quoted(name)} mimics itself; name the joint that it follows"
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


def _check(joint: JointElement, mimic: Mimic, joints: dict[str, JointElement]) -> None:
    if joint.freedom != 1:
        raise joint.element.error(
            f"joint {quoted(joint.name)} is {joint.type} and has a <mimic>; only a joint of one "
            "degree of freedom can follow another"
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
            "a leader has one degree of freedom"
        )
