"""The time step of a simulation, chosen from the poles of the robot and of the closed loop.

In a step of h [s], an integrator multiplies the amplitude of a mode with the pole lambda by |R|,
with R = R(lambda h). The exact factor is exp(Re lambda h). A step is short enough for a mode if it
changes the damping of the mode by at most 5 %, or the amplitude over the run by at most 1 %:

    |ln|R| - Re(lambda) h| <= max(0.05 |Re(lambda)| h, 0.01 h / T)                          (11.4)

T is the duration of the run. The step must be short enough for all modes of the robot with constant
inputs, and for all modes of the closed loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
import pinocchio as pin

from fflin.base.errors import ChartError
from fflin.base.names import group_of
from fflin.base.validation import Array, Values
from fflin.control.channel import Law
from fflin.control.policy import BoundLaw, Command, Policy
from fflin.control.sensors import lags_of_robot
from fflin.dynamics.delays import HeldSystem, Hold
from fflin.dynamics.integrators import Integrator
from fflin.linear.linearization import Linearizer
from fflin.linear.model import LinearModel
from fflin.robot.outputs import FullState
from fflin.simulation.plant import ROUNDED_DOWN, ROUNDED_UP, Plant

# Names in messages: the robot with constant inputs, a loop that is constant during the run, and a
# rotation, which acts like an undamped oscillation.
ROBOT = "robot"
CLOSED_LOOP = "closed loop"
ROTATION = "rotation of the base or of a joint"
LAG = "lag of the inputs and outputs"
LONGEST_STEP = 0.01  # [s] default time step, if no pole requires a shorter step
# [s] default time step for magnetorquers and periodic laws, which act slowly
SLOW_STEP = 1.0
_DAMPING, _AMPLITUDE = 0.05, 0.01  # tolerances in (11.4)
_SHORTEST_STEP = 1e-12  # [s] at which the search for a step ends

# A pole of a sampled loop below this magnitude decays within two samples. The step hardly matters
# to such a pole, and its logarithm has large rounding errors.
_VANISHING = 0.1

# Participations in a mode count as equal up to this relative difference.
_SAME = 1e-6

# Displacements of the state from which the derivatives of a policy are estimated. If both
# displacements give the same derivatives up to the relative difference _SMOOTH, the policy is
# differentiable.
_DISPLACEMENTS = (1e-6, 1e-5)
_SMOOTH = 0.05
_STEEPEST = 1e100  # largest derivative of a policy [SI units] that counts as finite

# A step resolves a function of time if a parabola through its values at the start, the middle and
# the end of the step is accurate to _PARABOLA times the largest value. This is compared at the
# fractions _BETWEEN of the step, in _WINDOWS steps of the run. _TRIALS is the largest number of
# steps that are tried. A function that jumps within a step is never resolved; it may jump at
# multiples of the step.
_PARABOLA = 0.02
_BETWEEN = (0.2, 0.35, 0.7, 0.85)
_WINDOWS = 16
_TRIALS = 8


class Demand(NamedTuple):
    """Step error of one mode: the ratio of the left to the right side of (11.4), and the mode."""

    error: float
    mode: Callable[[], str]


class Limit(Protocol):
    """Something that limits the step, such as the poles of the robot."""

    def demand(self, method: type[Integrator], h: float, duration: float) -> Demand:
        """Return the largest step error (11.4) of a step of h [s]."""
        ...


def step_error(exact: Array, simulated: Array, h: float, duration: float) -> Array:
    """Return the ratio of the left to the right side of (11.4), for each mode.

    `exact` and `simulated` are the logarithms of the exact and of the simulated factor by which the
    amplitude changes in h [s].
    """
    tolerance = np.maximum(_DAMPING * np.abs(exact), _AMPLITUDE * h / duration)
    error: Array = np.abs(simulated - exact) / tolerance
    return np.nan_to_num(error, nan=np.inf)


@dataclass(frozen=True, eq=False)
class Poles:
    """Poles [1/s] of the robot or of a continuous closed loop.

    `system` is the name of the system in messages. `A` is the matrix whose eigenvalues are the
    poles, and `state_names` are the names of its states. If A is not known, the names are empty.
    """

    system: str
    poles: Values
    A: Array | None = None
    state_names: tuple[str, ...] = ()

    @classmethod
    def of(cls, system: str, A: Array, state_names: tuple[str, ...]) -> Poles:
        """Return the poles of a matrix A (n, n)."""
        return cls(system, np.linalg.eigvals(A), A, state_names)

    def demand(self, method: type[Integrator], h: float, duration: float) -> Demand:
        """Return the largest step error; see `Limit`."""
        if not len(self.poles):
            return Demand(0.0, str)
        z = self.poles * h
        errors = step_error(z.real, method.growth(z), h, duration)
        worst = int(errors.argmax())
        return Demand(float(errors[worst]), lambda: self.mode(worst))

    @property
    def fastest(self) -> float:
        """Largest magnitude [1/s] of the poles."""
        return float(np.abs(self.poles).max(initial=0.0))

    @property
    def fastest_mode(self) -> str:
        """Text that names the mode of the fastest pole."""
        return self.mode(int(np.abs(self.poles).argmax()))

    def mode(self, index: int) -> str:
        """Return a text that names the mode of a pole, such as its frequency and its main state."""
        pole = complex(self.poles[index])
        size = abs(pole)
        if not size:
            return f"the {self.system}"
        if self.system == ROTATION:
            return f"the {ROTATION} at {size:.3g} rad/s"
        state = self._main_state(pole)
        if group_of(state) in ("q_b", "r_b") and self.system == ROBOT:
            return f"the rotation of the base at {size:.3g} rad/s"
        text = f"the pole at {pole.real:.3g} 1/s of the {self.system}"
        details = list[str]()
        if abs(pole.imag) > 1e-6 * size:
            text = f"the mode at {size / (2.0 * math.pi):.3g} Hz of the {self.system}"
            details.append(f"damping ratio {-pole.real / size:.2g}")
        if state:
            details.append(f"mainly {state}")
        if details:
            text += f" ({', '.join(details)})"
        return text

    def _main_state(self, pole: complex) -> str:
        """Return the name of the state with the largest participation in the mode of a pole."""
        if self.A is None:
            return ""
        # The two calls of `eig` may return the poles in different orders.
        right_poles, right_vectors = np.linalg.eig(self.A)
        left_poles, left_vectors = np.linalg.eig(self.A.T)
        right = right_vectors[:, np.abs(right_poles - pole).argmin()]
        left = left_vectors[:, np.abs(left_poles - pole).argmin()]
        participation = np.abs(left * right)
        # A loop may have further states without names, such as the states of its controller.
        named = participation[: len(self.state_names)]
        # Coordinate and rate of an oscillating mode have the same participation. Rounding must not
        # decide between them.
        largest = np.flatnonzero(named >= (1.0 - _SAME) * named.max())
        return self.state_names[int(largest[0])]


def rotation(rate: float) -> Poles:
    """Return the pole of a rotation at `rate` [rad/s], which acts like an undamped oscillation."""
    return Poles(ROTATION, np.array([1j * rate]))


@dataclass(frozen=True, eq=False)
class SampledLoop:
    """Sampled linear loop: its poles with the exact plant, and with the plant as it is integrated.

    `lin` is the sampled model, and `generator` the continuous-time model from which it was
    sampled. `loop` returns the matrix of the closed loop about a sampled model.
    """

    lin: LinearModel
    generator: LinearModel
    loop: Callable[[LinearModel], Array]

    def demand(self, method: type[Integrator], h: float, duration: float) -> Demand:
        """Return the largest step error; see `Limit`. The amplitudes are compared per sample.

        Only methods that define `Integrator.held` are compared. For other methods, only the poles
        of the robot limit the step.
        """
        dt = self.lin.dt
        A, B = self.generator.A, self.generator.B
        with np.errstate(over="ignore", invalid="ignore"):
            if method.held(A, B, h) is None:
                return Demand(0.0, str)
        exact_loop = self.loop(self.lin)
        if not np.abs(exact_loop).max(initial=0.0) < _STEEPEST:  # the run stops at once
            return Demand(0.0, str)
        with np.errstate(over="ignore", invalid="ignore"):
            integrated = self.loop(self._integrated(partial(_in_steps, method, h)))
        if not np.isfinite(integrated).all():
            return Demand(math.inf, lambda: "the sampled loop")
        exact, simulated = _matched(
            np.linalg.eigvals(exact_loop), np.linalg.eigvals(integrated)
        )
        lasts = np.abs(exact) > _VANISHING
        if not lasts.any():
            return Demand(0.0, str)
        poles = np.log(exact[lasts].astype(complex)) / dt
        growth: Array = np.log(np.maximum(np.abs(simulated[lasts]), 1e-300))
        errors = step_error(poles.real * dt, growth, dt, duration)
        worst = int(errors.argmax())
        return Demand(
            float(errors[worst]), lambda: Poles("sampled loop", poles).mode(worst)
        )

    def _integrated(self, hold: Hold) -> LinearModel:
        """Return the sampled model of the plant as it is integrated.

        `hold` returns the matrices of the integrated motion under held inputs.
        """
        lin = self.lin
        A, B = self.generator.A, self.generator.B
        if not lin.added:
            A, B = hold(A, B, lin.dt)
        else:
            A, B = HeldSystem(A, B, lin.dt, lin.delay, hold).sampled()
        return replace(lin, A=A, B=B)


def _in_steps(
    method: type[Integrator], h: float, A: Array, B: Array, time: float
) -> tuple[Array, Array]:
    """Return the matrices of the motion of dx/dt = A x + B u over a time [s], in steps up to h."""
    steps = max(1, math.ceil(time / h - 1e-9))
    step = method.held(A, B, time / steps)
    assert step is not None
    nx, nu = step[1].shape
    extended = np.eye(nx + nu)
    extended[:nx] = np.hstack(step)
    sample = np.linalg.matrix_power(extended, steps)[:nx]
    return sample[:, :nx], sample[:, nx:]


def _matched(one: Values, other: Values) -> tuple[Values, Values]:
    """Return two sets of poles (n,), ordered such that each pole is near its counterpart."""
    from scipy.optimize import linear_sum_assignment

    return one, other[linear_sum_assignment(np.abs(one[:, None] - other))[1]]


@dataclass(frozen=True)
class Signal:
    """Function of time, such as a disturbance, with the longest step [s] that resolves it.

    `step` is 0 if no step resolves the function, because it jumps within steps or is random.
    """

    name: str
    step: float

    @classmethod
    def of(
        cls,
        name: str,
        signal: Callable[[float], Array],
        dt: float | None,
        duration: float,
    ) -> Signal:
        """Return the limit of a function of time, for a given step dt [s] or the default step."""
        longest = LONGEST_STEP if dt is None else dt
        step = min(longest, duration)
        if np.array_equal(signal(0.0), signal(0.0)):
            for _ in range(_TRIALS):
                if _is_resolved(signal, step, duration):
                    return cls(name, step)
                step = shorter(step)
        return cls(name, 0.0)

    def demand(self, method: type[Integrator], h: float, duration: float) -> Demand:
        """Return the ratio of the step to the longest step that resolves the function."""
        error = h / self.step if self.step else 0.0
        return Demand(error, lambda: self.name)


class Pace:
    """The limits of the time step for a run of a given duration with a given method."""

    def __init__(
        self,
        limits: Sequence[Limit],
        method: type[Integrator],
        duration: float,
        longest: float = LONGEST_STEP,
    ) -> None:
        self.limits = tuple(limits)
        self._method = method
        self._duration = duration
        self._longest = longest

    def demand(self, h: float) -> Demand:
        """Return the largest step error (11.4) of a step of h [s]; it should be at most 1."""
        demands = [
            limit.demand(self._method, h, self._duration) for limit in self.limits
        ]
        return max(demands, key=lambda limit: limit.error, default=Demand(0.0, str))

    def step(self, longest: float | None = None) -> tuple[float, str]:
        """Return the longest accurate step [s] of 1, 2 or 5 units, and the mode that limits it.

        The unit is a power of ten of a second. If `longest` is accurate, return `longest` and an
        empty text. By default, `longest` is the longest default step.
        """
        h = longest or self._longest
        mode = ""
        while h > _SHORTEST_STEP and (demand := self.demand(h)).error > 1.0:
            mode = demand.mode()
            h = shorter(h)
        return h, mode

    @property
    def fastest(self) -> Poles | None:
        """The poles of the closed loop if they are constant during the run, or None."""
        poles = (limit for limit in self.limits if isinstance(limit, Poles))
        return next((limit for limit in poles if limit.system == CLOSED_LOOP), None)

    def remarks(self, h: float, allowed: Callable[[float], float]) -> Iterator[str]:
        """Yield remarks on a step of h [s] that is too long.

        `allowed` returns the longest allowed step of at most a given length [s].
        """
        for limit in self.limits:
            if isinstance(limit, Signal) and not limit.step:
                yield (
                    f"{limit.name} jumps within a step or is random, so no step resolves it; let "
                    "it jump only at multiples of dt"
                )
        demand = self.demand(h)
        if demand.error > 1.0 + 1e-9:
            accurate = allowed(self.step(shorter(h))[0])
            advice = "no step is accurate"
            if self.demand(accurate).error <= 1.0:
                advice = f"dt={accurate:.9g} (--dt {accurate:.9g}) is accurate"
            yield (
                f"the step of {h:.3g} s is too long for {demand.mode()}, so the motion is not "
                f"accurate; {advice}"
            )


def shorter(h: float) -> float:
    """Return the next shorter step [s] in the series 10, 5, 2, 1, 0.5, ... ms."""
    unit = 10.0 ** math.floor(math.log10(h * (1.0 + 1e-9)))
    for digit in (5.0, 2.0, 1.0):
        if digit * unit < h * (1.0 - 1e-9):
            return digit * unit
    return 0.5 * unit


def limits_of_step(
    plant: Plant,
    policy: Policy | None,
    commands: Command | None,
    q: Array,
    v: Array,
    u: Array,
    sample: float,
) -> list[Limit]:
    """Return the limits of the step for a run from q and v with the inputs u.

    `commands` is the policy, bound to the robot, or None without a policy. `sample` is the sample
    time [s] of the policy, or 0 if the policy is continuous.
    """
    A, B, names = _plant_model(plant, q, v, u)
    limits: list[Limit] = [Poles.of(ROBOT, A, names)]
    if rate := _largest_rate(plant, v[None]):
        limits.append(rotation(rate))
    if commands is None:
        return limits
    assert policy is not None
    lags = plant.lags
    if policy.senses_outputs:
        lags = np.append(lags, lags_of_robot(plant.state))
    if lags.any():
        rates = 1.0 / lags[lags > 0.0]
        limits.append(Poles(LAG, -rates.astype(complex)))
    trajectory = policy.followed_trajectory
    if trajectory is not None:
        poles = np.zeros(0) if sample else policy.poles_along()
        limits.append(Poles("loop along the trajectory", poles))
        limits.append(rotation(_largest_rate(plant, trajectory.v)))
        return limits
    if sample:
        loop = _sampled_loop(policy, sample)
        if loop is not None:
            limits.append(loop)
        return limits
    linear = policy.closed_loop()
    if linear is not None:
        loop_names = _loop_names(policy, len(linear[0]))
        limits.append(Poles.of(CLOSED_LOOP, linear[0], loop_names))
        return limits
    if not (isinstance(commands, BoundLaw) or plant.robot.orbit):
        # Infinite commands are accepted, because limits may clip them. NaN is refused.
        zero = np.zeros(len(plant.actuation.names))
        law = Law(commands, plant.actuation.names, (zero, zero), np.inf)
        K = _derivatives(plant, law, q, v)
        if K is not None:
            limits.append(Poles.of("closed loop at the start", A + B @ K, names))
    return limits


def _largest_rate(plant: Plant, v: Array) -> float:
    """Return the largest angular rate [rad/s] of the base or of a joint, for rows v (N, nv)."""
    base = np.linalg.norm(v[:, 3:6], axis=1)
    return float(max(base.max(), np.abs(v[:, plant.turning]).max()))


def _plant_model(
    plant: Plant, q: Array, v: Array, u: Array
) -> tuple[Array, Array, tuple[str, ...]]:
    """Return A, B and the state names of the robot, about its motion through q and v.

    Without an orbit, the errors are about a moving reference (5.1), and B is for inputs in base
    axes. In orbit, A is zero if the base is rotated by 180 deg from the reference.
    """
    robot = plant.robot.replace(outputs=[FullState()])
    state = plant.state
    if not robot.orbit:
        model = Linearizer(robot, frame="local", moving=True)(
            q, v, _in_base_axes(plant, q, u)
        )
        return model.A, model.B, model.state_names
    try:
        model = Linearizer(robot, frame=state.frame, reference=state.reference)(q, v, u)
    except ChartError:
        return np.zeros((state.nx, state.nx)), np.zeros((state.nx, len(u))), state.names
    return model.A, model.B, model.state_names


def _in_base_axes(plant: Plant, q: Array, u: Array) -> Array:
    """Return inputs (nu,) with the wrenches in reference axes rotated to base axes."""
    u = u.copy()
    R = plant.state.rotation(q)
    for held in plant.actuation.held:
        u[held] = u[held].dot(R)
    return u


def _loop_names(policy: Policy, count: int) -> tuple[str, ...]:
    """Return the names of the states of a closed loop with `count` states."""
    lin = policy.model
    names = () if lin is None else lin.state_names
    return (*names, *(f"controller state {k}" for k in range(count - len(names))))


def _sampled_loop(policy: Policy, sample: float) -> SampledLoop | None:
    """Return the sampled loop of a linear policy without delay, or None without a model."""
    lin = policy.model
    if lin is None:
        return None
    sampled = lin if lin.dt else lin.discretize(sample)
    generator = sampled.generator
    if generator is None or not np.isclose(sampled.dt, sample):
        return None
    loop = policy.loop_around(sample)
    if loop is None:
        return None
    return SampledLoop(sampled, generator, loop)


def _derivatives(plant: Plant, law: Law, q: Array, v: Array) -> Array | None:
    """Return the derivatives (nu, nx) of a policy's command at t = 0, or None if it has none.

    The derivatives are with respect to the errors about a moving reference (5.1), and the command
    is in base axes.
    """
    state, model = plant.state, plant.robot.model
    nv = state.nx // 2

    def command(displacement: Array) -> Array:
        along = displacement[:nv].copy()
        along[:3] *= 2.0  # q_b is half of a small rotation
        at = pin.integrate(model, q, state.spread(along))
        u = law(0.0, at, v + state.spread(displacement[nv:]))
        return _in_base_axes(plant, at, u)

    start = command(np.zeros(state.nx))
    if not np.isfinite(start).all():
        return None
    estimates = []
    for size in _DISPLACEMENTS:
        columns = [(command(unit) - start) / size for unit in size * np.eye(state.nx)]
        estimates.append(np.array(columns).T)
    one, other = estimates
    if not np.isfinite(estimates).all() or np.abs(other).max() > _STEEPEST:
        return None
    if not np.abs(one - other).max() <= _SMOOTH * np.abs(other).max():
        return None
    return other


def _is_resolved(signal: Callable[[float], Array], h: float, duration: float) -> bool:
    """Return whether steps of h [s] resolve a function of time; see `_PARABOLA`."""
    steps = max(1, math.floor(duration / h + 1e-9))
    # The first step counts, and other steps that are spread over the run. The golden ratio keeps
    # their times from being multiples of a period of the function.
    spread = [math.floor(steps * math.fmod(k * 0.618034, 1.0)) for k in range(_WINDOWS)]
    errors, largest = 0.0, 0.0
    for first in sorted(set(spread)):
        start = signal(first * h * ROUNDED_UP)
        middle = signal((first + 0.5) * h)
        end = signal((first + 1) * h * ROUNDED_DOWN)
        for s in _BETWEEN:
            exact = signal((first + s) * h)
            weights = (
                (1.0 - s) * (1.0 - 2.0 * s),
                4.0 * s * (1.0 - s),
                s * (2.0 * s - 1.0),
            )
            parabola = weights[0] * start + weights[1] * middle + weights[2] * end
            errors = max(errors, float(np.abs(exact - parabola).max(initial=0.0)))
            largest = max(largest, float(np.abs(exact).max(initial=0.0)))
    return errors <= _PARABOLA * largest
