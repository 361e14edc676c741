"""Pointing errors over the runs of a campaign, with quantiles and confidence intervals."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np

from fflin.base import html, intervals
from fflin.base.errors import FflinWarning, InputError, unknown
from fflin.base.intervals import Estimate
from fflin.base.tables import folded, grid
from fflin.base.validation import (
    Array,
    ArrayLike,
    FrozenArrays,
    Indices,
    instance,
    share,
)
from fflin.batch.run import Execution
from fflin.simulation.pointing import Pointing, PointingError, pointing

if TYPE_CHECKING:
    from fflin.campaign.campaign import Campaign
    from fflin.campaign.runs import CampaignJob
    from fflin.robot.robot import Robot

# {statistic over the time of a run: end of the name of its figure}
_STATISTICS = {"largest": "", "rms": " rms", "p95": " p95", "p997": " p997"}

# Titles of the kinds of errors in the report.
_TITLES = {
    "absolute": "absolute",
    "mean": "mean of a window",
    "relative": "relative to the mean",
    "drift": "drift",
}

# Quantiles over the runs that the report and the record contain.
_QUANTILES = (0.5, 0.95)

# Errors in the report are in seconds of arc if all of them are below this angle [deg].
_SMALL = 0.02
_ARCSEC = 3600.0

# Errors of at most this size are rounding errors, and shown as a dot.
_ZERO = 1e-12


@dataclass(frozen=True, eq=False, repr=False)
class CampaignPointing(FrozenArrays, html.Reported):
    """Pointing errors of N runs of a campaign, in the terms of ECSS-E-ST-60-10C.

    Figures are numbers that describe one run. `values`, `quantile` and `fraction` use them by these
    names:

    - ``ERROR AXIS`` [deg]: largest error of the run. ERROR is ``absolute``, ``mean``, ``relative``
      or ``drift``, and AXIS is ``x``, ``y``, ``z``, ``angle`` or ``line of sight``.
    - ``ERROR AXIS rms``, ``ERROR AXIS p95`` and ``ERROR AXIS p997`` [deg]: root mean square, and
      the values that are not exceeded in 95 % and 99.7 % of the time of the run.
    - ``settled`` [s]: time after which the angle stays below `accuracy`; infinite if it does not.
    - ``wheel speed`` and ``wheel torque``: largest used fraction of the limit of a wheel.
    - ``pulses``, ``impulse`` [N s] and ``propellant`` [kg] of the thrusters.

    A quantile of the largest errors over the runs is the ensemble interpretation of the standard. A
    run that was stopped early has infinite figures, and meets no condition.

    Attributes
    ----------
    axes : tuple of str
        Columns of the errors: "x", "y", "z" and "angle", or "line of sight".
    absolute, mean, relative, drift : PointingError
        Errors [deg] of each run; each array is (N, k). `drift` is None if runs are too short.
    after : ndarray (N,)
        Time [s] from which the errors of each run are counted.
    settled : ndarray (N,)
        Settling times [s]; NaN without `accuracy`.
    window, apart : float
        Length of the windows, and time between the windows of the drift [s].
    accuracy : float or None
        Angle [deg] of the settling time.
    momentum_used, torque_used : mapping
        For each wheel with a limit, the largest speed or torque of each run (N,) as a fraction of
        the limit.
    thrusters : mapping
        ``pulses``, ``impulse`` [N s] and ``propellant`` [kg] of each run (N,), if known.
    confidence : float
        Confidence level of the intervals.
    robot : str

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    >>> runs = fflin.monte_carlo(robot, policy, {"q_b": 0.02}, runs=8, duration=20.0, dt=0.05)
    >>> pointing = runs.pointing(2.0, accuracy=0.5)
    >>> pointing.fraction("absolute angle < 1 deg and settled < 20 s").value
    1.0
    >>> pointing.absolute.largest.shape, pointing.quantile("relative angle", 0.95).value < 1.0
    ((8, 4), True)
    """

    axes: tuple[str, ...]
    absolute: PointingError
    mean: PointingError
    relative: PointingError
    drift: PointingError | None
    after: Array
    settled: Array
    window: float
    apart: float
    accuracy: float | None
    momentum_used: Mapping[str, Array]
    torque_used: Mapping[str, Array]
    thrusters: Mapping[str, Array]
    confidence: float
    robot: str

    def __len__(self) -> int:
        return len(self.after)

    @property
    def stopped(self) -> int:
        """Number of runs that were stopped early."""
        return int(np.isinf(self.after).sum())

    def names(self) -> list[str]:
        """Return the names of all figures."""
        return list(self._figures())

    def values(self, name: str) -> Array:
        """Return a figure of every run (N,), such as ``absolute angle``.

        Raises
        ------
        UnknownNameError
            If there is no such figure.
        """
        return self.figure(name)[0]

    def figure(self, name: str) -> tuple[Array, str]:
        """Return a figure of every run (N,), and its unit."""
        figures = self._figures()
        name = instance("name", name, str, "the name of a figure")
        if name not in figures:
            raise unknown("figure", name, list(figures))
        return figures[name]

    def quantile(
        self, name: str, p: float, *, confidence: float | None = None
    ) -> Estimate:
        """Return the p-quantile of a figure over the runs, with its confidence interval.

        The interval is computed from order statistics and is valid for any distribution.
        """
        if confidence is None:
            confidence = self.confidence
        values = self.values(name)
        return intervals.quantile(
            values, share("p", p), share("confidence", confidence)
        )

    def fraction(self, condition: str, *, confidence: float | None = None) -> Estimate:
        """Return the fraction of runs that meet a condition, with its Clopper-Pearson interval.

        The condition is a text as in `Campaign.met`, such as ``absolute angle < 0.02 deg``. Angles
        may also be in arcsec.
        """
        from fflin.campaign.campaign import bounds_of

        if confidence is None:
            confidence = self.confidence
        instance(
            "condition", condition, str, "a text such as 'absolute angle < 0.02 deg'"
        )
        met = np.isfinite(self.after)
        for bound in bounds_of(condition, self.figure):
            met = met & bound.met
        sure = share("confidence", confidence)
        return intervals.clopper_pearson(int(met.sum()), len(self), sure)

    def _figures(self) -> dict[str, tuple[Array, str]]:
        """Return {name of a figure: (values (N,), unit)}."""
        figures = dict[str, tuple[Array, str]]()
        for kind, error in self._errors().items():
            for statistic, end in _STATISTICS.items():
                arrays = getattr(error, statistic)
                for column, axis in enumerate(self.axes):
                    figures[f"{kind} {axis}{end}"] = arrays[:, column], "deg"
        if self.accuracy is not None:
            figures["settled"] = self.settled, "s"
        used = {"wheel speed": self.momentum_used, "wheel torque": self.torque_used}
        for name, shares in used.items():
            if shares:
                figures[name] = np.max(list(shares.values()), axis=0), ""
        units = {"impulse": "N s", "propellant": "kg"}
        for name, values in self.thrusters.items():
            figures[name] = values, units.get(name, "")
        return figures

    def _errors(self) -> dict[str, PointingError]:
        """Return {kind of error: error}."""
        kinds = {kind: getattr(self, kind) for kind in _TITLES}
        return {kind: error for kind, error in kinds.items() if error is not None}

    def __str__(self) -> str:
        lines = [*self._head(), *self._lines()]
        return f"{folded(self._head())}\n\n{grid(self._rows(), 'll')}" + (
            f"\n\n{folded(self._lines())}" if len(lines) > len(self._head()) else ""
        )

    def _html_parts(self) -> list[str]:
        return [
            *map(html.paragraph, self._head()),
            html.table(self._rows(), "ll"),
            *map(html.paragraph, self._lines()),
        ]

    def _head(self) -> list[str]:
        """Return the title and the meaning of the columns."""
        head = [
            f"{self.robot}: pointing errors of {len(self):,} runs, windows of {self.window:g} s"
        ]
        if self.stopped:
            head.append(
                f"{self.stopped:,} runs were stopped early; their errors are infinite"
            )
        starts = self.after[np.isfinite(self.after)]
        if starts.size and np.ptp(starts):
            head.append(
                "errors count from the settling of each run on, so the largest angle of a run that "
                "settles is at most the accuracy"
            )
        elif starts.size:
            head.append(f"errors count from {starts[0]:.4g} s on")
        head.append(
            "largest error of each run: quantiles over the runs, and the interval of the 95 % "
            f"quantile at {100.0 * self.confidence:g} % confidence"
        )
        high = self.quantile(f"absolute {self.axes[-1]}", 0.95)
        if math.isfinite(high.value) and math.isinf(high.high):
            # The largest of N values is below the quantile with the probability 0.95^N.
            tail = (1.0 - self.confidence) / 2.0
            enough = math.floor(math.log(tail) / math.log(0.95)) + 1
            cause = f"fewer than {enough} runs do not bound the 95 % quantile"
            if len(self) >= enough:
                cause = f"{self.stopped:,} runs were stopped"
            head.append(f"the interval ends at inf, because {cause}")
        return head

    def _rows(self) -> list[list[str]]:
        """Return the table of errors."""
        errors = self._errors()
        finite = self.absolute.largest[np.isfinite(self.after)]
        unit, factor = "deg", 1.0
        if finite.max(initial=0.0) < _SMALL:
            unit, factor = "arcsec", _ARCSEC
        rows = [["error", f"about [{unit}]", "median", "95 %", "from", "to", "rms"]]
        for kind in errors:
            for column, axis in enumerate(self.axes):
                name = f"{kind} {axis}"
                middle = self.quantile(name, 0.5).value
                high = self.quantile(name, 0.95)
                rms = self.quantile(f"{name} rms", 0.95).value
                values = [factor * value for value in (middle, *high, rms)]
                title = "" if column else _TITLES[kind]
                if kind == "drift" and not column:
                    title += f" in {self.apart:g} s"
                rows.append([title, axis, *map(_cell, values)])
        return rows

    def _lines(self) -> list[str]:
        """Return lines on the settling time, the wheels and the thrusters."""
        lines = list[str]()
        figures = self._figures()
        sure = f"at {100.0 * self.confidence:g} % confidence"
        if "settled" in figures:
            settled = int(np.isfinite(self.settled).sum())
            rate = intervals.clopper_pearson(settled, len(self), self.confidence)
            value, low, high = (f"{100.0 * x:.4g}" for x in rate)
            lines.append(
                f"the angle settles within {self.accuracy:g} deg in {value} % of the runs "
                f"({low} to {high} % {sure}), in 95 % of the runs "
                f"{_settling(self.quantile('settled', 0.95).value)}"
            )
        for name in ("wheel speed", "wheel torque"):
            if name in figures:
                used = 100.0 * self.quantile(name, 0.95).value
                lines.append(
                    f"largest {name}: at most {used:.3g} % of its limit in 95 % of the runs"
                )
        for name in self.thrusters:
            unit = figures[name][1]
            value = f"{self.quantile(name, 0.95).value:.3g} {unit}".rstrip()
            lines.append(
                f"{name} of the thrusters: at most {value} in 95 % of the runs"
            )
        return lines


def _settling(time: float) -> str:
    if not math.isfinite(time):
        return "not within the run"
    return f"within {time:.4g} s"


def _cell(value: float) -> str:
    """Format an error, or a dot for a rounding error."""
    if abs(value) <= _ZERO:
        return "."
    return f"{value:.3g}"


def pointing_record(errors: CampaignPointing) -> dict[str, object]:
    """Return the report as JSON values; an estimate is [value, low, high]."""
    quantiles = {}
    for name in errors.names():
        quantiles[name] = {
            f"{p:g}": _finite(errors.quantile(name, p)) for p in _QUANTILES
        }
    names = ("window", "apart", "accuracy", "confidence", "axes", "stopped")
    return {
        **{name: getattr(errors, name) for name in names},
        "units": {name: errors.figure(name)[1] for name in errors.names()},
        "quantiles": quantiles,
    }


def _finite(values: Estimate) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values]


def campaign_pointing(
    campaign: Campaign,
    window: float,
    *,
    after: float | None = None,
    apart: float | None = None,
    accuracy: float | None = None,
    line_of_sight: ArrayLike | None = None,
    robot: Robot | None = None,
    policy: object = None,
    progress: Callable[[int, int], object] | None = None,
    **options: object,
) -> CampaignPointing:
    """Return the pointing errors of all runs, in the terms of ECSS-E-ST-60-10C.

    A campaign does not contain the motions of its runs, so every run is simulated again, and
    `Motion.pointing` is applied to it. Only the figures of each run are kept. Runs of the compiled
    engine are computed on all cores.

    Parameters
    ----------
    campaign : Campaign
        A method of the campaign: ``campaign.pointing(window)``.
    window, after, apart, accuracy, line_of_sight
        As in `Motion.pointing`.
    robot, policy, **options
        As in `Campaign.replay`, for a campaign that was loaded from a file.
    progress : callable, optional
        As in `sweep`.

    Returns
    -------
    CampaignPointing

    Raises
    ------
    InputError
        If all runs were stopped early, if the runs have no target or are too short for a window, or
        if a campaign from a file lacks its robot.

    Warns
    -----
    FflinWarning
        If runs do not end at the recorded state, because the policy or an option differs.

    References
    ----------
    ECSS-E-ST-60-10C, Space engineering: control performance, 2008.
    """
    from fflin.campaign.replay import job_of_campaign

    completed = np.flatnonzero(~campaign.stopped)
    if not len(completed):
        raise InputError("all runs were stopped early, so no run has pointing errors")
    job = job_of_campaign(campaign, robot, policy, options)
    drawn = np.array(campaign.drawn)
    q = np.array(campaign.q)

    def errors_of(runs: Indices) -> list[tuple[Pointing, float]]:
        """Return the pointing errors of a few runs, and how far they end from the recorded q."""
        errors = list[tuple[Pointing, float]]()
        for run, motion in zip(runs.tolist(), job.replays(drawn[runs]), strict=True):
            one = pointing(
                motion,
                window,
                after=after,
                apart=apart,
                accuracy=accuracy,
                line_of_sight=line_of_sight,
            )
            errors.append((one, float(np.abs(motion.q[-1] - q[run]).max())))
        return errors

    found = _of_groups(errors_of, completed, job, progress)
    missed = max(distance for _, distance in found)
    if missed > 0.0:
        warnings.warn(
            f"runs end {missed:.2g} (largest difference of q) from the recorded end; the policy, "
            "an option, the version or the processor differs",
            FflinWarning,
            stacklevel=2,
        )
    return _joined(campaign, completed, [errors for errors, _ in found])


def _of_groups(
    errors_of: Callable[[Indices], list[tuple[Pointing, float]]],
    runs: Indices,
    job: CampaignJob,
    progress: Callable[[int, int], object] | None,
) -> list[tuple[Pointing, float]]:
    """Return the results of a function of groups of runs, which threads compute in parallel."""
    groups = [runs[at : at + job.lanes] for at in range(0, len(runs), job.lanes)]
    results = list[tuple[Pointing, float]]()
    with Execution(progress=progress) as how:
        threads = min(how.count(job), len(groups))
        computed: Iterable[list[tuple[Pointing, float]]] = map(errors_of, groups)
        if threads > 1:
            pool = ThreadPoolExecutor(threads)
            how.callback(pool.shutdown, wait=False, cancel_futures=True)
            computed = pool.map(errors_of, groups)
        begun = monotonic()
        for group in computed:
            if not results:
                _expect(how.progress, monotonic() - begun, len(groups), threads)
            results += group
            if how.progress:
                how.progress(len(results), len(runs))
    return results


def _expect(progress: object, seconds: float, groups: int, threads: int) -> None:
    """Report the estimated time to fflin's progress bar, from the time [s] of the first group."""
    tell = getattr(progress, "expect", None)
    if tell is not None:
        rest = math.ceil(groups / threads) - 1
        tell(rest * seconds, threads, "pointing errors")


