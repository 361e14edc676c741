"""The time step follows the poles of the robot and of the loop."""

import numpy as np
import pytest
from scipy.linalg import expm

import fflin
from fflin.dynamics.integrators import (
    CommutatorFree4,
    SemiImplicitEuler,
)
from fflin.simulation.pace import Pace, Poles, Signal, rotation, shorter, step_error
from tests.support.robots import free_body

HUB = (20.0, 25.0, 30.0)


def hub_with_mode(frequency, damping=0.001, turns=2.0):
    """Return a free body with one flexible mode about x."""
    mode = fflin.FlexibleAppendage(
        "base",
        [frequency],
        np.zeros((3, 1)),
        np.array([[turns], [0.0], [0.0]]),
        damping=damping,
        name="array",
    )
    return free_body(HUB).replace(appendages=[mode])


def oscillation(lin):
    """Return the pole of the fastest oscillation of a model."""
    poles = np.linalg.eigvals(lin.A)
    return poles[poles.imag.argmax()]


def peak(t, x, low, high):
    """Return the largest magnitude of x between two times."""
    return np.abs(x[(t >= low) & (t <= high)]).max()


@pytest.mark.parametrize("pole", [-0.3 + 20.0j, 25.0j, -40.0 + 0.0j, 2.0 + 3.0j])
def test_growth_is_the_growth_of_a_step_of_the_method(pole):
    h = 0.02
    A = np.array([[0.0, 1.0], [-(abs(pole) ** 2), 2.0 * pole.real]])
    if pole.imag == 0.0:
        A = np.array([[pole.real]])
    step, _ = CommutatorFree4.held(A, np.zeros((len(A), 0)), h)
    exact = np.log(np.abs(np.linalg.eigvals(step)).max())
    assert CommutatorFree4.growth(np.array([pole * h]))[0] == pytest.approx(
        exact, rel=1e-9
    )
    if pole.imag:
        v = np.eye(2)[1] + h * A[1]  # the new velocity
        step = np.array([np.eye(2)[0] + h * v, v])
        exact = np.log(np.abs(np.linalg.eigvals(step)).max())
        assert SemiImplicitEuler.growth(np.array([pole * h]))[0] == pytest.approx(
            exact, rel=1e-9
        )


def test_the_step_error_of_an_undamped_mode_is_its_loss_over_the_run():
    z, h, duration = 0.3, 0.01, 5.0
    pole = Poles("loop", np.array([1j * z / h]))
    # leading term of |ln|R|| per step, times the steps
    loss = z**6 / 144.0 * duration / h
    demand = pole.demand(CommutatorFree4, h, duration)
    assert demand.error == pytest.approx(loss / 0.01, rel=0.02)
    # With damping, the larger of the two tolerances counts.
    exact, simulated = np.array([-0.002, -0.002]), np.array([-0.0021, -0.0023])
    assert step_error(exact, simulated, 0.01, 1.0) == pytest.approx([1.0, 3.0])
    assert step_error(exact, simulated, 0.01, 0.1) == pytest.approx([0.1, 0.3])


def test_steps_are_one_two_or_five_units():
    steps = [0.01]
    while steps[-1] > 2e-5:
        steps.append(shorter(steps[-1]))
    expected = [0.01, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5]
    assert steps == pytest.approx(expected, rel=1e-12)
    assert shorter(0.013) == pytest.approx(0.01)


def test_the_default_step_keeps_the_damping_of_a_flexible_mode():
    robot = hub_with_mode(20.0)
    v = np.zeros(robot.nv)
    v[6] = 1.0
    motion = fflin.simulate(robot, v0=v, duration=2.0)
    pole = oscillation(fflin.linearize(robot))
    x = motion.x[:, motion.state_names.index("q_m.array_mode_1")]
    decay = peak(motion.t, x, 1.9, 2.0) / peak(motion.t, x, 0.0, 0.1)
    # 5 % of the damping, and the same fraction of a period in both windows.
    assert decay == pytest.approx(np.exp(1.9 * pole.real), rel=0.02)
    (note,) = motion.notes
    assert "22.4 Hz" in note and "q_m.array_mode_1" in note and "0.002 s" in note


