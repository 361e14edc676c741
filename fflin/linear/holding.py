"""Models about points that only inputs hold, and the momentum that wheels gain there."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinError
from fflin.base.names import group_of, input_keys
from fflin.base.validation import Array, Vector
from fflin.dynamics.coordinates import frame_of
from fflin.linear.equilibrium import equilibrium
from fflin.linear.least_norm import TOLERANCE
from fflin.linear.linearization import linearize
from fflin.linear.model import LinearModel

# Orbit normal in the axes of the orbital frames.
_NORMAL = {"lvlh": (0.0, -1.0, 0.0), "hill": (0.0, 0.0, 1.0)}


def is_held(lin: LinearModel) -> bool:
    """Return whether only the wheels of a model accelerate at its operating point.

    Any equilibrium is such a point. In every other case, the wheels take up a constant torque on
    the robot and gain momentum, so that the robot stays at the point until they saturate.
    """
    if lin.is_equilibrium():
        return True
    wheels = {f"qdot_m.{name}" for name in lin.wheels}
    judged = [x not in lin.ignorable and x not in wheels for x in lin.state_names]
    return bool(np.abs(lin.rate[judged]).max(initial=0.0) <= lin.bound(TOLERANCE))


def held(lin: LinearModel, *, tilt: bool = True) -> LinearModel:
    """Return a model about the same point with the inputs of `equilibrium`, which hold the robot.

    Under gravity, `equilibrium` may tilt the base unless `tilt` is false.

    If the point needs no other inputs, return the model itself. This is also so if the inputs
    cannot be chosen: the model has a moving reference, lacks states of the robot or was read from a
    file, or its point has inputs already.

    Raises
    ------
    EquilibriumError
        If no inputs hold the robot at the point.
    """
    robot = lin._robot
    if is_held(lin) or lin.moving or robot is None or lin.u0.any():
        return lin
    source = (lin.generator or lin).undelayed
    if len(source.A) + len(source.dependent) != 2 * robot.nv:
        return lin
    frame = frame_of(robot, source.frame)
    reference = None
    if robot.orbit or source.x0[:6].any():
        reference = source.reference
    balanced = equilibrium(
        robot, source.q, v=source.v, frame=frame, reference=reference, tilt=tilt
    )
    model = linearize(
        robot,
        balanced.q,
        source.v,
        balanced.u,
        frame=frame,
        reference=reference,
        independent=source.independent,
    )
    if lin.lag.any() or lin.output_lag.any():
        model = model.with_lags(*lags_by_name(lin))
    if lin.dt:
        delays = dict(zip(input_keys(lin), lin.delay.tolist(), strict=True))
        return model.discretize(lin.dt, delays)
    return model


def lags_by_name(lin: LinearModel) -> tuple[dict[str, float], dict[str, float]]:
    """Return the time constants of inputs and outputs by name, as arguments of `with_lags`."""
    lags = dict(zip(input_keys(lin), lin.lag.tolist(), strict=True))
    output_lags = dict(zip(lin.output_names, lin.output_lag.tolist(), strict=True))
    return lags, output_lags


def held_if_possible(lin: LinearModel) -> LinearModel:
    """Return the model of `held`, or `lin` itself if no inputs hold the robot."""
    try:
        return held(lin)
    except FflinError:
        return lin


def momentum_rate(lin: LinearModel) -> Vector:
    """Return the momentum (3,) [N m] that the wheels gain per second at the point of a model.

    The axes are the axes of the angular velocity of the base: base axes in orbit. A wheel without
    an inertia gains the momentum of its torque.
    """
    lin = lin.undelayed
    nv = len(lin.M)
    names = [f"qdot_m.{name}" for name in lin.wheels]
    at = [i for i, name in enumerate(lin.state_names[nv:]) if name in names]
    rate: Array = lin.M[:3, at] @ lin.rate[nv:][at]
    keys = input_keys(lin)
    massless = [
        i
        for i, key in enumerate(keys)
        if group_of(key) == "wheel"
        and f"qdot_m.{lin.input_names[i]}" not in lin.state_names
    ]
    forces = lin.M @ lin.B[nv:, massless] @ lin.u0[massless]
    return rate - forces[:3]


def wheel_notes(lin: LinearModel) -> tuple[str, ...]:
    """Return a note on the momentum that wheels gain while they hold the robot at its point.

    In orbit, the torque on the robot is constant in the rotating orbital frame. Its part along the
    orbit normal adds up. Its part T across the normal obeys dh/dt = T - n x h, so this part of the
    momentum h moves on a circle with the diameter 2 T / n and is zero after each orbit.
    """
    if "q_b.x" not in lin.state_names:
        return ()
    rate = momentum_rate(lin)
    n = lin.mean_motion
    torque = float(np.linalg.norm(rate))
    if torque <= lin.bound(TOLERANCE) * float(lin.M[:3, :3].diagonal().max()):
        return ()
    head = f"the wheels hold a torque of {torque:.3g} N m"
    if not n:
        return (f"{head}, and gain as much momentum [N m s] in each second",)
    vector = lin.x0[:3]  # of the quaternion of the base relative to the reference
    turn = pin.Quaternion(
        np.sqrt(1.0 - float(vector @ vector)), *vector.tolist()
    ).matrix()
    normal = (lin.reference.rotation @ turn).T @ np.array(_NORMAL[lin.frame])
    parts = float(rate @ normal) * normal, rate - float(rate @ normal) * normal
    along, across = (float(np.linalg.norm(part)) for part in parts)
    gains = list[str]()
    if along > TOLERANCE * torque:
        gained = along * 2.0 * math.pi / n
        gains.append(f"{gained:.3g} N m s per orbit along the orbit normal")
    if across > TOLERANCE * torque:
        gains.append(
            f"up to {2.0 * across / n:.3g} N m s across the orbit normal, which returns to zero "
            "after each orbit"
        )
    return (f"{head}: they gain {' and '.join(gains)}",)
