"""Task of a sweep: its points, and the part of the result that is the same at all points."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base.record import content_digest
from fflin.base.validation import Array
from fflin.base.version import __version__
from fflin.batch.batch_record import asked_of, texts_of
from fflin.batch.chunks import ChunkJob
from fflin.batch.configurations import Configurations, GivenConfigurations, content
from fflin.batch.linear_batch import AT_ROOT, LinearBatch
from fflin.batch.rows import Points, checked_inputs, checked_velocities, column
from fflin.robot.frames import ROOT

# Attributes of a robot that, with its model and its mappings, tell it from others.
_OF_THE_ROBOT = (
    *("name", "urdf_sha256", "locked", "joints", "followers"),
    *("inputs", "outputs", "gravity", "orbit"),
)


class SweepTask:
    """Points of a sweep, and the part of its result that is the same at all points."""

    def __init__(self, job: ChunkJob, configurations: Configurations, v: Any, u: Any) -> None:
        self.job, self.robot = job, job.linearizer.robot
        self.configurations, self.count = configurations, len(configurations)
        names = job.linearizer.prepared.actuation.names
        self.v = None if v is None else checked_velocities(self.robot, v, self.count)
        self.u = None if u is None else checked_inputs(names, u, self.count)

    def points(self, start: int, stop: int) -> Points:
        """Return some of the points."""
        v, u = (None if rows is None else rows[start:stop] for rows in (self.v, self.u))
        return Points(self.configurations.rows(start, stop), v, u)

    def given(self) -> dict[str, Array]:
        """Return the arrays of points that differ from point to point and are there already."""
        rows = {"v": self.v, "u0": self.u}
        if isinstance(self.configurations, GivenConfigurations):
            rows["q"] = self.configurations.q
        return {key: x for key, x in rows.items() if x is not None and x.strides[0] != 0}

    def constants(self, varying: Iterable[str]) -> dict[str, Array]:
        """Return one row of each array that is the same at all points."""
        prepared, root = self.job.linearizer.prepared, self.robot.model.jointPlacements[ROOT]
        rows: dict[str, Array] = {
            **prepared.rest,
            "C": prepared.common["C"],
            "D": prepared.common["D"],
            "_root": AT_ROOT if root.isIdentity(0.0) else pin.SE3ToXYZQUAT(root),
        }
        if self.u is not None:
            rows["u0"] = self.u[0]
        if self.v is not None:
            rows["v"] = self.v[0]
        if not prepared.own_reference:
            rows["_reference"] = prepared.reference
        return {key: value for key, value in rows.items() if key not in varying}

    def batch(self, arrays: Mapping[str, Array]) -> LinearBatch:
        """Assemble a batch from the arrays that vary between points."""
        count = len(arrays["q"])
        rows: dict[str, Any] = {
            key: np.broadcast_to(value, (count, *value.shape))
            for key, value in self.constants(arrays).items()
        }
        common = self.job.linearizer.prepared.common
        held = {item.name for item in fields(LinearBatch)} - {"C", "D"}
        absent: dict[str, Any] = dict.fromkeys(("_x0", "_y0", "_reference", "_drift"))
        return LinearBatch(
            **absent | rows | dict(arrays),
            **{key: common[key] for key in common.keys() & held},
            columns=tuple(map(column, self.robot.joints)),
            _asked=asked_of(common),
        )

    def texts(self, constants: Iterable[str]) -> dict[str, str]:
        """Return the texts in a file of the batch."""
        one = {key: np.empty((1, *shape)) for key, shape in self.job.shapes.items()}
        example = self.batch(one | {"q": self.points(0, 1).q})
        return {**texts_of(example, self.count), "constant": json.dumps(list(constants))}

    @property
    def request(self) -> str:
        """Hash of all that the result depends on."""
        robot, prepared = self.robot, self.job.linearizer.prepared
        inertias = [inertia.toDynamicParameters() for inertia in robot.model.inertias]
        placements = [placement.homogeneous for placement in robot.model.jointPlacements]
        said = [getattr(robot, key) for key in _OF_THE_ROBOT]
        said += [dict(getattr(robot, key)) for key in ("stiffness", "damping", "rest")]
        said += [prepared.map.frame, prepared.moving, prepared.own_reference]
        said += [self.job.only_inertia, __version__, pin.__version__, self.count]
        rows = {"v": self.v, "u": self.u}
        return content_digest(
            {
                "robot": repr(said),
                "model": np.concatenate([np.ravel(each) for each in (*inertias, *placements)]),
                "reference": prepared.reference,
                **{key: "none" if value is None else value for key, value in rows.items()},
                **{f"of q: {key}": value for key, value in content(self.configurations).items()},
            }
        )
