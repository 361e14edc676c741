"""What each output measures, and its exact derivatives with respect to q, v and dv/dt."""

from typing import NamedTuple

import pinocchio as pin

from fflin.base.rotation import skew
from fflin.base.validation import Array

# Rows of Pinocchio's spatial vectors, and of the base in its v.
LINEAR, ANGULAR = slice(0, 3), slice(3, 6)

_LOCAL = pin.ReferenceFrame.LOCAL


class Sensed(NamedTuple):
    """Outputs and their derivatives at a point.

    Attributes
    ----------
    y : ndarray (ny,)
        The outputs; zero where they are states.
    by_q, by_v, by_a : ndarray (ny, nv)
        Derivatives with respect to the tangent of q that pin.integrate moves along, v and a;
        rows of states are zero. None for by_a where no output depends on a.
    """

    y: Array
    by_q: Array
    by_v: Array
    by_a: Array | None

    def part(self, rows: slice) -> "Sensed":
        """Return views of the rows of one output."""
        y, by_q, by_v, by_a = self
        return Sensed(y[rows], by_q[rows], by_v[rows], None if by_a is None else by_a[rows])


class Point(NamedTuple):
    """The robot with its base at the origin, and what was left out of it.

    Attributes
    ----------
    q, v : ndarray (nq,), (nv,)
        Configuration with the base at the world's origin in its axes, and velocity without the
        linear one of the base.
    R, r_b : ndarray (3, 3), (3,)
        Rotation and position of the base relative to the reference.
    v_b, g : ndarray (3,)
        Velocity of the base's origin and gravity, in base axes.
    stored : tuple of (int, ndarray (3,))
        Momentum of wheels that are no joints: the joint that carries it, and it in its axes.
    """

    model: pin.Model
    data: pin.Data
    q: Array
    v: Array
    R: Array
    r_b: Array
    v_b: Array
    g: Array
    stored: tuple[tuple[int, Array], ...] = ()


class Carried(NamedTuple):
    """Where a frame is: the joint that carries it, and its placement on that joint."""

    joint: int
    placement: pin.SE3


# Each of these writes the rows of one output. Those of the whole robot call all of Pinocchio's
# that they need; those of a frame expect its computeForwardKinematicsDerivatives.


def center_of_mass(at: Point, to: Sensed) -> None:
    """Position in reference axes."""
    jacobian = pin.jacobianCenterOfMass(at.model, at.data, at.q, False)
    to.y[:] = at.r_b + at.R.dot(at.data.com[0])
    to.by_q[:] = at.R.dot(jacobian)


def momentum(at: Point, to: Sensed) -> None:
    """Angular about the centre of mass, wheels included, then linear, in reference axes."""
    # Its rate, which this differentiates too, is of no interest: any acceleration will do.
    by_q, _, _, by_v = pin.computeCentroidalDynamicsDerivatives(at.model, at.data, at.q, at.v, at.v)
    mass, still = pin.computeTotalMass(at.model), at.data.hg
    to.y[:3] = at.R.dot(still.angular)
    to.y[3:] = at.R.dot(still.linear + mass * at.v_b)
    for part, rows in (slice(0, 3), ANGULAR), (slice(3, 6), LINEAR):
        to.by_q[part] = at.R.dot(by_q[rows])
        to.by_v[part] = at.R.dot(by_v[rows])
    to.by_q[3:, ANGULAR] -= at.R.dot(skew(mass * at.v_b))
    for joint, stored in at.stored:
        jacobian = pin.getJointJacobian(at.model, at.data, joint, _LOCAL)
        R = at.R.dot(at.data.oMi[joint].rotation)
        to.y[:3] += R.dot(stored)
        to.by_q[:3] -= R.dot(skew(stored)).dot(jacobian[ANGULAR])


def frame_pose(at: Point, frame: Carried, to: Sensed) -> None:
    """Position in reference axes, and the rotation vector from where it is."""
    placement = at.data.oMi[frame.joint] * frame.placement
    _, jacobian = pin.getFrameVelocityDerivatives(at.model, at.data, *frame, _LOCAL)
    to.y[:3] = at.r_b + at.R.dot(placement.translation)
    to.by_q[:3] = at.R.dot(placement.rotation).dot(jacobian[LINEAR])
    to.by_q[3:] = jacobian[ANGULAR]


def frame_velocity(at: Point, frame: Carried, to: Sensed) -> None:
    """Angular in the frame's axes, and of its origin in reference axes."""
    by_q, jacobian = pin.getFrameVelocityDerivatives(at.model, at.data, *frame, _LOCAL)
    velocity = pin.getFrameVelocity(at.model, at.data, *frame, _LOCAL)
    R = at.R.dot((at.data.oMi[frame.joint] * frame.placement).rotation)
    to.y[:3] = velocity.angular
    to.by_q[:3] = by_q[ANGULAR]
    to.by_v[:3] = jacobian[ANGULAR]
    # A velocity held in axes that turn turns with them: the frame's, and the base's.
    to.y[3:] = R.dot(velocity.linear) + at.R.dot(at.v_b)
    to.by_q[3:] = R.dot(by_q[LINEAR] - skew(velocity.linear).dot(jacobian[ANGULAR]))
    to.by_q[3:, ANGULAR] -= at.R.dot(skew(at.v_b))
    to.by_v[3:] = R.dot(jacobian[LINEAR])


def gyroscope(at: Point, frame: Carried, to: Sensed) -> None:
    """Angular velocity in the frame's axes."""
    by_q, jacobian = pin.getFrameVelocityDerivatives(at.model, at.data, *frame, _LOCAL)
    to.y[:] = pin.getFrameVelocity(at.model, at.data, *frame, _LOCAL).angular
    to.by_q[:] = by_q[ANGULAR]
    to.by_v[:] = jacobian[ANGULAR]


def accelerometer(at: Point, frame: Carried, to: Sensed) -> None:
    """Acceleration of the origin less gravity, in the frame's axes.

    Pinocchio was given dv_b/dt + omega_b x v_b - g, in base axes, for the base's acceleration.
    """
    _, by_q, by_v, by_a = pin.getPointClassicAccelerationDerivatives(
        at.model, at.data, *frame, _LOCAL
    )
    to.y[:] = pin.getFrameClassicalAcceleration(at.model, at.data, *frame, _LOCAL).linear
    assert to.by_a is not None
    to.by_q[:], to.by_v[:], to.by_a[:] = by_q, by_v, by_a
    # The terms of that sum; gravity turns against the base.
    of_base = by_a[:, LINEAR]
    to.by_q[:, ANGULAR] -= of_base.dot(skew(at.g))
    to.by_v[:, ANGULAR] -= of_base.dot(skew(at.v_b))
