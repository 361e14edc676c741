"""What the loop of each input bears: closed forms, and the limits at which it gets unstable."""

import math

import numpy as np
import pytest

import fflin
from fflin.control.plots import input_loops
from tests.support.weights import unit_weights


def test_a_mass_with_position_and_rate_feedback_has_the_margin_of_the_textbook():
    lin = fflin.linearize(fflin.load("cubesat"))
    gain = fflin.acceleration_lqr(lin, 2.0, 3.0, 1.0)
    w, response, loops = input_loops(gain)
    row, mass = 3, 3.5
    k, c = gain.K[row, 3] / mass, gain.K[row, 9] / mass
    # L = (k + c s)/s^2 is one where w^4 = k^2 + c^2 w^2.
    crossing = math.sqrt((c**2 + math.sqrt(c**4 + 4.0 * k**2)) / 2.0)
    assert loops[row].phase == pytest.approx(math.degrees(math.atan2(c * crossing, k)), rel=1e-9)
    assert loops[row].gain == (0.0, math.inf)
    expected = (k + 1j * c * w) / (1j * w) ** 2
    np.testing.assert_allclose(response[:, row], expected, rtol=1e-6)


@pytest.mark.parametrize("name", ["canadarm2", "dual_arm", "servicer_7dof"])
def test_an_optimal_loop_has_the_guaranteed_margins(name):
    lin = fflin.linearize(fflin.load(name))
    gain = fflin.lqr(lin, *unit_weights(lin))
    *_, loops = input_loops(gain)
    low, high = gain.margins.gain
    for loop in loops:
        assert loop.phase >= max(60.0, gain.margins.phase) - 1e-6
        assert loop.gain[0] <= min(0.5, low) + 1e-6 and loop.gain[1] == math.inf > high


def growth(gain, i, factor):
    """How far the poles are beyond the limit, where input i has a factor: below zero stable."""
    inputs = np.ones(len(gain.K), complex)
    inputs[i] = factor
    poles = np.linalg.eigvals(gain.A - gain.B @ (inputs[:, None] * gain.K))
    return np.abs(poles).max() - 1.0 if gain.dt else poles.real.max()


def hovering():
    """A loop that needs its gain: the arm stands upright in gravity."""
    robot = fflin.load("servicer_7dof", gravity=(0.0, 0.0, -9.81))
    return fflin.linearize(robot, u=fflin.equilibrium(robot).u)


@pytest.mark.parametrize(
    "lin",
    [
        lambda: fflin.linearize(fflin.load("canadarm2")).discretize(0.5),
        lambda: fflin.linearize(fflin.load("planar_detumble")).discretize(1.0),
        hovering,
        lambda: hovering().discretize(0.02),
    ],
)
def test_a_loop_is_unstable_just_beyond_its_margins_and_no_sooner(lin):
    lin = lin()
    gain = fflin.lqr(lin, *unit_weights(lin))
    *_, loops = input_loops(gain)
    held = 0
    for i, loop in enumerate(loops):
        low, high = loop.gain
        for limit, beyond in ((high, 1.001), (low, 1.0 / 1.001)):
            if 0.0 < limit < math.inf:
                assert growth(gain, i, limit * beyond) > 0.0 > growth(gain, i, limit / beyond)
                held += 1
        # A phase turns the loops of both signs of the frequency, one of which gets unstable.
        for sign in (1.0, -1.0):
            if loop.phase == math.inf:
                for angle in np.radians([45.0, 90.0, 135.0, 180.0]):
                    assert growth(gain, i, np.exp(1j * sign * angle)) < 0.0
                continue
            inside, outside = (
                np.exp(1j * sign * math.radians(share * loop.phase)) for share in (0.999, 1.001)
            )
            assert growth(gain, i, inside) < 0.0 < growth(gain, i, outside)
    assert held


def test_what_is_not_regulated_has_no_part_in_the_loops():
    robot = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin)
    assert len(gain.regulated) < len(gain.state_names)
    fed = [lin.state_names.index(name) for name in gain.regulated]
    grid, values, loops = input_loops(gain)
    A, B, K = lin.A[np.ix_(fed, fed)], lin.B[fed], gain.K[:, fed]
    for k in (0, 100, len(grid) - 1):
        for i in (0, 13):
            others = [j for j in range(len(K)) if j != i]
            closed = np.linalg.inv(1j * grid[k] * np.eye(len(fed)) - A + B[:, others] @ K[others])
            assert values[k, i] == pytest.approx((K[i] @ closed @ B[:, i]), rel=1e-6)
    assert all(loop.phase > 59.9 for loop in loops)
