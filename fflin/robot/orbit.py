"""Orbits, with the rotating orbital frame in which the motion of a robot is described."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, asdict, dataclass, fields
from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias, TypeVar

from fflin.base import html
from fflin.base.errors import InputError, require_known
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
# IGRF-14 in 2025. The dipole points south.
DIPOLES = {"earth": 29.73e-6 * 6371.2e3**3}


class MagneticPole(NamedTuple):
    """Place where the axis of a dipole leaves the northern hemisphere, and its motion."""

    colatitude: float  # angle [rad] from the rotation axis of the body
    longitude: float  # geographic longitude [rad], positive eastwards
    rate: float  # angular velocity [rad/s] of the body relative to inertial space


# Dipole terms g10, g11 and h11 [nT] of IGRF-14 in 2025, from which the pole follows, and the
# angular velocity of the earth of WGS 84.
_G10, _G11, _H11 = -29350.0, -1410.3, 4545.5
MAGNETIC_POLES = {
    "earth": MagneticPole(
        math.atan2(math.hypot(_G11, _H11), -_G10), math.atan2(-_H11, -_G11), 7.292115e-5
    )
}

# Function of time [s] and of the position (3,) [m] of the origin of the orbital frame from the
# centre of the central body, which returns the magnetic flux density (3,) [T]. Both vectors are in
# equatorial inertial axes: x towards the ascending node, z along the north pole.
MagneticField: TypeAlias = Callable[[float, Array], ArrayLike]

# Names of the fields that are not functions.
DIPOLE, TILTED_DIPOLE = "dipole", "tilted_dipole"

# If an altitude over the earth is below this value [m], it was probably given in km.
_LOWEST = 80e3

# Largest eccentricity. For larger ones, r at perigee loses digits by cancellation.
_LARGEST_ECCENTRICITY = 0.99

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
        Height above the surface [m]. An altitude of less than 80 km over the earth is refused,
        because the value was probably given in km.
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
    field : {"dipole", "tilted_dipole"} or callable, optional
        Magnetic field for inputs of the type `Magnetorquer`. "dipole" is the field of a dipole
        along the rotation axis of the earth. "tilted_dipole" is the field of a dipole through the
        geomagnetic poles, which rotates with the earth. A function of the time t [s] and of the
        position (3,) [m] of the origin of the orbital frame from the centre of the body returns the
        flux density (3,) [T]. Both vectors are in inertial axes with x towards the ascending node
        and z towards the north pole. By default, there is no field.
    node_longitude : float
        Geographic longitude [rad] of the ascending node at t = 0, positive eastwards; only the
        tilted dipole depends on it.

    Attributes
    ----------
    altitude, mean_motion, body, mu, body_radius, inclination, argument_of_latitude, field,
    node_longitude
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
    node_longitude: float = 0.0

    def __post_init__(self) -> None:
        mu, ground = _central_body(self.body, self.mu, self.body_radius)
        if (self.altitude is None) == (self.mean_motion is None):
            raise InputError(
                f"altitude is {self.altitude} [m] and mean_motion is {self.mean_motion} [rad/s]; "
                "give exactly one of them"
            )
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
            # If `mu` is given, the orbit was read from a saved file, or "earth" is the user's name
            # for another body.
            if self.body == "earth" and self.mu is None:
                _require_above_air("an altitude", altitude)
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
            "node_longitude": _longitude(self.node_longitude),
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
        return _json_text(self)

    @classmethod
    def from_json(cls, text: str) -> CircularOrbit:
        """Return the orbit from the JSON text of `to_json`, with bit-for-bit equal values."""
        return _restored(cls, text, "mean_motion")

    def _repr_html_(self) -> str:
        latitude = _degrees(self.argument_of_latitude)
        return _card(self, {"argument of latitude at t = 0": latitude})

    def __str__(self) -> str:
        return (
            f"circular orbit {self.altitude / 1e3:.6g} km over {self.body}, mean motion "
            f"{self.mean_motion:.6g} rad/s, period {self.period / 60.0:.5g} min"
        )


def _degrees(angle: float) -> str:
    return f"{math.degrees(angle):.6g} deg"


def _field_text(field: str | MagneticField | None) -> str:
    """Return a magnetic field as text."""
    if field is None:
        return "none"
    return field if isinstance(field, str) else "function"


def _card(orbit: CircularOrbit | EllipticOrbit, rows: Mapping[str, str]) -> str:
    """Return a card for notebooks; `rows` are facts that only this type of orbit has."""
    facts = {
        "period": f"{orbit.period / 60.0:.6g} min",
        "mean motion": f"{orbit.mean_motion:.6g} rad/s",
        "inclination": _degrees(orbit.inclination),
        **rows,
        "magnetic field": _field_text(orbit.field),
    }
    table = html.table([["", ""], *([*fact] for fact in facts.items())], "ll")
    return html.card(type(orbit).__name__, str(orbit).partition(", ")[0], table)


def _central_body(
    body: object, mu: float | None, body_radius: float | None
) -> tuple[float, float]:
    """Return the gravitational parameter [m^3/s^2] and the radius [m] of the central body."""
    name = instance("body", body, str, "a name such as 'earth'")
    if (mu is None) != (body_radius is None):
        raise InputError("only one of mu and body_radius is given; give both or none")
    if mu is None:
        require_known("central body", [name], BODIES)
        return BODIES[name]
    return positive("mu", mu), positive("body_radius", body_radius)


def _require_above_air(what: str, altitude: float) -> None:
    """Raise `InputError` if no satellite orbits the earth at an altitude, probably given in km."""
    if altitude >= _LOWEST:
        return
    kilometres = 400.0
    if altitude >= _LOWEST / 1e3:
        kilometres = altitude
    raise InputError(
        f"{what} of {altitude:.8g} m over earth is too low for an orbit, expected at least "
        f"{_LOWEST / 1e3:g} km; altitudes are in metres, so write {kilometres:.8g} km as "
        f"{kilometres:.8g}e3"
    )


class OrbitState(NamedTuple):
    """Rotation and gravity gradient of an orbital frame at one time."""

    rate: float  # d theta/dt [rad/s] of the angle theta from the perigee
    rate_change: float  # d^2 theta/dt^2 [rad/s^2]
    gradient: float  # mu / r^3 [1/s^2]
    gradient_change: float  # its derivative [1/s^3]
    radius: float  # r [m]
    angle: float  # theta [rad], which grows by 2 pi in each revolution


@dataclass(frozen=True, kw_only=True)
class EllipticOrbit:
    r"""Elliptic orbit about a central body; the model of the robot then depends on time.

    The orbital frame is defined as in `CircularOrbit`: its origin moves on the orbit, in free fall,
    and its axes are ``lvlh`` (default) or ``hill``. But in ``lvlh``, x is along the orbit only at
    perigee and apogee. Elsewhere, x is perpendicular to z, which points towards the central body.
    With the true anomaly :math:`\theta` and the radius r, the frame rotates at
    :math:`\Omega = \dot\theta \hat z` about the orbit normal, and the gravity gradient is
    :math:`\mu/r^3 (3 \hat r \hat r^T - E)`.

    Parameters
    ----------
    perigee : float
        Height [m] of the lowest point of the orbit above the surface.
    apogee : float, optional
        Height [m] of the highest point of the orbit above the surface.
    eccentricity : float, optional
        Eccentricity e of the orbit, 0 <= e < 1, instead of the apogee.
    inclination : float
        Angle [rad] between the orbital plane and the equator, 0 to pi; only the magnetic field
        depends on it.
    argument_of_perigee : float
        Angle [rad] from the ascending node to the perigee; only the magnetic field depends on it.
    anomaly : float
        True anomaly [rad] at t = 0: the angle from the perigee to the robot.
    body : str
        "earth", "moon", "mars", "venus", "mercury", "jupiter" or "saturn"; any other name
        requires `mu` and `body_radius`.
    mu, body_radius : float, optional
        Gravitational parameter [m^3/s^2] and radius [m] of the central body.
    field, node_longitude
        Magnetic field and longitude of the ascending node, as in `CircularOrbit`.

    Attributes
    ----------
    perigee, apogee, eccentricity, inclination, argument_of_perigee, anomaly, body, mu, body_radius
    field, node_longitude
        The parameters; omitted parameters are computed from the others.
    semi_major_axis : float
        Semi-major axis [m].
    mean_motion : float
        Mean motion n [rad/s].
    period : float
        Period 2 pi / n [s].

    Raises
    ------
    InputError
        If apogee and eccentricity are both given or both omitted, an angle is out of range, the
        orbit is not an ellipse, it is below the surface, or the field is not valid.
    UnknownNameError
        If the central body is unknown.

    Examples
    --------
    >>> orbit = fflin.EllipticOrbit(perigee=400e3, apogee=35_786e3)
    >>> round(orbit.eccentricity, 3), round(orbit.period / 3600, 2)  # h
    (0.723, 10.58)
    >>> robot = fflin.load("cubesat", orbit=orbit)
    >>> lin = fflin.linearize(robot, t=1800.0)  # half an hour after perigee
    >>> lin.t
    1800.0
    """

    perigee: float
    apogee: float = _FOLLOWS
    eccentricity: float = _FOLLOWS
    inclination: float = 0.0
    argument_of_perigee: float = 0.0
    anomaly: float = 0.0
    body: str = "earth"
    mu: float = _FOLLOWS
    body_radius: float = _FOLLOWS
    field: str | MagneticField | None = None
    node_longitude: float = 0.0

    def __post_init__(self) -> None:
        mu, ground = _central_body(self.body, self.mu, self.body_radius)
        if (self.apogee is None) == (self.eccentricity is None):
            raise InputError(
                f"apogee is {self.apogee} [m] and eccentricity is {self.eccentricity}; give "
                "exactly one of them"
            )
        low = number("perigee", self.perigee)
        if not 0.0 < low < 1e15:
            raise InputError(
                f"a perigee of {low:g} m over {self.body} is not on an orbit; give a height above "
                "0 and below 1e15 m"
            )
        nearest = ground + low
        if self.apogee is None:
            e = number("eccentricity", self.eccentricity)
            _require_ellipse(e)
            high = (ground + low) * (1.0 + e) / (1.0 - e) - ground if e else low
        else:
            high = number("apogee", self.apogee)
            if not low <= high < 1e18:
                raise InputError(
                    f"apogee is {high:g} m, expected at least the perigee of {low:g} m, and below "
                    "1e18 m"
                )
            e = (high - low) / (2.0 * ground + high + low)
            _require_ellipse(e)
        angles = {
            "inclination": (0.0, math.pi),
            "argument_of_perigee": (-2.0 * math.pi, 2.0 * math.pi),
            "anomaly": (-2.0 * math.pi, 2.0 * math.pi),
        }
        for name, (least, largest) in angles.items():
            angle = _angle(name, getattr(self, name), least, largest)
            object.__setattr__(self, name, angle)
        if self.body == "earth" and self.mu is None:
            _require_above_air("a perigee", low)
        known = {
            "perigee": low,
            "apogee": high,
            "eccentricity": e,
            "mu": mu,
            "body_radius": ground,
            "node_longitude": _longitude(self.node_longitude),
        }
        _check_field(self.field, self.body)
        for name, value in known.items():
            object.__setattr__(self, name, value)
        if not math.isfinite(nearest / (1.0 - e)):
            raise InputError("the orbit is too large to be computed")

    @property
    def semi_major_axis(self) -> float:
        """Semi-major axis [m]."""
        return (self.body_radius + self.perigee) / (1.0 - self.eccentricity)

    @property
    def mean_motion(self) -> float:
        """Mean motion n [rad/s]."""
        a = self.semi_major_axis
        return math.sqrt(self.mu / a) / a

    @property
    def period(self) -> float:
        """Time of one revolution [s]."""
        return 2.0 * math.pi / self.mean_motion

    @property
    def mean_anomaly(self) -> float:
        """Mean anomaly [rad] at t = 0."""
        return _mean_anomaly(self.anomaly, self.eccentricity)

    def at(self, t: float) -> OrbitState:
        """Return the rotation and the gravity gradient of the orbital frame at time t [s]."""
        t = number("t", t)
        e = self.eccentricity
        n = self.mean_motion
        mean = self.mean_anomaly + n * t
        revolutions = round(mean / (2.0 * math.pi))
        E = eccentric_anomaly(mean - 2.0 * math.pi * revolutions, e)
        # r / a, and (dr/dt) / r
        ratio = 1.0 - e * math.cos(E)
        climb = n * e * math.sin(E) / (ratio * ratio)
        rate = n * math.sqrt(1.0 - e * e) / (ratio * ratio)
        gradient = n * n / (ratio * ratio * ratio)
        theta = true_anomaly(E, e) + 2.0 * math.pi * revolutions
        return OrbitState(
            rate=rate,
            rate_change=-2.0 * climb * rate,
            gradient=gradient,
            gradient_change=-3.0 * climb * gradient,
            radius=self.semi_major_axis * ratio,
            angle=theta,
        )

    def to_json(self) -> str:
        """Return the orbit as JSON text; a field that is a function is left out."""
        return _json_text(self)

    @classmethod
    def from_json(cls, text: str) -> EllipticOrbit:
        """Return the orbit from the JSON text of `to_json`, with bit-for-bit equal values."""
        return _restored(cls, text, "apogee")

    def _repr_html_(self) -> str:
        rows = {
            "eccentricity": f"{self.eccentricity:.6g}",
            "argument of perigee": _degrees(self.argument_of_perigee),
            "true anomaly at t = 0": _degrees(self.anomaly),
        }
        return _card(self, rows)

    def __str__(self) -> str:
        return (
            f"elliptic orbit {self.perigee / 1e3:.6g} x {self.apogee / 1e3:.6g} km over "
            f"{self.body}, eccentricity {self.eccentricity:.5g}, period "
            f"{self.period / 60.0:.5g} min, true anomaly {math.degrees(self.anomaly):.4g} deg at "
            "t = 0"
        )


Orbit: TypeAlias = CircularOrbit | EllipticOrbit
_Kind = TypeVar("_Kind", CircularOrbit, EllipticOrbit)


def _json_text(orbit: Orbit) -> str:
    """Return an orbit as JSON text; a field that is a function is left out."""
    parts = asdict(orbit)
    if callable(orbit.field):
        parts["field"] = None
    return json.dumps(parts)


def _restored(kind: type[_Kind], text: str, derived: str) -> _Kind:
    """Return the orbit from its JSON text, with its own value of the field `derived`.

    The constructor computes this field from the others, with a rounding error.
    """
    try:
        parts = json.loads(text)
        value = parts.pop(derived)
        orbit = kind(**parts)
    except (AttributeError, KeyError, TypeError, json.JSONDecodeError):
        raise InputError(f"{text!r} is not the JSON text of an orbit") from None
    object.__setattr__(orbit, derived, positive(derived, value))
    return orbit


def _require_ellipse(e: float) -> None:
    if not 0.0 <= e <= _LARGEST_ECCENTRICITY:
        raise InputError(
            f"the eccentricity is {e:g}, expected 0 to {_LARGEST_ECCENTRICITY:g}"
        )


def eccentric_anomaly(mean: float, e: float) -> float:
    """Solve Kepler's equation E - e sin E = M for the eccentric anomaly E [rad].

    The root is between M - e and M + e. Each step of Newton's method that leaves the interval
    around the root is replaced by a bisection, so the iteration cannot fail. M is `mean` [rad].
    """
    low = mean - e
    high = mean + e
    E = mean + e * math.sin(mean)
    for _ in range(_KEPLER_STEPS):
        residual = E - e * math.sin(E) - mean
        if residual > 0.0:
            high = min(high, E)
        else:
            low = max(low, E)
        step = residual / (1.0 - e * math.cos(E))
        following = E - step
        if not low <= following <= high:
            following = 0.5 * (low + high)
        if abs(following - E) <= 1e-16 * (1.0 + abs(E)):
            return following
        E = following
    return E


# Bisection alone needs about 55 steps for all digits.
_KEPLER_STEPS = 80


def true_anomaly(E: float, e: float) -> float:
    """Return the true anomaly [rad] for the eccentric anomaly E [rad], both in [-pi, pi]."""
    return 2.0 * math.atan2(
        math.sqrt(1.0 + e) * math.sin(0.5 * E), math.sqrt(1.0 - e) * math.cos(0.5 * E)
    )


@lru_cache(maxsize=64)
def _mean_anomaly(theta: float, e: float) -> float:
    """Return the mean anomaly [rad] for the true anomaly theta [rad]."""
    revolutions = round(theta / (2.0 * math.pi))
    rest = theta - 2.0 * math.pi * revolutions
    E = 2.0 * math.atan2(
        math.sqrt(1.0 - e) * math.sin(0.5 * rest),
        math.sqrt(1.0 + e) * math.cos(0.5 * rest),
    )
    return E - e * math.sin(E) + 2.0 * math.pi * revolutions


def orbit_from_json(text: str) -> Orbit:
    """Return a circular or an elliptic orbit from the JSON text of its `to_json`."""
    kind = EllipticOrbit if '"perigee"' in text else CircularOrbit
    return kind.from_json(text)


def is_elliptic(orbit: Orbit | None) -> bool:
    """Return whether models in an orbit depend on time."""
    return isinstance(orbit, EllipticOrbit)


def _angle(name: str, value: object, least: float, most: float) -> float:
    """Return an angle [rad] within limits, or raise `InputError`."""
    angle = number(name, value)
    if not least <= angle <= most:
        raise InputError(
            f"{name} is {angle:g} rad, expected {least:.4g} to {most:.4g}; give radians, such as "
            f"{math.radians(angle):.3g} for {angle:g} deg"
        )
    return angle


def _longitude(value: object) -> float:
    """Return a geographic longitude [rad], or raise `InputError`."""
    return _angle("node_longitude", value, -ONE_ROTATION, ONE_ROTATION)


def _check_field(field: object, body: str) -> None:
    """Raise `InputError` if a magnetic field is neither known nor a function nor None."""
    if field is None or callable(field):
        return
    if not isinstance(field, str) or field not in (DIPOLE, TILTED_DIPOLE):
        raise InputError(
            f"field is {field!r}, expected 'dipole', 'tilted_dipole' or a function of time [s] and "
            "position [m] that returns the flux density (3,) [T]"
        )
    if body not in DIPOLES:
        raise InputError(
            f"the magnetic dipole of {body} is not known; give field= as a function of time and "
            "position"
        )


def checked_orbit(value: object) -> Orbit | None:
    """Convert an orbit, an altitude [m] or a mapping of parameters to an orbit; None stays None."""
    if value is None or isinstance(value, CircularOrbit | EllipticOrbit):
        return value
    if not isinstance(value, Mapping):
        return CircularOrbit(number("orbit", value))
    # A mapping with one of these names describes an elliptic orbit.
    elliptic = {"perigee", "apogee", "eccentricity"} & set(value)
    if elliptic:
        known = [item.name for item in fields(EllipticOrbit)]
        require_known("part of orbit", value, known)
        if "perigee" not in value:
            raise InputError(
                f"the orbit has {sorted(elliptic)[0]} but no perigee; give perigee [m]"
            )
        return EllipticOrbit(**value)
    require_known("part of orbit", value, CircularOrbit.__dataclass_fields__)
    return CircularOrbit(**value)
