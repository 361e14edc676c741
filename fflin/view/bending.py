"""Flexible appendages and slosh as they are drawn: links that bend, and balls without a link."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.robot.equipment.appendages import FlexibleAppendage, Slosh
from fflin.robot.joints import find_frame
from fflin.robot.robot import Robot
from fflin.robot.urdf.xml import Element

_DENSITY = 1000.0  # [kg/m^3] of the ball that stands for a mass


class Bending(NamedTuple):
    """Motion of an appendage's links by its modes, to first order: a rotation about its frame.

    Of all rotations, it fits the mode shapes best that have the participation of the modes.
    """

    node: int  # Pinocchio joint of the first mode, whose node of the scene carries the links
    carrier: int  # Pinocchio joint
    frame: pin.SE3  # on the carrier
    modes: list[int]  # in q
    twist: Array  # (6, k) for a unit of q: translation over rotation
    center: Array  # (3,) of a ball that stands for the links, in the frame

    def placement(self, data: pin.Data, q: Array) -> pin.SE3:
        """Return the placement of the bent frame in the world."""
        shift, turn = np.split(self.twist @ q[self.modes], 2)
        return data.oMi[self.carrier] * self.frame * pin.SE3(pin.exp3(turn), shift)


@lru_cache(maxsize=4)
def bendings(robot: Robot) -> dict[str, Bending]:
    """Return {title: bending} of the flexible appendages of a robot."""
    found = {}
    for item in robot.appendages:
        if isinstance(item, FlexibleAppendage):
            joints = [robot.joint(name) for name in item.modes]
            scale = np.array([joint.scale for joint in joints])
            turn, shift = np.linalg.pinv(item.rotation).T, np.zeros((3, len(joints)))
            if not turn.any():
                shift = np.linalg.pinv(item.translation).T
            t, r = item.translation[:, 0], item.rotation[:, 0]
            found[item.title] = Bending(
                robot.model.getJointId(joints[0].name),
                *find_frame(robot.model, item.frame),
                [joint.idx_q for joint in joints],
                np.vstack((shift, turn)) / scale,
                np.cross(t, r) / max(float(t @ t), 1e-12),
            )
    return found


def bent_links(robot: Robot, root: Element) -> dict[str, Bending]:
    """Return {link: bending} of the links of a URDF that are fixed to an appendage's frame."""
    children: dict[str, list[str]] = {}
    for joint in root.find_all("joint"):
        ends = [joint.find_all(end) for end in ("parent", "child")]
        if all(ends):
            parent, child = (end[0].attributes.get("link", "") for end in ends)
            children.setdefault(parent, []).append(child)
    carried = {child for links in children.values() for child in links}
    found: dict[str, Bending] = {}
    for item in robot.appendages:
        if isinstance(item, FlexibleAppendage) and item.frame in carried:  # so not the root link
            bending, links = bendings(robot)[item.title], [item.frame]
            for link in links:
                if robot.model.existFrame(link) and (
                    find_frame(robot.model, link).joint == bending.carrier
                ):
                    found[link] = bending
                    links += children.get(link, [])
    return found


def node_of(frame: pin.Frame, bent: dict[str, Bending]) -> tuple[int, pin.SE3]:
    """Return the Pinocchio joint whose node carries a link's frame, and the frame on this node."""
    if bending := bent.get(frame.name):
        return bending.node, bending.frame.actInv(frame.placement)
    return frame.parentJoint, frame.placement


def balls(
    robot: Robot, bent: dict[str, Bending]
) -> list[tuple[int, str, tuple[float, ...], Array]]:
    """Return Pinocchio joint, kind, size [m] and position of what stands for other appendages."""
    found: list[tuple[int, str, tuple[float, ...], Array]] = []
    for item in robot.appendages:
        if isinstance(item, Slosh):
            joint = robot.model.getJointId(item.modes[1])
            lever = robot.model.inertias[joint].lever
            found.append((joint, "sphere", (_radius(item.mass),), lever))
        elif item.frame not in bent:
            bending = bendings(robot)[item.title]
            mass = float(np.square(item.participation[:3, 0]).sum())
            size = _radius(mass or 1.0)
            # The rotation of a box is seen.
            kind, sides = ("sphere", (size,)) if mass else ("box", (size,) * 3)
            found.append((bending.node, kind, sides, bending.center))
    return found


def _radius(mass: float) -> float:
    return (0.75 * mass / (math.pi * _DENSITY)) ** (1.0 / 3.0)
