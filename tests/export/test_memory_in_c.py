"""C code of laws with integrals: the test program, and 2,000 samples against Python."""

import subprocess

import numpy as np
import pytest

import fflin
from fflin.export.c_code import CLaw
from tests.support.motions import displaced

H = 0.05
SAMPLES = 2_000
LIMITS = {"tau_b": 0.1, "F_b": 0.1}


def designed(kind):
    robot = fflin.load("planar_detumble")
    if kind == "outputs":
        robot = robot.replace(
            outputs=[
                fflin.BasePose(),
                fflin.Gyroscope("base"),
                fflin.JointPositions(),
                fflin.JointVelocities(),
            ]
        )
    lin = fflin.linearize(robot).discretize(H)
    gain = fflin.lqr(lin, integral_action=["q_b", "q_m"])
    if kind == "gain":
        return robot, lin, gain, fflin.StateFeedback(lin, gain)
    if kind == "states":
        policy = fflin.StateFeedback(lin, gain)
        return robot, lin, policy, policy
    policy = fflin.OutputFeedback(lin, fflin.lqg(gain, fflin.kalman(lin, 1e-3, 1e-4)))
    return robot, lin, policy, policy


@pytest.mark.process
@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("limits", [None, LIMITS])
@pytest.mark.parametrize("kind", ["gain", "states", "outputs"])
def test_the_test_program_agrees(tmp_path, kind, limits, real):
    robot, _, law, _ = designed(kind)
    fflin.write_c(law, tmp_path, robot=robot, limits=limits, real=real)
    program = tmp_path / "test"
    sources = ["controller.c", "controller_test.c"]
    flags = [
        "-std=c99",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-pedantic",
        "-ffp-contract=off",
    ]
    command = ["cc", *flags, "-o", str(program), *sources, "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True, timeout=60)
    done = subprocess.run(
        [program], check=False, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stdout


@pytest.mark.process
@pytest.mark.parametrize("kind", ["states", "outputs"])
def test_the_code_equals_python_over_two_thousand_samples(tmp_path, kind):
    robot, lin, law, policy = designed(kind)
    code = CLaw(fflin.write_c(law, tmp_path, robot=robot, limits=LIMITS)).bind(robot)
    command = policy.bind(robot)
    high = np.array([LIMITS.get(x.partition(".")[0], np.inf) for x in lin.input_names])
    state = fflin.StateMap(robot)
    random = np.random.default_rng(5)
    size = displaced(lin, degrees=30.0)
    limited = 0
    for k in range(SAMPLES):
        q, v = state.to_pinocchio(
            lin.x0 + size * np.sin(0.01 * k + 6.0 * random.random())
        )
        expected = command(k * H, q, v)
        u = np.clip(expected, -high, high)
        command.correct(u - expected)
        limited += (u != expected).any()
        assert np.abs(code(k * H, q, v) - u).max() < 1e-12 * max(1.0, np.abs(u).max())
    assert 100 < limited < SAMPLES


@pytest.mark.process
def test_a_motion_with_the_code_equals_the_motion_with_the_law(tmp_path):
    robot, lin, law, policy = designed("states")
    code = CLaw(fflin.write_c(law, tmp_path, limits=LIMITS))
    run = {
        "x0": displaced(lin, degrees=20.0),
        "duration": 5.0,
        "dt": 0.01,
        "limits": LIMITS,
        "linear": False,
        "frame": None,
    }
    one, other = (fflin.simulate(robot, law, **run) for law in (policy, code))
    assert np.abs(one.x - other.x).max() < 1e-11


def test_a_continuous_law_with_integrals_is_refused(tmp_path):
    lin = fflin.linearize(fflin.load("planar_detumble"))
    gain = fflin.lqr(lin, integral_action=["q_b"])
    with pytest.raises(fflin.InputError, match="continuous"):
        fflin.write_c(gain, tmp_path)


@pytest.mark.parametrize("ending", ["npz", "json"])
def test_a_gain_with_integrals_from_a_file_gives_the_same_code(tmp_path, ending):
    robot, _, gain, _ = designed("gain")
    gain.save(tmp_path / f"gain.{ending}")
    read = fflin.Gain.load(tmp_path / f"gain.{ending}")
    one = fflin.write_c(gain, tmp_path / "one", robot=robot)
    other = fflin.write_c(read, tmp_path / "other", robot=robot)
    name = "controller.c"
    assert (one / name).read_text() == (other / name).read_text()
