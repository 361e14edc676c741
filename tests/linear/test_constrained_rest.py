"""Fast models of constrained robots at rest are equal to the general equations."""

import pickle
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.constrained import parallelogram, random_constraints

ARRAYS = ("A", "B", "C", "D", "f0", "x0", "y0", "u0", "v", "placement", "M")


def general(robot, q, **options):
    """The same model by the general equations, with zero velocities given explicitly."""
    return fflin.linearize(robot, q, np.zeros(robot.nv), **options)


def closed_points(robot, q, rng, count):
    """Closed configurations near q."""
    for _ in range(count):
        step = 0.2 * rng.normal(size=robot.nv)
        yield fflin.closed(robot, pin.integrate(robot.model, q, step))


def assert_equal(model, expected):
    for key in ARRAYS:
        value = getattr(expected, key)
        size = np.abs(value).max(initial=1.0)
        np.testing.assert_allclose(getattr(model, key), value, atol=1e-11 * size)
    for key in ("state_names", "state_units", "dependent", "rank", "independent"):
        assert getattr(model, key) == getattr(expected, key)


@pytest.mark.parametrize("frame", ["hybrid", "local"])
@pytest.mark.parametrize("seed", [0, 3, 5, 8])
def test_models_at_rest_are_equal_to_the_general_equations(seed, frame):
    rng = np.random.default_rng(seed)
    robot, q, _, _ = random_constraints(rng, count=1, loads=False)
    linearizer = fflin.Linearizer(robot, frame=frame)
    first = linearizer(q)
    fast = 0
    for point in closed_points(robot, q, rng, 3):
        model = linearizer(point)
        fast += linearizer._rest.model(point.copy()) is not None
        expected = general(robot, point, frame=frame, independent=first.independent)
        assert_equal(model, expected)
    rows = sum(len(item.rows) for item in robot.constraints)
    assert (fast > 0) == (rows == first.rank)


@pytest.mark.parametrize("options", [{}, {"moving": True}, {"frame": "local"}])
@pytest.mark.parametrize("seed", [0, 3, 5, 8])
def test_models_in_motion_do_not_depend_on_the_points_before(seed, options):
    """Only at later points, the independent coordinates give the tangent space."""
    rng = np.random.default_rng(seed)
    robot, q, _, _ = random_constraints(rng, count=1, loads=True)
    linearizer = fflin.Linearizer(robot, **options)
    first = linearizer(q)
    regular = 0
    for near in closed_points(robot, q, rng, 3):
        point, v = fflin.closed(robot, near, rng.normal(size=robot.nv))
        u = rng.normal(size=first.B.shape[1])
        model = linearizer(point, v, u)
        regular += linearizer._closure.tangent(point).partitioned
        chosen = {**options, "independent": first.independent}
        expected = fflin.linearize(robot, point, v, u, **chosen)
        assert_equal(model, expected)
    rows = sum(len(item.rows) for item in robot.constraints)
    assert (regular > 0) == (rows == first.rank)


def test_other_inputs_act_through_the_same_equations():
    rng = np.random.default_rng(3)
    robot, q, _, _ = random_constraints(rng, count=1, loads=False)
    inputs = [fflin.BaseTorque(), fflin.JointTorque("joint_8")]
    robot = robot.replace(inputs=inputs)
    linearizer = fflin.Linearizer(robot)
    first = linearizer(q)
    for point in closed_points(robot, q, rng, 2):
        expected = general(robot, point, independent=first.independent)
        assert_equal(linearizer(point), expected)


def test_copies_keep_all_fields():
    rng = np.random.default_rng(3)
    robot, q, _, _ = random_constraints(rng, count=1, loads=False)
    linearizer = fflin.Linearizer(robot)
    linearizer(q)
    model = linearizer(q)
    for copied in (replace(model), pickle.loads(pickle.dumps(model))):
        assert_equal(copied, model)
        np.testing.assert_array_equal(copied._all_states, model._all_states)
    assert (
        fflin.modes(model).frequencies.shape
        == fflin.modes(linearizer(q)).frequencies.shape
    )


def test_an_open_point_and_a_singular_posture_are_refused_as_before():
    robot = parallelogram(0.6, 1.5, 0.8, 1.1, gravity=0.0)
    linearizer = fflin.Linearizer(robot, independent=["left"])
    bent = {"left": 0.4, "bar": -0.4, "right": 0.4}
    linearizer(fflin.closed(robot, fflin.configuration(robot, bent)))
    with pytest.raises(fflin.ConstraintError, match="bar_end/right_end"):
        linearizer(fflin.configuration(robot, bent | {"left": 0.5}))
    flat = {"left": np.pi / 2, "bar": -np.pi / 2, "right": np.pi / 2}
    with pytest.raises(fflin.ConstraintError, match="singular posture"):
        linearizer(fflin.configuration(robot, flat))
