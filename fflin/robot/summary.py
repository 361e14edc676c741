"""Text about a robot: a summary, and the draft of a robot file."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from string import Template
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from fflin.base.tables import counted, folded, grid, width
from fflin.robot.fields import limits_of, travel_of
from fflin.robot.inputs import BaseForce, BaseTorque, Thruster
from fflin.robot.joints import ROOT, Joint

if TYPE_CHECKING:
    from fflin.robot.orbit import Orbit
    from fflin.robot.robot import Robot

LIMIT_UNITS = "limits in rad, N m and rad/s, or in m, N and m/s for prismatic joints"

_STATE = {
    "rpy": "[deg]",
    "position": "[m]",
    "joints": "[rad | m]",
    "velocity": "[rad/s | m/s]",
}

_LOOKS = {
    "reaction_wheel": re.compile(
        r"(?<![a-z])(rw|(fly|reaction_?)?wheel)(?![a-z])", re.IGNORECASE
    ),
    "thruster": re.compile(
        r"(?<![a-z])(thr|thruster|nozzle|rcs)(?![a-z])", re.IGNORECASE
    ),
}

# Frequency [rad/s] and damping ratio of the springs and dampers that a draft suggests for joints
# without a motor.
_SWING = math.pi
_DAMPED = 0.01

# Inertia [kg m^2], torque [N m] and largest speed [rad/s] of a small reaction wheel, which a draft
# suggests if the URDF does not give them.
_ROTOR, _MOTOR, _SPEED = 1e-3, 0.1, 600.0


def robot_info(robot: Robot, at_point: str = "") -> str:
    """Return text about a robot's tree, masses and limits, with `at_point` below its heading."""
    modes = {joint.name for joint in robot.modes}
    inputs = sum(len(names) for _, names in robot.named_inputs)
    counts = [counted(robot.n - len(modes), "joint")]
    if modes:
        counts.append(counted(len(modes), "mode"))
    counts += [f"{12 + 2 * robot.n} states", counted(inputs, "input")]
    head = f"{robot.name}: {', '.join(counts)}, mass {robot.mass:.6g} kg"
    head += f"\nfrom {robot.urdf or 'a Pinocchio model'}"
    if robot.orbit:
        head += f"\n{folded(_orbit_lines(robot.orbit))}"
    tree = joint_table(robot)
    limits = ""
    if any(cell != "." for row in tree[1:] for cell in row[3:]):
        limits = LIMIT_UNITS
    frames = [
        frame.name for frame in robot.model.frames.tolist() if frame.parentJoint >= ROOT
    ]
    names = ", ".join(name for name in dict.fromkeys(frames) if name not in modes)
    parts = [head, at_point, grid(tree, "ll"), limits, folded(_settings(robot))]
    parts.append(f"frames\n{_indented(names, '  ')}")
    if robot.notes:
        parts.append(
            "\n".join(("warnings", *(_indented(note, "    ") for note in robot.notes)))
        )
    return "\n\n".join(filter(None, parts))


def _orbit_lines(orbit: Orbit) -> list[str]:
    """Return lines about an orbit and, if it has one, about its magnetic field."""
    lines = [str(orbit)]
    if orbit.field is not None:
        field = orbit.field if isinstance(orbit.field, str) else "function"
        angle = math.degrees(orbit.inclination)
        lines.append(f"magnetic field {field}, inclination {angle:.6g} deg")
    return lines


def joint_table(robot: Robot) -> list[list[str]]:
    """Return a table with one row for the base and for each joint that is not a mode.

    The joints are in the order of the tree, and their names are indented by their depth. The masses
    of modes are added to their carriers.
    """
    model = robot.model
    masses = [body.mass for body in model.inertias.tolist()]
    for index in sorted(
        (model.getJointId(joint.name) for joint in robot.modes), reverse=True
    ):
        masses[model.parents[index]] += masses[index]
    kinds = {joint: _kind(joint) for joint in robot.joints if not joint.mode}
    kinds |= {joint: "wheel" for joint in robot.joints if joint.name in robot.wheels}
    for joint, leader, multiplier, offset in robot.followers:
        kinds[joint] = f"mimics {leader.name} * {multiplier:g}"
        if offset:
            sign = "-" if offset < 0 else "+"
            kinds[joint] += f" {sign} {abs(offset):g}"
    rows = [["joint", "type", "mass [kg]", "lower", "upper", "effort", "velocity"]]
    rows.append(["(base)", "free", f"{masses[ROOT]:.6g}", ".", ".", ".", "."])
    depth = {ROOT: 0}
    for joint in sorted(kinds, key=lambda joint: joint.idx_v):
        index = model.getJointId(joint.name)
        depth[index] = depth[model.parents[index]] + 1
        rates = model.effortLimit[joint.idx_v], model.velocityLimit[joint.idx_v]
        cells = map(_limit, (*travel_of(model, joint), *rates))
        name = "  " * depth[index] + joint.name
        mass = f"{masses[index]:.6g}"
        rows.append([name, kinds[joint], mass, *cells])
    return rows


