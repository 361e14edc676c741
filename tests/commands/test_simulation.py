"""The command simulate as a user runs it."""

import os
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import scipy.io

import fflin
from tests.support.commands import refused, run
from tests.support.marks import exhaustive
from tests.support.messages import says
from tests.support.patience import finished


def test_a_loop_settles_is_saved_and_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    code, out, err = run(
        *("simulate", "ets_vii", "--rpy", 30, 0, 0, "--duration", 60, "--dt", 0.05),
        *("--plot", "loop.png", "-o", "loop.npz"),
        cwd=tmp_path,
    )
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 80
    motion = fflin.Motion.load(tmp_path / "loop.npz")
    assert motion.t[-1] == 60.0
    assert motion.attitude_error[0] == pytest.approx(30.0)
    assert motion.attitude_error[-1] < 0.01
    assert (tmp_path / "loop.png").stat().st_size > 50_000
    apart = np.abs(motion.x - motion.linear).max(axis=0)
    most = motion.state_names[apart.argmax()]
    assert says(out, f"{np.degrees(apart.max()):.3g} deg in {most}")
    assert out.splitlines()[-2:] == ["wrote loop.npz", "wrote loop.png"]


def test_an_arm_with_slow_joints_comes_back_within_its_limits(tmp_path):
    code, out, _ = run(
        *(
            "simulate",
            "canadarm2",
            "--joint",
            "joint_2=0.5",
            "--duration",
            60,
            "--dt",
            0.05,
        ),
        *("-o", "m.npz"),
        cwd=tmp_path,
    )
    assert code == 0 and "stopped" not in out
    motion = fflin.Motion.load(tmp_path / "m.npz")
    limits = fflin.linearize(fflin.load("canadarm2")).limits
    for names, rows in ((motion.input_names, motion.u), (motion.state_names, motion.x)):
        for name, row in zip(names, rows.T, strict=True):
            if not name.startswith("q_m."):
                assert np.abs(row).max() <= limits.get(name, np.inf), name
    joint = motion.x[:, motion.state_names.index("q_m.joint_2")]
    assert (
        joint[0] == 0.5 and abs(joint[-1]) < 0.4 * joint[0] and joint.max() == joint[0]
    )


@pytest.mark.exhaustive
def test_target_sampling_limits_and_delay(tmp_path):
    code, _, err = run(
        *("simulate", "ets_vii", "--target-joint", "joint_1=0.5", "--sample", 0.1),
        *("--limit", "tau_m=2", "--delay", 0.1, "--duration", 40, "--dt", 0.02),
        *("-o", "m.json"),
        cwd=tmp_path,
    )
    assert (code, err) == (0, "")
    motion = fflin.Motion.load(tmp_path / "m.json")
    joints = [
        i for i, name in enumerate(motion.input_names) if name.startswith("tau_m")
    ]
    assert np.abs(motion.u[:, joints]).max() == 2.0
    assert not motion.u[:5].any()
    assert motion.x[-1, motion.state_names.index("q_m.joint_1")] == pytest.approx(
        0.5, abs=0.02
    )


@pytest.mark.process
def test_thrusts_are_allocated_or_their_cut_is_reported(tmp_path):
    command = (
        "simulate",
        "cubesat",
        "--inputs",
        "cubesat",
        "--rpy",
        20,
        0,
        0,
        "--duration",
        80,
    )
    command = [sys.executable, "-m", "fflin", *map(str, command), "--sample", "0.1"]
    # Compiling takes longer than both runs.
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    settled = []
    for option in (("--no-allocate",), ()):
        done = finished(
            [*command, *option, "-o", "m.npz"],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env=environment,
        )
        assert done.returncode == 0
        motion = fflin.Motion.load(tmp_path / "m.npz")
        assert motion.input_names[0] == "x_plus_top" and (motion.u[:, :12] >= 0.0).all()
        assert motion.attitude_error[0] == pytest.approx(20.0)
        assert motion.attitude_error[-1] < 0.1
        settled.append(motion.t[motion.attitude_error > 0.4].max())
        assert (
            says(done.stderr, "negative thrust", "cut at zero")
            if option
            else not done.stderr
        )
    # Half of what the thrusters were to give was cut; the wheels gave their part.
    assert settled[1] < 0.85 * settled[0]
    assert "--allocate" in refused("simulate", "ets_vii", "--allocate")


