"""Configurations on the manifold of a robot's constraints, and the tangent space of the manifold.

Displacements and velocities are in state order (angular, linear, joints), in base axes.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple, overload

import numpy as np
import pinocchio as pin

from fflin.base.errors import ConstraintError, FflinWarning, InputError, listed
from fflin.base.validation import Array, ArrayLike, Indices, instance
from fflin.dynamics.constraints import Constraints
from fflin.dynamics.state import StateMap
from fflin.robot.fields import travel_of
from fflin.robot.robot import Robot

# A configuration whose residual is at most _SILENT is closed without a warning. If its residual
# exceeds NEAR, it is refused. Both are in m and rad.
_SILENT, NEAR = 1e-9, 1e-6

# Newton's method: residual [m, rad] at which q counts as closed from the start, step at which the
# iteration ends, and largest residual at its end per metre of distance from the world's origin.
CLOSED, _ARRIVED, _LEFT = 1e-13, 1e-11, 1e-11

# Relative singular values of J, with rows and columns in comparable units. Values above _REGULAR
# count for the rank, and values below _ZERO are rounding errors. A value between them means that
# the rank changes nearby.
_REGULAR, _ZERO = 1e-6, 1e-10
# Least size of J in units of equal inertia: if J is smaller, nothing moves the constrained frames.
_LEAST = 1e-3

# Largest product of the norms of J and of the inverse of its dependent columns, in comparable
# units, at which a point is clearly regular.
_CLEAR = 300.0

# Velocity of the rows, relative to the norms of J and nu, that is only a rounding error: `closed`
# leaves up to 7e-15.
_EXACT = 1e-14

# A rank is constant nearby if no motion on the manifold accelerates redundant rows by more than
# this fraction of the motion's own accelerations.
_CONSTANT = 1e-7

_NONE: Indices = np.zeros(0, dtype=np.intp)

# Newton's method: largest number of steps, and largest step [rad] of a rotation.
_STEPS, _LONGEST = 100, 0.5


class TangentSpace(NamedTuple):
    """Tangent space of the manifold at a configuration: J nu = 0.

    The rank r of J may be less than its number of rows. `selected` combines the rows to r
    independent rows, J_r = `selected` J.
    """

    rank: int
    jacobian: Array  # J (rows, 6 + n)
    selected: Array  # (r, rows)
    basis: Array  # basis (6 + n, d) of the velocities with J nu = 0
    inverse: Array  # (6 + n, r): a matrix with J_r `inverse` = E
    redundant: Array  # (rows - r, rows): combinations of rows of J that are zero
    row_scale: Array  # (rows,) that converts angular rows to metres
    # Whether the rows of `basis` for the coordinates of `Closure.partition` are an identity
    partitioned: bool = False

    @property
    def rows(self) -> Array:
        """Independent rows J_r (r, 6 + n) of the constraints."""
        return self.selected @ self.jacobian


class _Partition:
    """Independent and dependent coordinates of regular constraints, and scales of J."""

    def __init__(
        self, dependent: Indices, picked: Indices, row_scale: Array, column_scale: Array
    ) -> None:
        r, d = len(dependent), len(picked)
        self.order = np.concatenate((dependent, picked))
        self.place = np.argsort(self.order)
        self.row_scale = row_scale
        self.scale = np.outer(row_scale, column_scale)  # of J to comparable units
        # from the scaled solution to velocities, and from comparable units to the inverse
        unscale = -np.outer(column_scale[dependent], 1.0 / column_scale[picked])
        columns = np.outer(column_scale[dependent], np.ones(r))
        self.unscale = np.concatenate((unscale, columns), axis=1)
        self.selected = np.diag(row_scale)
        self.rows, self.free = np.eye(r), np.eye(d)
        self.zeros = np.zeros((d, r))
        self.redundant = np.zeros((0, r))


class Closure:
    """Constraints of a robot in the coordinates of its state."""

    def __init__(self, state: StateMap) -> None:
        self.state = state
        self.constraints = Constraints(state.robot)
        self._model = state.robot.model
        self._data = state.robot.create_data()
        from scipy.linalg.lapack import dgesv

        self._solve = dgesv
        self._partition: _Partition | None = None
        # Jacobian at the last closed configuration of `configuration`
        self._jacobian: tuple[Array, Array] | None = None
        # Last configuration and its tangent space, which several functions need
        self._last: tuple[Array, TangentSpace] | None = None

    def configuration(self, q: Array) -> Array:
        """Return the closed configuration at q (nq,); raise an error if q is more than 1e-6 off."""
        self.constraints.settle(q)
        residual, jacobian = self.constraints.residual_and_jacobian(q)
        if np.abs(residual).max() <= CLOSED:
            self._jacobian = q, jacobian
            return q
        distance, text = self.distance(q)
        if not distance <= NEAR:
            raise ConstraintError(
                f"q is off {text}; close it with fflin.closed(robot, q), or give the constraint "
                "another placement"
            )
        if distance > _SILENT:
            warnings.warn(
                f"q is off {text}; it was replaced by the nearest closed configuration",
                FflinWarning,
                stacklevel=4,
            )
        return self.nearest(q)

    def velocity(self, q: Array, v: Array) -> Array:
        """Return the velocity (nv,) on the manifold at v; raise an error if v is far from it."""
        if not v.any():
            return v
        nu = self.state.velocities(v)
        space = self.tangent(q)
        J = space.jacobian
        rate = J @ nu
        if rate.dot(rate) <= _EXACT**2 * np.vdot(J, J) * nu.dot(nu):
            return v
        kept = self.kept(space, q, nu)
        scale = 1.0 / np.sqrt(self._inertia(q).diagonal())
        apart = float(np.linalg.norm((nu - kept) / scale))
        speed = float(np.linalg.norm(nu / scale))
        if apart <= NEAR * speed:
            return self.state.spread(kept)
        title = self._title(int(np.argmax(np.abs(rate * space.row_scale))))
        raise ConstraintError(
            f"v violates constraint '{title}', whose frames would move apart at "
            f"{np.abs(rate).max():.3g} m/s or rad/s; give fflin.closed(robot, q, v)[1]"
        )

    def kept(self, space: TangentSpace, q: Array, nu: Array) -> Array:
        """Return the velocity on the manifold that is nearest to nu in kinetic energy."""
        M = self._inertia(q)
        G = space.basis
        kept: Array = G @ np.linalg.solve(G.T @ M @ G, G.T @ (M @ nu))
        return kept

    def after_impact(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the velocity (nv,) just after the constraints close at a closed q, and impulses.

        v (nv,) is the velocity just before. The impulses (rows,) of the constraints are the
        smallest ones if the constraints are redundant.
        """
        space = self.tangent(q)
        nu = self.state.velocities(v)
        kept = self.kept(space, q, nu)
        change = self._inertia(q) @ (kept - nu)
        impulses = np.linalg.lstsq(space.jacobian.T, change, None)[0]
        return self.state.spread(kept), impulses

    def distance(self, q: Array) -> tuple[float, str]:
        """Return the largest residual at q, and the text that names its constraint."""
        residual = np.abs(self.constraints.residual(q))
        index = int(np.argmax(residual))
        angular = any(
            pair.rows.start <= index < pair.rows.stop
            and pair.selected[index - pair.rows.start, 3:].any()
            for pair in self.constraints.pairs
        )
        unit = "rad" if angular else "m"
        text = f"constraint '{self._title(index)}' by {residual[index]:.3g} {unit}"
        return float(residual[index]), text

    def _title(self, index: int) -> str:
        """Return the name of the constraint with this row."""
        pairs = self.constraints.pairs
        pair = next(x for x in pairs if x.rows.start <= index < x.rows.stop)
        return pair.constraint.title

    def nearest(self, q: Array, kept: Indices = _NONE) -> Array:
        """Return the closed configuration nearest to q (nq,), within the joint limits.

        The coordinates with the indices `kept` do not change.
        """
        low, high = self._travel(q)
        start, at = q, q
        fixed = np.zeros(6 + self.state.robot.n, dtype=bool)
        fixed[kept] = True
        size = np.sqrt(self._inertia(q).diagonal())
        row_scale, _ = self.scales(q)
        for _ in range(_STEPS):
            residual = self.constraints.residual(at)
            if np.abs(residual).max() <= CLOSED:
                return at
            columns = np.where(fixed, 0.0, 1.0 / size)
            J = self.state.columns(self.constraints.jacobian(at))
            scaled = row_scale[:, None] * J * columns
            back = self.state.velocities(pin.difference(self._model, at, start))
            left = row_scale * (residual + J @ np.where(fixed, 0.0, back))
            step = np.where(fixed, 0.0, back) - columns * (
                np.linalg.pinv(scaled, rcond=_ZERO) @ left
            )
            longest = float(np.abs(step).max())
            if longest > _LONGEST:
                step *= _LONGEST / longest
            ahead = pin.integrate(self._model, at, self.state.spread(step))
            positions = self.state.joint_positions(ahead)
            beyond = (positions < low) | (positions > high)
            if beyond.any():
                ahead = ahead.copy()
                for index in np.flatnonzero(beyond).tolist():
                    value = float(np.clip(positions[index], low[index], high[index]))
                    self.state.robot.joints[index].place(ahead, value)
                self.state.robot.follow(ahead)
                fixed[6:] |= beyond
            at = ahead
            if longest < _ARRIVED:
                break
        distance, text = self.distance(at)
        # The residual is a difference of positions, whose rounding errors are relative to them.
        reach = 1.0 + float(np.abs(at[:3]).max())
        if distance <= _LEFT * reach:
            return at
        raise ConstraintError(
            f"no closed configuration was found near q: the nearest one is off {text}; give a q "
            "that is nearer to a closed one, and check joint limits and placements"
        )

    def _travel(self, q: Array) -> tuple[Array, Array]:
        """Return the joint limits (n,), extended to the positions at q if these are outside."""
        robot = self.state.robot
        limits = [travel_of(robot.model, joint) for joint in robot.joints]
        low, high = np.array(limits).reshape(-1, 2).T
        positions = self.state.joint_positions(q)
        return np.minimum(low, positions), np.maximum(high, positions)

    def _inertia(self, q: Array) -> Array:
        return self.state.project(pin.crba(self._model, self._data, q).T)

    def scales(self, q: Array) -> tuple[Array, Array]:
        """Return the scales of the rows (rows,) and columns (6 + n,) of J to comparable units.

        The scale of a row is 1 for lengths, and the radius of gyration for angles. In the scaled
        columns, all coordinates have the inertia of the whole robot.
        """
        inertia = self._inertia(q).diagonal()
        mass = float(inertia[3:6].mean())
        radius = float(np.sqrt(inertia[:3].mean() / mass))
        rows = np.where(self.constraints.angular, radius, 1.0)
        return rows, np.sqrt(mass / inertia)

    def partition(self, picked: Indices, q: Array) -> None:
        """Prepare for the independent coordinates `picked` (d,), chosen at q (nq,).

        At points that are clearly regular, `tangent` then needs no singular values.
        """
        row_scale, column_scale = self.scales(q)
        dependent = np.setdiff1d(np.arange(len(column_scale)), picked)
        if len(dependent) == len(row_scale):
            self._partition = _Partition(dependent, picked, row_scale, column_scale)
            self._last = None

    def tangent(self, q: Array) -> TangentSpace:
        """Return the tangent space at a closed q (nq,); raise an error for a singular posture."""
        if self._last is not None and (self._last[0] == q).all():
            return self._last[1]
        space = self._regular(q)
        if space is None:
            space = self._general(q)
        self._last = q.copy(), space
        return space

    def _regular(self, q: Array) -> TangentSpace | None:
        """Return the tangent space from a partition, or None if q is not clearly regular."""
        part = self._partition
        if part is None:
            return None
        if self._jacobian is not None and self._jacobian[0] is q:
            J = self.state.columns(self._jacobian[1])
        else:
            J = self.state.columns(self.constraints.jacobian(q))
        scaled = (J * part.scale).take(part.order, axis=1)
        r = len(J)
        _, _, solved, failed = self._solve(
            scaled[:, :r], np.concatenate((scaled[:, r:], part.rows), axis=1)
        )
        d = solved.shape[1] - r
        inverse = solved[:, d:]
        size = np.vdot(scaled, scaled) * np.vdot(inverse, inverse)
        if failed or not size < _CLEAR**2:
            return None
        solved *= part.unscale
        basis = np.concatenate((solved[:, :d], part.free))
        right = np.concatenate((inverse, part.zeros))
        return TangentSpace(
            rank=r,
            jacobian=J,
            selected=part.selected,
            basis=basis.take(part.place, axis=0),
            inverse=right.take(part.place, axis=0),
            redundant=part.redundant,
            row_scale=part.row_scale,
            partitioned=True,
        )

    def _general(self, q: Array) -> TangentSpace:
        J = self.state.columns(self.constraints.jacobian(q))
        row_scale, columns = self.scales(q)
        U, sizes, Vt = np.linalg.svd(row_scale[:, None] * J * columns)
        relative = sizes / max(sizes[0], _LEAST)
        rank = int(np.count_nonzero(relative > _REGULAR))
        if rank < len(relative) and relative[rank] > _ZERO:
            raise self._singular(relative[rank])
        if not rank:
            titles = listed(item.title for item in self.constraints.items)
            raise ConstraintError(
                f"constraints {titles} have no effect, because no motion of "
                f"'{self.state.robot.name}' moves their frames relative to each other; remove them"
            )
        space = TangentSpace(
            rank=rank,
            jacobian=J,
            selected=(U[:, :rank] / sizes[:rank]).T * row_scale,
            basis=columns[:, None] * Vt[rank:].T,
            inverse=columns[:, None] * Vt[:rank].T,
            redundant=U[:, rank:].T * row_scale,
            row_scale=row_scale,
        )
        self._require_constant_rank(space, q)
        return space

    def _require_constant_rank(self, space: TangentSpace, q: Array) -> None:
        """Raise an error if the rank of J changes along a motion on the manifold.

        At a constant rank, every velocity on the manifold has accelerations on the manifold: the
        redundant combinations of rows have no bias gamma.
        """
        if not len(space.redundant):
            return
        rng = np.random.default_rng(0)
        for _ in range(3):
            nu = space.basis @ rng.normal(size=space.basis.shape[1])
            gamma = self.constraints.bias(q, self.state.spread(nu))
            size = float(np.linalg.norm(space.row_scale * gamma))
            rate = float(np.abs(space.redundant @ gamma).max(initial=0.0))
            if rate > _CONSTANT * max(size, float(nu @ nu)):
                raise self._singular(rate)

    def _singular(self, size: float) -> ConstraintError:
        return ConstraintError(
            f"'{self.state.robot.name}' is at a singular posture: the rank of its constraints "
            f"changes nearby (measure {size:.1e}), so that no linear model holds there; give "
            "another configuration"
        )


