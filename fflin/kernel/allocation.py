"""Control allocation: convert commands for some inputs to commands for other inputs with limits.

The allocated inputs stay within their limits. They minimise the difference between their
accelerations and the accelerations of the command. An active set method solves this bounded least
squares problem. The method starts with all inputs at zero. If the bounds of an input exclude zero,
this input starts at the bound nearest to zero. The problem is strictly convex, so the solution does
not depend on the order in which inputs reach their bounds.

References
----------
C. L. Lawson and R. J. Hanson, Solving Least Squares Problems, SIAM, 1995, chapter 23.
"""

from collections import namedtuple

import numpy as np

from fflin.base.validation import Array
from fflin.kernel import vectors as vec
from fflin.kernel.bodies import factorise, solve_inwards, write_columns
from fflin.kernel.forward import MECHANICS, POINT, configure, push, turn_held
from fflin.kernel.orbit import model_flux_at, write_now
from fflin.kernel.tree import INDICES, LANED, Struct, empty
from fflin.kernel.vectors import Entries, called, load, root, store

# `solve` minimises the squared error of the scaled force plus LEAST^2 times the sum of the squared
# scaled inputs x. If several x produce the same force, the second term selects the x with the
# smallest norm.
LEAST = 1e-7

# Weight of a translation of the robot, if no input of the design pushes the robot. Then the torque
# about the centre of mass is exact, even if thrusters exert it only together with a force. Among
# the inputs that exert the torque, those with the smallest force are used. In a translation, motors
# hold their joints; passive joints count as if the force did not reach them.
LIGHT = 1e-3
_LOW, _HIGH, _FREE, _TRIED = 0, 1, 2, 4


class LeastSquares(
    namedtuple(
        "LeastSquares", "least most columns A Q R b y wanted x s low high state order"
    )
):
    """Problem: find bounded inputs x (k,) whose force is as near as possible to a given force.

    - `least`, `most` (k,): the bounds of x.
    - `columns`: k + 1 force vectors (size,), one after the other. The first k are the forces of
      unit inputs. The last is the given force.

    The other fields are work space:

    - `A`: the vectors of `columns` for one lane. The first k are divided by the Frobenius norm of
      the matrix that they form.
    - `Q`, `R`: QR factors of a matrix with one column (size + k,) for each free input. A column
      contains the force of its input from `A`, and then one entry for each of the k inputs. This
      entry is `LEAST` for the input of the column, and 0 for the other inputs.
    - `order`: the free inputs, in the order in which they became free.
    - `b`: first the right-hand side of the least squares problem, then its residual. `y`: the
      components of the right-hand side along the vectors of `Q`; later work space of `_steepest`.
    - `wanted`: the given force, scaled to length 1; later the force that x produces.
    - `s`: the least squares solution without bounds. `low`, `high`: the bounds of the scaled x.
    - `state`: for each input, whether it is free, at its lower bound or at its upper bound.
      `_TRIED` is added if the input could not leave its bound.
    """


class Allocation(
    namedtuple("Allocation", "asking giving point work translation excess problem back")
):
    """Allocation of commands for the inputs of the robot `asking` to the inputs of `giving`.

    The two robots differ only in their inputs. `point` holds q and inputs: first the inputs
    of `asking`, later the inputs of `giving`. `work` is work space. If `problem` has no inputs,
    nothing is allocated. `back` is the problem of `write_difference`: it finds the inputs of
    `asking` for a given force.

    `translation` is work space for three columns of M, one after the other: the generalised forces
    that accelerate the whole robot without rotation. `excess` (6 + n,) is the part of these forces
    that does not count as an error, see `LIGHT`.
    """


LEAST_SQUARES = Struct(LeastSquares, columns=LANED, state=INDICES, order=INDICES)
_ROBOTS = {"asking": MECHANICS, "giving": MECHANICS}
ALLOCATION = Struct(
    Allocation,
    **_ROBOTS,
    point=POINT,
    work=LANED,
    translation=LANED,
    problem=LEAST_SQUARES,
    back=LEAST_SQUARES,
)


def _row_product(a: Array, first: int, b: Array, second: int, count: int) -> float:
    total = 0.0
    for index in range(count):
        total += a[first + index] * b[second + index]
    return total


