"""Weights of a regulator by a rule: from the limits of the URDF, or by name."""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import eigh

from fflin.analysis.mechanics import rate_matrix, second_order
from fflin.analysis.ranks import Noisy, null_space
from fflin.analysis.reduction import (
    ignorable_wheels,
    regulated_part,
    rigid_forces,
    selection,
    without,
)
from fflin.base.errors import InputError, listed, unknown
from fflin.base.validation import Array
from fflin.control.loop_limits import (
    NOT_ENOUGH,
    Limit,
    efforts_left,
    growth,
    largest_use,
    limits_on,
    slowed,
)
from fflin.control.weights import GivenWeight, reweighed, sampled_cost, weights_of
from fflin.linear.model import LinearModel

# The bandwidth [rad/s] of a loop that no limit slows: it settles in about thirty seconds. With
# inputs held for h, the bandwidth is at most _HELD / h.
BANDWIDTH, _HELD = 0.2, 0.3

# Displacements from which the robot must return within its limits: a rotation of the base [deg], an
# offset of the base in radii of gyration, and a joint's [rad], [m], or this fraction of its range.
ROTATION, OFFSET, ANGLE, LENGTH, TRAVEL = 30.0, 0.1, 0.3, 0.1, 0.25

# What grows is held by a loop of at least this fraction of its rate of growth, and of the second
# fraction where the efforts have less. A slower one lets light joints swing by radians.
_OF_GROWTH, _LEAST_OF_GROWTH = 0.4, 0.25

# The inputs reach each mode by at least this fraction of the effort that holds it at rest. A mode
# that they reach less keeps its own decay.
_LEAST_REACH = 1e-3

# No input acts on a coordinate if the inputs' effect, relative to its inertia, is below this.
_IDLE = 1e-12

# Iterations for the bandwidth of a robot with dampers, whose effect depends on the bandwidth.
_PASSES = 4


class Weights(NamedTuple):
    """Weights of a continuous cost (nx, nx) and (nu, nu), the rule that made them, and w."""

    Q: Array
    R: Array
    rule: str
    bandwidth: float
    terms: tuple[Array, Array]  # what the largest of each coordinate (m,) and input (nu,) costs


class Pace(NamedTuple):
    """Bandwidth of a loop without active limits, and the fraction of the displacements."""

    bandwidth: float = BANDWIDTH  # [rad/s]
    fraction: float = 1.0
    hold: float = 0.0  # [s] that the inputs of a continuous model will be held for
    held: float = _HELD  # what the fastest of the loop may do within a hold [rad]


AT_A_POINT = Pace()


def default_weights(
    lin: LinearModel, pace: Pace = AT_A_POINT, momenta: Mapping[str, float] | None = None
) -> Weights:
    """Return weights with which a displaced robot comes back within the URDF's limits (10.7)."""
    m = len(lin.M)
    N = rate_matrix(lin)[:m, m:]
    if N.shape != lin.M.shape or not np.linalg.cond(N) < 1e8:
        raise InputError(
            f"the states of the model of '{lin.robot}' are not coordinates and their rates, which "
            "the default weights require; give Q and R"
        )
    damping, w = _damping(lin), pace.bandwidth
    for _ in range(_PASSES if damping.any() else 1):
        found = _of_inertia(lin, lin.M + damping / w, np.linalg.inv(N), pace, momenta or {})
        w, before = found.bandwidth, w
        if NOT_ENOUGH in found.rule or w > 0.97 * before:
            break
    return found


def _damping(lin: LinearModel) -> Array:
    """Return B (m, m) of viscous dampers, 0 where there are none."""
    m = len(lin.M)
    if lin.dt or not lin.A[m:, m:].any():  # samples show springs as damping too
        return np.zeros_like(lin.M)
    D = second_order(lin).D.values
    rates, modes = eigh(0.5 * (D + D.T), lin.M)
    # Coupling by motion moves energy between coordinates, and an orbit rotates them: no damping.
    size = np.sqrt(lin.M.diagonal())
    whole = max(np.abs(rates).sum(), np.abs(D / np.outer(size, size)).max())
    damped = bool(rates.sum() > 1e-9 * whole)
    forces = lin.M @ modes
    return (forces * rates.clip(0.0)) @ forces.T * damped


