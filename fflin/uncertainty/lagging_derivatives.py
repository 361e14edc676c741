"""Derivatives of models with lags with respect to the parameters of the robot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fflin.base.validation import Array
from fflin.dynamics.integrators import held_derivatives
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot
from fflin.uncertainty.derivatives import ModelDerivatives
from fflin.uncertainty.parameters import Parameter


class LaggingDerivatives(ModelDerivatives):
    """Derivatives of a model with lags, from the derivatives of the model without lags.

    `source` is the model `lin` in continuous time.
    """

    def __init__(self, lin: LinearModel, robot: Robot, source: LinearModel) -> None:
        plain = source.undelayed
        super().__init__(plain, robot, plain)
        self._lagging = source
        self._dt = lin.dt

    def over(self, parameters: Sequence[Parameter]) -> tuple[Array, ...]:
        """Return dA, dB, dC, dD, df0 and dy0 (P, ..), one entry for each of P parameters."""
        derivatives = super().over(parameters)
        derivatives = _with_lagging_inputs(derivatives, self._lagging.lag)
        derivatives = _with_lagging_outputs(derivatives, self._lagging.output_lag)
        if not self._dt:
            return derivatives
        dA, dB, dC, dD, df0, dy0 = derivatives
        driven = np.column_stack((self._lagging.B, self._lagging.f0))
        given = np.concatenate((dB, df0[..., None]), axis=2)
        dA, held = held_derivatives(self._lagging.A, driven, self._dt, dA, given)
        return dA, held[..., :-1], dC, dD, held[..., -1], dy0


def _with_lagging_inputs(
    derivatives: tuple[Array, ...], lags: Array
) -> tuple[Array, ...]:
    """Return the derivatives with the inputs of time constants `lags` (nu,) [s] as states.

    The equations of these states do not depend on the parameters.
    """
    dA, dB, dC, dD, df0, dy0 = derivatives
    late = np.flatnonzero(lags)
    count = len(late)
    direct = np.where(lags > 0.0, 0.0, 1.0)
    dA = np.concatenate((dA, dB[..., late]), axis=2)
    dC = np.concatenate((dC, dD[..., late]), axis=2)
    added = ((0, 0), (0, count), (0, 0))
    return (
        np.pad(dA, added),
        np.pad(dB * direct, added),
        dC,
        dD * direct,
        np.pad(df0, added[:2]),
        dy0,
    )


def _with_lagging_outputs(
    derivatives: tuple[Array, ...], lags: Array
) -> tuple[Array, ...]:
    """Return the derivatives with the outputs of time constants `lags` (ny,) [s] as states."""
    dA, dB, dC, dD, df0, dy0 = derivatives
    late = np.flatnonzero(lags)
    rates = 1.0 / lags[late]
    direct = np.where(lags > 0.0, 0.0, 1.0)
    added = ((0, 0), (0, 0), (0, len(late)))
    dA = np.concatenate((dA, rates[:, None] * dC[:, late]), axis=1)
    return (
        np.pad(dA, added),
        np.concatenate((dB, rates[:, None] * dD[:, late]), axis=1),
        np.pad(direct[:, None] * dC, added),
        direct[:, None] * dD,
        np.concatenate((df0, rates * dy0[:, late]), axis=1),
        direct * dy0,
    )
