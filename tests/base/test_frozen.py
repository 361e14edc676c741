"""Results stay read-only on every way that makes a copy of them."""

import copy
import pickle

import numpy as np
import pytest

import fflin


@pytest.fixture(scope="module")
def results():
    """Results of several kinds, one of them with an array that was made when it was asked for."""
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin)
    policy = fflin.StateFeedback(lin, gain.K)
    motion = fflin.simulate(robot, policy, duration=0.1, dt=0.05, engine="python")
    assert lin.x0.size
    lft = fflin.uncertain(robot, {"base.mass": 0.1}).lft()
    batch = fflin.sweep(robot, [robot.neutral()] * 2)
    return lin, gain, motion, lft, fflin.sensitivity(lin)["base.mass"], batch


COPIES = {
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
    **{
        f"pickle {k}": lambda x, k=k: pickle.loads(pickle.dumps(x, k))
        for k in range(2, 6)
    },
}


@pytest.mark.parametrize("way", COPIES)
def test_copies_are_read_only_and_equal(results, way):
    for result in results:
        again, count = COPIES[way](result), 0
        for name, value in vars(result).items():
            if isinstance(value, np.ndarray):
                outcome, count = vars(again)[name], count + 1
                assert np.array_equal(outcome, value)
                assert not outcome.flags.writeable, (type(result).__name__, name)
        assert count > 4
