"""`fflin init`, and the robot files that it writes, as a user runs them."""

import re
import sys
import warnings

import numpy as np
import pytest

import fflin
from fflin.robot.catalog import bundled_directory
from tests.support.commands import refused, run
from tests.support.messages import says
from tests.support.patience import finished
from tests.support.robots import BUNDLED, mostly

BODY = (
    '<inertial><mass value="{mass}"/><inertia ixx="{xx}" iyy="0.4" izz="0.5" ixy="0" ixz="0" '
    'iyz="0"/></inertial>'
)
LINKS = {
    "base": (50, 0.3),
    "hinged panel": (4, 0.3),
    "rw_x": (1, 0.7),
    "RCS_1": (0.1, 0.3),
}
OWN = (
    '<robot name="own">'
    + "".join(
        f'<link name="{name}">{BODY.format(mass=m, xx=x)}</link>'
        for name, (m, x) in LINKS.items()
    )
    + '<joint name="hinge 1" type="revolute"><parent link="base"/><child link="hinged panel"/>'
    '<origin xyz="0 1 0"/><axis xyz="0 1 0"/>'
    '<limit lower="-1" upper="2" effort="0" velocity="3"/><dynamics damping="0.3"/></joint>'
    '<joint name="spin" type="continuous"><parent link="base"/><child link="rw_x"/>'
    '<origin xyz="0 0 0.5" rpy="0 0 1.5707963267948966"/><axis xyz="1 0 0"/>'
    '<limit effort="2" velocity="500"/></joint>'
    '<joint name="nozzle mount" type="fixed"><parent link="base"/><child link="RCS_1"/>'
    '<origin xyz="-1 0 0" rpy="0 1.5707963267948966 0"/></joint>'
    "</robot>"
)


@pytest.mark.parametrize(
    "name", mostly(BUNDLED, "cubesat", "inspector", "planar_detumble", "servicer_7dof")
)
def test_a_robot_file_from_init_can_be_simulated(tmp_path, name):
    code, out, err = run("init", name, "-o", "own.toml", cwd=tmp_path)
    assert (code, err) == (0, "") and says(out, "own.toml", "fflin simulate own.toml")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plain = fflin.load(name)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*(effort.* 0 of|damping unused)")
        robot = fflin.load(tmp_path / "own.toml")
    assert robot.urdf == plain.urdf and robot.model == plain.model
    assert robot.start["rpy"] == (10.0, 0.0, 0.0)
    idle = [x.name for x in plain.joints if plain.model.effortLimit[x.idx_v] == 0.0]
    assert list(robot.passive) == idle == list(robot.stiffness)
    damped = {joint: d for joint, d in plain.urdf_damping.items() if d}
    assert {joint: robot.damping[joint] for joint in damped} == pytest.approx(damped)
    code, out, err = run(
        "simulate", "own.toml", "--duration", 5, "-o", "m.npz", cwd=tmp_path
    )
    assert code in (0, 1) and err == "" and "own: 5 s" in out
    motion = fflin.Motion.load(tmp_path / "m.npz")
    assert motion.attitude_error[0] == pytest.approx(10.0)
    assert motion.attitude_error[-1] < motion.attitude_error[0] and not motion.stopped


@pytest.mark.process
def test_init_warns_only_of_properties_that_its_file_omits(tmp_path):
    text = OWN.replace('damping="0.3"', 'damping="0.3" friction="0.1"').replace(
        "RCS_1", "thr " * 9
    )
    (tmp_path / "own.urdf").write_text(text.replace("thr thr", "thr-thr"))
    command = [sys.executable, "-m", "fflin", "init", "own.urdf"]
    done = finished(command, capture_output=True, text=True, cwd=tmp_path, check=True)
    assert says(done.stderr, "fflin: warning: own: ", "'hinge 1'")
    assert done.stderr.count("\n") == 1
    comments = [
        x for x in (tmp_path / "own.toml").read_text().splitlines() if x.startswith("#")
    ]
    assert max(map(len, comments)) <= 80 and "direction [1, 0, 0]" in " ".join(
        x[2:] for x in comments
    )


