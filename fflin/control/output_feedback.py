"""Feedback of what is measured, by a compensator that estimates the state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from fflin.base.errors import InputError
from fflin.base.validation import Array, vector
from fflin.control.kalman import Compensator, kalman
from fflin.control.policies import Policy
from fflin.control.tracking import TrajectoryFeedback
from fflin.control.tvkalman import FilterSchedule
from fflin.dynamics.aba import Aba
from fflin.dynamics.output_kinds import KINDS
from fflin.dynamics.outputs import Measuring, Sensing, state_indices
from fflin.dynamics.state import StateMap
from fflin.linear.fit import Signals, require_fit, require_same
from fflin.linear.model import LinearModel
from fflin.robot.outputs import FullState, Gyroscope
from fflin.robot.robot import Robot


def measured_at(state: StateMap) -> tuple[list[int], list[Gyroscope]]:
    """Return which states the outputs of a robot are, and its gyroscopes, that count after them."""
    found, gyros = list[int](), list[Gyroscope]()
    for output in state.robot.outputs:
        if isinstance(output, Gyroscope):
            first = state.nx + 3 * len(gyros)
            found += range(first, first + 3)
            gyros.append(output)
        elif type(output) in KINDS:
            raise InputError(f"a {type(output).__name__} is measured in Python")
        else:
            found += state_indices(state, output)
    return found, gyros


@dataclass(frozen=True, eq=False)
class OutputFeedback:
    """The feedback of a sampled compensator, such as `lqg` makes, on the robot's outputs.

    At each sample u - u0 = C z acts, then y is measured and z brought up to the next sample. An
    accelerometer is taken to feel u as it is commanded, before limits. The estimate begins at
    zero: the point itself.

    Parameters
    ----------
    lin : LinearModel
        The sampled model that the compensator was made for.
    compensator : Compensator
    noise : callable, optional
        noise(t) -> (ny,), added to y.

    Raises
    ------
    InputError
        If the compensator is of another model or not sampled.
    """

    lin: LinearModel
    compensator: Compensator
    noise: Callable[[float], ArrayLike] | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.lin, LinearModel) or not isinstance(self.compensator, Compensator):
            raise InputError(
                "OutputFeedback takes a LinearModel and a Compensator, as fflin.lqg returns it"
            )
        lin, compensator = self.lin, self.compensator
        if not lin.dt or lin.moving:
            raise InputError(
                "the model must be sampled and about a point that stays; take "
                "lin.discretize(dt), and the gain and the estimator of that"
            )
        signals = (compensator.input_names, compensator.output_names, compensator.dt)
        if signals != (lin.output_names, lin.input_names, lin.dt):
            raise InputError(
                f"the compensator is of another model than '{lin.robot}' with its "
                f"{len(lin.output_names)} outputs at dt = {lin.dt:g} s; use one for both"
            )

    def bind(self, robot: Robot) -> Policy:
        """Return policy(t, q, v) -> u for a robot, with an estimate of its own.

        Raises
        ------
        InputError
            If the robot has not the model's states, inputs and outputs; its masses may be others.
        """
        lin, by = self.lin, self.compensator
        state = StateMap(robot, reference=lin.reference, frame=lin.frame)
        require_fit(lin, robot, state)
        own = (lin.output_names, lin.output_units)
        require_same(f"the model is one of '{lin.robot}'", robot, "output", own, _sensed(state))
        there = Measuring(state, lin.q), state.read(lin.q, lin.v)
        stays = _Sample(by.A, by.B, by.C, by.u0, by.y0, lin.C, lin.D)
        return _Loop(state, lin.dt, self.noise, len(by.A), lambda _: stays, lambda _: there)


@dataclass(frozen=True, eq=False)
class TrajectoryOutputFeedback(TrajectoryFeedback):
    r"""The feedback ``u = u*(t) - K(t) eh`` of the error from a trajectory as it is estimated.

    At each sample u acts, then y is measured and the estimate eh of the filter brought up to the
    next sample, as in `OutputFeedback`. Positions and attitudes are measured relative to where the
    trajectory has the base. What `bind` returns has the estimate (nx,) of the sample to come as
    ``estimate``.

    Parameters
    ----------
    trajectory : LinearTrajectory
    schedule : GainSchedule
        Of `tvlqr` with a sampling time.
    filter : FilterSchedule
        Of `tvkalman` with the same.
    noise : callable, optional
        noise(t) -> (ny,), added to y.

    Raises
    ------
    InputError
        If the two are not sampled alike or of different trajectories.
    """

    filter: FilterSchedule
    noise: Callable[[float], ArrayLike] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.filter, FilterSchedule):
            raise InputError(
                f"filter is a {type(self.filter).__name__}, expected a FilterSchedule, as "
                "fflin.tvkalman returns it"
            )
        gains, seen = self.schedule, self.filter
        if not (gains.dt and gains.dt == seen.dt and np.array_equal(gains.A, seen.A)):
            raise InputError(
                f"the gains are sampled at dt = {gains.dt:g} s, the filter at {seen.dt:g} s, "
                "expected the same sample= and the same trajectory of both"
            )

    def bind(self, robot: Robot) -> Policy:
        """Return policy(t, q, v) -> u for a robot, with an estimate of its own.

        Raises
        ------
        InputError
            If the robot has not the trajectory's states, inputs and outputs.
        """
        super().bind(robot)  # refuses another robot
        origin, home = self.trajectory.robot, StateMap(robot, frame="local")
        own = _sensed(StateMap(origin, frame="local"))
        made = f"the trajectory is one of '{origin.name}'"
        require_same(made, robot, "output", own, _sensed(home))

        def there(t: float) -> tuple[Measuring, Array]:
            q, v, _ = self.reference(t)
            state = home.about(home.origin * pin.XYZQUATToSE3(q[:7]))
            return Measuring(state, q), state.read(q, v)

        return _Loop(home, self.filter.dt, self.noise, self._size, self._sample, there)

    def law(self) -> Callable[[float, Array], Array]:
        """Return law(t, e) -> u at the samples, on what the linear models measure."""
        law = _Law(self._size, self._sample)
        return lambda t, e: law.step(
            t, lambda by, u: by.y0 + by.seen @ (e + by.jump) + by.through @ (u - by.u0)
        )

    @property
    def _size(self) -> int:
        return len(self.filter.state_names)

    @cached_property
    def _rest(self) -> tuple[LinearModel, Array]:
        """The model after the end, and the gain of its steady filter."""
        lin, seen = self.end.discretize(self.filter.dt), self.filter
        return lin, kalman(lin, seen.W[-1], seen.V).L

    def _sample(self, t: float) -> _Sample:
        gains, seen, dt = self.schedule, self.filter, self.filter.dt
        k, jump = round(t / dt), np.zeros(self._size)
        if k < len(seen.A):
            A, B, K, L, C, D = (x[k] for x in (seen.A, seen.B, gains.K, seen.L, seen.C, seen.D))
            # Held, an input that changes does most like its mean.
            u = self.reference(t + 0.5 * dt * (self.trajectory.hold == "linear"))[2]
            y = seen.y[k]
        else:
            (lin, L), K = self._rest, self.end_gain
            A, B, C, D, u, y = lin.A, lin.B, lin.C, lin.D, lin.u0, lin.y0
            if k == len(seen.A):
                # From here on the error is counted from rest.
                stop = self.reference(self.duration)[1] - lin.v
                jump[len(jump) // 2 :] = StateMap(self.trajectory.robot).velocities(stop)
        return _Sample(A - B @ K - L @ (C - D @ K), L, -K, u, y, C, D, jump)


class _Sample(NamedTuple):
    """u = u0 + C (z + jump), then z = A (z + jump) + B (y - y0), y by `seen` and `through`."""

    A: Array
    B: Array
    C: Array
    u0: Array
    y0: Array
    seen: Array
    through: Array
    jump: Array | float = 0.0


class _Law:
    """What a compensator does from sample to sample; its estimate begins at zero."""

    def __init__(self, size: int, at: Callable[[float], _Sample]) -> None:
        self.at = at
        self.estimate: Array = np.zeros(size)  # of the state at the sample to come

    def step(self, t: float, measure: Callable[[_Sample, Array], Array]) -> Array:
        """Return the command of a sample, at which y is measured then."""
        by = self.at(t)
        z = self.estimate + by.jump
        u: Array = by.u0 + by.C @ z
        self.estimate = by.A @ z + by.B @ (measure(by, u) - by.y0)
        return u


class _Loop(_Law):
    """The policy of a law on what the robot measures, relative to where it is to be."""

    def __init__(
        self, state: StateMap, dt: float, noise: Any, size: int, at: Any, there: Any
    ) -> None:
        super().__init__(size, at)
        self._dt, self._noise, self._there = dt, noise, there
        self._still: Array = np.zeros(state.robot.nv)
        felt = any(output.FEELS_ACCELERATION for output in state.robot.outputs)
        self._aba, self._asked = Aba(state) if felt else None, -np.inf

    def sample(self, t: float) -> tuple[_Sample, StateMap, Array]:
        """Return what it does at a sample, and the chart and the state that y is relative to."""
        measure, near = self._there(t)
        return self.at(t), measure.state, near

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        apart = t - self._asked
        if self._asked >= 0.0 and abs(apart - self._dt) > 1e-6 * self._dt:
            raise InputError(
                f"the compensator is asked {apart:g} s after its last sample, expected "
                f"{self._dt:g} s; leave `sample` out"
            )
        self._asked = t

        def measured(_: _Sample, u: Array) -> Array:
            measure, near = self._there(t)
            state, a = measure.state, self._still
            if aba := self._aba:
                a = aba.acceleration(q, v, aba.actuation.in_base_axes(state.chart(q), u))
            y: Array = measure(state.read(q, v, near=near), q, v, a)
            if self._noise is not None:
                y = y + vector("noise(t)", self._noise(t), len(y), "one value for each output")
            return y

        return self.step(t, measured)


def _sensed(state: StateMap) -> Signals:
    outputs = state.robot.outputs
    sensed = state if outputs == (FullState(),) else Sensing(state, outputs)
    return sensed.names, sensed.units
