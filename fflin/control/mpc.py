"""Model predictive control about a fixed point or along a trajectory."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress
from typing import NamedTuple, TypeAlias

import numpy as np

from fflin.base import html
from fflin.base.errors import FflinWarning, InputError, listed, optional_package
from fflin.base.names import by_name, input_keys, stands_for_any, state_keys
from fflin.base.process import in_one_thread
from fflin.base.validation import (
    Array,
    ArrayLike,
    Indices,
    Mask,
    instance,
    number,
    vector,
    whole,
)
from fflin.control.estimator import Estimator
from fflin.control.gain import Gain
from fflin.control.loops import Loop, Measure, next_sample
from fflin.control.lqg import require_estimated, steady_rejection
from fflin.control.lqr import at_fixed_point, regulator
from fflin.control.optimal.differential_riccati import bounded_by, samples_back
from fflin.control.policies import Deviation, Feedback, OutputSensing, StateFeedback
from fflin.control.policy import BoundLaw, Command, Noise
from fflin.control.tracking import TrajectoryFeedback
from fflin.control.trajectory_end import rest_or_fall, steady_regulator
from fflin.control.tvlqr import asks_steady, held_stages, tvlqr
from fflin.control.weights import Rule, Weight, sampled_cost, warn_of_integral, weight
from fflin.dynamics.outputs import Measuring
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_fit
from fflin.linear.linear_trajectory import LinearTrajectory, along
from fflin.linear.model import LinearModel, refuse_delayed, refuse_frozen
from fflin.linear.trajectory import refuse_periodic
from fflin.robot.fields import chosen_limits, input_limits, range_of
from fflin.robot.robot import Robot

# Weights Q, R and Qf, and the rule that gives Q and R if they are None.
Cost: TypeAlias = "tuple[Weight | None, Weight | None, Weight | str, Rule | None]"

# Largest number of entries of the matrices that map the inputs to the predicted states and limited
# signals. Matrices with this number of entries fill 160 MB.
_MOST_ENTRIES = 20_000_000

# Settings of the solver DAQP. The rows of the constraints are scaled to length 1. The width of a
# limit is the upper bound minus the lower bound of its scaled row. _EXACT is the tolerance of the
# constraints, and _PRICE is the weight of soft-limit violations, both relative to the median width.
# _YIELDS is the regularisation of soft limits. If a plan exceeds a soft limit by less than
# _VIOLATED times the median width, the violation is not reported.
_EXACT, _PRICE, _YIELDS, _VIOLATED = 1e-9, 1e3, 1.0, 1e-6

# If the robot exceeds a soft limit by at most this fraction of the difference between the upper and
# the lower limit, the violation is not reported. For a limit on one side only, this is the smallest
# reported violation, in the unit of the signal.
_OVER = 1e-3

# The two kinds of soft-limit violations in the notes of a run.
_OF_PLANS, _OF_ROBOT = "plans that exceed", "samples at which the robot exceeds"

# Constants of DAQP: _OPEN is infinity, _SOFT is the code of a soft limit, and _SOFTENED is the exit
# flag for a plan that exceeds a soft limit. _MOST is the largest number of iterations.
_OPEN, _SOFT, _SOFTENED, _MOST = 1e30, 8, 2, 10_000


@in_one_thread
def mpc(
    lin: LinearModel | LinearTrajectory,
    Q: Weight | None = None,
    R: Weight | None = None,
    *,
    horizon: int = 20,
    sample: float | None = None,
    dt: float | None = None,
    limits: float | str | Mapping[str, object] | Sequence[object] | None = "urdf",
    Qf: Weight | str = "steady",
    weights: Rule | None = None,
    disturbance: Estimator | None = None,
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
    sample : float
        Sample time h [s] of the controller; by default the sample time of a sampled model.
    dt : float
        Former name of `sample`.
    limits : "urdf", float, mapping or list of them, optional
        Limits as in `simulate`, for inputs, states and outputs: {name, group or pattern: magnitude,
        or (least, largest)}. The limits bound the values of these signals. Along a trajectory,
        however, limits of q_b and r_b bound the error relative to the trajectory. With None, the
        only limit is that thrusters cannot pull.
    Qf : "steady", or as Q
        Weight on the error after N samples, or at the end of a trajectory. "steady" is the cost
        to go of the regulator from the end of the horizon on.
    weights : {"urdf", "identity"} or mapping, optional
        Rule for the weights if Q and R are omitted, as in `lqr`.
    disturbance : Estimator, optional
        Filter of `kalman` for the sampled model, about a point. The controller then feeds back the
        estimate of the filter instead of the state. The regulator equations of `lqg` give the
        steady state and inputs under the estimated disturbances, from which the errors are counted,
        so that constant disturbances leave no error.

    Returns
    -------
    Mpc, OutputMpc or TrajectoryMpc
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
    >>> policy = fflin.mpc(lin, sample=0.2, horizon=10, limits={"tau_b": 2.0, "tau_m": 1.0})
    >>> q0 = fflin.configuration(robot, {"joint_2": 0.4})
    >>> motion = fflin.simulate(robot, policy, q0=q0, duration=4.0, dt=0.05)
    >>> bool(abs(motion.u[:, 6:]).max() <= 1.0), policy.matrices(motion.x[0]).H.shape
    (True, (90, 90))
    """
    instance(
        "lin",
        lin,
        (LinearModel, LinearTrajectory),
        "a LinearModel or a LinearTrajectory",
    )
    if isinstance(lin, LinearModel):
        refuse_delayed(lin, "model predictive control")
        refuse_frozen(lin, "model predictive control")
    else:
        refuse_periodic(lin, "model predictive control")
    samples = whole("horizon", horizon, 1)
    if sample is not None and dt is not None:
        raise InputError(
            "sample and dt are both given, but dt is the former name of sample"
        )
    if sample is None:
        sample = dt
    if sample is None:
        if not lin.dt:
            raise InputError("sample is missing; give the sample time [s]")
        sample = lin.dt
    dt = number("sample", sample)
    # The design starts from the continuous model or trajectory. If lin is sampled, its sampling
    # time must be the same as the controller's.
    source = lin if isinstance(lin, LinearTrajectory) else lin.generator
    has_other_dt = lin.dt > 0.0 and lin.dt != dt
    if source is None or source.dt or has_other_dt:
        raise InputError(
            "lin is sampled with another dt, or the model before sampling is not known; give the "
            "continuous model and sample="
        )
    if disturbance is None and isinstance(source, LinearModel):
        warn_of_integral(source, (Q, R), weights, "mpc")
    cost = (Q, R, Qf, weights)
    stageless = _stageless_horizon(source, limits, samples, dt)
    if isinstance(source, LinearTrajectory):
        if disturbance is not None:
            raise InputError(
                "disturbance is given along a trajectory, expected a model about a point"
            )
        return _along(source, stageless, cost)
    about = _about(source, stageless, cost)
    if disturbance is None:
        return about
    expected = "an Estimator, as fflin.kalman returns it"
    estimator = instance("disturbance", disturbance, Estimator, expected)
    require_estimated(about.gain, estimator)
    return OutputMpc(about.lin, about.gain, about.horizon, estimator)


