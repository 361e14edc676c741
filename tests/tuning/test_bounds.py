"""Bounds of goals over whole ranges: closed forms, random parameters and instability."""

import math

import numpy as np
import pytest

import fflin
from fflin.uncertainty.gain_bound import Channels, Scaling, gain_bound, improved
from tests.support.tuning import of_sweep

RATES = np.geomspace(1e-2, 1e2, 60)


def oscillator(damping, width):
    """Channels of x'' + damping x' + (1 + width delta) x = d, with z = e = x."""

    def response(frequencies):
        s = 1j * np.minimum(frequencies, 1e30)
        x = 1.0 / (s**2 + damping * s + 1.0)
        return x[:, None, None] * np.array([[-width, 1.0], [-width, 1.0]])

    return Channels(response, 1, np.zeros(1))


def largest(stiffness, damping):
    """Largest gain of an oscillator over frequency."""
    ratio = damping / (2.0 * math.sqrt(stiffness))
    if ratio >= math.sqrt(0.5):
        return 1.0 / stiffness
    return 1.0 / (2.0 * stiffness * ratio * math.sqrt(1.0 - ratio**2))


@pytest.mark.parametrize("damping", [0.05, 0.5, 3.0])
def test_the_bound_of_an_oscillator_is_its_gain_at_the_softest_spring(damping):
    exact = largest(1.0 - 0.3, damping)
    channels = oscillator(damping, 0.3)
    assert gain_bound(channels, RATES, 1.001 * exact).value == 1.001 * exact
    bound = gain_bound(channels, RATES, largest(1.0, damping)).value
    assert exact <= bound <= 1.15 * exact


def test_a_scaling_that_overflows_is_not_accepted():
    M = np.array([[[0.1, 500.0], [1e-3, 0.1]]], complex)
    huge = Scaling(np.array([800.0, -800.0]), np.full(2, 1e300))
    _, value = improved(M, huge, 2, np.zeros(0), 1.0)
    assert value == math.inf
    scaling, value = improved(M, Scaling(np.zeros(2), np.zeros(2)), 2, np.zeros(0), 1.0)
    assert value <= 1.0 and np.isfinite(scaling.log_d).all()


def test_a_range_with_an_unstable_loop_has_no_bound():
    bound = gain_bound(oscillator(0.1, 1.001), RATES, 1.0)
    assert bound.value == math.inf and bound.missing < 1.0


@pytest.fixture(scope="module")
def uncertain():
    robot = fflin.load(
        "servicer_7dof",
        lock=["joint_*"],
        inputs=[fflin.BaseTorque()],
        outputs=[fflin.BasePose()],
        stiffness={"panel_*": 100.0},
        damping={"panel_*": 1.0},
    )
    stiffness = {"range": 0.2, "tied": True}
    return fflin.uncertain(robot, {"base.density": 0.2, "panel_*.stiffness": stiffness})


LAW = fflin.LowPass(4.5, damping=0.7, order=2) * fflin.PD(
    "q_b", "tau_b", shared=True, kp=300.0, kd=fflin.Tunable(850.0), lag=0.033
)
GOALS = [
    fflin.MaxGain({"tau_b": 0.01}, {"q_b": 1e-3}),
    fflin.Margin(0.7),
    fflin.Decay(0.001),
]


@pytest.mark.exhaustive
def test_the_report_bounds_the_gains_over_the_whole_ranges(uncertain):
    tuned = fflin.tune(uncertain, LAW, GOALS, starts=1, steps=5)
    gain, margin, decay = tuned.goals
    assert gain.worst < gain.bound <= 1.1 * gain.worst
    assert margin.worst <= margin.bound <= 1.1 * margin.worst
    assert math.isnan(decay.bound)
    draws, _ = uncertain.draws(40, seed=5)
    frequencies = np.geomspace(1e-2, 1e2, 500)
    for deltas in draws:
        lin = fflin.linearize(uncertain.at(uncertain.values(deltas)))
        assert 0.7 / fflin.margins(tuned, lin).disk <= margin.bound
        matrices = lin.A, lin.B, lin.C, lin.D
        gains = of_sweep(tuned, matrices, frequencies)[:, 0]
        assert gains.max() * 0.01 / 1e-3 <= gain.bound
    report = str(tuned)
    assert "upper bounds" in report
    assert "not certified over the whole ranges: decay rate" in report.replace(
        "\n  ", " "
    )
