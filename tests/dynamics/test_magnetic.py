"""The magnetic field along an orbit: dipoles, tilted dipoles and functions."""

import math

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.disturbance import BaseDisturbance, true_field
from fflin.dynamics.magnetic import MagneticField
from fflin.dynamics.state import StateMap
from fflin.robot.orbit import MAGNETIC_POLES
from fflin.robot.summary import robot_info

EARTH_RATE = 7.292115e-5  # [rad/s], WGS 84
INCLINATION, NODE = 1.2, 0.7

# Earth-fixed moment [T m^3] of the dipole of IGRF-14 in 2025: g11, h11, g10 [nT] times the cube of
# the reference radius. `fflin` rounds the magnitude to four digits.
G = np.array([-1410.3, 4545.5, -29350.0])
MOMENT = 29.73e-6 * 6371.2e3**3 * G / np.linalg.norm(G)

CIRCLE = {
    "altitude": 500e3,
    "inclination": INCLINATION,
    "argument_of_latitude": 0.4,
}
ELLIPSE = {
    "perigee": 500e3,
    "eccentricity": 0.3,
    "inclination": INCLINATION,
    "argument_of_perigee": 0.4,
    "anomaly": 2.0,
}
ORBITS = [
    lambda **options: fflin.CircularOrbit(**CIRCLE, **options),
    lambda **options: fflin.EllipticOrbit(**ELLIPSE, **options),
]


