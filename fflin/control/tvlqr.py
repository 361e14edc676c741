"""Time-varying linear quadratic regulator and Kalman filter along a trajectory."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from fflin.analysis.reduction import momentum_reduction
from fflin.base.errors import DetectabilityError, EquilibriumError, InputError, StabilizabilityError
from fflin.base.process import in_one_thread
from fflin.base.validation import Array, instance, number
from fflin.control.default_weights import pace_along
from fflin.control.gain import Gain
from fflin.control.gain_schedule import FilterSchedule, GainSchedule, Interpolant
from fflin.control.kalman import disturbance, kalman
from fflin.control.lqr import lqr
from fflin.control.optimal import differential_riccati as riccati
from fflin.control.weights import Weight, cost_weights, rule_weights, sampled_cost, weight
from fflin.dynamics.integrators import HEAVY, LIGHT, held_cost
from fflin.linear.equilibrium import equilibrium
from fflin.linear.linear_trajectory import LinearTrajectory, Steps, along, transitions
from fflin.linear.linearization import Linearizer
from fflin.linear.model import LinearModel
from fflin.linear.trajectory import Trajectory
from fflin.robot.mass_properties import rotor_names


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

    From any time t to the end T, the regulator minimises the finite-horizon cost

    .. math:: e(T)^T Q_f\,e(T) + \int_t^T e^T Q\,e + \delta u^T R\,\delta u\;d\tau.

    The differential Riccati equation is :math:`-\dot P = A^T P + P A - P B R^{-1} B^T P + Q`, with
    :math:`P(T) = Q_f`. The Riccati equation is solved backwards from knot to knot, by maps
    :math:`P_0 = W + \Phi^T P_1 (I + G P_1)^{-1} \Phi` from the cost :math:`P_1` at a knot to the
    cost :math:`P_0` at the previous knot. W and G are positive semidefinite. Each map is computed
    from a short matrix exponential by doubling, so P stays positive semidefinite over any horizon.
    The method has order four in general, and is exact if A and B are constant. Knots are added
    until the estimated errors of the steps and of the interpolation of P are below 1e-7.

    With `sample`, the regulator is sampled: e is measured at the samples, and :math:`\delta u` is
    held between samples. The cost is still the integral over continuous time, evaluated by (10.1)
    and (10.3) of docs/derivation.md along the motion.

    Parameters
    ----------
    traj : LinearTrajectory
    Q : array_like (nx, nx) or (nx,), float, or mapping, optional
        Weight on the error, positive semidefinite, as in `lqr`.
    R : array_like (nu, nu) or (nu,), float, or mapping, optional
        Weight on the inputs, positive definite.
    Qf : "steady", or as Q
        Weight on the error at the end. "steady" is the infinite-horizon cost of `lqr` about the end
        point. The end point is the last configuration, in its final motion if this motion is
        steady, otherwise at rest. States that the inputs cannot stabilise have zero weight in Qf,
        see `momentum_reduction`.
    sample : float, optional
        Sampling time [s], which must divide the duration.
    weights : {"urdf", "identity"}, optional
        Rule for the weights if Q and R are omitted. The rule of `lqr` is applied to the linear
        model at the last point of the trajectory, with two changes: the limits are checked for
        displacements a tenth as large, and errors decay within the duration of the trajectory.
    rule : str
        Description of the rule that set Q and R.

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
    if Q is None and R is None:
        pace = pace_along(float(traj.t[-1] - traj.t[0]), dt)
        Q, R, _, rule = rule_weights(steady_end(traj), weights, pace=pace)
    elif weights is not None or Q is None or R is None:
        raise InputError("give either both Q and R, or only weights='urdf' or 'identity'")
    Q, R, _ = cost_weights(traj, Q, R, None)
    Qf = steady_regulator(steady_end(traj), Q, R, sample)[0] if steady else weight("Qf", Qf, names)

    def at(times: Array) -> riccati.Coefficients:
        A, B = traj.matrices_at(times)
        return riccati.Coefficients(A, riccati.spread(B, R), np.broadcast_to(Q, A.shape))

    with riccati.bounded_by("smaller weights or a larger R"):
        if sample is not None:
            stages = list(held_stages(traj, dt, Q, R))
            gains, costs, residual = riccati.samples_back(reversed(stages), Qf)
            t, P, K = traj.samples(dt), costs[::-1], np.concatenate((gains[::-1], gains[:1]))
            A, B = np.split(np.array([whole for _, whole in stages]), [len(Q)], axis=2)
        else:
            t, P = riccati.solve_back(at, traj.t, Qf)
            A, B = traj.matrices_at(t)
            K = np.linalg.solve(R, B.transpose(0, 2, 1) @ P)
            residual = Interpolant(t, P, K, (A, B, Q, R), 0.0).residual(at)
    return GainSchedule._of(
        traj,
        t=t,
        K=K,
        P=P,
        A=A,
        B=B,
        Q=Q,
        R=R,
        Qf=Qf,
        residual=residual,
        robot=traj.robot.name,
        dt=dt,
        weights=rule,
        knots=traj.t,
    )


def asks_steady(value: object, name: str = "Qf", kind: str = "a weight") -> bool:
    """Return whether a value is "steady"; raise `InputError` if it is another string."""
    if isinstance(value, str) and value != "steady":
        raise InputError(f"{name} is {value!r}, expected 'steady' or {kind}")
    return isinstance(value, str)


def held_stages(
    traj: LinearTrajectory, dt: float, Q: Array, R: Array
) -> Iterator[tuple[Array, Array]]:
    """Yield the cost and the transition of each sample, from first to last."""
    nx, W = len(Q), block_diag(Q, R)
    for steps, whole in transitions(traj, dt):
        total, transition = np.zeros_like(W), np.eye(len(W))
        for cost, step in zip(held_cost(steps.F, W, steps.h), steps.maps, strict=True):
            total += transition.T @ cost @ transition
            transition[:nx] = step @ transition
        yield total, whole


def require_continuous(traj: LinearTrajectory) -> None:
    """Raise `InputError` if traj is not a LinearTrajectory in continuous time."""
    expected = "a LinearTrajectory; fflin.linearize_trajectory returns one"
    if instance("traj", traj, LinearTrajectory, expected).dt:
        raise InputError("traj is sampled; give the continuous trajectory and sample=")


def steady_end(traj: LinearTrajectory, end: int = -1) -> LinearModel:
    """Return the model at knot `end`, or the model at rest there if the knot is not steady."""
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
    """Return the model at rest in the last configuration, in base axes; rotors keep spinning."""
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


@in_one_thread
def tvkalman(
    traj: LinearTrajectory,
    W: Weight,
    V: Weight,
    G: ArrayLike | None = None,
    P0: Weight | str = "steady",
    *,
    sample: float,
) -> FilterSchedule:
    r"""Return the time-varying Kalman filter of sampled outputs along a trajectory.

    White noise of intensity W acts on the error, and noise of covariance V on the outputs at each
    sample. Between samples, :math:`\delta u` is held. The covariance P of the estimation error is
    computed forward from P0 by (10.4) of docs/derivation.md:

    .. math:: P_{k+1} = \Phi (P - P C^T (C P C^T + V)^{-1} C P)_k \Phi^T + W_k,\qquad
              L = \Phi P C^T (C P C^T + V)^{-1}.

    Here :math:`\Phi` is the transition matrix over one sample, and :math:`W_k` is the covariance of
    the disturbance integrated over this sample.

    Parameters
    ----------
    traj : LinearTrajectory
        Trajectory of a robot whose outputs are the measurements.
    W : array_like (nx, nx) or (nx,), float, or mapping
        Intensity of the disturbance, positive semidefinite, as in `kalman`.
    V : array_like (ny, ny) or (ny,), float, or mapping
        Covariance of the measurement noise at a sample, positive definite.
    G : array_like (nx, nw) or (N, nx, nw), optional
        Input matrix of the disturbance, interpolated linearly between the knots; W is then (nw,
        nw). With ``G=traj.B``, the disturbance acts at the inputs, and the keys of a mapping W are
        names of inputs.
    P0 : "steady", or as W
        Covariance at the start. "steady" is the covariance of `kalman` about the start point. The
        start point is the first configuration, in its initial motion if this motion is steady,
        otherwise at rest.
    sample : float
        Sampling time [s], which must divide the duration.

    Returns
    -------
    FilterSchedule

    Raises
    ------
    InputError
        If a size or value is wrong, if P overflows, or if the sampling time does not divide the
        duration.
    UnknownNameError
        If a name does not exist.
    EquilibriumError, DetectabilityError
        If P0 is "steady", and either no inputs can hold the robot at the start point or the model
        at this point is not detectable.

    References
    ----------
    R. E. Kalman and R. S. Bucy, J. Basic Engineering 83(1), 1961.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> noise = {"tau_b": 0.1, "F_b": 0.1, "tau_m": 0.01}
    >>> fflin.tvkalman(along, noise, 1e-4, G=along.B, sample=0.1).L.shape
    (21, 18, 18)
    """
    require_continuous(traj)
    dt = number("sample", sample)
    V = weight("V", V, traj.output_names, definite=True)
    noise, columns = disturbance(traj, W, G)
    columns = np.broadcast_to(columns, (len(traj.t), *columns.shape[-2:]))

    def intensity(t: float) -> Array:
        (by,) = traj.between(t, columns)
        spread = by @ noise @ by.T
        return 0.5 * (spread + spread.T)

    if asks_steady(P0, "P0", "a covariance"):
        lin, early = steady_end(traj, 0), intensity(float(traj.t[0]))
        try:
            P = kalman(lin.discretize(dt), held_cost(lin.A.T, early, dt), V).P
        except (DetectabilityError, InputError) as error:
            said = f"no steady filter exists at the start of the trajectory: {error}; or give P0"
            raise type(error)(said) from None
    else:
        P = weight("P0", P0, traj.state_names)
    held, at_samples, nx = list(transitions(traj, dt)), along(traj.resampled(dt)), len(P)
    maps = np.array([whole for _, whole in held])
    with riccati.bounded_by("a smaller W or a larger V"):
        disturbed = [_disturbed(steps, intensity) for steps, _ in held]
        stages = [
            (block_diag(each, V), np.hstack((whole[:, :nx].T, C.T)))
            for each, whole, C in zip(disturbed, maps, at_samples.C, strict=False)
        ]
        K, P, residual = riccati.samples_back(stages, P)
    L = K.transpose(0, 2, 1)
    return FilterSchedule._of(
        at_samples,
        L=np.concatenate((L, L[-1:])),
        P=P,
        A=maps[:, :, :nx],
        B=maps[:, :, nx:],
        W=np.array(disturbed),
        V=V,
        residual=residual,
        robot=traj.robot.name,
        dt=dt,
    )


def _disturbed(steps: Steps, intensity: Callable[[float], Array]) -> Array:
    """Return the covariance (nx, nx) that a disturbance adds during a sample."""
    nx = len(steps.maps[0])
    first, second = (np.array([intensity(t) for t in times]) for times in steps.nodes.T.tolist())
    added = held_cost(steps.F[:, :nx, :nx].mT, HEAVY * first + LIGHT * second, steps.h)
    W = np.zeros((nx, nx))
    for step, each in zip(steps.maps[:, :, :nx], added, strict=True):
        W = step @ W @ step.T + each
    return W
