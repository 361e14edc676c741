"""The command line as a user runs it: in a process of its own."""

import json
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.base.tables import matrix
from fflin.commands import cli
from fflin.commands.options import ROBOT
from fflin.robot.catalog import bundled_directory
from tests.support.commands import refused, run, without_warnings
from tests.support.marks import exhaustive
from tests.support.messages import says
from tests.support.patience import finished
from tests.support.robots import BUNDLED


@pytest.mark.exhaustive
def test_robots_lists_all_with_n_mass_and_origin():
    code, out, err = run("robots")
    assert code == 0 and not err
    _, table, *refused = out.split("\n\n")
    rows = {line.split()[0]: line.split() for line in table.splitlines()}
    assert set(fflin.list_robots()) - set(rows) == {"alex_psyonic_hands"}
    # By the name of its file: where that lies is of no use here, and breaks the lines.
    assert "alex_psyonic_hands.urdf" in refused[0] and "mimics" in refused[0]
    assert max(map(len, out.splitlines())) <= 80
    assert rows["ets_vii"][1:4] == ["6", "2690.4", "fflin"]
    assert rows["talos"][1] == "32" and rows["talos"][3] == "example-robot-data"


def test_info_shows_tree_masses_and_limits():
    code, out, err = run("info", "dual_arm")
    assert code == 0 and not err
    assert says(out, "8 joints, 28 states, 14 inputs")
    lines = out.splitlines()
    left, deeper = (
        next(x for x in lines if x.strip().startswith(n)) for n in ("left_1", "left_2")
    )
    assert len(deeper) - len(deeper.lstrip()) == len(left) - len(left.lstrip()) + 2
    assert "revolute" in left and "tool_left" in out
    assert says(out, "rad, N m and rad/s")
    assert max(map(len, lines)) <= 80


@pytest.mark.parametrize("name", BUNDLED)
def test_check_exits_0_on_every_bundled_robot(name):
    code, out, err = run("check", name, "--frame", "world", "--rpy", 20, -30, 160)
    assert code == 0 and not err
    assert says(out, "largest error")
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.process
def test_damping_that_is_asked_for_is_not_warned_of():
    for option, message in (([], True), (["--damping", "urdf"], False)):
        done = finished(
            [sys.executable, "-m", "fflin", "modes", "planar_detumble", *option],
            capture_output=True,
            text=True,
            check=True,
        )
        assert ("damping" in done.stderr) == message


@pytest.mark.process
def test_warnings_are_one_line_each_on_stderr_and_in_info():
    done = finished(
        [sys.executable, "-m", "fflin", "info", "planar_detumble"],
        capture_output=True,
        text=True,
    )
    words = "planar_detumble: damping unused: 'joint_1', 'joint_2', 'joint_3'"
    assert done.returncode == 0
    assert done.stderr.startswith("fflin: warning: ") and done.stderr.count("\n") == 1
    assert words in done.stderr
    assert words in " ".join(done.stdout.split())
    silent = finished(
        [sys.executable, "-W", "ignore", "-m", "fflin", "info", "planar_detumble"],
        capture_output=True,
        text=True,
    )
    assert silent.returncode == 0 and not silent.stderr


def test_round_off_is_not_shown_as_figures():
    values = np.array([[2.0, 1e-17, 1e-20], [3e-16, 1.0, 0.0]])
    shown = [
        line.split()
        for line in matrix(values, ["a", "b"], ["x", "y", "z"]).splitlines()
    ]
    # 1e-20 stands alone in its column, and 3e-16 is just above the rounding of a one.
    assert shown == [
        ["x", "y", "z"],
        ["a", "2", "~0", "1e-20"],
        ["b", "3e-16", "1", "."],
    ]


def test_a_cut_matrix_shows_the_columns_that_fit_and_counts_the_others():
    names = [f"input_{j:04d}" for j in range(20)]
    whole = matrix(np.ones((2, 20)), ["a", "b"], names)
    text = matrix(np.ones((2, 20)), ["a", "b"], names, "see -o")
    # A column takes 12 characters, and 6 columns fit beside the name of the row into 80.
    assert all(name in whole for name in names)
    assert [name for name in names if name in text] == names[:6]
    assert text.endswith("\n\n... and 14 more columns, see -o")
    few = matrix(np.ones((2, 6)), ["a", "b"], names[:6], "see -o")
    assert few == matrix(np.ones((2, 6)), ["a", "b"], names[:6])


