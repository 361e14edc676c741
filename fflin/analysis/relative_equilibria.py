"""Relative equilibria of a rigid body in orbit, and their stability."""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError, SingularInertiaError
from fflin.base.tables import grid
from fflin.base.validation import Array, Complex, FrozenArrays, instance
from fflin.dynamics.coordinates import frame_of
from fflin.dynamics.orbital import field_of, mean_motion
from fflin.dynamics.state import Frame
from fflin.robot.joints import ROOT
from fflin.robot.robot import Robot

# Relative rounding error of the principal moments, which follow from sums over bodies and
# eigenvalues.
_ROUNDING = 1e3 * float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False)
class RelativeEquilibrium(FrozenArrays):
    """Relative equilibrium: an attitude at rest in the orbital frame, with fixed joints.

    Attributes
    ----------
    q : ndarray (nq,)
        Configuration in which the centre of mass is on the orbit. ``equilibrium(robot, q).u``
        returns the inputs that hold the joints at q.
    moments : ndarray (3,)
        Principal moments of inertia [kg m^2] about three axes through the centre of mass: the
        radial axis, the along-track axis and the orbit normal.
    poles : ndarray (6,)
        Poles [rad/s] of the attitude motion with fixed joints: two of pitch, then four of roll and
        yaw.
    stable : bool or None
        True if no pole has a positive real part, False if a pole has one, None if rounding error
        leaves the sign undecided.
    margin : float
        Smallest of the quantities that must be positive for stability, divided by its rounding
        error. The equilibrium is stable if `margin` is above 1, and unstable if `margin` is below
        -1.

    Examples
    --------
    >>> robot = fflin.load("servicer_7dof", orbit=fflin.CircularOrbit(altitude=700e3))
    >>> best = fflin.relative_equilibria(robot)[0]
    >>> bool(best.moments.argmin() == 0), best.poles.shape  # the longest axis to the body
    (True, (6,))
    """

    q: Array
    moments: Array
    poles: Complex
    stable: bool | None
    margin: float


class RelativeEquilibria(tuple[RelativeEquilibrium, ...]):
    """Tuple of the 24 relative equilibria, most stable first; ``print`` shows a table.

    Examples
    --------
    >>> robot = fflin.load("servicer_7dof", orbit=fflin.CircularOrbit(altitude=700e3))
    >>> found = fflin.relative_equilibria(robot)
    >>> sum(bool(each.stable) for each in found)
    4
    """

    __slots__ = ()

    def __str__(self) -> str:
        """Show a table with one row for each group of four equivalent attitudes."""
        rows = [["radial", "along", "normal [kg m^2]", "", "growth [1/s]"]]
        for one in self[::4]:
            said = {True: "stable", False: "unstable", None: "undecided"}[one.stable]
            growth = float(one.poles.real.max()) if one.stable is False else 0.0
            sizes = [f"{moment:.5g}" for moment in one.moments]
            rows.append([*sizes, said, f"{growth:.4g}" if growth else "."])
        return (
            f"principal moments of inertia; each row stands for 4 attitudes\n{grid(rows, 'rrrlr')}"
        )


