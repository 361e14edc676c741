"""Values of goals in a closed loop, with derivatives: peak gains, variances, poles and steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fflin.base.errors import InputError
from fflin.base.validation import Array, Values
from fflin.tuning.channels import Channel, Ends
from fflin.tuning.closed_loop import ClosedLoop
from fflin.tuning.goals import Damping, Decay, Goal, Margin, Track, Variance

# Frequencies of the logarithmic grid, and how far it reaches beyond the poles.
_GRID, _BEYOND = 48, 30.0

# A local peak is refined and reported if it is above this fraction of the highest one, and at most
# _PEAKS of them.
_NEAR, _PEAKS = 0.7, 6

# Each refinement divides the interval about a peak by _PARTS / 2. A parabola then gives the peak.
_PARTS, _REFINEMENTS = 8, 4

# Poles whose values are above _NEAR of the largest are reported, at most _POLES.
_POLES = 6

# Rounding error of a number of samples.
_ROUNDING = 1e-9

# Least distance of a transformed pole from a pole of the transformation.
_AT_ONCE = 1e-9

# Number of instants of a step response.
_STEPS = 2000


@dataclass(frozen=True, eq=False)
class Piece:
    """Value of a goal at one frequency, pole or time, with its derivatives.

    `where` is the frequency [rad/s], the magnitude of the pole, or the time [s]. `gradient` returns
    the derivatives (p,) for the parameters of the law, and (c,) for the scaling of the channels.
    """

    value: float
    where: float
    gradient: Callable[[], tuple[Array, Array]]


_NOTHING = np.zeros(0)


def pieces_of(
    goal: Goal,
    ends: Ends | None,
    channel: Channel | None,
    loop: ClosedLoop,
    scaling: Array,
    floor: float = 0.0,
) -> list[Piece]:
    """Return the pieces of a goal in a stable closed loop, the largest first.

    Peaks of gains below `floor` are not refined.
    """
    if isinstance(goal, Decay):
        return _decay(goal, loop)
    if isinstance(goal, Damping):
        return _damping(goal, loop)
    assert ends is not None
    assert channel is not None
    if isinstance(goal, Variance):
        return _variances(ends, channel, loop)
    if isinstance(goal, Track):
        return _step_errors(goal, channel, loop)
    factors = np.exp(scaling) if isinstance(goal, Margin) else None
    return _peaks(ends, channel, loop, factors, floor)


def scaled(
    system: tuple[Array, Array, Array, Array], factors: Array | None
) -> tuple[Array, Array, Array, Array]:
    """Return the channel diag(d) T diag(d)^-1."""
    if factors is None:
        return system
    A, B, C, D = system
    rows = factors[:, None]
    return A, B / factors, rows * C, rows * D / factors


def grid_of(loop: ClosedLoop, ends: Ends) -> Array:
    """Return frequencies [rad/s] of the plant at which the gain of a channel is examined first."""
    plant = loop.plant
    poles = loop.poles
    sizes = np.abs(poles)
    sizes = sizes[sizes > 0.0]
    resonant = poles[np.abs(poles.real) < 0.3 * np.abs(poles)]
    low, high = (plant.warped(end) for end in ends.band)
    places = (*ends.weight.corners, *ends.watched)
    corners = [plant.warped(corner) for corner in places]
    parts = [sizes, np.abs(poles.imag), np.array(corners)]
    for width in (-1.0, 1.0):
        parts.append(np.abs(resonant) + width * resonant.real)
    if len(sizes):
        least, most = sizes.min() / _BEYOND, sizes.max() * _BEYOND
        parts.append(np.geomspace(least, most, _GRID))
    inside = np.concatenate(parts)
    inside = inside[(inside > low) & (inside < high)]
    ends_of_band = [low]
    if math.isfinite(high):
        ends_of_band.append(high)
    return np.unique(np.concatenate((inside, ends_of_band, [math.inf])))


def gains_at(
    loop: ClosedLoop,
    system: tuple[Array, Array, Array, Array],
    ends: Ends,
    frequencies: Array,
) -> Array:
    """Return the weighted gains at frequencies of the plant."""
    responses = loop.responses(system, frequencies)
    if min(responses.shape[1:]) == 1:
        gains = np.linalg.norm(responses, axis=(1, 2))
    else:
        adjoint = responses.conj().transpose(0, 2, 1)
        gram = responses @ adjoint
        if responses.shape[1] > responses.shape[2]:
            gram = adjoint @ responses
        if not np.isfinite(gram).all():
            return np.full(len(gram), np.inf)
        gains = np.sqrt(np.maximum(np.linalg.eigvalsh(gram)[:, -1], 0.0))
    weighted: Array = gains * weights_at(loop, ends, frequencies)
    return weighted


def weights_at(loop: ClosedLoop, ends: Ends, frequencies: Array) -> Array:
    """Return the gains of the weight at frequencies of the plant.

    The highest frequency of a sampled plant is half the sample rate.
    """
    plant = loop.plant
    weight = ends.weight
    if len(weight.denominator) == 1:
        constant = float(weight.numerator[0] / weight.denominator[0])
        return np.full(len(frequencies), abs(constant))
    if not plant.dt:
        return weight.at(frequencies)
    return weight.at(2.0 * np.arctan(0.5 * plant.dt * frequencies) / plant.dt)


def _peaks(
    ends: Ends,
    channel: Channel,
    loop: ClosedLoop,
    factors: Array | None,
    floor: float,
) -> list[Piece]:
    """Return the local peaks of the weighted gain of a channel."""
    system = scaled(loop.system(channel), factors)
    grid = grid_of(loop, ends)
    if math.isfinite(loop.plant.warped(ends.band[1])):
        grid = grid[:-1]
    gains = gains_at(loop, system, ends, grid)
    if not np.isfinite(gains).all():
        return [Piece(math.inf, 0.0, lambda: (_NOTHING, _NOTHING))]
    highest = int(gains.argmax())
    if gains[highest] < floor:
        return [_gain_piece(ends, channel, loop, factors, float(grid[highest]))]
    grid, gains = _halved(loop, system, ends, grid, gains)
    padded = np.concatenate(([-1.0], gains, [-1.0]))
    is_peak = (gains >= padded[:-2]) & (gains >= padded[2:])
    chosen = np.flatnonzero(is_peak & (gains >= _NEAR * gains.max()))
    chosen = chosen[np.argsort(-gains[chosen], kind="stable")][:_PEAKS]
    peaks: dict[float, None] = {}
    last = len(grid) - 1
    inner = [int(i) for i in chosen if np.isfinite(grid[i])]
    for i in chosen:
        if not np.isfinite(grid[i]):
            peaks[math.inf] = None
    if inner:
        lows = grid[[max(i - 1, 0) for i in inner]]
        highs = grid[[min(i + 1, last) for i in inner]]
        middles = grid[inner]
        highs = np.where(np.isfinite(highs), highs, 2.0 * middles + 1e-300)
        best = gains[inner]
        rows = np.arange(len(inner))
        for _ in range(_REFINEMENTS):
            steps = np.linspace(0.0, 1.0, _PARTS + 1)
            trials = lows[:, None] + (highs - lows)[:, None] * steps
            values = gains_at(loop, system, ends, trials.ravel()).reshape(trials.shape)
            index = values.argmax(axis=1)
            improved = values[rows, index] >= best
            best = np.where(improved, values[rows, index], best)
            middles = np.where(improved, trials[rows, index], middles)
            width = (highs - lows) / _PARTS
            lows = np.maximum(lows, middles - width)
            highs = np.minimum(highs, middles + width)
        middles = _vertices(loop, system, ends, middles, lows, highs)
        for w in middles.tolist():
            peaks[w] = None
    pieces = [_gain_piece(ends, channel, loop, factors, w) for w in peaks]
    return sorted(pieces, key=lambda piece: -piece.value)


def _halved(
    loop: ClosedLoop,
    system: tuple[Array, Array, Array, Array],
    ends: Ends,
    grid: Array,
    gains: Array,
) -> tuple[Array, Array]:
    """Return a grid with the middles of all intervals near a high gain, and its gains."""
    near = np.maximum(gains[:-1], gains[1:]) >= _NEAR * gains.max()
    near &= np.isfinite(grid[1:])
    middles = 0.5 * (grid[:-1][near] + grid[1:][near])
    places = np.flatnonzero(near) + 1
    inner = gains_at(loop, system, ends, middles)
    return np.insert(grid, places, middles), np.insert(gains, places, inner)


def _vertices(
    loop: ClosedLoop,
    system: tuple[Array, Array, Array, Array],
    ends: Ends,
    middles: Array,
    lows: Array,
    highs: Array,
) -> Array:
    """Return the maxima of parabolas through the gains about each peak, where they are higher."""
    trials = np.concatenate((lows, middles, highs))
    below, best, above = gains_at(loop, system, ends, trials).reshape(3, -1)
    left, right = middles - lows, highs - middles
    with np.errstate(all="ignore"):
        falls = (best - below) / left, (best - above) / right
        vertices = middles + 0.5 * (falls[0] * right - falls[1] * left) / sum(falls)
    inside = (vertices > lows) & (vertices < highs)
    vertices = np.where(inside, vertices, middles)
    higher = gains_at(loop, system, ends, vertices) >= best
    improved: Array = np.where(higher, vertices, middles)
    return improved


def _gain_piece(
    ends: Ends,
    channel: Channel,
    loop: ClosedLoop,
    factors: Array | None,
    frequency: float,
) -> Piece:
    """Return the weighted gain of a channel at a frequency of the plant."""
    T, L, R = loop.response_vectors(channel, frequency)
    if factors is not None:
        T = factors[:, None] * T / factors
        L = factors[:, None] * L
        R = R / factors
    left, sizes, right = np.linalg.svd(T)
    weight = float(weights_at(loop, ends, np.array([frequency]))[0])
    u, v = left[:, 0], right[0].conj()

    def gradient() -> tuple[Array, Array]:
        sensitivity = weight * np.outer((L.T @ u.conj()), (R @ v)).real
        of_scaling = _NOTHING
        if factors is not None:
            of_scaling = weight * sizes[0] * (np.abs(u) ** 2 - np.abs(v) ** 2)
        return loop.gradient(sensitivity), of_scaling

    value = weight * float(sizes[0])
    return Piece(value, loop.plant.time(frequency), gradient)


def _continuous(loop: ClosedLoop) -> tuple[Values, Values]:
    """Return the poles in the time of the model, and their derivatives by the plant's poles."""
    poles = loop.poles
    dt = loop.plant.dt
    if not dt:
        return poles, np.ones(len(poles), complex)
    half: Values = 0.5 * dt * poles
    # A pole at -2/dt is a pole at zero of the sampled loop, which decays at once.
    half = np.where(np.abs(half + 1.0) < _AT_ONCE, -1.0 + _AT_ONCE, half)
    half = np.where(np.abs(half - 1.0) < _AT_ONCE, 1.0 - _AT_ONCE, half)
    return 2.0 * np.arctanh(half) / dt, 1.0 / (1.0 - half**2)


