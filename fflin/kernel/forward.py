r"""Forward dynamics of a robot with inputs, springs and gravity, and integrals of the motion.

The accelerations c solve (3.1), with M from the composite rigid body algorithm and the bias from
RNEA. The computation of c is in base axes. Position and linear velocity of the base are not used,
because c does not depend on them. Momentum and centre of mass follow from the external wrench W by
(11.2) of docs/derivation.md, as in `simulation.run`:

.. math:: H(t) = H(0) + \int W\,dt, \qquad r_c(t) = r_c(0) + \int p / m\,dt

The first half of H is the linear momentum p. The second half is the angular momentum about the
initial position of the base's origin. The centre of mass r_c is relative to the same point. H and
r_c are in world axes.
"""

from collections import namedtuple

from fflin.kernel import bodies
from fflin.kernel import vectors as vec
from fflin.kernel.bodies import spatial_inertia_times, stored_momentum
from fflin.kernel.extension import add_plates
from fflin.kernel.orbit import (
    RATE_CHANGE,
    STRENGTH,
    add_gradient,
    add_residual_torque,
    changing_field,
    flux_at,
    from_inertial_axes,
    kinetic_energy,
    normal_at,
    orbital_potential,
    outwards_at,
    pull_on,
    spin_at,
    write_now,
)
from fflin.kernel.tree import FLAGS, INDICES, LANED, REALS, TREE, Struct
from fflin.kernel.vectors import Entries, angle, called, chosen, load, store


class Mechanics(
    namedtuple(
        "Mechanics",
        "tree gravity index circling scale springy rest held triads origin faults disturbance",
    )
):
    """Parameters of a robot in the simulation loop.

    In compiled code, the arrays of `faults` and some arrays of `tree` have a second axis of eight
    lanes. The other arrays have no axis of lanes.

    - `tree`: the kinematic tree.
    - `gravity` (3,): gravity in world axes [m/s^2].
    - `index`: for each joint, the index in q of the first entry of the joint.
    - `circling`: for each joint, whether its first entry in q is the cosine of the joint angle.
    - `scale`: for each joint, the change of its first entry in q per unit of q_m. The value is 1
      except for modal amplitudes.
    - `springy`: for each joint, whether the joint has a spring or a damper.
    - `rest`: for each joint, the position at which the spring exerts no force.
    - `triads`: one index for each vector input, which is a torque or force on the base with three
      components. The index is the position of the first component among all inputs.
    - `held`: the entries of `triads` for the vector inputs in reference axes.
    - `origin` (7,): placement of the world relative to the reference, as position and quaternion.
    - `faults`: the `ActuatorFaults`.
    - `disturbance`: the `BaseDisturbance`.
    """


class ActuatorFaults(namedtuple("ActuatorFaults", "gain bias until turn")):
    """Actuator faults: a command u produces the inputs gain u + bias (nu,).

    - `until` (nu,): for each input, the time [s] from which the input is 0.
    - `turn`: for each vector input of `Mechanics.triads`, the three columns (9,) of a matrix. Each
      column is the direction in which one of the three components actually acts.
    """


class BaseDisturbance(
    namedtuple("BaseDisturbance", "vector phase rate at held inertial")
):
    """Torques and forces on the base: k terms, each a vector times sin(rate t + phase).

    - `vector` (k, 3): torques [N m] and forces [N]. `phase` (k,): phases [rad].
    - `rate` (k,): angular frequencies [rad/s], 0 for a constant, whose phase is pi / 2.
    - `at` (k,): 0 for a torque, 3 for a force.
    - `held` (k,): True if the vector is in world axes, False if it is in base axes.
    - `inertial` (k,): True if the vector is in inertial axes and the world is an orbital frame.
      The inertial axes are the axes of the orbital frame at t = 0.
    """


class Point(namedtuple("Point", "q nu u pushing wrench")):
    """Point of a robot: q (nq,), nu (6 + n,) in base axes, and inputs.

    - `u` (number of inputs,): the commanded inputs.
    - `pushing` (number of inputs,): the inputs after faults. Torques and forces on the base are in
      base axes.
    - `wrench` (6,): moment and force of the inputs and disturbances about the base's origin, in
      base axes, at the last evaluation of the accelerations.
    """


class CommonPoint(Point):
    """Point whose arrays have no axis of lanes, because all lanes have the same point."""


