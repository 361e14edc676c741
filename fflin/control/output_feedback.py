"""Feedback of what is measured, by a compensator that estimates the state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fflin.base.errors import InputError
from fflin.base.validation import Array, vector
from fflin.control.kalman import Compensator
from fflin.dynamics.aba import Aba
from fflin.dynamics.outputs import Measuring, Sensing
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_fit, require_same
from fflin.linear.model import LinearModel
from fflin.robot.outputs import FullState

if TYPE_CHECKING:
    from fflin.control.policies import Policy
    from fflin.robot.robot import Robot


def measured_states(state: StateMap) -> list[int] | None:
    """Return which states the outputs of a robot are, or None where one is no state."""
    if state.robot.outputs == (FullState(),):
        return list(range(state.nx))
    sensing = Sensing(state, state.robot.outputs)
    whole = len(sensing.states) == len(sensing.names)
    return [index for _, index in sorted(sensing.states)] if whole else None


@dataclass(frozen=True, eq=False)
class OutputFeedback:
    """The feedback of a sampled compensator, such as `lqg` makes, on the robot's outputs.

    At each sample u - u0 = C z acts, then y is measured and z brought up to the next sample. An
    accelerometer is taken to feel u as it is commanded, before limits. The estimate begins at
    zero: the point itself.

    Parameters
    ----------
    lin : LinearModel
        The sampled model that the compensator was made for.
    compensator : Compensator
    noise : callable, optional
        noise(t) -> (ny,), added to y.

    Raises
    ------
    InputError
        If the compensator is of another model or not sampled.
    """

    lin: LinearModel
    compensator: Compensator
    noise: Callable[[float], ArrayLike] | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.lin, LinearModel) or not isinstance(self.compensator, Compensator):
            raise InputError(
                "OutputFeedback takes a LinearModel and a Compensator, as fflin.lqg returns it"
            )
        lin, compensator = self.lin, self.compensator
        if not lin.dt or lin.moving:
            raise InputError(
                "the model must be sampled and about a point that stays; take "
                "lin.discretize(dt), and the gain and the estimator of that"
            )
        signals = (compensator.input_names, compensator.output_names, compensator.dt)
        if signals != (lin.output_names, lin.input_names, lin.dt):
            raise InputError(
                f"the compensator is of another model than '{lin.robot}' with its "
                f"{len(lin.output_names)} outputs at dt = {lin.dt:g} s; use one for both"
            )

    def bind(self, robot: Robot) -> Policy:
        """Return policy(t, q, v) -> u for a robot, with an estimate of its own.

        Raises
        ------
        InputError
            If the robot has not the model's states, inputs and outputs; its masses may be others.
        """
        lin, by = self.lin, self.compensator
        state = StateMap(robot, reference=lin.reference, frame=lin.frame)
        require_fit(lin, robot, state)
        full = robot.outputs == (FullState(),)
        sensed = state if full else Sensing(state, robot.outputs)
        own, there = (lin.output_names, lin.output_units), (sensed.names, sensed.units)
        require_same(f"the model is one of '{lin.robot}'", robot, "output", own, there)
        measure = Measuring(state, lin.q)
        aba = Aba(state) if any(output.FEELS_ACCELERATION for output in robot.outputs) else None
        near = state.read(lin.q, lin.v)
        z: Array = np.zeros(len(by.A))
        asked = -np.inf

        def policy(t: float, q: Array, v: Array) -> Array:
            nonlocal z, asked
            if asked >= 0.0 and abs(t - asked - lin.dt) > 1e-6 * lin.dt:
                raise InputError(
                    f"the compensator is asked {t - asked:g} s after its last sample, expected "
                    f"{lin.dt:g} s; leave `sample` out"
                )
            asked = t
            u: Array = by.u0 + by.C @ z
            a: Array = np.zeros(robot.nv)
            if aba is not None:
                a = aba.acceleration(q, v, aba.actuation.in_base_axes(state.chart(q), u))
            y = measure(state.read(q, v, near=near), q, v, a)
            if self.noise is not None:
                y = y + vector("noise(t)", self.noise(t), len(y), "one value for each output")
            z = by.A @ z + by.B @ (y - by.y0)
            return u

        return policy
