r"""Models with changed masses, whose bodies stay physically realisable.

A body has mass m, centre of mass c and inertia I about c. With the identity matrix E, the second
moments of its mass distribution are :math:`\Sigma = \tfrac12 \mathrm{tr}(I) E - I`. The body is
physically realisable if and only if its pseudo-inertia is positive (semi)definite, that is if m
and Sigma are (Wensing, Kim and Slotine, Linear matrix
inequalities for physically-consistent inertial parameter identification, IEEE Robotics and
Automation Letters 3(1), 2018).
"""

from collections.abc import Mapping
from dataclasses import replace
from hashlib import sha256
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, listed, unknown
from fflin.base.names import by_name
from fflin.base.validation import Array, as_double, number, vector, whole
from fflin.base.validation import by_name as mapping
from fflin.robot.frames import ROOT
from fflin.robot.urdf.links import TRIANGLE_SLACK, is_impossible
from fflin.robot.wheels import with_inputs

_KEYS = ("mass", "com", "inertia")
_SYMMETRIC = 1e-9
_ROUNDING = 1e-12


def with_bodies(robot: Any, bodies: Any) -> Any:
    """Return a robot with other bodies, see `Robot.with_mass_properties`."""
    model = robot._bare.model
    given = mapping("bodies", bodies, "body")
    index_of = {"base": ROOT, **{model.names[i]: i for i in range(ROOT, model.njoints)}}
    links: dict[int, list[str]] = {}
    for frame in model.frames.tolist():
        if frame.type == pin.FrameType.BODY and frame.name not in index_of:
            links.setdefault(frame.parentJoint, []).append(frame.name)
    several = {name: index for index, many in links.items() if many[1:] for name in many}
    index_of |= several | {many[0]: index for index, many in links.items()}
    names, done, new = list(index_of), dict[int, Any](), model.copy()
    for place, value in by_name("body", given, names).items():
        name, index = names[place], index_of[names[place]]
        body = "base" if index == ROOT else model.names[index]
        if name in several:
            raise InputError(
                f"'{name}' is one of several links of the body '{body}': "
                f"{listed(links[index])}; give the properties of the whole body '{body}'"
            )
        if done.setdefault(index, value) is not value:
            raise InputError(
                f"the body '{body}' is given twice, once under the name '{name}'; give it once"
            )
        new.inertias[index] = _given(name, value, model.inertias[index])
    return _of_model(robot, new)


def _given(name: str, value: Any, old: pin.Inertia) -> pin.Inertia:
    """Return a body that is given in part or as a whole."""
    of = f"of '{name}'"
    if isinstance(value, pin.Inertia):
        value = {"mass": value.mass, "com": value.lever, "inertia": value.inertia}
    if not isinstance(value, Mapping):
        raise InputError(
            f"'{name}' is a {type(value).__name__}, expected {{'mass': m, 'com': (3,), "
            "'inertia': (3, 3)} or a pin.Inertia"
        )
    for key in value:
        if key not in _KEYS:
            raise unknown("mass property", key, _KEYS)
    mass = number(f"mass {of}", value.get("mass", old.mass))
    if "mass" in value and not mass > 0.0:
        raise InputError(f"mass {of} is {mass:g} kg, expected more than 0")
    com = vector(f"com {of}", value.get("com", old.lever), 3, "a point in the body's frame")
    if "inertia" not in value:
        return pin.Inertia(mass, com, old.inertia * (mass / old.mass if old.mass else 1.0))
    inertia = as_double(f"inertia {of}", value["inertia"])
    if inertia.shape != (3, 3) or not np.isfinite(inertia).all():
        raise InputError(
            f"inertia {of} has shape {inertia.shape}, expected (3, 3) finite numbers [kg m^2] "
            "about the centre of mass"
        )
    if np.abs(inertia - inertia.T).max() > _SYMMETRIC * np.abs(inertia).max():
        raise InputError(f"inertia {of} is not symmetric; give a symmetric matrix (3, 3)")
    inertia = 0.5 * (inertia + inertia.T)
    least, middle, largest = np.linalg.eigvalsh(inertia).tolist()
    moments = f"inertia {of} has principal moments {least:.3g}, {middle:.3g}, {largest:.3g} kg m^2"
    if is_impossible(mass, (least, middle, largest)):
        raise InputError(f"{moments}; expected values of 0 or more")
    if largest - middle - least > TRIANGLE_SLACK * largest:
        raise InputError(
            f"{moments}, which is not physically realisable; none may exceed the sum of the "
            "other two"
        )
    return pin.Inertia(mass, com, inertia)