BASE_DISTURBANCE = Struct(
    BaseDisturbance, LANED, rate=REALS, at=INDICES, held=FLAGS, inertial=FLAGS
)
ACTUATOR_FAULTS, POINT = Struct(ActuatorFaults, LANED), Struct(Point, LANED)
COMMON_POINT = Struct(CommonPoint)
_OF_MECHANICS = {FLAGS: "circling springy", REALS: "gravity scale rest origin"}
MECHANICS = Struct(
    Mechanics,
    INDICES,
    _OF_MECHANICS,
    tree=TREE,
    faults=ACTUATOR_FAULTS,
    disturbance=BASE_DISTURBANCE,
)


@called
def configure(work, robot, q):
    """Write the poses of all bodies and the packed M at the configuration q."""
    bodies.outwards(work, robot.tree, q)
    bodies.inwards(work, robot.tree)


def joint_position(robot, q, joint):
    """Return the position of a joint at q; the angle of a continuous joint is in (-pi, pi]."""
    at = robot.index[joint]
    value = load(q, at)
    if robot.circling[joint]:
        value = angle(load(q, at + 1), value)
    return value / load(robot.scale, joint)


def apply_faults(
    faults: ActuatorFaults,
    triads: list[int],
    t: float,
    h: float,
    u: Entries,
    given: Entries,
) -> None:
    """Write to `given` the inputs that the actuators produce for a command u in a step.

    The step begins at time t [s] and lasts h [s]. If an actuator fails within the step, its mean
    output acts during the step, so that the impulse is exact.
    """
    for index in range(len(faults.gain)):
        value = load(faults.gain, index) * load(u, index) + load(faults.bias, index)
        left = (load(faults.until, index) - t) / h
        fraction = chosen(left, 1.0, left, 1.0)
        store(given, index, chosen(0.0, left, fraction * value, 0.0))
    for index in range(len(triads)):
        at = triads[index]
        columns = vec.get_columns(faults.turn, 9 * index)
        vec.put3(given, at, vec.product(columns, vec.get3(given, at)))


def turn_held(robot, point):
    """Rotate the torques and forces that are in reference axes to base axes, in place.

    They are entries of `point.pushing`, and begin at the indices in `robot.held`.
    """
    pushing = point.pushing
    for index in range(len(robot.held)):
        at = robot.held[index]
        turn = vec.attitude(robot.origin)
        axes = vec.columns_of(vec.quaternion_times(turn, vec.attitude(point.q)))
        vec.put3(pushing, at, vec.across(axes, vec.get3(pushing, at)))


def push(work, tree, pushing):
    """Write the generalised force of the inputs `pushing` to `work`.

    The force begins at work[tree.offsets.c]. In `pushing`, torques and forces on the base are in
    base axes. `bodies.write_columns` must be called before `push`, which reads the columns of
    body-fixed inputs.
    """
    offsets = tree.offsets
    size, count = len(tree.row), len(tree.wrench_body)
    vec.clear(work, offsets.c, size)
    for index in range(len(tree.driven)):
        if tree.driven[index] >= 0:
            vec.add(work, offsets.c + tree.driven[index], load(pushing, index))
    for index in range(count):
        u = load(pushing, tree.input[index])
        for row in range(size):
            force = load(work, offsets.columns + row * count + index) * u
            vec.add(work, offsets.c + row, force)


@called
def disturb(work, robot, orbit, extension, point, t):
    """Add the disturbances at time t [s] to the generalised force that `push` has written."""
    disturbance = robot.disturbance
    for index in range(len(disturbance.at)):
        phase = disturbance.rate[index] * t + load(disturbance.phase, index)
        sine = vec.cosine_and_sine(phase)[1]
        force = vec.times(vec.get3(disturbance.vector, 3 * index), sine)
        if orbit is not None and disturbance.inertial[index]:
            force = from_inertial_axes(orbit, force)
        if disturbance.held[index]:
            force = vec.across(vec.axes_of(point.q), force)
        vec.add3(work, robot.tree.offsets.c + disturbance.at[index], force)
    if orbit is not None:
        add_residual_torque(work, orbit, point.q, robot.tree.offsets.c)
    if extension is not None:
        axes, to = vec.axes_of(point.q), robot.tree.offsets.c
        add_plates(work, extension.plates, orbit, axes, to)


