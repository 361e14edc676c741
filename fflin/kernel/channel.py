"""Actuator channel: limits, sample and hold, delay, pulses and wheel speeds.

The Python engine and the compiled engine both call these functions; see `control.channel`.
"""

from __future__ import annotations

from collections import namedtuple

from fflin.kernel import vectors as vec
from fflin.kernel.arguments import FLAGS, INDICES, LANED, REAL, REALS, WHOLE, Struct
from fflin.kernel.lanes import chosen, load, peek, poke, store, whole, width


class Wheels(
    namedtuple("Wheels", "at row least_torque most_torque least_speed most_speed stiffness")
):
    r"""Wheels (k,) with speed limits: :math:`u \le J (w_{max} - w) / dt`.

    Fields of each wheel: the index of its input (`at`), the index of its speed in nu (`row`), the
    limits of its torque [N m] and speed [rad/s], and the stiffness J / dt. Within a step of dt, a
    torque u changes the speed w by u dt / J. J is the effective inertia between the wheel and the
    rest of the free robot. The torque limits of the motor apply as well.
    """


class Pulses(namedtuple("Pulses", "at on_off most least quantum left level end time")):
    """Pulsed thrusters (k,) that realise the command of each sample by an impulse.

    Fields of each thruster: the index of its input (`at`), whether it is on-off, its largest thrust
    [N], its least impulse [N s] and the impulse of one step (`quantum`). The commanded impulse that
    was not fired is `left` for the next sample. The thrust `level` acts until the step `end`.
    `time` [s] is the sample time.
    """


class Channel(
    namedtuple("Channel", "low high held pending slots sample delay fresh wheels pulses")
):
    """Limits (nu,) of commands, and the delayed commands `pending` (slots, nu), one per sample.

    `delay` (1,) is in steps. `fresh` (1,) is 1 if a command begins to act in this step, else 0.
    """


WHEELS = Struct(Wheels, at=INDICES, row=INDICES)
PULSES = Struct(Pulses, REALS, {LANED: "left level end"}, at=INDICES, on_off=FLAGS, time=REAL)
_OF_CHANNEL = {WHOLE: "slots sample", LANED: "held pending delay fresh"}
CHANNEL = Struct(Channel, REALS, _OF_CHANNEL, wheels=WHEELS, pulses=PULSES)


def clipped(value, low, high):
    """Return a number clipped to limits; NaN remains NaN."""
    value = chosen(value, low, low, value)
    return chosen(high, value, high, value)


def limit(channel, u):
    """Saturate inputs at their limits."""
    for index in range(len(channel.low)):
        value = clipped(load(u, index), load(channel.low, index), load(channel.high, index))
        store(u, index, value)


def is_asked(channel, step):
    """Return whether the policy is evaluated at the start of a step."""
    return channel.sample == 0 or step % channel.sample == 0


def transmit(channel, step, nu, u):
    """Replace the command u by the inputs that act in this step.

    u is a new command only in steps in which the policy is evaluated (`is_asked`).
    """
    count = len(channel.low)
    if is_asked(channel, step):
        limit(channel, u)
        if channel.sample > 0:
            first = (step // channel.sample) % channel.slots * count
            vec.copy(u, 0, channel.pending, first, count)
    # Write the latest command that has arrived after the delay, or its pulses.
    if channel.sample > 0:
        any_fresh = False
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
        vec.copy(channel.held, 0, u, 0, count)
        pulses = channel.pulses
        for index in range(len(pulses.at)):
            level = chosen(float(step), load(pulses.end, index), load(pulses.level, index), 0.0)
            store(u, pulses.at[index], level)
    # Reduce torques that would make a wheel exceed its speed limit in a step, at most to zero.
    wheels = channel.wheels
    for index in range(len(wheels.at)):
        least, most = load(wheels.least_torque, index), load(wheels.most_torque, index)
        speed, stiffness = load(nu, wheels.row[index]), load(wheels.stiffness, index)
        low = clipped(stiffness * (load(wheels.least_speed, index) - speed), least, most)
        high = clipped(stiffness * (load(wheels.most_speed, index) - speed), least, most)
        low, high = chosen(low, 0.0, low, 0.0), chosen(0.0, high, high, 0.0)
        at = wheels.at[index]
        store(u, at, clipped(load(u, at), low, high))


def _begin_pulses(channel, step, u):
    """Fire the pulse of a sample, and leave the remaining impulse to the next sample."""
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
        # An impulse that only rounding errors put below the least impulse is fired.
        fires = chosen(0.0, fired, chosen(fired, (1.0 - 1e-9) * least, 0.0, 1.0), 0.0)
        left, end = wanted - fires * fired, float(step) + fires * length
        store(pulses.left, index, chosen(0.5, fresh, left, load(pulses.left, index)))
        store(pulses.end, index, chosen(0.5, fresh, end, load(pulses.end, index)))
        store(pulses.level, index, chosen(0.5, fresh, level, load(pulses.level, index)))
