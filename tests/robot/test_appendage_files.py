"""Flexible appendages and slosh in robot files."""

import numpy as np
import pytest

import fflin
from fflin.base.errors import FflinError

TWO_ARRAYS = """
urdf = "servicer_7dof"

[[flexible]]
name = "left"
frame = "panel_left_link"
frequency = [0.2, 0.5]
damping = 0.01
translation = [[0, 0], [0, 0], [0.5, 0.1]]
rotation = [[0.05, 0], [0, 0], [0, 0]]

[[slosh]]
name = "tank"
frame = "base"
radius = 0.3
height = 0.4
density = 1000.0
acceleration = 0.1
pendulum = false
damping = 0.02

[[slosh]]
frame = "base"
mass = 5.0
position = [0, 0, 0.2]
length = 0.5
"""


def written(tmp_path, text):
    path = tmp_path / "robot.toml"
    path.write_text(text)
    return path


def test_robot_file_gives_the_same_robot_as_python(tmp_path):
    robot = fflin.load(written(tmp_path, TWO_ARRAYS))
    left = fflin.FlexibleAppendage(
        "panel_left_link",
        [0.2, 0.5],
        [[0, 0], [0, 0], [0.5, 0.1]],
        [[0.05, 0], [0, 0], [0, 0]],
        damping=0.01,
        name="left",
    )
    tank = fflin.Slosh.cylinder(
        "base", 0.3, 0.4, 1000.0, 0.1, pendulum=False, damping=0.02, name="tank"
    )
    swing = fflin.Slosh("base", 5.0, (0, 0, 0.2), length=0.5)
    same = fflin.load("servicer_7dof", appendages=[left, tank, swing])
    assert robot.joint_names == same.joint_names
    assert "base_slosh_x" in robot.joint_names
    one, other = fflin.linearize(robot), fflin.linearize(same)
    assert np.array_equal(one.A, other.A) and np.array_equal(one.B, other.B)


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ("frequency = [0.2, 0.5]", "frequency = [0.2, -0.5]", 7, "mode 2"),
        ("frequency = [0.2, 0.5]", "frequencies = [0.2, 0.5]", 7, "frequency"),
        ("frequency = [0.2, 0.5]\n", "", 4, "the key 'frequency'"),
        ('frame = "panel_left_link"', 'frame = "panel_lef"', 6, "panel_lef"),
        ("mass = 5.0", 'mass = "5 kg"', 23, "mass"),
        ("radius = 0.3", "radius = -0.3", 13, "radius"),
        ("[[slosh]]\nname", "[slosh]\nname", 22, "invalid TOML"),
        ("translation = [[0, 0], [0, 0], [0.5, 0.1]]", "translation = 3", 6, "shape"),
        ("[0.5, 0.1]", "[0.5, 5.1]", 4, "left_mode_2"),
        (
            'frame = "panel_left_link"',
            'frame = "base"\nop4 = "a.op4"',
            8,
            "'frequency'",
        ),
        ("mass = 5.0", "mass = 5e6", 4, "base_slosh_x"),
        ("radius = 0.3\n", "", 13, "the key 'radius'"),
    ],
)
def test_mistakes_are_reported_by_file_and_line(tmp_path, old, new, line, message):
    assert old in TWO_ARRAYS
    path = written(tmp_path, TWO_ARRAYS.replace(old, new, 1))
    with pytest.raises(FflinError) as caught:
        fflin.load(path)
    text = str(caught.value)
    assert message in text and text.startswith(f"{path}:"), text
    assert abs(int(text.split(":")[1]) - line) <= 1, text