@called
def accelerate(work, robot, orbit, extension, point, t, rates, to):
    """Write d(nu)/dt at time t [s] into `rates` from the index `to` on.

    `orbit` is None without an orbit. In orbit, nu is relative to the orbital frame, and the first
    entry of `point.wrench` is the power [W] of inputs, disturbances and dampers. `extension` is an
    `Extension` with flat plates, or None.

    First, the equation of motion (3.1) is solved for the accelerations c: M c is the force of the
    inputs, minus the bias, minus the force of springs and dampers. `configure` must be called
    before this function. The factorisation of M overwrites M.
    """
    tree, nu = robot.tree, point.nu
    force = tree.offsets.c
    size = len(tree.row)
    omega_b = vec.get3(nu, 0)
    if orbit is not None:
        write_now(orbit, t)
        omega_b = vec.plus(omega_b, spin_at(orbit, point.q))
        bodies.write_columns(work, tree, flux_at(orbit, point.q))
    else:
        bodies.write_columns(work, tree, None)
    push(work, tree, point.pushing)
    disturb(work, robot, orbit, extension, point, t)
    vec.copy(work, force, point.wrench, 0, 6)
    if orbit is not None:
        store(point.wrench, 0, _power(work, tree, nu))
        if len(orbit.ellipse) > 0:
            vec.add(point.wrench, 0, _field_power(work, robot, orbit, point))
        add_gradient(work, tree, outwards_at(orbit, point.q), orbit.now[STRENGTH])
    bodies.move_bodies(work, tree, nu, omega_b)
    bodies.load_bodies(work, tree)
    bodies.collect(work, tree)
    for index in range(size):
        vec.add(work, force + index, -load(work, tree.offsets.bias + index))
    for joint in range(len(robot.index)):
        if robot.springy[joint]:
            stretch = joint_position(robot, point.q, joint) - load(robot.rest, joint)
            pull = load(tree.stiffness, joint) * stretch
            pull = pull + load(tree.damping, joint) * load(nu, 6 + joint)
            vec.add(work, force + 6 + joint, -pull)
    bodies.factorise(work, tree)
    # `solve` replaces the force M c by the accelerations c.
    bodies.solve(work, tree, force)
    vec.copy(work, force, rates, to, size)
    if orbit is not None:
        _turn_with_orbit(orbit, point, rates, to)
        return
    # By (3.2), dv_b/dt is the linear part of c plus gravity, minus omega_b x v_b.
    gravity = vec.across(vec.axes_of(point.q), vec.get3(robot.gravity, 0))
    transport = vec.cross(vec.get3(nu, 0), vec.get3(nu, 3))
    fall = vec.minus(gravity, transport)
    vec.put3(rates, to + 3, vec.plus(vec.get3(rates, to + 3), fall))


def _power(work, tree, nu):
    """Return the power [W] of the generalised force of inputs and disturbances, and of dampers."""
    total = 0.0
    for index in range(len(tree.row)):
        total = total + load(work, tree.offsets.c + index) * load(nu, index)
    for joint in range(len(tree.damping)):
        rate = load(nu, 6 + joint)
        total = total - load(tree.damping, joint) * rate * rate
    return total


@called
def _field_power(work, robot, orbit, point):
    """Return the power [W] that changes the Jacobi integral in an elliptic orbit (17.3)."""
    q, z = point.q, normal_at(orbit, point.q)
    zero = vec.minus(z, z)
    angular, linear = _momentum_error(work, robot, point.nu, (zero, zero))
    position = vec.across(vec.axes_of(q), vec.get3(q, 0))
    angular = vec.plus(angular, vec.cross(position, linear))
    power = orbit.now[RATE_CHANGE] * vec.dot(z, angular)
    return power - 0.5 * changing_field(work, robot.tree, orbit, q)


def _turn_with_orbit(orbit, point, rates, to):
    """Convert the accelerations c at `rates[to]` to d(nu)/dt relative to the frame (14.2)."""
    q, w, v = point.q, vec.get3(point.nu, 0), vec.get3(point.nu, 3)
    spin = spin_at(orbit, q)
    change = vec.times(normal_at(orbit, q), orbit.now[RATE_CHANGE])
    angular = vec.minus(vec.cross(w, spin), change)
    position = vec.across(vec.axes_of(q), vec.get3(q, 0))
    turning = vec.cross(vec.plus(w, vec.plus(spin, spin)), v)
    linear = vec.minus(pull_on(orbit, q, position), turning)
    vec.add6(rates, to, (angular, linear))


