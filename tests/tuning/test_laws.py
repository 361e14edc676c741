"""Tuned laws of problems whose least value is known."""

import math
from importlib.util import find_spec

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

import fflin
from fflin.tuning import hinf
from fflin.tuning.hinf import Generalised, synthesis
from fflin.tuning.search import simplex_program
from fflin.tuning.verification import largest_in_band, peak_above, second_value
from tests.support.compleib import AC6
from tests.support.tuning import least_gain, problem_of

needs_slycot = pytest.mark.skipif(find_spec("slycot") is None, reason="needs slycot")


def generalised(matrices):
    A, B1, B2, C1, C2, D11, D12, D21 = (np.atleast_2d(matrix) for matrix in matrices)
    return Generalised(
        A, B1, B2, C1, C2, D11, D12, D21, np.zeros((len(C2), B2.shape[1]))
    )


def scalar(a, q, r):
    """x' = a x + w + u, z = (q x, r u), y = x."""
    none = np.zeros((2, 1))
    return (
        np.array([[a]]),
        np.eye(1),
        np.eye(1),
        np.array([[q], [0.0]]),
        np.eye(1),
        none,
        np.array([[0.0], [r]]),
        np.zeros((1, 1)),
    )


@pytest.mark.parametrize(("a", "q", "r"), [(1.0, 2.0, 0.5), (-1.0, 1.0, 1.0)])
def test_the_gain_of_a_scalar_plant_is_that_of_its_closed_form(a, q, r):
    # With u = -k x, the gain is sqrt(q^2 + r^2 k^2) / (k - a) at w = 0. Its minimum over k
    # is at k = -q^2 / (a r^2) for a < 0, and it falls to r for k without end for a > 0.
    value, law = least_gain(scalar(a, q, r), fflin.StaticGain("*", "*", largest=1e3))
    least = r * math.sqrt(1e6 + (q / r) ** 2) / (1e3 - a)
    k = 1e3
    if a < 0.0:
        k = -(q**2) / (a * r**2)
        least = math.sqrt(q**2 + r**2 * k**2) / (k - a)
    assert value == pytest.approx(least, rel=1e-5)
    # The value is flat about the minimum: an error of 1e-5 in it allows sqrt(1e-5) in k.
    assert -law.D[0, 0] == pytest.approx(k, rel=1e-2)


def satellite(n=4):
    """Two masses with a weak spring; force noise on both, and the force on the first is a cost."""
    A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-1, 1, -0.1, 0.1], [2, -2, 0.2, -0.2]])
    B = np.array([[0.0], [0.0], [1.0], [0.0]])
    B1 = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    C1 = np.vstack((np.eye(4)[:2], np.zeros((1, 4))))
    D12 = np.array([[0.0], [0.0], [0.7]])
    return A, B1, B, C1, np.eye(n), np.zeros((3, 2)), D12, np.zeros((n, 2))


def riccati_value(matrices):
    """The least gain of state feedback, from the Riccati equation of H-infinity control."""
    A, B1, B2, C1, _, _, D12, _ = matrices
    R = D12.T @ D12

    def is_possible(gamma):
        B = np.hstack((B1, B2))
        weights = np.diag([-(gamma**2)] * B1.shape[1] + [R[0, 0]])
        try:
            X = solve_continuous_are(A, B, C1.T @ C1, weights)
        except np.linalg.LinAlgError:
            return False
        loop = A - B @ np.linalg.solve(weights, B.T @ X)
        stable = np.linalg.eigvals(loop).real.max() < 0.0
        return stable and np.linalg.eigvalsh(X)[0] > -1e-9

    low, high = 0.1, 100.0
    while high > low * (1.0 + 1e-6):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if is_possible(middle) else (middle, high)
    return high


@pytest.mark.exhaustive
def test_static_state_feedback_reaches_the_riccati_value():
    matrices = satellite()
    value, _ = least_gain(matrices, fflin.StaticGain("*", "*", largest=1e3), starts=4)
    least = riccati_value(matrices)
    assert least * (1.0 - 1e-5) <= value <= least * (1.0 + 1e-3)


