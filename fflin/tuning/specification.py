"""Laws and goals as tables of a robot file, or as text of the command line."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from typing import TypeVar

from fflin.base.errors import InputError, listed, located, require_known
from fflin.base.names import group_of
from fflin.base.toml_file import flat, toml_value
from fflin.linear.model import LinearModel
from fflin.tuning.channels import ends_of
from fflin.tuning.goals import (
    Damping,
    Decay,
    Goal,
    Margin,
    MaxGain,
    RollOff,
    Track,
    Variance,
)
from fflin.tuning.parameters import Tunable
from fflin.tuning.plant import Signals, signals_of
from fflin.tuning.structures import (
    PD,
    PID,
    Lead,
    LowPass,
    Notch,
    StateSpaceLaw,
    StaticGain,
    Structure,
    Structured,
)

T = TypeVar("T")

LAWS: dict[str, Callable[..., Structure]] = {
    "pd": PD,
    "pid": PID,
    "static_gain": StaticGain,
    "state_space": StateSpaceLaw,
}
FILTERS: dict[str, Callable[..., Structure]] = {
    "low_pass": LowPass,
    "lead": Lead,
    "notch": Notch,
}
GOALS: dict[str, Callable[..., Goal]] = {
    "max_gain": MaxGain,
    "roll_off": RollOff,
    "margin": Margin,
    "decay": Decay,
    "damping": Damping,
    "variance": Variance,
    "track": Track,
}

# Keys whose tables are parameters to tune. Other tables contain sizes of signals.
_TUNABLE = (
    *("kp", "ki", "kd", "lag"),
    *("frequency", "damping", "zero", "pole", "zero_damping", "pole_damping"),
)

# Inputs that a law commands unless it names others, the first of these groups that exists.
_GROUPS = ("tau_b", "wheel")

# A word without quotes in the text of the command line.
_WORD = re.compile(r"[\w.*?\-]+")


def table_of(text: str) -> dict[str, object]:
    """Return the table of a text such as ``pd measured=q_b lag=[0.1,1]``.

    The first word is the type. Values are written as in TOML; names need no quotes.
    """
    kind, *entries = _split(text)
    table: dict[str, object] = {"type": kind}
    for entry in entries:
        key, equals, value = entry.partition("=")
        if not equals or not value:
            raise InputError(f"'{text}': '{entry}' is not of the form KEY=VALUE")
        if key in table:
            raise InputError(f"'{text}': {key} is given twice; give it once")
        table[key] = _value(text, value)
    return table


def _split(text: str) -> list[str]:
    """Split a text at spaces that are outside of brackets, braces and quotes."""
    parts = [""]
    depth = 0
    quote = ""
    for letter in text.strip():
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        depth += (letter in "[{") - (letter in "]}")
        if letter.isspace() and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return [part for part in parts if part] or [""]


def _value(text: str, written: str) -> object:
    if _WORD.fullmatch(written) and not re.fullmatch(
        r"[+-]?(\d.*|inf|nan|true|false)", written
    ):
        return written
    try:
        return toml_value(written)
    except ValueError:
        raise InputError(
            f"'{text}': {written} is not a value; write a number, a name, [least,largest] or "
            "{name=size}"
        ) from None


def structure_of(tables: Sequence[Mapping[str, object]], lin: LinearModel) -> Structure:
    """Return the structure of the tables `law`: the sum of all laws, in series with all filters."""
    shared: dict[str, Tunable] = {}
    terms: list[Structure] = []
    filters: list[Structure] = []
    for number, table in enumerate(tables, 1):
        with located(_label("law", number, table)):
            values = dict(table)
            kind = _kind("law", values, {**LAWS, **FILTERS})
            if kind in FILTERS:
                filters.append(_filter(kind, values, shared))
                continue
            terms.append(_law(kind, values, shared, lin))
    if not terms:
        raise InputError(
            f"no law has signals; add a law of the type {', '.join(LAWS)} before the filters"
        )
    structure = terms[0]
    for term in terms[1:]:
        structure = structure + term
    for item in filters:
        structure = item * structure
    return structure


def _law(
    kind: str, values: dict[str, object], shared: dict[str, Tunable], lin: LinearModel
) -> Structure:
    """Return a law, in series with the filters of its key `filters`."""
    inner = values.pop("filters", [])
    values.setdefault("measured", "q_b")
    if "inputs" not in values:
        values["inputs"] = _default_inputs(lin)
    structure = _made(kind, LAWS[kind], _tunables(values, shared), ("filters",))
    if not isinstance(inner, Sequence) or not all(
        isinstance(x, Mapping) for x in inner
    ):
        raise InputError(
            f"filters are {inner!r}, expected tables, such as [{{ type = 'low_pass' }}]"
        )
    for table in inner:
        of_filter = dict(table)
        name = _kind("filter", of_filter, FILTERS)
        structure = _filter(name, of_filter, shared) * structure
    return structure


def _filter(
    kind: str, values: dict[str, object], shared: dict[str, Tunable]
) -> Structure:
    return _made(kind, FILTERS[kind], _tunables(values, shared))


def _default_inputs(lin: LinearModel) -> str:
    """Return the group of inputs that a law commands if it names none."""
    groups = [group_of(key) for key in signals_of(lin).input_keys]
    for group in _GROUPS:
        if group in groups:
            return group
    raise InputError(
        f"the robot has neither a base torque nor wheels; add the key inputs: {listed(groups)}"
    )


def goals_of(tables: Sequence[Mapping[str, object]]) -> list[Goal]:
    """Return the goals of the tables `goal`."""
    goals = []
    for number, table in enumerate(tables, 1):
        with located(_label("goal", number, table)):
            values = dict(table)
            kind = _kind("goal", values, GOALS)
            for key in ("inputs", "outputs"):
                if key in values:
                    values[key] = flat(values[key])
            if isinstance(below := values.get("below"), Mapping):
                values["below"] = _transfer_function(below)
            goals.append(_made(kind, GOALS[kind], values))
    return goals


def _transfer_function(table: Mapping[str, object]) -> tuple[object, object]:
    """Return the numerator and the denominator of a table."""
    keys = ("numerator", "denominator")
    require_known("key of below", table, keys)
    missing = [key for key in keys if key not in table]
    if missing:
        raise InputError(
            f"below has no {missing[0]}, expected {{ numerator = [..], denominator = [..] }}"
        )
    return table["numerator"], table["denominator"]


def _tunables(
    values: Mapping[str, object], shared: dict[str, Tunable]
) -> dict[str, object]:
    """Replace the tables of parameters by `Tunable`; equal names give one shared parameter."""
    result = dict(values)
    for key in _TUNABLE:
        table = values.get(key)
        if not isinstance(table, Mapping):
            continue
        require_known(
            f"key of the parameter {key}", table, signature(Tunable).parameters
        )
        name = str(table.get("name", ""))
        if name in shared:
            if len(table) > 1:
                raise InputError(
                    f"parameter '{name}' is shared; give its bounds and value only once"
                )
            result[key] = shared[name]
            continue
        parameter = Tunable(**table)
        result[key] = parameter
        if name:
            shared[name] = parameter
    return result


def _label(what: str, number: int, table: Mapping[str, object]) -> str:
    kind = table.get("type", "")
    return f"{what} {number} ({kind})" if kind else f"{what} {number}"


def _kind(what: str, values: dict[str, object], known: Mapping[str, object]) -> str:
    """Remove the key `type` from the values of a table, and return it."""
    if "type" not in values:
        raise InputError(
            f"the key 'type' is missing; set 'type' to one of {', '.join(known)}"
        )
    kind = str(values.pop("type"))
    require_known(f"type of {what}", [kind], known)
    return kind


def _made(
    kind: str,
    make: Callable[..., T],
    values: Mapping[str, object],
    more: Sequence[str] = (),
) -> T:
    """Make an object of a table; its keys are the parameters of `make`."""
    parameters = signature(make).parameters
    names = [name for name in parameters if not name.startswith("_")]
    require_known(f"key of {kind}", values, [*names, *more])
    missing = [
        name
        for name in names
        if parameters[name].default is parameters[name].empty and name not in values
    ]
    if missing:
        raise InputError(f"the key '{missing[0]}' is missing; add this key")
    return make(**values)


def check_signals(
    structure: Structure, goals: Sequence[Goal], lin: LinearModel
) -> None:
    """Raise an error if a signal of the structure or of a goal is not in the model."""
    signals: Signals = signals_of(lin)
    measured, commanded = Structured(structure, signals).used
    for number, goal in enumerate(goals, 1):
        with located(f"goal {number} ({goal.label})"):
            ends_of(goal, signals, lin.state_names, measured, commanded)
