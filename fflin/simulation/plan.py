"""The checked plan of a simulation: start, times, limits, method and events."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.names import group_of
from fflin.base.validation import Array, instance, truth, vector
from fflin.control.channel import Channel, Law, Saturation, saturation, warn_beyond
from fflin.control.linear_controller import growing
from fflin.control.policies import axes_of, bound, fed_back, feedback_of
from fflin.control.tracking import Reference, followed, reference_of, tracking_of
from fflin.dynamics import points
from fflin.dynamics.coordinates import ORBITAL, refuse_orbit
from fflin.dynamics.integrators import Integrator, integrator
from fflin.dynamics.state import Frame, StateMap
from fflin.linear.model import LinearModel
from fflin.robot.fields import Range, chosen_limits
from fflin.robot.mass_properties import rotor_names
from fflin.robot.robot import Robot
from fflin.simulation.plant import Disturbance, Plant
from fflin.simulation.prediction import Predictor, predictor
from fflin.simulation.times import Times, times_of

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

Event: TypeAlias = Callable[[float, Array, Array], float]
Callback: TypeAlias = Callable[[float, Array, Array, Array], None]
Limits: TypeAlias = "float | str | Mapping[str, Any] | Sequence[Any]"

# If inputs jump at knots, the last stage is evaluated earlier by this fraction of a step.
_BEFORE = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulationOptions:
    """Options of a simulation as they are given; see `simulate` for the meaning of each."""

    x0: ArrayLike | None = None
    q0: ArrayLike | None = None
    v0: ArrayLike | None = None
    duration: float | None = None
    dt: float | None = None
    method: str = "cf4"
    project: bool = True
    sample: float | None = None
    delay: float = 0.0
    limits: Limits | None = None
    disturbance: Disturbance | None = None
    events: Sequence[Event] = ()
    callback: Callback | None = None
    linear: LinearModel | bool | None = None
    target: LinearModel | ArrayLike | None = None
    frame: Frame | None = None
    reference: pin.SE3 | None = None
    every: int | None = None
    progress: bool | None = None


@dataclass(frozen=True, eq=False)
class Plan:
    """Checked plan of a simulation, which does not change during the run."""

    q: Array  # (nq,)
    v: Array  # (nv,)
    times: Times
    policy: Any  # policy of the law
    law: Law | None  # without a law, only `initial` acts
    initial: Array  # (nu,) inputs until the first command arrives
    limits: Saturation  # limits of the inputs
    wheels: list[int]  # indices in v of the wheels with a speed limit
    known: dict[str, Range]  # all limits of states and inputs, including reported ones
    method: type[Integrator]
    project: bool  # whether momentum and centre of mass are projected; false in orbit
    turning: Array  # indices in v of the velocities whose rotation per step is bounded
    chart: StateMap | None  # the run ends when the base leaves this chart
    events: tuple[Event, ...]
    callback: Callback | None
    progress: bool | None  # whether a bar is shown; None shows it if the run takes long
    near: Array | None  # state (nx,) from which continuous joints count turns
    target: Array | None  # target state (nx,), if known
    reference: Reference | None  # followed motion, if any
    steered: tuple[str, ...]  # states that are known to be fed back
    notes: Callable[[], tuple[str, ...]]  # computes the notes of the report
    predictor: Predictor | None  # prediction of the linear motion under the same law

    @property
    def last_node(self) -> float:
        """Time of the last stage as a fraction of the step; below 1 if inputs jump at knots."""
        return 1.0 - _BEFORE if getattr(self.policy, "jumps", False) else 1.0

    def channel(self) -> Channel | None:
        """Return the channel of the law's commands to the inputs, without pending commands."""
        if self.law is None:
            return None
        return Channel(
            self.law,
            self.initial,
            self.limits,
            self.times.sample,
            self.times.delay,
            lambda t, q, v: v[self.wheels],
        )


def start_of(
    state: StateMap, options: SimulationOptions, reference: Reference | None
) -> tuple[Array, Array]:
    """Return the initial configuration (nq,) and velocity (nv,)."""

    def default() -> tuple[Array, Array]:
        if reference:
            q, v, _ = reference(0.0)
            return q.copy(), v.copy()
        return points.start_of(state.robot)

    q, v = points.point_of(state, options.x0, options.q0, options.v0, default)
    points.require_slow("the initial velocity", v)
    return q, v


def target_of(state: StateMap, target: LinearModel | ArrayLike | None) -> Array | None:
    """Return the target state (nx,): the given state, or the point of a given model, or None."""
    if target is None:
        return None
    if not isinstance(target, LinearModel):
        goal: Array = vector("target", target, state.nx, "a state (12 + 2n)").copy()
        state.to_pinocchio(goal)  # raises an error for an invalid attitude
        return goal
    theirs = set(target.state_names) <= set(state.names) and len(target.q) == state.robot.nq
    if target.moving or not theirs:
        raise InputError(
            f"target is a model of '{target.robot}', expected a state of '{state.robot.name}' "
            "or a model of that robot about a fixed point"
        )
    if state.robot.orbit and target.frame != state.frame:
        said = f"target is a model in frame '{target.frame}', expected '{state.frame}'"
        raise InputError(f"{said}, the frame of the motion; q differs between orbital frames")
    goal = state.read(target.q, target.v)
    # If the model has another reference or frame, its base states cannot be copied.
    same = target.frame == state.frame and target.reference.isApprox(state.reference, 1e-12)
    for name, value in zip(target.state_names, target.x0, strict=True):
        if same or group_of(name) == "q_m":
            goal[state.names.index(name)] = value
    return goal


