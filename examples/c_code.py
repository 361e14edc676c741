"""C code of a regulator, and the nonlinear simulation with the compiled code in the loop."""

import numpy as np

import fflin

robot = fflin.load("servicer_7dof", lock=["panel_*"])
lin = fflin.linearize(robot).discretize(0.1)
gain = fflin.lqr(lin)
code = fflin.CLaw(fflin.write_c(gain, "flight", limits="urdf"))

v0 = fflin.velocity(robot, {"omega_b.z": 0.05, "joint_2": 0.1})
options = {"v0": v0, "duration": 30.0, "limits": "urdf"}
in_c = fflin.simulate(robot, code, **options)
in_python = fflin.simulate(robot, fflin.StateFeedback(lin, gain.K), **options)
assert np.abs(in_c.q - in_python.q).max() < 1e-12
figure = in_c.plot(show=["omega_b", "q_m", "tau_m"])
figure.savefig("c_code.png", dpi=62)
