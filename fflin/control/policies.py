"""What decides on the inputs: feedback of the state about a point or along a trajectory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from fflin.base.errors import InputError
from fflin.base.validation import Array, as_double
from fflin.control.channel import Law
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import moving_error, readout
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from fflin.control.gain_schedule import GainSchedule
    from fflin.linear.linear_trajectory import LinearTrajectory

Policy: TypeAlias = Callable[[float, Array, Array], ArrayLike]


@runtime_checkable
class Bindable(Protocol):
    """A policy that must know the robot before it decides."""

    def bind(self, robot: Robot) -> Policy:
        """Return the policy for that robot."""
        ...


@dataclass(frozen=True, eq=False)
class StateFeedback:
    """The feedback ``u = u0 - K (x - x0)`` of a linear model's state.

    The angle of a continuous joint is taken on the turn nearest to x0.

    Parameters
    ----------
    lin : LinearModel
        The model that K was made for; of a reduced one the states that it has are fed back.
    K : array_like (nu, nx)

    Raises
    ------
    InputError
        If K has another shape or the model is one about a moving reference.
    """

    lin: LinearModel
    K: Array

    def __post_init__(self) -> None:
        if not isinstance(self.lin, LinearModel):
            raise InputError(f"lin is a {type(self.lin).__name__}, expected a fflin.LinearModel")
        if self.lin.moving:
            raise InputError(
                "the model is about a moving reference; follow it with TrajectoryFeedback"
            )
        K, shape = as_double("K", self.K), self.lin.B.shape[::-1]
        if K.shape != shape:
            raise InputError(
                f"K has shape {K.shape}, expected {shape} (nu, nx); take the gain that was "
                "designed for this model"
            )
        if not np.isfinite(K).all():
            raise InputError("K has entries that are NaN or infinite, expected finite numbers")
        K.setflags(write=False)
        object.__setattr__(self, "K", K)

    def bind(self, robot: Robot) -> Policy:
        """Return policy(t, q, v) -> u for a robot.

        Raises
        ------
        InputError
            If the model is not one of this robot.
        """
        lin = self.lin
        state = StateMap(robot, reference=lin.reference, frame=lin.frame)
        require_same_robot(lin, robot, state)
        fed = np.array([state.names.index(name) for name in lin.state_names])
        near = np.zeros(state.nx)
        near[fed] = lin.x0
        K = np.zeros((len(self.K), state.nx))
        K[:, fed] = self.K
        command = readout(state, K, lin.u0 + self.K @ lin.x0, near)

        def policy(_: float, q: Array, v: Array) -> Array:
            return command(q, v)

        return policy


@dataclass(frozen=True, eq=False)
class TrajectoryFeedback:
    """The feedback ``u = u*(t) - K(t) e`` of the error from a trajectory.

    The error is that of `linearize_trajectory`; K is held at its last value after the end, and
    the trajectory's last point then is the target.

    Parameters
    ----------
    trajectory : LinearTrajectory
    schedule : GainSchedule
        As `tvlqr` returns it.
    """

    trajectory: LinearTrajectory
    schedule: GainSchedule

    def __post_init__(self) -> None:
        if not hasattr(self.trajectory, "point") or not callable(
            getattr(self.schedule, "gain", None)
        ):
            raise InputError(
                "TrajectoryFeedback takes a LinearTrajectory and a GainSchedule, as "
                "fflin.linearize_trajectory and fflin.tvlqr return them"
            )

    def bind(self, robot: Robot) -> Policy:
        """Return policy(t, q, v) -> u for a robot.

        Raises
        ------
        InputError
            If the trajectory is not one of this robot.
        """
        along = self.trajectory
        if along.robot.joint_names != robot.joint_names or along.robot.inputs != robot.inputs:
            raise InputError(
                f"the trajectory is one of '{along.robot.name}' with its inputs, not of "
                f"'{robot.name}' as it is given; simulate the robot that was linearised"
            )
        state = StateMap(robot, frame="local")
        end = float(along.t[-1])

        def policy(t: float, q: Array, v: Array) -> Array:
            t = min(max(t, float(along.t[0])), end)
            q_star, v_star, u_star = along.point(t)
            u: Array = u_star - self.schedule.gain(t).dot(moving_error(state, q_star, v_star, q, v))
            return u

        return policy


@dataclass(frozen=True, eq=False)
class Allocation:
    """Thrusts, none of them negative, that come nearest to what a policy asks for.

    The policy decides on the inputs of the robot `design`, such as torque and force on the base;
    the thrusters and motors of the simulated robot give the generalised force that it means, in
    the least squares of the accelerations that the two would cause.

    Parameters
    ----------
    policy : policy or StateFeedback
    design : Robot
        The same robot with the inputs that the policy decides on.
    """

    policy: Any
    design: Robot

    @property
    def lin(self) -> LinearModel | None:
        """The model that the policy was made for, where it has one; its inputs are the design's."""
        return getattr(self.policy, "lin", None)

    def bind(self, robot: Robot) -> Policy:
        """Return policy(t, q, v) -> u for a robot.

        Raises
        ------
        InputError
            If the two robots have not the same joints.
        """
        from scipy.optimize import lsq_linear

        if not isinstance(self.design, Robot):
            raise InputError(f"design is a {type(self.design).__name__}, expected a fflin.Robot")
        if self.design.joint_names != robot.joint_names:
            raise InputError(
                f"the design's joints are not those of '{robot.name}'; allocate for the same robot"
            )
        lin = self.lin
        asked, given = (
            StateMap(each, reference=lin.reference, frame=lin.frame) if lin else StateMap(each)
            for each in (self.design, robot)
        )
        asking, giving = Actuation(asked), Actuation(given)
        free = np.full(len(asking.names), np.inf)
        inner = Law(bound(self.policy, self.design), asking.names, (-free, free), np.inf)
        data = robot.create_data()
        least = np.full(len(giving.names), -np.inf)
        least[giving.groups.get("thrust", [])] = 0.0

        def policy(t: float, q: Array, v: Array) -> Array:
            u = inner(t, q, v)
            force = asking.columns(data, q) @ asking.in_base_axes(asked.chart(q), u)
            columns = giving.columns(data, q)
            for held in giving.held:
                columns = columns.copy()
                columns[:, held.columns] = columns[:, held.columns] @ given.chart(q).R.T
            M = given.project(pin.crba(robot.model, data, q).T)
            factor = np.linalg.cholesky(M)
            A, b = np.linalg.solve(factor, columns), np.linalg.solve(factor, force)
            size = float(np.linalg.norm(b))
            if size == 0.0:
                return np.zeros(len(least))
            # Scaled to 1, as the solver stops at absolute figures. The added rows choose the
            # least of the thrusts that do the same; their effect is below rounding.
            unit = float(np.linalg.norm(A))
            found = lsq_linear(
                np.vstack((A / unit, 1e-7 * np.eye(len(least)))),
                np.concatenate((b / size, np.zeros(len(least)))),
                (least, np.full_like(least, np.inf)),
                method="bvls",
                tol=1e-14,
            )
            thrusts: Array = np.maximum(found.x, least) * (size / unit)
            return thrusts

        return policy


def bound(policy: Any, robot: Robot) -> Policy:
    """Return a policy for a robot, or raise `InputError` where it is none."""
    result = policy.bind(robot) if isinstance(policy, Bindable) else policy
    if not callable(result):
        raise InputError(
            f"policy is a {type(policy).__name__}, expected policy(t, q, v) -> u, such as "
            "StateFeedback(lin, gain.K)"
        )
    return result


def require_same_robot(lin: LinearModel, robot: Robot, state: StateMap) -> None:
    """Raise `InputError` where a model is not one of a robot with its inputs."""
    names = Actuation(state).names
    if (
        lin.urdf_sha256 != robot.urdf_sha256
        or lin.input_names != names
        or not set(lin.state_names) <= set(state.names)
    ):
        raise InputError(
            f"the model is one of '{lin.robot}' with {len(lin.input_names)} inputs, not of "
            f"'{robot.name}' as it is given with {len(names)}; linearise this robot"
        )
