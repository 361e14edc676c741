r"""Constraints of a robot: residual, Jacobian, and the accelerations that they require.

Constraint k holds frame 2, the constraint's `frame`, relative to frame 1. Frame 1 is fixed to the
frame `to`, or to inertial space, at the constraint's placement, so that frames 1 and 2 coincide if
a weld is closed. With the twists :math:`V_1` and :math:`V_2` of the two frames in their own axes,
and the transformation X of twists from frame 2 to frame 1, the relative twist is

.. math:: V = X V_2 - V_1.

See (18.1) of docs/derivation.md.

Each constraint sets some rows S of V to zero, in the axes of frame 1: :math:`S V = J \nu = 0`.
Differentiated, this is :math:`J \dot\nu + \gamma = 0`. Twists have the linear part first, as in
Pinocchio, and so have the tangent coordinates of q and :math:`\nu`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.rotation import skew
from fflin.base.validation import Array, Mask
from fflin.robot.constraints import Constraint, Hinge, Spherical
from fflin.robot.joints import ROOT, Carried, find_frame
from fflin.robot.robot_data import RobotData

_LOCAL = pin.ReferenceFrame.LOCAL
_BASE = slice(0, 6)  # columns of the base


class Pair(NamedTuple):
    """The two frames of a constraint: the joints that carry them, and placements on these."""

    constraint: Constraint
    rows: slice  # rows of the constraint among all rows
    selected: Array  # S (k, 6)
    first: Carried  # frame 1, on the joint of `to`, or on the universe
    second: Carried  # frame 2

    @property
    def is_loop(self) -> bool:
        """Whether both frames are on the robot, so that a motion of the base moves them alike."""
        return self.first.joint >= ROOT


class _Slopes(NamedTuple):
    """Derivatives (6, nv) of the twist V and the acceleration of a frame, in its own axes."""

    twist_by_q: Array
    jacobian: Array
    rate_by_q: Array
    rate_by_v: Array


class RowDerivatives(NamedTuple):
    """Derivatives (rows, nv) of the rows of the constraints, in Pinocchio's order."""

    twist_by_q: Array  # of J v with respect to q, at constant v
    by_q: Array  # of J dv/dt + gamma with respect to q, at constant v and dv/dt
    by_v: Array  # of J dv/dt + gamma with respect to v


