"""The regulator: weights by name, what it refuses, margins, sampled costs, files."""

import re
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.integrate import quad_vec, solve_ivp
from scipy.linalg import expm

import fflin
from fflin.control.optimal.largest_gain import largest_gain
from fflin.dynamics.integrators import held_cost
from tests.support.messages import any_wording, says
from tests.support.robots import BUNDLED, panels, random_point


@pytest.fixture(scope="module")
def lin():
    return fflin.linearize(fflin.load("ets_vii"))


@pytest.fixture(scope="module")
def gain(lin):
    Q = fflin.bryson(
        lin, {"q_b": 0.05, "r_b": 0.1, "q_m": 0.1, "omega_b": 0.1, "v_b": 0.1}
    )
    return fflin.lqr(lin, Q, fflin.bryson(lin, {"tau_b": 100, "F_b": 100, "tau_m": 20}))


def joints_only(robot):
    return robot.replace(inputs=[fflin.JointTorque(name) for name in robot.joint_names])


def test_cost_to_go_is_the_integral_of_the_cost(lin, gain):
    x = np.random.default_rng(0).normal(size=24) * 0.1

    def rate(_, y):
        u = -gain.K @ y[:-1]
        cost = y[:-1] @ gain.Q @ y[:-1] + u @ gain.R @ u
        return np.append(lin.A @ y[:-1] + lin.B @ u, cost)

    end = solve_ivp(
        rate, (0, 80), np.append(x, 0.0), method="LSODA", rtol=1e-9, atol=1e-10
    ).y[:, -1]
    assert end[-1] == pytest.approx(x @ gain.P @ x, rel=1e-6)
    assert gain.margin == pytest.approx(-np.linalg.eigvals(gain.closed_loop).real.max())
    assert (gain.x0 == lin.x0).all() and gain.input_names == lin.input_names
    with pytest.raises(ValueError, match="read-only"):
        gain.K[0, 0] = 1.0


def test_weights_by_matrix_diagonal_number_and_name_are_one(lin):
    names = lin.state_names
    by_name = {"q_b": 4.0, "r_b": 1.0, "q_m": 2.0, "q_m.joint_2": 7.0, "omega_b": 0.5}
    groups = [name.partition(".")[0] for name in names]
    diagonal = np.array(
        [
            by_name.get(n, by_name.get(g, 0.0))
            for n, g in zip(names, groups, strict=True)
        ]
    )
    expected = fflin.lqr(lin, np.diag(diagonal), 3.0 * np.eye(12)).K
    for Q in (by_name, dict(reversed(by_name.items())), diagonal, diagonal.tolist()):
        assert (fflin.lqr(lin, Q, 3.0).K == expected).all()
    assert (
        fflin.lqr(lin, diagonal, {"tau_b": 3, "F_b": 3, "tau_m": 3}).K == expected
    ).all()
    # Round-off asymmetry is no error.
    noisy = np.diag(diagonal) + 1e-14 * np.triu(np.ones((24, 24)), 1)
    assert fflin.lqr(lin, noisy, 3.0).K == pytest.approx(expected, rel=1e-8, abs=1e-9)


def test_brysons_rule_is_the_square_of_the_largest_value(lin):
    Q = fflin.bryson(lin, {"q_m": 0.5, "q_b.z": 0.1})
    assert Q[lin.state_names.index("q_b.z")] == pytest.approx(100.0)
    assert Q[6:12] == pytest.approx(4.0) and np.count_nonzero(Q) == 7
    R = fflin.bryson(lin, {"tau_b": 2.0, "F_b": 4.0, "tau_m": 10.0})
    assert R == pytest.approx([0.25] * 3 + [1 / 16] * 3 + [0.01] * 6)
    for words, largest in {
        "'q_b'": {"q_b": 1.0, "tau_b": 1.0},
        "F_b.x": {"tau_b": 1.0},
        "positive": {"q_b": 0.0},
        "1e-200": {"q_b": 1e-200},
        r"1e\+200": {"tau_b": 1e200},
        "'qb'": {"qb": 1.0},
        "{name": {},
    }.items():
        with pytest.raises(fflin.FflinError, match=words):
            fflin.bryson(lin, largest)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_a_mode_that_the_weights_leave_out_is_not_held_by_rounding(lin, dt, seed):
    V = np.random.default_rng(seed).normal(size=(12, 11))
    Q = np.eye(24)
    Q[:12, :12] = V @ V.T
    with pytest.raises(fflin.InputError, match="combination"):
        fflin.lqr(lin.discretize(dt) if dt else lin, Q, 1.0)


