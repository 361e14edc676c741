"""Validity of a linear model: its prediction error, and settling of its closed loop."""

import math
from collections import Counter
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np

from fflin.base import html
from fflin.base.errors import ChartError, ConstraintError, InputError
from fflin.base.intervals import until_failure
from fflin.base.tables import folded
from fflin.base.validation import (
    Array,
    FrozenArrays,
    Indices,
    count,
    number,
    share,
    whole,
)
from fflin.batch.run import Execution, Progress
from fflin.campaign.runs import expect, notes_on_engine
from fflin.campaign.settling import OUTCOMES, PATIENCE, Loop, settle
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot
from fflin.simulation.report import TRUSTED

# The prediction error is measured at these fractions of the largest displacement, in _DIRECTIONS
# directions.
_LEVELS = 2.0 ** np.arange(-6.0, 1.0)
_DIRECTIONS = 4

_ROUNDING = 1e-7  # smaller prediction errors are integration errors

# Number of directions in which a displacement of a robot with constraints is tried.
_ATTEMPTS = 30

# Largest accepted value of a displacement argument.
_FARTHEST = 1e6


@dataclass(frozen=True, eq=False, repr=False)
class Validity(html.Reported, FrozenArrays):
    """Range of validity of a linear model and its closed loop; ``print`` shows a summary.

    The closed loop is simulated from initial displacements of several levels. The level of a
    displacement is its size as a fraction of the largest displacement that was tested. Base
    attitude, base position and joints are displaced at the same time, in a random direction. A run
    ends if the base rotates past 180 deg, because the linear model does not predict this. In
    simulations and campaigns, the law continues there.

    Attributes
    ----------
    levels : ndarray (k,)
        Levels at which the prediction error was measured.
    prediction_error : ndarray (k,)
        Largest error in the motion that the linear model predicts over three time constants of the
        closed loop, as a fraction of the initial displacement. Errors are measured in the norm of
        the loop's Lyapunov function. The value is NaN if a run left the chart or became singular.
    slope : float
        Exponent k with which the absolute error grows as displacement^k, fitted to the four
        smallest levels. The expected value is 2, because linearisation neglects terms of second
        order. The value is NaN if one of these errors is as small as the integration error, or a
        run left the chart.
    trusted : dict
        Displacement {"attitude" [deg], "position" [m], "joint" [joint_unit]} at which
        `prediction_error` reaches 10 %.
    sampled : ndarray (N,)
        Levels of the random initial displacements, ascending.
    outcomes : tuple of str
        Outcome of the run from each random displacement: "settled", "slow" (not settled within the
        allowed time), "chart" (approached a rotation of 180 deg), "diverged", or "singular"
        (reached a posture at which the rank of the constraints changes).
    holds : dict
        Displacement up to which every random run settled, with the keys of `trusted`.
    inside : int
        Number of random runs with displacements up to `holds`.
    inside_rate : float
        Lower confidence bound, at the level `confidence`, on the fraction of displacements up to
        `holds` from which the loop settles.
    rate : tuple of float
        Clopper-Pearson interval of the fraction of all displacements from which the loop settles.
    confidence : float
        Confidence level of the intervals.
    joint_unit : str
        "rad" or "m" if all joints have this unit, otherwise "rad|m".
    frame : str
        Frame whose axes express the base velocities and inputs in the feedback.
    notes : tuple of str
        Why the runs were simulated in Python although no engine was given.
    residual : float
        Largest distance [m|rad] of an initial configuration from the constraints of the robot; 0
        without constraints.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> reach = fflin.validity(robot, lin, fflin.lqr(lin), samples=4)
    >>> sorted(reach.trusted), bool(1.5 < reach.slope < 2.5)
    (['attitude', 'joint', 'position'], True)
    """

    levels: Array
    prediction_error: Array
    slope: float
    trusted: dict[str, float]
    sampled: Array
    outcomes: tuple[str, ...]
    holds: dict[str, float]
    inside: int
    inside_rate: float
    rate: tuple[float, float]
    confidence: float
    largest: dict[str, float]
    joint_unit: str
    robot: str
    frame: str
    notes: tuple[str, ...] = ()
    residual: float = 0.0

    @property
    def settled(self) -> int:
        """Number of runs that settled."""
        return self.outcomes.count("settled")

    def __str__(self) -> str:
        trusted, holds, largest = (
            shown(displacement, self.joint_unit)
            for displacement in (self.trusted, self.holds, self.largest)
        )
        count = len(self.outcomes)
        sure = f"{100.0 * self.confidence:g} %"
        low, high = self.rate
        ends = Counter(self.outcomes)
        failures = ", ".join(
            f"{ends[key]} {words}" for key, words in _ENDS.items() if ends[key]
        )
        order = "the order of the error cannot be determined"
        if np.isfinite(self.slope):
            order = (
                f"the error grows with the displacement to the power {self.slope:.3f}"
            )
        beyond = (
            ", the largest displacement tested" if self.trusted == self.largest else ""
        )
        first = shown(_scaled(self.largest, float(self.sampled[0])), self.joint_unit)
        prediction = (
            f"{self.robot}: the linear loop predicts the nonlinear loop within "
            f"{100.0 * TRUSTED:g} % up to {trusted}{beyond}; {order}"
        )
        safe = f"the run from the smallest displacement tried, {first}, did not settle"
        if self.inside:
            safe = (
                f"up to {holds}, every run settled ({self.inside} of {self.inside}), so at least "
                f"{100.0 * self.inside_rate:.1f} % of such displacements settle ({sure} confidence)"
            )
        overall = (
            f"up to {largest}, {self.settled} of {count} runs settled, so {100.0 * low:.1f} to "
            f"{100.0 * high:.1f} % of such displacements settle ({sure} confidence)"
        )
        if failures:
            overall += f"; {failures}"
        return folded([prediction, safe, overall, *self.notes])


