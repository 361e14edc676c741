"""The page of a motion: the robots in the scene, and the panel of figures beside them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pinocchio as pin

from fflin.base.tables import counted
from fflin.base.validation import Array
from fflin.dynamics.impact import Impact
from fflin.dynamics.names import frame_of
from fflin.dynamics.orbital import field_of
from fflin.dynamics.state import StateMap
from fflin.robot.frames import find_frame
from fflin.robot.robot import ROOT, Robot
from fflin.view.page import build_page, packed
from fflin.view.panel import panel
from fflin.view.phases import payloads
from fflin.view.playback import Playback, body_poses, frame_indices, play_back, thrusters
from fflin.view.recorder import Recorder
from fflin.view.scene import Animation, Drawing, Visualizer, body_paths
from fflin.view.tube import tubes

if TYPE_CHECKING:
    from fflin.campaign.campaign import Campaign
    from fflin.campaign.reach import Funnel
    from fflin.dynamics.state import Frame
    from fflin.simulation.motion import Motion

# Where one looks from, and where the sun stands, in world axes.
VIEWS = {"space": (1.0, -0.62, 0.50), "lab": (1.0, -0.62, 0.36)}
SUN = (0.62, -0.78, 0.62)

TOOL_COLOR, COM_COLOR = "#ff9d4d", "#7fe3c4"
FORCE_COLOR, TORQUE_COLOR = "#ffd166", "#d58cff"

# Length of the arrow of the largest force, and the way on which the camera goes along with the
# base unless it is told otherwise, both in sizes of the robot.
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
    cloud: Campaign | None = None,
    funnel: Funnel | None = None,
) -> tuple[str, tuple[str, ...]]:
    """Return the page of a motion, and what could not be drawn; see `visualize`."""
    shown = frame_indices(motion.t, fps, speed)
    t, q, u = motion.t[shown], motion.q[shown], motion.u[shown]
    state = chart_of(robot, motion)
    film = play_back(robot, state, t, q, u, tool)

    window, sent = Recorder(), set[str]()
    scenery = Visualizer(window=window)
    drawing = Drawing(robot, scenery["robot"], sent=sent)
    moving = [(drawing, film.poses)]
    data = robot.model.createData()
    goal = _target(motion, state, shown) if target is None else target[None]
    # One pose where it stands still, or one a frame.
    goals = np.array([body_poses(robot, data, each) for each in goal])
    if len(goal):
        ghost = Drawing(robot, scenery["target"], "ghost", sent)
        ghost.place(goals[0])
        moving += [(ghost, goals)] if len(goal) > 1 else []
    if motion.linear is not None:
        predicted = [state.to_pinocchio(x)[0] for x in motion.linear[shown]]
        poses = np.array([body_poses(robot, data, each) for each in predicted])
        moving.append((Drawing(robot, scenery["linear"], "linear", sent), poses))
    held = list(payloads(motion, shown))
    for caught, poses in held:
        moving.append(
            (Drawing(caught.payload, scenery["held"][caught.prefix], "held", sent), poses)
        )
    clips = []
    for each, poses in moving:
        each.place(poses[0])
        clips += each.tracks(t - t[0], poses)
    window.send(Animation(clips))

    # Of each phase, as far as it is known, the robot that then flies.
    flown = [part._robot for part in motion._phases if not isinstance(part, Impact)]
    flown = flown or [robot] * max(1, len(motion.phases))
    names = [each.name.replace("+", " + ") for each in flown]
    about = [f"{subtitle(each)}, {t[-1] - t[0]:.4g} s" for each in flown]
    info = stage_info(
        robot, drawing, film.poses[0], scene=scene, subtitle=about[0], frame=motion.frame
    )
    shown_points = frame_points(drawing, film, info["size"])
    for each, rows in ((drawing, goals), *moving[len(moving) - len(held) :]):
        for poses in rows[:: max(1, len(rows) // 24)]:
            shown_points = np.concatenate((shown_points, corner_points(each, poses)))
    # How far the ghost is beside the robot at most: what coincides with it is not seen.
    step, beside = max(1, len(t) // 24), 0.0
    for pose, at in zip(film.poses[::step], [*goals[::step]] * len(t), strict=False):
        apart = corner_points(drawing, pose) - corner_points(drawing, at)
        beside = max(beside, float(np.abs(apart).max()))
    info["floor"][2] = float(shown_points[:, 2].min())
    if follow is None:
        # All of a long way at once, and nothing is to be seen of the robot.
        follow = bool(np.ptp(shown_points, axis=0).max() > _FAR * info["size"])
    if follow:
        shown_points = frame_points(drawing, film, info["size"], follow=True)
    info |= panel(robot, motion, shown, goal)
    info |= marks(robot, film, tool, info["size"], goals[:1] if motion.phases else goals)
    if cloud is not None:
        from fflin.view.cloud import cloud_of

        info["cloud"] = cloud_of(robot, cloud, tool)
    colors = (TOOL_COLOR, COM_COLOR)
    info |= {
        "tubes": tubes(robot, funnel, tool, info["size"], colors) if funnel is not None else [],
        "mode": "motion",
        "t": packed(t),
        "speed": speed,
        "follow": follow,
        "points": rounded(shown_points, info["size"]),
        "target": beside > 0.02 * info["size"],
        "linear": motion.linear is not None,
        "phases": [*zip(motion.phases, motion.starts.tolist(), names, about, strict=False)],
        "held": [caught.prefix for caught, _ in held],
    }
    told = (each.notes for each, _ in moving if each is drawing or each.robot.urdf)
    notes = dict.fromkeys(note for notes in told for note in notes)
    return build_page(info, window.commands()), tuple(notes)


def chart_of(robot: Robot, motion: Motion) -> StateMap:
    """Return the map between a motion's states and configurations."""
    return StateMap(robot, reference=motion.reference, frame=cast("Frame", motion.frame))


