"""Linear quadratic regulator with weighted accelerations, in closed form."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fflin.analysis.stabilizability import require_stabilizable
from fflin.analysis.wheels import regulated_part
from fflin.base.errors import InputError, StabilizabilityError
from fflin.base.validation import Array, dimension
from fflin.control.gain import Gain, make_gain
from fflin.control.lqr import require_fixed_point
from fflin.control.riccati import Riccati, Solution
from fflin.control.weights import Weight, weight
from fflin.linear.model import LinearModel


class _Channel(NamedTuple):
    """Gains, blocks of P and poles of every double integrator, an entry each."""

    kp: Array
    kd: Array
    p11: Array
    p12: Array
    p22: Array
    poles: Array


def acceleration_lqr(
    lin: LinearModel,
    Qp: Weight,
    Qv: Weight,
    Ra: Weight,
    *,
    dt: float | None = None,
    wheel_speeds: bool | None = None,
) -> Gain:
    r"""Return the linear quadratic regulator with weighted accelerations, in closed form.

    Let the accelerations :math:`a = L u` be the inputs, where L is the lower block of B. A model
    at rest then has one double integrator per coordinate, :math:`\ddot q_i = s_i a_i`, with
    s = 1/2 for attitude and s = 1 otherwise. Diagonal weights decouple the coordinates. By (10.2)
    of docs/derivation.md, the regulator in continuous time is

    .. math:: k_p = \sqrt{q_p/r_a},\quad k_d = \sqrt{q_v/r_a + 2 s k_p},\quad
              u = u_0 - L^{-1} [\operatorname{diag} k_p, \operatorname{diag} k_d]\,(x - x_0),

    and its poles are the roots of :math:`\lambda^2 + k_d \lambda + s k_p`. Under an exact
    zero-order hold the coordinates remain decoupled, and each gain still has a closed form. The
    speed of a reaction wheel whose angle is not regulated is a single integrator with k_p = 0. The
    weight on u is :math:`L^T R_a L`. The gain is computed without this product, so an
    ill-conditioned inertia does not reduce its accuracy.

    Parameters
    ----------
    lin : LinearModel
        Continuous or sampled model at rest, without gravity, orbit, springs or dampers. Every
        coordinate that `lqr` regulates must be actuated.
    Qp, Qv, Ra : array_like (6 + n,) or float, or mapping
        Diagonal weights on the positions (q_b, r_b, q_m), the velocities and the accelerations. In
        a mapping {name: weight}, `Qp` takes names of positions; `Qv` and `Ra` take names of
        velocities.
    dt : float, optional
        Sampling time [s]; the continuous model is sampled first.
    wheel_speeds : bool, optional
        As in `lqr`.

    Returns
    -------
    Gain
        Its residual refers to the Riccati equation in the model's own variables.

    Raises
    ------
    EquilibriumError
        If the point is not a fixed point.
    StabilizabilityError
        If a coordinate is not actuated.
    InputError
        If the model's dynamics are not double integrators, or a weight is negative or not diagonal.
        Qp, Ra, and Qv on wheel speeds must be positive.
    ModelError
        If the robot's model was changed after it was made.

    References
    ----------
    Y. Yang, Analytic LQR design for spacecraft control system based on quaternion model, J.
    Aerospace Engineering 25(3), 2012: its attitude regulator is the weight Ra = J R J.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> gain = fflin.acceleration_lqr(lin, 1.0, 1.0, 1.0)
    >>> gain.method, round(float(gain.poles.real.max()), 3)
    ('closed form', -0.707)
    """
    require_fixed_point(lin)
    if dt is not None:
        lin = lin.discretize(dt)
    whole, lin = lin, regulated_part(lin, wheel_speeds)
    rates, L = _integrators(lin)
    m, half = len(rates), len(whole.A) // 2
    positions, velocities = lin.state_names[:-m], lin.state_names[-m:]
    qp, qv, ra = (
        _diagonal(name, value, names, kept, definite=name != "Qv")
        for name, value, names, kept in (
            ("Qp", Qp, whole.state_names[:half], positions),
            ("Qv", Qv, whole.state_names[half:], velocities),
            ("Ra", Ra, whole.state_names[half:], velocities),
        )
    )
    if (rates + qv == 0.0).any():
        name = velocities[int((rates + qv).argmin())]
        raise InputError(f"Qv is 0 for {name}, expected a positive weight on a wheel's speed")
    pick = np.eye(m)[rates != 0.0]
    # The residual is that of the same equation with accelerations as inputs.
    hold = np.vstack((0.5 * lin.dt**2 * rates * pick, lin.dt * np.eye(m)))
    by_acceleration = hold if lin.dt else np.vstack((np.zeros_like(pick), np.eye(m)))
    Q = np.diag(np.concatenate((qp, qv)))
    equation = Riccati(lin.A, by_acceleration, Q, np.diag(ra), None, lin.dt)
    inverse = np.linalg.inv(L) if L.shape[0] == L.shape[1] else np.linalg.pinv(L)
    try:
        with np.errstate(all="ignore"):
            channel = _channels(rates, qp, qv, ra, lin.dt)
            stable = np.abs(channel.poles) < 1.0 if lin.dt else channel.poles.real < 0.0
            K = inverse @ np.hstack((pick.T * channel.kp, np.diag(channel.kd)))
            p12 = channel.p12[:, None] * pick
            P = np.block([[np.diag(channel.p11), p12], [p12.T, np.diag(channel.p22)]])
            residual = equation.trial(P).residual
            sound = stable.all() and np.isfinite(K).all()
    except np.linalg.LinAlgError:
        sound = False
    if not sound:
        raise InputError(
            "the solution overflows with these weights and dt; scale Qp, Qv and Ra so that they "
            "differ less"
        )
    R = L.T @ (ra[:, None] * L)
    solution = Solution(P, K, channel.poles, residual, "closed form")
    return make_gain(whole, lin, solution, Q, 0.5 * (R + R.T), None)


def _integrators(lin: LinearModel) -> tuple[Array, Array]:
    """Return s (m,), 0 of a rate without its coordinate, and L (m, nu) of integrators."""
    nx, h = len(lin.A), lin.dt or 1.0
    p = sum(name.startswith(("q_", "r_")) for name in lin.state_names)
    slope = (lin.A - np.eye(nx)) / h if lin.dt else lin.A
    s: Array = slope[:p, p:].sum(axis=0)
    L, double = lin.B[p:] / h, np.diag(s)[s != 0.0]
    expected = np.zeros((nx, nx))
    expected[: len(double), p:] = double
    # A tolerance, since the division by the sampling time rounds.
    if (
        len(double) != p
        or not np.allclose(slope, expected, rtol=1e-12, atol=0.0)
        or not np.allclose(lin.B[:p], 0.5 * h * lin.dt * double @ L, rtol=1e-12, atol=0.0)
    ):
        raise InputError(
            "the model has other dynamics than double integrators, expected a model at rest "
            "without gravity, orbit, springs or dampers; use lqr"
        )
    sizes = np.abs(L).max(axis=1, keepdims=True)
    if not sizes.all() or np.linalg.matrix_rank(L / sizes, tol=1e-10) < len(s):
        require_stabilizable(lin)
        raise StabilizabilityError(
            "the inputs do not accelerate every coordinate independently; use lqr"
        )
    return s, L


def _diagonal(
    what: str, value: Weight, names: Sequence[str], kept: Sequence[str], *, definite: bool
) -> Array:
    """Return the diagonal of a weight on the states that are kept of those that it may name."""
    if not isinstance(value, Mapping) and dimension(what, value) == 2:
        raise InputError(
            f"{what} is a matrix, expected its diagonal; for a full weight matrix use lqr"
        )
    whole = weight(what, value, names, definite=definite and len(kept) == len(names))
    diagonal = whole.diagonal()[[names.index(name) for name in kept]]
    return weight(what, diagonal, kept, definite=definite).diagonal()


def _channels(s: Array, qp: Array, qv: Array, ra: Array, h: float) -> _Channel:
    """Solve all channels: double integrators where s is not zero, single ones elsewhere."""
    double, single = s != 0.0, s == 0.0
    those = s[double], qp, qv[double], ra[double]
    found = _sampled(*those, h) if h else _continuous(*those)
    kd, p22 = np.sqrt(qv / ra), np.sqrt(qv * ra)
    if h:
        step = _decaying((-(h**2) * qv / ra).astype(complex)).real
        kd, p22 = step / h, ra * step / (h**2 * (1.0 - step))
    poles = np.concatenate((found.poles, (1.0 - h * kd if h else -kd)[single]))
    kd[double], p22[double] = found.kd, found.p22
    return found._replace(kd=kd, p22=p22, poles=poles)


def _continuous(s: Array, qp: Array, qv: Array, ra: Array) -> _Channel:
    kp = np.sqrt(qp / ra)
    kd = np.sqrt(qv / ra + 2.0 * s * kp)
    root = np.sqrt((kd * kd - 4.0 * s * kp).astype(complex))
    fast = -0.5 * (kd + root)
    p22 = ra * kd
    return _Channel(kp, kd, kp * p22 / s, ra * kp, p22, np.concatenate((fast, s * kp / fast)))


def _sampled(s: Array, qp: Array, qv: Array, ra: Array, h: float) -> _Channel:
    """Solve the channels under a hold of length h."""
    # With sigma = (z - 1)(1/z - 1) the spectral factor of a channel is of second degree, ra sigma^2
    # + (qv - qp s^2 h^2 / 4) h^2 sigma + qp s^2 h^4 = 0, and with delta = 1 - z each root gives
    # delta^2 - sigma delta + sigma = 0.
    step = s * h
    middle = (qv - 0.25 * qp * step**2) * h**2
    last = qp * step**2 * h**2
    root = np.sqrt((middle**2 - 4.0 * ra * last).astype(complex))
    larger = -0.5 * (middle + np.where(middle < 0.0, -root, root))
    first, second = (_decaying(sigma) for sigma in (larger / ra, last / larger))
    product, total = (first * second).real, (first + second).real
    kp = product / (step * h)
    kd = (total - 0.5 * product) / h
    spent = qp / kp**2  # r_a + b' P b
    p11 = spent * kp * kd / step
    p12 = spent * kp / h - 0.5 * step * p11
    p22 = (spent * (kd - kp * step) - 0.5 * step * h * p12) / h
    return _Channel(kp, kd, p11, p12, p22, 1.0 - np.concatenate((first, second)))


def _decaying(sigma: Any) -> Any:
    """Return the root of d^2 - sigma d + sigma = 0 with |1 - d| < 1, without cancellation."""
    root = np.sqrt(sigma * sigma - 4.0 * sigma)
    root = np.where(np.abs(sigma + root) >= np.abs(sigma - root), root, -root)
    larger = 0.5 * (sigma + root)
    smaller = sigma / larger
    return np.where(np.abs(1.0 - larger) < 1.0, larger, smaller)
