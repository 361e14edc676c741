"""A funnel: ellipsoids of errors along a trajectory, with the outcomes of its runs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from fflin.base.errors import InputError
from fflin.base.intervals import clopper_pearson
from fflin.base.record import Design
from fflin.base.tables import folded, grid
from fflin.base.validation import Array, number
from fflin.base.writing import as_path
from fflin.dynamics.points import point_of
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import moving_error
from fflin.linear.trajectory import Trajectory
from fflin.robot.robot import Robot

_ROUNDING = 1e-12  # of P, below which a direction has no weight


def spread(P: Array) -> Array:
    """Return W (nx, r) whose W W' is the pseudoinverse of P, each error in its own scale."""
    scale = np.sqrt(P.diagonal().clip(min=0.0))
    unit = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0.0)
    values, axes = np.linalg.eigh(unit[:, None] * P * unit)
    kept = values > _ROUNDING * values.max()
    found: Array = unit[:, None] * axes[:, kept] / np.sqrt(values[kept])
    return found


@dataclass(frozen=True, eq=False, repr=False)
class Funnel(Design):
    """Ellipsoids ``e' P(t) e <= rho`` of errors relative to a trajectory; prints as a table.

    Errors are defined as in `linearize_trajectory`; P is the schedule's cost to go. Errors in
    directions in which P is zero are not tested.

    Attributes
    ----------
    t : ndarray (m,)
        Times [s] of the knots.
    tried : ndarray (m,)
        Largest level rho of the tested initial errors. The square roots of the levels of all tested
        errors are evenly spread.
    outcomes : ndarray (m, N)
        Outcome of each run, sorted by ascending level: 0 if it reached the goal, 1 if it was
        stopped early, 2 if it exceeded `within`, 3 if it missed the goal.
    rho : ndarray (m,)
        Largest level up to which every run succeeded.
    inside : ndarray (m,)
        Number of runs that start at or below the level `rho`.
    inside_rate : ndarray (m,)
        Lower bound, at confidence level `confidence`, on the success rate of runs that start at or
        below the level `rho`.
    rate : ndarray (m, 2)
        Clopper-Pearson interval of the success rate of all runs. All of them start at or below the
        level `tried`.
    attitude, position, joints : ndarray (m, 3), (m, 3), (m, n)
        Half-axes of the ellipsoids in base attitude [deg], base position [m] and each joint
        [rad|m].
    goal, within : str
        Bounds on the final errors of a run, and on its errors at any time.
    confidence : float
        Confidence level of the intervals.
    at, P : ndarray (M,), (M, nx, nx)
        Times [s] and cost to go of the schedule.
    knots, q, v, u, hold, frame
        The followed trajectory, see `trajectory`.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> reach = fflin.funnel(robot, fflin.tvlqr(along), {"attitude": 5.0}, samples=4, knots=2)
    >>> bool(reach.contains(0.0, q=motion.q[0], v=motion.v[0]))
    True
    """

    VECTORS: ClassVar = ("t", "tried", "at", "knots")

    robot: Robot
    t: Array
    tried: Array
    outcomes: Array
    goal: str
    within: str
    confidence: float
    at: Array
    P: Array
    knots: Array
    q: Array
    v: Array
    u: Array
    hold: str
    frame: str

    def __post_init__(self) -> None:
        super().__post_init__()
        count, sure = self.outcomes.shape[1], self.confidence
        failed = self.outcomes != 0.0
        inside = np.where(failed.any(axis=1), failed.argmax(axis=1), count)
        kept = count - failed.sum(axis=1)
        values: dict[str, Any] = {
            "inside": inside,
            "rho": self.tried * ((inside - 0.5).clip(min=0.0) / count) ** 2,
            "inside_rate": (inside > 0) * (1.0 - sure) ** (1.0 / inside.clip(min=1)),
            "rate": np.array([clopper_pearson(int(x), count, sure)[1:] for x in kept]),
        }
        self.__dict__.update(values)
        roots = [self.root(t) for t in self.t.tolist()]
        turn, place = (np.array([_axes(W[part]) for W in roots]) for part in _BASE)
        joints = [np.linalg.norm(W[6 : 6 + self.robot.n], axis=1) for W in roots]
        self.__dict__["attitude"] = np.degrees(2.0 * np.arcsin(np.minimum(turn, 1.0)))
        self.__dict__.update(position=place, joints=np.array(joints))

    def __getattr__(self, name: str) -> Any:  # what `__post_init__` adds
        raise AttributeError(name)

    @cached_property
    def trajectory(self) -> Trajectory:
        """The followed trajectory."""
        values: Any = (self.robot, self.knots, self.q, self.v, self.u)
        return Trajectory(*values, hold=self.hold, frame=self.frame)

    def level(self, t: float) -> float:
        """Return rho at time t; between two knots, the smaller of their two levels."""
        t = number("t", t)
        if not self.t[0] <= t <= self.t[-1]:
            raise InputError(f"t is {t:g} s, expected {self.t[0]:g} to {self.t[-1]:g} s")
        near = [self.t.searchsorted(t, side) - (side == "right") for side in ("right", "left")]
        return float(self.rho[near].min())

    def cost(self, t: float) -> Array:
        """Return P (nx, nx) at time t by linear interpolation of the schedule."""
        k = int(np.clip(self.at.searchsorted(t, "right") - 1, 0, len(self.at) - 2))
        part = float(np.clip((t - self.at[k]) / (self.at[k + 1] - self.at[k]), 0.0, 1.0))
        P: Array = (1.0 - part) * self.P[k] + part * self.P[k + 1]
        return P

    def root(self, t: float, *, smooth: bool = False) -> Array:
        """Return W (nx, r): the ellipsoid at time t is the set of all W z with norm(z) <= 1.

        With `smooth`, the level is interpolated between knots, as figures show it.
        """
        size = np.interp(t, self.t, np.sqrt(self.rho)) if smooth else np.sqrt(self.level(t))
        return size * spread(self.cost(t))

    def contains(self, t: float, x: Any = None, *, q: Any = None, v: Any = None) -> bool:
        """Return whether a state is inside the funnel at time t.

        Parameters
        ----------
        t : float
            Time [s], from the first to the last knot.
        x : array_like (nx,), optional
            State of ``StateMap(robot, frame="local")``.
        q, v : array_like (nq,), (nv,), optional
            Configuration and velocity in Pinocchio's order, instead of x. If v is omitted, the
            robot is at rest.
        """
        rho, state = self.level(t), StateMap(self.robot, frame="local")
        if x is None and q is None:
            raise InputError("no state is given; give x, or q and v")
        q, v = point_of(state, x, q, v, lambda: (q, v))
        e = moving_error(state, *self.trajectory.flow.at(float(t))[:2], q, v)
        return bool(e @ self.cost(t) @ e <= rho)

    def __repr__(self) -> str:
        m, count = self.outcomes.shape
        return f"Funnel('{self.robot.name}', {m} knots of {count} runs, goal '{self.goal}')"

    def __str__(self) -> str:
        count, sure = self.outcomes.shape[1], f"{100.0 * self.confidence:g} %"
        head = f"{self.robot.name}: errors from which every run ends with {self.goal}"
        head += f", and on the way {self.within}" * bool(self.within) + f"; {count} runs per knot"
        tail = [
            "base, joint: largest half-axes",
            "runs: number of starts inside, all of which succeeded (+: all starts that were tried)",
            f"inside: lower bound of the success rate of starts inside ({sure} confidence)",
            "tried: interval of the success rate of starts up to the largest level that was tried",
        ]
        rows = [["t [s]", "rho", "base [deg]", "base [m]", "joint", "runs", "inside", "tried"]]
        wide = (self.attitude, self.position, self.joints)
        for k, (low, high) in enumerate(100.0 * self.rate):
            reach = [f"{each[k].max(initial=0.0):.3g}" for each in wide]
            many = f"{self.inside[k]}{' +' if self.inside[k] == count else ''}"
            shares = [f"{100.0 * self.inside_rate[k]:.1f} %", f"{low:.0f}-{high:.0f} %"]
            rows.append([f"{self.t[k]:.4g}", f"{self.rho[k]:.3g}", *reach, many, *shares])
        return "\n".join([folded([head]), "", grid(rows, "r"), "", folded(tail)])

    @classmethod
    def load(cls, path: str | Path, robot: Robot) -> Funnel:  # type: ignore[override]
        """Read a funnel of a robot from a file that `save` wrote; errors as in `Gain.load`."""
        return cls._read(as_path(path), robot=robot)


_BASE = slice(0, 3), slice(3, 6)


def _axes(W: Array) -> Array:
    return np.linalg.svd(np.hstack((W, np.zeros((3, 3)))))[1]
