"""The closed loop, step after step: a policy, forward dynamics, and steps on the manifold."""

from __future__ import annotations

from collections import namedtuple

from fflin.kernel.allocation import allocate
from fflin.kernel.arguments import FLAG, INDICES, LANED, REAL, Opener, Struct
from fflin.kernel.channel import CHANNEL, is_asked, transmit
from fflin.kernel.conservation import (
    MOMENTUM_REFERENCE,
    add_wrench,
    begin_step,
    end_step,
    impose,
    kept_at,
    start_at,
)
from fflin.kernel.displacements import attitude, displace, quaternion_times, turn_back
from fflin.kernel.forward import (
    MECHANICS,
    POINT,
    accelerate,
    apply_faults,
    configure,
    turn_held,
)
from fflin.kernel.lanes import below, called, compiled, inlined, listed, load, store
from fflin.kernel.policies import LAW, NOTHING, command
from fflin.kernel.vectors import copy, put3, put6


class Method(namedtuple("Method", "h origin shift speed nodes weights moments tangent")):
    """Steps of h [s], s stages each, by what its displacements and velocities are made of.

    Row by row: shares of v and the stages' accelerations in the displacement after each stage, and
    the second one after the last (`shift`), and in the velocity there (`speed`). A displacement
    begins at the configuration of the first stage, or of the second stage if `origin` is 1. `nodes`
    [s] are the stages' times, `weights` and `moments` their shares in sums along, with h and h^2.
    With `tangent` it is a share of the rate in the tangent at the first configuration, and the last
    is the sum of all by `weights`.
    """


class StopConditions(namedtuple("StopConditions", "squares sign")):
    """Stop condition: squared rate bounds (6 + n,), and the sign (1,) of q0 in the chart.

    The sign is 0 if there is no chart. The engine in Python has the rates in the order of v (nv,).
    """


class Stages(namedtuple("Stages", "rates along total first second u")):
    """Work space: v and the accelerations of the stages, displacements, and two stages' q.

    `u` (nu,) is what acted as the last step began.
    """


class Arguments(
    namedtuple("Arguments", "robot method law channel reference project pushed stop point stages")
):
    """Arguments of `advance`, with the switches for the projection and for external forces."""


ARGUMENTS = Struct(
    Arguments,
    robot=MECHANICS,
    method=Struct(Method, h=REAL, origin=INDICES, tangent=FLAG),
    law=LAW,
    channel=CHANNEL,
    reference=MOMENTUM_REFERENCE,
    project=FLAG,
    pushed=FLAG,
    stop=Struct(StopConditions),
    point=POINT,
    stages=Struct(Stages, LANED),
)
_opened = Opener(ARGUMENTS)


@inlined
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


@inlined
def _record(rows, row, point, reference, t):
    """Write a row: q, nu, u, and momentum and centre of mass as they are to be."""
    at = row * (len(point.q) + len(point.nu) + len(point.u) + 9)
    for values in (point.q, point.nu, point.u):
        copy(values, 0, rows, at, len(values))
        at += len(values)
    momentum, center = kept_at(reference, t)
    put6(rows, at, momentum)
    put3(rows, at + 6, center)


@inlined
def goes_on(stop, origin, q, rates):
    """Whether all rates are finite and within bounds, and the base is in the chart of an origin."""
    scalar = quaternion_times(attitude(origin), attitude(q))[1]
    good = below(-(load(stop.sign, 0) * scalar), 1e-300)
    for index in range(len(stop.squares)):
        rate = load(rates, index)
        good = good and below(rate * rate, load(stop.squares, index))
    return good


@inlined
def _act(work, channel, law, robot, point, step, stage, t):
    """Write the inputs at a stage, as they are commanded and in base axes."""
    if law.kind != NOTHING and (channel.sample == 0 or stage == 0):
        if is_asked(channel, step):
            command(work, robot, law, point, t, step // max(channel.sample, 1), stage)
            allocate(law.allocation, point, law.u)
        transmit(channel, step, point.nu, point.u)
    apply_faults(robot.faults, robot.triads, t, point.u, point.pushing)
    turn_held(robot, point)


@called
def _turn_shift(method, stages, nu, stage, last):
    """Write the displacement in the tangent after a stage, from the one of the stage before."""
    along, total = stages.along, stages.total
    for index in range(len(along)):
        if stage == 0:
            store(along, index, 0.0)
            store(total, index, 0.0)
    turn_back(along, nu)
    for index in range(len(along)):
        rate = load(along, index)
        store(total, index, load(total, index) + method.weights[stage] * rate)
        store(along, index, load(total, index) if last else load(method.shift, stage) * rate)


@inlined
def _move(robot, method, stages, point, stage):
    """Go from a stage, whose acceleration is there, to the next one, or to the end of the step."""
    rates, along = stages.rates, stages.along
    if stage == 1:
        copy(point.q, 0, stages.second, 0, len(point.q))
    last = stage == len(method.origin) - 1
    if method.tangent:
        _turn_shift(method, stages, point.nu, stage, last)
    else:
        _combine(method.shift, stage, rates, along)
    _combine(method.speed, stage, rates, point.nu)
    begin = stages.first if method.origin[stage] == 0 else stages.second
    displace(robot.tree, begin, along, point.q)
    if last and not method.tangent:
        _combine(method.shift, stage + 1, rates, along)
        displace(robot.tree, point.q, along, point.q)


@listed
def go_on(of, clock, last, every, rows, work):
    """Do as `advance`, of arguments that are opened."""
    robot, method, law, channel, kept = of.robot, of.method, of.law, of.channel, of.reference
    point, stages = of.point, of.stages
    h, row = method.h, 0
    configure(work, robot, point.q)
    if clock[0] == 0:
        start_at(work, robot, kept, point)
    for step in range(clock[0], last):
        begin_step(kept)
        copy(point.q, 0, stages.first, 0, len(point.q))
        copy(point.nu, 0, stages.rates, 0, len(point.nu))
        for stage in range(len(method.origin)):
            t = step * h + method.nodes[stage]
            _act(work, channel, law, robot, point, step, stage, t)
            if stage == 0:
                copy(point.u, 0, stages.u, 0, len(point.u))
                if every > 0 and step % every == 0:
                    _record(rows, row, point, kept, step * h)
                    row += 1
            accelerate(work, robot, point, stages.rates, (1 + stage) * len(point.nu))
            if of.pushed:
                weight, moment = method.weights[stage], method.moments[stage]
                add_wrench(work, robot, kept, point, weight, moment)
            _move(robot, method, stages, point, stage)
            if len(law.filter.rates) > len(law.filter.z):
                _combine(method.speed, stage, law.filter.rates, law.filter.z)
            configure(work, robot, point.q)
        if of.pushed:
            end_step(kept, h)
        if of.project:
            impose(work, robot, kept, point, (step + 1) * h)
        clock[0] = step + 1
        if not goes_on(of.stop, robot.origin, point.q, point.nu):
            break


@compiled
def advance(words, clock, last, every, rows, work):
    """Advance eight runs up to a step, or to a step that meets a stop condition.

    `words` are of `Arguments`. The point, the momentum reference and the memory of policy and
    channel are updated; clock (1,) is the number of steps done of `last`. At the first step the
    momentum and the centre of mass of the start are written into the momentum reference. Every
    `every` steps, if that is not 0, a row gets q, nu, u, and the momentum (6,) and centre of mass
    (3,) of the reference. `work` has `Layout.size` entries.
    """
    go_on(_opened(words), clock, last, every, rows, work)
