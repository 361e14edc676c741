"""The command tune: laws and goals of a robot file, its report, and flights of the saved law."""

import json

import numpy as np
import pytest

import fflin
from tests.support.c_code import COMPILERS, needs_compiler, outcome
from tests.support.commands import refused, run

FILE = """urdf = "cubesat"
outputs = ["base"]
[[input]]
type = "base_torque"
max = 1e-3
[tune]
sample = 0.5
delay = 0.5
starts = 1
steps = 15
[[tune.law]]
type = "pd"
shared = true
[[tune.law]]
type = "low_pass"
frequency = [0.5, 5.0]
[[tune.goal]]
type = "margin"
disk = 0.6
hard = true
[[tune.goal]]
type = "max_gain"
inputs = { tau_b = 1e-6 }
outputs = { q_b = 1e-2 }
"""


@pytest.fixture
def satellite(tmp_path, monkeypatch):
    """Write a robot file with the table [tune] into the working directory; return its name."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "satellite.toml").write_text(FILE)
    return "satellite.toml"


@pytest.mark.exhaustive
def test_a_robot_file_is_tuned_saved_flown_and_reported(satellite):
    code, out, err = run("tune", satellite, "-o", "law.npz", "--json")
    assert code == 0 and err.startswith("fflin: models of the plant\n")
    report = json.loads(out)
    assert report["met"] and report["files"] == ["law.npz"]
    assert [goal["label"] for goal in report["goals"]] == [
        "disk margin at the inputs",
        "gain tau_b to q_b",
    ]
    assert report["units"]["low_pass.frequency"] == "rad/s"
    robot = fflin.load(satellite)
    lin = fflin.linearize(robot).discretize(0.5, delay=0.5)
    policy = fflin.LinearController("law.npz", lin)
    assert fflin.margins(policy, lin).disk >= 0.6
    # The command flies the law of the file with its delay, as Python does.
    q0 = fflin.configuration(robot, rpy=(1, -2, 1))
    motion = fflin.simulate(robot, policy, q0=q0, duration=20.0, dt=0.1, limits="urdf")
    options = ("--controller", "law.npz", "--rpy", 1, -2, 1, "--duration", 20)
    code, out, err = run(
        "simulate", satellite, *options, "--dt", 0.1, "-o", "flown.npz"
    )
    assert (code, err) == (0, "")
    flown = fflin.Motion.load("flown.npz")
    assert np.array_equal(flown.q[-1], motion.q[-1])


def test_the_report_has_eighty_columns_and_options_replace_the_file(satellite):
    options = ("--law", "pd", "--goal", "decay rate=0.01", "--starts", 1)
    code, out, _ = run("tune", satellite, *options)
    assert code == 0 and "decay rate" in out and "disk" not in out
    assert max(map(len, out.splitlines())) <= 80
    assert out.startswith("tune: satellite: all goals hold")


@pytest.mark.exhaustive
def test_the_exit_code_says_whether_the_hard_goals_hold(satellite):
    hopeless = "max_gain inputs={tau_b=1} outputs={q_b=1e-9}"
    options = ("--steps", 5, "--goal", "decay rate=0.01 hard=true", "--goal")
    assert run("tune", satellite, *options, hopeless)[0] == 0
    assert run("tune", satellite, *options, f"{hopeless} hard=true")[0] == 1


@pytest.mark.exhaustive
def test_uncertain_parameters_come_from_the_file_or_the_option(satellite):
    options = ("--vary", "base.density=0.1", "--steps", 5, "--json")
    code, out, _ = run("tune", satellite, *options)
    assert code == 0
    assert json.loads(out)["examined"] > 200


@needs_compiler
@pytest.mark.exhaustive
def test_a_tuned_law_becomes_c_code(satellite, tmp_path):
    run("tune", satellite, "-o", "law.mat")
    code, _, err = run("export", "law.mat", "-o", "flight", "--robot", satellite)
    assert (code, err) == (0, "")
    assert outcome(tmp_path / "flight", COMPILERS[0])[0] == 0
    assert "give the robot of the design" in refused("export", "law.mat", "-o", "other")


def test_wrong_entries_are_refused_in_one_line(satellite):
    def replaced(old, new):
        text = FILE.replace(old, new)
        assert text != FILE
        with open("wrong.toml", "w") as file:
            file.write(text)
        return refused("tune", "wrong.toml")

    assert "wrong.toml:7" in replaced("sample", "sampl")
    assert "did you mean margin" in replaced('"margin"', '"margn"')
    assert "goal 1 (margin)" in replaced("disk =", "disc =")
    assert "did you mean tau_b" in replaced("tau_b = 1e-6", "tau_bb = 1e-6")
    assert "expected tables [[tune.law]]" in replaced(
        '[[tune.law]]\ntype = "pd"\nshared = true\n[[tune.law]]', "[tune.law]"
    )
    no_goal = "no goal is given; add --goal"
    assert no_goal in refused("tune", "cubesat", "--law", "pd")
    assert "velocities" in refused(
        "tune", satellite, "--vary", "*.density=0.1", "--velocity", "omega_b.x=0.1"
    )


@pytest.mark.exhaustive
def test_the_report_says_that_thrusters_produce_the_torque_of_the_law():
    command = ["tune", "inspector", "--output", "base", "--starts", "1", "--goal"]
    options = ["margin disk=0.5", "--law", "pd shared=true", "--inputs", "inspector"]
    _, text, _ = run(*command, *options)
    assert "fflin.Allocation" in text
    _, text, _ = run(*command, *options[:3], "--inputs", "base")
    assert "fflin.Allocation" not in text
