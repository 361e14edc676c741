"""Settling of a regulated robot: error norm, random displacements, and runs from them.

The norm belongs to the Lyapunov function of the linear loop that decays as the robot's energy does.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import count
from typing import Any, NamedTuple

import numpy as np

from fflin.analysis.names import rate_of
from fflin.analysis.wheels import picked, regulated_part, wheel_inputs
from fflin.base.errors import InputError
from fflin.base.rotation import quaternion_product
from fflin.base.validation import Array, as_double
from fflin.campaign.runs import CampaignJob, done_by
from fflin.control.policies import StateFeedback
from fflin.control.saturation import Saturation
from fflin.dynamics.state import Frame, StateMap
from fflin.dynamics.state_rows import states_of
from fflin.linear.fit import require_fit
from fflin.linear.linearization import linearize
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot
from fflin.simulation.plan import Plan
from fflin.simulation.plant import Plant

# A run has settled where its error is this share of the first, and has diverged where it is this
# many times as large.
SETTLED, DIVERGED = 1e-3, 1e3
EDGE = 1e-3  # of 1 - |q_b|^2, within 4 degrees of a turn of 180, where a run leaves the chart
# The prediction is measured over so many time constants of the slowest pole; a random run may take
# as many times what the slowest pole needs to settle.
_FORESIGHT, _PATIENCE = 3.0, 3.0
_STEP = 0.25  # over the fastest pole
_WIDEST = 10.0  # displacement of a joint [rad] up to which steps are as much shorter
_FINER, _FINEST = 8, 2  # times as many steps where a run diverges, and how often so
_MOST_STEPS = 1_000_000
_LOOKS = 60  # at the prediction

OUTCOMES = ("slow", "settled", "chart", "diverged")


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
        """P of the Lyapunov function of the linear loop."""
        from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov

        names = self.lin.state_names
        of = dict(zip(names[-len(self.lin.M) :], np.sqrt(self.lin.M.diagonal()), strict=True))
        # A coordinate as its rate; a rate may stand without one.
        size = [self.decay * of[rate_of(name)] for name in names if name not in of]
        Q = np.diag(np.array([*size, *of.values()]) ** 2)
        solve = solve_discrete_lyapunov if self.lin.dt else solve_continuous_lyapunov
        P: Array = solve(self.rate.T, Q if self.lin.dt else -Q)
        return (P + P.T) / 2.0

    def size(self, error: Array) -> Array:
        """Return the norm of deviations (.., nz) of the model's states."""
        square: Array = ((error @ self.weight) * error).sum(axis=-1)
        return np.sqrt(np.maximum(square, 0.0))

    def displaced(
        self, rng: np.random.Generator, attitude: float, position: float, joint: float
    ) -> Array:
        """Return a state (nx,) displaced by [deg], [m] and [rad|m], the model's states alone."""
        state, lin = self.state, self.lin
        g = state.groups
        x = state.to_state(lin.q, lin.v)
        axis, along = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
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

    def errors(self, q: Array, nu: Array) -> tuple[Array, Array]:
        """Return q0^2 (N,) of the chart, and deviations (N, nz) of the model's states, of rows."""
        x = states_of(self.state, q, nu)
        e, turns = x[:, self.watched] - self.lin.x0, np.isin(self.watched, 6 + self.state.unbounded)
        e[:, turns] -= 2.0 * np.pi * np.round(e[:, turns] / (2.0 * np.pi))
        return 1.0 - (x[:, :3] ** 2).sum(axis=1), e

    def fed_back_in(self, frame: Frame) -> Loop:
        """Return the same linear loop, fed back in other axes."""
        state = StateMap(self.robot, reference=self.lin.reference, frame=frame)
        if not np.allclose(state.to_state(self.lin.q, self.lin.v)[:3], 0.0, atol=1e-9):
            raise InputError(
                "the base of the operating point is rotated relative to the reference, so that "
                "models in other frames differ; compare frames on a model made without reference="
            )
        return replace(self, lin=replace(self.lin, frame=state.frame))


