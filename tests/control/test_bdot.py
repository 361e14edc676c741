"""Magnetorquers in the field of a dipole, and the B-dot law that detumbles with them."""

import math

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.magnetic import MagneticField
from fflin.dynamics.orbital import OrbitField
from fflin.linear.linearization import Linearizer
from fflin.robot.orbit import DIPOLES
from fflin.simulation.rotation_rates import RotationRates
from tests.support.marks import exhaustive
from tests.support.robots import random_point

INCLINATION, LATITUDE = 1.2, 0.7
ORBIT = fflin.CircularOrbit(
    500e3, inclination=INCLINATION, argument_of_latitude=LATITUDE, field="dipole"
)
RODS = [fflin.Magnetorquer(axis, max=0.2) for axis in np.eye(3)]


@pytest.fixture(scope="module")
def cubesat():
    return fflin.load("cubesat", orbit=ORBIT, inputs=RODS)


def dipole(t, position):
    """Flux density of a dipole along -z, in equatorial axes."""
    distance = np.linalg.norm(position)
    r = position / distance
    north = np.array([0.0, 0.0, 1.0])
    return DIPOLES["earth"] / distance**3 * (north - 3.0 * (north @ r) * r)


def test_the_field_in_lvlh_axes(cubesat):
    """b = a (sin i cos u, -cos i, 2 sin i sin u), x along, y minus normal, z to the earth."""
    field = OrbitField(cubesat, "lvlh").magnetic
    a = DIPOLES["earth"] / ORBIT.radius**3
    for t in (0.0, 1234.5):
        u = LATITUDE + ORBIT.mean_motion * t
        s, c = math.sin(INCLINATION), math.cos(INCLINATION)
        expected = a * np.array([s * math.cos(u), -c, 2.0 * s * math.sin(u)])
        assert field.at(t) == pytest.approx(expected, rel=1e-14)
    assert 2e-5 < a < 3e-5  # [T], the field at the magnetic equator in a low orbit


@pytest.mark.parametrize("frame", ["lvlh", "hill"])
def test_a_function_of_position_gives_the_same_field(frame):
    """The dipole in equatorial axes is an independent computation of the field."""
    axes = OrbitField(fflin.load("cubesat", orbit=ORBIT), frame).axes
    other = fflin.CircularOrbit(
        500e3, inclination=INCLINATION, argument_of_latitude=LATITUDE, field=dipole
    )
    known, given = MagneticField(ORBIT, axes), MagneticField(other, axes)
    for t in (0.0, 700.0, 4000.0):
        assert given.at(t) == pytest.approx(known.at(t), abs=1e-18)
        # The central difference over 2 s has the relative error (n 1 s)^2 / 6 = 2e-7.
        assert given.rate(t) == pytest.approx(known.rate(t), rel=1e-5, abs=1e-14)


def test_the_torque_is_across_the_field(cubesat):
    """With the moment m s, the torque is m s x b."""
    q = fflin.configuration(cubesat, rpy=(30, 20, 50))
    lin = fflin.linearize(cubesat, q)
    R = pin.XYZQUATToSE3(q[:7]).rotation
    b = R.T @ OrbitField(cubesat, "lvlh").magnetic.at(0.0)
    torque = lin.M[:3, :3] @ lin.B[6:9]
    assert torque == pytest.approx(np.cross(np.eye(3), b).T, abs=1e-18)
    assert lin.input_units == ("A m^2",) * 3
    assert fflin.check(cubesat, lin).ok


def test_a_magnetorquer_on_a_moving_link_is_verified():
    robot = fflin.load("planar_detumble")
    rods = [fflin.Magnetorquer((1, 2, 3), robot.joint_names[-1]), fflin.BaseTorque()]
    robot = robot.replace(orbit=ORBIT, inputs=rods)
    q, v, _ = random_point(robot, np.random.default_rng(2), speed=0.1, degrees=40.0)
    assert fflin.check(robot, fflin.linearize(robot, q, v, frame="hill")).ok


def test_files_and_records(tmp_path, cubesat):
    text = """
    urdf = "cubesat"
    orbit = { altitude = 500e3, inclination = 1.2, argument_of_latitude = 0.7, field = "dipole" }
    [[input]]
    type = "magnetorquer"
    axis = [0, 0, 1]
    max = 0.2
    name = "rod"
    """
    (tmp_path / "sat.toml").write_text(text)
    robot = fflin.load(tmp_path / "sat.toml")
    assert robot.orbit == ORBIT
    assert fflin.linearize(robot).input_names == ("rod",)
    assert fflin.CircularOrbit.from_json(ORBIT.to_json()) == ORBIT
    function = fflin.CircularOrbit(500e3, field=dipole)
    assert fflin.CircularOrbit.from_json(function.to_json()).field is None


