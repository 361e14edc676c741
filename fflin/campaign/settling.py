"""A regulated robot: the Lyapunov norm of its linear loop, its displacements, and whether it settles.

The norm decays in the linear loop as the robot's energy does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from fflin.analysis.names import rate_of
from fflin.analysis.wheels import picked, regulated_part, wheel_inputs
from fflin.base.errors import InputError
from fflin.base.rotation import quaternion_product
from fflin.base.validation import Array, as_double
from fflin.campaign.flights import Starts
from fflin.control.policies import StateFeedback
from fflin.control.saturation import Saturation
from fflin.dynamics.state import Frame, StateMap
from fflin.dynamics.state_rows import states_of
from fflin.linear.fit import require_fit
from fflin.linear.linearization import linearize
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot
from fflin.simulation.plan import Plan, law_of
from fflin.simulation.plant import Plant
from fflin.simulation.simulate import planned

# A run has settled where its error is this share of the first, in the norm of its Lyapunov
# function, and has diverged where it is this many times as large.
SETTLED, DIVERGED = 1e-3, 1e3

# A run has left the chart where 1 - |q_b|^2 is less: within 4 degrees of a turn of 180.
EDGE = 1e-3

# The prediction is measured over so many time constants of the slowest pole; a random run may take
# as many times what the slowest pole needs to settle.
_FORESIGHT, _PATIENCE = 3.0, 3.0

_STEP = 0.25  # over the fastest pole
_WIDEST = 10.0  # displacement of a joint [rad] up to which steps are as much shorter
_FINER = 8  # times as many steps are taken where a run diverges
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

    def starts(self, states: Any) -> Starts:
        """Return where runs from states begin."""
        return Starts(*self.state.points(np.array(states))[1:])

    def fed_back_in(self, frame: Frame) -> Loop:
        """Return the same linear loop, fed back in other axes."""
        state = StateMap(self.robot, reference=self.lin.reference, frame=frame)
        if not np.allclose(state.to_state(self.lin.q, self.lin.v)[:3], 0.0, atol=1e-9):
            raise InputError(
                "the base of the point is turned against the reference, where frames have "
                "different models; compare them on a model made without a reference"
            )
        return replace(self, lin=replace(self.lin, frame=state.frame))


class Trial(NamedTuple):
    """Runs of a loop: steps of dt [s], looked at every so many of them; see `Settling`."""

    loop: Loop
    foresees: bool
    limits: Any
    dt: float
    steps: int
    every: int
    fine: int = 0  # how often they have been made shorter

    @classmethod
    def of(cls, loop: Loop, *, foresees: bool, limits: Any, joint: float) -> Trial:
        """Make one long enough to settle, or to measure what the linear loop foresees."""
        lin, decay = loop.lin, loop.decay
        # Between samples, and where it is cut, the robot is without its loop.
        free = linearize(loop.robot, lin.q, lin.v, lin.u0, frame=lin.frame, reference=lin.reference)
        fastest = float(np.abs(np.linalg.eigvals(free.A)).max()) * (1.0 + bool(lin.dt))
        if not lin.dt:
            fastest = max(fastest, float(np.abs(np.linalg.eigvals(loop.rate)).max()))
        horizon = (_FORESIGHT if foresees else _PATIENCE * math.log(1.0 / SETTLED)) / decay
        dt = _STEP / (max(fastest, 4.0 * decay) * min(max(joint, 1.0), _WIDEST))
        every = 1
        if lin.dt:
            every = math.ceil(lin.dt / dt)
            dt, horizon = lin.dt / every, lin.dt * math.ceil(horizon / lin.dt)
        if horizon / dt > _MOST_STEPS:
            raise InputError(
                f"the loop's fastest pole is at {fastest:.3g} 1/s and its slowest at {decay:.3g} "
                f"1/s: a run would take {horizon / dt:.3g} steps, expected at most "
                f"{_MOST_STEPS:,}; give a gain whose poles are less apart, or damp what swings"
            )
        steps = math.ceil(horizon / dt * (1.0 - 1e-9))
        if not lin.dt:
            every = max(1, steps // _LOOKS) if foresees else 4
            steps = every * math.ceil(steps / every)
        return cls(loop, foresees, limits, dt, steps, every)

    def finer(self) -> Trial | None:
        """Return it in shorter steps; None where they are the shortest."""
        if self.fine == 2:
            return None
        steps, every = self.steps * _FINER, self.every * _FINER
        return self._replace(dt=self.dt / _FINER, steps=steps, every=every, fine=self.fine + 1)

    def make(self) -> tuple[Plan, Plant]:
        """Return its plan; nothing cuts the inputs unless limits are given."""
        loop, lin = self.loop, self.loop.lin
        times = {"duration": self.dt * self.steps, "dt": self.dt, "every": self.steps}
        options = {"q0": lin.q, "v0": lin.v, "linear": False, "project": not self.foresees}
        policy = StateFeedback(lin, loop.K)
        plan, plant = planned(loop.robot, policy, limits=self.limits, **times, **options)
        if self.limits is None:
            free = np.full(len(plan.initial), np.inf)
            open_ = Saturation(-free, free, None, None)
            law = law_of(plan.policy, plant, open_, plan.times)
            plan = replace(plan, limits=open_, law=law)
        return plan, plant

    def judge(self, _: Plan, __: Plant, count: int) -> Settling:
        """Return what watches its runs."""
        return Settling(self, count)


class Judged(NamedTuple):
    """How runs ended: which of OUTCOMES (N,), and the largest error of the prediction (N,)."""

    outcome: Array
    error: Array


class Settling:
    """Runs of a loop: whether they have settled, and how far they are from the linear loop's."""

    SHAPES = dict.fromkeys(Judged._fields, ())

    def __init__(self, trial: Trial, count: int) -> None:
        self._trial, self._loop = trial, trial.loop
        self._code, self._worst = np.zeros(count, dtype=int), np.zeros(count)
        self._step = _foreseen(trial) if trial.foresees else None

    @property
    def over(self) -> Any:
        """Which runs (count,) need not go on."""
        return (self._code > 0) & (self._step is None)

    def copy(self) -> Settling:
        """Return one that goes its own way from here on."""
        other = object.__new__(Settling)
        other.__dict__ |= {
            k: x.copy() if isinstance(x, np.ndarray) else x for k, x in vars(self).items()
        }
        return other

    def add(self, first: int, q: Array, nu: Array, _: Array) -> Settling:
        """Take rows (steps, count, ..) from a step on into account."""
        loop, rows = self._loop, slice(-first % self._trial.every, None, self._trial.every)
        q, nu = q[rows], nu[rows]
        shape = q.shape[:2]
        if not shape[0]:
            return self
        x = states_of(loop.state, *(each.reshape(-1, each.shape[-1]) for each in (q, nu)))
        e = x[:, loop.watched] - loop.lin.x0
        turns = np.isin(loop.watched, 6 + loop.state.unbounded)
        e[:, turns] -= 2.0 * np.pi * np.round(e[:, turns] / (2.0 * np.pi))
        e = e.reshape(*shape, -1)
        size = loop.size(e)
        if first == 0:
            self._first, self._ahead = size[0], e[0]
        edge = 1.0 - (x[:, :3] ** 2).sum(axis=1).reshape(shape) < EDGE
        ends = [size <= SETTLED * self._first, edge, ~(size < DIVERGED * self._first)]
        code = np.select(ends, [1, 2, 3], 0)
        code = np.take_along_axis(code, (code > 0).argmax(axis=0)[None], axis=0)[0]
        self._code = np.where(self._code > 0, self._code, code)
        if self._step is not None:
            for each in e:
                self._worst = np.maximum(self._worst, loop.size(each - self._ahead))
                self._ahead = self._ahead @ self._step.T
        return self

    def outcome(self, _: int, stop: Array) -> Judged:
        """Return how they ended, by which of STOPS."""
        code = np.where(self._code > 0, self._code, np.array([0, 3, 2, 3])[stop.astype(int)])
        error = self._worst / np.maximum(self._first, 1e-300)
        return Judged(code.astype(float), np.where((stop > 0.0) | (code > 1), np.nan, error))


def _foreseen(trial: Trial) -> Array:
    """Return what takes the linear loop from look to look, by the method of the nonlinear one.

    Of a linear system CF4 is the classical method of order four, whose steps are those of its
    stability polynomial: so the difference of the two loops is that of what is not linear.
    """
    Z = trial.loop.rate
    if trial.loop.lin.dt:
        return Z
    one, Z = np.eye(len(Z)), Z * trial.dt
    step = one + Z @ (one + Z / 2.0 @ (one + Z / 3.0 @ (one + Z / 4.0)))
    return np.linalg.matrix_power(step, trial.every)


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


def _direction(rng: np.random.Generator) -> Array:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)
