"""Outputs that would measure the states that a message names."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence

_STATE = re.compile(r"\b(q_b|r_b|q_m|omega_b|v_b|qdot_m)\.(\w+)")

# With more joints than this, a hint shows a pattern.
_MOST_JOINTS = 3


def with_outputs(message: str, states: str = "") -> str:
    """Return a message that ends with the [[output]] of a robot file that measures its states.

    `states` is a text that names all states; by default, the message itself. An empty message does
    not change.
    """
    if not message:
        return message
    named = _STATE.findall(states or message)
    groups = {group for group, _ in named}
    tables = list[str]()
    if groups & {"r_b", "v_b"}:
        tables.append('type = "base"')
    elif groups & {"q_b", "omega_b"}:
        tables.append('type = "star_tracker"')
    # Measured positions also show their rates.
    group, kind = ("q_m", "joints") if "q_m" in groups else ("qdot_m", "rates")
    joints = sorted({joint for other, joint in named if other == group})
    if len(joints) > _MOST_JOINTS:
        joints = [f"{_beginning(joints)}*"]
    if joints:
        tables.append(f'type = "{kind}", joints = {json.dumps(joints)}')
    if not tables:
        return message
    shown = " and ".join(f"[[output]] ({table})" for table in tables)
    return f"{message}, such as {shown} in the robot file"


def _beginning(names: Sequence[str]) -> str:
    """Return the longest text with which all names begin."""
    first = names[0]
    lengths = range(len(first), 0, -1)
    candidates = (first[:length] for length in lengths)
    return next(
        (x for x in candidates if all(name.startswith(x) for name in names)), ""
    )
