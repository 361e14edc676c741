"""Observability against exact arithmetic on the dual, and Gramians against their integrals."""

import numpy as np
import pytest
from scipy.linalg import expm

import fflin
from fflin import BasePose, JointPositions, JointTorque, JointVelocities
from tests.support import exact
from tests.support.robots import BUNDLED

ARMS = [name for name in BUNDLED if name != "cubesat"]


def hidden(lin, result):
    """The unobservable motions stay so: C V = 0, and A V within V."""
    V = np.linalg.qr(result.basis)[0]
    scale = max(1.0, np.abs(lin.A).max())
    assert result.dimension + V.shape[1] == len(lin.A)
    assert result.dimension == len(result.rows)
    assert len(result.unobservable) == V.shape[1] == len(result.fixed_poles)
    assert np.abs(lin.C @ V).max(initial=0.0) < 1e-8 * max(1.0, np.abs(lin.C).max())
    assert np.abs(lin.A @ V - V @ (V.T @ lin.A @ V)).max(initial=0.0) < 1e-7 * scale
    assert (
        np.abs(result.rows @ result.basis).max(initial=0.0)
        < 1e-8 * np.abs(result.rows).max()
    )


@pytest.mark.parametrize("name", ARMS)
def test_at_rest_it_is_the_kernel_of_C_and_CA(robots, name):
    robot = robots[name]
    n = robot.n
    for outputs, dimension in (
        ([fflin.FullState()], 12 + 2 * n),
        ([JointPositions()], 2 * n),
        ([JointVelocities()], n),
        ([BasePose()], 12),
        ([BasePose(), JointVelocities()], 12 + n),
        ([fflin.CenterOfMass()], 6),
        ([fflin.Momentum()], 6),
    ):
        lin = fflin.linearize(robot.replace(outputs=outputs))
        for model in (lin, lin.discretize(0.1)):
            result = fflin.observability(model)
            assert result.dimension == dimension and result.method == "closed form"
            assert result.detectable == (dimension == 12 + 2 * n)
            hidden(model, result)


def test_joints_only_hide_the_base(robots):
    robot = robots["ets_vii"]
    result = fflin.observability(
        fflin.linearize(robot.replace(outputs=[JointPositions()]))
    )
    assert result.unobservable == tuple(
        f"{group}.{axis}"
        for group in ("q_b", "r_b", "omega_b", "v_b")
        for axis in "xyz"
    )
    assert "not detectable" in str(result)


@pytest.mark.parametrize("name", ARMS)
def test_springs_and_dampers_against_exact_arithmetic(robots, name):
    """Observing joints of M a + D v + K q = 0 is reaching with the transposed matrices."""
    robot, rng = robots[name], np.random.default_rng(1)
    nv = 6 + robot.n
    for _ in range(4):
        joints = list(robot.joint_names)
        # Each spring of 1 to 9 rad/s on what it moves with the base free, each damper of 0.1 to 1.
        default = dict(
            zip(
                joints,
                1.0 / np.linalg.inv(fflin.linearize(robot).M).diagonal()[6:],
                strict=True,
            )
        )
        K = {
            j: default[j] * float(rng.uniform(1, 90))
            for j in joints
            if rng.random() < 0.6
        }
        D = {
            j: default[j] * float(rng.uniform(0.1, 1))
            for j in joints
            if rng.random() < 0.6
        }
        seen = [j for j in joints if rng.random() < 0.5] or joints[:1]
        chosen = robot.replace(
            stiffness=K, damping=D, outputs=[JointPositions(tuple(seen))]
        )
        lin = fflin.linearize(chosen)
        M, k, d = (
            exact.modular(x)
            for x in (
                lin.M,
                *(np.diag([0.0] * 6 + [v.get(j, 0.0) for j in joints]) for v in (K, D)),
            )
        )
        slopes = exact.solve(M, np.hstack((-k, -d)) % exact.PRIME)
        A = np.zeros((2 * nv, 2 * nv), dtype=np.int64)
        A[:nv, nv:] = np.eye(nv, dtype=np.int64)
        A[nv:] = slopes
        expected = exact.krylov_dimension(A.T.copy(), exact.modular(lin.C).T.copy())
        result = fflin.observability(lin)
        assert result.dimension == expected
        hidden(lin, result)
        assert fflin.observability(lin.discretize(0.02)).dimension == expected


