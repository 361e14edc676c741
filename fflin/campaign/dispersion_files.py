"""Dispersions from a TOML file."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fflin.base.errors import FflinError, InputError, unknown
from fflin.base.names import stands_for_any
from fflin.base.toml_file import TomlFile
from fflin.base.writing import as_path
from fflin.robot.input_files import is_number

_TABLE = "dispersions"
_FORMS = ("normal", "uniform", "values", "distribution")
_EXPECTED = (
    "a number (a standard deviation), {uniform = [least, largest]}, {values = [a, b, ...]} or "
    '{distribution = "NAME", ...}'
)


class DispersionFile(dict[str, Any]):
    """{name, group or pattern: spread} of a file, and the lines on which they stand."""

    document: TomlFile


@contextmanager
def placed(dispersions: Any) -> Iterator[None]:
    """Put file and line of the spread that something is wrong about in front of it."""
    try:
        yield
    except FflinError as error:
        if not isinstance(dispersions, DispersionFile):
            raise
        quoted, file = re.findall(r"'([^']*)'", str(error)), dispersions.document
        keys = [k for name in quoted for k in dispersions if name in (k, k.rpartition(".")[0])]
        names = [*quoted, *(name.rpartition(".")[0] for name in quoted)]
        keys += [key for key in dispersions if stands_for_any(key, names)]
        raise type(error)(f"{file.path}:{file.line(_TABLE, *keys[:1])}: {error}") from None


def load_dispersions(path: str | Path) -> dict[str, Any]:
    """Read the dispersions of `monte_carlo` from a TOML file.

    The file has one table ``[dispersions]`` of names, groups or patterns, each with its spread:

    ==========================================  ==================================================
    ``0.05`` or ``{normal = 0.05}``             normal about 0 with this standard deviation
    ``{uniform = [-0.1, 0.2]}``                 uniform between least and largest value
    ``{values = [0, 10, 20]}``                  one of these values, all equally likely
    ``{distribution = "triang", c = 0.5}``      distribution of scipy.stats by its name, with its
                                                shape parameters, ``loc`` and ``scale``
    ``{normal = 0.05, tied = true}``            one draw for all names of a pattern or group
    ==========================================  ==================================================

    Values are in the SI units of the state, input or joint, see `monte_carlo`.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    dict
        {name: spread}, as `monte_carlo` takes it. If `monte_carlo` refuses a name or spread, its
        message names file and line.

    Raises
    ------
    FileError
        If the path is not a regular file, or the file cannot be read or is too large.
    UnknownNameError
        If a table, kind of spread, distribution or parameter is unknown; with file and line.
    InputError
        If the file is not TOML or a value is wrong; with file and line.

    Examples
    --------
    >>> from pathlib import Path
    >>> _ = Path("uncertain.toml").write_text("dispersions.q_b = {uniform = [-0.1, 0.1]}")
    >>> fflin.load_dispersions("uncertain.toml").keys()
    dict_keys(['q_b'])
    """
    try:
        document = TomlFile(as_path(path))
    except InputError as error:  # q_b = 1 and q_b.sensor = 1 are a number and a table
        hint = '; names with dots stand in quotes, "q_b.sensor"' * ("overwrite" in str(error))
        raise InputError(f"{error}{hint}") from None
    table = document.record.get(_TABLE)
    for key in (*document.record, _TABLE):
        if key != _TABLE or not isinstance(table, dict) or not table:
            problem = unknown("table", key, [_TABLE]) if key != _TABLE else "contains no spreads"
            raise document.unknown(f"{problem}; write [{_TABLE}] and below it q_b = 0.05", key)
    found = DispersionFile()
    found.document = document
    for name, value in _names(table or {}):
        try:
            found[name] = _spread(value)
        except FflinError as error:
            line = document.line(_TABLE, name)
            raise type(error)(f"{document.path}:{line}: '{name}': {error}") from None
    return found


def _names(table: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (name, spread); ``base.mass = 0.1`` is the name "base.mass"."""
    for key, value in table.items():
        if isinstance(value, dict) and value and not {*value} & {*_FORMS}:
            yield from _names(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value


def _spread(value: Any) -> Any:
    table: dict[str, Any] = dict(value) if isinstance(value, dict) else {"normal": value}
    if "tied" in table:
        tied = table.pop("tied")
        return {"range": _spread(table), "tied": tied}
    if isinstance(table.get("distribution"), str):
        return _distribution(**table)
    (form, given), *others = table.items() or [("", None)]
    entries = given if isinstance(given, list) and form in ("uniform", "values") else [given]
    right = {"normal": given is not entries, "uniform": len(entries) == 2, "values": given}
    if not others and all(map(is_number, entries)) and right.get(form):
        return tuple(entries) if form == "uniform" else given
    raise InputError(f"{reprlib.repr(value)} is not a spread, expected {_EXPECTED}")


def _distribution(distribution: str, **given: Any) -> Any:
    from scipy import stats

    kinds = stats.rv_continuous, stats.rv_discrete
    known = [each for each in dir(stats) if isinstance(getattr(stats, each), kinds)]
    if distribution not in known:
        raise unknown("distribution of scipy.stats", distribution, known)
    kind = getattr(stats, distribution)
    try:
        for key, value in given.items():
            if not is_number(value):
                raise ValueError(f"has {key} = {reprlib.repr(value)}, expected a finite number")
        frozen = kind(**given)
        if abs(float(frozen.ppf(0.5))) < 1e100:
            return frozen
        problem = f"is not defined for {', '.join(f'{key} = {x:g}' for key, x in given.items())}"
    except (TypeError, ValueError) as error:
        problem = str(error).partition("() ")[2] or str(error)
    shapes = f"{kind.shapes}, " if kind.shapes else ""
    raise InputError(
        f"distribution {distribution} {problem}; its parameters are {shapes}loc, scale"
    )
