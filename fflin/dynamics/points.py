"""Configurations, velocities and inputs, built from values that are given by name."""

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, InputError, listed
from fflin.base.names import by_name, input_keys, rates_by_name
from fflin.base.validation import (
    Array,
    ArrayLike,
    instance,
    looks_like_degrees,
    numbers,
    placement,
    shaped,
)
from fflin.dynamics.state import Actuation, StateMap
from fflin.robot.fields import input_limits, limits_of, travel_of, warn_of_degrees
from fflin.robot.inputs import named_wheels
from fflin.robot.joints import ROOT, Joint, by_joint
from fflin.robot.robot import Robot

# [rad/s|m/s], so that squared speeds and their sums do not overflow
LARGEST_SPEED = 1e50

# [SI]; an excess over a limit is reported only if it is larger than this
LIMIT_SLACK = 1e-9


def configuration(
    robot: Robot,
    joints: Mapping[str, float] | None = None,
    base: pin.SE3 | None = None,
    *,
    rpy: ArrayLike | None = None,
) -> Array:
    """Return the Pinocchio configuration for joint values given by name and a base placement.

    Parameters
    ----------
    robot : Robot
    joints : mapping, optional
        Values of independent joints by name, {joint: value [rad|m]}. All other joints are at their
        neutral positions. A name may be a pattern such as ``hinge_*``.
    base : pin.SE3, optional
        Placement of the base in the world; the identity by default.
    rpy : array_like (3,), optional
        Roll, pitch and yaw [deg] of the base about fixed axes, with the base at the origin. It
        takes the place of `base`.

    Returns
    -------
    ndarray (nq,)

    Raises
    ------
    UnknownNameError
        If a name or pattern in `joints` matches no joint.
    InputError
        If a value is not a finite number, a named joint is a mimic joint, or both `base` and `rpy`
        are given.

    Warns
    -----
    FflinWarning
        If a value is outside the position limits of the joint, which fflin does not enforce. A
        common reason is an angle in degrees.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> fflin.configuration(robot, {"joint_2": 0.4})
    array([0.        , 0.        , 0.        , 0.        , 0.        ,
           0.        , 1.        , 1.        , 0.        , 0.92106099,
           0.38941834, 1.        , 0.        ])

    The base rotated by 30 deg about x has the quaternion (sin 15 deg, 0, 0, cos 15 deg):

    >>> fflin.configuration(robot, rpy=(30, 0, 0))[3:7].round(4)
    array([0.2588, 0.    , 0.    , 0.9659])
    """
    instance("robot", robot, Robot, "a fflin.Robot")
    q = pin.neutral(robot.model)
    if rpy is not None:
        if base is not None:
            raise InputError("base and rpy are both given; give one of them")
        base = base_of({"rpy": shaped("rpy", rpy, (3,), " [deg]")})
    if base is not None:
        root = robot.model.jointPlacements[ROOT]
        q[:7] = pin.SE3ToXYZQUAT(root.actInv(placement("base", base)))
    if joints is not None:
        values = numbers("joints", joints, "joint", "joint")
        for name, value in by_joint(values, robot.joint_names, robot.joint).items():
            joint = robot.joint(name)
            joint.place(q, value)
            _warn_beyond_travel(robot, joint, value)
    robot.follow(q)
    return robot.checked_configuration(q)


def _warn_beyond_travel(robot: Robot, joint: Joint, value: float) -> None:
    """Warn if the value of a joint [rad|m] is outside the position limits of the joint."""
    low, high = travel_of(robot.model, joint)
    if low <= value <= high:
        return
    unit = joint.unit
    shown = f"{value:g} {unit}"
    if unit == "rad" and looks_like_degrees(value, low, high):
        shown = f"{value:g} (deg?)"
    text = f"joint '{joint.name}' at {shown} is outside {low:g} to {high:g} {unit}"
    warnings.warn(text, FflinWarning, stacklevel=3)


def require_slow(what: str, v: Array) -> None:
    """Raise `InputError` if a velocity exceeds `LARGEST_SPEED`."""
    if not np.abs(v).max(initial=0.0) < LARGEST_SPEED:
        raise InputError(
            f"{what} has an entry of {np.abs(v).max():.3g}, expected less than {LARGEST_SPEED:g} "
            "[rad/s|m/s]"
        )


def base_of(state: Mapping[str, Any]) -> pin.SE3:
    """Return the base placement from "rpy" [deg] and "position" [m] of a mapping.

    The mapping is a robot's `point`, `start` or `target`. A missing entry counts as zero.
    """
    rotation = pin.rpy.rpyToMatrix(*np.radians(state.get("rpy", np.zeros(3))))
    return pin.SE3(rotation, np.array(state.get("position", np.zeros(3))))


