"""What is drawn at random from run to run: spreads by name, and the runs that come of the draws."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from fflin.base.errors import InputError, UnknownNameError
from fflin.base.names import by_name, input_keys
from fflin.base.validation import Array, number
from fflin.base.validation import by_name as mapping
from fflin.control.output_feedback import OutputFeedback
from fflin.control.policies import StateFeedback, bound
from fflin.kernel.tree import Tree
from fflin.robot.frames import ROOT
from fflin.robot.mass_properties import stretched, with_inertias
from fflin.robot.robot import Robot
from fflin.simulation.plant import Drives, Plant

_BLOCK = 1024  # runs whose draws are made together, whatever the chunks are
_OF_BODIES, _OF_INPUTS, _OF_SPRINGS = (
    ("mass", "com", "inertia"),
    ("gain", "bias", "fails"),
    ("stiffness", "damping"),
)
_RELATIVE = ("mass", "inertia", "stiffness", "damping")
_AXES = {"com": "xyz", "inertia": "xyz"}


class Column(NamedTuple):
    """A number that is drawn for each run, what it changes and of whom."""

    name: str
    kind: str  # state, or what a name ends with
    at: tuple[int, int]  # which state, body, joint or input, and which of its axes
    inverse: Callable[[Array], Array]  # of the distribution function


class Draws(NamedTuple):
    """Rows of what is drawn: the values (N, k), and the numbers of the runs (N,)."""

    drawn: Array
    run: Array


class Dispersions:
    """The columns of a campaign, by name; see `monte_carlo`."""

    def __init__(self, given: Any, plant: Plant, policy: Any, seed: int) -> None:
        self._seed = seed
        self.columns: list[Column] = []
        robot, state = plant.robot, plant.state
        bodies = list(robot._bare.model.names)[ROOT + 1 :]
        known = {
            **dict.fromkeys(_OF_BODIES, ["base", *bodies]),
            **dict.fromkeys(_OF_INPUTS, list(input_keys(plant.actuation))),
            **dict.fromkeys(_OF_SPRINGS, list(robot.joint_names)),
            "sensor": list(sensors_of(policy)),
            "state": list(state.names),
        }
        sorted_: dict[str, dict[str, Any]] = {}
        for key, spread in mapping("dispersions", given, "name").items():
            head, _, kind = str(key).rpartition(".")
            kind, head = (kind, head) if kind in known and head else ("state", str(key))
            sorted_.setdefault(kind, {})[head] = _inverse(str(key), spread)
        for kind, spreads in sorted_.items():
            names = known[kind]
            if kind == "sensor" and not names:
                raise InputError(
                    f"'{next(iter(spreads))}.sensor' is dispersed, and a "
                    f"{type(policy).__name__} has no sensors; StateFeedback and OutputFeedback do"
                )
            what = "state to disperse" if kind == "state" else f"{kind} to disperse, of anything,"
            try:
                found = by_name(what, spreads, names)
            except UnknownNameError as error:
                if kind != "state":
                    raise
                others = " | ".join((*_OF_BODIES, *_OF_INPUTS, *_OF_SPRINGS, "sensor"))
                raise UnknownNameError(f"{error}, or NAME.{{{others}}}") from None
            for at, inverse in sorted(found.items()):
                own = names[at] if kind == "state" else f"{names[at]}.{kind}"
                if kind in _OF_SPRINGS and not getattr(robot.springs, kind)[at]:
                    raise InputError(f"'{own}' is dispersed, and is 0: nothing times a factor")
                for axis, letter in enumerate(_AXES.get(kind, " ")):
                    name = f"{own}.{letter}".rstrip(". ")
                    self.columns.append(Column(name, kind, (at, axis), inverse))
        if not self.columns:
            raise InputError("dispersions is empty; give at least one, such as {'q_b': 0.05}")

    @property
    def names(self) -> tuple[str, ...]:
        """Of what is drawn."""
        return tuple(column.name for column in self.columns)

    def rows(self, start: int, stop: int) -> Draws:
        """Return what is drawn for some runs; it depends on seed, name and run alone."""
        first, last = start // _BLOCK, -(-stop // _BLOCK)
        drawn = np.empty(((last - first) * _BLOCK, len(self.columns)))
        for at, column in enumerate(self.columns):
            for block in range(first, last):
                key = (self._seed, zlib.crc32(column.name.encode()))
                stream = np.random.Philox(np.random.SeedSequence(key, spawn_key=(block,)))
                # Of a tail of 0 or 1 the inverse may be infinite.
                uniform = np.random.Generator(stream).random(_BLOCK).clip(1e-16, 1.0 - 1e-16)
                drawn[(block - first) * _BLOCK :][:_BLOCK, at] = column.inverse(uniform)
        kept = slice(start - first * _BLOCK, stop - first * _BLOCK)
        return Draws(drawn[kept], np.arange(start, stop, dtype=float))

    def require_possible(self, draws: Draws) -> None:
        """Raise `InputError` where a draw makes no robot."""
        for at, column in enumerate(self.columns):
            drawn = draws.drawn[:, at]
            bad = ~np.isfinite(drawn)
            if column.kind in _RELATIVE:
                bad |= drawn <= -1.0
            if bad.any():
                row = int(bad.argmax())
                raise InputError(
                    f"'{column.name}' is drawn as {drawn[row]:.4g} in run {draws.run[row]:.0f}"
                    + ", of which no robot is made: expected more than -1, relative; "
                    * (column.kind in _RELATIVE)
                    + "take a smaller spread, or a uniform one (least, largest)"
                )


class Varied:
    """A robot and a start, and what draws make of them."""

    def __init__(self, columns: list[Column], plant: Plant, policy: Any, x0: Array) -> None:
        self._columns, self._plant, self._policy, self._x0 = columns, plant, policy, x0
        self.model = plant.robot._bare.model

    def _of(self, kind: str, drawn: Array, size: int, axes: int = 1) -> Array | None:
        """Return the draws (N, size, axes) of a kind, zero where nothing is drawn."""
        columns = [(at, each.at) for at, each in enumerate(self._columns) if each.kind == kind]
        if not columns:
            return None
        found = np.zeros((len(drawn), size, axes))
        for at, place in columns:
            found[(slice(None), *place)] = drawn[:, at]
        return found

    def starts(self, drawn: Array) -> tuple[Array, Array]:
        """Return configurations and velocities (N, nq), (N, nv) to begin at."""
        state, apart = self._plant.state, self._of("state", drawn, len(self._x0))
        x = self._x0 + (0.0 if apart is None else apart[..., 0])
        _, q, v = state.points(np.broadcast_to(x, (len(drawn), len(self._x0))))
        return q, v

    def bodies(self, drawn: Array) -> dict[int, tuple[Array, Array, Array]]:
        """Return masses (N,), centres (N, 3) and inertias (N, 3, 3) of bodies that are drawn."""
        size, found = self.model.njoints - ROOT, {}
        of = {kind: self._of(kind, drawn, size, 3 if kind in _AXES else 1) for kind in _OF_BODIES}
        for at in {each.at[0] for each in self._columns if each.kind in _OF_BODIES}:
            zero = np.zeros((len(drawn), 3))
            mass, com, inertia = (zero if of[k] is None else of[k][:, at] for k in _OF_BODIES)
            body = self.model.inertias[ROOT + at]
            found[at] = stretched(body, mass[:, 0], com, inertia)
        return found

    def in_lanes(self, drawn: Array, tree: Tree) -> dict[str, Array]:
        """Return what differs from run to run, as the compiled loop takes it."""
        plant = self._plant
        q, v = self.starts(drawn)
        runs = {"q": q, "nu": plant.state.velocities(v)}
        if bodies := self.bodies(drawn):
            parameters = np.tile(tree.bodies.reshape(1, -1, 10), (len(drawn), 1, 1))
            for at, (mass, com, inertia) in bodies.items():
                old = self.model.inertias[ROOT + at]
                before = _parameters(*(np.array([x]) for x in (old.mass, old.lever, old.inertia)))
                # Linear in these, so that wheels in the body stay as they are.
                parameters[:, at] += _turned(
                    _parameters(mass, com, inertia) - before, tree.axes[at]
                )
            runs["bodies"] = parameters.reshape(len(drawn), -1)
        for kind in _OF_SPRINGS:
            if (factor := self._of(kind, drawn, plant.robot.n)) is not None:
                runs[kind] = (1.0 + factor[..., 0]) * getattr(plant.robot.springs, kind)
        sensed = self._of("sensor", drawn, len(sensors_of(self._policy)))
        if sensed is not None and isinstance(self._policy, OutputFeedback):
            runs["y0"] = self._policy.compensator.y0 - sensed[..., 0]
        elif sensed is not None:
            offset = self._policy.terms(plant.state)[1]
            runs["offset"] = offset - sensed[..., 0] @ self._policy.K.T
        return runs | {
            key: value
            for key, value in self._drives(drawn)._asdict().items()
            if (value != getattr(plant.drives, key)).any()
        }

    def _drives(self, drawn: Array) -> Drives:
        nu = len(self._plant.drives.gain)
        gain, bias, fails = (self._of(kind, drawn, nu) for kind in _OF_INPUTS)
        none = np.zeros((len(drawn), nu))
        until = np.full_like(none, np.inf)
        if fails is not None:
            at = [each.at[0] for each in self._columns if each.kind == "fails"]
            until[:, at] = fails[:, at, 0]
        return Drives(
            1.0 + (none if gain is None else gain[..., 0]),
            none if bias is None else bias[..., 0],
            until,
        )

    def policy(self, drawn: Array) -> Any:
        """Return the policy of a run (k,), with the errors of its sensors."""
        sensed = self._of("sensor", drawn[None], len(sensors_of(self._policy)))
        if sensed is None:
            return self._policy
        bias = sensed[0, :, 0]
        if isinstance(self._policy, StateFeedback):
            return Biased(self._policy, -self._policy.K @ bias)
        before = self._policy.noise
        return replace(self._policy, noise=lambda t: bias + (before(t) if before else 0.0))

    def one(self, drawn: Array) -> tuple[Plant, Array, Array]:
        """Return the robot of a run (k,) with its inputs' errors, and q and v to begin at."""
        plant, rows = self._plant, drawn[None]
        robot: Robot = plant.robot
        q, v = self.starts(rows)
        if bodies := self.bodies(rows):
            of = {ROOT + at: tuple(x[0] for x in each) for at, each in bodies.items()}
            robot = with_inertias(robot, of)
        for kind in _OF_SPRINGS:
            if (factor := self._of(kind, rows, robot.n)) is not None:
                values = (1.0 + factor[0, :, 0]) * getattr(robot.springs, kind)
                given = dict(zip(robot.joint_names, values.tolist(), strict=True))
                robot = replace(robot, **{kind: given})
        state = type(plant.state)(robot, reference=plant.state.reference, frame=plant.state.frame)
        faulty = any(each.kind in _OF_INPUTS for each in self._columns)
        drives = Drives(*(x[0] for x in self._drives(rows))) if faulty else None
        return Plant(state, plant.disturbance, drives), q[0], v[0]


