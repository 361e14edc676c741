"""Linear models about many points at once, by the compiled kernel."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from operator import itemgetter
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fflin.base.rotation import product_matrix, rotation_matrices
from fflin.base.validation import Array
from fflin.batch.rows import Points
from fflin.dynamics.chart import SMALLEST_Q0, Chart, Standing
from fflin.dynamics.inertia import Inertia
from fflin.dynamics.rnea import Rates
from fflin.kernel.accelerations import BatchAccelerations, inverse_inertias
from fflin.kernel.tree import LANES, Tree, batch_tree
from fflin.linear.linearization import LARGEST
from fflin.linear.prepared import Prepared
from fflin.linear.state_equations import assemble, drift
from fflin.robot.frames import ROOT

# Up to this angle the kernel's sines and cosines are exact to rounding [rad].
_FARTHEST = 1e6

RowNumbers: TypeAlias = NDArray[np.integer[Any]]
Mask: TypeAlias = NDArray[np.bool_]


class BatchEquations(ABC):
    """What differs from point to point of a robot's linear models, about many points."""

    BLOCK: ClassVar[int]  # points that are done at a time

    def __init__(self, prepared: Prepared, tree: Tree) -> None:
        self._prepared, self._tree = prepared, tree
        self._least_coupling = 0.999 * (6 + prepared.robot.n)

    def write(self, points: Points, out: Mapping[str, Array]) -> RowNumbers:
        """Write what differs from point to point, and return the rows that are left.

        Left are those that the linearizer refuses or warns of: where M is singular or nearly so,
        the chart ends, or numbers are beyond all sense. `out` has B_lower and, but at rest, A, f0,
        _x0 and with a moving reference _drift, each with as many rows.
        """
        count = len(points.q)
        if count < LANES:
            more = {key: np.empty((LANES, *array.shape[1:])) for key, array in out.items()}
            left = self.write(points.each(_filled), more)
            for key, array in out.items():
                array[:] = more[key][:count]
            return left[left < count]
        good = np.zeros(count, dtype=bool)
        for start in range(0, count, self.BLOCK):
            # The last block begins early enough to fill the lanes; some points are done twice.
            rows = slice(min(start, count - LANES), start + self.BLOCK)
            place = {key: array[rows] for key, array in out.items()}
            point = points.each(itemgetter(rows))
            with np.errstate(all="ignore"):
                good[rows] = self._write_block(point, place)
        return np.flatnonzero(~good)

    @abstractmethod
    def _write_block(self, points: Points, out: Mapping[str, Array]) -> Mask:
        """Do the points of a block and return which of them are good."""

    def _regular(self, q: Array, couplings: Array) -> Mask:
        """Return where M is far from singular, and the angles are such that their sines are."""
        # NaN, from a pivot that is zero, compares false.
        good = (self._least_coupling < couplings) & (couplings < Inertia.warning_coupling)
        near = np.abs(q[:, 7:]) < _FARTHEST
        return good if near.all() else good & near.all(axis=1)


class RestEquations(BatchEquations):
    """B = [0; M^-1 F] at rest, where only u acts, through columns F that do not depend on q."""

    BLOCK = 2**16

    def _write_block(self, points: Points, out: Mapping[str, Array]) -> Mask:
        q, B, actuation = points.q, out["B_lower"], self._prepared.actuation
        nv = B.shape[1]
        inverse = B if actuation.default else np.empty((len(q), nv, nv))
        couplings = inverse_inertias(self._tree, q, inverse)
        if not actuation.default:
            np.matmul(inverse, actuation.fixed, out=B)
        return self._regular(q, couplings)


class PointEquations(BatchEquations):
    """A, B and f0 about any points."""

    BLOCK = 256  # what is computed on the way stays in the cache

    def __init__(self, prepared: Prepared, tree: Tree) -> None:
        super().__init__(prepared, tree)
        self._accelerations = BatchAccelerations(prepared.map, prepared.actuation, tree)
        self._root = prepared.robot.model.jointPlacements[ROOT].rotation

    def _write_block(self, points: Points, out: Mapping[str, Array]) -> Mask:
        prepared, state, actuation = self._prepared, self._prepared.map, self._prepared.actuation
        q, v, u = points
        count, nv, groups = len(q), state.nx // 2, state.groups
        nu: Array = np.zeros((count, nv)) if v is None else state.velocities(v)
        if u is None:
            u = np.zeros((count, len(actuation.names)))
        q_m = state.joint_positions(q)
        chart, r_b, within = self._place(q)
        u_base = actuation.in_base_axes(chart, u)
        stiffness, damping, rest = state.robot.springs
        forces = u_base @ actuation.fixed.T
        forces[:, 6:] -= stiffness * (q_m - rest) + damping * nu[:, 6:]
        A = out["A"] if "A" in out else np.empty((count, state.nx, state.nx))
        B = out["B_lower"]
        A[:] = prepared.rest["A"]
        found = self._accelerations.rates(q, nu, forces, u_base, A)
        B[:] = found.inverse if actuation.default else found.inverse @ actuation.fixed
        if actuation.carried:
            B[:, :, self._accelerations.carried] = found.inverse @ found.columns
        lower = A[:, nv:]
        rates = Rates(found.c, lower[..., groups.q_m], lower[..., nv:], B, self._gravity(q))
        f0 = assemble(state, actuation, chart, nu, u_base, rates, A, B, moving=prepared.moving)
        values = {"_x0": state.compose(chart, r_b, q_m, nu), "f0": f0}
        if prepared.moving:
            values |= {"_drift": drift(state, f0, rates.gravity), "f0": np.zeros_like(f0)}
        for key in values.keys() & out.keys():
            out[key][:] = values[key]
        good = within & self._regular(q, found.couplings)
        # NaN compares false.
        for array in (lower, B, values["f0"][:, None]):
            good &= np.einsum("ijk,ijk->i", array, array) < LARGEST
        return good

    def _place(self, q: Array) -> tuple[Chart, Array, Mask]:
        """Return the chart and the base's position, and where the chart reaches."""
        if self._prepared.own_reference:
            chart: Chart = Standing(len(q))
            return chart, chart.q_b, np.ones(len(q), dtype=bool)
        state = self._prepared.map
        quaternions = q[:, 3:7] @ product_matrix(state.origin_quaternion).T
        quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
        quaternions[quaternions[:, 3] < 0.0] *= -1.0
        q0 = quaternions[:, 3:]
        chart = Chart(quaternions[:, :3], q0, rotation_matrices(quaternions))
        return chart, state.positions(q), q0[:, 0] >= SMALLEST_Q0

    def _gravity(self, q: Array) -> Array:
        gravity = np.array(self._prepared.robot.gravity)
        if not gravity.any():
            return gravity
        components: Array = (self._root.T @ gravity) @ rotation_matrices(q[:, 3:7])
        return components


def _filled(rows: Array) -> Array:
    """Return as many rows as lanes, the last of them repeated."""
    return np.pad(rows, ((0, LANES - len(rows)), (0, 0)), mode="edge")


def batch_equations(prepared: Prepared, *, only_inertia: bool) -> BatchEquations | None:
    """Return the equations of a robot, or None where the kernel does not know them.

    It differentiates no outputs, and knows joints that are screws about fixed axes. Where
    `only_inertia`, all but B is known beforehand.
    """
    tree = batch_tree(prepared.robot)
    if tree is None or prepared.sensing is not None:
        return None
    simple = only_inertia and not prepared.actuation.carried
    return (RestEquations if simple else PointEquations)(prepared, tree)
