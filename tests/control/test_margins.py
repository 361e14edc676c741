"""What the loop of each input bears: closed forms, and the limits at which it gets unstable."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import fflin
from fflin.control.gain import asymmetry, guaranteed_margin
from fflin.control.lqr import regulator
from fflin.control.optimal.disk import (
    best_scaling,
    largest_scaled_gain,
    worst_perturbation,
)
from fflin.control.optimal.largest_gain import ACCURACY, _largest_among, largest_gain
from fflin.control.plots import input_loops
from tests.support.marks import exhaustive
from tests.support.weights import unit_weights


def test_a_mass_with_position_and_rate_feedback_has_the_margin_of_the_textbook():
    lin = fflin.linearize(fflin.load("cubesat"))
    gain = fflin.acceleration_lqr(lin, 2.0, 3.0, 1.0)
    w, response, loops = input_loops(gain)
    row, mass = 3, 3.5
    k, c = gain.K[row, 3] / mass, gain.K[row, 9] / mass
    # L = (k + c s)/s^2 is one where w^4 = k^2 + c^2 w^2.
    crossing = math.sqrt((c**2 + math.sqrt(c**4 + 4.0 * k**2)) / 2.0)
    assert loops[row].phase == pytest.approx(
        math.degrees(math.atan2(c * crossing, k)), rel=1e-9
    )
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
                assert (
                    growth(gain, i, limit * beyond)
                    > 0.0
                    > growth(gain, i, limit / beyond)
                )
                held += 1
        # A phase turns the loops of both signs of the frequency, one of which gets unstable.
        for sign in (1.0, -1.0):
            if loop.phase == math.inf:
                for angle in np.radians([45.0, 90.0, 135.0, 180.0]):
                    assert growth(gain, i, np.exp(1j * sign * angle)) < 0.0
                continue
            inside, outside = (
                np.exp(1j * sign * math.radians(share * loop.phase))
                for share in (0.999, 1.001)
            )
            assert growth(gain, i, inside) < 0.0 < growth(gain, i, outside)
    assert held


def test_unregulated_states_do_not_affect_the_margins():
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
            closed = np.linalg.inv(
                1j * grid[k] * np.eye(len(fed)) - A + B[:, others] @ K[others]
            )
            assert values[k, i] == pytest.approx((K[i] @ closed @ B[:, i]), rel=1e-6)
    assert all(loop.phase > 59.9 for loop in loops)


def loop_of(gain):
    """The regulated states' A, B and K, with inputs scaled by sqrt(R_ii)."""
    fed = [gain.state_names.index(name) for name in gain.regulated]
    scale = np.sqrt(gain.R.diagonal())
    return (
        gain.A[np.ix_(fed, fed)],
        gain.B[fed] / scale,
        scale[:, None] * gain.K[:, fed],
    )


def balance(gain, frequencies):
    """Return half of S - T at the scaled inputs, from the open loop K (s - A)^-1 B."""
    A, B, K = loop_of(gain)
    s = 1j * np.asarray(frequencies)
    s = (np.exp(s * gain.dt) if gain.dt else s)[..., None, None]
    L = K @ np.linalg.solve(s * np.eye(len(A)) - A, B)
    unit = np.eye(len(K))
    return 0.5 * (unit - L) @ np.linalg.inv(unit + L)


def swept(gain):
    """Return the largest gain of half of S - T, and its frequency, from a sweep of frequencies."""
    most = np.pi / gain.dt if gain.dt else 1e3
    grid = np.geomspace(1e-6 * most, most, 600)
    sizes = np.linalg.norm(balance(gain, grid), 2, axis=(1, 2))
    result = [(sizes[0], grid[0]), (sizes[-1], grid[-1])]
    inner = 1 + np.flatnonzero((sizes[1:-1] >= sizes[:-2]) & (sizes[1:-1] >= sizes[2:]))
    for at in sorted(inner, key=lambda at: -sizes[at])[:3]:
        peak = minimize_scalar(
            lambda w: -np.linalg.norm(balance(gain, w), 2),
            bounds=grid[[at - 1, at + 1]],
            method="bounded",
        )
        result.append((-peak.fun, peak.x))
    return max(result)


def beyond(gain, factors):
    """How far the poles are beyond the limit with factors (nu, nu) at the scaled inputs."""
    A, B, K = loop_of(gain)
    poles = np.linalg.eigvals(A - B @ factors @ K)
    return np.abs(poles).max() - 1.0 if gain.dt else poles.real.max()


def factors_of(delta):
    """Return the factors (1 - delta/2)^-1 (1 + delta/2) of a point of the disk."""
    unit = np.eye(len(delta))
    return np.linalg.solve(unit - 0.5 * delta, unit + 0.5 * delta)


