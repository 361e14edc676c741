"""Default weights of a regulator whose torque only magnetorquers produce."""

from argparse import Namespace

import numpy as np
import pytest

import fflin
from fflin.commands.builders import gain_of, robot_of_design
from fflin.control.magnetic_weights import magnetic_weights


def without_weights(altitude=500e3):
    orbit = fflin.CircularOrbit(altitude, inclination=1.7, field="dipole")
    return fflin.load("cubesat_magnetic").replace(weights={}, orbit=orbit)


def test_the_loop_is_as_slow_as_the_orbit():
    for altitude in (500e3, 3000e3):
        robot = without_weights(altitude)
        design = robot_of_design(robot, None)
        assert [type(item) for item in design.inputs] == [fflin.BaseTorque]
        lin = fflin.linearize(design)
        fastest = np.abs(fflin.lqr(lin).poles).max() / robot.orbit.mean_motion
        assert 2.0 < fastest < 10.0


def test_the_weights_of_the_bundled_satellite_are_rounded_default_weights():
    default = magnetic_weights(without_weights())["bryson"]
    given = fflin.load("cubesat_magnetic").weights["bryson"]
    assert {*given} == {*default}
    for name, value in default.items():
        assert given[name] == pytest.approx(value, rel=0.03)


def test_given_weights_and_other_actuators_have_no_default_weights_for_slow_loops():
    robot = fflin.load("cubesat_magnetic")
    assert robot_of_design(robot, None).weights == robot.weights
    wheel = fflin.ReactionWheel((0, 0, 1), "base", inertia=1e-5)
    steered = without_weights().replace(inputs=[*robot.inputs, wheel])
    assert not robot_of_design(steered, None).weights


def test_the_description_separates_default_weights_from_given_weights():
    robot = without_weights()
    design = robot_of_design(robot, None)
    lin = fflin.linearize(design)
    options = {"weights": None, "integral": None, "sample": 10.0, "wheel_speeds": None}
    single = {"q": [], "r": [], "bryson": []}
    default = gain_of(lin, Namespace(**options, **single), robot, allocated=True)
    start = "omega_b, tau_b, q_b.x, q_b.y, q_b.z: default for magnetorquers; all other"
    assert default.weights.startswith(start)
    single["r"] = [("tau_b", 1e15)]
    mixed = gain_of(lin, Namespace(**options, **single), robot, allocated=True)
    start = (
        "omega_b, q_b.x, q_b.y, q_b.z: default for magnetorquers; tau_b as given; all"
    )
    assert mixed.weights.startswith(start)


def test_weights_of_the_robot_file_are_described_as_given():
    robot = fflin.load("cubesat_magnetic")
    lin = fflin.linearize(robot_of_design(robot, None))
    options = {"weights": None, "integral": None, "sample": 10.0, "wheel_speeds": None}
    single = {"q": [], "r": [], "bryson": []}
    gain = gain_of(lin, Namespace(**options, **single), robot, allocated=True)
    assert "as given" in gain.weights
    assert "default for magnetorquers" not in gain.weights


@pytest.mark.compiled
@pytest.mark.exhaustive
def test_all_satellites_of_a_campaign_acquire_their_attitude():
    robot = without_weights()
    design = robot_of_design(robot, None)
    lin = fflin.linearize(design).discretize(10.0)
    law = fflin.Allocation(fflin.StateFeedback(lin, fflin.lqr(lin)), design)
    campaign = fflin.monte_carlo(
        robot,
        law,
        {"q_b": (-0.5, 0.5), "omega_b": (-0.09, 0.09)},
        v0=np.zeros(6),
        runs=96,
        duration=20000.0,
        dt=5.0,
        limits="urdf",
    )
    assert campaign.met("attitude < 5 deg").all()
