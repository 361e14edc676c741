"""Default weights of a regulator, derived from the limits of the URDF."""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.linalg import eigh

from fflin.analysis.mechanics import rate_matrix, second_order
from fflin.base.errors import InputError, listed
from fflin.base.names import state_keys
from fflin.base.validation import Array, Complex, Indices, Mask
from fflin.control.channel import warn_beyond
from fflin.control.optimal.riccati import rates_of, solve
from fflin.linear.model import LinearModel
from fflin.robot.rotors import motor_of

# Nominal bandwidth [rad/s], with which a loop settles in about 30 s. Limits may reduce it. If the
# inputs are held for h seconds, the frequency of the fastest mode is at most _HELD / h [rad/s].
BANDWIDTH, _HELD = 0.2, 0.3

# If the inputs hold the robot against gravity, the nominal bandwidth is at least this fraction of
# sqrt(g / r) [rad/s], with the radius of gyration r: slower loops leave its fall to the robot.
_OF_FALL = 0.25

# Design displacements, from which the robot must return without exceeding a limit: the ROTATION of
# the base about the centre of mass [deg], its OFFSET in radii of gyration, and the ANGLE [rad] or
# LENGTH [m] of a joint. A joint displacement is at most TRAVEL times the joint's position limit.
ROTATION, OFFSET, ANGLE, LENGTH, TRAVEL = 30.0, 0.1, 0.3, 0.1, 0.25

# If a mode is unstable, the initial bandwidth is at least _OF_GROWTH times the growth rate of the
# mode. Effort limits may then reduce the bandwidth, but only to _LEAST_OF_GROWTH times this rate.
# With a lower bandwidth, joints with a small inertia would swing by several radians. A sampling
# time that is too long for these bandwidths takes precedence.
_OF_GROWTH, _LEAST_OF_GROWTH = 0.4, 0.25

# In the weight on velocities (10.8), the effect S R^-1 S' of the inputs is raised to this fraction
# of D (10.7) in every direction in which the effect is smaller than this. A mode on which the
# inputs have a smaller effect keeps its open-loop decay.
_LEAST_REACH = 1e-3

# The inputs count as having no effect on coordinate i if the diagonal entry i of S R^-1 S' is at
# most this times the entry i of D (10.7), both about the centre of mass.
_IDLE = 1e-12

# Constraints carry an input if its weight is at most the first value times the largest weight. They
# carry a combination of inputs of a block if its squared effect is at most the second value.
_CARRIED, _CARRIED_TOGETHER = 1e-20, 1e-12

# Nor do the inputs have an effect in a direction in which the eigenvalue of S R^-1 S', in units of
# D, is below this.
_NO_EFFECT = 1e-9

# Largest number of iterations for the bandwidth of a robot with dampers. Iterations are needed,
# because the bandwidth depends on the inertia M + B / w, which depends on the bandwidth w.
_PASSES = 4

# Largest number of bandwidths that `_slowed` tries. For each bandwidth, it estimates the factor
# `left`: at `left` times the bandwidth, the first effort reaches its limit. If `left` is below 1
# for every bandwidth, `_slowed` chooses the highest bandwidth whose `left` is at least _IN_VAIN
# times the largest `left`. A lower bandwidth would hardly reduce the efforts.
_TRIALS, _IN_VAIN = 8, 0.9

# The report names a mode if its decay rate is below this fraction of the nominal decay rate, which
# is sqrt(1/2) times the bandwidth.
_AS_SLOW = 0.9

_NOT_ENOUGH = "is too small for all displacements"


# Weights Q (nx, nx) and R (nu, nu), a description of their rule, the bandwidth of the loop [rad/s],
# and the costs (nx + nu,). Each cost is the contribution of a state or input to the cost function
# at the largest value of this state or input. The rate of a coordinate has the cost of the
# coordinate.
Weights: TypeAlias = tuple[Array, Array, str, float, Array]


class Pace(NamedTuple):
    """Nominal bandwidth of a loop, size of the displacements, and hold time of inputs."""

    bandwidth: float = BANDWIDTH  # [rad/s]
    fraction: float = 1.0  # factor on the design displacements
    hold: float = 0.0  # [s], hold time of the inputs; 0 if they are continuous
    # [rad], largest permitted product of mode frequency and hold time
    held: float = _HELD
    slower: float = 1.0  # factor by which the bandwidth of the loop is divided
    most: float = math.inf  # [rad/s], largest bandwidth


