"""Which states the outputs of a linear model show."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import Any

import numpy as np

from fflin.analysis.mechanics import checked, scaled, slopes
from fflin.analysis.names import combination, with_rates
from fflin.analysis.ranks import EPS, Margin, echelon, reached_by, split, unit_columns
from fflin.base.tables import width
from fflin.base.validation import Array
from fflin.linear.model import LinearModel

# A defective pair of poles at zero moves by the square root of round-off.
_DECAY = 1e-7


@dataclass(frozen=True, eq=False)
class Observability:
    """What the outputs of a linear model show; prints in words.

    Attributes
    ----------
    dimension : int
        nx less the dimension of the unobservable subspace.
    unobservable : tuple of str
        Names of the motions that leave no trace in the outputs: a state, or several together.
    basis : ndarray (nx, nx - dimension)
        Those motions, a column each.
    rows : ndarray (dimension, nx)
        What can be told from the outputs: the unobservable subspace is ``rows @ x = 0``.
    fixed_poles : ndarray (nx - dimension,)
        Poles of the error that no observer can move [1/s], or of the sampled model.
    detectable : bool
        Whether all of these decay.
    method : str
        "closed form" or "eigenvalues": how the dimension was found.
    margin : Margin
        Distance of the rank decisions from doubt: far above 1, far below 1.
    """

    dimension: int
    unobservable: tuple[str, ...]
    basis: Array
    rows: Array
    fixed_poles: Any
    detectable: bool
    method: str
    margin: Margin
    robot: str

    def __post_init__(self) -> None:
        for array in (self.basis, self.rows, self.fixed_poles):
            array.setflags(write=False)

    def __str__(self) -> str:
        lines = [
            f"{self.robot}: {self.dimension} of {len(self.basis)} states are observable "
            f"({self.method}); {'' if self.detectable else 'not '}detectable"
        ]
        if self.unobservable:
            lines.append(f"unobservable: {with_rates(self.unobservable)}")
        return "\n".join(textwrap.fill(line, width(), subsequent_indent="  ") for line in lines)


def observability(lin: LinearModel) -> Observability:
    r"""Find what the outputs show, from C and the structure of A.

    About rest without springs and dampers :math:`A^2 = 0`, and the unobservable subspace is the
    kernel of :math:`[C; C A]`, which is one decision. Elsewhere it is the orthogonal complement
    of what the dual pair :math:`(A^T, C^T)` reaches, found eigenvalue by eigenvalue in units of
    energy, as in `controllability`.

    Parameters
    ----------
    lin : LinearModel
        Continuous or sampled, fresh, reduced, or loaded from a file.

    Returns
    -------
    Observability

    Raises
    ------
    InputError
        If `lin` is no linear model of positions and their rates.
    """
    lin = checked(lin)
    X = slopes(lin)
    pair = scaled(X, lin.M, lin.dt)
    seen = unit_columns((lin.C @ pair.to_x).T)
    nv = len(lin.M)
    if X[:nv, :nv].any() or X[nv:].any():
        reached, rest, F, margin = reached_by(pair.A.T, seen, pair.tolerance)
        method = "eigenvalues"
    else:
        drifted = unit_columns(_clean(pair.A.T @ seen))
        reached, rest, margin = split(np.hstack((seen, drifted)), pair.tolerance)
        F, method = rest.T @ pair.A.T @ rest, "closed form"
    size = np.tile(np.sqrt(lin.M.diagonal()), 2)
    basis, _ = echelon(pair.to_x @ rest, size)
    rates = np.linalg.eigvals(F) if len(F) else np.zeros(0)
    if method == "closed form":
        rates = np.zeros(len(F))
    poles = rates / pair.unit
    decays = bool((rates.real < -_DECAY).all())
    if lin.dt:
        poles = 1.0 + lin.dt * poles
        decays = bool((np.abs(poles) < 1.0 - _DECAY).all())
    return Observability(
        dimension=reached.shape[1],
        unobservable=tuple(combination(column, lin.state_names, size) for column in basis.T),
        basis=basis,
        rows=reached.T @ pair.from_x,
        fixed_poles=poles,
        detectable=decays,
        method=method,
        margin=margin,
        robot=lin.robot,
    )


def _clean(columns: Array) -> Array:
    """Put to zero the columns that are rounding of columns of unit length."""
    sizes = np.linalg.norm(columns, axis=0)
    return np.where(sizes > 1e2 * len(columns) * EPS, columns, 0.0)
