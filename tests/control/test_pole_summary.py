"""First line of the reports of gains and filters: how fast the poles decay."""

from types import SimpleNamespace

import numpy as np
import pytest

import fflin
from fflin.control.gain import neutral_poles, summary_of_poles


def wheels_in_orbit(altitude):
    """Return the gain of a robot whose wheels only the weak gravity gradient unloads."""
    wheels = [fflin.ReactionWheel(axis, inertia=1e-5) for axis in np.eye(3)]
    orbit = fflin.CircularOrbit(altitude=altitude)
    robot = fflin.load("cubesat", inputs=wheels, orbit=orbit)
    return fflin.lqr(fflin.linearize(robot), wheel_speeds=True)


def test_a_marginal_pole_is_called_neutral_and_not_a_decay():
    gain = wheels_in_orbit(36e6)
    decays = np.sort(-gain.poles.real)
    rounding = 1e-7 * np.abs(gain.poles).max()
    assert decays[2] < rounding
    first = " ".join(str(gain).split("\n\n")[0].split())
    assert first.startswith(
        f"9 poles, 3 of them neutral (decay {decays[2]:.2g} 1/s, within the rounding error "
        f"of {rounding:.2g} 1/s), slowest decay of the others "
        f"{decays[3]:.3g} 1/s, smallest damping ratio 0.71"
    )


def test_a_slow_but_certain_decay_is_stated_as_it_is():
    gain = wheels_in_orbit(550e3)
    decay = -gain.poles.real.max()
    assert str(gain).startswith(f"9 poles, slowest decay {decay:.3g} 1/s")


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_a_split_double_pole_at_zero_is_neutral(dt):
    # Rounding moves a double pole at zero by the square root of the rounding error, 1.5e-8.
    rates = np.array([-1.55e-8, 1.55e-8, -1.0 + 1.0j, -1.0 - 1.0j])
    assert neutral_poles(rates, dt).tolist() == [True, True, False, False]
    poles = np.exp(rates * dt) if dt else rates
    text = summary_of_poles(SimpleNamespace(poles=poles, dt=dt))
    assert text.startswith("4 poles, 2 of them neutral")
    assert "slowest decay of the others 1 1/s" in text


def test_poles_that_are_all_neutral_have_no_decay():
    design = SimpleNamespace(poles=np.array([1j, -1j]), dt=0.0)
    assert summary_of_poles(design).startswith(
        "2 poles, 2 of them neutral (decay 0 1/s"
    )
    assert "slowest" not in summary_of_poles(design)


def test_the_report_of_a_gain_names_its_inputs_with_units():
    report = str(fflin.lqr(fflin.linearize(fflin.load("servicer_7dof"))))
    assert "\nu: tau_b [N m], F_b [N], tau_m [N m]\n" in report
    assert "\nx: q_b [1], r_b [m], q_m [rad], omega_b [rad/s], v_b [m/s], " in report
    assert "too large to show" in report


def test_poles_of_delays_are_one_line():
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(max=1e-3)])
    model = fflin.linearize(robot).discretize(0.25, delay=0.5)
    report = str(fflin.lqr(model))
    # Each of three inputs is two samples late.
    assert "6 poles at zero (delay)" in report
    assert "e-0" not in report.partition("slowest first")[2].partition("6 poles")[0]
    plain = str(fflin.lqr(fflin.linearize(robot).discretize(0.25)))
    assert "poles at zero" not in plain
