"""Observability of a linear model, with the names of the unobservable motions."""

from dataclasses import dataclass

import numpy as np

from fflin.analysis import mechanics
from fflin.analysis.hautus import split_by_poles, unobservable
from fflin.analysis.names import combination, undecided, unsettled, with_rates
from fflin.analysis.ranks import EPS, FixedPoles, Margin, Noisy, echelon, without_rounding
from fflin.base.tables import folded
from fflin.base.validation import Array, FrozenArrays, Values
from fflin.linear.model import LinearModel


@dataclass(frozen=True, eq=False)
class Observability(FrozenArrays):
    """Observability of a linear model; prints in words.

    Attributes
    ----------
    dimension : int
        nx minus the dimension of the unobservable subspace.
    unobservable : tuple of str
        Names of the unobservable motions; each is a state or a combination of states.
    basis : ndarray (nx, nx - dimension)
        Unobservable motions, one column each.
    rows : ndarray (dimension, nx)
        Observable combinations of states. The unobservable subspace is the set of all x with
        ``rows @ x = 0``.
    fixed_poles : ndarray (nx - dimension,)
        Poles of the estimation error that no observer can move: [1/s] for a continuous model,
        discrete-time poles z for a sampled one.
    detectable : bool
        Whether all fixed poles are stable.
    method : str
        Method that determined the dimension: "closed form" or "eigenvalues".
    margin : Margin
        Certainty of the rank decisions, as in `Controllability`.
    notes : tuple of str
        Ranks that rounding error leaves undecided.

    Examples
    --------
    >>> robot = fflin.load("cubesat", outputs=[fflin.Gyroscope("base")])
    >>> fflin.observability(fflin.linearize(robot)).unobservable[:3]
    ('q_b.x', 'q_b.y', 'q_b.z')
    """

    dimension: int
    unobservable: tuple[str, ...]
    basis: Array
    rows: Array
    fixed_poles: Values
    detectable: bool
    method: str
    margin: Margin
    notes: tuple[str, ...]
    robot: str

    def __str__(self) -> str:
        lines = [
            f"{self.robot}: {self.dimension} of {len(self.basis)} states are observable "
            f"({self.method}); {'' if self.detectable else 'not '}detectable"
        ]
        if self.unobservable:
            lines.append(f"unobservable: {with_rates(self.unobservable)}")
        lines += [f"note: {note}" for note in self.notes]
        return folded(lines)


def observability(lin: LinearModel) -> Observability:
    r"""Determine the observable subspace from C and the structure of A.

    At rest, observability is tested in second-order form, :math:`M a + D v + K s = 0`, by the null
    space of :math:`[p^2 M + p D + K; C_s + p C_v]` at each pole p. All poles p = 0 are tested
    together. At nonzero velocity, observability is tested as the controllability of the dual pair
    :math:`(A^T, C^T)`, with states scaled to units of energy, as in `controllability`. The
    unobservable subspace is the orthogonal complement of the controllable subspace of the dual
    pair.

    Parameters
    ----------
    lin : LinearModel
        Linear model: continuous or sampled, full or reduced. A model loaded from a file is also
        accepted.

    Returns
    -------
    Observability
        Dimension, basis, and named unobservable motions.

    Raises
    ------
    InputError
        If `lin` is not a linear model of positions and their rates.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.JointPositions()])
    >>> found = fflin.observability(fflin.linearize(robot))
    >>> found.dimension, found.detectable
    (6, False)
    """
    lin = mechanics.checked(lin)
    motions, fixed, method = _unobservable(lin)
    size = mechanics.state_sizes(lin)
    basis, _ = echelon(motions, size)
    nx, count = basis.shape
    complement = np.linalg.qr(basis * size[:, None], mode="complete")[0][:, count:]
    return Observability(
        dimension=nx - count,
        unobservable=tuple(combination(column, lin.state_names, size) for column in basis.T),
        basis=basis,
        rows=complement.T * size,
        fixed_poles=fixed.poles,
        detectable=fixed.decays,
        method=method,
        margin=fixed.margin,
        notes=(
            *undecided(lin, fixed.margin, "observable", nx - count),
            *unsettled(lin, fixed.settling, "detectable"),
        ),
        robot=lin.robot,
    )


def _unobservable(lin: LinearModel) -> tuple[Array, FixedPoles, str]:
    """Return the motions (nx, k) that the outputs miss, their poles, and the method."""
    source, nv = mechanics.at_rest(lin), len(lin.M)
    if source is not None:
        system = mechanics.second_order(source)
        N = mechanics.rates_of_positions(mechanics.rate_matrix(source))
        C = np.hstack((lin.C[:, :nv] @ N, lin.C[:, nv:]))
        size = np.tile(system.size, 2)
        each = np.linalg.norm(C / size, axis=1)
        units = np.where(each > 0.0, each, 1.0)
        shown = without_rounding(Noisy(C, 4.0 * EPS * np.abs(C)), units, size)
        position, velocity = shown.columns(slice(0, nv)), shown.columns(slice(nv, None))
        found = unobservable(system, position, velocity, lin.dt)
        if found is not None:
            motions = np.vstack((N @ found.motions[:nv], found.motions[nv:]))
            return motions, found.fixed, "eigenvalues" if system.acting else "closed form"
    # The uncontrollable subspace of the dual pair (A^T, C^T).
    part = split_by_poles(mechanics.rate_matrix(lin), lin.C.T, lin.M, lin.dt, dual=True)
    return part.outside, part.fixed, "eigenvalues"
