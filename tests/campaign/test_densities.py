"""Masses, densities and centres of mass are the same in campaigns as in `uncertain`; tied draws."""

import numpy as np
import pytest

import fflin
from fflin.campaign.runs import CampaignJob
from fflin.robot.catalog import bundled_directory
from tests.support.campaigns import both

pytestmark = pytest.mark.filterwarnings("ignore::fflin.FflinWarning")


def drawn(robot, given):
    job = CampaignJob(robot, None, given, 0, "python", {"duration": 1.0})
    return job.dispersions.one(job.dispersions.drawn(0, 1)[0])[0].robot


def same_bodies(robot, other):
    for body, expected in zip(robot.model.inertias, other.model.inertias, strict=True):
        parameters = expected.toDynamicParameters()
        assert (
            np.abs(body.toDynamicParameters() - parameters).max()
            <= 1e-13 * np.abs(parameters).max()
        )


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("servicer_7dof", {"link_3": 0.3, "base": -0.2}),
        ("planar_detumble", {"target": 0.1, "hand": -0.5, "link_1": 2.0}),
        ("inspector.toml", {"base": 0.2, "gripper": -0.3}),
    ],
)
def test_a_density_matches_uncertain_robots(name, changes):
    robot = fflin.load(name)
    ranges = {f"{link}.density": (0.1, 4.0) for link in changes}
    uncertain = fflin.uncertain(robot, ranges)
    expected = uncertain.at({f"{link}.density": 1.0 + d for link, d in changes.items()})
    result = drawn(robot, {f"{link}.density": [d] for link, d in changes.items()})
    same_bodies(result, expected)
    assert result.mass != robot.mass


@pytest.mark.parametrize(
    ("name", "link", "body"),
    [("servicer_7dof", "link_3", "joint_3"), ("cubesat", "base", "base")],
)
def test_a_centre_of_mass_moves_as_that_of_uncertain_robots(name, link, body):
    robot = fflin.load(name)
    shift = {"x": 0.03, "y": -0.02, "z": 0.05}
    parameters = fflin.sensitivity(fflin.linearize(robot)).parameters
    now = {axis: parameters[f"{link}.com.{axis}"].value for axis in shift}
    uncertain = fflin.uncertain(
        robot, {f"{link}.com.{a}": (x - 0.1, x + 0.1) for a, x in now.items()}
    )
    job = CampaignJob(
        robot, None, {f"{body}.com": 0.02}, 0, "python", {"duration": 1.0}
    )
    assert job.dispersions.names == tuple(f"{body}.com.{axis}" for axis in shift)
    result = job.dispersions.one(np.array([*shift.values()]))[0].robot
    same_bodies(
        result, uncertain.at({f"{link}.com.{a}": now[a] + d for a, d in shift.items()})
    )
    at = robot.model.getJointId(body) if body != "base" else 1
    assert not np.array_equal(
        result.model.inertias[at].lever, robot.model.inertias[at].lever
    )


def test_one_draw_for_all_that_a_pattern_names():
    robot = fflin.load(
        "servicer_7dof", stiffness={"panel_left": 60.0, "panel_right": 80.0}
    )
    given = {
        "panel_*.stiffness": {"range": (-0.3, 0.3), "tied": True},
        "joint_*.mass": {"range": 0.1, "tied": True},
        "joint_2.com": 0.01,
        "panel_*.com": {"range": 0.01, "tied": True},
        "q_b": {"range": 0.01, "tied": True},
        "q_m.joint_1": 0.02,
    }
    job = CampaignJob(robot, None, given, 0, "python", {"duration": 1.0})
    names = job.dispersions.names
    assert {"panel_*.stiffness", "joint_*.mass", "panel_*.com.x", "q_b"} < set(names)
    assert len(names) == 1 + 1 + 3 + 3 + 1 + 1
    rows = job.dispersions.drawn(0, 4)
    assert len(np.unique(rows[:, names.index("joint_*.mass")])) == 4
    for row in rows:
        value = dict(zip(names, row, strict=True))
        plant, _, q, _ = job.dispersions.one(row)
        factor = 1.0 + value["panel_*.stiffness"]
        left, right = (
            plant.robot.stiffness[f"panel_{side}"] for side in ("left", "right")
        )
        assert (left, right) == pytest.approx((factor * 60.0, factor * 80.0))
        x = fflin.StateMap(robot).to_state(q, np.zeros(robot.nv))
        assert x[:3] == pytest.approx([value["q_b"]] * 3)
        for i, body in enumerate(plant.robot.model.names):
            before, after = robot.model.inertias[i], plant.robot.model.inertias[i]
            if body.startswith("joint_"):
                assert after.mass == pytest.approx(
                    before.mass * (1.0 + value["joint_*.mass"])
                )
            if body.startswith("panel_"):
                shift = [value[f"panel_*.com.{axis}"] for axis in "xyz"]
                assert after.lever - before.lever == pytest.approx(shift)
    # The draws of what is not tied stay those that they are alone.
    alone = CampaignJob(
        robot, None, {"joint_2.com": 0.01}, 0, "python", {"duration": 1.0}
    )
    same = [names.index(name) for name in alone.dispersions.names]
    assert (alone.dispersions.drawn(0, 4) == rows[:, same]).all()


def test_a_tied_density_is_of_all_its_links():
    robot = fflin.load("planar_detumble")
    result = drawn(robot, {"link_*.density": {"range": [0.3], "tied": True}})
    same_bodies(result, drawn(robot, {"link_*.density": [0.3]}))
    with pytest.raises(fflin.InputError, match="disperse the same mass"):
        drawn(
            robot, {"link_*.density": {"range": 0.3, "tied": True}, "joint_1.mass": 0.1}
        )


