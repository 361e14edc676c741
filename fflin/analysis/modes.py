"""Natural modes of a linear model: free-free frequencies, damping ratios, shapes."""

import textwrap
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from fflin.analysis.mechanics import checked
from fflin.analysis.ranks import EPS
from fflin.analysis.reduction import ReducedModel
from fflin.base import html, svg
from fflin.base.errors import InputError
from fflin.base.rotation import skew
from fflin.base.tables import counted, folded, grid, width
from fflin.base.validation import Array, Complex, FrozenArrays, Values
from fflin.dynamics.state import StateMap
from fflin.linear.model import LinearModel, refuse_frozen
from fflin.robot.equipment.assembly import effective_shares
from fflin.robot.joints import ROOT
from fflin.robot.mass_properties import mode_carriers
from fflin.robot.robot import Robot

# With coordinates scaled to unit inertias, a stiffness counts as zero if it is at most nx times
# this fraction of the largest stiffness. Modes below about 3e-7 sqrt(nx) times the highest
# frequency therefore count as rigid-body modes.
_NO_STIFFNESS = 1e-13

# The energy of a body is a sum in which large terms of balls and of their link may cancel. The
# energy counts as zero below this fraction of the terms.
_ROUNDING = 1e-13


@dataclass(frozen=True, eq=False, repr=False)
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
    strain : mapping of str to float
        Fraction of the mode's elastic energy in the spring of each joint, the largest first. The
        mapping is empty if the robot has no springs or the model was loaded from a file.
    energy : mapping of str to float
        Fraction of the mode's kinetic energy in each body, the largest first. The fractions are
        nonnegative and sum to 1. A body has the name of its link (of several links, the first), or
        of its joint if it has no link; the root body is "base". A body includes its flexible
        appendages and sloshing liquid. The mapping is empty if the model was loaded from a file.

    Notes
    -----
    Let :math:`V_i` be the complex twist of body i in the mode, and :math:`I_i` its spatial inertia.
    The kinetic energy of body i as a fraction of the total, averaged over a period, is

    .. math::
        e_i = \frac{V_i^H I_i V_i}{\sum_k V_k^H I_k V_k}.

    For a body with flexible appendages or slosh, the term of the body also contains the energy of
    its modes, see (16.1) of docs/derivation.md. For a joint with a rotor inertia, it contains the
    energy of the rotor.

    The twists are relative to the reference frame. If the robot floats freely at rest, its modes
    have zero momentum, so the fractions do not depend on which link is the base. The fraction
    :math:`e_i` of a body is never negative, whereas the product :math:`\phi_i (M \phi)_i` of a
    single coordinate can be negative.

    Examples
    --------
    >>> springs = {"panel_left": 100.0, "panel_right": 90.0}  # N m/rad
    >>> robot = fflin.load("servicer_7dof", stiffness=springs)
    >>> mode = fflin.modes(fflin.linearize(robot)).modes[0]
    >>> mode.unstable, mode.shape.shape
    (False, (30,))
    >>> list(mode.energy)[:2]
    ['panel_right_link', 'panel_left_link']
    """

    pole: complex
    shape: Complex
    unstable: bool
    margin: float
    energy: Mapping[str, float]
    strain: Mapping[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        unstable = ", unstable" if self.unstable else ""
        return f"Mode(pole={self.pole:.5g}, nx={len(self.shape)}{unstable})"

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
        """Damping ratio -Re(p)/abs(p): 0 if undamped, 1 if real and stable, < 0 if unstable."""
        if self.pole.real == 0.0:
            return 0.0
        return -self.pole.real / abs(self.pole)

    @property
    def time_constant(self) -> float:
        """Time [s] in which the mode decays, or grows if it is unstable, by a factor e."""
        if self.pole.real == 0.0:
            return float("inf")
        return 1.0 / abs(self.pole.real)


@dataclass(frozen=True, eq=False, repr=False)
class Modes(html.Reported):
    """Natural modes of a linear model; ``print`` shows a table.

    Attributes
    ----------
    modes : tuple of Mode
        Modes with nonzero eigenvalues, in ascending order of frequency.
    rigid_body : int
        Number of rigid-body modes: independent displacements without a restoring force.
    zero_eigenvalues : int
        Number of zero eigenvalues; each rigid-body mode without friction contributes two.
    residual : float
        Largest residual of a mode, ``|A x - pole x| / (|A| |x|)`` with the eigenvector x. The
        states are scaled to unit inertias and to the time of the fastest motion.
    equilibrium : bool
        Whether the operating point is an equilibrium or a relative equilibrium. If False, the
        eigenvalues describe the model frozen at this point and do not determine the stability of
        the motion.
    state_names, state_units : tuple of str
        Names and units of the states, which are the entries of each mode's `shape`.
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
        """Remarks on missing data, and on modes of undecided stability (due to rounding errors)."""
        notes = [
            f"undecided: the mode at {mode.frequency:.4g} rad/s may grow or decay, because the "
            f"real part of its pole is only {mode.margin:.1g} times the rounding error"
            for mode in self.modes
            if 0.1 < abs(mode.margin) < 10.0
        ]
        if self.modes and not self.modes[0].energy:
            notes.append(
                "the kinetic energies of the bodies are unknown, because the model was loaded "
                "from a file"
            )
        return tuple(notes)

    @property
    def poles(self) -> Complex:
        """All nx eigenvalues of A [rad/s], including zero and conjugate eigenvalues."""
        listed = [0j] * self.zero_eigenvalues
        for mode in self.modes:
            listed.append(mode.pole)
            if mode.oscillates:
                listed.append(mode.pole.conjugate())
        return np.array(listed)

    def __str__(self) -> str:
        """Show the number of rigid-body modes, and a table of the other modes."""
        parts = [folded([line]) for line in self._lines()]
        rows = self._rows()
        left = max(map(len, grid(rows, "rrrll").splitlines())) - len(rows[0][-1])
        for row, mode in zip(rows[1:], self.modes, strict=True):
            row[-1] = _percents(mode.energy, width() - left)
        if self.modes:
            parts.append(grid(rows, "rrrll"))
        for title, table, align in self._of_appendages():
            parts.append(f"{textwrap.fill(title, width())}\n{grid(table, align)}")
        return "\n\n".join(parts)

    def _html_parts(self) -> list[str]:
        head, *notes = self._lines()
        parts = [html.verdict(head, False if self.unstable else None)]
        parts += [html.paragraph(note, "note") for note in notes]
        rows = self._rows()
        for row, mode in zip(rows[1:], self.modes, strict=True):
            row[-1] = _percents(mode.energy, 80)
        if self.modes:
            poles = svg.figure("poles", svg.pole_map(self.poles))
            parts.append(html.side_by_side(html.table(rows, "rrrll"), poles))
        for title, table, align in self._of_appendages():
            parts.append(html.folded(title, html.table(table, align)))
        return parts

    def _lines(self) -> list[str]:
        """Return the first lines of the report: the numbers of modes, and notes."""
        vibrations = len(self.vibrations)
        others = len(self.modes) - len(self.vibrations)
        head = (
            f"{self.robot}: {counted(self.rigid_body, 'rigid-body mode')} "
            f"({counted(self.zero_eigenvalues, 'eigenvalue')} at zero), "
            f"{counted(vibrations, 'vibration')}"
        )
        if others:
            head += f", {counted(others, 'real pole')}"
        if not self.equilibrium:
            head += "; not an equilibrium: eigenvalues of a frozen model do not show stability"
        lines = [head]
        if self.unstable:
            poles = ", ".join(f"{mode.pole:.5g}" for mode in self.unstable)
            lines.append(f"unstable poles (positive real part): {poles}")
        lines += [f"note: {note}" for note in self.notes]
        return lines

    def _rows(self) -> list[list[str]]:
        """Return the table of modes; its last column is empty."""
        rows = [["rad/s", "damping", "decay [s]", "", "kinetic energy"]]
        for mode in self.modes:
            frequency = damping = "."
            if mode.oscillates:
                frequency = f"{mode.frequency:.6g}"
                damping = f"{mode.damping_ratio:.4g}"
            decay = f"{mode.time_constant:.4g}" if mode.pole.real else "."
            growth = "unstable" if mode.unstable else ""
            rows.append([frequency, damping, decay, growth, ""])
        return rows

    def _of_appendages(self) -> list[tuple[str, list[list[str]], str]]:
        """Return (title, rows, alignment) of two tables about flexible appendages and slosh.

        For a robot without them, the list is empty. The first table lists two frequencies of each
        mode: the frequency if the link that carries the appendage is free, and the frequency if
        this link is clamped. The second table contains the effective masses.
        """
        robot = self.lin._robot
        if robot is None or not robot.modes:
            return []
        clamped = {
            joint.name: joint.oscillation(robot.stiffness[joint.name], 0.0)[0]
            for joint in robot.modes
            if robot.stiffness.get(joint.name)
        }
        rows = [["rad/s", "clamped", "mode", "elastic energy"]]
        # Freeing the link raises the frequencies. A motion far below all clamped frequencies, such
        # as an oscillation in orbit, is not a mode of an appendage, although it strains the
        # appendages a little.
        least = 0.5 * min(clamped.values(), default=0.0)
        for mode in self.vibrations:
            name = next(iter(mode.strain), "")
            if name in clamped and mode.frequency > least:
                percents = _percents(mode.strain, 60)
                rows.append(
                    [f"{mode.frequency:.6g}", f"{clamped[name]:.6g}", name, percents]
                )
        of_masses = [["mode", "clamped", *"xyz", "xx", "yy", "zz"]]
        for name, parts in effective_shares(
            robot._bare.model, robot.appendages
        ).items():
            cells = [f"{100.0 * part:.1f}" if part > 1e-12 else "." for part in parts]
            frequency = f"{clamped[name]:.6g}" if name in clamped else "."
            of_masses.append([name, frequency, *cells])
        title = (
            "effective masses and moments of inertia about the frame of the appendage, in % of "
            "the inertia of the body that carries it, or of the inertia in its file"
        )
        of_modes = (
            "modes of the appendages, with the link that carries them free and clamped"
        )
        return [(of_modes, rows, "rrll"), (title, of_masses, "lrrrrrrr")]