class SettlingJob(CampaignJob):
    """Runs of a loop from displaced states, looked at by `Settling` every so many steps."""

    def __init__(
        self, loop: Loop, foresees: bool, limits: Any, joint: float, fine: int = 0, engine: str = ""
    ) -> None:
        lin, decay = loop.lin, loop.decay
        self.loop, self.foresees, self.fine = loop, foresees, fine
        # Between samples, and where it is cut, the robot is without its loop.
        free = linearize(loop.robot, lin.q, lin.v, lin.u0, frame=lin.frame, reference=lin.reference)
        rates = [2.0 * free.A] if lin.dt else [free.A, loop.rate]
        fastest = max(float(np.abs(np.linalg.eigvals(each)).max()) for each in rates)
        horizon = (_FORESIGHT if foresees else _PATIENCE * math.log(1.0 / SETTLED)) / decay
        pace = max(fastest, 4.0 * decay) * min(max(joint, 1.0), _WIDEST)
        self.every = math.ceil(lin.dt * pace / _STEP) if lin.dt else 1
        dt = lin.dt / self.every if lin.dt else _STEP / pace
        if not horizon / dt <= _MOST_STEPS:
            raise InputError(
                f"the loop's fastest pole is at {fastest:.3g} 1/s and its slowest at {decay:.3g} "
                f"1/s: a run would take {horizon / dt:.3g} steps, expected at most "
                f"{_MOST_STEPS:,}; give a gain whose poles are closer together, or add damping"
            )
        if not lin.dt:
            self.every = max(1, int(horizon / dt / _LOOKS)) if foresees else 4
        looks, finer = math.ceil(horizon / (dt * self.every) - 1e-9), _FINER**fine
        dt, self.every = dt / finer, self.every * finer
        options = {"q0": lin.q, "v0": lin.v, "dt": dt, "duration": dt * self.every * looks}
        options |= {"limits": limits, "project": not foresees, "every": self.every}
        none = dict.fromkeys(loop.state.names, 0.0)
        super().__init__(loop.robot, StateFeedback(lin, loop.K), none, 0, engine, options)
        if limits is None:  # nothing cuts, not even thrusts that pull
            most = np.full(len(self.plan.initial), np.inf)
            self.plan = replace(self.plan, limits=Saturation(-most, most, None, None))
        self._again = partial(SettlingJob, loop, foresees, limits, joint, fine)
        self.finer = partial(SettlingJob, loop, foresees, limits, joint, fine + 1)
        self.step = self._foreseen(dt)

    def _foreseen(self, dt: float) -> Array | None:
        """Return what takes the linear loop from look to look, by the method of the nonlinear one.

        Of a linear system CF4 is the classical method of order four, whose steps are those of its
        stability polynomial: so the difference of the two loops is that of what is not linear.
        """
        if not self.foresees or self.loop.lin.dt:
            return self.loop.rate if self.foresees else None
        one, Z = np.eye(len(self.loop.rate)), self.loop.rate * dt
        step = one + Z @ (one + Z / 2.0 @ (one + Z / 3.0 @ (one + Z / 4.0)))
        return np.linalg.matrix_power(step, self.every)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each array of a run's outcome."""
        return dict.fromkeys(Judged._fields, ())

    def _tally(self, count: int) -> Any:
        return Settling(self, count)

    def plan_of(self, drawn: Array) -> tuple[Plan, Plant]:
        """Return the plan of a run, which ends once it has settled."""
        plan, plant = super().plan_of(drawn)
        loop, first, steps = self.loop, self.loop.size(drawn[self.loop.watched]), count(1)

        def settled(_: float, q: Array, v: Array) -> float:
            if next(steps) % self.every:
                return 1.0
            e = loop.errors(q[None], loop.state.velocities(v)[None])[1]
            return float(loop.size(e[0]) - SETTLED * first)

        return replace(plan, events=() if self.foresees else (settled,)), plant


class Judged(NamedTuple):
    """Results of runs: index into OUTCOMES (N,), and largest prediction error (N,)."""

    outcome: Array
    error: Array


