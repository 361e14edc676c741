"""Basilisk in closed loop: a hub with three reaction wheels under its flight software.

Navigation, attitude error, `mrpFeedback` and `rwMotorTorque` run once a step, after RK4 of the
spacecraft; the torques are held until the next. The feedback is of modified Rodrigues parameters.
"""

import numpy as np
from Basilisk.architecture import bskLogging, messaging
from Basilisk.fswAlgorithms import (
    attTrackingError,
    inertial3D,
    mrpFeedback,
    rwMotorTorque,
)
from Basilisk.simulation import reactionWheelStateEffector, simpleNav, spacecraft
from Basilisk.utilities import SimulationBaseClass, macros, simIncludeRW

from benchmarks.closed_loop import WHEEL, Loop, welded
from benchmarks.contender import Contender
from benchmarks.robots import Array

REFUSALS = (ValueError,)
TASK, CRAFT = "task", "craft"


def contenders(loop: Loop) -> list[Contender]:
    here = BasiliskLoop(mrp_law(loop))
    return [Contender("Basilisk, held", here.loop, here.run, here.end)]


def mrp_law(loop: Loop) -> Loop:
    """Return the loop under Basilisk's law, which is the same to first order."""
    if not loop.wheels:
        raise ValueError("its attitude loop supports one body with wheels only")
    K = loop.K.copy()
    K[:, :3] *= 2.0  # a parameter is half of q_b
    return loop.but(K=K, held=True, mrp=True)


class BasiliskLoop:
    """A simulation with its spacecraft and wheels, from the loop's start to its end."""

    def __init__(self, loop: Loop) -> None:
        # of states made anew at each start
        bskLogging.setDefaultLogLevel(bskLogging.BSK_ERROR)
        self.loop, self.craft = loop, spacecraft.Spacecraft()
        self.simulation = SimulationBaseClass.SimBaseClass()
        process = self.simulation.CreateNewProcess("process")
        process.addTask(self.simulation.CreateNewTask(TASK, macros.sec2nano(loop.dt)))
        self.rotors = simIncludeRW.rwFactory()
        for axis in np.eye(3).tolist():
            self.rotors.create(
                *("custom", axis),
                **{"Js": WHEEL, "Omega_max": 1e6, "RWModel": messaging.BalancedWheels},
                **{"useMaxTorque": False, "useRWfriction": False},
            )
        self.cluster = reactionWheelStateEffector.ReactionWheelStateEffector()
        self.craft.ModelTag, self.cluster.ModelTag = CRAFT, "wheels"
        self.rotors.addToSpacecraft(CRAFT, self.cluster, self.craft)
        self._set_hub()
        # The highest goes first, then what has none in this order: wheels take the last command.
        self.simulation.AddModelToTask(TASK, self.cluster, 2)
        self.simulation.AddModelToTask(TASK, self.craft, 1)
        self._kept = self._software()

    def _set_hub(self) -> None:
        inertia, hub, x0 = welded(self.loop), self.craft.hub, self.loop.x0
        hub.mHub, hub.IHubPntBc_B = inertia.mass, inertia.inertia.tolist()
        hub.r_BcB_B = inertia.lever[:, None].tolist()
        parameters = x0[:3] / (1.0 + np.sqrt(1.0 - x0[:3] @ x0[:3]))
        rates = x0[6 + self.loop.robot.n :][:3]
        hub.sigma_BNInit, hub.omega_BN_BInit = (
            parameters[:, None].tolist(),
            rates[:, None].tolist(),
        )

    def _software(self) -> list[object]:
        """Add the flight software, and return what must outlive it."""
        navigation, target = simpleNav.SimpleNav(), inertial3D.inertial3D()
        error, feedback = attTrackingError.attTrackingError(), mrpFeedback.mrpFeedback()
        torques = rwMotorTorque.rwMotorTorque()
        for module in (navigation, target, error, feedback, torques):
            self.simulation.AddModelToTask(TASK, module)
        target.sigma_R0N = [0.0, 0.0, 0.0]
        feedback.K, feedback.P = (
            -self.loop.K[0, 0],
            -self.loop.K[0, 6 + self.loop.robot.n],
        )
        feedback.Ki = -1.0  # none
        torques.controlAxes_B = np.eye(3).ravel().tolist()
        vehicle = messaging.VehicleConfigMsgPayload()
        vehicle.ISCPntB_B = np.ravel(self.craft.hub.IHubPntBc_B).tolist()
        rotors, vehicle = (
            self.rotors.getConfigMessage(),
            messaging.VehicleConfigMsg().write(vehicle),
        )
        navigation.scStateInMsg.subscribeTo(self.craft.scStateOutMsg)
        error.attNavInMsg.subscribeTo(navigation.attOutMsg)
        error.attRefInMsg.subscribeTo(target.attRefOutMsg)
        feedback.guidInMsg.subscribeTo(error.attGuidOutMsg)
        feedback.vehConfigInMsg.subscribeTo(vehicle)
        feedback.rwParamsInMsg.subscribeTo(rotors)
        feedback.rwSpeedsInMsg.subscribeTo(self.cluster.rwSpeedOutMsg)
        torques.vehControlInMsg.subscribeTo(feedback.cmdTorqueOutMsg)
        torques.rwParamsInMsg.subscribeTo(rotors)
        self.cluster.rwMotorCmdInMsg.subscribeTo(torques.rwMotorTorqueOutMsg)
        return [navigation, target, error, feedback, torques, rotors, vehicle]

    def run(self) -> None:
        for rotor in self.rotors.rwList.values():
            rotor.Omega = rotor.theta = 0.0
        self.simulation.InitializeSimulation()
        self.simulation.ConfigureStopTime(macros.sec2nano(self.loop.duration))
        self.simulation.ExecuteSimulation()

    def end(self) -> Array:
        """Return the last state (nx,)."""
        message, n = self.craft.scStateOutMsg.read(), 6 + self.loop.robot.n
        parameters, x = np.array(message.sigma_BN), np.zeros(2 * n)
        x[:3] = 2.0 * parameters / (1.0 + parameters @ parameters)
        x[3:6], x[n + 3 : n + 6] = message.r_BN_N, message.v_BN_N
        x[n : n + 3], x[n + 6 :] = message.omega_BN_B, self._speeds()
        return x

    def _speeds(self) -> Array:
        return np.array(self.cluster.rwSpeedOutMsg.read().wheelSpeeds[:3])
