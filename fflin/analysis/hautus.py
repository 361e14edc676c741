"""Controllable and observable subspaces by the Popov-Belevitch-Hautus test, pole by pole.

`split_by_poles` tests any pair (A, B), or the dual pair (A^T, C^T), by the rank of [A - p I, B] at
each pole p. `unobservable` tests a second-order system M a + D v + K s = 0 with the positions s and
the output C_s s + C_v v, by the null space of [p^2 M + p D + K; C_s + p C_v] at each pole p. The
test of second-order systems is less sensitive to rounding.
"""

from operator import itemgetter

import numpy as np

from fflin.analysis import ranks
from fflin.analysis.mechanics import SecondOrder, energy_units, rates_of_positions
from fflin.base.validation import Array, Values

# Singular values of [A - s I, B] are computed only at s = 0 and at suspicious eigenvalues s of A.
# The columns of B have unit length. An eigenvalue is suspicious if another eigenvalue is closer to
# it than _SUSPICIOUS. It is also suspicious if its left eigenvector y is nearly orthogonal to the
# columns of B: |y^H B| < _SUSPICIOUS. The refinement of a pole stops if the smallest singular value
# exceeds _SUSPICIOUS, because this singular value is then certainly not zero.
_SUSPICIOUS = 1e-3

# Rounding splits a multiple eigenvalue into several poles, which are refined separately. Refined
# poles closer than _SAME_POLE therefore count as one pole. If two unobservable poles of a
# second-order system are closer than _DEFECTIVE, they may be one defective pole. A defective pole
# has too few eigenvectors for the test. In second-order systems, both distances are relative to the
# modulus of the pole.
_SAME_POLE, _DEFECTIVE = 1e-9, 1e-5

# `_left_vectors` refines a pole by the Rayleigh quotient of a singular vector. The refinement
# converges quadratically, so _REFINEMENTS steps are enough. `_missed_shapes_at` refines a pole of a
# second-order system in at most twice as many steps. It also stops the refinement if a step is
# larger than _NEAR times the modulus of the pole.
_REFINEMENTS, _NEAR = 4, 0.1

# Two poles are aliased if their difference times dt is closer than this to a nonzero multiple of 2
# pi j. A state that is observable in the continuous model may then be unobservable in the sampled
# model.
_ALIASED = 1e-6

# If a motion decays to less than this fraction within one sample, only its rounding error remains.
_DEAD = 1e4 * ranks.EPS


def split_by_poles(
    X: Array,
    drive: Array,
    M: Array,
    dt: float,
    *,
    known: Array | None = None,
    dual: bool = False,
) -> tuple[Array, Array, Array, ranks.FixedPoles]:
    """Split the state space by the left null vectors of [A - s I, B] at each eigenvalue s of A.

    The rows of `known` (k, nx) are combinations of states that are known to be uncontrollable. They
    are taken out of the state space first, so nx - k replaces nx in the shapes of the following
    four results, except for the number of rows or columns that refer to states:

    - a basis (nx, d) of the controllable subspace;
    - a basis (nx, nx - d) of a complement of this subspace;
    - a matrix (nx - d, nx), each row of which is an uncontrollable combination of states;
    - the fixed poles.

    If `dual`, the pair (A^T, C^T) replaces (A, B), and the rows of `known` are unobservable
    motions. The second result is then a basis of the other unobservable motions, and the first and
    third results have no meaning.
    """
    # X is A, or (A - I)/dt of a sampled model. The matrix `drive` is B, or C^T of the dual pair.
    # The states x = to_x xi are scaled to states xi in units of energy. Positions are also divided
    # by a unit of time, which is chosen so that the scaled A has a norm of about 1.
    nv = len(M)
    p, v = slice(0, nv), slice(nv, None)
    to_x, from_x = energy_units(M, rates_of_positions(X))
    A = from_x @ X @ to_x
    turning, fall, drag = (
        float(np.linalg.norm(A[i, j], 2)) for i, j in ((p, p), (v, p), (v, v))
    )
    rate = max(turning, drag, np.sqrt(fall))
    # If no force depends on the state, the unit of time is arbitrary.
    unit = 1.0
    if rate > 0.0:
        unit = 1.0 / rate
    if dt:
        # If the sample time is the period of the only vibration, the state returns to its initial
        # value in each sample. X then contains rounding errors instead of the spring forces, and
        # the unit of time derived from X would be too long.
        unit = min(unit, 100.0 * dt)
    stretch = np.repeat((unit, 1.0), nv)
    to_x, from_x = to_x * stretch, from_x / stretch[:, None]
    A = unit * A * stretch / stretch[:, None]
    # `noise` is the relative rounding error of M^-1. For a sampled model, it is at least the
    # rounding error of (A - I)/dt. The tolerance of the rank decisions is twenty times `noise`.
    root = np.sqrt(M.diagonal())
    noise = len(X) * ranks.EPS * float(np.linalg.cond(M / np.outer(root, root)))
    if dt:
        noise = max(noise, ranks.EPS * (unit / dt + float(np.linalg.norm(A, 2))))
    to, back = from_x, to_x
    if dual:
        A, to, back = A.T, to_x.T, from_x.T
    B = ranks.unit_columns(to @ drive)
    inside: Array = np.eye(2 * nv)
    if known is not None and len(known):
        taken = known @ back
        taken /= np.linalg.norm(taken, axis=1, keepdims=True)
        inside = np.linalg.qr(taken.T, mode="complete")[0][:, len(known) :]
    inside, rest, margin = without_left_vectors(A, B, inside, 20.0 * noise)
    margin = margin.transformed(to_x[nv:, nv:], halved=True)
    fixed = ranks.FixedPoles(margin=margin)
    if rest.shape[1]:
        rates, vectors = np.linalg.eig(rest.T @ A @ rest)
        fixed = _fixed_poles(rates, unit, to_x @ rest @ vectors, dt, margin)
    return to_x @ inside, to_x @ rest, rest.T @ from_x, fixed


