"""The outputs of a robot, prepared: names and units, and evaluation by either route."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.names import joints_by_name
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.output_kinds import KINDS, Carried, Point, Sensed, Slopes, World
from fflin.dynamics.state import PIN_ANGULAR, PIN_LINEAR, StateMap
from fflin.robot.frames import ROOT, find_frame
from fflin.robot.outputs import BasePose, FullState, JointPositions, JointVelocities, Output

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
        own_reference: bool = False,
    ) -> None:
        robot = state.robot
        self._state, self._own_reference = state, own_reference
        # The free-flyer joint may itself stand somewhere in the world.
        self._home = pin.SE3ToXYZQUAT(robot.model.jointPlacements[ROOT].inverse())

        self.states: list[tuple[int, int]] = []
        self._kinds: list[tuple[slice, Slopes, tuple[Carried, ...]]] = []
        signals: list[tuple[str, str]] = []
        for output in outputs:
            at = len(signals)
            if type(output) in KINDS:
                frames = _carried(state, output)
                signals += output.signals
                self._kinds.append((slice(at, len(signals)), KINDS[type(output)][0], frames))
            else:
                indices = state_indices(state, output)
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
        ny, nv = len(self.names), len(v)
        by_a = np.zeros((ny, nv)) if self.needs_acceleration else None
        sensed = Sensed(np.zeros(ny), np.zeros((ny, nv)), np.zeros((ny, nv)), by_a)
        if not self._kinds:
            return sensed
        at = self._point(data, q, v)
        derived = False
        for rows, slopes, frames in self._kinds:
            if frames and not derived:
                self._derive(at, v, a)
                derived = True
            slopes(at, frames, sensed.part(rows))
        return sensed

    def _derive(self, at: Point, v: Array, a: Array) -> None:
        felt: tuple[Array, ...] = ()
        if self.needs_acceleration:
            rate = a.copy()
            rate[PIN_LINEAR] += skew(v[PIN_ANGULAR]).dot(at.v_b) - at.g
            felt = (rate,)
        pin.computeForwardKinematicsDerivatives(at.model, at.data, at.q, at.v, *felt)

    def _point(self, data: pin.Data, q: Array, v: Array) -> Point:
        state, robot = self._state, self._state.robot
        still_q, still_v = q.copy(), v.copy()
        still_q[:7] = self._home
        still_v[PIN_LINEAR] = 0.0
        R, r_b = _STANDING
        if not self._own_reference:
            R, r_b = state.rotation(q), state.positions(q)
        return Point(
            *(robot.model, data, still_q, still_v, R, r_b),
            *(v[PIN_LINEAR], state.gravity(q), robot.stored_momentum),
        )


class Measuring:
    """The outputs y of the nonlinear robot, out of elementary kinematics in the world.

    The route by which C and D are checked, and nothing of the one by which they are made.

    Parameters
    ----------
    state : StateMap
    q : ndarray (nq,)
        The point, from which rotation vectors are counted.
    """

    def __init__(self, state: StateMap, q: Array) -> None:
        self.state = state
        robot = state.robot
        self._world = world = World(
            *(robot.model, robot.create_data(), state.reference),
            *(np.array(robot.gravity), robot.stored_momentum),
        )
        pin.forwardKinematics(robot.model, world.data, q)
        frames = [_carried(state, output) for output in robot.outputs]
        attitudes = [[np.array(world.placement(f).rotation) for f in group] for group in frames]
        self._outputs = tuple(zip(robot.outputs, frames, attitudes, strict=True))

    def __call__(self, x: Array, q: Array, v: Array, a: Array) -> Array:
        """Return y (ny,); `a` (nv,) is dv/dt as Pinocchio's ABA returns it."""
        world = self._world
        pin.forwardKinematics(world.model, world.data, q, v, a)
        return np.concatenate(
            [
                KINDS[type(output)][1](world, frames, attitudes)
                if type(output) in KINDS
                else x[state_indices(self.state, output)]
                for output, frames, attitudes in self._outputs
            ]
        )


def state_indices(state: StateMap, output: Output) -> list[int]:
    """Return the indices of the states that an output is made of."""
    robot, groups = state.robot, state.groups
    if isinstance(output, FullState):
        return list(range(state.nx))
    if isinstance(output, BasePose):
        return list(range(groups.q_b.start, groups.r_b.stop))
    if not isinstance(output, JointPositions | JointVelocities):
        raise InputError(f"{output!r} is no output, as FramePose('tool') would be")
    group = groups.q_m if isinstance(output, JointPositions) else groups.qdot_m
    names = robot.joint_names
    asked = names if output.joints is None else output.joints
    return [
        group.start + names.index(name)
        for key in asked
        for name in joints_by_name(
            "joint", {str(key): 0}, names, lambda name: robot.joint(name).name
        )
    ]


def _carried(state: StateMap, output: Output) -> tuple[Carried, ...]:
    """Return where the frames of an output are; a link's before a joint's of the same name."""
    return tuple(Carried(*find_frame(state.robot.model, name)) for name in output.frames)
