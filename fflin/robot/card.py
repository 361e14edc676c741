"""HTML card of a robot for notebooks: a small picture, the joints and the inputs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from fflin.base import html, svg
from fflin.base.html import escape
from fflin.base.validation import Array
from fflin.robot.fields import limits_of
from fflin.robot.inputs import Input, JointTorque
from fflin.robot.joints import ROOT
from fflin.robot.mass_properties import equivalent_box
from fflin.robot.summary import LIMIT_UNITS, joint_table, output_words

if TYPE_CHECKING:
    from fflin.robot.robot import Robot

# The picture shows the robot from this direction (azimuth and elevation [rad]), in a square with
# sides _SIZE [px].
_AZIMUTH, _ELEVATION = math.radians(-35.0), math.radians(25.0)
_SIZE = 190.0

# Largest number of rows in the table of inputs.
_MOST = 80


def robot_card(robot: Robot) -> str:
    """Return the card of a robot."""
    inputs = _input_table(robot)
    count = sum(len(names) for _, names in robot.named_inputs)
    left = len(inputs) - 1 - _MOST
    more = f"and {left} more, see named_inputs" if left > 0 else ""
    table = html.table(inputs[: 1 + _MOST], "lll")
    return html.result_card(
        robot,
        html.side_by_side(thumbnail(robot), html.table(joint_table(robot), "ll")),
        html.paragraph(LIMIT_UNITS if robot.joints else "", "note"),
        html.folded(f"inputs ({count})", table, html.paragraph(more)),
        html.folded("outputs", *map(html.paragraph, output_words(robot))),
        html.folded("warnings", *map(html.paragraph, robot.notes)),
    )


def _input_table(robot: Robot) -> list[list[str]]:
    """Return a table with the type, the place and the limits of each input."""
    limits = limits_of(robot)
    lagging = any(item.lag for item in robot.inputs)
    rows = [["input", "type", "at", "lower", "upper", *["lag [s]"] * lagging]]
    for item, names in robot.named_inputs:
        for name in names:
            ends = limits.get(name, (-math.inf, math.inf))
            cells = [f"{end:.5g}" if abs(end) < 1e300 else "." for end in ends]
            if lagging:
                cells.append(f"{item.lag:g}" if item.lag else ".")
            rows.append([name, type(item).__name__, _place(item), *cells])
    return rows


def _place(item: Input) -> str:
    """Return the name of the frame or joint on which an input acts."""
    if isinstance(item, JointTorque):
        return item.joint
    return ", ".join(item.frames) or "base"


def thumbnail(robot: Robot) -> str:
    """Return a small picture of a robot at its neutral configuration.

    Each body is drawn as the uniform box with its mass and moments of inertia, and each joint as a
    dot, which a line connects to the joint before it. Modes are omitted.
    """
    model, data = robot.model, robot.create_data()
    pin.forwardKinematics(model, data, robot.neutral())
    modes = {model.getJointId(joint.name) for joint in robot.modes}
    boxes: list[tuple[float, str, Array]] = []  # depth, name, corners (8, 2)
    for joint, inertia in enumerate(model.inertias.tolist()):
        if joint < ROOT or joint in modes or inertia.mass <= 0.0:
            continue
        sides, placement = equivalent_box(inertia)
        signs = np.indices((2, 2, 2)).reshape(3, 8).T - 0.5
        corners = _seen([(data.oMi[joint] * placement).act(x) for x in signs * sides])
        name = "base" if joint == ROOT else model.names[joint]
        boxes.append((float(corners[:, 2].mean()), name, corners[:, :2]))
    bones: list[tuple[str, Array]] = []  # name, two points (2, 2)
    for joint in range(ROOT + 1, model.njoints):
        if joint in modes:
            continue
        ends = [data.oMi[k].translation for k in (model.parents[joint], joint)]
        bones.append((model.names[joint], _seen(ends)[:, :2]))
    return _drawn(boxes, bones)


def _seen(points: Sequence[Array]) -> Array:
    """Return points (k, 3): to the right and upwards in the picture, then towards the viewer."""
    c, s = math.cos(_AZIMUTH), math.sin(_AZIMUTH)
    rise, tilt = math.cos(_ELEVATION), math.sin(_ELEVATION)
    right = (-s, c, 0.0)
    up = (-tilt * c, -tilt * s, rise)
    near = (rise * c, rise * s, tilt)
    seen: Array = np.array(points) @ np.array((right, up, near)).T
    return seen


def _drawn(
    boxes: list[tuple[float, str, Array]], bones: list[tuple[str, Array]]
) -> str:
    """Return the picture of boxes and bones, scaled to its size."""
    every = [points for *_, points in boxes] + [points for _, points in bones]
    if not every:
        return ""
    low, high = np.min(np.vstack(every), axis=0), np.max(np.vstack(every), axis=0)
    scale = (_SIZE - 12.0) / max(float((high - low).max()), 1e-9)
    middle = (low + high) / 2.0

    def pixels(points: Array) -> list[tuple[float, float]]:
        shifted = _SIZE / 2.0 + scale * (points - middle) * (1.0, -1.0)
        return [(float(x), float(y)) for x, y in shifted]

    parts = []
    for _, name, corners in sorted(boxes, key=lambda box: box[0]):
        outline = " ".join(f"{x:.1f},{y:.1f}" for x, y in _hull(pixels(corners)))
        parts.append(
            f'<polygon class="shape" points="{outline}"><title>{escape(name)}</title>'
            "</polygon>"
        )
    for name, ends in bones:
        (x1, y1), (x2, y2) = pixels(ends)
        parts.append(
            f'<path class="bone" d="M{x1:.1f} {y1:.1f}L{x2:.1f} {y2:.1f}"/>'
            f'<circle class="joint" cx="{x2:.1f}" cy="{y2:.1f}" r="2.6">'
            f"<title>{escape(name)}</title></circle>"
        )
    return svg.picture(0.0, 0.0, _SIZE, _SIZE, "".join(parts))


def _hull(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the corners of the convex hull of points, by Andrew's monotone chain."""

    def half(ordered: list[tuple[float, float]]) -> list[tuple[float, float]]:
        chain: list[tuple[float, float]] = []
        for x, y in ordered:
            while len(chain) > 1:
                (x1, y1), (x2, y2) = chain[-2:]
                if (x2 - x1) * (y - y1) - (y2 - y1) * (x - x1) > 0.0:
                    break
                chain.pop()
            chain.append((x, y))
        return chain[:-1]

    ordered = sorted(points)
    return half(ordered) + half(ordered[::-1])