def _decay(goal: Decay, loop: ClosedLoop) -> list[Piece]:
    """Return the required rate divided by the decay rates of the slowest poles."""
    poles, rates = _continuous(loop)
    values = goal.rate / np.maximum(-poles.real, 1e-300)

    def piece(index: int) -> Piece:
        def gradient() -> tuple[Array, Array]:
            change = (rates[index] * loop.pole_gradient(index)).real
            return values[index] / -poles[index].real * change, _NOTHING

        return Piece(float(values[index]), float(abs(poles[index])), gradient)

    return [piece(index) for index in _largest(values, loop)]


def _damping(goal: Damping, loop: ClosedLoop) -> list[Piece]:
    """Return the required damping ratio divided by the ratios of the least damped poles."""
    poles, rates = _continuous(loop)
    sizes = np.abs(poles)
    values = goal.ratio * sizes / np.maximum(-poles.real, 1e-300)
    low, high = goal.band
    values = np.where((sizes >= low) & (sizes <= high), values, 0.0)

    def piece(index: int) -> Piece:
        def gradient() -> tuple[Array, Array]:
            pole, size = poles[index], sizes[index]
            change = rates[index] * loop.pole_gradient(index)
            of_size = (pole.conj() * change).real / size
            of_rate = -change.real
            rate = -pole.real
            return goal.ratio * (of_size / rate - size / rate**2 * of_rate), _NOTHING

        return Piece(float(values[index]), float(sizes[index]), gradient)

    return [piece(index) for index in _largest(values, loop)]


