"""Arrows of force and torque on the page: rounding errors have none, and each has a scale."""

from dataclasses import replace

import numpy as np
import pytest

import fflin
from fflin.view.page import Page
from fflin.view.pages import frame_points, marks, panel, play_back
from tests.support.motions import settling

NOISE = 3e-12  # below the threshold of the report, 1e-9 in SI units


def pushed(motion, force, torque):
    """Return the motion with a wrench on the base that fades, and no other inputs."""
    u = np.zeros_like(motion.u)
    fading = np.exp(-motion.t)
    u[:, motion.input_names.index("F_b.y")] = force * fading
    u[:, motion.input_names.index("tau_b.z")] = torque * fading
    return replace(motion, u=u)


@pytest.mark.parametrize(
    ("force", "torque", "drawn"),
    [
        (2.0, 3.0, ["force", "torque"]),
        (NOISE, 3.0, ["torque"]),
        (2.0, NOISE, ["force"]),
        (NOISE, NOISE, []),
    ],
)
def test_rounding_errors_have_neither_arrow_nor_chart(robots, force, torque, drawn):
    robot = robots["planar_detumble"]
    motion = pushed(settling(robot, 1.0), force, torque)
    page = Page(robot, motion.q[0], "space", None, None)
    film = play_back(fflin.StateMap(robot), motion.q, motion.u)
    arrows = marks(page, film, np.zeros((0, robot.n + 1, 7)))["arrows"]
    assert [arrow["kind"] for arrow in arrows] == drawn
    shown = panel(robot, motion, np.arange(0, len(motion.t), 20), motion.q[:1])
    titles = [plot["title"] for plot in shown["plots"]]
    for kind in ("force", "torque"):
        assert (f"base {kind}" in titles) == (kind in drawn)


def test_the_camera_makes_no_room_for_an_arrow_of_rounding_errors(robots):
    robot = robots["planar_detumble"]
    motion = settling(robot, 1.0)
    page = Page(robot, motion.q[0], "space", None, None)
    shown = {}
    for force in (0.0, NOISE, 2.0):
        film = play_back(fflin.StateMap(robot), motion.q, pushed(motion, force, 0.0).u)
        shown[force] = frame_points(page, film)
    np.testing.assert_array_equal(shown[NOISE], shown[0.0])
    assert np.abs(shown[2.0] - shown[0.0]).max() > 0.5 * page.size


@pytest.mark.browser
def test_the_legend_gives_the_scale_of_the_arrows_that_are_drawn(
    robots, watch, tmp_path
):
    robot = robots["planar_detumble"]
    path = tmp_path / "motion.html"
    motion = pushed(settling(robot, 1.0), NOISE, -3.0)
    fflin.visualize(robot, motion, html=path)
    watched = watch(path.as_uri() + "#pause")
    labels = watched.page.locator("#legend label").all_text_contents()
    assert [text for text in labels if "on the base" in text] == [
        "torque on the base (longest: 3.0 N m)"
    ]
    arrows = "Object.keys(viewer.scene_tree.find(['meshcat', 'wrench']).children)"
    assert watched.do(arrows) == ["torque"]
