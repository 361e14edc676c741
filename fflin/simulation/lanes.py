"""The compiled engine, which simulates eight runs in parallel.

An array whose values differ between the runs has eight entries in its last axis, one for each run.
These entries are called lanes. If there are fewer than eight runs, the remaining lanes repeat the
last run.
"""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.process import Progress
from fflin.base.rotation import rotation_matrix
from fflin.base.validation import Array, Indices, Mask, shaped, vector
from fflin.control.channel import channel_of
from fflin.control.loops import Loop, Sample, measured_at
from fflin.control.policies import translation_excess
from fflin.control.policy import BDotForm, Form, OutputForm, PathForm, Policy, StateForm
from fflin.control.sensor_errors import drift_generator, noise_generator
from fflin.control.tracking import AT_THE_END, TrajectoryFeedback
from fflin.dynamics.disturbance import Wave, distortion, waves_of
from fflin.dynamics.magnetic import MagneticField
from fflin.dynamics.orbital import mean_motion
from fflin.dynamics.state import StateMap
from fflin.kernel import allocation, forward, loop, orbit, policies
from fflin.kernel.compiled import compiles, is_kept, kernel
from fflin.kernel.constraints import LEAST_FRACTION, Constraints
from fflin.kernel.limits import Task, lacks_numba, reason_against
from fflin.kernel.tree import LANES, batch_tree, empty, laid_out, work_space
from fflin.robot.disturbance import BASE, INERTIAL, UNITS, DisturbanceTerm
from fflin.robot.fields import input_limits, limits_of
from fflin.robot.inputs import BaseTorque
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.orbit import EllipticOrbit
from fflin.robot.outputs import Gyroscope
from fflin.robot.robot import Robot
from fflin.simulation.extension import DRAG, SUNLIGHT, extension_of, is_extended
from fflin.simulation.plan import Plan, Times
from fflin.simulation.plant import Plant
from fflin.simulation.run import (
    STOPS,
    Recording,
    ending_of,
    go,
    singular_at,
    stop_conditions,
    stop_of,
)

# By default, a single run of more than LONG steps uses the compiled loop, if the machine code of
# the loop is already stored.
LONG = 20_000

# Place of the inputs among the vectors of a recorded row; see `LaneLoop`.
_INPUTS = 2

SLOTS = 128  # number of samples for which noise is stored at once
_MEMORY = 2**22  # [bytes] memory for recorded rows

# Name, in `Runs`, of the vectors of `disturbances_of` with dispersed constants.
DISTURBANCE = "disturbance"

# Names, in `Runs`, of the residual dipoles and of the matrices that distort the magnetic field.
RESIDUAL, DISTORTION = "residual", "distortion"

# {name of an array of the loop: values (N, size), one row per run}; see `Dispersions.in_lanes`.
Runs: TypeAlias = Mapping[str, Array]


def engine_of(engine: object, plan: Plan, *, many: bool = False) -> str:
    """Return the name of the engine for a plan: the requested engine, or the default engine.

    The default engine for many runs is the compiled loop, if it supports the plan. For a single
    run, two further conditions must be true: the run is long, and the machine code of the loop has
    been stored by an earlier run.
    """
    if not compiles(engine, lambda: not_compilable(plan)):
        return "python"
    long = plan.times.steps > LONG and is_kept("loop", loop_name(plan, lanes=1))
    if engine or many or long:
        return "compiled"
    return "python"


def loop_name(plan: Plan, *, lanes: int) -> str:
    """Return the name of the kernel function that simulates a number of runs of a plan."""
    name = "advance_one" if lanes == 1 else "advance"
    if is_extended(plan):
        name += "_extended"
    return f"{name}_in_orbit" if plan.plant.field else name


def form_of(policy: Policy, robot: Robot) -> Form | None:
    """Return the data of a policy for a robot, or None; raise `InputError` if they are invalid."""
    form = policy.form(robot)
    if form is None or isinstance(form, OutputForm | PathForm | BDotForm):
        return form
    what = f"{policy.kind}.form(robot)"
    if not isinstance(form, StateForm):
        kind = type(form).__name__
        raise InputError(f"{what} has type {kind}, expected a fflin.StateForm or None")
    points = math.prod(len(values) for values in form.grid.values())
    nx = 12 + 2 * robot.n
    nu = sum(len(names) for _, names in robot.named_inputs)
    shaped(
        f"offsets of {what}", form.offsets, (points, nu), " (points of the grid, nu)"
    )
    shaped(
        f"gains of {what}",
        form.gains,
        (points, nu, nx),
        " (points of the grid, nu, nx)",
    )
    shaped(f"x0 of {what}", form.x0, (nx,), " (nx)")
    return form


