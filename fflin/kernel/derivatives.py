"""M^-1, accelerations and their slopes at many points, eight to an instruction."""

from __future__ import annotations

from fflin.kernel import factor, rnea
from fflin.kernel.crba import inwards, outwards
from fflin.kernel.lanes import compiled, inlined, load, splat, store
from fflin.kernel.slopes import differentiate
from fflin.kernel.tree import LANES
from fflin.kernel.vectors import get6, minus6, put6, times6


@inlined
def _invert(work, robot):
    """Write M^-1, and what tells whether it is sound."""
    tree, size = robot.tree, len(robot.tree.row)
    factor.invert_factor(work, tree)
    factor.multiply(work, tree, robot.judged)
    total = splat(work, 0.0)
    for row in range(size):
        total = total + robot.bounds[row] * load(work, tree.square + row * (size + 1))
    store(work, robot.judged + 1, total)


@inlined
def _push(work, robot):
    """Write the slopes over the inputs, columns of M^-1 or sums of them."""
    size, count, carried = len(robot.tree.row), len(robot.row), len(robot.loads.input)
    square, by_u = robot.tree.square, robot.by_u
    for row in range(size):
        for index in range(count):
            if robot.row[index] >= 0:
                value = load(work, square + row * size + robot.row[index])
                store(work, by_u + row * count + index, value)
        for index in range(carried):
            total = splat(work, 0.0)
            for k in range(size):
                column = load(work, robot.layout.columns + k * carried + index)
                total = total + load(work, square + row * size + k) * column
            store(work, by_u + row * count + robot.loads.input[index], total)


@inlined
def _solve(work, robot):
    """Write -M^-1 times the slopes of the forces, six columns at a time."""
    tree, layout, size = robot.tree, robot.layout, len(robot.tree.row)
    width = 2 * size
    zero = splat(work, 0.0)
    none = (zero, zero, zero), (zero, zero, zero)
    # The first six columns, of the base's turn and shift, are zeros.
    for row in range(size):
        put6(work, robot.slopes + row * width, none)
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
            put6(work, robot.slopes + column + row * width, total)


@compiled
def derive(robot, points, out, lanes, work, moves):
    """Write what `RowRates` returns of as many points as there are lanes at least."""
    q, nu, force, u = points
    c, A, by_u, judged = out
    tree, layout, loads, size = robot.tree, robot.layout, robot.loads, len(robot.tree.row)
    for block in range(0, len(q), LANES):
        # The last block begins early enough to fill the lanes; some points are done twice.
        first = min(block, len(q) - LANES)
        factor.pack(q, first, lanes.q)
        outwards(work, tree, lanes.q)
        if moves:
            factor.pack(nu, first, lanes.nu)
            factor.pack(force, first, lanes.force)
            factor.pack(u, first, lanes.u)
            rnea.move_bodies(work, tree, layout, lanes.nu)
            rnea.load_bodies(work, tree, layout, loads)
            rnea.load_carried(work, tree, layout, loads, lanes.u)
            rnea.load_momenta(work, tree, layout, loads)
        rnea.write_columns(work, tree, layout, loads)
        inwards(work, tree)
        factor.keep_diagonal(work, tree)
        factor.factorise(work, tree)
        if moves:
            rnea.collect(work, tree, layout)
            rnea.collect_momenta(work, tree, layout)
            for index in range(size):
                value = load(lanes.force, index) - load(work, layout.bias + index)
                store(work, layout.c + index, value)
            factor.solve(work, tree, layout.c)
        _invert(work, robot)
        _push(work, robot)
        factor.unpack(work, robot.by_u, by_u.shape[1], by_u, first, 0)
        factor.unpack(work, robot.judged, judged.shape[1], judged, first, 0)
        if moves:
            rnea.accelerate_bodies(work, tree, layout)
            differentiate(work, tree, layout, loads)
            _solve(work, robot)
            factor.unpack(work, layout.c, size, c, first, 0)
            lower = size * 2 * size
            factor.unpack(work, robot.slopes, lower, A, first, A.shape[1] - lower)
