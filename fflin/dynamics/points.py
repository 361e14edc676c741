"""Configurations, velocities and inputs of a point by name."""

from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, unknown
from fflin.base.validation import Array, by_name, number, placement
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.state import StateMap
from fflin.robot.frames import ROOT
from fflin.robot.inputs import named_wheels
from fflin.robot.robot import Robot


def configuration(
    robot: Robot,
    joints: Mapping[str, float] | None = None,
    base: pin.SE3 | None = None,
) -> Array:
    """Build a Pinocchio configuration.

    Parameters
    ----------
    robot : Robot
    joints : mapping, optional
        {joint: value [rad|m]} of independent joints; the others stay at neutral.
    base : pin.SE3, optional
        Placement of the base in the world; the identity by default.

    Returns
    -------
    ndarray (nq,)

    Raises
    ------
    UnknownNameError
        If there is no such joint.
    InputError
        If a value is not a finite number, or a joint mimics another.
    """
    if not isinstance(robot, Robot):
        raise InputError(f"robot is a {type(robot).__name__}, expected a fflin.Robot")
    q = pin.neutral(robot.model)
    if base is not None:
        root = robot.model.jointPlacements[ROOT]
        q[:7] = pin.SE3ToXYZQUAT(root.actInv(placement("base", base)))
    for name, value in by_name("joints", {} if joints is None else joints, "joint").items():
        robot.joint(name).place(q, number(f"joint '{name}'", value))
    robot.follow(q)
    return robot.checked_configuration(q)


def velocity(robot: Robot, values: Mapping[str, float]) -> Array:
    """Build a Pinocchio velocity.

    Parameters
    ----------
    robot : Robot
    values : mapping
        {joint: rate [rad/s|m/s]}, and omega_b.x, .y, .z [rad/s] and v_b.x, .y, .z [m/s] of the
        base in base axes; the others are zero.

    Returns
    -------
    ndarray (nv,)

    Raises
    ------
    UnknownNameError
        If there is no such joint or component.
    InputError
        If a value is not a finite number.
    """
    state = StateMap(robot)
    base = state.names[state.groups.omega_b] + state.names[state.groups.v_b]
    nu = np.zeros(6 + robot.n)
    for name, value in by_name("values", values, "velocity").items():
        if name in base:
            index = base.index(name)
        elif name in robot.joint_names:
            index = 6 + robot.joint_names.index(name)
        elif name in (wheel for wheel, _ in named_wheels(robot.inputs)):
            robot.joint(name)  # says why it has no speed
        else:
            raise unknown("velocity", name, (*robot.joint_names, *base))
        nu[index] = number(f"velocity '{name}'", value)
    return state.spread(nu)


def effort(robot: Robot, values: Mapping[str, float]) -> Array:
    """Build an input over the robot's inputs.

    Parameters
    ----------
    robot : Robot
    values : mapping
        {name of an input: value}; the others are zero.

    Returns
    -------
    ndarray (nu,)

    Raises
    ------
    UnknownNameError
        If there is no such input.
    InputError
        If a value is not a finite number.
    """
    names = Actuation(StateMap(robot)).names
    u = np.zeros(len(names))
    for name, value in by_name("values", values, "input").items():
        if name not in names:
            raise unknown("input", name, names)
        u[names.index(name)] = number(f"effort '{name}'", value)
    return u
