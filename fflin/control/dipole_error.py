"""Prediction of the attitude error that a residual dipole causes under a law of magnetorquers."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import expm

from fflin.base.names import group_of
from fflin.base.rotation import rotation_matrix
from fflin.base.validation import Array
from fflin.control.optimal.periodic_loops import monodromy, steady_states
from fflin.dynamics.orbital import OrbitField
from fflin.linear.model import LinearModel
from fflin.robot.disturbance import RESIDUAL_DIPOLE, magnetic_values
from fflin.robot.inputs import Magnetorquer
from fflin.robot.robot import Robot

# Number of steps per orbit in which the field is constant, and the error [deg] from which a note is
# given.
_STEPS, _LARGE = 360, 10.0


def note_on_dipole(robot: Robot, lin: LinearModel, K: Array) -> tuple[str, ...]:
    """Return a note if the residual dipole of a robot causes a large attitude error.

    `lin` and `K` are the model and the gain of a law whose torque magnetorquers produce. The note
    is for robots without joints and other inputs.
    """
    dipole = np.array(magnetic_values(robot.disturbance, RESIDUAL_DIPOLE))
    only_magnetic = {*map(type, robot.inputs)} == {Magnetorquer}
    if not dipole.any() or robot.n or not only_magnetic:
        return ()
    error = steady_error(robot, lin, K, dipole)
    if error is None or error < _LARGE:
        return ()
    size = f"{error:.2g} deg"
    if error > 90.0:
        size = "more than 90 deg"
    return (
        f"the residual dipole of {np.linalg.norm(dipole):.2g} A m^2 is too large for this gain: "
        f"the predicted steady attitude error is {size}; reduce the dipole, or use a periodic "
        "regulator, whose default weights use the limits of the magnetorquers",
    )


def steady_error(
    robot: Robot, lin: LinearModel, K: Array, dipole: Array
) -> float | None:
    """Return the largest attitude error [deg] of the periodic motion under a residual dipole.

    The linear loop is flown over one orbit. `Allocation` realises the torque across the field that
    is nearest to the commanded torque in the norm of the inverse inertia.

    The result is None if this loop is unstable, or if the law has no base torque or no continuous
    model. It is 180 deg if the linear error exceeds the range of the attitude.
    """
    source = lin.generator or lin
    states = _entries(source.state_names, ("q_b", "omega_b"))
    inputs = _entries(source.input_names, ("tau_b",))
    if source.dt or robot.orbit is None or len(states) != 6 or len(inputs) != 3:
        return None
    A = source.A[np.ix_(states, states)]
    B = source.B[np.ix_(states, inputs)]
    gain = K[np.ix_(inputs, states)]
    field = OrbitField(robot, source.frame).magnetic
    assert field is not None  # since the robot has magnetorquers
    to_base = rotation_matrix(source.q[3:7]).T
    h = robot.orbit.period / _STEPS
    inertia = np.linalg.inv(B[3:])
    loops = np.zeros((_STEPS, 7, 7))
    for loop, t in zip(loops, h * (np.arange(_STEPS) + 0.5), strict=True):
        b = to_base @ field.at(float(t))
        along = inertia @ b
        realised = np.eye(3) - np.outer(along, b) / (b @ along)
        loop[:6, :6] = A - B @ realised @ gain
        loop[:6, 6] = B @ np.cross(dipole, b)
    steps = expm(h * loops)
    F = steps[:, :6, :6]
    if np.abs(np.linalg.eigvals(monodromy(F))).max() >= 1.0:
        return None
    errors = steady_states(F, steps[:, :6, 6:])[:, :3, 0]
    largest = float(np.linalg.norm(errors, axis=1).max())
    return math.degrees(2.0 * math.asin(min(largest, 1.0)))


def _entries(names: tuple[str, ...], groups: tuple[str, ...]) -> list[int]:
    """Return the indices of the names that belong to the groups."""
    return [i for i, name in enumerate(names) if group_of(name) in groups]
