"""The compiled simulation loop, for robots, policies and options that it supports."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from fflin.base.errors import InputError, unknown
from fflin.base.progress import Progress
from fflin.control.linear_controller import LinearController, measured_at
from fflin.control.output_feedback import OutputFeedback, TrajectoryOutputFeedback
from fflin.control.policies import Allocation, Gridded, StateFeedback
from fflin.control.tracking import TrajectoryFeedback
from fflin.kernel.compiled import kernel, loop_pays, numba_is_there
from fflin.kernel.tree import batch_tree
from fflin.robot.frames import ROOT
from fflin.simulation.conservation import Conserved
from fflin.simulation.plan import Plan
from fflin.simulation.plant import Plant
from fflin.simulation.run import Recording, ending_of, go

ENGINES = ("python", "compiled")

_OF_OUTPUTS = OutputFeedback, LinearController, TrajectoryOutputFeedback
_KNOWN = StateFeedback, TrajectoryFeedback, *_OF_OUTPUTS
_SLICE, _FIRST_SLICE = 0.05, 16  # [s] and steps between looks at the clock and at Ctrl-C
# Multiplications in the factor of M, beyond which ABA in the loop in Python is quicker.
_LARGEST_FACTOR = 200_000


def engine_of(engine: Any, plan: Plan, plant: Plant, runs: int = 0) -> str:
    """Return which loop does a plan, or so many runs by eight: as asked for, or the quicker."""
    if engine is not None and not (isinstance(engine, str) and engine in ENGINES):
        raise unknown("engine", str(engine), list(ENGINES))
    if engine == "python":
        return "python"
    reason = _reason(plan, plant)
    if engine == "compiled" and reason:
        raise InputError(f"engine='compiled' cannot run this: {reason}; leave engine out")
    if reason or (engine is None and not (_small(plant) and _pays(plan, runs))):
        return "python"
    return "compiled"


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


def _pays(plan: Plan, runs: int) -> bool:
    steps = plan.times.steps
    return loop_pays(runs * steps, "advance_eight") if runs else loop_pays(steps)


def _small(plant: Plant) -> bool:
    tree = batch_tree(plant.robot)
    return tree is not None and int((tree.depth**2).sum()) < _LARGEST_FACTOR


def carried_out(plan: Plan, plant: Plant, conserved: Conserved, engine: str) -> Recording:
    """Run a plan to its end by an engine; `plant` and `conserved` are of the robot that moves."""
    return go(plan, plant, conserved) if engine == "python" else _fly(plan, plant, conserved)


def _fly(plan: Plan, plant: Plant, conserved: Conserved) -> Recording:
    """Run a plan by the compiled loop, slice by slice."""
    from fflin.simulation.packing import SLOTS, noise_of, noises, packed

    tree, state, times = batch_tree(plant.robot), plant.state, plan.times
    assert tree is not None
    advance = kernel("loop", "advance", "the loop of `simulate`")
    parts = packed(plan, plant, conserved, tree)
    (mechanics, _, law, _, (kept, *_), _, point, stages), noise = parts, noise_of(plan)
    ends = np.cumsum([len(each) for each in (point.q, point.nu, point.u, kept.start[:6])])
    rows, clock = np.empty((times.rows, ends[-1] + 3)), np.zeros(1, dtype=np.intp)
    flat, work = rows.reshape(-1), np.empty(mechanics.layout.size)
    ending, bar = ending_of(plan), Progress(plan.progress)
    stopped, length = "", _FIRST_SLICE
    try:
        while not stopped and clock[0] < times.steps:
            began, first = time.perf_counter(), -(-int(clock[0]) // times.every)
            last = min(times.steps, int(clock[0]) + length)
            if noise:
                last = min(last, (int(clock[0]) // times.sample + SLOTS) * times.sample)
                at, values = noises(noise, times, len(law.y), int(clock[0]), last)
                law.added.reshape(SLOTS, -1)[at % SLOTS] = values
            advance(*parts, clock, last, times.every, flat[first * rows.shape[1] :], work)
            stopped = ending(clock[0] * times.dt, point.q, state.spread(point.nu))
            bar.update(int(clock[0]), times.steps)
            taken = max(time.perf_counter() - began, 1e-6)
            length = max(_FIRST_SLICE, int(length * min(8.0, _SLICE / taken)))
    except KeyboardInterrupt:
        if not clock[0]:
            raise
        stopped = f"interrupted at t = {clock[0] * times.dt:g} s"
    finally:
        bar.close()
    if not np.isfinite(stages.u).all():
        return go(plan, plant, conserved)  # which says whose command was no number
    count, end = -(-int(clock[0]) // times.every), clock[0] * times.dt
    t = np.append(times.every * np.arange(count) * times.dt, end)
    momentum, center = np.split(kept.start[:9] + kept.sums[:9], [6])
    center += end * kept.per_mass * kept.start[:3]
    rows[count] = np.concatenate((point.q, point.nu, stages.u, momentum, center))
    count += not stopped.startswith(("diverged", "interrupted"))
    q, nu, u, momentum, center = np.split(rows[:count], ends, axis=1)
    v, steps = state.spread(nu), int(clock[0])
    return Recording(t[:count], q, v, u, momentum, center, steps, stopped, "compiled")
