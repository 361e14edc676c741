"""Limits of the compiled engine: what is computed in Python, and the reasons in messages.

`sweep`, `simulate` and campaigns describe what they compute by a `Task`. If `reason_against`
returns a reason, they use the Python engine, or raise an error with this reason for
engine="compiled".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from fflin.kernel.compiled import numba_is_missing, numba_is_there, without_numba
from fflin.kernel.tree import batch_tree
from fflin.robot.inputs import has_magnetorquers
from fflin.robot.joints import ROOT
from fflin.robot.orbit import is_elliptic
from fflin.robot.robot import Robot


@dataclass(frozen=True, kw_only=True)
class Task:
    """What a sweep or a simulation computes.

    Attributes
    ----------
    robots : tuple of Robot
        The robot, and the robot for whose inputs the policy was designed if it is another one.
    simulated : bool
        True for simulations, false for sweeps.
    outputs : bool
        Whether outputs other than the state are computed.
    events, callback, disturbance : bool
        Whether the simulation has these.
    lagging : bool
        Whether an output has a lag that a law in an `Allocation` measures.
    python_policy : str
        Kind of the policy if it has no data for the compiled loop, or an empty text.
    own_sample_time : bool
        Whether the policy has another sample time than the loop.
    noise_at_stages : bool
        Whether noise is added to measurements that are taken at all stages of a step.
    measurements : str
        Why the measured outputs cannot be computed, or an empty text.
    """

    robots: tuple[Robot, ...]
    simulated: bool = False
    outputs: bool = False
    events: bool = False
    callback: bool = False
    disturbance: bool = False
    lagging: bool = False
    python_policy: str = ""
    own_sample_time: bool = False
    noise_at_stages: bool = False
    measurements: str = ""

    def first(self, condition: Callable[[Robot], bool]) -> str:
        """Return the name of the first robot that meets a condition, or an empty text."""
        return next((robot.name for robot in self.robots if condition(robot)), "")


class Limit(NamedTuple):
    """Something that the compiled engine does not compute.

    `subject` returns a true value if the task needs it. The braces in `reason` stand for this
    value.
    """

    subject: Callable[[Task], object]
    reason: str


def _is_in_elliptic_orbit(robot: Robot) -> bool:
    return is_elliptic(robot.orbit)


def _has_field_function(robot: Robot) -> bool:
    return robot.orbit is not None and callable(robot.orbit.field)


def _has_magnetorquer(robot: Robot) -> bool:
    return has_magnetorquers(robot.inputs)


def _has_other_joint(robot: Robot) -> bool:
    return batch_tree(robot) is None


def _has_displaced_root(robot: Robot) -> bool:
    return not robot.model.jointPlacements[ROOT].isIdentity(0.0)


_NUMBA = Limit(lambda task: not numba_is_there() and without_numba(), "{}")

LIMITS = (
    _NUMBA,
    Limit(lambda task: task.outputs, "the outputs are not the state"),
    Limit(lambda task: task.events, "events are computed in Python"),
    Limit(lambda task: task.callback, "callbacks are called in Python"),
    Limit(lambda task: task.disturbance, "disturbances are computed in Python"),
    Limit(
        lambda task: task.lagging,
        "lags of outputs are not computed for a law in an Allocation",
    ),
    Limit(
        lambda task: "" if task.simulated else task.first(_is_in_elliptic_orbit),
        "sweeps of '{}' in its elliptic orbit are computed in Python",
    ),
    Limit(lambda task: task.python_policy, "a {} is computed in Python"),
    Limit(
        lambda task: task.simulated and task.first(_has_field_function),
        "the magnetic field of '{}' is a function, which is called in Python",
    ),
    Limit(
        lambda task: "" if task.simulated else task.first(_has_magnetorquer),
        "sweeps of '{}' with its magnetorquers are computed in Python",
    ),
    Limit(
        lambda task: task.first(_has_other_joint),
        "a joint of '{}' does not move along a screw with a fixed axis",
    ),
    Limit(
        lambda task: task.simulated and task.first(_has_displaced_root),
        "the root joint of '{}' is not at the origin of the world",
    ),
    Limit(
        lambda task: task.own_sample_time,
        "its sample time differs from the compensator's",
    ),
    Limit(
        lambda task: task.noise_at_stages,
        "noise is evaluated at every stage of every step",
    ),
    Limit(lambda task: task.measurements, "{}"),
)


def lacks_numba(task: Task) -> bool:
    """Return whether the compiled engine could compute a task if numba were installed."""
    others = [limit for limit in LIMITS if limit is not _NUMBA]
    return numba_is_missing() and not any(limit.subject(task) for limit in others)


def reason_against(task: Task) -> str:
    """Return why the compiled engine cannot compute a task, or an empty text if it can."""
    for limit in LIMITS:
        subject = limit.subject(task)
        if subject:
            return limit.reason.format(subject)
    return ""
