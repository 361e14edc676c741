"""The plan of a receding horizon, sample by sample: the quadratic program and who solves it."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fflin.base.errors import FflinWarning, InputError, MissingPackageError
from fflin.base.validation import Array, number, vector

# DAQP has no infinity. A limit in a row of length 1 is kept to this, in shares of the limits' size.
_OPEN, _EXACT = 1e30, 1e-9

# The price of passing a soft limit, in the same shares: by the first power, so that it is passed
# where nothing else is left, and beyond that by the square over this.
_PRICE, _YIELDS = 1e5, 1e-6

# DAQP's words for a soft limit and for a plan that passes one, and how far that is, as above.
_SOFT, _PASSES, _PASSED = 8, 2, 1e-6

_MOST = 10_000  # iterations


class Stage(NamedTuple):
    """A sample, e' = A e + B d with d = u - u*, and limits on E e' + D d, first those of inputs."""

    A: Array  # (nx, nx)
    B: Array  # (nx, nu)
    K: Array  # (nu, nx), of the regulator that no limit hinders
    L: Array  # (nu, nu): d = L z - K e costs z'z more than that one
    E: Array  # (m, nx)
    D: Array  # (m, nu)
    low: Array  # (m,)
    high: Array  # (m,)


class Matrices(NamedTuple):
    r"""The quadratic program of a horizon, for any solver.

    Over the deviations :math:`d = (u_0 - u^*_0, \dots, u_{N-1} - u^*_{N-1})` it is the least of

    .. math:: \tfrac12 d^T H d + g^T d, \qquad \mathrm{low} \le G\,d \le \mathrm{high},

    where the deviations of the state are :math:`e_k = \Phi_k e_0 + \Gamma_k d`. What is in `soft`
    may be passed where nothing else is left.
    """

    H: Array  # (N nu, N nu)
    g: Array  # (N nu,)
    G: Array  # (m, N nu)
    low: Array  # (m,)
    high: Array  # (m,)
    soft: NDArray[np.bool_]  # (m,)
    Phi: Array  # (N + 1, nx, nx)
    Gamma: Array  # (N + 1, nx, N nu)
    inputs: tuple[str, ...]  # "name[k]" of d
    limits: tuple[str, ...]  # "name[k]" of the rows of G, at the end of sample k but for inputs


def condensed(stages: Sequence[Stage], planned: bool) -> tuple[Array, Array, Array]:
    """Return e (N + 1, nx, ..), z or d (N nu, ..) and what is limited (m, ..) of (d or z, e_0)."""
    nx, nu = stages[0].B.shape
    size = len(stages) * nu
    e = np.eye(nx, size + nx, size)
    states, others, limited = [e], [], []
    for k, by in enumerate(stages):
        own = np.eye(nu, size + nx, k * nu)
        z, d = (own, by.L @ own - by.K @ e) if planned else (by.K @ e + own, own)
        others.append(d if planned else np.linalg.solve(by.L, z))
        e = by.A @ e + by.B @ d
        states.append(e)
        limited.append(by.E @ e + by.D @ d)
    return np.array(states), np.vstack(others), np.vstack(limited)


@dataclass(frozen=True, eq=False)
class Horizon:
    """The samples that a horizon passes over, of which the last N stay."""

    stages: tuple[Stage, ...]
    samples: int  # N
    acting: list[int]  # inputs that are limited
    dt: float
    inputs: tuple[str, ...]
    limited: tuple[str, ...]

    @cached_property
    def _last(self) -> tuple[Stage, ...]:
        return self.stages[-self.samples :]

    def window(self, k: int) -> tuple[Stage, ...]:
        """Return the stages ahead of sample k; the same object where they are the same."""
        beyond = k >= len(self.stages) - self.samples
        return self._last if beyond else self.stages[k : k + self.samples]

    def matrices(self, e: ArrayLike | None, t: float) -> Matrices:
        """Return the program of a sample at the deviation e (nx,) of the state."""
        if (t := number("t", t)) < 0.0:
            raise InputError(f"t is {t:g} s, expected 0 or more")
        stages = self.window(round(min(t / self.dt, len(self.stages))))
        nx, size = len(stages[0].A), len(self.inputs) * self.samples
        start = np.zeros(nx) if e is None else vector("e", e, nx, "a deviation of the state")
        states, z, limited = condensed(stages, planned=False)
        of_d, of_e = z[:, :size], z[:, size:] @ start
        free = limited[:, size:] @ start
        low, high = (np.concatenate([getattr(s, at) for s in stages]) for at in ("low", "high"))
        hard = np.arange(len(self.limited)) < len(self.acting)
        named = [
            [f"{x}[{k}]" for k in range(len(stages)) for x in of]
            for of in (self.inputs, self.limited)
        ]
        return Matrices(
            *(2.0 * of_d.T @ of_d, 2.0 * of_d.T @ of_e, limited[:, :size], low - free, high - free),
            *(np.tile(~hard, len(stages)), states[..., size:], states[..., :size]),
            *map(tuple, named),
        )


class Receding:
    """The commands of a run: at each sample the first of the plan that costs least."""

    def __init__(self, horizon: Horizon) -> None:
        self.of = horizon
        self._stages: tuple[Stage, ...] = ()
        self.solves = self.softened = self.unfinished = 0
        self._worst, self._said = 0.0, ""

    def step(self, t: float, e: Array) -> Array:
        """Return the command (nu,) as the deviation from its target, at the state's e (nx,)."""
        stages = self.of.window(round(t / self.of.dt))
        now, acting = stages[0], self.of.acting
        d: Array = -now.K @ e
        if not self.of.limited:
            return d
        if stages is not self._stages:
            self._change(stages)
        free = self._free @ e
        low, high = self._low - free, self._high - free
        self.solves += 1
        z, flag = self._solved(low, high)
        if flag <= 0:  # once more, from nothing
            self._start()
            z, flag = self._solved(low, high)
        if flag > 0:
            d += now.L @ z[: len(d)]
            if flag == _PASSES:
                self._count(t, self._G @ z + free)
        else:
            self.unfinished += 1
            if self.unfinished == 1:
                warnings.warn(
                    f"the plan at t = {t:g} s was not found (DAQP ends with {flag}); where that is "
                    "so the regulator acts, cut at the limits of the inputs",
                    FflinWarning,
                    stacklevel=2,
                )
        d[acting] = np.clip(d[acting], now.low[: len(acting)], now.high[: len(acting)])
        return d

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be said of the run."""
        said = f"{self.solves} plans of {self.of.samples} samples of {self.of.dt:g} s"
        if self.softened:
            said += f", {self.softened} of them beyond a limit, the farthest {self._said}"
        if self.unfinished:
            said += f"; {self.unfinished} not found, where the regulator acted, cut at the limits"
        return (said,)

    def _change(self, stages: tuple[Stage, ...]) -> None:
        fresh, self._stages = not self._stages, stages
        _, _, rows = condensed(stages, planned=True)
        size = len(self.of.inputs) * self.of.samples
        self._G, self._free = rows[:, :size], rows[:, size:]
        self._low, self._high = (np.concatenate([s[i] for s in stages]) for i in (-2, -1))
        soft = np.arange(len(self.of.limited)) >= len(self.of.acting)
        self._soft = np.tile(soft, len(stages))
        length = np.linalg.norm(self._G, axis=1)
        # What no input moves within the horizon is no limit of it.
        self._moved = length > 1e-12 * length.max()
        self._unit = 1.0 / np.where(self._moved, length, 1.0)
        width = ((self._high - self._low) * self._unit)[self._moved]
        width = width[np.isfinite(width) & (width > 0.0)]
        self._size = float(np.median(width)) if len(width) else 1.0
        self._rows = self._G * self._unit[:, None]
        self._unit /= self._size
        if fresh:
            self._start()
        else:
            self._model.update(A=self._rows)

    def _start(self) -> None:
        try:
            import daqp
        except ImportError:
            raise MissingPackageError(
                "this needs the solver DAQP; install it with: pip install 'fflin[mpc]'"
            ) from None
        self._model: Any = daqp.Model()
        self._model.settings = {
            **{"primal_tol": _EXACT, "iter_limit": _MOST, "w_soft": _PRICE, "rho_soft": _YIELDS}
        }
        m, size = self._rows.shape
        open_, kinds = np.full(m, _OPEN), (_SOFT * self._soft).astype(np.int32)
        self._model.setup(np.eye(size), np.zeros(size), self._rows, open_, -open_, kinds)

    def _solved(self, low: Array, high: Array) -> tuple[Array, int]:
        with np.errstate(invalid="ignore"):
            low, high = (
                np.where(self._moved, np.clip(x * self._unit, -_OPEN, _OPEN), y)
                for x, y in ((low, -_OPEN), (high, _OPEN))
            )
        self._model.update(bupper=high, blower=low)
        z, _, flag, _ = self._model.solve()
        return self._size * z, int(flag)

    def _count(self, t: float, reached: Array) -> None:
        """Note how far the plan goes beyond the soft limits."""
        excess = np.maximum(self._low - reached, reached - self._high) * self._soft
        share = excess * self._unit
        self.softened += bool(share.max() > _PASSED)
        if share.max() > self._worst:
            self._worst, row = float(share.max()), int(share.argmax())
            sample, at = divmod(row, len(self.of.limited))
            when = t + (sample + 1) * self.of.dt
            self._said = f"{self.of.limited[at]} by {excess[row]:.2g} at {when:.4g} s"
