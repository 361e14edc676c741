"""State x = (q_b, r_b, q_m, omega_b, v_b, qdot_m), its frames and chart, and the inputs."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from itertools import compress

import numpy as np
import pinocchio as pin

import fflin.robot.inputs as kinds
from fflin.base import rotation as turning
from fflin.base.errors import ChartError, InputError
from fflin.base.validation import Array, ArrayLike, Indices, instance, placement, vector
from fflin.dynamics import coordinates as names
from fflin.dynamics.coordinates import (
    ANGULAR,
    IN_REFERENCE_AXES,
    LINEAR,
    SMALLEST_Q0,
    Chart,
    Frame,
)
from fflin.dynamics.magnetic import DistortedField
from fflin.dynamics.orbital import OrbitField
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.robot import Robot


class StateMap:
    r"""Map between Pinocchio's (q, v) and the state of the linear model.

    The state is :math:`X = (q_b, r_b, q_m, \omega_b, v_b, \dot q_m)` of dimension 12 + 2n. The base
    placement relative to the reference is :math:`{}^{ref}M_b = {}^oM_{ref}^{-1}\,{}^oM_b`. Its
    translation is r_b, and the vector part of its unit quaternion is q_b. Of the two quaternions
    of an attitude, the one with a scalar part of at least 0 is used.

    Parameters
    ----------
    robot : Robot
    reference : pin.SE3, optional
        Placement oMref relative to which the attitude and position of the base are measured; the
        identity by default.
    frame : {"hybrid", "local", "world", "lvlh", "hill"}
        Axes of the angular velocity omega_b of the base and of the velocity v_b of its origin:

        - hybrid (default): omega_b in base axes, v_b = d r_b/dt in reference axes;
        - local: omega_b and v_b in base axes;
        - world: omega_b and v_b in reference axes;
        - lvlh (default in orbit) or hill: the same axes as hybrid, for a robot in orbit only.
          Pinocchio's world is then the orbital frame, with the axes lvlh or hill. With local in
          orbit, it is the orbital frame with the axes lvlh.
    t : float
        Time [s] for which `orbit` holds. It matters only in an elliptic orbit, and for
        magnetorquers.

    Attributes
    ----------
    nx : int
        Number of states, 12 + 2n.
    names, units : tuple of str
        Names and units of the nx states.
    groups : Groups
        Slices of q_b, r_b, q_m, omega_b, v_b, qdot_m in the state.
    axes : tuple of bool
        Whether omega_b is in reference axes, and whether v_b is in reference axes.
    in_reference : tuple of slice
        Slices of nu = (omega_b, v_b, qdot_m), or of generalised forces in the same order, whose
        components are in reference axes.
    S : ndarray (nv, 6 + n) or None
        Matrix S of v = S nu, with nu = (omega_b, v_b, qdot_m) in base axes, if the robot has mimic
        joints or modes. Otherwise S is None, because v is only a permutation of nu.
    unbounded : ndarray of int
        Indices of the continuous joints among the n joints.
    origin_quaternion : ndarray (4,)
        Attitude of `origin` as a quaternion x, y, z, w.
    orbit : tuple of ndarray (3,), (3, 3), or None
        For a robot in orbit, a vector and a matrix in the axes of the reference frame. The vector
        is the angular velocity of this frame. The matrix maps the position of a point at rest in
        this frame to the acceleration of the point. None without an orbit.

    Raises
    ------
    InputError
        If the frame is unknown or the reference is not a pin.SE3.
    ModelError
        If the robot's Pinocchio model (``robot.model``) was modified after the robot was created.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> state = fflin.StateMap(robot, frame="local")
    >>> x = state.to_state(robot.neutral(), fflin.velocity(robot, {"joint_1": 0.1}))
    >>> q, v = state.to_pinocchio(x)
    >>> state.nx, state.names[-3], float(x[-3])
    (18, 'qdot_m.joint_1', 0.1)
    """

    def __repr__(self) -> str:
        return f"StateMap('{self.robot.name}', nx={self.nx}, frame='{self.frame}')"

    def __init__(
        self,
        robot: Robot,
        *,
        reference: pin.SE3 | None = None,
        frame: Frame | None = None,
        t: float = 0.0,
    ) -> None:
        instance("robot", robot, Robot, "a fflin.Robot; fflin.load makes one")
        robot.require_unchanged()
        n = robot.n
        self.robot = robot
        self.frame = names.frame_of(robot, frame)
        self.axes = IN_REFERENCE_AXES[self.frame]
        self.in_reference = tuple(compress((ANGULAR, LINEAR), self.axes))
        # Acceleration field of the orbit, or None if the robot is not in orbit.
        self.field = OrbitField(robot, self.frame) if robot.orbit else None
        self.elliptic = self.field is not None and self.field.elliptic
        # Whether the dynamics depend on time.
        self.varying = self.elliptic or kinds.has_magnetorquers(robot.inputs)
        self.move_to(t)
        self.nx = 12 + 2 * n
        self.groups = names.Groups(
            q_b=slice(0, 3),
            r_b=slice(3, 6),
            q_m=slice(6, 6 + n),
            omega_b=slice(6 + n, 9 + n),
            v_b=slice(9 + n, 12 + n),
            qdot_m=slice(12 + n, self.nx),
        )
        units = names.state_units(robot)
        self.names = tuple(units)
        self.units = tuple(units.values())
        joints = robot.joints
        # For each velocity of the state, its index in Pinocchio's v.
        idx_v = [joint.idx_v for joint in joints]
        self._order = np.array([3, 4, 5, 0, 1, 2, *idx_v], dtype=np.intp)
        # For each entry of Pinocchio's v, the index of this velocity in nu. Mimic joints have no
        # velocity in nu, and `spread` writes their entries of v afterwards.
        self._place = np.zeros(robot.nv, dtype=np.intp)
        self._place[self._order] = np.arange(6 + n)
        # `_flat` contains, for each entry of a matrix (6 + n, 6 + n) in state order, the index of
        # the same entry in a flattened matrix (nv, nv) in Pinocchio's order.
        self._flat = self._order[:, None] * robot.nv + self._order
        self._flat_transposed = np.ascontiguousarray(self._flat.T)
        # Factor from each velocity of the state to Pinocchio's v. It is 1 except for the velocities
        # of modal amplitudes.
        self._scale = np.array([1.0] * 6 + [joint.scale for joint in joints])
        self._scaled = bool((self._scale != 1.0).any())
        # Matrix S of v = S nu. It is None without mimic joints and modes, because S is then only
        # the permutation `_order`.
        self.S: Array | None = None
        if robot.followers or self._scaled:
            self.S = np.column_stack([self.spread(e) for e in np.eye(6 + n)])
        self._idx_q = np.array([joint.idx_q for joint in joints], dtype=np.intp)
        self.unbounded = np.flatnonzero([joint.unbounded for joint in joints])
        # In Pinocchio's q, a continuous joint has two entries: cosine and sine of its angle.
        self._cos = self._idx_q[self.unbounded]
        self._sin = self._cos + 1
        root = robot.model.jointPlacements[ROOT].rotation
        self._gravity: Array = root.T @ np.array(robot.gravity)
        self._pulled = any(robot.gravity)
        # Whether gravity or the motion in orbit accelerates the base's origin relative to the
        # reference.
        self.falls = self._pulled or robot.orbit is not None
        oMref = pin.SE3.Identity()
        if reference is not None:
            oMref = placement("reference", reference)
        self._refer(oMref)

    def about(self, reference: pin.SE3) -> StateMap:
        """Return a copy of the map with another reference placement and the same `frame`."""
        other = copy(self)
        other._refer(reference)
        return other

    def _refer(self, oMref: pin.SE3) -> None:
        self._reference = oMref
        # The free-flyer joint of the model may have a placement other than the identity. Rotations
        # are composed as quaternions, which are accurate to machine precision even near 180 deg.
        offset = pin.SE3ToXYZQUAT(oMref.actInv(self.robot.model.jointPlacements[ROOT]))
        self._position, self.origin_quaternion = offset[:3], offset[3:]
        self._rotation = turning.rotation_matrix(self.origin_quaternion)
        self._aligned = bool((self._rotation == np.eye(3)).all())

    def move_to(self, t: float) -> None:
        """Set the time t [s] for which `orbit` and all fields hold; see `OrbitField.move_to`."""
        self.t = t
        if self.field:
            self.field.move_to(t)

    @property
    def orbit(self) -> tuple[Array, Array] | None:
        """Rotation and field of the orbit in the axes of the reference, see `StateMap`."""
        field = self.field
        if field is None:
            return None
        R = self._reference.rotation
        return R.T @ field.rate, R.T @ field.pull @ R

    @property
    def reference(self) -> pin.SE3:
        """Copy of the reference placement oMref."""
        return pin.SE3(self._reference)

    @property
    def origin(self) -> pin.SE3:
        """Base placement relative to the reference if q[:7] is 0, 0, 0, 0, 0, 0, 1."""
        return pin.XYZQUATToSE3(
            np.concatenate((self._position, self.origin_quaternion))
        )

    def chart(self, q: Array) -> Chart:
        """Return the attitude chart at a valid configuration q (nq,).

        `charts` returns the charts at several configurations.

        Raises
        ------
        ChartError
            If the base is rotated by 180 deg from the reference.
        """
        chart = self.unchecked_chart(q)
        if chart.q0 < SMALLEST_Q0:
            raise ChartError(
                "the base is rotated by 180 deg from the reference, where the attitude chart "
                "(quaternion vector part) is singular; give a reference nearer to the base"
            )
        return chart

    def unchecked_chart(self, q: Array) -> Chart:
        """Return the attitude chart at a valid q (nq,), without the check against 180 deg.

        At 180 deg, the matrix J does not exist, but q_b and R do. The sign of the quaternion in q
        then selects one of the two values of q_b.
        """
        return Chart.of(turning.quaternion_product(self.origin_quaternion, q[3:7]))

    def charts(self, q: Array) -> Chart:
        """Return the attitude charts at valid q (.., nq), without the check against 180 deg."""
        return Chart.of(q[..., 3:7] @ turning.product_matrix(self.origin_quaternion).T)

    def rotation(self, q: Array) -> Array:
        """Return the rotation matrix (3, 3) of the base relative to the reference, at a valid q.

        Unlike the chart, the rotation matrix is regular at an attitude 180 deg from the reference.
        """
        turned: Array = pin.XYZQUATToSE3(q[:7]).rotation
        if self._aligned:
            return turned
        rotation: Array = self._rotation.dot(turned)
        return rotation

    def gravity(self, q: Array) -> Array:
        """Return gravity (.., 3) [m/s^2] in base axes at valid configurations q (.., nq)."""
        if not self._pulled:
            return self._gravity
        turned = turning.rotation_matrix if q.ndim == 1 else turning.rotation_matrices
        rotated: Array = self._gravity @ turned(q[..., 3:7])  # R^T g
        return rotated

    def scalar(self, q: Array) -> float:
        """Return the scalar part q0 of the base quaternion relative to the reference.

        The sign of q0 changes with the sign of the quaternion in the valid configuration q (nq,).
        """
        return float(turning.quaternion_product(self.origin_quaternion, q[3:7])[3])

    def to_state(self, q: Array, v: Array, *, near: Array | None = None) -> Array:
        """Convert a Pinocchio configuration and velocity to a state.

        Parameters
        ----------
        q : array_like (nq,)
            Configuration.
        v : array_like (nv,)
            Velocity in Pinocchio's order: linear and angular velocity of the base in base axes,
            then joint rates.
        near : array_like (nx,), optional
            State for unwrapping the angles of continuous joints: each angle is shifted by the
            multiple of 2 pi that brings it closest to its value in `near`. By default, the angles
            are in (-pi, pi].

        Returns
        -------
        ndarray (nx,)

        Raises
        ------
        ChartError
            If the base is rotated by 180 deg from the reference.
        InputError
            If an argument has a wrong size or an entry that is not finite.
        """
        q = self.robot.checked_configuration(q)
        v = self.robot.checked_velocity(v)
        if near is not None:
            near = vector("near", near, self.nx, "a state (12 + 2n)")
        self.chart(q)  # raises an error at 180 deg
        return self.read(q, v, near=near)

    def read(self, q: Array, v: Array, *, near: Array | None = None) -> Array:
        """Return the same state as `to_state`, without checking the arguments.

        Control laws read the state at every attitude. Therefore 180 deg is allowed here, see
        `unchecked_chart`.
        """
        q_m, nu = self.joint_positions(q), self.velocities(v)
        x = self.compose(self.unchecked_chart(q), self.positions(q), q_m, nu)
        if near is None:
            return x
        return names.unwound(x, 6 + self.unbounded, near)

    def compose(self, chart: Chart, r_b: Array, q_m: Array, nu: Array) -> Array:
        """Assemble the state (.., nx) from parts; velocities nu (.., 6 + n) are in base axes."""
        in_frame = chart.to_reference(self.in_reference, nu[..., None])[..., 0]
        return np.concatenate((chart.q_b, r_b, q_m, in_frame), -1)

    def to_pinocchio(self, x: ArrayLike) -> tuple[Array, Array]:
        """Convert a state to a Pinocchio configuration and velocity.

        Parameters
        ----------
        x : array_like (nx,)

        Returns
        -------
        q : ndarray (nq,)
        v : ndarray (nv,)

        Raises
        ------
        ChartError
            If the norm of q_b is 1 (a rotation by 180 deg), or exceeds 1 and therefore describes no
            attitude.
        InputError
            If x has a wrong size or an entry that is not finite.
        """
        _, q, v = self.points(vector("x", x, self.nx, "a state (12 + 2n)")[None])
        return q[0], v[0]

    def points(self, x: Array) -> tuple[Chart, Array, Array]:
        """Return the attitude charts, configurations and velocities of states (N, nx)."""
        g = self.groups
        if not np.isfinite(x).all():
            raise InputError("x has entries that are not finite; give finite numbers")
        square = 1.0 - (x[:, g.q_b] ** 2).sum(axis=1, keepdims=True)
        if not (square >= SMALLEST_Q0**2).all():
            raise ChartError(
                f"|q_b| is {np.sqrt(1.0 - square.min()):.9g}, expected less than 1: at 1 the base "
                "is rotated by 180 deg from the reference, where the attitude chart is singular"
            )
        relative = np.concatenate((x[:, g.q_b], np.sqrt(square)), axis=1)
        chart = Chart(
            relative[:, :3], relative[:, 3:], turning.rotation_matrices(relative)
        )
        q = np.empty((len(x), self.robot.nq))
        q[:, :3] = turning.row_products(x[:, g.r_b] - self._position, self._rotation)
        turned = turning.row_products(
            relative, turning.product_matrix(self.origin_quaternion)
        )
        q[:, 3:7] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        angles = x[:, g.q_m]
        q[:, self._idx_q] = angles * self._scale[6:]
        q[:, self._cos] = np.cos(angles[:, self.unbounded])
        q[:, self._sin] = np.sin(angles[:, self.unbounded])
        if self.robot.followers:
            for row in q:
                self.robot.follow(row)
        nu = chart.to_base(self.in_reference, x[:, 6 + self.robot.n :, None])[..., 0]
        return chart, q, self.spread(nu)

    def velocities(self, v: Array) -> Array:
        """Return (omega_b, v_b, qdot_m) (.., 6 + n) in base axes from Pinocchio's v (.., nv)."""
        nu = v.take(self._order, axis=-1)
        if self._scaled:
            nu = nu / self._scale
        return nu

    def spread(self, nu: Array) -> Array:
        """Return Pinocchio's v = S nu (.., nv) from nu = (omega_b, v_b, qdot_m) in base axes."""
        if self._scaled:
            nu = nu * self._scale
        v = nu.take(self._place, axis=-1)
        for joint, leader, multiplier, _ in self.robot.followers:
            v[..., joint.idx_v] = multiplier * v[..., leader.idx_v]
        return v

    def lift(self, forces: Array) -> Array:
        """Return Pinocchio's tau (nv, ...) from generalised forces (6 + n, ...) in base axes."""
        tau = np.zeros((self.robot.nv, *forces.shape[1:]))
        tau[self._order] = (forces.T / self._scale).T
        return tau

    def forces(self, tau: Array) -> Array:
        """Return generalised forces S^T tau (6 + n, ...) in base axes from tau (nv, ...)."""
        if self.S is None:
            return tau.take(self._order, axis=0)
        return self.S.T @ tau

    def columns(self, matrix: Array) -> Array:
        """Return ``matrix @ S``: convert columns (..., nv) from Pinocchio's v to state order."""
        if self.S is None:
            return matrix.take(self._order, axis=1)
        return matrix @ self.S

    def project(self, matrix: Array, out: Array | None = None) -> Array:
        """Return ``S.T @ matrix @ S``: convert a matrix (nv, nv) from Pinocchio's v to state order.

        See (7.3) of docs/derivation.md.
        """
        if self.S is not None:
            return np.matmul(self.S.T @ matrix, self.S, out=out)
        # With mode="clip", NumPy writes directly into `out`, without a buffer. This mode clips no
        # index here, because all indices are in range.
        return matrix.take(self._flat, out=out, mode="clip")

    def project_transposed(self, matrix: Array, out: Array) -> None:
        """Write the last k rows of ``(S.T @ matrix @ S).T`` to a C-contiguous array (k, 6 + n)."""
        if self.S is None:
            matrix.take(
                self._flat_transposed[out.shape[1] - len(out) :], out=out, mode="clip"
            )
        else:
            out[:] = (self.S.T @ matrix @ self.S).T[out.shape[1] - len(out) :]

    def to_frame(self, chart: Chart, vectors: Array) -> Array:
        """Transform velocities or wrenches (.., 6 + n, k) from base axes to the axes of `frame`.

        The transformation matrix is F in (4.6) of docs/derivation.md.
        """
        return chart.to_reference(self.in_reference, vectors)

    def to_base(self, chart: Chart, vectors: Array) -> Array:
        """Transform velocities or wrenches (.., 6 + n, k) from the axes of `frame` to base axes.

        The transformation matrix is the transpose of F in (4.6) of docs/derivation.md.
        """
        return chart.to_base(self.in_reference, vectors)

    def joint_positions(self, q: Array) -> Array:
        """Return joint positions q_m (.., n) [rad|m|kg^0.5 m] at valid configurations (.., nq)."""
        angles = q.take(self._idx_q, axis=-1)
        if self._scaled:
            angles = angles / self._scale[6:]
        if self._cos.size:
            sines, cosines = q.take(self._sin, axis=-1), q.take(self._cos, axis=-1)
            angles[..., self.unbounded] = np.arctan2(sines, cosines)
        return angles

    def joints_apart(self, before: Array, q: Array) -> Array:
        """Return the change of q_m (n,) between the valid configurations `before` and `q` (nq,)."""
        apart: Array = (q.take(self._idx_q) - before.take(self._idx_q)) / self._scale[
            6:
        ]
        if self._cos.size:
            s, c, s_0, c_0 = (
                x.take(at) for x in (q, before) for at in (self._sin, self._cos)
            )
            apart[self.unbounded] = np.arctan2(s * c_0 - c * s_0, c * c_0 + s * s_0)
        return apart

    def positions(self, q: Array) -> Array:
        """Return the base positions r_b (.., 3) [m] at valid configurations (.., nq)."""
        positions: Array = self._position + q[..., :3] @ self._rotation.T
        return positions


