"""Campaigns of robots with constraints: starts in independent coordinates, and refusals."""

import numpy as np
import pytest

import fflin
from fflin.dynamics.constraints import Constraints
from tests.simulation.test_constraints import dual_arm

OPTIONS = {"runs": 3, "duration": 0.1, "dt": 0.05, "engine": "python"}


def test_starts_are_closed_and_keep_the_drawn_coordinates():
    robot, q, v = dual_arm()
    spreads = {"q_m.left_1": 0.02, "qdot_m.left_2": 0.02, "omega_b": 0.01}
    campaign = fflin.monte_carlo(robot, None, spreads, q0=q, v0=v, **OPTIONS)
    nominal = fflin.StateMap(robot).to_state(q, v)
    rows = Constraints(robot)
    motion = campaign.replay(1)
    assert np.abs(rows.residual(motion.q[0])).max() < 1e-13
    assert np.abs(rows.jacobian(motion.q[0]) @ motion.v[0]).max() < 1e-13
    for at, name in enumerate(campaign.names):
        column = motion.state_names.index(name)
        drawn = campaign.drawn[1, at]
        assert drawn and motion.x[0, column] == pytest.approx(
            nominal[column] + drawn, abs=1e-12
        )


def test_draws_that_cannot_be_closed_are_refused():
    # From 0.8 to 3 rad, no choice of the dependent joints closes the loop.
    robot, q, v = dual_arm()
    with pytest.raises(fflin.InputError, match="smaller dispersion"):
        fflin.monte_carlo(robot, None, {"q_m.left_2": [2.0]}, q0=q, v0=v, **OPTIONS)
