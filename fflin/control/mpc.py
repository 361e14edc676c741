"""Model predictive control about a fixed point or along a trajectory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from fflin.base.errors import InputError, listed
from fflin.base.names import by_name, input_keys, stands_for_any, state_keys
from fflin.base.process import in_one_thread
from fflin.base.validation import Array, Indices, instance, number, whole
from fflin.control.channel import input_limits
from fflin.control.gain import Gain
from fflin.control.horizon import Horizon, Matrices, Receding, Stage
from fflin.control.lqr import lqr
from fflin.control.optimal.differential_riccati import bounded_by, samples_back
from fflin.control.policies import Feedback, Policy, StateFeedback
from fflin.control.tracking import TrajectoryFeedback
from fflin.control.tvlqr import asks_steady, held_stages, steady_regulator, tvlqr
from fflin.control.weights import Weight, sampled_cost, weight
from fflin.dynamics.state import StateMap
from fflin.linear.linear_trajectory import LinearTrajectory, along
from fflin.linear.model import LinearModel
from fflin.robot.fields import chosen_limits, range_of
from fflin.robot.robot import Robot

# Weights Q and R, and the name of their rule.
Cost: TypeAlias = "tuple[Weight | None, Weight | None, str | None]"

# Largest number of entries in the matrices that map inputs to states and limits: 160 MB.
_MOST = 20_000_000


@in_one_thread
def mpc(
    lin: LinearModel | LinearTrajectory,
    Q: Weight | None = None,
    R: Weight | None = None,
    *,
    horizon: int = 20,
    dt: float | None = None,
    limits: float | str | Mapping[str, object] | Sequence[object] | None = "urdf",
    Qf: Weight | str = "steady",
    weights: str | None = None,
) -> Mpc | TrajectoryMpc:
    r"""Return the model predictive controller about a fixed point or along a trajectory.

    At each sample, the controller computes inputs for the next N samples. These inputs respect the
    limits and minimise

    .. math:: e_N^T Q_f\,e_N + \int_0^{N h} e^T Q\,e + \delta u^T R\,\delta u\;dt.

    The controller applies only the inputs of the first sample, and repeats the computation at the
    next sample. If no limit is active over the horizon, the controller equals the regulator of
    `lqr` or `tvlqr`.

    - Input limits are hard: inputs never exceed these limits.
    - Limits of states and outputs are soft. They apply to the values that the linear model predicts
      at the samples. If the quadratic program would otherwise be infeasible, soft limits are
      exceeded slightly; the motion's `notes` report this.
    - If the solver finds no solution, the LQR command is applied, saturated at the input limits,
      and a warning is issued.

    DAQP solves the quadratic program (docs/guide/mpc.md; ``pip install 'fflin[mpc]'``). The
    solver starts from the limits that were active at the previous sample.

    Parameters
    ----------
    lin : LinearModel or LinearTrajectory
        Continuous model or trajectory, or a sampled model that `discretize` returned.
    Q, R : see `lqr`, optional
        Weights of the integral. If both are omitted, a rule sets the weights, as in `lqr` for a
        model and in `tvlqr` for a trajectory. The argument `weights` selects the rule.
    horizon : int
        Number N of samples in the horizon.
    dt : float
        Sampling time h [s].
    limits : "urdf", float, mapping or list of them, optional
        Limits as in `simulate`, for inputs, states and outputs: {name, group or pattern: magnitude,
        or (least, largest)}. The limits bound the values of these signals. Along a trajectory,
        however, limits of q_b and r_b bound the error relative to the trajectory. With None, the
        only limit is that thrusters cannot pull.
    Qf : "steady", or as Q
        Weight on the error after N samples, or at the end of a trajectory. "steady" is the cost
        to go of the regulator from the end of the horizon on.
    weights : {"urdf", "identity"}, optional
        Rule for the weights if Q and R are omitted, as in `lqr`.

    Returns
    -------
    Mpc or TrajectoryMpc
        Policy for `simulate` and `monte_carlo`. The method ``matrices(e)`` of the policy
        (``matrices(e, t)`` along a trajectory) returns the quadratic program at a state error e,
        for use with other solvers.

    Raises
    ------
    InputError
        If an argument has a wrong size or value, or the operating point exceeds the limits.
    EquilibriumError, StabilizabilityError
        See `lqr` and `tvlqr`.
    MissingPackageError
        If DAQP is not installed; raised when DAQP is first used.
    UnknownNameError
        If a name does not exist.

    References
    ----------
    D. Arnström, A. Bemporad and D. Axehill, A dual active-set solver for embedded quadratic
    programming using recursive LDL' updates, IEEE Trans. Automatic Control 67(8), 2022.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> policy = fflin.mpc(lin, dt=0.2, horizon=10, limits={"tau_b": 2.0, "tau_m": 1.0})
    >>> q0 = fflin.configuration(robot, {"joint_2": 0.4})
    >>> motion = fflin.simulate(robot, policy, q0=q0, duration=4.0, dt=0.05)
    >>> bool(abs(motion.u[:, 6:]).max() <= 1.0), policy.matrices(motion.x[0]).H.shape
    (True, (90, 90))
    """
    instance("lin", lin, (LinearModel, LinearTrajectory), "a LinearModel or a LinearTrajectory")
    samples = whole("horizon", horizon, 1)
    if dt is None and not lin.dt:
        raise InputError("dt is missing; give the sampling time [s]")
    dt = number("dt", lin.dt if dt is None else dt)
    source = lin if isinstance(lin, LinearTrajectory) else lin.generator
    if source is None or source.dt or dt != (lin.dt or dt):
        raise InputError(
            "lin is sampled with another dt, or the model before sampling is not known; give the "
            "continuous model and dt="
        )
    limited = _limits(source, limits)
    if samples**2 * (len(limited.at) + len(lin.state_names)) * len(lin.input_names) > _MOST:
        raise InputError(
            f"horizon is {samples} samples with {len(limited.at)} limits, which makes the "
            "optimisation problem too large; give a shorter horizon or fewer limits"
        )
    given = (Q, R, weights), Qf, samples, dt, limited
    made: Callable[[Horizon], Mpc | TrajectoryMpc]
    if isinstance(source, LinearTrajectory):
        made, stages = _along(source, *given)
    else:
        made, stages = _about(source, *given)
    acting = limited.at[limited.at < len(lin.input_names)]
    name = source.robot if isinstance(source.robot, str) else source.robot.name
    return made(Horizon(tuple(stages), samples, dt, lin.input_names, acting, limited.names, name))


class _Shown:
    horizon: Horizon

    def __repr__(self) -> str:
        of = self.horizon
        said = f"'{of.robot}', {of.samples} samples of {of.dt:g} s, {len(of.limited)} limits"
        return f"{type(self).__name__}({said})"


@dataclass(eq=False, repr=False)
class Mpc(_Shown, Feedback):
    """Model predictive controller about a point.

    Attributes
    ----------
    lin : LinearModel
        The sampled model.
    gain : Gain
        The regulator that acts if no limit is active.
    horizon : Horizon
        The stages of the quadratic program.
    """

    lin: LinearModel
    gain: Gain
    horizon: Horizon

    def matrices(self, e: ArrayLike | None = None) -> Matrices:
        """Return the quadratic program at the deviation e = x - x0 (nx,), by default zero."""
        return self.horizon.matrices(e, 0.0)

    def bind(self, robot: Robot) -> Policy:
        """Return policy(t, q, v) -> u for a robot with the model's states and inputs."""
        lin, state = self.lin, self.state_map(robot)
        fed, near = [state.names.index(name) for name in lin.state_names], np.zeros(state.nx)
        near[fed] = lin.x0

        def at(_: float, q: Array, v: Array) -> tuple[Array, Array]:
            return lin.u0, state.read(q, v, near=near)[fed] - lin.x0

        return Receding(self.horizon, at)