# Largest number of rows of the table on the card of a notebook.
_SHOWN = 100


class _Predictive(Feedback):
    horizon: Horizon

    def __repr__(self) -> str:
        horizon = self.horizon
        summary = f"{horizon.samples} samples of {horizon.dt:g} s, {len(horizon.limited)} limits"
        return f"{type(self).__name__}('{horizon.robot}', {summary})"

    def _repr_html_(self) -> str:
        horizon = self.horizon
        rows = [["limited signal", "", "least", "largest"]]
        columns = horizon.limited, horizon.at, horizon.low, horizon.high
        for name, at, low, high in zip(*columns, strict=True):
            kind = "input" if at < len(horizon.inputs) else "soft"
            rows.append([name, kind, f"{low:.5g}", f"{high:.5g}"])
        table = html.table(rows[:_SHOWN], "ll")
        left = len(rows) - _SHOWN
        more = f"and {left} more, see horizon" if left > 0 else ""
        return html.result_card(self, table, html.paragraph(more))

    def bind(self, robot: Robot) -> Command:
        """Return policy(t, q, v) -> u for a robot with the same states and inputs."""
        return Receding(self.horizon, self.deviation(robot))

    def matrices(self, e: ArrayLike | None = None, t: float = 0.0) -> Matrices:
        """Return the quadratic program for the error e (nx,) at time t [s]; e is zero by default.

        About a point, e is the deviation x - x0, and the program does not depend on t.
        """
        horizon = self.horizon
        stages = self.horizon.window(max(number("t", t), 0.0))
        nx = len(stages[0].A)
        size = len(horizon.inputs) * horizon.samples
        start = (
            np.zeros(nx)
            if e is None
            else vector("e", e, nx, "a deviation of the state")
        )
        states, z, limited = condensed(stages, planned=False)
        (low, high, soft), free = horizon.bounds(stages), limited[:, size:] @ start
        double = 2.0 * z[:, :size].T
        H, g = double @ z[:, :size], double @ (z[:, size:] @ start)
        names = (
            tuple(f"{name}[{k}]" for k in range(horizon.samples) for name in names)
            for names in (horizon.inputs, horizon.limited)
        )
        program = (H, g, limited[:, :size], low - free, high - free, soft)
        return Matrices(*program, states[..., size:], states[..., :size], *names)


