"""Integral action of a linear quadratic regulator: integrated signals, weights and the design.

The integrals xi of H (x - x0) are further states of the model. The regulator of this extended model
brings H (x - x0) to zero under a constant disturbance, by u = u0 - K (x - x0) - K_i xi.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fflin.base.errors import InputError, StabilizabilityError
from fflin.base.names import by_name, matching
from fflin.base.validation import Array, ArrayLike, dimension, numbers, shaped
from fflin.control.data_sheet import output_keys
from fflin.control.gain import StaticLoop, static_loop
from fflin.control.optimal.riccati import Riccati, Solution, best_solution
from fflin.linear.model import LinearModel

# Signals that are integrated: names or groups of states or outputs, their weights, or the matrix H.
Integrated: TypeAlias = str | Sequence[str] | Mapping[str, float] | ArrayLike

# The default weights make the integrals slower than the rest of the loop by this factor.
_SLOWER = 3.0

# A combination of signals counts as out of reach of constant inputs if their effect on it is below
# this fraction of the terms that it is computed from.
_NO_EFFECT = 1e-9

# Coefficients below this fraction of the largest are omitted from a combination in a message.
_SHOWN = 1e-6


@dataclass(frozen=True, eq=False)
class IntegralAction:
    """Signals to be integrated: names (k,), units (k,), H (k, nx) and weights (k,) or None."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    H: Array
    weights: Array | None = None

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the integrals as states."""
        return tuple(f"integral.{name}" for name in self.names)

    @property
    def state_units(self) -> tuple[str, ...]:
        """Units of the integrals."""
        return tuple(f"{unit} s".strip() for unit in self.units)


def is_off(given: object) -> bool:
    """Return whether no signals are given, which switches integral action off."""
    return isinstance(given, Sequence | Mapping) and not given


def integral_action(lin: LinearModel, given: Integrated) -> IntegralAction:
    """Return the integrated signals of a model, or raise an error if they are unknown.

    `given` are names, a mapping {name: weight}, or the matrix H (k, nx).
    """
    if isinstance(given, str):
        given = [given]
    if isinstance(given, Mapping):
        return _of_names(
            lin, list(given), numbers("integral_action", given, "name", "weight of")
        )
    if isinstance(given, Sequence) and all(isinstance(name, str) for name in given):
        return _of_names(lin, [str(name) for name in given], None)
    nx = len(lin.A)
    rows = 1 if dimension("integral_action", given) < 2 else len(np.asarray(given))
    hint = " (k, nx); or give names of states or outputs"
    H = shaped("integral_action", np.atleast_2d(np.asarray(given)), (rows, nx), hint)
    names = tuple(f"y_{k + 1}" for k in range(rows))
    return IntegralAction(names, ("",) * rows, H)


def _of_names(
    lin: LinearModel, keys: list[str], weights: Mapping[str, float] | None
) -> IntegralAction:
    """Return the integrals of named states or outputs."""
    known = dict.fromkeys((*lin.state_names, *lin.output_names))
    names = list(known)
    key_of = output_keys(keys, names)
    chosen = [
        i for key in keys for i in matching("state or output", key_of[key], names)
    ]
    indices = list(dict.fromkeys(chosen))
    H, units = [], []
    for index in indices:
        name = names[index]
        if name in lin.state_names:
            at = lin.state_names.index(name)
            H.append(np.eye(len(lin.A))[at])
            units.append(lin.state_units[at])
            continue
        at = lin.output_names.index(name)
        if lin.D[at].any():
            raise InputError(
                f"'{name}' cannot be integrated, because the inputs change it directly; integrate "
                "a position, an attitude or a rate"
            )
        H.append(lin.C[at])
        units.append(lin.output_units[at])
    values = None
    if weights is not None:
        weight_of = {key_of[key]: weight for key, weight in weights.items()}
        by_index = by_name("state or output", weight_of, names)
        values = np.array([by_index[i] for i in indices])
        if not (values > 0.0).all():
            name = names[indices[int(values.argmin())]]
            raise InputError(
                f"the weight of the integral of {name} is {values.min():g}, expected a positive "
                "number"
            )
    return IntegralAction(
        tuple(names[i] for i in indices), tuple(units), np.array(H), values
    )


def extended(A: Array, B: Array, H: Array, dt: float) -> tuple[Array, Array]:
    """Return A and B of a model with the integrals of H (x - x0) as further states."""
    k, nx = H.shape
    corner = np.eye(k) if dt else np.zeros((k, k))
    lower = np.hstack(((dt or 1.0) * H, corner))
    upper = np.hstack((A, np.zeros((nx, k))))
    return np.vstack((upper, lower)), np.vstack((B, np.zeros((k, B.shape[1]))))


def _static(
    part: LinearModel, loop: Solution, R: Array, action: IntegralAction, H: Array
) -> StaticLoop:
    """Return the loop without integrals from the inputs to the integrated signals.

    The inputs are scaled by the weight of their changes in the cost of the loop. Raise
    `StabilizabilityError` if constant inputs cannot change a combination of these signals.
    """
    W = R
    if part.dt:
        W = R + part.B.T @ loop.P @ part.B
    factor = np.linalg.cholesky(W)
    static = static_loop(part.A - part.B @ loop.K, part.B, H, factor, part.dt)
    scale = np.where(static.terms > 0.0, static.terms, 1.0)
    directions, sizes, _ = np.linalg.svd(static.gain / scale[:, None])
    if len(sizes) < len(H) or sizes[-1] < _NO_EFFECT:
        raise StabilizabilityError(
            "integral action is not possible: constant inputs cannot change "
            f"{_combination(directions[:, -1] / scale, action.names)}, so the regulator cannot "
            "bring it to zero; integrate fewer signals"
        )
    return static


def _combination(coefficients: Array, names: Sequence[str]) -> str:
    """Return a combination of signals as a text, with 1 as the largest coefficient."""
    largest = coefficients[np.abs(coefficients).argmax()]
    terms = [
        f"{value:+.4g} {name}"
        for value, name in zip(coefficients / largest, names, strict=True)
        if abs(value) > _SHOWN
    ]
    if len(terms) == 1:
        return terms[0].partition(" ")[2]
    return "the combination " + " ".join(terms)


def _default_weight(static: StaticLoop, dt: float) -> Array:
    """Return the weight (k, k) with which all integrals decay slower than the loop.

    If the loop were infinitely fast, they would all decay at the same rate.
    """
    rate = 1.0 / (_SLOWER * static.time)
    size = rate**2
    if dt:
        growth = np.expm1(rate * dt)
        size = growth**2 / (1.0 + growth) / dt**2
    weight: Array = size * np.linalg.inv(static.gain @ static.gain.T)
    return 0.5 * (weight + weight.T)


def with_integrals(
    part: LinearModel,
    loop: Solution,
    weights: tuple[Array, Array, Array],
    action: IntegralAction,
    H: Array,
) -> tuple[Solution, Array, float]:
    """Return the regulator of a model with integrals, their weight (k, k), and the loop's pace.

    The pace [1/s] is the inverse of the slowest time constant of the loop without integrals.

    Parameters
    ----------
    part : LinearModel
        Model of the regulated states.
    loop : Solution
        Regulator of this model without integrals.
    weights : tuple of ndarray
        Q, R and N of this regulator.
    action : IntegralAction
    H : ndarray (k, nr)
        Integrated signals as combinations of the regulated states.
    """
    Q, R, N = weights
    k = len(H)
    static = _static(part, loop, R, action, H)
    dt = part.dt
    if action.weights is None:
        Q_i = _default_weight(static, dt)
    else:
        Q_i = np.diag(action.weights) * (dt or 1.0)
    A, B = extended(part.A, part.B, H, dt)
    none = np.zeros((len(Q), k))
    both = np.block([[Q, none], [none.T, Q_i]])
    cross = np.vstack((N, np.zeros((k, N.shape[1]))))
    equation = Riccati(A, B, both, R, cross, dt)
    try:
        solution = best_solution(equation, None)
    except np.linalg.LinAlgError as error:
        raise StabilizabilityError(
            f"no regulator with integral action was found: {error}; give smaller weights of the "
            "integrals"
        ) from None
    return solution, Q_i, 1.0 / static.time
