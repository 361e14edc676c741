"""Reaction wheels in a linear model, on whose angles no other state depends."""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from fflin.analysis.mechanics import floating_inertia, second_order, slopes
from fflin.analysis.ranks import Noisy, echelon, image, null_space
from fflin.base.errors import InputError, StabilizabilityError, listed
from fflin.base.frozen import frozen
from fflin.base.names import input_keys
from fflin.base.validation import Array
from fflin.linear.files import given
from fflin.linear.model import LinearModel, same_certificate

Indices: TypeAlias = NDArray[np.intp]
Make: TypeAlias = Callable[[LinearModel], LinearModel]
Part = TypeVar("Part", bound=LinearModel)

# What is smaller, relative to the rest, is rounding.
_ROUNDING = 1e-9


def wheel_inputs(lin: LinearModel) -> tuple[str, ...]:
    """Return the names of the inputs that are wheels."""
    keys = (key.partition(".") for key in input_keys(lin))
    return tuple(name for group, _, name in keys if group == "wheel")


def ignorable_wheels(lin: LinearModel) -> tuple[Indices, Indices]:
    """Return the wheels (k,) on whose angle nothing depends, and those whose speed is so too."""
    # A speed matters where the carrier turns at the point, and where the wheel has friction.
    nv, wanted = len(lin.M), {f"q_m.{name}" for name in wheel_inputs(lin)}
    at = np.flatnonzero([name in wanted for name in lin.state_names[:nv]])
    if not len(at):
        return at, at
    system = second_order(lin.generator or lin)
    angle, speed = (~matrix.values[:, at].any(axis=0) for matrix in (system.K, system.D))
    return at[angle], at[angle & speed]


def leaving(lin: LinearModel, wheel_speeds: bool | None) -> Indices:
    """Return the wheels (k,) that leave a design (9.5)."""
    # Inputs that turn nothing at rest may still spin wheels: as many as they do so independently
    # can be held. By default these stay where something else turns the base.
    if wheel_speeds is not None and not isinstance(wheel_speeds, bool | np.bool_):
        raise InputError(f"wheel_speeds is {wheel_speeds!r}, expected True, False or None")
    _, free = ignorable_wheels(lin)
    if len(free) and wheel_speeds is None:
        turning = [name.startswith("q_b.") for name in lin.state_names[: len(lin.M)]]
        wheel_speeds = bool(second_order(lin.generator or lin).S.values[turning].any())
    if not len(free) or not wheel_speeds:
        return free
    forces = rigid_forces(without(lin.generator or lin, free))
    sizes = np.linalg.norm(forces.values, axis=0)
    idle = null_space(forces @ np.diag(1.0 / np.where(sizes > 0.0, sizes, 1.0)))[0]
    motors = [lin.input_names.index(lin.state_names[i].removeprefix("q_m.")) for i in free]
    spun = image(idle[motors], _ROUNDING)[0]
    held: Any = echelon(spun, np.ones(len(free)))[1]
    return np.delete(free, held)


def regulated_part(lin: LinearModel, wheel_speeds: bool | None = None) -> LinearModel:
    """Return the model of the states that are regulated; `lin` itself where it has no wheels."""
    # What is `leaving` leaves it, the angles of other wheels too where nothing depends on them, so
    # that there are fewer positions than rates; and the base's position where no input pushes it.
    if not wheel_inputs(lin):
        return lin
    source, nv = lin.generator or lin, len(lin.M)
    idle = ~second_order(source).S.values.any(axis=1)
    base = [i for i in range(nv) if idle[i] and lin.state_names[i].startswith("r_b.")]
    columns = [*base, *(i + nv for i in base)]
    if np.abs(np.delete(source.A[:, columns], columns, axis=0)).max(initial=0.0) > _ROUNDING:
        base = []  # in axes that turn one direction is part of the others
    left = np.union1d(base, leaving(lin, wheel_speeds)).astype(np.intp)
    part = without(lin, left)
    angles = {lin.state_names[i] for i in ignorable_wheels(lin)[0]}
    rest = [name for name in part.state_names if name not in angles]
    if len(rest) == len(part.M):
        raise StabilizabilityError(f"the model contains wheel speeds alone{damped_wheels(part)}")
    return selected(lin, rest, part.M, partial(regulated_part, wheel_speeds=wheel_speeds))