class Constraints:
    """Constraints of one robot at any configuration, in Pinocchio's tangent coordinates.

    Attributes
    ----------
    items : tuple of Constraint
    count : int
        Number of rows of all constraints.
    """

    def __init__(self, robot: RobotData) -> None:
        self.items = robot.constraints
        self.count = sum(len(item.rows) for item in self.items)
        self._robot = robot
        self._model = robot.model
        self._data = robot.model.createData()
        self._pairs: tuple[Pair, ...] = ()
        self._signs: list[Array | None] = []
        self._angular: Mask = np.zeros(0, dtype=bool)

    def settle(self, q: Array) -> None:
        """Store, in constraints without a placement, the pose of their frames at q (nq,)."""
        if self._pairs:
            return
        pin.forwardKinematics(self._model, self._data, q)
        for item in self.items:
            if item.placement is not None:
                continue
            to = self._carrier(item.to)
            frame = self._carrier(item.frame)
            item.store(self._pose(to).actInv(self._pose(frame)))

    @property
    def pairs(self) -> tuple[Pair, ...]:
        """The frames of all constraints; raise `InputError` if a placement is not yet stored."""
        if not self._pairs:
            self._pairs = tuple(self._made())
            self._signs = [self._sign(pair) for pair in self._pairs]
            of_pairs = [pair.selected[:, 3:].any(axis=1) for pair in self._pairs]
            self._angular = np.concatenate(of_pairs)
        return self._pairs

    @property
    def angular(self) -> Mask:
        """Whether each row (rows,) is angular."""
        _ = self.pairs
        return self._angular

    def residual(self, q: Array) -> Array:
        """Return phi (rows,) at q (nq,): the distances [m] and angles [rad] left to close.

        On the manifold phi is zero, and its derivative in tangent coordinates is J.
        """
        pin.forwardKinematics(self._model, self._data, q)
        residual = np.zeros(self.count)
        for pair in self.pairs:
            residual[pair.rows] = _distances(pair, self._apart(pair))
        return residual

    def jacobian(self, q: Array) -> Array:
        """Return J (rows, nv) at q (nq,)."""
        pairs = self.pairs
        columns = pin.computeJointJacobians(self._model, self._data, q)
        jacobian = np.empty((self.count, self._model.nv))
        for pair, signs in zip(pairs, self._signs, strict=True):
            first = self._pose(pair.first)
            if signs is None:
                apart = first.actInv(self._pose(pair.second))
                jacobian[pair.rows] = self._mimic_rows(pair, apart)
                continue
            # Column k of `columns` is the twist in world axes of all bodies that joint k moves.
            selected = pair.selected.dot(first.actionInverse)
            np.multiply(selected.dot(columns), signs, out=jacobian[pair.rows])
        return jacobian

    def residual_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """Return phi (rows,), see `residual`, and J (rows, nv) at q (nq,)."""
        jacobian = self.jacobian(q)
        residual = np.empty(self.count)
        for pair in self.pairs:
            residual[pair.rows] = _distances(pair, self._apart(pair))
        return residual, jacobian

    def _mimic_rows(self, pair: Pair, apart: pin.SE3) -> Array:
        """Return the rows of J (k, nv) of a constraint on a robot with mimic joints."""
        second = _of_frame(pair.second, self._joint_jacobian(pair.second))
        first = _of_frame(pair.first, self._joint_jacobian(pair.first))
        rows: Array = pair.selected @ (apart.action @ second - first)
        if pair.is_loop:
            rows[:, _BASE] = 0.0
        return rows

    def _sign(self, pair: Pair) -> Array | None:
        """Return the sign (nv,) of each velocity in the motion of frame 2 relative to frame 1.

        It is zero if a velocity moves both frames or none. Return None for mimic joints.
        """
        if self._robot.followers:
            return None
        return self._moves(pair.second) - self._moves(pair.first)

    def _moves(self, frame: Carried) -> Array:
        """Return for each velocity (nv,) whether it moves a frame: 1 or 0."""
        moves = np.zeros(self._model.nv)
        if frame.joint >= ROOT:
            for joint in self._model.supports[frame.joint]:
                start = self._model.idx_vs[joint]
                moves[start : start + self._model.nvs[joint]] = 1.0
        return moves

    def bias(self, q: Array, v: Array) -> Array:
        """Return gamma (rows,) at q (nq,) and v (nv,), so that J dv/dt + gamma = 0."""
        pin.forwardKinematics(self._model, self._data, q, v, np.zeros_like(v))
        bias = np.zeros(self.count)
        for pair in self.pairs:
            X = self._apart(pair)
            first, second = self._twist(pair.first), self._twist(pair.second)
            rates = X.act(self._acceleration(pair.second))
            rates -= self._acceleration(pair.first)
            # dX/dt V_2 = V x X V_2 with the relative twist V = X V_2 - V_1.
            rates -= first.cross(X.act(second))
            bias[pair.rows] = pair.selected @ rates.vector
        return bias

    def derivatives(self, q: Array, v: Array, a: Array) -> RowDerivatives:
        """Return the derivatives of the rows at q (nq,), v (nv,) and the acceleration a (nv,)."""
        pin.computeForwardKinematicsDerivatives(self._model, self._data, q, v, a)
        derivatives = RowDerivatives(*np.zeros((3, self.count, self._model.nv)))
        for pair in self.pairs:
            pose = self._apart(pair)
            X = pose.action
            first, second = self._slopes(pair.first), self._slopes(pair.second)
            relative = X @ second.jacobian - first.jacobian
            twist = pose.act(self._twist(pair.second))
            rate = pose.act(self._acceleration(pair.second))
            turning = self._twist(pair.first).action
            # d(X V_2) = X dV_2 - (X V_2) x (relative xi), and the same for accelerations.
            twist_by_q = X @ second.twist_by_q - twist.action @ relative
            rate_by_q = X @ second.rate_by_q - rate.action @ relative
            S, rows = pair.selected, pair.rows
            derivatives.twist_by_q[rows] = S @ (twist_by_q - first.twist_by_q)
            rate_by_q -= first.rate_by_q
            rate_by_q += twist.action @ first.twist_by_q - turning @ twist_by_q
            derivatives.by_q[rows] = S @ rate_by_q
            rate_by_v = X @ second.rate_by_v - first.rate_by_v
            rate_by_v += twist.action @ first.jacobian
            rate_by_v -= turning @ X @ second.jacobian
            derivatives.by_v[rows] = S @ rate_by_v
            if pair.is_loop:
                for array in derivatives:
                    array[rows, _BASE] = 0.0
        return derivatives

    def wrenches(self, q: Array, forces: Array) -> pin.StdVec_Force:
        """Return the wrenches on all joints, in their frames, of constraint forces (rows,)."""
        pin.forwardKinematics(self._model, self._data, q)
        wrenches = pin.StdVec_Force(self._model.njoints, pin.Force.Zero())
        for pair in self.pairs:
            wrench = pin.Force(pair.selected.T @ forces[pair.rows])
            first, second = pair.first, pair.second
            wrenches[first.joint] -= first.placement.act(wrench)
            turned = self._apart(pair).actInv(wrench)
            wrenches[second.joint] += second.placement.act(turned)
        return wrenches

    def force_by_q(self, q: Array, forces: Array) -> Array:
        """Return the derivative (nv, nv) of J^T times the forces (rows,), due to rotations alone.

        The wrench on frame 2 is constant in the axes of frame 1, so it turns relative to frame 2.
        The derivative at wrenches that are constant in the frames of their joints is not included.
        """
        pin.computeJointJacobians(self._model, self._data, q)
        total = np.zeros((self._model.nv, self._model.nv))
        for pair in self.pairs:
            X = self._apart(pair).action
            second = _of_frame(pair.second, self._joint_jacobian(pair.second))
            first = _of_frame(pair.first, self._joint_jacobian(pair.first))
            force, torque = np.split(pair.selected.T @ forces[pair.rows], 2)
            turned = np.zeros((6, 6))
            turned[:3, 3:] = turned[3:, :3] = skew(force)
            turned[3:, 3:] = skew(torque)
            total += second.T @ X.T @ turned @ (X @ second - first)
        return total

    def _made(self) -> Iterator[Pair]:
        at = 0
        for item in self.items:
            if item.placement is None:
                raise InputError(
                    f"constraint '{item.title}' has no placement yet; give placement=, or the "
                    "configuration at which it is closed"
                )
            to = self._carrier(item.to)
            first = Carried(to.joint, to.placement * item.placement)
            rows = slice(at, at + len(item.rows))
            yield Pair(item, rows, item.rows, first, self._carrier(item.frame))
            at = rows.stop

    def _carrier(self, frame: str | None) -> Carried:
        if frame is None:
            return Carried(ROOT - 1, pin.SE3.Identity())
        return find_frame(self._model, frame)

    def _pose(self, frame: Carried) -> pin.SE3:
        return self._data.oMi[frame.joint] * frame.placement

    def _apart(self, pair: Pair) -> pin.SE3:
        """Return the pose of frame 2 in frame 1."""
        return self._pose(pair.first).actInv(self._pose(pair.second))

    def _twist(self, frame: Carried) -> pin.Motion:
        return frame.placement.actInv(self._data.v[frame.joint])

    def _acceleration(self, frame: Carried) -> pin.Motion:
        return frame.placement.actInv(self._data.a[frame.joint])

    def _slopes(self, frame: Carried) -> _Slopes:
        """Return derivatives of the twist and acceleration of a frame, in its own axes."""
        if frame.joint < ROOT:
            return _Slopes(*np.zeros((4, 6, self._model.nv)))
        twist_by_q, rate_by_q, rate_by_v, jacobian = (
            pin.getJointAccelerationDerivatives(
                self._model, self._data, frame.joint, _LOCAL
            )
        )
        columns = twist_by_q, jacobian, rate_by_q, rate_by_v
        return _Slopes._make(_of_frame(frame, column) for column in columns)

    def _joint_jacobian(self, frame: Carried) -> Array:
        if frame.joint < ROOT:
            return np.zeros((6, self._model.nv))
        jacobian: Array = pin.getJointJacobian(
            self._model, self._data, frame.joint, _LOCAL
        )
        return jacobian


