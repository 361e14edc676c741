"""Batches in the coordinates of other tools, against the conversion of each model."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.batch import tool_batch
from tests.support.robots import BUNDLED

TOOLS = ("drake", "mujoco", "pinocchio", "crocoddyl", "spart", "euler", "euler_rates")
FIELDS = ("A", "B", "f0", "x0", "u0", "q", "v", "T", "T_left", "T_u")


def agree(batch, tool, **options):
    """Assert that a batch is converted as each of its models is."""
    together = batch.to(tool, **options)
    for i, lin in enumerate(batch):
        alone = lin.to(tool, **options)
        for name in FIELDS:
            expected = getattr(alone, name)
            size = 1.0 + np.abs(expected).max()
            assert getattr(together, name)[i] == pytest.approx(
                expected, abs=1e-12 * size
            ), name
        assert together.state_names == alone.state_names
        assert together.input_names == alone.input_names
        assert (together.dt, together.reference) == (alone.dt, alone.reference)
    return together


@pytest.mark.parametrize("tool", TOOLS)
def test_moving_points_are_converted_as_one_at_a_time(tool):
    robot = fflin.load("planar_detumble")
    rng = np.random.default_rng(2)
    points = fflin.random_configurations(robot, 6, seed=1)
    u = rng.normal(size=(6, 9))
    agree(fflin.sweep(robot, points, 0.3 * rng.normal(size=(6, 9)), u), tool)


@pytest.mark.parametrize("name", BUNDLED)
def test_points_at_rest_share_one_change_of_coordinates(name, monkeypatch):
    robot = fflin.load(name)
    joint = robot.joint_names[0] if robot.joint_names else None
    q = np.tile(robot.neutral(), (5, 1))
    if joint:
        q = fflin.grid(robot, {joint: np.linspace(-0.4, 0.4, 5)})
    made = []
    change = tool_batch._Points.change

    def counted(points, rows):
        made.append(len(rows))
        return change(points, rows)

    monkeypatch.setattr(tool_batch._Points, "change", counted)
    agree(fflin.sweep(robot, q), "drake")
    assert made == [5]


@pytest.mark.parametrize("tool", ["crocoddyl", "mujoco"])
def test_a_time_step_gives_the_matrices_of_the_tool(tool):
    robot = fflin.load("ets_vii")
    rng = np.random.default_rng(3)
    points = fflin.random_configurations(robot, 4, seed=2)
    batch = fflin.sweep(
        robot, points, 0.2 * rng.normal(size=(4, robot.nv)), moving=True
    )
    agree(batch, tool, dt=0.01)


@pytest.mark.parametrize("frame", ["world", "hybrid", "local"])
def test_references_and_frames_of_the_base_are_kept(frame):
    robot = fflin.load("ets_vii")
    reference = pin.SE3(pin.rpy.rpyToMatrix(0.3, 0.2, -0.4), np.array([1.0, 2.0, 3.0]))
    near = fflin.sweep(robot, fflin.random_configurations(robot, 4, seed=4)).q.copy()
    for row, angle in zip(near, (0.0, 0.2, 0.2, -0.3), strict=True):
        row[3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(angle, 0.1, 0.0)).coeffs()
    agree(fflin.sweep(robot, near, frame=frame, reference=reference), "drake")


def test_a_batch_without_its_robot_names_the_remedy(tmp_path):
    robot = fflin.load("planar_detumble")
    fflin.sweep(robot, fflin.grid(robot, {"joint_1": [0.0, 0.1]})).save(
        tmp_path / "batch.npz"
    )
    with pytest.raises(fflin.InputError, match="robot"):
        fflin.LinearBatch.load(tmp_path / "batch.npz").to("drake")
    batch = fflin.LinearBatch.load(tmp_path / "batch.npz", robot)
    agree(batch, "drake")
    with pytest.raises(fflin.InputError, match="no points"):
        batch[:0].to("drake")


def test_an_index_gives_the_model_of_one_point():
    robot = fflin.load("planar_detumble")
    batch = fflin.sweep(robot, fflin.grid(robot, {"joint_1": [-0.5, 0.2, 0.9]}))
    converted = batch.to("drake")
    for i, model in enumerate(converted):
        single = batch[i].to("drake")
        for name in ("A", "B", "f0", "x0", "u0", "q", "v", "T", "T_left", "T_u"):
            expected = getattr(single, name)
            assert getattr(model, name) == pytest.approx(expected, abs=1e-12)
        for name in ("state_names", "state_units", "input_names", "input_units"):
            assert getattr(model, name) == getattr(single, name)
        assert model.C.shape == (0, len(model.A)) and not model.output_names
    assert i == 2
    assert (converted[-1].A == converted[np.int64(2)].A).all()
    with pytest.raises(IndexError, match="3 points"):
        converted[3]
    with pytest.raises(fflin.InputError, match="index has type str"):
        converted["first"]


def test_a_tool_is_given_by_its_name():
    lin = fflin.linearize(fflin.load("planar_detumble"))
    with pytest.raises(fflin.InputError, match="type list, expected a name: drake"):
        lin.to(["drake"])