def test_the_law_removes_energy(cubesat):
    """The moment -k db/dt gives the power -|k| (w x b)^2 in a field that does not change."""
    law = fflin.BDot(2e4).bind(cubesat)
    b = OrbitField(cubesat, "lvlh").magnetic.at(0.0)
    w = np.array(
        [0.3, -0.2, 0.4]
    )  # so fast that the change of the field does not matter
    u = law(0.0, cubesat.neutral(), np.concatenate((np.zeros(3), w)))
    power = w @ np.cross(u, b)
    assert power == pytest.approx(-2e4 * np.sum(np.cross(w, b) ** 2), rel=0.02)


def test_damping_exerts_the_torque_across_the_field(cubesat):
    """The torque is -k times the part of the inertial angular velocity across the field."""
    law = fflin.RateDamping(3e-5).bind(cubesat)
    field = OrbitField(cubesat, "lvlh")
    q = fflin.configuration(cubesat, rpy=(30, 20, 50))
    R = pin.XYZQUATToSE3(q[:7]).rotation
    w = np.array([0.3, -0.2, 0.4])
    t = 700.0
    b = R.T @ field.magnetic.at(t)
    inertial = w + R.T @ field.rate
    along = b * (b @ inertial) / (b @ b)
    u = law(t, q, np.concatenate((np.zeros(3), w)))
    torque = np.cross(u, b)
    assert torque == pytest.approx(-3e-5 * (inertial - along), rel=1e-12, abs=1e-18)


def test_damping_without_a_field_commands_nothing(cubesat):
    orbit = fflin.CircularOrbit(500e3, field=lambda t, r: np.zeros(3))
    robot = cubesat.replace(orbit=orbit)
    v = fflin.velocity(robot, {"omega_b": 0.05})
    u = fflin.RateDamping(3e-5).bind(robot)(0.0, robot.neutral(), v)
    assert np.array_equal(u, np.zeros(3))


@pytest.mark.exhaustive
def test_damping_stops_the_rotation_relative_to_inertial_space(cubesat):
    v0 = np.concatenate((np.zeros(3), np.full(3, 0.05)))
    options = {"duration": 2.0 * ORBIT.period, "dt": 10.0, "limits": "urdf"}
    motion = fflin.simulate(cubesat, fflin.RateDamping(3e-5), v0=v0, **options)
    assert fflin.detumbling_time(motion, factor=1.0) < 2.0 * ORBIT.period


@pytest.mark.exhaustive
def test_a_cubesat_detumbles_within_a_few_orbits(cubesat):
    spin = np.radians(5.0) / math.sqrt(3.0) * np.ones(3)
    v0 = np.concatenate((np.zeros(3), spin))
    options = {"duration": 2.0 * ORBIT.period, "dt": 10.0}
    law = fflin.BDot(2e4)
    motion = fflin.simulate(cubesat, law, v0=v0, limits="urdf", **options)
    assert np.abs(motion.u).max() <= 0.2
    assert fflin.detumbling_time(motion) < 2.0 * ORBIT.period
    assert fflin.detumbling_time(motion, factor=0.5) == math.inf


def test_a_satellite_at_rest_in_an_ellipse_rotates_with_the_frame():
    """Its rate is that of the true anomaly, whose mean over a period is the mean motion."""
    orbit = fflin.EllipticOrbit(perigee=500e3, eccentricity=0.2, anomaly=0.4)
    t = np.linspace(0.0, orbit.period, 2001)
    q = np.zeros((len(t), 7))
    q[:, 6] = 1.0
    motion = RotationRates(t, q, np.zeros((len(t), 6)), "lvlh", orbit)
    rates = [orbit.at(time).rate for time in t.tolist()]
    assert motion.rates == pytest.approx(rates, rel=1e-15)
    assert motion.rates.max() > 1.4 * orbit.mean_motion
    assert motion.means()[-1] == pytest.approx(orbit.mean_motion, rel=1e-12)
    assert motion.slow_after(1.1 * orbit.mean_motion) == t[-1]


@pytest.mark.compiled
@pytest.mark.parametrize("law", [fflin.BDot(2e4), fflin.RateDamping(3e-5)])
def test_a_compiled_campaign_detumbles_as_the_python_engine_does(cubesat, law):
    spread = {"q_b": 0.1, "omega_b": 0.02, "base.mass": 0.05}
    options = {"runs": 3, "duration": 100.0, "dt": 1.0, "seed": 4}
    one, other = (
        fflin.monte_carlo(cubesat, law, spread, engine=engine, **options)
        for engine in ("compiled", "python")
    )
    for name in ("q", "v", "u"):
        expected = getattr(other, name)
        size = np.maximum(1.0, np.abs(expected).max())
        assert np.abs(getattr(one, name) - expected).max() < 1e-12 * size, name


def refused(match, function):
    with pytest.raises(fflin.InputError, match=match):
        function()


