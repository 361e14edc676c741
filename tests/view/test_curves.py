"""Curves of a motion: the same colour for a joint in figures and on the page, names for all."""

import re

import numpy as np
import pytest

import fflin
from fflin.base.figures import COLORS, GREY
from fflin.view.pages import panel
from tests.support.motions import settling

pytest.importorskip("matplotlib")


def lines_of_figure(motion, **options):
    """Return {name: (colour, line style)} of the curves that a figure names."""
    from matplotlib.colors import to_hex

    figure = fflin.plot_motion(motion, **options)
    return {
        line.get_label(): (to_hex(line.get_color()), line.get_linestyle())
        for axes in figure.axes
        for line in axes.lines
        if not line.get_label().startswith("_")
    }


def lines_of_page(robot, motion):
    """Return {name: (colour, line style)} of the curves in the panel of a page."""
    rows = np.arange(0, len(motion.t), 20)
    plots = panel(robot, motion, rows, motion.q[:1])["plots"]
    return {
        line["label"]: (line["colour"], "-." if line["dashed"] else "-")
        for plot in plots
        for line in plot["lines"]
        if line["label"]
    }


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["canadarm2", "dual_arm", "planar_detumble"])
def test_a_joint_has_one_colour_in_all_figures_and_on_the_page(robots, name):
    robot = robots[name]
    motion = settling(robot, 2.0, predicted=True)
    figure, page = lines_of_figure(motion), lines_of_page(robot, motion)
    for joint in robot.joint_names:
        assert figure[joint] == page[joint]
    assert len({page[joint] for joint in robot.joint_names}) == robot.n
    # The colour does not depend on what else is drawn.
    last = robot.joint_names[-1]
    alone = lines_of_figure(motion, show=[f"tau_m.{last}", f"q_m.{last}"])
    assert alone[last] == page[last]


def test_a_figure_of_many_joints_names_the_eight_that_change_most():
    robot = fflin.load("anymal")
    motion = settling(robot, 2.0)
    figure, page = lines_of_figure(motion, show=["q_m"]), lines_of_page(robot, motion)
    named = {
        joint: page[joint] for joint in robot.joint_names if page[joint][0] != GREY
    }
    assert sorted(color for color, _ in named.values()) == sorted(COLORS)
    assert {name: figure[name] for name in named} == named
    assert figure[f"{robot.n - 8} more"] == (GREY, "-")
    spans = {}
    for group in ("q_m", "qdot_m", "tau_m"):
        names = (*motion.state_names, *motion.input_names)
        values = np.column_stack((motion.x, motion.u))
        of_group = {
            name.partition(".")[2]: np.ptp(values[:, k])
            for k, name in enumerate(names)
            if name.startswith(f"{group}.")
        }
        for joint, span in of_group.items():
            share = span / (max(of_group.values()) or 1.0)
            spans[joint] = max(share, spans.get(joint, 0.0))
    least = min(spans[joint] for joint in named)
    assert all(spans[joint] <= least for joint in spans if joint not in named)


@pytest.mark.browser
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_a_grey_curve_that_is_pointed_at_is_named_and_brought_out(watch, tmp_path):
    robot = fflin.load("anymal")
    motion = settling(robot, 2.0)
    path = tmp_path / "motion.html"
    fflin.visualize(robot, motion, html=path)
    watched = watch(path.as_uri() + "#pause", size=(1200, 900))
    watched.drawn()
    plots = watched.do("""fflin.plots.map(({ title, lines }) => [
        title, lines.map(({ label, colour, values }) => [label, colour, values[0]])
    ])""")
    at = next(k for k, (title, _) in enumerate(plots) if title == "joints")
    lines = plots[at][1]
    values = np.array([value for _, _, value in lines])
    grey = [k for k, (_, colour, _) in enumerate(lines) if colour == GREY]
    # the grey curve that is farthest from the others at the start
    apart = [min(abs(values[k] - np.delete(values, k))) for k in grey]
    label, _, value = lines[grey[int(np.argmax(apart))]]
    canvas = watched.page.locator(".plot canvas").nth(at)
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    low, high = (float(f(0.0, f(values))) for f in (min, max))
    every = watched.do(
        f"fflin.plots[{at}].lines.flatMap(({{ values }}) => [...values])"
    )
    low, high = min(0.0, *every), max(0.0, *every)
    spare = 0.06 * (high - low)
    low, high = low - spare * (low < 0), high + spare * (high > 0)
    y = (1 - (value - low) / (high - low)) * (box["height"] - 2) + 1
    assert "more in grey" in watched.page.locator(".plot").nth(at).text_content()

    def bright():
        return watched.do(f"""(() => {{
            const canvas = document.querySelectorAll('.plot canvas')[{at}];
            const {{ width, height }} = canvas;
            const {{ data }} = canvas.getContext('2d').getImageData(5, 0, width - 60, height);
            let count = 0;
            for (let k = 0; k < data.length; k += 4) {{
                if (Math.min(data[k], data[k + 1], data[k + 2]) > 200 && data[k + 3] > 200) count++;
            }}
            return count;
        }})()""")

    before = bright()
    watched.page.mouse.move(box["x"] + 1, box["y"] + y)
    told = watched.page.locator(".plot .at").nth(at).text_content()
    assert re.match(rf"{re.escape(label)} ", told)
    assert bright() > before + 100
    watched.page.mouse.move(box["x"] + 1, box["y"] - 200)
    assert bright() < before + 50
