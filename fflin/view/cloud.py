"""Paths of the runs of a campaign, drawn as thin lines around the motion of a page."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.campaign.campaign import Campaign
from fflin.robot.frames import find_frame
from fflin.robot.robot import ROOT, Robot
from fflin.view.page import packed

# With these a page grows by no more than 1.2 MB.
_RUNS, _ROWS = 240, 150

_COLORS = {"base": "#a9c4e8", "tool": "#ffb877"}


def drawn_robot(robot: Robot, cloud: Any, motion: Any) -> Robot:
    """Return the robot of a motion shown with a cloud, with the bodies that its run drew."""
    if not isinstance(cloud, Campaign):
        said = f"cloud is a {type(cloud).__name__}, expected a Campaign"
        raise InputError(f"{said}, as fflin.monte_carlo returns it")
    if cloud.urdf_sha256 != robot.urdf_sha256:
        raise InputError(
            f"cloud is a campaign of '{cloud.robot}', which differs from the robot '{robot.name}'; "
            "give the robot of the campaign"
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
