"""150 random robots with 1 to 3 random constraints, some of them redundant.

Each of them is linearised, checked and simulated. A robot at a singular posture, or whose
constraints have no effect, is refused with a message that says so.
"""

import numpy as np
import pytest

import fflin
from fflin.dynamics.constraints import Constraints
from tests.support.constrained import random_constraints
from tests.support.robots import FRAMES, random_pose

CHUNK = 25


def case(seed):
    """Return a random robot, its closed point and its model; None if it is refused."""
    rng = np.random.default_rng([47, seed])
    try:
        robot, q, v, u = random_constraints(
            rng, count=1 + seed % 3, loads=seed % 2 == 0
        )
        options = {"frame": FRAMES[seed % 3], "reference": random_pose(rng, 60.0)}
        if seed % 5 == 0:
            v, u = np.zeros_like(v), np.zeros_like(u)
        return robot, q, v, fflin.linearize(robot, q, v, u, **options)
    except fflin.ConstraintError as error:
        text = str(error)
        assert any(x in text for x in ("singular", "no effect", "no closed")), text
        return None


def flown(robot, q, v):
    """Return the largest residual and rate of the rows in a motion of 0.1 s, and the motion."""
    motion = fflin.simulate(
        robot, q0=q, v0=v, duration=0.1, dt=0.01, engine="python", frame="local"
    )
    rows = Constraints(robot)
    residual = max(np.abs(rows.residual(q)).max() for q in motion.q)
    pairs = zip(motion.q, motion.v, strict=True)
    rate = max(np.abs(rows.jacobian(q) @ v).max() for q, v in pairs)
    return residual, rate, motion


@pytest.mark.exhaustive
@pytest.mark.parametrize("first", range(0, 150, CHUNK))
def test_random_robots_are_verified_and_stay_closed(first):
    for seed in range(first, first + CHUNK):
        found = case(seed)
        if found is None:
            continue
        robot, q, v, lin = found
        check = fflin.check(robot, lin)
        assert check.ok, (seed, str(check))
        residual, rate, motion = flown(robot, q, v)
        assert not motion.stopped, (seed, motion.stopped)
        reach = 1.0 + np.abs(motion.q[:, :3]).max()
        speed = 1.0 + np.abs(motion.v).max()
        assert residual < 1e-11 * reach, (seed, residual, reach)
        assert rate < 1e-11 * reach * speed, (seed, rate, reach * speed)
        if not robot.anchored and not any(robot.gravity):
            assert np.abs(motion.momentum_drift).max() < 1e-12, seed
