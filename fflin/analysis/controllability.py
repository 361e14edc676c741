"""Controllability of a linear model, with the names of the uncontrollable states."""

from dataclasses import dataclass

import numpy as np

from fflin.analysis import mechanics
from fflin.analysis.hautus import split_by_poles, unobservable
from fflin.analysis.mechanics import ConservedMomenta, combination
from fflin.analysis.ranks import (
    FixedPoles,
    Margin,
    Noisy,
    echelon,
    image,
    null_space,
    unit_columns,
)
from fflin.base.tables import folded
from fflin.base.validation import Array, FrozenArrays, Values
from fflin.linear.model import LinearModel

_LOOPS = (
    "a periodic joint motion can still rotate the base of the nonlinear robot, by O(e^2) for a "
    "joint amplitude e, although the linear model does not show it"
)


@dataclass(frozen=True, eq=False)
class Controllability(FrozenArrays):
    """Controllability of a linear model; ``print`` shows a summary.

    Attributes
    ----------
    dimension : int
        Dimension of the controllable subspace.
    controllable : tuple of str
        Names of states that the inputs can set independently; there are `dimension` of them. Within
        the controllable subspace, their values determine the whole state, ``x = basis @ values``.
    uncontrollable : tuple of str
        Names of the uncontrollable combinations of states.
    rows : ndarray (nx - dimension, nx)
        Coefficients of the uncontrollable combinations, one row for each. The controllable subspace
        is the set of all x with ``rows @ x = 0``.
    basis : ndarray (nx, dimension)
        Basis of the controllable subspace. Column i is the state in which ``controllable[i]`` is 1
        and the other states named in `controllable` are 0.
    fixed_poles : ndarray (nx - dimension,)
        Poles that no feedback can move: [1/s] for a continuous model, discrete-time poles z for a
        sampled one.
    stabilizable : bool
        Whether all fixed poles are stable.
    reach : dict
        Numbers of independent directions that the inputs can control, with the keys
        ``"base attitude"``, ``"base position"`` and ``"joints"``. The inputs can bring the position
        states to any value along these directions, if the final values of all other states are left
        free.
    method : str
        Method that determined the dimension: "closed form", "modes" or "eigenvalues".
    margin : Margin
        Certainty of the rank decisions, as two ratios: the smallest singular value counted as
        nonzero, divided by its tolerance, and the largest singular value counted as zero, divided
        by its tolerance. The decisions are certain if the first ratio is far above 1 and the second
        ratio is far below 1.
    notes : tuple of str
        Remarks on the result, such as ranks that rounding error leaves undecided.

    Examples
    --------
    >>> robot = fflin.load("cubesat", inputs=[fflin.BaseTorque()])
    >>> found = fflin.controllability(fflin.linearize(robot))
    >>> found.controllable[:3], found.uncontrollable[:2]
    (('q_b.x', 'q_b.y', 'q_b.z'), ('linear momentum x', 'linear momentum y'))
    """

    dimension: int
    controllable: tuple[str, ...]
    uncontrollable: tuple[str, ...]
    rows: Array
    basis: Array
    fixed_poles: Values
    stabilizable: bool
    reach: dict[str, int]
    method: str
    margin: Margin
    notes: tuple[str, ...]
    robot: str

    def __str__(self) -> str:
        nx = len(self.basis)
        lines = [
            f"{self.robot}: {self.dimension} of {nx} states are controllable ({self.method}); "
            f"{'' if self.stabilizable else 'not '}stabilizable"
        ]
        if self.uncontrollable:
            lines.append(f"controllable: {', '.join(self.controllable)}")
            lines.append(f"uncontrollable: {', '.join(mechanics.grouped(self.uncontrollable))}")
            placed = [f"{what} {count}" for what, count in self.reach.items()]
            lines.append(f"controllable directions: {', '.join(placed)}")
        lines += [f"note: {note}" for note in self.notes]
        return folded(lines)


