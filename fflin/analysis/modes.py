"""Natural modes of a linear model: free-free frequencies, damping ratios, shapes."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.analysis.eigenpairs import natural_modes
from fflin.analysis.modal_energy import energy_by_body
from fflin.base.errors import InputError
from fflin.base.frozen import FrozenArrays
from fflin.base.tables import counted, grid, width
from fflin.base.validation import Array
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Mode(FrozenArrays):
    r"""Natural mode: a conjugate pair of poles, or a real pole.

    Attributes
    ----------
    pole : complex
        Eigenvalue of A [rad/s]; for a pair, the eigenvalue with positive imaginary part.
    shape : ndarray (nx,) of complex
        Eigenvector in the units of the state, scaled so that the largest position entry is 1.
    unstable : bool
        Whether the real part of the pole is positive by more than its rounding error.
    margin : float
        Real part of the pole as a multiple of its rounding error; infinite if that error is zero.
    energy : mapping of str to float
        Fraction of the mode's kinetic energy in each body, the largest first. The fractions are
        nonnegative and sum to 1. A body is named after the joint that carries it; the root body is
        "base". Empty for a model loaded from a file, which lacks the bodies.

    Notes
    -----
    With the complex twist :math:`V_i` of body i in the mode and its spatial inertia
    :math:`I_i`, the fraction of the energy, averaged over a period, is

    .. math::
        e_i = \frac{V_i^H I_i V_i}{\sum_k V_k^H I_k V_k}.

    The twists are relative to the reference frame. If the robot floats freely from rest, a mode has
    no momentum, and the fractions do not depend on which link is the base. The fraction :math:`e_i`
    is never negative, unlike the product :math:`\phi_i (M \phi)_i` for one coordinate.

    Examples
    --------
    >>> springs = {"panel_left": 100.0, "panel_right": 90.0}  # N m/rad
    >>> robot = fflin.load("servicer_7dof", stiffness=springs)
    >>> mode = fflin.modes(fflin.linearize(robot)).modes[0]
    >>> mode.unstable, mode.shape.shape
    (False, (30,))
    >>> list(mode.energy)[:2]
    ['panel_right', 'panel_left']
    """

    pole: complex
    shape: NDArray[np.complexfloating[Any]]
    unstable: bool
    margin: float
    energy: Mapping[str, float]

    @property
    def oscillates(self) -> bool:
        """Whether the mode is a conjugate pair of poles."""
        return self.pole.imag > 0.0

    @property
    def frequency(self) -> float:
        """Natural frequency [rad/s], the modulus of the pole."""
        return abs(self.pole)

    @property
    def damping_ratio(self) -> float:
        """Damping ratio -Re(p)/abs(p): 0 undamped, 1 for a real stable pole, negative unstable."""
        return 0.0 if self.pole.real == 0.0 else -self.pole.real / abs(self.pole)

    @property
    def time_constant(self) -> float:
        """Time constant [s] in which the mode decays to 1/e, or grows by e if it is unstable."""
        return float("inf") if self.pole.real == 0.0 else 1.0 / abs(self.pole.real)


@dataclass(frozen=True, eq=False)
class Modes:
    """Natural modes of a linear model; prints as a table.

    Attributes
    ----------
    modes : tuple of Mode
        Modes with nonzero eigenvalues, in ascending order of frequency.
    rigid_body : int
        Number of rigid-body modes: independent displacements without a restoring force.
    zero_eigenvalues : int
        Number of zero eigenvalues; a rigid-body mode without friction has two.
    residual : float
        Largest ``|A x - pole x|`` relative to ``|A| |x|``. The states are scaled to unit inertias
        and to the time of the fastest motion.
    equilibrium : bool
        Whether the operating point is an equilibrium or a relative equilibrium. If False, the
        eigenvalues describe the model frozen at this point and do not decide its stability.
    state_names, state_units : tuple of str
        Names and units of the entries of the shapes.
    robot : str
        Name of the robot.
    lin : LinearModel
        The analysed model.

    Examples
    --------
    >>> springs = {"panel_left": 100.0, "panel_right": 90.0}  # N m/rad
    >>> robot = fflin.load("servicer_7dof", stiffness=springs)
    >>> found = fflin.modes(fflin.linearize(robot))
    >>> found.damping_ratios.round(6), found.equilibrium
    (array([0., 0.]), True)
    """

    modes: tuple[Mode, ...]
    rigid_body: int
    zero_eigenvalues: int
    residual: float
    equilibrium: bool
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    robot: str
    lin: LinearModel

    @property
    def vibrations(self) -> tuple[Mode, ...]:
        """The modes that oscillate."""
        return tuple(mode for mode in self.modes if mode.oscillates)

    @property
    def frequencies(self) -> Array:
        """Natural frequencies [rad/s] of the modes that oscillate, ascending."""
        return np.array([mode.frequency for mode in self.vibrations])

    @property
    def damping_ratios(self) -> Array:
        """Damping ratios of the modes that oscillate, in the order of `frequencies`."""
        return np.array([mode.damping_ratio for mode in self.vibrations])

    @property
    def unstable(self) -> tuple[Mode, ...]:
        """The unstable modes."""
        return tuple(mode for mode in self.modes if mode.unstable)

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on missing data, and on modes whose stability is undecided due to rounding."""
        undecided = tuple(
            f"undecided: whether the mode at {mode.frequency:.4g} rad/s grows or decays; its real "
            f"part is {mode.margin:.1g} times its rounding error"
            for mode in self.modes
            if 0.1 < abs(mode.margin) < 10.0
        )
        if not self.modes or self.modes[0].energy:
            return undecided
        return (*undecided, "a model from a file lacks the kinetic energies of the bodies")

    @property
    def poles(self) -> NDArray[np.complexfloating[Any]]:
        """All nx eigenvalues of A [rad/s], including zeros and conjugates."""
        listed = [0j] * self.zero_eigenvalues
        for mode in self.modes:
            listed += [mode.pole, mode.pole.conjugate()] if mode.oscillates else [mode.pole]
        return np.array(listed)

    def __str__(self) -> str:
        """Show how many are rigid, and a table of the others with the bodies that move most."""
        vibrations, others = len(self.vibrations), len(self.modes) - len(self.vibrations)
        head = (
            f"{self.robot}: {counted(self.rigid_body, 'rigid-body mode')} "
            f"({counted(self.zero_eigenvalues, 'eigenvalue')} at zero), "
            f"{counted(vibrations, 'vibration')}"
        )
        head += f", {counted(others, 'real pole')}" if others else ""
        if not self.equilibrium:
            head += "; not an equilibrium: eigenvalues of a frozen model do not show stability"
        said = [head]
        if self.unstable:
            poles = ", ".join(f"{mode.pole:.5g}" for mode in self.unstable)
            said.append(f"unstable: poles with a positive real part {poles}")
        said += [f"note: {note}" for note in self.notes]
        parts = [textwrap.fill(each, width()) for each in said]
        rows = [["rad/s", "damping", "time [s]", "", "kinetic energy"]]
        rows += [
            [
                f"{mode.frequency:.6g}" if mode.oscillates else ".",
                f"{mode.damping_ratio:.4g}" if mode.oscillates else ".",
                f"{mode.time_constant:.4g}" if mode.pole.real else ".",
                "unstable" if mode.unstable else "",
                "",
            ]
            for mode in self.modes
        ]
        left = max(map(len, grid(rows, "rrrll").splitlines())) - len(rows[0][-1])
        for row, mode in zip(rows[1:], self.modes, strict=True):
            row[-1] = _percents(mode.energy, width() - left)
        if self.modes:
            parts.append(grid(rows, "rrrll"))
        return "\n\n".join(parts)


