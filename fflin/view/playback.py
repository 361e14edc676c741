"""Data of an animation: poses, trails and forces of a motion, and its captured payloads."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.dynamics.impact import Capture, inertia_at
from fflin.dynamics.integrators import CommutatorFree4
from fflin.dynamics.state import Actuation, StateMap
from fflin.robot.joints import ROOT, find_frame, find_joint, frame_index
from fflin.robot.robot import Robot
from fflin.simulation.motion import Motion
from fflin.simulation.plant import Plant
from fflin.view.shapes import bendings

# Limits of one integration step of a payload's flight before capture: time [s], and phase [rad] of
# the fastest oscillation.
_STEP, _SWING = 0.05, 0.3

# Largest number of frames; more would enlarge the file without a visible effect.
_MOST_FRAMES = 3000


@dataclass(frozen=True)
class Playback:
    """Poses, trails and forces of a motion at N frames."""

    t: Array  # (N,) [s]; each is a time of the motion, so that no pose is interpolated
    poses: Array  # (N, njoints - 1, 7): x, y, z and quaternion of each joint's frame in the world
    com: Array  # (N, 3) [m]
    tool: Array  # (N, 3) origin of the tool [m]
    force: Array  # (N, 3) [N] on the base, in world axes
    torque: Array  # (N, 3) [N m] on the base, in world axes
    thrust: Array  # (N, k) [N] of k thrusters


def frame_indices(t: Array, fps: float, speed: float) -> Array:
    """Return the indices of the samples at t (N,) [s] that are nearest to a film's frames."""
    duration = float(t[-1] - t[0])
    count = min(round(duration * fps / speed), len(t) - 1, _MOST_FRAMES)
    wanted = np.linspace(t[0], t[-1], max(count, 1) + 1)
    after = np.clip(np.searchsorted(t, wanted), 1, len(t) - 1) if len(t) > 1 else np.zeros(1, int)
    if len(t) > 1:
        after -= wanted - t[after - 1] < t[after] - wanted
    return np.unique(after)


def default_tool(robot: Robot) -> str | None:
    """Return the name of the tool frame: "tool", or the last link of the longest chain."""
    model = robot.model
    if robot.n == 0:
        return None
    if model.existFrame("tool"):
        return "tool"
    depths = [len(support) for support in model.supports.tolist()]
    deepest = max(range(ROOT, model.njoints), key=lambda joint: depths[joint])
    links = [
        frame.name
        for frame in model.frames.tolist()
        if frame.parentJoint == deepest and frame.type == pin.FrameType.BODY
    ]
    return links[-1] if links else None


def body_poses(robot: Robot, data: pin.Data, q: Array) -> Array:
    """Return the poses (njoints - 1, 7) of all joint frames at q (nq,).

    The first mode of a flexible appendage has the pose of the appendage's bent frame.
    """
    pin.forwardKinematics(robot.model, data, q)
    poses = np.array([pin.SE3ToXYZQUAT(placement) for placement in data.oMi.tolist()[ROOT:]])
    for bending in bendings(robot).values() if robot.appendages else ():
        poses[bending.node - ROOT] = pin.SE3ToXYZQUAT(bending.placement(data, q))
    return poses


def play_back(
    robot: Robot, state: StateMap, t: Array, q: Array, u: Array, tool: str | None
) -> Playback:
    """Compute the data of an animation from rows of a motion; wrenches are in the state's frame."""
    model, data = robot.model, robot.model.createData()
    tool_id = frame_index(model, tool) if tool else None
    groups = Actuation(state).groups

    def frame(q_k: Array, u_k: Array) -> tuple[Array, ...]:
        poses = body_poses(robot, data, q_k)
        com = pin.centerOfMass(model, data, q_k).copy()
        base = data.oMi[ROOT]
        end = base if tool_id is None else pin.updateFramePlacement(model, data, tool_id)
        force, torque = (
            (state.reference if relative else base).rotation @ u_k[groups[kind]]
            if kind in groups
            else np.zeros(3)
            for kind, relative in (("F_b", state.axes[1]), ("tau_b", state.axes[0]))
        )
        return poses, com, end.translation.copy(), force, torque

    frames = [frame(q_k, u_k) for q_k, u_k in zip(q, u, strict=True)]
    thrust = u[:, groups.get("thrust", np.zeros(0, dtype=int))]
    poses, com, tools, force, torque = map(np.array, zip(*frames, strict=True))
    return Playback(t, poses, com, tools, force, torque, thrust)


def payloads(motion: Motion, shown: Array) -> Iterator[tuple[Capture, Array]]:
    """Yield each capture and the poses (N, njoints - 1, 7) of its payload at the rows `shown`."""
    parts = motion._phases
    first = np.cumsum([0, *(len(part.t) if isinstance(part, Motion) else 0 for part in parts)])
    for k, caught in enumerate(parts):
        if not isinstance(caught, Capture):
            continue
        before = motion.t[shown[shown < first[k]]] - motion.t[first[k]]
        poses = _flight(caught, motion.frame, before)
        for part, start, end in zip(parts[k:], first[k:], first[k + 1 :], strict=False):
            rows = shown[(shown >= start) & (shown < end)] - start
            poses += _held(caught, part._robot, part.q[rows]) if len(rows) else []
        yield caught, np.array(poses)


def _flight(caught: Capture, frame: Any, t: Array) -> list[Array]:
    """Return the poses of an undamped, free payload at times [s] before its capture."""
    payload = caught.payload.replace(damping=0.0)
    data, state = payload.create_data(), StateMap(payload, frame=frame)
    q, v, plant, now, poses = caught.payload_q, caught.payload_v, Plant(state), 0.0, list[Array]()
    none = np.zeros(len(plant.actuation.names))
    softness = np.linalg.inv(state.project(inertia_at(payload, q))).diagonal()[6:]
    rate = np.sqrt(softness @ payload.springs.stiffness)  # [rad/s] upper bound of its frequencies
    for time in t[::-1].tolist():
        steps = math.ceil((now - time) * max(1.0 / _STEP, rate / _SWING))
        for _ in range(steps):
            take = CommutatorFree4(payload.model, (time - now) / steps).step
            q, v = take(lambda _, q, v: plant.stage(0.0, q, v, none)[0], 0.0, q, v)
        now = time
        poses.insert(0, body_poses(payload, data, q))
    return poses


def _held(caught: Capture, robot: Robot, rows: Array) -> list[Array]:
    """Return the poses of a payload on the robot that carries it, at rows of q (N, nq)."""
    model, data = robot.model, robot.model.createData()
    names = [f"{caught.prefix}.{name}" for name in list(caught.payload.model.names)[ROOT + 1 :]]
    places = [find_frame(model, caught.prefix), *(find_joint(model, name) for name in names)]
    poses = []
    for q in rows:
        pin.forwardKinematics(model, data, q)
        poses.append(np.array([pin.SE3ToXYZQUAT(data.oMi[joint] * at) for joint, at in places]))
    return poses
