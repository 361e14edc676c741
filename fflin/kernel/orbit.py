r"""Motion relative to the rotating frame of an orbit, with the gravity gradient.

All vectors are in base axes, and positions are relative to the base's origin. The orbital frame
has the angular velocity s = theta' z. Here z is the orbit normal, r is the unit vector away from
the central body, and k is its gravitational parameter divided by the cube of the distance from the
central body. The gravity gradient gives a point at x the acceleration T x (14.1):

.. math:: T = k (3 r r^T - E)

A circular orbit has a constant k = n^2 and theta' = n. Only `write_now` knows how both depend on
time.
"""

import math
from collections import namedtuple

from fflin.kernel import vectors as vec
from fflin.kernel.bodies import add_column, at_parent, joint_axis, stored_momentum
from fflin.kernel.tree import FIELD, INERTIA, LANED, PLACE, REALS, Struct
from fflin.kernel.vectors import called, load

# Offsets in `Orbit.now`.
STRENGTH, RATE, RATE_CHANGE, ANGLE, FLUX, FLUX_CHANGE = 0, 1, 2, 3, 4, 7
STRENGTH_CHANGE, END = 10, 11

# Offsets in `Orbit.ellipse`.
ECCENTRICITY, MEAN_ANOMALY, START = 0, 1, 2

# Largest number of steps for Kepler's equation, as in `robot.orbit.eccentric_anomaly`.
_KEPLER_STEPS = 80


class Orbit(
    namedtuple(
        "Orbit",
        "outwards normal mean_motion ellipse latitude dipole pole distortion residual now",
    )
):
    """Orbit of the simulated robot.

    - `outwards`, `normal` (3,): the unit vectors r and z in the axes of the orbital frame.
    - `mean_motion` (1,) [rad/s].
    - `ellipse` (3,): eccentricity, and mean and true anomaly [rad] at t = 0; empty in a circular
      orbit.
    - `latitude` (1,): argument of latitude u [rad] at t = 0.
    - `dipole` (3,) [T]: amplitudes of the magnetic flux density (radial sin u, level cos u, polar)
      of the part of a dipole along the rotation axis, away from the central body, along the orbit
      and along the orbit normal, at a distance of one semi-major axis; zero without a field.
    - `pole` (5,): for a tilted dipole, the amplitude [T] of the other part, the longitude [rad] of
      its pole from the ascending node at t = 0, the angular velocity [rad/s] of the central body,
      and sine and cosine of the inclination; otherwise empty.
    - `distortion` (9,): columns of the matrix that multiplies the magnetic field, because the true
      field differs from the model; empty without a difference.
    - `residual` (3,) [A m^2]: residual dipole in base axes; empty without one.
    - `now` (11,): k [1/s^2], theta' [rad/s], theta'' [rad/s^2], the angle [rad] by which the
      orbital frame has rotated since t = 0, the magnetic flux density (3,) [T] in the axes of the
      orbital frame, the derivative (3,) of these three numbers, and the derivative of k [1/s^3].
      `write_now` writes all values.
    """


ORBIT = Struct(Orbit, REALS, {LANED: "distortion residual"})


def write_now(orbit, t):
    """Write the values of the orbit at time t [s] to `orbit.now`."""
    n = orbit.mean_motion[0]
    orbit.now[STRENGTH] = n * n
    orbit.now[RATE] = n
    orbit.now[RATE_CHANGE] = 0.0
    orbit.now[ANGLE] = n * t
    orbit.now[STRENGTH_CHANGE] = 0.0
    if len(orbit.ellipse) > 0:
        _write_ellipse(orbit, t)
    r, z = vec.get3(orbit.outwards, 0), vec.get3(orbit.normal, 0)
    along = vec.cross(z, r)
    rate = orbit.now[RATE]
    cosine, sine = vec.cosine_and_sine(orbit.latitude[0] + orbit.now[ANGLE])
    radial, level, polar = vec.get3(orbit.dipole, 0)
    flux = vec.plus(vec.times(r, radial * sine), vec.times(along, level * cosine))
    flux = vec.plus(flux, vec.times(z, polar))
    change = vec.times(r, rate * radial * cosine)
    change = vec.minus(change, vec.times(along, rate * level * sine))
    vec.put3(orbit.now, FLUX, flux)
    vec.put3(orbit.now, FLUX_CHANGE, change)
    if len(orbit.pole) > 0:
        _add_tilt(orbit, t)
    if len(orbit.ellipse) > 0:
        _scale_flux(orbit)


