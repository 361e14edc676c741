"""A servicer that holds still, catches what comes, and has a joint that jams."""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

import fflin

DEBRIS = pin.Inertia(500.0, np.array([0.0, 0.0, 0.8]), np.diag([160.0, 160.0, 120.0]))
TWIST = np.array([0.01, 0.0, 0.02, 0.0, 0.03, 0.0])


class Phases(NamedTuple):
    """Each phase, what led to the next, and all of it."""

    robot: fflin.Robot
    approach: fflin.Motion
    caught: fflin.Capture
    held: fflin.Motion
    jammed: fflin.Impact
    after: fflin.Motion
    whole: fflin.Motion


def regulated(robot, q, v, duration, **options):
    """The motion from (q, v) on to rest at q, with what was caught at rest in its springs."""
    target = q.copy()
    for joint in robot.joints:
        if joint.name.startswith("payload."):
            joint.place(target, 0.0)
    lin = fflin.linearize(robot, target)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    return fflin.simulate(
        robot, policy, q0=q, v0=v, duration=duration, dt=0.02, **options
    )


def phases(payload=DEBRIS, payload_v=TWIST):
    """Fly them."""
    robot = fflin.load("servicer_7dof")
    base = pin.SE3(pin.rpy.rpyToMatrix(0.1, 0.4, -0.2), np.array([0.3, -0.2, 0.1]))
    q = fflin.configuration(robot, {"joint_2": 0.6, "joint_4": -1.2}, base)
    v = fflin.velocity(robot, {"omega_b.x": 0.01, "joint_3": 0.02, "v_b.y": 0.005})
    approach = regulated(robot, q, v, 4.0)
    end = {"q": approach.q[-1], "v": approach.v[-1]}
    caught = fflin.capture(robot, "tool", payload, **end, payload_v=payload_v)
    held = regulated(caught.robot, caught.q, caught.v, 6.0)
    jammed = fflin.jam(caught.robot, "joint_3", q=held.q[-1], v=held.v[-1])
    after = regulated(jammed.robot, jammed.q, jammed.v, 3.0)
    whole = approach.then(caught, held, jammed, after)
    return Phases(robot, approach, caught, held, jammed, after, whole)
