"""Robots from TOML files: what is read, what goes before it, and the place of every mistake."""

import re
import time
import warnings

import numpy as np
import pytest

import fflin
from fflin.robot.catalog import bundled_directory
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


def test_a_file_says_what_load_would_be_told(written):
    robot = fflin.load(written(WHOLE))
    told = fflin.load(
        "servicer_7dof",
        lock={"joint_7": 0.5},
        passive=["panel_left", "panel_right"],
        inputs=[
            fflin.BaseTorque(),
            fflin.BaseForce(),
            *(fflin.JointTorque(f"joint_{k}") for k in range(1, 7)),
            fflin.ReactionWheel((0, 0, 1), inertia=0.01, name="rw"),
        ],
        outputs=[fflin.CenterOfMass(), fflin.FramePose("tool"), fflin.FrameVelocity("tool")],
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
    assert robot.name == "sat" and robot.urdf == told.urdf
    for key in (
        *("urdf_sha256", "joints", "locked", "inputs", "outputs", "stiffness", "damping", "rest"),
        *("gravity", "weights", "passive", "wheels"),
    ):
        assert getattr(robot, key) == getattr(told, key), key
    assert robot.model == told.model
    assert robot.passive == ("panel_left", "panel_right")
    assert robot.start == {
        "joints": {"joint_2": 0.4, "panel_left": 0.05, "panel_right": 0.05},
        "rpy": (20.0, 0.0, -10.0),
        "position": (1.0, 2.0, 3.0),
        "velocity": {"omega_b.z": 0.01, "qdot_m.rw": 50.0},
    }


def test_urdf_lies_beside_the_file_wherever_that_is_named_from(written, tmp_path, monkeypatch):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "own.urdf").write_bytes(
        (bundled_directory() / "ets_vii.urdf").read_bytes()
    )
    path = written('urdf = "deep/own.urdf"\npackage_dirs = ["deep", "/x"]\n')
    robot = fflin.load(path)
    assert robot.urdf == tmp_path / "deep" / "own.urdf" and robot.n == 6
    assert [str(folder) for folder in robot.package_dirs[:2]] == [str(tmp_path / "deep"), "/x"]
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
    with pytest.raises(fflin.FileError, match=r"no file at 'cubesats.toml'"):
        fflin.load("cubesats.toml")


def test_what_is_told_goes_before_the_file(written):
    path = written(WHOLE)
    robot = fflin.load(path, stiffness={"panel_right": 9}, lock={"joint_1": 0.1}, gravity=(0, 0, 0))
    assert robot.locked == ("joint_7=0.5", "joint_1=0.1")
    assert robot.stiffness == {"panel_left": 100.0, "panel_right": 9.0}
    assert robot.gravity == (0.0, 0.0, 0.0)
    # What the file says of a joint that is locked by the caller is not missed.
    assert "q_m.joint_1" not in robot.weights["q"] and robot.weights["q"] == {"q_b": 7.0}
    assert fflin.load(path, lock={"joint_7": 0.2}).locked == ("joint_7=0.2",)
    both = fflin.load(path, lock=["panel_*"])
    assert both.passive == () and both.stiffness == {} and both.rest == {}
    assert both.start["joints"] == {"joint_2": 0.4}
    one = fflin.load(path, lock=["panel_left"])
    assert one.stiffness == {"panel_right": 80.0} and one.passive == ("panel_right",)
    # Other inputs, without the wheel that the start knows.
    base = robot.replace(inputs=[fflin.BaseTorque(), fflin.JointTorque("*")])
    assert base.start["velocity"] == {"omega_b.z": 0.01}
    assert [item.joint for item in base.inputs[1:]] == [f"joint_{k}" for k in range(2, 7)]


@pytest.mark.parametrize("inputs", [(), "named"])
def test_passive_joints_have_no_torque(inputs):
    fields = {"inputs": [fflin.BaseTorque(), fflin.JointTorque("*")]} if inputs else {}
    robot = fflin.load("servicer_7dof", passive=["panel_*"], **fields)
    names = fflin.linearize(robot).input_names
    assert names[-7:] == tuple(f"tau_m.joint_{k}" for k in range(1, 8))
    fewer = robot.replace(passive=["q_m.joint_1", "panel_right"])
    assert fewer.passive == ("joint_1", "panel_right")
    assert fewer.inputs == tuple(x for x in robot.inputs if x != fflin.JointTorque("joint_1"))


