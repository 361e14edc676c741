"""Dispersions: random changes of the robot, sensors, delay and initial state of each run."""

import math
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cached_property, partial
from itertools import combinations
from operator import attrgetter
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import (
    ChartError,
    ConstraintError,
    InputError,
    UnknownNameError,
)
from fflin.base.names import by_name, group_of, input_keys, stands_for_any
from fflin.base.rotation import row_products
from fflin.base.validation import Array, Indices, untied
from fflin.base.validation import by_name as mapping
from fflin.base.writing import reason
from fflin.campaign.spreads import SEED, SEEDS, Inverse, inverse_of
from fflin.control.data_sheet import Deviations, output_keys
from fflin.control.policy import Command, Policy, bound
from fflin.control.sensor_errors import SensorErrors
from fflin.dynamics.coordinates import PIN_ANGULAR, PIN_LINEAR
from fflin.dynamics.disturbance import Plate, distortion
from fflin.dynamics.state import StateMap
from fflin.kernel.forward import ActuatorFaults
from fflin.kernel.tree import Tree, batch_tree
from fflin.linear.model import LinearModel
from fflin.robot.disturbance import (
    MAGNETIC,
    PLATE,
    RESIDUAL_DIPOLE,
    UNITS,
    DisturbanceTerm,
    MagneticTerm,
    magnetic_values,
    plates_of,
    terms_of,
)
from fflin.robot.equipment.assembly import first_impossible, turned_to
from fflin.robot.fields import warn_of_degrees
from fflin.robot.inputs import JointTorque, ReactionWheel, Thruster
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.mass_properties import properties, varied
from fflin.robot.robot import Robot
from fflin.simulation.extension import DRAG, SUNLIGHT
from fflin.simulation.lanes import (
    DISTORTION,
    DISTURBANCE,
    RESIDUAL,
    disturbances_of,
)
from fflin.simulation.plan import Times
from fflin.simulation.plant import Plant

# number of runs whose values are drawn together; does not depend on the chunks
_BLOCK = 1024

# Probabilities at one standard deviation of a normal distribution.
_ONE_SIGMA = np.array([0.15865525393145707, 0.8413447460685429])

# Names of the axes, for the kinds of dispersions that have one value per axis.
_AXES = {"com": "xyz", "inertia": "xyz", "misalignment": "12"}
_OF_BODIES = ("mass", "com", "inertia", "density")
_OF_INPUTS, _OF_SPRINGS = ("gain", "bias", "fails"), ("stiffness", "damping")
_OF_SENSORS = ("sensor", "noise", "drift")
# Kinds that need a sampled law, and whose number is the value in all runs.
_RANDOM_ERRORS = ("noise", "drift")
_DISTURBANCES = tuple(f"{name}.{axis}" for name in UNITS for axis in "xyz")
# Disturbances in a magnetic field, in addition to `_DISTURBANCES`.
_MAGNETIC = tuple(
    f"{name}.{axis}" if count == 3 else name
    for name, (count, _, _) in MAGNETIC.items()
    for axis in "xyz"[:count]
)
# Kind of the relative changes of the amplitudes of periodic disturbances.
_AMPLITUDE = "amplitude"
# Kinds of the relative changes of the forces on flat plates.
_OF_PLATES = (DRAG, SUNLIGHT)
_FACTORS = (
    "mass",
    "inertia",
    "density",
    "frequency",
    _AMPLITUDE,
    *_OF_PLATES,
    *_OF_SPRINGS,
)


class Column(NamedTuple):
    """Random variable with one value per run, and the quantities that this value changes."""

    name: str
    # "state", "delay", "seed" (of noise), or the last part of a name, such as "mass"
    kind: str
    at: list[int]  # indices of the changed quantities in `Dispersions._known[kind]`
    axis: int
    inverse: Inverse


