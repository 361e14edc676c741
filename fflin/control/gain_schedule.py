"""A time-varying feedback along a trajectory."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from fflin.base.errors import InputError
from fflin.base.record import NOT_VERIFIED, Design
from fflin.base.validation import Array, number

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

    from fflin.linear.trajectory import Trajectory
    from fflin.robot.robot import Robot


def _nothing() -> Array:
    return np.zeros(0)


@dataclass(frozen=True, eq=False, repr=False)
class GainSchedule(Design):
    r"""A time-varying feedback ``u = u*(t) - K(t) e`` of the error e from a trajectory.

    Attributes
    ----------
    t : ndarray (M,)
        Times of the knots [s]: the trajectory's and those that P needs, or the samples.
    K : ndarray (M, nu, nx)
        Of samples the last row repeats what acts to the end.
    P : ndarray (M, nx, nx)
        The cost from t on is e' P(t) e.
    A : ndarray (M, nx, nx)
    B : ndarray (M, nx, nu)
        The model at the knots, linear in between; or M - 1 that take a sample to the next.
    Q, R, Qf : ndarray
        Weights of the continuous cost.
    residual : float
        Largest residual of the differential Riccati equation midway between the knots, relative
        to the sum of the norms of its terms; of samples that of the difference equation.
    state_names, input_names : tuple of str
    robot : str
    dt : float
        Time [s] between samples, over which u is held; 0 for continuous time.
    weights : str
        The rule that made the weights, in words.
    knots, q, v, u, hold, frame
        The trajectory, see `trajectory`.
    """

    VECTORS: ClassVar = ("t", "knots")

    t: Array
    K: Array
    P: Array
    A: Array
    B: Array
    Q: Array
    R: Array
    Qf: Array
    residual: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    robot: str
    dt: float = field(default_factory=float)
    weights: str = field(default_factory=str)
    knots: Array = field(default_factory=_nothing)
    q: Array = field(default_factory=_nothing)
    v: Array = field(default_factory=_nothing)
    u: Array = field(default_factory=_nothing)
    hold: str = field(default_factory=str)
    frame: str = field(default_factory=str)

    def __repr__(self) -> str:
        time = f"dt={self.dt:g} s, " if self.dt else ""
        return (
            f"GainSchedule('{self.robot}', {len(self.t)} knots, {self.t[0]:g} to "
            f"{self.t[-1]:g} s, {time}nx={self.P.shape[1]}, nu={self.K.shape[1]}, "
            f"residual={self.residual:.1e})"
        )

    def __str__(self) -> str:
        """Show the rule of its weights too."""
        verdict = [] if self.verified else [NOT_VERIFIED]
        return "\n".join([repr(self), f"weights: {self.weights or 'as given'}", *verdict])

    def trajectory(self, robot: Robot) -> Trajectory:
        """Return the trajectory that it keeps a robot on."""
        from fflin.dynamics.actuation import Actuation
        from fflin.dynamics.state import StateMap
        from fflin.linear.fit import require_same
        from fflin.linear.trajectory import Trajectory

        if not self.knots.size:
            raise InputError("the file has no trajectory; load it with fflin.Trajectory.load")
        state, made = StateMap(robot), f"the gains are those of '{self.robot}'"
        inputs = Actuation(state).names, self.input_names
        for kind, there, own in (
            ("state", state.names, self.state_names),
            ("input", *inputs),
        ):
            require_same(made, robot, kind, (own, own), (there, there))
        values: dict[str, Any] = {name: getattr(self, name) for name in ("q", "v", "u")}
        return Trajectory(robot, self.knots, **values, hold=self.hold, frame=self.frame)

    def __call__(self, t: float) -> Array:
        """Return K (nu, nx) at a time."""
        return self.gain(t)

    def gain(self, t: float) -> Array:
        """Return K (nu, nx) at a time; InputError where it is not within the knots.

        Between the knots R^-1 B' P of B and P there; of samples that of the last one.
        """
        first, last = self._ends
        if type(t) is not float or not first <= t <= last:
            t = self._within(t)
        k = bisect_right(self._starts, t) - 1
        if self.dt:
            return self.K[k]
        x = t - self._starts[k]
        square = x * x
        powers = np.array((1.0, x, square, square * x, square * square))
        K: Array = powers.dot(self._quartics[k]).reshape(self.K.shape[1:])
        return K

    def cost_to_go(self, t: float) -> Array:
        """Return P (nx, nx) at a time: a cubic between the knots, or that of the last sample."""
        t = self._within(t)
        P: Array = self.P[bisect_right(self._starts, t) - 1] if self.dt else self._cubics(t)
        return P

    def _within(self, t: float) -> float:
        t, (first, last) = number("t", t), self._ends
        if not first <= t <= last:
            raise InputError(f"t is {t:g} s, expected {first:g} to {last:g} s")
        return t

    @cached_property
    def _ends(self) -> tuple[float, float]:
        return float(self.t[0]), float(self.t[-1])

    @cached_property
    def _starts(self) -> list[float]:
        """Where each piece begins; a sample a little early, since clocks are rounded."""
        early = [self._ends[0], *(self.t[1:] - 1e-9 * self.dt).tolist()]
        return early if self.dt else self.t[:-1].tolist()

    @cached_property
    def _cubics(self) -> CubicHermiteSpline:
        """P over time."""
        from scipy.interpolate import CubicHermiteSpline

        drift, across = self.P @ self.A, (0, 2, 1)
        spent = self.K.transpose(across) @ self.R @ self.K
        return CubicHermiteSpline(
            self.t, self.P, spent - drift - drift.transpose(across) - self.Q, extrapolate=False
        )

    @cached_property
    def _quartics(self) -> Array:
        """Coefficients (M - 1, 5, nu nx) of K in the time since the knot."""
        reach = np.linalg.solve(self.R, self.B.transpose(0, 2, 1))
        slope = np.diff(reach, axis=0) / np.diff(self.t)[:, None, None]
        P = self._cubics.c[::-1]
        K = np.zeros((5, *slope.shape))
        K[:4] += reach[:-1] @ P
        K[1:] += slope @ P
        return np.ascontiguousarray(K.transpose(1, 0, 2, 3)).reshape(len(slope), 5, -1)
