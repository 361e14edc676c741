"""Loops that are closed over what is measured."""

import numpy as np

import fflin
from tests.support.weights import unit_weights

POSITIONS = (fflin.BasePose(), fflin.JointPositions())
FELT = (*POSITIONS, fflin.Accelerometer("base"))


def designed(outputs, **fields):
    robot = fflin.load("ets_vii", outputs=outputs, **fields)
    q = fflin.configuration(robot, {"joint_2": 0.4})
    lin = fflin.linearize(robot, q, None, fflin.equilibrium(robot, q).u)
    sampled = lin.discretize(0.05)
    gain = fflin.lqr(sampled, *fflin.sampled_cost(lin, 0.05, *unit_weights(lin)))
    estimator = fflin.kalman(sampled, np.diag(lin.B @ lin.B.T) + 1e-6, 1e-4)
    return robot, sampled, fflin.lqg(gain, estimator)


def foreseen(lin, compensator, x, steps):
    """The states of the linear model under the compensator, sample by sample."""
    e, z, rows = x - lin.x0, np.zeros(len(x)), []
    for _ in range(steps + 1):
        rows.append(e)
        du = compensator.C @ z
        z = compensator.A @ z + compensator.B @ (lin.C @ e + lin.D @ du)
        e = lin.A @ e + lin.B @ du
    return lin.x0 + np.array(rows)
