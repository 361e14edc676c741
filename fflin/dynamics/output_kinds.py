"""Value of each kind of output and, computed independently, its derivatives."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin

import fflin.robot.outputs as kinds
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.names import PIN_ANGULAR, PIN_LINEAR
from fflin.robot.frames import Carried

_LOCAL = pin.ReferenceFrame.LOCAL


class Sensed(NamedTuple):
    """Outputs and their derivatives (ny, nv) at a point; zero for outputs that are states."""

    y: Array
    by_q: Array  # over the tangent of q that pin.integrate moves along
    by_v: Array
    by_a: Array | None  # None where no output depends on a

    def part(self, rows: slice) -> "Sensed":
        """Return views of the rows of one output."""
        y, by_q, by_v, by_a = self
        return Sensed(y[rows], by_q[rows], by_v[rows], None if by_a is None else by_a[rows])


class Point(NamedTuple):
    """Robot with its base moved to the origin and to rest, and the removed base motion."""

    model: pin.Model
    data: pin.Data
    q: Array  # (nq,) with the base at the world's origin in its axes
    v: Array  # (nv,) without the linear one of the base
    R: Array  # rotation (3, 3) and position (3,) of the base relative to the reference
    r_b: Array
    v_b: Array  # velocity of the base's origin and gravity (3,), in base axes
    g: Array
    # Momentum (3,) of wheels that are no joints: the joint that carries it, and it in its axes.
    stored: tuple[tuple[int, Array], ...]
    spin: Array  # (3,) rate at which an orbit turns the world, in base axes

    def placement(self, frame: Carried) -> pin.SE3:
        """Return the placement of a frame on the robot."""
        return self.data.oMi[frame.joint] * frame.placement


class World(NamedTuple):
    """Robot at its actual pose, after Pinocchio's second-order forward kinematics."""

    model: pin.Model
    data: pin.Data
    reference: pin.SE3  # what positions and axes are relative to
    gravity: Array
    stored: tuple[tuple[int, Array], ...]  # as in `Point`
    spin: Array  # in its own axes

    def placement(self, frame: Carried) -> pin.SE3:
        """Return the placement of a frame in the world."""
        return self.data.oMi[frame.joint] * frame.placement

    def velocity(self, frame: Carried) -> pin.Motion:
        """Return the twist of a frame in its own axes."""
        return frame.placement.actInv(self.data.v[frame.joint])


# Those of the whole robot call all of Pinocchio's that they need; those of frames expect its
# computeForwardKinematicsDerivatives: f(point, where to write them, *frames)
Slopes: TypeAlias = Callable[..., None]

# f(world, attitudes of the frames at the point of linearisation, *frames)
Value: TypeAlias = Callable[..., Array]


def _center_of_mass_slopes(at: Point, to: Sensed) -> None:
    jacobian = pin.jacobianCenterOfMass(at.model, at.data, at.q, False)
    to.y[:] = at.r_b + at.R.dot(at.data.com[0])
    to.by_q[:] = at.R.dot(jacobian)


def _center_of_mass(world: World, _: object) -> Array:
    return np.asarray(world.reference.actInv(_center(world)))


def _center(world: World) -> Array:
    model, data = world.model, world.data
    bodies = [(model.inertias[i], data.oMi[i]) for i in range(1, model.njoints)]
    moments = [inertia.mass * placement.act(inertia.lever) for inertia, placement in bodies]
    return np.asarray(sum(moments) / sum(inertia.mass for inertia, _ in bodies))


def _momentum_slopes(at: Point, to: Sensed) -> None:
    # Its rate, which this differentiates too, is of no interest: any acceleration will do.
    by_q, _, _, by_v = pin.computeCentroidalDynamicsDerivatives(at.model, at.data, at.q, at.v, at.v)
    mass, still = pin.computeTotalMass(at.model), at.data.hg
    to.y[:3] = at.R.dot(still.angular)
    to.y[3:] = at.R.dot(still.linear + mass * at.v_b)
    for part, rows in (slice(0, 3), PIN_ANGULAR), (slice(3, 6), PIN_LINEAR):
        to.by_q[part] = at.R.dot(by_q[rows])
        to.by_v[part] = at.R.dot(by_v[rows])
    to.by_q[3:, PIN_ANGULAR] -= at.R.dot(skew(mass * at.v_b))
    for joint, stored in at.stored:
        jacobian = pin.getJointJacobian(at.model, at.data, joint, _LOCAL)
        R = at.R.dot(at.data.oMi[joint].rotation)
        to.y[:3] += R.dot(stored)
        to.by_q[:3] -= R.dot(skew(stored)).dot(jacobian[PIN_ANGULAR])


def _momentum(world: World, _: object) -> Array:
    model, data, turned = world.model, world.data, world.reference.rotation.T
    momenta = [data.oMi[i].act(model.inertias[i] * data.v[i]) for i in range(1, model.njoints)]
    linear = sum(h.linear for h in momenta)
    angular = sum(h.angular for h in momenta) - np.cross(_center(world), linear)
    for joint, stored in world.stored:
        angular += data.oMi[joint].rotation @ stored
    return np.concatenate((turned @ angular, turned @ linear))


def _frame_pose_slopes(at: Point, to: Sensed, frame: Carried) -> None:
    placement = at.placement(frame)
    _, jacobian = pin.getFrameVelocityDerivatives(at.model, at.data, *frame, _LOCAL)
    to.y[:3] = at.r_b + at.R.dot(placement.translation)
    to.by_q[:3] = at.R.dot(placement.rotation).dot(jacobian[PIN_LINEAR])
    to.by_q[3:] = jacobian[PIN_ANGULAR]