def modes(lin: LinearModel) -> Modes:
    r"""Compute the natural modes of a linear model.

    If the operating point is at rest and the only force is a symmetric stiffness, the modes are the
    vibration modes of the free-floating structure:

    .. math::
        K \phi = \omega^2 M^* \phi, \qquad M^* = ((M^{-1})_{EE})^{-1}.

    The index E selects the coordinates on which the stiffness K acts. M* is a Schur complement of
    M: the effective inertia of these coordinates if all other coordinates are free to move. If
    other forces act, or the operating point is in motion, the modes are the eigenvectors of A. Zero
    eigenvalues form Jordan blocks of size two or more, which are sensitive to rounding, so these
    eigenvalues are first separated exactly from all others.

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
        If the robot's Pinocchio model (``robot.model``) was modified after the robot was created.

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
    lin = checked(lin)
    refuse_frozen(lin, "modes")
    if lin.dt:
        raise InputError(
            f"the model is sampled at dt = {lin.dt:g} s; give the continuous model"
        )
    nv, inertia = len(lin.M), np.sqrt(lin.M.diagonal())
    # If the input forces u0 cancel each other, their rounding errors remain in the derivatives of
    # the accelerations with respect to the positions. Derivatives that are no larger than these
    # errors are set to zero.
    A = lin.A.copy()
    by_position = A[nv:, :nv]
    rounding = np.abs(lin.B[nv:]) @ np.abs(lin.u0)
    by_position[np.abs(by_position) <= 1e2 * EPS * rounding[:, None]] = 0.0
    # Scale the states and the time so that the largest entries of A are about 1.
    rates = np.abs(np.tile(inertia, 2)[:, None] * A / np.tile(inertia, 2))
    turning = max(float(rates[nv:, nv:].max()), float(rates[:nv, :nv].max()))
    fastest = max(float(rates[nv:, :nv].max()) ** 0.5, turning) or 1.0
    weight = np.concatenate((fastest * inertia, inertia))
    pairs, rigid_body = nonzero_eigenpairs(
        weight[:, None] * A / weight / fastest, _NO_STIFFNESS
    )
    # Pole, shape and margin of each mode
    eigenmodes: list[tuple[complex, Complex, float]] = []
    residual = 0.0
    for scaled_pole, vector, error in pairs:
        if scaled_pole.imag < 0.0:
            continue
        oscillates = abs(scaled_pole.real) <= error and scaled_pole.imag
        growth = 0.0 if oscillates else scaled_pole.real
        pole = complex(growth, scaled_pole.imag) * fastest
        shape = vector / weight
        left = weight * (A @ shape - pole * shape) / fastest
        residual = max(
            residual, float(np.linalg.norm(left) / np.linalg.norm(weight * shape))
        )
        # A shape is scaled by its largest coordinate. If several coordinates are equally large, as
        # for symmetric panels, the shape is scaled by the first of them.
        positions = np.abs(shape[:nv])
        largest = int(np.flatnonzero(positions >= (1.0 - 1e-9) * positions.max())[0])
        shape = np.asarray(shape / shape[largest], complex)
        margin = scaled_pole.real / error
        eigenmodes.append((pole, shape, margin))
    shapes = np.array([shape for _, shape, _ in eigenmodes], complex).reshape(
        len(eigenmodes), 2 * nv
    )
    energies = energies_of(lin._robot, lin, shapes)
    listed = [
        Mode(pole, shape, margin > 1.0, margin, energy, strain)
        for (pole, shape, margin), (energy, strain) in zip(
            eigenmodes, energies, strict=True
        )
    ]
    return Modes(
        tuple(sorted(listed, key=lambda mode: (abs(mode.pole), mode.pole.real))),
        rigid_body,
        2 * nv - len(pairs),
        residual,
        lin.is_equilibrium(),
        lin.state_names,
        lin.state_units,
        lin.robot,
        lin,
    )


def _percents(energy: Mapping[str, float], room: int) -> str:
    """List bodies or joints with at least 1 % of the energy, and the total of all others.

    The list is shortened until it fits into `room` characters, if necessary to the first entry
    without the total.
    """
    words = [
        f"{body} {100.0 * part:.0f} %" for body, part in energy.items() if part >= 0.01
    ]
    text = ""
    for count in range(len(words), 0, -1):
        left = sum(list(energy.values())[count:])
        text = ", ".join(words[:count])
        if left >= 0.005:
            text += f"; + {len(energy) - count} more {100.0 * left:.0f} %"
        if len(text) <= room:
            return text
    return "".join(words[:1])


def energies_of(
    robot: Robot | None, lin: LinearModel, shapes: Complex
) -> list[tuple[Mapping[str, float], Mapping[str, float]]]:
    """Return {body: fraction of the kinetic energy} and {joint: fraction of the elastic energy}.

    The rows of `shapes` (k, nx) are the shapes of k modes, see `Mode`. The result has one pair of
    mappings for each mode. Without a robot, all mappings are empty.
    """
    if robot is None:
        return [({}, {}) for _ in shapes]
    state = StateMap(robot, reference=lin.reference, frame=lin.frame)
    chart = state.chart(lin.q)
    moved = shapes[:, : shapes.shape[1] // 2].T
    if isinstance(lin, ReducedModel):
        moved = lin.T[: len(lin.T) // 2, : len(moved)] @ moved
    if lin._all_states is not None:
        rows, columns = lin._all_states.shape
        moved = lin._all_states[: rows // 2, : columns // 2] @ moved
    # The kinetic energy is computed with displacements, in base axes, instead of velocities. In a
    # mode, the velocities are the displacements times the pole, so the fractions are the same.
    moved = np.vstack((chart.J @ moved[:3], chart.R.T @ moved[3:6], moved[6:]))
    parts = np.hstack((moved.real, moved.imag))
    real, imaginary = np.hsplit(_energies(robot, lin.q, state.spread(parts.T).T), 2)
    terms = real + imaginary
    # The inertia of a link without its balls is not physically realisable, and its energy alone may
    # be negative. So the energies of all balls and liquids are added to the energy of their link.
    carriers = mode_carriers(robot)
    owners = (
        np.array([carriers.get(i, i) for i in range(ROOT, robot.model.njoints)]) - ROOT
    )
    kinetic = np.zeros_like(terms)
    sizes = np.zeros_like(terms)
    np.add.at(kinetic, owners, terms)
    np.add.at(sizes, owners, np.abs(terms))
    kinetic[np.abs(kinetic) <= _ROUNDING * sizes] = 0.0
    elastic = robot.springs.stiffness[:, None] * np.abs(moved[6:]) ** 2
    names = _body_names(robot)
    bodies = {i for i in range(len(names)) if i + ROOT not in carriers}
    fractions: list[tuple[Mapping[str, float], Mapping[str, float]]] = []
    for of_bodies, of_springs in zip(kinetic.T, elastic.T, strict=True):
        parts = of_bodies / (of_bodies.sum() or 1.0)
        order = np.argsort(-parts.round(9), kind="stable").tolist()
        energy = {names[i]: float(parts[i]) for i in order if i in bodies}
        parts = of_springs / (of_springs.sum() or 1.0)
        order = np.argsort(-parts, kind="stable").tolist()
        strain = {
            robot.joint_names[i]: float(parts[i]) for i in order if parts[i] > 0.0
        }
        fractions.append((energy, strain))
    return fractions


def _body_names(robot: Robot) -> list[str]:
    """Return the names of all bodies: "base", then the link that each joint carries.

    A joint without a link, for example a wheel, gives its own name.
    """
    links = dict[int, str]()
    for frame in robot.model.frames:
        if frame.type == pin.FrameType.BODY:
            links.setdefault(frame.parentJoint, frame.name)
    root_link = links.pop(ROOT, "base")
    joints = enumerate(list(robot.model.names)[ROOT + 1 :], ROOT + 1)
    names = [links.get(index, name) for index, name in joints]
    base = root_link if "base" in names else "base"
    return [base, *names]


def _energies(robot: Robot, q: Array, v: Array) -> Array:
    """Return twice the kinetic energy (bodies, k) of each body, with the rotor of its joint.

    The columns of v (nv, k) are k velocities at the configuration q.
    """
    # The twists of all k motions are propagated together, from each body to the next. This needs a
    # single pin.Data, whose construction costs more than the rest of this function.
    model = robot.model
    data = robot.create_data()
    pin.forwardKinematics(model, data, q, np.zeros(model.nv))
    twists = np.zeros((model.njoints, 6, v.shape[1]))
    energies = np.zeros((model.njoints, v.shape[1]))
    for index in range(ROOT, model.njoints):
        body = model.inertias[index]
        rates = v[model.idx_vs[index] : model.idx_vs[index] + model.nvs[index]]
        armature = model.armature[
            model.idx_vs[index] : model.idx_vs[index] + model.nvs[index]
        ]
        twist = twists[index]
        twist[:] = np.asarray(data.joints[index].S).reshape(6, -1) @ rates
        twist += data.liMi[index].toActionMatrixInverse() @ twists[model.parents[index]]
        angular = twist[3:]
        linear = twist[:3] - skew(body.lever) @ angular
        energies[index] = body.mass * (linear**2).sum(axis=0) + armature @ rates**2
        energies[index] += (angular * (body.inertia @ angular)).sum(axis=0)
    return energies[ROOT:]


def nonzero_eigenpairs(
    A: Array, tolerance: float
) -> tuple[list[tuple[complex, Values, float]], int]:
    """Return (pole, eigenvector, rounding error) of each nonzero pole of A, and the nullity of A.

    A is repeatedly replaced by :math:`V_1^T A V_1`, where the columns of :math:`V_1` are
    orthonormal and orthogonal to the null space of A. Each step removes only zero eigenvalues. The
    steps end when A is nonsingular.
    """
    # Rounding moves the k zero eigenvalues of a Jordan block by the k-th root of the rounding
    # error. Zero eigenvalues are therefore removed before the others are computed. Singular values
    # of at most n * tolerance count as zero. So the caller must scale A (n, n) so that its largest
    # entries are about 1.
    n = len(A)
    whole = A
    size = float(np.linalg.norm(A))
    nullity = n - int(
        np.count_nonzero(np.linalg.svd(A, compute_uv=False) > n * tolerance)
    )
    steps: list[Array] = []
    while len(A):
        used = A.any(axis=0)
        if used.all():
            _, singular, transposed = np.linalg.svd(A)
            rank = int(np.count_nonzero(singular > n * tolerance))
            if rank == len(A):
                break
            complement = np.asarray(transposed[:rank].T)
        else:
            # Columns that are exactly zero are removed directly, because an orthogonal
            # transformation would add rounding errors.
            complement = np.eye(len(A))[:, used]
        steps.append(A @ complement)
        A = complement.T @ steps[-1]
    if not len(A):
        return [], nullity
    values, right = np.linalg.eig(A)
    # The left eigenvector y of each right eigenvector x is scaled to y x = 1. If A is defective,
    # `right` has no inverse, so the pseudoinverse is used.
    left = np.linalg.pinv(right, rcond=EPS)
    pairs: list[tuple[complex, Values, float]] = []
    for value, y, x in zip(values.tolist(), left, right.T, strict=True):
        error = 1e2 * EPS * size * min(float(np.linalg.norm(y)), 1.0 / EPS)
        if value.imag < 0.0 and pairs and pairs[-1][0] == value.conjugate():
            pairs.append((complex(value), pairs[-1][1].conj(), error))
            continue
        for step in reversed(steps):
            # An eigenvector x of V_1^T A V_1 gives the eigenvector A V_1 x of A, up to a factor.
            x = step @ x  # noqa: PLW2901 - the same vector in a larger space
        x /= np.linalg.norm(x)  # noqa: PLW2901
        # Slow modes lose accuracy in these steps; one inverse iteration restores the accuracy.
        if np.linalg.norm(whole @ x - value * x) > 1e2 * EPS * abs(value):
            near = whole - (value + EPS * size) * np.eye(n)
            with suppress(np.linalg.LinAlgError):  # `near` may be exactly singular
                x = np.linalg.solve(near, x)  # noqa: PLW2901
        pairs.append((complex(value), x / np.linalg.norm(x), error))
    return pairs, nullity
