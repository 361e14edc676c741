"""What a Pinocchio model must hold before anything is computed, and whether it was changed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pinocchio as pin

from fflin.base.errors import ModelError
from fflin.base.validation import is_rotation
from fflin.robot.urdf.inertias import is_impossible


def check_model(model: pin.Model, name: str) -> None:
    """Refuse a model whose numbers no robot has, by the joint that has them."""
    # All parents first: making the Data of a model whose parents form a loop never ends.
    for faults in (_of_parent, _of_joint):
        for index in range(1, model.njoints):
            for fault in faults(model, index):
                raise ModelError(
                    f"'{name}': joint '{model.names[index]}' {fault}; correct it in the model"
                )


def _of_parent(model: pin.Model, index: int) -> Iterator[str]:
    parent = model.parents[index]
    if not parent < index:
        yield f"has the parent {parent}, expected a joint before {index}"


def _of_joint(model: pin.Model, index: int) -> Iterator[str]:
    """Say what is wrong with the placement, the body or the armature of a joint."""
    placement, body = model.jointPlacements[index], model.inertias[index]
    if not np.isfinite(placement.homogeneous).all():
        yield "has a placement that is not finite"
    if not is_rotation(placement.rotation):
        yield "has a placement whose rotation is none: R^T R and det R must be 1"
    if not (np.isfinite(body.mass) and body.mass >= 0.0):
        yield f"carries a mass of {body.mass:g} kg, expected one not below 0"
    if not (np.isfinite(body.lever).all() and np.isfinite(body.inertia).all()):
        yield "carries a body whose inertia or centre of mass is not finite"
    moments = np.linalg.eigvalsh(body.inertia).tolist()
    if is_impossible(body.mass, moments):
        shown = ", ".join(f"{moment:.3g}" for moment in moments)
        yield f"carries a body of principal moments {shown} kg m^2; none can be negative"
    joint = model.joints[index]
    for value in model.armature[joint.idx_v : joint.idx_v + joint.nv].tolist():
        if not (np.isfinite(value) and value >= 0.0):
            yield f"has an armature of {value:g}, expected 0 or more"


def change_in(model: pin.Model, made: pin.Model) -> str:
    """Say what A, B and C depend on and was changed; not frames added, nor limits."""
    for what, now, before in (
        ("its joints", model.names.tolist(), made.names.tolist()),
        ("the parents of its joints", model.parents.tolist(), made.parents.tolist()),
        ("its gravity", model.gravity, made.gravity),
    ):
        if now != before:
            return what
    for what, now, before in (
        ("the axis", model.joints, made.joints),
        ("the placement", model.jointPlacements, made.jointPlacements),
        ("the inertia", model.inertias, made.inertias),
    ):
        for name, one, other in zip(made.names, now, before, strict=True):
            if one != other:
                return f"{what} of joint '{name}'"
    if not np.array_equal(model.armature, made.armature):
        return "its armature"
    for frame, before in zip(model.frames, made.frames, strict=False):
        if frame != before:
            return f"frame '{before.name}'"
    return "its frames" if model.nframes < made.nframes else ""