_ENDS = {
    "slow": "did not settle in the allowed time",
    "chart": "approached a rotation of 180 deg",
    "diverged": "diverged",
    "singular": "reached a singular posture of the constraints",
}


def validity(
    robot: Robot,
    lin: LinearModel,
    gain: object,
    *,
    attitude: float = 90.0,
    position: float = 0.5,
    joint: float = 1.0,
    samples: int = 100,
    seed: int = 0,
    confidence: float = 0.95,
    limits: object = None,
    executor: Executor | None = None,
    workers: int | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
    engine: str | None = None,
) -> Validity:
    """Find displacements up to which a linear model predicts the motion and its loop settles.

    The nonlinear robot is simulated under the feedback ``u = u0 - K (x - x0)``; if the model is
    sampled, u is held between samples. All runs start from a displaced configuration and the
    velocity of the operating point. There are two sets of runs:

    - Runs from displacements of growing size show how far the motion departs from the linear
      prediction.
    - Runs from random displacements show whether the loop settles. A run has settled if its error
      falls to a thousandth of its initial value within the allowed time. The allowed time is three
      times the settling time of the slowest mode of the linear loop.

    If the robot has constraints, the independent coordinates of the model are displaced. The other
    coordinates follow in small stages, such that the constraints stay closed. Displacements that no
    closed configuration has are drawn again.

    If numba is installed, the compiled loop computes eight runs at a time.

    Parameters
    ----------
    robot : Robot
        Robot of the model, with the same inputs.
    lin : LinearModel
        Model about an equilibrium, full or reduced, continuous or sampled.
    gain : Gain or array_like (nu, nx)
        Gain K, which must stabilise the linear loop.
    attitude, position, joint : float
        Largest displacements to test: of the base attitude [deg], of the base position [m] and of
        the most displaced joint [rad|m]. A state that is missing from a reduced model, or that the
        gain does not regulate, is not displaced; its displacement is reported as 0.
    samples, seed : int
        Number of random runs, and random seed. The same seed gives the same result for any executor
        or number of workers.
    confidence : float
        Confidence level of the intervals.
    limits : optional
        Limits at which the inputs saturate, as in `simulate`. By default, the inputs do not
        saturate, and thrusts may be negative.
    executor, workers, threads, engine, progress : optional
        As in `monte_carlo`; ``progress(done, total)`` counts the runs of both sets.

    Returns
    -------
    Validity
        Prediction errors, outcomes of the random runs, and success rates with their intervals.

    Raises
    ------
    InputError
        If one of these conditions is true:

        - the linear loop is unstable;
        - the operating point is not an equilibrium;
        - the poles are so far apart that a run would take a million steps;
        - the constraints of the robot cannot be closed at displacements of this size;
        - an argument has a wrong size or value.
    FflinError
        If a worker process dies.

    References
    ----------
    C. J. Clopper and E. S. Pearson, The use of confidence or fiducial limits illustrated in the
    case of the binomial, Biometrika 26(4), 1934.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> reach = fflin.validity(robot, lin, fflin.lqr(lin), samples=4)
    >>> reach.inside <= 4, len(reach.outcomes)
    (True, 4)
    """
    loop = Loop(robot, lin, gain)
    largest = _checked_displacement(loop.lin, attitude, position, joint)
    samples = count("samples", samples)
    seed = whole("seed", seed, 0)
    confidence = share("confidence", confidence)
    how = Execution(executor, workers, threads, None, progress)
    levels = (np.arange(samples) + 0.5) / samples

    def displaced(levels: Array, streams: Indices) -> Array:
        """Return the initial deviations (N, nx) of runs; each random stream gives one direction."""
        x = [
            _displaced(loop, _scaled(largest, level), seed, stream)
            for level, stream in zip(levels.tolist(), streams.tolist(), strict=True)
        ]
        return np.array(x) - loop.start

    streams = np.repeat(np.arange(_DIRECTIONS), len(_LEVELS))
    # The first set of runs measures the prediction error. The second set shows whether the loop
    # settles from random displacements.
    first = displaced(np.tile(_LEVELS, _DIRECTIONS), streams)
    second = displaced(levels, _DIRECTIONS + np.arange(samples))
    predicting, settling = (
        partial(loop.runs, predicts, limits, largest["joint"], engine)
        for predicts in (True, False)
    )
    total = len(first) + samples
    example = predicting()
    with how:
        # A random run usually settles, and ends, after about 1 / PATIENCE of its largest duration.
        # So all random runs take about as long as `few` runs of the largest duration.
        few = math.ceil(samples / PATIENCE)
        expect(
            how.progress,
            [(example, first, len(first)), (settling(), second, few)],
            how,
        )
        part_progress = how.progress and partial(_report, how.progress, 0, total)
        predicted = settle(predicting, first, how, part_progress)
        part_progress = how.progress and partial(
            _report, how.progress, len(first), total
        )
        random = settle(settling, second, how, part_progress)
    error = predicted["error"].reshape(_DIRECTIONS, -1).max(axis=0)
    outcomes = tuple(OUTCOMES[int(code)] for code in random["outcome"])
    failed = np.array([outcome != "settled" for outcome in outcomes])
    inside, bound, rate = until_failure(failed, confidence)
    safe_level = float(levels[inside - 1]) if inside else 0.0
    return Validity(
        levels=_LEVELS,
        prediction_error=error,
        slope=_slope(error),
        trusted=_scaled(largest, _crossing(error)),
        sampled=levels,
        outcomes=outcomes,
        holds=_scaled(largest, safe_level),
        inside=inside,
        inside_rate=bound,
        rate=rate,
        confidence=confidence,
        largest=largest,
        joint_unit=joint_unit(loop.lin),
        robot=loop.lin.robot,
        frame=loop.lin.frame,
        residual=loop.residual(loop.start + np.vstack((first, second))),
        notes=notes_on_engine(example, engine),
    )


