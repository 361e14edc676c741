"""Weights of a regulator by a rule, and by name."""

import math
import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from fflin.analysis.ranks import Noisy, null_space
from fflin.analysis.wheels import ignorable_wheels, picked, regulated_part, rigid_forces, without
from fflin.base.errors import FflinWarning, InputError, listed, unknown
from fflin.base.names import by_name, input_keys, stands_for_any
from fflin.base.validation import Array, number
from fflin.control.default_weights import AT_A_POINT, BANDWIDTH, Pace, default_weights
from fflin.control.weights import inverse_square, is_input, sampled_cost
from fflin.linear.model import LinearModel

# Along a trajectory errors are a tenth of these, and are to be gone within it: so many time
# constants are to fit in, of a loop that is no slower than at a point, nor faster than this. Under
# a hold it may use more of it, since the regulator of the samples themselves is exact.
_BESIDE, _CONSTANTS, _FASTEST, _HELD_ALONG = 0.1, 15.0, 1.5, 1.0

# The speeds of wheels come back at this share of the bandwidth.
_SPEEDS = 0.1

# A weight that is given and this many times apart from that of the rule is on another scale.
_APART = 1e4


class _Given(NamedTuple):
    """Given weight, and whether it was given as a largest value."""

    value: float
    largest: bool


def pace_along(duration: float, hold: float) -> Pace:
    """Return the pace of a loop along a trajectory of that duration [s]."""
    return Pace(min(max(_CONSTANTS / duration, BANDWIDTH), _FASTEST), _BESIDE, hold, _HELD_ALONG)


def rule_weights(
    lin: LinearModel,
    name: str | None,
    given: Mapping[str, Any] | None = None,
    *,
    wheel_speeds: bool | None = None,
    pace: Pace = AT_A_POINT,
) -> tuple[Array, Array, Array | None, str]:
    """Return Q, R and N of a model by a rule, changed by `given` weights, and the rule in words."""
    # The cost of a sampled model is the continuous one under the hold, where it is known what it
    # was sampled from. The rule is by default what the robot has in its `weights`, else "urdf".
    source = lin.generator or lin
    layers = [(given, False)] if given else []
    if name is None and lin.weights:
        layers.insert(0, (lin.weights, True))
        name = lin.weights.get("rule")
    terms: Array = np.zeros(sum(lin.B.shape))
    if name is None or name == "urdf":
        pace = pace._replace(hold=lin.dt or pace.hold)
        Q, R, rule, terms = _of_regulated(source, pace, wheel_speeds)
    elif name == "identity":
        nx, nu = lin.B.shape
        Q, R, rule = np.eye(nx), np.eye(nu), "identity: 1 on every state and every input"
    else:
        raise unknown("rule of weights", name, ("urdf", "identity"))
    given_weights: dict[int, _Given] = {}
    named: dict[str, None] = {}
    for layer, of_robot in layers:
        weights, names = _weights_of(lin, layer, of_robot)
        given_weights |= weights
        named |= dict.fromkeys(names)
    if named:
        Q, R = _reweighed(lin, Q, R, terms, given_weights)
        rule = f"{', '.join(named)} as given, the others {rule}"
        rule += " (figures of this rule alone)" if terms.any() else ""
    if source.dt == lin.dt:
        return Q, R, None, rule
    return (*sampled_cost(source, lin.dt, Q, R), rule)