def test_linearize_prints_readable_tables():
    code, out, err = run("linearize", "ets_vii", "--joint", "joint_2=0.5")
    assert code == 0 and not err
    assert max(map(len, out.splitlines())) <= 80
    assert says(out, "24 states, 12 inputs", "hybrid", "fixed point")
    assert "x0: q_m.joint_2 = 0.5 rad" in out
    assert "\x1b" not in out  # plain where it is not a terminal
    robot = fflin.load("ets_vii")
    lin = fflin.linearize(robot, fflin.configuration(robot, {"joint_2": 0.5}))
    row = next(x for x in out.splitlines() if x.startswith("omega_b.x") and "e-" in x)
    assert f"{lin.B[12, 0]:.5g}" in row.split()


def test_units_are_above_the_tables():
    motion = ("--velocity", "joint_1=0.1", "--stiffness", "panel_left=100")
    code, out, err = run(
        "linearize", "servicer_7dof", *motion, "--output", "frame:tool"
    )
    assert code == 0 and not err
    text = " ".join(out.split())
    assert (
        "u: tau_b [N m], F_b [N], tau_m [N m] y: tool.position [m], tool.rotation [rad]"
        in text
    )
    assert (
        "f0: q_m.joint_1 = 0.1 rad/s," in text
        and "rad/s^2" in text
        and "/s/s" not in text
    )
    assert max(map(len, out.splitlines())) <= 80
    # No entry is broken between its name, its value and its unit.
    shown = out.split("f0: ")[1].split("\n\n")[0]
    assert all(line.count(" = ") == line.count("/s") for line in shown.splitlines())
    code, out, _ = run("linearize", "cubesat", "--inputs", "cubesat")
    assert "u: x_plus_top ... z_minus_right [N], wheel_x ... wheel_z [N m]" in out
    assert "q_m [rad], omega_b [rad/s]" in out


def test_sampled_model_matches_python(tmp_path):
    path = tmp_path / "m.mat"
    options = ("planar_detumble", "--dt", 0.1, "--velocity", "joint_1=0.1")
    code, _, err = run("linearize", *options, "-o", path)
    assert code == 0 and not err
    robot = fflin.load("planar_detumble")
    expected = fflin.linearize(
        robot, v=fflin.velocity(robot, {"joint_1": 0.1})
    ).discretize(0.1)
    saved = fflin.LinearModel.load(path)
    assert saved.dt == 0.1
    for key in ("A", "B", "f0"):
        # The command reads the robot by another route, which rounds otherwise.
        np.testing.assert_allclose(
            getattr(saved, key), getattr(expected, key), rtol=0, atol=1e-13
        )
    code, out, err = run("linearize", *options)
    assert code == 0 and not err and says(out, "sampled", "0.1 s")
    assert "q_m.joint_1 = 0.0099" in out and "/s^2" not in out  # f0 is what a step adds
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.process
@pytest.mark.parametrize(
    "command",
    [
        ("linearize", "servicer_7dof", "--joint", "joint_2=9", "--joint", "joint_4=1"),
        (
            "simulate",
            "servicer_7dof",
            "--target-joint",
            "joint_2=9",
            "--duration",
            "0.01",
        ),
    ],
)
def test_joints_beyond_their_limits_are_named(command):
    done = finished(
        [sys.executable, "-m", "fflin", *command], capture_output=True, text=True
    )
    assert done.returncode == 0
    assert "'joint_2' at 9 (deg?) is outside -2.094 to 2.094 rad" in done.stderr
    assert done.stderr.startswith("fflin: warning: ") and done.stderr.count("\n") == 1


@pytest.mark.parametrize("ending", [".npz", ".mat", ".json"])
def test_linearize_saves_the_model_of_python(ending, tmp_path):
    path = tmp_path / f"m{ending}"
    options = (
        "--joint",
        "left_2=0.3",
        "--frame",
        "local",
        "--lock",
        "right_1=0.2",
        "--lock",
        "right_4",
    )
    code, out, err = run("linearize", "dual_arm", *options, "-o", path)
    assert code == 0 and not err and "24 states, 12 inputs" in out
    saved = fflin.LinearModel.load(path)
    robot = fflin.load("dual_arm", lock={"right_1": 0.2, "right_4": None})
    lin = fflin.linearize(
        robot, fflin.configuration(robot, {"left_2": 0.3}), frame="local"
    )
    assert (saved.B == lin.B).all() and saved.state_names == lin.state_names
    assert saved.frame == "local" and saved.certificate == lin.certificate