def test_passive_joints_and_inputs_do_not_contradict():
    robot = fflin.load("servicer_7dof", passive=["panel_*"])
    with pytest.raises(fflin.InputError, match="'panel_left' is passive and has a joint torque"):
        robot.replace(inputs=[fflin.JointTorque("panel_left")])
    with pytest.raises(fflin.InputError, match="'panel_left' is locked and passive; leave one"):
        fflin.load("servicer_7dof", lock=["panel_left"], passive=["panel_left"])
    with pytest.raises(fflin.InputError, match="leaves no input"):
        fflin.load("ets_vii", inputs=[fflin.JointTorque("joint_1")]).replace(passive="joint_1")
    with pytest.raises(fflin.UnknownNameError, match="no joint named 'pannel'"):
        robot.replace(passive=["pannel"])


URDF = 'urdf = "servicer_7dof"\n'
INPUT = "[[input]]\ntype = "
CASES = {
    INPUT + "'base_force'": "sat.toml: holds inputs alone; add urdf = ",
    "": "sat.toml: holds inputs alone; add urdf",
    "passive = ['a']": "sat.toml: has no `urdf`; a robot file begins with it: add urdf = ",
    URDF + '"a\\u001b[31m\\u0007" = 1': r"named 'a\x1b[31m\x07'",
    URDF + '[stiffness]\n"a\\u001b" = "x"': r": stiffness.a\x1b is 'x', expected",
    URDF + "pasive = ['panel_left']": ":2: no key of a robot file named 'pasive'; did you mean pas",
    URDF + "tides = 1\n": ":2: no key of a robot file named 'tides'",
    URDF + "orbit = 'low'\n": ":2: orbit is 'low', expected a finite number",
    URDF + "[orbit]\nheight = 1.0\n": "no part of orbit named 'height'",
    URDF + "[[inputs]]\ntype = 'base_force'": ":2: no key of a robot file named 'inputs'; did you",
    URDF + INPUT + "'base_forces'": ":3: no type of input named 'base_forces'; did you mean base_f",
    "urdf = 3": ":1: urdf is 3, expected a name in quotes",
    "#\nurdf = 'nosuch'": ":2: no robot named 'nosuch'",
    "#\nurdf = 'no/such.urdf'": "no/such.urdf'; give a URDF's path or a name",
    "urdf = 'sat.toml'": "expected a URDF or a robot's name",
    URDF + "lock = 3": ":2: lock is 3, expected a name in quotes",
    URDF + "\nlock = ['joint_9']": ":3: no joint to lock named 'joint_9'; did you mean",
    URDF + "[lock]\njoint_1 = 0\njoint_9 = 1": ":4: no joint to lock named 'joint_9'",
    URDF + "[lock]\njoint_1 = 'a'": ":3: lock.joint_1 is 'a', expected a finite number",
    URDF + "passive = ['panel_left', 3]": ":2: passive is 3, expected a name in quotes",
    URDF + "passive = ['panel_*', 'hinge']": ":2: no joint named 'hinge'",
    URDF + "passive = ['panel_left']\nlock = ['panel_left']": (
        ":2: joint 'panel_left' is locked in line 3; leave one out"
    ),
    URDF + "passive = ['panel_left']\n" + INPUT + "'joint_torque'\njoint = 'panel_left'": (
        ":5: joint 'panel_left' is passive and has a joint torque; leave one out"
    ),
    URDF + "outputs = ['com', 'frame:nosuch']": ":2: no frame named 'nosuch'",
    URDF + "outputs = ['comm']": ":2: no output named 'comm'; did you mean com",
    URDF + "gravity = [0, 0]": ":2: gravity is [0, 0], expected three numbers",
    URDF + "gravity = '123'": ":2: gravity is '123', expected a finite number",
    URDF + "stiffness = true": ":2: stiffness is True, expected a finite number",
    URDF + "[stiffness]\n#\npanel_left = -1": ":4: stiffness of joint 'panel_left' is -1, expected",
    URDF + "[stiffness]\npanel_left = '1'": ":3: stiffness.panel_left is '1', expected a finite",
    URDF + "[stiffness]\n#\npanel = 1": ":4: no joint named 'panel'; did you mean panel_",
    URDF + "[stiffness]\n'hinge_*' = 1": ":3: no joint named 'hinge_*'",
    URDF + "[damping]\njoint_1 = inf": ":3: damping.joint_1 is inf, expected a finite number",
    URDF + "damping = 'all'": ":2: damping is 'all', expected 'urdf', a number or a mapping",
    URDF + "rest = 1": ":2: rest is 1, expected a mapping {joint: position}",
    URDF + "lock = ['joint_1']\n[rest]\njoint_1 = 1": ":4: joint 'joint_1' is locked in line 2; l",
    URDF + "weights = 3": ":2: weights is 3, expected a mapping of rule, q, r, bryson",
    URDF
    + "[weights]\nQ.q_b = 3": ":3: no part of weights named 'Q'; there are: rule, q, r, bryson",
    URDF + "[weights]\nrule = 'none'": ":3: no rule of weights named 'none'; there are: urdf, id",
    URDF + "[weights.q]\nq_b = 3\ntau_b = 3": ":4: no state named 'tau_b'; did you mean",
    URDF + "[weights.r]\n'tau_m.*' = 0": ":3: r of 'tau_m.*' is 0, expected more than 0",
    URDF + "[weights.q]\nq_b = 3\n[weights.bryson]\nq_b = 3": "'q_b' has a weight and a largest",
    URDF + "[start]\nrpy = [0, 0]": ":3: start rpy is [0, 0], expected three numbers",
    URDF + "[start]\nrpz = [0, 0, 1]": ":3: no part of start named 'rpz'; did you mean rpy?",
    URDF + "[start.joints]\njoint_1 = 1\njoint_9 = 0": ":4: no joint named 'joint_9'",
    URDF + "[start.velocity]\nomega_b.w = 1": ":3: no velocity named 'omega_b.w'; did you mean",
    URDF + "[stiffness]\na.b.c.d = 'x'": ":3: stiffness.a.b.c.d is 'x', expected",
}


