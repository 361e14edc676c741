"""Run statistics, updated while a run goes on: final and largest errors, and settling time.

Its size does not depend on how long the run is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from fflin.base.validation import Array
from fflin.dynamics.state import StateMap
from fflin.dynamics.state_rows import attitude_errors, moving_errors, states_of
from fflin.simulation.plan import Plan
from fflin.simulation.report import DWELL, SETTLED, THERE

# Errors of each kind, largest of their entries, with their units; wheels are no joints.
KINDS = {
    "attitude": "deg",
    "position": "m",
    "joints": "rad|m",
    "turning": "rad/s",
    "moving": "m/s",
    "rates": "rad/s|m/s",
}
STOPS = ("", "diverged", "left the chart", "stopped")


class Outcome(NamedTuple):
    """Outcomes of runs, one row of each array per run."""

    q: Array  # (N, nq), at last
    v: Array  # (N, nv)
    x: Array  # (N, nx)
    u: Array  # (N, nu)
    largest_x: Array  # (N, nx), errors
    largest_u: Array  # (N, nu)
    errors: Array  # (N, kinds), at last
    largest: Array  # (N, kinds)
    settle: Array  # (N, kinds) [s], since when settled; infinite where it is not
    error_history: Array  # (N, times, kinds), infinite where a run was stopped before
    input_history: Array  # (N, times, nu), zero there
    stop: Array  # (N,), which of STOPS
    end: Array  # (N,) [s]


def stop_of(said: str) -> int:
    """Return which of the STOPS a sentence tells of."""
    found = (at for at, word in enumerate(STOPS) if word and said.startswith(word))
    return next(found, len(STOPS) - 1) if said else 0


class Tally:
    """The worst of some runs up to now, of errors from `home` (nx,) or (steps + 1, nx)."""

    span = 2**20  # steps between looks at what is over

    def __init__(self, plan: Plan, state: StateMap, home: Array, count: int, steps: Array) -> None:
        self._plan, self._state, self._homes = plan, state, home
        self._home = home if home.ndim == 1 else home[0]
        g, wheels = state.groups, state.robot.wheels
        joints = [i for i, joint in enumerate(state.robot.joint_names) if joint not in wheels]
        self._spun = [i for i in range(g.q_m.start, g.q_m.stop) if i - g.q_m.start not in joints]
        self._parts = [
            np.arange(state.nx)[part]
            for part in (g.r_b, g.q_m.start + np.array(joints, dtype=int), g.omega_b, g.v_b)
        ]
        self._parts.append(g.qdot_m.start + np.array(joints, dtype=int))
        self._circling = 6 + state.unbounded
        self.over = np.zeros(count, dtype=bool)  # none ends before its time
        self.largest_x: Array = np.zeros((count, state.nx))
        self.largest_u: Array = np.zeros((count, len(plan.initial)))
        self.largest: Array = np.zeros((count, len(KINDS)))
        self.outside: Array = np.full((count, len(KINDS)), -1)
        self.steps = steps
        self.error_history: Array = np.full((count, len(steps), len(KINDS)), np.inf)
        self.input_history: Array = np.zeros((count, len(steps), len(plan.initial)))

    def add(self, first: int, rows: Sequence[Array], _: Any = None) -> Tally:
        """Take rows (steps, count, ..) of q, nu and u from a step on into account."""
        q, nu, u = map(np.ascontiguousarray, rows)
        x, e, sizes = self._errors(first, q, nu)
        self._last = q[-1], nu[-1], u[-1], x[-1], sizes[-1]
        np.maximum(self.largest_x, np.abs(e).max(axis=0), out=self.largest_x)
        np.maximum(self.largest_u, np.abs(u).max(axis=0), out=self.largest_u)
        kept = slice(*np.searchsorted(self.steps, (first, first + len(sizes))))
        for history, each in ((self.error_history, sizes), (self.input_history, u)):
            history[:, kept] = each[self.steps[kept] - first].swapaxes(0, 1)
        largest = np.maximum.accumulate(np.concatenate((self.largest[None], sizes)))[1:]
        self.largest[:] = largest[-1]
        # Where an error has its largest so far it is outside; so what was outside last stays it
        # when a larger one comes.
        outside = sizes > np.maximum(SETTLED * largest, THERE)
        last = first + len(sizes) - 1 - outside[::-1].argmax(axis=0)
        self.outside = np.where(outside.any(axis=0), last, self.outside)
        return self

    def outcome(self, done: int, stop: Array) -> Outcome:
        """Return how the runs ended in the last row after so many steps, by which of STOPS."""
        times, (q, nu, u, x, sizes) = self._plan.times, self._last
        settled = self.outside + 1
        late = (stop != 0.0)[:, None] | (settled > (1.0 - DWELL) * (done + 1))
        return Outcome(
            q,
            self._state.spread(nu),
            x,
            u,
            self.largest_x,
            self.largest_u,
            sizes,
            self.largest,
            np.where(late, np.inf, settled * times.dt),
            self.error_history,
            self.input_history,
            stop,
            np.full(len(stop), done * times.dt),
        )

    def _read(self, q: Array, nu: Array) -> Array:
        """Return states, joints that go round on the turn that is nearest."""
        x, to = states_of(self._state, q, nu), self._home
        at = self._circling
        x[:, at] -= 2.0 * np.pi * np.round((x[:, at] - to[at]) / (2.0 * np.pi))
        return x

    def _errors(self, first: int, q: Array, nu: Array) -> tuple[Array, ...]:
        """Return the states, their errors, and how large each kind is."""
        steps, count = q.shape[:2]
        x = self._read(q.reshape(-1, q.shape[-1]), nu.reshape(-1, nu.shape[-1]))
        to: Array = self._home
        e: Array = x - to
        if self._homes.ndim == 2:
            to = np.repeat(self._homes[first : first + steps], count, axis=0)
            e, at = moving_errors(self._state.frame, x, to), self._circling
            e[:, at] -= 2.0 * np.pi * np.round(e[:, at] / (2.0 * np.pi))
        e[:, self._spun] = 0.0
        sizes = np.empty((len(e), len(KINDS)))
        sizes[:, 0] = attitude_errors(x, to)
        absolute = np.abs(e)
        for kind, part in enumerate(self._parts, 1):
            sizes[:, kind] = absolute[:, part].max(axis=1, initial=0.0)
        return tuple(each.reshape(steps, count, -1) for each in (x, e, sizes))
