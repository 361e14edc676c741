"""Trajectory tracking: feedback along a trajectory, and its reference."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, ClassVar, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base.errors import EquilibriumError, InputError
from fflin.base.names import by_name
from fflin.base.validation import Array
from fflin.control.gain_schedule import GainSchedule
from fflin.control.linear_controller import LinearController
from fflin.control.policies import Allocation, Policy, decider, fed_back
from fflin.control.tvlqr import resting_end, steady_regulator
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.state import Frame, StateMap
from fflin.dynamics.state_rows import moved_by, moving_error
from fflin.linear.fit import require_same, require_turns
from fflin.linear.linear_trajectory import LinearTrajectory, along
from fflin.linear.model import LinearModel
from fflin.linear.trajectory import Trajectory
from fflin.robot.robot import Robot

# A clock of many steps is rounded.
AT_THE_END = 1.0 + 1e-9

# Returns q, v and u in the policy's axes at a time of the run.
Reference: TypeAlias = Callable[[float], tuple[Array, Array, Array]]


@dataclass(frozen=True, eq=False)
class TrajectoryFeedback:
    """Trajectory tracking ``u = u*(t) - K(t) e`` with the error e relative to a trajectory.

    The error is defined as in `linearize_trajectory`. Torques and forces on the base are in base
    axes, and t is the time since the first knot. After the end, the target is the last
    configuration at rest. The command is then the sum of the inputs that hold the robot there and
    the feedback of the regulator with the same weights.

    Parameters
    ----------
    trajectory : Trajectory
    schedule : GainSchedule
        Result of `tvlqr`.
    held : bool
        Whether commands are held between samples; commands of a sampled schedule are always held.
        With held commands, the command at the last knot already contains the inputs that hold the
        robot there.

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
        if not (
            isinstance(self.trajectory, Trajectory) and isinstance(self.schedule, GainSchedule)
        ):
            raise InputError(
                f"TrajectoryFeedback got a {type(self.trajectory).__name__} and a "
                f"{type(self.schedule).__name__}, expected a LinearTrajectory and a GainSchedule, "
                "as fflin.linearize_trajectory and fflin.tvlqr return them"
            )

    @property
    def duration(self) -> float:
        """Time [s] from the first knot to the last."""
        return float(self.trajectory.t[-1] - self.trajectory.t[0])

    @cached_property
    def models(self) -> LinearTrajectory:
        """The linear models along the trajectory."""
        motion = self.trajectory
        return motion if isinstance(motion, LinearTrajectory) else along(motion)

    @cached_property
    def end(self) -> LinearModel:
        """Model at rest in the last configuration; `InputError` if no inputs hold it there."""
        try:
            return resting_end(self.trajectory)
        except EquilibriumError as error:
            raise InputError(
                f"no inputs hold the robot after the end of the trajectory at {self.duration:g} s: "
                f"{error}; give a duration within the trajectory"
            ) from None

    def reference(self, t: float) -> tuple[Array, Array, Array]:
        """Return the reference q, v, and u in base axes at time t of the run."""
        return self._point(t, self.duration * AT_THE_END)

    def _point(self, t: float, over: float) -> tuple[Array, Array, Array]:
        if t > over:
            return self.end.q, self.end.v, self.end.u0
        first, last = self.trajectory.t[[0, -1]].tolist()
        return self.trajectory.flow.at(min(first + max(t, 0.0), last))

    @property
    def over(self) -> float:
        """Time [s] after which the command holds the robot at the end."""
        held = self.held or self.schedule.dt
        return self.duration * (2.0 - AT_THE_END if held else AT_THE_END)

    @property
    def jumps(self) -> bool:
        """Whether the command jumps at knots, because inputs are held between them."""
        return self.trajectory.hold == "previous" and not self.schedule.dt

    @property
    def ahead(self) -> float:
        """Time [s] into a sample at which a changing input is closest to the sample mean."""
        return 0.5 * self.schedule.dt if self.trajectory.hold == "linear" else 0.0

    def commanded(self, t: float) -> tuple[Array, Array, Array]:
        """Return q, v, u of the trajectory point to which the command at run time t refers."""
        q, v, u = self._point(t, self.over)
        if self.ahead and t <= self.over:
            u = self._point(min(t + self.ahead, self.duration), self.duration)[2]
        return q, v, u

    @cached_property
    def end_gain(self) -> Array:
        """Gain K (nu, nx) of the regulator with the same weights about `end`."""
        by = self.schedule
        return steady_regulator(self.end, by.Q, by.R, by.dt)[1]

    def beside(self, offset: Mapping[str, float]) -> tuple[Array, Array]:
        """Return q (nq,) and v (nv,) at an offset from the start of the trajectory.

        Parameters
        ----------
        offset : mapping
            {name, group or pattern of states: error, in the base axes at the start}. The angles
            roll, pitch, yaw [deg] may be given instead of q_b.

        Raises
        ------
        InputError
            If the attitude is given twice, or ``|q_b|`` is not less than 1.
        UnknownNameError
            If a state does not exist.
        """
        robot, (q, v, _) = self.trajectory.robot, self.reference(0.0)
        # A chart about where it begins, which may be turned by any angle itself.
        chart = StateMap(robot, reference=pin.XYZQUATToSE3(q[:7]), frame=self.frame)
        values = by_name("state", offset, (*chart.names, "roll", "pitch", "yaw"))
        e, angles = np.zeros(chart.nx), np.zeros(3)
        for index, value in values.items():
            if index < chart.nx:
                e[index] = value
            else:
                angles[index - chart.nx] = value
        if angles.any():
            if e[:3].any():
                raise InputError(
                    "the offset has both q_b and an angle roll, pitch or yaw; give only one of them"
                )
            turn = pin.Quaternion(pin.rpy.rpyToMatrix(*np.radians(angles))).coeffs()
            e[:3] = turn[:3] if turn[3] >= 0.0 else -turn[:3]
        if not np.linalg.norm(e[:3]) < 1.0:
            raise InputError(
                f"|q_b| of the offset is {np.linalg.norm(e[:3]):.3g}, expected less than 1"
            )
        return chart.to_pinocchio(moved_by(self.frame, chart.to_state(q, v)[None], e[None])[0])

    def gain(self, t: float) -> Array:
        """Return the gain K (nu, nx) at time t of the run."""
        knots = self.schedule.t
        if t > self.over:
            return self.end_gain
        return self.schedule.gain(float(knots[0]) + min(max(t, 0.0), float(knots[-1] - knots[0])))

    def law(self) -> Callable[[float, Array], Array]:
        """Return law(t, e) -> u: the inputs for an error e at time t of the run."""
        return lambda t, e: self.commanded(t)[2] - self.gain(t) @ e

    def bind(self, robot: Robot) -> Policy:
        """Return policy(t, q, v) -> u for a robot.

        Raises
        ------
        InputError
            If the robot's states or inputs differ from the trajectory's. Its masses may differ.
        """
        origin = self.trajectory.robot
        state, own = StateMap(robot, frame="local"), StateMap(origin, frame="local")
        made = f"the trajectory is a motion of '{origin.name}'"
        for kind, pair in (("input", map(Actuation, (own, state))), ("state", (own, state))):
            require_same(made, robot, kind, *((each.names, each.units) for each in pair))
        require_turns(made, origin.nq, robot)

        def policy(t: float, q: Array, v: Array) -> Array:
            q_star, v_star, u_star = self.commanded(t)
            return u_star - self.gain(t).dot(moving_error(state, q_star, v_star, q, v))

        return policy


