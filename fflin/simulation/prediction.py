"""Motion predicted by the linear model under the control law of the simulated robot."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, instance
from fflin.control.channel import Channel
from fflin.control.linear_controller import LinearController
from fflin.control.policies import Compensation
from fflin.control.tracking import AT_THE_END, TrajectoryFeedback
from fflin.dynamics.coordinates import moved_by, moving_errors
from fflin.dynamics.state import StateMap
from fflin.linear.model import LinearModel
from fflin.simulation.plant import Plant

# Returns the command (nu,) at a deviation (nx,) from a linear model's point.
LinearLaw: TypeAlias = Callable[[Array], Array]

_SHARES = (0.0, 0.5, 0.5, 1.0)  # of a step, at which its stages are


class Predictor(NamedTuple):
    """Linear model, and a factory of its law in the initial state.

    States of a controller that are integrated along stand behind the robot's.
    """

    lin: LinearModel
    law: Callable[[], LinearLaw]


def predictor(plant: Plant, policy: Any, linear: Any) -> Predictor | TrajectoryFeedback | None:
    """Return the predictor of a run: the policy's own model, or the given model."""
    if isinstance(linear, bool | np.bool_) and not linear:
        return None
    given = not (linear is None or isinstance(linear, bool | np.bool_))
    along = isinstance(policy, TrajectoryFeedback)
    if along and not given:
        return policy
    own: Any = getattr(policy, "lin", None)
    if given and not along:
        own = _checked(plant, policy, linear)
    law = _law(policy, own) if isinstance(own, LinearModel) else None
    if law is not None and own.state_names == plant.state.names:
        extended = isinstance(policy, LinearController) and not policy.dt
        return Predictor(policy.around(own)[0] if extended else own, law)
    if linear is None:
        return None
    raise InputError(
        f"linear= is given, but this model cannot predict a motion under {type(policy).__name__}; "
        "leave linear= out, or give the full model of a StateFeedback, an "
        "OutputFeedback, a LinearController or no policy"
    )


def _checked(plant: Plant, policy: Any, linear: Any) -> LinearModel:
    """Return the model that is to predict, or raise `InputError` where it is of another run."""
    instance("linear", linear, LinearModel, "a fflin.LinearModel, True or False")
    state = plant.state
    names = (state.names, plant.actuation.names, state.frame)
    same = (linear.state_names, linear.input_names, linear.frame) == names and not linear.moving
    if isinstance(policy, LinearController):
        same = same and linear.output_names == policy.lin.output_names
    if not same or not linear.reference.isApprox(state.reference, 1e-9):
        raise InputError(
            f"linear is a model of '{linear.robot}' with other states, inputs, frame or reference "
            f"than the simulation of '{plant.robot.name}'; linearise that robot in the policy's "
            "frame and reference"
        )
    return linear


def _law(policy: Any, lin: LinearModel) -> Callable[[], LinearLaw] | None:
    """Return a factory of a policy's law in deviations from a point, if the policy is linear."""
    if policy is None:
        return lambda: lambda _: np.zeros(len(lin.u0))
    if isinstance(policy, LinearController):
        if not policy.dt:
            _, gains, offset = policy.around(lin)
            return lambda: lambda e: offset + gains @ e
        stays = policy.terms

        def measured() -> LinearLaw:
            law = Compensation(len(stays.A), lambda _: stays)
            return lambda e: law.step(0.0, lambda _, u: lin.y0 + lin.C @ e + lin.D @ (u - lin.u0))

        return measured
    own, K = getattr(policy, "lin", None), getattr(policy, "K", None)
    if K is None or not isinstance(own, LinearModel):
        return None
    fed = [lin.state_names.index(name) for name in own.state_names]
    apart = lin.x0[fed] - own.x0
    return lambda: lambda e: own.u0 - K @ (e[fed] + apart)


def predict(plan: Any, x: Array, steps: int, target: Array) -> Array:
    """Return the states (N, nx) of the linear model in closed loop; no rows where it has none."""
    if plan.predictor is None:
        return x[:0]
    # A prediction that overflows is none.
    with np.errstate(over="ignore", invalid="ignore"):
        if isinstance(plan.predictor, TrajectoryFeedback):
            # The frame of a trajectory's errors.
            e = _errors(plan.predictor, plan, moving_errors("local", x[:1], target[:1])[0], steps)
            found = moved_by("local", target, e[: len(x)]) if len(e) >= len(x) else x[:0]
        else:
            found = _states(plan.predictor, plan, x[0], steps)[: len(x)]
    return found if len(found) == len(x) and np.isfinite(found).all() else x[:0]


