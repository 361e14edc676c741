"""The page that animates the natural modes of a robot, one at a time."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from fflin.analysis.modes import energies_of
from fflin.base.errors import InputError
from fflin.base.tables import counted
from fflin.base.validation import Array
from fflin.dynamics.state import StateMap
from fflin.robot.robot import Robot
from fflin.view.page import Page, packed, subtitle
from fflin.view.scene import Drawing, body_poses

if TYPE_CHECKING:
    from fflin.analysis.modes import Mode, Modes
    from fflin.linear.model import LinearModel

# Number of poses in a period, and the period's duration on the screen [s]. The amplitude is
# limited by the rotation _ANGLE [rad], and by the displacement _SHARE relative to the robot's
# size.
_PHASES, _PERIOD = 48, 2.0
_ANGLE, _SHARE = 0.5, 0.14


def mode_page(
    robot: Robot, found: Modes, *, scene: str, tool: str | None
) -> tuple[str, tuple[str, ...]]:
    """Return the page of a robot's modes, and notes about missing drawings; see `visualize`."""
    lin = found.lin
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    if lin.urdf_sha256 != robot.urdf_sha256 or lin.state_names != state.names:
        raise InputError(
            f"the modes belong to a model of '{lin.robot}' with {len(lin.state_names)} states, "
            f"expected the {state.nx} states of '{robot.name}'; give the robot and the modes of "
            "the same unreduced model"
        )
    if not found.vibrations:
        raise InputError(
            f"'{robot.name}' has no vibration to show: no mode oscillates; give its flexible "
            "joints a stiffness"
        )
    page = Page(robot, scene, tool, lin.frame)
    at_rest = body_poses(robot, robot.model.createData(), lin.q)
    page.drawing.place(at_rest)
    page.draw(robot, "rest", "ghost").place(at_rest)
    page.set_stage(at_rest, f"{subtitle(robot)}, {counted(len(found.vibrations), 'vibration')}")
    swings = [_swing(state, page.drawing, mode, lin, page.size) for mode in found.vibrations]
    energies = energies_of(robot, lin, [mode.shape for mode in found.vibrations])
    points = [page.drawing.points(at) for swing in swings for at in swing[:: _PHASES // 4]]
    modes = [
        {
            "frequency": mode.frequency,
            "damping": mode.damping_ratio,
            "unstable": bool(mode.unstable),
            "energy": list(energy.items())[:2],
            "shape": _shape(mode, lin),
            "poses": packed(poses),
        }
        for mode, (energy, _), poses in zip(found.vibrations, energies, swings, strict=True)
    ]
    corners = np.concatenate(points)
    html = page.html("modes", corners, period=_PERIOD, bodies=page.nodes, modes=modes)
    return html, page.drawing.notes


def _swing(state: StateMap, drawing: Drawing, mode: Mode, lin: LinearModel, size: float) -> Array:
    """Return poses (_PHASES, njoints - 1, 7) over a period of x0 + Re(a shape exp(i phase))."""
    robot, half = state.robot, len(lin.x0) // 2
    data = robot.model.createData()

    def poses(amplitude: float) -> Array:
        found = []
        for phase in np.arange(_PHASES) * (2.0 * math.pi / _PHASES):
            x = lin.x0.copy()
            x[:half] += amplitude * (mode.shape[:half] * np.exp(1j * phase)).real
            found.append(body_poses(robot, data, state.to_pinocchio(x)[0]))
        return np.array(found)

    # Displacement of the corners per unit amplitude, computed with a small amplitude.
    small = 1e-4
    rest = drawing.points(body_poses(robot, data, lin.q))
    moved = np.array([drawing.points(each) - rest for each in poses(small)])
    reach = float(np.linalg.norm(moved, axis=2).max()) / small
    turned = np.abs(mode.shape[:half]) * [
        {"1": 2.0, "rad": 1.0}.get(unit, 0.0) for unit in lin.state_units[:half]
    ]
    most = [_ANGLE / turned.max()] if turned.any() else []
    most += [_SHARE * size / reach] if reach else []
    return poses(min(most, default=0.0))


def _shape(mode: Mode, lin: LinearModel) -> list[tuple[str, str, float, float]]:
    """Return name, unit, amplitude and phase [deg] of the positions with the largest amplitude.

    The largest amplitude is 1.
    """
    sizes, phases = np.abs(mode.shape), np.angle(mode.shape, deg=True)
    order = np.argsort(-sizes[: len(sizes) // 2].round(9), kind="stable")[:8].tolist()
    return [
        (lin.state_names[i], lin.state_units[i], float(sizes[i]), float(phases[i]))
        for i in order
        if sizes[i] > 0.01
    ]
