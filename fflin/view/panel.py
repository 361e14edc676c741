"""The figures beside a motion: where it is, what drives it and its limits, over time."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.names import input_keys
from fflin.base.validation import Array
from fflin.dynamics.state import StateMap
from fflin.robot.robot import Robot
from fflin.view.page import packed

if TYPE_CHECKING:
    from fflin.simulation.motion import Motion

_COLORS = (
    *("#ff7a70", "#7ad97f", "#6aa5ff", "#f6c35b", "#c58bff", "#5fd6d0"),
    *("#ff9ed0", "#b6c46a", "#9aa7ff", "#d79a6a", "#4fb08c", "#e05fa8"),
)
# Of more lines than there are colours those that change most are named, so many.
_NAMED, _UNNAMED = 8, "#8a93a5"

# A limit is drawn where a curve comes to this share of it.
_NEAR = 1.0 / 3.0

# What is below this, in SI units, is rounding.
_NOTHING = 1e-14

# What has one colour for a name, and one legend: charts of a group and a unit, in their order.
_CHARTS = (
    {("tau_b", "N m"): "base torque"},
    {("F_b", "N"): "base force"},
    {
        ("q_m", "rad"): "joints",
        ("q_m", "m"): "slides",
        ("qdot_m", "rad/s"): "joint rates",
        ("qdot_m", "m/s"): "slide rates",
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
    """What a chart shows of one name: its values (N,), and limits (2,), infinite where open."""

    name: str
    values: Array
    limits: Array


def errors(robot: Robot, q: Array, target: Array) -> dict[str, Array]:
    """Return the distance of configurations (N, nq) from a target (1, nq) or targets (N, nq).

    Returns
    -------
    dict
        attitude [deg], position [m] of the base, turns [deg] and slides [m]: the largest errors of
        joints that turn and that slide, which reaction wheels do not count as; each (N,).
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
    turns = [not j.prismatic and j.name not in wheels for j in robot.joints]
    slides = [j.prismatic for j in robot.joints]
    return {
        "attitude": np.degrees([np.linalg.norm(pin.log3(each.rotation)) for each in relative]),
        "position": np.array([np.linalg.norm(each.translation) for each in relative]),
        "turns": np.degrees(np.abs(joints[:, turns]).max(axis=1, initial=0.0)),
        "slides": np.abs(joints[:, slides]).max(axis=1, initial=0.0),
    }


def panel(robot: Robot, motion: Motion, shown: Array, target: Array) -> dict[str, Any]:
    """Return the readouts and plots of a motion's page.

    Parameters
    ----------
    robot : Robot
    motion : Motion
    shown : ndarray (N,) of int
        Its rows on the page.
    target : ndarray (k, nq)
        What the errors are counted from, one for all rows or one each; of none there are no
        errors, and the way from the start is shown.
    """
    found = errors(robot, motion.q[shown], target if len(target) else motion.q[:1])
    of = "{} error" if len(target) else "{} from the start"
    prismatic = [joint.prismatic for joint in robot.joints if joint.name not in robot.wheels]
    kinds = {"attitude": "°", "position": "m"}
    kinds |= {"turns": "°"} if not all(prismatic) else {}
    kinds |= {"slides": "m"} if any(prismatic) else {}
    titles = {"turns": "largest joint", "slides": "largest slide"}
    readouts = [
        (
            of.format(titles.get(kind, kind)),
            unit,
            np.where(found[kind] < _NOTHING, 0.0, found[kind]),
        )
        for kind, unit in kinds.items()
    ]
    none = np.full(2, np.inf)
    plots = [
        _plot(title, unit, [_Line("", values, none)], {})
        for title, unit, values in readouts[:2]
        if values.any()
    ]
    readouts.append(("momentum drift", "", motion.momentum_drift[shown]))
    if len(motion.com_drift):  # a file may not tell
        readouts.append(("centre of mass drift", "m", motion.com_drift[shown]))
    lines = _lines(robot, motion, shown)
    for charts in _CHARTS:
        family = {key: lines[key] for key in charts if key in lines}
        colors = _colors(family.values())
        drawn = [_plot(charts[key], key[1], each, colors) for key, each in family.items()]
        # Of rates their limits alone are of interest.
        drawn = [plot for plot in drawn if plot["limits"] or not plot["title"].endswith("rates")]
        if drawn:
            drawn[0]["keys"] = list(colors.items())
        plots += drawn
    return {
        "readouts": [
            {"label": label, "unit": unit, "values": packed(values)}
            for label, unit, values in readouts
        ],
        "plots": plots,
    }


def _lines(robot: Robot, motion: Motion, shown: Array) -> dict[tuple[str, str], list[_Line]]:
    """Return the lines of states and inputs that are not zero all along, by group and unit."""
    limits = dict(
        zip(getattr(motion, "limit_names", ()), getattr(motion, "limits", ()), strict=True)
    )
    found: dict[tuple[str, str], list[_Line]] = {}
    for name, key, unit, column in (
        *zip(motion.state_names, motion.state_names, motion.state_units, motion.x.T, strict=True),
        *zip(motion.input_names, input_keys(motion), motion.input_units, motion.u.T, strict=True),
    ):
        group, _, entry = key.partition(".")
        line = _Line(entry, column[shown], limits.get(name, np.full(2, np.inf)))
        if np.abs(line.values).max() < _NOTHING:
            continue
        if group in ("q_m", "qdot_m") and entry in robot.wheels:
            if group == "q_m":
                continue
            group, inertia = "speed", robot.wheels[entry]
            momentum = _Line(entry, inertia * line.values, inertia * line.limits)
            found.setdefault(("momentum", "N m s"), []).append(momentum)
        found.setdefault((group, unit), []).append(line)
    return found


def _colors(charts: Iterable[list[_Line]]) -> dict[str, str]:
    """Return {name: colour}: of all, or of those that change most."""
    change: dict[str, float] = {}
    for lines in charts:
        most = max(float(np.ptp(line.values)) for line in lines) or 1.0
        for line in lines:
            share = float(np.ptp(line.values)) / most
            change[line.name] = max(share, change.get(line.name, 0.0))
    if set(change) <= set("xyz"):
        return {axis: _COLORS["xyz".index(axis)] for axis in change}
    names = list(change)
    if len(names) > len(_COLORS):
        names = sorted(sorted(names, key=lambda name: -change[name])[:_NAMED], key=names.index)
    return dict(zip(names, _COLORS, strict=False))


def _plot(title: str, unit: str, lines: list[_Line], colors: dict[str, str]) -> dict[str, Any]:
    drawn: dict[float, set[str]] = {}
    for line in lines:
        for level in line.limits[np.isfinite(line.limits) & (line.limits != 0.0)].tolist():
            if (line.values / level).max() >= _NEAR:
                drawn.setdefault(level, set()).add(colors.get(line.name, _UNNAMED))
    return {
        "title": title,
        "unit": unit,
        "lines": [
            {
                "label": line.name,
                "colour": colors.get(line.name, _UNNAMED if line.name else _COLORS[0]),
                "values": packed(line.values),
            }
            for line in lines
        ],
        # One that several lines share is of no line's colour.
        "limits": [[level, *of] if len(of) == 1 else [level, ""] for level, of in drawn.items()],
    }