def controllability(lin: LinearModel) -> Controllability:
    r"""Determine the controllable subspace from the structure of the model.

    Let :math:`x_1` be the positions and :math:`\nu` the velocities, with :math:`\dot x_1 = N \nu`,
    and let :math:`A_{ij}` and :math:`B_i` be the corresponding blocks of A and B. The method
    depends on the model:

    - At rest, the momenta :math:`W M \nu` with :math:`W M [A_{21}, A_{22}, B_2] = 0` are conserved;
      each row of W defines one momentum. These momenta, and the coordinates :math:`W M N^{-1} x_1`
      whose rates are these momenta, are uncontrollable and are separated exactly from the other
      states. Without springs and dampers, all other states are controllable, so the dimension is 2
      rank(B).
    - At rest with symmetric springs and dampers, the other states are tested in second-order form,
      :math:`M a + D v + K s = S u` with positions s, damping D and stiffness K, by the rank of
      :math:`[p^2 M + p D + K, S]` at each pole p. In this matrix, entries that are zero to within
      rounding error are set to zero, and rows longer than 1 are scaled to length 1.
    - At nonzero velocity, or if springs or dampers are not symmetric, the Popov-Belevitch-Hautus
      test is applied: the rank of :math:`[A - p I, B]` at each pole p is found from its singular
      values, with the states scaled to units of energy.

    A sampled model has the controllable subspace of its continuous model, with one exception:
    sampling may map two poles to one, and the inputs may then control only one of the two modes.
    For example, a vibration is uncontrollable if the sample time is a multiple of half its period.
    A sampled model that was loaded from a file lacks the continuous model, so only the sampled
    matrices are analysed.

    The tolerance of every rank decision is a small multiple of the rounding error. In the result,
    `margin` compares the singular values with their tolerances, and `notes` lists ranks that
    rounding error leaves undecided.

    Parameters
    ----------
    lin : LinearModel
        Linear model: continuous or sampled, full or reduced. A model loaded from a file is also
        accepted.

    Returns
    -------
    Controllability
        Dimension and basis of the controllable subspace, and names of controllable and
        uncontrollable states.

    Raises
    ------
    InputError
        If `lin` is not a `LinearModel`, or its states are not positions followed by their rates.

    Notes
    -----
    All inputs, including thrusters, are assumed to act in both directions. At a nonzero angular
    velocity, the result applies to the model with A and B frozen at the operating point. The motion
    itself may be uncontrollable even if this frozen model is controllable. At nonzero velocity,
    poles with a modulus below about 1e-8 times the largest modulus are treated as zero.

    References
    ----------
    P. C. Hughes and R. E. Skelton, Controllability and observability of linear matrix
    second-order systems, J. Applied Mechanics 47(2), 1980.

    Examples
    --------
    >>> motors = [fflin.JointTorque(f"joint_{i}") for i in (1, 2, 3)]
    >>> arm = fflin.load("planar_detumble", inputs=motors)
    >>> found = fflin.controllability(fflin.linearize(arm))
    >>> found.dimension, found.stabilizable
    (6, False)
    """
    lin = mechanics.checked(lin)
    conserved, size = mechanics.conserved(lin), np.tile(np.sqrt(lin.M.diagonal()), 2)
    found = _by_second_order(lin, conserved)
    if found is None:
        z, R = conserved.selected, conserved.rates
        X, M = mechanics.rate_matrix(lin)[z] @ conserved.T, R.T @ lin.M @ R
        split = split_by_poles(X, lin.B[z], M, lin.dt)
        found = split.inside, split.rows, None, "eigenvalues", split.fixed.transformed(R)
    controllable, rows, names, method, fixed = found
    if names is None:
        z = conserved.selected
        rows = echelon(rows.T, 1.0 / size[z])[0].T
        states = tuple(lin.state_names[i] for i in z)
        names = [combination(row, states, 1.0 / size[z]) for row in rows]
    others: Array = np.zeros((len(rows), len(lin.A)))
    others[:, conserved.selected] = rows
    # When the controllable states are named, prefer coordinates on which an input acts directly.
    driven = mechanics.second_order(lin.generator or lin).S.values.any(axis=1)
    basis, pivots = echelon(conserved.T @ controllable, size, np.tile(driven, 2))
    zero = np.full(2 * len(conserved.weights), 1.0 if lin.dt else 0.0)
    fixed = fixed._replace(margin=conserved.margin & fixed.margin)
    if len(zero):
        fixed = fixed._replace(decays=False, settling=Margin())
    groups = np.array([name.partition(".")[0] for name in lin.state_names[: len(lin.M)]])
    titles = {"q_b": "base attitude", "r_b": "base position", "q_m": "joints"}
    weighted = (basis * size[:, None])[: len(groups)]
    momenta, notes = mechanics.momentum_names(lin, conserved), list[str]()
    rotates = any("angular momentum" in name for name in momenta)
    if rotates and any(groups[conserved.kept] == "q_m"):
        notes.append(_LOOPS)
    if momenta:
        notes.append("fflin.momentum_reduction removes the conserved momenta from the model")
    if not lin.is_equilibrium():
        notes.append(
            "the operating point is not an equilibrium, so the result is valid only for A and B "
            "frozen at this point"
        )
    notes += mechanics.undecided(lin, fixed, "controllable", basis.shape[1], "stabilizable")
    return Controllability(
        dimension=basis.shape[1],
        controllable=tuple(lin.state_names[i] for i in pivots),
        uncontrollable=(*momenta, *names),
        rows=np.vstack((conserved.momenta, conserved.coordinates, others)),
        basis=basis,
        fixed_poles=np.concatenate((zero, fixed.poles)),
        stabilizable=fixed.decays,
        reach={
            title: image(unit_columns(weighted[groups == group]), 1e-8)[0].shape[1]
            for group, title in titles.items()
            if group in groups
        },
        method=method,
        margin=fixed.margin,
        notes=tuple(notes),
        robot=lin.robot,
    )