@dataclass(eq=False, repr=False)
class TrajectoryMpc(_Shown, TrajectoryFeedback):
    """Model predictive controller along a trajectory and about its end.

    The inherited attributes contain the trajectory and the regulator's schedule.
    """

    horizon: Horizon

    def matrices(self, e: ArrayLike | None = None, t: float = 0.0) -> Matrices:
        """Return the quadratic program at time t [s] and error e (nx,), by default zero."""
        return self.horizon.matrices(e, t)

    def bind(self, robot: Robot) -> Policy:
        """Return policy(t, q, v) -> u for a robot with the trajectory's states and inputs."""
        return Receding(self.horizon, self.deviation(robot))


class _Limits(NamedTuple):
    """Limited signals: their names, limits, and indices among inputs, states and outputs."""

    names: tuple[str, ...]
    at: Indices
    low: Array
    high: Array

    def of_stage(self, C: Array, D: Array, *target: Array) -> tuple[Array, ...]:
        """Return E, D, low and high of a stage from its output matrices and target values."""
        (nx, nu), there = (C.shape[1], D.shape[1]), np.concatenate(target)[self.at]
        of_e = np.vstack((np.zeros((nu, nx)), np.eye(nx), C))[self.at]
        of_d = np.vstack((np.eye(nu), np.zeros((nx, nu)), D))[self.at]
        return of_e, of_d, self.low - there, self.high - there


