"""The record of a campaign: how its runs ended, with statistics that say how sure they are."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.base import intervals
from fflin.base.errors import InputError, unknown
from fflin.base.frozen import FrozenArrays
from fflin.base.intervals import Estimate
from fflin.base.record import reading
from fflin.base.tables import folded, grid
from fflin.base.validation import Array, number, whole
from fflin.base.writing import as_path
from fflin.batch.files import read_rows, write_rows
from fflin.campaign.tally import KINDS, STOPS

if TYPE_CHECKING:
    from fflin.campaign.runs import CampaignJob
    from fflin.simulation.motion import Motion

_ARRAYS = ("drawn", "q", "v", "x", "u", "largest_x", "largest_u", "errors", "largest", "settle")
_ONE_EACH = ("stop", "end")
_COMPARED = re.compile(r"\s*(.+?)\s*(<=|>=|<|>)\s*([-+.\deE]+)\s*(.*?)\s*")
_UNITS = {"deg": ("rad", math.pi / 180.0), "mm": ("m", 1e-3), "cm": ("m", 1e-2)}
_UNITS |= {"deg/s": ("rad/s", math.pi / 180.0), "mm/s": ("m/s", 1e-3), "ms": ("s", 1e-3)}
NOT_RUN = -1.0  # where `stop` is this, a file has no run


@dataclass(frozen=True, eq=False, repr=False)
class Campaign(FrozenArrays):
    """The runs of `monte_carlo`, N of them.

    What can be asked about by name: the errors at last of each kind, ``attitude`` [deg],
    ``position`` [m], ``joints``, ``turning`` (omega_b), ``moving`` (v_b), ``rates``; a state or an
    input, with its sign, at last; ``worst NAME`` for the largest of the whole run, of the error
    where NAME is a state; ``settle`` [s] or ``settle KIND``, since when the error stays within 2 %
    of its largest; ``end`` [s]; and ``drawn NAME``, what was drawn. Errors are largest entries, from
    the target, or from the start where there is none. A run that was stopped early is beyond every
    bound: its errors, worst values and settling are infinite, and it meets no condition.

    Attributes
    ----------
    drawn : ndarray (N, k)
        What was drawn, its `names` (k,).
    q, v, x, u : ndarray (N, ..)
        At last: of a run that diverged, the last that was finite.
    largest_x, largest_u : ndarray (N, nx), (N, nu)
        Largest errors of the states and largest inputs, without sign, as far as each run went.
    errors, largest, settle : ndarray (N, 6)
        Of each kind, at last, at most, and since when [s], infinite where it is not settled.
    stop : ndarray (N,)
        0 where a run came to its end, 1 where it diverged, 2 where it left the chart, 3 else.
    end : ndarray (N,)
        When [s].
    asked : int
        How many runs were asked for; fewer where `until` was met before.
    """

    drawn: Array
    q: Array
    v: Array
    x: Array
    u: Array
    largest_x: Array
    largest_u: Array
    errors: Array
    largest: Array
    settle: Array
    stop: Array
    end: Array
    names: tuple[str, ...]
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    judged: tuple[str, ...]  # the kinds that are steered
    robot: str
    urdf_sha256: str
    duration: float
    dt: float
    seed: int
    asked: int
    engine: str
    _job: CampaignJob | None = field(default=None, kw_only=True)

    def __len__(self) -> int:
        return len(self.stop)

    def __repr__(self) -> str:
        lost = int(self.stopped.sum())
        return f"Campaign('{self.robot}', {len(self)} runs of {self.duration:g} s, {lost} stopped)"

    def __str__(self) -> str:
        by = ", compiled" if self.engine == "compiled" else ""
        few = f", of {self.asked:,} asked for" if len(self) < self.asked else ""
        lines = [
            f"{self.robot}: {len(self):,} runs of {self.duration:g} s{few}, seed {self.seed}{by}"
        ]
        counts = [f"{int((self.stop == k).sum()):,} {STOPS[k]}" for k in (1, 2, 3)]
        ended = int((~self.stopped).sum())
        said = ", ".join(each for each in counts if each[0] != "0") or "none was stopped"
        lines.append(f"{ended:,} came to their end; {said}")
        rows = [["error", "unit", "half", "95 %", "99 %", "worst 95 %", "settled after [s]"]]
        for name, unit in KINDS.items():
            figures = [self.quantile(name, p).value for p in (0.5, 0.95, 0.99)]
            figures += [self.quantile(f"{of} {name}", 0.95).value for of in ("worst", "settle")]
            rows.append([name, unit, *(f"{x:.3g}" for x in figures)])
        parts = [folded(lines), "", grid(rows, "ll"), ""]
        about = [f"worst {kind}" for kind in self.judged[:2]] or ["worst attitude"]
        told, doubt = [], 3.0 / math.sqrt(len(self))  # of what is drawn alike by chance
        for name in about:
            found = [item for item in self.sensitivity(name).items() if abs(item[1]) > doubt]
            first = ", ".join(f"{key}\u00a0{value:+.2f}" for key, value in found[:4])
            told.append(f"{name} goes with (rank correlation): {first or 'nothing that is told'}")
        return "\n".join([*parts, folded(told)])

    @property
    def stopped(self) -> Array:
        """Whether each run (N,) was stopped before its end."""
        found: Array = self.stop != 0.0
        return found

    def values(self, name: str) -> Array:
        """Return a figure of each run (N,) by its name, in SI units but for angles in deg."""
        return self._named(name)[0]

    def _named(self, name: str) -> tuple[Array, str]:
        """Return a figure of each run, and its unit."""
        of, _, rest = name.partition(" ")
        of, rest = (of, rest) if of in ("worst", "settle", "drawn", "final") else ("final", name)
        if name in ("settle", "end"):
            at = [list(KINDS).index(kind) for kind in self.judged]
            found = self.end if name == "end" else self.settle[:, at].max(axis=1, initial=0.0)
            return found, "s"
        groups: dict[str, list[tuple[Any, Any, Any]]] = {
            "final": [
                (tuple(KINDS), tuple(KINDS.values()), self._beyond(self.errors)),
                (self.state_names, self.state_units, self.x),
                (self.input_names, self.input_units, self.u),
            ],
            "worst": [
                (tuple(KINDS), tuple(KINDS.values()), self._beyond(self.largest)),
                (self.state_names, self.state_units, self._beyond(self.largest_x)),
                (self.input_names, self.input_units, self._beyond(self.largest_u)),
            ],
            "settle": [(tuple(KINDS), ("s",) * len(KINDS), self.settle)],
            "drawn": [(self.names, ("",) * len(self.names), self.drawn)],
        }
        for names, units, arrays in groups[of]:
            if rest in names:
                at = names.index(rest)
                return arrays[:, at], units[at]
        known = [each for names, *_ in groups[of] for each in names]
        raise unknown(f"figure '{of} ...'" if of != "final" else "figure", rest, known)

    def _beyond(self, sizes: Array) -> Array:
        return np.where(self.stopped[:, None], np.inf, sizes)

    def met(self, condition: str | Array) -> Array:
        """Return which runs (N,) meet a condition.

        Parameters
        ----------
        condition : str or array_like of bool (N,)
            ``NAME < NUMBER UNIT``, also <=, > and >=, several joined by ``and``; no unit takes the
            figure's own. A run that was stopped meets no text.
        """
        if not isinstance(condition, str):
            found = np.asarray(condition)
            if found.shape != (len(self),) or found.dtype != bool:
                raise InputError(
                    f"condition has shape {found.shape} of {found.dtype}, expected a text such as "
                    f"'attitude < 1 deg', or ({len(self)},) True or False"
                )
            return found
        met = ~self.stopped
        for part in condition.split(" and "):
            match = _COMPARED.fullmatch(part)
            try:
                name, sign, bound, unit = match.groups() if match else ("", "", "", "")
                limit = float(bound)
            except ValueError:
                raise InputError(
                    f"condition is {part!r}, expected NAME < NUMBER UNIT, such as "
                    "'attitude < 1 deg'"
                ) from None
            values, own = self._named(name)
            limit *= _factor(part, unit, own)
            compare = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal}
            met = met & compare[sign](values, limit)
        return met

    def fraction(self, condition: str | Array, *, confidence: float = 0.95) -> Estimate:
        """Return the share of runs that meet a condition, with Clopper and Pearson's interval."""
        met = int(self.met(condition).sum())
        return intervals.clopper_pearson(met, len(self), _share("confidence", confidence))

    def quantile(self, name: str, p: float, *, confidence: float = 0.95) -> Estimate:
        """Return the value below which a figure is in a share p of the runs, with its interval.

        The interval is one of order statistics: it holds whatever the distribution is. A final
        state or input has a sign, and is of the runs that came to their end.
        """
        sure = _share("confidence", confidence)
        return intervals.quantile(self._of_all(name), _share("p", p), sure)

    def mean(self, name: str, *, confidence: float = 0.95) -> Estimate:
        """Return the mean of a figure over the runs that came to their end, with its interval."""
        values = self.values(name)[~self.stopped]
        values = values[np.isfinite(values)]
        if not len(values):
            raise InputError(f"no run came to its end with a finite {name}; there is no mean")
        return intervals.mean(values, _share("confidence", confidence))

    def _of_all(self, name: str) -> Array:
        values = self.values(name)
        if name in (*self.state_names, *self.input_names):
            values = values[~self.stopped]
        if not len(values):
            raise InputError(f"no run came to its end; there is no '{name}' to tell of")
        return values

    def worst(self, k: int = 5, name: str | None = None) -> list[int]:
        """Return the numbers of the k runs with the largest figure, the worst first.

        By default of the worst error of the first kind that is steered; runs that were stopped go
        before all others, the earliest first.
        """
        values = self.values(name or f"worst {(self.judged or tuple(KINDS))[0]}")
        order = np.lexsort((-values, np.where(self.stopped, self.end, np.inf)))
        return [int(run) for run in order[: whole("k", k, 1)]]

    def sensitivity(self, name: str | None = None) -> dict[str, float]:
        """Return {what is drawn: Spearman's rank correlation with a figure}, the largest first.

        Of what is drawn or, under ``|NAME|``, how far that is from its median, whichever tells
        more: errors grow to both sides of an attitude.
        """
        about = self.values(name or f"worst {(self.judged or tuple(KINDS))[0]}")
        apart = np.abs(self.drawn - np.median(self.drawn, axis=0))
        signed, sized = (intervals.rank_correlations(x, about) for x in (self.drawn, apart))
        found = {
            f"|{key}|" if abs(size) > abs(value) else key: max(value, size, key=abs)
            for key, value, size in zip(self.names, signed.tolist(), sized.tolist(), strict=True)
        }
        return dict(sorted(found.items(), key=lambda pair: -abs(pair[1])))

    def replay(self, run: int) -> Motion:
        """Return the motion of a run, which ends in the same state to the last bit.

        Raises
        ------
        InputError
            If there is no such run, or the campaign is from a file.
        """
        at = whole("run", run, 0, len(self) - 1)
        if self._job is None:
            raise InputError(
                "the campaign is from a file, without its robot and policy; make the same call of "
                "monte_carlo and replay its run: the same seed draws the same"
            )
        return self._job.replay(np.array(self.drawn[at]))

    def save(self, path: str | Path) -> None:
        """Write it to a .npz or .h5 file, whole or not at all."""
        arrays = {key: np.ascontiguousarray(getattr(self, key)) for key in (*_ARRAYS, *_ONE_EACH)}
        texts = {"header": json.dumps(self.header())}
        write_rows(as_path(path), arrays, texts, sealed=True)

    def header(self) -> dict[str, Any]:
        """Return all but the arrays and what made them."""
        arrays = {*_ARRAYS, *_ONE_EACH, "_job"}
        rest = [item.name for item in fields(self) if item.name not in arrays]
        return {"kind": "Campaign", **{name: getattr(self, name) for name in rest}}

    @classmethod
    def load(cls, path: str | Path) -> Campaign:
        """Read what `save` or `monte_carlo` wrote.

        Raises
        ------
        FileError
            If the file cannot be read, is damaged or is another thing.
        """
        source = as_path(path)
        with reading(source, "Campaign"):
            arrays, _, texts, _ = read_rows(source, verify=True)
            return cls.of(arrays, json.loads(texts["header"]))

    @classmethod
    def of(cls, arrays: Mapping[str, Array], header: Mapping[str, Any], job: Any = None) -> Campaign:
        """Put one together of arrays, of which rows that were not run are left out, and the rest."""
        if header["kind"] != "Campaign":
            raise ValueError(f"it is a {header['kind']}")
        run = np.asarray(arrays["stop"]) != NOT_RUN
        rows = {
            key: arrays[key] if run.all() else arrays[key][run] for key in (*_ARRAYS, *_ONE_EACH)
        }
        named = {item.name for item in fields(cls)} - {*rows, "_job"}
        values = {key: header[key] for key in named}
        texts = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return cls(**rows, **texts, _job=job)


def _factor(part: str, unit: str, own: str) -> float:
    """Return what takes a unit to a figure's own."""
    if unit in ("", own) or unit in own.split("|"):
        return 1.0
    to, factor = _UNITS.get(unit, ("", 0.0))
    if to == own or to in own.split("|"):
        return factor
    back, inverse = _UNITS.get(own, ("", 0.0))
    if back == unit:
        return 1.0 / inverse
    raise InputError(f"condition {part!r} is in {unit}, expected {own or 'no unit'}")


def _share(name: str, value: Any) -> float:
    share = number(name, value)
    if not 0.0 < share < 1.0:
        raise InputError(f"{name} is {share:g}, expected a share between 0 and 1")
    return share
