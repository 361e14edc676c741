"""Time in which a satellite detumbles."""

from __future__ import annotations

import math

import numpy as np

from fflin.base.errors import InputError
from fflin.base.rotation import rotation_matrices
from fflin.base.validation import Array, instance, positive
from fflin.dynamics.coordinates import PIN_ANGULAR
from fflin.dynamics.orbital import normal_of
from fflin.simulation.motion import Motion


def detumbling_time(motion: Motion, factor: float = 4.0) -> float:
    """Return the time after which a satellite rotates slowly, averaged over an orbit.

    The rate is the magnitude of the angular velocity of the base relative to inertial space. Its
    mean over the orbital period that ends at the time t is compared with the orbital rate. Under
    the law `BDot`, this mean approaches about twice the orbital rate.

    Parameters
    ----------
    motion : Motion
        Motion in orbit, longer than one orbital period.
    factor : float
        Bound of the mean rate, divided by the orbital rate.

    Returns
    -------
    float
        Earliest time t [s], from one period on, at which the mean rate is below the bound;
        infinite if there is none.

    Raises
    ------
    InputError
        If the motion is not in orbit, or the factor is not positive.

    Examples
    --------
    >>> robot = fflin.load("cubesat", orbit=500e3)
    >>> motion = fflin.simulate(robot, duration=1.01 * robot.orbit.period, dt=10.0)
    >>> round(fflin.detumbling_time(motion) / robot.orbit.period, 2)  # at rest in the frame
    1.0
    """
    instance("motion", motion, Motion, "a Motion, as fflin.simulate returns it")
    factor = positive("factor", factor)
    orbit = motion.orbit
    if orbit is None:
        raise InputError(
            "the motion is not in orbit; simulate a robot with an orbit, such as "
            "CircularOrbit(500e3)"
        )
    rates = np.linalg.norm(_inertial_rates(motion), axis=1)
    # Integral of the rate from the start, and its mean over the period before each row.
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(motion.t)
    angle = np.append(0.0, np.cumsum(steps))
    start = motion.t - orbit.period
    means = (angle - np.interp(start, motion.t, angle)) / orbit.period
    slow = (start >= 0.0) & (means < factor * orbit.mean_motion)
    if not slow.any():
        return math.inf
    return float(motion.t[slow.argmax()])


def _inertial_rates(motion: Motion) -> Array:
    """Return the angular velocities (N, 3) relative to inertial space, in base axes."""
    assert motion.orbit is not None
    normal = normal_of(motion.frame)
    R = rotation_matrices(motion.q[:, 3:7])
    rates: Array = motion.v[:, PIN_ANGULAR] + motion.orbit.mean_motion * normal @ R
    return rates
