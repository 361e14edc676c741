"""The report of a law: no name is lost, and lower limits and missing bounds are explained."""

import math

import numpy as np
import pytest

import fflin
from fflin.tuning.goal_values import goal_table, legend
from tests.support.tuning import of_sweep
from tests.tuning.test_hidden_modes import equal_wings

NAMES = ("star_tracker.x", "star_tracker.y", "star_tracker.z", "gyroscope.hub.x")


def value_of(goal, value=0.5, **values):
    defaults = {"check": value, "frequency": 1.0, "parameters": {}, "active": False}
    return fflin.GoalValue(goal.label, goal.hard, value, **(defaults | values))


def test_no_name_of_a_signal_is_lost_in_80_columns():
    goals = [
        value_of(fflin.MaxGain(NAMES, ["tau_b", "error.q_b"], hard=True), active=True),
        value_of(fflin.RollOff("q_b", "a" * 70, above=5.0, below=1.0)),
        value_of(fflin.Decay(0.1), parameters={"base.density": 0.9}),
    ]
    table = goal_table(goals)
    assert max(map(len, table.splitlines())) <= 80
    for name in (*NAMES, "tau_b", "error.q_b", "above", "5 rad/s", "decay rate"):
        assert name in table
    words = table.split()
    assert "".join(word for word in words if {*word} == {"a"}) == "a" * 70
    # Each value stands beside the first line of its goal.
    assert sum(line.split().count("0.5") == 2 for line in table.splitlines()) == 3


@pytest.mark.parametrize(
    ("goals", "kinds"),
    [
        ([fflin.MaxGain("u", "y"), fflin.Track("y", 10.0)], None),
        ([fflin.MaxGain("u", "y"), fflin.Margin(0.5)], "margins"),
        ([fflin.Decay(0.1), fflin.Damping(0.5)], "decay rates and damping ratios"),
        (
            [fflin.Damping(0.5), fflin.Margin(0.5, at="outputs"), fflin.Decay(0.1)],
            "margins, decay rates and damping ratios",
        ),
    ],
)
def test_lower_limits_are_explained_if_there_are_any(goals, kinds):
    _, *lines = legend([value_of(goal) for goal in goals])
    if kinds is None:
        assert not lines
        return
    (line,) = lines
    assert line.startswith(f"{kinds} have lower limits")
    assert line.endswith("is to divide it")


def test_a_factor_multiplies_upper_limits_and_divides_lower_ones():
    """A rigid body with u = -(kp y + kd y') has poles whose sum is -kd / J."""
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()])
    lin = fflin.linearize(robot)
    law = fflin.PD(
        "q_b.x", "tau_b.x", rates="omega_b.x", kd=(1e-6, 1e-3), kp=(1e-9, 1.0)
    )
    J = 1.0 / lin.B[lin.state_names.index("omega_b.x"), 0]
    rate = 10.0 * 0.5 * 1e-3 / J
    tuned = fflin.tune(lin, law, fflin.Decay(rate), starts=1, steps=60)
    assert not tuned.met and tuned.factor == pytest.approx(10.0, rel=1e-3)
    loosened = fflin.Decay(rate / (1.001 * tuned.factor))
    start = tuned.relaxed
    assert fflin.tune(lin, law, loosened, starts=1, steps=1, start=start).met


@pytest.fixture(scope="module")
def untied():
    """The loop of two equal wings of little damping, whose frequencies vary independently."""
    ranges = {f"{side}_mode_1.frequency": 0.3 for side in ("left", "right")}
    return fflin.uncertain(equal_wings(damping=1e-3), ranges)


@pytest.mark.exhaustive
def test_the_report_says_why_a_bound_is_missing(untied):
    goals = [
        fflin.MaxGain({"tau_b.x": 0.01}, {"q_b.x": 1.0}),
        fflin.Decay(1e-9),
        fflin.Damping(1e-6),
    ]
    law = fflin.PD("q_b.x", "tau_b.x")
    tuned = fflin.tune(untied, law, goals, starts=1, steps=2)
    gain, decay, damping = tuned.goals
    assert gain.bound == math.inf and "no bound was found near" in gain.no_bound
    assert math.isnan(decay.bound) and decay.no_bound == damping.no_bound
    report = str(tuned).replace("\n  ", " ")
    assert f"whole ranges: {gain.label}; {gain.no_bound}" in report
    assert (
        "whole ranges: decay rate, damping ratio; no bound: only gains and margins"
        in report
    )


@pytest.fixture(scope="module")
def designed():
    """A controller of full order for two goals."""
    pytest.importorskip("slycot")
    robot = fflin.load(
        "cubesat", inputs=[fflin.BaseTorque()], outputs=[fflin.BasePose()]
    )
    goals = [
        fflin.MaxGain({"tau_b": 0.01}, {"q_b": 0.05}),
        fflin.MaxGain({"q_b": 1e-3}, {"tau_b": 0.02}),
    ]
    return fflin.hinf(fflin.linearize(robot), goals, measured="q_b")


def test_each_goal_of_hinf_has_the_value_of_a_sweep(designed):
    lin = designed.lin
    frequencies = np.geomspace(1e-2, 1e3, 400)
    gains = of_sweep(designed, (lin.A, lin.B, lin.C, lin.D), frequencies)
    torque, effort = gains[:, 0] * 0.01 / 0.05, gains[:, 1] * 1e-3 / 0.02
    for goal, swept in zip(designed.goals, (torque, effort), strict=True):
        assert goal.value == pytest.approx(swept.max(), rel=1e-2)
        assert goal.value >= swept.max() * (1.0 - 1e-6)
        assert goal.value == pytest.approx(goal.check, rel=1e-6)
        assert goal.value <= designed.gamma * (1.0 + 1e-6) and math.isnan(goal.least)
    assert designed.goals[0].label in str(designed)


def test_the_report_of_hinf_has_the_order_and_the_norm(designed):
    report = str(designed).replace("\n  ", " ")
    assert f"hold with order {designed.order}; the norm of the loop from all" in report
    assert f"full order {designed.order}: the norm is {designed.gamma:.4g}" in report
    assert repr(designed).startswith("HInfinity('cubesat', gamma=")
