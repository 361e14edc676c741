"""Time-varying linear quadratic regulator along a trajectory."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from fflin.analysis.gramians import held_cost
from fflin.analysis.momentum import momentum_reduction
from fflin.base.errors import EquilibriumError, InputError, StabilizabilityError
from fflin.base.threads import in_one_thread
from fflin.base.validation import Array, number
from fflin.control import differential_riccati as riccati
from fflin.control.gain import Gain
from fflin.control.gain_schedule import GainSchedule
from fflin.control.lqr import lqr
from fflin.control.weight_rules import pace_along, rule_weights
from fflin.control.weights import Weight, cost_weights, sampled_cost, weight
from fflin.linear.equilibrium import equilibrium
from fflin.linear.ignorable import rotor_names
from fflin.linear.linear_trajectory import LinearTrajectory
from fflin.linear.linearization import Linearizer
from fflin.linear.model import LinearModel
from fflin.linear.trajectory import Trajectory
from fflin.linear.trajectory_sampling import transitions


@in_one_thread
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
    r"""Return the time-varying linear quadratic regulator along a trajectory.

    From any time t to the end T, it minimises the finite-horizon cost

    .. math:: e(T)^T Q_f\,e(T) + \int_t^T e^T Q\,e + \delta u^T R\,\delta u\;d\tau.

    The differential Riccati equation is :math:`-\dot P = A^T P + P A - P B R^{-1} B^T P + Q`, with
    :math:`P(T) = Q_f`. It is solved backwards from knot to knot by maps
    :math:`P_0 = W + T^T P_1 (E + G P_1)^{-1} T`. Here E is the identity, and W and G are positive
    semidefinite. Each map is computed from a short matrix exponential by doubling, so P stays
    positive semidefinite over any horizon. The method is of fourth order along a changing
    trajectory and exact along a constant one. Knots are added until halving and interpolation
    agree to 1e-7.

    With `sample`, the regulator is sampled: a computer measures e at the samples and holds
    :math:`\delta u` between them. The cost remains the integral above, evaluated by (10.1) and
    (10.3) along the motion.

    Parameters
    ----------
    traj : LinearTrajectory
    Q : array_like (nx, nx) or (nx,), float, or mapping, optional
        Weight on the error, positive semidefinite, as in `lqr`.
    R : array_like (nu, nu) or (nu,), float, or mapping, optional
        Weight on the inputs, positive definite.
    Qf : "steady", or as Q
        Weight on the error at the end. "steady" is the infinite-horizon cost of `lqr` about the end
        point: the last configuration at rest, or in its final motion if that motion is steady. It
        omits the states that the inputs cannot stabilise, see `momentum_reduction`.
    sample : float, optional
        Sampling time [s]. It must divide the duration.
    weights : {"urdf", "identity"}, optional
        Rule for the weights, instead of Q and R: the rule of `lqr` about that end point, for
        displacements a tenth as large. The loop is fast enough for errors to decay within the
        duration of the trajectory.
    rule : str
        Description of the rule that made Q and R.

    Returns
    -------
    GainSchedule

    Raises
    ------
    InputError
        If a weight has a wrong size or is not positive (semi)definite, if P changes so fast that
        too many knots are needed, or if the sampling time does not divide the duration.
    UnknownNameError
        If a name does not exist.
    EquilibriumError, StabilizabilityError
        If Qf is "steady" and no inputs can hold the robot at the end point.

    References
    ----------
    W.-W. Lin and E. K.-W. Chu (with others), structure-preserving doubling algorithms, 2018.
    E. Celledoni, A. Marthinsen and B. Owren, Commutator-free Lie group methods, Future Generation
    Computer Systems 19(3), 2003.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> fflin.tvlqr(along, sample=0.1).K.shape
    (21, 9, 18)
    """
    require_continuous(traj)
    names, dt = traj.state_names, 0.0 if sample is None else number("sample", sample)
    steady = asks_steady(Qf)
    given, by_rule = list[Any]((Q, R)), Q is None and R is None
    if not by_rule and (weights is not None or Q is None or R is None):
        raise InputError("give both Q and R, or neither and weights='urdf' or 'identity'")
    end: Any = steady_end(traj) if steady or by_rule else None
    if by_rule:
        pace = pace_along(float(traj.t[-1] - traj.t[0]), dt)
        *given, _, rule = rule_weights(end, weights, pace=pace)
    Q, R, _ = cost_weights(traj, given[0], given[1], None)
    Qf = steady_regulator(end, Q, R, sample)[0] if steady else weight("Qf", Qf, names)
    fields: dict[str, Any] = {key: getattr(traj, key) for key in ("q", "v", "u", "hold", "frame")}
    fields |= {"state_names": names, "input_names": traj.input_names, "robot": traj.robot.name}
    fields |= {"Q": Q, "R": R, "Qf": Qf, "weights": rule, "knots": traj.t}
    fields |= {"verified": traj.verified, "dt": dt}

    @cache
    def at(t: float) -> riccati.Coefficients:
        A, B = traj.matrices(t)
        return riccati.Coefficients(A, riccati.spread(B, R), Q)

    with riccati.bounded_by("smaller weights or a larger R"):
        if sample is not None:
            return GainSchedule(**fields, **_sampled(traj, dt, Q, R, Qf))
        t, P = riccati.solve_back(at, traj.t, Qf)
    A, B = map(np.array, zip(*(traj.matrices(float(x)) for x in t), strict=True))
    K = np.linalg.solve(R, B.transpose(0, 2, 1) @ P)
    residual = riccati.Passed(t, P, K, (A, B, Q, R), 0.0, -1.0).residual(at)
    return GainSchedule(t=t, K=K, P=P, A=A, B=B, residual=residual, **fields)


def asks_steady(Qf: Any) -> bool:
    """Return whether Qf is "steady"; raise `InputError` if it is another string."""
    if isinstance(Qf, str) and Qf != "steady":
        raise InputError(f"Qf is {Qf!r}, expected 'steady' or a weight")
    return isinstance(Qf, str)


def held_stages(
    traj: LinearTrajectory, dt: float, Q: Array, R: Array
) -> Iterator[tuple[Array, Array]]:
    """Yield the samples that `samples_back` takes, from first to last."""
    nx, W = len(Q), block_diag(Q, R)
    for steps, whole in transitions(traj, traj.matrices, dt):
        total, way = np.zeros_like(W), np.eye(len(W))
        for F, h, step, _ in steps:
            total += way.T @ held_cost(F, W, h) @ way
            way[:nx] = step @ way
        yield total, whole


def require_continuous(traj: LinearTrajectory) -> None:
    """Raise `InputError` if traj is not a LinearTrajectory in continuous time."""
    if not isinstance(traj, LinearTrajectory):
        raise InputError(
            f"traj is a {type(traj).__name__}, expected a LinearTrajectory; "
            "fflin.linearize_trajectory returns one"
        )
    if traj.dt:
        raise InputError("traj is sampled; give the continuous trajectory and sample=")


def steady_end(traj: LinearTrajectory, end: int = -1) -> LinearModel:
    """Return the model at the last knot, or the first (0), if steady, else at rest there."""
    lin = traj[end]
    if lin.is_equilibrium():
        return lin
    try:
        return resting_end(traj, end)
    except EquilibriumError as error:
        where, given = ("end", "Q, R and Qf") if end else ("start", "P0")
        raise EquilibriumError(
            f"no inputs hold the robot at the {where} of the trajectory: {error}; give {given}"
        ) from None


def resting_end(traj: Trajectory, end: int = -1) -> LinearModel:
    """Return the model at rest in the last configuration, in base axes; rotors spin on there."""
    robot, q, v = traj.robot, traj.q[end], np.zeros(traj.robot.nv)
    rotors = rotor_names(robot)
    spinning = [joint.idx_v for joint in robot.joints if joint.name in rotors]
    v[spinning] = traj.v[end, spinning]
    held = equilibrium(robot, q, v=v)
    return Linearizer(robot, moving=True)(held.q, v, held.u)


def steady_regulator(
    lin: LinearModel, Q: Array, R: Array, sample: float | None
) -> tuple[Array, Array]:
    """Return the cost P (nx, nx) and K (nu, nx) of a regulator about a steady point."""

    def regulator(lin: LinearModel, Q: Array) -> Gain:
        if not sample:
            return lqr(lin, Q, R)
        return lqr(lin.discretize(sample), *sampled_cost(lin, sample, Q, R))

    try:
        gain = regulator(lin, Q)
        return gain.P, gain.K
    except StabilizabilityError:
        part = momentum_reduction(lin)
        gain = regulator(part, part.T.T @ Q @ part.T)
        return part.S.T @ gain.P @ part.S, gain.K @ part.S


def _sampled(traj: LinearTrajectory, dt: float, Q: Array, R: Array, P: Array) -> dict[str, Any]:
    """Return t, K, P, A, B and the residual of the regulator whose inputs are held."""
    nx, stages = len(Q), list(held_stages(traj, dt, Q, R))
    K, P, residual = riccati.samples_back(reversed(stages), P)
    maps = np.array([whole for _, whole in stages])
    found = {"t": traj.samples(dt), "K": np.concatenate((K[::-1], K[:1])), "P": P[::-1]}
    return found | {"A": maps[:, :, :nx], "B": maps[:, :, nx:], "residual": residual}
