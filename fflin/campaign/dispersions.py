"""Dispersions: random values by name, and the robots and initial states that follow from them."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import ChartError, InputError, UnknownNameError
from fflin.base.names import by_name, input_keys
from fflin.base.validation import Array, untied
from fflin.base.validation import by_name as mapping
from fflin.base.writing import reason
from fflin.campaign.pointing import columns_of, in_lanes, misaligned, require_direction
from fflin.campaign.spreads import SEED, deviation_of, inverse_of, is_closed_form, whole_number
from fflin.control.linear_controller import LinearController
from fflin.control.policies import Allocation, Policy, StateFeedback, bound, decider
from fflin.control.tracking import TrajectoryOutputFeedback
from fflin.dynamics.state import StateMap
from fflin.kernel.forward import ActuatorFaults
from fflin.kernel.tree import Tree, loads_of
from fflin.robot.equipment.assembly import first_impossible
from fflin.robot.joints import ROOT
from fflin.robot.mass_properties import bodies_named, varied, with_changed
from fflin.robot.robot import Robot
from fflin.simulation.lanes import noise_generator
from fflin.simulation.plan import Times
from fflin.simulation.run import Plant

_BLOCK = 1024  # runs drawn together, independent of the chunks
_OF_BODIES = {"mass": " ", "com": "xyz", "inertia": "xyz", "density": " "}  # {property: axes}
_AXES = _OF_BODIES | {"misalignment": "12"}
_OF_INPUTS, _OF_SPRINGS = ("gain", "bias", "fails"), ("stiffness", "damping")
_OF_SENSORS = ("sensor", "noise")
_FACTORS = ("mass", "inertia", "density", "frequency", *_OF_SPRINGS)


class Column(NamedTuple):
    """Random value of each run, and the quantities that this value changes."""

    name: str
    kind: str  # "state", "delay", "seed" (of noise), or the last part of a name
    at: tuple[tuple[int, int], ...]  # (index of state, body, joint, .., axis)
    inverse: Callable[[Array], Array]  # inverse distribution function


class Bound(NamedTuple):
    """Function that creates a policy for a robot, and the linear model of its design, if any."""

    bind: Callable[[Robot], Policy]
    lin: Any = None


class Dispersions:
    """Dispersions of `monte_carlo`: random values, and the runs' robots and initial states."""

    def __init__(
        self, given: object, plant: Plant, policy: object, x0: Array, seed: int, times: Times
    ) -> None:
        self._plant, self._policy, self._x0, self._seed = plant, policy, x0, seed
        self._times = times
        self._model = plant.robot._bare.model
        self._sensors: tuple[str, ...] = ()
        self._senses_states = isinstance(reads := decider(policy), StateFeedback)
        if isinstance(reads, StateFeedback | LinearController):
            lin = reads.lin
            self._sensors = lin.state_names if self._senses_states else lin.output_names
        if isinstance(reads, TrajectoryOutputFeedback):
            self._sensors = reads.filter.output_names
        known = {
            "state": plant.state.names,
            **dict.fromkeys(_OF_SENSORS, self._sensors),
            **dict.fromkeys(_OF_BODIES, tuple(plant.robot.pieces)),
            **dict.fromkeys((*_OF_INPUTS, "misalignment"), input_keys(plant.actuation)),
            **dict.fromkeys(_OF_SPRINGS, plant.robot.joint_names),
        }
        modes = tuple(each.name for each in plant.robot.modes)
        if modes:
            known["frequency"] = modes
        # Indices of the joints of the modes, in the order of the names.
        self._modes = [plant.robot.joint_names.index(name) for name in modes]
        by_kind: dict[str, dict[str, object]] = {}
        self.columns: list[Column] = []
        for key, spread in mapping("dispersions", given, "name").items():
            head, _, kind = str(key).rpartition(".")
            kind, head = (kind, head) if kind in known and head else ("state", str(key))
            if key == "delay":
                kind, known["delay"] = "delay", ("delay",)
            own, tied = untied(str(key), spread)
            if kind == "fails" and isinstance(own, int | float):
                raise InputError(
                    f"'{key}' is {own:g}, a standard deviation, but a time of failure needs "
                    "another description; give (least, largest) in s, a list of times in s or a "
                    "distribution"
                )
            inverse = deviation_of if kind == "noise" else inverse_of
            spreads = by_kind.setdefault(kind, {})
            spreads[head] = inverse(str(key), own), str(key) if tied else ""
        if "noise" in by_kind:
            self.columns.append(Column(SEED, "seed", ((0, 0),), whole_number))
        for kind, spreads in by_kind.items():
            self._add(kind, spreads, list(known[kind]), " | ".join([*known][1:]))
        if not self.columns:
            raise InputError(
                "dispersions is empty; give at least one dispersion, such as {'q_b': 0.05}"
            )
        self._kinds = {column.kind for column in self.columns}
        # Drawn values of slow distributions, by name and block.
        self._kept: dict[tuple[str, int], Array] = {}
        self._refuse_same_mass()

    def _refuse_same_mass(self) -> None:
        """Raise an error if a link's mass is dispersed twice, directly or as part of a body."""
        pieces = [*self._plant.robot.pieces.values()]
        masses = [*self._changed("mass"), *self._changed("density")]
        for (column, at), (other, of) in combinations(masses, 2):
            one, two = pieces[at], pieces[of]
            if at == of or (one.joint == two.joint and (one.whole or two.whole)):
                names = f"'{self.names[column]}' and '{self.names[other]}'"
                raise InputError(f"{names} disperse the same mass; disperse only one of them")

    def _add(self, kind: str, spreads: Mapping[str, Any], names: list[str], kinds: str) -> None:
        if kind in _OF_SENSORS and not names:
            raise InputError(
                f"'{next(iter(spreads))}.{kind}' is dispersed, but the policy "
                f"({type(decider(self._policy)).__name__}) has no sensors; use a StateFeedback, "
                "OutputFeedback or LinearController"
            )
        if kind in ("noise", "delay") and not self._times.sample:
            raise InputError(
                f"{kind} is dispersed, but the policy is continuous, and {kind} applies only to "
                "a sampled policy; give sample=, a multiple of dt (--sample on the command line)"
            )
        label = dict(zip(names, names, strict=True))
        try:
            if kind in _OF_BODIES:
                spreads, written = self._by_piece(kind, spreads)
                label |= written
            found = by_name(f"{kind} to disperse", spreads, names)
        except UnknownNameError as error:
            raise UnknownNameError(
                f"{error}" + f"; or NAME.({kinds})" * (kind == "state")
            ) from None
        draws: dict[str, tuple[Any, list[int]]] = {}
        for at, (inverse, tied) in sorted(found.items()):
            own = names[at] if kind in ("state", "delay") else f"{label[names[at]]}.{kind}"
            nominal = self._plant.robot.springs
            of_spring = kind in _OF_SPRINGS and not getattr(nominal, kind)[at]
            if of_spring or (kind == "frequency" and not nominal.stiffness[self._modes[at]]):
                raise InputError(
                    f"'{own}' is dispersed by a factor, but its nominal value is 0; remove the "
                    "dispersion, or give the robot a nonzero value"
                )
            if kind == "misalignment":
                require_direction(self._plant.robot, at)
            draws.setdefault(tied or own, (inverse, []))[1].append(at)
        for own, (inverse, targets) in draws.items():
            for axis, letter in enumerate(_AXES.get(kind, " ")):
                name = f"{own}.{letter}".rstrip(". ")
                where = tuple((at, axis) for at in targets)
                self.columns.append(Column(name, kind, where, inverse))

    def _by_piece(
        self, kind: str, spreads: Mapping[str, object]
    ) -> tuple[dict[str, Any], dict[str, str]]:
        """Return {link or body: spread}, and {link or body: key} for keys without a wildcard."""
        robot, found, named = self._plant.robot, dict[str, object](), dict[str, str]()
        alone = {*robot.pieces, *robot.link_of}
        for key in sorted(spreads, key=lambda key: key in alone):  # names override patterns
            for name in bodies_named(robot, f"{kind} to disperse", key):
                if name in named:
                    raise InputError(
                        f"'{named[name]}' and '{key}' are the same link; give its {kind} only once"
                    )
                found[name] = spreads[key]
                named |= {name: key} if key in alone else {}
        whole = {robot.pieces[name].joint for name in named if robot.pieces[name].whole}
        links = {name for name in found if robot.pieces[name].joint in whole}
        return {name: x for name, x in found.items() if name in named or name not in links}, named

    def _changed(self, *kinds: str) -> list[tuple[int, int]]:
        """Return (column, index of a state, body, joint, ..) for each quantity of these kinds."""
        columns = enumerate(self.columns)
        return [(i, at) for i, each in columns if each.kind in kinds for at, _ in each.at]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the dispersed values."""
        return tuple(column.name for column in self.columns)

    def drawn(self, start: int, stop: int) -> Array:
        """Return the values (N, k) of runs start to stop - 1.

        They depend only on seed, name and run.
        """
        drawn = np.empty((stop - start, len(self.columns)))
        for at, column in enumerate(self.columns):
            for first in range(start // _BLOCK * _BLOCK, stop, _BLOCK):
                low, high = max(start, first), min(stop, first + _BLOCK)
                values = self._drawn(column, first // _BLOCK, high - first)
                drawn[low - start : high - start, at] = values[low - first : high - first]
        return drawn

    def _uniform(self, column: Column, block: int) -> Array:
        key = (self._seed, zlib.crc32(column.name.encode()))
        stream = np.random.Philox(np.random.SeedSequence(key, spawn_key=(block,)))
        # The inverse may be infinite at 0 and 1, so the values are kept between them.
        return np.random.Generator(stream).random(_BLOCK).clip(1e-16, 1.0 - 1e-16)

    def _drawn(self, column: Column, block: int, count: int) -> Array:
        """Return the first `count` values of a block of runs.

        Values of slow distributions are kept for later calls.
        """
        uniform = self._uniform(column, block)
        if is_closed_form(column.inverse):
            return column.inverse(uniform)
        kept = self._kept.get((column.name, block), np.empty(0))
        if len(kept) < count:
            try:
                kept = np.asarray(column.inverse(uniform[:count]), dtype=float)
            except Exception as error:  # each distribution raises its own types
                raise InputError(
                    f"no values can be drawn from the distribution of '{column.name}': "
                    f"{reason(error)}"
                ) from None
            self._kept[column.name, block] = kept
        return kept

    def require_possible(self, runs: int) -> None:
        """Raise `InputError` if a drawn value gives an invalid robot or attitude."""
        for start in range(0, runs, _BLOCK):
            drawn = self.drawn(start, min(start + _BLOCK, runs))
            for values, column in zip(drawn.T, self.columns, strict=True):
                least = -1.0 if column.kind in _FACTORS else -np.inf
                bad = ~np.isfinite(values) | (values <= least)
                if bad.any():
                    run = int(bad.argmax())
                    bound = f" more than {least:g}" if np.isfinite(least) else " a finite number"
                    raise InputError(
                        f"'{column.name}' is drawn as {values[run]:.4g} in run {start + run}, "
                        f"for which no valid robot exists; expected{bound}. Use a smaller standard "
                        "deviation, or a uniform distribution (least, largest)"
                    )
            try:
                self.starts(drawn)
            except ChartError as error:
                said = f"an invalid initial attitude is drawn in the runs from {start} on"
                raise InputError(f"{said}: {error}; use a smaller dispersion") from None
            if not (appendages := self._plant.robot.appendages):
                continue
            # A drawn inertia may be too small for the flexible modes of its body.
            refused = first_impossible(self._model, appendages, self.bodies(drawn))
            if refused is not None:
                try:
                    self.one(drawn[refused])
                except InputError as error:
                    said = f"run {start + refused} draws an invalid mass or inertia"
                    raise InputError(f"{said}: {error}; use a smaller dispersion") from None

    def _of(self, kind: str, drawn: Array, size: int, axes: int = 1) -> Array:
        """Return the drawn values (N, size, axes) of a kind, or zeros if it is not dispersed."""
        found = np.zeros((len(drawn), size, axes))
        for values, column in zip(drawn.T, self.columns, strict=True):
            for at in column.at if column.kind == kind else ():
                found[(slice(None), *at)] = values
        return found

    def starts(self, drawn: Array) -> tuple[Array, Array]:
        """Return the initial configurations (N, nq) and velocities (N, nv)."""
        x = self._x0 + self._of("state", drawn, len(self._x0))[..., 0]
        return self._plant.state.points(x)[1:]

    def bodies(self, drawn: Array) -> dict[int, tuple[Array, Array, Array]]:
        """Return masses (N,), centres (N, 3) and inertias (N, 3, 3) of the dispersed bodies."""
        robot, model = self._plant.robot, self._model
        pieces = [*robot.pieces.values()]
        mass, com, inertia, density = (
            self._of(kind, drawn, len(pieces), len(axes)) for kind, axes in _OF_BODIES.items()
        )
        changed: dict[int, list[Array]] = {}
        for at in sorted({at for _, at in self._changed(*_OF_BODIES)}):
            joint = pieces[at].joint
            own = model.getJointId(robot.model.names[joint]) if joint > ROOT else ROOT
            changes = mass[:, at, 0], density[:, at, 0], com[:, at], inertia[:, at]
            changed.setdefault(own, []).append(varied(pieces[at], *changes))
        return {joint: with_changed(model.inertias[joint], x) for joint, x in changed.items()}

    def _springs(self, kind: str, drawn: Array) -> Array:
        robot = self._plant.robot
        factor: Array = 1.0 + self._of(kind, drawn, robot.n)[..., 0]
        # If the frequency of a mode changes, its damping ratio stays the same.
        frequency = 1.0 + self._of("frequency", drawn, len(self._modes))[..., 0]
        factor[:, self._modes] *= frequency ** (2 if kind == "stiffness" else 1)
        return factor * getattr(robot.springs, kind)

    @property
    def _springs_of(self) -> tuple[str, ...]:
        """Names of the dispersed properties: stiffness, damping, both or neither."""
        if "frequency" in self._kinds:
            return _OF_SPRINGS
        return tuple(kind for kind in _OF_SPRINGS if kind in self._kinds)

    def _faults(self, drawn: Array) -> ActuatorFaults | None:
        """Return the faults of the inputs in each run (N,), or None if no fault is dispersed."""
        if not self._kinds & {*_OF_INPUTS, "misalignment"}:
            return None
        gain, bias, until = (
            self._of(kind, drawn, len(self._plant.faults.gain))[..., 0] for kind in _OF_INPUTS
        )
        safe = np.ones(until.shape[1], dtype=bool)
        safe[[at for _, at in self._changed("fails")]] = False
        until[:, safe] = np.inf
        turn = columns_of(self._plant.robot, self._angles(drawn))
        return ActuatorFaults(1.0 + gain, bias, until, turn)

    def _angles(self, drawn: Array) -> Array:
        return self._of("misalignment", drawn, len(self._plant.faults.gain), 2)

    def _sensing(self, drawn: Array) -> tuple[Array, Array, Array]:
        """Return bias and deviation (N, ny) of the sensors, and the seed (N,) of their noise."""
        bias, noise = (self._of(key, drawn, len(self._sensors))[..., 0] for key in _OF_SENSORS)
        return bias, noise, self._of("seed", drawn, 1)[:, 0, 0]

    def delays(self, drawn: Array) -> Array:
        """Return the delays (N,) in integration steps."""
        late = self._of("delay", drawn, 1)[:, 0, 0] / self._times.dt
        return np.maximum(0.0, np.rint(self._times.delay + late))

    def in_lanes(self, drawn: Array, tree: Tree) -> dict[str, Array]:
        """Return the arrays of the compiled loop that vary between runs."""
        plant, (q, v) = self._plant, self.starts(drawn)
        runs = {"q": q, "nu": plant.state.velocities(v)}
        if faults := self._faults(drawn):
            runs |= faults._asdict()
        if self._kinds & {*_OF_BODIES}:
            parameters = np.tile(tree.bodies.reshape(1, -1, 10), (len(drawn), 1, 1))
            for at, body in self.bodies(drawn).items():
                # In the tree, wheels are numbered together with the joints.
                body_at = plant.robot.model.getJointId(self._model.names[at]) - ROOT
                old, axes = self._model.inertias[at], tree.axes[body_at]
                before = (np.array([x]) for x in (old.mass, old.lever, old.inertia))
                # Only the change of the body is added, because its parameters also contain its
                # wheels.
                parameters[:, body_at] += _parameters(axes, *body) - _parameters(axes, *before)
            runs["bodies"] = parameters.reshape(len(drawn), -1)
        runs |= {kind: self._springs(kind, drawn) for kind in self._springs_of}
        if "misalignment" in self._kinds:
            loads = loads_of(plant.robot, plant.actuation, tree)
            turned = in_lanes(plant.robot, tree, loads, self._angles(drawn))
            turned["bodies"] += runs.get("bodies", tree.bodies)
            runs |= turned
        if self._kinds & {*_OF_SENSORS}:
            names = plant.state.names if self._senses_states else self._sensors
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
        """Return a run's robot with its inputs, its policy, and its initial q and v."""
        plant, policy, rows = self._plant, self._policy, drawn[None]
        robot, (q, v) = plant.robot, self.starts(rows)
        bodies = {
            joint: pin.Inertia(float(mass[0]), com[0], inertia[0])
            for joint, (mass, com, inertia) in self.bodies(rows).items()
        }
        robot = robot.with_bodies(bodies) if bodies else robot
        for kind in self._springs_of:
            values = self._springs(kind, rows)[0].tolist()
            of: Any = {kind: dict(zip(robot.joint_names, values, strict=True))}
            robot = replace(robot, **of)
        if self._kinds & {*_OF_SENSORS}:
            policy = _with_sensor_errors(policy, *(each[0] for each in self._sensing(rows)))
        if "misalignment" in self._kinds:
            robot = misaligned(robot, self._angles(rows)[0])
            if isinstance(policy, Allocation):  # allocates to the nominal directions
                given = policy
                policy = Bound(lambda _: bound(given, plant.robot))
        state = StateMap(robot, reference=plant.state.reference, frame=plant.state.frame)
        faults = self._faults(rows)
        own = None if faults is None else ActuatorFaults(*(x[0] for x in faults))
        return Plant(state, plant.disturbance, own), policy, q[0], v[0]


