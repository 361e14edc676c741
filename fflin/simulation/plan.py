"""The checked plan of a simulation: start, time steps, limits, method and events."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from itertools import cycle, pairwise
from typing import NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, InputError, listed
from fflin.base.names import by_name, group_of
from fflin.base.validation import (
    Array,
    ArrayLike,
    as_double,
    function,
    instance,
    number,
    numbers,
    truth,
    vector,
    whole,
)
from fflin.control.channel import (
    Correction,
    Inputs,
    Law,
    Saturation,
    channelled,
    saturation,
    warn_beyond,
)
from fflin.control.data_sheet import Deviations
from fflin.control.lags import lag_difference, lags_of_robot
from fflin.control.policies import Feedback
from fflin.control.policy import (
    Policy,
    Reference,
    bound,
    defined_by_user,
    initial_inputs,
)
from fflin.control.sensor_errors import SensorErrors, declared_errors
from fflin.control.tracking import prepared
from fflin.dynamics import points
from fflin.dynamics.coordinates import ORBITAL, Frame
from fflin.dynamics.integrators import held_exponential, integrator
from fflin.dynamics.methods import DEFAULT_METHOD
from fflin.dynamics.state import StateMap, selection
from fflin.linear.model import Delay, LinearModel
from fflin.linear.trajectory import Trajectory
from fflin.robot.fields import chosen_limits, input_keys_of
from fflin.robot.orbit import is_elliptic
from fflin.robot.robot import Robot
from fflin.simulation.pace import (
    LONGEST_STEP,
    SLOW_STEP,
    Pace,
    Signal,
    limits_of_step,
)
from fflin.simulation.plant import LARGEST_TURN, Disturbance, Plant

Event: TypeAlias = Callable[[float, Array, Array], float]
Callback: TypeAlias = Callable[[float, Array, Array, Array], None]
Limits: TypeAlias = "float | str | Mapping[str, object] | Sequence[object]"

# SHORTEST and LONGEST are the bounds [s] of an automatic duration. The duration is determined by a
# linear simulation. If the loop is in continuous time, the simulation has the time step _LOOK [s].
SHORTEST, LONGEST, _LOOK = 60.0, 600.0, 0.5
# The inputs of a trajectory may jump at the knots of the trajectory. In this case, the last stage
# of each step is evaluated slightly early, by this fraction of the step. So the stage does not
# include an input jump at the end of the step.
_BEFORE = 1e-6
_MOST_ENTRIES, _MOST_STEPS = 500_000_000, 10_000_000_000
# If a fast pole determines the automatic time step, a run of more than _MANY_STEPS steps (half a
# minute of computing) causes a warning. If `every` is not given, a run of more than _ENDLESS steps
# (some hours) is refused.
_MANY_STEPS, _ENDLESS = 50_000, 10_000_000
# If `every` is not given, a run of at most _MANY_ROWS steps records every step. A longer run
# records only about _FEW_ROWS steps.
_MANY_ROWS, _FEW_ROWS = 100_000, 10_000
_FOREVER = 1e100  # [s] longest time that is accepted; 1 / _FOREVER^2 does not underflow


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulationOptions:
    """Arguments of `simulate`, unchecked; see `simulate` for their meaning."""

    robot: Robot
    policy: object = None
    x0: ArrayLike | None = None
    q0: ArrayLike | None = None
    v0: ArrayLike | None = None
    duration: float | None = None
    dt: float | None = None
    method: str = DEFAULT_METHOD
    project: bool = True
    sample: float | None = None
    delay: Delay | None = None
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
    engine: str | None = None
    noise: float = 1.0
    seed: int = 0


class Times(NamedTuple):
    """Time step `dt` [s] of a simulation, and other times as numbers of steps."""

    dt: float
    steps: int
    every: int  # steps between recorded rows
    # steps between samples of the law; 0 if the law is evaluated at all stages
    sample: int
    # steps from a sample to the effect of its command: one for all inputs, or one for each input
    delays: tuple[int, ...]
    notes: tuple[str, ...]  # remarks on the recorded rows, for the report

    @property
    def rows(self) -> int:
        """Largest number of recorded rows."""
        return self.steps // self.every + 2

    @property
    def slow(self) -> float:
        """Squared angular velocity [rad^2/s^2] up to which a step is accurate."""
        return float((LARGEST_TURN / self.dt) ** 2)


class Plan:
    """Checked arguments of `simulate`, and data derived from them; constant during the run."""

    def __init__(self, options: SimulationOptions) -> None:
        robot = instance(
            "robot", options.robot, Robot, "a fflin.Robot; fflin.load makes one"
        )
        self.events = _functions(options)
        policy = None if options.policy is None else prepared(options.policy, robot)
        self.options = options
        duration = duration_of(policy, options)
        state = _state_of(policy, options)
        self.plant = plant = Plant(state, options.disturbance)
        self.method = integrator(options.method)
        lin = policy.model if policy else None
        follows = _reference_of(policy, plant)
        default = (
            partial(points.start_of, robot)
            if follows is None
            else lambda: follows(0.0)[:2]
        )
        # Initial configuration (nq,) and velocity (nv,).
        self.q, self.v = points.point_of(
            state, options.x0, options.q0, options.v0, default
        )
        self.q, self.v = plant.constrain(self.q, self.v)
        points.require_slow("the initial velocity", self.v)
        if plant.field:
            plant.field.require_near(self.q)
        commands = None if policy is None else bound(policy, robot)
        sample = sample_of(policy, options.sample)
        dt = None if options.dt is None else _positive("the step dt", options.dt)
        u = _inputs_at_start(policy, plant)
        limits = limits_of_step(
            plant, policy, commands, self.q, self.v, u, sample or 0.0
        )
        limits += _signals(plant, self.q, self.v, dt, duration)
        pace = Pace(limits, self.method, duration, _longest_step(plant, policy))
        late = delays_of(policy, plant, options.delay)
        self.times = times = _with_notes_on_design(
            times_of(options, duration, sample, pace, late), policy, plant, late
        )
        if policy and times.sample:
            policy = policy.held_for(times.sample * times.dt)
        # Errors that the outputs of the robot declare, or None.
        self.errors, policy = _with_errors(policy, state, times, options)
        self.policy = policy
        # `reference` is a function of time that returns q, v and u of the motion that the policy
        # follows, or None.
        self.reference = follows if options.target is None else None
        goal = lin if options.target is None else options.target
        # Inertias {name: inertia [kg m^2]} of the joints that are flown as wheels at the target.
        self.flown = robot.wheels_at(self._final_velocity(goal))
        # {state or input: (least, largest)}: the limits that saturation enforces.
        self.acting = chosen_limits(robot, options.limits, self.flown)
        self.limits = saturation(
            robot,
            self.acting,
            self.q,
            times.dt,
            times.sample,
            wheels=self.flown,
            pulsed=policy is not None,
        )
        # `initial` (nu,) are the inputs that act until the first command arrives. Without a law,
        # these inputs act throughout the run.
        self.law = law_of(policy, plant, self.limits, times)
        _warn_beyond_limits(policy, plant, self.limits)
        self.initial = _inputs_at_start(policy, plant)
        # Motion that the policy follows, or None, whatever the target.
        self.follows = follows
        # Target state (nx,), or None if there is no target.
        self.target = target_of(state, goal, _target_name(options.target, policy))
        # The angle of a continuous joint is unique only up to full turns. In the first row of the
        # motion, this angle is within half a turn of the joint's angle in the state `near` (nx,).
        # If `near` is None, this angle is within half a turn of 0.
        self.near = self.target
        if options.x0 is not None:
            self.near = np.asarray(options.x0, dtype=float)
        elif self.reference:
            self.near = state.read(*self.reference(0.0)[:2])
        # Whether each step ends with a correction that sets momentum and centre of mass to their
        # predicted values. In orbit, momentum is not conserved, so there is no correction.
        # If a frame is held in the world, the constraint determines where the base is.
        self.project = truth("project", options.project) and not (
            robot.orbit or robot.anchored
        )
        # Indices in v of the wheels with a speed limit.
        self.wheels = [robot.joints[row - 6].idx_v for row in self.limits.wheels.row]
        # States that the policy feeds back, if known.
        self.steered = policy.fed_back if policy else ()
        # Function of time that returns the measurement noise; None if the policy defines no noise.
        self.noise = policy.measurement_noise if policy else None
        # Whether the run ends when the base leaves the attitude chart of the reference.
        self.within_chart = False
        # Time of the last stage of a step, as a fraction of the step; see _BEFORE.
        self.last_node = 1.0 - _BEFORE if policy and policy.jumps else 1.0

    def _final_velocity(self, goal: LinearModel | ArrayLike | None) -> Array:
        """Return the velocity (nv,) of the target at the end; the initial velocity if no target.

        Joints that `goal` does not name are at rest. `target_of` raises the errors about `goal`.
        """
        if self.reference is not None:
            end: Array = self.reference(self.times.steps * self.times.dt)[1]
            return end
        if goal is None:
            return self.v
        state = self.plant.state
        names = state.names
        x = goal
        if isinstance(goal, LinearModel):
            names, x = goal.state_names, goal.x0
        rates = dict(
            zip(names, np.ravel(as_double("target", x)).tolist(), strict=False)
        )
        v = np.zeros(state.robot.nv)
        for joint in state.robot.joints:
            v[joint.idx_v] = rates.get(f"qdot_m.{joint.name}", 0.0)
        return v

    def replace(self, **changes: object) -> Plan:
        """Return a copy of the plan with some attributes replaced."""
        other = copy(self)
        for name, value in changes.items():
            setattr(other, name, value)
        return other

    def applied_by(self, law: Law) -> Inputs:
        """Return a function f(step, t, q, v) that computes the inputs (nu,) of a step.

        See `applied`.
        """
        return self.applied(law, lambda t, q, v: v[self.wheels], law.correct)

    def applied(
        self, law: Inputs, speeds: Inputs, correct: Correction | None = None
    ) -> Inputs:
        """Return a function f(step, *point) that computes the inputs (nu,) of a step.

        f calls ``law(*point)`` for the command, and ``speeds(*point)`` for the speeds of the wheels
        whose speed is limited. The actuator channel changes the command: limits, sample and hold,
        delay and thruster pulses. f calls `correct` after each command, see `channelled`.
        """
        times = self.times
        return channelled(
            law, speeds, self.limits, self.initial, times.sample, times.delays, correct
        )


def _with_errors(
    policy: Policy | None, state: StateMap, times: Times, options: SimulationOptions
) -> tuple[Deviations | None, Policy | None]:
    """Return the errors that the outputs of a robot declare, and the law that receives them."""
    factor = number("noise", options.noise)
    if factor < 0.0:
        raise InputError(f"noise is {factor:g}, expected a factor of at least 0")
    seed = whole("seed", options.seed, 0)
    if policy is None or not factor:
        return None, policy
    sample = times.sample * times.dt
    errors = declared_errors(policy, state, sample)
    if errors is None:
        return None, policy
    errors = errors.scaled(factor)
    steps = math.sqrt(sample) * errors.drift
    function = SensorErrors(np.zeros(len(steps)), errors.noise, steps, seed)
    return errors, policy.with_sensor_errors(function)


def _signals(
    plant: Plant, q: Array, v: Array, dt: float | None, duration: float
) -> list[Signal]:
    """Return the disturbances that depend on time, at q and v, as limits of the step."""
    signals = list[Signal]()
    if plant.disturbance is not None:
        given = partial(plant.disturbing, q=q, v=v)
        signals.append(Signal.of("the disturbance", given, dt, duration))
    if plant.on_base.periodic:
        wrench = partial(plant.on_base.wrench, q=q)
        signals.append(Signal.of("the robot's disturbance", wrench, dt, duration))
    return signals


def law_of(
    policy: Policy | None, plant: Plant, limits: Saturation, times: Times
) -> Law | None:
    """Return the policy, bound to the robot, as a law that checks commands; None if no policy."""
    if policy is None:
        return None
    within = (limits.low, limits.high)
    return Law(bound(policy, plant.robot), plant.actuation.names, within, times.slow)


def _target_name(target: object, policy: Policy | None) -> str:
    """Return the noun for a target in messages: the given target, or the policy's model."""
    if target is None and policy is not None:
        return f"the model of the policy ({policy.kind})"
    return "target"


