"""How far the linear model and its loop reach."""

from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
from scipy.stats import binomtest
from test_cli import refused, run

import fflin
from fflin.closed_loop import Loop
from fflin.region import _clopper_pearson
from fflin.weights import default_weights


def held(robot, dt=0.0, reduce=False):
    lin = fflin.linearize(robot)
    lin = fflin.momentum_reduction(lin) if reduce else lin
    lin = lin.discretize(dt) if dt else lin
    return lin, fflin.lqr(lin, *default_weights(lin))


@pytest.fixture(scope="module")
def arm(robots):
    return robots["planar_detumble"]


def test_prediction_error_is_of_second_order(arm):
    for dt in (0.0, 0.2):
        lin, gain = held(arm, dt)
        found = fflin.validity(arm, lin, gain, samples=2)
        assert found.slope == pytest.approx(2.0, abs=0.1)
        assert (np.diff(found.prediction_error[:5]) > 0.0).all()
        assert 0.0 < found.trusted["attitude"] < 90.0
        # A model that is wrong to first order shows it.
    lin, gain = held(arm)
    wrong = fflin.LinearModel(**{**vars(lin), "A": lin.A * 1.02})
    assert fflin.validity(arm, wrong, gain, samples=1).slope < 1.5


def test_the_loop_is_that_of_aba_in_world_coordinates(robots):
    """A run against an integration of (q, v) by Pinocchio, which knows nothing of the chart."""
    import pinocchio as pin

    robot = robots["ets_vii"]
    lin, gain = held(robot)
    loop = Loop(robot, lin, gain.K)
    x = loop.displaced(np.random.default_rng(1), 40.0, 0.3, 0.5)
    times = np.linspace(0.0, 4.0, 9)
    _, motion = loop.run(x, times, 1e-10)
    data = robot.create_data()
    q, v = loop.state.to_pinocchio(x)
    h = 0.005
    for _ in range(800):

        def rate(dq, dv, q=q, v=v):
            here, speed = pin.integrate(robot.model, q, dq), v + dv
            state = loop.state.to_state(here, speed, near=x)
            u = lin.u0 - gain.K @ (state - lin.x0)
            frame = loop.state.chart(here)
            u = u.copy()
            u[3:6] = frame.R.T @ u[3:6]
            tau = loop.state.lift(u)
            return speed, pin.aba(robot.model, data, here, speed, tau).copy()

        # The midpoint rule, for which the tangent at q is good enough.
        k, a = rate(np.zeros(robot.nv), np.zeros(robot.nv))
        k, a = rate(h / 2 * k, h / 2 * a)
        q, v = pin.integrate(robot.model, q, h * k), v + h * a
    last = loop.state.to_state(q, v, near=x)
    assert motion[-1] == pytest.approx(last - lin.x0, abs=2e-4)


def test_same_seed_same_result_whoever_runs_it(arm):
    lin, gain = held(arm)
    one = fflin.validity(arm, lin, gain, attitude=170.0, samples=12, seed=3)
    for executor in (ProcessPoolExecutor(2), ThreadPoolExecutor(3)):
        with executor:
            two = fflin.validity(
                arm, lin, gain, attitude=170.0, samples=12, seed=3, executor=executor
            )
        assert two.outcomes == one.outcomes and two.slope == one.slope
        assert (two.prediction_error == one.prediction_error)[:5].all()
    other = fflin.validity(arm, lin, gain, attitude=170.0, samples=12, seed=4)
    assert (other.prediction_error != one.prediction_error).any()


def test_what_the_counts_say(arm):
    """A loop that is lost far out: the runs below the first failure, and both intervals."""
    lin, gain = held(arm)
    found = fflin.validity(arm, lin, gain, attitude=174.0, position=5.0, joint=3.0, samples=30)
    failed = [i for i, outcome in enumerate(found.outcomes) if outcome != "settled"]
    assert failed and found.inside == failed[0] > 0
    assert found.settled == 30 - len(failed)
    level = found.sampled[found.inside - 1]
    assert found.holds == {"attitude": 174.0 * level, "position": 5.0 * level, "joint": 3.0 * level}
    assert found.inside_rate == pytest.approx(0.05 ** (1.0 / found.inside))
    assert f"{found.inside} of {found.inside} runs" in " ".join(str(found).split())


def test_interval_is_clopper_and_pearsons():
    for successes, count in ((0, 10), (3, 10), (10, 10), (97, 100)):
        for confidence in (0.9, 0.99):
            exact = binomtest(successes, count).proportion_ci(confidence, method="exact")
            found = _clopper_pearson(successes, count, confidence)
            assert found == pytest.approx((exact.low, exact.high), rel=1e-9)


def test_joints_only_hold_the_reduced_model(robots):
    robot = robots["ets_vii"]
    robot = robot.replace(inputs=[fflin.JointTorque(name) for name in robot.joint_names])
    lin, gain = held(robot, reduce=True)
    found = fflin.validity(robot, lin, gain, joint=0.5, samples=5)
    assert found.slope == pytest.approx(2.0, abs=0.1)
    assert found.settled == 5


def test_bad_input(arm):
    lin, gain = held(arm)
    for arguments, words in (
        ((arm, lin, -gain.K), "not stable"),
        ((arm, lin, gain.K[:, 1:]), "K has shape"),
        ((arm, lin, "K"), "neither"),
        ((arm, None, gain), "expected a fflin.Robot"),
        ((arm.replace(inputs=[fflin.BaseTorque()]), lin, gain), "inputs are not those"),
    ):
        with pytest.raises(fflin.InputError, match=words):
            fflin.validity(*arguments)
    for options, words in (
        ({"samples": 0}, "samples is 0"),
        ({"seed": 1.5}, "seed is 1.5"),
        ({"attitude": 180.0}, "below 175 deg"),
        ({"joint": -1.0}, "none negative"),
        ({"confidence": 1.0}, "between 0 and 1"),
    ):
        with pytest.raises(fflin.InputError, match=words):
            fflin.validity(arm, lin, gain, **options)
    gone = fflin.linearize(arm, v=fflin.velocity(arm, {"omega_b.z": 0.1}))
    with pytest.raises(fflin.InputError, match="no fixed point"):
        fflin.validity(arm, gone, gain)


def test_command_line():
    code, out, err = run("validity", "cubesat", "--samples", "4", "--jobs", "2")
    assert code == 0 and not err
    assert "4 of 4 runs" in out and max(map(len, out.splitlines())) <= 80
    assert "--jobs is 0" in refused("validity", "cubesat", "--jobs", "0")
    assert "below 175 deg" in refused("validity", "cubesat", "--attitude", "200")