def pace_of(lin: LinearModel) -> Pace:
    """Return the nominal pace for a model.

    On average, an input acts h/2 later than the state from which it is computed, with the sampling
    time h. A delay tau adds to this time, and so counts like 2 tau of hold time. At low
    frequencies, a lag acts like a delay of its time constant.
    """
    late = float((lin.delay + lin.lag).max(initial=0.0))
    return Pace(hold=lin.dt + 2.0 * late)


class Limit(NamedTuple):
    """Bandwidth [rad/s], with a description of the limit or unstable mode that determines it."""

    bandwidth: float
    what: str


def default_weights(
    lin: LinearModel, pace: Pace, momenta: Mapping[str, float]
) -> Weights:
    """Return the weights (10.7), with which a displaced robot returns without exceeding its limits.

    `momenta` maps the speed of each wheel that has a motor to the largest momentum [N m s] that the
    motor may add to the wheel.
    """
    m = len(lin.M)
    N = rate_matrix(lin)[:m, m:]
    if N.shape != lin.M.shape or not np.linalg.cond(N) < 1e8:
        raise InputError(
            f"the states of the model of '{lin.robot}' are not coordinates and their rates, which "
            "the default weights require; give Q and R"
        )
    pace = pace._replace(bandwidth=max(pace.bandwidth, _OF_FALL * _rate_of_fall(lin)))
    to_velocities = np.linalg.inv(N)
    weights = _within_limits(lin, to_velocities, pace, momenta)
    if pace.slower == 1.0:
        return weights
    bandwidth = weights[3]
    slower = pace._replace(most=bandwidth / pace.slower)
    return _within_limits(lin, to_velocities, slower, momenta)


def _within_limits(
    lin: LinearModel, to_velocities: Array, pace: Pace, momenta: Mapping[str, float]
) -> Weights:
    """Return the weights of a pace, whose bandwidth is reduced as the limits require.

    `to_velocities` (m, m) maps the rates of the coordinates to the velocities of the model.
    """
    damping = _damping(lin)
    w = min(pace.bandwidth, pace.most)
    passes = _PASSES if damping.any() else 1
    for _ in range(passes):
        before = w
        M = lin.M + damping / w
        Q, R, rule, w, terms = _of_inertia(lin, M, to_velocities, pace, momenta)
        if _NOT_ENOUGH in rule or w > 0.97 * before:
            break
    return Q, R, rule, w, terms


def _damping(lin: LinearModel) -> Array:
    """Return the viscous damping matrix (m, m): the positive semidefinite part of D.

    The matrix is zero for a model without damping, and for a sampled model.
    """
    undamped = np.zeros_like(lin.M)
    m = len(lin.M)
    # In the matrix A of a sampled model, springs look like damping, so damping is ignored.
    if lin.dt or not lin.A[m:, m:].any():
        return undamped
    D = second_order(lin).D.values
    # The generalised eigenvalues of the symmetric part are damping rates [1/s].
    rates, modes = eigh(0.5 * (D + D.T), lin.M)
    # Gyroscopic coupling and orbital motion may add damping rates of both signs. These rates sum to
    # zero, because conservative motion preserves volumes in phase space. If the rates of a model
    # sum to zero, apart from rounding, the model counts as undamped.
    size = np.sqrt(lin.M.diagonal())
    largest_entry = np.abs(D / np.outer(size, size)).max()
    scale = max(np.abs(rates).sum(), largest_entry)
    if not rates.sum() > 1e-9 * scale:
        return undamped
    # With the modes V, V^T M V = E. So the symmetric part is (M V) diag(rates) (M V)^T. Negative
    # rates are omitted.
    momenta = lin.M @ modes
    damping: Array = (momenta * rates.clip(0.0)) @ momenta.T
    return damping


class ModalCost(NamedTuple):
    """Cost (10.7) for a bandwidth of 1 rad/s, and the m modes of the closed loop.

    The cost is scaled so that the slowest mode has the frequency 1 rad/s.
    """

    on_inputs: Array  # (nu,), diagonal of R
    on_positions: Array  # (m, m), weight on the coordinates
    scale: float  # factor by which the cost was multiplied
    gain: Array  # (nu, m), from coordinates to inputs
    frequencies: Array  # (m,) [rad/s], ascending
    # (m, m), columns of T V Lambda^(-1/2) of (10.7): velocities of the model per rate of a mode
    modes: Array
    to_modes: Array  # (m, m), from coordinates to modes
    mass: Array  # (m,), inertia of each mode without the damping term B / w
    input_momenta: Array  # (nu, m), momentum that each input adds per rate of a mode