def perturbed(robot: Any, seed: Any, **spreads: Any) -> Any:
    """Return a robot with its bodies drawn at random, see `Robot.perturbed`."""
    model = robot._bare.model
    checked = {key: number(key, value) for key, value in spreads.items()}
    for key, spread in checked.items():
        if not 0.0 <= spread < 1.0:
            raise InputError(f"{key} is {spread:g}, expected 0 or more and less than 1")
    draw, new = np.random.default_rng(whole("seed", seed, 0)), model.copy()
    for index in range(ROOT, model.njoints):
        drawn = draw.uniform(-1.0, 1.0, (1, 7))
        if any(checked.values()):
            sizes = checked["mass"], checked["com"], checked["inertia"]
            parts = (size * x for size, x in zip(sizes, np.split(drawn, (1, 4), 1), strict=True))
            heavier, shift, wider = parts
            body = model.inertias[index]
            mass, com, about = stretched(body, heavier, shift * _radii(body), wider)
            new.inertias[index] = pin.Inertia(float(mass[0]), com[0], about[0])
    return _of_model(robot, new)


def with_inertias(robot: Any, bodies: Mapping[int, Any]) -> Any:
    """Return a robot with other masses, centres of mass and inertias of its bare model's bodies."""
    model = robot._bare.model.copy()
    for index, (mass, com, inertia) in bodies.items():
        model.inertias[index] = pin.Inertia(float(mass), com, inertia)
    return _of_model(robot, model)


def _of_model(robot: Any, model: pin.Model) -> Any:
    """Return a robot with a model that has other masses and no wheels, and a hash of its own."""
    robot.require_unchanged()
    bare, told = robot._bare, robot.urdf_sha256
    masses, before = (
        b"".join(body.toDynamicParameters().tobytes() for body in each.inertias.tolist())
        for each in (model, bare.model)
    )
    if masses != before:
        told = sha256(told.encode() + masses).hexdigest()
    other = replace(bare, model=model, urdf_sha256=told)
    if bare is robot:
        return other
    return with_inputs(replace(robot, urdf_sha256=told, _wheelless=other), robot.inputs)


def _radii(body: pin.Inertia) -> Array:
    """Return the root mean square distances (3,) of a body's mass from its centre, by axis [m]."""
    second = 0.5 * np.trace(body.inertia) - body.inertia.diagonal()
    radii: Array = np.sqrt(np.abs(second) / (body.mass or np.inf))
    return radii


def stretched(
    body: pin.Inertia, mass: Array, com: Array, inertia: Array
) -> tuple[Array, Array, Array]:
    """Return masses (N,), centres (N, 3) and inertias (N, 3, 3) of a body that was changed.

    `mass` (N, 1) and `inertia` (N, 3) are relative; `com` (N, 3) moves the centre [m], mass and
    inertia about it held. All are along the axes of the body's frame.
    """
    # Stretched along its frame's axes by S, its Sigma becomes S Sigma S, which stays positive.
    heavier, unit = 1.0 + mass.reshape(-1), np.eye(3)
    second = 0.5 * np.trace(body.inertia) * unit - body.inertia
    # A body that is none, as some files have them, keeps its shape.
    sound = np.linalg.eigvalsh(second)[0] >= -_ROUNDING * np.trace(second)
    stretch = np.sqrt(1.0 + (inertia if sound else inertia[:, :1] * np.ones(3)))
    second = heavier[:, None, None] * second * stretch[:, :, None] * stretch[:, None]
    about = np.trace(second, axis1=1, axis2=2)[:, None, None] * unit - second
    return heavier * body.mass, body.lever + com, about
