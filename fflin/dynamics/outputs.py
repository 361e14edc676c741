"""Outputs of a robot, prepared: names, units, and two independent evaluations."""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.names import PIN_ANGULAR, PIN_LINEAR
from fflin.dynamics.orbital import field_of
from fflin.dynamics.output_kinds import KINDS, Point, Sensed, Slopes, World
from fflin.dynamics.state import StateMap
from fflin.robot.frames import ROOT, Carried, find_frame
from fflin.robot.joints import by_joint
from fflin.robot.outputs import BasePose, FullState, JointOutput, JointPositions, Output

# Rotation and position of the base relative to itself.
_STANDING: tuple[Array, Array] = (np.eye(3), np.zeros(3))


class Sensing:
    """Outputs of a robot, prepared; with `own_reference` relative to the base itself."""

    # Neither where the base is nor how fast it moves along changes what happens on the robot
    # (Galilei). So Pinocchio is asked about the robot with its base at the origin, in its own axes,
    # and without the velocity v_b of its origin; these are put on afterwards, and an orbit costs no
    # digits. Of the base's acceleration only dv_b/dt + omega_b x v_b - g, in base axes, is felt.

    def __init__(
        self, state: StateMap, outputs: Sequence[Output], *, own_reference: bool = False
    ) -> None:
        robot = state.robot
        self._state, self._own_reference = state, own_reference
        # The free-flyer joint may itself stand somewhere in the world.
        self._home = pin.SE3ToXYZQUAT(robot.model.jointPlacements[ROOT].inverse())

        # (output, state) for each output that is a state.
        self.states: list[tuple[int, int]] = []
        self._kinds: list[tuple[slice, Slopes, list[Carried]]] = []
        signals: list[tuple[str, str]] = []
        for output in outputs:
            at = len(signals)
            if type(output) in KINDS:
                frames = [find_frame(robot.model, name) for name in output.frames]
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
            raise InputError(f"output '{twice[0]}' is given twice; remove one")
        inertial = [x.WORD for x in outputs if x.WORD in ("accelerometer", "momentum")]
        if robot.orbit and inertial:
            raise InputError(
                f"output {inertial[0]} needs inertial axes, but the world of '{robot.name}' "
                "rotates with its orbit; remove this output"
            )
        # Where one does, D is not zero.
        self.needs_acceleration = any(output.FEELS_ACCELERATION for output in outputs)

    def evaluate(self, data: pin.Data, q: Array, v: Array, a: Array) -> Sensed:
        """Return the outputs and their derivatives at valid q (nq,) and v (nv,)."""
        # What `data` held is lost; a counts where `needs_acceleration` alone.
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
            slopes(at, sensed.part(rows), *frames)
        return sensed

    def _derive(self, at: Point, v: Array, a: Array) -> None:
        felt: tuple[Array, ...] = ()
        if self.needs_acceleration:
            rate = a.copy()
            rate[PIN_LINEAR] += skew(v[PIN_ANGULAR]).dot(at.v_b) - at.g
            felt = (rate,)
        pin.computeForwardKinematicsDerivatives(at.model, at.data, at.q, at.v, *felt)

    def _point(self, data: pin.Data, q: Array, v: Array) -> Point:
        # Neither where the base is nor how fast it moves along changes what happens on the robot
        # (Galilei): both are left out and put on afterwards, so that an orbit costs no digits.
        state, robot = self._state, self._state.robot
        still_q, still_v = q.copy(), v.copy()
        still_q[:7] = self._home
        still_v[PIN_LINEAR] = 0.0
        R, r_b = _STANDING
        if not self._own_reference:
            R, r_b = state.rotation(q), state.positions(q)
        spin = R.T @ state.orbit[0] if state.orbit else np.zeros(3)
        return Point(
            *(robot.model, data, still_q, still_v, R, r_b),
            *(v[PIN_LINEAR], state.gravity(q), robot.stored_momentum, spin),
        )


class Measuring:
    """Outputs y by elementary kinematics, to check C and D; rotations are relative to q."""

    def __init__(self, state: StateMap, q: Array) -> None:
        self.state = state
        robot, field = state.robot, field_of(state.robot, state.frame)
        self._world = world = World(
            *(robot.model, robot.create_data(), state.reference),
            *(np.array(robot.gravity), robot.stored_momentum),
            np.zeros(3) if field is None else field.rate,
        )
        pin.forwardKinematics(robot.model, world.data, q)
        frames = [[find_frame(world.model, x) for x in output.frames] for output in robot.outputs]
        attitudes = [[np.array(world.placement(f).rotation) for f in group] for group in frames]
        self._outputs = tuple(zip(robot.outputs, frames, attitudes, strict=True))

    def __call__(self, x: Array, q: Array, v: Array, a: Array) -> Array:
        """Return y (ny,); `a` (nv,) is dv/dt as Pinocchio's ABA returns it."""
        world = self._world
        pin.forwardKinematics(world.model, world.data, q, v, a)
        return np.concatenate(
            [
                KINDS[type(output)][1](world, attitudes, *frames)
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
    if not isinstance(output, JointOutput):
        raise InputError(f"{output!r} is not an output; expected one such as FramePose('tool')")
    group = groups.q_m if isinstance(output, JointPositions) else groups.qdot_m
    names = robot.joint_names
    asked = names if output.joints is None else output.joints
    return [
        group.start + names.index(name)
        for key in asked
        for name in by_joint({str(key): 0}, names, robot.joint)
    ]
