"""Steady motion at the start or the end of a trajectory, and its regulator."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.analysis.reduction import momentum_reduction
from fflin.base.errors import EquilibriumError, StabilizabilityError
from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.control.gain import Gain
from fflin.control.lqr import regulator
from fflin.control.weights import sampled_cost
from fflin.dynamics.coordinates import LINEAR
from fflin.linear.equilibrium import equilibrium
from fflin.linear.linear_trajectory import LinearTrajectory
from fflin.linear.linearization import Linearizer
from fflin.linear.model import LinearModel
from fflin.linear.trajectory import Trajectory
from fflin.robot.joints import ROOT
from fflin.robot.orbit import is_elliptic
from fflin.robot.robot import Robot

# A robot falls freely if the net force of its inputs is at most this fraction of its weight.
_NO_FORCE = 1e-6


class SteadyEnd(NamedTuple):
    """Linear model about the steady motion at a knot of a trajectory.

    If the robot falls freely, the model is relative to axes that fall with the robot. The vector
    `fall` (3,) is the velocity [m/s] of these axes at the knot, in base axes. Otherwise it is zero.
    """

    model: LinearModel
    fall: Array

    @property
    def map(self) -> Array:
        """Map (nx, nx) from the errors of the trajectory to the errors of the model (5.4)."""
        names = self.model.state_names
        if not self.fall.any():
            return np.eye(len(names))
        attitude, speed = names.index("q_b.x"), names.index("v_b.x")
        T = np.eye(len(names))
        T[speed : speed + 3, attitude : attitude + 3] = -2.0 * skew(self.fall)
        return T

    @property
    def v(self) -> Array:
        """Velocity (nv,) of the steady motion, relative to the axes of the trajectory."""
        v = self.model.v.copy()
        v[:3] += self.fall
        return v

    def of_trajectory(self, robot: Robot) -> LinearModel:
        """Return the linear model of the errors of the trajectory of a robot.

        The errors of `model` are T times the errors of the trajectory, see `map`. So the returned
        model has the matrices A' = T^-1 A T and B' = T^-1 B. The outputs are linearised again,
        because the outputs of `model` are for the velocity relative to the falling axes.
        """
        lin, T = self.model, self.map
        if not self.fall.any():
            return lin
        inverse = 2.0 * np.eye(len(T)) - T  # because (T - I)^2 = 0
        outputs = Linearizer(robot, moving=True)(lin.q, self.v, lin.u0)
        return replace(
            lin,
            A=inverse @ lin.A @ T,
            B=inverse @ lin.B,
            C=outputs.C,
            D=outputs.D,
            y0=outputs.y0,
        )


def steady_end(traj: LinearTrajectory, end: int = -1) -> SteadyEnd:
    """Return the steady motion at knot `end`.

    The steady motion is the motion at the knot if it is steady. Otherwise it is the configuration
    of the knot at rest. If no inputs hold the robot there and it falls freely at the knot, it is at
    rest relative to axes that fall with its centre of mass.
    """
    lin = traj[end]
    if lin.is_equilibrium():
        return SteadyEnd(lin, np.zeros(3))
    return rest_or_fall(traj, end)


def rest_or_fall(traj: LinearTrajectory, end: int = -1) -> SteadyEnd:
    """Return the robot at rest at knot `end`; in free fall, at rest relative to falling axes."""
    try:
        resting = resting_end(traj, end, traj.independent)
        return SteadyEnd(resting, np.zeros(3))
    except EquilibriumError as error:
        if not traj.robot.constraints and _falls(traj, end):
            return _falling_end(traj, end)
        where, given = "start", "P0"
        if end:
            where, given = "end", "Q, R and Qf"
        raise EquilibriumError(
            f"no inputs hold the robot at the {where} of the trajectory: {error}; give {given}"
        ) from None


def resting_end(
    traj: Trajectory, end: int = -1, independent: Sequence[str] | None = None
) -> LinearModel:
    """Return the model at rest at knot `end`, in base axes. Only wheels keep their speeds.

    `independent` names the coordinates of a robot with constraints.
    """
    return _at_rest(traj.robot, traj.q[end], traj.v[end], independent)


def _at_rest(
    robot: Robot, q: Array, v: Array, independent: Sequence[str] | None = None
) -> LinearModel:
    """Return the model at rest, in base axes. Only wheels keep their speeds in v (nv,)."""
    if robot.orbit and is_elliptic(robot.orbit):
        raise EquilibriumError("in an elliptic orbit, these inputs would vary")
    still, wheels = np.zeros(robot.nv), robot.wheels_at(v)
    spinning = [joint.idx_v for joint in robot.joints if joint.name in wheels]
    still[spinning] = v[spinning]
    held = equilibrium(robot, q, v=still, tilt=False)
    linearizer = Linearizer(robot, moving=True, independent=independent)
    return linearizer(held.q, still, held.u)


def _falls(traj: LinearTrajectory, end: int) -> bool:
    """Return whether the robot falls freely at a knot: its inputs exert no net force there."""
    robot = traj.robot
    weight = float(traj[end].M[3, 3] * np.linalg.norm(robot.gravity))
    columns = traj.actuation.columns(robot.create_data(), traj.q[end])
    force = np.linalg.norm(columns[LINEAR] @ traj.u_base[end])
    return bool(force <= _NO_FORCE * weight and weight > 0.0)


def _falling_end(traj: LinearTrajectory, end: int) -> SteadyEnd:
    """Return the robot at rest at a knot, relative to axes that fall with it (5.4)."""
    # Relative to axes that fall with the acceleration g, a robot moves as without gravity.
    robot = traj.robot.replace(gravity=(0.0, 0.0, 0.0))
    q = traj.q[end]
    v = traj.v[end]
    data = robot.create_data()
    pin.centerOfMass(robot.model, data, q, v)
    fall = data.oMi[ROOT].rotation.T @ data.vcom[0]
    return SteadyEnd(_at_rest(robot, q, v), fall)


def steady_regulator(
    end: SteadyEnd, Q: Array, R: Array, sample: float | None
) -> tuple[Array, Array]:
    """Return the cost matrix P (nx, nx) and the gain K (nu, nx) about a steady motion.

    P and K refer to the errors of the trajectory. The weights refer to the errors of the model of
    the steady motion. If the inputs cannot stabilise the model, its `momentum_reduction` is
    regulated.
    """

    def about(lin: LinearModel, Q: Array) -> Gain:
        if not sample:
            return regulator(lin, Q, R)
        return regulator(lin.discretize(sample), *sampled_cost(lin, sample, Q, R))

    lin, to_model = end.model, end.map
    try:
        gain = about(lin, Q)
        P, K = gain.P, gain.K
    except StabilizabilityError:
        part = momentum_reduction(lin)
        gain = about(part, part.T.T @ Q @ part.T)
        P, K = part.S.T @ gain.P @ part.S, gain.K @ part.S
    return to_model.T @ P @ to_model, K @ to_model
