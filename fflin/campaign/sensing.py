"""Sensor errors of the states or outputs that a policy reads, sample by sample."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array
from fflin.control.policies import Policy, StateFeedback, bound
from fflin.robot.robot import Robot


class Bound(NamedTuple):
    """A policy that a function makes for a robot."""

    bind: Callable[[Robot], Policy]


def misled(policy: StateFeedback, error: Callable[[float], Array]) -> Bound:
    """Return a state feedback that reads states with an error."""

    def bind(robot: Robot) -> Policy:
        inner = bound(policy, robot)
        return lambda t, q, v: np.asarray(inner(t, q, v)) - policy.K @ error(t)

    return Bound(bind)


def noise_of(bias: Array, deviation: Array, seed: float) -> Callable[[float], Array]:
    """Return the error (ny,) of what is sensed, sample after sample."""
    normal = normals(seed)
    return lambda _: bias + deviation * normal.standard_normal(len(bias))


def normals(seed: float) -> np.random.Generator:
    """Return what draws the noise of a run."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(int(seed))))
