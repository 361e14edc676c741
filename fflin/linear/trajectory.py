"""A motion of a robot by knots, with inputs that are held or linear in between."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fflin.base.errors import FflinError, FflinWarning, InputError
from fflin.base.frozen import frozen
from fflin.base.record import Design
from fflin.base.tables import folded
from fflin.base.validation import Array, as_double, number, vector
from fflin.base.writing import as_path
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.names import refuse_orbit
from fflin.dynamics.points import require_slow
from fflin.dynamics.state import StateMap
from fflin.linear.flow import Flow
from fflin.robot.robot import Robot

# The largest residual of a motion of the robot.
_MOTION = 1e-2

# Between two knots the base goes the shorter way, of less than half a turn [rad].
_FARTHEST_TURN = 2.5

_CAUSES = (
    "usual causes: hold, the axes (frame) of u or v, units of t or of joints, and the robot's "
    "springs, damping and gravity"
)


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Design):
    """A motion of a robot by knots; the arrays are copied and read-only.

    Parameters
    ----------
    robot : Robot
    t : array_like (N,)
        Times of the knots [s], increasing.
    q : array_like (N, nq)
        Configurations in Pinocchio's order; each continuous joint may have one column, its angle,
        instead of the two of (cos, sin).
    v : array_like (N, nv)
        Velocities in Pinocchio's order.
    u : array_like (N, nu) or (N - 1, nu)
        Over the robot's inputs; of N - 1 rows each acts over an interval.
    hold : {"linear", "previous"}, optional
        Whether inputs are linear between the knots, or stay what they were at the knot before, as
        those of a computer. Linear by default, and held where u has N - 1 rows.
    frame : {"local", "hybrid", "world"}
        Axes of the inputs on the base, in which they are held too: those of the base, or of the
        world for the force (hybrid) or for force and torque (world).
    verified : bool
        False of a file that has no digest to tell damage by.

    Raises
    ------
    InputError
        If a size is wrong, the times do not increase, or a row is no configuration or velocity.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> flown = motion.trajectory()
    >>> flown.save("flown.csv")
    >>> back = fflin.Trajectory.load("flown.csv", robot)
    >>> back.q.shape, back.hold, bool(back.residual.max() < 1e-6)
    ((11, 13), 'previous', True)
    """

    VECTORS: ClassVar = ("t",)

    robot: Robot
    t: Array
    q: Array
    v: Array
    u: Array
    hold: str | None = field(default=None, kw_only=True)
    frame: str = field(default="local", kw_only=True)
    _note: str = field(default="", kw_only=True)  # what is printed below it; no file has it

    def __post_init__(self) -> None:
        refuse_orbit(self.robot, "trajectories")
        robot, nu = self.robot, len(Actuation(self._state).names)
        times = as_double("t", self.t)
        times = vector("t", times, times.size, "times of the knots")
        if len(times) < 2:
            raise InputError("t must hold at least two times, each later than the one before")
        if (back := np.flatnonzero(np.diff(times) <= 0.0)).size:
            late, early = times[back[0] : back[0] + 2]
            raise InputError(
                f"t[{back[0] + 1}] is {early:.9g} s, after {late:.9g} s; expected each time later "
                "than the one before"
            )
        if self.hold is not None and str(self.hold) not in ("linear", "previous"):
            raise InputError(f"hold is {self.hold!r}, expected 'linear' or 'previous'")
        count, u = len(times), as_double("u", self.u)
        short = u.shape == (count - 1, nu) and self.hold != "linear"
        if not short and u.shape != (count, nu):
            expected = f"({count}, {nu}), or ({count - 1}, {nu}) where each acts over an interval"
            raise InputError(f"u has shape {u.shape}, expected {expected}")
        v = as_double("v", self.v)
        if v.shape != (count, robot.nv):
            raise InputError(f"v has shape {v.shape}, expected ({count}, {robot.nv})")
        rows: dict[str, list[Array]] = {"q": [], "v": [], "u": []}
        u = np.vstack((u, u[-1:])) if short else u
        for t, *row in zip(times, _configurations(robot, self.q, count), v, u, strict=True):
            try:
                rows["q"].append(robot.checked_configuration(row[0]))
                rows["v"].append(robot.checked_velocity(row[1]))
                require_slow("v", rows["v"][-1])
                rows["u"].append(vector("u", row[2], nu, "the robot's inputs"))
            except FflinError as error:
                raise InputError(f"at t = {t:g} s: {error}") from None
        values: dict[str, Any] = {name: frozen(np.array(each)) for name, each in rows.items()}
        values |= {"t": times, "hold": self.hold or ("previous" if short else "linear")}
        for name, value in values.items():
            object.__setattr__(self, name, value)
        super().__post_init__()

    def __repr__(self) -> str:
        how = "held" if self.hold == "previous" else "linear"
        return (
            f"{type(self).__name__}('{self.robot.name}', {len(self.t)} knots, {self.t[0]:g} to "
            f"{self.t[-1]:g} s, inputs {how}, frame='{self.frame}')"
        )

    def __str__(self) -> str:
        """Show how good a motion of the robot it is."""
        said = self._fault or f"residual {self.residual.max():.1e}"
        note = f"\n{folded([self._note])}" if self._note else ""
        return f"{folded(super().__str__().splitlines())}\n{folded([said])}{note}"

    @property
    def _state(self) -> StateMap:
        axes: Any = self.frame
        return StateMap(self.robot, frame=axes)

    @cached_property
    def flow(self) -> Flow:
        """The motion between the knots."""
        return Flow(self._state, self.t, self.q, self.v, self.u, self.hold == "previous")

    @cached_property
    def u_base(self) -> Array:
        """The inputs (N, nu) from the knots on, those on the base in base axes."""
        return frozen(Actuation(self._state).rows_in_base_axes(self.q, self.u))

    @property
    def residual(self) -> Array:
        """How far the knots are from a motion (N,): what the intervals around each miss.

        An interval is integrated from its first knot under its inputs; what its end misses the
        next knot by, as a rate, is relative to the largest rate of the motion, see `Flow`.
        """
        found = self.flow.residual
        return np.maximum(np.append(found, 0.0), np.append(0.0, found))

    def point(self, t: float) -> tuple[Array, Array, Array]:
        """Return q, v, and u in base axes at a time.

        Between knots q and v are cubics with the robot's own velocities and accelerations.

        Raises
        ------
        InputError
            If the time is not within the knots.
        """
        return self.flow.at(self._within(t))

    def resampled(self, dt: float) -> Trajectory:
        """Return the same motion with knots dt [s] apart, and one at the end, see `point`.

        Inputs that are held stay what they were where each old knot is a new one.
        """
        times = self.samples(dt)
        if times[-1] < self.t[-1]:
            times = np.append(times, self.t[-1])
        q, v, _ = map(np.array, zip(*map(self.flow.at, times), strict=True))
        u = np.array([self.flow.input(t) for t in times])
        kept = {"hold": self.hold, "frame": self.frame, "verified": self.verified}
        return Trajectory(self.robot, times, q, v, u, **kept)  # type: ignore[arg-type]

    def samples(self, dt: float) -> Array:
        """Return the times every dt [s] that are within the knots."""
        dt, duration = number("dt", dt), float(self.t[-1] - self.t[0])
        if not dt >= 1e-7 * duration:
            raise InputError(
                f"dt is {dt:g} s, expected a positive time of 1e-7 of the {duration:g} s or more"
            )
        times: Array = self.t[0] + dt * np.arange(int(duration / dt * (1.0 + 1e-9)) + 1)
        if abs(times[-1] - self.t[-1]) <= 1e-6 * dt:
            times[-1] = self.t[-1]
        return times

    def require(self, *, strict: bool = False) -> None:
        """Warn of knots that are no motion of the robot to 1e-2, or refuse them if `strict`.

        The message says which interval misses the motion most, by how much, and how many do. A
        motion that overflows is refused in any case.
        """
        fault = self._fault
        if fault and (strict or self.flow.residual.max() == np.inf):
            raise InputError(fault)
        if fault:
            warnings.warn(fault, FflinWarning, stacklevel=3)

    @property
    def _fault(self) -> str:
        """Say why the knots are no motion of the robot; nothing if they are one."""
        missed = self.flow.residual
        k = int(missed.argmax())
        where = f"'{self.robot.name}': from t = {self.t[k]:g} to {self.t[k + 1]:g} s"
        if missed[k] == np.inf:
            return (
                f"t, q, v, u are no motion of {where} it overflows; expected finite rates and "
                "times; check their units"
            )
        if missed[k] > _MOTION:
            return (
                f"t, q, v, u are no motion of {where} they miss it by {missed[k]:.2g} of its "
                f"largest rate, and {(missed > _MOTION).sum()} of "
                f"{len(missed)} intervals by more than {_MOTION:g}; {_CAUSES}"
            )
        rates = np.linalg.norm(self.v[:, 3:6], axis=1)
        turns = np.diff(self.t) * np.maximum(rates[1:], rates[:-1])
        k = int(turns.argmax())
        if turns[k] > _FARTHEST_TURN:
            return (
                f"the base turns by {turns[k]:.2g} rad from t = {self.t[k]:g} to {self.t[k + 1]:g} "
                f"s, more than its ends can tell; give knots at most {_FARTHEST_TURN:g} rad apart"
            )
        return ""

    def save(self, path: str | Path) -> None:
        """Write it to a .npz, .mat, .json or .csv file, whole or not at all; see `load`."""
        from fflin.linear.trajectory_files import write_csv

        target = as_path(path)
        if type(self) is Trajectory and target.suffix == ".csv":
            write_csv(target, self)
        else:
            super().save(target)

    @staticmethod
    def load(  # type: ignore[override]
        path: str | Path, robot: Robot, *, hold: str | None = None, frame: str | None = None
    ) -> Trajectory:
        """Read a trajectory that `save`, `Motion.save` or another program wrote.

        A .npz, .mat or .json file has t (N,), q and v, or the states x (N, nx) of `StateMap`, and
        u, a row for each knot. A .csv file has named columns: t; q[0] ... and v[0] ..., or the
        names of the states, such as q_b.x; and those of the inputs, such as tau_m.joint_1, which
        are zero where left out. The texts `hold` and `frame` may be there too, in a .csv in every
        row.

        Parameters
        ----------
        path : str or Path
        robot : Robot
        hold, frame : str, optional
            What the file says by default, else what `Trajectory` takes; of x the frame says the
            axes of the velocities too.

        Raises
        ------
        FileError
            If the file cannot be read, is damaged, or has not these entries.
        InputError
            If what it has is no trajectory of this robot.
        """
        from fflin.linear.trajectory_files import read

        source = as_path(path)
        values = read(source, robot, hold, frame)
        try:
            return Trajectory(robot, **values)
        except InputError as error:
            raise InputError(f"{source}: {error}") from None

    def _within(self, t: float) -> float:
        t = number("t", t)
        if not self.t[0] <= t <= self.t[-1]:
            raise InputError(f"t is {t:g} s, expected {self.t[0]:g} to {self.t[-1]:g} s")
        return t

    @property
    def _given(self) -> dict[str, Any]:
        return {item.name: getattr(self, item.name) for item in fields(Trajectory)}


def _configurations(robot: Robot, q: ArrayLike, count: int) -> Array:
    """Return q (count, nq), where it is narrower with the cosine and sine of each angle."""
    rows, cosines = as_double("q", q), np.array(list(robot.unbounded), dtype=int)
    narrow = (count, robot.nq - len(cosines))
    if rows.shape == (count, robot.nq):
        return rows
    if rows.shape != narrow:
        hint = ": continuous joints take two columns, (cos, sin); `Trajectory` takes angles too, "
        hint = f"{hint}{narrow}" if len(cosines) else ""
        raise InputError(f"q has shape {rows.shape}, expected ({count}, {robot.nq}){hint}")
    wide = np.empty((count, robot.nq))
    wide[:, np.delete(np.arange(robot.nq), cosines + 1)] = rows
    angles = wide[:, cosines]
    wide[:, cosines], wide[:, cosines + 1] = np.cos(angles), np.sin(angles)
    return wide


def along(motion: Any, robot: Robot | None) -> Trajectory:
    """Return a motion by knots, its inputs held or linear, whichever has the least residual."""
    if motion.phases:
        raise InputError("a motion of several phases is of several robots; take each alone")
    if robot is None:
        raise InputError("the motion is from a file, without its robot; give the one that moves")
    entries = {name: getattr(motion, name) for name in ("t", "q", "v", "u", "placement")}
    from fflin.linear.trajectory_files import arguments

    values = arguments(entries, robot, "previous", motion.frame, motion.verified)
    held = Trajectory(robot, **values)
    if not (motion.u - motion.u[0]).any():
        return held
    before, u = motion.t[-4:-1] - motion.t[-1], values["u"]
    u[-1] = np.linalg.solve(np.vander(before).T, np.eye(len(before))[-1]) @ u[-4:-1]
    smooth = Trajectory(robot, **values | {"hold": "linear", "u": u})
    return min(held, smooth, key=lambda each: float(each.residual.max()))
