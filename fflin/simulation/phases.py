"""Motions joined from phases: after an impact, with another robot, or under another policy."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array, instance
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.coordinates import state_history
from fflin.dynamics.impact import Impact, joint_called
from fflin.dynamics.state import StateMap
from fflin.robot.robot import ROOT, Robot

if TYPE_CHECKING:
    from fflin.simulation.motion import Motion

# Largest difference of rates and displacements between the end of a phase and the next phase's
# start.
_MET = 1e-6


def carried_on(first: Motion, later: tuple[Motion | Impact, ...]) -> Motion:
    """Join several phases to one motion; see `Motion.then`."""
    if not later or isinstance(later[-1], Impact):
        raise InputError(
            "the last phase is an impact, expected a Motion; simulate the robot after the impact"
        )
    parts: tuple[Any, ...] = (*(first._phases or (first,)), *later)
    if not all(getattr(part, "_robot", part) for part in parts):
        raise InputError(
            "a motion that was read from a file lacks its robot; join motions returned by simulate"
        )
    whole: Motion = replace(
        parts[0], phases=(parts[0].robot,), starts=parts[0].t[:1], _phases=parts
    )
    robot, q, v, event = whole._robot, whole.q[-1], whole.v[-1], ""
    for part in parts[1:]:
        if isinstance(part, Impact):
            _require_met(part.event, robot, q, v, *part._before)
            robot, q, v, event = part.robot, part.q, part.v, part.event
            whole = replace(whole, notes=(*whole.notes, f"{whole.t[-1]:g} s: {part.told}"))
        else:
            instance("a phase", part, type(first), "a Motion, or an Impact before one")
            name, other = event or part.robot, part._robot
            _require_met(name, robot, q, v, other, part.q[0], part.v[0])
            robot, q, v, event = other, part.q[-1], part.v[-1], ""
            whole = _longer(whole, part, name)
    return whole


def _require_met(
    what: str, robot: Robot, q: Array, v: Array, other: Robot, other_q: Array, other_v: Array
) -> None:
    """Raise `InputError` if a phase does not begin in the final state of the previous phase."""
    seen, rates = _seen(robot, other, q, other_q[None], other_v[None])
    apart = np.abs([pin.difference(robot.model, q, seen[0]), rates[0] - v]).max(axis=0)
    if apart.max() > _MET * max(1.0, np.abs(v).max()):
        at = max(i for i, start in enumerate(robot.model.idx_vs) if start <= apart.argmax())
        raise InputError(
            f"'{what}' does not begin where the motion before it ended: "
            f"'{robot.model.names[at]}' differs by {apart.max():.2g} in position or rate; start "
            "from q and v in the last row of that motion"
        )


def _seen(robot: Robot, other: Robot, last: Array, q: Array, v: Array) -> tuple[Array, Array]:
    """Convert rows of another robot to this robot's coordinates; missing joints are at rest."""
    own_q, own_v = np.tile(last, (len(q), 1)), np.zeros((len(q), robot.nv))
    for name in list(robot.model.names)[ROOT:]:
        if other.model.existJointName(name):
            here, there = joint_called(robot, name), joint_called(other, name)
            own_q[:, here.idx_q :][:, : here.nq] = q[:, there.idx_q :][:, : here.nq]
            own_v[:, here.idx_v :][:, : here.nv] = v[:, there.idx_v :][:, : here.nv]
    return own_q, own_v


def _longer(whole: Motion, motion: Motion, name: str) -> Motion:
    """Append the rows of another motion, converted to this motion's chart, joints and inputs."""
    if (motion.frame, motion.circles) != (whole.frame, whole.circles):
        where, before = (f"'{m.frame}'{' in orbit' * bool(m.circles)}" for m in (motion, whole))
        raise InputError(
            f"'{name}' is in the frame {where}, the first phase in {before}; simulate both in one "
            "frame"
        )
    frame: Any = whole.frame
    state, there = (StateMap(m._robot, reference=m.reference, frame=frame) for m in (whole, motion))
    last, near, t = whole.q[-1], whole.x[-1], motion.t - motion.t[0] + whole.t[-1]
    q, v = _seen(state.robot, there.robot, last, motion.q, motion.v)
    target = np.zeros(0)
    if whole.target.size and motion.target.size:
        points = there.points(np.atleast_2d(motion.target))[1:]
        goals = state_history(state, *_seen(state.robot, there.robot, last, *points), near)
        rows = (whole.target, len(whole.t)), (goals, len(t))
        target = np.vstack([np.broadcast_to(x, (n, state.nx)) for x, n in rows])
    alike: dict[str, Any] = {
        key: np.concatenate([getattr(m, key) for m in (whole, motion)])
        for key in ("energy", "momentum", "momentum_drift", "com_drift")
    }
    return replace(
        whole,
        **alike,
        t=np.concatenate((whole.t, t)),
        q=np.vstack((whole.q, q)),
        v=np.vstack((whole.v, v)),
        x=np.vstack((whole.x, state_history(state, q, v, near, t))),
        u=np.vstack((whole.u, _inputs(whole, state, motion, there))),
        target=target,
        prediction=whole.prediction[:0],
        steered=tuple(x for x in whole.steered if x in motion.steered),
        stopped=motion.stopped,
        notes=tuple(dict.fromkeys((*whole.notes, *motion.notes))),
        verified=whole.verified and motion.verified,
        phases=(*whole.phases, name),
        starts=np.append(whole.starts, whole.t[-1]),
    )


def _inputs(whole: Motion, state: StateMap, motion: Motion, there: StateMap) -> Array:
    """Return a phase's inputs (N, nu) in the order of the whole motion; missing inputs are zero."""
    if more := [name for name in motion.input_names if name not in whole.input_names]:
        raise InputError(
            f"a phase has the input {more[0]}, which the first phase lacks; give the first robot "
            "that input"
        )
    u = np.zeros((len(motion.t), len(whole.input_names)))
    u[:, [whole.input_names.index(name) for name in motion.input_names]] = motion.u
    turn = there.reference.rotation.T @ state.reference.rotation
    for held in Actuation(state).held:  # in reference axes
        u[:, held] = u[:, held] @ turn
    return u
