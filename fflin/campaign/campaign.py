"""Campaign: outcomes of Monte Carlo runs, and statistics with confidence intervals."""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fflin.base import intervals
from fflin.base.errors import FflinWarning, InputError, unknown
from fflin.base.intervals import Estimate
from fflin.base.record import CODECS, reading
from fflin.base.tables import data_frame
from fflin.base.validation import (
    Array,
    FrozenArrays,
    Mask,
    dimension,
    instance,
    share,
    whole,
)
from fflin.base.writing import as_path, write_atomically
from fflin.batch.files import read_rows, write_rows
from fflin.campaign.pointing import campaign_pointing
from fflin.campaign.report import campaign_card, campaign_report
from fflin.campaign.runs import KINDS, MODES, kind_named
from fflin.campaign.spreads import SEED
from fflin.linear.files import labels, write_table
from fflin.simulation.report import WHEEL_SPEEDS

if TYPE_CHECKING:
    from pandas import DataFrame

    from fflin.campaign.runs import CampaignJob
    from fflin.robot.robot import Robot
    from fflin.simulation.motion import Motion

NOT_RUN = -1.0  # value of `stop` in the rows of a file that contain no run

_COMPARED = re.compile(
    r"\s*(.+?)\s*(<=|>=|<|>)\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)(?![.\d])\s*(.*?)\s*"
)
_COMPARE = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal}
_DEGREE = math.pi / 180.0
_FACTORS = {  # {(unit in a condition, unit of the figure): conversion factor}
    ("deg", "rad"): _DEGREE,
    ("rad", "deg"): 1.0 / _DEGREE,
    ("deg/s", "rad/s"): _DEGREE,
    ("arcsec", "deg"): 1.0 / 3600.0,
    ("mm", "m"): 1e-3,
    ("mm/s", "m/s"): 1e-3,
}


class Bound(NamedTuple):
    """Comparison in a condition, and the mask (N,) of runs that satisfy the comparison.

    `text` is the comparison with its unit, which users may omit.
    """

    name: str
    sign: str
    limit: float
    met: Mask
    text: str


def bounds_of(
    condition: str, figure: Callable[[str], tuple[Array, str]]
) -> list[Bound]:
    """Return the comparisons in a condition such as ``attitude < 1 deg and settle < 40 s``.

    The function `figure` returns the values (N,) and the unit of a named quantity.
    """
    bounds = []
    for part in condition.split(" and "):
        if not (match := _COMPARED.fullmatch(part)):
            raise InputError(
                f"condition {part!r} cannot be read, expected NAME < NUMBER UNIT, such as "
                "'attitude < 1 deg'"
            )
        name = kind_named(match[1])
        sign = match[2]
        limit = float(match[3])
        unit = match[4]
        values, figure_unit = figure(name)
        alternatives = figure_unit.split("|")
        factor = 1.0
        if unit not in ("", figure_unit, *alternatives):
            factor = max(
                _FACTORS.get((unit, alternative), 0.0) for alternative in alternatives
            )
        if not factor:
            raise InputError(
                f"condition {part!r} has the unit {unit}, expected {figure_unit or 'no unit'}"
            )
        limit *= factor
        text = part.strip() if unit else f"{part.strip()} {figure_unit}".strip()
        bounds.append(Bound(name, sign, limit, _COMPARE[sign](values, limit), text))
    return bounds


