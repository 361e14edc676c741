r"""Constraints: frames that coincide in some of their directions, in the simulation loop.

A constraint holds a frame of one body at a frame of another body, or at a frame of the world. A row
is one component of the twist of the second frame relative to the first frame, in axes of the first
frame. The rows of the Jacobian J are linearly independent. With the accelerations c of the robot
without constraints, and with the bias :math:`\gamma` of the rows, the constrained accelerations are

.. math:: c - M^{-1} J^T (J M^{-1} J^T)^{-1} (J c + \gamma)

The same operator corrects positions and velocities after each step. From M = L^T D L follows
:math:`J M^{-1} J^T = Z^T Z` with :math:`Z = D^{-1/2} L^{-T} J^T`. So Z = Q R, with an orthonormal
basis Q, gives the solution without the squared condition number of :math:`Z^T Z`.
`orthonormalise` and `respond` are this solution. Both engines use them; the Python engine computes
Z from another factor of M.

If all bodies that a constraint loads belong to one robot, the constraint exerts no wrench on the
robot: the first six columns of J are exactly zero. Both frames are loaded at the same point, the
origin of the first frame, so that action and reaction are collinear even if the frames do not
coincide exactly.
"""

from collections import namedtuple

from fflin.base.validation import Array
from fflin.kernel import bodies
from fflin.kernel import vectors as vec
from fflin.kernel.bodies import BIAS, VELOCITY, joint_axis, motion_cross
from fflin.kernel.tree import INDICES, LANED, MOTION, PLACE, REALS, Struct
from fflin.kernel.vectors import below, called, chosen, compiled_as, load, root, store

# Largest number of corrections of the position, and of the velocity, at the end of a step. The
# factors of the first correction serve for all, so a position error e becomes an error of order
# e^2, then e^3.
_CORRECTIONS = 3

# Sum of the squared errors of all rows, in m and rad or m/s and rad/s, up to which a position or a
# velocity is not corrected.
_CLOSED = 1e-24

# Smallest squared orthogonal fraction of a row for which the rows count as independent.
LEAST_FRACTION = 1e-10

# Offsets of the entries that `locate` writes for each pair of frames: the axes of the first frame,
# the vectors from the joints of both bodies to the origin of the first frame, the rotation vector
# of the second frame relative to the first for small rotations, and its position. The rotation
# vector and the position are in axes of the first frame, all other vectors are in base axes.
AXES, FIRST_LEVER, SECOND_LEVER, ROTATION, POSITION = 0, 9, 12, 15, 18
LOCATION = 21


class Constraints(
    namedtuple(
        "Constraints",
        "first second first_pose second_pose pair component location jacobian basis triangle "
        "error roots change multipliers forces squares least at packed twist",
    )
):
    """Constraints between k pairs of frames, with r independent rows, and their work space.

    - `first`, `second` (k,): the bodies of both frames. `first` is -1 for a frame of the world.
    - `first_pose`, `second_pose` (k, 12): the frames relative to the joint frames of their bodies,
      or to the world: three columns of the rotation, and the origin.
    - `pair` (r,): the pair of frames of each row. `component` (r,): the component of the relative
      twist, from 0 to 2 for the angular and from 3 to 5 for the linear velocity.

    All other fields are work space, with one column per lane.

    - `location` (k, 21): the locations of the frames; see `locate`.
    - `jacobian` (r, 6 + n): J. `basis` (r, 6 + n): the columns of Q. `triangle` (r, r): R.
    - `error` (r,): values of the rows that a correction must set to zero.
    - `roots` (6 + n,): the diagonal of D^(-1/2).
    - `change` (6 + n,): the correction of the accelerations, the velocities or the position.
      `multipliers` (r,): its multipliers.
    - `forces` (r,): the forces [N] and moments [N m] on the second frame in axes of the first
      frame, which the constraints exert at the first stage of the latest step.
    - `squares` (r,): the squared lengths of the columns of Z at the start; before, zeros.
    - `least` (1,): the smallest fraction of a column of Z that is orthogonal to the columns before
      it, squared, or the smallest of its squared length at the start. If it is zero, the rows are
      not independent.
    - `at` (nq,): a displaced configuration. `packed`: a copy of the packed M.
    - `twist` (6,): the relative twist of a pair of frames, in axes of the first frame.
    """


