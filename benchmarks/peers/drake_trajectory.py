"""Drake along a trajectory: linear models at the knots, its regulator, and the closed loop."""

import numpy as np
import pinocchio as pin
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.controllers import (
    FiniteHorizonLinearQuadraticRegulator,
    FiniteHorizonLinearQuadraticRegulatorOptions,
    MakeFiniteHorizonLinearQuadraticRegulator,
)
from pydrake.systems.framework import DiagramBuilder, OutputPortSelection
from pydrake.systems.primitives import FirstOrderTaylorApproximation
from pydrake.trajectories import PiecewisePolynomial

import fflin
from benchmarks.peers.drake_peer import DrakePoint
from benchmarks.robots import Array, Point


class DrakeTrajectory:
    """A trajectory without inputs on the base, and a cost without base velocities.

    So the errors of quaternions, of places and rates in world axes have the cost of fflin's.

    Parameters
    ----------
    traj : fflin.Trajectory
    q, r : ndarray (nx,), (nu,)
        Diagonals of Q, which is Qf too, and R in fflin's order.
    """

    def __init__(self, traj: fflin.Trajectory, q: Array, r: Array) -> None:
        zero = np.zeros(6 + traj.robot.n)
        self.here = here = DrakePoint(
            Point(traj.robot, zero[6:], zero, zero), rest=True
        )
        self.traj, self.plant, self.context = traj, here.plant, here.context
        self.states = np.array(
            [self.state(*row) for row in zip(traj.q, traj.v, strict=True)]
        )
        self.states[:, here.turns[6:]] = np.unwrap(
            self.states[:, here.turns[6:]], axis=0
        )
        self.inputs = traj.u_base[:, np.argsort(here.order)]
        n = len(here.order)
        self.Q, self.R = np.zeros(here.nq + here.nv), np.diag(r[np.argsort(here.order)])
        self.Q[here.turns], self.Q[here.turns[0] - 1] = q[:n], q[0]
        self.Q[here.nq + here.order] = q[n:]
        self.Q = np.diag(self.Q)
        rates = [
            self._at(*row).CopyToVector()
            for row in zip(self.states, self.inputs, strict=True)
        ]
        self.reference = PiecewisePolynomial.CubicHermite(
            traj.t, self.states.T, np.array(rates).T
        )
        self.feedforward = PiecewisePolynomial.FirstOrderHold(traj.t, self.inputs.T)

    def _at(self, x: Array, u: Array):
        self.plant.SetPositionsAndVelocities(self.context, x)
        self.here.port.FixValue(self.context, u)
        return self.plant.EvalTimeDerivatives(self.context)

    def state(self, q: Array, v: Array) -> Array:
        """Return Drake's state of a configuration and velocity in Pinocchio's order."""
        robot, here = self.traj.robot, self.here
        x = np.zeros(here.nq + here.nv)
        x[here.turns[0] - 1], x[here.turns[:3]], x[here.turns[3:6]] = (
            q[6],
            q[3:6],
            q[:3],
        )
        x[here.turns[6:]] = fflin.StateMap(robot).joint_positions(q[None])[0]
        R = pin.XYZQUATToSE3(q[:7]).rotation
        joints = [v[joint.idx_v] for joint in robot.joints]
        x[here.nq + here.order] = np.concatenate((R @ v[3:6], R @ v[:3], joints))
        return x

    def linearize(self) -> list[object]:
        """Return the linear models at all knots."""
        found = []
        for x, u in zip(self.states, self.inputs, strict=True):
            self.plant.SetPositionsAndVelocities(self.context, x)
            self.here.port.FixValue(self.context, u)
            port = self.here.port.get_index()
            none = OutputPortSelection.kNoOutput
            found.append(
                FirstOrderTaylorApproximation(self.plant, self.context, port, none)
            )
        return found

    def regulator(self, accuracy: float, *, system: bool = False):
        """Return the result of the regulator's design, or what closes the loop."""
        options = FiniteHorizonLinearQuadraticRegulatorOptions()
        options.Qf, options.x0, options.u0 = self.Q, self.reference, self.feedforward
        options.input_port_index = self.here.port.get_index()
        config = options.simulator_config
        config.accuracy = accuracy
        options.simulator_config = config
        make = (
            MakeFiniteHorizonLinearQuadraticRegulator
            if system
            else FiniteHorizonLinearQuadraticRegulator
        )
        t = self.traj.t
        return make(self.plant, self.context, t[0], t[-1], self.Q, self.R, options)

    def gains(self, result: object) -> Array:
        """Return a design's K (N, nu, nx) at the knots, on fflin's errors."""
        here, found = self.here, []
        for t, q, v in zip(self.traj.t, self.traj.q, self.traj.v, strict=True):
            R, (x, y, z, w) = pin.XYZQUATToSE3(q[:7]).rotation, q[3:7]
            n, nq = len(here.order), here.nq
            T = np.zeros((nq + here.nv, 2 * n))  # what fflin's error is in Drake's
            T[here.turns[0] - 1, :3] = -x, -y, -z
            T[here.turns[:3], :3] = ((w, -z, y), (z, w, -x), (-y, x, w))
            T[np.ix_(here.turns[3:6], range(3, 6))] = R
            T[here.turns[6:], np.arange(6, n)] = 1.0
            for part, rate in ((slice(0, 3), v[3:6]), (slice(3, 6), v[:3])):
                rows = nq + here.order[part]
                T[rows, :3] = -2.0 * R @ pin.skew(rate)
                T[rows, n + part.start : n + part.stop] = R
            T[nq + here.order[6:], np.arange(n + 6, 2 * n)] = 1.0
            K = (result.K.value(t) @ T)[here.order]
            K[:3], K[3:6] = R.T @ K[:3], R.T @ K[3:6]
            found.append(K)
        return np.array(found)

    def loop(self, regulator: object, start: Array) -> "DrakeLoop":
        return DrakeLoop(self, regulator, start)


class DrakeLoop:
    """The plant under a regulator from a state on; `run` returns the last one."""

    def __init__(self, along: DrakeTrajectory, regulator: object, start: Array) -> None:
        builder = DiagramBuilder()
        plant = builder.AddSystem(along.plant.Clone())
        policy = builder.AddSystem(regulator)
        port = plant.get_applied_generalized_force_input_port()
        builder.Connect(policy.get_output_port(0), port)
        builder.Connect(plant.get_state_output_port(), policy.get_input_port(0))
        self.diagram, self.plant, self.start = builder.Build(), plant, start
        self.end = float(along.traj.t[-1])
        self.simulator = Simulator(self.diagram)
        self.accuracy = SimulatorConfig().accuracy

    def run(self, accuracy: float | None = None) -> Array:
        config = SimulatorConfig()
        config.accuracy = accuracy or config.accuracy
        if accuracy:
            config.max_step_size = 0.01
        ApplySimulatorConfig(config, self.simulator)
        context = self.simulator.get_mutable_context()
        context.SetTime(0.0)
        own = self.plant.GetMyMutableContextFromRoot(context)
        self.plant.SetPositionsAndVelocities(own, self.start)
        self.simulator.Initialize()
        self.simulator.AdvanceTo(self.end)
        return self.plant.GetPositionsAndVelocities(own).copy()