def modes(lin: LinearModel) -> Modes:
    r"""Compute the natural modes of a linear model.

    At rest, if a symmetric stiffness is the only force, these are the modes of the free-floating
    structure:

    .. math::
        K \phi = \omega^2 M^* \phi, \qquad M^* = ((M^{-1})_{EE})^{-1},

    over the coordinates E on which the stiffness K acts. M* is a Schur complement of M: the
    effective inertia of the coordinates E if all other coordinates are free to move. In all other
    cases the modes are the eigenvectors of A. The zero eigenvalues form Jordan blocks of size two
    or more. They are separated exactly from the other eigenvalues.

    Parameters
    ----------
    lin : LinearModel
        Continuous-time model, full or reduced. A model loaded from a file is also accepted.

    Returns
    -------
    Modes
        Modes, poles and numbers of rigid-body modes and zero eigenvalues.

    Raises
    ------
    InputError
        If the model is sampled, or its states are not positions followed by their velocities.
    ModelError
        If the robot's model was changed after the linear model was made.

    References
    ----------
    P. C. Hughes, Spacecraft Attitude Dynamics, 1986, on unconstrained modes. V. Kublanovskaya,
    USSR Computational Mathematics and Mathematical Physics 6(4), 1966, on Jordan blocks.

    Examples
    --------
    >>> springs = {"panel_left": 100.0, "panel_right": 90.0}  # N m/rad
    >>> robot = fflin.load("servicer_7dof", stiffness=springs)
    >>> found = fflin.modes(fflin.linearize(robot))
    >>> found.rigid_body, found.frequencies.round(1)
    (13, array([0.9, 1.2]))
    """
    if not isinstance(lin, LinearModel):
        raise InputError(f"lin is a {type(lin).__name__}, expected a fflin.LinearModel")
    lin.require_unchanged()
    if lin.dt:
        raise InputError(f"the model is sampled at dt = {lin.dt:g} s; give the continuous model")
    nx, nv = len(lin.A), len(lin.M)
    if nx != 2 * nv:
        raise InputError(f"the model has {nx} states, expected {nv} positions and their velocities")
    found = natural_modes(lin)
    triples = sorted(found.triples, key=lambda triple: (abs(triple[0]), triple[0].real))
    shapes = [_normalised(x) for _, x, _ in triples]
    energies = energy_by_body(lin._robot, lin, shapes)
    return Modes(
        tuple(
            Mode(pole, shape, margin > 1.0, margin, energy)
            for (pole, _, margin), shape, energy in zip(triples, shapes, energies, strict=True)
        ),
        found.rigid_body,
        found.zeros,
        found.residual,
        lin.is_equilibrium(),
        lin.state_names,
        lin.state_units,
        lin.robot,
        lin,
    )


def _normalised(shape: Array) -> NDArray[np.complexfloating[Any]]:
    positions = np.abs(shape[: len(shape) // 2])
    # Of several that move equally, such as symmetric panels, the first.
    largest = int(np.flatnonzero(positions >= (1.0 - 1e-9) * positions.max())[0])
    return np.asarray(shape / shape[largest], dtype=complex)


def _percents(energy: Mapping[str, float], room: int) -> str:
    """Name the bodies with 1 % of the energy or more, and sum up those that are left out."""
    words = [f"{body} {100.0 * part:.0f} %" for body, part in energy.items() if part >= 0.01]
    text = ""
    for count in range(len(words), 0, -1):
        left = sum(list(energy.values())[count:])
        others = f"; + {len(energy) - count} more {100.0 * left:.0f} %" if left >= 0.005 else ""
        text = ", ".join(words[:count]) + others
        if len(text) <= room:
            break
    return text
