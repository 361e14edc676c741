"""The closed loop: policy, actuator channel, steps on the manifold, and statistics of a run.

The channel changes the commands of the policy: it applies limits, sample and hold, a delay,
thruster pulses and the speed limits of wheels. The compiled engine runs the whole loop. The Python
engine calls only `goes_on` and the functions of the channel (see `control.channel`).
"""

from collections import namedtuple

import numpy as np

from fflin.base.validation import Array
from fflin.kernel import constraints as held
from fflin.kernel import forward
from fflin.kernel import vectors as vec
from fflin.kernel.allocation import allocate, write_difference
from fflin.kernel.extension import EXTENSION, lag_inputs
from fflin.kernel.forward import MECHANICS, MOMENTUM_REFERENCE, POINT
from fflin.kernel.orbit import ORBIT
from fflin.kernel.policies import (
    LAW,
    NOTHING,
    PATH,
    command,
    correct,
    error,
    observe,
    read_state,
)
from fflin.kernel.tree import FLAG, FLAGS, INDICES, LANED, REAL, REALS, WHOLE, Struct
from fflin.kernel.vectors import (
    Entries,
    angle,
    below,
    chosen,
    compiled_as,
    load,
    root,
    store,
)


class Wheels(
    namedtuple(
        "Wheels", "at row least_torque most_torque least_speed most_speed stiffness"
    )
):
    r"""Wheels (k,) with speed limits: :math:`u \le J (w_{max} - w) / dt`.

    A torque u changes the speed w by u dt / J in a step of dt [s]. J = 1 / (M^-1)_ii is the
    effective inertia of the wheel in the free-floating robot, and i is the index of w in nu.

    - `at`: index of the wheel's input. `row`: index of the wheel's speed in nu.
    - `least_torque`, `most_torque` [N m]: torque limits of the motor.
    - `least_speed`, `most_speed` [rad/s]: speed limits.
    - `stiffness`: J / dt, with J at the initial configuration.
    """


class Pulses(namedtuple("Pulses", "at on_off most least left level end time")):
    """Pulsed thrusters (k,): one pulse per sample delivers the commanded impulse.

    - `at`: index of the thruster's input. `on_off`: True if the thrust is either 0 or `most`, False
      if the thrust can have any value from 0 to `most`.
    - `most` [N]: largest thrust. `least` [N s]: least impulse of a pulse.
    - `left` [N s]: the commanded impulse that was not fired. It is added to the commanded impulse
      of the next sample.
    - `level` [N]: the thrust of the latest pulse. `end`: the time at which the latest pulse ends,
      in steps. If a pulse ends within a step, its mean thrust acts during this step, so that the
      impulse is exact.
    - `time` [s]: the sample time.
    """


class Channel(
    namedtuple(
        "Channel", "low high held pending slots sample delay fresh wheels pulses"
    )
):
    """Channel from commands (nu,) to inputs: limits, sample and hold, delay, wheels and pulses.

    - `low`, `high` (nu,): limits of the commands.
    - `held` (nu,): the latest command that has arrived. `pending` (slots, nu): the commands of the
      latest samples. Some of these commands may not have arrived yet, because of the delay.
    - `sample`: number of steps per sample, 0 for continuous commands.
    - `delay` (1,) or (nu,): delay of all inputs, or of each input, in steps.
    - `fresh`, of the same length: 1 in a step in which a command arrives, else 0. Until the first
      command arrives, `fresh` is 1 at the start of each sample, so that the initial inputs are
      pulsed too.
    """


WHEELS = Struct(Wheels, at=INDICES, row=INDICES)
PULSES = Struct(
    Pulses, REALS, {LANED: "left level end"}, at=INDICES, on_off=FLAGS, time=REAL
)
_OF_CHANNEL = {WHOLE: "slots sample", LANED: "held pending delay fresh"}
CHANNEL = Struct(Channel, REALS, _OF_CHANNEL, wheels=WHEELS, pulses=PULSES)


