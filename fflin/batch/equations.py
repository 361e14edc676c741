"""Linear models about many points at once, by the compiled kernel."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fflin.base.rotation import product_matrix, rotation_matrices
from fflin.base.validation import Array
from fflin.batch.inertia import FARTHEST, Rows
from fflin.dynamics.chart import SMALLEST_Q0, Chart
from fflin.dynamics.inertia import Inertia
from fflin.kernel.accelerations import BatchRates, Points, Rates
from fflin.kernel.tree import LANES, batch_tree
from fflin.linear.linearization import LARGEST, Linearizer
from fflin.linear.state_equations import STANDING, Point, ride_along, state_equations, turned
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
        self._linearizer = linearizer
        self._state, self._actuation = linearizer._map, linearizer._actuation
        self._rates = BatchRates(self._state, self._actuation)
        robot = linearizer.robot
        self._root = robot.model.jointPlacements[ROOT].rotation
        self._least_coupling = 0.999 * (6 + robot.n)

    @staticmethod
    def possible(linearizer: Linearizer) -> bool:
        """Whether the kernel knows the robot's joints, and no output is to be differentiated."""
        return linearizer._sensing is None and batch_tree(linearizer.robot) is not None

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
        chart, within = self._chart(q)
        u_base = self._actuation.in_base_axes(chart, u)
        stiffness, damping, rest = state.robot.passive
        forces = u_base @ self._actuation.fixed.T
        forces[:, 6:] -= stiffness * (q_m - rest) + damping * nu[:, 6:]
        A, B = out["A"], out["B_lower"]
        A[:] = self._linearizer._A_rest
        rates = self._evaluate(Points(q, nu, forces, u_base), A)
        self._set_inputs(rates, B)
        point = Point(nu, u_base, rates.c, self._gravity(q))
        out["f0"][:] = state_equations(state, self._actuation, chart, point, A, B)
        if "_drift" in out:
            out["_drift"][:] = ride_along(state, point, A, out["f0"])
        x0 = out["_x0"]
        x0[:, :6] = 0.0
        x0[:, groups.q_m] = q_m
        x0[:, nv:] = nu
        if chart is not STANDING:
            x0[:, groups.q_b] = chart.q_b
            x0[:, groups.r_b] = state.positions(q)
            for part, held in zip((groups.omega_b, groups.v_b), state.axes, strict=True):
                if held:
                    x0[:, part] = turned(chart.R, x0[:, part])
        good = within & (np.abs(q[:, 7:]) < FARTHEST).all(axis=1)
        good &= self._least_coupling < rates.couplings
        good &= rates.couplings < Inertia.warning_coupling
        # What is not finite shows in these, NaN too.
        for array in (A[:, nv:], B, out["f0"][:, None]):
            good &= np.einsum("ijk,ijk->i", array, array) < LARGEST
        return good

    def _evaluate(self, points: Points, A: Array) -> Rates:
        """Return the rates, their slopes in the lower half of A."""
        count, nv = points.nu.shape
        carried = len(self._rates.carried)
        if count < LANES:
            filled = Points(*(np.pad(x, ((0, LANES - count), (0, 0)), mode="edge") for x in points))
            slopes: Array = np.zeros((LANES, *A.shape[1:]))
            rates = self._evaluate(filled, slopes)
            A[:, nv:] = slopes[:count, nv:]
            return Rates(*(array[:count] for array in rates))
        rates = Rates(
            np.empty((count, nv, nv)),
            np.empty((count, nv)),
            A.reshape(count, -1),
            np.empty((count, nv * carried)),
            np.empty(count),
        )
        self._rates.evaluate(points, rates)
        return rates

    def _set_inputs(self, rates: Rates, B: Array) -> None:
        if self._actuation.default:
            B[:] = rates.inverse
            return
        np.matmul(rates.inverse, self._actuation.fixed, out=B)
        carried = self._rates.carried
        if len(carried):
            columns = rates.columns.reshape(len(B), -1, len(carried))
            B[:, :, carried] = rates.inverse @ columns

    def _chart(self, q: Array) -> tuple[Chart, NDArray[np.bool_]]:
        """Return the chart at each configuration, and where it reaches."""
        if self._linearizer._own_reference:
            return STANDING, np.ones(len(q), dtype=bool)
        quaternions = q[:, 3:7] @ product_matrix(self._state.origin_quaternion).T
        quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
        quaternions[quaternions[:, 3] < 0.0] *= -1.0
        q0 = quaternions[:, 3:]
        chart = Chart(quaternions[:, :3], q0, rotation_matrices(quaternions))
        return chart, q0[:, 0] >= SMALLEST_Q0

    def _gravity(self, q: Array) -> Array:
        gravity = np.array(self._state.robot.gravity)
        if not gravity.any():
            return gravity
        rotations = rotation_matrices(q[:, 3:7])
        components: Array = (self._root.T @ gravity) @ rotations
        return components