def test_linearize_for_a_tool_saves_the_model_of_python(tmp_path):
    code, out, _ = run(
        *(
            "linearize",
            "cubesat",
            "--rpy",
            "20",
            "10",
            "0",
            "--velocity",
            "omega_b.z=0.2",
        ),
        *("--for", "drake", "-o", str(tmp_path / "a.mat")),
    )
    lines = ["linearize: cubesat: 13 states, 6 inputs", f"wrote {tmp_path / 'a.mat'}"]
    assert code == 0 and out.splitlines() == lines
    saved = fflin.ToolModel.load(tmp_path / "a.mat")
    robot = fflin.load("cubesat")
    turned = pin.SE3(pin.rpy.rpyToMatrix(*np.radians((20.0, 10.0, 0.0))), np.zeros(3))
    v = fflin.velocity(robot, {"omega_b.z": 0.2})
    lin = fflin.linearize(robot, fflin.configuration(robot, {}, turned), v)
    assert np.array_equal(saved.A, lin.to("drake").A) and saved.tool == "drake"
    for options in (
        (),
        ("-o", str(tmp_path / "a.csv")),
        ("--trajectory", "x.csv", "-o", "a.npz"),
    ):
        assert refused("linearize", "cubesat", "--for", "drake", *options)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mat"]


def test_reference_world_keeps_the_attitude_in_the_state(tmp_path):
    path = tmp_path / "m.json"
    options = ("--rpy", 90, 0, 0, "--position", 1, 2, 3)
    run("linearize", "cubesat", *options, "--reference", "world", "-o", path)
    x0 = json.loads(path.read_text())["x0"]
    assert x0[:6] == pytest.approx([0.5**0.5, 0, 0, 1, 2, 3])
    run("linearize", "cubesat", *options, "-o", path)
    assert json.loads(path.read_text())["x0"][:6] == [0.0] * 6


def test_invalid_input_is_one_line_and_leaves_nothing(tmp_path):
    output = tmp_path / "m.npz"
    bad = tmp_path / "bad.urdf"
    bad.write_text("<robot name='r'><link")
    typo = tmp_path / "bad.toml"
    typo.write_text('[[input]]\ntype = "truster"\n')
    cases = {
        ("linearize", "ets_vi", "-o", output): "'ets_vi'",
        ("linearize", bad, "-o", output): "bad.urdf:1",
        ("linearize", tmp_path / "no.urdf", "-o", output): "no file",
        (
            "check",
            tmp_path / "bad.tml",
        ): f"in the folder {tmp_path}; did you mean 'bad.toml'",
        ("check", tmp_path / "none" / "bad.toml"): "its folder does not exist",
        (
            "check",
            "cubesat",
            "--inputs",
            tmp_path / "bud.toml",
        ): "did you mean 'bad.toml'",
        ("montecarlo", "cubesat", "--runs", 2): '[dispersions] and "base.mass" = 0.05',
        ("linearize", tmp_path, "-o", output): "folder",
        ("linearize", "ets_vii", "--joint", "joint_9=1", "-o", output): "'joint_9'",
        ("linearize", "ets_vii", "--joint", "joint_1=x", "-o", output): "'x'",
        ("linearize", "ets_vii", "--joint", "joint_1", "-o", output): "'joint_1'",
        ("linearize", "ets_vii", "--joint", "joint_1=nan", "-o", output): "finite",
        ("linearize", "ets_vii", "--frame", "body", "-o", output): "'body'",
        ("linearize", "ets_vii", "--lock", "tail", "-o", output): "'tail'",
        ("linearize", "ets_vii", "-o", tmp_path / "m.xls"): "'.xls'",
        ("linearize", "ets_vii", "-o", tmp_path / "none" / "m.npz"): "m.npz",
        (
            "linearize",
            "ets_vii",
            "--joint",
            "joint_1=1",
            "--joint",
            "joint_1=2",
        ): "'joint_1'",
        ("linearize", "ets_vii", "--lock", "joint_1", "--joint", "joint_1=2"): "locked",
        ("linearize", "ets_vii", "--stiffness", "joint_1=-1"): "-1",
        ("linearize", "ets_vii", "--damping", "viscous"): "'viscous'",
        ("linearize", "cubesat", "--inputs", typo, "-o", output): "bad.toml:2",
        ("check", "cubesat", "--inputs", "none.toml"): "none.toml",
        (
            "check",
            "cubesat",
            "--inputs",
            "servicer_7dof",
        ): "'joint_1'",
        ("check", "cubesat", "--inputs", "cubesats"): "'cubesats'",
        ("linearize", "ets_vii", "--dt", 0, "-o", output): "dt is 0",
        ("check", "ets_vii", "--output", "pos:tool"): "'pos'",
        ("check", "ets_vii", "--output", "pose"): "'pose'",
        ("check", "ets_vii", "--output", "com:tool"): "com",
        ("check", "ets_vii", "--output", "pose:tol"): "'tol'",
        ("check", "ets_vii", "--output", "base", "--output", "state"): "twice",
        ("linearize", "ets_vii", "--out", "m.mat"): "--out",
        ("check", "romeo"): "'LHand'",
        ("check", "cubesat", "--rpy", 180, 0, 0, "--reference", "world"): "180 deg",
        ("check",): "ROBOT",
        ("dance",): "'dance'",
        (): "required",
    }
    for arguments, words in cases.items():
        assert words in refused(*arguments)
    assert sorted(tmp_path.iterdir()) == [typo, bad]