def without_left_vectors(
    A: Array, B: Array, inside: Array, tolerance: float
) -> tuple[Array, Array, ranks.Margin]:
    """Split a space of states into the part that the columns of B reach and the rest.

    `inside` (n, m) is an orthonormal basis of the space. A has a norm of about 1, and the columns
    of B have unit length. Return orthonormal bases of both parts, and the margin of the decisions.
    """
    # Orthogonal transformations split off left null vectors until none remain. For a defective
    # eigenvalue, the repeated steps split off the whole Jordan chain. A staircase algorithm is not
    # used, because it would carry the rounding error of an ill-conditioned step into the next step.
    rest: Array = np.zeros((len(inside), 0))
    margin = ranks.Margin()
    while inside.shape[1]:
        lost, step_margin = _left_vectors(
            inside.T @ A @ inside, inside.T @ B, tolerance
        )
        margin &= step_margin.transformed(inside)
        if not lost.shape[1]:
            break
        rest = np.hstack((rest, inside @ lost))
        inside = inside @ ranks.image(lost, 0.5)[1]
    return inside, rest, margin


def _fixed_poles(
    rates: Values, unit: float, shapes: Values, dt: float, margin: ranks.Margin
) -> ranks.FixedPoles:
    """Return the poles of the uncontrollable or unobservable part, and whether they decay.

    `rates` (k,) are the eigenvalues of this part in the unit of time `unit` [s]. If dt is not 0,
    they are eigenvalues of (A - I)/dt, and the returned poles are eigenvalues of A. Column i of
    `shapes` (nx, k) is the motion with eigenvalue i. `margin` is the margin of the rank decisions.
    """
    poles: Values
    if dt:
        poles = 1.0 + dt * rates / unit
        decay = 1.0 - np.abs(poles)
    else:
        poles = rates / unit
        decay = -rates.real
    slowest = int(decay.argmin())
    fastest = int(decay.argmax())
    if dt and abs(poles[fastest]) < _DEAD:
        # This motion decays to rounding error within one sample. The samples cannot distinguish two
        # such motions, so the rank is undecided.
        margin &= _decision(1.0, shapes[:, fastest])
    ratio = max(float(decay[slowest]), 0.0) / ranks.DECAY
    return ranks.FixedPoles(
        poles=poles,
        decays=bool(decay[slowest] > ranks.DECAY),
        margin=margin,
        settling=_decision(ratio, shapes[:, slowest]),
    )


def _decision(ratio: float, state: Values) -> ranks.Margin:
    """Return the margin of one decision about a motion `state` (nx,).

    The motion is reported by its positions (nv,) or by its rates (nv,), whichever are larger.
    """
    decision = ranks.Margin((ranks.Decision(ratio, state),))
    return decision.transformed(1.0, halved=True)


