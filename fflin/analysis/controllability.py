"""Controllability of a linear model, and checks before the design of regulators and filters."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fflin.analysis import along_motion, mechanics, moving_points, ranks
from fflin.analysis.hautus import split_by_poles, unobservable
from fflin.analysis.lasting_modes import conclude, reached, root_of
from fflin.analysis.mechanics import ConservedMomenta, combination
from fflin.analysis.observability import lasting_motions, observability
from fflin.analysis.output_hints import with_outputs
from fflin.base.errors import (
    DetectabilityError,
    InputError,
    StabilizabilityError,
    listed,
)
from fflin.base.validation import Array, Values
from fflin.linear.linear_trajectory import LinearTrajectory
from fflin.linear.model import LinearModel, refuse_frozen

_LOOPS = (
    "a periodic joint motion can still rotate the base of the nonlinear robot, by O(e^2) for a "
    "joint amplitude e, although the linear model does not show it"
)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Controllability(ranks.RankAnalysis):
    """Controllability of a linear model; ``print`` shows a summary.

    Attributes
    ----------
    dimension : int
        Dimension of the controllable subspace.
    bound : int
        Largest possible dimension along the motion. It equals `dimension`, unless `method` is
        "frozen".
    duration : float
        Duration [s] of the analysed trajectory; 0 for the model of one operating point.
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
        sampled one. Empty for a trajectory, which has no poles.
    stabilizable : bool or None
        Whether all fixed poles are stable. At a point that the robot leaves, and along a
        trajectory: True if the inputs control all states, False if they cannot change a conserved
        momentum, and None if this is undecided.
    reach : dict
        Numbers of independent directions that the inputs can control, with the keys
        ``"base attitude"``, ``"base position"`` and ``"joints"``. The inputs can bring the position
        states to any value along these directions, if the final values of all other states are left
        free.
    method : str
        Method that determined the dimension: "closed form", "modes", "eigenvalues", "frozen" or
        "Gramian". With "frozen", the dimension is valid only for A and B at the operating point,
        which the robot leaves. With "Gramian", it is valid along the given trajectory.
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

    controllable: tuple[str, ...]
    uncontrollable: tuple[str, ...]
    stabilizable: bool | None
    reach: dict[str, int]

    def _lines(self) -> list[str]:
        lines = list[str]()
        if self.uncontrollable:
            lines.append(f"controllable: {', '.join(self.controllable)}")
            lines.append(
                f"uncontrollable: {', '.join(mechanics.grouped(self.uncontrollable))}"
            )
            placed = [f"{group} {count}" for group, count in self.reach.items()]
            lines.append(f"controllable directions: {', '.join(placed)}")
        conserved = self.uncontrollable[: len(self.basis) - self.bound]
        limit = f"no input can change {listed(mechanics.grouped(conserved))}"
        decays = ranks.verdict(self.stabilizable, "stabilizable")
        return [self._head("controllable", limit, decays), *lines]


