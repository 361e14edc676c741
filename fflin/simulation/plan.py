"""What a simulation is to do: its start, times, limits, method and events, checked."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from fflin.base.errors import FflinWarning, InputError
from fflin.base.validation import Array, number, vector, whole
from fflin.control.channel import Channel, Law
from fflin.control.policies import Allocation, bound
from fflin.control.saturation import Saturation
from fflin.dynamics.integrators import Integrator, integrator
from fflin.dynamics.state import StateMap
from fflin.linear.ignorable import rotor_names
from fflin.linear.model import LinearModel
from fflin.robot.fields import Range
from fflin.robot.robot import Robot
from fflin.simulation.plant import Plant

Event: TypeAlias = Callable[[float, Array, Array], float]
Callback: TypeAlias = Callable[[float, Array, Array, Array], None]

LARGEST_SPEED = 1e50  # in SI units; beyond it squares overflow
LARGEST_TURN = 1.0  # within one step [rad], beyond which no integrator follows
_STEP = 0.01  # [s]
_MOST_ENTRIES, _MOST_STEPS = 500_000_000, 10_000_000_000
_MANY_STEPS = 100_000  # some seconds
_LONGEST = 1e100  # [s]; the square of its inverse is still a number


class Times(NamedTuple):
    """The step `dt` [s], and how many steps there are in all and between what happens."""

    dt: float
    steps: int
    every: int  # from one recorded row to the next
    sample: int  # between samples of the law; 0 where it is asked at every stage of every step
    delay: int  # from a sample to its effect
    fastest: float  # magnitude of the loop's poles [1/s]; 0 where it is not known

    @property
    def rows(self) -> int:
        """Most rows that are recorded."""
        return self.steps // self.every + 2

    @property
    def slow(self) -> float:
        """Square of the velocity up to which no turn within a step is too large."""
        return float((LARGEST_TURN / self.dt) ** 2)

    def require_room(self, width: int, *, chosen: bool) -> None:
        """Raise `InputError` where rows of so many numbers, or the steps, are too many.

        `chosen` says that the step was chosen here and not given; where the loop's fastest pole
        asks for many steps, an `FflinWarning` says so.
        """
        forced = chosen and self.fastest * _STEP > 1.0
        if self.rows * width > _MOST_ENTRIES or self.steps > _MOST_STEPS:
            asked = f", which the loop's fastest pole at {self.fastest:.3g} 1/s asks for,"
            raise InputError(
                f"{self.steps * self.dt:g} s in steps of {self.dt:g} s"
                f"{asked if forced else ''} are "
                f"{self.steps:.3g} steps and {self.rows:.3g} rows; take a larger dt or `every`"
            )
        if forced and self.steps > _MANY_STEPS:
            warnings.warn(
                f"the loop's fastest pole at {self.fastest:.3g} 1/s asks for steps of "
                f"{self.dt:.3g} s, {self.steps:,} in all; give dt=, or take a slower gain",
                FflinWarning,
                stacklevel=3,
            )


@dataclass(frozen=True, eq=False)
class Plan:
    """A simulation to be done, which nothing changes while it runs: arrays and whole numbers."""

    q: Array  # (nq,)
    v: Array  # (nv,)
    times: Times
    law: Law | None  # nothing but `initial` acts where there is none
    initial: Array  # (nu,), what acts until the first command arrives
    limits: Saturation  # what acts of a command
    rotors: list[int]  # velocities of the wheels that have a largest speed
    known: dict[str, Range]  # limits of states and inputs, whether they cut or not
    method: type[Integrator]
    project: bool  # whether momentum and centre of mass are kept
    turning: Array  # the velocities whose turn within a step has a bound
    chart: StateMap | None  # that ends the run where the base leaves it
    events: tuple[Event, ...]
    callback: Callback | None
    progress: bool | None  # whether a bar is shown; None shows it where the run takes long
    near: Array | None  # the state (nx,) from which continuous joints count turns
    target: Array | None  # the state (nx,) that is steered to, where one is known
    steered: tuple[str, ...]  # the states that are known to be fed back
    linear: LinearModel | None  # predicts the motion under u = u0 - K (x - x0)
    K: Array | None  # (nu, nx)

    def channel(self) -> Channel | None:
        """Return the way of the law's commands to the inputs, with nothing on it yet."""
        if self.law is None:
            return None
        times, rotors = self.times, self.rotors

        def speeds(t: float, q: Array, v: Array) -> Array:
            return v[rotors]

        return Channel(self.law, self.initial, self.limits, times.sample, times.delay, speeds)


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