def _largest(values: Array, loop: ClosedLoop) -> list[int]:
    """Return the indices of the largest values; one of each pair of poles."""
    upper = np.flatnonzero(loop.poles.imag >= 0.0)
    order = upper[np.argsort(-values[upper], kind="stable")][:_POLES]
    largest = values[order[0]] if len(order) else 0.0
    return [int(index) for index in order if values[index] >= _NEAR * largest]


def abscissa_pieces(loop: ClosedLoop) -> list[Piece]:
    """Return the real parts of the poles, the largest first, relative to the largest pole."""
    poles = loop.poles
    upper = np.flatnonzero(poles.imag >= 0.0)
    order = upper[np.argsort(-poles.real[upper], kind="stable")][:_POLES]

    def piece(index: int) -> Piece:
        return Piece(
            float(poles[index].real),
            float(abs(poles[index])),
            lambda: (loop.pole_gradient(index).real, _NOTHING),
        )

    return [piece(int(index)) for index in order]


def _variances(ends: Ends, channel: Channel, loop: ClosedLoop) -> list[Piece]:
    """Return the standard deviation of each output of a channel."""
    from scipy.linalg import solve_continuous_lyapunov

    A, B, C, D = loop.system(channel)
    if np.abs(D).max(initial=0.0) > 0.0:
        raise InputError(
            "white noise reaches an output of a Variance goal without a lag, so that the variance "
            "is infinite; add a LowPass to the structure, or leave out this output or noise"
        )
    P = solve_continuous_lyapunov(A, -B @ B.T)
    squares = np.maximum(np.einsum("ij,jk,ik->i", C, P, C), 0.0)
    deviations = np.sqrt(squares)
    nz = loop.nz
    D12 = np.hstack((channel.D12, np.zeros((len(channel.D12), nz))))
    D21 = np.vstack((channel.D21, np.zeros((nz, channel.D21.shape[1]))))

    def piece(row: int) -> Piece:
        def gradient() -> tuple[Array, Array]:
            c = C[row : row + 1]
            Q = solve_continuous_lyapunov(A.T, -c.T @ c)
            forces = loop.B2.T @ Q
            sensitivity = forces @ P @ loop.C2.T + forces @ B @ D21.T
            sensitivity += D12[row : row + 1].T @ c @ P @ loop.C2.T
            if not deviations[row]:
                return np.zeros(len(loop.changes)), _NOTHING
            return loop.gradient(sensitivity / deviations[row]), _NOTHING

        return Piece(float(deviations[row]), math.nan, gradient)

    order = np.argsort(-deviations, kind="stable")
    largest = deviations[order[0]]
    return [piece(int(row)) for row in order if deviations[row] >= _NEAR * largest]


