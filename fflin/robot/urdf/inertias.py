"""What a URDF's inertias tell about themselves: refused where impossible, noted where odd."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import pinocchio as pin

from fflin.robot.urdf.links import Link
from fflin.robot.urdf.xml import enumerated, named, quoted

# Rounding of the six numbers leaves a singular inertia with eigenvalues of about -1e-16 of the
# largest when they are written in full; CAD programs write fewer digits.
_NEGATIVE_SLACK = 1e-9

# A point mass that a CAD program integrates has the inertia of rounding, of either sign: that
# of a body within a micrometre of its centre.
_POINT = 1e-6  # [m]

# A negative moment this small against that of the rigid body it is fixed to changes M no more
# than the last digits of published figures do.
_LOST_IN_BODY = 1e-6

# Published figures have three digits or more, and a flat plate's lie on the bound.
TRIANGLE_SLACK = 1e-3


def is_impossible(mass: float, moments: Sequence[float]) -> bool:
    """Tell whether the principal moments, ascending [kg m^2], are negative beyond rounding."""
    # A body within the radius r of its centre has moments of at most mass r^2.
    return moments[0] < -max(_NEGATIVE_SLACK * moments[-1], mass * _POINT**2)


def inertia_notes(links: Iterable[Link], model: pin.Model, origin: str) -> list[str]:
    """Warn of odd inertias; refuse negative ones that the link's rigid body does not outweigh."""
    unequal, weightless, negligible = [], [], []
    for link in links:
        if link.mass is None:
            continue
        least, middle, largest = link.principal_inertias().tolist()
        if is_impossible(link.mass, (least, middle, largest)):
            joint = model.frames[model.getFrameId(link.name, pin.FrameType.BODY)].parentJoint
            of_body = np.linalg.eigvalsh(model.inertias[joint].inertia)[0]
            if abs(least) > _LOST_IN_BODY * of_body:
                raise link.element.error(
                    f"the inertia of link {quoted(link.name)} has principal moments {least:.3g}, "
                    f"{middle:.3g}, {largest:.3g} kg m^2; none can be negative: correct ixx ... izz"
                )
            negligible.append(link.name)
        elif largest - middle - least > TRIANGLE_SLACK * abs(largest):
            unequal.append(link.name)
        if link.mass == 0.0 and any(link.inertia):
            weightless.append(link.name)
    lost = f"the inertia of {named('link', negligible)} has a negative principal moment, of no "
    notes = (
        (negligible, f"{lost}account beside the links it is fixed to"),
        # One principal moment is more than the sum of the others.
        (unequal, f"inertia of no rigid body: {enumerated(unequal)}"),
        (weightless, f"an inertia and no mass: {named('link', weightless)}"),
    )
    return [f"{origin}: {text}" for names, text in notes if names]