def test_existing_output_survives_a_failure(tmp_path):
    output = tmp_path / "m.npz"
    output.write_text("precious")
    refused("linearize", "romeo", "-o", output)
    assert output.read_text() == "precious"


def test_robots_own_file_is_never_the_output(tmp_path):
    robot = tmp_path / "robot.json"
    robot.write_bytes((bundled_directory() / "cubesat.urdf").read_bytes())
    before = robot.read_bytes()
    assert "input file" in refused("linearize", robot, "-o", robot)
    assert robot.read_bytes() == before
    sibling = tmp_path / "arm.A.csv"
    sibling.write_bytes(before)
    code, _, error = run("linearize", sibling, "-o", tmp_path / "arm.csv")
    assert code == 2 and "input file" in error
    assert sibling.read_bytes() == before


@pytest.mark.process
@pytest.mark.parametrize(
    "arguments",
    [("linearize", "cubesat"), ("--help",), ("lqr", "--help"), ("--version",)],
)
def test_unwritable_stdout_is_one_line(arguments):
    with open("/dev/full", "w") as full:
        done = finished(
            [sys.executable, "-m", "fflin", *arguments],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert done.returncode == 2
    assert says(done.stderr, "fflin: error: ", "No space left on device")
    assert done.stderr.count("\n") == 1


@pytest.mark.process
@pytest.mark.parametrize("arguments", [("check", "nosuch"), ("check",)])
def test_unwritable_stderr_does_not_change_the_exit_code(arguments):
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "fflin", *arguments]
        assert finished(command, stderr=full).returncode == 2


@pytest.mark.parametrize(
    "arguments",
    [
        ("{}",),
        ("linearize", "{}"),
        ("linearize", "cubesat", "--frame", "{}"),
        ("lqr", "cubesat", "--{}"),
    ],
)
def test_names_neither_split_nor_fill_the_line(arguments):
    message = refused(
        *(argument.format("a\nb\x1b[31m" + 5000 * "c" + "d") for argument in arguments)
    )
    assert (
        r"a\nb\x1b[31mc" in message
        and "...c" in message
        and "cd" in message
        and len(message) < 500
    )


def test_an_empty_name_is_reported_to_be_empty():
    assert "empty" in refused("linearize", "cubesat", "-o", "")
    assert "empty" in refused("linearize", "cubesat", "--inputs", "")
    assert "empty" in refused("simulate", "cubesat", "--duration", "1", "--plot", "")
    with pytest.raises(fflin.InputError, match="path"):
        fflin.linearize(fflin.load("cubesat")).save("")


def test_negative_numbers_are_not_options():
    code, out, _ = run(
        "check", "cubesat", "--rpy", "-30", "-1e-3", "0", "--position", "-.5", 0, 0
    )
    assert code == 0 and "A and B of cubesat: verified" in out