def _frame_pose(world: World, before: Sequence[Array], frame: Carried) -> Array:
    placement = world.placement(frame)
    turned = pin.log3(before[0].T @ placement.rotation)
    return np.concatenate((world.reference.actInv(placement.translation), turned))


def _frame_velocity_slopes(at: Point, to: Sensed, frame: Carried) -> None:
    _angular_slopes(at, to.part(slice(0, 3)), frame)
    by_q, jacobian = pin.getFrameVelocityDerivatives(at.model, at.data, *frame, _LOCAL)
    velocity = pin.getFrameVelocity(at.model, at.data, *frame, _LOCAL)
    R = at.R.dot(at.placement(frame).rotation)
    # A velocity held in axes that turn turns with them: the frame's, and the base's.
    to.y[3:] = R.dot(velocity.linear) + at.R.dot(at.v_b)
    to.by_q[3:] = R.dot(by_q[PIN_LINEAR] - skew(velocity.linear).dot(jacobian[PIN_ANGULAR]))
    to.by_q[3:, PIN_ANGULAR] -= at.R.dot(skew(at.v_b))
    to.by_v[3:] = R.dot(jacobian[PIN_LINEAR])


def _frame_velocity(world: World, _: object, frame: Carried) -> Array:
    velocity = world.velocity(frame)
    R = world.reference.rotation.T @ world.placement(frame).rotation
    return np.concatenate((velocity.angular, R @ velocity.linear))


def _relative_pose_slopes(at: Point, to: Sensed, *frames: Carried) -> None:
    place, other = map(at.placement, frames)
    jacobian, seeing = (
        pin.getFrameVelocityDerivatives(at.model, at.data, *frame, _LOCAL)[1] for frame in frames
    )
    relative = other.actInv(place)
    R, p = relative.rotation, relative.translation
    to.y[:3] = p
    to.by_q[:3] = (
        R.dot(jacobian[PIN_LINEAR]) - seeing[PIN_LINEAR] + skew(p).dot(seeing[PIN_ANGULAR])
    )
    to.by_q[3:] = jacobian[PIN_ANGULAR] - R.T.dot(seeing[PIN_ANGULAR])
    to.by_q[:, :6] = 0.0  # the base carries both


def _relative_pose(world: World, before: Sequence[Array], *frames: Carried) -> Array:
    place, other = map(world.placement, frames)
    turned = pin.log3((before[1].T @ before[0]).T @ other.rotation.T @ place.rotation)
    seen = other.rotation.T @ (place.translation - other.translation)
    return np.concatenate((seen, turned))


def _angular_slopes(at: Point, to: Sensed, frame: Carried) -> None:
    by_q, jacobian = pin.getFrameVelocityDerivatives(at.model, at.data, *frame, _LOCAL)
    to.y[:] = pin.getFrameVelocity(at.model, at.data, *frame, _LOCAL).angular
    to.by_q[:] = by_q[PIN_ANGULAR]
    to.by_v[:] = jacobian[PIN_ANGULAR]


def _gyroscope_slopes(at: Point, to: Sensed, frame: Carried) -> None:
    _angular_slopes(at, to, frame)
    spin = at.placement(frame).rotation.T.dot(at.spin)
    to.y[:] += spin
    to.by_q[:] += skew(spin).dot(to.by_v)  # the frame's angular Jacobian


def _gyroscope(world: World, _: object, frame: Carried) -> Array:
    spin = world.placement(frame).rotation.T @ world.spin
    return np.asarray(world.velocity(frame).angular + spin)


def _accelerometer_slopes(at: Point, to: Sensed, frame: Carried) -> None:
    # Pinocchio was given dv_b/dt + omega_b x v_b - g, in base axes, for the base's acceleration.
    _, by_q, by_v, by_a = pin.getPointClassicAccelerationDerivatives(
        at.model, at.data, *frame, _LOCAL
    )
    to.y[:] = pin.getFrameClassicalAcceleration(at.model, at.data, *frame, _LOCAL).linear
    assert to.by_a is not None
    to.by_q[:], to.by_v[:], to.by_a[:] = by_q, by_v, by_a
    # The terms of that sum; gravity turns against the base.
    of_base = by_a[:, PIN_LINEAR]
    to.by_q[:, PIN_ANGULAR] -= of_base.dot(skew(at.g))
    to.by_v[:, PIN_ANGULAR] -= of_base.dot(skew(at.v_b))


def _accelerometer(world: World, _: object, frame: Carried) -> Array:
    velocity = world.velocity(frame)
    rate = frame.placement.actInv(world.data.a[frame.joint]).linear
    felt = rate + np.cross(velocity.angular, velocity.linear)
    return np.asarray(felt - world.placement(frame).rotation.T @ world.gravity)


# What is not here is made of states.
KINDS: dict[type[kinds.Output], tuple[Slopes, Value]] = {
    kinds.CenterOfMass: (_center_of_mass_slopes, _center_of_mass),
    kinds.Momentum: (_momentum_slopes, _momentum),
    kinds.FramePose: (_frame_pose_slopes, _frame_pose),
    kinds.FrameVelocity: (_frame_velocity_slopes, _frame_velocity),
    kinds.RelativePose: (_relative_pose_slopes, _relative_pose),
    kinds.Gyroscope: (_gyroscope_slopes, _gyroscope),
    kinds.Accelerometer: (_accelerometer_slopes, _accelerometer),
}
