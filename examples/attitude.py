"""Attitude control: wheels slew a satellite and hold it against a torque that they do not know."""

import fflin

inputs = fflin.load_inputs("cubesat")
wheels = [item for item in inputs if isinstance(item, fflin.ReactionWheel)]
outputs = [fflin.BasePose(), fflin.Gyroscope("base")]
robot = fflin.load("cubesat", inputs=wheels, outputs=outputs)
pushed = robot.replace(disturbance={"tau_b": [2e-7, 0.0, -1e-7]})  # N m

model = fflin.linearize(robot).discretize(0.25, delay=0.25)
noise = {
    "q_b": {"noise_equivalent_angle": 10.0},  # arc seconds
    "gyroscope": {"angle_random_walk": 0.05},  # deg/sqrt(h)
    "r_b": 1e-8,
}
drift = {"tau_b": 1e-16}
estimator = fflin.kalman(model, {"omega_b": 1e-11}, noise, disturbance_noise=drift)
law = fflin.OutputFeedback(model, fflin.lqg(fflin.lqr(model), estimator))
print(fflin.margins(law, model))

goal = fflin.configuration(robot, rpy=(0, 0, 60))
slew = fflin.plan(robot, (goal, None), 60.0, knots=31, free=["r_b", "v_b"])
motion = fflin.simulate(pushed, law.follow(slew), duration=120.0, dt=0.05)
print(motion.pointing(window=10.0, after=60.0))
figure = motion.plot(show=["q_b", "wheel"])
figure.savefig("attitude.png", dpi=62)
