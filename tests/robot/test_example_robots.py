"""Every robot of example-robot-data that can be a free flyer, at rest and moving."""

import numpy as np
import pytest

import fflin
from fflin.robot.catalog import find_robot
from tests.support.robots import FRAMES, mostly, random_point

# What does not give a model at neutral, and why.
REFUSED = {
    "bravo7_gripper": "'bravo_finger1_joint'.*'bravo_finger2_joint'",
    "falcon_bravo7_gripper": "'bravo_finger1_joint'.*'bravo_finger2_joint'",
    "bluevolta_bravo7_gripper": "'bravo_finger1_joint'.*'bravo_finger2_joint'",
    "romeo": "'LHand'.*'RHand'",
    "icub": "'neck_roll'.*'neck_yaw'",
    "alex_psyonic_hands": "'Left_index_q2'",
}
NAMES = [n for n in fflin.list_robots() if find_robot(n).origin == "example-robot-data"]


def test_names_match_the_package():
    from example_robot_data.robots_loader import ROBOTS

    # SDF only, and a robot that its loader makes from the URDF of another.
    assert set(ROBOTS) - set(NAMES) == {"cassie", "talos_legs"}
    with pytest.raises(fflin.UnknownNameError, match="cassie"):
        fflin.load("cassie")


@pytest.mark.parametrize(
    "name", mostly(NAMES, *REFUSED, "panda", "solo12", "tiago_no_hand")
)
def test_check_holds(name):
    if name in REFUSED:
        with pytest.raises(fflin.FflinError, match=REFUSED[name]):
            fflin.linearize(fflin.load(name))
        return
    robot = fflin.load(name)
    assert robot.n == robot.model.nv - 6 - len(robot.followers)
    result = fflin.check(robot, fflin.linearize(robot))
    assert result.ok, result
    rng = np.random.default_rng(1)
    for frame in FRAMES:
        point = random_point(robot, rng, degrees=160.0)
        result = fflin.check(robot, fflin.linearize(robot, *point, frame=frame))
        assert result.ok, result


def test_an_inertia_that_is_negative_only_by_rounding_is_accepted():
    robot = fflin.load("icub", lock=["neck_roll", "neck_yaw"])
    link = robot.links["r_hip_2"]
    assert -1e-18 < np.linalg.eigvalsh(link.inertia)[0] < 0.0 < link.mass
    assert sum(
        item.mass for item in robot.pieces.values() if not item.whole
    ) == pytest.approx(robot.mass)
    model = fflin.uncertain(robot, {"base.mass": 0.1})
    assert model.names == ("base.mass",)