@vec.compiled_as(_row_product)
def row_product(a: Array, first: int, b: Array, second: int, count: int) -> float:
    """Return the scalar product of a[first : first + count] and b[second : second + count]."""
    return a[first : first + count].dot(b[second : second + count])


def _add_row(
    a: Array, first: int, share: float, b: Array, second: int, count: int
) -> None:
    for index in range(count):
        a[first + index] += share * b[second + index]


@vec.compiled_as(_add_row)
def add_row(
    a: Array, first: int, factor: float, b: Array, second: int, count: int
) -> None:
    """Add `factor` times b[second : second + count] to a[first : first + count], in place."""
    a[first : first + count] += factor * b[second : second + count]


def _row_products(a: Array, size: int, b: Array, out: Array) -> None:
    for index in range(len(out)):
        out[index] = _row_product(a, index * size, b, 0, size)


@vec.compiled_as(_row_products)
def row_products(a: Array, size: int, b: Array, out: Array) -> None:
    """Write to `out` the scalar products of b[:size] with the rows (size,) of a."""
    np.dot(a.reshape(len(out), size), b[:size], out)


def _remove_components(
    Q: Array, size: int, count: int, x: Array, out: Array, first: int
) -> None:
    # This is the modified Gram-Schmidt method. The least squares solution is as accurate as with
    # Householder's method, because `_fit` treats the right-hand side as the last column of the
    # matrix.
    for index in range(count):
        share = _row_product(Q, index * size, x, 0, size)
        _add_row(x, 0, -share, Q, index * size, size)
        out[first + index] = share


@vec.compiled_as(_remove_components)
def remove_components(
    Q: Array, size: int, count: int, x: Array, out: Array, first: int
) -> None:
    """Make x (size,) orthogonal to the first `count` rows of Q.

    These rows must be orthonormal. The components of x along them are written to `out`, from the
    index `first` on.
    """
    basis = Q[: count * size].reshape(count, size)
    components = basis.dot(x)
    x -= components.dot(basis)
    # Orthogonalise twice, because rounding errors leave part of the components after the first
    # pass.
    rest = basis.dot(x)
    x -= rest.dot(basis)
    np.add(components, rest, out[first : first + count])


def _write_scaled(source: Array, lane: int, share: float, target: Array) -> None:
    for index in range(len(target)):
        target[index] = share * vec.peek(source, index, lane)


@vec.compiled_as(_write_scaled)
def write_scaled(source: Array, lane: int, factor: float, target: Array) -> None:
    """Fill `target` with the first entries of one lane of `source`, multiplied by `factor`."""
    target[:] = factor * source[: len(target)]


def least_squares(least: Entries, most: Entries, size: int) -> LeastSquares:
    """Return a `LeastSquares` problem with the bounds `least` and `most` (k,), for forces (size,).

    All other arrays contain zeros, and have one axis.
    """
    count = len(least)
    lengths = dict.fromkeys(("x", "y", "s", "low", "high"), count)
    lengths |= dict.fromkeys(("columns", "A"), (count + 1) * size)
    lengths |= {"Q": count * (size + count), "R": count * count}
    lengths |= {"b": size + count, "wanted": size}
    zeros = {name: np.zeros(length) for name, length in lengths.items()}
    return empty(LEAST_SQUARES)._replace(
        least=least,
        most=most,
        state=np.zeros(count, dtype=np.intp),
        order=np.zeros(count, dtype=np.intp),
        **zeros,
    )