_OF_CONSTRAINTS = {
    INDICES: "first second pair component",
    REALS: "first_pose second_pose",
}
CONSTRAINTS = Struct(Constraints, LANED, _OF_CONSTRAINTS)


def _product_by_loop(left, first, right, second, count):
    """Compute `_product` in compiled code."""
    total = load(left, first) * load(right, second)
    for index in range(1, count):
        total = total + load(left, first + index) * load(right, second + index)
    return total


@compiled_as(_product_by_loop)
def _product(left, first, right, second, count):
    """Return the scalar product of `count` entries of two arrays."""
    return left[first : first + count].dot(right[second : second + count])


def _add_by_loop(target, to, factor, source, first, count):
    """Compute `_add` in compiled code."""
    for index in range(count):
        vec.add(target, to + index, factor * load(source, first + index))


@compiled_as(_add_by_loop)
def _add(target, to, factor, source, first, count):
    """Add `count` entries of an array, times a factor, to entries of another array."""
    target[to : to + count] += factor * source[first : first + count]


def orthonormalise(basis: Array, triangle: Array, least: Array, rows: int) -> None:
    """Replace the columns of Z in `basis` by the columns of Q, and write R to `triangle`.

    The columns are stored one after the other; their number is `rows`. The modified Gram-Schmidt
    method keeps the accuracy of the solutions. `least` (1,) is reduced to the smallest squared
    orthogonal fraction.
    """
    size = len(basis) // rows
    for i in range(rows):
        at = i * size
        # The squared length remains on the diagonal of R until column i is orthonormal.
        store(triangle, i * rows + i, _product(basis, at, basis, at, size))
    for i in range(rows):
        at = i * size
        square = _product(basis, at, basis, at, size)
        fraction = square / load(triangle, i * rows + i)
        store(least, 0, chosen(fraction, load(least, 0), fraction, load(least, 0)))
        length = root(square)
        store(triangle, i * rows + i, length)
        inverse = 1.0 / length
        for index in range(size):
            store(basis, at + index, load(basis, at + index) * inverse)
        # The processor computes the parts of all later columns at the same time.
        for j in range(i + 1, rows):
            part = _product(basis, at, basis, j * size, size)
            store(triangle, i * rows + j, part)
            _add(basis, j * size, -part, basis, at, size)


def respond(
    basis: Array, triangle: Array, error: Array, change: Array, forces: Array
) -> None:
    """Write the smallest y with Z^T y = -error to `change`, and its multipliers to `forces`.

    The multipliers are the values with Z forces = y. `orthonormalise` must have written Q and R.
    """
    rows = len(error)
    size = len(basis) // rows
    vec.clear(change, 0, size)
    for i in range(rows):
        total = -load(error, i)
        for j in range(i):
            total = total - load(triangle, j * rows + i) * load(forces, j)
        total = total / load(triangle, i * rows + i)
        store(forces, i, total)
        _add(change, 0, total, basis, i * size, size)
    for i in range(rows - 1, -1, -1):
        total = load(forces, i)
        for j in range(i + 1, rows):
            total = total - load(triangle, i * rows + j) * load(forces, j)
        store(forces, i, total / load(triangle, i * rows + i))


def _frame(work, tree, body, poses, index):
    """Return the axes of a frame and the vector from its body's joint to it, in base axes."""
    turn = vec.get_columns(work, tree.offsets.places + body * PLACE)
    x, y, z = vec.get_columns(poses, 12 * index)
    axes = vec.product(turn, x), vec.product(turn, y), vec.product(turn, z)
    return axes, vec.product(turn, vec.get3(poses, 12 * index + 9))


def _world_frame(q, poses, index):
    """Return the axes and the position of a frame of the world, both in base axes.

    The position is relative to the origin of the base.
    """
    base = vec.axes_of(q)
    x, y, z = vec.get_columns(poses, 12 * index)
    axes = vec.across(base, x), vec.across(base, y), vec.across(base, z)
    origin = vec.get3(poses, 12 * index + 9)
    return axes, vec.across(base, vec.minus(origin, vec.get3(q, 0)))


def _from_base(work, tree, body, position):
    """Return a position relative to a body's joint as a position relative to the base."""
    while body > 0:
        place = tree.offsets.places + body * PLACE
        position = vec.plus(position, vec.get3(work, place + 9))
        body = tree.parent[body]
    return position