# Offsets of the four vectors in `MomentumReference.sums`.
IMPULSE, SHIFT, STEP_IMPULSE, STEP_SHIFT = 0, 6, 9, 15
SUMS = 18


class MomentumReference(namedtuple("MomentumReference", "start weight per_mass sums")):
    """Momentum and centre of mass that the robot must have by (11.2).

    All vectors are in world axes. The arrays may have a second axis of lanes.

    - `start` (12,): the initial linear and angular momentum (6,), the initial centre of mass (3,),
      and the point (3,) relative to which angular momentum and centre of mass are measured.
    - `weight` (3,): mass times gravity.
    - `per_mass` (1,): 1 / mass.
    - `sums` (18,): four vectors. The first two are for the time before the current step: the
      impulse (6,), and the displacement (3,) of the centre of mass due to the impulse. The other
      two are for the current step: the impulse (6,), and the displacement (3,) times the mass.
    """


MOMENTUM_REFERENCE = Struct(MomentumReference, LANED)


def add_wrench(work, robot, orbit, reference, point, weight, moment):
    """Add the external wrench at a stage of the integrator to the sums of the current step.

    `weight` [s] is the weight of the stage in an integral over the step. `moment` [s^2] is the
    weight of the stage in a double integral. In orbit, the work replaces the impulse, because the
    Jacobi integral replaces the momentum.
    """
    if orbit is not None:
        vec.add(reference.sums, STEP_IMPULSE, load(point.wrench, 0) * weight)
        return
    axes = vec.axes_of(point.q)
    moments, force = vec.get6(point.wrench, 0)
    position = vec.minus(vec.get3(point.q, 0), vec.get3(reference.start, 9))
    lever = vec.product(axes, vec.get3(work, robot.tree.offsets.subtree_inertias + 1))
    force, falls = vec.product(axes, force), vec.get3(reference.weight, 0)
    # The weight m g acts at the centre of mass. Its moment about the base's origin is `lever` x g,
    # where `lever` is m times the position of the centre of mass from the base's origin.
    torque = vec.plus(
        vec.product(axes, moments), vec.cross(position, vec.plus(force, falls))
    )
    torque = vec.plus(
        torque, vec.cross(vec.times(lever, load(reference.per_mass, 0)), falls)
    )
    force = vec.plus(force, falls)
    vec.add6(reference.sums, STEP_IMPULSE, vec.times6((force, torque), weight))
    vec.add3(reference.sums, STEP_SHIFT, vec.times(force, moment))


def end_step(reference, h):
    """Finish a step of h [s]: add the step's sums to the sums of the time before the step.

    The sums of the step are set to zero. The impulse before the step also displaces the centre of
    mass during the step.
    """
    per_mass = load(reference.per_mass, 0)
    shift = vec.times(vec.get3(reference.sums, IMPULSE), h)
    shift = vec.plus(shift, vec.get3(reference.sums, STEP_SHIFT))
    vec.add3(reference.sums, SHIFT, vec.times(shift, per_mass))
    vec.add6(reference.sums, IMPULSE, vec.get6(reference.sums, STEP_IMPULSE))
    vec.clear(reference.sums, STEP_IMPULSE, SUMS - STEP_IMPULSE)


def kept_at(reference, t):
    """Return the (linear, angular) momentum and the centre of mass of the reference at t [s].

    t must be the end of the last finished step.
    """
    momentum = vec.plus6(
        vec.get6(reference.start, 0), vec.get6(reference.sums, IMPULSE)
    )
    flown = vec.times(vec.get3(reference.start, 0), t * load(reference.per_mass, 0))
    shift = vec.plus(vec.get3(reference.start, 6), vec.get3(reference.sums, SHIFT))
    return momentum, vec.plus(shift, flown)


