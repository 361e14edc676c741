"""Checks of a Pinocchio model before anything is computed, and of changes made to it later."""

from collections.abc import Iterator

import numpy as np
import pinocchio as pin

from fflin.base.errors import ModelError
from fflin.base.validation import is_rotation
from fflin.robot.frames import ROOT
from fflin.robot.joints import Joint
from fflin.robot.urdf.links import is_impossible


def check_root(model: pin.Model, name: str) -> None:
    """Refuse a model that is not one tree on one free-flyer."""
    root = model.joints[ROOT].shortname() if model.njoints > ROOT else "none"
    if root != "JointModelFreeFlyer":
        raise ModelError(
            f"'{name}': the root joint is {root}, expected JointModelFreeFlyer; build the model "
            "with pin.JointModelFreeFlyer() as its root joint"
        )
    fixed = [model.names[i] for i in range(ROOT + 1, model.njoints) if model.parents[i] == 0]
    if fixed:
        raise ModelError(
            f"'{name}': joint '{fixed[0]}' is attached to the world, not the free-flyer; connect "
            "every moving link to the one base"
        )


def joint_of(model: pin.Model, index: int) -> Joint:
    """Return a joint, or refuse one that has not one degree of freedom."""
    joint = model.joints[index]
    kind = joint.shortname()
    name = model.names[index]
    if kind == "JointModelMimic":
        raise ModelError(
            f"joint '{name}' is a JointModelMimic, for which Pinocchio has no derivatives; load "
            "the URDF with fflin.load, or build the model with mimic=False"
        )
    if joint.nv != 1 or joint.nq not in (1, 2):
        raise ModelError(
            f"joint '{name}' is a {kind.removeprefix('JointModel')} of {joint.nv} "
            f"degrees of freedom, expected 1; lock it with lock=['{name}']"
        )
    return Joint(name, joint.idx_q, joint.idx_v, joint.nq == 2, kind.startswith("JointModelP"))


def check_order(model: pin.Model, name: str) -> None:
    """Refuse joints of which one hangs neither on the one before it nor on what that hangs on."""
    above: list[int] = []
    for joint, parent in enumerate(model.parents.tolist()):
        while above and above[-1] != parent:
            above.pop()
        if joint and not above:
            raise ModelError(
                f"'{name}': the joints are not in depth-first order, which makes Pinocchio's CRBA "
                "wrong; add all joints of one branch before the joints of the next"
            )
        above.append(joint)


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
    if not (parent := model.parents[index]) < index:
        yield f"has the parent {parent}, expected a joint before {index}"


def _of_joint(model: pin.Model, index: int) -> Iterator[str]:
    """Say what is wrong with the placement, the body or the armature of a joint."""
    placement, body = model.jointPlacements[index], model.inertias[index]
    if not np.isfinite(placement.homogeneous).all():
        yield "has a placement that is not finite"
    if not is_rotation(placement.rotation):
        yield "has a placement whose matrix R is not a rotation: R^T R must be I and det R 1"
    if not (np.isfinite(body.mass) and body.mass >= 0.0):
        yield f"carries a mass of {body.mass:g} kg, expected 0 or more"
    if not (np.isfinite(body.lever).all() and np.isfinite(body.inertia).all()):
        yield "carries a body whose inertia or centre of mass is not finite"
    moments = np.linalg.eigvalsh(body.inertia).tolist()
    if is_impossible(body.mass, moments):
        shown = ", ".join(f"{moment:.3g}" for moment in moments)
        yield f"carries a body of principal moments {shown} kg m^2, expected 0 or more"
    joint = model.joints[index]
    for value in model.armature[joint.idx_v : joint.idx_v + joint.nv].tolist():
        if not (np.isfinite(value) and value >= 0.0):
            yield f"has an armature of {value:g}, expected 0 or more"


def change_in(model: pin.Model, made: pin.Model) -> str:
    """Say what A, B and C depend on and was changed; not frames added, nor limits."""
    for what, key in {"its joints": "names", "the parents of its joints": "parents"}.items():
        if getattr(model, key).tolist() != getattr(made, key).tolist():
            return what
    if model.gravity != made.gravity:
        return "its gravity"
    of_joints = {"axis": "joints", "placement": "jointPlacements", "inertia": "inertias"}
    for what, key in of_joints.items():
        pairs = zip(made.names, getattr(model, key), getattr(made, key), strict=True)
        for name in (name for name, now, before in pairs if now != before):
            return f"the {what} of joint '{name}'"
    if not np.array_equal(model.armature, made.armature):
        return "its armature"
    for frame, before in zip(model.frames, made.frames, strict=False):
        if frame != before:
            return f"frame '{before.name}'"
    return "its frames" if model.nframes < made.nframes else ""