def _left_vectors(A: Array, B: Array, tolerance: float) -> tuple[Array, ranks.Margin]:
    """Return a basis (m, k) of the left eigenvectors of A that are orthogonal to the columns of B.

    The basis is real and orthonormal. The second result is the margin of the rank decisions.
    """
    from scipy.linalg import eig

    poles, left = eig(A, left=True, right=False)
    missed_by_inputs = np.linalg.norm(left.conj().T @ B, axis=1) < _SUSPICIOUS
    distances = np.abs(poles[:, None] - poles) + np.eye(len(A))
    near = missed_by_inputs | (distances.min(axis=1) < _SUSPICIOUS)
    # Rounding splits a defective zero eigenvalue into several poles, so zero itself is tested
    # first.
    candidates = [0j, *poles[(poles.imag >= 0.0) & near]]
    basis: Array = np.zeros((len(A), 0))
    margin, known = ranks.Margin(), np.zeros(0, dtype=complex)
    for start in candidates:
        pole = complex(start)
        for _ in range(_REFINEMENTS):
            at = pole.real if abs(pole.imag) < _SAME_POLE else pole
            U, values, _ = np.linalg.svd(np.hstack((A - at * np.eye(len(A)), B)))
            last = U[:, -1]
            refined = complex(last.conj() @ A @ last)
            if not pole or abs(refined - pole) < ranks.EPS or values[-1] > _SUSPICIOUS:
                break
            pole = refined
        if (np.abs(known - at) < _SAME_POLE).any():
            continue
        rank = int((values > tolerance).sum())
        single = abs(at.imag) <= _SAME_POLE
        states = 1 if single else 2
        margin &= ranks.judged(values / tolerance, U, rank, states)
        vectors = U[:, rank:]
        if not vectors.shape[1]:
            continue
        known = np.append(known, at)
        parts = np.real(vectors)
        if not single:
            parts = np.hstack((vectors.real, vectors.imag))
        # Poles that differ only by rounding error have the same left vectors, so only new
        # directions are added.
        new = parts - basis @ (basis.T @ parts)
        basis = np.hstack((basis, ranks.image(new, _SUSPICIOUS)[0]))
    return basis, margin


def unobservable(
    system: SecondOrder, position: ranks.Noisy, velocity: ranks.Noisy, dt: float
) -> tuple[Array, tuple[tuple[complex, Values], ...], ranks.FixedPoles] | None:
    """Return the motions for which ``position @ s + velocity @ ds/dt`` stays zero.

    At each nonzero pole p, the shapes of these motions are the null space of
    :math:`[p^2 M + p D + K; C_s + p C_v]`, where C_s is `position` and C_v is `velocity`. Return
    three results:

    - a basis (2 nv, k) of these motions (s, ds/dt);
    - the nonzero poles of these motions in continuous time, one of each conjugate pair, each with
      its m mode shapes (nv, m);
    - the fixed poles.

    Return None if the test is inconclusive, that is, if K or D is not symmetric, D is indefinite,
    sampling aliases two poles, or a pole is defective.
    """
    # A motion with the pole zero has the position s + t v at the time t, with K s = K v = D v = 0.
    # Such a motion is unobservable if C_s v = 0 and C_s s + C_v v = 0. With C_s = S^T and C_v = 0,
    # this function also finds the motions that the input matrix S does not control, because M, D
    # and K are symmetric.
    if not system.is_symmetric_and_semidefinite:
        return None
    starts, margin = system.poles
    # Sampling may map two poles to one, or a vibration to the pole z = 1.
    s = np.concatenate((starts, np.conj(starts), [0.0])) * dt
    apart = s[:, None] - s
    turns = np.round(apart.imag / (2.0 * np.pi))
    if ((turns != 0.0) & (np.abs(apart - 2j * np.pi * turns) < _ALIASED)).any():
        return None
    none, empty = (
        ranks.Noisy.exact(np.zeros_like(m)) for m in (system.M, position.values)
    )
    rows = [[system.K, none], [none, system.K], [none, system.D], [empty, position]]
    fast = np.abs(velocity.values).max(initial=0.0)
    slow = np.abs(position.values).max(initial=0.0)
    unit = 1.0
    if fast and slow:
        unit = slow / fast
    scale = np.concatenate((1.0 / system.size, unit / system.size))
    seen = ranks.stacked([*rows, [position, velocity]])
    basis, at_origin = ranks.null_space(seen @ np.diag(scale))
    margin = at_origin.transformed(1.0 / system.size, halved=True) & margin
    at_zero = basis * scale[:, None]
    motions = [at_zero]
    poles = [0j] * at_zero.shape[1]
    decays: list[ranks.Decision] = []
    missed: list[tuple[complex, Values]] = []
    for start in starts:
        shapes, pole, certain = _missed_shapes_at(
            system, position, velocity, complex(start)
        )
        if any(abs(pole - other) < _SAME_POLE * abs(pole) for other, _ in missed):
            continue
        margin &= certain
        if not shapes.shape[1]:
            continue
        # If a pole has fewer independent eigenvectors than its multiplicity, the test is
        # inconclusive.
        D = system.D.values
        sizes = np.abs(shapes)
        change = shapes.T @ (2.0 * pole * system.M + D) @ shapes
        size = sizes.T @ (2.0 * abs(pole) * np.abs(system.M) + np.abs(D)) @ sizes
        least = np.linalg.svd(change, compute_uv=False)[-1]
        if not least > _DEFECTIVE * np.linalg.norm(size):
            return None
        missed.append((pole, shapes))
        motion = np.vstack((shapes, pole * shapes))
        motions.append(motion.real)
        poles += [pole] * shapes.shape[1]
        if pole.imag:
            motions.append(motion.imag)
            poles += [pole.conjugate()] * shapes.shape[1]
        decay = max(-pole.real / abs(pole) / (1e2 * ranks.EPS * len(system.M)), 0.0)
        decays.append(ranks.Decision(decay, shapes[:, 0]))
    if _nearly_equal([pole for pole, _ in missed]):
        return None
    slowest = [] if at_zero.shape[1] else sorted(decays, key=itemgetter(0))[:1]
    fixed_poles: Values = np.array(poles)
    if dt:
        fixed_poles = np.exp(fixed_poles * dt)
    fixed = ranks.FixedPoles(
        poles=fixed_poles,
        decays=not at_zero.shape[1] and all(one.ratio > 1.0 for one in slowest),
        margin=margin,
        settling=ranks.Margin(tuple(slowest)),
    )
    return np.hstack(motions), tuple(missed), fixed


