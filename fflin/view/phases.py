"""Payloads in the page of a motion with several phases, before and after their capture."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.dynamics.capture import Capture
from fflin.dynamics.impact import inertia_at
from fflin.dynamics.integrators import CommutatorFree4
from fflin.dynamics.state import StateMap
from fflin.robot.frames import ROOT, find_frame, find_joint
from fflin.robot.robot import Robot
from fflin.simulation.motion import Motion
from fflin.simulation.plant import Plant
from fflin.view.playback import body_poses

# Steps of the way on which a payload came: at most so long [s], and so much of its swing [rad].
_STEP, _SWING = 0.05, 0.3


def payloads(motion: Motion, shown: Array) -> Iterator[tuple[Capture, Array]]:
    """Yield what is caught and its poses (N, njoints - 1, 7) at the rows that are shown."""
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
    """Return the poses of a payload at times before it is caught [s], as it flies undamped."""
    payload = caught.payload.replace(damping=0.0)
    data, state = payload.create_data(), StateMap(payload, frame=frame)
    q, v, plant, now, poses = caught.payload_q, caught.payload_v, Plant(state), 0.0, list[Array]()
    none = np.zeros(len(plant.actuation.names))
    softness = np.linalg.inv(state.project(inertia_at(payload, q))).diagonal()[6:]
    rate = np.sqrt(softness @ payload.springs.stiffness)  # no swing is faster
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