def target_of(
    state: StateMap, target: LinearModel | ArrayLike | None, name: str = "target"
) -> Array | None:
    """Return the target state (nx,), or None if there is no target.

    The argument `target` is the state itself, or a linear model about this state. `name` is the
    noun for it in messages.
    """
    if target is None:
        return None
    if isinstance(target, LinearModel):
        target = target.undelayed
    else:
        goal: Array = vector(name, target, state.nx, "a state (12 + 2n)").copy()
        state.to_pinocchio(goal)  # raises an error for an invalid attitude
        return goal
    theirs = (
        set(target.state_names) <= set(state.names) and len(target.q) == state.robot.nq
    )
    # In orbit, the model and the simulation must have the same frame, because q is relative to the
    # orbital frame.
    if (
        target.moving
        or not theirs
        or (state.robot.orbit and target.frame != state.frame)
    ):
        wanted = f"a state of '{state.robot.name}' or a model of that robot about a fixed point"
        if state.robot.orbit:
            wanted += f" in frame {state.frame!r}"
        raise InputError(
            f"{name} is a model of '{target.robot}' in frame '{target.frame}', expected {wanted}"
        )
    near = selection(target.state_names, state.names).T @ target.x0
    return state.to_state(target.q, target.v, near=near)


def _reference_of(policy: Policy | None, plant: Plant) -> Reference | None:
    """Return the motion that a policy follows, or None; raise `InputError` if it is invalid."""
    follows = None if policy is None else policy.reference_motion
    if policy is None or follows is None:
        return None
    if defined_by_user(policy, "reference_motion"):
        label = f"{policy.kind}.reference_motion(0)"
        start = follows(0.0)
        if not isinstance(start, Sequence) or len(start) != 3:
            raise InputError(
                f"{label} has type {type(start).__name__}, expected q (nq,), v (nv,) and u (nu,)"
            )
        robot = plant.robot
        sizes = robot.nq, robot.nv, len(plant.actuation.names)
        for name, value, size in zip("qvu", start, sizes, strict=True):
            vector(f"{name} of {label}", value, size, f"the {name} of '{robot.name}'")
    return follows


