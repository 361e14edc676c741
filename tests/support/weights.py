"""Weights that suit a robot of any size, for tests that need some loop."""

import numpy as np


def unit_weights(lin):
    """Return 1 on every state, and on inputs the squares of the accelerations that each gives."""
    nx = len(lin.A)
    forces = lin.M @ lin.B[nx // 2 :] / (lin.dt or 1.0)
    return np.ones(nx), ((forces / lin.M.diagonal()[:, None]) ** 2).sum(axis=0)
