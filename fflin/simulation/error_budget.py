"""Error budgets of linear loops: the contribution of each cause, and their total."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from fflin.base import html
from fflin.base.errors import FflinWarning, InputError
from fflin.base.names import by_name, input_keys
from fflin.base.process import in_one_thread
from fflin.base.rotation import rotation_matrix
from fflin.base.tables import folded, grid
from fflin.base.validation import (
    Array,
    FrozenArrays,
    Mask,
    Values,
    dimension,
    instance,
    number,
    positive,
    truth,
    vector,
)
from fflin.control.closed_loop import ClosedLoop, judged_states
from fflin.control.data_sheet import output_keys
from fflin.control.gain import Gain
from fflin.control.lags import (
    designed_lags,
    lags_of_commands,
    lags_of_model,
    model_of_loop,
)
from fflin.control.margins import delayed_model, laws_in_loop
from fflin.control.optimal.periodic_loops import (
    monodromy,
    steady_covariances,
    steady_states,
)
from fflin.control.policy import Policy, System, as_policy
from fflin.control.sensor_errors import declared_errors
from fflin.dynamics.coordinates import PIN_ANGULAR, PIN_LINEAR, refuse_elliptic
from fflin.dynamics.disturbance import phasors_of, plate_phasors
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import attitude_rotations
from fflin.linear.model import LinearModel
from fflin.robot.disturbance import (
    BASE,
    RESIDUAL_DIPOLE,
    magnetic_values,
    plates_of,
)
from fflin.robot.inputs import BaseForce, BaseTorque, Input
from fflin.robot.joints import ROOT
from fflin.simulation.motion import Motion

if TYPE_CHECKING:
    from fflin.robot.robot import Robot

Kind = Literal["noise", "constant", "periodic", "simulated"]

# States of the attitude, and the name of its errors in the budget.
_ATTITUDE = ("q_b.x", "q_b.y", "q_b.z")
_AXES = ("attitude.x", "attitude.y", "attitude.z")

# Error of the attitude [deg] per unit of the state q_b, the vector part of a quaternion.
_DEGREES = math.degrees(2.0)

# Errors of the report are in seconds of arc if all are below this angle [deg].
_SMALL = 0.02
_ARCSEC = 3600.0

# Errors of at most this size, or this fraction of the largest error of the attitude, are rounding
# errors, and shown as a dot.
_ZERO = 1e-12
_ROUNDING = 1e-10

# Name of the part of the simulated errors that the other causes do not explain.
_NOT_SUPERPOSED = "simulated minus superposed"

# Forces on the base that flat plates exert.
_WRENCH = (BaseTorque.GROUP, BaseForce.GROUP)

# Names of the causes of flat plates.
_PLATES = ("mean of flat plates", "periodic part of flat plates")

# Fraction of a motion from which its errors are counted.
_LATE = 0.5

_GROWING = (
    "left out: drift of the bias of {}, which the law does not reject, so that its errors grow "
    "without bound"
)

# A bias is rejected if it changes the states of the plant by at most this fraction of the states of
# the law.
_REJECTED = 1e-6


class Contribution(NamedTuple):
    """Contribution of one cause to the errors of a budget.

    Attributes
    ----------
    cause : str
        Name of the cause, such as "noise of q_b" or "constant tau_b".
    kind : {"noise", "constant", "periodic", "simulated"}
    size : ndarray (n,)
        Standard deviation for noise, magnitude for a constant cause, amplitude for a periodic one;
        for each of `ErrorBudget.names`. "simulated" is the standard deviation of a motion that the
        other causes do not explain.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> budget = fflin.error_budget(fflin.lqr(lin), lin, disturbance={"tau_b.z": 1e-3})
    >>> budget.contributions[0].cause, budget.contributions[0].kind
    ('constant tau_b.z', 'constant')
    """

    cause: str
    kind: Kind
    size: Array


@dataclass(frozen=True, eq=False, repr=False)
class ErrorBudget(FrozenArrays, html.Reported):
    """Errors of a linear loop by cause, and their total as in ECSS-E-ST-60-10C.

    Constant errors have unknown signs, so their magnitudes are added. Noise and periodic errors are
    independent, so their variances are added; a sinusoid of amplitude a has the variance a^2 / 2.
    The total is the sum of the constants plus `factor` standard deviations.

    Attributes
    ----------
    names, units : tuple of str (n,)
        Errors: ``attitude.x``, ``.y`` and ``.z`` [deg], and then the other states of the loop in
        their units.
    contributions : tuple of Contribution
    constant, deviation, total : ndarray (n,)
        Sum of the constants, standard deviation of all other errors, and total.
    factor : float
        Number of standard deviations in the total.
    simulated_mean, simulated_deviation : ndarray (3,) or (0,)
        Mean and standard deviation [deg] of the attitude errors of the given motion from `after`
        on; empty without a motion.
    after : float or None
        Time [s] from which the errors of the motion are counted; None without a motion.
    dt, delay : float
        Sampling time of the loop, 0 in continuous time, and delay of its inputs [s].
    robot : str
    notes : tuple of str
        Causes that are left out.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> causes = {"noise": {"q_b": 1e-5}, "disturbance": {"tau_b": (0.0, 0.0, 1e-3)}}
    >>> budget = fflin.error_budget(fflin.lqr(lin), lin, sample=0.1, **causes)
    >>> budget.names[2], [part.cause for part in budget.contributions]
    ('attitude.z', ['noise of q_b', 'constant tau_b'])
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    contributions: tuple[Contribution, ...]
    constant: Array
    deviation: Array
    total: Array
    factor: float
    simulated_mean: Array
    simulated_deviation: Array
    dt: float
    delay: float
    robot: str
    after: float | None = None
    notes: tuple[str, ...] = ()

    def error(self, name: str) -> dict[str, float]:
        """Return {cause: size} of one of the errors `names`, and its total.

        Raises
        ------
        UnknownNameError
            If there is no such error.
        """
        from fflin.base.errors import require_known

        require_known("error", [name], self.names)
        at = self.names.index(name)
        sizes = {part.cause: float(part.size[at]) for part in self.contributions}
        return {**sizes, "total": float(self.total[at])}

    def __str__(self) -> str:
        return f"{folded(self._head())}\n\n{grid(self._rows(), 'll')}"

    def _html_parts(self) -> list[str]:
        return [
            *map(html.paragraph, self._head()),
            html.table(self._rows(), "ll"),
        ]

    def _head(self) -> list[str]:
        time = f"sampled at {self.dt:g} s" if self.dt else "continuous"
        if self.delay:
            time += f", delay {self.delay:g} s"
        lines = [
            f"{self.robot}: error budget of the attitude, {time}",
            f"total: sum of the constants plus {self.factor:g} standard deviations",
        ]
        if self.after is not None:
            lines.append(f"simulated: errors of the motion from {self.after:.4g} s on")
        return [*lines, *self.notes]

    def _rows(self) -> list[list[str]]:
        """Return the table of the attitude errors."""
        unit, scale = "deg", 1.0
        if self.total[:3].max() < _SMALL:
            unit, scale = "arcsec", _ARCSEC
        words = {
            "noise": "standard deviation",
            "constant": "constant",
            "periodic": "amplitude",
            "simulated": "standard deviation",
        }
        largest = scale * float(self.total[:3].max())
        zero = max(_ZERO, _ROUNDING * largest)

        def row(cause: str, kind: str, errors: Array) -> list[str]:
            return [cause, kind, *_cells(scale * errors[:3], zero)]

        deviation = words["noise"]
        rows = [["cause", f"[{unit}]", "x", "y", "z"]]
        for part in self.contributions:
            rows.append(row(part.cause, words[part.kind], part.size))
        rows.append(row("all constants", "sum", self.constant))
        rows.append(row("all others", deviation, self.deviation))
        rows.append(row("total", "", self.total))
        if len(self.simulated_mean):
            rows.append(row("simulated", "mean", self.simulated_mean))
            rows.append(row("", deviation, self.simulated_deviation))
        return rows


