"""Margins of periodic loops equal those of searches in hand-written loops."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag, expm

import fflin
from fflin.control.closed_loop import ClosedLoop
from fflin.control.margins import laws_in_loop
from fflin.control.optimal.periodic_loops import (
    ChannelHarmonics,
    Harmonics,
    PeriodicLoop,
)
from fflin.control.periodic_closed_loop import PeriodicClosedLoop
from tests.control.test_multirate import designed
from tests.support.marks import exhaustive


def random_loop(seed, samples, channels, size=3):
    """Return a stable periodic loop with random matrices."""
    rng = np.random.default_rng(seed)
    F = rng.normal(size=(samples, size, size))
    loop = PeriodicLoop(
        F,
        rng.normal(size=(samples, size, channels)),
        rng.normal(size=(samples, channels, size)),
        rng.normal(size=(samples, channels, channels)),
    )
    return loop._replace(F=F * (0.7 / loop.radius) ** (1.0 / samples))


def monodromy(loop, change):
    """Return the transition of a period with w = change(z) z; change has taps (n, m) of filters."""
    channels, taps = change.shape
    size = loop.F.shape[1]
    product = np.eye(size + channels * (taps - 1))
    for F, G, H, J in zip(*loop, strict=True):
        now = np.diag(change[:, 0])
        past = block_diag(*change[:, None, 1:])
        inverse = np.linalg.inv(np.eye(channels) - J @ now)
        # z and w by the state x and the past values of z.
        z = inverse @ np.hstack((H, J @ past))
        w = now @ z + np.hstack((np.zeros((channels, size)), past))
        following = np.hstack((F, np.zeros((size, past.shape[1])))) + G @ w
        chains = [following]
        for channel in range(channels):
            chain = np.zeros((taps - 1, product.shape[0]), complex)
            if taps > 1:
                chain[0] = z[channel]
                start = size + channel * (taps - 1)
                chain[1:, start : start + taps - 2] = np.eye(taps - 2)
            chains.append(chain)
        product = np.vstack(chains) @ product
    return product


def filters(angle, values):
    """Return the taps (n, N) of filters with the responses `values` (N, n) at the harmonics."""
    samples = len(values)
    at = angle + 2.0 * math.pi * np.arange(samples) / samples
    basis = np.exp(-1j * np.outer(at, np.arange(samples)))
    return np.linalg.solve(basis, values).T


@pytest.mark.parametrize(
    ("samples", "channels"), [(2, 1), *exhaustive((3, 1), (3, 2), (5, 3))]
)
def test_the_worst_perturbation_makes_a_filter_that_destabilises_the_loop(
    samples, channels
):
    for seed in range(3):
        loop = random_loop(seed, samples, channels)
        peak = Harmonics(loop).structured_peak()
        change = peak.perturbation.reshape(samples, channels)
        assert np.abs(change) == pytest.approx(1.0 / peak.reached)
        poles = np.linalg.eigvals(monodromy(loop, filters(peak.frequency, change)))
        pole = np.exp(1j * samples * peak.frequency)
        assert np.abs(poles - pole).min() < 1e-7
        assert peak.reached <= peak.bound * (1.0 + 1e-9)
        if samples * channels <= 3:
            assert peak.reached == pytest.approx(peak.bound, rel=1e-6)
        else:
            assert peak.reached > 0.8 * peak.bound


@pytest.mark.parametrize("samples", [2, *exhaustive(3)])
def test_no_smaller_perturbation_destabilises_the_loop(samples):
    """All-pass filters with random delays and phases are perturbations of constant size."""
    rng = np.random.default_rng(0)
    for seed in range(3):
        loop = random_loop(seed, samples, 1)
        bound = Harmonics(loop).structured_peak().bound
        for _ in range(300):
            taps = np.zeros((1, 6), complex)
            phase = np.exp(1j * rng.uniform(0.0, 2.0 * np.pi))
            taps[0, rng.integers(6)] = 0.999 / bound * phase
            poles = np.linalg.eigvals(monodromy(loop, taps))
            assert np.abs(poles).max() < 1.0


def test_the_bound_equals_a_search_over_all_perturbations():
    """The spectral radius over the phases, on a fine grid of angles that is refined."""
    loop = random_loop(1, 2, 1)
    harmonics = Harmonics(loop)

    def responses(angles):
        """Return the responses from the sum of the impulse responses of both samples."""
        columns = np.zeros((len(angles), 2, 2), complex)
        for start in range(2):
            x = loop.G[start]
            total = np.zeros((len(angles), 2), complex)
            total[:, start] += loop.J[start, 0, 0]
            for k in range(start + 1, 400):
                z = (loop.H[k % 2] @ x)[0, 0]
                total[:, k % 2] += z * np.exp(-1j * angles * (k - start))
                x = loop.F[k % 2] @ x
            columns[:, :, start] = total
        basis = np.array([[1.0, 1.0], [1.0, -1.0]]) / math.sqrt(2.0)
        return basis @ columns @ basis

    peak = harmonics.structured_peak()
    angles = np.append(np.linspace(0.0, math.pi / 2.0, 200), peak.frequency)
    M = responses(angles)
    assert harmonics.at(angles) == pytest.approx(M, abs=1e-9)
    phases = np.exp(1j * np.linspace(0.0, 2.0 * math.pi, 721))
    turned = M[:, None].repeat(len(phases), axis=1)
    turned[:, :, 1] *= phases[:, None]
    largest = np.abs(np.linalg.eigvals(turned)).max()
    # A step of half a degree leaves an error below 1e-5.
    assert largest <= peak.bound * (1.0 + 1e-9)
    assert largest == pytest.approx(peak.bound, rel=1e-5)


@pytest.fixture(scope="module")
def loop():
    """Return a robot, its model and a law of a star tracker at 4 Hz and a gyroscope at 20 Hz."""
    _, lin, compensator = designed()
    return lin, fflin.MultirateFeedback(lin, compensator)


def radius(lin, policy, *, input_delay=0.0, factor=1.0, channel=0):
    """Return the largest pole of a period of a hand-written loop, with changes of one input."""
    law, h = policy.compensator, lin.dt
    source = lin.generator
    samples = 5
    late = 4  # samples of delay of the star tracker
    kept = [
        index
        for index, name in enumerate(source.state_names)
        if name.startswith(("q_b", "omega_b"))
    ]
    others = np.setdiff1d(np.arange(len(source.A)), kept)
    assert not source.A[np.ix_(kept, others)].any() and not source.C[:, others].any()
    A, B, C = source.A[np.ix_(kept, kept)], source.B[kept], source.C[:, kept]
    nx, nu = B.shape
    ny, nz = law.B.shape[2], law.A.shape[1]
    whole, rest = divmod(input_delay / h, 1.0)
    history = int(whole) + 1
    nxt = nx + nz + ny + 3 * late + history

    def flow(time):
        block = np.zeros((nx + nu, nx + nu))
        block[:nx, :nx], block[:nx, nx:] = A, B
        result = expm(block * time)
        return result[:nx, :nx], result[:nx, nx:]

    full = flow(h)
    parts = flow(rest * h), flow((1.0 - rest) * h)
    product = np.eye(nxt)
    trackers = [lin.output_names.index(f"q_b.{axis}") for axis in "xyz"]
    for k in range(samples):
        step = np.zeros((nxt, nxt))
        x = np.eye(nxt)[:nx]
        z = np.eye(nxt)[nx : nx + nz]
        held = np.eye(nxt)[nx + nz : nx + nz + ny]
        line = np.eye(nxt)[nx + nz + ny : nx + nz + ny + 3 * late]
        past = np.eye(nxt)[-history:]
        y = C @ x
        received = y.copy()
        for row, output in enumerate(trackers):
            at = row * late
            arrives = (k - late) % 5 == 0
            received[output] = line[at + late - 1] if arrives else held[output]
        u = law.C @ z
        u[channel] *= factor
        own = np.vstack((u[channel], past))  # latest first
        x_next = full[0] @ x + full[1] @ u
        column = full[1][:, channel]
        x_next = x_next - np.outer(column, u[channel])
        early, now = own[history], own[history - 1]
        (_, first), (A_rest, second) = parts
        effect = np.outer(A_rest @ first[:, channel], early)
        x_next = x_next + effect + np.outer(second[:, channel], now)
        step[:nx] = x_next
        step[nx : nx + nz] = law.A[k] @ z + law.B[k] @ received
        step[nx + nz : nx + nz + ny] = received
        for row, output in enumerate(trackers):
            at = nx + nz + ny + row * late
            step[at] = y[output]
            step[at + 1 : at + late] = line[row * late : row * late + late - 1]
        step[-history:] = own[:history]
        product = step @ product
    return float(np.abs(np.linalg.eigvals(product)).max())


@pytest.mark.exhaustive
def test_margins_are_the_limits_of_a_hand_written_loop(loop):
    lin, policy = loop
    margins = fflin.margins(policy, lin)
    assert margins.samples == 5 and margins.stable
    assert radius(lin, policy) < 1.0
    for index, channel in enumerate(margins.channels):
        assert math.isnan(channel.phase)
        limits = [(0.0, channel.gain[0]), (0.0, channel.gain[1]), (channel.delay, 1.0)]
        for number, (delay, factor) in enumerate(limits):
            grows = []
            for change in (1.0 - 1e-4, 1.0 + 1e-4):
                changed = {"factor": factor * change}
                if number == 2:
                    changed = {"input_delay": delay * change}
                grows.append(radius(lin, policy, channel=index, **changed) > 1.0)
            assert grows == ([True, False] if number == 0 else [False, True])


@pytest.mark.exhaustive
def test_a_law_that_repeats_has_the_margins_of_the_law():
    """Three equal samples are a period of a law that does not vary with time."""
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()])
    lin = fflin.linearize(robot).discretize(0.2)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin))
    laws = laws_in_loop(policy, lin, None)
    expected = ClosedLoop(laws, lin, 0.3, None, "inputs").margins()
    result = PeriodicClosedLoop(laws * 3, lin, 0.3, None, "inputs").margins()
    assert result.disk == pytest.approx(expected.disk, rel=1e-6)
    assert result.frequency == pytest.approx(expected.frequency, rel=1e-2)
    for one, other in zip(result.channels, expected.channels, strict=True):
        assert one.gain == pytest.approx(other.gain, rel=1e-6)
        assert one.delay == pytest.approx(other.delay, rel=1e-6)
        assert one.disk == pytest.approx(other.disk, rel=1e-5)


def test_a_delayed_sensor_is_part_of_the_loop():
    """A delay of all sensors has the effect of the same delay of all inputs."""
    result = []
    for seconds in (0.2, 0.0):
        outputs = [fflin.StarTracker(delay=seconds)]
        outputs.append(fflin.Gyroscope("base", delay=seconds))
        robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=outputs)
        lin = fflin.linearize(robot).discretize(0.1)
        gains = np.hstack((-0.02 * np.eye(3), -0.02 * np.eye(3)))
        none = np.zeros((0, 0))
        system = (none, np.zeros((0, 6)), np.zeros((3, 0)), gains, lin.dt)
        policy = fflin.LinearController(system, lin)
        result.append(fflin.margins(policy, lin, delay=0.2 - seconds))
    late_sensors, late_inputs = result
    assert late_sensors.samples == 1
    assert late_sensors.disk == pytest.approx(late_inputs.disk, rel=1e-6)
    for one, other in zip(*(one.channels for one in result), strict=True):
        assert one.gain == pytest.approx(other.gain, rel=1e-6)
        assert one.delay == pytest.approx(other.delay, rel=1e-6)


def test_what_a_periodic_loop_does_not_have_is_refused(loop):
    lin, policy = loop
    unknown = replace(lin, _robot=None)
    with pytest.raises(fflin.InputError, match="the model has no robot"):
        fflin.margins(policy, unknown)
    with pytest.raises(fflin.InputError, match="expected a gain"):
        fflin.validity(lin._robot, lin, policy)


@pytest.mark.exhaustive
def test_the_report_of_a_periodic_loop_states_that_it_has_no_phase_margin(loop):
    lin, policy = loop
    report = " ".join(str(fflin.margins(policy, lin)).split())
    assert "no channel has a phase margin" in report


def test_the_difference_of_a_loop_with_a_factor_is_a_determinant():
    """The eigenvalues of the responses give it for all factors, also at inserted angles."""
    loop = random_loop(5, 4, 2)
    channel = ChannelHarmonics(Harmonics(loop), 1)
    angles = channel._angles
    channel._refine(angles[1:] > 0.5 * angles[-1])
    assert len(channel._angles) > len(angles)
    one = loop.channel(1)
    responses = Harmonics(one).at(channel._angles) - 0.5 * np.eye(4)
    for factor in (0.3, 2.5):
        expected = np.linalg.det(np.eye(4) - (factor - 1.0) * responses)
        np.testing.assert_allclose(channel._with_factor(factor), expected, rtol=1e-9)