def _of_inertia(
    lin: LinearModel,
    M: Array,
    to_velocities: Array,
    pace: Pace,
    momenta: Mapping[str, float],
) -> Weights:
    """Return the weights (10.7) for the inertia M (m, m), which includes the damping term B / w.

    `to_velocities` (m, m) maps the rates of the coordinates to the velocities of the model.
    """
    h = lin.dt or 1.0
    m = len(M)
    size = displacements(lin, pace.fraction)
    # The displacements are rotations about the centre of mass, displacements of the centre of mass,
    # and joint displacements. `shift` maps them to the coordinates of the model.
    X = _about_center_of_mass(lin)
    shift = np.linalg.solve(to_velocities, X @ to_velocities)
    D = _upper_bound(lin, M, X, np.abs(to_velocities) @ size)
    S = lin.M @ lin.B[m:] / h  # (m, nu), generalised forces of the inputs
    on_inputs = _input_costs(lin, S, D)
    modal = _modal_cost(lin, M, to_velocities, S, D, on_inputs)
    largest_inputs = _largest_use(modal.gain @ shift, size, lin.state_names)
    limits = _bandwidth_limits(lin, modal, shift, size, momenta, largest_inputs)
    limit = min([Limit(pace.bandwidth, ""), *limits])
    sampling = Limit(math.inf, "")
    if pace.hold:
        fastest = float(modal.frequencies[-1])
        sampling = Limit(pace.held / (pace.hold * fastest), "the sample time")
    sampling = min(sampling, Limit(pace.most, "the disk margin"))
    damped = bool((lin.M != M).any())
    # In A of a free mass at rest, only the rates of the coordinates depend on the velocities.
    # Springs, dampers, gravity or a motion at the operating point add terms to A. Then velocities
    # have weights too, and `_slowed` checks the efforts of the closed loop.
    rate = rate_matrix(lin)
    if rate[m:].any() or rate[:m, :m].any():
        growth, mode = _growth(lin)
        limit = min(max(limit, Limit(_OF_GROWTH * growth, mode)), sampling)
        least = min(Limit(_LEAST_OF_GROWTH * growth, mode), limit)
        costs = _costs(
            lin, modal, _on_velocities(lin, S, modal.on_inputs, D / modal.scale, damped)
        )
        idle = _idle(X.T @ S, on_inputs, X.T @ D @ X)
        limit, achieved = _slowed(lin, costs, shift, size, size * ~idle, limit, least)
    else:
        limit = min(limit, sampling)
        costs = _costs(lin, modal, None)
        achieved = ""
    rule = _rule(lin, size, limit, achieved, pace.fraction * ROTATION)
    if damped:
        rule += "; joint damping is included"
    position_terms = modal.on_positions.diagonal() * size**2
    input_terms = modal.on_inputs * largest_inputs**2
    terms = h * np.append(np.tile(position_terms, 2), input_terms)
    return *costs(limit.bandwidth), rule, limit.bandwidth, terms


def _modal_cost(
    lin: LinearModel,
    M: Array,
    to_velocities: Array,
    S: Array,
    D: Array,
    on_inputs: Array,
) -> ModalCost:
    """Return the cost (10.7) for a bandwidth of 1 rad/s.

    M, D and S are the matrices of (10.7). `on_inputs` (nu,) is the diagonal of R before scaling.
    """
    reach = _definite((S / on_inputs) @ S.T, D)
    eigenvalues, modes = _modes(M, _definite(_reference_effect(lin, S, D), D), reach)
    # Scale the cost so that the frequency of the slowest mode is the bandwidth.
    scale = eigenvalues[0]
    on_inputs = on_inputs * scale
    reach = reach / scale
    eigenvalues = eigenvalues / scale
    from_velocities = np.linalg.inv(modes)
    to_modes = from_velocities @ to_velocities
    on_positions = to_modes.T @ (np.sqrt(eigenvalues)[:, None] * to_modes)
    # The inputs R^-1 S' (S R^-1 S')^-1 f exert the generalised forces f.
    stiffness = M @ modes @ (eigenvalues[:, None] ** 0.75 * to_modes)
    gain = (S / on_inputs).T @ np.linalg.solve(reach, stiffness)
    input_momenta = (S / on_inputs).T @ np.linalg.solve(reach, lin.M @ modes)
    mass = np.ones(len(M))
    if (lin.M != M).any():
        mass = np.diag(from_velocities @ np.linalg.solve(M, lin.M @ modes))
    return ModalCost(
        on_inputs=on_inputs,
        on_positions=0.5 * (on_positions + on_positions.T),
        scale=scale,
        gain=gain,
        frequencies=eigenvalues**0.375,
        modes=modes,
        to_modes=to_modes,
        mass=mass,
        input_momenta=input_momenta,
    )


