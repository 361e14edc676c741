"""The magnetic field along an orbit: dipoles, tilted dipoles and functions."""

import math

import numpy as np
import pytest

import fflin
from fflin.dynamics.magnetic import MagneticField
from fflin.robot.orbit import MAGNETIC_POLES

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
    size = np.abs(law.K).max()
    assert np.abs(law.K[-1] - law.K[0]).max() < 1e-9 * size
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
