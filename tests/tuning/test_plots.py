"""The figure of a tuned law shows its goals with their limits, its loops, and the search."""

import math

import numpy as np
import pytest

import fflin
from fflin.tuning.curves import curves_of

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def tuned():
    robot = fflin.load(
        "cubesat", inputs=[fflin.BaseTorque()], outputs=[fflin.BasePose()]
    )
    lin = fflin.linearize(robot)
    goals = [
        fflin.MaxGain({"tau_b": 1e-6}, {"q_b": 1e-2}),
        fflin.RollOff({"q_b": 1.0}, {"tau_b": 1e-3}, above=5.0, below=10.0),
        fflin.Margin(0.6, hard=True),
        fflin.Track("q_b.x", settling=60.0, overshoot=0.5),
        fflin.Decay(0.001),
    ]
    law = fflin.LowPass() * fflin.PD("q_b", "tau_b")
    return fflin.tune([lin, lin], law, goals, starts=1, steps=5)


def test_the_peak_of_a_curve_is_the_value_of_the_goal(tuned):
    curves = [curves_of(item) for item in tuned._loops]
    assert curves[4] is None
    for goal, item in zip(tuned.goals[:3], curves, strict=False):
        assert item.values.shape == (2, len(item.where))
        # The grid contains no point nearer to the peak than its spacing of 3 %.
        peak = (item.values / item.high).max()
        assert peak <= goal.value * (1.0 + 1e-9)
        assert peak == pytest.approx(goal.value, rel=1e-2)
    roll_off = curves[1]
    assert np.isinf(roll_off.high[roll_off.where < 5.0]).all()
    step = curves[3]
    outside = np.maximum(step.values - step.high, step.low - step.values)
    assert (outside[:, 1:].max() <= 0.0) == tuned.goals[3].met
    assert step.where[-1] == 180.0 and step.over_time


def test_the_history_ends_at_the_result(tuned):
    assert len(tuned.history) == len(tuned.parameter_history)
    last = dict(zip(tuned.parameters, tuned.parameter_history[-1], strict=True))
    assert last == tuned.parameters
    assert math.isfinite(tuned.history[-1, 0])


@pytest.mark.exhaustive
def test_the_figure_has_a_panel_for_each_goal_the_loops_and_the_search(tuned, tmp_path):
    figure = tuned.plot(tmp_path / "tuned.svg")
    titles = [panel.get_title() for panel in figure.axes if panel.get_title()]
    assert titles == [
        "gain tau_b to q_b",
        "gain q_b to tau_b above 5 rad/s",
        "disk margin at the inputs",
        "step of q_b.x",
        "Nichols plot",
        "goals in the search",
        "parameters in the search",
    ]
    assert (tmp_path / "tuned.svg").stat().st_size > 10_000
    with pytest.raises(fflin.InputError, match="a Tuned"):
        fflin.plot_tuned(3)
