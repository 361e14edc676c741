"""The names of a robot's states and inputs, GROUP.ENTRY each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fflin.base.names import by_name
from fflin.robot.inputs import BaseForce, BaseTorque, Input, JointTorque, named_wheels


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
    wheels = iter([name for name, _ in named_wheels(inputs)])
    keys: list[str] = []
    for item in inputs:
        if isinstance(item, BaseTorque | BaseForce):
            keys += [f"{item.GROUP}.{axis}" for axis in "xyz"]
        elif isinstance(item, JointTorque):
            keys.append(f"{item.GROUP}.{item.joint}")
        else:
            count = sum(key.startswith(f"{item.GROUP}.") for key in keys)
            own = getattr(item, "name", None) or f"{item.KEY}_{1 + count}"
            keys.append(f"{item.GROUP}.{next(wheels) if item.GROUP == 'wheel' else own}")
    return tuple(keys)


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
