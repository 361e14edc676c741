"""What acts on a robot as the kernel reads it, its work space, and M^-1 at many points."""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from fflin.base.validation import Array
from fflin.dynamics.actuation import Actuation
from fflin.kernel.compiled import kernel
from fflin.kernel.tree import LANES, PIN_ANGULAR, PIN_LINEAR, Tree
from fflin.robot.frames import ROOT
from fflin.robot.robot import Robot


class Layout(namedtuple("Layout", "motion load bias c columns lower held size")):
    """Where the parts of the kernel's work space begin, beyond those of the tree; its size."""


class Loads(namedtuple("Loads", "body wrench input stored_body stored stiffness damping")):
    """Body, unit wrench at its joint and number of carried inputs; stored momenta; springs."""


def inverse_inertias(tree: Tree, q: Array, out: Array) -> Array:
    """Write M^-1 (N, 6 + n, 6 + n) at configurations (N, nq), N the number of lanes at least."""
    couplings = np.empty(len(q))
    flat = out.reshape(len(q), -1)
    spaces = work_space(q.shape[1]), work_space(tree.size)
    kernel("factor", "invert")(tree, writable(q), flat, couplings, *spaces)
    return couplings


def writable(rows: Array) -> Array:
    """Return rows that may be written, copied if need be: numba compiles for either kind."""
    return np.require(rows, np.float64, ("C", "W"))


def work_space(size: int) -> Array:
    """Return an array (size, LANES) with nothing in it yet."""
    space = np.empty((size + 1) * LANES)
    # The kernel's vectors are 64 bytes; where they begin at such an address it is faster.
    first = -(space.ctypes.data // 8) % LANES
    return space[first : first + size * LANES].reshape(size, LANES)


def loads_of(robot: Robot, actuation: Actuation, tree: Tree) -> Loads:
    """Return what acts on a robot."""
    body: list[int] = []
    inputs: list[int] = []
    wrenches: list[Array] = []
    for joint, numbers, columns in actuation.wrench_columns:
        turned = tree.axes[joint - ROOT].T
        for number, column in zip(numbers.tolist(), columns.T, strict=True):
            body.append(joint - ROOT)
            inputs.append(number)
            wrenches.append(
                np.concatenate((turned @ column[PIN_ANGULAR], turned @ column[PIN_LINEAR]))
            )
    stored = [(joint - ROOT, momentum) for joint, momentum in robot.stored_momentum]
    return Loads(
        np.array(body, dtype=np.intp),
        np.array(wrenches).ravel(),
        np.array(inputs, dtype=np.intp),
        np.array([index for index, _ in stored], dtype=np.intp),
        np.array([tree.axes[index].T @ h for index, h in stored]).ravel(),
        np.array(robot.springs.stiffness),
        np.array(robot.springs.damping),
    )


def layout_of(tree: Tree, carried: int) -> Layout:
    """Return the work space for a tree with so many inputs that are carried."""
    from fflin.kernel.rnea import LOAD, MOTION

    size, bodies = len(tree.row), len(tree.parent)
    sizes = (
        *(bodies * MOTION, bodies * LOAD, size, size, size * carried),
        *(size * 2 * size, size * 6),
    )
    return Layout(*(tree.size + int(x) for x in np.cumsum([0, *sizes])))
