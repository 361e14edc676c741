"""The command lqg: its law equals the design in Python, and other commands fly and export it."""

import json

import numpy as np
import pytest

import fflin
from tests.support.c_code import COMPILERS, needs_compiler, outcome
from tests.support.commands import refused, run, warned

HEAD = """urdf = "cubesat"
disturbance = { tau_b = [2e-6, -1e-6, 0] }
"""
WHEELS = "".join(
    f'[[input]]\ntype = "reaction_wheel"\naxis = {axis}\ninertia = 1e-5\nmax = 1e-3\n'
    for axis in np.eye(3).tolist()
)
TORQUE = '[[input]]\ntype = "base_torque"\nmax = 1e-3\n'
THRUSTER = """[[input]]
type = "thruster"
frame = "base"
position = [0.1, 0, 0]
direction = [0, 1, 0]
max = 0.1
"""
TRACKER = """[[output]]
type = "star_tracker"
noise = { noise_equivalent_angle = 10.0 }
"""
GYROSCOPE = """[[output]]
type = "gyroscope"
frame = "base"
noise = { angle_random_walk = 0.1 }
bias = { bias_instability = 5.0 }
"""
POSITION = """[[output]]
type = "base_pose"
noise = 1e-3
"""
LATE = "sample = 0.5\ndelay = 0.25\n"
TIMES = ("--sample", 0.25, "--delay", 0.25)


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Work in an empty folder; return a function that writes a robot file from its parts."""
    monkeypatch.chdir(tmp_path)

    def written(*parts, name="satellite.toml"):
        (tmp_path / name).write_text("".join((HEAD, *parts)))
        return name

    return written


def design(robot):
    """Return the sampled model and the compensator in Python, with the noise of the command."""
    model = fflin.linearize(robot).discretize(0.25, delay=0.25)
    gain = fflin.lqr(model)
    noise = {"tau_b": (2e-6) ** 2 / 100.0}
    found = []
    for exponent in range(0, -7, -1):
        W = 10.0**exponent * np.linalg.inv(gain.R)
        B = model.undelayed.B
        estimator = fflin.kalman(model, W, G=B, disturbance_noise=noise)
        compensator = fflin.lqg(gain, estimator)
        found.append(compensator)
        if compensator.pace:  # the regulator had to be made slower for the margin
            found.pop()
            break
    return model, found[-1]


@pytest.mark.exhaustive
def test_the_law_of_the_command_is_the_design_in_python_and_is_flown(write):
    satellite = write(TORQUE, TRACKER, GYROSCOPE)
    code, out, err = run("lqg", satellite, *TIMES, "-o", "law.npz", "--json")
    assert (code, err) == (0, "")
    report = json.loads(out)
    assert report["files"] == ["law.npz"] and report["margins"]["disk"] >= 2 / 3
    robot = fflin.load(satellite)
    model, compensator = design(robot)
    assert np.abs(np.array(report["A"]) - compensator.A).max() < 1e-9
    saved = fflin.Compensator.load("law.npz")
    assert np.array_equal(saved.delay, [0.25, 0.25, 0.25])
    policy = fflin.OutputFeedback(model, saved)
    q0 = fflin.configuration(robot, rpy=(1, -2, 1))
    flight = {"duration": 20.0, "dt": 0.05, "limits": "urdf"}
    motion = fflin.simulate(robot, policy, q0=q0, **flight, noise=0.0)
    options = ("--controller", "law.npz", "--rpy", 1, -2, 1, "--no-noise")
    times = ("--duration", 20, "--dt", 0.05, "-o", "flown.npz")
    code, out, err = run("simulate", satellite, *options, *times)
    assert (code, err) == (0, "")
    assert np.array_equal(fflin.Motion.load("flown.npz").q[-1], motion.q[-1])
    # Both commands state the margins of the same loop.
    line = "margins of the linear loop, all inputs at once"
    assert line in out and line in run("lqg", satellite, *TIMES)[1]


@pytest.mark.exhaustive
def test_a_saved_law_follows_a_trajectory(write):
    satellite = write(TORQUE, TRACKER, GYROSCOPE)
    assert run("lqg", satellite, *TIMES, "-o", "law.npz")[0] == 0
    slew = ("--target-rpy", 20, 0, 0, "--duration", 30, "--knots", 11)
    free = [word for name in ("r_b", "v_b") for word in ("--free-end", name)]
    assert run("plan", satellite, *slew, *free, "-o", "slew.npz")[0] == 0
    flight = ("--trajectory", "slew.npz", "--controller", "law.npz")
    times = ("--duration", 40, "--dt", 0.05, "--no-noise")
    code, out, err = run("simulate", satellite, *flight, *times, "-o", "flown.npz")
    assert (code, err) == (0, ""), out
    robot = fflin.load(satellite)
    slewed = fflin.Trajectory.load("slew.npz", robot)
    law = fflin.OutputFeedback(design(robot)[0], fflin.Compensator.load("law.npz"))
    options = {"duration": 40.0, "dt": 0.05, "limits": "urdf", "noise": 0.0}
    motion = fflin.simulate(robot, law.follow(slewed), **options)
    flown = fflin.Motion.load("flown.npz")
    assert np.abs(flown.q - motion.q).max() < 1e-12
    # The attitude is held after the end. The filter still learns the constant torque.
    assert motion.q[-1, 3] == pytest.approx(np.sin(np.radians(10.0)), abs=1e-3)
    start = refused("simulate", satellite, *flight, "--rpy", 1, 0, 0)
    assert "the trajectory defines the start" in start
    weights = refused("simulate", satellite, *flight, "--sample", 1)
    assert "--controller replaces the regulator" in weights
    assert "--trajectory" in refused(
        "simulate", satellite, "--periodic", 9, *flight[2:]
    )
    for option in (("--period", 5), ("--motion", "free"), ("--bdot", 1.0)):
        assert option[0] in refused("simulate", satellite, *flight, *option)


@pytest.mark.exhaustive
def test_a_saved_law_of_base_torque_follows_a_plan_of_thrusts(write):
    text = ""
    for x, y in ((0, 1), (1, 2), (2, 0)):
        for arm in (0.1, -0.1):
            for sign in (1.0, -1.0):
                position = (arm * np.eye(3)[x]).tolist()
                direction = (sign * np.eye(3)[y]).tolist()
                text += '[[input]]\ntype = "thruster"\nframe = "base"\nmax = 0.1\n'
                text += f"position = {position}\ndirection = {direction}\n"
    satellite = write(text, '[[output]]\ntype = "base"\nnoise = 1e-4\n', GYROSCOPE)
    code, _, err = run("lqg", satellite, "--sample", 0.25, "-o", "law.npz")
    assert code == 0, err
    slew = ("--target-rpy", 5, 0, 0, "--duration", 30, "--knots", 11)
    code, _, err = run("plan", satellite, *slew, "-o", "slew.npz")
    assert code == 0, err
    flight = ("--trajectory", "slew.npz", "--controller", "law.npz", "--no-noise")
    times = ("--duration", 35, "--dt", 0.05, "-o", "flown.npz")
    code, _, err = run("simulate", satellite, *flight, *times)
    assert code == 0, err
    end = fflin.Motion.load("flown.npz").q[-1]
    assert end[3] == pytest.approx(np.sin(np.radians(2.5)), abs=1e-3)


def test_the_table_states_the_standard_deviations_of_the_filter(write):
    satellite = write(TORQUE, TRACKER, GYROSCOPE)
    _, out, _ = run(
        "lqg", satellite, *TIMES, "--process-noise", "omega_b=1e-10", "--json"
    )
    report = json.loads(out)
    model = fflin.linearize(fflin.load(satellite)).discretize(0.25, delay=0.25)
    noise = {"tau_b": (2e-6) ** 2 / 100.0}
    estimator = fflin.kalman(model, {"omega_b": 1e-10}, disturbance_noise=noise)
    sigma = dict(zip(estimator.state_names, np.sqrt(np.diag(estimator.P)), strict=True))
    shown = report["standard_deviations"]
    # q_b is half of a small rotation.
    assert shown["q_b.x"] == pytest.approx(np.degrees(2.0 * sigma["q_b.x"]))
    for name in ("omega_b.y", "disturbance.tau_b.x", "bias.base.gyroscope.z"):
        assert shown[name] == pytest.approx(sigma[name])
    units = report["units"]
    assert units["q_b.x"] == "deg" and units["disturbance.tau_b.x"] == "N m"
    assert not any(name.startswith("past") for name in shown)


def test_a_small_disk_margin_is_a_warning(write):
    satellite = write(TORQUE, TRACKER, GYROSCOPE)
    model = fflin.linearize(fflin.load(satellite)).discretize(1.0)
    gain = fflin.lqr(model, weights={"q": {"q_b": 1000.0}})
    estimator = fflin.kalman(model, {"v_b": 1e-6, "omega_b": 1e-6})
    law = fflin.OutputFeedback(model, fflin.lqg(gain, estimator))
    disk = fflin.margins(law, model).disk
    assert 0.0 < disk < 0.3
    options = ("--sample", 1.0, "--disturbance", "none")
    noise = ("--process-noise", "v_b=1e-6", "--process-noise", "omega_b=1e-6")
    [warning] = [
        text
        for text in warned("lqg", satellite, *options, "--q", "q_b=1000", *noise)
        if "filter" in text
    ]
    assert f"(disk margin {disk:.2g}, below 0.3)" in warning
    assert "--process-noise" in warning
    assert not warned("lqg", satellite, "--sample", 0.25)


RANGES = ("--vary", "base.density=0.2", "--vary", "base.inertia.xx=0.1")


@pytest.mark.exhaustive
@pytest.mark.parametrize("times", ["", LATE])
def test_vary_states_the_worst_margins_of_the_law_over_the_ranges(write, times):
    satellite = write(TORQUE, TRACKER, times, GYROSCOPE)
    noise = ("--process-noise", "omega_b=1e-10")
    command = ("lqg", satellite, *TIMES, *noise, *RANGES)
    code, out, err = run(*command, "-o", "law.npz", "--json")
    assert (code, err) == (0, "")
    robot = fflin.load(satellite)
    model = fflin.linearize(robot).discretize(0.25, delay=0.25)
    law = fflin.MultirateFeedback if times else fflin.OutputFeedback
    compensator = fflin.MultirateCompensator if times else fflin.Compensator
    ranges = {"base.density": 0.2, "base.inertia.xx": 0.1}
    policy = law(model, compensator.load("law.npz"))
    worst = fflin.uncertain(robot, ranges).worst(policy)
    shown = json.loads(out)["worst"]
    assert shown["margin"]["value"] == pytest.approx(worst.margin.value, rel=1e-9)
    assert shown["margin"]["parameters"] == dict(worst.margin.parameters)
    assert shown["damping"]["value"] == pytest.approx(worst.damping.value, rel=1e-9)
    assert (shown["unstable"], shown["safe"]) == (0, None)
    assert json.loads(out)["margins"]["disk"] > shown["margin"]["value"]
    text = " ".join(run(*command)[1].split())
    assert f"least disk margin {worst.margin.value:.4g} at base.density" in text
    assert "stability in the whole set is not guaranteed" in text


def test_vary_refuses_unknown_parameters_and_a_moving_operating_point(write):
    satellite = write(WHEELS, TRACKER, GYROSCOPE)
    message = refused("lqg", satellite, *TIMES, "--vary", "base.mas=0.1")
    assert "did you mean" in message and "base.mass" in message
    spinning = ("--velocity", "wheel_1=10", "--vary", "base.mass=0.1")
    assert "remove the ranges" in refused("lqg", satellite, *TIMES, *spinning)
    orbiting = ("--orbit", "600e3", "--vary", "base.mass=0.1")
    assert "add --orbit none" in refused("lqg", satellite, *TIMES, *orbiting)


@pytest.mark.exhaustive
def test_sensors_with_their_own_times_are_flown_with_all_inputs(write):
    satellite = write(WHEELS, THRUSTER, TRACKER, LATE, GYROSCOPE)
    options = ("--inputs", "wheels", "-o", "law.mat")
    code, out, err = run("lqg", satellite, *TIMES, *options, "--json")
    assert (code, err) == (0, "")
    assert json.loads(out)["margins"]["disk"] >= 2 / 3
    law = fflin.MultirateCompensator.load("law.mat")
    assert law.A.shape[0] == 2 and law.output_names == tuple(
        f"wheel_{k}" for k in (1, 2, 3)
    )
    flight = ("--rpy", 1, -2, 1, "--duration", 5, "--dt", 0.05, "--controller")
    command = ("simulate", satellite, *flight, "law.mat", "-o")
    assert run(*command, "all.npz")[::2] == (0, "")
    assert run(*command, "wheels.npz", "--inputs", "wheels")[::2] == (0, "")
    motions = [fflin.Motion.load(name) for name in ("all.npz", "wheels.npz")]
    assert np.abs(motions[0].q - motions[1].q).max() < 1e-12
    assert not motions[0].u[:, 3].any()


@needs_compiler
@pytest.mark.exhaustive
@pytest.mark.parametrize("times", ["", LATE])
def test_the_law_becomes_c_code(write, tmp_path, times):
    satellite = write(WHEELS, THRUSTER, TRACKER, times, GYROSCOPE)
    run("lqg", satellite, *TIMES, "--inputs", "wheels", "-o", "law.json")
    options = ("-o", "flight", "--robot", satellite, "--limits", "urdf")
    code, _, err = run("export", "law.json", *options)
    assert (code, err) == (0, "")
    assert outcome(tmp_path / "flight", COMPILERS[0])[0] == 0


@pytest.mark.exhaustive
def test_disturbances_of_the_robot_file_are_estimated_unless_the_gain_integrates(write):
    satellite = write(TORQUE, TRACKER, GYROSCOPE)

    def states(*options):
        noise = ("--process-noise", "omega_b=1e-10")
        code, out, err = run("lqg", satellite, *TIMES, *noise, *options, "--json")
        assert code == 0, err
        names = json.loads(out)["state_names"]
        kinds = ("disturbance", "integral", "bias")
        return [sum(name.startswith(kind) for name in names) for kind in kinds]

    assert states() == [3, 0, 3]
    assert states("--disturbance", "none") == [0, 0, 3]
    assert states("--disturbance", "tau_b.x=1e-12") == [1, 0, 3]
    assert states("--integral", "q_b") == [0, 3, 3]
    assert states("--disturbance-frequency", "tau_b=0.01") == [9, 0, 3]


def test_wrong_or_missing_data_are_refused_in_one_line(write):
    satellite = write(TORQUE, TRACKER, GYROSCOPE)
    assert "add --sample H" in refused("lqg", satellite)
    assert "has no sensors" in refused("lqg", "cubesat", "--sample", 1)
    no_noise = refused("lqg", "cubesat", "--sample", 1, "--output", "base")
    assert "q_b.x" in no_noise and "--noise NAME=SIGMA" in no_noise
    options = (*TIMES, "--disturbance", "F_b")
    assert "--disturbance F_b=INTENSITY" in refused("lqg", satellite, *options)
    late = write(TORQUE, TRACKER, LATE, GYROSCOPE, name="late.toml")
    integral = ("--integral", "q_b")
    message = refused("lqg", late, *TIMES, *integral)
    assert message.startswith("fflin: error: --integral q_b has no effect")
    both = refused("lqg", satellite, *TIMES, *integral, "--disturbance", "tau_b")
    assert "--integral q_b and --disturbance tau_b make two integrators" in both
    weighted = write(TORQUE, "[weights]\nintegral = ['q_b']\n", TRACKER, GYROSCOPE)
    message = refused("lqg", weighted, *TIMES, "--disturbance", "tau_b")
    assert "integral of [weights] in the robot file and --disturbance" in message
    assert "no reaction wheels" in refused("lqg", late, *TIMES, "--inputs", "wheels")
    words = "--inputs also accepts joints, base, wheels"
    assert words in refused("lqg", late, *TIMES, "--inputs", "wheel")
    run("lqg", satellite, *TIMES, "-o", "law.npz")
    negative = ("--controller", "law.npz", "--negative-feedback")
    assert "sign of its feedback" in refused("simulate", satellite, *negative)
    wheels = write(WHEELS, TRACKER, GYROSCOPE, name="wheels.toml")
    other = refused("simulate", wheels, "--controller", "law.npz")
    assert "tau_b.x" in other and "--inputs of the design" in other


def test_the_noise_of_a_star_tracker_is_given_by_its_name(write):
    satellite = write(TORQUE, TRACKER, GYROSCOPE)
    process = ("--process-noise", "omega_b=1e-10", "--json")
    by_sensor, by_state, other = (
        json.loads(run("lqg", satellite, *TIMES, *process, "--noise", noise)[1])
        for noise in ("star_tracker=1e-4", "q_b=1e-4", "star_tracker=1e-3")
    )
    assert by_sensor["A"] == by_state["A"]
    assert by_sensor["A"] != other["A"]
    message = refused("lqg", satellite, *TIMES, "--noise", "tracker=1e-4")
    assert "no output named 'tracker'" in message and "q_b" in message


def test_an_output_that_shows_the_missing_states_is_named(write):
    both = write(WHEELS, TORQUE, '[[input]]\ntype = "base_force"\n', TRACKER, GYROSCOPE)
    message = refused("lqg", both, *TIMES)
    assert "r_b.z" in message and '[[output]] (type = "base"' in message
    rates = write(WHEELS, TORQUE, TRACKER, GYROSCOPE, name="rates.toml")
    message = refused("lqg", rates, *TIMES)
    wheels = '["wheel_1", "wheel_2", "wheel_3"]'
    assert f'[[output]] (type = "rates", joints = {wheels})' in message
