"""Aerial robots: rotors with reaction torques, and hover."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.quadrotor import INERTIA, MASS, PLACES, SIGNS, K, canted, quadrotor


def test_four_rotors_have_the_closed_form(tmp_path):
    """Force and torques of f_k: lift sum f_k, moments p x f z, and yaw sum s_k k f_k."""
    robot = quadrotor(tmp_path, arm=False)
    hover = fflin.equilibrium(robot)
    assert hover.u == pytest.approx(np.full(4, MASS * 9.81 / 4.0), rel=1e-12)
    lin = fflin.linearize(robot, hover.q, u=hover.u)
    assert lin.is_equilibrium() and fflin.check(robot, lin).ok
    x, y = np.transpose(PLACES)
    wrench = {
        "omega_b.x": y / INERTIA[0],
        "omega_b.y": -x / INERTIA[1],
        "omega_b.z": K * np.array(SIGNS) / INERTIA[2],
        "v_b.z": np.full(4, 1.0 / MASS),
    }
    for name, expected in wrench.items():
        row = lin.B[lin.state_names.index(name)]
        assert row == pytest.approx(expected, rel=1e-12, abs=1e-12)
    assert fflin.controllability(lin).dimension == 12
    assert fflin.lqr(lin).poles.real.max() < 0.0


OUT = {"shoulder": 1.2, "elbow": 0.3}


@pytest.mark.parametrize(
    "rpy", [(0.0, 0.0, 0.0), (0.3, -0.5, 1.0)], ids=["level", "inclined"]
)
def test_the_base_tilts_until_the_rotors_carry_the_arm(tmp_path, rpy):
    robot = quadrotor(tmp_path).replace(inputs=canted(5.0))
    given = fflin.configuration(
        robot, OUT, base=pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.ones(3))
    )
    held = fflin.equilibrium(robot, given)
    lin = fflin.linearize(robot, held.q, u=held.u)
    assert lin.is_equilibrium() and "tilt of the base" in str(held)
    # Independent of the search: the rotors' forces and gravity cancel at the centre of mass.
    model, data = robot.model, robot.create_data()
    force = np.transpose([rotor.direction for rotor in robot.inputs[:4]]) @ held.u[:4]
    R, start = (pin.XYZQUATToSE3(q[:7]).rotation for q in (held.q, given))
    total = pin.computeTotalMass(model)
    assert R @ force == pytest.approx((0.0, 0.0, 9.81 * total), abs=1e-8)
    center = pin.centerOfMass(model, data, held.q) - held.q[:3]
    moment = sum(
        np.cross(r.position, r.direction) * u
        for r, u in zip(robot.inputs[:4], held.u[:4], strict=True)
    )
    assert R @ moment == pytest.approx(np.cross(center, R @ force), abs=1e-8)
    # The tilt is the rotation from the given attitude, and has no part about the vertical.
    assert start @ pin.exp3(held.tilt) == pytest.approx(R, abs=1e-12)
    assert np.array_equal(held.q[7:], given[7:]) and np.array_equal(
        held.q[:3], given[:3]
    )
    with pytest.raises(fflin.EquilibriumError, match="F_b"):
        fflin.equilibrium(robot, given, tilt=False)


def test_an_attitude_that_is_an_equilibrium_is_kept(tmp_path):
    robot = quadrotor(tmp_path)
    held = fflin.equilibrium(robot, fflin.configuration(robot, OUT))
    assert not held.tilt.any()
    # No tilt helps legs that cannot push.
    motors = robot.replace(inputs=[fflin.JointTorque("*")])
    with pytest.raises(fflin.EquilibriumError, match="set gravity to zero"):
        fflin.equilibrium(motors)


@pytest.mark.parametrize("degrees", [1.0, 5.0])
def test_default_weights_keep_a_weak_yaw_as_fast_as_they_say(tmp_path, degrees):
    """The slowest pole of a loop within its limits has the bandwidth of the report."""
    robot = quadrotor(tmp_path).replace(inputs=canted(degrees))
    hover = fflin.equilibrium(robot)
    gain = fflin.lqr(fflin.linearize(robot, hover.q, u=hover.u))
    assert np.abs(gain.poles).min() > 0.2
    assert "decaying more slowly" not in gain.weights


def test_default_weights_hold_a_stretched_arm_in_hover(tmp_path):
    """A bandwidth of 0.2 rad/s leaves the arm to gravity, which swings it over."""
    robot = quadrotor(tmp_path)
    hover = fflin.equilibrium(robot, fflin.configuration(robot, OUT))
    lin = fflin.linearize(robot, hover.q, u=hover.u)
    q0 = hover.q + np.array((0.3, 0.0, 0.1, *np.zeros(6)))
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    motion = fflin.simulate(robot, policy, q0=q0, duration=8.0, dt=0.01, limits="urdf")
    assert np.abs(motion.q[-1, :3] - hover.q[:3]).max() < 0.05
    assert np.abs(motion.q[:, 7:] - hover.q[7:]).max() < 1.0
