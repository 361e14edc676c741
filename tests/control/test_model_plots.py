"""Figures of linear models: what they draw is what was computed, and can be read."""

import math
from dataclasses import replace

import numpy as np
import pytest

import fflin
from tests.support.figures import assert_legible, texts
from tests.support.messages import says
from tests.support.robots import mostly

pytest.importorskip("matplotlib")


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("name", "inputs"),
    [
        pytest.param("cubesat", "cubesat", marks=pytest.mark.exhaustive),
        ("canadarm2", None),
        pytest.param("servicer_7dof", "servicer_7dof", marks=pytest.mark.exhaustive),
    ],
)
def test_the_pattern_matches_a_and_b_by_groups(name, inputs):
    robot = fflin.load(name)
    lin = fflin.linearize(
        robot.replace(inputs=fflin.load_inputs(inputs)) if inputs else robot
    )
    figure = fflin.plot_matrices(lin)
    assert_legible(figure)
    for axes, values, names in zip(
        figure.axes, (lin.A, lin.B), (lin.state_names, lin.input_names), strict=False
    ):
        drawn = axes.get_images()[0].get_array()
        shown = ~np.ma.getmaskarray(drawn)
        np.testing.assert_array_equal(drawn[shown], np.abs(values[shown]))
        # What is left out is zero, or lost in the rounding of the largest.
        assert np.abs(values[~shown]).max(initial=0.0) < 1e-15 * np.abs(values).max()
        assert (values[~shown] == 0.0).mean() > 0.5
        members = [label.get_text() for label in axes.get_xticklabels()]
        assert members == list(names)
    written = [text for text, _ in texts(figure)]
    assert any("SI units" in text for text in written)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    "name", mostly(["planar_detumble", "talos"], "planar_detumble")
)
def test_patterns_of_sampled_robots_can_be_read(name):
    sampled = fflin.linearize(fflin.load(name)).discretize(0.1)
    figure = fflin.plot_matrices(sampled)
    assert_legible(figure)
    assert f"{name}, frame hybrid, sampled every 0.1 s" in [
        text for text, _ in texts(figure)
    ]


@pytest.mark.exhaustive
def test_patterns_of_none_can_be_read():
    empty = replace(
        fflin.linearize(fflin.load("cubesat")),
        B=np.zeros((12, 6)),
        A=np.zeros((12, 12)),
    )
    assert_legible(fflin.plot_matrices(empty))


def bars(figure):
    """Heights of the filled and of the outlined bars, by their line and column."""
    filled, outlined = {}, {}
    for bar in figure.axes[0].patches:
        line, column = bar.get_y(), bar.get_x() + bar.get_width() / 2.0
        (filled if bar.get_fill() else outlined)[line, round(column)] = bar.get_height()
    return filled, outlined


@pytest.mark.parametrize("name", mostly(["servicer_7dof", "talos"], "servicer_7dof"))
def test_bars_are_the_shapes_of_the_modes(name):
    robot = fflin.load(name, stiffness=20.0, damping=0.3)
    result = fflin.modes(fflin.linearize(robot))
    figure = fflin.plot_modes(result)
    assert_legible(figure)
    filled, outlined = bars(figure)
    half = len(result.state_names) // 2
    shapes = np.array([mode.shape[:half] for mode in result.modes])
    drawn = np.array(
        [[filled[line, i] for i in range(half)] for line in range(len(shapes))]
    )
    # The axis points down, and a bar of 1 leaves room for that of the next line.
    np.testing.assert_allclose(-drawn / 0.45, shapes.real, atol=1e-12)
    late = np.abs(shapes.imag) > 0.02 * np.abs(shapes)
    assert {place for place, shown in np.ndenumerate(late) if shown} == set(outlined)
    for place, height in outlined.items():
        assert abs(height) == pytest.approx(0.45 * abs(shapes[place]))
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    for label, mode in zip(labels, result.modes, strict=True):
        if mode.oscillates:
            hertz = mode.frequency / (2.0 * math.pi)
            damping = f"damping {mode.damping_ratio:.2g}"
            assert label == f"{mode.frequency:.3g} rad/s, {hertz:.3g} Hz, {damping}"
        else:
            assert label == f"real, decays in {mode.time_constant:.3g} s"


