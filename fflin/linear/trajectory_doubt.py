"""When the knots of a trajectory are no motion of the robot, and what may have been meant."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from fflin.base.rotation import rotation_matrices

# A residual from which on the knots are in doubt as a motion of the robot, and how many of the
# intervals that miss most are tried with what else may have been meant.
_IN_DOUBT, _TRIED = 1e-2, 5

# Between two knots the base goes the shorter way, of less than half a turn [rad].
_FARTHEST_TURN = 2.5


def doubt(traj: Any) -> str:
    """Say when the knots are no motion of the robot, and what would mend it."""
    found = traj.flow.residual
    worst = int(found.argmax())
    rates = np.linalg.norm(traj.v[:, 3:6], axis=1)
    turns = np.diff(traj.t) * np.maximum(rates[1:], rates[:-1])
    if found[worst] <= _IN_DOUBT and turns.max() > _FARTHEST_TURN:
        k = int(turns.argmax())
        return (
            f"the base turns by {turns[k]:.2g} rad from t = {traj.t[k]:g} to {traj.t[k + 1]:g} "
            f"s, more than its ends can tell; give knots at most {_FARTHEST_TURN:g} rad apart"
        )
    if found[worst] <= _IN_DOUBT:
        return ""
    said = (
        f"t, q, v, u are no motion of '{traj.robot.name}': from t = {traj.t[worst]:g} to "
        f"{traj.t[worst + 1]:g} s they miss it by {found[worst]:.2g} of its largest rate"
    )
    plain, few = traj._plain, found.argsort()[-_TRIED:].tolist()
    once = dict(_others(plain))
    # Two things may be meant otherwise, neither of which mends it alone.
    twice = (
        {f"{first}, {words}": each for words, each in _others(other) if words != first}
        for first, other in once.items()
    )
    for tried in (once, *twice):
        sizes = {words: float(each.flow.missed(few).max()) for words, each in tried.items()}
        words = min(sizes, key=sizes.__getitem__)
        size = sizes[words]
        if size <= _IN_DOUBT and (size := float(tried[words].flow.residual.max())) <= _IN_DOUBT:
            return f"{said}; {words} they hold to {size:.0e}"
    return f"{said}; give those of one motion under the robot's own inputs, springs and gravity"


def _others(traj: Any) -> Iterator[tuple[str, Any]]:
    """Yield what else a trajectory may have been meant to be, and how to say it."""
    robot, R = traj.robot, rotation_matrices(traj.q[:, 3:7])
    yield "with the input of the knot before (hold='previous')", replace(traj, hold="previous")
    yield "with the input of the knot after", replace(traj, u=traj.u[1:], hold="previous")
    yield "with inputs linear between the knots (hold='linear')", replace(traj, hold="linear")
    yield "with t in milliseconds", replace(traj, t=1e-3 * traj.t)
    turning = [joint for joint in robot.joints if not (joint.prismatic or joint.unbounded)]
    q, v = traj.q.copy(), traj.v.copy()
    for rows, at in ((q, [x.idx_q for x in turning]), (v, [x.idx_v for x in turning])):
        rows[:, at] = np.radians(rows[:, at])
    if turning and not robot.followers:
        yield "with joints in degrees", replace(traj, q=q, v=v)
    for frame in ("local", "hybrid", "world"):
        yield f"with u in frame {frame}", replace(traj, frame=frame)
    v = traj.v.copy()
    for words, part, frame in (
        ("linear velocity", slice(0, 3), "hybrid"),
        ("velocities", slice(3, 6), "world"),
    ):
        v[:, part] = (traj.v[:, None, part] @ R)[:, 0]
        yield f"with the {words} of the base in reference axes", replace(traj, v=v)
        yield f"with u and v in frame {frame}", replace(traj, v=v, frame=frame)
    for words, has, fields_ in (
        ("without damping", any(robot.damping.values()), {"damping": {}}),
        ("without springs", any(robot.stiffness.values()), {"stiffness": {}}),
        ("without gravity", any(robot.gravity), {"gravity": (0.0, 0.0, 0.0)}),
        ('with damping="urdf"', any(robot.urdf_damping.values()), {"damping": "urdf"}),
    ):
        if has:
            yield words, replace(traj, robot=robot.replace(**fields_))
