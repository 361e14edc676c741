"""Figures: what they show and are named by, and the files they are saved to."""

import math
import pickle
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import fflin
from fflin.dynamics.state_rows import attitude_rotations
from fflin.simulation.plots import resting_from
from tests.support.motions import tracked
from tests.support.weights import unit_weights

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def loop():
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin, *unit_weights(lin))
    x0 = lin.x0.copy()
    x0[2] = math.sin(math.radians(10.0))
    policy = fflin.StateFeedback(lin, gain.K)
    return lin, gain, fflin.simulate(robot, policy, x0=x0, duration=3.0, every=10)


ROWS = (
    *("t", "q", "v", "x", "u", "target"),
    *("energy", "momentum", "momentum_drift", "com_drift"),
)


def lines(axes):
    return {line.get_label(): line for line in axes.get_lines()}


@pytest.mark.exhaustive
def test_motion_shows_linear_next_to_nonlinear_and_their_difference(loop):
    _, _, motion = loop
    figure = motion.plot()
    axes = {ax.get_title(): ax for ax in figure.axes if ax.get_title()}
    attitude = axes["attitude: rotation vector"]
    full, dashed = attitude.get_lines()[4], attitude.get_lines()[5]
    assert full.get_label() == "z"
    # The robot is planar, so z is the angle of the rotation.
    angle, predicted = (
        np.degrees(2.0 * np.arcsin(x[:, 2])) for x in (motion.x, motion.linear)
    )
    np.testing.assert_allclose(full.get_ydata(), angle, atol=1e-12)
    np.testing.assert_allclose(dashed.get_ydata(), predicted, atol=1e-12)
    assert attitude.get_ylabel() == "[deg]"
    assert dashed.get_linestyle() == "--"
    differences = [ax for ax in figure.axes if ax.get_ylabel().startswith("difference")]
    assert len(differences) == 6
    apart = differences[0].get_lines()[2].get_ydata()
    np.testing.assert_allclose(apart, angle - predicted, atol=1e-12)
    units = [ax.get_ylabel().partition("\n")[2] for ax in differences]
    assert units == ["[deg]", "[m]", "[deg]", "[deg/s]", "[m/s]", "[deg/s]"]
    assert axes["velocity v_b"].get_ylabel() == "[m/s]"
    torque = lines(axes["base torque"])["z"]
    np.testing.assert_array_equal(torque.get_ydata(), motion.u[:, 2])
    assert set(lines(axes["joint torques"])) == set(
        fflin.load("planar_detumble").joint_names
    )
    assert "relative momentum drift" in axes


@pytest.fixture(scope="module")
def along():
    """A run along a trajectory, and beyond its end for as long again."""
    return tracked(fflin.load("planar_detumble"), 2.0, run=4.0, limits=0.3)


def shown_rows(x):
    """The states (N, 18) of a robot with three joints, as figures show them."""
    turns = (slice(6, 12), slice(15, 18))  # joints, angular velocity, joint rates
    rows = x.copy()
    rows[:, :3] = np.degrees(attitude_rotations(x, np.zeros(18)))
    for turn in turns:
        rows[:, turn] = np.degrees(x[:, turn])
    return rows


@pytest.mark.exhaustive
def test_a_reference_is_drawn_in_a_pale_colour_below_the_motion(along):
    _, motion = along
    figure = motion.plot()
    result = panels(figure)
    titles = (
        "attitude: rotation vector",
        "position r_b",
        "joints q_m",
        "angular velocity omega_b",
    )
    titles = (*titles, "velocity v_b", "joint rates qdot_m")
    for title, start in zip(titles, range(0, 18, 3), strict=True):
        curves = [
            item for item in result[title].get_lines() if len(item.get_xdata()) > 2
        ]
        assert len(curves) == 6
        for k, (pale, flown) in enumerate(zip(curves[::2], curves[1::2], strict=True)):
            for curve, x in ((pale, motion.target), (flown, motion.x)):
                np.testing.assert_allclose(
                    curve.get_ydata(),
                    shown_rows(x)[:, start + k],
                    rtol=1e-12,
                    atol=1e-12,
                )
            assert pale.get_color() == flown.get_color() and pale.get_alpha() < 0.5
            assert pale.get_linewidth() > 2.0 * flown.get_linewidth()
    texts = [text.get_text() for axes in figure.axes for text in legend_texts(axes)]
    assert texts.count("reference") == 1
    figure = motion.plot(show=["q_m", "tau_m"])
    (named,) = figure.legends
    assert [text.get_text() for text in named.get_texts()][-2:] == [
        "reference",
        "limit",
    ]
    assert not any(legend_texts(axes) for axes in figure.axes[:-1])