def test_all_that_init_suggests_can_be_taken(tmp_path):
    """Every comment that is a line of TOML, uncommented, gives a robot that loads."""
    (tmp_path / "own.urdf").write_text(OWN)
    code, _, _ = run("init", "own.urdf", cwd=tmp_path)
    assert code == 0
    text = (tmp_path / "own.toml").read_text()
    assert 'passive = ["hinge 1"]\n' in text
    assert says(text, '"rw_x"', "[0, 0, 0.5]", "[0, 1, 0]")
    assert says(text, '"RCS_1"', "[-1, 0, 0]", "[1, 0, 0]")
    # A URDF that is not written as xacro has no arguments.
    taken = re.sub(r"(?m)^# (?=\[|(?!xacro)[a-z_]+ = |\"[\w. ]+\" = )", "", text)
    # The wheel takes the place of its joint, which no other line may then speak of.
    assert says(text, 'To use this wheel, lock joint "spin" above.')
    (tmp_path / "free.toml").write_text(taken.replace('lock = ["spin"]', ""))
    with pytest.raises(
        fflin.InputError, match="if joint 'spin' turns the wheel itself, lock it"
    ):
        fflin.load(tmp_path / "free.toml")
    taken = re.sub(r'(?m)^"\w+\.spin".*\n', "", taken)
    (tmp_path / "all.toml").write_text(taken)
    robot = fflin.load(tmp_path / "all.toml")
    assert robot.locked == ("spin=0.0",) and robot.passive == ("hinge 1",)
    spin = {"max": 2.0, "max_speed": 500.0}  # the limits of its joint
    assert robot.inputs == (
        fflin.BaseTorque(max=1.0),
        fflin.BaseForce(max=1.0),
        fflin.Thruster("RCS_1", (0, 0, 0), (0, 0, 1), "RCS_1", max=1.0),
        fflin.ReactionWheel((1, 0, 0), "rw_x", inertia=0.7, name="rw_x_rotor", **spin),
    )
    assert robot.outputs == (fflin.CenterOfMass(),) and robot.gravity[2] == -9.81
    assert robot.weights == {"rule": "urdf", "bryson": {"q_b": 0.05}}
    assert robot.limits["q_m.hinge 1"] == (-1.0, 2.0)
    assert robot.start["velocity"] == {"qdot_m.hinge 1": 0.01}
    # The spring that is guessed: 0.5 Hz with the base held.
    inertia = 0.4  # about y, through the panel's centre
    assert robot.stiffness["hinge 1"] == pytest.approx(inertia * np.pi**2, rel=1e-5)
    assert robot.damping["hinge 1"] == 0.3


def test_inputs_come_in_the_order_of_their_numbers(tmp_path):
    nozzles = "".join(
        f'<link name="thruster_{k}"/><joint name="n{k}" type="fixed"><parent link="base"/>'
        f'<child link="thruster_{k}"/></joint>'
        for k in range(1, 13)
    )
    (tmp_path / "own.urdf").write_text(OWN.replace("</robot>", f"{nozzles}</robot>"))
    assert run("init", "own.urdf", cwd=tmp_path)[0] == 0
    result = re.findall(
        '# name = "thruster_([0-9]+)"', (tmp_path / "own.toml").read_text()
    )
    assert result == [str(k) for k in range(1, 13)]


def test_joints_that_all_have_no_effort_keep_their_motors(tmp_path):
    text = (bundled_directory() / "canadarm2.urdf").read_text()
    (tmp_path / "zero.urdf").write_text(re.sub(r'effort="[^"]*"', 'effort="0"', text))
    code, _, _ = run("init", "zero.urdf", "-o", "sub.toml", cwd=tmp_path)
    text = (tmp_path / "sub.toml").read_text()
    assert code == 0 and says(text, "effort")
    with pytest.warns(fflin.FflinWarning, match="0 of 7"):
        robot = fflin.load(tmp_path / "sub.toml")
    assert robot.passive == () and len(fflin.linearize(robot).u0) == 13


def test_a_bus_with_unactuated_wings_becomes_a_robot_by_uncommenting(tmp_path):
    """The springs are suggested, and the frame of appendages is the root link, here "bus"."""
    text = OWN.replace('effort="2"', 'effort="0"').replace('"base"', '"bus"')
    (tmp_path / "own.urdf").write_text(text)
    assert run("init", "own.urdf", cwd=tmp_path)[0] == 0
    written = (tmp_path / "own.toml").read_text()
    wing = r'# "hinge 1" = [0-9.]+\n'
    assert re.search(r"\[stiffness\]\n(# .*\n)*" + wing, written)
    taken = re.sub(r"(?m)^# (passive = )", r"\1", written)
    springs, rest = taken.split("# [rest]")
    taken = (
        re.sub(r'(?m)^# (?="(hinge 1|spin)" = [0-9.]+$)', "", springs)
        + "# [rest]"
        + rest
    )
    appendage = re.search(r"# \[\[flexible\]\]\n(#.*\n)*?(?=# \[\[slosh)", written)[0]
    taken = taken.replace(appendage, re.sub(r"(?m)^# ", "", appendage))
    (tmp_path / "taken.toml").write_text(taken)
    robot = fflin.load(tmp_path / "taken.toml")
    assert set(robot.passive) == {"hinge 1", "spin"} <= set(robot.stiffness)
    assert robot.stiffness["hinge 1"] == pytest.approx(0.4 * np.pi**2, rel=1e-5)
    assert robot.damping["hinge 1"] == 0.3 and robot.damping["spin"] > 0.0
    assert robot.appendages[0].frame == "bus"


