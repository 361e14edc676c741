"""Inputs from TOML files: what is read, the bundled sets, and the place of every mistake."""

import os
import re
import time

import numpy as np
import pytest
from scipy.optimize import linprog

import fflin
from fflin.robot.catalog import bundled_directory

WHOLE = """
# every type, in an order of its own
[[input]]
type = "thruster"
frame = "tool"
position = [0.1, 2, -3e-1]
direction = [0, 0, 2]

[[ input ]]
type = 'joint_torque'
joint = "joint_1"
[["input"]]
"type" = "base_force"
[[input]]
name = "main" # a comment
type = "thruster"
frame = "base"
position = [
  0,
  0, 0,
]
direction = [1.0, 0, 0]
[[input]]
type = "base_torque"
[[input]]
type = "reaction_wheel"
axis = [0, 2, 0]
inertia = 1e-3
[[input]]
type = "reaction_wheel"
frame = "tool"
axis = [0, 0, 1]
momentum = -2
name = "spare"
"""
WHEEL = '[[input]]\ntype = "reaction_wheel"\naxis = [0, 0, 1]\n'
THRUSTER = '[[input]]\ntype = "thruster"\nframe = "base"\nposition = [0, 0, 0]\n'


@pytest.fixture
def written(tmp_path):
    def write(content):
        path = tmp_path / "inputs.toml"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


@pytest.mark.parametrize(
    "start", [b"", b"\xef\xbb\xbf"], ids=["plain", "byte order mark"]
)
@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_order_in_the_file_matches_u(written, start, ending):
    path = written(start + WHOLE.replace("\n", ending).encode())
    inputs = (
        fflin.Thruster("tool", (0.1, 2, -0.3), (0, 0, 1)),
        fflin.JointTorque("joint_1"),
        fflin.BaseForce(),
        fflin.Thruster("base", (0, 0, 0), (1, 0, 0), "main"),
        fflin.BaseTorque(),
        fflin.ReactionWheel((0, 1, 0), inertia=1e-3),
        fflin.ReactionWheel((0, 0, 1), "tool", name="spare", momentum=-2),
    )
    assert fflin.load_inputs(path) == fflin.load_inputs(str(path)) == inputs
    lin = fflin.linearize(fflin.load("ets_vii", inputs=inputs))
    assert lin.input_names[::4] == ("thruster_1", "F_b.z", "tau_b.z")
    assert lin.input_names[-2:] == ("wheel_1", "spare")
    assert lin.input_names[5] == "main"


def test_example_of_the_docstring(written):
    from textwrap import dedent

    text = fflin.load_inputs.__doc__
    body = re.search(r"content ::\n\n(.*?)\n\n *gives", text, re.DOTALL)[1]
    shown = re.search(r"gives the inputs\s+``(.*?)``", text)[1]
    assert fflin.load_inputs(written(dedent(body))) == eval(shown, vars(fflin) | {})


def test_bundled_sets_by_name_and_by_path():
    for path in bundled_directory().glob("*.toml"):
        assert fflin.load_inputs(path.stem) == fflin.load_inputs(path)
    servicer = fflin.load("servicer_7dof", inputs=fflin.load_inputs("servicer_7dof"))
    names = fflin.linearize(servicer).input_names
    arm = tuple(f"tau_m.joint_{number}" for number in range(1, 8))
    assert (
        names[6:13] == arm
        and len(names) == 17
        and not any("panel" in name for name in names)
    )


def test_thrusters_of_cubesat_push_and_turn_every_way():
    """Pulling is not needed: nonnegative thrusts give each direction, and nothing but it."""
    thrusters = [
        x for x in fflin.load_inputs("cubesat") if isinstance(x, fflin.Thruster)
    ]
    lin = fflin.linearize(fflin.load("cubesat", inputs=thrusters))
    assert len(lin.input_names) == 12
    assert np.linalg.matrix_rank(lin.B) == 6
    wrenches = lin.M @ lin.B[6:]
    # By a pair: a newton is shared by two, a newton metre is two forces at each one's lever.
    least = (1 / 0.05, 1 / 0.095, 1 / 0.045, 1.0, 1.0, 1.0)
    for total, direction in zip(
        (*least, *least), (*np.eye(6), *-np.eye(6)), strict=True
    ):
        # thrusts of 0 or more
        result = linprog(np.ones(12), A_eq=wrenches, b_eq=direction)
        assert result.success and result.fun == pytest.approx(total, rel=1e-9)
    # All at once cancel, so that every thrust can be raised by the same amount.
    np.testing.assert_allclose(wrenches @ np.ones(12), 0.0, atol=1e-15)


