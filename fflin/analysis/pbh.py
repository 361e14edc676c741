"""Controllable and observable subspaces by the Popov-Belevitch-Hautus test, pole by pole."""

from typing import NamedTuple

import numpy as np

from fflin.analysis.mechanics import rates_of_positions
from fflin.analysis.ranks import EPS, FixedPoles, Margin, decided, image, judged, unit_columns
from fflin.base.validation import Array

# Singular values decide on an eigenvector whose product with inputs of unit length is smaller, or
# whose eigenvalue has a neighbour this near; any other is reached without doubt.
_SUSPICIOUS = 1e-3

# Eigenvalues nearer than this are the same: rounding moves a defective one by its square root.
# The Rayleigh quotient of the singular vector converges quadratically, in few steps.
_SAME_POLE, _REFINEMENTS = 1e-9, 4

# A slower decay may be a defective pair of poles at zero, which rounding moves by its square root.
_DECAY = 1e-7

# A motion of which a sample leaves less has died out: the rest is rounding.
_DEAD = 1e4 * EPS


class _Scaled(NamedTuple):
    """A pair in coordinates of energy: ``x = to_x @ xi``, time in units of `unit` seconds."""

    A: Array
    to_x: Array
    from_x: Array
    unit: float
    tolerance: float


def _scaled(X: Array, M: Array, dt: float) -> _Scaled:
    """Scale Jacobians to units of energy, and of time so that A has a size of about 1."""
    # Velocities are L^T nu with M = L L^T, so that |xi|^2 is twice the kinetic energy, positions
    # likewise over the time unit. The tolerance is twenty times the rounding of M^-1, or that of
    # the exponential which the slopes of a sampled model are a difference of.
    nv = len(M)
    p, v = slice(0, nv), slice(nv, None)
    L = np.linalg.cholesky(M)
    N = rates_of_positions(X)
    to_velocity, zero = np.linalg.inv(L.T), np.zeros((nv, nv))
    to_x = np.block([[N @ to_velocity, zero], [zero, to_velocity]])
    back = np.block([[L.T @ np.linalg.inv(N), zero], [zero, L.T]])
    A = back @ X @ to_x
    turning, fall, drag = (float(np.linalg.norm(A[i, j], 2)) for i, j in ((p, p), (v, p), (v, v)))
    rate = max(turning, drag, np.sqrt(fall))
    # Without forces no unit of time is better than another.
    unit = 1.0 / rate if rate > 0.0 else 1.0
    if dt:
        # Sampled at the period of its only vibration, the model shows only rounding as forces.
        unit = min(unit, 100.0 * dt)
    # With time in this unit, positions are measured in it too.
    stretch = np.repeat((unit, 1.0), nv)
    to_x, back = to_x * stretch, back / stretch[:, None]
    root = np.sqrt(M.diagonal())
    condition = float(np.linalg.cond(M / np.outer(root, root)))
    A = unit * A * stretch / stretch[:, None]
    noise = EPS * (unit / dt + float(np.linalg.norm(A, 2))) if dt else 0.0
    return _Scaled(A, to_x, back, unit, 20.0 * max(len(X) * EPS * condition, noise))


class Split(NamedTuple):
    """The state space of a model, split into what its inputs reach and the rest."""

    reached: Array  # (nx, d), a basis
    rest: Array  # (nx, nx - d), a basis; of the dual pair of what no output shows
    rows: Array  # (nx - d, nx) with rows @ x what no input acts on
    fixed: FixedPoles  # of the rest


