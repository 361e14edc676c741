"""Trajectory: motion of a robot given by knots, with constant or linear inputs between knots."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fflin.base.errors import FflinError, FflinWarning, InputError
from fflin.base.record import Design, record_of, write_record
from fflin.base.tables import folded
from fflin.base.validation import Array, as_double, frozen, number, vector
from fflin.base.writing import as_path
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.coordinates import refuse_orbit
from fflin.dynamics.points import require_slow
from fflin.dynamics.state import StateMap
from fflin.linear.flow import Flow
from fflin.robot.robot import Robot

# Largest residual up to which knots count as a motion of the robot.
_MOTION = 1e-2

# Largest rotation of the base between two knots [rad], so that its direction is unambiguous.
_FARTHEST_TURN = 2.5

_CAUSES = (
    "usual causes: wrong hold, wrong axes (frame) of u or v, wrong units of t or of the joints, "
    "or springs, damping or gravity that differ from the robot"
)


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Design):
    """Motion of a robot, given by configurations, velocities and inputs at knots.

    The arrays are copied and read-only.

    Parameters
    ----------
    robot : Robot
    t : array_like (N,)
        Times of the knots [s], increasing.
    q : array_like (N, nq)
        Configurations in Pinocchio's order. A continuous joint may have one column, its angle,
        instead of the two columns (cos, sin).
    v : array_like (N, nv)
        Velocities in Pinocchio's order.
    u : array_like (N, nu) or (N - 1, nu)
        Inputs at the knots. If u has N - 1 rows, each row applies to one interval between knots.
    hold : {"linear", "previous"}, optional
        Inputs between the knots: "linear" interpolates, and "previous" holds the value of the
        previous knot, like a digital controller. The default is "linear", or "previous" if u has
        N - 1 rows.
    frame : {"local", "hybrid", "world"}
        Axes of the force and torque on the base:

        - local: force and torque in base axes;
        - hybrid: force in world axes, torque in base axes;
        - world: force and torque in world axes.

        If the inputs are held ("previous"), the force and torque are constant in these axes.
    verified : bool
        False for data from a file without a SHA-256 digest, because damage to such a file cannot be
        detected.

    Raises
    ------
    InputError
        If an array has a wrong size, the times do not increase, or a row is not a valid
        configuration, velocity or input.

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
    _note: str = field(default="", kw_only=True)  # note printed below; not saved in files

    def __post_init__(self) -> None:
        refuse_orbit(self.robot, "trajectories")
        robot, nu = self.robot, len(Actuation(self._state).names)
        times = as_double("t", self.t)
        times = vector("t", times, times.size, "times of the knots")
        if len(times) < 2:
            raise InputError(f"t has {len(times)} times, expected at least 2, in increasing order")
        if (back := np.flatnonzero(np.diff(times) <= 0.0)).size:
            late, early = times[back[0] : back[0] + 2]
            raise InputError(
                f"t[{back[0] + 1}] is {early:.9g} s, after {late:.9g} s; expected increasing times"
            )
        if self.hold is not None and str(self.hold) not in ("linear", "previous"):
            raise InputError(f"hold is {self.hold!r}, expected 'linear' or 'previous'")
        count, u = len(times), as_double("u", self.u)
        short = u.shape == (count - 1, nu) and self.hold != "linear"
        if not short and u.shape != (count, nu):
            expected = f"({count}, {nu}), or ({count - 1}, {nu}) if each row acts over an interval"
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
        values: dict[str, object] = {name: frozen(np.array(each)) for name, each in rows.items()}
        values |= {"t": times, "hold": self.hold or ("previous" if short else "linear")}
        for name, value in values.items():
            object.__setattr__(self, name, value)
        super().__post_init__()

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}('{self.robot.name}', {len(self.t)} knots, {self.t[0]:g} to "
            f"{self.t[-1]:g} s, hold='{self.hold}', frame='{self.frame}')"
        )

    def __str__(self) -> str:
        """Return a text about the trajectory, with its residual as a motion of the robot."""
        said = self._fault or f"residual {self.residual.max():.1e}"
        note = f"\n{folded(self._note.splitlines())}" if self._note else ""
        return f"{folded(super().__str__().splitlines())}\n{folded([said])}{note}"

    @property
    def _state(self) -> StateMap:
        axes: Any = self.frame
        return StateMap(self.robot, frame=axes)

    @cached_property
    def flow(self) -> Flow:
        """Interpolation of the motion between the knots."""
        return Flow(self._state, self.t, self.q, self.v, self.u, self.hold == "previous")

    @cached_property
    def u_base(self) -> Array:
        """Inputs (N, nu) just after each knot, with inputs on the base in base axes."""
        state = self._state
        return frozen(Actuation(state).in_base_axes(state.charts(self.q), self.u))

    @property
    def residual(self) -> Array:
        """Residual (N,) at each knot, which shows how well the motion obeys the robot's dynamics.

        In each interval, the dynamics are integrated from the first knot under the given inputs.
        The error of the interval is the difference between the integrated state and the second
        knot, divided by the duration of the interval and by the largest rate of the motion; see
        `Flow`. The residual of a knot is the larger error of its two adjacent intervals.
        """
        found = self.flow.residual
        return np.maximum(np.append(found, 0.0), np.append(0.0, found))

    def point(self, t: float) -> tuple[Array, Array, Array]:
        """Return q (nq,), v (nv,), and u (nu,) in base axes, at time t [s].

        Between knots, q and v are cubic polynomials that match the robot's velocities and
        accelerations at the knots.

        Raises
        ------
        InputError
            If the time is before the first or after the last knot.
        """
        return self.flow.at(self._within(t))

    def resampled(self, dt: float) -> Trajectory:
        """Return the motion with new knots every dt [s] and at the end, interpolated by `point`.

        Held inputs are reproduced exactly only if every old knot is also a new knot.
        """
        times = self.samples(dt)
        if times[-1] < self.t[-1]:
            times = np.append(times, self.t[-1])
        q, v, _ = self.flow.points(times)
        u = np.array([self.flow.input(t) for t in times])
        kept = {"hold": self.hold, "frame": self.frame, "verified": self.verified}
        return Trajectory(self.robot, times, q, v, u, **kept)  # type: ignore[arg-type]

    def samples(self, dt: float) -> Array:
        """Return times from the first knot to the last, dt [s] apart."""
        dt, duration = number("dt", dt), float(self.t[-1] - self.t[0])
        if not dt >= 1e-7 * duration:
            raise InputError(
                f"dt is {dt:g} s, expected at least 1e-7 of the duration of {duration:g} s"
            )
        times: Array = self.t[0] + dt * np.arange(int(duration / dt * (1.0 + 1e-9)) + 1)
        if abs(times[-1] - self.t[-1]) <= 1e-6 * dt:
            times[-1] = self.t[-1]
        return times

    def require(self, *, strict: bool = False) -> None:
        """Warn if the residual of the motion exceeds 1e-2; raise `InputError` instead if `strict`.

        The message gives the interval with the largest error, this error, and the number of
        intervals with errors above 1e-2. If the integration overflows, `InputError` is raised even
        without `strict`.
        """
        fault = self._fault
        if fault and (strict or self.flow.residual.max() == np.inf):
            raise InputError(fault)
        if fault:
            warnings.warn(fault, FflinWarning, stacklevel=3)

    @property
    def _fault(self) -> str:
        """Return why the knots are not a motion of the robot, or an empty text."""
        missed = self.flow.residual
        k = int(missed.argmax())
        where = f"'{self.robot.name}': from t = {self.t[k]:g} to {self.t[k + 1]:g} s"
        if missed[k] > _MOTION:
            error = f"the error is {missed[k]:.2g} of the largest rate, and "
            if missed[k] == np.inf:
                error = "the integration overflows, and the errors of "
            return (
                f"t, q, v, u are not a motion of {where} {error}{(missed > _MOTION).sum()} of "
                f"{len(missed)} intervals exceed {_MOTION:g}; {_CAUSES}"
            )
        rates = np.linalg.norm(self.v[:, 3:6], axis=1)
        turns = np.diff(self.t) * np.maximum(rates[1:], rates[:-1])
        k = int(turns.argmax())
        if turns[k] > _FARTHEST_TURN:
            return (
                f"the base rotates by {turns[k]:.2g} rad from t = {self.t[k]:g} to "
                f"{self.t[k + 1]:g} s, too far for one interval; give more knots, at most "
                f"{_FARTHEST_TURN:g} rad apart"
            )
        return ""

    def save(self, path: str | Path) -> None:
        """Write the trajectory to a .npz, .mat, .json or .csv file, atomically; see `load`."""
        from fflin.linear.files import write_csv

        target = as_path(path)
        if type(self) is Trajectory and target.suffix == ".csv":
            write_csv(target, self)
        elif type(self) is Trajectory:
            record = record_of(self) | {"input_names": list(Actuation(self._state).names)}
            write_record(target, record, checksummed=self.verified)
        else:
            super().save(target)

    @staticmethod
    def load(  # type: ignore[override]
        path: str | Path, robot: Robot, *, hold: str | None = None, frame: str | None = None
    ) -> Trajectory:
        """Read a trajectory that `save`, `Motion.save` or another program wrote.

        A .npz, .mat or .json file contains the entries

        - t (N,);
        - q and v, or the states x (N, nx) of `StateMap`;
        - u, with one row for each knot;
        - optionally the texts `hold` and `frame`.

        A .csv file contains the named columns

        - t;
        - q[0] ... and v[0] ..., or the names of the states, such as q_b.x;
        - the names of inputs, such as tau_m.joint_1; inputs without a column are zero;
        - optionally `hold` and `frame`, the same in every row.

        Parameters
        ----------
        path : str or Path
        robot : Robot
        hold, frame : str, optional
            Options of `Trajectory`, by default as in the file. If the file contains x, `frame` also
            defines the axes of the velocities in x.

        Raises
        ------
        FileError
            If the file cannot be read, is damaged, or lacks a required entry.
        InputError
            If the entries of the file are not a valid trajectory of this robot.
        """
        from fflin.linear.files import read

        source = as_path(path)
        values = read(source, robot, hold, frame)
        try:
            return Trajectory(robot, **values)
        except InputError as error:
            raise InputError(f"{source}: {error}") from None

    def _within(self, t: float) -> float:
        t = number("t", t)
        if not self.t[0] <= t <= self.t[-1]:
            raise InputError(
                f"t is {t:g} s, expected a time of the trajectory, {self.t[0]:g} to "
                f"{self.t[-1]:g} s"
            )
        return t

    @property
    def _given(self) -> dict[str, Any]:
        return {item.name: getattr(self, item.name) for item in fields(Trajectory)}