def test_invalid_weights_are_named(lin):
    indefinite = np.eye(24)
    indefinite[3, 7] = indefinite[7, 3] = 2.0
    for words, arguments in {
        "-3 .*q_b.x": (-3, 1),
        "R .*tau_m.joint_3": (
            1,
            [1.0] * 8 + [0.0] + [1.0] * 3,
        ),
        r"\(3, 3\)": (np.eye(3), 1),
        r"\(5,\)": (np.ones(5), 1),
        r"\(2, 2, 2\)": (np.ones((2, 2, 2)), 1),
        r"Q\[0, 1\]": (np.triu(np.ones((24, 24))), 1),
        "rows": ([[1.0], [1.0, 2.0]], 1),
        "nan": (np.nan, 1),
        "'one'": ("one", 1),
        "'qb'": ({"qb": 1}, 1),
        "F_b.x": (1, {"tau_b": 1}),
        r"\(2, 2\)": (1, 1, np.eye(2)),
        "q_m.joint_1": ({"q_b": 1, "r_b": 1}, 1),
    }.items():
        with pytest.raises(fflin.FflinError, match=words):
            fflin.lqr(lin, *arguments)
    # Rounding decides which of several states these directions are along.
    for words, arguments in {
        "-1 .*(r_b.x|q_m.joint_2)": (indefinite, 1),
        r"Q - N R\^-1 N'": (1, 1, np.ones((24, 12))),
    }.items():
        with any_wording(), pytest.raises(fflin.FflinError, match=words):
            fflin.lqr(lin, *arguments)
    with any_wording(), pytest.raises(fflin.FflinError, match=r"R .*eigenvalue"):
        fflin.lqr(lin, 1, np.ones((12, 12)))
    with pytest.raises(fflin.InputError, match="LinearModel"):
        fflin.lqr(fflin.load("ets_vii"), 1, 1)


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_weights_of_any_size_give_a_gain_or_one_clear_line(lin, dt):
    model = lin.discretize(dt) if dt else lin
    sizes = (1e-300, 1e-150, 1e-20, 1.0, 1e20, 1e150, 1e300)
    solved = 0
    for q in sizes:
        for r in sizes:
            try:
                gain = fflin.lqr(model, q, r)
            except fflin.StabilizabilityError as error:
                assert "weights" in str(error)
            else:
                assert np.isfinite(gain.K).all() and gain.margin > 0.0
                assert gain.residual < 1e-3
                solved += 1
    assert solved >= 7
    nx, nu = model.B.shape
    with any_wording(), pytest.raises(fflin.StabilizabilityError, match="weights"):
        fflin.lqr(model, 1e308 * np.eye(nx), np.eye(nu))


def test_an_operating_point_that_is_not_a_fixed_point_is_refused_with_its_rows():
    robot = fflin.load("ets_vii")
    v = fflin.velocity(robot, {"omega_b.z": 0.1, "joint_1": 0.2})
    for point in (
        fflin.linearize(robot, None, v),
        fflin.linearize(robot, None, v).discretize(0.1),
    ):
        with pytest.raises(fflin.EquilibriumError, match=r"q_m\.joint_1.* 0\.2"):
            fflin.lqr(point, 1, 1)
    with pytest.raises(fflin.EquilibriumError, match=r"qdot_m\.joint_2"):
        fflin.lqr(fflin.linearize(robot, None, v, moving=True), 1, 1)
    # Flying along is steady.
    v = fflin.velocity(robot, {"v_b.x": 0.1})
    steady = fflin.lqr(fflin.linearize(robot, None, v, moving=True), 1, 1)
    assert steady.residual < 1e-14 and steady.margin > 0.0