@dataclass(frozen=True, eq=False, repr=False)
class Campaign(FrozenArrays):
    """Result of a Monte Carlo campaign of N runs, which `monte_carlo` returns.

    A figure is a number that describes one run. Statistics and conditions use figures by these
    names:

    - ``attitude`` [deg], ``position`` [m], ``joints``, ``omega_b``, ``v_b`` and ``joint rates``:
      final error in the states of this kind. These six names are the kinds of error, each called
      KIND below.
    - ``wheel speeds`` [rad/s] and ``modes`` [sqrt(kg) m]: largest final error of the speeds of
      wheels, and of the coordinates of flexible appendages and slosh.
    - The name of a state or input: final value of this signal, including its sign.
    - ``worst NAME``: largest magnitude during the run: of the error if NAME is a kind, a state,
      ``wheel speeds`` or ``modes``; of the command if NAME is an input.
    - ``settle KIND`` [s]: settling time, after which the error of this kind stays within 2 % of its
      largest value. ``settle`` [s]: the longest settling time of attitude, position and joints, as
      far as the policy controls them.
    - ``end`` [s]: end of the run.
    - ``drawn NAME``: value drawn for the dispersed parameter NAME.

    The error in ``attitude`` is the angle of the rotation from the target attitude. The error of
    any other kind is the largest deviation of its states from the target. If there is no target,
    the initial state replaces the target. A run that was stopped early counts as a violation of
    every bound: its errors, worst values and settling times are infinite, and it meets no
    condition.

    Attributes
    ----------
    drawn : ndarray (N, k)
        Values drawn for the k dispersed parameters; `names` (k,) contains the names of the
        parameters.
    q, v, x, u : ndarray (N, ..)
        Final configuration, velocity, state and inputs; for a run that diverged, the last finite
        values.
    largest_x, largest_u : ndarray (N, nx), (N, nu)
        Largest magnitudes of the state errors and the inputs, up to the end of each run.
    errors, largest, settle : ndarray (N, 6)
        Final error, largest error and settling time [s] of each kind. The settling time is infinite
        if the error has not settled.
    times : tuple of float
        Times [s] of the histories; empty unless `monte_carlo` was called with `histories`.
    error_history, input_history : ndarray (N, M, 6), (N, M, nu)
        Errors of each kind, and commanded inputs, at the `times`. After a run is stopped, its
        errors are infinite and its commands are zero.
    stop, end : ndarray (N,)
        Outcome (0 completed, 1 diverged, 3 stopped for another reason) and end time [s] of each
        run. The outcome 2 does not occur, because runs continue beyond 180 deg.
    asked : int
        Requested number of runs. N is smaller if the condition `until` ended the campaign early.
    goals : tuple of str
        Conditions whose success rates appear in the printed report and in `plot_campaign`.
    notes : tuple of str
        Remarks on the time step of the runs, see `Motion.notes`, on runs that were read from a
        file, and why the runs were simulated in Python although no engine was given.
    wheels, modes : tuple of str
        Joints that were simulated as wheels, and modes of flexible appendages and slosh.
    x_end : tuple of float
        Target state (nx,) at the end of a run, or the initial state if there is no target.
    replay_settings : mapping
        Names of the dispersions and options of the call, with which `replay` repeats a run of a
        campaign that was loaded from a file.

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
    # largest permitted magnitudes; infinite without a limit
    input_limits: tuple[float, ...]
    times: tuple[float, ...]
    # subset of attitude, position, joints that the policy controls
    judged: tuple[str, ...]
    robot: str
    urdf_sha256: str
    duration: float
    dt: float
    seed: int
    asked: int
    engine: str
    goals: tuple[str, ...]
    confidence: float
    notes: tuple[str, ...] = ()
    wheels: tuple[str, ...] = ()
    modes: tuple[str, ...] = ()
    x_end: tuple[float, ...] = ()
    replay_settings: Mapping[str, object] = field(default_factory=dict)
    _job: CampaignJob | None = field(default=None, kw_only=True)

    def __len__(self) -> int:
        return len(self.stop)

    def __repr__(self) -> str:
        lost = int(self.stopped.sum())
        return f"Campaign('{self.robot}', {len(self)} runs of {self.duration:g} s, {lost} stopped)"

    def __str__(self) -> str:
        return campaign_report(self)

    def _repr_html_(self) -> str:
        return campaign_card(self)

    @property
    def stopped(self) -> Mask:
        """Whether each run (N,) was stopped before its end."""
        stopped: Mask = self.stop != 0.0
        return stopped

    @property
    def about(self) -> str:
        """Default figure of `worst` and `sensitivity`.

        The default is the figure that the goals first compare by ``<`` or ``<=``. If no goal
        contains such a comparison, the default is ``worst KIND``, where KIND is the first of
        ``attitude``, ``position`` and ``joints`` that the policy controls.
        """
        bounded = [bound.name for bound in self.bounds if bound.sign[0] == "<"]
        return [*bounded, f"worst {(self.judged or tuple(KINDS))[0]}"][0]

    @property
    def bounds(self) -> list[Bound]:
        """All comparisons of a figure with a number in the goals."""
        return [bound for goal in self.goals for bound in bounds_of(goal, self.figure)]

    def _with_units(self, goal: str) -> str:
        """Return a goal with the unit of each number, for reports."""
        return " and ".join(bound.text for bound in bounds_of(goal, self.figure))

    def values(self, name: str) -> Array:
        """Return the named figure of every run (N,), in SI units; attitude errors are in deg."""
        return self.figure(name)[0]

    def figure(self, name: str) -> tuple[Array, str]:
        """Return the named figure of every run (N,), and its unit."""
        name = kind_named(instance("name", name, str, "the name of a figure"))
        if name == "end":
            return self.end, "s"
        if name == "settle":
            at = [list(KINDS).index(kind) for kind in self.judged]
            return self.settle[:, at].max(axis=1, initial=0.0), "s"
        statistic, _, rest = name.partition(" ")
        if statistic not in ("worst", "settle", "drawn"):
            statistic = "final"
            rest = name
        indices = {WHEEL_SPEEDS: self._indices("qdot_m", self.wheels)}
        indices[MODES] = self._indices("q_m", self.modes)
        if indices.get(rest) and statistic in ("final", "worst"):
            at = indices[rest]
            errors = self.largest_x[:, at]
            if statistic == "final":
                errors = np.abs(self.x[:, at] - np.array(self.x_end)[at])
            return np.where(self.stopped, np.inf, errors.max(axis=1)), self.state_units[
                at[0]
            ]
        states = (self.state_names, self.state_units)
        inputs = (self.input_names, self.input_units)
        kinds = tuple(KINDS), self._units_of_kinds()
        groups: list[tuple[tuple[str, ...], tuple[str, ...], Array]] = {
            "final": [(*kinds, self.errors), (*states, self.x), (*inputs, self.u)],
            "worst": [
                (*kinds, self.largest),
                (*states, self.largest_x),
                (*inputs, self.largest_u),
            ],
            "settle": [(kinds[0], ("s",) * len(KINDS), self.settle)],
            "drawn": [(self.names, ("",) * len(self.names), self.drawn)],
        }[statistic]
        for names, units, arrays in groups:
            if rest in names:
                values, unit = arrays[:, names.index(rest)], units[names.index(rest)]
                bounded = statistic == "worst" or arrays is self.errors
                if bounded:
                    values = np.where(self.stopped, np.inf, values)
                return values, unit
        known = [name for names, *_ in groups for name in names]
        raise unknown(
            "figure", rest, [*known, *(name for name, at in indices.items() if at)]
        )

    def _units_of_kinds(self) -> tuple[str, ...]:
        """Return the units of the kinds of error, with the units of this robot for joints."""
        others = {*self.wheels, *self.modes}
        joints: dict[str, list[str]] = {"q_m": [], "qdot_m": []}
        for state, unit in zip(self.state_names, self.state_units, strict=True):
            group, _, name = state.partition(".")
            if group in joints and name not in others and unit not in joints[group]:
                joints[group].append(unit)
        units = {
            **KINDS,
            "joints": "|".join(joints["q_m"]) or KINDS["joints"],
            "joint rates": "|".join(joints["qdot_m"]) or KINDS["joint rates"],
        }
        return tuple(units.values())

    def _indices(self, group: str, joints: tuple[str, ...]) -> list[int]:
        """Return the indices of the states of some joints, for "q_m" or "qdot_m"."""
        return [self.state_names.index(f"{group}.{name}") for name in joints]

    def met(self, condition: object) -> Mask:
        """Return a mask (N,) of the runs that meet a condition.

        Parameters
        ----------
        condition : str or array_like of bool (N,)
            Text such as ``NAME < NUMBER UNIT``; the other operators are <=, > and >=, and ``and``
            joins several comparisons. If UNIT is omitted, NUMBER is in the unit of the figure. A
            run that was stopped early never meets a condition given as text.
        """
        if not isinstance(condition, str):
            dimension("condition", condition)  # refuses rows of different lengths
            given = condition if isinstance(condition, np.ndarray | list) else None
            mask = np.asarray(given)
            if mask.shape != (len(self),) or mask.dtype != bool:
                raise InputError(
                    f"condition has shape {mask.shape} of {mask.dtype}, expected a text such as "
                    f"'attitude < 1 deg', or ({len(self)},) booleans"
                )
            return mask
        met = ~self.stopped
        for bound in bounds_of(condition, self.figure):
            met = met & bound.met
        return met

    def fraction(self, condition: object, *, confidence: float = 0.95) -> Estimate:
        """Return the fraction of runs that meet a condition, with its Clopper-Pearson interval."""
        met, sure = int(self.met(condition).sum()), share("confidence", confidence)
        return intervals.clopper_pearson(met, len(self), sure)

    def quantile(self, name: str, p: float, *, confidence: float = 0.95) -> Estimate:
        """Return the p-quantile of a figure over the runs, with its confidence interval.

        The interval is computed from order statistics and is valid for any distribution. For final
        states and inputs, which can have either sign, only the completed runs are included.
        """
        values = self.values(name)
        if name in (*self.state_names, *self.input_names):
            values = values[~self.stopped]
        return intervals.quantile(
            values, share("p", p), share("confidence", confidence)
        )

    def mean(self, name: str, *, confidence: float = 0.95) -> Estimate:
        """Return the mean of a figure over the completed runs, with Student's t interval.

        Raises
        ------
        InputError
            If the figure is infinite in a completed run. For example, the settling time is infinite
            if the error has not settled.
        """
        values = self.values(name)[~self.stopped]
        if endless := int(np.isinf(values).sum()):
            raise InputError(
                f"{name!r} is infinite in {endless} of {len(values)} completed runs, so its mean "
                "is not finite; use a fraction or a quantile"
            )
        return intervals.mean(values, share("confidence", confidence))

    def worst(self, k: int = 5, name: str | None = None) -> list[int]:
        """Return the indices of the k runs in which a figure, such as ``attitude``, is largest.

        The default figure is `about`. Runs that were stopped early come first, the earliest stop
        before the others.
        """
        figure = self.values(name or self.about)
        stop_times = np.where(self.stopped, self.end, np.inf)
        # `lexsort` sorts by its last key first: by stop time, and then by decreasing figure.
        order = np.lexsort((-figure, stop_times))
        return [int(run) for run in order[: whole("k", k, 1)]]

    def sensitivity(self, name: str | None = None) -> dict[str, float]:
        """Return Spearman's rank correlations {name: value} between dispersed values and a figure.

        The correlation with the largest magnitude comes first. For each dispersed parameter, the
        figure is correlated with the drawn value, and with the distance of the drawn value from its
        median. The correlation with the larger magnitude is returned: under the key ``NAME`` for
        the value, or ``|NAME|`` for the distance. For example, the distance is more informative for
        a figure that grows with an initial error of either sign. The default figure is `about`.
        """
        name = self.about if name is None else name
        figure = self.values(name)
        apart = np.abs(self.drawn - np.median(self.drawn, axis=0))
        signed, sized = (
            intervals.rank_correlations(x, figure) for x in (self.drawn, apart)
        )
        correlations = {}
        for key, value, size in zip(
            self.names, signed.tolist(), sized.tolist(), strict=True
        ):
            if key == SEED:
                continue
            if abs(size) > abs(value):
                correlations[f"|{key}|"] = size
            else:
                correlations[key] = value
        return dict(sorted(correlations.items(), key=lambda pair: -abs(pair[1])))

    def replay(
        self,
        run: int,
        *,
        robot: Robot | None = None,
        policy: object = None,
        **options: object,
    ) -> Motion:
        """Simulate a run of the campaign again, and return its motion.

        In the returned motion, q, v and u equal the original run bit for bit. The state x is
        computed from q and v by different code. It therefore agrees only to machine precision, and
        the angles of continuous joints may differ by full turns.

        Parameters
        ----------
        run : int
            Index of the run.
        robot, policy : optional
            Robot and policy of the campaign. They are needed for a campaign that was loaded from a
            file.
        **options
            Options of `monte_carlo` that a file cannot contain: functions such as `disturbance`,
            and a linear model as `target`.

        Raises
        ------
        InputError
            If the run does not exist, or the campaign was loaded from a file and the robot or an
            option is missing or differs from the campaign.

        Warns
        -----
        FflinWarning
            If the motion does not end at the recorded q and v, because the policy or an option
            differs.
        """
        from fflin.campaign.replay import job_of_campaign

        at = whole("run", run, 0, len(self) - 1)
        job = job_of_campaign(self, robot, policy, options)
        motion = job.replay(np.array(self.drawn[at]))
        missed = max(
            float(np.abs(motion.q[-1] - self.q[at]).max()),
            float(np.abs(motion.v[-1] - self.v[at]).max()),
        )
        if missed > 0.0:
            warnings.warn(
                f"the motion ends {missed:.2g} (largest difference of q and v) from the recorded "
                "end of the run; the policy, an option, the version or the processor differs",
                FflinWarning,
                stacklevel=2,
            )
        worst = ""
        if at == self.worst(1)[0]:
            worst = f", worst {self.about.removeprefix('worst ')}"
        about = f"run {at} of {len(self)}{worst}, seed {self.seed}, {motion._about}"
        return replace(motion, _about=about)

    pointing = campaign_pointing

    def save(self, path: str | Path) -> None:
        """Save the campaign to a .npz, .h5, .csv or .mat file, atomically.

        A .csv or .mat file is a table of figures for other programs, with one row for each run;
        `load` cannot read this table. The columns have the names of the figures with units, such as
        ``worst tau_b.x [N m]``. In a .mat file, the variable `columns` contains the names, and the
        variable `runs` contains the values.
        """
        target = as_path(path)
        if target.suffix not in (".csv", ".mat"):
            self._save(target)
            return
        columns, rows = self._table()
        if target.suffix == ".csv":
            write_table(target, columns, rows)
            return
        table = {"columns": np.array([columns], dtype=object), "runs": rows}
        write_atomically({target: CODECS[".mat"][0](table, True)})

    def _table(self) -> tuple[list[str], Array]:
        """Return the columns and the rows of the table of figures, with one row for each run."""
        finals = (*KINDS, *self.state_names, *self.input_names)
        names = [f"drawn {name}" for name in self.names] + ["end", *finals]
        names += [f"worst {name}" for name in finals] + [
            f"settle {kind}" for kind in KINDS
        ]
        values, units = zip(*map(self.figure, names), strict=True)
        columns = labels(["stop", *names], ["", *units])
        return columns, np.column_stack((self.stop, *values))

    def to_pandas(self) -> DataFrame:
        """Return the table of figures as a pandas data frame, with the number of the run as index.

        The columns are the columns of the .csv file that `save` writes.

        Raises
        ------
        MissingPackageError
            If pandas is not installed.
        """
        columns, rows = self._table()
        runs = np.column_stack((np.arange(len(rows), dtype=float), rows))
        return data_frame(["run", *columns], runs, index="run")

    def _save(self, path: Path, **texts: str) -> None:
        """Write the campaign and additional strings, such as the digest of the call, to a file."""
        arrays = {key: np.ascontiguousarray(getattr(self, key)) for key in ARRAYS}
        rest = {key: getattr(self, key) for key in _HEADER}
        texts["header"] = json.dumps({"kind": "Campaign", **rest})
        write_rows(path, arrays, texts, checksummed=True)

    @classmethod
    def load(cls, path: str | Path) -> Campaign:
        """Read a campaign from a file that `save` or `monte_carlo` wrote.

        Raises
        ------
        FileError
            If the file cannot be read, is damaged or does not contain a campaign.
        """
        source = as_path(path)
        with reading(source, "Campaign"):
            arrays, _, texts, _ = read_rows(source, verify=True)
            header = json.loads(texts["header"])
            if header["kind"] != "Campaign":
                raise ValueError(f"the file contains: {header['kind']}")
            return cls.of(arrays, header)

    @classmethod
    def of(
        cls,
        arrays: Mapping[str, Array],
        header: Mapping[str, object],
        job: CampaignJob | None = None,
    ) -> Campaign:
        """Return a campaign from its header and arrays; rows of missing runs are left out."""
        run = np.asarray(arrays["stop"]) != NOT_RUN
        values = dict[str, Any]()
        for key in ARRAYS:
            values[key] = arrays[key]
            if not run.all():
                values[key] = arrays[key][run]
        # Files of earlier versions do not contain these fields.
        header = {
            "notes": [],
            "wheels": [],
            "modes": [],
            "x_end": [],
            "replay_settings": {},
            **header,
        }
        for key in _HEADER:
            value = header[key]
            values[key] = tuple(value) if isinstance(value, list) else value
        return cls(**values, _job=job)


_NAMES = [item.name for item in fields(Campaign)]
ARRAYS, _HEADER = _NAMES[: _NAMES.index("names")], _NAMES[_NAMES.index("names") : -1]
