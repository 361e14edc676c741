"""Derivatives of all goals by the parameters of all structures, against differences."""

import numpy as np
import pytest

import fflin
from fflin.tuning.channels import ends_of
from fflin.tuning.plant import Plant
from fflin.tuning.problem import Case, Measure, Problem
from fflin.tuning.structures import Structured
from tests.support.tuning import signals_of

LAG = fflin.Tunable(0.3, name="shared lag")

STRUCTURES = {
    "PID": fflin.PID("*", "*"),
    "coupled PD": fflin.PD("*", "*", coupled=True),
    "PD of rates": fflin.PID("y0", "u0", rates="y1"),
    "series": fflin.LowPass(order=2, damping=(0.3, 1.0))
    * fflin.Notch((0.5, 5.0))
    * fflin.PD("*", "*", shared=True)
    * fflin.Lead(),
    "sum": fflin.StaticGain("*", "*", pattern=[[1, 1], [0, 1]])
    + fflin.LowPass() * fflin.PID("y1", "u1"),
    "state space": fflin.StateSpaceLaw(2),
    "shared": fflin.PD("y0", "u0", lag=LAG) + fflin.PD("y1", "u1", lag=LAG),
    "more inputs than axes": fflin.PID("y0", "*", coupled=True),
    "distribution": fflin.LowPass()
    * (
        fflin.PD("*", "*", distribution=[[1.0, 0.2], [0.0, 0.7]]) + fflin.PD("y0", "u0")
    ),
    "function": fflin.CustomLaw(
        lambda k: ([[-(k["w"] ** 2)]], [[k["w"]]], [[k["k"]]], [[-k["k"]]]),
        {"w": (0.5, 2.0), "k": (0.1, 0.5)},
        "y0",
        "u0",
    ),
}

GOALS = {
    "gain": fflin.MaxGain("u0", ("y0", "u1"), below=([1.0, 2.0], [1.0, 0.5])),
    "margin": fflin.Margin(0.5),
    "margin at outputs": fflin.Margin(0.5, "outputs"),
    "decay": fflin.Decay(0.1),
    "damping": fflin.Damping(0.9),
    "variance": fflin.Variance({"u0": 1.0, "u1": 0.5}, {"y0": 1.0, "y1": 0.3}),
    "step": fflin.Track("y0", settling=3.0),
    "roll-off": fflin.RollOff({"y0": 2.0, "y1": 1.0}, ("error.y0", "u0"), 3.0, 1.0),
}

# Differences of step h have errors of about eps / h = 2e-11 and h^2 = 1e-10 of each value.
STEP, LARGEST = 1e-5, 1e-7


def plant_of(dt):
    """Two nearly separate axes, so that feedback with the right sign is stable."""
    rng = np.random.default_rng(0)
    A = rng.standard_normal((5, 5)) - 3.0 * np.eye(5)
    B = rng.standard_normal((5, 2))
    C = np.linalg.pinv(B) + 0.1 * rng.standard_normal((2, 5))
    D = 0.1 * rng.standard_normal((2, 2)) if dt else np.zeros((2, 2))
    return signals_of(A, B, C), Plant(A, B, C, D, 2, dt)


def error_of(structure, goal, dt):
    signals, plant = plant_of(dt)
    measure = Measure(goal, ends_of(goal, signals, (), (0, 1), (0, 1)))
    structured = Structured(structure, signals)
    problem = Problem(structured, [measure], [Case(plant, [measure])])
    rng = np.random.default_rng(5)
    for _ in range(1000):
        x = np.clip(0.3 * problem.start(rng), *problem.bounds)
        if problem.evaluate(x) is not None:
            break
    gradient = problem.evaluate(x)[0].gradient()
    differences = np.zeros_like(gradient)
    for index, step in enumerate(STEP * np.eye(len(x))):
        values = [problem.evaluate(x + sign * step)[0].value for sign in (1.0, -1.0)]
        differences[index] = (values[0] - values[1]) / (2.0 * STEP)
    assert np.abs(gradient).max() > 0.0
    return np.abs(gradient - differences).max() / max(1.0, np.abs(gradient).max())


@pytest.mark.parametrize("goal", GOALS)
def test_the_derivatives_of_a_goal_equal_differences(goal):
    assert error_of(STRUCTURES["coupled PD"], GOALS[goal], 0.0) < LARGEST


@pytest.mark.parametrize("structure", STRUCTURES)
def test_the_derivatives_of_a_structure_equal_differences(structure):
    # The derivatives of a law that a user defines are differences themselves.
    assert error_of(STRUCTURES[structure], GOALS["gain"], 0.2) < LARGEST


@pytest.mark.exhaustive
@pytest.mark.parametrize("dt", [0.0, 0.2])
@pytest.mark.parametrize("structure", STRUCTURES)
def test_the_derivatives_of_all_goals_and_structures_equal_differences(structure, dt):
    errors = {
        key: error_of(STRUCTURES[structure], goal, dt) for key, goal in GOALS.items()
    }
    assert max(errors.values()) < LARGEST, errors
