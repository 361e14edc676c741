"""Quadratic programs over stages: optimality, bounds that are soft, and what has no solution."""

import sys

import numpy as np
import pytest

from fflin import MissingPackageError
from fflin.control.optimal.plan_search import StageRows, solve_stages

N, NX, NU = 6, 3, 2


def problem(**given):
    """The arguments of a program, by name."""
    rng = np.random.default_rng(3)
    shape = (N + 1, NX + NU)
    roots = rng.normal(size=(*shape, NX + NU))
    low = np.full(shape, -0.6)
    low[:, NX:] = -0.2
    low[0, :NX] = -np.inf
    ends = rng.normal(size=(N, NX, NX + 2 * NU))
    ends[:, :, :NX] = np.eye(NX) + 0.3 * ends[:, :, :NX]
    c = 0.3 * rng.normal(size=(N, NX))
    c[0] += 1.0
    values = {
        "ends": ends,
        "c": c,
        "H": roots @ roots.transpose(0, 2, 1),
        "g": rng.normal(size=shape),
        "limits": np.array((low, -low)),
        "soft": np.tile(np.where(np.arange(NX + NU) < NX, 5.0, np.inf), (N + 1, 1)),
        "rows": StageRows(np.zeros(0, int), np.zeros((0, NX + 2 * NU)), np.zeros((2, 0)), 1.0),
        "scale": np.array([1.0, 2.0, 0.3, 5.0, 1.0]),
    }
    return values | given


def solved(**given):
    return solve_stages(**problem(**given))


def test_the_solution_meets_the_conditions_of_optimality():
    """The slopes of the Lagrangian are the prices of the bounds: none inside, outwards at a hard
    one, no more than `soft` at a soft one and just that beyond it."""
    qp = problem()
    x, u, y = solved()
    A, B, D = np.split(qp["ends"], (NX, NX + NU), axis=2)
    w = np.hstack((x, u))
    after = [A[k] @ x[k] + B[k] @ u[k] + D[k] @ u[k + 1] + qp["c"][k] for k in range(N)]
    assert x[0] == pytest.approx(0.0, abs=1e-8)
    assert x[1:] == pytest.approx(np.array(after), abs=1e-7)
    slopes = (qp["H"] @ w[..., None])[..., 0] + qp["g"]
    for k in range(N):
        slopes[k] += np.concatenate((A[k].T @ y[k], B[k].T @ y[k]))
        slopes[k + 1] -= np.concatenate((y[k], -D[k].T @ y[k]))
    slopes, w, bound, soft = slopes[1:], w[1:], qp["limits"][1, 1:], qp["soft"][1:]
    out = -slopes * np.sign(w)
    inside, beyond = np.abs(w) < bound - 1e-5, np.abs(w) > bound + 1e-5
    assert inside.any() and beyond.any() and (~inside & np.isinf(soft)).any()
    assert slopes[inside] == pytest.approx(0.0, abs=1e-5)
    assert out[beyond] == pytest.approx(5.0, abs=1e-5) and not np.isinf(soft[beyond]).any()
    assert (out[~inside] > -1e-5).all() and (out <= soft + 1e-5).all()
    assert (np.abs(u) <= 0.2).all()


def test_combined_variables_keep_their_limits_where_these_cost_more_than_to_exceed_them():
    """The multiplier of a soft limit is at most its price."""
    x, u, _ = solved()
    rng = np.random.default_rng(1)
    k, G = np.array([1, 1, 3, N - 1]), rng.normal(size=(4, NX + 2 * NU))
    none = StageRows(k, G, np.outer((-1.0, 1.0), np.full(4, np.inf)), 1e3)
    before = none.values(x, u)
    assert before[3] == pytest.approx(G[3] @ np.concatenate((x[N - 1], u[N - 1], u[N])), abs=1e-12)
    high = before - 0.01 * np.abs(before)
    rows = none._replace(limits=np.array((none.limits[0], high)))
    hard, soft = (none.values(*solved(rows=rows._replace(soft=price))[:2]) for price in (1e3, 1e-6))
    assert (hard <= high + 1e-7).all() and np.abs(hard - high).min() < 1e-7
    assert soft == pytest.approx(before, abs=1e-4)
    scaled = solved(rows=rows, scale=np.ones(NX + NU))
    assert none.values(*scaled[:2]) == pytest.approx(hard, abs=1e-6)


def test_scales_change_nothing_and_hard_bounds_may_leave_nothing():
    for found, known in zip(solved(), solved(scale=np.ones(NX + NU)), strict=True):
        assert found == pytest.approx(known, abs=1e-6)
    qp = problem()
    assert solved(soft=np.full_like(qp["g"], np.inf), c=qp["c"] + 50.0) is None


def test_without_the_solver_it_is_said_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "piqp", None)
    with pytest.raises(MissingPackageError, match=r"'fflin\[mpc\]'"):
        solved()