def about_z(angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def tilted(t, position):
    """Flux density of the earth's dipole by 3 (m r) r - m, in axes of the ascending node."""
    moment = about_z(EARTH_RATE * t - NODE) @ MOMENT
    r = np.linalg.norm(position)
    outwards = position / r
    return (3.0 * (moment @ outwards) * outwards - moment) / r**3


def of(orbit):
    """The field in hill axes: away from the earth, along the orbit, along the normal."""
    return MagneticField(orbit, np.eye(3))


def test_the_pole_is_the_geomagnetic_pole_of_2025():
    # 80.8 degrees north, 72.8 degrees west
    pole = MAGNETIC_POLES["earth"]
    assert round(90.0 - math.degrees(pole.colatitude), 1) == 80.8
    assert round(math.degrees(pole.longitude), 1) == -72.8


@pytest.mark.parametrize("orbit", ORBITS)
def test_the_tilted_dipole_is_the_field_of_the_vector_formula(orbit):
    field = of(orbit(field="tilted_dipole", node_longitude=NODE))
    given = of(orbit(field=tilted))
    for t in (0.0, 1000.0, 7e4):
        expected = given.at(t)
        assert np.abs(field.at(t) - expected).max() < 1e-13 * np.abs(expected).max()
        # The error of a central difference over 2 s is below (u' s)^2 / 6 of u' b, with u' about
        # 1e-3 rad/s.
        assert field.rate(t) == pytest.approx(given.rate(t), rel=1e-5, abs=1e-14)


@pytest.mark.parametrize("orbit", ORBITS)
def test_the_axial_dipole_has_the_derivative_of_its_field(orbit):
    field = of(orbit(field="dipole"))
    for t in (0.0, 1000.0, 7e4):
        change = (field.at(t + 0.1) - field.at(t - 0.1)) / 0.2
        assert field.rate(t) == pytest.approx(change, rel=1e-7, abs=1e-15)


def test_without_eccentricity_both_orbits_have_the_same_field():
    options = {"inclination": INCLINATION, "field": "tilted_dipole"}
    circle = of(fflin.CircularOrbit(500e3, argument_of_latitude=0.9, **options))
    options |= {"argument_of_perigee": 0.4, "anomaly": 0.5}
    ellipse = of(fflin.EllipticOrbit(perigee=500e3, eccentricity=0.0, **options))
    for t in (0.0, 4000.0):
        assert ellipse.at(t) == pytest.approx(circle.at(t), rel=1e-13)
        assert ellipse.rate(t) == pytest.approx(circle.rate(t), rel=1e-12)


def test_the_field_turns_with_the_earth():
    # A later start is an earlier longitude of the node and a later position on the orbit.
    options = {"inclination": INCLINATION, "field": "tilted_dipole"}
    first = fflin.CircularOrbit(500e3, **options)
    late = 5000.0
    second = fflin.CircularOrbit(
        500e3,
        argument_of_latitude=first.mean_motion * late,
        node_longitude=-EARTH_RATE * late,
        **options,
    )
    assert of(second).at(300.0) == pytest.approx(of(first).at(late + 300.0), rel=1e-12)


def with_rods(orbit, name="cubesat"):
    rods = [fflin.Magnetorquer(axis, max=0.2) for axis in np.eye(3)]
    return fflin.load(name, orbit=orbit, inputs=rods)


@pytest.mark.parametrize("orbit", ORBITS)
def test_a_function_moves_a_robot_as_the_tilted_dipole_does(orbit):
    motions = []
    for field in ("tilted_dipole", tilted):
        node = NODE if isinstance(field, str) else 0.0
        robot = with_rods(orbit(field=field, node_longitude=node))
        lin = fflin.linearize(robot)
        K = np.zeros((3, 12))
        K[:, 6:9] = 20.0 * np.eye(3)
        v0 = fflin.velocity(robot, {"omega_b": 0.02})
        law = fflin.StateFeedback(lin, K)
        motions.append(fflin.simulate(robot, law, v0=v0, duration=100.0, dt=5.0))
    one, other = motions
    assert np.abs(one.u).max() > 0.1
    assert np.abs(one.q - other.q).max() < 1e-12


def test_periodic_models_need_a_period_for_a_tilted_dipole():
    orbit = fflin.CircularOrbit(**CIRCLE, field="tilted_dipole")
    robot = with_rods(orbit)
    with pytest.raises(fflin.InputError, match=r"rotates with the earth.*give period="):
        fflin.linearize_orbit(robot, steps=8)
    with pytest.raises(fflin.InputError, match="differs from the field one period"):
        fflin.linearize_orbit(robot, steps=8, period=2.0 * orbit.period)
    with pytest.raises(fflin.InputError, match=r"period is -1 s, expected more than 0"):
        fflin.linearize_orbit(robot, steps=8, period=-1.0)
    # Without magnetorquers, the model does not depend on the field.
    wheels = robot.replace(inputs=[fflin.BaseTorque()])
    assert fflin.linearize_orbit(wheels, steps=8).period == orbit.period


@pytest.mark.exhaustive
@pytest.mark.parametrize("field", ["tilted_dipole", tilted])
def test_a_repeated_ground_track_gives_a_periodic_regulator(field):
    # Two orbits in one sidereal day.
    orbit = fflin.CircularOrbit(
        mean_motion=2.0 * EARTH_RATE, inclination=1.0, field=field
    )
    robot = with_rods(orbit)
    models = fflin.linearize_orbit(robot, steps=32, period=2.0 * orbit.period)
    assert models.period == 2.0 * orbit.period
    # The field after one orbit is another one.
    assert np.abs(models.B[16] - models.B[0]).max() > 0.02 * np.abs(models.B[0]).max()
    law = fflin.tvlqr(models, 1.0, 1e4, "periodic", sample=models.period / 64)
    # The cost repeats. The gain holds until the next sample, so the last two gains are equal.
    assert np.abs(law.P[-1] - law.P[0]).max() < 1e-9 * np.abs(law.P).max()
    assert law.residual < 1e-9
    assert law.loop_multipliers[0] < 1.0
    size = np.abs(law.K).max()
    assert np.array_equal(law.gain(law.period), law.K[0])
    assert np.abs(law.K[32] - law.K[0]).max() > 0.01 * size


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"field": "igrf"}, "field is 'igrf', expected 'dipole', 'tilted_dipole' or"),
        ({"field": "tilted_dipole", "body": "moon"}, "dipole of moon is not known"),
        ({"node_longitude": 100.0}, "node_longitude is 100 rad, expected"),
    ],
)
def test_refused(given, message):
    for orbit in ORBITS:
        with pytest.raises(fflin.InputError, match=message):
            orbit(**given)


@pytest.mark.parametrize("make", ORBITS)
def test_text_keeps_the_field(make):
    orbit = make(field="tilted_dipole", node_longitude=NODE)
    assert type(orbit).from_json(orbit.to_json()) == orbit
    assert type(orbit).from_json(make(field=tilted).to_json()).field is None
    assert "tilted_dipole" in orbit._repr_html_()


