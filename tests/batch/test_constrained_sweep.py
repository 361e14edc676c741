"""Sweeps over robots with constraints: one choice of coordinates, and closed configurations."""

import numpy as np
import pytest

import fflin
from tests.support.constrained import parallelogram
from tests.support.marks import exhaustive

ARRAYS = ("A", "B", "C", "D", "f0", "x0", "y0", "q", "M", "placement")


@pytest.fixture(scope="module")
def robot():
    """Two arms whose tools are welded together."""
    return fflin.load(
        "dual_arm", constraints=[fflin.Weld("tool_left", "tool_right", name="grasp")]
    )


BENT = {"left_1": 0.4, "left_2": 0.6, "right_1": -0.4, "right_2": -0.6}


@pytest.fixture(scope="module")
def start(robot):
    return fflin.closed(robot, fflin.configuration(robot, BENT))


def assert_models(batch, robot, independent, **options):
    for index, model in enumerate(batch):
        expected = fflin.linearize(
            robot, batch.q[index], independent=independent, **options
        )
        for key in ARRAYS:
            value = getattr(expected, key)
            size = np.abs(value).max(initial=1.0)
            np.testing.assert_allclose(getattr(model, key), value, atol=1e-10 * size)
        for key in ("state_names", "dependent", "rank", "independent", "output_names"):
            assert getattr(model, key) == getattr(expected, key)


def test_a_grid_keeps_its_joints_and_closes_the_others(robot, start):
    points = fflin.grid(
        robot,
        {"left_1": [0.3, 0.4, 0.5], "left_2": [0.5, 0.6]},
        joints={"right_1": -0.4, "right_2": -0.6},
    )
    batch = fflin.sweep(robot, points)
    assert len(batch) == 6
    assert batch.residual.max() < 1e-11
    names = batch.joint_names
    assert names == robot.joint_names
    moved = batch.joint_positions[:, [names.index("left_1"), names.index("left_2")]]
    expected = [(a, b) for a in (0.3, 0.4, 0.5) for b in (0.5, 0.6)]
    np.testing.assert_allclose(moved, expected, atol=1e-12)
    assert_models(batch, robot, batch[0].independent)
    nearest = batch.nearest({"left_1": 0.5, "left_2": 0.6})
    np.testing.assert_array_equal(nearest.B, batch[5].B)


@pytest.mark.parametrize("forces", exhaustive({}, {"gravity": (0.0, 0.0, -1.0)}))
def test_random_configurations_are_closed(robot, start, forces):
    loaded = robot.replace(stiffness=3.0, **forces)
    loaded = loaded.replace(outputs=[fflin.ConstraintForce("grasp")])
    ranges = {name: (x - 0.3, x + 0.3) for name, x in BENT.items()}
    ranges |= {"*_3": (-0.3, 0.3), "*_4": (-0.3, 0.3)}
    points = fflin.random_configurations(loaded, 5, ranges=ranges)
    independent = ["q_b", "r_b", "left_1", "right_1"]
    batch = fflin.sweep(loaded, points, independent=independent)
    assert batch.residual.max() < 1e-11
    assert len(np.unique(batch.joint_positions[:, 0])) == 5
    assert batch[0].state_names[6:8] == ("q_m.left_1", "q_m.right_1")
    drawn = points.rows(0, 5)
    plain = loaded.joint("left_1").idx_q
    np.testing.assert_allclose(batch.q[0, plain], drawn[0, plain], atol=1e-12)
    assert_models(batch, loaded, independent)


def test_an_open_row_of_an_array_is_named(robot, start):
    rows = np.array([start, start, start])
    rows[2, 7] += 0.1
    with pytest.raises(fflin.ConstraintError, match=r"configuration 2.*grasp"):
        fflin.sweep(robot, rows)


def test_a_batch_in_a_file_keeps_its_models(robot, start, tmp_path):
    batch = fflin.sweep(robot, start[None], moving=True)
    batch.save(tmp_path / "batch.npz")
    for loaded in (
        fflin.LinearBatch.load(tmp_path / "batch.npz"),
        fflin.LinearBatch.load(tmp_path / "batch.npz", robot),
    ):
        model, expected = loaded[0], batch[0]
        for key in (*ARRAYS, "drift", "_all_states"):
            value = getattr(expected, key)
            np.testing.assert_array_equal(getattr(model, key), value)
        assert model.dependent == expected.dependent
        np.testing.assert_array_equal(loaded.residual, batch.residual)
    gains = fflin.lqr_batch(batch[[0]], 1.0, 1.0)
    np.testing.assert_allclose(gains.K[0], fflin.lqr(batch[0], 1.0, 1.0).K, rtol=1e-9)


def test_redundant_linkages_are_swept():
    """The frequency of a parallelogram of four bars follows from its angle, see `parallelogram`."""
    crank, bar, length = 0.6, 1.5, 0.8
    robot = parallelogram(crank, bar, length, 1.1)
    angles = np.array([-1.0, -0.3, 0.2, 0.9])
    points = fflin.grid(robot, {"left": angles}, joints={"bar": 1.0, "right": -1.0})
    inertia = 2.0 * crank * length**2 / 3.0 + bar * length**2
    weight = (crank + bar) * 9.81 * length
    u = [fflin.effort(robot, {"left": weight * np.sin(x)}) for x in angles]
    batch = fflin.sweep(robot, points, u=u, independent=["left"])
    expected = -weight * np.cos(angles) / inertia
    np.testing.assert_allclose(batch.A[:, 1, 0], expected, rtol=1e-9)


def test_compiled_code_is_refused(robot, start):
    with pytest.raises(fflin.InputError, match="constraints of 'dual_arm'"):
        fflin.sweep(robot, start[None], engine="compiled")
