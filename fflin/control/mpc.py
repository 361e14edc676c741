"""Model predictive control: within limits that are foreseen, about a point or along a motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fflin.base.errors import InputError, listed
from fflin.base.names import by_name, input_keys, stands_for_any, state_keys
from fflin.base.threads import in_one_thread
from fflin.base.validation import Array, number, whole
from fflin.control.differential_riccati import bounded_by, samples_back
from fflin.control.gain import Gain
from fflin.control.horizon import Horizon, Matrices, Receding, Stage
from fflin.control.lqr import lqr
from fflin.control.policies import Clock, Policy, StateFeedback
from fflin.control.saturation import saturation
from fflin.control.tracking import TrajectoryFeedback
from fflin.control.tvlqr import asks_steady, held_stages, steady_regulator, tvlqr
from fflin.control.weights import Weight, sampled_cost, weight
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import moving_error
from fflin.linear.linear_trajectory import LinearTrajectory, along
from fflin.linear.model import LinearModel
from fflin.robot.fields import Range, range_of
from fflin.robot.limits import chosen_limits
from fflin.robot.robot import Robot

_MOST_SAMPLES, _MOST_ENTRIES = 1000, 20_000_000


@in_one_thread
def mpc(
    lin: LinearModel | LinearTrajectory,
    Q: Weight | None = None,
    R: Weight | None = None,
    *,
    horizon: int = 20,
    dt: float | None = None,
    limits: float | str | Mapping[str, Any] | Sequence[Any] | None = "urdf",
    Qf: Weight | str = "steady",
    weights: str | None = None,
) -> Mpc | TrajectoryMpc:
    r"""Return the model predictive controller about a fixed point or along a trajectory.

    At each sample it plans the inputs of the next N and commands the first of them: of all that
    keep within the limits those of the least

    .. math:: e_N^T Q_f\,e_N + \int_0^{N h} e^T Q\,e + \delta u^T R\,\delta u\;dt,

    inputs held in between, so that where nothing is at a limit it is the regulator of `lqr` or
    `tvlqr`. Limits of inputs are kept to the last bit. Those of states and outputs hold at the
    samples, for the linear model; where they cannot all hold, as from a state that is beyond one,
    they are passed by as little as can be, which the motion's `notes` say. Where no plan is found,
    which is warned of, the regulator acts, cut at the limits.

    Each plan is a quadratic program over the inputs alone, in coordinates in which its Hessian is
    the identity (docs/mpc.md). DAQP (``pip install 'fflin[mpc]'``) solves it exactly, by the limits
    that are active, beginning with those of the last sample.

    Parameters
    ----------
    lin : LinearModel or LinearTrajectory
        Continuous; or a model that was sampled from one, in whose ``dt`` it runs.
    Q, R : see `lqr`
        Of the integral. By default those of `lqr` or `tvlqr`, by the rule `weights`.
    horizon : int
        Samples N that it looks ahead, 20 by default.
    dt : float
        Sampling time h [s].
    limits : "urdf", float, mapping or list of them, optional
        As in `simulate`, of inputs, and of states and outputs too: {name, group or pattern:
        magnitude, or (least, largest)} of the values themselves. Along a trajectory those of q_b
        and r_b are of the error from it. None for none but that thrusters do not pull.
    Qf : "steady", or as Q
        Weight on the error at the horizon's end; along a trajectory at that of the motion, see
        `tvlqr`. "steady" is the regulator's cost from there on.
    weights : see `lqr`

    Returns
    -------
    Mpc or TrajectoryMpc
        A policy for `simulate` and `monte_carlo`. Its ``matrices(e)``, along a trajectory
        ``matrices(e, t)``, are the program at a deviation of the state, for other solvers: H, g,
        G, low, high, soft, Phi, Gamma, inputs, limits.

    Raises
    ------
    InputError
        If an argument has a wrong size or value, or the point is beyond the limits.
    EquilibriumError, StabilizabilityError
        As `lqr` and `tvlqr` raise them.
    MissingPackageError
        If DAQP is not installed, when it runs.
    UnknownNameError
        If a name does not exist.

    References
    ----------
    J. B. Rawlings, D. Q. Mayne and M. M. Diehl, Model Predictive Control, 2017, sections 2.5, 8.8.

    D. Arnström, A. Bemporad and D. Axehill, A dual active-set solver for embedded quadratic
    programming using recursive LDL' updates, IEEE Trans. Automatic Control 67(8), 2022.
    """
    if not isinstance(lin, LinearModel | LinearTrajectory):
        raise InputError(
            f"lin is a {type(lin).__name__}, expected a LinearModel or a LinearTrajectory; "
            "fflin.linearize and fflin.linearize_trajectory make them"
        )
    samples = whole("horizon", horizon, 1, _MOST_SAMPLES)
    if dt is None and not lin.dt:
        raise InputError("dt is missing; give the sampling time [s]")
    dt = number("dt", lin.dt if dt is None else dt)
    source = lin.generator if isinstance(lin, LinearModel) else lin
    if source is None or source.dt:
        raise InputError("lin is sampled; give the continuous one it was made of, and dt=")
    if lin.dt and dt != lin.dt:
        raise InputError(f"dt is {dt:g} s, and lin is sampled at {lin.dt:g} s; give one of them")
    robot = lin.robot if isinstance(lin, LinearTrajectory) else lin._robot
    if robot is None:
        raise InputError("the model is from a file, which has no robot; linearise it anew")
    kept = _limits(source, robot, limits, dt)
    if (samples * len(source.input_names)) ** 2 + len(kept.names) * samples**2 > _MOST_ENTRIES:
        raise InputError(f"horizon is {samples}, too many samples of so many inputs and limits")
    if isinstance(source, LinearTrajectory):
        return _along(source, Q, R, Qf, weights, samples, dt, kept)
    return _about(source, Q, R, Qf, weights, samples, dt, kept)


@dataclass(frozen=True, eq=False)
class Mpc:
    """A model predictive controller about a point, as `mpc` makes it.

    Attributes
    ----------
    lin : LinearModel
        Sampled.
    gain : Gain
        Of the regulator that it is where no limit is near.
    """

    lin: LinearModel
    gain: Gain
    horizon: Horizon

    def matrices(self, e: ArrayLike | None = None) -> Matrices:
        """Return the quadratic program at x - x0 = e (nx,), 0 by default, for any solver."""
        return self.horizon.matrices(e, 0.0)

    def bind(self, robot: Robot) -> Policy:
        """Return policy(t, q, v) -> u for a robot that has the model's states and inputs."""
        lin = self.lin
        StateFeedback(lin, self.gain.K).bind(robot)  # refuses another robot
        state = StateMap(robot, reference=lin.reference, frame=lin.frame)
        fed, near = [state.names.index(name) for name in lin.state_names], np.zeros(state.nx)
        near[fed] = lin.x0

        def at(_: float, q: Array, v: Array) -> tuple[Array, Array]:
            return lin.u0, state.read(q, v, near=near)[fed] - lin.x0

        return _Run(self.horizon, at)


