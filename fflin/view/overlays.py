"""Marks of a campaign in the page of a motion: paths of runs, and the tube of a funnel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import instance
from fflin.dynamics.state import StateMap
from fflin.robot.joints import find_frame, frame_index
from fflin.robot.robot import ROOT, Robot
from fflin.view.page import packed

if TYPE_CHECKING:
    from fflin.campaign.campaign import Campaign
    from fflin.campaign.funnel import Funnel
    from fflin.simulation.motion import Motion

# With these a page grows by no more than 1.2 MB.
_RUNS, _ROWS = 240, 150

_COLORS = {"base": "#a9c4e8", "tool": "#ffb877"}

# Number of ellipsoids along a path, and their least half axis in sizes of the robot.
_COUNT, _THIN = 160, 1e-3


def drawn_robot(robot: Robot, cloud: Campaign, motion: Motion) -> Robot:
    """Return the robot of a motion shown with a cloud, with the bodies that its run drew."""
    from fflin.campaign.campaign import Campaign

    instance("cloud", cloud, Campaign, "a Campaign, as fflin.monte_carlo returns it")
    if cloud.urdf_sha256 != robot.urdf_sha256:
        raise InputError(
            f"cloud is a campaign of '{cloud.robot}', expected a campaign of the given robot "
            f"'{robot.name}'"
        )
    drawn: Robot = getattr(motion, "_robot", None) or robot
    same = list(drawn.model.names) == list(robot.model.names) and drawn.name == robot.name
    return drawn if same else robot


def cloud_of(robot: Robot, campaign: Campaign, tool: str | None) -> list[dict[str, Any]]:
    """Return the paths of base and tool of the runs, or of some of them, evenly chosen."""
    chosen = np.unique(np.linspace(0, len(campaign) - 1, _RUNS).astype(int))
    runs, data = campaign.courses(chosen.tolist(), _ROWS), robot.model.createData()
    ends = {"base": (ROOT, pin.SE3.Identity())}
    if tool:
        ends["tool"] = find_frame(robot.model, tool)
    points = np.empty((len(ends), sum(map(len, runs)), 3))
    for row, q in enumerate(np.concatenate(runs)):
        pin.forwardKinematics(robot.model, data, q)
        points[:, row] = [data.oMi[of].act(at.translation) for of, at in ends.values()]
    said = f"in {len(runs)} of {len(campaign):,} runs"
    return [
        {"name": name, "label": f"{name} {said}", "colour": _COLORS[name], "points": packed(of)}
        | {"counts": list(map(len, runs))}
        for name, of in zip(ends, points, strict=True)
    ]


def tubes(
    robot: Robot, funnel: Funnel, tool: str | None, size: float, colors: tuple[str, str]
) -> list[dict[str, Any]]:
    """Return centres (N, 3) and half axes (N, 9) of the ellipsoids of tool and base."""
    from fflin.campaign.funnel import Funnel

    instance("funnel", funnel, Funnel, "a Funnel, as fflin.funnel returns it")
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
