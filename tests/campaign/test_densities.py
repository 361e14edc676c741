"""A link's density means the same in campaigns as in `sensitivity` and `uncertain`."""

import numpy as np
import pytest

import fflin
from fflin.campaign.runs import CampaignJob
from tests.support.campaigns import both

pytestmark = pytest.mark.filterwarnings("ignore::fflin.FflinWarning")


def drawn(robot, given):
    job = CampaignJob(robot, None, given, 0, "python", {"duration": 1.0})
    return job.dispersions.one(job.dispersions.rows(0, 1).drawn[0])[0].robot


def same_bodies(robot, other):
    for body, expected in zip(robot.model.inertias, other.model.inertias, strict=True):
        there = expected.toDynamicParameters()
        assert np.abs(body.toDynamicParameters() - there).max() <= 1e-13 * np.abs(there).max()


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("servicer_7dof", {"link_3": 0.3, "base": -0.2}),
        ("planar_detumble", {"target": 0.1, "hand": -0.5, "link_1": 2.0}),
        ("robots/inspector.toml", {"base": 0.2, "gripper": -0.3}),
    ],
)
def test_a_density_is_that_of_uncertain_robots(name, changes):
    robot = fflin.load(name)
    ranges = {f"{link}.density": (0.1, 4.0) for link in changes}
    of = fflin.uncertain(robot, ranges)
    expected = of.at({f"{link}.density": 1.0 + d for link, d in changes.items()})
    found = drawn(robot, {f"{link}.density": [d] for link, d in changes.items()})
    same_bodies(found, expected)
    assert found.mass != robot.mass


def test_of_a_body_of_one_link_it_is_the_mass_of_the_body():
    robot = fflin.load("servicer_7dof")
    same_bodies(drawn(robot, {"link_3.density": [0.3]}), drawn(robot, {"joint_3.mass": [0.3]}))


def test_lanes_and_patterns():
    robot = fflin.load("planar_detumble")
    campaign = both(robot, None, {"*.density": 0.1, "joint_1.com": 0.1, "qdot_m": 0.1})
    assert len(campaign["q"]) == 3
    job = CampaignJob(robot, None, {"*.density": 0.1}, 0, "python", {"duration": 1.0})
    names = job.dispersions.names
    assert "target.density" in names and "joint_3.density" not in names
    assert len(names) == len(robot.links)


def test_what_is_wrong_is_one_line():
    robot = fflin.load("servicer_7dof")
    both_of = {"link_3.density": 0.1, "joint_3.mass": 0.1}
    with pytest.raises(fflin.InputError, match=r"'joint_3\.mass' and 'link_3\.density' both"):
        drawn(robot, both_of)
    with pytest.raises(fflin.InputError, match="expected more than -1"):
        fflin.monte_carlo(robot, None, {"link_3.density": [-1.0]}, runs=1, duration=0.1, dt=0.1)
    with pytest.raises(fflin.UnknownNameError, match="link_3"):
        drawn(robot, {"link_33.density": 0.1})