def test_passive_joints_and_gravity(tmp_path):
    path = tmp_path / "m.npz"
    options = (
        "--stiffness",
        "panel_left=100",
        "--stiffness",
        "panel_right=90",
        "--damping",
        "0.5",
    )
    code, _, _ = run(
        "linearize", "servicer_7dof", *options, "--gravity", 0, 0, -1.6, "-o", path
    )
    assert code == 0
    robot = fflin.load(
        "servicer_7dof",
        stiffness={"panel_left": 100.0, "panel_right": 90.0},
        damping=0.5,
        gravity=(0, 0, -1.6),
    )
    # The compiled equations, where a process has them, round otherwise.
    again = fflin.Linearizer(robot)()
    assert (fflin.LinearModel.load(path).A == again.A).all()
    options = (
        "--damping",
        "urdf",
        "--velocity",
        "joint_2=0.3",
        "--effort",
        "tau_m.joint_1=2",
    )
    code, out, _ = run("check", "planar_detumble", *options)
    assert code == 0 and "A and B of planar_detumble: verified" in out


def test_inputs_and_outputs_match_python(tmp_path):
    path = tmp_path / "m.mat"
    springs = ("--stiffness", "panel_left=100", "--stiffness", "panel_right=100")
    inputs = fflin.load_inputs("servicer_7dof")
    options = ("--inputs", bundled_directory() / "servicer_7dof.toml", *springs)
    code, out, err = run(
        "linearize", "servicer_7dof", *options, "--output", "frame:tool", "-o", path
    )
    assert code == 0 and not err and "30 states, 17 inputs" in out
    robot = fflin.load(
        "servicer_7dof",
        inputs=inputs,
        outputs=[fflin.FramePose("tool"), fflin.FrameVelocity("tool")],
        stiffness={"panel_left": 100.0, "panel_right": 100.0},
    )
    lin, saved = fflin.Linearizer(robot)(), fflin.LinearModel.load(path)
    for key in "ABCD":
        assert (getattr(saved, key) == getattr(lin, key)).all()
    assert (
        saved.input_names == lin.input_names and saved.output_names == lin.output_names
    )
    code, out, _ = run("check", "servicer_7dof", *options)
    assert code == 0 and "A and B of servicer_7dof: verified" in out


def test_output_and_output_file_are_distinguished(tmp_path):
    for option in (("--output-file",), ("--output-f",), ("-o",)):
        path = tmp_path / f"m{len(option[0])}.json"
        code, _, err = run("linearize", "ets_vii", "--output=com", *option, path)
        assert code == 0 and not err
        assert fflin.LinearModel.load(path).output_names == ("com.x", "com.y", "com.z")


def test_check_exits_1_where_it_falls_short(monkeypatch, capsys):
    """The exit code of a model that does not hold, by planting a wrong one."""
    from dataclasses import replace

    from fflin.commands import cli

    right = fflin.linearize
    monkeypatch.setattr(
        fflin,
        "linearize",
        lambda *a, **k: replace(lin := right(*a, **k), B=lin.B * 1.001),
    )
    assert cli.main(["check", "ets_vii"]) == 1
    assert "FAILED" in capsys.readouterr().out


def test_warnings_of_other_packages_are_shown_as_those_of_fflin(monkeypatch, capsys):
    from fflin.commands import cli

    right, outcome = fflin.linearize, []

    def linearize(*arguments, **options):
        assert (np.array([1e308]) * 10.0).max() == np.inf
        warnings.warn("mind this", fflin.FflinWarning, stacklevel=2)
        if outcome:
            raise fflin.InputError("too large")
        return right(*arguments, **options)

    monkeypatch.setattr(fflin, "linearize", linearize)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert cli.main(["linearize", "cubesat"]) == 0
        *_, foreign, own_line = capsys.readouterr().err.splitlines()
        outcome.append("error")
        assert cli.main(["linearize", "cubesat"]) == 2
        error = capsys.readouterr().err
    assert own_line == "fflin: warning: mind this"
    assert foreign == "fflin: warning: overflow encountered in multiply"
    assert error.endswith("fflin: warning: mind this\nfflin: error: too large\n")


