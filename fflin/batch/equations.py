"""Linear models about many points at once, by the compiled kernel."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fflin.base.rotation import product_matrix, rotation_matrices
from fflin.base.validation import Array
from fflin.batch.inertia import FARTHEST, Rows
from fflin.dynamics.chart import SMALLEST_Q0, Chart, Standing
from fflin.dynamics.inertia import Inertia
from fflin.dynamics.rnea import Rates
from fflin.kernel.accelerations import BatchRates, Points, Written
from fflin.kernel.tree import LANES, batch_tree
from fflin.linear.linearization import LARGEST, Linearizer
from fflin.linear.state_equations import assemble, drift
from fflin.robot.frames import ROOT

# Points that are done at a time, so that what is computed on the way stays in the cache.
_BLOCK = 256


class BatchEquations:
    """A, B and f0 about many points, as a `Linearizer` of the robot has them about each.

    Parameters
    ----------
    linearizer : Linearizer
        Without outputs but the state; see `possible`.
    """

    def __init__(self, linearizer: Linearizer) -> None:
        self._prepared = linearizer.prepared
        self._state, self._actuation = self._prepared.map, self._prepared.actuation
        self._rates = BatchRates(self._state, self._actuation)
        robot = linearizer.robot
        self._root = robot.model.jointPlacements[ROOT].rotation
        self._least_coupling = 0.999 * (6 + robot.n)

    @staticmethod
    def possible(linearizer: Linearizer) -> bool:
        """Whether the kernel knows the robot's joints, and no output is to be differentiated."""
        return linearizer.prepared.sensing is None and batch_tree(linearizer.robot) is not None

    def write(self, q: Array, v: Array | None, u: Array | None, out: Mapping[str, Array]) -> Rows:
        """Write what differs from point to point, and return the rows that are left.

        Left are those that the linearizer refuses or warns of: where M is singular or nearly so,
        the chart ends, or numbers are beyond all sense.

        Parameters
        ----------
        q, v, u : ndarray (N, nq), (N, nv), (N, nu)
            Valid points; None for rest and no input.
        out : mapping
            A, B_lower, f0, _x0 and, with a moving reference, _drift, each with N rows.
        """
        nv, nu = self._state.nx // 2, len(self._actuation.names)
        good = np.zeros(len(q), dtype=bool)
        for start in range(0, len(q), _BLOCK):
            rows = slice(start, start + _BLOCK)
            count = len(q[rows])
            velocities: Array = np.zeros((count, nv))
            if v is not None:
                velocities = self._state.velocities(v[rows])
            inputs: Array = np.zeros((count, nu)) if u is None else u[rows]
            place = {key: array[rows] for key, array in out.items()}
            with np.errstate(all="ignore"):
                good[rows] = self._block(q[rows], velocities, inputs, place)
        return np.flatnonzero(~good)

    def _block(self, q: Array, nu: Array, u: Array, out: Mapping[str, Array]) -> NDArray[np.bool_]:
        state, groups, nv = self._state, self._state.groups, self._state.nx // 2
        q_m = state.joint_positions(q)
        chart, r_b, within = self._place(q)
        u_base = self._actuation.in_base_axes(chart, u)
        stiffness, damping, rest = state.robot.passive
        forces = u_base @ self._actuation.fixed.T
        forces[:, 6:] -= stiffness * (q_m - rest) + damping * nu[:, 6:]
        A, B = out["A"], out["B_lower"]
        A[:] = self._prepared.rest["A"]
        written = self._evaluate(Points(q, nu, forces, u_base), A)
        self._set_inputs(written, B)
        lower = A[:, nv:]
        rates = Rates(written.c, lower[..., groups.q_m], lower[..., nv:], B, self._gravity(q))
        moving = self._prepared.moving
        f0 = assemble(state, self._actuation, chart, nu, u_base, rates, A, B, moving=moving)
        if moving:
            out["_drift"][:] = drift(state, f0, rates.gravity)
        out["f0"][:] = 0.0 if moving else f0
        out["_x0"][:] = state.compose(chart, r_b, q_m, nu)
        good = within & (np.abs(q[:, 7:]) < FARTHEST).all(axis=1)
        good &= self._least_coupling < written.couplings
        good &= written.couplings < Inertia.warning_coupling
        # What is not finite shows in these, NaN too.
        for array in (A[:, nv:], B, out["f0"][:, None]):
            good &= np.einsum("ijk,ijk->i", array, array) < LARGEST
        return good

    def _evaluate(self, points: Points, A: Array) -> Written:
        """Return the rates, their slopes in the lower half of A."""
        count, nv = points.nu.shape
        carried = len(self._rates.carried)
        if count < LANES:
            filled = Points(*(np.pad(x, ((0, LANES - count), (0, 0)), mode="edge") for x in points))
            slopes: Array = np.zeros((LANES, *A.shape[1:]))
            rates = self._evaluate(filled, slopes)
            A[:, nv:] = slopes[:count, nv:]
            return Written(*(array[:count] for array in rates))
        rates = Written(
            np.empty((count, nv, nv)),
            np.empty((count, nv)),
            A.reshape(count, -1),
            np.empty((count, nv * carried)),
            np.empty(count),
        )
        self._rates.evaluate(points, rates)
        return rates

    def _set_inputs(self, rates: Written, B: Array) -> None:
        if self._actuation.default:
            B[:] = rates.inverse
            return
        np.matmul(rates.inverse, self._actuation.fixed, out=B)
        carried = self._rates.carried
        if len(carried):
            columns = rates.columns.reshape(len(B), -1, len(carried))
            B[:, :, carried] = rates.inverse @ columns

    def _place(self, q: Array) -> tuple[Chart, Array, NDArray[np.bool_]]:
        """Return the chart and the base's position, and where the chart reaches."""
        if self._prepared.own_reference:
            chart: Chart = Standing(len(q))
            return chart, chart.q_b, np.ones(len(q), dtype=bool)
        quaternions = q[:, 3:7] @ product_matrix(self._state.origin_quaternion).T
        quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
        quaternions[quaternions[:, 3] < 0.0] *= -1.0
        q0 = quaternions[:, 3:]
        chart = Chart(quaternions[:, :3], q0, rotation_matrices(quaternions))
        return chart, self._state.positions(q), q0[:, 0] >= SMALLEST_Q0

    def _gravity(self, q: Array) -> Array:
        gravity = np.array(self._state.robot.gravity)
        if not gravity.any():
            return gravity
        rotations = rotation_matrices(q[:, 3:7])
        components: Array = (self._root.T @ gravity) @ rotations
        return components
