"""The nonlinear robot under a state feedback, and the motion that the linear model predicts."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import count, pairwise
from threading import Lock
from typing import Any

import numpy as np

from fflin.analysis.names import rate_of
from fflin.analysis.wheels import picked, regulated_part, wheel_inputs
from fflin.base.errors import ChartError, InputError
from fflin.base.rotation import quaternion_product
from fflin.base.validation import Array, as_double
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_fit
from fflin.linear.model import LinearModel
from fflin.linear.nonlinear import Nonlinear
from fflin.robot.robot import Robot

# A run has settled where its error is this share of the first, in the norm of its Lyapunov
# function, and has diverged where it is this many times as large.
SETTLED, DIVERGED = 1e-3, 1e3

_LSODA_TURN = Lock()

# A run has left the chart where 1 - |q_b|^2 is less: within 4 degrees of a turn of 180.
_EDGE = 1e-3

# The prediction is measured over so many time constants of the slowest pole, integrated to this
# relative error; a random run may take as many times what the slowest pole needs to settle.
_FORESIGHT, _PRECISION, _PATIENCE = 3.0, 1e-9, 3.0
_STEPS = 60

# Evaluations of the dynamics that a run may take; a loop that settles takes a tenth.
_MOST_EVALUATIONS = 60_000


@dataclass(frozen=True, eq=False)
class Loop:
    """A robot, its linear model, and the feedback ``u = u0 - K (z - z0)`` on the model's states."""

    robot: Robot
    lin: LinearModel  # whole or reduced; sampled if its input is held
    K: Array  # (nu, nz)

    @cached_property
    def state(self) -> StateMap:
        """The whole state of the robot, in the model's axes."""
        return StateMap(self.robot, reference=self.lin.reference, frame=self.lin.frame)

    @cached_property
    def watched(self) -> Array:
        """Which of its entries are the model's states."""
        names = self.state.names
        return np.array([names.index(name) for name in self.lin.state_names], dtype=np.intp)

    @cached_property
    def rate(self) -> Array:
        """State matrix of the linear loop, A - B K."""
        closed: Array = self.lin.A - self.lin.B @ self.K
        return closed

    @cached_property
    def decay(self) -> float:
        """The slowest decay of the linear loop [1/s]; not positive where it is unstable."""
        poles = np.linalg.eigvals(self.rate)
        if self.lin.dt:
            return -math.log(max(float(np.abs(poles).max()), 1e-300)) / self.lin.dt
        return -float(poles.real.max())

    @cached_property
    def weight(self) -> Array:
        """P of the Lyapunov function of the linear loop that decays as its energy does."""
        from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov

        names = self.lin.state_names
        of = dict(zip(names[-len(self.lin.M) :], np.sqrt(self.lin.M.diagonal()), strict=True))
        # A coordinate as its rate; a rate may stand without one.
        size = [self.decay * of[rate_of(name)] for name in names if name not in of]
        Q = np.diag(np.array([*size, *of.values()]) ** 2)
        solve = solve_discrete_lyapunov if self.lin.dt else solve_continuous_lyapunov
        P: Array = solve(self.rate.T, Q if self.lin.dt else -Q)
        return (P + P.T) / 2.0

    def size(self, error: Array) -> float:
        """Return the norm of a deviation (nz,) of the model's states."""
        return math.sqrt(max(float(error @ self.weight @ error), 0.0))

    def displaced(
        self, rng: np.random.Generator, attitude: float, position: float, joint: float
    ) -> Array:
        """Return a state (nx,) displaced by [deg], [m] and [rad|m], the model's states alone."""
        state, lin = self.state, self.lin
        g = state.groups
        x = state.to_state(lin.q, lin.v)
        axis, along = _direction(rng), _direction(rng)
        turn = np.radians(attitude) / 2.0
        q0 = np.sqrt(1.0 - float(x[g.q_b] @ x[g.q_b]))
        relative = np.array((*(np.sin(turn) * axis), np.cos(turn)))
        turned = quaternion_product(np.array((*x[g.q_b], q0)), relative)
        moved = x.copy()
        moved[g.q_b] = turned[:3] * np.copysign(1.0, turned[3])
        moved[g.r_b] += position * along
        spread = rng.uniform(-1.0, 1.0, size=self.robot.n)
        moved[g.q_m] += joint * spread / np.abs(spread).max(initial=1e-300)
        x[self.watched] = moved[self.watched]
        return x

    def prediction_error(self, x: Array) -> float:
        """Return the linear loop's largest relative error; NaN where the other ends unsettled."""
        times = self._times(_FORESIGHT / self.decay)
        _, motion = self.run(x, times, _PRECISION)
        foreseen = self.linear(motion[0], times)[: len(motion)]
        first, last = self.size(motion[0]), self.size(motion[-1])
        if len(motion) < len(times) and last > SETTLED * first:
            return np.nan
        return max(map(self.size, motion - foreseen)) / first

    def outcome(self, x: Array) -> str:
        """Return the outcome of a run with time enough to settle, as `run` names it."""
        return self.run(x, self._times(_PATIENCE * np.log(1.0 / SETTLED) / self.decay), 1e-6)[0]

    def _times(self, horizon: float) -> Array:
        """Return the times of a run: its samples, or even steps."""
        if self.lin.dt:
            return self.lin.dt * np.arange(1.0 + np.ceil(horizon / self.lin.dt))
        return np.linspace(0.0, horizon, _STEPS + 1)

    def run(self, x: Array, times: Array, precision: float) -> tuple[str, Array]:
        """Return how the nonlinear loop ends, and the deviations (<= len(times), nz) on the way.

        It ends "settled", "slow" where it was on its way at the last time, "chart" where the base
        came near a turn of 180 degrees, or "diverged".
        """
        follow = self._sampled if self.lin.dt else self._continuous
        motion = [x[self.watched] - self.lin.x0]
        try:
            # A run that overflows counts as diverged; NumPy and SciPy need not warn of it.
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                outcome = follow(x, times, precision, motion)
        except ChartError:
            outcome = "chart"
        except InputError:  # an overflow, or a spin that takes too many evaluations
            outcome = "diverged"
        return outcome, np.array(motion)

    def _dynamics(self) -> Callable[[Array, Array], Array]:
        """Return the nonlinear model of one run, with a work space and a count of its own."""
        model, evaluations = Nonlinear(self.state, self.lin), count()

        def rate(x: Array, u: Array) -> Array:
            if next(evaluations) >= _MOST_EVALUATIONS:
                raise InputError(f"the run takes more than {_MOST_EVALUATIONS} evaluations")
            return model(x, u)

        return rate

    def _continuous(self, x: Array, times: Array, precision: float, motion: list[Array]) -> str:
        from scipy.integrate import solve_ivp

        first, dynamics = self.size(motion[0]), self._dynamics()

        def ended(_: float, x: Array) -> float:
            return float(self._outcome(x, first) == "slow") - 0.5

        ended.terminal = True  # type: ignore[attr-defined]
        # A loop with fast poles is stiff; LSODA finds that out and changes its method. That of
        # ODEPACK keeps its state for the whole process.
        with _LSODA_TURN:
            found = solve_ivp(
                lambda _, x: dynamics(x, self._input(x)),
                (times[0], times[-1]),
                x,
                method="LSODA",
                t_eval=times,
                events=ended,
                **_tolerances(x, precision),
            )
        motion += list(found.y.T[1:, self.watched] - self.lin.x0)
        if found.t_events[0].size:
            return self._outcome(found.y_events[0][-1], first, slack=1e-3)
        return "slow" if found.success else "diverged"

    def _sampled(self, x: Array, times: Array, precision: float, motion: list[Array]) -> str:
        from scipy.integrate import solve_ivp

        first, dynamics = self.size(motion[0]), self._dynamics()
        outcome = "slow"
        for span in pairwise(times.tolist()):
            found = solve_ivp(
                lambda _, x, held: dynamics(x, held),
                span,
                x,
                method="DOP853",
                args=(self._input(x),),
                **_tolerances(x, precision),
            )
            if not found.success:
                return "diverged"
            x = found.y[:, -1]
            motion.append(x[self.watched] - self.lin.x0)
            outcome = self._outcome(x, first)
            if outcome != "slow":
                break
        return outcome

    def _input(self, x: Array) -> Array:
        u: Array = self.lin.u0 - self.K @ (x[self.watched] - self.lin.x0)
        return u

    def _outcome(self, x: Array, first: float, slack: float = 0.0) -> str:
        """Return how a run that has come to x ends, or "slow"; `slack` of an event's rounding."""
        now = self.size(x[self.watched] - self.lin.x0)
        if now <= (1.0 + slack) * SETTLED * first:
            return "settled"
        if 1.0 - float(x[:3] @ x[:3]) < (1.0 + slack) * _EDGE:
            return "chart"
        return "slow" if now < (1.0 - slack) * DIVERGED * first else "diverged"

    def linear(self, error: Array, times: Array) -> Array:
        """Return the deviations (len(times), nz) that the linear model predicts."""
        from scipy.linalg import expm

        step = self.rate if self.lin.dt else expm(self.rate * (times[1] - times[0]))
        motion = [error]
        for _ in times[1:]:
            motion.append(step @ motion[-1])
        return np.array(motion)


