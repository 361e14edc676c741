"""A robot file to begin with: what a URDF says of a robot, and what its names suggest."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pinocchio as pin

from fflin.base.tables import counted
from fflin.base.validation import Array
from fflin.robot.frames import ROOT
from fflin.robot.limits import limits_of
from fflin.robot.robot import Robot

_WHEEL = re.compile(r"(?<![a-z])(rw|(fly|reaction_?)?wheel)(?![a-z])", re.IGNORECASE)
_THRUSTER = re.compile(r"(?<![a-z])(thr|thruster|nozzle|rcs)(?![a-z])", re.IGNORECASE)

_HEAD = """\
# What is known of {name}: {joints}, {mass:.6g} kg. Lines with # are suggestions; fflin's
# guide has all keys. A name may be a pattern, "hinge_*", or a group: q_b, r_b, q_m, omega_b, v_b,
# qdot_m of states, tau_b, F_b, tau_m, thrust, wheel of inputs.

urdf = {urdf}
# package_dirs = ["../meshes"]  # where package:// paths of meshes are looked up
# lock = ["{joint}"]  # joints that are welded; or {{ "{joint}" = 0.1 }} [rad|m]
# outputs = ["com"]  # what is watched, in the words of --output; the state by default
# gravity = [0.0, 0.0, -9.81]  # [m/s^2] in world axes"""

_INPUTS = """\
# What acts on the robot. As soon as one stands here, these are all; by default
# [[input]]
# type = "base_torque"
# max = 1.0  # [N m]
# [[input]]
# type = "base_force"
# max = 1.0  # [N]"""
_MOTORS = """\
# [[input]]
# type = "joint_torque"
# joint = "*"  # all that are not passive"""

# How joints without a motor swing with all else held [rad/s], and their damping ratio.
_SWING, _DAMPED = math.pi, 0.01
_GUESSED = "Of joints without a motor a guess: they swing at 0.5 Hz, damped by 1 %."

_WEIGHTS = """\
# What a regulator weighs; by default what the limits ask for.
# [weights]
# rule = "urdf"  # or "identity", of what is not named below
# [weights.bryson]  # largest deviations that are acceptable; beside [weights.q], [weights.r]
# q_b = 0.05

# Where `fflin simulate` and `fflin view` begin.
[start]
rpy = [10.0, 0.0, 0.0]  # attitude of the base [deg], about fixed axes
# position = [0.1, 0.0, 0.0]  # [m]"""
_START = """\
# joints = {{ "{joint}" = 0.1 }}  # [rad|m]
# velocity = {{ "{joint}" = 0.01 }}  # [rad/s|m/s]"""


def draft(robot: Robot, urdf: str) -> str:
    """Return the text of a robot file.

    Parameters
    ----------
    robot : Robot
        As its URDF is, with nothing said of it.
    urdf : str
        What the file names the URDF by.
    """
    names = {
        "name": _text(robot.name)[1:-1],
        "joints": counted(robot.n, "joint"),
        "mass": robot.mass,
        "urdf": _text(urdf),
        "joint": _text(robot.joint_names[0])[1:-1] if robot.n else "joint_1",
    }
    motors, start = ([_MOTORS], [_START.format_map(names)]) if robot.n else ([], [])
    first = [_HEAD.format_map(names), *_passive(robot)]
    inputs = "\n".join((_INPUTS, *motors, *_candidates(robot)))
    parts = [*first, inputs, *_springs(robot), *_limits(robot), "\n".join((_WEIGHTS, *start))]
    return "\n\n".join(parts) + "\n"


def _idle(robot: Robot) -> list[str]:
    """Return the joints whose effort is 0."""
    effort = robot.model.effortLimit
    return [joint.name for joint in robot.joints if effort[joint.idx_v] == 0.0]


def _passive(robot: Robot) -> list[str]:
    idle = _idle(robot)
    if not idle:
        return []
    if len(idle) == robot.n:
        note = (
            "# The URDF gives every joint an effort of 0, as some exporters do; without a motor are"
        )
        return [f"{note}\n# passive = [{', '.join(map(_text, idle))}]"]
    rows = "".join(f"  {_text(name)},  # effort 0 in the URDF\n" for name in idle)
    return [f"# Joints without a motor, which get no torque.\npassive = [\n{rows}]"]


