"""What is kept of a run while it goes on: where it ends, its worst, and since when it is settled.

Its size does not depend on how long the run is.
"""

from __future__ import annotations

from typing import NamedTuple

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
    """How a run ended, a row of each array of a campaign."""

    q: Array  # (nq,), at last
    v: Array  # (nv,)
    x: Array  # (nx,)
    u: Array  # (nu,)
    largest_x: Array  # (nx,), largest errors
    largest_u: Array  # (nu,), largest inputs
    errors: Array  # (kinds,), at last
    largest: Array  # (kinds,)
    settle: Array  # (kinds,) [s], since when settled; infinite where it is not
    stop: float  # which of STOPS
    end: float  # [s]
    said: str  # why it was stopped, if it was


class Tally:
    """The worst of some runs that go on together, up to now."""

    def __init__(self, plan: Plan, state: StateMap, home: Array, count: int) -> None:
        self._plan, self._state, self._home = plan, state, home
        g, wheels = state.groups, state.robot.wheels
        joints = [i for i, joint in enumerate(state.robot.joint_names) if joint not in wheels]
        self._spun = [i for i in range(g.q_m.start, g.q_m.stop) if i - g.q_m.start not in joints]
        self._parts = [
            np.arange(state.nx)[part]
            for part in (g.r_b, g.q_m.start + np.array(joints, dtype=int), g.omega_b, g.v_b)
        ]
        self._parts.append(g.qdot_m.start + np.array(joints, dtype=int))
        self._circling = 6 + state.unbounded
        self.largest_x = np.zeros((count, state.nx))
        self.largest_u = np.zeros((count, len(plan.initial)))
        self.largest = np.zeros((count, len(KINDS)))
        self.outside = np.full((count, len(KINDS)), -1)

    def copy(self) -> Tally:
        """Return one that goes its own way from here on."""
        other = object.__new__(Tally)
        other.__dict__ |= {
            key: value.copy() if key in ("largest_x", "largest_u", "largest", "outside") else value
            for key, value in vars(self).items()
        }
        return other

    def add(self, first: int, q: Array, nu: Array, u: Array) -> Tally:
        """Take rows (steps, count, ..) from a step on into account."""
        e, sizes = self._errors(first, *(np.ascontiguousarray(each) for each in (q, nu)))
        np.maximum(self.largest_x, np.abs(e).max(axis=0), out=self.largest_x)
        np.maximum(self.largest_u, np.abs(u).max(axis=0), out=self.largest_u)
        largest = np.maximum.accumulate(np.concatenate((self.largest[None], sizes)))[1:]
        self.largest[:] = largest[-1]
        # Where an error has its largest so far it is outside; so what was outside last stays it
        # when a larger one comes.
        outside = sizes > np.maximum(SETTLED * largest, THERE)
        last = first + len(sizes) - 1 - outside[::-1].argmax(axis=0)
        self.outside = np.where(outside.any(axis=0), last, self.outside)
        return self

    def outcome(self, lane: int, done: int, said: str, q: Array, nu: Array, u: Array) -> Outcome:
        """Return how one of the runs ended after so many steps, with its last values."""
        times = self._plan.times
        _, sizes = self._errors(done, q[None, None], nu[None, None])
        stop = next((k for k, word in enumerate(STOPS) if word and said.startswith(word)), 3)
        settled = self.outside[lane] + 1
        late = bool(said) | (settled > (1.0 - DWELL) * (done + 1))
        return Outcome(
            q.copy(),
            self._state.spread(nu),
            self._read(q[None], nu[None])[0],
            u.copy(),
            self.largest_x[lane].copy(),
            self.largest_u[lane].copy(),
            sizes[0, 0],
            self.largest[lane].copy(),
            np.where(late, np.inf, settled * times.dt),
            float(stop if said else 0),
            done * times.dt,
            said,
        )

    def _read(self, q: Array, nu: Array) -> Array:
        """Return states, joints that go round on the turn that is nearest."""
        x, to = states_of(self._state, q, nu), self._home
        at = self._circling
        x[:, at] -= 2.0 * np.pi * np.round((x[:, at] - to[at]) / (2.0 * np.pi))
        return x

    def _errors(self, first: int, q: Array, nu: Array) -> tuple[Array, Array]:
        """Return the errors of the states, and how large each kind is."""
        steps, count = q.shape[:2]
        x = self._read(q.reshape(-1, q.shape[-1]), nu.reshape(-1, nu.shape[-1]))
        to: Array = self._home
        e: Array = x - to
        if self._plan.reference is not None:
            to = np.repeat(self._targets(first, steps), count, axis=0)
            e, at = moving_errors(self._state.frame, x, to), self._circling
            e[:, at] -= 2.0 * np.pi * np.round(e[:, at] / (2.0 * np.pi))
        e[:, self._spun] = 0.0
        sizes = np.empty((len(e), len(KINDS)))
        sizes[:, 0] = attitude_errors(x, to)
        absolute = np.abs(e)
        for kind, part in enumerate(self._parts, 1):
            sizes[:, kind] = absolute[:, part].max(axis=1, initial=0.0)
        return e.reshape(steps, count, -1), sizes.reshape(steps, count, -1)

    def _targets(self, first: int, steps: int) -> Array:
        """Return the states (steps, nx) of the motion that is followed."""
        assert self._plan.reference is not None
        t = (first + np.arange(steps)) * self._plan.times.dt
        q, v, _ = map(np.array, zip(*map(self._plan.reference, t.tolist()), strict=True))
        return states_of(self._state, q, self._state.velocities(v))