@called
def _add_tilt(orbit, t):
    """Add the magnetic field of the part of a dipole across the rotation axis at time t [s]."""
    r, z = vec.get3(orbit.outwards, 0), vec.get3(orbit.normal, 0)
    along = vec.cross(z, r)
    amplitude, longitude, spin = vec.get3(orbit.pole, 0)
    i_sine, i_cosine = orbit.pole[3], orbit.pole[4]
    cosine, sine = vec.cosine_and_sine(orbit.latitude[0] + orbit.now[ANGLE])
    x, y = vec.cosine_and_sine(longitude + spin * t)
    # Components of the unit vector (x, y, 0) away from the central body, along the orbit and along
    # the orbit normal, and their derivatives.
    rate = orbit.now[RATE]
    outer = cosine * x + sine * i_cosine * y
    level = cosine * i_cosine * y - sine * x
    polar = -i_sine * y
    outer_change = rate * level + spin * (sine * i_cosine * x - cosine * y)
    level_change = spin * (sine * y + cosine * i_cosine * x) - rate * outer
    polar_change = -spin * i_sine * x
    flux = vec.plus(vec.times(r, -2.0 * outer), vec.times(along, level))
    flux = vec.plus(flux, vec.times(z, polar))
    vec.add3(orbit.now, FLUX, vec.times(flux, amplitude))
    change = vec.plus(vec.times(r, -2.0 * outer_change), vec.times(along, level_change))
    change = vec.plus(change, vec.times(z, polar_change))
    vec.add3(orbit.now, FLUX_CHANGE, vec.times(change, amplitude))


def _scale_flux(orbit):
    """Scale the magnetic field to the distance in an elliptic orbit, by (a / r)^3."""
    n = orbit.mean_motion[0]
    scale = orbit.now[STRENGTH] / (n * n)
    flux = vec.times(vec.get3(orbit.now, FLUX), scale)
    growth = orbit.now[STRENGTH_CHANGE] / orbit.now[STRENGTH]
    change = vec.times(vec.get3(orbit.now, FLUX_CHANGE), scale)
    vec.put3(orbit.now, FLUX, flux)
    vec.put3(orbit.now, FLUX_CHANGE, vec.plus(change, vec.times(flux, growth)))


@called
def _write_ellipse(orbit, t):
    """Write the values of an elliptic orbit at time t [s], as `EllipticOrbit.at` computes them."""
    n = orbit.mean_motion[0]
    e = orbit.ellipse[ECCENTRICITY]
    mean = orbit.ellipse[MEAN_ANOMALY] + n * t
    whole_turns = 2.0 * math.pi * round(mean / (2.0 * math.pi))
    E = _eccentric_anomaly(mean - whole_turns, e)
    ratio = 1.0 - e * math.cos(E)
    climb = n * e * math.sin(E) / (ratio * ratio)
    rate = n * math.sqrt(1.0 - e * e) / (ratio * ratio)
    gradient = n * n / (ratio * ratio * ratio)
    sine = math.sqrt(1.0 + e) * math.sin(0.5 * E)
    cosine = math.sqrt(1.0 - e) * math.cos(0.5 * E)
    theta = 2.0 * math.atan2(sine, cosine) + whole_turns
    orbit.now[STRENGTH] = gradient
    orbit.now[RATE] = rate
    orbit.now[RATE_CHANGE] = -2.0 * climb * rate
    orbit.now[ANGLE] = theta - orbit.ellipse[START]
    orbit.now[STRENGTH_CHANGE] = -3.0 * climb * gradient