@dataclass(eq=False, repr=False)
class Mpc(_Predictive):
    """Model predictive controller about a point.

    Attributes
    ----------
    lin : LinearModel
        The sampled model.
    gain : Gain
        The regulator that acts if no limit is active.
    horizon : Horizon
        The predicted samples (stages) of the quadratic program, and their limits.
    """

    lin: LinearModel
    gain: Gain
    horizon: Horizon


class Target(NamedTuple):
    """Steady state and inputs under a disturbance, as deviations from the operating point."""

    x: Array  # (nx,)
    u: Array  # (nu,)
    limited: Array  # limited signals of all stages


@dataclass(eq=False, repr=False)
class OutputMpc(OutputSensing, Mpc):
    """Model predictive controller that feeds back an estimate of the state and disturbances.

    Attributes
    ----------
    estimator : Estimator
        The filter that estimates the state, the disturbances and the biases.
    Pi, Gamma : ndarray (nx, nw), (nu, nw)
        Steady state ``Pi w`` and inputs ``Gamma w`` under disturbances w.
    """

    estimator: Estimator
    noise: Noise | None = None

    def __post_init__(self) -> None:
        self.Pi, self.Gamma = steady_rejection(self.gain, self.estimator)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the outputs of the model."""
        return self.lin.output_names

    @property
    def sample_time(self) -> float:
        """Sample time [s]."""
        return self.lin.dt

    def bind(self, robot: Robot) -> Command:
        """Return policy(t, q, v) -> u for a robot with the same states, inputs and outputs."""
        lin = self.lin
        state = self.state_map(robot)
        require_fit(lin, robot, state, sensed=True)
        return _Estimating(self, state)

    def target(self, stages: Sequence[Stage], w: Array) -> Target:
        """Return the steady state and inputs under the disturbance w (nw,) during the stages."""
        nx = len(self.lin.A)
        at = slice(nx, nx + len(w))
        step = self.estimator.A[at, at]
        limited, now = list[Array](), w
        for stage in stages:
            after = step @ now
            limited.append(stage.E @ (self.Pi @ after) + stage.D @ (self.Gamma @ now))
            now = after
        return Target(self.Pi @ w, self.Gamma @ w, np.concatenate(limited))


class _Estimating(Loop):
    """Policy that advances the estimate and plans from it."""

    def __init__(self, policy: OutputMpc, state: StateMap) -> None:
        lin = policy.lin
        sizes = len(policy.estimator.A), len(lin.C)
        measuring = Measuring(state, lin.q), state.read(lin.q, lin.v)
        super().__init__(
            state,
            lin.dt,
            sizes,
            lambda t: (partial(self._step, t), *measuring),
            policy.noise,
            start=lin.y0,
        )
        self.policy = policy
        self.receding = Receding(policy.horizon, policy.deviation(state.robot))

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of the plans."""
        return self.receding.notes

    def _step(self, t: float, z: Array, measure: Measure) -> tuple[Array, Array]:
        """Return the command and the next estimate."""
        policy = self.policy
        lin, estimator = policy.lin, policy.estimator
        nx = len(lin.A)
        x = z[:nx]
        disturbance = z[nx : nx + policy.Pi.shape[1]]
        target = policy.target(policy.horizon.window(t), disturbance)
        du = target.u + self.receding.step(t, x - target.x, target)
        u = lin.u0 + du
        innovation = measure(u) - lin.y0 - estimator.C @ z - estimator.D @ du
        following = estimator.A @ z + estimator.B @ du + estimator.L @ innovation
        return u, following


