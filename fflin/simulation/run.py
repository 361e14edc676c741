"""The simulation loop over a plan, with the recording of its rows."""

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from fflin.base.errors import InputError
from fflin.base.process import Progress
from fflin.base.validation import Array
from fflin.control.channel import Channel
from fflin.dynamics.points import LARGEST_SPEED
from fflin.kernel.loop import StopConditions, goes_on
from fflin.simulation.plan import Plan
from fflin.simulation.plant import Conserved, MomentumReference, Plant
from fflin.simulation.times import LARGEST_TURN

# Function that takes one step from (t, q, v) with initial inputs u; returns q and v at the end.
Advance: TypeAlias = Callable[[float, Array, Array, Array], tuple[Array, Array]]

STOPS = ("", "diverged", "left the chart", "stopped")

_LOOK = 16  # steps between checks of the clock
_LARGEST_SHOWN = 1e3  # [rad] per step, above which a message does not give the number


class Recording(NamedTuple):
    """Recorded rows of a run: times (N,), motion, inputs and conserved quantities."""

    t: Array
    q: Array
    v: Array
    u: Array
    momentum: Array  # (N, 6) from the external impulse; see `Conserved`
    center: Array  # (N, 3) centre of mass from this momentum
    steps: int  # number of steps that were begun
    stopped: str  # reason if the run ended early, or an empty text
    engine: str  # name of the engine


# A diverging motion overflows before it is stopped, so NumPy need not warn.
@np.errstate(over="ignore", invalid="ignore")
def go(plan: Plan, plant: Plant, conserved: Conserved, hint: str = "") -> Recording:
    """Simulate a plan in Python; `plant` and `conserved` belong to the simulated robot.

    The progress bar of a long run shows `hint`.
    """
    times, q, v = plan.times, plan.q, plan.v
    dt, channel = times.dt, plan.channel()
    reference = MomentumReference(conserved, plan.method, dt, q, v)
    advance = _advance(plan, plant, conserved, reference, channel)
    rows = tuple(
        np.empty((times.rows, size)) for size in (1, len(q), len(v), len(plan.initial), 6, 3)
    )
    count = 0

    def record(t: float, u: Array) -> None:
        nonlocal count
        values: tuple[Array | float, ...] = t, q, v, u, reference.momentum, reference.center(t)
        for row, value in zip(rows, values, strict=True):
            row[count] = value
        count += 1
        if plan.callback is not None:
            plan.callback(t, q.copy(), v.copy(), u.copy())

    step, stopped, project, bar = 0, "", plan.project, Progress(plan.progress)
    ending = ending_of(plan, stop_conditions(plan))
    try:
        for step in range(times.steps):
            t = step * dt
            u = plan.initial if channel is None else channel.begin(step, t, q, v)
            if step % times.every == 0:
                record(t, u)
            q, v = advance(t, q, v, u)
            t = (step + 1) * dt
            if project:
                conserved.impose(q, v, reference.momentum, reference.center(t))
            if stopped := ending(t, q, v):
                break
            if step % _LOOK == 0:
                bar(step + 1, times.steps, hint=hint)
    except KeyboardInterrupt:
        if not count:
            raise
        stopped = f"interrupted at t = {step * dt:g} s"
    finally:
        bar.close()
    if not stopped.startswith(("diverged", "interrupted")):
        record(t, u)
    t_of, q_of, v_of, u_of, momentum, center = (row[:count] for row in rows)
    return Recording(t_of[:, 0], q_of, v_of, u_of, momentum, center, step + 1, stopped, "python")


def _advance(
    plan: Plan,
    plant: Plant,
    conserved: Conserved,
    reference: MomentumReference,
    channel: Channel | None,
) -> Advance:
    """Return the function that takes one step."""
    take = plan.method(plant.robot.model, plan.times.dt).step
    ask = channel.ask if channel is not None and channel.continuous else None
    pushed = not plant.isolated(driven=channel is not None)
    stage, wrench, wrenches = plant.stage, conserved.wrench, reference.wrenches
    latest = plan.last_node * plan.times.dt
    follow, weights = plan.law and plan.law.advance, plan.method.step_weights(plan.times.dt)[1]

    def asked(t: float, q: Array, v: Array, u: Array) -> tuple[Array, Array]:
        stages, last = 0, t + latest

        def f(t: float, q: Array, v: Array) -> Array:
            nonlocal stages
            # At the first stage, u is already the policy's command.
            a, push = stage(t, q, v, ask(min(t, last), q, v) if ask and stages else u)
            if pushed:
                wrenches[stages][:] = wrench(q, push)
            stages += 1
            if follow:
                follow(weights[stages - 1, : stages + 1], stages == len(weights))
            return a

        end = take(f, t, q, v)
        if pushed:
            reference.advance()
        return end

    return asked


def stop_conditions(plan: Plan) -> StopConditions:
    """Return the stop conditions of a run, with squared rates in the order of v (nv,)."""
    squares = np.full(len(plan.v), LARGEST_SPEED**2)
    squares[plan.turning] = (LARGEST_TURN / plan.times.dt) ** 2
    sign = float(np.sign(plan.chart.scalar(plan.q))) if plan.chart else 0.0
    return StopConditions(squares=squares, sign=[sign])


def ending_of(plan: Plan, stop: StopConditions) -> Callable[[float, Array, Array], str]:
    """Build a function that returns why a run ends, or an empty text if the run continues."""
    # The entries of a list are read faster than the entries of an array.
    stop = stop._replace(squares=stop.squares.tolist())
    anywhere = stop._replace(sign=[0.0])
    turned = plan.chart.origin_quaternion if plan.chart else (0.0, 0.0, 0.0, 1.0)
    origin = [0.0, 0.0, 0.0, *map(float, turned)]

    def ending(t: float, q: Array, v: Array) -> str:
        place, rates = q.tolist(), v.tolist()
        if goes_on(stop, origin, place, rates):
            for event in plan.events:
                value = event(t, q.copy(), v.copy())
                try:
                    margin = float(value)
                except (TypeError, ValueError):
                    margin = math.nan
                if math.isnan(margin):
                    raise InputError(
                        f"an event returned {value!r} at t = {t:g} s, expected a number"
                    )
                if margin <= 0.0:
                    return f"{getattr(event, '__name__', 'event')} at t = {t:g} s"
            return ""
        if goes_on(anywhere, origin, place, rates):
            return f"left the chart at t = {t:g} s: the base rotated by 180 deg from the reference"
        dt, turn = plan.times.dt, float(np.abs(v[plan.turning]).max()) * plan.times.dt
        detail = f": a joint or the base rotates by {turn:.2g} rad per step"
        known = LARGEST_TURN <= turn <= _LARGEST_SHOWN
        return f"diverged at t = {t:g} s in steps of {dt:g} s{detail * known}; give a smaller dt"

    return ending


def stop_of(message: str) -> int:
    """Return the index in STOPS for the message with which a run ended."""
    found = (at for at, word in enumerate(STOPS) if word and message.startswith(word))
    return next(found, len(STOPS) - 1) if message else 0