def followed(policy: Any, robot: Robot, held: float = 0.0) -> Any:
    """Return a policy, for a schedule the feedback along its trajectory; held so long, if it is."""
    if isinstance(policy, Allocation):
        return replace(policy, policy=followed(policy.policy, policy.design, held))
    if isinstance(policy, GainSchedule):
        return TrajectoryFeedback(policy.trajectory(robot), policy, held=held > 0.0)
    if held and isinstance(policy, TrajectoryFeedback):
        return replace(policy, held=True)
    if held and isinstance(policy, LinearController):
        return policy.sampled(held)
    return policy


def reference_of(policy: Any) -> Reference | None:
    """Return the reference of a policy that follows a motion, else None."""
    found = getattr(decider(policy), "reference", None)
    return found if callable(found) else None


def tracking_of(policy: Any) -> TrajectoryFeedback | None:
    """Return the feedback along a trajectory that a policy is or allocates."""
    decides = decider(policy)
    return decides if isinstance(decides, TrajectoryFeedback) else None


def steered_by(policy: Any) -> tuple[str, ...]:
    """Return the names of the states that a policy feeds back, as far as that is known."""
    if (follows := tracking_of(policy)) is None:
        return fed_back(policy)
    used, names = np.abs(follows.schedule.K).max(axis=(0, 1)), follows.schedule.state_names
    return tuple(name for name, size in zip(names, used, strict=True) if size)


@lru_cache(maxsize=2)  # half of a short run's time
def largest_rate(schedule: GainSchedule) -> float:
    """Return the magnitude [1/s] that the loop's poles pass for a twentieth of the time alone."""
    # A large weight at the end makes K large for a moment, which is over before it does harm; the
    # inputs of samples do not follow at all, 0.
    if schedule.dt:
        return 0.0
    rates = np.abs(np.linalg.eigvals(schedule.A - schedule.B @ schedule.K)).max(axis=1)
    held, rates = np.diff(schedule.t), np.maximum(rates[1:], rates[:-1])
    order = rates.argsort()
    passed = np.searchsorted(held[order].cumsum(), 0.95 * held.sum())
    return float(rates[order][min(int(passed), len(rates) - 1)])