def test_a_file_names_its_urdf_from_where_it_lies(tmp_path):
    (tmp_path / "deep" / "er").mkdir(parents=True)
    (tmp_path / "a b.urdf").write_text(OWN)
    code, out, _ = run(
        "init", tmp_path / "a b.urdf", "-o", "deep/er/x.toml", cwd=tmp_path
    )
    assert code == 0 and says(out, "deep/er/x.toml")
    assert fflin.load(tmp_path / "deep" / "er" / "x.toml").name == "x"
    assert (
        'urdf = "../../a b.urdf"\n' in (tmp_path / "deep" / "er" / "x.toml").read_text()
    )


def test_init_writes_over_nothing_unless_requested(tmp_path):
    code, out, _ = run("init", "ets_vii", cwd=tmp_path)
    assert code == 0 and says(out, "ets_vii.toml")
    path = tmp_path / "ets_vii.toml"
    path.write_text("mine")
    assert "--force" in refused("init", "ets_vii", cwd=tmp_path)
    assert path.read_text() == "mine"
    assert run("init", "ets_vii", "--force", cwd=tmp_path)[0] == 0
    assert says(path.read_text(), "ets_vii", "6 joints")
    for words, arguments in {
        "robot file": ("ets_vii.toml", "-o", "b.toml"),
        "'.urdf'": ("ets_vii", "-o", "b.urdf"),
        "'ets_vi'": ("ets_vi",),
        "folder": ("ets_vii", "-o", "none/b.toml"),
    }.items():
        assert words in refused("init", *arguments, cwd=tmp_path)
    assert sorted(item.name for item in tmp_path.iterdir()) == ["ets_vii.toml"]


SAT = """
urdf = "servicer_7dof"
passive = ["panel_*"]
outputs = ["com"]
stiffness = 100
damping = 5
[weights]
rule = "identity"
[weights.bryson]
tau_b = 2
[start]
rpy = [20, 0, 0]
joints = { joint_2 = 0.4 }
velocity = { omega_b.z = 0.01 }
"""


@pytest.fixture
def sat(tmp_path):
    (tmp_path / "sat.toml").write_text(SAT)
    return tmp_path


@pytest.mark.exhaustive
def test_a_robot_file_stands_wherever_a_robot_does(sat):
    for arguments in (
        *(("info", "sat.toml"), ("linearize", "sat.toml"), ("check", "sat.toml")),
        *(("analyze", "sat.toml"), ("modes", "sat.toml"), ("lqr", "sat.toml")),
        ("sweep", "sat.toml", "--random", 3, "-o", "s.npz"),
        ("lqr", "servicer_7dof.toml", "--stiffness", 100, "--lock", "panel_right"),
    ):
        code, out, err = run(*arguments, cwd=sat)
        assert code == 0 and out and "fflin: error" not in err, arguments
    lin = fflin.LinearBatch.load(sat / "s.npz")
    assert lin.input_names[-1] == "tau_m.joint_7" and lin.output_names == (
        "com.x",
        "com.y",
        "com.z",
    )


@pytest.mark.compiled
def test_validity_takes_a_robot_file(sat, brief_validity):
    code, out, _ = run("validity", "sat.toml", "--samples", 2, cwd=sat)
    assert code == 0 and "of 2" in out


def test_options_go_before_the_file(sat):
    def saved(*options):
        code, _, err = run("linearize", "sat.toml", *options, "-o", "m.npz", cwd=sat)
        assert code == 0, err
        return fflin.LinearModel.load(sat / "m.npz")

    assert saved().output_names[0] == "com.x" and not saved().q[:3].any()
    assert saved("--output", "base").output_names[0] == "q_b.x"
    assert saved("--inputs", "joints").input_names == tuple(
        f"tau_m.joint_{k}" for k in range(1, 8)
    )
    assert (
        saved("--inputs", "joints", "--passive", "joint_1").input_names[0]
        == "tau_m.joint_2"
    )
    assert "passive" in refused(
        "linearize", "sat.toml", "--inputs", "joints", "--passive", "joint_?", cwd=sat
    )