def _state_of(policy: Policy | None, options: SimulationOptions) -> StateMap:
    """Return the state map of a motion.

    If the policy has a frame, the state map uses this frame, otherwise the frame in `options`. The
    same applies to the reference.
    """
    robot, frame, reference = options.robot, options.frame, options.reference
    own_frame, own_reference = policy.axes if policy else (None, None)
    other_frame = own_frame is not None and frame not in (None, own_frame)
    if other_frame or (own_reference is not None and reference is not None):
        raise InputError(
            f"frame={frame!r} or reference= is given, but the policy defines its own, with frame "
            f"'{own_frame}'; leave them out"
        )
    followed = policy.followed_trajectory if policy else None
    if followed is not None:
        _require_same_orbit(robot, followed)
    elif own_frame and _designed_in_orbit(policy, own_frame, robot) != bool(
        robot.orbit
    ):
        designed, simulated = "without an orbit", "in orbit"
        if not robot.orbit:
            designed, simulated = "in orbit", "not in orbit"
        raise InputError(
            f"the policy was designed {designed}, frame '{own_frame}', but '{robot.name}' is "
            f"{simulated}; design it for the robot that is simulated"
        )
    reference = own_reference if reference is None else reference
    frame = own_frame if frame is None else frame
    return StateMap(robot, reference=reference, frame=frame)


