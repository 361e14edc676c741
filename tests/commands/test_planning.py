"""The commands plan and equilibrium, simulate --mpc, and the names of the two time steps."""

import json
import re

import numpy as np
import pytest

import fflin
from tests.support.commands import refused, run

ROBOT = "planar_detumble"


@pytest.mark.exhaustive
def test_a_plan_is_followed(tmp_path):
    locked = ("--lock", "joint_2", "--lock", "joint_3")
    target = ("--target-joint", "joint_1=0.3", "--duration", 20, "--knots", 5)
    command = ("plan", ROBOT, *locked, *target)
    code, out, _ = run(*command, "--limit", "tau_m=0.5", "-o", "p.npz", cwd=tmp_path)
    assert code == 0 and "wrote p.npz" in out
    robot = fflin.load(ROBOT, lock=["joint_2", "joint_3"])
    motion = fflin.Trajectory.load(tmp_path / "p.npz", robot)
    end = fflin.configuration(robot, {"joint_1": 0.3})
    assert np.abs(motion.q[0] - robot.neutral()).max() < 1e-9
    assert np.abs(motion.q[-1] - end).max() < 1e-6
    assert motion.residual.max() < 1e-5 and np.abs(motion.u[:, 6:]).max() <= 0.5 + 1e-9
    flown = run(
        "simulate",
        ROBOT,
        *locked,
        "--trajectory",
        "p.npz",
        "--dt",
        0.02,
        "-o",
        "m.npz",
        cwd=tmp_path,
    )
    assert flown[0] == 0
    # One percent of the displacement.
    assert np.abs(fflin.Motion.load(tmp_path / "m.npz").q[-1] - end).max() < 0.003
    assert "--duration" in refused("plan", ROBOT)


@pytest.mark.exhaustive
def test_a_plan_begins_at_the_trajectory_of_a_file(tmp_path):
    """From a plan, the search needs fewer iterations; the file is not overwritten."""
    locked = ("--lock", "joint_2", "--lock", "joint_3")
    target = ("--target-joint", "joint_1=0.3", "--duration", 20, "--knots", 6)
    command = ("plan", ROBOT, *locked, *target, "--limit", "tau_m=0.5")
    guess, iterations, efforts = (), [], []
    for name in ("first.csv", "again.csv"):
        code, out, err = run(*command, *guess, "-o", name, cwd=tmp_path)
        assert code == 0, err
        result = re.search(r"effort (\S+), KKT residuals\s+after (\d+) iterations", out)
        efforts.append(float(result[1]))
        iterations.append(int(result[2]))
        guess = ("--guess", "first.csv")
    assert iterations[1] < iterations[0] and efforts[1] <= efforts[0]
    code, _, err = run(
        *command, "--guess", "first.csv", "-o", "first.csv", cwd=tmp_path
    )
    assert code != 0 and "first.csv" in err
    assert "missing.csv" in refused(*command, "--guess", "missing.csv")


WHEELS = """
[[input]]
type = "reaction_wheel"
axis = [1, 0, 0]
inertia = 2e-4
[[input]]
type = "reaction_wheel"
axis = [0, 1, 0]
inertia = 2e-4
[[input]]
type = "reaction_wheel"
axis = [0, 0, 1]
inertia = 2e-4
"""


@pytest.mark.exhaustive
@pytest.mark.parametrize("degrees", [1.0, 30.0])
def test_wheels_alone_slew_a_body_at_rest(tmp_path, degrees):
    (tmp_path / "wheels.toml").write_text(WHEELS)
    command = [
        "plan",
        "cubesat",
        "--inputs",
        "wheels.toml",
        "--target-rpy",
        degrees,
        0,
        0,
    ]
    for name in ("r_b", "v_b", "omega_b"):
        command += ["--free-end", name]
    code, _, err = run(*command, "--duration", 60, "-o", "p.npz", cwd=tmp_path)
    assert code == 0, err
    robot = fflin.load(
        "cubesat", inputs=[fflin.ReactionWheel(a, inertia=2e-4) for a in np.eye(3)]
    )
    motion = fflin.Trajectory.load(tmp_path / "p.npz", robot)
    roll = 2.0 * np.arctan2(motion.q[-1, 3], motion.q[-1, 6])
    assert np.degrees(roll) == pytest.approx(degrees, abs=1e-6)
    assert np.abs(motion.v[-1]).max() < 1e-9


def test_an_equilibrium_has_its_inputs_and_its_stability(tmp_path):
    spring = ("--stiffness", "joint_1=3", "--joint", "joint_1=0.2")
    code, out, _ = run("equilibrium", ROBOT, *spring, "-o", "e.json", cwd=tmp_path)
    assert (
        code == 0
        and "neutral, it may drift" in out
        and "tau_m.joint_1 = 0.6 N m" in out
    )
    saved = json.loads((tmp_path / "e.json").read_text())
    robot = fflin.load(ROBOT, stiffness={"joint_1": 3.0})
    held = fflin.equilibrium(robot, fflin.configuration(robot, {"joint_1": 0.2}))
    assert (
        np.abs(saved["u"] - held.u).max() < 1e-9
        and np.abs(saved["q"] - held.q).max() < 1e-9
    )
    circle = fflin.load("cubesat", orbit=fflin.CircularOrbit(400e3))
    result = fflin.relative_equilibria(circle)
    k = next(k for k, item in enumerate(result) if item.stable is False)
    orbit = ("--orbit", 400e3, "--relative-equilibrium", k + 1)
    message = json.loads(run("equilibrium", "cubesat", *orbit, "--json")[1])
    assert message["stability"] == "unstable"
    assert message["largest_real_part"] == pytest.approx(
        result[k].poles.real.max(), rel=1e-6
    )
    assert "--effort" in refused("equilibrium", ROBOT, "--effort", "tau_m.joint_1=1")