def _target(motion: Motion, state: StateMap, shown: Array) -> Array:
    """Return where a motion is steered to (k, nq): nowhere, one place, or one a frame."""
    states = motion.target.reshape(-1, state.nx)
    states = states[shown] if len(states) > 1 else states
    return np.array([state.to_pinocchio(x)[0] for x in states]).reshape(-1, state.robot.nq)


def subtitle(robot: Robot) -> str:
    """Return what the page says of a robot below its name."""
    wheels = len(robot.wheels)
    parts = [counted(robot.n - wheels, "joint"), *[counted(wheels, "wheel")] * bool(wheels)]
    orbit = [f"{robot.orbit.altitude / 1e3:.6g} km over {robot.orbit.body}"] if robot.orbit else []
    return ", ".join([*parts, f"{robot.mass:.4g} kg", *orbit])


def frame_points(drawing: Drawing, film: Playback, size: float, *, follow: bool = False) -> Array:
    """Return corners of all that moves and tips of forces (M, 3) at some frames, for a camera."""
    chosen = np.unique(np.linspace(0, len(film.t) - 1, 24).astype(int))
    strongest = np.linalg.norm(film.force, axis=1).max() or 1.0
    points = []
    for index in chosen:
        base = film.poses[index, 0, :3]
        tip = base + ARROW * size * film.force[index] / strongest
        shift = base - film.poses[0, 0, :3] if follow else np.zeros(3)
        points.append(np.vstack((corner_points(drawing, film.poses[index]), tip)) - shift)
    return np.concatenate(points)


def rounded(points: Array, size: float) -> list[list[float]]:
    """Return points (M, 3) as they are sent: as exact as a robot of that size needs."""
    digits = max(4, 4 - math.floor(math.log10(size)))
    found: list[list[float]] = points.round(digits).tolist()
    return found


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
    robot: Robot,
    drawing: Drawing,
    poses: Array,
    *,
    scene: str,
    subtitle: str,
    frame: str | None = None,
) -> dict[str, Any]:
    """Return what the page's stage needs, of the first frame's poses (njoints - 1, 7)."""
    points = corner_points(drawing, poses)
    low, high = points.min(axis=0), points.max(axis=0)
    centre = (low + high) / 2.0
    size = max(float(np.linalg.norm(points - centre, axis=1).max()), 1e-3)
    sun, direction, orbit = np.array(SUN), np.array(VIEWS[scene]), dict[str, Any]()
    field = field_of(robot, frame_of(robot, frame)) if scene == "space" else None
    if field and robot.orbit:
        # Up is away from the body, and x along the orbit.
        radial, along, normal = field.axes.T
        sun, direction = (along * x + normal * y + radial * z for x, y, z in (sun, direction))
        far = robot.orbit.radius / robot.orbit.body_radius
        orbit = {
            "up": [along.tolist(), radial.tolist(), (-normal).tolist()],
            "orbit": {"body": robot.orbit.body, "distance": far, "rate": robot.orbit.mean_motion},
        }
    return orbit | {
        "title": robot.name,
        "subtitle": subtitle,
        "scene": scene,
        "size": size,
        "centre": centre.tolist(),
        "floor": [*centre[:2].tolist(), float(low[2])],
        "sun": sun.tolist(),
        "direction": direction.tolist(),
        "base": ["meshcat", "robot", body_paths(robot)[0]],
    }


def triads(robot: Robot, tool: str | None, size: float) -> list[dict[str, Any]]:
    """Return the axes drawn at the base and the tool."""
    paths = body_paths(robot)
    found = [(paths[0], pin.SE3.Identity(), 0.3)]
    if tool:
        joint, placement = find_frame(robot.model, tool)
        found.append((paths[joint - ROOT], placement, 0.12))
    return [
        {
            "path": ["meshcat", "robot", path],
            "position": placement.translation.tolist(),
            "quaternion": pin.SE3ToXYZQUAT(placement)[3:].tolist(),
            "length": share * size,
        }
        for path, placement, share in found
    ]


def marks(
    robot: Robot, film: Playback, tool: str | None, size: float, goals: Array
) -> dict[str, Any]:
    """Return trails, also of moving goals (N, njoints - 1, 7), wrenches and plumes."""
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
        "triads": triads(robot, tool, size),
    }
