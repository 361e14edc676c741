"""A linear model as a mechanical system M a + D v + K s = S u, and its conserved momenta."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from fflin.analysis.ranks import (
    EPS,
    Margin,
    Noisy,
    echelon,
    null_space,
    stacked,
    without_rounding,
)
from fflin.base.errors import FflinWarning, InputError
from fflin.base.validation import Array, Indices, Values, instance
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    pass

# Springs or dampers count as not symmetric if their relative asymmetry exceeds this.
_SYMMETRIC = 1e-8

# If the relative residual of a momentum exceeds this, no coordinate has the momentum as its rate,
# because the operating point is in motion.
_CONSISTENT = 1e-8

# Rounding error of springs per squared spin rate and of dampers per spin rate, in units of energy.
_OF_SPIN = 1e-15

# If the orbital rate, relative to the fastest vibration, is below this, the square of the ratio is
# close to rounding error.
_SLOWEST = 3e-6


def checked(lin: LinearModel) -> LinearModel:
    """Return the model if its states are positions and their rates, or raise `InputError`."""
    instance("lin", lin, LinearModel, "a fflin.LinearModel")
    lin.require_unchanged()
    nx = len(lin.A)
    if lin.M.shape != (nx // 2, nx // 2) or nx % 2:
        raise InputError(
            f"the model has {nx} states and an inertia of shape {lin.M.shape}, expected half as "
            "many rows as states; make the model with linearize or momentum_reduction"
        )
    for name in "ABCD":
        if not np.isfinite(getattr(lin, name)).all():
            raise InputError(f"{name} of the model has entries that are not finite")
    warn_of_stiffness(lin)
    return lin


def warn_of_stiffness(lin: LinearModel) -> None:
    """Warn if a vibration is so fast that orbital effects are within its rounding error."""
    nv, size = len(lin.M), np.sqrt(lin.M.diagonal())
    fastest = float((np.abs(rate_matrix(lin)[nv:, :nv]) * size[:, None] / size).max()) ** 0.5
    if 0.0 < lin.mean_motion < _SLOWEST * fastest:
        warnings.warn(
            f"orbital effects on '{lin.robot}' at {lin.mean_motion:.3g} rad/s are smaller than "
            f"the rounding error of joint vibrations at {fastest:.3g} rad/s, so the result may "
            "miss the orbital effects; lock the joints that vibrate",
            FflinWarning,
            stacklevel=4,
        )


def state_sizes(lin: LinearModel) -> Array:
    """Return weights (nx,) that scale the states to comparable sizes by their inertia."""
    return np.tile(np.sqrt(lin.M.diagonal()), 2)


def rate_matrix(lin: LinearModel) -> Array:
    """Return A, or (A - I)/dt of a sampled model, which has the same invariant subspaces."""
    return (lin.A - np.eye(len(lin.A))) / lin.dt if lin.dt else lin.A


def floating_inertia(M: Array, kept: Indices, others: Indices) -> Array:
    """Return the inertia of the kept coordinates with the others free: a Schur complement of M."""
    across = M[np.ix_(others, kept)]
    return M[np.ix_(kept, kept)] - across.T @ np.linalg.solve(M[np.ix_(others, others)], across)


@dataclass(frozen=True)
class SecondOrder:
    """Matrices of M a + D v + K s = S u, in coordinates s whose rates are the velocities v."""

    M: Array
    K: Noisy
    D: Noisy
    S: Noisy  # (nv, nu)

    @cached_property
    def size(self) -> Array:
        """Square roots (nv,) of the diagonal of M, which make forces and speeds comparable."""
        return np.sqrt(self.M.diagonal())

    def restricted(self, R: Array) -> SecondOrder:
        """Return the system restricted to the motions R z; constraint forces do no work."""
        M = R.T @ self.M @ R
        K, D = ((forces @ R).after(R.T) for forces in (self.K, self.D))
        return SecondOrder(M, K, D, self.S.after(R.T))

    @property
    def acting(self) -> bool:
        """Whether there are springs or dampers."""
        return bool(self.K.values.any() or self.D.values.any())

    @cached_property
    def symmetric(self) -> bool:
        """Whether springs and dampers are symmetric, and all dampers have the same sign."""
        units = np.outer(self.size, self.size)
        for matrix in (self.K.values / units, self.D.values / units):
            if np.abs(matrix - matrix.T).max(initial=0.0) > _SYMMETRIC * np.abs(matrix).max():
                return False
        drag = np.linalg.eigvalsh(self.D.values / units)
        return min(-drag.min(), drag.max()) <= _SYMMETRIC * np.abs(drag).max()

    @cached_property
    def poles(self) -> tuple[Values, Margin]:
        """Approximate nonzero poles, one of each conjugate pair, and the margin of the ranks."""
        rigid, margin = self._null(self.K, self.D)
        unloaded, other = self._null(self.K)
        R = null_space(Noisy.exact(rigid.T @ self.M / self.size))[0]
        part = self.restricted(R / self.size[:, None])
        r = len(part.M)
        if not r:
            return np.zeros(0, dtype=complex), margin & other
        L = np.linalg.inv(np.linalg.cholesky(part.M))
        K, D = L @ part.K.values @ L.T, L @ part.D.values @ L.T
        zeros = unloaded.shape[1] - rigid.shape[1]
        if D.any():
            fastest = max(np.linalg.norm(K, 2) ** 0.5, np.linalg.norm(D, 2))
            A = np.block([[np.zeros((r, r)), np.eye(r)], [-K / fastest**2, -D / fastest]])
            found = np.linalg.eigvals(A) * fastest
        else:
            roots = np.sqrt(-np.linalg.eigvalsh((K + K.T) / 2.0).astype(complex))
            found, zeros = np.concatenate((roots, -roots)), 2 * zeros
        found = found[np.argsort(np.abs(found))][zeros:]
        return found[found.imag >= 0.0], margin & other

    def _null(self, *matrices: Noisy) -> tuple[Array, Margin]:
        stack = stacked([[matrix] for matrix in matrices]) @ np.diag(1.0 / self.size)
        basis, margin = null_space(stack)
        return basis / self.size[:, None], margin.transformed(1.0 / self.size)


def second_order(lin: LinearModel) -> SecondOrder:
    """Return the second-order form of a model, continuous or sampled."""
    # The product with M leaves rounding errors in entries without a spring, damper or input, so
    # entries below a threshold are set to zero. All springs share one threshold and all dampers
    # another, in units of energy. Each input has its own threshold.
    nv, M, X = len(lin.M), lin.M, rate_matrix(lin)
    size, N = np.sqrt(M.diagonal()), rates_of_positions(X)
    rates = np.hstack((X[nv:], lin.B[nv:]))
    spread = 4.0 * nv * EPS * np.abs(rates)
    if lin.dt:
        # Every entry of a matrix exponential has the rounding error of the largest entry.
        spread[:, : 2 * nv] += 4.0 * nv * EPS * np.abs(lin.A).max() / lin.dt * (X[nv:] != 0.0)
    noise = np.abs(M) @ spread
    # Forces that balance during a spin leave rounding errors. The model may have no other force
    # that gives a scale for these errors, so they are estimated from the spin rate.
    turns = [x for x, unit in zip(lin.x0, lin.state_units, strict=True) if unit == "rad/s"]
    spin = float(np.abs(turns).max(initial=0.0))
    noise[:, :nv] += _OF_SPIN * np.outer(size, size) * spin**2
    noise[:, nv : 2 * nv] += _OF_SPIN * np.outer(size, size) * spin
    forces = Noisy(M @ rates, noise)
    K, D, S = map(forces.columns, (slice(0, nv), slice(nv, 2 * nv), slice(2 * nv, None)))
    # To find rounding errors, each entry of S is compared with the norm of its own column.
    each = np.linalg.norm(S.values / size[:, None], axis=0)
    return SecondOrder(
        M=M,
        K=without_rounding(K @ -N, size, size),
        D=without_rounding(D @ -np.eye(nv), size, size),
        S=without_rounding(S, size, np.where(each > 0.0, each, 1.0)),
    )


def at_rest(lin: LinearModel) -> LinearModel | None:
    """Return `lin` or its continuous model if that model is a second-order system, else None."""
    # The continuous model has this structure if the rates of the positions depend on the
    # velocities alone. The structure then also applies to a model sampled from it. A sampled model
    # without its continuous model has this structure only if there are no forces.
    source, nv = lin.generator or lin, len(lin.M)
    X = rate_matrix(source)
    if X[:nv, :nv].any() or (source.dt and X[nv:].any()):
        return None
    return source


def rates_of_positions(X: Array) -> Array:
    """Return N (nv, nv) with dp/dt = N nu, or the identity if sampling makes N ill-conditioned."""
    nv = len(X) // 2
    N = X[:nv, nv:]
    return N if np.linalg.cond(N) < 1e6 else np.eye(nv)


@dataclass(frozen=True)
class ConservedMomenta:
    """Conserved momenta, which no input, spring or damper changes, and the kept coordinates."""

    # W (k, nv): W M nu is conserved. W is in echelon form, so the row for the momentum of a single
    # coordinate is a unit vector.
    weights: Array
    # L1, L2 (k, nx) with L1 A = 0, L2 A = L1 and L1 B = L2 B = 0. For a sampled model, A is
    # replaced by (A - I)/dt.
    momenta: Array
    coordinates: Array
    # (r,): kept coordinates. If L1 x = L2 x = 0, they and their rates determine all other states.
    kept: Indices
    T: Array  # (nx, 2 r): maps kept coordinates and rates to the state, if L1 x = L2 x = 0
    margin: Margin  # margin of the rank decision on r

    @property
    def selected(self) -> Indices:
        """Indices (2 r,) of the kept coordinates and their rates in the state."""
        return np.concatenate((self.kept, self.kept + len(self.T) // 2))

    @property
    def rates(self) -> Array:
        """Map (nv, r) from the rates of the kept coordinates to all velocities."""
        return self.T[len(self.T) // 2 :, len(self.kept) :]


def conserved(lin: LinearModel) -> ConservedMomenta:
    """Find the conserved momenta (9.2): :math:`W M [A_{21}, A_{22}, B_2] = 0`."""
    lin = lin.generator or lin  # the continuous model conserves the same momenta
    nv, X, system = len(lin.M), rate_matrix(lin), second_order(lin)
    size = system.size
    pushes = stacked([[system.K.T], [system.D.T], [system.S.T]])
    free, margin = null_space(pushes @ np.diag(1.0 / size), states=2)
    # A column of W^T is a unit vector if the momentum belongs to a single coordinate.
    basis, pivots = echelon(free / size[:, None], size)
    W = basis.T
    momenta = W @ lin.M
    coordinates = _driven(X, momenta)
    if coordinates is None:
        pivots, W = pivots[:0], W[:0]
        momenta = coordinates = np.zeros((0, nv))
    kept = np.setdiff1d(np.arange(nv), pivots)
    r, k = len(kept), len(pivots)
    T = np.zeros((2 * nv, 2 * r))
    T[kept, np.arange(r)] = T[nv + kept, r + np.arange(r)] = 1.0
    if k:
        T[pivots, :r] = -np.linalg.solve(coordinates[:, pivots], coordinates[:, kept])
        T[nv + pivots, r:] = -np.linalg.solve(momenta[:, pivots], momenta[:, kept])
    zero = np.zeros((k, nv))
    L1, L2 = np.hstack((zero, momenta)), np.hstack((coordinates, zero))
    return ConservedMomenta(W, L1, L2, kept, T, margin.transformed(1.0 / size))


def _driven(X: Array, momenta: Array) -> Array | None:
    """Return the coordinates (k, nv) whose rates are the momenta, or None if there are none."""
    nv = len(X) // 2
    X11, X12 = X[:nv, :nv], X[:nv, nv:]
    if not X11.any():
        found = np.linalg.solve(X12.T, momenta.T).T
    else:
        wanted = np.hstack((momenta, np.zeros_like(momenta)))
        found = np.linalg.lstsq(np.hstack((X12, X11)).T, wanted.T, rcond=None)[0].T
    error = np.abs(found @ X12 - momenta).max(initial=0.0)
    error = max(error, np.abs(found @ X11).max(initial=0.0))
    return found if error <= _CONSISTENT * np.abs(momenta).max(initial=0.0) else None
