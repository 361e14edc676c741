"""Laws of given orders for problems of COMPleib, against published values and full order."""

import numpy as np
import pytest

import fflin
from fflin.tuning.hinf import Generalised, synthesis
from tests.support import compleib
from tests.support.marks import exhaustive
from tests.support.tuning import least_gain

GAIN = fflin.StaticGain("*", "*", largest=1e6)

# Published values of static output feedback, rounded to four digits. Apkarian and Noll state 1.192
# for REA2; most searches end at 1.1813, but the gain of a law of large gains tends to 1.149.
# The values of AC15 and HE4 are those of hinfstruct, rounded to three digits, and of HIFOO.
PUBLISHED = {
    "HE1": 0.1538,
    "AC7": 0.0651,
    "AC8": 2.005,
    "AC4": 0.9355,
    "REA2": 1.149,
    "HE2": 4.249,
    "AC6": 4.114,
    "AC15": 15.2,
    "HE4": 22.8382,
}

# Numbers of starts other than three.
STARTS = {"HE1": 1, "AC7": 1, "REA2": 9}

# Problems whose static value is that of full order within 2 %, so that no law is better.
AS_GOOD_AS_FULL_ORDER = ("AC17", "AC2", "AC16", "DIS1", "DIS4")


def matrices_of(name):
    problem = getattr(compleib, name)
    return tuple(np.atleast_2d(np.array(matrix, float)) for matrix in problem)


def full_order(matrices):
    pytest.importorskip("slycot")
    D22 = np.zeros((len(matrices[4]), matrices[2].shape[1]))
    return synthesis(Generalised(*matrices, D22))[1]


def with_noise(matrices, size):
    """A plant whose measurements also have independent noise of a size."""
    A, B1, B2, C1, C2, D11, D12, D21 = matrices
    ny = len(C2)
    B1, D11 = np.pad(B1, ((0, 0), (0, ny))), np.pad(D11, ((0, 0), (0, ny)))
    return A, B1, B2, C1, C2, D11, D12, np.hstack((D21, size * np.eye(ny)))


@pytest.mark.parametrize(
    "name",
    ["HE1", "AC7", *exhaustive("AC8", "AC4", "REA2", "HE2", "AC6", "AC15", "HE4")],
)
def test_a_static_gain_reaches_the_best_published_value(name):
    value, _ = least_gain(matrices_of(name), GAIN, starts=STARTS.get(name, 3))
    assert value <= PUBLISHED[name] * 1.002
    assert value >= PUBLISHED[name] * (0.997 if name == "AC15" else 0.999)


def test_the_law_of_rea2_that_few_searches_find_has_the_gain_of_a_sweep():
    # A published search ends at 1.192, and most searches at 1.1813.
    A, B1, B2, C1, C2, _, D12, _ = matrices_of("REA2")
    K = np.array([[-24.17149056, -20.68875818], [-20.63156641, -23.86448085]])
    loop, read = A + B2 @ K @ C2, C1 + D12 @ K @ C2
    assert np.linalg.eigvals(loop).real.max() < 0.0
    rates = np.concatenate(([0.0], np.geomspace(1e-3, 1e4, 4000)))
    inner = np.linalg.inv(1j * rates[:, None, None] * np.eye(4) - loop)
    gains = np.linalg.norm(read @ inner @ B1, 2, axis=(1, 2))
    assert gains.max() == pytest.approx(PUBLISHED["REA2"], rel=1e-3)


@pytest.mark.parametrize("name", ["AC17", *exhaustive("AC2", "AC16", "DIS1", "DIS4")])
def test_a_static_gain_is_as_good_as_full_order(name):
    matrices = matrices_of(name)
    value, _ = least_gain(matrices, GAIN, starts=1 if name == "AC17" else 6)
    # Measurements without noise are the limit of small noise. It cannot make a law better.
    least = full_order(with_noise(matrices, 1e-4))
    assert least * (1.0 - 2e-3) <= value <= least * 1.02


@pytest.mark.exhaustive
def test_he1_reaches_the_same_value_from_all_starts():
    values = [least_gain(compleib.HE1, GAIN, starts=number)[0] for number in (1, 2, 3)]
    assert max(values) <= min(values) * (1.0 + 1e-6)


@pytest.mark.exhaustive
def test_feedback_of_all_states_reaches_the_value_of_full_order():
    # With all states measured, no law of any order is better than a static gain.
    matrices = matrices_of("AC16")
    value, _ = least_gain(matrices, GAIN, starts=4)
    least = full_order(with_noise(matrices, 1e-5))
    assert least * (1.0 - 1e-3) <= value <= least * (1.0 + 2e-3)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["AC4", "HE1", "HE2"])
def test_a_law_of_a_higher_order_is_never_worse(name):
    matrices = matrices_of(name)
    values = [
        least_gain(matrices, fflin.StateSpaceLaw(order), starts=2)[0]
        for order in (0, 1, 2)
    ]
    assert values[1] <= values[0] * (1.0 + 1e-9) and values[2] <= values[1]
    assert values[2] < 0.9 * values[0]
    if name == "AC4":
        least = full_order(matrices)
        assert least * (1.0 - 1e-3) <= values[2] <= 1.05 * least


def test_two_searches_of_a_first_order_law_are_equal_bit_for_bit():
    laws = [
        least_gain(compleib.AC7, fflin.StateSpaceLaw(1), starts=2, steps=6)[1]
        for _ in range(2)
    ]
    assert np.array_equal(laws[0].gain, laws[1].gain)


def distance_from_axis(matrices, gamma):
    """Distance from the imaginary axis of the eigenvalues of the Hamiltonian of the estimator."""
    A, B1, _, C1, C2, D11, _, D21 = matrices
    C, D = np.vstack((C1, C2)), np.vstack((D11, D21))
    R = D @ D.T - np.diag([gamma**2] * len(C1) + [0.0] * len(C2))
    drift = np.block([[A.T, np.zeros_like(A)], [-B1 @ B1.T, -A]])
    left = np.vstack((C.T, -B1 @ D.T))
    right = np.hstack((D @ B1.T, C))
    poles = np.linalg.eigvals(drift - left @ np.linalg.solve(R, right))
    return np.abs(poles.real).min()


def test_full_order_ends_where_the_estimator_has_no_riccati_solution():
    # SLICOT's SB10AD fails for this problem at all levels below 100.
    matrices = with_noise(matrices_of("REA1"), 1e-3)
    norm = full_order(matrices)
    assert distance_from_axis(matrices, 1.001 * norm) > 1e-3
    assert distance_from_axis(matrices, 0.999 * norm) < 1e-9
    A, B1, B2, C1, C2, D11, D12, D21 = matrices
    assert full_order((A, B1, B2, C1, C2[:2], D11, D12, D21[:2])) > norm
