"""The Kalman filter along a trajectory."""

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
    r"""A time-varying Kalman filter of the error e from a trajectory.

    With :math:`\nu = y - y^*(t) - C \hat e - D\,\delta u`, the left side that of the next sample
    where the filter is sampled,

    .. math:: \dot{\hat e} = A(t)\,\hat e + B(t)\,\delta u + L(t)\,\nu.

    Attributes
    ----------
    t : ndarray (M,)
        Times of the knots [s]: the trajectory's and those that P needs, or the samples.
    L : ndarray (M, nx, ny)
        Of samples the last row repeats what acts to the end.
    P : ndarray (M, nx, nx)
        Covariance of the error of the estimate, of a sample before its y is seen.
    A, B, W : ndarray (M, nx, nx), (M, nx, nu), (M, nx, nx)
        The model and the intensity of its disturbance; or M - 1 that take a sample to the next,
        and the covariance of what the disturbance does meanwhile.
    C, D, y : ndarray (M, ny, nx), (M, ny, nu), (M, ny)
        The outputs, and what they are on the motion.
    V : ndarray (ny, ny)
        Intensity of the noise of the outputs, or its covariance in a sample.
    residual : float
        As that of `GainSchedule`.
    state_names, input_names, output_names : tuple of str
    robot : str
    dt : float
        Time [s] between samples; 0 for continuous time.

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
        """Return L (nx, ny) at a time, as `GainSchedule.gain` does K."""
        return super().gain(t).T

    def covariance(self, t: float) -> Array:
        """Return P (nx, nx) at a time: a cubic between the knots, or that of the last sample."""
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
    r"""Return the Kalman filter along a trajectory.

    The error is disturbed as a model of `kalman` is, by white noises of intensities W and V, and
    P, the covariance of the estimate's error, goes forward from P0 by

    .. math:: \dot P = A P + P A^T - P C^T V^{-1} C P + W,\qquad L = P C^T V^{-1}.

    In the time to the start this is the equation of `tvlqr` for :math:`A^T, C^T, W, V`, and is
    solved in the same way. With `sample` it is the filter of a computer that measures y so often
    and holds :math:`\delta u` in between, (10.4): V is the covariance of a sample's noise then, and
    W still the intensity of what disturbs the robot all the time.

    Parameters
    ----------
    traj : LinearTrajectory
        Of a robot whose outputs are what is measured.
    W : array_like (nx, nx) or (nx,), float, or mapping
        Positive semidefinite, as `kalman` takes it.
    V : array_like (ny, ny) or (ny,), float, or mapping
        Positive definite.
    G : array_like (nx, nw) or (N, nx, nw), optional
        The disturbance acts through G, linear between the knots, and W is (nw, nw):
        ``G=traj.B`` for noisy inputs, whose names W then takes.
    P0 : "steady", or as W
        Covariance at the start. "steady" is that of `kalman` about the robot at rest in the first
        configuration, or in its motion there if that is steady.
    sample : float, optional
        Sampling time [s], of which the duration is a multiple.

    Returns
    -------
    FilterSchedule

    Raises
    ------
    InputError
        If a size or value is wrong, P changes so fast that the knots run out, or the sampling time
        does not divide the duration.
    UnknownNameError
        If a name does not exist.
    EquilibriumError, DetectabilityError
        If P0 is "steady", and no inputs hold the robot there or outputs do not show it.

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
        raise type(error)(f"at the start: {error}; give P0") from None


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