def _kind(joint: Joint) -> str:
    """Return the type of an independent joint in the words of URDF."""
    if joint.prismatic:
        return "prismatic"
    if joint.unbounded:
        return "continuous"
    return "revolute"


def _limit(value: float) -> str:
    """Return a limit as a cell of a table; "." if it is missing."""
    if abs(value) < 1e300:
        return f"{value:.5g}"
    return "."


def output_words(robot: Robot) -> list[str]:
    """Return each output as on the command line, with the properties of its sensor."""
    words = []
    for output in robot.outputs:
        joints = vars(output).get("joints") or ()
        word = ":".join((output.WORD, *output.frames, *joints))
        words.append(f"{word} ({output.sensor})" if output.sensor else word)
    return words


def _settings(robot: Robot) -> list[str]:
    """Return lines about the fields that a URDF does not contain, except inputs and orbit."""
    outputs = output_words(robot)
    shown: dict[str, object] = {
        "stiffness [N m/rad | N/m | 1/s^2]": robot.stiffness,
        "damping [N m s/rad | N s/m | 1/s]": robot.damping,
        "spring rest positions [rad | m]": robot.rest,
        "reaction torques [N m/N]": {
            thruster.name: thruster.torque
            for thruster in robot.inputs
            if isinstance(thruster, Thruster) and thruster.torque
        },
        "passive joints": robot.passive,
        "locked joints": robot.locked,
        "gravity [m/s^2]": robot.gravity if any(robot.gravity) else (),
        "disturbance, in simulations only": {
            name: [term.text(name, orbit=robot.orbit is not None) for term in terms]
            for name, terms in robot.disturbance.items()
        },
        **_actuators(robot),
        "outputs": outputs if outputs != ["state"] else (),
        "limits": {
            key: f"{low:g} to {high:g}" for key, (low, high) in robot.limits.items()
        },
        **{f"weights, {part}": value for part, value in robot.weights.items()},
    }
    for name in ("point", "target", "start"):
        for part, value in getattr(robot, name).items():
            shown[f"{name}, {part} {_STATE[part]}"] = value
    lines = [f"{title}: {_as_text(value)}" for title, value in shown.items() if value]
    return lines + [
        f"{x.title} on frame {x.frame}: modes {', '.join(x.modes)}"
        for x in robot.appendages
    ]


def _actuators(robot: Robot) -> dict[str, tuple[str, ...]]:
    """Return the properties of actuators, {properties: names of the inputs that have them}."""
    names_of: dict[str, list[str]] = {}
    for item, names in robot.named_inputs:
        if item.actuator:
            name = item.GROUP if len(names) > 1 else names[0]
            names_of.setdefault(item.actuator, []).append(name)
    return {f"inputs ({key})": tuple(names) for key, names in names_of.items()}


def _as_text(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} = {_as_text(entry)}" for key, entry in value.items())
    if isinstance(value, tuple | list):
        return ", ".join(map(_as_text, value))
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)


def _indented(text: str, below: str) -> str:
    return fill(text, width(), initial_indent="  ", subsequent_indent=below)


def draft(robot: Robot, urdf: str) -> str:
    """Return the draft of a robot file; `urdf` is the path of the URDF in the draft."""
    model = robot.model
    idle = [joint for joint in robot.joints if model.effortLimit[joint.idx_v] == 0.0]
    names = ", ".join(_text(joint.name) for joint in idle)
    passive = f"\n# Joints without a motor: their effort is 0 in the URDF.\npassive = [{names}]\n"
    mark = ""  # before the springs and dampers that are guessed
    if len(idle) == robot.n:
        mark = "# "
        passive = (
            "\n# The URDF gives every joint an effort of 0, as some exporters do. If the joints\n"
            "# have no motors, uncomment this line, and the springs and dampers below.\n"
            f"# passive = [{names}]\n"
        )
    if not idle:
        passive = ""
    M = pin.crba(model, model.createData(), robot.neutral())
    inertia = {joint.name: float(M[joint.idx_v, joint.idx_v]) for joint in idle}
    known = {name: value for name, value in robot.urdf_damping.items() if value}
    guessed = {name: 2.0 * _DAMPED * _SWING * size for name, size in inertia.items()}
    damping = {
        mark + _text(name): guessed[name] for name in guessed if name not in known
    }
    damping |= {_text(name): value for name, value in known.items()}
    limits = {}
    for name, (low, high) in limits_of(robot).items():
        limit = f"{high:.6g}" if low == -high else f"[{low:.6g}, {high:.6g}]"
        limits[f"# {_text(name)}"] = limit
    candidates, spun = _candidates(robot)
    on_base = [
        frame.name
        for frame in model.frames.tolist()
        if frame.parentJoint == ROOT and frame.type == pin.FrameType.BODY
    ]
    first_joint = robot.joint_names[0] if robot.n else "joint_1"
    joint = _text(first_joint)
    first_frame = on_base[0] if on_base else "root_joint"
    tables = {
        "damping": {key: f"{value:.6g}" for key, value in damping.items()},
        "stiffness": {
            mark + _text(name): f"{size * _SWING**2:.6g}"
            for name, size in inertia.items()
        },
        "limits": limits,
    }
    template = Template(
        (Path(__file__).parent / "assets" / "robot.toml").read_text("utf-8")
    )
    return template.substitute(
        {
            key: "".join(f"{k} = {x}\n" for k, x in entries.items())
            for key, entries in tables.items()
        },
        name=_text(robot.name)[1:-1],
        joints=counted(robot.n, "joint"),
        mass=f"{robot.mass:.6g}",
        urdf=_text(urdf),
        joint=joint,
        frame=_text(first_frame),
        passive=passive,
        candidates=candidates,
        lock=", ".join(spun) or joint,
    )


