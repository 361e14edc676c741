"""Laws and goals as tables of a robot file and as text of the command line."""

import math
from inspect import signature

import numpy as np
import pytest

import fflin
from fflin.tuning.plant import signals_of
from fflin.tuning.specification import (
    FILTERS,
    GOALS,
    LAWS,
    check_signals,
    goals_of,
    structure_of,
    table_of,
)
from fflin.tuning.structures import Structured


@pytest.fixture(scope="module")
def lin():
    robot = fflin.load(
        "cubesat",
        inputs=[
            fflin.ReactionWheel((1, 0, 0), inertia=1e-5),
            fflin.ReactionWheel((0, 1, 0), inertia=1e-5),
            fflin.ReactionWheel((0, 0, 1), inertia=1e-5),
        ],
        outputs=[fflin.BasePose()],
    )
    return fflin.linearize(robot)


def parameters_of(texts, lin):
    structured = Structured(
        structure_of(list(map(table_of, texts)), lin), signals_of(lin)
    )
    return {parameter.name: parameter for parameter in structured.parameters}


def test_a_text_and_a_table_are_the_same():
    text = "max_gain inputs={tau_b=0.01, wheel=2e-3} outputs=[q_b.x,'q_b.y'] hard=true"
    with pytest.raises(fflin.InputError, match="is not a value"):
        table_of(text)
    assert table_of(text.replace("[q_b.x,'q_b.y']", '["q_b.x", "q_b.y"]')) == {
        "type": "max_gain",
        "inputs": {"tau_b": 0.01, "wheel": 2e-3},
        "outputs": ["q_b.x", "q_b.y"],
        "hard": True,
    }
    assert table_of("pd measured=q_b lag=[0.1, 1] kp=-2e3") == {
        "type": "pd",
        "measured": "q_b",
        "lag": [0.1, 1],
        "kp": -2000.0,
    }


def test_laws_are_added_and_filters_multiply_their_sum(lin):
    texts = ["pd shared=true", "static_gain measured=q_b.x inputs=wheel_1 name=cross"]
    without = parameters_of(texts, lin)
    assert {"kp", "kd", "lag", "cross.wheel_1.q_b.x"} == {*without}
    filtered = parameters_of([*texts, "notch frequency=[2,3] name=wing"], lin)
    assert {*filtered} - {*without} == {
        "wing.frequency",
        "wing.zero_damping",
        "wing.pole_damping",
    }
    notch = filtered["wing.frequency"]
    assert (notch.least, notch.largest, notch.unit) == (2.0, 3.0, "rad/s")


def test_a_law_has_filters_of_its_own(lin):
    texts = [
        "pd measured=q_b.x inputs=wheel_1 filters=[{type='low_pass', frequency=3.0}]",
        "pd measured=q_b.y inputs=wheel_2",
    ]
    structure = structure_of(list(map(table_of, texts)), lin)
    structured = Structured(structure, signals_of(lin))
    values = np.array([parameter.value for parameter in structured.parameters])
    assert len(structured.law(values).A) == 3
    assert structured.parameters[0].fixed


def test_parameters_with_one_name_are_shared(lin):
    texts = [
        "pd measured=q_b.x inputs=wheel_1 lag={name='lag', least=0.1, largest=2}",
        "pd measured=q_b.y inputs=wheel_2 lag={name='lag'}",
    ]
    names = list(parameters_of(texts, lin))
    assert names.count("lag") == 1 and len(names) == 5
    twice = [texts[0], texts[1].replace("'lag'}", "'lag', least=0.2}")]
    with pytest.raises(fflin.InputError, match="only once"):
        parameters_of(twice, lin)


def test_goals_have_the_fields_of_their_tables():
    gain, track = goals_of(
        [
            {
                "type": "max_gain",
                "inputs": {"q_b": {"x": 1e-3}},
                "outputs": "error.q_b.x",
                "below": {"numerator": [2.0, 0.01], "denominator": [1.0, 0.5]},
                "band": [0.1, math.inf],
            },
            {"type": "track", "output": "q_b.x", "settling": 60.0, "hard": True},
        ]
    )
    assert gain.inputs == {"q_b.x": 1e-3} and gain.band == (0.1, math.inf)
    assert gain.weight().numerator.tolist() == [1.0, 0.5]
    assert track.hard and track.examined == 180.0