@pytest.mark.parametrize("name", [name for name in BUNDLED if name != "cubesat"])
@pytest.mark.parametrize("dt", [0.0, 0.2])
def test_states_that_inputs_cannot_hold_are_named(robots, name, dt):
    robot = robots[name]
    q = random_point(robot, np.random.default_rng(1))[0]

    def refused(inputs, words):
        point = fflin.linearize(robot.replace(inputs=inputs), q)
        with pytest.raises(fflin.StabilizabilityError, match=words):
            fflin.lqr(point.discretize(dt) if dt else point, 1, 1)

    joints = [fflin.JointTorque(joint) for joint in robot.joint_names]
    angular = "angular momentum x/y/z"
    refused(joints, f"stabilise {angular}; add inputs, or design on .*_reduction")
    refused([fflin.BaseForce(), *joints], f"stabilise {angular}; add inputs, or design")
    oblique = fflin.Thruster(robot.model.frames[2].name, (0.0, 0.0, 0.0), (1, 1, 0))
    refused(
        [fflin.BaseTorque(), oblique, *joints],
        "stabilise linear momentum .*; add inputs, or",
    )
    plane = [
        fflin.Thruster(
            robot.model.frames[2].name, position=(0.1, y, 0.0), direction=direction
        )
        for y, direction in ((0.1, (1, 0, 0)), (-0.1, (-1, 0, 0)), (0.1, (0, 1, 0)))
    ]
    refused(
        [*plane, *joints], "stabilise angular momentum x/y.*; add inputs, or design"
    )
    base = [fflin.BaseTorque(), fflin.BaseForce()]
    refused(
        [*base, *joints[1:]],
        f"stabilise momentum of {robot.joint_names[0]}; .*--stiffness",
    )


@pytest.mark.parametrize("name", BUNDLED)
def test_a_base_that_no_input_pushes_is_regulated_without_its_position(robots, name):
    """The regulator equals the regulator of the model without the conserved linear momentum."""
    robot = robots[name]
    motors = [fflin.JointTorque(joint) for joint in robot.joint_names]
    q = random_point(robot, np.random.default_rng(2))[0]
    lin = fflin.linearize(robot.replace(inputs=[fflin.BaseTorque(), *motors]), q)
    part = fflin.momentum_reduction(lin)
    for model, reduced in ((lin, part), (lin.discretize(0.1), part.discretize(0.1))):
        gain = fflin.lqr(model, 1.0, 1.0)
        unpushed = {f"{group}.{axis}" for group in ("r_b", "v_b") for axis in "xyz"}
        assert set(gain.state_names) - set(gain.regulated) == unpushed
        expected = fflin.lqr(reduced, 1.0, 1.0).K @ part.S
        assert gain.K == pytest.approx(
            expected, rel=1e-7, abs=1e-9 * np.abs(expected).max()
        )
        assert says(str(gain), "v_b.z (no input pushes the base there)")
        assert not says(str(gain), "wheel")


def test_default_weights_of_a_base_torque_alone_have_the_documented_bandwidth():
    hub = fflin.load("cubesat", inputs=[fflin.BaseTorque()])
    gain = fflin.lqr(fflin.linearize(hub))
    assert np.abs(gain.poles) == pytest.approx(np.full(6, 0.2), rel=1e-6)
    closed = fflin.acceleration_lqr(fflin.linearize(hub), 1.0, 1.0, 1.0)
    assert closed.poles == pytest.approx(np.roots([1, 2**0.5, 0.5]).repeat(3))


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_modes_that_decay_by_themselves_are_not_blamed(dt):
    """Equal panels: a torque moves one of their modes, a force the other; both decay."""
    robot = panels(damping=0.2).replace(outputs=[fflin.Gyroscope("base")])

    def about(*inputs):
        lin = fflin.linearize(robot.replace(inputs=inputs))
        return lin.discretize(dt) if dt else lin

    torques = about(fflin.BaseTorque())
    missed = fflin.controllability(torques).uncontrollable
    assert any("q_m.h1" in name for name in missed)
    assert fflin.lqr(torques, 1.0, 1.0).margin > 0.0
    with pytest.raises(
        fflin.StabilizabilityError, match="angular momentum"
    ) as messages:
        fflin.lqr(about(fflin.BaseForce()), 1.0, 1.0)
    assert "q_m" not in str(messages.value) and "spring" not in str(messages.value)
    pushed = about(fflin.BaseTorque(), fflin.BaseForce())
    unseen = fflin.observability(pushed).unobservable
    assert any("q_m.h1" in name for name in unseen)
    with pytest.raises(
        fflin.DetectabilityError, match=r"observe q_b\.x, .* r_b\.x"
    ) as messages:
        fflin.kalman(pushed, 1.0, 1.0)
    assert "q_m" not in str(messages.value)
    # Without dampers the modes last, and they are blamed.
    robot = panels(damping=0.0)
    with pytest.raises(fflin.StabilizabilityError, match=r"vibration.*h1"):
        fflin.lqr(about(fflin.BaseTorque()), 1.0, 1.0)


