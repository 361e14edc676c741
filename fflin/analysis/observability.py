"""Observability of a linear model, with the names of the unobservable motions, and Gramians."""

from dataclasses import dataclass

import numpy as np

from fflin.analysis import along_motion, mechanics, moving_points
from fflin.analysis.hautus import split_by_poles, unobservable
from fflin.analysis.ranks import (
    DECAY,
    FROZEN,
    GRAMIAN,
    FixedPoles,
    Margin,
    RankAnalysis,
    echelon,
    lasting,
    verdict,
)
from fflin.base import html
from fflin.base.errors import InputError, listed
from fflin.base.validation import Array, FrozenArrays, Values, instance, positive
from fflin.dynamics.integrators import held_cost
from fflin.linear.linear_trajectory import LinearTrajectory
from fflin.linear.model import LinearModel, refuse_frozen


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Observability(RankAnalysis):
    """Observability of a linear model; ``print`` shows a summary.

    Attributes
    ----------
    dimension : int
        Number of states nx minus the dimension of the unobservable subspace.
    bound : int
        Largest possible dimension along the motion. It equals `dimension`, unless `method` is
        "frozen".
    duration : float
        Duration [s] of the analysed trajectory; 0 for the model of one operating point.
    unobservable : tuple of str
        Names of the unobservable motions; each is a state or a combination of states.
    basis : ndarray (nx, nx - dimension)
        Unobservable motions, one column each.
    rows : ndarray (dimension, nx)
        Observable combinations of states. The unobservable subspace is the set of all x with
        ``rows @ x = 0``.
    fixed_poles : ndarray (nx - dimension,)
        Poles of the estimation error that no observer can move: [1/s] for a continuous model,
        discrete-time poles z for a sampled one. Empty for a trajectory, which has no poles.
    detectable : bool or None
        Whether all fixed poles are stable. At a point that the robot leaves, and along a
        trajectory: True if the outputs determine all states, False if they do not depend on the
        position of the base, and None if this is undecided.
    method : str
        Method that determined the dimension: "closed form", "eigenvalues", "frozen" or "Gramian",
        as in `Controllability`.
    margin : Margin
        Certainty of the rank decisions, as in `Controllability`.
    notes : tuple of str
        Ranks that rounding error leaves undecided.

    Examples
    --------
    >>> robot = fflin.load("cubesat", outputs=[fflin.Gyroscope("base")])
    >>> fflin.observability(fflin.linearize(robot)).unobservable[:3]
    ('q_b.x', 'q_b.y', 'q_b.z')
    """

    unobservable: tuple[str, ...]
    detectable: bool | None

    def _lines(self) -> list[str]:
        lines = list[str]()
        if self.unobservable:
            lines.append(f"unobservable: {', '.join(self.unobservable)}")
        parts = ("position", "velocity", "attitude")[
            : (len(self.basis) - self.bound) // 3
        ]
        limit = f"no output depends on the {listed(parts)} of the base"
        decays = verdict(self.detectable, "detectable")
        return [self._head("observable", limit, decays), *lines]


def observability(lin: LinearModel | LinearTrajectory) -> Observability:
    r"""Determine the observable subspace from C and the structure of A.

    At rest, observability is tested in second-order form, :math:`M a + D v + K s = 0` with damping
    D and stiffness K, by the null space of :math:`[p^2 M + p D + K; C_s + p C_v]` at each pole p.
    Here :math:`C_s` and :math:`C_v` are the columns of C for the positions s and the velocities v.
    All poles at p = 0 are tested together. In a steady motion, observability is tested as the
    controllability of the dual pair :math:`(A^T, C^T)`, with states scaled to units of energy, as
    in `controllability`. The unobservable subspace is the orthogonal complement of the controllable
    subspace of the dual pair.

    At any other point, A and C change along the motion. The dynamics do not depend on the position,
    velocity and attitude of the base, so these are unobservable, in motion as at rest, if the
    outputs do not depend on them. If the outputs determine all positions at once, all states are
    observable. Otherwise the rest is tested with A and C frozen at the operating point, and the
    result is never detectable. Along a trajectory, the rank of the finite-horizon observability
    Gramian is found, with the outputs at the knots. The result describes the errors at the first
    knot that the outputs determine.

    Parameters
    ----------
    lin : LinearModel or LinearTrajectory
        Linear model: continuous or sampled, full or reduced. A model loaded from a file is also
        accepted. A `LinearTrajectory` is analysed over its whole duration, or over its period.

    Returns
    -------
    Observability
        Dimension of the observable part, and basis and names of the unobservable motions.

    Raises
    ------
    InputError
        If `lin` is not a `LinearModel` or `LinearTrajectory`, or its states are not positions
        followed by their rates.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.JointPositions()])
    >>> found = fflin.observability(fflin.linearize(robot))
    >>> found.dimension, found.detectable
    (6, False)
    """
    if isinstance(lin, LinearTrajectory):
        return _along(lin)
    lin = mechanics.of_robot(lin)
    refuse_frozen(lin, "observability")
    if not lin.is_equilibrium():
        return _in_motion(lin)
    nv = len(lin.M)
    source = mechanics.at_rest(lin)
    method = "eigenvalues"
    motions = None
    if source is not None:
        system = mechanics.second_order(source)
        N = mechanics.rates_of_positions(mechanics.rate_matrix(source))
        C = np.hstack((lin.C[:, :nv] @ N, lin.C[:, nv:]))
        shown = mechanics.outputs_without_rounding(lin, C)
        position, velocity = shown.columns(slice(0, nv)), shown.columns(slice(nv, None))
        if hidden := unobservable(system, position, velocity, lin.dt):
            motions, _, fixed = hidden
            motions = np.vstack((N @ motions[:nv], motions[nv:]))
            if not system.acting:
                method = "closed form"
    if motions is None:
        # The unobservable subspace is the uncontrollable part of the dual pair (A^T, C^T).
        X = mechanics.rate_matrix(lin)
        _, motions, _, fixed = split_by_poles(X, lin.C.T, lin.M, lin.dt, dual=True)
    dimension = len(lin.A) - motions.shape[1]
    return _result(
        lin,
        motions,
        bound=dimension,
        fixed_poles=fixed.poles,
        detectable=fixed.decays,
        method=method,
        margin=fixed.margin,
        notes=(
            *moving_points.steadiness(lin),
            *mechanics.undecided(lin, fixed, "observable", dimension, "detectable"),
        ),
    )


