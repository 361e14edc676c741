"""The constrained solution of the kernel, compared with the equations of motion and Pinocchio."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.constraints import Constraints
from fflin.kernel import bodies, constraints, forward
from fflin.simulation.lanes import mechanics_of
from fflin.simulation.plant import Plant
from tests.dynamics.test_constraints import CASES, constrained_tree
from tests.support.robots import random_tree


def moving(rng, kind, to, gravity=(0.0, 0.0, -9.0)):
    """Return the plant of a random tree with a constraint, and its q, v and u in motion."""
    robot, _, q = constrained_tree(rng, kind, to)
    robot = robot.replace(gravity=gravity)
    plant = Plant(fflin.StateMap(robot))
    v = fflin.closed(robot, q, rng.normal(size=robot.nv))[1]
    q, v = plant.constrain(q, v)
    return plant, q, v, rng.normal(size=6 + robot.n)


def in_kernel(plant, q, v, u):
    """Return the kernel's mechanics, constraints, point and work space, configured at q."""
    mechanics = mechanics_of(plant)
    held = plant.constrained.in_kernel(mechanics.tree, len(q))
    nu = plant.state.velocities(v)
    point = forward.Point(q.copy(), nu, u.copy(), u.copy(), np.zeros(6))
    work = np.zeros(mechanics.tree.offsets.size)
    forward.configure(work, mechanics, point.q)
    forward.turn_held(mechanics, point)
    return mechanics, held, point, work


