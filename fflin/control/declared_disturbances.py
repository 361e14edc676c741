"""Disturbances that a robot file declares, as random walks that a filter estimates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fflin.robot.disturbance import terms_of
from fflin.robot.robot import Robot

# Time [s] within which the random walk of a disturbance reaches its declared size.
_WALK = 100.0


class DeclaredDisturbances(NamedTuple):
    """Intensities of random walks, and frequencies [Hz], by the group of the force."""

    intensities: dict[str, float]
    frequencies: dict[str, float]


def declared_disturbances(robot: Robot) -> DeclaredDisturbances:
    """Return the random walks of the torques and forces in the disturbance of a robot.

    The intensity of a group, such as tau_b, follows from its largest component.
    """
    sizes = dict[str, float]()
    frequencies = dict[str, float]()
    for name, term in terms_of(robot.disturbance):
        size = float(np.abs((term.constant, term.amplitude)).max())
        if size:
            sizes[name] = max(size, sizes.get(name, 0.0))
        if term.periodic:
            frequencies[name] = term.frequency
    intensities = {name: size**2 / _WALK for name, size in sizes.items()}
    return DeclaredDisturbances(intensities, frequencies)
