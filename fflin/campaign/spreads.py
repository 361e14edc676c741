"""Spreads of random values, from Python or a TOML file, and inverse distribution functions."""

import reprlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np

from fflin.base.errors import FflinError, InputError, UnknownNameError, unknown
from fflin.base.toml_file import TomlFile, is_number
from fflin.base.validation import Array, number
from fflin.base.writing import as_path

Inverse: TypeAlias = Callable[[Array], Array]  # inverse distribution function

# name of the noise seed among the drawn values; its correlation is omitted
SEED = "noise"

_TABLE = "dispersions"
_FORMS = ("normal", "uniform", "values", "distribution")
_EXPECTED = (
    "a number (a standard deviation), {uniform = [least, largest]}, {values = [a, b, ...]} or "
    '{distribution = "NAME", ...}'
)


class DispersionFile(dict[str, object]):
    """Dispersions {name, group or pattern: spread} from a TOML file, with the parsed file."""

    document: TomlFile


def placed(dispersions: object) -> AbstractContextManager[None]:
    """Return a context manager that adds the file and line of a `DispersionFile` to errors."""
    if isinstance(dispersions, DispersionFile):
        return dispersions.document.located(_TABLE)
    return nullcontext()


def load_dispersions(path: str | Path) -> dict[str, object]:
    """Read the dispersions of `monte_carlo` from a TOML file.

    The file has one table ``[dispersions]``. Its keys are names, groups or patterns; each value is
    a spread in one of these forms:

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
        Mapping {name: spread} for the argument `dispersions` of `monte_carlo`. If a name or spread
        is not valid for the robot, `monte_carlo` raises an error that names the file and the line.

    Raises
    ------
    FileError
        If the path is not a regular file, or the file cannot be read or is too large.
    UnknownNameError
        If a table, kind of spread, distribution or parameter is unknown. The message names file
        and line.
    InputError
        If the file is not TOML or a value is wrong. The message names file and line.

    Examples
    --------
    >>> from pathlib import Path
    >>> _ = Path("uncertain.toml").write_text("dispersions.q_b = {uniform = [-0.1, 0.1]}")
    >>> fflin.load_dispersions("uncertain.toml").keys()
    dict_keys(['q_b'])
    """
    try:
        document = TomlFile(as_path(path))
    except InputError as error:  # for example, q_b = 1 and q_b.sensor = 1
        message = str(error)
        if "overwrite" in message:
            message += '; put names that contain dots in quotes, "q_b.sensor"'
        raise InputError(message) from None
    table = document.record.get(_TABLE)
    for key in (*document.record, _TABLE):
        if key != _TABLE or not isinstance(table, dict) or not table:
            problem = "contains no spreads"
            if key != _TABLE:
                kind = (
                    "table" if isinstance(document.record[key], dict | list) else "name"
                )
                problem = (
                    f"{kind} '{key}' is outside [{_TABLE}], the only table of this file"
                )
            problem = f"{problem}; write [{_TABLE}] and below it q_b = 0.05"
            raise document.error(UnknownNameError(problem), key)
    dispersions = DispersionFile()
    dispersions.document = document
    for name, value in _names(table or {}):
        try:
            dispersions[name] = _spread(value)
        except FflinError as error:
            raise document.error(
                type(error)(f"'{name}': {error}"), _TABLE, name
            ) from None
    return dispersions


