"""Conventions of other tools for a free-flyer (`TOOLS`), and derivatives of their coordinates."""

from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import ChartError, InputError, unknown
from fflin.base.rotation import (
    product_matrix,
    quaternion_product,
    rotation_matrix,
    skew,
)
from fflin.base.validation import (
    Array,
    ArrayLike,
    instance,
    normalised,
    placement,
    vector,
)
from fflin.dynamics.coordinates import (
    ANGULAR,
    IN_REFERENCE_AXES,
    LINEAR,
    SMALLEST_Q0,
    refuse_orbit,
)
from fflin.dynamics.state import Actuation, StateMap
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot

# Step of complex-step differentiation along a motion. The step is so small that its square is
# lost by rounding in every sum. So the derivatives are exact to machine precision.
_STEP = 1e-20j

_NAMES = {
    "wxyz": ["quat.w", "quat.x", "quat.y", "quat.z"],
    "euler": ["roll", "pitch", "yaw"],
}
_UNITS = {"quat": "1", "p": "m", "v": "m/s"}  # all others have rad or rad/s


class Convention(NamedTuple):
    """Convention of a tool for the coordinates of a free-flyer."""

    # Attitude in the tool's state x': "wxyz" (a quaternion), "q_b", "euler", "tangent" (a rotation
    # vector), or "pose" (one tangent vector for attitude and position).
    attitude: str
    stored: str  # attitude in the tool's q: "wxyz", "xyzw", "matrix" or "euler"
    angular_first: bool
    # First flag: whether omega and the base torque are in world axes. Second flag: whether v and
    # the base force are in world axes.
    axes: tuple[bool, bool]
    # whether the base frame is the root link's inertial frame (`_centre`)
    at_centre: bool = False
    # whether the twist contains the rates of the Euler angles, not omega
    rates: bool = False


TOOLS = {
    "drake": Convention("wxyz", "wxyz", True, IN_REFERENCE_AXES["world"]),
    "mujoco": Convention("tangent", "wxyz", False, IN_REFERENCE_AXES["hybrid"]),
    "pinocchio": Convention("pose", "xyzw", False, IN_REFERENCE_AXES["local"]),
    "crocoddyl": Convention("pose", "xyzw", False, IN_REFERENCE_AXES["local"]),
    "spart": Convention(
        "tangent", "matrix", True, IN_REFERENCE_AXES["hybrid"], at_centre=True
    ),
    "euler": Convention("euler", "euler", True, IN_REFERENCE_AXES["hybrid"]),
    "euler_rates": Convention(
        "euler", "euler", True, IN_REFERENCE_AXES["hybrid"], rates=True
    ),
}


# Tools whose matrices can describe one time step of the semi-implicit Euler method (15.6).
STEPPING = ("mujoco", "crocoddyl")


class Jacobians(NamedTuple):
    """Derivatives of a tool's x' with respect to y (15.1), and of u with respect to u' and y.

    u is in base axes, and u' is in the axes of the tool.
    """

    P: Array  # dx'/dy (15.2)
    rate: Array  # time derivative of P along the motion
    left: Array  # left inverse of P
    V: Array  # du/du'
    H: Array  # du/dy for constant u' (15.4)
    # term dn/dt n^T of (15.5) for the length of a quaternion; zero without quaternion
    extra: Array


