"""Control laws as the tables that the C code contains, with test cases computed by fflin."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.linalg import norm

from fflin.base.errors import FflinError, InputError
from fflin.base.rotation import conjugate, quaternion_product
from fflin.base.validation import Array, instance
from fflin.control.channel import input_limits
from fflin.control.gain import Gain
from fflin.control.kalman import Compensator
from fflin.control.linear_controller import LinearController
from fflin.control.policies import Compensation, Gridded, Sample, StateFeedback
from fflin.control.tracking import TrajectoryFeedback, TrajectoryOutputFeedback
from fflin.control.tvlqr import GainSchedule
from fflin.dynamics.state import Actuation, StateMap
from fflin.linear.fit import Signals, require_same, sensed
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
    signals: Signals  # names and units of the states or outputs
    inputs: Signals
    frame: Any
    dt: float
    u0: Array  # (rows, nu)
    limits: tuple[Array, Array]  # (nu,) least and largest inputs
    robot: Robot | None
    lin: LinearModel | None


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
    axes: dict[str, Array]

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
        return [name in angles for name in self.signals[0]]

    @property
    def operations(self) -> float:
        """Bound on the number of rounded operations between an argument and u or z."""
        return float(len(self.terms.A) + len(self.signals[0]) + 16)

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
    attitude, nu = quaternion_product(world.origin_quaternion, q[3:7]), world.velocities(v)
    pose = attitude, world.positions(q), world.joint_positions(q)
    return np.concatenate((*pose, nu[:3], world.rotation(q) @ nu[3:6], nu[6:]))


def law_of(given: object, robot: object, limits: object) -> StateLaw | OutputLaw:
    """Convert a policy or design to the tables of a law; `limits` are as in `simulate`."""
    of_states = Gain | StateFeedback | Gridded | GainSchedule | TrajectoryFeedback
    known = isinstance(given, of_states | LinearController | Compensator)
    if not known or isinstance(given, TrajectoryOutputFeedback):
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
    policy: Any = given
    axes: dict[str, Array] = {}
    if isinstance(given, TrajectoryFeedback):
        lin, dt, state = None, given.schedule.dt, given.state_map(robot)
        placements, x0, u0, K = _samples(given, state)
    else:
        if isinstance(given, Gain):
            lin = lin or _model_of(given, robot)
            policy = StateFeedback(lin, given.K)
        dt, state = given.dt if isinstance(given, Gain) else lin.dt, policy.state_map(robot)
        axes, gains = policy.table() if isinstance(policy, Gridded) else ({}, policy.K[None])
        terms = [StateFeedback(lin, gain).terms(state) for gain in gains]
        placements, x0, u0 = lin.placement[None], terms[0][2][None], lin.u0[None]
        K = np.array([gain for gain, _, _ in terms])
    actuation = Actuation(state)
    return StateLaw(
        title=type(given).__name__,
        signals=(state.names, state.units),
        inputs=(actuation.names, actuation.units),
        frame=state.frame,
        dt=dt,
        u0=u0,
        limits=_limits(robot, limits, actuation.names),
        robot=robot,
        lin=lin,
        state=state,
        policy=policy.bind(robot),
        placements=placements,
        x0=x0,
        K=K,
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
    if gain.urdf_sha256 != robot.urdf_sha256:
        raise InputError(
            f"the gain was designed for another '{gain.robot}' than the given '{robot.name}': "
            "their masses or URDFs differ; give the robot of the design with robot= (--robot), "
            "or design the gain again"
        )
    frame: Any = gain.frame
    state = StateMap(robot, frame=frame, reference=pin.XYZQUATToSE3(gain.placement))
    own, there = (gain.state_names, gain.state_units), (state.names, state.units)
    require_same(f"the gain was designed for '{gain.robot}'", robot, "state", own, there)
    q, v = state.to_pinocchio(gain.x0)
    return linearize(robot, q, v, gain.u0, frame=frame, reference=state.reference)


def _limits(robot: Robot | None, limits: object, names: Sequence[str]) -> tuple[Array, Array]:
    """Return the least and largest inputs (nu,); without `limits`, they are infinite."""
    if limits is None:
        return np.full(len(names), -np.inf), np.full(len(names), np.inf)
    own = [x for _, group in named_inputs(robot.inputs if robot else ()) for x in group]
    if robot is None or own != list(names):
        raise InputError(
            "limits need the robot with the inputs of the law; give the robot of the design "
            "with robot= (--robot)"
        )
    return input_limits(robot, chosen_limits(robot, limits)[0])


def _samples(policy: TrajectoryFeedback, state: StateMap) -> tuple[Array, Array, Array, Array]:
    """Return poses, x0, u0 and K at each sample, and at last after the end of the trajectory."""
    if not (dt := policy.schedule.dt):
        raise InputError(
            "the gains are continuous in time, expected sampled gains; design sampled gains with "
            "tvlqr(..., sample=dt) (fflin tvlqr --sample)"
        )
    last = int(np.ceil(policy.over / dt * (1.0 - 1e-12)))
    while last * dt <= policy.over:
        last += 1
    world, rows = StateMap(state.robot, frame="local"), []
    for t in dt * np.arange(last + 1):
        q, v, u = policy.commanded(t)
        attitude = quaternion_product(world.origin_quaternion, q[3:7])
        x0 = np.zeros(state.nx)
        x0[state.groups.q_m] = world.joint_positions(q)
        x0[6 + state.robot.n :] = world.velocities(v)
        rows.append((np.append(world.positions(q), attitude), x0, u, policy.gain(t)))
    poses, states, inputs, gains = map(np.array, zip(*rows, strict=True))
    return poses, states, inputs, gains


def _output_law(
    given: LinearController | Compensator, lin: Any, robot: Robot | None, limits: object
) -> OutputLaw:
    if isinstance(given, Compensator):
        none = np.zeros((len(given.u0), len(given.y0)))
        terms = Sample(given.A, given.B, given.C, none, given.u0, given.y0)
        known: dict[str, str] = {}  # {signal: unit}
        if robot is not None:
            state = StateMap(robot)
            actuation = Actuation(state)
            for names, units in (sensed(state), (actuation.names, actuation.units)):
                known |= dict(zip(names, units, strict=True))
        inputs, outputs = (
            (names, tuple(known.get(name, "unknown") for name in names))
            for names in (given.output_names, given.input_names)
        )
    else:
        terms, inputs = given.terms, (lin.input_names, lin.input_units)
        outputs = lin.output_names, lin.output_units
    if not given.dt and len(terms.A):
        raise InputError(
            "the controller is continuous, expected a sampled controller; use "
            "LinearController.sampled(dt), or design the controller for lin.discretize(dt)"
        )
    return OutputLaw(
        title=type(given).__name__,
        signals=outputs,
        inputs=inputs,
        frame=lin.frame if lin else "",
        dt=given.dt,
        u0=terms.u0[None],
        limits=_limits(robot, limits, inputs[0]),
        robot=robot,
        lin=lin,
        terms=terms,
    )
