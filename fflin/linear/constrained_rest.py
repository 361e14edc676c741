"""Fast linear models of constrained robots at rest on which no forces act.

At rest without forces, only B, the inertia and the map from the independent states to all states
depend on the configuration (18.7). One solution with the columns of J for the dependent coordinates
gives them. The general equations of `fflin.linear.constrained` remain for the first point, at which
the coordinates are chosen, and for points that are not clearly regular.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array, Indices, frozen
from fflin.dynamics.closure import CLOSED, Closure
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


class _Choice(NamedTuple):
    """Indices and scales that belong to one choice of independent coordinates."""

    columns: Indices  # (6 + n,) of J in Pinocchio's order: dependent, then picked
    place: Indices  # (6 + n,) of each coordinate in this order
    scale: Array  # (r, 6 + n) of the columns of J to comparable units
    unscale: Array  # (r, d) from the scaled solution to velocities
    right: Array  # (r, d + r) with an identity in the last columns
    identity: Array  # (d, d)
    halved: Array  # (6 + n, d) from the basis G to the positions in T, see (2.1)
    per_inertia: (
        Array  # (d,) inverse inertias of the picked coordinates of the free robot
    )
    diagonal: Indices  # (d,) of the flat M_r^-1 G^T (d, 6 + n): the diagonal of M_r^-1
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
        self._data = data
        self._solve, self._solve_inertia = dgesv, dposv
        self._choice: _Choice | None = None
        self.waits = True  # whether `choose` was not yet called
        self._centred: Array = pin.neutral(self._state.robot.model)

    def choose(self, kept: Indices, q: Array, fields: dict[str, Any]) -> None:
        """Prepare for the independent states with the indices `kept` (2 d,), chosen at q (nq,).

        `fields` are the fields of all models, with A and f0 in all states.
        """
        self.waits = False
        row_scale, column_scale = self._closure.scales(q)
        nv, d = len(column_scale), len(kept) // 2
        picked = kept[:d]
        dependent = np.setdiff1d(np.arange(nv), picked)
        r = len(dependent)
        if len(row_scale) != r or self._state.S is not None:
            # The general equations treat redundant rows, mimic joints and modes.
            return
        order = np.concatenate((dependent, picked))
        in_pinocchio = self._state.velocities(np.arange(float(nv)))
        N = np.ones(nv)
        N[ANGULAR] = 0.5
        self._choice = _Choice(
            columns=in_pinocchio[order].astype(np.intp),
            place=np.argsort(order),
            scale=np.outer(row_scale, column_scale[order]),
            unscale=-np.outer(column_scale[dependent], 1.0 / column_scale[picked]),
            right=np.eye(r, d + r, d),
            identity=np.eye(d),
            halved=np.outer(N, 1.0 / N[picked]),
            per_inertia=1.0 / self._inertia(q).diagonal()[picked],
            diagonal=picked + nv * np.arange(d),
            fields={
                **fields,
                "A": frozen(fields["A"][np.ix_(kept, kept)]),
                "f0": frozen(fields["f0"][kept]),
                "_computed": {
                    **fields["_computed"],
                    # The default outputs are all states.
                    "x0": partial(_independent_states, fields["_computed"]["y0"], kept),
                },
            },
        )

    def model(self, q: Array) -> LinearModel | None:
        """Return the model at q (nq,), or None if the general equations are needed there."""
        choice = self._choice
        if choice is None:
            return None
        residual, J = self._closure.constraints.residual_and_jacobian(q)
        if not residual.dot(residual) <= CLOSED**2:
            return None
        J = J.take(choice.columns, axis=1)
        J *= choice.scale
        r, nv = J.shape
        d = nv - r
        right = choice.right.copy()
        right[:, :d] = J[:, r:]
        # One solution gives the velocities of the dependent coordinates, and the inverse.
        _, _, solution, failed = self._solve(J[:, :r], right)
        every, inverse = J.ravel(), solution[:, d:].ravel("F")
        size = every.dot(every) * inverse.dot(inverse)
        if failed or not size < _REGULAR**2:
            return None
        G = np.concatenate((solution[:, :d] * choice.unscale, choice.identity))
        G = G.take(choice.place, axis=0)
        reduced = G.T.dot(self._inertia(q)).dot(G)
        _, by_force, failed = self._solve_inertia(reduced, G.T)
        inertia = reduced.diagonal()
        coupling = inertia.dot(by_force.take(choice.diagonal))
        comparable = inertia.dot(choice.per_inertia) < _COMPARABLE
        if failed or not comparable or not coupling < WARNING_COUPLING:
            return None
        if not self._actuation.default:
            columns = self._actuation.columns(self._data, self._centred)
            by_force = by_force.dot(columns)
        B = np.zeros((2 * d, by_force.shape[1]))
        B[d:] = by_force
        T = np.zeros((2 * nv, 2 * d))
        np.multiply(G, choice.halved, out=T[:nv, :d])
        T[nv:, d:] = G
        for array in (B, q, T):
            array.setflags(write=False)
        return LinearModel(
            choice.fields,
            B=B,
            q=q,
            C=T,
            _all_states=T,
            _inertia=partial(_frozen_inertia, reduced),
        )

    def _inertia(self, q: Array) -> Array:
        """Return M (6 + n, 6 + n) in base axes and state order."""
        self._centred[7:] = q[7:]
        M = pin.crba(self._state.robot.model, self._data, self._centred)
        return self._state.project(M.T)


def _independent_states(
    whole: Callable[[LinearModel], Array], kept: Indices, lin: LinearModel
) -> Array:
    """Return the independent states from the function `whole` of all states."""
    return frozen(whole(lin)[kept])


def _frozen_inertia(M: Array, _: LinearModel) -> Array:
    """Return M as a read-only array."""
    return frozen(M)
