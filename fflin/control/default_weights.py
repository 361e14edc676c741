"""The weights that a regulator gets where none are given."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import eigh

from fflin.analysis.mechanics import second_order, slopes
from fflin.base.errors import InputError, listed
from fflin.base.validation import Array
from fflin.control.riccati import half_size, solve
from fflin.control.saturation import warn_beyond
from fflin.linear.model import LinearModel

# The bandwidth [rad/s] of a loop that no limit slows: it settles in about thirty seconds. Under a
# hold of h it is this much over h at the most.
BANDWIDTH, _HELD = 0.2, 0.3

# The displacements that the limits must bear: a turn of the base [deg], a way of it in radii of
# gyration, and a joint's [rad], [m], or this share of its travel.
TURN, WAY, ANGLE, LENGTH, TRAVEL = 30.0, 0.1, 0.3, 0.1, 0.25

# So many times the loops of springs and gravity are slowed.
_TRIALS = 8

# So many times the bandwidth is sought at which damping counts.
_PASSES = 4

_NOT_ENOUGH = ", which is not enough for all displacements"


class Weights(NamedTuple):
    """Weights of a continuous cost (nx, nx) and (nu, nu), the rule that made them, and w."""

    Q: Array
    R: Array
    rule: str
    bandwidth: float


class Pace(NamedTuple):
    """How fast a loop comes back that no limit slows, from which share of the displacements."""

    bandwidth: float = BANDWIDTH  # [rad/s]
    share: float = 1.0
    hold: float = 0.0  # [s] that the inputs of a continuous model will be held for
    held: float = _HELD  # what the fastest of the loop may do within a hold [rad]


AT_A_POINT = Pace()


class _Limit(NamedTuple):
    """The largest bandwidth that a limit leaves, and what limits it."""

    bandwidth: float
    what: str


def default_weights(
    lin: LinearModel, pace: Pace = AT_A_POINT, momenta: Mapping[str, float] | None = None
) -> Weights:
    """Return weights with which a displaced robot comes back within the URDF's limits (10.7)."""
    m = len(lin.M)
    N = slopes(lin)[:m, m:]
    if N.shape != lin.M.shape or not np.linalg.cond(N) < 1e8:
        raise InputError(
            f"the model of '{lin.robot}' has not the coordinates and their rates as states, which "
            "the default weights are made for; give Q and R"
        )
    damping, w = _damping(lin), pace.bandwidth
    for _ in range(_PASSES if damping.any() else 1):
        found = _of_inertia(lin, lin.M + damping / w, np.linalg.inv(N), pace, momenta or {})
        w, before = found.bandwidth, w
        if _NOT_ENOUGH in found.rule or w > 0.97 * before:
            break
    return found


def _damping(lin: LinearModel) -> Array:
    """Return B (m, m) of viscous dampers, 0 where there are none."""
    m = len(lin.M)
    if lin.dt or not lin.A[m:, m:].any():  # samples show springs as damping too
        return np.zeros_like(lin.M)
    D = second_order(lin).D.values
    rates, modes = eigh(0.5 * (D + D.T), lin.M)
    # What motion brings to one, it takes from another; what an orbit turns is not damped.
    size = np.sqrt(lin.M.diagonal())
    whole = max(np.abs(rates).sum(), np.abs(D / np.outer(size, size)).max())
    damped: Any = rates.sum() > 1e-9 * whole
    forces = lin.M @ modes
    return (forces * rates.clip(0.0)) @ forces.T * damped


def _of_inertia(
    lin: LinearModel, M: Array, inverse: Array, pace: Pace, momenta: Mapping[str, float]
) -> Weights:
    """Return the weights of an inertia M (m, m) that damping adds to; N^-1 is `inverse`."""
    h, m, size = lin.dt or 1.0, len(M), displacements(lin, pace.share)
    theta = np.abs(inverse) @ size
    D = np.abs(M) @ theta / theta
    S = lin.M @ lin.B[m:] / h
    cost = (S**2 / D[:, None]).sum(axis=0)
    if not cost.all():
        raise InputError(
            f"input {lin.input_names[int(cost.argmin())]} acts on nothing; leave it out, or give "
            "Q and R"
        )
    reach = _reach(S, cost, D)
    ratios, T = eigh(reach, M)
    back = T.T @ M  # T^-1
    # The slowest is to have the bandwidth w.
    cost, reach, ratios = cost * ratios[0], reach / ratios[0], ratios / ratios[0]
    to_modes = back @ inverse
    Q = np.zeros_like(lin.A)
    Q[:m, :m] = to_modes.T @ (np.sqrt(ratios)[:, None] * to_modes)
    Q = 0.5 * (Q + Q.T)
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
    limits = [
        _Limit(pace.bandwidth, ""),
        *_limits("speed", room, _fastest(taken, rates, to_modes, size, lin, mass), 1.0),
        *_limits("effort", _efforts(lin), _largest(gain, size, lin.state_names), 2.0),
    ]
    if pace.hold or lin.dt:
        fastest = pace.held / ((pace.hold or lin.dt) * rates[-1])
        limits.append(_Limit(float(fastest), "the time of the hold"))
    limit = min(limits)
    rate = slopes(lin)
    if rate[m:].any() or rate[:m, :m].any():
        limit = _slowed(lin, Q, cost, size, limit)
    R = np.diag(h * cost / limit.bandwidth**4)
    rule = _rule(lin, size, limit, pace.share * TURN) + (
        "; damping is counted in" if (lin.M != M).any() else ""
    )
    return Weights(h * Q, R, rule, limit.bandwidth)