def test_the_linear_model_is_shown_between_samples_and_inputs_stay_with_their_units(
    tmp_path,
):
    code, out, _ = run(
        *(
            "simulate",
            "cubesat",
            "--inputs",
            "cubesat",
            "--rpy",
            5,
            0,
            0,
            "--sample",
            0.5,
        ),
        *("--duration", 5, "-o", "m.npz", "--no-allocate"),
        cwd=tmp_path,
    )
    assert code == 0
    motion = fflin.Motion.load(tmp_path / "m.npz")
    assert motion.linear.shape == motion.x.shape
    # The wheels make some turns, and are left where they are then.
    base = [
        not name.partition(".")[2].startswith("wheel_") for name in motion.state_names
    ]
    assert np.abs(motion.linear - motion.x)[:, base].max() < 1e-4
    apart = np.abs(motion.linear - motion.x).max() / np.abs(motion.x).max()
    assert apart < 1e-3
    lines = out.splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith("largest inputs"))
    until = next(i for i, line in enumerate(lines) if line.startswith("thrusters"))
    inputs = [part for line in lines[at:until] for part in line.split(", ")]
    assert all(part.rstrip(",").endswith((" N", " N m")) for part in inputs)
    assert "e-1" not in " ".join(inputs)  # what is rounding is none of the largest
    assert max(map(len, lines)) <= 80


