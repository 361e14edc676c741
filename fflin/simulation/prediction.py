"""The motion that the linear model predicts under the law that the robot is under."""

from __future__ import annotations

import numpy as np

from fflin.base.validation import Array
from fflin.control.channel import Channel
from fflin.linear.model import LinearModel
from fflin.simulation.plan import Plan


def predict(plan: Plan, x: Array, steps: int) -> Array:
    """Return the states (N, nx) of the linear model in closed loop; no rows where it has none.

    Parameters
    ----------
    plan : Plan
        Its model is continuous, or sampled with the time of the samples.
    x : ndarray (N, nx)
        The states of the nonlinear robot, where the first row begins.
    steps : int
        That are taken; the last one has a row in any case.
    """
    if plan.linear is None or plan.K is None:
        return x[:0]
    # A prediction that overflows is none.
    with np.errstate(over="ignore", invalid="ignore"):
        found = _states(plan.linear, plan.K, plan, x[0], steps)[: len(x)]
    return found if len(found) == len(x) and np.isfinite(found).all() else x[:0]


def _states(lin: LinearModel, K: Array, plan: Plan, x: Array, steps: int) -> Array:
    dt, _, every, sample, delay, _ = plan.times
    x0, u0, limits = lin.x0, lin.u0, plan.limits
    if limits.wheels or limits.pulses:
        # Both change within a sample.
        lin = lin.generator or lin
    rotors = (
        [lin.state_names.index(f"qdot_m.{name}") for name in limits.wheels.names]
        if limits.wheels
        else []
    )

    def law(e: Array) -> Array:
        u: Array = u0 - K @ e
        return u

    def speeds(e: Array) -> Array:
        return x0[rotors] + e[rotors]

    channel = Channel(law, u0, limits, sample, delay, speeds)
    rows = []
    e = x - x0
    if lin.dt:
        # Between the samples of a sampled model there is nothing to say.
        whole = round(lin.dt / dt)
        within = limits.wheels or limits.pulses
        if within or sample != whole or any(count % whole for count in (delay, every, steps)):
            return np.zeros((0, len(x)))
        for step in range(0, steps, whole):
            u = channel.begin(step, e)
            if step % every == 0:
                rows.append(e)
            e = lin.A @ e + lin.B @ (u - u0) + lin.f0
        return np.array([*rows, e]) + x0

    held = lin.discretize(dt)
    for step in range(steps):
        u = channel.begin(step, e)
        if step % every == 0:
            rows.append(e)
        if sample:
            e = held.A @ e + held.B @ (u - u0) + held.f0
            continue
        stages: list[Array] = []
        for share in (0.0, 0.5, 0.5, 1.0):
            at = e + share * dt * stages[-1] if stages else e
            stages.append(lin.A @ at + lin.B @ (channel.ask(at) - u0) + lin.f0)
        e = e + dt / 6.0 * (stages[0] + 2.0 * (stages[1] + stages[2]) + stages[3])
    return np.array([*rows, e]) + x0
