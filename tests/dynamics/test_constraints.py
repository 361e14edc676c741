"""Residual, Jacobian and bias of constraints, compared with differences of motions."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.constraints import Constraints
from tests.support.robots import random_pose, random_tree

WEIGHTS = (45.0 / 60.0, -9.0 / 60.0, 1.0 / 60.0)
H = 1e-2


def difference(f, h=H):
    """Sixth-order central difference of f(t) at t = 0."""
    pairs = [f(k * h) - f(-k * h) for k in (1, 2, 3)]
    return sum(w * x for w, x in zip(WEIGHTS, pairs, strict=True)) / h


def constrained_tree(rng, kind, to):
    """Return a random tree with one constraint that is closed at a random configuration."""
    tree = random_tree(rng, 6)
    model = tree.model.copy()
    for index in (1, model.njoints - 1):
        model.addJointFrame(index)
    robot = fflin.from_model(model, name=tree.name)
    first, last = model.names[1], model.names[model.njoints - 1]
    axis = {"axis": rng.normal(size=3)} if kind is fflin.Hinge else {}
    item = kind(last, first if to else None, **axis)
    robot = robot.replace(constraints=[item])
    joints = {joint.name: rng.uniform(-1.0, 1.0) for joint in robot.joints}
    q = fflin.configuration(robot, joints, random_pose(rng, 70.0))
    constraints = Constraints(robot)
    constraints.settle(q)
    return robot, constraints, q


CASES = [
    pytest.param(kind, to, id=f"{kind.__name__}-{'loop' if to else 'inertial'}")
    for kind in (fflin.Weld, fflin.Hinge, fflin.Spherical)
    for to in (True, False)
]


@pytest.mark.parametrize(("kind", "to"), CASES)
def test_on_the_manifold_the_jacobian_is_the_derivative_of_the_residual(kind, to):
    rng = np.random.default_rng(3)
    robot, constraints, q = constrained_tree(rng, kind, to)
    assert np.abs(constraints.residual(q)).max() < 1e-14
    J = constraints.jacobian(q)
    for _ in range(3):
        v = rng.normal(size=robot.nv)
        phi = difference(
            lambda t, v=v: constraints.residual(pin.integrate(robot.model, q, t * v))
        )
        # h^6 times the seventh derivative of a product of six sines is below 1e-9
        np.testing.assert_allclose(J @ v, phi, atol=1e-8)


@pytest.mark.parametrize(("kind", "to"), CASES)
def test_the_bias_is_the_rate_of_the_relative_twist(kind, to):
    """J v changes at the rate J a + gamma, on and off the manifold."""
    rng = np.random.default_rng(5)
    robot, constraints, q = constrained_tree(rng, kind, to)
    q = pin.integrate(robot.model, q, 0.1 * rng.normal(size=robot.nv))
    v, a = rng.normal(size=(2, robot.nv))

    def twist(t):
        # The motion with the velocity v + t a, up to an error of the order t^3.
        moved = pin.integrate(robot.model, q, t * v + 0.5 * t**2 * a)
        return constraints.jacobian(moved) @ (v + t * a)

    rate = difference(twist)
    expected = constraints.jacobian(q) @ a + constraints.bias(q, v)
    np.testing.assert_allclose(expected, rate, atol=1e-7)


def along(robot, q, f):
    """Derivative of f(q) with respect to Pinocchio's tangent coordinates of q."""
    return np.array(
        [
            difference(lambda t, e=e: f(pin.integrate(robot.model, q, t * e)))
            for e in np.eye(robot.nv)
        ]
    ).T


@pytest.mark.parametrize(("kind", "to"), CASES)
def test_the_derivatives_of_the_rows_are_differences(kind, to):
    rng = np.random.default_rng(7)
    robot, constraints, q = constrained_tree(rng, kind, to)
    q = pin.integrate(robot.model, q, 0.1 * rng.normal(size=robot.nv))
    v, a = rng.normal(size=(2, robot.nv))

    def rows(q, v):
        return constraints.jacobian(q) @ a + constraints.bias(q, v)

    slopes = constraints.derivatives(q, v, a)
    by_q = along(robot, q, lambda q: rows(q, v))
    np.testing.assert_allclose(slopes.by_q, by_q, atol=1e-7)
    twist_by_q = along(robot, q, lambda q: constraints.jacobian(q) @ v)
    np.testing.assert_allclose(slopes.twist_by_q, twist_by_q, atol=1e-7)
    by_v = [difference(lambda t, e=e: rows(q, v + t * e)) for e in np.eye(robot.nv)]
    np.testing.assert_allclose(slopes.by_v, np.array(by_v).T, atol=1e-9)


@pytest.mark.parametrize(("kind", "to"), CASES)
def test_the_wrenches_and_their_derivative_are_those_of_the_jacobian(kind, to):
    """The generalised force J^T lam varies as RNEA with fixed wrenches, and with their turning."""
    rng = np.random.default_rng(11)
    robot, constraints, q = constrained_tree(rng, kind, to)
    q = pin.integrate(robot.model, q, 0.1 * rng.normal(size=robot.nv))
    forces = rng.normal(size=constraints.count)
    wrenches = constraints.wrenches(q, forces)
    data, still = robot.create_data(), np.zeros(robot.nv)
    force = -pin.rnea(robot.model, data, q, still, still, wrenches)
    np.testing.assert_allclose(constraints.jacobian(q).T @ forces, force, atol=1e-12)
    held = -pin.computeRNEADerivatives(robot.model, data, q, still, still, wrenches)[0]
    expected = along(robot, q, lambda q: constraints.jacobian(q).T @ forces)
    turning = constraints.derivatives(q, still, still, forces).force_by_q
    slopes = held + turning
    np.testing.assert_allclose(slopes, expected, atol=1e-7)


def test_a_missing_placement_is_stored_at_the_first_configuration():
    robot = fflin.load("planar_detumble", constraints=[fflin.Weld("hand")])
    constraints = Constraints(robot)
    with pytest.raises(fflin.InputError, match="no placement yet"):
        constraints.residual(robot.neutral())
    q = fflin.configuration(robot, {"joint_1": 0.3})
    constraints.settle(q)
    hand = robot.model.frames[robot.model.getFrameId("hand")]
    data = robot.create_data()
    pin.forwardKinematics(robot.model, data, q)
    expected = data.oMi[hand.parentJoint] * hand.placement
    assert robot.constraints[0].placement.isApprox(expected, 1e-14)
    assert Constraints(robot.replace(gravity=(0, 0, -1))).residual(q).max() < 1e-14
    assert "weld 'hand': frame 'hand' to inertial space, position (" in str(
        robot.constraints[0]
    )