def flexible():
    """A loop with weakly damped vibrations."""
    return fflin.linearize(fflin.load("servicer_7dof", stiffness={"panel_*": 100.0}))


DISKS = {
    "continuous": lambda: fflin.linearize(fflin.load("canadarm2")),
    "upright": hovering,
    "flexible": flexible,
    "sampled": lambda: fflin.linearize(fflin.load("canadarm2")).discretize(0.5),
    "sampled upright": lambda: hovering().discretize(0.02),
    "sampled flexible": lambda: flexible().discretize(0.1),
}


@pytest.mark.parametrize("case", DISKS)
@pytest.mark.exhaustive
def test_the_fixed_scaling_bears_full_perturbations_exactly_up_to_its_bound(case):
    lin = DISKS[case]()
    rng = np.random.default_rng(0)
    for weights in ((), unit_weights(lin)):
        gain = fflin.lqr(lin, *weights)
        disk = 1.0 / largest_gain(*asymmetry(gain))[0]
        size, frequency = swept(gain)
        # The largest gain of the code is accurate to ACCURACY, and the refined sweep is better.
        assert abs(disk * size - 1.0) < 2.0 * ACCURACY
        # For the factors F of delta, I + F L is singular where I - delta (S - T)/2 is singular.
        # The smallest such delta has rank one.
        u, _, v = np.linalg.svd(balance(gain, frequency))
        worst = np.outer(v[0].conj(), u[:, 0].conj())
        assert beyond(gain, factors_of(1.001 * disk * worst)) > 0.0
        assert beyond(gain, factors_of(0.999 * disk * worst)) < 0.0
        # No other point of the disk makes the loop unstable.
        for _ in range(30):
            delta = rng.normal(size=(2, len(u), len(u)))
            delta = delta[0] + 1j * delta[1]
            delta *= 0.999 * disk / np.linalg.norm(delta, 2)
            assert beyond(gain, factors_of(delta)) < 0.0
        assert gain.margins.disk > disk * (1.0 - 2.0 * ACCURACY)


@pytest.mark.parametrize("case", DISKS)
@pytest.mark.exhaustive
def test_the_disk_margin_has_the_best_scaling_of_every_frequency(case):
    lin = DISKS[case]()
    rng = np.random.default_rng(1)
    for weights in ((), unit_weights(lin)):
        gain = fflin.lqr(lin, *weights)
        disk, (low, high), phase = gain.margins
        count = len(gain.K)
        # No frequency needs a smaller disk, and one needs nearly this disk.
        most = np.pi / gain.dt if gain.dt else 1e3
        grid = np.geomspace(1e-4 * most, most, 60)
        bounds = [best_scaling(M)[0] for M in balance(gain, grid)]
        assert max(bounds) <= (1.0 + 1e-6) / disk
        value, frequency, _ = largest_scaled_gain(asymmetry(gain))
        assert min(1.0 / value, 2.0) == disk
        if gain.dt:
            frequency = 2.0 * math.atan(frequency) / gain.dt
        # The open loop may be infinite at 0. The response is even in the frequency, so its error
        # there is of the order 1e-8.
        frequency = min(max(frequency, 1e-4), 1e9)
        response = balance(gain, frequency)
        scaling = best_scaling(response)
        assert scaling[0] == pytest.approx(1.0 / disk, rel=1e-6)
        # A perturbation of the channels that is at most a fifth larger makes the loop unstable.
        reached, change = worst_perturbation(response, scaling[1], scaling[0])
        assert reached > 1.0 / (1.2 * disk)
        assert beyond(gain, factors_of(1.001 * np.diag(change))) > 0.0
        assert beyond(gain, factors_of(0.999 * disk * reached * np.diag(change))) < 0.0
        # No change of the channels within the disk makes the loop unstable.
        for _ in range(30):
            delta = np.exp(2j * np.pi * rng.uniform(size=count)) * 0.999 * disk
            assert beyond(gain, factors_of(np.diag(delta))) < 0.0
            gains = np.exp(rng.uniform(np.log(low), np.log(high), count))
            turns = np.radians(rng.choice([-0.999, 0.999], count) * phase)
            assert beyond(gain, np.diag(gains)) < 0.0
            assert beyond(gain, np.diag(np.exp(1j * turns))) < 0.0
        # The limits of gain and phase are on the edge of the disk.
        for factor in (low, high, np.exp(1j * math.radians(phase))):
            assert abs(2.0 * (factor - 1.0) / (factor + 1.0)) == pytest.approx(
                disk, rel=1e-12
            )
        assert fflin.margins(gain, lin).disk == pytest.approx(disk, rel=1e-5)


