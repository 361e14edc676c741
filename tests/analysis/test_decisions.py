"""Decisions beside exact arithmetic, equal on every processor, and told where rounding makes them.

``python -m tests.support.decisions --exact`` judges all 800 cases that this file takes a part of.
"""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fflin
from fflin.analysis.mechanics import shape
from tests.support import decisions
from tests.support.mechanisms import mechanical, motors
from tests.support.messages import says
from tests.support.patience import finishing
from tests.support.robots import random_tree

CORES = ("", "Haswell", "Nehalem", "Prescott", "Sandybridge")


@pytest.mark.parametrize(
    "seeds",
    [
        (164, 193, 253, 388, 520, 627, 740),  # of those that rounding once decided
        pytest.param(range(20, 75), marks=pytest.mark.exhaustive),
    ],
    ids=["picked", "many"],
)
def test_random_decisions_match_exact_arithmetic(robots, seeds):
    wrong, doubts, count = {}, 0, 0
    for seed in seeds:
        lin, K, D = decisions.case(seed, robots)
        true = decisions.truth(lin, K, D)
        for dt in decisions.PERIODS:
            decided = decisions.decisions(lin.discretize(dt) if dt else lin)
            doubts += bool(decided["doubts"])
            count += 1
            if {key: decided[key] for key in true} != true:
                wrong[seed, dt] = decided, true
    assert not wrong
    assert doubts <= count // 100


@pytest.mark.process
def test_the_decisions_are_the_same_on_every_processor():
    root = Path(__file__).parents[2]

    def start(core):
        chosen = {"OPENBLAS_CORETYPE": core} if core else {}
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", **chosen}
        command = [sys.executable, "-m", "tests.support.decisions", "--count", "12"]
        return subprocess.Popen(
            command, cwd=root, env=environment, stdout=subprocess.PIPE, text=True
        )

    outputs = []
    for pair in (CORES[:2], CORES[2:4], CORES[4:]):
        running = [start(core) for core in pair]
        for process in running:
            with finishing(process):
                outputs.append(process.communicate()[0])
        assert not any(process.returncode for process in running)
    result = [json.loads(output) for output in outputs]
    assert len(result[0]) == 12 * len(decisions.PERIODS)
    for core, other in zip(CORES, result, strict=True):
        assert {key for key in other if other[key] != result[0][key]} == set(), core


def test_equal_ends_leave_a_vibration_that_the_middle_cannot_drive(robots):
    """Both ends of this arm weigh the same, so that they may turn against what is between."""
    robot = robots["canadarm2"]
    robot = robot.replace(inputs=motors(robot)[2:4], stiffness=8.063)
    lin = fflin.linearize(robot)
    for model in (lin, lin.discretize(0.1)):
        result = fflin.controllability(model)
        assert result.dimension == 12 and not any(
            "undecided" in note for note in result.notes
        )


def weakly_driven(robots, weak):
    """Twelve oscillators, of which the last is driven and moves another as weakly as given."""
    like = fflin.linearize(robots["ets_vii"])
    K = np.diag(1.0 + np.arange(12.0))
    K[10, 11] = K[11, 10] = weak
    S = np.eye(12)[:, [*range(10), 11]]
    return mechanical(np.eye(12), K, 0.0 * K, S, like)


def test_a_decision_within_rounding_names_the_state_and_both_answers(
    robots, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "80")
    clear = fflin.controllability(weakly_driven(robots, 1e-6))
    assert clear.dimension == 24 and not clear.notes and clear.margin.kept > 1e4
    none = fflin.controllability(weakly_driven(robots, 0.0))
    assert none.dimension == 22 and none.margin.dropped < 0.1
    seen = set()
    for exponent in np.arange(-11.4, -9.8, 0.25):
        result = fflin.controllability(weakly_driven(robots, 10.0**exponent))
        (note,) = result.notes
        other = 22 if result.dimension == 24 else 24
        assert "joint_5" in note and f"{result.dimension} or {other} of 24" in note
        assert max(map(len, str(result).splitlines())) <= 80
        seen.add(result.dimension)
    assert seen == {22, 24}


