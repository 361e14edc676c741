"""Orbital frame: velocities relative to it, and the gravity-gradient field (14.1), (17.1)."""

import math
import warnings
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, InputError
from fflin.base.rotation import rotation_matrices, skew
from fflin.base.validation import Array, Mask
from fflin.dynamics.coordinates import ANGULAR, LINEAR, PIN_ANGULAR, PIN_LINEAR
from fflin.dynamics.magnetic import MagneticField
from fflin.robot.joints import ROOT
from fflin.robot.orbit import CircularOrbit, EllipticOrbit, OrbitState
from fflin.robot.robot import Robot

# For each orbital frame, two unit vectors in its axes: the direction away from the central body,
# and the orbit normal. The frame "local" has velocities in base axes, and its world is "lvlh".
_LVLH = ((0.0, 0.0, -1.0), (0.0, -1.0, 0.0))
_AXES = {
    "hill": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "lvlh": _LVLH,
    "local": _LVLH,
}


def normal_of(frame: str) -> Array:
    """Return the unit vector (3,) along the orbit normal in the axes of an orbital frame."""
    return np.array(_AXES[frame][1])


def mean_motion(robot: Robot) -> float:
    """Return the mean motion of a robot's orbit [rad/s], or 0 without an orbit."""
    return robot.orbit.mean_motion if robot.orbit else 0.0


# Limits of the relative error of the linear gravity field (14.1). Above `_COARSE`, a warning is
# given. Above `_USELESS`, an error is raised.
_COARSE, _USELESS = 0.01, 0.5


