"""Trajectory planning: low-effort motions between two states within limits."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from fflin.base.errors import FflinWarning, InputError, listed, located
from fflin.base.names import chosen, group_of, input_keys
from fflin.base.process import Progress
from fflin.base.tables import counted
from fflin.base.validation import Array, ArrayLike, Mask, number, whole
from fflin.control.optimal.controlled_ends import controlled_ends
from fflin.control.optimal.initial_guess import JointMotion, initial_guess
from fflin.control.optimal.plan_search import Search, excess
from fflin.control.optimal.shooting import Point, Shooting, passive_springs
from fflin.control.weights import Weight, weight
from fflin.dynamics import points
from fflin.dynamics.closure import closure_of
from fflin.dynamics.coordinates import refuse_orbit
from fflin.dynamics.state import Actuation, StateMap
from fflin.linear.model import LinearModel
from fflin.linear.optimality import STATIONARY, Optimality
from fflin.linear.trajectory import Trajectory
from fflin.robot.fields import chosen_limits, input_limits
from fflin.robot.inputs import JointTorque, ReactionWheel, has_magnetorquers
from fflin.robot.robot import Robot

# Largest permitted error at the goal, and largest permitted violation of a state limit at a knot
# [rad, m, s].
_REACHED = 1e-7

# A warning is given if the motion exceeds a limit by more than _BETWEEN times the limit. The motion
# is checked at the ends of _PARTS equal parts of each interval.
_BETWEEN, _PARTS = 0.01, 16

# A warning is given if deflections that no input controls end farther from the goal than this
# fraction of the largest deflection of the motion.
_VIBRATES = 0.05

_UNKNOWN = (
    "its KKT residuals are unknown, because the last quadratic program cannot be solved"
)


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
    limits: float | str | Mapping[str, object] | Sequence[object] | None = "urdf",
    R: Weight | None = None,
    free: Sequence[str] = (),
    guess: Trajectory | JointMotion | None = None,
    progress: bool | None = None,
) -> Trajectory:
    r"""Plan a low-effort trajectory to a goal within limits, such as a slew or detumbling.

    The plan minimises :math:`\int u^T R\,u\;dt`. Inputs, joints and wheels stay within their
    limits. The method is multiple shooting: the state at the start of each interval is an
    optimisation variable. Sequential quadratic programming searches for a local minimum in at most
    100 iterations. The search ends earlier at a stationary point, or if the violation of the goal
    and the limits at the knots is above 0.01 and does not fall by a tenth in ten iterations. The
    quadratic programs are built from the linear models along the motion and solved by PIQP (``pip
    install 'fflin[mpc]'``). Second-order corrections allow long steps.

    ``motion.optimality`` contains the residuals of the Karush-Kuhn-Tucker conditions at the plan,
    and `print` shows them. If the plan is not stationary, a warning states how large the gradient
    of the effort still is, relative to the gradient without the goal and the limits.

    If the robot has constraints, start and goal must be closed, see `closed`. The search uses
    independent coordinates at each knot, and each knot of the plan is closed. States in `free` may
    still follow from the other states.

    Springs without motors, such as modes of flexible appendages, end at the goal if the inputs
    excite them. Of two equal wings, torques on the base excite only the symmetric or only the
    antisymmetric mode. Printing the trajectory names the modes that are not prescribed for this
    reason, and their final deflection. A warning is issued if it exceeds 5 % of the largest
    deflection.

    In orbit, the motion is relative to the orbital frame with the axes ``lvlh``, also at its ends:
    a robot at rest rotates with the orbit. The plan includes the gravity gradient and the rotation
    of this frame. It begins at t = 0, which defines the position in an elliptic orbit. Plans in
    orbit need about three to five times the computing time.

    The base may rotate by any angle, including full turns if the angular rates at both ends require
    them. Continuous joints take the shorter direction.

    Limits of joints and wheels are satisfied at the knots, and may be exceeded by up to 1 % between
    knots. If the motion between knots exceeds a limit, the quadratic program includes this limit at
    points within the interval. If limits cannot be satisfied between knots, they are satisfied at
    the knots only, and a warning is issued. Printing the trajectory shows the largest violation,
    the limit that is violated and the time, and the inputs and states nearest to their limits.

    Parameters
    ----------
    robot : Robot
    goal : LinearModel, (q, v) or array_like (nx,)
        End of the motion: the operating point of a model, a configuration and velocity in
        Pinocchio's order, or a state of `StateMap` in the default frame. In (q, v), q=None means
        the neutral configuration, and v=None means rest. Wheels may end at any angle and, with
        v=None, at any speed, which the momentum determines. If `free` contains omega_b, they end at
        rest.
    duration : float
        Duration of the motion [s].
    x0, q0, v0 : array_like, optional
        Start of the motion, as in `simulate`: a state, or a configuration and velocity. The default
        is the robot's `start`.
    knots : int
        Number of equally spaced knots.
    hold : {"previous", "linear"}
        Inputs between knots: held at the value of the previous knot, or linearly interpolated.
    limits : "urdf", float, mapping or list of them, optional
        Limits of inputs and states, as in `simulate`. With None, the only limit is that thrusters
        cannot pull.
    R : array_like (nu, nu) or (nu,), float, or mapping, optional
        Diagonal weight on the inputs, as in `lqr`. The default weight of an input is 1/limit^2, or
        1 if the input has no limit.
    free : sequence of str
        States whose end value is free, by name, group or pattern:
        ``["r_b", "qdot_m.wheel_*"]``.
    guess : Trajectory or callable, optional
        Motion at which the search begins: a trajectory, whose time is scaled to the duration, or a
        function ``guess(t)`` of the time t [s] from 0 to the duration. The function returns the
        joint positions (n,) [rad or m] in the order of ``robot.joint_names``, or a mapping {joint
        or pattern: position}; joints that it does not name move on a cubic curve from the start to
        the goal. Continuous joints may have angles beyond pi. If the inputs are torques between
        bodies of the robot, the base moves as the conserved momentum requires. Otherwise the base
        moves on the cubic curve.

        By default, the search begins at a cubic curve from the start to the goal. If all inputs are
        joint torques, the system is nonholonomic, and the base reaches most attitudes only if the
        joints move in loops. Then the search begins at loops of the joints that rotate the base to
        the attitude of the goal. The loops stay within the limits of the joints if possible. If the
        robot has constraints, the search always begins at the cubic curve, closed at the knots.
    progress : bool, optional
        Whether to show the iteration, the cost relative to the initial guess, and the largest
        violation on stderr. By default, they are shown for long runs if stderr is a terminal.

    Returns
    -------
    Trajectory
        Planned motion and its inputs. Torques and forces on the base are in base axes. If `hold` is
        "previous", they are constant in these axes between knots.

    Raises
    ------
    InputError
        If an argument has a wrong size or value, the start or goal is outside a limit, or no motion
        to the goal within the limits is found. The message states by how much the last trial misses
        the goal or exceeds a limit. A feasible motion may exist even if none is found.
    ConstraintError
        If the start or the goal violates a constraint of the robot, or the motion at which the
        search begins cannot be closed.
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
    >>> robot = fflin.load("planar_detumble", lock=["joint_2", "joint_3"])
    >>> goal = fflin.configuration(robot, {"joint_1": 0.3})
    >>> limits = {"tau_b": 6.0, "F_b": 3.5, "tau_m": 3.0}
    >>> motion = fflin.plan(robot, (goal, None), 20.0, knots=11, limits=limits)
    >>> bool(motion.residual.max() < 1e-5), motion.optimality.stationarity < 0.01
    (True, True)
    """
    state = StateMap(robot)
    if robot.constraints:
        refuse_orbit(robot, "plans of robots with constraints")
    if has_magnetorquers(robot.inputs):
        raise InputError(
            f"'{robot.name}' has magnetorquers, whose torque depends on the attitude, and plans do "
            "not support this; give other inputs with robot.replace(inputs=[...])"
        )
    start = points.point_of(state, x0, q0, v0, partial(points.start_of, robot))
    start, end = _on_constraints(state, start, _goal_point(state, goal))
    knots, duration = whole("knots", knots, 3, 10_000), number("duration", duration)
    if not 1e-9 < duration < 1e9:
        raise InputError(f"duration is {duration:g} s, expected a positive time")
    if str(hold) not in ("linear", "previous"):
        raise InputError(f"hold is {hold!r}, expected 'linear' or 'previous'")
    if not (
        isinstance(free, list | tuple) and all(isinstance(name, str) for name in free)
    ):
        raise InputError(
            f"free is {free!r}, expected a list of state names, such as ['r_b']"
        )
    t, actuation = np.linspace(0.0, duration, knots), Actuation(state)
    wheels = robot.wheels_at(end[1])
    shooting = Shooting(robot, t, hold == "previous", wheels)
    acting = chosen_limits(robot, limits, wheels)
    low, high = input_limits(robot, acting)
    weights = _weights(R, low, high, input_keys(actuation))
    left = {*shooting.wheels, *chosen("state", free, state.names)}
    rates = range(*state.groups.omega_b.indices(state.nx))
    if _without_velocity(goal) and left.isdisjoint(rates):
        left |= {state.names.index(f"qdot_m.{name}") for name in wheels}
    asked = np.array([i not in left for i in range(state.nx)])
    bounds = np.array([acting.get(name, (-np.inf, np.inf)) for name in state.names]).T
    _require_within(shooting, bounds, "start", start, np.full(state.nx, True))
    _require_within(shooting, bounds, "goal", end, asked)
    # NumPy's warnings are not needed, because an error is raised if the search diverges.
    with np.errstate(all="ignore"), closing(Progress(progress)) as line:
        inputs = np.array((low, high))
        cost = _knot_weights(shooting)[:, None] * weights
        size = np.abs(np.where(np.isfinite(bounds), bounds, 0.0)).max(axis=0)
        first = initial_guess(shooting, guess, start, end, asked, bounds, weights)
        shooting.refine(*first, np.inf)
        controlled, importance = controlled_ends(shooting, *first, weights, asked)
        determining = shooting.determining(end, controlled)
        search = Search(
            shooting,
            start,
            end,
            controlled,
            importance,
            determining,
            bounds,
            inputs,
            size,
            cost,
            _PARTS,
            line.say,
        )
        made = _least(search, first)
    if made.reached:
        q, v, u = made.q, made.v, made.u
        if controlled.all():
            q[-1], v[-1] = end  # the integrated motion misses it by at most _REACHED
        within = _note(shooting, made)
        vibrating, fault = _vibrations(shooting, made, end, asked & ~controlled)
        for text in (*fault, *_faults(made, within)):
            warnings.warn(text, FflinWarning, stacklevel=2)
        limits_of_all = np.hstack((bounds, inputs))
        nearest = _nearest_to_limits(shooting, actuation, made, limits_of_all)
        note = f"{within}\n{made.optimality or _UNKNOWN}{vibrating}{nearest}"
        return Trajectory(
            robot, t, q, v, u, hold=hold, _note=note, _optimality=made.optimality
        )
    raise _failure(shooting, made, asked, duration)


# An error at the goal above this [rad or m; rad/s or m/s times at most 1 s] means that the search
# has diverged.
_DIVERGED = 100.0


class _Made(NamedTuple):
    """Plan, with the final error and the limit violations of the integrated motion."""

    q: Array
    v: Array
    u: Array
    missed: Array  # error at the goal (nx,)
    at_knots: Array  # largest limit violations at the knots (nx,)
    # limit violations (N, parts, nx) at the ends of all parts, relative to limits
    beyond: Array
    most: float  # largest entry of `beyond`
    optimality: Optimality | None  # None if it could not be computed

    @property
    def reached(self) -> bool:
        """Whether the motion ends at the goal and is within the limits at the knots."""
        return bool(max(self.missed.max(), self.at_knots.max()) <= _REACHED)


def _weights(R: Weight | None, low: Array, high: Array, inputs: Sequence[str]) -> Array:
    """Return the weights (nu,) of the squared inputs, by default from their limits."""
    if R is None:
        size = np.maximum(np.abs(low), np.abs(high))
        R = np.where(np.isfinite(size) & (size > 0.0), size, 1.0) ** -2.0
    matrix = weight("R", R, inputs, definite=True)
    weights: Array = matrix.diagonal()
    if (matrix != np.diag(weights)).any():
        raise InputError(
            "R has nonzero off-diagonal entries, expected a diagonal weight; give its diagonal"
        )
    return weights


def _goal_point(
    state: StateMap,
    goal: LinearModel | tuple[ArrayLike | None, ArrayLike | None] | ArrayLike,
) -> Point:
    """Return q (nq,) and v (nv,) of a goal: the point of a model, (q, v), or a state x (nx,)."""
    robot = state.robot

    def at_rest() -> Point:
        return robot.neutral(), np.zeros(robot.nv)

    if isinstance(goal, LinearModel):
        return points.point_of(state, None, goal.q, goal.v, at_rest)
    if isinstance(goal, tuple) and len(goal) == 2:
        return points.point_of(state, None, *goal, at_rest)
    return points.point_of(state, goal, None, None, at_rest)


def _on_constraints(state: StateMap, start: Point, end: Point) -> tuple[Point, Point]:
    """Return start and goal on the constraints of the robot, if it has any.

    Raise `ConstraintError` if one of them is far from the constraints.
    """
    closure = closure_of(state)
    if closure is None:
        return start, end
    closed = list[Point]()
    for name, point in {"start": start, "goal": end}.items():
        with located(f"the {name} of the plan"):
            q = closure.configuration(point[0])
            closed.append((q, closure.velocity(q, point[1])))
    first, last = closed
    return first, last


def _without_velocity(goal: object) -> bool:
    """Return whether a goal is a configuration without a velocity."""
    return isinstance(goal, tuple) and len(goal) == 2 and goal[1] is None


def _knot_weights(shooting: Shooting) -> Array:
    """Return the weight [s] of each knot in the integral of the effort over time.

    If the inputs are held, the weights are the hold times, otherwise the trapezoidal weights.
    """
    h = shooting.h
    if shooting.held:
        return np.append(h, h[-1])
    padded = np.append(h, 0.0)
    weights: Array = 0.5 * (padded + padded[::-1])
    return weights


def _least(search: Search, guess: tuple[Array, Array, Array]) -> _Made:
    """Search for a plan of least effort in up to two attempts, and return the better attempt.

    The search begins at the knots q, v and the inputs u of the guess.

    An attempt that reaches the goal is better than an attempt that does not. If both or neither
    reach the goal, the attempt with the smaller violation is better.
    """
    shooting = search.shooting
    bounds = search.bounds
    cost = search.cost
    attempts = list[_Made]()
    unit = float((cost * guess[2] ** 2).sum() or cost.sum())
    cost = cost / unit  # cost * u**2 of the guess sums to 1
    # The first attempt has limits between the knots. If it misses the goal, or exceeds a limit by
    # more than the tolerance, a second attempt has limits at the knots only.
    divisions = [1]
    if np.isfinite(bounds).any():
        divisions = [_PARTS, 1]
    for parts in divisions:
        (q, v, u, *_), optimality = search._replace(cost=cost, parts=parts).best(*guess)
        if optimality is not None:
            optimality = replace(optimality, effort=unit * optimality.effort)
        if shooting.held:
            # the last row repeats the input of the last interval
            u = np.vstack((u[:-1], u[-2]))
        missed = np.abs(shooting.between((q[-1], v[-1]), search.end)) * search.asked
        within = shooting.inside(shooting.motions(q, v, u), _PARTS)
        beyond = excess(bounds[:, None, None] - within)
        beyond /= np.where(search.size > 0.0, search.size, 1.0)
        at_knots = excess(bounds[:, None] - shooting.limited_values(q, v)).max(axis=0)
        attempts.append(
            _Made(q, v, u, missed, at_knots, beyond, float(beyond.max()), optimality)
        )
        if attempts[-1].reached and attempts[-1].most <= _BETWEEN:
            break
    return max(attempts, key=lambda made: (made.reached, -made.most))


def _require_within(
    shooting: Shooting, bounds: Array, which_end: str, point: Point, asked: Mask
) -> None:
    """Raise `InputError` if a state of a point is outside its limits.

    `asked` (nx,) is True for the states to check.
    """
    values = shooting.limited_values(*point)
    state = shooting.state
    outside = [
        f"{state.names[i]} is {values[i]:.4g} {state.units[i]}, limit {limit:.4g} {state.units[i]}"
        for side, limits in zip((-1.0, 1.0), bounds, strict=True)
        for i, limit in enumerate(limits)
        if asked[i] and side * (values[i] - limit) > _REACHED
    ]
    if outside:
        raise InputError(f"the {which_end} is outside the limits: {listed(outside)}")


def _failure(
    shooting: Shooting, made: _Made, asked: Mask, duration: float
) -> InputError:
    """Return the error for a failed search, with the largest violations of the last trial."""
    robot, state = shooting.state.robot, shooting.state
    units = ["rad"] * 3 + [*state.units[3:]]
    names = [f"the attitude about {axis}" for axis in "xyz"] + [*state.names[3:]]
    misses = [
        f"{words} {names[i]} by {far[i]:.3g} {units[i]}"
        for words, far in (
            ("misses", made.missed),
            ("exceeds the limit of", made.at_knots),
        )
        for i in np.argsort(-far)[:3]
        if far[i] > _REACHED
    ]
    advice = (
        "give a longer duration, wider limits or more knots, or leave the final value of some "
        "states free with `free` (--free-end)"
    )
    internal = all(
        isinstance(item, JointTorque | ReactionWheel) for item in robot.inputs
    )
    if internal and asked[state.groups.omega_b].any() and asked[state.groups.v_b].any():
        advice = (
            "the inputs cannot change the momentum, so omega_b and v_b at the end cannot be "
            "chosen; leave them free with `free` (--free-end), and also r_b or q_b if the goal "
            "moves the base"
        )
    elif asked[state.groups.q_b].any() and all(
        isinstance(actuator, JointTorque) for actuator in robot.inputs
    ):
        advice = (
            "joint torques alone rotate the base only if the joints move in loops (the system is "
            "nonholonomic); give a longer duration, more knots or a `guess` (--guess) in which the "
            "joints move in loops, or leave q_b free with `free` (--free-end)"
        )
    if passive := _passive_joints(shooting, asked & (made.missed > _REACHED)):
        names = [f"{group}.{name}" for name in passive for group in ("q_m", "qdot_m")]
        advice = (
            f"{listed(passive)} have springs and no motor, so they vibrate at the end; leave them "
            f"free with free={names} (--free-end), or lock them"
        )
    outcome = listed(misses)
    if not misses or _diverged(made, duration):
        outcome = "diverges"
    return InputError(
        f"no motion within the limits was found that ends at the goal after {duration:g} s; the "
        f"last trial {outcome}; {advice}"
    )


def _passive_joints(shooting: Shooting, asked: Mask) -> list[str]:
    """Return the joints with springs but without a motor whose final values are prescribed."""
    state = shooting.state
    robot = state.robot
    prescribed = {state.names[i] for i in np.flatnonzero(asked)}
    return [name for name in passive_springs(robot) if f"q_m.{name}" in prescribed]


def _diverged(made: _Made, duration: float) -> bool:
    """Return whether the error at the end is too large to tell how near a motion is to the goal."""
    half = len(made.missed) // 2
    positions, rates = made.missed[:half], made.missed[half:]
    largest = max(positions.max(), rates.max() * min(duration, 1.0))
    return not largest <= _DIVERGED


def _faults(made: _Made, note: str) -> Iterator[str]:
    """Return warnings about a plan that exceeds a limit, or may not have the least effort."""
    if made.most > _BETWEEN:
        yield f"{note}; give more knots or a longer duration"
    optimality = made.optimality
    if optimality is None:
        yield f"the plan reaches the goal, but {_UNKNOWN}"
    elif not optimality.stationary:
        yield (
            "the plan reaches the goal, but is not a minimum of the effort: the search ended after "
            f"{counted(optimality.iterations, 'iteration')}, the gradient is still "
            f"{optimality.stationarity:.1e} of the gradient of the effort, and the complementarity "
            f"is {optimality.complementarity:.1e}, expected at most {STATIONARY:.0e}"
        )


def _vibrations(
    shooting: Shooting, made: _Made, end: Point, uncontrolled: Mask
) -> tuple[str, list[str]]:
    """Return a note and warnings about deflections that the inputs do not control.

    Both are empty without such deflections. `uncontrolled` (nx,) is True for the states that are
    prescribed, but that the inputs cannot choose, see `controlled_ends`.
    """
    state = shooting.state
    half = state.nx // 2
    left = [i for i in shooting.deflections if uncontrolled[[i, half + i]].any()]
    if not left:
        return "", []
    names = listed([state.names[i].removeprefix("q_m.") for i in left])
    positions = shooting.limited_values(made.q, made.v)[:, :half]
    goal = shooting.limited_values(*end)[:half]
    error = float(np.abs(positions[-1] - goal)[left].max())
    largest = float(np.abs(positions - goal)[:, shooting.deflections].max())
    percent = f"{100.0 * error / (largest or 1.0):.2g} %"
    note = (
        f"{names} cannot be chosen at the end beside the other states: the deflection ends "
        f"{percent} of the largest deflection from the goal"
    )
    if error <= _VIBRATES * largest:
        return f"\n{note}", []
    remedy = (
        "the inputs do not excite these deflections, or are held for nearly whole periods of them: "
        "give another number of knots or another duration"
    )
    return f"\n{note}", [f"{note}; {remedy}"]


def _note(shooting: Shooting, made: _Made) -> str:
    """Describe the integrated motion's largest violation of a state limit."""
    most = "exceeds no state limit"
    if made.most > 0.0:
        k, part, i = np.unravel_index(made.beyond.argmax(), made.beyond.shape)
        at = (k + (part + 1) / _PARTS) * shooting.h[0]
        percent = f"{100.0 * made.most:.2g} %"
        most = f"exceeds the limit of {shooting.state.names[i]} by {percent} at t = {at:.4g} s"
    return f"the integrated motion {most} (checked at {_PARTS} points per interval)"


