"""Ranges of validity of robots with constraints: displacements of the independent states."""

import numpy as np
import pytest

import fflin
from fflin.campaign.settling import OUTCOMES, Loop
from fflin.dynamics.constraints import Constraints
from fflin.simulation.run import STOPS
from tests.simulation.test_constraints import dual_arm
from tests.support.constrained import pendulum

INERTIA = np.array((0.2, 0.3, 0.4))


def held_body():
    """A body on a point under gravity, with its attitude as independent coordinates."""
    robot = pendulum(3.0, INERTIA, 0.7).replace(independent=["q_b"])
    lin = fflin.linearize(robot)
    return robot, lin, fflin.lqr(lin)


@pytest.mark.exhaustive
def test_the_error_of_a_held_body_is_of_second_order(brief_validity):
    robot, lin, gain = held_body()
    options = {"attitude": 40.0, "engine": "python", "samples": 4}
    reach = fflin.validity(robot, lin, gain, **options)
    # The fit over levels with a ratio of 8 leaves terms of the next order.
    assert abs(reach.slope - 2.0) < 0.01
    assert reach.largest == {"attitude": 40.0, "position": 0.0, "joint": 0.0}
    assert reach.settled == reach.inside == 4
    assert reach.residual < 1e-13
    assert reach.trusted["attitude"] > 5.0


@pytest.mark.exhaustive
def test_two_arms_have_a_range(brief_validity, monkeypatch):
    # The slope needs accurate predictions.
    monkeypatch.setattr("fflin.campaign.settling._STEP_PREDICTED", 0.25)
    robot, q, _ = dual_arm()
    lin = fflin.linearize(robot, q)
    sizes = {"attitude": 30.0, "position": 0.2, "joint": 0.3}
    options = {"engine": "python", "samples": 2, **sizes}
    reach = fflin.validity(robot, lin, fflin.lqr(lin), **options)
    assert abs(reach.slope - 2.0) < 0.02
    assert reach.residual < 1e-12
    assert set(reach.outcomes) == {"settled"}


@pytest.mark.parametrize("level", [0.1, 1.0])
def test_displaced_states_are_closed_and_have_the_displacements(level):
    robot, q, _ = dual_arm()
    chosen = ["q_b", "r_b", "left_1", "right_2"]
    lin = fflin.linearize(robot, q, independent=chosen)
    loop = Loop(robot, lin, fflin.lqr(lin))
    rng = np.random.default_rng(3)
    x = loop.displaced(rng, 40.0 * level, 0.3 * level, 0.1 * level)
    at, _ = loop.state.to_pinocchio(x)
    assert np.abs(Constraints(robot).residual(at)).max() < 1e-13
    # The loop does not move the base, so all independent states have the displacements.
    g, apart = loop.state.groups, x - loop.start
    angle = 2.0 * np.arcsin(np.linalg.norm(apart[g.q_b]))
    assert np.degrees(angle) == pytest.approx(40.0 * level, rel=1e-12)
    assert np.linalg.norm(apart[g.r_b]) == pytest.approx(0.3 * level, rel=1e-12)
    names = loop.state.names
    joints = [apart[names.index(f"q_m.{name}")] for name in ("left_1", "right_2")]
    assert 0.0 < np.abs(joints).max() <= 0.1 * level
    others = [apart[names.index(f"q_m.{name}")] for name in ("left_2", "right_3")]
    assert np.abs(others).min() > 1e-4


def test_displacements_without_a_closed_configuration_are_refused():
    # The arms are too short for three radians of each independent joint.
    robot, q, _ = dual_arm()
    lin = fflin.linearize(robot, q)
    options = {"joint": 300.0, "samples": 2, "engine": "python"}
    with pytest.raises(fflin.InputError, match="were not closed at 30 random"):
        fflin.validity(robot, lin, fflin.lqr(lin), **options)


def test_a_run_that_stops_at_a_singular_posture_is_named():
    robot, lin, gain = held_body()
    loop = Loop(robot, lin, gain)
    x = np.tile(loop.start, (2, 1))
    x[:, loop.model_states[0]] += 0.1
    runs = {
        "state_errors": (x - loop.start)[:, None],
        "x": x,
        "stop": np.array([0.0, STOPS.index("stopped")]),
        "largest": np.zeros((2, 6)),
    }
    judged = loop._judged(None, runs)
    assert [OUTCOMES[int(code)] for code in judged["outcome"]] == ["slow", "singular"]
    assert np.isnan(judged["error"]).tolist() == [False, True]


@pytest.mark.compiled
def test_both_engines_find_the_same_range(brief_validity):
    robot, lin, gain = held_body()
    options = {"attitude": 60.0, "samples": 8}
    one, two = (
        fflin.validity(robot, lin, gain, engine=engine, **options)
        for engine in ("python", "compiled")
    )
    np.testing.assert_allclose(two.prediction_error, one.prediction_error, rtol=1e-6)
    assert two.outcomes == one.outcomes
