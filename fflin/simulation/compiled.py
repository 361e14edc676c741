"""The compiled simulation loop, for robots, policies and options that it supports."""

from __future__ import annotations

import logging
import time
from typing import Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.process import Progress
from fflin.control.linear_controller import LinearController, OutputFeedback, measured_at
from fflin.control.policies import Allocation, Gridded, StateFeedback
from fflin.control.tracking import TrajectoryFeedback, TrajectoryOutputFeedback
from fflin.kernel.compiled import checked_engine, is_kept, numba_is_there
from fflin.kernel.tree import LANES, batch_tree
from fflin.robot.joints import ROOT
from fflin.simulation.conservation import Conserved
from fflin.simulation.plan import Plan
from fflin.simulation.plant import Plant
from fflin.simulation.run import Recording, ending_of, go, stop_conditions

_OF_OUTPUTS = OutputFeedback, LinearController, TrajectoryOutputFeedback
_KNOWN = StateFeedback, TrajectoryFeedback, *_OF_OUTPUTS
_SLICE, _FIRST_SLICE = 0.05, 16  # [s] and steps between looks at the clock and at Ctrl-C
# Steps beyond which a single run goes by the compiled loop, if its machine code is there.
LONG = 20_000
# A run in Python of more than so many seconds is followed by a line on the compiled loop, which
# takes about this fraction of the time and must be compiled once.
_LONG_RUN, _FRACTION, _COMPILING = 20.0, 0.1, 30.0

_log = logging.getLogger("fflin")


def engine_of(engine: Any, plan: Plan, plant: Plant, *, many: bool = False) -> str:
    """Return which loop does a plan, or many runs of it: as asked for, or by the rule.

    Many runs go by the compiled loop where it can run them; one does if it is long and the machine
    code is there already.
    """
    if checked_engine(engine) == "python":
        return "python"
    reason = _reason(plan, plant)
    if engine == "compiled":
        if reason:
            raise InputError(
                f"engine='compiled' is not possible, because {reason}; leave engine out"
            )
        return "compiled"
    wanted = many or (plan.times.steps > LONG and is_kept("loop", "advance"))
    return "compiled" if wanted and not reason else "python"


def _reason(plan: Plan, plant: Plant) -> str:
    """Say what keeps a plan from the compiled loop; nothing where it can run it."""
    policy, robots = plan.policy, [plant.robot]
    if not numba_is_there():
        return "numba is not installed (pip install 'fflin[fast]')"
    if plan.events or plan.callback or plant.disturbance or plant.field:
        return "events, callbacks, disturbances and the field of an orbit are computed in Python"
    if isinstance(policy, Allocation):
        robots.append(policy.design)
        policy = policy.policy
    known = type(policy) in _KNOWN or isinstance(policy, Gridded)
    if policy is not None and not known:
        return f"a {type(policy).__name__} is computed in Python"
    if reason := _unmeasured(plan, plant, policy):
        return reason
    for robot in robots:
        at_home = robot.model.jointPlacements[ROOT].isIdentity(0.0)
        if batch_tree(robot) is None or not at_home:
            return f"a joint of '{robot.name}' does not move along a screw with a fixed axis"
    return ""


def _unmeasured(plan: Plan, plant: Plant, policy: Any) -> str:
    """Say why a plan's compensator, if it has one, cannot have its samples."""
    if not isinstance(policy, _OF_OUTPUTS):
        return ""
    dt = policy.dt if isinstance(policy, LinearController) else policy.filter.dt
    if abs(plan.times.sample * plan.times.dt - dt) > 1e-6 * dt and dt:
        return "its sample time differs from the compensator's"
    if policy.noise is not None and not plan.times.sample:
        return "noise is evaluated at every stage of every step"
    try:
        measured_at(plant.state)
    except InputError as error:
        return str(error)
    return ""


def carried_out(plan: Plan, plant: Plant, conserved: Conserved, engine: str) -> Recording:
    """Run a plan to its end by an engine; `plant` and `conserved` are of the robot that moves."""
    if engine == "compiled":
        return _fly(plan, plant, conserved)
    began = time.perf_counter()
    run = go(plan, plant, conserved)
    spent = time.perf_counter() - began
    if spent > _LONG_RUN and not _reason(plan, plant):
        once = "" if is_kept("loop", "advance") else f", and {_COMPILING:g} s once to compile"
        _log.warning(
            "fflin: the simulation took %.0f s in Python; engine='compiled' (--engine compiled) "
            "would take about %.1g s%s",
            spent,
            _FRACTION * spent,
            once,
        )
    return run


def _fly(plan: Plan, plant: Plant, conserved: Conserved) -> Recording:
    """Run a plan by the compiled loop, slice by slice, as the first of eight equal runs."""
    from fflin.simulation.packing import SLOTS, CompiledLoop, kept_at, noise_of, noises, packed

    tree, state, times, every = batch_tree(plant.robot), plant.state, plan.times, plan.times.every
    assert tree is not None
    loop = CompiledLoop(packed(plan, plant, conserved, tree))
    law, point, stages = loop.parts.law, loop.parts.point, loop.parts.stages
    noise, clock = noise_of(plan), np.zeros(1, dtype=np.intp)
    rows, space = np.empty((times.rows, loop.width)), loop.rows(times.rows)
    room = len(space) // loop.width * every  # in steps
    ending, bar = ending_of(plan, stop_conditions(plan)), Progress(plan.progress)
    stopped, length = "", _FIRST_SLICE
    try:
        while not stopped and clock[0] < times.steps:
            began, step = time.perf_counter(), int(clock[0])
            first = -(-step // every)
            last = min(times.steps, step + length, first * every + room)
            if noise:
                last = min(last, (step // times.sample + SLOTS) * times.sample)
                at, values = noises(noise, times, len(law.y), step, last)
                law.added.reshape(SLOTS, -1, LANES)[at % SLOTS] = values[..., None]
            loop.advance(clock, last, every, space)
            done = -(-int(clock[0]) // every)
            taken = space[: (done - first) * loop.width, 0]
            rows[first:done] = taken.reshape(-1, loop.width)
            stopped = ending(clock[0] * times.dt, point.q[:, 0], state.spread(point.nu[:, 0]))
            bar.update(int(clock[0]), times.steps)
            spent = max(time.perf_counter() - began, 1e-6)
            length = max(_FIRST_SLICE, int(length * min(8.0, _SLICE / spent)))
    except KeyboardInterrupt:
        if not clock[0]:
            raise
        stopped = f"interrupted at t = {clock[0] * times.dt:g} s"
    finally:
        bar.close()
    if not np.isfinite(stages.u).all():
        return go(plan, plant, conserved)  # which says whose command was no number
    count, end = -(-int(clock[0]) // every), clock[0] * times.dt
    t = np.append(every * np.arange(count) * times.dt, end)
    momentum, center = kept_at(loop.parts, end)
    ended = point.q[:, 0], point.nu[:, 0], stages.u[:, 0], momentum, center
    rows[count] = np.concatenate(ended)
    count += not stopped.startswith(("diverged", "interrupted"))
    q, nu, u, momentum, center = (rows[:count, part] for part in loop.columns)
    v, steps = state.spread(nu), int(clock[0])
    return Recording(t[:count], q, v, u, momentum, center, steps, stopped, "compiled")
