"""Disturbances of the true system: torques and forces on the base that no control law knows.

In a magnetic field, they include a residual magnetic dipole, and errors of the field model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from fflin.base.errors import InputError, require_known
from fflin.base.validation import ONE_ROTATION, number, positive
from fflin.robot.flat_plate import FlatPlate, checked_plate
from fflin.robot.inputs import BaseForce, BaseTorque, three_numbers

Vector3: TypeAlias = tuple[float, float, float]

BASE, INERTIAL, ORBITAL = "base", "inertial", "orbital"
AXES = (BASE, INERTIAL, ORBITAL)

# {name: unit} of the torque and the force on the base.
UNITS = {BaseTorque.GROUP: BaseTorque.UNIT, BaseForce.GROUP: BaseForce.UNIT}

_NONE: Vector3 = (0.0, 0.0, 0.0)
_KEYS = ("constant", "amplitude", "frequency", "phase", "axes")


@dataclass(frozen=True)
class DisturbanceTerm:
    """Torque [N m] or force [N] on the base: constant + amplitude sin(2 pi frequency t + phase).

    Attributes
    ----------
    constant, amplitude : tuple of float (3,)
        Constant part and amplitude of the periodic part [N m | N].
    frequency : float
        Frequency [Hz]; 0 without a periodic part.
    phase : float
        Phase [rad] at t = 0, the start of a simulation.
    axes : str
        Axes of both vectors: "base", "inertial" or "orbital". If empty, the axes are the default:
        "base" for a torque, and for a force "inertial", or "orbital" in orbit.
    """

    constant: Vector3 = _NONE
    amplitude: Vector3 = _NONE
    frequency: float = 0.0
    phase: float = 0.0
    axes: str = ""

    def axes_in(self, name: str, *, orbit: bool) -> str:
        """Return the axes of the term `name`, which is tau_b or F_b, with the default resolved."""
        if self.axes:
            return self.axes
        if name == BaseTorque.GROUP:
            return BASE
        return ORBITAL if orbit else INERTIAL

    @property
    def periodic(self) -> bool:
        """Whether the term has a periodic part."""
        return any(self.amplitude)

    def text(self, name: str, *, orbit: bool) -> str:
        """Return the term as text, such as "2e-05, 0, 0 N m (base axes)"."""
        parts = list[str]()
        if any(self.constant):
            parts.append(", ".join(f"{x:.6g}" for x in self.constant))
        if self.periodic:
            wave = ", ".join(f"{x:.6g}" for x in self.amplitude)
            shift = f", phase {self.phase:.6g} rad" if self.phase else ""
            parts.append(f"({wave}) at {self.frequency:.6g} Hz{shift}")
        axes = self.axes_in(name, orbit=orbit)
        return f"{' + '.join(parts) or '0'} {UNITS[name]} ({axes} axes)"


# Name of the flat plates in the field `disturbance`.
PLATE = "plate"

# Names of the disturbances that need a magnetic field: a constant magnetic moment in base axes, and
# the difference between the true field and the field of the orbit. The true field is the field of
# the orbit, rotated by a rotation vector in the axes `lvlh` and multiplied by 1 + field_scale.
RESIDUAL_DIPOLE = "residual_dipole"
FIELD_SCALE = "field_scale"
FIELD_ROTATION = "field_rotation"

# {name: (number of values, unit, axes)}
MAGNETIC = {
    RESIDUAL_DIPOLE: (3, "A m^2", "base"),
    FIELD_ROTATION: (3, "rad", "lvlh"),
    FIELD_SCALE: (1, "", ""),
}


@dataclass(frozen=True)
class MagneticTerm:
    """Values of a residual dipole or of an error of the magnetic field.

    Attributes
    ----------
    values : tuple of float
        Three values of `RESIDUAL_DIPOLE` [A m^2] or `FIELD_ROTATION` [rad], or one value of
        `FIELD_SCALE`.
    """

    values: tuple[float, ...]

    def text(self, name: str, *, orbit: bool) -> str:
        """Return the values as text, such as "0.01, 0, 0 A m^2 (base axes)"."""
        _, unit, axes = MAGNETIC[name]
        text = ", ".join(f"{x:.6g}" for x in self.values)
        if axes:
            text += f" {unit} ({axes} axes)"
        return text


Disturbing: TypeAlias = DisturbanceTerm | FlatPlate | MagneticTerm

# Terms {name: terms} of the torque tau_b and the force F_b, and flat plates; their sum acts on the
# base.
DisturbanceTerms: TypeAlias = Mapping[str, tuple[Disturbing, ...]]


def checked_disturbance(given: object) -> dict[str, tuple[Disturbing, ...]]:
    """Return the field `disturbance` of a robot as {name: terms}; None or {} removes it.

    The value of a torque or force is three numbers, a table of `DisturbanceTerm`, or a list of
    these. The value of "plate" is a table of `FlatPlate`, or a list of these. The values of
    `MAGNETIC` are three numbers or one number.
    """
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InputError(
            f"disturbance is {given!r}, expected a table such as {{'tau_b': [2e-5, 0, 0]}}"
        )
    require_known("disturbance", given, (*UNITS, PLATE, *MAGNETIC))
    terms: dict[str, tuple[Disturbing, ...]] = {}
    for name, value in given.items():
        items: Sequence[object] = [value]
        if name == PLATE:
            if isinstance(value, list | tuple):
                items = value
            label = f"disturbance '{name}'"
            terms[name] = tuple(checked_plate(label, item) for item in items)
            continue
        if name in MAGNETIC:
            terms[name] = (_magnetic_term(name, value),)
            continue
        if isinstance(value, list | tuple) and any(map(_is_term, value)):
            items = value
        terms[name] = tuple(_term(f"disturbance '{name}'", item) for item in items)
    return terms


def _magnetic_term(name: str, value: object) -> MagneticTerm:
    """Return a checked term of `MAGNETIC` from its values."""
    label = f"disturbance '{name}'"
    if isinstance(value, tuple) and len(value) == 1:
        value = value[0]
    if isinstance(value, MagneticTerm):
        return value
    if name == FIELD_SCALE:
        return MagneticTerm((number(label, value),))
    return MagneticTerm(three_numbers(label, value))


def _is_term(value: object) -> bool:
    return isinstance(value, Mapping | DisturbanceTerm | list | tuple)


def _term(label: str, value: object) -> DisturbanceTerm:
    """Return a checked term from three numbers, a table or a term."""
    if isinstance(value, DisturbanceTerm):
        return value
    if not isinstance(value, Mapping):
        return DisturbanceTerm(constant=three_numbers(label, value))
    require_known(f"key of {label}", value, _KEYS)
    if not {"constant", "amplitude", "frequency"} & {*value}:
        raise InputError(
            f"{label} is empty; give constant=, or amplitude= and frequency="
        )
    constant = three_numbers(f"constant of {label}", value.get("constant", _NONE))
    amplitude = three_numbers(f"amplitude of {label}", value.get("amplitude", _NONE))
    axes = value.get("axes", "")
    if "axes" in value and axes not in AXES:
        raise InputError(
            f"axes of {label} is {axes!r}, expected one of {', '.join(AXES)}"
        )
    if ("amplitude" in value) != ("frequency" in value):
        missing = "frequency" if "amplitude" in value else "amplitude"
        raise InputError(
            f"{label} has no {missing}; a periodic disturbance needs both an amplitude and a "
            "frequency in Hz"
        )
    if "phase" in value and "amplitude" not in value:
        raise InputError(
            f"{label} has a phase but no amplitude; give amplitude and frequency, or remove the "
            "phase"
        )
    frequency = 0.0
    if "frequency" in value:
        frequency = positive(f"frequency of {label}", value["frequency"])
    phase = number(f"phase of {label}", value.get("phase", 0.0))
    if abs(phase) > ONE_ROTATION:
        raise InputError(
            f"phase of {label} is {phase:g} rad, expected at most one rotation; give radians, "
            f"such as {math.radians(phase):.3g} for {phase:g} deg"
        )
    return DisturbanceTerm(constant, amplitude, frequency, phase, str(axes))


def terms_of(given: DisturbanceTerms) -> list[tuple[str, DisturbanceTerm]]:
    """Return all terms of torques and forces, each as a pair (name, term)."""
    pairs = [(name, term) for name, terms in given.items() for term in terms]
    return [(name, term) for name, term in pairs if isinstance(term, DisturbanceTerm)]


def plates_of(given: DisturbanceTerms) -> list[FlatPlate]:
    """Return the flat plates of a disturbance."""
    return [plate for plate in given.get(PLATE, ()) if isinstance(plate, FlatPlate)]


def magnetic_values(given: DisturbanceTerms, name: str) -> tuple[float, ...]:
    """Return the values of a term of `MAGNETIC`; zeros if the disturbance does not contain it."""
    for term in given.get(name, ()):
        if isinstance(term, MagneticTerm):
            return term.values
    return (0.0,) * MAGNETIC[name][0]
