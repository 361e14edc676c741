"""Simulation of the nonlinear robot on the manifold, under any policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.control.policies import Policy, StateFeedback
from fflin.dynamics.state import Frame
from fflin.dynamics.state_rows import state_history
from fflin.linear.model import LinearModel
from fflin.robot.robot import Robot
from fflin.simulation.compiled import carried_out, engine_of
from fflin.simulation.jacobi import conserved_by
from fflin.simulation.motion import Motion
from fflin.simulation.plan import Event, Plan, planned
from fflin.simulation.plant import Disturbance, Plant
from fflin.simulation.prediction import predict
from fflin.simulation.run import Recording

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from fflin.control.gain_schedule import GainSchedule

# A step that was chosen here is divided by this if the motion diverges, up to so many times, while
# the runs that diverged took less than so many times the steps of the first one, and while the next
# one takes no more than so many steps.
_FINER, _MOST_FINER, _MOST_SPENT, _MOST_STEPS = 4, 3, 4, 10_000_000


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

    In orbit q and v are relative to the orbit's frame, here and in what a policy is given; nothing
    keeps the momentum, and no base is shifted.

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
        Step [s]; by default 0.01, or less if the loop's fastest pole or the samples ask for it. If
        the motion diverges in steps of that size, it is flown again in steps of a quarter, up to
        three times, and `Motion.notes` say so. A motion with an event, a callback, a disturbance or
        a policy of your own in Python is flown once, as these may remember their calls. Where the
        input is neither sampled nor late, the step is made to divide the duration.
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
        an OutputFeedback or LinearController without its noise, or none; by default the policy's
        own model, False for none. Sampled, it does so where every row is at a sample.
    target : LinearModel or array_like (nx,), optional
        State, or model whose point it is, that errors are counted from; by default the point of
        the policy's own model, or along a trajectory the state that it has at each time, and none
        under a policy without one.
    frame : {"hybrid", "local", "world", "lvlh", "hill"}, optional
    reference : pin.SE3, optional
        Chart of x and axes of u; the policy's by default, else hybrid, in orbit lvlh, and the
        identity.
    every : int, optional
        Steps from one recorded row to the next; by default 1, or where that would be more than
        100,000 rows, as many as leave 10,000, which the motion's `notes` say.
    progress : bool, optional
        Whether a bar is shown on stderr; by default on a terminal, for runs that take long.
    engine : {"python", "compiled"}, optional
        What runs the loop; by default Python, and the compiled one for a run of more than 20,000
        steps if its machine code is there already. It needs numba, no orbit, and no policy, event,
        callback or disturbance in Python. Both give the same to rounding.

    Returns
    -------
    Motion
        Ended early, ``stopped`` says why: an event, an interrupt (Ctrl-C), or a loop that left
        the chart or diverged, and in steps of which size.

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

    def prepared(dt: float | None, every: int | None) -> tuple[Plan, Plant]:
        return planned(
            robot,
            policy,
            *(x0, q0, v0, duration, dt, method, project, sample, delay, limits, disturbance),
            *(events, callback, linear, target, frame, reference, every, progress),
        )

    plan, plant = prepared(dt, every)
    # A function of the caller's may remember what it was called with.
    again = dt is None and plan.repeatable and disturbance is None
    most, spent, coarse = _MOST_SPENT * plan.times.steps, 0, list[str]()
    try:
        while True:
            conserved = conserved_by(plant.robot, plan.q, plant.field)
            run = carried_out(plan, plant, conserved, engine_of(engine, plan, plant))
            spent += run.steps
            last = len(coarse) == _MOST_FINER or spent > most
            last = last or _FINER * plan.times.steps > _MOST_STEPS
            if not again or last or not run.stopped.startswith("diverged"):
                break
            coarse.append(f"{plan.times.dt:g}")
            plan, plant = prepared(plan.times.dt / _FINER, plan.times.every * _FINER)
        motion = motion_of(plan, plant, run.engine, run)
    except MemoryError:
        raise InputError(
            f"{plan.times.rows} rows of '{robot.name}' do not fit into the memory; take a larger "
            "dt or `every`"
        ) from None
    if not coarse:
        return motion
    note = f"the motion diverges in steps of {', '.join(coarse)} s"
    if not motion.stopped:
        taken = f"flown in steps of {plan.times.dt:g} s"
        note = f"{taken}, as {note}; a smaller dt (--step) shows how accurate that is"
    return replace(motion, notes=(*motion.notes, note))


def motion_of(plan: Plan, plant: Plant, engine: str, run: Recording | None = None) -> Motion:
    """Return the motion that a plan leads to, or led to where its run is given."""
    state, robot = plant.state, plant.robot
    conserved = conserved_by(robot, plan.q, plant.field)
    run = run or carried_out(plan, plant, conserved, engine)
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
        prediction=predict(plan, x, run.steps, target),
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
        steered=plan.steered,
        notes=(*plan.notes, *getattr(plan.law and plan.law.policy, "notes", ())),
        limit_names=tuple(plan.known),
        limits=np.array(list(plan.known.values())).reshape(-1, 2),
    )
