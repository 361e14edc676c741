"""M^-1 of many configurations at once, against the one of each."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.batch.sweep import ChunkJob
from fflin.dynamics.rnea import Inertia
from fflin.linear.aba_route import inertia_matrix
from tests.support.robots import BUNDLED, random_tree

pytestmark = pytest.mark.compiled

numba = pytest.importorskip("numba")


def spread_configurations(robot, count, seed=0):
    """Random joints, and bases that are anywhere."""
    rng = np.random.default_rng(seed)
    q = np.empty((count, robot.nq))
    for row in q:
        joints = {joint.name: rng.uniform(-3.0, 3.0) for joint in robot.joints}
        pose = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))
        row[:] = fflin.configuration(robot, joints, pose)
    return q


def agreement(robot, q):
    """Largest difference of kernel and loop, over what the conditioning of M lets round-off do."""
    size = 6 + robot.n
    kernel, loop = np.empty((2, len(q), size, size))
    job = ChunkJob(fflin.Linearizer(robot), at_rest=True)
    assert not len(job.write({"q": q}, {"B_lower": kernel}))
    inertia = Inertia(fflin.StateMap(robot), robot.create_data())
    for point, inverse in zip(q, loop, strict=True):
        inertia.invert(point, inverse)
    worst = 0.0
    for fast, slow, point in zip(kernel, loop, q, strict=True):
        mobility = np.sqrt(slow.diagonal())
        error = (np.abs(fast - slow) / np.outer(mobility, mobility)).max()
        worst = max(worst, error / condition(robot, point))
    return worst


def condition(robot, q):
    M = inertia_matrix(robot, fflin.linearize(robot, q))
    scale = 1.0 / np.sqrt(M.diagonal())
    return np.linalg.cond(scale[:, None] * M * scale)


@pytest.mark.parametrize("name", BUNDLED)
def test_kernel_agrees_with_pinocchio_on_every_bundled_robot(name, robots):
    # Not a multiple of the lanes, so that the last are filled up.
    assert agreement(robots[name], spread_configurations(robots[name], 21)) < 1e-14


@pytest.mark.parametrize("n", [1, 2, 7, 20])
def test_kernel_agrees_on_random_trees_of_every_joint_type(n):
    robot = random_tree(np.random.default_rng(n), n)
    assert agreement(robot, spread_configurations(robot, 11)) < 1e-14


@pytest.mark.exhaustive
def test_kernel_counts_the_rotors_of_joints_and_base(robots):
    model = robots["servicer_7dof"].model.copy()
    model.armature = np.linspace(0.1, 2.0, model.nv)
    robot = fflin.from_model(model)
    assert agreement(robot, spread_configurations(robot, 11)) < 1e-14