def _distances(pair: Pair, apart: pin.SE3) -> Array:
    """Return the rows (k,) of phi from the pose of frame 2 in frame 1."""
    if isinstance(pair.constraint, Spherical):
        distances: Array = apart.translation
        return distances
    rotation = apart.rotation
    if isinstance(pair.constraint, Hinge):
        turned = _tilt(np.array(pair.constraint.axis), rotation)
    else:
        turned = pin.log3(rotation)
    distances = pair.selected.dot(np.concatenate((apart.translation, turned)))
    return distances


def _of_frame(frame: Carried, columns: Array) -> Array:
    """Return twists of a frame in its own axes from twists (6, k) of the joint that carries it."""
    twists: Array = frame.placement.actionInverse @ columns
    return twists


def _tilt(axis: Array, rotation: Array) -> Array:
    """Return the rotation vector (3,) that tilts an axis to the axis rotated by a matrix R."""
    tilted = rotation @ axis
    across = _cross(axis, tilted)
    sine = float(np.linalg.norm(across))
    cosine = float(axis @ tilted)
    if sine < 1e-12 and cosine > 0.0:
        return across
    angle = np.arctan2(sine, cosine)
    if sine < 1e-12:
        # The axes are opposite: any rotation by 180 deg across the axis closes the hinge.
        across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        sine = float(np.linalg.norm(across))
    vector: Array = angle * across / sine
    return vector


def _cross(first: Array, second: Array) -> Array:
    """Return the cross product of two vectors (3,), faster than `np.cross`."""
    a, b, c = first.tolist()
    x, y, z = second.tolist()
    return np.array((b * z - c * y, c * x - a * z, a * y - b * x))