def test_a_spring_is_advised_only_where_it_changes_a_momentum():
    """A spring between links changes the momentum of a joint, but not of the whole robot."""
    base = [fflin.BaseTorque(), fflin.BaseForce()]
    loose = panels(damping=0.0).replace(stiffness={})
    with pytest.raises(
        fflin.StabilizabilityError, match=r"momentum of h1.*--stiffness.*--reduce"
    ):
        fflin.lqr(fflin.linearize(loose.replace(inputs=base)), 1.0, 1.0)
    with pytest.raises(fflin.StabilizabilityError, match=r'lock = \["h\*"\], --lock'):
        fflin.lqr(fflin.linearize(loose.replace(inputs=base)), 1.0, 1.0)
    one = [*base, fflin.JointTorque("h2")]
    with pytest.raises(fflin.StabilizabilityError, match=r'lock = \["h1"\], --lock'):
        fflin.lqr(fflin.linearize(loose.replace(inputs=one)), 1.0, 1.0)
    hub = fflin.load("cubesat", inputs=[fflin.BaseForce()])
    with pytest.raises(
        fflin.StabilizabilityError, match=r"angular momentum.*--reduce"
    ) as messages:
        fflin.lqr(fflin.linearize(hub))
    assert "spring" not in str(messages.value)


def test_a_largest_q_b_beyond_a_quaternion_is_refused(lin):
    """Degrees or radians for q_b, whose magnitude is the sine of half the angle."""
    robot = fflin.load("ets_vii")
    for refused in (
        lambda: fflin.bryson(lin, {"q_b": 5.0}),
        lambda: fflin.lqr(lin, weights={"bryson": {"q_b.x": 5.0}}),
        lambda: robot.replace(weights={"bryson": {"q_b": 1.5}}),
        lambda: robot.replace(limits={"q_b": 30.0}),
    ):
        with pytest.raises(fflin.InputError, match=r"at most 1.*sin\(x / 2\)"):
            refused()
    assert fflin.bryson(lin, {"q_b": 1.0})[0] == 1.0


def test_limits_may_be_lists_of_mappings_and_open_on_one_side(lin, gain):
    robot, policy = fflin.load("ets_vii"), fflin.StateFeedback(lin, gain.K)
    x0 = np.zeros(24)
    x0[0] = 0.2

    def largest(limits):
        motion = fflin.simulate(robot, policy, x0=x0, duration=0.05, limits=limits)
        return motion.u[:, 0].min(), motion.u[:, 0].max()

    free = largest(None)
    assert free[0] < -1.0
    assert largest({"tau_b": (-1.0, np.inf)})[0] == -1.0
    assert largest({"tau_b": (-np.inf, 1.0)}) == free
    assert largest([{"tau_b": 1.0}, {"tau_b.x": 0.5}])[0] == -0.5
    with pytest.raises(fflin.InputError, match=r"tau_b"):
        largest({"tau_b": (np.inf, np.inf)})


def test_springs_do_not_hide_that_momentum_is_conserved():
    robot = joints_only(
        fflin.load("servicer_7dof").replace(stiffness=20.0, damping=1.0)
    )
    with pytest.raises(fflin.StabilizabilityError, match="angular momentum"):
        fflin.lqr(fflin.linearize(robot), 1, 1)
    # Without what is conserved it can be held, and so can all with the base's inputs.
    reduced = fflin.lqr(fflin.momentum_reduction(fflin.linearize(robot)), 1, 1)
    assert reduced.K.shape == (9, 18) and reduced.residual < 1e-14
    flexible = robot.replace(inputs=[fflin.BaseTorque(), fflin.BaseForce()])
    gain = fflin.lqr(fflin.linearize(flexible), 1, 1e-4)
    assert gain.method == "general" and gain.residual < 1e-13 and gain.margin > 0.0


def disk_on_a_grid(gain):
    scale = np.sqrt(gain.R.diagonal())
    loop, worst = gain.closed_loop, 0.0
    for w in np.append(np.geomspace(1e-4, 1e4, 4000), 0.0):
        s = np.exp(1j * w * gain.dt) if gain.dt else 1j * w
        if gain.dt and w * gain.dt > np.pi:
            continue
        S = np.eye(len(scale)) - gain.K @ np.linalg.solve(
            s * np.eye(len(loop)) - loop, gain.B
        )
        T = np.eye(len(scale)) - S
        scaled = scale[:, None] * (0.5 * (S - T)) / scale
        worst = max(worst, np.linalg.norm(scaled, 2))
    return 1.0 / worst


