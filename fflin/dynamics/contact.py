"""Constrained accelerations and constraint forces, with their derivatives, in base axes.

The accelerations a satisfy M a + h = S u + J^T lam and J a + gamma = 0, see (18.2) and (18.3) of
docs/derivation.md.
The free accelerations and their derivatives, with lam = 0, come from `fflin.dynamics.rnea`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from fflin.base.errors import ConstraintError, listed
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.closure import Closure, TangentSpace
from fflin.dynamics.coordinates import ANGULAR, LINEAR

# A component of lam is determinate if its part along redundant rows is less than this fraction.
_DETERMINATE = 1e-7


@dataclass
class Contact:
    """Constraint forces at one point, and what their derivatives need.

    Attributes
    ----------
    space : TangentSpace
    c : ndarray (6 + n,)
        Constrained accelerations, in the convention of `AccelerationDerivatives.c`.
    forces : ndarray (rows,)
        Constraint forces lam. If rows are redundant, lam is the smallest of the possible forces.
    wrenches : pin.StdVec_Force
        Wrenches of the constraint forces on all joints, in their frames.
    forces_by_x : ndarray (rows, 12 + 2 n)
        Derivatives of lam with respect to displacements of the state in base axes.
    forces_by_u : ndarray (rows, nu)
        Derivatives of lam with respect to u in base axes.
    twist_by_q : ndarray (r, 6 + n)
        Derivatives of J_r nu with respect to displacements of the configuration.
    """

    space: TangentSpace
    c: Array
    forces: Array
    wrenches: pin.StdVec_Force
    forces_by_x: Array
    forces_by_u: Array
    twist_by_q: Array

    def added_to(self, wrenches: pin.StdVec_Force | None) -> pin.StdVec_Force:
        """Return the wrenches of the constraints plus other wrenches on the joints."""
        total = pin.StdVec_Force(self.wrenches)
        for joint, wrench in enumerate(wrenches or ()):
            total[joint] += wrench
        return total

    def require_determinate(self, names: Sequence[str], components: Array) -> None:
        """Raise an error if components of lam depend on internal stresses of redundant rows.

        `components` (k, rows) selects the components from lam.
        """
        scaled = components * self.space.row_scale
        free = components @ self.space.redundant.T
        size = np.linalg.norm(scaled, axis=1)
        lost = np.linalg.norm(free, axis=1) > _DETERMINATE * size
        if lost.any():
            shown = listed(name for name, flag in zip(names, lost, strict=True) if flag)
            raise ConstraintError(
                f"{shown} is not determinate, because the constraints are redundant, so that it "
                "depends on internal stresses; leave it out with ConstraintForce(..., components=)"
            )


class ContactSolver:
    """Solution of the constrained equations of motion at points of one robot."""

    def __init__(self, closure: Closure) -> None:
        from scipy.linalg.lapack import dposv

        self._solve = dposv
        self._closure = closure
        self._state = closure.state
        self._rows: Array = np.zeros((0, 0))
        self._inverse_by_rows: Array = np.zeros((0, 0))
        self._delassus: Array = np.zeros((0, 0))

    def contact(
        self, q: Array, v: Array, nu: Array, c: Array, inverse: Array
    ) -> Contact:
        """Return the contact at a point from the free accelerations c and M^-1."""
        constraints = self._closure.constraints
        space = self._closure.tangent(q)
        self._rows = rows = space.rows
        self._inverse_by_rows = inverse.dot(rows.T)
        self._delassus = rows.dot(self._inverse_by_rows)
        error = rows.dot(self._rate(q, nu, c))
        error += space.selected.dot(constraints.bias(q, v))
        reduced = -self._solved(error)
        forces = space.selected.T.dot(reduced)
        none = np.zeros((0, 0))
        return Contact(
            space=space,
            c=c + self._inverse_by_rows.dot(reduced),
            forces=forces,
            wrenches=constraints.wrenches(q, forces),
            forces_by_x=none,
            forces_by_u=none,
            twist_by_q=none,
        )

    def differentiate(
        self,
        contact: Contact,
        q: Array,
        v: Array,
        nu: Array,
        inverse: Array,
        slopes: Array,
        by_u: Array,
    ) -> None:
        """Constrain the derivatives `slopes` (6 + n, 12 + 2 n) and `by_u` (6 + n, nu) in place.

        On entry, they are the derivatives of the free accelerations, at wrenches of the constraint
        forces that are constant in the frames of their joints.
        """
        state, constraints = self._state, self._closure.constraints
        nv = len(contact.c)
        space, rows = contact.space, self._rows
        rates = state.spread(self._rate(q, nu, contact.c))
        of_rows = constraints.derivatives(q, v, rates, contact.forces)
        slopes[:, :nv] += inverse.dot(state.project(of_rows.force_by_q))
        residual = np.empty((len(rows), 2 * nv + by_u.shape[1]))
        residual[:, : 2 * nv] = rows.dot(slopes)
        residual[:, 2 * nv :] = rows.dot(by_u)
        explicit = space.selected.dot(of_rows.all)
        explicit = explicit.reshape(-1, len(v))
        explicit = state.columns(explicit).reshape(len(rows), 3 * nv)
        residual[:, : 2 * nv] += explicit[:, nv:]
        if state.robot.anchored:
            # Loops do not depend on the linear acceleration of the base.
            linear = rows[:, LINEAR]
            residual[:, :3] += linear.dot(skew(state.gravity(q)))
            residual[:, nv : nv + 3] += linear.dot(skew(nu[LINEAR]))
            residual[:, nv + 3 : nv + 6] -= linear.dot(skew(nu[ANGULAR]))
        solved = -self._solved(residual)
        by_x, by_input = solved[:, : 2 * nv], solved[:, 2 * nv :]
        slopes += self._inverse_by_rows.dot(by_x)
        by_u += self._inverse_by_rows.dot(by_input)
        contact.forces_by_x = space.selected.T.dot(by_x)
        contact.forces_by_u = space.selected.T.dot(by_input)
        contact.twist_by_q = explicit[:, :nv]

    def _solved(self, right: Array) -> Array:
        """Return (J_r M^-1 J_r^T)^-1 times a vector or a matrix."""
        _, solved, failed = self._solve(self._delassus, right)
        if failed:  # rounding errors are as large as the smallest eigenvalue
            solved = np.linalg.solve(self._delassus, right)
        result: Array = solved
        return result

    def _rate(self, q: Array, nu: Array, c: Array) -> Array:
        """Return dnu/dt (3.2) from the accelerations c without gravity."""
        rate = c.copy()
        if self._state.robot.anchored:
            # Loops do not depend on the linear acceleration of the base.
            rate[LINEAR] += self._state.gravity(q)
            rate[LINEAR] -= skew(nu[ANGULAR]) @ nu[LINEAR]
        return rate