@called
def locate(work, robot, constraints, q):
    """Write the locations of the frames at q; `bodies.outwards` must be called before."""
    tree = robot.tree
    location = constraints.location
    for pair in range(len(constraints.first)):
        to = pair * LOCATION
        first, second = constraints.first[pair], constraints.second[pair]
        others, lever = _frame(work, tree, second, constraints.second_pose, pair)
        position = _from_base(work, tree, second, lever)
        axes, origin = _world_frame(q, constraints.first_pose, pair)
        start = origin
        if first >= 0:
            axes, origin = _frame(work, tree, first, constraints.first_pose, pair)
            start = _from_base(work, tree, first, origin)
        apart = vec.minus(position, start)
        for axis in range(3):
            vec.put3(location, to + AXES + 3 * axis, axes[axis])
        vec.put3(location, to + FIRST_LEVER, origin)
        vec.put3(location, to + SECOND_LEVER, vec.minus(lever, apart))
        # If the axes coincide, the rate of this vector is the relative angular velocity. The
        # entries x and y are zero if the z axes coincide, whatever the rotation about z is.
        x, y, _ = axes
        a, b, c = others
        angle = 0.5 * (vec.dot(y, a) - vec.dot(x, b))
        rotation = -vec.dot(y, c), vec.dot(x, c), angle
        vec.put3(location, to + ROTATION, rotation)
        vec.put3(location, to + POSITION, vec.across(axes, apart))


def write_positions(constraints):
    """Write the position errors of all rows to `constraints.error`; call `locate` before.

    Return the sum of their squares.
    """
    for row in range(len(constraints.error)):
        at = constraints.pair[row] * LOCATION + ROTATION
        value = load(constraints.location, at + constraints.component[row])
        store(constraints.error, row, value)
    error = constraints.error
    return _product(error, 0, error, 0, len(error))


def write_velocities(constraints, nu):
    """Write the velocities of all rows to `constraints.error`; call `write_jacobian` before.

    Return the sum of their squares.
    """
    size = len(constraints.change)
    for row in range(len(constraints.error)):
        value = _product(constraints.jacobian, row * size, nu, 0, size)
        store(constraints.error, row, value)
    error = constraints.error
    return _product(error, 0, error, 0, len(error))


def _direction(constraints, row):
    """Return the axis of a row in base axes, and whether the row is an angular component."""
    component = constraints.component[row]
    at = constraints.pair[row] * LOCATION + AXES + 3 * (component % 3)
    return vec.get3(constraints.location, at), component < 3


@called
def _add_column(work, tree, constraints, pair, body, lever, sign):
    """Add the twists that a joint causes, at the end of a lever from the joint, to rows of J.

    The rows are the rows of a pair of frames.
    """
    size = len(constraints.change)
    axes = vec.get_columns(constraints.location, pair * LOCATION + AXES)
    w, v = joint_axis(work, tree, body)
    v = vec.plus(v, vec.cross(w, lever))
    twist = vec.across(axes, w), vec.across(axes, v)
    vec.put6(constraints.twist, 0, vec.times6(twist, sign))
    for row in range(len(constraints.error)):
        if constraints.pair[row] == pair:
            value = load(constraints.twist, constraints.component[row])
            at = row * size + tree.coordinate[body]
            vec.add(constraints.jacobian, at, value)


def _put_base(constraints, pair, lever):
    """Write the columns of the base into the rows of a pair; the lever is from the base."""
    size = len(constraints.change)
    for row in range(len(constraints.error)):
        if constraints.pair[row] == pair:
            axis, angular = _direction(constraints, row)
            if angular:
                vec.put3(constraints.jacobian, row * size, axis)
            else:
                columns = vec.cross(lever, axis), axis
                vec.put6(constraints.jacobian, row * size, columns)


