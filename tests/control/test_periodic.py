"""Periodic regulators and filters: Riccati equations over one period, and laws that repeat."""

import numpy as np
import pytest
from scipy.linalg import block_diag, solve_continuous_are, solve_discrete_are

import fflin
from fflin.control.mean_field import mean_model
from fflin.control.optimal import differential_riccati as riccati
from fflin.control.optimal import periodic_riccati
from fflin.control.tvlqr import _solved_states, held_stages, loop_multipliers
from fflin.robot.orbit import DIPOLES
from tests.support.orbits import in_ellipse, in_orbit
from tests.support.robots import free_body

BODY = (3.0, 5.0, 4.0)
Q, R = {"q_b": 1.0, "r_b": 0.5, "omega_b": 0.3, "v_b": 0.2}, 2.0


@pytest.fixture(scope="module")
def along():
    return fflin.linearize_orbit(in_ellipse(free_body(BODY), 0.1), steps=8)


@pytest.fixture(scope="module")
def schedule(along):
    return fflin.tvlqr(along, Q, R, "periodic", sample=along.period / 8)


def apart(P, expected):
    """Largest difference of two matrices, relative to the largest entry."""
    return np.abs(P - expected).max() / np.abs(expected).max()


def test_the_sampled_solution_satisfies_the_periodic_equation(schedule):
    assert apart(schedule.P[0], schedule.P[-1]) < 1e-12
    assert schedule.residual < 1e-9
    assert np.array_equal(schedule.K[0], schedule.gain(0.0))
    least = np.linalg.eigvalsh(schedule.P)[:, 0]
    assert (least > 0.0).all()


def test_a_backward_sweep_over_many_periods_gives_the_same_solution(along, schedule):
    Q_matrix, R_matrix = schedule.Q, schedule.R
    stages = list(held_stages(along, along.period / 8, Q_matrix, R_matrix))
    P = np.zeros((12, 12))
    for _ in range(60):
        _, costs, _ = riccati.samples_back(reversed(stages), P)
        P = costs[-1]
    assert apart(P, schedule.P[0]) < 1e-10


@pytest.mark.exhaustive
def test_the_lifted_system_has_the_same_solution(along):
    h = along.period / 3
    schedule = fflin.tvlqr(along, Q, R, "periodic", sample=h)
    # All inputs of a period are the inputs of one sample of the lifted system.
    nx, nu = 12, 6
    state = np.hstack((np.eye(nx), np.zeros((nx, 3 * nu))))
    cost = np.zeros((nx + 3 * nu, nx + 3 * nu))
    for k, (weights, whole) in enumerate(held_stages(along, h, schedule.Q, schedule.R)):
        pick = np.zeros((nu, nx + 3 * nu))
        pick[:, nx + k * nu : nx + (k + 1) * nu] = np.eye(nu)
        both = np.vstack((state, pick))
        cost += both.T @ weights @ both
        state = whole @ both
    A, B = state[:, :nx], state[:, nx:]
    Q_lifted, S, R_lifted = cost[:nx, :nx], cost[:nx, nx:], cost[nx:, nx:]
    expected = solve_discrete_are(A, B, Q_lifted, R_lifted, s=S)
    assert apart(schedule.P[0], expected) < 1e-9
    assert schedule.P.shape == (4, 12, 12)


def test_the_multipliers_are_those_of_the_closed_loop(schedule):
    total = np.eye(12)
    for A, B, K in zip(schedule.A, schedule.B, schedule.K, strict=False):
        total = (A - B @ K) @ total
    expected = np.sort(np.abs(np.linalg.eigvals(total)))[::-1]
    # Small eigenvalues of the product itself are not accurate.
    assert np.allclose(schedule.loop_multipliers[:3], expected[:3], rtol=1e-6)
    assert schedule.loop_multipliers[0] < 1.0


