"""Replay of runs: what a campaign's file keeps of its call, and the job that repeats its runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, listed
from fflin.base.validation import by_name, instance, untied
from fflin.campaign.runs import CampaignJob
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from fflin.campaign.campaign import Campaign

# A spread that every kind of dispersion accepts. A replayed run draws no values.
_ANY_SPREAD = (0.0, 1.0)


def replay_settings(
    dispersions: object, options: Mapping[str, object]
) -> dict[str, object]:
    """Return what is needed to repeat the runs of a call, as JSON values.

    The result contains the dispersed names, each with a flag whether the names of a pattern share
    one value, the options of the call, and the names of options that cannot be written as JSON.
    """
    kept = dict[str, object]()
    missing = list[str]()
    for name, value in options.items():
        if value is None or name == "histories":
            continue
        if isinstance(value, pin.SE3):
            kept[name] = {"placement": value.homogeneous.tolist()}
        elif isinstance(value, LinearModel) or callable(value):
            missing.append(name)
        else:
            kept[name] = _plain(value)
    spreads = by_name("dispersions", dispersions, "name")
    names = {key: untied(key, spread)[1] for key, spread in spreads.items()}
    return {"dispersions": names, "options": kept, "missing": missing}


def _plain(value: object) -> object:
    """Convert arrays and NumPy numbers, also inside mappings and sequences, to JSON values."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return value


def job_of_campaign(
    campaign: Campaign,
    robot: Robot | None,
    policy: object,
    options: Mapping[str, object],
) -> CampaignJob:
    """Return the job that repeats the runs of a campaign; see `Campaign.replay`."""
    if robot is not None:
        return job_of(campaign, robot, policy, options)
    if campaign._job is None:
        raise InputError(
            "the campaign was loaded from a file, which does not contain its robot and policy; "
            "give them, as in replay(0, robot=robot, policy=policy)"
        )
    return campaign._job


def job_of(
    campaign: Campaign, robot: object, policy: object, options: Mapping[str, object]
) -> CampaignJob:
    """Return the job that repeats the runs of a campaign that was loaded from a file.

    `options` are the options of the original call that the file does not contain.
    """
    checked_robot = instance("robot", robot, Robot, "the fflin.Robot of the campaign")
    if checked_robot.urdf_sha256 != campaign.urdf_sha256:
        raise InputError(
            f"robot is '{checked_robot.name}', but the campaign is of another URDF, "
            f"'{campaign.robot}'; give the robot of the campaign"
        )
    settings: Mapping[str, Any] = campaign.replay_settings
    if not settings:
        raise InputError(
            "the campaign's file was written by an earlier version and does not contain the "
            "options of its call; call monte_carlo again with the same seed"
        )
    lacking = [f"{name}=" for name in settings["missing"] if name not in options]
    if lacking:
        raise InputError(
            f"a file cannot contain {listed(lacking)}; give the same value as to monte_carlo"
        )
    spreads: dict[str, object] = {}
    for name, tied in settings["dispersions"].items():
        spreads[name] = {"range": _ANY_SPREAD, "tied": True} if tied else _ANY_SPREAD
    again = {**settings["options"], **options}
    placement = again.get("reference")
    if isinstance(placement, Mapping):
        again["reference"] = pin.SE3(np.array(placement["placement"]))
    job = CampaignJob(
        checked_robot, policy, spreads, campaign.seed, campaign.engine, again
    )
    if (
        job.dispersions.names != campaign.names
        or job.plant.state.names != campaign.state_names
    ):
        raise InputError(
            "the robot or policy differs from the campaign, because the names of the drawn "
            "values or of the states differ; give the arguments of the call of monte_carlo"
        )
    return job
