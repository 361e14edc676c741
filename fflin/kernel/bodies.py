"""Inertia M (composite rigid body algorithm), and accelerations and forces of the bodies (RNEA).

All vectors are in base axes, so no vector is rotated from joint to joint. Moments and inertias of a
body are about its joint. If they were about the base's origin, the inertia of a light tool on a
long arm would lose digits. Row i of the packed M holds the entries up to the diagonal that can be
nonzero in M or its factor. Their column indices are the coordinates on the path from the base to
coordinate i; see `kernel.tree._paths`. If coordinate j is on this path, the path to j is the
beginning of the path to i. So the column indices of row j are also the first column indices of
row i.

References
----------
R. Featherstone, Rigid Body Dynamics Algorithms, Springer, 2008, chapter 5, sections 6.2 and 6.5.
"""

from fflin.kernel import vectors as vec
from fflin.kernel.tree import INERTIA, LOAD, MOTION, PLACE
from fflin.kernel.vectors import load, store

# Offsets of the motion vectors of each body: velocity, Psi', acceleration for c = 0, the
# acceleration that c adds to it, and Psi''. Here c is the acceleration of the coordinates (3.1).
# Psi' and Psi'' are defined in `kernel.derivatives`.
VELOCITY, PSI, BIAS, ADDED, PSI2 = 0, 6, 12, 18, 24
# Offsets of the loads of the subtree beyond each joint. MOMENTUM is the momentum p, MOMENTS are the
# columns of G, and STORED is the stored momentum h; see `kernel.derivatives`. FORCE is the moment
# and force that the motion of the subtree requires for c = 0, minus the wrenches of `load_carried`.
# Before `collect`, FORCE is for the single body. CARRIED is the moment and force that c requires;
# `accelerate_bodies` adds CARRIED to FORCE.
MOMENTUM, MOMENTS, STORED, FORCE, CARRIED = 0, 3, 12, 15, 21


def _inertia(work, at, place, bodies, first):
    """Write a body's inertia in base axes: mass m, first moment, and inertia about its joint."""
    axes = vec.get_columns(work, place)
    store(work, at, load(bodies, first))
    vec.put3(work, at + 1, vec.product(axes, vec.get3(bodies, first + 1)))
    # R I R^T with the rotation R = `axes`: u, v and w are the columns of R I, and each product with
    # a row of R I is a column of the symmetric result. Only six entries of the result are kept.
    (xx, xy, xz), (yy, yz, zz) = vec.get6(bodies, first + 4)
    u = vec.product(axes, (xx, xy, xz))
    v = vec.product(axes, (xy, yy, yz))
    w = vec.product(axes, (xz, yz, zz))
    _, yy, yz = vec.product(axes, (u[1], v[1], w[1]))
    zz = vec.product(axes, (u[2], v[2], w[2]))[2]
    vec.put6(work, at + 4, (vec.product(axes, (u[0], v[0], w[0])), (yy, yz, zz)))


def spatial_inertia_times(work, at, motion):
    """Return the product (moment, force) of a spatial inertia and a motion vector.

    The spatial inertia begins at work[at].
    """
    m, h = load(work, at), vec.get3(work, at + 1)
    (xx, xy, xz), (yy, yz, zz) = vec.get6(work, at + 4)
    w, v = motion
    turning = (
        vec.dot((xx, xy, xz), w),
        vec.dot((xy, yy, yz), w),
        vec.dot((xz, yz, zz), w),
    )
    return vec.plus(turning, vec.cross(h, v)), vec.plus(
        vec.times(v, m), vec.cross(w, h)
    )


