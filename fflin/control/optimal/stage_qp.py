"""Quadratic programs over the stages of a linear motion, solved by PIQP."""

from typing import NamedTuple

import numpy as np

from fflin.base.errors import optional_package
from fflin.base.validation import Array, Indices

# Absolute and relative tolerance of the optimality conditions of the scaled problem.
_ACCURACY = 1e-10


class StageSolution(NamedTuple):
    """Optimal states and inputs, and the multipliers of the equality constraints."""

    x: Array  # (N + 1, nx)
    u: Array  # (N + 1, nu)
    y: Array  # (N, nx), multipliers of A x + B u + D u[k + 1] + c - x[k + 1] = 0


class StageRows(NamedTuple):
    """Soft limits low - s <= G (x[k], u[k], u[k + 1]) <= high + s of linear combinations."""

    k: Indices  # (m,)
    G: Array  # (m, nx + 2 nu)
    low: Array  # (m,)
    high: Array
    soft: float  # cost of a unit of s

    def values(self, x: Array, u: Array) -> Array:
        """Return G (x[k], u[k], u[k + 1]) (m,)."""
        stages = np.hstack((x[self.k], u[self.k], u[self.k + 1]))
        values: Array = np.einsum("ij,ij->i", self.G, stages)
        return values


class StageQP(NamedTuple):
    r"""Quadratic program in w = (x, u) over N stages, with bounds on every variable.

    .. math::
        \min \sum_{k=0}^N \tfrac12 w_k^T H_k w_k + g_k^T w_k + \mathrm{soft}_k^T s_k, \quad
        x_{k+1} = A_k x_k + B_k u_k + D_k u_{k+1} + c_k, \quad
        \mathrm{low}_k - s_k \le w_k \le \mathrm{high}_k + s_k, \quad s_k \ge 0

    The soft limits of `rows` are further constraints.
    """

    start: Array  # x[0] (nx,)
    A: Array  # (N, nx, nx)
    B: Array  # (N, nx, nu)
    D: Array  # (N, nx, nu), zero if inputs are held
    c: Array  # (N, nx)
    H: Array  # (N + 1, nx + nu, nx + nu), positive semidefinite
    g: Array  # (N + 1, nx + nu)
    low: Array  # (N + 1, nx + nu)
    high: Array
    soft: Array  # (N + 1, nx + nu)
    rows: StageRows
    scale: Array  # (nx + nu,), typical sizes of the variables, which scale the program

    def solve(self) -> StageSolution | None:
        """Return the solution, or None if the program is infeasible or the solver fails."""
        import scipy.sparse as sp

        piqp = optional_package("piqp", "this needs the solver PIQP", "mpc")
        (N, nx, nu), (knots, nw) = self.B.shape, self.g.shape
        size, of_rows = np.tile(self.scale, knots), 1.0 / np.tile(self.scale[:nx], knots)
        none = sp.csc_array((N * nx, nw))
        ends = np.concatenate((np.tile(-np.eye(nx), (N, 1, 1)), self.D), axis=2)
        links = sp.hstack((sp.block_diag(np.concatenate((self.A, self.B), axis=2)), none))
        links = links + sp.hstack((none, sp.block_diag(ends)))
        first = sp.eye_array(nx, knots * nw)
        E = sp.diags_array(of_rows) @ sp.vstack((first, links)) @ sp.diags_array(size)
        H = self.scale[:, None] * self.H * self.scale
        cost = np.abs(H).max() or 1.0
        low, high = (each.ravel() / size for each in (self.low, self.high))
        prices = self.soft.ravel() * size
        at = np.flatnonzero(np.isfinite(prices) & (np.isfinite(low) | np.isfinite(high)))
        picked = sp.eye_array(knots * nw, format="csr")[at]
        columns = self.rows.k[:, None] * nw + np.append(np.arange(nw), nw + nx + np.arange(nu))
        starts = np.arange(len(columns) + 1) * (nw + nu)
        combined = sp.csr_array(
            (self.rows.G.ravel() * size[columns.ravel()], columns.ravel(), starts),
            (len(columns), knots * nw),
        )
        # Each soft limit has a slack s: w + s >= low, w - s <= high.
        limited = sp.vstack((picked, combined))
        least = np.concatenate((low[at], self.rows.low))
        largest = np.concatenate((high[at], self.rows.high))
        prices = np.concatenate((prices[at], np.full(len(columns), self.rows.soft)))
        low[at], high[at] = -np.inf, np.inf
        k, open_ = len(least), np.full(len(least), np.inf)
        slack = sp.eye_array(k)
        G = sp.vstack((sp.hstack((limited, slack)), sp.hstack((limited, -slack))), format="csc")
        of_G = np.concatenate((least, -open_)), np.concatenate((open_, largest))
        solver = piqp.SparseSolver()
        for name in ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"):
            setattr(solver.settings, name, _ACCURACY)
        solver.setup(
            sp.block_diag((*(H / cost), sp.csc_array((k, k))), format="csc"),
            np.concatenate((self.g.ravel() * size, prices)) / cost,
            sp.hstack((E, sp.csc_array((E.shape[0], k))), format="csc"),
            of_rows * np.concatenate((self.start, -self.c.ravel())),
            *((G, *of_G) if k else (None, None, None)),
            np.concatenate((low, np.zeros(k))),
            np.concatenate((high, open_)),
        )
        if solver.solve() != piqp.PIQP_SOLVED:
            return None
        found = solver.result
        w = (found.x[: len(size)] * size).reshape(knots, nw)
        y = (cost * of_rows * found.y).reshape(knots, nx)[1:]
        return StageSolution(w[:, :nx], np.clip(w, self.low, self.high)[:, nx:], y)
