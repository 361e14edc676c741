"""Closing of constraints."""

import re

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.closure import Closure, redundancy
from tests.support.constrained import at, parallelogram, random_constraints
from tests.support.marks import exhaustive


def residual(robot, q):
    return np.abs(Closure(fflin.StateMap(robot)).constraints.residual(q)).max()


def test_the_closed_configuration_is_the_nearest_one():
    """No closed configuration beside it is nearer, in displacements weighted by inertia."""
    robot = parallelogram(0.6, 1.5, 0.8, 1.1)
    start = fflin.configuration(robot, {"left": 0.5, "bar": -0.2, "right": 0.3})
    q = fflin.closed(robot, start)
    assert residual(robot, q) < 1e-12
    state = fflin.StateMap(robot)
    M = state.project(pin.crba(robot.model, robot.create_data(), start).T)
    weights = M.diagonal()

    def distance(other):
        apart = state.velocities(pin.difference(robot.model, start, other))
        return weights @ apart**2

    basis = Closure(state).tangent(q).basis
    for step in (1e-3, -1e-3):
        beside = pin.integrate(robot.model, q, state.spread(step * basis[:, 0]))
        beside = Closure(state).nearest(beside)
        assert distance(beside) > distance(q)


def test_joints_stay_within_their_limits():
    robot = fflin.load(
        "dual_arm", constraints=[fflin.Spherical("tool_left", "tool_right")]
    )
    bent = {"left_1": 0.9, "right_1": -0.9, "left_2": 0.7, "right_2": -0.7}
    open_q = fflin.configuration(robot, bent)
    robot = fflin.load(
        "dual_arm",
        constraints=[fflin.Spherical("tool_left", "tool_right", placement=at())],
    )
    q = fflin.closed(robot, open_q)
    assert residual(robot, q) < 1e-11
    for joint in robot.joints:
        low = robot.model.lowerPositionLimit[joint.idx_q]
        high = robot.model.upperPositionLimit[joint.idx_q]
        assert low - 1e-12 <= joint.value(q) <= high + 1e-12


def test_a_constraint_out_of_reach_is_named_with_the_distance_left():
    far = fflin.Spherical("tool_left", "base", placement=at(x=50.0), name="anchor")
    robot = fflin.load("dual_arm", constraints=[far])
    with pytest.raises(fflin.ConstraintError, match=r"off constraint 'anchor' by 4\d"):
        fflin.closed(robot, robot.neutral())


def test_a_robot_without_constraints_has_nothing_to_close():
    robot = fflin.load("cubesat")
    with pytest.raises(fflin.InputError, match="has no constraints"):
        fflin.closed(robot, robot.neutral())


def test_a_constraint_that_nothing_moves_is_refused():
    robot = fflin.load("planar_detumble")
    model = robot.model.copy()
    joint = model.getJointId("joint_1")
    placement = model.jointPlacements[joint]
    parent = model.getFrameId("base")
    kind = pin.FrameType.OP_FRAME
    model.addFrame(pin.Frame("socket", 1, parent, placement, kind))
    model.addFrame(pin.Frame("ball", joint, parent, at(), kind))
    on_axis = fflin.Spherical("ball", "socket", name="pivot")
    robot = fflin.from_model(model, constraints=[on_axis])
    with pytest.raises(fflin.ConstraintError, match="constraints pivot have no effect"):
        fflin.linearize(robot)


def test_redundant_rows_are_counted_and_named():
    robot = parallelogram(0.6, 1.5, 0.8, 1.1)
    robot = robot.replace(constraints=robot.constraints)
    count = redundancy(robot, robot.neutral())
    assert (count.rows, count.rank, count.free) == (11, 8, 1)
    assert count.redundant == ("bar_end/right_end",)
    assert "3 redundant rows in bar_end/right_end" in str(count)


def test_the_velocity_nearest_in_kinetic_energy_conserves_momentum_of_a_loop():
    robot = fflin.load("dual_arm", constraints=[fflin.Weld("tool_left", "tool_right")])
    v = np.random.default_rng(1).normal(size=robot.nv)
    q, after = fflin.closed(robot, robot.neutral(), v)
    data = robot.create_data()
    before = pin.computeCentroidalMomentum(robot.model, data, q, v).vector.copy()
    change = pin.computeCentroidalMomentum(robot.model, data, q, after).vector - before
    np.testing.assert_allclose(change, 0.0, atol=1e-11 * np.abs(before).max())


