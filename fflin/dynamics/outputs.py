"""The outputs of a robot, prepared: their names and units, and their evaluation at a point."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.rotation import quaternion_product, rotation_matrix, skew
from fflin.base.validation import Array
from fflin.dynamics.output_kinds import ANGULAR, KINDS, LINEAR, Carried, Point, Sensed, Slopes
from fflin.dynamics.state import StateMap
from fflin.robot.frames import ROOT, find_frame
from fflin.robot.outputs import (
    BasePose,
    FullState,
    JointPositions,
    JointVelocities,
    Output,
)
from fflin.robot.robot import Robot

# Rotation and position of the base relative to itself.
_STANDING: tuple[Array, Array] = (np.eye(3), np.zeros(3))


class Sensing:
    r"""The outputs of a robot, prepared.

    Neither where the base is nor how fast it moves along changes what happens on the robot
    (Galilei). So Pinocchio is asked about the robot with its base at the origin, in its own axes,
    and without the velocity v_b of its origin; rotation, position and velocity of the base are
    put on afterwards, and an orbit costs no digits. Of the base's acceleration only
    :math:`\dot v_b + \omega_b \times v_b - g`, in base axes, is felt.

    Parameters
    ----------
    state : StateMap
    outputs : sequence of Output
    gravity : array_like (3,), optional
        In world axes [m/s^2]; zero by default.
    own_reference : bool
        Whether the reference is the base's own placement at each point, not that of `state`.

    Attributes
    ----------
    names, units : tuple of str
        Of the ny outputs.
    states : list of (int, int)
        (output, state) for each output that is a state.
    needs_acceleration : bool
        Whether an output depends on the acceleration, so that D is not zero.

    Raises
    ------
    InputError
        If something is no output, two outputs have one name, or a joint mimics another.
    UnknownNameError
        If there is no such frame or joint.
    """

    def __init__(
        self,
        state: StateMap,
        outputs: Sequence[Output],
        *,
        gravity: Array | None = None,
        own_reference: bool = False,
    ) -> None:
        robot = state.robot
        self._model, self._nv, self._stored = robot.model, robot.nv, robot.stored_momentum
        self._gravity: Array = np.zeros(3) if gravity is None else np.array(gravity, dtype=float)
        self._weighed = bool(self._gravity.any())
        self._own_reference = own_reference
        # The free-flyer joint may itself stand somewhere in the world.
        root = robot.model.jointPlacements[ROOT]
        self._root_rotation = np.array(root.rotation)
        self._home = pin.SE3ToXYZQUAT(root.inverse())
        placement = pin.SE3ToXYZQUAT(state.reference.actInv(root))
        self._position, self._quaternion = placement[:3], placement[3:]
        self._rotation = rotation_matrix(self._quaternion)

        self.states: list[tuple[int, int]] = []
        self._kinds: list[tuple[slice, Slopes, tuple[Carried, ...]]] = []
        signals: list[tuple[str, str]] = []
        for output in outputs:
            at = len(signals)
            if type(output) in KINDS:
                frames = tuple(carried(robot, name) for name in output.frames)
                signals += output.signals
                self._kinds.append((slice(at, len(signals)), KINDS[type(output)][0], frames))
            else:
                indices = states_of(state, output)
                self.states += enumerate(indices, start=at)
                signals += [(state.names[index], state.units[index]) for index in indices]
        # Those of frames last: the others overwrite what these read.
        self._kinds.sort(key=lambda kind: bool(kind[2]))
        self.names = tuple(name for name, _ in signals)
        self.units = tuple(unit for _, unit in signals)
        twice = [name for index, name in enumerate(self.names) if name in self.names[:index]]
        if twice:
            raise InputError(f"output '{twice[0]}' is asked for twice; leave one of them out")
        self.needs_acceleration = any(output.FEELS_ACCELERATION for output in outputs)

    def evaluate(self, data: pin.Data, q: Array, v: Array, a: Array) -> Sensed:
        """Return the outputs and their derivatives at a point.

        Parameters
        ----------
        data : pin.Data
            Work space; what it held is lost.
        q : ndarray (nq,)
            A valid configuration.
        v : ndarray (nv,)
            Velocity: base linear and angular in base axes, then joints.
        a : ndarray (nv,)
            Its time derivative as pin.aba returns it, with gravity's part. Not looked at where
            `needs_acceleration` is false.

        Returns
        -------
        Sensed
        """
        ny, nv = len(self.names), self._nv
        by_a = np.zeros((ny, nv)) if self.needs_acceleration else None
        sensed = Sensed(np.zeros(ny), np.zeros((ny, nv)), np.zeros((ny, nv)), by_a)
        if len(self.states) == ny:
            return sensed
        at = self._point(data, q, v)
        derived = False
        for rows, slopes, frames in self._kinds:
            if frames and not derived:
                self._derive(data, at, v, a)
                derived = True
            slopes(at, frames, sensed.part(rows))
        return sensed

    def _derive(self, data: pin.Data, at: Point, v: Array, a: Array) -> None:
        felt: tuple[Array, ...] = ()
        if self.needs_acceleration:
            rate = a.copy()
            rate[LINEAR] += skew(v[ANGULAR]).dot(at.v_b) - at.g
            felt = (rate,)
        pin.computeForwardKinematicsDerivatives(self._model, data, at.q, at.v, *felt)

    def _point(self, data: pin.Data, q: Array, v: Array) -> Point:
        still_q, still_v = q.copy(), v.copy()
        still_q[:7] = self._home
        still_v[LINEAR] = 0.0
        R, r_b = _STANDING
        if not self._own_reference:
            R = rotation_matrix(quaternion_product(self._quaternion, q[3:7]))
            r_b = self._position + self._rotation @ q[:3]
        gravity = self._gravity
        if self._weighed:
            gravity = rotation_matrix(q[3:7]).T @ (self._root_rotation.T @ gravity)
        v_b = v[LINEAR]
        return Point(self._model, data, still_q, still_v, R, r_b, v_b, gravity, self._stored)


def states_of(state: StateMap, output: Output) -> list[int]:
    """Return the indices of the states that an output is made of."""
    robot, groups = state.robot, state.groups
    if isinstance(output, FullState):
        return list(range(state.nx))
    if isinstance(output, BasePose):
        return list(range(groups.q_b.start, groups.r_b.stop))
    if not isinstance(output, JointPositions | JointVelocities):
        raise InputError(f"{output!r} is no output, as FramePose('tool') would be")
    group = groups.q_m if isinstance(output, JointPositions) else groups.qdot_m
    names = robot.joint_names if output.joints is None else output.joints
    return [group.start + robot.joints.index(robot.joint(name)) for name in names]


def carried(robot: Robot, name: str) -> Carried:
    """Return where a frame is; a link's before a joint's of the same name."""
    return Carried(*find_frame(robot.model, name))
