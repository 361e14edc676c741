"""Simulations of robots whose inputs have a lag, compared with the exact linear motion."""

import numpy as np
import pytest

import fflin
from fflin.kernel import limits
from tests.support.c_code import needs_compiler
from tests.support.marks import exhaustive


def pushed_base(lag=0.3):
    """Return a base and its model; the motion is exactly linear if forces alone move it."""
    inputs = [fflin.BaseTorque(lag=lag), fflin.BaseForce(lag=lag)]
    robot = fflin.load("cubesat", inputs=inputs)
    return robot, fflin.linearize(robot)


@pytest.mark.parametrize("delay", [0.1, *exhaustive(0.0)])
def test_held_commands_give_the_exact_sampled_motion(delay):
    """The motion of a law that ignores the lag equals the exact model with the lag.

    The forces are exact at the stages, whose quadrature has an error of (h/T)^5/2880 a step.
    """
    robot, lin = pushed_base()
    plain = lin.discretize(0.25)
    law = fflin.StateFeedback(plain, fflin.lqr(plain).K)
    motion = fflin.simulate(
        robot, law, x0=0.1 * (np.arange(12) % 6 == 3), duration=1.5, delay=delay
    )
    model = lin.with_lags().discretize(0.25, delay=delay)
    z = np.zeros(len(model.A))
    z[:12] = motion.x[0]
    every = round(0.25 / motion.step)
    for row in motion.x[::every]:
        assert row == pytest.approx(z[:12], abs=1e-11)
        z = model.A @ z + model.B @ (-law.K @ z[:12])


@pytest.mark.parametrize("sample", [0.0, 0.25])
def test_the_prediction_contains_the_lag(sample):
    robot, lin = pushed_base()
    model = lin.with_lags()
    if sample:
        model = model.discretize(sample)
    gain = fflin.lqr(model)
    law = fflin.StateFeedback(model, gain)
    assert law.system.A.shape == (6, 6)
    x0 = 0.1 * (np.arange(12) % 6 == 4)
    motion = fflin.simulate(robot, law, x0=x0, duration=2.0)
    assert motion.x == pytest.approx(motion.prediction, abs=1e-9)
    blind = fflin.StateFeedback(lin, fflin.lqr(lin))
    seen = fflin.simulate(robot, blind, x0=x0, duration=2.0)
    assert seen.x == pytest.approx(seen.prediction, abs=1e-9)


def test_a_law_designed_without_the_lag_overshoots_more():
    robot, lin = pushed_base(lag=3.0)
    x0 = 0.1 * (np.arange(12) % 6 == 3)
    ends = []
    for model in (lin, lin.with_lags()):
        sampled = model.discretize(0.5)
        law = fflin.StateFeedback(sampled, fflin.lqr(sampled, 1.0, 1.0))
        motion = fflin.simulate(robot, law, x0=x0, duration=30.0, dt=0.1)
        ends.append(motion.x[:, 3].min())
    assert ends[0] < 1.5 * ends[1] < 0.0


def test_lag_limits_and_wheels_conserve_momentum():
    wheels = [
        fflin.ReactionWheel(axis, inertia=1e-5, name=f"wheel_{k}", max=2e-3, lag=0.2)
        for k, axis in enumerate(np.eye(3))
    ]
    robot = fflin.load("cubesat", inputs=wheels)
    lin = fflin.linearize(robot).with_lags().discretize(0.25)
    law = fflin.StateFeedback(lin, fflin.lqr(lin))
    q0 = fflin.configuration(robot, rpy=(20, 0, 10))
    motion = fflin.simulate(robot, law, q0=q0, duration=40.0, dt=0.05, limits="urdf")
    assert motion.momentum_drift.max() < 1e-12
    assert np.abs(motion.x[-1, :3]).max() < 1e-3


def test_constant_inputs_act_from_the_start():
    """At an equilibrium that inputs hold, the lag changes nothing."""
    inputs = [fflin.BaseTorque(lag=0.5), fflin.BaseForce(lag=0.5)]
    robot = fflin.load("cubesat", inputs=inputs, gravity=(0.0, 0.0, -9.81))
    lin = fflin.linearize(robot, u=fflin.equilibrium(robot).u)
    law = fflin.StateFeedback(lin, fflin.lqr(lin))
    motion = fflin.simulate(robot, law, duration=5.0)
    assert motion.u[0, 5] == pytest.approx(9.81 * robot.mass)
    assert np.abs(motion.x).max() < 1e-9