def test_a_velocity_on_the_manifold_is_not_corrected_again():
    robot = fflin.load("dual_arm", constraints=[fflin.Weld("tool_left", "tool_right")])
    closure = Closure(fflin.StateMap(robot))
    rng = np.random.default_rng(2)
    for _ in range(5):
        q, v = fflin.closed(robot, robot.neutral(), rng.normal(size=robot.nv))
        np.testing.assert_array_equal(closure.velocity(q, v), v)


def test_two_constraints_of_the_same_name_are_refused():
    twice = [fflin.Weld("tool_left"), fflin.Weld("tool_left")]
    with pytest.raises(fflin.InputError, match="two constraints are named 'tool_left'"):
        fflin.load("dual_arm", constraints=twice)


def test_two_frames_of_one_body_are_refused():
    model = fflin.load("cubesat").model.copy()
    kind = pin.FrameType.OP_FRAME
    model.addFrame(pin.Frame("corner", 1, model.getFrameId("base"), at(x=0.1), kind))
    with pytest.raises(fflin.InputError, match="connects two frames of the same body"):
        fflin.from_model(model, constraints=[fflin.Weld("corner", "base")])


def test_inertial_space_is_refused_in_orbit():
    with pytest.raises(fflin.InputError, match="is in orbit"):
        fflin.load("cubesat", constraints=[fflin.Weld("base")], orbit=500e3)


@pytest.mark.parametrize(
    ("item", "message"),
    [
        (lambda: fflin.Weld("a", "a"), "connects frame 'a' to itself"),
        (lambda: fflin.Weld(""), "frame of a constraint is '', expected a name"),
        (lambda: fflin.Hinge("a", axis=(0, 0, 0)), "is zero; give a direction"),
        (lambda: fflin.Weld("a", placement=3), "placement of constraint 'a'"),
        (
            lambda: fflin.load("cubesat", constraints="weld"),
            "expected a list of Weld, Hinge and Spherical",
        ),
        (
            lambda: fflin.load("cubesat", outputs=[fflin.ConstraintForce("clamp")]),
            "no constraint named 'clamp'",
        ),
        (
            lambda: fflin.ConstraintForce("clamp", 3),
            'components is 3, expected names such as ["force.x"]',
        ),
    ],
)
def test_a_wrong_value_is_refused(item, message):
    with pytest.raises(fflin.FflinError, match=re.escape(message)):
        item()


def test_constraints_of_a_robot_file_are_read(tmp_path):
    path = tmp_path / "arms.toml"
    path.write_text(
        """
urdf = "dual_arm"
outputs = ["force:grasp"]
[[constraint]]
type = "weld"
frame = "tool_left"
to = "tool_right"
name = "grasp"
position = [0.1, 0.0, 0.0]
rpy = [0.0, 0.0, 90.0]
[[constraint]]
type = "hinge"
frame = "base"
axis = [1, 0, 0]
"""
    )
    robot = fflin.load(path)
    grasp, hinge = robot.constraints
    assert isinstance(grasp, fflin.Weld)
    assert isinstance(hinge, fflin.Hinge)
    assert (grasp.title, hinge.title, hinge.to) == ("grasp", "base", None)
    np.testing.assert_allclose(grasp.placement.translation, (0.1, 0.0, 0.0))
    turned = pin.rpy.rpyToMatrix(0.0, 0.0, np.pi / 2.0)
    np.testing.assert_allclose(grasp.placement.rotation, turned, atol=1e-15)
    assert hinge.axis == (1.0, 0.0, 0.0)
    assert hinge.placement is None


@pytest.mark.parametrize("seed", exhaustive(*range(200, 212)))
def test_random_constraints_are_closed_again_after_a_displacement(seed):
    rng = np.random.default_rng(seed)
    robot, q, *_ = random_constraints(rng, count=1 + seed % 3)
    moved = pin.integrate(robot.model, q, 0.05 * rng.normal(size=robot.nv))
    assert residual(robot, fflin.closed(robot, moved)) < 1e-11
