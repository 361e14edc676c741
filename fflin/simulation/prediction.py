"""The motion that the linear model predicts under the law that the robot is under."""

from __future__ import annotations

import numpy as np

from fflin.base.validation import Array
from fflin.control.channel import Channel
from fflin.linear.model import LinearModel


def predict(
    lin: LinearModel,
    K: Array,
    limits: tuple[Array, Array],
    sample: int,
    delay: int,
    x: Array,
    dt: float,
    steps: int,
    every: int,
) -> Array:
    """Return the states (rows, nx) of the linear model in closed loop.

    Parameters
    ----------
    lin : LinearModel
        Continuous, or sampled with the time of the samples.
    K : ndarray (nu, nx)
    limits : tuple of ndarray (nu,)
    sample, delay : int
        In steps, as `Channel` takes them.
    x : ndarray (nx,)
        Where it begins.
    dt : float
        Step [s].
    steps, every : int
        Steps in all, and from one row to the next; the last step has a row in any case.
    """
    x0, u0 = lin.x0, lin.u0

    def law(e: Array) -> Array:
        u: Array = u0 - K @ e
        return u

    channel = Channel(law, u0, *limits, sample, delay)
    rows = []
    e = x - x0
    if lin.dt:
        # Between the samples of a sampled model there is nothing to say.
        whole = round(lin.dt / dt)
        if sample != whole or any(count % whole for count in (delay, every, steps)):
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
