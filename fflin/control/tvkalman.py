"""Time-varying Kalman filter along a trajectory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from fflin.analysis.gramians import held_cost
from fflin.base.errors import DetectabilityError, InputError
from fflin.base.threads import in_one_thread
from fflin.base.validation import Array, number
from fflin.control import differential_riccati as riccati
from fflin.control.gain_schedule import Schedule
from fflin.control.kalman import disturbance, kalman
from fflin.control.tvlqr import require_continuous, steady_end
from fflin.control.weights import Weight, weight
from fflin.linear.linear_trajectory import LinearTrajectory, along
from fflin.linear.sampling import HEAVY, LIGHT
from fflin.linear.trajectory_sampling import transitions


@dataclass(frozen=True, eq=False, repr=False)
class FilterSchedule(Schedule):
    r"""Time-varying Kalman filter for the error e relative to a trajectory.

    With the innovation :math:`\nu = y - y^*(t) - C \hat e - D\,\delta u`,

    .. math:: \dot{\hat e} = A(t)\,\hat e + B(t)\,\delta u + L(t)\,\nu.

    For a sampled filter, the left side is the estimate for the next sample.

    Attributes
    ----------
    t : ndarray (M,)
        Times [s] of the knots: the trajectory's knots, and knots added to interpolate P. For a
        sampled filter, the sample times.
    L : ndarray (M, nx, ny)
        Filter gains. In a sampled filter the last row repeats the gain before it.
    P : ndarray (M, nx, nx)
        Covariance of the estimation error; for a sampled filter, before the measurement update.
    A, B, W : ndarray (M, nx, nx), (M, nx, nu), (M, nx, nx)
        Linear model and intensity of the disturbance at the knots. A sampled filter has M - 1 of
        each: the transitions from one sample to the next, and the covariance of the disturbance
        over that time.
    C, D, y : ndarray (M, ny, nx), (M, ny, nu), (M, ny)
        Output matrices, and the outputs along the trajectory.
    V : ndarray (ny, ny)
        Intensity of the measurement noise; for a sampled filter, its covariance per sample.
    residual : float
        Residual of the Riccati equation, as in `GainSchedule`.
    state_names, input_names, output_names : tuple of str
    robot : str
    dt : float
        Sampling time [s]; 0 for continuous time.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> filtered = fflin.tvkalman(along, 1e-3, 1e-4, sample=0.1)
    >>> filtered.dt, filtered.P.shape[1:]
    (0.1, (18, 18))
    """

    VECTORS: ClassVar = ("t",)
    WIDTH: ClassVar = "ny"

    L: Array
    P: Array
    A: Array
    B: Array
    C: Array
    D: Array
    y: Array
    W: Array
    V: Array
    residual: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    robot: str
    dt: float = field(default_factory=float)

    def gain(self, t: float) -> Array:
        """Return the filter gain L (nx, ny) at time t; see `GainSchedule.gain`."""
        return super().gain(t).T

    def covariance(self, t: float) -> Array:
        """Return P (nx, nx) at time t by cubic interpolation; if sampled, at the latest sample."""
        return self.passed.cost(self._within(t))

    @cached_property
    def passed(self) -> riccati.Passed:
        """Gain and cost over time."""
        A, C, L = (each.transpose(0, 2, 1) for each in (self.A, self.C, self.L))
        return riccati.Passed(self.t, self.P, L, (A, C, self.W, self.V), self.dt, 1.0)


@in_one_thread
def tvkalman(
    traj: LinearTrajectory,
    W: Weight,
    V: Weight,
    G: ArrayLike | None = None,
    P0: Weight | str = "steady",
    sample: float | None = None,
) -> FilterSchedule:
    r"""Return the time-varying Kalman filter along a trajectory.

    White noise of intensities W and V acts on the error and on the outputs, as in `kalman`. The
    covariance P of the estimation error is integrated forward from P0,

    .. math:: \dot P = A P + P A^T - P C^T V^{-1} C P + W,\qquad L = P C^T V^{-1}.

    In reversed time this is the equation of `tvlqr` with :math:`A, B, Q, R` replaced by
    :math:`A^T, C^T, W, V`. It is solved in the same way.

    With `sample`, the filter is sampled, (10.4): a computer measures y at the samples and holds
    :math:`\delta u` between them. V is then the noise covariance per sample. W remains the
    intensity of the continuous disturbance.

    Parameters
    ----------
    traj : LinearTrajectory
        Trajectory of a robot whose outputs are the measurements.
    W : array_like (nx, nx) or (nx,), float, or mapping
        Intensity of the disturbance, positive semidefinite, as in `kalman`.
    V : array_like (ny, ny) or (ny,), float, or mapping
        Intensity of the measurement noise, positive definite.
    G : array_like (nx, nw) or (N, nx, nw), optional
        Input matrix of the disturbance, linear between the knots; W is then (nw, nw). With
        ``G=traj.B`` the disturbance acts at the inputs, and W takes names of inputs.
    P0 : "steady", or as W
        Covariance at the start. "steady" is the covariance of `kalman` about the start point: the
        first configuration at rest, or in its initial motion if that motion is steady.
    sample : float, optional
        Sampling time [s]. It must divide the duration.

    Returns
    -------
    FilterSchedule

    Raises
    ------
    InputError
        If a size or value is wrong, if P changes so fast that too many knots are needed, or if
        the sampling time does not divide the duration.
    UnknownNameError
        If a name does not exist.
    EquilibriumError, DetectabilityError
        If P0 is "steady" and no inputs can hold the robot at the start point, or if the model
        there is not detectable.

    References
    ----------
    R. E. Kalman and R. S. Bucy, J. Basic Engineering 83(1), 1961.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> noise = {"tau_b": 0.1, "F_b": 0.1, "tau_m": 0.01}
    >>> fflin.tvkalman(along, noise, 1e-4, G=along.B, sample=0.1).L.shape
    (21, 18, 18)
    """
    require_continuous(traj)
    dt = 0.0 if sample is None else number("sample", sample)
    V = weight("V", V, traj.output_names, definite=True)
    noise, columns = disturbance(traj, W, G)
    through = np.broadcast_to(columns, (len(traj.t), *columns.shape[-2:]))

    @cache
    def at(t: float) -> riccati.Coefficients:
        (A, _), (C, by) = traj.matrices(t), traj.between(t, traj.C, through)
        intensity = by @ noise @ by.T
        return riccati.Coefficients(A.T, riccati.spread(C.T, V), 0.5 * (intensity + intensity.T))

    names: Any = ("state_names", "input_names", "output_names", "verified")
    fields: dict[str, Any] = {key: getattr(traj, key) for key in names}
    fields |= {"robot": traj.robot.name, "V": V, "dt": dt}
    if isinstance(P0, str):
        if P0 != "steady":
            raise InputError(f"P0 is {P0!r}, expected 'steady' or a covariance")
        P = _steady(traj, at(float(traj.t[0])).Q, V, dt)
    else:
        P = weight("P0", P0, traj.state_names)
    with riccati.bounded_by("a smaller W or a larger V"):
        if sample is not None:
            return FilterSchedule(**fields, **_sampled(traj, dt, lambda t: at(t).Q, V, P))
        times, found = riccati.solve_back(lambda time: at(-time), -traj.t[::-1], P)
    t, P = -times[::-1], found[::-1]
    own, clock = (traj.C, traj.D, traj.y), t.tolist()
    rows = zip(*((*traj.matrices(x), *traj.between(x, *own)) for x in clock), strict=True)
    fields |= dict(zip("ABCDy", map(np.array, rows), strict=True))
    L = np.linalg.solve(V, fields["C"] @ P).transpose(0, 2, 1)
    fields |= {"t": t, "L": L, "P": P, "W": np.array([at(float(x)).Q for x in t])}
    made = FilterSchedule(residual=np.inf, **fields)
    return replace(made, residual=made.passed.residual(at))


def _steady(traj: LinearTrajectory, W: Array, V: Array, dt: float) -> Array:
    lin = steady_end(traj, 0)
    if dt:
        lin, W = lin.discretize(dt), held_cost(lin.A.T, W, dt)
    try:
        return kalman(lin, W, V).P
    except (DetectabilityError, InputError) as error:
        raise type(error)(
            f"no steady filter exists at the start of the trajectory: {error}; or give P0"
        ) from None


def _sampled(
    traj: LinearTrajectory, dt: float, intensity: Callable[[float], Array], V: Array, P: Array
) -> dict[str, Any]:
    """Return what the schedule of a filter has whose measurements are sampled."""
    at_samples, nx, disturbed = along(traj.resampled(dt)), len(P), list[Array]()
    held = list(transitions(traj, traj.matrices, dt))

    def stages() -> Iterator[tuple[Array, Array]]:
        for C, (steps, whole) in zip(at_samples.C, held, strict=False):
            W = np.zeros((nx, nx))
            for F, h, step, (first, second) in steps:
                mixed = HEAVY * intensity(first) + LIGHT * intensity(second)
                W = step[:, :nx] @ W @ step[:, :nx].T + held_cost(F[:nx, :nx].T, mixed, h)
            disturbed.append(W)
            yield block_diag(W, V), np.hstack((whole[:, :nx].T, C.T))

    K, P, residual = riccati.samples_back(stages(), P)
    L, maps = K.transpose(0, 2, 1), np.array([whole for _, whole in held])
    return {
        **{"t": at_samples.t, "L": np.concatenate((L, L[-1:])), "P": P},
        **{"A": maps[:, :, :nx], "B": maps[:, :, nx:], "W": np.array(disturbed)},
        **{key: getattr(at_samples, key) for key in "CDy"},
        "residual": residual,
    }
