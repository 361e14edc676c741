"""Motion of a robot given by knots, with constant or linear inputs between the knots."""

from __future__ import annotations

import warnings
from dataclasses import astuple, dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base import html, svg
from fflin.base.errors import FflinWarning, InputError, located
from fflin.base.record import Design, record_of, write_record
from fflin.base.rotation import rotation_matrices
from fflin.base.tables import data_frame, folded
from fflin.base.validation import ArrayLike, as_double, frozen, instance, number, vector
from fflin.base.writing import as_path
from fflin.dynamics.aba import Aba
from fflin.dynamics.coordinates import frame_of
from fflin.dynamics.integrators import DEFAULT_INTEGRATOR, integrate_rows
from fflin.dynamics.points import require_slow
from fflin.dynamics.state import Actuation, StateMap
from fflin.linear.optimality import Optimality
from fflin.robot.orbit import is_elliptic
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from pandas import DataFrame
    from scipy.interpolate import CubicSpline

    from fflin.base.validation import Array, Indices, Vector

# Largest residual at which the knots are accepted as a motion of the robot.
_MOTION = 1e-2

# Largest allowed rotation [rad] of the base between adjacent knots. For a rotation near pi, the
# knots do not define the direction of rotation.
_FARTHEST_TURN = 2.5

_CAUSES = (
    "usual causes: wrong hold, wrong axes (frame) of u or v, quaternions that are not in the order "
    "x, y, z, w, knots of a coarse or semi-implicit Euler integration, wrong units of t or of the "
    "joints, or springs, damping or gravity that differ from the robot"
)

_MORE_KNOTS = "give more knots, with steps= of linearize_orbit or --periodic N"

# The integration over an interval is repeated with halved steps. The repetition ends if the state
# at the end of the interval changes by at most _ACCURACY, or if the interval has _MOST_STEPS steps.
# The change of the state is relative: it is divided by the duration of the interval and by the
# largest velocities and accelerations of the motion.
_ACCURACY, _MOST_STEPS = 1e-8, 128

# Two durations with at most this relative difference count as equal.
_SAME_TIME = 1e-9

# Relative difference of magnetic fields that count as equal.
_SAME_FIELD = 1e-6

# Assumed rounding errors. _POSITION_ROUNDING is the error of a position, relative to the largest
# position. An acceleration is a sum of terms. _SUM_ROUNDING is the error of this sum, relative to
# the sum of the magnitudes of the terms.
_EPS = float(np.finfo(float).eps)
_POSITION_ROUNDING, _SUM_ROUNDING = 16.0 * _EPS, 1e3 * _EPS

# Rates [SI units] of a robot with constraints below this fraction of the largest rate count as
# zero.
_HELD = 1e-6

# The same fraction for a robot without constraints, whose wheels may be at rest.
_RESTS = 1e-12

# Largest difference [SI units] between the first and the last state of a periodic motion.
_CLOSED = 1e-6

# A time counts as the time of a knot if the two differ by less than this fraction of the interval.
_NEAR = 1e-9