@pytest.mark.parametrize(("kind", "to"), CASES)
def test_both_engines_solve_the_equations_of_motion_with_multipliers(kind, to):
    # M a + h = tau + J^T lambda and J a + gamma = 0, solved as one linear system.
    plant, q, v, u = moving(np.random.default_rng(11), kind, to)
    robot, model = plant.robot, plant.robot.model
    rows, kept = Constraints(robot), plant.constrained.kept
    J, gamma = rows.jacobian(q)[kept], rows.bias(q, v)[kept]
    free, push = plant.stage(0.0, q, v, u)
    M = pin.crba(model, robot.create_data(), q)
    system = np.block([[M, -J.T], [J, np.zeros((len(J), len(J)))]])
    assert np.linalg.cond(system) < 1e5
    solution = np.linalg.solve(system, np.concatenate((M @ free, -gamma)))
    expected, forces = np.split(solution, [robot.nv])
    # The condition number of these systems is below 1e5, so 1e-10 of the largest entry.
    tolerance = 1e-10 * np.abs(solution).max()
    rate, wrench = plant.constrained_stage(0.0, q, v, u)
    np.testing.assert_allclose(rate, expected, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(plant.constrained.forces, forces, atol=tolerance)
    np.testing.assert_allclose(wrench - push, (J.T @ forces)[:6], atol=tolerance)
    mechanics, held, point, work = in_kernel(plant, q, v, u)
    rates = np.zeros(len(point.nu))
    forward.accelerate(work, mechanics, None, None, point, 0.0, rates, 0)
    before = point.wrench.copy()
    constraints.constrain(work, mechanics, held, point, rates, 0)
    np.testing.assert_allclose(
        plant.state.spread(rates), expected, rtol=0.0, atol=tolerance
    )
    np.testing.assert_allclose(held.multipliers, forces, atol=tolerance)
    change = (point.wrench - before)[[3, 4, 5, 0, 1, 2]]
    np.testing.assert_allclose(change, wrench - push, atol=tolerance)


@pytest.mark.parametrize(("kind", "to"), CASES)
def test_factors_of_all_rows_are_the_solutions_of_single_rows(kind, to):
    plant, q, v, u = moving(np.random.default_rng(7), kind, to)
    mechanics, held, _, work = in_kernel(plant, q, v, u)
    tree = mechanics.tree
    constraints.locate(work, mechanics, held, q)
    constraints.write_jacobian(work, mechanics, held)
    bodies.factorise(work, tree)
    constraints.factorise(work, tree, held)
    r, size = len(held.error), len(tree.row)
    Z = held.jacobian.reshape(r, size).copy()
    for column in Z:
        bodies.solve_inwards(work, tree, column, 0)
    Z *= held.roots
    Q, R = held.basis.reshape(r, size), np.triu(held.triangle.reshape(r, r))
    np.testing.assert_allclose(R.T @ Q, Z, rtol=0.0, atol=1e-14 * np.abs(Z).max())
    # Gram-Schmidt's rounding errors grow with the condition number of Z.
    apart = 1e-15 * np.linalg.cond(Z)
    np.testing.assert_allclose(Q @ Q.T, np.eye(r), rtol=0.0, atol=10 * apart)
    np.testing.assert_allclose(held.squares, (Z**2).sum(axis=1), rtol=1e-14)


@pytest.mark.parametrize(("kind", "to"), CASES)
def test_corrections_end_on_the_constraints_and_move_loops_without_momentum(kind, to):
    rng = np.random.default_rng(5)
    plant, q, v, u = moving(rng, kind, to)
    robot, model = plant.robot, plant.robot.model
    rows = Constraints(robot)
    q = pin.integrate(model, q, 1e-6 * rng.normal(size=robot.nv))
    v = v + 1e-6 * rng.normal(size=robot.nv)
    mechanics, held, point, work = in_kernel(plant, q, v, u)
    constraints.close(work, mechanics, held, point)
    of_kernel = point.q, plant.state.spread(point.nu)
    of_python = plant.constrained.close(q, v)
    for new_q, new_v in (of_kernel, of_python):
        # The kernel corrects nothing whose squared errors add up to less than 1e-24.
        assert np.abs(rows.residual(new_q)).max() < 1e-12
        assert np.abs(rows.jacobian(new_q) @ new_v).max() < 1e-12
        # Neither engine moves further than the displacement, up to the ratio of inertias.
        assert np.abs(pin.difference(model, q, new_q)).max() < 1e-4
    # The engines use the inertia at different configurations, 1e-6 apart.
    for one, other in zip(of_kernel, of_python, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-9)
    if to:
        data = robot.create_data()
        moved = pin.difference(model, q, of_python[0])
        # The first Newton correction is the only one above 1e-11.
        impulse = (pin.crba(model, data, q) @ moved)[:6]
        assert np.abs(impulse).max() < 1e-10
        assert (held.jacobian.reshape(len(held.error), -1)[:, :6] == 0.0).all()


def test_a_loop_between_branches_and_a_mimic_joint_has_the_jacobian_of_pinocchio():
    rng = np.random.default_rng(2)
    model = random_tree(rng, 7).model.copy()
    for index in range(1, model.njoints):
        model.addJointFrame(index)
    tree = fflin.from_model(model, name="branches")
    names = list(model.names)[1:]
    for first, last in ((names[2], names[-1]), (names[-1], names[1])):
        robot = tree.replace(constraints=[fflin.Weld(first, last)])
        plant = Plant(fflin.StateMap(robot))
        q = pin.integrate(model, robot.neutral(), rng.normal(size=robot.nv))
        q, v = plant.constrain(q, np.zeros(robot.nv))
        mechanics, held, point, work = in_kernel(plant, q, v, np.zeros(6 + robot.n))
        constraints.locate(work, mechanics, held, point.q)
        constraints.write_jacobian(work, mechanics, held)
        kept = plant.constrained.kept
        J = plant.state.columns(Constraints(robot).jacobian(q)[kept])
        np.testing.assert_allclose(held.jacobian, J.ravel(), atol=1e-14)


def test_a_row_that_depends_on_others_is_noticed():
    basis = np.array([1.0, 0.0, 0.0, 1.0, 1e-6, 0.0])
    least = np.ones(1)
    constraints.orthonormalise(basis, np.zeros(4), least, 2)
    # The second row is at an angle of 1e-6 from the first; rounding changes the 16th digit of 1.
    assert least[0] == pytest.approx(1e-12, rel=1e-3)
    assert not least[0] > constraints.LEAST_FRACTION
