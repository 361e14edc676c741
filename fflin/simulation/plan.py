"""What a simulation is to do: its start, times, limits, method and events, checked."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from fflin.base.errors import InputError
from fflin.base.names import group_of
from fflin.base.validation import Array, vector
from fflin.control.channel import Channel, Law
from fflin.control.policies import bound
from fflin.control.saturation import Saturation
from fflin.control.tracking import Reference, TrajectoryFeedback
from fflin.dynamics import points
from fflin.dynamics.integrators import Integrator, integrator
from fflin.dynamics.state import StateMap
from fflin.linear.ignorable import rotor_names
from fflin.linear.model import LinearModel
from fflin.robot.fields import Range
from fflin.robot.robot import Robot
from fflin.simulation.plant import Plant
from fflin.simulation.times import Times

Event: TypeAlias = Callable[[float, Array, Array], float]
# Returns the command (nu,) at a deviation (nx,) from a linear model's point.
LinearLaw: TypeAlias = Callable[[Array], Array]
Callback: TypeAlias = Callable[[float, Array, Array, Array], None]

# A share of a step that is no longer part of what comes after it.
_BEFORE = 1e-6

LARGEST_SPEED = 1e50  # in SI units; beyond it squares overflow


class Predictor(NamedTuple):
    """A linear model, and what makes the law that it is under, which remembers nothing yet."""

    lin: LinearModel
    law: Callable[[], LinearLaw]


@dataclass(frozen=True, eq=False)
class Plan:
    """A simulation to be done, which nothing changes while it runs: arrays and whole numbers."""

    q: Array  # (nq,)
    v: Array  # (nv,)
    times: Times
    policy: Any  # of which the law is
    law: Law | None  # nothing but `initial` acts where there is none
    initial: Array  # (nu,), what acts until the first command arrives
    limits: Saturation  # what acts of a command
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
    reference: Reference | None  # the motion that is followed, where there is one
    steered: tuple[str, ...]  # the states that are known to be fed back
    notes: tuple[str, ...]  # what is to be said of the run
    predictor: Predictor | TrajectoryFeedback | None  # of the linear motion under the same law

    @property
    def last_node(self) -> float:
        """When in a step, of 1, its last stage asks: before a knot at its end where inputs jump."""
        return 1.0 - _BEFORE if getattr(self.policy, "jumps", False) else 1.0

    def channel(self) -> Channel | None:
        """Return the way of the law's commands to the inputs, with nothing on it yet."""
        if self.law is None:
            return None
        return Channel(self.law, self.initial, self.limits, self.times.sample, self.times.delay)


def start_of(
    state: StateMap, x0: Any, q0: Any, v0: Any, reference: Reference | None
) -> tuple[Array, Array]:
    """Return the initial configuration and velocity (nq,), (nv,)."""

    def default() -> tuple[Array, Array]:
        if reference:
            q, v, _ = reference(0.0)
            return q.copy(), v.copy()
        return points.start_of(state.robot)

    q, v = points.point_of(state, x0, q0, v0, default)
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
    theirs = set(target.state_names) <= set(state.names) and len(target.q) == state.robot.nq
    if target.moving or not theirs:
        raise InputError(
            f"target is a model of '{target.robot}', expected a state of '{state.robot.name}' or a "
            "model of it about a point that stays"
        )
    goal = state.read(target.q, target.v)
    # Where the model has another reference or frame, its state of the base is another.
    same = target.frame == state.frame and target.reference.isApprox(state.reference, 1e-12)
    for name, value in zip(target.state_names, target.x0, strict=True):
        if same or group_of(name) == "q_m":
            goal[state.names.index(name)] = value
    return goal


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


def turning(robot: Robot) -> Array:
    """Return where angular velocities stand, less those of rotors, which may be of any size."""
    rotors = rotor_names(robot)
    joints = [joint for joint in robot.joints if not joint.prismatic and joint.name not in rotors]
    return np.array([3, 4, 5, *(joint.idx_v for joint in joints)])