@called
def write_jacobian(work, robot, constraints):
    """Write J; `locate` must be called before.

    The motions of the joints on the common path of both bodies to the base cancel.
    """
    tree = robot.tree
    places = tree.offsets.places
    location = constraints.location
    vec.clear(constraints.jacobian, 0, len(constraints.jacobian))
    for pair in range(len(constraints.first)):
        first, second = max(constraints.first[pair], 0), constraints.second[pair]
        first_lever = vec.get3(location, pair * LOCATION + FIRST_LEVER)
        second_lever = vec.get3(location, pair * LOCATION + SECOND_LEVER)
        # The index of a body is larger than the index of its parent. So the body with the larger
        # index is not on the path of the other one.
        while first != second:
            if second > first:
                _add_column(work, tree, constraints, pair, second, second_lever, 1.0)
                shift = vec.get3(work, places + second * PLACE + 9)
                second_lever = vec.plus(second_lever, shift)
                second = tree.parent[second]
            else:
                _add_column(work, tree, constraints, pair, first, first_lever, -1.0)
                shift = vec.get3(work, places + first * PLACE + 9)
                first_lever = vec.plus(first_lever, shift)
                first = tree.parent[first]
        if constraints.first[pair] < 0:
            _put_base(constraints, pair, second_lever)


def _solve_inwards(work, tree, basis, rows):
    """Replace the columns of J^T in `basis` by the columns of L^-T J^T.

    The result is the result of `bodies.solve_inwards` for each column. Here all columns share each
    entry of L, and the six entries of the base remain in registers until they are complete.
    """
    packed = tree.offsets.packed
    size = len(tree.row)
    for k in range(size - 1, 5, -1):
        row = tree.row[k]
        # The first six entries of each path belong to the base.
        for t in range(6, tree.depth[k]):
            entry, above = load(work, packed + row + t), tree.path[row + t]
            for i in range(rows):
                at = i * size
                vec.add(basis, at + above, -entry * load(basis, at + k))
    for i in range(rows):
        at = i * size
        base = vec.get6(basis, at)
        for k in range(size - 1, 5, -1):
            entries = vec.get6(work, packed + tree.row[k])
            base = vec.minus6(base, vec.times6(entries, load(basis, at + k)))
        vec.put6(basis, at, base)
    for k in range(5, 0, -1):
        for t in range(k):
            entry = load(work, packed + tree.row[k] + t)
            for i in range(rows):
                at = i * size
                vec.add(basis, at + t, -entry * load(basis, at + k))


@called
def factorise(work, tree, constraints):
    """Write Q and R for the present J; `bodies.factorise` must have factorised M."""
    basis, roots = constraints.basis, constraints.roots
    rows, size = len(constraints.error), len(tree.row)
    vec.copy(constraints.jacobian, 0, basis, 0, len(basis))
    _solve_inwards(work, tree, basis, rows)
    for k in range(size):
        scale = root(load(work, tree.offsets.scaled + tree.row[k] + tree.depth[k]))
        store(roots, k, scale)
        for row in range(rows):
            at = row * size + k
            store(basis, at, load(basis, at) * scale)
    for row in range(rows):
        at = row * size
        # A row that vanishes as a whole has only rounding errors, which can seem independent.
        square = _product(basis, at, basis, at, size)
        start = load(constraints.squares, row)
        start = chosen(0.0, start, start, square)
        store(constraints.squares, row, start)
        fraction, least = square / start, load(constraints.least, 0)
        store(constraints.least, 0, chosen(fraction, least, fraction, least))
    orthonormalise(basis, constraints.triangle, constraints.least, rows)


@called
def correct(work, tree, constraints):
    """Write the smallest change that sets `constraints.error` to zero, in the metric of M.

    The change is for accelerations, for velocities, or for a small displacement. `factorise` must
    be called before.
    """
    change = constraints.change
    respond(
        constraints.basis,
        constraints.triangle,
        constraints.error,
        change,
        constraints.multipliers,
    )
    # L^-1 D^(-1/2) y
    for k in range(len(tree.row)):
        row = tree.row[k]
        value = load(change, k) * load(constraints.roots, k)
        for t in range(tree.depth[k]):
            above = load(change, tree.path[row + t])
            value = value - load(work, tree.offsets.packed + row + t) * above
        store(change, k, value)


def _twist(work, tree, body, offset, lever):
    """Return a motion vector of a body at the point at the end of a lever from its joint.

    `offset` is `VELOCITY` or `BIAS`.
    """
    w, v = vec.get6(work, tree.offsets.motion + body * MOTION + offset)
    return w, vec.plus(v, vec.cross(w, lever))