def _costs(
    lin: LinearModel,
    modal: ModalCost,
    on_velocities: Callable[[float], Array] | None,
) -> Callable[[float], tuple[Array, Array]]:
    """Return a function that maps a bandwidth to the weights Q (nx, nx) and R (nu, nu).

    `on_velocities` maps a bandwidth to the weight (m, m) on velocities, which is zero by default.
    """
    h = lin.dt or 1.0
    m = len(lin.M)

    def costs(w: float) -> tuple[Array, Array]:
        Q = np.zeros_like(lin.A)
        Q[:m, :m] = h * modal.on_positions
        if on_velocities:
            Q[m:, m:] = h * on_velocities(w)
        return Q, np.diag(h * modal.on_inputs / w**4)

    return costs


def _bandwidth_limits(
    lin: LinearModel,
    modal: ModalCost,
    shift: Array,
    size: Array,
    momenta: Mapping[str, float],
    largest_inputs: Array,
) -> list[Limit]:
    """Return the bandwidths at which speeds, wheel momenta and efforts reach their limits.

    `shift` (m, m) maps the displacements with the magnitudes `size` (m,) to the coordinates of the
    model. The displacements require inputs of at most `largest_inputs` (nu,) if the bandwidth is
    1 rad/s.
    """
    speed_limits, motors = _speed_limits(lin, momenta)
    speeds_and_momenta = np.vstack((modal.modes, modal.input_momenta[motors]))
    largest_speeds = _fastest(
        speeds_and_momenta,
        modal.frequencies,
        modal.to_modes @ shift,
        size,
        lin,
        modal.mass,
    )
    # Speeds are proportional to the bandwidth, and efforts to its square.
    return [
        *_limits_on("speed", speed_limits, largest_speeds, 1.0),
        *_limits_on("effort", _efforts_left(lin), largest_inputs, 2.0),
    ]


def _speed_limits(
    lin: LinearModel, momenta: Mapping[str, float]
) -> tuple[dict[str, float], Indices]:
    """Return the limits on the rates of the coordinates and on the momenta of wheels.

    The second result contains the indices of the motors of these wheels among the inputs.
    """
    limits = {
        name: lin.limits.get(name, math.inf) for name in lin.state_names[len(lin.M) :]
    }
    motors = [
        motor_of(lin.input_names, name.removeprefix("qdot_m.")) for name in momenta
    ]
    return limits | dict(momenta), np.array(motors, dtype=np.intp)


def _about_center_of_mass(lin: LinearModel) -> Array:
    """Return X (m, m), which maps velocities about the centre of mass to the model's velocities.

    The velocity of the base about the centre of mass is the velocity of the point of the base that
    coincides with the centre of mass of the robot. X is the identity if the states do not contain
    the attitude and the position of the base.
    """
    X = np.eye(len(lin.M))
    if _has_free_base(lin):
        X[3:6, :3] = -lin.M[3:6, :3] / lin.M[3, 3]
    return X


def _has_free_base(lin: LinearModel) -> bool:
    return list(lin.state_names[:6]) == list(state_keys(())[:6])


def _upper_bound(lin: LinearModel, M: Array, X: Array, theta: Array) -> Array:
    """Return D (m, m) of (10.7), for design displacements `theta` (m,) of the quasi-coordinates.

    In coordinates about the centre of mass, D has one diagonal block for the attitude of the base,
    one for its position, and one entry for each joint.
    """
    about_center = X.T @ M @ X
    D = np.zeros_like(M)
    for block in (blocks := _blocks(lin)):
        at = np.ix_(block, block)
        D[at] = about_center[at]
        for other in blocks:
            if other is not block:
                coupling = np.linalg.norm(about_center[np.ix_(block, other)], 2)
                ratio = theta[other].max() / theta[block].max()
                D[block, block] += coupling * ratio
    back = np.linalg.inv(X)
    bound: Array = back.T @ D @ back
    return bound


def _blocks(lin: LinearModel) -> list[Indices]:
    """Return the indices of the base attitude, of the base position, and of each joint."""
    blocks: dict[str, list[int]] = {}
    for index, name in enumerate(lin.state_names[: len(lin.M)]):
        group = name.partition(".")[0]
        block = group if group in ("q_b", "r_b") else name
        blocks.setdefault(block, []).append(index)
    return [np.array(indices, dtype=np.intp) for indices in blocks.values()]


