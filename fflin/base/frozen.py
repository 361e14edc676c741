"""Results with read-only arrays, so that nobody changes them by accident."""

from dataclasses import fields
from typing import Any

import numpy as np

from fflin.base.validation import Array


class FrozenArrays:
    """Mixin of frozen dataclasses: makes their arrays read-only, and copies writable ones."""

    def __post_init__(self) -> None:
        this: Any = self
        for item in fields(this):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray) and value.flags.writeable:
                object.__setattr__(self, item.name, frozen(value.copy()))

    def __setstate__(self, state: dict[str, Any]) -> None:
        # NumPy makes arrays anew, and writeable, for deepcopy and most of pickle's protocols.
        for value in state.values():
            if isinstance(value, np.ndarray):
                frozen(value)
        vars(self).update(state)


def frozen(array: Array) -> Array:
    """Return the array itself, read-only."""
    array.setflags(write=False)
    return array
