"""Robots from TOML files: what is read, what goes before it, and the place of every mistake."""

import re
import time
import warnings
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

import fflin
from fflin.robot.catalog import bundled_directory
from fflin.robot.loading import KEYS
from tests.support.messages import says
from tests.support.robots import BUNDLED

WHOLE = """
urdf = "servicer_7dof"
passive = ["panel_*"]
lock = { joint_7 = 0.5 }
outputs = ["com", "frame:tool"]
gravity = [0, 0, -1e-6]
damping = 0.2

[[input]]
type = "base_torque"
[[input]]
type = "base_force"
[[input]]
type = "joint_torque"
joint = "*"
[[input]]
type = "reaction_wheel"
name = "rw"
axis = [0, 0, 1]
inertia = 0.01

[stiffness]
"panel_*" = 80
q_m.panel_left = 100.0

[rest]
panel_left = 0.1

[weights]
rule = "identity"
[weights.q]
q_m.joint_1 = 3
q_b = 7
[weights.bryson]
tau_b = 2
qdot_m.rw = 10

[start]
joints = { joint_2 = 0.4, "panel_*" = 0.05 }
rpy = [20, 0, -10]
position = [1, 2, 3]
[start.velocity]
omega_b.z = 0.01
rw = 50
"""


AT_REST = WHOLE.replace("gravity", "# gravity").replace("panel_left = 0.1\n", "")


@pytest.fixture
def written(tmp_path):
    def write(content, name="sat.toml"):
        path = tmp_path / name
        path.write_text(content)
        return path

    return write


def test_a_robot_file_is_equivalent_to_the_arguments_of_load(written):
    robot = fflin.load(written(WHOLE))
    messages = fflin.load(
        "servicer_7dof",
        lock={"joint_7": 0.5},
        passive=["panel_left", "panel_right"],
        inputs=[
            fflin.BaseTorque(),
            fflin.BaseForce(),
            *(fflin.JointTorque(f"joint_{k}") for k in range(1, 7)),
            fflin.ReactionWheel((0, 0, 1), inertia=0.01, name="rw"),
        ],
        outputs=[
            fflin.CenterOfMass(),
            fflin.FramePose("tool"),
            fflin.FrameVelocity("tool"),
        ],
        stiffness={"panel_left": 100.0, "panel_right": 80.0},
        damping=0.2,
        rest={"panel_left": 0.1},
        gravity=(0.0, 0.0, -1e-6),
        weights={
            "rule": "identity",
            "q": {"q_m.joint_1": 3.0, "q_b": 7.0},
            "bryson": {"tau_b": 2.0, "qdot_m.rw": 10.0},
        },
    )
    assert robot.name == "sat" and robot.urdf == messages.urdf
    for key in (
        *(
            "urdf_sha256",
            "joints",
            "locked",
            "inputs",
            "outputs",
            "stiffness",
            "damping",
            "rest",
        ),
        *("gravity", "weights", "passive", "wheels"),
    ):
        assert getattr(robot, key) == getattr(messages, key), key
    assert robot.model == messages.model
    assert robot.passive == ("panel_left", "panel_right")
    assert robot.start == {
        "joints": {"joint_2": 0.4, "panel_left": 0.05, "panel_right": 0.05},
        "rpy": (20.0, 0.0, -10.0),
        "position": (1.0, 2.0, 3.0),
        "velocity": {"omega_b.z": 0.01, "qdot_m.rw": 50.0},
    }


def test_urdf_lies_next_to_the_file_wherever_that_is_named_from(
    written, tmp_path, monkeypatch
):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "own.urdf").write_bytes(
        (bundled_directory() / "ets_vii.urdf").read_bytes()
    )
    path = written('urdf = "deep/own.urdf"\npackage_dirs = ["deep", "/x"]\n')
    robot = fflin.load(path)
    assert robot.urdf == tmp_path / "deep" / "own.urdf" and robot.n == 6
    assert [str(folder) for folder in robot.package_dirs[:2]] == [
        str(tmp_path / "deep"),
        "/x",
    ]
    monkeypatch.chdir(tmp_path / "deep")
    assert fflin.load("../sat.toml").n == 6
    one = 'urdf = "ets_vii"\npassive = "joint_1"\nlock = "joint_2"\noutputs = "com"\n'
    assert fflin.load(written(one)).locked == ("joint_2=0.0",)
    assert fflin.load(written('urdf = "talos"\nlock = ["arm_*"]')).name == "sat"


