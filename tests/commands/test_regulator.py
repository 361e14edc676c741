"""fflin lqr."""

import json
import re
import warnings

import numpy as np
import pytest

import fflin
from fflin.commands.cli import main
from tests.support.messages import hear_lines, says


def run(capsys, *arguments):
    code = main(["lqr", *arguments])
    out, err = capsys.readouterr()
    return code, out, hear_lines(err)


def test_it_shows_and_saves_the_gain_that_the_library_gives(capsys, tmp_path):
    path = tmp_path / "gain.npz"
    code, out, err = run(
        capsys,
        *("ets_vii", "--joint", "joint_2=0.4", "--q", "q_b=5", "--bryson", "tau_m=10"),
        *("--bryson", "q_m.joint_1=0.1", "--r", "tau_b.x=0.01", "-o", str(path)),
    )
    assert (code, err) == (0, "")
    assert max(map(len, out.removesuffix(f"wrote {path}\n").splitlines())) <= 80
    robot = fflin.load("ets_vii")
    lin = fflin.linearize(robot, fflin.configuration(robot, {"joint_2": 0.4}))
    rule = fflin.lqr(lin)
    saved = fflin.Gain.load(path)
    # One factor takes what is not given to the scale of the largest values.
    scale = saved.R[3, 3] / rule.R[3, 3]
    Q, R = scale * rule.Q, scale * rule.R.diagonal()
    for index, weight in {0: 5.0, 1: 5.0, 2: 5.0, 6: 100.0}.items():
        Q[index], Q[:, index], Q[index, index] = 0.0, 0.0, weight
    R[0], R[6:] = 0.01, 0.01
    expected = fflin.lqr(lin, Q, R)
    assert saved.Q == pytest.approx(Q, rel=1e-12) and saved.R == pytest.approx(
        np.diag(R), rel=1e-12
    )
    assert says(saved.weights, "q_b, tau_b.x, tau_m, q_m.joint_1")
    assert saved.K == pytest.approx(
        expected.K, rel=1e-9, abs=1e-9 * np.abs(expected.K).max()
    )
    for words in ("every entry", "A - B K", "disk margin", "q_b, tau_b.x"):
        assert words in out


def test_dt_keeps_the_continuous_cost(capsys, tmp_path):
    path = tmp_path / "gain.json"
    options = (
        "--weights",
        "identity",
        "--r",
        "tau_m=2",
        "--sample",
        "0.2",
        "-o",
        str(path),
    )
    assert run(capsys, "planar_detumble", *options)[0] == 0
    lin = fflin.linearize(fflin.load("planar_detumble"))
    cost = fflin.sampled_cost(lin, 0.2, 1.0, {"tau_b": 1.0, "F_b": 1.0, "tau_m": 2.0})
    saved = fflin.Gain.load(path)
    assert saved.dt == 0.2
    assert saved.K == pytest.approx(
        fflin.lqr(lin.discretize(0.2), *cost).K, rel=1e-6, abs=1e-6
    )


@pytest.mark.parametrize("dt", [None, 0.2])
def test_without_weights_the_limits_of_the_urdf_choose_them(capsys, tmp_path, dt):
    path = tmp_path / "gain.json"
    options = () if dt is None else ("--sample", str(dt))
    assert main(["lqr", "servicer_7dof", *options, "-o", str(path)]) == 0
    lin = fflin.linearize(fflin.load("servicer_7dof"))
    expected = fflin.lqr(lin.discretize(dt) if dt else lin)
    saved = fflin.Gain.load(path)
    assert (saved.K == expected.K).all() and saved.weights == expected.weights
    out = " ".join(capsys.readouterr().out.split())
    assert f"weights: {saved.weights}" in out and "URDF" in saved.weights


def test_joints_alone_cannot_hold_the_base(capsys):
    code, out, err = run(capsys, "ets_vii", "--inputs", "joints")
    assert (code, out) == (2, "")
    assert re.search(r"angular momentum.*\(--reduce\)$", err)
    code, out, err = run(capsys, "ets_vii", "--inputs", "joints", "--reduce")
    assert (code, err) == (0, "")
    assert "K (6 x 12)" in out and "q_m.joint_6" in out
    code, _, err = run(capsys, "servicer_7dof", "--inputs", "base")
    assert code == 2 and "momentum of joint_1, momentum of joint_2" in err
    code, _, err = run(capsys, "cubesat", "--inputs", "joints")
    assert code == 2 and "'cubesat'" in err


