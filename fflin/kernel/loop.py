"""The closed loop: a policy, forward dynamics, steps on the manifold, and statistics of a run."""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from fflin.kernel import forward
from fflin.kernel import vectors as vec
from fflin.kernel.allocation import allocate
from fflin.kernel.arguments import FLAG, INDICES, LANED, REAL, REALS, Struct
from fflin.kernel.channel import CHANNEL, is_asked, transmit
from fflin.kernel.forward import MECHANICS, MOMENTUM_REFERENCE, POINT
from fflin.kernel.lanes import angle, below, chosen, compiled, load, root, store
from fflin.kernel.policies import LAW, NOTHING, PATH, command, error, read_state


class Method(namedtuple("Method", "h origin shift speed nodes weights moments")):
    """Integration method: steps of h [s] with s stages.

    - `shift`: rows with the weights of v and of the stages' accelerations in the displacement after
      each stage. The last row is a second displacement after the last stage.
    - `speed`: rows with the same weights for the velocity after each stage.
    - `origin`: for each displacement, 0 if it starts at the configuration of the first stage, or 1
      if it starts at the configuration of the second stage.
    - `nodes` [s]: times of the stages.
    - `weights`, `moments`: weights of the stages in an integral and in a double integral over the
      step, including h and h^2.
    """


class StopConditions(namedtuple("StopConditions", "squares sign")):
    """Stop conditions: squared bounds of the rates (6 + n,), and the sign (1,) of q0 in the chart.

    The sign is 0 if there is no chart. In the Python engine, rates are in the order of v (nv,).
    """


class Stages(namedtuple("Stages", "rates along first second u")):
    """Work space: v and the accelerations of the stages, a displacement, and q at two stages.

    `u` (nu,) are the inputs at the beginning of the last step.
    """


class Arguments(
    namedtuple("Arguments", "robot method law channel reference project pushed stop point stages")
):
    """Arguments of `advance`, with the switches for the projection and for external forces."""


ARGUMENTS = Struct(
    Arguments,
    robot=MECHANICS,
    method=Struct(Method, h=REAL, origin=INDICES),
    law=LAW,
    channel=CHANNEL,
    reference=MOMENTUM_REFERENCE,
    project=FLAG,
    pushed=FLAG,
    stop=Struct(StopConditions),
    point=POINT,
    stages=Struct(Stages, LANED),
)


def _combine(shares, row, rates, out):
    """Write a combination of v and the accelerations of the stages."""
    size = len(out)
    count = len(rates) // size
    for index in range(size):
        total = load(shares, row * count) * load(rates, index)
        for stage in range(1, count):
            part = load(rates, stage * size + index)
            total = total + load(shares, row * count + stage) * part
        store(out, index, total)


def goes_on(stop, origin, q, rates):
    """Return whether all rates are within finite bounds and the base is within the chart."""
    vector, scalar = vec.get3(origin, 3), load(origin, 6)
    scalar = scalar * load(q, 6) - vec.dot(vector, vec.get3(q, 3))
    good = below(-(load(stop.sign, 0) * scalar), 1e-300)
    for index in range(len(stop.squares)):
        rate = load(rates, index)
        good = good and below(rate * rate, load(stop.squares, index))
    return good