def _input_costs(lin: LinearModel, S: Array, D: Array) -> Array:
    """Return the diagonal of R (nu,), up to a factor.

    The weight of an input is s' D^-1 s (10.7), with the generalised forces s of the input.
    """
    cost: Array = (S * np.linalg.solve(D, S)).sum(axis=0)
    if lin.dependent:
        # Constraints may carry an input entirely. Its gain is zero at every weight.
        cost[cost <= _CARRIED * cost.max()] = cost.max()
    if not cost.all():
        raise InputError(
            f"input {lin.input_names[int(cost.argmin())]} has no effect on any coordinate; remove "
            "it, or give Q and R"
        )
    return cost


def _reference_effect(lin: LinearModel, S: Array, D: Array) -> Array:
    """Return the effect (m, m) of inputs of which the base force acts at the centre of mass.

    The torque and the force on the base have one weight matrix each instead of weights for single
    axes, so the effect does not depend on the position and the axes of the root frame (10.7).
    """
    names = list(lin.input_names)
    torque, force = (
        [names.index(axis) for axis in axes if axis in names]
        for axes in (("tau_b.x", "tau_b.y", "tau_b.z"), ("F_b.x", "F_b.y", "F_b.z"))
    )
    S = S.copy()
    if len(torque) == len(force) == 3 and _has_free_base(lin):
        S[:, force] += S[:, torque] @ lin.M[:3, 3:6] / lin.M[3, 3]
    blocks = [axes for axes in (torque, force) if len(axes) == 3]
    together = [index for axes in blocks for index in axes]
    blocks += [[index] for index in range(len(names)) if index not in together]
    effect = np.zeros_like(D)
    for block in blocks:
        forces = S[:, block]
        weight = forces.T @ np.linalg.solve(D, forces)
        if lin.dependent:
            # Constraints may carry some combinations of the inputs.
            inverse = np.linalg.pinv(weight, _CARRIED_TOGETHER, hermitian=True)
            effect += forces @ inverse @ forces.T
        else:
            effect += forces @ np.linalg.solve(weight, forces.T)
    return effect


def _modes(M: Array, reference: Array, reach: Array) -> tuple[Array, Array]:
    """Return the eigenvalues (m,) of the `reference` effect, and the modes (m, m) of the loop.

    `reach` is the effect of the inputs. The modes are the columns of T V Lambda^(-1/2) of (10.7).
    If the two effects are equal, the modes are T, the eigenvectors of the reference effect.
    """
    ratios, T = eigh(reference, M)
    V = np.linalg.cholesky((T.T @ reach @ T)[::-1, ::-1])[::-1, ::-1]
    modes: Array = T @ V / np.sqrt(ratios)
    return ratios, modes


def _idle(S: Array, cost: Array, D: Array) -> Mask:
    """Return a mask (m,) of the coordinates on which no input has an effect.

    S and D are in coordinates about the centre of mass.
    """
    idle: Mask = (S**2 / cost).sum(axis=1) <= _IDLE * D.diagonal()
    return idle


def _definite(reach: Array, D: Array) -> Array:
    """Return the effect S R^-1 S' (m, m) of the inputs, made positive definite.

    The gain needs its inverse. In directions without an effect, it becomes D (m, m). All other
    directions keep their effect, so that a weak one is not mistaken for a strong one.
    """
    factor = np.linalg.cholesky(D)
    unit = np.linalg.inv(factor)
    effects, directions = np.linalg.eigh(unit @ reach @ unit.T)
    if effects[0] >= _NO_EFFECT:
        return reach
    effects[effects < _NO_EFFECT] = 1.0
    root = factor @ directions * np.sqrt(effects)
    definite: Array = root @ root.T
    return definite


