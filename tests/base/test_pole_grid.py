"""Curves of constant damping ratio and natural frequency."""

import numpy as np
import pytest

from fflin.base.pole_grid import (
    Label,
    damped_poles,
    equally_fast_poles,
    nyquist_frequency,
    oscillates,
    spaced,
)


@pytest.mark.parametrize("dt", [0.0, 0.3])
@pytest.mark.parametrize("ratio", [0.2, 0.6, 0.8])
def test_poles_of_a_damped_oscillator_lie_on_the_curve_of_its_ratio(ratio, dt):
    w = np.array([0.1, 1.0, 5.0])
    poles = damped_poles(ratio, w, dt)
    for frequency, pole in zip(w, poles, strict=True):
        # x'' + 2 ratio w x' + w^2 x = 0
        roots = np.roots([1.0, 2.0 * ratio * frequency, frequency**2])
        expected = roots[np.argmax(roots.imag)]
        if dt:
            expected = np.exp(expected * dt)
        # Rounding of np.roots is a few eps of the largest coefficient.
        assert abs(pole - expected) < 1e-13 * max(1.0, frequency**2)


@pytest.mark.parametrize("dt", [0.0, 0.3])
def test_a_curve_of_natural_frequency_ends_undamped_and_critically_damped(dt):
    poles = equally_fast_poles(2.0, dt)
    rates = np.log(poles) / dt if dt else poles
    np.testing.assert_allclose(np.abs(rates), 2.0, rtol=1e-14)
    assert rates[0].imag == pytest.approx(2.0, rel=1e-14)
    assert rates[-1].real == pytest.approx(-2.0, rel=1e-14)
    if dt:
        assert abs(poles[0]) == pytest.approx(1.0, abs=1e-8)


def test_a_spiral_ends_on_the_negative_real_axis():
    ratio, dt = 0.4, 0.2
    end = nyquist_frequency(ratio, dt)
    (pole,) = damped_poles(ratio, np.array([end]), dt)
    # |z| = exp(-w ratio dt), with w dt = pi / sqrt(1 - ratio^2)
    assert pole.real == pytest.approx(-np.exp(-np.pi * ratio / np.sqrt(0.84)))
    assert abs(pole.imag) < 1e-15


def test_rounding_errors_of_real_poles_do_not_oscillate():
    assert oscillates(np.array([-1.0 + 1e-3j, -1.0 - 1e-3j]))
    assert not oscillates(np.array([-5.0 + 1e-12j, -5.0 - 1e-12j, 0.0]))
    assert not oscillates(np.zeros(0, complex))


def test_labels_that_would_overlap_are_left_out():
    labels = [Label(0.0, 0.0, "a"), Label(0.05, 0.0, "b"), Label(0.05, 0.2, "c")]
    kept = spaced(labels, 0.1, 0.1)
    assert [label.text for label in kept] == ["a", "c"]