def test_uncertain_decisions_are_reported_with_their_errors(robots):
    lin = weakly_driven(robots, 10.0**-11.25)
    assert fflin.controllability(lin).dimension == 22
    with pytest.raises(fflin.StabilizabilityError, match=r"joint_5.*22.*24") as error:
        fflin.lqr(lin, 1.0, 1.0)
    assert error.value.margin.dropped > 0.1
    C = np.eye(24)[[*range(10), 11]]
    blind = replace(lin, C=C, D=np.zeros((11, 11)), output_names=lin.input_names)
    result = fflin.observability(blind)
    (note,) = result.notes
    assert "joint_5" in note and ("24 or 22" in note or "22 or 24" in note)
    assert says(str(result), "undecided")
    lin = weakly_driven(robots, 10.0**-10.5)
    with pytest.warns(fflin.FflinWarning, match="joint_5"):
        fflin.kalman(
            replace(lin, C=C, D=np.zeros((11, 11)), output_names=lin.input_names),
            1.0,
            1.0,
        )
    lin = weakly_driven(robots, 10.0**-12.0)
    blind = replace(lin, C=C, D=np.zeros((11, 11)), output_names=lin.input_names)
    with pytest.raises(fflin.DetectabilityError, match="undecided") as error:
        fflin.kalman(blind, 1.0, 1.0)
    assert 0.01 < error.value.margin.dropped < 1.0


def test_a_decay_within_rounding_is_reported(robots):
    """Twins in one damping: their difference is not driven, and hardly decays."""
    like = fflin.linearize(robots["ets_vii"])
    K = np.diag([0.0] * 10 + [4.0, 4.0])
    S = np.zeros((12, 11))
    S[:10, :10] = np.eye(10)
    S[10:, 10] = 1.0

    def judged(decay):
        return fflin.controllability(mechanical(np.eye(12), K, decay * K, S, like))

    for decay, stabilizable in ((1e-9, True), (0.0, False)):
        result = judged(decay)
        assert result.dimension == 22 and result.stabilizable == stabilizable
        assert not any("undecided" in note for note in result.notes)
    near = judged(1e-12)
    (note,) = (note for note in near.notes if note.startswith("undecided"))
    assert says(note, "by itself") and says(note, "may not be stabilizable")


def test_modes_that_decay_between_samples_are_reported(robots):
    """Of a file, which holds the samples alone, two fast motions look like one."""
    lin, K, D = decisions.case(164, robots)
    sampled = lin.discretize(0.1)
    true = decisions.truth(lin, K, D)
    assert fflin.controllability(sampled).dimension == true["controllable"]
    alone = fflin.controllability(replace(sampled, _source=None))
    assert alone.dimension != true["controllable"]
    assert any(
        f"{alone.dimension} or {true['controllable']} of" in note
        for note in alone.notes
    )
    assert fflin.controllability(replace(sampled, A=sampled.A.copy())).dimension == 4
    changed = replace(sampled, B=2.0 * sampled.B)
    assert (
        changed.generator is None and sampled.generator is lin and lin.generator is lin
    )


def test_a_spring_at_rest_does_not_push_the_base(robots):
    """What rounding leaves of a spring's force at its rest is no force."""
    robot = robots["planar_detumble"]
    at = dict(zip(robot.joint_names, (-0.48, -0.4, 0.63), strict=True))
    robot = robot.replace(inputs=motors(robot), stiffness=50.0, rest=at)
    lin = fflin.linearize(robot, fflin.configuration(robot, at))
    for model in (lin, lin.discretize(0.1)):
        reduced = fflin.momentum_reduction(model)
        assert len(reduced.A) == 6 and not reduced.notes and reduced.margin.kept > 1e4
        assert reduced.margin.dropped < 0.1
        gain = fflin.lqr(reduced, 1.0, 1.0)
        assert gain.margin > 0.0 and gain.residual < 1e-8


@pytest.mark.parametrize(
    "postures", [8, pytest.param(100, marks=pytest.mark.exhaustive)]
)
def test_momenta_are_conserved_in_every_posture(robots, postures):
    rng = np.random.default_rng(0)
    trees = (random_tree(rng, int(rng.integers(1, 8))) for _ in range(3 * postures))
    cases = [robot for robot in robots.values() if robot.n for _ in range(postures)]
    for robot in (*cases, *trees):
        at = {joint: rng.uniform(-1.0, 1.0) for joint in robot.joint_names}
        sprung = robot.replace(inputs=motors(robot), stiffness=50.0, rest=at)
        lin = fflin.linearize(sprung, fflin.configuration(sprung, at))
        reduced = fflin.momentum_reduction(lin)
        assert len(reduced.A) == 2 * robot.n, (robot, at)
        assert not reduced.notes


def test_motions_of_the_base_are_named_in_full(robots):
    lin = fflin.linearize(robots["ets_vii"])
    at = np.eye(12)
    assert (
        shape(lin, at[1]) == "rotation about y"
        and shape(lin, at[4]) == "translation along y"
    )
    assert shape(lin, at[11]) == "joint_6"