def _configurations(robot: Robot, q: ArrayLike, count: int) -> Array:
    """Return q (count, nq); convert continuous joints to (cos, sin) if they are given as angles."""
    rows, cosines = as_double("q", q), np.array(list(robot.unbounded), dtype=int)
    narrow = (count, robot.nq - len(cosines))
    if rows.shape == (count, robot.nq):
        return rows
    if rows.shape != narrow:
        hint = f", or {narrow} with one angle for each continuous joint instead of (cos, sin)"
        hint = hint if len(cosines) else ""
        raise InputError(f"q has shape {rows.shape}, expected ({count}, {robot.nq}){hint}")
    wide = np.empty((count, robot.nq))
    wide[:, np.delete(np.arange(robot.nq), cosines + 1)] = rows
    angles = wide[:, cosines]
    wide[:, cosines], wide[:, cosines + 1] = np.cos(angles), np.sin(angles)
    return wide


def along(motion: Any, robot: Robot | None) -> Trajectory:
    """Convert a motion to a trajectory with constant or linear inputs, whichever fits better."""
    if motion.phases:
        raise InputError(
            "the motion has several phases, each with its own robot; convert each phase separately"
        )
    if robot is None:
        raise InputError(
            "the motion was read from a file, which does not contain its robot; give the robot, "
            "motion.trajectory(robot)"
        )
    entries = {name: getattr(motion, name) for name in ("t", "q", "v", "u", "placement")}
    from fflin.linear.files import arguments

    values = arguments(entries, robot, "previous", motion.frame, motion.verified)
    held = Trajectory(robot, **values)
    if not (motion.u - motion.u[0]).any():
        return held
    before, u = motion.t[-4:-1] - motion.t[-1], values["u"]
    u[-1] = np.linalg.solve(np.vander(before).T, np.eye(len(before))[-1]) @ u[-4:-1]
    smooth = Trajectory(robot, **values | {"hold": "linear", "u": u})
    return min(held, smooth, key=lambda each: float(each.residual.max()))