def test_margins_are_the_least_over_all_frequencies(lin, gain):
    sampled = fflin.lqr(lin.discretize(0.3), gain.Q, gain.R)
    for item in (gain, sampled):
        grid = disk_on_a_grid(item)
        assert grid * 0.998 < item.margins.disk < grid * (1.0 + 1e-4)
    # A continuous regulator of diagonal R bears half the gain, and 60 degrees.
    assert gain.margins.disk >= 1.0 and gain.margins.phase >= 53.0
    # Any gains within the margin, on all inputs at once, leave the loop stable.
    low, high = sampled.margins.gain
    rng = np.random.default_rng(2)
    for _ in range(50):
        factors = np.exp(rng.uniform(np.log(low), np.log(high), 12))
        loop = sampled.A - sampled.B @ (factors[:, None] * sampled.K)
        assert np.abs(np.linalg.eigvals(loop)).max() < 1.0


def test_the_largest_gain_of_a_resonance_is_found_between_the_poles():
    """w^2/(s^2 + 2 z w s + w^2) has its largest gain, 1/(2 z sqrt(1 - z^2)), below w."""
    for z in (0.05, 0.3, 0.6):
        A = np.array([[0.0, 1.0], [-9.0, -6.0 * z]])
        B, C = np.array([[0.0], [9.0]]), np.array([[1.0, 0.0]])
        exact = 1.0 / (2.0 * z * np.sqrt(1.0 - z**2))
        assert largest_gain(A, B, C, np.zeros((1, 1)))[0] == pytest.approx(
            exact, rel=2e-5
        )
        # With a direct term, on a dense grid.
        D = np.array([[0.7]])
        response = D + [
            C @ np.linalg.solve(1j * w * np.eye(2) - A, B)
            for w in np.linspace(0, 9, 9001)
        ]
        assert largest_gain(A, B, C, D)[0] == pytest.approx(
            np.abs(response).max(), rel=3e-5
        )


def test_a_cross_weight_that_takes_a_spring_away_leaves_its_joint_unweighed():
    model = fflin.linearize(fflin.load("astrobee_arm").replace(stiffness=20.0))
    N = np.zeros(model.B.shape)
    N[:8] = np.linalg.solve(model.B[8:], model.A[8:, :8]).T
    Q = N @ N.T + np.diag([1.0] * 6 + [0.0] * 10)
    with pytest.raises(fflin.InputError, match=r"q_m.arm_"):
        fflin.lqr(model, Q, 1.0, N)


@pytest.mark.parametrize("fields", [{}, {"stiffness": 50.0, "damping": 3.0}])
def test_a_cross_weight_is_sampled_with_the_rest(fields):
    model = fflin.linearize(fflin.load("astrobee_arm").replace(**fields))
    nx, nu = model.B.shape
    rng, h = np.random.default_rng(5), 0.3
    V = rng.normal(size=(nx + nu, nx + nu))
    W = V @ V.T
    Q, R, N = fflin.sampled_cost(model, h, W[:nx, :nx], W[nx:, nx:], W[:nx, nx:])
    F = np.vstack((np.hstack((model.A, model.B)), np.zeros((nu, nx + nu))))
    integral = quad_vec(
        lambda t: expm(F * t).T @ W @ expm(F * t), 0.0, h, epsrel=1e-11
    )[0]
    scale = np.abs(integral).max()
    assert np.block([[Q, N], [N.T, R]]) == pytest.approx(
        integral, rel=1e-9, abs=1e-11 * scale
    )


