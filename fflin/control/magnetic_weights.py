"""Default weights of a regulator whose torque only magnetorquers produce."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from fflin.control.authority import point_properties
from fflin.robot.robot import Robot

# The scales are the largest inertia I and the mean motion n of the orbit: n^2 I for torques and n
# for rates. In campaigns of the bundled cubesat, all runs then acquire the attitude. With a gain of
# the attitude below 2 n^2 I, the gravity gradient holds some satellites upside down. With less
# damping, the loop is unstable, because the torque along the field is missing.
_TORQUE, _RATE, _ATTITUDE = 1.72, 0.58, 0.267


def magnetic_weights(robot: Robot) -> dict[str, dict[str, float]]:
    """Return the entries of `weights` of a robot in orbit, for a regulator of the base torque.

    They make the loop as slow as the orbit.
    """
    assert robot.orbit is not None
    n = robot.orbit.mean_motion
    at_rest = point_properties(robot, robot.neutral(), np.zeros(robot.nv))
    inertia = np.diag(at_rest.inertia)
    largest = float(inertia.max())
    bryson = {"omega_b": _RATE * n, "tau_b": _TORQUE * n * n * largest}
    for axis, value in zip("xyz", inertia.tolist(), strict=True):
        bryson[f"q_b.{axis}"] = min(1.0, _ATTITUDE * largest / value)
    return {"bryson": bryson}


def described(rule: str, defaults: Collection[str], given: Collection[str]) -> str:
    """Return the description of weights, which states which weights are defaults.

    `rule` describes all single weights as given, although the user set only those named in `given`.
    `defaults` are the names of the entries of `magnetic_weights`.
    """
    names, separator, others = rule.partition(" as given; ")
    if not separator:
        return rule
    weighted = names.split(", ")
    automatic = [name for name in weighted if name in defaults and name not in given]
    if not automatic:
        return rule
    parts = [f"{', '.join(automatic)}: default for magnetorquers"]
    if rest := [name for name in weighted if name not in automatic]:
        parts.append(f"{', '.join(rest)} as given")
    return "; ".join((*parts, others))
