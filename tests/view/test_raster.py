"""On-off thrusters on the page: a strip for each, with every pulse and the duty."""

import base64
from dataclasses import replace

import numpy as np
import pytest

import fflin
from fflin.view.pages import panel
from tests.support.motions import settling

DUTIES = {"x_plus_top": 0.25, "y_minus_back": 0.0125, "z_minus_left": 1.0}


@pytest.fixture(scope="module")
def pulsed():
    """A cubesat with on-off thrusters, of which three fire, and a motion of it."""
    inputs = [
        replace(item, on_off=True) if isinstance(item, fflin.Thruster) else item
        for item in fflin.load_inputs("cubesat")
    ]
    robot = fflin.load("cubesat", inputs=inputs)
    motion = settling(robot, 20.0)  # rows of 0.01 s
    u = np.zeros_like(motion.u)
    fires = {name: motion.input_names.index(name) for name in DUTIES}
    u[500:1000, fires["x_plus_top"]] = 0.025
    u[:, fires["z_minus_left"]] = 0.025
    # pulses of one row, of which the frames of the page show only some
    u[100:600:20, fires["y_minus_back"]] = 0.025
    return robot, replace(motion, u=u)


def raster(robot, motion, rows):
    plots = panel(robot, motion, rows, robot.neutral()[None])["plots"]
    (plot,) = (plot for plot in plots if plot.get("raster"))
    return plot, plots


def test_a_raster_has_all_pulses_and_the_duty_of_each_thruster(pulsed):
    robot, motion = pulsed
    # The strips do not depend on the frames.
    few, many = (
        raster(robot, motion, np.arange(0, len(motion.t), step))[0] for step in (300, 3)
    )
    lines = {line["label"]: line for line in many["lines"]}
    assert {name: line["duty"] for name, line in lines.items()} == pytest.approx(DUTIES)
    cells = {
        name: np.frombuffer(base64.b64decode(line["pulses"]), np.uint8)
        for name, line in lines.items()
    }
    for line in few["lines"]:
        assert line["pulses"] == lines[line["label"]]["pulses"]
    assert (cells["z_minus_left"] == 255).all()
    on = np.flatnonzero(cells["x_plus_top"])
    assert (on[0], on[-1], len(on)) == (150, 299, 150)
    # Each of the 25 short pulses is drawn, and nothing between them.
    starts = np.flatnonzero(np.diff(np.sign(cells["y_minus_back"].astype(int))) > 0)
    assert len(starts) == 25


def test_only_on_off_thrusters_have_strips(pulsed):
    robot, motion = pulsed
    inputs = [
        replace(item, on_off=False)
        if isinstance(item, fflin.Thruster) and item.name.startswith("x_")
        else item
        for item in robot.inputs
    ]
    rows = np.arange(0, len(motion.t), 20)
    plot, plots = raster(robot.replace(inputs=inputs), motion, rows)
    labels = [line["label"] for line in plot["lines"]]
    assert labels == ["y_minus_back", "z_minus_left"]
    (steps,) = (plot for plot in plots if plot["title"] == "thrusters")
    assert [line["label"] for line in steps["lines"]] == ["x_plus_top"]


@pytest.mark.browser
def test_strips_stand_below_one_another_with_their_duty(pulsed, watch, tmp_path):
    robot, motion = pulsed
    path = tmp_path / "motion.html"
    fflin.visualize(robot, motion, html=path)
    watched = watch(path.as_uri() + "#pause", size=(1200, 700))
    watched.drawn()
    at = watched.do("fflin.plots.findIndex(({ raster }) => raster)")
    assert not watched.do("fflin.plots.some(({ title }) => title === 'thrusters')")
    canvas = watched.page.locator(".plot canvas").nth(at)
    canvas.scroll_into_view_if_needed()
    pixels, width, height = watched.do(f"""(() => {{
        const canvas = document.querySelectorAll('.plot canvas')[{at}];
        const {{ width, height }} = canvas, context = canvas.getContext('2d');
        return [[...context.getImageData(0, 0, width, height).data], width, height];
    }})()""")
    image = np.array(pixels, dtype=int).reshape(height, width, 4)
    colours = watched.do(f"fflin.plots[{at}].lines.map(({{ colour }}) => colour)")
    row = height / len(colours)
    shares = []
    for k, colour in enumerate(colours):
        strip = image[round((k + 1) * row) - 5, : width - 44]
        wanted = [*bytes.fromhex(colour[1:])]
        near = (np.abs(strip[:, :3] - wanted).max(axis=1) < 30) & (strip[:, 3] > 150)
        shares.append(near.mean())
    assert shares[0] == pytest.approx(0.25, abs=0.02)
    assert shares[2] > 0.97
    # One that is pointed at is named with its duty.
    box = canvas.bounding_box()
    watched.page.mouse.move(box["x"] + 5, box["y"] + 1.5 * row)
    told = watched.page.locator(".plot .at").nth(at).text_content()
    assert told == "y_minus_back off, duty 1.2 %"
    # Enlarged, it is a raster too.
    canvas.click(position={"x": 20, "y": 5})
    values = watched.page.locator("#large .curves output").all_text_contents()
    assert [value.split(", ")[1] for value in values] == [
        "duty 25 %",
        "duty 1.2 %",
        "duty 100 %",
    ]


@pytest.mark.browser
def test_the_panel_is_one_column_of_at_most_30_percent(watch, tmp_path):
    robot = fflin.load("servicer_7dof", inputs=fflin.load_inputs("servicer_7dof"))
    path = tmp_path / "motion.html"
    fflin.visualize(robot, settling(robot, 20.0, predicted=True), html=path)
    watched = watch(path.as_uri() + "#pause", size=(1600, 420))
    for width, height in ((1600, 420), (1600, 900), (832, 600), (720, 600)):
        watched.resize(width, height)
        panel_box = watched.page.locator("#panel").bounding_box()
        assert panel_box["width"] <= 0.3 * width + 1
        lefts = watched.do(
            "[...document.querySelectorAll('.plot')].map((each) => each.offsetLeft)"
        )
        assert len(set(lefts)) == 1
    watched.resize(832, 560)
    canvas = watched.page.locator(".plot canvas").last
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    panel_box = watched.page.locator("#panel").bounding_box()
    assert box["y"] + box["height"] <= panel_box["y"] + panel_box["height"]
    assert box["height"] >= 48