@dataclass(frozen=True)
class Biased:
    """A policy whose commands are shifted (nu,)."""

    policy: Any
    shift: Array

    def bind(self, robot: Robot) -> Callable[[float, Array, Array], Array]:
        """Return policy(t, q, v) -> u for a robot."""
        inner = bound(self.policy, robot)
        return lambda t, q, v: np.asarray(inner(t, q, v)) + self.shift


def sensors_of(policy: Any) -> tuple[str, ...]:
    """Return the names of what a policy measures, as far as that is known."""
    if isinstance(policy, StateFeedback):
        return policy.lin.state_names
    return policy.lin.output_names if isinstance(policy, OutputFeedback) else ()


def _parameters(mass: Array, com: Array, inertia: Array) -> Array:
    """Return m, m c, and I about the origin (xx xy xz yy yz zz) of bodies, (N, 10)."""
    square = (com * com).sum(axis=1)[:, None, None] * np.eye(3) - com[:, :, None] * com[:, None]
    about = inertia + mass[:, None, None] * square
    return np.column_stack((mass, mass[:, None] * com, about[:, *np.triu_indices(3)]))


def _turned(parameters: Array, axes: Array) -> Array:
    """Return parameters (N, 10) in other axes (3, 3)."""
    new = parameters.copy()
    new[:, 1:4] = parameters[:, 1:4] @ axes
    about = np.empty((len(new), 3, 3))
    rows, columns = np.triu_indices(3)
    about[:, rows, columns] = about[:, columns, rows] = parameters[:, 4:]
    new[:, 4:] = (axes.T @ about @ axes)[:, rows, columns]
    return new


