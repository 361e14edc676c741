"""Laws that the rules of the loop obey, uncompiled: impulses, wheels, faults, allocation, ends."""

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest

from fflin.control.channel import Saturation, channel_of
from fflin.kernel import allocation
from fflin.kernel import loop as rules
from fflin.kernel import vectors as vec
from fflin.kernel.allocation import LEAST, least_squares, nearest, solve
from fflin.kernel.forward import ActuatorFaults, apply_faults
from fflin.kernel.loop import Pulses, StopConditions, Wheels, goes_on

DT, SAMPLE = 0.1, 4


def acting(limits, commands, delay=0, nu=None, initial=None, channels=None):
    """The inputs (steps, nu) that act in each step; `nu` is what the rates make of them.

    The channel is appended to `channels`.
    """
    size = commands.shape[1]
    channel = channel_of(
        limits, np.zeros(size) if initial is None else initial, SAMPLE, [delay]
    )
    rows = []
    for step in range(SAMPLE * len(commands)):
        u = commands[step // SAMPLE].copy()
        rules.transmit(channel, step, np.zeros(size) if nu is None else nu(rows), u)
        rows.append(u)
    if channels is not None:
        channels.append(channel)
    return np.array(rows)


def pulsed(on_off, most, least):
    """Return the saturation of a pulsed thruster, whose commands have no other limit."""
    one = np.ones(1)
    pulses = Pulses(
        at=np.array([0]),
        on_off=np.array([on_off]),
        most=most * one,
        least=least * one,
        left=0.0 * one,
        level=0.0 * one,
        end=0.0 * one,
        time=SAMPLE * DT,
    )
    return Saturation(0.0 * one, np.inf * one)._replace(pulses=pulses)


@pytest.mark.parametrize("delay", [0, 1, 4, 7])
def test_the_impulse_of_a_held_sample_matches_its_clipped_command(delay):
    rng = np.random.default_rng(delay)
    low, high, initial = (
        np.array([-1.0, -0.5]),
        np.array([0.4, 2.0]),
        np.array([0.1, -0.9]),
    )
    commands = rng.uniform(-3.0, 3.0, size=(6, 2))
    u = acting(Saturation(low, high), commands, delay, initial=initial)
    assert u[:delay] == pytest.approx(np.tile([0.1, -0.5], (delay, 1)), abs=0.0)
    for k in range(5 - delay // SAMPLE):
        held = u[delay + k * SAMPLE : delay + (k + 1) * SAMPLE]
        impulse = SAMPLE * DT * np.clip(commands[k], low, high)
        assert DT * held.sum(axis=0) == pytest.approx(impulse, rel=1e-14)


@pytest.mark.parametrize("on_off", [False, True])
def test_pulses_fire_the_impulse_of_the_commands_minus_the_remainder(on_off):
    rng = np.random.default_rng(3)
    most, least = 2.0, 0.15
    commands = rng.uniform(0.0, 1.0, size=(40, 1))
    u = acting(pulsed(on_off, most, least), commands, channels=(channels := []))[:, 0]
    wanted = SAMPLE * DT * commands[:, 0].cumsum()
    fired = DT * u.cumsum()[SAMPLE - 1 :: SAMPLE]
    # Nothing is lost or made: what is not fired yet is left, at most a pulse of it.
    assert channels[0].pulses.left[0] == pytest.approx(
        wanted[-1] - fired[-1], abs=1e-12
    )
    # Only impulses below the least impulse wait for the next sample.
    assert np.abs(wanted - fired).max() <= least + 1e-12
    of_samples = DT * u.reshape(-1, SAMPLE).sum(axis=1)
    assert ((of_samples == 0.0) | (of_samples >= least - 1e-12)).all() and (
        of_samples > 0.0
    ).any()
    if on_off:
        # A pulse has the full thrust, except in the step in which it ends.
        pulses = u.reshape(-1, SAMPLE)
        ends = (pulses > 0.0) & (pulses < most)
        assert ends.any() and (ends.sum(axis=1) <= 1).all()
        assert (np.diff(pulses, axis=1) <= 0.0).all() and u.max() == most


@pytest.mark.parametrize("on_off", [False, True])
def test_the_command_above_the_largest_thrust_is_not_fired_later(on_off):
    u = acting(pulsed(on_off, 2.0, 0.0), np.array([[5.0], [0.0]]))
    assert u == pytest.approx(
        2.0 * np.repeat([[1.0], [0.0]], SAMPLE, axis=0), abs=1e-15
    )


@pytest.mark.parametrize(
    ("factor", "fires"), [(1.0 - 1e-10, True), (1.0 - 1e-8, False)]
)
def test_a_thruster_fires_its_least_impulse_despite_a_rounding_error(factor, fires):
    command = np.array([[factor * 0.15 / (SAMPLE * DT)]])
    assert (acting(pulsed(False, 2.0, 0.15), command) > 0.0).all() == fires


def test_pulses_begin_only_in_lanes_in_which_a_command_arrives():
    channel = channel_of(pulsed(False, 2.0, 0.0), np.zeros(1), SAMPLE, [0])
    values = (channel.pulses.left, channel.pulses.level, channel.pulses.end)
    for fresh in (0.0, 1.0):
        for value in values:
            value[:] = 0.3
        channel.fresh[:] = fresh
        rules._begin_pulses(channel, SAMPLE, np.ones(1))
        expected = (
            (0.0, 0.3 / (SAMPLE * DT) + 1.0, 2.0 * SAMPLE) if fresh else (0.3,) * 3
        )
        assert np.ravel(values) == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize("asked", [-0.3, 0.3])
def test_a_wheel_spins_up_by_its_torque_to_its_largest_speed_and_no_further(asked):
    inertia, speeds, torques = 0.04, (-3.0, 4.0), (-0.25, 0.2)
    wheels = Wheels(
        at=np.array([0]),
        row=np.array([0]),
        least_torque=np.array([torques[0]]),
        most_torque=np.array([torques[1]]),
        least_speed=np.array([speeds[0]]),
        most_speed=np.array([speeds[1]]),
        stiffness=np.array([inertia / DT]),
    )
    limits = Saturation(np.full(1, -np.inf), np.full(1, np.inf))._replace(wheels=wheels)
    commands = np.full((4, 1), asked)
    commands[-1] *= -1.0  # which brakes

    def speed(rows):
        return np.array([DT / inertia * sum(u[0] for u in rows)])

    u = acting(limits, commands, nu=speed)
    w = DT / inertia * u.cumsum()
    edge = speeds[asked > 0.0]
    assert u[0] == torques[asked > 0.0] and w[2] == pytest.approx(
        u[0, 0] * 3 * DT / inertia
    )
    assert w[3 * SAMPLE - 1] == pytest.approx(edge, rel=1e-12)
    assert (np.abs(w) <= abs(edge) * (1.0 + 1e-12)).all()
    assert u[3 * SAMPLE - 1] == pytest.approx(0.0, abs=1e-12)
    # away from its limit a wheel has all its torque
    assert u[3 * SAMPLE] == torques[asked < 0.0]


def test_a_wheel_beyond_its_speed_is_only_slowed_down():
    speeds, one = np.array([5.0]), np.ones(1)
    wheels = Wheels(np.array([0]), np.array([0]), -one, one, -one, one, one)
    limits = Saturation(np.full(1, -np.inf), np.full(1, np.inf))._replace(wheels=wheels)
    for command, given in ((0.5, 0.0), (-0.5, -0.5), (-3.0, -1.0)):
        commands = np.array([[command]])
        assert acting(limits, commands, nu=lambda _: speeds)[0] == given


def test_a_faulty_input_has_a_gain_a_bias_and_turned_axes_until_it_fails():
    rng = np.random.default_rng(5)
    u, gain, bias = rng.normal(size=(3, 7))
    turns = [pin.exp3(rng.normal(size=3)) for _ in range(2)]
    until, given = np.full(7, 9.0), np.empty(7)
    until[1] = 2.025  # within the step from 2.0
    faults = ActuatorFaults(
        gain, bias, until, np.concatenate([R.ravel("F") for R in turns])
    )
    fractions = {1.9: 1.0, 2.0: 0.25, 2.1: 0.0}
    for t, fraction in fractions.items():
        expected = gain * u + bias
        expected[1] *= fraction
        for R, at in zip(turns, (slice(1, 4), slice(4, 7)), strict=True):
            expected[at] = R @ expected[at]
        apply_faults(faults, [1, 4], t, 0.1, u, given)
        assert given == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("seed", range(12))
def test_an_allocation_meets_the_conditions_of_karush_kuhn_and_tucker(seed):
    """Minimise ``|A u - b|^2 / |b|^2 + LEAST^2 |u|^2 / scale^2`` within the bounds."""
    rng = np.random.default_rng(seed)
    size, count = 6, 9
    A, b = rng.normal(size=(size, count)), 10.0 ** (seed % 3) * rng.normal(size=size)
    least, most = -rng.uniform(0.0, 0.4, size=count), rng.uniform(0.05, 0.4, size=count)
    least[::3] = 0.0  # of thrusters, which cannot pull
    # an input that cannot be zero, and a constant one
    least[1], least[4] = 0.02, most[4]
    problem = least_squares(least, most, size)._replace(
        columns=np.append(A.T.ravel(), b)
    )
    solve(problem, size, 0)
    u, unit, force = np.array(problem.x), np.linalg.norm(A), np.linalg.norm(b)
    assert (u >= least).all() and (u <= most).all()
    # The gradient, in the scale of the solver, with columns and force divided by their norms.
    slope = (A / unit).T @ (A @ u - b) / force + LEAST**2 * u * unit / force
    # Rounding of 1e-16 moves an input by 1e-16 / LEAST.
    near = 1e-16 / LEAST
    low, high = u <= least + near, u >= most - near
    free, constant = ~(low | high), low & high
    assert u[constant] == pytest.approx(most[4:5], rel=1e-15)
    assert np.abs(slope[free]).max(initial=0.0) < 1e-12
    assert (slope[low & ~high] > -1e-12).all() and (slope[high & ~low] < 1e-12).all()
    assert (low | high).any()


@pytest.mark.parametrize("seed", range(8))
def test_an_allocation_that_can_realise_the_force_is_the_smallest(seed):
    """Minimise ``|u|^2`` with ``A u = b``: where no bound acts, u is ``A^T l`` for one l."""
    rng = np.random.default_rng(seed)
    size, count = 6, 12
    A = rng.normal(size=(size, count))
    least, most = -rng.uniform(0.2, 1.0, size=count), rng.uniform(0.2, 1.0, size=count)
    least[::2] = 0.0
    b = A @ rng.uniform(least, most)
    problem = least_squares(least, most, size)._replace(
        columns=np.append(A.T.ravel(), b)
    )
    solve(problem, size, 0)
    u = np.array(problem.x)
    free = (u > least + 1e-9) & (u < most - 1e-9)
    assert size <= free.sum() < count
    multiplier = np.linalg.lstsq(A[:, free].T, u[free], rcond=None)[0]
    assert u == pytest.approx(np.clip(A.T @ multiplier, least, most), abs=1e-12)
    assert A @ u == pytest.approx(b, abs=1e-10)


@pytest.mark.parametrize("seed", range(6))
def test_an_allocation_never_leaves_its_bounds_and_its_cost_never_grows(
    seed, monkeypatch
):
    """The cost ``|A x - b|^2 + LEAST^2 |x|^2`` and the bounds, at each step of the solver."""
    rng = np.random.default_rng(seed)
    size, count, seen, fit = 6, 12, [], allocation._fit

    def watched(problem, *rest):
        x, wanted = np.array(problem.x), problem.wanted.copy()
        assert (np.array(problem.low) - 1e-15 <= x).all()
        assert (x <= np.array(problem.high) + 1e-15).all()
        force = x @ problem.A[:-size].reshape(count, size)
        seen.append((wanted, np.sum((force - wanted) ** 2) + LEAST**2 * x @ x))
        fit(problem, *rest)

    monkeypatch.setattr(allocation, "_fit", watched)
    for _ in range(20):
        columns, b = rng.normal(size=(count, size)), rng.normal(size=size)
        most, pulls = rng.uniform(0.01, 0.4, size=count), rng.integers(0, 2, size=count)
        seen.clear()
        nearest(columns.T, b, -most * pulls, most)
        pairs = [
            (before, after)
            for (wanted, before), (other, after) in pairwise(seen)
            if (wanted == other).all()
        ]
        assert len(pairs) > 2 and all(after < before + 1e-15 for before, after in pairs)


@pytest.mark.parametrize("seed", range(6))
def test_inputs_with_equal_forces_get_equal_fractions_of_a_force_that_is_too_large(
    seed,
):
    rng = np.random.default_rng(seed)
    A, b = rng.normal(size=(6, 8)), rng.normal(size=6)
    least, most = np.zeros(8), rng.uniform(0.02, 0.2, size=8)
    u = nearest(np.hstack((A, A)), b, np.tile(least, 2), np.tile(most, 2))
    once = nearest(A, b, 2.0 * least, 2.0 * most)
    assert np.linalg.norm(A @ once - b) > 0.01
    assert ((once > 0.0) & (once < 2.0 * most)).any()
    assert u == pytest.approx(np.tile(0.5 * once, 2), abs=1e-9)


def test_an_allocation_of_no_force_has_no_force_and_an_allocation_of_nan_is_nan():
    rng = np.random.default_rng(2)
    A, most = rng.normal(size=(6, 9)), np.full(9, 0.5)
    assert (nearest(A, np.zeros(6), -most, most) == 0.0).all()
    # the first input cannot be zero, and the others balance it
    least = np.append(0.1, -most[1:])
    u = nearest(A, np.zeros(6), least, most)
    assert u[0] == pytest.approx(0.1, rel=1e-12) and A @ u == pytest.approx(
        np.zeros(6), abs=1e-12
    )
    assert np.isnan(nearest(A, np.append(np.zeros(5), np.nan), least, most)).all()
    # Inputs without effect are as near to zero as their bounds allow.
    assert (
        nearest(np.zeros((6, 9)), np.ones(6), least, most) == np.maximum(least, 0.0)
    ).all()
    assert (nearest(np.zeros((6, 9)), np.zeros(6), -most, most) == 0.0).all()


def test_an_allocation_to_inputs_at_their_bounds_ends_after_few_steps(monkeypatch):
    """Rounding errors return an input to its bound, and the solver must not release it again."""
    rng, fit, calls = np.random.default_rng(1), allocation._fit, []
    monkeypatch.setattr(
        allocation, "_fit", lambda *given: (calls.append(1), fit(*given))
    )
    for _ in range(4000):
        count = int(rng.integers(1, 7))
        A = np.rint(1.5 * rng.normal(size=(6, count)))
        least, most = -1.0 * rng.integers(0, 2, size=count), np.ones(count)
        u = 1.0 * rng.integers(0, 2, size=count)
        calls.clear()
        nearest(A, A @ u, least, most)
        assert len(calls) <= 6 * count


def test_loops_that_are_compiled_agree_with_the_functions_of_numpy_that_they_replace():
    rng = np.random.default_rng(0)
    Q = np.linalg.qr(rng.normal(size=(5, 3)))[0].T.ravel()
    a, b, x, empty = (
        rng.normal(size=12),
        rng.normal(size=12),
        rng.normal(size=5),
        np.zeros(6),
    )
    given = {
        allocation.row_product: (a, 2, b, 3, 5),
        allocation.add_row: (a, 2, 0.7, b, 3, 5),
        allocation.row_products: (a, 4, b, empty[:3]),
        allocation.remove_components: (Q, 5, 3, x, empty, 1),
        allocation.write_scaled: (a, 0, 0.7, x),
    }
    for function, arguments in given.items():
        ends = []
        for item in (function, vec.IN_PLACE[function]):
            copies = [
                np.array(value) if np.ndim(value) else value for value in arguments
            ]
            result = item(*copies)
            ends.append(np.hstack([*copies, 0.0 if result is None else result]))
        assert ends[0] == pytest.approx(ends[1], abs=1e-14)
        assert (ends[0] != np.hstack([*arguments, 0.0])).any()


def test_a_run_goes_on_within_its_speeds_and_its_chart():
    turn = pin.Quaternion(pin.exp3(np.array([0.0, 0.0, 2.0]))).coeffs()
    origin, bounds = np.append(np.zeros(3), turn), np.array([2.0, 3.0])

    def at(angle, *rates, sign=1.0):
        q = np.append(np.zeros(3), (0.0, 0.0, np.sin(angle / 2.0), np.cos(angle / 2.0)))
        return bool(
            goes_on(StopConditions(bounds**2, [sign]), origin, q, np.array(rates))
        )

    for rates, expected in (
        ((1.9, -2.9), True),
        ((2.1, 0.0), False),
        ((-2.1, 0.0), False),
        ((0.0, -3.1), False),
        ((np.nan, 0.0), False),
        ((0.0, np.inf), False),
    ):
        assert at(0.0, *rates) is expected
    # The chart ends where the rotations of origin and base together are 180 deg.
    edge = np.pi - 2.0
    for angle, expected in ((edge - 1e-6, True), (edge + 1e-6, False)):
        assert at(angle, 0.0, 0.0) is expected
        assert at(angle, 0.0, 0.0, sign=-1.0) is not expected
        assert at(angle, 0.0, 0.0, sign=0.0) is True