def test_invalid_input_is_one_line_and_leaves_no_file(capsys, tmp_path):
    for words, arguments in {
        "state named 'nope'": ("--q", "nope=1"),
        "input named 'nope'": ("--r", "nope=1"),
        "'taum'": ("--bryson", "taum=5"),
        "'q_b' (--bryson)": ("--bryson", "q_b=0"),
        "1e-200": ("--bryson", "q_b=1e-200"),
        "'q_b.x'": ("--bryson", "q_b=1", "--q", "q_b=1"),
        "eigenvalue -1": ("--q", "q_b=-1"),
        "eigenvalue 0": ("--r", "F_b.y=0"),
        "-1 s": ("--sample", "-1"),
        "q_b.x": ("--velocity", "omega_b.x=0.1"),
        "cannot balance": ("--gravity", "0", "0", "-9.81", "--inputs", "joints"),
        "--q": ("--q", "q_b=1", "--q", "q_b=2"),
    }.items():
        code, out, err = run(
            capsys, "ets_vii", *arguments, "-o", str(tmp_path / "k.npz")
        )
        assert (code, out) == (2, ""), words
        assert (
            err.count("\n") == 1 and err.startswith("fflin: error: ") and words in err
        ), err
    assert not list(tmp_path.iterdir())
    code, _, err = run(capsys, "ets_vii", "-o", str(tmp_path / "k.csv"))
    assert code == 2 and "'.csv'" in err
    code, out, err = run(capsys, "ets_vii", "-o", str(tmp_path / "nowhere" / "k.npz"))
    assert (code, out) == (2, "") and "k.npz" in err


WHEELS = "\n".join(
    f'[[input]]\ntype = "reaction_wheel"\nname = "wheel_{name}"\naxis = {axis}\ninertia = 3e-6'
    for name, axis in zip("xyz", ([1, 0, 0], [0, 1, 0], [0, 0, 1]), strict=True)
)


def test_three_wheels_hold_the_attitude_without_being_asked(capsys, tmp_path):
    inputs, path = tmp_path / "wheels.toml", tmp_path / "gain.json"
    inputs.write_text(WHEELS)
    code, out, err = run(capsys, "cubesat", "--inputs", str(inputs), "-o", str(path))
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines()[:-1])) <= 80
    assert says(out, "not regulated: r_b.x")
    saved = fflin.Gain.load(path)
    robot = fflin.load("cubesat", inputs=fflin.load_inputs(inputs))
    assert (saved.K == fflin.lqr(fflin.linearize(robot)).K).all() and len(
        saved.regulated
    ) == 6
    inputs.write_text(WHEELS.rpartition("[[input]]")[0])
    code, out, err = run(capsys, "cubesat", "--inputs", str(inputs))
    assert (code, out) == (
        2,
        "",
    ) and "angular momentum z" in err


def test_the_speeds_of_wheels_are_chosen_and_weighed(capsys, tmp_path):
    path = tmp_path / "gain.npz"
    common = ("cubesat", "--inputs", "cubesat", "-o", str(path))
    for options, speeds in (
        ((), 3),
        (("--no-wheel-speeds",), 0),
        (("--wheel-speeds",), 3),
    ):
        assert run(capsys, *common, *options)[0] == 0
        kept = fflin.Gain.load(path).regulated
        assert sum(name.startswith("qdot_m.wheel_") for name in kept) == speeds
    assert (
        run(capsys, *common, "--sample", "0.1", "--bryson", "qdot_m.wheel_z=0.5")[0]
        == 0
    )
    quick = fflin.Gain.load(path)
    assert run(capsys, *common, "--sample", "0.1")[0] == 0
    slow = fflin.Gain.load(path)
    at = slow.state_names.index("qdot_m.wheel_z")
    assert np.abs(quick.K[:, at]).max() > 10.0 * np.abs(slow.K[:, at]).max()
    assert says(quick.weights, "qdot_m.wheel_z", "limits")


