"""What a motion's figure is asked to show."""

import numpy as np
import pytest

import fflin
from fflin.commands.cli import main
from fflin.dynamics.state_rows import attitude_rotations

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def motion():
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    x0 = lin.x0.copy()
    x0[2], x0[6] = 0.1, 0.2
    return fflin.simulate(
        robot, fflin.StateFeedback(lin, fflin.lqr(lin).K), x0=x0, duration=1.0
    )


def drawn(motion, show):
    """The panels by their titles, with the histories of those that are named."""
    figure = motion.plot(show=show)
    return {
        axes.get_title(): {
            line.get_label(): np.asarray(line.get_ydata())
            for line in axes.get_lines()
            if not line.get_label().startswith("_")
        }
        for axes in figure.axes
        if axes.get_title() and "drift" not in axes.get_title()
    }


def test_groups_names_and_patterns_pick_panels_and_lines(motion):
    names = motion.state_names
    panels = drawn(motion, ["q_b.z", "*.joint_1", "F_b"])
    assert set(panels) == {
        *(
            "attitude: rotation vector",
            "joints q_m",
            "joint rates qdot_m",
            "base force",
            "joint torques",
        )
    }
    turned = np.degrees(attitude_rotations(motion.x, np.zeros(motion.x.shape[1])))
    np.testing.assert_allclose(
        panels["attitude: rotation vector"]["z"], turned[:, 2], atol=1e-12
    )
    np.testing.assert_array_equal(
        panels["joint rates qdot_m"]["joint_1"],
        np.degrees(1.0) * motion.x[:, names.index("qdot_m.joint_1")],
    )
    assert list(panels["joints q_m"]) == ["joint_1"]
    assert list(panels["base force"]) == ["x", "y", "z"]
    torque = panels["joint torques"]["joint_1"]
    np.testing.assert_array_equal(
        torque, motion.u[:, motion.input_names.index("tau_m.joint_1")]
    )


@pytest.mark.exhaustive
def test_states_alone_and_inputs_alone(motion):
    assert set(drawn(motion, "r_b")) == {"position r_b"}
    assert set(drawn(motion, ["tau_m"])) == {"joint torques"}
    assert drawn(motion, None).keys() == drawn(motion, ["*"]).keys()


def test_missing_packages_are_reported(motion):
    with pytest.raises(fflin.UnknownNameError, match="'thrust'"):
        motion.plot(show=["thrust"])
    with pytest.raises(fflin.InputError, match="show"):
        motion.plot(show=3)


def test_show_on_the_command_line(tmp_path, capsys):
    path = tmp_path / "a.svg"
    options = [
        "--duration",
        "0.5",
        "--plot",
        str(path),
        "--show",
        "r_b",
        "--show",
        "tau_m",
    ]
    assert main(["simulate", "planar_detumble", "--rpy", "0", "0", "5", *options]) in (
        0,
        1,
    )
    assert path.stat().st_size and "wrote" in capsys.readouterr().out
