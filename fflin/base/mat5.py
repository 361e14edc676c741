"""MATLAB's MAT files, level 5, read without trust.

Every length is held against what is there, so that a damaged or hostile file is a `ValueError`
and nothing worse. Format: "MAT-File Format", The MathWorks, R2023b, chapter 1.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np

HEADER = 128

# Data types by their number, as NumPy calls them, and those of text as Python does.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4"}
_TYPES |= {9: "f8", 12: "i8", 13: "u8"}
_TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_MATRIX, _COMPRESSED = 14, 15
_TAG = {order: struct.Struct(f"{order}II") for order in "<>"}

# Classes of arrays.
_CELL, _STRUCT, _CHAR, _NUMBERS = 1, 2, 4, range(6, 16)
_COMPLEX = 0x0800

# Of compressed data [bytes], and of cells within cells.
_LARGEST, _DEEPEST = 2**31, 16


def read_mat(content: bytes) -> dict[str, Any]:
    """Return the variables: arrays, texts, lists of cells, structs as dicts; no others."""
    if content[124:128] not in (b"\0\1IM", b"\1\0MI"):
        hint = ", but of version 7.3; save it with the option -v7" * (content[126:128] == b"IM")
        raise ValueError(f"not a MATLAB file of level 5{hint}")
    order = "<" if content[126:128] == b"IM" else ">"
    variables: dict[str, Any] = {}
    for kind, data in _unpacked(content[HEADER:], order):
        if kind != _MATRIX:
            raise ValueError(f"a variable has the unknown data type {kind}")
        name, value = _matrix(data, order, 0)
        if value is not None:
            variables[name] = value
    return variables


def _unpacked(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    for kind, inner in _elements(data, order):
        if kind == _COMPRESSED:
            yield from _elements(zlib.decompressobj().decompress(inner, _LARGEST), order)
        else:
            yield kind, inner


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield the type and the bytes of each element."""
    at, unpack = 0, _TAG[order].unpack_from
    while at < len(data):
        if at + 8 > len(data):
            raise ValueError("the file ends within an element")
        kind, size = unpack(data, at)
        if kind >> 16:  # a small one, which stands in its own tag
            kind, size, start, step = kind & 0xFFFF, kind >> 16, at + 4, 8
        else:
            start = at + 8
            step = 8 + (size if kind == _COMPRESSED else -(-size // 8) * 8)
        if start + size > len(data) or (step == 8 and size > 4):
            raise ValueError("the file ends within an element")
        yield kind, data[start : start + size]
        at += step


def _matrix(data: bytes, order: str, depth: int) -> tuple[str, Any]:
    """Return the name and value of an array; the value is None if its class is not supported."""
    if depth > _DEEPEST:
        raise ValueError("its cells are nested too deeply")
    if not data:
        return "", np.zeros((0, 0))
    parts = _elements(data, order)
    try:
        flags = _integers(*next(parts), order)[0]
        kind = flags & 0xFF
        if kind not in (_CELL, _STRUCT, _CHAR, *_NUMBERS):
            return "", None
        shape = _integers(*next(parts), order)
        name = _text(*next(parts), order)
        count = math.prod(shape)
        if len(shape) < 2 or min(shape) < 0 or count > 2**40:
            raise ValueError(f"{name} has the impossible shape {shape}")
        if kind == _CELL:
            return name, _cells(parts, count, order, depth)
        if kind == _STRUCT:
            width = _integers(*next(parts), order)[0]
            names = _text(*next(parts), order)
            keys = [
                names[i : i + width].partition("\0")[0] for i in range(0, len(names), width or 1)
            ]
            values = _cells(parts, len(keys), order, depth) if count == 1 else []
            return name, dict(zip(keys, values, strict=count == 1))
        if kind == _CHAR:
            return name, _rows(_text(*next(parts), order), shape)
        values = _numbers(*next(parts), order)
        if flags & _COMPLEX:
            values = values + 1j * _numbers(*next(parts), order)
        if values.size != count:
            raise ValueError(f"{name} has {values.size} entries, expected {count}")
        return name, values.reshape(shape, order="F")
    except StopIteration:
        raise ValueError("the file ends within an array") from None


def _cells(parts: Iterator[tuple[int, bytes]], count: int, order: str, depth: int) -> list[Any]:
    values = []
    for kind, data in parts:
        if kind != _MATRIX:
            raise ValueError(f"a cell has the unknown data type {kind}")
        values.append(_matrix(data, order, depth + 1)[1])
    if len(values) != count:
        raise ValueError(f"an array has {len(values)} cells, expected {count}")
    return values


def _rows(text: str, shape: tuple[int, ...]) -> str | list[str]:
    """Return the text of a char array, or a list of texts if it has several rows."""
    if shape[0] <= 1:
        return text
    if len(text) != math.prod(shape):
        raise ValueError(f"a text of shape {shape} has {len(text)} characters")
    return [text[row :: shape[0]].rstrip() for row in range(shape[0])]


def _integers(kind: int, data: bytes, order: str) -> tuple[int, ...]:
    """Return what stands before the figures, 32 bits each."""
    if kind not in (5, 6) or len(data) % 4 or not data:
        raise ValueError(f"its integers have the unknown data type {kind}")
    return struct.unpack(f"{order}{len(data) // 4}i", data)


def _numbers(kind: int, data: bytes, order: str) -> Any:
    if kind not in _TYPES:
        raise ValueError(f"its numbers have the unknown data type {kind}")
    return np.frombuffer(data, np.dtype(order + _TYPES[kind]))


def _text(kind: int, data: bytes, order: str) -> str:
    if kind not in _TEXTS:
        raise ValueError(f"a text has the unknown data type {kind}")
    wide = "" if kind in (1, 2, 16) else "-le" if order == "<" else "-be"
    return data.decode(_TEXTS[kind] + wide)
