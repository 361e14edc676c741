"""Figures: what they show and are named by, and the files they are saved to."""

import math
import sys

import numpy as np
import pytest

import fflin
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


def lines(axes):
    return {line.get_label(): line for line in axes.get_lines()}


def test_motion_shows_linear_beside_nonlinear_and_their_difference(loop):
    _, _, motion = loop
    figure = motion.plot()
    axes = {each.get_title(): each for each in figure.axes if each.get_title()}
    attitude = axes["attitude q_b"]
    full, dashed = attitude.get_lines()[4], attitude.get_lines()[5]
    assert full.get_label() == "z"
    np.testing.assert_array_equal(full.get_ydata(), motion.x[:, 2])
    np.testing.assert_array_equal(dashed.get_ydata(), motion.linear[:, 2])
    assert dashed.get_linestyle() == "--"
    differences = [each for each in figure.axes if each.get_ylabel().startswith("difference")]
    assert len(differences) == 6
    apart = differences[0].get_lines()[2].get_ydata()
    np.testing.assert_array_equal(apart, motion.x[:, 2] - motion.linear[:, 2])
    assert axes["velocity v_b"].get_ylabel() == "[m/s]"
    torque = lines(axes["inputs"])["tau_b.z"]
    np.testing.assert_array_equal(torque.get_ydata(), motion.u[:, 2])
    assert set(lines(axes["joint inputs tau_m"])) == {
        name for name in motion.input_names if name.startswith("tau_m")
    }
    assert "momentum drift, relative" in axes


def test_motion_without_a_prediction_has_no_differences():
    robot = fflin.load("cubesat")
    motion = fflin.simulate(robot, v0=[0, 0, 0, 0.1, 0, 0.2], duration=1.0, every=10)
    figure = motion.plot()
    assert not [each for each in figure.axes if each.get_ylabel().startswith("difference")]


def test_many_inputs_and_joints_are_named_beside_the_panels_each_in_its_colour():
    bare = fflin.load("servicer_7dof")
    thrusters = [
        fflin.Thruster("tool", (0, 0, 0), (1.0, k, 0.0), f"a_thruster_with_a_long_name_{k}")
        for k in range(12)
    ]
    robot = bare.replace(inputs=[*thrusters, *bare.inputs[2:]])
    motion = fflin.simulate(robot, duration=0.05)
    figure = motion.plot()
    named = {legend.get_title().get_text(): legend for legend in figure.legends}
    shown = [text.get_text() for text in named["joints"].get_texts()]
    assert shown == list(robot.joint_names)
    assert len(named["inputs"].get_texts()) == 12
    for legend in named.values():
        colors = {line.get_color() for line in legend.get_lines()}
        assert len(colors) == len(legend.get_lines())
    axes = {each.get_title(): each for each in figure.axes}
    torques, angles = (
        {line.get_label().rpartition(".")[2]: line.get_color() for line in axes[title].get_lines()}
        for title in ("joint inputs tau_m", "joints q_m")
    )
    assert torques == angles
    # Nothing lies on anything else.
    figure.draw_without_rendering()
    boxes = [each.get_tightbbox() for each in (*figure.axes, *figure.legends)]
    for i, one in enumerate(boxes):
        assert not any(one.overlaps(other) for other in boxes[:i])
        assert one.x0 >= 0.0
        assert one.x1 <= figure.bbox.x1 + 1.0


def test_attitude_through_180_degrees_has_a_gap():
    robot = fflin.load("cubesat")
    motion = fflin.simulate(robot, v0=[0, 0, 0, 0, 0, 2.0], duration=2.0)
    z = motion.plot().axes[0].get_lines()[2].get_ydata()
    assert np.isnan(z).sum() == 1
    assert np.nanmax(np.abs(np.diff(z))) < 0.1


@pytest.mark.parametrize("suffix", [".png", ".pdf", ".svg"])
def test_figures_are_saved_whole(loop, tmp_path, suffix):
    _, _, motion = loop
    path = tmp_path / f"loop{suffix}"
    motion.plot(path)
    start = {".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<?xml"}[suffix]
    assert path.read_bytes().startswith(start)
    assert list(tmp_path.iterdir()) == [path]


def test_bad_figures_are_refused(loop, tmp_path, monkeypatch):
    _, _, motion = loop
    with pytest.raises(fflin.FileError, match=r"ends in '\.bmp'"):
        motion.plot(tmp_path / "loop.bmp")
    with pytest.raises(fflin.InputError, match="expected a Motion"):
        fflin.plot_motion(3)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(fflin.MissingPackageError, match=r"pip install 'fflin\[plot\]'"):
        motion.plot()
    assert not list(tmp_path.iterdir())