def _in_motion(lin: LinearModel) -> Observability:
    """Determine the observable subspace at a point that is not an equilibrium.

    The motions that symmetries make unobservable are exact. Unless the outputs determine all
    states at once, the rest is decided by A and C at this point, as in `controllability`.
    """
    nx = len(lin.A)
    notes = moving_points.steadiness(lin)
    margin = moving_points.all_coordinates_measured(lin)
    if margin is not None:
        return _result(
            lin,
            np.zeros((nx, 0)),
            bound=nx,
            fixed_poles=np.zeros(0),
            detectable=True,
            method="closed form",
            margin=margin,
            notes=(moving_points.NOTE_AT_ONCE, *notes),
        )
    known = moving_points.unobserved(lin)
    X = mechanics.rate_matrix(lin)
    _, others, _, fixed = split_by_poles(
        X, lin.C.T, lin.M, lin.dt, known=known.T, dual=True
    )
    motions = np.hstack((known, others))
    # the frozen poles do not decide about decay
    fixed = fixed._replace(settling=Margin())
    undecided = mechanics.undecided(lin, fixed, "observable", nx - motions.shape[1])
    detectable = False if known.shape[1] else None
    return _result(
        lin,
        motions,
        bound=nx - known.shape[1],
        fixed_poles=np.concatenate(
            (moving_points.constant_poles(known.shape[1], lin.dt), fixed.poles)
        ),
        detectable=detectable,
        method=FROZEN,
        margin=fixed.margin,
        notes=(moving_points.NOTE, *notes, *undecided),
    )


def _along(traj: LinearTrajectory) -> Observability:
    """Determine which errors at the start of a trajectory can be computed from its outputs."""
    first, _ = along_motion.ends(traj)
    # Motions that are unobservable by symmetry, such as a displacement of the whole robot. The
    # largest entries of C along the trajectory show on which states the outputs depend.
    largest_C = np.abs(traj.C).max(axis=0)
    by_symmetry = moving_points.unobserved(first, largest_C)
    # Motions outside the image of the observability Gramian.
    split = along_motion.seen(traj, by_symmetry)
    by_gramian = split.to_x @ split.rest
    motions = np.hstack((by_symmetry, by_gramian))
    nx, unobservable_count = motions.shape
    dimension = nx - unobservable_count
    fixed = FixedPoles(margin=split.margin)
    # Motions that are unobservable by symmetry never decay. The Gramian does not show whether the
    # other unobservable motions decay.
    detectable: bool | None = True
    if by_gramian.size:
        detectable = None
    if by_symmetry.size:
        detectable = False
    return _result(
        first,
        motions,
        bound=dimension,
        duration=float(traj.t[-1] - traj.t[0]),
        fixed_poles=np.zeros(0),
        detectable=detectable,
        method=GRAMIAN,
        margin=split.margin,
        notes=mechanics.undecided(first, fixed, "observable", dimension),
    )


def _result(
    lin: LinearModel,
    motions: Array,
    *,
    bound: int,
    fixed_poles: Values,
    detectable: bool | None,
    method: str,
    margin: Margin,
    notes: tuple[str, ...],
    duration: float = 0.0,
) -> Observability:
    """Return the result for the unobservable motions (nx, k)."""
    size = np.tile(np.sqrt(lin.M.diagonal()), 2)
    basis, _ = echelon(motions, size)
    nx, count = basis.shape
    complement = np.linalg.qr(basis * size[:, None], mode="complete")[0][:, count:]
    return Observability(
        dimension=nx - count,
        bound=bound,
        duration=duration,
        unobservable=tuple(
            mechanics.combination(column, lin.state_names, size) for column in basis.T
        ),
        basis=basis,
        rows=complement.T * size,
        fixed_poles=fixed_poles,
        detectable=detectable,
        method=method,
        margin=margin,
        notes=notes,
        robot=lin.robot,
    )


