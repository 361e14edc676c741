"""Trajectory tracking: feedback of the state or of the outputs along a trajectory."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import ClassVar

import numpy as np
import pinocchio as pin

from fflin.base.errors import EquilibriumError, InputError
from fflin.base.names import by_name
from fflin.base.validation import Array, instance
from fflin.control.kalman import stationary_kalman
from fflin.control.loops import Loop, Sample, Step
from fflin.control.policies import (
    Allocation,
    Deviation,
    Feedback,
    OutputSensing,
)
from fflin.control.policy import (
    Command,
    Noise,
    OutputForm,
    PathForm,
    Policy,
    Reference,
    as_policy,
    states_of_gain,
)
from fflin.control.trajectory_end import SteadyEnd, resting_end, steady_regulator
from fflin.control.tvlqr import FilterSchedule, GainSchedule
from fflin.dynamics.coordinates import Frame
from fflin.dynamics.outputs import Measuring
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import moved_by, moving_error
from fflin.linear.fit import require_configuration_size, require_same, signals_of
from fflin.linear.model import LinearModel
from fflin.linear.trajectory import Trajectory
from fflin.robot.fields import warn_of_degrees
from fflin.robot.robot import Robot

# A time counts as the end if it is at most this factor times the end time, because sums of time
# steps are rounded.
AT_THE_END = 1.0 + 1e-9


@dataclass(eq=False)
class TrajectoryFeedback(Feedback):
    """Trajectory tracking ``u = u*(t) - K(t) e`` with the error e relative to a trajectory.

    The error is defined as in `linearize_trajectory`. Torques and forces on the base are in base
    axes, and t is the time since the first knot. After the end of the trajectory, the target is
    the last configuration at rest. The command is then the sum of the holding inputs at this
    target and the feedback of a regulator with the same weights. A periodic trajectory has no end:
    trajectory and gains repeat.

    Parameters
    ----------
    trajectory : Trajectory
    schedule : GainSchedule
        Result of `tvlqr`.
    held : bool
        Whether commands are held between samples; commands of a sampled schedule are always held.
        The command of the last knot, if held, acts after the end of the trajectory, so it already
        contains the holding inputs.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> policy = fflin.TrajectoryFeedback(motion.trajectory(), fflin.tvlqr(along))
    >>> bool(fflin.simulate(robot, policy, duration=1.0).attitude_error.max() < 1e-3)
    True
    """

    trajectory: Trajectory
    schedule: GainSchedule
    held: bool = field(default=False, kw_only=True)

    frame: ClassVar[Frame] = "local"

    def __post_init__(self) -> None:
        instance("trajectory", self.trajectory, Trajectory, "a fflin.Trajectory")
        expected = "a GainSchedule, as fflin.tvlqr returns it"
        instance("schedule", self.schedule, GainSchedule, expected)

    @property
    def model(self) -> LinearModel | None:
        """None, because the law acts about no point."""
        return None

    @property
    def sample_time(self) -> float:
        """Sample time [s] of the schedule; 0 if it is continuous."""
        return self.schedule.dt

    @property
    def axes(self) -> tuple[Frame | None, pin.SE3 | None]:
        """Base axes; the reference is free."""
        return self.frame, None

    @property
    def reference_motion(self) -> Reference | None:
        """The trajectory and its end as a function of time."""
        return self.reference

    @property
    def followed_trajectory(self) -> Trajectory | None:
        """The trajectory."""
        return self.trajectory

    @property
    def fed_back(self) -> tuple[str, ...]:
        """States with a gain at any time."""
        schedule = self.schedule
        names = list[str]()
        for part, group in enumerate(schedule.partition.names):
            names += states_of_gain(group, schedule.K[schedule.parts == part])
        return tuple(dict.fromkeys(names))

    def initial_inputs_for(self, names: tuple[str, ...]) -> Array | None:
        """Return the inputs of the trajectory at its start."""
        return self.reference(0.0)[2]

    def reference_inputs(self, names: tuple[str, ...]) -> tuple[str, Array] | None:
        """Return the inputs at all knots."""
        return "on its trajectory", self.trajectory.u_base

    def held_for(self, seconds: float) -> Policy:
        """Return the law with held commands."""
        return replace(self, held=True)

    def poles_along(self) -> Array:
        """Return the poles [1/s] of the robot and of the loop; empty for a sampled schedule."""
        return poles_along(self.schedule)

    def form(self, robot: Robot) -> PathForm | OutputForm | None:
        """Return the trajectory and the gains; None for a robot with constraints.

        Only Python supports trajectories of robots with constraints.
        """
        if robot.constraints:
            return None
        return PathForm(self)

    @property
    def duration(self) -> float:
        """Time [s] from the first knot to the last."""
        return float(self.trajectory.t[-1] - self.trajectory.t[0])

    @cached_property
    def end(self) -> LinearModel:
        """Model at rest in the last configuration; `InputError` if no inputs hold the robot."""
        try:
            return resting_end(self.trajectory, independent=self._independent)
        except EquilibriumError as error:
            raise InputError(
                f"no inputs hold the robot after the end of the trajectory at {self.duration:g} s: "
                f"{error}; give a duration within the trajectory"
            ) from None

    @property
    def _independent(self) -> tuple[str, ...] | None:
        """Last independent coordinates of a robot with constraints; None without constraints."""
        if not self.trajectory.robot.constraints:
            return None
        names = self.schedule.partition.names[-1]
        return names[: len(names) // 2]

    def reference(self, t: float) -> tuple[Array, Array, Array]:
        """Return the reference q, v, and u in base axes at time t of the run."""
        if self.trajectory.period:
            return self.trajectory.point(float(self.trajectory.t[0]) + t)
        if t > self.duration * AT_THE_END:
            return self.end.q, self.end.v, self.end.u0
        first, last = self.trajectory.t[[0, -1]].tolist()
        return self.trajectory.point(min(first + max(t, 0.0), last))

    @property
    def over(self) -> float:
        """Time [s] after which the command holds the robot at the end of the trajectory.

        It is infinite for a periodic trajectory.
        """
        if self.trajectory.period:
            return np.inf
        if self.held or self.schedule.dt:
            return self.duration * (2.0 - AT_THE_END)
        return self.duration * AT_THE_END

    @property
    def jumps(self) -> bool:
        """Whether the command jumps at knots, because inputs are held between knots."""
        return self.trajectory.hold == "previous" and not self.schedule.dt

    @property
    def ahead(self) -> float:
        """Time [s] after a sample at which the reference input equals its mean over the sample."""
        if self.trajectory.hold != "previous":
            return 0.5 * self.schedule.dt
        return 0.0

    def commanded(self, t: float) -> tuple[Array, Array, Array]:
        """Return q, v, u of the trajectory point to which the command at run time t refers."""
        if t > self.over:
            return self.reference(np.inf)
        q, v, u = self.reference(t)
        if self.ahead:
            middle = t + self.ahead
            if not self.trajectory.period:
                middle = min(middle, self.duration)
            u = self.reference(middle)[2]
        return q, v, u

    @cached_property
    def end_gain(self) -> Array:
        """Gain K (nu, nx) of the regulator about `end`, with the weights of the schedule."""
        schedule = self.schedule
        Q = schedule.Q if schedule.Q.ndim == 2 else schedule.Q[-1]
        end = SteadyEnd(self.end, np.zeros(3))
        return steady_regulator(end, Q, schedule.R, schedule.dt)[1]

    def beside(self, offset: Mapping[str, float]) -> tuple[Array, Array]:
        """Return q (nq,) and v (nv,) displaced from the initial state of the trajectory.

        Parameters
        ----------
        offset : mapping
            Mapping {name, group or pattern of states: initial error}, in the base axes at the
            start. The keys ``roll``, ``pitch`` and ``yaw`` [deg] can replace q_b.

        Raises
        ------
        InputError
            If the attitude is given both by q_b and by angles, or ``|q_b|`` is not less than 1.
        UnknownNameError
            If a state does not exist.
        """
        robot, (q, v, _) = self.trajectory.robot, self.reference(0.0)
        # The reference of the chart is the initial base pose, because the initial attitude may be
        # any rotation and a chart covers less than 180 deg.
        chart = StateMap(robot, reference=pin.XYZQUATToSE3(q[:7]), frame=self.frame)
        values = by_name("state", offset, (*chart.names, "roll", "pitch", "yaw"))
        given = np.zeros(chart.nx + 3)
        given[list(values)] = list(values.values())
        e, angles = given[:-3], given[-3:]
        warn_of_degrees(robot, dict(zip(chart.names, e.tolist(), strict=True)))
        if (e[:3].any() and angles.any()) or not np.linalg.norm(e[:3]) < 1.0:
            raise InputError(
                f"the offset has |q_b| = {np.linalg.norm(e[:3]):.3g} and roll, pitch, yaw = "
                f"{angles} deg, expected only one of them, and |q_b| less than 1"
            )
        if angles.any():
            turn = pin.Quaternion(pin.rpy.rpyToMatrix(*np.radians(angles))).coeffs()
            if turn[3] < 0.0:
                turn = -turn
            e[:3] = turn[:3]
        return chart.to_pinocchio(
            moved_by(self.frame, chart.to_state(q, v)[None], e[None])[0]
        )

    def gain(self, t: float) -> Array:
        """Return the gain K (nu, nx) at time t of the run."""
        if t > self.over:
            return self.end_gain
        return self.schedule.gain(self._on_schedule(t))

    def part(self, t: float) -> int:
        """Return the index of the part of the trajectory at time t of the run."""
        if t > self.over:
            return len(self.schedule.switches)
        return self.schedule.part(self._on_schedule(t))

    def _on_schedule(self, t: float) -> float:
        """Return the time of the schedule at time t of the run."""
        knots = self.schedule.t
        if self.schedule.period:
            return float(knots[0]) + t
        return float(knots[0]) + min(max(t, 0.0), float(knots[-1] - knots[0]))

    def state_map(self, robot: Robot) -> StateMap:
        """Return the robot's states in base axes; `InputError` if the robot does not fit."""
        origin = self.trajectory.robot
        state = StateMap(robot, frame="local")
        design_state = StateMap(origin, frame="local")
        made = f"the trajectory was made for '{origin.name}'"
        for kind in ("input", "state"):
            require_same(made, state, kind, *signals_of(design_state, kind))
        require_configuration_size(made, origin.nq, robot)
        return state

    def deviation(self, robot: Robot) -> Deviation:
        """Return f(t, q, v) -> u*, e: the inputs of the trajectory and the error relative to it."""
        state = self.state_map(robot)
        groups = [
            [state.names.index(name) for name in names]
            for names in self.schedule.partition.names
        ]
        reduced = len(groups[0]) < state.nx

        def deviation(t: float, q: Array, v: Array) -> tuple[Array, Array]:
            q_star, v_star, u_star = self.commanded(t)
            e = moving_error(state, q_star, v_star, q, v)
            return u_star, e[groups[self.part(t)]] if reduced else e

        return deviation

    def bind(self, robot: Robot) -> Command:
        """Return policy(t, q, v) -> u for a robot.

        Raises
        ------
        InputError
            If the robot has other states or inputs than the trajectory. Masses may differ.
        """
        deviation = self.deviation(robot)

        def policy(t: float, q: Array, v: Array) -> Array:
            u, e = deviation(t, q, v)
            command: Array = u - self.gain(t).dot(e)
            return command

        return policy


