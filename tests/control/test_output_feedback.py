"""Loops closed over what is measured: the linear loop with its estimate foresees them."""

import numpy as np
import pytest

import fflin
from tests.support.measured import FELT, POSITIONS, designed, foreseen


@pytest.mark.parametrize("outputs", [POSITIONS, FELT], ids=["positions", "felt"])
def test_the_linear_loop_predicts_it_to_second_order(outputs):
    robot, lin, compensator = designed(outputs, stiffness=3.0)
    policy = fflin.OutputFeedback(lin, compensator)
    apart = []
    for size in (2e-4, 1e-4):
        x0 = lin.x0 + size * np.cos(np.arange(len(lin.x0)))
        motion = fflin.simulate(robot, policy, x0=x0, duration=2.0, dt=0.01, every=5)
        expected = foreseen(lin, compensator, x0, 40)
        apart.append(np.abs(motion.x - expected).max() / size)
    assert apart[0] < 0.05
    assert apart[0] / apart[1] == pytest.approx(2.0, abs=0.05)


def test_the_loop_settles_unless_there_is_noise():
    robot, lin, compensator = designed(POSITIONS)
    x0 = lin.x0.copy()
    x0[:6] += (0.05, -0.03, 0.02, 0.1, 0.05, -0.1)
    rng = np.random.default_rng(0)

    def noise(t):
        return 1e-4 * rng.normal(size=len(lin.y0))

    ends = []
    for policy in (
        fflin.OutputFeedback(lin, compensator),
        fflin.OutputFeedback(lin, compensator, noise),
    ):
        motion = fflin.simulate(robot, policy, x0=x0, duration=60.0, dt=0.05)
        assert not motion.stopped
        ends.append(np.abs(motion.error[-1]).max())
    assert ends[0] < 1e-6 < 1e-5 < ends[1] < 1e-2


def test_an_unstable_compensator_is_reported():
    """A fast regulator with a fast filter: the loop is stable, the compensator is not."""
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot).discretize(0.1)
    compensator = fflin.lqg(fflin.lqr(lin, 1e4, 1e-2), fflin.kalman(lin, 1.0, 1e-6))
    assert np.abs(np.linalg.eigvals(compensator.A)).max() > 1.05
    policy = fflin.OutputFeedback(lin, compensator)
    assert np.abs(np.linalg.eigvals(policy.loop)).max() < 1.0
    notes = fflin.simulate(robot, policy, duration=0.1).notes
    assert any("unstable" in note for note in notes)


def test_compensators_that_do_not_fit_are_refused():
    robot, lin, compensator = designed(POSITIONS)
    continuous = fflin.linearize(robot)
    with pytest.raises(fflin.InputError, match="sampled"):
        fflin.OutputFeedback(continuous, compensator)
    with pytest.raises(fflin.InputError, match="model"):
        fflin.OutputFeedback(continuous.discretize(0.1), compensator)
    with pytest.raises(fflin.InputError, match="Compensator"):
        fflin.OutputFeedback(lin, np.eye(3))
    policy = fflin.OutputFeedback(lin, compensator)
    with pytest.raises(fflin.InputError, match="outputs"):
        fflin.simulate(robot.replace(outputs=[fflin.BasePose()]), policy, duration=1.0)
    short = fflin.OutputFeedback(lin, compensator, lambda t: np.zeros(3))
    with pytest.raises(fflin.InputError, match="output"):
        fflin.simulate(robot, short, duration=1.0)


def test_the_compensator_of_a_delayed_model_needs_this_delay():
    """A compensator without the commands on their way would fly another loop than its design."""
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=["base"])
    lin = fflin.linearize(robot)
    designs = []
    for delay in (0.0, 0.25):
        model = lin.discretize(0.25, delay=delay)
        estimator = fflin.kalman(model, {"omega_b": 1e-9}, 1e-6)
        designs.append((model, fflin.lqg(fflin.lqr(model), estimator)))
    (early, of_early), (late, of_late) = designs
    for model, compensator in ((early, of_late), (late, of_early)):
        with pytest.raises(fflin.InputError, match="delayed inputs"):
            fflin.OutputFeedback(model, compensator)
    # The estimate contains the commands after limits, and the compensator itself says so.
    past = [name.startswith("past_") for name in of_late.state_names]
    assert sum(past) == 3
    np.testing.assert_array_equal(of_late.E[past], np.eye(3))
    assert np.array_equal(fflin.OutputFeedback(late, of_late).windup, of_late.E)
    assert not of_early.E.any()


def test_a_controller_for_delayed_inputs_notes_that_its_model_has_no_delay(tmp_path):
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], outputs=["base"])
    lin = fflin.linearize(robot)
    late = lin.discretize(0.25, delay=0.25)
    estimator = fflin.kalman(late, {"omega_b": 1e-9}, 1e-6)
    compensator = fflin.lqg(fflin.lqr(late), estimator)
    compensator.save(tmp_path / "law.npz")
    for given in (compensator, tmp_path / "law.npz"):
        policy = fflin.LinearController(given, lin)
        motion = fflin.simulate(robot, policy, duration=1.0)
        assert any("designed for delayed inputs" in note for note in motion.notes)
        motion = fflin.simulate(
            robot, fflin.LinearController(given, late), duration=1.0
        )
        assert not any("delayed inputs" in note for note in motion.notes)


def test_a_compensator_of_several_sample_times_names_its_policy():
    sensors = [
        fflin.StarTracker(sample=0.5, noise={"noise_equivalent_angle": 10.0}),
        fflin.Gyroscope("base", noise={"angle_random_walk": 0.1}),
    ]
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(max=1e-3)], outputs=sensors)
    model = fflin.linearize(robot).discretize(0.25)
    estimator = fflin.kalman(model, {"omega_b": 1e-10})
    compensator = fflin.lqg(fflin.lqr(model), estimator)
    with pytest.raises(fflin.InputError, match="MultirateFeedback"):
        fflin.OutputFeedback(model, compensator)