@called
def allocate(allocation, orbit, point, commanded, t):
    """Write to `point.u` the inputs of `giving` that replace a command for the inputs of `asking`.

    Within their bounds, these inputs minimise e^T M e, where e is the difference between their
    accelerations and the accelerations of the command. A translation of the robot counts in part,
    see `Allocation.excess`. If the problem has no inputs, the command is written unchanged. In
    orbit, magnetorquers act in the field at the time t [s]; `orbit` is None without an orbit.
    """
    if len(allocation.problem.least) == 0:
        vec.copy(commanded, 0, point.u, 0, len(point.u))
        return
    work, asking, giving = allocation.work, allocation.asking, allocation.giving
    work_point, tree, problem = allocation.point, asking.tree, allocation.problem
    size = len(tree.row)
    count = len(problem.least)
    columns = problem.columns
    vec.copy(point.q, 0, work_point.q, 0, len(work_point.q))
    configure(work, asking, work_point.q)
    _write_translation(work, tree, allocation.translation)
    factorise(work, tree)
    if orbit is not None:
        write_now(orbit, t)
    _write_columns(work, tree, orbit, point)
    vec.copy(commanded, 0, work_point.pushing, 0, len(commanded))
    _write_force(work, asking, work_point, columns, count * size)
    # Write the generalised forces of unit inputs of `giving`, one after the other.
    _write_columns(work, giving.tree, orbit, point)
    for unit in range(count):
        for index in range(count):
            store(work_point.pushing, index, 1.0 if index == unit else 0.0)
        _write_force(work, giving, work_point, columns, unit * size)
        _reduce_translation(allocation, columns, unit * size, size)
    for column in range(count + 1):
        _scale(work, tree, columns, column * size)
    for lane in range(vec.lane_count(point.u)):
        solve(problem, size, lane)
        for index in range(count):
            vec.poke(point.u, index, lane, problem.x[index])


@called
def write_difference(allocation, orbit, point, commanded):
    """Replace a command by the difference of the applied and the commanded inputs of `asking`.

    `point.u` contains the applied inputs of `giving`. Call this function after `allocate`, whose
    scaled forces it uses. With an allocation, the difference is the input of `asking` whose force
    is nearest to the difference of the achieved and the wanted force.
    """
    count = len(allocation.problem.least)
    inputs = len(commanded)
    if count == 0:
        for index in range(inputs):
            store(commanded, index, load(point.u, index) - load(commanded, index))
        return
    work, asking, back = allocation.work, allocation.asking, allocation.back
    work_point, tree = allocation.point, asking.tree
    achieved = allocation.problem.columns
    size = len(tree.row)
    _write_columns(work, tree, orbit, point)
    for unit in range(inputs):
        for index in range(inputs):
            store(work_point.pushing, index, 1.0 if index == unit else 0.0)
        _write_force(work, asking, work_point, back.columns, unit * size)
        _scale(work, tree, back.columns, unit * size)
    for k in range(size):
        lack = -load(achieved, count * size + k)
        for index in range(count):
            lack = lack + load(point.u, index) * load(achieved, index * size + k)
        store(back.columns, inputs * size + k, lack)
    for lane in range(vec.lane_count(commanded)):
        solve_unbounded(back, size, lane)
        for index in range(inputs):
            vec.poke(commanded, index, lane, back.x[index])


def _write_columns(work, tree, orbit, point):
    """Write the columns of B_u; in orbit, with the magnetic field that `orbit.now` contains."""
    if orbit is not None:
        write_columns(work, tree, model_flux_at(orbit, point.q))
    else:
        write_columns(work, tree, None)


def _write_translation(work, tree, translation):
    """Write the columns of M for the velocity of the base, from the packed M."""
    packed = tree.offsets.packed
    size = len(tree.row)
    for k in range(size):
        for axis in range(3):
            # The packed M is the lower triangle, and the base has the rows 0 to 5.
            row, column = max(k, 3 + axis), min(k, 3 + axis)
            entry = load(work, packed + tree.row[row] + column)
            store(translation, axis * size + k, entry)


def _reduce_translation(allocation, columns, at, size):
    """Subtract the part `excess` of the translation that a generalised force causes.

    The force begins at columns[at]. Its entries 3 to 5 are the sum of all external forces.
    """
    translation = allocation.translation
    push = vec.times(vec.get3(columns, at + 3), 1.0 / load(translation, 3))
    for k in range(size):
        part = push[0] * load(translation, k)
        part = part + push[1] * load(translation, size + k)
        part = part + push[2] * load(translation, 2 * size + k)
        part = part * allocation.excess[k]
        store(columns, at + k, load(columns, at + k) - part)


def _scale(work, tree, columns, at):
    """Replace a force f in `columns` by D^-1/2 L^-T f, whose squared norm is f^T M^-1 f."""
    solve_inwards(work, tree, columns, at)
    for k in range(len(tree.row)):
        pivot = load(work, tree.offsets.scaled + tree.row[k] + tree.depth[k])
        store(columns, at + k, load(columns, at + k) * root(pivot))