def _displaced(
    loop: Loop, displacement: dict[str, float], seed: int, stream: int
) -> Array:
    """Return a state (nx,) after a displacement in the direction of a random stream.

    If the constraints of the robot cannot be closed there, the direction is drawn again.
    """
    for attempt in range(_ATTEMPTS):
        key = (stream, attempt) if attempt else (stream,)
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
        try:
            return loop.displaced(rng, **displacement)
        except (ConstraintError, ChartError):
            continue
    raise InputError(
        f"the constraints of '{loop.robot.name}' were not closed at {_ATTEMPTS} random "
        f"displacements by {shown(displacement, joint_unit(loop.lin))}; give smaller values for "
        "attitude, position and joint"
    )


def _report(progress: Progress, before: int, total: int, done: int, _: int) -> None:
    progress(before + done, total)


def _slope(errors: Array) -> float:
    """Return the exponent k for which the absolute error grows as displacement^k, or NaN.

    The exponent of the relative error is fitted to the four smallest levels; k is one more than
    this exponent. The result is NaN if one of these errors is NaN or as small as the integration
    error.
    """
    if not errors[:4].min() > _ROUNDING:
        return np.nan
    return 1.0 + float(np.polyfit(np.log(_LEVELS[:4]), np.log(errors[:4]), 1)[0])


