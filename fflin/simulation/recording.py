"""The motion that a run has recorded."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.dynamics.state_rows import states_of
from fflin.linear.model import LinearModel
from fflin.simulation.motion import Motion
from fflin.simulation.prediction import predict

if TYPE_CHECKING:
    from fflin.simulation.run import Run


def check_prediction(run: Run, linear: Any) -> None:
    """Raise `InputError` where a model is given that cannot predict the run."""
    if linear is None or isinstance(linear, bool | np.bool_):
        return
    if not isinstance(linear, LinearModel):
        raise InputError(
            f"linear is a {type(linear).__name__}, expected a fflin.LinearModel, True or False"
        )
    names = (run.state.names, run.dynamics.actuation.names, run.state.frame)
    if (linear.state_names, linear.input_names, linear.frame) != names or linear.moving:
        raise InputError(
            f"linear is a model of '{linear.robot}' that has not the states, inputs and frame of "
            f"the run of '{run.robot.name}'; linearise that robot in the policy's frame"
        )
    if getattr(run.policy, "K", None) is None:
        raise InputError("linear predicts under a StateFeedback alone; leave it out")


def motion_of(run: Run, stopped: str, linear: LinearModel | bool | None) -> Motion:
    """Make the motion of what a run has recorded; `stopped` says why it ended early."""
    rows = slice(0, run.count)
    q, v, u, expected = (each[rows] for each in run.rows)
    history = run.conserved.histories(q, v)
    x = states_of(run.state, q, v, run.near)
    lin = run.lin if linear is None or linear is True else linear or None
    prediction: Array = np.zeros((0, run.state.nx))
    K = getattr(run.policy, "K", None)
    if lin is not None and K is not None and lin.state_names == run.state.names:
        loop = (lin, K, run.limits, run.sample, run.delay)
        # What overflows is no prediction.
        with np.errstate(over="ignore", invalid="ignore"):
            prediction = predict(*loop, x[0], run.dt, run.taken, run.every)[: run.count]
        if not np.isfinite(prediction).all():
            prediction = prediction[:0]
    return Motion(
        t=run.t[rows],
        q=q,
        v=v,
        x=x,
        u=u,
        target=x[0] if run.target is None else run.target,
        prediction=prediction if len(prediction) == run.count else prediction[:0],
        energy=history.energy,
        momentum=np.roll(history.momentum, 3, axis=1),
        momentum_drift=run.conserved.drift(history, expected),
        placement=pin.SE3ToXYZQUAT(run.state.reference),
        state_names=run.state.names,
        input_names=run.dynamics.actuation.names,
        state_units=run.state.units,
        input_units=run.dynamics.actuation.units,
        frame=run.state.frame,
        robot=run.robot.name,
        urdf_sha256=run.robot.urdf_sha256,
        stopped=stopped,
    )
