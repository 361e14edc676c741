"""Conversion of control laws to the tables of their C code, and test cases for this code."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin
from numpy.linalg import norm

from fflin.base.errors import FflinError, InputError
from fflin.base.rotation import conjugate, quaternion_product
from fflin.base.validation import Array, Indices, instance
from fflin.control.bdot import TINY
from fflin.control.compensator import Compensator
from fflin.control.following import Following, ReferencePath
from fflin.control.gain import Gain, model_of, sampled_for
from fflin.control.loops import NOT_CORRECTED, Sample
from fflin.control.multirate import MultirateCompensator
from fflin.control.policies import PointLaw, StateFeedback
from fflin.control.policy import (
    BDotForm,
    Command,
    OutputForm,
    PathForm,
    Policy,
    StateForm,
    bound,
)
from fflin.control.sensors import SensorTiming, timing_of_robot
from fflin.control.tracking import TrajectoryFeedback, TrajectoryOutputFeedback
from fflin.control.tvlqr import GainSchedule
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import readout
from fflin.linear.fit import Signals, signals_of
from fflin.linear.model import LinearModel
from fflin.linear.trajectory import refuse_periodic
from fflin.robot.fields import chosen_limits, input_limits
from fflin.robot.loading import load
from fflin.robot.robot import Robot

CASES = 200

Design: TypeAlias = Gain | GainSchedule | Compensator | MultirateCompensator | Policy


class Case(NamedTuple):
    """Test case for the C code: arguments `given` of a step, and the correct results `out`.

    `sample` is the number of the sample, and `scale` is the sum of the magnitudes of the terms of
    each result. The rounding error of a result is at most the product of the unit roundoff, its
    `scale` and the number of operations.
    """

    sample: int
    given: Array
    out: Array
    scale: Array


@dataclass(frozen=True, kw_only=True)
class Law:
    """Control law, converted to the tables of its C code, with test cases.

    A state law is ``u = u0 - K (x - x0)``. Its tables K, x0, u0 and `reference` have one row for
    all samples, or one row for each sample. If there is a table `axis_points`, it contains a grid
    of joint positions. K then has one row for each grid point, and is interpolated. A state law
    with memory has ``C z`` as a further term, and the next z is ``A z + B (x - x0)``. Its K has one
    row.

    A magnetic law is ``u = D w``. Its vector w is the measured y, or b x omega / (b b) of the
    measured y = (b, omega).

    An output law is ``u = u0 + C z + D (y - y0)``. The next controller state z is
    ``A z + B (y - y0)``. Its tables u0 and y0 have one row for all samples, or one row for each
    sample.
    """

    title: str
    state: StateMap | None  # None for an output law
    signals: Signals  # names and units of the states or outputs
    inputs: Signals
    dt: float
    robot: Robot
    lin: LinearModel | None
    # Tables of the C code, by name. Every law has the tables u0, low, high, continuous and E, the
    # gain of the anti-windup, which may be empty.
    tables: dict[str, Array]
    memory: int  # number of entries of the memory z
    # q (N, nq) and v (N, nv) at all samples of an output law that follows a trajectory. Its
    # attitudes and positions are relative to the base poses in q.
    points: tuple[Array, Array] | None = None
    # sample times and delays that the sensors must have, or None if they may have any
    timing: SensorTiming | None = None
    delay: tuple[float, ...] = ()  # delay [s] of each input; empty without delays
    # inputs (nu,) until the first command arrives, if they are not the first row of u0
    initial: Array | None = None
    # bound on the number of rounded operations between an argument and a result
    operations: float
    cases: list[Case]
    period: int = 1  # number of samples after which the tables A, B and E repeat
    # whether the tables for the samples repeat; if not, the last row stays in effect
    repeats: bool = False
    # data of a magnetic law
    magnetic: BDotForm | None = None

    @property
    def kind(self) -> str:
        """Kind of the law: state, output or magnetic."""
        if self.magnetic is not None:
            return "magnetic"
        return "state" if self.state else "output"


def measured(world: StateMap, q: Array, v: Array) -> Array:
    """Return the arguments (13 + 2n,) of the C code of a state law at q and v.

    `world` is a state map of the robot whose reference is the world. q and v are not checked.
    """
    # The C code takes the angular velocity of the base in base axes, but the velocity of its origin
    # in world axes. `velocities` returns both in base axes.
    attitude = quaternion_product(world.origin_quaternion, q[3:7])
    omega_b, v_b, joint_rates = np.split(world.velocities(v), (3, 6))
    return np.concatenate(
        (
            attitude,
            world.positions(q),
            world.joint_positions(q),
            omega_b,
            world.rotation(q) @ v_b,
            joint_rates,
        )
    )


def law_of(given: object, robot: object, limits: object) -> Law:
    """Convert a policy or a controller design to a `Law`, with `limits` as in `simulate`."""
    if not isinstance(given, Design):
        raise _not_written(given)
    lin = None
    trajectory = None
    if isinstance(given, Gain):
        lin = given._lin
    elif isinstance(given, Policy):
        lin = given.model
        trajectory = given.followed_trajectory
    if robot is None and isinstance(given, Following):
        robot = given.lin._robot
    if robot is None and lin:
        robot = lin._robot
    if robot is None and trajectory:
        robot = trajectory.robot
    if robot is None:
        # A law that was read from a file contains only the robot's name, which `load` may know.
        with suppress(FflinError):
            name = lin.robot if lin else getattr(given, "robot", "")
            robot = load(name)
    robot = instance("robot", robot, (Robot, type(None)), "a Robot")
    if robot is None:
        raise _robot_error(given, "is not known")
    if robot.urdf_sha256 != getattr(lin or given, "urdf_sha256", robot.urdf_sha256):
        raise _robot_error(
            given, f"has another URDF or other masses than '{robot.name}'"
        )
    law = _law_of(given, robot)
    high = np.full(len(law.inputs[0]), np.inf)
    low = -high
    if limits is not None:
        if signals_of(StateMap(robot), "input")[0] != law.inputs[0]:
            raise InputError(
                "limits need the robot with the inputs of the law; give the robot of the design "
                "with robot= (--robot)"
            )
        low, high = input_limits(robot, chosen_limits(robot, limits))
    law.tables.update(low=low, high=high)
    return law


def _not_written(given: object) -> InputError:
    return InputError(
        f"law has type {type(given).__name__}, expected a Gain, StateFeedback, OutputFeedback, "
        "MultirateFeedback, LinearController, Compensator, GainSchedule, TrajectoryFeedback, "
        "ScheduledFeedback, BDot or RateDamping"
    )


def _robot_error(given: object, problem: str) -> InputError:
    """Build the error for the robot of a design, which `problem` describes."""
    return InputError(
        f"the robot of this {type(given).__name__} {problem}; give the robot of the design with "
        "robot= (--robot)"
    )


def _law_of(given: Design, robot: Robot) -> Law:
    """Convert a policy or a controller design for a robot."""
    title = type(given).__name__
    if isinstance(given, Compensator | MultirateCompensator):
        return _compensator_law(given, robot)
    policy = _policy_of(given, robot)
    form = policy.form(robot)
    if isinstance(form, BDotForm):
        return _magnetic_law(title, form, robot)
    law = _law_along_trajectory(title, policy, robot)
    if law is None:
        dt = given.dt if isinstance(given, Gain) else policy.sample_time
        law = _law_of_model(title, policy, dt, robot)
    if law is None:
        raise _not_written(given)
    return law


def _policy_of(given: Policy | Gain | GainSchedule, robot: Robot) -> Policy:
    """Return the policy of a gain or of a gain schedule; return a policy unchanged."""
    if isinstance(given, GainSchedule):
        return TrajectoryFeedback(given.trajectory(robot), given)
    if not isinstance(given, Gain):
        return given
    made = f"the gain was designed for '{given.robot}'"
    model = given._lin or model_of(
        given, robot, made, pin.XYZQUATToSE3(given.placement)
    )
    if (given.integrals or given.delay.any()) and not model.dt:
        model = sampled_for(given, model)
    return StateFeedback(model, given if given.integrals else given.K)


def _law_along_trajectory(title: str, policy: Policy, robot: Robot) -> Law | None:
    """Convert a policy along a trajectory, or return None for another policy."""
    if isinstance(policy, Following):
        return _following_law(title, policy, robot)
    if isinstance(policy, TrajectoryFeedback) and policy.trajectory.period:
        return _periodic_law(title, policy, robot)
    form = policy.form(robot)
    if not isinstance(form, PathForm):
        return None
    state = form.policy.state_map(robot)
    tables = _samples(form.policy, state)
    return _law_of_states(title, policy, state, tables, {}, robot)


def _law_of_model(title: str, policy: Policy, dt: float, robot: Robot) -> Law | None:
    """Convert a policy about the point of its model, or return None if it is of another kind."""
    form, lin = policy.form(robot), policy.model
    if lin is None:
        return None
    if isinstance(form, StateForm):
        return _state_law(title, policy, dt, form, robot)
    if isinstance(form, OutputForm) and form.loop.measures_state:
        return _memory_law(title, policy, form.terms(0.0), robot)
    # The form also contains the sensors of the robot, which the code does not contain.
    if not isinstance(policy, PointLaw):
        return None
    terms = policy.terms_of_period()
    law = _output_law(
        title,
        terms,
        inputs=(lin.input_names, lin.input_units),
        signals=(lin.output_names, lin.output_units),
        dt=policy.sample_time,
        robot=robot,
        lin=lin,
    )
    return replace(law, timing=policy.designed_timing)


def _state_law(
    title: str, policy: Policy, dt: float, form: StateForm, robot: Robot
) -> Law:
    """Convert a state feedback about the point of a model."""
    return _law_about_point(
        title, policy, robot, x0=form.x0, gains=form.gains, axes=form.grid, dt=dt
    )


def _memory_law(title: str, policy: Policy, terms: Sample, robot: Robot) -> Law:
    """Convert a state feedback with a memory, such as integrals, about the point of a model."""
    return _law_about_point(
        title,
        policy,
        robot,
        x0=terms.y0,
        gains=-terms.D[None],
        dt=policy.sample_time,
        terms=terms,
    )


def _following_law(title: str, policy: Following, robot: Robot) -> Law:
    """Convert a law that follows a trajectory, with one row of the tables for each sample."""
    lin = policy.lin
    path = ReferencePath(policy, robot)
    dt = policy.sample_time
    if policy.senses_outputs:
        timing = timing_of_robot(path.state, dt)
        times = dt * np.arange(policy.samples + timing.oldest)
        rows = [path.terms(t) for t in times]
        planned = np.array([row.y0 for row in rows])
        received = [timing.measured(k) for k in range(len(times))]
        # Each received value is compared with the plan at the time of its measurement.
        y0 = np.take_along_axis(planned, np.array(received), axis=0)
        law = _output_law(
            title,
            list(policy.terms),
            inputs=(lin.input_names, lin.input_units),
            signals=(lin.output_names, lin.output_units),
            dt=dt,
            robot=robot,
            lin=None,
            rows=(np.array([row.u0 for row in rows]), y0),
        )
        law = replace(law, points=_points(policy, times), timing=timing)
    else:
        times = dt * np.arange(policy.samples)
        rows = [path.terms(t) for t in times]
        tables = _references(path.state, *_points(policy, times)) | {
            "u0": np.array([row.u0 for row in rows]),
            "K": -rows[0].D[None],
        }
        law = _law_of_states(
            title, policy, path.state, tables, {}, robot, terms=rows[0]
        )
    delay = tuple(policy.input_delays.values())
    return replace(law, delay=delay, initial=policy.reference(0.0)[2])


def _points(policy: Following, times: Array) -> tuple[Array, Array]:
    """Return q (N, nq) and v (N, nv) of the trajectory of a law at times (N,) [s] of the run."""
    q, v, _ = map(np.array, zip(*map(policy.reference, times), strict=True))
    return q, v


def _law_about_point(
    title: str,
    policy: Policy,
    robot: Robot,
    *,
    x0: Array,
    gains: Array,
    dt: float,
    axes: Mapping[str, Array] = {},
    terms: Sample | None = None,
) -> Law:
    """Return the law of a policy about the point of its model, with one gain for each grid point.

    `terms` are the terms of a law with a memory.
    """
    lin = policy.model
    assert lin is not None
    frame, reference = policy.axes
    state = StateMap(robot, reference=reference, frame=frame)
    tables = {
        "reference": lin.placement[None],
        "x0": x0[None],
        "u0": lin.u0[None],
        "K": gains,
    }
    return _law_of_states(
        title, policy, state, tables, axes, robot, dt=dt, lin=lin, terms=terms
    )


def _memory_case(
    random: np.random.Generator, terms: Sample, case: Case, dx: Array, size: Array
) -> Case:
    """Return the test case of a law with memory at a random memory z.

    `case` is the test case of its gain K alone, and dx = x - x0. `size` (nx,) are the sums of the
    magnitudes of the terms in dx.
    """
    z = random.normal(scale=10.0 ** random.uniform(-4, 0), size=len(terms.A))
    after = terms.A @ z + terms.B @ dx
    scale = case.scale + np.abs(terms.C) @ np.abs(z)
    of_next = np.abs(terms.A) @ np.abs(z) + np.abs(terms.B) @ size
    return Case(
        case.sample,
        np.concatenate((z, case.given)),
        np.concatenate((case.out + terms.C @ z, after)),
        np.concatenate((scale, of_next)),
    )


def _law_of_states(
    title: str,
    policy: Policy,
    state: StateMap,
    tables: dict[str, Array],
    axes: Mapping[str, Array],
    robot: Robot,
    *,
    dt: float | None = None,
    lin: LinearModel | None = None,
    terms: Sample | None = None,
) -> Law:
    """Return the law with tables of K, x0, u0 and `reference`, whose gain may have a grid.

    The memory of the law, if it has one, follows `terms`.
    """
    dt = policy.sample_time if dt is None else dt
    memory = 0
    if terms is None:
        command = bound(policy, robot)
        tables["E"] = NOT_CORRECTED
    else:
        _require_sampled(dt)
        memory = len(terms.A)
        command = _gain_alone(state, tables, dt)
        tables |= {key: getattr(terms, key) for key in "ABCE"}
    cases = list(_state_cases(state, command, dt, tables, axes, terms))
    tables["in_reference_axes"] = np.array(state.axes)
    tables["continuous"] = np.array(
        [joint.unbounded for joint in robot.joints], dtype=bool
    )
    if axes:
        tables["axis_joint"] = np.array([*map(robot.joint_names.index, axes)])
        tables["axis_size"] = sizes = np.array([*map(len, axes.values())])
        padded = [np.pad(x, (0, sizes.max() - len(x))) for x in axes.values()]
        tables["axis_points"] = np.array(padded)
    cells = (np.abs(x).max() / np.diff(x).min() for x in axes.values())
    return Law(
        title=title,
        state=state,
        signals=signals_of(state, "state"),
        inputs=signals_of(state, "input"),
        dt=dt,
        robot=robot,
        lin=lin,
        tables=tables,
        operations=state.nx + 32.0 + 8.0 * sum(cells) + 2.0 * memory,
        cases=cases,
        memory=memory,
    )


def _chart(state: StateMap, tables: Mapping[str, Array], row: int) -> StateMap:
    """Return the state map about the reference in a row of the tables of a law."""
    if len(tables["reference"]) == 1:
        return state
    return state.about(pin.XYZQUATToSE3(tables["reference"][row]))


def _gain_alone(state: StateMap, tables: Mapping[str, Array], dt: float) -> Command:
    """Return the command of a law with memory whose memory is zero."""
    [K] = tables["K"]

    def command(t: float, q: Array, v: Array) -> Array:
        row = round(t / dt)
        x0, u0 = tables["x0"][row], tables["u0"][row]
        law = readout(_chart(state, tables, row), K, u0 + K @ x0, x0)
        return np.asarray(law(t, q, v))

    return command


def _state_cases(
    state: StateMap,
    policy: Command,
    dt: float,
    tables: dict[str, Array],
    axes: Mapping[str, Array],
    terms: Sample | None,
) -> Iterator[Case]:
    """Yield test cases at random states, with the results that the policy computes.

    With `terms`, the law also has a memory, and `policy` is its gain alone.

    Some states are close to half a turn from the reference or the target. If K is interpolated,
    some states are at the ends of the grid or beyond.
    """
    random = np.random.default_rng(0)
    n = state.robot.n
    turning = state.unbounded
    world = StateMap(state.robot, frame=state.frame)
    for index in range(CASES):
        row = index % len(tables["x0"])
        x0, u0, about = (tables[key][row] for key in ("x0", "u0", "reference"))
        # Joint positions and velocities are random near x0. The pose of the base is set below.
        x = x0 + random.normal(scale=10.0 ** random.uniform(-4, 0), size=state.nx)
        x[:6] = 0.0
        turns = np.zeros(n)
        turns[turning] = random.integers(-3, 4, len(turning))
        if index % 5 == 0:  # continuous joints close to half a turn from x0
            close = np.pi + random.choice([-1e-3, 1e-3], len(turning))
            x[6 + turning] = x0[6 + turning] + close
        if axes and index % 4 == 0:  # joints at and beyond the ends of the grid
            for name, values in axes.items():
                at = 6 + state.robot.joint_names.index(name)
                x[at] = random.choice(
                    [values[0], values[-1], values[0] - 0.1, values[-1] + 0.1]
                )
        q, v = state.to_pinocchio(x)
        turn: Array = random.normal(size=4)
        if index % 7 == 0:  # attitude close to half a turn from the reference
            turn[3] = (1e-3, -1e-3, 0.1, -0.1)[index % 4]
        # attitude: exactly half a turn
        if index == 0 and (about[3:6] == 0.0).all() and not axes:
            turn = np.array((1.0, 0.0, 0.0, 0.0))
        turn = quaternion_product(about[3:], turn / norm(turn))
        q[3:7] = quaternion_product(conjugate(world.origin_quaternion), turn)
        origin = world.origin
        q[:3] = origin.rotation.T @ (
            about[:3] + random.normal(size=3) - origin.translation
        )
        given = measured(world, q, v)
        given[7 : 7 + n] += 2.0 * np.pi * turns
        u = np.asarray(policy(row * dt, q, v))
        displaced = _chart(state, tables, row).read(q, v, near=x0)
        # The next lines sum the magnitudes of the terms in each entry of x - x0.
        omega, v = given[7 + n : 10 + n], given[10 + n : 13 + n]
        pose = [1.0] * 3 + [float(norm(given[4:7]) + norm(about[:3]))] * 3
        rates = np.repeat((norm(omega), norm(v)), 3)
        joints = np.abs(given[7 : 7 + n]), np.abs(given[13 + n :])
        size = np.abs(x0) + np.hstack((pose, joints[0], rates, joints[1]))
        gains = np.abs(tables["K"])
        K = gains.max(axis=0) if axes else gains[row % len(gains)]
        case = Case(row, given, u, np.abs(u0) + K @ size)
        if terms is not None:
            dx = displaced - x0
            case = _memory_case(random, terms, case, dx, size)
        yield case


def _periodic_law(title: str, policy: TrajectoryFeedback, robot: Robot) -> Law:
    """Convert the feedback along a trajectory that repeats."""
    if isinstance(policy, TrajectoryOutputFeedback):
        refuse_periodic(policy.trajectory, "C code of output feedback")
    state = policy.state_map(robot)
    law = _law_of_states(title, policy, state, _samples(policy, state), {}, robot)
    return replace(law, repeats=True)


def _samples(policy: TrajectoryFeedback, state: StateMap) -> dict[str, Array]:
    """Return the tables of a law with one row for each sample of a trajectory.

    The last row also applies to all samples after the end of the trajectory. If the trajectory
    repeats, the rows are the samples of one period.
    """
    if not (dt := policy.schedule.dt):
        raise InputError(
            "the gains are continuous in time, expected sampled gains; design sampled gains with "
            "tvlqr(..., sample=dt) (fflin tvlqr --sample)"
        )
    if policy.trajectory.period:
        times = dt * np.arange(len(policy.schedule.K) - 1)
    else:
        times = dt * np.arange(int(policy.over / dt) + 3)
        times = times[: np.searchsorted(times, policy.over, side="right") + 1]
    q, v, u0 = map(np.array, zip(*map(policy.commanded, times), strict=True))
    gains = np.array([*map(policy.gain, times)])
    return _references(state, q, v) | {"u0": u0, "K": gains}


def _references(state: StateMap, q: Array, v: Array) -> dict[str, Array]:
    """Return the tables of base poses and states at points q (N, nq) and v (N, nv)."""
    attitudes = [
        quaternion_product(state.origin_quaternion, quaternion)
        for quaternion in q[:, 3:7]
    ]
    joints = state.joint_positions(q), state.velocities(v)
    return {
        "reference": np.hstack((state.positions(q), attitudes)),
        "x0": np.hstack((np.zeros((len(q), 6)), *joints)),
    }


_AXES = ("x", "y", "z")


def _magnetic_law(title: str, form: BDotForm, robot: Robot) -> Law:
    """Convert a law of the magnetic field, whose moments are a gain times a vector."""
    names = [f"derivative of b.{axis}" for axis in _AXES]
    units = ["T/s"] * 3
    if form.measures_rate:
        names = [f"b.{axis}" for axis in _AXES] + [f"omega.{axis}" for axis in _AXES]
        units = ["T"] * 3 + ["rad/s"] * 3
    return Law(
        title=title,
        state=None,
        signals=(tuple(names), tuple(units)),
        inputs=signals_of(StateMap(robot), "input"),
        dt=0.0,
        robot=robot,
        lin=None,
        tables={
            "u0": np.zeros((1, len(form.gain))),
            "D": form.gain,
            "E": NOT_CORRECTED,
        },
        operations=16.0,
        memory=0,
        cases=list(_magnetic_cases(form)),
        magnetic=form,
    )


def _magnetic_cases(form: BDotForm) -> Iterator[Case]:
    """Yield test cases of a magnetic law at random measurements; one has no field."""
    random = np.random.default_rng(0)
    gains = np.abs(form.gain)
    for number in range(CASES):
        y: Array = random.normal(size=3) * 10.0 ** random.uniform(-9, -5)
        vector, size = y, np.abs(y)
        if form.measures_rate:
            b = 1e3 * y
            if not number:
                b = np.zeros(3)
            omega = random.normal(size=3) * 10.0 ** random.uniform(-4, 0)
            y = np.concatenate((b, omega))
            square = max(float(b @ b), TINY)
            vector = np.cross(b, omega) / square
            size = np.full(3, norm(b) * norm(omega) / square)
        yield Case(0, y, form.gain @ vector, gains @ size)


def _compensator_law(given: Compensator | MultirateCompensator, robot: Robot) -> Law:
    """Convert a compensator, which contains no model; the robot's signals give the units."""
    none = np.zeros((len(given.u0), len(given.y0)))
    corrected = given.E.any()
    periodic = isinstance(given, MultirateCompensator)
    matrices = (given.A, given.B, given.E)
    terms = [
        Sample(
            A, B, given.C, none, given.u0, given.y0, E=E if corrected else NOT_CORRECTED
        )
        for A, B, E in (zip(*matrices, strict=True) if periodic else [matrices])
    ]
    state = StateMap(robot)
    sensed, asked = (signals_of(state, kind) for kind in ("output", "input"))
    known = dict(zip(sensed[0] + asked[0], sensed[1] + asked[1], strict=True))
    return _output_law(
        type(given).__name__,
        terms,
        inputs=(
            given.output_names,
            tuple(known.get(x, "unknown") for x in given.output_names),
        ),
        signals=(
            given.input_names,
            tuple(known.get(x, "unknown") for x in given.input_names),
        ),
        dt=given.dt,
        robot=robot,
        lin=None,
    )


