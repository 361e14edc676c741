"""Points that only inputs hold: designs with these inputs, and the momentum that wheels gain."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.linear.holding import held, momentum_rate, wheel_notes
from tests.support.messages import says
from tests.support.robots import free_body

ORBIT = fflin.CircularOrbit(altitude=550e3)
INERTIA = np.diag((20.0, 25.0, 30.0))
TILTED = pin.rpy.rpyToMatrix(0.05, 0.1, 0.02)


def wheels(*axes, inertia=0.01):
    return [
        fflin.ReactionWheel(axis, "base", inertia=inertia, name=f"wheel_{k}")
        for k, axis in enumerate(axes)
    ]


def hub(inputs, R=TILTED):
    """A body of 50 kg whose attitude R is not an equilibrium in orbit, and its configuration."""
    robot = free_body((20.0, 25.0, 30.0)).replace(inputs=inputs, orbit=ORBIT)
    return robot, fflin.configuration(robot, base=pin.SE3(R, np.zeros(3)))


def gravity_gradient(R):
    """Return the torque at rest in LVLH axes: of the gravity gradient, and of gyroscopic forces."""
    n, J = ORBIT.mean_motion, R @ INERTIA @ R.T
    radial, spin = np.array((0.0, 0.0, -1.0)), np.array((0.0, -n, 0.0))
    return 3.0 * n**2 * np.cross(radial, J @ radial) - np.cross(spin, J @ spin)


@pytest.mark.parametrize("massive", [True, False])
@pytest.mark.parametrize("frame", ["lvlh", "hill"])
def test_wheels_take_up_the_torque_of_the_gravity_gradient(massive, frame):
    mounted = wheels(*np.eye(3).tolist(), inertia=0.01 if massive else None)
    robot, q = hub(mounted)
    # lvlh: x along, y -normal, z down
    to_hill = np.array(((0, 0, -1), (1, 0, 0), (0, -1, 0)))
    axes = np.eye(3) if frame == "lvlh" else to_hill
    placed = pin.SE3(axes @ TILTED, np.zeros(3))
    q = fflin.configuration(robot, base=placed)
    lin = held(fflin.linearize(robot, q, frame=frame))
    # in base axes, like the angular velocity
    torque = TILTED.T @ gravity_gradient(TILTED)
    assert momentum_rate(lin) == pytest.approx(
        torque, rel=1e-9, abs=1e-9 * np.abs(torque).max()
    )
    at = [
        i
        for i, name in enumerate(lin.state_names)
        if name.startswith(("omega_b", "v_b"))
    ]
    assert np.abs(lin.f0[at]).max() < 1e-15


@pytest.mark.exhaustive
def test_wheels_gain_the_reported_momentum():
    """One orbit of the nonlinear loop; the momentum is measured in the flight."""
    robot, q = hub(wheels(*np.eye(3).tolist()))
    lin = fflin.linearize(robot, q)
    gain = fflin.lqr(lin)
    assert says(str(gain), "held at the operating point: u0")
    motion = fflin.simulate(
        robot,
        fflin.StateFeedback(lin, gain.K),
        q0=q,
        duration=ORBIT.period,
        dt=ORBIT.period / 1e3,
    )
    speeds = motion.v[:, 6:]
    turned = np.degrees(
        2.0 * np.arcsin(np.linalg.norm(motion.x[:, :3] - motion.x[0, :3], axis=1))
    )
    assert turned.max() < 0.05
    # along the axes of LVLH, whose y is minus the normal
    gained = TILTED @ (0.01 * speeds).T
    torque = gravity_gradient(TILTED)
    period, n = ORBIT.period, ORBIT.mean_motion
    across = 2.0 * np.hypot(torque[0], torque[2]) / n
    assert abs(gained[1, -1]) == pytest.approx(abs(torque[1]) * period, rel=2e-2)
    assert np.hypot(gained[0], gained[2]).max() == pytest.approx(across, rel=2e-2)
    message = [
        f"gain {abs(torque[1]) * period:.3g} N m s per orbit",
        f"up to {across:.3g} N m s",
    ]
    assert says(" ".join(motion.notes), *message) and says(str(gain), *message)


def test_an_equilibrium_needs_no_other_inputs():
    """The model itself is returned, and with inputs of the user too."""
    robot, q = hub([fflin.BaseTorque()], np.eye(3))
    level = fflin.linearize(robot, q)
    assert held(level) is level and not wheel_notes(level)
    robot, q = hub([fflin.BaseTorque()])
    given = fflin.linearize(robot, q, u=[1e-3, 0.0, 0.0])
    assert held(given) is given
    with pytest.raises(fflin.EquilibriumError, match="not a fixed point"):
        fflin.lqr(given)


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_a_base_torque_holds_the_gravity_gradient(dt):
    robot, q = hub([fflin.BaseTorque()])
    lin = fflin.linearize(robot, q)
    model = lin.discretize(dt) if dt else lin
    gain = fflin.lqr(model, 1.0, 1.0)
    assert gain.u0 == pytest.approx(-TILTED.T @ gravity_gradient(TILTED), rel=1e-9)
    expected = fflin.equilibrium(robot, q)
    about = fflin.linearize(robot, expected.q, u=expected.u)
    about = about.discretize(dt) if dt else about
    assert (gain.K == fflin.lqr(about, 1.0, 1.0).K).all()
    assert (fflin.StateFeedback(model, gain.K).lin.u0 == gain.u0).all()
    noise = fflin.kalman(model, 1e-3, 1e-4)
    assert fflin.lqg(gain, noise).poles.size == len(gain.poles) + len(noise.poles)


def test_a_centre_of_mass_next_to_the_origin_is_put_on_the_orbit():
    """No input pushes this robot, so its origin leaves the orbit instead of its centre of mass."""
    robot = fflin.load(
        "servicer_7dof", lock=["*"], inputs=wheels(*np.eye(3).tolist()), orbit=ORBIT
    )
    gain = fflin.lqr(fflin.linearize(robot))
    q = robot.neutral()
    center = pin.centerOfMass(robot.model, robot.create_data(), q)
    assert np.linalg.norm(center) > 1e-3
    assert gain.x0[3:6] == pytest.approx(-center * (0.0, 1.0, 1.0), abs=1e-12)
    q[:3] = (0.0, 0.0, 10.0)  # a place that the user gives is kept
    with pytest.raises(fflin.EquilibriumError, match="F_b"):
        fflin.lqr(fflin.linearize(robot, q))


def test_forces_below_the_tolerance_of_an_equilibrium_are_no_reason_to_refuse():
    """Springs deflect by 1e-9 rad, which leaves 1e-15 N m that nothing balances."""
    robot = fflin.load(
        "servicer_7dof",
        lock=["joint_*"],
        passive=["panel_*"],
        stiffness=100.0,
        orbit=ORBIT,
    )
    robot = robot.replace(inputs=wheels(*np.eye(3).tolist()))
    for number in (0, 5, 13):
        place = fflin.relative_equilibria(robot)[number]
        reference = pin.XYZQUATToSE3(place.q[:7])
        result = fflin.equilibrium(robot, place.q, reference=reference)
        lin = fflin.linearize(robot, result.q, u=result.u, reference=reference)
        assert lin.is_equilibrium()