def _crossing(errors: Array) -> float:
    """Return the level at which the relative error reaches TRUSTED, interpolated between levels.

    If no error exceeds TRUSTED, return 1.
    """
    beyond = np.flatnonzero(~(errors <= TRUSTED))
    if not len(beyond):
        return 1.0
    first = int(beyond[0])
    if first == 0 or not np.isfinite(errors[first]):
        # Below the smallest level, the error is not known. If a run left the chart or diverged, the
        # error at the index `first` is NaN. In both cases, the error is not interpolated, but
        # assumed to be proportional to the level. If errors[0] is NaN, the result is 0.
        at = max(first - 1, 0)
        near = float(min(_LEVELS[at] * TRUSTED / errors[at], _LEVELS[first]))
        if not np.isfinite(errors[0]):
            return 0.0
        return near
    pair = slice(first - 1, first + 1)
    return float(
        np.exp(np.interp(np.log(TRUSTED), np.log(errors[pair]), np.log(_LEVELS[pair])))
    )


def _checked_displacement(
    lin: LinearModel, attitude: float, position: float, joint: float
) -> dict[str, float]:
    """Validate the largest displacements, and return them as {quantity: value}.

    The quantities are "attitude", "position" and "joint". A quantity without a state in the model
    gets the value 0.
    """
    given = {"attitude": attitude, "position": position, "joint": joint}
    given = {key: number(key, value) for key, value in given.items()}
    if given["attitude"] >= 175.0 or not all(
        0.0 <= x <= _FARTHEST for x in given.values()
    ):
        raise InputError(
            f"the displacements are {shown(given)}, but each must be 0 or more and at most "
            f"{_FARTHEST:g}, and the rotation must be less than 175 deg, because the attitude "
            "chart ends at 180 deg"
        )
    groups = {name.partition(".")[0] for name in lin.state_names}
    names = {"attitude": "q_b", "position": "r_b", "joint": "q_m"}
    largest = {}
    for key, name in names.items():
        largest[key] = given[key] if name in groups else 0.0
    if not any(largest.values()):
        raise InputError(
            "no state of the model is displaced; give a nonzero displacement of one of its states"
        )
    return largest


def _scaled(largest: dict[str, float], level: float) -> dict[str, float]:
    """Return a displacement multiplied by the factor `level`."""
    return {key: level * value for key, value in largest.items()}


def joint_unit(lin: LinearModel) -> str:
    """Return the unit that all joints of the model share, or "rad|m" if there is no such unit."""
    pairs = zip(lin.state_names, lin.state_units, strict=True)
    units = {unit for name, unit in pairs if name.startswith("q_m.")}
    if len(units) == 1:
        return units.pop()
    return "rad|m"


def shown(displacement: dict[str, float], of_joints: str = "rad|m") -> str:
    """Format a displacement; entries that are zero are omitted."""
    units = {"attitude": "deg", "position": "m", "joint": of_joints}
    words = [
        f"{displacement[key]:.3g} {unit}"
        for key, unit in units.items()
        if displacement[key]
    ]
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:]))) or "0"