def test_passive_on_the_command_line(sat):
    robot = ("linearize", "servicer_7dof", "-o", "m.npz")
    assert run(*robot, "--passive", "panel_*", "--passive", "joint_1", cwd=sat)[0] == 0
    names = fflin.LinearModel.load(sat / "m.npz").input_names
    assert names[6:] == tuple(f"tau_m.joint_{k}" for k in range(2, 8))
    assert "'hinge_*'" in refused(*robot[:2], "--passive", "hinge_*", cwd=sat)


@pytest.mark.exhaustive
def test_simulate_begins_and_weighs_as_the_file_says(sat):
    def simulated(*options):
        code, _, err = run(
            "simulate", "sat.toml", "--duration", 1, "-o", "m.npz", *options, cwd=sat
        )
        assert code in (0, 1), err
        return fflin.Motion.load(sat / "m.npz")

    robot = fflin.load(sat / "sat.toml")
    motion = simulated()
    x = dict(zip(motion.state_names, motion.x[0], strict=True))
    assert x["q_b.x"] == pytest.approx(np.sin(np.radians(10.0)))
    assert x["q_m.joint_2"] == 0.4 and x["omega_b.z"] == 0.01
    lin = fflin.linearize(robot, fflin.configuration(robot), reference=motion.reference)
    law = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    again = fflin.simulate(robot, law, duration=1.0, limits="urdf")
    np.testing.assert_allclose(again.x, motion.x, atol=1e-9)
    assert says(fflin.lqr(lin).weights, "tau_b", "identity")
    turned = simulated(
        "--rpy", 0, 0, 5, "--joint", "joint_*=0.1", "--velocity", "joint_1=0.2"
    )
    x = dict(zip(turned.state_names, turned.x[0], strict=True))
    assert x["q_b.x"] == 0.0 and x["q_b.z"] == pytest.approx(np.sin(np.radians(2.5)))
    assert x["q_m.joint_2"] == x["q_m.joint_7"] == 0.1 and x["q_m.panel_left"] == 0.0
    assert x["omega_b.z"] == 0.01 and x["qdot_m.joint_1"] == 0.2


@pytest.mark.exhaustive
def test_lqr_on_the_command_line_uses_the_weights_of_the_file(sat):
    def weights(*options):
        code, out, err = run("lqr", "sat.toml", *options, cwd=sat)
        assert code == 0, err
        return out

    assert says(weights(), "tau_b", "identity")
    assert says(weights("--q", "q_b=3"), "tau_b, q_b", "identity")
    assert says(weights("--weights", "urdf"), "URDF")


WHEEL = """<robot name="bus"><link name="bus"><inertial><mass value="50"/>
<inertia ixx="5" ixy="0" ixz="0" iyy="6" iyz="0" izz="7"/></inertial></link>
<link name="wheel_x"><inertial><mass value="1"/>
<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.002"/></inertial></link>
<joint name="spin" type="{kind}"><parent link="bus"/><child link="wheel_x"/><axis xyz="0 0 1"/>
<limit effort="0.1" velocity="{speed}"/></joint></robot>"""


@pytest.mark.parametrize(
    ("kind", "speed", "inertia", "most"),
    [
        ("fixed", 0, 0.001, 600.0),
        ("continuous", 0, 0.002, 600.0),
        ("continuous", 50, 0.002, 50.0),
    ],
)
def test_suggested_wheels_have_an_inertia_and_saturate(
    tmp_path, kind, speed, inertia, most
):
    (tmp_path / "bus.urdf").write_text(WHEEL.format(kind=kind, speed=speed))
    assert run("init", tmp_path / "bus.urdf", cwd=tmp_path)[0] == 0
    text = (tmp_path / "bus.toml").read_text()
    start = text.index('# [[input]]\n# type = "reaction_wheel"')
    table = text[start:].split("\n\n")[0].replace("# ", "", 1).replace("\n# ", "\n")
    lock = 'lock = ["spin"]\n' if kind == "continuous" else ""
    (tmp_path / "flown.toml").write_text(f'urdf = "bus.urdf"\n{lock}{table}\n')
    robot = fflin.load(tmp_path / "flown.toml")
    (wheel,) = robot.inputs
    assert (
        wheel.inertia == pytest.approx(inertia)
        and wheel.max
        and wheel.max_speed == most
    )


def test_an_ideal_force_on_the_base_is_reported_to_be_ideal(tmp_path):
    (tmp_path / "bus.urdf").write_text(WHEEL.format(kind="fixed", speed=0))
    assert says(
        run("init", tmp_path / "bus.urdf", cwd=tmp_path)[1], "ideal torque and force"
    )
    assert says(
        run("info", tmp_path / "bus.toml")[1],
        "warning: an ideal torque and force without",
    )
    jets = run("info", "cubesat", "--inputs", "cubesat")[1]
    assert "ideal" not in jets
