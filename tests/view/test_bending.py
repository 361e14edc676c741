"""Flexible appendages and slosh on the page: links that bend to first order, else balls."""

import base64
import re

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.robot.joints import ROOT
from fflin.view.page import body_poses
from fflin.view.pages import mode_page, panel
from fflin.view.shapes import shapes


def posed(robot, q):
    """Return the placements in the world of the shapes of a robot at q."""
    poses = body_poses(robot, q)
    return [
        pin.XYZQUATToSE3(poses[shape.joint - ROOT]) * shape.placement
        for shape in shapes(robot)[0]
    ]


def test_panels_of_an_array_turn_about_the_frame_at_which_it_is_clamped():
    rigid = fflin.load("inspector", lock=["hinge_*"])
    rotation = np.array([[4.27], [0.0], [0.3]])
    array = fflin.FlexibleAppendage(
        "panel_left_1", 0.25, [[0], [0], [2.71]], rotation, name="left"
    )
    robot = rigid.replace(appendages=[array])
    # At rest nothing is moved.
    before, after = posed(rigid, rigid.neutral()), posed(robot, robot.neutral())
    for one, other in zip(before, after, strict=True):
        assert one.isApprox(other, 1e-12)
    # A single mode turns by its momentum r over its moment of inertia |r|^2.
    amplitude = 0.3
    bent = posed(robot, fflin.configuration(robot, {"left_mode_1": amplitude}))
    frame = robot.model.frames[robot.model.getFrameId("panel_left_1")].placement
    turn = pin.exp3(amplitude * rotation[:, 0] / np.square(rotation).sum())
    moved = [k for k in range(len(after)) if not after[k].isApprox(bent[k], 1e-12)]
    assert moved
    for k in moved:
        expected = frame * pin.SE3(turn, np.zeros(3)) * frame.inverse() * after[k]
        assert bent[k].isApprox(expected, 1e-12)
    # Both panels move, and nothing on the other side.
    sides = np.array([after[k].translation[1] for k in moved])
    assert (sides > 0.0).all() and np.ptp(sides) > 0.5


def test_an_array_without_rotation_moves_along_its_momentum():
    t = np.array([[0.0], [1.0], [2.0]])
    array = fflin.FlexibleAppendage(
        "panel_left_1", 0.25, t, np.zeros((3, 1)), name="left"
    )
    robot = fflin.load("inspector", lock=["hinge_*"], appendages=[array])
    before = posed(robot, robot.neutral())
    after = posed(robot, fflin.configuration(robot, {"left_mode_1": 0.3}))
    moved = [
        (b, a) for b, a in zip(before, after, strict=True) if not a.isApprox(b, 1e-12)
    ]
    assert moved
    frame = robot.model.frames[robot.model.getFrameId("panel_left_1")].placement
    # A mass |t|^2 with the momentum t has moved by t / |t|^2 for a unit of the amplitude.
    shift = frame.rotation @ (0.3 * t[:, 0] / 5.0)
    for b, a in moved:
        assert a.isApprox(pin.SE3(np.eye(3), shift) * b, 1e-12)


@pytest.mark.parametrize("turns", [True, False])
def test_noise_in_place_of_zero_does_not_change_how_an_array_bends(turns):
    t = np.array([[0.0, 0.0], [0.0, 0.0], [2.71, 1.5]])
    r = np.array([[4.27, 0.8], [0.0, 0.0], [0.0, 0.0]]) * turns
    rigid, poses = fflin.load("inspector", lock=["hinge_*"]), []
    for noise in (0.0, 1e-13):
        rng = np.random.default_rng(1)
        parts = (x + noise * rng.normal(size=(3, 2)) for x in (t, r))
        array = fflin.FlexibleAppendage(
            "panel_left_1", [0.25, 1.1], *parts, name="left"
        )
        robot = rigid.replace(appendages=[array])
        moved = fflin.configuration(robot, {"left_mode_1": 0.3, "left_mode_2": -0.1})
        poses.append(posed(robot, moved))
    for one, other in zip(*poses, strict=True):
        assert one.isApprox(other, 1e-10)


def test_appendages_of_the_root_link_and_slosh_are_balls():
    boom = fflin.FlexibleAppendage(
        "base", 0.3, [[2], [0], [0]], [[0], [6], [0]], name="boom"
    )
    noise = [[1e-13], [2e-13], [0]]  # in place of zero
    twist = fflin.FlexibleAppendage("base", 0.3, noise, [[0], [0], [1]], name="twist")
    tank = fflin.Slosh("base", 20.0, (0.0, 0.2, 0.1), frequency=0.2, name="tank")
    rigid = fflin.load("inspector", lock=["*"])
    robot = rigid.replace(appendages=[boom, twist, tank])
    drawn = shapes(robot)[0][len(shapes(rigid)[0]) :]
    assert [shape.kind for shape in drawn] == ["sphere", "box", "sphere"]
    q = fflin.configuration(
        robot, {"boom_mode_1": 0.1, "twist_mode_1": 0.2, "tank_x": 0.05}
    )
    at_rest, moved = posed(robot, robot.neutral())[-3:], posed(robot, q)[-3:]
    # The boom's mass is at r / t = 3 m, and moves by 1 / t for a unit of the amplitude.
    assert at_rest[0].translation == pytest.approx([0.0, 0.0, 3.0])
    assert (moved[0].translation - at_rest[0].translation)[0] == pytest.approx(
        0.05, rel=1e-3
    )
    assert at_rest[1].translation == pytest.approx([0.0, 0.0, 0.0])
    assert pin.log3(moved[1].rotation) == pytest.approx([0.0, 0.0, 0.2])
    assert at_rest[2].translation == pytest.approx(tank.position)
    assert moved[2].translation - at_rest[2].translation == pytest.approx(
        [0.05, 0.0, 0.0]
    )


def test_the_page_of_modes_plays_the_arrays():
    robot = fflin.load("inspector_flexible.toml", lock=["arm_*"])
    result = fflin.modes(fflin.linearize(robot))
    html, notes = mode_page(robot, result, "space", None)
    assert not notes
    packed = re.findall(r'"poses":"([^"]+)"', html)
    assert len(packed) == len(result.vibrations)
    arrays = [
        robot.model.getJointId(f"{side}_mode_1") - ROOT for side in ("left", "right")
    ]
    swings = []
    for item in packed[:2]:
        poses = np.frombuffer(base64.b64decode(item), "<f4").reshape(48, -1, 7)
        turns = [
            pin.log3(pin.XYZQUATToSE3(pose.astype(float)).rotation) for pose in poses[0]
        ]
        swings.append([turns[k] - turns[0] for k in arrays])
    assert np.linalg.norm(swings, axis=-1).min() > 0.05  # [rad] relative to the bus
    # The slowest mode bends both arrays towards the same side, the next towards opposite sides.
    assert swings[0][0][0] * swings[0][1][0] < 0.0 < swings[1][0][0] * swings[1][1][0]


def test_the_page_of_a_motion_plots_modal_amplitudes():
    robot = fflin.load("inspector_flexible.toml", lock=["arm_*"])
    q = fflin.configuration(robot, {"left_mode_1": 0.1})
    motion = fflin.simulate(robot, q0=q, duration=2.0, dt=0.1)
    result = panel(robot, motion, np.arange(len(motion.t)), np.zeros((0, robot.nq)))
    chart = next(
        item for item in result["plots"] if item["title"] == "modal amplitudes"
    )
    assert chart["unit"] == "kg^0.5 m"
    assert "left_mode_1" in {line["label"] for line in chart["lines"]}