def step_times(goal: Track, dt: float) -> tuple[Array, float]:
    """Return the instants [s] of a step response, and their distance.

    The trapezoidal rule makes a step at -h/2 of a step at 0. One of the instants of a continuous
    plant is the settling time.
    """
    if dt:
        number = max(2, math.ceil(goal.examined / dt - _ROUNDING))
        return dt * np.arange(number + 1), dt
    before = math.ceil(goal.settling / goal.examined * _STEPS)
    step = goal.settling / (before + 0.5)
    number = math.ceil(goal.examined / step)
    return step * (np.arange(number) + 0.5), step


def powers(matrix: Array, vector: Array, count: int) -> Array:
    """Return the rows ``matrix^k vector`` (count, n) for k = 0, 1, ..., count - 1."""
    rows = np.zeros((count, len(vector)))
    rows[0] = vector
    power = matrix.T
    done = 1
    while done < count:
        more = min(done, count - done)
        rows[done : done + more] = rows[:more] @ power
        power = power @ power
        done += more
    return rows


def _step_errors(goal: Track, channel: Channel, loop: ClosedLoop) -> list[Piece]:
    """Return the largest violations of the template of a step response.

    The trapezoidal rule, which is exact for sampled plants, integrates the loop.
    """
    A, B, C, D = loop.system(channel)
    times, h = step_times(goal, loop.plant.dt)
    n = len(A)
    inverse = np.linalg.inv(np.eye(n) - 0.5 * h * A)
    advance = inverse @ (np.eye(n) + 0.5 * h * A)
    nz = loop.nz
    D12 = np.hstack((channel.D12, np.zeros((len(channel.D12), nz))))[0]
    D21 = np.vstack((channel.D21, np.zeros((nz, channel.D21.shape[1]))))[:, 0]
    # The state xi of the loop has x_k = xi_(k+1) + xi_k for the input of sample k, here a step.
    drive = 0.5 * h * inverse @ B[:, 0]
    halves = np.zeros((len(times) + 1, n))
    halves[1:] = powers(advance, drive, len(times)).cumsum(axis=0)
    states = halves[1:] + halves[:-1]
    # The reference is the negative of the error of the sensor.
    errors = -(states @ C[0] + D[0, 0]) - 1.0
    low, high = goal.bounds(times)
    ratios = np.where(errors > 0.0, errors / high, errors / low)
    padded = np.concatenate(([-1.0], ratios, [-1.0]))
    is_peak = (ratios >= padded[:-2]) & (ratios >= padded[2:])
    chosen = np.flatnonzero(is_peak & (ratios >= _NEAR * ratios.max()) & (times > 0.0))
    chosen = chosen[np.argsort(-ratios[chosen], kind="stable")][:_PEAKS]
    measured = states @ loop.C2.T + D21

    def impulses(count: int) -> Array:
        """Return the responses (count, m) of the output to impulses of all gains."""
        # Response of xi: x_k = xi_(k+1) + xi_k after one sample of input.
        column = 0.5 * h * (inverse.T @ C[0])
        columns = powers(advance.T, column, count)
        columns[1:] += columns[:-1].copy()
        rows: Array = columns @ loop.B2
        rows[0] += D12
        return rows

    def piece(k: int) -> Piece:
        def gradient() -> tuple[Array, Array]:
            rows = impulses(k + 1)
            sensitivity = rows[::-1].T @ measured[: k + 1]
            bound = high[k] if errors[k] > 0.0 else low[k]
            return loop.gradient(-sensitivity / bound), _NOTHING

        return Piece(float(ratios[k]), float(times[k]), gradient)

    pieces = [piece(int(k)) for k in chosen]
    if not pieces:
        pieces = [piece(int(ratios.argmax()))]
    return pieces
