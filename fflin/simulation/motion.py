"""A simulated motion: what was done, where it led, and the figures that prove it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pinocchio as pin

from fflin.base import record
from fflin.base.errors import InputError
from fflin.base.record import Design
from fflin.base.validation import Array, instance
from fflin.base.writing import as_path, check_ending
from fflin.dynamics.state_rows import attitude_errors, moving_errors
from fflin.linear.trajectory_files import write_table
from fflin.robot.orbit import CircularOrbit
from fflin.simulation.report import Passed, Saturated, limited, motion_report, passed, saturated

FORMATS = (*record.FORMATS, ".csv")

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fflin.dynamics.impact import Impact
    from fflin.linear.trajectory import Trajectory
    from fflin.robot.robot import Robot


@dataclass(frozen=True, eq=False, repr=False)
class Motion(Design):
    """A motion of a robot, row by row.

    Attributes
    ----------
    t : ndarray (N,)
        Times [s].
    q : ndarray (N, nq)
    v : ndarray (N, nv)
        Configuration and velocity in Pinocchio's order.
    x : ndarray (N, nx)
        The state in the chart of `reference` and `frame`; continuous joints go on counting turns.
    u : ndarray (N, nu)
        What acted from t on, in the frame's axes; the last row repeats what acted to the end.
    target : ndarray (nx,) or (N, nx)
        The state that is steered to, of a motion that is followed the one at each time; empty
        where none is known.
    prediction : ndarray (N, nx)
        The state as the linear model has it under the same law; no rows where there is none.
    energy : ndarray (N,)
        Kinetic, of gravity and of springs [J]; in orbit the Jacobi integral, which is kinetic
        relative to the frame, of tide and turning of the frame, and of springs.
    momentum : ndarray (N, 6)
        Angular about the centre of mass [N m s], then linear [N s], in world axes; in orbit that
        of the motion relative to the frame.
    momentum_drift : ndarray (N,)
        How far the momentum is from its initial value and the impulse since. The linear part is
        relative to the mass times the rms speed of its elements at the fastest row. The angular
        part is relative to that speed times mass and radius of gyration about the base's first
        position, plus what wheels store: the most that momenta of that energy can be, (11.5) of
        docs/derivation.md. In orbit, where momentum is not kept, how far `energy` is from its
        initial value and the work since, relative to its largest terms.
    com_drift : ndarray (N,)
        How far the centre of mass is from where its initial velocity and the impulse since take
        it [m]; no rows in orbit, and where a file does not tell.
    state_names, input_names, state_units, input_units : tuple of str
    frame : {"hybrid", "local", "world", "lvlh", "hill"}
    robot, urdf_sha256 : str
    stopped : str
        Why it ended before its time; empty where it did not.
    wheels : tuple of str
        The joints that are reaction wheels, whose angle is no error.
    wheel_inertias : ndarray (k,)
        Of those, about their axes [kg m^2]; none where a file does not tell.
    steered : tuple of str
        The states that the policy is known to feed back; empty where that is not known.
    notes : tuple of str
        What is to be known of the run.
    limit_names : tuple of str
        The states and inputs that have limits.
    engine : str
        What ran the loop, "compiled" or "python"; empty where a file does not tell.
    limits : ndarray (k, 2)
        Their least and largest values, infinite where there is none, kept within or not.
    phases, starts : tuple of str, ndarray (k,)
        Of a motion that was carried on (`then`), how each phase began and when [s].

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> spin = fflin.velocity(robot, {"omega_b.z": 0.1})
    >>> motion = fflin.simulate(robot, v0=spin, duration=2.0)
    >>> motion.save("motion.npz")
    >>> fflin.Motion.load("motion.npz").x.shape == motion.x.shape
    True
    """

    OPEN: ClassVar = ("limits",)
    VECTORS: ClassVar = (
        *("t", "energy", "momentum_drift", "com_drift", "placement", "wheel_inertias", "starts"),
    )

    t: Array
    q: Array
    v: Array
    x: Array
    u: Array
    target: Array
    prediction: Array
    energy: Array
    momentum: Array
    momentum_drift: Array
    placement: Array
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_units: tuple[str, ...]
    frame: str
    robot: str
    urdf_sha256: str
    stopped: str
    com_drift: Array = field(default_factory=lambda: np.zeros(0))
    _robot: Any = field(default=None, kw_only=True)  # that was simulated; no file has it
    wheels: tuple[str, ...] = field(default_factory=tuple)
    wheel_inertias: Array = field(default_factory=lambda: np.zeros(0))
    steered: tuple[str, ...] = field(default_factory=tuple)
    notes: tuple[str, ...] = field(default_factory=tuple)
    limit_names: tuple[str, ...] = field(default_factory=tuple)
    limits: Array = field(default_factory=lambda: np.zeros((0, 2)))
    engine: str = field(default_factory=str)
    phases: tuple[str, ...] = field(default_factory=tuple)
    starts: Array = field(default_factory=lambda: np.zeros(0))
    _phases: tuple[Any, ...] = field(default=(), kw_only=True)  # motions and impacts; as _robot
    circles: str = field(default_factory=str)  # the orbit, as text

    def __post_init__(self) -> None:
        rows = (self.q, self.v, self.x, self.u, self.energy, self.momentum, self.momentum_drift)
        may_lack = (self.prediction, self.com_drift)
        count = len(self.t)
        if any(len(x) != count for x in rows) or any(len(x) not in (0, count) for x in may_lack):
            raise InputError("the rows of the motion are not as many as its times")
        if self.target.size in (0, self.x.shape[1]):  # of .mat, which knows no vectors
            object.__setattr__(self, "target", self.target.ravel())
        if not len(self.prediction):  # of json, which knows no empty matrices
            object.__setattr__(self, "prediction", np.zeros((0, self.x.shape[1])))
        object.__setattr__(self, "limits", self.limits.reshape(len(self.limit_names), 2))
        super().__post_init__()

    def __repr__(self) -> str:
        stopped = f", stopped: {self.stopped}" if self.stopped else ""
        return (
            f"Motion('{self.robot}', {len(self.t)} rows, {self.t[0]:g} to {self.t[-1]:g} s, "
            f"{self.kept} drift {self.momentum_drift.max():.1e}, "
            f"com drift {self.com_drift.max(initial=0.0):.1e} m{stopped})"
        )

    def __str__(self) -> str:
        report = motion_report(self)
        return report if self.verified else f"{report}\n{record.NOT_VERIFIED}"

    @property
    def reference(self) -> pin.SE3:
        """Placement that attitude and position are relative to."""
        return pin.XYZQUATToSE3(self.placement)

    @property
    def orbit(self) -> CircularOrbit | None:
        """What it circles, if anything; the world is then the frame of it that `frame` says."""
        return CircularOrbit.from_json(self.circles) if self.circles else None

    @property
    def kept(self) -> str:
        """What it conserves but for what acts on it, whose drift is `momentum_drift`."""
        return "Jacobi integral" if self.circles else "momentum"

    @property
    def linear(self) -> Array | None:
        """The linear model's states (N, nx), where it was asked for."""
        return self.prediction if len(self.prediction) else None

    @property
    def error(self) -> Array | None:
        """The states less the target (N, nx); None where there is no target.

        Of a target that moves, in its own axes, as `linearize_trajectory` has it.
        """
        if self.tracked:
            return moving_errors(self.frame, self.x, self.target)
        return self.x - self.target if self.target.size else None

    @property
    def tracked(self) -> bool:
        """Whether the target moves, one a row."""
        return self.target.ndim == 2 and self.target.size > 0

    @property
    def attitude_error(self) -> Array | None:
        """Angle (N,) [deg] between the base's attitude and the target's; None without target."""
        return attitude_errors(self.x, self.target) if self.target.size else None

    def then(self, *later: Impact | Motion) -> Motion:
        """Return one motion of this and what came after: ``approach.then(caught, held)``.

        Parameters
        ----------
        *later : Impact or Motion
            Of `capture` or `jam` at the last row before it, and of `simulate` from there on.

        Returns
        -------
        Motion
            Of this one's robot and in its chart, on one time axis; a joint that jammed stands
            still. Energy and momentum are those of the robot as it is at the time.

        Raises
        ------
        InputError
            If one does not begin where the one before ended, has another frame or more inputs, or
            is from a file.
        """
        from fflin.simulation.phases import carried_on

        return carried_on(self, later)

    def trajectory(self, robot: Robot | None = None) -> Trajectory:
        """Return the motion by knots, with inputs that are held or linear: what it holds to better.

        Of inputs that change all the time the last, which no row has, is extrapolated. A motion
        that was read from a file needs the `robot`.
        """
        from fflin.linear.trajectory import along

        return along(self, robot or self._robot)

    @property
    def passed(self) -> tuple[Passed, ...]:
        """What went beyond its limit, the farthest first, with value, time and limit."""
        return passed(self.t, limited(self))

    @property
    def saturated(self) -> tuple[Saturated, ...]:
        """Inputs at their limit and wheels at their speed, the longest share of the run first."""
        names = {*self.input_names, *(f"qdot_m.{name}" for name in self.wheels)}
        return saturated(self.t, (each for each in limited(self) if each[0] in names))

    def save(self, path: str | Path) -> None:
        """Write it to a .npz, .mat, .json or .csv file, whole or not at all.

        A csv has the times, states and inputs alone, and cannot be loaded.

        Raises
        ------
        FileError
            If the ending is another or the file cannot be written.
        """
        target = as_path(path)
        check_ending(target, FORMATS)
        if target.suffix != ".csv":
            super().save(target)
            return
        record.require_finite({"t": self.t, "x": self.x, "u": self.u})
        names = ["t", *self.state_names, *(f"u.{name}" for name in self.input_names)]
        write_table(target, names, np.column_stack((self.t, self.x, self.u)))

    def plot(self, path: str | Path | None = None, **options: Any) -> Any:
        """Draw the motion, see `plot_motion`; into a file where a path is given."""
        return plot_motion(self, path, **options)