class OrbitField:
    """Accelerations of masses in the rotating frame of an orbit at one time.

    If the orbit is elliptic, `move_to` changes the time and with it all quantities of this list:

    - `rate` (3,): angular velocity of the frame [rad/s].
    - `rate_change` (3,): derivative of `rate` [rad/s^2]; zero in a circular orbit.
    - `tide` (3, 3): matrix G of (14.1). At a position x, gravity per unit mass minus gravity at the
      frame's origin is `tide` x.
    - `gradient`: the gravitational parameter divided by the cube of the radius [1/s^2].
    - `pull` (3, 3): matrix K of (14.2) or (17.1). A free mass that is at rest in the frame at x has
      the acceleration `pull` x relative to the frame.

    One quantity is constant:

    - `axes` (3, 3): its columns are three unit vectors: away from the central body, along the
      orbit, and along the orbit normal.
    """

    def __init__(self, robot: Robot, frame: str) -> None:
        r, z = (np.array(axis) for axis in _AXES[frame])
        bodies = robot.model.inertias.tolist()[ROOT:]
        self.robot = robot
        self._root = robot.model.jointPlacements[ROOT]
        self._stored = robot.stored_momentum
        self.axes: Array = np.column_stack((r, np.cross(z, r), z))
        self._normal = z
        self._tide_of_unit = 3.0 * np.outer(r, r) - np.eye(3)
        self.elliptic = isinstance(robot.orbit, EllipticOrbit)
        self._start = _state_at(robot.orbit, 0.0)
        self._set(self._start)
        self._mass = np.array([[body.mass] for body in bodies])
        self._lever = np.array([body.lever for body in bodies])[..., None]
        self._levers = np.array([skew(body.lever) for body in bodies])
        self._inertia = np.array([body.inertia for body in bodies])
        self._none = pin.Force.Zero()
        self.magnetic: MagneticField | None = None
        if robot.orbit and robot.orbit.field is not None:
            self.magnetic = MagneticField(robot.orbit, self.axes)
        placements = robot.model.jointPlacements.tolist()[ROOT + 1 :]
        steps = [placement.translation for placement in placements]
        self._reach = sum(float(np.linalg.norm(x)) for x in (*steps, *self._lever))

    def _set(self, now: OrbitState) -> None:
        self._now = now
        self.gradient = now.gradient
        self.rate: Array = now.rate * self._normal
        self.rate_change: Array = now.rate_change * self._normal
        self.tide: Array = now.gradient * self._tide_of_unit
        self._turning = skew(self.rate)
        self.pull: Array = self.tide - self._turning @ self._turning
        if self.elliptic:
            self.pull = self.pull - skew(self.rate_change)

    @property
    def _radius(self) -> float:
        """Distance [m] from the central body; infinite without an orbit."""
        return self._now.radius if self.robot.orbit else math.inf

    def move_to(self, t: float) -> None:
        """Set the time t [s]. In a circular orbit, nothing depends on time."""
        if self.elliptic:
            self._set(_state_at(self.robot.orbit, t))

    @property
    def velocity(self) -> Array:
        """Inertial velocity (3,) [m/s] of the frame's origin, in the axes of the frame."""
        now = self._now
        # The gradient mu / r^3 changes by -3 mu / r^4 dr/dt.
        climb = -now.gradient_change / now.gradient * now.radius / 3.0
        velocity: Array = self.axes @ (climb, now.radius * now.rate, 0.0)
        return velocity

    def turned(self, t: float) -> Array:
        """Return the rotation (3, 3) of the orbital axes from t = 0 to time t [s]."""
        rotation = t * self.rate
        if self.elliptic:
            angle = _state_at(self.robot.orbit, t).angle - self._start.angle
            rotation = angle * self._normal
        axes: Array = pin.exp3(rotation)
        return axes

    def base(self, q: Array) -> tuple[Array, Array]:
        """Return the attitude (3, 3) and position (3,) of the base in the orbital frame."""
        base = self._root * pin.XYZQUATToSE3(q[:7])
        return base.rotation, base.translation

    def attitudes(self, q: Array) -> Array:
        """Return the attitudes (N, 3, 3) of the base in the orbital frame at rows q (N, nq)."""
        rotations: Array = self._root.rotation @ rotation_matrices(q[:, 3:7])
        return rotations

    def positions(self, q: Array) -> Array:
        """Return the positions (N, 3) of the base in the orbital frame at rows q (N, nq)."""
        positions: Array = q[:, :3] @ self._root.rotation.T + self._root.translation
        return positions

    def falls(self, q: Array) -> Array:
        """Return `GravityGradient.fall` (N, 3) at rows q (N, nq)."""
        pull = (self.positions(q) @ self.pull.T)[:, None]
        fall: Array = (pull @ self.attitudes(q))[:, 0]
        return fall

    def is_near(self, q: Array) -> Mask:
        """Return a mask (N,) of the rows q (N, nq) at which `require_near` gives no warning."""
        distance = np.linalg.norm(self.positions(q), axis=1) + self._reach
        near: Mask = 1.5 * distance <= _COARSE * self._radius
        return near

    def require_near(self, q: Array) -> None:
        """Check that the robot is near the origin of the orbital frame, where (14.1) is accurate.

        Warn if the relative error at the robot may exceed `_COARSE`. Raise `InputError` if it may
        exceed `_USELESS`.
        """
        distance = float(np.linalg.norm(self.base(q)[1])) + self._reach
        error = 1.5 * distance / self._radius
        message = (
            f"'{self.robot.name}' extends to {distance / 1e3:.4g} km from the origin of its orbit "
            f"frame, where the linear gravity gradient has an error of up to {100.0 * error:.2g} %"
        )
        if error > _USELESS:
            raise InputError(f"{message}; choose an orbit that is nearer to the robot")
        if error > _COARSE:
            warnings.warn(message, FflinWarning, stacklevel=7)

    def absolute(self, q: Array, v: Array) -> Array:
        """Return the inertial velocity (nv,) for the velocity v relative to the orbital frame.

        v and the result are in Pinocchio's order.
        """
        R, position = self.base(q)
        inertial = v.copy()
        inertial[PIN_LINEAR] += R.T @ (self._turning @ position)
        inertial[PIN_ANGULAR] += R.T @ self.rate
        return inertial

    def relative(self, q: Array, v: Array, absolute: Array, rate: Array) -> Array:
        """Return dv/dt (nv,) of the velocity v relative to the orbital frame, see (14.2), (17.1).

        `absolute` (nv,) is the inertial velocity, and `rate` (nv,) is its time derivative.
        """
        frame = absolute - v
        if self.elliptic:
            R, position = self.base(q)
            rate = rate.copy()
            rate[PIN_LINEAR] -= R.T @ (skew(self.rate_change) @ position)
            rate[PIN_ANGULAR] -= R.T @ self.rate_change
        omega_cross = skew(v[PIN_ANGULAR])
        relative_rate = rate.copy()
        relative_rate[PIN_LINEAR] += (
            omega_cross @ frame[PIN_LINEAR] - skew(frame[PIN_ANGULAR]) @ v[PIN_LINEAR]
        )
        relative_rate[PIN_ANGULAR] += omega_cross @ frame[PIN_ANGULAR]
        return relative_rate

    def wrenches(self, data: pin.Data) -> list[pin.Force]:
        """Return the gravity-gradient wrench on each body, in the frame of the body's joint.

        The first wrench, on Pinocchio's universe, is zero.
        """
        R, center = self._bodies(data)
        back = R.swapaxes(1, 2)
        force = self._mass * (back @ (self.tide @ center))[..., 0]
        # With the inertia I of a body and `tide` in body axes, the matrix I `tide` - `tide` I is
        # [t]x of the torque t = 3 n^2 r x (I r).
        torque_cross = self._inertia @ (back @ self.tide @ R)
        torque_cross -= torque_cross.swapaxes(1, 2)
        torque_about_center = torque_cross[:, (2, 0, 1), (1, 2, 0)]
        moment_of_force = (self._levers @ force[..., None])[..., 0]
        torque = torque_about_center + moment_of_force
        return [self._none, *map(pin.Force, force, torque)]

    def slopes(self, data: pin.Data) -> Array:
        """Return derivatives (nv, nv) of the generalised force of `wrenches` with respect to q.

        In these derivatives, only the wrenches vary with q. The Jacobians of the bodies are held
        constant, because the ABA derivatives include their change. The columns for the base
        position are zero here, because `add_turning` adds the effect of this position.
        """
        # All quantities are in the axes of each body. There, `tide` is T = R^T `tide` R, and a body
        # at the position r has the force m T r. A small rotation t of the body changes T by
        # T [t]x - [t]x T.
        model = self.robot.model
        R, centers = self._bodies(data)
        joints = range(ROOT, model.njoints)
        local = pin.ReferenceFrame.LOCAL
        J = np.array(
            [pin.getJointJacobian(model, data, joint, local) for joint in joints]
        )
        # Translations and rotations of the bodies' frames, per unit of each coordinate.
        displacement = J.copy()
        displacement[:, :, PIN_LINEAR] = 0.0
        translation = displacement[:, PIN_LINEAR]
        rotation = displacement[:, PIN_ANGULAR]
        T = R.mT @ self.tide @ R
        center_cross = skew((R.mT @ centers)[..., 0])
        pull_cross = skew((R.mT @ self.tide @ centers)[..., 0])
        # Change of r in body axes, and change of T r due to the change of T.
        center_change = translation + (center_cross - self._levers) @ rotation
        by_tide = (pull_cross - T @ center_cross) @ rotation
        force = self._mass[..., None] * (T @ center_change + by_tide)
        # The torque about the centre of mass is the vector of the antisymmetric matrix I T - T I.
        # Its derivatives with respect to the three rotations follow from the changes of T.
        axes = skew(np.eye(3))
        T = T[:, None]
        torque_cross = self._inertia[:, None] @ (T @ axes - axes @ T)
        torque_cross -= torque_cross.mT
        by_rotation = torque_cross[..., (2, 0, 1), (1, 2, 0)].mT
        torque = by_rotation @ rotation + self._levers @ force
        wrench = np.concatenate((force, torque), axis=1)
        total: Array = (J.mT @ wrench).sum(axis=0)
        return total

    @property
    def strength(self) -> float:
        """Bound of the accelerations per unit distance [1/s^2] that the frame adds, see (14.1).

        The gravity gradient, the centrifugal acceleration and the Euler acceleration count by
        their magnitudes, because they may cancel each other.
        """
        gravity = float(np.linalg.norm(self.tide, 2))
        turning = float(self.rate @ self.rate)
        return gravity + turning + float(np.linalg.norm(self.rate_change))

    def force_sizes(self, data: pin.Data, M: Array) -> Array:
        """Bound the generalised forces (6 + n,) of the frame by the Cauchy-Schwarz inequality.

        The force of coordinate i is an integral of accelerations K x times dx/dq_i over the mass,
        and M_ii (6 + n, 6 + n) is the integral of the square of dx/dq_i. `data` contains the
        placements of the bodies.
        """
        reach = math.sqrt(self._weighted(data, np.eye(3)))
        sizes: Array = self.strength * reach * np.sqrt(M.diagonal())
        return sizes

    def derivative_sizes(self, M: Array) -> tuple[Array, Array]:
        """Return sizes of the derivatives of the forces of the frame with respect to q and v.

        They are bounds of the integrals of (dx/dq_i)^T K dx/dq_j and of the Coriolis terms, as in
        `force_sizes`. The results are (6 + n, 6 + n).
        """
        root = np.sqrt(M.diagonal())
        product = np.outer(root, root)
        coriolis = 2.0 * float(np.linalg.norm(self.rate))
        return self.strength * product, coriolis * product

    def near(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return q with q[:3] = 0, and the inertial v with zero linear velocity of the base.

        The position and the linear velocity of the base do not change the accelerations c in
        (14.2).
        """
        q, v = q.copy(), self.absolute(q, v)
        q[:3] = v[PIN_LINEAR] = 0.0
        return q, v

    def add_turning(self, q: Array, v: Array, by_q: Array, by_v: Array) -> None:
        """Convert derivatives of inertial accelerations to derivatives of relative accelerations.

        The given `by_q` and `by_v` are the derivatives at the point that `near` returns for q and
        v. They are changed in place to the derivatives of (14.2) at q and v.
        """
        R, position = self.base(q)
        fall = R.T @ (
            self.pull @ position - self.tide @ self.base(np.r_[0.0, 0.0, 0.0, q[3:]])[1]
        )
        spin, W, V = (skew(x) for x in (R.T @ self.rate, v[PIN_ANGULAR], v[PIN_LINEAR]))
        # The next lines differentiate the relative accelerations (14.2), which are c_w + w x s and
        # c_v + fall - 2 s x v - w x v. Here s is `rate` in base axes, and (c_w, c_v) is the
        # inertial acceleration at the point that `near` returns. The velocities w and v of the base
        # are relative to the frame. The matrices `spin`, `W` and `V` are [s]x, [w]x and [v]x.
        by_q[:, ANGULAR] += by_v[:, ANGULAR] @ spin
        if self.elliptic:
            by_q[ANGULAR, ANGULAR] -= skew(R.T @ self.rate_change)
        by_q[ANGULAR, ANGULAR] += W @ spin
        by_v[ANGULAR, ANGULAR] -= spin
        by_v[:, LINEAR] = 0.0
        by_q[LINEAR, ANGULAR] += skew(fall) + 2.0 * V @ spin
        by_q[LINEAR, LINEAR] += R.T @ self.pull @ R
        by_v[LINEAR, ANGULAR] += V
        by_v[LINEAR, LINEAR] -= 2.0 * spin + W

    def potential(self, data: pin.Data) -> float:
        """Return the potential energy [J] in the orbital frame, without the energy of springs.

        It is the sum of two terms of (14.3): the integral over the mass of the robot, and the sum
        over the wheels with a constant momentum.
        """
        # The integral term is -1/2 times the integral of x^T K x. The matrix K of (14.3) is `pull`.
        # If the orbit is elliptic, only the symmetric part of `pull` contributes.
        energy = -0.5 * self._weighted(data, self.pull)
        for joint, momentum in self._stored:
            energy -= float(self.rate @ data.oMi[joint].rotation @ momentum)
        return energy

    def _weighted(self, data: pin.Data, G: Array) -> float:
        """Return the integral of x^T G x over the mass of the robot, for a matrix G (3, 3)."""
        R, center = self._bodies(data)
        inertia = self._inertia
        second = (
            0.5 * np.trace(inertia, axis1=1, axis2=2)[:, None, None] * np.eye(3)
            - inertia
        )
        flying = (self._mass[..., None] * center.swapaxes(1, 2) @ G @ center).sum()
        return float(flying + (R.swapaxes(1, 2) @ G @ R * second).sum())

    def power(self, model: pin.Model, data: pin.Data, q: Array, v: Array) -> float:
        """Return the power [W] that changes the Jacobi integral because the orbit is elliptic.

        The Jacobi integral changes because its potentials depend on time, and because the
        acceleration of the frame exerts the force -Omega' x r per unit mass, see (17.3).
        """
        if not self.elliptic:
            return 0.0
        pin.computeCentroidalMomentum(model, data, q, v)
        center = data.com[0]
        momentum = data.hg.angular + np.cross(center, data.hg.linear)
        for joint, stored in self._stored:
            momentum = momentum + data.oMi[joint].rotation @ stored
        z = self._normal
        turning = 2.0 * self._now.rate * self._now.rate_change
        pull_change = self._now.gradient_change * self._tide_of_unit
        pull_change = pull_change + turning * (np.eye(3) - np.outer(z, z))
        power = -0.5 * self._weighted(data, pull_change)
        return power - float(self.rate_change @ momentum)

    def _bodies(self, data: pin.Data) -> tuple[Array, Array]:
        """Return the attitudes (k, 3, 3) and the centres of mass (k, 3, 1) of the k bodies.

        They are in the orbital frame.
        """
        placements = data.oMi.tolist()[ROOT:]
        R = np.array([placement.rotation for placement in placements])
        origins = np.array([placement.translation for placement in placements])
        return R, origins[..., None] + R @ self._lever


def _state_at(orbit: CircularOrbit | EllipticOrbit | None, t: float) -> OrbitState:
    """Return rotation and gravity gradient at time t [s]; without an orbit, all are zero."""
    if isinstance(orbit, EllipticOrbit):
        return orbit.at(t)
    n = 0.0
    radius = math.inf
    if orbit:
        n = orbit.mean_motion
        radius = orbit.radius
    return OrbitState(
        rate=n,
        rate_change=0.0,
        gradient=n * n,
        gradient_change=0.0,
        radius=radius,
        angle=n * t,
    )


# Weights in (14.4), divided by n^2. The three weights are for rotations about the radial direction,
# the direction of flight and the orbit normal.
_WEIGHTS = (2.0, -1.0, -1.0)


class GravityGradient(NamedTuple):
    """Gravity-gradient field of an orbit at one base pose and one time, in base axes.

    A rotation about a unit vector s at unit rate gives a point at x the acceleration [s]x^2 x. The
    field n^2 (3 r r^T - E) x is a weighted sum of three such accelerations (14.4). The weights are
    2 n^2 for the radial direction, -n^2 for the direction of flight and -n^2 for the orbit normal.
    In an elliptic orbit, mu / r^3 replaces n^2.
    """

    # (weight, unit vector (3,)) of each rotation
    turns: tuple[tuple[float, Array], ...]
    spin: Array  # angular velocity (3,) of the orbital frame [rad/s]
    # Acceleration (3,) [m/s^2], relative to the orbital frame, of a free mass that is at rest in
    # this frame at the base's origin.
    fall: Array
    spin_change: Array  # derivative (3,) of the angular velocity of the frame [rad/s^2]
    pull: Array  # matrix K (3, 3) of (14.2) or (17.1) [1/s^2]

    @classmethod
    def at(cls, field: OrbitField, q: Array) -> "GravityGradient":
        """Return the field at the base pose of q (nq,), which `require_near` checks first."""
        field.require_near(q)
        R, position = field.base(q)
        weights = (weight * field.gradient for weight in _WEIGHTS)
        return cls(
            turns=tuple(zip(weights, (R.T @ field.axes).T, strict=True)),
            spin=R.T @ field.rate,
            fall=R.T @ (field.pull @ position),
            spin_change=R.T @ field.rate_change,
            pull=R.T @ field.pull @ R,
        )

    def force(
        self, model: pin.Model, data: pin.Data, q: Array
    ) -> tuple[Array, Array, Array]:
        """Return the generalised force P (nv,) of the field at q, with its derivatives (14.4).

        P excludes the free fall of the base's origin, and does not depend on the base pose in q.
        The base in q should be at the world's origin, because digits are lost if it is far away.
        The second result (nv, nv) contains the derivatives with respect to q, for a field that is
        constant in base axes. The third result (nv, 3) contains the derivatives with respect to
        rotations of the base.
        """
        total, v, at_rest = np.zeros((3, model.nv))
        by_q, by_turn = np.zeros((model.nv, model.nv)), np.zeros((model.nv, 3))
        for weight, v[PIN_ANGULAR] in self.turns:
            over_q, over_v, _ = pin.computeRNEADerivatives(model, data, q, v, at_rest)
            total += weight * data.tau
            by_q += weight * over_q
            by_turn += weight * over_v[:, PIN_ANGULAR] @ skew(v[PIN_ANGULAR])
        return total, by_q, by_turn
