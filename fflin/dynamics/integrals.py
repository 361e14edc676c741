r"""Energy, momentum and centre of mass of a robot at many configurations.

All rows are computed together, body after body. Poses and velocities of the bodies are in base axes
and relative to the origin of the base. So their rounding errors do not depend on how far the base
is from the origin of the world.

Each row is rounded as if it were the only one, because no product of matrices contains several
rows. So a row does not depend on how many others were recorded.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base.rotation import rotation_rows
from fflin.base.validation import Array
from fflin.dynamics.coordinates import PIN_ANGULAR, PIN_LINEAR
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot

# This many rows are computed at a time. With fewer rows, the time of the calls of NumPy dominates,
# and arrays of more rows do not fit into the cache of the processor.
_ROWS = 4096

# A number for each row (N,), or one number for all rows.
Number: TypeAlias = Any
# Three numbers, or an array (3, N).
Vector: TypeAlias = Any
# The x, y and z axes of a frame, in base axes.
Axes: TypeAlias = Sequence[Vector]

_ZERO: Vector = (0.0, 0.0, 0.0)
_IDENTITY: Axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Screw(NamedTuple):
    """Revolute, prismatic or helical joint with a constant axis.

    The z axis of `frame`, which is relative to the frame of the joint, is the axis of the joint.
    The joint rotates by `turn` about z and moves by `slide` along z, per unit of its position.
    """

    frame: pin.SE3
    turn: float
    slide: float


class Integrals(NamedTuple):
    """Sums over the bodies at N rows, in world axes.

    `energy` includes the rotors of the joints (armature). `momentum` consists of the linear
    momentum, and of the angular momentum about the centre of mass, which includes the stored
    momentum of wheels. `polar` is half the trace of the inertia about the origin of the world.
    """

    energy: Array  # (N,) kinetic energy
    momentum: Array  # (N, 6)
    center: Array  # (N, 3) centre of mass, from the origin of the world
    polar: Array  # (N,)


class _Body(NamedTuple):
    """Body in a frame whose z axis is the axis of its joint.

    The base and the body of a joint that is not a screw are in the frame of Pinocchio; their
    `screw` is None.
    """

    parent: int
    # of the frame relative to the parent's frame, at the joint position 0
    place: pin.SE3
    joint: pin.JointModel
    screw: Screw | None
    inertia: pin.Inertia
    armature: float
    stored: Array  # (3,) momentum of wheels


class _Motion(NamedTuple):
    """Pose of a body, and velocity of its origin, in base axes."""

    axes: Axes
    origin: Vector
    angular: Vector
    linear: Vector


def screw_of(model: pin.Model, joint: pin.JointModel) -> Screw | None:
    """Return the screw of a joint with one degree of freedom, or None if it is not a screw."""
    data = joint.createData()
    q, v = pin.neutral(model), np.zeros(model.nv)
    joint.calc(data, q)
    subspace = np.asarray(data.S).reshape(6)
    v[joint.idx_v] = 0.7
    joint.calc(data, pin.integrate(model, q, v))
    if not data.M.isApprox(pin.exp6(0.7 * subspace), 1e-12):
        return None
    linear, angular = subspace[PIN_LINEAR], subspace[PIN_ANGULAR]
    turn = float(np.linalg.norm(angular))
    axis = angular / turn if turn else linear / np.linalg.norm(linear)
    slide = float(linear @ axis)
    # The axis must pass through the origin of the joint's frame, as for all screw joints of
    # Pinocchio.
    if np.abs(linear - slide * axis).max() > 1e-12:
        return None
    rotation = (
        pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis)
        .normalized()
        .matrix()
    )
    # For an axis along x, y or z, all entries are 0 or 1. Rounding errors in their place would move
    # a planar robot out of its plane.
    whole = rotation.round()
    rotation = np.where(np.abs(rotation - whole) < 1e-15, whole, rotation)
    return Screw(pin.SE3(rotation, np.zeros(3)), turn, slide)


def integrals(robot: Robot, q: Array, v: Array) -> Integrals:
    r"""Return the sums over the bodies of a robot at rows q (N, nq) and v (N, nv).

    With the mass :math:`m_i`, the centre of mass :math:`c_i`, the inertia :math:`I_i`, the velocity
    :math:`\dot c_i` and the angular velocity :math:`\omega_i` of each body, and with the centre of
    mass :math:`c` of the robot,

    .. math::
        T = \tfrac{1}{2} \sum_i (m_i \dot c_i^T \dot c_i + \omega_i^T I_i \omega_i), \quad
        p = \sum_i m_i \dot c_i, \quad
        L = \sum_i (I_i \omega_i + (c_i - c) \times m_i \dot c_i).
    """
    bodies = _bodies(robot)
    parts = []
    for first in range(0, len(q), _ROWS):
        rows = slice(first, first + _ROWS)
        parts.append(_sums(robot, bodies, np.array(q[rows].T), np.array(v[rows].T)))
    whole = [np.concatenate(part) for part in zip(*parts, strict=True)]
    return Integrals(*whole)


@lru_cache(maxsize=16)  # robots do not change
def _bodies(robot: Robot) -> list[_Body]:
    """Return the bodies of a robot, in Pinocchio's order."""
    model = robot.model
    stored = np.zeros((robot.model.njoints, 3))
    for index, momentum in robot.stored_momentum:
        stored[index] += momentum
    frames = [pin.SE3.Identity()] * model.njoints
    bodies: list[_Body] = []
    for index in range(ROOT, model.njoints):
        joint, parent = model.joints[index], model.parents[index]
        screw, armature = None, 0.0
        if index > ROOT:
            screw, armature = screw_of(model, joint), float(model.armature[joint.idx_v])
        if screw is not None:
            frames[index] = screw.frame
        frame = frames[index]
        bodies.append(
            _Body(
                parent - ROOT,
                frames[parent].inverse() * model.jointPlacements[index] * frame,
                joint,
                screw,
                frame.actInv(model.inertias[index]),
                armature,
                frame.rotation.T @ stored[index],
            )
        )
    return bodies


