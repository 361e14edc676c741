"""Unloading of reaction wheels by external torques, beside any law of the attitude."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import TypeVar, cast

import numpy as np
from scipy.linalg import null_space

from fflin.base.errors import FflinWarning, InputError, listed
from fflin.base.validation import Array, frozen, instance, number
from fflin.control.loops import NOT_CORRECTED
from fflin.control.margins import disk_margin_of
from fflin.control.multirate_feedback import MultirateFeedback
from fflin.control.policies import LinearLaw, StateFeedback
from fflin.control.sensors import timing_of_model
from fflin.dynamics.state import selection
from fflin.linear.holding import held_if_possible, lags_by_name
from fflin.linear.linearization import linearize
from fflin.linear.model import LinearModel
from fflin.robot.inputs import Thruster, lags_of
from fflin.robot.robot import Robot

LawT = TypeVar("LawT", bound=LinearLaw | MultirateFeedback)

# Fraction of the disk margin below which a warning appears.
_KEPT = 0.8

# Singular values below this fraction of the largest one count as zero.
_ZERO = 1e-9


def unload_wheels(law: LawT, design: Robot, rate: float) -> LawT:
    r"""Return a law that also returns the wheels to their speeds at the operating point.

    The given law controls the attitude with the wheels, and may contain integrals, a filter and
    delayed inputs. The returned law adds a feedback of the wheel speeds s to its commands:

    .. math:: u = u_{law} - U (B_w U)^{+} k (s - s_0),\qquad B_o U = 0

    B_w are the rows of B of the wheel speeds, B_o the rows of all other rates, and the columns of U
    span the null space of B_o. So the external torque and the motors of the wheels cancel each
    other on the robot: the wheels return to s_0 with the rate k, and the attitude is not disturbed.
    The unloading changes no other signal of the given law. But if the gain of a wheel or of the
    external torque differs from the model, the two no longer cancel each other, so the margins
    become smaller with the rate.

    In orbit, the law may feed back the wheel speeds itself, because the links that carry the wheels
    rotate. The law then responds to the unloading, so the attitude may change.
    Magnetorquers produce the part of the external torque across the field by `Allocation`,
    and the wheels wait for the rest.

    Thrusters that push in one direction only produce the external torque by `Allocation`. Choose k
    such that ``k * momentum`` is below the torque of the thrusters, because saturated thrusters
    disturb the attitude. If the thrusters exert a torque only together with a force, give a design
    without `BaseForce`, for which `Allocation` lets them push the robot. A constant external torque
    T leaves the momentum T/k in the wheels.

    Parameters
    ----------
    law : StateFeedback, OutputFeedback, LinearController or MultirateFeedback
        Law for a robot whose inputs include the wheels. An output feedback must measure the wheel
        speeds, for example by ``JointVelocities(("wheel_*",))``. `lqr` and `kalman` must leave out
        the wheel speeds, as they do by default without an external torque.
    design : Robot
        Robot of the law with an additional external torque, such as ``BaseTorque()``.
    rate : float
        Rate k [1/s].

    Returns
    -------
    StateFeedback, OutputFeedback, LinearController or MultirateFeedback
        Law for `design`, of the same type.

    Raises
    ------
    InputError
        If the law already feeds back wheel speeds or does not measure them, `design` has other
        states, outputs or sensors than the robot of the law or lacks its inputs, the inputs have
        different delays or lags, or the inputs of `design` cannot change all wheel speeds without
        accelerating the rest of the robot.

    Warns
    -----
    FflinWarning
        If the loop with unloading is unstable, or if its disk margin for changes of all inputs at
        once is less than 80 % of the margin without unloading. The message states both margins.

    Examples
    --------
    >>> inputs = fflin.load_inputs("cubesat")
    >>> wheels = [item for item in inputs if isinstance(item, fflin.ReactionWheel)]
    >>> satellite = fflin.load("cubesat", inputs=wheels)
    >>> lin = fflin.linearize(satellite).discretize(0.25)
    >>> law = fflin.StateFeedback(lin, fflin.lqr(lin, integral_action=["q_b"]))
    >>> design = satellite.replace(inputs=[fflin.BaseTorque(), *wheels])
    >>> unloading = fflin.unload_wheels(law, design, 0.01)
    >>> fflin.simulate(design, unloading, duration=1.0).u.shape[1]
    6
    """
    kinds = "a StateFeedback, OutputFeedback, LinearController or MultirateFeedback"
    instance("law", law, (LinearLaw, MultirateFeedback), kinds)
    instance("design", design, Robot, "a fflin.Robot")
    rate = number("rate", rate)
    if rate <= 0.0:
        raise InputError(f"rate is {rate:g} 1/s, expected more than 0")
    lin, continuous = _models(law, design)
    speeds = [f"qdot_m.{name}" for name in lin.wheels]
    if not speeds:
        raise InputError(
            f"'{design.name}' has no wheels, expected ReactionWheel inputs"
        )
    _require_unregulated(law, speeds)
    null = _null_feedback(continuous, speeds)
    if isinstance(law, MultirateFeedback):
        several = _multirate(law, lin, continuous, rate * null, speeds)
        _warn_of_margin(law, several, rate)
        return cast(LawT, several)

    sensors = lin.output_names if law.senses_outputs else lin.robot_states
    rows = selection(law.lin.input_names, lin.input_names)
    columns = selection(law.system.inputs, sensors)
    of_speeds = selection(speeds, sensors)
    _, B, C, D = law.system[:4]
    unloading = copy(law)
    unloading.lin = lin
    unloading.system = law.system._replace(
        B=B @ columns,
        C=rows.T @ C,
        D=rows.T @ D @ columns - rate * null @ of_speeds,
        inputs=sensors,
        outputs=lin.input_names,
    )
    unloading.windup = _windup(law.windup, continuous, rows)
    if isinstance(unloading, StateFeedback):
        states = selection(law.lin.state_names, lin.state_names)
        attitude = rows.T @ unloading.K @ states
        wheels = null @ selection(speeds, lin.state_names)
        unloading.K = frozen(attitude + rate * wheels)
    _warn_of_margin(law, unloading, rate)
    return unloading


def _warn_of_margin(
    law: LinearLaw | MultirateFeedback,
    unloading: LinearLaw | MultirateFeedback,
    rate: float,
) -> None:
    """Warn if unloading makes a stable loop unstable, or takes a large part of its disk margin."""
    before = disk_margin_of(law, law.lin)
    if not before:
        return
    after = disk_margin_of(unloading, unloading.lin)
    if after is None or after >= _KEPT * before:
        return
    change = f"lowers the disk margin of the loop from {before:.3g} to {after:.3g}"
    if not after:
        change = (
            f"makes the loop unstable, whose disk margin without it is {before:.3g}"
        )
    warnings.warn(
        f"unloading at {rate:g} 1/s {change}; give a lower rate",
        FflinWarning,
        stacklevel=3,
    )


def _multirate(
    law: MultirateFeedback,
    lin: LinearModel,
    continuous: LinearModel,
    feedback: Array,
    speeds: list[str],
) -> MultirateFeedback:
    """Return a law of sensors with their own sample times that also unloads the wheels.

    `lin` and `continuous` are the models of the design, and `feedback` (nu, number of wheels) is
    the gain of the wheel speeds.
    """
    if timing_of_model(lin) != timing_of_model(law.lin):
        raise InputError(
            f"the sensors of '{lin.robot}' have other sample times or delays than the sensors of "
            "the law; give the robot of the law with an additional external torque"
        )
    rows = selection(law.lin.input_names, lin.input_names)
    given = law.compensator
    E = np.array([_windup(windup, continuous, rows) for windup in given.E])
    unloading = copy(law)
    unloading.lin = lin
    unloading.compensator = replace(
        given,
        C=rows.T @ given.C,
        E=E,
        u0=rows.T @ given.u0,
        output_names=lin.input_names,
    )
    of_speeds = selection(speeds, lin.output_names)
    unloading.feedthrough = -feedback @ of_speeds
    return unloading


def _models(
    law: LinearLaw | MultirateFeedback, design: Robot
) -> tuple[LinearModel, LinearModel]:
    """Return the model of `design` at the point of a law, sampled like the law's model.

    The second model is in continuous time. Both contain the inputs of the law.
    """
    lin = law.lin
    delays = set(lin.delay.tolist())
    if len(delays) > 1:
        raise InputError(
            f"the inputs of the law have the delays {listed(f'{x:g} s' for x in delays)}, expected "
            "one delay of all inputs, so that the external torque and the wheels act together"
        )
    lag = _common_lag("the inputs of the law", lin.lag.tolist())
    _common_lag(f"the inputs of '{design.name}'", lags_of(design.named_inputs))
    continuous = held_if_possible(
        linearize(design, lin.q, lin.v, frame=lin.frame, reference=lin.reference)
    )
    made = f"the law was designed for '{lin.robot}'"
    signals = [("state", lin.robot_states, continuous.state_names)]
    if law.senses_outputs:
        signals.append(("output", lin.output_names, continuous.output_names))
    for kind, names, known in signals:
        if names != known:
            raise InputError(
                f"{made} with other {kind}s than '{design.name}'; give the robot of the law with "
                "an additional external torque, robot.replace(inputs=[fflin.BaseTorque(), ...])"
            )
    missing = [x for x in lin.input_names if x not in continuous.input_names]
    if missing:
        raise InputError(
            f"the law commands {listed(missing)}, expected inputs of '{design.name}'; give the "
            "robot of the law with an additional external torque"
        )
    model = continuous
    if lin.lag.any() or lin.output_lag.any():
        # The wheels and the external torque lag alike, so their lagging torques cancel each other.
        # The law computes only the lagging torques of its own commands.
        model = continuous.with_lags(lag, lags_by_name(lin)[1])
    if not lin.dt:
        return model, continuous
    return model.discretize(lin.dt, delay=delays.pop()), continuous


def _common_lag(what: str, lags: Sequence[float]) -> float:
    """Return the common lag [s] of inputs, or raise `InputError`; `what` names the inputs."""
    different = sorted(set(lags))
    if len(different) > 1:
        raise InputError(
            f"{what} have the lags {listed(f'{x:g} s' for x in different)}, expected one lag of "
            "all inputs, so that the external torque and the wheels act together"
        )
    return different[0]


def _require_unregulated(law: LinearLaw | MultirateFeedback, speeds: list[str]) -> None:
    """Raise `InputError` if a law feeds back the wheel speeds already or cannot measure them."""
    systems = law.laws_of_period()
    sensors = systems[0].inputs
    unmeasured = [name for name in speeds if name not in sensors]
    if unmeasured:
        raise InputError(
            f"the law does not measure {listed(unmeasured)}; add the output "
            'JointVelocities(("wheel_*",))'
        )
    matrices = np.vstack([x for system in systems for x in (system.D, system.B)])
    fed_back = [name for name in speeds if matrices[:, sensors.index(name)].any()]
    if fed_back and not law.lin.mean_motion:
        raise InputError(
            f"the law already feeds back {listed(fed_back)}; design it with wheel_speeds=False, "
            "or for the robot with wheels alone"
        )


def _null_feedback(lin: LinearModel, speeds: list[str]) -> Array:
    """Return U (B_w U)^+ (nu, number of wheels), the inputs for unit accelerations of the wheels.

    These inputs accelerate nothing else.
    """
    thrusters = _thrusters(lin)
    usable = [i for i, name in enumerate(lin.input_names) if name not in thrusters]
    wheels = selection(speeds, lin.state_names)
    others = [name for name in lin.state_names if name not in speeds]
    B = lin.B[:, usable]
    null = null_space(selection(others, lin.state_names) @ B, rcond=_ZERO)
    accelerations = wheels @ B @ null
    values = np.linalg.svd(accelerations, compute_uv=False)
    rank = int((values > _ZERO * np.abs(wheels @ B).max()).sum())
    if rank < len(speeds):
        raise InputError(
            f"the inputs change only {rank} of {len(speeds)} independent wheel speeds without "
            "accelerating the rest of the robot; add BaseTorque() to the inputs of the design, "
            "which Allocation realises by thrusters"
        )
    feedback = np.zeros((len(lin.input_names), len(speeds)))
    feedback[usable] = null @ np.linalg.pinv(accelerations)
    return feedback


def _thrusters(lin: LinearModel) -> set[str]:
    """Return the names of the thrusters among the inputs of a model."""
    robot = lin._robot
    assert robot is not None
    return {
        name
        for item, names in robot.named_inputs
        for name in names
        if isinstance(item, Thruster)
    }


def _windup(windup: Array, lin: LinearModel, rows: Array) -> Array:
    """Return the anti-windup gain (nz, nu) of a law with further inputs.

    A further input has the effect of the inputs of the law that cause the nearest accelerations.
    `windup` is the gain of the law. `rows` selects the inputs of the law
    from all inputs of the model `lin`.
    """
    if not windup.size:
        return NOT_CORRECTED
    wheels = {f"qdot_m.{name}" for name in lin.wheels}
    others = [name for name in lin.state_names if name not in wheels]
    B = selection(others, lin.state_names) @ lin.B
    equivalent = np.linalg.lstsq(B @ rows.T, B, rcond=None)[0]
    corrected: Array = windup @ equivalent
    return corrected
