r"""Modes of appendages as bodies on joints, subtracted from the links that carry them.

Each mode with participation L is equivalent to one ball on one screw joint. The ball's spatial
inertia I and the twist S per unit amplitude satisfy I S = L and S^T I S = 1. The ball is subtracted
from the link's inertia, so that the sum of both is the link in the URDF.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, InputError
from fflin.base.validation import Array
from fflin.robot.equipment.appendages import Appendage, FlexibleAppendage, Slosh, rigid_inertia
from fflin.robot.equipment.mounting import Mounted, difference, inertia_of, turned_to
from fflin.robot.joints import ROOT, Joint, find_frame
from fflin.robot.mass_properties import Piece, as_inertia

# An eigenvalue of M_rr - L L^T counts as negative if it is below minus this fraction of the
# largest eigenvalue of M_rr.
_NEGATIVE = 1e-9
# A larger relative difference between mass properties of a file and of the URDF causes a warning.
_AGREE = 1e-2
# Largest fraction of a body's mass in the balls of its modes. CRBA sums inertias inwards, and the
# mass of each sum must be positive.
_LARGEST_SHARE = 0.9
# Least distance of a ball from its appendage's frame, relative to the body's radius of gyration,
# for which the ball's motion counts as a rotation about the frame.
_SHORTEST = 0.05
# Least mass of a ball, relative to the mass with which no rotor is needed.
_LIGHTEST = 1e-6
# If the translation part of a participation is below this fraction of the rotation part, or vice
# versa, it counts as zero.
_NONE = 1e-14


class _Modes(NamedTuple):
    """Appendage on a body, with its participation L (6, k) in the body's frame."""

    appendage: Appendage
    joint: int
    placement: pin.SE3
    L: Array  # rows: translation, rotation about the body's origin


def mounted_appendages(
    model: pin.Model,
    bodies: list[pin.Inertia],
    appendages: Sequence[Appendage],
    links: Mapping[str, Piece],
) -> tuple[list[Mounted], dict[str, dict[str, float]]]:
    """Return the bodies and springs of all modes, and subtract the bodies from their carriers."""
    found = [_seen(model, item) for item in appendages]
    for item in found:
        _compare_inertia(item, bodies, links)
    for joint in dict.fromkeys(item.joint for item in found):
        of = "the base" if joint == ROOT else f"the link of joint '{model.names[joint]}'"
        _require_inertia(bodies[joint], of, [item for item in found if item.joint == joint])
    parts: list[Mounted] = []
    springs: dict[str, dict[str, float]] = {"stiffness": {}, "damping": {}}
    for item in found:
        if isinstance(item.appendage, Slosh):
            parts += _liquid(item.appendage, item, bodies)
        for kind, values in item.appendage.springs.items():
            springs[kind] |= values
    balls = {
        joint: [ball for item in found if item.joint == joint for ball in _balls(item, body)]
        for joint, body in enumerate(bodies)
    }
    for joint, of_body in balls.items():
        mass = sum(ball.mass for ball in of_body)
        lighter = min(1.0, _LARGEST_SHARE * bodies[joint].mass / mass) if mass else 1.0
        if lighter < _LIGHTEST:
            raise InputError(
                f"mode '{of_body[0].name}' moves the centre of mass of its body, but without the "
                f"sloshing liquid this body has only {bodies[joint].mass:.3g} kg; the mass in "
                "the URDF must include the appendage and the liquid"
            )
        for ball in of_body:
            part, removed = ball.mounted(joint, lighter)
            parts.append(part)
            bodies[joint] = difference(bodies[joint], removed)
    return parts, springs


def _seen(model: pin.Model, item: Appendage) -> _Modes:
    joint, placement = find_frame(model, item.frame)
    R, p = placement.rotation, placement.translation
    t, r = (R @ part for part in np.split(item.participation, 2))
    r = r + np.cross(p, t, axisb=0, axisc=0)
    return _Modes(item, joint, placement, np.vstack((t, r)))


def effective_shares(model: pin.Model, appendages: Sequence[Appendage]) -> dict[str, Array]:
    """Return {mode: effective masses and moments of inertia (6,)} in the appendage's frame.

    The values are fractions of the rigid inertia about the frame's origin. This is the inertia of
    the appendage's file, or without one, the inertia of the body that carries the appendage.
    """
    found: dict[str, Array] = {}
    for item in appendages:
        joint, placement = find_frame(model, item.frame)
        total = model.inertias[joint].se3Action(placement.inverse()).matrix()
        if isinstance(item, FlexibleAppendage) and item.inertia is not None:
            total = item.inertia
        squares = item.participation.T**2
        shares = squares / np.maximum(total.diagonal(), 1e-300)
        found |= dict(zip(item.modes, shares, strict=True))
    return found


