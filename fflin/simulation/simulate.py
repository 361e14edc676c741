"""Simulation of the nonlinear robot on the manifold, under any policy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.control.policies import Policy, StateFeedback
from fflin.dynamics.coordinates import state_history
from fflin.dynamics.state import Frame
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot
from fflin.simulation.lanes import carried_out, engine_of
from fflin.simulation.motion import Motion
from fflin.simulation.plan import Callback, Event, Limits, Plan, SimulationOptions, planned
from fflin.simulation.plant import Conserved, Disturbance, Plant, conserved_by
from fflin.simulation.prediction import predict
from fflin.simulation.run import Recording

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from fflin.control.gain_schedule import GainSchedule


def simulate(
    robot: Robot,
    policy: Policy | StateFeedback | GainSchedule | Any = None,
    *,
    x0: ArrayLike | None = None,
    q0: ArrayLike | None = None,
    v0: ArrayLike | None = None,
    duration: float | None = None,
    dt: float | None = None,
    method: str = "cf4",
    project: bool = True,
    sample: float | None = None,
    delay: float = 0.0,
    limits: Limits | None = None,
    disturbance: Disturbance | None = None,
    events: Sequence[Event] = (),
    callback: Callback | None = None,
    linear: LinearModel | bool | None = None,
    target: LinearModel | ArrayLike | None = None,
    frame: Frame | None = None,
    reference: pin.SE3 | None = None,
    every: int | None = None,
    progress: bool | None = None,
    engine: str | None = None,
) -> Motion:
    r"""Simulate the nonlinear robot under a policy.

    The integrator takes steps of fixed size on the manifold, by default with the commutator-free
    method CF4 of order 4. After each step a projection restores two conserved quantities:

    - The base is shifted so that the centre of mass has the position determined by momentum and
      impulse.
    - The base velocity is set to :math:`\nu_b = M_{bb}^{-1}(H - M_{bm} \dot q_m)`. The momentum H
      is integrated from the external impulse with the weights of the method.

    Thrusters never pull: a negative thrust is saturated at zero.

    In orbit, q and v are relative to the orbital frame, also in the arguments of policies.
    Momentum is not conserved in orbit, so that the projection is off.

    Parameters
    ----------
    robot : Robot
    policy : callable, optional
        Function policy(t, q, v) -> u (nu,) over the robot's inputs, such as
        ``StateFeedback(lin, gain.K)``. A `GainSchedule` acts as the feedback along its trajectory.
        By default all inputs are zero.
    x0 : array_like (nx,), optional
        Initial state in the chart of the policy's model, or of `frame` and `reference`.
    q0 : array_like (nq,), optional
    v0 : array_like (nv,), optional
        Initial configuration and velocity in Pinocchio's order, instead of `x0`. If only one of
        q0 and v0 is given, the other is neutral or zero. Without x0, q0 and v0, the motion starts
        at the start of the followed trajectory or at the robot's `start`.
    duration : float, optional
        Simulated time [s]; by default the duration of the followed trajectory.
    dt : float, optional
        Step [s]; by default 0.01, or less if the loop's fastest pole or the samples require a
        shorter step. For continuous policies without delay, the step is adjusted to divide the
        duration.
    method : {"cf4", "semi_implicit_euler"}
    project : bool
        Whether the projection after each step restores momentum and centre of mass.
    sample : float, optional
        Sample time [s] of the policy, a multiple of dt; u is held between samples. By default the
        sample time of the policy's model. With a continuous model, the policy is evaluated at
        every stage of every step.
    delay : float
        Time [s] from a sample to the effect of its command, a multiple of dt. Until the first
        command takes effect, the input is u0 of the policy's model, or zero without a model. If
        `delay` is given without `sample`, the policy is sampled every dt.
    limits : "urdf", float, mapping or list of them, optional
        Limits at which the inputs saturate; by default none:

        - "urdf": all limits of the robot (efforts of the URDF, `min` and `max` of the inputs, the
          largest wheel speeds, `Robot.limits`).
        - A number: the largest magnitude of every input.
        - {input, group or pattern: magnitude, or (lower, upper)}.
        - A list such as ``["urdf", {"tau_m": 5.0}]``: explicit limits take precedence over "urdf".

        On-off thrusters always fire in pulses. `Motion.passed` lists the violated limits.
    disturbance : callable, optional
        Function disturbance(t, q, v) -> generalised force (nv,) in Pinocchio's order.
    events : sequence of callable
        Functions event(t, q, v) -> float. The run ends after the step in which a value becomes
        zero or negative.
    callback : callable, optional
        Function callback(t, q, v, u), called at every recorded row.
    linear : LinearModel or bool, optional
        Model that predicts the motion under the same control law; by default the policy's own
        model, False for no prediction. A motion can be predicted for a StateFeedback, an
        OutputFeedback or LinearController (without its noise), or no policy.
        There is no prediction for a sampled model that was read from a file.
    target : LinearModel or array_like (nx,), optional
        Target state from which errors are measured, or a model whose operating point is the
        target. By default the operating point of the policy's own model, or the followed
        trajectory's state at each time. Other policies have no target.
    frame : {"hybrid", "local", "world", "lvlh", "hill"}, optional
    reference : pin.SE3, optional
        Frame and reference placement of x and u. The default is the frame and reference of the
        policy. Without a policy, the frame is "hybrid" ("lvlh" in orbit), and the reference is
        the identity.
    every : int, optional
        Number of steps from one recorded row to the next; by default 1. The default is larger for
        more than 100,000 steps, so that about 10,000 rows are recorded, as the motion's `notes`
        report.
    progress : bool, optional
        Whether to show a progress bar on stderr; by default on a terminal, for long runs.
    engine : {"python", "compiled"}, optional
        Engine that runs the loop. The default is Python, except that a run of more than 20,000
        steps uses the compiled engine if this engine has already been compiled. The compiled
        engine needs numba. The compiled engine supports no orbits, and no policies, events,
        callbacks or disturbances written in Python. The Python engine and the compiled engine
        agree to machine precision.

    Returns
    -------
    Motion
        Simulated motion. If the motion ended early, ``stopped`` gives the reason: an event, an
        interrupt (Ctrl-C), or a loop that left the chart or diverged (with the step size).

    Raises
    ------
    InputError
        If an argument has a wrong size or value, a policy or disturbance returns an invalid input
        or force, or dt is too large for the loop.
    UnknownNameError
        If a method or input is unknown.

    Warns
    -----
    FflinWarning
        If the loop's fastest pole requires more than 50,000 steps, or springs and gravity at the
        target require inputs beyond the limits. The warning names the pole or the inputs.

    References
    ----------
    E. Celledoni, A. Marthinsen and B. Owren, Future Generation Computer Systems
    19(3), 2003.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> q0 = fflin.configuration(robot, {"joint_1": 0.3})
    >>> policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    >>> motion = fflin.simulate(robot, policy, q0=q0, duration=5.0, limits="urdf")
    >>> motion.u.shape[1], float(motion.t[-1])
    (9, 5.0)
    """
    options = SimulationOptions(
        x0=x0,
        q0=q0,
        v0=v0,
        duration=duration,
        dt=dt,
        method=method,
        project=project,
        sample=sample,
        delay=delay,
        limits=limits,
        disturbance=disturbance,
        events=events,
        callback=callback,
        linear=linear,
        target=target,
        frame=frame,
        reference=reference,
        every=every,
        progress=progress,
    )
    plan, plant = planned(robot, policy, options)
    try:
        conserved = conserved_by(plant.robot, plan.q, plant.field)
        run = carried_out(plan, plant, conserved, engine_of(engine, plan, plant))
        return motion_of(plan, plant, conserved, run)
    except MemoryError:
        raise InputError(
            f"{plan.times.rows} rows of '{robot.name}' exceed the available memory; take a larger "
            "dt or `every`"
        ) from None


def motion_of(plan: Plan, plant: Plant, conserved: Conserved, run: Recording) -> Motion:
    """Return the motion of a run of a plan."""
    state, robot = plant.state, plant.robot
    if plant.field and not run.stopped:
        plant.field.require_near(run.q[np.linalg.norm(run.q[:, :3], axis=1).argmax()])
    x = state_history(state, run.q, run.v, plan.near, run.t)
    target = np.zeros(0) if plan.target is None else plan.target
    if plan.reference is not None:
        q, v, _ = map(np.array, zip(*map(plan.reference, run.t.tolist()), strict=True))
        target = state_history(state, q, v, plan.near, run.t)
    history = conserved.histories(run.q, run.v)
    return Motion(
        **{name: getattr(run, name) for name in ("t", "q", "v", "u", "stopped", "engine")},
        x=x,
        target=target,
        prediction=predict(plan, x, run.steps),
        energy=history.energy,
        momentum=np.roll(history.momentum, 3, axis=1),
        momentum_drift=conserved.momentum_drift(history, run.momentum),
        # In orbit the centre of mass keeps to no line.
        com_drift=np.linalg.norm(history.center - run.center, axis=1)[: 0 if robot.orbit else None],
        placement=pin.SE3ToXYZQUAT(state.reference),
        state_names=state.names,
        input_names=plant.actuation.names,
        state_units=state.units,
        input_units=plant.actuation.units,
        frame=state.frame,
        circles=robot.orbit.to_json() if robot.orbit else "",
        robot=robot.name,
        urdf_sha256=robot.urdf_sha256,
        _robot=robot,
        wheels=tuple(robot.wheels),
        wheel_inertias=np.array(list(robot.wheels.values())),
        modes=tuple(joint.name for joint in robot.modes),
        mode_rotations=np.array([joint.rotation for joint in robot.modes]),
        steered=plan.steered,
        notes=(*plan.notes(), *getattr(plan.law and plan.law.policy, "notes", ())),
        limit_names=tuple(plan.known),
        limits=np.array(list(plan.known.values())).reshape(-1, 2),
    )