def _cells(values: Array, zero: float) -> list[str]:
    """Format errors; errors of at most `zero` are a dot."""
    return [f"{x:.3g}" if abs(x) > zero else "." for x in values.tolist()]


# NumPy's warnings are not needed, because a loop that overflows is refused.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
@in_one_thread
def error_budget(
    policy: Policy | Gain,
    lin: LinearModel,
    *,
    noise: Mapping[str, float] | None = None,
    bias: Mapping[str, float] | None = None,
    disturbance: Mapping[str, object] | None = None,
    periodic: Mapping[str, tuple[object, float]] | None = None,
    force_noise: Mapping[str, float] | None = None,
    delay: float | None = None,
    sample: float | None = None,
    factor: float = 3.0,
    motion: Motion | None = None,
    robot: Robot | None = None,
    limit_cycle: bool = False,
    after: float | None = None,
) -> ErrorBudget:
    r"""Return the errors of the loop of a linear policy and a model, for each cause.

    By linear superposition, each cause acts alone on the closed loop

    .. math:: \dot x = F x + G w,\qquad x_{k+1} = F x_k + G w_k

    A constant w leads to :math:`-F^{-1} G w`, or to :math:`(E - F)^{-1} G w` in a sampled loop. A
    sinusoid leads to the amplitude of the frequency response. White noise leads to the covariance S
    with :math:`F S + S F^T + G W G^T = 0`, or with :math:`S = F S F^T + G W G^T`. A sampled loop
    contains the exact sampled plant with delayed inputs, and forces act between the samples. Its
    errors are those at the samples. The errors of a periodic law, such as `MultirateFeedback`, vary
    over its period: constants count with their largest magnitude, noise and sinusoids with their
    root mean square.

    A name in a mapping is a name, a group or a pattern. The values of a group are independent: the
    result of a group of constants is the sum of the magnitudes, and the result of a group of noises
    or sinusoids is the root of the sum of squares. A vector ``"tau_b": (x, y, z)`` is one constant.

    Parameters
    ----------
    policy : Policy or Gain
        Linear law about a point, as for `margins`.
    lin : LinearModel
        Model of the robot. A continuous model may be given for a sampled law.
    noise : mapping, optional
        White noise {measured signal: size}. In a sampled loop, the size is the standard deviation
        of each sample in the unit of the signal. In continuous time, it is the square root of the
        intensity [unit sqrt(s)]. `StateFeedback` and gains measure the states, other laws the
        outputs. By default, a sampled law receives the noise, and the drift of the biases, that
        the outputs of `robot` declare.
    bias : mapping, optional
        Constant errors {measured signal: bias} of sensors.
    disturbance : mapping, optional
        Constant generalised forces {input, ``tau_b`` or ``F_b``: value} [N m or N].
    periodic : mapping, optional
        Sinusoidal forces {name: (amplitude, frequency [Hz])}. The amplitude of ``tau_b`` or ``F_b``
        may also be a vector, whose components have the same phase.
    force_noise : mapping, optional
        White noise of forces {name: square root of the intensity [N m sqrt(s) or N sqrt(s)]}.
    delay : float, optional
        Delay [s] of all inputs, as in `margins`. The default is the delay of `lin` or, if it has
        none, of the policy's model.
    sample : float, optional
        Sampling time [s] with which a continuous law is executed.
    factor : float
        Number of standard deviations in the total.
    motion : Motion, optional
        Simulated motion whose attitude errors are compared with the budget.
    robot : Robot, optional
        Robot whose field `disturbance` contains further causes, at the attitude of `lin`, and whose
        outputs may declare noise and drifting biases. A bias that the law does not reject leads to
        errors that grow without bound; a note names it instead. If `lin` has no lags, the loop has
        the lags of this robot. The inputs that realise the commands of an `Allocation` must have
        equal lags; different lags are neglected, with an `FflinWarning`. In orbit,
        constants in inertial axes are sinusoids with the rate of the orbit. The drag and the solar
        pressure on flat plates are those at the attitude of `lin`. In orbit, their periodic part
        has up to 128 harmonics; its amplitude is that of a sinusoid with the same variance.
    limit_cycle : bool
        Whether the part of the errors of `motion` that the linear superposition does not explain is
        a further cause, "simulated minus superposed". The motion must contain the same causes. Its
        size is the square root of the difference of the variances, if this is positive. The part is
        an estimate of the limit cycle of thruster pulses and deadbands, but it also contains all
        other effects that the linear loop lacks, such as limits and the rest of the initial error.
    after : float, optional
        Time [s] from which the errors of `motion` are counted, such as the settling time
        ``motion.pointing(...).after``; half of the motion by default.

    Returns
    -------
    ErrorBudget

    Raises
    ------
    InputError
        If the policy is not linear about a point, the loop is unstable, or no cause is given.
    UnknownNameError
        If a signal or force does not exist.

    References
    ----------
    ECSS-E-ST-60-10C, Space engineering: control performance, 2008, summation rules of error
    budgets.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    >>> budget = fflin.error_budget(policy, lin, disturbance={"tau_b.z": 1e-3})
    >>> float(budget.total[2]) > 0.0, float(budget.deviation[2])
    (True, 0.0)
    """
    lin, delay = delayed_model(policy, _with_lags_of(robot, policy, lin), delay)
    if sample is not None:
        sample = positive("sample", sample, "s")
    factor = positive("factor", factor)
    laws = laws_in_loop(policy, lin, sample)
    forces = [
        *_given("disturbance", disturbance),
        *_given("periodic", periodic),
        *_given("force_noise", force_noise),
    ]
    phasors = _disturbances(robot, lin)
    forces += [name for name, _ in phasors]
    plates = _plates(robot, lin)
    forces += _WRENCH if plates else ()
    loop = DisturbedLoop(laws, lin, delay, sample, forces)
    acting = [loop.phasor(*key, value) for key, value in phasors.items()]
    acting += loop.plates(plates)
    if noise is None:
        causes, notes = loop.declared(*_declared_errors(policy, lin, robot, loop.dt))
    else:
        causes, notes = loop.declared(_given("noise", noise), {})
    for key, values in _given("bias", bias).items():
        causes.append(loop.bias(key, number(f"bias '{key}'", values)))
    for key, values in _given("disturbance", disturbance).items():
        causes.append(loop.disturbance(key, values))
    for key, values in _given("periodic", periodic).items():
        causes.append(loop.periodic(key, *_sinusoid(key, values)))
    for key, values in _given("force_noise", force_noise).items():
        size = _size("force_noise", key, values)
        causes.append(loop.force_noise(key, size))
    causes += acting
    if truth("limit_cycle", limit_cycle):
        causes.append(_not_superposed(motion, after, loop.signals, causes))
    if not causes:
        raise InputError(
            "no cause of errors is given; give noise, bias, disturbance, periodic, force_noise or "
            "a robot with a disturbance"
        )
    variance = np.zeros(len(loop.signals))
    constant = np.zeros(len(loop.signals))
    for part in causes:
        if part.kind == "constant":
            constant = constant + part.size
        else:
            variance = variance + _variance(part)
    deviation = np.sqrt(variance)
    mean, spread = _simulated(motion, after)
    return ErrorBudget(
        names=loop.signals,
        units=loop.signal_units,
        contributions=tuple(causes),
        constant=constant,
        deviation=deviation,
        total=constant + factor * deviation,
        factor=factor,
        simulated_mean=mean,
        simulated_deviation=spread,
        dt=loop.dt,
        delay=loop.longest_delay,
        robot=lin.robot,
        after=None if motion is None else _start(motion, after),
        notes=notes,
    )


