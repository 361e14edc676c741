"""Motions for the tests of pages."""

from types import SimpleNamespace

import numpy as np
import pinocchio as pin

import fflin


def _motion(robot, t, q, u, linear=None):
    return SimpleNamespace(
        t=t,
        q=np.array(q),
        u=np.array(u),
        frame="hybrid",
        reference=pin.SE3.Identity(),
        urdf_sha256=robot.urdf_sha256,
        robot=robot.name,
        linear=linear,
        momentum_drift=1e-13,
    )


def settling(robot, duration):
    t = np.linspace(0, duration, 2001)
    rng = np.random.default_rng(0)
    v = np.r_[0.3, -0.2, 0.1, 0.5, 0.2, -0.1, rng.uniform(-0.7, 0.7, robot.nv - 6)]
    decay = np.exp(-t / 5)
    q = [pin.integrate(robot.model, robot.neutral(), s * v) for s in decay]
    for each in q:
        robot.follow(each)
    u = np.outer(decay, [-40, -15, 9, -20, 14, 3, *rng.uniform(-5, 5, robot.n)])
    return _motion(robot, t, q, u)


def falling(robot, duration):
    motion = settling(robot, duration)
    state = fflin.StateMap(robot)
    extra = np.exp(-motion.t / 3)[:, None]
    motion.u = np.hstack([motion.u, extra])[:, : len(fflin.linearize(robot).input_names)]
    zero = np.zeros(robot.nv)
    motion.linear = np.array([0.9 * state.to_state(q, zero) for q in motion.q])
    return motion