def damped_wheels(part: LinearModel) -> str:
    """Return what to do where wheels have damping, of a model that may be without their angles."""
    nv, rates = len(part.M), slopes(part)[-len(part.M) :, -len(part.M) :]
    least = _ROUNDING * (np.abs(part.M) @ np.abs(rates)).diagonal()
    dragged = -(part.M @ rates).diagonal() > least
    names = [part.state_names[i - nv].removeprefix("qdot_m.") for i in np.flatnonzero(dragged)]
    damped = [name for name in names if name in wheel_inputs(part)]
    if not damped:
        return ""
    return f": wheel speeds stay in the model due to the damping of {listed(damped)}; remove it"


def rigid_forces(body: LinearModel) -> Noisy:
    """Return what the inputs do to the rigid motions (r, nu), which no spring holds."""
    system = second_order(body)
    motions = null_space(system.K.T @ np.diag(1.0 / system.size))[0] / system.size[:, None]
    return system.S.after(motions.T)


def without(lin: LinearModel, left: Indices) -> LinearModel:
    """Return a model without coordinates (k,) and their rates, exact whatever these do (9.4)."""
    kept = np.setdiff1d(np.arange(len(lin.M)), left)
    names = [lin.state_names[i] for i in (*kept, *(kept + len(lin.M)))]
    rest = floating_inertia(lin.M, kept, left)
    return selected(_balanced(lin), names, rest, partial(without, left=left))


def _balanced(lin: LinearModel) -> LinearModel:
    """Return a model without the forces that are rounding of a spin, which its parts lack."""
    nv, A, system = len(lin.M), lin.A.copy(), second_order(lin)
    if not lin.dt and not system.K.values.any():
        A[nv:, :nv] = 0.0
    if not lin.dt and not system.D.values.any():
        A[nv:, nv:] = 0.0
    return replace(lin, A=A)


def selected(lin: LinearModel, names: Sequence[str], M: Array, make: Make) -> LinearModel:
    """Return the model of some states, of the inertia M, and of the outputs that see no others."""
    S = picked(names, lin.state_names)
    seen, values = seen_through(lin, S), part_of(lin, S, S.T, M)
    values |= {"C": seen @ values["C"], "D": seen @ lin.D, "y0": seen @ lin.y0}
    for key in ("output_names", "output_units"):
        values[key] = tuple(getattr(lin, key)[i] for i in seen.argmax(axis=1))
    return certified(LinearModel(**values), lin, make)


def picked(names: Sequence[str], of: Sequence[str]) -> Array:
    """Return S (k, n) that picks names from others."""
    return np.eye(len(of))[[of.index(name) for name in names]]


def seen_through(lin: LinearModel, S: Array) -> Array:
    """Return O (k, ny) that picks the outputs which see none but the states S x."""
    others = np.abs(lin.C - lin.C @ S.T @ S).max(axis=1, initial=0.0)
    return np.eye(len(lin.C))[others <= 1e-12 * np.abs(lin.C).max(axis=1, initial=0.0)]


def part_of(lin: LinearModel, S: Array, T: Array, M: Array) -> dict[str, Any]:
    """Return the fields of a model of the states z = S x of the inertia M, the others T z."""
    names = tuple(lin.state_names[i] for i in S.argmax(axis=1))
    whole = {item.name: getattr(lin, item.name) for item in fields(LinearModel)}
    return whole | {
        "A": S @ lin.A @ T,
        "B": S @ lin.B,
        "C": lin.C @ T,
        "f0": S @ lin.f0,
        "x0": S @ lin.x0,
        "state_names": names,
        "state_units": tuple(lin.state_units[i] for i in S.argmax(axis=1)),
        "_ignorable": partial(given, tuple(name for name in names if name in lin.ignorable)),
        "_drift": None if lin.drift is None else S @ lin.drift,
        "_inertia": partial(given, frozen(M)),
    }


def certified(part: Part, lin: LinearModel, make: Make) -> Part:
    """Return a part with the certificate of the whole, and with what made it of its source."""
    fingerprint, source = part.fingerprint, lin.generator
    certify = partial(same_certificate, lin, fingerprint)
    of = (fingerprint, make(source)) if lin.dt and source is not None else None
    return replace(part, _certify=certify, _source=of)
