"""Changes of the accelerations and constraint forces of a robot at one point.

A change F of the generalised forces at constant M and J changes the accelerations a and the
constraint forces lam by

    M da + F = J^T dlam,   J da = 0,

see (18.2) of docs/derivation.md. The forces lam belong to the independent rows of J.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.dynamics.closure import Closure
from fflin.dynamics.contact import Contact


class HeldForces:
    """Response of the accelerations and constraint forces at one point to changed forces.

    Attributes
    ----------
    response : ndarray (6 + n + r, 6 + n)
        Map from a change F of the generalised forces to the changes of the 6 + n accelerations, and
        of the forces of the r independent rows.
    """

    def __init__(
        self, closure: Closure, contact: Contact, q: Array, inverse: Array
    ) -> None:
        self._closure, self._contact, self._q = closure, contact, q
        space = contact.space
        self._state = closure.state
        rows, G = space.rows, space.basis
        by_rows = inverse @ rows.T
        mobility = np.linalg.inv(rows @ by_rows)  # (J M^-1 J^T)^-1
        to_rows = by_rows @ mobility  # J to_rows is the identity
        robot = self._state.robot
        M = self._state.project(pin.crba(robot.model, robot.create_data(), q).T)
        accelerations = -G @ np.linalg.solve(G.T @ M @ G, G.T)
        self.response: Array = np.vstack((accelerations, to_rows.T))
        self._by_rows: Array = np.vstack((-to_rows, -mobility))

    @property
    def is_redundant(self) -> bool:
        """Whether rows of the constraints are redundant."""
        return len(self._contact.space.redundant) > 0

    def require_no_mimic_joints(self) -> None:
        """Raise `InputError` if the robot has mimic joints, which Pinocchio cannot constrain."""
        robot = self._state.robot
        if robot.followers:
            raise InputError(
                f"the check of sensitivities uses Pinocchio's constrained dynamics, which do not "
                f"support mimic joints, but '{robot.name}' has both; compare with fflin.linearize "
                "of the changed robot"
            )

    def wrenches(
        self, forces: Array, pushed: pin.StdVec_Force | None
    ) -> pin.StdVec_Force:
        """Return the wrenches of forces (r,) on all joints, plus other wrenches `pushed`."""
        total = self._closure.constraints.wrenches(self._q, self._of_all_rows(forces))
        for joint, wrench in enumerate(pushed or ()):
            total[joint] += wrench
        return total

    def turning(self, forces: Array) -> Array:
        """Return the derivative (6 + n, 6 + n) of J^T times forces (r,), due to rotations alone."""
        still = np.zeros(self._state.robot.nv)
        derivatives = self._closure.constraints.derivatives(
            self._q, still, still, self._of_all_rows(forces)
        )
        return self._state.project(derivatives.force_by_q)

    def by_row_rates(self, c: Array) -> Array:
        """Return derivatives (6 + n + r, 6 + n) by q, because J depends on q.

        The accelerations change by c (nv,), in Pinocchio's order. At other configurations, the same
        change would open the constraints.
        """
        derivatives = self._closure.constraints.derivatives(
            self._q, np.zeros_like(c), c
        )
        by_q = self._state.columns(derivatives.by_q)
        result: Array = self._by_rows @ (self._contact.space.selected @ by_q)
        return result

    def changed(self, forces: Array, by_x: Array, by_u: Array) -> Contact:
        """Return the contact after changes of the forces (r,) and their derivatives (r, ..)."""
        contact, selected = self._contact, self._contact.space.selected
        return replace(
            contact,
            forces=contact.forces + selected.T @ forces,
            forces_by_x=contact.forces_by_x + selected.T @ by_x,
            forces_by_u=contact.forces_by_u + selected.T @ by_u,
        )

    def _of_all_rows(self, forces: Array) -> Array:
        """Return the forces of all rows from the forces (r,) of the independent rows."""
        result: Array = self._contact.space.selected.T @ forces
        return result
