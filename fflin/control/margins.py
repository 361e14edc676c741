"""Margins of gain, phase and delay of linear loops, for each channel and for all together."""

from __future__ import annotations

import math

import numpy as np

from fflin.base.errors import InputError, listed
from fflin.base.names import group_of, input_keys
from fflin.base.process import in_one_thread
from fflin.base.validation import Array, instance, number, positive
from fflin.control.closed_loop import ClosedLoop
from fflin.control.delayed import is_delayed, law_with_memory
from fflin.control.gain import Gain
from fflin.control.gain import Margins as GainMargins
from fflin.control.lags import (
    designed_lags,
    lags_of_its_robot,
    lags_of_model,
    model_of_loop,
    robot_lags,
    warn_of_lags,
)
from fflin.control.loop_margins import Margins, Place
from fflin.control.optimal.disk import disk_gain, disk_phase
from fflin.control.periodic_closed_loop import PeriodicClosedLoop
from fflin.control.policy import Policy, System, as_policy, loop_matrix
from fflin.control.sensed_laws import sensed_systems
from fflin.control.sensors import sensors_of_model, timing_of
from fflin.linear.model import LinearModel, refuse_frozen

# The report of a simulation contains no margins if the loop has more states than this, or if a
# periodic loop has more harmonics of all channels.
_MOST_STATES = 250
_MOST_HARMONICS = 40


@in_one_thread
def margins(
    policy: Policy | Gain,
    lin: LinearModel,
    delay: float | None = None,
    sample: float | None = None,
    *,
    at: Place = "inputs",
) -> Margins:
    r"""Return the margins of the loop of a linear policy and a model.

    A sampled loop contains the exact sampled plant, with held inputs that arrive after the delay.
    In continuous time, the delay is approximated by a rational function of order 10, whose phase
    error is below 1e-9 rad up to an angle of 6 rad.

    The disk margin of n channels is the inverse of the largest structured singular value of
    (S - T)/2 over frequency, where S and T are the sensitivity and the complementary sensitivity.
    Its upper bound D (S - T)/2 D^-1 with the best diagonal D for each frequency is exact for up to
    three channels. For more, the result also contains the smallest destabilising change that was
    found.

    The loop of measured outputs contains their sample times and delays. If the law is periodic,
    as `MultirateFeedback` is, an oscillation has N frequencies at once, where N is the number of
    samples of the period. Its disk margin allows independent factors at each of them, as unknown
    dynamics of the channels cause them. The factors of the gain margins are constant, and the delay
    margins are computed for the exact loop.

    Parameters
    ----------
    policy : Policy or Gain
        Linear law about a point: `StateFeedback`, `OutputFeedback`, `LinearController`,
        `MultirateFeedback`, or a gain.
    lin : LinearModel
        Model of the robot with which the loop is closed. A continuous model may be given for a
        sampled law.
    delay : float, optional
        Delay [s] of all inputs. A delay of `lin`, see `LinearModel.discretize`, is added. By
        default, the delay of `lin` is used. If `lin` has none, it is the delay of the policy's
        model, as in `simulate`. Likewise, if `lin` has no lags, the loop has the lags of its
        robot, and a warning states lags for which the law was not designed. If the robot has no
        lags either, the loop has the lags of the policy's model. For an `Allocation`, give the
        model of its design, with the lag of the thrusters, such as
        ``lin.with_lags({"tau_b": 0.05})``.
    sample : float, optional
        Sample time [s] with which a continuous law is executed.
    at : {"inputs", "outputs"}, optional
        Whether the inputs or the measured outputs are changed.

    Returns
    -------
    Margins

    Raises
    ------
    InputError
        If the policy is not linear about a point, or its signals differ from the signals of the
        model.

    References
    ----------
    P. Seiler, A. Packard and P. Gahinet, An introduction to disk margins, IEEE Control Systems
    Magazine 40(5), 2020.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    >>> slow = fflin.margins(policy, lin, delay=0.2, sample=0.1)
    >>> slow.disk < fflin.margins(policy, lin).disk
    True
    """
    if not isinstance(at, str) or at not in ("inputs", "outputs"):
        raise InputError(f"at is {at!r}, expected 'inputs' or 'outputs'")
    model = instance("lin", lin, LinearModel, "a fflin.LinearModel")
    law = policy if isinstance(policy, Gain) else as_policy(policy)
    if not lags_of_model(model):
        warn_of_lags(law, robot_lags(law, model), "the loop")
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return closed_loop(policy, lin, delay, sample, at).margins()