@pytest.mark.parametrize("sampled", [True, False])
def test_constant_models_give_the_solution_of_the_algebraic_equation(sampled):
    along = fflin.linearize_orbit(in_orbit(free_body(BODY)), steps=8)
    sample = along.period / 40 if sampled else None
    schedule = fflin.tvlqr(along, Q, R, "periodic", sample=sample)
    A, B = along.A[0], along.B[0]
    if not sampled:
        expected = solve_continuous_are(A, B, schedule.Q, schedule.R)
        assert len(schedule.t) < 200
    else:
        lin = along[0].discretize(sample)
        Qd, Rd, N = fflin.sampled_cost(along[0], sample, schedule.Q, schedule.R)
        expected = solve_discrete_are(lin.A, lin.B, Qd, Rd, s=N)
    for P in schedule.P[:: len(schedule.P) // 4]:
        assert apart(P, expected) < 1e-9


@pytest.mark.exhaustive
def test_few_knots_give_the_continuous_solution_of_a_fast_loop():
    satellite = fflin.load("cubesat_magnetic")
    # One of 16 intervals lasts about ten time constants of the loop.
    cost = np.diag((0.06, 0.06, 0.02, 0, 0, 0, 1e-3, 1e-3, 2e-5, 0, 0, 0)), 0.1
    costs = [
        fflin.tvlqr(fflin.linearize_orbit(satellite, steps=n), *cost, "periodic").P[0]
        for n in (16, 32)
    ]
    assert apart(*costs) < 1e-3


@pytest.mark.exhaustive
def test_the_continuous_solution_repeats(along):
    schedule = fflin.tvlqr(along, Q, R, "periodic")
    assert apart(schedule.P[0], schedule.P[-1]) < 1e-12
    assert schedule.residual < 1e-5
    assert schedule.loop_multipliers[0] < 1.0
    # A sweep with the method of other schedules, from this cost, gives this cost again.
    S = along.B @ np.linalg.solve(schedule.R, along.B.mT)

    def at(times):
        A, B = along.matrices_at(times)
        S = B @ np.linalg.solve(schedule.R, B.mT)
        return np.array((A, S, np.broadcast_to(schedule.Q, A.shape)))

    _, P = riccati.solve_back(at, along.t, schedule.P[-1])
    assert apart(P[0], schedule.P[0]) < 1e-7
    late = schedule.period + 1.0
    assert np.allclose(schedule.gain(late), schedule.gain(1.0), rtol=0.0, atol=1e-12)
    assert np.allclose(
        schedule.cost_to_go(late), schedule.cost_to_go(1.0), rtol=1e-12, atol=1e-12
    )
    assert S.shape == (9, 12, 12)


def test_the_filter_is_the_dual_of_the_regulator():
    robot = in_ellipse(free_body(BODY), 0.1).replace(outputs=[fflin.BasePose()])
    along = fflin.linearize_orbit(robot, steps=8)
    h = along.period / 8
    filtered = fflin.tvkalman(along, 1e-3, 1e-4, P0="periodic", sample=h)
    assert filtered.period == along.period
    assert apart(filtered.P[-1], filtered.P[0]) < 1e-12
    assert filtered.residual < 1e-9
    # A filter that starts with another covariance forgets it.
    P = np.eye(12)
    for _ in range(5):
        for Phi, C, W in zip(filtered.A, filtered.C, filtered.W, strict=False):
            gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + filtered.V)
            P = Phi @ (P - gain @ C @ P) @ Phi.T + W
            P = 0.5 * (P + P.T)
    assert apart(P, filtered.P[0]) < 1e-9
    assert np.array_equal(filtered.gain(late := 2.5 * h), filtered.L[2])
    assert np.array_equal(filtered.gain(late + along.period), filtered.L[2])


def test_cross_terms_are_removed_before_the_doubling():
    rng = np.random.default_rng(3)
    stages = []
    for _ in range(4):
        root = rng.normal(size=(5, 5))
        stages.append((root @ root.T + np.eye(5), rng.normal(size=(3, 5))))
    maps = [periodic_riccati.sample_transition(*stage) for stage in stages]
    P = periodic_riccati.periodic_cost(periodic_riccati.over_period(maps))
    _, costs, _ = riccati.samples_back(stages, P)
    assert apart(costs[-1], P) < 1e-12
    assert np.linalg.eigvalsh(P)[0] > 0.0


