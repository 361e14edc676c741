r"""Linear-fractional form of a robot at rest: the signals that each parameter multiplies.

The force F that accelerates a link with the accelerations a is

    s = T X a,   f = D s,   F = X^T T^T f

X is the Jacobian of the link's centre of mass in the axes of its inertia, D = blkdiag(m E, I), and
T is the shift of an uncertain centre of mass (otherwise the identity E). The numbers of signals
that parameters multiply are: 3 for a mass, 6 for a density, 1 for a diagonal entry of the inertia,
2 for an off-diagonal entry, and 2 in T and 2 in T^T for a coordinate of the centre of mass. These
numbers are minimal: they are the ranks of the changes of M, since X has full rank on a free base.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.base.rotation import skew
from fflin.base.validation import Array
from fflin.dynamics.state import Actuation, StateMap
from fflin.robot.mass_properties import Piece
from fflin.uncertainty.derivatives import UNITS
from fflin.uncertainty.parameters import AXES, ENTRIES, OF_PIECES, Parameter

_LOCAL = pin.ReferenceFrame.LOCAL


class Range(NamedTuple):
    """Range of a parameter: the parameter, its middle value and half width."""

    parameter: Parameter
    middle: float
    half: float

    @property
    def shift(self) -> float:
        """Difference between the middle and the nominal value."""
        return self.middle - self.parameter.value

    @property
    def repeats(self) -> int:
        """Number of signals that the parameter multiplies."""
        part = self.parameter.part
        if part[:8] == "inertia." and part[8] == part[9]:
            return 1
        return _REPEATS.get(part.partition(".")[0], 1)


class Block(NamedTuple):
    """Block of an uncertain model: one delta, which varies a parameter or several tied ones.

    Tied parameters have a common value, or a common factor on their nominal values.
    """

    name: str
    unit: str
    middle: float
    half: float
    ranges: tuple[Range, ...]

    @property
    def repeats(self) -> int:
        """Number of signals that the block's delta multiplies."""
        return sum(each.repeats for each in self.ranges)

    def values(self, value: float) -> dict[str, float]:
        """Return {parameter: value} for a common value or factor of the block."""
        delta = (value - self.middle) / self.half
        return {each.parameter.name: each.middle + each.half * delta for each in self.ranges}


# Number of signals for each part. "inertia" is an off-diagonal entry, or a wheel's inertia, which
# is also subtracted from the wheel's carrier. "frequency" is squared.
_REPEATS = {"mass": 3, "density": 6, "com": 4, "inertia": 2, "frequency": 2}


class Fraction(NamedTuple):
    """Matrices of the accelerations a (6 + n, ..) and of z, each over x, w and u."""

    a: tuple[Array, Array, Array]
    z: tuple[Array, Array, Array]


def fraction(
    state: StateMap,
    actuation: Actuation,
    q: Array,
    pieces: Mapping[str, Piece],
    ranges: Sequence[Range],
) -> Fraction:
    """Return the linear-fractional form about a point at rest without forces."""
    form = _Form(state, actuation, q, ranges)
    of_pieces: dict[str, dict[str, int]] = {}
    of_modes: dict[str, dict[str, int]] = {}
    robot = state.robot
    modes = {joint.name for joint in robot.modes if robot.stiffness.get(joint.name)}
    for at, each in enumerate(ranges):
        one = each.parameter
        if one.of in pieces and one.part in OF_PIECES:
            of_pieces.setdefault(one.of, {})[one.part] = at
        elif one.of in modes and one.damper >= 0:
            of_modes.setdefault(one.of, {})[one.part] = at
        else:
            form.add_alone(at)
    for name, parts in of_pieces.items():
        form.add_piece(pieces[name], parts)
    for name, parts in of_modes.items():
        form.add_mode(robot.joint_names.index(name), parts)
    return form.solved()


