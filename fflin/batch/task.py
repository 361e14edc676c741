"""What a sweep is asked to do: its points, and what of the result is the same at all of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from hashlib import sha256
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.base.version import __version__
from fflin.batch.chunks import ChunkJob, Points
from fflin.batch.configurations import (
    Configurations,
    GivenConfigurations,
    Grid,
    RandomConfigurations,
)
from fflin.batch.dispatch import Span
from fflin.batch.joint_columns import joint_columns
from fflin.batch.linear_batch import LinearBatch
from fflin.batch.rows import checked_configurations, checked_inputs, checked_velocities
from fflin.robot.frames import ROOT
from fflin.robot.robot import Robot


class SweepTask:
    """A sweep's points, and what of its result is the same at all of them."""

    def __init__(self, job: ChunkJob, configurations: Configurations, v: Any, u: Any) -> None:
        self.job, self.robot = job, job.linearizer.robot
        self.configurations, self.count = configurations, len(configurations)
        names = job.linearizer.prepared.actuation.names
        self.v = None if v is None else checked_velocities(self.robot, v, self.count)
        self.u = None if u is None else checked_inputs(names, u, self.count)

    def points(self, span: Span) -> Points:
        """Return the points of a span."""
        v, u = (None if rows is None else rows[slice(*span)] for rows in (self.v, self.u))
        return Points(self.configurations.rows(*span), v, u)

    def varying(self) -> dict[str, Array]:
        """Return the arrays of points that differ from point to point and are there already."""
        rows = {"v": self.v, "u0": self.u}
        if isinstance(self.configurations, GivenConfigurations):
            rows["q"] = self.configurations.q
        return {key: x for key, x in rows.items() if x is not None and x.strides[0] != 0}

    def constants(self, varying: Iterable[str]) -> dict[str, Array]:
        """Return what is the same at all points, a row of each."""
        prepared, root = self.job.linearizer.prepared, self.robot.model.jointPlacements[ROOT]
        rows: dict[str, Array] = {
            **prepared.rest,
            "C": prepared.common["C"],
            "D": prepared.common["D"],
            "_root": _NOWHERE if root.isIdentity(0.0) else pin.SE3ToXYZQUAT(root),
        }
        if self.u is not None:
            rows["u0"] = self.u[0]
        if self.v is not None:
            rows["v"] = self.v[0]
        if not prepared.own_reference:
            rows["_reference"] = prepared.reference
        return {key: value for key, value in rows.items() if key not in varying}

    def batch(self, arrays: Mapping[str, Array]) -> LinearBatch:
        """Put a batch together of what differs from point to point."""
        count = len(arrays["q"])
        rows: dict[str, Any] = {
            key: np.broadcast_to(value, (count, *value.shape))
            for key, value in self.constants(arrays).items()
        }
        common = self.job.linearizer.prepared.common
        absent: dict[str, Any] = dict.fromkeys(("_x0", "_y0", "_reference", "_drift"))
        return LinearBatch(
            **absent | rows | dict(arrays),
            **{key: common[key] for key in common if key not in _OF_MODELS},
            _ignorable=None,
            _columns=joint_columns(self.robot),
            _system=self.robot,
        )

    @property
    def request(self) -> str:
        """Hash of all that the result depends on."""
        robot, prepared = self.robot, self.job.linearizer.prepared
        model = robot.model
        digest = sha256(
            repr(
                [getattr(robot, key) for key in _OF_THE_ROBOT]
                + [dict(getattr(robot, key)) for key in ("stiffness", "damping", "rest")]
                + [prepared.map.frame, prepared.moving, prepared.own_reference]
                + [self.job.only_inertia, __version__, pin.__version__]
            ).encode()
        )
        for inertia, placement in zip(model.inertias, model.jointPlacements, strict=True):
            digest.update(inertia.toDynamicParameters().tobytes())
            digest.update(placement.homogeneous.tobytes())
        digest.update(prepared.reference.tobytes())
        digest.update(f"{self.count} {self.configurations.fingerprint}".encode())
        for rows in (self.v, self.u):
            digest.update(b"none" if rows is None else np.ascontiguousarray(rows).data)
        return digest.hexdigest()


# Fields of a linear model that a batch has as arrays, or not at all.
_OF_MODELS = ("C", "D", "dt", "_inertia", "_certify", "_ignorable")

# What the robot is, beside what its model and its mappings hold.
_OF_THE_ROBOT = (
    *("name", "urdf_sha256", "locked", "joints", "followers"),
    *("inputs", "outputs", "gravity"),
)
_NOWHERE = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def as_configurations(robot: Robot, q: Any) -> Configurations:
    """Return the points that `sweep` is given as rows of this robot.

    Raises
    ------
    InputError
        If they are none, or of another robot.
    """
    if not isinstance(robot, Robot):
        raise InputError(f"robot is a {type(robot).__name__}, expected a fflin.Robot")
    if isinstance(q, GivenConfigurations):  # checked already
        return q
    if not isinstance(q, Grid | RandomConfigurations):
        return GivenConfigurations(checked_configurations(robot, q))
    if q.robot is robot:
        return q
    # The same robot with other inputs or outputs will do.
    if q.robot.joints != robot.joints:
        raise InputError(
            f"q is of '{q.robot.name}', whose joints are others than those of '{robot.name}'"
        )
    return replace(q, robot=robot)