def closure_of(state: StateMap) -> Closure | None:
    """Return the closure of a robot's constraints, or None if it has none."""
    return Closure(state) if state.robot.constraints else None


def closed_point(robot: Robot, q: Array, v: Array | None) -> tuple[Array, Array | None]:
    """Return the closed point nearest to q and v, and warn if q was off a constraint.

    Commands call it, because their point is given by single joints and not as a whole.
    """
    closure = Closure(StateMap(robot))
    closure.constraints.settle(q)
    distance, text = closure.distance(q)
    if distance > NEAR:
        warnings.warn(
            f"the point is off {text}; the nearest closed configuration is used instead",
            FflinWarning,
            stacklevel=2,
        )
    if v is None:
        return closure.nearest(q), None
    q, v = closed(robot, q, v)
    return q, v


class Redundancy(NamedTuple):
    """Numbers of rows and independent rows of a robot's constraints, and what they leave free."""

    rows: int
    rank: int
    free: int  # number of velocities that the constraints permit
    # names of the constraints that the others imply, at least in part
    redundant: tuple[str, ...]

    def __str__(self) -> str:
        text = (
            f"{self.rows} rows of rank {self.rank}, {self.free} velocities remain free"
        )
        if self.redundant:
            text += (
                f"; {self.rows - self.rank} redundant rows in {', '.join(self.redundant)}: forces "
                "there may depend on internal stresses"
            )
        return text


