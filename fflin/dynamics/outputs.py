"""Outputs of a robot: names, units, and two independent computations of their values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin

import fflin.robot.outputs as kinds
from fflin.base.errors import InputError
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.coordinates import PIN_ANGULAR, PIN_LINEAR
from fflin.dynamics.state import StateMap
from fflin.robot.joints import ROOT, Carried, by_joint, find_frame
from fflin.robot.outputs import (
    BasePose,
    FullState,
    JointOutput,
    JointPositions,
    Output,
    StarTracker,
)
from fflin.robot.robot import Robot

_LOCAL = pin.ReferenceFrame.LOCAL


class Sensed(NamedTuple):
    """Outputs y (ny,) and their derivatives (ny, nv) at a point.

    Some outputs are states. `Sensing.states` lists their rows, which are zero here.
    """

    y: Array
    by_q: Array  # with respect to the tangent displacement of pin.integrate
    by_v: Array
    by_a: Array  # with respect to the acceleration a

    def part(self, rows: slice) -> Sensed:
        """Return views of some rows, such as the rows of one output."""
        views = [array[rows] for array in self]
        return Sensed(*views)


class Point(NamedTuple):
    """Robot with its base moved to the world's origin and the linear velocity of its base removed.

    R, r_b and v_b are the attitude, position and linear velocity of the base before this change.
    """

    model: pin.Model
    data: pin.Data
    # (nq,) with the base at the world's origin and aligned with the world's axes
    q: Array
    v: Array  # (nv,) without the linear velocity of the base
    R: Array  # rotation (3, 3) of the base relative to the reference
    r_b: Array  # position (3,) of the base relative to the reference
    v_b: Array  # velocity (3,) of the base's origin in base axes
    g: Array  # gravity (3,) in base axes
    # (joint, momentum) for each wheel that is modelled without a joint of its own. The wheel is
    # mounted on this joint, and its angular momentum (3,) is in the axes of the joint.
    stored: tuple[tuple[int, Array], ...]
    # angular velocity (3,) of the orbital frame in base axes; zero without an orbit
    spin: Array

    def placement(self, frame: Carried) -> pin.SE3:
        """Return the placement of a frame of the moved robot in the world."""
        return self.data.oMi[frame.joint] * frame.placement

    def jacobian(self, frame: Carried) -> Array:
        """Return the Jacobian (6, nv) of a frame of the robot, in the axes of this frame."""
        of_frame = pin.getFrameVelocityDerivatives(
            self.model, self.data, *frame, _LOCAL
        )
        return np.asarray(of_frame[1])


# A function `f(point, sensed, *frames)` that writes outputs and their derivatives into `sensed`. A
# function with frames reads the results of `pin.computeForwardKinematicsDerivatives`, which its
# caller must call first. A function without frames calls all Pinocchio functions that it needs.
Derivatives: TypeAlias = Callable[..., None]

# A function `f(measuring, attitudes, *frames)` that returns an output. `attitudes` are the rotation
# matrices of the frames at the operating point.
Value: TypeAlias = Callable[..., Array]


def _center_of_mass_derivatives(at: Point, to: Sensed) -> None:
    jacobian = pin.jacobianCenterOfMass(at.model, at.data, at.q, False)
    to.y[:] = at.r_b + at.R.dot(at.data.com[0])
    to.by_q[:] = at.R.dot(jacobian)


def _center_of_mass(world: Measuring, _: object) -> Array:
    center = pin.centerOfMass(world.model, world.data, pin.KinematicLevel.POSITION)
    return np.asarray(world.reference.actInv(center))


def _momentum_derivatives(at: Point, to: Sensed) -> None:
    # The last argument is an acceleration. It affects only the derivatives of dh/dt, which are not
    # used here, so v is given in its place.
    by_q, _, _, by_v = pin.computeCentroidalDynamicsDerivatives(
        at.model, at.data, at.q, at.v, at.v
    )
    mass = pin.computeTotalMass(at.model)
    h = at.data.hg
    to.y[:3] = at.R.dot(h.angular)
    to.y[3:] = at.R.dot(h.linear + mass * at.v_b)
    for part, rows in (slice(0, 3), PIN_ANGULAR), (slice(3, 6), PIN_LINEAR):
        to.by_q[part] = at.R.dot(by_q[rows])
        to.by_v[part] = at.R.dot(by_v[rows])
    to.by_q[3:, PIN_ANGULAR] -= at.R.dot(skew(mass * at.v_b))
    for joint, stored in at.stored:
        jacobian = pin.getJointJacobian(at.model, at.data, joint, _LOCAL)
        R = at.R.dot(at.data.oMi[joint].rotation)
        to.y[:3] += R.dot(stored)
        to.by_q[:3] -= R.dot(skew(stored)).dot(jacobian[PIN_ANGULAR])


def _momentum(world: Measuring, _: object) -> Array:
    h = pin.computeCentroidalMomentum(world.model, world.data)
    turned = world.reference.rotation.T
    angular = h.angular.copy()
    for joint, stored in world.stored:
        angular += world.data.oMi[joint].rotation @ stored
    return np.concatenate((turned @ angular, turned @ h.linear))


def _pose_derivatives(at: Point, to: Sensed, frame: Carried, *other: Carried) -> None:
    # The output is the pose of `frame` relative to the frame `other`, or relative to the reference
    # if there is no other frame.
    origin = pin.SE3(at.R, at.r_b)
    if other:
        origin = at.placement(*other).inverse()
    relative = origin * at.placement(frame)
    jacobian = at.jacobian(frame)
    R, p = relative.rotation, relative.translation
    to.y[:3] = p
    to.by_q[:3] = R.dot(jacobian[PIN_LINEAR])
    to.by_q[3:] = jacobian[PIN_ANGULAR]
    if other:
        jacobian = at.jacobian(*other)
        to.by_q[:3] += skew(p).dot(jacobian[PIN_ANGULAR]) - jacobian[PIN_LINEAR]
        to.by_q[3:] -= R.T.dot(jacobian[PIN_ANGULAR])
        to.by_q[:, :6] = 0.0  # a motion of the base moves both frames alike


def _pose(
    world: Measuring, before: Sequence[Array], frame: Carried, *other: Carried
) -> Array:
    origin, rotation = world.reference, world.reference.rotation
    if other:
        origin, rotation = world.placement(*other), before[1]
    relative = origin.actInv(world.placement(frame))
    attitude = rotation.T @ before[0]
    return np.concatenate(
        (relative.translation, pin.log3(attitude.T @ relative.rotation))
    )


def _frame_velocity_derivatives(at: Point, to: Sensed, frame: Carried) -> None:
    _angular_derivatives(at, to.part(slice(0, 3)), frame)
    by_q, jacobian = pin.getFrameVelocityDerivatives(at.model, at.data, *frame, _LOCAL)
    velocity = pin.getFrameVelocity(at.model, at.data, *frame, _LOCAL)
    R = at.R.dot(at.placement(frame).rotation)
    # The linear velocity of the frame is the sum of `velocity.linear`, which is in the axes of the
    # frame, and v_b, which is in base axes. R and `at.R` rotate these two terms to reference axes.
    # The skew terms are the derivatives of these two rotations.
    to.y[3:] = R.dot(velocity.linear) + at.R.dot(at.v_b)
    to.by_q[3:] = R.dot(
        by_q[PIN_LINEAR] - skew(velocity.linear).dot(jacobian[PIN_ANGULAR])
    )
    to.by_q[3:, PIN_ANGULAR] -= at.R.dot(skew(at.v_b))
    to.by_v[3:] = R.dot(jacobian[PIN_LINEAR])


def _frame_velocity(world: Measuring, _: object, frame: Carried) -> Array:
    velocity = world.velocity(frame)
    R = world.reference.rotation.T @ world.placement(frame).rotation
    return np.concatenate((velocity.angular, R @ velocity.linear))


def _angular_derivatives(at: Point, to: Sensed, frame: Carried) -> None:
    by_q, jacobian = pin.getFrameVelocityDerivatives(at.model, at.data, *frame, _LOCAL)
    to.y[:] = pin.getFrameVelocity(at.model, at.data, *frame, _LOCAL).angular
    to.by_q[:] = by_q[PIN_ANGULAR]
    to.by_v[:] = jacobian[PIN_ANGULAR]


def _gyroscope_derivatives(at: Point, to: Sensed, frame: Carried) -> None:
    _angular_derivatives(at, to, frame)
    spin = at.placement(frame).rotation.T.dot(at.spin)
    to.y[:] += spin
    # `to.by_v` is the angular Jacobian of the frame
    to.by_q[:] += skew(spin).dot(to.by_v)


def _gyroscope(world: Measuring, _: object, frame: Carried) -> Array:
    spin = world.placement(frame).rotation.T @ world.spin
    return np.asarray(world.velocity(frame).angular + spin)


def _accelerometer_derivatives(at: Point, to: Sensed, frame: Carried) -> None:
    # `Sensing.evaluate` has set the linear acceleration of the base to
    # dv_b/dt + omega_b x v_b - g in base axes.
    _, by_q, by_v, by_a = pin.getPointClassicAccelerationDerivatives(
        at.model, at.data, *frame, _LOCAL
    )
    to.y[:] = pin.getFrameClassicalAcceleration(
        at.model, at.data, *frame, _LOCAL
    ).linear
    to.by_q[:], to.by_v[:], to.by_a[:] = by_q, by_v, by_a
    # The next terms are the derivatives of -g with respect to a rotation of the base, and of
    # omega_b x v_b with respect to omega_b. The vector g is constant in world axes. The derivative
    # with respect to v_b is already in `by_v`.
    of_base = by_a[:, PIN_LINEAR]
    to.by_q[:, PIN_ANGULAR] -= of_base.dot(skew(at.g))
    to.by_v[:, PIN_ANGULAR] -= of_base.dot(skew(at.v_b))


def _force_derivatives(at: Point, to: Sensed) -> None:
    """Leave zeros, because `state_equations.output_equations` computes constraint forces."""


def _force(world: Measuring, _: object) -> Array:
    raise InputError(
        "the force of a constraint is an output of linear models only; remove ConstraintForce from "
        "the outputs"
    )


def _accelerometer(world: Measuring, _: object, frame: Carried) -> Array:
    velocity = world.velocity(frame)
    rate = frame.placement.actInv(world.data.a[frame.joint]).linear
    acceleration = rate + np.cross(velocity.angular, velocity.linear)
    return np.asarray(acceleration - world.placement(frame).rotation.T @ world.gravity)


# Outputs of all types that are not listed here are states.
KINDS: dict[type[kinds.Output], tuple[Derivatives, Value]] = {
    kinds.CenterOfMass: (_center_of_mass_derivatives, _center_of_mass),
    kinds.Momentum: (_momentum_derivatives, _momentum),
    kinds.FramePose: (_pose_derivatives, _pose),
    kinds.FrameVelocity: (_frame_velocity_derivatives, _frame_velocity),
    kinds.RelativePose: (_pose_derivatives, _pose),
    kinds.Gyroscope: (_gyroscope_derivatives, _gyroscope),
    kinds.Accelerometer: (_accelerometer_derivatives, _accelerometer),
    kinds.ConstraintForce: (_force_derivatives, _force),
}


# Attitude and position of a base that is at the reference.
_AT_REFERENCE: tuple[Array, Array] = (np.eye(3), np.zeros(3))


class Sensing:
    """Outputs of a robot and their derivatives.

    The outputs are relative to the reference, or relative to the current pose of the base if
    `own_reference` is true.
    """

    # Motion relative to the base does not depend on the base's position and linear velocity
    # (Galilean invariance). So Pinocchio evaluates the robot with its base at the origin and
    # v_b = 0, and the motion of the base is added afterwards. If Pinocchio used the actual position
    # and velocity of a base in orbit, digits would be lost.

    def __init__(
        self, state: StateMap, outputs: Sequence[Output], *, own_reference: bool = False
    ) -> None:
        robot = state.robot
        self.state, self._own_reference = state, own_reference
        # This q[:7] places the base at the world's origin, even if the model places its free-flyer
        # joint elsewhere.
        self._home = pin.SE3ToXYZQUAT(robot.model.jointPlacements[ROOT].inverse())

        # (rows of y, matrix that maps all constraint forces to them) for each ConstraintForce.
        self.forces: list[tuple[slice, Array]] = []
        # (index in y, index in the state) for each output that is a state.
        self.states: list[tuple[int, int]] = []
        self._kinds: list[tuple[slice, Derivatives, list[Carried]]] = []
        signals: list[tuple[str, str]] = []
        for output in outputs:
            at = len(signals)
            if type(output) in KINDS:
                frames = [find_frame(robot.model, name) for name in output.frames]
                signals += output.signals
                if isinstance(output, kinds.ConstraintForce):
                    rows = slice(at, len(signals))
                    self.forces.append((rows, _components(robot, output)))
                self._kinds.append(
                    (slice(at, len(signals)), KINDS[type(output)][0], frames)
                )
            else:
                indices = state_indices(state, output)
                self.states += enumerate(indices, start=at)
                signals += [
                    (state.names[index], state.units[index]) for index in indices
                ]
        # Outputs of frames are evaluated first, because the other outputs overwrite the data that
        # the outputs of frames read.
        self._kinds.sort(key=lambda kind: not kind[2])
        self.names = tuple(name for name, _ in signals)
        self.units = tuple(unit for _, unit in signals)
        twice = [
            name for index, name in enumerate(self.names) if name in self.names[:index]
        ]
        if twice:
            raise InputError(f"output '{twice[0]}' is given twice; remove one")
        inertial = [x.WORD for x in outputs if x.WORD in ("accelerometer", "momentum")]
        if robot.orbit and inertial:
            raise InputError(
                f"output {inertial[0]} needs inertial axes, but the world of '{robot.name}' "
                "rotates with its orbit; remove this output"
            )
        # Whether an output depends on the acceleration. Otherwise, D is zero.
        self.needs_acceleration = any(output.FEELS_ACCELERATION for output in outputs)

    def evaluate(self, data: pin.Data, q: Array, v: Array, a: Array) -> Sensed:
        """Return the outputs and their derivatives at q (nq,) and v (nv,), which are not checked.

        Outputs that are states are zero in the result. `data` is overwritten. The acceleration `a`
        (nv,) is dv/dt, and is ignored unless `needs_acceleration` is true.
        """
        ny, nv = len(self.names), len(v)
        sensed = Sensed(np.zeros(ny), *np.zeros((3, ny, nv)))
        if not self._kinds:
            return sensed
        state, robot = self.state, self.state.robot
        centred_q, centred_v = q.copy(), v.copy()
        centred_q[:7] = self._home
        centred_v[PIN_LINEAR] = 0.0
        R, r_b = _AT_REFERENCE
        if not self._own_reference:
            R, r_b = state.rotation(q), state.positions(q)
        spin = np.zeros(3)
        if state.orbit:
            spin = R.T @ state.orbit[0]
        at = Point(
            model=robot.model,
            data=data,
            q=centred_q,
            v=centred_v,
            R=R,
            r_b=r_b,
            v_b=v[PIN_LINEAR],
            g=state.gravity(q),
            stored=robot.stored_momentum,
            spin=spin,
        )
        point = [at.q, at.v]
        if self.needs_acceleration:
            point.append(a.copy())
            point[-1][PIN_LINEAR] += skew(v[PIN_ANGULAR]).dot(at.v_b) - at.g
        if self._kinds[0][2]:
            pin.computeForwardKinematicsDerivatives(at.model, at.data, *point)
        for rows, slopes, frames in self._kinds:
            slopes(at, sensed.part(rows), *frames)
        return sensed


class Measuring:
    """Outputs y computed by kinematics without derivatives, to check C and D.

    The orientation output of a frame is the rotation vector from its attitude at the operating
    point to its current attitude. The argument q is the configuration at the operating point.
    """

    def __init__(self, state: StateMap, q: Array) -> None:
        self.state = state
        robot = state.robot
        field = state.field
        self.model = robot.model
        self.data = robot.create_data()
        self.reference = state.reference
        self.gravity = np.array(robot.gravity)
        self.stored = robot.stored_momentum  # as in `Point`
        # Angular velocity (3,) of the orbital frame in its own axes; zero without an orbit.
        self.spin = np.zeros(3) if field is None else field.rate
        pin.forwardKinematics(self.model, self.data, q)
        frames = [
            [find_frame(self.model, x) for x in output.frames]
            for output in robot.outputs
        ]
        attitudes = [
            [np.array(self.placement(f).rotation) for f in group] for group in frames
        ]
        # Indices of the states that make up an output; empty for outputs in `KINDS`.
        states = [
            [] if type(x) in KINDS else state_indices(state, x) for x in robot.outputs
        ]
        self._outputs = tuple(
            zip(robot.outputs, frames, attitudes, states, strict=True)
        )

    def __call__(
        self,
        x: Array,
        q: Array,
        v: Array,
        a: Array,
        forces: Mapping[str, Array] | None = None,
    ) -> Array:
        """Return y (ny,) at a point, which is given as the state x and also as q and v.

        `a` (nv,) is dv/dt as Pinocchio's ABA returns it. `forces` is {constraint: wrench (6,)}.
        """
        pin.forwardKinematics(self.model, self.data, q, v, a)
        values = list[Array]()
        for output, frames, attitudes, states in self._outputs:
            if isinstance(output, kinds.ConstraintForce) and forces is not None:
                wrench = dict(zip(kinds.FORCES, forces[output.name], strict=True))
                values.append(np.array([wrench[name] for name in output.chosen]))
            elif type(output) in KINDS:
                measure = KINDS[type(output)][1]
                values.append(measure(self, attitudes, *frames))
            else:
                values.append(x[states])
        return np.concatenate(values)

    def placement(self, frame: Carried) -> pin.SE3:
        """Return the placement of a frame in the world."""
        return self.data.oMi[frame.joint] * frame.placement

    def velocity(self, frame: Carried) -> pin.Motion:
        """Return the twist of a frame, in the axes of this frame."""
        return frame.placement.actInv(self.data.v[frame.joint])


def _components(robot: Robot, output: kinds.ConstraintForce) -> Array:
    """Return the matrix (k, rows) from the forces of all constraints to the components."""
    blocks = []
    for item in robot.constraints:
        selected = item.rows.T
        if item.title != output.name:
            selected = np.zeros_like(selected)
        blocks.append(selected)
    wrench = np.hstack(blocks)
    return wrench[[list(kinds.FORCES).index(name) for name in output.chosen]]


def sensors_by_signal(state: StateMap) -> dict[str, Output]:
    """Return {name of an entry of y: its output} for the outputs of a robot, in the order of y."""
    sensors = dict[str, Output]()
    for output in state.robot.outputs:
        if type(output) in KINDS:
            names = [name for name, _ in output.signals]
        else:
            names = [state.names[index] for index in state_indices(state, output)]
        sensors |= dict.fromkeys(names, output)
    return sensors


def state_indices(state: StateMap, output: Output) -> list[int]:
    """Return the indices of the states that make up an output."""
    robot, groups = state.robot, state.groups
    if isinstance(output, FullState):
        return list(range(state.nx))
    if isinstance(output, BasePose):
        return list(range(groups.q_b.start, groups.r_b.stop))
    if isinstance(output, StarTracker):
        return list(range(groups.q_b.start, groups.q_b.stop))
    if not isinstance(output, JointOutput):
        raise InputError(
            f"{output!r} is not an output; expected one such as FramePose('tool')"
        )
    group = groups.q_m if isinstance(output, JointPositions) else groups.qdot_m
    names = robot.joint_names
    asked = names if output.joints is None else output.joints
    return [
        group.start + names.index(name)
        for key in asked
        for name in by_joint({str(key): 0}, names, robot.joint)
    ]