@pytest.mark.process
def test_the_motion_is_kept_though_nobody_reads_the_table(tmp_path):
    pipe = os.pipe()
    os.close(pipe[0])
    with os.fdopen(pipe[1], "w") as closed:
        command = [
            sys.executable,
            "-m",
            "fflin",
            "simulate",
            "cubesat",
            "--duration",
            "1",
        ]
        done = finished(
            [*command, "-o", "m.npz"],
            cwd=tmp_path,
            stdout=closed,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert done.stderr == ""
    assert len(fflin.Motion.load(tmp_path / "m.npz").t) == 101


@pytest.mark.parametrize("option", ["-o", "--plot"])
def test_a_place_that_cannot_be_written_is_reported_before_the_run(tmp_path, option):
    path = tmp_path / "nowhere" / ("m.npz" if option == "-o" else "m.png")
    code, out, err = run("simulate", "cubesat", option, path, cwd=tmp_path)
    assert (code, out) == (2, "")
    assert str(path) in err
    assert not list(tmp_path.iterdir())


@pytest.fixture
def interrupted(monkeypatch):
    right = fflin.simulate
    monkeypatch.setattr(
        fflin,
        "simulate",
        lambda *a, **k: replace(right(*a, **k), stopped="interrupted at t = 0.5 s"),
    )


@pytest.mark.exhaustive
def test_a_run_that_is_interrupted_takes_no_earlier_files_place(
    tmp_path, interrupted, capsys
):
    from fflin.commands import cli

    path, page, new = tmp_path / "m.npz", tmp_path / "m.html", tmp_path / "m.png"
    fflin.simulate(fflin.load("cubesat"), duration=0.1).save(path)
    earlier = path.read_bytes()
    command = [
        "simulate",
        "cubesat",
        "--duration",
        "1",
        "-o",
        str(path),
        "--plot",
        str(new),
    ]
    with pytest.raises(KeyboardInterrupt) as caught:
        cli.main(command)
    assert says(str(caught.value), "t = 0.5 s", str(path))
    assert path.read_bytes() == earlier
    message = capsys.readouterr().out
    assert f"wrote {new}" in message and str(path) not in message and new.is_file()
    page.write_text("earlier")
    with pytest.raises(KeyboardInterrupt, match=r"m\.html"):
        cli.main(["simulate", "cubesat", "--duration", "1", "--html", str(page)])
    assert page.read_text() == "earlier"


def test_a_run_that_is_interrupted_is_kept(tmp_path, interrupted, capsys):
    from fflin.commands import cli

    path = tmp_path / "m.npz"
    with pytest.raises(KeyboardInterrupt, match="interrupted"):
        cli.main(["simulate", "cubesat", "--duration", "1", "-o", str(path)])
    assert f"wrote {path}" in capsys.readouterr().out
    assert fflin.Motion.load(path).stopped == "interrupted at t = 0.5 s"


def test_a_free_robot_keeps_its_energy():
    code, out, _ = run(
        *("simulate", "planar_detumble", "--free", "--velocity", "omega_b.z=0.3"),
        *("--duration", 2),
    )
    assert code == 0
    energy = next(line for line in out.splitlines() if line.startswith("energy"))
    first, last = re.findall(r"([0-9.]+) J", energy)
    assert float(first) == pytest.approx(float(last), rel=1e-5) and float(first) > 1.0


def test_joints_alone_cannot_hold_the_base_but_the_reduced_part():
    err = refused("simulate", "ets_vii", "--inputs", "joints", "--duration", 1)
    assert "angular momentum" in err
    assert "--reduce" in err
    code, out, _ = run(
        *(
            "simulate",
            "ets_vii",
            "--inputs",
            "joints",
            "--reduce",
            "--joint",
            "joint_1=0.3",
        ),
        *("--duration", 50, "--dt", 0.05),
    )
    assert code == 0
    joints = next(line for line in out.splitlines() if line.startswith("joints"))
    assert joints.split()[1] == "deg"
    assert float(joints.split()[4]) < np.degrees(1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--plot", "loop.bmp"], "'.bmp'"),
        (["-o", "loop.xyz"], "'.xyz'"),
        (["--limit", "tau_x=1"], "tau_x"),
        (["--free", "--reduce"], "--free"),
        (["--free", "--weights", "identity"], "--free"),
        (["--free", "--limit", "tau_m=1"], "--free"),
        (["--dt", "5"], "too large for the mode"),
        (["--method", "rk4"], "method"),
    ],
)
def test_invalid_input_is_one_line_and_leaves_nothing(tmp_path, arguments, message):
    assert message in refused(
        "simulate", "ets_vii", "--duration", 20, *arguments, cwd=tmp_path
    )
    assert not list(tmp_path.iterdir())


def test_inputs_are_cut_to_the_limits_of_the_robot_unless_another_limit_is_given(
    tmp_path,
):
    (tmp_path / "weak.toml").write_text(
        "[[input]]\ntype = 'base_torque'\nmax = 1e-3\n[[input]]\ntype = 'base_force'\n"
    )
    command = ("simulate", "cubesat", "--inputs", "weak.toml", "--weights", "identity")
    command = (
        *command,
        "--rpy",
        20,
        0,
        0,
        "--duration",
        1,
        "--dt",
        0.01,
        "-o",
        "m.npz",
    )

    def largest(*options):
        code, out, _ = run(*command, *options, cwd=tmp_path)
        assert code == 0
        assert max(map(len, out.splitlines())) <= 80
        return np.abs(fflin.Motion.load(tmp_path / "m.npz").u[:, 0]).max(), out

    size, out = largest()
    assert size == 1e-3
    assert says(out, "tau_b.x", "limit", "-0.001 N m") and "exceeded" not in out
    size, _ = largest("--limit", "tau_b=2e-3")
    assert size == 2e-3
    size, out = largest("--limits", "none")
    assert size > 0.1
    assert says(out, "limit exceeded", "tau_b.x -0.1")
    size, _ = largest("--limits", "none", "--limit", "tau_b.x=3e-3")
    assert size == 3e-3
    assert "--limits" in refused("simulate", "cubesat", "--limits", "all")


