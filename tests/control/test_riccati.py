"""Riccati equations by half the size: against the general solver and against laws."""

import warnings

import numpy as np
import pytest
import scipy.linalg as sl

import fflin
from fflin.control.optimal import riccati
from fflin.control.optimal.riccati import (
    _SOUND,
    ModalMatrix,
    Riccati,
    _bilinear,
    _finished,
    half_size,
    second_order_loop,
    solve,
    structured,
)
from tests.support.robots import BUNDLED, random_point, random_tree


def weightings(lin, rng):
    """Identity, Bryson's, and random weights, diagonal and full."""
    nx, nu = lin.B.shape
    inertia = lin.M.diagonal()
    full_q, full_r = rng.normal(size=(nx, nx)), rng.normal(size=(nu, nu))
    return {
        "identity": (np.eye(nx), np.eye(nu)),
        "bryson": (np.diag(rng.uniform(0.02, 0.2, nx) ** -2), np.diag(inertia**-2)),
        "diagonal": (
            np.diag(10 ** rng.uniform(-2, 2, nx)),
            np.diag(10 ** rng.uniform(-2, 2, nu)),
        ),
        "full": (full_q @ full_q.T, full_r @ full_r.T + 0.1 * np.eye(nu)),
    }


def relative_residual(A, B, Q, R, P, N=None, dt=0.0):
    """The residual as the library defines it, written out another way."""
    N = np.zeros(B.shape) if N is None else N
    if not dt:
        K = np.linalg.solve(R, (P @ B + N).T)
        terms = [A.T @ P, P @ A, -K.T @ R @ K, Q]
    else:
        E = A - np.eye(len(A))
        W = R + B.T @ P @ B
        K = np.linalg.solve(W, B.T @ P @ A + N.T)
        terms = [P @ E, E.T @ P, E.T @ P @ E, -K.T @ W @ K, Q]
    return np.linalg.norm(sum(terms)) / sum(map(np.linalg.norm, terms))


def general(A, B, Q, R, N=None, dt=0.0):
    solver = sl.solve_discrete_are if dt else sl.solve_continuous_are
    P = solver(A, B, Q, R, s=N)
    return 0.5 * (P + P.T)


def residual_of_rounded_entries(A, B, Q, R, P, dt):
    """The largest relative residual if each entry of P changes by at most one unit roundoff."""
    rng = np.random.default_rng(0)
    residuals = []
    for _ in range(8):
        change = np.finfo(float).eps * rng.uniform(-1.0, 1.0, P.shape)
        rounded = P * (1.0 + 0.5 * (change + change.T))
        residuals.append(relative_residual(A, B, Q, R, rounded, None, dt))
    return max(residuals)


def compare_with_the_general_solution(equation, result, P, label):
    """Not behind it in the residual, and no further from it than it is from the solution."""
    A, B, Q, R, dt = (
        equation.A,
        equation.B,
        equation.Q,
        equation.R,
        float(equation.discrete),
    )
    trial = equation.trial(P)
    # A residual below _SOUND ends the refinement.
    assert result.residual <= max(trial.residual, _SOUND), label
    # Written another way, it holds too. If the inertia is ill-conditioned, rounding the entries of
    # P changes this residual more than any solver can.
    check = relative_residual(A, B, Q, R, result.P, None, dt)
    reached = relative_residual(A, B, Q, R, P, None, dt)
    rounded = residual_of_rounded_entries(A, B, Q, R, result.P, dt)
    assert check <= 2.0 * max(reached, rounded) + 1e-14, label
    # What they are off by, to first order, is what the two differ by.
    F = A - B @ equation.gain(P)
    lyapunov = sl.solve_discrete_lyapunov if dt else sl.solve_continuous_lyapunov
    tolerance = 1e-13 * np.linalg.norm(P)
    for solution in (P, result.P):
        defect = equation.trial(solution).defect
        tolerance += np.linalg.norm(lyapunov(F.T, defect if dt else -defect))
    assert np.linalg.norm(result.P - P) <= 2.5 * tolerance, label


