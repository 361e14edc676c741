"""What a simulation is to do: its start, times, limits, method and events, checked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, number
from fflin.control.channel import Channel, Law, limits_of
from fflin.control.policies import Allocation, bound
from fflin.dynamics.state import StateMap
from fflin.linear.ignorable import rotor_names
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot
from fflin.simulation.integrators import Integrator, integrator
from fflin.simulation.plant import Plant

Event: TypeAlias = Callable[[float, Array, Array], float]
Callback: TypeAlias = Callable[[float, Array, Array, Array], None]

LARGEST_SPEED = 1e50  # in SI units; beyond it squares overflow
LARGEST_TURN = 1.0  # within one step [rad], beyond which no integrator follows
_STEP = 0.01  # [s]
_MOST_ENTRIES = 500_000_000


class Times(NamedTuple):
    """The step `dt` [s], and how many steps there are in all and between what happens.

    Attributes
    ----------
    dt : float
    steps : int
    every : int
        From one recorded row to the next.
    sample : int
        Between samples of the law; 0 where it is asked at every stage of every step.
    delay : int
        From a sample to its effect.
    """

    dt: float
    steps: int
    every: int
    sample: int
    delay: int

    @property
    def rows(self) -> int:
        """Most rows that are recorded."""
        return self.steps // self.every + 2

    @property
    def slow(self) -> float:
        """Square of the velocity up to which no turn within a step is too large."""
        return float((LARGEST_TURN / self.dt) ** 2)


@dataclass(frozen=True, eq=False)
class Plan:
    """A simulation to be done, which nothing changes while it runs.

    Attributes
    ----------
    q, v : ndarray (nq,), (nv,)
        Where it begins.
    times : Times
    law : Law or None
        Nothing but `initial` acts where there is none.
    initial : ndarray (nu,)
        What acts until the first command arrives.
    limits : tuple of ndarray (nu,)
        Least and largest value of each input.
    method : type of Integrator
    project : bool
        Whether momentum and centre of mass are kept.
    turning : ndarray of int
        The velocities whose turn within a step has a bound.
    chart : StateMap or None
        The run ends where the base leaves it.
    events : tuple of callable
    callback : callable or None
    """

    q: Array
    v: Array
    times: Times
    law: Law | None
    initial: Array
    limits: tuple[Array, Array]
    method: type[Integrator]
    project: bool
    turning: Array
    chart: StateMap | None
    events: tuple[Event, ...]
    callback: Callback | None

    def channel(self) -> Channel | None:
        """Return the way of the law's commands to the inputs, with nothing on it yet."""
        if self.law is None:
            return None
        return Channel(self.law, self.initial, *self.limits, self.times.sample, self.times.delay)


def make_plan(
    plant: Plant,
    policy: Any,
    lin: LinearModel | None,
    start: tuple[Array, Array],
    *,
    duration: float,
    dt: float | None,
    every: int,
    sample: float | None,
    delay: float,
    limits: Any,
    method: str,
    project: bool,
    events: Sequence[Event],
    callback: Callback | None,
) -> Plan:
    """Return the plan of a simulation; `simulate` says what its arguments mean.

    `lin` is the policy's model, where it has one.
    """
    robot, names = plant.robot, plant.actuation.names
    if sample is None:
        sample = getattr(getattr(policy, "lin", None), "dt", None) or None
    fastest = 0.0 if sample else _fastest_pole(policy, lin)
    times = times_of(duration, dt, every, sample, delay, fastest=fastest)
    if times.rows * (robot.nq + robot.nv + 2 * plant.state.nx) > _MOST_ENTRIES:
        raise InputError(
            f"{duration:g} s in steps of {times.dt:g} s are {times.rows:.3g} rows; take a larger "
            "dt or `every`"
        )
    within = limits_of(plant.actuation, limits)
    # The model's inputs are others where they are allocated to the robot's.
    same = lin is not None and lin.input_names == names
    decide = None if policy is None else bound(policy, robot)
    return Plan(
        *start,
        times=times,
        law=None if decide is None else Law(decide, names, within, times.slow),
        initial=lin.u0 if lin is not None and same else np.zeros(len(names)),
        limits=within,
        method=method_of(method, times.dt, fastest),
        project=bool(project),
        turning=_turning(robot),
        chart=None if lin is None else plant.state,
        events=events_of(events, callback),
        callback=callback,
    )


