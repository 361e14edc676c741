"""Flexible solar arrays: a slew of the satellite excites their modes, and the modes decay."""

import numpy as np
import pinocchio as pin

import fflin

robot = fflin.load("inspector_flexible", lock=["arm_*"])
lin = fflin.linearize(robot)
print(fflin.modes(lin))

policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
base = pin.SE3(pin.rpy.rpyToMatrix(np.radians(5.0), 0.0, 0.0), np.zeros(3))
q0 = fflin.configuration(robot, base=base)
motion = fflin.simulate(robot, policy, q0=q0, duration=60.0)
figure = motion.plot(show=["q_b", "q_m"])
figure.savefig("flexible.png", dpi=62)