def _require_sampled(dt: float) -> None:
    """Raise `InputError` if a controller with memory is continuous."""
    if not dt:
        raise InputError(
            "the controller is continuous, expected a sampled controller; use "
            "LinearController.sampled(dt), or design the controller for lin.discretize(dt)"
        )


def _output_law(
    title: str,
    terms: list[Sample],
    *,
    inputs: Signals,
    signals: Signals,
    dt: float,
    robot: Robot,
    lin: LinearModel | None,
    rows: tuple[Array, Array] | None = None,
) -> Law:
    """Return the law of a controller, with `terms` for each sample of a period.

    `rows` contains u0 and y0 for each sample of a trajectory, if the law follows one.
    """
    first = terms[0]
    if len(first.A):
        _require_sampled(dt)
    angles = {f"q_m.{joint.name}" for joint in robot.joints if joint.unbounded}
    continuous = np.array([name in angles for name in signals[0]])
    u0, y0 = rows or (first.u0[None], first.y0[None])
    tables = {key: getattr(first, key) for key in "ABCDE"}
    if len(terms) > 1:
        for key in "ABE":
            tables[key] = np.array([getattr(term, key) for term in terms])
    tables |= {"u0": u0, "y0": y0, "continuous": continuous}
    return Law(
        title=title,
        state=None,
        signals=signals,
        inputs=inputs,
        dt=dt,
        robot=robot,
        lin=lin,
        tables=tables,
        operations=float(len(first.A) + len(signals[0]) + 16),
        memory=len(first.A),
        cases=list(_output_cases(terms, u0, y0, np.flatnonzero(continuous))),
        period=len(terms),
    )