def _nearly_equal(poles: list[complex]) -> bool:
    """Return whether two of the poles, or a pole and its complex conjugate, nearly coincide."""
    near = [
        abs(a - b) < _DEFECTIVE * abs(a) for i, a in enumerate(poles) for b in poles[:i]
    ]
    near += [0.0 < pole.imag < _DEFECTIVE * abs(pole) for pole in poles]
    return any(near)


def _missed_shapes_at(
    system: SecondOrder, position: ranks.Noisy, velocity: ranks.Noisy, pole: complex
) -> tuple[Values, complex, ranks.Margin]:
    """Return the unobservable shapes (nv, k) at a pole, the refined pole, and the rank margin."""
    M, K, D = system.M, system.K.values, system.D.values
    for step in range(2 * _REFINEMENTS):
        # Scale each coordinate by the size of its terms in s^2 M + s D + K, so that a slow mode
        # keeps its accuracy next to a fast mode.
        s = pole if pole.imag else pole.real
        size = abs(s)
        weight = np.sqrt(
            size**2 * M.diagonal() + size * np.abs(D.diagonal()) + np.abs(K.diagonal())
        )
        units = np.outer(weight, weight)
        spread = 4.0 * ranks.EPS * size**2 * np.outer(system.size, system.size)
        spread = (spread + size * system.D.noise + system.K.noise) / units
        noise = (position.noise + size * velocity.noise) / weight
        pencil = (s * s * M + s * D + K) / units
        seen = (position.values + s * velocity.values) / weight
        stack = np.vstack((pencil, seen)), np.vstack((spread, noise))
        states = 2 if pole.imag else 1
        values, vectors, rank, margin = ranks.right_vectors(*stack, states)
        shapes = vectors / weight[:, None]
        refined = _root(system, shapes[:, -1], pole)
        moved = abs(refined - pole) / size
        if not 4.0 * ranks.EPS < moved < _NEAR or (step and values[-1] > _SUSPICIOUS):
            break
        pole = refined
    return shapes[:, rank:], pole, margin.transformed(1.0 / weight)


def _root(system: SecondOrder, shape: Values, near: complex) -> complex:
    """Solve the quadratic equation of a mode shape for the pole nearest to `near`."""
    left = shape
    if abs(shape @ system.M @ shape) < 0.1 * abs(shape.conj() @ system.M @ shape):
        left = shape.conj()  # shape^T M shape may vanish if two poles are equal
    a, b, c = (left @ X @ shape for X in (system.M, system.D.values, system.K.values))
    root = np.sqrt(complex(b * b - 4.0 * a * c))
    if not (np.conj(b) * root).real >= 0.0:
        root = -root
    q = -(b + root) / 2.0
    roots = [q / a, c / q] if q else [0j]
    refined = complex(min(roots, key=lambda value: abs(value - near)))
    if not near.imag:
        return complex(refined.real)
    if not system.D.values.any():
        return complex(0.0, refined.imag)
    return refined
