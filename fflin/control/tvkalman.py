"""Kalman filters along a trajectory."""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from fflin.base.errors import InputError, located
from fflin.base.process import in_one_thread
from fflin.base.validation import Array, ArrayLike
from fflin.control.kalman import disturbance, stationary_kalman
from fflin.control.optimal import differential_riccati as riccati
from fflin.control.sensors import timing_of_robot
from fflin.control.trajectory_end import steady_end
from fflin.control.tvlqr import (
    FilterSchedule,
    asks_periodic,
    asks_steady,
    periodic_end,
    sample_time,
)
from fflin.control.weights import Weight, weight
from fflin.dynamics.integrators import HEAVY, LIGHT, held_cost
from fflin.dynamics.state import StateMap
from fflin.linear.linear_trajectory import LinearTrajectory, along, transitions


@in_one_thread
def tvkalman(
    traj: LinearTrajectory,
    W: Weight,
    V: Weight,
    G: ArrayLike | None = None,
    P0: Weight | str = "steady",
    *,
    sample: float,
) -> FilterSchedule:
    r"""Return the time-varying Kalman filter of sampled outputs along a trajectory.

    White noise of intensity W acts on the error, and noise of covariance V on the outputs at each
    sample. Between samples, :math:`\delta u` is held. The covariance P of the estimation error is
    computed forward from P0 by (10.4) of docs/derivation.md:

    .. math:: P_{k+1} = \Phi (P - P C^T (C P C^T + V)^{-1} C P)_k \Phi^T + W_k,\qquad
              L = \Phi P C^T (C P C^T + V)^{-1}.

    Here :math:`\Phi` is the transition matrix over one sample, and :math:`W_k` is the covariance of
    the disturbance integrated over this sample.

    Parameters
    ----------
    traj : LinearTrajectory
        Trajectory of a robot whose outputs are the measurements.
    W : array_like (nx, nx) or (nx,), float, or mapping
        Intensity of the disturbance, positive semidefinite, as in `kalman`.
    V : array_like (ny, ny) or (ny,), float, or mapping
        Covariance of the measurement noise at a sample, positive definite.
    G : array_like (nx, nw) or (N, nx, nw), optional
        Input matrix of the disturbance, interpolated linearly between the knots; W is then (nw,
        nw). With ``G=traj.B``, the disturbance acts at the inputs, and the keys of a mapping W are
        names of inputs.
    P0 : "steady", "periodic", or as W
        Covariance at the start. "steady" is the covariance of `kalman` about the start point. The
        start point is the first configuration, in its initial motion if this motion is steady,
        otherwise at rest, or in free fall as in `tvlqr`. "periodic" is the covariance after
        infinitely many periods of a periodic trajectory, such as `linearize_orbit` returns.
    sample : float
        Sampling time [s], which must divide the duration.

    Returns
    -------
    FilterSchedule

    Raises
    ------
    InputError
        If a size or value is wrong, if P overflows, if the sampling time does not divide the
        duration, or if outputs have their own sampling times or delays.
    UnknownNameError
        If a name does not exist.
    EquilibriumError, DetectabilityError
        If P0 is "steady", and either no inputs can hold the robot at the start point or the model
        at this point is not detectable.
    StabilizabilityError
        If P0 is "periodic", and the covariance grows from period to period.

    References
    ----------
    R. E. Kalman and R. S. Bucy, J. Basic Engineering 83(1), 1961.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> noise = {"tau_b": 0.1, "F_b": 0.1, "tau_m": 0.01}
    >>> fflin.tvkalman(along, noise, 1e-4, G=along.B, sample=0.1).L.shape
    (21, 18, 18)
    """
    dt = sample_time(traj, sample)
    if not timing_of_robot(StateMap(traj.robot, frame="local"), dt).is_plain:
        raise InputError(
            f"tvkalman measures all outputs every {dt:g} s and at once, but outputs of "
            f"'{traj.robot.name}' have their own sample or delay; design for the robot with "
            "robot.replace(outputs=...) without these fields"
        )
    traj.refuse_switches("Kalman filters")
    V = weight("V", V, traj.output_names, definite=True)
    noise, columns = disturbance(traj, W, G)
    columns = np.broadcast_to(columns, (len(traj.t), *columns.shape[-2:]))

    def intensity(t: float) -> Array:
        (input_matrix,) = traj.between(t, columns)
        spread = input_matrix @ noise @ input_matrix.T
        return 0.5 * (spread + spread.T)

    periodic = asks_periodic(P0, traj, "P0")
    P: Array = np.zeros((len(traj.state_names), len(traj.state_names)))
    if asks_steady(P0, "P0", "a covariance"):
        start, early = steady_end(traj, 0), intensity(float(traj.t[0]))
        lin = start.of_trajectory(traj.robot)
        with located(
            "give P0, because no steady filter exists at the start of the trajectory"
        ):
            per_sample = held_cost(lin.A.T, early, dt)
            P = stationary_kalman(lin.discretize(dt), per_sample, V).P
    elif not periodic:
        P = weight("P0", P0, traj.state_names)
    held = list(transitions(traj, dt))
    at_samples = along(traj.resampled(dt), traj.partition)
    nx = len(P)
    maps = np.array([whole for _, whole in held])
    # covariance that the disturbance adds per sample
    disturbed = np.zeros((len(held), nx, nx))
    with riccati.bounded_by("a smaller W or a larger V"):
        for covariance, (steps, _) in zip(disturbed, held, strict=True):
            early, late = (
                np.array([intensity(t) for t in times])
                for times in steps.nodes.T.tolist()
            )
            added = held_cost(
                steps.F[:, :nx, :nx].mT, HEAVY * early + LIGHT * late, steps.h
            )
            for step, step_noise in zip(steps.maps[:, :, :nx], added, strict=True):
                covariance[:] = step @ covariance @ step.T + step_noise
        stages = [
            (block_diag(process_noise, V), np.hstack((whole[:, :nx].T, C.T)))
            for process_noise, whole, C in zip(
                disturbed, maps, at_samples.C, strict=False
            )
        ]
        if periodic:
            P = periodic_end(traj, stages)
        K, P, residual = riccati.samples_back(stages, P)
    L = K.transpose(0, 2, 1)
    return FilterSchedule._of(
        at_samples,
        L=np.concatenate((L, L[-1:])),
        P=P,
        A=maps[:, :, :nx],
        B=maps[:, :, nx:],
        W=disturbed,
        V=V,
        residual=residual,
        robot=traj.robot.name,
        urdf_sha256=traj.robot.urdf_sha256,
        dt=dt,
        verified=traj.verified,
    )
