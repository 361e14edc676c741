"""A robot file to begin with: what a URDF says of a robot, and what its names suggest."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable

import numpy as np
import pinocchio as pin

from fflin.base.tables import counted
from fflin.base.validation import Array
from fflin.robot.frames import ROOT
from fflin.robot.limits import limits_of
from fflin.robot.robot import Robot

_WHEEL = re.compile(r"(^|[_\W])(rw|wheel|flywheel|reaction_wheel)(?![a-z])", re.IGNORECASE)
_THRUSTER = re.compile(r"(^|[_\W])(thr|thruster|nozzle|rcs)(?![a-z])", re.IGNORECASE)

_HEAD = """\
# {name}: {joints}, {mass:.6g} kg. Lines that begin with # are suggestions; the guide has
# all keys. Names may be patterns, "hinge_*", and groups: q_b, r_b, q_m, omega_b, v_b, qdot_m of
# states, tau_b, F_b, tau_m, thrust, wheel of inputs.

urdf = {urdf}
# package_dirs = ["../meshes"]  # where package:// paths of meshes are looked up
# lock = {{ {joint} = 0.0 }}  # joints that are welded, and where [rad|m]
# outputs = ["com"]  # what is watched, as --output has it: the state by default
# gravity = [0.0, 0.0, -9.81]  # [m/s^2] in world axes"""

_INPUTS = """\
# What acts on it. As soon as one stands here, these are all; by default:
# [[input]]
# type = "base_torque"  # or max = 1.0 [N m] below it
# [[input]]
# type = "base_force"
# [[input]]
# type = "joint_torque"
# joint = "*"  # every joint but the passive ones"""

_WEIGHTS = """\
# What `fflin lqr` and `fflin simulate` weigh; by default as the limits ask for.
# [weights]
# rule = "urdf"  # or "identity", of what is not named below
# [weights.bryson]  # largest deviations that are acceptable; or [weights.q], [weights.r]
# q_b = 0.05
# tau_b = 1.0

# Where `fflin simulate` and `fflin view` begin.
[start]
rpy = [10.0, 0.0, 0.0]  # [deg] about fixed axes
# position = [0.1, 0.0, 0.0]  # [m]"""


def draft(robot: Robot, urdf: str) -> str:
    """Return the text of a robot file.

    Parameters
    ----------
    robot : Robot
        Loaded with nothing but its URDF.
    urdf : str
        What the file names it by.
    """
    first = robot.joint_names[0] if robot.n else "joint_1"
    head = _HEAD.format(
        name=_quoted(robot.name).strip('"'),
        joints=counted(robot.n, "joint"),
        mass=robot.mass,
        urdf=_quoted(urdf),
        joint=_quoted(first),
    )
    start = [f"# joints = {{ {_quoted(first)} = 0.1 }}  # [rad|m]"] * bool(robot.n)
    parts = [
        head,
        *_passive(robot),
        _INPUTS,
        *_candidates(robot),
        *_springs(robot),
        *_limits(robot),
    ]
    return "\n\n".join(parts) + "\n\n" + "\n".join((_WEIGHTS, *start)) + "\n"