def _nearest_to_limits(
    shooting: Shooting, actuation: Actuation, made: _Made, limits: Array
) -> str:
    """Describe, for each group of signals, the state or input that is nearest to its limit.

    `limits` (2, k) contains the lower and upper limits of all states and inputs. The rates of
    wheels are a group of their own.
    """
    state = shooting.state
    wheel_rates = {
        state.names[i].replace("q_m.", "qdot_m.", 1) for i in shooting.wheels
    }
    names = state.names + input_keys(actuation)
    units = state.units + actuation.units
    low, high = limits
    values = np.hstack((shooting.limited_values(made.q, made.v), made.u))
    limit = np.abs(np.where(values > 0.0, high, low))
    # Fractions of the limits; 0 if the limit is zero.
    fractions = np.abs(values) / np.where(limit > 0.0, limit, np.inf)

    nearest: dict[tuple[str, bool], tuple[float, str]] = {}
    for i in np.flatnonzero(np.isfinite(limits).any(axis=0)):
        name = names[i]
        group = group_of(name), name in wheel_rates
        knot = int(fractions[:, i].argmax())
        text = f"{name} {abs(values[knot, i]):.3g} of {limit[knot, i]:.3g} {units[i]}"
        signal = float(fractions[knot, i]), text
        nearest[group] = max(nearest.get(group, signal), signal)
    if not nearest:
        return ""
    texts = [text for _, text in nearest.values()]
    listing = ", ".join(text.replace(" ", "\u00a0") for text in texts)
    return f"\nnearest to their limits at the knots: {listing}"
