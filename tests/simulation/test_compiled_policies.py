"""The compiled loop against the one in Python: every bundled robot under every policy."""

import warnings

import numpy as np
import pytest

import fflin
from fflin.kernel.compiled import ENGINES
from tests.support.motions import displaced
from tests.support.policies import POLICIES, between_gains, plain, shared
from tests.support.robots import BUNDLED

pytest.importorskip("numba")

pytestmark = pytest.mark.compiled


def apart(robot, policy, **options):
    """Run both loops; return the compiled motion and how far its arrays are apart from 1 on."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fflin.FflinWarning)
        python, motion = (
            fflin.simulate(robot, policy, **options, engine=engine)
            for engine in ENGINES
        )
    assert (python.engine, motion.engine) == ENGINES
    assert motion.stopped == python.stopped == ""
    sizes = {}
    for name in ("t", "q", "v", "x", "u", "energy", "momentum"):
        expected, result = getattr(python, name), getattr(motion, name)
        assert result.shape == expected.shape, name
        size = np.maximum(1.0, np.abs(expected).max(axis=0))
        sizes[name] = (np.abs(result - expected) / size).max(initial=0.0)
    return motion, sizes


@pytest.mark.parametrize("make", POLICIES, ids=lambda make: make.__name__)
@pytest.mark.parametrize("name", BUNDLED)
def test_both_loops_agree(robots, name, make):
    if make is between_gains and not robots[name].n:
        pytest.skip("there are no joints to lay a grid over")
    robot, policy, options = make(plain(robots[name]))
    x0 = displaced(fflin.linearize(robot), degrees=20.0)
    method = ("cf4", "semi_implicit_euler")[BUNDLED.index(name) % 2]
    options = {
        "x0": x0,
        "duration": 10.0,
        "dt": 0.02,
        "linear": False,
        "method": method,
    } | options
    motion, sizes = apart(robot, policy, **options)
    # Thrusts that do the same are told apart by rows of 1e-7: rounding is 1e7 times as large.
    assert sizes.pop("u") < (1e-8 if make is shared else 1e-10)
    assert max(sizes.values()) < 1e-10
    assert np.abs(motion.u).max() > 1e-3