def noisy():
    """The two masses with a noisy measurement of the second."""
    A, B1, B2, C1, *_ = satellite()
    C2 = np.array([[0.0, 1.0, 0.0, 0.0]])
    B1 = np.hstack((B1, np.zeros((4, 1))))
    return (
        A,
        B1,
        B2,
        C1,
        C2,
        np.zeros((3, 3)),
        satellite()[6],
        np.array([[0.0, 0.0, 0.3]]),
    )


@needs_slycot
def test_the_controller_of_full_order_has_the_norm_that_it_claims():
    matrices = noisy()
    (A, B, C, D), gamma = synthesis(generalised(matrices))
    plant = generalised(matrices)
    K = np.block([[D, C], [B, A]])
    n, nz = len(plant.A), len(A)
    grow = [
        np.block([[plant.A, np.zeros((n, nz))], [np.zeros((nz, n + nz))]]),
        np.block([[plant.B2, np.zeros((n, nz))], [np.zeros((nz, 1)), np.eye(nz)]]),
        np.block([[plant.C2, np.zeros((1, nz))], [np.zeros((nz, n)), np.eye(nz)]]),
    ]
    loop = grow[0] + grow[1] @ K @ grow[2]
    B1 = np.vstack((plant.B1, np.zeros((nz, 3))))
    D21 = np.vstack((plant.D21, np.zeros((nz, 3))))
    D12 = np.hstack((plant.D12, np.zeros((3, nz))))
    C1 = np.hstack((plant.C1, np.zeros((3, nz))))
    inputs, outputs = B1 + grow[1] @ K @ D21, C1 + D12 @ K @ grow[2]
    assert np.linalg.eigvals(loop).real.max() < 0.0
    largest = 0.0
    for w in np.geomspace(1e-2, 1e2, 300):
        states = np.linalg.solve(1j * w * np.eye(n + nz) - loop, inputs)
        largest = max(largest, np.linalg.norm(outputs @ states + D12 @ K @ D21, 2))
    assert gamma * 0.98 < largest <= gamma * (1.0 + 1e-6)


@needs_slycot
@pytest.mark.exhaustive
def test_a_law_of_full_order_reaches_the_value_of_hinf():
    # An unstable oscillator with a noisy measurement of its position.
    none = np.zeros((2, 1))
    matrices = (
        np.array([[0.0, 1.0], [0.5, -0.2]]),
        np.array([[0.0, 0.0], [1.0, 0.0]]),
        np.array([[0.0], [1.0]]),
        np.array([[1.0, 0.0], [0.0, 0.0]]),
        np.array([[1.0, 0.0]]),
        np.hstack((none, none)),
        np.array([[0.0], [0.5]]),
        np.array([[0.0, 0.3]]),
    )
    _, gamma = synthesis(generalised(matrices))
    value, _ = least_gain(matrices, fflin.StateSpaceLaw(2), steps=400)
    assert gamma * (1.0 - 1e-3) <= value <= gamma * 1.01


def with_noise(matrices, size):
    """A plant whose measurements also have independent noise of a size."""
    plant = generalised(matrices)
    ny = len(plant.C2)
    return plant._replace(
        B1=np.pad(plant.B1, ((0, 0), (0, ny))),
        D11=np.pad(plant.D11, ((0, 0), (0, ny))),
        D21=np.hstack((plant.D21, size * np.eye(ny))),
    )


@needs_slycot
@pytest.mark.parametrize("r", [1e-3, 1.0, 30.0])
def test_the_least_norm_of_a_noisy_integrator_is_that_of_its_closed_form(r):
    # For x' = w + u, z = (x, r u) and y = x + r n, both Riccati equations have the solution
    # 1 / sqrt(1 / r^2 - 1 / g^2). Its square is g^2 at the least norm g = sqrt(2) r.
    least = math.sqrt(2.0) * r
    _, gamma = synthesis(with_noise(scalar(0.0, 1.0, r), r))
    assert least * (1.0 - 1e-9) <= gamma <= least * (1.0 + 1e-3)


@needs_slycot
def test_full_order_with_exact_measurements_reaches_the_riccati_value():
    least = riccati_value(satellite())
    _, gamma = synthesis(with_noise(satellite(), 1e-5))
    assert least * (1.0 - 1e-5) <= gamma <= least * (1.0 + 1e-3)


