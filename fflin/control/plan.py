"""Trajectory planning: low-effort motions between two states within limits."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fflin.base.errors import FflinWarning, InputError, listed
from fflin.base.names import chosen, input_keys
from fflin.base.validation import Array, number, whole
from fflin.control.saturation import saturation
from fflin.control.shooting import Point, Shooting
from fflin.control.stage_qp import StageQP, StageSolution
from fflin.control.weights import Weight, weight
from fflin.dynamics import points
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.names import refuse_orbit
from fflin.dynamics.state import StateMap
from fflin.linear.model import LinearModel
from fflin.linear.trajectory import Trajectory
from fflin.robot.limits import chosen_limits
from fflin.robot.robot import Robot

# What may be missed of the goal and of limits of states in rad, m and s; what is sought of it.
_REACHED, _ENDS = 1e-7, 1e-8

# Between knots limits are exceeded by no more than this share of them, looked at so many times an
# interval.
_BETWEEN, _PARTS = 0.01, 16

# So many plans are made to that end. Limits are tightened at the knots beside if each tightening
# leaves this share of what the last one left to exceed, and of the room between limits; if not,
# the intervals are halved.
_MOST_PLANS, _OF_LAST, _OF_ROOM = 8, 0.5, 0.5

# A plan that exceeds limits by more than this share of them is no start for the next one.
_FAR = 0.5

# Intervals are flown as one motion where they miss each other by no more.
_MEETS = 1e-10

# One motion that ends so near to the goal stays one.
_NEARLY = 1e-3

# How accurate the ends of intervals are in these while it is sought, and at last.
_SEEKS, _FLIES = 1e-6, 1e-8

# Iterations go on until one would save less than this share of the effort, or so often.
_SAVED, _MOST, _MOST_CLOSING, _MOST_HALVINGS = 1e-6, 50, 20, 10

# What a step of wheels costs beside others, as they may take any.
_OF_WHEELS = 1e-6

# What missing the goal or a limit by 1 rad or m costs, in efforts of the guess.
_PRICE = 1e3


def plan(
    robot: Robot,
    goal: LinearModel | tuple[ArrayLike | None, ArrayLike | None] | ArrayLike,
    duration: float,
    *,
    x0: ArrayLike | None = None,
    q0: ArrayLike | None = None,
    v0: ArrayLike | None = None,
    knots: int = 101,
    hold: str = "previous",
    limits: float | str | Mapping[str, Any] | Sequence[Any] | None = "urdf",
    R: Weight | None = None,
    free: Sequence[str] = (),
) -> Trajectory:
    r"""Plan a low-effort trajectory to a goal within limits, such as a slew or detumbling.

    The plan minimises :math:`\int u^T R\,u\;dt`. Inputs, joints and wheels stay within their
    limits. The method is multiple shooting: the start of each interval is a variable. Sequential
    quadratic programming searches for a local minimum in at most 50 iterations. The quadratic
    programs are built from the linear models along the motion and solved by PIQP
    (``pip install 'fflin[mpc]'``).

    The base may rotate by any angle. It makes whole turns if the angular rates at both ends require
    them. Continuous joints take the shorter direction.

    Limits of joints and wheels are met at the knots; between knots, they may be exceeded, by up to
    1 %. If the integrated motion exceeds a limit between knots, the limit is tightened at the
    neighbouring knots and the plan is repeated. If that does not help, these intervals are halved.
    If an excess of more than 1 % remains after 8 plans, a warning is issued. Printing the
    trajectory shows the largest excess, its limit and its time.

    Parameters
    ----------
    robot : Robot
    goal : LinearModel, (q, v) or array_like (nx,)
        End of the motion: the point of a model, a configuration and velocity in Pinocchio's
        order, or a state of `StateMap` in frame "hybrid". In (q, v), None means neutral or at
        rest. Wheels may end at any angle.
    duration : float
        Duration of the motion [s].
    x0, q0, v0 : array_like, optional
        Start of the motion, as in `simulate`: a state, or a configuration and velocity. By default
        the robot's `start`.
    knots : int
        Number of equally spaced knots; knots are added where limits need them.
    hold : {"previous", "linear"}
        Inputs between knots: held at the value of the previous knot, or linearly interpolated.
    limits : "urdf", float, mapping or list of them, optional
        Limits of inputs and states, as in `simulate`. With None there are no limits, except that
        thrusters cannot pull.
    R : array_like (nu, nu) or (nu,), float, or mapping, optional
        Diagonal weight on the inputs, as in `lqr`. By default 1/limit^2, or 1 for an input without
        a limit.
    free : sequence of str
        States whose end value is free, by name, group or pattern:
        ``["r_b", "qdot_m.wheel_*"]``.

    Returns
    -------
    Trajectory
        Planned motion and its inputs. Torques and forces on the base are in base axes, and are held
        in these axes between knots.

    Raises
    ------
    InputError
        If an argument has a wrong size or value, the start or goal is outside a limit, or no
        motion to the goal within the limits is found. The message states by how much the last
        trial misses the goal or exceeds a limit. A feasible motion may still exist.
    MissingPackageError
        If PIQP is not installed.
    UnknownNameError
        If a name does not exist.

    References
    ----------
    H. G. Bock and K.-J. Plitt, A multiple shooting algorithm for direct solution of optimal
    control problems, IFAC World Congress, 1984.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> goal = fflin.configuration(robot, {"joint_1": 0.3})
    >>> limits = {"tau_b": 6.0, "F_b": 3.5, "tau_m": 3.0}
    >>> motion = fflin.plan(robot, (goal, None), 20.0, knots=21, limits=limits)
    >>> bool(motion.residual.max() < 1e-5)
    True
    """
    state = StateMap(robot)
    refuse_orbit(robot, "plans")
    start = points.point_of(state, x0, q0, v0, partial(points.start_of, robot))
    ends: Any = (goal.q, goal.v) if isinstance(goal, LinearModel) else goal
    x, q, v = (None, *ends) if isinstance(ends, tuple) and len(ends) == 2 else (ends, None, None)
    end = points.point_of(state, x, q, v, lambda: (robot.neutral(), np.zeros(robot.nv)))
    knots, duration = whole("knots", knots, 3, 10_000), number("duration", duration)
    if not 1e-9 < duration < 1e9:
        raise InputError(f"duration is {duration:g} s, expected a positive time")
    if str(hold) not in ("linear", "previous"):
        raise InputError(f"hold is {hold!r}, expected 'linear' or 'previous'")
    listed_names = isinstance(free, list | tuple) and all(isinstance(name, str) for name in free)
    if not listed_names:
        raise InputError(f"free is {free!r}, expected a list of state names, such as ['r_b']")
    t, actuation = np.linspace(0.0, duration, knots), Actuation(state)
    shooting = Shooting(robot, t, hold == "previous")
    acting = chosen_limits(robot, limits)[0]
    low, high = saturation(robot, acting, start[0], float(t[1]), 0)[:2]
    if (low > high).any():
        raise InputError("the lower limit of an input is above its upper limit; correct limits=")
    if R is None:
        size = np.maximum(np.abs(low), np.abs(high))
        weights: Array = np.where(np.isfinite(size) & (size > 0.0), size, 1.0) ** -2.0
    else:
        matrix = weight("R", R, input_keys(actuation), definite=True)
        weights = matrix.diagonal()
        if (matrix != np.diag(weights)).any():
            raise InputError(
                "R has nonzero off-diagonal entries, expected a diagonal weight; give its diagonal"
            )
    left = {*shooting.wheels, *chosen("state", free, state.names)}
    asked = np.array([i not in left for i in range(state.nx)])
    bounds = np.array([acting.get(name, (-np.inf, np.inf)) for name in state.names]).T
    size = np.abs(np.where(np.isfinite(bounds), bounds, 0.0)).max(axis=0)
    size[size == 0.0] = 1.0
    for name, point, which in (("start", start, slice(None)), ("goal", end, asked)):
        _require_within(state, bounds, name, point, which)
    with np.errstate(all="ignore"):  # what leads nowhere may diverge, which is said
        sought = partial(_sought, start, end, weights, np.array((low, high)))
        made = _kept_between(shooting, start, end, sought, bounds, size, asked)
    missed, passed = made.missed, made.beyond[:, ::_PARTS].max(axis=(0, 1))
    if max(missed.max(), passed.max()) <= _REACHED:
        q, v, u = made.q, made.v, made.u
        if asked.all():
            q[-1], v[-1] = end  # at rest, rounding would be all that a check sees
        note = _note(made, size)
        if (made.beyond > _BETWEEN * size).any():
            warnings.warn(
                f"{note}; give more knots or a longer duration", FflinWarning, stacklevel=2
            )
        return Trajectory(robot, made.shooting.t, q, v, u, hold=hold, _note=note)
    units = ["rad"] * 3 + [*state.units[3:]]
    by = [
        f"{words} {state.names[i]} by {far[i]:.2g} {units[i]}"
        for words, far in (("misses", missed), ("exceeds the limit of", passed))
        for i in np.argsort(-far)[:3]
        if far[i] > _REACHED
    ]
    raise InputError(
        f"no motion within the limits was found that ends at the goal after {duration:g} s; the "
        f"last trial {listed(by) if by else 'diverges'}; give a longer duration, wider limits, "
        "more knots, or list states with a free end value in `free`"
    )


class _Made(NamedTuple):
    """A plan, and what it misses of the goal (nx,) and exceeds of limits (2, .., nx)."""

    shooting: Shooting
    q: Array
    v: Array
    u: Array
    fine: Point  # q and v at _PARTS rows an interval
    missed: Array
    beyond: Array


def _require_within(state: StateMap, bounds: Array, what: str, point: Point, which: Any) -> None:
    """Raise `InputError` if a point is outside the limits of some states."""
    values = _limited(state, point[0][None], point[1][None])[0]
    asked = np.zeros(state.nx, dtype=bool)
    asked[which] = True
    outside = [
        f"{state.names[i]} is {values[i]:.4g} {state.units[i]}, limit {limit:.4g} {state.units[i]}"
        for side, limits in zip((-1.0, 1.0), bounds, strict=True)
        for i, limit in enumerate(limits)
        if asked[i] and side * (values[i] - limit) > _REACHED
    ]
    if outside:
        raise InputError(f"the {what} is outside the limits: {listed(outside)}")


def _note(made: _Made, size: Array) -> str:
    """Say which limit of a state (nx,) the integrated motion exceeds most, by what and when."""
    shares = (made.beyond / size).max(axis=0)
    row, i = np.unravel_index(shares.argmax(), shares.shape)
    most = "exceeds no limit of a state"
    if shares[row, i] > 0.0:
        shooting, (k, part) = made.shooting, divmod(int(row), _PARTS)
        at = shooting.t[k] + (part / _PARTS * shooting.h[k] if part else 0.0)
        percent = f"{100.0 * shares[row, i]:.2g} %"
        most = f"exceeds the limit of {shooting.state.names[i]} by {percent} at t = {at:.4g} s"
    return f"the integrated motion {most}, checked at {_PARTS} points per interval"


def _kept_between(
    shooting: Shooting,
    start: Point,
    end: Point,
    sought: Callable[..., Array],
    bounds: Array,
    size: Array,
    asked: Array,
) -> _Made:
    """Return of all plans that reach the goal the one that exceeds limits by the least."""
    best, known, least, last = None, None, np.inf, np.inf
    within = whole = _at_knots(bounds, shooting)
    for _ in range(_MOST_PLANS):
        u = sought(shooting, partial(_room, shooting, end, within, asked), known)
        made = _flown(shooting, start, end, u, bounds, asked)
        most, reached = float((made.beyond / size).max()), made.missed.max() <= _REACHED
        if best is None or (reached and most < least):
            best, least = made, most
        if least <= _BETWEEN or (within is whole and not reached):
            break
        tighter = _tighter(within, made.beyond)
        enough = (tighter[1] - tighter[0] >= _OF_ROOM * (bounds[1] - bounds[0])).all()
        if reached:
            latest = made
        if reached and enough and most <= _OF_LAST * last:
            known, last, within = made[1:4], most, tighter
        else:
            shooting, known = _halved(latest, size)
            known = known if most <= _FAR else None
            within = whole = _at_knots(bounds, shooting)
            last = np.inf
    assert best is not None
    return best


def _at_knots(bounds: Array, shooting: Shooting) -> Array:
    return np.repeat(bounds[:, None], len(shooting.t), axis=1)


def _flown(
    shooting: Shooting, start: Point, end: Point, u: Array, bounds: Array, asked: Array
) -> _Made:
    """Return what inputs make of the start."""
    fine = shooting.flown(start, u, _PARTS)
    q, v = (each[::_PARTS] for each in fine)
    missed = np.abs(shooting.between((q[-1], v[-1]), end)) * asked
    return _Made(shooting, q, v, u, fine, missed, _beyond(shooting.state, bounds, *fine))


def _halved(made: _Made, size: Array) -> tuple[Shooting, tuple[Array, Array, Array]]:
    """Return a plan with a knot in the middle of intervals that exceed a limit, and beside."""
    shares = (made.beyond / size).max(axis=(0, 2))[1:].reshape(-1, _PARTS).max(axis=1)
    far = np.pad(shares > _BETWEEN, 1)
    at = np.flatnonzero(far[:-2] | far[1:-1] | far[2:])
    middle = made.u[at] if made.shooting.held else 0.5 * (made.u[at] + made.u[at + 1])
    rows = np.arange(len(made.u)) * _PARTS
    rows = np.insert(rows, at + 1, rows[at] + _PARTS // 2)
    q, v = (each[rows] for each in made.fine)
    return made.shooting.halved(at), (q, v, np.insert(made.u, at + 1, middle, axis=0))


def _sought(
    start: Point,
    end: Point,
    R: Array,
    limits: Array,
    shooting: Shooting,
    room: Callable[[Array, Array], Array],
    known: tuple[Array, Array, Array] | None,
) -> Array:
    """Return the inputs (N + 1, nu) of the least effort that lead to the end, or nearest to it.

    The search begins at the knots and inputs that are `known`, if any.
    """
    # The Hessian is Gauss and Newton's, to which steps of the states add a cost that falls where
    # whole steps succeed (Levenberg and Marquardt).
    q, v, u = known or shooting.guess(start, end)
    cost, u = _shares(shooting, R, u), np.clip(u, *limits)
    shooting.refine(q, v, u, _SEEKS)
    wheels = [*shooting.wheels, *(shooting.state.nx // 2 + i for i in shooting.wheels)]
    near = np.where(np.isin(range(shooting.state.nx), wheels), _OF_WHEELS, 1.0) / len(q)
    search = _Search(shooting, limits, room, cost, near)
    missed = shooting.missed(q, v, u)
    price = 0.0 * missed

    def merit(u: Array, missed: Array, excess: Array) -> float:
        lost = (price * np.abs(missed)).sum() + _PRICE * excess.sum()
        return float((cost * u * u).sum() / 2.0 + lost)

    for _ in range(_MOST):
        excess = _excess(space := room(q, v))
        least = search.step(q, v, u, missed, near, cost * u)
        if least is None:
            return search.acting(u)
        z, du, y = least
        # What the multipliers say that it costs to miss (Powell).
        price = np.maximum(np.abs(y), 0.5 * (price + np.abs(y)))
        was, share = merit(u, missed, excess), 1.0
        saved = was - merit(u + du, 0.0 * missed, _excess(space - z))
        for _ in range(_MOST_HALVINGS):
            new, there = np.clip(u + share * du, *limits), shooting.moved(q, v, share * z)
            after = shooting.missed(*there, new)
            if was - merit(new, after, _excess(room(*there))) >= 1e-4 * share * saved:
                (q, v), u, missed = there, new, after
                break
            share *= 0.5
        near = near * (0.2 if share == 1.0 else 1.0 if share > 0.25 else 3.0)
        if saved <= _SAVED * was:
            break
    return search.acting(search.closed(start, q, v, u))


class _Search(NamedTuple):
    """Constant data of a search for a plan."""

    shooting: Shooting
    limits: Array  # least and largest inputs (2, nu)
    room: Callable[[Array, Array], Array]
    cost: Array  # of the squares of inputs (N + 1, nu)
    near: Array  # what steps of the states cost at first (nx,)

    def step(
        self, q: Array, v: Array, u: Array, missed: Array, near: Array, effort: Array
    ) -> StageSolution | None:
        """Return the best step of all knots and inputs; None if no step is found."""
        space, nx = self.room(q, v), self.shooting.state.nx
        if not max(_excess(space).max(), np.abs(missed).max()) < np.inf:
            return None
        try:
            A, B, D = self.shooting.slopes(q, v, u)
        except InputError:  # it has diverged
            return None
        low, high = np.concatenate((space, self.limits[:, None] - u), axis=2)
        weights = np.hstack((np.tile(near, (len(u), 1)), self.cost))
        H, of_x = weights[:, :, None] * np.eye(weights.shape[1]), np.zeros((len(u), nx))
        g, soft = np.hstack((of_x, effort)), np.hstack((of_x + _PRICE, np.full(u.shape, np.inf)))
        scale = np.concatenate((np.ones(nx), self.cost.sum(axis=0) ** -0.5))
        return StageQP(np.zeros(nx), A, B, D, missed, H, g, low, high, soft, scale).solve()

    def closed(self, start: Point, q: Array, v: Array, u: Array) -> Array:
        """Return the inputs that lead to the end in one motion, by the least changes."""
        shooting = self.shooting
        shooting.refine(q, v, u, _FLIES)
        missed = shooting.missed(q, v, u)
        for _ in range(_MOST_CLOSING):
            if np.abs(missed).max() <= _MEETS:
                (q, v), missed = shooting.flown(start, u), 0.0 * missed
            size = max(_excess(self.room(q, v)).max(), np.abs(missed).max())
            if size <= _ENDS and not missed.any():
                break
            least = self.step(q, v, u, missed, self.near, 0.0 * u)
            if least is None:
                break
            u = np.clip(u + least.u, *self.limits)
            if missed.any() or size > _NEARLY:
                q, v = shooting.moved(q, v, least.x)
                missed = shooting.missed(q, v, u)
        return u

    def acting(self, u: Array) -> Array:
        """Return the inputs; if held, the last row repeats the input of the last interval."""
        return np.vstack((u[:-1], u[-2])) if self.shooting.held else u


def _shares(shooting: Shooting, R: Array, u: Array) -> Array:
    """Return the cost of squared inputs (N + 1, nu), scaled so that the guess costs 1."""
    h = shooting.h
    # Of the knots in an integral: by the trapezoidal rule, or as long as each input is held.
    held = np.append(h, h[-1]) if shooting.held else 0.5 * (np.append(h, 0.0) + np.append(0.0, h))
    cost = held[:, None] * R
    cost /= (cost * u * u).sum() or cost.sum()
    return cost


def _room(shooting: Shooting, end: Point, bounds: Array, asked: Array, q: Array, v: Array) -> Array:
    """Return how far knots may move (2, N + 1, nx) within the limits of the joints, to the end."""
    state = shooting.state
    room = bounds - _limited(state, q, v)
    room[0, 0], room[1, 0] = -np.inf, np.inf
    way = shooting.between((q[-1], v[-1]), end)
    room[:, -1, asked] = np.clip(way, *room[:, -1])[asked]
    return room


def _limited(state: StateMap, q: Array, v: Array) -> Array:
    """Return the limited values (N, nx): positions and rates of joints, zero for the base."""
    n, values = state.robot.n, np.zeros((len(q), state.nx))
    values[:, 6 : 6 + n] = state.joint_positions(q)
    values[:, state.nx - n :] = state.velocities(v)[:, 6:]
    return values


def _beyond(state: StateMap, bounds: Array, q: Array, v: Array) -> Array:
    """Return how far rows are below and above limits (2, N, nx)."""
    values = _limited(state, q, v)
    return np.maximum(np.array((bounds[0] - values, values - bounds[1])), 0.0)


def _tighter(within: Array, beyond: Array) -> Array:
    """Return limits of knots (2, N + 1, nx), tighter beside intervals with rows beyond them."""
    # The last knot is the goal's.
    inside = beyond[:, 1:].reshape(2, within.shape[1] - 1, _PARTS, -1).max(axis=2)
    beside = np.maximum(inside[:, :-1], inside[:, 1:])
    tighter = within.copy()
    tighter[0, 1:-1] += beside[0]
    tighter[1, 1:-1] -= beside[1]
    return tighter


def _excess(room: Array) -> Array:
    """Return how far knots are outside of it (N + 1, nx)."""
    return np.maximum(np.maximum(room[0], -room[1]), 0.0)