def _eccentric_anomaly(mean, e):
    """Solve Kepler's equation; see `robot.orbit.eccentric_anomaly`."""
    low = mean - e
    high = mean + e
    E = mean + e * math.sin(mean)
    for _ in range(_KEPLER_STEPS):
        residual = E - e * math.sin(E) - mean
        if residual > 0.0:
            high = min(high, E)
        else:
            low = max(low, E)
        following = E - residual / (1.0 - e * math.cos(E))
        if following < low or following > high:
            following = 0.5 * (low + high)
        if abs(following - E) <= 1e-16 * (1.0 + abs(E)):
            return following
        E = following
    return E


def outwards_at(orbit, q):
    """Return the unit vector r away from the central body, in base axes."""
    return vec.across(vec.axes_of(q), vec.get3(orbit.outwards, 0))


def normal_at(orbit, q):
    """Return the unit vector z along the orbit normal, in base axes."""
    return vec.across(vec.axes_of(q), vec.get3(orbit.normal, 0))


def spin_at(orbit, q):
    """Return the angular velocity of the orbital frame, in base axes."""
    return vec.times(normal_at(orbit, q), orbit.now[RATE])


def model_flux_at(orbit, q):
    """Return the magnetic flux density [T] of the model, without its errors, in base axes."""
    return vec.across(vec.axes_of(q), vec.get3(orbit.now, FLUX))


def flux_at(orbit, q):
    """Return the magnetic flux density [T] in base axes."""
    return _true_vector(orbit, q, FLUX)


def flux_rate_at(orbit, q, nu):
    """Return the time derivative [T/s] of the magnetic flux density in base axes."""
    change = _true_vector(orbit, q, FLUX_CHANGE)
    return vec.plus(change, vec.cross(flux_at(orbit, q), vec.get3(nu, 0)))


def _true_vector(orbit, q, at):
    """Return a vector of the true magnetic field in base axes; `now[at]` is the model's vector."""
    axes = vec.axes_of(q)
    vector = vec.get3(orbit.now, at)
    result = vec.across(axes, vector)
    if len(orbit.distortion) > 0:
        columns = vec.get_columns(orbit.distortion, 0)
        result = vec.across(axes, vec.product(columns, vector))
    return result


@called
def add_residual_torque(work, orbit, q, to):
    """Add the torque (3,) of the residual dipole, in base axes, to `work` from `to` on."""
    if len(orbit.residual) > 0:
        dipole = vec.get3(orbit.residual, 0)
        vec.add3(work, to, vec.cross(dipole, flux_at(orbit, q)))


def from_inertial_axes(orbit, a):
    """Return a vector of the axes of the orbital frame at t = 0 in the axes of the frame now."""
    z = vec.get3(orbit.normal, 0)
    cosine, sine = vec.cosine_and_sine(orbit.now[ANGLE])
    along_normal = vec.times(z, vec.dot(z, a) * (1.0 - cosine))
    turned = vec.plus(vec.times(a, cosine), along_normal)
    return vec.minus(turned, vec.times(vec.cross(z, a), sine))


def tide(r, k, x):
    """Return the acceleration T x of the gravity gradient at x."""
    return vec.times(vec.minus(vec.times(r, 3.0 * vec.dot(r, x)), x), k)


def pull_on(orbit, q, x):
    """Return the acceleration, relative to the orbital frame, of a mass at rest in it at x.

    Here x is relative to the origin of the orbital frame, and in base axes.
    """
    turning = vec.times(vec.cross(normal_at(orbit, q), x), orbit.now[RATE_CHANGE])
    return vec.minus(_conservative_pull(orbit, q, x), turning)


def _conservative_pull(orbit, q, x):
    """Return the part of `pull_on` that has a potential: without the change of the frame's rate."""
    now, z = orbit.now, normal_at(orbit, q)
    fall = tide(outwards_at(orbit, q), now[STRENGTH], x)
    across_normal = vec.minus(x, vec.times(z, vec.dot(z, x)))
    return vec.plus(fall, vec.times(across_normal, now[RATE] * now[RATE]))


def _inertia_times(work, at, w):
    """Return I w, where I is the inertia about the joint in the spatial inertia at work[at]."""
    (xx, xy, xz), (yy, yz, zz) = vec.get6(work, at + 4)
    return (
        vec.dot((xx, xy, xz), w),
        vec.dot((xy, yy, yz), w),
        vec.dot((xz, yz, zz), w),
    )


