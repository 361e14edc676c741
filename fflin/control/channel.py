"""Channel from command to actuator: sample and hold, delay, limits and thruster pulses."""

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, InputError, listed
from fflin.base.validation import DOUBLE, Array, as_double
from fflin.control.policy import BoundLaw
from fflin.kernel import loop as rules
from fflin.kernel.tree import empty
from fflin.robot.fields import input_limits
from fflin.robot.inputs import Range
from fflin.robot.robot import Robot
from fflin.robot.rotors import motor_of

Inputs: TypeAlias = Callable[..., Array]

# Function that corrects the memory of a law by the difference of limited and commanded inputs.
Correction: TypeAlias = Callable[[Array], None]


class Saturation(NamedTuple):
    """Input limits, wheel speed limits and thruster pulses, which change the commands."""

    low: Array  # (nu,)
    high: Array
    wheels: rules.Wheels = empty(rules.WHEELS)
    pulses: rules.Pulses = empty(rules.PULSES)

    @property
    def cuts(self) -> bool:
        """Whether a limit may change a continuous command.

        Pulses are ignored, because pulsed thrusters need sampled commands.
        """
        return bool(np.isfinite((self.low, self.high)).any() or len(self.wheels.at))


def saturation(
    robot: Robot,
    limits: Mapping[str, Range],
    q: Array,
    dt: float,
    sample: int,
    *,
    wheels: Iterable[str],
    pulsed: bool,
) -> Saturation:
    """Return the saturation at q, for integration steps of dt [s] and `sample` steps per sample.

    `sample` is 0 for continuous commands. `wheels` are the joints that are flown as reaction
    wheels; speed limits of other joints are not enforced. If `pulsed` is True, pulsed thrusters
    fire pulses. Otherwise, they follow their commands without pulses.
    """
    low, high = input_limits(robot, limits)
    within = Saturation(low, high)
    names = [name for _, group in robot.named_inputs for name in group]
    motors = {
        name: motor_of(names, name) for name in wheels if f"qdot_m.{name}" in limits
    }
    driven = {name: motor for name, motor in motors.items() if motor is not None}
    if driven:
        spun, at = [*driven], [*driven.values()]
        of_v = [robot.joint(name).idx_v for name in spun]
        mobility = pin.computeMinverse(robot.model, robot.create_data(), q).diagonal()[
            of_v
        ]
        least_speed, most_speed = np.array(
            [limits[f"qdot_m.{name}"] for name in spun]
        ).T
        limited = rules.Wheels(
            at=np.array(at),
            row=np.array([6 + robot.joint_names.index(name) for name in spun]),
            least_torque=low[at],
            most_torque=high[at],
            least_speed=least_speed,
            most_speed=most_speed,
            stiffness=1.0 / (mobility * dt),
        )
        within = within._replace(wheels=limited)
    if not (pulsed and (thrusters := robot.pulsed_thrusters)):
        return within
    at = list(thrusters)
    time = sample * dt
    on_off = np.array([item.on_off for _, item in thrusters.values()])
    least = np.array([item.least_impulse or 0.0 for _, item in thrusters.values()])
    most = np.maximum(high[at], np.finfo(float).tiny)  # a limit of zero
    if (short := least > most * time).any() or not time:
        name, item = thrusters[at[int(short.argmax())]]
        why = (
            "is pulsed, which needs sampled commands; give sample= (--sample), "
            "or a sampled policy"
        )
        if time:
            why = (
                f"has a least impulse of {item.least_impulse:g} N s, too large for a sample of "
                f"{time:g} s; give a longer sample="
            )
        raise InputError(f"thruster '{name}' {why}")
    pulses = within.pulses._replace(
        at=np.array(at),
        on_off=on_off,
        most=most,
        least=least,
        time=time,
    )
    return within._replace(pulses=pulses)


