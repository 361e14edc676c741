"""How far a robot is from the one that a controller was made for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.linear.linearization import linearize
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    from fflin.robot.robot import Robot


def notes_of(policy: Any, robot: Robot) -> tuple[str, ...]:
    """Say how far a robot is from the one that a policy was made for; nothing for the same."""
    design = getattr(policy, "design", None)  # of an allocation
    along = getattr(policy, "trajectory", None)
    plant = robot if design is None else robot.replace(inputs=design.inputs)
    lin = getattr(policy, "lin", None)
    if along is not None:
        lin = linearize(along.robot, *along.point(float(along.t[0])), frame="local")
    if not isinstance(lin, LinearModel):
        return ()
    if (lin.urdf_sha256, lin.locked) == (robot.urdf_sha256, robot.locked):
        return ()
    here = linearize(plant, lin.q, lin.v, lin.u0, frame=lin.frame, reference=lin.reference)
    size = np.zeros(len(here.x0))
    size[-len(here.M) :] = np.sqrt(here.M.diagonal())
    rows = [here.state_names.index(name) for name in lin.state_names]
    sampled = here.discretize(lin.dt) if lin.dt else here
    own, other = (size[rows, None] * B for B in (lin.B, sampled.B[rows]))
    apart = np.linalg.norm(own - other, axis=0) / np.linalg.norm(own, axis=0).clip(1e-300)
    most = 100.0 * float(apart.max(initial=0.0))
    return (
        f"the controller is one of '{lin.robot}', the robot another: the accelerations that its "
        f"inputs cause differ by up to {most:.{0 if most >= 10.0 else 1}f} %",
    )
