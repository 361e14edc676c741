"""Linear models in the second-order form M a + D v + K s = S u, and their conserved momenta."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fflin.analysis import ranks
from fflin.base.errors import FflinWarning, InputError
from fflin.base.validation import Array, Indices, Values, instance
from fflin.linear.model import LinearModel, refuse_delayed, refuse_fixed

# K or D counts as not symmetric if its relative asymmetry exceeds this. D counts as indefinite if
# it has eigenvalues of both signs whose moduli exceed this fraction of the largest modulus.
_SYMMETRIC = 1e-8

# Largest residual of L2 A = L1 in (9.2) that counts as rounding, relative to the largest entry of
# L1. If the residual is larger, the operating point is in motion, and the momenta are not the rates
# of any coordinates.
_CONSISTENT = 1e-8

# A spin leaves rounding errors in K and D. In units of energy, the error of K is this number times
# the squared spin rate, and the error of D is this number times the spin rate.
_OF_SPIN = 1e-15

# Let r be the orbital rate divided by the frequency of the fastest vibration. In A, orbital effects
# are about r^2 times as large as the stiffness of this vibration. If r is below _SLOWEST, r^2 is
# close to rounding error.
_SLOWEST = 3e-6


def checked(lin: LinearModel) -> LinearModel:
    """Return the model, or raise `InputError` if its states are not positions and their rates.

    Also raise `InputError` if A, B, C or D has entries that are not finite. Warn if the orbital
    effects in A may be lost in rounding errors.
    """
    instance("lin", lin, LinearModel, "a fflin.LinearModel")
    lin.require_unchanged()
    refuse_delayed(lin, "this analysis")
    refuse_fixed(lin, "this analysis")
    nx = len(lin.A)
    if lin.M.shape != (nx // 2, nx // 2) or nx % 2:
        raise InputError(
            f"the model has {nx} states and an inertia of shape {lin.M.shape}, expected half as "
            "many rows as states; make the model with linearize or momentum_reduction"
        )
    for name in "ABCD":
        if not np.isfinite(getattr(lin, name)).all():
            raise InputError(f"{name} of the model has entries that are not finite")
    # Orbital effects in A may be smaller than the rounding errors that a fast vibration causes.
    nv, size = len(lin.M), np.sqrt(lin.M.diagonal())
    fastest = (
        float((np.abs(rate_matrix(lin)[nv:, :nv]) * size[:, None] / size).max()) ** 0.5
    )
    if 0.0 < lin.mean_motion < _SLOWEST * fastest:
        warnings.warn(
            f"orbital effects on '{lin.robot}' at {lin.mean_motion:.3g} rad/s are smaller than "
            f"the rounding error of joint vibrations at {fastest:.3g} rad/s, so the result may "
            "miss the orbital effects; lock the joints that vibrate",
            FflinWarning,
            stacklevel=3,
        )
    return lin


def of_robot(lin: LinearModel) -> LinearModel:
    """Return the model without delays of its inputs, checked; see `checked`."""
    return checked(instance("lin", lin, LinearModel, "a fflin.LinearModel").undelayed)


def rate_matrix(lin: LinearModel) -> Array:
    """Return A, or (A - I)/dt of a sampled model, which has the same invariant subspaces."""
    if not lin.dt:
        return lin.A
    return (lin.A - np.eye(len(lin.A))) / lin.dt


def floating_inertia(M: Array, kept: Indices, others: Indices) -> Array:
    """Return the Schur complement of M with respect to the coordinates `others`.

    This matrix is the inertia of the coordinates `kept` if no force acts on the other coordinates.
    """
    across = M[np.ix_(others, kept)]
    return M[np.ix_(kept, kept)] - across.T @ np.linalg.solve(
        M[np.ix_(others, others)], across
    )


@dataclass(frozen=True)
class SecondOrder:
    """Matrices of M a + D v + K s = S u, in coordinates s whose rates are the velocities v."""

    M: Array
    K: ranks.Noisy
    D: ranks.Noisy
    S: ranks.Noisy  # (nv, nu)

    @cached_property
    def size(self) -> Array:
        """Square roots (nv,) of the diagonal of M, which scale forces and speeds to equal units."""
        return np.sqrt(self.M.diagonal())

    def restricted(self, R: Array) -> SecondOrder:
        """Return the system in the coordinates z, for motions that are constrained to s = R z."""
        M = R.T @ self.M @ R
        K, D = ((forces @ R).after(R.T) for forces in (self.K, self.D))
        return SecondOrder(M, K, D, self.S.after(R.T))

    @property
    def acting(self) -> bool:
        """Whether K or D has nonzero entries, for example from springs or dampers."""
        return bool(self.K.values.any() or self.D.values.any())

    @cached_property
    def is_symmetric_and_semidefinite(self) -> bool:
        """Whether K and D are symmetric, and D is positive or negative semidefinite."""
        units = np.outer(self.size, self.size)
        K = self.K.values / units
        D = self.D.values / units
        for matrix in (K, D):
            asymmetry = np.abs(matrix - matrix.T).max(initial=0.0)
            if asymmetry > _SYMMETRIC * np.abs(matrix).max():
                return False
        eigenvalues = np.linalg.eigvalsh(D)
        rounding = _SYMMETRIC * np.abs(eigenvalues).max()
        is_positive = eigenvalues.min() >= -rounding
        is_negative = eigenvalues.max() <= rounding
        return bool(is_positive or is_negative)

    @cached_property
    def poles(self) -> tuple[Values, ranks.Margin]:
        """Approximate nonzero poles, one of each conjugate pair.

        The second item is the margin of the rank decisions on K and D.
        """
        scale = 1.0 / self.size
        rigid, margin = ranks.null_space(ranks.stacked([[self.K], [self.D]]), scale)
        unloaded, other = ranks.null_space(self.K, scale)
        part = self.restricted(
            ranks.null_space(ranks.Noisy.exact(rigid.T @ self.M), scale)[0]
        )
        r = len(part.M)
        L = np.linalg.inv(np.linalg.cholesky(part.M))
        K, D = L @ part.K.values @ L.T, L @ part.D.values @ L.T
        zeros = unloaded.shape[1] - rigid.shape[1]
        if D.any():
            fastest = max(np.linalg.norm(K, 2) ** 0.5, np.linalg.norm(D, 2))
            A = np.block(
                [[np.zeros((r, r)), np.eye(r)], [-K / fastest**2, -D / fastest]]
            )
            poles = np.linalg.eigvals(A) * fastest
        else:
            roots = np.sqrt(-np.linalg.eigvalsh((K + K.T) / 2.0).astype(complex))
            poles = np.concatenate((roots, -roots))
            zeros = 2 * zeros
        poles = poles[np.argsort(np.abs(poles))][zeros:]
        return poles[poles.imag >= 0.0], margin & other


def second_order(lin: LinearModel) -> SecondOrder:
    """Return the second-order form of a model, continuous or sampled."""
    # K, D and S are products with M, so rounding errors remain in entries that should be zero.
    # `without_rounding` sets an entry to zero if it is clearly below a bound on its rounding error.
    # For K and D, this bound is at least a fraction of the largest entry of the matrix, in units of
    # energy. For S, the norm of the column replaces the largest entry.
    nv = len(lin.M)
    M = lin.M
    X = rate_matrix(lin)
    size, N = np.sqrt(M.diagonal()), rates_of_positions(X)
    rates = np.hstack((X[nv:], lin.B[nv:]))
    spread = 4.0 * nv * ranks.EPS * np.abs(rates)
    if lin.dt:
        # In a matrix exponential, each entry has the rounding error of the largest entry.
        spread[:, : 2 * nv] += (
            4.0 * nv * ranks.EPS * np.abs(lin.A).max() / lin.dt * (X[nv:] != 0.0)
        )
    noise = np.abs(M) @ spread
    # In a spin, forces that balance each other leave rounding errors in K and D. If no other forces
    # act, the size of these errors cannot be seen in K and D. It is therefore estimated from
    # `spin`, the largest angular rate of the base and the joints.
    turns = [
        x for x, unit in zip(lin.x0, lin.state_units, strict=True) if unit == "rad/s"
    ]
    spin = float(np.abs(turns).max(initial=0.0))
    units = _units_of_spin(lin, size)
    noise[:, :nv] += _OF_SPIN * np.outer(units, units) * spin**2
    noise[:, nv : 2 * nv] += _OF_SPIN * np.outer(units, units) * spin
    forces = ranks.Noisy(M @ rates, noise)
    K, D, S = map(
        forces.columns, (slice(0, nv), slice(nv, 2 * nv), slice(2 * nv, None))
    )
    # The norm of each column of S sets the threshold for the entries of this column.
    column_sizes = ranks.divisors(np.linalg.norm(S.values / size[:, None], axis=0))
    return SecondOrder(
        M=M,
        K=ranks.without_rounding(K @ -N, size, size),
        D=ranks.without_rounding(D @ -np.eye(nv), size, size),
        S=ranks.without_rounding(S, size, column_sizes),
    )


def outputs_without_rounding(lin: LinearModel, C: Array | None = None) -> ranks.Noisy:
    """Return C (ny, nx), or another matrix with the same rows, without its rounding errors."""
    C = lin.C if C is None else C
    size = np.tile(np.sqrt(lin.M.diagonal()), 2)
    units = ranks.divisors(np.linalg.norm(C / size, axis=1))
    return ranks.without_rounding(
        ranks.Noisy(C, 4.0 * ranks.EPS * np.abs(C)), units, size
    )


def _units_of_spin(lin: LinearModel, size: Array) -> Array:
    """Return the square roots (nv,) of the inertias that determine the rounding errors of a spin.

    `size` (nv,) contains the square roots of the diagonal of M. The entry of a wheel contains only
    the inertia about the wheel's axis. But the dynamics are computed with the inertia of its body
    about the origin of the base, which may be a thousand times larger. This inertia is at most the
    largest moment of inertia of the whole robot.
    """
    names = lin.state_names[: len(size)]
    wheels = {f"q_m.{name}" for name in lin.wheels}
    spins = np.array([name in wheels for name in names])
    turns = np.array(lin.state_units[-len(size) :]) == "rad/s"
    return np.where(spins, size[turns].max(initial=0.0), size)


def at_rest(lin: LinearModel) -> LinearModel | None:
    """Return the continuous model of `lin`, or `lin` itself if no continuous model is known.

    Return None if the result would not be a second-order system.
    """
    # A continuous model is a second-order system if the rates of the positions depend on the
    # velocities alone. A sampled model without a known continuous model is accepted only if no
    # force depends on the state: (A - I)/dt then has the structure of a continuous model.
    source = lin.generator or lin
    nv = len(lin.M)
    X = rate_matrix(source)
    if X[:nv, :nv].any() or (source.dt and X[nv:].any()):
        return None
    return source


def rates_of_positions(X: Array) -> Array:
    """Return N (nv, nv) in dp/dt = N nu, for positions p and velocities nu.

    If sampling makes N ill-conditioned, return the identity instead.
    """
    nv = len(X) // 2
    N = X[:nv, nv:]
    if np.linalg.cond(N) < 1e6:
        return N
    return np.eye(nv)


def energy_units(M: Array, N: Array) -> tuple[Array, Array]:
    """Return the matrices (nx, nx) between states x = to_x xi and states xi in units of energy.

    Velocities nu become L^T nu with M = L L^T, so the squared length of L^T nu is twice the kinetic
    energy. Positions p with dp/dt = N nu become L^T N^-1 p. The second result is the inverse.
    """
    L, zero = np.linalg.cholesky(M), np.zeros_like(M)
    to_velocity = np.linalg.inv(L.T)
    to_x = np.block([[N @ to_velocity, zero], [zero, to_velocity]])
    from_x = np.block([[L.T @ np.linalg.inv(N), zero], [zero, L.T]])
    return to_x, from_x


@dataclass(frozen=True)
class ConservedMomenta:
    """Conserved momenta L1 x, their integrals L2 x, and the coordinates without both.

    A momentum is conserved if no input, spring or damper changes it.
    """

    # W (k, nv) in echelon form, where W M nu are the conserved momenta. If the momentum of a single
    # coordinate is conserved, its row of W is a unit vector.
    weights: Array
    # L1, L2 (k, nx) with L1 A = 0, L2 A = L1 and L1 B = L2 B = 0. For a sampled model, A is
    # replaced by (A - I)/dt.
    momenta: Array
    coordinates: Array
    # (r,): indices of the kept coordinates. If L1 x = L2 x = 0, these coordinates and their rates
    # determine all other states.
    kept: Indices
    # (nx, 2 r): maps kept coordinates and rates to the state, if L1 x = L2 x = 0
    T: Array
    margin: ranks.Margin  # margin of the rank decision on r

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
    pushes = ranks.stacked([[system.K.T], [system.D.T], [system.S.T]])
    free, margin = ranks.null_space(pushes, 1.0 / size, states=2)
    # The echelon form makes a column of W^T a unit vector if the momentum of a single coordinate is
    # conserved.
    basis, pivots = ranks.echelon(free, size)
    W = basis.T
    momenta = W @ lin.M
    # Find L2: the coordinates whose rates are the momenta.
    X11, X12 = X[:nv, :nv], X[:nv, nv:]
    if not X11.any():
        coordinates = np.linalg.solve(X12.T, momenta.T).T
    else:
        wanted = np.hstack((momenta, np.zeros_like(momenta)))
        coordinates = np.linalg.lstsq(np.hstack((X12, X11)).T, wanted.T, rcond=None)[
            0
        ].T
    error = np.hstack((coordinates @ X12 - momenta, coordinates @ X11))
    if np.abs(error).max(initial=0.0) > _CONSISTENT * np.abs(momenta).max(initial=0.0):
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
    return ConservedMomenta(W, L1, L2, kept, T, margin)


# {group of velocities: (name of their momentum, name of the coordinate whose rate this momentum
# is)}.
_CONSERVED = {
    "omega_b": ("angular momentum", "base attitude"),
    "v_b": ("linear momentum", "base position"),
}
_OTHER = ("momentum of", "position of")

_AXIS = re.compile(r"(?<!\S)[xyz](?!\S)")


def momentum_names(lin: LinearModel, conserved: ConservedMomenta) -> tuple[str, ...]:
    """Name the conserved momenta, and then the coordinates whose rates are these momenta."""
    nv = len(lin.M)
    size = np.sqrt(lin.M.diagonal())
    rates = [name.split(".", 1) for name in lin.state_names[nv:]]
    momenta, driven = (
        tuple(f"{_CONSERVED.get(group, _OTHER)[i]} {member}" for group, member in rates)
        for i in (0, 1)
    )
    # If the other coordinates are fixed, the inputs cannot move the named coordinate. The inputs
    # may move it together with the others, so its name ends in "with the joints fixed" or "with the
    # rest fixed".
    of_joint = np.array([group == "qdot_m" for group, _ in rates])
    only_joints = of_joint[conserved.kept].all()
    of_base = not conserved.weights[:, of_joint].any()
    rest = "the joints" if only_joints and of_base else "the rest"
    return (
        *(combination(row, momenta, size) for row in conserved.weights),
        *(
            f"{combination(row, driven, size)} with {rest} fixed"
            for row in conserved.weights
        ),
    )


def grouped(names: tuple[str, ...]) -> list[str]:
    """Join names that differ only in their axis, for example to "angular momentum x/y/z"."""
    groups: dict[str, list[str]] = {}
    for name in names:
        axes = _AXIS.findall(name)
        if len(axes) == 1:
            key = _AXIS.sub("\0", name)
            groups.setdefault(key, []).extend(axes)
        else:
            groups.setdefault(name, [])
    return [key.replace("\0", "/".join(axes)) for key, axes in groups.items()]


def combination(
    weights: Array, names: tuple[str, ...], sizes: Array, most: int = 3
) -> str:
    """Format a linear combination of names.

    At most `most` terms are written, those with the largest ``abs(weights) * sizes``. The other
    terms are counted. The first term is positive, because the sign of a direction has no meaning.
    """
    shares = np.abs(weights) * sizes
    largest = float(shares.max())
    # Rounding must not decide the order of terms of the same size.
    order = [
        i
        for i in np.argsort(-np.round(shares / largest, 6), kind="stable")
        if weights[i]
    ]
    weights = weights * np.sign(weights[order[0]])
    shown = [i for i in order if abs(weights[i]) * sizes[i] > 1e-6 * largest]
    terms: list[str] = []
    for i in shown[:most]:
        value = f"{abs(weights[i]):.3g}"
        sign = "-" if weights[i] < 0.0 else "+"
        if terms:
            sign += " "
        factor = "" if value == "1" else f"{value} "
        terms.append(f"{sign}{factor}{names[i]}")
    if len(shown) > most:
        terms.append(f"+ {len(shown) - most} more")
    return " ".join(terms).removeprefix("+")


def undecided(
    lin: LinearModel, fixed: ranks.FixedPoles, what: str, count: int, settled: str = ""
) -> tuple[str, ...]:
    """Return notes on undecided ranks, and on the slowest motion if its decay is undecided."""
    notes = list[str]()
    for ratio, at, change in fixed.margin.doubts:
        decision = what if change < 0 else f"not {what}"
        notes.append(
            f"undecided: {shape(lin, at)} counts as {decision}, but the test value is only "
            f"{ratio:.1g} times its rounding error; {count} or {count + change} of {len(lin.A)} "
            f"states are {what}"
        )
    decays = [
        f"undecided: {shape(lin, at)} may or may not decay by itself, because its decay rate is "
        f"only {ratio:.1g} times its rounding error; the model may or may not be {settled}"
        for ratio, at, _ in fixed.settling.doubts
    ]
    return (*notes, *decays)


def shape(lin: LinearModel, at: Values) -> str:
    """Describe a motion by its largest coordinates.

    The vector `at` (nv,), real or complex, contains the displacements or the rates of all
    coordinates in this motion.
    """
    size = np.sqrt(lin.M.diagonal())
    largest = at[int(np.abs(at * size).argmax())]
    of_base = {"omega_b": "rotation about ", "v_b": "translation along "}
    pairs = (name.partition(".") for name in lin.state_names[len(lin.M) :])
    names = tuple(
        of_base.get(group, "") + (member or group) for group, _, member in pairs
    )
    return combination(np.real(at / largest), names, size)
