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


def ellipse(e, n=N, **options):
    """An elliptic orbit of a mean motion and a semi-major axis of 1e6 m."""
    return fflin.EllipticOrbit(
        perigee=1e6 * (1.0 - e) - 1.0,
        eccentricity=e,
        body="x",
        mu=n**2 * 1e18,
        body_radius=1.0,
        **options,
    )


def in_ellipse(robot, e, n=N, **options):
    """The robot in an elliptic orbit of a mean motion."""
    return robot.replace(orbit=ellipse(e, n, **options))