def displacements(lin: LinearModel, share: float) -> Array:
    """Return what each coordinate (m,) is displaced by, a share of what it may be."""
    m = len(lin.M)
    names, units = lin.state_names[:m], lin.state_units[:m]
    radius = _radius_of_gyration(lin.M) if names[:6] == _BASE else 1.0
    size = np.empty(m)
    for i, (name, unit) in enumerate(zip(names, units, strict=True)):
        if name.startswith("q_b."):
            size[i] = math.sin(math.radians(share * TURN / 2.0))
        elif name.startswith("r_b."):
            size[i] = share * WAY * radius
        else:
            most = LENGTH if unit == "m" else ANGLE
            size[i] = share * min(most, TRAVEL * lin.limits.get(name, math.inf))
    return size


_BASE = tuple(f"{group}.{axis}" for group in ("q_b", "r_b") for axis in "xyz")


def _radius_of_gyration(M: Array) -> float:
    """Return the radius [m] at which a sphere would have the mass to have such moments."""
    mass = M[3, 3]
    way = np.array((M[4, 2] - M[5, 1], M[5, 0] - M[3, 2], M[3, 1] - M[4, 0])) / (2.0 * mass)
    moment = np.trace(M[:3, :3]) - 2.0 * mass * way @ way
    return math.sqrt(max(float(moment) / (2.0 * mass), 1e-300))


def _largest(K: Array, size: Array, names: tuple[str, ...]) -> Array:
    """Return the largest K d of all displacements d: the base's in any direction, joints' signs."""
    groups = np.array([name.partition(".")[0] for name in names[: len(size)]])
    scaled = K[..., : len(size)] * size
    total: Array = np.abs(scaled[..., (groups != "q_b") & (groups != "r_b")]).sum(axis=-1)
    for group in ("q_b", "r_b"):
        total += np.linalg.norm(scaled[..., groups == group], axis=-1)
    return total


def _reach(S: Array, cost: Array, D: Array) -> Array:
    """Return S R^-1 S' (m, m), and D where no input acts."""
    reach = (S / cost) @ S.T
    idle = reach.diagonal() <= 1e-12 * D
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
    return _largest(T @ (moving[..., None] * to_modes), size, lin.state_names).max(axis=0)


def _limits(what: str, room: Mapping[str, float], used: Array, power: float) -> list[_Limit]:
    """Return what is left of a bandwidth of 1, with a power of which what is used grows."""
    return [
        _Limit((most / size) ** (1.0 / power), f"the {what} of {name.partition('_m.')[2] or name}")
        for (name, most), size in zip(room.items(), used.tolist(), strict=True)
        if 0.0 < most < math.inf and size > 0.0
    ]


def _efforts(lin: LinearModel) -> dict[str, float]:
    """Return what the limits of the inputs leave beside what the point asks for."""
    inputs = zip(lin.input_names, lin.u0.tolist(), strict=True)
    return {name: lin.limits.get(name, math.inf) - abs(at) for name, at in inputs}


def _slowed(lin: LinearModel, Q: Array, cost: Array, size: Array, limit: _Limit) -> _Limit:
    """Return the bandwidth at which a loop with springs or gravity keeps within the limits."""
    for _ in range(_TRIALS):
        arguments = (lin.A, lin.B, Q, np.diag(cost / limit.bandwidth**4), None, lin.dt)
        try:
            solution: Any = half_size(*arguments) or solve(*arguments)
        except np.linalg.LinAlgError:
            break  # which the regulator tells with the reason
        use = _largest(solution.K, size, lin.state_names)
        share, what = min(_limits("effort", _efforts(lin), use, 2.0), default=_Limit(1.0, ""))
        if share >= 1.0 - 1e-6:
            return limit
        # What springs and gravity ask for stays however slow the loop.
        limit = _Limit(max(share, 0.3) * limit.bandwidth, what)
        asked = np.abs(lin.u0) + use
    else:
        high = np.array([lin.limits.get(name, math.inf) for name in lin.input_names])
        where = "at the displacements of the default weights"
        warn_beyond(lin.robot, where, lin.input_names, lin.input_units, asked[None], -high, high)
    return limit._replace(what=f"{limit.what}{_NOT_ENOUGH}")


def _rule(lin: LinearModel, size: Array, limit: _Limit, turn: float) -> str:
    groups = [name.partition(".")[0] for name in lin.state_names[: len(size)]]
    base = [f"{turn:g} deg"] * ("q_b" in groups)
    if "r_b" in groups:
        base.append(f"{size[groups.index('r_b')]:.2g} m")
    joints: dict[str, float] = {}
    for group, unit, d in zip(groups, lin.state_units, size, strict=False):
        if group == "q_m":
            joints[unit] = max(d, joints.get(unit, 0.0))
    from_where = [f"the base from {' and '.join(base)}"] if base else []
    if joints:
        sizes = " or ".join(f"{d:.2g} {unit}" for unit, d in joints.items())
        from_where.append(f"joints from {sizes}")
    source = "the limits of the URDF" if lin.limits else "mass and size, the URDF has no limits"
    slow = f", set by {limit.what}" if limit.what else ""
    if beyond := [name for name, room in _efforts(lin).items() if room <= 0.0]:
        slow += f"; the point alone asks {listed(beyond)} for more than the URDF allows"
    return (
        f"from {source}: {', '.join(from_where)} come back at {limit.bandwidth:.3g} rad/s or "
        f"faster{slow}"
    )
