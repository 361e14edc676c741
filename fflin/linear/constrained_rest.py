"""Fast linear models of constrained robots at rest on which no forces act.

At rest without forces, only B, the inertia and the map from the independent states to all states
depend on the configuration (18.7). One solution with the columns of J for the dependent coordinates
gives them. The general equations of `fflin.linear.constrained` remain for the first point, at which
the coordinates are chosen, and for points that are not clearly regular.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array, Indices, frozen
from fflin.dynamics.closure import CLOSED, Closure
from fflin.dynamics.constraints import Hold, hold_of
from fflin.dynamics.coordinates import ANGULAR
from fflin.dynamics.rnea import WARNING_COUPLING
from fflin.dynamics.state import Actuation
from fflin.linear.model import LinearModel

# Largest product of the norms of J and of the inverse of its dependent columns, in comparable
# units. Below it, the rank is clear. The corresponding limit of `Closure.tangent` is 1e6.
_REGULAR = 1e4

# Largest sum, over the independent coordinates, of the ratio between the inertia in the constrained
# robot and in the free robot. The corresponding limit of `Reducer` is 1e10.
_COMPARABLE = 1e8

# The inertia M, with the axes of all joints in `data.J`
_crba, _WORLD = pin.crba, pin.Convention.WORLD


class _Choice(NamedTuple):
    """Indices and scales that belong to one choice of independent coordinates.

    In the order of `columns`, the coordinates are first dependent, then independent.
    """

    columns: Indices  # (6 + n,) of Pinocchio's v
    of_inertia: Indices  # (6 + n, 6 + n) of M in Pinocchio's order, flat
    place: Indices  # (6 + n,) of each coordinate of the state
    # (6 + n, r) of the columns of J to comparable units; zero where a velocity moves no frame
    scale: Array
    system: Array  # (6 + n + r, r) with an identity at its end
    unscale: Array  # (d, r) from the scaled solution to velocities
    basis: Array  # (d (6 + n) + 1,) a flat G^T (d, 6 + n) of the independent part, and a zero
    entries: Indices  # (12 + 2 n, 2 d) of each entry of T in `basis`
    halved: Array  # (12 + 2 n, 2 d) from the entries of the basis to T, see (2.1)
    per_inertia: (
        Array  # (d,) inverse inertias of the independent coordinates of the free robot
    )
    fields: dict[str, Any]  # of all models


class RestSolver:
    """Models of one constrained robot at rest without forces, relative to the base at each point.

    `choose` must be called once, after the independent coordinates were chosen.
    """

    def __init__(self, closure: Closure, actuation: Actuation, data: pin.Data) -> None:
        from scipy.linalg.lapack import dgesv, dposv

        self._closure = closure
        self._state = closure.state
        self._actuation = actuation
        self._model = closure.state.robot.model
        self._data = data
        # A view of an array that Pinocchio overwrites in place
        self._joint_axes = data.J.T
        self._solve, self._solve_inertia = dgesv, dposv
        self._choice: _Choice | None = None
        self._holds: list[Hold] = []
        self._rows = np.empty((closure.constraints.count, 6))
        self.waits = True  # whether `choose` was not yet called
        self._centred: Array = pin.neutral(self._model)

    def choose(self, kept: Indices, q: Array, fields: dict[str, Any]) -> None:
        """Prepare for the independent states with the indices `kept` (2 d,), chosen at q (nq,).

        `fields` are the fields of all models, with A and f0 in all states.
        """
        self.waits = False
        constraints = self._closure.constraints
        row_scale, column_scale = self._closure.scales(q)
        nv, d = len(column_scale), len(kept) // 2
        picked = kept[:d]
        dependent = np.setdiff1d(np.arange(nv), picked)
        r = len(dependent)
        if len(row_scale) != r or self._state.S is not None:
            # The general equations treat redundant rows, mimic joints and modes.
            return
        self._holds = [
            hold_of(pair, self._data, self._rows) for pair in constraints.pairs
        ]
        order = np.concatenate((dependent, picked))
        place = np.argsort(order)
        in_pinocchio = self._state.velocities(np.arange(float(nv)))
        columns = in_pinocchio[order].astype(np.intp)
        scale = np.outer(column_scale[order], row_scale)
        scale *= constraints.signs[:, columns].T
        system = np.zeros((nv + r, r))
        system[nv:] = np.eye(r)
        basis = np.zeros(d * nv + 1)
        basis[:-1].reshape(d, nv)[:, r:] = np.eye(d)
        N = np.ones(nv)
        N[ANGULAR] = 0.5
        halved = np.ones((2 * nv, 2 * d))
        halved[:nv, :d] = np.outer(N, 1.0 / N[picked])
        zero = d * nv
        entries = np.full((2 * nv, 2 * d), zero)
        entries[:nv, :d] = place[:, None] + nv * np.arange(d)
        entries[nv:, d:] = entries[:nv, :d]
        M = self._inertia(q, columns[:, None] * nv + columns)
        self._choice = _Choice(
            columns=columns,
            of_inertia=columns[:, None] * nv + columns,
            place=place,
            scale=scale,
            system=system,
            unscale=-np.outer(1.0 / column_scale[picked], column_scale[dependent]),
            basis=basis,
            entries=entries,
            halved=halved,
            per_inertia=1.0 / M.diagonal()[r:],
            fields={
                **{key: value for key, value in fields.items() if key != "C"},
                "A": frozen(fields["A"][np.ix_(kept, kept)]),
                "f0": frozen(fields["f0"][kept]),
                "_computed": {
                    **fields["_computed"],
                    # The default outputs are all states.
                    "C": _all_states,
                    "x0": partial(_independent_outputs, kept),
                },
            },
        )

    def model(self, q: Array) -> LinearModel | None:
        """Return the model at q (nq,), or None if the general equations are needed there."""
        choice = self._choice
        if choice is None:
            return None
        M = self._inertia(q, choice.of_inertia)
        for hold in self._holds:
            if not hold.write(q, CLOSED):
                return None
        system = choice.system.copy()
        d, r = choice.unscale.shape
        nv = d + r
        axes = self._joint_axes.take(choice.columns, axis=0)
        np.multiply(axes.dot(self._rows.T), choice.scale, out=system[:nv])
        every = system.ravel()
        size = every.dot(every) - r
        # One solution gives the velocities of the dependent coordinates, and the inverse. Each
        # array is a transposed matrix, which LAPACK overwrites in place.
        failed = self._solve(
            system[:r].T, system[r:].T, overwrite_a=True, overwrite_b=True
        )[3]
        inverse = every[nv * r :]
        if failed or not size * inverse.dot(inverse) < _REGULAR**2:
            return None
        basis = choice.basis.copy()
        G_transposed = basis[:-1].reshape(d, nv)
        np.multiply(system[r:nv], choice.unscale, out=G_transposed[:, :r])
        reduced = G_transposed.dot(M).dot(G_transposed.T)
        _, by_force, failed = self._solve_inertia(reduced, G_transposed)
        inertia = reduced.diagonal()
        coupling = inertia.dot(by_force.diagonal(r))
        comparable = inertia.dot(choice.per_inertia) < _COMPARABLE
        if failed or not comparable or not coupling < WARNING_COUPLING:
            return None
        by_force = by_force.T.take(choice.place, axis=0).T
        if not self._actuation.default:
            columns = self._actuation.columns(self._data, self._centred)
            by_force = by_force.dot(columns)
        B = np.zeros((2 * d, by_force.shape[1]))
        B[d:] = by_force
        T = basis.take(choice.entries)
        T *= choice.halved
        B.setflags(write=False)
        q.setflags(write=False)
        T.setflags(write=False)
        return LinearModel(
            choice.fields,
            B=B,
            q=q,
            _all_states=T,
            _inertia=partial(_frozen_inertia, reduced),
        )

    def _inertia(self, q: Array, entries: Indices) -> Array:
        """Return entries of M, flat in Pinocchio's order; compute the axes of the joints too."""
        centred = self._centred
        centred[7:] = q[7:]
        M: Array = _crba(self._model, self._data, centred, _WORLD)
        return M.take(entries)


def _all_states(lin: LinearModel) -> Array:
    """Return the map from the independent states to all states."""
    assert lin._all_states is not None
    return lin._all_states


def _independent_outputs(kept: Indices, lin: LinearModel) -> Array:
    """Return the independent states of a model whose outputs are all states."""
    return frozen(lin.y0[kept])


def _frozen_inertia(M: Array, _: LinearModel) -> Array:
    """Return M as a read-only array."""
    return frozen(M)