class Dispersions:
    """Dispersions of `monte_carlo`: random changes of the plant, policy and initial state."""

    def __init__(
        self,
        given: object,
        plant: Plant,
        policy: Policy | None,
        x0: Array,
        seed: int,
        times: Times,
        declared: Deviations | None = None,
    ) -> None:
        self._plant, self._policy, self._x0, self._seed = plant, policy, x0, seed
        self._times = times
        robot = plant.robot
        self._model = robot._bare.model
        sensors = policy.sensors if policy else ()
        modes = tuple(map(attrgetter("name"), robot.modes))
        # {kind of dispersion: names of the quantities that can be dispersed}.
        self._known: dict[str, tuple[str, ...]] = {
            **dict.fromkeys(_OF_SENSORS, sensors),
            **dict.fromkeys(_OF_BODIES, tuple(robot.pieces)),
            **dict.fromkeys((*_OF_INPUTS, "misalignment"), input_keys(plant.actuation)),
            **dict.fromkeys(_OF_SPRINGS, robot.joint_names),
            "frequency": modes,
            DISTURBANCE: _disturbances(robot),
            _AMPLITUDE: _periodic(robot),
            **{kind: names for kind, (names, _) in _plates(plant).items()},
        }
        kinds = [*self._known]
        self._known |= {
            "state": plant.state.names,
            "delay": ("delay",),
            "seed": (SEED,),
        }
        # Joint index of each mode, in the order of `modes`.
        self._modes = [*map(robot.joint_names.index, modes)]
        by_kind: dict[str, dict[str, tuple[Inverse, str]]] = {}
        for key, spread in mapping("dispersions", given, "name").items():
            head, _, kind = str(key).rpartition(".")
            if kind not in kinds or not head:
                head = str(key)
                kind = "delay" if key == "delay" else "state"
            plain_spread, tied = untied(str(key), spread)
            group = str(key) if tied else ""
            if kind == "fails" and isinstance(plain_spread, int | float):
                raise InputError(
                    f"'{key}' is {plain_spread:g}, a standard deviation, but a time of failure "
                    "needs another description; give (least, largest) in s, a list of times in s "
                    "or a distribution"
                )
            if kind in _OF_SENSORS:
                head = output_keys([head], sensors)[head]
            inverse = inverse_of(str(key), plain_spread, fixed=kind in _RANDOM_ERRORS)
            by_kind.setdefault(kind, {})[head] = inverse, group
        if not by_kind:
            raise InputError(
                "dispersions is empty; give at least one dispersion, such as {'q_b': 0.05}"
            )
        if declared is not None:
            _add_declared(by_kind, declared, sensors)
        self._kinds = {*by_kind}
        self.columns: list[Column] = []
        if self._kinds & {*_RANDOM_ERRORS}:
            self.columns.append(Column(SEED, "seed", [0], 0, SEEDS))
        for kind, spreads in by_kind.items():
            self._add(kind, spreads, kinds)
        self._warn_of_degrees()
        # Names of the dispersed values.
        self.names = tuple(map(attrgetter("name"), self.columns))
        # Cached values of slow distributions: {(name, block of runs): values}.
        self._kept: dict[tuple[str, int], Array] = {}
        # The same mass must not be dispersed twice, for example for a link and for the whole body
        # that contains the link.
        pieces = [*robot.pieces.values()]
        masses = list[tuple[str, int]]()
        for kind in ("mass", "density"):
            masses += (
                (x.name, at) for x in self.columns if x.kind == kind for at in x.at
            )
        for (name, at), (other, other_at) in combinations(masses, 2):
            one, two = pieces[at], pieces[other_at]
            if at == other_at or (one.joint == two.joint and (one.whole or two.whole)):
                raise InputError(
                    f"'{name}' and '{other}' disperse the same mass; disperse only one of them"
                )

    def _add(
        self, kind: str, spreads: Mapping[str, tuple[Inverse, str]], kinds: list[str]
    ) -> None:
        """Add the columns of one kind of dispersion.

        `spreads` is {name, group or pattern: (inverse distribution function, common name)}. If the
        common name is not empty, all quantities that match the key share the column with this name,
        or one such column for each axis. `kinds` lists all kinds for messages.
        """
        robot = self._plant.robot
        names = self._known[kind]
        if not names:
            self._refuse(kind, next(iter(spreads)))
        if kind in (*_RANDOM_ERRORS, "delay") and not self._times.sample:
            raise InputError(
                f"{kind} is dispersed, but the policy is continuous, and {kind} applies only to "
                "a sampled policy; give sample=, a multiple of dt (--sample on the command line)"
            )
        _require_kinds(kind, spreads, names, kinds)
        written = dict[str, str]()
        try:
            if kind in _OF_BODIES:
                spreads, written = self._by_piece(kind, spreads)
            spread_of_index = by_name(f"{kind} to disperse", spreads, names)
        except UnknownNameError as error:
            message = str(error)
            if kind == "state" and not message.endswith("?"):
                message += f"; or NAME.({' | '.join(kinds)})"
            raise UnknownNameError(message) from None
        nominal = robot.springs._asdict()
        of_modes = robot.springs.stiffness[self._modes]
        factors = {**nominal, "frequency": of_modes}.get(kind)
        draws: dict[str, tuple[Inverse, list[int]]] = {}
        for at, (inverse, tied) in sorted(spread_of_index.items()):
            title = names[at]
            if kind not in ("state", "delay"):
                title = f"{written.get(title, title)}.{kind}"
            if factors is not None and not factors[at]:
                raise InputError(
                    f"'{title}' is dispersed by a factor, but its nominal value is 0; remove the "
                    "dispersion, or give the robot a nonzero value"
                )
            if kind == "misalignment" and group_of(names[at]) == JointTorque.GROUP:
                raise InputError(
                    f"'{title}' is dispersed, but the motor of a joint cannot be misaligned with "
                    "the joint; only thrusters, wheels, tau_b and F_b can be misaligned"
                )
            draws.setdefault(tied or title, (inverse, []))[1].append(at)
        for title, (inverse, targets) in draws.items():
            for axis, letter in enumerate(_AXES.get(kind, " ")):
                name = f"{title}.{letter}".rstrip(". ")
                self.columns.append(Column(name, kind, targets, axis, inverse))

    def _refuse(self, kind: str, key: str) -> None:
        """Raise `InputError` for a quantity that the robot or the policy does not have."""
        robot = self._plant.robot
        what = f"'{key}.{kind}' is dispersed, but"
        if kind in _OF_SENSORS:
            named = self._policy.inner.kind if self._policy else "None"
            raise InputError(
                f"{what} the policy ({named}) has no sensors; use a StateFeedback, OutputFeedback "
                "or LinearController"
            )
        if kind == _AMPLITUDE:
            raise InputError(
                f"{what} '{robot.name}' has no periodic disturbance; give the robot one, with "
                "amplitude= and frequency="
            )
        if kind in _OF_PLATES:
            raise InputError(
                f"{what} no flat plate of '{robot.name}' has {kind}; give it one in the table "
                "[[disturbance.plate]]"
            )

    def _warn_of_degrees(self) -> None:
        """Warn of dispersions of joint positions and rates that look like degrees."""
        names = self._known["state"]
        sizes = dict[str, float]()
        for column in self.columns:
            # fast functions from the module `spreads`
            if column.kind == "state" and isinstance(column.inverse, partial):
                quantiles = column.inverse(_ONE_SIGMA)
                size = float(np.abs(quantiles).max())
                sizes |= {names[index]: size for index in column.at}
        warn_of_degrees(self._plant.robot, sizes)

    def _by_piece(
        self, kind: str, spreads: Mapping[str, tuple[Inverse, str]]
    ) -> tuple[dict[str, tuple[Inverse, str]], dict[str, str]]:
        """Return {link or body: spread}, and {link or body: its key in `spreads`}.

        The second mapping omits keys with wildcards. A key without a wildcard overrides patterns
        that match the same link or body. If the key names a body of several links, it also
        overrides patterns that match these links.
        """
        robot = self._plant.robot
        spread_of_piece = dict[str, tuple[Inverse, str]]()
        named = dict[str, str]()
        alone = {*robot.pieces, *robot.link_of}
        whole = set[int]()
        # names come last to override patterns
        for key in sorted(spreads, key=alone.__contains__):
            for name in robot.bodies_named(f"{kind} to disperse", key):
                if name in named:
                    raise InputError(
                        f"'{named[name]}' and '{key}' are the same link; give its {kind} only once"
                    )
                spread_of_piece[name] = spreads[key]
                if key in alone:
                    named[name] = key
                    if robot.pieces[name].whole:
                        whole.add(robot.pieces[name].joint)
        for name in spread_of_piece.keys() - named:
            if robot.pieces[name].joint in whole:
                del spread_of_piece[name]
        return spread_of_piece, named

    def drawn(self, start: int, stop: int) -> Array:
        """Return the drawn values (N, k) of runs start to stop - 1.

        Each value is determined by its distribution, its name, the seed and the number of the run.
        """
        drawn = np.empty((stop - start, len(self.columns)))
        for at, column in enumerate(self.columns):
            for first in range(start // _BLOCK * _BLOCK, stop, _BLOCK):
                low, high = max(start, first), min(stop, first + _BLOCK)
                values = self._drawn(column, first // _BLOCK, high - first)
                drawn[low - start : high - start, at] = values[
                    low - first : high - first
                ]
        return drawn

    def _drawn(self, column: Column, block: int, count: int) -> Array:
        """Return at least the first `count` values of a column in a block of _BLOCK runs.

        The values of slow distributions are cached for later calls.
        """
        key = (self._seed, zlib.crc32(column.name.encode()))
        stream = np.random.Philox(np.random.SeedSequence(key, spawn_key=(block,)))
        # An inverse distribution function can be infinite at 0 and 1, so both are excluded.
        uniform = np.random.Generator(stream).random(_BLOCK).clip(1e-16, 1.0 - 1e-16)
        # a fast function from the module `spreads`
        if isinstance(column.inverse, partial):
            values: Array = column.inverse(uniform)
            return values
        kept = self._kept.get((column.name, block), np.empty(0))
        if len(kept) < count:
            try:
                kept = np.asarray(column.inverse(uniform[:count]), dtype=float)
            except Exception as error:  # a distribution may raise any exception
                raise InputError(
                    f"no values can be drawn from the distribution of '{column.name}': "
                    f"{reason(error)}"
                ) from None
            self._kept[column.name, block] = kept
        return kept

    def require_possible(self, runs: int) -> None:
        """Raise `InputError` if a drawn value gives an invalid robot or initial attitude."""
        for start in range(0, runs, _BLOCK):
            drawn = self.drawn(start, min(start + _BLOCK, runs))
            for values, column in zip(drawn.T, self.columns, strict=True):
                least = -1.0 if column.kind in _FACTORS else -np.inf
                bad = ~np.isfinite(values) | (values <= least)
                if bad.any():
                    run = int(bad.argmax())
                    bound = (
                        f" more than {least:g}"
                        if np.isfinite(least)
                        else " a finite number"
                    )
                    raise InputError(
                        f"'{column.name}' is drawn as {values[run]:.4g} in run {start + run}, "
                        f"for which no valid robot exists; expected{bound}. Use a smaller standard "
                        "deviation, or a uniform distribution (least, largest)"
                    )
            problem = (
                f"an invalid initial attitude is drawn in the runs from {start} on"
            )
            try:
                self.starts(drawn)
                # A drawn mass or inertia can be too small for the flexible modes of its body.
                if self._plant.robot.appendages:
                    refused = first_impossible(
                        self._model, self._plant.robot.appendages, self.bodies(drawn)
                    )
                    if refused is not None:
                        problem = (
                            f"run {start + refused} draws an invalid mass or inertia"
                        )
                        self.one(drawn[refused])
            except ConstraintError as error:
                raise InputError(
                    f"the initial state of a run from {start} on cannot satisfy the constraints: "
                    f"{error}; use a smaller dispersion"
                ) from None
            except (ChartError, InputError) as error:
                raise InputError(
                    f"{problem}: {error}; use a smaller dispersion"
                ) from None

    def _of(self, kind: str, drawn: Array, rest: float = 0.0) -> Array:
        """Return the values (N, size) or (N, size, axes) of all quantities of a kind of dispersion.

        `drawn` (N, k) contains the drawn values. `size` is the number of quantities of this
        kind. Quantities that are not dispersed have the value `rest`.
        """
        axes = len(_AXES.get(kind, " "))
        kind_values = np.full((len(drawn), len(self._known[kind]), axes), rest)
        for values, column in zip(drawn.T, self.columns, strict=True):
            if column.kind == kind:
                kind_values[:, column.at, column.axis] = values[:, None]
        if axes == 1:
            kind_values = kind_values[..., 0]
        return kind_values

    def starts(self, drawn: Array) -> tuple[Array, Array]:
        """Return the initial configurations (N, nq) and velocities (N, nv)."""
        q, v = self._plant.state.points(self._x0 + self._of("state", drawn))[1:]
        constrained = self._plant.constrained
        if constrained is None or "state" not in self._kinds:
            return q, v
        rows = [
            constrained.completed(*row, self._dependent)
            for row in zip(q, v, strict=True)
        ]
        closed_q, closed_v = map(np.array, zip(*rows, strict=True))
        return closed_q, closed_v

    @cached_property
    def _dependent(self) -> Indices:
        """Indices in nu of the coordinates that constraints determine from the drawn ones."""
        plant = self._plant
        assert plant.constrained is not None
        size = plant.state.nx // 2
        drawn = np.zeros(size, dtype=bool)
        for column in self.columns:
            if column.kind == "state":
                drawn[np.array(column.at) % size] = True
        q, _ = plant.state.to_pinocchio(self._x0)
        return plant.constrained.dependent(q, drawn)

    def bodies(self, drawn: Array) -> dict[int, tuple[Array, Array, Array]]:
        """Return {joint: (masses (N,), centres of mass (N, 3), inertias (N, 3, 3))} of bodies.

        Only dispersed bodies are included. Each key is the index of a joint in `_model`. The
        inertias are about the centres of mass.
        """
        robot = self._plant.robot
        model = self._model
        pieces = [*robot.pieces.values()]
        mass = self._of("mass", drawn)
        density = self._of("density", drawn)
        com = self._of("com", drawn)
        inertia = self._of("inertia", drawn)
        dispersed = set[int]()
        for column in self.columns:
            if column.kind in _OF_BODIES:
                dispersed.update(column.at)
        # {joint: changes (N, 4, 4) of the pseudo-inertia}; a body may consist of several pieces
        changes = dict[int, Array]()
        for at in sorted(dispersed):
            piece = pieces[at]
            # `_model` has no wheels and no modes, so its joints have other indices.
            joint = ROOT
            if piece.joint > ROOT:
                joint = model.getJointId(robot.model.names[piece.joint])
            change = varied(
                piece, mass[:, at], density[:, at], com[:, at], inertia[:, at]
            )
            changes[joint] = changes.get(joint, 0.0) + change
        result = dict[int, tuple[Array, Array, Array]]()
        for joint, change in changes.items():
            nominal = model.inertias[joint].toPseudoInertia().toMatrix()
            result[joint] = properties(nominal + change)
        return result

    def _springs(self, drawn: Array) -> dict[str, Array]:
        """Return {"stiffness" or "damping": values (N, n) of all joints}.

        A property that no dispersion changes is omitted.
        """
        springs = dict[str, Array]()
        # The stiffness of a mode is proportional to w^2, and its damping to zeta w. Here w is the
        # frequency. The damping ratio zeta does not change with w.
        frequency = 1.0 + self._of("frequency", drawn)
        for kind, power in zip(_OF_SPRINGS, (2, 1), strict=True):
            if self._kinds & {kind, "frequency"}:
                factor = 1.0 + self._of(kind, drawn)
                factor[:, self._modes] *= frequency**power
                springs[kind] = factor * getattr(self._plant.robot.springs, kind)
        return springs

    def _faults(self, drawn: Array) -> ActuatorFaults | None:
        """Return the actuator faults of N runs, or None if no fault is dispersed."""
        if not self._kinds & {*_OF_INPUTS, "misalignment"}:
            return None
        gain, bias = self._of("gain", drawn), self._of("bias", drawn)
        until = self._of("fails", drawn, np.inf)
        angles = self._of("misalignment", drawn)
        # the actual axes of tau_b and F_b
        turn: list[Array] = [np.empty((len(drawn), 0))]
        for first in self._plant.triads:
            turn += [
                turned(axis, angles[:, first + k]) for k, axis in enumerate(np.eye(3))
            ]
        return ActuatorFaults(1.0 + gain, bias, until, np.concatenate(turn, axis=1))

    def _amplitudes(self, drawn: Array) -> dict[str, Array]:
        """Return factors {"tau_b" or "F_b": (N, 3)} of the amplitudes of periodic disturbances."""
        factors = np.ones((len(drawn), len(_DISTURBANCES)))
        at = [_DISTURBANCES.index(name) for name in self._known[_AMPLITUDE]]
        factors[:, at] += self._of(_AMPLITUDE, drawn)
        return dict(zip(UNITS, np.split(factors, len(UNITS), axis=1), strict=True))

    def _plate_forces(self, drawn: Array) -> dict[str, Array]:
        """Return {kind of force: forces (N, k) [N]} of the flat plates, if they are dispersed."""
        return {
            kind: forces * self._plate_factors(kind, drawn)
            for kind, (_, forces) in _plates(self._plant).items()
            if kind in self._kinds
        }

    def _plate_factors(self, kind: str, drawn: Array) -> Array:
        """Return the factors (N, k) of drag or solar pressure on all flat plates."""
        forces = _plates(self._plant)[kind][1]
        factors = np.ones((len(drawn), len(forces)))
        factors[:, forces > 0.0] += self._of(kind, drawn)
        return factors

    def delays(self, drawn: Array) -> Array:
        """Return the total delays (N, k) in integration steps, with the columns of `Times.delays`.

        The drawn delay changes the delay of every input.
        """
        late = self._of("delay", drawn)[:, :1] / self._times.dt
        steps: Array = np.maximum(0.0, np.rint(np.array(self._times.delays) + late))
        return steps

    def in_lanes(self, drawn: Array) -> dict[str, Array]:
        """Return the arrays of the compiled loop that differ between runs, one row per run."""
        plant, (q, v), count = self._plant, self.starts(drawn), len(drawn)
        tree = batch_tree(plant.robot)
        assert tree is not None
        runs = {"q": q, "nu": plant.state.velocities(v), **self._springs(drawn)}
        if faults := self._faults(drawn):
            runs |= faults._asdict()
        if self._kinds & {*_OF_BODIES}:
            parameters = np.tile(tree.bodies.reshape(1, -1, 10), (count, 1, 1))
            for at, body in self.bodies(drawn).items():
                # The tree also contains the wheels, so the index of a body differs from its index
                # in `_model`.
                body_at = plant.robot.model.getJointId(self._model.names[at]) - ROOT
                old, axes = self._model.inertias[at], tree.axes[body_at]
                before = (np.array([x]) for x in (old.mass, old.lever, old.inertia))
                # `parameters` include the wheels of a body, but `body` and `before` do not.
                # Therefore only the change from `before` to `body` is added to `parameters`.
                parameters[:, body_at] += _parameters(axes, *body) - _parameters(
                    axes, *before
                )
            runs["bodies"] = parameters.reshape(count, -1)
        if "misalignment" in self._kinds:
            pointed = _pointed_lanes(plant.robot, tree, self._of("misalignment", drawn))
            pointed["bodies"] += runs.get("bodies", tree.bodies)
            runs |= pointed
        if self._kinds & {*_OF_SENSORS}:
            runs |= self._sensors_in_lanes(drawn)
        if self._kinds & {DISTURBANCE, _AMPLITUDE}:
            waves = disturbances_of(plant.robot, dispersed=True)
            vectors = np.tile([wave.vector for wave in waves], (count, 1, 1))
            factors = self._amplitudes(drawn)
            for at, wave in enumerate(waves):
                if wave.rate:
                    vectors[:, at] *= factors[wave.name]
            vectors = vectors.reshape(count, -1)
            # The last two terms are the dispersed constants, in the order of `_DISTURBANCES`.
            size = len(_DISTURBANCES)
            vectors[:, -size:] = self._of(DISTURBANCE, drawn)[:, :size]
            runs[DISTURBANCE] = vectors
        if self._magnetic:
            runs |= self._magnetic_in_lanes(drawn)
        runs |= self._plate_forces(drawn)
        if "delay" in self._kinds:
            runs["delay"] = self.delays(drawn)
        return runs

    @property
    def _magnetic(self) -> bool:
        """Whether the residual dipole or the errors of the magnetic field are dispersed."""
        first = len(_DISTURBANCES)
        columns = [column for column in self.columns if column.kind == DISTURBANCE]
        return any(at >= first for column in columns for at in column.at)

    def _magnetic_in_lanes(self, drawn: Array) -> dict[str, Array]:
        """Return the arrays of `in_lanes` for the residual dipole and the errors of the field."""
        plant = self._plant
        assert plant.field is not None
        robots = [
            _with_magnetic(plant.robot, row) for row in self._of(DISTURBANCE, drawn)
        ]
        residual = [
            magnetic_values(robot.disturbance, RESIDUAL_DIPOLE) for robot in robots
        ]
        matrices = [distortion(robot, plant.field) for robot in robots]
        flat = [(np.eye(3) if x is None else x).ravel("F") for x in matrices]
        return {RESIDUAL: np.array(residual), DISTORTION: np.array(flat)}

    def _sensors_in_lanes(self, drawn: Array) -> dict[str, Array]:
        """Return the arrays of `in_lanes` for the errors of sensors."""
        sensors, plant = self._known["sensor"], self._plant
        of_outputs = self._policy is not None and self._policy.senses_outputs
        names = sensors if of_outputs else plant.state.names
        fed = [names.index(name) for name in sensors]
        kinds = {"sensed": "sensor", "noise": "noise"}
        if "drift" in self._kinds:
            kinds["drift"] = "drift"
        arrays = dict[str, Array]()
        for key, kind in kinds.items():
            arrays[key] = np.zeros((len(drawn), len(names)))
            arrays[key][:, fed] = self._of(kind, drawn)
        if "drift" in arrays:
            arrays["drift"] *= self._root_of_sample
        if self._kinds & {*_RANDOM_ERRORS}:
            arrays["seed"] = self._of("seed", drawn)[:, 0]
        return arrays

    @property
    def _root_of_sample(self) -> float:
        """Square root of the sample time of the law [s^0.5]."""
        return math.sqrt(self._times.sample * self._times.dt)

    def one(self, drawn: Array) -> tuple[Plant, Policy | None, Array, Array]:
        """Return the plant, the policy, and the initial q and v of a run with drawn values (k,)."""
        plant = self._plant
        policy = self._policy.fresh() if self._policy else None
        rows = drawn[None]
        robot, (q, v) = plant.robot, self.starts(rows)
        bodies = self.bodies(rows)
        if bodies:
            drawn_bodies = dict[int, pin.Inertia]()
            for joint, (mass, com, inertia) in bodies.items():
                drawn_bodies[joint] = pin.Inertia(float(mass[0]), com[0], inertia[0])
            robot = robot.with_bodies(drawn_bodies)
        springs = {"stiffness": robot.stiffness, "damping": robot.damping}
        for kind, values in self._springs(rows).items():
            springs[kind] = dict(
                zip(robot.joint_names, values[0].tolist(), strict=True)
            )
        robot = replace(
            robot, stiffness=springs["stiffness"], damping=springs["damping"]
        )
        if self._kinds & {DISTURBANCE, _AMPLITUDE}:
            factors = {name: x[0] for name, x in self._amplitudes(rows).items()}
            constants = self._of(DISTURBANCE, rows)[0]
            robot = _disturbed(robot, constants[: len(_DISTURBANCES)], factors)
            if self._magnetic:
                robot = _with_magnetic(robot, constants)
        if self._kinds & {*_OF_PLATES}:
            plates = [self._plate_factors(kind, rows)[0] for kind in _OF_PLATES]
            robot = _with_plates(robot, *plates)
        if policy and self._kinds & {*_OF_SENSORS}:
            bias, noise, drift, (seed,) = (
                self._of(kind, rows)[0] for kind in (*_OF_SENSORS, "seed")
            )
            policy = with_sensor_errors(
                policy, bias, noise, seed, self._root_of_sample * drift
            )
        if "misalignment" in self._kinds:
            robot = _misaligned(robot, self._of("misalignment", rows)[0])
            if policy and policy.commanded_robot:
                # The allocation must use the nominal directions.
                policy = _Bound(policy, plant.robot)
        state = StateMap(
            robot, reference=plant.state.reference, frame=plant.state.frame
        )
        faults = self._faults(rows)
        actuator_faults = None
        if faults is not None:
            first = [values[0] for values in faults]
            actuator_faults = ActuatorFaults(*first)
        drawn_plant = Plant(state, plant.disturbance, actuator_faults)
        return drawn_plant, policy, *drawn_plant.constrain(q[0], v[0])


@dataclass(eq=False)
class _Bound(Policy):
    """Policy that is bound to a given robot, whatever robot is simulated."""

    policy: Policy
    robot: Robot

    @property
    def model(self) -> LinearModel | None:
        """Model of the policy."""
        return self.policy.model

    def bind(self, robot: Robot) -> Command:
        """Return the command of the policy for its own robot."""
        return bound(self.policy, self.robot)


def _require_kinds(
    kind: str, keys: Iterable[str], names: Sequence[str], kinds: Sequence[str]
) -> None:
    """Raise `UnknownNameError` for a key that names no state, and ends in a misspelt kind.

    A kind without the name of a quantity before it, such as "mass", is also refused.
    """
    if kind != "state":
        return
    for key in keys:
        head, _, end = key.rpartition(".")
        near = get_close_matches(end.lower(), (*kinds, "delay"), n=1)
        if stands_for_any(key, names) or not near:
            continue
        meant = f"{head or '*'}.{near[0]}"
        if near == ["delay"]:
            meant = "delay"
        raise UnknownNameError(
            f"no state to disperse named '{key}'; did you mean {meant}?"
        )


def _periodic(robot: Robot) -> tuple[str, ...]:
    """Return the entries of `_DISTURBANCES` that periodic terms of a robot contain."""
    names = set[str]()
    for name, term in terms_of(robot.disturbance):
        amplitudes = zip("xyz", term.amplitude, strict=True)
        names.update(f"{name}.{axis}" for axis, amplitude in amplitudes if amplitude)
    return tuple(name for name in _DISTURBANCES if name in names)


def _plates(plant: Plant) -> dict[str, tuple[tuple[str, ...], Array]]:
    """Return {kind of force: (names, forces (k,) [N])} of the k flat plates of a robot.

    The names, such as plate_1, belong to the plates on which the force acts.
    """
    plates = [Plate(plate, plant.field) for plate in plates_of(plant.robot.disturbance)]
    forces = {
        DRAG: np.array([plate.drag for plate in plates]),
        SUNLIGHT: np.array([plate.sunlight for plate in plates]),
    }
    return {
        kind: (tuple(f"{PLATE}_{at + 1}" for at in np.flatnonzero(values)), values)
        for kind, values in forces.items()
    }


def _with_plates(robot: Robot, drag: Array, sunlight: Array) -> Robot:
    """Return a robot whose flat plates have drag and solar pressure multiplied by factors (k,)."""
    plates = zip(plates_of(robot.disturbance), drag, sunlight, strict=True)
    scaled = tuple(
        replace(
            plate,
            density=plate.density * float(of_drag),
            solar_pressure=plate.solar_pressure * float(of_sunlight),
        )
        for plate, of_drag, of_sunlight in plates
    )
    return replace(robot, disturbance={**robot.disturbance, PLATE: scaled})


def _disturbed(robot: Robot, drawn: Array, factors: Mapping[str, Array]) -> Robot:
    """Return a robot with further constant disturbances and other amplitudes.

    The constants `drawn` (6,) are in the order of `_DISTURBANCES`. The amplitudes of the terms
    tau_b and F_b are multiplied by `factors` {name: (3,)}.
    """
    terms = dict(robot.disturbance)
    for name, value in zip(UNITS, drawn.reshape(-1, 3).tolist(), strict=True):
        x, y, z = value
        scaled = [
            _scaled(term, factors[name])
            for term_name, term in terms_of(robot.disturbance)
            if term_name == name
        ]
        terms[name] = (*scaled, DisturbanceTerm(constant=(x, y, z)))
    return replace(robot, disturbance=terms)


def _disturbances(robot: Robot) -> tuple[str, ...]:
    """Return the names of the constant disturbances that can be dispersed."""
    if robot.orbit is None or robot.orbit.field is None:
        return _DISTURBANCES
    return _DISTURBANCES + _MAGNETIC


def _with_magnetic(robot: Robot, drawn: Array) -> Robot:
    """Return a robot with a further residual dipole and further errors of the magnetic field.

    The entries of `drawn` are in the order of `_disturbances`.
    """
    terms = dict(robot.disturbance)
    first = len(_DISTURBANCES)
    for name, (count, _, _) in MAGNETIC.items():
        before = magnetic_values(robot.disturbance, name)
        more = drawn[first : first + count].tolist()
        values = [x + y for x, y in zip(before, more, strict=True)]
        terms[name] = (MagneticTerm(tuple(values)),)
        first += count
    return replace(robot, disturbance=terms)


def _scaled(term: DisturbanceTerm, factors: Array) -> DisturbanceTerm:
    """Return a disturbance whose amplitude (3,) is multiplied by factors (3,)."""
    x, y, z = (np.array(term.amplitude) * factors).tolist()
    return replace(term, amplitude=(x, y, z))


def with_sensor_errors(
    policy: Policy,
    bias: Array,
    deviation: Array,
    seed: float,
    steps: Array | None = None,
) -> Policy:
    """Add errors to the measurements (ny,) of a policy; return the new policy.

    The measurements are the states or outputs that the policy feeds back. `deviation` (ny,)
    contains the standard deviations of the noise. `steps` (ny,) contains the standard deviations of
    the change of the bias from sample to sample.
    """
    if steps is None:
        steps = np.zeros(len(bias))
    given = policy.measurement_noise
    return policy.with_sensor_errors(SensorErrors(bias, deviation, steps, seed, given))


def _add_declared(
    by_kind: dict[str, dict[str, tuple[Inverse, str]]],
    declared: Deviations,
    sensors: tuple[str, ...],
) -> None:
    """Add the errors that outputs declare, unless the dispersions contain this error."""
    for kind in _RANDOM_ERRORS:
        spreads = by_kind.get(kind, {})
        given = by_name(f"{kind} to disperse", spreads, sensors)
        for at, size in enumerate(getattr(declared, kind).tolist()):
            if size and at not in given:
                name = sensors[at]
                inverse = inverse_of(f"{name}.{kind}", size, fixed=True)
                by_kind.setdefault(kind, {})[name] = inverse, ""


def _parameters(axes: Array, mass: Array, com: Array, inertia: Array) -> Array:
    """Return the inertial parameters (N, 10) of bodies in the axes of another frame.

    The columns of `axes` (3, 3) are the directions of these axes. The parameters are the mass m,
    the first moment m c with the centre of mass c, and six entries (xx xy xz yy yz zz) of the
    inertia about the origin. The argument `inertia` (N, 3, 3) is about the centre of mass.
    """
    square = (com * com).sum(axis=1)[:, None, None] * np.eye(3) - com[:, :, None] * com[
        :, None
    ]
    about = axes.T @ (inertia + mass[:, None, None] * square) @ axes
    rows, columns = np.triu_indices(3)
    return np.column_stack(
        (mass, mass[:, None] * row_products(com, axes), about[:, rows, columns])
    )


def turned(direction: object, angles: Array) -> Array:
    """Rotate a direction by angles (N, 2) [rad] about two axes normal to it; return (N, 3)."""
    first, second, along = turned_to(np.array(direction, dtype=float)).T
    size = np.linalg.norm(angles, axis=1)[:, None]
    side = angles[:, 1:] * first - angles[:, :1] * second
    directions: Array = np.cos(size) * along + np.sinc(size / np.pi) * side
    return directions


def _misaligned(robot: Robot, angles: Array) -> Robot:
    """Return a robot whose thrusters and wheels are misaligned by angles (nu, 2) [rad]."""
    inputs = list(robot.inputs)
    for place, item, _, at, direction in _mounted(robot):
        inputs[place] = _pointed(item, turned(direction, angles[at : at + 1])[0])
    return robot.replace(inputs=inputs)


def _pointed_lanes(robot: Robot, tree: Tree, angles: Array) -> dict[str, Array]:
    """Return the arrays of the compiled loop that change with misalignment angles (N, nu, 2).

    The arrays contain the wrenches of the inputs, the stored momenta, the joint placements, and the
    changes of the body parameters. Each array has one row per run.
    """
    model = robot._bare.model
    count = len(angles)
    names = list(robot.model.names)
    wrench = np.tile(tree.wrench, (count, 1)).reshape(count, -1, 6)
    stored = np.tile(tree.stored, (count, 1)).reshape(count, -1, 3)
    fixed = np.tile(tree.fixed, (count, 1)).reshape(count, -1, 12)
    bodies = np.zeros((count, tree.bodies.size // 10, 10))
    inputs, storing = tree.input.tolist(), tree.stored_body.tolist()
    for _, item, actuator_names, at, before in _mounted(robot):
        joint, placement = find_frame(model, item.frame)
        body = names.index(model.names[joint]) - ROOT
        axes = tree.axes[body].T @ placement.rotation
        after = turned(before, angles[:, at])
        if at in inputs:
            forces = [
                placement.act(pin.Force(_pointed(item, x).wrench)).vector
                for x in np.eye(3)
            ]
            columns = np.column_stack(forces)
            parts = [
                tree.axes[body].T @ columns[rows] for rows in (PIN_ANGULAR, PIN_LINEAR)
            ]
            wrench[:, inputs.index(at)] += row_products(
                after - before, np.concatenate(parts).T
            )
        if isinstance(item, ReactionWheel) and item.momentum:
            stored[:, storing.index(body)] += item.momentum * row_products(
                after - before, axes.T
            )
        if isinstance(item, ReactionWheel) and item.inertia:
            wheel = names.index(actuator_names[0]) - ROOT
            fixed[:, wheel, :9] = [
                (axes @ turned_to(direction)).ravel("F") for direction in after
            ]
            a = row_products(after, axes.T)
            b = axes @ before
            change = np.outer(b, b) - a[:, :, None] * a[:, None]
            row, column = np.triu_indices(3)
            bodies[:, body, 4:] += item.inertia * change[:, row, column]
    arrays = {"wrench": wrench, "stored": stored, "fixed": fixed, "bodies": bodies}
    return {name: values.reshape(count, -1) for name, values in arrays.items()}


def _pointed(item: Thruster | ReactionWheel, along: Array) -> Thruster | ReactionWheel:
    """Return a copy of a thruster or wheel that points along another direction."""
    if isinstance(item, Thruster):
        return replace(item, direction=along.tolist())
    return replace(item, axis=along.tolist())


def _mounted(
    robot: Robot,
) -> Iterator[tuple[int, Thruster | ReactionWheel, tuple[str, ...], int, Array]]:
    """Yield (index in `robot.inputs`, item, names, index in u, direction) for each actuator.

    The actuators are the thrusters and the reaction wheels.
    """
    first = 0
    for place, (item, names) in enumerate(robot.named_inputs):
        if isinstance(item, Thruster | ReactionWheel):
            direction = item.direction if isinstance(item, Thruster) else item.axis
            yield place, item, names, first, np.array(direction)
        first += len(names)