@pytest.mark.parametrize("name", [*BUNDLED, "tree_7", "tree_32"])
@pytest.mark.parametrize("dt", [0.0, 0.05])
def test_residual_is_at_or_below_the_general_solvers_and_gains_agree(robots, name, dt):
    rng = np.random.default_rng(3)
    robot = (
        robots[name]
        if name in robots
        else random_tree(rng, int(name.partition("_")[2]))
    )
    rest = fflin.linearize(robot, random_point(robot, rng)[0])
    lin = rest.discretize(dt) if dt else rest
    for label, (Q, R) in weightings(rest, rng).items():
        result = solve(lin.A, lin.B, Q, R, None, dt)
        equation = Riccati(lin.A, lin.B, Q, R, None, dt)
        # Under a hold the bilinear map may cost an ill-conditioned inertia the fallback.
        assert result.method == "structured" or dt, label
        try:
            P = general(lin.A, lin.B, Q, R, None, dt)
        except (
            ValueError,
            np.linalg.LinAlgError,
        ):  # which of the samples depends on the processor
            assert dt and result.residual < 1e-12, label
        else:
            compare_with_the_general_solution(equation, result, P, label)
        poles = np.linalg.eigvals(lin.A - lin.B @ result.K)
        scale = np.abs(poles - bool(dt)) if dt else np.abs(poles)
        for pole in result.poles:
            nearest = np.abs(poles - pole).argmin()
            assert np.abs(poles[nearest] - pole) <= 1e-7 * scale[nearest] + 1e-12, label
        assert np.linalg.eigvalsh(result.P)[0] > 0.0, label


def test_half_the_eigenproblem_has_the_hamiltonians_stable_eigenvalues(robots):
    lin = fflin.linearize(robots["ets_vii"])
    Q, R = weightings(lin, np.random.default_rng(5))["bryson"]
    modes, _ = second_order_loop(lin.A, lin.B, Q, np.linalg.cholesky(R))
    S = lin.B @ np.linalg.solve(R, lin.B.T)
    hamiltonian = np.linalg.eigvals(np.block([[lin.A, -S], [-Q, -lin.A.T]]))
    stable = hamiltonian[hamiltonian.real < 0.0]
    for pole in modes.values:
        assert np.abs(stable - pole).min() < 1e-7 * np.abs(pole)


def loops(robots):
    """Loops of models at rest, with springs, and of ones that move, turn and are damped."""
    rng = np.random.default_rng(6)
    plain = robots["dual_arm"]
    springs = plain.replace(stiffness=50.0)
    moving = springs.replace(damping=3.0, gravity=(0.0, 0.1, -0.3))
    point = random_point(moving, rng, speed=0.1)
    for lin, even in (
        (fflin.linearize(plain), True),
        (fflin.linearize(springs), True),
        (fflin.linearize(moving, *point), False),
        (fflin.linearize(moving, *point, moving=True), False),
    ):
        Q = np.diag(rng.uniform(1.0, 10.0, len(lin.A)))
        R = np.diag(lin.M.diagonal() ** -2.0)
        yield lin, Q, R, second_order_loop(lin.A, lin.B, Q, np.sqrt(R)), even


def test_the_continuous_equation_of_a_sampled_model_has_the_same_P(robots):
    lin = fflin.linearize(robots["ets_vii"])
    rng = np.random.default_rng(8)
    V = rng.normal(size=(36, 36))
    W = V @ V.T
    cost = fflin.sampled_cost(lin, 0.2, W[:24, :24], W[24:, 24:], W[:24, 24:])
    held = lin.discretize(0.2)
    equation = Riccati(held.A, held.B, *cost, held.dt)
    result = solve(held.A, held.B, *cost, held.dt)
    assert result.method == "structured" and result.residual < 1e-13
    assert _bilinear(equation).trial(result.P).residual < 1e-12
    other = Riccati(held.A, held.B, cost.Q, cost.R, -cost.N, held.dt)
    assert _bilinear(other).trial(result.P).residual > 1e-6


def test_half_size_loops_are_loops_of_the_model_and_optimal_without_odd_powers(robots):
    for lin, Q, R, (modes, tolerance), even in loops(robots):
        m = len(lin.A) // 2
        V, poles = modes.V, modes.values
        assert poles.real.max() < 0.0
        # The inputs make what is missing of V' = A V, in the velocities alone.
        missing = V * poles - lin.A @ V
        assert np.abs(missing[:m]).max() < 1e-10 * np.abs(lin.A @ V).max()
        U = np.linalg.solve(lin.B[m:], missing[m:])
        cost = V.conj().T @ Q @ V + U.conj().T @ R @ U
        assert tolerance == pytest.approx(cost, rel=1e-6, abs=1e-9 * np.abs(cost).max())
        residual = (
            Riccati(lin.A, lin.B, Q, R, None, 0.0)
            .trial(modes.lyapunov_modal(tolerance))
            .residual
        )
        assert (residual < 1e-11) == even


