"""Accelerations of many points by the compiled kernel, which reads a robot and what acts on it."""

from __future__ import annotations

from collections import namedtuple
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fflin.base.validation import Array
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.inertia import LARGEST_SHARE, Inertia, bounds_of
from fflin.dynamics.rnea import Accelerations, Rates
from fflin.dynamics.state import StateMap
from fflin.kernel.compiled import kernel
from fflin.kernel.tree import LANES, Tree, layout_of, loads_of, work_space

Mask: TypeAlias = NDArray[np.bool_]

_FARTHEST = 1e6  # [rad], up to which the kernel's sines and cosines are exact to rounding


class Packed(namedtuple("Packed", "q nu force u")):
    """Eight points, lane beside lane."""


class Derived(namedtuple("Derived", "tree layout loads row bounds slopes by_u judged size")):
    """A robot as `derive` reads it, and where its results begin in the work space; its size.

    `row` is the coordinate that each input pushes, -1 for one that is carried, and `bounds` those
    of `inertia_bounds`, 0 where they are not known.
    """


class RowRates:
    """Accelerations of rows of points, their slopes and M^-1, by the compiled kernel.

    Of every point are judged the sum of the couplings M_ii (M^-1)_ii, and that of (M^-1)_ii over
    what mass and place of the links would allow; see `Inertia`.
    """

    def __init__(self, state: StateMap, actuation: Actuation, tree: Tree) -> None:
        robot, nv, fixed = state.robot, state.nx // 2, actuation.fixed
        loads, bounds = loads_of(robot, actuation, tree), bounds_of(robot)
        layout, nu = layout_of(tree, len(loads.input)), fixed.shape[1]
        ends = np.cumsum((layout.size, nv * state.nx, nv * nu, 2))
        self._robot = Derived(
            *(tree, layout, loads),
            np.where(fixed.any(axis=0), np.abs(fixed).argmax(axis=0), -1).astype(np.intp),
            np.zeros(nv) if bounds is None else state.velocities(bounds),
            *map(int, ends),
        )
        self.state, self._actuation = state, actuation
        self._sizes = robot.nq, nv, nv, nu
        self._least_coupling = 0.999 * nv

    def write_inverse(self, q: Array, by_u: Array) -> Array:
        """Write the slopes over u (N, 6 + n, nu); return what is judged (N, 2)."""
        none = np.empty((0, 0))
        return self._derive((q, none, none, none), none, none, by_u, moves=False)

    def write(
        self, q: Array, nu: Array, q_m: Array, u: Array, A: Array, by_u: Array
    ) -> tuple[Array, Array]:
        """Write slopes and by_u of `Rates`; return c (N, 6 + n) and what is judged (N, 2).

        The slopes are the lower halves of A (N, nx, nx). Both arrays are C-contiguous; nu and u
        are in base axes.
        """
        force = u @ self._actuation.fixed.T
        force[:, 6:] += self.state.robot.springs.force(q_m, nu[:, 6:])
        c = np.empty(nu.shape)
        flat = A.reshape(len(q), -1)
        return c, self._derive((q, nu, force, u), c, flat, by_u, moves=True)

    def sound(self, q: Array, judged: Array) -> Mask:
        """Return where (N,) M is far from singular and the kernel's sines are exact."""
        # NaN, from a pivot that is zero, compares false.
        coupling, q_m = judged[:, 0], q[:, 7:]
        good = (self._least_coupling < coupling) & (coupling < Inertia.warning_coupling)
        if q_m.max(initial=0.0) < _FARTHEST and q_m.min(initial=0.0) > -_FARTHEST:
            return good
        return good & (np.abs(q_m) < _FARTHEST).all(axis=1)

    def _derive(
        self, points: tuple[Array, ...], c: Array, A: Array, by_u: Array, *, moves: bool
    ) -> Array:
        count, judged = len(points[0]), np.empty((len(points[0]), 2))
        kernel("derivatives", "derive")(
            self._robot,
            tuple(map(_writable, points)),
            (c, A, by_u.reshape(count, -1), judged),
            Packed(*map(work_space, self._sizes)),
            work_space(self._robot.size),
            moves,
        )
        return judged


class RowOfOne:
    """`Accelerations` of one point by the compiled kernel, where that can vouch for it."""

    def __init__(self, rows: RowRates, otherwise: Accelerations) -> None:
        self._rows, self._otherwise = rows, otherwise

    def rates(
        self, q: Array, v: Array, nu: Array, q_m: Array, u: Array, slopes: Array, by_u: Array
    ) -> Rates:
        """Return the rates as `Accelerations.rates` does."""
        eight_q, eight_nu, eight_q_m, eight_u = (
            np.repeat(each[None], LANES, axis=0) for each in (q, nu, q_m, u)
        )
        all_slopes, all_by_u = (np.empty((LANES, *each.shape)) for each in (slopes, by_u))
        c, judged = self._rows.write(eight_q, eight_nu, eight_q_m, eight_u, all_slopes, all_by_u)
        if not (self._rows.sound(q[None], judged[:1]).all() and judged[0, 1] < LARGEST_SHARE):
            return self._otherwise.rates(q, v, nu, q_m, u, slopes, by_u)
        slopes[:], by_u[:] = all_slopes[0], all_by_u[0]
        return Rates(c[0], slopes, by_u, self._rows.state.gravity(q))


def _writable(rows: Array) -> Array:
    """Return rows that may be written, copied if need be: numba compiles for either kind."""
    return np.require(rows, np.float64, ("C", "W"))
