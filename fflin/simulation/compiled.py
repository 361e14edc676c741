"""The compiled simulation loop, for robots, policies and options that it supports."""

from __future__ import annotations

import logging
import time
from typing import Any

from fflin.base.errors import InputError
from fflin.control.linear_controller import LinearController, OutputFeedback, measured_at
from fflin.control.policies import Allocation, Gridded, StateFeedback
from fflin.control.tracking import TrajectoryFeedback, TrajectoryOutputFeedback
from fflin.kernel.compiled import checked_engine, is_kept, numba_is_there
from fflin.kernel.tree import batch_tree
from fflin.robot.joints import ROOT
from fflin.simulation.conservation import Conserved
from fflin.simulation.plan import Plan
from fflin.simulation.plant import Plant
from fflin.simulation.run import Recording, go

_OF_OUTPUTS = OutputFeedback, LinearController, TrajectoryOutputFeedback
_KNOWN = StateFeedback, TrajectoryFeedback, *_OF_OUTPUTS
# Steps beyond which a single run goes by the compiled loop, if its machine code is there.
LONG = 20_000
# A run in Python of more than so many seconds is followed by a line on the compiled loop, which
# takes about this fraction of the time and must be compiled once.
_LONG_RUN, _FRACTION, _COMPILING = 20.0, 0.1, 30.0

_log = logging.getLogger("fflin")


def engine_of(engine: Any, plan: Plan, plant: Plant, *, many: bool = False) -> str:
    """Return the engine for a plan or many runs of it: as requested, or by the rule.

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
    """Return why the compiled loop cannot run a plan; empty if it can."""
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
        from fflin.simulation.lanes import recorded

        return recorded(plan, plant)
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