def _states(predictor: Predictor, plan: Any, x: Array, steps: int) -> Array:
    dt, _, every, sample, delay, *_ = plan.times
    lin, limits = predictor.lin.generator, plan.limits
    if lin is None:  # what happens between its samples is not known
        return x[:0]
    x0, u0 = lin.x0, lin.u0
    of = [lin.state_names.index(f"qdot_m.{name}") for name in limits.wheel_names]
    channel = Channel(
        predictor.law(), plan.initial, limits, sample, delay, speeds=lambda e: (x0 + e)[of]
    )
    rows: list[Array] = []
    e: Array = np.concatenate((x, np.zeros(len(x0) - len(x)))) - x0

    def slope(_: int, e: Array) -> Array:
        rate: Array = lin.A @ e + lin.B @ (channel.ask(e) - u0) + lin.f0
        return rate

    stepped = not sample and channel.cuts
    held = lin.discretize(dt) if sample else lin
    A, B, f0 = held.A, held.B, held.f0
    if not (sample or stepped):  # then a step is a matrix and a shift
        f0 = _after(dt, np.zeros(len(e)), slope)
        A = np.column_stack([_after(dt, unit, slope) - f0 for unit in np.eye(len(e))])
    for step in range(steps):
        u = channel.begin(step, e) if sample else u0
        if step % every == 0:
            rows.append(e)
        e = _after(dt, e, slope) if stepped else A.dot(e) + B.dot(u - u0) + f0
    return (np.array([*rows, e]) + x0)[:, : len(x)]


def _after(dt: float, e: Array, slope: Callable[[int, Array], Array]) -> Array:
    """Return e one step later, by the classical Runge-Kutta method, from its derivative."""
    stages: list[Array] = []
    for stage, share in enumerate(_SHARES):
        stages.append(slope(stage, e + share * dt * stages[-1] if stages else e))
    after: Array = e + dt / 6.0 * (stages[0] + 2.0 * (stages[1] + stages[2]) + stages[3])
    return after


def _errors(policy: TrajectoryFeedback, plan: Any, e: Array, steps: int) -> Array:
    """Return the errors from a trajectory that the linear models along it have, see `predict`."""
    dt, _, every, sample, delay, *_ = plan.times
    models, limits = policy.models, plan.limits
    start, end = models.t[[0, -1]].tolist()

    def at(t: float) -> tuple[Array, Array, Array]:
        """Return A, B and the inputs of the trajectory at a time of the run."""
        if t > policy.duration * AT_THE_END:
            return policy.end.A, policy.end.B, policy.end.u0
        return (*models.matrices(min(start + t, end)), policy.reference(t)[2])

    of = [models.state_names.index(f"qdot_m.{name}") for name in limits.wheel_names]

    def speeds(t: float, e: Array) -> Array:
        return policy.reference(t)[1][plan.wheels] + e[of]

    channel = Channel(policy.law(), plan.initial, limits, sample, delay, speeds)
    rows, after, ended, held = [], at(0.0), False, models.hold == "previous"
    for step in range(steps):
        t = step * dt
        if step % every == 0:
            rows.append(e)
        ends = not ended and t > policy.duration - 1e-6 * dt
        u = None if ends and sample else channel.begin(step, t, e)
        if ends:
            # From here on the error is counted from rest.
            ended, after = True, at(math.inf)
            stop = policy.reference(policy.duration)[1] - policy.end.v
            e = e + np.concatenate((np.zeros(len(e) // 2), StateMap(models.robot).velocities(stop)))
        u = channel.begin(step, t, e) if u is None else u
        before, half, after = after, at(t + 0.5 * dt), at(t + dt)
        # What the trajectory holds ends with the step, whatever acts from the next knot on.
        last = at(t + (1.0 - 1e-6) * dt) if held else after
        points = (before, half, half, last)

        def slope(stage: int, e: Array, t: float = t, u: Array = u, points: Any = points) -> Array:
            A, B, u_star = points[stage]
            if stage and channel.continuous:
                u = channel.ask(t + min(_SHARES[stage], plan.last_node) * dt, e)
            rate: Array = A @ e + B @ (u - u_star)
            return rate

        e = _after(dt, e, slope)
    return np.array([*rows, e])