@dataclass(frozen=True, eq=False)
class TrajectoryMpc(TrajectoryFeedback):
    """A model predictive controller along a trajectory and about its end, as `mpc` makes it.

    Attributes
    ----------
    trajectory : LinearTrajectory
    schedule : GainSchedule
        Of the regulator that it is where no limit is near.
    """

    horizon: Horizon

    def matrices(self, e: ArrayLike | None = None, t: float = 0.0) -> Matrices:
        """Return the quadratic program of the sample at t [s], at the error e (nx,)."""
        return self.horizon.matrices(e, t)

    def law(self) -> Any:
        """Return law(t, e) -> u of the error at a time of the run."""
        plans = Receding(self.horizon)
        return lambda t, e: self.commanded(t)[2] + plans.step(t, e)

    def bind(self, robot: Robot) -> Policy:
        """Return policy(t, q, v) -> u for a robot that has the trajectory's states and inputs."""
        super().bind(robot)  # refuses another robot
        state = StateMap(robot, frame=self.frame)

        def at(t: float, q: Array, v: Array) -> tuple[Array, Array]:
            q_star, v_star, u_star = self.commanded(t)
            return u_star, moving_error(state, q_star, v_star, q, v)

        return _Run(self.horizon, at)


class _Run(Receding):
    """The policy of a run: what is planned of u and x, from `at`, at each sample."""

    def __init__(self, horizon: Horizon, at: Any) -> None:
        super().__init__(horizon)
        self._at, self._clock = at, Clock(horizon.dt)

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        self._clock.tick(t)
        u, e = self._at(t, q, v)
        return u + self.step(t, e)


class _Kept(NamedTuple):
    """What is limited: places among inputs, states and outputs, names and limits (m,) of all."""

    inputs: list[int]
    states: list[int]
    outputs: list[int]
    names: tuple[str, ...]
    low: Array
    high: Array

    def rows(self, C: Array, D: Array, u: Array, x: Array, y: Array) -> tuple[Array, ...]:
        """Return E, D, low and high of a `Stage` where inputs, states and outputs have a target."""
        (_, nx), nu = C.shape, D.shape[1]
        none, target = np.zeros((len(self.states), nu)), self.target(u, x, y)
        E = np.vstack((np.zeros((len(self.inputs), nx)), np.eye(nx)[self.states], C[self.outputs]))
        D = np.vstack((np.eye(nu)[self.inputs], none, D[self.outputs]))
        return E, D, self.low - target, self.high - target

    def target(self, u: Array, x: Array, y: Array) -> Array:
        return np.concatenate((u[self.inputs], x[self.states], y[self.outputs]))


