"""Standard deviations of the estimates of a steady-state filter."""

from __future__ import annotations

import math

import numpy as np

from fflin.base.names import group_of
from fflin.control.estimator import BIAS, DISTURBANCE, Estimator
from fflin.control.multirate import MultirateEstimator
from fflin.linear.model import LinearModel
from fflin.robot.disturbance import UNITS


def deviations(
    estimator: Estimator | MultirateEstimator, lin: LinearModel
) -> dict[str, tuple[float, str]]:
    """Return {signal: (standard deviation, unit)} of the error of a steady-state filter.

    The prediction has these errors before the measurements of a sample. For a periodic filter, they
    are the largest of a period. Attitudes are in deg. Earlier values of outputs and of commands are
    left out.
    """
    P = np.atleast_3d(estimator.P.T).T
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2).max(axis=0))
    units = dict(zip(lin.state_names, lin.state_units, strict=True))
    sensed = dict(zip(lin.output_names, lin.output_units, strict=True))
    estimated = estimator.estimated or estimator.state_names
    result = dict[str, tuple[float, str]]()
    for name, value in zip(estimator.state_names, sigma.tolist(), strict=True):
        if name not in estimated or name in lin.added:
            continue
        if name.startswith(DISTURBANCE):
            force = group_of(name.removeprefix(DISTURBANCE))
            result[name] = value, UNITS.get(force, "SI")
        elif name.startswith(BIAS):
            result[name] = value, sensed[name.removeprefix(BIAS)]
        elif group_of(name) == "q_b":
            # q_b is half of a small rotation.
            result[name] = math.degrees(2.0 * value), "deg"
        elif name in units:
            result[name] = value, units[name]
    return result
