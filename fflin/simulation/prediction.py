"""Motion predicted by the linear model under the control law of the simulated robot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, instance
from fflin.control.channel import Channel
from fflin.control.linear_controller import LinearController
from fflin.control.policies import Compensation
from fflin.linear.model import LinearModel
from fflin.simulation.plant import Plant

# Function of a deviation (nx,) from a linear model's point that returns the command (nu,).
LinearLaw: TypeAlias = Callable[[Array], Array]


class Predictor(NamedTuple):
    """Linear model, and a function that creates a new instance of its control law.

    In the deviation, the robot's states come first, then the states of a continuous-time
    controller.
    """

    lin: LinearModel
    law: Callable[[], LinearLaw]


def predictor(plant: Plant, policy: Any, linear: object) -> Predictor | None:
    """Return the predictor of a run: the policy's own model, or the given model."""
    if isinstance(linear, bool | np.bool_) and not linear:
        return None
    given = not (linear is None or isinstance(linear, bool | np.bool_))
    own: Any = _checked(plant, policy, linear) if given else getattr(policy, "lin", None)
    law = _law(policy, own) if isinstance(own, LinearModel) else None
    if law is not None and own.state_names == plant.state.names:
        along = isinstance(policy, LinearController) and not policy.dt
        return Predictor(policy.around(own)[0] if along else own, law)
    if linear is None:
        return None
    raise InputError(
        "linear= is given, but this model cannot predict a motion with a policy of type "
        f"{type(policy).__name__}; leave linear= out, or give the full model of a StateFeedback, "
        "an OutputFeedback, a LinearController or no policy"
    )


def _checked(plant: Plant, policy: object, linear: object) -> LinearModel:
    """Return the given model, or raise `InputError` if it does not fit the simulation."""
    linear = instance("linear", linear, LinearModel, "a fflin.LinearModel, True or False")
    state = plant.state
    names = (state.names, plant.actuation.names, state.frame)
    same = (linear.state_names, linear.input_names, linear.frame) == names and not linear.moving
    if isinstance(policy, LinearController):
        same = same and linear.output_names == policy.lin.output_names
    if not same or not linear.reference.isApprox(state.reference, 1e-9):
        raise InputError(
            f"linear is a model of '{linear.robot}' with other states, inputs, frame or "
            f"reference than the simulation of '{plant.robot.name}'; linearise the simulated "
            "robot with the frame and the reference of the policy"
        )
    return linear


def _law(policy: object, lin: LinearModel) -> Callable[[], LinearLaw] | None:
    """Return a function that creates a policy's linear law; None for a nonlinear policy."""
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


# After an overflow the prediction is omitted, so NumPy need not warn.
@np.errstate(over="ignore", invalid="ignore")
def predict(plan: Any, x: Array, steps: int) -> Array:
    """Return the states (N, nx) that the linear closed loop predicts; no rows if it cannot."""
    lin = plan.predictor and plan.predictor.lin.generator
    if lin is None:  # no model, or one in discrete time without its motion between samples
        return x[:0]
    dt, _, every, sample, delay, *_ = plan.times
    x0, u0, limits = lin.x0, lin.u0, plan.limits
    of = [lin.state_names.index(f"qdot_m.{name}") for name in limits.wheel_names]
    channel = Channel(
        plan.predictor.law(), plan.initial, limits, sample, delay, speeds=lambda e: (x0 + e)[of]
    )
    rows: list[Array] = []
    e: Array = np.concatenate((x[0], np.zeros(len(x0) - x.shape[1]))) - x0

    def slope(e: Array) -> Array:
        rate: Array = lin.A @ e + lin.B @ (channel.ask(e) - u0) + lin.f0
        return rate

    stepped = not sample and channel.cuts
    held = lin.discretize(dt) if sample else lin
    A, B, f0 = held.A, held.B, held.f0
    if not (sample or stepped):  # a step is then e -> A e + f0
        f0 = _after(dt, np.zeros(len(e)), slope)
        A = np.column_stack([_after(dt, unit, slope) - f0 for unit in np.eye(len(e))])
    for step in range(steps):
        u = channel.begin(step, e) if sample else u0
        if step % every == 0:
            rows.append(e)
        e = _after(dt, e, slope) if stepped else A.dot(e) + B.dot(u - u0) + f0
    found = (np.array([*rows, e]) + x0)[: len(x), : x.shape[1]]
    return found if len(found) == len(x) and np.isfinite(found).all() else x[:0]


def _after(dt: float, e: Array, slope: Callable[[Array], Array]) -> Array:
    """Advance e by one step of the classical Runge-Kutta method; `slope` is its derivative."""
    first = slope(e)
    second = slope(e + 0.5 * dt * first)
    third = slope(e + 0.5 * dt * second)
    after: Array = e + dt / 6.0 * (first + 2.0 * (second + third) + slope(e + dt * third))
    return after
