"""C code of laws for delayed inputs: the law's memory is in the code, the delay in the plant."""

import numpy as np
import pytest

import fflin
from fflin.export.c_code import CLaw
from tests.support.c_code import COMPILERS, needs_compiler, outcome
from tests.support.motions import displaced

H = 0.05
SAMPLES = 2_000
DELAY = {"tau_b": 0.08, "F_b": 0.05, "tau_m": 0.02}
LIMITS = {"tau_b": 0.1, "F_b": 0.1}


def designed(kind):
    """Return the robot, its delayed model and a law for it."""
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    late = lin.discretize(H, DELAY)
    if kind == "states":
        return robot, late, fflin.StateFeedback(late, fflin.lqr(late))
    if kind == "integrals":
        gain = fflin.lqr(late, integral_action=["q_b", "q_m"])
        return robot, late, fflin.StateFeedback(late, gain)
    estimator = fflin.kalman(late, 1e-3, 1e-4)
    compensator = fflin.lqg(fflin.lqr(late), estimator)
    return robot, late, fflin.OutputFeedback(late, compensator)


@pytest.mark.process
@needs_compiler
@pytest.mark.parametrize("kind", ["states", "integrals", "outputs"])
def test_the_code_equals_python_over_two_thousand_samples(tmp_path, kind):
    robot, late, law = designed(kind)
    folder = fflin.write_c(law, tmp_path, limits=LIMITS)
    for compiler in COMPILERS:
        code, text = outcome(folder, compiler)
        assert code == 0, text
    code = CLaw(folder).bind(robot)
    command = law.bind(robot)
    high = [LIMITS.get(name.partition(".")[0], np.inf) for name in late.input_names]
    state = fflin.StateMap(robot)
    random = np.random.default_rng(5)
    plain = late.undelayed
    size = displaced(plain, degrees=30.0)
    limited = 0
    for k in range(SAMPLES):
        shift = size * np.sin(0.01 * k + 6.0 * random.random())
        q, v = state.to_pinocchio(plain.x0 + shift)
        expected = command(k * H, q, v)
        u = np.clip(expected, -np.array(high), high)
        command.correct(u - expected)
        limited += (u != expected).any()
        assert np.abs(code(k * H, q, v) - u).max() < 1e-12 * max(1.0, np.abs(u).max())
    assert 100 < limited < SAMPLES


@pytest.mark.process
@needs_compiler
def test_a_motion_with_the_code_equals_the_motion_with_the_law(tmp_path):
    """The description of the code states the delays, so `simulate` applies them to both."""
    robot, late, law = designed("states")
    code = CLaw(fflin.write_c(law, tmp_path, limits=LIMITS))
    run = {
        "x0": displaced(late.undelayed, degrees=20.0),
        "duration": 5.0,
        "limits": LIMITS,
        "dt": 0.01,
    }
    one = fflin.simulate(robot, law, **run)
    for delay in (DELAY, None):
        other = fflin.simulate(robot, code, **run, delay=delay)
        assert np.abs(one.x - other.x).max() < 1e-11
    assert code.input_delays == law.input_delays
    assert set(code.input_delays.values()) == set(DELAY.values())


@pytest.mark.process
@needs_compiler
def test_the_code_of_a_gain_is_that_of_its_law(tmp_path):
    _, late, law = designed("states")
    gain = fflin.lqr(late)
    sources = [
        (fflin.write_c(given, tmp_path / name) / "controller.c").read_text()
        for given, name in ((gain, "gain"), (law, "law"))
    ]
    assert sources[0] == sources[1]
