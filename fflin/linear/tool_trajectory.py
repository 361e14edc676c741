"""Linear models and gains along a trajectory, in the coordinates of Pinocchio or Crocoddyl."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from fflin.base.errors import InputError
from fflin.base.record import Design
from fflin.base.validation import Array, Vector
from fflin.dynamics.coordinates import refuse_constraints
from fflin.dynamics.state import StateMap
from fflin.linear.exchange import euler_step, step_of
from fflin.linear.tool_coordinates import ToolCoordinates, tool_coordinates
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from fflin.linear.linear_trajectory import LinearTrajectory
    from fflin.linear.trajectory import Trajectory

# Tools whose errors along a trajectory are a constant matrix times the errors of fflin, because
# both are in the axes of the moving base.
ALONG = ("pinocchio", "crocoddyl")


@dataclass(frozen=True, eq=False, repr=False)
class ToolTrajectory(Design):
    r"""Error dynamics along a trajectory in another tool's coordinates.

    The error x is the tool's difference of states, such as ``state.diff(xs[k], x)`` of Crocoddyl:
    a tangent vector of q in the order of v, then the difference of v.

    Attributes
    ----------
    tool, robot : str
        Names of the tool and the robot.
    t : ndarray (N,)
        Times of the knots [s].
    A, B : ndarray (N, nx, nx), (N, nx, nu)
        Matrices at the knots. A sampled trajectory has N - 1 of each, from one knot to the next.
    q, v, u : ndarray (N, nq), (N, nv), (N, nu)
        The trajectory in the tool's coordinates; inputs on the base are in base axes.
    T, T_left : ndarray (nx, 12 + 2n), (12 + 2n, nx)
        Matrix from the errors of the `LinearTrajectory` to x, and its left inverse.
    T_u : ndarray (nu, nu)
        Matrix from the inputs of the `LinearTrajectory` to the inputs of the tool.
    dt : float
        Sample time or time step [s]; 0 in continuous time.
    state_names, input_names : tuple of str

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> nodes = along.to("crocoddyl", dt=0.02)  # Fx and Fu of each node
    >>> nodes.A.shape, nodes.state_names[:3]
    ((11, 18, 18), ('p.x', 'p.y', 'p.z'))
    """

    tool: str
    robot: str
    t: Vector
    A: Array
    B: Array
    q: Array
    v: Array
    u: Array
    T: Array
    T_left: Array
    T_u: Array
    dt: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]


@dataclass(frozen=True, eq=False, repr=False)
class ToolSchedule(Design):
    """Feedback ``u = u* - K x`` along a trajectory in another tool's coordinates.

    Attributes
    ----------
    tool, robot : str
        Names of the tool and the robot.
    t : ndarray (M,)
        Times of the gains [s].
    K : ndarray (M, nu, nx)
        Gains for the error x, see `ToolTrajectory`.
    q, v, u : ndarray (M, nq), (M, nv), (M, nu)
        The trajectory at these times, in the tool's coordinates.
    dt : float
        Sample time [s]; 0 in continuous time.
    state_names, input_names : tuple of str

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> fflin.tvlqr(along, sample=0.1).to("crocoddyl", robot).K.shape
    (21, 9, 18)
    """

    tool: str
    robot: str
    t: Vector
    K: Array
    q: Array
    v: Array
    u: Array
    dt: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]


class _Change:
    """Constant matrices from the errors of a moving reference to the tool's coordinates."""

    def __init__(self, robot: Robot, tool: str) -> None:
        refuse_constraints(robot, f"trajectories in the coordinates of {tool}")
        self.kind = kind = tool_coordinates(robot, tool, moving=True)
        if tool not in ALONG:
            raise InputError(
                f"tool is '{tool}', expected {' or '.join(ALONG)}, whose errors along a trajectory "
                "are in base axes; convert a model at one knot with along[k].to(tool)"
            )
        coordinates = ToolCoordinates(StateMap(robot, frame="local"), moving=True)
        nu = np.zeros(6 + robot.n)
        point = robot.neutral(), nu, np.zeros(len(coordinates.actuation.names)), nu
        source, to = coordinates.jacobians(*point), kind.jacobians(*point)
        self.T, self.T_left = to.P @ source.left, source.P @ to.left
        self.T_u = np.linalg.solve(to.V, source.V)

    def names(self) -> dict[str, tuple[str, ...]]:
        """Return the names of states and inputs of the tool."""
        inputs = tuple(self.kind.actuation.names[i] for i in self.kind.inputs)
        return {"state_names": tuple(self.kind.states()), "input_names": inputs}


def tool_trajectory(
    traj: LinearTrajectory, tool: str, dt: float | None
) -> ToolTrajectory:
    """Convert the linear models along a trajectory to a tool; see `LinearTrajectory.to`."""
    change = _Change(traj.robot, tool)
    step = step_of(tool, dt)  # 0 for a continuous-time result
    if step and traj.dt:
        raise InputError(
            "the trajectory is sampled; leave out dt, or give the continuous one"
        )
    A = change.T @ traj.A @ change.T_left
    B = change.T @ traj.B @ np.linalg.inv(change.T_u)
    if step:
        rates = np.hstack((traj.v, traj.accelerations()))
        for k, rate in enumerate(rates):
            A[k], B[k], _ = euler_step(A[k], B[k], rate, step, tool)
    return ToolTrajectory(
        tool=tool,
        robot=traj.robot.name,
        t=traj.t,
        A=A,
        B=B,
        q=traj.q,
        v=traj.v,
        u=traj.u_base @ change.T_u.T,
        T=change.T,
        T_left=change.T_left,
        T_u=change.T_u,
        dt=step or traj.dt,
        verified=traj.verified,
        **change.names(),
    )


class Schedule(Protocol):
    """Gains along a trajectory, of which `GainSchedule` is the only class."""

    @property
    def t(self) -> Array:
        """Times [s] of the knots (N,)."""

    @property
    def K(self) -> Array:
        """Gains (N, nu, nx) at the knots."""

    @property
    def dt(self) -> float:
        """Sample time [s]; 0 if the gains are continuous."""

    @property
    def robot(self) -> str:
        """Name of the robot."""

    @property
    def verified(self) -> bool:
        """Whether the digest of a file was checked."""

    def trajectory(self, robot: Robot) -> Trajectory:
        """Return the trajectory of the gains."""
        ...


def tool_schedule(schedule: Schedule, tool: str, robot: Robot) -> ToolSchedule:
    """Convert the gains along a trajectory; see `GainSchedule.to`."""
    change, traj = _Change(robot, tool), schedule.trajectory(robot)
    times = schedule.t
    q, v, u = traj.points(times)
    if schedule.dt and traj.hold == "linear":
        # A sampled command holds the mean input of the sample.
        u = traj.points(np.minimum(times + 0.5 * schedule.dt, times[-1]))[2]
    return ToolSchedule(
        tool=tool,
        robot=schedule.robot,
        t=times,
        K=change.T_u @ schedule.K @ change.T_left,
        q=q,
        v=v,
        u=u @ change.T_u.T,
        dt=schedule.dt,
        verified=schedule.verified,
        **change.names(),
    )