def test_bundled_robot_files_are_asked_for_by_their_whole_name():
    for name in ("cubesat", "servicer_7dof"):
        assert fflin.load(name).inputs != fflin.load_inputs(name)
        robot = fflin.load(f"{name}.toml")
        assert robot.inputs == fflin.load_inputs(name)
        assert robot.urdf_sha256 == fflin.load(name).urdf_sha256 and robot.name == name
    with pytest.raises(fflin.FileError, match=r"'cubesats.toml'"):
        fflin.load("cubesats.toml")


def test_arguments_override_the_file(written):
    path = written(WHOLE)
    robot = fflin.load(
        path, stiffness={"panel_right": 9}, lock={"joint_1": 0.1}, gravity=(0, 0, 0)
    )
    assert robot.locked == ("joint_7=0.5", "joint_1=0.1")
    assert robot.stiffness == {"panel_left": 100.0, "panel_right": 9.0}
    assert robot.gravity == (0.0, 0.0, 0.0)
    # What the file says of a joint that is locked by the caller is not missed.
    assert "q_m.joint_1" not in robot.weights["q"] and robot.weights["q"] == {
        "q_b": 7.0
    }
    assert fflin.load(path, lock={"joint_7": 0.2}).locked == ("joint_7=0.2",)
    both = fflin.load(path, lock=["panel_*"])
    assert both.passive == () and both.stiffness == {} and both.rest == {}
    assert both.start["joints"] == {"joint_2": 0.4}
    one = fflin.load(path, lock=["panel_left"])
    assert one.stiffness == {"panel_right": 80.0} and one.passive == ("panel_right",)
    # Other inputs, without the wheel that the start knows.
    base = robot.replace(inputs=[fflin.BaseTorque(), fflin.JointTorque("*")])
    assert base.start["velocity"] == {"omega_b.z": 0.01}
    assert [item.joint for item in base.inputs[1:]] == [
        f"joint_{k}" for k in range(2, 7)
    ]


@pytest.mark.parametrize("inputs", [(), "named"])
def test_passive_joints_have_no_torque(inputs):
    fields = {"inputs": [fflin.BaseTorque(), fflin.JointTorque("*")]} if inputs else {}
    robot = fflin.load("servicer_7dof", passive=["panel_*"], **fields)
    names = fflin.linearize(robot).input_names
    assert names[-7:] == tuple(f"tau_m.joint_{k}" for k in range(1, 8))
    fewer = robot.replace(passive=["q_m.joint_1", "panel_right"])
    assert fewer.passive == ("joint_1", "panel_right")
    assert fewer.inputs == tuple(
        x for x in robot.inputs if x != fflin.JointTorque("joint_1")
    )


def test_passive_joints_and_inputs_do_not_contradict():
    robot = fflin.load("servicer_7dof", passive=["panel_*"])
    with pytest.raises(fflin.InputError, match="'panel_left'"):
        robot.replace(inputs=[fflin.JointTorque("panel_left")])
    with pytest.raises(fflin.InputError, match="'panel_left'"):
        fflin.load("servicer_7dof", lock=["panel_left"], passive=["panel_left"])
    with pytest.raises(fflin.InputError, match="input"):
        fflin.load("ets_vii", inputs=[fflin.JointTorque("joint_1")]).replace(
            passive="joint_1"
        )
    with pytest.raises(fflin.UnknownNameError, match="'pannel'"):
        robot.replace(passive=["pannel"])


