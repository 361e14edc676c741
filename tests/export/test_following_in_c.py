"""C code of laws that follow a trajectory: the test program, and simulations against Python."""

import json

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.control import test_multirate_following as multirate
from tests.control.test_following import LAWS, SAMPLE, satellite, slew
from tests.support.c_code import COMPILERS, needs_compiler, outcome

pytestmark = [pytest.mark.process, needs_compiler]


def following(kind, **options):
    robot = satellite()
    return robot, LAWS[kind](robot, **options).follow(slew(robot))


def memoryless():
    """Return a law whose gain has no memory."""
    robot = satellite()
    lin = fflin.linearize(robot).discretize(SAMPLE)
    return robot, fflin.StateFeedback(lin, fflin.lqr(lin).K).follow(slew(robot))


@pytest.mark.exhaustive
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("kind", [*LAWS, "memoryless"])
def test_the_test_program_agrees(tmp_path, kind, real, compiler):
    robot, law = memoryless() if kind == "memoryless" else following(kind, delay=0.35)
    fflin.write_c(law, tmp_path, robot=robot, real=real, limits={"wheel": 1e-4})
    code, text = outcome(tmp_path, compiler)
    assert code == 0, text


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", [*LAWS, "memoryless"])
def test_the_code_follows_as_python_does(tmp_path, kind):
    robot, law = memoryless() if kind == "memoryless" else following(kind, delay=0.25)
    policy = fflin.CLaw(fflin.write_c(law, tmp_path, robot=robot))
    assert policy.input_delays == law.input_delays
    options = {
        "q0": fflin.configuration(robot, rpy=(2, -1, 3)),
        "duration": 18.0,
        "dt": SAMPLE,
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


def with_star_tracker(delay=0.0):
    """Return a law of a late, slow star tracker and a gyroscope, which follows a slew."""
    robot = multirate.satellite(noise=False)
    return robot, multirate.multirate(robot, delay).follow(slew(robot))


def with_held_values():
    """Return an ordinary law of the same sensors, which receives the latest value of each."""
    plain = multirate.satellite(sample=None, delay=0.0, noise=False)
    law, _ = multirate.equal_rates(plain)
    return multirate.satellite(noise=False), law.follow(slew(plain))


def that_unloads():
    """Return a law of late sensors that also feeds back the latest wheel speeds."""
    design, law = multirate.unloading()
    return design, law.follow(slew(multirate.satellite()))


LATE = {
    "star tracker": with_star_tracker,
    "star tracker, delayed inputs": lambda: with_star_tracker(0.12),
    "held values": with_held_values,
    "unloading": that_unloads,
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", LATE)
def test_the_code_compares_late_values_with_the_plan_at_their_measurement(
    tmp_path, kind
):
    """Over thousands of samples, at random errors from the slew and from its end."""
    robot, law = LATE[kind]()
    policy = fflin.CLaw(fflin.write_c(law, tmp_path, robot=robot))
    python, in_c = law.bind(robot), policy.bind(robot)
    random = np.random.default_rng(2)
    difference = largest = 0.0
    for sample in range(2500):
        t = sample * law.sample_time
        q, v, _ = law.reference(t)
        q = pin.integrate(robot.model, q, 0.02 * random.normal(size=robot.nv))
        v = v + 1e-3 * random.normal(size=robot.nv)
        one, other = python(t, q, v), in_c(t, q, v)
        difference = max(difference, np.abs(one - other).max())
        largest = max(largest, np.abs(one).max())
    assert largest > 1e-5
    assert difference < 1e-12 * largest


@pytest.mark.exhaustive
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("kind", LATE)
def test_the_test_program_of_late_sensors_agrees(tmp_path, kind, real, compiler):
    robot, law = LATE[kind]()
    fflin.write_c(law, tmp_path, robot=robot, real=real, limits={"wheel": 1e-4})
    code, text = outcome(tmp_path, compiler)
    assert code == 0, text


def test_the_code_of_late_sensors_follows_as_python_does(tmp_path):
    robot, law = with_star_tracker(0.1)
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
    }
    python, in_c = (
        fflin.simulate(robot, policy, **options) for policy in (law, fflin.CLaw(folder))
    )
    assert np.abs(python.u).max() == pytest.approx(2e-5)
    assert in_c.q == pytest.approx(python.q, abs=1e-12)
    assert in_c.u == pytest.approx(python.u, abs=1e-12)


def test_a_robot_with_other_sensors_than_the_code_is_refused(tmp_path):
    _, law = with_star_tracker()
    policy = fflin.CLaw(fflin.write_c(law, tmp_path))
    message = "other sample times or delays than the outputs for which the C code"
    with pytest.raises(fflin.InputError, match=message):
        policy.bind(multirate.satellite(delay=0.1))
    about = json.loads((tmp_path / "controller.json").read_text())
    assert about["timing"]["delays"] == [4, 4, 4, 0, 0, 0]


@pytest.mark.exhaustive
def test_the_code_of_a_law_that_unloads_equals_python(tmp_path):
    robot = satellite()
    design = robot.replace(inputs=[fflin.BaseTorque(), *robot.inputs])
    law = fflin.unload_wheels(LAWS["state feedback"](robot), design, 0.04)
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