def controllability(lin: LinearModel | LinearTrajectory) -> Controllability:
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
    - In a steady motion, or if springs or dampers are not symmetric, the Popov-Belevitch-Hautus
      test is applied: the rank of :math:`[A - p I, B]` at each pole p is found from its singular
      values, with the states scaled to units of energy.
    - At any other point, A and B change along the motion, and their rank at one instant proves
      nothing about the motion. If no input exerts a net force on the robot, the linear momentum and
      the centre of mass are separated first, and the angular momentum if no input exerts a net
      moment either; see (9.6) of docs/derivation.md. No input changes these nine states, in motion
      as at rest. If the inputs accelerate all coordinates independently, all states are
      controllable. Otherwise the rest is tested with A and B frozen at the operating point. `bound`
      is then the number of states without the conserved ones, `method` is "frozen", and the result
      is never stabilizable.
    - Along a trajectory, the rank of the finite-horizon controllability Gramian is found, with the
      inputs constant between the knots. The result describes the errors at the last knot that the
      inputs can reach from zero error at the first knot.

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
    lin : LinearModel or LinearTrajectory
        Linear model: continuous or sampled, full or reduced. A model loaded from a file is also
        accepted. A `LinearTrajectory` is analysed over its whole duration, or over its period.

    Returns
    -------
    Controllability
        Dimension and basis of the controllable subspace, and names of controllable and
        uncontrollable states.

    Raises
    ------
    InputError
        If `lin` is not a `LinearModel` or `LinearTrajectory`, its states are not positions followed
        by their rates, or it was loaded from a file and its operating point is not an equilibrium,
        so that the conserved momenta are unknown.

    Notes
    -----
    All inputs, including thrusters, are assumed to act in both directions. At nonzero velocity,
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

    In motion, the six momenta and the centre of mass remain uncontrollable:

    >>> v = fflin.velocity(arm, {"joint_1": 0.1})
    >>> found = fflin.controllability(fflin.linearize(arm, v=v))
    >>> found.bound, found.method, found.stabilizable
    (9, 'frozen', False)
    """
    if isinstance(lin, LinearTrajectory):
        return _along(lin)
    lin = mechanics.of_robot(lin)
    refuse_frozen(lin, "controllability")
    if not lin.is_equilibrium():
        return _in_motion(lin)
    conserved, size = mechanics.conserved(lin), np.tile(np.sqrt(lin.M.diagonal()), 2)
    split = _by_second_order(lin, conserved)
    if split is None:
        z, R = conserved.selected, conserved.rates
        X, M = mechanics.rate_matrix(lin)[z] @ conserved.T, R.T @ lin.M @ R
        inside, _, rows, fixed = split_by_poles(X, lin.B[z], M, lin.dt)
        split = inside, rows, None, "eigenvalues", fixed
    controllable, rows, names, method, fixed = split
    if names is None:
        z = conserved.selected
        rows, names = _named(rows, tuple(lin.state_names[i] for i in z), size[z])
    others: Array = np.zeros((len(rows), len(lin.A)))
    others[:, conserved.selected] = rows
    zero = moving_points.constant_poles(2 * len(conserved.weights), lin.dt)
    margin = conserved.margin & fixed.margin.transformed(conserved.rates)
    fixed = fixed._replace(
        margin=margin, settling=fixed.settling.transformed(conserved.rates)
    )
    if len(zero):
        fixed = fixed._replace(decays=False, settling=ranks.Margin())
    momenta, notes = mechanics.momentum_names(lin, conserved), list[str]()
    rotates = any("angular momentum" in name for name in momenta)
    kept = [lin.state_names[i] for i in conserved.kept]
    if rotates and any(name.startswith("q_m.") for name in kept):
        notes.append(_LOOPS)
    if momenta:
        notes.append(
            "fflin.momentum_reduction removes the conserved momenta from the model"
        )
    dimension = controllable.shape[1]
    notes += moving_points.steadiness(lin)
    notes += mechanics.undecided(lin, fixed, "controllable", dimension, "stabilizable")
    return _result(
        lin,
        conserved.T @ controllable,
        bound=dimension,
        uncontrollable=(*momenta, *names),
        rows=np.vstack((conserved.momenta, conserved.coordinates, others)),
        fixed_poles=np.concatenate((zero, fixed.poles)),
        stabilizable=fixed.decays,
        method=method,
        margin=fixed.margin,
        notes=tuple(notes),
    )


def _in_motion(lin: LinearModel) -> Controllability:
    """Determine the controllable subspace at a point that is not an equilibrium.

    The conserved momenta are exact, so they are taken out first. Unless the inputs accelerate all
    coordinates independently, the rest is decided by A and B at this point. This rank does not
    decide about the motion, so it never makes the result stabilizable.
    """
    nx = len(lin.A)
    conserved = moving_points.conserved(lin)
    count = len(conserved.rows)
    notes = moving_points.steadiness(lin)
    margin = None
    if not count:
        margin = moving_points.all_coordinates_driven(lin)
    if margin is not None:
        return _result(
            lin,
            np.eye(nx),
            bound=nx,
            uncontrollable=(),
            rows=np.zeros((0, nx)),
            fixed_poles=np.zeros(0),
            stabilizable=True,
            method="closed form",
            margin=margin,
            notes=(moving_points.NOTE_AT_ONCE, *notes),
        )
    X = mechanics.rate_matrix(lin)
    inside, _, rows, fixed = split_by_poles(
        X, lin.B, lin.M, lin.dt, known=conserved.rows
    )
    rows, names = _named(rows, lin.state_names, np.tile(np.sqrt(lin.M.diagonal()), 2))
    zero = moving_points.constant_poles(count, lin.dt)
    # the frozen poles do not decide about decay
    fixed = fixed._replace(settling=ranks.Margin())
    undecided = mechanics.undecided(lin, fixed, "controllable", inside.shape[1])
    stabilizable = False if count else None
    return _result(
        lin,
        inside,
        bound=nx - count,
        uncontrollable=(*conserved.names, *names),
        rows=np.vstack((conserved.rows, rows)),
        fixed_poles=np.concatenate((zero, fixed.poles)),
        stabilizable=stabilizable,
        method=ranks.FROZEN,
        margin=fixed.margin,
        notes=(moving_points.NOTE, *notes, *undecided),
    )


def _along(traj: LinearTrajectory) -> Controllability:
    """Determine which errors at the end of a trajectory its inputs can set."""
    _, last = along_motion.ends(traj)
    conserved = moving_points.conserved(last)
    split = along_motion.reachable(traj, conserved.rows)
    size = np.tile(np.sqrt(last.M.diagonal()), 2)
    rows, names = _named(split.rest.T @ split.from_x, last.state_names, size)
    lost = np.vstack((conserved.rows, rows))
    dimension = split.image.shape[1]
    fixed = ranks.FixedPoles(margin=split.margin)
    stabilizable: bool | None = True
    if len(lost):
        stabilizable = None
    if len(conserved.rows):
        stabilizable = False
    return _result(
        last,
        split.to_x @ split.image,
        bound=dimension,
        duration=float(traj.t[-1] - traj.t[0]),
        uncontrollable=(*conserved.names, *names),
        rows=lost,
        fixed_poles=np.zeros(0),
        stabilizable=stabilizable,
        method=ranks.GRAMIAN,
        margin=split.margin,
        notes=mechanics.undecided(last, fixed, "controllable", dimension),
    )


def _named(rows: Array, states: Sequence[str], size: Array) -> tuple[Array, list[str]]:
    """Return uncontrollable combinations of states in echelon form, and their names.

    `size` (nx,) makes the states comparable, as in `SecondOrder.size`.
    """
    rows = ranks.echelon(rows.T, 1.0 / size)[0].T
    return rows, [combination(row, tuple(states), 1.0 / size) for row in rows]


def _result(
    lin: LinearModel,
    controllable: Array,
    *,
    bound: int,
    uncontrollable: tuple[str, ...],
    rows: Array,
    fixed_poles: Values,
    stabilizable: bool | None,
    method: str,
    margin: ranks.Margin,
    notes: tuple[str, ...],
    duration: float = 0.0,
) -> Controllability:
    """Return the result for the controllable subspace with the basis `controllable` (nx, d)."""
    size = np.tile(np.sqrt(lin.M.diagonal()), 2)
    # Name the controllable states by coordinates on which an input acts directly, if possible.
    driven = mechanics.second_order(lin.generator or lin).S.values.any(axis=1)
    basis, pivots = ranks.echelon(controllable, size, np.tile(driven, 2))
    groups = np.array(
        [name.partition(".")[0] for name in lin.state_names[: len(lin.M)]]
    )
    titles = {"q_b": "base attitude", "r_b": "base position", "q_m": "joints"}
    weighted = (basis * size[:, None])[: len(groups)]
    return Controllability(
        dimension=basis.shape[1],
        bound=bound,
        duration=duration,
        controllable=tuple(lin.state_names[i] for i in pivots),
        uncontrollable=uncontrollable,
        rows=rows,
        basis=basis,
        fixed_poles=fixed_poles,
        stabilizable=stabilizable,
        reach={
            title: ranks.image(ranks.unit_columns(weighted[groups == group]), 1e-8)[
                0
            ].shape[1]
            for group, title in titles.items()
            if group in groups
        },
        method=method,
        margin=margin,
        notes=notes,
        robot=lin.robot,
    )


def _by_second_order(
    lin: LinearModel, conserved: ConservedMomenta
) -> tuple[Array, Array, list[str] | None, str, ranks.FixedPoles] | None:
    """Find the controllable subspace of a model at rest, without its conserved momenta.

    The subspace is expressed in 2 r states: the r coordinates `conserved.kept` and their rates.
    Return None if `mechanics.at_rest` finds no second-order system, or if the test is inconclusive.
    Otherwise return five results:

    - a basis (2 r, d) of the controllable subspace;
    - a matrix (2 r - d, 2 r), each row of which is an uncontrollable combination of these states;
    - the names of the rows, or None if the caller must form the names from the state names;
    - the name of the method;
    - the fixed poles.
    """
    source = mechanics.at_rest(lin)
    R = conserved.rates
    if source is None:
        return None
    system, r = mechanics.second_order(source).restricted(R), len(conserved.kept)
    idle, margin = ranks.null_space(system.S.T, 1.0 / system.size)
    if not system.acting or (not idle.shape[1] and not lin.dt):
        # S has rank r, so the inputs can accelerate the r coordinates independently, and all 2 r
        # states are controllable. Sampled models with springs or dampers are excluded, because
        # sampling may make their states uncontrollable.
        everything = np.eye(2 * r)
        return (
            everything,
            everything[:0],
            [],
            "closed form",
            ranks.FixedPoles(margin=margin),
        )
    S = system.S.T
    hidden = unobservable(system, S, ranks.Noisy.exact(0.0 * S.values), lin.dt)
    if hidden is None:
        return None
    # M, K and D are symmetric, because `unobservable` returns None otherwise. So the system with
    # the output S^T s is the dual of the system with the input matrix S. For each motion (s, v)
    # that this output does not observe, the row (s^T D + v^T M, s^T M) is an uncontrollable
    # combination of states.
    motions, shapes, fixed = hidden
    s, v = np.split(motions, 2)
    rows = np.hstack((s.T @ system.D.values + v.T @ system.M, s.T @ system.M))
    # The controllable subspace is orthogonal to these rows.
    exact = ranks.Noisy.exact(rows)
    scale = 1.0 / np.tile(system.size, 2)
    controllable, _ = ranks.null_space(exact, scale)
    to_s = np.linalg.inv(
        (mechanics.rates_of_positions(mechanics.rate_matrix(source)) @ R)[
            conserved.kept
        ]
    )
    controllable[:r] = np.linalg.solve(to_s, controllable[:r])
    if system.D.values.any():
        rows = np.hstack((rows[:, :r] @ to_s, rows[:, r:]))
        return controllable, rows, None, "eigenvalues", fixed
    # Without damping, the uncontrollable combinations of states are modal coordinates of vibrations
    # and instabilities, and the rates of these coordinates.
    members = tuple(
        lin.state_names[len(lin.M) + i].split(".", 1)[-1] for i in conserved.kept
    )
    read = [np.zeros((0, 2 * r))]
    names = list[str]()
    for pole, of_pole in shapes:
        if pole.real < 0.0:  # the pole with positive real part has the same shapes
            continue
        momenta = of_pole.real.T @ system.M
        zero = np.zeros_like(momenta)
        read += [np.hstack((momenta @ to_s, zero)), np.hstack((zero, momenta))]
        kind = "vibration" if pole.imag else "instability"
        for prefix in ("", "rate of "):
            for amplitudes in of_pole.real.T * system.size:
                shape = combination(
                    amplitudes / np.abs(amplitudes).max(), members, np.ones(r)
                )
                names.append(f"{prefix}{kind} at {abs(pole):.4g} rad/s ({shape})")
    return controllable, np.vstack(read), names, "modes", fixed


def require_stabilizable(lin: LinearModel) -> None:
    """Raise `StabilizabilityError` if there are states that the inputs cannot stabilise.

    A delay of the inputs makes no difference.
    """
    lin = lin.undelayed
    missed = "the inputs cannot stabilise {}; add inputs"
    if len(lin.A) < 2 * len(lin.M):  # the model has wheel speeds without wheel angles
        robot = lin._robot
        if robot and any(robot.damping.get(name) for name in lin.wheels):
            missed += ", or remove the damping of the wheels"
        report = reached(
            lin.state_names,
            lin.dt,
            lin.A,
            lin.B,
            "stabilised by the inputs",
            missed,
            unstable=True,
        )
        return conclude(StabilizabilityError, *report)
    analysis = controllability(lin)
    words = ""
    if not analysis.stabilizable:
        # The message names the momenta and the other uncontrollable states that do not decay. It
        # omits the coordinates whose rates are the momenta.
        conserved = mechanics.conserved(lin)
        count = len(conserved.weights)
        others = _lasting(lin, analysis, 2 * count)
        lost = (*analysis.uncontrollable[:count], *others)
        words = missed.format(listed(mechanics.grouped(lost))) + _remedies(
            lin, conserved
        )
    return conclude(StabilizabilityError, words, analysis.notes, analysis.margin)


def _lasting(
    lin: LinearModel, analysis: Controllability, first: int
) -> tuple[str, ...]:
    """Name the uncontrollable combinations of states that do not decay by themselves.

    The combinations are the rows of the result `analysis` from the row `first` on. The rows before
    it are conserved.
    """
    rows = analysis.rows
    names = analysis.uncontrollable[first:]
    if analysis.method == "modes" or not names:
        return names  # undamped vibrations and instabilities
    # The combinations z = rows x obey dz/dt = F z, because they span a left invariant subspace.
    size = np.tile(np.sqrt(lin.M.diagonal()), 2)
    F = (rows @ mechanics.rate_matrix(lin) / size) @ np.linalg.pinv(rows / size)
    left = ranks.lasting(F[first:, first:].T, lin.dt)
    if left.shape[1] == len(names) or not (left.shape[1] or first):
        return names
    return tuple(_named(left.T @ rows[first:], lin.state_names, size)[1])


def _remedies(lin: LinearModel, conserved: ConservedMomenta) -> str:
    """Return what helps if momenta are conserved, besides more inputs.

    A spring between links changes the momentum of a joint, but not the momentum of the robot.
    """
    of_joint = [name.startswith("qdot_m.") for name in lin.state_names[len(lin.M) :]]
    advice = ""
    if conserved.weights[:, of_joint].any():
        # The names of these joints, as a pattern if they differ only by their ends.
        loose = [
            name.removeprefix("momentum of ")
            for name in mechanics.momentum_names(lin, conserved)[
                : len(conserved.weights)
            ]
            if name.startswith("momentum of ")
            and " + " not in name
            and " - " not in name
        ]
        advice += (
            ", add a spring to any joint that no input moves (--stiffness, stiffness=)"
        )
        if loose:
            names = ", ".join(f'"{name}"' for name in _patterns(lin, loose))
            advice += f", lock such joints (lock = [{names}], --lock)"
    if len(conserved.weights) and len(conserved.kept):
        advice += ", or design on fflin.momentum_reduction(lin) (--reduce)"
    return advice


def _patterns(lin: LinearModel, joints: Sequence[str]) -> list[str]:
    """Return patterns that match exactly the given joints of a model, such as ``arm_*``."""
    everything = [
        x.removeprefix("q_m.") for x in lin.state_names if x.startswith("q_m.")
    ]
    groups = dict[str, list[str]]()
    for name in joints:
        groups.setdefault(re.sub(r"[0-9]+$", "", name), []).append(name)
    patterns = list[str]()
    for stem, names in groups.items():
        same = [name for name in everything if name.startswith(stem)]
        whole = len(names) > 1 and bool(stem) and len(same) == len(names)
        if whole:
            patterns.append(f"{stem}*")
        else:
            patterns += names
    return patterns


def require_detectable(lin: LinearModel) -> None:
    """Raise `DetectabilityError` if there are unobservable motions that do not decay.

    Earlier commands, which are states of a model with delayed inputs, are known.
    """
    lin = lin.undelayed
    missed = "the outputs do not observe {}, whose motion does not decay by itself; add outputs"
    if len(lin.A) < 2 * len(lin.M):
        words, notes, margin = reached(
            lin.state_names,
            lin.dt,
            lin.A.T,
            lin.C.T,
            "observed by the outputs",
            missed,
            unstable=True,
        )
        return conclude(DetectabilityError, with_outputs(words), notes, margin)
    analysis = observability(lin)
    words = ""
    if not analysis.detectable:
        motions = lasting_motions(lin, analysis)
        words = with_outputs(missed.format(listed(motions)), " ".join(motions))
    return conclude(DetectabilityError, words, analysis.notes, analysis.margin)


def require_weighed(lin: LinearModel, A: Array, Q: Array) -> None:
    """Raise `InputError` if a marginally stable mode has no weight in Q."""
    missed = "Q has no weight on {}, whose motion does not decay by itself; add a weight there"
    conclude(
        InputError,
        *reached(lin.state_names, lin.dt, A.T, root_of(Q), "weighted by Q", missed),
    )


def require_disturbed(names: Sequence[str], dt: float, A: Array, W: Array) -> None:
    """Raise `InputError` if noise of intensity W leaves a marginally stable mode of A unexcited."""
    missed = (
        "W does not excite {}, whose motion does not decay by itself, so a steady-state filter "
        "would not correct its estimate; give the noise there a positive intensity"
    )
    report = reached(names, dt, A, root_of(W), "excited by W", missed, spans=True)
    conclude(InputError, *report)
