"""Statistics of a run: final and largest errors, settling times, and histories at a few times.

Their size does not depend on the duration of the run.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from fflin.base.rotation import conjugate, quaternion_product
from fflin.base.validation import Array, Indices, Mask
from fflin.dynamics.coordinates import attitude_errors, moving_errors, states_of, unwound
from fflin.dynamics.state import StateMap
from fflin.kernel import loop
from fflin.kernel.compiled import kernel
from fflin.kernel.tree import LANES, empty, laid_out, words_of
from fflin.simulation.lanes import Statistics, no_law
from fflin.simulation.plan import Plan
from fflin.simulation.report import SETTLED, THERE, is_late, settled_at
from fflin.simulation.run import Recording, stop_of

# Kinds of errors with their units. The error of a kind is its largest entry; wheels and modes do
# not count as joints.
KINDS = {
    "attitude": "deg",
    "position": "m",
    "joints": "rad|m",
    "omega_b": "rad/s",
    "v_b": "m/s",
    "joint rates": "rad/s|m/s",
}
# Attitude error [deg] at which a run is close to the end of the chart.
EDGE = 176.0
# LOOK is the number of steps between checks of a stop condition. _LONG is the number of steps per
# call without a stop condition.
LOOK, _LONG = 64, 2**20

# Function of the state errors (N, nx) at the start and now; returns the mask (N,) of ended runs.
Over: TypeAlias = Callable[[Array, Array], Mask]

# Former names of kinds, which conditions and goals still accept.
_FORMER = {"turning": "omega_b", "moving": "v_b", "rates": "joint rates"}


def kind_named(name: str) -> str:
    """Replace a former name of a kind of error, as in ``worst turning``, by its present name."""
    of, _, kind = name.rpartition(" ")
    kind = _FORMER.get(kind, kind) if of in ("", "worst", "settle") else kind
    return f"{of} {kind}".strip()


class Judge(NamedTuple):
    """Evaluation of runs, whose results replace the record of a campaign; it is sent to workers."""

    fields: tuple[str, ...]  # names of the results
    # Return the results (N,) from the runs' outcomes; the first history entry is the start.
    figures: Callable[[Mapping[str, Array]], dict[str, Array]]
    over: Over | None = None  # condition that ends a run early


def kinds_of(state: StateMap) -> Indices:
    """Return the index into KINDS of each state (nx,).

    The index is 0 for the attitude and for states without a kind, such as modes. The index is -1
    for wheels.
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


def errors_of(state: StateMap, target: Array, q: Array, v: Array) -> tuple[Array, Array]:
    """Return the states (N, nx) of q and v, and their errors from the target (nx,) or (N, nx)."""
    moving = target.ndim == 2
    near = target[0] if moving else target
    x = unwound(state, states_of(state, q, state.velocities(v)), near)
    e = unwound(state, moving_errors(state.frame, x, target)) if moving else x - target
    return x, e


def outcome_of(plan: Plan, target: Array, steps: Array, run: Recording) -> dict[str, Array]:
    """Return a run's outcome from its recorded steps: a row of each array of `Campaign`.

    The outcome also has the state errors at the times of the histories.

    Errors are relative to the state `target` (nx,), or to a moving state (steps + 1, nx). Histories
    have entries at `steps`.
    """
    count, state = len(run.q), plan.plant.state
    kind, target = kinds_of(state), target[:count] if target.ndim == 2 else target
    x, signed = errors_of(state, target, run.q, run.v)
    e, u = np.where(kind < 0, 0.0, np.abs(signed)), np.abs(run.u)
    others = [e[:, kind == of].max(axis=1, initial=0.0) for of in range(1, len(KINDS))]
    sizes = np.column_stack([attitude_errors(x, target), *others])
    settled, stop = settled_at(sizes), stop_of(run.stopped)
    late, kept = is_late(settled, count) | (stop > 0), steps[steps < count]

    def history(values: Array, after: float) -> Array:
        found = np.full((len(steps), values.shape[1]), after)
        found[: len(kept)] = values[kept]
        return found

    return dict(
        q=run.q[-1],
        v=run.v[-1],
        x=x[-1],
        u=run.u[-1],
        largest_x=e.max(axis=0),
        largest_u=u.max(axis=0),
        errors=sizes[-1],
        largest=sizes.max(axis=0),
        settle=np.where(late, np.inf, settled * plan.times.dt),
        error_history=history(sizes, np.inf),
        input_history=history(run.u, 0.0),
        stop=np.array(float(stop)),
        end=np.array(run.steps * plan.times.dt),
        state_errors=history(signed, np.nan),
    )


