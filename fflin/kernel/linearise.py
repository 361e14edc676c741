"""A, B and f0 about eight points at once, or about one."""

from __future__ import annotations

from fflin.kernel import factor, rnea
from fflin.kernel import words as of
from fflin.kernel.accelerations import Layout, Loads
from fflin.kernel.assembly import JUDGED, Equations, Places, Point, assemble, enter, judge, push
from fflin.kernel.crba import inwards, outwards
from fflin.kernel.factor import pack, unpack
from fflin.kernel.lanes import compiled, inlined, listed, load, splat, store
from fflin.kernel.slopes import differentiate
from fflin.kernel.tree import LANES, Tree
from fflin.kernel.vectors import copy, get6, minus6, put6, times6

FARTHEST = 1e6  # [rad], up to which sines and cosines are exact to rounding


@listed
def _differentiate(work, robot, point):
    """Write M^-1, c and its slopes over what acts but the inputs, before M^-1 is applied."""
    tree, layout, loads = robot.tree, robot.layout, robot.loads
    enter(work, robot, point)
    outwards(work, tree, point.q)
    rnea.move_bodies(work, tree, layout, point.nu)
    rnea.load_bodies(work, tree, layout, loads)
    rnea.load_carried(work, tree, layout, loads, point.pushing)
    rnea.load_momenta(work, tree, layout, loads)
    rnea.write_columns(work, tree, layout, loads)
    inwards(work, tree)
    rnea.collect(work, tree, layout)
    rnea.collect_momenta(work, tree, layout)
    factor.keep_diagonal(work, tree)
    factor.factorise(work, tree)
    for index in range(len(tree.row)):
        value = load(point.forces, index) - load(work, layout.bias + index)
        store(work, layout.c + index, value)
    factor.solve(work, tree, layout.c)
    factor.invert_factor(work, tree)
    factor.multiply(work, tree, robot.places.judged)
    push(work, robot)
    rnea.accelerate_bodies(work, tree, layout)
    differentiate(work, tree, layout, loads)


@inlined
def _solve_lanes(work, tree, layout, to):
    """Write -M^-1 slopes to the lower half of A, six columns at a time."""
    size = len(tree.row)
    width = 2 * size
    zero = splat(work, 0.0)
    none = (zero, zero, zero), (zero, zero, zero)
    # The first six columns, of q_b and r_b, are zeros that need no product.
    for column in range(width % 6 or 6, width, 6):
        slopes = layout.lower + column
        for k in range(size):
            put6(work, layout.held + k * 6, get6(work, slopes + k * width))
        for row in range(size):
            total = none
            for k in range(size):
                entry = load(work, tree.square + (row * size + k))
                held = get6(work, layout.held + k * 6)
                total = minus6(total, times6(held, entry))
            put6(work, to + column + row * width, total)


@inlined
def _solve_row_by_row(work, tree, layout, to):
    """Write -M^-1 slopes to the lower half of A, in loops along rows, as LLVM vectorises them."""
    size = len(tree.row)
    width = 2 * size
    for row in range(size):
        at = to + row * width
        for column in range(6, width):
            store(work, at + column, 0.0)
        for k in range(size):
            share, slopes = load(work, tree.square + row * size + k), layout.lower + k * width
            for column in range(6, width):
                value = load(work, at + column) - share * load(work, slopes + column)
                store(work, at + column, value)
    copy(work, to, work, layout.lower, size * width)  # which `assemble` leaves in base axes


@compiled
def linearise(robot, points, out, point, work):
    """Write the models about many points, as many as there are lanes at least."""
    # Of a moving reference f0 is its own rate; `judged` is as `places` says.
    q, v, u = points
    A, B, f0, x0, judged = out
    size, places = len(robot.order), robot.places
    for block in range(0, len(q), LANES):
        # The last block begins early enough to fill the lanes; some points are done twice.
        first = min(block, len(q) - LANES)
        pack(q, first, point.q)
        pack(v, first, point.v)
        pack(u, first, point.u)
        _differentiate(work, robot, point)
        _solve_lanes(work, robot.tree, robot.layout, places.A + 2 * size * size)
        assemble(work, robot, point)
        judge(work, robot)
        unpack(work, places.A, A.shape[1], A, first, 0)
        unpack(work, places.B, B.shape[1], B, first, 0)
        unpack(work, places.f0, f0.shape[1], f0, first, 0)
        unpack(work, places.x0, x0.shape[1], x0, first, 0)
        unpack(work, places.judged, JUDGED, judged, first, 0)


_TREE = of.kind_of(
    Tree,
    axes=of.REALS.copy(ndim=3),
    common=of.TABLE,
    unbounded=of.FLAGS,
    **dict.fromkeys(("parent", "index", "coordinate", "target", "row", "depth"), of.INDICES),
    path=of.INDICES,
    **dict.fromkeys(("entries", "places", "own", "inertias", "packed"), of.WHOLE),
    **dict.fromkeys(("scaled", "diagonal", "square", "size"), of.WHOLE),
)
_ROBOT = of.kind_of(
    Equations,
    tree=_TREE,
    layout=of.kind_of(Layout, of.WHOLE),
    loads=of.kind_of(Loads, **dict.fromkeys(("body", "input", "stored_body"), of.INDICES)),
    places=of.kind_of(Places, of.WHOLE),
    **dict.fromkeys(("order", "index", "row", "held", "turned"), of.INDICES),
    circling=of.FLAGS,
    own=of.WHOLE,
    moving=of.WHOLE,
)
KIND = of.numba.types.Tuple((_ROBOT, of.kind_of(Point), of.REALS))
_opened = of.opener(KIND)


@compiled
def linearise_one(words, q, v, u, A, B, f0, x0):
    """Write the model about a point, and return whether it is a sound one."""
    robot, rest, work = _opened(words)
    places, size, count = robot.places, len(robot.order), len(robot.row)
    width = 2 * size
    point = Point(q, v, u, rest.nu, rest.pushing, rest.forces)
    for at in range(7, len(q)):
        if not abs(q[at]) < FARTHEST:
            return False
    _differentiate(work, robot, point)
    light = 0.0
    for row in range(size):
        light += robot.bounds[row] * work[robot.tree.square + row * (size + 1)]
    _solve_row_by_row(work, robot.tree, robot.layout, places.A + width * size)
    assemble(work, robot, point)
    judge(work, robot)
    for row in range(width):
        for column in range(width):
            A[row, column] = work[places.A + row * width + column]
        f0[row], x0[row] = work[places.f0 + row], work[places.x0 + row]
    for row in range(size):
        for column in range(count):
            B[row, column] = 0.0
            B[size + row, column] = work[places.B + row * count + column]
    # NaN compares false.
    judged = work[places.judged], work[places.judged + 1], work[places.judged + 2]
    limits = robot.limits
    sound = limits[0] < judged[0] < limits[1] and judged[1] < limits[2]
    return sound and judged[2] >= limits[3] and light < limits[4]
