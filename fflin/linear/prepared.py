"""Data that are the same for all points: prepared once, used by `Linearizer` and by sweeps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.frozen import frozen
from fflin.base.validation import Array, truth
from fflin.base.version import __version__
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.names import refuse_orbit, unknown_frame
from fflin.dynamics.orbital import mean_motion
from fflin.dynamics.state import Frame, StateMap
from fflin.kernel.compiled import numba_is_there
from fflin.linear.certificate import certify, inertia_matrix
from fflin.linear.ignorable import ignorable_states
from fflin.linear.state_equations import at_rest
from fflin.robot.frames import ROOT
from fflin.robot.limits import magnitudes_of
from fflin.robot.massless import require_inertia
from fflin.robot.outputs import FullState
from fflin.robot.robot import Robot

# A model whose squares add up to more counts as not finite, since its eigenvalues would overflow.
LARGEST = 1e200

if TYPE_CHECKING:
    from fflin.dynamics.outputs import Sensing
    from fflin.kernel.accelerations import RowRates


@dataclass(frozen=True, eq=False)
class Prepared:
    """Data that are the same for all points of linearisation of a robot; arrays are read-only."""

    robot: Robot
    map: StateMap
    actuation: Actuation
    sensing: Sensing | None  # None where the outputs are the state
    moving: bool
    own_reference: bool  # the base's own placement at each point, not that of `map`
    reference: Array  # (7,) the placement of `map`: position [m] and quaternion x, y, z, w
    free: bool  # whether at rest all of a model but M^-1 is in `common` and `rest`
    common: Mapping[str, Any]  # fields of a model that are the same about all points
    rest: Mapping[str, Array]  # its A, f0, u0 and v where nothing moves, pulls or pushes

    @cached_property
    def fields(self) -> dict[str, Any]:
        """Fields of a model at rest except B and q; some take as long to make as the dynamics."""
        at_rest = partial(_state_at_rest, self.map)
        asked = {"x0": at_rest, "y0": at_rest, "_reference": partial(own_reference, self.robot)}
        other = {} if self.own_reference else {"_reference": self.reference}
        return {**self.common, **self.rest, "_when_asked": asked, **other}

    def kernel(self) -> RowRates:
        """Return the compiled accelerations; `InputError` if the robot has none."""
        from fflin.kernel.accelerations import RowRates
        from fflin.kernel.tree import batch_tree

        tree, reason = batch_tree(self.robot), self.not_compilable
        if tree is None or reason:
            raise InputError(f"engine='compiled' cannot run this: {reason}; leave it out")
        return RowRates(self.map, self.actuation, tree)

    @property
    def not_compilable(self) -> str:
        """Reason why the robot has no compiled accelerations; empty if it has."""
        from fflin.kernel.tree import batch_tree

        name = self.robot.name
        if not numba_is_there():
            return "numba is not installed (pip install 'fflin[fast]')"
        if self.robot.orbit:
            return f"'{name}' is in orbit"
        return "" if batch_tree(self.robot) else f"a joint of '{name}' has an unsupported type"


def prepare(
    robot: Robot, *, frame: Frame | None, reference: pin.SE3 | None, moving: bool
) -> Prepared:
    """Prepare a robot; arguments and errors are as in `Linearizer`."""
    moving = truth("moving", moving)
    if moving:
        refuse_orbit(robot, "models with moving=True")
    if frame is None:
        frame = "local" if moving else None
    elif not isinstance(frame, str):  # nor one whose comparison below is an array
        raise unknown_frame(frame)
    if moving and (reference is not None or frame != "local"):
        raise InputError(
            "moving=True gives the error in the moving base's own axes, but a reference or a frame "
            "other than 'local' is given; leave both out"
        )
    state = StateMap(robot, reference=reference, frame=frame)
    own = reference is None and robot.orbit is None  # in orbit it is the orbit's frame
    require_inertia(robot)
    actuation = Actuation(state)
    sensing = None
    if robot.outputs != (FullState(),):
        from fflin.dynamics.outputs import Sensing

        sensing = Sensing(state, robot.outputs, own_reference=own)
    acts = (
        robot.orbit
        or any(robot.gravity)
        or robot.stored_momentum
        or any(x.any() for x in robot.springs)
    )
    nu = len(actuation.names)
    seen = sensing or state
    return Prepared(
        robot=robot,
        map=state,
        actuation=actuation,
        sensing=sensing,
        moving=moving,
        own_reference=own,
        reference=frozen(pin.SE3ToXYZQUAT(state.reference)),
        free=sensing is None and not moving and not acts,
        common={
            "C": frozen(np.eye(state.nx)),
            "D": frozen(np.zeros((state.nx, nu))),
            "dt": 0.0,
            "state_names": state.names,
            "input_names": actuation.names,
            "output_names": seen.names,
            "state_units": state.units,
            "input_units": actuation.units,
            "output_units": seen.units,
            "frame": state.frame,
            "moving": moving,
            "robot": robot.name,
            "urdf_sha256": robot.urdf_sha256,
            "locked": robot.locked,
            "fflin_version": __version__,
            "pinocchio_version": pin.__version__,
            "_inertia": partial(inertia_matrix, robot),
            "_certify": partial(certify, robot),
            "_ignorable": partial(ignorable_states, robot),
            "_limits": partial(magnitudes_of, robot),
            "weights": robot.weights,
            "mean_motion": mean_motion(robot),
            "_robot": robot,
        },
        rest={
            "A": frozen(at_rest(state)),
            "f0": frozen(np.zeros(state.nx)),
            "u0": frozen(np.zeros(nu)),
            "v": frozen(np.zeros(robot.nv)),
        },
    )


def _state_at_rest(state: StateMap, q: Array) -> Array:
    x0: Array = np.zeros(state.nx)
    x0[state.groups.q_m] = state.joint_positions(q)
    return frozen(x0)


def own_reference(robot: Robot, q: Array) -> Array:
    """Return the base placement (7,) at a configuration, the default reference of a model."""
    root = robot.model.jointPlacements[ROOT]
    if root.isIdentity(0.0):
        return q[:7]
    return frozen(pin.SE3ToXYZQUAT(root * pin.XYZQUATToSE3(q[:7])))
