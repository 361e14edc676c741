"""Constraints in a simulation: the rows that both engines use, and the Python engine's solution.

Of redundant rows, only independent rows are simulated. Near the initial configuration, they imply
the other rows. Every stage of a step corrects the accelerations, and every step ends with a
correction of positions and velocities; see `kernel.constraints`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.linalg import qr
from scipy.linalg.lapack import dpotrf, dtrtrs

from fflin.base.errors import ConstraintError, listed
from fflin.base.validation import Array, Indices, Mask
from fflin.dynamics.closure import Closure
from fflin.dynamics.constraints import Pair
from fflin.dynamics.state import StateMap
from fflin.kernel import constraints as kernel
from fflin.kernel.tree import Tree
from fflin.robot.constraints import Hinge
from fflin.robot.joints import ROOT, Carried
from fflin.robot.outputs import FORCES

# A row of J whose entries are below this value [m|1] is zero.
_ZERO = 1e-9

# The fraction of a row that is orthogonal to the rows before it, in the metric of M. An independent
# row has a larger fraction than _INDEPENDENT, a redundant row a smaller one than _REDUNDANT.
_INDEPENDENT, _REDUNDANT = 1e-4, 1e-7

# Newton's method for drawn configurations: largest number of corrections, residual [m|rad] at which
# they end, and largest residual that may be left.
_CORRECTIONS, _CLOSED, _LEFT = 30, 1e-14, 1e-10

# Factor of the columns of J that should remain independent.
_RELUCTANT = 1e-6

# Part of a unit wrench that must vanish for a determinate component.
_DETERMINATE = 1e-6


class Correction(NamedTuple):
    """Change (6 + n,) of accelerations or velocities, and its multipliers (r,)."""

    change: Array
    forces: Array


class Constrained:
    """Constraints of a robot in motion.

    Attributes
    ----------
    kept : ndarray of int (r,)
        Indices of the independent rows among all rows.
    names : tuple of str
        Names of the forces and torques of all constraints, as in `ConstraintForce`.
    outside : bool
        Whether a frame of the world holds the robot, so that its momentum is not constant.
    least : ndarray (1,)
        Squared orthogonal fraction of the rows, see `kernel.constraints`; the smallest so far. A
        row that vanishes also reduces it: the squared length of a row in the metric of M^-1, as a
        fraction of the squared length at the start.
    forces : ndarray (r,)
        Forces of the independent rows at the latest evaluation of the accelerations.
    """

    def __init__(self, state: StateMap, q: Array) -> None:
        robot = state.robot
        self._state = state
        self._model = robot.model
        self._data = robot.create_data()
        self._closure = Closure(state)
        self.constraints = self._closure.constraints
        self.constraints.settle(q)
        self.outside = robot.anchored
        self.kept = self._independent(q)
        J = self._state.columns(self.constraints.jacobian(q)[self.kept])
        self._start_squares = _squares(self._scaled(q, J)[1])
        self.names = tuple(
            f"{item.title}.{component}"
            for item in self.constraints.items
            for component in FORCES
        )
        self.least = np.ones(1)
        self.forces: Array = np.zeros(len(self.kept))

    def start(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the initial q and v on the constraints.

        Raise `ConstraintError` if the given q (nq,) or v (nv,) is far from them.
        """
        q = self._closure.configuration(q)
        return q, self._closure.velocity(q, v)

    def accelerate(self, q: Array, v: Array, rate: Array) -> tuple[Array, Array]:
        """Return dv/dt (nv,) for the accelerations `rate` (nv,) of the robot without constraints.

        The second result is the wrench (6,) of the constraints on the robot: force and moment about
        the base's origin in base axes.
        """
        J = self.constraints.jacobian(q)[self.kept]
        error = J @ rate + self.constraints.bias(q, v)[self.kept]
        columns = self._state.columns(J)
        change, self.forces = self._correction(q, columns, error)
        wrench = self.forces @ J[:, :6]
        return rate + self._state.spread(change), wrench

    def close(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return q and v at the end of a step, corrected such that the constraints hold."""
        for _ in range(2):
            q = self._nearer(q)
        return q, self._slowed(q, v)

    def independent(self) -> bool:
        """Return whether the rows were independent at all evaluations so far."""
        return bool(self.least[0] > kernel.LEAST_FRACTION)

    def wrenches(self, q: Array, forces: Array) -> Array:
        """Return the forces and torques (N, k) of all constraints from forces (N, r) of the rows.

        If redundant rows do not determine some forces, the smallest forces are returned.
        """
        full = np.zeros((len(q), self.constraints.count))
        full[:, self.kept] = forces
        if len(self.kept) < self.constraints.count:
            for row, q_i in zip(full, q, strict=True):
                row[:] = self._determinate(q_i) @ row
        return np.hstack(
            [full[:, pair.rows] @ pair.selected for pair in self.constraints.pairs]
        )

    def dependent(self, q: Array, drawn: Mask) -> Indices:
        """Return the indices of r coordinates that the constraints determine from the others.

        Coordinates in the mask `drawn` (6 + n,) are chosen only if the others do not suffice.
        """
        J = self._state.columns(self.constraints.jacobian(q)[self.kept])
        M = self._state.project(pin.crba(self._model, self._data, q))
        columns = J / np.sqrt(M.diagonal())
        columns /= np.linalg.norm(columns, axis=1)[:, None]
        columns[:, drawn] *= _RELUCTANT
        _, order = qr(columns, mode="r", pivoting=True)
        indices: Indices = np.sort(order[: len(self.kept)])
        return indices

    def completed(self, q: Array, v: Array, dependent: Indices) -> tuple[Array, Array]:
        """Return q and v on the constraints, for which only dependent coordinates change.

        Raise `ConstraintError` if Newton's method does not converge.
        """
        change = np.zeros(6 + self._state.robot.n)
        for _ in range(_CORRECTIONS):
            residual = self.constraints.residual(q)[self.kept]
            J = self._state.columns(self.constraints.jacobian(q)[self.kept])
            if not np.abs(residual).max() > _CLOSED:
                break
            change[dependent] = -np.linalg.solve(J[:, dependent], residual)
            q = pin.integrate(self._model, q, self._state.spread(change))
            self._state.robot.follow(q)
        distance, text = self._closure.distance(q)
        if not distance <= _LEFT:
            raise ConstraintError(f"Newton's method leaves {text}")
        nu = self._state.velocities(v)
        nu[dependent] -= np.linalg.solve(J[:, dependent], J @ nu)
        return q, self._state.spread(nu)

    def notes(self, q: Array) -> Iterator[str]:
        """Yield a note if redundant rows do not determine some of the forces at q."""
        if len(self.kept) == self.constraints.count:
            return
        apart = np.abs(self._determinate(q) - np.eye(self.constraints.count))
        open_rows = apart.max(axis=0) > _DETERMINATE
        titles = [
            pair.constraint.title
            for pair in self.constraints.pairs
            if open_rows[pair.rows].any()
        ]
        if titles:
            yield (
                f"the constraints are redundant: the forces of {listed(titles)} are not "
                "determinate, so the smallest are recorded"
            )

    def in_kernel(self, tree: Tree, nq: int) -> kernel.Constraints:
        """Return the constraints for the compiled engine."""
        pairs, pair_of, component = list[Frames](), list[int](), list[int]()
        for pair in self.constraints.pairs:
            first = len(pairs)
            pairs.append(_frames(tree, pair, np.eye(3)))
            rows = [(first, 3), (first, 4), (first, 5)]
            if isinstance(pair.constraint, Hinge):
                # The tilt of the axis has the components x and y in axes whose z is the axis.
                x, y = pair.selected[3:, 3:]
                pairs.append(
                    _frames(tree, pair, np.column_stack((x, y, np.cross(x, y))))
                )
                rows += [(first + 1, 0), (first + 1, 1)]
            elif len(pair.selected) == 6:
                rows += [(first, 0), (first, 1), (first, 2)]
            pair_of += [row[0] for row in rows]
            component += [row[1] for row in rows]
        size, r = len(tree.row), len(self.kept)
        return kernel.Constraints(
            first=[frames.first for frames in pairs],
            second=[frames.second for frames in pairs],
            first_pose=np.concatenate([frames.first_pose for frames in pairs]),
            second_pose=np.concatenate([frames.second_pose for frames in pairs]),
            pair=np.array(pair_of)[self.kept],
            component=np.array(component)[self.kept],
            location=np.zeros(kernel.LOCATION * len(pairs)),
            jacobian=np.zeros(r * size),
            basis=np.zeros(r * size),
            triangle=np.zeros(r * r),
            error=np.zeros(r),
            roots=np.zeros(size),
            change=np.zeros(size),
            multipliers=np.zeros(r),
            forces=np.zeros(r),
            squares=np.zeros(r),
            least=np.ones(1),
            at=np.zeros(nq),
            packed=np.zeros(len(tree.path)),
            twist=np.zeros(6),
        )

    def _correction(self, q: Array, J: Array, error: Array) -> Correction:
        """Return the smallest change c (6 + n,) with J c = -error, in the metric of M at q."""
        factor, rows = self._scaled(q, J)
        fractions = _squares(rows) / self._start_squares
        self.least[0] = min(self.least[0], fractions.min())
        basis = rows.ravel()
        r, size = J.shape
        triangle, change, forces = np.zeros(r * r), np.zeros(size), np.zeros(r)
        kernel.orthonormalise(basis, triangle, self.least, r)
        kernel.respond(basis, triangle, error, change, forces)
        return Correction(dtrtrs(factor, change, 1, 1)[0], forces)

    def _scaled(self, q: Array, J: Array) -> tuple[Array, Array]:
        """Return the Cholesky factor L of M at q, and the rows (r, 6 + n) of J times L^-T."""
        M = self._state.project(pin.crba(self._model, self._data, q))
        factor, _ = dpotrf(M, 1)
        # One row at a time, because OpenBLAS would wait for threads if there were several.
        return factor, np.array([dtrtrs(factor, row, 1)[0] for row in J])

    def _nearer(self, q: Array) -> Array:
        """Return q after one Newton correction of the residual."""
        residual = self.constraints.residual(q)[self.kept]
        J = self._state.columns(self.constraints.jacobian(q)[self.kept])
        change = self._state.spread(self._correction(q, J, residual).change)
        nearer: Array = pin.integrate(self._model, q, change)
        self._state.robot.follow(nearer)
        return nearer

    def _slowed(self, q: Array, v: Array) -> Array:
        """Return v without the part that violates the constraints."""
        J = self.constraints.jacobian(q)[self.kept]
        change, _ = self._correction(q, self._state.columns(J), J @ v)
        slowed: Array = v + self._state.spread(change)
        return slowed

    def _independent(self, q: Array) -> Indices:
        """Return the indices of independent rows at q; raise an error if the rank is ambiguous."""
        J = self._state.columns(self.constraints.jacobian(q))
        rows = np.flatnonzero(np.abs(J).max(axis=1) > _ZERO)
        M = self._state.project(pin.crba(self._model, self._data, q))
        factor, _ = dpotrf(M, 1)
        Z = dtrtrs(factor, J[rows].T, 1)[0]
        Z /= np.linalg.norm(Z, axis=0)
        R, order = qr(Z, mode="r", pivoting=True)
        fractions = np.abs(R.diagonal())
        rank = int((fractions > _REDUNDANT).sum())
        if rank and fractions[rank - 1] < _INDEPENDENT:
            raise ConstraintError(
                f"the constraints of '{self._state.robot.name}' are nearly singular at the initial "
                f"configuration: a row differs from the others by {fractions[rank - 1]:.1e}, "
                f"expected more than {_INDEPENDENT:g}, or less than {_REDUNDANT:g} for a redundant "
                "row; start from another configuration"
            )
        if not rank:
            raise ConstraintError(
                f"the constraints of '{self._state.robot.name}' restrict no motion at the initial "
                "configuration; remove them"
            )
        independent: Indices = np.sort(rows[order[:rank]])
        return independent

    def _determinate(self, q: Array) -> Array:
        """Return the projection (k, k) of the forces of all rows on the determinate forces."""
        J = self.constraints.jacobian(q)
        basis = np.linalg.qr(J @ J[self.kept].T)[0]
        projection: Array = basis @ basis.T
        return projection


class Frames(NamedTuple):
    """The two frames of a constraint on bodies of the tree; the body -1 is the world."""

    first: int
    second: int
    first_pose: Array
    second_pose: Array


def _frames(tree: Tree, pair: Pair, axes: Array) -> Frames:
    """Return the frames of a pair, rotated to the given axes (3, 3) of the first frame."""
    rotation = pin.SE3(axes, np.zeros(3))
    first, first_pose = _on_body(tree, pair.first, rotation)
    second, second_pose = _on_body(tree, pair.second, rotation)
    return Frames(first, second, first_pose, second_pose)


def _on_body(tree: Tree, frame: Carried, rotation: pin.SE3) -> tuple[int, Array]:
    """Return the body of a rotated frame, and the frame in the axes of the tree's joint frame."""
    pose = frame.placement * rotation
    if frame.joint < ROOT:
        return -1, _packed(pose)
    body = frame.joint - ROOT
    to_joint = pin.SE3(tree.axes[body].T, np.zeros(3))
    return body, _packed(to_joint * pose)


def _packed(pose: pin.SE3) -> Array:
    """Return the columns of the rotation, and the translation, of a pose."""
    return np.concatenate((pose.rotation.ravel("F"), pose.translation))


def _squares(rows: Array) -> Array:
    """Return the squared lengths (r,) of rows (r, k)."""
    squares: Array = np.einsum("ij,ij->i", rows, rows)
    return squares
