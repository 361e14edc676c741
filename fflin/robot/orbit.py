"""A circular orbit, in whose rotating frame a robot flies."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping
from dataclasses import KW_ONLY, asdict, dataclass
from typing import Any

from fflin.base.errors import FflinWarning, InputError, unknown
from fflin.base.validation import number

# Gravitational parameter [m^3/s^2] and equatorial radius [m]: JPL DE440, IAU 2015.
BODIES = {
    "earth": (3.986004418e14, 6378137.0),
    "moon": (4.902800118e12, 1737400.0),
    "mars": (4.282837522e13, 3396190.0),
    "venus": (3.248585920e14, 6051800.0),
    "mercury": (2.203186855e13, 2440530.0),
    "jupiter": (1.266865341e17, 71492000.0),
    "saturn": (3.793120749e16, 60268000.0),
}

# Altitudes [m] below the first are doubtful, of bodies without air below the second; those of low
# earth orbits, whose radius may be given.
_AIR, _BARE, _LOW_ORBITS = 80e3, {"moon": 1e3, "mercury": 1e3}, (150e3, 1000e3)

_FOLLOWS: Any = None  # from the others


@dataclass(frozen=True)
class CircularOrbit:
    r"""A circular orbit about a central body.

    Its point falls freely, and a robot of this orbit is described relative to a frame that goes
    and turns with it: ``lvlh`` (x along the orbit, y against its normal, z to the body) or
    ``hill`` (x away from the body, y along, z normal). Pinocchio's world is that frame, and
    velocities are relative to it. What pulls at distance x from the point is linear in x,
    :math:`n^2 (3 r r^T - E) x` per mass, with r the unit vector away from the body: the error is
    of the order of x over the orbit's radius.

    Parameters
    ----------
    altitude : float, optional
        Above the surface [m]; `FflinWarning` where kilometres or a radius seem to be meant.
    mean_motion : float, optional
        n [rad/s], instead of the altitude.
    body : str
        "earth", "moon", "mars", "venus", "mercury", "jupiter", "saturn"; or any name, for a body
        whose `mu` and `body_radius` are given.
    mu, body_radius : float, optional
        The body's gravitational parameter [m^3/s^2] and radius [m].

    Attributes
    ----------
    altitude, mean_motion, body, mu, body_radius
        As above, each of them known.
    radius : float
        Of the orbit [m].
    period : float
        2 pi / n [s].

    Raises
    ------
    InputError
        If not just one of altitude and mean motion is given, a value is not positive, or the orbit
        is below the surface.
    UnknownNameError
        If there is no such body.

    Examples
    --------
    >>> orbit = fflin.CircularOrbit(altitude=700e3)
    >>> round(orbit.period)  # s
    5926
    >>> robot = fflin.load("cubesat", orbit=orbit)
    >>> lin = fflin.linearize(robot, frame="hill")
    >>> round(float(lin.A[9, 3] / orbit.mean_motion**2), 6)  # 3, of Hill's equations
    3.0
    """

    altitude: float = _FOLLOWS
    _: KW_ONLY
    mean_motion: float = _FOLLOWS
    body: str = "earth"
    mu: float = _FOLLOWS
    body_radius: float = _FOLLOWS

    def __post_init__(self) -> None:
        if not isinstance(self.body, str):
            raise InputError(f"body is {self.body!r}, expected a name such as 'earth'")
        if (self.mu is None) != (self.body_radius is None):
            raise InputError("an orbit about another body needs both mu and body_radius; give both")
        if self.mu is None and self.body not in BODIES:
            raise unknown("central body", self.body, BODIES)
        given = [value for value in (self.altitude, self.mean_motion) if value is not None]
        if len(given) != 1:
            said = "both are" if given else "neither is"
            raise InputError(
                f"an orbit has an altitude [m] or a mean motion [rad/s], and {said} given; give one"
            )
        size = self.mu, self.body_radius
        mu, ground = (
            BODIES[self.body]
            if self.mu is None
            else (_positive(name, x) for name, x in zip(("mu", "body_radius"), size, strict=True))
        )
        n = self.mean_motion
        if self.altitude is not None:
            altitude = number("altitude", self.altitude)
        else:
            n = _positive("mean_motion", n)
            altitude = (mu / n) ** (1.0 / 3.0) / n ** (1.0 / 3.0) - ground
        if not 0.0 < altitude < 1e15:
            raise InputError(
                f"an altitude of {altitude:g} m over {self.body} is "
                f"{'no orbit about it' if altitude > 0.0 else 'at or below the surface'}; expected "
                f"more than 0 and a mean motion below {math.sqrt(mu / ground) / ground:.4g} rad/s"
            )
        if self.altitude is not None:
            n = math.sqrt(mu / (ground + altitude)) / (ground + altitude)
            above, said = altitude - ground, ""
            if altitude < _BARE.get(self.body, _AIR):
                said = "altitudes are in metres, 400 km is 400e3"
            elif self.body == "earth" and _LOW_ORBITS[0] <= above <= _LOW_ORBITS[1]:
                said = f"if that is the orbit's radius, its altitude is {above:.8g} m"
            if said and self.mu is None:  # not of an asteroid, nor of an orbit that was saved
                said = f"an altitude of {altitude:.8g} m over {self.body}: {said}"
                warnings.warn(said, FflinWarning, stacklevel=3)
        known = {"altitude": altitude, "mean_motion": n, "mu": mu, "body_radius": ground}
        for name, value in known.items():
            object.__setattr__(self, name, value)

    @property
    def radius(self) -> float:
        """Of the orbit [m]."""
        return self.body_radius + self.altitude

    @property
    def period(self) -> float:
        """Time of one revolution [s]."""
        return 2.0 * math.pi / self.mean_motion

    def to_json(self) -> str:
        """Return it as text."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> CircularOrbit:
        """Return the same one, to the last bit, of its text."""
        parts = json.loads(text)
        n = parts.pop("mean_motion")
        orbit = cls(**parts)
        object.__setattr__(orbit, "mean_motion", _positive("mean_motion", n))
        return orbit

    def __str__(self) -> str:
        return (
            f"circular orbit {self.altitude / 1e3:.6g} km over {self.body}, mean motion "
            f"{self.mean_motion:.6g} rad/s, period {self.period / 60.0:.5g} min"
        )


def checked_orbit(value: Any) -> CircularOrbit | None:
    """Return the orbit that a field says: one, its altitude [m], its parts by name, or none."""
    if value is None or isinstance(value, CircularOrbit):
        return value
    if not isinstance(value, Mapping):
        return CircularOrbit(number("orbit", value))
    for name in value:
        if name not in CircularOrbit.__dataclass_fields__:
            raise unknown("part of orbit", name, CircularOrbit.__dataclass_fields__)
    return CircularOrbit(**value)


def _positive(name: str, value: Any) -> float:
    found = number(name, value)
    if not found > 0.0:
        raise InputError(f"{name} is {found:g}, expected more than 0")
    return found