class RunStatistics(Statistics):
    """Statistics of eight parallel runs in compiled code.

    Errors are relative to the state `target` (nx,), or to a moving state (steps + 1, nx) whose q
    and nu are the arrays of `path`. Histories have entries at `steps`.
    """

    span = LOOK

    def __init__(
        self,
        plan: Plan,
        target: Array,
        steps: Array,
        path: Sequence[Array],
        over: Over | None = None,
    ) -> None:
        self._dt, self._state, self._over = plan.times.dt, (state := plan.plant.state), over
        self._target, self._steps = target, steps
        if over is None:
            self.span = _LONG
        robot, kinds, nu = state.robot, len(KINDS), len(plan.initial)
        first = target if target.ndim == 1 else target[0]
        x, y, z = first[:3].tolist()
        attitude = np.array((x, y, z, math.sqrt(max(0.0, 1.0 - x * x - y * y - z * z))))
        law, marks = no_law(state, plan.initial), empty(loop.RUN_STATISTICS)
        law.path.point.q[3:7] = quaternion_product(conjugate(state.origin_quaternion), attitude)
        q_ref, nu_ref = path or (np.zeros(0), np.zeros(0))
        marks = marks._replace(
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
            states=np.full(len(steps) * state.nx, np.nan),
        )
        self._fresh: list[tuple[Array, Array]] = []
        self._marks = laid_out(marks, loop.RUN_STATISTICS, lambda *pair: self._fresh.append(pair))
        self._words = words_of(self._marks, loop.RUN_STATISTICS)

    def reset(self) -> None:
        """Prepare for eight new runs."""
        for lanes, initial in self._fresh:
            lanes[:] = initial

    def over(self, q: Array, v: Array) -> Mask:
        """Return the mask (LANES,) of the runs that end early at these q and v (LANES, ..)."""
        if self._over is None:
            return np.zeros(LANES, dtype=bool)
        first = _by_run(self._marks.states[: self._state.nx])
        return self._over(first, errors_of(self._state, self._target, q, v)[1])

    def add(self, first: int, rows: Array) -> None:
        """Add rows (steps, width, LANES) of q, nu, u, .. from step `first` on."""
        take = kernel("loop", "take", "the run statistics")
        take(self._words, rows.reshape(-1, LANES), first, len(rows))
        sizes = map(len, (self._marks.at.q, self._marks.at.nu, self._marks.largest_u))
        self._last = np.split(rows[-1].T, np.cumsum(list(sizes)), axis=1)[:3]

    def outcome(self, done: int, stop: Array) -> dict[str, Array]:
        """Return the outcomes of the runs after `done` steps; `stop` has indices into STOPS."""
        (q, nu, u), marks, times = self._last, self._marks, len(self._steps)
        settled = _by_run(marks.outside) + 1.0
        late = (stop != 0.0)[:, None] | is_late(settled, done + 1)
        return dict(
            q=q,
            v=self._state.spread(nu),
            x=_by_run(marks.law.x),
            u=u,
            largest_x=_by_run(marks.largest_x),
            largest_u=_by_run(marks.largest_u),
            errors=_by_run(marks.sizes),
            largest=_by_run(marks.largest),
            settle=np.where(late, np.inf, settled * self._dt),
            error_history=_by_run(marks.errors, times, len(KINDS)),
            input_history=_by_run(marks.inputs, times, u.shape[1]),
            stop=stop,
            end=np.full(LANES, done * self._dt),
            state_errors=_by_run(marks.states, times, self._state.nx),
        )


def _by_run(values: Array, *shape: int) -> Array:
    """Convert values (.., LANES) with one lane per run to rows (LANES, *shape)."""
    shape = shape or (len(values),)
    return np.moveaxis(np.reshape(values, (*shape, LANES)), -1, 0)