@needs_slycot
def test_the_least_norm_does_not_depend_on_units():
    # Two modes with a damping ratio of 0.3 %, in units of very different sizes.
    rng = np.random.default_rng(3)
    w = np.array([0.3, 12.0])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.diag(w**2), -0.006 * np.diag(w)]])
    modes = rng.standard_normal((2, 1))
    B2, C2 = np.vstack((0.0 * modes, modes)), np.hstack((modes.T, np.zeros((1, 2))))
    none = np.zeros((1, 4))
    plant = with_noise(
        (
            *(A, 0.3 * B2, B2, np.vstack((2.0 * C2, none)), C2),
            *(np.zeros((2, 1)), np.array([[0.0], [0.5]]), np.zeros((1, 1))),
        ),
        0.1,
    )
    units = np.array([1e3, 1e-3, 20.0, 1e-2])
    scaled = plant._replace(
        A=units[:, None] * plant.A / units,
        B1=units[:, None] * plant.B1,
        B2=1e4 * units[:, None] * plant.B2,
        C1=plant.C1 / units,
        C2=1e-4 * plant.C2 / units,
        D12=1e4 * plant.D12,
        D21=1e-4 * plant.D21,
    )
    # In milliseconds.
    faster = plant._replace(A=1e3 * plant.A, B1=1e3 * plant.B1, B2=1e3 * plant.B2)
    norms = [synthesis(form)[1] for form in (plant, scaled, faster)]
    assert norms == pytest.approx([norms[0]] * 3, rel=1e-5)


@needs_slycot
def test_an_undisturbed_integrator_has_a_controller():
    # For x' = u, z = (x, u) and y = x + n, the gain from n to x is 1 at w = 0 in each stable loop.
    one, none = np.eye(1), np.zeros((1, 1))
    matrices = (
        none,
        none,
        one,
        np.eye(2, 1),
        one,
        np.zeros((2, 1)),
        np.eye(2)[:, 1:],
        one,
    )
    _, gamma = synthesis(generalised(matrices))
    assert 1.0 - 1e-9 <= gamma <= 1.001


@needs_slycot
def test_a_design_whose_loop_exceeds_its_level_is_refused(monkeypatch):
    monkeypatch.setattr(hinf, "largest_in_band", lambda *_: (1e13, 0.0))
    with pytest.raises(fflin.InputError, match="verified"):
        synthesis(generalised(noisy()))


def test_the_largest_gain_in_a_band_is_that_at_its_end():
    # 1 / (s + 1) falls with frequency.
    system = -np.eye(1), np.eye(1), np.eye(1), np.zeros((1, 1))
    gain, frequency = largest_in_band(system, 2.0, math.inf)
    assert gain == pytest.approx(1.0 / math.sqrt(5.0), rel=1e-12) and frequency == 2.0
    assert largest_in_band(system, 0.0, math.inf)[0] == pytest.approx(1.0)


def test_a_gain_above_a_level_is_found_at_its_frequency():
    problem = problem_of(AC6)
    measure, case = problem.measures[0], problem.cases[0]
    channel, loop = case.channels[0], case.loops(problem.law(problem.start()))[0]
    goal, ends = measure.goal, measure.ends
    largest = second_value(goal, ends, channel, loop)
    none = np.zeros(0)
    assert peak_above(goal, ends, channel, loop, none, 1.0001 * largest) is None
    gain, frequency = peak_above(goal, ends, channel, loop, none, 0.5 * largest)
    assert gain == pytest.approx(largest, rel=1e-6)
    A, B, C, D = loop.system(channel)
    inner = 1j * frequency * np.eye(len(A)) - A
    response = D + C @ np.linalg.solve(inner, B)
    assert np.linalg.norm(response, 2) == pytest.approx(gain, rel=1e-9)


def test_the_quadratic_program_satisfies_its_conditions():
    rng = np.random.default_rng(2)
    rows = rng.standard_normal((30, 5))
    offsets = -rng.uniform(0.0, 1.0, 30)
    sums = np.ones(30)
    sums[20:] = 0.0
    z = simplex_program(rows @ rows.T, offsets, sums)
    costs = rows @ rows.T @ z - offsets
    price = -(z * costs).sum()
    # Optimality: the costs of all entries are not negative, and those of used entries vanish.
    assert z.min() >= 0.0 and z[:20].sum() == pytest.approx(1.0, abs=1e-9)
    assert (costs + price * sums).min() > -1e-8
    assert np.abs((costs + price * sums)[z > 1e-9]).max() < 1e-8
