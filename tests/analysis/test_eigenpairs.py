"""Zeros in Jordan blocks, split off from a matrix that is built to have them."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from fflin.analysis.modes import nonzero_eigenpairs

TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])


def hidden(rng, *blocks):
    A = block_diag(*blocks)
    turned = np.linalg.qr(rng.normal(size=A.shape))[0]
    return turned @ A @ turned.T


@pytest.mark.parametrize("seed", range(5))
def test_zeros_are_split_off_and_the_others_kept(seed):
    rng = np.random.default_rng(seed)
    others = [np.array([[0.3]]), np.array([[-0.7]]), 0.5 * TURN]
    chains = [np.eye(size, k=1) for size in (4, 2, 1)]
    A = hidden(rng, *chains, *others)
    pairs, nullity = nonzero_eigenpairs(A, 1e-13)
    assert nullity == 3
    values = sorted(
        (value for value, *_ in pairs), key=lambda value: (value.real, value.imag)
    )
    assert values == pytest.approx([-0.7, -0.5j, 0.5j, 0.3], abs=1e-13)
    for value, x, error in pairs:
        assert np.abs(A @ x - value * x).max() < 1e-14 and np.linalg.norm(
            x
        ) == pytest.approx(1.0)
        assert error < 1e-11
    assert nonzero_eigenpairs(hidden(rng, *chains), 1e-13) == ([], 3)


@pytest.mark.parametrize("seed", range(5))
def test_rounding_is_not_taken_for_growth(seed):
    """Two equal poles on the axis that make one block: rounding moves them by its root."""
    coupled = np.block([[TURN, np.eye(2)], [np.zeros((2, 2)), TURN]])
    A = hidden(np.random.default_rng(seed), coupled, np.array([[0.1]]))
    pairs, nullity = nonzero_eigenpairs(A, 1e-13)
    assert nullity == 0 and len(pairs) == 5
    on_axis = [(value, error) for value, _, error in pairs if value.imag]
    # far beyond the rounding of A
    assert max(abs(value.real) for value, _ in on_axis) > 1e-12
    assert all(abs(value.real) < error < 1e-3 for value, error in on_axis)
    (growing,) = (value.real - error for value, _, error in pairs if not value.imag)
    assert growing > 0.09
