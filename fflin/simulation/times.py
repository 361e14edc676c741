"""Step, sample time, delay, recorded rows and duration of a simulation."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fflin.base.errors import FflinWarning, InputError
from fflin.base.validation import Array, number, whole
from fflin.control.linear_controller import LinearController, closed_loop
from fflin.control.policies import StateFeedback, decider, fed_back
from fflin.control.tracking import TrajectoryFeedback, largest_rate, tracking_of
from fflin.dynamics.integrators import held_exponential
from fflin.dynamics.state import StateMap
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from fflin.simulation.plan import SimulationOptions

# Bounds of an automatic duration [s], and the time step [s] of the linear loop that determines it.
SHORTEST, LONGEST, _LOOK = 60.0, 600.0, 0.5
LARGEST_TURN = 1.0  # [rad] largest rotation within a step for which integrators are accurate
_STEP = 0.01  # [s]
_MOST_ENTRIES, _MOST_STEPS = 500_000_000, 10_000_000_000
# If the step is chosen automatically, a larger number of steps than the first causes a warning
# (half a minute of computing). A larger number than the second is refused (some hours).
_MANY_STEPS, _ENDLESS = 50_000, 10_000_000
# With more rows than the first number, only some steps are recorded, in about as many rows as the
# second.
_MANY_ROWS, _FEW_ROWS = 100_000, 10_000
_FOREVER = 1e100  # [s]; its inverse squared does not underflow


class Times(NamedTuple):
    """The step `dt` [s], the number of steps, and sample time, delay and rows in steps."""

    dt: float
    steps: int
    every: int  # steps between recorded rows
    sample: int  # steps between samples of the law; 0 if it is evaluated at all stages
    delay: int  # steps from a sample to its effect
    fastest: float  # largest magnitude of the loop's poles [1/s]; 0 if unknown
    thinned: bool  # whether `every` was chosen automatically

    @property
    def rows(self) -> int:
        """Largest number of recorded rows."""
        return self.steps // self.every + 2

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the recorded rows, for the report."""
        said = f"one in {self.every} steps is recorded; every=1 (--every 1) records all "
        notes: tuple[str, ...] = (f"{said}{self.steps:,} steps",) if self.thinned else ()
        if self.sample and self.every % self.sample and self.sample % self.every:
            aside = (
                f"a row is recorded every {self.every} steps, but the controller samples every "
                f"{self.sample} steps, so the "
            )
            notes += (f"{aside}rows are not a valid trajectory",)
        return notes

    @property
    def slow(self) -> float:
        """Square of the largest angular velocity for which rotations per step are small enough."""
        return float((LARGEST_TURN / self.dt) ** 2)

    def require_room(self, width: int, *, chosen: bool) -> None:
        """Raise an error for too many rows or steps; warn of many automatically `chosen` steps."""
        most = _ENDLESS if self.thinned else _MOST_STEPS
        if self.rows * width > _MOST_ENTRIES or self.steps > most:
            raise InputError(
                f"{self.steps * self.dt:g} s in steps of {self.dt:g} s are {self.steps:.3g} steps "
                f"and {self.rows:.3g} rows, which is too many; use a larger dt or `every`, or a "
                "slower gain if a fast pole of the loop requires this step"
            )
        if chosen and self.fastest * _STEP > 1.0 and self.steps > _MANY_STEPS:
            warnings.warn(
                "the simulation takes long, because the fastest pole of the loop at "
                f"{self.fastest:.3g} 1/s requires {self.steps:,} steps of {self.dt:.3g} s; give "
                "dt=, sample= or a slower gain",
                FflinWarning,
                stacklevel=3,
            )


