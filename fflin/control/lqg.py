"""Compensators that feed back the estimate of a Kalman filter."""

from __future__ import annotations

import numpy as np

from fflin.base.errors import InputError, listed
from fflin.base.validation import instance
from fflin.control.compensator import Compensator
from fflin.control.estimator import Estimator
from fflin.control.gain import Gain
from fflin.dynamics.state import selection


def lqg(gain: Gain, estimator: Estimator) -> Compensator:
    r"""Return the LQG compensator, which feeds back the state estimate: u - u0 = -K xh.

    .. math:: \dot z = (A - B K - L C + L D K) z + L (y - y_0),\qquad u - u_0 = -K z

    For a sampled model, xh is the prediction from earlier samples, so that one sampling time is
    available for the computation.

    Parameters
    ----------
    gain : Gain
    estimator : Estimator
        Estimator for the same model.

    Returns
    -------
    Compensator

    Raises
    ------
    InputError
        If gain and estimator belong to different models, or the gain feeds back a state that the
        estimator does not estimate.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> sampled = lin.discretize(0.1)
    >>> compensator = fflin.lqg(fflin.lqr(sampled), fflin.kalman(sampled, 1e-3, 1e-4))
    >>> compensator.dt
    0.1
    """
    instance("gain", gain, Gain, "a Gain, as fflin.lqr returns it")
    e = instance(
        "estimator", estimator, Estimator, "an Estimator, as fflin.kalman returns it"
    )
    if gain.dt != e.dt or not (
        np.array_equal(gain.A, e.A) and np.array_equal(gain.B, e.B)
    ):
        raise InputError(
            "the gain and the estimator belong to different models; use one model for both"
        )
    names = e.estimated or e.state_names
    if missing := [name for name in gain.regulated if name not in names]:
        raise InputError(
            f"the gain feeds back {listed(missing)}, which the estimator does not estimate; use "
            "the same wheel_speeds= for both designs"
        )
    S = selection(names, e.state_names)
    return Compensator._of(
        e,
        A=S @ (e.A - e.B @ gain.K - e.L @ (e.C - e.D @ gain.K)) @ S.T,
        B=S @ e.L,
        C=-gain.K @ S.T,
        poles=np.concatenate((gain.poles, e.poles)),
        state_names=names,
        input_names=e.output_names,
        output_names=e.input_names,
        verified=gain.verified and e.verified,
    )