REFUSED = {
    "pd measured": "KEY=VALUE",
    "pd kp=1 kp=2": "twice",
    "pd kp=1..2": "not a value",
    "pdd": "did you mean pd",
    "pd measurd=q_b": "did you mean measured",
    "pd lag={lest=1}": "did you mean least",
    "pd inputs=weel": "did you mean wheel",
    "pd measured=qb": "did you mean q_b",
    "notch frequency=1": "no law has signals",
    "pd filters=low_pass": "expected tables",
    "pd filters=[{type='notc'}]": "did you mean notch",
    "pd filters=[{frequency=1}]": "'type' is missing",
}


@pytest.mark.parametrize("text", REFUSED)
def test_a_wrong_law_is_refused_with_the_nearest_name(text, lin):
    with pytest.raises(fflin.FflinError, match=REFUSED[text].replace("[", r"\[")):
        check_signals(structure_of([table_of(text)], lin), [], lin)


REFUSED_GOALS = {
    "margn": "did you mean margin",
    "margin": "'disk' is missing",
    "margin disc=1": "did you mean disk",
    "max_gain inputs=weel outputs=q_b": "did you mean wheel",
    "max_gain inputs=wheel outputs={qb=1}": "did you mean q_b",
    "max_gain inputs=wheel outputs=q_b below={numerator=[1.0]}": "no denominator",
    "track output=q_b settling=1": "expected one",
}


@pytest.mark.parametrize("text", REFUSED_GOALS)
def test_a_wrong_goal_is_refused_with_the_nearest_name(text, lin):
    structure = structure_of([table_of("pd")], lin)
    with pytest.raises(fflin.FflinError, match=REFUSED_GOALS[text]) as error:
        check_signals(structure, goals_of([table_of(text)]), lin)
    assert str(error.value).startswith("goal 1 (")


def test_a_robot_without_torque_needs_the_key_inputs():
    robot = fflin.load("cubesat", inputs=[fflin.BaseForce()])
    with pytest.raises(fflin.InputError, match="inputs: F_b"):
        structure_of([table_of("pd")], fflin.linearize(robot))


STRANGE = (
    3,
    -1.0,
    True,
    "x",
    [],
    [[1]],
    [{}],
    {},
    {"a": {"b": [1]}},
    math.nan,
    [1, 2, 3],
)
TABLES = {
    "pd": {"measured": "q_b", "inputs": "wheel"},
    "pid": {"measured": "q_b", "inputs": "wheel"},
    "static_gain": {"measured": "q_b", "inputs": "wheel"},
    "state_space": {"order": 1},
    "low_pass": {},
    "lead": {},
    "notch": {"frequency": 1.0},
    "max_gain": {"inputs": "wheel", "outputs": "q_b"},
    "roll_off": {"inputs": "wheel", "outputs": "q_b", "above": 1.0, "below": 1.0},
    "margin": {"disk": 0.5},
    "decay": {"rate": 0.1},
    "damping": {"ratio": 0.1},
    "variance": {"inputs": {"wheel": 1.0}, "outputs": {"q_b": 1.0}},
    "track": {"output": "q_b.x", "settling": 10.0},
}


def strange_tables():
    """Each table with each of its keys replaced by each strange value."""
    for kind, table in TABLES.items():
        make = {**LAWS, **FILTERS, **GOALS}[kind]
        for key in (*signature(make).parameters, "type"):
            for value in STRANGE:
                yield kind, {"type": kind, **table, key: value}


@pytest.mark.exhaustive
def test_strange_values_are_accepted_or_refused_in_one_line(lin):
    faults = []
    for kind, table in strange_tables():
        laws, goals = [{"type": "pd"}], []
        if kind in GOALS:
            goals = [table]
        elif kind in FILTERS:
            laws.append(table)
        else:
            laws = [table]
        try:
            check_signals(structure_of(laws, lin), goals_of(goals), lin)
        except fflin.FflinError as error:
            if "\n" in str(error):
                faults.append((table, str(error)))
        except Exception as error:
            faults.append((table, repr(error)))
    assert not faults, faults[:5]
