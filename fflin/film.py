"""From a motion to what its page shows: the robots in the scene, and the figures beside them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.model import ROOT, Robot
from fflin.page import packed
from fflin.playback import Playback, thrusters
from fflin.scene import Animation, Drawing, Visualizer, body_paths
from fflin.validation import Array

# Where one looks from, and where the sun stands, in world axes.
VIEW = (1.0, -0.62, 0.50)
SUN = (0.62, -0.78, 0.62)

TOOL_COLOR, COM_COLOR = "#ff9d4d", "#7fe3c4"
FORCE_COLOR, TORQUE_COLOR = "#ffd166", "#d58cff"


def animate(visualizer: Visualizer, robots: Sequence[tuple[Drawing, Array, Array]]) -> None:
    """Move drawings (drawing, t (N,), poses (N, njoints - 1, 7)) by one animation."""
    clips = []
    for drawing, t, poses in robots:
        drawing.place(poses[0])
        clips += drawing.tracks(t - t[0], poses)
    visualizer.window.send(Animation(clips))


def frame_points(drawing: Drawing, poses: Array, *, follow: bool, most: int = 12) -> Array:
    """Return corners (M, 3) of all that moves at some frames, for a camera to frame."""
    chosen = np.unique(np.linspace(0, len(poses) - 1, most).astype(int))
    points = []
    for index in chosen:
        shift = poses[index, 0, :3] - poses[0, 0, :3] if follow else np.zeros(3)
        points.append(corner_points(drawing, poses[index]) - shift)
    return np.concatenate(points)


def corner_points(drawing: Drawing, poses: Array) -> Array:
    """Return the corners (M, 3) of all bodies' bounding boxes in the world."""
    return np.concatenate(
        [
            np.array([placement.act(corner) for corner in corners])
            for joint, corners in zip(drawing.bodies, drawing.corners, strict=True)
            for placement in [pin.XYZQUATToSE3(poses[joint - ROOT])]
        ]
    )


def stage_info(
    robot: Robot, drawing: Drawing, poses: Array, *, scene: str, subtitle: str
) -> dict[str, Any]:
    """Return what the page's stage needs: sizes, light, floor and where the base is.

    Parameters
    ----------
    robot : Robot
    drawing : Drawing
    poses : ndarray (njoints - 1, 7)
        Of the first frame.
    scene : str
        "space" or "lab".
    subtitle : str
    """
    points = corner_points(drawing, poses)
    low, high = points.min(axis=0), points.max(axis=0)
    centre = (low + high) / 2.0
    size = max(float(np.linalg.norm(points - centre, axis=1).max()), 1e-3)
    return {
        "title": robot.name,
        "subtitle": subtitle,
        "scene": scene,
        "size": size,
        "centre": centre.tolist(),
        "floor": [*centre[:2].tolist(), float(low[2])],
        "sun": SUN,
        "direction": VIEW,
        "base": ["meshcat", "robot", body_paths(robot)[0]],
    }


def triads(robot: Robot, tool: str | None, size: float) -> list[dict[str, Any]]:
    """Return the axes drawn at the base and the tool."""
    paths = body_paths(robot)
    found = [(paths[0], pin.SE3.Identity(), 0.3)]
    if tool:
        frame = robot.model.frames[robot.model.getFrameId(tool)]
        found.append((paths[frame.parentJoint - ROOT], frame.placement, 0.12))
    return [
        {
            "path": ["meshcat", "robot", path],
            "position": placement.translation.tolist(),
            "quaternion": pin.SE3ToXYZQUAT(placement)[3:].tolist(),
            "length": share * size,
        }
        for path, placement, share in found
    ]


def marks(robot: Robot, film: Playback, tool: str | None, size: float) -> dict[str, Any]:
    """Return trails, arrows of the base's wrench and plumes."""
    trails = [("centre of mass", COM_COLOR, film.com)]
    if tool:
        trails.insert(0, ("tool", TOOL_COLOR, film.tool))
    arrows = [("force", FORCE_COLOR, film.force), ("torque", TORQUE_COLOR, film.torque)]
    paths = body_paths(robot)
    most = float(np.abs(film.thrust).max(initial=0.0))
    return {
        "trails": [
            {"name": name, "colour": color, "points": packed(points), "radius": 0.0055 * size}
            for name, color, points in trails
        ],
        "arrows": [
            {
                "kind": kind,
                "colour": color,
                "values": packed(values),
                "most": float(np.linalg.norm(values, axis=1).max()),
            }
            for kind, color, values in arrows
            if np.any(values)
        ],
        "plumes": [
            {
                "path": ["meshcat", "robot", paths[joint - ROOT]],
                "position": position.tolist(),
                "direction": direction.tolist(),
                "values": packed(film.thrust[:, k]),
                "most": most,
            }
            for k, (joint, position, direction) in enumerate(thrusters(robot))
            if most
        ],
        "triads": triads(robot, tool, size),
    }


def legend(
    shown: dict[str, Any], *, target: bool = False, linear: bool = False
) -> list[dict[str, Any]]:
    """Return the entries of the legend, each of which can be switched off."""
    entries = [
        {"label": f"path of the {each['name']}", "colour": each["colour"],
         "paths": [["meshcat", "trails", each["name"]]]}
        for each in shown["trails"]
    ]  # fmt: skip
    entries += [
        {"label": f"{each['kind']} on the base", "colour": each["colour"],
         "paths": [["meshcat", "wrench", each["kind"]]]}
        for each in shown["arrows"]
    ]  # fmt: skip
    if target:
        entries.append({"label": "target", "colour": "#8fb4ff", "paths": [["meshcat", "target"]]})
    if linear:
        entries.append(
            {"label": "linear model", "colour": "#ffb45e", "paths": [["meshcat", "linear"]]}
        )
    return entries
