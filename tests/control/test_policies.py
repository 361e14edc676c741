"""Least squares within bounds, against a solver that knows nothing of thrusters."""

import itertools

import numpy as np
import pytest
from scipy.optimize import linprog, lsq_linear

from fflin.control.authority import gives_every_wrench
from fflin.kernel import allocation
from fflin.kernel.allocation import nearest


@pytest.mark.parametrize("seed", range(40))
def test_it_is_the_least_squares_within_the_bounds(seed):
    rng = np.random.default_rng(seed)
    rows, pushing, others = rng.integers(3, 9), rng.integers(0, 7), rng.integers(0, 4)
    count = max(1, pushing + others)
    A, b = (
        rng.normal(size=(rows, count)),
        rng.normal(size=rows) * 10.0 ** rng.integers(-6, 7),
    )
    least = np.where(np.arange(count) < pushing, 0.0, -np.inf)
    most = np.full(count, np.inf)
    if seed % 3 == 0:
        most[:] = rng.uniform(0.01, 0.3, count) * np.linalg.norm(b)
        least[pushing:] = -most[pushing:]
    u = nearest(A, b, least, most)
    assert (u >= least).all() and (u <= most).all()
    size = np.linalg.norm(b)
    best = lsq_linear(
        A, b / size, (least / size, most / size), method="bvls", tol=1e-14
    )
    assert np.linalg.norm(A @ u - b) / size <= np.sqrt(2.0 * best.cost) + 1e-9


def test_of_all_that_do_the_same_it_is_the_least():
    u = nearest(np.ones((1, 4)), np.array([2.0]), np.zeros(4), np.full(4, np.inf))
    assert u == pytest.approx([0.5] * 4, abs=1e-9)
    assert not nearest(np.ones((2, 3)), np.zeros(2), np.zeros(3), np.ones(3)).any()


def test_an_input_that_leaves_its_bound_adds_one_column_to_the_factor(monkeypatch):
    added = []
    fit = allocation._fit

    def noted(problem, size, free, kept):
        added.extend(range(kept, free))
        fit(problem, size, free, kept)

    monkeypatch.setattr(allocation, "_fit", noted)
    wanted = np.arange(1.0, 7.0)  # the last thruster leaves its bound first
    u = nearest(np.eye(6), wanted, np.zeros(6), np.full(6, np.inf))
    assert u == pytest.approx(wanted, rel=1e-12)
    assert added == [0, 1, 2, 3, 4, 5]


def test_thrusters_that_push_every_way():
    corners = np.array(list(itertools.product((1, -1), repeat=3)))
    x, y, z = corners.T
    d = np.column_stack((y * z, -x * y, x * z))
    W = np.vstack((d.T, np.cross(corners * (0.6, 0.55, 0.65), d).T))
    pushing = np.ones(8, dtype=bool)
    assert gives_every_wrench(W, pushing)
    # Every wrench and its opposite can be had, by an independent solver.
    for wrench in np.vstack((np.eye(6), -np.eye(6))):
        assert linprog(np.ones(8), A_eq=W, b_eq=wrench, bounds=(0, None)).status == 0
    assert not gives_every_wrench(W[:, :7], pushing[:7])
    assert not gives_every_wrench(np.eye(6), np.arange(6) < 3)
    assert gives_every_wrench(np.eye(6), np.zeros(6, dtype=bool))
    assert gives_every_wrench(
        np.hstack((np.eye(6), -np.eye(6))), np.ones(12, dtype=bool)
    )


def test_an_input_with_zero_limits_is_zero():
    u = nearest(
        np.ones((1, 3)),
        np.array([3.0]),
        np.array([0, -1.0, 0]),
        np.array([0, 1.0, 5.0]),
    )
    assert u[0] == pytest.approx(0.0, abs=1e-12)
    assert u[1:] == pytest.approx([1.0, 2.0])
