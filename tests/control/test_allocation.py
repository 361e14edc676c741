"""Allocation of a torque to thrusters that exert it only together with a force."""

import numpy as np
import pinocchio as pin
import pytest

import fflin

# Four thrusters that all push along +z: they exert torques about x and y of both signs.
PLACES = ((0.5, 0.0, 0.4), (-0.5, 0.0, 0.4), (0.0, 0.5, 0.4), (0.0, -0.5, 0.4))
TORQUE = np.array([0.3, -0.2, 0.0])


def robots(*, limit=100.0, force=False, passive=()):
    """Return a robot with the thrusters, and the robot for the design."""
    thrusters = [
        fflin.Thruster("base", place, (0, 0, 1), max=limit) for place in PLACES
    ]
    robot = fflin.load("servicer_7dof")
    driven = [name for name in robot.joint_names if name not in passive]
    motors = [fflin.JointTorque(name) for name in driven]
    wanted = [fflin.BaseTorque(), fflin.BaseForce()] if force else [fflin.BaseTorque()]
    return (
        robot.replace(inputs=[*thrusters, *motors]),
        robot.replace(inputs=[*wanted, *motors]),
    )


def posture(robot):
    """Return a configuration with a stretched arm."""
    angles = dict(zip(robot.joint_names, np.linspace(0.3, -0.5, robot.n), strict=True))
    return fflin.configuration(robot, joints=angles)


def accelerations(robot, design, commanded):
    """Return M, commanded and attained accelerations (6 + n,), and all inputs."""
    motors = len(robot.inputs) - len(PLACES)
    commanded = np.concatenate((commanded, np.zeros(motors)))
    q = posture(robot)
    v = np.zeros(robot.nv)
    law = fflin.Allocation(lambda t, q, v: commanded, design)
    u = law.bind(robot)(0.0, q, v)
    lin, wanted = fflin.linearize(robot, q), fflin.linearize(design, q)
    rates = slice(len(lin.M), None)
    return lin.M, wanted.B[rates] @ commanded, lin.B[rates] @ u, u


def test_a_torque_without_a_wanted_force_is_exact_although_the_thrusters_push():
    M, wanted, attained, u = accelerations(*robots(), TORQUE)
    thrust = u[:4]
    # The robot accelerates as commanded, apart from the acceleration of the centre of mass.
    uniform = np.zeros(len(M))
    uniform[5] = thrust.sum() / M[5, 5]
    size = np.abs(wanted).max()
    assert np.abs(attained - uniform - wanted).max() < 1e-5 * size
    assert uniform[5] > 1e-3
    # Opposite thrusters would only add force.
    assert min(thrust[0], thrust[1]) < 1e-6 * thrust.max()
    assert min(thrust[2], thrust[3]) < 1e-6 * thrust.max()


@pytest.mark.parametrize("passive", [(), ("panel_left", "panel_right")])
def test_the_thrusters_exert_the_torque_about_the_centre_of_mass(passive):
    robot, design = robots(passive=passive)
    thrust = accelerations(robot, design, TORQUE)[-1][:4]
    center = pin.centerOfMass(robot.model, robot.create_data(), posture(robot))
    moment = np.cross(np.array(PLACES) - center, (0.0, 0.0, 1.0)).T @ thrust
    assert moment == pytest.approx(TORQUE, abs=1e-5)


def test_a_design_with_a_force_counts_an_unwanted_force_as_an_error():
    commanded = np.concatenate((TORQUE, np.zeros(3)))
    M, wanted, attained, u = accelerations(*robots(force=True), commanded)
    thrust = u[:4]
    error = attained - wanted
    assert (thrust > 1e-6).any()
    # The gradient of e' M e vanishes for all thrusters that are not at their limit of zero.
    robot, _ = robots(force=True)
    columns = fflin.linearize(robot, posture(robot)).B[len(M) :]
    gradient = columns.T @ M @ error
    assert np.abs(gradient[np.abs(u) > 1e-6]).max() < 1e-6 * np.abs(columns.T @ M).max()
    assert np.abs(error[:3]).max() > 0.05 * np.abs(wanted[:3]).max()


def test_a_torque_beyond_the_limits_is_reduced():
    _, wanted, attained, u = accelerations(*robots(limit=0.4), TORQUE)
    assert u[:4].max() == pytest.approx(0.4, rel=1e-6)
    assert np.abs(attained[:2]).max() < np.abs(wanted[:2]).max()


@pytest.mark.compiled
def test_compiled_code_allocates_as_python_does():
    robot, design = robots(limit=0.4)
    lin = fflin.linearize(design)
    K = np.zeros((len(lin.input_names), len(lin.state_names)))
    K[:3, :3] = 2.0 * np.eye(3)
    law = fflin.Allocation(fflin.StateFeedback(lin, K), design)
    options = {
        "q0": fflin.configuration(robot, rpy=(6, -9, 0)),
        "duration": 2.0,
        "dt": 0.02,
    }
    python, compiled = (
        fflin.simulate(robot, law, engine=engine, **options)
        for engine in ("python", "compiled")
    )
    assert np.abs(python.u).max() > 0.1
    assert compiled.u == pytest.approx(python.u, abs=1e-9)
    assert compiled.q == pytest.approx(python.q, abs=1e-10)
