"""Motions from one state to another within limits, of the least inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fflin.base.errors import InputError, listed
from fflin.base.names import chosen, input_keys
from fflin.base.validation import Array, number, whole
from fflin.control.saturation import saturation
from fflin.control.shooting import Point, Shooting
from fflin.control.stages import Rows
from fflin.control.weights import Weight, weight
from fflin.dynamics import points
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.state import StateMap
from fflin.linear.model import LinearModel
from fflin.linear.trajectory import Trajectory
from fflin.robot.limits import chosen_limits

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from fflin.robot.robot import Robot

# What may be missed of the goal in rad, m and s, between knots while it is sought, and at last.
_REACHED, _MEETS, _ENDS = 1e-6, 1e-7, 1e-9

# It is sought until an iteration would save less than this share of the effort, or so often.
_SAVED, _MOST, _MOST_FIRM, _MOST_TRIALS = 5e-3, 30, 10, 10

# What a step of wheels costs beside others, as they may take any.
_OF_WHEELS = 1e-6

# A step of this [rad, m] at every knot costs the whole effort to begin with; and so many times
# more costs what misses the goal.
_STEP, _FIRMLY = 0.3, 1e9


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
    r"""Plan a motion to a goal within limits: a slew from rest to rest, or the end of a tumble.

    Of all inputs that stay within their limits, and keep joints and wheels within theirs at the
    knots, those of a least :math:`\int u^T R\,u\;dt`: a local minimum, or as near to one as 30
    iterations come. Each solves the quadratic problem that the linear models along the motion make,
    with the start of each interval a variable of its own (multiple shooting), near enough to the
    knots for them to hold. The attitude may turn by any angle, and goes round where the rates at
    both ends have it so; continuous joints take the shorter way.

    Parameters
    ----------
    robot : Robot
    goal : LinearModel, (q, v) or array_like (nx,)
        Where it ends: the point of a model, a configuration and velocity in Pinocchio's order, of
        which None is neutral and rest, or a state of `StateMap` in frame "hybrid". Wheels may end
        at any angle.
    duration : float
        [s]
    x0, q0, v0 : array_like, optional
        Where it begins, as in `simulate`: a state, or a configuration and velocity; by default the
        robot's `start`.
    knots : int
        How many, equally far apart.
    hold : {"previous", "linear"}
        Whether inputs stay what they were at the knot before, or are linear between knots.
    limits : "urdf", float, mapping or list of them, optional
        As in `simulate`, and of states too; None for none but that thrusters do not pull.
    R : array_like (nu, nu) or (nu,), float, or mapping, optional
        Weight on the inputs as `lqr` takes it, diagonal; by default 1/limit^2, and 1 of inputs
        without one.
    free : sequence of str
        States that may end anywhere, by name, group or pattern: ``["r_b", "qdot_m.wheel_*"]``.

    Returns
    -------
    Trajectory
        A motion of the robot under its inputs, those on the base in and held in base axes.

    Raises
    ------
    InputError
        If an argument has a wrong size or value, or the goal is not reached within the limits:
        by how much it is missed.
    UnknownNameError
        If a name does not exist.

    References
    ----------
    H. G. Bock and K.-J. Plitt, A multiple shooting algorithm for direct solution of optimal
    control problems, IFAC World Congress, 1984.
    """
    state = StateMap(robot)
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
        raise InputError(f"free is {free!r}, expected a list of names of states")
    t, actuation = np.linspace(0.0, duration, knots), Actuation(state)
    shooting = Shooting(robot, t, hold == "previous")
    acting = chosen_limits(robot, limits)[0]
    low, high = saturation(robot, acting, start[0], float(t[1]), 0)[:2]
    if (low > high).any():
        raise InputError("limits leave an input nothing: its least is above its largest")
    if R is None:
        size = np.maximum(np.abs(low), np.abs(high))
        weights: Array = np.where(np.isfinite(size) & (size > 0.0), size, 1.0) ** -2.0
    else:
        matrix = weight("R", R, input_keys(actuation), definite=True)
        weights = matrix.diagonal()
        if (matrix != np.diag(weights)).any():
            raise InputError("R has entries off its diagonal; a plan takes a diagonal weight")
    names = state.names
    left = {*shooting.wheels, *chosen("state", free, names)}
    asked = np.array([i not in left for i in range(len(names))])
    rows = (np.tile(each, (knots, 1)) for each in (np.zeros_like(low), low, high))
    inputs = Rows(np.outer(shooting.shares, weights), *rows)
    bounds = np.array([acting.get(name, (-np.inf, np.inf)) for name in names]).T
    with np.errstate(all="ignore"):  # what leads nowhere may diverge, which the goal's miss says
        u = _sought(shooting, start, end, inputs, bounds, asked)
        q, v = shooting.flown(start, u)
        missed = np.abs(shooting.between((q[-1], v[-1]), end)) * asked
    if missed.max() <= _REACHED:
        if asked.all():
            q[-1], v[-1] = end  # at rest, rounding would be all that a check sees
        return Trajectory(robot, t, q, v, u, hold=hold)
    units = ["rad"] * 3 + [*state.units[3:]]
    worst = [i for i in np.argsort(-missed)[:3] if missed[i] > _REACHED]
    by = [f"{names[i]} by {missed[i]:.2g} {units[i]}" for i in worst]
    raise InputError(
        f"no motion within the limits was found that ends at the goal after {duration:g} s: it "
        f"misses {listed(by) if by else 'it by far'}; give it more time, larger limits, or in "
        "`free` what may end anywhere"
    )


class _Iterate(NamedTuple):
    """Knots and inputs, and what the intervals, and at last the goal, are missed by (N + 1, nx)."""

    q: Array
    v: Array
    u: Array
    missed: Array


def _sought(
    shooting: Shooting, start: Point, end: Point, inputs: Rows, bounds: Array, asked: Array
) -> Array:
    """Return the inputs (N + 1, nu) of the least effort that lead to the end, or nearest to it."""
    nx = len(asked)
    q, v, u = shooting.guess(start, end)
    u = np.clip(u, inputs.low, inputs.high)
    at = _Iterate(q, v, u, np.vstack((shooting.refine(q, v, u), np.zeros(nx))))
    begun = inputs.cost(u) / (len(q) * _STEP**2) or 1.0
    near, firm, single = begun, 0, False
    y: Array = np.zeros((len(q) - 1, nx))
    owed = np.zeros(nx)  # by the goal to the effort (augmented Lagrangian)
    slack = np.ones((len(q), nx))
    slack[:, [*shooting.wheels, *(nx // 2 + i for i in shooting.wheels)]] = _OF_WHEELS
    for count in range(_MOST + _MOST_FIRM):
        stages = shooting.stages(*at)
        room = _room(shooting.state, at, bounds)
        middle: Array = np.zeros((len(q), nx))
        middle[-1] = at.missed[-1] + owed
        share = 1.0  # of what is missed, that is to be closed
        for _ in range(_MOST_TRIALS):
            weights: Array = near * slack
            weights[-1, asked] = _FIRMLY * begun
            part = stages._replace(c=stages.c - (1.0 - share) * at.missed[:-1])
            u, z, y = part.least(inputs, Rows(weights, share * middle, *room), y)
            q, v = shooting.moved(at.q, at.v, z)
            goal = shooting.between((q[-1], v[-1]), end) * asked
            new = _Iterate(q, v, u, np.vstack((shooting.missed(q, v, u), goal)))
            # What the multipliers say that it costs to miss, and more than that.
            price = 1.5 * np.abs(np.vstack((y, y[-1])))
            was, now = (
                inputs.cost(x.u) + float((price * np.abs(x.missed)).sum()) for x in (at, new)
            )
            least = inputs.cost(u) + float(price[-1] @ np.abs((at.missed - z)[-1] * asked))
            least += (1.0 - share) * float((price * np.abs(at.missed)).sum())
            saved = was - least
            close = np.abs(new.missed).max() <= _MEETS and saved <= _SAVED * inputs.cost(u)
            if close or was - now > 0.1 * saved:
                break
            near, share = 4.0 * near, 0.5 * share
        else:
            break
        at, gained, owed = new, was - now > 0.7 * saved, (middle - z)[-1] * asked
        if not firm and saved > _SAVED * inputs.cost(u) and count < _MOST:
            near *= 0.1 if gained else 1.0
            continue
        near, firm = max(min(10.0 * near, 1e4 * begun), 100.0 * begun), firm + 1
        if single or np.abs(at.missed).max() <= _MEETS:
            # From here on the knots are those of one motion, along which small errors grow.
            single, (q, v) = True, shooting.flown(start, at.u)
            missed = np.zeros_like(at.missed)
            missed[-1] = shooting.between((q[-1], v[-1]), end) * asked
            at = _Iterate(q, v, at.u, missed)
            if np.abs(missed).max() <= _ENDS:
                break
        if firm > _MOST_FIRM:
            break
    return at.u if not shooting.held else np.vstack((at.u[:-1], at.u[-2]))


def _room(state: StateMap, at: _Iterate, bounds: Array) -> Array:
    """Return how far knots may move (2, N + 1, nx) for the joints to keep within their limits."""
    n, nx = state.robot.n, state.nx
    room = np.full((2, len(at.q), nx), np.inf) * [[[-1.0]], [[1.0]]]
    room[..., 6 : 6 + n] = bounds[:, None, 6 : 6 + n] - state.joint_positions(at.q)
    room[..., nx - n :] = bounds[:, None, nx - n :] - state.velocities(at.v)[:, 6:]
    room[:, 0] = 0.0
    return room
