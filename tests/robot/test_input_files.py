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


@pytest.mark.parametrize("start", [b"", b"\xef\xbb\xbf"], ids=["plain", "byte order mark"])
@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_order_in_the_file_is_that_of_u(written, start, ending):
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
    body = re.search(r"holds ::\n\n(.*?)\n\n +gives", text, re.DOTALL)[1]
    shown = re.search(r"gives ``(.*?)``", text)[1]
    assert fflin.load_inputs(written(dedent(body))) == eval(shown, vars(fflin) | {})


def test_bundled_sets_by_name_and_by_path():
    for path in bundled_directory().glob("*.toml"):
        assert fflin.load_inputs(path.stem) == fflin.load_inputs(path)
    servicer = fflin.load("servicer_7dof", inputs=fflin.load_inputs("servicer_7dof"))
    names = fflin.linearize(servicer).input_names
    arm = tuple(f"tau_m.joint_{number}" for number in range(1, 8))
    assert names[6:13] == arm and len(names) == 17 and not any("panel" in name for name in names)


def test_thrusters_of_cubesat_push_and_turn_every_way():
    """Pulling is not needed: nonnegative thrusts give each direction, and nothing but it."""
    thrusters = [x for x in fflin.load_inputs("cubesat") if isinstance(x, fflin.Thruster)]
    lin = fflin.linearize(fflin.load("cubesat", inputs=thrusters))
    assert len(lin.input_names) == 12
    assert np.linalg.matrix_rank(lin.B) == 6
    wrenches = lin.M @ lin.B[6:]
    # By a pair: a newton is shared by two, a newton metre is two forces at each one's lever.
    least = (1 / 0.05, 1 / 0.095, 1 / 0.045, 1.0, 1.0, 1.0)
    for total, direction in zip((*least, *least), (*np.eye(6), *-np.eye(6)), strict=True):
        found = linprog(np.ones(12), A_eq=wrenches, b_eq=direction)  # thrusts of 0 or more
        assert found.success and found.fun == pytest.approx(total, rel=1e-9)
    # All at once cancel, so that every thrust can be raised by the same amount.
    np.testing.assert_allclose(wrenches @ np.ones(12), 0.0, atol=1e-15)