def _with_lags_of(
    robot: Robot | None, policy: Policy | Gain, lin: LinearModel
) -> LinearModel:
    """Return the model with the lags of the given robot, if it has none itself."""
    from fflin.robot.robot import Robot

    instance("lin", lin, LinearModel, "a fflin.LinearModel")
    if robot is None or lags_of_model(lin):
        return lin
    instance("robot", robot, Robot, "a Robot")
    law = policy if isinstance(policy, Gain) else as_policy(policy)
    lags, neglected = lags_of_commands(law, lin, robot)
    if neglected and not designed_lags(law):
        warnings.warn(neglected, FflinWarning, stacklevel=5)
    return model_of_loop(lin, lags)


def _given(name: str, mapping: object) -> Mapping[str, object]:
    """Return the mapping of an argument, or an empty one."""
    if mapping is None:
        return {}
    checked: Mapping[str, object] = instance(
        name, mapping, Mapping, "a mapping {name: value}"
    )
    return checked


def _size(argument: str, key: str, value: object) -> float:
    """Return a size of noise, which must not be negative."""
    size = number(f"{argument} '{key}'", value)
    if size < 0.0:
        raise InputError(f"{argument} '{key}' is {size:g}, expected at least 0")
    return size


def _sinusoid(key: str, value: object) -> tuple[object, float]:
    """Return the amplitude and the frequency [rad/s] of a sinusoidal force."""
    label = f"periodic '{key}'"
    if not isinstance(value, Sequence) or len(value) != 2:
        raise InputError(
            f"{label} is {value!r}, expected an amplitude and a frequency [Hz]"
        )
    amplitude, frequency = value
    frequency = number(f"frequency of {label}", frequency)
    if not frequency > 0.0:
        raise InputError(
            f"{label} has the frequency {frequency:g} Hz, expected more than 0"
        )
    return amplitude, 2.0 * math.pi * frequency