def test_the_disk_margin_does_not_depend_on_the_units_of_the_inputs():
    lin = fflin.linearize(fflin.load("canadarm2"))
    gain = fflin.acceleration_lqr(lin, 1.0, 1.0, 1.0)
    fixed = 1.0 / largest_gain(*asymmetry(gain))[0]
    # Here the fixed scaling states a third of the margin.
    assert gain.margins.disk > 3.0 * fixed
    scale = np.geomspace(0.01, 100.0, len(gain.K))
    other = replace(gain, B=gain.B * scale, K=gain.K / scale[:, None])
    assert other.margins.disk == pytest.approx(gain.margins.disk, rel=1e-5)


@pytest.mark.parametrize("name", ["cubesat", "ets_vii", "planar_detumble"])
@pytest.mark.parametrize("dt", [0.0, *exhaustive(0.01, 0.1, 1.0)])
@pytest.mark.exhaustive
def test_the_margin_that_the_weights_guarantee_is_a_lower_bound(name, dt):
    lin = fflin.linearize(fflin.load(name))
    model = lin.discretize(dt) if dt else lin
    nx, nu = lin.B.shape
    rng = np.random.default_rng(8)
    full = np.eye(nu) + 0.1
    cross = 0.05 * rng.normal(size=(nx, nu))
    costs = [
        (np.eye(nx), np.eye(nu), None),
        (np.eye(nx), np.diag(10.0 ** rng.uniform(-2.0, 2.0, nu)), None),
        (np.eye(nx), full, None),
        (np.eye(nx), full, cross),
    ]
    if dt:
        costs.append(tuple(fflin.sampled_cost(lin, dt, np.eye(nx), full)))
    for cost in costs:
        gain = regulator(model, *cost)
        assert 0.0 < guaranteed_margin(gain) <= gain.margins.disk * (1.0 + ACCURACY)
    # Of a mass without cross weights, the continuous guarantee is Kalman's.
    if not dt:
        assert guaranteed_margin(regulator(lin, *costs[0])) == pytest.approx(2.0 / 3.0)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_margins_are_computed_only_for_a_warning():
    lin = fflin.linearize(fflin.load("canadarm2"))
    nx, nu = lin.B.shape
    sturdy = [
        fflin.lqr(lin, np.eye(nx), np.eye(nu)),
        fflin.lqr(lin, np.eye(nx), np.eye(nu) + 0.1),
        fflin.lqr(lin.discretize(0.1)),
    ]
    fragile = [
        fflin.acceleration_lqr(lin, 1.0, 1.0, 1.0),
        fflin.lqr(lin.discretize(0.5), np.eye(nx), 1e-9 * np.eye(nu)),
    ]
    assert not any("margins" in vars(gain) for gain in sturdy)
    assert all("margins" in vars(gain) for gain in fragile)
    assert all(gain.margins.disk < 0.3 for gain in fragile)
    assert all(gain.margins.disk >= 0.3 for gain in sturdy)


def test_the_largest_gain_of_many_poles_is_found_from_few_of_them():
    """60 resonances in parallel, one of them a little larger than the others."""
    frequencies = np.geomspace(0.1, 100.0, 60)
    damping = np.full(60, 0.01)
    damping[37] = 0.008
    A, B, C = np.zeros((120, 120)), np.zeros((120, 60)), np.zeros((60, 120))
    for i, (omega, zeta) in enumerate(zip(frequencies, damping, strict=True)):
        A[2 * i, 2 * i + 1] = 1.0
        A[2 * i + 1, 2 * i : 2 * i + 2] = -(omega**2), -2.0 * zeta * omega
        B[2 * i + 1, i] = omega**2
        C[i, 2 * i] = 1.0
    largest, frequency = largest_gain(A, B, C, np.zeros((60, 60)))
    # The gain of a resonance is 1 / (2 zeta sqrt(1 - zeta^2)).
    assert largest == pytest.approx(
        1.0 / (0.016 * math.sqrt(1.0 - 0.008**2)), rel=ACCURACY
    )
    assert frequency == pytest.approx(frequencies[37], rel=1e-3)


@pytest.mark.parametrize("count, tried", [(60, 60), (200, 22), (2000, 28)])
def test_a_smooth_gain_is_tried_at_few_of_many_frequencies(count, tried):
    """A start that needs one evaluation a pole costs n^4."""
    frequencies = np.geomspace(0.01, 100.0, count).tolist()
    calls = []

    def gain(frequency):
        calls.append(frequency)
        return 1.0 / (1.0 + math.log(frequency / 3.0) ** 2), frequency

    largest, _ = _largest_among(gain, frequencies)
    assert len(calls) == len(set(calls)) <= tried
    assert largest == max(map(gain, frequencies))[0]
