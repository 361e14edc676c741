"""Pages of robots in orbit: the body that they circle is where it is, and turns with the orbit."""

import base64

import numpy as np
import pytest

import fflin
from tests.view.test_page import page_data

SIZE = WIDTH, HEIGHT = 480, 600  # of the window [px]
HALF = np.tan(np.radians(17.0))  # of the field of view


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """A page in each frame, and one of the same robot without an orbit."""
    folder, robot = tmp_path_factory.mktemp("orbit"), fflin.load("cubesat")
    for frame in ("lvlh", "hill", "hybrid"):
        flown = robot if frame == "hybrid" else robot.replace(orbit=700e3)
        motion = fflin.simulate(flown, duration=40.0, dt=0.5, frame=frame)
        fflin.visualize(flown, motion, html=folder / f"{frame}.html", open=False)
    return folder


def test_the_messages_to_pages_are_complete(pages):
    lvlh, hill, plain = (
        page_data(pages / f"{x}.html") for x in ("lvlh", "hill", "hybrid")
    )
    assert "orbit" not in plain and "up" not in plain
    orbit = fflin.CircularOrbit(700e3)
    for data in (lvlh, hill):
        assert data["orbit"]["distance"] == pytest.approx(
            orbit.radius / orbit.body_radius
        )
        assert data["orbit"]["rate"] == orbit.mean_motion
        # The axes of the screen are those of the frame, in another order.
        Q = np.array(data["up"])
        assert np.allclose(Q @ Q.T, np.eye(3)) and np.linalg.det(Q) == pytest.approx(
            1.0
        )
        assert "700 km over earth" in data["subtitle"]
    assert np.allclose(lvlh["up"], [[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    assert np.allclose(hill["up"], [[0, 1, 0], [1, 0, 0], [0, 0, -1]])


def test_an_elliptic_orbit_brings_the_direction_and_distance_of_the_earth(tmp_path):
    orbit = fflin.EllipticOrbit(perigee=500e3, eccentricity=0.3, anomaly=0.4)
    robot = fflin.load("cubesat", orbit=orbit)
    motion = fflin.simulate(robot, duration=900.0, dt=30.0)
    path = tmp_path / "elliptic.html"
    fflin.visualize(robot, motion, html=path, open=False)
    shown = page_data(path)["orbit"]
    last = orbit.at(900.0)
    for key, value in {
        "distances": last.radius / orbit.body_radius,
        "angles": last.angle - 0.4,
    }.items():
        values = np.frombuffer(base64.b64decode(shown[key]), dtype="<f4")
        assert values[-1] == pytest.approx(value, rel=1e-6)
    assert shown["farthest"] == pytest.approx(last.radius / orbit.body_radius)


def look(watched, towards, up=(0, 1, 0)):
    """Look from the orbit's point along a direction of the screen's axes, at the sky alone."""
    watched.do(
        f"""(() => {{ const c = viewer.camera; viewer.controls.update = Boolean;
        viewer.set_property(["meshcat"], "visible", false); c.clearViewOffset();
        c.position.set(0, 0, 0); c.up.set({up[0]}, {up[1]}, {up[2]});
        c.lookAt({", ".join(map(str, towards))}); c.updateMatrixWorld();
        viewer.set_dirty(); }})()"""
    )
    return watched.picture().astype(float)


@pytest.mark.browser
@pytest.mark.parametrize("frame", ["lvlh", "hill"])
def test_the_earth_is_below_in_its_true_size_and_goes_back(pages, watch, frame):
    watched = watch(
        (pages / f"{frame}.html").as_uri() + "#pause", size=SIZE, painted=True
    )
    orbit = fflin.CircularOrbit(700e3)
    dip = np.arccos(orbit.body_radius / orbit.radius)
    level = look(watched, (-np.cos(dip), -np.sin(dip), 0.0))
    blue = level[:, WIDTH // 2 - 10 : WIDTH // 2 + 10, 2].mean(axis=1)
    # the rim of the air is at the horizon
    assert abs(int(blue.argmax()) - HEIGHT / 2) < 8
    assert blue[: HEIGHT // 4].max() < 0.3 * blue.max()
    assert blue[3 * HEIGHT // 4 :].min() > 0.3 * blue.max()
    # Straight down, ahead being up: what was below is behind after some seconds.
    before = look(watched, (0, -1, 0), (1, 0, 0))
    watched.do("fflin.seek(10)")
    after = look(watched, (0, -1, 0), (1, 0, 0))
    turned = orbit.mean_motion * 10.0
    R, far = orbit.body_radius, orbit.radius
    angle = np.arctan2(R * np.sin(turned), far - R * np.cos(turned))
    expected = np.tan(angle) / HALF * HEIGHT / 2
    middle = slice(150, 350)
    misfit = [
        np.abs(after[150 + s : 350 + s, 100:380] - before[middle, 100:380]).mean()
        for s in range(-140, 141)
    ]
    assert np.argmin(misfit) - 140 == pytest.approx(expected, abs=8)
