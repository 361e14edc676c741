"""Equilibria of robots with constraints: loads in the loop, and squeezing forces."""

import numpy as np
import pytest

import fflin
from tests.support.constrained import parallelogram, pendulum, strut


@pytest.mark.parametrize("angle", [0.3, -0.8])
def test_motors_hold_a_parallelogram_with_the_smallest_torques(angle):
    """The weight gives the torque (m + M) g L sin(angle); three motors share it equally."""
    crank, bar, length = 0.6, 1.5, 0.8
    robot = parallelogram(crank, bar, length, 1.1)
    motors = [fflin.JointTorque(name) for name in ("left", "bar", "right")]
    robot = robot.replace(inputs=motors)
    guess = {"left": angle, "bar": -angle, "right": angle}
    held = fflin.equilibrium(robot, fflin.configuration(robot, guess))
    torque = (crank + bar) * 9.81 * length * np.sin(angle)
    # The bar turns by minus the angle of the cranks relative to the left one.
    expected = torque / 3.0 * np.array((1.0, -1.0, 1.0))
    np.testing.assert_allclose(held.u, expected, rtol=1e-9)
    assert fflin.linearize(robot, held.q, u=held.u).is_equilibrium(1e-9)
    assert len(held.residual) == 1


def test_a_hanging_body_needs_no_inputs_and_a_tilted_one_does():
    robot = pendulum(3.0, np.array((0.2, 0.3, 0.4)), 0.7)
    assert not fflin.equilibrium(robot).u.any()
    free = robot.replace(inputs=[fflin.Thruster("base", (0, 0, 0), (0, 0, 1))])
    q = fflin.closed(free, fflin.configuration(free, rpy=(0, 20, 0)))
    with pytest.raises(fflin.EquilibriumError, match="residual forces"):
        fflin.equilibrium(free, q)


@pytest.mark.parametrize("load", [-3.0, 12.0])
def test_the_force_in_a_strut_is_chosen(load):
    robot = strut(1.2, 0.9, 40.0)
    at_rest = fflin.equilibrium(robot)
    assert not at_rest.u.any()
    squeezed = fflin.equilibrium(robot, forces={"foot.force.x": load})
    measured = robot.replace(outputs=[fflin.ConstraintForce("foot", ("force.x",))])
    lin = fflin.linearize(measured, squeezed.q, u=squeezed.u, independent=["knee"])
    np.testing.assert_allclose(lin.y0, load, rtol=1e-9)
    assert lin.is_equilibrium(1e-9)


def test_two_arms_squeeze_each_other_by_a_given_force():
    weld = fflin.Weld("tool_left", "tool_right", name="grasp")
    robot = fflin.load("dual_arm", constraints=[weld])
    bent = {"left_1": 0.4, "left_2": 0.6, "right_1": -0.4, "right_2": -0.6}
    q = fflin.configuration(robot, bent)
    assert not fflin.equilibrium(robot, q).u.any()
    forces = {"grasp.force.x": 5.0, "grasp.torque.z": -1.0}
    held = fflin.equilibrium(robot, q, forces=forces)
    measured = robot.replace(outputs=[fflin.ConstraintForce("grasp")])
    lin = fflin.linearize(measured, held.q, u=held.u)
    np.testing.assert_allclose(lin.y0[[0, 5]], (5.0, -1.0), rtol=1e-9)
    assert lin.is_equilibrium(1e-9)
    # no inputs with the same forces are smaller
    rows = np.vstack((lin.M @ lin.B[len(lin.M) :], lin.D[[0, 5]]))
    beyond = np.linalg.svd(rows)[2][np.linalg.matrix_rank(rows) :]
    np.testing.assert_allclose(beyond @ held.u, 0.0, atol=1e-9)


def test_what_is_not_supported_is_refused():
    weld = fflin.Weld("tool_left", "tool_right", name="grasp")
    robot = fflin.load("dual_arm", constraints=[weld])
    with pytest.raises(fflin.InputError, match=r"'grasp\.pull'.*component"):
        fflin.equilibrium(robot, forces={"grasp.pull": 1.0})
    with pytest.raises(fflin.InputError, match="only at rest"):
        fflin.equilibrium(robot, v=np.ones(robot.nv))
    with pytest.raises(fflin.InputError, match="no constraints that exert"):
        fflin.equilibrium(fflin.load("dual_arm"), forces={"grasp.force.x": 1.0})
    weak = robot.replace(inputs=[fflin.JointTorque("left_1")])
    forces = {"grasp.force.x": 1.0, "grasp.force.y": 1.0}
    with pytest.raises(
        fflin.EquilibriumError, match=r"constraint forces grasp\.force\.x"
    ):
        fflin.equilibrium(weak, forces=forces)


def test_models_of_designs_hold_the_weight_of_a_linkage():
    """The default design of an unbalanced point uses the inputs of the equilibrium."""
    robot = parallelogram(0.6, 1.5, 0.8, 1.1)
    guess = {"left": 0.5, "bar": -0.5, "right": 0.5}
    q = fflin.closed(robot, fflin.configuration(robot, guess))
    lin = fflin.linearize(robot, q, independent=["left"])
    gain = fflin.lqr(lin)
    np.testing.assert_allclose(gain.u0, fflin.equilibrium(robot, q).u, rtol=1e-9)
    assert gain.poles.real.max() < 0.0
