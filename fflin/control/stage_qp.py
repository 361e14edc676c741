"""Quadratic programs over the stages of a linear motion, solved by PIQP."""

from typing import NamedTuple

import numpy as np

from fflin.base.errors import MissingPackageError
from fflin.base.validation import Array

# What may be left of the optimality conditions of the scaled problem, absolute and relative.
_ACCURACY = 1e-10


class StageSolution(NamedTuple):
    """The least cost's states and inputs, and the multipliers of the equations."""

    x: Array  # (N + 1, nx)
    u: Array  # (N + 1, nu)
    y: Array  # (N, nx), of A x + B u + D u[k + 1] + c - x[k + 1]


class StageQP(NamedTuple):
    r"""The least cost of w = (x, u) over N stages, every variable within bounds.

    .. math::
        \min \sum_{k=0}^N \tfrac12 w_k^T H_k w_k + g_k^T w_k + \mathrm{soft}_k^T s_k, \quad
        x_{k+1} = A_k x_k + B_k u_k + D_k u_{k+1} + c_k, \quad
        \mathrm{low}_k - s_k \le w_k \le \mathrm{high}_k + s_k, \quad s_k \ge 0
    """

    start: Array  # x[0] (nx,)
    A: Array  # (N, nx, nx)
    B: Array  # (N, nx, nu)
    D: Array  # (N, nx, nu), zero where inputs are held
    c: Array  # (N, nx)
    H: Array  # (N + 1, nx + nu, nx + nu), positive semidefinite
    g: Array  # (N + 1, nx + nu)
    low: Array  # (N + 1, nx + nu)
    high: Array
    soft: Array  # (N + 1, nx + nu)
    scale: Array  # (nx + nu,), sizes that variables may have, in shares of which it is solved

    def solve(self) -> StageSolution | None:
        """Return the solution; None where the hard bounds leave none, or it is not found."""
        import scipy.sparse as sp

        try:
            import piqp
        except ImportError:
            raise MissingPackageError(
                "this needs the solver PIQP; install it with: pip install 'fflin[mpc]'"
            ) from None
        (N, nx, _), (rows, nw) = self.B.shape, self.g.shape
        size, of_rows = np.tile(self.scale, rows), 1.0 / np.tile(self.scale[:nx], rows)
        none = sp.csc_array((N * nx, nw))
        ends = np.concatenate((np.tile(-np.eye(nx), (N, 1, 1)), self.D), axis=2)
        links = sp.hstack((sp.block_diag(np.concatenate((self.A, self.B), axis=2)), none))
        links = links + sp.hstack((none, sp.block_diag(ends)))
        first = sp.eye_array(nx, rows * nw)
        E = sp.diags_array(of_rows) @ sp.vstack((first, links)) @ sp.diags_array(size)
        H = self.scale[:, None] * self.H * self.scale
        cost = np.abs(H).max() or 1.0
        low, high = (each.ravel() / size for each in (self.low, self.high))
        prices = self.soft.ravel() * size
        at = np.flatnonzero(np.isfinite(prices) & (np.isfinite(low) | np.isfinite(high)))
        # What is soft has a slack s of its own: w + s >= low, w - s <= high.
        k, open_ = len(at), np.full(len(at), np.inf)
        picked, slack = sp.eye_array(rows * nw, format="csr")[at], sp.eye_array(k)
        G = sp.vstack((sp.hstack((picked, slack)), sp.hstack((picked, -slack))), format="csc")
        of_G = np.concatenate((low[at], -open_)), np.concatenate((open_, high[at]))
        low[at], high[at] = -np.inf, np.inf
        solver = piqp.SparseSolver()
        for name in ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"):
            setattr(solver.settings, name, _ACCURACY)
        solver.setup(
            sp.block_diag((*(H / cost), sp.csc_array((k, k))), format="csc"),
            np.concatenate((self.g.ravel() * size, prices[at])) / cost,
            sp.hstack((E, sp.csc_array((E.shape[0], k))), format="csc"),
            of_rows * np.concatenate((self.start, -self.c.ravel())),
            *((G, *of_G) if k else (None, None, None)),
            np.concatenate((low, np.zeros(k))),
            np.concatenate((high, open_)),
        )
        if solver.solve() != piqp.PIQP_SOLVED:
            return None
        found = solver.result
        w = (found.x[: len(size)] * size).reshape(rows, nw)
        y = (cost * of_rows * found.y).reshape(rows, nx)[1:]
        return StageSolution(w[:, :nx], np.clip(w, self.low, self.high)[:, nx:], y)