def _sums(robot: Robot, bodies: list[_Body], q: Array, v: Array) -> Integrals:
    """Return the sums at q (nq, N) and v (nv, N)."""
    motion = _Motion(_IDENTITY, _ZERO, tuple(v[PIN_ANGULAR]), tuple(v[PIN_LINEAR]))
    motions: list[_Motion] = []
    centers: list[Vector] = []
    momenta: list[Vector] = []
    first, spin, linear = _ZERO, _ZERO, _ZERO
    energy: Array = np.zeros(q.shape[1])
    polar: Array = np.zeros(q.shape[1])
    total = 0.0
    for body in bodies:
        if motions:
            motion = _moved(motions[body.parent], body, q, v)
            if body.armature:
                energy += 0.5 * body.armature * v[body.joint.idx_v] ** 2
        motions.append(motion)
        mass = body.inertia.mass
        lever = _turned(motion.axes, body.inertia.lever)
        velocity = _plus(motion.linear, _cross(motion.angular, lever))
        # Angular velocity and angular momentum in the axes of the body
        rates = tuple(_dot(axis, motion.angular) for axis in motion.axes)
        turning = _turned(
            tuple(zip(*body.inertia.inertia.tolist(), strict=True)), rates
        )
        center, momentum = _plus(motion.origin, lever), _times(velocity, mass)
        centers.append(center)
        momenta.append(momentum)
        energy += 0.5 * (_dot(velocity, momentum) + _dot(rates, turning))
        first = _plus(first, _times(center, mass))
        linear = _plus(linear, momentum)
        spin = _plus(spin, _turned(motion.axes, _plus(turning, body.stored)))
        polar += 0.5 * float(np.trace(body.inertia.inertia))
        total += mass
    center = _times(first, 1.0 / total)
    for body, body_center, momentum in zip(bodies, centers, momenta, strict=True):
        apart = _plus(body_center, _times(center, -1.0))
        spin = _plus(spin, _cross(apart, momentum))
        polar += body.inertia.mass * _dot(apart, apart)
    axes: Axes = tuple(zip(*rotation_rows(*q[3:7]), strict=True))
    position: Vector = q[:3]
    root = robot.model.jointPlacements[ROOT]
    if not root.isIdentity(0.0):
        axes = tuple(_turned(root.rotation.T, axis) for axis in axes)
        position = _plus(_turned(root.rotation.T, position), root.translation)
    center = _plus(position, _turned(axes, center))
    polar += total * _dot(center, center)
    total_momentum = np.array([*_turned(axes, linear), *_turned(axes, spin)])
    return Integrals(energy, total_momentum.T, np.array(center).T, polar)


