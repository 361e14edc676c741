"""Motion: states and inputs of a simulation, and the drift of its conserved quantities."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base import html, record
from fflin.base.errors import FflinWarning, InputError
from fflin.base.figures import Figure
from fflin.base.record import Design
from fflin.base.tables import data_frame
from fflin.base.validation import Array, Open, Vector, instance
from fflin.base.writing import RECORDS, as_path, check_ending
from fflin.dynamics.coordinates import frame_of
from fflin.dynamics.impact import Impact
from fflin.dynamics.state import Actuation, StateMap
from fflin.dynamics.state_rows import attitude_errors, moving_errors, state_history
from fflin.linear.files import arguments, labels, write_table
from fflin.linear.model import StatesAndInputs
from fflin.linear.trajectory import Trajectory
from fflin.robot.orbit import Orbit, orbit_from_json
from fflin.robot.robot import Robot
from fflin.simulation.phases import in_coordinates_of, named_phase, require_start
from fflin.simulation.pointing import pointing
from fflin.simulation.report import (
    Passed,
    Saturated,
    curves,
    motion_parts,
    motion_report,
    passed,
    pulse_thrusters,
    saturated,
)

if TYPE_CHECKING:
    from pandas import DataFrame

FORMATS = (*RECORDS, ".csv")

# Frames per second of the page that notebooks show, chosen for a small file.
_FPS = 10.0


@dataclass(frozen=True, eq=False, repr=False)
class Motion(StatesAndInputs, Design):
    """Simulated or recorded motion of a robot, with one row per time.

    Attributes
    ----------
    t : ndarray (N,)
        Times [s].
    q : ndarray (N, nq)
    v : ndarray (N, nv)
        Configuration and velocity in Pinocchio's order.
    x : ndarray (N, nx)
        State in the chart defined by `reference` and `frame`. The rotation q_b is at most 180 deg:
        if the base rotates further, q_b jumps to the shorter rotation. The angles of continuous
        joints are not wrapped at a full turn.
    u : ndarray (N, nu)
        Inputs just after each time t, in the axes of `frame`. The last row repeats the inputs of
        the row before it, because no inputs are applied after the last time.
    target : ndarray (nx,) or (N, nx)
        Target state; or, if the robot follows a trajectory, the trajectory's state at each time.
        The array is empty if no target is known.
    prediction : ndarray (N, nx)
        States that the linear model predicts under the same control law. The array has no rows if
        there is no prediction, for example because the base rotates past 180 deg.
    energy : ndarray (N,)
        Kinetic energy, plus the potential energy of gravity and springs [J]. In orbit, `energy`
        is the Jacobi integral: kinetic energy relative to the orbital frame, plus the potentials
        of the gravity gradient, the frame's rotation and the springs.
    momentum : ndarray (N, 6)
        Angular momentum about the centre of mass [N m s], then linear momentum [N s], in world
        axes. In orbit, `momentum` is the momentum of the motion relative to the orbital frame.
    momentum_drift : ndarray (N,)
        Relative error of the simulated momentum. The expected momentum is the initial momentum
        plus the impulse of external forces. The difference from the expected momentum is divided
        by the largest momentum that the kinetic energy permits, see (11.6) of docs/derivation.md:

        - Linear momentum is divided by the mass times the root-mean-square speed of the mass
          elements in the row with the fastest motion.
        - Angular momentum is divided by this value times the radius of gyration about the initial
          base position, plus the momentum stored in wheels.

        In orbit, momentum is not conserved. Therefore the drift in orbit is the relative error of
        `energy`: the difference from the expected energy, divided by the largest terms of the
        energy. The expected energy is the initial energy plus the work of inputs and disturbances,
        and in an elliptic orbit plus the work of the changing field.
    com_drift : ndarray (N,)
        Distance [m] between the centre of mass and its expected position, which follows from the
        initial velocity and the impulse of external forces. The array is empty in orbit, or if the
        motion was read from a file without these data.
    state_names, input_names, state_units, input_units : tuple of str
    frame : {"hybrid", "local", "world", "lvlh", "hill"}
    robot, urdf_sha256 : str
    stopped : str
        Reason why the run ended early; empty if the run was completed.
    wheels : tuple of str
        Joints that are flown as reaction wheels at the target: each `ReactionWheel`, and rotors
        that spin there, see `LinearModel.wheels`. The reported errors do not include wheel angles.
    wheel_inertias : ndarray (k,)
        Inertias of the wheels about their axes [kg m^2]; empty if the motion was read from a file
        without these inertias.
    modes : tuple of str
        Joints that are modes of flexible appendages or slosh. The report lists them separately
        from the other joints.
    mode_rotations : ndarray (k,)
        Rotation [rad] of the structure per unit of each mode's amplitude; 0 if a mode causes no
        rotation. For a flexible appendage, the rotation is :math:`|w| + |v| / |c|`. Per unit of
        amplitude, the mode rotates the moving mass by w and displaces its centre of mass by v; c is
        the vector from the appendage's frame to this centre of mass. The second term is omitted if
        :math:`|c|` is below 5 % of the radius of gyration of the carrying body.
    steered : tuple of str
        States that the policy feeds back; empty if these states are not known.
    notes : tuple of str
        Remarks on the run that appear in the report.
    limit_names : tuple of str
        States and inputs that have limits.
    engine : str
        Engine that ran the simulation, "compiled" or "python"; empty if the engine is not known.
    step : float
        Time step [s] of the simulation; 0 if it is not known.
    limits : ndarray (k, 2)
        Lower and upper limits of the states and inputs in `limit_names`. A missing limit is
        infinite. Limits that the simulation does not enforce are included.
    constraint_names : tuple of str
        Names of the recorded forces [N] and torques [N m] of constraints, such as "grip.force.x"
        and "grip.torque.z" for a constraint named "grip"; see `ConstraintForce`.
    constraint_forces : ndarray (N, k)
        Forces and torques that each constraint exerts on its `frame`, just after each time t, in
        the axes of its placement. The last row repeats the row before it, as in `u`. Redundant
        constraints leave some of them open; then the smallest ones are recorded, and a note says
        so.
    phases, starts : tuple of str, ndarray (k,)
        Names and start times [s] of the phases, if `then` joined the motion from several phases.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> spin = fflin.velocity(robot, {"omega_b.z": 0.1})
    >>> motion = fflin.simulate(robot, v0=spin, duration=2.0)
    >>> motion.save("motion.npz")
    >>> fflin.Motion.load("motion.npz").x.shape == motion.x.shape
    True
    """

    _SHAPES = (
        "t:t q:tq v:tv x:tx u:tu momentum:tm state_names:x input_names:u "
        "wheels:w wheel_inertias:w modes:k mode_rotations:k phases:p starts:p "
        "constraint_names:c"
    )

    t: Vector
    q: Array
    v: Array
    x: Array
    u: Array
    target: Array
    prediction: Array
    energy: Vector
    momentum: Array
    momentum_drift: Vector
    placement: Vector
    frame: str
    robot: str
    urdf_sha256: str
    stopped: str
    com_drift: Vector = field(default_factory=lambda: np.zeros(0))
    # simulated robot; not saved in files
    _robot: Any = field(default=None, kw_only=True)
    # controller, and run of a campaign, as text; not saved
    _about: str = field(default="", kw_only=True)
    # whether the controller only detumbles; not saved
    _detumbling: bool = field(default=False, kw_only=True)
    # checksum of the nominal robot; not saved
    _nominal: str = field(default="", kw_only=True)
    wheels: tuple[str, ...] = field(default_factory=tuple)
    wheel_inertias: Vector = field(default_factory=lambda: np.zeros(0))
    steered: tuple[str, ...] = field(default_factory=tuple)
    notes: tuple[str, ...] = field(default_factory=tuple)
    limit_names: tuple[str, ...] = field(default_factory=tuple)
    limits: Open = field(default_factory=lambda: np.zeros((0, 2)))
    engine: str = field(default_factory=str)
    step: float = 0.0
    phases: tuple[str, ...] = field(default_factory=tuple)
    starts: Vector = field(default_factory=lambda: np.zeros(0))
    # motions and impacts; not saved
    _phases: tuple[Any, ...] = field(default=(), kw_only=True)
    circles: str = field(default_factory=str)  # the orbit, as text
    modes: tuple[str, ...] = field(default_factory=tuple)
    mode_rotations: Vector = field(default_factory=lambda: np.zeros(0))
    constraint_names: tuple[str, ...] = field(default_factory=tuple)
    constraint_forces: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        rows = (
            self.q,
            self.v,
            self.x,
            self.u,
            self.energy,
            self.momentum,
            self.momentum_drift,
        )
        if not self.constraint_names:  # .json files have no empty matrices
            object.__setattr__(self, "constraint_forces", np.zeros((0, 0)))
        may_lack = (self.prediction, self.com_drift, self.constraint_forces)
        count = len(self.t)
        if any(len(x) != count for x in rows) or any(
            len(x) not in (0, count) for x in may_lack
        ):
            raise InputError(
                f"a motion has {count} times; every history needs as many rows"
            )
        columns = self.constraint_forces.shape[-1]
        if columns != len(self.constraint_names):
            raise InputError(
                f"constraint_forces has {columns} columns, expected one for each of the "
                f"{len(self.constraint_names)} constraint_names"
            )
        of_target = self.target.shape[-1] if self.target.ndim else 1
        if self.target.size and of_target != self.x.shape[1] != self.target.size:
            raise InputError(
                f"the target has shape {self.target.shape}, expected a state or rows"
            )
        if self.target.size in (0, self.x.shape[1]):  # .mat files have no vectors
            object.__setattr__(self, "target", self.target.ravel())
        if not len(self.prediction):  # .json files have no empty matrices
            object.__setattr__(self, "prediction", np.zeros((0, self.x.shape[1])))
        object.__setattr__(
            self, "limits", self.limits.reshape(len(self.limit_names), 2)
        )
        super().__post_init__()

    def __repr__(self) -> str:
        stopped = f", stopped: {self.stopped}" if self.stopped else ""
        return (
            f"Motion('{self.robot}', {len(self.t)} rows, {self.t[0]:g} to {self.t[-1]:g} s, "
            f"{self.kept} drift {self.momentum_drift.max():.1e}, "
            f"com drift {self.com_drift.max(initial=0.0):.1e} m{stopped})"
        )

    def _report(self) -> str:
        return motion_report(self)

    def _html_parts(self) -> list[str]:
        return motion_parts(self, self._page())

    def _page(self) -> str:
        """Return the page of the motion in HTML, or an empty text if its robot is not known."""
        from tempfile import TemporaryDirectory

        from fflin import visualize

        if self._robot is None:
            return ""
        if html.is_shown_elsewhere(self):
            return html.paragraph(html.SHOWN_ABOVE, "note")
        with TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore", FflinWarning)  # about drawings
            path = Path(folder) / "motion.html"
            visualize(self._robot, self, html=path, open=False, fps=_FPS)
            page = path.read_text("utf-8")
        return html.frame(self.robot, 480, content=page)

    @property
    def reference(self) -> pin.SE3:
        """Placement relative to which the attitude and position of the base are measured."""
        return pin.XYZQUATToSE3(self.placement)

    @property
    def orbit(self) -> Orbit | None:
        """Orbit of the robot, or None.

        In orbit, the world is the orbital frame with the axes named by `frame`.
        """
        return orbit_from_json(self.circles) if self.circles else None

    @property
    def kept(self) -> str:
        """Name of the conserved quantity whose error is `momentum_drift`."""
        return "Jacobi integral" if self.circles else "momentum"

    @property
    def linear(self) -> Array | None:
        """States (N, nx) that the linear model predicts; None without a prediction."""
        return self.prediction if len(self.prediction) else None

    @property
    def error(self) -> Array | None:
        """Errors (N, nx) of the states from the target; None without a target.

        For a fixed target, the error is the difference of the states. For a moving target, the
        errors are in the axes of the target, as in `linearize_trajectory`.
        """
        if self.tracked:
            return moving_errors(self.frame, self.x, self.target)
        if not self.target.size:
            return None
        return self.x - self.target

    @property
    def tracked(self) -> bool:
        """Whether the target moves; `target` then contains one state per time."""
        return self.target.ndim == 2 and self.target.size > 0

    @property
    def attitude_error(self) -> Array | None:
        """Angle (N,) [deg] between the base attitude and its target; None without a target."""
        if not self.target.size:
            return None
        return attitude_errors(self.x, self.target)

    pointing = pointing

    def then(self, *later: Impact | Motion) -> Motion:
        """Join this motion and later phases into one motion.

        For example, ``approach.then(caught, held)`` joins an approach, the result ``caught`` of a
        capture, and the motion ``held`` after the capture.

        Parameters
        ----------
        *later : Impact or Motion
            Later phases in order. An impact, which `capture` or `jam` returns, happens at the last
            row of the phase before it. A motion, which `simulate` returns, starts where the phase
            before it ended, with the same mass properties. Only a capture adds a payload. A release
            needs no impact: simulate the robot without the payload or the constraint.

        Returns
        -------
        Motion
            Joined motion on one time axis, with the states and the chart of this motion. The states
            of a jammed joint remain, with zero velocity after the jam. The energy and momentum of
            each phase are computed for the robot of that phase, for example with its payload.

        Raises
        ------
        InputError
            If no phase is given, or the last phase is an impact. Also if a phase does not begin at
            the end of the phase before it, has other mass properties without an impact, has another
            frame or more inputs than this motion, or was read from a file.
        """
        if not later:
            raise InputError(
                "no later phase is given, expected Motion or Impact objects; give the motion "
                "after this one"
            )
        if isinstance(later[-1], Impact):
            raise InputError(
                "the last phase is an impact, expected a Motion; simulate the robot after the "
                "impact"
            )
        parts = (*(self._phases or (self,)), *later)
        if any(isinstance(part, Motion) and part._robot is None for part in parts):
            raise InputError(
                "a motion that was read from a file lacks its robot; join motions returned by "
                "simulate"
            )
        first = parts[0]
        whole: Motion = replace(
            first, phases=(first.robot,), starts=first.t[:1], _phases=parts
        )
        # robot, q and v at the end of the phases that are already joined
        robot = whole._robot
        q = whole.q[-1]
        v = whole.v[-1]
        event = ""  # impact directly before the next motion, which names its phase
        for part in parts[1:]:
            if isinstance(part, Impact):
                require_start(part.event, *part._before, (robot, q, v))
                robot = part.robot
                q = part.q
                v = part.v
                event = part.event
                note = f"{whole.t[-1]:g} s: {part.summary}"
                whole = replace(whole, notes=(*whole.notes, note))
            else:
                instance("a phase", part, Motion, "a Motion, or an Impact before one")
                name = event or named_phase(robot, part._robot)
                require_start(name, part._robot, part.q[0], part.v[0], (robot, q, v))
                robot = part._robot
                q = part.q[-1]
                v = part.v[-1]
                event = ""
                whole = _longer(whole, part, name)
        return whole

    def trajectory(self, robot: Robot | None = None) -> Trajectory:
        """Return the motion as a trajectory, which can be linearised or tracked.

        Between rows, the inputs are either held or interpolated linearly, depending on which of the
        two fits the dynamics better. If they are interpolated, the inputs at the last row are
        extrapolated, because they are not recorded. `robot` is required only if the motion was read
        from a file.
        """
        robot = self._robot if robot is None else robot
        return _as_trajectory(self, robot)

    @property
    def passed(self) -> tuple[Passed, ...]:
        """Limit violations with value, time and limit, sorted by relative size, largest first."""
        return passed(self.t, curves(self))

    @property
    def saturated(self) -> tuple[Saturated, ...]:
        """Inputs and wheel speeds that saturated, sorted by time in saturation, longest first."""
        return saturated(self.t, curves(self), pulse_thrusters(self))

    def save(self, path: str | Path) -> None:
        """Save the motion to a .npz, .mat, .json or .csv file, atomically.

        A .csv file is a table of times, states and inputs for other programs; `load` cannot read
        it. Its first line contains the names with units, such as ``omega_b.x [rad/s]`` and
        ``u.tau_b.x [N m]``.

        Raises
        ------
        FileError
            If the file has another ending or cannot be written.
        """
        target = as_path(path)
        check_ending(target, FORMATS)
        if target.suffix != ".csv":
            super().save(target)
            return
        record.require_finite({"t": self.t, "x": self.x, "u": self.u})
        write_table(target, *self._table())

    def _table(self) -> tuple[list[str], Array]:
        """Return the columns and the rows of times, states and inputs."""
        names = ["t", *self.state_names, *(f"u.{name}" for name in self.input_names)]
        columns = labels(names, ["s", *self.state_units, *self.input_units])
        return columns, np.column_stack((self.t, self.x, self.u))

    def to_pandas(self) -> DataFrame:
        """Return times, states and inputs as a pandas data frame, with the times as its index.

        The columns are the columns of the .csv file that `save` writes.

        Raises
        ------
        MissingPackageError
            If pandas is not installed.
        """
        return data_frame(*self._table(), index="t [s]")

    def plot(
        self, path: str | Path | None = None, *, show: Sequence[str] | None = None
    ) -> Figure:
        """Draw the motion by `plot_motion`, and save the figure if a path is given."""
        from fflin import plot_motion

        return plot_motion(self, path, show=show)


def _as_trajectory(motion: Motion, robot: Robot | None) -> Trajectory:
    """Convert a motion to a trajectory with constant or linear inputs between the knots.

    If the inputs of the motion vary, two trajectories are computed: one with constant inputs
    between the knots, and one with linear inputs. The result is the trajectory whose largest
    residual is smaller.
    """
    if motion.phases:
        raise InputError(
            "the motion has several phases, each with its own robot; convert each phase separately"
        )
    if robot is None:
        raise InputError(
            "the motion was read from a file, which does not contain its robot; give the robot, "
            "motion.trajectory(robot)"
        )
    instance("robot", robot, Robot, "a fflin.Robot; fflin.load makes one")
    entries = {
        name: getattr(motion, name) for name in ("t", "q", "v", "u", "placement")
    }
    values = arguments(entries, robot, "previous", motion.frame, motion.verified)
    held = Trajectory(robot, **values)
    if not (motion.u - motion.u[0]).any():
        return held
    before = motion.t[-4:-1] - motion.t[-1]
    u = values["u"]
    u[-1] = np.linalg.solve(np.vander(before).T, np.eye(len(before))[-1]) @ u[-4:-1]
    smooth = Trajectory(robot, **values | {"hold": "linear", "u": u})
    return min(held, smooth, key=lambda trajectory: float(trajectory.residual.max()))


def require_motion(motion: object) -> Motion:
    """Return the motion, or raise `InputError` if it is not a Motion."""
    return instance("motion", motion, Motion, "a Motion, as fflin.simulate returns it")


def _named_frame(motion: Motion) -> str:
    """Return the frame of a motion for messages."""
    text = f"'{motion.frame}'"
    if motion.circles:
        text += " in orbit"
    return text


def _forces_named(names: Sequence[str], motion: Motion) -> Array:
    """Return the forces of constraints (N, k) with given names; missing ones are zero."""
    forces = np.zeros((len(motion.t), len(names)))
    for column, name in zip(
        motion.constraint_forces.T, motion.constraint_names, strict=True
    ):
        forces[:, names.index(name)] = column
    return forces


def _longer(whole: Motion, motion: Motion, name: str) -> Motion:
    """Append the rows of `motion` to `whole`, converted to the chart, joints and inputs of `whole`.

    The appended phase gets the name `name`.
    """
    if (motion.frame, motion.circles) != (whole.frame, whole.circles):
        raise InputError(
            f"'{name}' is in the frame {_named_frame(motion)}, the first phase in "
            f"{_named_frame(whole)}; simulate both in one frame"
        )
    if more := [name for name in motion.input_names if name not in whole.input_names]:
        raise InputError(
            f"a phase has the input {more[0]}, which the first phase lacks; give the first robot "
            "that input"
        )
    frame = frame_of(whole._robot, whole.frame)
    state, other_state = (
        StateMap(m._robot, reference=m.reference, frame=frame) for m in (whole, motion)
    )
    last = whole.q[-1]
    near = whole.x[-1]
    t = motion.t - motion.t[0] + whole.t[-1]
    convert = partial(in_coordinates_of, state.robot, other_state.robot, last)
    q, v = convert(motion.q, motion.v)
    target = np.zeros(0)
    if whole.target.size and motion.target.size:
        _, target_q, target_v = other_state.points(np.atleast_2d(motion.target))
        goals = state_history(state, *convert(target_q, target_v), near)
        both = (whole.target, len(whole.t)), (goals, len(t))
        target = np.vstack([np.broadcast_to(x, (n, state.nx)) for x, n in both])
    u = np.zeros((len(t), len(whole.input_names)))  # missing inputs are zero
    u[:, [whole.input_names.index(name) for name in motion.input_names]] = motion.u
    for held in Actuation(state).held:  # inputs in reference axes
        u[:, held] = (
            u[:, held] @ other_state.reference.rotation.T @ state.reference.rotation
        )
    rows = {"t": t, "q": q, "v": v, "x": state_history(state, q, v, near, t), "u": u}
    names = tuple(dict.fromkeys((*whole.constraint_names, *motion.constraint_names)))
    forces = [_forces_named(names, part) for part in (whole, motion)]
    joined: dict[str, Any] = {
        "constraint_names": names,
        "constraint_forces": np.concatenate(forces),
    }
    for key in (*rows, "energy", "momentum", "momentum_drift", "com_drift"):
        added = rows.get(key, getattr(motion, key))
        joined[key] = np.concatenate((getattr(whole, key), added))
    about = whole._about
    if motion._about and motion._about != about:
        about = f"{about}, then {motion._about}".removeprefix(", then ")
    return replace(
        whole,
        **joined,
        _about=about,
        _detumbling=whole._detumbling and motion._detumbling,
        target=target,
        prediction=whole.prediction[:0],
        steered=tuple(x for x in whole.steered if x in motion.steered),
        stopped=motion.stopped,
        notes=tuple(dict.fromkeys((*whole.notes, *motion.notes))),
        verified=whole.verified and motion.verified,
        phases=(*whole.phases, name),
        starts=np.append(whole.starts, whole.t[-1]),
    )
