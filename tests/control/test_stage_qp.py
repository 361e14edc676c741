"""Quadratic programs over stages: optimality, bounds that are soft, and what has no solution."""

import sys

import numpy as np
import pytest
import scipy.sparse as sp

from fflin import MissingPackageError
from fflin.control.optimal.plan_search import solve_stages

N, NX, NU = 6, 3, 2


def problem(**given):
    """The arguments of a program, by name."""
    rng = np.random.default_rng(3)
    shape = (N + 1, NX + NU)
    of_x = np.arange(N * (NX + NU)) % (NX + NU) < NX  # at every knot but the first
    ends = rng.normal(size=(N, NX, NX + 2 * NU))
    ends[:, :, :NX] = np.eye(NX) + 0.3 * ends[:, :, :NX]
    c = 0.3 * rng.normal(size=(N, NX))
    c[0] += 1.0
    values = {
        "ends": ends,
        "c": c,
        "cost": rng.normal(size=shape) ** 2,
        "g": rng.normal(size=shape),
        "limits": np.multiply.outer((-0.2, 0.2), np.ones((N + 1, NU))),
        "rows": sp.csr_array(np.eye((N + 1) * (NX + NU))[NX + NU :][of_x]),
        "room": np.outer((-0.6, 0.6), np.ones(N * NX)),
        "prices": np.full(N * NX, 5.0),
        "scale": np.array([1.0, 2.0, 0.3, 5.0, 1.0]),
    }
    return values | given


def solved(**given):
    return solve_stages(**problem(**given))


def test_the_solution_meets_the_conditions_of_optimality():
    """The slopes of the Lagrangian are the prices of the bounds: none inside, outwards at a hard
    one, no more than `soft` at a soft one and just that beyond it."""
    qp = problem()
    x, u, y, _ = solved()
    A, B, D = np.split(qp["ends"], (NX, NX + NU), axis=2)
    w = np.hstack((x, u))
    after = [A[k] @ x[k] + B[k] @ u[k] + D[k] @ u[k + 1] + qp["c"][k] for k in range(N)]
    assert x[0] == pytest.approx(0.0, abs=1e-8)
    assert x[1:] == pytest.approx(np.array(after), abs=1e-7)
    slopes = qp["cost"] * w + qp["g"]
    for k in range(N):
        slopes[k] += np.concatenate((A[k].T @ y[k], B[k].T @ y[k]))
        slopes[k + 1] -= np.concatenate((y[k], -D[k].T @ y[k]))
    slopes, w = slopes[1:], w[1:]
    bound, soft = (
        np.repeat([[0.6, 0.2], [5.0, np.inf]], (NX, NU), axis=1)[:, None] + 0.0 * w
    )
    out = -slopes * np.sign(w)
    inside, beyond = np.abs(w) < bound - 1e-5, np.abs(w) > bound + 1e-5
    assert inside.any() and beyond.any() and (~inside & np.isinf(soft)).any()
    assert slopes[inside] == pytest.approx(0.0, abs=1e-5)
    assert (
        out[beyond] == pytest.approx(5.0, abs=1e-5) and not np.isinf(soft[beyond]).any()
    )
    assert (out[~inside] > -1e-5).all() and (out <= soft + 1e-5).all()
    assert (np.abs(u) <= 0.2).all()


def test_combined_variables_keep_their_limits_where_these_cost_more_than_to_exceed_them():
    """The multiplier of a soft limit is at most its price."""
    qp, rng = problem(), np.random.default_rng(1)
    more = sp.csr_array(rng.normal(size=(4, (N + 1) * (NX + NU))))
    rows = sp.vstack((qp["rows"], more))

    def values(result):
        return more @ np.hstack(result[:2]).ravel()

    before = values(solved())
    high = before - 0.01 * np.abs(before)
    room = np.hstack((qp["room"], (np.full(4, -np.inf), high)))
    hard, soft = (
        values(
            solved(
                rows=rows, room=room, prices=np.append(qp["prices"], np.full(4, price))
            )
        )
        for price in (1e3, 1e-6)
    )
    assert (hard <= high + 1e-7).all() and np.abs(hard - high).min() < 1e-7
    assert soft == pytest.approx(before, abs=1e-4)
    prices = np.append(qp["prices"], np.full(4, 1e3))
    scaled = solved(rows=rows, room=room, prices=prices, scale=np.ones(NX + NU))
    assert values(scaled) == pytest.approx(hard, abs=1e-6)


def test_scales_change_nothing_and_hard_bounds_may_leave_nothing():
    for result, known in zip(solved(), solved(scale=np.ones(NX + NU)), strict=True):
        assert result == pytest.approx(known, abs=1e-6)
    limits = problem()["limits"].copy()
    limits[1, 2, 0] = -0.3  # below the lower limit
    assert solved(limits=limits) is None
    none = {"rows": sp.csr_array((0, (N + 1) * (NX + NU))), "room": np.zeros((2, 0))}
    free = solved(**none, prices=np.zeros(0))
    beyond = [np.maximum(np.abs(x) - 0.6, 0.0).sum() for x in (free[0], solved()[0])]
    assert beyond[0] > beyond[1] + 0.1 and np.abs(free[1]).max() <= 0.2


def test_without_the_solver_the_error_names_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "piqp", None)
    with pytest.raises(MissingPackageError, match=r"'fflin\[mpc\]'"):
        solved()