def require_motion(motion: Any) -> Motion:
    """Return the motion, or raise `InputError` where it is none."""
    found: Motion = instance("motion", motion, Motion, "a Motion, as fflin.simulate returns it")
    return found


def plot_motion(
    motion: Motion, path: str | Path | None = None, *, show: Sequence[str] | None = None
) -> Figure:
    """Draw the errors, inputs and momentum drift of a motion, linear beside nonlinear.

    Parameters
    ----------
    motion : Motion
        With a prediction, each group of states shows the nonlinear robot in full lines and the
        linear model dashed, and below it their difference. Along a trajectory it shows the robot
        over the pale reference, and below it the error, that of the linear model dashed; a dotted
        line is where the reference comes to rest.
    path : str or Path, optional
        .png, .pdf or .svg to save to.
    show : sequence of str, optional
        What is drawn of states and inputs: names, groups or patterns such as ``q_m``, ``thrust``,
        ``*.hinge_*``; all by default.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingPackageError
        If matplotlib is not installed.
    FileError
        If the ending is another or the file cannot be written.
    UnknownNameError
        If there is nothing of a name in `show`.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> figure = fflin.plot_motion(motion, "motion.png", show=["q_b", "*.joint_1"])
    """
    from fflin.simulation.motion_plot import draw_motion

    return draw_motion(require_motion(motion), path, show)
