"""Configurations and velocities of a tree of joints, in Pinocchio's order."""

import math
from functools import cached_property

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, ModelError
from fflin.base.validation import DOUBLE, NORM_TOLERANCE, Array, vector
from fflin.robot.joints import Follower, Joint
from fflin.robot.model_checks import change_in

_CONFIGURATION = "a configuration in Pinocchio's order"

# What renormalising a unit quaternion leaves: two ulp of unity.
ROUND_OFF = 2.0 * float(np.finfo(float).eps)

# Data holds a third-order tensor of nv^3 entries among others: about 32 nv^3 bytes in all.
_DATA_BYTES_PER_NV3 = 32
_DATA_LIMIT = 2**30


class Coordinates:
    """Configuration q and velocity v of a robot, and checks of given values."""

    model: pin.Model
    name: str
    joints: tuple[Joint, ...]
    followers: tuple[Follower, ...]
    _as_made: tuple[pin.Model, pin.Model] | None

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the n independent joints, in state order."""
        return tuple(joint.name for joint in self.joints)

    @property
    def n(self) -> int:
        """Number of independent joints."""
        return len(self.joints)

    @cached_property
    def nq(self) -> int:
        """Size of Pinocchio's configuration vector q."""
        return int(self.model.nq)

    @cached_property
    def nv(self) -> int:
        """Size of Pinocchio's velocity vector v: 6 + n, plus one for each mimic joint."""
        return int(self.model.nv)

    @cached_property
    def unbounded(self) -> dict[int, str]:
        """Continuous joints: {index of the cosine in q: joint name}."""
        joints = (*self.joints, *(follower.joint for follower in self.followers))
        return {joint.idx_q: joint.name for joint in joints if joint.unbounded}

    def neutral(self) -> Array:
        """Return the neutral configuration (nq,), with mimic joints placed by their leaders."""
        q = pin.neutral(self.model)
        self.follow(q)
        return q

    def follow(self, q: Array) -> None:
        """Place the mimic joints of a configuration q (nq,) by their leaders, in place."""
        for follower in self.followers:
            follower.place(q)

    def checked_configuration(self, q: Array) -> Array:
        """Return a valid configuration q (nq,), corrected within 1e-6, or raise `InputError`."""
        if type(q) is not np.ndarray or q.dtype is not DOUBLE or q.shape != (self.nq,):
            q = vector("q", q, self.nq, _CONFIGURATION)
        entries = q.tolist()
        if not math.isfinite(sum(entries)):
            vector("q", q, self.nq, _CONFIGURATION)  # says which entry it is
        x, y, z, w = entries[3:7]
        worst = abs(x * x + y * y + z * z + w * w - 1.0)
        if worst > NORM_TOLERANCE:
            raise InputError(
                f"the base quaternion q[3:7] has length {np.linalg.norm(q[3:7]):.9g}, expected 1; "
                "normalise it (x, y, z, w)"
            )
        for index in self.unbounded:
            c, s = entries[index], entries[index + 1]
            excess = abs(c * c + s * s - 1.0)
            if excess > worst:
                worst = excess
                if excess > NORM_TOLERANCE:
                    raise InputError(
                        f"(cos, sin) of continuous joint '{self.unbounded[index]}', "
                        f"q[{index}:{index + 2}], has length {np.hypot(c, s):.9g}, expected 1; "
                        "normalise it"
                    )
        if worst > ROUND_OFF:
            q = pin.normalize(self.model, q)
        return self._followed(q) if self.followers else q

    def checked_velocity(self, v: Array) -> Array:
        """Return a valid velocity v (nv,), without modification, or raise `InputError`."""
        v = vector("v", v, self.nv, "a velocity in Pinocchio's order")
        for joint, leader, multiplier, _ in self.followers:
            expected = multiplier * v[leader.idx_v]
            if abs(v[joint.idx_v] - expected) > NORM_TOLERANCE * max(1.0, abs(expected)):
                raise InputError(
                    f"v[{joint.idx_v}] of joint '{joint.name}' is {v[joint.idx_v]:.9g}, but it "
                    f"mimics '{leader.name}', which requires {expected:.9g}"
                )
        return v

    def _followed(self, q: Array) -> Array:
        """Return a copy of q (nq,) with mimic joints corrected if they are within 1e-6."""
        placed = q.copy()
        self.follow(placed)
        for joint, leader, *_ in self.followers:
            part = slice(joint.idx_q, joint.idx_q + 1 + joint.unbounded)
            error = np.abs(placed[part] - q[part]).max()
            if error > NORM_TOLERANCE * max(1.0, np.abs(placed[part]).max()):
                raise InputError(
                    f"joint '{joint.name}' is at {joint.value(q):.9g}, but it mimics "
                    f"'{leader.name}', which puts it at {joint.value(placed):.9g}; "
                    "fflin.configuration places mimic joints"
                )
        return placed

    def require_unchanged(self) -> None:
        """Raise `ModelError` if the model was changed in place after the robot was made."""
        assert self._as_made is not None
        made = self._as_made[1]
        # Tells in a microsecond that nothing at all was changed.
        if self.model != made and (change := change_in(self.model, made)):
            raise ModelError(
                f"the model of '{self.name}' was changed after the robot was made: {change}; make "
                "a new robot from it with fflin.from_model(model)"
            )

    def create_data(self) -> pin.Data:
        """Return a new pin.Data for this robot, or raise `ModelError` if it exceeds 1 GiB."""
        self.require_room()
        return self.model.createData()

    def require_room(self) -> None:
        """Raise `ModelError` if a pin.Data of this robot would exceed 1 GiB."""
        size = _DATA_BYTES_PER_NV3 * self.nv**3
        if size > _DATA_LIMIT:
            raise ModelError(
                f"'{self.name}' has {self.n} joints, for which Pinocchio's Data takes about "
                f"{size / 2**30:.1f} GiB, more than the limit of 1 GiB; lock joints that do not "
                "matter"
            )
