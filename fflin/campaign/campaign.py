"""The record of a campaign: how its runs ended, with statistics that say how sure they are."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.base import intervals
from fflin.base.errors import InputError, unknown
from fflin.base.frozen import FrozenArrays
from fflin.base.intervals import Estimate
from fflin.base.record import reading
from fflin.base.validation import Array, share, whole
from fflin.base.writing import as_path
from fflin.batch.files import read_rows, write_rows
from fflin.campaign.conditions import Bound, bounds_of
from fflin.campaign.report import campaign_report
from fflin.campaign.spreads import SEED
from fflin.campaign.tally import KINDS

if TYPE_CHECKING:
    from fflin.campaign.runs import CampaignJob
    from fflin.simulation.motion import Motion

NOT_RUN = -1.0  # where `stop` is this, a file has no run


@dataclass(frozen=True, eq=False, repr=False)
class Campaign(FrozenArrays):
    """The runs of `monte_carlo`, N of them.

    What can be asked about by name: the error at last of each kind, ``attitude`` [deg],
    ``position`` [m], ``joints``, ``turning`` (omega_b), ``moving`` (v_b), ``rates``; a state or an
    input, with its sign, at last; ``worst NAME`` for the largest of the whole run, of the error
    where NAME is a state; ``settle`` [s] or ``settle KIND``, since when the error stays within 2 %
    of its largest; ``end`` [s]; and ``drawn NAME``. Errors are largest entries, from the target, or
    from the start where there is none. A run that was stopped early is beyond every bound: its
    errors, worst values and settling are infinite, and it meets no condition.

    Attributes
    ----------
    drawn : ndarray (N, k)
        What was drawn, its `names` (k,).
    q, v, x, u : ndarray (N, ..)
        At last; of a run that diverged, the last that was finite.
    largest_x, largest_u : ndarray (N, nx), (N, nu)
        Largest errors of the states and largest inputs, without sign, as far as each run went.
    errors, largest, settle : ndarray (N, 6)
        Of each kind, at last, at most, and since when [s], infinite where it is not settled.
    times : tuple of float
        [s], when the histories have their rows; none unless they were asked for.
    error_history, input_history : ndarray (N, M, 6), (N, M, nu)
        Errors of each kind, and commands, at each of these times; of a run that was stopped
        infinite, and zero, from then on.
    stop, end : ndarray (N,)
        0 where a run came to its end, 1 where it diverged, 2 where it left the chart, 3 else; and
        when [s].
    asked : int
        How many runs were asked for; more than there are where `until` was met before.
    goals : tuple of str
        The conditions that report and figure tell the shares of.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    >>> runs = fflin.monte_carlo(robot, policy, {"q_b": 0.02}, runs=8, duration=5.0, dt=0.05)
    >>> len(runs), runs.quantile("attitude", 0.5).value < 10
    (8, True)
    >>> float(runs.replay(runs.worst(1)[0]).t[-1])
    5.0
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
    error_history: Array
    input_history: Array
    stop: Array
    end: Array
    names: tuple[str, ...]
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    input_limits: tuple[float, ...]  # largest magnitudes that act, infinite where there are none
    times: tuple[float, ...]
    judged: tuple[str, ...]  # the kinds that are steered
    robot: str
    urdf_sha256: str
    duration: float
    dt: float
    seed: int
    asked: int
    engine: str
    goals: tuple[str, ...]
    confidence: float
    _job: CampaignJob | None = field(default=None, kw_only=True)

    def __len__(self) -> int:
        return len(self.stop)

    def __repr__(self) -> str:
        lost = int(self.stopped.sum())
        return f"Campaign('{self.robot}', {len(self)} runs of {self.duration:g} s, {lost} stopped)"

    def __str__(self) -> str:
        return campaign_report(self)

    @property
    def stopped(self) -> Any:
        """Whether each run (N,) was stopped before its end."""
        return self.stop != 0.0

    @property
    def about(self) -> str:
        """The figure that is asked about by default.

        What the first goal bounds from above, or the worst error of what is steered first.
        """
        bounded = [each.name for each in self.bounds if each.sign[0] == "<"]
        return [*bounded, f"worst {(self.judged or tuple(KINDS))[0]}"][0]

    @property
    def bounds(self) -> list[Bound]:
        """What the goals compare."""
        return [each for goal in self.goals for each in bounds_of(goal, self.figure)]

    def values(self, name: str) -> Array:
        """Return a figure of each run (N,) by its name, in SI units but for angles in deg."""
        return self.figure(name)[0]

    def figure(self, name: str) -> tuple[Array, str]:
        """Return a figure of each run (N,), and its unit."""
        if name == "end":
            return self.end, "s"
        if name == "settle":
            at = [list(KINDS).index(kind) for kind in self.judged]
            return self.settle[:, at].max(axis=1, initial=0.0), "s"
        of, _, rest = name.partition(" ")
        of, rest = (of, rest) if of in ("worst", "settle", "drawn") else ("final", name)
        states, inputs = (
            (self.state_names, self.state_units),
            (self.input_names, self.input_units),
        )
        kinds = tuple(KINDS), tuple(KINDS.values())
        groups: list[tuple[Any, Any, Array]] = {
            "final": [(*kinds, self._beyond(self.errors)), (*states, self.x), (*inputs, self.u)],
            "worst": [
                (*kinds, self._beyond(self.largest)),
                (*states, self._beyond(self.largest_x)),
                (*inputs, self._beyond(self.largest_u)),
            ],
            "settle": [(kinds[0], ("s",) * len(KINDS), self.settle)],
            "drawn": [(self.names, ("",) * len(self.names), self.drawn)],
        }[of]
        for names, units, arrays in groups:
            if rest in names:
                return arrays[:, names.index(rest)], units[names.index(rest)]
        raise unknown("figure", rest, [each for names, *_ in groups for each in names])

    def _beyond(self, sizes: Array) -> Array:
        return np.where(self.stopped[:, None], np.inf, sizes)

    def met(self, condition: Any) -> Any:
        """Return which runs (N,) meet a condition.

        Parameters
        ----------
        condition : str or array_like of bool (N,)
            ``NAME < NUMBER UNIT``, also <=, > and >=, several joined by ``and``; no unit is the
            figure's own. A run that was stopped meets no text.
        """
        if not isinstance(condition, str):
            found = np.asarray(condition if isinstance(condition, np.ndarray | list) else None)
            if found.shape != (len(self),) or found.dtype != bool:
                raise InputError(
                    f"condition has shape {found.shape} of {found.dtype}, expected a text such as "
                    f"'attitude < 1 deg', or ({len(self)},) True or False"
                )
            return found
        met = ~self.stopped
        for bound in bounds_of(condition, self.figure):
            met = met & bound.met
        return met

    def fraction(self, condition: Any, *, confidence: float = 0.95) -> Estimate:
        """Return the share of runs that meet a condition, with Clopper and Pearson's interval."""
        met, sure = int(self.met(condition).sum()), share("confidence", confidence)
        return intervals.clopper_pearson(met, len(self), sure)

    def quantile(self, name: str, p: float, *, confidence: float = 0.95) -> Estimate:
        """Return the value below which a figure is in a share p of the runs, with its interval.

        The interval is one of order statistics: it holds whatever the distribution is. A final
        state or input has a sign, and is of the runs that came to their end.
        """
        values = self.values(name)
        if name in (*self.state_names, *self.input_names):
            values = values[~self.stopped]
        return intervals.quantile(values, share("p", p), share("confidence", confidence))

    def mean(self, name: str, *, confidence: float = 0.95) -> Estimate:
        """Return the mean of a figure over runs that came to their end, with Student's interval.

        Raises
        ------
        InputError
            If it is infinite in some of these, as is the settling of what did not settle.
        """
        values = self.values(name)[~self.stopped]
        if endless := int(np.isinf(values).sum()):
            raise InputError(
                f"{name!r} is infinite in {endless} of {len(values)} runs that came to their end; "
                "ask for a fraction or a quantile"
            )
        return intervals.mean(values, share("confidence", confidence))

    def worst(self, k: int = 5, name: str | None = None) -> list[int]:
        """Return the numbers of the k runs with the largest figure, `about` by default.

        Runs that were stopped go before all others, the earliest first.
        """
        order = np.lexsort(
            (-self.values(name or self.about), np.where(self.stopped, self.end, np.inf))
        )
        return [int(run) for run in order[: whole("k", k, 1)]]

    def sensitivity(self, name: str | None = None) -> dict[str, float]:
        """Return {what is drawn: Spearman's rank correlation with a figure}, the largest first.

        Of what is drawn or, under ``|NAME|``, how far that is from its median, whichever tells
        more: errors grow to both sides of an attitude. The figure is `about` by default.
        """
        figure = self.values(name or self.about)
        apart = np.abs(self.drawn - np.median(self.drawn, axis=0))
        signed, sized = (intervals.rank_correlations(x, figure) for x in (self.drawn, apart))
        found = {
            f"|{key}|" if abs(size) > abs(value) else key: max(value, size, key=abs)
            for key, value, size in zip(self.names, signed.tolist(), sized.tolist(), strict=True)
            if key != SEED
        }
        return dict(sorted(found.items(), key=lambda pair: -abs(pair[1])))

    def replay(self, run: int) -> Motion:
        """Return the motion of a run.

        Its q, v and u are those of the run bit for bit. Its x is read from q and v by other code:
        it is that of the run to machine precision, continuous joints but for full turns.

        Raises
        ------
        InputError
            If there is no such run, or the campaign is from a file.
        """
        at = whole("run", run, 0, len(self) - 1)
        return self._flown().replay(np.array(self.drawn[at]))

    def courses(self, runs: Sequence[int], most: int) -> list[Array]:
        """Return configurations (at most `most` + 1, nq) on the way of some runs, evenly apart."""
        return self._flown().courses(np.array(self.drawn[list(runs)]), most)

    def _flown(self) -> CampaignJob:
        if self._job is None:
            raise InputError(
                "the campaign is from a file, without its robot and policy; make the same call of "
                "monte_carlo and replay its run: the same seed draws the same"
            )
        return self._job

    def save(self, path: str | Path) -> None:
        """Write it to a .npz or .h5 file, whole or not at all."""
        self._save(as_path(path))

    def _save(self, path: Path, **texts: str) -> None:
        """Write it with more texts, such as the request that `monte_carlo` knows its call by."""
        arrays = {key: np.ascontiguousarray(getattr(self, key)) for key in _ARRAYS}
        rest = {key: getattr(self, key) for key in _HEADER}
        texts["header"] = json.dumps({"kind": "Campaign", **rest})
        write_rows(path, arrays, texts, sealed=True)

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
            header = json.loads(texts["header"])
            if header["kind"] != "Campaign":
                raise ValueError(f"it is a {header['kind']}")
            return cls.of(arrays, header)

    @classmethod
    def of(cls, arrays: Mapping[str, Array], header: Any, job: Any = None) -> Campaign:
        """Put one together of arrays, less the rows that were not run, and the rest."""
        run = np.asarray(arrays["stop"]) != NOT_RUN
        values: dict[str, Any] = {
            key: arrays[key] if run.all() else arrays[key][run] for key in _ARRAYS
        }
        for key in _HEADER:
            values[key] = tuple(header[key]) if isinstance(header[key], list) else header[key]
        return cls(**values, _job=job)


_NAMES = [item.name for item in fields(Campaign)]
_ARRAYS, _HEADER = _NAMES[: _NAMES.index("names")], _NAMES[_NAMES.index("names") : -1]