def not_compilable(plan: Plan) -> str:
    """Return why the compiled loop cannot run a plan, or an empty text if it can."""
    return reason_against(task_of(plan))


def only_numba_is_missing(plan: Plan) -> bool:
    """Return whether the compiled loop could run a plan if numba were installed."""
    return lacks_numba(task_of(plan))


def task_of(plan: Plan) -> Task:
    """Return what a plan asks of an engine."""
    plant = plan.plant
    task = Task(
        robots=(plant.robot,),
        simulated=True,
        events=bool(plan.events),
        callback=bool(plan.options.callback),
        disturbance=bool(plant.disturbance),
    )
    if plan.policy is None:
        return task
    policy = plan.policy.inner
    design = plan.policy.commanded_robot
    form = form_of(policy, design or plant.robot)
    if design is not None:
        task = replace(task, robots=(plant.robot, design))
    if form is None:
        task = replace(task, python_policy=policy.kind)
    if not isinstance(form, OutputForm):
        return task
    times = plan.times
    dt = form.loop.dt
    measurements = ""
    if not form.loop.measures_state:
        measurements = _measurement_error(plant.state)
    if design is not None and isinstance(form.loop, Loop) and form.loop.lag:
        task = replace(task, lagging=True)
    return replace(
        task,
        own_sample_time=dt > 0.0 and abs(times.sample * times.dt - dt) > 1e-6 * dt,
        noise_at_stages=policy.measurement_noise is not None and not times.sample,
        measurements=measurements,
    )


def _measurement_error(state: StateMap) -> str:
    """Return why the outputs of a robot cannot be computed in lanes, or an empty text."""
    try:
        measured_at(state)
    except InputError as error:
        return str(error)
    return ""


