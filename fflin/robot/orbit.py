"""Circular orbits, with the rotating orbital frame in which the motion of a robot is described."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, asdict, dataclass
from typing import Any, TypeAlias

from fflin.base.errors import FflinWarning, InputError, require_known
from fflin.base.validation import (
    ONE_ROTATION,
    Array,
    ArrayLike,
    instance,
    number,
    positive,
)

# Gravitational parameter [m^3/s^2] and equatorial radius [m] of each body. The source for the earth
# is WGS 84. For the other bodies, the sources are the JPL ephemerides (parameters) and IAU 2015
# (radii).
BODIES = {
    "earth": (3.986004418e14, 6378137.0),
    "moon": (4.902800118e12, 1737400.0),
    "mars": (4.282837522e13, 3396190.0),
    "venus": (3.248585920e14, 6051800.0),
    "mercury": (2.203186855e13, 2440530.0),
    "jupiter": (1.266865341e17, 71492000.0),
    "saturn": (3.793120749e16, 60268000.0),
}

# Moments [T m^3] of the centred dipoles that are used as magnetic fields: mu_0 / (4 pi) times the
# magnetic dipole moment. The earth's moment is (29.73 uT) (6371.2 km)^3, with the dipole terms of
# IGRF-14 in 2025. The dipole is along the rotation axis, and points south.
DIPOLES = {"earth": 29.73e-6 * 6371.2e3**3}

# Function of time [s] and of the position (3,) [m] of the origin of the orbital frame from the
# centre of the central body, which returns the magnetic flux density (3,) [T]. Both vectors are in
# equatorial inertial axes: x towards the ascending node, z along the north pole.
MagneticField: TypeAlias = Callable[[float, Array], ArrayLike]

# If an altitude over the earth is below this value [m], it was probably given in km.
_LOWEST = 80e3

_FOLLOWS: Any = None  # default of fields that follow from other fields


@dataclass(frozen=True)
class CircularOrbit:
    r"""Circular orbit about a central body.

    The orbital frame has its origin on the orbit, in free fall, and rotates once per revolution.
    Its axes are one of

    - ``lvlh``: x along the orbit, y opposite to the orbit normal, z towards the central body;
    - ``hill``: x away from the central body, y along the orbit, z along the orbit normal.

    The orbital frame is the world of Pinocchio, so that velocities are relative to this rotating
    frame. The gravity gradient is modelled as linear in the position x relative to the origin: the
    force per mass is :math:`n^2 (3 r r^T - E) x`, with the mean motion n, the unit vector r away
    from the central body, and the identity E. The relative error of this linearisation is of the
    order of ``|x|`` divided by the orbit's radius.

    Parameters
    ----------
    altitude : float, optional
        Height above the surface [m]. An altitude of less than 80 km over the earth causes an
        `FflinWarning`, because the value was probably given in km.
    mean_motion : float, optional
        Mean motion n [rad/s], instead of the altitude.
    body : str
        "earth", "moon", "mars", "venus", "mercury", "jupiter" or "saturn"; any other name
        requires `mu` and `body_radius`.
    mu, body_radius : float, optional
        Gravitational parameter [m^3/s^2] and radius [m] of the central body.
    inclination : float
        Angle [rad] from the equator to the plane of the orbit, from 0 to pi; only the magnetic
        field depends on it.
    argument_of_latitude : float
        Angle [rad] at t = 0 along the orbit, measured from the ascending node.
    field : {"dipole"} or callable, optional
        Magnetic field for inputs of the type `Magnetorquer`. "dipole" is the field of a dipole
        along the rotation axis of the earth. A function of the time t [s] and of the position (3,)
        [m] of the origin of the orbital frame from the centre of the body returns the flux density
        (3,) [T]. Both vectors are in inertial axes with x towards the ascending node and z towards
        the north pole. By default, there is no field.

    Attributes
    ----------
    altitude, mean_motion, body, mu, body_radius, inclination, argument_of_latitude, field
        The parameters; omitted parameters are computed from the others.
    radius : float
        Radius of the orbit [m].
    period : float
        Period 2 pi / n [s].

    Raises
    ------
    InputError
        If altitude and mean motion are both given or both omitted, a value is not positive, the
        orbit is below the surface, or the field or an angle is not valid.
    UnknownNameError
        If the central body is unknown.

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
    inclination: float = 0.0
    argument_of_latitude: float = 0.0
    field: str | MagneticField | None = None

    def __post_init__(self) -> None:
        instance("body", self.body, str, "a name such as 'earth'")
        if (self.mu is None) != (self.body_radius is None):
            raise InputError(
                "only one of mu and body_radius is given; give both or none"
            )
        if (self.altitude is None) == (self.mean_motion is None):
            raise InputError(
                f"altitude is {self.altitude} [m] and mean_motion is {self.mean_motion} [rad/s]; "
                "give exactly one of them"
            )
        if self.mu is None:
            require_known("central body", [self.body], BODIES)
            mu, ground = BODIES[self.body]
        else:
            mu = positive("mu", self.mu)
            ground = positive("body_radius", self.body_radius)
        if self.altitude is None:
            n = positive("mean_motion", self.mean_motion)
            # The radius is (mu / n^2)^(1/3), computed without overflow of n^2.
            altitude = (mu / n) ** (1.0 / 3.0) / n ** (1.0 / 3.0) - ground
        else:
            altitude = number("altitude", self.altitude)
        if not 0.0 < altitude < 1e15:
            raise InputError(
                f"an altitude of {altitude:g} m over {self.body} is not an orbit; give an "
                "altitude above 0 and below 1e15 m, or another mean motion"
            )
        if self.altitude is not None:
            n = math.sqrt(mu / (ground + altitude)) / (ground + altitude)
            # Do not warn if `mu` is given. In this case, the orbit was read from a saved file, or
            # "earth" is the user's name for another body.
            if self.body == "earth" and self.mu is None and altitude < _LOWEST:
                message = f"an altitude of {altitude:.8g} m over earth is too low for an orbit"
                message += "; altitudes are in metres, so write 400 km as 400e3"
                warnings.warn(message, FflinWarning, stacklevel=3)
        known = {
            "altitude": altitude,
            "mean_motion": n,
            "mu": mu,
            "body_radius": ground,
            "inclination": _angle("inclination", self.inclination, 0.0, math.pi),
            "argument_of_latitude": _angle(
                "argument_of_latitude",
                self.argument_of_latitude,
                -ONE_ROTATION,
                ONE_ROTATION,
            ),
        }
        _check_field(self.field, self.body)
        for name, value in known.items():
            object.__setattr__(self, name, value)

    @property
    def radius(self) -> float:
        """Radius of the orbit [m]."""
        return self.body_radius + self.altitude

    @property
    def period(self) -> float:
        """Time of one revolution [s]."""
        return 2.0 * math.pi / self.mean_motion

    def to_json(self) -> str:
        """Return the orbit as JSON text; a field that is a function is left out."""
        parts = asdict(self)
        if callable(self.field):
            parts["field"] = None
        return json.dumps(parts)

    @classmethod
    def from_json(cls, text: str) -> CircularOrbit:
        """Return the orbit from the JSON text of `to_json`, with bit-for-bit equal values."""
        try:
            parts = json.loads(text)
            n = parts.pop("mean_motion")
            orbit = cls(**parts)
        except (AttributeError, KeyError, TypeError, json.JSONDecodeError):
            raise InputError(f"{text!r} is not the JSON text of an orbit") from None
        object.__setattr__(orbit, "mean_motion", positive("mean_motion", n))
        return orbit

    def __str__(self) -> str:
        return (
            f"circular orbit {self.altitude / 1e3:.6g} km over {self.body}, mean motion "
            f"{self.mean_motion:.6g} rad/s, period {self.period / 60.0:.5g} min"
        )