def test_errors(cubesat):
    free = fflin.load("cubesat", inputs=RODS)
    refused("no magnetic field", lambda: fflin.linearize(free))
    refused("is zero", lambda: fflin.Magnetorquer((0, 0, 0)))
    refused("expected 0; linear", lambda: fflin.linearize(cubesat, u=[0.1, 0, 0]))
    refused("'igrf'", lambda: fflin.CircularOrbit(5e5, field="igrf"))
    refused("moon", lambda: fflin.CircularOrbit(5e5, body="moon", field="dipole"))
    refused("radians", lambda: fflin.CircularOrbit(5e5, inclination=98.0))
    refused("gain", lambda: fflin.BDot(-1.0))
    refused("N m s", lambda: fflin.RateDamping(0.0))
    plain = fflin.load("cubesat", orbit=ORBIT)
    refused("no magnetorquers", lambda: fflin.BDot(1.0).bind(plain))
    free = fflin.simulate(fflin.load("cubesat"), duration=0.1)
    refused("not in orbit", lambda: fflin.detumbling_time(free))
    bad = plain.replace(
        orbit=fflin.CircularOrbit(5e5, field=lambda t, r: [math.nan] * 3), inputs=RODS
    )
    refused("field", lambda: fflin.linearize(bad))
    arm = fflin.load("planar_detumble")
    rod = fflin.Magnetorquer((1, 0, 0), arm.joint_names[-1])
    arm = arm.replace(orbit=ORBIT, inputs=[rod])
    refused("moves relative", lambda: fflin.BDot(1.0).bind(arm))


def test_models_of_magnetorquers_hold_at_their_time(cubesat):
    """At each time, the torque of a unit moment along s is s x b with the flux b of that time."""
    q = fflin.configuration(cubesat, rpy=(30, 20, 50))
    R = pin.XYZQUATToSE3(q[:7]).rotation
    field = OrbitField(cubesat, "lvlh").magnetic
    for t in (0.0, 1500.0):
        lin = fflin.linearize(cubesat, q, t=t)
        expected = np.cross(np.eye(3), R.T @ field.at(t)).T
        assert lin.M[:3, :3] @ lin.B[6:9] == pytest.approx(expected, abs=1e-18)
        assert lin.t == t
        assert fflin.check(cubesat, lin).ok
        with pytest.raises(
            fflin.InputError, match="magnetorquers; use linearize_orbit"
        ):
            fflin.lqr(lin)
    batch = fflin.sweep(cubesat, q[None])
    with pytest.raises(fflin.InputError, match="lqr_batch does not support magnet"):
        fflin.lqr_batch(batch, 1.0, 1.0)
    with pytest.raises(fflin.InputError, match="do not support magnetorquers"):
        fflin.uncertain(cubesat, {"base.mass": 0.1})


def test_the_periodic_model_of_magnetorquers_follows_the_field(cubesat):
    along = fflin.linearize_orbit(cubesat, steps=8)
    field = OrbitField(cubesat, "lvlh").magnetic
    for k in (0, 3, 8):
        expected = np.cross(np.eye(3), field.at(along.t[k])).T
        lin = along[k]
        assert lin.M[:3, :3] @ along.B[k, 6:9] == pytest.approx(expected, abs=1e-18)
        assert lin.t == along.t[k]
    assert along.check().ok


@exhaustive
def test_a_periodic_regulator_of_magnetorquers_alone_stabilises_the_attitude(cubesat):
    along = fflin.linearize_orbit(cubesat, steps=32)
    law = fflin.tvlqr(along, 1.0, 1e4, "periodic", sample=ORBIT.period / 64)
    q0 = along.q[0].copy()
    q0[3:7] = fflin.configuration(cubesat, rpy=(2, -1, 1))[3:7]
    options = {"duration": ORBIT.period, "dt": ORBIT.period / 128}
    motion = fflin.simulate(cubesat, law, q0=q0, engine="python", **options)
    assert motion.attitude_error[-1] < 0.1 * motion.attitude_error[0]


def test_a_trajectory_must_repeat_with_the_magnetic_field(cubesat):
    rest = np.tile(cubesat.neutral(), (3, 1)), np.zeros((3, 6))
    moments = np.zeros((3, 3))
    with pytest.raises(fflin.InputError, match="period of the field"):
        times = [0.0, 50.0, 100.0]
        fflin.Trajectory(cubesat, times, *rest, moments, hold="smooth", period=100.0)
    moments[1] = 0.1
    with pytest.raises(fflin.InputError, match="expected 0; linear"):
        Linearizer(cubesat, moving=True).along(*rest, moments)


def test_magnetorquers_balance_no_forces(cubesat):
    """An equilibrium and a motion at rest leave constant torques to the other inputs."""
    wheels = [
        x for x in fflin.load_inputs("cubesat") if isinstance(x, fflin.ReactionWheel)
    ]
    robot = cubesat.replace(inputs=[fflin.BaseTorque(), *RODS])
    tilted = fflin.configuration(robot, rpy=(20, 0, 0))
    point = fflin.equilibrium(robot, tilted)
    assert np.abs(point.u[:3]).max() > 1e-9
    assert not point.u[3:].any()
    along = fflin.linearize_orbit(robot, tilted, steps=8)
    assert not along.u[:, 3:].any()
    mixed = fflin.linearize_orbit(cubesat.replace(inputs=[*wheels, *RODS]), steps=8)
    assert not mixed.u[:, 3:].any()
