"""Natural modes of a linear model: free-free frequencies, damping ratios, shapes."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.analysis.zero_eigenvalues import nonzero_eigenpairs
from fflin.base.errors import InputError
from fflin.base.tables import counted, grid, width
from fflin.base.validation import Array
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    from numpy.typing import NDArray

_EPS = float(np.finfo(float).eps)

# A stiffness this far below the largest, both scaled to unit inertias, is taken for none: modes
# of less than 3e-7 of the highest frequency count as rigid.
_NO_STIFFNESS = 1e-13


@dataclass(frozen=True, eq=False)
class Mode:
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
    """

    pole: complex
    shape: NDArray[np.complexfloating[Any]]
    unstable: bool
    margin: float

    def __post_init__(self) -> None:
        self.shape.setflags(write=False)

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
    state_names : tuple of str
        Of the shapes.
    robot : str
    """

    modes: tuple[Mode, ...]
    rigid_body: int
    zero_eigenvalues: int
    residual: float
    equilibrium: bool
    state_names: tuple[str, ...]
    robot: str

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
        """Of which modes it hangs on rounding whether they grow or decay."""
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
        return modes_report(self)


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
    """
    if not isinstance(lin, LinearModel):
        raise InputError(f"lin is a {type(lin).__name__}, expected a fflin.LinearModel")
    if lin.dt:
        raise InputError(f"the model is sampled at dt = {lin.dt:g} s; give the continuous one")
    nx, nv = len(lin.A), len(lin.M)
    if nx != 2 * nv:
        raise InputError(f"the model has {nx} states, expected {nv} positions and their velocities")
    inertia = np.sqrt(lin.M.diagonal())
    A = _significant(lin)
    weight, fastest = _scales(A, inertia)
    found = _free_free(A, lin.M, inertia)
    if found is None:
        found = _general(A, weight, fastest)
    triples, rigid_body, zeros = found
    triples.sort(key=lambda triple: (abs(triple[0]), triple[0].real))
    residual = 0.0
    for pole, shape, _ in triples:
        left = weight * (A @ shape - pole * shape) / fastest
        residual = max(residual, float(np.linalg.norm(left) / np.linalg.norm(weight * shape)))
    return Modes(
        tuple(
            Mode(pole, _normalised(shape), margin > 1.0, margin) for pole, shape, margin in triples
        ),
        rigid_body,
        zeros,
        residual,
        lin.is_equilibrium(),
        lin.state_names,
        lin.robot,
    )


# A pole, its shape, and its real part as a multiple of rounding.
_Found = tuple[list[tuple[complex, Any, float]], int, int]


def _significant(lin: LinearModel) -> Array:
    """Return A without slopes that are the rounding of inputs that cancel each other."""
    nv, A = len(lin.M), lin.A.copy()
    slopes = A[nv:, :nv]
    pushed = np.abs(lin.B[nv:]) @ np.abs(lin.u0)
    slopes[np.abs(slopes) <= 1e2 * _EPS * pushed[:, None]] = 0.0
    return A


def _free_free(A: Array, M: Array, inertia: Array) -> _Found | None:
    """Return the modes of a body at rest with symmetric stiffness; None for any other model."""
    from scipy.linalg import eigh

    nv = len(M)
    N, slope = A[:nv, nv:], A[nv:, :nv] @ A[:nv, nv:]
    if A[:nv, :nv].any() or A[nv:, nv:].any():
        return None
    # Over s with p = N s, ds/dt = nu; scaled to a unit diagonal of M.
    unit = M / np.outer(inertia, inertia)
    by_s = slope * inertia[:, None] / inertia
    K = -unit @ by_s
    size = float(np.abs(K).max(initial=0.0))
    rounding = 1e2 * _EPS * float(np.linalg.cond(unit))
    if not np.abs(K - K.T).max(initial=0.0) <= rounding * size:
        return None
    felt = np.flatnonzero(by_s.any(axis=0))
    if not felt.size:
        return [], nv, 2 * nv
    free = np.setdiff1d(np.arange(nv), felt)
    across = unit[np.ix_(free, felt)]
    M_star = unit[np.ix_(felt, felt)] - across.T @ np.linalg.solve(unit[np.ix_(free, free)], across)
    K = -M_star @ by_s[np.ix_(felt, felt)]
    squares, vectors = eigh((K + K.T) / 2.0, (M_star + M_star.T) / 2.0)
    squares, vectors = _polished(by_s[np.ix_(felt, felt)], squares, vectors)
    found: list[tuple[complex, Any, float]] = []
    for square, vector in zip(squares.tolist(), vectors.T, strict=True):
        if abs(square) <= _NO_STIFFNESS * len(felt) * float(np.abs(squares).max()):
            continue
        # All that floats follows: -omega^2 s = (d nudot/ds) s, of any size.
        s = by_s[:, felt] @ vector / inertia
        root = abs(square) ** 0.5
        for pole in [1j * root] if square > 0.0 else [complex(root), complex(-root)]:
            shape = np.concatenate((N @ s, pole * s))
            found.append((pole, shape, math.copysign(math.inf, pole.real) if pole.real else 0.0))
    counted = sum(2 if pole.imag else 1 for pole, *_ in found)
    return found, nv - counted // 2, 2 * nv - counted


