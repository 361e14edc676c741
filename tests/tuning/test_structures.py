"""Structures of laws for the signals of a plant: distribution to more inputs, sums, units."""

import numpy as np
import pytest

import fflin
from fflin.tuning.plant import Signals
from fflin.tuning.structures import Structured, per_second, quotient, times_seconds

# Directions of four wheels, as columns; the inertia of the body is 2 kg m^2 about all axes.
WHEELS = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0], [1.0, 1.0, 1.0, 1.0]])
INERTIA = 2.0


@pytest.fixture
def signals():
    """Three attitudes and four wheels of a rigid body."""
    none, unit = np.zeros((3, 3)), np.eye(3)
    A = np.block([[none, unit], [none, none]])
    B = np.vstack((np.zeros((3, 4)), WHEELS / INERTIA))
    return Signals(
        ("q_b.x", "q_b.y", "q_b.z"),
        ("wheel_1", "wheel_2", "wheel_3", "wheel_4"),
        ("1", "1", "1"),
        ("N m",) * 4,
        A,
        B,
        np.hstack((unit, none)),
    )


def test_four_wheels_give_each_axis_the_acceleration_that_its_gains_command(signals):
    structured = Structured(fflin.PD("q_b", "wheel_*", lag=0.5), signals)
    names = [parameter.name for parameter in structured.parameters]
    assert names[:3] == ["kp.q_b.x", "kp.q_b.y", "kp.q_b.z"]
    units = {parameter.name: parameter.unit for parameter in structured.parameters}
    assert (units["kp.q_b.x"], units["kd.q_b.z"]) == ("1/s^2", "1/s")
    law = structured.law(np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 0.5]))
    acceleration = WHEELS / INERTIA @ law.D
    assert np.allclose(acceleration, -np.diag([0.1, 0.2, 0.3]), rtol=0, atol=1e-15)


def test_a_given_distribution_keeps_the_units_of_the_inputs(signals):
    matrix = np.linalg.pinv(WHEELS)
    structure = fflin.PD("q_b", "wheel_*", shared=True, distribution=matrix)
    structured = Structured(structure, signals)
    units = [parameter.unit for parameter in structured.parameters]
    assert units == ["N m", "N m s", "s"]
    law = structured.law(np.array([4.0, 0.0, 0.1]))
    torque = WHEELS @ law.D
    assert np.allclose(torque, -4.0 * np.eye(3), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("structure", "word"),
    [
        (fflin.PD("q_b", "wheel_*", distribution=np.eye(3)), r"shape \(3, 3\)"),
        (fflin.PD("q_b", ["wheel_1", "wheel_2"]), "more inputs"),
        (fflin.PD(["q_b.x", "q_b.z"], ["wheel_3"] * 3), "each name once"),
        (fflin.PD("q_b.y", ["wheel_1", "wheel_2"]), "cannot accelerate"),
    ],
)
def test_a_distribution_that_does_not_fit_is_refused(structure, word, signals):
    with pytest.raises(fflin.InputError, match=word):
        Structured(structure, signals)


def test_a_filter_of_a_sum_has_states_only_for_the_inputs_of_the_sum(signals):
    terms = fflin.PD("q_b.z", "wheel_1") + fflin.StaticGain("q_b.x", "wheel_2")
    structured = Structured(fflin.LowPass(order=2) * terms, signals)
    law = structured.law(np.array([p.value for p in structured.parameters]))
    assert (
        len(law.A) == 1 + 2 * 2
    )  # the lag of the PD, and a filter for each of two inputs
    assert structured.used == ((0, 2), (0, 1))


def test_a_bounded_notch_starts_within_its_bounds(signals):
    structure = fflin.Notch((2.0, 3.0), name="wing") * fflin.PD("q_b.z", "wheel_1")
    notch = Structured(structure, signals).parameters[0]
    assert (notch.name, notch.unit) == ("wing.frequency", "rad/s")
    assert 2.0 <= notch.value <= 3.0


def test_units_are_those_of_the_quantities():
    assert quotient("N m", "rad/s") == "N m/(rad/s)"
    assert quotient("m/s^2", "m") == "1/s^2"
    assert (times_seconds("1/s^2"), times_seconds("1/s")) == ("1/s", "1")
    assert (times_seconds("1"), times_seconds("N m")) == ("s", "N m s")
    assert (per_second("1/s^2"), per_second("N m")) == ("1/s^3", "N m/s")