def test_info_shows_the_inputs_of_a_file_with_the_limits_of_the_urdf():
    code, out, err = run("info", "servicer_7dof", "--inputs", "servicer_7dof")
    assert code == 0 and not err and "9 joints, 30 states, 17 inputs" in out
    table, _, _ = out.split("\ninput ")[1].partition("\n\n")
    rows = [line.split() for line in table.splitlines()[1:]]
    limits = {row[0]: (row[-2], row[-1]) for row in rows}
    model = fflin.load("servicer_7dof").model
    effort = dict(
        zip(model.names.tolist()[2:], model.effortLimit[6:].tolist(), strict=True)
    )
    for name in ("joint_1", "joint_7"):
        assert tuple(map(float, limits[f"tau_m.{name}"])) == (
            -effort[name],
            effort[name],
        )
    assert limits["F_b.x"] == ("-40", "40") and limits["back_left_top"] == ("0", "22")
    assert len(limits) == 17
    assert "\ninput " in run("info", "servicer_7dof")[1]
    assert "nosuch.toml" in refused("info", "cubesat", "--inputs", "./nosuch.toml")


SETTINGS = """urdf = "servicer_7dof"
lock = ["panel_right"]
passive = ["panel_left"]
orbit = 500e3
outputs = ["pose:tool", "joints"]
[stiffness]
"panel_*" = 40.0
[limits]
tau_b = 10.0
"qdot_m.joint_1" = 0.2
[weights]
rule = "identity"
[weights.bryson]
q_b = 0.05
[start]
rpy = [10, -5, 8]
joints = { joint_2 = 0.6 }
"""


def test_info_shows_the_settings_that_are_not_in_the_urdf(tmp_path):
    (tmp_path / "sat.toml").write_text(SETTINGS)
    code, out, err = run(
        "info", "sat.toml", "--damping", "panel_left=0.4", cwd=tmp_path
    )
    lines = out.splitlines()
    assert code == 0 and not err and max(map(len, lines)) <= 80
    for line in (
        "stiffness [N m/rad | N/m | 1/s^2]: panel_left = 40",
        "damping [N m s/rad | N s/m | 1/s]: panel_left = 0.4",
        "passive joints: panel_left",
        "locked joints: panel_right=0.0",
        "outputs: pose:tool, joints",
        "limits: qdot_m.joint_1 = -0.2 to 0.2, tau_b.x = -10 to 10, tau_b.y = -10 to 10,",
        "weights, rule: identity",
        "weights, bryson: q_b = 0.05",
        "start, rpy [deg]: 10, -5, 8",
        "start, joints [rad | m]: joint_2 = 0.6",
    ):
        assert line in lines
    assert "circular orbit 500 km" in out and "tau_b.x        N m    -10   10" in lines
    bare = run("info", "servicer_7dof")[1]
    for word in (
        "stiffness",
        "damping",
        "passive",
        "locked",
        "outputs",
        "weights",
        "start",
        "orbit",
    ):
        assert word not in bare
    assert (
        "gravity [m/s^2]: 0, 0, -1.6"
        in run("info", "cubesat", "--gravity", 0, 0, -1.6)[1]
    )


def test_check_takes_a_tolerance(tmp_path):
    code, out, _ = run("check", "ets_vii", "--tolerance", "1e-6")
    assert code == 0 and "at most 1.0e-06" in out
    assert run("check", "ets_vii", "--tolerance", "1e-20")[0] == 1
    assert "tolerance" in refused("check", "ets_vii", "--tolerance", 2)


def test_check_shows_the_largest_error_of_each_comparison():
    code, out, _ = run("check", "ets_vii")
    assert code == 0
    for row in (
        r"ABA derivatives +54 .* 1\.0e-09",
        r"differences +54 .* 1\.0e-08",
        "flow +1 ",
    ):
        assert len(re.findall(row, out)) == 1


@pytest.mark.parametrize("name", BUNDLED)
def test_warnings_of_bundled_robots_fit_a_terminal(name, capfd):
    from fflin.commands import cli

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        robot = fflin.load(name)
        warnings.simplefilter("always")
        beyond = [f"--joint={joint}=99" for joint in robot.joint_names]
        assert cli.main(["linearize", name, *beyond]) == 0
    out, err = capfd.readouterr()
    limited = sum(not joint.unbounded for joint in robot.joints)
    bounded = robot.model.upperPositionLimit[7:].max(initial=0.0) < 99.0
    assert len(err.splitlines()) == len(robot.notes) + limited * bounded
    assert all(line.startswith("fflin: warning: ") for line in err.splitlines())
    assert max(map(len, (out + err).splitlines())) <= 80