def _polished(by_s: Array, squares: Array, vectors: Array) -> tuple[Array, Array]:
    """Return the pairs of -by_s, after one Newton step from those of its symmetric pencil.

    The Schur complement rounds by the conditioning of M, A itself is right to the last digits.
    """
    defect = -np.linalg.solve(vectors, by_s @ vectors) - np.diag(squares)
    gaps = squares - squares[:, None]
    # Equal ones stay as they are: any of their combinations will do.
    apart = np.abs(defect) < 1e-3 * np.abs(gaps)
    mixed = np.divide(defect, gaps, out=np.zeros_like(defect), where=apart)
    return squares + defect.diagonal(), vectors + vectors @ mixed


def _scales(A: Array, inertia: Array) -> tuple[Array, float]:
    """Return weights of the states and a rate, over which the entries of A are of order 1.

    Velocities are weighed by sqrt(M_ii), and positions by the rate as well.
    """
    nv = len(inertia)
    rates = np.abs(np.tile(inertia, 2)[:, None] * A / np.tile(inertia, 2))
    turning = max(float(rates[nv:, nv:].max()), float(rates[:nv, :nv].max()))
    fastest = max(float(rates[nv:, :nv].max()) ** 0.5, turning) or 1.0
    return np.concatenate((fastest * inertia, inertia)), fastest


def _general(A: Array, weight: Array, fastest: float) -> _Found:
    """Return the modes of any model, by the eigenvalues of A."""
    scaled = weight[:, None] * A / weight / fastest
    found, nullity = nonzero_eigenpairs(scaled, _NO_STIFFNESS)
    listed: list[tuple[complex, Any, float]] = []
    for pole, vector, error in found:
        if pole.imag < 0.0:
            continue
        real = 0.0 if abs(pole.real) <= error and pole.imag else pole.real
        value = complex(real, pole.imag) * fastest
        listed.append((value, vector / weight, pole.real / error))
    return listed, nullity, len(weight) - len(found)


def _normalised(shape: Array) -> NDArray[np.complexfloating[Any]]:
    positions = np.abs(shape[: len(shape) // 2])
    # Of equals, such as two panels in symmetry, the first.
    largest = int(np.flatnonzero(positions >= (1.0 - 1e-9) * positions.max())[0])
    return np.asarray(shape / shape[largest], dtype=complex)


def modes_report(found: Modes) -> str:
    """Show natural modes: how many are rigid, and a table of the others with what moves most."""
    vibrations, others = len(found.vibrations), len(found.modes) - len(found.vibrations)
    head = (
        f"{found.robot}: {counted(found.rigid_body, 'rigid-body mode')} "
        f"({counted(found.zero_eigenvalues, 'eigenvalue')} at zero), "
        f"{counted(vibrations, 'vibration')}"
    )
    head += f", {counted(others, 'real pole')}" if others else ""
    if not found.equilibrium:
        head += "; not an equilibrium, where eigenvalues are those of a frozen model"
    parts = [textwrap.fill(head, width())]
    if found.unstable:
        poles = ", ".join(f"{mode.pole:.5g}" for mode in found.unstable)
        parts.append(textwrap.fill(f"unstable: poles with a positive real part {poles}", width()))
    parts += [textwrap.fill(f"note: {note}", width()) for note in found.notes]
    rows = [["rad/s", "damping", "time [s]", "", "what moves"]]
    rows += [
        [
            f"{mode.frequency:.6g}" if mode.oscillates else ".",
            f"{mode.damping_ratio:.4g}" if mode.oscillates else ".",
            f"{mode.time_constant:.4g}" if mode.pole.real else ".",
            "unstable" if mode.unstable else "",
            "",
        ]
        for mode in found.modes
    ]
    left = max(map(len, grid(rows, "rrrll").splitlines())) - len(rows[0][-1])
    for row, mode in zip(rows[1:], found.modes, strict=True):
        row[-1] = _moving_most(mode, found.state_names, width() - left)
    if found.modes:
        parts.append(grid(rows, "rrrll"))
    return "\n\n".join(parts)


def _moving_most(mode: Mode, names: Sequence[str], room: int) -> str:
    """Name the positions that move most in a mode, as many as there is room for."""
    shape = mode.shape[: len(names) // 2]
    sizes = abs(shape)
    text = ""
    for i in (-sizes.round(9)).argsort(kind="stable").tolist():
        value = complex(shape[i])
        if abs(value) < 0.1:
            break
        amount = f"{value.real:.2g}"
        if abs(value.imag) > 0.02 * abs(value):  # an angle of more than a degree
            angle = math.degrees(math.atan2(value.imag, value.real))
            amount = f"{abs(value):.2g} at {angle:.0f} deg"
        longer = f"{text}, {names[i]} {amount}" if text else f"{names[i]} {amount}"
        if text and len(longer) > room:
            break
        text = longer
    return text