def relative_equilibria(
    robot: Robot, q: Array | None = None, *, frame: Frame | None = None
) -> RelativeEquilibria:
    r"""List the attitudes in which a robot with fixed joints stays at rest in its orbital frame.

    In each of the 24 attitudes, the principal axes of inertia are parallel to the axes of the
    orbital frame. Let n be the orbital rate, and :math:`I_r, I_a, I_n` the moments of inertia about
    the radial axis, the along-track axis and the orbit normal. The poles :math:`\lambda` are the
    roots of two equations, the first for pitch and the second for roll and yaw, see (14.8) of
    docs/derivation.md:

    .. math::
        \lambda^2 = -3 n^2 (I_a - I_r)/I_n, \qquad
        \lambda^4 + (1 + 3 k_a + k_a k_r)\,n^2 \lambda^2 + 4 k_a k_r\,n^4 = 0, \qquad
        k_a = (I_n - I_r)/I_a, \quad k_r = (I_n - I_a)/I_r.

    If all poles are imaginary and simple, the body librates about the equilibrium.

    Parameters
    ----------
    robot : Robot
        Robot in orbit.
    q : array_like (nq,), optional
        Configuration that provides the joint positions; neutral by default.
    frame : {"lvlh", "hill"}, optional
        Orbital frame in which `q` of each result is expressed; "lvlh" by default.

    Returns
    -------
    RelativeEquilibria
        Tuple of 24 `RelativeEquilibrium`, most stable first.

    Raises
    ------
    InputError
        If the robot is not in orbit, its wheels store momentum, or an argument is invalid.
    SingularInertiaError
        If the robot has no inertia about an axis.

    References
    ----------
    D. B. DeBra and R. H. Delp, Rigid body attitude stability and natural frequencies in a circular
    orbit, J. Astronautical Sciences 8, 1961. P. C. Hughes, Spacecraft Attitude Dynamics, 1986.

    Examples
    --------
    >>> robot = fflin.load("servicer_7dof", orbit=fflin.CircularOrbit(altitude=700e3))
    >>> found = fflin.relative_equilibria(robot)
    >>> len(found), found[0].stable
    (24, True)
    """
    instance("robot", robot, Robot, "a fflin.Robot")
    field = field_of(robot, frame_of(robot, frame))
    if field is None:
        raise InputError(
            f"'{robot.name}' is not in orbit; give it an orbit by "
            "robot.replace(orbit=fflin.CircularOrbit(altitude=...)) or --orbit"
        )
    if robot.stored_momentum:
        raise InputError(
            f"wheels of '{robot.name}' store momentum, whose gyroscopic torque is not considered "
            "here; set momentum=0, or use fflin.equilibrium at an attitude"
        )
    q = robot.neutral() if q is None else robot.checked_configuration(q).copy()
    q[:7] = pin.SE3ToXYZQUAT(pin.SE3.Identity())
    data, root = robot.create_data(), robot.model.jointPlacements[ROOT]
    pin.ccrba(robot.model, data, q, np.zeros(robot.nv))
    center = root.actInv(data.com[0])
    sizes, axes = np.linalg.eigh(root.rotation.T @ data.Ig.inertia @ root.rotation)
    if sizes[0] <= _ROUNDING * sizes[2]:
        raise SingularInertiaError(
            f"'{robot.name}' has no inertia about one axis; give the link an inertia about every "
            "axis"
        )
    n, found = mean_motion(robot), []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        own = axes[:, order] * signs
        if np.linalg.det(own) < 0.0:
            continue
        R = field.axes @ own.T
        at, moments = q.copy(), sizes[list(order)]
        at[:7] = pin.SE3ToXYZQUAT(root.inverse() * pin.SE3(R, -R @ center))
        poles, margin = _libration(moments, n)
        stable = None if abs(margin) <= 1.0 else margin > 0.0
        found.append(RelativeEquilibrium(at, moments, poles, stable, margin))
    return RelativeEquilibria(sorted(found, key=lambda one: (-one.margin, *one.moments)))


def _libration(moments: Array, n: float) -> tuple[Complex, float]:
    """Return the poles (6,) of the attitude motion, and the smallest margin of stability."""
    radial, along, normal = moments.tolist()
    pitch = 3.0 * (along - radial) / normal
    k_a, k_r = (normal - radial) / along, (normal - along) / radial
    b, c = 1.0 + 3.0 * k_a + k_a * k_r, 4.0 * k_a * k_r
    # Solve mu^2 + b mu + c = 0 for mu = lambda^2 / n^2 without cancellation.
    root = np.sqrt(complex(b * b - 4.0 * c))
    larger = -0.5 * (b + (root if b >= 0.0 else -root))
    squares = np.array([-pitch, larger, c / larger if larger else 0.0], dtype=complex)
    roots = n * np.sqrt(squares)
    poles = np.column_stack((roots, -roots)).ravel()
    rounding = _ROUNDING * (max(moments) / min(moments)) ** 2
    return poles, float(min(pitch, c, b, b * b - 4.0 * c) / rounding)