def _write_force(work, robot, point, columns, at):
    """Write the generalised force of the inputs `point.pushing` to `columns`, from index `at` on.

    First, the torques and forces of `point.pushing` that are in reference axes are rotated to base
    axes, in place.
    """
    turn_held(robot, point)
    push(work, robot.tree, point.pushing)
    vec.copy(work, robot.tree.offsets.c, columns, at, len(robot.tree.row))


@called
def solve(problem, size, lane):
    """Write the solution x for one lane to `problem.x`; x is NaN if the given force is NaN."""
    x = problem.x
    A = problem.A
    low = problem.low
    high = problem.high
    wanted = problem.wanted
    least = problem.least
    most = problem.most
    count = len(problem.least)
    write_scaled(problem.columns, lane, 1.0, A)
    last = count * size
    unit = root(row_product(A, 0, A, 0, last))
    force = root(row_product(A, last, A, last, size))
    # Also if no force is wanted, inputs whose bounds exclude zero must be balanced by others.
    force = unit if force == 0.0 else force
    nothing = not (unit > 0.0 and force > 0.0)
    scale = 1.0 if nothing else unit / force
    free = 0
    for j in range(count):
        low[j] = least[j] * scale
        high[j] = max(most[j] * scale, least[j] * scale + 1e-15)
        x[j] = min(max(0.0, low[j]), high[j])
        problem.state[j] = _LOW
        if least[j] != 0.0:
            problem.state[j] = _FREE
            problem.order[free] = j
            free += 1
    if not nothing:
        write_scaled(A[last:], 0, 1.0 / force, wanted)
        write_scaled(A, 0, 1.0 / unit, A)
        free, kept = _solve_scaled(problem, size, free, 0)
        # Replace the wanted force by the force that the inputs x produce. The difference between
        # these forces would cause rounding errors larger than the terms with LEAST.
        wanted[:] = 0.0
        for j in range(count):
            if x[j] != 0.0:
                add_row(wanted, 0, x[j], A, j * size, size)
        _solve_scaled(problem, size, free, kept)
    for j in range(count):
        x[j] = min(max(x[j] / scale, least[j]), most[j]) + 0.0 * force


@called
def solve_unbounded(problem, size, lane):
    """Write the solution without bounds for one lane to `problem.x`, as `solve` does with bounds.

    `solve` could do the same, but its code would be compiled once more, for half a minute.
    """
    x, s = problem.x, problem.s
    A, wanted = problem.A, problem.wanted
    count = len(x)
    last = count * size
    write_scaled(problem.columns, lane, 1.0, A)
    unit = root(row_product(A, 0, A, 0, last))
    force = root(row_product(A, last, A, last, size))
    for j in range(count):
        s[j] = 0.0
        problem.state[j] = _FREE
        problem.order[j] = j
    scale = 0.0
    if unit > 0.0 and force > 0.0:
        scale = force / unit
        write_scaled(A[last:], 0, 1.0 / force, wanted)
        write_scaled(A, 0, 1.0 / unit, A)
        _fit(problem, size, count, 0)
        # The second solution is for the force of the first one, as in `solve`.
        wanted[:] = 0.0
        for j in range(count):
            add_row(wanted, 0, s[j], A, j * size, size)
        _fit(problem, size, count, count)
    for j in range(count):
        x[j] = s[j] * scale + 0.0 * force


@called
def _solve_scaled(problem, size, free, kept):
    """Find the inputs whose force is closest to `wanted`, and write them to x.

    The iteration starts from the given x and `state`.

    `free` is the number of free inputs in `order`. The QR factors contain the columns of the first
    `kept` of these inputs. Return `free` and `kept` for the next call.
    """
    x, s, low, high = problem.x, problem.s, problem.low, problem.high
    state = problem.state
    order = problem.order
    count = len(problem.x)
    newest = -1
    for _ in range(20 * count):
        _fit(problem, size, free, kept)
        kept = free
        hit = -1
        step = 1.0
        for at in range(free):
            j = order[at]
            if not low[j] <= s[j] <= high[j]:
                bound = low[j] if s[j] < low[j] else high[j]
                reached = (bound - x[j]) / (s[j] - x[j])
                if hit < 0 or reached < step:
                    hit, step = at, reached
        if hit >= 0:
            for at in range(free):
                x[order[at]] += step * (s[order[at]] - x[order[at]])
            j = order[hit]
            x[j] = low[j] if s[j] < low[j] else high[j]
            state[j] = _LOW if s[j] < low[j] else _HIGH
            free = free - 1
            kept = hit
            for at in range(hit, free):
                order[at] = order[at + 1]
            if j != newest or step > 0.0:
                newest = -1
                continue
            # The input that was just released is beyond its bound again, because of rounding
            # errors. So another input is released instead.
            state[j] += _TRIED
            _fit(problem, size, free, kept)
            kept = free
        for j in range(count):
            if state[j] == _FREE:
                x[j] = s[j]
            elif hit < 0:
                state[j] %= _TRIED
        newest = _steepest(problem, size)
        if newest < 0:
            break
        state[newest] = _FREE
        order[free] = newest
        free += 1
    return free, kept