@pytest.mark.exhaustive
def test_states_that_no_input_pushes_are_not_regulated():
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque()],
        orbit={"perigee": 500e3, "eccentricity": 0.1},
    )
    along = fflin.linearize_orbit(robot, steps=16)
    schedule = fflin.tvlqr(along, 1.0, 1e4, "periodic", sample=along.period / 32)
    assert "not regulated: r_b.x" in schedule.weights
    rows = [3, 4, 5, 9, 10, 11]
    assert not schedule.K[:, :, rows].any()
    # The six multipliers of the translation are 1; the attitude does not depend on it.
    closed = schedule.A - schedule.B @ schedule.K[:-1]
    total = np.linalg.multi_dot(closed[::-1])
    size = np.sort(np.abs(np.linalg.eigvals(total)))[::-1]
    assert size[:6] == pytest.approx(np.ones(6), abs=1e-4)
    assert len(schedule.loop_multipliers) == 6
    assert schedule.loop_multipliers[0] == pytest.approx(size[6], rel=1e-4)
    assert schedule.loop_multipliers[0] < 0.1
    assert "closed loop of the regulated states: largest" in str(schedule)


def arm_with_wheels(orbit):
    """Linear models of an arm on a base with wheels, whose momentum only gravity can change."""
    wheels = [
        fflin.ReactionWheel(axis, inertia=0.005, max=0.05, name=f"w{name}")
        for axis, name in zip(np.eye(3), "xyz", strict=True)
    ]
    inputs = [*wheels, fflin.JointTorque("*")]
    circle = fflin.CircularOrbit(altitude=1200e3)
    arm = fflin.load("ets_vii", inputs=inputs, orbit=circle)
    held = fflin.relative_equilibria(arm, arm.neutral())[0]
    return fflin.linearize_orbit(arm.replace(orbit=orbit), held.q, steps=16)


ARM_Q = {"q_b": 1.0, "q_m": 1.0, "omega_b": 1e4, "qdot_m": 1e-3}
ARM_R = {"wheel": 1e4, "tau_m": 1e4}


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:ets_vii. unphysical", "ignore:the phase margin")
def test_a_circular_orbit_gives_the_gain_of_lqr_for_wheels_and_joints():
    along = arm_with_wheels(fflin.CircularOrbit(altitude=1200e3))
    h = along.period / 100
    schedule = fflin.tvlqr(along, ARM_Q, ARM_R, "periodic", sample=h)
    lin = along[0]
    Qd, Rd, N = fflin.sampled_cost(lin, h, schedule.Q, schedule.R)
    gain = fflin.lqr(lin.discretize(h), Qd, Rd, N, wheel_speeds=True)
    # without the base position and the angles of the wheels
    assert len(gain.regulated) == 21
    for K in schedule.K[::25]:
        assert apart(K, gain.K) < 1e-8


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:ets_vii. unphysical")
def test_an_elliptic_orbit_gives_the_cost_of_a_backward_sweep_for_wheels_and_joints():
    along = arm_with_wheels(fflin.EllipticOrbit(perigee=500e3, eccentricity=0.2))
    h = along.period / 100
    schedule = fflin.tvlqr(along, ARM_Q, ARM_R, "periodic", sample=h)
    not_swept = ("r_b", "v_b", "q_m.w")
    kept = [
        i for i, name in enumerate(along.state_names) if not name.startswith(not_swept)
    ]
    nx, nu = len(schedule.Q), len(schedule.R)
    both = [*kept, *range(nx, nx + nu)]
    stages = [
        (weights[np.ix_(both, both)], whole[np.ix_(kept, both)])
        for weights, whole in held_stages(along, h, schedule.Q, schedule.R)
    ]
    P = np.zeros((21, 21))
    # The largest multiplier is 0.934, so an error of P shrinks by 0.872 per period.
    for _ in range(250):
        for weights, whole in reversed(stages):
            total = weights + whole.T @ P @ whole
            gain = np.linalg.solve(total[21:, 21:], total[21:, :21])
            P = total[:21, :21] - total[:21, 21:] @ gain
            P = 0.5 * (P + P.T)
    assert apart(schedule.P[0][np.ix_(kept, kept)], P) < 1e-9
    assert schedule.loop_multipliers[0] == pytest.approx(0.93369, abs=1e-5)
    others = np.setdiff1d(np.arange(nx), kept)
    assert not schedule.K[:, :, others].any()
    assert not schedule.P[:, others].any()


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:ets_vii. unphysical")
def test_wheel_speeds_without_weight_may_keep_their_momentum():
    """Momentum normal to the orbit costs nothing, so its rounding errors must not grow."""
    along = arm_with_wheels(fflin.CircularOrbit(altitude=1200e3))
    Q = ARM_Q | {f"qdot_m.w{axis}": 0.0 for axis in "xyz"}
    schedule = fflin.tvlqr(along, Q, ARM_R, "periodic", sample=along.period / 100)
    assert apart(schedule.P[0], schedule.P[-1]) < 1e-12
    # The double multiplier 1 of the Hamiltonian moves by the root of the rounding error.
    assert schedule.loop_multipliers[0] == pytest.approx(1.0, abs=1e-6)
    assert schedule.loop_multipliers[1] < 0.999


