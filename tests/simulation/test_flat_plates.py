"""Drag and solar pressure on flat plates, compared with closed forms."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.disturbance import BaseDisturbance
from fflin.dynamics.orbital import OrbitField
from fflin.robot.flat_plate import SOLAR_PRESSURE
from tests.support.robots import free_body

BODY = free_body((4.0, 5.0, 6.0))
AREA, NORMAL, ARM = 0.3, np.array((0.0, 3.0, 4.0)) / 5.0, np.array((0.1, -0.4, 0.7))
PLATE = {"area": AREA, "normal": 2.0 * NORMAL, "position": ARM}
SUN = np.array((0.3, -0.5, 0.8))
SUN /= np.linalg.norm(SUN)


def wrench(plate, rpy=(0, 0, 0), t=0.0, orbit=None):
    """Return the force and the torque of plates, in base axes."""
    robot = BODY.replace(disturbance={"plate": plate}, orbit=orbit)
    field = OrbitField(robot, "lvlh") if orbit else None
    q = fflin.configuration(robot, rpy=rpy)
    return np.split(BaseDisturbance(robot, field).wrench(t, q), 2)


@pytest.mark.parametrize("rpy", [(0, 0, 0), (20, -30, 50)])
def test_drag_is_opposite_to_the_velocity(rpy):
    velocity = np.array((100.0, 7000.0, 2000.0))
    drag = {"density": 2e-11, "drag_coefficient": 2.5, "velocity": velocity}
    force, torque = wrench(PLATE | drag, rpy)
    R = pin.rpy.rpyToMatrix(*np.radians(rpy))
    v = R.T @ velocity
    area = AREA * NORMAL @ v / np.linalg.norm(v)
    assert area > 0.0
    expected = -0.5 * 2e-11 * 2.5 * area * np.linalg.norm(v) * v
    np.testing.assert_allclose(force, expected, rtol=1e-12)
    np.testing.assert_allclose(torque, np.cross(ARM, expected), rtol=1e-12)


def test_an_absorbing_a_mirroring_and_a_diffuse_plate_have_their_closed_forms():
    """A mirror changes the momentum along its normal only; absorbed light pushes along its ray."""
    pressure, cosine = SOLAR_PRESSURE, float(NORMAL @ SUN)
    assert cosine > 0.0
    black, _ = wrench(PLATE | {"sun": SUN})
    np.testing.assert_allclose(black, -pressure * AREA * cosine * SUN, rtol=1e-12)
    mirror, _ = wrench(PLATE | {"sun": 5.0 * SUN, "specular": 1.0})
    expected = -2.0 * pressure * AREA * cosine**2 * NORMAL
    np.testing.assert_allclose(mirror, expected, rtol=1e-12, atol=1e-22)
    # Lambert's law: the diffuse light leaves with 2/3 of its momentum along the normal.
    white, _ = wrench(PLATE | {"sun": SUN, "diffuse": 1.0})
    along = 2.0 / 3.0 * pressure * AREA * cosine * NORMAL
    np.testing.assert_allclose(white, black - along, rtol=1e-12)
    half = {"sun": SUN, "specular": 0.5, "diffuse": 0.5, "solar_pressure": 1.0}
    mixed, _ = wrench(PLATE | half)
    mean = 0.5 * (mirror + white) / pressure
    np.testing.assert_allclose(mixed, mean, rtol=1e-12)


def test_a_face_in_the_shadow_feels_nothing_unless_both_faces_are_exposed():
    away = {"sun": -SUN, "specular": 0.3, "diffuse": 0.2}
    away |= {"density": 1e-11, "velocity": -7000.0 * SUN}
    force, torque = wrench(PLATE | away)
    assert not force.any() and not torque.any()
    both, _ = wrench(PLATE | away | {"two_sided": True})
    front, _ = wrench(PLATE | away | {"normal": -NORMAL})
    np.testing.assert_allclose(both, front, rtol=1e-12)
    assert both.any()


def test_in_orbit_drag_opposes_the_orbit_and_the_sun_stays_in_inertial_space():
    orbit = fflin.CircularOrbit(500e3)
    plate = {"area": AREA, "normal": (1, 0, 0), "density": 1e-12}
    force, _ = wrench(plate, orbit=orbit)
    speed = np.sqrt(orbit.mu / orbit.radius)
    expected = -0.5 * 1e-12 * speed**2 * 2.2 * AREA
    np.testing.assert_allclose(force, (expected, 0.0, 0.0), rtol=1e-12)
    # In the frame lvlh, x points along the orbit and z to the central body. A quarter of a
    # revolution after the sun was ahead, it is below the satellite.
    sun = {"area": AREA, "normal": (0, 0, 1), "sun": (1, 0, 0)}
    assert not wrench(sun, orbit=orbit)[0].any()
    quarters = [
        wrench(sun | {"two_sided": True}, t=0.25 * k * orbit.period, orbit=orbit)[0]
        for k in (1, 2, 3)
    ]
    pressure = SOLAR_PRESSURE * AREA
    expected = np.outer((-1.0, 0.0, 1.0), (0.0, 0.0, pressure))
    found = np.abs(np.array(quarters))
    np.testing.assert_allclose(found, np.abs(expected), atol=1e-12 * pressure)
    assert quarters[0][2] * quarters[2][2] < 0.0


def test_a_simulation_gains_the_momentum_of_the_plates_and_no_linear_model_does():
    plates = [PLATE | {"sun": SUN, "solar_pressure": 0.05}, PLATE | {"sun": SUN}]
    robot = BODY.replace(disturbance={"plate": plates, "F_b": (0.01, 0, 0)})
    force, _ = wrench({**plates[0], "position": (0, 0, 0)})
    motion = fflin.simulate(robot, duration=0.5, dt=0.01)
    # The attitude changes by less than 1e-3 rad within this time.
    expected = 0.5 * (force + np.array((0.01, 0.0, 0.0))) / robot.mass * 0.5**2
    np.testing.assert_allclose(motion.q[-1, :3], expected, rtol=5e-3, atol=1e-8)
    lin, plain = fflin.linearize(robot), fflin.linearize(BODY)
    assert np.array_equal(lin.A, plain.A) and not lin.f0.any()


def test_an_equilibrium_balances_the_plates():
    plate = PLATE | {"sun": SUN, "specular": 0.4}
    robot = BODY.replace(disturbance={"plate": [plate]})
    force, torque = wrench(plate)
    held = fflin.equilibrium(robot, disturbed=True)
    expected = {"tau_b": -torque, "F_b": -force}
    for name, value in zip(held.input_names, held.u, strict=True):
        group, _, axis = name.partition(".")
        at = "xyz".index(axis)
        assert value == pytest.approx(expected[group][at], rel=1e-9)
    assert not fflin.equilibrium(robot).u.any()


def test_a_robot_file_has_plates(tmp_path):
    text = """urdf = "cubesat"
