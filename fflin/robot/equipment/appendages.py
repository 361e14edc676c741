r"""Flexible appendages and slosh of a link, modelled as bodies on passive joints.

An appendage with the rigid inertia :math:`M_{rr}` is clamped to a frame that moves with the twist
V. The appendage has k modes with the amplitudes :math:`\eta`, unit modal mass and the modal
participation L (6, k). Its kinetic energy is

.. math:: T = \tfrac12 V^T M_{rr} V + V^T L \dot\eta + \tfrac12 \dot\eta^T \dot\eta.

Each mode is modelled by a ball on a screw joint, see `fflin.robot.equipment.assembly` and (16.4) of
docs/derivation.md. The link and its balls together have the inertia in the URDF.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import pinocchio as pin

from fflin.base import html
from fflin.base.errors import InputError
from fflin.base.validation import (
    Array,
    FrozenArrays,
    as_double,
    number,
    quantity,
    shaped,
    truth,
)
from fflin.robot.inputs import Vector3, three_numbers, unit_vector

# First positive root x of J_1'(x) = 0, where J_1 is a Bessel function. The first lateral sloshing
# mode in a circular cylinder has the wavenumber x / radius.
_FIRST_ROOT = 1.8411837813406593
_FASTEST = 1e12  # [Hz]


@dataclass(frozen=True, eq=False, repr=False)
class FlexibleAppendage(html.Reported, FrozenArrays):
    r"""Flexible part of a link, such as a solar array, described by its modes when clamped.

    Each mode adds a coordinate to q_m, with the name NAME_mode_1, NAME_mode_2 and so on. The
    coordinate is the modal amplitude, in kg^0.5 m because the modal mass is 1. For a mode of
    angular frequency :math:`\omega` and damping ratio :math:`\zeta`, the coordinate has the
    stiffness :math:`\omega^2`, the damping :math:`2 \zeta \omega` and no motor. The link's inertia
    in the URDF must include the appendage as if it were rigid.

    At rest, A and B follow from frequencies and participation alone. If the link rotates at a rate
    w, forces of the order w^2 also depend on other integrals of the mode shapes. They are exact for
    a straight beam that bends in one direction, and approximate otherwise.

    Parameters
    ----------
    frame : str
        Frame of the model at which the appendage is clamped, on the base or on any link.
    frequency : float or sequence of float (k,)
        Frequencies [Hz] of the clamped appendage.
    translation : array_like (3, k)
        Modal participation in translation [kg^0.5]: the linear momentum of each mode for a unit
        modal rate, in the frame's axes. The square of an entry is the effective mass of the mode
        along this axis of the frame.
    rotation : array_like (3, k)
        Modal participation in rotation [kg^0.5 m]: the angular momentum of each mode about the
        frame's origin, for a unit modal rate.
    damping : float or sequence of float (k,)
        Damping ratios, from 0 to 1.
    name : str, optional
        Prefix of the names of the coordinates; the frame's name by default.

    Raises
    ------
    InputError
        If a shape is wrong, a value is not finite, a frequency is not positive, or a damping ratio
        is not between 0 and 1. `load` also raises the error if the participation L is too large for
        the rigid inertia :math:`M_{rr}` of the carrying body, because :math:`M_{rr} - L L^T` must
        be positive semidefinite.

    Examples
    --------
    >>> array = fflin.FlexibleAppendage(
    ...     "base", [0.3], [[0.0], [0.0], [2.0]], [[3.0], [0.0], [0.0]], name="array"
    ... )
    >>> robot = fflin.load("planar_detumble", appendages=[array])
    >>> robot.joint_names[-1], round(robot.stiffness["array_mode_1"], 3)
    ('array_mode_1', 3.553)
    """

    frame: str
    frequency: Any
    translation: Any
    rotation: Any
    damping: Any = 0.005
    name: str | None = None
    # Rigid inertia M_rr (6, 6) from a file, about the frame's origin, with translation before
    # rotation. If `rigid` is true, M_rr replaces the inertia of the link `frame`. If `frame` is not
    # a link, M_rr replaces the inertia of the whole body that carries the frame.
    inertia: Array | None = field(default=None, kw_only=True)
    rigid: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        _check_names(self.frame, self.name)
        label = f"flexible appendage '{self.frame}'"
        frequency = np.atleast_1d(as_double(f"frequency of {label}", self.frequency))
        damping = as_double(f"damping of {label}", self.damping)
        modes = frequency.size
        if frequency.ndim != 1 or not modes or damping.shape not in ((), (modes,)):
            raise InputError(
                f"frequency and damping of {label} have shapes {frequency.shape} and "
                f"{damping.shape}, expected k frequencies [Hz], and k damping ratios or one "
                "damping ratio for all"
            )
        damping = np.broadcast_to(damping, modes).copy()
        known = (
            (frequency > 0.0)
            & (frequency < _FASTEST)
            & (damping >= 0.0)
            & (damping <= 1.0)
        )
        for mode in np.flatnonzero(~known)[:1].tolist():
            raise InputError(
                f"mode {mode + 1} of {label} has the frequency {frequency[mode]:g} Hz and the "
                f"damping ratio {damping[mode]:g}, expected a frequency of more than 0 and less "
                f"than {_FASTEST:g} Hz, and a ratio from 0 to 1"
            )
        for name, unit in (("translation", "kg^0.5"), ("rotation", "kg^0.5 m")):
            hint = f": one column [{unit}] for each of the {modes} frequencies"
            value = shaped(f"{name} of {label}", getattr(self, name), (3, modes), hint)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "frequency", frequency)
        object.__setattr__(self, "damping", damping)
        super().__post_init__()

    @classmethod
    def from_nastran(
        cls,
        op4: object,
        asm: object,
        *,
        frame: str,
        origin: object = None,
        modes: int | None = None,
        length: str = "m",
        mass: str = "kg",
        damping: object = 0.005,
        name: str | None = None,
        rigid: bool = False,
    ) -> FlexibleAppendage:
        r"""Read a Craig-Bampton model that Nastran wrote as an external superelement.

        The boundary of the superelement is reduced to a rigid interface at `frame`. In the matrices
        of the file, the index b denotes the boundary, and the index q denotes the modes. With these
        matrices,

        - the participation is :math:`L = \Phi^T M_{bq} V`;
        - the rigid inertia is :math:`M_{rr} = \Phi^T M_{bb} \Phi`.

        :math:`\Phi` contains the rigid motions of the boundary, in the output coordinate systems of
        its grids. V contains the eigenvectors of :math:`K_{qq}, M_{qq}`, scaled to unit modal mass.

        Parameters
        ----------
        op4 : path
            Output4 file with the mass and stiffness matrix (mxx, maa or maax; kxx, kaa or kaax).
        asm : path
            Assembly file with the boundary grids and the points of the modes. A .pch file in the
            same folder defines which degrees of freedom of the grids belong to the boundary;
            without this file, all six do.
        frame : str
            Frame of the robot's model at the interface. Its axes must be parallel to the basic
            axes of the Nastran file.
        origin : sequence of float (3,), optional
            Position [m] of the frame's origin in the file's basic coordinates; by default the mean
            position of the boundary grids.
        modes : int, optional
            Number of modes to use, in the order of increasing frequency; all by default.
        length : {"m", "mm", "cm", "in", "ft"}
            Unit of length in the file.
        mass : {"kg", "g", "tonne", "lb", "slug", "lbf s^2/in"}
            Unit of mass in the file.
        damping, name
            See `FlexibleAppendage`.
        rigid : bool
            Whether the rigid inertia from the file replaces the URDF's inertia of the link that
            carries the frame. With False, a warning compares the two inertias if they differ by
            more than 1 %.

        Returns
        -------
        FlexibleAppendage

        Raises
        ------
        FileError
            If a file, or a file that it includes, is missing, too large or not a regular file.
        InputError
            If a file is truncated or not a Craig-Bampton model, or pyYeti is not installed (``pip
            install 'fflin[nastran]'``).
        UnknownNameError
            If a unit is unknown.
        """
        from fflin.robot.equipment.nastran import read_superelement

        frequency, L, inertia = read_superelement(
            op4, asm, origin=origin, modes=modes, length=length, mass=mass
        )
        return cls(
            frame, frequency, L[:3], L[3:], damping, name, inertia=inertia, rigid=rigid
        )

    @property
    def title(self) -> str:
        """Prefix of the names of the modes."""
        return self.name or self.frame

    @property
    def modes(self) -> tuple[str, ...]:
        """Names of the modes, which are coordinates of the robot."""
        return tuple(
            f"{self.title}_mode_{k}" for k in range(1, 1 + len(self.frequency))
        )

    @property
    def participation(self) -> Array:
        """Modal participation L (6, k): translation, then rotation about the frame's origin."""
        return np.vstack((self.translation, self.rotation))

    @property
    def springs(self) -> dict[str, dict[str, float]]:
        """Stiffness and damping of the modes, as {"stiffness": {mode: value}, "damping": ...}."""
        omega = 2.0 * math.pi * self.frequency
        values = {"stiffness": omega**2, "damping": 2.0 * self.damping * omega}
        return {
            key: dict(zip(self.modes, x.tolist(), strict=True))
            for key, x in values.items()
        }

    def __str__(self) -> str:
        from fflin.base.tables import grid

        squares = self.participation.T**2
        rows = [["mode", "f [Hz]", "damping", "m_x", "m_y", "m_z", "I_x", "I_y", "I_z"]]
        modes = zip(self.modes, self.frequency, self.damping, squares, strict=True)
        for mode, f, ratio, sizes in modes:
            rows.append(
                [mode, f"{f:.5g}", f"{ratio:.3g}", *(f"{x:.3g}" for x in sizes)]
            )
        sums = squares.sum(axis=0)
        head = f"{self.title}: clamped at frame '{self.frame}'"
        totals = {"all modes": sums}
        if self.inertia is not None:
            rigid, body = self.inertia.diagonal(), rigid_inertia(self.inertia)
            totals |= {"rigid": rigid, "residual": rigid - sums}
            at = ", ".join(f"{x:.4g}" for x in body.lever)
            head += f"\n{body.mass:.5g} kg, centre of mass ({at}) m in the frame"
        rows += [
            [name, "", "", *(f"{x:.4g}" for x in values)]
            for name, values in totals.items()
        ]
        about = (
            "effective masses m [kg] and moments of inertia I [kg m^2] about the frame"
        )
        return f"{head}\n{about}\n\n{grid(rows, 'l')}"