def test_a_given_step_that_is_too_long_is_in_the_notes():
    robot = hub_with_mode(20.0)
    v = np.zeros(robot.nv)
    v[6] = 1.0
    motion = fflin.simulate(robot, v0=v, duration=0.5, dt=0.005)
    (note,) = motion.notes
    assert (
        "0.005 s is too long" in note
        and "q_m.array_mode_1" in note
        and "dt=0.002" in note
    )
    assert not fflin.simulate(robot, v0=v, duration=0.5, dt=0.002).notes


def barely_unstable(robot, dt, radius):
    """Return the sampled model, and a gain whose largest pole has the given magnitude."""
    lin = fflin.linearize(robot).discretize(dt)
    rate, torque = lin.state_names.index("omega_b.x"), lin.input_names.index("tau_b.x")
    attitude = lin.state_names.index("q_b.x")

    def magnitude(size):
        K = np.zeros(lin.B.T.shape)
        K[torque, rate], K[torque, attitude] = size, 0.2 * size
        poles = np.linalg.eigvals(lin.A - lin.B @ K)
        return np.abs(poles[np.abs(poles.imag) > 0.3]).max(initial=0.0), K

    low, high = 0.0, 400.0
    for _ in range(60):
        size = 0.5 * (low + high)
        value, K = magnitude(size)
        low, high = (size, high) if value < radius else (low, size)
    return lin, K


@pytest.mark.exhaustive
def test_a_sampled_loop_that_is_unstable_by_the_exact_model_grows():
    # The mode turns by more than half a turn in a sample, so feedback of the rate excites it.
    robot = hub_with_mode(14.0, damping=0.005)
    lin, K = barely_unstable(robot, 0.05, 1.002)
    poles = np.linalg.eigvals(lin.A - lin.B @ K)
    radius = np.abs(poles).max()
    assert radius == pytest.approx(1.002, abs=1e-6)
    x0 = np.zeros(lin.A.shape[0])
    x0[lin.state_names.index("q_m.array_mode_1")] = 1e-3
    motion = fflin.simulate(robot, fflin.StateFeedback(lin, K), x0=x0, duration=8.0)
    x = motion.x[:, lin.state_names.index("q_m.array_mode_1")]
    growth = peak(motion.t, x, 7.0, 8.0) / peak(motion.t, x, 2.0, 3.0)
    assert growth == pytest.approx(radius**100, rel=0.06)
    coarse = fflin.simulate(
        robot, fflin.StateFeedback(lin, K), x0=x0, duration=1.0, dt=0.025
    )
    assert any("too long" in note for note in coarse.notes)


def test_the_rates_of_a_fast_spin_are_accurate():
    robot = fflin.load("cubesat")
    v0 = np.zeros(6)
    v0[3:] = 60.0 * np.array([0.05, 1.0, 0.08])
    motion = fflin.simulate(robot, v0=v0, duration=3.0)
    fine = fflin.simulate(robot, v0=v0, duration=3.0, dt=0.001)
    assert np.abs(motion.v[-1] - fine.v[-1]).max() / 60.0 < 0.01
    assert "rotation" in motion.notes[0] and len(motion.notes) == 1
    assert "in steps of 0.005 s" in str(motion)


def test_energy_shows_that_a_given_step_is_too_long():
    robot = fflin.load("cubesat")
    v0 = np.zeros(6)
    v0[3:] = 60.0 * np.array([0.05, 1.0, 0.08])
    motion = fflin.simulate(robot, v0=v0, duration=3.0, dt=0.012)
    assert motion.momentum_drift.max() < 1e-13
    change = np.abs(motion.energy / motion.energy[0] - 1.0).max()
    assert 1e-5 < change < 1e-3
    assert f"the energy changes by {100.0 * change:.2g} %" in motion.notes[-1]