def test_a_residual_dipole_exerts_the_torque_m_cross_b():
    moment = np.array([0.02, -0.01, 0.03])
    robot = with_rods(ORBITS[0](field="dipole"))
    robot = robot.replace(disturbance={"residual_dipole": moment})
    q = fflin.configuration(robot, rpy=(20.0, -30.0, 50.0))
    state = StateMap(robot, frame="lvlh")
    R = pin.XYZQUATToSE3(q[:7]).rotation
    for t in (0.0, 900.0):
        wrench = BaseDisturbance(robot, state.field).wrench(t, q)
        torque = np.cross(moment, R.T @ state.field.magnetic.at(t))
        assert wrench == pytest.approx(np.r_[np.zeros(3), torque], rel=1e-14)
    # A magnetorquer with the same moment exerts the same torque.
    lin = fflin.linearize(robot, q)
    by_rods = lin.M[:3, :3] @ lin.B[6:9] @ moment
    wrench = BaseDisturbance(robot, state.field).wrench(0.0, q)
    assert by_rods == pytest.approx(wrench[3:], rel=1e-12)


def test_the_true_field_is_rotated_and_scaled_in_lvlh_axes():
    errors = {"field_scale": 0.25, "field_rotation": (0.0, 0.0, 0.3)}
    robot = with_rods(ORBITS[0](field="dipole")).replace(disturbance=errors)
    for frame in ("lvlh", "hill"):
        state = StateMap(robot, frame=frame)
        model = state.field.magnetic
        true = true_field(robot, state.field)
        # A rotation about z of lvlh, which points to the earth.
        down = -state.field.axes[:, 0]
        for t in (0.0, 900.0):
            for name in ("at", "rate"):
                b = getattr(model, name)(t)
                across = b - down * (down @ b)
                expected = 1.25 * (
                    down * (down @ b)
                    + math.cos(0.3) * across
                    + math.sin(0.3) * np.cross(down, b)
                )
                assert getattr(true, name)(t) == pytest.approx(expected, rel=1e-13)


def test_linear_models_and_equilibria_do_not_contain_the_disturbance():
    errors = {
        "residual_dipole": (0.1, 0.2, 0.3),
        "field_scale": 0.25,
        "field_rotation": (0.0, 0.0, 0.3),
    }
    robot = with_rods(ORBITS[0](field="dipole"))
    disturbed = robot.replace(disturbance=errors)
    one, other = fflin.linearize(robot), fflin.linearize(disturbed)
    assert np.array_equal(one.B, other.B) and np.array_equal(one.f0, other.f0)
    wheels = disturbed.replace(inputs=[fflin.BaseTorque(), *robot.inputs])
    held = fflin.equilibrium(wheels, disturbed=True).u
    expected = fflin.equilibrium(wheels.replace(disturbance=None)).u
    assert held == pytest.approx(expected, abs=1e-18)


def test_an_error_budget_contains_the_torque_of_the_residual_dipole():
    """The torque m x b has a constant part and a part with the rate of the orbit."""
    moment = np.array([0.02, -0.01, 0.03])
    orbit = ORBITS[0](field="dipole")
    robot = fflin.load("cubesat", orbit=orbit, inputs=[fflin.BaseTorque()])
    disturbed = robot.replace(disturbance={"residual_dipole": moment})
    q = fflin.configuration(robot, rpy=(20.0, -30.0, 50.0))
    lin = fflin.linearize(robot, q, u=fflin.equilibrium(robot, q).u)
    gain = fflin.lqr(lin)
    budget = fflin.error_budget(gain, lin, robot=disturbed)
    field = StateMap(robot, frame="lvlh").field.magnetic
    R = pin.XYZQUATToSE3(q[:7]).rotation
    # b is c + s sin(n t) + k cos(n t), here from its values at four quarters of an orbit.
    quarters = [field.at(k * orbit.period / 4.0) @ R for k in range(4)]
    mean = 0.25 * sum(quarters)
    torque = np.cross(moment, mean)
    cosine = np.cross(moment, 0.5 * (quarters[0] - quarters[2]))
    sine = np.cross(moment, 0.5 * (quarters[1] - quarters[3]))
    given = fflin.error_budget(gain, lin, disturbance={"tau_b": torque})
    assert budget.constant == pytest.approx(given.constant, rel=1e-9)
    hertz = 1.0 / orbit.period
    waves = [
        {"constant": torque},
        {"amplitude": cosine, "frequency": hertz, "phase": math.pi / 2.0},
        {"amplitude": sine, "frequency": hertz},
    ]
    waved = robot.replace(disturbance={"tau_b": waves})
    expected = fflin.error_budget(gain, lin, robot=waved)
    assert budget.total == pytest.approx(expected.total, rel=1e-9)