def test_an_equilibrium_states_the_inputs_against_a_constant_disturbance(tmp_path):
    head = 'urdf = "cubesat"\n[disturbance]\ntau_b = [2e-5, 0, 0]\n'
    (tmp_path / "pushed.toml").write_text(head)
    title = "u against the constant disturbance too"
    out = run("equilibrium", "pushed.toml", cwd=tmp_path)[1]
    assert "u: all zero" in out
    assert f"{title}: tau_b.x = -2e-05 N m" in out
    message = json.loads(run("equilibrium", "pushed.toml", "--json", cwd=tmp_path)[1])
    assert message["disturbed_u"] == pytest.approx([-2e-5, 0, 0, 0, 0, 0], abs=1e-12)
    assert not any(message["u"])
    info = " ".join(run("info", "pushed.toml", cwd=tmp_path)[1].split())
    assert "disturbance, in simulations only: tau_b = 2e-05, 0, 0 N m (base" in info
    jet = '[[input]]\ntype = "thruster"\nframe = "base"\ndirection = [1, 0, 0]\n'
    (tmp_path / "jet.toml").write_text(head + jet + "position = [0, 0, 0]\n")
    code, out, _ = run("equilibrium", "jet.toml", cwd=tmp_path)
    assert code == 0
    assert f"{title}: none, the inputs of" in " ".join(out.split())


def test_an_equilibrium_beyond_the_limits_is_reported():
    heavy = ("equilibrium", "servicer_7dof", "--gravity", 0, 0, -9.81)
    message = json.loads(run(*heavy, "--json")[1])
    robot = fflin.load("servicer_7dof", gravity=(0.0, 0.0, -9.81))
    u = fflin.equilibrium(robot).u
    limits = fflin.linearize(robot).limits
    names = fflin.linearize(robot).input_names
    pairs = zip(names, np.abs(u), strict=True)
    expected = [name for name, size in pairs if size > limits.get(name, np.inf)]
    assert expected and set(message["beyond_limits"]) == set(expected)
    assert f"beyond their limits: {message['beyond_limits'][0]}" in run(*heavy)[1]
    light = run("equilibrium", "servicer_7dof", "--json")[1]
    assert json.loads(light)["beyond_limits"] == []


def test_predictive_control_keeps_the_limits(tmp_path):
    command = (
        "simulate",
        ROBOT,
        "--joint",
        "joint_1=0.3",
        "--duration",
        4,
        "--dt",
        0.05,
    )
    mpc = ("--mpc", "--sample", 0.2, "--horizon", 10, "--limit", "tau_m=0.1")
    code, *_ = run(*command, *mpc, "-o", "m.npz", cwd=tmp_path)
    motion, robot = fflin.Motion.load(tmp_path / "m.npz"), fflin.load(ROBOT)
    lin, limits = fflin.linearize(robot), ["urdf", {"tau_m": 0.1}]
    policy = fflin.mpc(lin, dt=0.2, horizon=10, limits=limits)
    q0 = fflin.configuration(robot, {"joint_1": 0.3})
    expected_value = fflin.simulate(
        robot, policy, q0=q0, duration=4.0, dt=0.05, limits=limits
    )
    assert code == 0 and np.abs(motion.u - expected_value.u).max() < 1e-9
    assert 0.1 - 1e-6 < np.abs(motion.u[:, 6:]).max() <= 0.1 + 1e-9
    assert "--sample" in refused(*command, "--mpc")
    assert "--allocate" in refused(*command, *mpc, "--allocate")


@pytest.mark.exhaustive
def test_the_former_names_of_the_time_steps_still_work(tmp_path, capsys):
    def x(*words):
        assert (
            run(
                "simulate",
                ROBOT,
                "--rpy",
                0,
                0,
                5,
                "--duration",
                1,
                *words,
                "-o",
                "m.npz",
                cwd=tmp_path,
            )[0]
            == 0
        )
        return fflin.Motion.load(tmp_path / "m.npz").x

    new, former = x("--sample", 0.1, "--dt", 0.02), x("--dt", 0.1, "--step", 0.02)
    assert np.array_equal(new, former) and not np.array_equal(new, x("--dt", 0.02))
    assert np.array_equal(x("--dt", 0.02), x("--step", 0.02))
    gains = [
        json.loads(run("lqr", ROBOT, name, 0.1, "--json")[1])
        for name in ("--dt", "--sample")
    ]
    assert gains[0] == gains[1] and gains[0]["dt"] == 0.1


def test_mpc_along_a_trajectory_names_the_way_in_python(tmp_path):
    robot = fflin.load("planar_detumble")
    rest = np.zeros((3, robot.nv))
    q = np.tile(robot.neutral(), (3, 1))
    motion = fflin.Trajectory(robot, [0.0, 1.0, 2.0], q, rest, np.zeros((3, 9)))
    motion.save(tmp_path / "rest.npz")
    path = tmp_path / "rest.npz"
    command = ("simulate", "planar_detumble", "--trajectory", path, "--sample", 0.2)
    err = refused(*command, "--mpc")
    assert "fflin.mpc(models, ...)" in err and "remove --mpc" in err
