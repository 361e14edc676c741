"""The names of a robot's states and inputs, GROUP.ENTRY each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fflin.base.names import by_name
from fflin.robot.inputs import Input, named_inputs


def state_keys(joints: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the 12 + 2n states: of the configuration, then of their rates."""
    return (
        *(f"{group}.{axis}" for group in ("q_b", "r_b") for axis in "xyz"),
        *(f"q_m.{name}" for name in joints),
        *(f"{group}.{axis}" for group in ("omega_b", "v_b") for axis in "xyz"),
        *(f"qdot_m.{name}" for name in joints),
    )


def input_keys_of(inputs: Sequence[Input]) -> tuple[str, ...]:
    """Return the names of the inputs, as `fflin.base.names.input_keys` has those of a model."""
    return tuple(
        name if name.startswith(f"{item.GROUP}.") else f"{item.GROUP}.{name}"
        for item, names in named_inputs(inputs)
        for name in names
    )


def rates_by_name(joints: Sequence[str], values: Mapping[str, float]) -> dict[str, float]:
    """Return {state: rate} of {joint, state, group or pattern: rate}.

    Raises
    ------
    UnknownNameError
        If there is no such joint or component.
    """
    names = state_keys(joints)[6 + len(joints) :]
    full = {f"qdot_m.{key}" if key in joints else key: value for key, value in values.items()}
    return {names[index]: value for index, value in by_name("velocity", full, names).items()}