def times_of(policy: object, options: SimulationOptions) -> Times:
    """Return the times of a simulation from the options and the policy."""
    duration, dt, every, sample = options.duration, options.dt, options.every, options.sample
    follows = tracking_of(policy)
    if sample is not None:
        sample = _positive("sample", sample)
    else:
        by = decider(policy)
        made = by if hasattr(by, "dt") else getattr(policy, "lin", None)
        sample = getattr(follows.schedule if follows else made, "dt", None) or None
    fastest = 0.0 if sample else _fastest_pole(policy, follows)
    if duration is None and follows is None:
        raise InputError("the duration is missing; give duration= in s")
    duration = _positive("duration", follows.duration if follows and duration is None else duration)
    delay = number("delay", options.delay)
    if not 0.0 <= delay < duration:
        raise InputError(
            f"delay is {delay:g} s, expected at least 0 and less than the duration of "
            f"{duration:g} s, so that a command takes effect"
        )
    if every is not None:
        every = whole("every", every, 1)
    if dt is None:
        dt = _STEP
        if fastest * dt > 1.0:
            dt = float(0.5 ** np.ceil(np.log2(fastest)))
        if sample or delay:
            dt = _part_of(sample or delay, dt, duration, delay)
    dt = _positive("the step dt", dt)
    steps = max(1, round(duration / dt))
    if abs(steps * dt - duration) > 1e-6 * duration:
        if sample or delay:
            _in_steps("duration", duration, dt)  # raises an error
        steps = int(np.ceil(duration / dt))
        dt = duration / steps
    if sample is None:
        sample = dt if delay else 0.0
    samples, late = _in_steps("sample", sample, dt), _in_steps("delay", delay, dt)
    thinned = every is None and steps > _MANY_ROWS
    if every is None:  # rows of a sampled loop are at its samples
        part = max(samples, 1)
        every = part * -(-steps // (_FEW_ROWS * part)) if thinned else 1
    return Times(dt, steps, every, samples, late, fastest, thinned)


def _fastest_pole(policy: object, follows: TrajectoryFeedback | None) -> float:
    """Return the largest magnitude [1/s] of a continuous loop's poles; 0 if it is not known."""
    if follows is not None:
        return largest_rate(follows.schedule)
    closed = closed_loop(policy)
    if closed is None or closed[1]:
        return 0.0
    return float(np.abs(np.linalg.eigvals(closed[0])).max())


def _in_steps(name: str, time: float, dt: float) -> int:
    """Convert a time [s] to a number of steps; raise `InputError` unless it is a multiple of dt."""
    if abs(round(time / dt) * dt - time) > 1e-6 * dt:
        raise InputError(
            f"{name} is {time:g} s, expected a multiple of the step dt = {dt:g} s; "
            "choose dt accordingly"
        )
    return round(time / dt)


def _part_of(sample: float, largest: float, *times: float) -> float:
    """Return a step that divides the sample time and, if possible, the other times."""
    least = int(np.ceil(sample / largest))
    for parts in range(least, least + 1000):
        dt = sample / parts
        if all(abs(round(time / dt) * dt - time) <= 1e-6 * dt for time in times):
            return dt
    return sample / least


def _positive(name: str, value: object) -> float:
    time = number(name, value)
    if not 1.0 / _FOREVER < time <= _FOREVER:
        raise InputError(f"{name} is {time:g} s, expected more than 0 and at most {_FOREVER:g} s")
    return time


def time_to_settle(
    robot: Robot, policy: StateFeedback | LinearController, q: Array, v: Array | None
) -> float:
    """Return the time [s] at which the errors of the linear loop stay below 1 % of their maxima.

    The time is rounded up to tens of seconds.
    """
    lin = policy.lin
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    start = state.read(q, np.zeros(robot.nv) if v is None else v, near=state.read(lin.q, lin.v))
    e = start[[state.names.index(name) for name in lin.state_names]] - lin.x0
    closed = closed_loop(policy)
    assert closed is not None
    loop, dt, _ = closed
    step = dt or _LOOK
    if not dt:
        loop = held_exponential(loop, np.zeros((len(loop), 0)), step)[0]
    e = np.concatenate((e, np.zeros(len(loop) - len(e))))
    places = [f"q_m.{name}" for name in robot.joint_names if name not in robot.wheels]
    kinds = [[f"{group}.{axis}" for axis in "xyz"] for group in ("q_b", "r_b")] + [places]
    fed = {*fed_back(policy)}
    rows = [[i for i, name in enumerate(lin.state_names) if name in fed & {*k}] for k in kinds]
    history = [e]
    for _ in range(math.ceil(LONGEST / step)):
        history.append(loop @ history[-1])
    errors = np.array([np.abs(np.array(history)[:, of]).max(axis=1, initial=0.0) for of in rows])
    away = (errors > 0.01 * errors.max(axis=1, keepdims=True)).any(axis=0)
    last = float(np.flatnonzero(away).max(initial=0)) * step
    return max(SHORTEST, 10.0 * math.ceil(last / 10.0)) if last < 0.99 * LONGEST else SHORTEST
