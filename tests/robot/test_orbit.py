"""Circular orbits, and robots that have one."""

import math
import pickle
import sys

import pytest

import fflin
from fflin.robot.orbit import BODIES
from tests.support.patience import finished


def test_altitude_and_mean_motion_say_the_same():
    high = fflin.CircularOrbit(altitude=35_786e3)
    assert high.period == pytest.approx(86164.1, rel=1e-4)  # a sidereal day
    assert high.radius == pytest.approx(42164e3, rel=1e-4)
    assert high.mean_motion**2 * high.radius**3 == pytest.approx(high.mu, rel=1e-14)
    same = fflin.CircularOrbit(mean_motion=high.mean_motion)
    assert same.altitude == pytest.approx(high.altitude, rel=1e-12)
    assert pickle.loads(pickle.dumps(high)) == high
    assert all(type(item).from_json(item.to_json()) == item for item in (high, same))
    assert "35786 km over earth" in str(high)


def test_other_bodies():
    assert fflin.CircularOrbit(100e3, body="moon").period == pytest.approx(
        7066.0, rel=2e-3
    )
    orbit = fflin.CircularOrbit(1e3, body="bennu", mu=4.89, body_radius=245.0)
    assert orbit.mean_motion == pytest.approx(math.sqrt(4.89 / 1245.0**3))
    assert {"earth", "moon", "mars"} <= set(BODIES)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "altitude"),
        ({"altitude": 7e5, "mean_motion": 1e-3}, "exactly one"),
        ({"altitude": -1.0}, "-1 m .*not an orbit"),
        ({"altitude": 0.0}, " 0 m .*not an orbit"),
        ({"mean_motion": 2e-3}, "another mean motion"),
        ({"mean_motion": 1e-300}, "mean.motion|orbit"),
        ({"mean_motion": -1e-3}, "mean_motion"),
        ({"altitude": math.nan}, "altitude"),
        ({"altitude": "high"}, "'high'"),
        ({"altitude": 7e5, "body": "mars_2"}, "'mars_2'"),
        ({"altitude": 7e5, "mu": 4.0}, "body_radius"),
        ({"altitude": 7e5, "body": "x", "mu": 0.0, "body_radius": 1.0}, "mu"),
    ],
)
def test_refused(given, message):
    with pytest.raises(fflin.FflinError, match=message):
        fflin.CircularOrbit(**given)


@pytest.mark.parametrize(
    ("altitude", "body", "message"),
    [
        (400, "earth", "write 400 km as 400e3"),
        (550, "earth", "550 m .* at least 80 km; .* write 550 km as 550e3"),
        (35786, "earth", "write 35786 km as 35786e3"),
        (79.9e3, "earth", "79900 m"),
        (8, "earth", "write 400 km as 400e3"),
    ],
)
def test_an_altitude_in_kilometres_is_refused(altitude, body, message):
    with pytest.raises(fflin.InputError, match=message):
        fflin.CircularOrbit(altitude, body=body)


@pytest.mark.filterwarnings("error::fflin.FflinWarning")
def test_no_other_altitude_is_refused():
    # of LAGEOS, O3b, GPS
    for altitude in (80e3, 100e3, 400e3, 5860e3, 8062e3, 20200e3, 35786e3):
        fflin.CircularOrbit(altitude)
    fflin.CircularOrbit(2e3, body="moon"), fflin.CircularOrbit(6778e3, body="venus")
    fflin.CircularOrbit(680.0, body="bennu", mu=4.89, body_radius=245.0)
    fflin.CircularOrbit(mean_motion=1.2393e-3)  # as low


def test_a_robot_file_with_kilometres_is_refused_with_its_line(tmp_path):
    (tmp_path / "sat.toml").write_text('urdf = "cubesat"\norbit = 550\n')
    with pytest.raises(fflin.FflinError, match="write 550 km as 550e3") as error:
        fflin.load(tmp_path / "sat.toml")
    assert "sat.toml:2: " in str(error.value)


def test_a_robot_has_one():
    orbit = fflin.CircularOrbit(altitude=700e3)
    robot = fflin.load("cubesat", orbit=orbit)
    assert robot.orbit is orbit
    assert robot.replace(orbit=700e3).orbit == orbit
    assert robot.replace(orbit={"altitude": 700e3, "body": "earth"}).orbit == orbit
    assert robot.replace(orbit=None).orbit is None
    with pytest.raises(fflin.InputError, match="gravity"):
        robot.replace(gravity=(0, 0, -9.81))
    with pytest.raises(fflin.UnknownNameError, match="'altitud'"):
        robot.replace(orbit={"altitud": 1.0})


def test_robot_file(tmp_path):
    file = tmp_path / "robot.toml"
    file.write_text('urdf = "cubesat"\n[orbit]\naltitude = 300e3\nbody = "mars"\n')
    assert fflin.load(file).orbit == fflin.CircularOrbit(300e3, body="mars")
    file.write_text('urdf = "cubesat"\norbit = 700e3\n')
    assert fflin.load(file).orbit == fflin.CircularOrbit(700e3)
    file.write_text('urdf = "cubesat"\n\norbit = -1.0\n')
    with pytest.raises(fflin.InputError, match=r"robot\.toml:3: .*-1 m"):
        fflin.load(file)


def test_frames_suit_the_orbit():
    robot = fflin.load("cubesat")
    for given, message in ((robot, "orbit"), (robot.replace(orbit=7e5), "orbit")):
        frame = "lvlh" if given is robot else "hybrid"
        with pytest.raises(fflin.InputError, match=message):
            fflin.StateMap(given, frame=frame)
    assert fflin.StateMap(robot.replace(orbit=7e5)).frame == "lvlh"


@pytest.mark.process
def test_an_orbit_loads_no_numpy_dynamics():
    code = (
        "import fflin, sys; fflin.CircularOrbit(7e5); print('pinocchio' in sys.modules)"
    )
    done = finished(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "False"
