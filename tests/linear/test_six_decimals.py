"""Rotations as most logs and files have them, with six decimals: read and normalised everywhere."""

import json

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.robot.joints import ROOT
from tests.support.robots import LINKS, MIMIC, random_pose

# Rounding to six decimals moves an entry by 5e-7, so a unit quaternion by at most 1e-6. It turns
# by at most twice this angle. A rotation matrix turns by less, as it has nine entries for it.
TURN = 2.1e-6
# Sums of three products of entries that are each some eps wrong.
ROUND_OFF = 16.0 * np.finfo(float).eps
TOLERANCE = 1e-5  # of lengths, as the docstring of `Robot.checked_configuration` has it


def rounded(rng, count):
    """Unit quaternions (count, 4), and the same with six decimals."""
    exact = rng.normal(size=(count, 4))
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    return exact, np.round(exact, 6)


def angle(R, S):
    return np.linalg.norm(pin.log3(R.T @ S))


def test_a_trajectory_takes_every_quaternion_of_six_decimals(robots):
    robot = robots["cubesat"]
    exact, given = rounded(np.random.default_rng(0), 500)
    q = np.column_stack((np.zeros((500, 3)), given))
    nothing = np.zeros((500, 6))
    result = fflin.Trajectory(robot, np.arange(500.0), q, nothing, nothing[1:]).q[:, 3:]
    normalised = given / np.linalg.norm(given, axis=1, keepdims=True)
    np.testing.assert_allclose(result, normalised, rtol=0, atol=3e-16)
    np.testing.assert_allclose(result, exact, rtol=0, atol=TURN / 2.0)


def test_a_length_within_the_tolerance_is_normalised_and_another_is_refused(robots):
    robot = robots["ets_vii"]  # its solar arrays turn without end
    joint = next(joint for joint in robot.joints if joint.unbounded)
    exact = robot.neutral()
    exact[3:7] = 0.1, -0.7, 0.5, 0.5
    exact[3:7] /= np.linalg.norm(exact[3:7])
    for part in (slice(3, 7), slice(joint.idx_q, joint.idx_q + 2)):
        for sign in (1.0, -1.0):
            near, far = exact.copy(), exact.copy()
            near[part] *= 1.0 + 0.99 * sign * TOLERANCE
            far[part] *= 1.0 + 1.01 * sign * TOLERANCE
            taken = robot.checked_configuration(near)
            np.testing.assert_allclose(taken, exact, rtol=0, atol=1e-15)
            assert np.array_equal(fflin.sweep(robot, near[None]).q[0], taken)
            with pytest.raises(
                fflin.InputError, match=r"has length (0\.99998|1\.00001)"
            ):
                robot.checked_configuration(far)


@pytest.mark.parametrize("tool", ["drake", "mujoco", "pinocchio"])
def test_other_tools_give_quaternions_of_six_decimals(robots, tool):
    robot = robots["planar_detumble"]
    for seed in range(20):
        pose = random_pose(np.random.default_rng(seed), 150.0)
        lin = fflin.linearize(robot, fflin.configuration(robot, {}, pose))
        back = fflin.from_tool(robot, tool, np.round(lin.to(tool).q, 6))
        result = pin.XYZQUATToSE3(back.q[:7]).rotation
        np.testing.assert_allclose(result.T @ result, np.eye(3), rtol=0, atol=ROUND_OFF)
        assert angle(result, pose.rotation) < TURN


def test_rotation_matrices_of_six_decimals_are_normalised(robots):
    robot = robots["planar_detumble"]
    for seed in range(100):
        R = random_pose(np.random.default_rng(seed), 150.0).rotation
        reference = pin.SE3(np.round(R, 6), np.zeros(3))
        state = fflin.StateMap(robot, reference=reference)
        result = state.origin.rotation.T
        np.testing.assert_allclose(result.T @ result, np.eye(3), rtol=0, atol=ROUND_OFF)
        assert angle(result, R) < TURN
    far = pin.SE3(R * (1.0 + 1.01 * TOLERANCE), np.zeros(3))
    with pytest.raises(fflin.InputError, match="not a rotation matrix"):
        fflin.StateMap(robot, reference=far)


