"""Motion at which the search for a plan begins."""

from collections.abc import Callable, Mapping
from typing import TypeAlias

import numpy as np
import pinocchio as pin
from scipy.interpolate import CubicSpline

from fflin.base.errors import InputError, UnknownNameError
from fflin.base.names import input_keys
from fflin.base.validation import Array, ArrayLike, Mask, function, numbers, vector
from fflin.control.optimal.floating_base import FloatingBase
from fflin.control.optimal.joint_loops import (
    MOST_CIRCLES,
    STEPS,
    Loops,
    rotation_axes,
)
from fflin.control.optimal.shooting import Point, Shooting
from fflin.dynamics.state import Actuation
from fflin.linear.trajectory import Trajectory, cubic
from fflin.robot.inputs import JointTorque, ReactionWheel
from fflin.robot.joints import by_joint
from fflin.robot.robot import Robot

# Joint positions (n,), or positions of some joints by name, as a function of the time [s].
JointMotion: TypeAlias = Callable[[float], ArrayLike | Mapping[str, float]]

Knots: TypeAlias = tuple[Array, Array, Array]

# The joints' motion is integrated in at least this many steps, and in at least _STEPS_PER_INTERVAL
# steps between knots.
_LEAST_STEPS, _STEPS_PER_INTERVAL = 400, 4

# Least number of intervals between knots for one circle of a loop.
_INTERVALS_PER_CIRCLE = 8

# Number of postures at which the axes of rotation are computed, within 1 rad or 1 m of the start.
_POSTURES = 20

# A larger angular momentum, relative to the inertia [kg m^2] of the joints, rotates the base.
_AT_REST = 1e-9  # [rad/s]

# A smaller error of the attitude [rad] at the end needs no loops of the joints.
_REACHED = 1e-6


def initial_guess(
    shooting: Shooting,
    guess: Trajectory | JointMotion | None,
    start: Point,
    end: Point,
    asked: Mask,
    bounds: Array,
    weights: Array,
) -> Knots:
    """Return the knots q, v and the inputs u at which the search begins.

    `asked` (nx,) is True for the states whose end value is prescribed, and `bounds` (2, nx)
    contains the limits of the states. `weights` (nu,) are the weights of the squared inputs.
    """
    if isinstance(guess, Trajectory):
        return _of_trajectory(shooting, guess, start)
    if guess is not None:
        if isinstance(guess, Mapping):
            raise InputError(
                "guess is a mapping, expected a function guess(t) that returns the mapping {joint: "
                "position} at the time t, or a fflin.Trajectory"
            )
        if not callable(guess):
            raise InputError(
                f"guess has type {type(guess).__name__}, expected a fflin.Trajectory, or a "
                "function of the time t that returns joint positions"
            )
        return _of_joints(shooting, guess, start, end)
    if _needs_loops(shooting, asked):
        _require_attainable(shooting, start, end, asked)
        return _with_loops(shooting, start, end, asked, bounds, weights)
    return shooting.guess(start, end)


def conserves_momentum(robot: Robot) -> bool:
    """Return whether all inputs are torques between two bodies of a robot that is not in orbit."""
    return robot.orbit is None and all(
        isinstance(item, JointTorque)
        or (isinstance(item, ReactionWheel) and item.inertia is not None)
        for item in robot.inputs
    )


def _of_trajectory(shooting: Shooting, motion: Trajectory, start: Point) -> Knots:
    """Return the knots and inputs of a given motion, at the times of the plan."""
    robot = shooting.state.robot
    if (motion.robot.nq, motion.robot.nv) != (robot.nq, robot.nv) or (
        input_keys(motion.actuation) != input_keys(Actuation(shooting.state))
    ):
        raise InputError("guess is a motion of a robot with other joints or inputs")
    fraction = shooting.t / shooting.t[-1]
    pace = (motion.t[-1] - motion.t[0]) / shooting.t[-1]
    q, v, u = motion.points(motion.t[0] + fraction * (motion.t[-1] - motion.t[0]))
    q = q.copy()
    v = pace * v
    q[0], v[0] = start
    q, v = shooting.near(q, v)
    return q, v, u.copy()


def _of_joints(
    shooting: Shooting, guess: JointMotion, start: Point, end: Point
) -> Knots:
    """Return the knots and inputs of a motion whose joint positions a function returns."""
    function("guess", guess, "(t)")
    robot = shooting.state.robot
    times = _fine_times(shooting)
    joints = _straight(shooting, start, end, times)
    for t, row in zip(times.tolist(), joints, strict=True):
        label = f"guess({t:.4g})"
        value = guess(t)
        if isinstance(value, Mapping):
            positions = numbers(label, value, "joint", f"{label} of joint")
            try:
                by_name = by_joint(positions, robot.joint_names, robot.joint)
            except UnknownNameError as error:
                raise UnknownNameError(
                    f"{label}: {error}; a guess is a mapping {{joint: position}} or all "
                    "joint positions, returned by a function of the time t"
                ) from None
            for name, position in by_name.items():
                row[robot.joint_names.index(name)] = position
        else:
            row[:] = vector(
                label,
                value,
                robot.n,
                "joint positions in the order of robot.joint_names",
            )
    base = None
    if conserves_momentum(robot) and not robot.constraints:
        base = FloatingBase(shooting.state, start)
    return _along(shooting, base, times, joints, start, end)


def _needs_loops(shooting: Shooting, asked: Mask) -> bool:
    """Return whether only loops of the joints can rotate the base to a prescribed attitude."""
    state = shooting.state
    return (
        all(isinstance(item, JointTorque) for item in state.robot.inputs)
        and not shooting.wheels
        and not state.robot.constraints
        and not state.robot.orbit
        and len(state.robot.inputs) > 1
        and bool(asked[state.groups.q_b].any())
    )


