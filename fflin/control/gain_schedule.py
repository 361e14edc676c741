"""Time-varying feedback gain along a trajectory."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np

from fflin.base.errors import InputError
from fflin.base.record import NOT_VERIFIED, Design
from fflin.base.tables import folded
from fflin.base.validation import Array, number
from fflin.control.differential_riccati import Passed
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.state import StateMap
from fflin.linear.fit import require_same
from fflin.linear.trajectory import Trajectory
from fflin.robot.robot import Robot

_nothing = partial(np.zeros, 0)


@dataclass(frozen=True, eq=False, repr=False)
class Schedule(Design):
    """Gain as a function of time, given at the knots or samples of a trajectory."""

    WIDTH: ClassVar = "nu"

    t: Array

    def __repr__(self) -> str:
        of: Any = self
        time, wide = f"dt={of.dt:g} s, " if of.dt else "", self.passed.K.shape[1]
        return (
            f"{type(self).__name__}('{of.robot}', {len(self.t)} knots, {self.t[0]:g} to "
            f"{self.t[-1]:g} s, {time}nx={of.P.shape[1]}, {self.WIDTH}={wide}, "
            f"residual={of.residual:.1e})"
        )

    def __call__(self, t: float) -> Array:
        """Return the gain at a time."""
        return self.gain(t)

    def gain(self, t: float) -> Array:
        """Return the gain at time t, or raise `InputError` if t is outside the knots.

        Between knots, the gain is computed from the interpolated model and P. A sampled schedule
        returns the gain of the most recent sample.
        """
        passed = self.passed
        if type(t) is not float or not passed.first <= t <= passed.last:
            t = self._within(t)
        return passed.gain(t)

    def _within(self, t: float) -> float:
        t, passed = number("t", t), self.passed
        if not passed.first <= t <= passed.last:
            raise InputError(f"t is {t:g} s, expected {passed.first:g} to {passed.last:g} s")
        return t

    @cached_property
    def passed(self) -> Passed:
        """Gain and cost over time."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False, repr=False)
class GainSchedule(Schedule):
    r"""Time-varying feedback ``u = u*(t) - K(t) e`` of the error e relative to a trajectory.

    Attributes
    ----------
    t : ndarray (M,)
        Times [s] of the knots: the trajectory's knots, and knots added to interpolate P. For a
        sampled schedule, the sample times.
    K : ndarray (M, nu, nx)
        Gains. In a sampled schedule the last row repeats the gain before it.
    P : ndarray (M, nx, nx)
        Cost matrix: the optimal cost from t on is e' P(t) e.
    A : ndarray (M, nx, nx)
    B : ndarray (M, nx, nu)
        Linear model at the knots. A sampled schedule has M - 1 matrices A and B; each pair leads
        from one sample to the next.
    Q, R, Qf : ndarray
        Weights of the continuous cost.
    residual : float
        Largest residual of the differential Riccati equation midway between the knots, relative
        to the sum of the norms of its terms. For a sampled schedule, the residual of the
        difference equation.
    state_names, input_names : tuple of str
    robot : str
    dt : float
        Sampling time [s], over which u is held; 0 for continuous time.
    weights : str
        Description of the rule that made the weights.
    knots, q, v, u, hold, frame
        The trajectory, see `trajectory`.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> schedule = fflin.tvlqr(along)
    >>> schedule.gain(0.5).shape, schedule.residual < 1e-3
    ((9, 18), True)
    >>> flight = fflin.simulate(robot, schedule, q0=robot.neutral(), duration=1.0)
    """

    VECTORS: ClassVar = ("t", "knots")

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

    def __str__(self) -> str:
        """Return the report: the sizes, the residual and the rule of the weights."""
        verdict = [] if self.verified else [NOT_VERIFIED]
        said = [repr(self), f"weights: {self.weights or 'as given'}", *verdict]
        return "\n".join(folded([each]) for each in said)

    def trajectory(self, robot: Robot) -> Trajectory:
        """Return the trajectory that the gains were designed for."""
        if not self.knots.size:
            raise InputError(
                "the file of gains contains no trajectory; load one with fflin.Trajectory.load "
                "and use TrajectoryFeedback"
            )
        state, made = StateMap(robot), f"the gains are for a model of '{self.robot}'"
        inputs = Actuation(state).names, self.input_names
        for kind, there, own in (
            ("state", state.names, self.state_names),
            ("input", *inputs),
        ):
            require_same(made, robot, kind, (own, own), (there, there))
        values: dict[str, Any] = {name: getattr(self, name) for name in ("q", "v", "u")}
        return Trajectory(robot, self.knots, **values, hold=self.hold, frame=self.frame)

    def cost_to_go(self, t: float) -> Array:
        """Return P (nx, nx) at time t by cubic interpolation; if sampled, at the latest sample."""
        return self.passed.cost(self._within(t))

    @cached_property
    def passed(self) -> Passed:
        """Gain and cost over time."""
        model = (self.A, self.B, self.Q, self.R)
        return Passed(self.t, self.P, self.K, model, self.dt, -1.0)