def _moved(above: _Motion, body: _Body, q: Array, v: Array) -> _Motion:
    """Return the motion of a body from the motion of its parent."""
    joint, screw, place = body.joint, body.screw, body.place
    axes: Axes
    x, y, z = (_turned(above.axes, column) for column in place.rotation.T)
    shift = _turned(above.axes, place.translation)
    angular = above.angular
    if screw is None:
        local = _joint_motion(joint, q, v)
        axes = (x, y, z)
        shift = _plus(shift, _turned((x, y, z), local.origin))
        linear = _plus(above.linear, _cross(angular, shift))
        linear = _plus(linear, _turned(axes, local.linear))
        angular = _plus(angular, _turned(axes, local.angular))
        axes = tuple(_turned(axes, axis) for axis in local.axes)
        return _Motion(axes, _plus(above.origin, shift), angular, linear)
    rate = v[joint.idx_v]
    if screw.slide:
        # A joint that slides has one entry of q.
        shift = _plus(shift, _times(z, screw.slide * q[joint.idx_q]))
    linear = _plus(above.linear, _cross(angular, shift))
    if screw.slide:
        linear = _plus(linear, _times(z, screw.slide * rate))
    if screw.turn:
        angular = _plus(angular, _times(z, screw.turn * rate))
        if joint.nq == 2:
            cosine, sine = q[joint.idx_q], q[joint.idx_q + 1]
        else:
            angle = screw.turn * q[joint.idx_q]
            cosine, sine = np.cos(angle), np.sin(angle)
        turned = _plus(_times(x, cosine), _times(y, sine))
        y = _plus(_times(y, cosine), _times(x, -sine))
        x = turned
    return _Motion((x, y, z), _plus(above.origin, shift), angular, linear)


def _joint_motion(joint: pin.JointModel, q: Array, v: Array) -> _Motion:
    """Return the motion of a joint that is not a screw, in the axes of its frame at position 0."""
    count = q.shape[1]
    data = joint.createData()
    rotation, vectors = np.empty((3, 3, count)), np.empty((3, 3, count))
    for i in range(count):
        joint.calc(data, q[:, i].copy(), v[:, i].copy())
        rotation[:, :, i] = data.M.rotation.T
        velocity = data.M.rotation @ data.v.angular, data.M.rotation @ data.v.linear
        vectors[:, :, i] = data.M.translation, *velocity
    return _Motion(tuple(map(tuple, rotation)), *map(tuple, vectors))


def _turned(axes: Axes, vector: Vector) -> Vector:
    """Return a vector with the given entries along the given axes."""
    if axes is _IDENTITY:
        return vector
    total = _ZERO
    for axis, entry in zip(axes, vector, strict=True):
        # Most frames are parallel to the frame of their parent, so most entries are zero.
        if isinstance(entry, np.ndarray) or entry:
            part = _times(axis, entry)
            total = part if total is _ZERO else _plus(total, part)
    return total


def _plus(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _times(a: Vector, value: Number) -> Vector:
    return a[0] * value, a[1] * value, a[2] * value


def _dot(a: Vector, b: Vector) -> Number:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    z = a[0] * b[1] - a[1] * b[0]
    return x, y, z