def _compare_inertia(item: _Modes, bodies: list[pin.Inertia], links: Mapping[str, Piece]) -> None:
    """Warn if a file's rigid inertia differs from the link's."""
    appendage = item.appendage
    if not isinstance(appendage, FlexibleAppendage) or appendage.inertia is None:
        return
    of_file, link = rigid_inertia(appendage.inertia), links.get(appendage.frame)
    of_link, what = bodies[item.joint], f"the body with frame '{appendage.frame}'"
    if link is not None:
        of_link, what = as_inertia(link), f"link '{appendage.frame}'"
    of_link = of_link.se3Action(item.placement.inverse())
    M = of_link.matrix()
    size = _radius_of_gyration(of_link.mass, M[3:, 3:])
    scale = np.array([1.0, 1.0, 1.0, *[1.0 / size] * 3])
    apart = np.abs(M - appendage.inertia) * np.outer(scale, scale)
    if apart.max() > _AGREE * max(M[0, 0], of_file.mass):
        file, urdf = (f"{x.mass:.4g} kg at {_point(x.lever)} m" for x in (of_file, of_link))
        warnings.warn(
            f"flexible appendage '{appendage.title}': the inertia in its file ({file}) differs "
            f"from the inertia of {what} ({urdf} in the axes of the frame) in these values or in "
            "the moments of inertia; correct the URDF, or use the inertia of the file with "
            "rigid=True",
            FflinWarning,
            stacklevel=6,
        )


def _radius_of_gyration(mass: float, inertia: Array) -> float:
    """Return the root mean square distance [m] of a mass from the point that `inertia` is about."""
    return math.sqrt(max(float(np.trace(inertia)), 1e-300) / max(2.0 * mass, 1e-300))


def _point(values: Array) -> str:
    return f"({', '.join(f'{x:.4g}' for x in values)})"


def _require_inertia(body: pin.Inertia, of: str, found: Sequence[_Modes]) -> None:
    """Raise `InputError` if M_rr - L L^T of a body has a negative eigenvalue."""
    L = np.hstack([item.L for item in found])
    rows = np.array([body.mass]), body.lever[None], body.inertia[None]
    for k, mode in enumerate((name for item in found for name in item.appendage.modes), start=1):
        least = float(_least_eigenvalue(*rows, L[:, :k])[0])
        if not least >= -_NEGATIVE:
            raise InputError(
                f"the effective masses of the modes up to '{mode}' exceed the inertia of {of} "
                f"({body.mass:.4g} kg): M_rr - L L^T has the eigenvalue {least:.2g}, relative to "
                "the largest eigenvalue of M_rr; the inertia in the URDF must include the "
                "appendage as if it were rigid"
            )


def _least_eigenvalue(mass: Array, center: Array, inertia: Array, L: Array) -> Array:
    """Return the least eigenvalue (N,) of M_rr - L L^T, relative to the largest one of M_rr.

    M_rr follows from masses (N,), centres of mass (N, 3), and inertias (N, 3, 3) about them.
    """
    # M_rr is scaled: about the centre of mass, with unit mass and unit radius of gyration.
    trace = np.trace(inertia, axis1=1, axis2=2)
    size = np.sqrt(np.maximum(trace, 1e-300) / np.maximum(2.0 * mass, 1e-300))[:, None, None]
    t, r = np.split(L, 2)
    modes = np.empty((len(mass), *L.shape))
    modes[:, :3] = t
    modes[:, 3:] = (r - np.cross(center[:, :, None], t[None], axis=1)) / size
    M = np.zeros((len(mass), 6, 6))
    M[:, :3, :3], M[:, 3:, 3:] = mass[:, None, None] * np.eye(3), inertia / size**2
    left = M - modes @ modes.swapaxes(1, 2)
    least = np.full(len(mass), -np.inf)
    finite = np.isfinite(left).all(axis=(1, 2))
    largest = np.linalg.eigvalsh(M[finite])[:, -1]
    least[finite] = np.linalg.eigvalsh(left[finite])[:, 0] / largest
    return least


def first_impossible(
    model: pin.Model,
    appendages: Sequence[Appendage],
    bodies: Mapping[int, tuple[Array, Array, Array]],
) -> int | None:
    """Return the first of N rows in which modes need more inertia than their body has.

    `bodies` maps joints of `model` to masses (N,), centres of mass (N, 3) and inertias (N, 3, 3).
    Return None if all rows are possible.
    """
    found = [_seen(model, item) for item in appendages]
    impossible = []
    for joint, rows in bodies.items():
        if of_body := [item.L for item in found if item.joint == joint]:
            least = _least_eigenvalue(*rows, np.hstack(of_body))
            impossible += np.flatnonzero(~(least >= -_NEGATIVE)).tolist()
    return min(impossible, default=None)


