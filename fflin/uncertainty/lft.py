r"""Linear-fractional models: A and B as exact functions of uncertain parameters.

:math:`\dot x = A x + B_1 w + B_2 u,\; z = C_1 x + D_{11} w + D_{12} u,\; w = \Delta z` with
:math:`\Delta = \mathrm{diag}(\delta_k E_{r_k})`. Here :math:`\delta_k` is between -1 and 1, and
:math:`E_{r_k}` is the identity of size :math:`r_k`.

For the generalised accelerations a of the robot, the inertial force of a link is the generalised
force F:

    s = T X a,   f = D s,   F = X^T T^T f

X is the Jacobian of the link's centre of mass, in the axes of the link's inertia. The matrix
D = blkdiag(m E, I) contains the mass m and the inertia I. T shifts an uncertain centre of mass. If
the centre of mass is known, T is the identity E. Each parameter of a link multiplies :math:`r_k`
signals:

- 3 for a mass,
- 6 for a density,
- 1 for a diagonal entry of the inertia, and 2 for an off-diagonal entry,
- 4 for a coordinate of the centre of mass: 2 in T and 2 in T^T.

If the robot has constraints, a = G b with the accelerations b of the independent coordinates, and
the generalised forces are G^T F. The constraints can make some signals of a mass property linearly
dependent. A basis of the signals is then multiplied by the parameter. The basis is empty if the
parameter has no effect.

These numbers are minimal. No :math:`r_k` can be smaller than the rank of the derivative of the
inertia matrix M with respect to the parameter. Because X has full rank on a free base, each number
is equal to this rank if D is nonsingular.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base import html
from fflin.base.errors import InputError
from fflin.base.names import matching
from fflin.base.record import Design
from fflin.base.rotation import skew
from fflin.base.tables import counted, cut, folded, grid
from fflin.base.validation import Array, Vector, as_double, numbers
from fflin.linear.linearization import Prepared
from fflin.linear.model import ControlSystem, LinearModel, state_space
from fflin.robot.mass_properties import Piece
from fflin.uncertainty.derivatives import UNITS
from fflin.uncertainty.parameters import AXES, ENTRIES, OF_PIECES, Parameter

_LOCAL = pin.ReferenceFrame.LOCAL


@dataclass(frozen=True, eq=False, repr=False)
class LFT(Design):
    r"""Uncertain linear model in linear-fractional form (LFT), exact in its parameters.

    .. math:: \dot x = A x + B_1 w + B_2 u,\quad z = C_1 x + D_{11} w + D_{12} u,\quad
              y = C_2 x + D_{21} w + D_{22} u,\quad w = \Delta z

    Each uncertain parameter has a normalised value delta between -1 and 1. :math:`\Delta` is a
    diagonal matrix that contains every delta one or more times. ``print`` shows the range of every
    parameter and the number of its repetitions.

    Attributes
    ----------
    A, B1, B2 : ndarray (nx, nx), (nx, nw), (nx, nu)
        Matrices of the state equation.
    C1, D11, D12 : ndarray (nw, nx), (nw, nw), (nw, nu)
        Matrices of z.
    C2, D21, D22 : ndarray (ny, nx), (ny, nw), (ny, nu)
        Matrices of the outputs y.
    parameters : tuple of str
        Uncertain parameters in the order in which their deltas occur in :math:`\Delta`. Tied
        parameters, which share one delta, are listed once, under their pattern.
    repeats : ndarray (k,)
        Number of times that each delta occurs in :math:`\Delta`. Zero if constraints make a
        parameter ineffective.
    middle, half : ndarray (k,)
        Middle and half width of each range: a parameter has the value ``middle + half * delta``.
        For tied parameters, ``middle + half * delta`` is their common value if their range was
        given as a pair. If their range is relative, ``middle + half * delta`` is the factor that
        multiplies their nominal values.
    units : tuple of str
        Units of the parameters; "1" for a factor.
    state_names, input_names, output_names : tuple of str
    robot : str

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lft = fflin.uncertain(robot, {"base.density": 0.2}).lft()
    >>> A, B, C, D = lft.at({"base.density": 1.1})
    >>> lft.parameters, B.shape
    (('base.density',), (18, 9))
    """

    A: Array
    B1: Array
    B2: Array
    C1: Array
    D11: Array
    D12: Array
    C2: Array
    D21: Array
    D22: Array
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    repeats: Vector
    middle: Vector
    half: Vector
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    robot: str

    def _report(self) -> str:
        return f"{folded([self._head()])}\n\n{grid(cut(self._rows()), 'll')}"

    def _html_parts(self) -> list[str]:
        rows = cut(self._rows(), "see parameters")
        return [html.paragraph(self._head()), html.table(rows, "ll")]

    def _head(self) -> str:
        many = counted(len(self.repeats), "parameter")
        count = f"{self.repeats.sum():g}"
        return f"{self.robot}: {many}, {len(self.A)} states; Delta is {count} x {count}"

    def _rows(self) -> list[tuple[str, ...]]:
        """Return the table of the parameters and their ranges."""
        rows: list[tuple[str, ...]] = [
            ("parameter", "unit", "least", "largest", "repeated")
        ]
        columns = self.parameters, self.units, self.middle, self.half, self.repeats
        for name, unit, middle, half, repeats in zip(*columns, strict=True):
            ends = f"{middle - half:.6g}", f"{middle + half:.6g}"
            shown_unit = "." if unit == "1" else unit
            rows.append((name, shown_unit, *ends, f"{repeats:g}"))
        return rows

    @property
    def dt(self) -> float:
        """Sample time, which is 0 because the model is in continuous time."""
        return 0.0

    def at(
        self, values: Mapping[str, float] | Array
    ) -> tuple[Array, Array, Array, Array]:
        r"""Return A, B, C and D at given values of the parameters.

        Parameters
        ----------
        values : mapping or array_like (.., k)
            Values {parameter: value}, or rows of k deltas. Parameters that are not named are at the
            middle of their ranges.

        Returns
        -------
        A, B, C, D : ndarray
            Matrices of the model for each row. For example, the state matrix is
            :math:`A + B_1 \Delta (E - D_{11} \Delta)^{-1} C_1`, with the identity E.

        Raises
        ------
        InputError
            If a row does not have k finite deltas, or the inertia matrix M is singular at these
            values.
        """
        if isinstance(values, Mapping):
            given = numbers("values", values, "parameter", "value")
            values = np.zeros(len(self.parameters))
            for key, value in given.items():
                for at in matching("parameter", key, self.parameters):
                    values[at] = (value - self.middle[at]) / self.half[at]
        rows = as_double("values", values)
        if not np.isfinite(rows).all() or rows.shape[-1:] != self.repeats.shape:
            raise InputError(
                f"deltas have shape {rows.shape}, expected (.., {len(self.repeats)}) finite numbers"
            )
        delta = np.repeat(rows, self.repeats.astype(int), axis=-1)
        within = np.eye(len(self.D11)) - self.D11 * delta[..., None, :]
        outer = np.concatenate((self.C1, self.D12), axis=1)
        try:
            z = np.linalg.solve(
                within, np.broadcast_to(outer, (*delta.shape, outer.shape[1]))
            )
        except np.linalg.LinAlgError:
            raise InputError(
                "the inertia M is singular at these parameters; give narrower ranges"
            ) from None
        # Derivatives of w with respect to the states and the inputs.
        x, u = np.split(delta[..., None] * z, [len(self.A)], axis=-1)
        A, B = self.A + self.B1 @ x, self.B2 + self.B1 @ u
        return A, B, self.C2 + self.D21 @ x, self.D22 + self.D21 @ u

    def to_control(self) -> ControlSystem:
        """Return a `control.StateSpace` from (w, u) to (z, y), with signal names.

        The channels of w and z have names such as ``w_PARAMETER_1`` and ``z_PARAMETER_1``. Dots in
        all signal names are replaced by underscores.

        Raises
        ------
        MissingPackageError
            If python-control is not installed.
        InputError
            If two signals differ only by a dot or an underscore, because python-control has no dots
            in names.
        """
        channels = [
            f"{name}.{at + 1}"
            for name, repeats in zip(self.parameters, self.repeats, strict=True)
            for at in range(int(repeats))
        ]
        B, C = np.hstack((self.B1, self.B2)), np.vstack((self.C1, self.C2))
        D = np.block([[self.D11, self.D12], [self.D21, self.D22]])
        inputs = [*(f"w.{name}" for name in channels), *self.input_names]
        outputs = [*(f"z.{name}" for name in channels), *self.output_names]
        return state_space((self.A, B, C, D), 0.0, self.state_names, inputs, outputs)


class Range(NamedTuple):
    """Parameter with the middle value and the half width of its range."""

    parameter: Parameter
    middle: float
    half: float


class Block(NamedTuple):
    """Block of an uncertain model: one delta, which varies a parameter or several tied parameters.

    Tied parameters have a common value, or a common factor on their nominal values.
    """

    name: str
    unit: str
    middle: float
    half: float
    ranges: tuple[Range, ...]

    def values(self, value: float) -> dict[str, float]:
        """Return {parameter: value} for a given common value or common factor of the block."""
        delta = (value - self.middle) / self.half
        return {
            interval.parameter.name: interval.middle + interval.half * delta
            for interval in self.ranges
        }


# Largest number of signals that one parameter multiplies: 6 for a density.
_MOST = 6

# Signals are linearly dependent if a singular value is below this. The signals are in units of
# their size without constraints, for motions of equal kinetic energy.
_DEPENDENT = 1e-11


def linear_fractional(
    lin: LinearModel,
    ready: Prepared,
    pieces: Mapping[str, Piece],
    blocks: Sequence[Block],
) -> LFT:
    """Return the LFT of a model about an operating point at rest, without steady forces."""
    form = _Form(
        ready, lin, [interval for block in blocks for interval in block.ranges]
    )
    # M contains products of the parameters of a link, such as mass and centre of mass. The damping
    # force of a mode contains the product of its frequency and damping ratio. Therefore all
    # parameters of a link or mode are added together. `together` is {(link or mode, joint): {part:
    # index of the parameter}}. For a link, `joint` is -1.
    together: dict[tuple[str, int], dict[str, int]] = {}
    sprung = {name for name, stiffness in ready.robot.stiffness.items() if stiffness}
    modes = sprung & {joint.name for joint in ready.robot.modes}
    for at, (one, *_) in enumerate(form.ranges):
        is_piece = one.of in pieces and one.part in OF_PIECES
        if is_piece or (one.joint >= 0 and one.of in modes):
            together.setdefault((one.of, one.joint), {})[one.part] = at
        else:
            form.add_alone(at)
    for (name, joint), parts in together.items():
        if joint >= 0:
            form.add_mode(joint, parts)
        else:
            form.add_piece(pieces[name], parts)
    taken = (np.arange(_MOST) < form.used[:, None]).ravel()
    ends = np.cumsum([len(block.ranges) for block in blocks])[:-1]
    repeats = [float(used.sum()) for used in np.split(form.used, ends)]
    force = form.motion()
    # Solve the equation of motion for a, and eliminate a from z.
    (M, *others), (Z, *direct) = form.parts(force), form.parts(form.z[taken])
    others[2], direct[2] = others[2][:, taken], direct[2][:, taken]
    x, u, w = (-np.linalg.solve(M, matrix) for matrix in others)
    C1, D12, D11 = (d + Z @ matrix for d, matrix in zip(direct, (x, u, w), strict=True))
    nv, ny, nw = len(x), len(lin.C), len(D11)
    return LFT._of(
        lin,
        A=np.vstack((lin.A[:nv], x)),
        B1=np.vstack((np.zeros((nv, nw)), w)),
        B2=np.vstack((np.zeros_like(u), u)),
        C1=C1,
        D11=D11,
        D12=D12,
        C2=np.array(lin.C),
        D21=np.zeros((ny, nw)),
        D22=np.array(lin.D),
        parameters=tuple(block.name for block in blocks),
        units=tuple(block.unit for block in blocks),
        repeats=np.array(repeats),
        middle=np.array([block.middle for block in blocks]),
        half=np.array([block.half for block in blocks]),
    )


class _Form:
    """Linear-fractional form under construction.

    A signal, such as an entry of z or of the force, is a linear combination of the entries of
    (a, x, u, w). The signal is stored as a row of coefficients. Each parameter adds entries to z,
    and terms to the force.
    """

    def __init__(
        self, ready: Prepared, lin: LinearModel, ranges: Sequence[Range]
    ) -> None:
        state = ready.map
        robot = ready.robot
        data = ready.robot.create_data()
        self.state, self.ranges = state, ranges
        centred = lin.q.copy()  # with the base at the origin
        centred[:3] = 0.0
        columns = np.array(ready.actuation.columns(data, centred))
        pin.computeJointJacobians(robot.model, data, centred)
        self.jacobians = {
            joint: state.columns(pin.getJointJacobian(robot.model, data, joint, _LOCAL))
            for joint in range(1, robot.model.njoints)
        }
        # In the independent coordinates of a robot with constraints, all accelerations are G times
        # the independent ones, and all states are T times the independent ones.
        nx, nu = lin.B.shape
        nv, d = len(columns), nx // 2
        T = np.eye(nx) if lin._all_states is None else lin._all_states
        self.G: Array = T[nv:, d:]
        self.ends = np.cumsum((d, nx, nu, _MOST * len(ranges)))
        self.unit = np.eye(self.ends[-1])
        a, x, self.u, _ = np.split(self.unit, self.ends[:-1])
        self.a: Array = self.G @ a
        self.x: Array = T @ x
        self._constrained = bool(lin.dependent)
        # Typical sizes of a, x, u and w, in which signals are comparable.
        inertia = state.project(pin.crba(robot.model, data, centred).T).diagonal()
        self._speeds = 1.0 / np.sqrt(inertia)
        self._typical: Array = np.ones(self.ends[-1])
        self._typical[:d] = 1.0 / np.sqrt(lin.M.diagonal())
        # For each parameter, `z` reserves _MOST rows, and `used` counts the rows in use.
        self.used = np.zeros(len(ranges), dtype=np.intp)
        self.z = np.zeros((_MOST * len(ranges), self.ends[-1]))
        # Inertial forces plus spring and damper forces minus input forces, of the nominal robot and
        # of the changes. By the equation of motion, G^T times their sum is zero.
        self.nominal = np.zeros((d, self.ends[-1]))
        by_a, by_x, by_u, _ = self.parts(self.nominal)
        by_a[:] = lin.M
        by_u[:] = -self.G.T @ columns
        if lin.dependent:
            # A also contains the stiffness by the constant forces of preloaded springs in loops.
            by_x[:] = -lin.M @ lin.A[d:]
        else:
            by_x[6:, state.groups.q_m] = np.diag(robot.springs.stiffness)
            by_x[6:, state.groups.qdot_m] = np.diag(robot.springs.damping)
        self.force = np.zeros((nv, self.ends[-1]))

    def motion(self) -> Array:
        """Return the signals (d, k) of the equation of motion, which are zero."""
        signals: Array = self.nominal + self.G.T @ self.force
        return signals

    def parts(self, signals: Array) -> list[Array]:
        """Split signals (N, k) into views of their coefficients of a, x, u and w."""
        return np.split(signals, self.ends[:-1], axis=1)

    def times(self, at: int, signals: Array, sizes: Array | None = None) -> Array:
        """Multiply signals by the change of a parameter from its nominal value.

        `at` is the index of the parameter in `ranges`. `sizes` (k,) are the sizes of the signals
        without constraints. If they are given, the signals can be linearly dependent.

        The result is (shift + half * delta) * signals, where shift is the middle of the range minus
        the nominal value. The products half * signals become new entries of z. So the products
        delta * half * signals are the new entries of w. If the signals are linearly dependent, a
        basis of the signals replaces them in z.
        """
        parameter, middle, half = self.ranges[at]
        basis = signals
        combined: Array = np.eye(len(signals))
        if self._constrained and sizes is not None:
            basis, combined = self._basis(signals, sizes)
        first = _MOST * at + self.used[at]
        rows = slice(first, first + len(basis))
        self.used[at] += len(basis)
        self.z[rows] = half * basis
        self._typical[self.ends[2] :][rows] = half
        w = self.unit[self.ends[2] :]  # the entries of w as signals
        shift = middle - parameter.value
        if not self._constrained:
            return shift * signals + w[rows]
        result: Array = shift * signals + combined @ w[rows]
        return result

    def _basis(self, signals: Array, sizes: Array) -> tuple[Array, Array]:
        """Return a basis of signals (k, n), and the matrix that combines it to the signals."""
        sizes = np.where(sizes > 0.0, sizes, 1.0)
        scaled = signals * self._typical / sizes[:, None]
        U, values, Vt = np.linalg.svd(scaled, full_matrices=False)
        kept = values > _DEPENDENT
        basis = values[kept, None] * Vt[kept] / self._typical
        return basis, sizes[:, None] * U[:, kept]

    def _sizes(self, matrix: Array) -> Array:
        """Return the sizes (k,) of signals of the robot without constraints.

        A matrix (k, 6 + n) makes the signals of the accelerations.
        """
        sizes: Array = np.linalg.norm(matrix * self._speeds, axis=1)
        return sizes

    def add_piece(self, piece: Piece, parts: Mapping[str, int]) -> None:
        """Replace the nominal inertial force of a link by the force with uncertain parameters.

        `parts` contains the indices in `ranges` of the uncertain parameters of the link, such as
        {"mass": 0, "com.x": 1}. The force is F = X^T T^T f with f = D s and s = T X a, as in the
        module's docstring.
        """
        X = piece.placement.inverse().toActionMatrix() @ self.jacobians[piece.joint]
        D = np.zeros((6, 6))
        D[:3, :3] = piece.mass * np.eye(3)
        D[3:, 3:] = piece.inertia
        shifts = []
        for axis, direction in zip(AXES, piece.frame.rotation.T, strict=True):
            parameter = parts.get(f"com.{axis}")
            if parameter is not None:
                # A shift of the centre of mass by d along this axis changes the velocity by
                # omega x d. The matrix of this cross product has rank 2. It is factorised as
                # L R, with L (3, 2) and R (2, 3), so that d multiplies only two signals.
                cross = -skew(piece.placement.rotation.T @ direction)
                left, sizes, right = np.linalg.svd(cross)
                shifts.append((parameter, left[:, :2] * sizes[:2], right[:2]))

        nominal = X @ self.a
        s = nominal.copy()
        sizes = self._sizes(X)
        for parameter, L, R in shifts:  # s = T X a
            of_turn = np.abs(R) @ sizes[3:]
            s[:3] += L @ self.times(parameter, R @ nominal[3:], of_turn)

        f = D @ s
        of_force = np.abs(D) @ sizes
        if "mass" in parts:
            f[:3] += self.times(parts["mass"], s[:3], sizes[:3])
        for entry, (i, j) in ENTRIES.items():
            parameter = parts.get(f"inertia.{entry}")
            if parameter is None:
                continue
            if i == j:
                rows = [3 + i]
                f[3 + i] += self.times(parameter, s[rows], sizes[rows])[0]
            else:
                # The inertia is symmetric: its entries (i, j) and (j, i) change alike.
                rows = [3 + i, 3 + j]
                change_i, change_j = self.times(parameter, s[rows], sizes[rows])
                f[3 + j] += change_i
                f[3 + i] += change_j
        if "density" in parts:
            f = f + self.times(parts["density"], f, of_force)

        shifted_force = f.copy()
        for parameter, L, R in shifts:  # T^T f
            change = self.times(parameter, L.T @ f[:3], np.abs(L.T) @ of_force[:3])
            shifted_force[3:] += R.T @ change
        self.force += X.T @ (shifted_force - D @ nominal)

    def add_alone(self, at: int) -> None:
        """Add the effect of a parameter of a joint, thruster or wheel.

        M, the spring and damper forces, and the input forces contain no product of this parameter
        and another one. So the effect of this parameter can be added independently of the others.
        """
        # In `force`, inertial, spring and damper forces are positive, and input forces negative.
        parameter = self.ranges[at].parameter
        if parameter.joint >= 0:
            index = 6 + parameter.joint
            position = self.x[[index]]
            rate = self.x[[self.state.groups.qdot_m.start + parameter.joint]]
            signal = parameter.by_stiffness * position + parameter.by_damping * rate
            self.force[index] += self.times(at, signal)[0]
        elif parameter.wrench:
            joint, column, wrench = parameter.wrench
            force_per_input = self.jacobians[joint].T @ wrench
            signal = self.times(at, self.u[[column]])[0]
            self.force -= np.outer(force_per_input, signal)
        else:
            M_p = sum(
                self.jacobians[joint].T
                @ np.tensordot(changes, UNITS, 1)
                @ self.jacobians[joint]
                for joint, changes in parameter.bodies.items()
            )
            # The inertia of a wheel is added to the wheel, and subtracted from the body that
            # carries the wheel. So M_p has rank 2, and two of its eigenvectors represent it.
            values, vectors = np.linalg.eigh(M_p)
            largest = np.argsort(-np.abs(values))[:2]
            L = vectors[:, largest]
            signals = (values[largest, None] * L.T) @ self.a
            self.force += L @ self.times(at, signals)

    def add_mode(self, index: int, parts: Mapping[str, int]) -> None:
        """Replace the spring and damper force of a mode by omega I (omega x + 2 zeta dx/dt).

        x is the amplitude of the mode, and I its inertia. The frequency omega and the damping ratio
        zeta of the mode can be uncertain.
        """
        joint = self.state.robot.joints[index]
        springs = self.state.robot.springs
        K, D = springs.stiffness[index], springs.damping[index]
        omega, ratio = joint.oscillation(K, D)
        position = self.x[[6 + index]]
        rate = self.x[[self.state.groups.qdot_m.start + index]]
        turns = 2.0 * np.pi

        def by_frequency(signal: Array) -> Array:
            scaled = omega * signal
            if "frequency" in parts:
                scaled = scaled + turns * self.times(parts["frequency"], signal)
            return scaled

        damped = ratio * rate
        if "damping" in parts:
            damped = damped + self.times(parts["damping"], rate)
        force = joint.inertia * by_frequency(by_frequency(position) + 2.0 * damped)
        self.force[6 + index] += (force - K * position - D * rate)[0]
