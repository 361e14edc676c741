"""Simulation of the nonlinear robot under any policy, with a linear prediction."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter
from time import perf_counter
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.names import group_of, input_keys
from fflin.base.process import LONG_RUN
from fflin.base.rotation import conjugate
from fflin.base.validation import Array, ArrayLike, instance
from fflin.control.bdot import BDot, RateDamping
from fflin.control.loops import PredictedLaw
from fflin.control.policy import BoundLaw, Command, Policy, Predictor
from fflin.control.sensor_errors import note_on_errors
from fflin.control.tvlqr import GainSchedule
from fflin.dynamics.coordinates import Frame
from fflin.dynamics.integrators import held_exponential
from fflin.dynamics.methods import DEFAULT_METHOD
from fflin.dynamics.outputs import sensors_by_signal
from fflin.dynamics.state_rows import state_history
from fflin.kernel.compiled import is_kept
from fflin.linear.model import Delay, LinearModel, refuse_frozen
from fflin.robot.fields import limits_of
from fflin.robot.robot import Robot
from fflin.simulation.lanes import (
    engine_of,
    loop_name,
    not_compilable,
    only_numba_is_missing,
    recorded,
)
from fflin.simulation.motion import Motion
from fflin.simulation.plan import Callback, Event, Limits, Plan, SimulationOptions
from fflin.simulation.plant import Disturbance
from fflin.simulation.run import Conserved, Recording, go

# After a run in Python of more than LONG_RUN seconds, a message recommends the compiled loop. The
# compiled loop takes about the fraction _FRACTION of the time in Python. It must be compiled once,
# which takes about _COMPILING seconds.
_FRACTION, _COMPILING = 0.1, 30.0

# If limits act on continuous commands, the prediction is integrated in parts of a time step. The
# length of a part is at most _PART divided by the fastest pole, which changes the damping of an
# oscillation by less than 1e-7 of its frequency.
_PART = 0.1
# A linear prediction makes blocks of 2**_DOUBLINGS steps; see `_affine_motion`.
_DOUBLINGS = 8

# deviation from the target at which limits do not act, to find the poles of a loop
_SMALL = 1e-6

# Changes of the energy of a free motion, relative to its largest kinetic energy, above which a note
# says that the step is too long. With springs, a step may change the amplitudes by 1 %, and so the
# energy by 2 %. Without springs, the energy hardly changes even if the rates are wrong: a spinning
# cubesat whose rates are wrong by 6 % has an energy error of 2e-5.
_ENERGY_OF_SPRINGS, _ENERGY = 0.03, 1e-5

_log = logging.getLogger("fflin")


def simulate(
    robot: Robot,
    policy: Policy | GainSchedule | Command | None = None,
    *,
    x0: ArrayLike | None = None,
    q0: ArrayLike | None = None,
    v0: ArrayLike | None = None,
    duration: float | None = None,
    dt: float | None = None,
    method: str = DEFAULT_METHOD,
    project: bool = True,
    sample: float | None = None,
    delay: Delay | None = None,
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
    noise: float = 1.0,
    seed: int = 0,
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
        trajectory. By default all inputs are zero. Before the run, a continuous function is called
        at displaced states with t = 0, to choose the time step. So a function with memory must be
        sampled (`sample`).
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
        Integration step [s]; by default 0.01, or 1 for magnetorquers and for laws that repeat, or
        less if the fastest pole of the loop or the sample time requires a shorter step. For
        continuous-time policies without delay, the step is adjusted so that the duration is a
        whole number of steps.
    method : {"cf4", "semi_implicit_euler"}
        Integration method.
    project : bool
        Whether the projection after each step restores momentum and centre of mass.
    sample : float, optional
        Sample time [s] of the policy, a multiple of dt; u is held between samples. The default is
        the sample time of the policy's model. If this model is in continuous time, the policy is
        evaluated at every stage of every integration step.
    delay : float or mapping, optional
        Time [s] from a sample until its command takes effect, a multiple of dt: one for all inputs,
        or {name, group or pattern: delay}. The default is the delay of the policy's model or C
        code, see `LinearModel.discretize`. Until the first command takes effect, the input is u0 of
        the policy's model or C code, or zero for a function. If `delay` is given without `sample`,
        the policy is sampled every dt.
    limits : "urdf", float, mapping or list of them, optional
        Limits at which the inputs saturate. By default, inputs do not saturate. Limits are one of

        - "urdf": all limits of the robot (efforts of the URDF, `min` and `max` of the inputs, the
          largest wheel speeds, `Robot.limits`);
        - a number: the largest magnitude of every input;
        - a mapping {input, group or pattern: magnitude, or (lower, upper)};
        - a list in which explicit limits take precedence over "urdf", such as
          ``["urdf", {"tau_m": 5.0}]``, and later mappings over earlier ones.

        One side of a limit may be infinite.

        On-off thrusters fire in pulses, whatever the limits. `Motion.passed` lists violated limits.
    disturbance : mapping or callable, optional
        Generalised forces {name or group: value}, such as ``{"tau_b": (0, 0, 1e-3)}`` or
        ``{"F_b.x": 0.1, "tau_m.joint_1": 0.2}``, or a function disturbance(t, q, v) that returns
        them. The torque and the force on the base are in the axes of the inputs ``tau_b`` and
        ``F_b``. A function may also return an array (nv,) in Pinocchio's order: force, then torque
        on the base, both in base axes, then joints. This form is deprecated and gives a warning.
        Before the run, a function is called at times of the whole run with the initial q and v, to
        choose the step. These forces add to `Robot.disturbance`, which acts in every simulation
        of the robot. The linear prediction contains neither.
    events : sequence of callable
        Functions event(t, q, v) -> float. The run ends after the step in which the value of an
        event becomes zero or negative.
    callback : callable, optional
        Function callback(t, q, v, u) that is called at every recorded row.
    linear : LinearModel or bool, optional
        Model that predicts the motion under the same control law. The default is the policy's own
        model; with False, there is no prediction. The motion can be predicted without a policy,
        and for a StateFeedback, an OutputFeedback or a LinearController, but not for a
        discrete-time model that was read from a file. The prediction ignores noise. If the base
        rotates past 180 deg from the reference, the prediction is omitted.
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
        engine needs numba. It does not support functions written in Python, such as policies,
        events, callbacks and disturbances. The results of both engines agree to machine precision.
    noise : float
        Factor of the noise and of the drifting biases that the outputs of the robot declare, see
        `Output`; 0 leaves them out. They act on sampled laws that measure outputs, if the
        law was made without `noise`. A bias is zero at the start, and drifts as a random walk.
    seed : int
        Seed of this noise.

    Returns
    -------
    Motion
        Simulated motion. If the motion ended early, ``stopped`` gives the reason: an event, an
        interrupt (Ctrl-C), or a diverging simulation, with its step size. The motion continues if
        the base rotates past 180 deg: policies then use the shorter rotation, see
        docs/guide/simulation.md.

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
    plan = Plan(
        SimulationOptions(
            robot=robot,
            policy=policy,
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
            engine=engine,
            noise=noise,
            seed=seed,
        )
    )
    predicting = predictor(plan)
    compiled = engine_of(engine, plan) == "compiled"
    hint = ""
    if not compiled and not not_compilable(plan):
        hint = "(faster: --engine compiled) "
    shown = hint
    if only_numba_is_missing(plan):
        shown = "(faster: fflin[fast]) "
    began = perf_counter()
    try:
        run = recorded(plan) if compiled else go(plan, shown)
        if hint and (spent := perf_counter() - began) > LONG_RUN:
            once = ""
            if not is_kept("loop", loop_name(plan, lanes=1)):
                once = f", and {_COMPILING:g} s once to compile"
            message = "the simulation took %.0f s in Python; engine='compiled' (--engine compiled)"
            _log.warning(
                f"fflin: {message} would take about %.0f s%s",
                spent,
                _FRACTION * spent,
                once,
            )
        return motion_of(plan, run, predicting)
    except MemoryError:
        raise InputError(
            f"{plan.times.rows} rows of '{robot.name}' exceed the available memory; use a larger "
            "dt or `every`"
        ) from None


# {class of a policy: what it is called on the page of a motion}
_CONTROLLERS = {
    "StateFeedback": "state feedback",
    "OutputFeedback": "output feedback",
    "LinearController": "linear controller",
    "TrajectoryFeedback": "trajectory tracking",
    "TrajectoryOutputFeedback": "trajectory tracking, output feedback",
    "Mpc": "MPC",
    "OutputMpc": "output feedback, MPC",
    "TrajectoryMpc": "trajectory tracking, MPC",
    "BDot": "B-dot",
    "RateDamping": "rate damping",
}


def controller_of(policy: object) -> str:
    """Return the name of a controller, or "no control" without a policy."""
    if policy is None:
        return "no control"
    law = policy.inner if isinstance(policy, Policy) else policy
    return _CONTROLLERS.get(type(law).__name__, "controller")


def is_detumbling(policy: object) -> bool:
    """Return whether a policy reduces the rotation rate, and has no attitude as its target."""
    law = policy.inner if isinstance(policy, Policy) else policy
    return isinstance(law, BDot | RateDamping)


def motion_of(
    plan: Plan, run: Recording, predicting: Predictor | None = None
) -> Motion:
    """Build the motion from the recorded rows of a run; `predicting` computes the prediction.

    The motion of a brief recording has no notes, and its energy and momentum are NaN.
    """
    plant, state, robot = plan.plant, plan.plant.state, plan.plant.robot
    if plant.field and not run.stopped:
        plant.field.require_near(run.q[np.linalg.norm(run.q[:, :3], axis=1).argmax()])
    x = state_history(state, run.q, run.v, plan.near, run.t)
    target = np.zeros(0) if plan.target is None else plan.target
    reference = conjugate(state.origin_quaternion)
    if plan.follows is not None:
        q, v, _ = map(np.array, zip(*map(plan.follows, run.t.tolist()), strict=True))
        reference = q[:, 3:7]
        if plan.reference is not None:
            target = state_history(state, q, v, plan.near, run.t)
    beyond = past_half_turn(run, reference)
    # Beyond 180 deg from the reference, q_b jumps to the shorter rotation. A linear model does not
    # predict this jump.
    prediction = x[:0]
    if predicting is not None and beyond is None:
        prediction = predict(plan, predicting, x, run.steps)
    balances: dict[str, Any]
    notes: tuple[str, ...] = ()
    if run.is_brief:
        balances = _unknown_balances(len(run.t))
    else:
        balances, of_energy = _balances(plan, run)
        of_turn = half_turn_notes(plan, beyond, predicted=predicting is not None)
        notes = _notes(plan, of_energy, of_turn)
    limits = limits_of(plan.options.robot) | plan.acting
    return Motion(
        t=run.t,
        q=run.q,
        v=run.v,
        u=run.u,
        stopped=run.stopped,
        engine=run.engine,
        step=plan.times.dt,
        x=x,
        target=target,
        prediction=prediction,
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
        _about=controller_of(plan.policy),
        _detumbling=is_detumbling(plan.policy),
        wheels=tuple(plan.flown),
        wheel_inertias=np.array(list(plan.flown.values())),
        modes=tuple(map(attrgetter("name"), robot.modes)),
        mode_rotations=np.array([*map(attrgetter("rotation"), robot.modes)]),
        steered=plan.steered,
        notes=notes,
        limit_names=tuple(limits),
        limits=np.array(list(limits.values())).reshape(-1, 2),
        **balances,
        **_constraint_forces(plan, run),
    )


def _notes(plan: Plan, of_energy: list[str], of_turn: list[str]) -> tuple[str, ...]:
    """Return the notes of a motion, with the given notes on its energy and on half a turn."""
    plant, policy, times = plan.plant, plan.policy, plan.times
    loop_notes: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    if policy:
        loop_notes = policy.loop_notes(times.sample * times.dt)
        notes = policy.notes
    if policy and plan.errors:
        errors = note_on_errors(policy.sensors, plan.errors, plan.options.seed)
        notes = (*notes, errors)
    if plan.law and isinstance(plan.law.policy, BoundLaw):
        notes += plan.law.policy.notes
    if plant.constrained is not None:
        notes = (*notes, *plant.constrained.notes(plan.q))
    return (*loop_notes, *times.notes, *of_energy, *dict.fromkeys(notes), *of_turn)


def _unknown_balances(rows: int) -> dict[str, Any]:
    """Return the fields of a motion about energy and momentum, all NaN."""
    unknown = np.broadcast_to(np.nan, (rows, 6))
    return {
        "energy": unknown[:, 0],
        "momentum": unknown,
        "momentum_drift": unknown[:, 0],
    }


def _balances(plan: Plan, run: Recording) -> tuple[dict[str, Any], list[str]]:
    """Return the fields of a motion about energy and momentum, and notes on them."""
    energy, momentum, center, kept, scale = Conserved(plan).histories(
        run.t, run.q, run.v
    )
    # In orbit, `com_drift` is empty, because the centre of mass moves on a curve even without
    # inputs and disturbances.
    com_drift = np.linalg.norm(center - run.center, axis=1)
    if plan.plant.robot.orbit:
        com_drift = com_drift[:0]
    missing = np.linalg.norm((kept - run.momentum).reshape(-1, 2, 3), axis=2)
    drift = np.divide(missing, scale, np.zeros_like(missing), where=scale > 0.0)
    fields = {
        "energy": energy,
        "momentum": np.roll(momentum, 3, axis=1),
        "momentum_drift": drift.max(axis=1),
        "com_drift": com_drift,
    }
    return fields, [*_energy_note(plan, run, energy, float(scale[0]))]


def _constraint_forces(plan: Plan, run: Recording) -> dict[str, Any]:
    """Return the fields of a motion about the forces of constraints."""
    constrained = plan.plant.constrained
    if constrained is None or run.forces is None:
        return {}
    return {
        "constraint_names": constrained.names,
        "constraint_forces": constrained.wrenches(run.q, run.forces),
    }


def _energy_note(
    plan: Plan, run: Recording, energy: Array, scale: float
) -> Iterator[str]:
    """Yield a note if the energy of a free motion changes, which is an error of the integration.

    The projection conserves the momentum whatever the step is, so only the energy shows the error.
    `scale` is the largest linear momentum that the kinetic energy permits (11.6).
    """
    robot = plan.plant.robot
    driven = (
        run.u.any()
        or plan.options.disturbance is not None
        or robot.disturbance
        or robot.springs.damping.any()
    )
    if driven or robot.orbit or not scale:
        return
    kinetic = scale**2 / (2.0 * robot.mass)
    change = float(np.abs(energy - energy[0]).max()) / kinetic
    tolerance = _ENERGY_OF_SPRINGS if robot.springs.stiffness.any() else _ENERGY
    if change > tolerance:
        yield (
            f"the energy changes by {100.0 * change:.2g} % of its largest kinetic part, although "
            "no force does work, so the motion is not accurate; give a smaller dt"
        )


def past_half_turn(run: Recording, reference: Array) -> float | None:
    """Return the time [s] of the first recorded row after the base rotated past 180 deg, or None.

    `reference` is the attitude from which the rotation is measured: one quaternion (4,), or one
    quaternion for each row (N, 4), of arbitrary signs.
    """
    if reference.ndim == 2:
        # Of the two quaternions of each attitude, choose the one that is nearer to the row before.
        products = (reference[1:] * reference[:-1]).sum(axis=1)
        signs = np.cumprod(np.where(products < 0.0, -1.0, 1.0))
        reference = reference * np.append(1.0, signs)[:, None]
    # The scalar part of the quaternion from the reference to the base changes its sign at 180 deg.
    negative = (run.q[:, 3:7] * reference).sum(axis=1) < 0.0
    rows = np.flatnonzero(negative != negative[0])
    if not len(rows):
        return None
    return float(run.t[rows[0]])


def half_turn_notes(plan: Plan, beyond: float | None, *, predicted: bool) -> list[str]:
    """Return a note if the base rotated past 180 deg at the time `beyond` [s] and this matters.

    It matters if the policy feeds the attitude back, or if the motion was to be predicted.
    """
    if beyond is None:
        return []
    clauses = list[str]()
    steered = "q_b" in map(group_of, plan.steered)
    policy = plan.policy
    if policy and not plan.steered and policy.model is None:
        # C code does not say which states it feeds back. A function has no reference.
        steered = policy.axes[1] is not None
    if steered:
        clauses.append("the law continued with the shorter rotation")
    if predicted:
        clauses.append(
            "the linear prediction is omitted, because it does not hold there"
        )
    if not clauses:
        return []
    origin = "reference" if plan.follows is None else "trajectory"
    at = f"the base rotated past 180 deg from the {origin} at t = {beyond:g} s"
    return [f"{at}; {'; '.join(clauses)}"]


def predictor(plan: Plan) -> Predictor | None:
    """Return the predictor of a plan's motion, or None if there is no prediction.

    The predictor uses the model in the option `linear`, or by default the model of the policy.
    """
    linear, policy, state = plan.options.linear, plan.policy, plan.plant.state
    lin = policy.model if policy else None
    if lin is not None:
        lin = lin.undelayed
    if not (linear is None or isinstance(linear, bool | np.bool_)):
        lin = instance(
            "linear", linear, LinearModel, "a fflin.LinearModel, True or False"
        ).undelayed
        names = (state.names, plan.plant.actuation.names, state.frame)
        same = (lin.state_names, lin.input_names, lin.frame) == names and not lin.moving
        if policy and policy.senses_outputs:
            same = same and lin.output_names == policy.sensors
        if not same or not lin.reference.isApprox(state.reference, 1e-9):
            raise InputError(
                f"linear is a model of '{lin.robot}' with other states, inputs, frame or "
                f"reference than the simulation of '{state.robot.name}'; linearise the simulated "
                "robot with the frame and the reference of the policy"
            )
    elif linear is not None and not linear:
        return None
    if lin is not None and lin.t is not None:
        if linear is None:
            return None
        refuse_frozen(lin, "a linear prediction (linear=)")
    if lin is not None and lin.state_names == state.names:
        lin = _with_lags_of(plan, lin)
        if policy is None:
            none = np.zeros(len(lin.u0))
            return lin, lambda _: none
        predicted = policy.prediction(lin, state)
        if predicted is not None:
            return predicted
    if linear is None:
        return None
    kind = policy.kind if policy else None
    raise InputError(
        "linear= is given, but this model cannot predict a motion with a policy of type "
        f"{kind}; leave linear= out, or give the full model of a "
        "StateFeedback, an OutputFeedback, a LinearController or no policy"
    )


def _with_lags_of(plan: Plan, lin: LinearModel) -> LinearModel:
    """Return the model with the lags of the simulated robot, in continuous time if it has any."""
    lags = plan.plant.lags
    source = lin.generator
    output_lags = {}
    if plan.policy and plan.policy.senses_outputs:
        sensors = sensors_by_signal(plan.plant.state)
        output_lags = {name: sensor.lag or 0.0 for name, sensor in sensors.items()}
    if source is None or not (lags.any() or any(output_lags.values())):
        return lin
    by_input = dict(zip(input_keys(lin), lags.tolist(), strict=True))
    return source.with_lags(by_input, output_lags)


# A prediction that overflows is omitted, so NumPy's warnings are suppressed.
@np.errstate(over="ignore", invalid="ignore")
def predict(plan: Plan, predicting: Predictor, x: Array, steps: int) -> Array:
    """Return the states (N, nx) that the linear closed loop predicts.

    Return no rows if the model cannot predict a motion, or if the prediction is not finite.
    """
    model, law = predicting
    lin = model.generator
    times = plan.times
    dt, every, sample = times.dt, times.every, times.sample
    if lin is None:  # a discrete-time model without its continuous-time model
        return x[:0]
    x0, u0 = lin.x0, lin.u0
    # Indices in x of the wheel speeds that have limits.
    wheel_rows = plan.plant.state.nx // 2 + plan.limits.wheels.row
    correct = law.correct if isinstance(law, PredictedLaw) else None
    applied = plan.applied(law, lambda e: (x0 + e)[wheel_rows], correct)
    rows: list[Array] = []
    nx = x.shape[1]
    e: Array = np.concatenate((x[0] - x0[:nx], np.zeros(len(x0) - nx)))

    def rate(e: Array) -> Array:
        """Return de/dt under a continuous command."""
        derivative: Array = lin.A @ e + lin.B @ (applied(0, e) - u0) + lin.f0
        return derivative

    cuts = not sample and plan.limits.cuts
    # Without limits, a step of a continuous loop is e -> A e + f0 with constant A and f0, and its
    # command is included in A. With limits, the loop is integrated in short parts of a step.
    A: Array = lin.A
    B: Array = lin.B
    f0: Array = lin.f0[:, None]
    parts = 1
    if not sample:
        f0 = rate(np.zeros(len(e)))[:, None]
        size = _SMALL if cuts else 1.0
        A = np.column_stack(
            [(rate(size * unit) - f0[:, 0]) / size for unit in np.eye(len(e))]
        )
    if cuts:
        fastest = max(
            np.abs(np.linalg.eigvals(matrix)).max(initial=0.0) for matrix in (A, lin.A)
        )
        parts = math.ceil(max(1.0, fastest * dt / _PART))
    A, forced = held_exponential(A, np.hstack((B, f0)), dt)
    B, f0 = forced[:, :-1], forced[:, -1]
    if not (sample or cuts):
        states = _affine_motion(A, f0, e, steps, every)[: len(x)]
        if len(states) == len(x) and np.isfinite(states).all():
            return (states + x0)[:, : x.shape[1]]
        # A power of A may overflow although no state does, so the steps are then made one by one.
    for step in range(steps):
        u = applied(step, e) if sample else u0
        if step % every == 0:
            rows.append(e)
        if cuts:
            for _ in range(parts):
                e = _runge_kutta(rate, e, dt / parts)
        else:
            e = A.dot(e) + B.dot(u - u0) + f0
    states = (np.array([*rows, e]) + x0)[: len(x), : x.shape[1]]
    if len(states) == len(x) and np.isfinite(states).all():
        return states
    return x[:0]


def _affine_motion(A: Array, f0: Array, e: Array, steps: int, every: int) -> Array:
    """Return e before every `every`-th of the steps e -> A e + f0, and e after the last step."""
    # A block of steps is filled by doubling: the first 2^k rows times the 2^k-th power of the step
    # matrix are the next 2^k rows. All steps are computed for every value of `every`, so the rows
    # of a thinned run equal rows of the full run bit for bit.
    size = len(e)
    # Matrix of one step of the vector (e, 1).
    step = np.zeros((size + 1, size + 1))
    step[:size, :size] = A
    step[:size, size] = f0
    step[size, size] = 1.0
    powers = [step]
    for _ in range(_DOUBLINGS):
        powers.append(powers[-1] @ powers[-1])
    block = 2**_DOUBLINGS
    rows = np.empty((block, size + 1))
    first = np.append(e, 1.0)
    kept: list[Array] = []
    for begin in range(0, steps + 1, block):
        rows[0] = first
        for doubling in range(_DOUBLINGS):
            filled = 2**doubling
            rows[filled : 2 * filled] = rows[:filled] @ powers[doubling].T
        first = powers[-1] @ rows[0]
        # Row i of the block is e after begin + i steps. Keep the multiples of `every` before the
        # last step.
        end = min(block, steps - begin)
        first_multiple = -begin % every
        kept.append(rows[first_multiple:end:every].copy())
        last_step_in_block = steps < begin + block
        if last_step_in_block:
            kept.append(rows[end : end + 1].copy())
    return np.concatenate(kept)[:, :size]


def _runge_kutta(rate: Callable[[Array], Array], e: Array, h: float) -> Array:
    """Return e after a step of h [s] of the classical Runge-Kutta method, for de/dt = rate(e)."""
    after: Array = e
    derivative: Array = np.zeros(len(e))
    for fraction, weight in ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
        derivative = rate(e + fraction * h * derivative)
        after = after + weight * h / 6.0 * derivative
    return after