def wheels_file(tmp_path, count=3):
    path = tmp_path / "wheels.toml"
    axes = zip("xyz", ([1, 0, 0], [0, 1, 0], [0, 0, 1]), strict=True)
    blocks = [
        f'[[input]]\ntype = "reaction_wheel"\nname = "wheel_{n}"\naxis = {a}\ninertia = 3e-6\n'
        for n, a in axes
    ]
    path.write_text("".join(blocks[:count]))
    return path


@pytest.mark.parametrize(
    "options", [(), *exhaustive((("--reduce",),), (("--sample", 0.2),))]
)
@pytest.mark.exhaustive
def test_three_wheels_settle_the_attitude(tmp_path, options):
    code, _, err = run(
        *("simulate", "cubesat", "--inputs", wheels_file(tmp_path), "--rpy", 30, 0, 0),
        *(*options, "-o", "m.npz"),
        cwd=tmp_path,
    )
    assert (code, err) == (0, "")
    motion = fflin.Motion.load(tmp_path / "m.npz")
    assert (
        motion.attitude_error[0] == pytest.approx(30.0)
        and motion.attitude_error[-1] < 0.01
    )
    assert np.abs(motion.u).max() > 1e-4 and np.abs(motion.momentum).max() < 1e-12


@pytest.mark.compiled
@pytest.mark.exhaustive
def test_a_target_velocity_is_the_points_and_is_held(tmp_path):
    pytest.importorskip("numba")

    def speeds(*options):
        code, _, _ = run("simulate", "cubesat", *options, "-o", "m.npz", cwd=tmp_path)
        assert code == 0
        motion = fflin.Motion.load(tmp_path / "m.npz")
        at = motion.state_names.index("qdot_m.wheel_z")
        return motion.x[:, at], motion.target[at], motion

    options = ("--inputs", wheels_file(tmp_path), "--target-velocity", "wheel_z=500")
    speed, target, _ = speeds(*options, "--duration", 5)
    assert target == 500.0 and speed == pytest.approx(
        np.full(len(speed), 500.0), abs=1e-9
    )
    # With thrusters it comes back from another speed, and the body hardly notices.
    options = (
        "--inputs",
        "cubesat",
        "--target-velocity",
        "wheel_z=500",
        "--duration",
        300,
    )
    speed, target, motion = speeds(
        *(*options, "--velocity", "wheel_z=450", "--dt", 0.05, "--engine", "compiled")
    )
    assert (speed[0], target) == (450.0, 500.0) and abs(speed[-1] - 500.0) < 1.0
    assert motion.attitude_error.max() < 2.0 and motion.attitude_error[-1] < 0.01
    assert "--free" in refused(
        "simulate", "cubesat", "--free", "--target-velocity", "omega_b.x=1"
    )
    assert "more than once for 'wheel_x'" in refused(
        *("simulate", "cubesat", "--inputs", wheels_file(tmp_path)),
        *("--target-velocity", "wheel_x=1", "--target-velocity", "wheel_x=2"),
    )


def test_unregulated_modes_are_reported(tmp_path):
    wheels = ("cubesat", "--inputs", wheels_file(tmp_path), "--position", 1, 0, 0)
    joints = ("ets_vii", "--inputs", "joints", "--reduce", "--rpy", 30, 0, 0)
    for command, error in ((wheels, "position"), (joints, "attitude")):
        code, out, _ = run("simulate", *command, "--duration", 1)
        assert code == 0
        assert re.search(rf"{error} .* not controlled\n", out)


def test_show_is_checked_before_the_run(tmp_path):
    message = refused(
        *("simulate", "ets_vii", "--show", "q_x", "--plot", tmp_path / "a.png"),
        *("--limit", "nothing=1"),  # what the run itself would refuse
    )
    assert "'q_x'" in message


