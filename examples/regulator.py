"""LQR regulator: a satellite with an arm returns from a rotation of 30 degrees."""

import numpy as np
import pinocchio as pin

import fflin

robot = fflin.load("servicer_7dof")
lin = fflin.linearize(robot)
assert fflin.check(robot, lin).ok
gain = fflin.lqr(lin)

base = pin.SE3(pin.rpy.rpyToMatrix(np.radians(30.0), 0.0, 0.0), np.zeros(3))
q0 = fflin.configuration(robot, {"joint_2": 0.3}, base)
policy = fflin.StateFeedback(lin, gain.K)
motion = fflin.simulate(robot, policy, q0=q0, duration=120.0, linear=lin)
print(f"final attitude error: {motion.attitude_error[-1]:.2g} deg")
figure = motion.plot(show=["q_b", "q_m", "tau_b"])
figure.savefig("regulator.png", dpi=62)
