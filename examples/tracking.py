"""Plan a low-effort trajectory of an arm, and track it with time-varying gains."""

import fflin

robot = fflin.load("astrobee_arm")
goal = fflin.configuration(robot, {"arm_proximal": 0.6, "arm_distal": -0.8})
trajectory = fflin.plan(robot, (goal, None), 30.0, knots=31)
along = fflin.linearize_trajectory(robot, trajectory)
policy = fflin.TrajectoryFeedback(trajectory, fflin.tvlqr(along, sample=0.1))

v0 = fflin.velocity(robot, {"omega_b.x": 0.01})
motion = fflin.simulate(robot, policy, v0=v0, duration=30.0, dt=0.01)
print(f"final attitude error: {motion.attitude_error[-1]:.2g} deg")
figure = motion.plot(show=["q_b", "q_m", "tau_m"])
figure.savefig("tracking.png", dpi=62)
