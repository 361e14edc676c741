"""Motion between the knots of a trajectory, and the speeds of its joints there."""

import numpy as np

import fflin


def between_knots(motion, k, parts=64):
    """Yield q and v at the ends of equal parts of an interval, integrated from its first knot."""
    s, rows = np.linspace(0.0, 1.0, parts + 1)[:, None], (parts + 1, 1)
    t = motion.t[k] + s[:, 0] * (motion.t[k + 1] - motion.t[k])
    u = motion.u[k] + (motion.hold == "linear") * s * (motion.u[k + 1] - motion.u[k])
    q, v = motion.q[k], motion.v[k]
    held = {"hold": motion.hold, "frame": motion.frame}
    divided = fflin.Trajectory(
        motion.robot, t, np.tile(q, rows), np.tile(v, rows), u, **held
    )
    for part in range(parts):
        q, v = divided.end(part, 1, q, v)
        yield q, v


def largest_speeds(motion):
    """Return the largest speeds of the joints (n,) of the motion integrated between knots."""
    speeds = [v for k in range(len(motion.t) - 1) for _, v in between_knots(motion, k)]
    return np.abs(np.vstack((motion.v, speeds))[:, 6:]).max(axis=0)
