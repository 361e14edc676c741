"""The tube of a funnel in the page: ellipsoids of the positions of base and tool."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.dynamics.state import StateMap
from fflin.robot.frames import frame_index
from fflin.robot.robot import Robot
from fflin.view.page import packed

_COUNT, _THIN = 160, 1e-3  # ellipsoids along a path; the least half axis in sizes of the robot


def tubes(
    robot: Robot, funnel: Any, tool: str | None, size: float, colors: tuple[str, str]
) -> list[dict[str, Any]]:
    """Return centres (N, 3) and half axes (N, 9) of the ellipsoids of tool and base."""
    from fflin.campaign.reach import Funnel

    if not isinstance(funnel, Funnel):
        said = f"funnel is a {type(funnel).__name__}, expected a Funnel"
        raise InputError(f"{said}, as fflin.funnel returns it")
    if funnel.robot.joint_names != robot.joint_names or funnel.q.shape[1] != robot.nq:
        raise InputError(f"the funnel belongs to '{funnel.robot.name}', expected '{robot.name}'")
    state, model, data = StateMap(robot, frame="local"), robot.model, robot.model.createData()
    frames = {"base": None} | ({"tool": frame_index(model, tool)} if tool else {})
    found: dict[str, list[Any]] = {name: [] for name in frames}
    for t in np.linspace(funnel.t[0], funnel.t[-1], _COUNT):
        q = funnel.trajectory.flow.at(float(t))[0]
        root = funnel.root(float(t), smooth=True)
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        turned = pin.XYZQUATToSE3(q[:7])
        # How base, turned by twice the vector part of a quaternion, and joints are displaced.
        moved = state.lift(np.vstack((2.0 * root[:3], root[3:6], root[6 : 6 + robot.n])))
        for name, frame in frames.items():
            at, way = turned.translation, turned.rotation @ root[3:6]
            if frame is not None:
                at = data.oMf[frame].translation.copy()
                world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
                way = pin.getFrameJacobian(model, data, frame, world)[:3] @ moved
            axes, sizes, _ = np.linalg.svd(np.hstack((way, np.zeros((3, 3)))))
            found[name].append((at, (axes * np.maximum(sizes[:3], _THIN * size)).T.ravel()))
    return [
        {"name": name, "colour": color, "centres": packed(centres), "axes": packed(axes)}
        for (name, rows), color in zip(reversed(found.items()), colors[-len(found) :], strict=True)
        for centres, axes in [map(np.array, zip(*rows, strict=True))]
    ]