class Actuation:
    """Inputs of a robot: their names and units, the matrix B_u, and their wrenches on the links."""

    # Magnetic field in which the magnetorquers act, if it is not the field of `state`.
    true_field: DistortedField | None = None

    def __init__(self, state: StateMap) -> None:
        robot = state.robot
        nv = 6 + state.robot.n
        self.state = state
        self._model = robot.model
        names: list[str] = []
        units: list[str] = []
        # {group: indices of its inputs}. The groups are tau_b, F_b, tau_m, thrust and wheel. They
        # are in the order of their first inputs.
        self.groups: dict[str, list[int]] = {}
        columns: list[Array] = []
        held: list[slice] = []
        # {joint: inputs that are mounted on it}, for thrusters and for wheels that are modelled
        # without a joint of their own. Each input is (its index, wrench (6,) of a unit input in the
        # frame of the joint).
        carried: dict[int, list[tuple[int, Array]]] = {}
        self.torquers = _torquers(state)
        identity = np.eye(nv)
        for item, input_names in robot.named_inputs:
            at = len(columns)
            unit = item.UNIT
            if isinstance(item, kinds.BaseTorque | kinds.BaseForce):
                rows = ANGULAR if isinstance(item, kinds.BaseTorque) else LINEAR
                columns += list(identity[rows])
                if rows in state.in_reference:
                    held.append(slice(at, at + 3))
            elif isinstance(item, kinds.JointTorque):
                index = robot.joint_names.index(item.joint)
                unit = robot.joints[index].force_unit
                columns.append(identity[6 + index])
            elif isinstance(item, kinds.ReactionWheel) and item.inertia:
                columns.append(identity[6 + robot.joint_names.index(input_names[0])])
            elif isinstance(item, kinds.Magnetorquer):
                columns.append(np.zeros(nv))
            else:
                assert isinstance(item, kinds.Thruster | kinds.ReactionWheel)
                joint, placement = find_frame(robot.model, item.frame)
                wrench = np.array(placement.act(pin.Force(item.wrench)).vector)
                carried.setdefault(joint, []).append((at, wrench))
                columns.append(np.zeros(nv))
            names += input_names
            units += [unit] * len(input_names)
            self.groups.setdefault(item.GROUP, []).extend(range(at, len(columns)))
        if len({*names}) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(
                f"two inputs are named '{twice}'; give one of them another name"
            )
        # Linear models have the attributes `input_names` and `input_units`. They are defined here
        # too, so that some functions accept either object.
        self.names = self.input_names = tuple(names)
        self.units = self.input_units = tuple(units)
        # One slice of three inputs for each torque or force on the base that is in reference axes.
        self.held = tuple(held)
        # B_u (6 + n, nu) with zero columns for the inputs whose generalised forces depend on the
        # configuration.
        self.fixed: Array = np.column_stack(columns) if columns else np.zeros((nv, 0))
        # Whether the inputs are tau_b, F_b and all joint torques in state order, so that B_u is the
        # identity.
        self.default = self.fixed.shape == (nv, nv) and bool(
            (self.fixed == identity).all()
        )
        # (joint, indices, wrenches) for each joint in `carried`. The indices (k,) are the positions
        # in u of the k inputs that are mounted on the joint. The wrenches (6, k) of unit inputs are
        # in the frame of the joint.
        self.wrench_columns: list[tuple[int, Indices, Array]] = []
        self._of_carried: list[int] = []
        for joint, items in carried.items():
            places, wrenches = zip(*items, strict=True)
            self.wrench_columns.append(
                (joint, np.array(places), np.column_stack(wrenches))
            )
            self._of_carried += places
        self.carried = bool(carried)  # whether columns depend on the configuration

    def columns(self, data: pin.Data, q: Array, flux: Array | None = None) -> Array:
        """Return B_u (6 + n, nu) at q, the generalised forces of unit inputs in base axes (6.1).

        `flux` (3,) is the magnetic flux density [T] in the axes in which q gives the attitude of
        the base. By default, it is the flux density at the time of `state` in the orbital frame.
        """
        if not (self.carried or self.torquers):
            return self.fixed
        columns = self.fixed.copy()
        pin.computeJointJacobians(self._model, data, q)
        if self.torquers:
            self._write_torquers(
                data, self.flux(self.state.t) if flux is None else flux, columns
            )
        if not self.carried:
            return columns
        forces = [
            pin.getJointJacobian(
                self._model, data, joint, pin.ReferenceFrame.LOCAL
            ).T.dot(wrenches)
            for joint, _, wrenches in self.wrench_columns
        ]
        columns[:, self._of_carried] = self.state.forces(np.concatenate(forces, axis=1))
        return columns

    def flux(self, t: float) -> Array:
        """Return the magnetic flux density (3,) [T] at time t [s], in orbital axes."""
        if self.true_field is not None:
            return self.true_field.at(t)
        field = self.state.field
        assert field is not None
        assert field.magnetic is not None
        return field.magnetic.at(t)

    def magnetic_columns(self, data: pin.Data, q: Array, flux: Array) -> Array:
        """Return the columns of `columns` that belong to magnetorquers, all others as zeros."""
        columns = np.zeros_like(self.fixed)
        pin.computeJointJacobians(self._model, data, q)
        self._write_torquers(data, flux, columns)
        return columns

    def _write_torquers(self, data: pin.Data, flux: Array, columns: Array) -> None:
        """Write the columns of magnetorquers; `data` must contain the Jacobians of the joints."""
        local = pin.ReferenceFrame.LOCAL
        for joint, index, axis in self.torquers:
            x, y, z = axis
            flux_x, flux_y, flux_z = data.oMi[joint].rotation.T.dot(flux)
            torque = np.array(
                (
                    y * flux_z - z * flux_y,
                    z * flux_x - x * flux_z,
                    x * flux_y - y * flux_x,
                )
            )
            J = pin.getJointJacobian(self._model, data, joint, local)
            columns[:, index] = self.state.forces(torque.dot(J[names.PIN_ANGULAR]))

    def in_base_axes(self, chart: Chart, u: Array) -> Array:
        """Return the inputs u (.., nu) with all torques and forces on the base in base axes."""
        if not self.held:
            return u
        return chart.to_base(self.held, u[..., None])[..., 0]

    def wrenches(self, u: Array) -> pin.StdVec_Force | None:
        """Return the wrenches of thrusters and wheels on all joints, in the frames of the joints.

        Wheels are included only if they are modelled without a joint of their own. The result is
        None if the robot has neither such wheels nor thrusters.
        """
        if not self.carried:
            return None
        external = pin.StdVec_Force(self._model.njoints, pin.Force.Zero())
        for joint, inputs, wrenches in self.wrench_columns:
            external[joint] = pin.Force(wrenches.dot(u.take(inputs)))
        return external


def _torquers(state: StateMap) -> list[tuple[int, int, Array]]:
    """Return (joint, index in u, axis (3,) in the frame of the joint) of each magnetorquer.

    Raise `InputError` if there are magnetorquers, but no magnetic field.
    """
    robot = state.robot
    torquers: list[tuple[int, int, Array]] = []
    at = 0
    for item, input_names in robot.named_inputs:
        if isinstance(item, kinds.Magnetorquer):
            joint, placement = find_frame(robot.model, item.frame)
            torquers.append((joint, at, placement.rotation @ np.array(item.axis)))
        at += len(input_names)
    if torquers and not (state.field and state.field.magnetic):
        raise InputError(
            f"'{robot.name}' has magnetorquers but no magnetic field; give it an orbit with a "
            "field, such as CircularOrbit(500e3, inclination=1.7, field='dipole') or --orbit 500e3 "
            "--inclination 1.7 --field dipole"
        )
    return torquers


def selection(names: Sequence[str], known: Sequence[str]) -> Array:
    """Return the matrix S (k, n) that selects k of the n entries of a vector by their names.

    `names` lists the names of the selected entries, and `known` lists the names of all entries.
    """
    return np.eye(len(known))[[*map(known.index, names)]]