def checked_loop(robot: Robot, lin: LinearModel, gain: Any) -> Loop:
    """Return the loop of a gain, or raise `InputError` where it cannot settle at the point."""
    if not isinstance(robot, Robot) or not isinstance(lin, LinearModel):
        raise InputError("expected a fflin.Robot, its fflin.LinearModel and a gain")
    K = as_double("gain", getattr(gain, "K", gain))
    if K.shape != lin.B.T.shape:
        raise InputError(f"K has shape {K.shape}, expected {lin.B.T.shape}")
    if not np.isfinite(K).all():
        raise InputError("K has entries that are NaN or infinite, expected finite numbers")
    kept = getattr(gain, "regulated", ())
    part = regulated_part(lin, any(f"qdot_m.{name}" in kept for name in wheel_inputs(lin)))
    if part.state_names == kept:  # the others, which are left to themselves, do not settle
        K, lin = K @ picked(kept, lin.state_names).T, part
    loop = Loop(robot, lin, K)
    require_fit(lin, robot, loop.state)
    if not len(lin.x0):
        raise InputError(f"the model of '{lin.robot}' has no states; nothing is to settle")
    if lin.moving or not lin.is_equilibrium() or lin.v.any():
        raise InputError("the point is no fixed point at rest; its loop cannot settle there")
    if not loop.decay > 0.0:
        raise InputError(
            f"the linear loop is not stable: its slowest pole grows with {-loop.decay:.3g} 1/s; "
            "design the gain with fflin.lqr"
        )
    return loop


def _tolerances(x: Array, precision: float) -> dict[str, Any]:
    return {"rtol": precision, "atol": 1e-3 * precision * (1.0 + np.abs(x))}


def _direction(rng: np.random.Generator) -> Array:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)
