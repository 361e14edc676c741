"""Settling of a regulated robot: error norm, random displacements, and runs from them.

The norm belongs to the Lyapunov function of the linear loop that decays as the robot's energy does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fflin.analysis.names import rate_of
from fflin.analysis.reduction import regulated_part, selection, wheel_inputs
from fflin.base.errors import InputError
from fflin.base.rotation import quaternion_product
from fflin.base.validation import Array, as_double
from fflin.campaign.dispersions import Draws
from fflin.campaign.runs import CampaignJob, completed
from fflin.control.policies import StateFeedback
from fflin.dynamics.coordinates import states_of, unwound
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_fit
from fflin.linear.linearization import linearize
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot

# Ratio of a run's error to its initial error at which it has settled, and has diverged.
SETTLED, DIVERGED = 1e-3, 1e3
EDGE = (
    1e-3  # value of 1 - |q_b|^2, 4 degrees from a rotation of 180, at which a run leaves the chart
)
# Duration of a comparison with the prediction in time constants of the slowest pole, and of a
# random run in times that this pole needs to settle.
_CONSTANTS, _PATIENCE = 3.0, 3.0
_STEP = 0.25  # time step times the fastest pole
_WIDEST = 10.0  # displacement of a joint [rad] up to which steps shorten in proportion
_FINER, _FINEST = 8, 2  # factor by which steps are shortened if a run diverges, and how often
_MOST_STEPS = 1_000_000
_CHECKS = 60  # comparisons with the prediction in a run

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
    def start(self) -> Array:
        """The state (nx,) of the operating point."""
        return self.state.to_state(self.lin.q, self.lin.v)

    @cached_property
    def watched(self) -> Array:
        """Mask of the entries of the whole state that are states of the model."""
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
        g, x = self.state.groups, self.start.copy()
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
        """Return q0^2 (N,) of the base attitude and the deviations (N, nz) from the model's x0."""
        x, center = states_of(self.state, q, nu), np.zeros(self.state.nx)
        center[self.watched] = self.lin.x0
        e = unwound(self.state, x - center)[:, self.watched]
        return 1.0 - (x[:, :3] ** 2).sum(axis=1), e


def settling_runs(
    loop: Loop, predicts: bool, limits: object, joint: float, fine: int = 0
) -> CampaignJob:
    """Return runs of a loop from displaced states, until they settle or up to a horizon.

    With `predicts`, they last three time constants and are compared with the linear loop. `joint`
    is the largest displacement of a joint, and `fine` is how often the steps have been shortened.
    """
    lin, decay = loop.lin, loop.decay
    # Between samples, and where an input saturates, the robot moves without its loop.
    free = linearize(loop.robot, lin.q, lin.v, lin.u0, frame=lin.frame, reference=lin.reference)
    rates = [2.0 * free.A] if lin.dt else [free.A, loop.rate]
    fastest = max(float(np.abs(np.linalg.eigvals(each)).max()) for each in rates)
    horizon = (_CONSTANTS if predicts else _PATIENCE * math.log(1.0 / SETTLED)) / decay
    pace = max(fastest, 4.0 * decay) * min(max(joint, 1.0), _WIDEST)
    every = math.ceil(lin.dt * pace / _STEP) if lin.dt else 1
    dt = lin.dt / every if lin.dt else _STEP / pace
    if not horizon / dt <= _MOST_STEPS:
        raise InputError(
            f"the loop's fastest pole is at {fastest:.3g} 1/s and its slowest at {decay:.3g} "
            f"1/s: a run would take {horizon / dt:.3g} steps, expected at most "
            f"{_MOST_STEPS:,}; give a gain with poles of more similar speed, or add damping"
        )
    if not lin.dt:
        every = max(1, int(horizon / dt / _CHECKS)) if predicts else 4
    checks, finer = math.ceil(horizon / (dt * every) - 1e-9), _FINER**fine
    dt, every = dt / finer, every * finer
    options = {"q0": lin.q, "v0": lin.v, "dt": dt, "duration": dt * every * checks}
    options |= {"limits": limits, "project": not predicts, "every": every}
    # Without limits no input saturates, and thrusters may pull.
    options |= {"unlimited": limits is None}
    rule = Settling(loop, every, _transition(loop, dt, every) if predicts else None)
    deviations = dict.fromkeys(loop.state.names, 0.0)
    policy = StateFeedback(lin, loop.K)
    return CampaignJob(loop.robot, policy, deviations, 0, "python", options, rule)


def _transition(loop: Loop, dt: float, every: int) -> Array:
    """Return the transition matrix of the linear loop from check to check.

    For a linear system CF4 is the classical method of order four, which multiplies by its stability
    polynomial in each step. The two loops then differ by their nonlinear terms alone.
    """
    if loop.lin.dt:
        return loop.rate
    one, Z = np.eye(len(loop.rate)), loop.rate * dt
    step = one + Z @ (one + Z / 2.0 @ (one + Z / 3.0 @ (one + Z / 4.0)))
    return np.linalg.matrix_power(step, every)