def _require_attainable(
    shooting: Shooting, start: Point, end: Point, asked: Mask
) -> None:
    """Raise `InputError` if joint torques cannot rotate the base to a prescribed attitude.

    If the joints rotate the base about a single axis, whatever their positions are, no loop rotates
    it about another axis. About two or three axes, loops rotate the base to every attitude.
    """
    state = shooting.state
    base = FloatingBase(state, start)
    size = float(np.linalg.norm(base.inertia(state.joint_positions(start[0]))))
    if np.abs(base.angular_momentum).max() > _AT_REST * size:
        return
    if not asked[state.groups.q_b].all():
        return
    joints = state.joint_positions(start[0])
    random = np.random.default_rng(0).uniform(-1.0, 1.0, (_POSTURES, len(joints)))
    axes = rotation_axes(base, joints + random)
    if len(axes) > 1:
        return
    rotation = pin.log3(base.start_rotation.T @ state.rotation(end[0]))
    left = rotation - axes.T @ (axes @ rotation)
    if np.linalg.norm(left) <= _REACHED:
        return
    possible = "do not rotate it"
    if len(axes):
        possible = f"rotate it only about the axis {_shown(axes[0])}"
    raise InputError(
        f"the attitude of the goal is unreachable: the goal rotates the base about "
        f"{_shown(rotation)}, in base axes, but joint torques {possible}, in any loop of the "
        "joints; leave q_b free with `free` (--free-end), or add inputs that act on the base"
    )


def _shown(vector: Array) -> str:
    """Return the direction of a vector (3,) as text, with a positive largest component."""
    direction = vector / np.linalg.norm(vector)
    if direction[np.abs(direction).argmax()] < 0.0:
        direction = -direction
    rounded = np.round(direction, 3) + 0.0
    return f"({', '.join(f'{x:g}' for x in rounded)})"


def _with_loops(
    shooting: Shooting,
    start: Point,
    end: Point,
    asked: Mask,
    bounds: Array,
    weights: Array,
) -> Knots:
    """Return knots and inputs of a motion whose joint loops rotate the base to the goal."""
    state = shooting.state
    robot = state.robot
    groups = state.groups
    base = FloatingBase(state, start)
    times = np.linspace(0.0, shooting.t[-1], STEPS * MOST_CIRCLES + 1)
    motors = [item.joint for item in robot.inputs if isinstance(item, JointTorque)]
    moved = [robot.joint_names.index(name) for name in motors]
    loops = Loops(
        base,
        times,
        _straight(shooting, start, end, times),
        np.array(moved),
        state.rotation(end[0]),
        asked[groups.q_b],
        np.stack((bounds[:, groups.q_m], bounds[:, groups.qdot_m]), axis=1),
        weights,
    )
    joints = loops.path
    if np.linalg.norm(loops.error(joints)) > _REACHED:
        circles = max(1, len(shooting.h) // _INTERVALS_PER_CIRCLE)
        joints, _ = loops.best(min(circles, MOST_CIRCLES))
    fine = _fine_times(shooting)
    return _along(shooting, base, fine, CubicSpline(times, joints)(fine), start, end)


def _fine_times(shooting: Shooting) -> Array:
    """Return equally spaced times that contain the times of the knots."""
    intervals = len(shooting.h)
    steps = max(_STEPS_PER_INTERVAL, -(-_LEAST_STEPS // intervals))
    return np.linspace(0.0, shooting.t[-1], intervals * steps + 1)


def _straight(shooting: Shooting, start: Point, end: Point, times: Array) -> Array:
    """Return joint positions (K, n) on a cubic curve from the start to the end.

    Continuous joints take the shorter direction.
    """
    state = shooting.state
    first = state.joint_positions(start[0])
    last = first + state.joints_apart(start[0], end[0])
    T = times[-1]
    rates = (T * state.velocities(v)[6:] for v in (start[1], end[1]))
    powers = (times[:, None] / T) ** np.arange(4)
    joints: Array = powers @ cubic(first, last, *rates).T
    return joints


def _along(
    shooting: Shooting,
    base: FloatingBase | None,
    times: Array,
    joints: Array,
    start: Point,
    end: Point,
) -> Knots:
    """Return knots and inputs for joint positions (K, n) at times that contain the knots.

    The base moves as the conserved momentum requires. If `base` is None, the base moves on the
    curve of the default guess.
    """
    state = shooting.state
    every = (len(times) - 1) // len(shooting.h)
    rates = CubicSpline(times, joints)(times, 1)
    if base is None:
        q, v, _ = shooting.guess(start, end)
        for joint, values in zip(state.robot.joints, joints[::every].T, strict=True):
            joint.place(q.T, values)
        state.robot.follow(q.T)
        nu = state.velocities(v)
        nu[:, 6:] = rates[::every]
        q[0] = start[0]
        v = state.spread(nu)
        v[0] = start[1]
        q, v = shooting.near(q, v)
        return q, v, shooting.inputs(shooting.t, q, v)
    q, v = base.motion(times, joints, rates, base.rotations(times, joints))
    q[0], v[0] = start
    inputs = shooting.inputs(times, q, v)
    u = inputs[::every]
    if shooting.held:  # an input is constant until the next knot
        parts = 0.5 * (inputs[1:] + inputs[:-1])
        u[:-1] = parts.reshape(len(shooting.h), every, -1).mean(axis=1)
    return q[::every], v[::every], u
