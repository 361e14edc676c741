"""Linear models about many points by the compiled kernel."""

from __future__ import annotations

from collections.abc import Mapping
from operator import itemgetter
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fflin.base.validation import Array
from fflin.batch.rows import Points
from fflin.dynamics.chart import SMALLEST_Q0
from fflin.dynamics.inertia import Inertia
from fflin.kernel.accelerations import inverse_inertias
from fflin.kernel.points import PointKernel
from fflin.kernel.tree import LANES, Tree, batch_tree
from fflin.linear.prepared import LARGEST, Prepared

# Up to this angle the kernel's sines and cosines are exact to machine precision [rad].
_FARTHEST = 1e6

RowNumbers: TypeAlias = NDArray[np.integer[Any]]
Mask: TypeAlias = NDArray[np.bool_]


class BatchEquations:
    """Equations of a robot's linear models about many points, for the arrays that vary."""

    def __init__(self, prepared: Prepared, tree: Tree, kernel: PointKernel | None) -> None:
        self._prepared, self._tree, self._kernel = prepared, tree, kernel
        self._block = 1024 if kernel else 2**16  # points that are done at a time
        self._least_coupling = 0.999 * (6 + prepared.robot.n)

    def write(self, points: Points, out: Mapping[str, Array]) -> RowNumbers:
        """Write the arrays that vary between points, and return the rows not computed."""
        count = len(points.q)
        if count < LANES:
            more = {key: np.empty((LANES, *array.shape[1:])) for key, array in out.items()}
            left = self.write(points.each(_filled), more)
            for key, array in out.items():
                array[:] = more[key][:count]
            return left[left < count]
        good = np.zeros(count, dtype=bool)
        for start in range(0, count, self._block):
            # The last block begins early enough to fill the lanes; some points are done twice.
            rows = slice(min(start, count - LANES), start + self._block)
            place = {key: array[rows] for key, array in out.items()}
            point = points.each(itemgetter(rows))
            with np.errstate(all="ignore"):
                good[rows] = (
                    self._anywhere(self._kernel, point, place)
                    if self._kernel
                    else self._at_rest(point.q, place["B_lower"])
                )
        return np.flatnonzero(~good)

    def _regular(self, q: Array, couplings: Array) -> Mask:
        """Return where M is far from singular, and the angles are such that their sines are."""
        # NaN, from a pivot that is zero, compares false.
        good = (self._least_coupling < couplings) & (couplings < Inertia.warning_coupling)
        q_m = q[:, 7:]
        if q_m.max(initial=0.0) < _FARTHEST and q_m.min(initial=0.0) > -_FARTHEST:
            return good
        return good & (np.abs(q_m) < _FARTHEST).all(axis=1)

    def _at_rest(self, q: Array, B: Array) -> Mask:
        """Write M^-1 F at rest, where only u acts, through columns F that do not depend on q."""
        nv, actuation = B.shape[1], self._prepared.actuation
        inverse = B if actuation.default else np.empty((len(q), nv, nv))
        couplings = inverse_inertias(self._tree, q, inverse)
        if not actuation.default:
            np.matmul(inverse, actuation.fixed, out=B)
        return self._regular(q, couplings)

    def _anywhere(self, kernel: PointKernel, points: Points, out: Mapping[str, Array]) -> Mask:
        """Write A, B and f0 about any points."""
        state, nu = self._prepared.map, len(self._prepared.actuation.names)
        (q, v, u), nx = points, state.nx
        v = np.zeros((len(q), state.robot.nv)) if v is None else v
        u = np.zeros((len(q), nu)) if u is None else u
        rate = "_drift" if self._prepared.moving else "f0"
        shapes = {"A": (nx, nx), "B_lower": (nx // 2, nu), rate: (nx,), "_x0": (nx,)}
        found = [out[key] if key in out else np.empty((len(q), *x)) for key, x in shapes.items()]
        coupling, squares, q0 = kernel.many(q, v, u, found).T
        if self._prepared.moving and "f0" in out:
            out["f0"][:] = 0.0
        # NaN compares false.
        return self._regular(q, coupling) & (squares < LARGEST) & (q0 >= SMALLEST_Q0)


def _filled(rows: Array) -> Array:
    """Return as many rows as lanes, the last of them repeated."""
    return np.pad(rows, ((0, LANES - len(rows)), (0, 0)), mode="edge")


def batch_equations(prepared: Prepared, *, only_inertia: bool) -> BatchEquations | None:
    """Return the equations of a robot, or None where the kernel does not know them."""
    tree = batch_tree(prepared.robot)
    if tree is None or prepared.sensing is not None:
        return None
    simple = only_inertia and not prepared.actuation.carried
    return BatchEquations(prepared, tree, None if simple else prepared.kernel())
