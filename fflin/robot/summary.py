"""Text about a robot: the list of robots, a summary, and the draft of a robot file."""

import json
import math
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping
from string import Template
from textwrap import fill

import numpy as np
import pinocchio as pin

from fflin.base.tables import counted, folded, grid, width
from fflin.robot.fields import limits_of, travel_of
from fflin.robot.inputs import BaseForce, BaseTorque
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot

_LIMITS = "limits in rad, N m and rad/s, or in m, N and m/s for prismatic joints"
_STATE = {"rpy": "[deg]", "position": "[m]", "joints": "[rad | m]", "velocity": "[rad/s | m/s]"}

_LOOKS = {
    "reaction_wheel": re.compile(r"(?<![a-z])(rw|(fly|reaction_?)?wheel)(?![a-z])", re.IGNORECASE),
    "thruster": re.compile(r"(?<![a-z])(thr|thruster|nozzle|rcs)(?![a-z])", re.IGNORECASE),
}

# Frequency [rad/s] and damping ratio that a draft suggests for joints without a motor.
_SWING, _DAMPED = math.pi, 0.01


def robot_list(entries: Iterable[tuple[str, Robot | str, str]]) -> str:
    """Return a table of robots from entries (name, robot or error message, origin)."""
    rows, refused = [["name", "n", "mass [kg]", "from"]], []
    for name, robot, origin in entries:
        if isinstance(robot, str):
            refused.append(f"{name} does not load: {robot}")
        else:
            rows.append([name, str(robot.n), f"{robot.mass:.6g}", origin])
    notes = [textwrap.fill(line, width(), subsequent_indent="  ") for line in refused]
    head = f"{len(rows) - 1} robots can be loaded by name; {len(refused)} cannot be loaded"
    return "\n\n".join((head, grid(rows, "lrrl"), *notes))


def robot_info(robot: Robot, at_point: str = "") -> str:
    """Return a text about a robot's tree, masses and limits, which includes `at_point`."""
    model = robot.model
    inputs = sum(3 if isinstance(item, BaseTorque | BaseForce) else 1 for item in robot.inputs)
    source = str(robot.urdf) if robot.urdf else "a Pinocchio model"
    modes = len(robot.modes)
    counts = [
        counted(robot.n - modes, "joint"),
        *[counted(modes, "mode")] * bool(modes),
        f"{12 + 2 * robot.n} states",
        counted(inputs, "input"),
    ]
    head = f"{robot.name}: {', '.join(counts)}, mass {robot.mass:.6g} kg\nfrom {source}"
    if robot.orbit:
        head += f"\n{folded([str(robot.orbit)])}"
    depth = {0: -1, 1: 0}
    masses = _masses(robot)
    rows = [["joint", "type", "mass [kg]", "lower", "upper", "effort", "velocity"]]
    rows.append(["(base)", "free", f"{masses[ROOT]:.6g}", ".", ".", ".", "."])
    kinds = {
        joint: "prismatic" if joint.prismatic else "continuous" if joint.unbounded else "revolute"
        for joint in robot.joints
        if not joint.mode
    }
    kinds |= {joint: "wheel" for joint in robot.joints if joint.name in robot.wheels}
    for joint, leader, multiplier, offset in robot.followers:
        kinds[joint] = f"mimics {leader.name} * {multiplier:g}"
        kinds[joint] += f" {'-' if offset < 0 else '+'} {abs(offset):g}" if offset else ""
    for joint in sorted(kinds, key=lambda joint: joint.idx_v):
        index = model.getJointId(joint.name)
        depth[index] = depth[model.parents[index]] + 1
        rates = model.effortLimit[joint.idx_v], model.velocityLimit[joint.idx_v]
        cells = (f"{x:.5g}" if abs(x) < 1e300 else "." for x in (*travel_of(model, joint), *rates))
        name, mass = "  " * depth[index] + joint.name, f"{masses[index]:.6g}"
        rows.append([name, kinds[joint], mass, *cells])
    of_modes = {joint.name for joint in robot.modes}
    frames = [
        frame.name
        for frame in model.frames.tolist()
        if frame.parentJoint >= ROOT and frame.name not in of_modes
    ]
    limited = any(cell != "." for row in rows[1:] for cell in row[3:])
    parts = [
        head,
        *[at_point] * bool(at_point),
        grid(rows, "ll"),
        *[_LIMITS] * limited,
        *_settings(robot),
    ]
    parts.append(f"frames\n{_indented(', '.join(dict.fromkeys(frames)), '  ')}")
    if robot.notes:
        parts.append("\n".join(("warnings", *(_indented(note, "    ") for note in robot.notes))))
    return "\n\n".join(parts)


def _masses(robot: Robot) -> list[float]:
    """Return the mass [kg] of the body of each joint, including its modes."""
    model = robot.model
    masses = [body.mass for body in model.inertias.tolist()]
    for index in sorted((model.getJointId(joint.name) for joint in robot.modes), reverse=True):
        masses[model.parents[index]] += masses[index]
    return masses


