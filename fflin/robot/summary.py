"""Summary of a robot in text and tables."""

import math
import textwrap
from collections.abc import Iterable, Mapping
from typing import Any

from fflin.base.tables import counted, folded, grid, width
from fflin.robot.inputs import BaseForce, BaseTorque
from fflin.robot.robot import ROOT, Robot

_LIMITS = "limits in rad, N m and rad/s; for prismatic joints in m, N and m/s"
_START = {"rpy": "[deg]", "position": "[m]", "joints": "[rad | m]", "velocity": "[rad/s | m/s]"}


def robot_list(entries: Iterable[tuple[str, Robot | str, str]]) -> str:
    """Show robots: (name, the robot or why it does not load, where from)."""
    rows, refused = [["name", "n", "mass [kg]", "from"]], []
    for name, robot, origin in entries:
        if isinstance(robot, str):
            refused.append(f"{name} does not load: {robot}")
        else:
            rows.append([name, str(robot.n), f"{robot.mass:.6g}", origin])
    notes = [textwrap.fill(line, width(), subsequent_indent="  ") for line in refused]
    head = f"{len(rows) - 1} robots load by name, {len(refused)} cannot be loaded"
    return "\n\n".join((head, grid(rows, "lrrl"), *notes))


def robot_info(robot: Robot) -> str:
    """Show a robot's tree, masses and limits."""
    model = robot.model
    inputs = sum(3 if isinstance(item, BaseTorque | BaseForce) else 1 for item in robot.inputs)
    source = str(robot.urdf) if robot.urdf else "a Pinocchio model"
    head = (
        f"{robot.name}: {counted(robot.n, 'joint')}, {12 + 2 * robot.n} states, "
        f"{counted(inputs, 'input')}, mass {robot.mass:.6g} kg\nfrom {source}"
    )
    if robot.orbit:
        head += f"\n{folded([str(robot.orbit)])}"
    depth = {0: -1, 1: 0}
    rows = [["joint", "type", "mass [kg]", "lower", "upper", "effort", "velocity"]]
    rows.append(["(base)", "free", f"{model.inertias[1].mass:.6g}", ".", ".", ".", "."])
    kinds = {
        joint: "prismatic" if joint.prismatic else "continuous" if joint.unbounded else "revolute"
        for joint in robot.joints
    }
    kinds |= {joint: "wheel" for joint in robot.joints if joint.name in robot.wheels}
    for joint, leader, multiplier, offset in robot.followers:
        kinds[joint] = f"mimics {leader.name} * {multiplier:g}"
        kinds[joint] += f" {'-' if offset < 0 else '+'} {abs(offset):g}" if offset else ""
    for joint in sorted(kinds, key=lambda joint: joint.idx_v):
        index = model.getJointId(joint.name)
        depth[index] = depth[model.parents[index]] + 1
        travel = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
        limits = (math.inf, math.inf) if joint.unbounded else travel
        limits += model.effortLimit[joint.idx_v], model.velocityLimit[joint.idx_v]
        mass = f"{model.inertias[index].mass:.6g}"
        rows.append(["  " * depth[index] + joint.name, kinds[joint], mass, *map(_limit, limits)])
    frames = [frame.name for frame in model.frames.tolist() if frame.parentJoint >= ROOT]
    limited = any(cell != "." for row in rows[1:] for cell in row[3:])
    parts = [head, grid(rows, "ll"), *[_LIMITS] * limited, *_settings(robot)]
    parts.append(f"frames\n{_indented(', '.join(dict.fromkeys(frames)), '  ')}")
    if robot.notes:
        parts.append("\n".join(("warnings", *(_indented(note, "    ") for note in robot.notes))))
    return "\n\n".join(parts)


def _settings(robot: Robot) -> list[str]:
    """Show what was set beside the URDF, but inputs and orbit."""
    outputs = [":".join((y.WORD, *y.frames, *(vars(y).get("joints") or ()))) for y in robot.outputs]
    shown = {
        "stiffness [N m/rad | N/m]": robot.stiffness,
        "damping [N m s/rad | N s/m]": robot.damping,
        "spring rest positions [rad | m]": robot.rest,
        "passive joints": robot.passive,
        "locked joints": robot.locked,
        "gravity [m/s^2]": robot.gravity if any(robot.gravity) else (),
        "outputs": outputs if outputs != ["state"] else (),
        "limits": {key: f"{low:g} to {high:g}" for key, (low, high) in robot.limits.items()},
        **{f"weights, {part}": value for part, value in robot.weights.items()},
        **{f"start, {part} {_START[part]}": value for part, value in robot.start.items()},
    }
    lines = [f"{title}: {_said(value)}" for title, value in shown.items() if value]
    return [folded(lines)] * bool(lines)


def _said(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} = {_said(each)}" for key, each in value.items())
    if isinstance(value, tuple | list):
        return ", ".join(map(_said, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _indented(text: str, below: str) -> str:
    return textwrap.fill(text, width(), initial_indent="  ", subsequent_indent=below)


def _limit(value: float) -> str:
    # Pinocchio marks what the URDF does not limit by the largest double or by infinity.
    return "." if not math.isfinite(value) or abs(value) > 1e300 else f"{value:.5g}"