def _designed_in_orbit(policy: Policy | None, frame: str, robot: Robot) -> bool:
    """Return whether a policy was designed for a robot in orbit.

    Base axes are possible with and without an orbit. If the policy has no model that tells, it is
    assumed to be designed for the given robot.
    """
    if frame != "local" or policy is None:
        return frame in ORBITAL
    if policy.model is None:
        return bool(robot.orbit)
    return policy.model.mean_motion > 0.0


def _require_same_orbit(robot: Robot, followed: Trajectory) -> None:
    """Raise `InputError` if a trajectory was made for another orbit, or begins at another time."""
    design = followed.robot
    if robot.orbit != design.orbit:
        given = [
            f"in {x.orbit}" if x.orbit else "not in orbit" for x in (robot, design)
        ]
        raise InputError(
            f"'{robot.name}' is {given[0]}, but the trajectory to follow is for a robot "
            f"{given[1]}; use the same orbit for both"
        )
    start = float(followed.t[0])
    if robot.orbit and is_elliptic(robot.orbit) and start:
        raise InputError(
            f"the trajectory begins at t = {start:g} s, but simulations begin at t = 0, elsewhere "
            "in the elliptic orbit; give a trajectory that begins at t = 0"
        )


def _functions(options: SimulationOptions) -> tuple[Event, ...]:
    """Return the events; raise `InputError` if an option that must be a function is not one."""
    expected = "a list of functions event(t, q, v)"
    events = tuple(instance("events", options.events, Sequence, expected))
    functions: list[tuple[str, object, str]] = [
        ("event", event, "(t, q, v)") for event in events
    ]
    functions.append(("callback", options.callback, "(t, q, v, u)"))
    if not isinstance(options.disturbance, Mapping):
        functions.append(("disturbance", options.disturbance, "(t, q, v)"))
    for name, given, arguments in functions:
        if not callable(given) and (given is not None or name == "event"):
            kind = type(given).__name__
            raise InputError(
                f"{name} has type {kind}, expected a function of {arguments}"
            )
        if callable(given):
            function(name, given, arguments)
    return events