def _by_second_order(
    lin: LinearModel, conserved: ConservedMomenta
) -> tuple[Array, Array, list[str] | None, str, FixedPoles] | None:
    """Split the 2 r states without conserved momenta at rest; None if the test is inconclusive.

    Return a basis (2 r, d) of the controllable subspace, rows (2 r - d, 2 r) on which no input
    acts, their names or None if these follow from the states, the method, and the fixed poles.
    """
    source, R = mechanics.at_rest(lin), conserved.rates
    if source is None:
        return None
    system, r = mechanics.second_order(source).restricted(R), len(conserved.kept)
    idle, margin = null_space(system.S.T @ np.diag(1.0 / system.size))
    if not system.acting or (not idle.shape[1] and not lin.dt):
        # The inputs act on every momentum that is not conserved, so all remaining states are
        # controllable.
        everything, fixed = np.eye(2 * r), FixedPoles(margin=margin.transformed(R / system.size))
        return everything, everything[:0], [], "closed form", fixed
    found = unobservable(system, system.S.T, Noisy.exact(np.zeros_like(system.S.values.T)), lin.dt)
    if found is None:
        return None
    # The system is symmetric. Each motion (s, v) that the output S^T s does not observe therefore
    # gives a row, a combination of states on which no input acts.
    s, v = np.split(found.motions, 2)
    rows = np.hstack((s.T @ system.D.values + v.T @ system.M, s.T @ system.M))
    # The controllable subspace is orthogonal to these rows.
    size = np.tile(system.size, 2)
    normal = rows / size
    normal = np.linalg.qr((normal / np.linalg.norm(normal, axis=1, keepdims=True)).T, "complete")[0]
    controllable = normal[:, len(rows) :] / size[:, None]
    to_s = np.linalg.inv(
        (mechanics.rates_of_positions(mechanics.rate_matrix(source)) @ R)[conserved.kept]
    )
    controllable[:r] = np.linalg.solve(to_s, controllable[:r])
    fixed = found.fixed.transformed(R)
    if system.D.values.any():
        rows = np.hstack((rows[:, :r] @ to_s, rows[:, r:]))
        return controllable, rows, None, "eigenvalues", fixed
    # Without damping, each row measures the position or the rate of a vibration that no input
    # drives.
    members = tuple(lin.state_names[len(lin.M) + i].split(".", 1)[-1] for i in conserved.kept)
    read, names = [np.zeros((0, 2 * r))], list[str]()
    for pole, shapes in found.shapes:
        if pole.real < 0.0:  # the pole with positive real part has the same shapes
            continue
        momenta = shapes.real.T @ system.M
        zero = np.zeros_like(momenta)
        read += [np.hstack((momenta @ to_s, zero)), np.hstack((zero, momenta))]
        kind = "vibration" if pole.imag else "instability"
        for what in ("", "rate of "):
            for each in shapes.real.T * system.size:
                shape = combination(each / np.abs(each).max(), members, np.ones(r))
                names.append(f"{what}{kind} at {abs(pole):.4g} rad/s ({shape})")
    return controllable, np.vstack(read), names, "modes", fixed
