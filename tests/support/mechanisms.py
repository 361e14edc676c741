"""Motors of a robot, and linear models of mechanisms made from their matrices."""

from dataclasses import replace

import numpy as np

from fflin import JointTorque


def motors(robot, count=None):
    return [JointTorque(name) for name in robot.joint_names[:count]]


def mechanical(M, K, D, S, like):
    """A linear model of M a + D v + K q = S u."""
    nv = len(M)
    A = np.zeros((2 * nv, 2 * nv))
    # Positions that change at other rates than the velocities, as half the rotation does.
    N = np.diag(1.0 / (1.0 + np.arange(nv) % 3))
    A[:nv, nv:] = N
    A[nv:] = -np.linalg.solve(M, np.hstack((K @ np.linalg.inv(N), D)))
    B = np.vstack((np.zeros_like(S), np.linalg.solve(M, S)))
    names = tuple(f"u_{i}" for i in range(S.shape[1]))
    return replace(
        like,
        A=A,
        B=B,
        D=np.zeros((2 * nv, len(names))),
        input_names=names,
        input_units=names,
        u0=np.zeros(len(names)),
        _inertia=lambda _: M,
    )