@dataclass(eq=False, repr=False)
class TrajectoryMpc(_Predictive, TrajectoryFeedback):
    """Model predictive controller along a trajectory and about its end.

    The inherited attributes contain the trajectory and the regulator's schedule.
    """

    horizon: Horizon


def _stageless_horizon(
    model: LinearModel | LinearTrajectory, limits: object, samples: int, dt: float
) -> Horizon:
    """Return a horizon with the limits of a model's signals, but no stages."""
    robot = model.robot if isinstance(model, LinearTrajectory) else model._robot
    if robot is None:
        raise InputError(
            "lin was loaded from a file, which contains no robot; linearise again"
        )
    inputs, states, outputs = model.input_names, model.state_names, model.output_names
    further_outputs = [name for name in outputs if name not in states]
    known = (*state_keys(robot.joint_names), *input_keys(model))
    limit_of = dict[str, object]()
    parts = list(limits) if isinstance(limits, list | tuple) else [limits]
    for k, part in enumerate(parts):
        if isinstance(part, Mapping) and further_outputs:
            output_limits, parts[k] = _split_limits(part, further_outputs, known)
            limit_of |= output_limits
    end = model.v[-1] if isinstance(model, LinearTrajectory) else model.v
    given = parts[0] if len(parts) == 1 else parts
    acting = chosen_limits(robot, given, robot.wheels_at(end))
    limit_of |= {name: acting[name] for name in states if name in acting}
    # an output that is also a state has its limit as a state
    output_keys = [name if name in further_outputs else "" for name in outputs]
    names = (*inputs, *states, *output_keys)
    unlimited = (-np.inf, np.inf)
    others = [limit_of.get(name, unlimited) for name in (*states, *output_keys)]
    limits_of_inputs = np.array(input_limits(robot, acting))
    low, high = np.hstack((limits_of_inputs, np.array(others).T))
    at = np.flatnonzero(np.isfinite((low, high)).any(axis=0))
    if samples**2 * (len(at) + len(states)) * len(inputs) > _MOST_ENTRIES:
        raise InputError(
            f"horizon is {samples} samples with {len(at)} limits, which makes the optimisation "
            "problem too large; give a shorter horizon or fewer limits"
        )
    limited = tuple(names[i] for i in at)
    return Horizon((), samples, dt, inputs, robot.name, limited, at, low[at], high[at])