class _Ball(NamedTuple):
    """Ball that represents a mode, in the frame of the body that carries it."""

    name: str
    t: Array  # (3,) translation part of the participation
    r: Array  # (3,) rotation part of the participation about the ball's centre
    center: Array
    mass: float  # [kg] mass with which no rotor is needed
    moment: float  # [kg m^2] moment of inertia of the ball
    lever: float  # [m] distance from the appendage's frame; 0 if it is too small for a rotation

    @property
    def rotation(self) -> float:
        r"""Rotation [rad] of the structure per unit of the amplitude.

        Per unit of the amplitude, the ball rotates by w and moves by v. It is at the distance c
        from the appendage's frame. The value is the upper bound :math:`|w| + |v| / |c|` of the
        rotation.
        """
        turned = float(np.linalg.norm(self.r)) / self.moment if self.moment else 0.0
        moved = float(np.linalg.norm(self.t)) / self.mass if self.mass else 0.0
        return turned + (moved / self.lever if self.lever else 0.0)

    def mounted(self, joint: int, lighter: float) -> tuple[Mounted, pin.Inertia]:
        """Return the ball on its joint, and the inertia to subtract from the body.

        The ball has the fraction `lighter` of `mass`.
        """
        mass = lighter * self.mass
        v = self.t / mass if mass else np.zeros(3)
        w = self.r / self.moment if self.moment else np.zeros(3)
        # The inertia of a rotor compensates a different mass of the ball: S^T I S + rotor = 1.
        rotor = 1.0 - float(self.t @ v + self.r @ w)
        moving, turning = float(np.linalg.norm(v)), float(np.linalg.norm(w))
        sphere = self.moment * np.eye(3)
        removed = inertia_of(mass, self.center, sphere)
        if turning:
            axis, scale = w / turning, turning
            origin: Array = self.center + np.cross(w, v) / turning**2
            pitch = float(v @ w) / turning**2
            motion: pin.JointModel = pin.JointModelHZ(pitch) if pitch else pin.JointModelRZ()
        else:
            axis, scale = (v / moving, moving) if moving else (np.eye(3)[2], 1.0)
            origin, motion = self.center, pin.JointModelPZ()
        R = turned_to(axis)
        own = inertia_of(mass, R.T @ (self.center - origin), sphere)
        pure = not turning
        mode = Joint(self.name, prismatic=pure, kind="modal", scale=scale, rotation=self.rotation)
        if abs(rotor) < 1e-13:
            rotor = 0.0
        return Mounted(mode, joint, pin.SE3(R, origin), motion, own, rotor / scale**2), removed


def _balls(item: _Modes, body: pin.Inertia) -> list[_Ball]:
    """Return a ball for each mode of a flexible appendage."""
    if not isinstance(item.appendage, FlexibleAppendage):
        return []
    p = item.placement.translation
    size = _radius_of_gyration(body.mass, body.matrix()[3:, 3:])
    balls = []
    for name, column in zip(item.appendage.modes, item.L.T, strict=True):
        t, r = column[:3], column[3:]
        # Refer participation to the appendage's frame: only there, a pure translation has r = 0.
        r = r - np.cross(p, t)
        square = float(t @ t)
        center = np.zeros(3)
        if math.sqrt(square) * size > _NONE * float(np.linalg.norm(r)):
            center = np.cross(t, r) / square
            # Limit the ball's distance to the body's radius of gyration.
            center *= min(1.0, size / max(float(np.linalg.norm(center)), 1e-300))
        else:
            t, square = np.zeros(3), 0.0
        r = r - np.cross(center, t)
        rest = float(np.linalg.norm(r))
        far = max(size, float(np.linalg.norm(p))) * math.sqrt(square)
        if rest <= _NONE * max(far, float(np.linalg.norm(column[3:]))):
            r, rest = np.zeros(3), 0.0
        moment = rest**2 + size**2 * square if rest else 0.0
        mass = square + (rest / size) ** 2 if square else 0.0
        lever = float(np.linalg.norm(center))
        lever = lever if lever >= _SHORTEST * size else 0.0
        balls.append(_Ball(name, t, r, p + center, mass, moment, lever))
    return balls


def _liquid(slosh: Slosh, item: _Modes, bodies: list[pin.Inertia]) -> list[Mounted]:
    """Return a slosh mass as two joints, the second with the mass; subtract it from the body."""
    joint, placement = item.joint, item.placement
    x, y, z = (placement.rotation @ slosh.axes).T
    at, point = placement * np.array(slosh.position), np.zeros((3, 3))
    bodies[joint] = difference(bodies[joint], inertia_of(slosh.mass, at, point))
    # A mass on springs slides along x and y. A pendulum rotates about -y, then about x, and so also
    # moves along x and y.
    slides = slosh.length is None
    arm = (slosh.length or 0.0) * z
    first, second = (turned_to(axis) for axis in ((x, y) if slides else (-y, x)))
    inertia, rotation = slosh.modal_mass, float(not slides)
    across = [
        Joint(name, prismatic=slides, kind="slosh", inertia=inertia, rotation=rotation)
        for name in slosh.modes
    ]
    motion = pin.JointModelPZ if slides else pin.JointModelRZ
    between = pin.SE3(first.T @ second, np.zeros(3))
    mass = inertia_of(slosh.mass, second.T @ -arm, point)
    outer = Mounted(across[0], joint, pin.SE3(first, at + arm), motion(), pin.Inertia.Zero())
    return [outer, Mounted(across[1], slosh.modes[0], between, motion(), mass)]