class ToolCoordinates:
    """Coordinates of a tool, or of fflin's own models, relative to a `StateMap`'s reference."""

    def __init__(
        self, state: StateMap, tool: str = "", *, moving: bool = False
    ) -> None:
        robot = state.robot
        is_fflin = not tool
        kind = TOOLS[tool] if tool else Convention("q_b", "xyzw", True, state.axes)
        self.state, self.convention, self._moving = state, kind, moving
        self.tangent = kind.attitude in ("tangent", "pose")
        # Shift for `np.roll` from the order (angular, linear) to the order of the tool.
        self._roll = 0 if kind.angular_first else 3
        self._world = np.repeat(kind.axes, 3)[:, None]
        self._base = _centre(robot) if kind.at_centre else pin.SE3.Identity()
        # from Pinocchio's (linear, angular) to (angular, linear)
        swap = np.roll(np.arange(6), 3)
        # X converts from the frame of the root link to the base frame of the tool. A displacement y
        # of the base becomes X y, a twist nu becomes X nu, and a wrench w becomes X^-T w.
        self._X: Array = self._base.toActionMatrixInverse()[np.ix_(swap, swap)]
        followers = () if is_fflin else map(attrgetter("joint"), robot.followers)
        self.joints = sorted((*robot.joints, *followers), key=attrgetter("idx_v"))
        if kind.stored in ("wxyz", "matrix") and robot.file_joints:
            self.joints.sort(key=lambda joint: _joint_path(robot, joint.name))
        self._idx_v = [*map(attrgetter("idx_v"), self.joints)]
        # Ratio of each joint velocity of Pinocchio to the joint velocity of the tool. It differs
        # from 1 only for modal amplitudes, which are scaled in Pinocchio's model.
        self._scales: Array = np.array([*map(attrgetter("scale"), self.joints)])
        if tool and kind.stored == "xyzw":
            self._scales[:] = 1.0
        self.actuation = acting = Actuation(state)
        # Wrenches (6, nu) of unit inputs. Only the columns of base torques and forces are nonzero.
        self._wrench = wrench = acting.fixed[:6]
        if (
            wrench[LINEAR].any()
            and not wrench[ANGULAR].any()
            and self._X[LINEAR, ANGULAR].any()
        ):
            raise InputError(
                "in spart, a base force acts at the centre of mass of the root link, so a "
                "BaseForce needs a BaseTorque for its moment about the origin of the link; give "
                "the robot a BaseTorque too"
            )
        # `inputs` contains, for each input of the tool, the index of the same input of the robot.
        self.inputs = np.arange(len(acting.names))
        at = np.flatnonzero(wrench.any(axis=0))
        if not is_fflin:
            self.inputs[at] = at[
                np.argsort((wrench[:, at].argmax(axis=0) + self._roll) % 6)
            ]
            motors = acting.groups.get("tau_m", at[:0])
            names = [f"tau_m.{joint.name}" for joint in self.joints]
            self.inputs[motors] = sorted(
                motors, key=lambda i: names.index(acting.names[i])
            )

    def states(self) -> dict[str, str]:
        """Return the names and units of x' as {name: unit}."""
        kind = self.convention
        units = dict[str, str]()
        attitude = _NAMES.get(kind.attitude, ["theta.x", "theta.y", "theta.z"])
        omega = (
            [f"{x}_rate" for x in attitude]
            if kind.rates
            else [f"omega.{x}" for x in "xyz"]
        )
        pose, twist = [*attitude, "p.x", "p.y", "p.z"], [*omega, "v.x", "v.y", "v.z"]
        for names, joint_name, angle in (
            (pose, "q_m", "rad"),
            (twist, "qdot_m", "rad/s"),
        ):
            base = np.roll(names, self._roll).tolist()
            units |= {name: _UNITS.get(name.partition(".")[0], angle) for name in base}
            units |= {f"{joint_name}.{j.name}": j.unit + angle[3:] for j in self.joints}
        return units

    def vectors(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Convert a valid Pinocchio configuration and velocity to the tool's q and v."""
        if (stored := self.convention.stored) == "xyzw":
            return q, v
        attitude, R = self._attitude(q)
        at = pin.SE3(self.state.rotation(q), self.state.positions(q)) * self._base
        if stored == "wxyz":
            attitude = np.roll(attitude, 1)
        elif stored == "euler":
            attitude = _angles(R)
        else:
            attitude = R.T.ravel()  # R by columns
        pose = np.concatenate((attitude, at.translation))
        turned = self._rotated(R, rates=self.convention.rates)
        twist = turned @ self._X @ self.state.velocities(v)[:6]
        joints = [joint.value(q) for joint in self.joints]
        parts = (pose, joints), (twist, v[self._idx_v] / self._scales)
        q, v = (
            np.concatenate((np.roll(base, self._roll), rest)) for base, rest in parts
        )
        return q, v

    def to_pinocchio(self, q: ArrayLike, v: ArrayLike | None) -> tuple[Array, Array]:
        """Convert the tool's q and v to Pinocchio's q and v; v=None means zero velocity."""
        robot = self.state.robot
        state = self.state
        size = 6 + len(self.joints)
        v = (
            np.zeros(size)
            if v is None
            else vector("v", v, size, "the tool's: base, then joints")
        )
        if self.convention.stored == "xyzw":
            return robot.checked_configuration(q), robot.checked_velocity(v)
        k = 3 + {"wxyz": 4, "matrix": 9}.get(self.convention.stored, 3)
        q = vector("q", q, k - 6 + size, "the tool's: base, then joints")
        pose, twist = np.roll(q[:k], -self._roll), np.roll(v[:6], -self._roll)
        R, at = self._rotation(pose[:-3]), pin.neutral(robot.model)
        base = pin.SE3(R, pose[-3:]) * self._base.inverse()
        at[:7] = pin.SE3ToXYZQUAT(state.origin.actInv(base))
        for joint, value in zip(self.joints, q[k:].tolist(), strict=True):
            joint.place(at, value)
        nu = np.linalg.solve(
            self._rotated(R, rates=self.convention.rates) @ self._X, twist
        )
        speed = state.spread(np.concatenate((nu, np.zeros(robot.n))))
        speed[self._idx_v] = v[6:] * self._scales
        return robot.checked_configuration(at), robot.checked_velocity(speed)

    def _rotation(self, attitude: Array) -> Array:
        """Return the rotation matrix (3, 3) of an attitude that is given as in the tool's q."""
        if self.convention.stored == "euler":
            R: Array = pin.rpy.rpyToMatrix(*attitude)
            return R
        if self.convention.stored == "matrix":
            R0 = pin.SE3(attitude.reshape(3, 3).T, np.zeros(3))
            R = placement("R0 (q[:9] by columns)", R0).rotation
            return R
        attitude = normalised("the quaternion w, x, y, z", attitude)
        return rotation_matrix(np.roll(attitude, -1))

    def _attitude(self, q: Array) -> tuple[Array, Array]:
        """Return the attitude of the tool's base as a quaternion x, y, z, w and as a matrix.

        The attitude is relative to the reference. In fflin's own coordinates relative to a moving
        reference, the attitude is the identity.
        """
        quaternion = quaternion_product(self.state.origin_quaternion, q[3:7])
        quaternion = quaternion_product(quaternion, pin.SE3ToXYZQUAT(self._base)[3:])
        if self.convention.attitude == "q_b":
            if quaternion[3] < 0.0:
                quaternion *= -1.0
            if self._moving:
                quaternion = np.array((0.0, 0.0, 0.0, 1.0))
        return quaternion, rotation_matrix(quaternion)

    def _rotated(self, R: Array, *, rates: bool = False) -> Array:
        """Return the matrix (6, 6) that rotates twists and wrenches from base axes to the tool's.

        If `rates` is True, the angular block converts omega to the rates of the Euler angles.
        """
        rotation = np.where(self._world, np.kron(np.eye(2), R), np.eye(6))
        if rates:
            rotation[ANGULAR, ANGULAR] = _of_angles(_angles(R))[0]
        return rotation

    def _held(self, parts: Array) -> Array:
        """Return the derivative (6, 3) of two vectors with respect to a base rotation (4.4).

        `parts` (6,) contains both vectors in base axes. A vector that the tool gives in world axes
        is constant in the world, so its components in base axes depend on the rotation. The
        derivative of a vector that the tool gives in base axes is zero.
        """
        derivative: Array = self._world * np.vstack(
            (skew(parts[ANGULAR]), skew(parts[LINEAR]))
        )
        return derivative

    def jacobians(self, q: Array, nu: Array, u: Array, rates: Array) -> Jacobians:
        """Return the `Jacobians` at a point.

        `q` is in Pinocchio's order. `nu`, `u` and `rates` are in base axes. `rates` (6 + n,) is the
        time derivative of `nu`.
        """
        quaternion, R = self._attitude(q)
        # Take a complex step along the motion. The real part of P is then P at the point, and the
        # imaginary part is the step times the time derivative of P.
        twist: Any = self._X @ nu[:6] + _STEP * (self._X @ rates[:6])
        spin = np.append(twist.real[ANGULAR], 0.0)
        quaternion_rate = 0.5 * product_matrix(quaternion) @ spin
        # If the reference moves with the robot, the attitude error and the tangent vector of the
        # pose stay zero, so they take no step.
        pose_step = 0j if self._moving else _STEP
        error_is_still = self._moving and self.convention.attitude == "q_b"
        attitude_step = 0j if error_is_still else _STEP
        pose, base_twist = self._base_jacobians(
            quaternion + attitude_step * quaternion_rate,
            twist,
            pose_step * twist.real,
        )
        P = self._with_joints(pose, base_twist)
        extra = np.zeros((len(P), len(P)))
        if self.convention.attitude == "wxyz":
            # from x, y, z, w to w, x, y, z
            rate_wxyz = np.roll(quaternion_rate, 1)
            extra[:4, :4] = np.outer(rate_wxyz, np.roll(quaternion, 1))
        left = self._left_inverse(P.real)
        V, H = self._input_jacobians(R, u)
        return Jacobians(P.real, P.imag / _STEP.imag, left, V, H, extra)

    def _base_jacobians(
        self, quaternion: Array, twist: Array, displacement: Array
    ) -> tuple[Array, Array]:
        """Return the derivatives (k, 12) of the base pose and (6, 12) of the base twist in x'.

        The columns are a rotation theta, a translation p, omega and v of the tool's base, all in
        base axes. `displacement` (6,) is the complex step of theta and p. `quaternion` (4,) and
        `twist` (6,) include the complex step.
        """
        kind = self.convention
        R = rotation_matrix(quaternion)
        scalar = quaternion[3]
        vector_part = quaternion[:3]
        # derivatives of the attitude and of the twist with respect to theta
        by_theta = -self._rotated(R) @ self._held(twist)
        attitude: Any = np.eye(3) + 0.5 * skew(displacement[ANGULAR])
        if kind.attitude == "euler":
            G, derivative = _of_angles(_angles(R), twist[ANGULAR])
            attitude = G
            by_theta[ANGULAR] = kind.rates * derivative @ G
        elif not self.tangent:
            attitude = 0.5 * (scalar * np.eye(3) + skew(vector_part))
            if kind.attitude == "wxyz":
                attitude = np.vstack((-0.5 * vector_part, attitude))
        k = len(attitude) + 3
        pose = np.zeros((k, 12), dtype=complex)
        pose[: k - 3, :3] = attitude
        if kind.attitude == "pose":
            # The tangent vector of the pose is in the axes of the base, and its translation
            # also depends on theta.
            pose[k - 3 :, :3] = 0.5 * skew(displacement[LINEAR])
            pose[k - 3 :, 3:6] = attitude
        else:
            pose[k - 3 :, 3:6] = R
        base_twist = np.zeros((6, 12), dtype=complex)
        base_twist[:, :3] = by_theta
        base_twist[:, 6:] = self._rotated(R, rates=kind.rates)
        return np.roll(pose, self._roll, 0), np.roll(base_twist, self._roll, 0)

    def _with_joints(self, pose: Array, base_twist: Array) -> Array:
        """Return P (15.2) from its base rows `pose` (k, 12) and `base_twist` (6, 12).

        The rows of P are the base pose, the joint positions, the base twist and the joint rates.
        """
        n = self.state.robot.n
        k = len(pose)
        nq = k + len(self.joints)
        P = np.zeros((nq + 6 + len(self.joints), 12 + 2 * n), dtype=complex)
        # The columns of base coordinates and base velocities are in the axes of the root link.
        base_columns = [*range(6), *range(6 + n, 12 + n)]
        X_twice = np.kron(np.eye(2), self._X)
        P[:k, base_columns] = pose @ X_twice
        P[nq : nq + 6, base_columns] = base_twist @ X_twice
        velocities = self.state.spread(np.eye(6 + n))[6:, self._idx_v]
        of_joints = (velocities / self._scales).T
        P[k:nq, 6 : 6 + n] = of_joints
        P[nq + 6 :, 12 + n :] = of_joints
        return P

    def _left_inverse(self, P: Array) -> Array:
        """Return the left inverse of P, computed block by block so that exact zeros stay exact."""
        nv = 6 + len(self.joints)
        nq = len(P) - nv
        coordinates = 6 + self.state.robot.n
        positions = _left(P[:nq, :coordinates])
        velocities = _left(P[nq:, coordinates:])
        below = -velocities @ P[nq:, :coordinates] @ positions
        zeros = np.zeros((coordinates, nv))
        return np.block([[positions, zeros], [below, velocities]])

    def _input_jacobians(self, R: Array, u: Array) -> tuple[Array, Array]:
        """Return V and H of the `Jacobians` under the inputs u; R is the tool's base attitude."""
        X, wrench = self._X, self._wrench
        rotation = X.T @ self._rotated(R).T - np.eye(6)
        V = np.eye(len(u)) + wrench.T @ rotation @ wrench
        H = np.zeros((len(u), 12 + 2 * self.state.robot.n))
        held = self._held(np.linalg.solve(X.T, wrench @ u))
        H[:, :3] = wrench.T @ X.T @ held @ X[ANGULAR, ANGULAR]
        return V[:, self.inputs], H


def tool_coordinates(
    robot: Robot, tool: str, *, moving: bool = False
) -> ToolCoordinates:
    """Return the coordinates of a tool for a robot.

    Raise an error if the tool is unknown or cannot represent the robot.
    """
    instance("tool", tool, str, f"a name: {', '.join(TOOLS)}")
    if tool not in TOOLS:
        raise unknown("tool", tool, TOOLS)
    if tool[:5] != "euler":
        refuse_orbit(robot, f"the coordinates of {tool}")
    return ToolCoordinates(StateMap(robot), tool, moving=moving)


def _centre(robot: Robot) -> pin.SE3:
    """Return the placement of the root link's inertial frame relative to the root link.

    The frame has its origin at the centre of mass, and the axes of the inertia in the URDF. If the
    link is not in `Robot.pieces`, the origin is the centre of mass of the whole base body, and the
    axes are the axes of the root link.
    """
    frames = (f for f in robot.model.frames.tolist() if f.type == pin.FrameType.BODY)
    name = next((frame.name for frame in frames if frame.parentJoint == ROOT), "")
    if piece := robot.pieces.get(name):
        return piece.placement
    return pin.SE3(np.eye(3), np.array(robot.model.inertias[ROOT].lever))


def _joint_path(robot: Robot, name: str) -> list[int]:
    """Return the URDF indices of the frames on the path from the root to a joint, for sorting.

    A frame that is not a joint of the URDF, such as a link, gets an index after the last joint.
    """
    frames = robot.model.frames
    path = list[int]()
    order = robot.file_joints
    at = robot.model.getFrameId(name, pin.FrameType.JOINT)
    while at:
        name, at = frames[at].name, frames[at].parentFrame
        index = order.index(name) if name in order else len(order)
        path.insert(0, index)
    return path


def _left(P: Array) -> Array:
    if len(P) == len(P.T):
        return np.asarray(np.linalg.inv(P))
    return np.asarray(np.linalg.solve(P.T @ P, P.T))


def _angles(R: Array) -> Array:
    """Return roll, pitch and yaw of R = R_z(yaw) R_y(pitch) R_x(roll).

    R may have an imaginary part, as in complex-step differentiation.
    """
    if np.hypot(R[0, 0].real, R[1, 0].real) < SMALLEST_Q0:
        raise ChartError(
            "the pitch is 90 deg, where roll and yaw cannot be distinguished; use a tool without "
            "Euler angles, or another attitude"
        )
    angles: Array = pin.rpy.matrixToRpy(R.real)
    if np.iscomplexobj(R):
        W = R.real.T @ R.imag
        angles = angles + 1j * _of_angles(angles)[0] @ (W[2, 1], W[0, 2], W[1, 0])
    return angles


def _of_angles(
    angles: Array, omega: ArrayLike = (0.0, 0.0, 0.0)
) -> tuple[Array, Array]:
    """Return G of de/dt = G omega for the Euler angles e, and the derivative d(G omega) / de."""
    (s, _, _), (c, cp, _), tp = np.sin(angles), np.cos(angles), np.tan(angles[1])
    G = np.array([[1.0, s * tp, c * tp], [0.0, c, -s], [0.0, s / cp, c / cp]])
    _, pitch, yaw = G @ omega
    bends = [
        [tp * pitch, yaw / cp, 0.0],
        [-cp * yaw, 0.0, 0.0],
        [pitch / cp, tp * yaw, 0.0],
    ]
    return G, np.array(bends)