def closed_loop(
    policy: Policy | Gain,
    lin: LinearModel,
    delay: float | None,
    sample: float | None,
    at: Place = "inputs",
) -> ClosedLoop:
    """Return the loop of a linear policy and a model; see `margins` for the arguments."""
    lin, delay = delayed_model(policy, lin, delay)
    if sample is not None:
        sample = positive("sample", sample, "s")
    laws = laws_in_loop(policy, lin, sample)
    if len(laws) > 1:
        return PeriodicClosedLoop(laws, lin, delay, sample, at)
    return ClosedLoop(laws, lin, delay, sample, at)


def matrices_of_period(policy: Policy, lin: LinearModel) -> tuple[Array, float]:
    """Return the matrices (N, nx, nx) of a loop for each sample of its period, and its dt [s].

    The policy measures outputs of the sampled model `lin`. The states of the loop are the states of
    the model, then the states of the law.
    """
    laws = laws_in_loop(policy, lin, None)
    rows = [lin.output_names.index(name) for name in laws[0].inputs]
    plant = System(lin.A, lin.B, lin.C[rows], lin.D[rows], lin.dt)
    return np.array([loop_matrix(law, plant) for law in laws]), lin.dt


def delayed_model(
    policy: Policy | Gain, lin: LinearModel, delay: float | None
) -> tuple[LinearModel, float]:
    """Return the model with which a loop is closed, and the delay [s] in addition to its own.

    If no delay is given and the model has none, the model gets the delay of the policy's model. If
    the model has no lags, it gets the lags of its robot, or else of the policy's model.
    """
    instance("lin", lin, LinearModel, "a fflin.LinearModel")
    refuse_frozen(lin, "the analysis of a closed loop")
    lin = _lagging(policy, lin)
    if delay is not None:
        delay = number("delay", delay)
        if delay < 0.0:
            raise InputError(f"delay is {delay:g} s, expected at least 0")
        return lin, delay
    known = policy if isinstance(policy, Gain) else as_policy(policy).model
    if lin.delay.any() or known is None:
        return lin, 0.0
    if is_delayed(known.state_names) and not (known.delay.any() or lin.added):
        raise InputError(
            "the gain was designed for delayed inputs, but lin has no delay; give the model "
            "of the gain, lin.discretize(dt, delay=...), or give delay="
        )
    source = lin.generator if lin.dt else lin
    if (
        not known.delay.any()
        or known.input_names != lin.input_names
        or (lin.dt and not math.isclose(lin.dt, known.dt))
    ):
        return lin, 0.0
    if source is None:
        raise InputError(
            "the law was designed for delayed inputs, but lin is sampled without a delay and its "
            "continuous model is unknown; give the continuous model, or delay=0"
        )
    delays = dict(zip(input_keys(lin), known.delay.tolist(), strict=True))
    return source.discretize(known.dt, delay=delays), 0.0


def _lagging(policy: Policy | Gain, lin: LinearModel) -> LinearModel:
    """Return the model with its lags, or with the lags of its robot or of the policy's model."""
    if lags_of_model(lin):
        return lin
    law = policy if isinstance(policy, Gain) else as_policy(policy)
    return model_of_loop(lin, robot_lags(law, lin) or designed_lags(law))


