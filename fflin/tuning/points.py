"""Models of a search: the nominal model, and others of a list or of uncertain parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, ArrayLike, as_double, instance, positive
from fflin.dynamics.delays import HeldSystem
from fflin.linear.linearization import linearize
from fflin.linear.model import Delay, LinearModel, delays_of, refuse_sampled
from fflin.tuning.loop import acting_lags, with_robot_lags
from fflin.uncertainty.lagging import with_lags
from fflin.uncertainty.lft import LFT
from fflin.uncertainty.uncertain import Uncertain

# Corners of the ranges that are examined at most, and random points between them.
_CORNERS, _DRAWS = 128, 200

_EXPECTED = "a fflin.LinearModel, a list of them, or a fflin.Uncertain"


@dataclass(frozen=True, eq=False)
class Point:
    """Model of a search: matrices, and the values of the uncertain parameters or its number."""

    matrices: tuple[Array, Array, Array, Array]
    parameters: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Points:
    """Models of a search.

    Attributes
    ----------
    nominal : LinearModel
        First model, sampled if the law is sampled.
    fixed : tuple of Point
        Models in all searches, the nominal model first.
    candidates : tuple of Point
        Further models, of which the search adds the worst ones.
    corners : int
        Number of candidates that are corners; these come first.
    lft : LFT, optional
        Continuous model as a function of the uncertain parameters, if the law is continuous.
    """

    nominal: LinearModel
    fixed: tuple[Point, ...]
    candidates: tuple[Point, ...] = ()
    corners: int = 0
    lft: LFT | None = None


def points_of(
    plant: object, dt: float | None, delay: Delay, seed: int, q: ArrayLike | None = None
) -> Points:
    """Return the models of the plant of `tune`."""
    if isinstance(plant, LinearModel):
        lin = _in_time(plant, dt, delay)
        return Points(lin, (Point((lin.A, lin.B, lin.C, lin.D)),))
    if isinstance(plant, Uncertain):
        return _of_ranges(plant, dt, delay, seed, q)
    if not isinstance(plant, Sequence) or not plant:
        instance("plant", plant, LinearModel, _EXPECTED)
    models = []
    for number, lin in enumerate(plant):  # type: ignore[arg-type]
        instance(f"plant[{number}]", lin, LinearModel, "a fflin.LinearModel")
        models.append(_in_time(lin, dt, delay))
    first = models[0]
    for number, lin in enumerate(models):
        same = (
            lin.state_names == first.state_names
            and lin.input_names == first.input_names
            and lin.output_names == first.output_names
            and lin.dt == first.dt
        )
        if not same:
            raise InputError(
                f"model {number} of the list has other signals or another sample time than model "
                "0; give models of one robot with the same inputs and outputs"
            )
    fixed = tuple(
        Point((lin.A, lin.B, lin.C, lin.D), {"model": float(number)})
        for number, lin in enumerate(models)
    )
    return Points(first, fixed)


def _in_time(lin: LinearModel, dt: float | None, delay: Delay) -> LinearModel:
    """Return a model with the lags of its robot, sampled at dt [s] with delayed inputs if given."""
    lin = with_robot_lags(lin)
    if dt is None:
        if not isinstance(delay, int | float) or delay != 0.0:
            raise InputError(
                "delay is given without dt; give the sample time of the law, or a sampled model "
                "with a delay, lin.discretize(dt, delay=)"
            )
        return lin
    refuse_sampled(lin.dt, "tune(dt=)")
    return lin.discretize(dt, delay)


def _of_ranges(
    plant: Uncertain, dt: float | None, delay: Delay, seed: int, q: ArrayLike | None
) -> Points:
    """Return the nominal model, the corners of the ranges and random points in them."""
    at = None if q is None else as_double("q", q)
    nominal = linearize(plant.robot, at)
    lft = with_lags(plant.lft(at), acting_lags(nominal))
    lin = _in_time(nominal, dt, delay)
    size = len(lft.repeats)
    if 2**size <= _CORNERS:
        corners = np.array(list(product((-1.0, 1.0), repeat=size)))
    else:
        rng = np.random.default_rng(seed)
        corners = rng.choice((-1.0, 1.0), (_CORNERS, size))
    physical = np.array([not plant.refusal(corner) for corner in corners])
    corners = corners[physical]
    draws, _ = plant.draws(_DRAWS, seed=seed)
    rows = np.vstack((corners, draws))
    delays = np.zeros(len(lft.input_names))
    if dt is not None:
        dt = positive("dt", dt, "s")
        delays = np.array(delays_of(nominal, delay, dt))
    candidates = tuple(
        Point(_sampled(lft, row, dt, delays), plant.values(row)) for row in rows
    )
    first = Point((lin.A, lin.B, lin.C, lin.D))
    whole = lft if dt is None else None
    return Points(lin, (first,), candidates, len(corners), whole)


def _sampled(
    lft: LFT, deltas: Array, dt: float | None, delays: Array
) -> tuple[Array, Array, Array, Array]:
    """Return the matrices of an uncertain model at deltas, sampled at dt [s]."""
    A, B, C, D = lft.at(deltas)
    if dt is None:
        return A, B, C, D
    held = HeldSystem(A, B, dt, delays)
    return (*held.sampled(), *held.outputs(C, D))


def named(point: Point) -> str:
    """Return the values of the parameters of a point as text."""
    if not point.parameters:
        return "nominal"
    return ", ".join(f"{key} {value:.4g}" for key, value in point.parameters.items())
