"""M^-1 at many configurations: by the compiled kernel where it pays, else one after the other."""

from __future__ import annotations

import logging
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.batch_tree import LANES, batch_tree
from fflin.errors import SingularInertiaError
from fflin.inertia import Inertia
from fflin.model import Robot
from fflin.state import StateMap
from fflin.validation import Array

if TYPE_CHECKING:
    from collections.abc import Callable

# The kernel beats the loop from here on; where numba is not loaded yet, that takes as long as the
# loop over some thousands of configurations.
_BREAK_EVEN, _BREAK_EVEN_UNLOADED = 16, 2000

# What a thread takes at a time, and how much of it is in the cache.
_BLOCK, _TILE = 2048, 256

_log = logging.getLogger("fflin")


class BatchInertia:
    """M^-1 at rest, of one robot at many configurations.

    Parameters
    ----------
    robot : Robot
    compiled : bool, optional
        Whether to take the compiled kernel; by default where numba is installed and it pays.
    """

    def __init__(self, robot: Robot, *, compiled: bool | None = None) -> None:
        self._robot = robot
        self._state = StateMap(robot)
        self._inertia = Inertia(self._state, robot.create_data())
        self._compiled = compiled
        self._tree = batch_tree(robot) if compiled or _has_numba() else None

    def invert(self, q: Array, out: Array, *, threads: int = 1) -> None:
        """Write M^-1 (6 + n, 6 + n) in base axes at each of the configurations.

        Parameters
        ----------
        q : ndarray (N, nq)
            Valid configurations.
        out : ndarray (N, 6 + n, 6 + n)
            C-contiguous.
        threads : int
            How many the kernel may take.

        Raises
        ------
        SingularInertiaError
            If a joint moves no mass; names the first such row.
        """
        self.loop(q, out, self.compiled(q, out, threads))

    def compiled(self, q: Array, out: Array, threads: int = 1) -> Array:
        """Do with the kernel what it can and return the rows that are left, all where it is not.

        Left are those where M is singular or nearly so, which the loop refuses or warns of.
        """
        if not self._is_compiled(len(q)):
            return np.arange(len(q))
        couplings = np.empty(len(q))
        kernel = _kernel()
        blocks = [slice(at, at + _BLOCK) for at in range(0, len(q), _BLOCK)]
        flat = out.reshape(len(q), -1)

        def work(block: slice) -> None:
            self._run(kernel, q[block], flat[block], couplings[block])

        if threads > 1 and len(blocks) > 1:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(work, blocks))
        else:
            list(map(work, blocks))
        # Written so that NaN, from a pivot that is zero, is among them.
        good = (self._inertia.least_coupling < couplings) & (couplings < Inertia.warning_coupling)
        return np.flatnonzero(~good)

    def loop(self, q: Array, out: Array, rows: Array) -> None:
        """Do the rows that are named, one after the other; raises as `invert` does."""
        for row in rows.tolist():
            try:
                self._inertia.invert(q[row], out[row])
            except SingularInertiaError as error:
                raise SingularInertiaError(f"configuration {row}: {error}") from None

    def _is_compiled(self, count: int) -> bool:
        if self._tree is None:
            return False
        if self._compiled is not None:
            return self._compiled
        return count >= (_BREAK_EVEN if "numba" in sys.modules else _BREAK_EVEN_UNLOADED)

    def _run(self, kernel: Callable[..., None], q: Array, out: Array, couplings: Array) -> None:
        assert self._tree is not None
        tree, motion = self._tree
        work = np.empty(tree.size + LANES)
        # The kernel's vectors are 64 bytes; where they begin at such an address it is faster.
        work = work[-(work.ctypes.data // 8) % LANES :]
        for start in range(0, len(q), _TILE):
            tile = slice(start, min(start + _TILE, len(q)))
            count = tile.stop - start
            moved = motion.of(q[tile])
            sums = np.empty(count + -count % LANES)
            if -count % LANES:
                moved = np.pad(moved, ((0, 0), (0, 0), (0, -count % LANES)), mode="edge")
            kernel(tree, moved, out[tile], sums, work)
            couplings[tile] = sums[:count]


def available_threads() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _has_numba() -> bool:
    return "numba" in sys.modules or find_spec("numba") is not None


def _kernel() -> Any:
    """Return the kernel, compiled at the first call ever and kept on disk."""
    from fflin import batch_kernel

    kernel = batch_kernel.invert
    if not kernel.signatures:
        folder = Path(kernel.stats.cache_path)
        source = Path(batch_kernel.__file__).stat().st_mtime
        kept = [entry.stat().st_mtime for entry in folder.glob("batch_kernel.invert-*.nbi")]
        if not any(time > source for time in kept):
            _log.warning("fflin: compiling the batch kernel, once; it is kept in %s", folder)
    return kernel