def _output_cases(
    terms: list[Sample], inputs: Array, outputs: Array, turning: Indices
) -> Iterator[Case]:
    """Yield test cases at random controller states z and outputs y of the robot.

    `terms` contains the law at each sample of a period; `inputs` and `outputs` contain u0 and y0 of
    each sample of a trajectory. The results of a case are u and the next z.
    """
    random, (nz, ny) = np.random.default_rng(0), terms[0].B.shape
    samples = max(len(terms), len(inputs))
    for number in range(CASES):
        index = number % samples
        row = min(index, len(inputs) - 1)
        sample = terms[index % len(terms)]._replace(u0=inputs[row], y0=outputs[row])
        size = 10.0 ** random.uniform(-4, 0)
        z, dy = random.normal(scale=size, size=nz), random.normal(scale=size, size=ny)
        turns = np.zeros(ny)
        turns[turning] = 2.0 * np.pi * random.integers(-3, 4, len(turning))
        y = sample.y0 + dy

        def measured(_: Array, y: Array = y) -> Array:
            return y

        u, next_z = sample.step(z, measured)
        of_z = np.abs(z)
        of_y = np.abs(y) + np.abs(sample.y0) + np.abs(turns)
        scale = np.abs(sample.u0) + np.abs(sample.C) @ of_z + np.abs(sample.D) @ of_y
        after = np.abs(sample.A) @ of_z + np.abs(sample.B) @ of_y
        yield Case(
            index,
            np.append(z, y + turns),
            np.append(u, next_z),
            np.append(scale, after),
        )
