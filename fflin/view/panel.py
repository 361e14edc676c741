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

# Titles of inputs of a group and a unit; of another group its own name.
_TITLES = {
    ("tau_b", "N m"): "base torque",
    ("F_b", "N"): "base force",
    ("tau_m", "N m"): "joint torques",
    ("tau_m", "N"): "joint forces",
    ("thrust", "N"): "thrusters",
    ("wheel", "N m"): "wheel torques",
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
    target: Array | None,
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
    target : ndarray (nq,) or None
        Without one there are no errors.
    drift : ndarray (N,)
        Of the momentum, relative.
    of_com : ndarray (N,), optional
        Distance of the centre of mass from its line [m].
    """
    found = {} if target is None else errors(robot, q, target)
    slide = any(joint.prismatic for joint in robot.joints)
    turn = robot.n > len(robot.wheels) + sum(joint.prismatic for joint in robot.joints)
    shown = {"attitude error": ("°", "attitude"), "position error": ("m", "position")}
    shown |= {"largest joint error": ("°", "turns")} if turn else {}
    shown |= {"largest slide error": ("m", "slides")} if slide else {}
    readouts = [(label, unit, found[key]) for label, (unit, key) in shown.items() if found]
    plots = [_plot(label, unit, [("", values)]) for label, unit, values in readouts[:2]]
    readouts.append(("momentum drift", "", drift))
    if of_com is not None:
        readouts.append(("centre of mass drift", "m", of_com))
    actuation = Actuation(state)
    for kind, indices in actuation.groups.items():
        labels = "xyz" if kind in ("tau_b", "F_b") else [""] * len(indices)
        for unit in dict.fromkeys(actuation.units[index] for index in indices):
            lines = [
                (label, u[:, index])
                for label, index in zip(labels, indices, strict=True)
                if actuation.units[index] == unit
            ]
            if any(values.any() for _, values in lines):
                plots.append(_plot(_TITLES.get((kind, unit), kind), unit, lines))
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
