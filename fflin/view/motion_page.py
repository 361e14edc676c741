"""The page of a motion: the robots in the scene, and the panel of numbers and plots."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.dynamics.impact import Impact
from fflin.dynamics.state import StateMap
from fflin.robot.joints import find_frame
from fflin.robot.robot import ROOT, Robot
from fflin.view.page import (
    Recorder,
    build_page,
    corner_points,
    packed,
    rounded,
    stage_info,
    subtitle,
    thrusters,
)
from fflin.view.panel import panel
from fflin.view.playback import Playback, body_poses, frame_indices, payloads, play_back
from fflin.view.scene import Drawing, Visualizer, animation, body_paths

if TYPE_CHECKING:
    from fflin.dynamics.state import Frame
    from fflin.simulation.motion import Motion

# A drawn robot with its poses (N, njoints - 1, 7).
Moving: TypeAlias = "tuple[Drawing, Array]"

TOOL_COLOR, COM_COLOR = "#ff9d4d", "#7fe3c4"
FORCE_COLOR, TORQUE_COLOR = "#ffd166", "#d58cff"

# Length of the largest force's arrow. The camera follows the base by default if its path is longer
# than _FAR. Both are in robot sizes.
ARROW, _FAR = 0.62, 20.0


def motion_page(
    robot: Robot,
    motion: Motion,
    *,
    scene: str,
    fps: float,
    speed: float,
    follow: bool | None,
    target: Array | None,
    tool: str | None,
) -> tuple[str, tuple[str, ...]]:
    """Return the page of a motion, and notes about missing drawings; see `visualize`."""
    shown = frame_indices(motion.t, fps, speed)
    frame = cast("Frame", motion.frame)
    t, state = motion.t[shown], StateMap(robot, reference=motion.reference, frame=frame)
    film = play_back(robot, state, t, motion.q[shown], motion.u[shown], tool)
    goal = _target(motion, state, shown) if target is None else target[None]
    data = robot.model.createData()
    # One pose if the target is fixed, or one for each frame.
    goals = np.array([body_poses(robot, data, each) for each in goal])

    window, sent = Recorder(), set[str]()
    scenery = Visualizer(window=window)
    drawing = Drawing(robot, scenery["robot"], sent=sent)
    ghosts = _ghosts(scenery, motion, state, shown, goals, sent)
    held = {
        caught.prefix: (
            Drawing(caught.payload, scenery["held"][caught.prefix], "held", sent, caught.prefix),
            at,
        )
        for caught, at in payloads(motion, shown)
    }
    moving = [(drawing, film.poses), *ghosts, *held.values()]
    clips = []
    for each, poses in moving:
        each.place(poses[0])
        clips += each.tracks(t - t[0], poses)
    window.record(animation(clips))

    # Robots of the phases, if known. After a capture, the robot includes the payload.
    flown = [part._robot for part in motion._phases if not isinstance(part, Impact)]
    flown = flown or [robot] * max(1, len(motion.phases))
    names = [each.name.replace("+", " + ") for each in flown]
    about = [f"{subtitle(each)}, {t[-1] - t[0]:.4g} s" for each in flown]
    info = stage_info(
        robot,
        drawing,
        film.poses[0],
        scene=scene,
        subtitle=about[0],
        tool=tool,
        frame=frame,
        held=[each for each, _ in held.values()],
    )
    size = info["size"]
    points = _points(film, size, (drawing, goals), held.values())
    info["floor"][2] = float(points[:, 2].min())
    if follow is None:
        # If the whole of a long path were in view, the robot would be only a dot.
        follow = bool(np.ptp(points, axis=0).max() > _FAR * size)
    if follow:
        points = frame_points(drawing, film, size, follow=True)
    info |= panel(robot, motion, shown, goal)
    info |= marks(robot, film, tool, size, goals[:1] if motion.phases else goals)
    info |= {
        "mode": "motion",
        "t": packed(t),
        "speed": speed,
        "follow": follow,
        "points": rounded(points, size),
        "target": len(goals) > 0,
        "linear": motion.linear is not None,
        "phases": [*zip(motion.phases, motion.starts.tolist(), names, about, strict=False)],
        "held": list(held),
    }
    drawn = [drawing, *(each for each, _ in moving[1:] if each.robot.urdf)]
    notes = dict.fromkeys(note for each in drawn for note in each.notes)
    return build_page(info, window.commands()), tuple(notes)


def _ghosts(
    scenery: Visualizer,
    motion: Motion,
    state: StateMap,
    shown: Array,
    goals: Array,
    sent: set[str],
) -> list[Moving]:
    """Draw the robot at the target and at the linear prediction; return the moving drawings."""
    robot, moving = state.robot, list[Moving]()
    if len(goals):
        ghost = Drawing(robot, scenery["target"], "ghost", sent)
        ghost.place(goals[0])
        moving += [(ghost, goals)] if len(goals) > 1 else []
    if motion.linear is not None:
        data = robot.model.createData()
        predicted = [state.to_pinocchio(x)[0] for x in motion.linear[shown]]
        poses = np.array([body_poses(robot, data, each) for each in predicted])
        moving.append((Drawing(robot, scenery["linear"], "linear", sent), poses))
    return moving


def _points(film: Playback, size: float, goal: Moving, held: Iterable[Moving]) -> Array:
    """Return corners (M, 3) of the robot, its target and its payloads at some frames."""
    points = [frame_points(goal[0], film, size)]
    for drawing, rows in (goal, *held):
        step = max(1, len(rows) // 24)
        points += [corner_points(drawing, poses) for poses in rows[::step]]
    return np.concatenate(points)


def _target(motion: Motion, state: StateMap, shown: Array) -> Array:
    """Return the targets (k, nq) of a motion: none, one, or one for each frame."""
    states = motion.target.reshape(-1, state.nx)
    states = states[shown] if len(states) > 1 else states
    return np.array([state.to_pinocchio(x)[0] for x in states]).reshape(-1, state.robot.nq)


def frame_points(drawing: Drawing, film: Playback, size: float, *, follow: bool = False) -> Array:
    """Return points (M, 3) that the camera must show: body corners and force tips."""
    chosen = np.unique(np.linspace(0, len(film.t) - 1, 24).astype(int))
    strongest = np.linalg.norm(film.force, axis=1).max() or 1.0
    points = []
    for index in chosen:
        base = film.poses[index, 0, :3]
        tip = base + ARROW * size * film.force[index] / strongest
        shift = base - film.poses[0, 0, :3] if follow else np.zeros(3)
        points.append(np.vstack((corner_points(drawing, film.poses[index]), tip)) - shift)
    return np.concatenate(points)


def marks(
    robot: Robot, film: Playback, tool: str | None, size: float, goals: Array
) -> dict[str, Any]:
    """Return the trails (also of a moving target `goals`), wrenches and plumes of a page."""
    trails, followed = [("centre of mass", COM_COLOR, film.com)], {}
    if len(goals) > 1:
        trails, followed = [("base", COM_COLOR, film.poses[:, 0, :3])], {"base": goals[:, 0, :3]}
    if tool:
        trails.insert(0, ("tool", TOOL_COLOR, film.tool))
        if followed:
            joint, at = find_frame(robot.model, tool)
            ends = [pin.XYZQUATToSE3(each).act(at.translation) for each in goals[:, joint - ROOT]]
            followed["tool"] = np.array(ends)
    arrows = [("force", FORCE_COLOR, film.force), ("torque", TORQUE_COLOR, film.torque)]
    paths = body_paths(robot)
    most = float(np.abs(film.thrust).max(initial=0.0))
    return {
        "trails": [
            {"name": name, "colour": color, "points": packed(points), "radius": 0.0055 * size}
            for name, color, points in trails
        ],
        "followed": [
            {"name": name, "points": packed(points), "radius": 0.004 * size}
            for name, points in followed.items()
        ],
        "arrows": [
            {
                "kind": kind,
                "longest": ARROW * size,
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
                "name": name,
            }
            for k, (name, joint, position, direction) in enumerate(thrusters(robot))
            if most
        ],
    }
