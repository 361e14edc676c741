"""Linear models of robots with constraints, in the coordinates of the motions that remain.

With a basis G of the velocities that the constraints permit, the tangent of the state manifold in
base axes is xi = G z1, dnu = G z2 + Y z1. Z maps these displacements to the coordinates of chart
and frame, where P picks d independent coordinates, the same for positions and rates. See (18.5) and
(18.6) of docs/derivation.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import ConstraintError, InputError, listed
from fflin.base.names import matching
from fflin.base.rotation import skew
from fflin.base.validation import Array, Indices, frozen
from fflin.dynamics.closure import Closure
from fflin.dynamics.contact import Contact
from fflin.dynamics.coordinates import ANGULAR, LINEAR, Chart
from fflin.dynamics.state import StateMap
from fflin.linear.model import LinearModel
from fflin.robot.constraints import checked_independent

# Coordinates are independent if the smallest singular value of their rows of the basis, in units of
# equal kinetic energy, is at least _INDEPENDENT.
_INDEPENDENT = 1e-5

# Sum, over the independent coordinates, of the ratio between the inertia in the constrained robot
# and in the free robot. Below it, no singular value is less than `_INDEPENDENT`.
_COMPARABLE = 0.1 / _INDEPENDENT**2

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
    """Motions of unit kinetic energy that the constraints permit at a moving reference."""

    positions: Array  # (6 + n, d)
    rates: Array  # (6 + n, d)
    lower: Array  # (6 + n, d) rates per displacement of the positions
    size: Array  # (6 + n,) square root of the inertia of each coordinate

    @classmethod
    def at(cls, closure: Closure, q: Array, v: Array) -> Motions:
        """Return the motions at a closed point."""
        state = closure.state
        M = state.project(pin.crba(state.robot.model, state.robot.create_data(), q).T)
        space = closure.tangent(q)
        G = space.basis
        G = G @ np.linalg.inv(np.linalg.cholesky(G.T @ M @ G)).T
        positions = G.copy()
        positions[ANGULAR] *= 0.5
        lower = np.zeros_like(G)
        if v.any():
            slopes = closure.constraints.derivatives(q, v, np.zeros_like(v))
            turning = space.selected @ state.columns(slopes.twist_by_q)
            lower = -np.linalg.pinv(space.rows) @ turning @ G
        return cls(positions, G, lower, np.sqrt(M.diagonal()))

    def best(self) -> Indices:
        """Return the indices (d,) of the coordinates that determine the motion best."""
        return _best(self.size, self.rates)

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


def _best(size: Array, rates: Array) -> Indices:
    """Return the indices of the coordinates that determine motions of unit kinetic energy best.

    `rates` (6 + n, d) are the rates of the motions, and `size` (6 + n,) is the square root of the
    inertia of each coordinate.
    """
    from scipy.linalg import qr

    order = 1.0 - _LESS * np.arange(len(size))
    pivots = qr(((order * size)[:, None] * rates).T, mode="r", pivoting=True)[1]
    best: Indices = np.sort(pivots[: rates.shape[1]])
    return best


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
        self._names: dict[str, tuple[str, ...]] = {}
        # Indices of the independent states, and the inverses of the rows of their positions and
        # rates in a tangent space with a partition, for a base at the reference
        self._kept: Indices = np.zeros(0, dtype=np.intp)
        self._first: Array = np.zeros((0, 0))
        self._second: Array = np.zeros((0, 0))
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
        if not self._names:
            state, picked = self._state, self._picked
            assert picked is not None
            kept = [*picked, *(picked + state.nx // 2)]
            self._names = _state_names(state, kept)
        return self._names

    def reduction(
        self, chart: Chart, q: Array, nu: Array, contact: Contact
    ) -> Reduction:
        """Return the reduction at a point; `nu` is the velocity in state order."""
        state = self._state
        M = state.project(pin.crba(state.robot.model, self._data, q).T)
        space = contact.space
        G = space.basis
        positions, rates = self._coordinates(chart, G)
        size = self._size(chart, M)
        inertia = G.T.dot(M).dot(G)
        if self._picked is None:
            self._choose(size, rates, inertia)
            assert self._picked is not None
            self.closure.partition(self._picked, q)
            self._prepare()
        picked = self._picked
        if len(picked) != G.shape[1]:
            raise ConstraintError(
                f"{G.shape[1]} coordinates are independent at this point, but {len(picked)} were "
                "chosen at the first point; linearise the points separately"
            )
        first, second = self._first, self._second
        regular = space.partitioned and (self._moving or chart.at_reference)
        by_energy = inertia.diagonal() / size.take(picked) ** 2
        if not regular or not by_energy.sum() < 0.25 * _COMPARABLE:
            first, second = self._inverses(size, positions, rates, inertia)
        nv, d = len(M), len(picked)
        T = np.zeros((2 * nv, 2 * d))
        T[:nv, :d] = positions.dot(first)
        T[nv:, d:] = rates.dot(second)
        if nu.any():
            lower = self._mixed(chart, nu, G)
            turning = contact.twist_by_q.dot(G)
            lower -= self._coordinates(chart, space.inverse.dot(turning))[1]
            lower -= T[nv:, d:].dot(lower.take(picked, axis=0))
            T[nv:, :d] = lower.dot(first)
        if not regular:
            T[self._kept] = np.eye(2 * d)
        reduced = second.T.dot(inertia).dot(second)
        return Reduction(self._kept, T, 0.5 * (reduced + reduced.T))

    def _prepare(self) -> None:
        """Compute what depends only on the choice of the independent coordinates."""
        picked, nv = self._picked, self._state.nx // 2
        assert picked is not None
        self._kept = np.concatenate((picked, picked + nv))
        N = np.ones(nv)
        N[ANGULAR] = 0.5
        self._first, self._second = np.diag(1.0 / N[picked]), np.eye(len(picked))

    def _coordinates(self, chart: Chart, basis: Array) -> tuple[Array, Array]:
        """Return positions and rates of displacements in base axes: the products with Z."""
        positions, rates = basis.copy(), basis.copy()
        if self._moving or chart.at_reference:
            positions[ANGULAR] *= 0.5
            return positions, rates
        positions[ANGULAR] = chart.N @ basis[ANGULAR]
        positions[LINEAR] = chart.R @ basis[LINEAR]
        for part in self._state.in_reference:
            rates[part] = chart.R @ basis[part]
        return positions, rates

    def _mixed(self, chart: Chart, nu: Array, basis: Array) -> Array:
        """Return the changes of the rates in the frame by rotations of the base."""
        mixed = np.zeros_like(basis)
        if self._moving:
            return mixed
        for part in self._state.in_reference:
            turned = skew(nu[part]).dot(basis[ANGULAR])
            if not chart.at_reference:
                turned = chart.R @ turned
            mixed[part] -= turned
        return mixed

    def _size(self, chart: Chart, M: Array) -> Array:
        """Return the square root (6 + n,) of the inertia of each coordinate."""
        inertia = M.diagonal().copy()
        if not (self._moving or chart.at_reference):
            for part in self._state.in_reference:
                inertia[part] = (chart.R @ M[part, part] @ chart.R.T).diagonal()
        size: Array = np.sqrt(inertia)
        return size

    def _choose(self, size: Array, rates: Array, inertia: Array) -> None:
        """Choose the independent coordinates from the rates of a basis with an inertia."""
        count = len(inertia)
        if self.given is not None:
            self._picked = self._named(count)
            return
        unit = rates @ np.linalg.inv(np.linalg.cholesky(inertia)).T
        self._picked = _best(size, unit)

    def _inverses(
        self, size: Array, positions: Array, rates: Array, inertia: Array
    ) -> tuple[Array, Array]:
        """Return the inverses (d, d) of the rows of the independent positions and rates."""
        picked = self._picked
        assert picked is not None
        scale = size.take(picked)
        inverses = []
        for motions in (positions, rates):
            rows = motions.take(picked, axis=0)
            try:
                inverse = np.linalg.inv(rows)
            except np.linalg.LinAlgError:
                raise self._dependent(picked) from None
            # The singular values are of the motions of unit kinetic energy.
            by_energy = (inverse * inertia.dot(inverse)).sum(axis=0)
            if not (by_energy / scale**2).sum() < _COMPARABLE:
                factor = np.linalg.cholesky(inertia)
                unit = scale[:, None] * rows @ np.linalg.inv(factor).T
                if np.linalg.svd(unit)[1][-1] < _INDEPENDENT:
                    raise self._dependent(picked)
            inverses.append(inverse)
        return inverses[0], inverses[1]

    def _dependent(self, picked: Indices) -> ConstraintError:
        names = listed(self._state.names[i] for i in picked)
        return ConstraintError(
            f"the coordinates {names} do not determine the motion at this point; give other "
            "coordinates with independent="
        )

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


def independent_states(
    whole: Callable[[LinearModel], Array], kept: Indices, lin: LinearModel
) -> Array:
    """Return the independent states from the function `whole` of all states."""
    return frozen(whole(lin)[kept])


def reduced_fields(
    reduction: Reduction, arrays: dict[str, Array], C: Array | None
) -> dict[str, Any]:
    """Return the arrays of a model in the independent states from the arrays in all states.

    C is None if the outputs are all states.
    """
    kept, T = reduction.kept, reduction.T
    reduced = {
        "A": arrays["A"].take(kept, axis=0).dot(T),
        "B": arrays["B"].take(kept, axis=0),
        "C": T if C is None else C.dot(T),
        "_all_states": T,
    }
    for key in ("f0", "drift"):
        if key in arrays:
            reduced[key] = arrays[key].take(kept)
    return {key: frozen(array) for key, array in reduced.items()}


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
