"""Gravity gradient: a satellite librates about an equilibrium attitude in orbit."""

import numpy as np
import pinocchio as pin

import fflin

orbit = fflin.CircularOrbit(altitude=500e3)
robot = fflin.load("servicer_7dof", lock=["joint_*", "panel_*"], orbit=orbit)
equilibria = fflin.relative_equilibria(robot)
print(equilibria)

away = np.array([0, 0, 0, *np.radians([0.0, 20.0, 10.0])])
q0 = pin.integrate(robot.model, equilibria[0].q, away)
motion = fflin.simulate(robot, q0=q0, duration=2.0 * orbit.period, dt=5.0)
figure = motion.plot(show=["q_b", "r_b"])
figure.savefig("orbit.png", dpi=62)
