"""The equations of A, B and f0 over rows of points, and what they are in closed form."""

from itertools import product

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.base.rotation import skew
from fflin.dynamics.coordinates import ReferenceChart
from fflin.dynamics.rnea import AccelerationDerivatives, Accelerations
from fflin.dynamics.state import Actuation
from fflin.linear.state_equations import assemble
from tests.support.robots import random_point, random_pose

COUNT = 5
GRAVITY = [{"gravity": (0.0, 0.0, 0.0)}, {"gravity": (0.3, -1.0, 2.0)}]
CASES = [
    *product(("hybrid", "local", "world"), (True, False), (False,), GRAVITY),
    *product(("local",), (True,), (True,), GRAVITY),
    (None, False, False, {"orbit": fflin.CircularOrbit(500e3)}),
]


def rows_of(robot, frame, default):
    """State, actuation, chart, nu, u and rates of some points, and the same point by point."""
    rng = np.random.default_rng(3)
    reference = None if default else random_pose(rng, 40.0)
    state = fflin.StateMap(robot, reference=reference, frame=frame)
    actuation = Actuation(state)
    source = Accelerations(state, actuation, robot.create_data())
    q, v, u = map(
        np.array, zip(*(random_point(robot, rng) for _ in range(COUNT)), strict=True)
    )
    if robot.orbit:
        q[:, :3] *= 0.1
    nv, nu = state.nx // 2, state.velocities(v)
    chart = ReferenceChart(COUNT) if default else state.charts(q)
    u = actuation.in_base_axes(chart, u)
    rates = [
        source.rates(*point, np.empty((nv, 2 * nv)), np.empty((nv, u.shape[1])))
        for point in zip(q, v, nu, u, strict=True)
    ]
    charts = [ReferenceChart() if default else state.chart(row) for row in q]
    return (
        state,
        actuation,
        (chart, nu, u, rates),
        list(zip(charts, nu, u, rates, strict=True)),
    )


def assembled(state, actuation, chart, nu, u, rates, moving):
    """A, the lower half of B, and f0, of rates that are left as they are."""
    A = np.zeros((*nu.shape[:-1], state.nx, state.nx))
    A[..., : state.nx // 2, :] = fflin.Linearizer(state.robot).prepared.rest["A"][
        : state.nx // 2
    ]
    A[..., state.nx // 2 :, :] = rates.slopes
    derivatives = AccelerationDerivatives(
        rates.c, A[..., state.nx // 2 :, :], rates.by_u.copy(), rates.gravity
    )
    f0 = assemble(actuation, chart, nu, u, derivatives, A, moving=moving)
    return A, derivatives.by_u, f0


@pytest.mark.parametrize(("frame", "default", "moving", "fields"), CASES)
def test_many_rows_are_the_same_as_one_after_the_other(
    robots, frame, default, moving, fields
):
    robot = robots["planar_detumble"].replace(**fields)
    state, actuation, (chart, nu, u, rates), points = rows_of(robot, frame, default)
    many = AccelerationDerivatives(
        *(np.array(part) for part in zip(*rates, strict=True))
    )
    result = assembled(state, actuation, chart, nu, u, many, moving)
    for row, point in enumerate(points):
        for all_rows, one in zip(
            result, assembled(state, actuation, *point, moving), strict=True
        ):
            assert np.abs(all_rows[row] - one).max() < 1e-13 * max(
                1.0, np.abs(one).max()
            )


def test_charts_of_rows_match_charts_of_single_points(robots):
    robot = robots["planar_detumble"]
    rng = np.random.default_rng(5)
    state = fflin.StateMap(robot, reference=random_pose(rng, 70.0))
    q = np.array([random_point(robot, rng)[0] for _ in range(COUNT)])
    charts = state.charts(q)
    w = rng.normal(size=(COUNT, 3))
    for row, point in enumerate(q):
        one = state.chart(point)
        for name in ("q_b", "R", "N", "J"):
            assert getattr(charts, name)[row] == pytest.approx(
                getattr(one, name), abs=1e-14
            )
        assert charts.q0[row, 0] == pytest.approx(one.q0, abs=1e-14) and one.q0 >= 0.0
        assert charts.rate(w)[row] == pytest.approx(one.rate(w[row]), abs=1e-14)
    # (1.2) and (1.3): N and J are inverse, R = exp of twice the angle of q_b about its axis.
    assert charts.N @ charts.J == pytest.approx(
        np.tile(np.eye(3), (COUNT, 1, 1)), abs=1e-12
    )
    for q_b, R in zip(charts.q_b, charts.R, strict=True):
        size = np.linalg.norm(q_b)
        assert R == pytest.approx(
            pin.exp3(2.0 * np.arcsin(size) * q_b / size), abs=1e-12
        )


def test_a_body_that_turns_alone_has_its_closed_form(robots):
    """Euler's equations: d(omega)/dt = I^-1 (tau - omega x I omega), here about the centre."""
    robot = robots["cubesat"]
    rng = np.random.default_rng(7)
    q, v, _ = random_point(robot, rng)
    tau = rng.normal(size=3)
    lin = fflin.linearize(
        robot, q, v, np.concatenate((tau, np.zeros(3))), frame="local"
    )
    body, w = robot.model.inertias[1], v[3:]
    # About the base's origin, since M is.
    M = lin.M
    blocks = M[:3, :3], M[:3, 3:], M[3:, 3:]
    momentum = blocks[0] @ w  # of the turn alone, which is all that the moments feel
    pull = np.concatenate((np.cross(w, momentum), np.cross(w, blocks[1].T @ w)))
    c = np.linalg.solve(M, np.concatenate((tau, np.zeros(3))) - pull)
    a = c[3:] - np.cross(w, v[:3])
    assert lin.f0[6:9] == pytest.approx(c[:3], abs=1e-11 * np.abs(c).max())
    assert lin.f0[9:] == pytest.approx(a, abs=1e-11 * np.abs(a).max())
    assert body.mass == pytest.approx(blocks[2][0, 0])
    assert lin.A[:3, :3] == pytest.approx(-0.5 * skew(w), abs=1e-14)
