"""Kalman filter and regulator (LQG): only gyroscope, pose and joints are measured, with noise."""

import numpy as np

import fflin

robot = fflin.load("servicer_7dof", lock=["panel_*"])
outputs = [fflin.Gyroscope("base"), fflin.BasePose(), fflin.JointPositions()]
robot = robot.replace(outputs=[*outputs, fflin.JointVelocities()])
lin = fflin.linearize(robot).discretize(0.1)
estimator = fflin.kalman(lin, 1e-6, 1e-4)
compensator = fflin.lqg(fflin.lqr(lin), estimator)

random = np.random.default_rng(0)
noise = random.normal(scale=1e-3, size=(601, len(lin.output_names)))
policy = fflin.OutputFeedback(lin, compensator, lambda t: noise[round(t / 0.1)])
v0 = fflin.velocity(robot, {"omega_b.z": 0.05, "joint_2": 0.1})
motion = fflin.simulate(robot, policy, v0=v0, duration=60.0)
figure = motion.plot(show=["q_b", "q_m"])
figure.savefig("kalman.png", dpi=62)