class Settling:
    """Rule by which runs have settled, and their differences from the linear loop.

    It is applied every `every` steps. With the transition matrix `step` of the linear loop between
    these checks, runs go on to their end and are compared with that loop.
    """

    # Index into OUTCOMES, and largest relative prediction error.
    FIELDS: ClassVar[tuple[str, ...]] = ("outcome", "error")
    every = 1
    span = 128  # steps between checks of `over`

    def __init__(self, loop: Loop, every: int, step: Array | None) -> None:
        self._loop, self.checked_every, self._step = loop, every, step
        self.reset()

    def reset(self) -> None:
        """Begin with other runs."""
        self._code, self._worst = np.zeros(1, dtype=int), np.zeros(1)
        self._next = 0  # first step that has not been added

    @property
    def over(self) -> NDArray[np.bool_]:
        """Mask of the runs that may end early."""
        return (self._code > 0) & (self._step is None)

    def add(self, first: int, rows: Sequence[Array], raw: Array | None = None) -> None:
        """Add the rows (steps, count, ..) from step `first` on."""
        begin, self._next = max(first, self._next), first + len(rows[0])
        checked = slice(begin - first + -begin % self.checked_every, None, self.checked_every)
        loop, (q, nu) = self._loop, (each[checked] for each in rows[:2])
        if not (shape := q.shape[:2])[0]:
            return
        square, e = loop.errors(*(each.reshape(-1, each.shape[-1]) for each in (q, nu)))
        e = e.reshape(*shape, -1)
        size = loop.size(e)
        if begin == 0:
            self._first, self._predicted = size[0], e[0]
        edge = square.reshape(shape) < EDGE
        ends = [size <= SETTLED * self._first, edge, ~(size < DIVERGED * self._first)]
        code = np.select(ends, [1, 2, 3], 0)
        code = np.take_along_axis(code, (code > 0).argmax(axis=0)[None], axis=0)[0]
        self._code = np.where(self._code > 0, self._code, code)
        if self._step is not None:
            for each in e:
                self._worst = np.maximum(self._worst, loop.size(each - self._predicted))
                self._predicted = self._predicted @ self._step.T

    def outcome(self, _: int, stop: Array) -> dict[str, Array]:
        """Return the outcomes of the runs; `stop` are indices into STOPS."""
        code = np.where(self._code > 0, self._code, np.array([0, 3, 2, 0])[stop.astype(int)])
        error = self._worst / np.maximum(self._first, 1e-300)
        error = np.where((stop > 0.0) | (code > 1), np.nan, error)
        return {"outcome": code.astype(float), "error": error}


def settle(
    runs_of: Callable[[int], CampaignJob],
    starts: Callable[[NDArray[np.intp]], Array],
    runs: NDArray[np.intp],
    engine: str | None = None,
    fine: int = 0,
    **how: Any,
) -> dict[str, Array]:
    """Return the outcomes of runs; those that diverge are repeated in shorter steps.

    `runs_of` makes the runs in steps that have been shortened `fine` times, and `starts` returns
    the deviations (N, nx) from which runs (N,) start.
    """

    def rows(start: int, stop: int) -> Draws:
        some = runs[start:stop]
        return Draws(starts(some), some.astype(float))

    job = runs_of(fine)
    job.choose(engine)
    arrays = completed(job, rows, len(runs), **how)
    lost = np.flatnonzero(arrays["outcome"] == OUTCOMES.index("diverged"))
    if len(lost) and fine < _FINEST:
        how["progress"] = None
        again = settle(runs_of, starts, runs[lost], engine, fine + 1, **how)
        for key, values in again.items():
            arrays[key][lost] = values
    return arrays


def checked_loop(robot: Robot, lin: LinearModel, gain: Any) -> Loop:
    """Return the loop of a gain, or raise `InputError` where it cannot settle at the point."""
    if not isinstance(robot, Robot) or not isinstance(lin, LinearModel):
        given = f"robot has type {type(robot).__name__}, lin has type {type(lin).__name__}"
        raise InputError(f"{given}; expected a fflin.Robot and its fflin.LinearModel")
    K = StateFeedback(lin, as_double("gain", getattr(gain, "K", gain))).K
    kept = getattr(gain, "regulated", ())
    part = regulated_part(lin, any(f"qdot_m.{name}" in kept for name in wheel_inputs(lin)))
    if part.state_names == kept:  # the others, which are left to themselves, do not settle
        K, lin = K @ selection(kept, lin.state_names).T, part
    loop = Loop(robot, lin, K)
    require_fit(lin, robot, loop.state)
    if not len(lin.x0):
        raise InputError(f"the model of '{lin.robot}' has no states, so nothing can settle")
    if lin.moving or not lin.is_equilibrium() or lin.v.any():
        raise InputError(
            "the operating point is not an equilibrium at rest, so the loop cannot settle there; "
            "linearise about an equilibrium"
        )
    if not loop.decay > 0.0:
        raise InputError(
            f"the linear loop is not stable: a mode grows at {-loop.decay:.3g} 1/s; "
            "design the gain with fflin.lqr"
        )
    return loop
