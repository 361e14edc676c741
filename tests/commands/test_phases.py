"""Phases on the command line: approach, latch and release, one saved motion after the other."""

import json

import numpy as np
import pytest

import fflin
from tests.simulation.test_constraints import off
from tests.support.commands import refused, run

HOW = ("--dt", "0.1", "--duration", "0.5", "--engine", "python")
WELD = ("--weld", "tool_left=tool_right")
BENT = ("--joint", "left_2=0.7", "--joint", "right_2=-0.6")
TARGET = ("--target-joint", "left_2=0.7", "--target-joint", "right_2=-0.6")


@pytest.mark.exhaustive
def test_an_approach_a_latch_and_a_release_follow_each_other(tmp_path):
    files = [tmp_path / f"{name}.npz" for name in ("approach", "held", "opened")]
    start = (*BENT, "--velocity", "left_1=0.1", "--rpy", "0", "0", "2")
    assert run("simulate", "dual_arm", *start, *TARGET, *HOW, "-o", files[0])[0] == 0
    given = ("dual_arm", *WELD, *TARGET, *HOW, "--after", files[0], "-o", files[1])
    code, out, _ = run("simulate", *given, "--json")
    assert code == 0
    given = ("dual_arm", *TARGET, *HOW, "--after", files[1], "-o", files[2])
    assert run("simulate", *given)[0] == 0
    approach, held, opened = map(fflin.Motion.load, files)
    robot = fflin.load("dual_arm")
    weld = fflin.Weld("tool_left", "tool_right")
    expected = fflin.latch(robot, weld, q=approach.q[-1], v=approach.v[-1])
    np.testing.assert_allclose(held.q[0], expected.q, atol=1e-13)
    np.testing.assert_allclose(held.v[0], expected.v, atol=1e-13)
    impact = json.loads(out)["impact"]
    assert impact["event"] == "tool_left/tool_right latched"
    np.testing.assert_allclose(impact["impulse"], expected.impulse, atol=1e-12)
    assert off(expected.robot, held)[0] < 1e-12
    assert held.momentum_drift.max() < 1e-12
    np.testing.assert_array_equal(opened.v[0], held.v[-1])
    assert opened.constraint_names == ()


@pytest.mark.exhaustive
def test_a_phase_that_is_already_closed_has_no_impact(tmp_path):
    files = [tmp_path / f"{name}.npz" for name in ("one", "two")]
    given = ("simulate", "dual_arm", *WELD, *TARGET, *HOW)
    assert run(*given, *BENT, "--rpy", "0", "0", "2", "-o", files[0])[0] == 0
    code, out, _ = run(*given, "--after", files[0], "-o", files[1])
    assert code == 0 and "impact" not in out
    one, two = map(fflin.Motion.load, files)
    np.testing.assert_allclose(two.v[0], one.v[-1], atol=1e-15)


def test_a_start_besides_the_file_and_other_robots_are_refused(tmp_path):
    path = tmp_path / "m.npz"
    assert run("simulate", "cubesat", *HOW, "--rpy", "1", "0", "0", "-o", path)[0] == 0
    again = ("simulate", "cubesat", *HOW, "--after", path)
    assert "--after" in refused(*again, "--rpy", "1", "0", "0")
    text = refused("simulate", "dual_arm", *HOW, "--after", path)
    assert "was made for 'cubesat'" in text


@pytest.mark.exhaustive
def test_a_gain_is_designed_at_the_end_of_a_motion(tmp_path):
    motion, elsewhere, gain = (tmp_path / f"{x}.npz" for x in ("m", "other", "gain"))
    start = ("--joint", "left_2=0.5", "--joint", "right_2=-0.6")
    short = ("--dt", "0.1", "--duration", "0.2", "--engine", "python")
    assert run("simulate", "dual_arm", *start, *TARGET, *short, "-o", motion)[0] == 0
    design = ("lqr", "dual_arm", *WELD)
    assert run(*design, *BENT, "-o", elsewhere)[0] == 0
    fly = ("simulate", "dual_arm", *WELD, *short, "--after", motion)
    text = refused(*fly, "--gain", elsewhere)
    assert "is off constraint 'tool_left/tool_right' by" in text
    assert "fflin lqr --after FILE" in text
    # The advice of the message: the same gain at the posture of the latch.
    assert run(*design, "--after", motion, "-o", gain)[0] == 0
    assert run(*fly, "--gain", gain)[0] == 0
    q = fflin.Motion.load(motion).q[-1]
    welded = fflin.load("dual_arm").replace(
        constraints=[fflin.Weld("tool_left", "tool_right")]
    )
    expected = fflin.lqr(fflin.linearize(welded, q))
    np.testing.assert_allclose(fflin.Gain.load(gain).K, expected.K, rtol=1e-9)
    assert "--after" in refused(*design, *BENT, "--after", motion)
