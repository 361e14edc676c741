"""Differences between a simulated robot and the robot that a controller was designed for."""

import numpy as np

from fflin.base.validation import Array
from fflin.control.default_weights import displacements
from fflin.linear.linearization import linearize
from fflin.linear.model import LinearModel
from fflin.robot.inputs import ReactionWheel
from fflin.robot.robot import Robot

# A smaller difference, relative to the largest effect, is rounding.
_ROUNDING = 1e-9
# Effects of a state count only if they exceed this fraction of the largest effect of any state.
_LEAST = 1e-2


def notes_of(policy: object, robot: Robot) -> tuple[str, ...]:
    """Return a note on how a robot differs from a policy's design; none if they are the same."""
    design = getattr(policy, "design", None)  # of an allocation
    along = getattr(policy, "trajectory", None)
    # An allocation commands the wrenches of its design, and torques of the robot's own wheels.
    own = {each.name: each for each in robot.inputs if isinstance(each, ReactionWheel)}
    asked = () if design is None else design.inputs
    inputs = [own.get(x.name, x) if isinstance(x, ReactionWheel) else x for x in asked]
    plant = robot if design is None else robot.replace(inputs=inputs)
    lin = getattr(policy, "lin", None)
    if getattr(lin, "_robot", None) is robot:
        return ()
    if along is not None:
        lin = linearize(along.robot, *along.point(float(along.t[0])), frame="local")
    if not isinstance(lin, LinearModel):
        return ()
    here = linearize(plant, lin.q, lin.v, lin.u0, frame=lin.frame, reference=lin.reference)
    size = np.pad(np.sqrt(here.M.diagonal()), (len(here.x0) - len(here.M), 0))
    rows = [here.state_names.index(name) for name in lin.state_names]
    sampled = here.discretize(lin.dt) if lin.dt else here
    whole = len(rows) == len(size)
    weight, every = size[rows, None], list(range(len(rows)))
    pairs = zip(_caused(lin, whole, every), _caused(sampled, whole, rows), strict=True)
    (own_B, other_B), (own_A, other_A) = ((weight * one, weight * other) for one, other in pairs)
    usual = _usual(here, own_A, other_A) if whole else 0.0
    said = {"inputs": _apart(own_B, other_B, 0.0), "states": _apart(own_A, other_A, usual)}
    parts = [
        f"due to {what} differ by up to {most:{'.0f' if most >= 10.0 else '.2g'}} %"
        for what, most in said.items()
        if most
    ]
    start = f"the robot differs from '{lin.robot}' of the controller's design: accelerations "
    return (start + ", accelerations ".join(parts),) if parts else ()


def _caused(lin: LinearModel, whole: bool, rows: list[int]) -> tuple[Array, Array]:
    """Return the effects of inputs and of states; of a reduced model, of A B and A^2 B."""
    A, B = lin.A - np.eye(len(lin.A)) * bool(lin.dt), lin.B
    moved = A if whole else np.hstack((A @ B, A @ A @ B))
    return B[rows], np.column_stack((moved, lin.f0))[rows]


def _usual(lin: LinearModel, own: Array, other: Array) -> Array:
    """Return sizes (nx + 1,) below which the effect of each state, and f0, is negligible."""
    size = displacements(lin, 1.0)
    both = np.maximum(*(np.linalg.norm(each[:, :-1], axis=0) for each in (own, other)))
    largest = (both.reshape(2, -1) * size).max(axis=1, keepdims=True)
    # f0 is compared with the effect of a displacement of the usual size.
    return np.append(_LEAST * largest / size, largest[0])


def _apart(own: Array, other: Array, usual: Array | float) -> float:
    """Return the largest relative difference of the columns [%], zero where it is rounding."""
    size, to, off = (np.linalg.norm(each, axis=0) for each in (own, other, own - other))
    least = _ROUNDING * max(size.max(initial=0.0), to.max(initial=0.0))
    floor = np.maximum(usual, least)
    apart = off / np.where(size > floor, size, np.maximum(to, usual)).clip(1e-300)
    return 100.0 * float(apart[off > least].max(initial=0.0))