def test_springs_dampers_gravity_motion_and_cross_terms_keep_half_the_size(robots):
    rng = np.random.default_rng(7)
    robot = robots["servicer_7dof"].replace(
        stiffness=50.0, damping=3.0, gravity=(0.0, 0.1, -0.3)
    )
    q, v, u = random_point(robot, rng, speed=0.1)
    for lin in (
        fflin.linearize(robot, q, v, u),
        fflin.linearize(robot, q, v, u, moving=True),
    ):
        nx, nu = lin.B.shape
        Q = np.diag(rng.uniform(1.0, 10.0, nx))
        R = np.diag(1.0 / lin.M.diagonal() ** 2)
        N = 0.3 * rng.normal(size=(nx, nu)) @ np.sqrt(R) / nx
        for dt in (0.0, 0.1):
            point = lin.discretize(dt) if dt else lin
            result = half_size(point.A, point.B, Q, R, N, dt)
            P = general(point.A, point.B, Q, R, N, dt)
            if not dt:  # a hold does not keep the double integrators of a damped system
                assert result.method == "structured"
            result = solve(point.A, point.B, Q, R, N, dt)
            assert result.residual < 1e-13
            assert result.P == pytest.approx(P, rel=1e-6, abs=1e-8 * np.abs(P).max())


def test_more_inputs_than_coordinates_share_the_force_at_the_least_cost():
    thrusters = [
        x for x in fflin.load_inputs("cubesat") if isinstance(x, fflin.Thruster)
    ]
    robot = fflin.load("cubesat", inputs=thrusters)
    lin = fflin.linearize(robot)
    assert lin.B.shape == (12, 12)
    Q, R = np.eye(12), np.diag(np.linspace(1.0, 3.0, 12))
    result = solve(lin.A, lin.B, Q, R)
    assert result.method == "structured"
    assert result.P == pytest.approx(
        sl.solve_continuous_are(lin.A, lin.B, Q, R), rel=1e-9
    )


def test_other_systems_go_to_the_general_solver():
    rng = np.random.default_rng(11)
    for n, nu in ((5, 2), (6, 2), (6, 3)):
        A, B = rng.normal(size=(n, n)), rng.normal(size=(n, nu))
        result = solve(A, B, np.eye(n), np.eye(nu))
        assert half_size(A, B, np.eye(n), np.eye(nu)) is None
        assert result.method == "general" and result.residual < 1e-14
        assert result.P == pytest.approx(
            sl.solve_continuous_are(A, B, np.eye(n), np.eye(nu))
        )
    with pytest.raises(np.linalg.LinAlgError):
        solve(np.eye(2), np.zeros((2, 1)), np.eye(2), np.eye(1))


def test_modes_that_coincide_cost_the_fallback_and_no_digits():
    """Critically damped channels: lambda^4 - 2 lambda^2 + 1 has double roots in lambda^2."""
    lin = fflin.linearize(fflin.load("cubesat"))
    s = np.array([0.5] * 3 + [1.0] * 3)
    Q = np.diag(np.concatenate((np.ones(6) / s**2, 2.0 * np.ones(6))))
    inverse = np.linalg.inv(lin.M)
    R = inverse @ inverse  # a cost of 1 on accelerations
    result = solve(lin.A, lin.B, Q, R)
    assert result.residual < 1e-13
    # In closed form kp = 1/s and kd = 2.
    assert result.K @ np.vstack((np.eye(6), np.zeros((6, 6)))) == pytest.approx(
        lin.M @ np.diag(1.0 / s), rel=1e-6, abs=1e-9 * lin.M.max()
    )