class Gaps(NamedTuple):
    """Gaps of a motion: ends of the intervals, integrated from their first knots, and next knots.

    `q` and `v` (N - 1, nv) are the displacements and changes of velocity from the next knots to
    these ends.
    """

    errors: Array  # (N - 1,) relative sizes; infinite if the integration overflows
    q: Array
    v: Array


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
    hold : {"linear", "previous", "smooth"}, optional
        Inputs between the knots: "linear" interpolates, and "previous" holds the value of the
        previous knot, like a digital controller. "smooth" interpolates the inputs of a periodic
        motion by periodic cubic splines. The default is "linear", or "previous" if u has
        N - 1 rows.
    frame : {"local", "hybrid", "world"}
        Axes of the force and torque on the base:

        - local: force and torque in base axes;
        - hybrid: force in world axes, torque in base axes;
        - world: force and torque in world axes.

        If the inputs are held ("previous"), the force and torque are constant in these axes. In
        orbit, q and v are relative to the orbital frame with the axes ``lvlh``, t = 0 is defined by
        the orbit, and `frame` is "local" or "lvlh", which has force in the axes ``lvlh``.
    period : float
        Time [s] after which the motion repeats: the time from the first knot to the last, or 0 for
        a motion that ends. The states at both knots must be equal. `linearize_orbit` makes periodic
        motions.
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

    robot: Robot
    t: Vector
    q: Array
    v: Array
    u: Array
    hold: str | None = field(default=None, kw_only=True)
    frame: str = field(default="local", kw_only=True)
    period: float = field(default=0.0, kw_only=True)
    # last lines of the report; not saved in files
    _note: str = field(default="", kw_only=True)
    # residuals of a plan, which `save` also writes
    _optimality: Optimality | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        robot = instance(
            "robot", self.robot, Robot, "a fflin.Robot; fflin.load makes one"
        )
        if robot.orbit and self.frame == "hill":
            raise InputError(
                "frame is 'hill', but trajectories in orbit are relative to the axes lvlh; give "
                "frame='local' or 'lvlh', also to simulate"
            )
        nu = len(self.actuation.names)
        times = vector(
            "t", as_double("t", self.t), np.size(self.t), "times of the knots"
        )
        count = len(times)
        if count < 2:
            raise InputError(
                f"t has {count} times, expected at least 2, in increasing order"
            )
        if (back := np.flatnonzero(np.diff(times) <= 0.0)).size:
            late, early = times[back[0] : back[0] + 2]
            raise InputError(
                f"t[{back[0] + 1}] is {early:.9g} s, after {late:.9g} s; expected increasing times"
            )
        holds: tuple[str, ...] = ("linear", "previous")
        if self.period:
            holds = (*holds, "smooth")
        if self.hold is not None and str(self.hold) not in holds:
            expected = " or ".join(map(repr, holds))
            raise InputError(f"hold is {self.hold!r}, expected {expected}")
        q = _configurations(robot, self.q, count)
        v, u = as_double("v", self.v), as_double("u", self.u)
        short = u.shape == (count - 1, nu) and self.hold not in ("linear", "smooth")
        hint = f", or ({count - 1}, {nu}) if each row acts over an interval"
        if short:
            u = np.vstack((u, u[-1:]))
        for name, rows, size, more in (("v", v, robot.nv, ""), ("u", u, nu, hint)):
            if rows.shape != (count, size):
                raise InputError(
                    f"{name} has shape {rows.shape}, expected {(count, size)}{more}"
                )
        for k, t in enumerate(times):
            with located(f"at t = {t:g} s"):
                q[k] = robot.checked_configuration(q[k])
                v[k] = robot.checked_velocity(v[k])
                require_slow("v", v[k])
                vector("u", u[k], nu, "the robot's inputs")
        values: dict[str, object] = {
            "t": times,
            "q": frozen(q),
            "v": frozen(v),
            "u": frozen(u),
        }
        default_hold = "previous" if short else "linear"
        values["hold"] = self.hold or default_hold
        for name, value in values.items():
            object.__setattr__(self, name, value)
        if self.period:
            self._require_period()
        super().__post_init__()

    def _require_periodic_field(self) -> None:
        """Raise `InputError` if the magnetic field does not repeat after `period`."""
        flux = self.actuation.flux
        for t in self.t.tolist():
            before, after = flux(t), flux(t + self.period)
            difference = np.linalg.norm(after - before)
            if difference > _SAME_FIELD * np.linalg.norm(before):
                raise InputError(
                    f"period is {self.period:g} s, but the magnetic field at t = {t:g} s differs "
                    "from the field one period later; give a period of the field, which is the "
                    "period of the orbit for field='dipole'"
                )

    def _require_period(self) -> None:
        """Raise `InputError` if the motion does not repeat after `period`."""
        period = number("period", self.period)
        duration = float(self.t[-1] - self.t[0])
        if not abs(period - duration) <= _SAME_TIME * duration:
            raise InputError(
                f"period is {period:g} s, expected the duration of the trajectory, {duration:g} s"
            )
        if self.robot.orbit and is_elliptic(self.robot.orbit):
            orbits = period / self.robot.orbit.period
            if round(orbits) < 1 or abs(orbits - round(orbits)) > _SAME_TIME * orbits:
                raise InputError(
                    f"period is {period:g} s, but the field of the elliptic orbit repeats after "
                    f"{self.robot.orbit.period:g} s; give a multiple of this period"
                )
        if self.actuation.torquers:
            self._require_periodic_field()
        apart = pin.difference(self.robot.model, self.q[0], self.q[-1])
        wheels = [joint.idx_v for joint in self.robot.joints if joint.unbounded]
        apart[wheels] = 0.0
        speed = np.abs(self.v).max(initial=0.0)
        jump = np.abs(self.v[-1] - self.v[0]).max()
        if np.abs(apart).max() > _CLOSED or jump > _CLOSED * max(1.0, speed):
            raise InputError(
                f"the motion does not repeat after {period:g} s: its first and last states differ "
                f"by {np.abs(apart).max():.2g} (rad, m) and {jump:.2g} (rad/s, m/s); give a "
                "periodic motion"
            )
        object.__setattr__(self, "period", period)

    def _within_period(self, times: Array) -> Array:
        """Return times (k,) of a periodic motion, moved into its first period.

        The times of a motion that ends are returned unchanged.
        """
        if not self.period:
            return times
        start = self.t[0]
        late = (times > self.t[-1]) | (times < start)
        return np.where(late, start + np.mod(times - start, self.period), times)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}('{self.robot.name}', {len(self.t)} knots, {self.t[0]:g} to "
            f"{self.t[-1]:g} s, hold='{self.hold}', frame='{self.frame}')"
        )

    def _report(self) -> str:
        """Return text about the trajectory: its largest residual, or why it is invalid."""
        return folded([repr(self), self._verdict(), *self._remarks()])

    def _remarks(self) -> list[str]:
        """Return the lines of the report after the verdict."""
        remarks = self._note.splitlines()
        if self._optimality is not None and not remarks:
            # The trajectory was read from a file.
            return [str(self._optimality)]
        return remarks

    def _verdict(self) -> str:
        return self._fault or f"residual {self.residual.max():.1e}"

    def _html_parts(self) -> list[str]:
        rows = svg.sampled(len(self.t))
        robot = self.robot
        q = self.q[rows]
        # The product of two unit quaternions is the cosine of half the angle between them.
        cosine = np.minimum(1.0, np.abs(q[:, 3:7] @ q[0, 3:7]))
        angle = 2.0 * np.degrees(np.arccos(cosine))
        revolute: dict[str, Array] = {}
        prismatic: dict[str, Array] = {}
        for joint in robot.joints:
            if joint.mode:
                continue
            values = np.array([joint.value(row) for row in q])
            if joint.prismatic:
                prismatic[joint.name] = values
            else:
                revolute[joint.name] = np.degrees(values)
        # title of each picture: unit and curves
        charts: dict[str, tuple[str, dict[str, Array]]] = {
            "attitude from the start": ("deg", {"base": angle}),
            "joints": ("deg", revolute),
            "prismatic joints": ("m", prismatic),
        }
        pictures = [
            svg.figure(title, svg.curves(self.t[rows], curves, unit))
            for title, (unit, curves) in charts.items()
            if curves
        ]
        notes = [html.paragraph(note) for note in self._remarks()]
        return [
            html.verdict(self._verdict(), not self._fault),
            *notes,
            html.side_by_side(*pictures),
        ]

    @cached_property
    def _aba(self) -> Aba:
        return Aba(StateMap(self.robot, frame=frame_of(self.robot, self.frame)))

    @property
    def optimality(self) -> Optimality | None:
        """Effort and KKT residuals of a plan; see `plan`.

        None if the trajectory is not the result of `plan`. Files contain these residuals.
        """
        return self._optimality

    @property
    def actuation(self) -> Actuation:
        """Inputs of the robot, with the force and torque on the base in the axes of `frame`."""
        return self._aba.actuation

    @cached_property
    def u_base(self) -> Array:
        """Inputs (N, nu) just after each knot, with inputs on the base in base axes."""
        return frozen(self._in_base_axes(self.q, self.u))

    def _in_base_axes(self, q: Array, u: Array) -> Array:
        charts = self._aba.state.charts
        if not self.actuation.held:
            return u
        return self.actuation.in_base_axes(charts(q), u)

    @property
    def residual(self) -> Array:
        """Residual (N,) at each knot, which shows how well the motion obeys the robot's dynamics.

        In each interval, the dynamics are integrated from the first knot under the given inputs.
        The error of the interval is the difference between the integrated state and the second
        knot, divided by the duration of the interval and by the largest rate of the motion. The
        residual of a knot is the larger error of its two adjacent intervals.
        """
        errors = self.interval_errors
        larger: Array = np.maximum(np.append(errors, 0.0), np.append(0.0, errors))
        return larger

    def point(self, t: float) -> tuple[Array, Array, Array]:
        """Return q (nq,), v (nv,), and u (nu,) in base axes, at time t [s].

        Between knots, q and v are cubic polynomials that match the robot's velocities and
        accelerations at the knots.

        Raises
        ------
        InputError
            If the motion has no period, and the time is before the first or after the last knot.
        """
        q, v, u = self.points(np.array([self._within(t)]))
        return q[0], v[0], u[0]

    def points(self, times: Array) -> tuple[Array, Array, Array]:
        """Return q, v and u (k, ..) at times (k,); see `point`."""
        times = self._within_period(times)
        k, s = intervals_of(self.t, times)
        s = s[:, None]
        steps, v = np.einsum("ij,lijk->lik", s ** np.arange(4), self.cubics[:, k])
        q = integrate_rows(self.robot.model, self.q[k], steps)
        return q, v, self._in_base_axes(q, self._input(k, s))

    def _input(self, k: int | Indices, fraction: float | Array) -> Array:
        """Return the inputs at one time in each of the intervals k, in the axes of `frame`.

        The time is given by `fraction`, the elapsed fraction of each interval, from 0 to 1.
        """
        u: Array = self.u[k]
        if self.hold == "previous":
            return u
        if self.hold == "smooth":
            return self._smooth_input(k, fraction)
        return u + fraction * (self.u[k + 1] - u)

    def _smooth_input(self, k: int | Indices, fraction: float | Array) -> Array:
        """Return the inputs by periodic cubic splines; see `_input` for the arguments."""
        start = self.t[k]
        times = start + np.reshape(fraction, np.shape(start)) * (self.t[k + 1] - start)
        u: Array = self._splines(times)
        return u

    @cached_property
    def _splines(self) -> CubicSpline:
        from scipy.interpolate import CubicSpline

        values = np.vstack((self.u[:-1], self.u[:1]))
        return CubicSpline(self.t, values, bc_type="periodic")

    @property
    def smooth_pieces(self) -> Array:
        """Coefficients (N - 1, 4, nu) of smooth inputs, for powers of the elapsed fraction.

        They are empty if the inputs are not smooth.
        """
        if self.hold != "smooth":
            return np.zeros((0, 4, self.u.shape[1]))
        lengths = np.diff(self.t)[:, None, None]
        powers = np.arange(4)[:, None]
        pieces: Array = self._splines.c[::-1].swapaxes(0, 1) * lengths**powers
        return pieces

    def accelerations(self) -> Array:
        """Return the accelerations (N, nv) just after each knot, in Pinocchio's order."""
        return self._aba.accelerations(self.q, self.v, self.u_base, self.t)

    def resampled(self, dt: float) -> Trajectory:
        """Return the motion with new knots every dt [s] and at the end, interpolated by `point`.

        Held inputs are reproduced exactly only if every old knot is also a new knot.
        """
        times = self.samples(dt)
        if times[-1] < self.t[-1]:
            times = np.append(times, self.t[-1])
        q, v, _ = self.points(times)
        k, s = intervals_of(self.t, times)
        u = self._input(k, s[:, None])
        return Trajectory._of(self, t=times, q=q, v=v, u=u, _note="", _optimality=None)

    def samples(self, dt: float) -> Array:
        """Return times from the first knot to the last, dt [s] apart."""
        dt = number("dt", dt)
        duration = float(self.t[-1] - self.t[0])
        if not dt >= 1e-7 * duration:
            raise InputError(
                f"dt is {dt:g} s, expected at least 1e-7 of the duration of {duration:g} s"
            )
        if not dt <= duration * (1.0 + _SAME_TIME):
            raise InputError(
                f"dt is {dt:g} s, expected at most the duration of {duration:g} s"
            )
        times: Array = self.t[0] + dt * np.arange(
            int(duration / dt * (1.0 + _SAME_TIME)) + 1
        )
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
        if fault and (strict or self.interval_errors.max() == np.inf):
            raise InputError(fault)
        if fault:
            warnings.warn(fault, FflinWarning, stacklevel=3)

    @property
    def _fault(self) -> str:
        """Return the reason why the trajectory is invalid, or an empty text.

        A trajectory is invalid if the knots are not a motion of the robot, or if the base rotates
        too far in one interval.
        """
        missed = self.interval_errors
        k = int(missed.argmax())
        where = f"'{self.robot.name}': from t = {self.t[k]:g} to {self.t[k + 1]:g} s"
        if missed[k] > _MOTION:
            error = f"the error is {missed[k]:.2g} of the largest rate, and "
            if missed[k] == np.inf:
                error = "the integration overflows, and the errors of "
            return (
                f"t, q, v, u are not a motion of {where} {error}{(missed > _MOTION).sum()} of "
                f"{len(missed)} intervals exceed {_MOTION:g}; "
                f"{_MORE_KNOTS if self.period else _CAUSES}"
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
        else:
            record = record_of(self) | {"input_names": list(self.actuation.names)}
            if self._optimality is not None:
                record["optimality"] = np.array(astuple(self._optimality), dtype=float)
            write_record(target, record, checksummed=self.verified)

    def to_pandas(self) -> DataFrame:
        """Return t, q, v and u as a pandas data frame, with the times as its index.

        The columns are the columns of the .csv file that `save` writes.

        Raises
        ------
        MissingPackageError
            If pandas is not installed.
        """
        from fflin.linear.files import trajectory_columns

        rows = np.column_stack((self.t, self.q, self.v, self.u))
        return data_frame(trajectory_columns(self), rows, index="t")

    @staticmethod
    def load(  # type: ignore[override]
        path: str | Path,
        robot: Robot,
        *,
        hold: str | None = None,
        frame: str | None = None,
    ) -> Trajectory:
        """Read a trajectory that `save`, `Motion.save` or another program wrote.

        A .npz, .mat or .json file contains the entries

        - t (N,);
        - q and v, or the states x (N, nx) of `StateMap`;
        - u, with one row for each knot;
        - optionally the texts `hold` and `frame`;
        - optionally `optimality`, the five values of `Optimality` in their order.

        A .csv file contains the named columns

        - t;
        - q[0] ... and v[0] ..., or the names of the states, such as q_b.x;
        - the names of inputs, such as tau_m.joint_1; inputs without a column are zero;
        - optionally `hold`, `frame` and the values of `Optimality`, such as `stationarity`, the
          same in every row.

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
        instance("robot", robot, Robot, "a fflin.Robot; fflin.load makes one")
        values = read(source, robot, hold, frame)
        with located(str(source)):
            return Trajectory(robot, **values)

    def _within(self, t: float) -> float:
        t = number("t", t)
        if self.period:
            return float(self._within_period(np.array([t]))[0])
        if not self.t[0] <= t <= self.t[-1]:
            raise InputError(
                f"t is {t:g} s, expected a time of the trajectory, {self.t[0]:g} to "
                f"{self.t[-1]:g} s"
            )
        return t

    @property
    def interval_errors(self) -> Array:
        """Relative error (N - 1,) of each interval, integrated from its first knot; see `residual`.

        The error is infinite if the integration overflows.
        """
        return self.gaps.errors

    @cached_property
    def gaps(self) -> Gaps:
        """Gaps between the intervals if each is integrated from its first knot."""
        # Errors are divided by the largest velocities and accelerations of the motion. A high
        # orbital velocity of the base would make this divisor so large that it hides errors.
        # Therefore, subtract the median velocity of the base. By Galilean invariance, this does not
        # change the accelerations.
        t = self.t
        rotations = rotation_matrices(self.q[:, 3:7])
        q = self.q.copy()
        v = self.v.copy()
        velocities = (rotations @ v[:, :3, None])[..., 0]
        usual = np.median(velocities, axis=0)
        if self.robot.orbit:
            # In orbit, the accelerations depend on position and velocity of the base.
            usual = np.zeros(3)
        flown = np.outer(t - t[0], usual)
        farthest = float(np.abs(q[:, 7:]).max(initial=1.0))
        digits = np.full(v.shape[1], _POSITION_ROUNDING * farthest)
        digits[:3] = _POSITION_ROUNDING * np.abs((q[:, :3], flown, velocities)).max()
        if not self.robot.orbit:
            q[:, :3] -= q[0, :3] + flown
        v[:, :3] -= usual @ rotations
        speed, push, sums = self._error_scales(q, v)

        def size(of_q: Array, of_v: Array, h: float) -> float:
            miss = np.maximum(np.abs(of_q) - digits, 0.0) / (speed * h)
            jump = np.maximum(np.abs(of_v) - digits - _SUM_ROUNDING * sums * h, 0.0) / (
                push * h
            )
            return float(np.maximum(miss, jump).max())

        errors = np.zeros(len(t) - 1)
        displacements = np.zeros((len(t) - 1, len(digits)))
        jumps = np.zeros((len(t) - 1, len(digits)))
        steps = 1
        model = self.robot.model
        # If the knots are not a motion of the robot, the integration may overflow. The error of the
        # interval is infinite in this case, so suppress NumPy's warnings about the overflow.
        with np.errstate(all="ignore"):
            for k, h in enumerate(np.diff(t).tolist()):
                steps = max(1, steps // 4)
                end = self.end(k, steps, q[k], v[k])
                while steps < _MOST_STEPS:
                    before = end
                    steps = 2 * steps
                    end = self.end(k, steps, q[k], v[k])
                    apart = pin.difference(model, before[0], end[0])
                    change = size(apart, end[1] - before[1], h)
                    if change <= _ACCURACY or not np.isfinite(change):
                        break
                displacements[k] = pin.difference(model, q[k + 1], end[0])
                jumps[k] = end[1] - v[k + 1]
                errors[k] = size(displacements[k], jumps[k], h)
        errors = np.where(np.isfinite(errors), errors, np.inf)
        return Gaps(errors, displacements, jumps)

    def _error_scales(self, q: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return the scales (nv,) of errors of velocities and accelerations.

        The third array (nv,) contains the largest sums of the magnitudes of the terms that the
        accelerations are sums of. A fast wheel would hide the errors of slower joints if they had
        the same scale. Therefore, each rotor has its own scale.
        """
        state = self._aba.state
        rates = self._aba.accelerations(q, v, self._in_base_axes(q, self.u), self.t)
        terms = [
            state.spread(self._aba.terms(*knot))
            for knot in zip(q, v, self.u, strict=True)
        ]
        # Take the largest magnitudes over all knots. Infinite or NaN entries count as zero.
        push, sums = (
            np.nan_to_num(np.abs(x), posinf=0.0).max(axis=0) for x in (rates, terms)
        )
        rotors = state.robot.rotors
        alone = [joint.idx_v for joint in state.robot.joints if joint.name in rotors]
        others = sorted({*range(6, v.shape[1])} - {*alone})
        speed = np.abs(v).max(axis=0)
        if self.robot.orbit:
            # A robot that is held at rest has no velocities and accelerations. So the scale of its
            # errors is the acceleration by its inputs, over the time in which the orbit turns by
            # 1 rad.
            push = np.maximum(push, sums)
            speed = np.maximum(speed, push / self.robot.orbit.mean_motion)
        # The base, joints or wheels may be at rest, so that their rates are rounding errors.
        least = _HELD if self.robot.constraints else _RESTS
        floors = [least * x.max() for x in (speed, push)]
        for group in ([0, 1, 2], [3, 4, 5], *([rotor] for rotor in alone), others):
            for x, floor in zip((speed, push), floors, strict=True):
                x[group] = max(x[group].max(initial=0.0), floor) or 1.0
        return speed, push, sums

    def end(self, k: int, steps: int, q: Array, v: Array) -> tuple[Array, Array]:
        """Integrate by (11.1) over an interval from a state at its first knot; return q, v."""
        start = self.t[k]
        h = self.t[k + 1] - self.t[k]
        method = DEFAULT_INTEGRATOR(self.robot.model, h / steps)

        state = self._aba.state

        def rate(t: float, q: Array, v: Array) -> Array:
            state.move_to(t)
            u = self._in_base_axes(q, self._input(k, (t - start) / h))
            return self._aba.acceleration(q, v, u).copy()

        for step in range(steps):
            q, v = method.step(rate, start + step * method.dt, q, v)
        return q, v

    @cached_property
    def cubics(self) -> Array:
        """Coefficients (2, N - 1, 4, nv) of the cubic polynomials for displacement and velocity."""
        q = self.q
        v = self.v
        h = np.diff(self.t)[:, None]
        model = self.robot.model
        begin = self._aba.accelerations(q, v, self.u_base, self.t)
        end = begin[1:]
        if self.hold == "previous":
            u = self._in_base_axes(q[1:], self.u[:-1])
            end = self._aba.accelerations(q[1:], v[1:], u, self.t[1:])
        apart = np.array([pin.difference(model, *pair) for pair in pairwise(q)])
        wheels = [joint.idx_v for joint in self.robot.joints if joint.unbounded]
        # The knots give the angle of a continuous joint only modulo full turns. Compute the number
        # of full turns between two knots from the speed of the joint.
        turns = (0.5 * h * (v[1:] + v[:-1]) - apart)[:, wheels] / (2.0 * np.pi)
        apart[:, wheels] += 2.0 * np.pi * np.round(turns)
        slopes = [
            pin.dDifference(model, *pair, pin.ArgumentPosition.ARG1) @ speed
            for pair, speed in zip(pairwise(q), v[1:], strict=True)
        ]
        displacement = cubic(np.zeros_like(apart), apart, h * v[:-1], h * slopes)
        return np.array((displacement, cubic(v[:-1], v[1:], h * begin[:-1], h * end)))


def _configurations(robot: Robot, q: ArrayLike, count: int) -> Array:
    """Return q (count, nq); convert angles of continuous joints to (cos, sin)."""
    rows, cosines = as_double("q", q), np.array(list(robot.unbounded), dtype=int)
    narrow = (count, robot.nq - len(cosines))
    if rows.shape == (count, robot.nq):
        return rows
    if rows.shape != narrow:
        hint = ""
        if len(cosines):
            hint = f", or {narrow} with one angle for each continuous joint instead of (cos, sin)"
        raise InputError(
            f"q has shape {rows.shape}, expected ({count}, {robot.nq}){hint}"
        )
    wide = np.empty((count, robot.nq))
    wide[:, np.delete(np.arange(robot.nq), cosines + 1)] = rows
    angles = wide[:, cosines]
    wide[:, cosines], wide[:, cosines + 1] = np.cos(angles), np.sin(angles)
    return wide


def intervals_of(t: Array, times: Array) -> tuple[Indices, Array]:
    """Return the interval index (k,) of each time, and the elapsed fraction (k,) of the interval.

    `t` contains the times of the knots.
    """
    k = t[1:-1].searchsorted(times, "right")
    fraction = (times - t[k]) / (t[k + 1] - t[k])
    ends = (fraction > 1.0 - _NEAR) & (k < len(t) - 2)
    fraction[ends | (fraction < _NEAR)] = 0.0
    return k + ends, np.minimum(fraction, 1.0)


def cubic(first: Array, last: Array, rate: Array, end_rate: Array) -> Array:
    """Return cubic polynomials over [0, 1] with given values and rates at both ends.

    The result (N - 1, 4, ..) contains the coefficients in the order of increasing powers.
    """
    apart = last - first
    return np.stack(
        (first, rate, 3 * apart - 2 * rate - end_rate, rate + end_rate - 2 * apart),
        axis=1,
    )


def refuse_periodic(traj: Trajectory, what: str) -> None:
    """Raise `InputError` for a periodic trajectory; `what` is the subject of the message."""
    if traj.period:
        raise InputError(
            f"{what} needs a trajectory that ends, but this one repeats after {traj.period:g} s; "
            "use tvlqr with Qf='periodic'"
        )