def _settings(robot: Robot) -> list[str]:
    """Return lines about settings that the URDF does not contain, except inputs and orbit."""
    outputs = [":".join((y.WORD, *y.frames, *(vars(y).get("joints") or ()))) for y in robot.outputs]
    shown = {
        "stiffness [N m/rad | N/m | 1/s^2]": robot.stiffness,
        "damping [N m s/rad | N s/m | 1/s]": robot.damping,
        "spring rest positions [rad | m]": robot.rest,
        "passive joints": robot.passive,
        "locked joints": robot.locked,
        "gravity [m/s^2]": robot.gravity if any(robot.gravity) else (),
        "outputs": outputs if outputs != ["state"] else (),
        "limits": {key: f"{low:g} to {high:g}" for key, (low, high) in robot.limits.items()},
        **{f"weights, {part}": value for part, value in robot.weights.items()},
        **{
            f"{name}, {part} {_STATE[part]}": value
            for name in ("point", "target", "start")
            for part, value in getattr(robot, name).items()
        },
    }
    lines = [f"{title}: {_said(value)}" for title, value in shown.items() if value]
    lines += [f"{x.title} on frame {x.frame}: modes {', '.join(x.modes)}" for x in robot.appendages]
    return [folded(lines)] * bool(lines)


def _said(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} = {_said(each)}" for key, each in value.items())
    if isinstance(value, tuple | list):
        return ", ".join(map(_said, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _indented(text: str, below: str) -> str:
    return textwrap.fill(text, width(), initial_indent="  ", subsequent_indent=below)


def draft(robot: Robot, urdf: str) -> str:
    """Return the draft of a robot file for a robot that has only a URDF, with the path `urdf`."""
    from importlib.resources import files

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
    found = (_candidate(robot, index) for index in sorted(range(model.nframes), key=_order(model)))
    candidates, joint = [*found], _text(robot.joint_names[0] if robot.n else "joint_1")
    spun = [_text(name) for _, name in candidates if name]
    template = Template(files("fflin.robot").joinpath("assets", "robot.toml").read_text("utf-8"))
    return template.substitute(
        name=_text(robot.name)[1:-1],
        joints=counted(robot.n, "joint"),
        mass=f"{robot.mass:.6g}",
        urdf=_text(urdf),
        joint=joint,
        passive=passive if names else "",
        candidates="".join(text for text, _ in candidates),
        lock=", ".join(spun) or joint,
        damping=_lines("", {name: f"{value:.6g}" for name, value in damping.items()}),
        stiffness=_lines("", {name: f"{size * _SWING**2:.6g}" for name, size in inertia.items()}),
        limits=_lines("# ", limits),
    )


def _lines(mark: str, values: Mapping[str, str]) -> str:
    return "".join(f"{mark}{_text(name)} = {value}\n" for name, value in values.items())


def _order(model: pin.Model) -> Callable[[int], list[tuple[float, str]]]:
    """Return a sort key for frames: by name, with numbers in the names compared by value."""

    def key(index: int) -> list[tuple[float, str]]:
        parts = re.split(r"([0-9]+)", model.frames[index].name)
        return [(float(x), "") if x.isdecimal() else (-1.0, x) for x in parts]

    return key


def _candidate(robot: Robot, index: int) -> tuple[str, str]:
    """Return the input that a link's name suggests, as TOML comments, and the joint of a wheel."""
    model, frame = robot.model, robot.model.frames[index]
    kind = next((kind for kind, look in _LOOKS.items() if look.search(frame.name)), "")
    if not kind or frame.type != pin.FrameType.BODY or frame.parentJoint < ROOT:
        return "", ""
    data = robot.create_data()
    pin.forwardKinematics(model, data, robot.neutral())
    placement = pin.updateFramePlacement(model, data, index)
    axis, name, limits = np.array([0.0, 0.0, 1.0]), frame.name, "# max = 1.0  # [N]\n"
    own = ""
    if kind == "reaction_wheel":
        name += "_rotor"  # because the wheel's name must differ from the names of joints and frames
        limits = "# max = 1.0  # [N m]\n"
        joint = model.joints[frame.parentJoint]
        if joint.nv == 1 and model.frames[frame.parentFrame].type == pin.FrameType.JOINT:
            data = joint.createData()
            joint.calc(data, robot.neutral())
            axis = np.asarray(data.S).reshape(6)[3:]
            size = axis @ model.inertias[frame.parentJoint].inertia @ axis
            own = model.names[frame.parentJoint]
            effort, speed = (
                f"{x:.6g}" if 0.0 < x < 1e100 else "1.0"
                for x in (model.effortLimit[joint.idx_v], model.velocityLimit[joint.idx_v])
            )
            limits = (
                f"# inertia = {size:.6g}  # [kg m^2]\n# max = {effort}  # [N m]\n"
                f"# max_speed = {speed}  # [rad/s]\n"
            )
    key = "axis" if kind == "reaction_wheel" else "direction"
    at, along = _vector(placement.translation), _vector(placement.rotation @ axis)
    position = "" if key == "axis" else "# position = [0, 0, 0]  # [m], in that frame\n"
    said = f"# Link {_text(frame.name)} at {at} [m], {key} {along}, both in base axes:"
    lock = f"# To use this wheel, lock joint {_text(own)} above.\n" if own else ""
    text = (
        f"{fill(said, 80, subsequent_indent='# ', break_long_words=False)}\n{lock}"
        f'# [[input]]\n# type = "{kind}"\n# name = {_text(name)}\n# frame = {_text(frame.name)}\n'
        f"{position}# {key} = {_vector(axis)}\n{limits}"
    )
    return text, own


def _vector(values: np.ndarray) -> str:
    return f"[{', '.join(f'{x:.6g}' for x in np.round(values, 9) + 0.0)}]"


def _text(name: str) -> str:
    """Return a name as a TOML string."""
    return json.dumps(name, ensure_ascii=False).replace("\x7f", "\\u007f")