def test_badly_scaled_weights_never_cost_the_residual(robots):
    rng = np.random.default_rng(13)
    for name in ("canadarm2", "servicer_7dof", "astrobee_arm"):
        lin = fflin.linearize(robots[name])
        nx, nu = lin.B.shape
        Q = np.diag(10 ** rng.uniform(-6, 6, nx))
        inverse = np.linalg.inv(lin.M)
        on_accelerations = inverse @ inverse
        on_accelerations = 0.5 * (on_accelerations + on_accelerations.T)
        for R in (np.diag(10 ** rng.uniform(-4, 4, nu)), on_accelerations):
            result = solve(lin.A, lin.B, Q, R)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                P = general(lin.A, lin.B, Q, R)
            assert (
                result.residual
                <= Riccati(lin.A, lin.B, Q, R, None, 0.0).trial(P).residual
            )
            assert result.poles.real.max() < 0.0


@pytest.mark.parametrize("dt", [0.0, 0.1])
@pytest.mark.parametrize("cross", [False, True])
def test_inputs_whose_costs_are_far_apart_are_scaled_first(robots, dt, cross):
    """SciPy's solver takes such an R for a singular one."""
    lin = fflin.linearize(robots["astrobee_arm"].replace(stiffness=20.0, damping=1.0))
    lin = lin.discretize(dt) if dt else lin
    nx, nu = lin.B.shape
    R = np.diag(np.geomspace(1e-12, 1e12, nu))
    N = 0.1 * np.sqrt(R)[np.arange(nx) % nu] if cross else None
    if not dt:
        with pytest.raises((ValueError, np.linalg.LinAlgError)):
            sl.solve_continuous_are(lin.A, lin.B, np.eye(nx), R, s=N)
    result = solve(lin.A, lin.B, np.eye(nx), R, N, dt)
    assert result.residual < 1e-10


def test_lyapunov_equations_by_modes(monkeypatch):
    rng = np.random.default_rng(17)
    F = rng.normal(size=(9, 9)) - 4.0 * np.eye(9)
    r = rng.normal(size=(9, 9))
    r += r.T
    assert ModalMatrix.of(F, False).lyapunov(r) == pytest.approx(
        sl.solve_continuous_lyapunov(F.T, -r), rel=1e-10, abs=1e-12
    )
    F /= 1.2 * np.abs(np.linalg.eigvals(F)).max()
    assert ModalMatrix.of(F, True).lyapunov(r) == pytest.approx(
        sl.solve_discrete_lyapunov(F.T, r), rel=1e-10, abs=1e-11
    )
    near = F + 1e-11 * rng.normal(size=F.shape)
    exact = np.sort_complex(np.linalg.eigvals(near))
    with monkeypatch.context() as patch:
        patch.setattr(np.linalg, "eigvals", None)  # they are read off
        poles = ModalMatrix.of(F, True).poles(near)
        assert np.sort_complex(poles) == pytest.approx(exact, rel=1e-9)
        assert (np.sort_complex(poles.conj()) == np.sort_complex(poles)).all()
    far = F + 0.1 * rng.normal(size=F.shape)
    exact = np.sort_complex(np.linalg.eigvals(far))
    assert np.sort_complex(ModalMatrix.of(F, True).poles(far)) == pytest.approx(
        exact, rel=1e-9
    )


def test_an_unstable_solution_is_rejected(robots):
    lin = fflin.linearize(robots["cubesat"])
    for model in (lin, lin.discretize(0.1)):
        equation = Riccati(model.A, model.B, np.eye(12), np.eye(6), None, model.dt)
        result = solve(model.A, model.B, np.eye(12), np.eye(6), None, model.dt)
        assert (
            _finished(equation, equation.trial(result.P), None, "general") is not None
        )
        assert (
            _finished(equation, equation.trial(0.0 * result.P), None, "general") is None
        )
        if not model.dt:
            assert (
                _finished(equation, equation.trial(-result.P), None, "general") is None
            )


def test_critical_damping_is_solved_by_half_the_size():
    """The rate's weight is such that both poles of each axis are at -1: modes coincide."""
    A, B = (
        np.kron([[0.0, 1.0], [0.0, 0.0]], np.eye(3)),
        np.kron([[0.0], [1.0]], np.eye(3)),
    )
    Q, R = np.diag([1.0] * 3 + [2.0] * 3), np.eye(3)
    result = half_size(A, B, Q, R)
    assert result is not None
    # (s + 1)^2 = s^2 + 2 s + 1: u = -p - 2 pdot.
    assert result.K == pytest.approx(np.kron([[1.0, 2.0]], np.eye(3)), abs=1e-13)
    assert result.residual < 1e-15
    # the root of the rounding
    assert result.poles == pytest.approx(-np.ones(6), abs=1e-7)