URDF = 'urdf = "servicer_7dof"\n'
INPUT = "[[input]]\ntype = "
CASES = {
    INPUT + "'base_force'": "sat.toml: urdf",
    "": "sat.toml: urdf",
    "passive = ['a']": "sat.toml: `urdf`",
    URDF + '"a\\u001b[31m\\u0007" = 1': r"sat.toml 'a\x1b[31m\x07'",
    URDF + '[stiffness]\n"a\\u001b" = "x"': r"sat.toml 'a\x1b'",
    URDF + "pasive = ['panel_left']": ":2: 'pasive'",
    URDF + "tides = 1\n": ":2: 'tides'",
    URDF + "orbit = 'low'\n": ":2: 'low'",
    URDF + "[orbit]\nheight = 1.0\n": "sat.toml 'height'",
    URDF + "[[inputs]]\ntype = 'base_force'": ":2: 'inputs'",
    URDF + INPUT + "'base_forces'": ":3: 'base_forces'",
    "urdf = 3": ":1: robot",
    URDF + (INPUT + "'base_force'\n") * 2: ":2: 'F_b.x'",
    "#\nurdf = 'nosuch'": ":2: 'nosuch'",
    "#\nurdf = 'no/such.urdf'": "sat.toml no/such.urdf'",
    "urdf = 'sat.toml'": "sat.toml URDF",
    URDF + "lock = 3": ":2: lock",
    URDF + "\nlock = ['joint_9']": ":3: 'joint_9'",
    URDF + "[lock]\njoint_1 = 0\njoint_9 = 1": ":4: 'joint_9'",
    URDF + "[lock]\njoint_1 = 'a'": ":3: 'a'",
    URDF + "passive = ['panel_left', 3]": ":2: passive",
    URDF + "passive = ['panel_*', 'hinge']": ":2: 'hinge'",
    URDF + "passive = ['panel_left']\nlock = ['panel_left']": (":2: 'panel_left'"),
    URDF
    + "passive = ['panel_left']\n"
    + INPUT
    + "'joint_torque'\njoint = 'panel_left'": (":5: 'panel_left'"),
    URDF + "outputs = ['com', 'frame:nosuch']": ":2: 'nosuch'",
    URDF + "outputs = ['comm']": ":2: 'comm'",
    URDF + "gravity = [0, 0]": ":2: [0, 0]",
    URDF + "gravity = '123'": ":2: '123'",
    URDF + "stiffness = true": ":2: True",
    URDF + "[stiffness]\n#\npanel_left = -1": ":4: 'panel_left'",
    URDF + "[stiffness]\npanel_left = '1'": ":3: '1'",
    URDF + "[stiffness]\n#\npanel = 1": ":4: 'panel'",
    URDF + "[stiffness]\n'hinge_*' = 1": ":3: 'hinge_*'",
    URDF + "[damping]\njoint_1 = inf": ":3: 'joint_1'",
    URDF + "damping = 'all'": ":2: 'all'",
    URDF + "rest = 1": ":2: rest",
    URDF + "lock = ['joint_1']\n[rest]\njoint_1 = 1": ":4: 'joint_1'",
    URDF + "weights = 3": ":2: weights",
    URDF + "[weights]\nQ.q_b = 3": ":3: 'Q'",
    URDF + "[weights]\nrule = 'none'": ":3: 'none'",
    URDF + "[weights.q]\nq_b = 3\ntau_b = 3": ":4: 'tau_b'",
    URDF + "[weights.r]\n'tau_m.*' = 0": ":3: 'tau_m.*'",
    URDF + "[weights.q]\nq_b = 3\n[weights.bryson]\nq_b = 3": "sat.toml 'q_b'",
    URDF + "[start]\nrpy = [0, 0]": ":3: [0, 0]",
    URDF + "[start]\nrpz = [0, 0, 1]": ":3: 'rpz'",
    URDF + "[start.joints]\njoint_1 = 1\njoint_9 = 0": ":4: 'joint_9'",
    URDF + "[start.velocity]\nomega_b.w = 1": ":3: 'omega_b.w'",
    URDF + "[stiffness]\na.b.c.d = 'x'": ":3: 'a.b.c.d'",
}


@pytest.mark.parametrize("content", CASES, ids=range(len(CASES)))
def test_every_mistake_has_its_line(written, content):
    path = written(content)
    with pytest.raises(fflin.FflinError) as caught:
        fflin.load(path)
    text = str(caught.value)
    line, _, keyword = CASES[content].partition(" ")
    assert text.startswith(str(path)) and "\n" not in text
    assert line in text and keyword in text, text


def test_errors_of_the_caller_are_not_those_of_the_file(written):
    path = written(URDF + "lock = ['joint_1']\n")
    for fields in ({"lock": ["joint_99"]}, {"stiffness": {"joint_99": 1}}):
        with pytest.raises(fflin.UnknownNameError) as caught:
            fflin.load(path, **fields)
        assert "joint_99" in str(caught.value) and "sat.toml" not in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        URDF + "a=" + "[" * 100_000,
        URDF + "lock." + "a." * 60_000 + "a=1",
        pytest.param(
            URDF
            + "[stiffness]\n"
            + "".join(f"{'a.' * 900}b{k} = 1\n" for k in range(60)),
            marks=pytest.mark.exhaustive,
        ),
        pytest.param(
            URDF + "[stiffness]\n" + "".join(f"j{k} = 1\n" for k in range(10_000)),
            marks=pytest.mark.exhaustive,
        ),
        URDF + "passive = [" + '"?*?*?*?*?*?*?*?*x", ' * 5_000 + "]",
        pytest.param(
            URDF + INPUT + "'joint_torque'\njoint = '" + "*?" * 50_000 + "'",
            marks=pytest.mark.exhaustive,
        ),
    ],
    ids=["nested", "dotted", "deep", "keys", "patterns", "pattern"],
)
def test_hostile_files_are_refused_in_time(written, content):
    path = written(content)
    begin = time.process_time()
    with pytest.raises(fflin.FflinError):
        fflin.load(path)
    assert time.process_time() - begin < 5.0


