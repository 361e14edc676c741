"""The figures beside a motion: errors, drift of the momentum and inputs over time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.state import StateMap
from fflin.robot.robot import Robot
from fflin.view.page import packed

_TITLES = {
    "tau_b": ("base torque", "N m"),
    "F_b": ("base force", "N"),
    "tau_m": ("joint torques", "N m"),
    "thrust": ("thrusters", "N"),
    "wheel": ("wheel torques", "N m"),
}


def errors(robot: Robot, q: Array, target: Array) -> dict[str, Array]:
    """Return the distance of configurations (N, nq) from a target (nq,).

    Returns
    -------
    dict
        attitude [deg], position [m] of the base, turns [deg] and slides [m]: the largest errors of
        joints that turn and that slide, which reaction wheels do not count as; each (N,).
    """
    state = StateMap(robot)
    goal = pin.XYZQUATToSE3(target[:7])
    relative = [goal.actInv(pin.XYZQUATToSE3(each[:7])) for each in q]
    joints = np.array([state.joint_positions(each) for each in q]) - state.joint_positions(target)
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


def panel(
    robot: Robot,
    state: StateMap,
    q: Array,
    u: Array,
    target: Array,
    drift: Array,
    of_com: Array | None = None,
) -> dict[str, Any]:
    """Return the readouts and plots of a motion's page.

    Parameters
    ----------
    robot : Robot
    state : StateMap
    q : ndarray (N, nq)
    u : ndarray (N, nu)
    target : ndarray (nq,)
    drift : ndarray (N,)
        Of the momentum, relative.
    of_com : ndarray (N,), optional
        Distance of the centre of mass from its line [m].
    """
    found = errors(robot, q, target)
    slide = any(joint.prismatic for joint in robot.joints)
    turn = robot.n > len(robot.wheels) + sum(joint.prismatic for joint in robot.joints)
    readouts = [
        ("attitude error", "°", found["attitude"]),
        ("position error", "m", found["position"]),
        *([("largest joint error", "°", found["turns"])] if turn else []),
        *([("largest slide error", "m", found["slides"])] if slide else []),
        ("momentum drift", "", drift),
        *([] if of_com is None else [("centre of mass drift", "m", of_com)]),
    ]
    plots: list[dict[str, Any]] = [
        _plot("attitude error", "°", [("", found["attitude"])]),
        _plot("position error", "m", [("", found["position"])]),
    ]
    for kind, columns in Actuation(state).groups.items():
        if kind not in _TITLES or not np.any(u[:, columns]):
            continue
        labels = ["x", "y", "z"] if len(columns) == 3 and kind in ("tau_b", "F_b") else None
        title, unit = _TITLES[kind]
        lines = [(labels[k] if labels else "", u[:, column]) for k, column in enumerate(columns)]
        plots.append(_plot(title, unit, lines))
    return {
        "readouts": [
            {"label": label, "unit": unit, "values": packed(values)}
            for label, unit, values in readouts
        ],
        "plots": plots,
    }


def _plot(title: str, unit: str, lines: list[tuple[str, Array]]) -> dict[str, Any]:
    return {
        "title": title,
        "unit": unit,
        "lines": [{"label": label, "values": packed(values)} for label, values in lines],
    }
