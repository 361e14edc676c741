"""Filters, margins and predictive control of robots with constraints."""

import numpy as np
import pytest
import scipy.linalg as sl

import fflin
from tests.support.constrained import parallelogram


@pytest.fixture(scope="module")
def linkage():
    """A parallelogram of four bars that stands on its side, and is driven by one motor."""
    robot = parallelogram(0.6, 1.5, 0.8, 1.1)
    return robot.replace(
        inputs=[fflin.JointTorque("left")], outputs=[fflin.JointPositions()]
    )


@pytest.fixture(scope="module")
def lin(linkage):
    guess = {"left": 0.5, "bar": -0.5, "right": 0.5}
    held = fflin.equilibrium(linkage, fflin.configuration(linkage, guess))
    return fflin.linearize(linkage, held.q, u=held.u, independent=["left"])


def test_a_filter_uses_all_encoders_of_the_loop(lin):
    """Each of the three encoders shows the one angle, so three together have a third of V."""
    assert lin.C.shape == (3, 2)
    np.testing.assert_allclose(np.abs(lin.C), [[1.0, 0.0]] * 3, atol=1e-9)
    W, V = np.diag((0.0, 1e-2)), 3e-4
    result = fflin.kalman(lin, W, V)
    P = sl.solve_continuous_are(lin.A.T, np.eye(2)[:, :1], W, [[V / 3.0]])
    np.testing.assert_allclose(result.P, P, rtol=1e-9)
    assert result.state_names == ("q_m.left", "qdot_m.left")


def test_the_margins_are_those_of_the_pendulum(lin):
    gain = fflin.lqr(lin, {"q_m": 4.0, "qdot_m": 1.0}, 0.5)
    w = np.logspace(-3, 4, 40001)
    (a,), (b,) = lin.A[1, :1], lin.B[1]
    loop = (gain.K[0, 0] + 1j * w * gain.K[0, 1]) * b / (-(w**2) - a)
    # (S - T) / 2 = (1 - L) / (1 + L) / 2
    disk = 2.0 / np.abs((1.0 - loop) / (1.0 + loop)).max()
    assert fflin.margins(gain, lin).disk == pytest.approx(disk, rel=1e-6)


@pytest.mark.exhaustive
def test_predictive_control_regulates_a_closed_loop(linkage, lin):
    """Without limits, the first input is that of the regulator."""
    model = fflin.linearize(
        linkage.replace(outputs=[fflin.FullState()]),
        lin.q,
        u=lin.u0,
        independent=["left"],
    )
    sampled = model.discretize(0.05)
    gain = fflin.lqr(sampled, *fflin.sampled_cost(model, 0.05, 1.0, 1.0))
    policy = fflin.mpc(model, 1.0, 1.0, horizon=10, dt=0.05, limits=None)
    start = fflin.closed(
        linkage,
        fflin.configuration(linkage, {"left": 0.55, "bar": -0.55, "right": 0.55}),
    )
    motions = [
        fflin.simulate(linkage, law, q0=start, duration=0.5, dt=0.01, engine="python")
        for law in (policy, fflin.StateFeedback(sampled, gain.K))
    ]
    np.testing.assert_allclose(motions[0].q, motions[1].q, atol=1e-9)
    assert np.abs(motions[0].u).max() > 0.0
