"""A robot whose model was changed in place makes no results under the old certificate."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin


def heavier(model):
    model.inertias[2] = model.inertias[2] + pin.Inertia(1.0, np.zeros(3), np.eye(3))


def longer(model):
    model.jointPlacements[3].translation[0] += 1e-9


def in_gravity(model):
    model.gravity.linear = np.array([0.0, 0.0, -9.81])


def geared(model):
    model.armature[7] = 0.1


def moved(model):
    model.frames[4].placement = pin.SE3.Random()


CHANGES = [
    (heavier, "inertia .*'joint_1'"),
    (longer, "placement .*'joint_2'"),
    (in_gravity, "gravity"),
    (geared, "armature"),
    (moved, "'link_1'"),
]


@pytest.mark.parametrize(("change", "message"), CHANGES)
def test_a_changed_model_is_refused_wherever_results_are_made(
    change, message, tmp_path
):
    robot = fflin.load("ets_vii")
    linearizer = fflin.Linearizer(robot)
    before = linearizer()
    gain = fflin.lqr(before, 1.0, 1.0)
    change(robot.model)
    after = linearizer()
    q = robot.neutral()
    for result in (
        lambda: fflin.linearize(robot),
        lambda: fflin.Linearizer(robot),
        lambda: fflin.check(robot, before),
        lambda: after.certificate,
        lambda: after.M,
        lambda: after.save(tmp_path / "after.npz"),
        lambda: fflin.sweep(robot, [q]),
        lambda: fflin.simulate(robot, duration=0.1),
        lambda: fflin.validity(robot, before, gain, samples=1),
        lambda: robot.replace(damping=1.0),
    ):
        with pytest.raises(fflin.ModelError, match=f"{message}.*from_model"):
            result()
    assert not list(tmp_path.iterdir())


def test_a_model_of_a_changed_robot_is_refused_by_its_users():
    robot = fflin.load("ets_vii")
    linearizer = fflin.Linearizer(robot)
    batch = fflin.sweep(robot, [robot.neutral()])
    robot.model.inertias[2].mass *= 2.0
    for use in (
        lambda lin: fflin.lqr(lin, 1.0, 1.0),
        lambda lin: fflin.acceleration_lqr(lin, 1.0, 1.0, 1.0),
        lambda lin: fflin.kalman(lin, 1.0, 1.0),
        fflin.momentum_reduction,
        lambda lin: lin.discretize(0.1),
        fflin.LinearModel.to_scipy,
        fflin.LinearModel.to_control,
    ):
        for lin in (linearizer(), batch[0]):
            with pytest.raises(fflin.ModelError, match=r"inertia .*'joint_1'"):
                use(lin)
    with pytest.raises(fflin.ModelError, match=r"inertia .*'joint_1'"):
        fflin.lqr_batch(batch, 1.0, 1.0)


def test_objects_made_from_a_model_keep_the_robot():
    robot = fflin.load("ets_vii", lock=["joint_6"])
    lin = fflin.linearize(robot)
    made = [
        lin.discretize(0.1),
        fflin.momentum_reduction(lin),
        replace(lin, u0=lin.u0 + 1.0),
    ]
    heavier(robot.model)
    for item in made:
        with pytest.raises(fflin.ModelError, match=r"inertia .*'joint_1'"):
            item.to_scipy()


def test_a_replaced_robot_keeps_its_cached_results():
    robot = fflin.load("ets_vii")
    heavier(robot.model)
    with pytest.raises(fflin.ModelError, match=r"inertia .*'joint_1'"):
        fflin.linearize(replace(robot, name="x"))
    fresh = replace(robot, model=robot.model.copy())
    assert fflin.linearize(fresh).certificate.route_B < 1e-9


def test_a_robot_made_of_the_changed_model_works_and_differs():
    robot = fflin.load("ets_vii")
    B = fflin.linearize(robot).B
    heavier(robot.model)
    other = fflin.from_model(robot.model)
    lin = fflin.linearize(other)
    assert fflin.check(other, lin).ok
    assert np.abs(lin.B - B).max() > 1e-6


def test_copies_keep_cached_results():
    robot = fflin.load("ets_vii")
    heavier(robot.model)
    for twin in (pickle.loads(pickle.dumps(robot)), copy.deepcopy(robot)):
        with pytest.raises(fflin.ModelError, match=r"inertia .*'joint_1'"):
            fflin.linearize(twin)


def test_limits_and_new_frames_are_no_change():
    robot = fflin.load("ets_vii")
    B = fflin.linearize(robot).B
    robot.model.upperPositionLimit[7] = 0.5
    frame = pin.Frame("nozzle", 1, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME)
    robot.model.addFrame(frame, False)
    np.testing.assert_array_equal(fflin.linearize(robot).B, B)
    pushed = robot.replace(inputs=[fflin.Thruster("nozzle", (0, 0, 0), (1, 0, 0))])
    assert fflin.check(pushed, fflin.linearize(pushed)).ok


def test_a_limit_that_is_not_a_number_is_not_a_change():
    model = fflin.load("ets_vii").model.copy()
    model.lowerPositionLimit[7] = np.nan
    fflin.linearize(fflin.from_model(model))
