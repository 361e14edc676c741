"""M^-1 at many configurations: by the compiled kernel where it pays, else one after the other."""

from __future__ import annotations

import logging
import os
import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fflin.batch_tree import LANES, batch_tree
from fflin.errors import SingularInertiaError
from fflin.inertia import Inertia
from fflin.model import Robot
from fflin.state import StateMap
from fflin.validation import Array

# The kernel beats the loop from here on; where numba is not loaded yet, that takes as long as the
# loop over some thousands of configurations.
_BREAK_EVEN, _BREAK_EVEN_UNLOADED = 16, 2000

# The kernel has sines of angles up to here [rad].
_FARTHEST = 1e6

Rows: TypeAlias = NDArray[np.integer[Any]]

_log = logging.getLogger("fflin")


class BatchInertia:
    """M^-1 at rest, of one robot at many configurations.

    Parameters
    ----------
    robot : Robot
    compiled : bool
        Whether to take the compiled kernel, where the robot's joints allow it; see `pays`.
    """

    def __init__(self, robot: Robot, *, compiled: bool) -> None:
        self._robot = robot
        self._state = StateMap(robot)
        self._inertia = Inertia(self._state, robot.create_data())
        self._tree = batch_tree(robot) if compiled else None

    def invert(self, q: Array, out: Array) -> None:
        """Write M^-1 (6 + n, 6 + n) in base axes at each of the configurations.

        Parameters
        ----------
        q : ndarray (N, nq)
            Valid configurations.
        out : ndarray (N, 6 + n, 6 + n)
            C-contiguous.

        Raises
        ------
        SingularInertiaError
            If a joint moves no mass; names the first such row.
        """
        self.loop(q, out, self.compiled(q, out))

    def compiled(self, q: Array, out: Array) -> Rows:
        """Do with the kernel what it can and return the rows that are left, all where it is not.

        Left are those where M is singular or nearly so, which the loop refuses or warns of, and
        those that are turned beyond all sense.
        """
        if self._tree is None:
            return np.arange(len(q))
        if len(q) < LANES:
            filled = np.pad(q, ((0, LANES - len(q)), (0, 0)), mode="edge")
            large: Array = np.empty((LANES, *out.shape[1:]))
            left = self.compiled(filled, large)
            out[:] = large[: len(q)]
            return left[left < len(q)]
        couplings = np.empty(len(q))
        space = np.empty(self._tree.size + LANES)
        # Its vectors are 64 bytes; where they begin at such an address it is faster.
        space = space[-(space.ctypes.data // 8) % LANES :]
        _kernel()(self._tree, q, out.reshape(len(q), -1), couplings, space)
        # Written so that NaN, from a pivot that is zero, is among them.
        good = (self._inertia.least_coupling < couplings) & (couplings < Inertia.warning_coupling)
        if not -_FARTHEST < q.min() <= q.max() < _FARTHEST:
            good &= (np.abs(q[:, 7:]) < _FARTHEST).all(axis=1)
        return np.flatnonzero(~good)

    def loop(self, q: Array, out: Array, rows: Rows) -> None:
        """Do the rows that are named, one after the other; raises as `invert` does."""
        for row in rows.tolist():
            try:
                self._inertia.invert(q[row], out[row])
            except SingularInertiaError as error:
                raise SingularInertiaError(f"configuration {row}: {error}") from None


def available_threads() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def pays(count: int) -> bool:
    """Whether the kernel is there and beats the loop over so many points."""
    if "numba" in sys.modules:
        return count >= _BREAK_EVEN
    return count >= _BREAK_EVEN_UNLOADED and find_spec("numba") is not None


# Threads that begin at the same time tell it once.
_TURN = Lock()


def _kernel() -> Any:
    """Return the kernel, compiled at the first call ever and kept on disk."""
    from fflin import batch_kernel

    with _TURN:
        _tell()
    return batch_kernel.invert


@cache
def _tell() -> None:
    """Say that the kernel is going to be compiled where it is."""
    from fflin import batch_kernel

    kernel = batch_kernel.invert
    folder = Path(kernel.stats.cache_path)
    source = Path(batch_kernel.__file__).stat().st_mtime
    kept = [entry.stat().st_mtime for entry in folder.glob("batch_kernel.invert-*.nbi")]
    if not any(time > source for time in kept):
        _log.warning("fflin: compiling the batch kernel, once; it is kept in %s", folder)