def test_sampled_cost_is_the_integral_under_held_inputs(lin):
    h = 0.4
    Q, R = np.diag(np.linspace(1, 5, 24)), np.diag(np.linspace(1, 2, 12))
    cost = fflin.sampled_cost(lin, h, Q, R)
    A, B = lin.A, lin.B
    # The specification's polynomials.
    AQ, AQA = A.T @ Q + Q @ A, A.T @ Q @ A
    Qd = Q * h + AQ * h**2 / 2 + AQA * h**3 / 3
    Nd = (
        Q @ B * h**2 / 2 + (Q @ A @ B / 2 + A.T @ Q @ B) * h**3 / 3 + AQA @ B * h**4 / 8
    )
    cross = B.T @ Q @ A @ B
    Rd = R * h + B.T @ Q @ B * h**3 / 3 + (cross + cross.T) * h**4 / 8
    Rd += B.T @ AQA @ B * h**5 / 20
    for result, expected in zip(cost, (Qd, Rd, Nd), strict=True):
        assert result == pytest.approx(expected, rel=1e-12, abs=1e-13)
    # The cost of the sampled loop is the continuous cost of its motion.
    gain = fflin.lqr(lin.discretize(h), *cost)
    assert gain.residual < 1e-14
    x = np.random.default_rng(1).normal(size=24)
    before, total = x @ gain.P @ x, 0.0
    F = np.block([[A, B], [np.zeros((12, 36))]])
    W = np.block([[Q, np.zeros((24, 12))], [np.zeros((12, 24)), R]])
    for _ in range(3):
        z = np.append(x, -gain.K @ x)
        total += quad_vec(lambda t: (expm(F * t) @ z) @ W @ (expm(F * t) @ z), 0, h)[0]  # noqa: B023
        x = (expm(F * h) @ z)[:24]
    assert total == pytest.approx(before - x @ gain.P @ x, rel=1e-9)


def test_held_cost_away_from_rest():
    rng = np.random.default_rng(3)
    F, W = rng.normal(size=(7, 7)), rng.normal(size=(7, 7))
    W = W @ W.T
    for h in (0.01, 3.0):
        exact = quad_vec(lambda t: expm(F.T * t) @ W @ expm(F * t), 0, h, epsrel=1e-12)[
            0
        ]
        assert held_cost(F, W, h) == pytest.approx(exact, rel=1e-9)


def test_sampled_cost_refuses(lin):
    with pytest.raises(fflin.InputError, match="continuous"):
        fflin.sampled_cost(lin.discretize(0.1), 0.1, 1, 1)
    with pytest.raises(fflin.InputError, match="dt"):
        fflin.sampled_cost(lin, 0.0, 1, 1)


@pytest.mark.parametrize("ending", [".npz", ".mat", ".json"])
def test_files_keep_every_bit(gain, tmp_path, ending):
    path = tmp_path / f"gain{ending}"
    gain.save(path)
    back = fflin.Gain.load(path)
    assert back._lin is None  # the model of the design is in no file
    for item in fields(gain):
        if item.name == "_lin":
            continue
        before, after = getattr(gain, item.name), getattr(back, item.name)
        same = (
            np.array_equal(before, after)
            if isinstance(before, np.ndarray)
            else before == after
        )
        assert same and np.shape(before) == np.shape(after), item.name
    for words, name in (("Gain", "else"), ("No such file", "missing")):
        if name == "else":
            (tmp_path / f"else{ending}").write_bytes(path.read_bytes()[:200])
        with pytest.raises(fflin.FileError, match=words):
            fflin.Gain.load(tmp_path / f"{name}{ending}")


def test_files_refuse_nonfinite_values_and_unknown_endings(gain, tmp_path):
    with pytest.raises(fflin.FileError, match=r"'\.csv'"):
        gain.save(tmp_path / "gain.csv")
    broken = replace(gain, K=np.full_like(gain.K, np.nan))
    with pytest.raises(fflin.InputError, match="finite"):
        broken.save(tmp_path / "gain.npz")
    assert not list(tmp_path.iterdir())


def test_a_gain_prints_in_80_columns(gain, lin):
    sampled = fflin.lqr(lin.discretize(0.1), gain.Q, gain.R)
    small = fflin.lqr(fflin.linearize(fflin.load("planar_detumble")), 1, 1)
    for item in (gain, sampled, small):
        text = str(item)
        assert max(map(len, text.splitlines())) <= 80
        rates = np.log(item.poles) / item.dt if item.dt else item.poles
        assert (
            f"{item.residual:.1e}" in text
            and f"decay {-rates.real.max():.3g} 1/s" in text
        )
    assert "writes every entry" in str(gain) and "qdot_m.joint_3" in str(small)