def add_gradient(work, tree, r, k):
    """Add the generalised force of the gravity gradient to work[tree.offsets.c].

    In the field region of `work`, write the position of each joint, and the moment and force of
    the field on the joint's subtree.
    """
    offsets = tree.offsets
    for body in range(len(tree.parent)):
        at = offsets.field + body * FIELD
        inertia = offsets.body_inertias + body * INERTIA
        if body == 0:
            vec.clear(work, at, 3)
        else:
            above = vec.get3(work, offsets.field + tree.parent[body] * FIELD)
            step = vec.get3(work, offsets.places + body * PLACE + 9)
            vec.put3(work, at, vec.plus(above, step))
        origin = vec.get3(work, at)
        m, h = load(work, inertia), vec.get3(work, inertia + 1)
        force = tide(r, k, vec.plus(vec.times(origin, m), h))
        turning = vec.cross(r, _inertia_times(work, inertia, r))
        moment = vec.cross(h, tide(r, k, origin))
        moment = vec.plus(moment, vec.times(turning, 3.0 * k))
        vec.put6(work, at + 3, (moment, force))
    for body in range(len(tree.parent) - 1, 0, -1):
        wrench = vec.get6(work, offsets.field + body * FIELD + 3)
        value = vec.dot6(joint_axis(work, tree, body), wrench)
        vec.add(work, offsets.c + tree.coordinate[body], value)
        to = offsets.field + tree.parent[body] * FIELD + 3
        vec.add6(work, to, at_parent(work, offsets.places + body * PLACE, wrench))
    vec.add6(work, offsets.c, vec.get6(work, offsets.field + 3))


def _subtract(work, at, value):
    vec.add(work, at, -value)


def subtract_gradient_slopes(work, tree, r, k):
    """Subtract the derivatives of the generalised force of the gravity gradient.

    They are subtracted from the matrix (6 + n, 12 + 2 n) of `derivatives.differentiate`, which is
    written before. The first three columns are for rotations of the base. `add_gradient` must have
    written the positions of the joints.
    """
    offsets = tree.offsets
    width = 2 * len(tree.row)
    lower = offsets.lower
    for body in range(len(tree.parent) - 1, 0, -1):
        inertia = offsets.subtree_inertias + body * INERTIA
        origin = vec.get3(work, offsets.field + body * FIELD)
        m, h = load(work, inertia), vec.get3(work, inertia + 1)
        column_i = tree.coordinate[body]
        row_i = lower + column_i * width
        w, linear = joint_axis(work, tree, body)
        # A unit motion of the joint displaces the mass at the position y from the joint by
        # `linear` + w x y. `shift` is the integral of this displacement over the subtree's mass.
        # The force of a mass at x becomes T (x + its displacement), and its point of action moves.
        shift = vec.plus(vec.times(linear, m), vec.cross(w, h))
        force = tide(r, k, shift)
        moment = vec.cross(shift, tide(r, k, origin))
        moment = vec.plus(moment, vec.cross(linear, tide(r, k, h)))
        moment = vec.plus(moment, vec.cross(h, tide(r, k, linear)))
        # The torque about the joint is 3 k r x (I r). A rotation w changes I by [w]x I - I [w]x.
        change = vec.cross(w, _inertia_times(work, inertia, r))
        other = _inertia_times(work, inertia, vec.cross(w, r))
        turning = vec.cross(r, vec.minus(change, other))
        moment = vec.plus(moment, vec.times(turning, 3.0 * k))
        wrench = moment, force
        above = body
        while above > 0:
            # The field has a potential, so the derivatives of joint forces are symmetric.
            column_j = tree.coordinate[above]
            row_j = lower + column_j * width
            value = vec.dot6(joint_axis(work, tree, above), wrench)
            _subtract(work, row_j + column_i, value)
            if above != body:
                _subtract(work, row_i + column_j, value)
            wrench = at_parent(work, offsets.places + above * PLACE, wrench)
            above = tree.parent[above]
        add_column(work, lower + column_i, width, vec.times6(wrench, -1.0))
        for index in range(3):
            _subtract(work, row_i + index, wrench[0][index])
    # A rotation of the base about the axis e changes T in base axes by -3 k (g r^T + r g^T), with
    # g = e x r.
    zero = 0.0
    one = 1.0
    axes = (one, zero, zero), (zero, one, zero), (zero, zero, one)
    inertia = offsets.subtree_inertias
    h = vec.get3(work, inertia + 1)
    for index in range(3):
        g = vec.cross(axes[index], r)
        force = vec.plus(vec.times(g, vec.dot(r, h)), vec.times(r, vec.dot(g, h)))
        moment = vec.cross(g, _inertia_times(work, inertia, r))
        moment = vec.plus(moment, vec.cross(r, _inertia_times(work, inertia, g)))
        change = vec.times6((moment, force), 3.0 * k)
        add_column(work, lower + index, width, change)