def _split_limits(
    limits: Mapping[str, object], outputs: list[str], known: tuple[str, ...]
) -> tuple[dict[str, tuple[float, float]], dict[str, object]]:
    """Return the limits {output: (least, largest)} of outputs, and all other entries of `limits`.

    A key that also stands for a name in `known` is no output.
    """
    keys = [
        key
        for key in limits
        if stands_for_any(key, outputs) and not stands_for_any(key, known)
    ]
    ranges = {key: range_of(key, limits[key]) for key in keys}
    range_at = by_name("output", ranges, outputs)
    output_limits = {outputs[index]: limit for index, limit in range_at.items()}
    rest = {key: limit for key, limit in limits.items() if key not in keys}
    return output_limits, rest


def _about(lin: LinearModel, horizon: Horizon, cost: Cost) -> Mpc:
    """Design the controller about a point; its horizon has no stages yet."""
    lin = at_fixed_point(lin)
    Q, R, Qf, weights = cost
    dt = horizon.dt
    sampled = lin.discretize(dt)
    if Q is None or R is None:
        gain = regulator(sampled, Q, R, weights=weights)
    else:
        gain = regulator(sampled, *sampled_cost(lin, dt, Q, R), weights=weights)
    StateFeedback(sampled, gain.K)  # refuses a moving reference
    total = np.block([[gain.Q, gain.N], [gain.N.T, gain.R]])
    end = gain.P if asks_steady(Qf) else weight("Qf", Qf, lin.state_names)
    whole = np.hstack((sampled.A, sampled.B))
    with bounded_by("a smaller Qf"):
        K, P, _ = samples_back([(total, whole)] * horizon.samples, end)
    stages = [
        horizon.stage(total, whole, *gain_and_cost, lin, lin.u0, lin.x0)
        for gain_and_cost in zip(K, P, strict=False)
    ]
    # The limits are relative to the point, so 0 must be within them.
    first = stages[0]
    exceeded = np.maximum(first.low, -first.high) > 1e-9
    if exceeded.any():
        raise InputError(
            f"the point exceeds the limits of {listed(compress(horizon.limited, exceeded))}; "
            "give wider limits, or linearise about another point"
        )
    return Mpc(sampled, gain, replace(horizon, stages=tuple(stages[::-1])))


def _along(traj: LinearTrajectory, horizon: Horizon, cost: Cost) -> TrajectoryMpc:
    """Design the controller along a trajectory; its horizon has no stages yet."""
    Q, R, Qf, weights = cost
    dt = horizon.dt
    traj.refuse_switches("predictive controllers")
    schedule = tvlqr(traj, Q, R, Qf, dt, weights=weights)
    Q, R = schedule.Q, schedule.R  # with default weights, if none are given
    state = StateMap(traj.robot, frame="local")

    def limited_state(lin: LinearModel, v: Array) -> Array:
        """Return the state (nx,) to which limits are relative, at the configuration of a model."""
        # The base pose is zero, because limits of the base pose apply to the error relative to the
        # trajectory.
        pose = np.zeros(6)
        return np.concatenate((pose, state.joint_positions(lin.q), state.velocities(v)))

    stages = list[Stage]()
    # Along the trajectory: sample k ends at knot k + 1.
    follows = TrajectoryFeedback(traj, schedule)
    models = along(traj.resampled(dt), traj.partition)
    for k, (total, transition) in enumerate(held_stages(traj, dt, Q, R)):
        K = schedule.K[k]
        P = schedule.P[k + 1]
        lin = models[k + 1]
        _, _, u = follows.commanded(k * dt)
        x = limited_state(lin, models.v[k + 1])
        stages.append(horizon.stage(total, transition, K, P, lin, u, x))

    # After the trajectory: the steady motion at its end.
    rest = rest_or_fall(traj)
    end = rest.of_trajectory(traj.robot)
    sampled = end.discretize(dt)
    weight_of_sample = sampled_cost(end, dt, rest.map.T @ Q @ rest.map, R)
    total = np.block(
        [
            [weight_of_sample.Q, weight_of_sample.N],
            [weight_of_sample.N.T, weight_of_sample.R],
        ]
    )
    transition = np.hstack((sampled.A, sampled.B))
    P, K = steady_regulator(rest, Q, R, dt)
    x = limited_state(end, rest.v)
    last = horizon.stage(total, transition, K, P, end, end.u0, x)
    stages += [last] * horizon.samples
    return TrajectoryMpc(traj, schedule, replace(horizon, stages=tuple(stages)))