CASES = {
    "": "inputs.toml: [[input]]",
    "# nothing": "inputs.toml: [[input]]",
    "input = []": "inputs.toml: [[input]]",
    "\n[input]\ntype = 'base_force'": ":2: [[input]]",
    "input = 3": ":1: [[input]]",
    "input = [3]": ":1: [[input]]",
    "#\n[[inputs]]\ntype = 'base_force'": ":2: 'inputs'",
    "#\n#\ntype = 'base_force'": ":3: 'type'",
    "[[input]]\ntype = base_force": ":2: column 8",
    "[[input]]\ntype = 'base_force": ":2: TOML",
    "[[input]]\ntype = 'a'\ntype = 'b'": ":3: TOML",
    b"[[input]]\n\ntype = '\xe9'": ":3: utf-8",
    "[[input]]": ":1: 'type'",
    "[[input]]\nTYPE = 'thruster'": ":1: 'type'",
    "[[input]]\n\ntype = 'truster'": ":3: 'truster'",
    "[[input]]\ntype = ['thruster']": ":2: type",
    "[[input]]\ntype = 'joint_torque'": ":1: 'joint'",
    "[[input]]\ntype = 'joint_torque'\njoint = 1": ":3: joint",
    "[[input]]\ntype = 'joint_torque'\njoint = ''": ":3: ''",
    "[[input]]\ntype = 'base_force'\nframe = 'b'": ":3: 'frame'",
    THRUSTER: ":1: 'direction'",
    THRUSTER + "direcion = [1, 0, 0]": ":5: 'direcion'",
    THRUSTER + "direction = [0, 0, 0.0]": ":5: direction",
    THRUSTER + "direction = [1, 0]": ":5: [1, 0]",
    THRUSTER + "direction = [1, 0, nan]": ":5: nan",
    THRUSTER + "direction = [1, 0, true]": ":5: True",
    THRUSTER + f"direction = [1, 0, 1{'0' * 400}]": ":5: 1000",
    THRUSTER + f"direction = [1, 0, 1{'0' * 9999}]": "inputs.toml: TOML",
    THRUSTER + "direction.x = 1": ":5: {'x': 1}",
    THRUSTER + "[input.direction]\nx = 1": ":5: {'x': 1}",
    THRUSTER + "direction = '1 0 0'": ":5: '1 0 0'",
    WHEEL.replace("1]", "0]"): ":3: axis",
    WHEEL + "inertia = 0": ":4: inertia",
    WHEEL + "inertia = -1.5": ":4: -1.5",
    WHEEL + "inertia = '1'": ":4: '1'",
    WHEEL + "inertia = true": ":4: True",
    WHEEL + "\nmomentum = inf": ":5: inf",
    WHEEL + "inertia = 1\nmomentum = 2": ":5: momentum",
    WHEEL + "inertias = 1": ":4: 'inertias'",
    WHEEL.replace("axis = [0, 0, 1]\n", ""): ":1: 'axis'",
    # What looks like keys and tables in texts and comments is none.
    "[[input]]\ntype = 'base_force'\nnote = '''\n[[input]]\nodd = 1\n'''": (
        ":3: 'note'"
    ),
    "[[input]]\ntype = 'base_force'\n[[input]]\ntype = 'joint_torque'\n"
    'joint = """\n[[input]]\nodd = 1"""  # \'\'\'\n# """\n\n odd = 1': (":10: 'odd'"),
    "\ninput = [{type = 'base_force'},\n  {type = 'odd'}]": ":2: 'odd'",
    WHEEL + "inertia = 0\nname = 'spin'": ":4: 'spin'",
    "[[input]]\ntype = 'thruster'\nname = 'jet'": ":1: ('jet')",
}


@pytest.mark.parametrize("content", CASES, ids=range(len(CASES)))
def test_every_mistake_has_its_line(written, content):
    path = written(content)
    with pytest.raises(fflin.FflinError) as caught:
        fflin.load_inputs(path)
    text = str(caught.value)
    line, _, keyword = CASES[content].partition(" ")
    assert text.startswith(str(path)) and "\n" not in text
    assert line in text and keyword in text


def test_invalid_files_are_refused(tmp_path, written):
    for path, words in (
        (tmp_path / "none.toml", "No such file"),
        (tmp_path, "folder"),
        (written(b"#" * 2**18), "128 KiB"),
    ):
        with pytest.raises(fflin.FileError, match=re.escape(words)):
            fflin.load_inputs(path)
    os.mkfifo(tmp_path / "pipe.toml")
    with pytest.raises(fflin.FileError, match="regular file"):
        fflin.load_inputs(tmp_path / "pipe.toml")
    for path in (3, None, b"a.toml", "a\0b"):
        with pytest.raises(fflin.InputError, match="path"):
            fflin.load_inputs(path)


@pytest.mark.parametrize(
    "content",
    [
        "a=" + "[" * 100_000,
        "#\n" + "a." * 60_000 + "a=1",
        "[[input]]\n" * 13_000,
        "a='''" + '"' * 120_000,
    ],
    ids=["nested", "dotted", "tables", "quotes"],
)
def test_hostile_files_are_refused_in_time(written, content):
    path = written(content)
    begin = time.process_time()
    with pytest.raises(fflin.FflinError):
        fflin.load_inputs(path)
    assert time.process_time() - begin < 5.0