def redundancy(robot: Robot, q: Array) -> Redundancy:
    """Return the rank and the redundancy of the constraints of a robot at a closed q (nq,)."""
    closure = Closure(StateMap(robot))
    closure.constraints.settle(q)
    space = closure.tangent(q)
    titles = [
        pair.constraint.title
        for pair in closure.constraints.pairs
        if np.abs(space.redundant[:, pair.rows] / space.row_scale[pair.rows]).max(
            initial=0.0
        )
        > _CONSTANT
    ]
    return Redundancy(
        rows=closure.constraints.count,
        rank=space.rank,
        free=space.basis.shape[1],
        redundant=tuple(titles),
    )


@overload
def closed(robot: Robot, q: ArrayLike, v: None = None) -> Array: ...


@overload
def closed(robot: Robot, q: ArrayLike, v: ArrayLike) -> tuple[Array, Array]: ...


def closed(
    robot: Robot, q: ArrayLike, v: ArrayLike | None = None
) -> Array | tuple[Array, Array]:
    """Return the configuration nearest to q at which all constraints of the robot are closed.

    Newton's method finds the nearest configuration, in displacements weighted by the inertia of
    each coordinate. Joints stay within their position limits, unless they are outside at q.

    Parameters
    ----------
    robot : Robot
        Robot with `constraints`. Constraints without a placement store the pose of their frames at
        q, which is then closed.
    q : array_like (nq,)
        Configuration in Pinocchio's order, see `configuration`.
    v : array_like (nv,), optional
        Velocity in Pinocchio's order.

    Returns
    -------
    ndarray (nq,) or tuple of ndarray (nq,), (nv,)
        The closed configuration. If `v` is given, also the velocity that the constraints permit
        and that is nearest to v in kinetic energy.

    Raises
    ------
    ConstraintError
        If no closed configuration is found; the message names the constraint and the distance that
        is left.
    InputError
        If an argument has a wrong size or value.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", constraints=[fflin.Spherical("hand")])
    >>> q = fflin.closed(robot, robot.neutral())  # stores the position of the hand
    >>> bent = fflin.configuration(robot, {"joint_2": 0.4})
    >>> q = fflin.closed(robot, bent)
    >>> bool(abs(q[:3]).max() > 0.01)  # the base has moved
    True
    """
    instance("robot", robot, Robot, "a fflin.Robot")
    state = StateMap(robot)
    q = robot.checked_configuration(q)
    if v is not None:
        v = robot.checked_velocity(v)
    closure = closure_of(state)
    if closure is None:
        raise InputError(
            f"'{robot.name}' has no constraints; give it some with robot.replace(constraints=[...])"
        )
    closure.constraints.settle(q)
    nearest = closure.nearest(q)
    if v is None:
        return nearest
    nu = closure.kept(closure.tangent(nearest), nearest, state.velocities(v))
    return nearest, state.spread(nu)