def _springs(robot: Robot) -> list[str]:
    """Return the damping of the URDF, and springs with which joints without a motor stay."""
    damping = {name: value for name, value in robot.urdf_damping.items() if value}
    idle = [name for name in _idle(robot) if len(_idle(robot)) < robot.n]
    if not (idle or damping):
        return []
    M = pin.crba(robot.model, robot.model.createData(), robot.neutral())
    stiffness = {}
    for joint in robot.joints:
        if joint.name in idle:
            inertia = float(M[joint.idx_v, joint.idx_v])
            stiffness[joint.name] = inertia * _SWING**2
            damping.setdefault(joint.name, 2.0 * _DAMPED * inertia * _SWING)
    guessed = "" if not idle else "\n# " + _GUESSED
    tables = [f"# Dampers [N m s/rad | N s/m], as the URDF has them.{guessed}"]
    tables += _table("damping", damping)
    if idle:
        tables += ["", f"# Springs [N m/rad | N/m].{guessed}", *_table("stiffness", stiffness)]
    return ["\n".join(tables)]


def _table(name: str, values: dict[str, float]) -> list[str]:
    return [f"[{name}]", *(f"{_text(key)} = {value:.6g}" for key, value in values.items())]


def _limits(robot: Robot) -> list[str]:
    found = limits_of(robot)
    if not found:
        return []
    rows = "".join(
        f"\n# {_text(name)} = " + (f"{high:.6g}" if low == -high else f"[{low:.6g}, {high:.6g}]")
        for name, (low, high) in found.items()
    )
    return [
        f"# Limits as the URDF has them: largest magnitude, or [least, largest].\n# [limits]{rows}"
    ]


def _candidates(robot: Robot) -> list[str]:
    """Return inputs that links look like, each with the frame of its link."""
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, robot.neutral())
    lines = []
    for index, frame in enumerate(model.frames):
        if frame.type != pin.FrameType.BODY or frame.parentJoint < ROOT:
            continue
        wheel, thruster = _WHEEL.search(frame.name), _THRUSTER.search(frame.name)
        if not (wheel or thruster):
            continue
        placement, axis, more = data.oMf[index], np.array([0.0, 0.0, 1.0]), []
        if wheel and (joint := _turning(robot, index)):
            axis = frame.placement.rotation.T @ _axis(robot, joint)
            inertia = float(axis @ frame.placement.actInv(model.inertias[joint]).inertia @ axis)
            more = [f"# inertia = {inertia:.6g}  # [kg m^2], if its joint is in lock"]
        at, along = (_vector(x) for x in (placement.translation, placement.rotation @ axis))
        kind, key = ("reaction_wheel", "axis") if wheel else ("thruster", "direction")
        lines += [
            f"# Link {_text(frame.name)} at {at}, {key} {along} in the robot's axes:",
            *("# [[input]]", f'# type = "{kind}"'),
            # A wheel may have a joint of its own, whose name no frame has.
            f"# name = {_text(frame.name + '_rotor' * bool(wheel))}",
            f"# frame = {_text(frame.name)}",
            *(["# position = [0, 0, 0]  # [m], in that frame"] if thruster and not wheel else []),
            f"# {key} = {_vector(axis)}",
            *more,
        ]
    return lines


def _turning(robot: Robot, index: int) -> int:
    """Return Pinocchio's joint about which a link turns by itself; 0 where there is none."""
    frame = robot.model.frames[index]
    joint = int(frame.parentJoint)
    moved = robot.model.frames[frame.parentFrame].type == pin.FrameType.JOINT
    turns = any(robot.model.getJointId(x.name) == joint and not x.prismatic for x in robot.joints)
    return joint if moved and turns else 0


def _axis(robot: Robot, index: int) -> Array:
    """Return the axis (3,) about which a joint turns, in its frame."""
    joint = robot.model.joints[index]
    data = joint.createData()
    joint.calc(data, robot.neutral())
    return np.asarray(data.S).reshape(6)[3:]


def _vector(values: Array) -> str:
    return f"[{', '.join(f'{x:.6g}' for x in np.round(values, 9) + 0.0)}]"


def _text(name: str) -> str:
    """Write a name as TOML does."""
    return json.dumps(name, ensure_ascii=False).replace("\x7f", "\\u007f")