@dataclass(frozen=True, eq=False)
class Slosh:
    r"""Liquid that sloshes in a tank, modelled as a point mass that moves across the tank's axis.

    With `frequency`, the mass moves on springs, and its coordinates are the displacements NAME_x
    and NAME_y [m]. With `length`, the mass is a pendulum without springs, and its coordinates
    NAME_x and NAME_y are angles [rad]. The angular frequency of a pendulum of length l is
    :math:`\sqrt{a/l}` under an acceleration a along the axis, such as the acceleration by a
    thruster. To linearise about an accelerated motion, use ``linearize(..., moving=True)``. The
    link's inertia in the URDF must include the sloshing mass.

    Parameters
    ----------
    frame : str
        Frame of the model, on the base or on any link.
    mass : float
        Mass m [kg] that sloshes.
    position : sequence of float (3,)
        Position [m] of the mass at rest, in the axes of `frame`.
    frequency : float, optional
        Frequency [Hz] of the mass on its springs. If the mass is a pendulum, `frequency` does not
        affect its stiffness, but converts the damping ratio to a damping coefficient.
    length : float, optional
        Length l [m] of the pendulum, whose hinge is at `position` + l `axis`.
    axis : sequence of float (3,)
        Axis of the tank in the frame's axes, from the bottom of the tank upwards. The directions x
        and y of the coordinates are perpendicular to `axis`. Direction x is the projection of the
        frame's x axis; if the x axis is within 25.8 deg of the line along `axis`, direction x is
        the projection of the frame's y axis.
    damping : float
        Damping ratio, from 0 to 1.
    name : str, optional
        Prefix of the names of the coordinates; by default the frame's name, followed by "_slosh".

    Raises
    ------
    InputError
        If a number is not finite or out of range, or both frequency and length are missing.
        `load` also raises the error if the carrying body has less mass than the liquid.

    Examples
    --------
    >>> tank = fflin.Slosh("base", 20.0, (0, 0, 0.1), frequency=0.2, damping=0.01, name="tank")
    >>> fflin.load("planar_detumble", appendages=[tank]).joint_names[-2:]
    ('tank_x', 'tank_y')
    """

    frame: str
    mass: float
    position: Vector3
    frequency: float | None = None
    length: float | None = None
    axis: Vector3 = (0.0, 0.0, 1.0)
    damping: float = 0.0
    name: str | None = None

    def __post_init__(self) -> None:
        _check_names(self.frame, self.name)
        title = self.frame if self.name is None else self.name
        label = f"slosh '{title}'"
        for name, unit in (("mass", "kg"), ("frequency", "Hz"), ("length", "m")):
            value = getattr(self, name)
            if value is not None or name == "mass":
                object.__setattr__(
                    self, name, quantity(f"{name} of {label}", value, unit)
                )
        if self.frequency is None and self.length is None:
            raise InputError(
                f"{label} has neither a frequency nor a length; give the frequency [Hz] of a mass "
                "on springs, or the length [m] of a pendulum"
            )
        ratio = number(f"damping of {label}", self.damping)
        if not 0.0 <= ratio <= 1.0:
            raise InputError(
                f"damping of {label} is {ratio:g}, expected a ratio from 0 to 1"
            )
        if ratio and self.frequency is None:
            raise InputError(
                f"{label} has the damping ratio {ratio:g}, but without a frequency, because a "
                "pendulum oscillates only under an acceleration; give the frequency [Hz] to "
                "which the ratio refers"
            )
        position = three_numbers(f"position of {label}", self.position)
        axis = unit_vector(f"axis of {label}", self.axis)
        for name, checked in (
            ("damping", ratio),
            ("position", position),
            ("axis", axis),
        ):
            object.__setattr__(self, name, checked)

    @classmethod
    def cylinder(
        cls,
        frame: str,
        radius: float,
        height: float,
        density: float,
        acceleration: float,
        *,
        bottom: Vector3 = (0.0, 0.0, 0.0),
        axis: Vector3 = (0.0, 0.0, 1.0),
        pendulum: bool = True,
        damping: float = 0.0,
        name: str | None = None,
    ) -> Slosh:
        r"""Return the first lateral slosh mode of the liquid in an upright circular cylinder.

        Let m be the mass of the liquid, h its height, R the radius of the tank, a the acceleration,
        and k = 1.8412 / R. The angular frequency :math:`\omega`, the sloshing mass :math:`m_1` and
        the length l of the equivalent pendulum are

        .. math::
            \omega^2 = a k \tanh k h, \qquad
            \frac{m_1}{m} = \frac{2 \tanh k h}{k h\,(k^2 R^2 - 1)}, \qquad
            l = \frac{a}{\omega^2}.

        Both as a pendulum and on springs, the sloshing mass is at the depth :math:`\tfrac{2}{k}
        \tanh \tfrac{k h}{2}` below the surface (Dodge, The new dynamic behavior of liquids in
        moving containers, Southwest Research Institute 2000, chapter 3; NASA SP-106, chapter 6).

        Parameters
        ----------
        frame : str
            Frame of the model, on the base or on any link.
        radius, height : float
            Radius R of the tank and height h of the liquid [m].
        density : float
            Density of the liquid [kg/m^3].
        acceleration : float
            Acceleration a along the axis [m/s^2], such as thrust divided by mass.
        bottom : sequence of float (3,)
            Position [m] of the centre of the tank's bottom, in the axes of `frame`.
        axis : sequence of float (3,)
            Axis of the tank in the frame's axes, from the bottom of the tank upwards.
        pendulum : bool
            Whether the mass is a pendulum, whose frequency depends on the acceleration at the
            operating point. With False, the mass is on springs, and its frequency is always the
            frequency under `acceleration`.
        damping, name
            Parameters of `Slosh`. The damping ratio refers to the frequency under `acceleration`.

        Returns
        -------
        Slosh

        Raises
        ------
        InputError
            If a number is not finite or not positive.
        """
        sizes = {"radius": radius, "height": height, "density": density}
        for key, value in (sizes | {"acceleration": acceleration}).items():
            quantity(f"{key} of the tank", value)
        k = _FIRST_ROOT / radius
        along = unit_vector("axis of the tank", axis)
        liquid = density * math.pi * radius**2 * height
        share = 2.0 * math.tanh(k * height) / (k * height * (_FIRST_ROOT**2 - 1.0))
        omega = math.sqrt(acceleration * k * math.tanh(k * height))
        at = height - 2.0 / k * math.tanh(0.5 * k * height)
        center = np.array(three_numbers("bottom of the tank", bottom)) + at * np.array(
            along
        )
        position = tuple(center.tolist())
        frequency = omega / (2.0 * math.pi)
        length = None
        if truth("pendulum", pendulum):
            length = acceleration / omega**2
        return cls(
            frame, share * liquid, position, frequency, length, along, damping, name
        )

    @property
    def title(self) -> str:
        """Prefix of the names of the coordinates."""
        return self.name or f"{self.frame}_slosh"

    @property
    def modes(self) -> tuple[str, ...]:
        """Names of the two coordinates."""
        return f"{self.title}_x", f"{self.title}_y"

    @property
    def modal_mass(self) -> float:
        """Inertia of each coordinate while the tank is fixed.

        The value is the mass [kg] for a mass on springs, and the moment of inertia [kg m^2] for a
        pendulum.
        """
        return self.mass * (self.length or 1.0) ** 2

    @property
    def participation(self) -> Array:
        """Modal participation L (6, 2): translation, then rotation about the frame's origin."""
        t = math.sqrt(self.mass) * self.axes[:, :2]
        return np.vstack((t, np.cross(np.array(self.position), t, axisb=0, axisc=0)))

    @property
    def springs(self) -> dict[str, dict[str, float]]:
        """Stiffness and damping by coordinate, as {"stiffness": {name: value}, "damping": ...}."""
        omega = 2.0 * math.pi * (self.frequency or 0.0)
        stiffness = {}
        if self.length is None:
            stiffness = dict.fromkeys(self.modes, self.modal_mass * omega**2)
        damping = 2.0 * self.damping * self.modal_mass * omega
        return {"stiffness": stiffness, "damping": dict.fromkeys(self.modes, damping)}

    @property
    def axes(self) -> Array:
        """Unit vectors along direction x, direction y and the tank's axis, as columns (3, 3).

        The vectors are in the frame's axes.
        """
        z = np.array(self.axis)
        index = 0 if abs(z[0]) < 0.9 else 1
        near = np.eye(3)[index]
        x = near - (near @ z) * z
        x /= np.linalg.norm(x)
        return np.column_stack((x, np.cross(z, x), z))


Appendage: TypeAlias = FlexibleAppendage | Slosh


def rigid_inertia(M: Array) -> pin.Inertia:
    """Convert a rigid-body mass matrix (6, 6), with translation before rotation, to an inertia."""
    # Pinocchio's parameters are the mass, the mass times the centre of mass (x, y, z), and the
    # inertia about the origin in the order xx, xy, yy, xz, yz, zz.
    entries = M[[0, 1, 2, 0, 3, 3, 4, 3, 4, 5], [0, 5, 3, 4, 3, 4, 4, 5, 5, 5]]
    return pin.Inertia.FromDynamicParameters(entries)


def _check_names(frame: object, name: object) -> None:
    names = {"frame": frame}
    if name is not None:
        names["name"] = name
    for key, value in names.items():
        printable = isinstance(value, str) and value.strip() and value.isprintable()
        if not printable or (key == "name" and set(str(value)) & set("*?[]")):
            raise InputError(
                f"{key} of an appendage is {value!r}, expected a name without *?[]"
            )