def _limits(of: LinearModel | LinearTrajectory, limits: object) -> _Limits:
    """Return the limits of a model's inputs, states and outputs."""
    if (robot := of.robot if isinstance(of, LinearTrajectory) else of._robot) is None:
        raise InputError("lin was loaded from a file, which contains no robot; linearise again")
    inputs, states, outputs = of.input_names, of.state_names, of.output_names
    beside = [name for name in outputs if name not in states]
    known = (*state_keys(robot.joint_names), *input_keys(of))
    found = dict[str, object]()
    parts = list(limits) if isinstance(limits, list | tuple) else [limits]
    for k, part in enumerate(parts):
        if isinstance(part, Mapping) and beside:
            own = [x for x in part if stands_for_any(x, beside) and not stands_for_any(x, known)]
            ranges = by_name("output", {key: range_of(key, part[key]) for key in own}, beside)
            found |= {beside[i]: limit for i, limit in ranges.items()}
            parts[k] = {key: limit for key, limit in part.items() if key not in own}
    acting = chosen_limits(robot, parts[0] if len(parts) == 1 else parts)[0]
    found |= {name: acting[name] for name in states if name in acting}
    of_inputs = np.array(input_limits(robot, acting))
    names = (*inputs, *states, *(name if name in beside else "" for name in outputs))
    others = [found.get(name, (-np.inf, np.inf)) for name in names[len(inputs) :]]
    low, high = np.hstack((of_inputs, np.array(others).T))
    if (least := low > high).any():
        raise InputError(
            f"the lower limit of {names[least.argmax()]} is above its upper limit; correct limits="
        )
    at = np.flatnonzero(np.isfinite((low, high)).any(axis=0))
    return _Limits(tuple(names[i] for i in at), at, low[at], high[at])


def _about(
    lin: LinearModel, cost: Cost, Qf: Weight | str, samples: int, dt: float, signals: _Limits
) -> tuple[Callable[[Horizon], Mpc], list[Stage]]:
    """Return a function that creates the controller about a point, and the stages."""
    (Q, R, weights), sampled = cost, lin.discretize(dt)
    given = (Q, R) if Q is None or R is None else sampled_cost(lin, dt, Q, R)
    gain = lqr(sampled, *given, weights=weights)
    StateFeedback(sampled, gain.K)  # refuses a moving reference
    limited = signals.of_stage(lin.C, lin.D, lin.u0, lin.x0, lin.y0)
    far = np.maximum(limited[2], -limited[3]) > 1e-9
    if beyond := [name for name, out in zip(signals.names, far, strict=True) if out]:
        raise InputError(
            f"the point exceeds the limits of {listed(beyond)}; give wider limits, or linearise "
            "about another point"
        )
    total = np.block([[gain.Q, gain.N], [gain.N.T, gain.R]])
    end = gain.P if asks_steady(Qf) else weight("Qf", Qf, lin.state_names)
    whole = np.hstack((sampled.A, sampled.B))
    with bounded_by("a smaller Qf"):
        K, P, _ = samples_back([(total, whole)] * samples, end)
    stages = [_stage(total, whole, *each, limited) for each in zip(K, P[:-1], strict=True)]
    return lambda ahead: Mpc(sampled, gain, ahead), stages[::-1]


def _along(
    traj: LinearTrajectory, cost: Cost, Qf: Weight | str, samples: int, dt: float, signals: _Limits
) -> tuple[Callable[[Horizon], TrajectoryMpc], list[Stage]]:
    """Return a function that creates the controller along a trajectory, and the stages."""
    schedule = tvlqr(traj, cost[0], cost[1], Qf, dt, weights=cost[2])
    follows, state = TrajectoryFeedback(traj, schedule), StateMap(traj.robot, frame="local")
    Q, R, models, end = schedule.Q, schedule.R, along(traj.resampled(dt)), follows.end

    def about(of: LinearModel, u: Array) -> tuple[Array, ...]:
        # Limits on the base pose apply to its error relative to the trajectory.
        x = np.concatenate((np.zeros(6), state.joint_positions(of.q), state.velocities(of.v)))
        return signals.of_stage(of.C, of.D, u, x, of.y0)

    stages = []
    for k, sample in enumerate(held_stages(traj, dt, Q, R)):
        limited = about(models[k + 1], follows.commanded(k * dt)[2])
        stages.append(_stage(*sample, schedule.K[k], schedule.P[k + 1], limited))
    held, sampled = sampled_cost(end, dt, Q, R), end.discretize(dt)
    P, K = steady_regulator(end, Q, R, dt)
    total = np.block([[held.Q, held.N], [held.N.T, held.R]])
    last = _stage(total, np.hstack((sampled.A, sampled.B)), K, P, about(end, end.u0))
    return lambda ahead: TrajectoryMpc(traj, schedule, ahead), stages + [last] * samples


def _stage(total: Array, whole: Array, K: Array, P: Array, limited: tuple[Array, ...]) -> Stage:
    """Return the stage of a sample from its cost, transition, gain, and the next sample's P."""
    A, B = np.split(whole, [len(P)], axis=1)
    L = np.linalg.inv(np.linalg.cholesky(total[len(P) :, len(P) :] + B.T @ P @ B)).T
    return Stage(A, B, K, L, *limited)