def law_of(policy: object, plant: Plant, limits: Saturation, times: Times) -> Law | None:
    """Bind the policy to the robot; return the law, which checks the policy's commands."""
    if policy is None:
        return None
    within = (limits.low, limits.high)
    return Law(bound(policy, plant.robot), plant.actuation.names, within, times.slow)


def planned(robot: Robot, policy: object, options: SimulationOptions) -> tuple[Plan, Plant]:
    """Return the checked plan of `simulate` with these options, and the plant."""
    policy = followed(policy, robot)
    times = times_of(policy, options)
    policy = followed(policy, robot, held=times.sample * times.dt)
    lin, _ = feedback_of(policy)
    follows = reference_of(policy)
    state = _state_of(robot, policy, options)
    plant = Plant(state, options.disturbance)
    foresees = predictor(plant, policy, options.linear)
    method = integrator(options.method)
    if times.fastest * times.dt > method.reach:
        raise InputError(
            f"the step dt is {times.dt:g} s, too large for a loop whose fastest pole is at "
            f"{times.fastest:.4g} 1/s; take at most {method.reach / times.fastest:.2g} s, or "
            "give `sample`"
        )
    q, v = start_of(state, options, follows)
    if plant.field:
        plant.field.require_near(q)
    times.require_room(robot.nq + robot.nv + 2 * state.nx, chosen=options.dt is None)
    acting, known = chosen_limits(robot, options.limits)
    within = saturation(robot, acting, q, times.dt, times.sample, pulsed=policy is not None)
    law = law_of(policy, plant, within, times)
    target = options.target
    follows = follows if target is None else None
    goal = target_of(state, lin if target is None else target)
    initial = _initial_inputs(policy, plant, within)
    near = state.read(*follows(0.0)[:2]) if follows else goal
    plan = Plan(
        q=q,
        v=v,
        times=times,
        policy=policy,
        law=law,
        initial=initial,
        limits=within,
        wheels=[robot.joint(name).idx_v for name in within.wheel_names],
        known=known,
        method=method,
        project=truth("project", options.project) and robot.orbit is None,
        turning=_rotating(robot),
        chart=None if lin is None else state,
        events=_checked_functions(options.events, options.callback),
        callback=options.callback,
        progress=options.progress,
        near=near if options.x0 is None else np.asarray(options.x0, dtype=float),
        target=goal,
        reference=follows,
        steered=fed_back(policy),
        notes=lambda: (*growing(policy), *times.notes),
        predictor=foresees,
    )
    return plan, plant


def _state_of(robot: Robot, policy: object, options: SimulationOptions) -> StateMap:
    """Return the state map of a motion, with the frame and reference of its policy if known."""
    frame, reference = options.frame, options.reference
    lin, _ = feedback_of(policy)
    own_frame, own_reference = axes_of(policy)
    if lin is not None and (frame is not None or reference is not None):
        raise InputError(
            "frame or reference is given, but the model of the policy defines both; leave them out"
        )
    if tracking_of(policy):
        if frame not in (None, own_frame):
            raise InputError(
                f"frame is {frame!r}, expected '{own_frame}' along a trajectory, whose inputs are "
                "in base axes; leave frame= out"
            )
        refuse_orbit(robot, "trajectories to follow")
    if own_frame and (own_frame in ORBITAL) != bool(robot.orbit):
        made, flown = ("in orbit", "not ") if own_frame in ORBITAL else ("without an orbit", "")
        raise InputError(
            f"the policy was designed {made}, frame '{own_frame}', but '{robot.name}' is {flown}in "
            "orbit; design it for the robot that is simulated"
        )
    reference = own_reference if reference is None else reference
    return StateMap(robot, reference=reference, frame=own_frame if frame is None else frame)


def _initial_inputs(policy: Any, plant: Plant, limits: Saturation) -> Array:
    """Return the inputs (nu,) before the first command; warn if they exceed the limits."""
    robot, actuation, (lin, _) = plant.robot, plant.actuation, feedback_of(policy)
    along = tracking_of(policy)
    # With allocation, the inputs of the policy's model are not the inputs of the robot.
    if lin is not None and lin.input_names == actuation.names:
        where, inputs, initial = "at its target", lin.u0[None], np.asarray(lin.u0)
    elif along is policy is not None:
        where, inputs = "on its trajectory", along.trajectory.u_base
        initial = along.reference(0.0)[2]
    else:
        return np.zeros(len(limits.low))
    units = dict(zip(actuation.names, actuation.units, strict=True))
    warn_beyond(robot.name, where, units, inputs, limits.low, limits.high)
    return initial


def _checked_functions(events: Sequence[Event], callback: Callback | None) -> tuple[Event, ...]:
    """Return the events; raise `InputError` if an event or the callback is not a function."""
    called = tuple(instance("events", events, Sequence, "a list of functions event(t, q, v)"))
    for each in called if callback is None else (*called, callback):
        if not callable(each):
            raise InputError(
                f"{each!r} is not a function; events take (t, q, v), callbacks (t, q, v, u)"
            )
    return called


def _rotating(robot: Robot) -> Array:
    """Return the indices in v of the rotation rates of the base and of all joints except rotors.

    The rotation of the base and of these joints within a step is bounded. Rotors may spin fast,
    because nothing depends on their angle.
    """
    rotors = rotor_names(robot)
    joints = [joint for joint in robot.joints if not joint.prismatic and joint.name not in rotors]
    return np.array([3, 4, 5, *(joint.idx_v for joint in joints)])
