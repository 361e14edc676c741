"""What a motion says of where it was steered to, and of its wheels."""

import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.motions import displaced, regulated


def spinning():
    return fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))


@pytest.fixture(scope="module")
def settled():
    _, lin, gain = regulated("ets_vii")
    return lin, fflin.StateFeedback(lin, gain.K)


def test_a_plain_policy_has_no_target_unless_one_is_given(settled):
    lin, feedback = settled
    robot = fflin.load("ets_vii")
    plain = feedback.bind(robot)
    options = {"x0": displaced(lin), "duration": 20.0, "dt": 0.05}
    blind = fflin.simulate(robot, plain, **options)
    assert blind.target.shape == (0,)
    assert blind.error is None and blind.attitude_error is None
    seen = fflin.simulate(robot, feedback, **options)
    for target in (lin, lin.x0):
        messages = fflin.simulate(robot, plain, target=target, **options)
        np.testing.assert_array_equal(messages.target, seen.target)
        np.testing.assert_allclose(
            messages.attitude_error, seen.attitude_error, atol=1e-9
        )
    assert seen.attitude_error[0] == pytest.approx(30.0)
    assert seen.attitude_error[-1] < 1.0
    # What is given goes before the policy's own.
    other = lin.x0 + 0.1 * np.eye(len(lin.x0))[6]
    moved = fflin.simulate(robot, feedback, target=other, **options)
    np.testing.assert_allclose(
        seen.error - moved.error, np.tile(other - lin.x0, (len(moved.t), 1))
    )


def test_a_free_robot_has_no_target():
    motion = fflin.simulate(fflin.load("ets_vii"), duration=0.1)
    assert motion.error is None and motion.target.shape == (0,)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (np.zeros(3), r"\(3,\)"),
        (np.full(30, np.nan), "target"),
        ("start", "target"),
        ({"q": 1}, "target"),
    ],
)
def test_an_invalid_target_is_refused_in_one_line(target, message):
    robot = fflin.load("ets_vii")
    with pytest.raises(fflin.InputError, match=message) as caught:
        fflin.simulate(robot, duration=0.1, target=target)
    assert "\n" not in str(caught.value)


def test_a_model_of_another_robot_is_not_a_target():
    lin = fflin.linearize(fflin.load("planar_detumble"))
    with pytest.raises(fflin.InputError, match="'planar_detumble'"):
        fflin.simulate(fflin.load("ets_vii"), duration=0.1, target=lin)


def test_a_model_in_another_reference_and_frame_is_the_same_target():
    robot = fflin.load("ets_vii")
    turned = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 0.4), np.array([1.0, 2.0, 3.0]))
    q = fflin.configuration(robot, {"joint_1": 0.5}, turned)
    v = 0.1 * np.ones(robot.nv)
    lin = fflin.linearize(robot, q, v, frame="local")
    assert not lin.x0[:6].any()
    motion = fflin.simulate(robot, q0=q, v0=v, duration=0.05, target=lin)
    np.testing.assert_allclose(motion.error[0], 0.0, atol=1e-14)
    assert motion.attitude_error[0] < 1e-6
    assert np.abs(motion.target[:6]).min() > 0.01


def test_a_target_may_differ_from_row_to_row():
    motion = fflin.simulate(fflin.load("ets_vii"), v0=0.1 * np.ones(12), duration=1.0)
    along = replace(motion, target=motion.x + 0.0)
    assert along.error.shape == motion.x.shape and not along.error.any()
    np.testing.assert_allclose(along.attitude_error, 0.0, atol=1e-7)


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".json"])
@pytest.mark.parametrize("steered", [False, True])
def test_wheels_target_and_notes_are_kept_in_files(tmp_path, suffix, steered):
    robot = spinning()
    target = np.arange(len(fflin.StateMap(robot).names)) / 100.0 if steered else None
    motion = fflin.simulate(robot, duration=0.1, target=target)
    assert motion.wheels == tuple(robot.wheels) and len(motion.wheels) == 3
    for wheel in motion.wheels:
        assert {f"q_m.{wheel}", f"qdot_m.{wheel}"} <= set(motion.state_names)
    motion = replace(motion, notes=("one", "two") if steered else ())
    motion.save(tmp_path / f"m{suffix}")
    loaded = fflin.Motion.load(tmp_path / f"m{suffix}")
    assert (loaded.wheels, loaded.notes) == (motion.wheels, motion.notes)
    np.testing.assert_array_equal(loaded.target, motion.target)
    assert loaded.target.ndim == 1


def test_a_page_without_a_target_shows_neither_ghost_nor_errors(tmp_path):
    robot = fflin.load("ets_vii")
    motion = fflin.simulate(robot, v0=np.ones(robot.nv), duration=0.5)
    free, steered = tmp_path / "free.html", tmp_path / "steered.html"
    fflin.visualize(robot, motion, html=free, open=False)
    fflin.visualize(robot, motion, html=steered, open=False, target=robot.neutral())
    for page, expected_value in ((free, False), (steered, True)):
        text = page.read_text()
        assert ('"attitude error"' in text) is expected_value
        assert (
            re.search(r'"target": ?(true|false)', text).group(1) == "true"
        ) is expected_value


@pytest.mark.exhaustive
def test_the_figure_of_a_motion_without_a_target_is_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    motion = fflin.simulate(fflin.load("ets_vii"), duration=0.1)
    motion.plot(tmp_path / "m.png")
    assert (tmp_path / "m.png").stat().st_size > 20_000
