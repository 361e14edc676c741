"""Conserved quantities and symmetries of a robot at an operating point that it leaves.

At such a point, A and B change along the motion, so their rank at one instant proves nothing about
the motion. The conserved quantities and the symmetries are exact: they are derived from the
mechanics, not from A and B. Equation numbers refer to docs/derivation.md.
"""

from typing import NamedTuple

import numpy as np

from fflin.analysis import mechanics, ranks
from fflin.base.errors import InputError
from fflin.base.validation import Array
from fflin.dynamics.coordinates import ANGULAR, IN_REFERENCE_AXES, LINEAR
from fflin.linear.linearization import Linearizer
from fflin.linear.model import LinearModel
from fflin.robot.outputs import CenterOfMass, Momentum

# A force that is larger than this fraction of the generalised force of its input, in units of
# energy, is certainly not a rounding error.
_CERTAIN = 1e-3

# Names of the rows that `_rows` returns.
_ANGULAR = tuple(f"angular momentum {axis}" for axis in "xyz")
_LINEAR = tuple(f"linear momentum {axis}" for axis in "xyz")
_CENTRE = tuple(f"centre of mass {axis}" for axis in "xyz")

# Note of every result whose dimension is exact although the point is not an equilibrium.
NOTE_AT_ONCE = (
    "the operating point is not an equilibrium, so the matrices change along the motion; the "
    "result does not depend on this change"
)

# Note of every result that depends on matrices frozen at one instant of a motion.
NOTE = (
    "the operating point is not an equilibrium, so the matrices change along the motion, and their "
    "rank at one point proves nothing about the motion; analyse the motion with "
    "fflin.linearize_trajectory, or a steady motion with moving=True"
)


class ConservedInMotion(NamedTuple):
    """Rows L (k, nx) of combinations of the state that no input can change, and their names."""

    rows: Array
    names: tuple[str, ...]


def conserved(lin: LinearModel) -> ConservedInMotion:
    r"""Return the conserved momenta of a moving point (9.6), and the centre of mass they move.

    Along the motion, ``L B = 0`` and ``dL/dt + L A = S L``, where S maps the linear momentum to the
    velocity of the centre of mass and is otherwise zero. So no input changes ``L x``.

    - If no input exerts a net force, the linear momentum is conserved, and the centre of mass
      moves with it.
    - If no input exerts a net force or moment, the angular momentum about the centre of mass is
      conserved too.

    In orbit, the field changes all momenta. The state of a reduced model no longer contains the
    momenta. In these two cases, L has no rows.

    Raises
    ------
    InputError
        If the model was loaded from a file, which does not contain the robot.
    """
    robot = lin._robot
    empty = ConservedInMotion(np.zeros((0, len(lin.A))), ())
    if robot is None:
        if _clearly_pushed(lin):
            return empty
        raise InputError(
            f"the model of '{lin.robot}' is from a file and its operating point moves, so its "
            "conserved momenta are unknown; use the model that linearize returns for the robot"
        )
    count = 12 + 2 * robot.n - 2 * lin.rank
    if robot.orbit or robot.anchored or len(lin.A) != count:
        return empty
    measured = robot.replace(outputs=[Momentum(), CenterOfMass()])
    if lin.moving:
        linearizer = Linearizer(measured, moving=True, independent=lin.independent)
    else:
        linearizer = Linearizer(
            measured,
            frame=lin.frame,
            reference=lin.reference,
            independent=lin.independent,
        )
    # The wrench of each input on the whole robot, with exact zeros.
    wrenches = linearizer.prepared.actuation.columns(robot.create_data(), lin.q)[:6]
    if wrenches[LINEAR].any():
        return empty
    rows = linearizer(lin.q, lin.v, lin.u0).C
    if wrenches[ANGULAR].any():
        return ConservedInMotion(rows[3:], _LINEAR + _CENTRE)
    return ConservedInMotion(rows, _ANGULAR + _LINEAR + _CENTRE)


