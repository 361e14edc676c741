"""Gravity-gradient force of an orbit and its derivatives, from three rotations by RNEA (14.4)."""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.names import PIN_ANGULAR
from fflin.dynamics.orbital import OrbitField, mean_motion

# What turns about the radial direction, the one along the orbit and the normal count.
_SHARES = (2.0, -1.0, -1.0)


class Tide(NamedTuple):
    """Gravity-gradient field of an orbit at one base pose, in base axes.

    A rotation about a unit vector s at unit rate gives a point at x the acceleration [s]x^2 x.
    Twice this term of the radial direction minus the terms of the other two directions, times n^2,
    is the field n^2 (3 r r^T - E) x.
    """

    turns: tuple[tuple[float, Array], ...]  # what each counts, and its (3,) unit vector
    spin: Array  # (3,) rate of the frame [rad/s]
    fall: Array  # (3,) what accelerates the base's origin, the frame's turning included [m/s^2]

    @classmethod
    def at(cls, field: OrbitField, q: Array) -> "Tide":
        """Return that at a configuration (nq,), which must be near to the orbit's point."""
        field.require_near(q)
        R, place = field.base(q)
        n = mean_motion(field.robot)
        turns = zip((share * n * n for share in _SHARES), (R.T @ field.axes).T, strict=True)
        return cls(tuple(turns), R.T @ field.rate, R.T @ (field.pull @ place))

    def force(self, model: pin.Model, data: pin.Data, q: Array) -> Array:
        """Return the generalised force (nv,) on the robot, less what falls with its origin."""
        total, v = np.zeros(model.nv), np.zeros(model.nv)
        for share, v[PIN_ANGULAR] in self.turns:
            total += share * pin.nonLinearEffects(model, data, q, v)
        return total

    def slopes(self, model: pin.Model, data: pin.Data, q: Array) -> tuple[Array, Array]:
        """Return the derivatives of `force` over the joints (nv, nv) and rotations (nv, 3)."""
        by_q, by_turn = np.zeros((model.nv, model.nv)), np.zeros((model.nv, 3))
        v, still = np.zeros(model.nv), np.zeros(model.nv)
        for share, v[PIN_ANGULAR] in self.turns:
            over_q, over_v, _ = pin.computeRNEADerivatives(model, data, q, v, still)
            by_q += share * over_q
            by_turn += share * over_v[:, PIN_ANGULAR] @ skew(v[PIN_ANGULAR])
        return by_q, by_turn