@called
def write_accelerations(work, robot, constraints, point):
    """Write the accelerations of all rows, for the accelerations c of the free robot.

    They are the rows of A_2 - A_1 - V_1 x V_2, with the twists V of both frames at the origin of
    the first frame, and their spatial accelerations A. `forward.accelerate` must have written c and
    the motion of the bodies.
    """
    tree = robot.tree
    location = constraints.location
    size = len(constraints.change)
    for pair in range(len(constraints.first)):
        first, second = constraints.first[pair], constraints.second[pair]
        lever = vec.get3(location, pair * LOCATION + SECOND_LEVER)
        twist = _twist(work, tree, second, VELOCITY, lever)
        alpha, a = _twist(work, tree, second, BIAS, lever)
        if first >= 0:
            lever = vec.get3(location, pair * LOCATION + FIRST_LEVER)
            change = motion_cross(_twist(work, tree, first, VELOCITY, lever), twist)
            change = vec.plus6(change, _twist(work, tree, first, BIAS, lever))
            alpha, a = vec.minus6((alpha, a), change)
        else:
            # The accelerations c lack gravity, and the twist lacks the velocity v_b.
            gravity = vec.across(vec.axes_of(point.q), vec.get3(robot.gravity, 0))
            transport = vec.cross(twist[0], vec.get3(point.nu, 3))
            a = vec.plus(a, vec.minus(gravity, transport))
        for row in range(len(constraints.error)):
            if constraints.pair[row] == pair:
                axis, angular = _direction(constraints, row)
                value = vec.dot(axis, a)
                if angular:
                    value = vec.dot(axis, alpha)
                by_c = _product(
                    constraints.jacobian, row * size, work, tree.offsets.c, size
                )
                store(constraints.error, row, value + by_c)


@called
def constrain(work, robot, constraints, point, rates, to):
    """Correct the accelerations that `forward.accelerate` has written into `rates`.

    The multipliers are the forces of the constraints. Forces from the world are added to
    `point.wrench`.
    """
    tree = robot.tree
    size = len(tree.row)
    locate(work, robot, constraints, point.q)
    write_jacobian(work, robot, constraints)
    write_accelerations(work, robot, constraints, point)
    factorise(work, tree, constraints)
    correct(work, tree, constraints)
    for index in range(size):
        vec.add(rates, to + index, load(constraints.change, index))
    for row in range(len(constraints.error)):
        force = load(constraints.multipliers, row)
        for index in range(6):
            value = load(constraints.jacobian, row * size + index)
            vec.add(point.wrench, index, force * value)


def independent(constraints):
    """Return whether the rows were independent at all stages so far, in all lanes."""
    return below(LEAST_FRACTION, load(constraints.least, 0))


@called
def close(work, robot, constraints, point):
    """Correct position and velocity at the end of a step, such that the constraints hold.

    Before and after, the poses of the bodies and M are those of `point.q`.
    """
    tree, q, nu = robot.tree, point.q, point.nu
    locate(work, robot, constraints, q)
    write_jacobian(work, robot, constraints)
    square = write_positions(constraints)
    rate = write_velocities(constraints, nu)
    if below(square, _CLOSED) and below(rate, _CLOSED):
        return
    packed = tree.offsets.packed
    vec.copy(work, packed, constraints.packed, 0, len(tree.path))
    bodies.factorise(work, tree)
    factorise(work, tree, constraints)
    moved = False
    for _ in range(_CORRECTIONS):
        square = write_positions(constraints)
        if below(square, _CLOSED):
            break
        moved = True
        correct(work, tree, constraints)
        vec.displace(tree, q, constraints.change, constraints.at)
        _replace(q, constraints.at, square)
        bodies.outwards(work, tree, q)
        locate(work, robot, constraints, q)
    if moved:
        write_jacobian(work, robot, constraints)
    for _ in range(_CORRECTIONS):
        rate = write_velocities(constraints, nu)
        if below(rate, _CLOSED):
            break
        correct(work, tree, constraints)
        for index in range(len(nu)):
            vec.add(constraints.change, index, load(nu, index))
        _replace(nu, constraints.change, rate)
    if moved:
        bodies.inwards(work, tree)
    else:
        vec.copy(constraints.packed, 0, work, packed, len(tree.path))


def _replace(values, corrected, square):
    """Replace values by their corrections in the lanes in which the squared error is too large.

    The other lanes do not change, so a lane does not depend on the errors of other lanes.
    """
    for index in range(len(values)):
        value = chosen(_CLOSED, square, load(corrected, index), load(values, index))
        store(values, index, value)
