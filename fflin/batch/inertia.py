"""M^-1 at many configurations: by the compiled kernel where it pays, else one after the other."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fflin.base.errors import SingularInertiaError
from fflin.base.validation import Array
from fflin.dynamics.inertia import Inertia
from fflin.dynamics.state import StateMap
from fflin.kernel.compiled import kernel
from fflin.kernel.tree import LANES, batch_tree
from fflin.robot.robot import Robot

# The kernel has sines of angles up to here [rad].
FARTHEST = 1e6

Rows: TypeAlias = NDArray[np.integer[Any]]


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
        kernel("factor", "invert")(self._tree, q, out.reshape(len(q), -1), couplings, space)
        # Written so that NaN, from a pivot that is zero, is among them.
        good = (self._inertia.least_coupling < couplings) & (couplings < Inertia.warning_coupling)
        if not -FARTHEST < q.min() <= q.max() < FARTHEST:
            good &= (np.abs(q[:, 7:]) < FARTHEST).all(axis=1)
        return np.flatnonzero(~good)

    def loop(self, q: Array, out: Array, rows: Rows) -> None:
        """Do the rows that are named, one after the other; raises as `invert` does."""
        for row in rows.tolist():
            try:
                self._inertia.invert(q[row], out[row])
            except SingularInertiaError as error:
                raise SingularInertiaError(f"configuration {row}: {error}") from None
