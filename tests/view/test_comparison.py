"""The linear model on the page of a motion: dashed curves, a strip along the time, a contour."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.robot.joints import ROOT
from fflin.simulation.report import TRUSTED
from fflin.view.page import Page, body_poses
from fflin.view.pages import deviation, errors, panel
from tests.support.motions import HOME, settling
from tests.view.test_layout import rows_of
from tests.view.test_panel import floats

COLOURS = {"small": "#3f8fd0", "visible": "#e6b422", "beyond": "#e0452c"}


def test_the_deviation_is_the_largest_distance_over_the_largest_displacement(robots):
    robot = robots["planar_detumble"]
    corners = Page(robot, robot.neutral(), "space", None, None).drawing.corners
    start = robot.neutral()
    flown, predicted = (np.tile(start, (3, 1)) for _ in range(2))
    flown[:, 0] += [0.5, 0.25, 0.0]
    predicted[:, 0] = flown[:, 0] + [0.0, 0.01, 0.06]
    poses = [body_poses(robot, q) for q in (flown, predicted, start[None])]
    expected = [0.0, 0.02, 0.12]
    np.testing.assert_allclose(deviation(corners, *poses), expected, atol=1e-12)
    # A joint angle counts by the distance that it moves the farthest corner of a body.
    step = fflin.velocity(robot, {"joint_1": 0.01})
    predicted = np.array([pin.integrate(robot.model, q, step) for q in flown])
    poses[1] = body_poses(robot, predicted)
    number = robot.model.getJointId("joint_1")
    axis = pin.XYZQUATToSE3(poses[0][2, number - ROOT])
    points = [
        axis.actInv(pin.XYZQUATToSE3(poses[0][2, k - ROOT]).act(point))
        for k, box in corners.items()
        if number in robot.model.supports[k].tolist()
        for point in box
    ]
    along = "XYZ".index(robot.model.joints[number].shortname()[-1])
    lever = max(np.linalg.norm(np.delete(point, along)) for point in points)
    expected = np.full(3, 2.0 * lever * np.sin(0.005) / 0.5)
    np.testing.assert_allclose(deviation(corners, *poses), expected, rtol=1e-9)


def test_a_robot_that_stays_at_its_target_has_no_deviation(robots):
    robot = robots["planar_detumble"]
    corners = Page(robot, robot.neutral(), "space", None, None).drawing.corners
    poses = body_poses(robot, np.tile(robot.neutral(), (2, 1)))
    assert deviation(corners, poses, poses + 1e-15, poses[:1]).tolist() == [0.0, 0.0]


def test_charts_of_errors_and_joints_have_the_prediction(robots):
    robot = robots["planar_detumble"]
    motion = settling(robot, 1.0, predicted=True)
    rows = np.arange(0, len(motion.t), 20)
    state = fflin.StateMap(robot, reference=HOME)
    target = state.points(motion.target[None])[1]
    predicted = state.points(motion.linear[rows])[1]
    shown = panel(robot, motion, rows, target, predicted)
    linear = {
        (plot["title"], line["label"]): floats(line["linear"])
        for plot in shown["plots"]
        for line in plot["lines"]
    }
    of_errors = errors(robot, predicted, target, motion.wheels)
    for name, factor in (("attitude", 1.0), ("position", 1e3)):
        values = factor * of_errors[name][1]
        np.testing.assert_allclose(linear[f"{name} error", ""], values, rtol=1e-6)
    for joint in robot.joint_names:
        values = motion.linear[rows, motion.state_names.index(f"q_m.{joint}")]
        values = np.degrees(values)
        np.testing.assert_allclose(linear["joints", joint], values, rtol=1e-6)
    for (title, _), values in linear.items():
        is_input = "torque" in title or "force" in title
        assert bool(len(values)) is not is_input


@pytest.mark.browser
def test_predictions_are_dashed_in_the_colour_of_their_curve(watch, tmp_path):
    robot = fflin.load("ets_vii")
    motion = settling(robot, 20.0, predicted=True)
    at = motion.state_names.index("q_m.joint_1")
    x = motion.x.copy()
    x[:, 6 : 6 + robot.n] = 0.0
    x[:, at] = 1.0
    prediction = x.copy()
    prediction[:, at] = -1.0
    path = tmp_path / "m.html"
    fflin.visualize(robot, replace(motion, x=x, prediction=prediction), html=path)
    watched = watch(path.as_uri() + "#pause", size=(1400, 900))
    watched.drawn()
    titles = watched.do("fflin.plots.map(({ title }) => title)")
    plot = titles.index("joints")
    (colour,) = watched.do(f"fflin.plots[{plot}].lines.map(({{ colour }}) => colour)")
    scale = watched.do(f"Math.max(...fflin.plots[{plot}].lines[0].values)")
    low, high = (1.12 * scale * s for s in (-1, 1))
    near, values, _ = rows_of(watched, plot, colour, low, high, least=110)
    flown, predicted = (
        near[np.abs(values - level * scale) < 0.1 * scale].any(axis=0).mean()
        for level in (1.0, -1.0)
    )
    assert flown > 0.97
    assert 0.3 < predicted < 0.85
    (key,) = watched.page.locator(".plot .dashed span").all_text_contents()
    assert key == "linear"


@pytest.fixture
def compared(robots, watch, tmp_path):
    """A motion whose prediction is right, then visibly wrong, then beyond its validity."""
    robot = robots["planar_detumble"]
    motion = settling(robot, duration=9.0, predicted=True)
    factor = np.select([motion.t < 3.0, motion.t < 6.0], [0.999, 0.93], 0.3)
    path = tmp_path / "motion.html"
    prediction = factor[:, None] * motion.x
    fflin.visualize(robot, replace(motion, prediction=prediction), html=path)
    return watch(path.as_uri() + "#pause", size=(900, 700))


@pytest.mark.browser
def test_the_strip_below_the_slider_is_coloured_by_the_deviation(compared):
    colours = compared.do("""(() => {
        const strip = document.querySelector('.track .deviation');
        const { width } = strip;
        const pixels = strip.getContext('2d').getImageData(0, 0, width, 1).data;
        return [0.5, 2.5, 3.5, 5.5, 6.5, 8.5].map((t) => {
            const k = 4 * Math.round((t / 9) * (width - 1));
            return [...pixels.slice(k, k + 3)];
        });
    })()""")
    hexes = [f"#{bytes(colour).hex()}" for colour in colours]
    assert hexes == [
        COLOURS[name] for name in ("small", "visible", "beyond") for _ in range(2)
    ]
    title = compared.page.locator(".track .deviation").get_attribute("title")
    assert "small up to 1 %" in title and f"from {100 * TRUSTED:g} %" in title
    # It lies along the way of the slider's thumb.
    strip, slider = (
        compared.page.locator(f".track {each}").bounding_box()
        for each in (".deviation", "input")
    )
    assert strip["x"] == pytest.approx(slider["x"] + 8, abs=1)
    assert strip["width"] == pytest.approx(slider["width"] - 16, abs=1)


SHOWN = """(() => {
    viewer.render();
    const { children } = viewer.scene_tree.find(['meshcat', 'linear']);
    const shown = Object.keys(children).filter((each) => !each.startsWith('<'));
    return [...new Set(shown.map((each) => children[each].object.visible))];
})()"""


@pytest.mark.browser
def test_the_contour_is_shown_only_where_it_is_three_pixels_apart(compared):
    compared.do("fflin.seek(7)")
    assert compared.do(SHOWN) == [True]
    compared.do("fflin.seek(1)")
    assert compared.do(SHOWN) == [False]
    # The distance is that on the screen: from far away nothing is apart.
    compared.do("fflin.seek(7)")
    assert compared.do(SHOWN) == [True]
    away = "viewer.camera.position.sub(viewer.controls.target).multiplyScalar({})"
    away += ".add(viewer.controls.target)"
    compared.do("viewer.controls.maxDistance = 1e6")
    compared.do(away.format(300))
    assert compared.do(SHOWN) == [False]
    compared.do(away.format(1 / 300))
    assert compared.do(SHOWN) == [True]


@pytest.mark.browser
def test_the_linear_model_is_drawn_as_a_line_about_it(compared):
    box = compared.page.get_by_label("linear model")
    drawn = {}
    for t in (1, 7):
        compared.do(f"fflin.seek({t})")
        box.check(force=True)
        whole = compared.picture()
        box.uncheck(force=True)
        bare = compared.picture()
        drawn[t] = whole[np.abs(whole - bare).max(axis=2) > 60]
    assert len(drawn[1]) == 0
    # A line, not a surface: 1.7 pixels about a robot of some hundred pixels.
    assert 300 < len(drawn[7]) < 0.02 * 900 * 700
    red, green, blue = np.median(drawn[7], axis=0)
    assert red > blue > 1.2 * green
