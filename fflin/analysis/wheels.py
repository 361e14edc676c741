"""Reaction wheels in a linear model: whose angle and speed nothing else depends on."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial
from itertools import compress
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fflin.analysis.mechanics import second_order
from fflin.analysis.ranks import Noisy, echelon, image, null_space
from fflin.base.errors import InputError
from fflin.base.names import input_keys
from fflin.base.validation import Array
from fflin.linear.model import Certificate, LinearModel

Indices: TypeAlias = NDArray[np.intp]

# What is smaller, relative to the rest, is rounding.
_ROUNDING = 1e-9


def wheel_inputs(lin: LinearModel) -> tuple[str, ...]:
    """Return the names of the inputs that are wheels."""
    keys = (key.partition(".") for key in input_keys(lin))
    return tuple(name for group, _, name in keys if group == "wheel")


def wheel_joints(lin: LinearModel) -> Indices:
    """Return the coordinates (k,) of int of the wheels that are joints."""
    wanted = {f"q_m.{name}" for name in wheel_inputs(lin)}
    names = lin.state_names[: len(lin.M)]
    return np.array([i for i, name in enumerate(names) if name in wanted], dtype=np.intp)


def ignorable_wheels(lin: LinearModel) -> tuple[Indices, Indices]:
    """Return the wheels on whose angle nothing depends, and those of them whose speed is so too.

    A speed matters where the carrier turns at the point, and where the wheel has friction.
    """
    at = wheel_joints(lin)
    if not len(at):
        return at, at
    system = second_order(lin.generator or lin)
    units, spin = np.outer(system.size, system.size[at]), np.abs(lin.x0[len(lin.M) + at])
    # What balances at a speed leaves the rounding of its square, and no other to compare with.
    still = np.abs(system.K.values[:, at]) <= _ROUNDING * spin**2 * units
    free = np.abs(system.D.values[:, at]) <= _ROUNDING**2 * spin * units
    angle = still.all(axis=0)
    return at[angle], at[angle & free.all(axis=0)]


def leaving(lin: LinearModel, wheel_speeds: bool | None) -> Indices:
    r"""Return the wheels (k,) that leave a design, (9.5) of docs/derivation.md.

    Inputs that turn no body at rest, :math:`\Phi^T S u = 0` with the rigid motions
    :math:`\Phi` of what is left without wheels, still spin some of them up and down: as many as
    they do so independently can be held. By default these stay where the momentum that the wheels
    have in all can be changed.
    """
    if wheel_speeds is not None and not isinstance(wheel_speeds, bool | np.bool_):
        raise InputError(f"wheel_speeds is {wheel_speeds!r}, expected True, False or None")
    _, free = ignorable_wheels(lin)
    if not len(free) or (wheel_speeds is not None and not wheel_speeds):
        return free
    body = without(lin.generator or lin, free)
    forces = rigid_forces(body)
    sizes = np.linalg.norm(forces.values, axis=0)
    scale = np.diag(1.0 / np.where(sizes > 0.0, sizes, 1.0))
    idle = null_space(forces @ scale)[0]
    motors = [lin.input_names.index(lin.state_names[i].removeprefix("q_m.")) for i in free]
    spun = image(idle[motors], _ROUNDING)[0]
    if not wheel_speeds:
        base = [i for i, name in enumerate(body.state_names) if name.startswith("q_b.")]
        torques = (second_order(body).S.values @ scale)[np.ix_(base, motors)] @ spun
        if not np.abs(torques).max(initial=0.0) > _ROUNDING * np.abs(scale).max():
            return free
    held: Any = echelon(spun, np.ones(len(free)))[1]
    return np.delete(free, held)


def rigid_forces(body: LinearModel) -> Noisy:
    """Return what the inputs do to the rigid motions (r, nu), which no spring holds."""
    system = second_order(body)
    motions = null_space(system.K.T @ np.diag(1.0 / system.size))[0] / system.size[:, None]
    return system.S.after(motions.T)


def following(M: Array, left: Indices) -> Array:
    """Return all rates (nv, r) over the others, of coordinates (k,) that no force holds."""
    kept = np.setdiff1d(np.arange(len(M)), left)
    R = np.zeros((len(M), len(kept)))
    R[kept, np.arange(len(kept))] = 1.0
    R[left] = -np.linalg.solve(M[np.ix_(left, left)], M[np.ix_(left, kept)])
    return R


def without(lin: LinearModel, left: Indices) -> LinearModel:
    r"""Return a model without coordinates (k,) and rates that no other depends on, (9.4).

    It is a quotient, exact whatever those do: z = S x picks the others, and S A = A_z S. Outputs
    that see what is left out are left out.
    """
    nv = len(lin.M)
    kept = np.setdiff1d(np.arange(nv), left)
    z = np.concatenate((kept, kept + nv))
    T = np.eye(2 * nv)[:, z]
    part: LinearModel = replace(
        LinearModel(**{item.name: getattr(lin, item.name) for item in fields(LinearModel)}),
        **part_of(lin, z, T, following(lin.M, left)),
        **outputs_of(lin, z),
    )
    return certified(part, lin, partial(without, left=left))


def seen_by(lin: LinearModel, z: Indices) -> Any:
    """Return which outputs (ny,) of bool see none but the states z (nz,)."""
    C = np.abs(lin.C)
    others: Array = np.delete(C, z, axis=1).max(axis=1, initial=0.0)
    return others <= 1e-12 * C.max(axis=1, initial=0.0)


def outputs_of(lin: LinearModel, z: Indices) -> dict[str, Any]:
    """Return the fields of a model of the states z (nz,) about the outputs that see these alone."""
    seen = seen_by(lin, z)
    return {
        "C": lin.C[np.ix_(seen, z)],
        "D": lin.D[seen],
        "y0": lin.y0[seen],
        "output_names": tuple(compress(lin.output_names, seen)),
        "output_units": tuple(compress(lin.output_units, seen)),
    }


def part_of(lin: LinearModel, z: Any, T: Array, R: Array) -> dict[str, Any]:
    """Return the fields of a model of the states z (nz,), the others T z, with rates R of all."""
    M = R.T @ lin.M @ R
    M.setflags(write=False)
    ignorable = tuple(lin.state_names[i] for i in z if lin.state_names[i] in lin.ignorable)
    return {
        "A": lin.A[z] @ T,
        "B": lin.B[z],
        "f0": lin.f0[z],
        "x0": lin.x0[z],
        "state_names": tuple(lin.state_names[i] for i in z),
        "state_units": tuple(lin.state_units[i] for i in z),
        "_ignorable": partial(_given, ignorable),
        "_drift": None if lin.drift is None else lin.drift[z],
        "_inertia": partial(_given, M),
    }


def certified(part: Any, lin: LinearModel, make: Any) -> Any:
    """Return a part with the certificate of the whole, and with what made it of its source."""
    fingerprint, source = part.fingerprint, lin.generator
    certify = partial(_same_certificate, lin, fingerprint)
    of = (fingerprint, make(source)) if lin.dt and source is not None else None
    return replace(part, _certify=certify, _source=of)


def _given(value: Any, _: LinearModel) -> Any:
    return value


def _same_certificate(whole: LinearModel, fingerprint: str, lin: LinearModel) -> Certificate:
    lin.require(fingerprint)
    return whole.certificate