orbit = 500e3
[[disturbance.plate]]
area = 0.02
normal = [0, 1, 0]
two_sided = true
density = 1e-12
[[disturbance.plate]]
area = 0.03
normal = [0, 0, 1]
sun = [1, 0, 1]
specular = 0.1
"""
    (tmp_path / "robot.toml").write_text(text)
    robot = fflin.load(tmp_path / "robot.toml")
    first, second = robot.disturbance["plate"]
    assert first.two_sided and first.area == 0.02 and second.sun == (1.0, 0.0, 1.0)
    text = second.text("plate", orbit=True)
    assert text == "0.03 m^2, normal (0, 0, 1), solar pressure"


def test_a_dispersed_force_that_no_plate_has_is_refused():
    robot = BODY.replace(disturbance={"plate": [PLATE | {"sun": SUN}]})
    with pytest.raises(fflin.InputError, match="no flat plate of 'body' has drag"):
        fflin.monte_carlo(robot, None, {"plate_1.drag": 0.1}, runs=2, duration=1.0)


GOOD = {"area": 0.1, "normal": (0, 0, 1), "sun": (0, 0, 1)}


@pytest.mark.parametrize(
    ("plate", "message"),
    [
        (3.0, "expected a table with area"),
        ({"area": 0.1}, "has no normal"),
        (GOOD | {"normal": (0, 0, 0)}, "normal of disturbance 'plate' is zero"),
        (GOOD | {"area": -0.1}, "area of disturbance 'plate'"),
        (GOOD | {"specular": 0.6, "diffuse": 0.6}, "add to 1.2"),
        (GOOD | {"diffuse": -0.1}, "expected at least 0"),
        ({"area": 0.1, "normal": (0, 0, 1)}, "neither drag nor solar pressure"),
        ({"area": 0.1, "normal": (0, 0, 1), "density": 1e-12}, "is not in orbit"),
    ],
)
def test_an_impossible_plate_is_refused(plate, message):
    with pytest.raises(fflin.InputError, match=message):
        BODY.replace(disturbance={"plate": [plate]})


def test_an_unknown_key_of_a_plate_is_refused():
    with pytest.raises(fflin.UnknownNameError, match="key of disturbance 'plate'"):
        BODY.replace(disturbance={"plate": GOOD | {"colour": "red"}})