@pytest.mark.parametrize("content", CASES, ids=range(len(CASES)))
def test_every_mistake_has_its_line(written, content):
    path = written(content)
    with pytest.raises(fflin.FflinError) as caught:
        fflin.load(path)
    text = str(caught.value)
    assert text.startswith(str(path)) and CASES[content] in text and "\n" not in text, text


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
        URDF + "[stiffness]\n" + "".join(f"{'a.' * 900}b{k} = 1\n" for k in range(60)),
        URDF + "[stiffness]\n" + "".join(f"j{k} = 1\n" for k in range(10_000)),
        URDF + "passive = [" + '"?*?*?*?*?*?*?*?*x", ' * 5_000 + "]",
        URDF + INPUT + "'joint_torque'\njoint = '" + "*?" * 50_000 + "'",
    ],
    ids=["nested", "dotted", "deep", "keys", "patterns", "pattern"],
)
def test_hostile_files_are_refused_in_time(written, content):
    path = written(content)
    begin = time.process_time()
    with pytest.raises(fflin.FflinError):
        fflin.load(path)
    assert time.process_time() - begin < 5.0


def test_models_of_a_file_are_told_from_those_of_its_urdf(written, tmp_path):
    plain = fflin.load("servicer_7dof")
    robot = fflin.load(written(AT_REST))
    lin = fflin.linearize(robot)
    gain = fflin.lqr(lin)
    with pytest.raises(
        fflin.InputError, match=r"the model is one of 'sat', not of .* without the input rw"
    ):
        fflin.simulate(plain, fflin.StateFeedback(lin, gain.K), duration=0.1)
    batch = fflin.sweep(robot, [robot.neutral()], out=tmp_path / "a.npz")
    with pytest.raises(fflin.InputError, match="not the robot that the batch is of"):
        fflin.LinearBatch.load(tmp_path / "a.npz", plain)
    assert fflin.LinearBatch.load(tmp_path / "a.npz", robot)[0].weights == robot.weights
    assert batch[0].weights == robot.weights


@pytest.mark.parametrize("ending", ["npz", "mat", "json", "csv"])
def test_a_regulator_weighs_what_the_robot_says(written, tmp_path, ending):
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
        assert gain.weights.startswith("q_m.joint_1, q_b, qdot_m.rw, tau_b as given, the others id")
    assert "from the limits" in fflin.lqr(lin, weights="urdf").weights


@pytest.mark.parametrize("name", BUNDLED)
def test_every_bundled_robot_in_a_file_is_itself(written, name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plain, robot = fflin.load(name), fflin.load(written(f'urdf = "{name}"\n'))
    assert robot.model == plain.model and robot.inputs == plain.inputs
    assert fflin.linearize(robot).A.tobytes() == fflin.linearize(plain).A.tobytes()


def test_the_file_is_not_written_over(written, tmp_path):
    robot = fflin.load(written(URDF))
    (tmp_path / "out.npz").symlink_to(tmp_path / "sat.toml")
    with pytest.raises(fflin.FileError, match=re.escape("is the input file")):
        fflin.linearize(robot).save(tmp_path / "out.npz")