def _decide(work, channel, law, robot, point, step, stage, t):
    """Write the commanded inputs at a stage."""
    if is_asked(channel, step):
        command(work, robot, law, point, t, step // max(channel.sample, 1), stage)
        allocate(law.allocation, point, law.u)
    transmit(channel, step, point.nu, point.u)


def _move(robot, method, stages, point, stage):
    """Move the point from a stage with known acceleration to the next stage or the step's end."""
    rates, along = stages.rates, stages.along
    if stage == 1:
        vec.copy(point.q, 0, stages.second, 0, len(point.q))
    _combine(method.shift, stage, rates, along)
    _combine(method.speed, stage, rates, point.nu)
    begin = stages.first if method.origin[stage] == 0 else stages.second
    vec.displace(robot.tree, begin, along, point.q)
    if stage == len(method.origin) - 1:
        _combine(method.shift, stage + 1, rates, along)
        vec.displace(robot.tree, point.q, along, point.q)


@compiled
def advance(words, clock, last, every, rows, work):
    """Advance eight runs to the step `last`, or until a stop condition is met.

    `words` represent `Arguments`. The point, the momentum reference, and the memory of policy and
    channel are updated. clock (1,) is the number of finished steps. At the first step, the initial
    momentum and centre of mass are written into the momentum reference. If `every` is not 0, a row
    is written every `every` steps: q, nu, u, and the reference of momentum (6,) and centre of mass
    (3,). `work` has `Layout.size` entries.
    """
    of = ARGUMENTS(words)
    robot, method, law, channel, kept = of.robot, of.method, of.law, of.channel, of.reference
    point, stages = of.point, of.stages
    h, at = method.h, 0  # `at` is the place of the next entry in `rows`
    forward.configure(work, robot, point.q)
    if clock[0] == 0:
        forward.start_at(work, robot, kept, point)
    for step in range(clock[0], last):
        forward.begin_step(kept)
        vec.copy(point.q, 0, stages.first, 0, len(point.q))
        vec.copy(point.nu, 0, stages.rates, 0, len(point.nu))
        for stage in range(len(method.origin)):
            t = step * h + method.nodes[stage]
            if law.kind != NOTHING and (channel.sample == 0 or stage == 0):
                _decide(work, channel, law, robot, point, step, stage, t)
            forward.apply_faults(robot.faults, robot.triads, t, point.u, point.pushing)
            forward.turn_held(robot, point)
            if stage == 0:
                vec.copy(point.u, 0, stages.u, 0, len(point.u))
                if every > 0 and step % every == 0:
                    for values in (point.q, point.nu, point.u):
                        vec.copy(values, 0, rows, at, len(values))
                        at += len(values)
                    momentum, center = forward.kept_at(kept, step * h)
                    vec.put6(rows, at, momentum)
                    vec.put3(rows, at + 6, center)
                    at += 9
            forward.accelerate(work, robot, point, stages.rates, (1 + stage) * len(point.nu))
            if of.pushed:
                weight, moment = method.weights[stage], method.moments[stage]
                forward.add_wrench(work, robot, kept, point, weight, moment)
            _move(robot, method, stages, point, stage)
            if len(law.filter.rates) > len(law.filter.z):
                _combine(method.speed, stage, law.filter.rates, law.filter.z)
            forward.configure(work, robot, point.q)
        if of.pushed:
            forward.end_step(kept, h)
        if of.project:
            forward.impose(work, robot, kept, point, (step + 1) * h)
        clock[0] = step + 1
        if not goes_on(of.stop, robot.origin, point.q, point.nu):
            break


class RunStatistics(
    namedtuple(
        "RunStatistics",
        "robot law path x_ref q_ref nu_ref kind settled tolerance steps at "
        "sizes largest_x largest_u largest outside errors inputs states",
    )
):
    """Statistics of the errors of eight runs, and the reference of these errors.

    - `law` computes states.
    - Errors are relative to the state `x_ref` (nx,), whose attitude is in the point of `path`. With
      a moving reference, they are relative to the rows `q_ref` and `nu_ref`.
    - `kind` (nx,) is the kind of each state: 0 if it has none, -1 if its error is not recorded.
    - An error has settled when it stays below the fraction `settled` of its largest value, or below
      `tolerance` (kinds,).
    - At the `steps` (times,), the errors of kinds and states, and the inputs, are recorded.
    - `at` is work space. The fields after `at` are laned.
    """


RUN_STATISTICS = Struct(
    RunStatistics,
    REALS,
    {
        INDICES: "kind steps",
        LANED: "sizes largest_x largest_u largest outside errors inputs states",
    },
    robot=MECHANICS,
    law=LAW,
    path=PATH,
    settled=REAL,
    at=POINT,
)


def _size(value):
    return chosen(value, 0.0, -value, value)


def _grow(stats, index, value):
    """Replace an entry of the statistics by a value if the value is larger."""
    store(stats, index, chosen(load(stats, index), value, value, load(stats, index)))


def _compare(stats, step):
    """Write the errors at a step, and the largest magnitude of each kind."""
    at, there, sizes, e = stats.at, stats.path.point, stats.sizes, stats.path.e
    if len(stats.q_ref) > 0:
        vec.copy(stats.q_ref, step * len(there.q), there.q, 0, len(there.q))
        vec.copy(stats.nu_ref, step * len(there.nu), there.nu, 0, len(there.nu))
        error(stats.robot, stats.path, at)
    else:
        read_state(stats.robot, stats.law, at, 0)
        for index in range(len(e)):
            store(e, index, load(stats.law.x, index) - load(stats.x_ref, index))
    for kind in range(len(sizes)):
        store(sizes, kind, 0.0)
    for index in range(len(e)):
        value, kind = _size(load(e, index)), stats.kind[index]
        if kind >= 0:
            _grow(stats.largest_x, index, value)
        if kind > 0:
            _grow(sizes, kind, value)
    (x, y, z), w = vec.attitude(there.q)
    vector, scalar = vec.quaternion_times(((-x, -y, -z), w), vec.attitude(at.q))
    half = angle(root(vec.dot(vector, vector)), _size(scalar))
    store(sizes, 0, half * (360.0 / np.pi))


@compiled
def take(words, rows, first, count):
    """Update the statistics with `count` rows of `advance`; the first row is the step `first`.

    `words` represent `RunStatistics`.
    """
    stats = RUN_STATISTICS(words)
    at, sizes, kept = stats.at, stats.sizes, 0
    width, inputs, e = len(at.q) + len(at.nu), len(stats.largest_u), stats.path.e
    while kept < len(stats.steps) and stats.steps[kept] < first:
        kept += 1
    for row in range(count):
        step, begin = first + row, row * (width + inputs + 9)
        vec.copy(rows, begin, at.q, 0, len(at.q))
        vec.copy(rows, begin + len(at.q), at.nu, 0, len(at.nu))
        _compare(stats, step)
        for kind in range(len(sizes)):
            value = load(sizes, kind)
            _grow(stats.largest, kind, value)
            # A new maximum exceeds its own bound, so it resets the settling time.
            bound = stats.settled * load(stats.largest, kind)
            bound = chosen(bound, stats.tolerance[kind], stats.tolerance[kind], bound)
            store(stats.outside, kind, chosen(bound, value, float(step), load(stats.outside, kind)))
        for index in range(inputs):
            _grow(stats.largest_u, index, _size(load(rows, begin + width + index)))
        if kept < len(stats.steps) and stats.steps[kept] == step:
            vec.copy(sizes, 0, stats.errors, kept * len(sizes), len(sizes))
            vec.copy(rows, begin + width, stats.inputs, kept * inputs, inputs)
            vec.copy(e, 0, stats.states, kept * len(e), len(e))
            kept += 1
    if count > 0:
        read_state(stats.robot, stats.law, at, 0)