def test_states_that_affect_regulated_states_remain_in_the_riccati_equation():
    class Models:
        A = np.zeros((2, 4, 4))

    Models.A[:, 0, 0] = 1.0
    Models.A[1, 0, 2] = 1e-6  # state 2 affects state 0 at one knot
    Models.A[0, 2, 3] = 1e-6  # and state 3 affects state 2
    Models.A[0, 0, 1] = 1e-20  # a rounding error
    regulated = np.array([True, False, False, False])
    assert _solved_states(Models, regulated).tolist() == [True, False, True, True]


def test_newton_steps_reduce_the_errors_of_a_slow_loop():
    """The sweep of x1 = 0.99999 x0 with W = 1 contracts errors by 2e-5 only."""
    a = 0.99999
    exact = 1.0 / (1.0 - a**2)
    P = periodic_riccati.repeated(
        lambda end: (a**2 * end + 1.0, np.array([[a]])), np.array([[0.9 * exact]]), ""
    )
    assert P[0, 0] == pytest.approx(exact, rel=1e-10)


def test_multipliers_of_states_on_which_the_regulated_states_depend_are_kept():
    regulated = np.array([True, False])
    apart_from_it = np.array([[[0.5, 0.0], [3.0, 1.0]]] * 3)
    coupled = apart_from_it.swapaxes(1, 2)
    np.testing.assert_allclose(loop_multipliers(apart_from_it, regulated), [0.125])
    np.testing.assert_allclose(loop_multipliers(coupled, regulated), [1.0, 0.125])


@pytest.mark.exhaustive
def test_default_weights_follow_from_limits_as_for_lqr():
    robot = fflin.load("cubesat", orbit={"perigee": 500e3, "eccentricity": 0.1})
    along = fflin.linearize_orbit(robot, steps=16)
    default = fflin.tvlqr(along, Qf="periodic", sample=along.period / 400)
    assert "from mass and size" in default.weights
    assert default.loop_multipliers[0] < 1e-6


def magnetic(latitude, limits=(0.2, 0.2, 0.2)):
    """Linear models of a magnetic satellite with a given argument of latitude at t = 0."""
    orbit = fflin.CircularOrbit(
        500e3, inclination=1.2, field="dipole", argument_of_latitude=latitude
    )
    rods = [
        fflin.Magnetorquer(axis, max=limit)
        for axis, limit in zip(np.eye(3), limits, strict=True)
    ]
    robot = fflin.load("cubesat", orbit=orbit, inputs=rods)
    return fflin.linearize_orbit(robot, steps=8)


def test_magnetorquers_have_the_mean_effect_of_the_field_over_one_period():
    """With unit moments, the mean of the squared torque about an axis is that of |b|^2 - b_i^2."""
    models = magnetic(0.3)
    lin = mean_model(models)
    s, c = np.sin(1.2), np.cos(1.2)
    a = DIPOLES["earth"] / models.robot.orbit.radius**3
    # squares of b = a (s cos u, -c, 2 s sin u) over one orbit
    squares = a**2 * np.array([0.5 * s**2, c**2, 2.0 * s**2])
    expected = np.diag(np.sqrt(squares.sum() - squares))
    torque = lin.M[:3, :3] @ lin.B[6:9]
    assert np.abs(torque - expected).max() < 1e-12 * a
    assert np.array_equal(lin.A, models[0].A)


