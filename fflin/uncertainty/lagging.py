"""Linear-fractional models with lags of inputs and outputs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fflin.base.names import lag_name
from fflin.base.validation import Array
from fflin.control.gain import Gain
from fflin.control.lags import (
    Lags,
    designed_lags,
    lags_of_robot,
    warn_of_lags,
)
from fflin.control.policy import Policy
from fflin.dynamics.state import StateMap
from fflin.robot.robot import Robot
from fflin.uncertainty.lft import LFT


def with_lags_of_loop(lft: LFT, robot: Robot, gain: object) -> LFT:
    """Return the LFT with the lags of the robot, or of the model of the law if it has none.

    Warn if the robot has lags for which the law was not designed.
    """
    outputs = isinstance(gain, Policy) and gain.senses_outputs
    lags = lags_of_robot(robot, StateMap(robot), outputs=outputs)
    if isinstance(gain, Policy | Gain):
        if not lags:
            lags = designed_lags(gain)
        warn_of_lags(gain, lags, "the loop of the robot")
    return with_lags(lft, lags)


def with_lags(lft: LFT, lags: Lags) -> LFT:
    """Return an LFT with lags of its inputs and outputs, as `LinearModel.with_lags`."""
    times = np.array([lags.inputs.get(name, 0.0) for name in lft.input_names])
    lft = _lagging_inputs(lft, times)
    times = np.array([lags.outputs.get(name, 0.0) for name in lft.output_names])
    return _lagging_outputs(lft, times)


def _lagging_inputs(lft: LFT, times: Array) -> LFT:
    """Return an LFT with time constants (nu,) [s] of its inputs."""
    late = np.flatnonzero(times)
    count = len(late)
    if not count:
        return lft
    rates = 1.0 / times[late]
    direct = np.where(times > 0.0, 0.0, 1.0)
    driven = np.zeros((count, len(times)))
    driven[np.arange(count), late] = rates
    nx, nw = len(lft.A), len(lft.C1)
    return replace(
        lft,
        A=np.block(
            [[lft.A, lft.B2[:, late]], [np.zeros((count, nx)), -np.diag(rates)]]
        ),
        B1=np.vstack((lft.B1, np.zeros((count, nw)))),
        B2=np.vstack((lft.B2 * direct, driven)),
        C1=np.hstack((lft.C1, lft.D12[:, late])),
        D12=lft.D12 * direct,
        C2=np.hstack((lft.C2, lft.D22[:, late])),
        D22=lft.D22 * direct,
        state_names=(
            *lft.state_names,
            *(lag_name(lft.input_names[index]) for index in late),
        ),
    )


def _lagging_outputs(lft: LFT, times: Array) -> LFT:
    """Return an LFT with time constants (ny,) [s] of its outputs."""
    late = np.flatnonzero(times)
    count = len(late)
    if not count:
        return lft
    rates = 1.0 / times[late][:, None]
    direct = np.where(times > 0.0, 0.0, 1.0)[:, None]
    selected = np.zeros((len(times), count))
    selected[late, np.arange(count)] = 1.0
    nx, nw = len(lft.A), len(lft.C1)
    return replace(
        lft,
        A=np.block(
            [
                [lft.A, np.zeros((nx, count))],
                [rates * lft.C2[late], -np.diag(rates[:, 0])],
            ]
        ),
        B1=np.vstack((lft.B1, rates * lft.D21[late])),
        B2=np.vstack((lft.B2, rates * lft.D22[late])),
        C1=np.hstack((lft.C1, np.zeros((nw, count)))),
        C2=np.hstack((direct * lft.C2, selected)),
        D21=direct * lft.D21,
        D22=direct * lft.D22,
        state_names=(
            *lft.state_names,
            *(lag_name(lft.output_names[index]) for index in late),
        ),
    )
