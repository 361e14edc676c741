"""What a Pinocchio model must hold before anything is computed, and whether it was changed."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from fflin.base.errors import ModelError
from fflin.base.validation import NORM_TOLERANCE
from fflin.robot.urdf.inertias import is_impossible


def check_model(model: pin.Model, name: str) -> None:
    """Refuse a model whose numbers no robot has.

    Parameters
    ----------
    model : pin.Model
    name : str
        What errors call the robot.

    Raises
    ------
    ModelError
        Naming the joint: if it hangs on one that comes after it, its placement is none, the body
        it carries is impossible, or its armature is negative or not finite.
    """
    # First of all: making the Data of a model whose parents form a loop never ends.
    for index in range(1, model.njoints):
        parent = model.parents[index]
        if not parent < index:
            raise _error(
                model, name, index, f"has the parent {parent}, expected a joint before {index}"
            )
    for index in range(1, model.njoints):
        _check_placement(model, name, index)
        _check_body(model, name, index)
        _check_armature(model, name, index)


def change_in(model: pin.Model, made: pin.Model) -> str:
    """Say what of a model that A, B and C depend on differs from what it was made as.

    Frames may have been added, and limits changed; the answer is then empty.
    """
    for what, now, before in (
        ("its joints", model.names.tolist(), made.names.tolist()),
        ("the parents of its joints", model.parents.tolist(), made.parents.tolist()),
        ("its gravity", model.gravity, made.gravity),
    ):
        if now != before:
            return what
    for what in ("joints", "jointPlacements", "inertias"):
        for index, (now, before) in enumerate(
            zip(getattr(model, what), getattr(made, what), strict=True)
        ):
            if now != before:
                return f"{_OF_JOINT[what]} joint '{made.names[index]}'"
    if not np.array_equal(model.armature, made.armature):
        return "its armature"
    for frame, before in zip(model.frames, made.frames, strict=False):
        if frame != before:
            return f"frame '{before.name}'"
    return "its frames" if model.nframes < made.nframes else ""


_OF_JOINT = {
    "joints": "the axis of",
    "jointPlacements": "the placement of",
    "inertias": "the inertia of",
}


def _check_placement(model: pin.Model, name: str, index: int) -> None:
    placement = model.jointPlacements[index]
    if not np.isfinite(placement.homogeneous).all():
        raise _error(model, name, index, "has a placement that is not finite")
    rotation = placement.rotation
    skewed = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if skewed > NORM_TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise _error(
            model, name, index, "has a placement whose rotation is none: R^T R and det R must be 1"
        )


def _check_body(model: pin.Model, name: str, index: int) -> None:
    body = model.inertias[index]
    if not (np.isfinite(body.mass) and body.mass >= 0.0):
        raise _error(
            model, name, index, f"carries a mass of {body.mass:g} kg, expected one not below 0"
        )
    if not (np.isfinite(body.lever).all() and np.isfinite(body.inertia).all()):
        raise _error(
            model, name, index, "carries a body whose inertia or centre of mass is not finite"
        )
    moments = np.linalg.eigvalsh(body.inertia).tolist()
    if is_impossible(body.mass, moments):
        shown = ", ".join(f"{moment:.3g}" for moment in moments)
        raise _error(
            model,
            name,
            index,
            f"carries a body of principal moments {shown} kg m^2; none can be negative",
        )


def _check_armature(model: pin.Model, name: str, index: int) -> None:
    joint = model.joints[index]
    for value in model.armature[joint.idx_v : joint.idx_v + joint.nv].tolist():
        if not (np.isfinite(value) and value >= 0.0):
            raise _error(model, name, index, f"has an armature of {value:g}, expected 0 or more")


def _error(model: pin.Model, name: str, index: int, what: str) -> ModelError:
    return ModelError(f"'{name}': joint '{model.names[index]}' {what}; correct it in the model")
