"""Motion between the knots of a trajectory, and its error at the next knot."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from itertools import pairwise

import numpy as np
import pinocchio as pin

from fflin.base.rotation import rotation_matrices
from fflin.base.validation import Array
from fflin.dynamics.aba import Aba
from fflin.dynamics.integrators import CommutatorFree4
from fflin.dynamics.state import StateMap
from fflin.robot.mass_properties import rotor_names

# Steps are halved until the end of an interval has this accuracy, relative to the largest rates.
# There are at most _MOST_STEPS steps.
_ACCURACY, _MOST_STEPS = 1e-8, 128

# Rounding errors of positions, and of accelerations relative to the summed terms.
_EPS = float(np.finfo(float).eps)
_POSITION_ROUNDING, _SUM_ROUNDING = 16.0 * _EPS, 1e3 * _EPS

# A time that is less than this fraction of an interval away from a knot counts as the knot.
_NEAR = 1e-9


class Flow:
    """Motion between N knots with times t and rows of q, v and u; u is in the frame of `state`."""

    def __init__(self, state: StateMap, t: Array, q: Array, v: Array, u: Array, held: bool) -> None:
        self._model, self._aba, self._held = state.robot.model, Aba(state), held
        self._t, self._q, self._v, self._u = t, q, v, u

    @property
    def held(self) -> tuple[slice, ...]:
        """Slices of the inputs that form vectors in reference axes."""
        return self._aba.actuation.held

    @cached_property
    def residual(self) -> Array:
        """Error (N - 1,) at the end of each interval; see `interval_errors`."""
        return self.interval_errors(range(len(self._t) - 1))

    def interval_errors(self, intervals: Iterable[int]) -> Array:
        """Return the relative errors at the ends of integrated intervals, from the next knots."""
        # Rates are relative to an observer who moves at the base's median velocity (Galilean
        # invariance), and each rotor has its own scale. So neither a high orbital velocity nor a
        # fast wheel hides an error.
        t, u, state = self._t, self._u, self._aba.state
        rotations, q, v = rotation_matrices(self._q[:, 3:7]), self._q.copy(), self._v.copy()
        velocities = (rotations @ v[:, :3, None])[..., 0]
        usual = np.median(velocities, axis=0)
        flown = np.outer(t - t[0], usual)
        farthest = float(np.abs(q[:, 7:]).max(initial=1.0))
        digits = np.full(v.shape[1], _POSITION_ROUNDING * farthest)
        digits[:3] = _POSITION_ROUNDING * max(
            float(np.abs(x).max()) for x in (q[:, :3], flown, velocities)
        )
        q[:, :3] -= q[0, :3] + flown
        v[:, :3] -= usual @ rotations
        knots = list(zip(q, v, u, strict=True))
        sums = _largest([state.spread(self._aba.terms(*each)) for each in knots])
        rotors = rotor_names(state.robot)
        alone = [joint.idx_v for joint in state.robot.joints if joint.name in rotors]
        others = sorted({*range(6, len(digits))} - {*alone})
        groups = [[0, 1, 2], [3, 4, 5], *([each] for each in alone), *([others] if others else [])]
        speed, push = np.abs(v).max(axis=0), _largest([self.rate(*each) for each in knots])
        for group in groups:
            speed[group], push[group] = (x[group].max() or 1.0 for x in (speed, push))

        def size(of_q: Array, of_v: Array, h: float) -> float:
            miss = np.maximum(np.abs(of_q) - digits, 0.0) / (speed * h)
            jump = np.maximum(np.abs(of_v) - digits - _SUM_ROUNDING * sums * h, 0.0) / (push * h)
            return float(np.maximum(miss, jump).max())

        found, steps = [], 1
        # If the knots are not a motion of the robot, the integration may diverge. The residual
        # shows it.
        with np.errstate(all="ignore"):
            for k in intervals:
                steps, h = max(1, steps // 4), float(t[k + 1] - t[k])
                end = self.end(k, steps, q[k], v[k])
                while steps < _MOST_STEPS:
                    before, steps = end, 2 * steps
                    end = self.end(k, steps, q[k], v[k])
                    apart = pin.difference(self._model, before[0], end[0])
                    change = size(apart, end[1] - before[1], h)
                    if change <= _ACCURACY or not np.isfinite(change):
                        break
                apart = pin.difference(self._model, end[0], q[k + 1])
                found.append(size(apart, v[k + 1] - end[1], h))
        return np.where(np.isfinite(found), found, np.inf)

    def end(
        self, k: int, steps: int, q: Array, v: Array, over: tuple[float, float] = (0.0, 1.0)
    ) -> tuple[Array, Array]:
        """Integrate by CF4 (11.1) over part of an interval, by default all of it; return q, v."""
        start, h = self._t[k], self._t[k + 1] - self._t[k]
        method = CommutatorFree4(self._model, (over[1] - over[0]) * h / steps)
        for step in range(steps):
            q, v = method.step(
                lambda t, q, v: self.rate(q, v, self._input(k, (t - start) / h)),
                start + over[0] * h + step * method.dt,
                q,
                v,
            )
        return q, v

    def at(self, t: float) -> tuple[Array, Array, Array]:
        """Return q, v and u (base axes) at a time, by cubics that match the accelerations."""
        q, v, u = self.points(np.array([t]))
        return q[0], v[0], u[0]

    def points(self, times: Array) -> tuple[Array, Array, Array]:
        """Return q, v and u (k, ..) at times (k,); `at` returns them at one time."""
        placements = [interval_of(self._t, t) for t in times.tolist()]
        k, s = np.array([k for k, _ in placements]), np.array([s for _, s in placements])
        powers, (turns, speeds) = s[:, None] ** np.arange(4), self.cubics
        steps = np.einsum("ij,ijk->ik", powers, turns[k])
        pairs = zip(self._q[k], steps, strict=True)
        q = np.array([pin.integrate(self._model, *pair) for pair in pairs])
        u = np.array([self._input(*each) for each in placements])
        u = self._in_base_axes(q, u)
        return q, np.einsum("ij,ijk->ik", powers, speeds[k]), u

    def input(self, t: float) -> Array:
        """Return the inputs (nu,) just after a time, in the frame's axes."""
        return self._input(*interval_of(self._t, t))

    def _input(self, k: int, fraction: float) -> Array:
        u: Array = self._u[k]
        return u if self._held else u + fraction * (self._u[k + 1] - u)

    def _in_base_axes(self, q: Array, u: Array) -> Array:
        actuation, state = self._aba.actuation, self._aba.state
        return actuation.in_base_axes(state.charts(q), u) if actuation.held else u

    def rate(self, q: Array, v: Array, u: Array) -> Array:
        """Return dv/dt (nv,) for inputs u in the frame's axes."""
        return self._aba.acceleration(q, v, self._in_base_axes(q, u)).copy()

    @cached_property
    def cubics(self) -> tuple[Array, Array]:
        """Coefficients (N - 1, 4, nv) of v and of the displacement from each interval's start."""
        q, v, h = self._q, self._v, np.diff(self._t)[:, None]
        begin = np.array([self.rate(*each) for each in zip(q, v, self._u, strict=True)])
        end = begin[1:]
        if self._held:
            end = np.array([self.rate(*each) for each in zip(q[1:], v[1:], self._u, strict=False)])
        apart = np.array([pin.difference(self._model, *pair) for pair in pairwise(q)])
        wheels = [joint.idx_v for joint in self._aba.state.robot.joints if joint.unbounded]
        # The knots give the angle of a wheel only up to full turns. The wheel's speed gives the
        # number of turns.
        turns = (0.5 * h * (v[1:] + v[:-1]) - apart)[:, wheels] / (2.0 * np.pi)
        apart[:, wheels] += 2.0 * np.pi * np.round(turns)
        slopes = [
            pin.dDifference(self._model, *pair, pin.ArgumentPosition.ARG1) @ speed
            for pair, speed in zip(pairwise(q), v[1:], strict=True)
        ]
        return (
            cubic(np.zeros_like(apart), apart, h * v[:-1], h * slopes),
            cubic(v[:-1], v[1:], h * begin[:-1], h * end),
        )


def _largest(rows: list[Array]) -> Array:
    """Return the largest magnitudes (nv,) over rows; infinite or NaN entries count as zero."""
    sizes = np.abs(rows)
    largest: Array = np.where(sizes < np.inf, sizes, 0.0).max(axis=0)
    return largest


def interval_of(t: Array, time: float) -> tuple[int, float]:
    """Return the index of the interval that contains a time, and its elapsed fraction."""
    last = len(t) - 2
    k = max(0, min(int(t.searchsorted(time, "right")) - 1, last))
    fraction = float((time - t[k]) / (t[k + 1] - t[k]))
    if fraction > 1.0 - _NEAR and k < last:
        return k + 1, 0.0
    return k, 0.0 if fraction < _NEAR else min(fraction, 1.0)


def cubic(first: Array, last: Array, rate: Array, end_rate: Array) -> Array:
    """Return the coefficients (N - 1, 4, ..) of cubics over [0, 1] from values and derivatives."""
    apart = last - first
    return np.stack(
        (first, rate, 3 * apart - 2 * rate - end_rate, rate + end_rate - 2 * apart), axis=1
    )
