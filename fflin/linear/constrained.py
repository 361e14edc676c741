"""Linear models of robots with constraints, in the coordinates of the motions that remain.

With a basis G of the velocities that the constraints permit, the tangent of the state manifold in
base axes is xi = G z1, dnu = G z2 + Y z1. Z maps these displacements to the coordinates of chart
and frame, where P picks d independent coordinates, the same for positions and rates. See (18.5) and
(18.6) of docs/derivation.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import ConstraintError, InputError, listed
from fflin.base.names import matching
from fflin.base.rotation import skew
from fflin.base.validation import Array, Indices, frozen
from fflin.dynamics.closure import Closure, TangentSpace
from fflin.dynamics.coordinates import ANGULAR, LINEAR, Chart
from fflin.dynamics.state import StateMap
from fflin.linear.model import LinearModel
from fflin.robot.constraints import checked_independent

# Coordinates are independent if the smallest singular value of their rows of the basis, in units of
# equal kinetic energy, is at least _INDEPENDENT.
_INDEPENDENT = 1e-5

# Each coordinate counts a little less than the one before it, so that rounding errors do not decide
# between two coordinates of equal weight.
_LESS = 1e-6


@dataclass(frozen=True)
class Reduction:
    """Map between all states and the independent states at a point.

    Attributes
    ----------
    kept : ndarray (2 d,) of int
        Indices of the independent states: positions, then rates.
    T : ndarray (12 + 2 n, 2 d)
        Map T_c from deviations of the independent states to deviations of all states.
    M : ndarray (d, d)
        Inertia of the independent coordinates.
    """

    kept: Indices
    T: Array
    M: Array


class Motions(NamedTuple):
    """Motions of unit kinetic energy that the constraints permit, in the coordinates of Z."""

    positions: Array  # (6 + n, d)
    rates: Array  # (6 + n, d)
    lower: Array  # (6 + n, d) rates per displacement of the positions
    size: Array  # (6 + n,) square root of the inertia of each coordinate

    def best(self) -> Indices:
        """Return the indices (d,) of the coordinates that determine the motion best."""
        from scipy.linalg import qr

        weighted = self.size[:, None] * self.rates
        order = 1.0 - _LESS * np.arange(len(self.size))
        pivots = qr((order[:, None] * weighted).T, mode="r", pivoting=True)[1]
        best: Indices = np.sort(pivots[: self.rates.shape[1]])
        return best

    def least(self, picked: Indices) -> float:
        """Return how well coordinates determine the motion, from 0 to 1."""
        if not len(picked):
            return 1.0
        parts = self.size[picked, None] * np.array(
            (self.rates[picked], self.positions[picked])
        )
        return float(np.linalg.svd(parts)[1].min())

    def reduction(self, picked: Indices) -> Reduction:
        """Return the reduction to the coordinates with given indices."""
        nv, d = self.rates.shape
        first = np.linalg.inv(self.positions[picked])
        second = np.linalg.inv(self.rates[picked])
        lower = (self.lower - self.rates @ second @ self.lower[picked]) @ first
        T = np.zeros((2 * nv, 2 * d))
        T[:nv, :d], T[nv:, :d] = self.positions @ first, lower
        T[nv:, d:] = self.rates @ second
        kept = np.concatenate((picked, picked + nv))
        T[kept] = np.eye(2 * d)
        return Reduction(kept, T, second.T @ second)


class Reducer:
    """Choice of independent coordinates of one robot, and reduction of its models to them.

    The choice is made at the first point, or given, and is the same at all points.
    """

    def __init__(
        self, closure: Closure, independent: Sequence[str] | None, *, moving: bool
    ) -> None:
        self.closure = closure
        self.given: tuple[str, ...] | None = closure.state.robot.independent or None
        if independent is not None:
            self.given = checked_independent(independent)
        self._state = closure.state
        self._moving = moving
        self._picked: Indices | None = None
        self._data = closure.state.robot.create_data()

    @property
    def independent(self) -> tuple[str, ...] | None:
        """Names of the independent coordinates, or None if they are not yet chosen."""
        if self._picked is None:
            return self.given
        return tuple(self._state.names[index] for index in self._picked)

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """Names and units of the independent states, and names of the others, once chosen."""
        state, picked = self._state, self._picked
        assert picked is not None
        kept = [*picked, *(picked + state.nx // 2)]
        return _state_names(state, kept)

    def reduction(
        self, chart: Chart, q: Array, v: Array, nu: Array, space: TangentSpace
    ) -> Reduction:
        """Return the reduction at a point; `nu` is v in state order."""
        return self.of_motions(self.motions(chart, q, v, nu, space))

    def of_motions(self, motions: Motions) -> Reduction:
        """Return the reduction at a point from the motions that the constraints permit there."""
        return motions.reduction(self._independent(motions))

    def motions(
        self, chart: Chart, q: Array, v: Array, nu: Array, space: TangentSpace
    ) -> Motions:
        """Return the motions at a point that the constraints permit."""
        state = self._state
        M = state.project(pin.crba(state.robot.model, self._data, q).T)
        G = space.basis
        G = G @ np.linalg.inv(np.linalg.cholesky(G.T @ M @ G)).T
        by_position, by_rate, mixed = self._coordinates(chart, nu)
        Y = np.zeros_like(G)
        if v.any():
            Y = -self._turning(space, q, v) @ G
        in_frame = by_rate @ M @ by_rate.T
        return Motions(
            positions=by_position @ G,
            rates=by_rate @ G,
            lower=mixed @ G + by_rate @ Y,
            size=np.sqrt(in_frame.diagonal()),
        )

    def _coordinates(self, chart: Chart, nu: Array) -> tuple[Array, Array, Array]:
        """Return the blocks of Z: of positions, of rates, and of rates by positions."""
        state = self._state
        nv = len(nu)
        by_position, by_rate = np.eye(nv), np.eye(nv)
        mixed = np.zeros((nv, nv))
        if self._moving:
            by_position[ANGULAR, ANGULAR] *= 0.5
            return by_position, by_rate, mixed
        by_position[ANGULAR, ANGULAR] = chart.N
        by_position[LINEAR, LINEAR] = chart.R
        for part in state.in_reference:
            by_rate[part, part] = chart.R
            mixed[part, ANGULAR] = -chart.R @ skew(nu[part])
        return by_position, by_rate, mixed

    def _turning(self, space: TangentSpace, q: Array, v: Array) -> Array:
        """Return J^+ K_q: minus the change of nu on the manifold per displacement of q."""
        derivatives = self.closure.constraints.derivatives(q, v, np.zeros_like(v))
        by_q = self._state.columns(derivatives.twist_by_q)
        solved: Array = np.linalg.pinv(space.rows) @ space.selected @ by_q
        return solved

    def _independent(self, motions: Motions) -> Indices:
        """Return the indices (d,) of the independent coordinates."""
        count = motions.rates.shape[1]
        if self._picked is None and self.given is None:
            self._picked = motions.best()
        elif self._picked is None:
            self._picked = self._named(count)
        picked = self._picked
        if len(picked) != count:
            raise ConstraintError(
                f"{count} coordinates are independent at this point, but {len(picked)} were chosen "
                "at the first point; linearise the points separately"
            )
        if motions.least(picked) < _INDEPENDENT:
            names = listed(self._state.names[i] for i in picked)
            raise ConstraintError(
                f"the coordinates {names} do not determine the motion at this point; give other "
                "coordinates with independent="
            )
        return picked

    def _named(self, count: int) -> Indices:
        """Return the indices of the coordinates that the user named."""
        state = self._state
        names = state.names[: state.nx // 2]
        picked: list[int] = []
        for key in self.given or ():
            picked += matching("coordinate", key, names)
        if len(set(picked)) != count:
            raise InputError(
                f"independent names {len(set(picked))} coordinates, expected {count}: the "
                f"constraints leave {count} of {len(names)} free"
            )
        return np.array(sorted(set(picked)), dtype=np.intp)


def reduced_fields(
    state: StateMap, reduction: Reduction, whole: LinearModel
) -> dict[str, Any]:
    """Return the fields of a model in the independent states from the model in all states."""
    kept, T = reduction.kept, reduction.T
    arrays = {
        "A": whole.A[kept] @ T,
        "B": whole.B[kept],
        "C": whole.C @ T,
        "f0": whole.f0[kept],
        "x0": whole.x0[kept],
        "y0": whole.y0,
        "placement": whole.placement,
        "_all_states": T,
    }
    if whole.drift is not None:
        arrays["drift"] = whole.drift[kept]
    return {
        **{key: frozen(array) for key, array in arrays.items()},
        **_state_names(state, kept),
    }


def _state_names(
    state: StateMap, kept: Sequence[int] | Indices
) -> dict[str, tuple[str, ...]]:
    """Return the names of states that are in the model and of states that are not."""
    names = [state.names[i] for i in kept]
    chosen = set(names)
    return {
        "state_names": tuple(names),
        "state_units": tuple(state.units[i] for i in kept),
        "dependent": tuple(name for name in state.names if name not in chosen),
    }