def combined(state: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Merge two mappings such as `robot.point`; entries of `other` replace entries of `state`.

    In "joints" and "velocity", only the joints and rates that `other` names are replaced.
    """
    both = {**state, **other}
    for part in ("joints", "velocity"):
        if part in both:
            both[part] = {**state.get(part, {}), **other.get(part, {})}
    return both


def start_of(robot: Robot) -> tuple[Array, Array]:
    """Return the initial configuration (nq,) and velocity (nv,) of a robot.

    They are given by `robot.start`. Values that are missing there are taken from `robot.point`.
    """
    start = combined(robot.point, robot.start)
    q = configuration(robot, start.get("joints"), base_of(start))
    rates = start.get("velocity")
    v: Array = np.zeros(robot.nv)
    if rates:
        v = velocity(robot, rates)
    return q, v


def point_of(
    state: StateMap,
    x0: ArrayLike | None,
    q0: ArrayLike | None,
    v0: ArrayLike | None,
    default: Callable[[], tuple[Array, Array]],
) -> tuple[Array, Array]:
    """Return q (nq,) and v (nv,) from x0, or from q0 and v0, or from `default` if all are None.

    If only q0 is given, v is zero. If only v0 is given, q is neutral.
    """
    robot = state.robot
    if x0 is not None:
        if q0 is not None or v0 is not None:
            raise InputError(
                "x0 is given together with q0 or v0; give either x0, or q0 and v0"
            )
        q, v = state.to_pinocchio(x0)
        _warn_of_angles(state, q)
        return q, v
    if q0 is None and v0 is None:
        return default()
    q = robot.neutral() if q0 is None else robot.checked_configuration(q0).copy()
    _warn_of_angles(state, q)
    v = np.zeros(robot.nv) if v0 is None else robot.checked_velocity(v0).copy()
    return q, v


def _warn_of_angles(state: StateMap, q: Array) -> None:
    """Warn of joint positions in q (nq,) that look like degrees."""
    names = [f"q_m.{name}" for name in state.robot.joint_names]
    positions = state.joint_positions(q).tolist()
    warn_of_degrees(state.robot, dict(zip(names, positions, strict=True)))


def velocity(robot: Robot, values: Mapping[str, float]) -> Array:
    """Return the Pinocchio velocity for joint rates and base velocities given by name.

    Parameters
    ----------
    robot : Robot
    values : mapping
        Rates by name, {name: rate}; all other rates are zero. A name is one of

        - a joint [rad/s|m/s];
        - a component of the base velocity in base axes: omega_b.x, .y, .z [rad/s] or v_b.x, .y, .z
          [m/s];
        - a pattern such as ``hinge_*``, or a group such as ``qdot_m``.

    Returns
    -------
    ndarray (nv,)

    Raises
    ------
    UnknownNameError
        If a name or pattern in `values` matches no joint and no velocity component.
    InputError
        If a value is not a finite number.

    Warns
    -----
    FflinWarning
        If the rate of a revolute joint looks like degrees: it exceeds 2 pi rad/s and the speed
        limit of the joint.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> fflin.velocity(robot, {"omega_b.z": 0.02, "joint_1": 0.1})
    array([0.  , 0.  , 0.  , 0.  , 0.  , 0.02, 0.1 , 0.  , 0.  ])
    """
    checked = numbers("values", values, "velocity", "velocity")
    state = StateMap(robot)
    for name, _ in named_wheels(robot.inputs):
        if name in checked and name not in robot.joint_names:
            # raises an error that explains why the wheel has no velocity
            robot.joint(name)
    rates = rates_by_name(robot.joint_names, checked)
    warn_of_degrees(robot, rates)
    return state.spread(
        np.array([rates.get(name, 0.0) for name in state.names[6 + robot.n :]])
    )


def effort(robot: Robot, values: Mapping[str, float]) -> Array:
    """Return the input vector u for values given by name.

    Parameters
    ----------
    robot : Robot
    values : mapping
        Values by name, {name: value}; all other inputs are zero. A name is an input, a group such
        as ``tau_m``, or a pattern.

    Returns
    -------
    ndarray (nu,)

    Raises
    ------
    UnknownNameError
        If a name or pattern in `values` matches no input.
    InputError
        If a value is not a finite number.

    Warns
    -----
    FflinWarning
        If an input is beyond its limits, so that the robot cannot apply it.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> fflin.effort(robot, {"tau_b.z": 2.0, "joint_1": 0.5})
    array([0. , 0. , 2. , 0. , 0. , 0. , 0.5, 0. , 0. ])
    """
    checked = numbers("values", values, "input", "effort")
    keys = input_keys(Actuation(StateMap(robot)))
    value_at = by_name("input", checked, keys)
    u = np.array([value_at.get(index, 0.0) for index in range(len(keys))])
    warn_beyond_limits(robot, u)
    return u


def warn_beyond_limits(robot: Robot, u: Array) -> None:
    """Warn if inputs u (nu,) at an operating point are beyond the limits of the robot."""
    least, largest = input_limits(robot, limits_of(robot))
    actuation = Actuation(StateMap(robot))
    rows = zip(actuation.names, actuation.units, u, least, largest, strict=True)
    beyond = [
        f"{name} = {value:.3g} {unit} (limits {low:g} to {high:g} {unit})"
        for name, unit, value, low, high in rows
        if not low - LIMIT_SLACK <= value <= high + LIMIT_SLACK
    ]
    if beyond:
        warnings.warn(
            f"the inputs at the operating point are beyond their limits: {listed(beyond)}; the "
            "robot cannot apply them",
            FflinWarning,
            stacklevel=3,
        )
