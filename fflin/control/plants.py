"""Whether a controller fits a robot, and how far that robot is from the one it was made for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from fflin.base.errors import InputError
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.state import StateMap
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    from fflin.robot.robot import Robot

# Names and units, in their order.
Signals: TypeAlias = tuple[tuple[str, ...], tuple[str, ...]]

_SHOWN = 4


def require_fit(lin: LinearModel, robot: Robot, state: StateMap) -> None:
    """Raise `InputError` where a model's states or inputs are not those of a robot.

    Its masses may be others: a controller meets a robot that is not quite its model.
    """
    made, actuation = f"the model is one of '{lin.robot}'", Actuation(state)
    inputs = (lin.input_names, lin.input_units)
    require_same(made, robot, "input", inputs, (actuation.names, actuation.units))
    # A reduced model has a part of the states.
    units = dict(zip(state.names, state.units, strict=True))
    there = tuple(name for name in lin.state_names if name in units)
    states = (lin.state_names, lin.state_units)
    require_same(made, robot, "state", states, (there, tuple(units[name] for name in there)))
    require_turns(made, len(lin.q), robot)


def require_same(made: str, robot: Robot, kind: str, own: Signals, there: Signals) -> None:
    """Raise `InputError` that says which names and units differ from those of a robot."""
    mine, others = (dict(zip(*each, strict=True)) for each in (own, there))
    lacking, beside = ([n for n in a if n not in b] for a, b in ((mine, others), (others, mine)))
    if names := lacking or beside:
        shown = ", ".join([*names[:_SHOWN], *["..."] * bool(names[_SHOWN:])])
        with_or_without = "without" if lacking else "with"
        said = f"{with_or_without} the {kind}{'s' * bool(names[1:])} {shown}"
    elif other := [name for name in mine if mine[name] != others[name]]:
        said = f"whose {kind} {other[0]} is in {others[other[0]]}, not {mine[other[0]]}"
    elif own != there:
        said = f"whose {kind}s stand in another order"
    else:
        return
    raise InputError(f"{made}, not of '{robot.name}' as it is given, {said}; linearise this robot")


def require_turns(made: str, size: int, robot: Robot) -> None:
    """Raise `InputError` where a configuration of that size is none of a robot."""
    if size != robot.nq:
        raise InputError(
            f"{made}, not of '{robot.name}' as it is given, whose configuration has {robot.nq} "
            f"entries, not {size}: other joints are continuous; linearise this robot"
        )


def notes_of(policy: Any, robot: Robot) -> tuple[str, ...]:
    """Say how far a robot is from the one that a policy was made for; nothing for the same."""
    from fflin.linear.linearization import linearize

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
    return (
        f"the controller is one of '{lin.robot}', the robot another: the accelerations that its "
        f"inputs cause differ by up to {100.0 * float(apart.max(initial=0.0)):.2g} %",
    )
