"""Kalman filter of the command lqg: its noise and disturbances from files and options."""

from __future__ import annotations

from argparse import Namespace
from functools import partial
from typing import NamedTuple

import fflin
from fflin.base.errors import InputError, listed
from fflin.base.names import by_name, group_of
from fflin.base.tables import cut, grid
from fflin.base.validation import Array
from fflin.commands.builders import once, refuse
from fflin.control.data_sheet import output_keys
from fflin.control.declared_disturbances import declared_disturbances
from fflin.control.recovery import Filter, recovering_filter
from fflin.control.sensors import sensors_of_model, timing_of_model
from fflin.linear.model import LinearModel
from fflin.robot.outputs import FullState

_NONE = "none"

_EXAMPLES = (
    '[[output]] type = "star_tracker" noise = { noise_equivalent_angle = 10.0 } and [[output]] '
    'type = "gyroscope" frame = "base" noise = { angle_random_walk = 0.05 }'
)


class Slow(NamedTuple):
    """Disturbances that a filter estimates: intensities and frequencies [Hz] by name."""

    noise: dict[str, float]
    frequency: dict[str, float]


class FilterDesign(NamedTuple):
    """Filter of the command lqg, with a line on its process noise."""

    filter: Filter
    note: str


def filter_of(lin: LinearModel, gain: fflin.Gain, arguments: Namespace) -> FilterDesign:
    """Return the filter of a model with the noise of its robot and of the options.

    Without --process-noise, the noise acts at the inputs, as `recovering_filter` chooses it.
    """
    slow = _disturbances(lin, gain, arguments)
    _require_possible_integrals(lin, gain, slow, arguments)
    design = partial(
        fflin.kalman,
        lin,
        V=_measurement_noise(lin, arguments),
        wheel_speeds=arguments.wheel_speeds,
        disturbance_noise=slow.noise or None,
        bias_noise=once("--bias-noise", arguments.bias_noise) or None,
        disturbance_frequency=slow.frequency or None,
    )
    if given := once("--process-noise", arguments.process_noise):
        return FilterDesign(design(W=given), "process noise: as given")

    def of_inputs(covariance: Array) -> Filter:
        return design(W=covariance, G=lin.undelayed.B)

    estimator, factor = recovering_filter(gain, lin, of_inputs)
    note = (
        f"process noise: at the inputs, {factor:g} R^-1 of the regulator per sample, the least "
        "power of ten with which the disk margin is 2/3, or the margin is largest; "
        "--process-noise sets other noise"
    )
    return FilterDesign(estimator, note)


def _measurement_noise(lin: LinearModel, arguments: Namespace) -> dict[str, float]:
    """Return the variances of --noise, or raise `InputError` if an output has no noise."""
    robot = lin._robot
    assert robot is not None  # since the command linearised it
    if all(isinstance(output, FullState) for output in robot.outputs):
        raise InputError(
            f"'{robot.name}' has no sensors, which the filter needs; add outputs to the robot "
            f"file, such as {_EXAMPLES}, or give --output"
        )
    given = once("--noise", arguments.noise)
    keys = output_keys(given, lin.output_names)
    known = by_name(
        "output", {keys[key]: x for key, x in given.items()}, lin.output_names
    )
    sensors = sensors_of_model(lin)
    missing = [
        name
        for index, name in enumerate(lin.output_names)
        if index not in known and sensors[name].noise is None
    ]
    if missing:
        raise InputError(
            f"the outputs {listed(missing)} have no noise; add noise to their [[output]] in the "
            "robot file, or give --noise NAME=SIGMA"
        )
    return {key: sigma**2 for key, sigma in given.items()}


def _disturbances(lin: LinearModel, gain: fflin.Gain, arguments: Namespace) -> Slow:
    """Return the disturbances of --disturbance, or by default those in the robot file.

    With integral action, the filter by default estimates none.
    """
    if arguments.disturbance == [(_NONE, None)]:
        refuse(arguments, ("disturbance_frequency",), "no disturbance is estimated")
        return Slow({}, {})
    assert lin._robot is not None  # since the command linearised it
    intensities, frequencies = declared_disturbances(lin._robot)
    frequencies |= once("--disturbance-frequency", arguments.disturbance_frequency)
    given = once("--disturbance", arguments.disturbance)
    if not given and gain.integrals:
        refuse(arguments, ("disturbance_frequency",), "the gain has integral action")
        return Slow({}, {})
    if not given:
        pushed = {"tau_b": "q_b", "F_b": "r_b"}
        regulated = {group_of(name) for name in gain.regulated or gain.state_names}
        given = {name: None for name in intensities if pushed[name] in regulated}
    noise = {}
    for name, intensity in given.items():
        force = _force(name)
        if intensity is not None:
            noise[name] = intensity
        elif force in intensities:
            noise[name] = intensities[force]
        else:
            raise InputError(
                f"--disturbance {name}: [disturbance] of the robot file has no {force}; give the "
                f"intensity of its random walk, --disturbance {name}=INTENSITY"
            )
    forces = {_force(name) for name in noise}
    kept = {name: x for name, x in frequencies.items() if _force(name) in forces}
    return Slow(noise, kept)


def _require_possible_integrals(
    lin: LinearModel, gain: fflin.Gain, slow: Slow, arguments: Namespace
) -> None:
    """Raise `InputError` if a law cannot integrate beside its filter."""
    if not gain.integrals:
        return
    integrals = "the entry integral of [weights] in the robot file"
    if arguments.integral:
        integrals = f"--integral {' '.join(arguments.integral)}"
    if slow.noise:
        raise InputError(
            f"{integrals} and --disturbance {listed(slow.noise)} make two integrators for one "
            "channel, of which only the sum is determined; remove one of them"
        )
    if not timing_of_model(lin).is_plain:
        raise InputError(
            f"{integrals} has no effect on a law of outputs with their own sample or delay; remove "
            "it, and let the filter estimate the disturbance: [disturbance] in the robot file, or "
            "--disturbance NAME=W"
        )


def _force(name: str) -> str:
    """Return the group of a disturbance, such as tau_b for tau_b and for tau_b.x."""
    return name.partition(".")[0]


def deviations_table(values: dict[str, tuple[float, str]]) -> str:
    """Format the standard deviations of the error of a filter."""
    rows = [["estimate", "unit", "standard deviation"]]
    rows += [[name, unit, f"{value:.3g}"] for name, (value, unit) in values.items()]
    return grid(cut(rows, "see --json"), "ll")
