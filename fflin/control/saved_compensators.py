"""Compensators in files, and the policies that fly them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fflin.base.errors import InputError, listed
from fflin.base.names import input_keys
from fflin.base.record import read_record, reading, text
from fflin.base.writing import RECORDS, as_path, check_ending
from fflin.control.compensator import Compensator
from fflin.control.linear_controller import OutputFeedback
from fflin.control.multirate import MultirateCompensator
from fflin.control.multirate_feedback import MultirateFeedback
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot

_KINDS: dict[str, type[Compensator | MultirateCompensator]] = {
    kind.__name__: kind for kind in (Compensator, MultirateCompensator)
}


def sampled_compensator(
    path: str | Path,
) -> Compensator | MultirateCompensator | None:
    """Return the sampled compensator that a file contains, or None for any other content."""
    target = as_path(path)
    check_ending(target, RECORDS)
    with reading(target, "controller"):
        kind = _KINDS.get(text(read_record(target)[0].get("kind", "")))
    if kind is None:
        return None
    compensator = kind.load(target)
    return compensator if compensator.dt else None


def feedback_of(
    compensator: Compensator | MultirateCompensator, lin: LinearModel
) -> OutputFeedback | MultirateFeedback:
    """Return the policy of a compensator about the point of a continuous model.

    The model may have more inputs than the compensator, which the policy does not change.
    """
    inputs = compensator.output_names
    if missing := [name for name in inputs if name not in lin.input_names]:
        raise InputError(
            f"the law was designed for the inputs {listed(missing)}, which '{lin.robot}' does not "
            "have; give the robot and the --inputs of the design"
        )
    delays = compensator.delay if compensator.delay.size else np.zeros(len(inputs))
    by_input = dict(zip(inputs, delays.tolist(), strict=True))
    keys = dict(zip(lin.input_names, input_keys(lin), strict=True))
    named = {keys[name]: value for name, value in by_input.items()}
    model = lin.discretize(compensator.dt, delay=named)
    at = [lin.input_names.index(name) for name in inputs]
    C = np.zeros((len(lin.input_names), compensator.C.shape[1]))
    C[at] = compensator.C
    E = compensator.E
    if E.size:
        E = np.zeros((*E.shape[:-1], len(C)))
        E[..., at] = compensator.E
    law = replace(
        compensator,
        C=C,
        E=E,
        u0=lin.u0,
        delay=model.delay,
        output_names=lin.input_names,
    )
    return policy_of(law, model)


def policy_of(
    compensator: Compensator | MultirateCompensator, model: LinearModel
) -> OutputFeedback | MultirateFeedback:
    """Return the policy of a compensator with the sampled model of its design."""
    if isinstance(compensator, MultirateCompensator):
        return MultirateFeedback(model, compensator)
    return OutputFeedback(model, compensator)


def robot_with_inputs(robot: Robot, names: tuple[str, ...]) -> Robot:
    """Return the robot without the inputs that a law does not command."""
    kept = tuple(
        item for item, own in robot.named_inputs if not {*own}.isdisjoint(names)
    )
    if not kept or len(kept) == len(robot.inputs):
        return robot
    return robot.replace(inputs=kept)