def prepared(policy: object, robot: Robot) -> Policy:
    """Return a policy for a robot; a gain schedule becomes the feedback along its trajectory."""
    if isinstance(policy, Allocation):
        return replace(policy, policy=prepared(policy.policy, policy.design))
    if isinstance(policy, GainSchedule):
        return TrajectoryFeedback(policy.trajectory(robot), policy)
    return as_policy(policy)


@lru_cache(maxsize=2)  # saves half the time of a short run
def poles_along(schedule: GainSchedule) -> Array:
    """Return the poles [1/s] of the robot and of the closed loop at all times of a schedule.

    Return an empty array for a sampled schedule.
    """
    if schedule.dt:
        return np.zeros(0)
    systems = (schedule.A, schedule.A - schedule.B @ schedule.K)
    return np.concatenate([np.linalg.eigvals(A).ravel() for A in systems])


@dataclass(eq=False)
class TrajectoryOutputFeedback(OutputSensing, TrajectoryFeedback):
    r"""Feedback ``u = u*(t) - K(t) eh`` of the estimated error relative to a trajectory.

    At each sample, u is applied and y is measured. The filter then advances the estimate eh to the
    next sample, as in `OutputFeedback`. Measured positions and attitudes are relative to the base
    pose of the trajectory. The policy returned by `bind` has an attribute ``estimate`` (nx,), the
    estimate of the error at the next sample.

    Parameters
    ----------
    trajectory : LinearTrajectory
    schedule : GainSchedule
        Result of `tvlqr` with a sample time.
    filter : FilterSchedule
        Result of `tvkalman` with the same sample time.
    noise : callable, optional
        Function noise(t) that returns measurement noise (ny,), which is added to y.

    Raises
    ------
    InputError
        If the gains and the filter have different sample times or trajectories.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> filtered = fflin.tvkalman(along, 1e-3, 1e-4, sample=0.1)
    >>> policy = fflin.TrajectoryOutputFeedback(along, fflin.tvlqr(along, sample=0.1), filtered)
    >>> fflin.simulate(robot, policy, duration=1.0).u.shape[1]
    9
    """

    filter: FilterSchedule
    noise: Noise | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        expected = "a FilterSchedule, as fflin.tvkalman returns it"
        seen = instance("filter", self.filter, FilterSchedule, expected)
        gains = self.schedule
        if not (gains.dt and gains.dt == seen.dt and np.array_equal(gains.A, seen.A)):
            raise InputError(
                f"the gains are sampled at dt = {gains.dt:g} s, the filter at {seen.dt:g} s, "
                "expected the same sample= and the same trajectory for both"
            )

    def bind(self, robot: Robot) -> Loop:
        """Return policy(t, q, v) -> u for a robot; each returned policy has its own estimate.

        Raises
        ------
        InputError
            If the robot has other states, inputs or outputs than the trajectory.
        """
        design = self.trajectory.robot
        state = self.state_map(robot)
        origin = f"the trajectory was made for '{design.name}'"
        design_outputs = signals_of(StateMap(design, frame="local"), "output")
        require_same(origin, state, "output", *design_outputs)

        def terms_at(t: float) -> tuple[Step, Measuring, Array]:
            # Positions and attitudes are measured relative to the base pose of the trajectory.
            state.move_to(float(self.trajectory.t[0]) + t)
            q, v, _ = self.reference(t)
            base_pose = state.origin * pin.XYZQUATToSE3(q[:7])
            relative = state.about(base_pose)
            return self.terms(t).step, Measuring(relative, q), relative.read(q, v)

        sizes = self.filter.L.shape[1:]
        return Loop(state, self.filter.dt, sizes, terms_at, self.noise)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.filter.output_names

    def form(self, robot: Robot) -> OutputForm:
        """Return the matrices for each sample of the trajectory, and for the robot at rest.

        If the trajectory repeats, the matrices repeat, too.
        """
        if self.trajectory.period:
            samples = len(self.filter.A)
            return OutputForm(self.bind(robot), self.terms, samples, samples)
        return OutputForm(self.bind(robot), self.terms, len(self.filter.A) + 2)

    @cached_property
    def _rest(self) -> tuple[LinearModel, Array]:
        """Model of the robot at rest after the trajectory, and gain of the steady-state filter."""
        lin = self.end.discretize(self.filter.dt)
        seen = self.filter
        return lin, stationary_kalman(lin, seen.W[-1], seen.V).L

    def terms(self, t: float) -> Sample:
        """Return the matrices and offsets of the sample at time t."""
        gains, seen = self.schedule, self.filter
        k, jump = round(t / seen.dt), np.zeros(len(seen.state_names))
        if self.trajectory.period:
            k %= len(seen.A)
        if k < len(seen.A):
            A, B, K, L, C, D = (
                x[k] for x in (seen.A, seen.B, gains.K, seen.L, seen.C, seen.D)
            )
            u, y = self.commanded(t)[2], seen.y[k]
        else:
            (lin, L), K = self._rest, self.end_gain
            A, B, C, D, u, y = lin.A, lin.B, lin.C, lin.D, lin.u0, lin.y0
            if k == len(seen.A):
                # At this sample, the reference changes from the trajectory to the robot at rest, so
                # the velocity error jumps.
                stop = self.reference(self.duration)[1] - lin.v
                state = StateMap(self.trajectory.robot)
                half = len(jump) // 2
                picked = [state.names.index(name) for name in seen.state_names[:half]]
                jump[half:] = state.velocities(stop)[picked]
        return Sample(A - B @ K - L @ (C - D @ K), L, -K, 0.0 * D.T, u, y, jump)