class Stage(NamedTuple):
    """One predicted sample: ``e' = A e + B d`` with ``d = u - u*``, and limits on ``E e' + D d``.

    e and e' are the errors at the start and at the end of the sample, and u* are the reference
    inputs. E and D have a row for each of the m limited signals. The inputs come first.
    """

    A: Array  # (nx, nx)
    B: Array  # (nx, nu)
    K: Array  # (nu, nx), gain of the regulator without limits
    L: Array  # (nu, nu): d = L z - K e costs z'z more than d = -K e
    E: Array  # (m, nx)
    D: Array  # (m, nu)
    low: Array  # (m,)
    high: Array  # (m,)


class Matrices(NamedTuple):
    """Quadratic program over the inputs ``d = u - u*`` of N samples.

    It minimises ``d'H d / 2 + g'd`` subject to ``low <= G d <= high``.

    Attributes
    ----------
    H, g : ndarray (N nu, N nu), (N nu,)
        Cost.
    G, low, high : ndarray (m, N nu), (m,), (m,)
        Limits.
    soft : ndarray (m,) of bool
        Limits that may be exceeded if the program is otherwise infeasible.
    Phi, Gamma : ndarray (N + 1, nx, nx), (N + 1, nx, N nu)
        Predicted errors ``e_k = Phi_k e + Gamma_k d``.
    inputs : tuple of str
        Names "name[k]" of the entries of d.
    limits : tuple of str
        Names "name[k]" of the rows of G. Limits of states and outputs apply at the end of sample k.
    """

    H: Array
    g: Array
    G: Array
    low: Array
    high: Array
    soft: Mask
    Phi: Array
    Gamma: Array
    inputs: tuple[str, ...]
    limits: tuple[str, ...]


def condensed(stages: Sequence[Stage], planned: bool) -> tuple[Array, Array, Array]:
    """Return the arrays that predict the errors, z and the limited values over N stages.

    z is the scaled difference between the inputs d and the inputs -K e of the regulator, so that
    ``d = L z - K e``. Each of the three arrays has N nu + nx columns. The first N nu columns
    multiply z if `planned` is True, and d otherwise. The last nx columns multiply the initial
    error.
    """
    (nx, nu), size = stages[0].B.shape, len(stages) * stages[0].B.shape[1]
    e = np.eye(nx, size + nx, size)
    states = [e]
    efforts, limited = list[Array](), list[Array]()
    for k, stage in enumerate(stages):
        selector = np.eye(nu, size + nx, k * nu)
        if planned:
            d = stage.L @ selector - stage.K @ e
            efforts.append(selector)
        else:
            d = selector
            efforts.append(np.linalg.solve(stage.L, selector + stage.K @ e))
        e = stage.A @ e + stage.B @ d
        states.append(e)
        limited.append(stage.E @ e + stage.D @ d)
    return np.array(states), np.vstack(efforts), np.vstack(limited)