def test_a_body_of_one_link_has_the_name_of_its_joint_too():
    robot = fflin.load("servicer_7dof")
    for part in ("density", "mass"):
        by_link, by_joint = (
            {f"{source}_3.{part}": [0.3]} for source in ("link", "joint")
        )
        same_bodies(drawn(robot, by_link), drawn(robot, by_joint))
        with pytest.raises(fflin.InputError, match=r"'link_3'.*'joint_3'.*only once"):
            drawn(robot, by_link | by_joint)


@pytest.mark.parametrize("name", ["servicer_7dof", "planar_detumble", "inspector.toml"])
def test_a_mass_leaves_the_inertia_about_the_centre_as_in_uncertain_robots(name):
    robot = fflin.load(name)
    links = [name for name, piece in robot.pieces.items() if not piece.whole][:4]
    uncertain = fflin.uncertain(robot, {f"{link}.mass": 0.5 for link in links})
    values = {
        range.parameter.name: 1.3 * range.parameter.value for range in uncertain.ranges
    }
    result = drawn(robot, {f"{link}.mass": [0.3] for link in links})
    same_bodies(result, uncertain.at(values))
    assert result.mass > robot.mass
    one = next(x for n, x in robot.pieces.items() if n == links[0])
    alone = drawn(robot, {f"{links[0]}.mass": [0.3]}).model.inertias[one.joint]
    if len([x for x in robot.pieces.values() if x.joint == one.joint]) == 1:
        assert np.allclose(
            alone.inertia, robot.model.inertias[one.joint].inertia, rtol=1e-12
        )
        if robot.wheels:  # the carrier counts them, and they stay as they are
            return
        denser = drawn(robot, {f"{links[0]}.density": [0.3]}).model.inertias[one.joint]
        assert np.allclose(denser.inertia, 1.3 * alone.inertia, rtol=1e-12)


def test_the_root_link_has_two_names_everywhere(tmp_path):
    (tmp_path / "bus.urdf").write_text(
        bundled_directory()
        .joinpath("ets_vii.urdf")
        .read_text()
        .replace('"base"', '"bus"')
    )
    robot = fflin.load(tmp_path / "bus.urdf")
    assert robot.link_of["base"] == "bus"
    S = fflin.sensitivity(fflin.linearize(robot))
    for part in ("mass", "com.x", "inertia.xx", "density"):
        assert S[f"bus.{part}"].name == S[f"base.{part}"].name == f"bus.{part}"
    for part, value in {
        "mass": 0.3,
        "density": 0.3,
        "com": 0.02,
        "inertia": 0.1,
    }.items():
        changed = (
            drawn(robot, {f"{name}.{part}": [value]}) for name in ("bus", "base")
        )
        same_bodies(*changed)
    ranges = ({f"{name}.mass": 0.2} for name in ("bus", "base"))
    one, two = (
        fflin.uncertain(robot, range).at({"bus.mass": 3000.0}) for range in ranges
    )
    same_bodies(one, two)


def test_a_pattern_means_the_links_and_not_the_bodies_that_they_form_too():
    robot = fflin.load("planar_detumble")
    links = {f"{link}.mass" for link in robot.links}
    assert {
        range.parameter.name for range in fflin.uncertain(robot, {"*.mass": 0.1}).ranges
    } == links
    job = CampaignJob(robot, None, {"*.mass": 0.1}, 0, "python", {"duration": 1.0})
    assert set(job.dispersions.names) == links
    S = fflin.sensitivity(fflin.linearize(robot))
    total = sum(S[name].dB for name in links)
    assert np.allclose(S.along({"*.mass": 1.0}).dB, total, rtol=1e-12)
    body = next(name for name, piece in robot.pieces.items() if piece.whole)
    both_of = {"*.mass": 0.1, f"{body}.mass": 0.2}
    names = CampaignJob(
        robot, None, both_of, 0, "python", {"duration": 1.0}
    ).dispersions.names
    on = {
        f"{n}.mass"
        for n, x in robot.pieces.items()
        if x.joint == robot.pieces[body].joint
    }
    assert set(names) == links - on | {f"{body}.mass"}
    link = next(name for name in robot.links if f"{name}.mass" in on)
    with pytest.raises(fflin.InputError, match="disperse the same mass"):
        drawn(robot, {f"{body}.mass": 0.1, f"{link}.density": 0.1})


@pytest.mark.compiled
def test_lanes_and_patterns():
    robot = fflin.load("planar_detumble")
    campaign = both(robot, None, {"*.density": 0.1, "joint_1.com": 0.1, "qdot_m": 0.1})
    assert len(campaign["q"]) == 3
    job = CampaignJob(robot, None, {"*.density": 0.1}, 0, "python", {"duration": 1.0})
    names = job.dispersions.names
    assert "target.density" in names and "joint_3.density" not in names
    assert len(names) == len(robot.links)


def test_errors_are_one_line():
    robot = fflin.load("servicer_7dof")
    both_of = {"link_3.density": 0.1, "joint_3.mass": 0.1}
    with pytest.raises(fflin.InputError, match=r"'joint_3\.mass'.*'link_3\.density'"):
        drawn(robot, both_of)
    with pytest.raises(fflin.InputError, match="-1"):
        fflin.monte_carlo(
            robot, None, {"link_3.density": [-1.0]}, runs=1, duration=0.1, dt=0.1
        )
    with pytest.raises(fflin.UnknownNameError, match="link_3"):
        drawn(robot, {"link_33.density": 0.1})