def _on_velocities(
    lin: LinearModel, S: Array, cost: Array, least: Array, damped: bool
) -> Callable[[float], Array]:
    """Return a function that maps a bandwidth w to the weight (m, m) on velocities (10.8).

    S (m, nu) contains the generalised forces of the inputs, and `cost` (nu,) the diagonal of R. The
    effect of the inputs is measured in units of `least` (m, m), the scaled matrix D of (10.7).
    """
    m = len(lin.M)
    # Root of the effect S R^-1 S' of the inputs. Weak directions are raised to a small effect.
    factor = np.linalg.cholesky(least)
    forces = np.linalg.solve(factor, S)
    effects, directions = np.linalg.eigh((forces / cost) @ forces.T)
    root = factor @ directions * np.sqrt(effects.clip(_LEAST_REACH))
    # Velocities are L p' with the coordinates p of (10.5), and p'' = F p + H p' + u'.
    L = np.linalg.solve(lin.M, root)
    rate = rate_matrix(lin)
    F = np.linalg.solve(L, rate[m:, :m] @ rate[:m, m:] @ L)
    H = np.linalg.solve(L, rate[m:, m:] @ L)
    damping_term = np.zeros_like(H)
    if damped:
        damping_term = H.T @ H
    _, stiffness, modes = np.linalg.svd(F)
    to_p = np.linalg.inv(L)

    def velocity_weight(w: float) -> Array:
        # Equal to 2 (w^2 + |F| - (F^2 + w^4)^(1/2)), in a form without cancellation.
        root = np.hypot(stiffness, w**2)
        of_modes = 2.0 * w**2 * (1.0 - w**2 / (stiffness + root))
        V = (modes.T * of_modes) @ modes - damping_term
        values, directions = np.linalg.eigh(V)
        # The weight is the positive semidefinite part of V.
        rows = directions.T @ to_p
        weight: Array = (rows.T * values.clip(0.0)) @ rows / w**4
        return 0.5 * (weight + weight.T)

    return velocity_weight


def _rate_of_fall(lin: LinearModel) -> float:
    """Return sqrt(g / r) [rad/s], with the gravity g that the inputs balance; 0 without gravity."""
    if not _has_free_base(lin):
        return 0.0
    m = len(lin.M)
    # A rotation by the angle 2 q_b turns the force that balances gravity.
    by_turn = rate_matrix(lin)[m + 3 : m + 6, :3]
    return math.sqrt(0.5 * float(np.linalg.norm(by_turn, 2)) / _radius_of_gyration(lin))


def _radius_of_gyration(lin: LinearModel) -> float:
    """Return the radius of gyration [m] of the robot.

    It is the radius of a thin spherical shell with the robot's mass and trace of inertia.
    """
    M = lin.M
    mass = float(M[3, 3])
    moment = np.trace(M[:3, :3] - M[:3, 3:6] @ M[3:6, :3] / mass)
    return math.sqrt(max(float(moment) / (2.0 * mass), 1e-300))


def displacements(lin: LinearModel, fraction: float) -> Array:
    """Return the design displacements (m,) of the coordinates, multiplied by `fraction`."""
    m = len(lin.M)
    names, units = lin.state_names[:m], lin.state_units[:m]
    radius = 1.0
    size = np.empty(m)
    if _has_free_base(lin):
        radius = _radius_of_gyration(lin)
    for i, (name, unit) in enumerate(zip(names, units, strict=True)):
        if name.startswith("q_b."):
            size[i] = math.sin(math.radians(fraction * ROTATION / 2.0))
        elif name.startswith("r_b."):
            size[i] = fraction * OFFSET * radius
        else:
            most = LENGTH if unit == "m" else ANGLE
            size[i] = fraction * min(most, TRAVEL * lin.limits.get(name, math.inf))
    return size


def _fastest(
    to_speeds: Array,
    frequencies: Array,
    to_modes: Array,
    size: Array,
    lin: LinearModel,
    mass: Array,
) -> Array:
    """Return the largest speeds and wheel momenta (k,) during the return from displacements.

    The displacements have the magnitudes `size` (m,), and the bandwidth is 1 rad/s. `to_speeds`
    (k, m) maps the rates of the modes to the speeds and the wheel momenta.
    """
    # In closed loop, each mode x obeys ``mass x'' + damping x' + stiffness x = 0``. The modes are
    # normalised with M + B / w, so `mass` (m,) is 1 without dampers, and at most 1 with dampers.
    # The dampers alone have the coefficient 1 - mass.
    stiffness = frequencies**2
    damping = np.sqrt((1.0 - mass) ** 2 + 2.0 * mass * stiffness)
    # The imaginary part avoids a division by zero if a mode is critically damped.
    root = np.sqrt(damping**2 - 4.0 * mass * stiffness + 1e-12j)
    # A light mode with dampers decays at up to its frequency^2, a mode without dampers at about
    # its frequency.
    fastest = frequencies[-1]
    if (mass != 1.0).any():
        fastest = frequencies[-1] ** 2
    time = np.geomspace(0.1 / fastest, 3.0, 60)[:, None]
    slow = np.exp((root - damping) * time / (2.0 * mass))
    fast = np.exp((-root - damping) * time / (2.0 * mass))
    # Speed -x' of each mode at each time, after a start from rest with x = 1.
    mode_speeds = (stiffness * (slow - fast) / root).real
    rows = to_speeds @ (mode_speeds[..., None] * to_modes)
    use = _largest_use(rows, size, lin.state_names)
    largest: Array = use.max(axis=0)
    return largest