def start_of(state: StateMap, x0: Any, q0: Any, v0: Any) -> tuple[Array, Array]:
    """Return the initial configuration and velocity (nq,), (nv,)."""
    robot = state.robot
    if x0 is not None:
        if q0 is not None or v0 is not None:
            raise InputError("x0 is given with q0 or v0; give either")
        q, v = state.to_pinocchio(x0)
    else:
        q = robot.neutral() if q0 is None else robot.checked_configuration(q0).copy()
        v = np.zeros(robot.nv) if v0 is None else robot.checked_velocity(v0).copy()
    if not np.abs(v).max() < LARGEST_SPEED:
        raise InputError(
            f"the initial velocity has an entry of {np.abs(v).max():.3g}, expected less than "
            f"{LARGEST_SPEED:g} [rad/s|m/s]"
        )
    return q, v


def times_of(
    duration: float,
    dt: float | None,
    every: int,
    sample: float | None,
    delay: float,
    *,
    fastest: float = 0.0,
) -> Times:
    """Return the times of a simulation whose fastest pole [1/s] is given, in steps."""
    if sample is not None:
        sample = _positive("sample", sample)
    duration, delay = _positive("duration", duration), number("delay", delay)
    if delay < 0.0:
        raise InputError(f"delay is {delay:g} s, expected 0 or more")
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
            raise InputError(
                f"duration is {duration:g} s, expected a multiple of the step dt = {dt:g} s where "
                "the input is sampled or late; choose the step so"
            )
        steps = int(np.ceil(duration / dt))
        dt = duration / steps
    if not isinstance(every, int | np.integer) or every < 1:
        raise InputError(f"every is {every!r}, expected a whole number of steps, 1 or more")
    if sample is None:
        sample = dt if delay else 0.0
    return Times(dt, steps, int(every), *_whole(dt, sample=sample, delay=delay))


def method_of(name: str, dt: float, fastest: float) -> type[Integrator]:
    """Return the integrator of that name, stable at the fastest pole [1/s] of the loop."""
    method = integrator(name)
    if fastest * dt > method.reach:
        raise InputError(
            f"the step dt is {dt:g} s, too large for a loop whose fastest pole is at "
            f"{fastest:.4g} 1/s; take at most {method.reach / fastest:.2g} s, or `sample`"
        )
    return method


def events_of(events: Any, callback: Any) -> tuple[Event, ...]:
    """Return the events, which can be called as the callback can."""
    if not isinstance(events, Sequence):
        raise InputError(
            f"events is a {type(events).__name__}, expected a list of functions event(t, q, v)"
        )
    for each in (*events, *([] if callback is None else [callback])):
        if not callable(each):
            raise InputError(f"{each!r} is no function of (t, q, v), as an event would be")
    return tuple(events)


def _fastest_pole(policy: Any, lin: LinearModel | None) -> float:
    """Return the largest magnitude [1/s] of the poles of a continuous loop, where it has any."""
    decides = policy.policy if isinstance(policy, Allocation) else policy
    K = getattr(decides, "K", None)
    if lin is None or K is None or lin.dt:
        return 0.0
    return float(np.abs(np.linalg.eigvals(lin.A - lin.B @ K)).max())


def _turning(robot: Robot) -> Array:
    """Return where angular velocities stand, less those of rotors.

    A rotor may spin as fast as it will: nothing depends on its angle.
    """
    rotors = rotor_names(robot)
    joints = [joint for joint in robot.joints if not joint.prismatic and joint.name not in rotors]
    return np.array([3, 4, 5, *(joint.idx_v for joint in joints)])


def _whole(dt: float, **times: float) -> list[int]:
    """Return named times [s] in steps."""
    for name, time in times.items():
        if abs(round(time / dt) * dt - time) > 1e-6 * dt:
            raise InputError(
                f"{name} is {time:g} s, expected a multiple of the step dt = {dt:g} s; "
                "choose the step so"
            )
    return [round(time / dt) for time in times.values()]


def _part_of(sample: float, largest: float, *times: float) -> float:
    """Return a step of which the sample and, where there is one, the other times are multiples."""
    least = int(np.ceil(sample / largest))
    for parts in range(least, least + 1000):
        dt = sample / parts
        if all(abs(round(time / dt) * dt - time) <= 1e-6 * dt for time in times):
            return dt
    return sample / least


def _positive(name: str, value: Any) -> float:
    time = number(name, value)
    if time <= 1e-100:  # its inverse is squared
        raise InputError(f"{name} is {time:g} s, expected more than 0")
    return time
