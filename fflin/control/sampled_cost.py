"""The cost of a continuous system under inputs that are held."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fflin.analysis.gramians import held_cost
from fflin.base.errors import InputError
from fflin.base.validation import Array, number
from fflin.control.weights import Weight, cost_weights
from fflin.linear.model import LinearModel


class SampledCost(NamedTuple):
    """Weights of a sum over samples: ``lqr(lin.discretize(dt), *cost)``."""

    Q: Array
    R: Array
    N: Array


def sampled_cost(
    lin: LinearModel, dt: float, Q: Weight, R: Weight, N: ArrayLike | None = None
) -> SampledCost:
    r"""Return the sum over samples that equals an integral cost under held inputs.

    Equation (10.1) of docs/derivation.md:

    .. math:: \begin{bmatrix} Q_d & N_d \\ N_d^T & R_d \end{bmatrix} = \int_0^h e^{F^T t}
              \begin{bmatrix} Q & N \\ N^T & R \end{bmatrix} e^{F t}\,dt,\qquad
              F = \begin{bmatrix} A & B \\ 0 & 0 \end{bmatrix}

    At rest F^3 = 0, and the integral is a polynomial in h, exact; elsewhere it is that of a
    short step (van Loan), doubled.

    Parameters
    ----------
    lin : LinearModel
        Continuous.
    dt : float
        Sampling time h [s].
    Q, R : see `lqr`
    N : array_like (nx, nu), optional

    Returns
    -------
    SampledCost
        (Q, R, N) as `lqr` takes them.

    Raises
    ------
    InputError
        If the model is sampled already, `dt` is not positive, or a weight is not one of `lqr`.

    References
    ----------
    C. F. van Loan, Computing integrals involving the matrix exponential, IEEE Trans. Automatic
    Control 23(3), 1978.
    """
    if not isinstance(lin, LinearModel) or lin.dt:
        raise InputError("lin must be a continuous LinearModel; give the one before discretize")
    h = number("dt", dt)
    if h <= 0.0:
        raise InputError(f"dt is {h:g} s, expected a positive sampling time")
    Q, R, cross = cost_weights(lin, Q, R, N)
    nx, nu = lin.B.shape
    F = np.zeros((nx + nu, nx + nu))
    F[:nx, :nx], F[:nx, nx:] = lin.A, lin.B
    W = np.zeros_like(F)
    W[:nx, :nx], W[nx:, nx:] = Q, R
    if cross is not None:
        W[:nx, nx:], W[nx:, :nx] = cross, cross.T
    total = held_cost(F, W, h)
    if not np.isfinite(total).all():
        raise InputError(f"dt is {h:g} s, over which the model overflows")
    return SampledCost(total[:nx, :nx], total[nx:, nx:], total[:nx, nx:])