def _joined(
    campaign: Campaign, completed: Indices, figures: list[Pointing]
) -> CampaignPointing:
    """Return the figures of all runs; the figures of stopped runs are infinite."""
    count = len(campaign)

    def all_runs(values: Sequence[object]) -> Array:
        rows = np.array(values, float)
        full = np.full((count, *rows.shape[1:]), np.inf)
        full[completed] = rows
        return full

    def errors(kind: str) -> PointingError | None:
        given = [getattr(one, kind) for one in figures]
        if any(error is None for error in given):
            return None
        return PointingError(
            *(
                all_runs([getattr(error, name) for error in given])
                for name in _STATISTICS
            )
        )

    def used(kind: str) -> dict[str, Array]:
        wheels = getattr(figures[0], kind)
        return {
            wheel: all_runs([getattr(one, kind)[wheel] for one in figures])
            for wheel in wheels
        }

    first = figures[0]
    settled = np.full(count, math.nan)
    if first.accuracy is not None:
        times = [math.inf if one.settled is None else one.settled for one in figures]
        settled = all_runs(times)
    absolute, mean, relative = map(errors, ("absolute", "mean", "relative"))
    assert absolute is not None and mean is not None and relative is not None
    return CampaignPointing(
        axes=first.axes,
        absolute=absolute,
        mean=mean,
        relative=relative,
        drift=errors("drift"),
        after=all_runs([one.after for one in figures]),
        settled=settled,
        window=first.window,
        apart=first.apart,
        accuracy=first.accuracy,
        momentum_used=used("momentum_used"),
        torque_used=used("torque_used"),
        thrusters={
            name: all_runs(values) for name, values in _thrusters(figures).items()
        },
        confidence=campaign.confidence,
        robot=campaign.robot,
    )


def _thrusters(figures: list[Pointing]) -> dict[str, list[object]]:
    """Return the figures of the thrusters, as far as they are known in all runs."""
    firings = [one.firings for one in figures]
    if any(firing is None for firing in firings):
        return {}
    known = dict[str, list[object]]()
    for name in ("pulses", "impulse", "propellant"):
        values = [getattr(firing, name) for firing in firings]
        for index, firing in enumerate(firings):
            # Without impulse, no propellant is used.
            if name == "propellant" and firing is not None and not firing.impulse:
                values[index] = 0.0
        if all(value is not None for value in values):
            known[name] = values
    return known