def noises(plan: Plan, size: int, step: int, last: int) -> tuple[Indices, Array]:
    """Return the indices (k,) and the sensor noise (k, size) of the samples in a range of steps.

    The range begins with `step` and ends before `last`. The policy must be sampled. If the policy
    defines no noise, the noise is zero.
    """
    times = plan.times
    at = np.arange(-(-step // times.sample), -(-last // times.sample))
    rows = np.zeros((len(at), size))
    for row, t in zip(rows, (at * times.sample * times.dt).tolist(), strict=True):
        if plan.noise:
            row[:] = vector(
                "noise(t)", plan.noise(t), size, "one value for each output"
            )
    return at, rows


def _largest(delays: Array) -> list[int]:
    """Return the largest of each column of delays (N, k) in steps."""
    largest: list[int] = delays.max(axis=0).astype(int).tolist()
    return largest


class Statistics:
    """Base class for statistics of eight parallel runs; this class collects none."""

    every = 1  # steps from one row to the next
    # steps between calls of `over`; Ctrl-C takes effect after at most this many
    span = 4096

    def over(self, q: Array, v: Array) -> Mask:
        """Return a mask (LANES,) of the runs that must end early, judged by q and v."""
        return np.zeros(len(q), dtype=bool)

    def reset(self) -> None:
        """Prepare for eight new runs."""

    def add(self, first: int, rows: Array) -> None:
        """Add rows (count, width, LANES) of q, nu, u, momentum and centre of mass.

        The rows are recorded at steps that are multiples of `every`. The first row is at the first
        of these steps that is not before the step `first`. When a run ends, this method is called
        with a single row, at the step `first`, for all lanes. For runs that continue, the next call
        may contain this row again.
        """

    def outcome(self, done: int, stop: Array) -> dict[str, Array]:
        """Return the outcomes after `done` steps; `stop` (LANES,) contains indices in STOPS."""
        return {}


class LaneLoop:
    """The compiled loop for a plan, with memory for its lanes; each thread needs its own loop.

    `lanes` is the number of runs at a time: eight, or one for a single run.

    `parts` are the arguments of the loop, with one lane per run, and `constraints` are its
    constraints, or None. A recorded row consists of q, nu, u, momentum, centre of mass and the
    forces of the constraints. For each of these six vectors, `ends` (6,) contains the column after
    its last entry.
    """

    def __init__(
        self, plan: Plan, runs: Runs | None = None, *, lanes: int = LANES
    ) -> None:
        runs = runs or {}
        self.lanes = lanes
        if "delay" in runs:  # provide space for the largest delay
            plan = plan.replace(
                times=plan.times._replace(delays=tuple(_largest(runs["delay"])))
            )
        stop = stop_conditions(plan)
        if runs:
            # `stop.sign` is the sign of q0 at the start of the plan, or 0 if q0 is not checked. The
            # initial quaternions of dispersed runs have a positive q0.
            stop = stop._replace(sign=[abs(stop.sign[0])])
        parts = packed(plan, stop, noisy="seed" in runs, dispersed={*runs})
        self._plan = plan
        self._state = plan.plant.state
        self._ending = ending_of(plan, stop)
        # With noise, `added` contains the noise of SLOTS samples. Without noise, it contains the
        # constant errors of a single sample, so that it is as long as y.
        self._noisy = len(parts.law.added) > len(parts.law.y)
        # `_fresh` contains a pair for each array with lanes: the array, and the column of initial
        # values that is copied to all lanes.
        self.constraints: Constraints | None = None
        plates: dict[str, Array] = {}
        if is_extended(plan):
            extended = loop.EXTENDED_OF_ONE if lanes == 1 else loop.EXTENDED
            whole = loop.ExtendedArguments(parts, extension_of(plan))
            whole, self._words, self._fresh = laid_out(whole, extended)
            self.parts, extension = whole
            # The words contain addresses of the arrays of `whole`, which must therefore exist.
            self._extended = whole
            if plan.plant.constrained is not None:
                self.constraints = extension.constraints
            plates = {
                DRAG: extension.plates.drag,
                SUNLIGHT: extension.plates.sunlight,
            }
        else:
            arguments = loop.ARGUMENTS_OF_ONE if lanes == 1 else loop.ARGUMENTS
            self.parts, self._words, self._fresh = laid_out(parts, arguments)
        self._work = self._space(self.parts.robot.tree.offsets.size)
        self._advance = kernel("loop", loop_name(plan, lanes=lanes))
        robot, point = self.parts.robot, self.parts.point
        momentum_size = 6
        center_size = 3
        forces = () if self.constraints is None else self.constraints.forces
        self.ends = np.cumsum(
            [
                len(point.q),
                len(point.nu),
                len(point.u),
                momentum_size,
                center_size,
                len(forces),
            ]
        )
        self.width = int(self.ends[-1])
        self.done = 0
        # Arrays of the loop that may differ between the runs, by their names in `Runs`.
        self._dispersed = {
            "q": point.q,
            "nu": point.nu,
            "delay": self.parts.channel.delay,
            **robot.tree._asdict(),
            **robot.faults._asdict(),
            DISTURBANCE: robot.disturbance.vector,
            RESIDUAL: self.parts.orbit.residual,
            DISTORTION: self.parts.orbit.distortion,
            **plates,
        }

    def _space(self, size: int) -> Array:
        """Return work space for the compiled code, which sees one lane as one axis."""
        space = work_space(size, self.lanes)
        if self.lanes == 1:
            space = space[:, 0]
        return space

    # A diverging motion may overflow before it is stopped, so NumPy's warnings are suppressed.
    @np.errstate(over="ignore", invalid="ignore")
    def fly(
        self, statistics: Statistics, out: Runs, runs: Runs | None = None
    ) -> list[str]:
        """Simulate at most one run per lane; return why each run ended early, or an empty text.

        `runs` contains the values that differ between the runs. Without `runs`, the plan itself is
        simulated. Row i of each array in `out` receives the outcome of run i. If
        `statistics.over` ends a run, the returned text is empty.
        """
        times, every, point = self._plan.times, statistics.every, self.parts.point
        steps = times.steps
        count = len(next(iter(out.values()))) if out else 1
        of_lane = np.minimum(np.arange(self.lanes), count - 1)
        runs = runs or {}
        self._write_initial_values(runs, of_lane)
        write_noise = self._sensor_errors(runs, of_lane)
        statistics.reset()
        row_size = 8 * self.lanes * self.width  # [bytes]
        most = max(1, min(-(-steps // every), _MEMORY // row_size))
        space = self._space(most * self.width)
        # The steps are divided into slices. A slice of `most * every` steps contains exactly `most`
        # recorded steps, whichever step comes first. These rows fit into `space`.
        span = min(most * every, statistics.span)
        if self._noisy:
            span = min(span, SLOTS * times.sample)
        clock = np.zeros(1, dtype=np.intp)
        messages = [""] * count
        going, bar = np.ones(count, dtype=bool), Progress(self._plan.options.progress)
        try:
            while self.done < steps and going.any():
                first = self.done
                last = min(steps, (first // span + 1) * span)
                write_noise(first, last)
                self._advance(self._words, clock, last, every, space, self._work)
                self.done = done = int(clock[0])
                if kept := -(-done // every) - -(-first // every):
                    rows = space[: kept * self.width]
                    rows = rows.reshape(kept, self.width, self.lanes)
                    statistics.add(first, rows)
                bar(done, steps)
                v = self._state.spread(point.nu.T)
                for lane in going.nonzero()[0]:
                    t = done * times.dt
                    messages[lane] = self._ending(t, point.q[:, lane], v[lane])
                    if not self._is_independent(int(lane)):
                        messages[lane] = singular_at(t)
                stop = np.array([float(stop_of(message)) for message in messages])
                if done % statistics.span == 0:
                    over = statistics.over(point.q.T, v)[:count] & (stop == 0.0)
                    stop[over] = STOPS.index("stopped")
                ending = going & ((stop > 0.0) | (done == steps))
                if not ending.any():
                    continue
                self._end(statistics, ending, stop[of_lane], out)
                going &= ~ending
                # A stop condition in one lane stops the loop for all lanes. A finished lane would
                # stop the loop again at every step, so the lane becomes a copy of a running lane.
                if going.any():
                    over = ~going[of_lane]
                    for array, _ in self._fresh:
                        array[:, over] = array[:, [going.argmax()]]
        finally:
            bar.close()
        return messages

    def _is_independent(self, lane: int) -> bool:
        """Return whether the rows of the constraints are independent in a lane."""
        if self.constraints is None:
            return True
        return float(self.constraints.least[0, lane]) > LEAST_FRACTION

    def _write_initial_values(self, runs: Runs, of_lane: Indices) -> None:
        """Write the initial values of all runs.

        `of_lane` (lanes,) contains the index of the run in each lane.
        """
        for array, initial in self._fresh:
            array[:] = initial
        for name, values in runs.items():
            if name in self._dispersed:
                self._dispersed[name][:] = values[of_lane].T
        robot = self.parts.robot
        # Each body has ten parameters, of which the mass is the first.
        mass = robot.tree.bodies[::10].sum(axis=0)
        reference = self.parts.reference
        reference.per_mass[0] = 1.0 / mass
        reference.weight[:] = mass * robot.gravity[:, None]
        # The moments of the momentum balance are about the initial base position.
        reference.start[9:] = self.parts.point.q[:3]
        self.done = 0

    def _sensor_errors(
        self, runs: Runs, of_lane: Indices
    ) -> Callable[[int, int], None]:
        """Write the sensor biases of all runs; return a function that writes sensor noise.

        `of_lane` (lanes,) contains the index of the run in each lane. The returned function must be
        called before each slice of steps. Its arguments are the first step of the slice and the
        step after the last one.
        """
        law = self.parts.law
        size = len(law.y)
        # Row k % SLOTS contains the errors (ny, lanes) of the measurement at sample k.
        slots = len(law.added) // max(size, 1)
        errors = law.added.reshape(slots, size, self.lanes)
        zero = np.zeros((self.lanes, size))
        bias = runs.get("sensed", zero)[of_lane].T
        deviation = runs.get("noise", zero)[of_lane].T
        errors[:] = bias
        generators = list[np.random.Generator]()
        drifting = list[np.random.Generator]()
        if "seed" in runs:
            generators = [noise_generator(seed) for seed in runs["seed"][of_lane]]
        if "drift" in runs:
            drifting = [drift_generator(seed) for seed in runs["seed"][of_lane]]
        steps = runs.get("drift", zero)[of_lane]
        drift = np.zeros((self.lanes, size))
        drawn_until = 0

        def write_noise(step: int, last: int) -> None:
            nonlocal drawn_until
            # If the end of a run interrupted this slice, the noise of the slice is already drawn.
            if not self._noisy or drawn_until == last:
                return
            drawn_until = last
            samples, noise = noises(self._plan, size, step, last)
            rows = samples % SLOTS
            errors[rows] = noise[..., None] + bias
            for lane, generator in enumerate(generators):
                normal = generator.standard_normal(noise.shape)
                errors[rows, :, lane] += deviation[:, lane] * normal
            for lane, generator in enumerate(drifting):
                changes = steps[lane] * generator.standard_normal(noise.shape)
                path = np.cumsum(np.vstack((drift[lane], changes)), axis=0)
                errors[rows, :, lane] += path[:-1]
                drift[lane] = path[-1]

        return write_noise

    def _end(
        self, statistics: Statistics, ending: Mask, stop: Array, out: Runs
    ) -> None:
        """Write the outcomes of the runs that end at the current step into `out`."""
        point = self.parts.point
        kept = self.parts.reference
        count = len(ending)
        conserved = kept.start[:9] + kept.sums[:9]
        conserved[6:] += (
            self.done * self._plan.times.dt * kept.per_mass * kept.start[:3]
        )
        last = np.vstack((point.q, point.nu, self.parts.method.u, conserved))
        if self.constraints is not None:
            last = np.vstack((last, self.constraints.forces))
        diverged = (stop == STOPS.index("diverged"))[:count]
        for chosen, finite in ((ending & diverged, False), (ending & ~diverged, True)):
            # the last state of a diverged run may not be finite, so it is not added
            if finite:
                statistics.add(self.done, last[None])
            outcome = statistics.outcome(self.done, stop)
            for name, rows in out.items():
                rows[chosen] = outcome[name][:count][chosen]


class LaneRows(Statistics):
    """Recorded rows of a single run, with the columns that `LaneLoop` describes."""

    def __init__(self, times: Times, width: int) -> None:
        self.every = times.every
        self.kept = np.empty((times.rows, width))

    def add(self, first: int, rows: Array) -> None:
        """Store rows; see `Statistics`."""
        begin = -(-first // self.every)
        self.kept[begin : begin + len(rows)] = rows[..., 0]


class RowsOfRuns(Statistics):
    """Recorded rows (LANES, rows, width) of eight runs, with columns up to the inputs."""

    def __init__(self, times: Times, loop: LaneLoop) -> None:
        self.every = times.every
        self.width = int(loop.ends[_INPUTS])
        self.rows = np.empty((LANES, times.rows, self.width))

    def add(self, first: int, rows: Array) -> None:
        """Store rows; see `Statistics`."""
        begin = -(-first // self.every)
        kept = rows[:, : self.width]
        self.rows[:, begin : begin + len(rows)] = np.moveaxis(kept, -1, 0)

    def outcome(self, done: int, stop: Array) -> dict[str, Array]:
        """Return the numbers of steps, and the last rows of all runs."""
        # After a run, its lane copies another run, whose rows may replace this last row.
        last = self.rows[:, -(-done // self.every)]
        return {"done": np.full(LANES, float(done)), "last": last}


def recorded(plan: Plan, runs: Runs | None = None) -> Recording:
    """Simulate a plan with the compiled loop; `runs` contains the values of one dispersed run."""
    # A replayed run of a campaign is computed with the machine code of the campaign.
    loop = LaneLoop(plan, runs, lanes=LANES if runs else 1)
    rows = LaneRows(plan.times, loop.width)
    try:
        [stopped] = loop.fly(rows, {}, runs)
    except KeyboardInterrupt:
        if not loop.done:
            raise
        stopped = f"interrupted at t = {loop.done * plan.times.dt:g} s"
    if runs is None and not np.isfinite(loop.parts.method.u).all():
        # the Python engine raises an error that names the invalid command
        return go(plan)
    return _recording(plan, loop, rows.kept, loop.done, stopped)


def recorded_runs(plan: Plan, runs: Runs, count: int) -> list[Recording]:
    """Simulate up to eight dispersed runs with the compiled loop.

    `runs` contains their values, with one row for each of the `count` runs. The recordings are
    brief.
    """
    loop = LaneLoop(plan, runs)
    statistics = RowsOfRuns(plan.times, loop)
    out = {
        "done": np.zeros(count),
        "last": np.zeros((count, statistics.width)),
    }
    reasons = loop.fly(statistics, out, runs)
    recordings = list[Recording]()
    for lane, (done, reason) in enumerate(zip(out["done"], reasons, strict=True)):
        kept = statistics.rows[lane]
        kept[-(-int(done) // plan.times.every)] = out["last"][lane]
        recordings.append(_recording(plan, loop, kept, int(done), reason))
    return recordings


def _recording(
    plan: Plan, loop: LaneLoop, kept: Array, done: int, stopped: str
) -> Recording:
    """Return the recording of a run that ended after `done` steps, from its recorded rows.

    If the rows end with the inputs, the recording is brief.
    """
    every, dt = plan.times.every, plan.times.dt
    count = -(-done // every)
    t = np.append(every * np.arange(count) * dt, done * dt)
    count += not stopped.startswith(("diverged", "interrupted"))
    kept = kept[:count]
    q, nu, u, momentum, center, forces, _ = np.split(kept, loop.ends, axis=1)
    brief = not momentum.size
    if brief:
        momentum = center = kept[:0]
    return Recording(
        t=t[:count],
        q=q,
        v=plan.plant.state.spread(nu),
        u=u,
        momentum=momentum,
        center=center,
        steps=done,
        stopped=stopped,
        engine="compiled",
        forces=None if brief or loop.constraints is None else forces,
    )


def packed(
    plan: Plan,
    stop: loop.StopConditions,
    *,
    noisy: bool = False,
    dispersed: Collection[str] = (),
) -> loop.Arguments:
    """Return the arguments of `kernel.loop.advance` for a plan that the kernel supports.

    `stop.squares` (nv,) must contain the squared limits of the entries of v. If `noisy` is true,
    the law stores the noise of SLOTS samples, even if the policy defines no noise. `dispersed`
    contains the names of the arrays that differ between the runs.
    """
    plant, times, method, u = plan.plant, plan.times, plan.method, plan.initial
    h, state = times.dt, plant.state
    size, (shift, speed) = 6 + state.robot.n, method.step_weights(h)
    mechanics = mechanics_of(plant, dispersed=DISTURBANCE in dispersed)
    # The delay line needs no space for commands that arrive after the end of the run.
    delays = [min(delay, times.steps) for delay in times.delays]
    channel = channel_of(plan.limits, u, times.sample, delays)
    return loop.Arguments(
        robot=mechanics,
        orbit=orbit_of(plant, dispersed=RESIDUAL in dispersed),
        method=loop.Method(
            h=h,
            origin=method.origins,
            shift=shift.ravel(),
            speed=speed.ravel(),
            nodes=np.minimum(np.array(method.nodes) * h, plan.last_node * h),
            weights=np.array(method.weights) * h,
            moments=h * (np.array(method.moments) * h),
            rates=np.zeros(speed.shape[1] * size),
            along=np.zeros(size),
            first=plan.q,
            second=plan.q,
            u=u,
        ),
        law=_law(plan, mechanics, noisy),
        channel=channel._replace(delay=list(map(float, times.delays))),
        # Placeholder: the values of this reference are written when a simulation starts.
        reference=forward.MomentumReference(*map(np.zeros, (12, 3, 1, forward.SUMS))),
        project=plan.project,
        pushed=not plant.isolated(driven=plan.law is not None),
        stop=stop._replace(squares=state.velocities(np.sqrt(stop.squares)) ** 2),
        point=forward.Point(
            q=plan.q, nu=state.velocities(plan.v), u=u, pushing=u, wrench=np.zeros(6)
        ),
    )


def disturbances_of(robot: Robot, *, dispersed: bool) -> list[Wave]:
    """Return the disturbances of a robot in the order of the compiled loop.

    If `dispersed` is true, a constant torque and a constant force follow, both zero, to which runs
    of a campaign add their drawn values.
    """
    waves = waves_of(robot)
    if dispersed:
        for name in UNITS:
            axes = DisturbanceTerm().axes_in(name, orbit=robot.orbit is not None)
            waves.append(Wave(name, axes, (0.0, 0.0, 0.0)))
    return waves


def mechanics_of(plant: Plant, *, dispersed: bool = False) -> forward.Mechanics:
    """Return the kernel's parameters of the robot and the actuators of a plant.

    `dispersed` is the argument of `disturbances_of`.
    """
    robot = plant.robot
    actuation = plant.actuation
    tree = batch_tree(plant.robot)
    springs = robot.springs
    assert tree is not None
    waves = disturbances_of(robot, dispersed=dispersed)
    return forward.Mechanics(
        tree=tree,
        gravity=list(robot.gravity),
        index=[joint.idx_q for joint in robot.joints],
        circling=[joint.unbounded for joint in robot.joints],
        scale=[joint.scale for joint in robot.joints],
        springy=(springs.stiffness != 0.0) | (springs.damping != 0.0),
        rest=springs.rest,
        held=[held.start for held in actuation.held],
        triads=plant.triads,
        origin=pin.SE3ToXYZQUAT(plant.state.origin),
        faults=plant.faults,
        disturbance=forward.BaseDisturbance(
            vector=np.array([wave.vector for wave in waves]).ravel(),
            phase=[wave.phase for wave in waves],
            rate=[wave.rate for wave in waves],
            at=[0 if wave.name == BaseTorque.GROUP else 3 for wave in waves],
            held=[wave.axes != BASE for wave in waves],
            inertial=[bool(plant.field) and wave.axes == INERTIAL for wave in waves],
        ),
    )


def orbit_of(plant: Plant, *, dispersed: bool = False) -> orbit.Orbit:
    """Return the kernel's parameters of the orbit of a plant; empty without an orbit.

    `dispersed` states whether the residual dipole and the errors of the field differ between runs.
    """
    none: orbit.Orbit = empty(orbit.ORBIT)
    field = plant.field
    path = plant.robot.orbit
    if field is None or path is None:
        return none
    ellipse = np.zeros(0)
    if isinstance(path, EllipticOrbit):
        anomaly = path.at(0.0).angle
        ellipse = np.array([path.eccentricity, path.mean_anomaly, anomaly])
        latitude = path.argument_of_perigee + anomaly
        distance = path.semi_major_axis
    else:
        latitude = path.argument_of_latitude
        distance = path.radius
    dipole: Array = np.zeros(3)
    pole: Array = np.zeros(0)
    if field.magnetic is not None:
        dipole, pole = _dipole_of(field.magnetic, path.inclination, distance)
    residual = plant.on_base.dipole
    matrix = distortion(plant.robot, field)
    if matrix is None and dispersed:
        matrix = np.eye(3)
    return none._replace(
        distortion=np.zeros(0) if matrix is None else matrix.ravel("F"),
        residual=residual if dispersed or residual.any() else np.zeros(0),
        outwards=field.axes[:, 0],
        normal=field.axes[:, 2],
        mean_motion=[mean_motion(plant.robot)],
        ellipse=ellipse,
        latitude=[latitude],
        dipole=dipole,
        pole=pole,
        now=np.zeros(orbit.END),
    )


def _dipole_of(
    field: MagneticField, inclination: float, distance: float
) -> tuple[Array, Array]:
    """Return the fields `dipole` and `pole` of the kernel's `Orbit`."""
    sine, cosine = math.sin(inclination), math.cos(inclination)
    a = field.moment / distance**3
    axial = a * math.cos(field.pole.colatitude)
    dipole = axial * np.array([-2.0 * sine, sine, cosine])
    if not field.rotates:
        return dipole, np.zeros(0)
    amplitude = a * math.sin(field.pole.colatitude)
    pole = [amplitude, field.pole.longitude, field.pole.rate, sine, cosine]
    return dipole, np.array(pole)


def no_law(state: StateMap, u: Array) -> policies.Law:
    """Return the law of an uncontrolled robot; the law computes states and errors only."""
    law: policies.Law = empty(policies.LAW)
    q, nu = np.zeros(state.robot.nq), np.zeros(state.nx // 2)
    point = law.path.point._replace(q=q, nu=nu, u=np.zeros(len(u)))
    return law._replace(
        turned=list(state.axes),
        origin=pin.SE3ToXYZQUAT(state.origin),
        near=np.zeros(state.robot.n),
        period=1,
        x=np.zeros(state.nx),
        u=u,
        path=law.path._replace(
            along=np.zeros(len(nu)), e=np.zeros(state.nx), point=point
        ),
    )


def _law(plan: Plan, mechanics: forward.Mechanics, noisy: bool) -> policies.Law:
    """Return the law of a plan's policy.

    An `Allocation` contains a policy for another robot, `Allocation.design`. In this case, the law
    first computes commands for the inputs of that robot. It then allocates these commands to the
    inputs of the simulated robot.
    """
    asking = plan.plant
    state = plan.plant.state
    form = None
    if plan.policy:
        if design := plan.policy.commanded_robot:
            asking = Plant(
                StateMap(design, reference=state.reference, frame=state.frame)
            )
        form = form_of(plan.policy.inner, asking.robot)
    law = no_law(state, np.zeros(len(asking.actuation.names)))
    if asking is not plan.plant:
        law = law._replace(allocation=_allocation(plan.plant, asking, mechanics))
    if isinstance(form, OutputForm):
        law = _filtered(law, plan, form, asking)
    elif isinstance(form, PathForm):
        path = _path(law.path, plan, form.policy, asking.state)
        law = law._replace(kind=policies.TRACK, path=path)
    elif isinstance(form, StateForm):
        law = _linear(law, form, state)
    elif isinstance(form, BDotForm):
        direct = law.filter._replace(D=form.gain.ravel())
        kind = policies.DAMPING if form.measures_rate else policies.B_DOT
        law = law._replace(kind=kind, filter=direct)
    size = len(law.measured)
    slots = SLOTS if noisy or plan.noise else 1
    return law._replace(y=np.zeros(size), added=np.zeros(slots * size))


def _linear(law: policies.Law, form: StateForm, state: StateMap) -> policies.Law:
    """Return the law of a state feedback, whose gain may be interpolated over a grid."""
    near = form.x0[state.groups.q_m].copy()
    law = law._replace(kind=policies.LINEAR, measured=np.arange(state.nx), near=near)
    if not form.grid:
        D = -form.gains[0].ravel()
        direct = law.filter._replace(D=D, u0=form.offsets[0], y0=np.zeros(state.nx))
        return law._replace(filter=direct)
    sizes = [len(values) for values in form.grid.values()]
    grid = policies.Grid(
        joint=[state.robot.joint_names.index(name) for name in form.grid],
        first=np.cumsum([0, *sizes]),
        values=np.concatenate(list(form.grid.values())),
        stride=[np.prod(sizes[axis + 1 :]) for axis in range(len(sizes))],
        K=form.gains.ravel(),
        offset=form.offsets.ravel(),
        at=np.zeros(len(sizes)),
    )
    return law._replace(grid=grid)


def _filtered(
    law: policies.Law, plan: Plan, form: OutputForm, asking: Plant
) -> policies.Law:
    """Return the law of a compensator, or of a state feedback with a memory.

    The law commands the inputs of the plant `asking`. Along a trajectory, the law contains the
    matrices of the compensator for each sample.
    """
    state = asking.state
    times = plan.times
    rows = 1
    loop = form.loop
    if form.samples:
        rows = min(form.samples, -(-times.steps // times.sample))
    starts = [k * times.sample * times.dt for k in range(rows)]
    _, measures, near = zip(*map(loop.at, starts), strict=True)
    nz = len(form.terms(0.0).A)
    stages = 1 if times.sample else 1 + len(plan.method.nodes)
    terms = [
        term._replace(jump=np.broadcast_to(term.jump, nz))
        for term in map(form.terms, starts)
    ]
    compensator = {
        key: np.concatenate([getattr(term, key).ravel() for term in terms])
        for key in Sample._fields
    }
    measured, gyros = list(range(state.nx)), list[Gyroscope]()
    if not loop.measures_state:
        measured, gyros = measured_at(state)
    frames = [find_frame(asking.robot.model, gyro.frame) for gyro in gyros]
    axes = mechanics_of(plan.plant).tree.axes
    turns = [axes[f.joint - ROOT].T @ f.placement.rotation for f in frames]
    return law._replace(
        kind=policies.LINEAR,
        period=min(form.period, rows),
        origin=np.concatenate(
            [pin.SE3ToXYZQUAT(measure.state.origin) for measure in measures]
        ),
        near=np.concatenate([x[state.groups.q_m] for x in near]),
        filter=policies.Filter(
            **compensator, z=np.zeros(nz), rates=np.zeros(stages * nz)
        ),
        measured=measured,
        gyros=[frame.joint - ROOT for frame in frames],
        gyro_axes=np.array([turn.ravel("F") for turn in turns]).ravel(),
        x=np.zeros(state.nx + 3 * len(gyros)),
    )


def _allocation(
    plant: Plant, asking: Plant, giving: forward.Mechanics
) -> allocation.Allocation:
    """Return the allocation of commands to the inputs of the simulated robot.

    The commands are for the inputs of the plant `asking`. The simulated robot is the robot of
    `plant`, and has the kernel parameters `giving`.
    """
    asks = mechanics_of(asking)
    size = plant.state.nx // 2
    least, most = input_limits(plant.robot, limits_of(plant.robot))
    inputs = max(len(robot.actuation.names) for robot in (asking, plant))
    free = np.full(len(asking.actuation.names), np.inf)
    point = empty(forward.POINT)._replace(
        q=np.zeros(plant.robot.nq), pushing=np.zeros(inputs)
    )
    return allocation.Allocation(
        asking=asks,
        giving=giving,
        point=point,
        work=np.zeros(max(asks.tree.offsets.size, giving.tree.offsets.size)),
        translation=np.zeros(3 * size),
        excess=translation_excess(asking.robot, plant.robot),
        problem=allocation.least_squares(least, most, size),
        back=allocation.least_squares(-free, free, size),
    )


def _path(
    path: policies.Path, plan: Plan, policy: TrajectoryFeedback, state: StateMap
) -> policies.Path:
    """Return a copy of `path` with the trajectory and the gains of a policy.

    If the run is longer than the trajectory, one more row is appended: the operating point at the
    end of the trajectory, and the gain for this point.
    """
    motion, schedule = policy.trajectory, policy.schedule
    shift, speed = (state.velocities(cubic).ravel() for cubic in motion.cubics)
    q = list(motion.q)
    u = list(motion.u)
    held = [part.start for part in motion.actuation.held]
    ends = plan.times.steps * plan.times.dt > policy.duration * AT_THE_END
    ends = ends and not motion.period
    pieces = schedule.K if schedule.dt else schedule.pieces
    pieces = pieces.reshape(len(schedule.starts), -1, len(u[0]) * state.nx)
    if ends:
        last = np.zeros_like(pieces[:1])
        last[0, 0] = policy.end_gain.ravel()
        pieces = np.concatenate((pieces, last))
        q.append(policy.end.q)
        u.append(policy.end.u0.copy())
        speed = np.append(speed, state.velocities(policy.end.v))
        for at in held:
            u[-1][at : at + 3] = rotation_matrix(q[-1][3:7]) @ u[-1][at : at + 3]
    return path._replace(
        t=motion.t,
        q=np.concatenate(q),
        u=np.concatenate(u),
        smooth=motion.smooth_pieces.ravel(),
        shift=shift,
        speed=speed,
        hold=motion.hold == "previous",
        ahead=policy.ahead,
        ends=bool(ends),
        held=held,
        over=policy.over,
        period=motion.period,
        slack=1e-9 * schedule.dt,
        last=float(schedule.t[-1] - schedule.t[0]),
        starts=schedule.starts,
        K=pieces.ravel(),
        order=pieces.shape[1],
    )