def _limits(of: LinearModel | LinearTrajectory, robot: Robot, limits: Any, dt: float) -> _Kept:
    known = (*state_keys(robot.joint_names), *input_keys(of))
    beside = [name for name in of.output_names if name not in of.state_names]
    outputs: dict[str, Range] = {}
    parts = []
    for part in limits if isinstance(limits, list | tuple) else [limits]:
        if isinstance(part, Mapping):
            own = {
                key: range_of(key, value)
                for key, value in part.items()
                if stands_for_any(key, beside) and not stands_for_any(key, known)
            }
            outputs |= {beside[i]: x for i, x in by_name("output", own, beside).items()}
            part = {key: value for key, value in part.items() if key not in own}
        parts.append(part)
    acting = chosen_limits(robot, parts if isinstance(limits, list | tuple) else parts[0])[0]
    low, high = saturation(robot, acting, robot.neutral(), dt, 1)[:2]
    found = {name: (low[i], high[i]) for i, name in enumerate(of.input_names)}
    found |= {name: acting[name] for name in of.state_names if name in acting}
    found |= {name: outputs[name] for name in beside if name in outputs}
    found = {name: x for name, x in found.items() if np.isfinite(x).any()}
    if wrong := [name for name, (least, largest) in found.items() if least > largest]:
        raise InputError(f"limits leave {listed(wrong)} nothing: the least is above the largest")
    inputs, states, out = (
        [i for i, name in enumerate(names) if name in among]
        for names, among in (
            *((of.input_names, found), (of.state_names, found), (of.output_names, outputs)),
        )
    )
    bounds = np.array(list(found.values())).reshape(-1, 2).T
    return _Kept(inputs, states, out, tuple(found), *bounds)


def _about(
    lin: LinearModel,
    Q: Any,
    R: Any,
    Qf: Any,
    weights: str | None,
    samples: int,
    dt: float,
    kept: _Kept,
) -> Mpc:
    sampled, steady = lin.discretize(dt), asks_steady(Qf)
    cost = (Q, R) if Q is None or R is None else sampled_cost(lin, dt, Q, R)
    gain = lqr(sampled, *cost, weights=weights)
    StateFeedback(sampled, gain.K)  # refuses a moving reference
    target = kept.target(lin.u0, lin.x0, lin.y0)
    far = np.maximum(kept.low - target, target - kept.high) > 1e-9 * np.maximum(1.0, abs(target))
    if far.any():
        raise InputError(
            f"the point itself is beyond the limits of {listed(np.array(kept.names)[far])}; give "
            "wider limits or another point"
        )
    total = np.block([[gain.Q, gain.N], [gain.N.T, gain.R]])
    whole = np.hstack((sampled.A, sampled.B))
    end = gain.P if steady else weight("Qf", Qf, lin.state_names)
    with bounded_by("a smaller Qf"):
        K, P, _ = samples_back([(total, whole)] * samples, end)
    rows = kept.rows(lin.C, lin.D, lin.u0, lin.x0, lin.y0)
    stages = [_stage(total, whole, *each, rows) for each in zip(K, P[:-1], strict=True)]
    return Mpc(sampled, gain, _horizon(stages[::-1], samples, dt, lin.input_names, kept))


def _along(
    traj: LinearTrajectory,
    Q: Any,
    R: Any,
    Qf: Any,
    weights: str | None,
    samples: int,
    dt: float,
    kept: _Kept,
) -> TrajectoryMpc:
    schedule = tvlqr(traj, Q, R, Qf, dt, weights=weights)
    follows, state = TrajectoryFeedback(traj, schedule), StateMap(traj.robot, frame="local")
    Q, R, models = schedule.Q, schedule.R, along(traj.resampled(dt))

    def rows(u: Array, C: Array, D: Array, q: Array, v: Array, y: Array) -> tuple[Array, ...]:
        x = np.zeros(state.nx)  # of the base's place the error is limited
        x[state.groups.q_m] = state.joint_positions(q)
        x[state.nx // 2 :] = state.velocities(v)
        return kept.rows(C, D, u, x, y)

    stages = []
    for k, sample in enumerate(held_stages(traj, dt, Q, R)):
        at = (getattr(models, name)[k + 1] for name in "CDqvy")
        u = follows.commanded(k * dt)[2]
        stages.append(_stage(*sample, schedule.K[k], schedule.P[k + 1], rows(u, *at)))
    end = follows.end
    sampled, cost = end.discretize(dt), sampled_cost(end, dt, Q, R)
    P, K = steady_regulator(end, Q, R, dt)
    total = np.block([[cost.Q, cost.N], [cost.N.T, cost.R]])
    there = rows(end.u0, end.C, end.D, end.q, end.v, end.y0)
    stages += [_stage(total, np.hstack((sampled.A, sampled.B)), K, P, there)] * samples
    plans = _horizon(stages, samples, dt, traj.input_names, kept)
    return TrajectoryMpc(traj, schedule, plans)


def _stage(total: Array, whole: Array, K: Array, P: Array, rows: tuple[Array, ...]) -> Stage:
    """Return a sample of that cost, transition and gain, where P is the cost from its end on."""
    nx = len(P)
    A, B = whole[:, :nx], whole[:, nx:]
    L = np.linalg.inv(np.linalg.cholesky(total[nx:, nx:] + B.T @ P @ B)).T
    return Stage(A, B, K, L, *rows)


def _horizon(
    stages: list[Stage], samples: int, dt: float, inputs: tuple[str, ...], kept: _Kept
) -> Horizon:
    return Horizon(tuple(stages), samples, kept.inputs, dt, inputs, kept.names)
