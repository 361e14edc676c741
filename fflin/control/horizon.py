"""Receding horizon: the quadratic program at each sample, and its solution by DAQP."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fflin.base.errors import FflinWarning, optional_package
from fflin.base.validation import Array, Indices, Mask, number, vector
from fflin.control.policies import Clock

# Settings of DAQP for rows scaled to length 1, relative to the typical width of the limits. _EXACT
# is the tolerance. _PRICE is the weight and _YIELDS the regularisation of soft limits. _VIOLATED is
# the smallest violation to report.
_EXACT, _PRICE, _YIELDS, _VIOLATED = 1e-9, 1e3, 1.0, 1e-6

# If the robot exceeds a limit by less than this fraction of the width between the limits, the
# violation is not reported.
_OVER = 1e-3

# _OPEN is DAQP's infinity, _SOFT is its code of a soft limit, and _SOFTENED is its exit flag for a
# plan that exceeds a soft limit. _MOST is the largest number of iterations.
_OPEN, _SOFT, _SOFTENED, _MOST = 1e30, 8, 2, 10_000


class Stage(NamedTuple):
    """Stage e' = A e + B d with d = u - u*, and limits of E e' + D d; input limits come first."""

    A: Array  # (nx, nx)
    B: Array  # (nx, nu)
    K: Array  # (nu, nx), gain of the regulator without limits
    L: Array  # (nu, nu): d = L z - K e costs z'z more than the regulator
    E: Array  # (m, nx)
    D: Array  # (m, nu)
    low: Array  # (m,)
    high: Array  # (m,)


class Matrices(NamedTuple):
    """Quadratic program over d = u - u* of N samples: min d'H d / 2 + g'd, low <= G d <= high.

    Attributes
    ----------
    H, g : ndarray (N nu, N nu), (N nu,)
        Cost.
    G, low, high : ndarray (m, N nu), (m,), (m,)
        Limits.
    soft : ndarray (m,) of bool
        Limits that may be exceeded if the program is otherwise infeasible.
    Phi, Gamma : ndarray (N + 1, nx, nx), (N + 1, nx, N nu)
        Predicted errors ``e_k = Phi_k e + Gamma_k d``.
    inputs : tuple of str
        Names "name[k]" of the entries of d.
    limits : tuple of str
        Names of the rows of G; limits of states and outputs apply at the end of sample k.
    """

    H: Array
    g: Array
    G: Array
    low: Array
    high: Array
    soft: Mask
    Phi: Array
    Gamma: Array
    inputs: tuple[str, ...]
    limits: tuple[str, ...]


def condensed(stages: Sequence[Stage], planned: bool) -> tuple[Array, Array, Array]:
    """Return errors, z and limited values as linear functions of e_0 and of z or d.

    The matrices have N nu + nx columns. The first N nu columns multiply z if `planned` is True and
    d otherwise. The last nx columns multiply e_0.
    """
    (nx, nu), size = stages[0].B.shape, len(stages) * stages[0].B.shape[1]
    e = np.eye(nx, size + nx, size)
    states, efforts, limited = [e], [], []
    for k, by in enumerate(stages):
        own = np.eye(nu, size + nx, k * nu)
        d = by.L @ own - by.K @ e if planned else own
        efforts.append(own if planned else np.linalg.solve(by.L, own + by.K @ e))
        e = by.A @ e + by.B @ d
        states.append(e)
        limited.append(by.E @ e + by.D @ d)
    return np.array(states), np.vstack(efforts), np.vstack(limited)


@dataclass(frozen=True, eq=False)
class Horizon:
    """Samples of a run; near the end of the run, the horizon is the last N samples."""

    stages: tuple[Stage, ...]
    samples: int  # N
    dt: float
    inputs: tuple[str, ...]
    acting: Indices  # indices of the inputs that have limits
    limited: tuple[str, ...]
    robot: str

    def window(self, t: float) -> tuple[Stage, ...]:
        """Return the N samples from time t on."""
        k = min(round(min(t / self.dt, len(self.stages))), len(self.stages) - self.samples)
        return self.stages[k : k + self.samples]

    def bounds(self, stages: Sequence[Stage]) -> tuple[Array, Array, Mask]:
        """Return the lower and upper limits (m,) of stages, and which of these limits are soft."""
        soft = np.tile(np.arange(len(self.limited)) >= len(self.acting), len(stages))
        low, high = (np.concatenate([each[i] for each in stages]) for i in (-2, -1))
        return low, high, soft

    def matrices(self, e: ArrayLike | None, t: float) -> Matrices:
        """Return the quadratic program at time t [s] for the deviation e (nx,) of the state."""
        stages = self.window(max(number("t", t), 0.0))
        nx, size = len(stages[0].A), len(self.inputs) * self.samples
        start = np.zeros(nx) if e is None else vector("e", e, nx, "a deviation of the state")
        states, z, limited = condensed(stages, planned=False)
        (low, high, soft), free = self.bounds(stages), limited[:, size:] @ start
        double = 2.0 * z[:, :size].T
        H, g = double @ z[:, :size], double @ (z[:, size:] @ start)
        names = (
            tuple(f"{name}[{k}]" for k in range(self.samples) for name in of)
            for of in (self.inputs, self.limited)
        )
        program = (H, g, limited[:, :size], low - free, high - free, soft)
        return Matrices(*program, states[..., size:], states[..., :size], *names)


_At = Callable[[float, Array, Array], tuple[Array, Array]]


class Receding:
    """Policy that applies the first input of each plan; `at(t, q, v)` returns u* and e."""

    def __init__(self, horizon: Horizon, at: _At | None = None) -> None:
        self.of, self._at, self._clock = horizon, at, Clock(horizon.dt)
        self._stages: tuple[Stage, ...] = ()
        self.solves = self.softened = self.unfinished = self.exceeded = 0
        self._worst, self._said, self._over, self._met = 0.0, "", _OVER, ""
        self._due: tuple[Stage, Array] | None = None  # the last sample and its input
        if horizon.limited:  # now, so that the first sample is not slower
            self._change(horizon.window(0.0))

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the run: plans, exceeded limits and failures of the solver."""
        said = (
            f"number of MPC plans, each of {self.of.samples} samples of {self.of.dt:g} s: "
            f"{self.solves}"
        )
        if self.softened:
            said += f"; plans that exceed a soft limit: {self.softened} (worst: {self._said})"
        if self.exceeded:
            said += f"; samples at which the robot exceeds a soft limit: {self.exceeded}"
            said += f" (worst: {self._met})"
        if self.unfinished:
            said += (
                "; plans without a solution, replaced by the saturated LQR command: "
                f"{self.unfinished}"
            )
        return (said,) if self.solves else ()

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        """Return the command (nu,) at a sample."""
        self._clock.tick(t)
        assert self._at is not None
        u, e = self._at(t, q, v)
        command: Array = u + self.step(t, e)
        return command

    def step(self, t: float, e: Array) -> Array:
        """Return the command (nu,) relative to u* for the error e (nx,)."""
        stages, acting = self.of.window(t), self.of.acting
        now, d = stages[0], -stages[0].K @ e
        if not self.of.limited:
            return d
        if not self._stages or stages[0] is not self._stages[0]:
            self._change(stages)
        free = self._free @ e
        self.solves += 1
        self._judge(t, e)
        z, flag = self._solved(free)
        if flag <= 0:  # solve again without a warm start
            self._start()
            z, flag = self._solved(free)
        if flag > 0:
            d += now.L @ z[: len(d)]
        if flag == _SOFTENED:
            self._count(t, free + self._G @ z)
        if flag <= 0:
            self.unfinished += 1
            if self.unfinished == 1:
                warnings.warn(
                    f"the MPC optimisation found no solution at t = {t:g} s (DAQP exit flag "
                    f"{flag}); at such samples, the LQR command is applied instead, saturated at "
                    "the input limits",
                    FflinWarning,
                    2,
                )
        d[acting] = np.clip(d[acting], now.low[: len(acting)], now.high[: len(acting)])
        self._due = now, d
        return d

    def _judge(self, t: float, e: Array) -> None:
        """Record soft limits that the robot exceeds because it differs from the model."""
        first = len(self.of.acting)
        if self._due is None or first == len(self.of.limited):
            return
        by, d = self._due
        reached, low, high = ((by.E @ e + by.D @ d)[first:], by.low[first:], by.high[first:])
        excess = np.maximum(low - reached, reached - high)
        fractions = excess / np.where(np.isfinite(high - low), high - low, 1.0)
        at = int(fractions.argmax())
        self.exceeded += bool(fractions[at] > _OVER)
        if fractions[at] > self._over:
            self._over = float(fractions[at])
            self._met = f"{self.of.limited[first + at]} by {excess[at]:.2g} at {t:.4g} s"

    def _count(self, t: float, reached: Array) -> None:
        """Record by how much a plan exceeds the soft limits."""
        excess = np.maximum(self._low - reached, reached - self._high) * self._soft
        row = int((fractions := excess * self._unit).argmax())
        self.softened += bool(fractions[row] > _VIOLATED * self._size)
        if fractions[row] > max(self._worst, _VIOLATED * self._size):
            sample, at = divmod(row, len(self.of.limited))
            self._worst, when = float(fractions[row]), t + (sample + 1) * self.of.dt
            self._said = f"{self.of.limited[at]} by {excess[row]:.2g} at {when:.4g} s"

    def _change(self, stages: tuple[Stage, ...]) -> None:
        fresh, self._stages = not self._stages, stages
        rows, size = condensed(stages, planned=True)[2], len(self.of.inputs) * self.of.samples
        low, high, self._soft = self.of.bounds(stages)
        self._G, self._free = rows[:, :size], rows[:, size:]
        length = np.linalg.norm(self._G, axis=1)
        moved = length > 1e-12 * length.max()  # drops limits that no input affects
        self._low, self._high = np.where(moved, low, -np.inf), np.where(moved, high, np.inf)
        self._unit = 1.0 / np.where(moved, length, 1.0)
        width = (self._high - self._low) * self._unit
        width = width[np.isfinite(width)]
        self._size = (float(np.median(width)) if len(width) else 1.0) or 1.0
        self._rows = self._G * self._unit[:, None]
        if fresh:
            self._start()
        else:
            self._model.update(A=self._rows)

    def _start(self) -> None:
        self._model = optional_package("daqp", "this needs the solver DAQP", "mpc").Model()
        self._model.settings = {"primal_tol": _EXACT * self._size, "iter_limit": _MOST}
        self._model.settings = {"w_soft": _PRICE * self._size, "rho_soft": _YIELDS}
        (m, size), kinds = self._rows.shape, (_SOFT * self._soft).astype(np.int32)
        open_ = np.full(m, _OPEN)
        self._model.setup(np.eye(size), np.zeros(size), self._rows, open_, -open_, kinds)

    def _solved(self, free: Array) -> tuple[Array, int]:
        low, high = (
            np.clip((limit - free) * self._unit, -_OPEN, _OPEN) for limit in (self._low, self._high)
        )
        self._model.update(bupper=high, blower=low)
        z, _, flag, _ = self._model.solve()
        return z, int(flag)
