"""Gains in the coordinates of other tools."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.state import Actuation

POSE = pin.SE3(pin.rpy.rpyToMatrix(0.3, 0.4, -0.5), np.array([0.1, -0.2, 0.3]))


def designed(dt=0.0):
    """A gain about a rotated pose with inputs that are not zero there."""
    robot = fflin.load("planar_detumble")
    q = fflin.configuration(robot, {"joint_1": 0.4}, POSE)
    u = np.random.default_rng(0).normal(size=9)
    lin = fflin.linearize(robot, q, u=u, reference=pin.SE3.Identity())
    lin = lin.discretize(dt) if dt else lin
    K = np.random.default_rng(1).normal(size=(9, 18))
    controller = fflin.lqr(fflin.linearize(robot, q, reference=pin.SE3.Identity()))
    from dataclasses import replace

    return robot, lin, replace(controller, K=K, u0=lin.u0, _lin=lin)


@pytest.mark.parametrize("tool", ["pinocchio", "drake", "mujoco", "euler", "spart"])
def test_the_closed_loop_is_the_same(tool):
    _, lin, gain = designed()
    controller = gain.to(tool)
    m = controller.model
    ours = lin.A - lin.B @ gain.K
    theirs = m.T_left @ (m.A - m.B @ controller.K) @ m.T
    # Beside the terms of a rate of T, which f0 gives where the point is no equilibrium.
    moved = m.T_left @ m.A @ m.T - lin.A
    free = m.T_left @ m.B @ (controller.K - m.T_u @ gain.K @ m.T_left) @ m.T
    assert np.abs(theirs - ours - (moved - free)).max() < 1e-12 * np.abs(ours).max()


def test_the_inputs_match_the_law_in_pinocchios_coordinates():
    """By differences along pin.integrate of the law of the simulation, with wrenches in base axes.

    The ROS 2 package linear_feedback_controller applies, with feedback_gain = K,
    u = feedforward + feedback_gain (pin.difference(q, q0), v0 - v).
    """
    robot, lin, gain = designed()
    controller = gain.to("pinocchio")
    state = fflin.StateMap(robot, reference=lin.reference, frame=lin.frame)
    law, actuation = fflin.StateFeedback(lin, gain.K).bind(robot), Actuation(state)

    order = [lin.input_names.index(name) for name in controller.model.input_names]

    def inputs(dx):
        q, v = pin.integrate(robot.model, lin.q, dx[: robot.nv]), lin.v + dx[robot.nv :]
        return actuation.in_base_axes(state.chart(q), law(0.0, q, v))[order]

    h = 1e-6
    differences = np.array(
        [(inputs(h * e) - inputs(-h * e)) / (2.0 * h) for e in np.eye(18)]
    ).T
    assert np.abs(differences + controller.K).max() < 1e-8
    # The formula of the message itself, near the reference.
    m, dx = controller.model, 1e-4 * np.random.default_rng(2).normal(size=18)
    q, v = pin.integrate(robot.model, m.q, dx[: robot.nv]), m.v + dx[robot.nv :]
    error = np.append(pin.difference(robot.model, q, m.q), m.v - v)
    assert np.abs(m.u0 + controller.K @ error - inputs(dx)).max() < 1e-6
    assert np.abs(controller.model.u0 - inputs(np.zeros(18))).max() < 1e-14


def test_a_gain_of_a_file_has_no_model(tmp_path):
    _, _, gain = designed()
    gain.save(tmp_path / "gain.npz")
    with pytest.raises(fflin.InputError, match="read from a file"):
        fflin.Gain.load(tmp_path / "gain.npz").to("drake")


def test_sampled_gains_too():
    _, _, gain = designed(0.1)
    one, other = gain.to("mujoco").K, designed()[2].to("mujoco").K
    assert np.abs(one - other).max() < 1e-12