def _inputs_at_start(policy: Policy | None, plant: Plant) -> Array:
    """Return the reference inputs (nu,) of the policy at the start, or zeros if it has none."""
    names = plant.actuation.names
    initial = None if policy is None else initial_inputs(policy, names)
    if initial is None:
        return np.zeros(len(names))
    return initial


def _warn_beyond_limits(
    policy: Policy | None, plant: Plant, limits: Saturation
) -> None:
    """Warn if the reference inputs of a policy exceed the limits.

    If the policy follows a trajectory, warn if its inputs exceed the limits at any time.
    """
    actuation = plant.actuation
    known = policy.reference_inputs(actuation.names) if policy else None
    if known is None:
        return
    where, inputs = known
    units = dict(zip(actuation.names, actuation.units, strict=True))
    warn_beyond(plant.robot.name, where, units, inputs, limits.low, limits.high)


def duration_of(policy: Policy | None, options: SimulationOptions) -> float:
    """Return the duration [s]; by default the duration of the followed trajectory."""
    duration = options.duration
    if duration is None:
        trajectory = policy.followed_trajectory if policy else None
        if trajectory is None:
            raise InputError("the duration is missing; give duration= in s")
        duration = float(trajectory.t[-1] - trajectory.t[0])
    return _positive("duration", duration)


def sample_of(policy: Policy | None, sample: float | None) -> float | None:
    """Return the sample time [s] of a policy, or None if the policy is continuous.

    The argument `sample` takes precedence over the sample time of the policy.
    """
    if sample is not None:
        return _positive("sample", sample)
    if policy is None:
        return None
    seconds = number(f"sample_time of {policy.kind}", policy.sample_time)
    if seconds == 0.0:
        return None
    return _positive(f"sample_time of {policy.kind}", seconds)


def delays_of(
    policy: Policy | None, plant: Plant, delay: Delay | None
) -> tuple[float, ...]:
    """Return the delay [s] of all inputs, or of each input.

    The argument `delay` takes precedence over the delay for which the policy was designed.
    """
    if isinstance(delay, Mapping):
        keys = input_keys_of(plant.robot)
        values = numbers("delay", delay, "input", "delay of")
        value_at = by_name("input", values, keys)
        return tuple(value_at.get(index, 0.0) for index in range(len(keys)))
    if delay is not None:
        return (number("delay", delay),)
    delay_of = {} if policy is None else policy.input_delays
    delays = tuple(delay_of.values())
    if len({*delays}) < 2:
        return delays[:1] or (0.0,)
    if tuple(delay_of) != plant.actuation.names:
        raise InputError(
            f"the model of the policy has different delays of {listed([*delay_of])}, which are not "
            "the inputs of the simulated robot; give delay= with one delay for all"
        )
    return delays


def _longest_step(plant: Plant, policy: Policy | None) -> float:
    """Return the longest default step [s].

    It is longer for magnetorquers and for laws that repeat, which act slowly, over many orbits.
    """
    trajectory = policy.followed_trajectory if policy else None
    if plant.actuation.torquers or (trajectory is not None and trajectory.period):
        return SLOW_STEP
    return LONGEST_STEP


