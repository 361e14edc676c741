"""Statistics of a run: final and largest errors, settling times, and histories at a few times.

Their size does not depend on how long the run is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fflin.base.rotation import conjugate, quaternion_product
from fflin.base.validation import Array
from fflin.dynamics.coordinates import attitude_errors, moving_errors, states_of, unwound
from fflin.dynamics.state import StateMap
from fflin.kernel import loop
from fflin.kernel.arguments import empty, laid_out, words_of
from fflin.kernel.compiled import kernel
from fflin.kernel.tree import LANES
from fflin.simulation.packing import no_law
from fflin.simulation.plan import Plan
from fflin.simulation.report import SETTLED, THERE, is_late, settled_at
from fflin.simulation.run import Recording, stop_of

# Kinds of errors with their units; the error of a kind is its largest entry. Wheels and modes are
# no joints.
KINDS = {
    "attitude": "deg",
    "position": "m",
    "joints": "rad|m",
    "omega_b": "rad/s",
    "v_b": "m/s",
    "joint rates": "rad/s|m/s",
}
# Former names of kinds, which conditions and goals may still use.
_FORMER = {"turning": "omega_b", "moving": "v_b", "rates": "joint rates"}


def kind_named(name: str) -> str:
    """Return a name of a kind of error, such as ``worst turning``, with its present words."""
    of, _, kind = name.rpartition(" ")
    kind = _FORMER.get(kind, kind) if of in ("", "worst", "settle") else kind
    return f"{of} {kind}".strip()


class Outcome(NamedTuple):
    """Outcomes of runs, one row of each array per run."""

    q: Array  # (N, nq), final
    v: Array  # (N, nv)
    x: Array  # (N, nx)
    u: Array  # (N, nu)
    largest_x: Array  # (N, nx), errors
    largest_u: Array  # (N, nu)
    errors: Array  # (N, kinds), final
    largest: Array  # (N, kinds)
    settle: Array  # (N, kinds) [s], settling times; infinite if the error has not settled
    error_history: Array  # (N, times, kinds), infinite after a run was stopped
    input_history: Array  # (N, times, nu), zero after a run was stopped
    stop: Array  # (N,), index into STOPS
    end: Array  # (N,) [s]


def kinds_of(state: StateMap) -> NDArray[np.intp]:
    """Return the index into KINDS of each state (nx,).

    It is 0 for the attitude and for states without a kind, such as modes, and -1 for wheels.
    """
    kind = np.zeros(state.nx, dtype=np.intp)
    groups, wheels = state.groups, state.robot.wheels
    for number, group in enumerate((groups.r_b, groups.q_m, groups.omega_b, groups.v_b), 1):
        kind[group] = number
    kind[groups.qdot_m] = len(KINDS) - 1
    for index, joint in enumerate(state.robot.joints):
        if joint.mode or joint.name in wheels:
            kind[groups.q_m.start + index] = 0 if joint.mode else -1
            kind[groups.qdot_m.start + index] = 0
    return kind


def outcome_of(
    plan: Plan, state: StateMap, target: Array, steps: Array, run: Recording
) -> dict[str, Array]:
    """Return the outcome, as a row of each array of `Outcome`, of a run with a row for every step.

    Errors are those from the state `target` (nx,), or from a moving one (steps + 1, nx). Histories
    are kept at `steps`.
    """
    count, kind, nu = len(run.q), kinds_of(state), state.velocities(run.v)
    moving = target.ndim == 2
    target = target[:count] if moving else target
    x = unwound(state, states_of(state, run.q, nu), target[0] if moving else target)
    e = unwound(state, moving_errors(state.frame, x, target)) if moving else x - target
    e, u = np.where(kind < 0, 0.0, np.abs(e)), np.abs(run.u)
    others = [e[:, kind == of].max(axis=1, initial=0.0) for of in range(1, len(KINDS))]
    sizes = np.column_stack([attitude_errors(x, target), *others])
    settled, stop = settled_at(sizes), stop_of(run.stopped)
    kept, last = steps[steps < count], slice(-1, None)
    error_history = np.full((1, len(steps), len(KINDS)), np.inf)
    input_history = np.zeros((1, len(steps), u.shape[1]))
    error_history[0, : len(kept)], input_history[0, : len(kept)] = sizes[kept], run.u[kept]
    return Outcome(
        q=run.q[last],
        v=run.v[last],
        x=x[last],
        u=run.u[last],
        largest_x=e.max(axis=0, keepdims=True),
        largest_u=u.max(axis=0, keepdims=True),
        errors=sizes[last],
        largest=sizes.max(axis=0, keepdims=True),
        settle=np.where(is_late(settled, count) | (stop > 0), np.inf, settled * plan.times.dt)[
            None
        ],
        error_history=error_history,
        input_history=input_history,
        stop=np.array([float(stop)]),
        end=np.array([run.steps * plan.times.dt]),
    )._asdict()


def marks_of(
    plan: Plan, state: StateMap, target: Array, steps: Array, path: Sequence[Array]
) -> loop.RunStatistics:
    """Return what the kernel's statistics of a run read and write.

    Errors are those from the state `target` (nx,), or from a moving one (steps + 1, nx) whose q and
    nu are the arrays of `path`. Histories are kept at `steps`.
    """
    robot, kinds, nu = state.robot, len(KINDS), len(plan.initial)
    first = target if target.ndim == 1 else target[0]
    x, y, z = first[:3].tolist()
    attitude = np.array((x, y, z, math.sqrt(max(0.0, 1.0 - x * x - y * y - z * z))))
    law, marks = no_law(state, plan.initial), empty(loop.RUN_STATISTICS)
    law.path.point.q[3:7] = quaternion_product(conjugate(state.origin_quaternion), attitude)
    q_ref, nu_ref = path or (np.zeros(0), np.zeros(0))
    return marks._replace(
        robot=marks.robot._replace(
            index=np.array([joint.idx_q for joint in robot.joints], dtype=np.intp),
            circling=np.array([joint.unbounded for joint in robot.joints], dtype=bool),
            scale=np.array([joint.scale for joint in robot.joints]),
        ),
        law=law._replace(near=first[state.groups.q_m]),
        path=law.path,
        x_ref=first,
        q_ref=q_ref,
        nu_ref=nu_ref,
        kind=kinds_of(state),
        settled=SETTLED,
        tolerance=np.full(kinds, THERE),
        steps=steps,
        at=marks.at._replace(q=np.zeros(robot.nq), nu=np.zeros(state.nx // 2)),
        sizes=np.zeros(kinds),
        largest_x=np.zeros(state.nx),
        largest_u=np.zeros(nu),
        largest=np.zeros(kinds),
        outside=np.full(kinds, -1.0),
        errors=np.full(len(steps) * kinds, np.inf),
        inputs=np.zeros(len(steps) * nu),
    )


class RunStatistics:
    """Statistics of eight parallel runs in compiled code; see `marks_of`."""

    FIELDS: ClassVar[tuple[str, ...]] = Outcome._fields
    every = 1
    span = 2**20  # steps between checks of `over`

    def __init__(
        self,
        plan: Plan,
        state: StateMap,
        target: Array,
        steps: Array,
        path: Sequence[Array],
    ) -> None:
        self._dt, self._state, self._steps = plan.times.dt, state, steps
        self.over = np.zeros(LANES, dtype=bool)  # every run goes on to its end
        marks = marks_of(plan, state, target, steps, path)
        self._fresh: list[tuple[Array, Array]] = []
        self._marks = laid_out(marks, loop.RUN_STATISTICS, lambda *pair: self._fresh.append(pair))
        self._words = words_of(self._marks, loop.RUN_STATISTICS)

    def reset(self) -> None:
        """Begin with eight other runs."""
        for lanes, initial in self._fresh:
            lanes[:] = initial

    def add(self, first: int, rows: Sequence[Array], raw: Array | None = None) -> None:
        """Add the rows (steps, count, ..) of q, nu, u, .. from step `first` on, also as `raw`."""
        take = kernel("loop", "take", "the run statistics")
        take(self._words, raw, first, len(rows[0]))
        self._last = [each[-1] for each in rows[:3]]

    def outcome(self, done: int, stop: Array) -> dict[str, Array]:
        """Return the outcomes of the runs after so many steps; `stop` are indices into STOPS."""
        (q, nu, u), marks = self._last, self._marks

        def by_run(values: Any, *shape: int) -> Array:
            shape = shape or (len(values),)
            return np.moveaxis(np.reshape(values, (*shape, LANES)), -1, 0)

        settled = by_run(marks.outside) + 1.0
        late = (stop != 0.0)[:, None] | is_late(settled, done + 1)
        return Outcome(
            q=q,
            v=self._state.spread(nu),
            x=by_run(marks.law.x),
            u=u,
            largest_x=by_run(marks.largest_x),
            largest_u=by_run(marks.largest_u),
            errors=by_run(marks.sizes),
            largest=by_run(marks.largest),
            settle=np.where(late, np.inf, settled * self._dt),
            error_history=by_run(marks.errors, len(self._steps), len(KINDS)),
            input_history=by_run(marks.inputs, len(self._steps), u.shape[1]),
            stop=stop,
            end=np.full(LANES, done * self._dt),
        )._asdict()
