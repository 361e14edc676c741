"""The field `disturbance` of a robot: its forms, files, summary and messages."""

import numpy as np
import pytest

import fflin
from fflin.robot.summary import robot_info

PERIODIC = {"amplitude": [0.0, 1e-5, 0.0], "frequency": 1.65e-4}


@pytest.fixture(scope="module")
def robot():
    return fflin.load("cubesat")


def test_three_numbers_are_a_constant(robot):
    given = {"tau_b": [2e-5, 0, 0], "F_b": np.array((0.0, 1e-4, 0.0))}
    disturbance = robot.replace(disturbance=given).disturbance
    [torque], [force] = disturbance["tau_b"], disturbance["F_b"]
    assert torque.constant == (2e-5, 0.0, 0.0)
    assert force.constant == (0.0, 1e-4, 0.0)
    assert not torque.periodic
    assert torque.axes_in("tau_b", orbit=False) == "base"
    assert force.axes_in("F_b", orbit=False) == "inertial"
    assert force.axes_in("F_b", orbit=True) == "orbital"


def test_a_list_is_a_sum_and_other_fields_leave_it(robot):
    given = {"tau_b": [[2e-5, 0, 0], PERIODIC | {"phase": 0.5, "axes": "inertial"}]}
    disturbed = robot.replace(disturbance=given)
    terms = disturbed.disturbance["tau_b"]
    assert [term.periodic for term in terms] == [False, True]
    assert terms[1].phase == 0.5
    again = disturbed.replace(gravity=(0, 0, -1.0)).replace(
        disturbance=disturbed.disturbance
    )
    assert again.disturbance == disturbed.disturbance
    assert again.replace(disturbance=None).disturbance == {}


def test_a_robot_file_has_the_same_keys(robot, tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(
        'urdf = "cubesat"\n[disturbance]\ntau_b = [2e-5, 0, 0]\n[[disturbance.F_b]]\n'
        'amplitude = [0, 1e-5, 0]\nfrequency = 1.65e-4\naxes = "base"\n'
    )
    loaded = fflin.load(path)
    expected = {"tau_b": [2e-5, 0, 0], "F_b": [PERIODIC | {"axes": "base"}]}
    assert loaded.disturbance == robot.replace(disturbance=expected).disturbance
    assert fflin.load(path, disturbance={}).disturbance == {}


def test_the_summary_shows_every_term(robot):
    given = {"tau_b": [[2e-5, 0, 0], PERIODIC | {"phase": 0.5}], "F_b": [0, 0, 1e-3]}
    text = " ".join(robot_info(robot.replace(disturbance=given)).split())
    assert (
        "disturbance, in simulations only: tau_b = 2e-05, 0, 0 N m (base axes), "
        "(0, 1e-05, 0) at 0.000165 Hz, phase 0.5 rad N m (base axes), "
        "F_b = 0, 0, 0.001 N (inertial axes)"
    ) in text


@pytest.mark.parametrize(
    "given, message",
    [
        ([1.0], "disturbance is [1.0], expected a table such as"),
        ({"tau_b": [1.0, 2.0]}, "disturbance 'tau_b' is [1.0, 2.0], expected three"),
        ({"tau_b": 1.0}, "disturbance 'tau_b' is 1.0, expected three"),
        ({"tau_b": {}}, "disturbance 'tau_b' is empty; give constant="),
        ({"tau_b": {"amplitude": (1, 0, 0)}}, "disturbance 'tau_b' has no frequency"),
        ({"tau_b": {"frequency": 1.0}}, "disturbance 'tau_b' has no amplitude"),
        (
            {"tau_b": PERIODIC | {"frequency": 0.0}},
            "frequency of disturbance 'tau_b' is 0",
        ),
        (
            {"tau_b": PERIODIC | {"phase": 90.0}},
            "phase of disturbance 'tau_b' is 90 rad, expected at most one rotation",
        ),
        (
            {"F_b": {"constant": (1, 0, 0), "phase": 1.0}},
            "disturbance 'F_b' has a phase but no amplitude",
        ),
        (
            {"F_b": {"constant": (1, 0, 0), "axes": "body"}},
            "axes of disturbance 'F_b' is 'body', expected one of base, inertial, orbital",
        ),
        (
            {"F_b": {"constant": (1, 0, 0), "axes": "orbital"}},
            "disturbance 'F_b' is in orbital axes, but 'cubesat' is not in orbit",
        ),
    ],
)
def test_an_invalid_disturbance_is_refused(robot, given, message):
    with pytest.raises(fflin.InputError) as error:
        robot.replace(disturbance=given)
    assert str(error.value).startswith(message)


def test_unknown_names_are_refused(robot):
    with pytest.raises(fflin.UnknownNameError, match="tau_m"):
        robot.replace(disturbance={"tau_m": (1, 0, 0)})
    with pytest.raises(fflin.UnknownNameError, match="period"):
        robot.replace(disturbance={"tau_b": {"constant": (1, 0, 0), "period": 2.0}})
