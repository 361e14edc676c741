"""Motions of robots with constraints: accelerations and projections, for searches of plans.

Both solve the normal equations of the constraints with the metric of the kinetic energy. Redundant
rows need no selection.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from scipy.linalg.lapack import dpotrf, dtrtrs

from fflin.base.validation import Array
from fflin.dynamics.aba import Aba
from fflin.dynamics.constraints import Constraints
from fflin.dynamics.state import StateMap

# Relative singular values of the rows, in units of equal kinetic energy, that are rounding errors.
_ZERO = 1e-8

# Newton's method: residual [m|rad] at which it ends, and largest number of steps.
_CLOSED, _MOST = 1e-13, 20

# Residual [m|rad] that rounding errors may leave after the last step, per metre of distance from
# the world's origin.
_LEFT = 1e-11


class ProjectedAba(Aba):
    """Dynamics of a robot with constraints, whose points are projected on the constraints.

    If a point is not finite, or cannot be projected, the results are NaN.
    """

    def __init__(self, state: StateMap) -> None:
        super().__init__(state)
        # The inherited methods then compute the accelerations without constraint forces.
        self._constraints = None
        self.rows = Constraints(state.robot)
        self._held = state.robot.create_data()

    def accelerations(
        self, q: Array, v: Array, u: Array, t: Array | None = None
    ) -> Array:
        """Return dv/dt (N, nv) at N closed points under the inputs u (N, nu)."""
        rates = np.full_like(v, np.nan)
        for row, q_k, v_k, u_k in zip(rates, q, v, u, strict=True):
            if not np.isfinite(np.concatenate((q_k, v_k))).all():
                continue
            free = self.acceleration(q_k, v_k, u_k)
            bias = self.rows.bias(q_k, v_k)
            J = self.rows.jacobian(q_k)
            row[:] = free + self._change(q_k, J, J @ free + bias)
        return rates

    def closed(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the points (N, nq), (N, nv) on the constraints that are near N given points."""
        pairs = zip(q, v, strict=True)
        closed_q, closed_v = zip(*(self._closed(*pair) for pair in pairs), strict=True)
        return np.array(closed_q), np.array(closed_v)

    def _closed(self, q: Array, v: Array) -> tuple[Array, Array]:
        model = self.state.robot.model
        smallest = np.inf
        for _ in range(_MOST):
            if not np.isfinite(np.concatenate((q, v))).all():
                break
            residual, J = self.rows.residual_and_jacobian(q)
            size = np.abs(residual).max()
            # Rounding errors are left if the residual is small and does not fall any more.
            rounded = size <= _LEFT * (1.0 + np.abs(q[:3]).max())
            if size <= _CLOSED or (rounded and size >= smallest):
                return q, v + self._change(q, J, J @ v)
            smallest = min(smallest, size)
            q = pin.integrate(model, q, self._change(q, J, residual))
            self.state.robot.follow(q)
        return np.full_like(q, np.nan), np.full_like(v, np.nan)

    def _change(self, q: Array, J: Array, error: Array) -> Array:
        """Return the smallest change c (nv,) with J c = -error, in the metric of M at q."""
        state = self.state
        M = state.project(pin.crba(state.robot.model, self._held, q))
        factor, _ = dpotrf(M, 1)
        # One row at a time, because OpenBLAS would wait for threads if there were several.
        columns = state.columns(J)
        scaled = np.array([dtrtrs(factor, row, 1)[0] for row in columns])
        least = np.linalg.lstsq(scaled, -error, rcond=_ZERO)[0]
        return state.spread(dtrtrs(factor, least, 1, 1)[0])