def _of_inertia(
    lin: LinearModel, M: Array, inverse: Array, pace: Pace, momenta: Mapping[str, float]
) -> Weights:
    """Return the weights of an inertia M (m, m) that damping adds to; N^-1 is `inverse`."""
    h, m, size = lin.dt or 1.0, len(M), displacements(lin, pace.fraction)
    theta = np.abs(inverse) @ size
    D = np.abs(M) @ theta / theta
    S = lin.M @ lin.B[m:] / h
    cost = (S**2 / D[:, None]).sum(axis=0)
    if not cost.all():
        raise InputError(
            f"input {lin.input_names[int(cost.argmin())]} has no effect on any coordinate; remove "
            "it, or give Q and R"
        )
    reach = _reach(S, cost, D)
    ratios, T = eigh(reach, M)
    back = T.T @ M  # T^-1
    # The slowest is to have the bandwidth w.
    unit = ratios[0]
    cost, reach, ratios = cost * unit, reach / unit, ratios / unit
    to_modes = back @ inverse
    on_positions = to_modes.T @ (np.sqrt(ratios)[:, None] * to_modes)
    on_positions = 0.5 * (on_positions + on_positions.T)
    # At w = 1, before anything slows it.
    stiffness = back.T @ (ratios[:, None] ** 0.75 * to_modes)
    gain = (S / cost).T @ np.linalg.solve(reach, stiffness)
    rates = ratios**0.375
    mass = np.ones(m) if (lin.M == M).all() else np.diag(T.T @ lin.M @ T)
    # The speeds of the coordinates, and the momenta of wheels, as the inputs add them up.
    room = {name: lin.limits.get(name, math.inf) for name in lin.state_names[m:]}
    room |= momenta
    added = (S / cost).T @ np.linalg.solve(reach, lin.M @ T)
    motors = [lin.input_names.index(name.removeprefix("qdot_m.")) for name in momenta]
    taken = np.vstack((T, added[motors]))
    use = largest_use(gain, size, lin.state_names)
    limits = [
        Limit(pace.bandwidth, ""),
        *limits_on("speed", room, _fastest(taken, rates, to_modes, size, lin, mass), 1.0),
        *limits_on("effort", efforts_left(lin), use, 2.0),
    ]
    limit, achieved = min(limits), ""
    rate = rate_matrix(lin)
    loaded = rate[m:].any() or rate[:m, :m].any()
    if loaded:
        grows = growth(lin)
        limit = max(limit, grows._replace(bandwidth=_OF_GROWTH * grows.bandwidth))
    if pace.hold or lin.dt:
        fastest = pace.held / ((pace.hold or lin.dt) * rates[-1])
        limit = min(limit, Limit(float(fastest), "the sampling time"))
    damped = (lin.M != M).any()
    on_velocities = _on_velocities(lin, S, cost, D / unit, damped) if loaded else None

    def costs(w: float) -> tuple[Array, Array]:
        Q = np.zeros_like(lin.A)
        Q[:m, :m] = h * on_positions
        if on_velocities:
            Q[m:, m:] = h * on_velocities(w)
        return Q, np.diag(h * cost / w**4)

    if loaded:
        driven = (S**2 / cost).sum(axis=1) > _IDLE * D / unit
        least = min(grows._replace(bandwidth=_LEAST_OF_GROWTH * grows.bandwidth), limit)
        limit, achieved = slowed(lin, costs, size, size * driven, limit, least)
    rule = _rule(lin, size, limit, achieved, pace.fraction * ROTATION) + (
        "; joint damping is included" if damped else ""
    )
    terms = h * on_positions.diagonal() * size**2, h * cost * use**2
    return Weights(*costs(limit.bandwidth), rule, limit.bandwidth, terms)


def _on_velocities(
    lin: LinearModel, S: Array, cost: Array, least: Array, damped: bool
) -> Callable[[float], Array]:
    """Return the weight (m, m) on velocities of (10.8), for a bandwidth."""
    m, X = len(lin.M), rate_matrix(lin)
    size = np.sqrt(least)
    values, directions = np.linalg.eigh((S / cost) @ S.T / np.outer(size, size))
    root = size[:, None] * directions * np.sqrt(values.clip(_LEAST_REACH))
    L = np.linalg.solve(lin.M, root)
    F, H = np.linalg.solve(L, X[m:, :m] @ X[:m, m:] @ L), np.linalg.solve(L, X[m:, m:] @ L)
    _, stiffness, modes = np.linalg.svd(F)
    own, back = H.T @ H * damped, np.linalg.inv(L)

    def at(w: float) -> Array:
        part = 2.0 * w**2 * (1.0 - w**2 / (stiffness + np.hypot(stiffness, w**2)))
        values, directions = np.linalg.eigh((modes.T * part) @ modes - own)
        rows = directions.T @ back
        weight = (rows.T * values.clip(0.0)) @ rows / w**4
        return 0.5 * (weight + weight.T)

    return at