def kinetic_energy(work, tree, nu):
    """Return half of nu^T M nu, with the packed M."""
    total = 0.0
    for k in range(len(tree.row)):
        row = tree.row[k]
        momentum = 0.5 * load(work, tree.offsets.packed + row + tree.depth[k])
        momentum = momentum * load(nu, k)
        for t in range(tree.depth[k]):
            entry = load(work, tree.offsets.packed + row + t)
            momentum = momentum + entry * load(nu, tree.path[row + t])
        total = total + momentum * load(nu, k)
    return total


def changing_field(work, tree, orbit, q):
    """Return the integral of x^T G x over the mass, where G is dK/dt without its skew part.

    K is the matrix of (17.1), and x is the position in the orbital frame; see (17.3).
    """
    now, r, z = orbit.now, outwards_at(orbit, q), normal_at(orbit, q)
    inertia = tree.offsets.subtree_inertias
    m, h = load(work, inertia), vec.get3(work, inertia + 1)
    position = vec.across(vec.axes_of(q), vec.get3(q, 0))
    turning = 2.0 * now[RATE] * now[RATE_CHANGE]
    pulled = tide(r, now[STRENGTH_CHANGE], position)
    across_normal = vec.minus(position, vec.times(z, vec.dot(z, position)))
    pulled = vec.plus(pulled, vec.times(across_normal, turning))
    first = vec.plus(vec.times(position, m), vec.times(h, 2.0))
    total = vec.dot(pulled, first)
    along_r, along_z, trace = _second_moments(work, inertia, r, z)
    total = total + now[STRENGTH_CHANGE] * (3.0 * along_r - trace)
    return total + turning * (trace - along_z)


def _second_moments(work, inertia, r, z):
    """Return the integrals of (r y)^2, (z y)^2 and y^2 over the mass, y from the base's origin."""
    (xx, _, _), (yy, _, zz) = vec.get6(work, inertia + 4)
    trace = 0.5 * (xx + yy + zz)
    along_r = trace - vec.dot(r, _inertia_times(work, inertia, r))
    along_z = trace - vec.dot(z, _inertia_times(work, inertia, z))
    return along_r, along_z, trace


def orbital_potential(work, tree, orbit, q):
    """Return the potential energy [J] in the orbital frame, without springs (14.3)."""
    now, r, z = orbit.now, outwards_at(orbit, q), normal_at(orbit, q)
    inertia = tree.offsets.subtree_inertias
    m, h = load(work, inertia), vec.get3(work, inertia + 1)
    position = vec.across(vec.axes_of(q), vec.get3(q, 0))
    first = vec.plus(vec.times(position, 0.5 * m), h)
    total = vec.dot(_conservative_pull(orbit, q, position), first)
    # The integral of y^T K y over the mass, with y from the base's origin. It is the sum of the
    # products of K with the second moments P = tr(I) / 2 E - I.
    along_r, along_z, trace = _second_moments(work, inertia, r, z)
    second = now[STRENGTH] * (3.0 * along_r - trace)
    second = second + now[RATE] * now[RATE] * (trace - along_z)
    total = -(total + 0.5 * second)
    for index in range(len(tree.stored_body)):
        along = vec.dot(z, stored_momentum(work, tree, index))
        total = total - now[RATE] * along
    return total
