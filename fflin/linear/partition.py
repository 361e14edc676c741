"""Independent coordinates along a motion of a robot with constraints, which change on the way."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fflin.base.errors import ConstraintError, InputError, listed
from fflin.base.validation import Array, Indices, Vector
from fflin.linear.constrained import Motions

# Coordinates change if they determine the motion worse than _DEGRADED times the best choice. They
# must not be worse than _WEAK at any knot of their part of the motion.
_DEGRADED, _WEAK = 0.3, 1e-3

# A time counts as the time of a change if it is less than this fraction of the duration before it.
_NEAR = 1e-9


class Partition(NamedTuple):
    """Parts of a motion, and the names of the states of the models in each part.

    A part begins at the time of a change. There are as many states in all parts.
    """

    times: Vector  # (S,) [s] times of the changes
    names: tuple[tuple[str, ...], ...]  # S + 1 groups of nx names

    @classmethod
    def of(
        cls, times: Vector, first: tuple[str, ...], later: tuple[str, ...]
    ) -> Partition:
        """Return the partition with the names of the first part and of all later parts."""
        nx = len(first)
        if len(later) != nx * len(times):
            raise InputError(
                f"switched_names has {len(later)} names, expected {nx} for each of the "
                f"{len(times)} times in switches"
            )
        groups = [later[k : k + nx] for k in range(0, len(later), nx)]
        return cls(times, (first, *groups))

    @property
    def later(self) -> tuple[str, ...]:
        """Names of the states of all parts but the first, one part after the other."""
        return tuple(name for group in self.names[1:] for name in group)

    def remarks(self) -> list[str]:
        """Return a line for each change of the coordinates."""
        half = len(self.names[0]) // 2
        return [
            f"from t = {t:g} s, the independent coordinates are {', '.join(names[:half])}"
            for t, names in zip(self.times.tolist(), self.names[1:], strict=True)
        ]

    def parts_at(self, times: Array, duration: float) -> Indices:
        """Return the index of the part at each of the times (k,) of a motion."""
        early = self.times - _NEAR * duration
        parts: Indices = early.searchsorted(times, "right")
        return parts


def partition_of(
    t: Vector, motions: Sequence[Motions], names: tuple[str, ...]
) -> Partition:
    """Return the parts of a motion with the knots t (N,), from the motions permitted at the knots.

    `names` are the names of all nx states. If coordinates stop determining the motion between two
    knots, and no others determine it there, raise `ConstraintError`.
    """
    starts = [0]
    choices = [motions[0].best()]
    last = len(motions) - 1
    for k, (before, at) in enumerate(pairwise(motions), start=1):
        present = choices[-1]
        best = at.best()
        valid = _valid(before, at, present)
        if valid and (at.least(present) >= _DEGRADED * at.least(best) or k == last):
            continue
        start = k
        if not valid:
            start = k - 1
            best = _valid_choice(before, at, present, t[k - 1 : k + 1], names)
        if start == starts[-1]:
            choices[-1] = best
        else:
            starts.append(start)
            choices.append(best)
    nv = len(names) // 2
    groups = [
        tuple(names[index] for index in (*picked, *(picked + nv))) for picked in choices
    ]
    return Partition(t[starts[1:]], tuple(groups))


def _valid(before: Motions, at: Motions, picked: Indices) -> bool:
    """Return whether coordinates determine the motion at two neighbouring knots and between."""
    if min(before.least(picked), at.least(picked)) < _WEAK:
        return False
    # At a point where the coordinates become dependent, their basis becomes infinite, and behind
    # the point it has the opposite orientation.
    bases = [x.rates @ np.linalg.inv(x.rates[picked]) for x in (before, at)]
    return bool(np.linalg.slogdet(bases[0].T @ bases[1])[0] > 0.0)


def _valid_choice(
    before: Motions, at: Motions, present: Indices, t: Array, names: tuple[str, ...]
) -> Indices:
    """Return coordinates that determine the motion between two knots at the times t (2,)."""
    for picked in (at.best(), before.best()):
        if _valid(before, at, picked):
            return picked
    raise ConstraintError(
        f"the coordinates {listed(names[index] for index in present)} do not determine the motion "
        f"between t = {t[0]:g} s and {t[1]:g} s, and no others do; give more knots there"
    )
