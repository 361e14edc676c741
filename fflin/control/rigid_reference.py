"""Trajectory of a rigid robot as the reference of the same robot with flexible appendages."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, listed
from fflin.base.validation import Array
from fflin.control.optimal.shooting import passive_springs
from fflin.dynamics.state import StateMap, selection
from fflin.linear.model import LinearModel
from fflin.linear.trajectory import Trajectory

# Largest difference of two inertias that count as equal, relative to their diagonal entries.
_SAME_INERTIA = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class RigidReference(Trajectory):
    """Trajectory of a rigid robot, for a robot with flexible appendages that do not deflect.

    It is not a motion of the flexible robot: the inputs of the rigid robot excite its modes.

    Parameters
    ----------
    rigid : Trajectory
        Trajectory of the rigid robot.
    """

    rigid: Trajectory = field(kw_only=True)

    @cached_property
    def cubics(self) -> Array:
        """Coefficients of the rigid motion; the deflections are constant."""
        flexible, rigid = StateMap(self.robot), StateMap(self.rigid.robot)
        return _spread(flexible, rigid, self.rigid.cubics)


def on_flexible_robot(lin: LinearModel, trajectory: Trajectory) -> Trajectory:
    """Return a trajectory of a rigid robot as a reference of the robot of a model.

    The flexible joints of this robot stay as they are at the operating point of the model. Inputs
    that the trajectory lacks are zero. A trajectory of a robot with the same joints is returned
    unchanged.

    Raises
    ------
    InputError
        If the trajectory lacks other joints than springs without motors, has other inputs or
        another inertia than the robot of the model, or if this robot has accelerometers.
    """
    robot = lin._robot
    planned = trajectory.robot
    if robot is None or not set(planned.joint_names) < set(robot.joint_names):
        return trajectory
    lacking = [name for name in robot.joint_names if name not in planned.joint_names]
    about = (
        f"the trajectory of '{planned.name}' lacks {listed(lacking)} of the law's robot"
    )
    flexible = passive_springs(robot)
    if moved := [name for name in lacking if name not in flexible]:
        raise InputError(
            f"{about}; only springs without motors may be missing, such as modes of flexible "
            f"appendages, but {listed(moved)} must be controlled; plan with the robot of the law"
        )
    if any(output.FEELS_ACCELERATION for output in robot.outputs):
        raise InputError(
            f"{about}, whose accelerometers measure the accelerations of these joints; plan with "
            "the robot of the law"
        )
    state, rigid = StateMap(robot), StateMap(planned)
    inputs = trajectory.actuation.names
    if other := [name for name in inputs if name not in lin.input_names]:
        raise InputError(
            f"{about}, and has the inputs {listed(other)}, which the law does not command; plan "
            "with the inputs of the law"
        )
    q = np.tile(lin.q, (len(trajectory.t), 1))
    q[:, :7] = trajectory.q[:, :7]
    for joint in planned.joints:
        robot.joint(joint.name).place(q.T, joint.values(trajectory.q.T))
    robot.follow(q.T)
    _require_same_inertia(about, state, rigid, q[0], trajectory.q[0])
    return RigidReference(
        robot,
        trajectory.t,
        q,
        _spread(state, rigid, trajectory.v),
        trajectory.u @ selection(inputs, lin.input_names),
        hold=trajectory.hold,
        frame=trajectory.frame,
        rigid=trajectory,
    )


def _spread(flexible: StateMap, rigid: StateMap, v: Array) -> Array:
    """Return velocities (.., nv) of the flexible robot, whose other joints have zero rates."""
    names = [_velocity_names(state) for state in (rigid, flexible)]
    return flexible.spread(rigid.velocities(v) @ selection(*names))


def _velocity_names(state: StateMap) -> list[str]:
    """Return the names of the base velocities and joint rates of a robot."""
    return [*state.names[state.nx // 2 :]]


def _require_same_inertia(
    about: str, flexible: StateMap, rigid: StateMap, q: Array, q_rigid: Array
) -> None:
    """Raise `InputError` if the inertia of the rigid robot is not that of the flexible robot.

    `about` is the beginning of the message.
    """
    inertias = []
    for state, point in ((flexible, q), (rigid, q_rigid)):
        robot = state.robot
        upper = pin.crba(robot.model, robot.create_data(), point)
        inertias.append(state.project(upper.T))
    S = selection(_velocity_names(rigid), _velocity_names(flexible))
    M = S @ inertias[0] @ S.T
    size = np.sqrt(np.outer(M.diagonal(), M.diagonal()))
    difference = float((np.abs(inertias[1] - M) / size).max())
    if difference > _SAME_INERTIA:
        raise InputError(
            f"{about}, and its mass or inertia differs by {100.0 * difference:.2g} % from the "
            "law's robot without deflection, expected the same; plan with the robot of the law, or "
            "give the rigid robot its mass properties"
        )