def legend_texts(axes):
    return axes.get_legend().get_texts() if axes.get_legend() else []


def test_below_it_stands_the_error(along):
    _, motion = along
    figure = motion.plot()
    strips = [item for item in figure.axes if item.get_ylabel().startswith("error")]
    units = ["[deg]", "[m]", "[deg]", "[deg/s]", "[m/s]", "[deg/s]"]
    assert [item.get_ylabel() for item in strips] == [
        f"error\n{unit}" for unit in units
    ]
    flown = np.array(
        [item.get_ydata() for axes in strips for item in axes.get_lines()[:3]]
    ).T
    np.testing.assert_allclose(
        flown[:, 3:], shown_rows(motion.error)[:, 3:], rtol=1e-12, atol=1e-13
    )
    turned = motion.error[:, :3] / np.linalg.norm(
        motion.error[:, :3], axis=1, keepdims=True
    )
    np.testing.assert_allclose(
        flown[:, :3], motion.attitude_error[:, None] * turned, atol=1e-6
    )


def rests(figure):
    """The times at which lines mark that a reference rests, of each panel that has one."""
    marks = [
        [x for x in axes.get_lines() if x.get_label() == "_rest"]
        for axes in figure.axes
    ]
    return [line.get_xdata()[0] for (line,) in filter(None, marks)]


@pytest.mark.exhaustive
def test_a_line_marks_where_the_reference_comes_to_rest(along):
    traj, motion = along
    figure = motion.plot()
    assert rests(figure) == [traj.t[-1]] * (len(figure.axes) - 1)
    within = motion.t <= traj.t[-1]
    rows = {name: getattr(motion, name)[within] for name in ROWS}
    figure = replace(motion, **rows).plot()
    assert not rests(figure)


def test_motion_without_a_prediction_has_no_differences():
    robot = fflin.load("cubesat")
    motion = fflin.simulate(robot, v0=[0, 0, 0, 0.1, 0, 0.2], duration=1.0, every=10)
    figure = motion.plot()
    assert not [ax for ax in figure.axes if ax.get_ylabel().startswith("difference")]


@pytest.mark.exhaustive
def test_many_inputs_and_joints_are_named_next_to_the_panels_each_in_its_colour():
    bare = fflin.load("servicer_7dof")
    thrusters = [
        fflin.Thruster(
            "tool", (0, 0, 0), (1.0, k, 0.0), f"a_thruster_with_a_long_name_{k}"
        )
        for k in range(12)
    ]
    robot = bare.replace(inputs=[*thrusters, *bare.inputs[2:]])
    motion = fflin.simulate(robot, duration=0.05)
    figure = motion.plot()
    named = {legend.get_title().get_text(): legend for legend in figure.legends}
    shown = [text.get_text() for text in named["joints"].get_texts()]
    # Eight have colours. Nothing moves, so these are the first eight.
    assert shown == [*robot.joint_names[:8], "1 more"]
    names = [text.get_text() for text in named["thrusters"].get_texts()]
    assert names == [*motion.input_names[:8], "4 more"]
    for legend in named.values():
        colors = {line.get_color() for line in legend.get_lines()}
        assert len(colors) == len(legend.get_lines())
    axes = {item.get_title(): item for item in figure.axes}
    torques, angles = (
        {
            line.get_label().rpartition(".")[2]: line.get_color()
            for line in axes[title].get_lines()
        }
        for title in ("joint torques", "joints q_m")
    )
    assert torques == angles
    # Nothing lies on anything else.
    figure.draw_without_rendering()
    boxes = [item.get_tightbbox() for item in (*figure.axes, *figure.legends)]
    for i, one in enumerate(boxes):
        assert not any(one.overlaps(other) for other in boxes[:i])
        assert one.x0 >= 0.0
        assert one.x1 <= figure.bbox.x1 + 1.0