def warn_beyond(
    robot: str,
    where: str,
    units: Mapping[str, str],
    asked: Array,
    low: Array,
    high: Array,
) -> None:
    """Warn about inputs whose commands `asked` (N, nu) are not between `low` and `high` (nu,).

    `units` maps the name of each input to its unit.
    """
    bounds = np.where(asked > 0.0, high, low)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.nan_to_num(np.abs(asked / bounds), posinf=np.inf)
    worst = ratio.argmax(axis=0)
    exceeded = ratio.max(axis=0) > 1.0 + 1e-6
    if not exceeded.any():
        return
    beyond = [
        f"{name} requires {asked[row, k]:.3g} {unit}, its limit is {bounds[row, k]:g}"
        for k, ((name, unit), row) in enumerate(zip(units.items(), worst, strict=True))
        if exceeded[k]
    ]
    message = f"the input limits are too small for '{robot}' {where}: {listed(beyond)}"
    warnings.warn(message, FflinWarning, stacklevel=3)


@dataclass(frozen=True, eq=False)
class Law:
    """Function that calls a policy with copies of q and v, and checks its command (nu,)."""

    policy: Callable[[float, Array, Array], object]
    names: tuple[str, ...]
    limits: tuple[Array, Array]
    # If the squared norm of v is at least this, the motion counts as diverging. In a diverging
    # motion, a command that is not finite raises no error.
    slow: float

    @property
    def correct(self) -> Correction | None:
        """Function that corrects the memory of the policy, or None; see `BoundLaw`."""
        if isinstance(self.policy, BoundLaw):
            return self.policy.correct
        return None

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        """Return the command (nu,), or raise `InputError` if its shape or a value is invalid."""
        u = self.policy(t, q.copy(), v.copy())
        is_double = type(u) is np.ndarray and u.dtype is DOUBLE
        u = (
            np.array(u)
            if is_double
            else as_double(f"policy(t, q, v) at t = {t:g} s", u)
        )
        names = self.names
        shape = (len(self.names),)
        if u.shape == shape and math.isfinite(u.dot(u)):
            return u
        if u.shape != shape:
            raise InputError(
                f"policy(t, q, v) returned shape {u.shape} at t = {t:g} s, expected {shape} with "
                f"one value for each of {listed(names)}"
            )
        wrong = np.flatnonzero(~np.isfinite(np.clip(u, *self.limits)))
        if len(wrong) and float(v.dot(v)) < self.slow:
            raise InputError(
                f"policy(t, q, v) returned {u[wrong[0]]} for {names[wrong[0]]} at t = {t:g} s, "
                "expected finite numbers"
            )
        return u


def channel_of(
    limits: Saturation, initial: Array, sample: int, delays: Sequence[int]
) -> rules.Channel:
    """Return the kernel's channel for limits, a sample time [steps] and delays [steps].

    There is one delay for all inputs, or one for each input.
    Until the first command arrives, the channel applies the inputs `initial` (nu,), saturated at
    their limits.
    """
    slots = 1
    if sample:
        slots = max(delays) // sample + 1
    fresh = {key: np.zeros(len(limits.pulses.at)) for key in ("left", "level", "end")}
    channel = rules.Channel(
        **limits._replace(pulses=limits.pulses._replace(**fresh))._asdict(),
        held=initial.copy(),
        pending=np.zeros(slots * len(initial)),
        slots=slots,
        sample=sample,
        delay=np.array(delays, dtype=float),
        fresh=np.zeros(len(delays)),
    )
    rules.limit(channel, channel.held)
    return channel


def channelled(
    law: Inputs,
    speeds: Inputs,
    limits: Saturation,
    initial: Array,
    sample: int,
    delays: Sequence[int],
    correct: Correction | None = None,
) -> Inputs:
    """Return f(step, *point), which sends a command through a channel and returns inputs (nu,).

    f calls ``law(*point)`` for the command, and ``speeds(*point)`` for the speeds (k,) of the
    wheels whose speed is limited. After each command, f calls `correct` with the change of the
    command by the input limits.
    """
    wheels, u = len(limits.wheels.at), initial.copy()
    if not (sample or limits.cuts or correct):
        return lambda _, *point: law(*point)
    within = limits._replace(wheels=limits.wheels._replace(row=np.arange(wheels)))
    channel = channel_of(within, initial, sample, delays)

    def applied(step: int, *point: object) -> Array:
        if rules.is_asked(channel, step):
            u[:] = command = law(*point)
            if correct:
                rules.limit(channel, u)
                correct(u - command)
        wheel_speeds = speeds(*point) if wheels else u[:0]
        rules.transmit(channel, step, wheel_speeds, u)
        return u.copy()

    return applied
