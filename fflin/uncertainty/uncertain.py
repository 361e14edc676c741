"""Robot with uncertain parameters: linear-fractional model, samples and worst case."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from fflin.base import html
from fflin.base.errors import InputError
from fflin.base.names import without_past
from fflin.base.validation import (
    Array,
    by_name,
    count,
    instance,
    number,
    numbers,
    untied,
    vector,
    whole,
)
from fflin.control.gain import Gain
from fflin.control.policy import Policy
from fflin.dynamics.coordinates import refuse_elliptic
from fflin.dynamics.state import StateMap
from fflin.linear.linearization import Prepared, linearize
from fflin.linear.model import LinearModel
from fflin.robot.inputs import has_magnetorquers
from fflin.robot.robot import Robot
from fflin.uncertainty.derivatives import WEIGH
from fflin.uncertainty.lft import LFT, Block, Range, linear_fractional
from fflin.uncertainty.parameters import Parameter, Parameters
from fflin.uncertainty.worst import Worst, searched

# Ranges are refused if the number of rejected draws per valid draw exceeds this.
_TRIES = 1000

_SHOWN = 100  # largest number of parameters on the card of a notebook

# Largest number of robots in a list; a robot takes about 50 kB.
_MOST_ROBOTS = 100_000


@dataclass(frozen=True, eq=False, repr=False)
class Uncertain:
    """Robot whose uncertain parameters each have a range, as returned by `uncertain`.

    Attributes
    ----------
    robot : Robot
        The nominal robot.
    blocks : tuple of Block
        Blocks of the uncertainty. A block is one parameter, or several tied parameters. The
        parameters of a block vary with one delta, a number between -1 and 1.

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
    _parameters: Parameters

    def __repr__(self) -> str:
        return f"Uncertain('{self.robot.name}', {len(self.ranges)} parameters)"

    def _repr_html_(self) -> str:
        rows = [["parameter", "unit", "least", "largest"]]
        for interval in self.ranges[:_SHOWN]:
            one = interval.parameter
            low, high = interval.middle - interval.half, interval.middle + interval.half
            rows.append([one.name, one.unit, f"{low:.6g}", f"{high:.6g}"])
        left = len(self.ranges) - _SHOWN
        more = f"and {left} more, see ranges" if left > 0 else ""
        return html.result_card(self, html.table(rows, "ll"), html.paragraph(more))

    @property
    def ranges(self) -> tuple[Range, ...]:
        """Ranges of the parameters in the order of the blocks; `half` is half the width."""
        return tuple(interval for block in self.blocks for interval in block.ranges)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the blocks: the name of one parameter, or the pattern of tied parameters."""
        return tuple(block.name for block in self.blocks)

    def lft(
        self, q: Array | None = None, *, independent: Sequence[str] | None = None
    ) -> LFT:
        """Return the model at rest as an exact linear-fractional function of the parameters.

        Parameters
        ----------
        q : array_like (nq,), optional
            Configuration; neutral by default.
        independent : sequence of str, optional
            Coordinates of the model of a robot with constraints, as in `linearize`. By default,
            they are chosen for the nominal robot.

        Raises
        ------
        InputError
            If an output depends on accelerations or masses, or if the operating point is not a
            fixed point for all values of the parameters. The operating point can depend on the
            parameters because of gravity, an orbit, stored momentum or a deflected spring.
        ConstraintError
            If q violates the constraints of the robot.
        """
        robot = self.robot
        lin = linearize(self.robot, q, independent=independent)
        if any(
            output.FEELS_ACCELERATION or type(output) in WEIGH
            for output in robot.outputs
        ):
            raise InputError(
                "an output depends on accelerations or masses, which the LFT cannot represent; "
                "remove it with robot.replace(outputs=)"
            )
        self._refuse_deflected(lin)
        departs = bool(lin.f0.any())
        if lin.dependent:
            # The forces of preloaded springs in a loop cancel to rounding errors.
            departs = not lin.is_equilibrium()
        pulled = [departs, *robot.gravity, robot.orbit, robot.stored_momentum]
        if any(pulled):
            raise InputError(
                "gravity, an orbit, stored momentum or a spring that is not at its rest position "
                "makes the point an equilibrium only for some values of the parameters; remove "
                "this effect from the robot, or linearise each robot of samples(n)"
            )
        ready = Prepared(robot, frame=lin.frame, reference=None, moving=False)
        return linear_fractional(lin, ready, self._parameters.pieces, self.blocks)

    def _refuse_deflected(self, lin: LinearModel) -> None:
        """Raise `InputError` if the stiffness of a deflected spring is uncertain."""
        robot = self.robot
        deflected = robot.springs.rest - StateMap(robot).joint_positions(lin.q)
        for one, *_ in self.ranges:
            if not (one.by_stiffness and deflected[one.joint]):
                continue
            raise InputError(
                f"the spring whose force '{one.name}' changes is deflected by "
                f"{abs(deflected[one.joint]):.3g} {robot.joints[one.joint].unit} at this point, so "
                "that the forces at the point depend on the parameter; give a point at which the "
                "spring is at rest, or linearise each robot of samples(n)"
            )

    def at(self, values: Mapping[str, float]) -> Robot:
        """Return the robot with the given parameter values {parameter or pattern: value}.

        All other parameters keep their nominal values. Tied parameters are named by their pattern.
        The value given for a pattern is their common value or, if their range is relative, the
        factor that multiplies their nominal values.

        Raises
        ------
        InputError
            If the inertia of a body with these parameters is not physically realisable.
        """
        known = self._parameters
        parameter_values = dict[str, float]()
        blocks = {block.name: block for block in self.blocks if block.name not in known}
        for key, value in numbers("values", values, "parameter", "value").items():
            if key in blocks:
                parameter_values |= blocks[key].values(value)
            else:
                parameter_values |= dict.fromkeys(known.find(key), value)
        return known.robot(parameter_values)

    def refusal(self, delta: Array) -> str:
        """Return why the robot with deltas (k,) is not physically realisable, or ""."""
        values = dict[str, float]()
        for block, d in zip(self.blocks, delta, strict=True):
            values |= block.values(block.middle + block.half * d)
        return self._parameters.refusal(values)

    def draws(self, n: int, *, seed: int = 0) -> tuple[Array, int]:
        """Return deltas (n, k) drawn uniformly from [-1, 1], and the number of rejected draws.

        A draw is rejected if the robot with these deltas is not physically realisable.
        """
        wanted = count("n", n)
        draw = np.random.default_rng(whole("seed", seed, 0))
        deltas = list[Array]()
        lost = 0
        while len(deltas) < wanted:
            delta = draw.uniform(-1.0, 1.0, len(self.blocks))
            if not (why := self.refusal(delta)):
                deltas.append(delta)
            elif (lost := lost + 1) >= _TRIES * (len(deltas) + 1):
                raise InputError(
                    f"only {len(deltas)} of {lost + len(deltas)} robots drawn from these ranges "
                    f"are valid: {why}; give narrower ranges"
                )
        return np.array(deltas), lost

    def values(self, delta: Array) -> dict[str, float]:
        """Return the parameter values {name: value} at deltas (k,), for use as argument of `at`."""
        pairs = zip(self.blocks, delta, strict=True)
        return {block.name: float(block.middle + block.half * d) for block, d in pairs}

    def samples(self, n: int, *, seed: int = 0) -> list[Robot]:
        """Return robots with parameters drawn uniformly from their ranges.

        Parameters
        ----------
        n : int
            Number of robots.
        seed : int
            The same seed gives the same robots.

        Returns
        -------
        list of Robot
            Robots that are all physically realisable. A draw is repeated if it gives a body whose
            pseudo-inertia is not positive definite.

        Raises
        ------
        InputError
            If n is above 100,000, or almost none of the drawn robots is physically realisable.
        """
        deltas, _ = self.draws(count("n", n, largest=_MOST_ROBOTS), seed=seed)
        return [self.at(self.values(delta)) for delta in deltas]

    def worst(
        self, gain: object, q: Array | None = None, *, samples: int = 200, seed: int = 0
    ) -> Worst:
        """Search the ranges for the worst closed loop u = -K x.

        The result also contains the central fraction of each range in which stability is
        guaranteed. The worst loop is at least as bad as the loop at every tried corner of the
        ranges and at every random draw. The reported gains of the worst loop are accurate to five
        digits. With more samples and the same seed, the result cannot be better, because the search
        first repeats the search with fewer samples.

        Parameters
        ----------
        gain : Gain, array_like (nu, nx), StateFeedback, LinearController or MultirateFeedback
            Linear law, which must stabilise the robot at the middle of the ranges. If it measures
            outputs, they must depend on states only. For a sampled law, every robot is sampled
            exactly with the delays of the law's model. The loops contain the lags of the robot's
            inputs, and of the outputs that the law measures; if the robot has none, the lags of
            the law's model. Sensors have the sample times and delays of the law's model. The
            search is then the same, but there is no guarantee for the robots that it does not try.
            For a `Gain`, only the states in
            `Gain.regulated`, and states that affect them, must be stable; for a policy, the states
            that it feeds back. For an array, all states must be stable. For example, a gain of
            reaction wheels does not stabilise the wheel angles, so give the `Gain` itself. The
            columns of an array belong to the states of `lft`.
        q : array_like (nq,), optional
            Configuration, as in `lft`.
        samples : int
            Number of random draws from the ranges. They are tried after the corners. If a loop is
            worse than all loops before it, a local search starts from this loop.
        seed : int
            The same seed gives the same draws.

        Returns
        -------
        Worst

        Raises
        ------
        InputError
            If K has a wrong size, the loop at the middle of the
            ranges is unstable, or `lft` raises an `InputError` for this robot.
        """
        lft = self.lft(q, independent=self._coordinates_of(gain))
        return searched(self, lft, gain, count("samples", samples), seed)

    def _coordinates_of(self, gain: object) -> tuple[str, ...] | None:
        """Return the independent coordinates of a law of a robot with constraints."""
        if not self.robot.constraints:
            return None
        states: tuple[str, ...] = ()
        if isinstance(gain, Gain):
            states = gain.model_states
        elif isinstance(gain, Policy) and gain.model is not None:
            states = gain.model.robot_states
        states = without_past(states)
        return states[: len(states) // 2] or None


def uncertain(robot: Robot, ranges: Mapping[str, object]) -> Uncertain:
    """Define the uncertain parameters of a robot and their ranges.

    Parameters
    ----------
    robot : Robot
    ranges : mapping
        Ranges {parameter or pattern: range}, with the parameter names of `Sensitivity`. A range is
        one of

        - a number: the relative half width, such as 0.2 for plus or minus 20 % of the nominal
          value;
        - a pair: the smallest and the largest value;
        - for a pattern whose parameters vary together, one of these ranges with ``"tied": True``,
          such as ``{"range": 0.2, "tied": True}``.

        Several parameters of a link may be given as ``{link: {"mass": .., "inertia.xx": ..}}``. By
        default, the parameters that match a pattern vary independently. Tied parameters vary
        together: if their range is relative, one factor multiplies all of them; if their range is a
        pair, they all have the same value.

    Returns
    -------
    Uncertain

    Raises
    ------
    UnknownNameError
        If a parameter does not exist.
    InputError
        If one of these conditions is true:

        - a range is empty, or relative to a nominal value of 0;
        - the robot at the middle of the ranges is not physically realisable;
        - the range of a mass, density, wheel inertia or frequency contains 0 or negative values;
        - the range of a stiffness or damping contains negative values;
        - a tied parameter has a second range.

    References
    ----------
    For the physical realisability of an inertia, see P. M. Wensing, S. Kim and J.-J. E. Slotine,
    IEEE Robotics and Automation Letters 3(1), 2018.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> of = fflin.uncertain(robot, {"base.mass": 0.2, "link_1": {"density": 0.3}})
    >>> len(of.samples(5, seed=1))
    5
    """
    instance("robot", robot, Robot, "a fflin.Robot").require_unchanged()
    refuse_elliptic(robot, "uncertain models")
    _refuse_magnetorquers(robot)
    given: dict[str, object] = {}
    for key, value in by_name("ranges", ranges, "parameter").items():
        if isinstance(value, Mapping) and "range" not in value:
            given |= {f"{key}.{part}": entry for part, entry in value.items()}
        else:
            given[key] = value
    if not given:
        raise InputError(
            "ranges is empty, expected {parameter: 0.2 or (least, largest)}"
        )
    parameters, alone, together = Parameters(robot), dict[str, Block](), list[Block]()
    for key, value in given.items():
        bounds, tied = untied(key, value)
        intervals = [_range(parameters[name], bounds) for name in parameters.find(key)]
        if tied:
            together.append(_tied(key, intervals, bounds))
            continue
        for interval in intervals:
            one, middle, half = interval
            alone[one.name] = Block(one.name, one.unit, middle, half, (interval,))
    made = Uncertain(robot, (*alone.values(), *together), parameters)
    names = [interval.parameter.name for interval in made.ranges]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(
            f"'{twice[0]}' is tied to other parameters and also has a range of its own; give "
            "only one of these ranges"
        )
    pieces = parameters.pieces
    for name, other in permutations(
        {interval.parameter.of for interval in made.ranges} & pieces.keys(), 2
    ):
        if pieces[name].whole and pieces[name].joint == pieces[other].joint:
            raise InputError(
                f"'{other}' is a link of the body '{name}'; give ranges for only one of the two"
            )
    if why := made.refusal(np.zeros(len(made.blocks))):
        raise InputError(
            f"the robot at the middle of the ranges is not valid: {why}; give other ranges"
        )
    return made


def _range(one: Parameter, value: object) -> Range:
    if one.part[:9] == "direction":
        raise InputError(
            f"'{one.name}' rotates a unit vector, so that the model is not a rational function of "
            "it; use fflin.sensitivity for this parameter"
        )
    if isinstance(value, tuple | list):
        least, largest = vector(
            f"range of '{one.name}'", value, 2, "(least, largest)"
        ).tolist()
    else:
        relative = number(f"range of '{one.name}'", value)
        if not one.value:
            raise InputError(
                f"'{one.name}' is 0, so that a relative range is empty; give the bounds (least, "
                "largest)"
            )
        least, largest = sorted(
            (one.value * (1.0 - relative), one.value * (1.0 + relative))
        )
    expected = "" if least < largest else "least < largest"
    if least < 0.0 and one.part in ("stiffness", "damping"):
        expected = "values of 0 or more"
    # The part "inertia", without an entry such as "xx", is the inertia of a wheel.
    if least <= 0.0 and one.part in ("mass", "density", "inertia", "frequency"):
        expected = "values above 0"
    if expected:
        raise InputError(
            f"range of '{one.name}' is {least:g} to {largest:g}, expected {expected}; give a "
            "relative half width, such as 0.2 for 20 %, or (least, largest), or LEAST:LARGEST"
        )
    return Range(one, 0.5 * (least + largest), 0.5 * (largest - least))


def _tied(key: str, ranges: list[Range], value: object) -> Block:
    """Return the block of several tied parameters, which vary with one common delta."""
    units = {interval.parameter.unit for interval in ranges}
    if isinstance(value, tuple | list):
        if len(units) > 1:
            raise InputError(
                f"the tied parameters of '{key}' have different units, "
                f"{', '.join(sorted(units))}, so they cannot have a common value; give a relative "
                "range, such as 0.2 for 20 %"
            )
        return Block(key, units.pop(), ranges[0].middle, ranges[0].half, tuple(ranges))
    relative = abs(number(key, value))
    # The half width of a range has the sign of the parameter's nominal value. So a positive delta
    # increases the magnitudes of all tied parameters.
    scaled = (
        interval._replace(half=relative * interval.parameter.value)
        for interval in ranges
    )
    return Block(key, "1", 1.0, relative, tuple(scaled))


def _refuse_magnetorquers(robot: Robot) -> None:
    """Raise `InputError` if an input is a magnetorquer, because B then depends on time."""
    if has_magnetorquers(robot.inputs):
        raise InputError(
            "uncertain models do not support magnetorquers, whose torques depend on time, but "
            f"'{robot.name}' has some; remove them with robot.replace(inputs=...)"
        )
