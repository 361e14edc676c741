"""Linear models in a circular orbit: textbooks' matrices, and every route to them."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

import fflin
from fflin.dynamics.names import groups_of
from tests.support.orbits import N, in_orbit
from tests.support.robots import free_body, random_pose, random_tree

ROBOTS = ("ets_vii", "cubesat", "canadarm2", "servicer_7dof")

# Clohessy and Wiltshire's matrix over (x, y, z, dx, dy, dz) in Hill's axes, and LVLH's axes in them.
CW = np.zeros((6, 6))
CW[:3, 3:] = np.eye(3)
CW[3:, :3] = np.diag((3.0 * N**2, 0.0, -(N**2)))
CW[3, 4], CW[4, 3] = 2.0 * N, -2.0 * N
HILL_OF = {"hill": np.eye(3), "lvlh": np.array(((0, 0, -1.0), (1.0, 0, 0), (0, -1.0, 0)))}


def translation(lin):
    """A over position and velocity of the base."""
    rows = np.r_[3:6, 9:12] if len(lin.A) == 12 else None
    return lin.A[np.ix_(rows, rows)]


@pytest.mark.parametrize("frame", ["hill", "lvlh"])
@pytest.mark.parametrize("degrees", [0.0, 130.0])
def test_the_translation_of_a_body_is_clohessy_and_wiltshires(frame, degrees):
    robot = in_orbit(free_body((3.0, 5.0, 4.0)))
    q = fflin.configuration(robot, base=random_pose(np.random.default_rng(0), degrees))
    lin = fflin.linearize(robot, q, frame=frame)
    turn = np.kron(np.eye(2), HILL_OF[frame])
    assert np.abs(turn @ translation(lin) @ turn.T - CW).max() <= 1e-14 * N
    rows = np.r_[3:6, 9:12]
    others = np.setdiff1d(np.arange(12), rows)
    assert not lin.A[np.ix_(rows, others)].any()
    assert np.allclose(lin.B[9:, 3:], np.eye(3) / lin.M[3, 3], rtol=0, atol=1e-15)


def test_its_samples_are_the_closed_form_of_textbooks():
    lin = fflin.linearize(in_orbit(free_body((3.0, 5.0, 4.0))), frame="hill")
    h = 1.7
    s, c, t = math.sin(N * h), math.cos(N * h), N * h
    # Clohessy and Wiltshire 1960, as in Vallado, Fundamentals of Astrodynamics.
    expected = np.array(
        [
            [4 - 3 * c, 0, 0, s / N, 2 * (1 - c) / N, 0],
            [6 * (s - t), 1, 0, -2 * (1 - c) / N, (4 * s - 3 * t) / N, 0],
            [0, 0, c, 0, 0, s / N],
            [3 * N * s, 0, 0, c, 2 * s, 0],
            [-6 * N * (1 - c), 0, 0, -2 * s, 4 * c - 3, 0],
            [0, 0, -N * s, 0, 0, c],
        ]
    )
    assert np.abs(translation(lin.discretize(h)) - expected).max() < 1e-14 * np.abs(expected).max()


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("frame", ["hill", "lvlh"])
def test_every_route_agrees_at_any_point(name, frame):
    robot = in_orbit(fflin.load(name))
    rng = np.random.default_rng(1)
    for speed in (0.0, 0.4):
        joints = {joint.name: rng.uniform(-1.0, 1.0) for joint in robot.joints}
        q = fflin.configuration(robot, joints, random_pose(rng, 100.0))
        nu = len(fflin.linearize(robot).input_names)
        lin = fflin.linearize(
            *(robot, q, speed * rng.normal(size=robot.nv), speed * rng.normal(size=nu)), frame=frame
        )
        found = fflin.check(robot, lin)
        assert found.ok, found