@called
def _fit(problem, size, free, kept):
    """Write the least squares solution for the free inputs to s, and the residual to b.

    First, the QR factors are extended by the columns of the free inputs from `order[kept]` on.
    """
    s, x, Q, R, b, y = problem.s, problem.x, problem.Q, problem.R, problem.b, problem.y
    order = problem.order
    A = problem.A
    count = len(problem.s)
    rows = size + count
    # Write the right-hand side to b: `wanted` minus the force of all inputs that are at their
    # bounds, and then -LEAST times each of these inputs.
    b[:] = 0.0
    write_scaled(problem.wanted, 0, 1.0, b[:size])
    for j in range(count):
        if problem.state[j] != _FREE and x[j] != 0.0:
            b[size + j] = -LEAST * x[j]
            add_row(b, 0, -x[j], A, j * size, size)
    # Extend Q by unit vectors, each orthogonal to all vectors before it.
    for at in range(kept, free):
        j = order[at]
        column = Q[at * rows : (at + 1) * rows]
        column[:] = 0.0
        write_scaled(A[j * size :], 0, 1.0, column[:size])
        column[size + j] = LEAST
        remove_components(Q, rows, at, column, R, at * count)
        length = root(row_product(column, 0, column, 0, rows))
        write_scaled(column, 0, 1.0 / length, column)
        R[at * count + at] = length
    remove_components(Q, rows, free, b, y, 0)
    for at in range(free - 1, -1, -1):
        value = y[at] / R[at * count + at]
        s[order[at]] = value
        if at > 0:
            add_row(y, 0, -value, R, at * count, at)


@called
def _steepest(problem, size):
    """Return the index of the input whose release from its bound reduces the cost fastest.

    Inputs that were tried and could not leave their bounds are excluded. If no release reduces the
    cost, return -1.
    """
    best = 0.0
    best_input = -1
    b = problem.b
    state = problem.state
    slopes = problem.y
    row_products(problem.A[: len(state) * size], size, b, slopes)
    for j in range(len(state)):
        if state[j] == _LOW or state[j] == _HIGH:
            slope = LEAST * b[size + j] + slopes[j]
            if state[j] == _HIGH:
                slope = -slope
            if slope > best:
                best, best_input = slope, j
    return best_input


def nearest(A: Array, b: Array, least: Array, most: Array) -> Array:
    """Return the u (k,) within the bounds `least` and `most` (k,) for which A u is nearest to b.

    If several u are equally good, the u with the smallest norm is returned.
    """
    problem = _problem_of(A, b, least, most)
    solve(problem, len(b), 0)
    return np.array(problem.x)


def nearest_unbounded(A: Array, b: Array) -> Array:
    """Return the u (k,) with the smallest norm for which A u is nearest to b."""
    bound = np.full(A.shape[1], np.inf)
    problem = _problem_of(A, b, -bound, bound)
    solve_unbounded(problem, len(b), 0)
    return np.array(problem.x)


def _problem_of(A: Array, b: Array, least: Array, most: Array) -> LeastSquares:
    """Return the problem in which A u must be nearest to b."""
    numbers = [0.0] * len(least)
    # Reading an entry is faster for lists than for arrays, so lists replace the arrays that are
    # read entry by entry.
    return least_squares(least.tolist(), most.tolist(), len(b))._replace(
        columns=np.concatenate((A.T.ravel(), b)),
        state=[0] * len(least),
        order=[0] * len(least),
        x=numbers.copy(),
        s=numbers.copy(),
        low=numbers.copy(),
        high=numbers.copy(),
    )