def lasting_motions(lin: LinearModel, analysis: Observability) -> tuple[str, ...]:
    """Name the unobservable motions of an analysis that do not decay by themselves."""
    size = np.tile(np.sqrt(lin.M.diagonal()), 2)
    basis = analysis.basis * size[:, None]
    # The motions span an invariant subspace: A basis = basis F.
    rate = size[:, None] * mechanics.rate_matrix(lin) / size
    F = np.linalg.pinv(basis) @ rate @ basis
    motions = lasting(F, lin.dt)
    if motions.shape[1] in (0, len(F)):
        return analysis.unobservable
    lasts, _ = echelon(analysis.basis @ motions, size)
    return tuple(
        mechanics.combination(column, lin.state_names, size) for column in lasts.T
    )


@dataclass(frozen=True, eq=False, repr=False)
class Gramians(FrozenArrays):
    """Controllability and observability Gramians of a linear model.

    Attributes
    ----------
    controllability : ndarray (nx, nx)
        Gramian W_c. The least input energy that moves the state from 0 to x is ``x^T W_c^-1 x``.
    observability : ndarray (nx, nx)
        Gramian W_o. The output energy of the free response from the initial state x is
        ``x^T W_o x``.
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

    def __repr__(self) -> str:
        return f"Gramians(nx={len(self.controllability)}, duration={self.duration:g} s)"

    def _repr_html_(self) -> str:
        return html.result_card(self)


def gramians(lin: LinearModel, duration: float | None = None) -> Gramians:
    r"""Compute the controllability and observability Gramians.

    .. math::
        W_c = \int_0^T e^{A t} B B^T e^{A^T t}\,dt, \quad
        W_o = \int_0^T e^{A^T t} C^T C e^{A t}\,dt.

    For a sampled model, sums over the samples replace the integrals. For an infinite horizon, the
    Gramians are the solutions of Lyapunov equations. For a finite horizon T, the Gramians are
    polynomials in T if :math:`A^2 = 0`, for example at rest without springs. In all other cases,
    the Gramians are computed for a short horizon, and this horizon is doubled until it equals T, by
    :math:`W_c(2 t) = W_c(t) + e^{A t} W_c(t) e^{A^T t}`.

    Parameters
    ----------
    lin : LinearModel
        Continuous or sampled model.
    duration : float, optional
        Horizon T [s]; a multiple of dt for a sampled model. By default the horizon is infinite,
        which requires an asymptotically stable model. A model with a free base is never
        asymptotically stable, so it requires a finite horizon.

    Returns
    -------
    Gramians
        Both Gramians and their horizon.

    Raises
    ------
    InputError
        If `duration` is not positive or not a multiple of dt, or if `duration` is omitted for a
        model that is not asymptotically stable.

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
    refuse_frozen(lin, "gramians")
    pairs = ((lin.A, lin.B), (lin.A.T, lin.C.T))
    if duration is None:
        poles = np.linalg.eigvals(lin.A)
        size = float(np.abs(poles).max())
        growth = float(poles.real.max())
        allowed = -DECAY * size
        slow = f"at {growth:.3g} 1/s"
        if lin.dt:
            growth = size - 1.0
            allowed = -DECAY
            slow = f"of modulus {size:.6g}"
        if growth >= allowed:
            raise InputError(
                f"the model is not asymptotically stable (a pole {slow}), so its infinite-time "
                "Gramians are not finite; give duration= for finite-time Gramians"
            )
    else:
        duration = positive("duration", duration, "s")
    with np.errstate(over="ignore", invalid="ignore"):
        matrices = [_gramian(A, B @ B.T, lin.dt, duration) for A, B in pairs]
    if not all(np.isfinite(W).all() for W in matrices):
        raise InputError(
            f"duration is {duration:g} s, over which the state transition matrix overflows; give "
            "a shorter duration"
        )
    reach, show = (0.5 * (W + W.T) for W in matrices)
    span = np.inf if duration is None else duration
    return Gramians(reach, show, span)


def _gramian(A: Array, Q: Array, dt: float, duration: float | None) -> Array:
    if duration is None:
        from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov

        W: Array = (
            solve_discrete_lyapunov(A, Q) if dt else solve_continuous_lyapunov(A, -Q)
        )
        return W
    if not dt:
        return held_cost(A.T, Q, duration)
    steps = round(duration / dt)
    if not steps or abs(steps * dt - duration) > 1e-9 * duration:
        raise InputError(
            f"duration is {duration:g} s, expected a multiple of dt = {dt:g} s"
        )
    # Sum A^k Q (A^k)^T over k < steps by repeated doubling.
    total, power = np.zeros_like(Q), np.eye(len(A))
    while steps:
        if steps & 1:
            total = total + power @ Q @ power.T
            power = power @ A
        Q, A = Q + A @ Q @ A.T, A @ A
        steps >>= 1
    return total
