"""Aerial robots: rotors with reaction torques, and hover."""

import numpy as np
import pytest

import fflin
from tests.support.quadrotor import INERTIA, MASS, PLACES, SIGNS, K, quadrotor


def test_four_rotors_have_the_closed_form(tmp_path):
    """Force and torques of f_k: lift sum f_k, moments p x f z, and yaw sum s_k k f_k."""
    robot = quadrotor(tmp_path, arm=False)
    hover = fflin.equilibrium(robot)
    assert hover.u == pytest.approx(np.full(4, MASS * 9.81 / 4.0), rel=1e-12)
    lin = fflin.linearize(robot, hover.q, u=hover.u)
    assert lin.is_equilibrium() and fflin.check(robot, lin).ok
    x, y = np.transpose(PLACES)
    wrench = {
        "omega_b.x": y / INERTIA[0],
        "omega_b.y": -x / INERTIA[1],
        "omega_b.z": K * np.array(SIGNS) / INERTIA[2],
        "v_b.z": np.full(4, 1.0 / MASS),
    }
    for name, expected in wrench.items():
        row = lin.B[lin.state_names.index(name)]
        assert row == pytest.approx(expected, rel=1e-12, abs=1e-12)
    assert fflin.controllability(lin).dimension == 12
    assert fflin.lqr(lin).poles.real.max() < 0.0