def clipped(value, low, high):
    """Return a number clipped to limits; NaN remains NaN."""
    value = chosen(value, low, low, value)
    return chosen(high, value, high, value)


def _limit_by_loop(channel, u):
    """Compute `limit` in compiled code."""
    for index in range(len(channel.low)):
        value = clipped(
            load(u, index), load(channel.low, index), load(channel.high, index)
        )
        store(u, index, value)


@compiled_as(_limit_by_loop)
def limit(channel: Channel, u: Array) -> None:
    """Saturate the commands u at the limits of the channel."""
    np.clip(u, channel.low, channel.high, out=u)


def is_asked(channel: Channel, step: int) -> bool:
    """Return whether the policy is evaluated in a step.

    Continuous commands are evaluated in every step, sampled commands at the start of each sample.
    """
    return channel.sample == 0 or step % channel.sample == 0


def transmit(channel: Channel, step: int, nu: Entries, u: Array) -> None:
    """Replace the command u by the inputs that act in a step.

    The command is read only in steps in which the policy is evaluated (`is_asked`). nu contains the
    wheel speeds, at the indices `Wheels.row`.
    """
    count = len(channel.low)
    if is_asked(channel, step):
        limit(channel, u)
        if channel.sample > 0:
            first = (step // channel.sample) % channel.slots * count
            vec.copy(u, 0, channel.pending, first, count)
    # If commands are sampled, write the latest command that has arrived to u. For a pulsed
    # thruster, write the present thrust instead.
    if channel.sample > 0:
        any_fresh = False
        # Each delay belongs to `width` inputs, which are all inputs or a single one.
        delays = len(channel.delay)
        width = count // delays
        for lane in range(vec.lane_count(channel.delay)):
            for late in range(delays):
                since = step - int(vec.peek(channel.delay, late, lane))
                arrives = since >= 0 and since % channel.sample == 0
                if arrives:
                    first = (since // channel.sample) % channel.slots * count
                    for index in range(late * width, (late + 1) * width):
                        value = vec.peek(channel.pending, first + index, lane)
                        vec.poke(channel.held, index, lane, value)
                fresh = arrives or (since < 0 and step % channel.sample == 0)
                vec.poke(channel.fresh, late, lane, 1.0 if fresh else 0.0)
                any_fresh = any_fresh or fresh
        if any_fresh:
            _begin_pulses(channel, step, channel.held)
        vec.copy(channel.held, 0, u, 0, count)
        pulses = channel.pulses
        for index in range(len(pulses.at)):
            fraction = clipped(load(pulses.end, index) - float(step), 0.0, 1.0)
            store(u, pulses.at[index], fraction * load(pulses.level, index))
    # Reduce the torque of a wheel so far that the wheel does not exceed a speed limit in this step.
    # If the wheel already exceeds a speed limit, the torque is at most reduced to zero, and is not
    # reversed.
    wheels = channel.wheels
    for index in range(len(wheels.at)):
        least, most = load(wheels.least_torque, index), load(wheels.most_torque, index)
        speed, stiffness = load(nu, wheels.row[index]), load(wheels.stiffness, index)
        low = clipped(
            stiffness * (load(wheels.least_speed, index) - speed), least, most
        )
        high = clipped(
            stiffness * (load(wheels.most_speed, index) - speed), least, most
        )
        low, high = chosen(low, 0.0, low, 0.0), chosen(0.0, high, high, 0.0)
        at = wheels.at[index]
        store(u, at, clipped(load(u, at), low, high))


def _begin_pulses(channel, step, u):
    """Start the pulses of a new sample for the commands u, and store the impulse that remains.

    Lanes in which `fresh` is 0 do not change.
    """
    pulses = channel.pulses
    sample = channel.sample
    width = len(channel.low) // len(channel.delay)
    for index in range(len(pulses.at)):
        fresh = load(channel.fresh, pulses.at[index] // width)
        most, least = load(pulses.most, index), load(pulses.least, index)
        command = load(u, pulses.at[index])
        wanted = chosen(most, command, most, command) * pulses.time + load(
            pulses.left, index
        )
        mean = clipped(wanted / pulses.time, 0.0, most)
        fired = mean * pulses.time
        if pulses.on_off[index]:
            level = most + 0.0 * mean
            length = float(sample) * mean / most
        else:
            level = mean
            length = float(sample) + 0.0 * mean
        # With the tolerance 1e-9, a thruster also fires if only a rounding error makes the impulse
        # smaller than the least impulse.
        fires = chosen(0.0, fired, chosen(fired, (1.0 - 1e-9) * least, 0.0, 1.0), 0.0)
        left, end = wanted - fires * fired, float(step) + fires * length
        store(pulses.left, index, chosen(0.5, fresh, left, load(pulses.left, index)))
        store(pulses.end, index, chosen(0.5, fresh, end, load(pulses.end, index)))
        store(pulses.level, index, chosen(0.5, fresh, level, load(pulses.level, index)))


class Method(
    namedtuple(
        "Method",
        "h origin shift speed nodes weights moments rates along first second u",
    )
):
    """Integration method: steps of h [s] with s stages.

    - `rates` (1 + s, 6 + n): work space for nu at the start of the step, followed by d(nu)/dt at
      each stage.
    - `shift` (s + 1, 1 + s): the displacement after stage i is the sum of the rows of `rates` with
      the weights in row i of `shift`. After the last stage, q is displaced twice: first by row
      s - 1, then by row s.
    - `speed` (s, 1 + s): nu after stage i is the sum of the rows of `rates` with the weights in row
      i of `speed`.
    - `origin` (s,): one entry for the displacement after each stage. 0: the displacement starts at
      q of the first stage. 1: the displacement starts at q of the second stage.
    - `nodes` (s,) [s]: times of the stages, measured from the start of the step.
    - `weights` (s,) [s]: weights of the stages in a time integral over the step, times h. `moments`
      (s,) [s^2]: weights of the stages in a double time integral over the step, times h^2.
    - `along`: work space for a displacement. `first`, `second`: work space for q at the first and
      at the second stage.
    - `u` (nu,): inputs at the start of the latest step.
    """


class StopConditions(namedtuple("StopConditions", "squares sign")):
    """Stop conditions: limits of the velocity and of the attitude.

    - `squares`: squared limits of the entries of nu (6 + n,). In the Python engine, `squares`
      contains the squared limits of the entries of v (nv,).
    - `sign` (1,): the sign that q0 must keep, where q0 is the scalar part of the quaternion from
      the reference to the base. If the sign is 0, every attitude is allowed.
    """


class Arguments(
    namedtuple(
        "Arguments",
        "robot orbit method law channel reference project pushed stop point",
    )
):
    """Arguments of `advance`.

    `orbit` is used by the functions whose names end with `in_orbit` only. The reference then
    contains the Jacobi integral in place of the momentum.

    If `project` is true, `forward.impose` corrects the base's position and velocity at the end of
    each step. After the correction, momentum and centre of mass match the momentum reference. If
    `pushed` is true, external wrenches act on the robot, and `forward.add_wrench` adds the
    integrals of the wrenches to the momentum reference.
    """


_OF_METHOD = {REAL: "h", INDICES: "origin", LANED: "rates along first second u"}
METHOD, STOP_CONDITIONS = Struct(Method, REALS, _OF_METHOD), Struct(StopConditions)
ARGUMENTS = Struct(
    Arguments,
    FLAG,
    robot=MECHANICS,
    orbit=ORBIT,
    method=METHOD,
    law=LAW,
    channel=CHANNEL,
    reference=MOMENTUM_REFERENCE,
    stop=STOP_CONDITIONS,
    point=POINT,
)
ARGUMENTS_OF_ONE = ARGUMENTS.with_one_lane()


class ExtendedArguments(namedtuple("ExtendedArguments", "usual extension")):
    """Arguments of `advance_extended`: the arguments of `advance`, and the extension."""


EXTENDED = Struct(ExtendedArguments, usual=ARGUMENTS, extension=EXTENSION)
EXTENDED_OF_ONE = EXTENDED.with_one_lane()


def goes_on(stop: StopConditions, origin: Entries, q: Entries, rates: Entries) -> bool:
    """Return True if all velocities are below their limits and the attitude is allowed.

    `rates` are the velocities. In compiled code, both conditions must be met in all lanes.
    """
    vector, scalar = vec.get3(origin, 3), load(origin, 6)
    scalar = scalar * load(q, 6) - vec.dot(vector, vec.get3(q, 3))
    good = below(-(load(stop.sign, 0) * scalar), 1e-300)
    for index in range(len(stop.squares)):
        rate = load(rates, index)
        good = good and below(rate * rate, load(stop.squares, index))
    return good


def _move(robot, method, point, stage):
    """Move the point from a stage to the next stage, or from the last stage to the step's end.

    `method.rates` must contain the accelerations of all stages up to the stage `stage`.
    """
    rates, along = method.rates, method.along
    if stage == 1:
        vec.copy(point.q, 0, method.second, 0, len(point.q))
    vec.combine(method.shift, stage, rates, along)
    vec.combine(method.speed, stage, rates, point.nu)
    begin = method.first if method.origin[stage] == 0 else method.second
    vec.displace(robot.tree, begin, along, point.q)
    if stage == len(method.origin) - 1:
        vec.combine(method.shift, stage + 1, rates, along)
        vec.displace(robot.tree, point.q, along, point.q)


def _ask(work, robot, orbit, law, extension, channel, point, t, step, stage):
    """Write the command of the policy to `point.u`, and correct the memory of the policy."""
    count = step // max(channel.sample, 1)
    command(work, robot, orbit, law, extension, point, t, count, stage)
    allocate(law.allocation, orbit, point, law.u, t)
    if len(law.filter.E) > 0:
        limit(channel, point.u)
        write_difference(law.allocation, orbit, point, law.u)
        correct(law, count, stage)


def advance(words, clock, last, every, rows, work):
    """Advance eight runs; `words` are the 64-bit words of `ARGUMENTS`, see `_advance`."""
    _advance(ARGUMENTS(words), None, None, clock, last, every, rows, work)


def advance_one(words, clock, last, every, rows, work):
    """Advance one run; `words` are the words of `ARGUMENTS_OF_ONE`, see `_advance`.

    A single run would be slower in eight equal lanes.
    """
    arguments = ARGUMENTS_OF_ONE(words)
    _advance(arguments, None, None, clock, last, every, rows, work)


# Only robots in orbit use the next two functions, only robots with constraints, lags or flat plates
# the two functions after them, and only robots with both the last two functions. So other robots
# need no compilation of the code for orbits and for the extension.


def advance_in_orbit(words, clock, last, every, rows, work):
    """Advance eight runs of a robot in orbit; see `advance`."""
    arguments = ARGUMENTS(words)
    _advance(arguments, arguments.orbit, None, clock, last, every, rows, work)


def advance_one_in_orbit(words, clock, last, every, rows, work):
    """Advance one run of a robot in orbit; see `advance_one`."""
    arguments = ARGUMENTS_OF_ONE(words)
    _advance(arguments, arguments.orbit, None, clock, last, every, rows, work)


def advance_extended(words, clock, last, every, rows, work):
    """Advance eight runs with an extension; `words` are the words of `EXTENDED`, see `_advance`."""
    arguments = EXTENDED(words)
    usual, extension = arguments.usual, arguments.extension
    _advance(usual, None, extension, clock, last, every, rows, work)


def advance_one_extended(words, clock, last, every, rows, work):
    """Advance one run with an extension; `words` are the words of `EXTENDED_OF_ONE`."""
    arguments = EXTENDED_OF_ONE(words)
    usual, extension = arguments.usual, arguments.extension
    _advance(usual, None, extension, clock, last, every, rows, work)


def advance_extended_in_orbit(words, clock, last, every, rows, work):
    """Advance eight runs of a robot in orbit with an extension; see `advance_extended`."""
    arguments = EXTENDED(words)
    usual, extension = arguments.usual, arguments.extension
    _advance(usual, usual.orbit, extension, clock, last, every, rows, work)


def advance_one_extended_in_orbit(words, clock, last, every, rows, work):
    """Advance one run of a robot in orbit with an extension; see `advance_one_extended`."""
    arguments = EXTENDED_OF_ONE(words)
    usual, extension = arguments.usual, arguments.extension
    _advance(usual, usual.orbit, extension, clock, last, every, rows, work)


def _advance(arguments, orbit, extension, clock, last, every, rows, work):
    """Advance all runs to the step `last`, or until one of the runs meets a stop condition.

    The function updates the point, the momentum reference, the state of the policy and the state of
    the channel. clock (1,) is the number of finished steps. Before step 0, the initial momentum and
    centre of mass are written into the momentum reference.

    `orbit` is None without an orbit, and `extension` is None for a robot without constraints, lags
    and flat plates. The code for them is then not compiled.

    If `every` is not 0, the function writes a row into `rows` at every step that is a multiple of
    `every`. A row consists of q, nu, u, the reference momentum (6,), the reference centre of mass
    (3,), and the forces of the constraints. `work` has `WorkOffsets.size` entries.
    """
    robot = arguments.robot
    method = arguments.method
    law = arguments.law
    channel = arguments.channel
    kept = arguments.reference
    # `at` is the index of the next entry in `rows`
    point = arguments.point
    h = method.h
    at = 0
    forward.configure(work, robot, point.q)
    if clock[0] == 0:
        forward.start_at(work, robot, orbit, kept, point)
    for step in range(clock[0], last):
        recorded = every > 0 and step % every == 0
        vec.copy(point.q, 0, method.first, 0, len(point.q))
        vec.copy(point.nu, 0, method.rates, 0, len(point.nu))
        for stage in range(len(method.origin)):
            t = step * h + method.nodes[stage]
            if law.kind != NOTHING and (channel.sample == 0 or stage == 0):
                _command(work, arguments, orbit, extension, t, step, stage)
            _drive(robot, extension, method, point, step * h, stage)
            to = (1 + stage) * len(point.nu)
            forward.accelerate(
                work, robot, orbit, extension, point, t, method.rates, to
            )
            _observe(work, arguments, extension, step, stage)
            if extension is not None:
                _constrain(work, robot, extension.constraints, method, point, stage)
            if stage == 0:
                vec.copy(point.u, 0, method.u, 0, len(point.u))
                if recorded:
                    at = _record(kept, point, extension, step * h, rows, at)
            if arguments.pushed:
                weight, moment = method.weights[stage], method.moments[stage]
                forward.add_wrench(work, robot, orbit, kept, point, weight, moment)
            _move(robot, method, point, stage)
            if len(law.filter.rates) > len(law.filter.z):
                vec.combine(method.speed, stage, law.filter.rates, law.filter.z)
            forward.configure(work, robot, point.q)
        forward.end_step(kept, h)
        if extension is not None and len(extension.constraints.pair) > 0:
            held.close(work, robot, extension.constraints, point)
        if arguments.project:
            forward.impose(work, robot, kept, point, (step + 1) * h)
        clock[0] = step + 1
        if not _continues(arguments, extension):
            break


def _drive(robot, extension, method, point, t, stage):
    """Write the inputs that act at a stage, after lags and faults, to `point.pushing`.

    t [s] is the start of the step.
    """
    faults, h = robot.faults, method.h
    if extension is None:
        forward.apply_faults(faults, robot.triads, t, h, point.u, point.pushing)
    else:
        lag = extension.actuators
        lag_inputs(lag, method.speed, point.u, stage)
        forward.apply_faults(faults, robot.triads, t, h, lag.acting, point.pushing)
    forward.turn_held(robot, point)


def _observe(work, arguments, extension, step, stage):
    """Advance the sensors with a lag by a stage."""
    if extension is not None:
        law, point, speed = arguments.law, arguments.point, arguments.method.speed
        count = step // max(arguments.channel.sample, 1)
        lag = extension.sensors
        observe(work, arguments.robot, law, lag, speed, point, count, stage)


def _record(kept, point, extension, t, rows, at):
    """Write a row into `rows`, and return the index after it."""
    for values in (point.q, point.nu, point.u):
        vec.copy(values, 0, rows, at, len(values))
        at += len(values)
    momentum, center = forward.kept_at(kept, t)
    vec.put6(rows, at, momentum)
    vec.put3(rows, at + 6, center)
    at += 9
    if extension is not None:
        forces = extension.constraints.forces
        vec.copy(forces, 0, rows, at, len(forces))
        at += len(forces)
    return at


def _command(work, arguments, orbit, extension, t, step, stage):
    """Write the inputs that the actuator channel lets through at a stage to `point.u`."""
    channel, point = arguments.channel, arguments.point
    if is_asked(channel, step):
        robot, law = arguments.robot, arguments.law
        _ask(work, robot, orbit, law, extension, channel, point, t, step, stage)
    transmit(channel, step, point.nu, point.u)


def _constrain(work, robot, constraints, method, point, stage):
    """Correct the accelerations of a stage; keep the forces of the first stage."""
    if len(constraints.pair) == 0:
        return
    first = (1 + stage) * len(point.nu)
    held.constrain(work, robot, constraints, point, method.rates, first)
    if stage == 0:
        forces = constraints.multipliers
        vec.copy(forces, 0, constraints.forces, 0, len(forces))


def _continues(arguments, extension):
    """Return whether no run meets a stop condition at the end of a step."""
    robot, point = arguments.robot, arguments.point
    good = goes_on(arguments.stop, robot.origin, point.q, point.nu)
    if extension is not None and len(extension.constraints.pair) > 0:
        good = good and held.independent(extension.constraints)
    return good


class RunStatistics(
    namedtuple(
        "RunStatistics",
        "robot law path x_ref q_ref nu_ref kind settled tolerance steps at "
        "sizes largest_x largest_u largest outside errors inputs states",
    )
):
    """Statistics of the errors of eight runs, and the reference from which errors are measured.

    - `x_ref` (nx,): the reference state. `path.point.q` contains the attitude of the reference as
      a quaternion.
    - `q_ref`, `nu_ref`: q and nu of a moving reference, one row per step. Both are empty if the
      reference does not move.
    - `law`: the `Law` with which `read_state` computes states.
    - `kind` (nx,): the states are grouped into kinds; the joint positions, for example, are one
      kind. Each entry is the index of the kind of one state. The index 0 is for the attitude, and
      for states that count only in `largest_x`. The index -1 is for states that do not count.
    - `settled`, a number, and `tolerance` (kinds,): the bound for settling is `settled` times the
      largest error of the kind, or the kind's `tolerance` if `tolerance` is larger.
    - `steps` (times,): the steps at which values are recorded: the errors of the kinds in `errors`,
      the inputs in `inputs`, and the errors of the states in `states`.
    - `at`: work space for the point. All fields after `at` have one column per lane.
    - `sizes`: the present errors of the kinds. `largest`: the largest errors of the kinds so far.
    - `largest_x`, `largest_u`: the largest magnitudes of the states' errors and of the inputs.
    - `outside`: for each kind, the last step at which the error exceeded the bound for settling.
    """


_LANED = "sizes largest_x largest_u largest outside errors inputs states"
_OF_STATISTICS = {INDICES: "kind steps", REAL: "settled", LANED: _LANED}
RUN_STATISTICS = Struct(
    RunStatistics, REALS, _OF_STATISTICS, robot=MECHANICS, law=LAW, path=PATH, at=POINT
)


def _size(value):
    return chosen(value, 0.0, -value, value)


def _grow(stats, index, value):
    """Replace an entry of `stats` by `value` if `value` is larger."""
    store(stats, index, chosen(load(stats, index), value, value, load(stats, index)))


def _compare(stats, step):
    """Write the errors of the states and of the kinds at a step, and update `largest_x`.

    The error of a kind is the largest magnitude of the errors of its states. The error of kind 0 is
    the angle [deg] of the attitude error.
    """
    at, followed, sizes, e = stats.at, stats.path.point, stats.sizes, stats.path.e
    if len(stats.q_ref) > 0:
        vec.copy(stats.q_ref, step * len(followed.q), followed.q, 0, len(followed.q))
        vec.copy(
            stats.nu_ref, step * len(followed.nu), followed.nu, 0, len(followed.nu)
        )
        error(stats.robot, stats.path, at)
    else:
        read_state(stats.robot, stats.law, at, 0)
        for index in range(len(e)):
            store(e, index, load(stats.law.x, index) - load(stats.x_ref, index))
    vec.clear(sizes, 0, len(sizes))
    for index in range(len(e)):
        value = _size(load(e, index))
        kind = stats.kind[index]
        if kind >= 0:
            _grow(stats.largest_x, index, value)
        if kind > 0:
            _grow(sizes, kind, value)
    (x, y, z), w = vec.attitude(followed.q)
    vector, scalar = vec.quaternion_times(((-x, -y, -z), w), vec.attitude(at.q))
    half = angle(root(vec.dot(vector, vector)), _size(scalar))
    store(sizes, 0, half * (360.0 / np.pi))


def take(words, rows, first, count):
    """Update the statistics with rows of `advance`, one row for each of `count` steps.

    `first` is the index of the first step. `words` are the 64-bit words of `RunStatistics`.
    """
    stats = RUN_STATISTICS(words)
    at = stats.at
    sizes = stats.sizes
    kept = 0
    inputs = len(stats.largest_u)
    width = len(at.q) + len(at.nu)
    stride = len(rows) // max(count, 1)
    e = stats.path.e
    while kept < len(stats.steps) and stats.steps[kept] < first:
        kept += 1
    for row in range(count):
        step, begin = first + row, row * stride
        vec.copy(rows, begin, at.q, 0, len(at.q))
        vec.copy(rows, begin + len(at.q), at.nu, 0, len(at.nu))
        _compare(stats, step)
        for kind in range(len(sizes)):
            value = load(sizes, kind)
            _grow(stats.largest, kind, value)
            # The bound for settling is a fraction of the largest error so far, or the tolerance if
            # the tolerance is larger. So a new largest error above the tolerance exceeds the bound,
            # and the settling time starts anew.
            bound = stats.settled * load(stats.largest, kind)
            bound = chosen(bound, stats.tolerance[kind], stats.tolerance[kind], bound)
            store(
                stats.outside,
                kind,
                chosen(bound, value, float(step), load(stats.outside, kind)),
            )
        for index in range(inputs):
            _grow(stats.largest_u, index, _size(load(rows, begin + width + index)))
        if kept < len(stats.steps) and stats.steps[kept] == step:
            vec.copy(sizes, 0, stats.errors, kept * len(sizes), len(sizes))
            vec.copy(rows, begin + width, stats.inputs, kept * inputs, inputs)
            vec.copy(e, 0, stats.states, kept * len(e), len(e))
            kept += 1
    if count > 0:
        read_state(stats.robot, stats.law, at, 0)