def outwards(work, tree, q):
    """Write the poses and the inertias of all bodies at q, from the base to the tips."""
    offsets = tree.offsets
    places, body_inertias = offsets.places, offsets.body_inertias
    vec.put6(work, places, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    vec.put3(work, places + 6, (0.0, 0.0, 1.0))
    _inertia(work, body_inertias, places, tree.bodies, 0)
    for body in range(1, len(tree.parent)):
        at = places + body * PLACE
        value = load(q, tree.index[body])
        if tree.unbounded[body]:
            cosine = value
            sine = load(q, tree.index[body] + 1)
        elif tree.turns[body] != 0.0:
            cosine, sine = vec.cosine_and_sine(tree.turns[body] * value)
        else:
            cosine, sine = 1.0, 0.0
        first = body * PLACE
        axes = vec.get_columns(work, places + tree.parent[body] * PLACE)
        x = vec.product(axes, vec.get3(tree.fixed, first))
        y = vec.product(axes, vec.get3(tree.fixed, first + 3))
        z = vec.product(axes, vec.get3(tree.fixed, first + 6))
        origin = vec.product(axes, vec.get3(tree.fixed, first + 9))
        vec.put3(work, at, vec.plus(vec.times(x, cosine), vec.times(y, sine)))
        vec.put3(work, at + 3, vec.minus(vec.times(y, cosine), vec.times(x, sine)))
        vec.put3(work, at + 6, z)
        vec.put3(
            work, at + 9, vec.plus(origin, vec.times(z, tree.slides[body] * value))
        )
        _inertia(work, body_inertias + body * INERTIA, at, tree.bodies, body * INERTIA)


def inwards(work, tree):
    """Write the packed M, its diagonal and the composite inertias, from the tips to the base."""
    offsets = tree.offsets
    bodies = len(tree.parent)
    places, packed = offsets.places, offsets.packed
    inertias = offsets.subtree_inertias
    vec.clear(work, packed, len(tree.path))
    vec.copy(work, offsets.body_inertias, work, inertias, bodies * INERTIA)
    pair = 0
    for body in range(bodies - 1, 0, -1):
        at = inertias + body * INERTIA
        place = places + body * PLACE
        z = vec.get3(work, place + 6)
        axis = vec.times(z, tree.turns[body]), vec.times(z, tree.slides[body])
        moment, force = spatial_inertia_times(work, at, axis)
        # Convert the composite inertia to the parent's joint, and add it to the parent's inertia.
        m, h, d = load(work, at), vec.get3(work, at + 1), vec.get3(work, place + 9)
        (xx, xy, xz), (yy, yz, zz) = vec.get6(work, at + 4)
        e = vec.plus(h, vec.times(d, m))
        px, py, pz = d[0] * (h[0] + e[0]), d[1] * (h[1] + e[1]), d[2] * (h[2] + e[2])
        xy = xy - (d[0] * e[1] + h[0] * d[1])
        xz = xz - (d[0] * e[2] + h[0] * d[2])
        yz = yz - (d[1] * e[2] + h[1] * d[2])
        to = inertias + tree.parent[body] * INERTIA
        vec.add(work, to, m)
        vec.add3(work, to + 1, e)
        vec.add6(
            work,
            to + 4,
            ((xx + (py + pz), xy, xz), (yy + (px + pz), yz, zz + (px + py))),
        )
        # Add the entries of M for this joint: one for each joint on the path to the base, and six
        # for the base. `tree.target` and `tree.share` list them in this order.
        above = body
        while above > 0:
            place = places + above * PLACE
            z = vec.get3(work, place + 6)
            value = tree.turns[above] * vec.dot(z, moment)
            value = value + tree.slides[above] * vec.dot(z, force)
            vec.add(work, packed + tree.target[pair], tree.share[pair] * value)
            pair += 1
            moment, force = at_parent(work, place, (moment, force))
            above = tree.parent[above]
        row = vec.times6((moment, force), tree.share[pair])
        vec.add6(work, packed + tree.target[pair], row)
        pair += 1
    # Write the base's rigid-body block of M: inertia, first moment of mass, and mass of the robot.
    # The block is packed as if the six coordinates were a chain of joints.
    m = load(work, inertias)
    hx, hy, hz = vec.get3(work, inertias + 1)
    (xx, xy, xz), (yy, yz, zz) = vec.get6(work, inertias + 4)
    vec.put6(work, packed, ((xx, xy, yy), (xz, yz, zz)))
    vec.put6(work, packed + 6, ((0.0, hz, -hy), (m, -hz, 0.0)))
    vec.put3(work, packed + 12, (hx, 0.0, m))
    vec.put6(work, packed + 15, ((hy, -hx, 0.0), (0.0, 0.0, m)))
    for index in range(len(tree.row)):
        at = packed + (tree.row[index] + tree.depth[index])
        vec.add(work, at, tree.armature[index])
        store(work, offsets.diagonal + index, load(work, at))


def factorise(work, tree):
    """Factorise the packed M = L^T D L: replace M by the unit lower triangular L.

    In the array at `scaled`, which is packed in the same way, 1 / D is written to the diagonal.
    """
    offsets = tree.offsets
    packed, scaled = offsets.packed, offsets.scaled
    for k in range(len(tree.row) - 1, -1, -1):
        row = packed + tree.row[k]
        depth = tree.depth[k]
        inverse = 1.0 / load(work, row + depth)
        store(work, scaled + (tree.row[k] + depth), inverse)
        store(work, row + depth, 1.0)
        for t in range(depth - 1, -1, -1):
            share = load(work, row + t) * inverse
            other = packed + tree.row[tree.path[tree.row[k] + t]]
            for s in range(t + 1):
                at = other + s
                store(work, at, load(work, at) - share * load(work, row + s))
            store(work, row + t, share)


def solve_inwards(work, tree, x, first):
    """Replace the generalised force f by L^-T f; f begins at x[first].

    L is the factor of M, which `factorise` must have written.
    """
    packed = tree.offsets.packed
    for k in range(len(tree.row) - 1, -1, -1):
        value = load(x, first + k)
        row = tree.row[k]
        for t in range(tree.depth[k]):
            at = first + tree.path[row + t]
            store(x, at, load(x, at) - load(work, packed + row + t) * value)


def solve(work, tree, x):
    """Replace the generalised force f by M^-1 f; f begins at work[x].

    `factorise` must have written the factor of M.
    """
    packed, scaled = tree.offsets.packed, tree.offsets.scaled
    solve_inwards(work, tree, work, x)
    for k in range(len(tree.row)):
        row = tree.row[k]
        value = load(work, x + k) * load(work, scaled + row + tree.depth[k])
        for t in range(tree.depth[k]):
            value = value - load(work, packed + row + t) * load(
                work, x + tree.path[row + t]
            )
        store(work, x + k, value)


def invert_factor(work, tree):
    """Replace the factor L of `factorise` by U = L^-1, and write V = L^-1 D^-1 at `scaled`."""
    offsets = tree.offsets
    packed, scaled = offsets.packed, offsets.scaled
    for k in range(len(tree.row)):
        row = packed + tree.row[k]
        depth = tree.depth[k]
        for t in range(depth):
            total = -load(work, row + t)
            for s in range(t + 1, depth):
                other = packed + tree.row[tree.path[tree.row[k] + s]]
                total = total - load(work, row + s) * load(work, other + t)
            store(work, row + t, total)
            above = tree.path[tree.row[k] + t]
            pivot = load(work, scaled + (tree.row[above] + tree.depth[above]))
            store(work, scaled + (tree.row[k] + t), total * pivot)


def multiply(work, tree, judged):
    """Write M^-1 = U V^T at `square`, and the sum of all M_ii (M^-1)_ii at `judged`.

    `invert_factor` must have written U = L^-1 and V = L^-1 D^-1.
    """
    offsets = tree.offsets
    packed, scaled, square = offsets.packed, offsets.scaled, offsets.square
    size = len(tree.row)
    coupling = 0.0
    for i in range(size):
        left = packed + tree.row[i]
        for j in range(i + 1):
            right = scaled + tree.row[j]
            total = load(work, left) * load(work, right)
            for t in range(1, tree.common[i, j]):
                total = total + load(work, left + t) * load(work, right + t)
            store(work, square + (i * size + j), total)
            store(work, square + (j * size + i), total)
            if i == j:
                coupling = coupling + total * load(work, offsets.diagonal + i)
    store(work, judged, coupling)


def joint_axis(work, tree, body):
    """Return the motion (angular, linear) of a joint per unit rate of its coordinate."""
    z = vec.get3(work, tree.offsets.places + (body * PLACE + 6))
    share = tree.factor[body]
    return vec.times(z, share * tree.turns[body]), vec.times(
        z, share * tree.slides[body]
    )


def motion_cross(velocity, along):
    """Return the spatial cross product `velocity` x `along`.

    If `along` is fixed in a body with this velocity, the result is the time derivative of `along`.
    """
    w, v = velocity
    return vec.cross(w, along[0]), vec.plus(
        vec.cross(w, along[1]), vec.cross(v, along[0])
    )


def at_joint(work, at, place):
    """Return a motion vector of the parent, shifted from the parent's origin to the joint's origin.

    The motion vector begins at work[at], and the pose of the joint begins at work[place].
    """
    w, v = vec.get6(work, at)
    return w, vec.plus(v, vec.cross(w, vec.get3(work, place + 9)))


def at_parent(work, place, force):
    """Return a spatial force about the parent's origin; the given moment is about the joint."""
    return vec.plus(force[0], vec.cross(vec.get3(work, place + 9), force[1])), force[1]


def move_bodies(work, tree, nu, omega_b):
    """Write the velocities, Psi' and the accelerations of all bodies, from the base to the tips.

    The velocities are for v_b = 0, and the accelerations are for c = 0. `omega_b` is the angular
    velocity of the base relative to inertial space. The joint rates are entries of nu.
    """
    offsets = tree.offsets
    vec.clear(work, offsets.motion, MOTION)
    vec.put3(work, offsets.motion, omega_b)
    for body in range(1, len(tree.parent)):
        at = offsets.motion + body * MOTION
        above = offsets.motion + tree.parent[body] * MOTION
        place = offsets.places + body * PLACE
        rate = load(nu, tree.coordinate[body])
        axis = joint_axis(work, tree, body)
        velocity = at_joint(work, above + VELOCITY, place)
        psi = motion_cross(velocity, axis)
        bias = at_joint(work, above + BIAS, place)
        vec.put6(work, at + VELOCITY, vec.plus6(velocity, vec.times6(axis, rate)))
        vec.put6(work, at + PSI, psi)
        vec.put6(work, at + BIAS, vec.plus6(bias, vec.times6(psi, rate)))


def load_bodies(work, tree):
    """Write the moment and force that the motion of each single body requires for c = 0.

    The moment includes the gyroscopic torque of stored momentum.
    """
    offsets = tree.offsets
    for body in range(len(tree.parent)):
        at = offsets.load + body * LOAD + FORCE
        moving = offsets.motion + body * MOTION
        inertia = offsets.body_inertias + body * INERTIA
        w, v = vec.get6(work, moving + VELOCITY)
        turning, p = spatial_inertia_times(work, inertia, (w, v))
        moment, force = spatial_inertia_times(
            work, inertia, vec.get6(work, moving + BIAS)
        )
        moment = vec.plus(moment, vec.plus(vec.cross(w, turning), vec.cross(v, p)))
        vec.put6(work, at, (moment, vec.plus(force, vec.cross(w, p))))
    for index in range(len(tree.stored_body)):
        body = tree.stored_body[index]
        w = vec.get3(work, offsets.motion + body * MOTION)
        h = stored_momentum(work, tree, index)
        vec.add3(work, offsets.load + body * LOAD + FORCE, vec.cross(w, h))


def load_carried(work, tree, u):
    """Subtract the wrenches of the body-fixed inputs in u from the forces of the bodies."""
    for index in range(len(tree.wrench_body)):
        push = vec.times6(
            carried_wrench(work, tree, index), -load(u, tree.input[index])
        )
        vec.add6(work, tree.offsets.load + tree.wrench_body[index] * LOAD + FORCE, push)


def collect_momenta(work, tree):
    """Write the momentum p, the matrix G and the stored momentum h of each subtree.

    They are defined in `kernel.derivatives`. CARRIED is set to zero.
    """
    offsets = tree.offsets
    for body in range(len(tree.parent)):
        at = offsets.load + body * LOAD
        inertia = offsets.body_inertias + body * INERTIA
        w, v = vec.get6(work, offsets.motion + body * MOTION + VELOCITY)
        h = vec.get3(work, inertia + 1)
        vec.put3(work, at + MOMENTUM, spatial_inertia_times(work, inertia, (w, v))[1])
        # The second moments of mass, the sum of m r r^T, are tr(I) / 2 times the identity, minus I.
        (xx, xy, xz), (yy, yz, zz) = vec.get6(work, inertia + 4)
        trace = 0.5 * (xx + yy + zz)
        second = (trace - xx, -xy, -xz), (-xy, trace - yy, -yz), (-xz, -yz, trace - zz)
        for axis in range(3):
            column = vec.plus(vec.times(v, h[axis]), vec.cross(w, second[axis]))
            vec.put3(work, at + MOMENTS + 3 * axis, column)
        vec.clear(work, at + STORED, 3)
        vec.clear(work, at + CARRIED, 6)
    for index in range(len(tree.stored_body)):
        at = offsets.load + tree.stored_body[index] * LOAD + STORED
        vec.add3(work, at, stored_momentum(work, tree, index))
    for body in range(len(tree.parent) - 1, 0, -1):
        at = offsets.load + body * LOAD
        above = offsets.load + tree.parent[body] * LOAD
        d = vec.get3(work, offsets.places + body * PLACE + 9)
        p = vec.get3(work, at + MOMENTUM)
        vec.add3(work, above + MOMENTUM, p)
        vec.add3(work, above + STORED, vec.get3(work, at + STORED))
        columns = vec.get_columns(work, at + MOMENTS)
        for index in range(3):
            column = vec.plus(columns[index], vec.times(p, d[index]))
            vec.add3(work, above + MOMENTS + 3 * index, column)


def stored_momentum(work, tree, index):
    """Return the stored momentum number `index`, in base axes."""
    axes = vec.get_columns(work, tree.offsets.places + tree.stored_body[index] * PLACE)
    return vec.product(axes, vec.get3(tree.stored, 3 * index))


def carried_wrench(work, tree, index):
    """Return the wrench of a body-fixed unit input, in base axes and about its body's joint.

    For a magnetorquer, return its axis in place of the moment.
    """
    axes = vec.get_columns(work, tree.offsets.places + tree.wrench_body[index] * PLACE)
    moment, force = vec.get6(tree.wrench, 6 * index)
    return vec.product(axes, moment), vec.product(axes, force)


def add_column(work, at, width, force):
    """Add (moment, force) to the base's six rows of a column; the matrix has `width` columns."""
    for index in range(3):
        vec.add(work, at + index * width, force[0][index])
        vec.add(work, at + (3 + index) * width, force[1][index])


def write_columns(work, tree, flux):
    """Write the generalised forces of body-fixed unit inputs, as columns of B_u.

    `flux` is the magnetic flux density [T] in base axes, or None if there are no magnetorquers.
    """
    offsets = tree.offsets
    count = len(tree.wrench_body)
    vec.clear(work, offsets.columns, len(tree.row) * count)
    for index in range(count):
        body = tree.wrench_body[index]
        wrench = carried_wrench(work, tree, index)
        if flux is not None and tree.magnetic[index]:
            wrench = vec.cross(wrench[0], flux), wrench[1]
        while body > 0:
            value = vec.dot6(joint_axis(work, tree, body), wrench)
            at = offsets.columns + tree.coordinate[body] * count + index
            vec.add(work, at, value)
            wrench = at_parent(work, offsets.places + body * PLACE, wrench)
            body = tree.parent[body]
        add_column(work, offsets.columns + index, count, wrench)


def collect(work, tree):
    """Sum the bodies' forces over each subtree, and write the generalised bias forces.

    The sums start at the tips.
    """
    offsets = tree.offsets
    vec.clear(work, offsets.bias, len(tree.row))
    for body in range(len(tree.parent) - 1, 0, -1):
        force = vec.get6(work, offsets.load + body * LOAD + FORCE)
        value = vec.dot6(joint_axis(work, tree, body), force)
        vec.add(work, offsets.bias + tree.coordinate[body], value)
        to = offsets.load + tree.parent[body] * LOAD + FORCE
        vec.add6(work, to, at_parent(work, offsets.places + body * PLACE, force))
    vec.add6(work, offsets.bias, vec.get6(work, offsets.load + FORCE))


def accelerate_bodies(work, tree):
    """Write Psi'' and the accelerations that c adds, and add the forces that c requires to FORCE.

    c begins at work[tree.offsets.c]. `collect_momenta` must have set CARRIED to zero. The
    accelerations are computed from the base to the tips, the forces from the tips to the base.
    """
    offsets = tree.offsets
    vec.put6(work, offsets.motion + ADDED, vec.get6(work, offsets.c))
    for body in range(1, len(tree.parent)):
        at = offsets.motion + body * MOTION
        above = offsets.motion + tree.parent[body] * MOTION
        place = offsets.places + body * PLACE
        rate = load(work, offsets.c + tree.coordinate[body])
        axis = joint_axis(work, tree, body)
        added = at_joint(work, above + ADDED, place)
        acceleration = vec.plus6(added, at_joint(work, above + BIAS, place))
        velocity = at_joint(work, above + VELOCITY, place)
        turned = motion_cross(velocity, vec.get6(work, at + PSI))
        vec.put6(work, at + PSI2, vec.plus6(motion_cross(acceleration, axis), turned))
        vec.put6(work, at + ADDED, vec.plus6(added, vec.times6(axis, rate)))
    for body in range(len(tree.parent) - 1, 0, -1):
        at = offsets.load + body * LOAD
        added = vec.get6(work, offsets.motion + body * MOTION + ADDED)
        inertia = offsets.body_inertias + body * INERTIA
        inertial_force = spatial_inertia_times(work, inertia, added)
        carried = vec.plus6(vec.get6(work, at + CARRIED), inertial_force)
        vec.add6(work, at + FORCE, carried)
        to = offsets.load + tree.parent[body] * LOAD + CARRIED
        vec.add6(work, to, at_parent(work, offsets.places + body * PLACE, carried))
