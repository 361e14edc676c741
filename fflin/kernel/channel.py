"""How a command reaches the robot in the loop, as `control.channel` has it for one in Python."""

from __future__ import annotations

from collections import namedtuple

from fflin.kernel.arguments import FLAGS, INDICES, LANED, REAL, WHOLE, Struct
from fflin.kernel.lanes import chosen, inlined, load, peek, poke, store, whole, width
from fflin.kernel.vectors import copy


class Wheels(
    namedtuple("Wheels", "at row least_torque most_torque least_speed most_speed stiffness")
):
    """Wheels with largest speeds (k,): their inputs, coordinates, torques, speeds, and J / dt."""


class Pulses(namedtuple("Pulses", "at on_off most least quantum left level end time")):
    """Thrusters that fire in pulses (k,), and what is left of their commands, see `Pulses`.

    `level` acts until the step `end`; `time` is that of a sample.
    """


class Channel(
    namedtuple("Channel", "low high held pending slots sample delay fresh wheels pulses")
):
    """Limits (nu,) of commands, and those on their way: `pending` has (slots, nu) of samples.

    `delay` (1,) is in steps; `fresh` (1,) says whether a command begins to act.
    """


WHEELS = Struct(Wheels, at=INDICES, row=INDICES)
PULSES = Struct(
    Pulses,
    at=INDICES,
    on_off=FLAGS,
    time=REAL,
    **dict.fromkeys(("left", "level", "end"), LANED),
)
CHANNEL = Struct(
    Channel,
    wheels=WHEELS,
    pulses=PULSES,
    **dict.fromkeys(("slots", "sample"), WHOLE),
    **dict.fromkeys(("held", "pending", "delay", "fresh"), LANED),
)


@inlined
def clipped(value, low, high):
    """Return a number within limits; what is no number stays none."""
    value = chosen(value, low, low, value)
    return chosen(high, value, high, value)


@inlined
def limit(channel, u):
    """Cut inputs to their limits."""
    for index in range(len(channel.low)):
        value = clipped(load(u, index), load(channel.low, index), load(channel.high, index))
        store(u, index, value)


@inlined
def send(channel, step, u):
    """Put the command of a sample on its way."""
    count = len(channel.low)
    copy(u, 0, channel.pending, (step // channel.sample) % channel.slots * count, count)


@inlined
def arrive(channel, step, u):
    """Write what acts in a step of what has arrived."""
    count, any_fresh = len(channel.low), False
    for lane in range(width(channel.delay)):
        since = step - int(peek(channel.delay, 0, lane))
        arrives = since >= 0 and since % channel.sample == 0
        if arrives:
            first = (since // channel.sample) % channel.slots * count
            for index in range(count):
                value = peek(channel.pending, first + index, lane)
                poke(channel.held, index, lane, value)
        fresh = arrives or (since < 0 and step % channel.sample == 0)
        poke(channel.fresh, 0, lane, 1.0 if fresh else 0.0)
        any_fresh = any_fresh or fresh
    if any_fresh:
        _begin_pulses(channel, step, channel.held)
    copy(channel.held, 0, u, 0, count)
    pulses = channel.pulses
    for index in range(len(pulses.at)):
        level = chosen(float(step), load(pulses.end, index), load(pulses.level, index), 0.0)
        store(u, pulses.at[index], level)


@inlined
def _begin_pulses(channel, step, u):
    """Take the command of a sample, and carry on what is not fired of it."""
    pulses, sample, fresh = channel.pulses, channel.sample, load(channel.fresh, 0)
    for index in range(len(pulses.at)):
        most, least = load(pulses.most, index), load(pulses.least, index)
        command = load(u, pulses.at[index])
        wanted = chosen(most, command, most, command) * pulses.time + load(pulses.left, index)
        if pulses.on_off[index]:
            quantum = load(pulses.quantum, index)
            length = clipped(whole(wanted / quantum), 0.0, float(sample))
            level, fired = most + 0.0 * wanted, length * quantum
        else:
            level = clipped(wanted / pulses.time, 0.0, most)
            length, fired = float(sample) + 0.0 * wanted, level * pulses.time
        # An impulse that misses the least one by rounding is the least one.
        fires = chosen(0.0, fired, chosen(fired, (1.0 - 1e-9) * least, 0.0, 1.0), 0.0)
        left, end = wanted - fires * fired, float(step) + fires * length
        store(pulses.left, index, chosen(0.5, fresh, left, load(pulses.left, index)))
        store(pulses.end, index, chosen(0.5, fresh, end, load(pulses.end, index)))
        store(pulses.level, index, chosen(0.5, fresh, level, load(pulses.level, index)))


@inlined
def spare_wheels(channel, nu, u):
    """Cut what would take a wheel beyond its speed within a step; it drives nothing of itself."""
    wheels = channel.wheels
    for index in range(len(wheels.at)):
        least, most = load(wheels.least_torque, index), load(wheels.most_torque, index)
        speed, stiffness = load(nu, wheels.row[index]), load(wheels.stiffness, index)
        low = clipped(stiffness * (load(wheels.least_speed, index) - speed), least, most)
        high = clipped(stiffness * (load(wheels.most_speed, index) - speed), least, most)
        low, high = chosen(low, 0.0, low, 0.0), chosen(0.0, high, high, 0.0)
        at = wheels.at[index]
        store(u, at, clipped(load(u, at), low, high))
