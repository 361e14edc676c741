"""What is drawn at random, from a TOML file."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fflin.base.errors import FflinError, InputError, UnknownNameError, unknown
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

    def __init__(self, spreads: Mapping[str, Any], document: TomlFile) -> None:
        super().__init__(spreads)
        self._document = document

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)  # a worker has nobody to tell a line

    def placed(self, error: FflinError) -> FflinError:
        """Return the error with file and line of the spread that it is about in front of it."""
        quoted = re.findall(r"'([^']*)'", str(error))
        names = [*quoted, *(name.rpartition(".")[0] for name in quoted)]
        ways = {key: {key, key.rpartition(".")[0] or key} for key in self}
        found = [key for key in self if key in quoted]
        found += [key for key in self if ways[key] & {*quoted[:1]}]
        found += [key for key in self if any(stands_for_any(x, names) for x in ways[key])]
        line = self._document.line(_TABLE, *found[:1])
        return type(error)(f"{self._document.path}:{line}: {error}")


@contextmanager
def placed(dispersions: Any) -> Iterator[None]:
    """Say where in its file a spread stands that something is wrong about."""
    try:
        yield
    except FflinError as error:
        if not isinstance(dispersions, DispersionFile):
            raise
        raise dispersions.placed(error) from None


def load_dispersions(path: str | Path) -> dict[str, Any]:
    """Read what `monte_carlo` draws at random from a TOML file.

    The file is one table ``[dispersions]`` of names, groups or patterns, each with its spread:

    ==========================================  ==================================================
    ``0.05`` or ``{normal = 0.05}``             standard deviation of a normal one about 0
    ``{uniform = [-0.1, 0.2]}``                 least and largest
    ``{values = [0, 10, 20]}``                  each as likely
    ``{distribution = "triang", c = 0.5}``      one of scipy.stats by its name, with its shapes,
                                                ``loc`` and ``scale``
    ==========================================  ==================================================

    Units are those of the state, input or joint, SI, as `monte_carlo` says.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    dict
        {name: spread}, as `monte_carlo` takes it; what that finds wrong of a name or spread is
        said with file and line.

    Raises
    ------
    FileError
        If it is not a regular file that can be read, or too large.
    UnknownNameError
        If there is no such table, kind of spread, distribution or parameter; with file and line.
    InputError
        If the file is not TOML or a value is wrong; with file and line.
    """
    document = TomlFile(as_path(path))
    for key in document.record:
        if key != _TABLE:
            raise document.unknown(f"{unknown('table', key, [_TABLE])}; write [{_TABLE}]", key)
    table = document.record.get(_TABLE, {})
    if not isinstance(table, dict) or not table:
        raise document.error(f"holds no spreads; write [{_TABLE}] and below it q_b = 0.05", _TABLE)
    return DispersionFile(dict(_spreads(document, table)), document)


def _spreads(document: TomlFile, table: Any, *way: str) -> Iterator[tuple[str, Any]]:
    """Yield (name, spread); ``base.mass = 0.1`` is the name "base.mass"."""
    for key, value in table.items():
        place = (*way, key)
        if isinstance(value, dict) and value and not {*value} & {*_FORMS}:
            yield from _spreads(document, value, *place)
            continue
        try:
            yield ".".join(place), _spread(key, value, bool(way))
        except UnknownNameError as error:
            raise document.unknown(error, _TABLE, *place) from None
        except InputError as error:
            said = f"'{'.'.join(place)}' {error}"
            raise document.error(said, _TABLE, *place) from None


def _spread(key: str, value: Any, below: bool) -> Any:
    if is_number(value):
        return value
    if not isinstance(value, dict):
        if below and isinstance(value, list):  # of a table whose only key is none of these
            raise unknown("kind of spread", key, _FORMS)
        raise InputError(f"is {reprlib.repr(value)}, expected {_EXPECTED}")
    form = next((form for form in _FORMS if form in value), "")
    given = value.get(form)
    others = [each for each in value if each != form]
    if form == "distribution":
        return _distribution(given, {each: value[each] for each in others})
    if others:
        raise unknown("key of a spread", others[0], [form])
    if form == "normal" and is_number(given):
        return given
    if form == "uniform" and _numbers(given) and len(given) == 2 and given[0] <= given[1]:
        return tuple(given)
    if form == "values" and _numbers(given) and given:
        return given
    raise InputError(f"is {reprlib.repr(value)}, expected {_EXPECTED}")


def _numbers(value: Any) -> bool:
    return isinstance(value, list) and all(map(is_number, value))


def _distribution(name: Any, given: dict[str, Any]) -> Any:
    from scipy import stats

    kinds = stats.rv_continuous | stats.rv_discrete
    known = [each for each in dir(stats) if isinstance(getattr(stats, each), kinds)]
    if name not in known:
        raise unknown("distribution of scipy.stats", name, known)
    distribution = getattr(stats, name)
    shapes = [each.strip() for each in (distribution.shapes or "").split(",") if each.strip()]
    scale = ["scale"] * isinstance(distribution, stats.rv_continuous)
    for key, value in given.items():
        if key not in (*shapes, "loc", *scale):
            raise unknown(f"parameter of {name}", key, [*shapes, "loc", *scale])
        if not is_number(value):
            raise InputError(f"has {key} = {reprlib.repr(value)}, expected a number")
    if missing := [each for each in shapes if each not in given]:
        raise InputError(f"is distributed by {name}, which needs {', '.join(missing)}; give it")
    frozen = distribution(**given)
    if not abs(frozen.ppf(0.5)) < 1e100:
        said = ", ".join(f"{key} = {value:g}" for key, value in given.items())
        raise InputError(f"has {said}, of which {name} is no distribution")
    return frozen
