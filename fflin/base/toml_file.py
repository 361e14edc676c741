"""Reader of TOML files that gives the values, and the line number of each key."""

import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fflin.base.errors import FflinError, InputError
from fflin.base.names import stands_for_any
from fflin.base.writing import read_file

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

# Largest size of a file [bytes], enough for about 1,000 inputs.
_SIZE_LIMIT = 2**17

# The number of dots in a line is limited, because the time to parse a key grows with the square of
# its number of dots.
_DOTS_LIMIT = 1_000

# Matches strings and comments. Multi-line strings may contain lines that look like keys. One-line
# strings and comments are matched too, because a quote inside them does not begin a string.
_TEXTS = re.compile(
    r'"""(?:\\.|[^\\])*?"""+|\'\'\'.*?\'\'\'+|"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'|#[^\n]*',
    re.DOTALL,
)
_PART = r"""(?:[\w-]+|"[^"]*"|'[^']*')"""
_KEY = rf"({_PART}(?:\s*\.\s*{_PART})*)\s*"
_LINE = re.compile(rf"\s*(?:(\[\[?)\s*{_KEY}\]|{_KEY}=)")


def is_number(value: object) -> bool:
    """Return whether a TOML value is a number with a magnitude below 1e100."""
    # The limit keeps the norm of a vector of such numbers finite. It also excludes inf, nan, and
    # integers that are too large for a float.
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and abs(value) < 1e100
    )


class TomlFile:
    """Content of a TOML file, and the line of each key path, such as ("input", 3, "axis")."""

    def __init__(self, path: Path) -> None:
        self.path = path
        content = read_file(path, "TOML", _SIZE_LIMIT)
        try:
            text = content.decode("utf-8-sig").replace("\r\n", "\n")
            for number, written in enumerate(text.split("\n"), start=1):
                if written.count(".") > _DOTS_LIMIT:
                    raise ValueError(
                        f"more than {_DOTS_LIMIT} dots in one line (at line {number})"
                    )
            self.record: dict[str, Any] = tomllib.loads(text)
        except (ValueError, RecursionError) as error:
            place = re.search(r"at line (\d+)", str(error))
            # `start` is the index of the first byte that is not UTF-8.
            last = getattr(error, "start", len(content.rstrip()))
            line = place[1] if place else content.count(b"\n", 0, last) + 1
            message = f"{path}:{line}: invalid TOML: {error}; correct the file"
            raise InputError(message) from None
        # Multi-line strings are replaced by line breaks, which keeps the line numbers. One-line
        # strings stay, because they may be quoted keys.
        self._lines = _lines_of(
            _TEXTS.sub(lambda x: "\n" * x[0].count("\n") or x[0], text)
        )
        for key_path, value in _values(self.record):
            # Python refuses to convert very long integers to text, so a message could not show the
            # value.
            if type(value) is int and value.bit_length() > 10_000:
                raise self.error(
                    f"{key_path[-1]} has too many digits; write a number of this size in the form "
                    "1e30",
                    *key_path,
                )

    def line(self, *key_path: str | int) -> int:
        """Return the line number of a key; if the key is missing, return the line of its table."""
        dotted = ".".join(map(str, key_path))
        while dotted and dotted not in self._lines:
            dotted = dotted.rpartition(".")[0]
        return self._lines.get(dotted, 1)

    def error(self, problem: FflinError | str, *key_path: str | int) -> FflinError:
        """Build an error whose message begins with the file and the line of a key.

        The error has the type of `problem`, or is an `InputError` if `problem` is a text.
        """
        kind = type(problem) if isinstance(problem, FflinError) else InputError
        return kind(f"{self.path}:{self.line(*key_path)}: {problem}")

    @contextmanager
    def located(self, *table: str | int, of: str = "") -> Iterator[None]:
        """Put a location and the prefix `of` before the message of an error in a ``with`` block.

        The location is the file, and the line of the key in `table` that the message names. If the
        message names no key, it is the line of `table`.
        """
        try:
            yield
        except FflinError as error:
            key_path = self._named_in(str(error), *table)
            raise self.error(type(error)(f"{of}{error}"), *key_path) from None

    def _named_in(self, message: str, *table: str | int) -> tuple[str | int, ...]:
        """Return the path of the key of `table` to which a message refers.

        A message refers to a key if it contains the name of the key, the string value of the key,
        or a name that the key matches as a pattern. If the message refers to no key, return the
        path of `table`.
        """
        head = "".join(f"{part}." for part in table)
        keys = [key.removeprefix(head) for key in self._lines if key.startswith(head)]
        mentions = re.findall(r"'([^']+)'| (\S+) is ", message)
        names = [name for one, other in mentions if (name := one or other.strip("'"))]
        for name in names:
            for key_path, value in _values(self.record):
                if value == name and key_path[: len(table)] == table:
                    return key_path
            for key in keys:
                if f".{key}".endswith(f".{name}") or key.rpartition(".")[0] == name:
                    return *table, key
        names += [name.rpartition(".")[0] for name in names]
        return *table, *[key for key in keys if stands_for_any(key, names)][:1]


def toml_value(text: str) -> object:
    """Return the value of a TOML text; raise `ValueError` if the text is not valid."""
    record = tomllib.loads(f"value = {text}")
    if len(record) > 1:
        raise ValueError("more than one value")
    return record["value"]


def flat(table: object) -> object:
    """Flatten nested tables, so that ``{"a": {"b": 1}}`` becomes ``{"a.b": 1}``.

    A value that is not a table is returned unchanged.
    """
    while isinstance(table, dict) and any(
        isinstance(x, dict) and x for x in table.values()
    ):
        pairs = []
        for key, value in table.items():
            inner = value if isinstance(value, dict) and value else {"": value}
            for below, entry in inner.items():
                name = f"{key}.{below}" if below else key
                pairs.append((name, entry))
        table = dict(pairs)
    return table


def _values(
    record: Mapping[str, object],
) -> Iterator[tuple[tuple[str | int, ...], object]]:
    """Yield (key path, value) for all values that are neither tables nor arrays, at any depth."""
    left: list[tuple[tuple[str | int, ...], object]] = [((), record)]
    while left:
        key_path, value = left.pop()
        if isinstance(value, dict | list):
            pairs = value.items() if isinstance(value, dict) else enumerate(value)
            left += [((*key_path, key), inner) for key, inner in pairs]
        else:
            yield key_path, value


def _lines_of(text: str) -> dict[str, int]:
    """Return {dotted key: line number} of all tables and keys."""
    lines: dict[str, int] = {}
    counts: dict[str, int] = {}
    table = ""
    for number, line in enumerate(text.split("\n"), start=1):
        match = _LINE.match(line)
        if not match:
            continue
        brackets, header, key = match.groups()
        name = ".".join(part.strip("\"'") for part in re.findall(_PART, header or key))
        if brackets:
            first, _, below = name.partition(".")
            if brackets == "[[":
                counts[name] = counts.get(name, -1) + 1
                name = f"{name}.{counts[name]}"
            elif first in counts and below:  # a subtable of the last table of an array
                name = f"{first}.{counts[first]}.{below}"
            table = name
        else:
            name = f"{table}.{name}" if table else name
        # `a.b = 1` also defines the key `a` in this line.
        while name and name not in lines:
            lines[name] = number
            name = name.rpartition(".")[0]
    return lines
