"""Draw docs/mpc.png, a slew under a saturated LQR and under MPC: ``python docs/scripts/slew.py``.

The base returns from 90 deg with a strong torque, while the joint torques are weak.
"""

from pathlib import Path

import numpy as np
import pinocchio as pin
from matplotlib import pyplot

import fflin

LIMITS = ["urdf", {"tau_b": 60.0, "F_b": 20.0, "tau_m": 1.0}]
SHOWN = ("joint_3", "joint_6", "panel_left", "panel_right")


def main() -> None:
    """Simulate both and draw attitude errors, joint positions with limits, and joint torques."""
    robot = fflin.load("servicer_7dof")
    lin = fflin.linearize(robot)
    Q = fflin.bryson(lin, {"q_b": 0.05, "r_b": 0.1, "q_m": 0.1})
    R = fflin.bryson(lin, {"tau_b": 20.0, "F_b": 20.0, "tau_m": 5.0})
    policy = fflin.mpc(lin, Q, R, horizon=20, dt=0.25, limits=LIMITS)
    base = pin.SE3(pin.AngleAxis(np.pi / 2.0, np.array([1.0, 0.0, 0.0])).matrix(), np.zeros(3))
    q0, (figure, axes) = fflin.configuration(robot, base=base), pyplot.subplots(3, 2, sharex=True)
    figure.set_size_inches(9.0, 6.5)
    cases = {"LQR, saturated": fflin.StateFeedback(policy.lin, policy.gain.K), "MPC": policy}
    for column, (title, each) in zip(axes.T, cases.items(), strict=True):
        motion = fflin.simulate(robot, each, q0=q0, duration=80.0, dt=0.05, limits=LIMITS)
        attitude, joints, torques = column
        attitude.set_title(title)
        attitude.plot(motion.t, motion.attitude_error)
        for k, name in enumerate(SHOWN):
            color = f"C{k}"
            q = motion.x[:, motion.state_names.index(f"q_m.{name}")]
            joints.plot(motion.t, q, color=color, label=name)
            torque = motion.u[:, motion.input_names.index(f"tau_m.{name}")]
            torques.plot(motion.t, torque, color=color, linewidth=0.8)
        for limit in motion.limits[motion.limit_names.index("q_m.panel_left")]:
            joints.axhline(limit, color="0.4", linestyle="--", linewidth=0.8)
        torques.set_xlabel("t [s]")
    for row, label in zip(axes, ("attitude error [deg]", "q_m [rad]", "tau_m [N m]"), strict=True):
        row[0].set_ylabel(label)
        low, high = np.array([each.get_ylim() for each in row]).T
        for each in row:
            each.set_ylim(low.min(), high.max())
    axes[1, 1].legend(loc="lower right", fontsize=8, title="dashed: joint limits of the panels")
    figure.tight_layout()
    figure.savefig(Path(__file__).parents[1] / "mpc.png", dpi=110)


if __name__ == "__main__":
    main()
