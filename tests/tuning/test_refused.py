"""Laws and goals that do not fit a robot, or cannot stabilise it, are refused with a reason."""

import math

import numpy as np
import pytest

import fflin
from fflin.tuning.plant import signals_of
from fflin.tuning.structures import Structured

DECAY = fflin.Decay(0.01)
BOUNDS = {"k": (0.0, 1.0)}
UNIT = np.eye(3)


@pytest.fixture(scope="module")
def lin():
    robot = fflin.load(
        "cubesat", inputs=[fflin.BaseTorque()], outputs=[fflin.BasePose()]
    )
    return fflin.linearize(robot)


@pytest.fixture(scope="module")
def wheels():
    """A satellite whose only inputs are three wheels."""
    names = {"w1": (1, 0, 0), "w2": (0, 1, 0), "w3": (0, 0, 1)}
    inputs = [
        fflin.ReactionWheel(axis, inertia=1e-5, name=name)
        for name, axis in names.items()
    ]
    robot = fflin.load("cubesat", inputs=inputs, outputs=[fflin.BasePose()])
    return fflin.linearize(robot)


def refused(lin, law, goal=DECAY, **settings):
    """Return the message with which a search is refused."""
    with pytest.raises(fflin.FflinError) as caught:
        fflin.tune(lin, law, goal, **settings)
    return str(caught.value)


@pytest.mark.parametrize(
    ("structure", "word"),
    [
        ([], "structure is a list, expected one structure"),
        ([fflin.PD("q_b", "tau_b"), fflin.LowPass()], "a + b"),
        (fflin.PD, "the class PD, expected an object"),
        (None, "NoneType, expected a structure of a law"),
    ],
)
def test_a_structure_is_one_object(structure, word, lin):
    assert word in refused(lin, structure)


@pytest.mark.parametrize("law", ["tau_b", "tau_b.x"])
def test_inputs_of_another_robot_are_refused_with_the_inputs_of_this_one(law, wheels):
    advice = f"no input named '{law}': the inputs of this robot are wheel (w1, w2, w3)"
    structure = fflin.PD("q_b.x", law)
    assert refused(wheels, structure).startswith(advice)
    goals = [fflin.MaxGain(law, "q_b"), fflin.MaxGain("w1", {"q_b.x": 1.0, law: 2.0})]
    for goal in goals:
        message = refused(wheels, fflin.PD("q_b", "wheel"), goal)
        assert message.startswith(advice) and message.endswith("give 'wheel'")


def test_a_misspelt_input_is_refused_with_the_nearest_name(wheels, lin):
    assert "did you mean w" in refused(wheels, fflin.PD("q_b", "w9"))
    assert "did you mean tau_b" in refused(lin, fflin.PD("q_b", "tau_c"))


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: fflin.MaxGain({}, "q_b"), "inputs are {}, expected one signal"),
        (lambda: fflin.RollOff("q_b", [], 1.0, 1.0), r"outputs are \[\], expected one"),
        (lambda: fflin.Variance({"q_b": 1.0}, {}), "outputs are {}, expected one"),
    ],
)
def test_a_goal_needs_inputs_and_outputs(make, word):
    with pytest.raises(fflin.InputError, match=word):
        make()


def test_a_law_needs_signals_and_each_once(lin):
    assert "the model has tau_b.x, tau_b.y" in refused(lin, fflin.PD("q_b", []))
    twice = fflin.StaticGain(["q_b", "q_b.y"], "tau_b")
    assert "contain 'q_b.y' twice" in refused(lin, twice)


@pytest.mark.parametrize(
    ("function", "word"),
    [
        (lambda k: ([], [], [], UNIT * math.nan), "a matrix D that is not finite"),
        (lambda k: (-UNIT / 0.0, UNIT, UNIT, UNIT), "start values k = 0.5"),
        (lambda k: None, "a NoneType, expected the four matrices"),
        (lambda k: (UNIT, UNIT, UNIT), "a tuple of length 3, expected"),
    ],
)
def test_a_function_that_returns_no_law_is_refused(function, word, lin):
    with np.errstate(all="ignore"):
        assert word in refused(lin, fflin.CustomLaw(function, BOUNDS, "q_b", "tau_b"))


STATIC = [
    fflin.StaticGain("q_b", "tau_b"),
    fflin.PD("q_b", "tau_b", kd=0.0),
    fflin.LowPass((1.0, 20.0), order=2) * fflin.PD("q_b", "tau_b", kd=0.0),
]


@pytest.mark.parametrize(
    ("law", "dt"),
    [(STATIC[0], None), (STATIC[1], 0.1), (STATIC[2], None)],
)
def test_a_law_without_rates_and_derivative_cannot_damp_a_rigid_body(law, dt, lin):
    message = refused(lin, law, dt=dt, starts=1)
    assert "no law of this structure is stable" in message
    assert "adds no damping; add an output of rates, such as fflin.Gyroscope" in message


def test_the_rates_that_a_model_has_are_named(lin):
    full = fflin.linearize(fflin.load("cubesat", inputs=[fflin.BaseTorque()]))
    message = refused(full, fflin.StaticGain("q_b", "tau_b"), starts=1)
    assert "measure rates, such as omega_b, or use a PD" in message
    law = fflin.PD("q_b", "tau_b", rates="omega_b", shared=True)
    assert fflin.tune(full, law, DECAY, starts=1, steps=2).met


def test_damping_that_is_too_small_is_not_called_impossible(lin):
    # The loop with J s^2 (1 + s / w) + kd s + kp is stable only if kd > kp / w.
    law = fflin.PD("q_b", "tau_b", kp=1.0, kd=(0.0, 1e-3), lag=1e-4, shared=True)
    law = fflin.LowPass(0.1) * law
    assert "none of 1 starts reached" in refused(lin, law, starts=1)


def test_bounds_that_begin_at_zero_have_a_start_between_them(lin):
    law = fflin.PD("q_b", "tau_b", kp=fflin.Tunable(0.0), kd=(0.0, 1e-9), lag=0.1)
    for parameter in Structured(law, signals_of(lin)).parameters[:6]:
        low, high = parameter.bounds
        assert -math.inf < low < high < math.inf
        assert 0.0 <= parameter.value <= parameter.largest


def test_a_sum_of_laws_starts_at_a_sum_with_fewer_states(lin):
    law = fflin.PD("q_b.x", "tau_b.x") + fflin.StateSpaceLaw(2, "q_b.y", "tau_b.y")
    simpler = Structured(law, signals_of(lin)).simpler
    assert simpler is not None
    names = [parameter.name for parameter in simpler.parameters]
    assert "kp" in names and "law.A[0,0]" in names and "law.A[1,1]" not in names


def test_a_saved_law_is_not_a_robot(lin, tmp_path):
    tuned = fflin.tune(lin, fflin.PD("q_b", "tau_b"), DECAY, starts=1, steps=1)
    for ending in (".mat", ".json"):
        path = tmp_path / f"law{ending}"
        tuned.save(path)
        with pytest.raises(fflin.FileError, match="Tuned for the robot 'cubesat'"):
            fflin.load(path)
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(fflin.FileError, match=r"a \.json file, expected a robot"):
        fflin.load(tmp_path / "other.json")