def _declared_errors(
    policy: Policy | Gain, lin: LinearModel, robot: Robot | None, sample: float
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the noise, and the drift within 1 s, that the outputs of a robot declare.

    Both are {output or group: standard deviation}.
    """
    if robot is None or not isinstance(policy, Policy):
        return {}, {}
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    errors = declared_errors(policy, state, sample)
    if errors is None:
        return {}, {}
    noise = _in_groups(policy.sensors, errors.noise)
    return noise, _in_groups(policy.sensors, errors.drift)


def _in_groups(names: Sequence[str], values: Array) -> dict[str, float]:
    """Return {name or group: size} of the sizes (ny,) that are not zero."""
    groups: dict[str, dict[str, float]] = {}
    for name, size in zip(names, values.tolist(), strict=True):
        groups.setdefault(name.rpartition(".")[0], {})[name] = size
    sizes: dict[str, float] = {}
    for group, members in groups.items():
        if group and len(set(members.values())) == 1:
            # The name of an output such as base.gyroscope is a group only as a pattern.
            key = f"{group}.*" if "." in group else group
            sizes[key] = next(iter(members.values()))
        else:
            sizes |= members
    return {name: size for name, size in sizes.items() if size}


def _disturbances(
    robot: Robot | None, lin: LinearModel
) -> dict[tuple[str, float], Values]:
    """Return {(name, rate [rad/s]): phasor (3,)} of a robot's disturbances in the axes of `lin`."""
    from fflin.robot.robot import Robot

    if robot is None:
        return {}
    instance("robot", robot, Robot, "a Robot")
    refuse_elliptic(robot, "error budgets")
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    attitude = _attitude(robot, lin)
    axes = {BaseTorque.GROUP: state.axes[0], BaseForce.GROUP: state.axes[1]}
    total: dict[tuple[str, float], Values] = {}
    for name, given_axes, given, rate in phasors_of(robot, state.field):
        value = given if given_axes == BASE else given @ attitude
        if axes[name]:
            value = state.rotation(lin.q) @ value
        key = name, rate
        total[key] = total.get(key, np.zeros(3, complex)) + value
    for rate, torque in _residual_torques(robot, state, attitude).items():
        value = torque
        if axes[BaseTorque.GROUP]:
            value = state.rotation(lin.q) @ torque
        key = BaseTorque.GROUP, rate
        total[key] = total.get(key, np.zeros(3, complex)) + value
    return total


def _attitude(robot: Robot, lin: LinearModel) -> Array:
    """Return the base axes (3, 3) at the operating point, in the axes of the world."""
    root = robot.model.jointPlacements[ROOT].rotation
    attitude: Array = root @ rotation_matrix(lin.q[3:7])
    return attitude


def _plates(robot: Robot | None, lin: LinearModel) -> dict[float, Values]:
    """Return {rate [rad/s]: phasor (6,)} of torque and force on flat plates in the axes of `lin`.

    The attitude of the plates is constant.
    """
    if robot is None or not plates_of(robot.disturbance):
        return {}
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    rotation = state.rotation(lin.q)
    phasors: dict[float, Values] = {}
    in_base = plate_phasors(robot, state.field, _attitude(robot, lin))
    for rate, wrench in in_base.items():
        torque, force = wrench[PIN_ANGULAR], wrench[PIN_LINEAR]
        if state.axes[0]:
            torque = rotation @ torque
        if state.axes[1]:
            force = rotation @ force
        phasors[rate] = np.concatenate((torque, force))
    return phasors


def _residual_torques(
    robot: Robot, state: StateMap, attitude: Array
) -> dict[float, Values]:
    """Return {rate [rad/s]: phasor (3,) [N m]} of the torque on the residual dipole, in base axes.

    The columns of `attitude` (3, 3) are the base axes in the axes of the orbital frame.
    """
    dipole = np.array(magnetic_values(robot.disturbance, RESIDUAL_DIPOLE))
    if not dipole.any():
        return {}
    assert state.field is not None
    assert state.field.magnetic is not None
    phasors = state.field.magnetic.phasors()
    if phasors is None:
        warnings.warn(
            f"'{robot.name}' has a residual dipole, whose torque the error budget contains only in "
            "a circular orbit with field='dipole'; give its largest torque as "
            "disturbance={'tau_b': ...}",
            FflinWarning,
            stacklevel=4,
        )
        return {}
    return {rate: np.cross(dipole, flux @ attitude) for rate, flux in phasors.items()}


def _variance(part: Contribution) -> Array:
    """Return the variances of a cause that is not constant."""
    if part.kind == "periodic":
        return 0.5 * part.size**2
    return part.size**2


def _not_superposed(
    motion: Motion | None,
    after: float | None,
    names: Sequence[str],
    causes: Sequence[Contribution],
) -> Contribution:
    """Return the part of the errors of a motion that the causes do not explain."""
    if motion is None:
        raise InputError(
            "limit_cycle needs a simulated motion, because the linear loop has no limit cycle; "
            "give motion="
        )
    deviations = dict(zip(_AXES, _simulated(motion, after)[1].tolist(), strict=True))
    late = _late(motion, after)
    for name, values in zip(motion.state_names, motion.x.T, strict=True):
        deviations.setdefault(name, float(values[late].std()))
    simulated = np.array([deviations[name] for name in names])
    variance = simulated**2
    for part in causes:
        if part.kind != "constant":
            variance = variance - _variance(part)
    return Contribution(
        _NOT_SUPERPOSED, "simulated", np.sqrt(np.maximum(variance, 0.0))
    )


def _start(motion: Motion, after: float | None) -> float:
    """Return the time [s] from which the errors of a motion are counted."""
    first, last = float(motion.t[0]), float(motion.t[-1])
    if after is None:
        return first + _LATE * (last - first)
    after = number("after", after)
    if not after < last:
        raise InputError(
            f"after is {after:g} s, expected less than the end of the motion at {last:g} s"
        )
    return max(after, first)


def _late(motion: Motion, after: float | None) -> Mask:
    """Return which rows of a motion are in the part from which its errors are counted."""
    start = _start(motion, after)
    late: Mask = motion.t >= start - 1e-9 * max(1.0, abs(start))
    return late


def _simulated(
    motion: Motion | None, after: float | None = None
) -> tuple[Array, Array]:
    """Return the mean and deviation [deg] of the attitude errors (3,); empty without a motion."""
    if motion is None:
        if after is not None:
            raise InputError(
                "after= is the start of the errors of a motion; give motion="
            )
        return np.zeros(0), np.zeros(0)
    instance("motion", motion, Motion, "a Motion, as fflin.simulate returns")
    if not motion.target.size:
        raise InputError("the motion has no target, so it has no attitude errors")
    errors = np.degrees(attitude_rotations(motion.x, motion.target))
    late = errors[_late(motion, after)]
    return late.mean(axis=0), late.std(axis=0)


class DisturbedLoop(ClosedLoop):
    """Closed loop on which noise, biases and forces act; `forces` are keys of all forces."""

    # Continuous model of the plant, and the indices of its states that the plant contains.
    _source: LinearModel
    _kept: list[int]
    # Names of the forces that can act, and their input matrix.
    _forces: tuple[str, ...]
    _force_inputs: Array

    def __init__(
        self,
        laws: Sequence[System],
        lin: LinearModel,
        delay: float,
        sample: float | None,
        forces: Sequence[str],
    ) -> None:
        self._acting = forces
        missing = [name for name in _ATTITUDE if name not in lin.state_names]
        if missing:
            raise InputError(
                f"the model has no state {missing[0]}; give a model that contains the attitude of "
                "the base"
            )
        super().__init__(laws, lin, delay, sample, "outputs")
        if not self.is_continuous_plant:
            raise InputError(
                "lin is sampled and its continuous model is unknown, so forces between the samples "
                "cannot be computed; give the continuous model"
            )
        self._delayed = self.with_delays(self.delays)
        # State matrices of the loop at each sample of the period of the law.
        self.F: Array = np.array(
            [self.closed_with(law, self._delayed)[0] for law in self.laws]
        )
        if not self.is_stable(monodromy(self.F)):
            raise InputError(
                "the loop is unstable or does not control the attitude, so its errors are not "
                "bounded; give a law that stabilises the attitude"
            )
        states = [self._source.state_names[index] for index in self._kept]
        units = [self._source.state_units[index] for index in self._kept]
        attitude = [states.index(name) for name in _ATTITUDE]
        others = [index for index in range(len(states)) if index not in attitude]
        self._rows = np.array([*attitude, *others])
        self._factors = np.array([_DEGREES] * 3 + [1.0] * len(others))
        self.signals = (*_AXES, *(states[index] for index in others))
        self.signal_units = ("deg",) * 3 + tuple(units[index] for index in others)
        self._force_inputs = self._force_inputs[self._kept]

    def kept_states(self, model: LinearModel, C: Array) -> list[int]:
        """Return the indices of the states of the plant.

        They are the attitude, and the states that inputs or the given forces reach, if they affect
        the attitude or a used signal.
        """
        self._source = model
        self._forces, self._force_inputs = _forces_of(model)
        attitude = [model.state_names.index(name) for name in _ATTITUDE]
        judged = np.zeros(len(model.A), dtype=bool)
        judged[judged_states(model, C)] = True
        A = np.where(np.outer(judged, judged), model.A, 0.0)
        reached: Mask = np.any(model.B, axis=1)
        for key in self._acting:
            at = self._signals("force", key, self._forces)
            reached = reached | self._force_inputs[:, at].any(axis=1)
        seen: Mask = np.any(C, axis=0)
        seen[attitude] = True
        for _ in A:
            reached = reached | A[:, reached].any(axis=1)
            seen = seen | A[seen].any(axis=0)
        kept: Mask = reached & seen & judged
        kept[attitude] = True
        self._kept = np.flatnonzero(kept).tolist()
        return self._kept

    def declared(
        self, noise: Mapping[str, object], drifts: Mapping[str, float]
    ) -> tuple[list[Contribution], tuple[str, ...]]:
        """Return the effects of noise and drifting biases, and notes on biases left out."""
        causes = [
            self.measurement_noise(key, _size("noise", key, size))
            for key, size in noise.items()
        ]
        notes = list[str]()
        for key, size in drifts.items():
            drift = self._drift(key, size)
            if drift is None:
                notes.append(_GROWING.format(key))
            else:
                causes.append(drift)
        return causes, tuple(notes)

    def measurement_noise(self, key: str, size: float) -> Contribution:
        """Return the effect of white noise of measured signals."""
        at = self._measured(key)
        G = size * self._from_measurements()[:, :, at]
        return Contribution(f"noise of {key}", "noise", self._deviation(G @ G.mT))

    def bias(self, key: str, size: float) -> Contribution:
        """Return the effect of constant errors of measured signals."""
        at = self._measured(key)
        G = size * self._from_measurements()[:, :, at]
        return Contribution(f"bias of {key}", "constant", self._constants(G))

    def _drift(self, key: str, size: float) -> Contribution | None:
        """Return the effect of biases of measured signals whose changes are white noise.

        `size` is the standard deviation of the change within 1 s. If X b are the steady states for
        a constant bias b, the states are X b + e. A change w of the bias then changes e by -X w.
        The result is None if a constant bias changes the states of the plant.
        """
        G = self._from_measurements()[:, :, self._measured(key)]
        steady: Array = steady_states(self.F, G).real
        sizes = np.abs(steady)
        limit = _REJECTED * sizes.max(initial=0.0)
        if sizes[:, self._rows].max(initial=0.0) > limit:
            return None
        later = np.roll(steady, -1, axis=0)
        W = size**2 * self.dt * later @ later.mT
        return Contribution(f"drift of {key}", "noise", self._deviation(W))

    def disturbance(self, key: str, value: object) -> Contribution:
        """Return the effect of constant forces."""
        at = self._signals("force", key, self._forces)
        label = f"disturbance '{key}'"
        inputs = self._force_inputs[:, at]
        if dimension(label, value):
            values = vector(label, value, len(at), "one value for each force")
            inputs = inputs @ values[:, None]
        else:
            inputs = inputs * number(label, value)
        G = self._held(inputs, 0.0).real
        return Contribution(f"constant {key}", "constant", self._constants(G))

    def periodic(self, key: str, amplitude: object, w: float) -> Contribution:
        """Return the effect of sinusoidal forces with a frequency [rad/s]."""
        at = self._signals("force", key, self._forces)
        label = f"amplitude of periodic '{key}'"
        inputs = self._force_inputs[:, at]
        if dimension(label, amplitude):
            values = vector(label, amplitude, len(at), "one value for each force")
            inputs = inputs @ values[:, None]
        else:
            inputs = inputs * number(label, amplitude)
        return self._sinusoid(key, inputs, w)

    def phasor(self, key: str, w: float, value: Values) -> Contribution:
        """Return the effect of forces (k,) with complex amplitudes; constants have w = 0."""
        at = self._signals("force", key, self._forces)
        inputs = self._force_inputs[:, at] @ value[:, None]
        if w:
            return self._sinusoid(key, inputs, w)
        G = self._held(inputs.real, 0.0).real
        return Contribution(f"constant {key}", "constant", self._constants(G))

    def plates(self, phasors: Mapping[float, Values]) -> list[Contribution]:
        """Return the effects of flat plates: of their mean wrench and of its harmonics.

        The phasors (6,) of torque and force belong to the rates [rad/s] of the harmonics.
        """
        at = [self._signals("force", key, self._forces) for key in _WRENCH]
        wrench = self._force_inputs[:, np.ravel(at)]
        causes = list[Contribution]()
        powers = np.zeros(self.size)
        for rate, phasor in phasors.items():
            inputs = wrench @ phasor[:, None]
            if rate:
                powers = powers + self._powers(inputs, rate)
                continue
            G = self._held(inputs.real, 0.0).real
            causes.append(Contribution(_PLATES[0], "constant", self._constants(G)))
        if powers.any():
            amplitudes = self._errors(np.sqrt(powers))
            causes.append(Contribution(_PLATES[1], "periodic", amplitudes))
        return causes

    def _sinusoid(self, key: str, inputs: Values, w: float) -> Contribution:
        """Return the effect of independent sinusoidal forces, whose amplitudes are columns."""
        amplitudes = np.sqrt(self._powers(inputs, w))
        hertz = w / (2.0 * math.pi)
        cause = f"{key} at {hertz:.4g} Hz"
        return Contribution(cause, "periodic", self._errors(amplitudes))

    def _powers(self, inputs: Values, w: float) -> Array:
        """Return the squared amplitudes of the states for sinusoids as in `_sinusoid`.

        They are the mean over the period of the law.
        """
        G = self._held(inputs, w)
        if self.dt:
            response = steady_states(self.F, G, w * self.dt)
        else:
            response = np.linalg.solve(1j * w * np.eye(self.size) - self.F, G)
        powers = np.sum(np.abs(response) ** 2, axis=2)
        mean: Array = powers.mean(axis=0)
        return mean

    def force_noise(self, key: str, size: float) -> Contribution:
        """Return the effect of white noise of forces."""
        at = self._signals("force", key, self._forces)
        G = size * self._force_inputs[:, at]
        W = np.zeros_like(self.F)
        count = len(self.plant.A)
        W[:, :count, :count] = self._covariance(G @ G.T)
        return Contribution(f"white {key}", "noise", self._deviation(W))

    def _measured(self, key: str) -> list[int]:
        """Return the indices of measured signals; a quantity such as "gyroscope" is a name."""
        names = self.law.inputs
        return self._signals("measured signal", output_keys([key], names)[key], names)

    def _signals(self, kind: str, key: str, names: Sequence[str]) -> list[int]:
        return sorted(by_name(kind, {key: None}, names))

    @property
    def size(self) -> int:
        """Number of states of the loop."""
        return len(self.F[0])

    def _from_measurements(self) -> Array:
        """Return the matrices (N, n, ny) from errors of measured signals to states of the loop."""
        _, B, _, D, *_ = self._delayed
        return np.array(
            [np.vstack((B @ law.D, law.B + law.B @ D @ law.D)) for law in self.laws]
        )

    def _held(self, inputs: Values, w: float) -> Values:
        """Return the matrices (N, n, k) from forces (nx, k) to the states of the loop.

        In a sampled loop, it is the effect of e^(j w t) over a sample.
        """
        from scipy.linalg import expm

        count, columns = inputs.shape
        if self.dt:
            block = np.zeros((count + columns, count + columns), complex)
            block[:count, :count] = self.plant.A
            block[:count, count:] = inputs
            block[count:, count:] = 1j * w * np.eye(columns)
            inputs = expm(block * self.dt)[:count, count:]
        G = np.zeros((*self.F.shape[:2], columns), complex)
        G[:, :count] = inputs
        return G

    def _covariance(self, W: Array) -> Array:
        """Return the covariance that white noise of intensity W adds to the states in a sample."""
        from scipy.linalg import expm

        if not self.dt:
            return W
        # C. F. Van Loan, IEEE Trans. Automatic Control 23(3), 1978
        A = self.plant.A
        count = len(A)
        block = np.block([[-A, W], [np.zeros((count, count)), A.T]])
        exponential = expm(block * self.dt)
        transition = exponential[count:, count:].T
        covariance: Array = transition @ exponential[:count, count:]
        return covariance

    def _constants(self, G: Array) -> Array:
        """Return the sum of the magnitudes of the constant errors that the columns of G cause.

        The errors of a periodic law vary over its period, and their largest magnitude counts.
        """
        states = steady_states(self.F, G) if self.dt else np.linalg.solve(-self.F, G)
        return self._errors(np.abs(states).max(axis=0).sum(axis=1))

    def _deviation(self, W: Array) -> Array:
        """Return the standard deviations for noise of intensities or covariances W (N, n, n).

        Those of a periodic law are the root mean square over its period.
        """
        from scipy.linalg import solve_continuous_lyapunov

        if self.dt:
            covariances = steady_covariances(self.F, W)
            return self._standard(covariances.mean(axis=0))
        return self._standard(solve_continuous_lyapunov(self.F[0], -W[0]))

    def _standard(self, S: Array) -> Array:
        """Return the standard deviations of a covariance of the states of the loop."""
        return self._errors(np.sqrt(np.maximum(S.diagonal(), 0.0)))

    def _errors(self, states: Array) -> Array:
        """Return the errors of the budget from sizes of the states of the loop."""
        errors: Array = self._factors * states[self._rows]
        return errors


def _forces_of(model: LinearModel) -> tuple[tuple[str, ...], Array]:
    """Return the names of forces, and their input matrix (nx, k).

    The forces are the inputs, and the torque and force on the base if the robot is known.
    """
    from fflin.linear.linearization import linearize

    robot: Robot | None = model._robot
    if robot is None:
        return input_keys(model), model.B
    groups = {name.partition(".")[0] for name in model.input_names}
    added = list[Input]()
    if "tau_b" not in groups:
        added.append(BaseTorque())
    if "F_b" not in groups:
        added.append(BaseForce())
    if not added:
        return input_keys(model), model.B
    larger = linearize(
        robot.replace(inputs=[*robot.inputs, *added]),
        model.q,
        model.v,
        frame=model.frame,
        reference=model.reference,
        independent=model.independent,
    )
    # The force that acts passes no lag, so that it does not move the states of lags.
    effects = dict(zip(larger.state_names, larger.B, strict=True))
    none = np.zeros(larger.B.shape[1])
    rows = [effects.get(name, none) for name in model.state_names]
    return input_keys(larger), np.array(rows)