def test_placements_of_a_model_with_six_decimals_become_rotations():
    model = pin.buildSampleModelHumanoidRandom()
    rough = model.copy()
    for index in range(ROOT, model.njoints):
        R = random_pose(np.random.default_rng(index), 90.0).rotation
        model.jointPlacements[index].rotation = R
        rough.jointPlacements[index].rotation = np.round(R, 6)
    rough.addFrame(
        pin.Frame("eye", ROOT, 0, rough.jointPlacements[2], pin.FrameType.OP_FRAME)
    )
    before = rough.copy()
    robot = fflin.from_model(rough)
    assert rough == before  # the model of the caller stays as it is
    result = [*robot.model.jointPlacements, robot.model.frames[-1].placement]
    exact = [*model.jointPlacements, model.jointPlacements[2]]
    for default, placement in zip(result, exact, strict=True):
        R = default.rotation
        np.testing.assert_allclose(R.T @ R, np.eye(3), rtol=0, atol=ROUND_OFF)
        assert angle(R, placement.rotation) < TURN


def test_mimic_joints_with_six_decimals_follow(tmp_path):
    path = tmp_path / "gripper.urdf"
    mimic = '<mimic joint="b" multiplier="-1.7" offset=".3"/>'
    kinds = {"a": "revolute", "b": "revolute", "parent": "base"}
    path.write_text(MIMIC.format(links=LINKS, mimic=mimic, **kinds))
    robot = fflin.load(path)
    for position in np.linspace(-1.0, 1.0, 101) / np.pi:
        exact = fflin.configuration(robot, {"b": position})
        result = robot.checked_configuration(np.round(exact, 6))
        np.testing.assert_allclose(result, exact, rtol=0, atol=1.7e-6)
        v = fflin.velocity(robot, {"b": position})
        robot.checked_velocity(np.round(v, 6))


def test_poses_in_files_of_other_programs_are_normalised(robots, tmp_path):
    robot, rng = robots["cubesat"], np.random.default_rng(5)
    q = fflin.configuration(robot, {}, random_pose(rng, 100.0))
    lin = fflin.linearize(robot, q)
    gain = fflin.lqr(lin)
    for made in (gain, lin):
        path = tmp_path / "made.json"
        made.save(path)
        text = json.loads(path.read_text())
        del text["sha256"]
        key = "placement" if "placement" in text else "reference"
        text[key] = np.round(text[key], 6).tolist()
        path.write_text(json.dumps(text))
        read = type(made).load(path)
        assert np.linalg.norm(read.placement[3:]) == pytest.approx(
            1.0, rel=0, abs=3e-16
        )
        np.testing.assert_allclose(read.placement, lin.placement, rtol=0, atol=1.1e-6)
        text[key] = (1.1 * np.array(text[key])).tolist()
        path.write_text(json.dumps(text))
        with pytest.raises(fflin.FileError, match="unit quaternion"):
            type(made).load(path)


def test_the_reference_of_a_trajectory_file_is_normalised_or_refused(robots, tmp_path):
    robot, rng = robots["cubesat"], np.random.default_rng(6)
    exact = pin.SE3ToXYZQUAT(random_pose(rng, 100.0))
    path, x = tmp_path / "path.json", np.zeros((2, 12))
    x[:, :6] = 0.1
    given = {"t": [0.0, 1.0], "x": x.tolist(), "u": np.zeros((1, 6)).tolist()}
    for factor in (1.0, 2.0):
        placement = factor * np.round(exact, 6)
        path.write_text(json.dumps(given | {"placement": placement.tolist()}))
        if factor == 1.0:
            result = fflin.Trajectory.load(path, robot).q[0]
            expected = fflin.StateMap(
                robot, reference=pin.XYZQUATToSE3(exact)
            ).to_pinocchio(x[0])
            np.testing.assert_allclose(result, expected[0], rtol=0, atol=TURN)
        else:
            with pytest.raises(fflin.InputError, match=r"placement.* has length 2"):
                fflin.Trajectory.load(path, robot)