def _candidates(robot: Robot) -> tuple[str, list[str]]:
    """Return suggested inputs as TOML text, and the names of joints that are probably wheels.

    An input is suggested for each link with a name such as "wheel" or "thruster". All lines of the
    text are TOML comments. The names of joints are quoted as TOML strings.
    """
    model = robot.model
    data = robot.create_data()
    pin.framesForwardKinematics(model, data, robot.neutral())
    text = ""
    spun = []

    # numbers in names compare by value
    def in_order(index: int) -> list[tuple[float, str]]:
        parts = re.split(r"([0-9]+)", model.frames[index].name)
        return [(float(x), "") if x.isdecimal() else (-1.0, x) for x in parts]

    for index in sorted(range(model.nframes), key=in_order):
        frame = model.frames[index]
        kind = next(
            (kind for kind, look in _LOOKS.items() if look.search(frame.name)), ""
        )
        if not kind or frame.type != pin.FrameType.BODY or frame.parentJoint < ROOT:
            continue
        axis = np.array([0.0, 0.0, 1.0])
        lines = ["max = 1.0  # [N]"]
        lock = ""
        name = _text(frame.name)
        key = "direction"
        if kind == "reaction_wheel":
            # The name of a wheel must differ from the names of all joints and frames.
            name = _text(f"{frame.name}_rotor")
            key = "axis"
            joint = model.joints[frame.parentJoint]
            if (
                joint.nv == 1
                and model.frames[frame.parentFrame].type == pin.FrameType.JOINT
            ):
                axis = np.asarray(data.joints[frame.parentJoint].S).reshape(6)[3:]
                size = axis @ model.inertias[frame.parentJoint].inertia @ axis
                spun.append(_text(model.names[frame.parentJoint]))
                lock = f"# To use this wheel, lock joint {spun[-1]} above.\n"
                effort = model.effortLimit[joint.idx_v]
                speed = model.velocityLimit[joint.idx_v]
            else:
                size = axis @ frame.inertia.inertia @ axis
                effort = speed = 0.0
            lines = [
                _guessed("inertia", size, _ROTOR, "[kg m^2]"),
                _guessed("max", effort, _MOTOR, "[N m]"),
                _guessed("max_speed", speed, _SPEED, "[rad/s]"),
            ]
        placed = data.oMf[index]
        remark = (
            f"# Link {_text(frame.name)} at {_vector(placed.translation)} [m], {key} "
            f"{_vector(placed.rotation @ axis)}, both in base axes:"
        )
        about = [f'type = "{kind}"', f"name = {name}", f"frame = {_text(frame.name)}"]
        if kind == "thruster":
            about.append("position = [0, 0, 0]  # [m], in that frame")
        lines = ["[[input]]", *about, f"{key} = {_vector(axis)}", *lines]
        text += f"{fill(remark, 80, subsequent_indent='# ', break_long_words=False)}\n{lock}"
        text += "".join(f"# {line}\n" for line in lines)
    return text, spun


def _guessed(key: str, value: float, guess: float, unit: str) -> str:
    """Return a line of TOML with a value, or with a guess if the URDF gives no finite value."""
    if 0.0 < value < 1e100:
        return f"{key} = {value:.6g}  # {unit}"
    return f"{key} = {guess:g}  # {unit}; a guess"


def ideal_inputs(robot: Robot) -> str:
    """Return a remark on the inputs of a robot that no actuator has, or ""."""
    ideal = [x for x in robot.inputs if isinstance(x, BaseTorque | BaseForce)]
    if not ideal:
        return ""
    kinds = " and ".join(
        "torque" if isinstance(x, BaseTorque) else "force" for x in ideal
    )
    limits = "" if all(x.max is not None for x in ideal) else " without limits"
    remark = f"an ideal {kinds}{limits} on the base stands for its actuators"
    if BaseTorque() not in ideal or BaseForce() not in ideal:
        # These are not the default inputs, so the user has chosen them.
        return remark
    return (
        f"{remark}; for thrusters or wheels, give the robot file [[input]] tables, or the option "
        "--inputs a file"
    )


def _vector(values: np.ndarray) -> str:
    return f"[{', '.join(f'{x:.6g}' for x in np.round(values, 9) + 0.0)}]"


def _text(name: str) -> str:
    """Return a name as a TOML string."""
    return json.dumps(name, ensure_ascii=False).replace("\x7f", "\\u007f")