def test_an_error_budget_warns_of_a_tilted_dipole():
    robot = fflin.load("cubesat", orbit=ORBITS[0](field="tilted_dipole"))
    disturbed = robot.replace(disturbance={"residual_dipole": (0.1, 0.0, 0.0)})
    lin = fflin.linearize(robot, u=fflin.equilibrium(robot).u)
    with pytest.warns(fflin.FflinWarning, match="only in a circular orbit with field"):
        fflin.error_budget(fflin.lqr(lin), lin, robot=disturbed, noise={"q_b": 1e-5})


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"residual_dipole": 0.1}, "disturbance 'residual_dipole'"),
        ({"field_scale": "large"}, "disturbance 'field_scale' is 'large', expected"),
    ],
)
def test_invalid_disturbances_are_refused(given, message):
    robot = with_rods(ORBITS[0](field="dipole"))
    with pytest.raises(fflin.InputError, match=message):
        robot.replace(disturbance=given)


def test_a_residual_dipole_needs_a_field():
    robot = fflin.load("cubesat", orbit=500e3)
    with pytest.raises(fflin.InputError, match="needs a magnetic field, but 'cubesat'"):
        robot.replace(disturbance={"residual_dipole": (0.1, 0.0, 0.0)})
    with pytest.raises(fflin.UnknownNameError, match="disturbance to disperse"):
        spreads = {"residual_dipole.disturbance": 0.1}
        fflin.monte_carlo(robot, None, spreads, runs=2, duration=1.0, engine="python")


@pytest.mark.parametrize(
    "engine", ["python", pytest.param("compiled", marks=pytest.mark.compiled)]
)
@pytest.mark.parametrize("allocated", [False, True])
def test_campaigns_draw_the_residual_dipole_and_the_errors_of_the_field(
    engine, allocated
):
    if engine == "compiled":
        pytest.importorskip("numba")
    robot = with_rods(ORBITS[0](field="dipole"))
    nominal = {"residual_dipole": (0.1, 0.0, 0.0), "field_scale": 0.1}
    robot = robot.replace(disturbance=nominal)
    law = fflin.BDot(1e4)
    if allocated:
        design = robot.replace(inputs=[fflin.BaseTorque()])
        lin = fflin.linearize(design)
        K = np.zeros((3, 12))
        K[:, 6:9] = 1e-4 * np.eye(3)
        law = fflin.Allocation(fflin.StateFeedback(lin, K), design)
    spreads = {
        "residual_dipole.disturbance": 0.05,
        "field_scale.disturbance": 0.2,
        "field_rotation.x.disturbance": 0.1,
        "tau_b.y.disturbance": 1e-6,
    }
    options = {"v0": fflin.velocity(robot, {"omega_b": 0.02}), "dt": 5.0}
    campaign = fflin.monte_carlo(
        robot, law, spreads, runs=3, duration=60.0, engine=engine, **options
    )
    names = [f"residual_dipole.{axis}.disturbance" for axis in "xyz"]
    names += ["field_rotation.x.disturbance", "field_scale.disturbance"]
    assert {*names} < {*campaign.names}
    at = [campaign.names.index(name) for name in (*names, "tau_b.y.disturbance")]
    for run, drawn in enumerate(campaign.drawn[:, at].tolist()):
        x, y, z, angle, scale, torque = drawn
        total = {
            "residual_dipole": (0.1 + x, y, z),
            "field_scale": 0.1 + scale,
            "field_rotation": (angle, 0.0, 0.0),
            "tau_b": (0.0, torque, 0.0),
        }
        alone = fflin.simulate(
            robot.replace(disturbance=total),
            law,
            duration=60.0,
            engine="python",
            **options,
        )
        assert campaign.q[run] == pytest.approx(alone.q[-1], abs=1e-12)
        assert campaign.v[run] == pytest.approx(alone.v[-1], abs=1e-12)
    motion = campaign.replay(0)
    assert np.array_equal(motion.q[-1], campaign.q[0])


def test_a_robot_file_contains_the_disturbance_of_the_field(tmp_path):
    (tmp_path / "robot.toml").write_text(
        """
        urdf = "cubesat"
        orbit = { altitude = 500e3, field = "tilted_dipole", node_longitude = 0.5 }

        [disturbance]
        residual_dipole = [0.01, 0, 0.02]
        field_scale = 0.1
        field_rotation = [0.05, 0, 0]
        """
    )
    robot = fflin.load(tmp_path / "robot.toml")
    assert robot.orbit.node_longitude == 0.5
    assert robot.disturbance["residual_dipole"][0].values == (0.01, 0.0, 0.02)
    assert robot.disturbance["field_scale"][0].values == (0.1,)
    assert "0.01, 0, 0.02 A m^2 (base axes)" in " ".join(robot_info(robot).split())
