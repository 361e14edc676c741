"""A circular orbit's frame: rates relative to it, and the field that is felt in it (14.1)."""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.names import ANGULAR, LINEAR, PIN_ANGULAR, PIN_LINEAR
from fflin.robot.frames import ROOT
from fflin.robot.robot import Robot

# Unit vectors away from the body, and along the orbit's normal, in each frame.
_AXES = {
    "hill": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "lvlh": ((0.0, 0.0, -1.0), (0.0, -1.0, 0.0)),
}


class OrbitField(NamedTuple):
    """What an orbit does to a robot whose world is the orbit's frame.

    The frame turns with `rate`; the field per mass at x is `tide` x.
    """

    robot: Robot
    frame: str
    rate: Array  # (3,) [rad/s]
    tide: Array  # (3, 3) [1/s^2]: n^2 (3 r r^T - E)

    @property
    def axes(self) -> Array:
        """Unit vectors (3, 3) away from the body, along the orbit and along its normal."""
        r, z = (np.array(axis) for axis in _AXES[self.frame])
        return np.column_stack((r, np.cross(z, r), z))

    @property
    def pull(self) -> Array:
        """The field (3, 3) that is felt at rest in the frame: n^2 (3 r r^T - z z^T) [1/s^2]."""
        return self.tide - skew(self.rate) @ skew(self.rate)

    def base(self, q: Array) -> tuple[Array, Array]:
        """Return attitude (3, 3) and place (3,) of the base."""
        base = self.robot.model.jointPlacements[ROOT] * pin.XYZQUATToSE3(q[:7])
        return base.rotation, base.translation

    def absolute(self, q: Array, v: Array) -> Array:
        """Return the velocity (nv,) in the frame that stands still of one relative to the orbit."""
        R, place = self.base(q)
        found = v.copy()
        found[PIN_LINEAR] += R.T @ np.cross(self.rate, place)
        found[PIN_ANGULAR] += R.T @ self.rate
        return found

    def relative(self, q: Array, v: Array, rate: Array) -> Array:
        """Return dv/dt (nv,) of a relative velocity where the absolute one changes by `rate`."""
        R, place = self.base(q)
        own, found = v[PIN_ANGULAR], rate.copy()
        spin, sweep = R.T @ self.rate, R.T @ np.cross(self.rate, place)
        found[PIN_LINEAR] += np.cross(own, sweep) - np.cross(spin, v[PIN_LINEAR])
        found[PIN_ANGULAR] += np.cross(own, spin)
        return found

    def wrenches(self, data: pin.Data) -> list[pin.Force]:
        """Return what pulls on each body, in its joint's frame; `data` says where joints are."""
        found = [pin.Force.Zero()]
        for inertia, place in zip(
            self.robot.model.inertias.tolist()[ROOT:], data.oMi.tolist()[ROOT:], strict=True
        ):
            R, lever = place.rotation, inertia.lever
            force = inertia.mass * (R.T @ (self.tide @ place.act(lever)))
            # 3 n^2 r x (I r) is the axial vector of I tide - tide I.
            turn = inertia.inertia @ (R.T @ self.tide @ R)
            torque = pin.unSkew(turn - turn.T)
            found.append(pin.Force(force, torque + np.cross(lever, force)))
        return found

    def slopes(self, data: pin.Data) -> Array:
        """Return the slopes (nv, nv) over q of the forces of `wrenches`, the base not shifted."""
        # Of a joint that turns by t, in its axes: those of R^T tide R are T [t]x - [t]x T.
        model = self.robot.model
        total = np.zeros((model.nv, model.nv))
        for joint in range(ROOT, model.njoints):
            inertia, place = model.inertias[joint], data.oMi[joint]
            lever, R = inertia.lever, place.rotation
            T, center = R.T @ self.tide @ R, R.T @ place.act(lever)
            jacobian = pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.LOCAL)
            moved = jacobian.copy()
            moved[:, PIN_LINEAR] = 0.0
            turned = moved[PIN_ANGULAR]
            shift = moved[PIN_LINEAR] + (skew(center) - skew(lever)) @ turned
            force = inertia.mass * (T @ shift + (skew(T @ center) - T @ skew(center)) @ turned)
            changes = [T @ skew(t) - skew(t) @ T for t in np.eye(3)]
            turns = [inertia.inertia @ change for change in changes]
            torque = np.column_stack([pin.unSkew(turn - turn.T) for turn in turns]) @ turned
            total += jacobian.T @ np.vstack((force, torque + skew(lever) @ force))
        return total

    def near(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return q and the absolute v of a base that is not displaced, which falls as any other."""
        q, v = q.copy(), self.absolute(q, v)
        q[:3] = v[PIN_LINEAR] = 0.0
        return q, v

    def add_turning(self, q: Array, v: Array, by_q: Array, by_v: Array) -> None:
        """Make slopes in state order at `near` those of the relative rates at q and v."""
        R, place = self.base(q)
        fall = R.T @ (self.pull @ place - self.tide @ self.base(np.r_[0.0, 0.0, 0.0, q[3:]])[1])
        spin, W, V = (skew(x) for x in (R.T @ self.rate, v[PIN_ANGULAR], v[PIN_LINEAR]))
        # Of dw/dt + w x spin, and of dv/dt = c + fall - 2 spin x v - w x v.
        by_q[:, ANGULAR] += by_v[:, ANGULAR] @ spin
        by_q[ANGULAR, ANGULAR] += W @ spin
        by_v[ANGULAR, ANGULAR] -= spin
        by_v[:, LINEAR] = 0.0
        by_q[LINEAR, ANGULAR] += skew(fall) + 2.0 * V @ spin
        by_q[LINEAR, LINEAR] += R.T @ self.pull @ R
        by_v[LINEAR, ANGULAR] += V
        by_v[LINEAR, LINEAR] -= 2.0 * spin + W

    def potential(self, data: pin.Data) -> float:
        """Return the energy (J) that the tide and the frame's turning have, after `wrenches`."""
        # -1/2 the integral of x^T G x, G = tide + n^2 (E - z z^T), over the masses.
        G, energy = self.pull, 0.0
        for inertia, place in zip(
            self.robot.model.inertias.tolist()[ROOT:], data.oMi.tolist()[ROOT:], strict=True
        ):
            R, center = place.rotation, place.act(inertia.lever)
            second = 0.5 * np.trace(inertia.inertia) * np.eye(3) - inertia.inertia
            energy -= 0.5 * (inertia.mass * center @ G @ center + np.sum(R.T @ G @ R * second))
        for joint, momentum in self.robot.stored_momentum:
            energy -= float(self.rate @ data.oMi[joint].rotation @ momentum)
        return energy


def field_of(robot: Robot, frame: str) -> OrbitField | None:
    """Return the field of a robot's orbit in a frame, if it has one."""
    if robot.orbit is None:
        return None
    n = float(robot.orbit.mean_motion or 0.0)
    r, z = (np.array(axis) for axis in _AXES[frame])
    return OrbitField(robot, frame, n * z, n * n * (3.0 * np.outer(r, r) - np.eye(3)))