def start_at(work, robot, orbit, reference, point):
    """Write the robot's initial momentum and centre of mass into `reference.start`.

    `point` is the initial point. `configure` must be called before this function. The last three
    entries of `reference.start`, the point of reference, must already be set.
    """
    axes = vec.axes_of(point.q)
    tree = robot.tree
    lever = vec.get3(work, tree.offsets.subtree_inertias + 1)
    nothing = vec.minus(lever, lever)
    angular, linear = _momentum_error(work, robot, point.nu, (nothing, nothing))
    position = vec.minus(vec.get3(point.q, 0), vec.get3(reference.start, 9))
    linear = vec.times(vec.product(axes, linear), -1.0)
    angular = vec.minus(vec.cross(position, linear), vec.product(axes, angular))
    vec.put6(reference.start, 0, (linear, angular))
    lever = vec.times(vec.product(axes, lever), load(reference.per_mass, 0))
    vec.put3(reference.start, 6, vec.plus(position, lever))
    if orbit is not None:
        write_now(orbit, 0.0)
        _start_in_orbit(work, robot, orbit, reference, point)


def _start_in_orbit(work, robot, orbit, reference, point):
    """Replace the initial momentum in `reference.start` by the Jacobi integral and five zeros."""
    tree = robot.tree
    total = kinetic_energy(work, tree, point.nu)
    total = total + orbital_potential(work, tree, orbit, point.q)
    for joint in range(len(robot.index)):
        if robot.springy[joint]:
            stretch = joint_position(robot, point.q, joint) - load(robot.rest, joint)
            total = total + 0.5 * load(tree.stiffness, joint) * stretch * stretch
    vec.clear(reference.start, 0, 6)
    store(reference.start, 0, total)


def _momentum_error(work, robot, nu, momentum):
    """Return a given momentum minus the momentum of the robot at nu.

    Both momenta are (angular, linear) in base axes, about the base's origin.
    """
    tree = robot.tree
    offsets = tree.offsets
    # The momentum of the bodies is the product of nu with the six base rows of M. By symmetry, the
    # six entries of a joint in the base rows are the first six entries of the joint's row.
    error = vec.minus6(
        momentum,
        spatial_inertia_times(work, offsets.subtree_inertias, vec.get6(nu, 0)),
    )
    for index in range(6, len(tree.row)):
        row = vec.get6(work, offsets.packed + tree.row[index])
        error = vec.minus6(error, vec.times6(row, load(nu, index)))
    angular, linear = error
    for index in range(len(tree.stored_body)):
        angular = vec.minus(angular, stored_momentum(work, tree, index))
    return angular, linear


def impose(work, robot, reference, point, t):
    """Set the base's position and velocity so that momentum and centre of mass match the reference.

    t [s] is the end of the last finished step. `configure` must be called before this function. The
    equations are solved for the correction of the velocity, not for the velocity itself, because
    the correction is small and has small rounding errors.
    """
    tree, nu = robot.tree, point.nu
    offsets = tree.offsets
    axes = vec.axes_of(point.q)
    m = load(work, offsets.subtree_inertias)
    lever = vec.get3(work, offsets.subtree_inertias + 1)
    per_mass = 1.0 / m
    (linear, angular), center = kept_at(reference, t)
    position = vec.minus(center, vec.times(vec.product(axes, lever), per_mass))
    vec.put3(point.q, 0, vec.plus(position, vec.get3(reference.start, 9)))
    angular = vec.across(axes, vec.minus(angular, vec.cross(position, linear)))
    linear = vec.across(axes, linear)
    angular, linear = _momentum_error(work, robot, nu, (angular, linear))
    # Compute the correction w of omega_b with the robot's inertia about the robot's centre of mass.
    # Compute the correction of v_b from w and the error of the linear momentum.
    (xx, xy, xz), (yy, yz, zz) = vec.get6(work, offsets.subtree_inertias + 4)
    d = vec.times(lever, per_mass)
    about = vec.minus(angular, vec.cross(d, linear))
    p, q, r = lever[0] * d[0], lever[1] * d[1], lever[2] * d[2]
    a, b, c = xx - (q + r), yy - (p + r), zz - (p + q)
    f, g, h = xy + lever[0] * d[1], xz + lever[0] * d[2], yz + lever[1] * d[2]
    x, y, z = b * c - h * h, g * h - f * c, f * h - g * b
    inverse = 1.0 / (a * x + f * y + g * z)
    adjugate = (
        (x, y, z),
        (y, a * c - g * g, f * g - a * h),
        (z, f * g - a * h, a * b - f * f),
    )
    w = vec.times(vec.product(adjugate, about), inverse)
    vec.add6(nu, 0, (w, vec.plus(vec.times(linear, per_mass), vec.cross(d, w))))