def test_an_on_off_thruster_without_samples_names_dt_in_its_error(tmp_path):
    (tmp_path / "t.toml").write_text(
        'urdf = "cubesat"\n[[input]]\ntype = "base_torque"\n[[input]]\ntype = "thruster"\n'
        'frame = "base"\nposition = [0, 0, 0]\ndirection = [1, 0, 0]\nmax = 1\non_off = true\n'
    )
    message = refused(
        "simulate", tmp_path / "t.toml", "--no-allocate", "--rpy", 9, 0, 0, "--reduce"
    )
    assert says(message, "(--sample)")


@pytest.mark.exhaustive
@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_a_controller_from_a_file_closes_the_loop(tmp_path, dt):
    robot = fflin.load("ets_vii", outputs=[fflin.BasePose(), fflin.JointPositions()])
    lin = fflin.linearize(robot)
    lin = lin.discretize(dt) if dt else lin
    controller = fflin.lqg(fflin.lqr(lin), fflin.kalman(lin, 1e-3, 1e-4))
    turned = {
        "A": controller.A,
        "B": controller.B,
        "C": -controller.C,
        "D": np.zeros((len(controller.C), controller.B.shape[1])),
        "Ts": dt,
    }
    scipy.io.savemat(tmp_path / "K.mat", turned)
    options = (
        "simulate",
        "ets_vii",
        "--output",
        "base",
        "--output",
        "joints",
        "--dt",
        0.05,
    )
    options = (
        *options,
        "--rpy",
        10,
        0,
        0,
        "--controller",
        "K.mat",
        "--negative-feedback",
    )
    code, out, err = run(*options, "-o", "m.npz", cwd=tmp_path)
    assert (code, err) == (0, "") and "settled" in out
    motion = fflin.Motion.load(tmp_path / "m.npz")
    assert (
        motion.attitude_error[0] == pytest.approx(10.0)
        and motion.attitude_error[-1] < 0.05
    )
    policy = fflin.LinearController(controller, lin)
    again = fflin.simulate(
        robot, policy, q0=motion.q[0], duration=motion.t[-1], dt=0.05
    )
    assert np.abs(again.x - motion.x).max() < 1e-9
    (tmp_path / "u.toml").write_text("[dispersions]\nq_b = 0.01\n'*.sensor' = 1e-4\n")
    code, out, err = run(
        *("montecarlo", *options[1:], "u.toml", "--runs", 4, "--duration", 2),
        cwd=tmp_path,
    )
    assert (code, err) == (0, "")


def test_controllers_that_do_not_fit_are_refused(tmp_path):
    scipy.io.savemat(tmp_path / "K.mat", {"K": np.eye(3)})
    robot = ("simulate", "ets_vii", "--controller", "K.mat")
    assert "A, B, C, D" in refused(*robot, cwd=tmp_path)
    scipy.io.savemat(tmp_path / "K.mat", {"D": np.eye(3)})
    assert "3 inputs" in refused(*robot, cwd=tmp_path)
    assert "--sample: --controller" in refused(*robot, "--sample", 1, cwd=tmp_path)
    assert "--free" in refused(*robot, "--free", cwd=tmp_path)
    assert "--controller" in refused("simulate", "cubesat", "--negative-feedback")
    assert "none.mat" in refused(*robot[:3], "none.mat", cwd=tmp_path)
    unstable = {"D": 100.0 * np.eye(12, 24, 6)}
    scipy.io.savemat(tmp_path / "K.mat", unstable)
    code, out, err = run(
        *(*robot, "--rpy", 1, 0, 0, "--limit", "tau_b=1", "--duration", 5), cwd=tmp_path
    )
    assert not err
    assert says(out, "unstable")
    assert sorted(tmp_path.iterdir()) == [tmp_path / "K.mat"] and code in (0, 1)
