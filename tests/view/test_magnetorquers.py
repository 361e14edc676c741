"""Magnetorquers on the page: the field, the moments and their torque are those of the motion."""

import base64

import numpy as np
import pytest

import fflin
from fflin.base.rotation import rotation_matrices
from fflin.dynamics.state import Actuation, StateMap
from fflin.view.magnetorquers import fluxes, magnetic_torque, moments, scales
from fflin.view.pages import play_back
from tests.view.test_page import page_data


@pytest.fixture(scope="module")
def flown():
    """A rotating satellite with three magnetorquers, one of them without a limit."""
    satellite = fflin.load("cubesat_magnetic")
    rods = [*satellite.inputs[:2], fflin.Magnetorquer((0, 1, 1), name="free")]
    robot = satellite.replace(inputs=rods)
    q0 = fflin.configuration(robot, rpy=(20, -30, 70))
    motion = fflin.simulate(robot, fflin.BDot(2e4), q0=q0, duration=60.0, dt=2.0)
    return robot, motion


def decoded(text, width):
    """Return the rows of an array of a page."""
    values = np.frombuffer(base64.b64decode(text), dtype="<f4")
    return values.reshape(-1, width)


def test_the_magnetic_torque_is_the_generalised_force_of_the_moments(flown):
    robot, motion = flown
    state = StateMap(robot)
    film = play_back(state, motion.q, motion.u)
    flux = fluxes(state, motion.t)
    torque = magnetic_torque(state, film.poses, motion.u, flux)
    data = robot.create_data()
    actuation = Actuation(state)
    for k in (0, 7, 30):
        state.move_to(motion.t[k])
        B = actuation.columns(data, motion.q[k])
        in_base = (B @ motion.u[k])[:3]
        R = rotation_matrices(motion.q[k : k + 1, 3:7])[0]
        np.testing.assert_allclose(R @ in_base, torque[k], rtol=0, atol=1e-18)


def test_an_arrow_has_its_longest_length_at_the_limit_or_at_the_largest_moment(flown):
    robot, motion = flown
    values = moments(StateMap(robot), motion.u)
    largest = np.abs(values).max()
    assert scales(robot, values) == [0.2, 0.2, largest]


def test_the_arrow_of_the_field_is_the_true_field():
    satellite = fflin.load("cubesat_magnetic")
    t = np.array([0.0, 500.0, 2000.0])
    assumed = fluxes(StateMap(satellite), t)
    errors = {"field_scale": 0.5, "field_rotation": [0.0, np.pi / 2, 0.0]}
    true = fluxes(StateMap(satellite.replace(disturbance=errors)), t)
    x, y, z = assumed.T  # a rotation of 90 deg about y maps x to -z, and z to x
    np.testing.assert_allclose(true, 1.5 * np.column_stack((z, y, -x)), atol=1e-19)


def test_a_robot_without_magnetorquers_has_no_field_on_its_page():
    robot = fflin.load("cubesat", orbit=500e3)
    assert fluxes(StateMap(robot), np.zeros(3)).shape == (0, 3)


@pytest.mark.browser
def test_the_page_draws_the_field_and_the_moments_of_the_motion(flown, watch, tmp_path):
    robot, motion = flown
    path = tmp_path / "motion.html"
    fflin.visualize(robot, motion, html=path, open=False)
    data = page_data(path)
    flux = fluxes(StateMap(robot), motion.t)
    shown = decoded(data["field"]["values"], 3)
    np.testing.assert_allclose(shown[[0, -1]], flux[[0, -1]], rtol=1e-6)
    assert [rod["name"] for rod in data["rods"]] == [
        "magnetorquer_1",
        "magnetorquer_2",
        "free",
    ]
    watched = watch(path.as_uri() + "#pause")
    labels = watched.page.locator("#legend label").all_text_contents()
    strongest = 1e6 * np.linalg.norm(flux, axis=1).max()
    assert f"magnetic field (longest: {strongest:.2g} µT)" in labels
    assert "magnetorquers (longest: limit)" in labels
    watched.do("fflin.seek(20)")
    row = int(np.flatnonzero(motion.t == 20.0)[0])
    arrow = "viewer.scene_tree.find(['meshcat', 'wrench', 'field']).object.children[0]"
    x, y, z, w = watched.do(f"{arrow}.quaternion.toArray()")
    along = np.array(
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]
    )
    np.testing.assert_allclose(along, flux[row] / np.linalg.norm(flux[row]), atol=1e-5)


@pytest.mark.browser
def test_night_falls_on_the_robot_only_if_the_reader_asks_for_it(watch, tmp_path):
    robot = fflin.load("cubesat", orbit=500e3)
    period = robot.orbit.period
    motion = fflin.simulate(robot, duration=period, dt=60.0)
    path = tmp_path / "motion.html"
    fflin.visualize(robot, motion, html=path, open=False)
    watched = watch(path.as_uri() + "#pause")
    light = (
        "viewer.scene_tree.find(['Lights', 'sun']).object.children[0].children[0]"
        ".intensity"
    )
    times = [0.0, 0.62 * period, 0.95 * period]
    bright = [watched.do(f"fflin.seek({t}), {light}") for t in times]
    assert len({*bright}) == 1
    watched.page.locator("#legend label.option").click()
    day, night, again = (watched.do(f"fflin.seek({t}), {light}") for t in times)
    assert day == again == bright[0]
    assert night == 0.0
