"""Gyroscopic torques of rotating bodies and of stored momentum, compared with closed forms."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.base.rotation import skew
from fflin.dynamics.aba import Aba

INERTIA = np.array([[4.0, 0.3, -0.2], [0.3, 5.0, 0.1], [-0.2, 0.1, 6.5]])
AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
OMEGA = np.array([0.7, -0.4, 1.1])
OMEGA_B = slice(6, 9)
# Sums of about ten terms of size 10, whose rounding errors are below 1e-14 each.
ACCURACY = 1e-12


def body(**wheel):
    """A rigid body whose centre of mass is the base's origin, with one wheel about AXIS."""
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint")
    model.appendBodyToJoint(
        1, pin.Inertia(50.0, np.zeros(3), INERTIA), pin.SE3.Identity()
    )
    model.addJointFrame(1)
    robot = fflin.from_model(model, name="body")
    return robot.replace(inputs=[fflin.ReactionWheel(AXIS, name="rotor", **wheel)])


def turned(robot):
    """A configuration with a rotated base, in which base axes and world axes differ."""
    placement = pin.SE3(pin.exp3(np.array([0.4, -0.3, 0.8])), np.zeros(3))
    return fflin.configuration(robot, {}, placement)


@pytest.mark.parametrize("momentum", [0.0, 12.0, -7.0])
def test_a_body_with_stored_momentum_obeys_the_equation_of_euler(momentum):
    """I d(omega)/dt = -omega x (I omega + h), and its derivative with respect to omega."""
    robot = body(momentum=momentum)
    q, v = turned(robot), np.array([*np.zeros(3), *OMEGA])
    lin = fflin.linearize(robot, q, v, frame="local")
    stored = momentum * AXIS
    total = INERTIA @ OMEGA + stored
    expected = np.linalg.solve(INERTIA, -np.cross(OMEGA, total))
    slope = np.linalg.solve(INERTIA, skew(total) - skew(OMEGA) @ INERTIA)
    np.testing.assert_allclose(lin.f0[OMEGA_B], expected, atol=ACCURACY)
    np.testing.assert_allclose(lin.A[OMEGA_B, OMEGA_B], slope, atol=ACCURACY)
    by_aba = Aba(fflin.StateMap(robot)).acceleration(q, v, np.zeros(1))
    np.testing.assert_allclose(by_aba[3:], expected, atol=ACCURACY)


def test_gyroscopic_torque_changes_neither_energy_nor_momentum():
    """The torque is perpendicular to omega, and R (I omega + h) is constant in the world."""
    robot = body(momentum=12.0)
    q, v = turned(robot), np.array([*np.zeros(3), *OMEGA])
    rate = fflin.linearize(robot, q, v, frame="local").f0[OMEGA_B]
    power = OMEGA @ INERTIA @ rate
    growth = INERTIA @ rate + np.cross(OMEGA, INERTIA @ OMEGA + 12.0 * AXIS)
    assert np.abs(rate).max() > 0.1
    assert abs(power) < ACCURACY
    assert np.abs(growth).max() < ACCURACY


def test_a_rotor_with_inertia_has_the_closed_form_of_two_bodies():
    """(I - J a a^T) d(omega)/dt = -omega x (I omega + J s a), and ds/dt = -a^T d(omega)/dt.

    I includes the rotor, whose speed s is relative to the body. J is the rotor's inertia.
    """
    J, speed = 0.2, 60.0
    robot = body(inertia=J)
    q = turned(robot)
    v = fflin.velocity(robot, {"rotor": speed})
    v[3:6] = OMEGA
    lin = fflin.linearize(robot, q, v, frame="local")
    rate, speed_rate = lin.f0[lin.f0.size // 2 :][:3], lin.f0[-1]
    total = INERTIA @ OMEGA + J * speed * AXIS
    carrier = INERTIA - J * np.outer(AXIS, AXIS)
    expected = np.linalg.solve(carrier, -np.cross(OMEGA, total))
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(rate, expected, atol=ACCURACY)
    assert speed_rate == pytest.approx(-AXIS @ expected, abs=ACCURACY)
    energy_rate = (OMEGA @ INERTIA + J * speed * AXIS) @ rate
    energy_rate += J * (AXIS @ OMEGA + speed) * speed_rate
    # Terms of size J speed omega d(omega)/dt, about 100.
    assert abs(energy_rate) < 10.0 * ACCURACY