@in_one_thread
def disk_margin_of(
    policy: Policy | Gain,
    lin: LinearModel,
    delay: float | None = None,
    sample: float | None = None,
) -> float | None:
    """Return the disk margin for changes of all inputs at once; 0 if the loop is unstable.

    The result is None if the policy is not linear about a point, if its loop has no margins, or if
    the loop has so many states that the computation would take long.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            closed = closed_loop(policy, lin, delay, sample)
            if closed.states > _MOST_STATES or closed.harmonics > _MOST_HARMONICS:
                return None
            return closed.disk_margin()
    except (InputError, np.linalg.LinAlgError):
        return None


def margins_at_once(
    policy: Policy, delay: float | None, sample: float | None
) -> GainMargins | None:
    """Return the margins of a policy and its model for changes of all inputs at once.

    The disk margin of an unstable loop is 0. The result is None if the policy is not linear about a
    point, if its loop has no margins, or if the loop has so many states that the computation would
    take long.
    """
    lin = policy.model
    if lin is None or policy.followed_trajectory is not None:
        return None
    if delay is not None and lin.delay.any():
        # The given delay replaces the delay of the model.
        lin = lin.generator
        if lin is None:
            return None
    disk = disk_margin_of(policy, lin, delay, sample)
    if disk is None:
        return None
    return GainMargins(disk, disk_gain(disk), disk_phase(disk))


def laws_in_loop(
    policy: Policy | Gain, lin: LinearModel, sample: float | None
) -> list[System]:
    """Return the linear law of a policy at each sample of its period, in series with its sensors.

    A continuous law is sampled if `sample` [s] is given. Raise `InputError` if the law does not fit
    the model.
    """
    outputs = False
    if isinstance(policy, Gain):
        names = policy.state_names, policy.input_names
        law = law_with_memory(policy.K, policy.A, policy.B, policy.dt, *names)
        if policy.integrals:
            law = policy.integral_law()
        laws = [law]
    else:
        given = as_policy(policy)
        if sample:
            given = given.held_for(sample)
        laws = given.laws_of_period()
        if not laws:
            raise InputError(
                f"policy is a {given.kind}, expected a linear law about a point: a StateFeedback, "
                "an OutputFeedback, a LinearController, a MultirateFeedback or a Gain"
            )
        outputs = given.senses_outputs
    law = laws[0]
    known = lin.output_names if outputs else lin.state_names
    missing = [name for name in law.inputs if name not in known]
    if missing or law.outputs != lin.input_names:
        if missing:
            what = f"the law measures {missing[0]}, which the model does not contain"
        else:
            what = "the law and the model have different inputs"
        if isinstance(policy, Policy) and policy.commanded_robot is not None:
            raise InputError(f"{what}; {_model_of_design(law, lin)}")
        raise InputError(
            f"{what}; give the model of the robot for which the law was designed, with the same "
            "inputs and outputs"
        )
    if not outputs:
        return laws
    return with_sensors(laws, lin)


def _model_of_design(law: System, lin: LinearModel) -> str:
    """Return what to give for the model of a law whose commands other inputs realise."""
    text = f"an Allocation commands {listed(law.outputs)}: give the model of its design"
    lag = max(lags_of_its_robot(lin, outputs=False).inputs.values(), default=0.0)
    if lag:
        lags = {group_of(name) or name: lag for name in law.outputs}
        text += f", and the lag of the inputs of '{lin.robot}' by lin.with_lags({lags})"
    return text


def with_sensors(laws: list[System], lin: LinearModel) -> list[System]:
    """Return laws of outputs in series with the sensors of the model's robot."""
    if lin._robot is None:
        if len(laws) > 1:
            raise InputError(
                "the model has no robot, so the sample times and delays of its outputs are "
                "unknown; give the model of fflin.linearize(robot)"
            )
        return laws
    sensors = sensors_of_model(lin)
    names = laws[0].inputs
    timing = timing_of([sensors[name] for name in names], names, laws[0].dt or 0.0)
    return sensed_systems(laws, timing)
