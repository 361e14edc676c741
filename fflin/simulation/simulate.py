"""Simulation of the nonlinear robot on the manifold, under any policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array, truth
from fflin.control.plants import notes_of
from fflin.control.policies import axes_of, feedback_of
from fflin.control.saturation import saturation, warn_beyond
from fflin.control.tracking import followed, reference_of, steered_by, tracking_of
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import state_history
from fflin.linear.model import LinearModel
from fflin.robot.limits import chosen_limits
from fflin.simulation.compiled import carried_out, engine_of
from fflin.simulation.conservation import Conserved
from fflin.simulation.motion import Motion
from fflin.simulation.plan import Plan, events_of, law_of, method_of, start_of, target_of, turning
from fflin.simulation.plant import Disturbance, Plant
from fflin.simulation.prediction import predict, predictor
from fflin.simulation.times import times_of

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from fflin.control.gain_schedule import GainSchedule
    from fflin.control.policies import Policy, StateFeedback
    from fflin.dynamics.state import Frame
    from fflin.robot.robot import Robot
    from fflin.simulation.plan import Callback, Event
    from fflin.simulation.run import Recording


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
    limits: float | str | Mapping[str, Any] | Sequence[Any] | None = None,
    disturbance: Disturbance | None = None,
    events: Sequence[Event] = (),
    callback: Callable[[float, Array, Array, Array], None] | None = None,
    linear: LinearModel | bool | None = None,
    target: LinearModel | ArrayLike | None = None,
    frame: Frame | None = None,
    reference: pin.SE3 | None = None,
    every: int | None = None,
    progress: bool | None = None,
    engine: str | None = None,
) -> Motion:
    r"""Simulate a robot under a policy.

    Steps of fixed size on the manifold, by default of the commutator-free method CF4 of order 4.
    After each step the base is shifted so that the centre of mass is where momentum and impulse
    take it, and its velocity is set so that the momentum is what the impulse from outside makes
    it, :math:`\nu_b = M_{bb}^{-1}(H - M_{bm} \dot q_m)`, where H is integrated with the weights of
    the method. Thrusters never pull: a negative thrust is cut to zero.

    Parameters
    ----------
    robot : Robot
    policy : callable, optional
        policy(t, q, v) -> u (nu,) over the robot's inputs, such as
        ``StateFeedback(lin, gain.K)``; of a `GainSchedule` the feedback along its trajectory. None
        acts by default.
    x0 : array_like (nx,), optional
        Initial state in the chart of the policy's model, or of `frame` and `reference`.
    q0 : array_like (nq,), optional
    v0 : array_like (nv,), optional
        Initial configuration and velocity in Pinocchio's order, instead of `x0`; neutral and at
        rest by default, or where nothing of these is given the start of the trajectory that is
        followed, or the robot's `start`.
    duration : float, optional
        [s]; by default that of the trajectory that is followed.
    dt : float, optional
        Step [s]; by default 0.01, or less where the loop's fastest pole or the samples ask for it.
        Where the input is neither sampled nor late, it is made to divide the duration.
    method : {"cf4", "rkmk4", "semi_implicit_euler"}
    project : bool
        Whether momentum and centre of mass are kept as above.
    sample : float, optional
        Time [s] between the samples of the policy, a multiple of dt, between which u is held; by
        default that of the policy's model where it is sampled, else the policy is asked at every
        stage of every step.
    delay : float
        Time [s] from a sample to its effect, a multiple of dt; until then u0 of the policy's
        model acts, or nothing. Where there is a delay and no `sample`, samples are dt apart.
    limits : "urdf", float, mapping or list of them, optional
        What cuts the inputs: "urdf" for all limits of the robot (efforts of the URDF, `min` and
        `max` of the inputs, the largest speeds of wheels, `Robot.limits`), the largest magnitude
        of all inputs, or {input, group or pattern: magnitude, or (least, largest)}; in a list such
        as ``["urdf", {"tau_m": 5.0}]`` what is given goes first. Nothing is cut by default. On-off
        thrusters fire in pulses in any case, and `Motion.passed` tells which limits were passed.
    disturbance : callable, optional
        disturbance(t, q, v) -> generalised force (nv,) in Pinocchio's order.
    events : sequence of callable
        event(t, q, v) -> float; the run ends after the step in which one is no longer positive.
    callback : callable, optional
        callback(t, q, v, u), called at every recorded row.
    linear : LinearModel or bool, optional
        Predicts the motion under the same law, of a StateFeedback, a feedback along a trajectory,
        an OutputFeedback without its noise, or none; by default the policy's own model, False for
        none. Sampled, it does so where every row is at a sample.
    target : LinearModel or array_like (nx,), optional
        State, or model whose point it is, that errors are counted from; by default the point of
        the policy's own model, or along a trajectory the state that it has at each time, and none
        under a policy without one.
    frame : {"hybrid", "local", "world"}, optional
    reference : pin.SE3, optional
        Chart of x and axes of u; the policy's by default, else hybrid and the identity.
    every : int, optional
        Steps from one recorded row to the next; by default 1, or where that would be more than
        100,000 rows, as many as leave 10,000, which the motion's `notes` say.
    progress : bool, optional
        Whether a bar is shown on stderr; by default on a terminal, for runs that take long.
    engine : {"python", "compiled"}, optional
        What runs the loop; by default the compiled one where it can and is the quicker. It needs
        numba, and no policy, event, callback or disturbance in Python. Both give the same to
        rounding.

    Returns
    -------
    Motion
        Ended early, ``stopped`` says why: an event, an interrupt (Ctrl-C), or a loop that left
        the chart or diverged.

    Raises
    ------
    InputError
        If an argument has a wrong size or value, a policy or disturbance returns what is no
        input or force, or dt is too large for the loop.
    UnknownNameError
        If there is no such method or input.

    Warns
    -----
    FflinWarning
        If the loop's fastest pole, which is named, asks for more than 50,000 steps, or springs
        and gravity at the target for more than the limits.

    References
    ----------
    E. Celledoni, A. Marthinsen and B. Owren, Future Generation Computer Systems 19(3), 2003.
    """
    plan, plant = planned(
        robot,
        policy,
        *(x0, q0, v0, duration, dt, method, project, sample, delay, limits, disturbance),
        *(events, callback, linear, target, frame, reference, every, progress),
    )
    engine = engine_of(engine, plan, plant)
    try:
        return motion_of(plan, plant, engine)
    except MemoryError:
        raise InputError(
            f"{plan.times.rows} rows of '{robot.name}' do not fit into the memory; take a larger "
            "dt or `every`"
        ) from None


def planned(
    robot: Robot,
    policy: Any,
    x0: Any = None,
    q0: Any = None,
    v0: Any = None,
    duration: float | None = None,
    dt: float | None = None,
    method: str = "cf4",
    project: bool = True,
    sample: float | None = None,
    delay: float = 0.0,
    limits: Any = None,
    disturbance: Disturbance | None = None,
    events: Sequence[Event] = (),
    callback: Callback | None = None,
    linear: LinearModel | bool | None = None,
    target: Any = None,
    frame: Frame | None = None,
    reference: pin.SE3 | None = None,
    every: int | None = None,
    progress: bool | None = None,
) -> tuple[Plan, Plant]:
    """Return what `simulate` does of its arguments, checked, and the robot that moves."""
    policy = followed(policy, robot)
    times = times_of(policy, duration, dt, every, sample, delay)
    policy = followed(policy, robot, held=times.sample > 0)
    lin, _ = feedback_of(policy)
    follows, along = reference_of(policy), tracking_of(policy)
    own_frame, own_reference = axes_of(policy)
    if lin is not None and (frame is not None or reference is not None):
        raise InputError("frame and reference are those of the policy's model; leave out")
    if along and frame not in (None, own_frame):
        raise InputError(
            f"frame is {frame!r}, expected '{own_frame}' along a trajectory, whose inputs are in "
            "base axes; leave it out"
        )
    axes = {"reference": own_reference if reference is None else reference}
    state = StateMap(robot, **axes, frame=own_frame if frame is None else frame)
    plant = Plant(state, disturbance)
    foresees = predictor(plant, policy, linear)
    q, v = start_of(state, x0, q0, v0, follows)
    times.require_room(robot.nq + robot.nv + 2 * state.nx, chosen=dt is None)
    acting, known = chosen_limits(robot, limits)
    within = saturation(robot, acting, q, times.dt, times.sample)
    law = law_of(policy, plant, within, times)
    signals, cut = (plant.actuation.names, plant.actuation.units), (within.low, within.high)
    follows = follows if target is None else None
    goal = target_of(state, lin if target is None else target)
    initial = np.zeros(len(within.low))
    # The model's inputs are others where they are allocated to the robot's.
    if lin is not None and lin.input_names == plant.actuation.names:
        initial = np.asarray(lin.u0)
        warn_beyond(robot.name, "at its target", *signals, lin.u0[None], *cut)
    elif along is policy is not None:
        initial = along.reference(0.0)[2]
        warn_beyond(robot.name, "on its trajectory", *signals, along.trajectory.u_base, *cut)
    near = state.read(*follows(0.0)[:2]) if follows else goal
    if x0 is not None:
        near = np.asarray(x0, dtype=float)
    plan = Plan(
        q=q,
        v=v,
        times=times,
        policy=policy,
        law=law,
        initial=initial,
        limits=within,
        known=known,
        method=method_of(method, times),
        project=truth("project", project),
        turning=turning(robot),
        chart=None if lin is None else state,
        events=events_of(events, callback),
        callback=callback,
        progress=progress,
        near=near,
        target=goal,
        reference=follows,
        steered=steered_by(policy),
        notes=(*notes_of(policy, robot), *times.notes),
        predictor=foresees,
    )
    return plan, plant


def motion_of(plan: Plan, plant: Plant, engine: str, run: Recording | None = None) -> Motion:
    """Return the motion that a plan leads to, or led to where its run is given."""
    state, robot = plant.state, plant.robot
    conserved = Conserved(robot, plan.q)
    run = run or carried_out(plan, plant, conserved, engine)
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
        prediction=predict(plan, x, run.steps, target),
        energy=history.energy,
        momentum=np.roll(history.momentum, 3, axis=1),
        momentum_drift=conserved.momentum_drift(history, run.momentum),
        com_drift=np.linalg.norm(history.center - run.center, axis=1),
        placement=pin.SE3ToXYZQUAT(state.reference),
        state_names=state.names,
        input_names=plant.actuation.names,
        state_units=state.units,
        input_units=plant.actuation.units,
        frame=state.frame,
        robot=robot.name,
        urdf_sha256=robot.urdf_sha256,
        _robot=robot,
        wheels=tuple(robot.wheels),
        wheel_inertias=np.array(list(robot.wheels.values())),
        steered=plan.steered,
        notes=plan.notes,
        limit_names=tuple(plan.known),
        limits=np.array(list(plan.known.values())).reshape(-1, 2),
    )
