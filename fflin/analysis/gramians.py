"""Controllability and observability Gramians."""

from dataclasses import dataclass

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, FrozenArrays, instance, positive
from fflin.dynamics.integrators import held_cost
from fflin.linear.model import LinearModel

# A pole that decays less, relative to the fastest, may be one at zero that rounding moved.
_DECAY = 1e-7


@dataclass(frozen=True, eq=False)
class Gramians(FrozenArrays):
    """Controllability and observability Gramians of a linear model.

    Attributes
    ----------
    controllability : ndarray (nx, nx)
        Gramian W_c; the least input energy that reaches x is ``x^T W_c^-1 x``.
    observability : ndarray (nx, nx)
        Gramian W_o; the output energy of the free response from x is ``x^T W_o x``.
    duration : float
        Horizon [s]; infinite if `duration` was omitted.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> within = fflin.gramians(lin, duration=10.0)
    >>> within.duration, within.observability.shape
    (10.0, (18, 18))
    """

    controllability: Array
    observability: Array
    duration: float


def gramians(lin: LinearModel, duration: float | None = None) -> Gramians:
    r"""Compute the controllability and observability Gramians.

    .. math::
        W_c = \int_0^T e^{A t} B B^T e^{A^T t}\,dt, \quad
        W_o = \int_0^T e^{A^T t} C^T C e^{A t}\,dt.

    The Gramians of a sampled model are sums over its samples. For an infinite horizon, the
    Gramians solve Lyapunov equations. For a finite horizon T, the Gramians are polynomials in T
    if :math:`A^2 = 0`, as at rest without springs. In all other cases, the Gramians are computed
    for a short horizon, which is then doubled repeatedly, :math:`W(2 t) = W(t) + e^{A t} W(t)
    e^{A^T t}`.

    Parameters
    ----------
    lin : LinearModel
        Continuous or sampled model.
    duration : float, optional
        Horizon T [s]; a multiple of dt for a sampled model. By default the horizon is infinite, and
        the model must be asymptotically stable. A model with a free base is never asymptotically
        stable.

    Returns
    -------
    Gramians
        Both Gramians and their horizon.

    Raises
    ------
    InputError
        If `duration` is not positive or not a multiple of dt, or if the model is not
        asymptotically stable and `duration` is missing.

    References
    ----------
    C. Van Loan, Computing integrals involving the matrix exponential, IEEE Trans. Automatic
    Control 23(3), 1978.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> fflin.gramians(lin, duration=10.0).controllability.shape
    (18, 18)
    """
    instance("lin", lin, LinearModel, "a fflin.LinearModel")
    pairs = ((lin.A, lin.B), (lin.A.T, lin.C.T))
    if duration is None:
        _require_decay(lin)
    else:
        duration = positive("duration", duration, "s")
    with np.errstate(over="ignore", invalid="ignore"):
        found = [_gramian(A, B @ B.T, lin.dt, duration) for A, B in pairs]
    if not all(np.isfinite(W).all() for W in found):
        raise InputError(
            f"duration is {duration:g} s, over which the state transition overflows; shorten it"
        )
    reach, show = (0.5 * (W + W.T) for W in found)
    return Gramians(reach, show, np.inf if duration is None else duration)


def _require_decay(lin: LinearModel) -> None:
    poles = np.linalg.eigvals(lin.A)
    size = float(np.abs(poles).max())
    growth = float(np.abs(poles).max()) - 1.0 if lin.dt else float(poles.real.max())
    if growth >= -_DECAY * (1.0 if lin.dt else size):
        slow = f"a pole of modulus {1.0 + growth:.6g}" if lin.dt else f"a pole at {growth:.3g} 1/s"
        raise InputError(
            f"the model is not asymptotically stable ({slow}), so its Gramians are not finite; "
            "give duration="
        )


def _gramian(A: Array, Q: Array, dt: float, duration: float | None) -> Array:
    if duration is None:
        from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov

        return solve_discrete_lyapunov(A, Q) if dt else solve_continuous_lyapunov(A, -Q)
    if not dt:
        return held_cost(A.T, Q, duration)
    steps = round(duration / dt)
    if not steps or abs(steps * dt - duration) > 1e-9 * duration:
        raise InputError(f"duration is {duration:g} s, expected a multiple of dt = {dt:g} s")
    # The sum of A^k Q A^kT over k < steps, by the binary digits of their number.
    total, power = np.zeros_like(Q), np.eye(len(A))
    while steps:
        if steps & 1:
            total = total + power @ Q @ power.T
            power = power @ A
        Q, A = Q + A @ Q @ A.T, A @ A
        steps >>= 1
    return total