class Settling:
    """Runs of a loop: whether they have settled, and how far they are from the linear loop's."""

    span = 128  # steps between looks at what is over

    def __init__(self, job: SettlingJob, count: int) -> None:
        self._job, self._loop = job, job.loop
        self._code, self._worst = np.zeros(count, dtype=int), np.zeros(count)

    @property
    def over(self) -> Any:
        """Which runs (count,) need not go on."""
        return (self._code > 0) & (self._job.step is None)

    def copy(self) -> Settling:
        """Return one that goes its own way from here on."""
        return copy(self)

    def add(self, first: int, rows: list[Array], _: Any = None) -> Settling:
        """Take rows (steps, count, ..) from a step on into account."""
        looks = slice(-first % self._job.every, None, self._job.every)
        loop, (q, nu) = self._loop, (each[looks] for each in rows[:2])
        if not (shape := q.shape[:2])[0]:
            return self
        square, e = loop.errors(*(each.reshape(-1, each.shape[-1]) for each in (q, nu)))
        e = e.reshape(*shape, -1)
        size = loop.size(e)
        if first == 0:
            self._first, self._ahead = size[0], e[0]
        edge = square.reshape(shape) < EDGE
        ends = [size <= SETTLED * self._first, edge, ~(size < DIVERGED * self._first)]
        code = np.select(ends, [1, 2, 3], 0)
        code = np.take_along_axis(code, (code > 0).argmax(axis=0)[None], axis=0)[0]
        self._code = np.where(self._code > 0, self._code, code)
        if self._job.step is not None:
            for each in e:
                self._worst = np.maximum(self._worst, loop.size(each - self._ahead))
                self._ahead = self._ahead @ self._job.step.T
        return self

    def outcome(self, _: int, stop: Array) -> Judged:
        """Return how they ended, by which of STOPS."""
        code = np.where(self._code > 0, self._code, np.array([0, 3, 2, 1])[stop.astype(int)])
        error = self._worst / np.maximum(self._first, 1e-300)
        return Judged(code.astype(float), np.where((stop > 0.0) | (code > 1), np.nan, error))


def flown(job: SettlingJob, rows: Any, runs: Any, how: dict[str, Any]) -> dict[str, Array]:
    """Return how runs ended; what diverges is flown again in shorter steps, which follow it."""
    arrays = done_by(job, lru_cache(64)(partial(rows, runs)), len(runs), **how)
    lost = np.flatnonzero(arrays["outcome"] == OUTCOMES.index("diverged"))
    if len(lost) and job.fine < _FINEST:
        again = flown(job.finer(engine=job.engine), rows, runs[lost], how | {"progress": None})
        for key, values in again.items():
            arrays[key][lost] = values
    return arrays


def checked_loop(robot: Robot, lin: LinearModel, gain: Any) -> Loop:
    """Return the loop of a gain, or raise `InputError` where it cannot settle at the point."""
    if not isinstance(robot, Robot) or not isinstance(lin, LinearModel):
        given = f"robot is a {type(robot).__name__}, lin is a {type(lin).__name__}"
        raise InputError(f"{given}; expected a fflin.Robot and its fflin.LinearModel")
    K = StateFeedback(lin, as_double("gain", getattr(gain, "K", gain))).K
    kept = getattr(gain, "regulated", ())
    part = regulated_part(lin, any(f"qdot_m.{name}" in kept for name in wheel_inputs(lin)))
    if part.state_names == kept:  # the others, which are left to themselves, do not settle
        K, lin = K @ picked(kept, lin.state_names).T, part
    loop = Loop(robot, lin, K)
    require_fit(lin, robot, loop.state)
    if not len(lin.x0):
        raise InputError(f"the model of '{lin.robot}' has no states, so nothing can settle")
    if lin.moving or not lin.is_equilibrium() or lin.v.any():
        raise InputError(
            "the operating point is not an equilibrium at rest, so its loop cannot settle there; "
            "linearise about an equilibrium"
        )
    if not loop.decay > 0.0:
        raise InputError(
            f"the linear loop is not stable: a mode grows at {-loop.decay:.3g} 1/s; "
            "design the gain with fflin.lqr"
        )
    return loop