def test_a_function_gets_the_step_of_the_same_linear_policy():
    robot = free_body((0.5, 0.6, 0.7))
    lin = fflin.linearize(robot)
    K = fflin.acceleration_lqr(lin, 4e4**2, 1.0, 1.0).K
    fastest = np.abs(np.linalg.eigvals(lin.A - lin.B @ K)).max()
    assert fastest > 150.0
    states = fflin.StateMap(robot)

    def law(t, q, v):
        return -K @ states.to_state(q, v)

    x0 = np.zeros(12)
    x0[0], x0[4] = 0.1, 0.3
    motion = fflin.simulate(robot, law, x0=x0, duration=0.3)
    same = fflin.simulate(robot, fflin.StateFeedback(lin, K), x0=x0, duration=0.3)
    assert motion.t[1] == same.t[1] < 0.01
    np.testing.assert_allclose(motion.x, same.x, atol=1e-12)
    assert "closed loop at the start" in motion.notes[0]


def test_a_policy_without_derivatives_keeps_the_default_step():
    robot = free_body(HUB)

    def bang_bang(t, q, v):
        return np.r_[-np.sign(v[3:]), 0.0, 0.0, 0.0]

    motion = fflin.simulate(robot, bang_bang, duration=0.1)
    assert motion.t[1] == 0.01 and not motion.notes


def test_a_stiff_spring_does_not_diverge_at_the_default_step():
    robot = fflin.load("planar_detumble", stiffness={"joint_1": 1.5e6})
    fastest = oscillation(fflin.linearize(robot))
    assert abs(fastest) > 600.0
    q0 = fflin.configuration(robot, {"joint_1": 1e-3})
    motion = fflin.simulate(robot, q0=q0, duration=0.2)
    assert not motion.stopped
    assert motion.energy == pytest.approx(motion.energy[0], rel=0.02)


class Push:
    """Force on the base along x, as a function of time; it counts its calls."""

    def __init__(self, force):
        self.force = force
        self.calls = 0

    def __call__(self, t, q, v):
        self.calls += 1
        return np.r_[self.force(t), np.zeros(5)]


def test_a_disturbance_of_100_hz_is_resolved():
    robot, w = free_body(HUB), 2.0 * np.pi * 100.0
    motion = fflin.simulate(
        robot, disturbance=Push(lambda t: np.sin(w * t)), duration=1.0, project=False
    )
    # m x'' = sin(w t): the mean velocity is 1/(m w).
    exact = (motion.t - np.sin(w * motion.t) / w) / (robot.mass * w)
    assert np.abs(motion.q[:, 0] - exact).max() < 0.01 * exact[-1]
    assert "the disturbance" in motion.notes[0]


def test_a_jump_of_a_disturbance_at_a_step_is_exact():
    robot = free_body(HUB)
    # 0.57 is not a multiple of 0.01 in floating-point arithmetic: 57 * 0.01 is larger.
    for jump in (0.57, 0.29, 0.3):
        push = Push(lambda t, jump=jump: 1.0 if t >= jump else 0.0)
        motion = fflin.simulate(robot, disturbance=push, duration=1.0, project=False)
        after = np.maximum(motion.t - jump, 0.0)
        np.testing.assert_allclose(motion.v[:, 0], after / robot.mass, atol=1e-14)
        np.testing.assert_allclose(
            motion.q[:, 0], after**2 / 2.0 / robot.mass, atol=1e-14
        )


def test_a_random_disturbance_is_in_the_notes():
    rng = np.random.default_rng(0)
    motion = fflin.simulate(
        free_body(HUB), disturbance=Push(lambda t: rng.normal()), duration=0.1
    )
    assert "random" in motion.notes[0] and motion.t[1] == 0.01


def test_a_constant_disturbance_has_no_note():
    motion = fflin.simulate(
        free_body(HUB), disturbance=Push(lambda t: 1.0), duration=0.5
    )
    assert not motion.notes
    assert Signal.of("x", lambda t: np.ones(1), 5.0, 100.0).step == 5.0