CASES = {
    "": "inputs.toml: holds no inputs; write [[input]]",
    "# nothing": "inputs.toml: holds no inputs",
    "input = []": "inputs.toml: holds no inputs",
    "\n[input]\ntype = 'base_force'": ":2: input is not an array of tables; write [[input]]",
    "input = 3": ":1: input is not an array of tables",
    "input = [3]": ":1: input is not an array of tables",
    "#\n[[inputs]]\ntype = 'base_force'": ":2: no table named 'inputs'; did you mean input?",
    "#\n#\ntype = 'base_force'": ":3: no table named 'type'; there are: input; write [[input]]",
    "[[input]]\ntype = base_force": ":2: not TOML: Invalid value at column 8; mend it there",
    "[[input]]\ntype = 'base_force": ":2: not TOML: ",
    "[[input]]\ntype = 'a'\ntype = 'b'": ":3: not TOML: Cannot overwrite a value",
    b"[[input]]\n\ntype = '\xe9'": ":3: is not UTF-8 text; save it as UTF-8",
    "[[input]]": ":1: input 1: has no key 'type'; give one of base_torque, base_force,",
    "[[input]]\nTYPE = 'thruster'": ":1: input 1: has no key 'type' ('TYPE' is not); give",
    "[[input]]\n\ntype = 'truster'": ":3: no type of input named 'truster'; did you mean thruster?",
    "[[input]]\ntype = ['thruster']": ":2: no type of input named",
    "[[input]]\ntype = 'joint_torque'": ":1: input 1: a joint_torque needs the key 'joint'; add",
    "[[input]]\ntype = 'joint_torque'\njoint = 1": ":3: input 1: joint is 1, expected a name",
    "[[input]]\ntype = 'joint_torque'\njoint = ''": ":3: input 1: joint is '', expected a name",
    "[[input]]\ntype = 'base_force'\nframe = 'b'": ":3: no key of a base_force named 'frame'",
    "[[input]]\ntype = 'base_force'\n" * 2: ":3: input 2: BaseForce() stands in line 1 already",
    THRUSTER: ":1: input 1: a thruster needs the key 'direction'; add it",
    THRUSTER + "direcion = [1, 0, 0]": ":5: no key of a thruster named 'direcion'; did you mean d",
    THRUSTER + "direction = [0, 0, 0.0]": ":5: input 1: thruster direction is zero; give where",
    THRUSTER + "direction = [1, 0]": ":5: input 1: direction is [1, 0], expected three finite",
    THRUSTER + "direction = [1, 0, nan]": ":5: input 1: direction is [1, 0, nan], expected three",
    THRUSTER + "direction = [1, 0, true]": ":5: input 1: direction is [1, 0, True], expected",
    THRUSTER + f"direction = [1, 0, 1{'0' * 400}]": ":5: input 1: direction is [1, 0, 1000",
    THRUSTER + f"direction = [1, 0, 1{'0' * 9999}]": "inputs.toml: not TOML: ",
    THRUSTER + "direction.x = 1": ":5: input 1: direction is {'x': 1}, expected three finite",
    THRUSTER + "[input.direction]\nx = 1": ":5: input 1: direction is {'x': 1}, expected three",
    THRUSTER + "direction = '1 0 0'": ":5: input 1: direction is '1 0 0', expected three",
    (THRUSTER + "direction = [1, 0, 0]\nname = 'a'\n") * 2: ":12: input 2: the name 'a' stands in",
    WHEEL.replace("1]", "0]"): ":3: input 1: wheel axis is zero; give what it turns about",
    WHEEL + "inertia = 0": ":4: input 1: wheel inertia is 0 kg m^2, expected more than 0",
    WHEEL + "inertia = -1.5": ":4: input 1: wheel inertia is -1.5 kg m^2, expected more than 0",
    WHEEL + "inertia = '1'": ":4: input 1: inertia is '1', expected a finite number",
    WHEEL + "inertia = true": ":4: input 1: inertia is True, expected a finite number",
    WHEEL + "\nmomentum = inf": ":5: input 1: momentum is inf, expected a finite number",
    WHEEL + "inertia = 1\nmomentum = 2": ":5: input 1: wheel momentum is given beside an inertia",
    WHEEL + "inertias = 1": ":4: no key of a reaction_wheel named 'inertias'; did you mean inertia",
    WHEEL.replace("axis = [0, 0, 1]\n", ""): ":1: input 1: a reaction_wheel needs the key 'axis'",
    (WHEEL + "name = 'a'\n") * 2: ":8: input 2: the name 'a' stands in line 1 already",
    # What looks like keys and tables in texts and comments is none.
    "[[input]]\ntype = 'base_force'\nnote = '''\n[[input]]\nodd = 1\n'''": (
        ":3: no key of a base_force named 'note'"
    ),
    "[[input]]\ntype = 'base_force'\n[[input]]\ntype = 'joint_torque'\n"
    'joint = """\n[[input]]\nodd = 1"""  # \'\'\'\n# """\n\n odd = 1': (
        ":10: no key of a joint_torque named 'odd'; there are: type, joint"
    ),
    "\ninput = [{type = 'base_force'},\n  {type = 'odd'}]": ":2: no type of input named 'odd'",
}


@pytest.mark.parametrize("content", CASES, ids=range(len(CASES)))
def test_every_mistake_has_its_line(written, content):
    path = written(content)
    with pytest.raises(fflin.FflinError) as caught:
        fflin.load_inputs(path)
    text = str(caught.value)
    assert text.startswith(str(path)) and CASES[content] in text and "\n" not in text


def test_files_that_are_none(tmp_path, written):
    for path, words in (
        (tmp_path / "none.toml", "cannot be read: No such file"),
        (tmp_path, "is a folder; give the path of a TOML file"),
        (written(b"#" * 2**18), "is larger than 128 KiB, too large for a TOML file"),
    ):
        with pytest.raises(fflin.FileError, match=re.escape(words)):
            fflin.load_inputs(path)
    os.mkfifo(tmp_path / "pipe.toml")
    with pytest.raises(fflin.FileError, match="not a regular file"):
        fflin.load_inputs(tmp_path / "pipe.toml")
    for path in (3, None, b"a.toml", "a\0b"):
        with pytest.raises(fflin.InputError, match="is not the path of a file of inputs"):
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
