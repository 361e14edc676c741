"""Motions that others published, by the nonlinear model in the chart."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import fflin
from fflin.dynamics.aba import Aba
from fflin.linear.nonlinear import Nonlinear
from tests.support.marks import exhaustive


def flown(robot, q, v, u, duration):
    """The state (nx,) after a time under a constant input, by DOP853 and ABA in the chart."""
    lin = fflin.linearize(robot, q, v, u, reference=pin.SE3.Identity())
    state = fflin.StateMap(robot)
    model = Nonlinear(Aba(state), lin)
    result = solve_ivp(
        lambda _, x: model.rates(np.r_[x, lin.u0][None])[0],
        (0.0, duration),
        lin.x0,
        method="DOP853",
        rtol=1e-13,
        atol=1e-13,
    )
    assert result.success
    return state, result.y[:, -1]


def test_two_hinged_panels_of_a_tumbling_hub():
    """AVSLab Basilisk, the test of its hinged rigid bodies without gravity and damping.

    The panels hang on hinges at (+-.5, 0, 1) m about the y axes of their own frames, the one at
    +.5 m turned by pi about z; a panel's centre is 1.5 m along its -x axis.
    """
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    hub = pin.Inertia(750.0, np.array([0.0, 0.0, 1.0]), np.diag([900.0, 800.0, 600.0]))
    model.appendBodyToJoint(1, hub, pin.SE3.Identity())
    panel = pin.Inertia(100.0, np.array([-1.5, 0.0, 0.0]), np.diag([100.0, 50.0, 50.0]))
    for name, side in (("panel_1", 1.0), ("panel_2", -1.0)):
        place = pin.SE3(np.diag([-side, -side, 1.0]), np.array([0.5 * side, 0.0, 1.0]))
        index = model.addJoint(1, pin.JointModelRY(), place, name)
        model.appendBodyToJoint(index, panel, pin.SE3.Identity())
    robot = fflin.from_model(model, stiffness=100.0)
    # What is given is the position and velocity of the whole's centre of mass.
    omega = np.array([0.1, -0.1, 0.1])
    q = fflin.configuration(robot, {"panel_1": np.deg2rad(5.0)})
    v = np.zeros(robot.nv)
    v[3:6] = omega
    data = robot.create_data()
    pin.centerOfMass(robot.model, data, q, v)
    q[:3] = np.array([0.1, -0.4, 0.3]) - data.com[0]
    v[:3] = np.array([-0.2, 0.5, 0.1]) - data.vcom[0]
    state, x = flown(robot, q, v, None, 2.5)
    q_b = x[state.groups.q_b]
    mrp = q_b / (1.0 + np.sqrt(1.0 - q_b @ q_b))
    expected = (0.06170318243240492, -0.07089090074412899, 0.06409500412692531)
    assert mrp == pytest.approx(expected, rel=1e-10, abs=0.0)
    expected = (-0.15832794740648992, 1.122481716747217, -0.37975995949382907)
    assert x[state.groups.r_b] == pytest.approx(expected, rel=1e-10, abs=0.0)


def test_spin_up_of_one_wheel():
    """The same project's back-of-envelope case of a balanced wheel, about z.

    Hub of 5 kg with moments (2, 2, 2 + J) kg m^2, J = 100 N m s / 6000 rpm of the wheel counted;
    it turns at .35 rad/s and the wheel at 100 rpm; from 5 to 10 s the motor gives .2 N m. Then
    omega = .35 - (.2/2) 5 = -.15, theta = 1.75 + 1.75 - (.2/2) 25/2 = 2.25, and the wheel has
    gained (2 + J) .2 / (2 J) 5.
    """
    rpm = 2.0 * np.pi / 60.0
    J = 100.0 / (6000.0 * rpm)
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    hub = pin.Inertia(5.0, np.zeros(3), np.diag([2.0, 2.0, 2.0 + J]))
    model.appendBodyToJoint(1, hub, pin.SE3.Identity())
    wheel = fflin.ReactionWheel((0, 0, 1), inertia=J)
    robot = fflin.from_model(model, inputs=[wheel])
    q, v = fflin.configuration(robot), fflin.velocity(robot, {"wheel_1": 100.0 * rpm})
    v[5] = 0.35
    state, x = flown(robot, q, v, None, 5.0)
    state, x = flown(robot, *state.to_pinocchio(x), [0.2], 5.0)
    g = state.groups
    assert 2.0 * np.arcsin(x[g.q_b]) == pytest.approx([0.0, 0.0, 2.25], abs=1e-10)
    assert x[g.omega_b] == pytest.approx([0.0, 0.0, -0.15], abs=1e-10)
    expected = 100.0 * rpm + (2.0 + J) * 0.2 / (2.0 * J) * 5.0
    assert x[g.qdot_m] == pytest.approx([expected], rel=1e-10)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ["joint", *exhaustive("stored")])
def test_total_momentum_is_conserved_along_a_motion(kind):
    """An arm swings on a base with wheels at speed; H in the world stays, the wheels' in it."""
    bare = fflin.load("dual_arm")
    axes, J, speed = ((1, 0, 0), (0, 1, 1), (0, -1, 1)), 1e-2, 200.0
    if kind == "joint":
        wheels = [fflin.ReactionWheel(axis, inertia=J) for axis in axes]
    else:
        wheels = [fflin.ReactionWheel(axis, momentum=J * speed) for axis in axes]
    motors = [fflin.JointTorque(name) for name in bare.joint_names]
    robot = bare.replace(inputs=[*motors, *wheels], outputs=[fflin.Momentum()])
    rates = {f"wheel_{k}": speed for k in (1, 2, 3)} if kind == "joint" else {}
    v = fflin.velocity(robot, rates | {"omega_b.x": 0.1, bare.joint_names[0]: 0.3})
    u = np.append(np.linspace(-0.5, 0.5, bare.n), 0.1 * np.ones(3) * (kind == "joint"))
    q = fflin.configuration(robot, dict.fromkeys(bare.joint_names, 0.3))
    state, x = flown(robot, q, v, u, 1.0)
    before, after = (
        fflin.linearize(robot, *point, reference=pin.SE3.Identity()).y0
        for point in ((q, v), state.to_pinocchio(x))
    )
    assert np.linalg.norm(before[:3]) > 1.0
    assert after == pytest.approx(before, abs=1e-10 * np.linalg.norm(before[:3]))