@pytest.mark.parametrize(
    "command",
    [
        ("linearize", "cubesat"),
        ("check", "cubesat"),
        ("analyze", "planar_detumble", "--stiffness", "3"),
        ("modes", "planar_detumble", "--stiffness", "3"),
        *exhaustive(
            (("lqr", "cubesat"),), (("validity", "cubesat", "--samples", "1"),)
        ),
    ],
)
def test_plot_draws_the_result_of_the_command(command, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    code, out, _ = run(*command, "--plot", tmp_path / "a.svg")
    assert code == 0 and out.endswith(f"wrote {tmp_path / 'a.svg'}\n")
    assert (tmp_path / "a.svg").read_bytes().startswith(b"<?xml")
    assert "'.bmp'" in refused(*command, "--plot", tmp_path / "a.bmp")
    assert "No such" in (
        message := refused(*command, "--plot", tmp_path / "no" / "a.png")
    ) or ("folder" in message)
    assert [path.name for path in tmp_path.iterdir()] == ["a.svg"]


def test_help_lists_every_command_once_by_its_task():
    code, out, _ = run("--help")
    assert code == 0 and max(map(len, out.splitlines())) <= 80
    assert "other:" not in out  # a new command is to be put beside those of its task
    listed = [
        line.split()[0]
        for line in out.splitlines()
        if line[:2] == "  " and line[2] > " "
    ]
    names = [name for name in listed if not name.startswith("-")]
    assert sorted(names) == sorted({*names})
    assert {"robots", "check", "modes", "lqr", "simulate", "sweep", "view"} <= {*names}
    sections = [part for part in out.split("\n\n") if ":\n" in part]
    close = next(part for part in sections if part.startswith("design and simulate:"))
    assert "lqr" in close and "simulate" in close and "info" not in close


def test_help_has_an_example_in_every_command():
    code, out, _ = run("--help")
    assert code == 0
    for command in ("robots", "info", "linearize", "check", "modes"):
        assert command in out
        code, text, _ = run(command, "--help")
        assert code == 0 and f"example: fflin {command}" in " ".join(text.split())
    assert run("--version")[1] == f"fflin {fflin.__version__}\n"


def test_short_help_fits_a_screen_and_full_help_has_every_option():
    (parsers,) = cli._parser("")._subparsers._group_actions
    for name, parser in parsers.choices.items():
        options = [
            action.option_strings[-1]
            for action in parser._actions
            if action.option_strings
        ]
        _, short, _ = run(name, "--help")
        _, full, _ = run(name, "--help", "all")
        listed = [line for line in short.splitlines() if line.startswith("  -")]
        assert len(listed) <= 20 and len(short.splitlines()) <= 55, name
        assert max(map(len, (*short.splitlines(), *full.splitlines()))) <= 80
        assert f"example: fflin {name}" in " ".join(short.split())
        assert all(
            re.search(rf"^  .*{option}\b", full, re.MULTILINE) for option in options
        ), name
        if options[1:]:
            assert short.endswith(
                f"help for all {len(options) - 1} options: fflin {name} --help all\n"
            )


def test_options_that_repeat_a_robot_file_are_in_one_group():
    repeated = {"lock", "xacro", "orbit", "stiffness", "damping", "gravity", "passive"}
    repeated |= {"inputs", "output", "weld", "independent", "inclination", "field"}
    (parsers,) = cli._parser("")._subparsers._group_actions
    for name in (
        "linearize",
        "check",
        "lqr",
        "simulate",
        "sweep",
        "montecarlo",
        "funnel",
    ):
        (group,) = (x for x in parsers.choices[name]._action_groups if x.title == ROBOT)
        assert {
            group_action.dest for group_action in group._group_actions
        } == repeated, name


@pytest.mark.sample
@pytest.mark.process
def test_closed_pipe_is_not_an_error():
    command = f"{sys.executable} -m fflin linearize talos | head -n 1"
    done = finished(
        ["bash", "-c", command],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parent,
    )
    assert done.stdout.startswith("linearize: ") and not without_warnings(done.stderr)


def test_wheels_from_a_file_at_speed(tmp_path):
    options = ("cubesat", "--inputs", "cubesat", "--velocity", "wheel_z=500")
    code, out, err = run("linearize", *options, "-o", "m.json", cwd=tmp_path)
    assert code == 0 and not err
    saved = json.loads((tmp_path / "m.json").read_text())
    names = saved["state_names"]
    row, column = names.index("omega_b.x"), names.index("omega_b.y")
    # (I - J a a^T) d(omega)/dt = -omega x h, h = 3e-6 * 500 about z
    expected = -3e-6 * 500.0 / (0.01520407970002 - 3e-6)
    assert saved["A"][row][column] == pytest.approx(expected, rel=1e-12)
    code, out, _ = run("check", *options)
    assert code == 0 and max(map(len, out.splitlines())) <= 80
    stored = tmp_path / "stored.toml"
    stored.write_text(
        '[[input]]\ntype = "reaction_wheel"\naxis = [0, 0, 1]\nmomentum = 0.1\n'
    )
    assert run("check", "cubesat", "--inputs", stored)[0] == 0
    err = refused("check", "cubesat", "--inputs", stored, "--velocity", "wheel_1=100")
    assert "'wheel_1'" in err


def test_linearize_shows_no_rounding_in_f0_and_calls_no_frozen_model_unstable():
    hover = ["linearize", "servicer_7dof", "--gravity", 0, 0, -9.81]
    code, held, _ = run(*hover, "--equilibrium")
    assert code == 0 and "a fixed point" in held
    assert says(held, "unstable") and "f0:" not in held
    code, falling, _ = run(*hover, "--joint", "joint_2=0.3", "--effort", "F_b.z=9000")
    assert code == 0 and "not a fixed point" in falling
    assert "unstable" not in falling and "f0:" in falling


def test_an_elliptic_orbit_is_given_by_perigee_and_apogee():
    code, out, _ = run("info", "cubesat", "--orbit", "500e3/900e3")
    assert code == 0
    assert "elliptic orbit 500 x 900 km over earth" in out
    code, out, _ = run("info", "cubesat", "--orbit", "100e3/300e3:mars")
    assert "elliptic orbit 100 x 300 km over mars" in out
    code, _, error = run("lqr", "cubesat", "--orbit", "500e3/900e3")
    assert code != 0
    assert "elliptic orbit" in error


@pytest.mark.exhaustive
def test_equilibria_in_orbit_are_taken_as_panels_sag(tmp_path):
    soft = ["servicer_7dof", "--passive", "panel_*", "--stiffness", "panel_*=40"]
    soft += ["--orbit", "400e3"]
    code, out, err = run("linearize", *soft, "--rpy", 5, 0, 0, "--equilibrium")
    assert (
        (code, err) == (0, "") and "a fixed point" in out and "q_m.panel_left = " in out
    )
    code, out, err = run("modes", *soft, "--relative-equilibrium")
    assert (code, err) == (0, "") and "not an equilibrium" not in out
    # A rigid body's libration, in closed form.
    code, out, _ = run("modes", "cubesat", "--orbit", "400e3", "--relative-equilibrium")
    result = fflin.relative_equilibria(fflin.load("cubesat", orbit=400e3))[0]
    assert code == 0 and all(f"{w:.6g}" in out for w in result.poles.imag if w > 0.0)
    for command in ("analyze", "lqr"):
        assert run(command, *soft, "--relative-equilibrium", 5)[0] == 0
    out = run("modes", *soft, "--rpy", 5, 0, 0)[1]
    assert "--relative-equilibrium" in out and max(map(len, out.splitlines())) <= 80
    assert run("lqr", *soft, "--rpy", 5, 0, 0)[0] == 0  # the inputs hold this point
    gain = tmp_path / "gain.npz"
    assert run("lqr", *soft, "--relative-equilibrium", 2, "-o", gain)[0] == 0
    short = ["--duration", 2, "--relative-equilibrium", 2, "--rpy", 0.5, 0, 0]
    for law in ((), ("--gain", gain), ("--free",)):
        code, out, _ = run("simulate", *soft, *short, *law)
        assert code == 0
    for words, options in {
        "--orbit": ["cubesat"],
        "25": [*soft, 25],
        "--rpy": [*soft, "--rpy", 5, 0, 0],
        "--effort": [*soft, "--effort", "F_b.x=1"],
    }.items():
        name, *more = options
        number = [more.pop()] if more and more[-1] == 25 else []
        assert words in refused("modes", name, *more, "--relative-equilibrium", *number)


def test_an_unknown_option_is_answered_with_the_help_of_its_command():
    code, _, err = run("lqr", "cubesat", "--target-joint", "a=0.3")
    assert code == 2
    assert err == (
        "fflin: error: unrecognized arguments: --target-joint a=0.3 (see fflin lqr --help)\n"
    )
    _, _, err = run("lqr", "cubesat", "--brison", "q_b=0.1")
    assert says(err, "--brison", "did you mean --bryson?")
