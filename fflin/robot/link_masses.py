"""Mass of each link as the URDF gives it, even if the link is fixed to another."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.validation import Array
from fflin.robot.frames import ROOT, find_frame
from fflin.robot.urdf.links import Link

if TYPE_CHECKING:
    from fflin.robot.robot import Robot

_ROUNDING = 1e-9


class LinkMass(NamedTuple):
    """Mass [kg] of a link, and inertia (3, 3) [kg m^2] about the origin of `placement`."""

    mass: float
    inertia: Array
    placement: pin.SE3  # of the <inertial> on the link

    @classmethod
    def of(cls, link: Link) -> LinkMass:
        """Return the mass properties of a <link>."""
        xx, xy, xz, yy, yz, zz = link.inertia
        turn = link.com.quaternion
        rotation = (
            pin.rpy.rpyToMatrix(*link.com.rpy)
            if turn is None
            else pin.Quaternion(np.array(turn)).matrix()
        )
        inertia = np.array(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
        return cls(float(link.mass or 0.0), inertia, pin.SE3(rotation, np.array(link.com.xyz)))


class Piece(NamedTuple):
    """A link, or a whole body, on the joint that carries it."""

    joint: int
    placement: pin.SE3  # of centre of mass and axes, on the joint
    mass: float
    inertia: Array
    frame: pin.SE3  # on the joint, in which its centre of mass is given
    whole: bool = False  # whether it is a body of several links


def pieces_of(robot: Robot) -> tuple[dict[str, Piece], dict[str, str]]:
    """Return {name: piece} of links and of bodies of several, and {body: link} of the others."""
    model = robot._bare.model
    found, also = dict[str, Piece](), dict[str, str]()
    of_body: dict[int, dict[str, Piece]] = {}
    for name, link in robot.links.items():
        if model.existFrame(name, pin.FrameType.BODY):
            joint, at = find_frame(model, name)
            piece = Piece(joint, at * link.placement, link.mass, link.inertia, at)
            of_body.setdefault(joint, {})[name] = piece
    for joint in range(ROOT, model.njoints):
        body, named = model.inertias[joint], of_body.get(joint, {})
        at, own_axes = pin.SE3(np.eye(3), body.lever), pin.SE3.Identity()
        whole = Piece(joint, at, body.mass, body.inertia, own_axes, len(named) > 1)
        total = sum((as_inertia(each) for each in named.values()), pin.Inertia.Zero())
        difference = np.abs(total.matrix() - body.matrix()).max()
        if difference <= _ROUNDING * np.abs(body.matrix()).max():
            found |= named
        elif len(named) == 1:
            found |= dict.fromkeys(named, whole)
        own = "base" if joint == ROOT else model.names[joint]
        alone = next(iter(named)) if len(named) == 1 else own
        also |= {own: alone} if alone != own else {}
        found.setdefault(alone, whole)
    # Wheels stand between the joints of the whole robot.
    now = [robot.model.getJointId(name) if i > ROOT else i for i, name in enumerate(model.names)]
    return {name: each._replace(joint=now[each.joint]) for name, each in found.items()}, also


def as_inertia(piece: Piece) -> pin.Inertia:
    """Return a piece as an inertia in its joint's frame."""
    return piece.placement.act(pin.Inertia(piece.mass, np.zeros(3), piece.inertia))


def with_share(body: tuple[Array, ...], piece: Piece, share: Array) -> tuple[Array, Array, Array]:
    """Return masses (N,), centres and inertias of bodies with so much more (N,) of a piece."""
    mass, com, inertia = body
    more, turn = share * piece.mass, piece.placement.rotation
    total, apart = mass + more, piece.placement.translation - com
    square = (apart * apart).sum(axis=1)[:, None, None] * np.eye(3) - apart[:, :, None] * apart[
        :, None
    ]
    own = share[:, None, None] * (turn @ piece.inertia @ turn.T)
    shifted = (mass * more / total)[:, None, None] * square
    return total, com + (more / total)[:, None] * apart, inertia + own + shifted
