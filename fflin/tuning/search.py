"""Minimisation of the largest of several functions by a bundle method with quasi-Newton steps.

The functions are smooth pieces of the goals, such as the gain at each local peak. In every step, a
quadratic program minimises the largest linear model of all pieces plus a quadratic term. If a trial
point is no improvement, the pieces there are added to the model, and the quadratic term grows. See
P. Apkarian and D. Noll, Nonsmooth H-infinity synthesis, IEEE Transactions on Automatic Control
51(1), 2006, and A. S. Lewis and M. L. Overton, Mathematical Programming 141, 2013.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fflin.base.validation import Array

# A trial point is accepted if it has this fraction of the predicted decrease.
_ACCEPTED = 0.05

# With this fraction of the predicted decrease, a longer step is tried.
_LONG = 0.5

# The search ends if the predicted decrease is smaller, or after so many trials without a decrease.
_SMALL, _TRIALS = 1e-9, 30

# It also ends if _PATIENCE steps decrease the objective by less than _WORTH.
_PATIENCE, _WORTH = 20, 5e-4

# Length of the first step in the coordinates of the parameters, and the longest step.
_FIRST, _LONGEST = 0.3, 3.0

# Weight of violated constraints in the decrease of the objective.
_PENALTY = 1.0

# Pieces so far below the largest one are left out.
_FAR = 3.0

# Least curvature relative to the largest one.
_FLAT = 1e-9

_QP_STEPS = 400
_RIDGE = 1e-13


class Term(NamedTuple):
    """Piece at a point: its value, whether it is a constraint, and its gradient.

    A constraint holds if its value is at most 0. `key` names the function, and `where` the place of
    the piece in it, such as the logarithm of a frequency.
    """

    value: float
    is_constraint: bool
    key: Hashable
    where: float
    gradient: Callable[[], Array]


# Function of a point that returns the pieces, or None if it is not defined there.
Evaluate = Callable[[Array], "list[Term] | None"]

# Function that is called in each step with its number and the largest value.
OnStep = Callable[[int, float], None]


@dataclass(frozen=True, eq=False)
class Minimum:
    """Result of a search.

    `stationarity` is the norm of the convex combination of gradients that the last quadratic
    program found, plus the distance of these pieces from the largest. `weights` are the
    coefficients of the functions in this combination. `history` contains the largest objective and
    the largest constraint at each point of `path`.
    """

    x: Array
    objective: float
    violation: float
    stationarity: float
    steps: int
    history: list[tuple[float, float]]
    weights: dict[Hashable, float] | None
    path: list[Array]

    def after(self, earlier: Minimum) -> Minimum:
        """Return this result with the steps of an earlier search before its own."""
        return replace(
            self,
            history=[*earlier.history, *self.history],
            path=[*earlier.path, *self.path],
        )


def levels(terms: list[Term]) -> tuple[float, float]:
    """Return the largest objective, and the largest constraint."""
    objective = max((t.value for t in terms if not t.is_constraint), default=-math.inf)
    constraint = max((t.value for t in terms if t.is_constraint), default=-math.inf)
    return objective, constraint


class _Model(NamedTuple):
    """Linear models of pieces about a point: offsets (k,), gradients (k, n) and their pieces."""

    offsets: Array
    gradients: Array
    terms: list[Term]


class _Trials(NamedTuple):
    """Result of the trials from a point; `terms` is None if none of them was accepted."""

    x: Array = np.zeros(0)
    terms: list[Term] | None = None
    model: _Model = _Model(np.zeros(0), np.zeros((0, 0)), [])
    z: Array = np.zeros(0)
    proximity: float = 0.0
    stationarity: float = math.inf
    weights: dict[Hashable, float] | None = None


def minimise(
    evaluate: Evaluate,
    start: Array,
    bounds: tuple[Array, Array],
    *,
    steps: int,
    target: float = -math.inf,
    is_done: Callable[[list[Term]], bool] | None = None,
    on_step: OnStep | None = None,
) -> Minimum:
    """Minimise the largest objective subject to constraints, from a point where all are defined.

    The search ends if all values are at most `target`. `on_step` is called in each step with its
    number and the largest of all values.
    """
    x: Array = np.clip(start, *bounds)
    terms = evaluate(x)
    assert terms is not None
    hessian: Array | None = None
    proximity = 0.0
    trials = _Trials()
    history: list[tuple[float, float]] = []
    path: list[Array] = []
    while len(history) < steps:
        objective, constraint = levels(terms)
        history.append((objective, constraint))
        path.append(x)
        if on_step is not None:
            on_step(len(history), max(objective, constraint))
        if max(objective, constraint) <= target:
            break
        if is_done is not None and is_done(terms):
            break
        if is_done is None and _stagnates(history):
            break
        model = _model_of(terms, objective, constraint)
        if hessian is None:
            size = float(np.linalg.norm(model.gradients, axis=1).max(initial=0.0))
            hessian = max(size, 1e-8) / _FIRST * np.eye(len(x))
        trials = _improved(
            evaluate, x, bounds, (objective, constraint), model, hessian, proximity
        )
        if trials.terms is None:
            break
        proximity = trials.proximity
        hessian = _updated(hessian, trials.x - x, trials.model, trials.z, trials.terms)
        x, terms = trials.x, trials.terms
    objective, constraint = levels(terms)
    violation = max(constraint, 0.0)
    count = len(history)
    if not path or path[-1] is not x:
        history.append((objective, constraint))
        path.append(x)
    return Minimum(
        x,
        objective,
        violation,
        trials.stationarity,
        count,
        history,
        trials.weights,
        path,
    )


def _improved(
    evaluate: Evaluate,
    x: Array,
    bounds: tuple[Array, Array],
    here: tuple[float, float],
    model: _Model,
    hessian: Array,
    proximity: float,
) -> _Trials:
    """Return the first accepted trial from x; `here` contains the levels at x."""
    low, high = bounds
    room = x - low, high - x
    scale = float(np.trace(hessian)) / len(x)
    result = _Trials()
    for trial in range(_TRIALS):
        curvature = hessian + proximity * np.eye(len(x))
        d, z, predicted, stationarity = _step(model, curvature, room)
        weights = _weights(model, z)
        result = result._replace(stationarity=stationarity, weights=weights)
        if float(np.abs(d).max(initial=0.0)) > _LONGEST:
            proximity = max(2.0 * proximity, 0.5 * scale)
            continue
        if predicted <= _SMALL:
            break
        candidate: Array = np.clip(x + d, low, high)
        after = evaluate(candidate)
        decrease = -math.inf if after is None else -_progress(after, *here)
        if after is not None and decrease >= _ACCEPTED * predicted:
            if trial == 0 and decrease >= 0.3 * predicted:
                proximity *= 0.3
            if decrease >= _LONG * predicted:
                longer = _extended(evaluate, x, d, bounds, here, decrease)
                if longer is not None:
                    candidate, after = longer
            return result._replace(
                x=candidate, terms=after, model=model, z=z, proximity=proximity
            )
        if after is not None:
            model = _with_cuts(model, after, *here, x, candidate)
        if after is None or trial >= 1:
            proximity = max(4.0 * proximity, 0.3 * scale)
    return result


def _stagnates(history: list[tuple[float, float]]) -> bool:
    """Return whether the last steps brought no decrease worth the time."""
    if len(history) <= _PATIENCE:
        return False
    before, now = history[-1 - _PATIENCE], history[-1]
    decrease = before[0] - now[0]
    violation = max(before[1], 0.0) - max(now[1], 0.0)
    return decrease + violation < _WORTH and abs(violation) < _WORTH


def _weights(model: _Model, z: Array) -> dict[Hashable, float]:
    """Return the sums of the multipliers of each function."""
    sums: dict[Hashable, float] = {}
    for term, weight in zip(model.terms, z.tolist(), strict=True):
        sums[term.key] = sums.get(term.key, 0.0) + weight
    return sums


def _extended(
    evaluate: Evaluate,
    x: Array,
    d: Array,
    bounds: tuple[Array, Array],
    levels_here: tuple[float, float],
    decrease: float,
) -> tuple[Array, list[Term]] | None:
    """Return a longer step with a larger decrease, or None if twice the step has none."""
    best = None
    factor = 2.0
    while factor * float(np.abs(d).max()) <= _LONGEST:
        candidate = np.clip(x + factor * d, *bounds)
        after = evaluate(candidate)
        if after is None:
            break
        farther = -_progress(after, *levels_here)
        if farther < 1.1 * decrease:
            break
        best = candidate, after
        decrease = farther
        factor *= 2.0
    return best


def _progress(terms: list[Term], objective: float, constraint: float) -> float:
    """Return the progress function of a point, which is 0 at the current point.

    `objective` and `constraint` are the levels of the current point.
    """
    violation = max(constraint, 0.0)
    new_objective, new_constraint = levels(terms)
    return max(
        new_objective - objective - _PENALTY * violation, new_constraint - violation
    )


def _offset(term: Term, objective: float, constraint: float) -> float:
    """Return the value of a piece in the progress function."""
    violation = max(constraint, 0.0)
    if term.is_constraint:
        return term.value - violation
    return term.value - objective - _PENALTY * violation


def _model_of(terms: list[Term], objective: float, constraint: float) -> _Model:
    """Return the linear models of the pieces that are not far below the largest."""
    offsets, gradients, kept = [], [], []
    for term in terms:
        offset = _offset(term, objective, constraint)
        if offset < -_FAR:
            continue
        gradient = term.gradient()
        if not np.isfinite(gradient).all():
            continue
        offsets.append(offset)
        gradients.append(gradient)
        kept.append(term)
    return _Model(np.array(offsets), np.array(gradients), kept)


def _with_cuts(
    model: _Model,
    terms: list[Term],
    objective: float,
    constraint: float,
    x: Array,
    trial: Array,
) -> _Model:
    """Return a model with the pieces at a trial point, shifted below the value at x."""
    offsets, gradients, kept = [], [], []
    distance = trial - x
    shift = 1e-4 * float(distance @ distance)
    for term in terms:
        offset = _offset(term, objective, constraint)
        if offset < -0.5 * _FAR:
            continue
        gradient = term.gradient()
        if not np.isfinite(gradient).all():
            continue
        offsets.append(min(offset - float(gradient @ distance), -shift))
        gradients.append(gradient)
        kept.append(term)
    if not kept:
        return model
    return _Model(
        np.concatenate((model.offsets, offsets)),
        np.vstack((model.gradients, gradients)),
        [*model.terms, *kept],
    )


def _step(
    model: _Model, curvature: Array, room: tuple[Array, Array]
) -> tuple[Array, Array, float, float]:
    """Return the step, the multipliers of the pieces, the predicted decrease and the stationarity.

    The step d minimises the largest ``offset + gradient d`` plus ``d curvature d / 2`` within the
    bounds.
    """
    n = len(curvature)
    below, above = room
    unit = np.eye(n)
    rows = np.vstack((model.gradients, unit, -unit))
    offsets = np.concatenate((model.offsets, -above, -below))
    k = len(model.offsets)
    sums = np.zeros(len(offsets))
    sums[:k] = 1.0
    factor = np.linalg.cholesky(curvature)
    scaled = np.linalg.solve(factor, rows.T)
    z = simplex_program(scaled.T @ scaled, offsets, sums)
    gradient = rows.T @ z
    d = -np.linalg.solve(factor.T, np.linalg.solve(factor, gradient))
    d = np.clip(d, -below, above)
    predicted = -float((model.offsets + model.gradients @ d).max())
    gap = -float(z[:k] @ model.offsets)
    stationarity = float(np.linalg.norm(gradient)) + gap
    return d, z[:k], predicted, stationarity


def simplex_program(Q: Array, offsets: Array, sums: Array) -> Array:
    """Return z >= 0 that minimises ``z Q z / 2 - offsets z`` with ``sums z = 1``.

    This is an active-set method; Q is positive semidefinite.
    """
    count = len(Q)
    candidates = np.where(sums > 0.0, offsets, -np.inf)
    active = [int(candidates.argmax())]
    z = np.zeros(count)
    z[active[0]] = 1.0
    ridge = _RIDGE * max(float(np.trace(Q)) / count, 1e-300)
    size = float(np.abs(Q).max(initial=0.0)) + 1e-300
    for _ in range(_QP_STEPS):
        k = len(active)
        matrix = np.zeros((k + 1, k + 1))
        matrix[:k, :k] = Q[np.ix_(active, active)] + ridge * np.eye(k)
        matrix[:k, k] = matrix[k, :k] = sums[active]
        right = np.append(offsets[active], 1.0)
        try:
            solution = np.linalg.solve(matrix, right)
        except np.linalg.LinAlgError:
            solution = np.linalg.lstsq(matrix, right, rcond=None)[0]
        target, price = solution[:k], solution[k]
        if target.min() >= 0.0:
            z[:] = 0.0
            z[active] = target
            costs = Q @ z + price * sums - offsets
            costs[active] = 0.0
            entering = int(costs.argmin())
            if costs[entering] >= -1e-12 * (size + np.abs(offsets).min()):
                break
            active.append(entering)
            continue
        now = z[active]
        falling = target < 0.0
        gaps = np.where(falling, now - target, 1.0)
        lengths = np.where(falling, now / gaps, np.inf)
        leaving = int(lengths.argmin())
        z[active] = now + lengths[leaving] * (target - now)
        z[active[leaving]] = 0.0
        active.pop(leaving)
    return z


def _updated(
    hessian: Array, step: Array, model: _Model, z: Array, after: list[Term]
) -> Array:
    """Return the damped BFGS update for the Lagrangian with multipliers z."""
    change = np.zeros(len(step))
    for weight, gradient, term in zip(z, model.gradients, model.terms, strict=True):
        if weight <= 1e-10:
            continue
        same = [other for other in after if other.key == term.key]
        if not same:
            continue
        nearest = min(same, key=lambda other: _apart(other.where, term.where))
        moved = nearest.gradient()
        if np.isfinite(moved).all():
            change += weight * (moved - gradient)
    direction = hessian @ step
    curvature = float(step @ direction)
    if curvature <= 0.0:
        return hessian
    product = float(step @ change)
    if product < 0.2 * curvature:
        share = 0.8 * curvature / (curvature - product)
        change = share * change + (1.0 - share) * direction
        product = float(step @ change)
    updated: Array = (
        hessian
        - np.outer(direction, direction) / curvature
        + np.outer(change, change) / product
    )
    sizes, vectors = np.linalg.eigh(0.5 * (updated + updated.T))
    sizes = np.maximum(sizes, _FLAT * max(float(sizes[-1]), 1.0))
    raised: Array = (vectors * sizes) @ vectors.T
    return raised


def _apart(first: float, second: float) -> float:
    """Return the distance of two places; places without a number are equal."""
    if first == second or math.isnan(first) or math.isnan(second):
        return 0.0
    return abs(first - second)