def of_inertias(spread, m=20):
    """Double integrators with an inertia matrix of the given condition number."""
    axes = np.linalg.qr(np.random.default_rng(1).normal(size=(m, m)))[0]
    inertia = axes * np.logspace(0.0, np.log10(spread), m) @ axes.T
    A, B = np.zeros((2 * m, 2 * m)), np.zeros((2 * m, m))
    A[:m, m:], B[m:] = np.eye(m), np.linalg.inv(inertia)
    return A, B, np.eye(2 * m), np.eye(m)


@pytest.mark.parametrize("dt", [0.0, 0.1])
@pytest.mark.parametrize("spread", [1e2, 1e4, 1e6])
def test_the_rounding_of_a_residual_is_predicted(spread, dt):
    A, B, Q, R = of_inertias(spread)
    if dt:
        A, B = np.eye(len(A)) + dt * A, dt * B + 0.5 * dt**2 * A @ B
    equation = Riccati(A, B, Q, R, None, dt)
    trial = equation.trial(solve(A, B, Q, R, None, dt).P)
    # The same residual matrix with 64 bits instead of 53 bits
    if np.finfo(np.longdouble).eps > 1e-18:
        pytest.skip("long double has no more bits than double")
    P, E = trial.P.astype(np.longdouble), equation.rate.astype(np.longdouble)
    change = P @ E
    Y = B.T.astype(np.longdouble) @ P
    spent = Y.T @ Y
    defect = change + change.T - spent + Q
    if dt:
        K = equation.gain(trial.P).astype(np.longdouble)
        W = R + B.T.astype(np.longdouble) @ P @ B
        Z = Y @ A
        # W is rounded in K, but the residual of W K = Z enters as its square only.
        spent = Z.T @ K + K.T @ Z - K.T @ W @ K
        defect = change + change.T + E.T @ change - spent + Q
    size = np.linalg.norm(trial.defect) / trial.residual
    apart = float(np.sqrt(((trial.defect - defect) ** 2).sum())) / size
    # Independent errors are at most half an EPS, and some cancel, so the prediction is larger.
    assert 0.05 * trial.rounding < apart < trial.rounding


def test_an_ill_conditioned_inertia_is_solved_by_half_the_size(monkeypatch):
    """Its residual is rounding alone, so no other method and no other modes are tried."""
    A, B, Q, R = of_inertias(1e7)
    calls = []
    monkeypatch.setattr(riccati, "_general", lambda *_: calls.append("general"))
    modes = ModalMatrix.of
    monkeypatch.setattr(
        ModalMatrix, "of", lambda *given: calls.append("modes") or modes(*given)
    )
    result = solve(A, B, Q, R)
    assert calls.count("modes") <= 1
    assert "general" not in calls
    assert 1e-11 < result.residual < result.rounding
    # Each eigenvalue s of the inertia is a double integrator with B = 1/s and unit weights, whose
    # closed-loop polynomial is z^2 + z sqrt(1/s^2 + 2/s) + 1/s.
    s = np.logspace(0.0, 7.0, 20)
    damping = np.sqrt(1.0 / s**2 + 2.0 / s)
    roots = np.array(
        [np.roots([1.0, d, 1.0 / item]) for d, item in zip(damping, s, strict=True)]
    )
    slowest = -np.abs(roots.real).min()
    assert result.poles.real.max() == pytest.approx(slowest, rel=1e-6)


def test_an_inaccurate_start_is_not_computed_again(monkeypatch):
    """The regulator tries the half-size method once, and then SciPy's."""
    lin = fflin.linearize(fflin.load("cubesat"))
    starts = []

    def poor(equation, apart=0.0):
        starts.append(apart)
        result = structured(equation, apart)
        return result._replace(residual=1e-3)

    monkeypatch.setattr("fflin.control.lqr.structured", poor)
    gain = fflin.lqr(lin, np.eye(12), np.eye(6))
    assert starts == [0.0]
    assert gain.method == "general"