def test_models_of_a_file_are_distinguished_from_those_of_its_urdf(written, tmp_path):
    plain = fflin.load("servicer_7dof")
    robot = fflin.load(written(AT_REST))
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin)
    with pytest.raises(fflin.InputError, match=r"'sat'.*rw"):
        fflin.simulate(plain, fflin.StateFeedback(lin, gain.K), duration=0.1)
    batch = fflin.sweep(robot, [robot.neutral()], out=tmp_path / "a.npz")
    with pytest.raises(fflin.InputError, match="batch"):
        fflin.LinearBatch.load(tmp_path / "a.npz", plain)
    assert fflin.LinearBatch.load(tmp_path / "a.npz", robot)[0].weights == robot.weights
    assert batch[0].weights == robot.weights


@pytest.mark.parametrize("ending", ["npz", "mat", "json"])
def test_a_regulator_uses_the_weights_of_the_robot(written, tmp_path, ending):
    robot = fflin.load(written(AT_REST))
    lin = fflin.linearize(robot)
    Q, R = np.eye(len(lin.x0)), np.eye(len(lin.u0))
    states, inputs = lin.state_names.index, lin.input_names.index
    Q[states("q_m.joint_1"), states("q_m.joint_1")] = 3.0
    for axis in "xyz":
        Q[states(f"q_b.{axis}"), states(f"q_b.{axis}")] = 7.0
        R[inputs(f"tau_b.{axis}"), inputs(f"tau_b.{axis}")] = 0.25
    Q[states("qdot_m.rw"), states("qdot_m.rw")] = 0.01
    # Held where there is something to hold: the angle of the wheel is not.
    lin.save(tmp_path / f"m.{ending}")
    loaded = fflin.LinearModel.load(tmp_path / f"m.{ending}")
    assert loaded.weights == lin.weights == robot.weights
    for model in (lin, loaded):
        gain = fflin.lqr(model)
        np.testing.assert_allclose(gain.K, fflin.lqr(lin, Q, R).K, rtol=1e-9, atol=1e-9)
        assert says(gain.weights, "q_b, q_m.joint_1, tau_b, qdot_m.rw")
    assert says(fflin.lqr(lin, weights="urdf").weights, "limits")


@pytest.mark.parametrize("name", BUNDLED)
def test_every_bundled_robot_in_a_file_is_itself(written, name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plain, robot = fflin.load(name), fflin.load(written(f'urdf = "{name}"\n'))
    assert robot.model == plain.model and robot.inputs == plain.inputs
    assert fflin.linearize(robot).A.tobytes() == fflin.linearize(plain).A.tobytes()


# Values whose structure is that of no key.
STRANGE = (
    *(
        "[[1, 2, 3]]",
        "[[]]",
        "[1, [2], 3]",
        "[['joint_1']]",
        "[{a = 'x'}]",
        "[{a = 1}]",
    ),
    *(
        "{a = [[1]]}",
        "{joint_1 = {a = {}}}",
        "true",
        "1979-05-27",
        "inf",
        "['\\u0000', []]",
    ),
    *(
        "{q = {q_b = [[1]]}}",
        "{rpy = [[1], 2, 3]}",
        "{altitude = 5e5, body = ['earth']}",
    ),
)


@pytest.mark.parametrize("value", STRANGE)
@pytest.mark.parametrize("key", KEYS)
def test_a_value_of_a_strange_structure_is_one_line(key, value, written):
    head = "" if key == "urdf" else 'urdf = "planar_detumble"\n'
    with pytest.raises(fflin.FflinError, match=r"sat\.toml:") as caught:
        fflin.load(written(f"{head}{key} = {value}\n"))
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


def test_the_draft_and_the_guide_have_every_key():
    draft = files("fflin.robot").joinpath("assets", "robot.toml").read_text("utf-8")
    guide = (Path(__file__).parents[2] / "docs/guide/robot_keys.inc").read_text("utf-8")
    described = re.findall(r"^\| `\[*(\w+)\]*` \| .", guide, re.MULTILINE)
    assert sorted(described) == sorted(KEYS)
    for name in KEYS:
        written = (f"[[{name}]]", f"[{name}]", f"{name} = ", f"${name}")
        assert any(item in draft for item in written), name
