"""Controllers of full order that minimise the H-infinity norm of goals.

See K. Glover and J. C. Doyle, State-space formulae for all stabilizing controllers that satisfy an
H-infinity norm bound, Systems & Control Letters 11, 1988.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import schur

from fflin.base.errors import InputError
from fflin.base.process import in_one_thread
from fflin.base.validation import Array, instance
from fflin.control.linear_controller import LinearController
from fflin.linear.model import LinearModel
from fflin.tuning.channels import Ends, channel_of, ends_of
from fflin.tuning.goals import Goal, MaxGain
from fflin.tuning.law import Law, law_of
from fflin.tuning.plant import Plant, plant_of, signals_of
from fflin.tuning.structures import Names, indices
from fflin.tuning.tuned import matrices_of
from fflin.tuning.verification import largest_in_band

# Relative accuracy of the norm, and relative size of the signals that make the problem regular.
_ACCURACY, _REGULAR = 1e-4, 1e-4

# Largest norm that is tried.
_LARGEST = 1e12

# Eigenvalues nearer to the imaginary axis, relative to the largest one, have no stable subspace.
_AXIS = 1e-11


class Generalised(NamedTuple):
    """Plant from (w, u) to (z, y)."""

    A: Array
    B1: Array
    B2: Array
    C1: Array
    C2: Array
    D11: Array
    D12: Array
    D21: Array
    D22: Array


class HInfinity(LinearController):
    """Controller of full order that `hinf` designed; a linear policy.

    Attributes
    ----------
    gamma : float
        Largest gain from all inputs to all outputs of the goals together, each divided by its
        limit. All goals hold if it is at most 1.
    order : int
        Number of states of the controller.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> goal = fflin.MaxGain({"tau_b": 0.01, "q_b": 1e-3}, {"q_b": 0.05, "tau_b": 1.0})
    >>> policy = fflin.hinf(lin, goal, measured="q_b", inputs="tau_b")
    >>> policy.order
    6
    """

    gamma: float
    order: int

    def __init__(self, law: Law, lin: LinearModel, gamma: float) -> None:
        super().__init__(matrices_of(law, lin.dt), lin)
        self.gamma = gamma
        self.order = len(law.A)


@in_one_thread
def hinf(
    lin: LinearModel,
    goals: Goal | Sequence[Goal],
    *,
    measured: Names = "*",
    inputs: Names = "*",
) -> HInfinity:
    """Design the controller of full order with the least H-infinity norm of goals.

    The generalised plant contains the inputs and outputs of all goals, divided by their sizes and
    limits. The norm is that of all of them together, so that it is an upper bound of the value of
    each goal. Small disturbances and outputs are added if the problem is singular. `gamma` is the
    norm of the loop that is returned. With lightly damped modes or states of very different sizes,
    rounding errors of the Riccati equations can end the search above the least norm.

    Parameters
    ----------
    lin : LinearModel
        Continuous or sampled model. For a sampled one, the controller is sampled too.
    goals : MaxGain or sequence of MaxGain
        Goals at all frequencies; their bounds may depend on frequency.
    measured, inputs : str or sequence of str
        Outputs that the controller measures, and inputs that it commands; all by default.

    Returns
    -------
    HInfinity

    Raises
    ------
    InputError
        If a goal is not a `MaxGain` at all frequencies, a signal does not exist, or no controller
        stabilises the plant.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> goal = fflin.MaxGain({"tau_b": 0.01, "q_b": 1e-3}, {"q_b": 0.05, "tau_b": 1.0})
    >>> policy = fflin.hinf(lin, goal, measured="q_b", inputs="tau_b")
    >>> policy.gamma < 1.0
    True
    """
    instance("lin", lin, LinearModel, "a fflin.LinearModel")
    every = [goals] if isinstance(goals, Goal) else goals
    if not isinstance(every, Sequence) or not every:
        raise InputError(f"goals are {goals!r}, expected one goal or more")
    signals = signals_of(lin)
    rows = indices("output", measured, signals.outputs)
    columns = indices("input", inputs, signals.inputs)
    ends = []
    for goal in every:
        instance("goal", goal, MaxGain, "a fflin.MaxGain, the goal of hinf")
        assert isinstance(goal, MaxGain)
        if goal.band != (0.0, np.inf):
            raise InputError(
                f"the goal '{goal.label}' has a band, but hinf needs goals at all frequencies; "
                "give below= as a transfer function, or use fflin.tune"
            )
        found = ends_of(goal, signals, lin.state_names, rows, columns)
        assert found is not None
        if lin.dt and len(found.weight.denominator) > 1:
            raise InputError(
                f"below of the goal '{goal.label}' depends on frequency, but the model is sampled; "
                "give a number, or the continuous model"
            )
        ends.append(found)
    model = _plant(lin, ends, rows)
    # Outputs without a state that the inputs move are not fed back.
    rows = tuple(row for row in rows if model.C[row].any())
    plant = _generalised(model, every, ends, rows, columns)
    law, gamma = synthesis(plant)
    ny, nu = len(signals.outputs), len(signals.inputs)
    selected, placed = np.eye(ny)[list(rows)], np.eye(nu)[:, list(columns)]
    A, B, C, D = law
    whole = (A, B @ selected, placed @ C, placed @ D @ selected)
    return HInfinity(law_of(whole, []), lin, gamma)


def _plant(lin: LinearModel, ends: Sequence[Ends], rows: Sequence[int]) -> Plant:
    """Return the plant with the states that the goals and the measured outputs contain."""
    ny = len(lin.output_names)
    used = np.zeros(ny + len(lin.state_names), bool)
    used[list(rows)] = True
    for end in ends:
        for kind, index in (*end.sinks, *end.sources):
            if kind in ("output", "error", "sensor"):
                used[index] = True
    return plant_of((lin.A, lin.B, lin.C, lin.D), lin.dt, used)


def _generalised(
    plant: Plant,
    goals: Sequence[Goal],
    ends: Sequence[Ends],
    rows: Sequence[int],
    columns: Sequence[int],
) -> Generalised:
    """Return the generalised plant of goals, with the states of their weights."""
    channels = [
        channel_of(goal, end, plant) for goal, end in zip(goals, ends, strict=True)
    ]
    sizes = [len(channel.C1) for channel in channels]
    widths = [channel.B1.shape[1] for channel in channels]
    C1 = np.vstack([channel.C1 for channel in channels])
    D12 = np.vstack([channel.D12 for channel in channels])[:, list(columns)]
    B1 = np.hstack([channel.B1 for channel in channels])
    D21 = np.hstack([channel.D21 for channel in channels])[list(rows)]
    D11 = np.zeros((sum(sizes), sum(widths)))
    row = 0
    for goal, end, size in zip(goals, ends, sizes, strict=True):
        column = 0
        for other, width in zip(ends, widths, strict=True):
            # Outputs of one goal also depend directly on inputs of the others.
            mixed = Ends(
                other.sources, end.sinks, other.source_sizes, end.sink_sizes, end.weight
            )
            block = channel_of(goal, mixed, plant).D11
            D11[row : row + size, column : column + width] = block
            column += width
        row += size
    A, C2, D22 = plant.A, plant.C[list(rows)], plant.D[np.ix_(rows, columns)]
    B2 = plant.B[:, list(columns)]
    blocks = [
        end.weight.state_space()
        for end, size in zip(ends, sizes, strict=True)
        for _ in range(size)
    ]
    a, b, c, d = (_diagonal([block[k] for block in blocks]) for k in range(4))
    n = len(a)
    return Generalised(
        np.block([[A, np.zeros((len(A), n))], [b @ C1, a]]),
        np.vstack((B1, b @ D11)),
        np.vstack((B2, b @ D12)),
        np.hstack((d @ C1, c)),
        np.hstack((C2, np.zeros((len(C2), n)))),
        d @ D11,
        d @ D12,
        D21,
        D22,
    )


def _diagonal(blocks: Sequence[Array]) -> Array:
    """Return a block-diagonal matrix; blocks may be empty."""
    rows = sum(len(block) for block in blocks)
    columns = sum(block.shape[1] for block in blocks)
    result = np.zeros((rows, columns))
    row = column = 0
    for block in blocks:
        height, width = block.shape
        result[row : row + height, column : column + width] = block
        row += height
        column += width
    return result


def synthesis(plant: Generalised) -> tuple[tuple[Array, Array, Array, Array], float]:
    """Return the controller (A, B, C, D) of u = K y, and the norm of the closed loop."""
    for with_states in (False, True):
        normal = _normalised(_regular(plant, with_states))
        D11 = normal.plant.D11
        low = max(_norm(D11[: normal.p1]), _norm(D11[:, : normal.m1]), 1e-12)
        high = max(1.0, 2.0 * low)
        best = _controller(normal, high)
        while best is None and high < _LARGEST:
            low = high
            high *= 4.0
            best = _controller(normal, high)
        if best is not None:
            break
    if best is None:
        raise InputError(
            "no controller with a finite H-infinity norm was found; check that the inputs and "
            "measured outputs can stabilise all states of the goals"
        )
    while high > low * (1.0 + _ACCURACY):
        middle = float(np.sqrt(low * high)) if low > 1e-9 * high else 1e-3 * high
        law = _controller(normal, middle)
        if law is None:
            low = middle
        else:
            high, best = middle, law
    A, B, C, D = best
    B, C, D = B @ normal.of_outputs, normal.of_inputs @ C, normal.of_inputs @ D
    D = D @ normal.of_outputs
    law = _without_feedthrough((A, B, C, D), plant.D22)
    loop = _closed(plant, law)
    return law, largest_in_band(loop, 0.0, np.inf)[0]


def _norm(matrix: Array) -> float:
    return float(np.linalg.norm(matrix, 2)) if matrix.size else 0.0


def _regular(plant: Generalised, with_states: bool) -> Generalised:
    """Return a plant with small further signals, so that D12 and D21 have full rank.

    If `with_states`, small outputs and disturbances of all states remove zeros on the imaginary
    axis, for which the Riccati equations have no solution.
    """
    if with_states:
        n = len(plant.A)
        size = _REGULAR * max(_norm(plant.C1), 1e-12)
        push = _REGULAR * max(_norm(plant.B1), 1e-12)
        plant = plant._replace(
            B1=np.hstack((plant.B1, push * np.eye(n))),
            C1=np.vstack((plant.C1, size * np.eye(n))),
            D11=np.pad(plant.D11, ((0, n), (0, n))),
            D12=np.pad(plant.D12, ((0, n), (0, 0))),
            D21=np.pad(plant.D21, ((0, 0), (0, n))),
        )
    nu, ny = plant.B2.shape[1], len(plant.C2)
    nw = plant.D11.shape[1]
    B1, C1, D11 = plant.B1, plant.C1, plant.D11
    D12, D21 = plant.D12, plant.D21
    sizes = np.linalg.svd(D12, compute_uv=False) if D12.size else np.zeros(0)
    if len(sizes) < nu or sizes[-1] < _REGULAR * sizes[0] or not sizes[0]:
        size = _REGULAR * (float(sizes.max(initial=0.0)) or 1.0)
        C1 = np.vstack((C1, np.zeros((nu, C1.shape[1]))))
        D11 = np.vstack((D11, np.zeros((nu, nw))))
        D12 = np.vstack((D12, size * np.eye(nu)))
    sizes = np.linalg.svd(D21, compute_uv=False) if D21.size else np.zeros(0)
    if len(sizes) < ny or sizes[-1] < _REGULAR * sizes[0] or not sizes[0]:
        size = _REGULAR * (float(sizes.max(initial=0.0)) or 1.0)
        B1 = np.hstack((B1, np.zeros((len(B1), ny))))
        D11 = np.hstack((D11, np.zeros((len(D11), ny))))
        D21 = np.hstack((D21, size * np.eye(ny)))
    return plant._replace(B1=B1, C1=C1, D11=D11, D12=D12, D21=D21)


class _Normal(NamedTuple):
    """Plant with D12 = [0; I], D21 = [0, I] and D22 = 0, and the scalings of y and u."""

    plant: Generalised
    p1: int
    m1: int
    of_outputs: Array
    of_inputs: Array


def _normalised(plant: Generalised) -> _Normal:
    """Return the plant in the coordinates of the formulas."""
    left, sizes, right = np.linalg.svd(plant.D12)
    m2 = plant.D12.shape[1]
    order = np.roll(np.arange(len(left)), len(left) - m2)
    of_z = left[:, order].T
    of_u = right.T / sizes
    left, sizes, right = np.linalg.svd(plant.D21)
    p2 = len(plant.D21)
    order = np.roll(np.arange(len(right)), len(right) - p2)
    of_w = right[order].T
    of_y = (left / sizes).T
    nz, nw = plant.D11.shape
    normal = Generalised(
        plant.A,
        plant.B1 @ of_w,
        plant.B2 @ of_u,
        of_z @ plant.C1,
        of_y @ plant.C2,
        of_z @ plant.D11 @ of_w,
        np.vstack((np.zeros((nz - m2, m2)), np.eye(m2))),
        np.hstack((np.zeros((p2, nw - p2)), np.eye(p2))),
        np.zeros((p2, m2)),
    )
    return _Normal(normal, nz - m2, nw - p2, of_y, of_u)


def _riccati(H: Array) -> Array | None:
    """Return the stabilising solution of a Hamiltonian matrix, or None if there is none."""
    n = len(H) // 2
    if not np.isfinite(H).all():
        return None
    try:
        T, vectors, count = schur(H, output="real", sort="lhp")
    except np.linalg.LinAlgError:
        return None
    poles = np.linalg.eigvals(T)
    nearest = np.abs(poles.real).min(initial=np.inf)
    if count != n or nearest <= _AXIS * np.abs(poles).max(initial=0.0):
        return None
    upper, lower = vectors[:n, :n], vectors[n:, :n]
    if np.linalg.svd(upper, compute_uv=False)[-1] < 1e-13:
        return None
    X: Array = np.linalg.solve(upper.T, lower.T).T
    return 0.5 * (X + X.T)


class _Solutions(NamedTuple):
    """Solutions X and Y of the Riccati equations, and the gains F and H that follow from them."""

    X: Array
    Y: Array
    F: Array
    H: Array


def _solutions(normal: _Normal, gamma: float) -> _Solutions | None:
    """Return the solutions for a norm below gamma, or None if there is no controller."""
    plant = normal.plant
    A, B1, B2, C1, C2, D11 = plant[:6]
    nz, nw = D11.shape
    square = gamma**2
    B, C = np.hstack((B1, B2)), np.vstack((C1, C2))
    D_row = np.hstack((D11, plant.D12))
    D_column = np.vstack((D11, plant.D21))
    R = D_row.T @ D_row
    R[:nw, :nw] -= square * np.eye(nw)
    Rt = D_column @ D_column.T
    Rt[:nz, :nz] -= square * np.eye(nz)
    try:
        R_inverse, Rt_inverse = np.linalg.inv(R), np.linalg.inv(Rt)
    except np.linalg.LinAlgError:
        return None
    none = np.zeros_like(A)
    upper = np.block([[A, none], [-C1.T @ C1, -A.T]])
    before, after = np.vstack((B, -C1.T @ D_row)), np.hstack((D_row.T @ C1, B.T))
    X = _riccati(upper - before @ R_inverse @ after)
    upper = np.block([[A.T, none], [-B1 @ B1.T, -A]])
    before = np.vstack((C.T, -B1 @ D_column.T))
    after = np.hstack((D_column @ B1.T, C))
    Y = _riccati(upper - before @ Rt_inverse @ after)
    if X is None or Y is None or not _is_semidefinite(X) or not _is_semidefinite(Y):
        return None
    radius = np.abs(np.linalg.eigvals(X @ Y)).max(initial=0.0)
    if radius >= square * (1.0 - 1e-9):
        return None
    F = -R_inverse @ (D_row.T @ C1 + B.T @ X)
    H = -(B1 @ D_column.T + Y @ C.T) @ Rt_inverse
    return _Solutions(X, Y, F, H)


def _is_semidefinite(matrix: Array) -> bool:
    """Return whether a symmetric matrix is positive semidefinite, up to rounding errors."""
    size = max(float(np.abs(matrix).max(initial=0.0)), 1e-12)
    return bool(np.linalg.eigvalsh(matrix).min(initial=0.0) >= -1e-7 * size)


def _controller(
    normal: _Normal, gamma: float
) -> tuple[Array, Array, Array, Array] | None:
    """Return the central controller with a norm below gamma, or None if there is none."""
    plant, p1, m1 = normal.plant, normal.p1, normal.m1
    solutions = _solutions(normal, gamma)
    if solutions is None:
        return None
    X, Y, F, H = solutions
    nz, nw = plant.D11.shape
    F12, F2 = F[m1:nw], F[nw:]
    H12, H2 = H[:, p1:nz], H[:, nz:]
    top, bottom = plant.D11[:p1], plant.D11[p1:]
    inner = np.linalg.inv(gamma**2 * np.eye(p1) - top[:, :m1] @ top[:, :m1].T)
    other = np.linalg.inv(gamma**2 * np.eye(m1) - top[:, :m1].T @ top[:, :m1])
    Dh = -bottom[:, :m1] @ top[:, :m1].T @ inner @ top[:, m1:] - bottom[:, m1:]
    left = np.eye(nz - p1) - bottom[:, :m1] @ other @ bottom[:, :m1].T
    right = np.eye(nw - m1) - top[:, m1:].T @ inner @ top[:, m1:]
    try:
        D12h, D21h = np.linalg.cholesky(left), np.linalg.cholesky(right).T
    except np.linalg.LinAlgError:
        return None
    Z = np.linalg.inv(np.eye(len(X)) - Y @ X / gamma**2)
    B2h = Z @ (plant.B2 + H12) @ D12h
    C2h = -D21h @ (plant.C2 + F12)
    B1h = -Z @ H2 + B2h @ np.linalg.solve(D12h, Dh)
    through = np.linalg.solve(D21h, C2h)
    A = plant.A + plant.B1 @ F[:nw] + plant.B2 @ F2 + B1h @ through
    law = A, B1h, F2 + Dh @ through, Dh
    loop = _closed(plant, law)
    if np.linalg.eigvals(loop[0]).real.max(initial=-np.inf) >= 0.0:
        return None
    return law


def _closed(
    plant: Generalised, law: tuple[Array, Array, Array, Array]
) -> tuple[Array, Array, Array, Array]:
    """Return the closed loop of a plant and a controller."""
    A, B, C, D = law
    left = np.linalg.inv(np.eye(len(D)) - D @ plant.D22)
    K, Cu = left @ D, left @ C
    Cy = plant.C2 + plant.D22 @ K @ plant.C2
    Dy = plant.D21 + plant.D22 @ K @ plant.D21
    return (
        np.block(
            [
                [plant.A + plant.B2 @ K @ plant.C2, plant.B2 @ Cu],
                [B @ Cy, A + B @ plant.D22 @ Cu],
            ]
        ),
        np.vstack((plant.B1 + plant.B2 @ K @ plant.D21, B @ Dy)),
        np.hstack((plant.C1 + plant.D12 @ K @ plant.C2, plant.D12 @ Cu)),
        plant.D11 + plant.D12 @ K @ plant.D21,
    )


def _without_feedthrough(
    law: tuple[Array, Array, Array, Array], D22: Array
) -> tuple[Array, Array, Array, Array]:
    """Return the controller of a plant with D22 from that of the plant without it."""
    A, B, C, D = law
    if not D22.any():
        return law
    inverse = np.linalg.inv(np.eye(len(D)) + D @ D22)
    turned = np.linalg.inv(np.eye(len(D22)) + D22 @ D)
    return A - B @ D22 @ inverse @ C, B @ turned, inverse @ C, inverse @ D
