"""Which states the inputs of a linear model can move, and the names of those that they cannot."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import Any

import numpy as np

from fflin.analysis.mechanics import Conserved, Scaled, checked, conserved, scaled, slopes
from fflin.analysis.names import combination, grouped, momentum_names, with_rates
from fflin.analysis.ranks import Margin, echelon, reached_by, split, unit_columns
from fflin.analysis.vibrations import undamped_modes, vibration_rows
from fflin.base.tables import width
from fflin.base.validation import Array
from fflin.linear.model import LinearModel

# A defective pair of poles at zero moves by the square root of round-off.
_DECAY = 1e-7

_LOOPS = (
    "closed loops of the joints still turn the base of the nonlinear robot (a loop of amplitude "
    "e by O(e^2)); a linear model cannot show it"
)


@dataclass(frozen=True, eq=False)
class Controllability:
    """What the inputs of a linear model can move; prints in words.

    Attributes
    ----------
    dimension : int
        Of the controllable subspace.
    controllable : tuple of str
        ``dimension`` states that can be put anywhere; the others follow by `basis`.
    uncontrollable : tuple of str
        Names of the combinations of states that no input acts on.
    rows : ndarray (nx - dimension, nx)
        Those combinations: the controllable subspace is ``rows @ x = 0``.
    basis : ndarray (nx, dimension)
        Spans the controllable subspace; column i moves state ``controllable[i]`` by 1 and the
        other controllable ones not.
    fixed_poles : ndarray (nx - dimension,)
        Poles that no feedback can move [1/s], or of the sampled model.
    stabilizable : bool
        Whether all of these decay.
    reach : dict
        {"base attitude", "base position", "joints": directions in which it can be put anywhere
        while the others follow as they must}.
    method : str
        "closed form", "modes" or "eigenvalues": how the dimension was found.
    margin : Margin
        Distance of the rank decisions from doubt: far above 1, far below 1.
    notes : tuple of str
        What to know beside it.
    """

    dimension: int
    controllable: tuple[str, ...]
    uncontrollable: tuple[str, ...]
    rows: Array
    basis: Array
    fixed_poles: Any
    stabilizable: bool
    reach: dict[str, int]
    method: str
    margin: Margin
    notes: tuple[str, ...]
    robot: str

    def __post_init__(self) -> None:
        for array in (self.rows, self.basis, self.fixed_poles):
            array.setflags(write=False)

    def __str__(self) -> str:
        nx = len(self.basis)
        lines = [
            f"{self.robot}: {self.dimension} of {nx} states are controllable ({self.method}); "
            f"{'' if self.stabilizable else 'not '}stabilizable"
        ]
        if self.uncontrollable:
            lines.append(f"controllable: {with_rates(self.controllable)}")
            lines.append(f"uncontrollable: {', '.join(grouped(self.uncontrollable))}")
            placed = [f"{what} in {count}" for what, count in self.reach.items()]
            lines.append(f"directions that the inputs move: {', '.join(placed)}")
        lines += [f"note: {note}" for note in self.notes]
        return "\n".join(textwrap.fill(line, width(), subsequent_indent="  ") for line in lines)


def controllability(lin: LinearModel) -> Controllability:
    r"""Find what the inputs can move, from the structure of the model.

    About rest the momenta with :math:`W M [A_{21}, A_{22}, B_2] = 0` are conserved, and with the
    coordinates :math:`W M N^{-1} x_1` that they drive they are split off exactly. Without
    springs and dampers that is all: the dimension is 2 rank(B). With springs alone the rest is
    decided frequency by frequency on the modes of :math:`(K, M)`, equal frequencies together:
    :math:`2 \sum_g \mathrm{rank}(\Phi_g^T S)`. With dampers, off rest, or sampled with springs,
    it is decided at each eigenvalue by singular values of :math:`[A - s E, B]`, in units of
    energy (Popov, Belevitch, Hautus).

    Every rank is that of a matrix scaled by M, with inputs of unit length; the tolerances are
    small multiples of the rounding, and `margin` says how near the decisions came to them.
    Frequencies whose squares differ by less than 1e4 roundings are taken as equal. A sampled
    model is judged as it stands: sampling at a period of a vibration loses it.

    Parameters
    ----------
    lin : LinearModel
        Continuous or sampled, fresh, reduced, or loaded from a file.

    Returns
    -------
    Controllability

    Raises
    ------
    InputError
        If `lin` is no linear model of positions and their rates.

    Notes
    -----
    Inputs act in both directions: that a thruster only pushes is not considered. At a nonzero
    angular velocity the answer is that of the frozen model, which certifies nothing about the
    motion. Where the fastest pole is more than about 1e8 times the slowest that is not zero, as
    with a heavy damper on a light link, the slow ones are taken for rounding, as `margin` shows.

    References
    ----------
    P. C. Hughes and R. E. Skelton, Controllability and observability of linear matrix
    second-order systems, J. Applied Mechanics 47(2), 1980.
    """
    lin = checked(lin)
    X, held = slopes(lin), conserved(lin)
    z, B = held.selected, lin.B[held.selected]
    A, M = X[z] @ held.T, held.T[len(lin.M) :, len(held.kept) :]
    part = _split_kept(lin, A, B, M.T @ lin.M @ M, held)
    rows = np.vstack((held.momenta, held.coordinates, part.rows @ _selector(z, len(X))))
    names = (*momentum_names(lin, held), *part.names)
    size = _state_sizes(lin)
    spanned = held.T @ part.reached
    basis, pivots = echelon(spanned, size, _driven_states(lin))
    zero = np.full(2 * len(held.weights), 1.0 if lin.dt else 0.0)
    notes = _notes(lin, held, part)
    return Controllability(
        dimension=basis.shape[1],
        controllable=tuple(lin.state_names[i] for i in pivots),
        uncontrollable=names,
        rows=rows,
        basis=basis,
        fixed_poles=np.concatenate((zero, part.poles)),
        stabilizable=not len(zero) and part.decays,
        reach=_reach(lin, basis * size[:, None]),
        method=part.method,
        margin=held.margin & part.margin,
        notes=notes,
        robot=lin.robot,
    )


@dataclass(frozen=True)
class _Part:
    """The split of what is left without the conserved momenta, in its own coordinates."""

    reached: Array
    rows: Array
    names: tuple[str, ...]
    poles: Any
    decays: bool
    method: str
    margin: Margin


def _split_kept(lin: LinearModel, A: Array, B: Array, M: Array, held: Conserved) -> _Part:
    r = len(M)
    everything = np.eye(2 * r)
    if not A[r:].any():
        return _whole(everything, Margin())
    size = np.sqrt(M.diagonal())
    driven = unit_columns((M @ B[r:]) / size[:, None])
    image, _, margin = split(driven, 1e-9)
    if image.shape[1] == r and not lin.dt:
        return _whole(everything, margin)
    modes = None if lin.dt else undamped_modes(A, M)
    if modes is not None:
        found = modes.split(B[r:])
        rows, names, poles = vibration_rows(
            found, modes, tuple(np.array(lin.state_names)[held.selected])
        )
        return _Part(found.reached, rows, names, poles, not len(rows), "modes", found.margin)
    return _by_eigenvalues(lin, scaled(A, M, lin.dt), B, held)


def _whole(everything: Array, margin: Margin) -> _Part:
    none = everything[:0]
    return _Part(everything, none, (), np.zeros(0), True, "closed form", margin)


def _by_eigenvalues(lin: LinearModel, pair: Scaled, B: Array, held: Conserved) -> _Part:
    drive = unit_columns(pair.from_x @ B)
    reached, rest, F, margin = reached_by(pair.A, drive, pair.tolerance)
    names = tuple(np.array(lin.state_names)[held.selected])
    size = _state_sizes(lin)[held.selected]
    rows: Array = rest.T @ pair.from_x
    labels: tuple[str, ...] = ()
    if len(rows):
        echeloned, _ = echelon(rows.T, 1.0 / size)
        rows = echeloned.T
        labels = tuple(combination(row, names, 1.0 / size) for row in rows)
    rates = np.linalg.eigvals(F) if len(F) else np.zeros(0)
    decays = bool((rates.real < -_DECAY).all())
    poles = rates / pair.unit
    if lin.dt:
        poles = 1.0 + lin.dt * poles
        decays = bool((np.abs(poles) < 1.0 - _DECAY).all())
    return _Part(pair.to_x @ reached, rows, labels, poles, decays, "eigenvalues", margin)


def _selector(states: Array, nx: int) -> Array:
    selector: Array = np.zeros((len(states), nx))
    selector[np.arange(len(states)), states] = 1.0
    return selector


def _state_sizes(lin: LinearModel) -> Array:
    """Weights (nx,) that make states comparable: what a unit of each moves, by its inertia."""
    return np.tile(np.sqrt(lin.M.diagonal()), 2)


def _driven_states(lin: LinearModel) -> Array:
    """Return the states of coordinates that an input pushes on directly."""
    force = np.abs(lin.M @ lin.B[len(lin.M) :])
    rounding = (
        1e3 * len(lin.M) * np.finfo(float).eps * (np.abs(lin.M) @ np.abs(lin.B[len(lin.M) :]))
    )
    return np.tile((force > rounding).any(axis=1), 2)


def _reach(lin: LinearModel, weighted: Array) -> dict[str, int]:
    nv = len(lin.M)
    groups = [name.split(".", 1)[0] for name in lin.state_names[:nv]]
    titles = {"q_b": "base attitude", "r_b": "base position", "q_m": "joints"}
    reach = {}
    for group, title in titles.items():
        rows = [i for i, other in enumerate(groups) if other == group]
        if rows:
            reach[title] = split(unit_columns(weighted[rows]), 1e-8)[0].shape[1]
    return reach


def _notes(lin: LinearModel, held: Conserved, part: _Part) -> tuple[str, ...]:
    notes = []
    turned = any("angular momentum" in name for name in momentum_names(lin, held))
    if turned and any(lin.state_names[i].startswith("q_m.") for i in held.kept):
        notes.append(_LOOPS)
    if len(held.weights):
        notes.append("conserved momenta are split off by fflin.momentum_reduction")
    if not lin.is_equilibrium():
        notes.append("the point is not a fixed point: this speaks of the frozen A and B")
    margin = held.margin & part.margin
    if margin.kept < 1e2 or margin.dropped > 0.3:
        notes.append(
            f"a rank was a near decision: kept {margin.kept:.0e} and dropped {margin.dropped:.0e} "
            "times the tolerance"
        )
    return tuple(notes)