@pytest.fixture(scope="module")
def limited():
    """An arm with prismatic joint, thrusters and wheels, all with limits, some of which bind."""
    robot = fflin.load("servicer_7dof", limits={"qdot_m": 0.05})
    inputs = [
        fflin.BaseTorque(max=8.0),
        fflin.BaseForce(max=2e3),
        *robot.inputs[2:],
        fflin.Thruster("base", (0, 0, 0), (1, 0, 0), "main", max=22.0),
        fflin.ReactionWheel(
            (0, 0, 1), inertia=0.05, name="spin", max=2.0, max_speed=300.0
        ),
        fflin.ReactionWheel(
            (1, 0, 0), inertia=0.05, name="idle", max=2.0, max_speed=300.0
        ),
    ]
    robot = robot.replace(inputs=inputs)
    u = np.zeros(18)
    u[0], u[4], u[6], u[15], u[16] = 5.0, 400.0, 120.0, 30.0, 1.0

    def policy(t, q, v):
        return u * np.cos(0.2 * t) + u * (np.arange(18) == 16)

    v0 = fflin.velocity(robot, {"spin": 290.0, "joint_1": 0.04})
    return fflin.simulate(robot, policy, v0=v0, duration=0.02, dt=1e-3, limits="urdf")


@pytest.mark.parametrize(
    ("target", "since"), [((0, 1, 2, 3, 3), 0.75), ((0, 1, 2, 3, 4), None)]
)
def test_a_target_rests_from_where_two_rows_of_it_are_one(target, since):
    rows = np.outer(target, (1.0, 0.0))
    t = np.linspace(0.0, 1.0, 5)
    motion = SimpleNamespace(t=t, x=rows, target=rows, tracked=True, phases=())
    assert resting_from(motion) == since


def panels(figure):
    return {ax.get_title(): ax for ax in figure.axes if ax.get_title()}


def test_each_axis_has_one_unit_and_wheels_have_separate_panels(limited):
    result = panels(limited.plot())
    units = {title: axes.get_ylabel() for title, axes in result.items()}
    assert units["base torque"] == "[N m]"
    assert units["base force"] == units["thrusters"] == "[N]"
    assert units["joint torques"] == "[N m]"
    assert units["wheel speed"] == "[rad/s]"
    assert units["wheel torque"] == "[N m]"
    assert units["wheel momentum"] == "[N m s]"
    for title in ("base torque", "base force"):
        assert {"x", "y", "z"} == set(lines(result[title])) - {"limit"}
    assert {"main"} == set(lines(result["thrusters"])) - {"limit"}
    for title in ("wheel speed", "wheel torque", "wheel momentum"):
        assert set(lines(result[title])) == {"spin", "idle", "limit"}
    for title in ("joints q_m", "joint rates qdot_m"):
        assert not {"spin", "idle"} & set(lines(result[title]))
    speed = limited.x[:, limited.state_names.index("qdot_m.spin")]
    np.testing.assert_array_equal(
        lines(result["wheel speed"])["spin"].get_ydata(), speed
    )
    momentum = lines(result["wheel momentum"])["spin"].get_ydata()
    np.testing.assert_allclose(momentum, 0.05 * speed)


def levels(axes):
    """The heights of the lines of limits, and how many of them the legend would name."""
    dashed = [line for line in axes.get_lines() if line.get_linestyle() == "--"]
    named = [line for line in dashed if line.get_label() == "limit"]
    return sorted(float(line.get_ydata()[0]) for line in dashed), len(named)


