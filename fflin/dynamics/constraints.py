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
from fflin.base.validation import Array, Mask
from fflin.robot.constraints import Constraint, Hinge, Spherical, Weld
from fflin.robot.joints import ROOT, Carried, find_frame
from fflin.robot.robot_data import RobotData

_LOCAL = pin.ReferenceFrame.LOCAL
_BASE = slice(0, 6)  # columns of the base
# Indices of a twist with the angular part first
_SWAPPED = np.array([3, 4, 5, 0, 1, 2])


class _Kinematics(NamedTuple):
    """Pose, twist and acceleration of the joints of a constraint; Pinocchio overwrites them."""

    first_pose: pin.SE3
    first_twist: pin.Motion
    first_rate: pin.Motion
    second_pose: pin.SE3
    second_twist: pin.Motion
    second_rate: pin.Motion


class Pair(NamedTuple):
    """The two frames of a constraint: the joints that carry them, and placements on these."""

    constraint: Constraint
    rows: slice  # rows of the constraint among all rows
    selected: Array  # S (k, 6)
    first: Carried  # frame 1, on the joint of `to`, or on the universe
    second: Carried  # frame 2
    state: _Kinematics

    @property
    def is_loop(self) -> bool:
        """Whether both frames are on the robot, so that a motion of the base moves them alike."""
        return self.first.joint >= ROOT


class RowDerivatives(NamedTuple):
    """Derivatives of the rows of the constraints, in Pinocchio's order."""

    # The three derivatives below (rows, 3 nv), side by side
    all: Array
    # Derivative (nv, nv) of J^T times constant forces with respect to q, due to rotations alone:
    # the wrench on frame 2 is constant in the axes of frame 1, so it turns relative to frame 2. The
    # derivative at wrenches that are constant in the frames of their joints is not included.
    force_by_q: Array

    @property
    def twist_by_q(self) -> Array:
        """Derivative (rows, nv) of J v with respect to q, at constant v."""
        return self.all[:, : len(self.force_by_q)]

    @property
    def by_q(self) -> Array:
        """Derivative (rows, nv) of J dv/dt + gamma with respect to q, at constant v and dv/dt."""
        nv = len(self.force_by_q)
        return self.all[:, nv : 2 * nv]

    @property
    def by_v(self) -> Array:
        """Derivative (rows, nv) of J dv/dt + gamma with respect to v."""
        return self.all[:, 2 * len(self.force_by_q) :]


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
    def signs(self) -> Array:
        """Signs (rows, nv) of the velocities in the rows, for a robot without mimic joints."""
        signs = np.empty((self.count, self._model.nv))
        for pair, sign in zip(self.pairs, self._signs, strict=True):
            signs[pair.rows] = sign
        return signs

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
        return self._evaluated(q, None)

    def residual_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """Return phi (rows,), see `residual`, and J (rows, nv) at q (nq,)."""
        residual = np.empty(self.count)
        return residual, self._evaluated(q, residual)

    def _evaluated(self, q: Array, residual: Array | None) -> Array:
        """Return J (rows, nv) at q (nq,), and write phi to `residual` (rows,) if it is given."""
        pairs = self.pairs
        columns = pin.computeJointJacobians(self._model, self._data, q)
        jacobian = np.empty((self.count, self._model.nv))
        for pair, signs in zip(pairs, self._signs, strict=True):
            first = self._pose(pair.first)
            if residual is not None or signs is None:
                apart = first.actInv(self._pose(pair.second))
            if residual is not None:
                residual[pair.rows] = _distances(pair, apart)
            if signs is None:
                jacobian[pair.rows] = self._mimic_rows(pair, apart)
                continue
            # Column k of `columns` is the twist in world axes of all bodies that joint k moves.
            selected = pair.selected.dot(first.actionInverse)
            np.multiply(selected.dot(columns), signs, out=jacobian[pair.rows])
        return jacobian

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
        bias = np.zeros(self.count)
        pairs = self.pairs
        if not v.any():
            return bias
        pin.forwardKinematics(self._model, self._data, q, v, np.zeros_like(v))
        for pair in pairs:
            _, own, twist, rate = self._motions(pair)
            rate -= pair.first.placement.actInv(pair.state.first_rate)
            # dX/dt V_2 = V x X V_2 with the relative twist V = X V_2 - V_1.
            rate -= own.cross(twist)
            bias[pair.rows] = pair.selected @ rate.vector
        return bias

    def derivatives(
        self, q: Array, v: Array, a: Array, forces: Array | None = None
    ) -> RowDerivatives:
        """Return the derivatives of the rows at q (nq,), v (nv,) and the acceleration a (nv,).

        `forces` (rows,) are constraint forces, zero by default.
        """
        nv = self._model.nv
        pin.computeForwardKinematicsDerivatives(self._model, self._data, q, v, a)
        slopes = np.zeros((self.count, 3 * nv))
        force_by_q = np.zeros((nv, nv))
        for pair in self.pairs:
            to_first, V_1, twist, rate = self._motions(pair)
            second = to_first.action.dot(self._slopes(pair.second))
            apart = second
            if pair.is_loop:
                first = pair.first.placement.actionInverse.dot(self._slopes(pair.first))
                apart = second - first
            # The columns of a motion of frame 2 relative to frame 1
            relative = apart[:, 3 * nv :]
            turn = twist.action
            # d(X V_2) = X dV_2 - (X V_2) x (relative xi), and the same for accelerations.
            twist_by_q = apart[:, :nv]
            twist_by_q -= turn.dot(relative)
            rate_by_q = apart[:, nv : 2 * nv]
            rate_by_q -= rate.action.dot(relative)
            if pair.is_loop:
                own = V_1.action
                rate_by_q += (turn - own).dot(first[:, :nv])
                rate_by_q -= own.dot(twist_by_q)
                rate_by_v = apart[:, 2 * nv : 3 * nv]
                rate_by_v += (turn - own).dot(first[:, 3 * nv :])
                rate_by_v -= own.dot(relative)
            slopes[pair.rows] = pair.selected.dot(apart[:, : 3 * nv])
            if pair.is_loop:
                for start in range(0, 3 * nv, nv):
                    slopes[pair.rows, start : start + 6] = 0.0
            if forces is not None:
                wrench = pair.selected.T.dot(forces[pair.rows])
                # The turned wrench is n x theta, and f x theta + f x d for the force f, the moment
                # n, and the rotation theta and displacement d.
                turning = pin.Motion(wrench[3:], wrench[:3]).action.T
                turned = turning.dot(-relative.take(_SWAPPED, axis=0))
                force_by_q += second[:, 3 * nv :].T.dot(turned)
        return RowDerivatives(slopes, force_by_q)

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
            second = self._carrier(item.frame)
            motions = [
                array[frame.joint]
                for frame in (first, second)
                for array in (self._data.oMi, self._data.v, self._data.a)
            ]
            kinematics = _Kinematics(*motions)
            yield Pair(item, rows, item.rows, first, second, kinematics)
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

    def _motions(
        self, pair: Pair
    ) -> tuple[pin.SE3, pin.Motion, pin.Motion, pin.Motion]:
        """Return the motions of the frames of a constraint, in the axes of frame 1.

        They are the twist of frame 1, the twist of frame 2, and the acceleration of frame 2. The
        first result is the pose of the joint of frame 2 in frame 1.
        """
        state = pair.state
        to_first = (state.first_pose * pair.first.placement).actInv(state.second_pose)
        twist = to_first.act(state.second_twist)
        rate = to_first.act(state.second_rate)
        own = pair.first.placement.actInv(state.first_twist)
        return to_first, own, twist, rate

    def _slopes(self, frame: Carried) -> Array:
        """Return derivatives (6, 4 nv) of the motion of a joint, in its own axes.

        They are the derivatives of the twist by q, of the acceleration by q and by v, and the
        Jacobian.
        """
        return np.concatenate(
            pin.getJointAccelerationDerivatives(
                self._model, self._data, frame.joint, _LOCAL
            ),
            axis=1,
        )

    def _joint_jacobian(self, frame: Carried) -> Array:
        if frame.joint < ROOT:
            return np.zeros((6, self._model.nv))
        jacobian: Array = pin.getJointJacobian(
            self._model, self._data, frame.joint, _LOCAL
        )
        return jacobian