def _rule(
    lin: LinearModel, size: Array, limit: Limit, achieved: str, turn: float
) -> str:
    groups = [name.partition(".")[0] for name in lin.state_names[: len(size)]]
    base = list[str]()
    if "q_b" in groups:
        base.append(f"{turn:g} deg")
    if "r_b" in groups:
        base.append(f"{size[groups.index('r_b')]:.2g} m")
    sizes = [
        x for x in zip(lin.state_units, size, groups, strict=False) if x[2] == "q_m"
    ]
    units = dict.fromkeys(unit for unit, *_ in sizes if unit != "kg^0.5 m")
    largest = {
        unit: max(d for joint_unit, d, _ in sizes if joint_unit == unit)
        for unit in units
    }
    from_where = list[str]()
    if base:
        from_where.append(f"{' and '.join(base)} of the base")
    if largest:
        offsets = " or ".join(f"{d:.2g} {unit}" for unit, d in largest.items())
        from_where.append(f"{offsets} of the joints")
    source = (
        "the limits of the URDF"
        if lin.limits
        else "mass and size (the URDF has no limits)"
    )
    slow = ""
    if limit.what:
        slow = f"; bandwidth limited by {limit.what}"
    if beyond := [name for name, room in _efforts_left(lin).items() if room <= 0.0]:
        slow += (
            "; inputs already at or beyond the URDF limit at the operating point: "
            f"{listed(beyond)}"
        )
    pace = achieved or f"bandwidth at least {limit.bandwidth:.3g} rad/s"
    return (
        f"from {source}, for displacements of {' and '.join(from_where)}: {pace}{slow}"
    )


def _largest_use(K: Array, size: Array, names: tuple[str, ...]) -> Array:
    """Return the largest magnitude of each entry of ``K d``, over all displacements d.

    The displacements d have the magnitudes `size` (m,). The rotation and the offset of the base may
    have any direction, and the displacement of each joint may have either sign. Only the first m
    columns of K are used.
    """
    groups = np.array([name.partition(".")[0] for name in names[: len(size)]])
    scaled = K[..., : len(size)] * size
    total: Array = np.abs(scaled[..., ~np.isin(groups, ("q_b", "r_b"))]).sum(axis=-1)
    for group in ("q_b", "r_b"):
        total += np.linalg.norm(scaled[..., groups == group], axis=-1)
    return total


def _limits_on(
    kind: str, room: Mapping[str, float], used: Array, power: float
) -> list[Limit]:
    """Return, for each limited signal, the factor on the bandwidth at which it reaches its limit.

    `room` maps the name of each signal to its limit. With a factor of 1, the largest values of the
    signals are `used`. The values are proportional to the factor raised to the power `power`.
    """
    return [
        Limit(
            (most / size) ** (1.0 / power),
            f"the {kind} of {name.partition('_m.')[2] or name}",
        )
        for (name, most), size in zip(room.items(), used.tolist(), strict=True)
        if 0.0 < most < math.inf and size > 0.0
    ]


def _efforts_left(lin: LinearModel) -> dict[str, float]:
    """Return, for each input, its limit minus its magnitude at the operating point."""
    inputs = zip(lin.input_names, lin.u0.tolist(), strict=True)
    return {name: lin.limits.get(name, math.inf) - abs(at) for name, at in inputs}


def _growth(lin: LinearModel) -> Limit:
    """Return the largest growth rate [1/s] of a mode, and a description of this mode."""
    poles, modes = np.linalg.eig(lin.A)
    rates = rates_of(poles, lin.dt).real
    fastest, k = float(rates.max()), int(rates.argmax())
    moving = listed(_moving_most(lin, modes[:, [k]]))
    return Limit(
        fastest, f"the unstable mode that grows by {fastest:.3g} 1/s ({moving})"
    )


