"""Names, units and axes of the state X = (q_b, r_b, q_m, omega_b, v_b, qdot_m) and its forces."""

from typing import Any, Literal, NamedTuple, cast, get_args

from fflin.base.errors import InputError
from fflin.robot.inputs import BaseForce, BaseTorque
from fflin.robot.robot import Robot

Frame = Literal["hybrid", "local", "world", "lvlh", "hill"]

# The frames of a circular orbit, which are the world of a robot that has one.
ORBITAL: tuple[Frame, ...] = ("lvlh", "hill")

# Which base velocities (omega_b, v_b), and wrenches (tau_b, F_b) with them, stand in the axes
# of the reference instead of the base's.
IN_REFERENCE_AXES: dict[str, tuple[bool, bool]] = {
    "hybrid": (False, True),
    "local": (False, False),
    "world": (True, True),
    **dict.fromkeys(ORBITAL, (False, True)),
}

# Rows of the base's angular and linear part in any (6 + n) velocity or wrench of state order,
ANGULAR, LINEAR = slice(0, 3), slice(3, 6)
# and in Pinocchio's v and spatial vectors.
PIN_LINEAR, PIN_ANGULAR = slice(0, 3), slice(3, 6)


def unknown_frame(frame: object) -> InputError:
    """Build the error for an unknown velocity frame."""
    return InputError(f"frame is {frame!r}, expected one of {', '.join(get_args(Frame))}")


def frame_of(robot: Robot, frame: object) -> Frame:
    """Return the requested frame, or a robot's default frame, checked against its orbit."""
    if frame is None:
        return ORBITAL[0] if robot.orbit else "hybrid"
    if not isinstance(frame, str) or frame not in get_args(Frame):
        raise unknown_frame(frame)
    if (frame in ORBITAL) != bool(robot.orbit):
        suits = " or ".join(ORBITAL) if robot.orbit else "hybrid, local or world"
        raise InputError(
            f"frame is '{frame}', but '{robot.name}' is in {'an' if robot.orbit else 'no'} orbit; "
            f"use {suits}{'' if robot.orbit else ', or give the robot an orbit (orbit=, --orbit)'}"
        )
    return cast("Frame", frame)


def refuse_orbit(robot: Any, what: str) -> None:
    """Raise `InputError` if a robot is in orbit, which `what` does not support."""
    if getattr(robot, "orbit", None):
        raise InputError(
            f"{what} are defined only without an orbit, but '{robot.name}' is in orbit; remove the "
            "orbit with robot.replace(orbit=None)"
        )


class Groups(NamedTuple):
    """Slices of the six groups of the state."""

    q_b: slice
    r_b: slice
    q_m: slice
    omega_b: slice
    v_b: slice
    qdot_m: slice


def states_of(robot: Robot) -> dict[str, str]:
    """Return {name: unit} of the 12 + 2n states."""
    units = dict.fromkeys(("q_b.x", "q_b.y", "q_b.z"), "1")
    units |= dict.fromkeys(("r_b.x", "r_b.y", "r_b.z"), "m")
    for joint in robot.joints:
        units[f"q_m.{joint.name}"] = joint.unit
    units |= dict.fromkeys(("omega_b.x", "omega_b.y", "omega_b.z"), "rad/s")
    units |= dict.fromkeys(("v_b.x", "v_b.y", "v_b.z"), "m/s")
    for joint in robot.joints:
        units[f"qdot_m.{joint.name}"] = f"{joint.unit}/s"
    return units


def forces_of(robot: Robot) -> dict[str, str]:
    """Return {name: unit} of the 6 + n generalised forces."""
    units = dict.fromkeys(("tau_b.x", "tau_b.y", "tau_b.z"), BaseTorque.UNIT)
    units |= dict.fromkeys(("F_b.x", "F_b.y", "F_b.z"), BaseForce.UNIT)
    for joint in robot.joints:
        units[f"tau_m.{joint.name}"] = joint.force_unit
    return units