@dataclass(frozen=True, eq=False)
class Horizon:
    """Predicted samples (stages) about a point or along a trajectory; each plan covers N stages."""

    stages: tuple[Stage, ...]
    samples: int  # N
    dt: float
    inputs: tuple[str, ...]
    robot: str
    limited: tuple[str, ...]  # names of the limited signals
    at: Indices  # indices of the limited signals among inputs, states and outputs
    low: Array
    high: Array

    def stage(
        self,
        total: Array,
        whole: Array,
        K: Array,
        P: Array,
        lin: LinearModel,
        u: Array,
        x: Array,
    ) -> Stage:
        """Return the stage of a sample with the gain K.

        `total` (nx + nu, nx + nu) is the cost matrix of the error and the input, and `whole`
        (nx, nx + nu) maps them to the next error. P is the cost matrix at the end of the sample.
        The limits of the stage are relative to the input `u`, the state `x` and the output
        ``of.y0``.
        """
        (nx, nu), at_point = lin.B.shape, np.concatenate((u, x, lin.y0))[self.at]
        A, B = np.split(whole, [nx], axis=1)
        L = np.linalg.inv(np.linalg.cholesky(total[nx:, nx:] + B.T @ P @ B)).T
        E = np.vstack((np.zeros((nu, nx)), np.eye(nx), lin.C))[self.at]
        D = np.vstack((np.eye(nu), np.zeros((nx, nu)), lin.D))[self.at]
        return Stage(A, B, K, L, E, D, self.low - at_point, self.high - at_point)

    def window(self, t: float) -> tuple[Stage, ...]:
        """Return the N stages from time t on, or the last N stages if fewer remain."""
        k = min(
            round(min(t / self.dt, len(self.stages))), len(self.stages) - self.samples
        )
        return self.stages[k : k + self.samples]

    def bounds(self, stages: Sequence[Stage]) -> tuple[Array, Array, Mask]:
        """Return the lower limits, the upper limits and a mask of the soft limits of all stages."""
        soft = np.tile(self.at >= len(self.inputs), len(stages))
        low = np.concatenate([stage.low for stage in stages])
        high = np.concatenate([stage.high for stage in stages])
        return low, high, soft


