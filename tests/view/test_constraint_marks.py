"""Marks of constraints on the page, and arrows of their forces."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.view.constraints import constraint_marks, reactions
from fflin.view.page import Page
from tests.support.robots import free_body


def latched_motion():
    """Return a servicer whose tools are latched after 0.4 s, and released after 0.8 s."""
    robot = fflin.load("dual_arm")
    bent = {"left_1": 0.4, "left_2": 0.7, "right_1": -0.3, "right_2": -0.6}
    q0 = fflin.configuration(robot, bent)
    v0 = fflin.velocity(robot, {"left_1": 0.05, "omega_b.z": 0.1})
    how = {"dt": 0.1, "engine": "python", "duration": 0.4}
    drift = fflin.simulate(robot, q0=q0, v0=v0, **how)
    grip = fflin.Weld("tool_left", "tool_right", name="grip")
    impact = fflin.latch(robot, grip, q=drift.q[-1], v=drift.v[-1])
    held = fflin.simulate(impact.robot, q0=impact.q, v0=impact.v, **how)
    opened = fflin.simulate(robot, q0=held.q[-1], v0=held.v[-1], **how)
    return robot, held, drift.then(impact, held, opened)


def test_each_kind_is_marked_at_its_frame():
    hinge = fflin.Hinge("link_2", axis=(0, 1, 0))
    robot = fflin.load("planar_detumble", constraints=[fflin.Weld("hand"), hinge])
    q = robot.neutral()
    nodes = Page(robot, q, "space", None, None).nodes
    weld, ring = constraint_marks(robot, nodes, robot.constraints)
    assert (weld["kind"], weld["name"]) == ("weld", "hand")
    assert weld["path"] == ["meshcat", "robot", "joint_3"]
    np.testing.assert_allclose(weld["position"], (0, 0, 0.3), atol=1e-15)
    assert (ring["kind"], ring["path"][-1]) == ("hinge", "joint_2")
    pose = pin.XYZQUATToSE3(np.array([*ring["position"], *ring["quaternion"]]))
    np.testing.assert_allclose(pose.rotation[:, 2], (0, 1, 0), atol=1e-15)


def test_a_constraint_of_a_frame_that_the_robot_lacks_is_marked_at_the_other_frame():
    robot = fflin.load("dual_arm")
    nodes = Page(robot, robot.neutral(), "space", None, None).nodes
    placement = pin.SE3(np.eye(3), np.array((0.1, 0.0, 0.0)))
    items = [
        fflin.Weld("target.handle", "tool_right", placement=placement),
        fflin.Weld("target.handle", name="unknown"),
    ]
    (mark,) = constraint_marks(robot, nodes, items)
    assert mark["path"][-1] == "right_4"
    np.testing.assert_allclose(mark["position"], (0.34, 0, 0), atol=1e-15)


def test_the_force_on_a_held_body_is_its_weight_in_world_axes():
    robot = free_body((3.0, 4.0, 5.0)).replace(
        gravity=(0, 0, -9.81), constraints=[fflin.Spherical("base")]
    )
    q0 = fflin.configuration(robot, rpy=(30, 20, 10))
    motion = fflin.simulate(robot, q0=q0, duration=0.2, dt=0.1, engine="python")
    (reaction,) = reactions(robot, motion, np.arange(len(motion.t)))
    # The base frame is at the centre of mass, so the body does not move.
    expected = np.tile((0, 0, 9.81 * robot.mass), (len(motion.t), 1))
    np.testing.assert_allclose(reaction.force, expected, atol=1e-9 * 9.81 * robot.mass)
    assert reaction.active.all()


def test_a_constraint_is_shown_only_in_its_phase():
    robot, held, motion = latched_motion()
    (reaction,) = reactions(robot, motion, np.arange(len(motion.t)))
    in_phase = np.arange(len(motion.t)) // len(held.t) == 1
    np.testing.assert_array_equal(reaction.active, in_phase)
    assert not reaction.force[~in_phase].any()
    sizes = np.linalg.norm(held.constraint_forces[:, :3], axis=1)
    np.testing.assert_allclose(
        np.linalg.norm(reaction.force[in_phase], axis=1), sizes, rtol=1e-12
    )
    torques = np.linalg.norm(held.constraint_forces[:, 3:], axis=1)
    shown = np.linalg.norm(reaction.torque, axis=1)
    np.testing.assert_allclose(shown[in_phase], torques, rtol=1e-12)
    assert torques.min() > 0.0 and not shown[~in_phase].any()


def test_the_torque_on_a_held_body_balances_its_weight_in_world_axes():
    robot = free_body((3.0, 4.0, 5.0))
    model = robot.model.copy()
    lever = pin.SE3(pin.rpy.rpyToMatrix(0.3, 0.1, 0.2), np.array([0.4, 0.0, 0.0]))
    model.addFrame(pin.Frame("edge", 1, lever, pin.FrameType.OP_FRAME))
    robot = fflin.from_model(model, name="body")
    weld = fflin.Weld("edge", placement=lever)
    robot = robot.replace(gravity=(0, 0, -9.81), constraints=[weld])
    motion = fflin.simulate(robot, duration=0.2, dt=0.1, engine="python")
    (reaction,) = reactions(robot, motion, np.arange(len(motion.t)))
    # The moment of the weight about the edge is -0.4 m g about y, and the weld balances it.
    expected = np.tile((0, 0.4 * 9.81 * robot.mass, 0), (len(motion.t), 1))
    size = 0.4 * 9.81 * robot.mass
    np.testing.assert_allclose(reaction.torque, expected, atol=1e-9 * size)


@pytest.mark.browser
def test_the_page_shows_the_constraint_and_its_force_while_they_act(watch, tmp_path):
    robot, held, motion = latched_motion()
    path = tmp_path / "motion.html"
    fflin.visualize(robot, motion, html=path, speed=0.2)
    watched = watch(path.as_uri() + "#pause")
    labels = watched.page.locator("#legend label").all_text_contents()
    largest = np.linalg.norm(held.constraint_forces[:, :3], axis=1).max()
    assert "constraint grip" in labels
    (scale,) = [text for text in labels if "force of constraints" in text]
    assert scale == f"force of constraints (longest: {largest:#.2g} N)"
    most = np.linalg.norm(held.constraint_forces[:, 3:], axis=1).max()
    (torques,) = [text for text in labels if "torque of constraints" in text]
    assert torques == f"torque of constraints (longest: {most:#.2g} N m)"
    visible = """(() => {
        const path = ['meshcat', 'robot', 'left_4', 'constraint 0'];
        const mark = viewer.scene_tree.find(path).object.children[0];
        const arrow = viewer.scene_tree.find(['meshcat', 'reactions', '0']).object;
        const couple = viewer.scene_tree.find(['meshcat', 'couples', '0']).object;
        return [mark.visible, arrow.children[0].visible, couple.children[0].visible];
    })()"""
    for time, expected in ((0.2, False), (0.6, True), (1.2, False)):
        watched.do(f"fflin.seek({time})")
        assert watched.do(visible) == [expected] * 3, time


@pytest.mark.browser
def test_a_page_without_a_motion_shows_the_constraints(watch, tmp_path):
    path = tmp_path / "still.html"
    fflin.visualize(fflin.load("scissor_mast"), html=path)
    watched = watch(path.as_uri() + "#pause")
    labels = watched.page.locator("#legend label").all_text_contents()
    assert "constraints foot, knee, head" in labels
