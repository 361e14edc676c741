"""Time in which a satellite detumbles."""

from __future__ import annotations

from fflin.base.errors import InputError
from fflin.base.validation import instance, positive
from fflin.simulation.motion import Motion
from fflin.simulation.rotation_rates import RotationRates


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
    rates = RotationRates(motion.t, motion.q, motion.v, motion.frame, orbit)
    return rates.slow_after(factor * orbit.mean_motion)
