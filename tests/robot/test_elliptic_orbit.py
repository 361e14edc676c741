"""Elliptic orbits: Kepler's equation, the rotation of the frame, and the parameters."""

import math
import pickle

import numpy as np
import pytest

import fflin
from fflin.robot.orbit import eccentric_anomaly, orbit_from_json
from tests.support.orbits import ellipse

EPS = np.finfo(float).eps


@pytest.mark.parametrize("e", [0.0, 1e-8, 0.1, 0.5, 0.9, 0.99])
def test_keplers_equation_is_solved_to_machine_precision(e):
    for mean in (*np.linspace(-math.pi, math.pi, 101), 1e-9, -1e-12, 0.0):
        E = eccentric_anomaly(float(mean), e)
        # Rounding E by one unit changes E - e sin E by at most (1 + e) eps |E|.
        assert abs(E - e * math.sin(E) - mean) <= 4.0 * EPS * max(abs(E), abs(mean))


def test_a_robot_passes_apogee_after_half_a_period_and_perigee_after_a_period():
    orbit = fflin.EllipticOrbit(perigee=400e3, apogee=2000e3)
    low = orbit.at(0.0)
    high = orbit.at(0.5 * orbit.period)
    assert low.radius == pytest.approx(orbit.body_radius + 400e3, rel=1e-14)
    assert high.radius == pytest.approx(orbit.body_radius + 2000e3, rel=1e-14)
    assert high.angle == pytest.approx(math.pi, rel=1e-12)
    assert orbit.at(3.0 * orbit.period).angle == pytest.approx(6 * math.pi, rel=1e-12)
    assert abs(low.rate_change) < 1e-16 * orbit.mean_motion**2
    # Angular momentum per mass is sqrt(mu p) everywhere.
    p = orbit.semi_major_axis * (1.0 - orbit.eccentricity**2)
    for t in np.linspace(0.0, orbit.period, 7):
        now = orbit.at(float(t))
        assert now.rate * now.radius**2 == pytest.approx(
            math.sqrt(orbit.mu * p), rel=1e-13
        )
        assert now.gradient == pytest.approx(orbit.mu / now.radius**3, rel=1e-13)


def test_rates_of_change_are_derivatives():
    orbit = ellipse(0.3, anomaly=1.0)
    h = 1e-3
    for t in (0.0, 2.0, 7.0, 13.0):
        now, before, after = (orbit.at(t + step) for step in (0.0, -h, h))
        # The error of the central difference is h^2 / 6 times the third derivative, below h^2.
        for value, change in (
            ("angle", now.rate),
            ("rate", now.rate_change),
            ("gradient", now.gradient_change),
        ):
            slope = (getattr(after, value) - getattr(before, value)) / (2.0 * h)
            assert abs(slope - change) < h**2


def test_the_anomaly_is_the_angle_at_the_start():
    for anomaly in (-3.0, -0.5, 0.0, 2.0, math.pi, 5.0):
        orbit = ellipse(0.6, anomaly=anomaly)
        assert orbit.at(0.0).angle == pytest.approx(anomaly, abs=1e-14)
        turned = orbit.at(2.0 * orbit.period).angle - anomaly
        assert turned == pytest.approx(4.0 * math.pi, rel=1e-13)


def test_without_eccentricity_the_numbers_are_those_of_a_circular_orbit():
    circle = fflin.CircularOrbit(700e3)
    orbit = fflin.EllipticOrbit(perigee=700e3, apogee=700e3)
    assert orbit.mean_motion == circle.mean_motion
    assert orbit.period == circle.period
    now = orbit.at(1234.5)
    assert now.rate == circle.mean_motion
    assert now.rate_change == 0.0
    assert now.gradient == circle.mean_motion**2
    assert now.radius == circle.radius


def test_apogee_and_eccentricity_say_the_same():
    one = fflin.EllipticOrbit(perigee=400e3, apogee=35_786e3, inclination=0.9)
    other = fflin.EllipticOrbit(perigee=400e3, eccentricity=one.eccentricity)
    assert other.apogee == pytest.approx(one.apogee, rel=1e-14)
    assert pickle.loads(pickle.dumps(one)) == one
    assert orbit_from_json(one.to_json()) == one
    assert orbit_from_json(other.to_json()) == other
    circle = fflin.CircularOrbit(400e3)
    assert orbit_from_json(circle.to_json()) == circle
    assert "400 x 35786 km over earth" in str(one)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"perigee": 4e5}, "exactly one"),
        ({"perigee": 4e5, "apogee": 5e5, "eccentricity": 0.1}, "exactly one"),
        ({"perigee": 4e5, "apogee": 3e5}, "at least the perigee"),
        ({"perigee": -4e5, "apogee": 3e5}, "not on an orbit"),
        ({"perigee": 4e5, "eccentricity": 1.0}, "eccentricity is 1"),
        ({"perigee": 4e5, "eccentricity": -0.1}, "eccentricity"),
        ({"perigee": 4e5, "apogee": 1e15}, "eccentricity"),
        ({"perigee": 4e5, "apogee": 5e5, "inclination": 51.6}, "give radians"),
        ({"perigee": 4e5, "apogee": 5e5, "anomaly": 90.0}, "give radians"),
        ({"perigee": 4e5, "apogee": 5e5, "body": "vulcan"}, "vulcan"),
        ({"perigee": 4e5, "apogee": 5e5, "mu": 1.0}, "body_radius"),
        ({"perigee": "low", "apogee": 5e5}, "'low'"),
    ],
)
def test_invalid_orbits_are_refused(given, message):
    with pytest.raises(fflin.FflinError, match=message):
        fflin.EllipticOrbit(**given)


def test_a_perigee_in_kilometres_is_refused():
    with pytest.raises(fflin.InputError, match="write 400 km as 400e3"):
        fflin.EllipticOrbit(perigee=400, apogee=500e3)


def test_robots_and_robot_files_have_elliptic_orbits(tmp_path):
    orbit = fflin.EllipticOrbit(perigee=400e3, apogee=900e3, anomaly=1.0)
    robot = fflin.load("cubesat", orbit=orbit)
    assert robot.orbit is orbit
    given = {"perigee": 400e3, "apogee": 900e3, "anomaly": 1.0}
    assert robot.replace(orbit=given).orbit == orbit
    file = tmp_path / "robot.toml"
    file.write_text(
        'urdf = "cubesat"\n[orbit]\nperigee = 400e3\napogee = 900e3\nanomaly = 1.0\n'
    )
    assert fflin.load(file).orbit == orbit
    file.write_text('urdf = "cubesat"\n[orbit]\napogee = 900e3\n')
    with pytest.raises(fflin.InputError, match=r"robot\.toml:2: .*no perigee"):
        fflin.load(file)
    with pytest.raises(fflin.UnknownNameError, match="'altitude'"):
        robot.replace(orbit={"perigee": 4e5, "altitude": 5e5})
