"""Orbits that several test files share."""

import fflin

N = 0.3  # [rad/s], so fast that it is seen beside the rest


def in_orbit(robot, n=N):
    """The robot in an orbit of a mean motion, at whose radius no test is too large."""
    return robot.replace(
        orbit=fflin.CircularOrbit(
            mean_motion=n, body="x", mu=n**2 * 1e18, body_radius=1.0
        )
    )
