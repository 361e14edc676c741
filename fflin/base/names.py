"""Names of states and inputs in the form GROUP.ENTRY, and patterns that match these names."""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from fflin.base.errors import InputError, UnknownNameError, unknown

T = TypeVar("T")

_GROUPS = ("tau_b", "F_b", "tau_m")
_OF_UNIT = {"N": "thrust", "N m": "wheel", "A m^2": "dipole"}

# Groups of inputs that robots can have.
INPUT_GROUPS = (*_GROUPS, *_OF_UNIT.values())


def undotted(name: str) -> str:
    """Return a name for python-control, which reserves dots for the form `system.signal`.

    Two names can become equal, such as ``q_m.a.b`` and ``q_m.a_b``.
    """
    return name.replace(".", "_")


def group_of(name: str) -> str:
    """Return the GROUP of a name GROUP.ENTRY, or "" if the name has no group."""
    return name.partition(".")[0] if "." in name else ""


# Name of a state that is an earlier command of an input, such as past_2.tau_b.x, or the force that
# an actuator with a lag exerts, such as lag.tau_b.x.
_PAST = re.compile(r"(past_[0-9]+|lag)\.", re.ASCII)


def past_name(samples: int, name: str) -> str:
    """Return the name of the state that is the command of an input some samples ago."""
    return f"past_{samples}.{name}"


LAG = "lag."  # start of the names of the states of inputs and outputs with a lag


def lag_name(name: str) -> str:
    """Return the name of the state that is the force of an input with a lag."""
    return f"{LAG}{name}"


def without_past(states: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of states without earlier commands and without forces that lag."""
    return tuple(name for name in states if not _PAST.match(name))


def input_keys(model: Any) -> tuple[str, ...]:
    """Return the names GROUP.ENTRY of the inputs of a model.

    The model is any object with the attributes `input_names` and `input_units`. An input without a
    known group gets the group "thrust", "wheel" or "dipole" of its unit, or the group "input".
    """
    return grouped(model.input_names, model.input_units)


def grouped(names: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    """Return the names GROUP.ENTRY of inputs; see `input_keys`."""
    keys = []
    for name, unit in zip(names, units, strict=True):
        key = name
        if group_of(name) not in _GROUPS:
            key = f"{_OF_UNIT.get(unit, 'input')}.{name}"
        keys.append(key)
    return tuple(keys)


def state_keys(joints: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the 12 + 2 n states for n joints: first positions, then velocities."""
    groups = dict(
        q_b="xyz", r_b="xyz", q_m=joints, omega_b="xyz", v_b="xyz", qdot_m=joints
    )
    return tuple(f"{group}.{name}" for group, names in groups.items() for name in names)


def runs(names: Sequence[str], units: Sequence[str]) -> list[tuple[int, int, str, str]]:
    """Return (first, last, group, units) for each run of consecutive names of one group.

    `first` and `last` are indices. Consecutive names without a group form a run if they have the
    same unit.
    """
    blocks: list[tuple[int, int, str, list[str]]] = []
    for i, (name, unit) in enumerate(zip(names, units, strict=True)):
        group = (
            name.partition(".")[0] if name.count(".") == 1 else name.rpartition(".")[0]
        )
        first = i
        block_units = [unit]
        if blocks and blocks[-1][2] == group and (group or unit in blocks[-1][3]):
            first, _, _, block_units = blocks.pop()
            block_units = list(dict.fromkeys((*block_units, unit)))
        blocks.append((first, i, group, block_units))
    return [
        (first, last, group, "|".join(block_units))
        for first, last, group, block_units in blocks
    ]


def matching(kind: str, key: str, names: Sequence[str]) -> list[int]:
    """Return the indices of the names that match a key, such as ``tau_m.x``, ``tau_m`` or ``*x``.

    The key is a name, a group, the part of a name after its first dot, or a pattern.
    """
    if key in names:
        return [names.index(key)]
    # If the pattern matches no whole name, it is compared with the part of each name after its
    # first dot. Only * and ? are wildcards, because joint names may contain brackets.
    pattern = re.compile(
        re.escape(str(key)).replace(r"\*", ".*").replace(r"\?", "."), re.DOTALL
    )
    of_group = [i for i, name in enumerate(names) if group_of(name) == key]
    indices = of_group or [i for i, name in enumerate(names) if pattern.fullmatch(name)]
    if not indices:
        indices = [
            i for i, n in enumerate(names) if pattern.fullmatch(n.partition(".")[2])
        ]
        groups = list(dict.fromkeys(group_of(names[i]) for i in indices))
        if len(groups) > 1:
            written = " or ".join(f"{group}.{key}" for group in groups)
            fits = ", ".join(groups)
            raise InputError(
                f"{kind} '{key}' is ambiguous: it is in {fits}; write {written}"
            )
    if not indices:
        known = dict.fromkeys((*filter(None, map(group_of, names)), *names))
        raise unknown(kind, key, known)
    return indices


def stands_for_any(key: str, names: Sequence[str]) -> bool:
    """Return whether a key matches any name; an ambiguous key also counts as a match."""
    try:
        return bool(matching("name", key, names))
    except UnknownNameError:
        return False
    except InputError:
        return True


def by_name(kind: str, values: Mapping[str, T], names: Sequence[str]) -> dict[int, T]:
    """Return {index of a name: value} from {name, pattern or group: value}.

    A name overrides a pattern, and a pattern overrides a group.
    """
    value_of_index: dict[int, T] = {}
    groups = {*map(group_of, names)}

    def priority(key: str) -> int:
        if _is_pattern(key):
            return 1
        return 0 if key in groups else 2

    for key in sorted(values, key=priority):
        value_of_index |= dict.fromkeys(matching(kind, key, names), values[key])
    return value_of_index


def rates_by_name(
    joints: Sequence[str], values: Mapping[str, float]
) -> dict[str, float]:
    """Return {velocity state: rate}; `values` has joints, states, groups or patterns as keys."""
    names = state_keys(joints)[6 + len(joints) :]
    full = {}
    for key, value in values.items():
        name = f"qdot_m.{key}" if key in joints else key
        full[name] = value
    return {
        names[index]: value for index, value in by_name("velocity", full, names).items()
    }


def chosen(kind: str, keys: Sequence[str], names: Sequence[str]) -> list[int]:
    """Return the sorted indices of all names that match any of the keys."""
    return sorted({index for key in keys for index in matching(kind, key, names)})


def joints_by_name(
    kind: str,
    values: Mapping[str, T],
    joints: Sequence[str],
    find: Callable[[str], object],
) -> dict[str, T]:
    """Return {joint: value} from {joint, pattern or ``q_m``: value}.

    `find` must raise an error for an invalid joint name.
    """
    many = {
        key: value for key, value in values.items() if key == "q_m" or _is_pattern(key)
    }
    states = [f"q_m.{name}" for name in joints]
    value_of_joint = {
        joints[i]: value for i, value in by_name(kind, many, states).items()
    }
    for key, value in values.items():
        if key not in many:
            find(name := str(key).removeprefix("q_m."))
            value_of_joint[name] = value
    return value_of_joint


def _is_pattern(key: object) -> bool:
    return "*" in str(key) or "?" in str(key)


def with_units(names: Sequence[str], units: Sequence[str]) -> str:
    """Return the groups of signals with their units, such as "tau_b [N m], F_b [N]"."""
    parts = []
    for first, last, group, unit in runs(names, units):
        ends = dict.fromkeys((names[first], names[last]))
        label = group or " ... ".join(ends)
        parts.append(f"{label} [{unit}]")
    return ", ".join(parts)