def _angle(name: str, value: object, least: float, most: float) -> float:
    """Return an angle [rad] within limits, or raise `InputError`."""
    angle = number(name, value)
    if not least <= angle <= most:
        raise InputError(
            f"{name} is {angle:g} rad, expected {least:.4g} to {most:.4g}; give radians, such as "
            f"{math.radians(angle):.3g} for {angle:g} deg"
        )
    return angle


def _check_field(field: object, body: str) -> None:
    """Raise `InputError` if a magnetic field is neither known nor a function nor None."""
    if field is None or callable(field):
        return
    if field != "dipole":
        raise InputError(
            f"field is {field!r}, expected 'dipole' or a function of time [s] and position [m] "
            "that returns the flux density (3,) [T]"
        )
    if body not in DIPOLES:
        raise InputError(
            f"the magnetic dipole of {body} is not known; give field= as a function of time and "
            "position"
        )


def checked_orbit(value: object) -> CircularOrbit | None:
    """Convert an orbit, an altitude [m] or a mapping of parameters to an orbit; None stays None."""
    if value is None or isinstance(value, CircularOrbit):
        return value
    if not isinstance(value, Mapping):
        return CircularOrbit(number("orbit", value))
    require_known("part of orbit", value, CircularOrbit.__dataclass_fields__)
    return CircularOrbit(**value)
