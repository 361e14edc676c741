"""C code of laws that follow a trajectory: the test program, and simulations against Python."""

import numpy as np
import pytest

import fflin
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