def _slowed(
    lin: LinearModel,
    costs: Callable[[float], tuple[Array, Array]],
    shift: Array,
    size: Array,
    driven: Array,
    limit: Limit,
    least: Limit,
) -> tuple[Limit, str]:
    """Reduce the bandwidth of a loop with springs or gravity until the effort limits are satisfied.

    The bandwidth starts at `limit` and is not reduced below `least`. The efforts at the start of
    the return are computed for displacements `size` (m,). The efforts during the return are
    computed for displacements `driven` (m,). Entries of `driven` are zero for coordinates on which
    no input acts, because only springs or gravity can return such coordinates. `shift` (m, m) maps
    the displacements to the coordinates of the model. The results are the bandwidth and a
    description of the loop.
    """
    # A trial contains the factor `left` (see `_TRIALS`), the name of the first effort that reaches
    # its limit, the bandwidth, a description of the loop, and the largest magnitudes (nu,) of the
    # inputs.
    trials = list[tuple[float, str, Limit, str, Array]]()
    for _ in range(_TRIALS):
        Q, R = costs(w := limit.bandwidth)
        try:
            K = solve(lin.A, lin.B, Q, R, None, lin.dt).K
        except np.linalg.LinAlgError:
            break
        poles, modes = np.linalg.eig(lin.A - lin.B @ K)
        rates = rates_of(poles, lin.dt)
        time = np.geomspace(0.1 / np.abs(rates).max(), 3.0 / np.abs(rates).min(), 60)
        decaying = (K @ modes) * np.exp(rates * time[:, None])[:, None]
        later = (decaying @ np.linalg.inv(modes)[:, : len(size)]).real
        use = np.maximum(
            _largest_use(K[:, : len(size)] @ shift, size, lin.state_names),
            _largest_use(later @ shift, driven, lin.state_names).max(axis=0),
        )
        efforts = _limits_on("effort", _efforts_left(lin), use, 2.0)
        left, effort = min(efforts, default=Limit(1.0, ""))
        decay = -rates.real
        fast = np.abs(rates)
        description = (
            f"bandwidth at least {fast.min():.3g} rad/s, decay rate at least {decay.min():.3g} "
            f"1/s, damping ratio at least {(decay / fast).min():.2g}"
        )
        slow = decay < _AS_SLOW * math.sqrt(0.5) * w
        if names := _moving_most(lin, modes[:, slow]):
            description += f"; modes decaying more slowly: {listed(names)}"
        if left >= 1.0 - 1e-6:
            return limit, description
        trials.append((left, effort, limit, description, np.abs(lin.u0) + use))
        if w <= least.bandwidth:
            break
        # Springs and gravity require efforts even if the loop is very slow, so the factor `left` is
        # only an estimate. The bandwidth is therefore reduced in steps.
        limit = max(Limit(min(max(left, 0.3), 0.8) * w, effort), least)
    if not trials:
        # the later design of the regulator also fails, and reports the reason
        return limit, ""
    enough = _IN_VAIN * max(left for left, *_ in trials)
    _, effort, (w, reason), description, required = next(
        x for x in trials if x[0] >= enough
    )
    high = np.array([lin.limits.get(name, math.inf) for name in lin.input_names])
    where = "to return from the displacements of the default weights"
    units = dict(zip(lin.input_names, lin.input_units, strict=True))
    warn_beyond(lin.robot, where, units, required[None], -high, high)
    cause = f"{effort}, which {_NOT_ENOUGH}"
    if reason == least.what:
        # An unstable mode or the sample time determines the bandwidth, and not an effort.
        cause = f"{reason}; {effort} {_NOT_ENOUGH}"
    return Limit(w, cause), description


def _moving_most(lin: LinearModel, modes: Complex) -> list[str]:
    """Return the names of the coordinates that move most in at least one column of `modes`.

    A coordinate is included if its motion, times the square root of its inertia, exceeds half of
    the largest such product in the same mode.
    """
    m = len(lin.M)
    large = np.abs(modes[:m]) * np.sqrt(lin.M.diagonal())[:, None]
    among = (large > 0.5 * large.max(axis=0, initial=0.0)).any(axis=1)
    return [
        name for name, moves in zip(lin.state_names[:m], among, strict=False) if moves
    ]


# Along a trajectory, the design displacements are multiplied by _BESIDE. They should decay within
# the duration. Therefore the bandwidth is _CONSTANTS / duration, but at least BANDWIDTH and at most
# _FASTEST [rad/s]. If the inputs are held, _HELD_ALONG replaces the stricter _HELD, because the
# design of the sampled regulator includes the hold exactly.
_BESIDE, _CONSTANTS, _FASTEST, _HELD_ALONG = 0.1, 15.0, 1.5, 1.0


def pace_along(duration: float, hold: float) -> Pace:
    """Return the pace along a trajectory of `duration` [s], with inputs held for `hold` [s]."""
    return Pace(
        min(max(_CONSTANTS / duration, BANDWIDTH), _FASTEST), _BESIDE, hold, _HELD_ALONG
    )