def step_of(
    options: SimulationOptions,
    duration: float,
    sample: float | None,
    pace: Pace,
    delays: tuple[float, ...],
) -> tuple[float, int, str]:
    """Return the time step [s], the number of steps, and the mode that makes the step short.

    The text is empty if the step is given or not short. A given step is shortened such that the
    duration is a whole number of steps.
    """
    dt = options.dt
    mode = ""
    longest = max(delays)
    if dt is None:
        dt, mode = pace.step()
        if sample or longest:
            dt = _part_of(sample or longest, dt, duration, *delays)
    dt = _positive("the step dt", dt)
    steps = max(1, round(duration / dt))
    if abs(steps * dt - duration) > 1e-6 * duration:
        if sample or longest:
            advice = _advice_on_duration(duration, dt, sample or longest, delays)
            _in_steps("duration", duration, dt, advice)  # raises an error
        steps = int(np.ceil(duration / dt))
        dt = duration / steps
    return dt, steps, mode


def _with_notes_on_design(
    times: Times, policy: Policy | None, plant: Plant, delays: tuple[float, ...]
) -> Times:
    """Return the times with notes on lags and delays for which the law was not designed."""
    return _with_delay_note(_with_lag_note(times, policy, plant), policy, delays)


def _with_lag_note(times: Times, policy: Policy | None, plant: Plant) -> Times:
    """Return the times with a note on lags for which the law was not designed, if there are any."""
    if policy is None or policy.model is None or policy.commanded_robot is not None:
        return times
    lags = lags_of_robot(plant.robot, plant.state, outputs=policy.senses_outputs)
    note = lag_difference(policy, lags, "the motion")
    return times._replace(notes=(*times.notes, note)) if note else times


def _with_delay_note(
    times: Times, policy: Policy | None, delays: tuple[float, ...]
) -> Times:
    """Return the times with a note on delays for which the law was not designed, if there are any.

    `delays` [s] is one delay for all inputs, or one for each input.
    """
    if policy is None or policy.model is None:
        return times
    designed = tuple(policy.input_delays.values()) or (0.0,)
    if np.allclose(_extremes(designed), _extremes(delays), rtol=0.0, atol=1e-9):
        return times
    note = (
        f"the law was designed for a delay of {_range(designed)} of the inputs, but the motion has "
        f"{_range(delays)}"
    )
    return times._replace(notes=(*times.notes, note))


def _extremes(values: tuple[float, ...]) -> tuple[float, float]:
    return min(values), max(values)


def _range(delays: tuple[float, ...]) -> str:
    """Write delays [s], such as '0.5 s' or '0 to 0.5 s'."""
    least, largest = _extremes(delays)
    if largest - least <= 1e-9:
        return f"{largest:g} s"
    return f"{least:g} to {largest:g} s"