def _of_regulated(
    lin: LinearModel, pace: Pace, wheel_speeds: bool | None
) -> tuple[Array, Array, str, Array]:
    """Return Q (nx, nx), R, the rule and costs, for a model that may have wheels.

    The costs (nx + nu,) are those of the largest value of each state and input, 0 if the rule has
    none.
    """
    part = regulated_part(lin, wheel_speeds)
    if part is lin:
        Q, R, rule, _, (of_positions, of_inputs) = default_weights(lin, pace)
        return Q, R, rule, np.concatenate((np.tile(of_positions, 2), of_inputs))
    wheels, _ = ignorable_wheels(lin)
    body = regulated_part(without(lin, wheels))
    at = wheels[[lin.state_names[i + len(lin.M)] in lin.limits for i in wheels]]
    names, spin = [lin.state_names[i + len(lin.M)] for i in at], np.abs(lin.x0[at + len(lin.M)])
    most = np.array([lin.limits[name] for name in names])
    # A wheel that is at its limit already is counted as one at rest, and told.
    room = np.where(spin < most, most - spin, most) / np.linalg.inv(lin.M).diagonal()[at]
    found = default_weights(body, pace, dict(zip(names, room, strict=True)))
    Q, R, rule, bandwidth, (of_positions, of_inputs) = found
    if beyond := [name for name, x, y in zip(names, spin, most, strict=True) if x >= y > 0.0]:
        rule += f"; at or beyond the URDF limit at the point itself: {listed(beyond)}"
    S = picked(body.state_names, lin.state_names)
    Q = S.T @ Q @ S
    terms = np.concatenate((np.tile(of_positions, 2) @ S, of_inputs))
    if speeds := [name for name in part.state_names if name not in body.state_names]:
        S, slow = picked(speeds, lin.state_names), _SPEEDS * bandwidth
        # Inputs R^-1/2 Z n that turn no body change the speeds at X n.
        root, forces = np.sqrt(R.diagonal()), rigid_forces(without(lin, wheels)).values
        X = S @ lin.B / root @ null_space(Noisy.exact(forces / root))[0] / (lin.dt or 1.0)
        Q += slow**2 * S.T @ np.linalg.pinv(X @ X.T, 1e-9, hermitian=True) @ S
        rule = f"{rule}; wheel speeds at {slow:.3g} rad/s"
    return Q, R, rule, terms


def _weights_of(
    lin: LinearModel, given: Mapping[str, Any], of_robot: bool
) -> tuple[dict[int, _Given], list[str]]:
    """Return what is given by index among the states and then the inputs, and the names."""
    parts = {part: dict(given.get(part, {})) for part in ("q", "r", "bryson")}
    if of_robot:  # a reduced model has not all that a robot's weights name
        names = (*lin.state_names, *input_keys(lin))
        for part, values in parts.items():
            parts[part] = {key: x for key, x in values.items() if stands_for_any(key, names)}
    q, r = (
        {key: _Given(number(f"weight of '{key}'", x), False) for key, x in parts[part].items()}
        for part in ("q", "r")
    )
    for name, size in parts["bryson"].items():
        side = r if is_input("state or input", name, lin) else q
        if name in side:
            raise InputError(
                f"'{name}' has both a weight and a largest value (bryson); give only one of them"
            )
        side[name] = _Given(inverse_square(f"largest value of '{name}' (--bryson)", size), True)
    of_inputs = by_name("input", r, input_keys(lin))
    nx = len(lin.x0)
    shifted = {nx + index: each for index, each in of_inputs.items()}
    return by_name("state", q, lin.state_names) | shifted, [*q, *r]


def _reweighed(
    lin: LinearModel, Q: Array, R: Array, terms: Array, given: Mapping[int, _Given]
) -> tuple[Array, Array]:
    """Return Q and R, scaled to the largest values that are given, with what is given in them.

    A common factor of Q and R does not change the gain. The rule's weights are scaled so that the
    largest values of the named states and inputs cost 1, as in Bryson's rule.
    """
    costs = [terms[index] for index, each in given.items() if each.largest and terms[index]]
    scale = math.exp(-np.log(costs).mean()) if costs else 1.0
    Q, R, nx, apart = scale * Q, scale * R, len(Q), dict[str, str]()
    names = (*lin.state_names, *input_keys(lin))
    for index, (value, largest) in given.items():
        matrix, at = (Q, index) if index < nx else (R, index - nx)
        own = float(matrix[at, at])
        if terms.any() and not largest and value > 0.0 and own > 0.0:
            ratio = value / own
            if not 1.0 / _APART < ratio < _APART:
                apart[names[index]] = f"{names[index]} is {value:.3g}, by the rule {own:.3g}"
        matrix[at], matrix[:, at], matrix[at, at] = 0.0, 0.0, value
    if apart:
        warnings.warn(
            f"the weights given differ in scale from the rule's weights: {listed(apart.values())}; "
            "one of the two groups will dominate the cost; give largest values (bryson) instead, "
            "to which the rule's weights are scaled",
            FflinWarning,
            stacklevel=4,
        )
    return Q, R
