"""Linear models about one point or many by the compiled kernel."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.chart import SMALLEST_Q0
from fflin.dynamics.inertia import LARGEST_SHARE, Inertia, bounds_of
from fflin.dynamics.rnea import Rates
from fflin.dynamics.state import StateMap
from fflin.kernel.accelerations import layout_of, loads_of, work_space, writable
from fflin.kernel.compiled import kernel
from fflin.kernel.tree import Tree
from fflin.robot.frames import ROOT


class PointKernel:
    """The kernel's equations of a robot whose state and inputs stand as `linear.Prepared` says."""

    def __init__(
        self,
        state: StateMap,
        actuation: Actuation,
        tree: Tree,
        largest: float,
        *,
        own: bool,
        moving: bool,
    ) -> None:
        from fflin.kernel.assembly import Equations, Places

        robot, nx, nu, fixed = state.robot, state.nx, len(actuation.names), actuation.fixed
        nv, loads = nx // 2, loads_of(state.robot, actuation, tree)
        layout = layout_of(tree, len(loads.input))
        sizes = nx * nx, nv * nu, nv * nu, nx, nx, nx + nu, 3
        places = Places(*(layout.size + int(at) for at in np.cumsum([0, *sizes])))
        joints, bounds = robot.joints, bounds_of(robot)
        self._robot = Equations(
            *(tree, layout, loads, places),
            state.velocities(np.arange(float(robot.nv))).astype(np.intp),
            np.array([joint.idx_q for joint in joints], dtype=np.intp),
            np.array([joint.unbounded for joint in joints], dtype=bool),
            np.array(robot.springs.rest),
            np.where(fixed.any(axis=0), np.abs(fixed).argmax(axis=0), -1).astype(np.intp),
            np.array([held.columns.start for held in actuation.held], dtype=np.intp),
            robot.model.jointPlacements[ROOT].rotation.T @ np.array(robot.gravity),
            pin.SE3ToXYZQUAT(state.origin),
            np.zeros(nv) if bounds is None else state.velocities(bounds),
            np.array([0.999 * nv, Inertia.warning_coupling, largest, SMALLEST_Q0, LARGEST_SHARE]),
            np.array(state.axes, dtype=np.intp),
            *(int(own), int(moving)),
        )
        self._sizes = robot.nq, robot.nv, nu, nv, nu, nv
        self._rest = np.zeros((nx, nx))
        self._rest[:nv, nv:] = np.diag([0.5] * 3 + [1.0] * (nv - 3))
        self._held: Any = None

    def many(self, q: Array, v: Array, u: Array, out: Iterable[Array]) -> Array:
        """Write A, lower B, f0 and x0 of as many points as there are lanes at least."""
        from fflin.kernel.assembly import Point

        judged, work = np.empty((len(q), 3)), work_space(self._robot.places.size)
        self._begin(work, self._rest.reshape(-1, 1))
        kernel("linearise", "linearise")(
            self._robot,
            tuple(writable(each) for each in (q, v, u)),
            (*(each.reshape(len(q), -1) for each in out), judged),
            Point(*map(work_space, self._sizes)),
            work,
        )
        return judged

    def one(self) -> Callable[..., bool]:
        """Return the function that writes the model about a point, as long as this is alive."""
        from fflin.kernel.assembly import Point
        from fflin.kernel.words import words_of

        function = kernel("linearise", "linearise_one", "the kernel of single points")
        work = np.zeros(self._robot.places.size)
        self._begin(work, self._rest.ravel())
        self._held = self._robot, Point(*map(np.zeros, self._sizes)), work
        return partial(function, words_of(self._held))

    def rates(self, gravity: Array) -> Rates:
        """Return the rates at the point that was done last, whose gravity in base axes is given."""
        robot, work = self._robot, self._held[-1]
        nv, nu = len(robot.order), len(robot.row)

        def part(at: int, *shape: int) -> Array:
            return work[at : at + math.prod(shape)].reshape(shape)

        lower = part(robot.layout.lower, nv, 2 * nv)
        return Rates(
            part(robot.layout.c, nv),
            lower[:, 6:nv],
            lower[:, nv:],
            part(robot.places.by_u, nv, nu),
            gravity,
            np.zeros((nv, 3)),
        )

    def _begin(self, work: Array, rest: Array) -> None:
        work[self._robot.places.A : self._robot.places.by_u] = rest
