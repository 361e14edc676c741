"""HTML page of a motion, with a panel of values and plots; HTML page of natural modes.

The page of natural modes animates one mode of a robot at a time.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.analysis.modes import Mode, Modes, energies_of
from fflin.base.errors import InputError
from fflin.base.figures import COLORS, CurveStyle
from fflin.base.rotation import rotation_matrices
from fflin.base.tables import counted
from fflin.base.validation import Array
from fflin.dynamics.coordinates import Frame, frame_of
from fflin.dynamics.impact import Capture, Impact, inertia_at, joint_called
from fflin.dynamics.integrators import DEFAULT_INTEGRATOR
from fflin.dynamics.state import Actuation, StateMap
from fflin.linear.model import LinearModel
from fflin.robot.inputs import Thruster
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.robot import Robot
from fflin.simulation.motion import Motion
from fflin.simulation.plant import Plant
from fflin.simulation.plots import (
    JOINTS,
    charts,
    family_of,
    resting_from,
    styles_of,
)
from fflin.simulation.report import DEGREES, STATES, THERE, TRUSTED, Curve, headline
from fflin.view.constraints import Reaction, constraint_marks, reactions
from fflin.view.magnetorquers import fluxes, magnetic_torque, moments, rods, scales
from fflin.view.page import Drawing, Page, body_poses, encoded, packed, subtitle
from fflin.view.shapes import carriers_of

# A mode is animated with _PHASES poses per period. A period takes _PERIOD [s] on the screen. The
# amplitude is chosen such that no rotation exceeds _ANGLE [rad], and no displacement exceeds _SHARE
# times the robot's size.
_PHASES, _PERIOD = 48, 2.0
_ANGLE, _SHARE = 0.5, 0.14

# ARROW is the length of the arrow for the largest force. If the motion extends over more than _FAR,
# the camera follows the base by default. Both lengths are relative to the robot's size.
ARROW, _FAR = 0.62, 20.0

# Length of the arrow for the largest force of the constraints, relative to the robot's size.
REACTION = 0.4

# The flight of a free payload is integrated in steps of at most _STEP [s]. Within a
# step, the phase of the payload's fastest oscillation changes by at most _SWING [rad].
_STEP, _SWING = 0.05, 0.3

# Lengths of the arrows of the magnetic field and of the moment of a magnetorquer at its limit,
# relative to the robot's size. Both begin inside the robot, and must be longer than it.
_FIELD, _MOMENT = 1.35, 1.0

# Largest number of frames. More frames would enlarge the file without a visible effect.
_MOST_FRAMES = 3000

# Values below this, in the units of the page, count as rounding errors.
_NOTHING = 1e-14

# A curve is not drawn if its largest magnitude is less than this fraction of the largest magnitude
# of all curves in its plot.
_UNSEEN = 1e-6

# The time slider is coloured by the deviation of the linear prediction: small up to _SMALL, visible
# up to TRUSTED, and beyond the validity of the linear model above.
_SMALL = 0.01

# {unit of a curve: unit and factor on the page}. Lengths of _LONG [m] or more stay in m.
_UNITS = {
    **DEGREES,
    "m": ("mm", 1e3),
    "m/s": ("mm/s", 1e3),
}
_LONG = 10.0

# Momentum and centre of mass are conserved if their errors do not exceed this: relative to the
# largest momentum, and in m, or relative to the distance from the reference if it exceeds 1 m.
_CONSERVED = 1e-9

# number of cells along the time in which the pulses of a thruster are drawn
_CELLS = 600

_NONE = np.zeros(0)


def motion_page(
    page: Page,
    motion: Motion,
    fps: float,
    speed: float,
    follow: bool | None,
    target: Array | None,
) -> str:
    """Return the page of a motion; see `visualize`."""
    robot = page.robot
    shown = frame_indices(motion.t, fps, speed)
    frame = frame_of(robot, motion.frame)
    t = motion.t[shown]
    state = StateMap(robot, reference=motion.reference, frame=frame)
    film = play_back(state, motion.q[shown], motion.u[shown])
    flux = fluxes(state, t)
    goal = _goals(state, motion, shown) if target is None else target[None]
    goals = body_poses(robot, goal)

    moving = [(page.drawing, film.poses)]
    if len(goals):
        ghost = Drawing(page, robot, "target", "ghost", coarse=True)
        ghost.place(goals[0])
        if len(goals) > 1:
            moving.append((ghost, goals))
    predicted: Array | None = None
    off: Array = _NONE
    if motion.linear is not None:
        predicted = state.points(motion.linear[shown])[1]
        predicted_poses = body_poses(robot, predicted)
        contour = Drawing(page, robot, "linear", "linear", coarse=True)
        moving.append((contour, predicted_poses))
        compared = goals if len(goals) else film.poses[:1]
        off = deviation(page.drawing.corners, film.poses, predicted_poses, compared)
    held = []
    for caught, poses in payloads(motion, frame, shown):
        name = caught.prefix
        held.append(
            (Drawing(page, caught.payload, f"held/{name}", "held", name), poses)
        )
    moving += held
    clips = []
    for drawing, poses in moving:
        drawing.place(poses[0])
        clips += drawing.tracks(t - t[0], poses)
    options = {"play": True, "repetitions": 1}
    page.window.record(
        {"type": "set_animation", "animations": clips, "options": options, "path": ""}
    )

    # Robot of each phase, if known. In the phases after a capture, the robot includes the payload.
    flown = [part._robot for part in motion._phases if not isinstance(part, Impact)]
    flown = flown or [robot] * max(1, len(motion.phases))
    names = [part_robot.name.replace("+", " + ") for part_robot in flown]
    about = [f"{subtitle(part_robot)}, {t[-1] - t[0]:.4g} s" for part_robot in flown]
    corners = [frame_points(page, film, flux)]
    for drawing, rows in ((page.drawing, goals), *held):
        corners += [drawing.points(poses) for poses in rows[:: max(1, len(rows) // 24)]]
    points = np.concatenate(corners)
    page.floor[2] = float(points[:, 2].min())
    if follow is None:
        # If the camera showed the whole of a long path, the robot would be only a dot.
        follow = bool(np.ptp(points, axis=0).max() > _FAR * page.size)
    if follow:
        points = frame_points(page, film, flux, follow=True)
    marked_goals = goals[:1] if motion.phases else goals
    return page.html(
        "motion",
        points,
        t.tolist(),
        subtitle=about[0],
        verdict=headline(motion),
        **panel(robot, motion, shown, goal, predicted, off),
        **marks(page, film, marked_goals),
        **_magnetic(page, state, film, motion.u[shown], flux),
        **_constraints(page, reactions(robot, motion, shown)),
        t=packed(t),
        speed=speed,
        follow=follow,
        target=len(goals) > 0,
        linear=predicted is not None,
        deviation={"values": packed(off), "levels": [_SMALL, TRUSTED]},
        boxes=_boxes(page.drawing),
        phases=[
            *zip(motion.phases, motion.starts.tolist(), names, about, strict=False)
        ],
        held=[drawing.prefix for drawing, _ in held],
    )


def _goals(state: StateMap, motion: Motion, shown: Array) -> Array:
    """Return the target configurations (k, nq) of a motion at the samples `shown`.

    There is one row for a fixed target, one row per sample for a moving target, and no row without
    a target.
    """
    states = motion.target.reshape(-1, state.nx)
    if len(states) > 1:
        states = states[shown]
    return state.points(states)[1]


def deviation(
    corners: Mapping[int, Array], flown: Array, predicted: Array, compared: Array
) -> Array:
    """Return the relative error (N,) of predicted poses (N, njoints - 1, 7) of the bodies.

    The error is the largest distance between a corner of a body's bounding box and its predicted
    position. It is divided by the largest distance of any corner, at any time, from its position
    at the poses `compared` (1 or N, njoints - 1, 7). `corners` contains the corners (8, 3) of each
    joint's body.
    """

    def farthest(one: Array, other: Array) -> Array:
        sizes = np.zeros(len(flown))
        for joint, points in corners.items():
            for point in points:
                ends = [moved(poses[:, joint - ROOT], point) for poses in (one, other)]
                distance = np.linalg.norm(ends[0] - ends[1], axis=1)
                sizes = np.maximum(sizes, distance)
        return sizes

    largest = float(farthest(flown, compared).max())
    errors = farthest(flown, predicted)
    if largest < THERE:
        return np.zeros(len(errors))
    relative: Array = errors / largest
    return relative


def _boxes(drawing: Drawing) -> list[list[float]]:
    """Return the least and largest coordinates of each body's bounding box, in joint order.

    A body without a drawing has an empty list.
    """
    boxes: list[list[float]] = [[] for _ in drawing.paths]
    for joint, corners in drawing.corners.items():
        ends = np.concatenate((corners.min(axis=0), corners.max(axis=0)))
        boxes[joint - ROOT] = ends.round(6).tolist()
    return boxes


def frame_points(
    page: Page, film: Playback, flux: Array | None = None, *, follow: bool = False
) -> Array:
    """Return points (M, 3) that the camera must show: corners of bodies, tips of arrows.

    The arrows are the force on the base and the magnetic field, if the flux density `flux` (N, 3)
    has rows. If `follow` is true, the displacement of the base from the first frame is subtracted.
    """
    strongest = _strongest(film.force)
    reach = ARROW * page.size / strongest if strongest > THERE else 0.0
    points = []
    for index in np.unique(np.linspace(0, len(film.poses) - 1, 24).astype(int)):
        base = film.poses[index, 0, :3]
        tips = [base + reach * film.force[index]]
        if flux is not None and len(flux):
            along = flux[index] / max(_strongest(flux), np.finfo(float).tiny)
            tips.append(base + _FIELD * page.size * along)
        shift = base - film.poses[0, 0, :3] if follow else np.zeros(3)
        corners = page.drawing.points(film.poses[index])
        points.append(np.vstack((corners, *tips)) - shift)
    return np.concatenate(points)


def marks(page: Page, film: Playback, goals: Array) -> dict[str, object]:
    """Return the data of the trails, force arrows and thruster plumes of a page.

    Forces and torques that never exceed THERE are rounding errors, and have no arrow.
    `goals` (k, njoints - 1, 7) are the poses of the target. If k > 1, the target moves, and the
    trails of the target are included.
    """
    trails = {"centre of mass": film.com}
    followed = dict[str, Array]()
    if len(goals) > 1:
        trails, followed = {"base": film.poses[:, 0, :3]}, {"base": goals[:, 0, :3]}
    if page.tool:
        joint, at = find_frame(page.robot.model, page.tool)
        trails = {"tool": moved(film.poses[:, joint - ROOT], at.translation), **trails}
        if followed:
            followed["tool"] = moved(goals[:, joint - ROOT], at.translation)
    return {
        "trails": [
            {"name": name, "points": packed(points)} for name, points in trails.items()
        ],
        "followed": [{"points": packed(points)} for points in followed.values()],
        "arrows": [
            {
                "kind": kind,
                "unit": unit,
                "longest": ARROW * page.size,
                "values": packed(values),
            }
            for kind, unit, values in (
                ("force", "N", film.force),
                ("torque", "N m", film.torque),
            )
            if _strongest(values) > THERE
        ],
        "plumes": [
            {**nozzle, "values": packed(film.thrust[:, k])}
            for k, nozzle in enumerate(page.nozzles)
            if np.abs(film.thrust).max(initial=0.0) > THERE
        ],
    }


def _magnetic(
    page: Page, state: StateMap, film: Playback, u: Array, flux: Array
) -> dict[str, object]:
    """Return the arrows of the magnetic field, and of moments and torque of magnetorquers."""
    if not len(flux):
        return {"field": None, "moments": []}
    values = moments(state, u)
    torque = magnetic_torque(state, film.poses, u, flux)
    full = scales(page.robot, values)
    return {
        "field": {
            "longest": _FIELD * page.size,
            "values": packed(flux),
            "torque": packed(torque),
            "torqueLongest": ARROW * page.size,
        },
        "moments": [
            {
                **rod,
                "longest": _MOMENT * page.size,
                "most": most,
                "values": packed(values[:, k]),
            }
            for k, (rod, most) in enumerate(
                zip(rods(page.robot, page.nodes), full, strict=True)
            )
        ],
    }


def _constraints(page: Page, items: Sequence[Reaction]) -> dict[str, object]:
    """Return the marks of constraints, with the frames in which they act, and their arrows.

    The forces of all constraints have one scale, and so have their torques. Forces and torques that
    never exceed THERE have no arrow.
    """
    active = {item.constraint.title: item.active for item in items}
    found = [item.constraint for item in items]
    marked = [
        {**mark, "active": packed(active[str(mark["name"])])}
        for mark in constraint_marks(page.robot, page.nodes, found)
    ]
    return {
        "constraints": marked,
        "reactions": [
            _arrow(page, item, item.force)
            for item in items
            if _strongest(item.force) > THERE
        ],
        "couples": [
            _arrow(page, item, item.torque)
            for item in items
            if _strongest(item.torque) > THERE
        ],
    }


def _arrow(page: Page, item: Reaction, values: Array) -> dict[str, object]:
    """Return the arrow of the forces or torques (N, 3) of a constraint."""
    return {
        "name": item.constraint.title,
        "longest": REACTION * page.size,
        "points": packed(item.point),
        "values": packed(values),
    }


def _strongest(vectors: Array) -> float:
    """Return the largest length of vectors (N, 3)."""
    return float(np.linalg.norm(vectors, axis=1).max())


def moved(poses: Array, point: Array) -> Array:
    """Return the world positions (N, 3) of a point (3,) fixed in a frame with poses (N, 7)."""
    positions: Array = poses[:, :3] + rotation_matrices(poses[:, 3:]) @ point
    return positions


class Playback(NamedTuple):
    """Poses, trails and forces of a motion at N frames."""

    # (N, njoints - 1, 7): x, y, z and quaternion of each joint's frame in the world
    poses: Array
    com: Array  # (N, 3) [m] centre of mass in the world
    force: Array  # (N, 3) [N] on the base, in world axes
    torque: Array  # (N, 3) [N m] on the base, in world axes
    thrust: Array  # (N, k) [N] of k thrusters


def frame_indices(t: Array, fps: float, speed: float) -> Array:
    """Return, for each frame of an animation, the index of the nearest sample in t (N,) [s]."""
    duration = float(t[-1] - t[0])
    count = min(round(duration * fps / speed), len(t) - 1, _MOST_FRAMES)
    wanted = np.linspace(t[0], t[-1], max(count, 1) + 1)
    return np.unique(np.searchsorted((t[1:] + t[:-1]) / 2.0, wanted))


def play_back(state: StateMap, q: Array, u: Array) -> Playback:
    """Return the animation of configurations q (N, nq) and inputs u (N, nu).

    The wrenches on the base are converted from the frame of `state` to world axes.
    """
    robot = state.robot
    data = state.robot.create_data()
    groups = Actuation(state).groups
    poses = body_poses(robot, q)
    com = np.array([pin.centerOfMass(robot.model, data, row).copy() for row in q])
    turned = rotation_matrices(poses[:, 0, 3:])

    def in_world(kind: str, relative: bool) -> Array:
        if kind not in groups:
            return np.zeros((len(q), 3))
        rotation = state.reference.rotation if relative else turned
        wrench: Array = rotation @ u[:, groups[kind], None]
        return wrench[..., 0]

    force, torque = in_world("F_b", state.axes[1]), in_world("tau_b", state.axes[0])
    return Playback(
        poses, com, force, torque, u[:, groups.get("thrust", np.zeros(0, dtype=int))]
    )


def payloads(
    motion: Motion, frame: Frame, shown: Array
) -> Iterator[tuple[Capture, Array]]:
    """Yield each capture, and the poses (N, njoints - 1, 7) of the captured payload.

    The poses are at the samples of the motion whose indices are in `shown` (N,).
    """
    parts = motion._phases
    counts = [len(part.t) if isinstance(part, Motion) else 0 for part in parts]
    first = np.cumsum([0, *counts])
    for k, caught in enumerate(parts):
        if not isinstance(caught, Capture):
            continue
        payload = caught.payload
        before = motion.t[shown[shown < first[k]]] - motion.t[first[k]]
        start = (caught.payload_q, caught.payload_v)
        poses = _flight(payload, *start, frame, before[::-1])[::-1]
        last: Motion | None = None  # last phase in which the robot holds the payload
        for j in range(k, len(parts)):
            part = parts[j]
            if isinstance(part, Impact):
                continue
            rows = shown[(shown >= first[j]) & (shown < first[j + 1])]
            if caught.prefix not in dict(part._robot.attached):
                break
            last = part
            end = first[j + 1]
            if len(rows):
                poses += _held(caught, part._robot, part.q[rows - first[j]])
        if last is not None:
            after = motion.t[shown[shown >= end]] - motion.t[end - 1]
            start = _released(caught, last._robot, last.q[-1], last.v[-1])
            poses += _flight(payload, *start, frame, after)
        yield caught, np.array(poses)


def _released(caught: Capture, robot: Robot, q: Array, v: Array) -> tuple[Array, Array]:
    """Return the configuration and velocity of a payload that the robot holds at q and v."""
    model = robot.model
    payload = caught.payload
    data = model.createData()
    pin.forwardKinematics(model, data, q, v)
    frame = model.getFrameId(caught.prefix, pin.FrameType.BODY)
    placement = pin.updateFramePlacement(model, data, frame)
    root = payload.model.jointPlacements[ROOT]
    payload_q = payload.neutral()
    payload_v = np.zeros(payload.nv)
    payload_q[:7] = pin.SE3ToXYZQUAT(root.actInv(placement))
    local = pin.ReferenceFrame.LOCAL
    payload_v[:6] = pin.getFrameVelocity(model, data, frame, local).vector
    for name in payload.model.names[ROOT + 1 :]:
        joint = joint_called(payload, name)
        held = joint_called(robot, f"{caught.prefix}.{name}")
        payload_q[joint.idx_q :][: joint.nq] = q[held.idx_q :][: held.nq]
        payload_v[joint.idx_v :][: joint.nv] = v[held.idx_v :][: held.nv]
    return payload_q, payload_v


def _flight(payload: Robot, q: Array, v: Array, frame: Frame, t: Array) -> list[Array]:
    """Return the poses of a free payload at times t (N,) [s], which is at q and v at t = 0.

    All times have the same sign, and their magnitudes increase. The free flight is integrated
    without damping and disturbances.
    """
    payload = payload.replace(damping=0.0, disturbance=None)
    state = StateMap(payload, frame=frame)
    plant = Plant(state)
    now = 0.0
    poses = list[Array]()
    none = np.zeros(len(plant.actuation.names))
    softness = np.linalg.inv(state.project(inertia_at(payload, q))).diagonal()[6:]
    # [rad/s] upper bound of frequencies
    rate = np.sqrt(softness @ payload.springs.stiffness)
    for time in t.tolist():
        steps = math.ceil(abs(now - time) * max(1.0 / _STEP, rate / _SWING))
        for _ in range(steps):
            take = DEFAULT_INTEGRATOR(payload.model, (time - now) / steps).step
            q, v = take(lambda _, q, v: plant.stage(0.0, q, v, none)[0], 0.0, q, v)
        now = time
        poses.append(body_poses(payload, q))
    return poses


def _held(caught: Capture, robot: Robot, rows: Array) -> list[Array]:
    """Return the poses of a captured payload at configurations (N, nq) of the combined robot."""
    model = robot.model
    data = robot.model.createData()
    places = carriers_of(robot, caught.prefix, caught.payload)
    poses = []
    for q in rows:
        pin.forwardKinematics(model, data, q)
        poses.append(
            np.array([pin.SE3ToXYZQUAT(data.oMi[joint] * at) for joint, at in places])
        )
    return poses


def errors(
    robot: Robot, q: Array, target: Array, wheels: Collection[str]
) -> dict[str, tuple[str, Array]]:
    """Return {quantity: (unit, errors (N,))} of q (N, nq) from the target.

    The joints `wheels` and modes are excluded.
    """
    goals = np.broadcast_to(target, q.shape)
    apart = np.array(
        [pin.difference(robot.model, *pair) for pair in zip(goals, q, strict=True)]
    )
    joints = [
        joint for joint in robot.joints if not (joint.mode or joint.name in wheels)
    ]
    turning = [joint.idx_v for joint in joints if not joint.prismatic]
    sliding = [joint.idx_v for joint in joints if joint.prismatic]
    error_of = {
        "attitude": ("deg", np.degrees(np.linalg.norm(apart[:, 3:6], axis=1))),
        "position": ("m", np.linalg.norm((q - goals)[:, :3], axis=1)),
    }
    if turning:
        error_of["largest joint"] = (
            "deg",
            np.degrees(np.abs(apart[:, turning]).max(axis=1)),
        )
    if sliding:
        error_of["largest prismatic"] = (
            "m",
            np.abs(apart[:, sliding]).max(axis=1),
        )
    return {
        k: (unit, np.where(x < _NOTHING, 0.0, x)) for k, (unit, x) in error_of.items()
    }


def panel(
    robot: Robot,
    motion: Motion,
    shown: Array,
    target: Array,
    predicted: Array | None = None,
    off: Array = _NONE,
) -> dict[str, object]:
    """Return the readouts and plots of a motion at the samples `shown`.

    `predicted` (N, nq) are the configurations that the linear model predicts at these samples, and
    `off` (N,) is their deviation.

    Errors are relative to the configurations `target` (k, nq). If k = 0, the page shows changes
    from the first configuration instead of errors.
    """
    compared = target if len(target) else motion.q[:1]
    error_of = errors(robot, motion.q[shown], compared, motion.wheels)
    label_form = "{} error" if len(target) else "{} change"
    # The errors of the joints are plotted only for a moving target.
    plotted = 4 if len(target) > 1 else 2
    rest = resting_from(motion) if len(target) > 1 else None
    predicted_errors = dict[str, tuple[str, Array]]()
    if predicted is not None:
        predicted_errors = errors(robot, predicted, compared, motion.wheels)
    readouts = list[tuple[str, str, Array]]()
    plots = list[dict[str, Any]]()
    for quantity, (unit, values) in error_of.items():
        label = label_form.format(quantity)
        _, linear = predicted_errors.get(quantity, (unit, None))
        (curve,) = in_page_units([Curve("", "", "", unit, values, _NONE, linear)])
        readouts.append((label, curve.unit, curve.values))
        if len(readouts) <= plotted and values.max() > THERE:
            plots.append(_plot(label, [curve]))
    if len(off):
        readouts.append(("linear model off by", "%", 100.0 * off))
    pulsed = {
        names[0]
        for item, names in robot.named_inputs
        if isinstance(item, Thruster) and item.on_off
    }
    for title, whole in charts(motion).items():
        lines = []
        for curve in whole:
            reference = linear = None
            if len(target) > 1 and curve.reference is not None:
                reference = curve.reference[shown]
            if predicted is not None and curve.linear is not None:
                linear = curve.linear[shown]
            lines.append(
                curve._replace(
                    values=curve.values[shown], reference=reference, linear=linear
                )
            )
        least = max(THERE, _UNSEEN * max(map(_size, lines)))
        seen = [curve for curve in lines if _size(curve) >= least]
        # States of the base are not plotted here, because the errors of attitude and position are
        # plotted above. Rates are plotted only if one of them comes near a limit.
        of_base = whole[0].group in STATES and whole[0].group not in JOINTS
        if (
            any(curve.near or not title.endswith("rates") for curve in seen)
            and not of_base
        ):
            strips = [curve for curve in seen if curve.name in pulsed]
            steady = [curve for curve in seen if curve.name not in pulsed]
            if strips:
                plots.append(_raster(motion, strips))
            if steady:
                plots.append(_plot(title, in_page_units(steady)))
    _color(plots, styles_of(motion))
    return {
        "readouts": [
            {"label": label, "unit": unit, "values": packed(values)}
            for label, unit, values in readouts
        ],
        "plots": plots,
        "conserved": conserved(motion),
        "rest": rest,
        "passed": [[str(violation), violation.time] for violation in motion.passed],
    }


def in_page_units(lines: list[Curve]) -> list[Curve]:
    """Convert curves of one unit: angles to deg, lengths to mm, and rates to deg/s and mm/s.

    Speeds of wheels are not converted, and neither are lengths if one of them reaches _LONG.
    """
    unit, factor = _UNITS.get(lines[0].unit, (lines[0].unit, 1.0))
    long = unit in ("mm", "mm/s") and max(map(_size, lines)) >= _LONG
    if long or lines[0].group == "speed":
        return lines
    return [curve.scaled(unit, factor) for curve in lines]


def conserved(motion: Motion) -> dict[str, object]:
    """Return the mark on the page that says whether momentum and centre of mass are conserved."""
    drift = float(motion.momentum_drift.max())
    distance = max(1.0, float(np.linalg.norm(motion.q[:, :3], axis=1).max()))
    shift = float(motion.com_drift.max(initial=0.0))  # empty in orbit
    holds = drift <= _CONSERVED and shift <= _CONSERVED * distance
    details = f"largest relative drift of the {motion.kept}: {drift:.1e}"
    if len(motion.com_drift):
        details += f"; largest drift of the centre of mass: {shift:.1e} m"
    text = f"{motion.kept} conserved"
    if drift > _CONSERVED:
        text = f"{motion.kept} drifts by {drift:.1e}"
    elif not holds:
        text = f"centre of mass drifts by {shift:.1e} m"
    return {"holds": holds, "text": text, "details": details}


def _size(curve: Curve) -> float:
    """Return the largest magnitude of a curve and, if it has a reference, of the reference."""
    rows = (
        curve.values if curve.reference is None else (*curve.values, *curve.reference)
    )
    return float(np.abs(rows).max())


def _plot(title: str, lines: list[Curve]) -> dict[str, Any]:
    """Return the data of a plot: its curves, and the limits that each curve comes near."""
    group = lines[0].group
    return {
        "title": title,
        "unit": lines[0].unit,
        # In all plots of a family, curves with the same label have the same style.
        "family": family_of(group),
        "lines": [
            {
                "label": curve.short,
                "values": packed(curve.values),
                "reference": "" if curve.reference is None else packed(curve.reference),
                "linear": "" if curve.linear is None else packed(curve.linear),
                "limits": curve.near,
            }
            for curve in lines
        ],
    }


def _color(
    plots: list[dict[str, Any]], styles: Mapping[str, Mapping[str, CurveStyle]]
) -> None:
    """Give all curves their styles, and the first plot of a family the names of its colours."""
    for plot in plots:
        family = styles.get(plot["family"], {})
        kin = [other for other in plots if other["family"] == plot["family"]]
        for line in plot["lines"]:
            style = family.get(line["label"], CurveStyle(COLORS[0]))
            line.update(colour=style.color, dashed=style.dashed)
        if family and plot is kin[0]:
            seen = {line["label"] for other in kin for line in other["lines"]}
            plot["keys"] = [
                [name, style.color, style.dashed]
                for name, style in family.items()
                if style.is_named and name in seen
            ]


def _raster(motion: Motion, thrusters: list[Curve]) -> dict[str, Any]:
    """Return the plot of thrusters that are off or on: a strip for each, and its duty.

    `pulses` is the fraction of time that a thruster is on, in each of _CELLS equal parts of the
    motion. It comes from all rows of the motion, because frames would miss short pulses.
    """
    plot = _plot("on-off thrusters", thrusters)
    edges = np.linspace(motion.t[0], motion.t[-1], _CELLS + 1)
    for line, curve in zip(plot["lines"], thrusters, strict=True):
        on = motion.u[:-1, motion.input_names.index(curve.name)] > 0.0
        spent = np.concatenate(([0.0], np.cumsum(on * np.diff(motion.t))))
        cells = np.diff(np.interp(edges, motion.t, spent)) / np.diff(edges)
        # rounded up, so that the shortest pulse is drawn
        levels = np.ceil(255.0 * np.clip(cells - 1e-9, 0.0, 1.0)).astype(np.uint8)
        line["pulses"] = encoded(levels.tobytes())
        line["duty"] = float(spent[-1] / (motion.t[-1] - motion.t[0]))
    return {**plot, "unit": "", "raster": True}


def mode_page(
    robot: Robot, model_modes: Modes, scene: str, tool: str | None
) -> tuple[str, Collection[str]]:
    """Return the page of a robot's modes, and notes about visual elements that are not drawn."""
    lin = model_modes.lin
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    if lin.urdf_sha256 != robot.urdf_sha256 or lin.state_names != state.names:
        raise InputError(
            f"the modes belong to a model of '{lin.robot}' with {len(lin.state_names)} states, "
            f"expected the {state.nx} states of '{robot.name}'; give the robot and the modes of "
            "the same unreduced model"
        )
    if not model_modes.vibrations:
        raise InputError(
            f"'{robot.name}' has no vibration to show: no mode oscillates; give its flexible "
            "joints a stiffness"
        )
    page, at_rest = Page(robot, lin.q, scene, tool, lin.frame), body_poses(robot, lin.q)
    page.drawing.place(at_rest)
    Drawing(page, robot, "rest", "ghost").place(at_rest)
    swings = [_swing(state, page, mode, lin) for mode in model_modes.vibrations]
    points = [
        page.drawing.points(at) for swing in swings for at in swing[:: _PHASES // 4]
    ]
    shapes = np.array([mode.shape for mode in model_modes.vibrations])
    energies = energies_of(robot, lin, shapes)
    modes = [
        {
            "frequency": mode.frequency,
            "damping": mode.damping_ratio,
            "unstable": bool(mode.unstable),
            "energy": list(energy.items())[:2],
            "shape": _shape(mode, lin),
            "poses": packed(poses),
        }
        for mode, (energy, _), poses in zip(
            model_modes.vibrations, energies, swings, strict=True
        )
    ]
    about = f"{subtitle(robot)}, {counted(len(modes), 'vibration')}"
    corners = np.concatenate(points)
    html = page.html("modes", corners, subtitle=about, period=_PERIOD, modes=modes)
    return html, page.notes


def _swing(state: StateMap, page: Page, mode: Mode, lin: LinearModel) -> Array:
    """Return the poses (_PHASES, njoints - 1, 7) of a mode's oscillation over one period."""
    robot = state.robot
    half = len(lin.x0) // 2

    def poses(amplitude: float) -> Array:
        x = np.repeat(lin.x0[None], _PHASES, axis=0)
        turns = np.exp(2j * math.pi * np.arange(_PHASES)[:, None] / _PHASES)
        x[:, :half] += amplitude * (mode.shape[:half] * turns).real
        return body_poses(robot, state.points(x)[1])

    # Largest displacement of a corner per unit amplitude, computed with a small amplitude.
    small = 1e-4
    moved = np.array(
        [page.drawing.points(pose_rows) - page.points for pose_rows in poses(small)]
    )
    reach = float(np.linalg.norm(moved, axis=2).max()) / small
    turned = np.abs(mode.shape[:half]) * [
        {"1": 2.0, "rad": 1.0}.get(unit, 0.0) for unit in lin.state_units[:half]
    ]
    bounds = []
    if turned.any():
        bounds.append(_ANGLE / turned.max())
    if reach:
        bounds.append(_SHARE * page.size / reach)
    return poses(min(bounds, default=0.0))


def _shape(mode: Mode, lin: LinearModel) -> list[tuple[str, str, float, float]]:
    """Return the name, unit, amplitude and phase [deg] of up to eight states of a mode.

    They are the position states with the largest amplitudes. The largest amplitude is 1. States
    with an amplitude of 0.01 or less are omitted.
    """
    sizes, phases = np.abs(mode.shape), np.angle(mode.shape, deg=True)
    order = np.argsort(-sizes[: len(sizes) // 2].round(9), kind="stable")[:8].tolist()
    return [
        (lin.state_names[i], lin.state_units[i], float(sizes[i]), float(phases[i]))
        for i in order
        if sizes[i] > 0.01
    ]