def test_a_motion_that_is_not_steady_is_sent_to_its_trajectory():
    robot = fflin.load("ets_vii")
    v = fflin.velocity(robot, {"omega_b.x": 0.1, "omega_b.y": 0.2, "joint_1": 0.1})
    with pytest.raises(fflin.EquilibriumError, match="moving=True"):
        fflin.lqr(fflin.linearize(robot, None, v), 1, 1)
    with pytest.raises(fflin.EquilibriumError, match=r"fflin\.tvlqr") as error:
        fflin.lqr(fflin.linearize(robot, None, v, moving=True), 1, 1)
    assert "moving=True" not in str(error.value)


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("dt", [0.02, 3.0])
def test_a_sampled_point_is_refused_with_the_rates_of_the_robot(moving, dt):
    # Every body falls at g, and the joints cannot hold the base. A sample of A and f0 also moves
    # the position, but the robot is at rest.
    robot = fflin.load("planar_detumble", gravity=(0.0, 0.0, -9.81))
    robot = robot.replace(inputs=[fflin.JointTorque("*")])
    lin = fflin.linearize(robot, moving=moving)
    stated = "not a fixed point: d v_b.z/dt = -9.81; "
    designs = (
        lambda: fflin.lqr(lin, 1, 1),
        lambda: fflin.lqr(lin.discretize(dt), 1, 1),
        lambda: fflin.mpc(lin, 1, 1, horizon=2, dt=dt),
        lambda: fflin.kalman(lin.discretize(dt), 1.0, 1.0),
    )
    for design in designs:
        with pytest.raises(fflin.EquilibriumError, match=re.escape(stated)):
            design()


def test_a_sampled_point_at_rest_has_no_rates_of_positions(tmp_path):
    # A constant acceleration a moves the position by a dt^2 / 2 in a sample. The continuous model
    # tells that the robot is at rest; a file of the sampled model knows only the mean rates.
    robot = fflin.load("planar_detumble", inputs=[fflin.JointTorque("joint_1")])
    lin = fflin.linearize(robot, u=[0.1])
    dt, first = 0.02, lin.state_names.index("qdot_m.joint_1")
    acceleration = f"d qdot_m.joint_1/dt = {lin.f0[first]:.6g}"
    sampled = lin.discretize(dt)
    sampled.save(tmp_path / "sampled.npz")
    with pytest.raises(fflin.EquilibriumError, match=re.escape(acceleration)) as error:
        fflin.lqr(sampled, 1, 1)
    assert "d q_m" not in str(error.value)
    loaded = fflin.LinearModel.load(tmp_path / "sampled.npz")
    mean = loaded.rate[lin.state_names.index("q_m.joint_1")]
    assert mean == pytest.approx(lin.f0[first] * dt / 2.0, rel=1e-12)


def test_an_equilibrium_does_not_depend_on_the_sampling_time(tmp_path):
    robot = fflin.load("planar_detumble")
    # 5e-9 m/s^2; the limit is 1e-9
    pushed = fflin.effort(robot, {"F_b.z": 5e-9 * robot.mass})
    lin = fflin.linearize(robot, u=pushed)
    assert not lin.is_equilibrium()
    for dt in (1e-3, 0.1):
        lin.discretize(dt).save(tmp_path / "sampled.npz")
        for sampled in (
            lin.discretize(dt),
            fflin.LinearModel.load(tmp_path / "sampled.npz"),
        ):
            assert not sampled.is_equilibrium()
            assert sampled.is_equilibrium(6e-9)


def test_a_weight_by_names_is_of_a_model():
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    for given in (fflin.lqr(lin), robot, 3):
        with pytest.raises(fflin.InputError, match="expected a LinearModel"):
            fflin.bryson(given, {"q_b": 0.1})


def test_a_feedback_accepts_the_gain_with_its_report():
    lin = fflin.linearize(fflin.load("planar_detumble"))
    gain = fflin.lqr(lin)
    assert (fflin.StateFeedback(lin, gain).K == gain.K).all()


def test_the_angle_of_a_wheel_is_not_regulated_whatever_its_speed_is():
    wheel = fflin.ReactionWheel((0, 0, 1), inertia=1e-3)
    robot = fflin.load("cubesat", inputs=[fflin.BaseTorque(), fflin.BaseForce(), wheel])
    report = " ".join(str(fflin.lqr(fflin.linearize(robot), wheel_speeds=True)).split())
    assert says(report, "not regulated: q_m.wheel_1", "angle of a wheel has no effect")
    assert "--wheel-speeds" not in report