def test_the_compiled_engine_refuses_a_sensor_with_a_lag_in_an_allocation(monkeypatch):
    monkeypatch.setattr(limits, "numba_is_there", lambda: True)
    design = fflin.load(
        "cubesat", inputs=[fflin.BaseTorque()], outputs=[fflin.BasePose(lag=0.3)]
    )
    lin = fflin.linearize(design).discretize(0.1)
    estimator = fflin.kalman(lin, 1e-6, 1e-6)
    law = fflin.OutputFeedback(lin, fflin.lqg(fflin.lqr(lin), estimator))
    robot = fflin.load("cubesat")
    shared = fflin.Allocation(law, design)
    with pytest.raises(fflin.InputError, match="lags of outputs are not computed"):
        fflin.simulate(robot, shared, duration=1.0, engine="compiled")


def test_kalman_and_lqg_contain_the_lag():
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque(lag=0.5), fflin.BaseForce()],
        outputs=[fflin.BasePose()],
    )
    lin = fflin.linearize(robot).with_lags().discretize(0.25)
    estimator = fflin.kalman(lin, 1e-6, 1e-8)
    compensator = fflin.lqg(fflin.lqr(lin), estimator)
    law = fflin.OutputFeedback(lin, compensator)
    assert "lag.tau_b.x" in compensator.state_names
    q0 = fflin.configuration(robot, rpy=(0.01, 0, 0))
    motion = fflin.simulate(robot, law, q0=q0, duration=30.0, dt=0.05)
    assert motion.x == pytest.approx(motion.prediction, abs=1e-7)
    assert np.abs(motion.x[-1, :3]).max() < 1e-6


@pytest.mark.parametrize("sample", [0.25, *exhaustive(0.0)])
def test_sensors_with_a_lag_follow_the_linear_model(sample):
    """Forces alone move the base, so the motion is exactly linear."""
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque(), fflin.BaseForce(lag=0.3)],
        outputs=[fflin.BasePose(lag=0.4), fflin.Gyroscope("base")],
    )
    lin = fflin.linearize(robot)
    model = lin.with_lags()
    if sample:
        lin, model = lin.discretize(sample), model.discretize(sample)
    x0 = 0.1 * (np.arange(12) % 6 == 3)
    motions = []
    for design in (lin, model):
        estimator = fflin.kalman(design, 1e-6, 1e-6)
        law = fflin.lqg(fflin.lqr(design), estimator)
        policy = fflin.LinearController(law, design)
        motion = fflin.simulate(robot, policy, x0=x0, duration=3.0)
        assert motion.x == pytest.approx(motion.prediction, abs=1e-8)
        motions.append(motion.x)
    assert np.abs(motions[0] - motions[1]).max() > 1e-5


def test_a_sensor_with_lag_delay_and_own_sample_in_one_loop():
    tracker = fflin.BasePose(lag=0.3, delay=0.1, sample=0.2)
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque(), fflin.BaseForce()],
        outputs=[tracker, fflin.Gyroscope("base")],
    )
    model = fflin.linearize(robot).with_lags().discretize(0.1)
    estimator = fflin.kalman(model, 1e-6, 1e-6)
    assert estimator.samples == 2
    law = fflin.MultirateFeedback(model, fflin.lqg(fflin.lqr(model), estimator))
    x0 = 0.1 * (np.arange(12) % 6 == 4)
    motion = fflin.simulate(robot, law, x0=x0, duration=6.0, dt=0.02)
    assert motion.x == pytest.approx(motion.prediction, abs=1e-7)


def test_laws_that_cannot_integrate_sensors_are_refused():
    robot = fflin.load("cubesat", outputs=[fflin.BasePose(lag=0.3)])
    lin = fflin.linearize(robot).discretize(0.1)
    law = fflin.OutputFeedback(
        lin, fflin.lqg(fflin.lqr(lin), fflin.kalman(lin, 1e-6, 1e-6))
    )
    q, v = robot.neutral(), np.zeros(robot.nv)
    command = law.bind(robot)
    command(0.0, q, v)
    with pytest.raises(fflin.InputError, match=r"only fflin\.simulate can integrate"):
        command(0.1, q, v)


@needs_compiler
def test_the_C_code_of_a_law_remembers_the_forces(tmp_path):
    robot, lin = pushed_base()
    model = lin.with_lags().discretize(0.25, delay=0.1)
    policy = fflin.StateFeedback(model, fflin.lqr(model))
    code = fflin.CLaw(fflin.write_c(policy, tmp_path / "law"))
    options = {"x0": 0.1 * (np.arange(12) % 6 == 3), "duration": 5.0, "dt": 0.05}
    expected = fflin.simulate(robot, policy, **options)
    result = fflin.simulate(robot, code, **options)
    assert np.abs(result.u - expected.u).max() < 1e-12 * np.abs(expected.u).max()
