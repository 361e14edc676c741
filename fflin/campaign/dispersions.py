"""Dispersions: the spreads by name, and the robots and starts that their draws give."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from fflin.base.errors import ChartError, InputError, UnknownNameError
from fflin.base.names import by_name, input_keys
from fflin.base.progress import Progress
from fflin.base.validation import Array, untied
from fflin.base.validation import by_name as mapping
from fflin.base.writing import reason
from fflin.campaign.pointing import columns_of, in_lanes, misaligned, require_direction
from fflin.campaign.sensing import Bound, misled, noise_of
from fflin.campaign.spreads import SEED, deviation_of, inverse_of, is_closed_form, whole_number
from fflin.control.linear_controller import LinearController
from fflin.control.output_feedback import TrajectoryOutputFeedback
from fflin.control.policies import Allocation, StateFeedback, bound
from fflin.dynamics.state import StateMap
from fflin.kernel.accelerations import loads_of
from fflin.kernel.tree import Tree
from fflin.robot.frames import ROOT
from fflin.robot.link_masses import Piece, pieces_of, with_share
from fflin.robot.mass_properties import stretched, with_inertias
from fflin.simulation.plant import Drives, Plant
from fflin.simulation.times import Times

_BLOCK = 1024  # runs whose draws are made together, whatever the chunks are
_GLANCE = 0.3  # seconds of drawing from one look at its progress to the next
_OF_BODIES = {"mass": " ", "com": "xyz", "inertia": "xyz"}  # with their axes
_AXES = _OF_BODIES | {"misalignment": "12"}
_OF_INPUTS, _OF_SPRINGS = ("gain", "bias", "fails"), ("stiffness", "damping")
_OF_SENSORS = ("sensor", "noise")
_FACTORS = ("mass", "inertia", "density", *_OF_SPRINGS)


class Column(NamedTuple):
    """A number that is drawn for each run, what it changes and of whom; of several if tied."""

    name: str
    kind: str  # "state", "delay", "seed" of noise, or what a name ends with
    at: tuple[tuple[int, int], ...]  # each state, body, joint, input or sensor, and which axis
    inverse: Callable[[Array], Array]  # of the distribution function


class Draws(NamedTuple):
    """Rows of what is drawn: the values (N, k), and the numbers of the runs (N,)."""

    drawn: Array
    run: Array


class Dispersions:
    """Dispersions of `monte_carlo`, and the robots and starts x0 (nx,) that their draws give."""

    def __init__(
        self, given: Any, plant: Plant, policy: Any, x0: Array, seed: int, times: Times
    ) -> None:
        self._plant, self._policy, self._x0, self._seed = plant, policy, x0, seed
        self._times = times
        self._model = plant.robot._bare.model
        bodies = ["base", *list(self._model.names)[ROOT + 1 :]]
        self._links = {n: each for n, each in pieces_of(plant.robot)[0].items() if not each.whole}
        self._sensors: tuple[str, ...] = ()
        if isinstance(policy, StateFeedback | LinearController):
            lin = policy.lin
            of_states = isinstance(policy, StateFeedback)
            self._sensors = lin.state_names if of_states else lin.output_names
        if isinstance(policy, TrajectoryOutputFeedback):
            self._sensors = policy.filter.output_names
        known = {
            "state": plant.state.names,
            **dict.fromkeys(_OF_SENSORS, self._sensors),
            **dict.fromkeys(_OF_BODIES, bodies),
            "density": tuple(self._links),
            **dict.fromkeys((*_OF_INPUTS, "misalignment"), input_keys(plant.actuation)),
            **dict.fromkeys(_OF_SPRINGS, plant.robot.joint_names),
        }
        by_kind: dict[str, dict[str, Any]] = {}
        self.columns: list[Column] = []
        for key, spread in mapping("dispersions", given, "name").items():
            head, _, kind = str(key).rpartition(".")
            kind, head = (kind, head) if kind in known and head else ("state", str(key))
            if key == "delay":
                kind, known["delay"] = "delay", ("delay",)
            own, tied = untied(str(key), spread)
            if kind == "fails" and isinstance(own, int | float):
                raise InputError(
                    f"'{key}' is {own:g}, a standard deviation about 0, which does not describe a "
                    "time of failure; give (least, largest), a list of times or a distribution"
                )
            inverse = deviation_of if kind == "noise" else inverse_of
            spreads = by_kind.setdefault(kind, {})
            spreads[head] = inverse(str(key), own), str(key) if tied else ""
        if "noise" in by_kind:
            self.columns.append(Column(SEED, "seed", ((0, 0),), whole_number))
        for kind, spreads in by_kind.items():
            self._add(kind, spreads, list(known[kind]), " | ".join([*known][1:]))
        if not self.columns:
            raise InputError("dispersions is empty; give at least one, such as {'q_b': 0.05}")
        self._kinds = {column.kind for column in self.columns}
        # What distributions of other packages gave, by name and block; closed forms are quick.
        self._kept: dict[tuple[str, int], Array] = {}
        heavier = {at + ROOT: self.names[column] for column, at in self._changed("mass")}
        for column, _, at in self._densities():
            if at in heavier:
                one, other = heavier[at], self.names[column]
                raise InputError(
                    f"'{one}' and '{other}' disperse the same mass; give only one of them"
                )

    def _add(self, kind: str, spreads: Any, names: list[str], kinds: str) -> None:
        if kind in _OF_SENSORS and not names:
            raise InputError(
                f"'{next(iter(spreads))}.{kind}' is dispersed, but a "
                f"{type(self._policy).__name__} has no sensors; use a StateFeedback, "
                "OutputFeedback or LinearController"
            )
        if kind in ("noise", "delay") and not self._times.sample:
            raise InputError(
                f"{kind} is dispersed, which needs a sampled policy, but this policy is "
                "continuous; give sample=, a multiple of dt (--dt on the command line)"
            )
        try:
            found = by_name(f"{kind} to disperse", spreads, names)
        except UnknownNameError as error:
            raise UnknownNameError(
                f"{error}" + f"; or NAME.({kinds})" * (kind == "state")
            ) from None
        draws: dict[str, tuple[Any, list[int]]] = {}
        for at, (inverse, tied) in sorted(found.items()):
            own = names[at] if kind in ("state", "delay") else f"{names[at]}.{kind}"
            if kind in _OF_SPRINGS and not getattr(self._plant.robot.springs, kind)[at]:
                raise InputError(
                    f"'{own}' is dispersed by a factor, but its nominal value is 0; leave it out "
                    "or give the robot a value"
                )
            if kind == "misalignment":
                require_direction(self._plant.robot, at)
            draws.setdefault(tied or own, (inverse, []))[1].append(at)
        for own, (inverse, places) in draws.items():
            for axis, letter in enumerate(_AXES.get(kind, " ")):
                name = f"{own}.{letter}".rstrip(". ")
                where = tuple((at, axis) for at in places)
                self.columns.append(Column(name, kind, where, inverse))

    def _changed(self, *kinds: str) -> list[tuple[int, int]]:
        """Return (column, which state, body, joint, input or sensor) of kinds."""
        columns = enumerate(self.columns)
        return [(i, at) for i, each in columns if each.kind in kinds for at, _ in each.at]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the dispersed values."""
        return tuple(column.name for column in self.columns)

    def rows(self, start: int, stop: int) -> Draws:
        """Return what is drawn for some runs; it depends on seed, name and run alone."""
        drawn = np.empty((stop - start, len(self.columns)))
        for at, column in enumerate(self.columns):
            for first in range(start // _BLOCK * _BLOCK, stop, _BLOCK):
                low, high = max(start, first), min(stop, first + _BLOCK)
                values = self._drawn(column, first // _BLOCK, high - first)
                drawn[low - start : high - start, at] = values[low - first : high - first]
        return Draws(drawn, np.arange(start, stop, dtype=float))

    def _uniform(self, column: Column, block: int) -> Array:
        key = (self._seed, zlib.crc32(column.name.encode()))
        stream = np.random.Philox(np.random.SeedSequence(key, spawn_key=(block,)))
        # At 0 and 1 the inverse may be infinite.
        return np.random.Generator(stream).random(_BLOCK).clip(1e-16, 1.0 - 1e-16)

    def _drawn(
        self, column: Column, block: int, count: int, said: Callable[[int], None] | None = None
    ) -> Array:
        """Return the first values of a block of runs, each drawn once: some distributions are slow.

        `said` is called with the number of values that this block has, as they are drawn.
        """
        uniform = self._uniform(column, block)
        if is_closed_form(column.inverse):
            return column.inverse(uniform)
        kept, size = self._kept.get((column.name, block), np.empty(0)), 1
        while len(kept) < count:
            begun = time.monotonic()
            part = uniform[len(kept) : min(count, len(kept) + size)]
            try:
                values = np.asarray(column.inverse(part), dtype=float)
            except Exception as error:  # each distribution has its own
                raise InputError(
                    f"the distribution of '{column.name}' cannot be drawn: {reason(error)}"
                ) from None
            kept = self._kept[column.name, block] = np.concatenate((kept, values))
            if said:
                said(len(kept))
            took = max(time.monotonic() - begun, 1e-9)
            size = max(1, min(2 * size, int(size * _GLANCE / took)))
        return kept

    def _draw_all(self, column: Column, runs: int) -> None:
        """Draw a distribution for so many runs, with a bar on a terminal."""
        bar = Progress()
        try:
            for first in range(0, runs, _BLOCK):

                def said(count: int, first: int = first) -> None:
                    done = first + count
                    bar.update(done, runs, f"drawing '{column.name}', {done:,} of {runs:,} ")

                self._drawn(column, first // _BLOCK, min(_BLOCK, runs - first), said)
        finally:
            bar.close()

    def require_possible(self, runs: int) -> None:
        """Raise `InputError` where a draw of so many runs makes no robot or no attitude."""
        for column in self.columns:
            if not is_closed_form(column.inverse):
                self._draw_all(column, runs)
        for start in range(0, runs, _BLOCK):
            drawn = self.rows(start, min(start + _BLOCK, runs)).drawn
            for values, column in zip(drawn.T, self.columns, strict=True):
                least = -1.0 if column.kind in _FACTORS else -np.inf
                bad = ~np.isfinite(values) | (values <= least)
                if bad.any():
                    run = int(bad.argmax())
                    bound = f" more than {least:g}" if np.isfinite(least) else " a finite number"
                    raise InputError(
                        f"'{column.name}' is drawn as {values[run]:.4g} in run {start + run}, "
                        f"which gives no valid robot; expected{bound}. Take a smaller spread, or "
                        "a uniform one (least, largest)"
                    )
            try:
                self.starts(drawn)
            except ChartError as error:
                said = f"an invalid initial attitude is drawn in the runs from {start} on"
                raise InputError(f"{said}: {error}; take a smaller spread") from None

    def _of(self, kind: str, drawn: Array, size: int, axes: int = 1) -> Array:
        """Return the draws (N, size, axes) of a kind, zero where nothing is drawn."""
        found = np.zeros((len(drawn), size, axes))
        for values, column in zip(drawn.T, self.columns, strict=True):
            for at in column.at if column.kind == kind else ():
                found[(slice(None), *at)] = values
        return found

    def starts(self, drawn: Array) -> tuple[Array, Array]:
        """Return configurations and velocities (N, nq), (N, nv) to begin at."""
        x = self._x0 + self._of("state", drawn, len(self._x0))[..., 0]
        return self._plant.state.points(x)[1:]

    def _densities(self) -> Iterator[tuple[int, Piece, int]]:
        """Yield columns of densities, the link of each, and its joint without wheels."""
        links, joints = list(self._links.values()), self._plant.robot.model.names
        for column, at in self._changed("density"):
            joint = links[at].joint
            own = self._model.getJointId(joints[joint]) if joint > ROOT else ROOT
            yield column, links[at], own

    def bodies(self, drawn: Array) -> dict[int, tuple[Array, Array, Array]]:
        """Return masses (N,), centres (N, 3) and inertias (N, 3, 3) of bodies that are drawn."""
        size, found = self._model.njoints - ROOT, {}
        of = [self._of(kind, drawn, size, len(axes)) for kind, axes in _OF_BODIES.items()]
        for at in sorted({at for _, at in self._changed(*_OF_BODIES)}):
            found[ROOT + at] = stretched(self._model.inertias[ROOT + at], *(x[:, at] for x in of))
        none = np.zeros((len(drawn), 3))
        for column, link, at in self._densities():
            body = found.get(at) or stretched(self._model.inertias[at], none[:, :1], none, none)
            found[at] = with_share(body, link, drawn[:, column])
        return found

    def _springs(self, kind: str, drawn: Array) -> Array:
        robot = self._plant.robot
        factor: Array = 1.0 + self._of(kind, drawn, robot.n)[..., 0]
        return factor * getattr(robot.springs, kind)

    def _drives(self, drawn: Array) -> Drives:
        gain, bias, until = (
            self._of(kind, drawn, len(self._plant.drives.gain))[..., 0] for kind in _OF_INPUTS
        )
        safe = np.ones(until.shape[1], dtype=bool)
        safe[[at for _, at in self._changed("fails")]] = False
        until[:, safe] = np.inf
        turn = columns_of(self._plant.robot, self._angles(drawn))
        return Drives(1.0 + gain, bias, until, turn)

    def _angles(self, drawn: Array) -> Array:
        return self._of("misalignment", drawn, len(self._plant.drives.gain), 2)

    def _sensing(self, drawn: Array) -> tuple[Array, Array, Array]:
        """Return bias and deviation (N, ny) of what is sensed, and the seed (N,) of its noise."""
        bias, noise = (self._of(key, drawn, len(self._sensors))[..., 0] for key in _OF_SENSORS)
        return bias, noise, self._of("seed", drawn, 1)[:, 0, 0]

    def delays(self, drawn: Array) -> Array:
        """Return the steps (N,) from a sample to its effect."""
        late = self._of("delay", drawn, 1)[:, 0, 0] / self._times.dt
        return np.maximum(0.0, np.rint(self._times.delay + late))

    def in_lanes(self, drawn: Array, tree: Tree) -> dict[str, Array]:
        """Return what differs from run to run, as the compiled loop takes it."""
        plant, (q, v) = self._plant, self.starts(drawn)
        runs = {"q": q, "nu": plant.state.velocities(v), **self._drives(drawn)._asdict()}
        if self._kinds & {*_OF_BODIES, "density"}:
            parameters = np.tile(tree.bodies.reshape(1, -1, 10), (len(drawn), 1, 1))
            for at, body in self.bodies(drawn).items():
                # In the tree wheels stand between the joints.
                body_at = plant.robot.model.getJointId(self._model.names[at]) - ROOT
                old, axes = self._model.inertias[at], tree.axes[body_at]
                before = (np.array([x]) for x in (old.mass, old.lever, old.inertia))
                # Linear in these, so that wheels in the body stay as they are.
                parameters[:, body_at] += _parameters(axes, *body) - _parameters(axes, *before)
            runs["bodies"] = parameters.reshape(len(drawn), -1)
        runs |= {kind: self._springs(kind, drawn) for kind in _OF_SPRINGS if kind in self._kinds}
        if "misalignment" in self._kinds:
            loads = loads_of(plant.robot, plant.actuation, tree)
            turned = in_lanes(plant.robot, tree, loads, self._angles(drawn))
            turned["bodies"] += runs.get("bodies", tree.bodies)
            runs |= turned
        if self._kinds & {*_OF_SENSORS}:
            names = plant.state.names if isinstance(self._policy, StateFeedback) else self._sensors
            fed = [names.index(name) for name in self._sensors]
            *errors, seed = self._sensing(drawn)
            for key, values in zip(("sensed", "noise"), errors, strict=True):
                runs[key] = np.zeros((len(drawn), len(names)))
                runs[key][:, fed] = values
            if "noise" in self._kinds:
                runs["seed"] = seed
        if "delay" in self._kinds:
            runs["delay"] = self.delays(drawn)[:, None]
        return runs

    def one(self, drawn: Array) -> tuple[Plant, Any, Array, Array]:
        """Return the robot of a run (k,) with its inputs, its policy, and q and v to begin at."""
        plant, policy, rows = self._plant, self._policy, drawn[None]
        robot, (q, v) = plant.robot, self.starts(rows)
        if bodies := self.bodies(rows):
            robot = with_inertias(robot, {k: [x[0] for x in body] for k, body in bodies.items()})
        for kind in self._kinds & {*_OF_SPRINGS}:
            values = self._springs(kind, rows)[0].tolist()
            of: Any = {kind: dict(zip(robot.joint_names, values, strict=True))}
            robot = replace(robot, **of)
        if "misalignment" in self._kinds:
            robot = misaligned(robot, self._angles(rows)[0])
            if isinstance(policy, Allocation):  # which does not know of it
                given = policy
                policy = Bound(lambda _: bound(given, plant.robot))
        if self._kinds & {*_OF_SENSORS}:
            error = noise_of(*(each[0] for each in self._sensing(rows)))
            if isinstance(policy, StateFeedback):
                policy = misled(policy, error)
            else:
                noise = policy.noise or np.zeros_like
                policy = copy(policy)
                vars(policy)["noise"] = lambda t: error(t) + np.asarray(noise(t))
        state = StateMap(robot, reference=plant.state.reference, frame=plant.state.frame)
        drives = Drives(*(x[0] for x in self._drives(rows)))
        faulty = drives if self._kinds & {*_OF_INPUTS, "misalignment"} else None
        return Plant(state, plant.disturbance, faulty), policy, q[0], v[0]


def _parameters(axes: Array, mass: Array, com: Array, inertia: Array) -> Array:
    """Return m, m c, and I about the origin (xx xy xz yy yz zz) of bodies in axes (N, 10)."""
    square = (com * com).sum(axis=1)[:, None, None] * np.eye(3) - com[:, :, None] * com[:, None]
    about = axes.T @ (inertia + mass[:, None, None] * square) @ axes
    rows, columns = np.triu_indices(3)
    return np.column_stack((mass, mass[:, None] * (com @ axes), about[:, rows, columns]))
