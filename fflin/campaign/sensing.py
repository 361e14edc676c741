"""Errors of what a policy reads, sample after sample."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fflin.base.validation import Array
from fflin.control.policies import StateFeedback, bound
from fflin.robot.robot import Robot


@dataclass(frozen=True)
class Misled:
    """A state feedback that reads states with an error."""

    policy: StateFeedback
    error: Callable[[float], Array]

    def bind(self, robot: Robot) -> Callable[[float, Array, Array], Array]:
        """Return the policy for a robot."""
        inner, K = bound(self.policy, robot), self.policy.K
        return lambda t, q, v: np.asarray(inner(t, q, v)) - K @ self.error(t)


@dataclass(frozen=True)
class Designed:
    """A policy for a robot as it should be."""

    policy: Any
    robot: Robot

    def bind(self, _: Robot) -> Any:
        """Return the policy for the other robot."""
        return bound(self.policy, self.robot)


def noise_of(bias: Array, deviation: Array, seed: float) -> Callable[[float], Array]:
    """Return the error (ny,) of what is sensed, sample after sample."""
    normal = normals(seed)
    return lambda _: bias + deviation * normal.standard_normal(len(bias))


def normals(seed: float) -> np.random.Generator:
    """Return what draws the noise of a run."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(int(seed))))
