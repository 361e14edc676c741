"""Links of a URDF: their placements, masses and inertias, and likely errors in them."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.robot.urdf.xml import Element, enumerated, named, nearest, quoted

# If a length is 1e8 m, adding 1 m^2 to its square changes nothing in double precision. The links'
# moments about their own joints would be lost, and ABA would divide zero by zero.
_FARTHEST = 1e7  # [m]

# Tolerance of a quaternion's length: files often have four digits, seldom fewer.
_QUATERNION_SLACK = 1e-3

# A singular inertia has eigenvalues of about -1e-16 of the largest, because its six numbers are
# rounded. The tolerance is larger because CAD programs write fewer digits.
_NEGATIVE_SLACK = 1e-9

# CAD programs give a point mass an inertia that is only a rounding error of either sign. It is no
# larger than if the body extended this far from its centre.
_POINT = 1e-6  # [m]

# A negative moment is accepted below this fraction of the whole rigid body's moment. It changes M
# by less than the rounding of published numbers does.
_LOST_IN_BODY = 1e-6

# Tolerance of the triangle inequality of principal moments. A flat plate fulfils it with equality,
# and published numbers have three digits or more.
TRIANGLE_SLACK = 1e-3

# Entries of an inertia in the order of URDF.
INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


class Pose(NamedTuple):
    """Placement of a frame in another frame, as in the file."""

    xyz: tuple[float, ...] = (0.0, 0.0, 0.0)  # [m]
    rpy: tuple[float, ...] = (0.0, 0.0, 0.0)  # roll, pitch, yaw about fixed axes [rad]
    quaternion: tuple[float, ...] | None = None  # x y z w of unit length, in place of rpy


class Link(NamedTuple):
    """One link, and the element that describes it."""

    name: str
    element: Element
    mass: float | None = None  # [kg]; None without <inertial>
    com: Pose = Pose()  # centre of mass, and axes of the inertia
    inertia: tuple[float, ...] = (0.0,) * 6  # [kg m^2] about the centre of mass, as in INERTIA


def read_link(element: Element) -> Link:
    """Read a <link>, or raise `UrdfError` if it is invalid."""
    name = element.text("name", "a <link>")
    of = f"link {quoted(name)}"
    refuse_near_miss(element, of, ("inertial",))
    for misplaced in element.find_all("mass"):
        raise misplaced.error(f"<mass> is directly in {of}; put it into an <inertial>")
    inertial = element.find("inertial", of)
    if inertial is None:
        return Link(name, element)
    refuse_near_miss(inertial, of, ("origin", "mass", "inertia"))
    mass_element = inertial.require("mass", f"<inertial> of {of}")
    mass_element.allow_only("value", of=of)
    mass = mass_element.number("value", f"<mass> of {of}")
    if mass < 0.0:
        raise mass_element.error(f"mass of {of} is {mass:g} kg, expected 0 or more; correct it")
    inertia = inertial.require("inertia", f"<inertial> of {of}")
    inertia.allow_only(*INERTIA, of=of)
    moments = tuple(inertia.number(entry, f"<inertia> of {of}") for entry in INERTIA)
    return Link(name, element, mass, read_pose(inertial, of), moments)


def read_pose(element: Element, of: str) -> Pose:
    """Read the <origin> of an element, or return the identity without one."""
    origin = element.find("origin", of)
    if origin is None:
        return Pose()
    origin.allow_only("xyz", "rpy", "quat_xyzw", of=of)
    what = f"<origin> of {of}"
    xyz, rpy = (
        origin.vector(name, what, 3) if name in origin.attributes else (0.0, 0.0, 0.0)
        for name in ("xyz", "rpy")
    )
    if (longest := max(map(abs, xyz))) > _FARTHEST:
        raise origin.error(
            f"xyz of {of} has an entry of {longest:g} m, expected at most {_FARTHEST:g} m; correct "
            "it"
        )
    if "quat_xyzw" not in origin.attributes:
        return Pose(xyz, rpy)
    if "rpy" in origin.attributes:
        raise origin.error(f"{what} has both rpy and quat_xyzw; keep one of them")
    quaternion = origin.vector("quat_xyzw", what, 4)
    length = float(np.hypot.reduce(quaternion))
    if not abs(length - 1.0) <= _QUATERNION_SLACK:
        raise origin.error(f"quat_xyzw of {what} has length {length:g}, expected 1; normalise it")
    return Pose(xyz, rpy, tuple(float(entry / length) for entry in quaternion))


def refuse_near_miss(element: Element, of: str, known: tuple[str, ...]) -> None:
    """Raise `UrdfError` for misspelt known child elements; other unknown elements are ignored."""
    for child in element.children:
        if child.tag in known or ":" in child.tag:
            continue
        if meant := nearest(child.tag.lower(), known, 0.85):
            raise child.error(
                f"<{child.tag}> in {of} is not known to URDF; did you mean <{meant}>?"
            )


def is_impossible(mass: float, moments: Sequence[float]) -> bool:
    """Return whether any of the sorted principal moments [kg m^2] is negative beyond rounding."""
    # A body within the radius r of its centre has moments of at most mass r^2.
    return moments[0] < -max(_NEGATIVE_SLACK * moments[-1], mass * _POINT**2)


def inertia_notes(links: Iterable[Link], model: pin.Model, origin: str) -> list[str]:
    """Return notes about unusual inertias.

    Raise an error for a negative moment that is not negligible beside the fixed links.
    """
    unequal, weightless, negligible = [], [], []
    for link in links:
        if link.mass is None:
            continue
        xx, xy, xz, yy, yz, zz = link.inertia
        tensor = np.array(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
        least, middle, largest = np.linalg.eigvalsh(tensor).tolist()
        if is_impossible(link.mass, (least, middle, largest)):
            joint = model.frames[model.getFrameId(link.name, pin.FrameType.BODY)].parentJoint
            of_body = np.linalg.eigvalsh(model.inertias[joint].inertia)[0]
            if abs(least) > _LOST_IN_BODY * of_body:
                raise link.element.error(
                    f"the inertia of link {quoted(link.name)} has principal moments {least:.3g}, "
                    f"{middle:.3g}, {largest:.3g} kg m^2, expected 0 or more; correct ixx ... izz"
                )
            negligible.append(link.name)
        elif largest - middle - least > TRIANGLE_SLACK * abs(largest):
            unequal.append(link.name)
        if link.mass == 0.0 and any(link.inertia):
            weightless.append(link.name)
    lost = f"the inertia of {named('link', negligible)} has a negative principal moment, "
    notes = (
        (negligible, f"{lost}negligible compared with the links it is fixed to"),
        # Note a principal moment that is larger than the sum of the other two.
        (unequal, f"unphysical inertia: {enumerated(unequal)}"),
        (weightless, f"inertia without mass: {named('link', weightless)}"),
    )
    return [f"{origin}: {text}" for names, text in notes if names]
