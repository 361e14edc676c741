"""The loop over a plan by the compiled kernel, where robot, policy and options allow it."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from fflin.base.errors import InputError, unknown
from fflin.base.progress import Progress
from fflin.control.output_feedback import OutputFeedback, measured_states
from fflin.control.policies import StateFeedback
from fflin.control.tracking import TrajectoryFeedback
from fflin.kernel.compiled import kernel, loop_pays, numba_is_there
from fflin.kernel.tree import batch_tree
from fflin.simulation.conservation import Conserved
from fflin.simulation.plan import Plan
from fflin.simulation.plant import Plant
from fflin.simulation.run import Recording, ending_of, go

ENGINES = ("python", "compiled")

_SLICE = 0.05  # [s] between looks at the clock and at Ctrl-C
# Multiplications in the factor of M, beyond which ABA in the loop in Python is quicker.
_LARGEST_FACTOR = 200_000


def engine_of(engine: Any, plan: Plan, plant: Plant) -> str:
    """Return which loop runs a plan: the one that is asked for, or by default the quicker.

    Raises
    ------
    InputError
        If the compiled one is asked for and cannot.
    UnknownNameError
        If there is no such engine.
    """
    if engine is not None and engine not in ENGINES:
        raise unknown("engine", str(engine), list(ENGINES))
    if engine == "python":
        return "python"
    reason = _reason(plan, plant)
    if engine == "compiled" and reason:
        raise InputError(f"engine='compiled' cannot run this: {reason}; leave it out")
    if reason or (engine is None and not (_small(plant) and loop_pays(plan.times.steps))):
        return "python"
    return "compiled"


def _reason(plan: Plan, plant: Plant) -> str:
    """Say what keeps a plan from the compiled loop; nothing where it can run it."""
    policy, robot = plan.policy, plant.robot
    kind = type(policy)
    keeps = {
        "numba is not installed (pip install 'fflin[fast]')": not numba_is_there(),
        "events, callbacks and disturbances are functions in Python": bool(
            plan.events or plan.callback or plant.disturbance
        ),
        f"the method {plan.method.__name__} is there in Python alone": not plan.method.origins,
        f"'{robot.name}' has a joint that is no screw about a fixed axis": batch_tree(robot)
        is None,
        f"a {kind.__name__} decides in Python": policy is not None
        and kind not in (StateFeedback, OutputFeedback, TrajectoryFeedback),
    }
    if kind is OutputFeedback:
        late = abs(plan.times.sample * plan.times.dt - policy.lin.dt) > 1e-6 * policy.lin.dt
        keeps |= {
            "the noise is a function in Python": policy.noise is not None,
            "the samples are not those of the compensator": late,
            "outputs that are no states are measured in Python": measured_states(plant.state)
            is None,
        }
    if kind is TrajectoryFeedback and policy.trajectory.flow.held:
        aligned = plant.state.origin.isIdentity(0.0)
        keeps["the trajectory's inputs stand in other axes than the run's"] = not aligned
    return next((reason for reason, holds in keeps.items() if holds), "")


def _small(plant: Plant) -> bool:
    tree = batch_tree(plant.robot)
    return tree is not None and int((tree.depth**2).sum()) < _LARGEST_FACTOR


def carried_out(plan: Plan, plant: Plant, conserved: Conserved, engine: str) -> Recording:
    """Run a plan to its end by an engine; `plant` and `conserved` are of the robot that moves."""
    return go(plan, plant, conserved) if engine == "python" else _fly(plan, plant, conserved)


def _fly(plan: Plan, plant: Plant, conserved: Conserved) -> Recording:
    """Run a plan by the compiled loop, slice by slice."""
    from fflin.simulation.packing import Seen, packed

    tree = batch_tree(plant.robot)
    assert tree is not None
    advance = kernel("loop", "advance", "the loop of `simulate`")
    times, state, seen = plan.times, plant.state, Seen(plant.state)
    parts = packed(plan, plant, conserved, tree)
    point, (kept, *_), acted = parts.point, parts.course, parts.stages.u
    ends = np.cumsum([len(each) for each in (point.q, point.nu, acted)])
    rows, clock = np.empty((times.rows, ends[-1] + 9)), np.zeros(1, dtype=np.intp)
    flat, work = rows.reshape(-1), np.empty(parts.robot.layout.size)
    ending, bar = ending_of(plan), Progress(plan.progress)
    stopped, length = "", 16
    try:
        while not stopped and clock[0] < times.steps:
            began, first = time.perf_counter(), -(-int(clock[0]) // times.every)
            last = min(times.steps, int(clock[0]) + length)
            advance(*parts, clock, last, times.every, flat[first * rows.shape[1] :], work)
            q = seen.in_world(point.q[None])[0]
            stopped = ending(clock[0] * times.dt, q, state.spread(point.nu))
            bar.update(int(clock[0]), times.steps)
            taken = max(time.perf_counter() - began, 1e-6)
            length = max(16, int(length * min(8.0, _SLICE / taken)))
    except KeyboardInterrupt:
        if not clock[0]:
            raise
        stopped = f"interrupted at t = {clock[0] * times.dt:g} s"
    finally:
        bar.close()
    steps = int(clock[0])
    count = -(-steps // times.every)
    t = times.every * np.arange(count + 1) * times.dt
    if not stopped.startswith(("diverged", "interrupted")):
        t[count] = steps * times.dt
        of_course = kept.start[:9] + kept.sums[:9]
        of_course[6:] += kept.start[:3] * kept.per_mass * t[count]
        rows[count] = np.concatenate((point.q, point.nu, acted, of_course))
        count += 1
    q, nu, u, of_course = np.split(rows[:count], ends, axis=1)
    q = seen.in_world(q)
    q[0] = plan.q
    momentum, center = seen.kept_in_world(of_course)
    v = state.spread(nu)
    return Recording(t[:count], q, v, u, momentum, center, steps, stopped, "compiled")
