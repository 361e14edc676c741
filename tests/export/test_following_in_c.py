"""C code of laws that follow a trajectory: the test program, and simulations against Python."""

import functools
import json

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.c_code import COMPILERS, needs_compiler, outcome
from tests.support.following import (
    LAWS,
    SAMPLE,
    equal_rates,
    satellite,
    slew,
    state_feedback,
    unloading,
    with_star_tracker,
)

pytestmark = [pytest.mark.process, needs_compiler]


def following(kind, **options):
    """Return a robot, and a law of a kind that follows a slew."""
    robot, law = LAWS[kind](**options)
    return robot, law.follow(slew(robot))


def memoryless():
    """Return a law whose gain has no memory."""
    robot = satellite()
    lin = fflin.linearize(robot).discretize(SAMPLE)
    return robot, fflin.StateFeedback(lin, fflin.lqr(lin).K).follow(slew(robot))


def with_held_values():
    """Return an ordinary law of late sensors, which receives the latest values.

    The planned angular rate at the measurement is not the planned angular rate at its arrival.
    """
    plain = with_star_tracker(sample=None, delay=0.0)
    law, _ = equal_rates(plain)
    tracker, _ = with_star_tracker().outputs
    slow = fflin.Gyroscope("base", sample=0.1, delay=0.15)
    robot = plain.replace(outputs=[tracker, slow])
    return robot, law.follow(slew(plain))


def that_unloads():
    """Return a law of late sensors that also feeds back the latest wheel speeds."""
    design, law = unloading()
    return design, law.follow(slew(with_star_tracker()))


# Laws of sensors with their own sample times and delays.
LATE = {
    "star tracker": lambda: following("star tracker", delay=0.1),
    "star tracker, inputs at once": lambda: following("star tracker"),
    "held values": with_held_values,
    "unloading": that_unloads,
}
CASES = LATE | {
    "estimated disturbance": lambda: following("estimated disturbance", delay=0.35),
    "integral action": lambda: following("integral action", delay=0.35),
    "state feedback": lambda: following("state feedback", delay=0.35),
    "memoryless": memoryless,
}


@functools.cache
def case(kind):
    """Return the robot and the law of a case, which is designed once."""
    return CASES[kind]()


@pytest.mark.exhaustive
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("kind", CASES)
def test_the_test_program_agrees(tmp_path, kind, real, compiler):
    robot, law = case(kind)
    fflin.write_c(law, tmp_path, robot=robot, real=real, limits={"wheel": 1e-4})
    code, text = outcome(tmp_path, compiler)
    assert code == 0, text


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", CASES)
def test_the_code_follows_as_python_does(tmp_path, kind):
    robot, law = case(kind)
    policy = fflin.CLaw(fflin.write_c(law, tmp_path, robot=robot))
    assert policy.input_delays == law.input_delays
    options = {
        "q0": fflin.configuration(robot, rpy=(2, -1, 3)),
        "duration": 18.0,
        "dt": 0.05,
        "noise": 0.0,
    }
    python, in_c = (fflin.simulate(robot, each, **options) for each in (law, policy))
    assert np.abs(python.u).max() > 1e-5
    assert in_c.q == pytest.approx(python.q, abs=1e-12)
    assert in_c.u == pytest.approx(python.u, abs=1e-12)


def test_the_header_states_the_reference_of_the_outputs(tmp_path):
    robot, law = following("estimated disturbance")
    fflin.write_c(law, tmp_path, robot=robot)
    header = (tmp_path / "controller.h").read_text()
    assert "unsigned long sample" in header
    assert "base pose of the trajectory" in header


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", LATE)
def test_the_code_compares_late_values_with_the_plan_at_their_measurement(
    tmp_path, kind
):
    """Over hundreds of samples, at random errors from the slew and from its end."""
    robot, law = case(kind)
    policy = fflin.CLaw(fflin.write_c(law, tmp_path, robot=robot))
    python, in_c = law.bind(robot), policy.bind(robot)
    random = np.random.default_rng(2)
    difference = largest = 0.0
    for sample in range(600):
        t = sample * law.sample_time
        q, v, _ = law.reference(t)
        q = pin.integrate(robot.model, q, 0.02 * random.normal(size=robot.nv))
        v = v + 1e-3 * random.normal(size=robot.nv)
        one, other = python(t, q, v), in_c(t, q, v)
        difference = max(difference, np.abs(one - other).max())
        largest = max(largest, np.abs(one).max())
    assert largest > 1e-5
    assert difference < 1e-12 * largest


def test_the_code_of_late_sensors_follows_within_limits(tmp_path):
    robot, law = following("star tracker", delay=0.1)
    limits = {"wheel": 2e-5}
    folder = fflin.write_c(law, tmp_path, limits=limits)
    header = (folder / "controller.h").read_text()
    assert "A and B repeat after 5 samples." in header
    assert "latest value of each output" in header
    options = {
        "q0": fflin.configuration(robot, rpy=(2, -1, 3)),
        "duration": 20.0,
        "dt": 0.05,
        "limits": limits,
        "noise": 0.0,
    }
    python, in_c = (
        fflin.simulate(robot, policy, **options) for policy in (law, fflin.CLaw(folder))
    )
    assert np.abs(python.u).max() == pytest.approx(2e-5)
    assert in_c.q == pytest.approx(python.q, abs=1e-12)
    assert in_c.u == pytest.approx(python.u, abs=1e-12)


def test_a_robot_with_other_sensors_than_the_code_is_refused(tmp_path):
    _, law = following("star tracker")
    policy = fflin.CLaw(fflin.write_c(law, tmp_path))
    message = "other sample times or delays than the outputs for which the C code"
    with pytest.raises(fflin.InputError, match=message):
        policy.bind(with_star_tracker(delay=0.1))
    about = json.loads((tmp_path / "controller.json").read_text())
    assert about["timing"]["delays"] == [4, 4, 4, 0, 0, 0]


@pytest.mark.exhaustive
def test_the_code_of_a_law_that_unloads_equals_python(tmp_path):
    robot = satellite()
    design = robot.replace(inputs=[fflin.BaseTorque(), *robot.inputs])
    law = fflin.unload_wheels(state_feedback(robot), design, 0.04)
    options = {
        "v0": fflin.velocity(design, {"wheel_x": 200.0, "wheel_z": -100.0}),
        "duration": 20.0,
        "dt": SAMPLE,
    }
    for number, policy in enumerate((law, law.follow(slew(robot)))):
        code = fflin.CLaw(fflin.write_c(policy, tmp_path / str(number), robot=design))
        python, in_c = (
            fflin.simulate(design, each, **options) for each in (policy, code)
        )
        assert np.abs(python.u[:, :3]).max() > 1e-5
        assert in_c.q == pytest.approx(python.q, abs=1e-12)
        assert in_c.u == pytest.approx(python.u, abs=1e-12)