def damped(robots):
    robot = robots["ets_vii"]
    robot = robot.replace(
        inputs=[JointTorque(j) for j in robot.joint_names],
        stiffness=50.0,
        damping=20.0,
        outputs=[JointPositions()],
    )
    return fflin.momentum_reduction(fflin.linearize(robot))


def test_endless_gramians_solve_lyapunov(robots):
    lin = damped(robots)
    result = fflin.gramians(lin)
    Wc, Wo = result.controllability, result.observability
    assert result.duration == np.inf
    assert lin.A @ Wc + Wc @ lin.A.T == pytest.approx(-lin.B @ lin.B.T, abs=1e-9)
    assert lin.A.T @ Wo + Wo @ lin.A == pytest.approx(-lin.C.T @ lin.C, abs=1e-9)
    sampled = lin.discretize(0.2)
    Wd = fflin.gramians(sampled).controllability
    assert sampled.A @ Wd @ sampled.A.T + sampled.B @ sampled.B.T == pytest.approx(
        Wd, rel=1e-9, abs=1e-9
    )
    assert fflin.gramians(lin, 1e4).controllability == pytest.approx(
        Wc, rel=1e-8, abs=1e-10
    )


def test_finite_gramians_are_the_integrals(robots):
    robot = robots["planar_detumble"]
    lin = fflin.linearize(robot)
    T = 3.0
    result = fflin.gramians(lin, T)
    # At rest A^2 = 0: the integrand is a polynomial of degree two, which Simpson sums exactly.
    nodes, weights = (0.0, T / 2, T), (T / 6, 4 * T / 6, T / 6)
    terms = [expm(lin.A * t) @ lin.B for t in nodes]
    Wc = sum(w * x @ x.T for w, x in zip(weights, terms, strict=True))
    assert result.controllability == pytest.approx(
        Wc, rel=1e-10, abs=1e-10 * np.abs(Wc).max()
    )
    terms = [lin.C @ expm(lin.A * t) for t in nodes]
    Wo = sum(w * x.T @ x for w, x in zip(weights, terms, strict=True))
    assert result.observability == pytest.approx(Wo, rel=1e-10, abs=1e-10)
    sampled = lin.discretize(0.5)
    powers = [np.linalg.matrix_power(sampled.A, k) @ sampled.B for k in range(7)]
    expected = sum(x @ x.T for x in powers)
    assert fflin.gramians(sampled, 3.5).controllability == pytest.approx(
        expected, rel=1e-10, abs=1e-12
    )


@pytest.mark.parametrize("T", [1e-3, 1e5, 1e8])
def test_gramians_at_rest_are_exact_over_any_horizon(robots, T):
    lin = fflin.linearize(robots["astrobee_arm"])
    result = fflin.gramians(lin, T)
    for A, B, W in (
        (lin.A, lin.B, result.controllability),
        (lin.A.T, lin.C.T, result.observability),
    ):
        Q = B @ B.T
        expected = Q * T + (A @ Q + Q @ A.T) * T**2 / 2 + A @ Q @ A.T * T**3 / 3
        np.testing.assert_allclose(
            W, expected, rtol=1e-12, atol=1e-14 * np.abs(expected).max()
        )


def test_gramians_that_do_not_exist(robots):
    lin = fflin.linearize(robots["ets_vii"])
    for model in (lin, lin.discretize(0.1)):
        with pytest.raises(fflin.InputError, match="duration"):
            fflin.gramians(model)
    with pytest.raises(fflin.InputError, match="duration is -1"):
        fflin.gramians(lin, -1.0)
    with pytest.raises(fflin.InputError, match="multiple"):
        fflin.gramians(lin.discretize(0.1), 0.25)
    with pytest.raises(fflin.InputError, match="LinearModel"):
        fflin.observability(3)
