"""Every command says its result in its first line, and shows nothing wide, long or twice."""

import re
from collections import Counter

import pytest

import fflin
from tests.support.commands import run
from tests.support.messages import any_wording
from tests.support.robots import mostly

ROBOTS = ("planar_detumble", "ets_vii", "servicer_7dof", "inspector", "canadarm2")

# What each command is given beside the robot, and what its first line says.
COMMANDS = {
    "info": ((), r"\d+ joints, \d+ states"),
    "linearize": ((), r"\d+ states, \d+ inputs"),
    "check": ((), r"A and B of \w+: verified, largest error \S+ \(allowed"),
    "analyze": ((), "controllable"),
    "modes": ((), r"\d+ rigid-body modes"),
    "lqr": ((), r"\d+ poles, slowest decay \S+ 1/s, smallest damping ratio"),
    "sensitivity": ((), "changes A and B most"),
    "uncertain": (("--vary", "base.mass=0.2"), r"1 parameter"),
    "simulate": (
        ("--rpy", 5, 0, 0, "--dt", 0.05),
        "settled after .*; saturated inputs: none",
    ),
    "validity": (("--samples", 3), "within 10 %"),
    "init": (("--force", "-o", "own.toml"), r"run: fflin simulate own\.toml"),
}
MOST = 24  # rows of a table: about a screen


def judge(out, command, words):
    lines = out.splitlines()
    assert lines[0].startswith(f"{command}: "), lines[0]
    # A line that is folded goes on below, indented.
    first = re.match(r".*(\n {2}\S.*)*", out)[0]
    assert re.search(words, " ".join(first.split())), first
    assert max(map(len, lines)) <= 80
    twice = [x for x, n in Counter(lines).items() if n > 1 and re.search(r"\w", x)]
    assert not twice
    assert max(part.count("\n") for part in out.split("\n\n")) <= MOST


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("robot", mostly(ROBOTS, "planar_detumble"))
def test_a_report_is_read_at_a_glance(robot, command, tmp_path, brief_validity):
    options, words = COMMANDS[command]
    code, out, err = run(command, robot, *options, cwd=tmp_path)
    assert code == 0 and not err
    judge(out, command, words)


# Those of a trajectory, in the order that each needs, and those of many runs.
CHAIN = {
    "linearize": (("--trajectory", "plan.npz"), r"\d+ knots, 0 to 0.5 s"),
    "check": (("--trajectory", "plan.npz"), r"A and B of \w+: verified, largest error"),
    "tvlqr": (("--trajectory", "plan.npz", "-o", "gains.npz"), r"knots=\d+"),
    "funnel": (
        (
            "--schedule",
            "gains.npz",
            "--goal",
            "attitude=5",
            "--knots",
            2,
            "--samples",
            2,
        ),
        "every run ends with attitude up to 5 deg",
    ),
    "sweep": (("--random", 3, "-o", "grid.npz"), "3 points"),
    "montecarlo": (
        ("spread.toml", "--runs", 4, "--duration", 1, "--goal", "attitude < 9 deg"),
        r"attitude < 9 deg: \S+ %",
    ),
}


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
@pytest.mark.exhaustive
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_report_of_a_trajectory_and_of_many_runs_is_too(robot, tmp_path):
    (tmp_path / "spread.toml").write_text(
        '[dispersions]\n"base.mass" = 0.1\nq_b = 0.05\n'
    )
    fflin.simulate(fflin.load(robot), duration=0.5, dt=0.1).trajectory().save(
        tmp_path / "plan.npz"
    )
    for command, (options, words) in CHAIN.items():
        code, out, err = run(command, robot, *options, cwd=tmp_path)
        assert code == 0, err
        judge(out, command, words)


@pytest.mark.exhaustive
def test_the_list_of_robots_begins_with_how_many_load():
    lines = run("robots")[1].splitlines()
    assert re.fullmatch(
        r"robots: \d+ robots can be loaded by name; 1 cannot be loaded", lines[0]
    )
    assert len(set(lines) - {""}) == len([line for line in lines if line])


def test_the_head_of_the_modes_continues_indented():
    given = ("planar_detumble", "--damping", "0.2", "--stiffness", "joint_1=0.3")
    with any_wording():
        code, out, _ = run("modes", *given)
    first, second, blank, *_ = out.splitlines()
    assert code == 0 and not blank and second.startswith("  ") and len(first) <= 80
    # The second line begins with a word that the first has no room for.
    assert len(first) + 1 + len(second.split()[0]) > 80