def split_by_poles(X: Array, drive: Array, M: Array, dt: float, *, dual: bool = False) -> Split:
    """Split the state space of (X, B) by left vectors w [A - s E, B] = 0 at every eigenvalue s."""
    # They are split off by an orthogonal transformation, until there are none: so that the whole of
    # a defective eigenvalue goes. A staircase would carry the rounding of a weak step into the
    # next.
    # X is A, or (A - E)/dt of a sampled model; `drive` is B, or C^T of the dual pair.
    pair = _scaled(X, M, dt)
    A, to = (pair.A.T, pair.to_x.T) if dual else (pair.A, pair.from_x)
    B = unit_columns(to @ drive)
    inside, margin = np.eye(len(A)), Margin()
    rest: Array = np.zeros((len(A), 0))
    while inside.shape[1]:
        lost, found = _left_vectors(inside.T @ A @ inside, inside.T @ B, pair.tolerance)
        margin &= found.seen(inside)
        if not lost.shape[1]:
            break
        rest = np.hstack((rest, inside @ lost))
        inside = inside @ image(lost, 0.5)[1]
    nv = len(A) // 2
    margin = margin.halved().seen(pair.to_x[nv:, nv:])
    parts = (pair.to_x @ inside, pair.to_x @ rest, rest.T @ pair.from_x)
    if not rest.shape[1]:
        return Split(*parts, FixedPoles(margin=margin))
    rates, vectors = np.linalg.eig(rest.T @ A @ rest)
    shapes = pair.to_x @ rest @ vectors
    poles = 1.0 + dt * rates / pair.unit if dt else rates / pair.unit
    decay = 1.0 - np.abs(poles) if dt else -rates.real
    least, most = int(decay.argmin()), int(decay.argmax())
    settling = decided(max(float(decay[least]), 0.0) / _DECAY, shapes[:, least]).halved()
    if dt and abs(poles[most]) < _DEAD:
        # Motions that die out between samples cannot be distinguished.
        margin &= decided(1.0, shapes[:, most]).halved()
    return Split(*parts, FixedPoles(poles, bool(decay[least] > _DECAY), margin, settling))


def _left_vectors(A: Array, B: Array, tolerance: float) -> tuple[Array, Margin]:
    """Return an orthonormal real basis (m, k) of the left eigenvectors that are orthogonal to B."""
    from scipy.linalg import eig

    poles, left = eig(A, left=True, right=False)
    unseen = np.linalg.norm(left.conj().T @ B, axis=1) < _SUSPICIOUS
    distances = np.abs(poles[:, None] - poles) + np.eye(len(A))
    near = unseen | (distances.min(axis=1) < _SUSPICIOUS)
    # Rounding splits a defective zero into several poles, so that zero itself is tested first.
    candidates = [0j, *poles[(poles.imag >= 0.0) & near]]
    found: Array = np.zeros((len(A), 0))
    margin, known = Margin(), np.zeros(0, dtype=complex)
    for pole in candidates:
        vectors, at, decision = _at_pole(A, B, complex(pole), tolerance)
        if (np.abs(known - at) < _SAME_POLE).any():
            continue
        margin &= decision
        if not vectors.shape[1]:
            continue
        known = np.append(known, at)
        parts = np.hstack((vectors.real, vectors.imag)) if abs(at.imag) > _SAME_POLE else vectors
        parts = np.real(parts)
        # Poles that differ only by rounding have the same vectors.
        new = parts - found @ (found.T @ parts)
        found = np.hstack((found, image(new, _SUSPICIOUS)[0]))
    return found, margin


def _at_pole(A: Array, B: Array, pole: complex, tolerance: float) -> tuple[Array, complex, Margin]:
    """Return the left vectors (m, k) at a pole, the pole itself, and the margin."""
    size = len(A)
    for _ in range(_REFINEMENTS):
        shift = pole.real if abs(pole.imag) < _SAME_POLE else pole
        U, values, _ = np.linalg.svd(np.hstack((A - shift * np.eye(size), B)))
        last = U[:, -1]
        refined = complex(last.conj() @ A @ last)
        if not pole or abs(refined - pole) < EPS or values[-1] > _SUSPICIOUS:
            break
        pole = refined
    rank = int((values > tolerance).sum())
    states = 2 if abs(shift.imag) > _SAME_POLE else 1
    return U[:, rank:], complex(shift), judged(values / tolerance, U, rank, states)