def test_thrusters_that_are_to_pull_are_warned_of_where_they_are_designed_with(capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("always", fflin.FflinWarning)
        code, out, err = run(capsys, "cubesat", "--inputs", "cubesat", "--no-allocate")
        assert code == 0 and "negative thrust" not in out
        assert says(err, "fflin: warning: ", "negative thrust", "x_plus_top")
        code, out, err = run(capsys, "cubesat")
        assert (code, err) == (0, "") and "negative thrust" not in out
        code, out, err = run(capsys, "cubesat", "--inputs", "cubesat")
        assert (code, err) == (0, "")
        assert "tau_b and F_b are realised by the thrusters" in " ".join(out.split())


@pytest.mark.exhaustive
def test_the_loop_that_lqr_reports_is_the_loop_that_is_simulated(capsys, tmp_path):
    path, other = tmp_path / "gain.npz", tmp_path / "thrusts.npz"
    robot = ("cubesat", "--inputs", "cubesat")
    code, out, err = run(capsys, *robot, "-o", str(path))
    assert (code, err) == (0, "") and "--no-allocate" in out
    gain = fflin.Gain.load(path)
    assert gain.input_names[:6] == tuple(
        f"{x}.{axis}" for x in ("tau_b", "F_b") for axis in "xyz"
    )
    runs = []
    for options in ((), ("--gain", str(path))):
        messages = (
            "simulate",
            *robot,
            "--rpy",
            "5",
            "0",
            "0",
            "--duration",
            "2",
            *options,
        )
        assert main([*messages, "-o", str(tmp_path / "run.npz"), "--force"]) == 0
        runs.append(fflin.Motion.load(tmp_path / "run.npz"))
    assert (runs[0].u == runs[1].u).all() and (runs[0].u[:, :12] >= 0.0).all()
    assert runs[0].u[:, :12].max() > 1e-4
    # The thrusters themselves are weighted only if they are to be commanded one by one.
    code, _, err = run(capsys, *robot, "--r", "thrust=1")
    assert code == 2 and says(err, "no input named 'thrust'", "--no-allocate")
    assert (
        run(capsys, *robot, "--r", "thrust=1", "--no-allocate", "-o", str(other))[0]
        == 0
    )
    assert fflin.Gain.load(other).input_names[0] == "x_plus_top"


def test_margins_and_allocation_are_in_json(capsys):
    assert main(["lqr", "cubesat", "--inputs", "cubesat", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    robot = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    wheels = [item for item in robot.inputs if isinstance(item, fflin.ReactionWheel)]
    design = robot.replace(inputs=[fflin.BaseTorque(), fflin.BaseForce(), *wheels])
    margins = fflin.lqr(fflin.linearize(design)).margins
    assert result["allocated"] is True
    assert result["margins"]["disk"] == pytest.approx(margins.disk, rel=1e-9)
    assert result["margins"]["gain"] == pytest.approx(margins.gain, rel=1e-9)


def test_gravity_beyond_the_limits_is_reported_and_not_refused(capsys):
    options = ("--gravity", "0", "0", "-9.81", "--equilibrium")
    with warnings.catch_warnings():
        warnings.simplefilter("always", fflin.FflinWarning)
        code, out, err = run(capsys, "servicer_7dof", *options)
    assert code == 0 and says(err, "tau_m.panel_left")
    assert says(out, "tau_m.panel_left, tau_m.panel_right")


@pytest.mark.exhaustive
def test_a_simulation_reports_the_margins_of_its_loop(capsys):
    loop = ["planar_detumble", "--rpy", "0", "0", "10", "--duration", "5"]
    assert main(["simulate", *loop, "--json"]) == 0
    margins = json.loads(capsys.readouterr().out)["margins"]
    assert margins["disk"] > 1.0
    assert main(["simulate", *loop, "--sample", "0.2", "--delay", "0.2"]) == 0
    text = capsys.readouterr().out
    assert "margins of the linear loop" in text
    lin = fflin.linearize(fflin.load("planar_detumble"))
    late = lin.discretize(0.2, delay=0.2)
    expected = fflin.margins(fflin.lqr(late), late).disk
    assert f"(disk margin {expected:.3g})" in " ".join(text.split())
    assert main(["simulate", *loop, "--free"]) == 0
    assert "margins of the linear loop" not in capsys.readouterr().out


def test_none_switches_off_the_integrals_of_the_robot_file(tmp_path, capsys):
    file = tmp_path / "robot.toml"
    file.write_text('urdf = "planar_detumble"\n[weights]\nintegral = ["q_b.z"]\n')
    found = []
    for options in ((), ("--integral", "none"), ("--integral", "q_b.z")):
        assert main(["lqr", str(file), *options, "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out)["integrals"])
    assert found == [["integral.q_b.z"], [], ["integral.q_b.z"]]
