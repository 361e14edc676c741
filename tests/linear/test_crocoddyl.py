"""Crocoddyl: derivatives of its Euler step, along trajectories and of gains."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.robots import random_point

STEP = 0.02  # [s]


def euler(robot, q, v, u):
    """IntegratedActionModelEuler: v+ = v + h a, q+ = q + h v+ on the manifold."""
    model = robot.model.copy()
    model.gravity.linear = np.array(robot.gravity)
    a = pin.aba(model, model.createData(), q, v, np.concatenate((np.zeros(6), u)))
    return pin.integrate(model, q, STEP * (v + STEP * a)), v + STEP * a


def differences(robot, q, v, u, size=1e-6):
    """Fx and Fu by central differences, in Crocoddyl's state.diff and state.integrate."""
    model, nv = robot.model, robot.nv
    q_0, v_0 = euler(robot, q, v, u)
    columns = []
    for d in np.eye(2 * nv + len(u)):
        ends = []
        for s in (size, -size):
            dq, dv, du = np.split(s * d, [nv, 2 * nv])
            q_1, v_1 = euler(robot, pin.integrate(model, q, dq), v + dv, u + du)
            ends.append(np.concatenate((pin.difference(model, q_0, q_1), v_1 - v_0)))
        columns.append((ends[0] - ends[1]) / (2.0 * size))
    return np.hsplit(np.transpose(columns), [2 * nv])


@pytest.fixture(scope="module")
def flight():
    motors = [fflin.JointTorque("*")]
    robot = fflin.load("astrobee_arm", gravity=(0.3, 0.0, -9.81), inputs=motors)
    q, v, _ = random_point(robot, np.random.default_rng(4))
    motion = fflin.simulate(
        robot, lambda t, q, v: np.array((0.2, -0.1)), q0=q, v0=v, duration=0.2, dt=0.01
    )
    return fflin.linearize_trajectory(robot, motion.trajectory())


def test_the_matrices_are_the_derivatives_of_the_step(flight):
    nodes, robot = flight.to("crocoddyl", dt=STEP), flight.robot
    assert nodes.dt == STEP and nodes.state_names[:2] == ("p.x", "p.y")
    for k in (0, 7, 19):
        point = flight.q[k], flight.v[k], flight.u[k]
        for got, expected in zip(
            (nodes.A[k], nodes.B[k]), differences(robot, *point), strict=True
        ):
            # Central differences at 1e-6 have errors of about 1e-10.
            assert got == pytest.approx(expected, abs=1e-8 * np.abs(expected).max())
        one = flight[k].to("crocoddyl", dt=STEP)
        assert one.A == pytest.approx(nodes.A[k], abs=1e-12)
        assert one.B == pytest.approx(nodes.B[k], abs=1e-12)


def test_a_model_comes_back_from_the_step():
    robot = fflin.load("astrobee_arm")
    lin = fflin.linearize(robot, v=0.2 * np.ones(robot.nv), moving=True)
    step = lin.to("crocoddyl", dt=STEP)
    back = fflin.from_tool(
        robot, "crocoddyl", step.q, step.v, A=step.A, B=step.B, dt=STEP, moving=True
    )
    assert back.A == pytest.approx(lin.A, abs=1e-10) and back.B == pytest.approx(
        lin.B, abs=1e-10
    )


@pytest.mark.parametrize("tool", ["pinocchio", "crocoddyl"])
def test_along_a_trajectory_it_is_the_conversion_of_each_knot(flight, tool):
    whole = flight.to(tool)
    for k in (0, 11):
        one = flight[k].to(tool)
        for name in ("A", "B"):
            expected = getattr(one, name)
            got = getattr(whole, name)[k]
            assert got == pytest.approx(expected, abs=1e-12 * np.abs(expected).max())
    sampled = flight.discretize(0.05)
    moved = sampled.to(tool)
    assert moved.dt == 0.05
    assert moved.T_left @ moved.A[1] @ moved.T == pytest.approx(sampled.A[1], abs=1e-12)


def test_gains_of_a_schedule_command_the_same_inputs(flight):
    robot = flight.robot
    schedule = fflin.tvlqr(flight, sample=0.05)
    converted = schedule.to("crocoddyl", robot)
    policy = fflin.TrajectoryFeedback(flight, schedule).bind(robot)
    small = 1e-5 * np.random.default_rng(2).normal(size=2 * robot.nv)
    for k in (0, 2):
        q = pin.integrate(robot.model, converted.q[k], small[: robot.nv])
        v = converted.v[k] + small[robot.nv :]
        e = np.concatenate(
            (pin.difference(robot.model, converted.q[k], q), v - converted.v[k])
        )
        feedback = converted.K[k] @ e
        # q_b is the sine of half the angle, so both errors are equal to second order.
        got = converted.u[k] - policy(0.05 * k, q, v)
        assert got == pytest.approx(feedback, abs=1e-4 * np.abs(feedback).max())


def test_a_tool_with_other_axes_is_refused(flight):
    with pytest.raises(fflin.InputError, match="along"):
        flight.to("mujoco")
    with pytest.raises(fflin.InputError, match="leave out dt"):
        flight.discretize(0.05).to("crocoddyl", dt=0.01)


def test_knots_of_a_coarse_euler_integration_name_it_as_a_cause(flight):
    robot = flight.robot
    q, v, u = [flight.q[0]], [flight.v[0]], np.array((0.2, -0.1))
    for _ in range(5):
        point = euler(robot, q[-1], v[-1], u)
        q.append(point[0])
        v.append(point[1])
    t = STEP * np.arange(6)
    with pytest.warns(fflin.FflinWarning, match="semi-implicit Euler"):
        fflin.linearize_trajectory(robot, t, q, v, np.tile(u, (5, 1)))
