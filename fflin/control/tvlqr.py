"""The linear quadratic regulator along a trajectory, over a finite horizon."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.base.errors import EquilibriumError, InputError, StabilizabilityError
from fflin.base.names import input_keys
from fflin.base.validation import Array, number
from fflin.control.differential_riccati import Coefficients, step_back
from fflin.control.gain_schedule import GainSchedule
from fflin.control.weights import Weight, weight
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.state import StateMap
from fflin.linear.sampling import GAUSS

if TYPE_CHECKING:
    from fflin.linear.linear_trajectory import LinearTrajectory
    from fflin.linear.model import LinearModel
    from fflin.linear.trajectory import Trajectory

# Between two knots P is a cubic; knots are added until it is this accurate, relative to P.
_ACCURACY = 1e-7
_KNOTS_LIMIT = 100_000
_TOO_FAST = "P changes too fast at {}; give smaller weights or a larger R"


def tvlqr(
    traj: LinearTrajectory,
    Q: Weight | None = None,
    R: Weight | None = None,
    Qf: Weight | str = "steady",
    sample: float | None = None,
    *,
    weights: str | None = None,
    rule: str = "as given",
) -> GainSchedule:
    r"""Return the regulator along a trajectory, over its finite horizon.

    From any time t to the end T it minimises

    .. math:: e(T)^T Q_f\,e(T) + \int_t^T e^T Q\,e + \delta u^T R\,\delta u\;d\tau.

    P of the differential Riccati equation :math:`-\dot P = A^T P + P A - P B R^{-1} B^T P + Q`,
    :math:`P(T) = Q_f`, is carried backwards from knot to knot by maps of the form
    :math:`P_0 = W + T^T P_1 (E + G P_1)^{-1} T` with W and G positive semidefinite, each of which
    comes from a short exponential by doubling: P stays positive semidefinite however long the
    horizon. The method is of order four in the trajectory's changes and exact where it does not
    change; knots are added until halving and interpolation agree to 1e-7.

    With `sample` it is the regulator of a computer that measures e every so often and holds
    :math:`\delta u` in between, at the same cost, by (10.1) and (10.3) along the motion.

    Parameters
    ----------
    traj : LinearTrajectory
    Q : array_like (nx, nx) or (nx,), float, or mapping, optional
        Weight on the error, as `lqr` takes it; positive semidefinite.
    R : array_like (nu, nu) or (nu,), float, or mapping, optional
        Positive definite.
    Qf : "steady", or as Q
        Weight on the error at the end. "steady" is the cost from there on of `lqr` about the robot
        at rest in the last configuration, or in its motion there if that is steady; what the
        inputs cannot hold is left out, see `momentum_reduction`.
    sample : float, optional
        Sampling time [s], of which the duration is a multiple.
    weights : {"urdf", "identity"}, optional
        Instead of Q and R: the rule of `lqr`, about that same point.
    rule : str
        What made Q and R, in words.

    Returns
    -------
    GainSchedule

    Raises
    ------
    InputError
        If a weight is of a wrong size or not positive (semi)definite, P changes so fast that
        the knots run out, or the sampling time does not divide the duration.
    UnknownNameError
        If a name does not exist.
    EquilibriumError, StabilizabilityError
        If Qf is "steady" and no inputs hold the robot there.

    References
    ----------
    W.-W. Lin and E. K.-W. Chu (with others), structure-preserving doubling algorithms, 2018.
    E. Celledoni, A. Marthinsen and B. Owren, Commutator-free Lie group methods, Future Generation
    Computer Systems 19(3), 2003.
    """
    from fflin.linear.linear_trajectory import LinearTrajectory

    if not isinstance(traj, LinearTrajectory):
        raise InputError(
            f"traj is a {type(traj).__name__}, expected a LinearTrajectory; "
            "fflin.linearize_trajectory makes one"
        )
    if traj.dt:
        raise InputError("traj is sampled; give the continuous one, and sample=")
    names, dt = traj.state_names, 0.0 if sample is None else number("sample", sample)
    steady = isinstance(Qf, str)
    if steady and Qf != "steady":
        raise InputError(f"Qf is {Qf!r}, expected 'steady' or a weight")
    by_rule = Q is None and R is None
    if not by_rule and (weights is not None or Q is None or R is None):
        raise InputError("give Q and R, both, or weights='urdf' or 'identity' without them")
    end: Any = steady_end(traj) if steady or by_rule else None
    given: list[Any] = [Q, R]
    if by_rule:
        from fflin.control.default_weights import rule_weights

        *given, _, rule = rule_weights(end, weights, hold=dt)
    Q = weight("Q", given[0], names)
    R = weight("R", given[1], input_keys(Actuation(StateMap(traj.robot))), definite=True)
    Qf = _cost_from(end, Q, R, sample) if steady else weight("Qf", Qf, names)
    fields: dict[str, Any] = {key: getattr(traj, key) for key in ("q", "v", "u", "hold", "frame")}
    fields |= {"state_names": names, "input_names": traj.input_names, "robot": traj.robot.name}
    fields |= {"Q": Q, "R": R, "Qf": Qf, "weights": rule, "knots": traj.t}
    fields |= {"verified": traj.verified, "dt": dt}
    if sample is not None:
        return GainSchedule(**fields, **_sampled(traj, dt, Q, R, Qf))
    try:
        # A P that overflows is refused below, so that NumPy need not warn of it.
        with np.errstate(over="ignore", invalid="ignore"):
            t, P = _solve(traj, Q, R, Qf)
    except np.linalg.LinAlgError:
        raise InputError(_TOO_FAST.format("some time")) from None
    A, B = map(np.array, zip(*(traj.matrices(float(x)) for x in t), strict=True))
    K = np.linalg.solve(R, B.transpose(0, 2, 1) @ P)
    schedule = GainSchedule(t=t, K=K, P=P, A=A, B=B, residual=math.inf, **fields)
    return replace(schedule, residual=_residual(schedule, traj))


def steady_end(traj: LinearTrajectory) -> LinearModel:
    """Return the model at the end where that is steady, else at rest in the last configuration."""
    lin = traj[-1]
    if lin.is_equilibrium():
        return lin
    try:
        return resting_end(traj)
    except EquilibriumError as error:
        raise EquilibriumError(f"at the end: {error}; give Q, R and Qf") from None


def resting_end(traj: Trajectory) -> LinearModel:
    """Return the model at rest in the last configuration, in base axes; rotors spin on there."""
    from fflin.linear.equilibrium import equilibrium
    from fflin.linear.ignorable import rotor_names
    from fflin.linear.linearization import Linearizer

    robot, q, v = traj.robot, traj.q[-1], np.zeros(traj.robot.nv)
    rotors = rotor_names(robot)
    spinning = [joint.idx_v for joint in robot.joints if joint.name in rotors]
    v[spinning] = traj.v[-1, spinning]
    return Linearizer(robot, moving=True)(q, v, equilibrium(robot, q, v=v).u)


def _cost_from(lin: Any, Q: Array, R: Array, sample: float | None) -> Array:
    """Return the cost P (nx, nx) of a regulator about a steady point."""
    from fflin.analysis.momentum import momentum_reduction
    from fflin.control.lqr import lqr
    from fflin.control.sampled_cost import sampled_cost

    def cost(lin: LinearModel, Q: Array) -> Array:
        if sample is None:
            return lqr(lin, Q, R).P
        return lqr(lin.discretize(sample), *sampled_cost(lin, sample, Q, R)).P

    try:
        return cost(lin, Q)
    except StabilizabilityError:
        part = momentum_reduction(lin)
        P: Array = part.S.T @ cost(part, part.T.T @ Q @ part.T) @ part.S
        return P


def _sampled(traj: LinearTrajectory, dt: float, Q: Array, R: Array, P: Array) -> dict[str, Any]:
    """Return t, K, P, A, B and the residual of the regulator whose inputs are held."""
    from fflin.analysis.gramians import held_cost
    from fflin.linear.trajectory_sampling import transitions

    nx, nu = len(Q), len(R)
    W = np.zeros((nx + nu, nx + nu))
    W[:nx, :nx], W[nx:, nx:] = Q, R
    maps, gains, costs, worst = [], [], [P], 0.0
    for steps, whole in reversed(list(transitions(traj, traj.matrices, dt))):
        total, way = np.zeros_like(W), np.eye(nx + nu)
        for F, h, step in steps:
            total += way.T @ held_cost(F, W, h) @ way
            way[:nx] = step @ way
        total += whole.T @ P @ whole
        K = np.linalg.solve(total[nx:, nx:], total[nx:, :nx])
        # A sum of squares, which stays positive.
        law = np.vstack((np.eye(nx), -K))
        P = law.T @ total @ law
        P = 0.5 * (P + P.T)
        terms = P, total[:nx, :nx], total[:nx, nx:] @ K
        size = sum(float(np.linalg.norm(each)) for each in terms)
        worst = max(worst, float(np.linalg.norm(terms[0] - terms[1] + terms[2])) / (size or 1.0))
        if not np.isfinite(P).all():
            raise InputError(_TOO_FAST.format("some time"))
        maps.append(whole)
        gains.append(K)
        costs.append(P)
    maps.reverse()
    held = np.array(maps)
    gains = [*gains[::-1], gains[0]]
    found = {"t": traj.samples(dt), "K": np.array(gains), "P": np.array(costs[::-1])}
    return found | {"A": held[:, :, :nx], "B": held[:, :, nx:], "residual": worst}


def _solve(traj: LinearTrajectory, Q: Array, R: Array, Qf: Array) -> tuple[Array, Array]:
    @cache
    def at(t: float) -> Coefficients:
        A, B = traj.matrices(t)
        return Coefficients(A, _spread(B, R), Q)

    def back(a: float, b: float, P: Array) -> Array:
        early, late = (at(a + c * (b - a)) for c in GAUSS)
        return step_back(early, late, P, b - a)

    times, values = [float(traj.t[-1])], [Qf]
    for a in traj.t[-2::-1].tolist():
        # Intervals left to do, the latest last; with P at the start from one step, where known.
        pending: list[tuple[float, float, Array | None]] = [(a, times[-1], None)]
        while pending:
            start, end, single = pending.pop()
            P = values[-1]
            single = back(start, end, P) if single is None else single
            middle = 0.5 * (start + end)
            half = back(middle, end, P)
            double = back(start, middle, half)
            h = end - start
            # The cubic with these values and slopes, midway.
            bend = at(start).rate(double) - at(end).rate(P)
            between = 0.5 * (double + P) + 0.125 * h * bend
            if max(_apart(single, double), _apart(between, half)) <= _ACCURACY:
                times += [middle, start]
                values += [half, double]
            elif len(times) > _KNOTS_LIMIT or h < 1e-12 * abs(traj.t[-1] - traj.t[0]):
                raise InputError(_TOO_FAST.format(f"t = {end:g} s"))
            else:
                pending += [(start, middle, None), (middle, end, half)]
    return np.array(times[::-1]), np.array(values[::-1])


def _spread(B: Array, R: Array) -> Array:
    S = B @ np.linalg.solve(R, B.T)
    half: Array = 0.5 * (S + S.T)
    return half


def _apart(first: Array, second: Array) -> float:
    return float(np.linalg.norm(first - second)) / max(float(np.linalg.norm(second)), 1e-300)


def _residual(schedule: GainSchedule, traj: LinearTrajectory) -> float:
    worst = 0.0
    for t in 0.5 * (schedule.t[1:] + schedule.t[:-1]):
        P, rate = schedule._cubics(t), schedule._cubics(t, 1)
        A, B = traj.matrices(float(t))
        drift, spent = P @ A, P @ _spread(B, schedule.R) @ P
        terms = np.array((rate, drift, drift.T, -spent, schedule.Q))
        size = float(np.linalg.norm(terms, axis=(1, 2)).sum())
        worst = max(worst, float(np.linalg.norm(terms.sum(axis=0))) / max(size, 1e-300))
    return worst