def test_the_prediction_is_the_exact_exponential():
    robot = hub_with_mode(20.0)
    lin = fflin.linearize(robot)
    x0 = np.zeros(lin.A.shape[0])
    x0[lin.state_names.index("q_m.array_mode_1")] = 1e-3
    x0[lin.state_names.index("q_b.x")] = 1e-3
    K = 0.1 * fflin.lqr(lin).K
    policy = fflin.StateFeedback(lin, K)
    for given in (0.005, 0.0005):
        motion = fflin.simulate(robot, policy, x0=x0, duration=0.5, dt=given)
        exact = expm((lin.A - lin.B @ K) * 0.5) @ x0
        np.testing.assert_allclose(motion.linear[-1], exact, atol=1e-13)
    # Limits that are never reached do not change the prediction.
    limited = fflin.simulate(robot, policy, x0=x0, duration=0.5, dt=0.005, limits=1e6)
    np.testing.assert_allclose(
        limited.linear[-1], exact, atol=1e-4 * np.abs(exact).max()
    )


@pytest.mark.exhaustive
def test_a_schedule_with_a_large_final_weight_ends_on_its_trajectory():
    robot = fflin.load("planar_detumble")
    v0 = fflin.velocity(robot, {"joint_1": 0.1})
    motion = fflin.simulate(robot, v0=v0, duration=0.2)
    along = fflin.linearize_trajectory(robot, motion.trajectory())
    nx = along.A.shape[1]
    schedule = fflin.tvlqr(along, np.eye(nx), 1e-2 * np.eye(9), np.eye(nx))
    q0, _ = fflin.TrajectoryFeedback(motion.trajectory(), schedule).beside(
        {"r_b.x": 0.05}
    )
    default = fflin.simulate(robot, schedule, q0=q0, v0=v0)
    fine = fflin.simulate(robot, schedule, q0=q0, v0=v0, dt=default.t[1] / 4.0)
    error, reference = default.x[-1] - default.target[-1], fine.x[-1] - fine.target[-1]
    assert np.abs(error - reference).max() < 0.05 * 0.05
    assert "along the trajectory" in default.notes[0]


def test_campaigns_use_the_same_step():
    robot = hub_with_mode(20.0)
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    motion = fflin.simulate(robot, policy, duration=0.5)
    runs = fflin.monte_carlo(
        robot, policy, {"q_b": 0.01}, runs=2, duration=0.5, engine="python"
    )
    assert runs.dt == motion.t[1] < 0.01
    assert runs.notes == motion.notes and "array_mode_1" in str(runs)


def test_the_pace_of_a_rotation_matches_an_undamped_mode():
    pace = Pace([rotation(60.0)], CommutatorFree4, 8.0)
    step, mode = pace.step()
    assert step == 0.005 and "rotation" in mode
    assert 60.0 * 8.0 * (60.0 * step) ** 5 / 144.0 < 0.011


@pytest.mark.exhaustive
def test_a_sample_far_above_the_period_of_a_mode_needs_short_steps():
    robot = hub_with_mode(300.0)
    lin = fflin.linearize(robot).discretize(1.0)
    policy = fflin.StateFeedback(lin, np.zeros(lin.B.T.shape))
    motion = fflin.simulate(robot, policy, duration=1.0)
    assert motion.t[1] <= 2e-4 and "q_m.array_mode_1" in motion.notes[0]


def test_a_continuous_controller_with_a_sample_time_is_judged_as_it_is_flown():
    robot = free_body(HUB)
    lin = fflin.linearize(robot)
    K = fflin.lqr(lin).K
    # First-order filters of the state feedback, whose poles at -5 1/s are continuous.
    filters = (-5.0 * np.eye(12), 5.0 * np.eye(12), -K, np.zeros((6, 12)))
    motion = fflin.simulate(
        robot, fflin.LinearController(filters, lin), duration=1.0, sample=0.1
    )
    assert motion.step == 0.01 and not motion.notes


def test_an_infinite_command_at_the_start_is_cut_at_its_limit():
    robot = free_body(HUB)
    command = np.r_[np.inf, np.zeros(5)]
    motion = fflin.simulate(robot, lambda t, q, v: command, duration=0.1, limits=2.0)
    assert (motion.u[:, 0] == 2.0).all()


