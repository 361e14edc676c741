"""The part of a model with reaction wheels that a regulator or a filter is designed for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fflin.analysis.momentum import momentum_reduction
from fflin.analysis.wheels import ignorable_wheels, outputs_of, wheel_inputs, without
from fflin.linear.model import LinearModel


def regulated_part(lin: LinearModel, wheel_speeds: bool | None = None) -> LinearModel:
    """Return the model of the states that are regulated; `lin` itself where it has no wheels.

    The angles of wheels leave it, where nothing depends on them; their speeds as
    `momentum_reduction` says; and the position of the base in the directions in which no input
    can push it. Where a speed stays whose angle has left there are fewer positions than rates.
    The others' columns of A are zero in its rows, so that it is exact whatever they do.
    """
    if not wheel_inputs(lin):
        return lin
    part: LinearModel = momentum_reduction(lin, wheel_speeds=wheel_speeds)
    still, _ = ignorable_wheels(lin)
    wheels = {lin.state_names[i] for i in still}
    left = set(lin.state_names[: len(lin.M)]) - set(part.state_names) - wheels
    if any(not name.startswith("r_b.") for name in left):
        # Something else is not held either, which whoever designs is to be told.
        gone = [i for i in still if lin.state_names[i] not in part.state_names]
        part = without(lin, np.array(gone, dtype=np.intp)) if gone else lin
    names = [name for name in part.state_names if name not in wheels]
    at, z = ([each.state_names.index(name) for name in names] for each in (part, lin))
    return replace(
        part,
        A=part.A[np.ix_(at, at)],
        B=part.B[at],
        f0=part.f0[at],
        x0=part.x0[at],
        state_names=tuple(names),
        state_units=tuple(part.state_units[i] for i in at),
        **outputs_of(lin, np.array(z)),
    )