def _inverse(name: str, spread: Any) -> Callable[[Array], Array]:
    """Return the inverse distribution function of a spread."""
    if hasattr(spread, "ppf"):
        try:
            middle = float(spread.ppf(0.5))
        except Exception:
            middle = np.nan
        if not np.isfinite(middle):
            raise InputError(f"the distribution of '{name}' has no median; freeze it first")
        return spread.ppf
    if isinstance(spread, tuple):
        if len(spread) != 2:
            raise InputError(f"'{name}' is {spread!r}, expected (least, largest)")
        least, largest = (number(f"'{name}'", each) for each in spread)
        if not least <= largest:
            raise InputError(f"'{name}' is ({least:g}, {largest:g}), expected (least, largest)")
        return partial(_uniform, least, largest)
    if isinstance(spread, list | np.ndarray):
        values = [number(f"'{name}'", each) for each in np.ravel(spread).tolist()]
        if not values:
            raise InputError(f"'{name}' has no values to choose from")
        return partial(_choice, np.array(values))
    deviation = number(f"'{name}'", spread)
    if deviation < 0.0:
        raise InputError(f"'{name}' is {deviation:g}, expected a standard deviation of 0 or more")
    return partial(_normal, deviation)


def _uniform(least: float, largest: float, u: Array) -> Array:
    return least + (largest - least) * u


def _choice(values: Array, u: Array) -> Array:
    return values[(u * len(values)).astype(int)]


def _normal(deviation: float, u: Array) -> Array:
    from scipy.special import ndtri

    normal: Array = deviation * ndtri(u)
    return normal
