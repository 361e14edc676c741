"""Pointing errors of a motion, as requirements state them: absolute, mean, relative and drift."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from fflin.base.errors import InputError
from fflin.base.html import Reported
from fflin.base.tables import folded, grid
from fflin.base.validation import (
    Array,
    ArrayLike,
    FrozenArrays,
    Indices,
    Mask,
    number,
    positive,
    vector,
)
from fflin.dynamics.state_rows import attitude_rotations
from fflin.simulation.report import Firings, curves, firings

if TYPE_CHECKING:
    from fflin.simulation.motion import Motion

# Fraction of the time in which an error is below the values of the columns "95 %" and "99.7 %".
_LEVELS = (0.95, 0.997)

# Errors are counted from this fraction of the run on, if neither `after` nor `accuracy` is given.
_LATE = 0.5

# At most this number of windows is evaluated; their starts are then evenly distributed.
_WINDOWS = 2000

# At most about this number of rows of windows is sorted for the quantiles of the relative error.
_ROWS = 200_000

# Sizes are sorted from this fraction of their number on, to find those of _LEVELS.
_SORTED_FROM = 0.9

# Relative difference below which fractions of the time are equal.
_SAME = 1e-9

# Number of rows of windows that are evaluated together; they stay in the cache of the processor.
_BLOCK = 8192

# Errors of at most this size in the unit of the table are rounding errors, and shown as a dot.
_ZERO = 1e-12

# Seconds of arc in a degree. The report uses them if no error exceeds _SMALL [deg].
_ARCSEC = 3600.0
_SMALL = 0.02


class PointingError(NamedTuple):
    """Statistics of one pointing error over time, for each axis and for the whole angle.

    Attributes
    ----------
    largest, rms, p95, p997 : ndarray (k,)
        Largest magnitude, root mean square, and the magnitudes [deg] that are not exceeded in 95 %
        and 99.7 % of the time. k is 4: rotation about x, y and z of the target, and the angle of
        the whole rotation; or 1 for the angle of a line of sight.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> spin = fflin.velocity(robot, {"omega_b.z": 0.1})
    >>> lin = fflin.linearize(robot)
    >>> law = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    >>> motion = fflin.simulate(robot, law, v0=spin, duration=60.0)
    >>> bool(motion.pointing(5.0).absolute.largest[-1] < 1.0)
    True
    """

    largest: Array
    rms: Array
    p95: Array
    p997: Array


@dataclass(frozen=True, eq=False, repr=False)
class Pointing(FrozenArrays, Reported):
    """Pointing errors of a motion from its target, in the terms of ECSS-E-ST-60-10C.

    All errors are in deg, and counted from the time `after` on.

    Attributes
    ----------
    axes : tuple of str
        Names of the columns of the errors: "x", "y", "z", "angle", or "line of sight".
    absolute : PointingError
        Absolute performance error: the error at each time.
    mean : PointingError
        Mean performance error: the mean of the error over each window.
    relative : PointingError
        Relative performance error: the error at each time minus its mean over the window. It is the
        instability within a window.
    drift : PointingError or None
        Performance drift error: the difference of the means of two windows that begin `apart`
        seconds apart; None if the run is too short for it.
    window, apart, after : float
        Length of the windows, time between the windows of the drift, and time from which errors
        are counted [s].
    accuracy : float or None
        Angle [deg] of the settling time.
    settled : float or None
        Time [s] after which the angle stays below `accuracy`; None if it does not, or only for less
        than a window.
    momentum_used, torque_used : mapping
        For each wheel with a limit, the largest magnitude of speed or torque as a fraction of the
        limit.
    firings : Firings or None
        Pulses, impulse [N s] and propellant [kg] of the thrusters.
    robot : str

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> spin = fflin.velocity(robot, {"omega_b.z": 0.1})
    >>> lin = fflin.linearize(robot)
    >>> law = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    >>> motion = fflin.simulate(robot, law, v0=spin, duration=60.0)
    >>> pointing = motion.pointing(5.0, accuracy=0.5)
    >>> pointing.settled < 60.0, pointing.axes
    (True, ('x', 'y', 'z', 'angle'))
    """

    axes: tuple[str, ...]
    absolute: PointingError
    mean: PointingError
    relative: PointingError
    drift: PointingError | None
    window: float
    apart: float
    after: float
    accuracy: float | None
    settled: float | None
    momentum_used: dict[str, float]
    torque_used: dict[str, float]
    firings: Firings | None
    robot: str

    def __str__(self) -> str:
        head = [
            f"{self.robot}: pointing errors from {self.after:.4g} s on, windows of "
            f"{self.window:g} s"
        ]
        if self.accuracy is not None:
            when = "does not settle"
            if self.settled is not None:
                when = f"settles after {self.settled:.4g} s"
            head.append(f"the angle {when} within {self.accuracy:g} deg")
        kinds = {
            "absolute": self.absolute,
            "mean of a window": self.mean,
            "relative to the mean": self.relative,
            f"drift in {self.apart:g} s": self.drift,
        }
        unit, factor = "deg", 1.0
        if self.absolute.largest.max() < _SMALL:
            unit, factor = "arcsec", _ARCSEC
        rows = [["error", f"about [{unit}]", "largest", "rms", "95 %", "99.7 %"]]
        for name, error in kinds.items():
            if error is None:
                continue
            for column, axis in enumerate(self.axes):
                values = [factor * float(array[column]) for array in error]
                cells = [f"{value:.3g}" if value > _ZERO else "." for value in values]
                title = "" if column else name
                rows.append([title, axis, *cells])
        text = [folded(head), grid(rows, "ll")]
        used = {
            "wheel speed": self.momentum_used,
            "wheel torque": self.torque_used,
        }
        lines = [
            f"largest {what}: {100.0 * max(shares.values()):.3g} % of its limit "
            f"({max(shares, key=lambda wheel: shares[wheel])})"
            for what, shares in used.items()
            if shares
        ]
        if self.firings is not None:
            lines.append(str(self.firings))
        if lines:
            text.append(folded(lines))
        return "\n\n".join(text)


def pointing(
    motion: Motion,
    window: float,
    *,
    after: float | None = None,
    apart: float | None = None,
    accuracy: float | None = None,
    line_of_sight: ArrayLike | None = None,
) -> Pointing:
    """Return the pointing errors from the target, in the terms of ECSS-E-ST-60-10C.

    The error is the rotation from the target to the attitude of the base, in target axes. Time
    averages treat it as linear between rows. At most 2000 windows are evaluated, which begin at
    rows of the motion.

    Parameters
    ----------
    motion : Motion
        A method of the motion: ``motion.pointing(window)``.
    window : float
        Length of the windows [s] of the mean and relative errors.
    after : float, optional
        Time [s] from which errors are counted: by default the settling time if `accuracy` is
        given and reached, otherwise half of the run.
    apart : float, optional
        Time [s] between the windows of the drift; `window` by default.
    accuracy : float, optional
        Angle [deg] for the settling time.
    line_of_sight : array_like (3,), optional
        Direction in base axes whose angle from the target is judged instead of the rotation.

    Returns
    -------
    Pointing

    Raises
    ------
    InputError
        If the motion has no target, is too short for a window, or has rows farther apart than a
        window is long.

    References
    ----------
    ECSS-E-ST-60-10C, Space engineering: control performance, 2008.
    """
    window = positive("window", window, "s")
    if not motion.target.size:
        raise InputError(
            "the motion has no target; simulate a policy about a point or along a trajectory"
        )
    errors = np.degrees(attitude_rotations(motion.x, motion.target))
    axes: tuple[str, ...] = ("x", "y", "z", "angle")
    if line_of_sight is not None:
        sight = vector("line_of_sight", line_of_sight, 3, "a direction")
        if not sight.any():
            raise InputError("line_of_sight is zero, expected a direction")
        sight = sight / np.abs(sight).max()
        errors = _sight_errors(errors, sight / np.linalg.norm(sight))
        axes = ("line of sight",)
    angle = np.linalg.norm(errors, axis=1)
    settled = None
    if accuracy is not None:
        accuracy = positive("accuracy", accuracy, "deg")
        settled = _settled(motion.t, angle <= accuracy, window)
    if after is None:
        after = settled if settled is not None else _start(motion.t)
    after = max(number("after", after), float(motion.t[0]))
    apart = window if apart is None else positive("apart", apart, "s")
    counted = motion.t >= after - 1e-9 * max(1.0, abs(after))
    left = float(motion.t[-1]) - after
    if counted.sum() < 3 or left < window * (1.0 - 1e-9):
        raise InputError(
            f"window is {window:g} s, but only {max(left, 0.0):.4g} s of the motion follow "
            f"{after:.4g} s; simulate longer, or give a shorter window or an earlier after"
        )
    t, errors = motion.t[counted], errors[counted]
    _require_rows(t, window)
    columns = len(axes)
    means, starts = _means(t, errors, window)
    drifts = _drifts(t, errors, window, apart)
    drift = None
    if drifts is not None:
        differences, earlier_starts = drifts
        drift = _statistics(differences, _durations(earlier_starts), columns)
    speeds, torques = _wheels(motion)
    return Pointing(
        axes=axes,
        absolute=_statistics(errors, _durations(t), columns),
        mean=_statistics(means, _durations(starts), columns),
        relative=_relative(t, errors, means, starts, window, columns),
        drift=drift,
        window=window,
        apart=apart,
        after=after,
        accuracy=accuracy,
        settled=settled,
        momentum_used=speeds,
        torque_used=torques,
        firings=firings(motion),
        robot=motion.robot,
    )


def _require_rows(t: Array, window: float) -> None:
    """Raise `InputError` if windows are so short that some contain a single row."""
    apart = float(np.diff(t).max())
    if window < apart * (1.0 - 1e-9):
        raise InputError(
            f"window is {window:g} s, but rows of the motion are {apart:.4g} s apart; give a "
            "window of at least this length, or simulate with a smaller dt or every"
        )


def _start(t: Array) -> float:
    return float(t[0] + _LATE * (t[-1] - t[0]))


def _sight_errors(errors: Array, sight: Array) -> Array:
    """Return the angles (N, 2) [deg] by which rotations (N, 3) [deg] turn a unit vector (3,).

    The two columns are the components of the angle about two axes across the vector.
    """
    turns = np.radians(errors)
    angle = np.linalg.norm(turns, axis=1, keepdims=True)
    axis = np.divide(turns, angle, out=np.zeros_like(turns), where=angle > 0.0)
    sine, cosine = np.sin(angle), np.cos(angle)
    along = (axis @ sight)[:, None]
    turned = (
        cosine * sight + sine * np.cross(axis, sight) + (1.0 - cosine) * along * axis
    )
    first = np.cross(sight, np.eye(3)[np.abs(sight).argmin()])
    first /= np.linalg.norm(first)
    across = np.column_stack((first, np.cross(sight, first)))
    parts = turned @ across
    size = np.linalg.norm(parts, axis=1)
    angles = np.arctan2(size, turned @ sight)
    scale = np.divide(angles, size, out=np.ones_like(size), where=size > 0.0)
    components: Array = np.degrees(parts * scale[:, None])
    return components


def _settled(t: Array, inside: Mask, window: float) -> float | None:
    """Return the time from which a condition is true until the end of the motion.

    Return None if the condition is not true for at least `window` [s] before the end.
    """
    outside = np.flatnonzero(~inside)
    first = outside[-1] + 1 if len(outside) else 0
    if first == len(t) or t[-1] - t[first] < window * (1.0 - 1e-9):
        return None
    return float(t[first])


def _integrals(t: Array, errors: Array) -> Array:
    """Return the integral (N, k) of the errors from the first time to each time."""
    steps = 0.5 * (errors[1:] + errors[:-1]) * np.diff(t)[:, None]
    return np.vstack((np.zeros(errors.shape[1]), np.cumsum(steps, axis=0)))


def _window_means(t: Array, errors: Array, starts: Array, window: float) -> Array:
    """Return the means (m, k) over windows that begin at the times `starts` (m,)."""
    totals = _integrals(t, errors)

    def at(times: Array) -> Array:
        # The errors are linear between rows, so their integral is quadratic.
        k = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
        since = (times - t[k])[:, None]
        slope = (errors[k + 1] - errors[k]) / (t[k + 1] - t[k])[:, None]
        value: Array = totals[k] + errors[k] * since + 0.5 * slope * since**2
        return value

    means: Array = (at(starts + window) - at(starts)) / window
    return means


def _starts(t: Array, length: float) -> Array:
    """Return the times at which windows of a length begin, at most _WINDOWS."""
    last = float(t[-1]) - length
    inside = t[t <= last + 1e-9 * max(1.0, abs(last))]
    if len(inside) > _WINDOWS:
        inside = inside[np.linspace(0, len(inside) - 1, _WINDOWS).astype(int)]
    return np.minimum(inside, last)


def _means(t: Array, errors: Array, window: float) -> tuple[Array, Array]:
    """Return the means (m, k) over windows, and the times at which they begin."""
    starts = _starts(t, window)
    return _window_means(t, errors, starts, window), starts


def _drifts(
    t: Array, errors: Array, window: float, apart: float
) -> tuple[Array, Array] | None:
    """Return how much the mean over a window differs from the mean over an earlier window.

    The later window begins `apart` [s] after the earlier one. The first result contains the
    differences (m, k) for m pairs of windows. The second result contains the times (m,) at which
    the earlier windows begin. Return None if the motion is too short for a pair.
    """
    if t[-1] - t[0] < (window + apart) * (1.0 - 1e-9):
        return None
    starts = _starts(t, window + apart)
    earlier_means = _window_means(t, errors, starts, window)
    later_means = _window_means(t, errors, starts + apart, window)
    return later_means - earlier_means, starts


def _relative(
    t: Array, errors: Array, means: Array, starts: Array, window: float, columns: int
) -> PointingError:
    """Return the statistics of the errors minus the mean of their window.

    The largest error is the maximum over all windows. For the other statistics, windows are left
    out if they have very many rows.
    """
    first = np.searchsorted(t, starts - 1e-9 * window)
    after = np.searchsorted(t, starts + window * (1.0 + 1e-9), side="right")
    per_window = len(t) * window / (t[-1] - t[0])
    most = max(int(_ROWS / per_window), 2)
    sampled = slice(None, None, math.ceil(len(starts) / most))
    at, counts = _rows_of_windows(first[sampled], after[sampled])
    by_axis = np.ascontiguousarray(errors.T)  # much faster
    apart = by_axis[:, at] - np.repeat(means[sampled].T, counts, axis=1)
    weights = np.repeat(_durations(starts)[sampled], counts)
    weights *= _shares_of_windows(t, first[sampled], after[sampled])
    statistics = _statistics(apart.T, weights, columns)
    largest = _largest_in_windows(by_axis, means.T, first, after)
    return statistics._replace(largest=largest[-columns:])


def _rows_of_windows(first: Indices, after: Indices) -> tuple[Indices, Indices]:
    """Return the rows of all windows, one window after the other, and their numbers of rows.

    Window i has the rows first[i] to after[i] - 1.
    """
    counts = after - first
    begins = np.cumsum(counts) - counts
    return np.arange(counts.sum()) + np.repeat(first - begins, counts), counts


def _shares_of_windows(t: Array, first: Indices, after: Indices) -> Array:
    """Return the fraction of its window for which each row lasts, by the trapezoidal rule.

    The fractions are in the order of `_rows_of_windows`.
    """
    at, counts = _rows_of_windows(first, after)
    ends = np.cumsum(counts)
    steps = np.diff(t, prepend=t[:1], append=t[-1:])
    before, behind = 0.5 * steps[at], 0.5 * steps[at + 1]
    before[ends - counts] = 0.0
    behind[ends - 1] = 0.0
    lengths = t[after - 1] - t[first]
    # a window with a single row consists of this row
    behind[(ends - 1)[lengths <= 0.0]] = 1.0
    lengths[lengths <= 0.0] = 1.0
    fractions: Array = (before + behind) / np.repeat(lengths, counts)
    return fractions


def _largest_in_windows(
    errors: Array, means: Array, first: Indices, after: Indices
) -> Array:
    """Return the largest magnitudes (k + 1,) of errors minus the mean of their window.

    The errors (k, N) and the means (k, m) have one row for each axis. The last entry of the result
    is the largest norm. Window i has the columns first[i] to after[i] - 1.
    """
    counts = after - first
    squares = np.zeros(len(errors) + 1)
    for count in np.unique(counts):
        windows = sliding_window_view(errors, count, axis=1)
        same = np.flatnonzero(counts == count)
        size = max(1, _BLOCK // int(count))
        for begin in range(0, len(same), size):
            block = same[begin : begin + size]
            parts = windows[:, first[block]] - means[:, block, None]
            parts *= parts
            largest = [*parts.max(axis=(1, 2)), parts.sum(axis=0).max()]
            squares = np.maximum(squares, largest)
    return np.sqrt(squares)


def _durations(t: Array) -> Array:
    """Return the weights (N,) [s] of rows at the times t (N,), by the trapezoidal rule."""
    if len(t) < 2 or t[-1] <= t[0]:
        return np.ones(len(t))
    steps = np.diff(t)
    durations = np.zeros(len(t))
    durations[:-1] += 0.5 * steps
    durations[1:] += 0.5 * steps
    return durations


def _statistics(errors: Array, durations: Array, columns: int) -> PointingError:
    """Return the statistics of errors (m, k), each of which lasts for a duration (m,).

    The statistics have one column for each axis, and a last column for the norm of the error. If
    `columns` is 1, they have only the last column.
    """
    by_axis = errors.T
    norms = np.sqrt((by_axis * by_axis).sum(axis=0))
    sizes = np.vstack((np.abs(by_axis), norms))[-columns:]
    share = durations / durations.sum()
    p95, p997 = np.array([_not_exceeded(row, share) for row in sizes]).T
    rms = np.sqrt(sizes**2 @ share)
    return PointingError(sizes.max(axis=1), rms, p95, p997)


def _not_exceeded(sizes: Array, share: Array) -> list[float]:
    """Return the sizes that are not exceeded in the fractions _LEVELS of the time.

    Each of the sizes (m,) lasts for a fraction `share` (m,) of the time.
    """
    # Only the largest sizes are sorted, which is several times faster.
    place = int(_SORTED_FROM * len(sizes))
    large = np.flatnonzero(sizes >= np.partition(sizes, place)[place])
    if 1.0 - share[large].sum() >= _LEVELS[0] * (1.0 - _SAME):
        large = np.arange(len(sizes))
    large = large[np.argsort(sizes[large])]
    shares = share[large]
    until = 1.0 - shares.sum() + np.cumsum(shares)
    rows = [int((until < level * (1.0 - _SAME)).sum()) for level in _LEVELS]
    return [float(sizes[large[min(row, len(large) - 1)]]) for row in rows]


def _wheels(motion: Motion) -> tuple[dict[str, float], dict[str, float]]:
    """Return the used fractions of the limits of wheel speeds and of wheel torques."""
    speeds = dict[str, float]()
    torques = dict[str, float]()
    kinds = {"speed": speeds, "wheel": torques}
    for curve in curves(motion):
        shares = kinds.get(curve.group)
        limit = min((abs(level) for level in curve.levels), default=math.inf)
        if shares is None or not 0.0 < limit < math.inf:
            continue
        shares[curve.short] = float(np.abs(curve.values).max()) / limit
    return speeds, torques
