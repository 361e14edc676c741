"""The loop over a plan: step after step, recorded until it ends."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from fflin.base.errors import InputError
from fflin.base.progress import Progress
from fflin.base.validation import Array
from fflin.control.channel import Channel
from fflin.simulation.conservation import Conserved, Course
from fflin.simulation.plan import LARGEST_SPEED, LARGEST_TURN, Plan
from fflin.simulation.plant import Plant

# Take one step from (t, q, v) under u as it begins; return q and v at its end.
Advance: TypeAlias = Callable[[float, Array, Array, Array], tuple[Array, Array]]

_LOOK = 16  # steps between looks at the clock


class Record(NamedTuple):
    """What a run went through: rows of time (N,), motion, inputs and what is conserved.

    Attributes
    ----------
    t, q, v, u : ndarray (N, ...)
    momentum : ndarray (N, 6)
        As the impulse from outside makes it, see `Conserved`.
    center : ndarray (N, 3)
        Of mass, where that momentum takes it.
    steps : int
        Steps that were begun.
    stopped : str
        Why it ended before its time, if it did.
    """

    t: Array
    q: Array
    v: Array
    u: Array
    momentum: Array
    center: Array
    steps: int
    stopped: str


# A motion that diverges overflows before it is stopped.
@np.errstate(over="ignore", invalid="ignore")
def go(plan: Plan, plant: Plant, conserved: Conserved, progress: bool | None = None) -> Record:
    """Run a plan to its end.

    Parameters
    ----------
    plan : Plan
    plant : Plant
        The robot that moves.
    conserved : Conserved
        Of that robot.
    progress : bool, optional
        Whether a bar is shown; see `simulate`.
    """
    times, q, v = plan.times, plan.q, plan.v
    dt, slow, channel = times.dt, times.slow, plan.channel()
    course = Course(conserved, plan.method, dt, q, v)
    advance = _advance(plan, plant, conserved, course, channel)
    recorder = _Recorder(plan, course)
    step, stopped, project = 0, "", plan.project
    ending, watched = _ending(plan), bool(plan.chart or plan.events)
    bar = Progress(times.steps, progress)
    try:
        for step in range(times.steps):
            t = step * dt
            u = plan.initial if channel is None else channel.begin(step, t, q, v)
            if step % times.every == 0:
                recorder.add(t, q, v, u)
            q, v = advance(t, q, v, u)
            t = (step + 1) * dt
            if project:
                conserved.impose(q, v, course.momentum, course.center(t))
            # The square is above that of any turn, and not finite where an entry is not.
            if watched or not float(v.dot(v)) < slow:
                stopped = ending(t, q, v)
                if stopped:
                    break
            if step % _LOOK == 0:
                bar.update(step + 1)
    except KeyboardInterrupt:
        if not recorder.count:
            raise
        stopped = f"interrupted at t = {step * dt:g} s"
    finally:
        bar.close()
    if not stopped.startswith(("diverged", "interrupted")):
        recorder.add(t, q, v, u)
    return recorder.record(step + 1, stopped)


class _Recorder:
    """Rows that fill, and the callback that is told of them."""

    def __init__(self, plan: Plan, course: Course) -> None:
        self._course, self._callback, self.count = course, plan.callback, 0
        sizes = (len(plan.q), len(plan.v), len(plan.initial), 6, 3)
        self._t = np.empty(plan.times.rows)
        self._rows = tuple(np.empty((plan.times.rows, size)) for size in sizes)

    def add(self, t: float, q: Array, v: Array, u: Array) -> None:
        row, course = self.count, self._course
        q_of, v_of, u_of, momentum, center = self._rows
        self._t[row], q_of[row], v_of[row], u_of[row] = t, q, v, u
        momentum[row], center[row] = course.momentum, course.center(t)
        self.count += 1
        if self._callback is not None:
            self._callback(t, q.copy(), v.copy(), u.copy())

    def record(self, steps: int, stopped: str) -> Record:
        q, v, u, momentum, center = (rows[: self.count] for rows in self._rows)
        return Record(self._t[: self.count], q, v, u, momentum, center, steps, stopped)


def _advance(
    plan: Plan, plant: Plant, conserved: Conserved, course: Course, channel: Channel | None
) -> Advance:
    """Return what takes one step."""
    take = plan.method(plant.robot.model, plan.times.dt).step
    ask = channel.ask if channel is not None and channel.continuous else None
    pushed = not plant.isolated(driven=channel is not None)

    if not ask and not pushed:
        acting: Array | None = None
        rate = plant.held(plan.initial)

        def held(t: float, q: Array, v: Array, u: Array) -> tuple[Array, Array]:
            nonlocal acting, rate
            if u is not acting:
                acting, rate = u, plant.held(u)
            return take(rate, t, q, v)

        return held

    stage, wrench, wrenches = plant.stage, conserved.wrench, course.wrenches

    def asked(t: float, q: Array, v: Array, u: Array) -> tuple[Array, Array]:
        stages = 0

        def f(t: float, q: Array, v: Array) -> Array:
            nonlocal stages
            # The first stage is the point that was asked about already.
            a, push = stage(t, q, v, ask(t, q, v) if ask and stages else u)
            if pushed:
                wrenches[stages][:] = wrench(q, push)
            stages += 1
            return a

        end = take(f, t, q, v)
        if pushed:
            course.advance()
        return end

    return asked


def _ending(plan: Plan) -> Callable[[float, Array, Array], str]:
    """Return what says why a run ends where a step has led it; nothing where it goes on."""
    chart = plan.chart
    scalar = chart.scalar(plan.q) if chart else 1.0

    def ending(t: float, q: Array, v: Array) -> str:
        nonlocal scalar
        turn = float(np.abs(v[plan.turning]).max(initial=0.0)) * plan.times.dt
        if not np.abs(v).max() < LARGEST_SPEED or turn > 1e3:
            return f"diverged at t = {t:g} s"
        if not turn < LARGEST_TURN:
            return f"diverged at t = {t:g} s: a joint or the base turns by {turn:.2g} rad a step"
        if chart:
            before, scalar = scalar, chart.scalar(q)
            if before * scalar < 0.0:
                return (
                    f"left the chart at t = {t:g} s: the base turned by 180 deg from the reference"
                )
        return _event(plan, t, q, v)

    return ending


def _event(plan: Plan, t: float, q: Array, v: Array) -> str:
    """Name the first event that is no longer positive."""
    for event in plan.events:
        value = event(t, q.copy(), v.copy())
        try:
            margin = float(value)
        except (TypeError, ValueError):
            margin = math.nan
        if math.isnan(margin):
            raise InputError(f"an event gave {value!r} at t = {t:g} s, expected a number")
        if margin <= 0.0:
            return f"{getattr(event, '__name__', 'event')} at t = {t:g} s"
    return ""
