"""Periodic Riccati equation of multirate filters, compared with sweeps and with SciPy."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from fflin.control.optimal.periodic_filter import periodic_filter


def system(n=5, k=3, seed=0):
    """Return A, C, W and V of a random system with unstable and slow modes."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A *= 1.05 / np.abs(np.linalg.eigvals(A)).max()
    C = rng.normal(size=(k, n))
    W = rng.normal(size=(n, n))
    V = rng.normal(size=(k, k))
    return A, C, W @ W.T, V @ V.T + np.eye(k)


def sweep(A, C, W, V, used, periods):
    """Return the covariances of a period after a long forward sweep from zero."""
    P = np.zeros_like(A)
    for _ in range(periods):
        rows = []
        for row in used:
            rows.append(P)
            C_j, V_j = C[row], V[np.ix_(row, row)]
            K = P @ C_j.T @ np.linalg.inv(C_j @ P @ C_j.T + V_j)
            P = A @ (P - K @ C_j @ P) @ A.T + W
            P = 0.5 * (P + P.T)
    return np.array(rows)


@pytest.mark.parametrize("seed", range(5))
def test_the_solution_equals_a_long_sweep(seed):
    A, C, W, V = system(seed=seed)
    used = np.random.default_rng(seed).random((4, 3)) < 0.5
    used[0] = True
    solution = periodic_filter(A, C, W, V, used)
    expected = sweep(A, C, W, V, used, 300)
    scale = np.abs(expected).max()
    assert np.abs(solution.P - expected).max() < 1e-10 * scale
    assert solution.residual < 1e-12
    assert not solution.K[~used[:, None, :].repeat(5, axis=1)].any()


@pytest.mark.parametrize("count", [1, 3])
def test_equal_rates_give_the_stationary_filter(count):
    A, C, W, V = system(seed=7)
    expected = solve_discrete_are(A.T, C.T, W, V)
    used = np.ones((count, 3), dtype=bool)
    solution = periodic_filter(A, C, W, V, used)
    for P, K in zip(solution.P, solution.K, strict=True):
        assert P == pytest.approx(expected, rel=1e-10, abs=1e-10)
        assert K == pytest.approx(
            expected @ C.T @ np.linalg.inv(C @ expected @ C.T + V), abs=1e-10
        )


def test_a_random_walk_between_rare_measurements_by_hand():
    """P grows by W at each sample; one measurement a period gives a quadratic equation."""
    N, W, V = 4, 0.3, 2.0
    used = np.zeros((N, 1), dtype=bool)
    used[0] = True
    one = np.ones((1, 1))
    solution = periodic_filter(one, one, W * one, V * one, used)
    # P = P V / (P + V) + N W
    total = N * W
    P = 0.5 * (total + np.sqrt(total**2 + 4.0 * total * V))
    after = P * V / (P + V)
    expected = [P, *(after + k * W for k in range(1, N))]
    assert solution.P[:, 0, 0] == pytest.approx(expected, rel=1e-13)
    assert solution.poles[0] == pytest.approx(1.0 - P / (P + V), rel=1e-13)


def test_slow_biases_are_resolved():
    """A bias that drifts by 1e-8 of the noise has a time constant of millions of samples."""
    A = np.eye(2)
    A[0, 1] = 0.05
    W = np.diag([1e-10, 1e-24])
    used = np.zeros((5, 1), dtype=bool)
    used[2] = True
    C, V = np.array([[1.0, 0.0]]), np.array([[1e-8]])
    solution = periodic_filter(A, C, W, V, used)
    assert solution.residual < 1e-10
    assert 0.0 < 1.0 - np.abs(solution.poles).max() < 1e-3


def test_an_unobserved_unstable_mode_has_no_filter():
    A = np.diag([1.1, 0.5])
    C = np.array([[0.0, 1.0]])
    with pytest.raises(np.linalg.LinAlgError):
        periodic_filter(A, C, np.eye(2), np.eye(1), np.ones((2, 1), dtype=bool))