class Hold:
    """One constraint of a robot whose base is in its neutral pose in `data`.

    `rows` (rows, 6) are the rows of all constraints.
    """

    def __init__(self, pair: Pair, data: pin.Data, rows: Array) -> None:
        self._pair = pair
        self._placement = pair.first.placement
        # Pinocchio overwrites these poses in place.
        self._first = data.oMi[pair.first.joint]
        self._second = data.oMi[pair.second.joint]
        self._root = data.oMi[ROOT]
        self._rows = rows[pair.rows]

    def write(self, q: Array, limit: float) -> bool:
        """Write the rows of the constraint; return whether it is closed within a limit [m, rad].

        The product of the rows with the twists of joints, in the axes of `data`, is the relative
        twist in the rows of the constraint, or a regular combination of these rows.
        """
        first = self._first * self._placement
        if not self._pair.is_loop:
            moved = self._root * pin.XYZQUATToSE3(q[:7])
            first = self._root * moved.actInv(first)
        return self._write(first, limit)

    def _write(self, first: pin.SE3, limit: float) -> bool:
        pair = self._pair
        np.dot(pair.selected, first.actionInverse, out=self._rows)
        apart = first.actInv(self._second * pair.second.placement)
        left = apart.translation
        square = left.dot(left)
        if isinstance(pair.constraint, Hinge):
            axis = np.array(pair.constraint.axis)
            tilted = apart.rotation.dot(axis) - axis
            square += tilted.dot(tilted)
        return bool(square <= limit * limit)


class HeldWeld(Hold):
    """One weld. Its rows are the relative twist in the axes of `data`, so they are constant."""

    def __init__(self, pair: Pair, data: pin.Data, rows: Array) -> None:
        super().__init__(pair, data, rows)
        # If the weld is closed, this frame coincides with the frame of the second joint.
        self._placement = pair.first.placement * pair.second.placement.inverse()
        self._rows[:] = np.eye(6)

    def _write(self, first: pin.SE3, limit: float) -> bool:
        return bool(first.actInv(self._second).isIdentity(limit))


def hold_of(pair: Pair, data: pin.Data, rows: Array) -> Hold:
    """Return the `Hold` of a constraint."""
    if isinstance(pair.constraint, Weld):
        return HeldWeld(pair, data, rows)
    return Hold(pair, data, rows)


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