def displacements(lin: LinearModel, fraction: float) -> Array:
    """Return what each coordinate (m,) is displaced by, a fraction of what it may be."""
    m = len(lin.M)
    names, units = lin.state_names[:m], lin.state_units[:m]
    radius = _radius_of_gyration(lin.M) if names[:6] == _BASE else 1.0
    size = np.empty(m)
    for i, (name, unit) in enumerate(zip(names, units, strict=True)):
        if name.startswith("q_b."):
            size[i] = math.sin(math.radians(fraction * ROTATION / 2.0))
        elif name.startswith("r_b."):
            size[i] = fraction * OFFSET * radius
        else:
            most = LENGTH if unit == "m" else ANGLE
            size[i] = fraction * min(most, TRAVEL * lin.limits.get(name, math.inf))
    return size


_BASE = tuple(f"{group}.{axis}" for group in ("q_b", "r_b") for axis in "xyz")


def _radius_of_gyration(M: Array) -> float:
    """Return the radius [m] at which a sphere would have the mass to have such moments."""
    mass = M[3, 3]
    center = np.array((M[4, 2] - M[5, 1], M[5, 0] - M[3, 2], M[3, 1] - M[4, 0])) / (2.0 * mass)
    moment = np.trace(M[:3, :3]) - 2.0 * mass * center @ center
    return math.sqrt(max(float(moment) / (2.0 * mass), 1e-300))


def _reach(S: Array, cost: Array, D: Array) -> Array:
    """Return S R^-1 S' (m, m), and D where no input acts."""
    reach = (S / cost) @ S.T
    idle = reach.diagonal() <= _IDLE * D
    reach[idle, idle] = D[idle]
    if np.linalg.eigvalsh(reach / np.sqrt(np.outer(D, D)))[0] < 1e-9:
        reach += np.diag(D)
    return reach


def _fastest(
    T: Array, rates: Array, to_modes: Array, size: Array, lin: LinearModel, mass: Array
) -> Array:
    """Return the largest of speeds (k,), T over the modes', on the way back at w = 1."""
    # Modes are of mass (m,), 1 where nothing damps them: what is left is their damping.
    most = np.sqrt((1.0 - mass) ** 2 + 2.0 * mass * rates**2)
    root = np.sqrt(most**2 - 4.0 * mass * rates**2 + 1e-12j)
    if not any(name.startswith("qdot_m.") for name in lin.limits):
        return np.zeros(len(T))
    first = 0.1 / rates[-1] ** (1 if (mass == 1.0).all() else 2)
    time = np.geomspace(first, 3.0, 60)[:, None]
    x = rates * time / math.sqrt(2.0)
    moving = math.sqrt(2.0) * rates * np.exp(-x) * np.sin(x)
    if (mass < 1.0).any():
        fast, slow = (np.exp((x - most) * time / (2.0 * mass)) for x in (-root, root))
        moving = (rates**2 * (slow - fast) / root).real
    return largest_use(T @ (moving[..., None] * to_modes), size, lin.state_names).max(axis=0)


def _rule(lin: LinearModel, size: Array, limit: Limit, achieved: str, turn: float) -> str:
    groups = [name.partition(".")[0] for name in lin.state_names[: len(size)]]
    base = [f"{turn:g} deg"] * ("q_b" in groups)
    if "r_b" in groups:
        base.append(f"{size[groups.index('r_b')]:.2g} m")
    joints: dict[str, float] = {}
    for group, unit, d in zip(groups, lin.state_units, size, strict=False):
        if group == "q_m" and unit != "kg^0.5 m":
            joints[unit] = max(d, joints.get(unit, 0.0))
    from_where = [f"{' and '.join(base)} of the base"] if base else []
    if joints:
        sizes = " or ".join(f"{d:.2g} {unit}" for unit, d in joints.items())
        from_where.append(f"{sizes} of the joints")
    source = "the limits of the URDF" if lin.limits else "mass and size (the URDF has no limits)"
    slow = f"; bandwidth limited by {limit.what}" if limit.what else ""
    if beyond := [name for name, room in efforts_left(lin).items() if room <= 0.0]:
        slow += f"; already at or beyond the URDF limit at the operating point: {listed(beyond)}"
    pace = achieved or f"bandwidth at least {limit.bandwidth:.3g} rad/s"
    return f"from {source}, for displacements of {' and '.join(from_where)}: {pace}{slow}"


# Along a trajectory the displacements are a tenth as large. They must decay within its duration:
# this many time constants fit in, of a loop no slower than at a point and no faster than _FASTEST.
# With held inputs the loop may be faster than at a point, since the sampled regulator is exact.
_BESIDE, _CONSTANTS, _FASTEST, _HELD_ALONG = 0.1, 15.0, 1.5, 1.0

