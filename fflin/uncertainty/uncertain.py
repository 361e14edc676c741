"""A robot with uncertain parameters: its linear-fractional form, its samples, its worst."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.tables import grid
from fflin.base.validation import Array, number, numbers, untied, vector, whole
from fflin.base.validation import by_name as mapping
from fflin.dynamics.state import StateMap
from fflin.linear.linearization import linearize
from fflin.linear.prepared import prepare
from fflin.robot.link_masses import Piece
from fflin.robot.robot import Robot
from fflin.uncertainty.fraction import Block, Range, fraction
from fflin.uncertainty.lft import LFT
from fflin.uncertainty.model_slopes import WEIGH
from fflin.uncertainty.parameters import Parameter
from fflin.uncertainty.variants import Variants
from fflin.uncertainty.worst import Worst, searched

# Draws for one that makes a robot, before it is said that hardly any does.
_TRIES = 1000


@dataclass(frozen=True, eq=False, repr=False)
class Uncertain:
    """A robot some of whose parameters lie in ranges; made by `uncertain`.

    Attributes
    ----------
    robot : Robot
        As it is.
    blocks : tuple of Block
        What one delta varies each: a parameter, or several that are tied.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> of = fflin.uncertain(robot, {"base.mass": 0.2})
    >>> round(of.samples(3, seed=1)[0].mass)
    173
    >>> len(of.samples(3, seed=1))
    3
    """

    robot: Robot
    blocks: tuple[Block, ...]
    _variants: Variants

    def __repr__(self) -> str:
        return f"Uncertain('{self.robot.name}', {len(self.ranges)} parameters)"

    def __str__(self) -> str:
        rows: list[tuple[str, ...]] = [("parameter", "unit", "value", "least", "largest", "")]
        for name, unit, middle, half, ranges in self.blocks:
            tied = len(ranges) > 1
            now = "" if tied else f"{ranges[0].parameter.value:.6g}"
            ends = (f"{x:.6g}" for x in (middle - half, middle + half))
            more = f"{len(ranges)} tied" if tied else ""
            rows.append((name, "." if unit == "1" else unit, now, *ends, more))
        return f"{self!r}\n\n{grid(rows, 'llrrrl')}"

    @property
    def ranges(self) -> tuple[Range, ...]:
        """Parameters with the `middle` of each range and `half` its width, block by block."""
        return tuple(each for block in self.blocks for each in block.ranges)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the blocks: of a parameter, or the pattern of those that are tied."""
        return tuple(block.name for block in self.blocks)

    def lft(self, q: Array | None = None) -> LFT:
        """Return the model at rest as an exact linear-fractional function of the parameters.

        Parameters
        ----------
        q : array_like (nq,), optional
            Configuration; neutral by default.

        Raises
        ------
        InputError
            If the point is no fixed point whatever the parameters: springs out of rest, gravity, an
            orbit, stored momentum; or if an output feels accelerations or masses.
        """
        robot = self.robot
        lin = linearize(robot, q)
        rest = robot.springs.rest - StateMap(robot).joint_positions(lin.q)
        pulled = [rest[each.parameter.spring] for each in self.ranges if each.parameter.spring >= 0]
        pulled += [lin.f0.any(), *robot.gravity, robot.orbit, robot.stored_momentum]
        if any(pulled):
            pulls = "gravity" if any(robot.gravity) else "a spring out of its rest"
            pulls = "the field of an orbit" if robot.orbit else pulls
            raise InputError(
                "the point is no fixed point whatever the parameters: there is "
                f"{'stored momentum' if robot.stored_momentum else pulls}; take a point at rest "
                "without, or samples(n), and linearise each"
            )
        return _lft(self, lin)

    def at(self, values: Mapping[str, float]) -> Robot:
        """Return the robot of {parameter or pattern: value}; those that are not named stay.

        The pattern of tied parameters takes their common value, or the factor of what they are.

        Raises
        ------
        InputError
            If a body of these is no rigid body.
        """
        return self._variants.robot(self._each(numbers("values", values, "parameter", "value")))

    def _each(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return {parameter: value} of what names and patterns stand for."""
        known, found = self._variants.parameters, dict[str, float]()
        blocks = {each.name: each for each in self.blocks if each.name not in known}
        for key, value in values.items():
            if key in blocks:
                found |= blocks[key].values(value)
            else:
                found |= dict.fromkeys(known.find(key), value)
        return found

    def makes(self, delta: Array) -> bool:
        """Whether there is a robot of deltas (k,)."""
        return not self._refusal(delta)

    def _refusal(self, delta: Array) -> str:
        pairs = zip(self.blocks, delta, strict=True)
        of_blocks = [block.values(block.middle + block.half * d) for block, d in pairs]
        return self._variants.refusal({name: x for of in of_blocks for name, x in of.items()})

    def draws(self, n: int, *, seed: int = 0) -> tuple[Array, int]:
        """Return deltas (n, k) of robots, uniform in their ranges, and how many made none."""
        count, draw = whole("n", n, 1), np.random.default_rng(whole("seed", seed, 0))
        found, lost = list[Array](), 0
        while len(found) < count:
            delta = draw.uniform(-1.0, 1.0, len(self.blocks))
            if why := self._refusal(delta):
                lost += 1
                if lost >= _TRIES * (len(found) + 1):
                    raise InputError(
                        f"of {lost} robots in these ranges {len(found)} were physical: {why}; give "
                        "narrower ranges"
                    )
                continue
            found.append(delta)
        return np.array(found), lost

    def values(self, delta: Array) -> dict[str, float]:
        """Return {name: value} of deltas (k,), as `at` takes them."""
        pairs = zip(self.blocks, delta, strict=True)
        return {each.name: float(each.middle + each.half * d) for each, d in pairs}

    def samples(self, n: int, *, seed: int = 0) -> list[Robot]:
        """Return robots with parameters drawn uniformly from their ranges.

        Parameters
        ----------
        n : int
        seed : int
            The same seed draws the same.

        Returns
        -------
        list of Robot
            What makes no rigid body, its pseudo-inertia not positive, is drawn again.

        Raises
        ------
        InputError
            If hardly any draw is physical.
        """
        return [self.at(self.values(delta)) for delta in self.draws(n, seed=seed)[0]]

    def worst(
        self, gain: Any, q: Array | None = None, *, samples: int = 200, seed: int = 0
    ) -> Worst:
        """Search the worst loop u = -K x over the set, and bound how far the set is safe.

        No corner and no draw that was tried is worse than what is returned, gains to five digits.
        More samples with the same seed begin with those of fewer, and never find less.

        Parameters
        ----------
        gain : Gain or array_like (nu, nx)
            K, which makes the loop of the middle of the ranges stable.
        q : array_like (nq,), optional
            As of `lft`.
        samples : int
            Draws. Corners are tried before them, and a local search goes on from each that is worse
            than what was found until then.
        seed : int
            The same seed draws the same.

        Returns
        -------
        Worst

        Raises
        ------
        InputError
            If K has a wrong size or the loop in the middle is unstable; else as of `lft`.
        """
        return searched(self, self.lft(q), gain, whole("samples", samples, 1), seed)


def uncertain(robot: Robot, ranges: Mapping[str, Any]) -> Uncertain:
    """Say which parameters of a robot are uncertain, and how much.

    Parameters
    ----------
    robot : Robot
    ranges : mapping
        {parameter: range}, the parameters those of `sensitivity`, or patterns; ``BODY.mass`` of
        `monte_carlo` is a ``density`` here. A number is a
        relative half width, 0.2 for 20 %; a pair the least and the largest value. ``{link:
        {"mass": .., "inertia.xx": ..}}`` says several of a link. A pattern gives each of its
        parameters a delta of its own; ``{"range": 0.2, "tied": True}`` gives them one: all of them
        are multiplied by the same factor or, of a pair, have the same value.

    Returns
    -------
    Uncertain

    Raises
    ------
    UnknownNameError
        If there is no such parameter.
    InputError
        If a range is empty, is relative to 0, has no physical robot in its middle, or masses,
        densities or inertias of wheels not above 0, stiffness or damping below it; if a parameter
        is tied and has another range too.

    References
    ----------
    P. M. Wensing, S. Kim and J.-J. E. Slotine, IEEE Robotics and Automation Letters 3(1), 2018, on
    when an inertia is that of a body.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> of = fflin.uncertain(robot, {"base.mass": 0.2, "link_1": {"density": 0.3}})
    >>> len(of.samples(5, seed=1))
    5
    """
    if not isinstance(robot, Robot):
        raise InputError(f"robot is a {type(robot).__name__}, expected a fflin.Robot")
    robot.require_unchanged()
    given: dict[str, Any] = {}
    for key, value in mapping("ranges", ranges, "parameter").items():
        if isinstance(value, Mapping) and "range" not in value:
            given |= {f"{key}.{part}": each for part, each in value.items()}
        else:
            given[key] = value
    if not given:
        raise InputError("ranges is empty, expected {parameter: 0.2 or (least, largest)}")
    variants, alone, together = Variants(robot), dict[str, Block](), list[Block]()
    for key, value in given.items():
        own, tied = untied(key, value)
        ones = [variants.parameters[name] for name in variants.parameters.find(key)]
        if tied:
            together.append(_tied(key, ones, own))
        else:
            alone |= {one.name: _alone(_range(one, own)) for one in ones}
    made = Uncertain(robot, (*alone.values(), *together), variants)
    _refuse_overlap(variants.pieces, made.ranges)
    if why := made._refusal(np.zeros(len(made.blocks))):
        raise InputError(f"the middle of the ranges is no robot: {why}")
    return made


def _refuse_overlap(pieces: Mapping[str, Piece], ranges: tuple[Range, ...]) -> None:
    names = [each.parameter.name for each in ranges]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"'{twice[0]}' is tied to others and has another range; give one of them")
    asked = {each.parameter.of for each in ranges} & pieces.keys()
    for name, other in permutations(asked, 2):
        if pieces[name].whole and pieces[name].joint == pieces[other].joint:
            raise InputError(f"'{other}' is a link of the body '{name}'; give one of them")


def _range(one: Parameter, value: Any) -> Range:
    if one.part[:9] == "direction":
        said = "turns a unit vector, in which the model is no fraction; see sensitivity"
        raise InputError(f"'{one.name}' {said}")
    if isinstance(value, tuple | list):
        least, largest = vector(f"range of '{one.name}'", value, 2, "(least, largest)").tolist()
    else:
        share = number(f"range of '{one.name}'", value)
        if not one.value:
            raise InputError(f"'{one.name}' is 0, of which a share is 0; give (least, largest)")
        least, largest = sorted((one.value * (1.0 - share), one.value * (1.0 + share)))
    expected = "" if least < largest else "less and more"
    if least < 0.0 and one.part in ("stiffness", "damping"):
        expected = "0 or more"
    if least <= 0.0 and one.part in ("mass", "density", "inertia"):  # the last is a wheel's
        expected = "more than 0"
    if expected:
        raise InputError(
            f"range of '{one.name}' is from {least:g} to {largest:g}, expected {expected}; 20 % is "
            "0.2, ends are (least, largest) or LEAST:LARGEST"
        )
    return Range(one, 0.5 * (least + largest), 0.5 * (largest - least))


def _alone(one: Range) -> Block:
    return Block(one.parameter.name, one.parameter.unit, one.middle, one.half, (one,))


def _tied(key: str, parameters: list[Parameter], value: Any) -> Block:
    """Return the block of parameters that have one delta."""
    ranges = [_range(one, value) for one in parameters]
    units = {one.unit for one in parameters}
    if isinstance(value, tuple | list):
        if len(units) > 1:
            raise InputError(
                f"the tied parameters of '{key}' have units {', '.join(sorted(units))}, of which "
                "no value is common; give a relative range, 0.2 for 20 %"
            )
        return Block(key, units.pop(), ranges[0].middle, ranges[0].half, tuple(ranges))
    share = abs(float(value))
    # Of what is below 0 too, more is further from 0.
    scaled = (each._replace(half=share * each.parameter.value) for each in ranges)
    return Block(key, "1", 1.0, share, tuple(scaled))


def _lft(of: Uncertain, lin: Any) -> LFT:
    ready = prepare(of.robot, frame=lin.frame, reference=None, moving=False)
    if any(output.FEELS_ACCELERATION or type(output) in WEIGH for output in of.robot.outputs):
        feels = "an output feels accelerations or weighs the robot; leave it out"
        raise InputError(f"{feels} with robot.replace(outputs=)")
    form = fraction(ready.map, ready.actuation, lin.q, of._variants.pieces, of.ranges)
    nv, nw = len(lin.A) // 2, len(form.z[0])
    x, w, u = form.a
    A = np.vstack((lin.A[:nv], x))
    return LFT(
        A=A,
        B1=np.vstack((np.zeros((nv, nw)), w)),
        B2=np.vstack((np.zeros((nv, u.shape[1])), u)),
        C1=form.z[0],
        D11=form.z[1],
        D12=form.z[2],
        C2=np.array(lin.C),
        D21=np.zeros((len(lin.C), nw)),
        D22=np.array(lin.D),
        parameters=of.names,
        units=tuple(each.unit for each in of.blocks),
        repeats=np.array([float(each.repeats) for each in of.blocks]),
        middle=np.array([each.middle for each in of.blocks]),
        half=np.array([each.half for each in of.blocks]),
        state_names=lin.state_names,
        input_names=lin.input_names,
        output_names=lin.output_names,
        robot=lin.robot,
    )