def times_of(
    options: SimulationOptions,
    duration: float,
    sample: float | None,
    pace: Pace,
    delays: tuple[float, ...],
) -> Times:
    """Derive the times of a simulation; `sample` is the sample time [s], None if continuous."""
    every = options.every
    notes = list[str]()
    for delay in delays:
        if 0.0 <= delay < duration:
            continue
        raise InputError(
            f"delay is {delay:g} s, expected at least 0 and less than the duration of "
            f"{duration:g} s, so that a command takes effect"
        )
    longest = max(delays)
    dt, steps, mode = step_of(options, duration, sample, pace, delays)
    if sample is None:
        sample = dt if longest else 0.0
        if longest:
            notes.append(
                f"delay= without sample=: the policy is sampled every {dt:g} s, and its commands "
                "are held"
            )
    reach, fastest = integrator(options.method).reach, pace.fastest
    if fastest and fastest.fastest * dt > reach:
        raise InputError(
            f"the step dt is {dt:g} s, too large for {fastest.fastest_mode}; take at most "
            f"{reach / fastest.fastest:.2g} s"
        )
    if mode:
        notes.append(f"the step is {dt:.3g} s, because {mode} requires it")
    in_steps = (duration, *delays)
    samples = _samples_in_steps(sample, dt, in_steps)

    def allowed(largest: float) -> float:
        """Return the longest allowed step [s] of at most `largest` [s]."""
        return _part_of(sample, largest, *in_steps) if sample else largest

    notes += pace.remarks(dt, allowed)
    late = tuple(_late_steps(delay, delays, dt, sample, duration) for delay in delays)
    thinned = every is None and steps > _MANY_ROWS
    part = max(samples, 1)
    # If `every` is chosen automatically, rows of a sampled policy are recorded only at samples.
    few = 1
    if thinned:
        few = part * -(-steps // (_FEW_ROWS * part))
    every = few if every is None else whole("every", every, 1)
    if thinned:
        message = f"one in {every} steps is recorded; every=1 (--every 1) records all "
        notes.append(f"{message}{steps:,} steps")
    if every % part and part % every:
        message = (
            f"a row is recorded every {every} steps, but the controller samples every "
        )
        notes.append(f"{message}{part} steps, so the rows are not a valid trajectory")
    times = Times(dt, steps, every, samples, late, tuple(notes))
    _require_possible(options, times, mode, thinned=thinned)
    return times


def _require_possible(
    options: SimulationOptions, times: Times, mode: str, *, thinned: bool
) -> None:
    """Raise `InputError` if a run has too many steps or rows; warn if it takes long.

    `mode` names the mode that makes an automatic step short, and is empty for other steps.
    """
    steps, dt = times.steps, times.dt
    entries = times.rows * (
        options.robot.nq + options.robot.nv + 24 + 4 * options.robot.n
    )
    most_steps = _ENDLESS if thinned else _MOST_STEPS
    if entries > _MOST_ENTRIES or steps > most_steps:
        reason = f"; {mode} requires this step" if mode else ""
        raise InputError(
            f"{steps * dt:g} s in steps of {dt:g} s are {steps:.3g} steps and {times.rows:.3g} "
            f"rows, which is too many{reason}; use a larger dt or `every`, sampled commands "
            "(sample=), a slower gain, or fewer modes"
        )
    if mode and steps > _MANY_STEPS:
        warnings.warn(
            f"the simulation takes long, because {mode} requires {steps:,} steps of {dt:.3g} s; "
            "give dt=, sampled commands (sample=), a slower gain, or fewer modes",
            FflinWarning,
            stacklevel=5,
        )


# Largest number of steps per sample that are tried beyond the least number.
_MOST_PARTS = 1000
_COUNTABLE = 2**53  # a double represents every whole number up to this one


def _in_steps(name: str, time: float, dt: float, advice: str) -> int:
    """Convert a time [s] to a number of steps; raise `InputError` unless it is a multiple of dt."""
    if time / dt > _COUNTABLE:
        raise InputError(
            f"{name} is {time:g} s, which is too many steps of dt = {dt:g} s"
        )
    if not _divides(dt, time):
        raise InputError(
            f"{name} is {time:.9g} s, expected a multiple of the step dt = {dt:.9g} s; {advice}"
        )
    return round(time / dt)


def _advice_on_duration(
    duration: float, dt: float, sample: float, delays: Sequence[float]
) -> str:
    """Return the nearest step [s] that divides the duration [s], or the nearest durations."""
    if nearest := _nearest_step(sample, dt, (duration, *delays)):
        return f"the nearest step that divides it is {_option(nearest)}"
    below = math.floor(duration / dt)
    times = [f"{steps * dt:.9g} s" for steps in (below, below + 1) if steps]
    return f"the nearest possible duration is {' or '.join(times)}"


def _samples_in_steps(sample: float, dt: float, times: Sequence[float]) -> int:
    """Return the sample time [s] as a number of steps of dt [s]; other times are multiples too.

    If it is not a whole number, raise `InputError` with the nearest step for which it is.
    """
    if _divides(dt, sample):
        return round(sample / dt)
    nearest = _nearest_step(sample, dt, times) or sample / max(1, round(sample / dt))
    advice = f"the nearest step that divides it is {_option(nearest)}"
    return _in_steps("sample", sample, dt, advice)


def _late_steps(
    delay: float, delays: tuple[float, ...], dt: float, sample: float, duration: float
) -> int:
    """Return a delay [s] as a number of steps of dt [s].

    If it is not a whole number, raise `InputError` with the nearest step for which it is.
    """
    if _divides(dt, delay):
        return round(delay / dt)
    if nearest := _nearest_step(sample, dt, (duration, *delays)):
        advice = f"the nearest step that divides it is {_option(nearest)}"
    else:
        advice = (
            "no step divides the sample time and the delay; the nearest delay for this step is "
            f"{round(delay / dt) * dt:g} s"
        )
    return _in_steps("delay", delay, dt, advice)


def _nearest_step(sample: float, dt: float, times: Sequence[float]) -> float | None:
    """Return the step nearest to dt [s] that divides the sample time and other times, or None."""
    parts = range(1, math.ceil(sample / dt) + _MOST_PARTS)
    steps = [sample / count for count in parts]
    fit = [step for step in steps if all(_divides(step, time) for time in times)]
    return min(fit, key=lambda step: abs(step - dt), default=None)


def _option(dt: float) -> str:
    """Return a step [s] as an argument and as an option of the command line."""
    return f"dt={dt:.9g} (--dt {dt:.9g})"


def _divides(dt: float, time: float) -> bool:
    """Return whether a time [s] is a whole number of steps of dt [s]."""
    return abs(round(time / dt) * dt - time) <= 1e-6 * dt


def _part_of(sample: float, largest: float, *times: float) -> float:
    """Return a time step of at most `largest` [s] that divides the sample time.

    If possible, the step also divides all `times`.
    """
    least = int(np.ceil(sample / largest))
    steps = [sample / parts for parts in range(least, least + _MOST_PARTS)]
    fit = (dt for dt in steps if all(_divides(dt, t) for t in times))
    return next(fit, steps[0])


def _positive(name: str, value: object) -> float:
    time = number(name, value)
    if not 1.0 / _FOREVER < time <= _FOREVER:
        raise InputError(
            f"{name} is {time:g} s, expected more than 0 and at most {_FOREVER:g} s"
        )
    return time


def time_to_settle(robot: Robot, policy: Feedback, q: Array, v: Array | None) -> float:
    """Return the time [s] after which the errors of the linear closed loop have settled.

    Three errors are considered: attitude, position and the largest joint error. Each of them has
    settled when it stays below 1 % of its own maximum. States that the policy does not feed back,
    and wheel angles, are ignored. The time is rounded up to a multiple of 10 s and is at least
    SHORTEST. If an error has not settled in 99 % of LONGEST, return SHORTEST.
    """
    lin = policy.lin
    matrices, step = _steps_of_loop(policy)
    v = np.zeros(robot.nv) if v is None else v
    _, initial_error = policy.deviation(robot)(0.0, q, v)
    history = np.zeros((math.ceil(LONGEST / step) + 1, len(matrices[0])))
    # After the errors of the model, the loop may have controller states, which are zero at first.
    history[0, : len(initial_error)] = initial_error
    for A, (state, next_state) in zip(cycle(matrices), pairwise(history), strict=False):
        next_state[:] = A @ state
    unsettled = np.zeros(len(history), dtype=bool)
    wheels = {f"q_m.{name}" for name in lin.wheels}
    for group in ("q_b", "r_b", "q_m"):
        judged = {name for name in policy.fed_back if group_of(name) == group} - wheels
        indices = [i for i, name in enumerate(lin.state_names) if name in judged]
        error = np.abs(history[:, indices]).max(axis=1, initial=0.0)
        unsettled |= error > 0.01 * error.max()
    last_unsettled = float(np.flatnonzero(unsettled).max(initial=0)) * step
    if last_unsettled >= 0.99 * LONGEST:
        return SHORTEST
    return max(SHORTEST, 10.0 * math.ceil(last_unsettled / 10.0))


def _steps_of_loop(policy: Feedback) -> tuple[Array, float]:
    """Return the matrices (N, nx, nx) of a period of the linear closed loop, and their step [s].

    Only laws of sensors with their own sample times have more than one matrix.
    """
    closed = policy.closed_loop()
    if closed is None:
        from fflin.control.margins import matrices_of_period

        return matrices_of_period(policy, policy.lin)
    A, dt = closed
    step = dt or _LOOK
    if not dt:
        no_inputs = np.zeros((len(A), 0))
        A, _ = held_exponential(A, no_inputs, step)
    return A[None], step
