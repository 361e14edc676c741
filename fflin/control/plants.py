"""How far a robot is from the one that a controller was made for."""

from typing import Any

import numpy as np

from fflin.base.validation import Array
from fflin.linear.linearization import linearize
from fflin.linear.model import LinearModel
from fflin.robot.inputs import ReactionWheel
from fflin.robot.robot import Robot

# Less than this, relative to the largest, is no difference.
_ROUNDING = 1e-9


def notes_of(policy: Any, robot: Robot) -> tuple[str, ...]:
    """Say how far a robot is from the one that a policy was made for; nothing for the same."""
    design = getattr(policy, "design", None)  # of an allocation
    along = getattr(policy, "trajectory", None)
    # An allocation asks its design for wrenches, and the robot's own wheels for torques.
    own = {each.name: each for each in robot.inputs if isinstance(each, ReactionWheel)}
    asked = () if design is None else design.inputs
    inputs = [own.get(x.name, x) if isinstance(x, ReactionWheel) else x for x in asked]
    plant = robot if design is None else robot.replace(inputs=inputs)
    lin = getattr(policy, "lin", None)
    if along is not None:
        lin = linearize(along.robot, *along.point(float(along.t[0])), frame="local")
    if not isinstance(lin, LinearModel):
        return ()
    here = linearize(plant, lin.q, lin.v, lin.u0, frame=lin.frame, reference=lin.reference)
    size = np.zeros(len(here.x0))
    size[-len(here.M) :] = np.sqrt(here.M.diagonal())
    rows = [here.state_names.index(name) for name in lin.state_names]
    sampled = here.discretize(lin.dt) if lin.dt else here
    whole = len(rows) == len(size)
    weight, every = size[rows, None], list(range(len(rows)))
    pairs = zip(_caused(lin, whole, every), _caused(sampled, whole, rows), strict=True)
    of_inputs, of_states = (_apart(weight * one, weight * other) for one, other in pairs)
    said = {"inputs": of_inputs, "states": of_states}
    parts = [
        f"that its {what} cause differ by up to {most:{'.0f' if most >= 10.0 else '.2g'}} %"
        for what, most in said.items()
        if most
    ]
    start = f"the controller is one of '{lin.robot}', the robot another: the accelerations "
    return (start + ", those ".join(parts),) if parts else ()


def _caused(lin: LinearModel, whole: bool, rows: list[int]) -> tuple[Array, Array]:
    """Return the rows of what inputs cause, and of what states do: of a part, what inputs see."""
    A, B = lin.A - np.eye(len(lin.A)) * bool(lin.dt), lin.B
    moved = A if whole else np.hstack((A @ B, A @ A @ B))
    return B[rows], np.column_stack((moved, lin.f0))[rows]


def _apart(own: Array, other: Array) -> float:
    """Return the largest relative difference of the columns [%], zero where it is rounding."""
    size, to, off = (np.linalg.norm(each, axis=0) for each in (own, other, own - other))
    least = _ROUNDING * max(size.max(initial=0.0), to.max(initial=0.0))
    apart = off / np.where(size > least, size, to).clip(1e-300)
    return 100.0 * float(apart[off > least].max(initial=0.0))