def test_units_of_a_shape_have_their_colours():
    lin = fflin.linearize(fflin.load("tiago_no_hand", stiffness=50.0))
    figure = fflin.plot_modes(fflin.modes(lin))
    legend = figure.legends[0]
    settings = {
        text.get_text(): patch.get_facecolor()
        for text, patch in zip(legend.get_texts(), legend.get_patches(), strict=True)
    }
    assert set(settings) == {"[1]", "[m]", "[rad]"} and len(set(settings.values())) == 3
    first = figure.axes[0].patches[: len(lin.state_units) // 2]
    for bar, unit in zip(first, lin.state_units, strict=False):
        assert bar.get_facecolor() == settings[f"[{unit}]"]


def test_modes_that_grow_and_robots_without_modes():
    robot = fflin.load("servicer_7dof", gravity=(0.0, 0.0, -9.81))
    hover = fflin.linearize(robot, u=fflin.equilibrium(robot).u)
    figure = fflin.plot_modes(fflin.modes(hover))
    assert_legible(figure)
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    growing = [mode for mode in fflin.modes(hover).unstable if not mode.oscillates]
    assert sum("grows in" in label for label in labels) == len(growing) > 0
    floating = fflin.plot_modes(fflin.modes(fflin.linearize(fflin.load("canadarm2"))))
    assert_legible(floating)
    ((message, _),) = texts(floating)
    assert says(message, "canadarm2", "0 vibrations", "0 real", "13 rigid-body")


@pytest.mark.parametrize("wrong", [False, True])
def test_errors_of_a_check_are_drawn_with_their_tolerances(wrong):
    robot = fflin.load("servicer_7dof")
    lin = fflin.linearize(robot)
    result = fflin.check(robot, replace(lin, B=1.001 * lin.B) if wrong else lin)
    assert result.ok is not wrong
    figure = fflin.plot_check(result)
    assert_legible(figure)
    axes = figure.axes[0]
    names = [label.get_text() for label in axes.get_yticklabels()]
    lines = {(line.get_label(), line.get_marker()): line for line in axes.get_lines()}
    shown = [row for row in result.rows if row.error]
    for row in shown:
        block = row.test in ("ABA derivatives", "differences")
        place = names.index(row.block if block else f"{row.test}: {row.block}")
        points = lines[row.test, "o"]
        at = np.flatnonzero(np.abs(points.get_ydata() - place) < 0.4)
        assert points.get_xdata()[at] == [row.error]
        bounds = next(
            line
            for (_, marker), line in lines.items()
            if marker == "|" and line.get_color() == points.get_color()
        )
        assert bounds.get_xdata()[at] == [row.tolerance]
    failed = next(line for (_, marker), line in lines.items() if marker == "x")
    assert sorted(failed.get_xdata()) == sorted(row.error for row in result.failures)
    exact = len(result.rows) - len(shown)
    title = axes.get_title(loc="left")
    assert f"{exact} " in title
    assert ("FAILED" if wrong else "OK") in title
    assert axes.get_xscale() == "log"


@pytest.fixture(scope="module")
def reach():
    robot = fflin.load("ets_vii")
    bent = {name: 0.3 + 0.1 * i for i, name in enumerate(robot.joint_names)}
    lin = fflin.linearize(robot, fflin.configuration(robot, bent))
    return fflin.validity(robot, lin, fflin.lqr(lin), attitude=60.0, samples=4)


@pytest.mark.compiled
def test_validity_reports_the_slope_that_is_drawn(reach):
    figure = fflin.plot_validity(reach)
    assert_legible(figure)
    left, right = figure.axes
    curve = left.get_lines()[0]
    x, y = (np.log(item) for item in (curve.get_xdata(), curve.get_ydata()))
    drawn = float(np.polyfit(x[:4], y[:4], 1)[0])
    assert drawn == pytest.approx(1.0, abs=0.1)
    assert curve.get_label() == f"relative error, ~ displacement^{drawn:.2f}"
    np.testing.assert_allclose(curve.get_ydata(), 100.0 * reach.prediction_error)
    heights = [sum(bar.get_height() for bar in group) for group in right.containers]
    assert heights == [reach.settled, 4 - reach.settled]


@pytest.mark.compiled
@pytest.mark.parametrize(
    ("name", "unit"),
    [("ets_vii", "rad"), ("cubesat", "rad|m"), ("tiago_no_hand", "rad|m")],
)
def test_joints_that_all_turn_are_displaced_by_radians(reach, name, unit):
    from fflin.campaign.validity import joint_unit

    assert joint_unit(fflin.linearize(fflin.load(name))) == unit
    assert reach.joint_unit == "rad"
    assert "0.5 m and 1 rad;" in fflin.plot_validity(reach).get_suptitle()
    assert "rad|m" not in str(reach) and "1 rad" in " ".join(str(reach).split())


@pytest.mark.compiled
def test_validity_of_runs_that_leave_the_chart_can_be_drawn(tmp_path):
    robot = fflin.load("cubesat")
    lin = fflin.linearize(robot)
    gain = fflin.acceleration_lqr(lin, 1.0, 1.0, 1.0)
    result = fflin.validity(robot, lin, gain, attitude=170.0, samples=12)
    figure = fflin.plot_validity(result, tmp_path / "validity.png")
    assert_legible(figure)
    known = np.isfinite(result.prediction_error)
    curve = figure.axes[0].get_lines()[0]
    np.testing.assert_allclose(
        curve.get_ydata()[known], 100.0 * result.prediction_error[known]
    )
    assert (tmp_path / "validity.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        ("plot_matrices", r"fflin\.LinearModel"),
        ("plot_modes", r"fflin\.modes"),
        ("plot_check", r"fflin\.check"),
        ("plot_validity", r"fflin\.validity"),
        ("plot_loops", r"fflin\.lqr"),
        ("plot_poles", "poles"),
    ],
)
def test_an_invalid_result_is_refused(function, expected):
    with pytest.raises(fflin.InputError, match=expected):
        getattr(fflin, function)("stable" if function == "plot_poles" else 3)
