"""Draft of a robot file, from the values of a URDF and from suggestive link names."""

import json
import math
import re
from collections.abc import Mapping
from importlib.resources import files
from string import Template
from textwrap import fill

import numpy as np
import pinocchio as pin

from fflin.base.tables import counted
from fflin.robot.frames import ROOT
from fflin.robot.limits import limits_of
from fflin.robot.robot import Robot

_LOOKS = {
    "reaction_wheel": re.compile(r"(?<![a-z])(rw|(fly|reaction_?)?wheel)(?![a-z])", re.IGNORECASE),
    "thruster": re.compile(r"(?<![a-z])(thr|thruster|nozzle|rcs)(?![a-z])", re.IGNORECASE),
}

# How joints without a motor swing with all else held [rad/s], and their damping ratio.
_SWING, _DAMPED = math.pi, 0.01


def draft(robot: Robot, urdf: str) -> str:
    """Return the text of a robot file for a robot whose URDF, named `urdf`, says all."""
    model = robot.model
    idle = [joint for joint in robot.joints if model.effortLimit[joint.idx_v] == 0.0]
    names = ", ".join(_text(joint.name) for joint in idle)
    passive = f"\n# Joints without a motor: their effort is 0 in the URDF.\npassive = [{names}]\n"
    if len(idle) == robot.n:
        passive = (
            "\n# The URDF gives every joint an effort of 0, as some exporters do.\n"
            f"# passive = [{names}]\n"
        )
        idle = []
    M = pin.crba(model, model.createData(), robot.neutral())
    inertia = {joint.name: float(M[joint.idx_v, joint.idx_v]) for joint in idle}
    damping = {name: 2.0 * _DAMPED * _SWING * size for name, size in inertia.items()}
    damping |= {name: value for name, value in robot.urdf_damping.items() if value}
    limits = {
        name: f"{high:.6g}" if low == -high else f"[{low:.6g}, {high:.6g}]"
        for name, (low, high) in limits_of(robot).items()
    }
    template = Template(files("fflin.robot").joinpath("assets", "robot.toml").read_text("utf-8"))
    return template.substitute(
        name=_text(robot.name)[1:-1],
        joints=counted(robot.n, "joint"),
        mass=f"{robot.mass:.6g}",
        urdf=_text(urdf),
        joint=_text(robot.joint_names[0] if robot.n else "joint_1"),
        passive=passive if names else "",
        candidates="".join(_candidate(robot, index) for index in range(model.nframes)),
        damping=_lines("", {name: f"{value:.6g}" for name, value in damping.items()}),
        stiffness=_lines("", {name: f"{size * _SWING**2:.6g}" for name, size in inertia.items()}),
        limits=_lines("# ", limits),
    )


def _lines(mark: str, values: Mapping[str, str]) -> str:
    return "".join(f"{mark}{_text(name)} = {value}\n" for name, value in values.items())


def _candidate(robot: Robot, index: int) -> str:
    """Return the input that a link's name suggests, in comments; empty if it suggests none."""
    model, frame = robot.model, robot.model.frames[index]
    kind = next((kind for kind, look in _LOOKS.items() if look.search(frame.name)), "")
    if not kind or frame.type != pin.FrameType.BODY or frame.parentJoint < ROOT:
        return ""
    data = robot.create_data()
    pin.forwardKinematics(model, data, robot.neutral())
    placement = pin.updateFramePlacement(model, data, index)
    axis, name, inertia = np.array([0.0, 0.0, 1.0]), frame.name, ""
    if kind == "reaction_wheel":
        name += "_rotor"  # which may be a joint's, whose name no frame has
        joint = model.joints[frame.parentJoint]
        if joint.nv == 1 and model.frames[frame.parentFrame].type == pin.FrameType.JOINT:
            data = joint.createData()
            joint.calc(data, robot.neutral())
            axis = np.asarray(data.S).reshape(6)[3:]
            size = axis @ model.inertias[frame.parentJoint].inertia @ axis
            inertia = f"# inertia = {size:.6g}  # [kg m^2], if its joint is locked\n"
    key = "axis" if kind == "reaction_wheel" else "direction"
    at, along = _vector(placement.translation), _vector(placement.rotation @ axis)
    position = "" if inertia or key == "axis" else "# position = [0, 0, 0]  # [m], in that frame\n"
    said = f"# Link {_text(frame.name)} at {at} [m], {key} {along}, both in base axes:"
    return (
        f"{fill(said, 80, subsequent_indent='# ', break_long_words=False)}\n"
        f'# [[input]]\n# type = "{kind}"\n# name = {_text(name)}\n# frame = {_text(frame.name)}\n'
        f"{position}# {key} = {_vector(axis)}\n{inertia}"
    )


def _vector(values: np.ndarray) -> str:
    return f"[{', '.join(f'{x:.6g}' for x in np.round(values, 9) + 0.0)}]"


def _text(name: str) -> str:
    """Write a name as TOML does."""
    return json.dumps(name, ensure_ascii=False).replace("\x7f", "\\u007f")
