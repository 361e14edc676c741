"""The panel beside a motion: errors, states, inputs and limits over time."""

from __future__ import annotations

from itertools import compress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.names import input_keys
from fflin.base.validation import Array
from fflin.dynamics.state import StateMap
from fflin.robot.robot import Robot
from fflin.simulation.motion_plot import resting_from
from fflin.view.page import packed

if TYPE_CHECKING:
    from fflin.simulation.motion import Motion

# A limit is drawn where a curve comes to this share of it.
_NEAR = 1.0 / 3.0

# What is below this, in SI units, is rounding.
_NOTHING = 1e-14

# Nor is a line drawn that is below this share of the largest of its plot.
_UNSEEN = 1e-6

_OPEN = np.full(2, np.inf)
_NONE = np.zeros(0)

# Titles of states and inputs of a group and a unit; in a family a name has one colour.
_CHARTS: tuple[dict[tuple[str, str], str], ...] = (
    {("tau_b", "N m"): "base torque"},
    {("F_b", "N"): "base force"},
    {
        ("q_m", "rad"): "joints",
        ("q_m", "m"): "prismatic joints",
        ("q_m", "kg^0.5 m"): "modal amplitudes",
        ("qdot_m", "rad/s"): "joint rates",
        ("qdot_m", "m/s"): "prismatic joint rates",
        ("tau_m", "N m"): "joint torques",
        ("tau_m", "N"): "joint forces",
    },
    {("thrust", "N"): "thrusters"},
    {
        ("speed", "rad/s"): "wheel speed",
        ("wheel", "N m"): "wheel torque",
        ("momentum", "N m s"): "wheel momentum",
    },
)


class _Line(NamedTuple):
    """Values (N,) of a name, its limits (2,), infinite where open, and a reference (N,) or (0,)."""

    name: str
    values: Array
    limits: Array
    reference: Array = _NONE

    @property
    def size(self) -> float:
        """The largest of its values."""
        return float(np.abs((*self.values, *self.reference)).max())


def errors(robot: Robot, q: Array, target: Array) -> dict[str, tuple[str, Array]]:
    """Return {what: (unit, values (N,))}, how far q (N, nq) is from targets.

    Wheels and modes are left out.
    """
    state = StateMap(robot)
    goals = map(pin.XYZQUATToSE3, np.broadcast_to(target, q.shape)[:, :7])
    relative = [
        goal.actInv(pin.XYZQUATToSE3(each[:7])) for goal, each in zip(goals, q, strict=True)
    ]
    joints = state.joint_positions(q) - state.joint_positions(target)
    for index, joint in enumerate(robot.joints):
        if joint.unbounded:
            joints[:, index] = np.angle(np.exp(1j * joints[:, index]))
    wheels = robot.wheels
    turns = [not (j.prismatic or j.mode or j.name in wheels) for j in robot.joints]
    slides = [j.prismatic and not j.mode for j in robot.joints]
    found = {
        "attitude": ("°", np.degrees([np.linalg.norm(pin.log3(x.rotation)) for x in relative])),
        "position": ("m", np.array([np.linalg.norm(x.translation) for x in relative])),
    }
    if any(turns):
        found["largest joint"] = ("°", np.degrees(np.abs(joints[:, turns]).max(axis=1)))
    if any(slides):
        found["largest prismatic joint"] = ("m", np.abs(joints[:, slides]).max(axis=1))
    return {k: (unit, np.where(x < _NOTHING, 0.0, x)) for k, (unit, x) in found.items()}


def panel(robot: Robot, motion: Motion, shown: Array, target: Array) -> dict[str, Any]:
    """Return readouts and plots of a page's rows (N,), with errors where it has targets (k, nq)."""
    found = errors(robot, motion.q[shown], target if len(target) else motion.q[:1])
    of = "{} error" if len(target) else "{} change"
    readouts = [(of.format(what), unit, values) for what, (unit, values) in found.items()]
    plots = [
        _plot(title, unit, [_Line("", values, _OPEN)])
        for title, unit, values in readouts[: 4 if len(target) > 1 else 2]
        if values.any()
    ]
    readouts.append((f"{motion.kept} drift", "", motion.momentum_drift[shown]))
    if len(motion.com_drift):  # a file may not tell
        readouts.append(("centre of mass drift", "m", motion.com_drift[shown]))
    reference = motion.target[shown] if len(target) > 1 else np.zeros((0, motion.x.shape[1]))
    lines = _lines(robot, motion, shown, reference)
    for family, charts in enumerate(_CHARTS):
        for key, title in charts.items():
            sizes = [line.size for line in lines.get(key, [])]
            seen = [x > _UNSEEN * max(sizes) for x in sizes]
            plot = _plot(title, key[1], list(compress(lines.get(key, []), seen)), family)
            # Of rates their limits alone are of interest.
            if any(each["limits"] or not title.endswith("rates") for each in plot["lines"]):
                plots.append(plot)
    return {
        "readouts": [
            {"label": label, "unit": unit, "values": packed(values)}
            for label, unit, values in readouts
        ],
        "plots": plots,
        "rest": resting_from(motion) if len(target) > 1 and not motion.phases else None,
        "passed": [[str(each), each.time] for each in motion.passed],
    }


def _lines(
    robot: Robot, motion: Motion, shown: Array, reference: Array
) -> dict[tuple[str, str], list[_Line]]:
    """Return the lines of states and inputs that are not zero all along, by group and unit."""
    limits = dict(zip(motion.limit_names, motion.limits, strict=True))
    found: dict[tuple[str, str], list[_Line]] = {}
    names, inputs = motion.state_names, motion.input_names
    for name, key, unit, column, followed in (
        *zip(names, names, motion.state_units, motion.x.T, reference.T, strict=True),
        *zip(
            *(inputs, input_keys(motion), motion.input_units, motion.u.T, [_NONE] * len(inputs)),
            strict=True,
        ),
    ):
        group, _, entry = key.partition(".")
        line = _Line(entry, column[shown], limits.get(name, _OPEN), followed)
        if line.size < _NOTHING:
            continue
        if group in ("q_m", "qdot_m") and entry in robot.wheels:
            if group == "q_m":
                continue
            group, inertia = "speed", robot.wheels[entry]
            momentum = _Line(entry, *(inertia * each for each in line[1:]))
            found.setdefault(("momentum", "N m s"), []).append(momentum)
        found.setdefault((group, unit), []).append(line)
    return found


def _plot(title: str, unit: str, lines: list[_Line], family: int = -1) -> dict[str, Any]:
    """Return a plot, with those limits of each line that it comes near."""
    return {
        "title": title,
        "unit": unit,
        "family": family,
        "lines": [
            {
                "label": line.name,
                "values": packed(line.values),
                "reference": packed(line.reference),
                "limits": [
                    level
                    for level in line.limits[np.isfinite(line.limits)].tolist()
                    if level and (line.values / level).max() >= _NEAR
                ],
            }
            for line in lines
        ],
    }
