"""What every result of a design is: a frozen dataclass that saves, loads and is read-only."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import ClassVar, TypeVar

import numpy as np

Kind = TypeVar("Kind", bound="Design")


@dataclass(frozen=True, eq=False, repr=False)
class Design:
    """Arrays, names and figures; the arrays are read-only."""

    # Names of the arrays of one dimension, which Matlab does not know.
    VECTORS: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray) and value.flags.writeable:
                value = value.copy()
                value.setflags(write=False)
                object.__setattr__(self, item.name, value)

    def save(self, path: str | Path) -> None:
        """Write it to a .npz, .mat or .json file, whole or not at all.

        Raises
        ------
        FileError
            If the ending is another or the file cannot be written.
        """
        from fflin.base.design_files import save_design

        save_design(self, path)

    @classmethod
    def load(cls: type[Kind], path: str | Path) -> Kind:
        """Read what `save` wrote; every figure is the same to the last bit.

        Raises
        ------
        FileError
            If the file cannot be read or is another thing.
        """
        from fflin.base.design_files import load_design

        return load_design(cls, path)