class _Form:
    """Linear-fractional form under construction.

    Signals are rows over (a, x, u, w). Each parameter adds rows to z and terms to the force.
    """

    def __init__(
        self, state: StateMap, actuation: Actuation, q: Array, ranges: Sequence[Range]
    ) -> None:
        self.state, self.ranges, model = state, ranges, state.robot.model
        centred = q.copy()  # with the base at the origin
        centred[:3] = 0.0
        self.data = state.robot.create_data()
        columns = np.array(actuation.columns(self.data, centred))
        pin.computeJointJacobians(model, self.data, centred)
        self.jacobians = {
            joint: state.columns(pin.getJointJacobian(model, self.data, joint, _LOCAL))
            for joint in range(1, model.njoints)
        }
        M = np.diag(state.project(np.diag(model.armature)).diagonal())
        for joint, J in self.jacobians.items():
            M += J.T @ model.inertias[joint].matrix() @ J
        repeats = [each.repeats for each in ranges]
        self.sizes = (len(M), state.nx, columns.shape[1], sum(repeats))
        self.ends = np.cumsum(self.sizes)
        self.unit = np.eye(self.ends[-1])
        self.next = list(np.cumsum((0, *repeats[:-1])))
        self.z = np.zeros((sum(repeats), self.ends[-1]))
        # Inertial and spring forces minus input forces. The equation of motion sets this sum to
        # zero.
        self.force = np.zeros((len(M), self.ends[-1]))
        g, (stiffness, damping, _) = state.groups, state.robot.springs
        a, x, u, _ = self.parts(self.force)
        a[:], u[:] = M, -columns
        x[6:, g.q_m], x[6:, g.qdot_m] = np.diag(stiffness), np.diag(damping)

    def parts(self, signals: Array) -> list[Array]:
        """Return the views of signals over a, x, u and w."""
        return np.split(signals, self.ends[:-1], axis=1)

    def times(self, at: int, signals: Array) -> Array:
        """Return a parameter's change times signals: (shift + half * delta) * signals.

        The product delta * half * signals is a new w, and `half` times the signals is added to z.
        """
        one, first = self.ranges[at], self.next[at]
        self.next[at] += len(signals)
        self.z[first : self.next[at]] = one.half * signals
        return one.shift * signals + self.unit[self.ends[2] + first : self.ends[2] + self.next[at]]

    def add_piece(self, piece: Piece, parts: Mapping[str, int]) -> None:
        """Replace the nominal inertial force of a link by the force with uncertain parameters."""
        J = piece.placement.inverse().toActionMatrix() @ self.jacobians[piece.joint]
        shifts = []
        for axis, direction in zip(AXES, piece.frame.rotation.T, strict=True):
            if (at := parts.get(f"com.{axis}")) is not None:
                cross = -skew(piece.placement.rotation.T @ direction)
                left, sizes, right = np.linalg.svd(cross)
                shifts.append((at, left[:, :2] * sizes[:2], right[:2]))
        D = np.zeros((6, 6))
        D[:3, :3], D[3:, 3:] = piece.mass * np.eye(3), piece.inertia
        now = J @ self.unit[: self.sizes[0]]
        s = now.copy()
        for at, left, right in shifts:  # a centre of mass shifted by d: v' = v + omega x d
            s[:3] += left @ self.times(at, right @ now[3:])
        f = D @ s
        if "mass" in parts:
            f[:3] += self.times(parts["mass"], s[:3])
        for entry, (i, j) in ENTRIES.items():
            if f"inertia.{entry}" in parts:
                rows = [i] if i == j else [i, j]
                turned = self.times(parts[f"inertia.{entry}"], s[[3 + row for row in rows]])
                for row, signal in zip(reversed(rows), turned, strict=True):
                    f[3 + row] += signal
        if "density" in parts:
            f = f + self.times(parts["density"], f)
        back = f.copy()
        for at, left, right in shifts:
            back[3:] += right.T @ self.times(at, left.T @ f[:3])
        self.force += J.T @ (back - D @ now)

    def add_alone(self, at: int) -> None:
        """Add the effect of a parameter of a joint, a thruster or a wheel."""
        one = self.ranges[at].parameter
        _, x, u, _ = np.split(self.unit, self.ends[:-1])
        if one.spring >= 0:
            self.force[6 + one.spring] += self.times(at, x[[6 + one.spring]])[0]
        elif one.damper >= 0:
            row = self.state.groups.qdot_m.start + one.damper
            self.force[6 + one.damper] += self.times(at, x[[row]])[0]
        elif one.wrench:
            joint, column, wrench = one.wrench
            given = self.jacobians[joint].T @ wrench
            self.force -= np.outer(given, self.times(at, u[[column]])[0])
        else:
            change = sum(
                self.jacobians[joint].T @ np.tensordot(parameters, UNITS, 1) @ self.jacobians[joint]
                for joint, parameters in one.bodies.items()
            )
            values, vectors = np.linalg.eigh(change)
            most = np.argsort(-np.abs(values))[: self.ranges[at].repeats]
            L = vectors[:, most]
            a = self.unit[: self.sizes[0]]
            self.force += L @ self.times(at, (values[most, None] * L.T) @ a)

    def add_mode(self, index: int, parts: Mapping[str, int]) -> None:
        """Replace the spring and damper force of a mode by omega I (omega x + 2 zeta x')."""
        joint, springs = self.state.robot.joints[index], self.state.robot.springs
        K, D = springs.stiffness[index], springs.damping[index]
        omega, ratio = joint.oscillation(K, D)
        x = np.split(self.unit, self.ends[:-1])[1]
        position, rate = x[[6 + index]], x[[self.state.groups.qdot_m.start + index]]
        turns = 2.0 * np.pi

        def by_frequency(signal: Array) -> Array:
            found = omega * signal
            if "frequency" in parts:
                found = found + turns * self.times(parts["frequency"], signal)
            return found

        damped = ratio * rate
        if "damping" in parts:
            damped = damped + self.times(parts["damping"], rate)
        force = joint.inertia * by_frequency(by_frequency(position) + 2.0 * damped)
        self.force[6 + index] += (force - K * position - D * rate)[0]

    def solved(self) -> Fraction:
        """Solve the equation of motion for a, and eliminate a from z."""
        (M, *others), (Z, *direct) = self.parts(self.force), self.parts(self.z)
        x, u, w = (-np.linalg.solve(M, each) for each in others)
        zx, zu, zw = (d + Z @ each for d, each in zip(direct, (x, u, w), strict=True))
        return Fraction((x, w, u), (zx, zw, zu))