@pytest.mark.parametrize("dt", ["0.01", np.nan, 0.0, 1e-320, np.inf])
@pytest.mark.parametrize("disturbance", [None, Push(lambda t: 1.0)])
def test_an_impossible_step_is_refused_with_and_without_a_disturbance(dt, disturbance):
    with pytest.raises(fflin.InputError, match="step dt"):
        fflin.simulate(free_body(HUB), duration=0.1, dt=dt, disturbance=disturbance)


def test_a_robot_in_orbit_may_start_half_a_turn_from_its_reference():
    robot = fflin.load("cubesat", orbit=500e3)
    q0 = fflin.configuration(robot)
    q0[3:7] = (1.0, 0.0, 0.0, 0.0)
    turned = fflin.simulate(robot, q0=q0, duration=0.1)
    assert not turned.stopped and turned.step == 0.01


def test_a_spin_about_an_oblique_axis_counts_by_its_norm():
    robot = free_body((20.0, 20.0, 20.0))
    v0 = np.r_[np.zeros(3), 30.0 * np.ones(3)]
    motion = fflin.simulate(robot, v0=v0, duration=0.5, dt=0.015)
    assert "52 rad/s" in motion.notes[0]


@pytest.mark.parametrize(
    ("times", "message", "allowed"),
    [
        (
            {"duration": 1.0, "sample": 0.125, "dt": 0.1},
            "sample is 0.125 s, expected a multiple of the step dt = 0.1 s; the nearest step that "
            "divides it is dt=0.125 (--dt 0.125)",
            {"dt": 0.125},
        ),
        (
            {"duration": 1.0, "sample": 0.1, "dt": 0.07},
            "duration is 1 s, expected a multiple of the step dt = 0.07 s; the nearest step that "
            "divides it is dt=0.05 (--dt 0.05)",
            {"dt": 0.05},
        ),
        (
            {"duration": 1.1478, "sample": 0.25, "dt": 0.25},
            "duration is 1.1478 s, expected a multiple of the step dt = 0.25 s; the nearest "
            "possible duration is 1 s or 1.25 s",
            {"duration": 1.25},
        ),
        (
            {"duration": 0.1478, "sample": 0.25, "dt": 0.25},
            "duration is 0.1478 s, expected a multiple of the step dt = 0.25 s; the nearest "
            "possible duration is 0.25 s",
            {"duration": 0.25},
        ),
    ],
)
def test_a_refused_time_is_refused_with_an_allowed_one(times, message, allowed):
    def simulated(**times):
        return fflin.simulate(free_body(HUB), lambda t, q, v: np.zeros(6), **times)

    with pytest.raises(fflin.InputError) as refusal:
        simulated(**times)
    assert str(refusal.value) == message
    motion = simulated(**times | allowed)
    assert motion.t[-1] == (times | allowed)["duration"]


def test_the_proposed_step_divides_the_sample_time():
    robot = hub_with_mode(1.1)
    model = fflin.linearize(robot).discretize(0.125)
    law = fflin.StateFeedback(model, fflin.lqr(model))
    motion = fflin.simulate(robot, law, duration=1.0, dt=0.125)
    # The longest accurate step of 1, 2 or 5 units is 0.05 s, which does not divide 0.125 s.
    assert "dt=0.0416666667 (--dt 0.0416666667) is accurate" in " ".join(
        str(motion).split()
    )
    finer = fflin.simulate(robot, law, duration=1.0, dt=0.0416666667)
    assert "not accurate" not in str(finer)


@pytest.mark.parametrize("seed", range(20))
def test_an_oscillating_mode_is_named_by_its_coordinate(seed):
    """Coordinate and rate participate equally, so rounding must not decide."""
    draw = np.random.default_rng(seed)
    frequency = draw.uniform(0.1, 10.0)
    damping = draw.uniform(0.0, 0.9)
    A = np.array([[0.0, 1.0], [-(frequency**2), -2.0 * damping * frequency]])
    assert "mainly q_m.a" in Poles.of("loop", A, ("q_m.a", "qdot_m.a")).fastest_mode
