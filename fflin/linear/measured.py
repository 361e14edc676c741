"""What the outputs of a robot measure anywhere, as the y0 of a model is at its point."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fflin.base.errors import InputError
from fflin.base.validation import Array, instance, vector
from fflin.dynamics.aba import Aba
from fflin.dynamics.outputs import Measuring
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_sensed
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot


def outputs(
    robot: Robot, lin: LinearModel, q: Any, v: Any = None, u: ArrayLike | None = None
) -> Array:
    """Return what the outputs of a robot measure, as y0 of a linear model is at its point.

    Attitudes are in the model's chart, where q0 >= 0, rotations of frames are counted from the
    point, and continuous joints are on the turn nearest to it. So ``y - lin.y0`` is what a
    controller of the model takes.

    Parameters
    ----------
    robot : Robot
        With the states, inputs and outputs of the model; its masses may be others.
    lin : LinearModel
    q, v : array_like (nq,), (nv,)
        In Pinocchio's order; v is zero by default.
    u : array_like (nu,), optional
        What an accelerometer feels; u0 by default.

    Returns
    -------
    ndarray (ny,)

    Raises
    ------
    InputError
        If a size is wrong, the model is of another robot or about a reference that moves.
    """
    instance("robot", robot, Robot, "a fflin.Robot")
    if instance("lin", lin, LinearModel, "a fflin.LinearModel").moving:
        raise InputError("the model is about a moving reference, expected one that stays")
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    require_sensed(lin, robot, state)
    at = robot.checked_configuration(q)
    moving = np.zeros(robot.nv) if v is None else robot.checked_velocity(v)
    u = lin.u0 if u is None else vector("u", u, len(lin.u0), "one for each input")
    a: Array = np.zeros(robot.nv)
    if any(output.FEELS_ACCELERATION for output in robot.outputs):
        aba = Aba(state)
        a = aba.acceleration(at, moving, aba.actuation.in_base_axes(state.chart(at), u))
    x = state.read(at, moving, near=state.read(lin.q, lin.v))
    return Measuring(state, lin.q)(x, at, moving, a)
