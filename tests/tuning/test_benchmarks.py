"""Static output feedback of COMPleib's HE1, and of problems with a bound from full order.

The matrices are those of F. Leibfritz, COMPleib 1.1 (2005), COMPleib.m.
"""

import numpy as np
import pytest

import fflin
from fflin.tuning.hinf import Generalised, synthesis
from tests.support.tuning import least_gain

HALF = 2.0**-0.5
GAIN = fflin.StaticGain("*", "*", largest=1e6)

# Longitudinal motion of a VTOL helicopter (Singh and Coelho, 1984).
HE1 = (
    [
        [-0.0366, 0.0271, 0.0188, -0.4555],
        [0.0482, -1.01, 0.0024, -4.0208],
        [0.1002, 0.3681, -0.7070, 1.42],
        [0.0, 0.0, 1.0, 0.0],
    ],
    [[4.678e-2, 0.0], [4.572e-2, 9.88e-3], [4.369e-2, 1.11e-3], [-2.179e-2, 0.0]],
    [[0.4422, 0.1761], [3.5446, -7.5922], [-5.52, 4.49], [0.0, 0.0]],
    HALF * np.array([[2.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]),
    [[0.0, 1.0, 0.0, 0.0]],
    np.zeros((2, 2)),
    HALF * np.eye(2),
    np.zeros((1, 2)),
)

# Supersonic transport aircraft at Mach 2.7 with all states measured (1974).
AC16 = (
    [
        [-0.037, 0.0123, 0.00055, -1.0],
        [0.0, 0.0, 1.0, 0.0],
        [-6.37, 0.0, -0.23, 0.0618],
        [1.25, 0.0, 0.016, -0.0457],
    ],
    np.eye(4),
    [[0.00084, 0.000236], [0.0, 0.0], [0.08, 0.804], [-0.0862, -0.0665]],
    np.eye(6, 4),
    np.eye(4),
    np.zeros((6, 4)),
    np.eye(6)[:, 4:],
    np.zeros((4, 4)),
)

# Missile autopilot (Fares, Apkarian and Noll, 2001).
AC4 = (
    [
        [-0.876, 1.0, -0.1209, 0.0],
        [8.9117, 0.0, -130.75, 0.0],
        [0.0, 0.0, -150.0, 0.0],
        [-1.0, 0.0, 0.0, -0.05],
    ],
    [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 1.0]],
    [[0.0], [0.0], [150.0], [0.0]],
    [[-0.25, 0.0, 0.0, 3.487], [0.0, 0.0, -3.0, 0.0]],
    [[-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0]],
    [[0.0, 0.25], [0.0, 0.0]],
    [[0.0], [3.0]],
    [[0.0, 1.0], [0.01, 0.0]],
)


def full_order(matrices):
    pytest.importorskip("slycot")
    plant = [np.atleast_2d(np.array(matrix, float)) for matrix in matrices]
    D22 = np.zeros((len(plant[4]), plant[2].shape[1]))
    return synthesis(Generalised(*plant, D22))[1]


def with_noise(matrices, size):
    """A plant whose measurements also have independent noise of a size."""
    A, B1, B2, C1, C2, D11, D12, D21 = matrices
    ny = len(C2)
    B1, D11 = np.pad(B1, ((0, 0), (0, ny))), np.pad(D11, ((0, 0), (0, ny)))
    return A, B1, B2, C1, C2, D11, D12, np.hstack((D21, size * np.eye(ny)))


def test_he1_reaches_the_best_published_value():
    value, _ = least_gain(HE1, GAIN, starts=1)
    assert value <= 0.1538 * 1.001
    # The best published value is rounded to four digits.
    assert value >= 0.15375


@pytest.mark.exhaustive
def test_he1_reaches_the_same_value_from_all_starts():
    values = [least_gain(HE1, GAIN, starts=number)[0] for number in (1, 2, 3)]
    assert max(values) <= min(values) * (1.0 + 1e-6)


@pytest.mark.exhaustive
def test_feedback_of_all_states_reaches_the_value_of_full_order():
    # With all states measured, no law of any order is better than a static gain.
    value, _ = least_gain(AC16, GAIN, starts=4)
    least = full_order(with_noise(AC16, 1e-5))
    assert least * (1.0 - 1e-3) <= value <= least * (1.0 + 2e-3)


@pytest.mark.exhaustive
def test_a_static_gain_is_no_better_than_full_order():
    static, _ = least_gain(AC4, GAIN)
    values = [least_gain(AC4, GAIN, starts=number)[0] for number in (1, 2)]
    assert full_order(AC4) * (1.0 - 1e-3) <= static
    assert max(values) <= static * (1.0 + 1e-6)