def test_limits_are_drawn_where_a_curve_comes_to_a_third_of_them(limited):
    figure = limited.plot()
    result = panels(figure)
    assert levels(result["base torque"]) == ([8.0], 1)
    assert levels(result["thrusters"]) == ([22.0], 1)
    assert levels(result["joint torques"]) == ([300.0], 1)
    assert levels(result["wheel speed"]) == ([300.0], 1)
    assert levels(result["wheel momentum"]) == ([15.0], 1)
    rate = math.degrees(0.05)
    assert levels(result["joint rates qdot_m"])[0] in ([rate], [-rate, rate])
    assert levels(result["joints q_m"]) == ([], 0)
    (named,) = [x for x in figure.legends if x.get_title().get_text() == "joints"]
    assert [text.get_text() for text in named.get_texts()].count("limit") == 1


@pytest.mark.exhaustive
def test_a_motion_without_limits_has_no_lines_of_them(loop):
    _, _, motion = loop
    assert not motion.limit_names
    for axes in motion.plot().axes:
        assert "limit" not in lines(axes)


@pytest.mark.exhaustive
def test_panels_of_wheels_and_limits_do_not_lie_on_each_other(limited):
    figure = limited.plot()
    figure.draw_without_rendering()
    boxes = [item.get_tightbbox() for item in (*figure.axes, *figure.legends)]
    for i, one in enumerate(boxes):
        assert not any(one.overlaps(other) for other in boxes[:i])
        assert one.x0 >= 0.0
        assert one.x1 <= figure.bbox.x1 + 1.0


def test_the_inertias_of_wheels_are_saved_and_loaded(limited, tmp_path):
    for ending in (".npz", ".mat", ".json"):
        limited.save(tmp_path / f"m{ending}")
        result = fflin.Motion.load(tmp_path / f"m{ending}")
        np.testing.assert_array_equal(result.wheel_inertias, [0.05, 0.05])
        assert result.wheels == ("spin", "idle") or result.wheels == ("idle", "spin")


def test_attitude_through_180_degrees_has_a_gap():
    robot = fflin.load("cubesat")
    motion = fflin.simulate(robot, v0=[0, 0, 0, 0, 0, 2.0], duration=2.0)
    z = motion.plot().axes[0].get_lines()[2].get_ydata()
    assert np.isnan(z).sum() == 1
    # 2 rad/s, until it would pass 180 deg
    assert np.nanmax(np.abs(np.diff(z))) < math.degrees(0.1)
    assert 170.0 < np.nanmax(z) <= 180.0


@pytest.mark.exhaustive
@pytest.mark.parametrize("suffix", [".png", ".pdf", ".svg"])
def test_figures_are_saved_whole(loop, tmp_path, suffix):
    _, _, motion = loop
    path = tmp_path / f"loop{suffix}"
    motion.plot(path)
    start = {".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<?xml"}[suffix]
    assert path.read_bytes().startswith(start)
    assert list(tmp_path.iterdir()) == [path]


def test_invalid_figures_are_refused(loop, tmp_path, monkeypatch):
    _, _, motion = loop
    with pytest.raises(fflin.FileError, match=r"'\.bmp'"):
        motion.plot(tmp_path / "loop.bmp")
    with pytest.raises(fflin.InputError, match="Motion"):
        fflin.plot_motion(3)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(fflin.MissingPackageError, match=r"'fflin\[plot\]'"):
        motion.plot()
    assert not list(tmp_path.iterdir())


def test_a_figure_has_a_picture_and_is_unknown_to_pyplot(loop):
    from matplotlib import pyplot

    *_, motion = loop
    before = pyplot.get_fignums()
    figure = fflin.plot_motion(motion, show=["q_b"])
    assert pyplot.get_fignums() == before
    content, shown = figure._repr_png_()
    assert content.startswith(b"\x89PNG") and 400 < shown["width"] < 1000
    copied = pickle.loads(pickle.dumps(figure))
    assert type(copied) is type(figure) and len(copied.axes) == len(figure.axes)


def test_a_figure_is_not_drawn_before_it_is_shown_or_saved(loop, monkeypatch):
    from matplotlib.figure import Figure

    drawn = []
    monkeypatch.setattr(Figure, "draw", lambda *_: drawn.append(1))
    fflin.plot_motion(loop[-1], show=["q_b"])
    fflin.plot_poles(loop[1])
    assert not drawn
