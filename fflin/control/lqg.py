"""Compensators that feed back the estimate of a Kalman filter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress

import numpy as np

from fflin.base.errors import InputError, listed
from fflin.base.names import chosen, group_of, without_past
from fflin.base.validation import Array, instance
from fflin.control.compensator import Compensator
from fflin.control.estimator import DISTURBANCE, Estimator
from fflin.control.gain import Gain, neutral_poles
from fflin.control.linear_controller import OutputFeedback
from fflin.control.margins import disk_margin_of
from fflin.control.multirate import MultirateCompensator, MultirateEstimator
from fflin.control.multirate_feedback import MultirateFeedback
from fflin.control.optimal.riccati import rates_of
from fflin.control.policy import Policy
from fflin.control.rejection import rejection
from fflin.control.slower_weights import LEAST_DISK, is_late, slowed
from fflin.dynamics.state import selection
from fflin.linear.model import LinearModel

# A mode belongs to biases if they have more than this fraction of its participation. A note appears
# if such a mode is slower than the loop by more than the factor _SLOW.
_MOST, _SLOW = 0.5, 10.0


def lqg(
    gain: Gain,
    estimator: Estimator | MultirateEstimator,
    *,
    zero_error: Sequence[str] | None = None,
) -> Compensator | MultirateCompensator:
    r"""Return the LQG compensator, which feeds back the state estimate: u - u0 = -K xh.

    .. math:: \dot z = (A - B K - L C + L D K) z + L (y - y_0),\qquad u - u_0 = -K z

    For a sampled model, xh is the prediction from earlier samples, so that one sampling time is
    available for the computation.

    If the estimator estimates disturbances w, the compensator cancels their steady effect:

    .. math:: u - u_0 = -K (\hat x - \Pi \hat w) + \Gamma \hat w,\qquad
              A \Pi - \Pi A_w + B \Gamma + B_d = 0,\qquad H \Pi = 0

    For a sampled model, the regulator equation is ``A Pi + B Gamma + B_d = Pi A_w``. These
    equations, (10.9) of docs/derivation.md, hold for the states that the gain regulates. H selects
    the states in `zero_error`. A constant disturbance then leaves no error in these states, and a
    sinusoid of a known frequency none at the samples. Other states, such as the deflection of a
    spring, may be displaced. Biases are estimated, but not fed back.

    If the gain has integrals, the compensator integrates the measured outputs, and the integrals
    are its last states: u - u0 = -K xh - K_i xi. A constant disturbance then leaves no error in
    these outputs, although it leaves an error in the estimate.

    If limits change the commands of a compensator that integrates, rejects disturbances or has
    delayed inputs, the filter uses the limited inputs, and the integrals are corrected as in
    `StateFeedback`.

    The filter reduces the margins of the loop. If inputs have delays or lags, or sensors have their
    own sampling times or delays, the default weights of `lqr` are made slower here until the disk
    margin of the whole loop is 2/3, which is a gain margin of 6 dB. The report of the compensator
    then states the factor and the margin. If a loop that is four times slower has a smaller margin,
    the gain is not changed, and the report states the margin. Weights from the user are not
    changed.

    The compensator of a `MultirateEstimator` has matrices for each sample of the period. It uses
    the measurements of every sensor when they arrive, and is flown by `MultirateFeedback`.

    Parameters
    ----------
    gain : Gain
    estimator : Estimator or MultirateEstimator
        Estimator for the same model.
    zero_error : sequence of str, optional
        Names or groups of regulated states that disturbances must not displace in the steady state.
        The default is the attitude and position of the base, and the positions of the joints with a
        motor, as far as the gain regulates them.

    Returns
    -------
    Compensator or MultirateCompensator

    Raises
    ------
    InputError
        If gain and estimator belong to different models, or the gain feeds back a state that the
        estimator does not estimate. Also if no input can reject a disturbance, that is, if it
        displaces states in `zero_error`; the message names the disturbance and these states. Also
        if the gain has integral action and the estimator estimates disturbances, or an integrated
        signal is not measured, or the gain has integral action and the outputs have their own
        sampling times or delays.
    UnknownNameError
        If `zero_error` contains an unknown name.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> sampled = lin.discretize(0.1)
    >>> compensator = fflin.lqg(fflin.lqr(sampled), fflin.kalman(sampled, 1e-3, 1e-4))
    >>> compensator.dt
    0.1
    """
    instance("gain", gain, Gain, "a Gain, as fflin.lqr returns it")
    kinds = (Estimator, MultirateEstimator)
    instance("estimator", estimator, kinds, "an Estimator, as fflin.kalman returns it")
    first = compensator_of(gain, estimator, zero_error)
    slower = gain._slower
    late = isinstance(estimator, MultirateEstimator) or is_late(gain)
    if slower is None or not late:
        return first
    lin = gain._lin
    assert lin is not None  # since the gain was designed for a model

    def redesign(factor: float) -> Compensator | MultirateCompensator:
        return compensator_of(slower(factor), estimator, zero_error)

    def margin_of(compensator: Compensator | MultirateCompensator) -> float | None:
        return disk_margin_with(lin, compensator)

    compensator, change = slowed(first, redesign, margin_of)
    if change is None:
        return first
    pace = f"the default weights of the gain: {change}"
    if change.disk < LEAST_DISK:
        smaller = " or a smaller disturbance_noise" if estimator.disturbances else ""
        pace += f"; a larger W{smaller} of kalman may raise it"
    return replace(compensator, pace=pace)


def disk_margin_with(
    lin: LinearModel, compensator: Compensator | MultirateCompensator
) -> float | None:
    """Return the disk margin at the inputs of a model with a compensator, or None."""
    policy: Policy
    try:
        if isinstance(compensator, MultirateCompensator):
            policy = MultirateFeedback(lin, compensator)
        else:
            policy = OutputFeedback(lin, compensator)
    except InputError:  # the model has no robot
        return None
    return disk_margin_of(policy, lin)


def compensator_of(
    gain: Gain,
    estimator: Estimator | MultirateEstimator,
    zero_error: Sequence[str] | None,
) -> Compensator | MultirateCompensator:
    """Return the compensator of `lqg`, whatever the margins of its loop."""
    if isinstance(estimator, MultirateEstimator):
        return _multirate(gain, estimator, zero_error)
    e = estimator
    names = require_estimated(gain, e)
    require_one_integrator(gain.integrals, e.disturbances)
    S = selection(names, e.state_names)
    feedback = _feedback(gain, e, zero_error)
    A: Array = S @ (e.A + e.B @ feedback - e.L @ (e.C + e.D @ feedback)) @ S.T
    B: Array = S @ e.L
    C: Array = feedback @ S.T
    # A filter without integrators forgets a limited command, but the estimate of a disturbance
    # would wind up, so this filter uses the limited inputs. The commands on their way to delayed
    # inputs are limited, too.
    driven = S @ (e.B - e.L @ e.D)
    E = np.zeros_like(driven)
    if e.disturbances or without_past(names) != names:
        E = driven
    if gain.integrals:
        A, B, C = _with_integrals(gain, e, A, B, C, driven)
        E = np.vstack((driven, gain.anti_windup))
    return Compensator._of(
        e,
        A=A,
        B=B,
        C=C,
        E=E,
        poles=np.concatenate((gain.poles, e.poles)),
        state_names=(*names, *gain.integrals),
        input_names=e.output_names,
        output_names=e.input_names,
        delay=gain.delay,
        slow_bias=_slow_bias(gain, e),
        verified=gain.verified and e.verified,
    )


def _feedback(
    gain: Gain, e: Estimator | MultirateEstimator, zero_error: Sequence[str] | None
) -> Array:
    """Return the feedback F (nu, nz) of the estimate, u - u0 = F z, without integrals."""
    nx = len(gain.model_states)
    feedback = np.hstack((-gain.K_x, np.zeros((len(gain.K), len(e.A) - nx))))
    if e.disturbances or zero_error is not None:
        Pi, Gamma = steady_rejection(gain, e, zero_error)
        feedback[:, nx : nx + len(e.disturbances)] = gain.K_x @ Pi + Gamma
    return feedback


def _multirate(
    gain: Gain, e: MultirateEstimator, zero_error: Sequence[str] | None
) -> MultirateCompensator:
    """Return the periodic compensator of outputs that are measured at different rates."""
    names = require_estimated(gain, e)
    feedback = _feedback(gain, e, zero_error)
    if gain.integrals:
        raise InputError(
            f"the gain has integral action ({listed(gain.integrals)}), but outputs have their own "
            "sample or delay; use disturbance_noise= of kalman instead of integral_action"
        )
    S = selection(names, e.state_names)
    driven = [S @ (e.B - L @ e.D) for L in e.L]
    corrected = bool(e.disturbances) or without_past(names) != names
    loops = [S @ (e.A + e.B @ feedback - L @ (e.C + e.D @ feedback)) @ S.T for L in e.L]
    return MultirateCompensator._of(
        e,
        A=np.array(loops),
        B=np.array([S @ L for L in e.L]),
        C=feedback @ S.T,
        E=np.array(driven) * corrected,
        poles=np.concatenate((gain.poles**e.samples, e.poles)),
        state_names=names,
        input_names=e.output_names,
        output_names=e.input_names,
        delay=gain.delay,
        slow_bias=_slow_bias(gain, e),
        verified=gain.verified and e.verified,
    )


def _slow_bias(gain: Gain, e: Estimator | MultirateEstimator) -> str:
    """Return a note on the estimated bias that settles slowest, or an empty text if it is fast."""
    if not e.biases:
        return ""
    names = e.estimated or e.state_names
    S = selection(names, e.state_names)
    # The error of a periodic filter is propagated over one period.
    gains = e.L if isinstance(e, MultirateEstimator) else [e.L]
    over_period = np.eye(len(e.A))
    for L in gains:
        over_period = (e.A - L @ e.C) @ over_period
    poles, modes = np.linalg.eig(S @ over_period @ S.T)
    # Participation of each state in each mode: products of right and left eigenvectors.
    participation = np.abs(modes * np.linalg.pinv(modes).T)
    participation /= participation.sum(axis=0)
    biases = [names.index(name) for name in e.biases if name in names]
    of_bias = participation[biases].sum(axis=0) > _MOST
    decays = -rates_of(poles, len(gains) * e.dt).real
    loop_rates = rates_of(gain.poles, gain.dt)
    loop_decays = -loop_rates.real[~neutral_poles(loop_rates, gain.dt)]
    if not of_bias.any() or not loop_decays.size:
        return ""
    slowest = int(np.where(of_bias, decays, np.inf).argmin())
    decay, loop = float(decays[slowest]), float(loop_decays.min())
    if not 0.0 < _SLOW * decay < loop:
        return ""
    name = names[biases[int(participation[biases, slowest].argmax())]]
    return (
        f"the estimate of {name} settles with a time constant of {1.0 / decay:.3g} s, "
        f"{loop / decay:.3g} times slower than the loop: after a large error, part of the pointing "
        "error remains for several time constants; a larger bias_noise shortens this time"
    )


def _with_integrals(
    gain: Gain, e: Estimator, A: Array, B: Array, C: Array, driven: Array
) -> tuple[Array, Array, Array]:
    """Return A, B and C of a compensator with the integrals of measured outputs as last states.

    The given A, B and C have no integrals. `driven` is the effect of the inputs on the estimate.
    """
    k = len(gain.integrals)
    nx = len(gain.model_states)
    H = np.hstack((gain.H, np.zeros((k, len(e.A) - nx))))
    without_feedthrough = ~e.D.any(axis=1)
    measured = e.C[without_feedthrough]
    # combination of outputs whose value is H (x - x0)
    rows = np.linalg.lstsq(measured[:, :nx].T, gain.H.T, rcond=None)[0].T
    lack = np.abs(rows @ measured - H).max(axis=1) > 1e-9 * np.abs(H).max()
    if lack.any():
        name = gain.integrals[int(lack.argmax())].removeprefix("integral.")
        raise InputError(
            f"the gain integrates {name}, which the outputs do not measure; add an output that "
            "measures it, or leave it out of the integral action"
        )
    combined = np.zeros((k, len(e.C)))
    combined[:, without_feedthrough] = rows
    corner = np.eye(k) if gain.dt else np.zeros((k, k))
    A = np.block([[A, -driven @ gain.K_i], [np.zeros((k, len(A))), corner]])
    B = np.vstack((B, (gain.dt or 1.0) * combined))
    return A, B, np.hstack((C, -gain.K_i))


def require_one_integrator(
    integrals: Sequence[str], disturbances: Sequence[str]
) -> None:
    """Raise `InputError` if a gain with integral action meets estimated disturbances.

    Both would integrate the error of the same channels, and only their sum would be determined.
    """
    if integrals and disturbances:
        both = listed(integrals), listed(disturbances)
        raise InputError(
            f"the gain has integral action ({both[0]}) and the estimator estimates disturbances "
            f"({both[1]}), which makes two integrators for one channel; omit disturbance_noise, or "
            "integral_action and the entry integral of the robot's weights"
        )


def require_estimated(gain: Gain, e: Estimator | MultirateEstimator) -> tuple[str, ...]:
    """Return the names of the estimated states, or raise `InputError` if they do not fit a gain."""
    nx = len(gain.model_states)
    if gain.dt != e.dt or not (
        np.array_equal(gain.A[:nx, :nx], e.A[:nx, :nx])
        and np.array_equal(gain.B[:nx], e.B[:nx])
    ):
        raise InputError(
            "the gain and the estimator belong to different models; use one model for both"
        )
    names = e.estimated or e.state_names
    regulated = [name for name in gain.regulated if name not in gain.integrals]
    if missing := [name for name in regulated if name not in names]:
        raise InputError(
            f"the gain feeds back {listed(missing)}, which the estimator does not estimate; use "
            "the same wheel_speeds= for both designs"
        )
    return names


def steady_rejection(
    gain: Gain,
    e: Estimator | MultirateEstimator,
    zero_error: Sequence[str] | None = None,
) -> tuple[Array, Array]:
    """Return Pi (nx, nw) and Gamma (nu, nw), the steady state and inputs under disturbances."""
    names = gain.model_states
    nx = len(names)
    regulated = [name for name in gain.regulated or names if name in names]
    R = selection(regulated, names)
    states = slice(nx, nx + len(e.disturbances))
    held = _held_states(gain, regulated, zero_error)
    equations = rejection(
        R @ gain.A[:nx, :nx] @ R.T,
        R @ gain.B[:nx],
        (R @ e.A[:nx, states], e.A[states, states]),
        selection(held, regulated),
        (R @ gain.Q[:nx, :nx] @ R.T, gain.R),
        gain.dt,
    )
    displaced = equations.displaced
    if displaced.any():
        moved = compress(held, np.any(displaced, axis=1).tolist())
        disturbed = compress(e.disturbances, np.any(displaced, axis=0).tolist())
        labels = [name.removeprefix(DISTURBANCE) for name in disturbed]
        raise InputError(
            f"no input can reject the disturbance {listed(labels)}: it displaces "
            f"{listed(moved)} in the steady state; add inputs, or name the states "
            "without an error in zero_error"
        )
    return R.T @ equations.Pi, equations.Gamma


def _held_states(
    gain: Gain, regulated: Sequence[str], zero_error: Sequence[str] | None
) -> list[str]:
    """Return the names of the regulated states that disturbances must not displace."""
    if zero_error is not None:
        if isinstance(zero_error, str):
            zero_error = [zero_error]
        instance("zero_error", zero_error, Sequence, "a list of names of states")
        return [regulated[i] for i in chosen("regulated state", zero_error, regulated)]
    motors = {
        name.partition(".")[2] for name in gain.input_names if group_of(name) == "tau_m"
    }
    return [
        name
        for name in regulated
        if group_of(name) in ("q_b", "r_b")
        or (group_of(name) == "q_m" and name.partition(".")[2] in motors)
    ]
