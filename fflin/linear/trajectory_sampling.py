"""Sampled error dynamics along a motion, with du held constant over each sample."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.linear.sampling import GAUSS, HEAVY, LIGHT, held_exponential
from fflin.linear.trajectory import Trajectory

# Steps are halved until the transition of a sample is this accurate.
_ACCURACY, _MOST_PARTS = 1e-8, 64

# F = [[A, B], [0, 0]] (nx + nu, nx + nu), for how long [s], what it does (nx, nx + nu), and the
# times of what is HEAVY and LIGHT in it.
Steps = list[tuple[Array, float, Array, tuple[float, float]]]


def transitions(
    along: Trajectory, matrices: Callable[[float], tuple[Array, Array]], dt: float
) -> Iterator[tuple[Steps, Array]]:
    """Yield the steps of each sample, and what they do to the error and du (nx, nx + nu)."""
    times = along.samples(dt)
    if times[-1] != along.t[-1]:
        duration = along.t[-1] - along.t[0]
        raise InputError(
            f"dt is {dt:g} s, but the duration of the trajectory, {duration:g} s, is not a "
            "multiple of it; give a dt that divides the duration"
        )
    nx, nu = 12 + 2 * along.robot.n, along.u.shape[1]

    def at(t: float) -> Array:
        F = np.zeros((nx + nu, nx + nu))
        F[:nx, :nx], F[:nx, nx:] = matrices(t)
        return F

    def over(cuts: list[float], parts: int) -> tuple[Steps, Array]:
        steps, whole = [], np.eye(nx + nu)
        for start, end in pairwise(cuts):
            for a, b in pairwise(np.linspace(start, end, parts + 1).tolist()):
                early, late = ((t, at(t)) for t in (a + c * (b - a) for c in GAUSS))
                for (first, heavy), (second, light) in ((early, late), (late, early)):
                    F, h = HEAVY * heavy + LIGHT * light, 0.5 * (b - a)
                    step = np.column_stack(held_exponential(F[:nx, :nx], F[:nx, nx:], h))
                    steps.append((F, h, step, (first, second)))
                    whole[:nx] = step @ whole
        return steps, whole[:nx]

    parts = 1
    for start, end in pairwise(times.tolist()):
        near = 1e-9 * (end - start)
        inner = along.t[(along.t > start + near) & (along.t < end - near)]
        cuts, parts = [start, *inner.tolist(), end], max(1, parts // 4)
        steps, whole = over(cuts, parts)
        while parts < _MOST_PARTS:
            parts, coarse = 2 * parts, whole
            steps, whole = over(cuts, parts)
            apart, size = (np.abs(each).max(axis=0) for each in (whole - coarse, whole))
            if (apart <= _ACCURACY * size).all():
                break
        yield steps, whole
