"""Laws that the rules of the loop obey, uncompiled: impulses, wheels, faults, allocation, ends."""

import numpy as np
import pinocchio as pin
import pytest

from fflin.control.channel import Saturation, channel_of
from fflin.kernel import loop as rules
from fflin.kernel.allocation import LEAST, least_squares, solve
from fflin.kernel.forward import ActuatorFaults, apply_faults
from fflin.kernel.loop import Pulses, StopConditions, Wheels, goes_on

DT, SAMPLE = 0.1, 4


def acting(limits, commands, delay=0, nu=None, initial=None, channels=None):
    """The inputs (steps, nu) that act in each step; `nu` is what the rates make of them.

    The channel is appended to `channels`.
    """
    size = commands.shape[1]
    channel = channel_of(limits, np.zeros(size) if initial is None else initial, SAMPLE, delay)
    rows = []
    for step in range(SAMPLE * len(commands)):
        u = commands[step // SAMPLE].copy()
        rules.transmit(channel, step, np.zeros(size) if nu is None else nu(rows), u)
        rows.append(u)
    if channels is not None:
        channels.append(channel)
    return np.array(rows)


@pytest.mark.parametrize("delay", [0, 1, 4, 7])
def test_the_impulse_of_a_held_sample_is_that_of_its_clipped_command(delay):
    rng = np.random.default_rng(delay)
    low, high, initial = np.array([-1.0, -0.5]), np.array([0.4, 2.0]), np.array([0.1, -0.2])
    commands = rng.uniform(-3.0, 3.0, size=(6, 2))
    u = acting(Saturation(low, high), commands, delay, initial=initial)
    assert u[:delay] == pytest.approx(np.tile(initial, (delay, 1)), abs=0.0)
    for k in range(5 - delay // SAMPLE):
        held = u[delay + k * SAMPLE : delay + (k + 1) * SAMPLE]
        impulse = SAMPLE * DT * np.clip(commands[k], low, high)
        assert DT * held.sum(axis=0) == pytest.approx(impulse, rel=1e-14)


@pytest.mark.parametrize("on_off", [False, True])
def test_pulses_fire_the_impulse_of_the_commands_but_for_what_is_left(on_off):
    rng = np.random.default_rng(3)
    most, least, quantum = 2.0, 0.15, 2.0 * DT
    pulses = Pulses(
        at=np.array([0]),
        on_off=np.array([on_off]),
        most=np.array([most]),
        least=np.array([least]),
        quantum=np.array([quantum]),
        left=np.zeros(1),
        level=np.zeros(1),
        end=np.zeros(1),
        time=SAMPLE * DT,
    )
    limits = Saturation(np.zeros(1), np.array([most]))._replace(pulses=pulses)
    commands = rng.uniform(0.0, 1.0, size=(40, 1))
    u = acting(limits, commands, channels=(channels := []))[:, 0]
    wanted = SAMPLE * DT * commands[:, 0].cumsum()
    fired = DT * u.cumsum()[SAMPLE - 1 :: SAMPLE]
    # Nothing is lost or made: what is not fired yet is left, at most a pulse of it.
    assert channels[0].pulses.left[0] == pytest.approx(wanted[-1] - fired[-1], abs=1e-12)
    assert np.abs(wanted - fired).max() <= max(least, 0.5 * quantum) + 1e-12
    of_samples = DT * u.reshape(-1, SAMPLE).sum(axis=1)
    assert ((of_samples == 0.0) | (of_samples >= least - 1e-12)).all() and (of_samples > 0.0).any()
    if on_off:
        assert set(np.unique(u)) == {0.0, most}


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
    assert u[0] == torques[asked > 0.0] and w[2] == pytest.approx(u[0, 0] * 3 * DT / inertia)
    assert w[3 * SAMPLE - 1] == pytest.approx(edge, rel=1e-12)
    assert (np.abs(w) <= abs(edge) * (1.0 + 1e-12)).all()
    assert u[3 * SAMPLE - 1] == pytest.approx(0.0, abs=1e-12)
    assert u[3 * SAMPLE] == torques[asked < 0.0]  # away from its limit a wheel has all its torque


def test_a_wheel_beyond_its_speed_is_only_slowed_down():
    speeds, one = np.array([5.0]), np.ones(1)
    wheels = Wheels(np.array([0]), np.array([0]), -one, one, -one, one, one)
    limits = Saturation(np.full(1, -np.inf), np.full(1, np.inf))._replace(wheels=wheels)
    for command, given in ((0.5, 0.0), (-0.5, -0.5), (-3.0, -1.0)):
        commands = np.array([[command]])
        assert acting(limits, commands, nu=lambda _: speeds)[0] == given


def test_a_faulty_input_gives_its_gain_and_bias_along_its_turned_axes_until_it_fails():
    rng = np.random.default_rng(5)
    u, gain, bias = rng.normal(size=(3, 4))
    R = pin.exp3(rng.normal(size=3))
    until, given = np.array([9.0, 2.0, 9.0, 9.0]), np.empty(4)
    faults = ActuatorFaults(gain, bias, until, R.ravel("F"))
    for t in (1.9, 2.0):
        expected = (gain * u + bias) * (t < until)
        expected[1:] = R @ expected[1:]
        apply_faults(faults, [1], t, u, given)
        assert given == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("seed", range(12))
def test_an_allocation_meets_the_conditions_of_karush_kuhn_and_tucker(seed):
    """Minimise ``|A u - b|^2 / |b|^2 + LEAST^2 |u|^2 / scale^2`` within the bounds."""
    rng = np.random.default_rng(seed)
    size, count = 6, 9
    A, b = rng.normal(size=(size, count)), rng.normal(size=size)
    least, most = -rng.uniform(0.0, 0.4, size=count), rng.uniform(0.05, 0.4, size=count)
    least[::3] = 0.0  # of thrusters, which cannot pull
    problem = least_squares(least, most, size)._replace(columns=np.append(A.T.ravel(), b))
    solve(problem, size, 0)
    u, unit, force = np.array(problem.x), np.linalg.norm(A), np.linalg.norm(b)
    assert (u >= least).all() and (u <= most).all()
    # The gradient, in the scale of the solver, with columns and force divided by their norms.
    slope = (A / unit).T @ (A @ u - b) / force + LEAST**2 * u * unit / force
    # Rounding of 1e-16 moves an input by 1e-16 / LEAST.
    near = 1e-16 / LEAST
    low, high = u <= least + near, u >= most - near
    free = ~(low | high)
    assert np.abs(slope[free]).max(initial=0.0) < 1e-12
    assert (slope[low] > -1e-12).all() and (slope[high] < 1e-12).all()
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
    problem = least_squares(least, most, size)._replace(columns=np.append(A.T.ravel(), b))
    solve(problem, size, 0)
    u = np.array(problem.x)
    free = (u > least + 1e-9) & (u < most - 1e-9)
    assert size <= free.sum() < count
    multiplier = np.linalg.lstsq(A[:, free].T, u[free], rcond=None)[0]
    assert u == pytest.approx(np.clip(A.T @ multiplier, least, most), abs=1e-12)
    assert A @ u == pytest.approx(b, abs=1e-10)


def test_a_run_goes_on_within_its_speeds_and_its_chart():
    turn = pin.Quaternion(pin.exp3(np.array([0.0, 0.0, 2.0]))).coeffs()
    origin, bounds = np.append(np.zeros(3), turn), np.array([2.0, 3.0])

    def at(angle, *rates, sign=1.0):
        q = np.append(np.zeros(3), (0.0, 0.0, np.sin(angle / 2.0), np.cos(angle / 2.0)))
        return bool(goes_on(StopConditions(bounds**2, [sign]), origin, q, np.array(rates)))

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
