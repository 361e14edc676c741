"""Natural modes of a linear model: free-free frequencies, damping ratios, shapes."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.analysis.eigenpairs import natural_modes
from fflin.base.errors import InputError
from fflin.base.frozen import FrozenArrays
from fflin.base.tables import counted, grid, width
from fflin.base.validation import Array
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Mode(FrozenArrays):
    """One mode: a conjugate pair of poles, or a real pole.

    Attributes
    ----------
    pole : complex
        Eigenvalue of A [rad/s]; of a pair, the one with a positive imaginary part.
    shape : ndarray (nx,) of complex
        Eigenvector in the units of the state; of the positions the one that moves most is 1.
    unstable : bool
        Whether it grows, by more than rounding can explain.
    margin : float
        The real part of the pole as a multiple of its rounding; infinite where it has none.

    Examples
    --------
    >>> springs = {"panel_left": 100.0, "panel_right": 90.0}  # N m/rad
    >>> robot = fflin.load("servicer_7dof", stiffness=springs)
    >>> mode = fflin.modes(fflin.linearize(robot)).modes[0]
    >>> mode.unstable, mode.shape.shape
    (False, (30,))
    """

    pole: complex
    shape: NDArray[np.complexfloating[Any]]
    unstable: bool
    margin: float

    @property
    def oscillates(self) -> bool:
        """Whether it is a pair of poles."""
        return self.pole.imag > 0.0

    @property
    def frequency(self) -> float:
        """Natural frequency, the modulus of the pole [rad/s]."""
        return abs(self.pole)

    @property
    def damping_ratio(self) -> float:
        """Minus the cosine of the pole: 0 undamped, 1 for a real stable pole, negative unstable."""
        return 0.0 if self.pole.real == 0.0 else -self.pole.real / abs(self.pole)

    @property
    def time_constant(self) -> float:
        """Time in which it decays to, or where it is unstable grows by, 1/e or e [s]."""
        return float("inf") if self.pole.real == 0.0 else 1.0 / abs(self.pole.real)


@dataclass(frozen=True, eq=False)
class Modes:
    """Natural modes of a linear model; prints as a table.

    Attributes
    ----------
    modes : tuple of Mode
        All but those of the eigenvalue zero, by frequency.
    rigid_body : int
        Independent displacements that nothing opposes: rigid-body modes.
    zero_eigenvalues : int
        How many eigenvalues are zero; a rigid-body mode without friction has two.
    residual : float
        Largest ``|A x - pole x|`` relative to ``|A| |x|``, in states scaled to unit inertias and to
        the time of the fastest motion.
    equilibrium : bool
        Whether the point is a fixed point or a relative equilibrium; elsewhere the eigenvalues
        are those of a frozen model and say nothing about stability.
    state_names, state_units : tuple of str
        Of the shapes.
    robot : str
    lin : LinearModel
        What they are modes of.

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
        """The modes that grow."""
        return tuple(mode for mode in self.modes if mode.unstable)

    @property
    def notes(self) -> tuple[str, ...]:
        """Modes of which rounding decides whether they grow or decay."""
        return tuple(
            f"undecided: whether the mode at {mode.frequency:.4g} rad/s grows or decays; its real "
            f"part is {mode.margin:.1g} times its rounding"
            for mode in self.modes
            if 0.1 < abs(mode.margin) < 10.0
        )

    @property
    def poles(self) -> NDArray[np.complexfloating[Any]]:
        """All nx eigenvalues of A, with the zeros and the conjugates."""
        listed = [0j] * self.zero_eigenvalues
        for mode in self.modes:
            listed += [mode.pole, mode.pole.conjugate()] if mode.oscillates else [mode.pole]
        return np.array(listed)

    def __str__(self) -> str:
        """Show how many are rigid, and a table of the others with what moves most."""
        vibrations, others = len(self.vibrations), len(self.modes) - len(self.vibrations)
        head = (
            f"{self.robot}: {counted(self.rigid_body, 'rigid-body mode')} "
            f"({counted(self.zero_eigenvalues, 'eigenvalue')} at zero), "
            f"{counted(vibrations, 'vibration')}"
        )
        head += f", {counted(others, 'real pole')}" if others else ""
        if not self.equilibrium:
            head += "; not an equilibrium, where eigenvalues are those of a frozen model"
        said = [head]
        if self.unstable:
            poles = ", ".join(f"{mode.pole:.5g}" for mode in self.unstable)
            said.append(f"unstable: poles with a positive real part {poles}")
        said += [f"note: {note}" for note in self.notes]
        parts = [textwrap.fill(each, width()) for each in said]
        rows = [["rad/s", "damping", "time [s]", "", "what moves"]]
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
            row[-1] = _moving_most(mode, self.state_names, width() - left)
        if self.modes:
            parts.append(grid(rows, "rrrll"))
        return "\n\n".join(parts)


def modes(lin: LinearModel) -> Modes:
    r"""Find the natural modes of a linear model.

    At rest, with symmetric stiffness and nothing else, those of the free-floating structure:

    .. math::
        K \phi = \omega^2 M^* \phi, \qquad M^* = ((M^{-1})_{EE})^{-1},

    over the coordinates E that the stiffness K acts on; M* is the inertia that they feel while
    all others float, the Schur complement of M. Elsewhere the eigenvalues of A, of which those at
    zero, in Jordan blocks of two and more, are split off exactly.

    Parameters
    ----------
    lin : LinearModel
        In continuous time; fresh, loaded from a file, or reduced.

    Returns
    -------
    Modes

    Raises
    ------
    InputError
        If the model is sampled, or its states are not positions and then as many velocities.

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
    if lin.dt:
        raise InputError(f"the model is sampled at dt = {lin.dt:g} s; give the continuous one")
    nx, nv = len(lin.A), len(lin.M)
    if nx != 2 * nv:
        raise InputError(f"the model has {nx} states, expected {nv} positions and their velocities")
    found = natural_modes(lin)
    triples = sorted(found.triples, key=lambda triple: (abs(triple[0]), triple[0].real))
    return Modes(
        tuple(Mode(pole, _normalised(x), margin > 1.0, margin) for pole, x, margin in triples),
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


def _moving_most(mode: Mode, names: Sequence[str], room: int) -> str:
    """Name the positions that move by a tenth of the most or more, or say how many are left out."""
    shape = mode.shape[: len(names) // 2]
    sizes = abs(shape)
    order = [i for i in (-sizes.round(9)).argsort(kind="stable").tolist() if sizes[i] >= 0.1]
    words = [f"{names[i]} {_amount(complex(shape[i]))}" for i in order]
    for count in range(len(words), 0, -1):
        left = f"; + {len(words) - count} more" if count < len(words) else ""
        text = ", ".join(words[:count]) + left
        if len(text) <= room:
            break
    return text


def _amount(value: complex) -> str:
    if abs(value.imag) <= 0.02 * abs(value):  # an angle of a degree
        return f"{value.real:.2g}"
    angle = math.degrees(math.atan2(value.imag, value.real))
    return f"{abs(value):.2g} at {angle:.0f} deg"
