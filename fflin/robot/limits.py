"""What the URDF says that a robot's joints can do."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fflin.robot.robot import Robot

# Pinocchio marks what the URDF does not limit by the largest double or by infinity.
_NONE = 1e300


def joint_limits(robot: Robot) -> dict[str, float]:
    """Return {name of an input or state: limit}, of those that the URDF limits.

    Of ``tau_m`` the largest effort [N m | N], of ``qdot_m`` the largest speed [rad/s | m/s], of
    ``q_m`` the whole travel [rad | m]. A limit of zero, which exporters write for none, is none.
    """
    model = robot.model
    found = {}
    for joint in robot.joints:
        found[f"tau_m.{joint.name}"] = float(model.effortLimit[joint.idx_v])
        found[f"qdot_m.{joint.name}"] = float(model.velocityLimit[joint.idx_v])
        if not joint.unbounded:
            low, high = model.lowerPositionLimit, model.upperPositionLimit
            found[f"q_m.{joint.name}"] = float(high[joint.idx_q]) - float(low[joint.idx_q])
    return {name: value for name, value in found.items() if 0.0 < value < _NONE}