class Receding(BoundLaw):
    """Policy that applies the first input of each plan.

    `at(t, q, v)` returns the reference inputs u* and the error e.
    """

    def __init__(self, horizon: Horizon, at: Deviation) -> None:
        self.of = horizon
        self._at = at
        self._last = -np.inf
        self.solves = self.unfinished = 0
        # For each kind of soft-limit violation: the number of plans or samples with a violation,
        # and the relative magnitude and the description of the largest violation.
        self._violations = dict.fromkeys((_OF_PLANS, _OF_ROBOT), (0, 0.0, ""))
        self._due: tuple[Stage, Array] | None = None  # stage and d of the last sample
        if horizon.limited:
            # Set up the solver now, so that the first sample takes no longer than the others.
            self._change(horizon.window(0.0))
            self._start()

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the run: number of plans, violations of soft limits, and solver failures."""
        message = (
            f"number of MPC plans, each of {self.of.samples} samples of {self.of.dt:g} s: "
            f"{self.solves}"
        )
        for event, (count, _, worst) in self._violations.items():
            if count:
                message += f"; {event} a soft limit: {count} (worst: {worst})"
        if self.unfinished:
            message += (
                "; plans without a solution, replaced by the saturated LQR command: "
                f"{self.unfinished}"
            )
        if not self.solves:
            return ()
        return (message,)

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        """Return the command (nu,) at a sample."""
        self._last = next_sample(t, self._last, self.of.dt)
        u, e = self._at(t, q, v)
        command: Array = u + self.step(t, e)
        return command

    def step(self, t: float, e: Array, target: Target | None = None) -> Array:
        """Return the command (nu,) minus the reference inputs, at a sample with error e (nx,).

        With a target, the error and the result are relative to its state and inputs.
        """
        stages = self.of.window(t)
        now = stages[0]
        d = -stages[0].K @ e
        if not self.of.limited:
            return d
        if stages[0] is not self._stages[0]:
            self._change(stages)
            self._model.update(A=self._rows)
        free = self._free @ e
        steady_x: Array = np.zeros(len(e))
        steady_u: Array = np.zeros(len(d))
        if target is not None:
            steady_x, steady_u = target.x, target.u
            free = free + target.limited
        self.solves += 1
        if self._due:
            # Check the soft limits at the end of the last sample. The robot may exceed a limit even
            # if the plan does not, because the robot differs from the model.
            previous, last = self._due
            reached = previous.E @ (e + steady_x) + previous.D @ last
            width = previous.high - previous.low
            excess = np.maximum(previous.low - reached, reached - previous.high)
            width = np.where(np.isfinite(width) & (width > 0.0), width, 1.0)
            self._record(_OF_ROBOT, t - self.of.dt, excess, 1.0 / width, _OVER)
        z, flag = self._solved(free)
        if flag <= 0:
            # The solver found no solution. Solve again without a warm start.
            self._start()
            z, flag = self._solved(free)
        if flag == _SOFTENED:
            reached = free + self._G @ z
            excess = np.maximum(self._low - reached, reached - self._high)
            self._record(_OF_PLANS, t, excess, self._unit, _VIOLATED * self._size)
        if flag > 0:
            d += now.L @ z[: len(d)]
        else:
            self.unfinished += 1
            if self.unfinished == 1:
                warnings.warn(
                    f"the MPC optimisation found no solution at t = {t:g} s (DAQP exit flag "
                    f"{flag}); at such samples, the LQR command is applied instead, saturated at "
                    "the input limits",
                    FflinWarning,
                    2,
                )
        # indices of limited inputs, whose limits come first
        hard = self.of.at[self.of.at < len(d)]
        low, high = (
            limit[: len(hard)] - steady_u[hard] for limit in (now.low, now.high)
        )
        d[hard] = np.clip(d[hard], low, high)
        self._due = now, d + steady_u
        return d

    def _record(
        self, event: str, t: float, excess: Array, unit: Array, least: float
    ) -> None:
        """Count a plan or sample that violates a soft limit, and record the largest violation.

        A soft limit is violated if its entry of ``excess * unit`` is larger than `least`. The
        entries are ordered by sample, and the first sample starts at time t [s].
        """
        fractions = np.where(self._soft[: len(excess)], excess * unit, 0.0)
        row = int(fractions.argmax())
        count, most, description = self._violations[event]
        if fractions[row] > max(most, least):
            sample, at = divmod(row, len(self.of.limited))
            most = float(fractions[row])
            when = t + (sample + 1) * self.of.dt
            description = f"{self.of.limited[at]} by {excess[row]:.2g} at {when:.4g} s"
        self._violations[event] = (
            count + bool(fractions[row] > least),
            most,
            description,
        )

    def _change(self, stages: tuple[Stage, ...]) -> None:
        self._stages = stages
        rows = condensed(stages, planned=True)[2]
        size = len(self.of.inputs) * self.of.samples
        low, high, self._soft = self.of.bounds(stages)
        self._G, self._free = rows[:, :size], rows[:, size:]
        length = np.linalg.norm(self._G, axis=1)
        moved = length > 1e-12 * length.max()  # False for limits that no input affects
        self._low = np.where(moved, low, -np.inf)
        self._high = np.where(moved, high, np.inf)
        self._unit = 1.0 / np.where(moved, length, 1.0)
        width = (self._high - self._low) * self._unit
        width = width[np.isfinite(width)]
        self._size = 1.0
        if len(width):
            self._size = float(np.median(width)) or 1.0
        self._rows = self._G * self._unit[:, None]

    def _start(self) -> None:
        self._model = optional_package(
            "daqp", "this needs the solver DAQP", "mpc"
        ).Model()
        self._model.settings = {"primal_tol": _EXACT * self._size, "iter_limit": _MOST}
        self._model.settings = {"w_soft": _PRICE * self._size, "rho_soft": _YIELDS}
        (m, size), kinds = self._rows.shape, (_SOFT * self._soft).astype(np.int32)
        open_ = np.full(m, _OPEN)
        self._model.setup(
            np.eye(size), np.zeros(size), self._rows, open_, -open_, kinds
        )

    def _solved(self, free: Array) -> tuple[Array, int]:
        low, high = (
            np.clip((limit - free) * self._unit, -_OPEN, _OPEN)
            for limit in (self._low, self._high)
        )
        self._model.update(bupper=high, blower=low)
        z, _, flag, _ = self._model.solve()
        return z, int(flag)
