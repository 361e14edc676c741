"""Flat plates: surfaces of a satellite on which drag and solar pressure act."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeAlias

from fflin.base.errors import InputError, require_known
from fflin.base.validation import number, positive, truth
from fflin.robot.inputs import three_numbers

Vector3: TypeAlias = tuple[float, float, float]

# Pressure [N/m^2] of sunlight that is absorbed, at the distance of the earth from the sun: the
# solar constant of 1361 W/m^2 divided by the speed of light.
SOLAR_PRESSURE = 4.54e-6


@dataclass(frozen=True)
class FlatPlate:
    """Flat plate on the base, on which drag and solar pressure act, see (11.7) and (11.8).

    Attributes
    ----------
    area : float
        Area [m^2].
    normal : tuple of float (3,)
        Direction out of the exposed face, in base axes. Its length is ignored.
    position : tuple of float (3,)
        Centre of pressure [m] from the origin of the base, in base axes.
    two_sided : bool
        Whether both faces are exposed.
    density : float
        Density [kg/m^3] of the atmosphere; 0 without drag.
    drag_coefficient : float
        Drag coefficient; 2.2 by default.
    velocity : tuple of float (3,)
        Velocity [m/s] relative to the atmosphere, in inertial axes. In orbit, by default, it is the
        velocity of the orbit.
    sun : tuple of float (3,)
        Direction to the sun, in inertial axes; zero without solar pressure.
    specular, diffuse : float
        Fractions of the sunlight that are reflected specularly and diffusely.
    solar_pressure : float
        Pressure [N/m^2] of absorbed sunlight; 4.54e-6 by default, as near the earth.
    """

    area: float
    normal: Vector3
    position: Vector3 = (0.0, 0.0, 0.0)
    two_sided: bool = False
    density: float = 0.0
    drag_coefficient: float = 2.2
    velocity: Vector3 = (0.0, 0.0, 0.0)
    sun: Vector3 = (0.0, 0.0, 0.0)
    specular: float = 0.0
    diffuse: float = 0.0
    solar_pressure: float = SOLAR_PRESSURE

    def text(self, name: str, *, orbit: bool) -> str:
        """Return the plate as text, such as "0.2 m^2, drag and solar pressure"."""
        effects = list[str]()
        if self.density:
            effects.append("drag")
        if any(self.sun):
            effects.append("solar pressure")
        normal = ", ".join(f"{x:.6g}" for x in self.normal)
        return f"{self.area:.6g} m^2, normal ({normal}), {' and '.join(effects)}"


_KEYS = tuple(item.name for item in fields(FlatPlate))
_VECTORS = ("normal", "position", "velocity", "sun")
_FACTORS = ("density", "specular", "diffuse")


def checked_plate(label: str, given: object) -> FlatPlate:
    """Return a checked plate from a table or a plate; `label` names it in messages."""
    if isinstance(given, FlatPlate):
        return given
    if not isinstance(given, Mapping):
        raise InputError(
            f"{label} is {given!r}, expected a table with area and normal, and with density or sun"
        )
    require_known(f"key of {label}", given, _KEYS)
    missing = [key for key in ("area", "normal") if key not in given]
    if missing:
        raise InputError(
            f"{label} has no {missing[0]}; give area [m^2] and normal (in base axes)"
        )
    values: dict[str, Any] = {}
    for key, value in given.items():
        name = f"{key} of {label}"
        if key in _VECTORS:
            values[key] = three_numbers(name, value)
        elif key in _FACTORS:
            values[key] = _at_least_zero(name, value)
        elif key == "two_sided":
            values[key] = truth(name, value)
        else:
            values[key] = positive(name, value)
    plate = FlatPlate(**values)
    if not any(plate.normal):
        raise InputError(f"normal of {label} is zero, expected a direction")
    reflected = plate.specular + plate.diffuse
    if reflected > 1.0:
        raise InputError(
            f"specular and diffuse of {label} add to {reflected:g}, expected at most 1"
        )
    if not plate.density and not any(plate.sun):
        raise InputError(
            f"{label} has neither drag nor solar pressure; give density [kg/m^3], or sun, the "
            "direction to the sun in inertial axes"
        )
    return plate


def _at_least_zero(name: str, value: object) -> float:
    checked = number(name, value)
    if checked < 0.0 or not math.isfinite(checked):
        raise InputError(f"{name} is {checked:g}, expected at least 0")
    return checked