def test_limits_weight_the_mean_effect_of_magnetorquers():
    limits = np.array([0.1, 0.2, 0.3])
    models = magnetic(0.3, limits)
    lin = mean_model(models)
    effect = sum((B * limits) @ (B * limits).T for B in models.B[:-1]) / 8
    result = (lin.B * limits) @ (lin.B * limits).T
    assert np.abs(result - effect).max() < 1e-13 * np.abs(effect).max()


@pytest.mark.exhaustive
def test_default_weights_of_magnetorquers_do_not_depend_on_the_start():
    laws = []
    for latitude in (0.0, 1.0):
        models = magnetic(latitude)
        laws.append(fflin.tvlqr(models, Qf="periodic", sample=models.period / 64))
    one, other = laws
    assert "mean effect over one period" in one.weights
    assert one.Q == pytest.approx(other.Q, rel=1e-9, abs=1e-12)
    assert one.R == pytest.approx(other.R, rel=1e-9)
    assert one.loop_multipliers[0] == pytest.approx(other.loop_multipliers[0], rel=0.05)
    assert one.loop_multipliers[0] < 0.2


def test_models_without_magnetorquers_on_the_base_are_unchanged(along):
    assert np.array_equal(mean_model(along).B, along[0].B)


@pytest.mark.exhaustive
def test_inputs_that_cannot_stabilise_are_refused():
    # Forces alone do not control the attitude.
    robot = in_ellipse(free_body((5.0, 6.0, 2.0)), 0.01)
    robot = robot.replace(inputs=[fflin.BaseForce()])
    along = fflin.linearize_orbit(robot, motion="free", steps=8)
    with pytest.raises(fflin.StabilizabilityError, match="grows from period to period"):
        fflin.tvlqr(along, 1.0, 1.0, "periodic", sample=along.period / 8)


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (fflin.tvlqr, "give Qf='periodic'"),
        (lambda a: fflin.tvlqr(a, 1.0, 1.0, 1.0), "give Qf='periodic'"),
        (lambda a: fflin.tvlqr(a, 1.0, 1.0, "cyclic"), "'steady', 'periodic'"),
        (lambda a: fflin.tvkalman(a, 1.0, 1.0, sample=1.0), "give P0='periodic'"),
        (lambda a: fflin.mpc(a, 5, sample=a.period / 8), "repeats after"),
        (
            lambda a: fflin.funnel(
                a.robot,
                fflin.tvlqr(a, Q, R, "periodic", sample=a.period / 12),
                {"attitude": 5.0},
                samples=2,
            ),
            "repeats after",
        ),
        (lambda a: a.to("pinocchio"), "orbit"),
    ],
)
def test_periodic_trajectories_are_refused_where_an_end_is_needed(along, ask, words):
    with pytest.raises(fflin.InputError, match=words) as refused:
        ask(along)
    assert "\n" not in str(refused.value)


def test_a_trajectory_that_ends_has_no_periodic_law():
    robot = fflin.load("planar_detumble")
    motion = fflin.simulate(robot, duration=0.2, dt=0.1)
    ends = fflin.linearize_trajectory(robot, motion.trajectory())
    with pytest.raises(fflin.InputError, match="has no period"):
        fflin.tvlqr(ends, 1.0, 1.0, "periodic")


def test_a_file_keeps_a_periodic_schedule(schedule, along, tmp_path):
    schedule.save(tmp_path / "schedule.npz")
    back = fflin.GainSchedule.load(tmp_path / "schedule.npz")
    assert (back.period, back.orbit) == (schedule.period, schedule.orbit)
    assert np.array_equal(back.loop_multipliers, schedule.loop_multipliers)
    assert back.trajectory(along.robot).period == along.period
    other = in_ellipse(free_body(BODY), 0.2)
    with pytest.raises(fflin.InputError, match="another orbit"):
        back.trajectory(other)
    assert block_diag(schedule.Q, schedule.R).shape == (18, 18)


def test_weights_that_leave_an_unstable_motion_are_refused():
    """Without weights, the minimal solution of the Riccati equation is zero."""
    orbit = fflin.EllipticOrbit(perigee=500e3, apogee=1900e3)
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()], orbit=orbit)
    along = fflin.linearize_orbit(robot, steps=24)
    with pytest.raises(fflin.StabilizabilityError, match="not weight an unstable"):
        fflin.tvlqr(
            along, np.zeros((12, 12)), 1e8, "periodic", sample=orbit.period / 60
        )