def _with_sensor_errors(policy: Any, bias: Array, deviation: Array, seed: float) -> Any:
    """Return a policy whose states or outputs (ny,) have these measurement errors."""
    if isinstance(policy, Allocation):
        return replace(policy, policy=_with_sensor_errors(policy.policy, bias, deviation, seed))
    generator, given = noise_generator(seed), getattr(policy, "noise", None)

    def error(t: float) -> Array:
        found: Array = bias + deviation * generator.standard_normal(len(bias))
        return found if given is None else found + np.asarray(given(t))

    def bind(robot: Robot) -> Policy:
        inner = bound(policy, robot)
        return lambda t, q, v: np.asarray(inner(t, q, v)) - policy.K @ error(t)

    if isinstance(policy, StateFeedback):
        return Bound(bind, policy.lin)
    noisy = copy(policy)
    noisy.noise = error
    return noisy


def _parameters(axes: Array, mass: Array, com: Array, inertia: Array) -> Array:
    """Return the inertial parameters (N, 10) of bodies along `axes`, the columns of a matrix.

    The parameters are the mass m, the products m c with the centre of mass c, and the inertia about
    the origin (xx xy xz yy yz zz).
    """
    square = (com * com).sum(axis=1)[:, None, None] * np.eye(3) - com[:, :, None] * com[:, None]
    about = axes.T @ (inertia + mass[:, None, None] * square) @ axes
    rows, columns = np.triu_indices(3)
    return np.column_stack((mass, mass[:, None] * (com @ axes), about[:, rows, columns]))