# The speeds of wheels come back at this fraction of the bandwidth.
_SPEEDS = 0.1


def pace_along(duration: float, hold: float) -> Pace:
    """Return the pace of a loop along a trajectory of that duration [s]."""
    return Pace(min(max(_CONSTANTS / duration, BANDWIDTH), _FASTEST), _BESIDE, hold, _HELD_ALONG)


def rule_weights(
    lin: LinearModel,
    name: str | None,
    given: Mapping[str, Any] | None = None,
    *,
    wheel_speeds: bool | None = None,
    pace: Pace = AT_A_POINT,
) -> tuple[Array, Array, Array | None, str]:
    """Return Q, R and N of a model by a rule, changed by `given` weights, and the rule in words."""
    # The cost of a sampled model is the continuous one under the hold, where it is known what it
    # was sampled from. The rule is by default what the robot has in its `weights`, else "urdf".
    source = lin.generator or lin
    layers = [(given, False)] if given else []
    if name is None and lin.weights:
        layers.insert(0, (lin.weights, True))
        name = lin.weights.get("rule")
    terms: Array = np.zeros(sum(lin.B.shape))
    if name is None or name == "urdf":
        pace = pace._replace(hold=lin.dt or pace.hold)
        Q, R, rule, terms = _of_regulated(source, pace, wheel_speeds)
    elif name == "identity":
        nx, nu = lin.B.shape
        Q, R, rule = np.eye(nx), np.eye(nu), "identity: 1 on every state and every input"
    else:
        raise unknown("rule of weights", name, ("urdf", "identity"))
    given_weights: dict[int, GivenWeight] = {}
    named: dict[str, None] = {}
    for layer, of_robot in layers:
        weights, names = weights_of(lin, layer, of_robot)
        given_weights |= weights
        named |= dict.fromkeys(names)
    if named:
        Q, R = reweighed(lin, Q, R, terms, given_weights)
        rule = f"{', '.join(named)} as given, the others {rule}"
        rule += " (with this rule alone)" if terms.any() else ""
    if source.dt == lin.dt:
        return Q, R, None, rule
    return (*sampled_cost(source, lin.dt, Q, R), rule)


def _of_regulated(
    lin: LinearModel, pace: Pace, wheel_speeds: bool | None
) -> tuple[Array, Array, str, Array]:
    """Return Q (nx, nx), R, the rule and costs, for a model that may have wheels.

    The costs (nx + nu,) are those of the largest value of each state and input, 0 if the rule has
    none.
    """
    part = regulated_part(lin, wheel_speeds)
    if part is lin:
        Q, R, rule, _, (of_positions, of_inputs) = default_weights(lin, pace)
        return Q, R, rule, np.concatenate((np.tile(of_positions, 2), of_inputs))
    wheels, _ = ignorable_wheels(lin)
    body = regulated_part(without(lin, wheels))
    at = wheels[[lin.state_names[i + len(lin.M)] in lin.limits for i in wheels]]
    names, spin = [lin.state_names[i + len(lin.M)] for i in at], np.abs(lin.x0[at + len(lin.M)])
    most = np.array([lin.limits[name] for name in names])
    # A wheel that is at its limit already is counted as one at rest, and named in the report.
    room = np.where(spin < most, most - spin, most) / np.linalg.inv(lin.M).diagonal()[at]
    found = default_weights(body, pace, dict(zip(names, room, strict=True)))
    Q, R, rule, bandwidth, (of_positions, of_inputs) = found
    if beyond := [name for name, x, y in zip(names, spin, most, strict=True) if x >= y > 0.0]:
        rule += f"; already at or beyond the URDF limit at the operating point: {listed(beyond)}"
    S = selection(body.state_names, lin.state_names)
    Q = S.T @ Q @ S
    terms = np.concatenate((np.tile(of_positions, 2) @ S, of_inputs))
    if speeds := [name for name in part.state_names if name not in body.state_names]:
        S, slow = selection(speeds, lin.state_names), _SPEEDS * bandwidth
        # Inputs R^-1/2 Z n that turn no body change the speeds at X n.
        root, forces = np.sqrt(R.diagonal()), rigid_forces(without(lin, wheels)).values
        X = S @ lin.B / root @ null_space(Noisy.exact(forces / root))[0] / (lin.dt or 1.0)
        Q += slow**2 * S.T @ np.linalg.pinv(X @ X.T, 1e-9, hermitian=True) @ S
        rule = f"{rule}; wheel speeds at {slow:.3g} rad/s"
    return Q, R, rule, terms