def _clearly_pushed(lin: LinearModel) -> bool:
    """Return whether an input exerts a net force that is certainly not a rounding error."""
    source = lin.generator
    if source is None:
        return False
    nv = len(lin.M)
    units = np.sqrt(lin.M.diagonal())[:, None]
    forces = (lin.M @ source.B[nv:]) / units
    linear = [name.startswith("v_b.") for name in lin.state_names[nv:]]
    return bool(
        (np.abs(forces[linear]) > _CERTAIN * np.linalg.norm(forces, axis=0)).any()
    )


def unobserved(lin: LinearModel, C: Array | None = None) -> Array:
    """Return the unobservable motions (nx, k) that follow from symmetries, at any point.

    C (ny, nx) replaces the output matrix of the model; only its zero entries matter.

    The dynamics do not change if the whole robot is displaced, moves at another constant velocity,
    or is rotated. Gravity that is uniform changes this only by a fall that all motions share. So if
    the outputs do not depend on the position of the base, a displacement is unobservable; if they
    do not depend on its velocity either, a constant velocity is unobservable; and if they do not
    depend on its attitude either, a rotation is unobservable. No other group of the base's states
    is returned, because the outputs at one point do not show that it is unobservable elsewhere.
    """
    nx = len(lin.A)
    motions = np.zeros((nx, 0))
    if lin.mean_motion:
        return motions
    shown = mechanics.outputs_without_rounding(lin, C).values
    # In other axes, the angular velocity changes with the attitude.
    groups = ["r_b", "v_b"]
    if not IN_REFERENCE_AXES[lin.frame][0]:
        groups.append("q_b")
    for group in groups:
        members = [
            i
            for i, name in enumerate(lin.state_names)
            if name.partition(".")[0] == group
        ]
        if len(members) != 3 or shown[:, members].any():
            break
        motions = np.hstack((motions, np.eye(nx)[:, members]))
    return motions


def all_coordinates_driven(lin: LinearModel) -> ranks.Margin | None:
    """Return the margin if the inputs accelerate all coordinates independently, or else None.

    All states are then controllable at this instant, whether or not A and B change along the
    motion: the columns of B and of ``A B - dB/dt`` span the state space. For a sampled model,
    return None, because sampling may make states uncontrollable.
    """
    if lin.dt:
        return None
    system = mechanics.second_order(lin)
    idle, margin = ranks.null_space(system.S.T, 1.0 / system.size)
    if idle.shape[1]:
        return None
    return margin


def all_coordinates_measured(lin: LinearModel) -> ranks.Margin | None:
    """Return the margin if the outputs determine all states or all positions, or else None.

    All states are then observable at this instant, whether or not A and C change along the motion.
    A sampled model must measure all states, because sampling may hide a velocity.
    """
    nv = len(lin.M)
    C = mechanics.outputs_without_rounding(lin)
    scale = 1.0 / np.tile(np.sqrt(lin.M.diagonal()), 2)
    hidden, margin = ranks.null_space(C, scale)
    if not hidden.shape[1]:
        return margin
    if lin.dt:
        return None
    static = ~C.values[:, nv:].any(axis=1)
    positions = ranks.Noisy(C.values[static, :nv], C.noise[static, :nv])
    hidden, margin = ranks.null_space(positions, scale[:nv])
    if hidden.shape[1]:
        return None
    return margin


def steadiness(lin: LinearModel) -> tuple[str, ...]:
    """Return a note if it is undecided whether the operating point is an equilibrium."""
    rate = lin.f0 if lin.drift is None else lin.drift
    judged = [name not in lin.ignorable for name in lin.state_names]
    tolerance = lin.bound(1e-9)
    ratio = float(np.abs(rate[judged]).max(initial=0.0)) / tolerance
    if not 1.0 / ranks.CLEAR < ratio < ranks.CLEAR:
        return ()
    kind = "an equilibrium" if ratio <= 1.0 else "not an equilibrium"
    return (
        f"undecided: the operating point counts as {kind}, but its largest rate is {ratio:.2g} "
        "times the tolerance",
    )


def constant_poles(count: int, dt: float) -> Array:
    """Return the poles (count,) of quantities that stay constant."""
    pole = 1.0 if dt else 0.0
    return np.full(count, pole)
