"""Control laws as the tables that the C code contains, with test cases computed by fflin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.linalg import norm

from fflin.base.errors import FflinError, InputError
from fflin.base.rotation import conjugate, quaternion_product
from fflin.base.validation import Array, instance
from fflin.control.channel import input_limits
from fflin.control.gain import Gain
from fflin.control.gain_schedule import GainSchedule
from fflin.control.kalman import Compensator
from fflin.control.linear_controller import LinearController
from fflin.control.policies import Compensation, Gridded, Sample, StateFeedback
from fflin.control.tracking import TrajectoryFeedback, TrajectoryOutputFeedback
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.state import StateMap
from fflin.linear.fit import sensed
from fflin.linear.linearization import linearize
from fflin.linear.model import LinearModel
from fflin.robot.fields import chosen_limits
from fflin.robot.inputs import named_inputs
from fflin.robot.loading import load
from fflin.robot.robot import Robot

CASES = 200


class Case(NamedTuple):
    """Test case: arguments `given` of a step, its results `out`, and the scale of rounding errors.

    The error of `out` is at most the unit roundoff times `scale` times the number of operations.
    """

    sample: int
    given: Array
    out: Array
    scale: Array


@dataclass(frozen=True, kw_only=True)
class Law:
    """Properties common to all exported laws."""

    title: str
    names: tuple[str, ...]  # of the states or outputs
    units: tuple[str, ...]
    frame: Any
    dt: float
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    u0: Array  # (rows, nu)
    low: Array  # (nu,)
    high: Array
    robot: Robot | None
    lin: LinearModel | None = None


@dataclass(frozen=True, kw_only=True)
class StateLaw(Law):
    """Law u = u0 - K (x - x0), with one row of tables, or a row for each sample.

    With `axes`, K is interpolated between the points of a grid {joint: values}.
    """

    state: StateMap
    policy: Callable[[float, Array, Array], Any]
    placements: Array  # (rows, 7), poses of the base or reference in the world
    x0: Array  # (rows, nx)
    K: Array  # (rows or points of the grid, nu, nx)
    axes: dict[str, Array] = field(default_factory=dict)

    @property
    def follows(self) -> bool:
        """Whether the law has one row for each sample."""
        return len(self.x0) > 1

    @property
    def operations(self) -> float:
        """Bound on the number of rounded operations between an argument and u."""
        cells = (np.abs(x).max() / np.diff(x).min() for x in self.axes.values())
        return self.state.nx + 32.0 + 8.0 * sum(cells)

    def cases(self) -> list[Case]:
        """Return test cases at random and near-singular states, with the inputs of the policy."""
        random = np.random.default_rng(0)
        return [self._case(random, k % len(self.x0), k) for k in range(CASES)]

    def _case(self, random: np.random.Generator, row: int, index: int) -> Case:
        state, n, about = self.state, self.state.robot.n, self.placements[row]
        world = StateMap(state.robot, frame=self.frame)
        # A random state near x0 with the base at the reference; the base's pose is set afterwards.
        x = self.x0[row] + random.normal(scale=10.0 ** random.uniform(-4, 0), size=state.nx)
        x[:6] = 0.0
        turns = np.zeros(n)
        turns[state.unbounded] = random.integers(-3, 4, len(state.unbounded))
        if index % 5 == 0:  # close to half a turn from the target, on either side
            close = np.pi + random.choice([-1e-3, 1e-3], len(state.unbounded))
            x[6 + state.unbounded] = self.x0[row, 6 + state.unbounded] + close
        if self.axes and index % 4 == 0:  # at and beyond the ends of the grid
            for name, values in self.axes.items():
                at = 6 + state.robot.joint_names.index(name)
                x[at] = random.choice([values[0], values[-1], values[0] - 0.1, values[-1] + 0.1])
        q, v = state.to_pinocchio(x)
        turn: Array = random.normal(size=4)
        if index % 7 == 0:  # close to half a turn from the reference
            turn[3] = (1e-3, -1e-3, 0.1, -0.1)[index % 4]
        if index == 0 and (about[3:6] == 0.0).all() and not self.axes:  # exactly half a turn
            turn = np.array((1.0, 0.0, 0.0, 0.0))
        turn = quaternion_product(about[3:], turn / norm(turn))
        q[3:7] = quaternion_product(conjugate(world.origin_quaternion), turn)
        there = about[:3] + random.normal(size=3)
        q[:3] = world.origin.rotation.T @ (there - world.origin.translation)
        given = measured(world, q, v)
        given[7 : 7 + n] += 2.0 * np.pi * turns
        u = np.asarray(self.policy(row * self.dt, q, v))
        # Magnitudes of the terms whose sum is a state.
        omega, v = given[7 + n : 10 + n], given[10 + n : 13 + n]
        pose = [1.0] * 3 + [float(norm(given[4:7]) + norm(about[:3]))] * 3
        rates = np.repeat((norm(omega), norm(v)), 3)
        joints = np.abs(given[7 : 7 + n]), np.abs(given[13 + n :])
        size = np.abs(self.x0[row]) + np.hstack((pose, joints[0], rates, joints[1]))
        K = np.abs(self.K).max(axis=0) if self.axes else np.abs(self.K[row])
        return Case(row, given, u, np.abs(self.u0[row]) + K @ size)


@dataclass(frozen=True, kw_only=True)
class OutputLaw(Law):
    """Law u = u0 + C z + D (y - y0), after which z becomes A z + B (y - y0)."""

    terms: Sample

    @property
    def continuous(self) -> list[bool]:
        """Whether each output is the angle of a continuous joint."""
        joints = self.robot.joints if self.robot else ()
        angles = {f"q_m.{joint.name}" for joint in joints if joint.unbounded}
        return [name in angles for name in self.names]

    @property
    def operations(self) -> float:
        """Bound on the number of rounded operations between an argument and u or z."""
        return float(len(self.terms.A) + len(self.names) + 16)

    def cases(self) -> list[Case]:
        """Return test cases at random controller states and outputs, with u and the next z."""
        random, by, found = np.random.default_rng(0), self.terms, list[Case]()
        (nz, ny), turning = by.B.shape, np.flatnonzero(self.continuous)
        for _ in range(CASES):
            size = 10.0 ** random.uniform(-4, 0)
            z, dy = random.normal(scale=size, size=nz), random.normal(scale=size, size=ny)
            turns = np.zeros(ny)
            turns[turning] = 2.0 * np.pi * random.integers(-3, 4, len(turning))
            y = by.y0 + dy
            law = Compensation(nz, lambda _: by)
            law.estimate = z
            u = law.step(0.0, lambda *_, y=y: y)
            of_z, of_y = np.abs(z), np.abs(y) + np.abs(by.y0) + np.abs(turns)
            scale = np.abs(by.u0) + np.abs(by.C) @ of_z + np.abs(by.D) @ of_y
            after = np.abs(by.A) @ of_z + np.abs(by.B) @ of_y
            out, scales = np.append(u, law.estimate), np.append(scale, after)
            found.append(Case(0, np.append(z, y + turns), out, scales))
        return found


def measured(world: StateMap, q: Array, v: Array) -> Array:
    """Return the arguments (13 + 2n,) of a state law at a valid q and v, in the order of C.

    `world` is the state map relative to the world.
    """
    nu = world.velocities(v)
    return np.concatenate(
        (
            quaternion_product(world.origin_quaternion, q[3:7]),
            world.positions(q),
            world.joint_positions(q),
            nu[:3],
            world.rotation(q) @ nu[3:6],
            nu[6:],
        )
    )


_KINDS = (
    *(Gain, StateFeedback, Gridded, LinearController, Compensator),
    *(GainSchedule, TrajectoryFeedback),
)


def law_of(given: object, robot: object, limits: object) -> StateLaw | OutputLaw:
    """Convert a policy or design to the tables of a law; `limits` are as in `simulate`."""
    if not isinstance(given, _KINDS) or isinstance(given, TrajectoryOutputFeedback):
        raise InputError(
            f"law has type {type(given).__name__}, expected a Gain, StateFeedback, OutputFeedback, "
            "LinearController, Compensator, GainSchedule, TrajectoryFeedback or ScheduledFeedback"
        )
    lin: Any = given._lin if isinstance(given, Gain) else getattr(given, "lin", None)
    robot = _robot_of(given, lin) if robot is None else instance("robot", robot, Robot, "a Robot")
    if isinstance(given, LinearController | Compensator):
        return _output_law(given, lin, robot, limits)
    if robot is None:
        raise InputError(
            f"the robot of this {type(given).__name__} is not known, and the C code depends on "
            "its continuous joints; give the robot with robot= (--robot)"
        )
    if isinstance(given, GainSchedule):
        given = TrajectoryFeedback(given.trajectory(robot), given)
    if isinstance(given, TrajectoryFeedback):
        return _tracking_law(given, robot, limits)
    policy: Any = given
    if isinstance(given, Gain):
        lin = lin or _model_of(given, robot)
        policy = StateFeedback(lin, given.K)
    axes, gains = policy.table() if isinstance(policy, Gridded) else ({}, policy.K[None])
    state = policy.state_map(robot)
    terms = [StateFeedback(lin, K).terms(state) for K in gains]
    return StateLaw(
        **_common(given, robot, limits, lin.input_names, lin.input_units),
        frame=state.frame,
        dt=given.dt if isinstance(given, Gain) else lin.dt,
        names=state.names,
        units=state.units,
        u0=lin.u0[None],
        lin=lin,
        state=state,
        policy=policy.bind(robot),
        placements=lin.placement[None],
        x0=terms[0][2][None],
        K=np.array([K for K, _, _ in terms]),
        axes=axes,
    )


def _robot_of(given: Any, lin: LinearModel | None) -> Robot | None:
    """Return the robot of a law; None if it is neither in memory nor among the known robots."""
    own = lin._robot if lin else getattr(getattr(given, "trajectory", None), "robot", None)
    if own is not None:
        return own
    try:
        return load(lin.robot if lin else given.robot)
    except FflinError:
        return None


def _model_of(gain: Gain, robot: Robot) -> LinearModel:
    """Linearise a robot at the point and reference stored with a gain that was read from a file."""
    if not gain.placement.size:
        raise InputError(
            "the file of the gain does not contain the reference pose, because the file was "
            "written by an older version; design the gain again"
        )
    if gain.urdf_sha256 != robot.urdf_sha256:
        raise InputError(
            f"the gain was designed for another '{gain.robot}' than the given '{robot.name}': "
            "their masses or URDFs differ; give the robot of the design with robot= (--robot), "
            "or design the gain again"
        )
    frame: Any = gain.frame
    state = StateMap(robot, frame=frame, reference=pin.XYZQUATToSE3(gain.placement))
    if gain.state_names != state.names:
        raise InputError(
            f"the states of the gain differ from those of '{robot.name}'; give the robot of the "
            "design with robot= (--robot)"
        )
    q, v = state.to_pinocchio(gain.x0)
    return linearize(robot, q, v, gain.u0, frame=frame, reference=state.reference)


def _common(
    given: object,
    robot: Robot | None,
    limits: object,
    names: tuple[str, ...],
    units: tuple[str, ...],
) -> dict[str, Any]:
    """Return the fields common to all laws; without `limits`, the input limits are infinite."""
    low, high = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    if limits is not None:
        own = [x for _, group in named_inputs(robot.inputs if robot else ()) for x in group]
        if robot is None or tuple(own) != names:
            raise InputError(
                "limits need the robot with the inputs of the law; give the robot of the design "
                "with robot= (--robot)"
            )
        low, high = input_limits(robot, chosen_limits(robot, limits)[0])
    common = {"title": type(given).__name__, "robot": robot, "low": low, "high": high}
    return {**common, "input_names": names, "input_units": units}


def _tracking_law(policy: TrajectoryFeedback, robot: Robot, limits: object) -> StateLaw:
    if not policy.schedule.dt:
        raise InputError(
            "the gains are continuous in time, expected sampled gains; design sampled gains with "
            "tvlqr(..., sample=dt) (fflin tvlqr --sample)"
        )
    dt, state = policy.schedule.dt, policy.state_map(robot)
    world = StateMap(robot, frame="local")
    # One row for each sample; the last row applies after the end of the trajectory.
    last = int(np.ceil(policy.over / dt * (1.0 - 1e-12)))
    while last * dt <= policy.over:
        last += 1
    points = [(*policy.commanded(k * dt), policy.gain(k * dt)) for k in range(last + 1)]
    placements, x0 = np.empty((last + 1, 7)), np.zeros((last + 1, state.nx))
    for k, (q, v, _, _) in enumerate(points):
        placements[k, :3] = world.positions(q)
        placements[k, 3:] = quaternion_product(world.origin_quaternion, q[3:7])
        x0[k, state.groups.q_m] = world.joint_positions(q)
        x0[k, 6 + robot.n :] = world.velocities(v)
    actuation = Actuation(state)
    return StateLaw(
        **_common(policy, robot, limits, actuation.names, actuation.units),
        frame=state.frame,
        dt=dt,
        names=state.names,
        units=state.units,
        u0=np.array([u for _, _, u, _ in points]),
        state=state,
        policy=policy.bind(robot),
        placements=placements,
        x0=x0,
        K=np.array([K for *_, K in points]),
    )


def _output_law(
    given: LinearController | Compensator, lin: Any, robot: Robot | None, limits: object
) -> OutputLaw:
    if isinstance(given, Compensator):
        none = np.zeros((len(given.u0), len(given.y0)))
        terms = Sample(given.A, given.B, given.C, none, given.u0, given.y0)
        inputs, outputs = given.output_names, given.input_names
        units = _units_of(robot, inputs, outputs)
    else:
        terms, inputs, outputs = given.terms, lin.input_names, lin.output_names
        units = [lin.input_units, lin.output_units]
    if not given.dt and len(terms.A):
        raise InputError(
            "the controller is continuous, expected a sampled controller; use "
            "LinearController.sampled(dt), or design the controller for lin.discretize(dt)"
        )
    return OutputLaw(
        **_common(given, robot, limits, inputs, units[0]),
        frame=lin.frame if lin else "",
        dt=given.dt,
        u0=terms.u0[None],
        lin=lin,
        terms=terms,
        names=outputs,
        units=units[1],
    )


def _units_of(robot: Robot | None, *names: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Return the units of signals that are inputs or outputs of a robot, "unknown" for others."""
    known: dict[str, str] = {}
    if robot is not None:
        state = StateMap(robot)
        actuation = Actuation(state)
        for signals in (sensed(state), (actuation.names, actuation.units)):
            known |= dict(zip(*signals, strict=True))
    return [tuple(known.get(name, "unknown") for name in each) for each in names]
