"""Simulation of the nonlinear robot under any policy, with a linear prediction."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from operator import attrgetter
from time import perf_counter
from typing import TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.process import LONG_RUN
from fflin.base.validation import Array, ArrayLike, instance
from fflin.control.linear_controller import LinearController, growing
from fflin.control.policies import Policy, StateFeedback, feedback_of
from fflin.control.tvlqr import GainSchedule
from fflin.dynamics.coordinates import Frame, state_history
from fflin.kernel.compiled import is_kept
from fflin.linear.model import LinearModel
from fflin.robot.fields import limits_of
from fflin.robot.robot import Robot
from fflin.simulation.lanes import engine_of, not_compilable, recorded
from fflin.simulation.motion import Motion
from fflin.simulation.plan import Callback, Event, Limits, Plan, SimulationOptions
from fflin.simulation.run import Conserved, Disturbance, Recording, go

# Linear model that predicts a motion, and a function that returns the command (nu,) for a deviation
# from the operating point. The deviation contains the states of the robot. If the controller is in
# continuous time and has states, the deviation also contains these states, at the end.
Predictor: TypeAlias = tuple[LinearModel, Callable[[Array], Array]]

# After a run in Python of more than LONG_RUN seconds, a message recommends the compiled loop. The
# compiled loop takes about the fraction _FRACTION of the time in Python. It must be compiled once,
# which takes about _COMPILING seconds.
_FRACTION, _COMPILING = 0.1, 30.0

_log = logging.getLogger("fflin")


def simulate(
    robot: Robot,
    policy: Policy | StateFeedback | GainSchedule | object = None,
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

    A policy is a control law policy(t, q, v) -> u. The integrator takes steps of fixed size on the
    configuration manifold, by default with the commutator-free method CF4 of order 4. After each
    step, a projection removes the integration errors of two quantities that follow from the initial
    momentum and the external impulse:

    - the position of the centre of mass: the base is shifted to restore it;
    - the momentum H: the base velocity is set to
      :math:`\nu_b = M_{bb}^{-1}(H - M_{bm} \dot q_m)`. H is integrated from the external forces
      with the weights of the method.

    Thrusters never pull, so a negative thrust is saturated at zero.

    In orbit, q and v are relative to the orbital frame, also in the arguments of policies. The
    projection is off in orbit, because momentum is not conserved there.

    Parameters
    ----------
    robot : Robot
    policy : callable, optional
        Function policy(t, q, v) -> u (nu,) that returns the inputs of the robot, such as
        ``StateFeedback(lin, gain.K)``. A `GainSchedule` is also accepted, and then tracks its
        trajectory. By default all inputs are zero.
    x0 : array_like (nx,), optional
        Initial state in the chart defined by `frame` and `reference`, which is by default the chart
        of the policy's model.
    q0 : array_like (nq,), optional
    v0 : array_like (nv,), optional
        Initial configuration and velocity in Pinocchio's order, instead of `x0`. If only v0 is
        given, q0 is neutral; if only q0 is given, v0 is zero. If x0, q0 and v0 are all omitted,
        the motion starts at the start of the followed trajectory or at the robot's `start`.
    duration : float, optional
        Simulated time [s]; by default the duration of the followed trajectory.
    dt : float, optional
        Integration step [s]; by default 0.01, or less if the fastest pole of the loop or the
        sample time requires a shorter step. For continuous-time policies without delay, the step
        is adjusted so that the duration is a whole number of steps.
    method : {"cf4", "semi_implicit_euler"}
        Integration method.
    project : bool
        Whether the projection after each step restores momentum and centre of mass.
    sample : float, optional
        Sample time [s] of the policy, a multiple of dt; u is held between samples. The default is
        the sampling time of the policy's model. If this model is in continuous time, the policy is
        evaluated at every stage of every integration step.
    delay : float
        Time [s] from a sample until its command takes effect, a multiple of dt. Until the first
        command takes effect, the input is u0 of the policy's model, or zero without a model. If
        `delay` is given without `sample`, the policy is sampled every dt.
    limits : "urdf", float, mapping or list of them, optional
        Limits at which the inputs saturate. By default, inputs do not saturate. Limits are one of

        - "urdf": all limits of the robot (efforts of the URDF, `min` and `max` of the inputs, the
          largest wheel speeds, `Robot.limits`);
        - a number: the largest magnitude of every input;
        - a mapping {input, group or pattern: magnitude, or (lower, upper)};
        - a list in which explicit limits take precedence over "urdf", such as
          ``["urdf", {"tau_m": 5.0}]``.

        On-off thrusters fire in pulses, whatever the limits. `Motion.passed` lists violated limits.
    disturbance : callable, optional
        Function disturbance(t, q, v) -> generalised force (nv,) in Pinocchio's order.
    events : sequence of callable
        Functions event(t, q, v) -> float. The run ends after the step in which the value of an
        event becomes zero or negative.
    callback : callable, optional
        Function callback(t, q, v, u) that is called at every recorded row.
    linear : LinearModel or bool, optional
        Model that predicts the motion under the same control law. The default is the policy's own
        model; with False, there is no prediction. The motion can be predicted without a policy,
        and for a StateFeedback, an OutputFeedback or a LinearController, but not for a
        discrete-time model that was read from a file. The prediction ignores noise.
    target : LinearModel or array_like (nx,), optional
        Target state from which errors are measured, or a model whose operating point is the
        target. The default is the operating point of the policy's own model, or the state of the
        followed trajectory at each time. If the policy has neither, there is no target.
    frame : {"hybrid", "local", "world", "lvlh", "hill"}, optional
    reference : pin.SE3, optional
        Frame and reference placement of x and u, see `StateMap`. The default is the frame and
        reference of the policy. Without a policy, the default frame is "hybrid" ("lvlh" in orbit),
        and the default reference is the identity.
    every : int, optional
        Number of steps from one recorded row to the next. The default is 1 for up to 100,000
        steps. For more steps, the default is larger, so that about 10,000 rows are recorded; the
        motion's `notes` then report this number.
    progress : bool, optional
        Whether to show a progress bar on stderr. By default, long runs show it on a terminal.
    engine : {"python", "compiled"}, optional
        Engine that runs the simulation. The default is "python". But a run of more than 20,000
        steps uses "compiled" by default if this engine has already been compiled. The compiled
        engine needs numba. It does not support orbits. It also does not support functions written
        in Python, such as policies, events, callbacks and disturbances. The results of both engines
        agree to machine precision.

    Returns
    -------
    Motion
        Simulated motion. If the motion ended early, ``stopped`` gives the reason: an event, an
        interrupt (Ctrl-C), an attitude beyond the range of the chart, or a diverging simulation,
        with its step size.

    Raises
    ------
    InputError
        If one of these conditions is true:

        - an argument has a wrong size or value;
        - a policy returns invalid inputs, or a disturbance returns an invalid force;
        - dt is too large for the fastest pole of the loop.
    UnknownNameError
        If a method or input is unknown.

    Warns
    -----
    FflinWarning
        If the fastest pole of the loop requires more than 50,000 steps, or if inputs beyond their
        limits are required to balance springs and gravity at the target. The warning names the
        pole or the inputs.

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
    plan = Plan(SimulationOptions(**locals()))
    foresees, compiled = predictor(plan), engine_of(engine, plan) == "compiled"
    hint = "" if compiled or not_compilable(plan) else "(faster: --engine compiled) "
    began = perf_counter()
    try:
        run = recorded(plan) if compiled else go(plan, hint)
        if hint and (spent := perf_counter() - began) > LONG_RUN:
            once = "" if is_kept("loop", "advance") else f", and {_COMPILING:g} s once to compile"
            said = "the simulation took %.0f s in Python; engine='compiled' (--engine compiled)"
            _log.warning(f"fflin: {said} would take about %.0f s%s", spent, _FRACTION * spent, once)
        return motion_of(plan, run, foresees)
    except MemoryError:
        raise InputError(
            f"{plan.times.rows} rows of '{robot.name}' exceed the available memory; use a larger "
            "dt or `every`"
        ) from None


def motion_of(plan: Plan, run: Recording, foresees: Predictor | None = None) -> Motion:
    """Build the motion from the recorded rows of a run; `foresees` computes the prediction."""
    plant, state, robot = plan.plant, plan.plant.state, plan.plant.robot
    if plant.field and not run.stopped:
        plant.field.require_near(run.q[np.linalg.norm(run.q[:, :3], axis=1).argmax()])
    x = state_history(state, run.q, run.v, plan.near, run.t)
    target = np.zeros(0) if plan.target is None else plan.target
    if plan.reference is not None:
        q, v, _ = map(np.array, zip(*map(plan.reference, run.t.tolist()), strict=True))
        target = state_history(state, q, v, plan.near, run.t)
    energy, momentum, center, kept, scale = Conserved(plan).histories(run.q, run.v)
    bound = plan.law and plan.law.policy
    limits = limits_of(plan.options.robot) | plan.acting
    missing = np.linalg.norm((kept - run.momentum).reshape(-1, 2, 3), axis=2)
    drift = np.divide(missing, scale, np.zeros_like(missing), where=scale > 0.0)
    return Motion(
        t=run.t,
        q=run.q,
        v=run.v,
        u=run.u,
        stopped=run.stopped,
        engine=run.engine,
        x=x,
        target=target,
        prediction=x[:0] if foresees is None else predict(plan, foresees, x, run.steps),
        energy=energy,
        momentum=np.roll(momentum, 3, axis=1),
        momentum_drift=drift.max(axis=1),
        # In orbit, `com_drift` is empty, because the centre of mass moves on a curve even without
        # inputs and disturbances.
        com_drift=np.linalg.norm(center - run.center, axis=1)[: 0 if robot.orbit else None],
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
        wheels=tuple(plan.flown),
        wheel_inertias=np.array(list(plan.flown.values())),
        modes=tuple(map(attrgetter("name"), robot.modes)),
        mode_rotations=np.array([*map(attrgetter("rotation"), robot.modes)]),
        steered=plan.steered,
        notes=(*growing(plan.policy), *plan.times.notes, *getattr(bound, "notes", ())),
        limit_names=tuple(limits),
        limits=np.array(list(limits.values())).reshape(-1, 2),
    )


def predictor(plan: Plan) -> Predictor | None:
    """Return the predictor of a plan's motion, or None if there is no prediction.

    The predictor uses the model in the option `linear`, or by default the model of the policy.
    """
    linear, policy, state = plan.options.linear, plan.policy, plan.plant.state
    own, _ = feedback_of(policy)
    lin = own
    if not (linear is None or isinstance(linear, bool | np.bool_)):
        lin = instance("linear", linear, LinearModel, "a fflin.LinearModel, True or False")
        names = (state.names, plan.plant.actuation.names, state.frame)
        same = (lin.state_names, lin.input_names, lin.frame) == names and not lin.moving
        if isinstance(policy, LinearController):
            same = same and lin.output_names == policy.lin.output_names
        if not same or not lin.reference.isApprox(state.reference, 1e-9):
            raise InputError(
                f"linear is a model of '{lin.robot}' with other states, inputs, frame or "
                f"reference than the simulation of '{state.robot.name}'; linearise the simulated "
                "robot with the frame and the reference of the policy"
            )
    elif linear is not None and not linear:
        return None
    if lin is not None and lin.state_names == state.names:
        if isinstance(policy, LinearController) and policy.dt:
            by, model = policy.terms(), lin
            z: Array = np.zeros(len(by.A))

            def command(e: Array) -> Array:
                nonlocal z
                u, z = by.step(z, lambda u: model.y0 + model.C @ e + model.D @ (u - model.u0))
                return u

            return lin, command
        if isinstance(policy, LinearController):
            both, gains, offset = policy.around(lin)
            return both, lambda e: offset + gains @ e
        if policy is None:
            none = np.zeros(len(lin.u0))
            return lin, lambda _: none
        gain = getattr(policy, "K", None)  # an allocation is nonlinear and has no gain
        if own is not None and gain is not None:
            K, constant, _ = StateFeedback(own, gain).terms(state)
            at_point = constant - K @ lin.x0
            return lin, lambda e: at_point - K @ e
    if linear is None:
        return None
    raise InputError(
        "linear= is given, but this model cannot predict a motion with a policy of type "
        f"{type(policy).__name__}; leave linear= out, or give the full model of a StateFeedback, "
        "an OutputFeedback, a LinearController or no policy"
    )


# A prediction that overflows is omitted, so NumPy's warnings are suppressed.
@np.errstate(over="ignore", invalid="ignore")
def predict(plan: Plan, foresees: Predictor, x: Array, steps: int) -> Array:
    """Return the states (N, nx) that the linear closed loop predicts.

    Return no rows if the model cannot predict a motion, or if the prediction is not finite.
    """
    lin, (dt, _, every, sample, *_) = foresees[0].generator, plan.times
    if lin is None:  # a discrete-time model without its continuous-time model
        return x[:0]
    x0, u0 = lin.x0, lin.u0
    of = plan.plant.state.nx // 2 + plan.limits.wheels.row  # indices of limited wheel speeds in x
    applied = plan.applied(foresees[1], speeds=lambda e: (x0 + e)[of])
    rows: list[Array] = []
    e: Array = np.concatenate((x[0], np.zeros(len(x0) - x.shape[1]))) - x0

    def stepped(e: Array) -> Array:
        """Return the deviation e after one step of the classical Runge-Kutta method."""
        after, rate = e, np.zeros(len(e))
        for share, weight in ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
            at = e + share * dt * rate
            rate = lin.A @ at + lin.B @ (applied(0, at) - u0) + lin.f0
            after = after + weight * dt / 6.0 * rate
        return after

    cuts = not sample and plan.limits.cuts
    held = lin.discretize(dt) if sample else lin
    A, B, f0 = held.A, held.B, held.f0
    if not (sample or cuts):  # in this case, a step is e -> A e + f0
        f0 = stepped(np.zeros(len(e)))
        A = np.column_stack([stepped(unit) - f0 for unit in np.eye(len(e))])
    for step in range(steps):
        u = applied(step, e) if sample else u0
        if step % every == 0:
            rows.append(e)
        e = stepped(e) if cuts else A.dot(e) + B.dot(u - u0) + f0
    found = (np.array([*rows, e]) + x0)[: len(x), : x.shape[1]]
    return found if len(found) == len(x) and np.isfinite(found).all() else x[:0]
