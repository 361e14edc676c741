"""Model predictive control: a rotation of 60 degrees within limits of torques and joints."""

import numpy as np
import pinocchio as pin

import fflin

limits = ["urdf", {"tau_b": 60.0, "F_b": 20.0, "tau_m": 1.0}]
robot = fflin.load("servicer_7dof")
lin = fflin.linearize(robot)
Q = fflin.bryson(lin, {"q_b": 0.05, "r_b": 0.1, "q_m": 0.1})
R = fflin.bryson(lin, {"tau_b": 20.0, "F_b": 20.0, "tau_m": 5.0})
policy = fflin.mpc(lin, Q, R, horizon=20, sample=0.25, limits=limits)

base = pin.SE3(pin.rpy.rpyToMatrix(np.radians(60.0), 0.0, 0.0), np.zeros(3))
q0 = fflin.configuration(robot, base=base)
motion = fflin.simulate(robot, policy, q0=q0, duration=80.0, dt=0.05, limits=limits)
print(f"final attitude error: {motion.attitude_error[-1]:.2g} deg")
figure = motion.plot(show=["q_b", "tau_b", "tau_m"])
figure.savefig("mpc.png", dpi=62)
