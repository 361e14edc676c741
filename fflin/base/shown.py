"""Text of a dataclass with the fields that differ from their defaults."""

from __future__ import annotations

from dataclasses import fields
from typing import Any


def shown_fields(item: Any) -> str:
    """Return the constructor call of a dataclass as a text, with the positional fields first.

    Fields with ``repr=False`` are omitted if they have their default value.
    """
    parts = []
    for field in sorted(fields(item), key=lambda field: bool(field.kw_only)):
        value = getattr(item, field.name)
        if field.repr or value != field.default:
            parts.append(f"{field.name}={value!r}")
    return f"{type(item).__name__}({', '.join(parts)})"