def target_of(state: StateMap, target: Any) -> Array | None:
    """Return the state (nx,) that is given, or that a model's point is; None where none is."""
    if target is None:
        return None
    if not isinstance(target, LinearModel):
        goal: Array = vector("target", target, state.nx, "a state (12 + 2n)").copy()
        state.to_pinocchio(goal)  # refuses what is no attitude
        return goal
    missing = [name for name in target.state_names if name not in state.names]
    if missing or len(target.q) != state.robot.nq or target.moving:
        raise InputError(
            f"target is a model of '{target.robot}', of which '{state.robot.name}' has no such "
            "state; give one of this robot"
        )
    goal = state.read(target.q, target.v)
    goal[[state.names.index(name) for name in target.state_names]] = target.x0
    return goal


def times_of(
    policy: Any,
    duration: float,
    dt: float | None,
    every: int,
    sample: float | None,
    delay: float,
) -> Times:
    """Return the times of a simulation, whose arguments are those of `simulate`."""
    if sample is not None:
        sample = _positive("sample", sample)
    else:
        sample = getattr(getattr(policy, "lin", None), "dt", None) or None
    fastest = 0.0 if sample else _fastest_pole(policy)
    duration, delay = _positive("duration", duration), number("delay", delay)
    if not 0.0 <= delay <= _LONGEST:
        raise InputError(f"delay is {delay:g} s, expected 0 to {_LONGEST:g} s")
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
            raise InputError(
                f"duration is {duration:g} s, expected a multiple of the step dt = {dt:g} s where "
                "the input is sampled or late; choose the step so"
            )
        steps = int(np.ceil(duration / dt))
        dt = duration / steps
    if sample is None:
        sample = dt if delay else 0.0
    samples, late = _whole(dt, sample=sample, delay=delay)
    return Times(dt, steps, every, samples, late, fastest)


def method_of(name: str, times: Times) -> type[Integrator]:
    """Return the integrator of that name, stable at the fastest pole of the loop."""
    method = integrator(name)
    if times.fastest * times.dt > method.reach:
        raise InputError(
            f"the step dt is {times.dt:g} s, too large for a loop whose fastest pole is at "
            f"{times.fastest:.4g} 1/s; take at most {method.reach / times.fastest:.2g} s, or "
            "`sample`"
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


def law_of(policy: Any, plant: Plant, limits: Saturation, times: Times) -> Law | None:
    """Return the policy bound to the robot, of which nothing but inputs is taken."""
    if policy is None:
        return None
    within = (limits.low, limits.high)
    return Law(bound(policy, plant.robot), plant.actuation.names, within, times.slow)


def fed_back(policy: Any) -> tuple[str, ...]:
    """Return the names of the states that a policy about a model's point feeds back."""
    lin = getattr(policy, "lin", None)
    if not isinstance(lin, LinearModel):
        return ()
    decides = policy.policy if isinstance(policy, Allocation) else policy
    K = getattr(decides, "K", None)
    used = np.ones(len(lin.state_names)) if K is None else np.abs(K).max(axis=0, initial=0.0)
    return tuple(name for name, size in zip(lin.state_names, used, strict=True) if size)


def _fastest_pole(policy: Any) -> float:
    """Return the largest magnitude [1/s] of the poles of a continuous loop, where it has any."""
    decides = policy.policy if isinstance(policy, Allocation) else policy
    lin, K = getattr(policy, "lin", None), getattr(decides, "K", None)
    if not isinstance(lin, LinearModel) or K is None or lin.dt:
        return 0.0
    return float(np.abs(np.linalg.eigvals(lin.A - lin.B @ K)).max())


def turning(robot: Robot) -> Array:
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
    if not 1.0 / _LONGEST < time <= _LONGEST:
        raise InputError(f"{name} is {time:g} s, expected more than 0 and at most {_LONGEST:g} s")
    return time