def _names(
    table: Mapping[str, object], before: str = ""
) -> Iterator[tuple[str, object]]:
    """Yield (name, spread) for each entry of a table.

    The entry ``mass`` of a nested table ``base`` has the name "base.mass".
    """
    for key, value in table.items():
        if isinstance(value, dict) and value and not {*value} & {*_FORMS}:
            yield from _names(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value


def _spread(value: object) -> object:
    table: dict[str, object] = (
        dict(value) if isinstance(value, dict) else {"normal": value}
    )
    if "tied" in table:
        tied = table.pop("tied")
        return {"range": _spread(table), "tied": tied}
    if isinstance(name := table.get("distribution"), str):
        return _distribution(
            name, {k: x for k, x in table.items() if k != "distribution"}
        )
    (form, given), *others = table.items() or [("", None)]
    entries = [given]
    if isinstance(given, list) and form in ("uniform", "values"):
        entries = given
    right = {
        "normal": given is not entries,
        "uniform": len(entries) == 2,
        "values": given,
    }
    if not others and all(map(is_number, entries)) and right.get(form):
        if form == "uniform":
            return tuple(entries)
        return given
    raise InputError(f"{reprlib.repr(value)} is not a dispersion, expected {_EXPECTED}")


# Distributions of the Kolmogorov-Smirnov statistic, whose `ppf` takes minutes for large samples
# and cannot be interrupted. The limit is the largest sample size n.
_SLOW = ("ksone", "kstwo")
_LARGEST_SAMPLE = 1000


def _distribution(distribution: str, given: Mapping[str, object]) -> object:
    from scipy import stats

    kinds = stats.rv_continuous, stats.rv_discrete
    known = [name for name in dir(stats) if isinstance(getattr(stats, name), kinds)]
    if distribution not in known:
        raise unknown("distribution of scipy.stats", distribution, known)
    kind = getattr(stats, distribution)
    try:
        for key, value in given.items():
            if not is_number(value):
                raise ValueError(
                    f"has {key} = {reprlib.repr(value)}, expected a finite number"
                )
        if distribution in _SLOW and number("n", given.get("n", 1)) > _LARGEST_SAMPLE:
            raise ValueError(
                f"has n = {given['n']}, expected at most {_LARGEST_SAMPLE}"
            )
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


def inverse_of(name: str, spread: object, *, fixed: bool = False) -> Inverse:
    """Return the inverse distribution function of a spread.

    A number is the standard deviation of a normal distribution; if `fixed` is true, the number
    itself is the value in all runs. For a distribution of scipy.stats, the method `ppf` is
    returned, which can be slow. For any other spread, a function of this module is returned as a
    `partial` object.
    """
    if hasattr(spread, "ppf"):
        try:
            middle = float(spread.ppf(0.5))
        except (
            Exception
        ):  # `ppf` may be the method of any object, and raise any exception
            middle = np.nan
        if not np.isfinite(middle):
            raise InputError(
                f"the distribution of '{name}' has no median; give a frozen distribution of "
                "scipy.stats"
            )
        inverse: Inverse = spread.ppf
        return inverse
    if isinstance(spread, tuple):
        bounds = [number(f"'{name}'", entry) for entry in spread]
        if len(bounds) != 2 or bounds[0] > bounds[1]:
            raise InputError(
                f"'{name}' is {spread!r}, expected bounds (least, largest) with least <= largest"
            )
        return partial(_uniform, bounds[0], bounds[1])
    if isinstance(spread, list | np.ndarray):
        values = [number(f"'{name}'", entry) for entry in np.ravel(spread).tolist()]
        if not values:
            raise InputError(
                f"the list of values of '{name}' is empty; give at least one value"
            )
        return partial(_choice, np.array(values))
    deviation = number(f"'{name}'", spread)
    if deviation < 0.0:
        raise InputError(
            f"'{name}' is {deviation:g}, expected a standard deviation of at least 0"
        )
    if fixed:
        return partial(_choice, np.array([deviation]))
    return partial(_normal, deviation)


def _uniform(least: float, largest: float, u: Array) -> Array:
    return least + (largest - least) * u


def _choice(values: Array, u: Array) -> Array:
    chosen: Array = values[(u * len(values)).astype(int)]
    return chosen


def _normal(deviation: float, u: Array) -> Array:
    from scipy.special import ndtri

    normal: Array = deviation * ndtri(u)
    return normal


# Inverse distribution function of the noise seeds. The seeds are whole numbers below 2^53, because
# the uniform values of NumPy are multiples of 2^-53.
SEEDS: Inverse = partial(np.multiply, 2.0**53)
