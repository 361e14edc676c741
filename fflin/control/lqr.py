"""Linear quadratic regulators from a Riccati equation, and `acceleration_lqr` in closed form."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from fflin.analysis.controllability import require_stabilizable, require_weighed
from fflin.analysis.reduction import regulated_part
from fflin.base.errors import (
    EquilibriumError,
    FflinWarning,
    InputError,
    StabilizabilityError,
    listed,
)
from fflin.base.validation import Array, ArrayLike, dimension, instance
from fflin.control import integral
from fflin.control.default_weights import pace_of
from fflin.control.gain import Gain, Integrals, cautions, make_gain
from fflin.control.integral import Integrated
from fflin.control.margins import disk_margin_of
from fflin.control.optimal.riccati import (
    Riccati,
    Solution,
    best_solution,
    is_reliable,
    rates_of,
    solved,
    structured,
)
from fflin.control.slower_weights import is_late, slowed
from fflin.control.weights import (
    WITH_WHEEL_SPEEDS,
    Rule,
    Weight,
    are_default,
    cost_weights,
    integrated,
    rule_weights,
    weight,
)
from fflin.dynamics.state import selection
from fflin.linear.holding import held, is_held
from fflin.linear.model import LinearModel, refuse_fixed, refuse_frozen

# A relative residual above _COARSE gives a warning, and a residual above _USELESS raises an error.
_COARSE, _USELESS = 1e-8, 1e-3


def lqr(
    lin: LinearModel,
    Q: Weight | None = None,
    R: Weight | None = None,
    N: ArrayLike | None = None,
    *,
    weights: Rule | None = None,
    wheel_speeds: bool | None = None,
    integral_action: Integrated | None = None,
) -> Gain:
    r"""Return the linear quadratic regulator of a model about a fixed point.

    For a continuous model, the feedback u = u0 - K (x - x0) minimises

    .. math:: \int_0^\infty \delta x^T Q\,\delta x + 2\,\delta x^T N\,\delta u
              + \delta u^T R\,\delta u\;dt.

    For a sampled model, the feedback minimises the corresponding sum over the samples.
    `sampled_cost` converts the weights of the integral to weights of the sum.

    For a fully actuated model, the Riccati equation is solved by an eigenproblem of half the usual
    size. For any other model, SciPy solves the Riccati equation. Newton's method refines either
    solution, and the result contains the residual in the model's own variables. If a weight is
    computed from an ill-conditioned inertia, such as M^-1 R_a M^-1 for weighted accelerations, the
    weight itself is inaccurate, and no solver can recover the accuracy. In this case, use
    `acceleration_lqr`.

    If no weights are given, fflin chooses weights that respect the limits of the URDF, see (10.7)
    of docs/derivation.md. The slowest closed-loop motion then has a bandwidth of 0.2 rad/s, or more
    if the inputs hold the robot against gravity. The bandwidth is lower if the robot would
    otherwise exceed an effort or speed limit while it returns from a rotation of 30 deg about its
    centre of mass and 0.3 rad of each joint. Without springs, gravity and such limits, the
    bandwidths do not depend on the root frame of the URDF. If the model is continuous, each input
    has a phase margin of at least 60 deg and tolerates any gain factor above one half. A sampled
    regulator has smaller margins; see ``gain.margins``. If inputs have delays or lags, default
    weights are made slower until the disk margin of the loop is 2/3, which is a gain margin of
    6 dB, but at most four times; ``gain.weights`` then states the factor and the margin. With
    springs or gravity, the controllable modes decay as fast as without them (10.8).
    ``gain.weights`` states the bandwidth, decay rate and damping of the loop, and lists any modes
    that still decay more slowly.

    If no input pushes the base, its position and velocity are not regulated. Such inputs are, for
    example, a base torque or reaction wheels, with or without joint torques. Of a model with
    reaction wheels, only the controllable states are regulated, see (9.4) of docs/derivation.md.
    The wheels are the joints in ``lin.wheels``: each `ReactionWheel`, and each rotor that spins at
    the operating point or is named in `Robot.wheel_joints`. ``gain.regulated`` lists the regulated
    states. Weights on the following states have no effect:

    - the position and velocity of the base, along axes in which no input pushes the base;
    - wheel angles, which are ignorable;
    - wheel speeds, if only wheels rotate the body, because the body's rate then determines them.
      In an orbit, the body rotates with the orbital frame, so a wheel's momentum exerts a torque on
      it: the orbital rate times this momentum. If nothing else couples the wheel speeds to the
      body, they are also left out by default, and this small torque is a disturbance of the
      attitude. The momentum then keeps its magnitude and turns once per revolution relative to the
      body. ``wheel_speeds=True`` keeps these speeds in the regulated model.

    Parameters
    ----------
    lin : LinearModel
        Model about a point, or a model with ``moving=True`` about a steady motion. If the point is
        not a fixed point, but inputs can hold the robot there at rest, the gain is designed with
        the inputs of `equilibrium`, which are then its ``u0``. Wheels that hold the robot gain
        momentum; the report of the gain states how much.
    Q : array_like (nx, nx) or (nx,), float, or mapping, optional
        Weight on the state, positive semidefinite: a matrix, its diagonal, or {name: weight} with
        names of states or of their groups, such as ``q_b``. Unnamed states have zero weight.
    R : array_like (nu, nu) or (nu,), float, or mapping, optional
        Weight on the inputs, positive definite, in the same forms as Q.
    N : array_like (nx, nu), optional
        Cross weight. Q - N R^-1 N' must be positive semidefinite.
    weights : {"urdf", "identity"} or mapping, optional
        Rule for the weights if Q and R are omitted. The rule "urdf" (default) respects the limits
        of the URDF. The rule "identity" gives each state and input a weight of 1. A mapping has the
        keys of `weights` in `Robot.replace`: ``q``, ``r`` and ``bryson`` replace single weights of
        the ``rule``. For a sampled model, the rule defines the continuous-time cost, which
        `sampled_cost` converts.
    integral_action : sequence of str, mapping or array_like (k, nx), optional
        Signals that are also integrated, so that a constant disturbance leaves no error in them:
        names or groups of states or outputs, such as ``["q_b"]``, {name: weight}, or a matrix H
        whose product with x - x0 is integrated. By default, the integrals are about three times
        slower than the loop; ``gain.weights`` states their rates. The weights of a mapping are for
        the integral over time of each signal. If no Q and R are given, the entry ``integral`` of
        `weights`, or of the robot's `weights`, is the default; an empty list switches integral
        action off. `Gain` describes the result, and
        ``StateFeedback(lin, gain)`` flies it.
    wheel_speeds : bool, optional
        Whether to regulate the wheel speeds to their values at the operating point. By default,
        wheel speeds are regulated if inputs other than the wheels can change them. If True,
        combinations of wheel speeds that exert no net torque on the base are also regulated. If
        False, no wheel speed is regulated. The default weights aim at a tenth of the bandwidth of
        the other states. If only the orbital rate couples the wheel speeds to the body, the loop is
        far slower; ``gain.weights`` states its slowest decay rate.

    Returns
    -------
    Gain

    Raises
    ------
    EquilibriumError
        If the operating point is not a fixed point, and no inputs hold the robot there; the message
        lists the nonzero entries of f0 and the forces that no input balances.
    StabilizabilityError
        If a mode neither decays by itself nor can be stabilised by the inputs; the message names
        the mode. Also if constant inputs cannot change a combination of the integrated signals;
        the message names the combination.
    InputError
        If a weight has a wrong size, is not positive (semi)definite, or is zero for a mode that
        does not decay by itself.
    UnknownNameError
        If a name does not exist.
    ModelError
        If the robot's Pinocchio model (``robot.model``) was modified after the robot was created.

    Warns
    -----
    FflinWarning
        If one of these conditions is true:

        - the weights are so badly scaled that the relative residual exceeds 1e-8;
        - the phase margin at the inputs is small;
        - the gain commands negative thrust.

    References
    ----------
    B. D. O. Anderson and J. B. Moore, Optimal Control: Linear Quadratic Methods, 1990.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> gain = fflin.lqr(lin)  # within the limits of the URDF
    >>> gain.K.shape, gain.residual < 1e-10
    ((9, 18), True)
    >>> fflin.lqr(lin, {"q_b": 100.0, "r_b": 10.0, "q_m": 10.0}, 1.0).margin > 0
    True
    >>> fflin.lqr(lin, integral_action=["q_b"]).integrals
    ('integral.q_b.x', 'integral.q_b.y', 'integral.q_b.z')
    """
    if integral_action is None and Q is None and R is None and N is None:
        integral_action = integrated(lin, weights)
    if integral.is_off(integral_action):
        integral_action = None
    gain = regulator(
        lin,
        Q,
        R,
        N,
        weights=weights,
        wheel_speeds=wheel_speeds,
        integral_action=integral_action,
    )
    if Q is None and not isinstance(integral_action, Mapping):
        gain = _with_margin(gain, lin, weights, wheel_speeds, integral_action)
    _caution(gain)
    return gain


def _with_margin(
    gain: Gain,
    lin: LinearModel,
    weights: Rule | None,
    wheel_speeds: bool | None,
    integral_action: Integrated | None,
) -> Gain:
    """Return a gain with default weights, made slower if its delays require it.

    A gain of a model without delays and lags is returned unchanged, as is a gain with other
    weights.
    """
    if not are_default(lin, weights):
        return gain
    redesign = partial(
        _slower,
        lin=lin,
        weights=weights,
        wheel_speeds=wheel_speeds,
        integral_action=integral_action,
    )
    if not is_late(gain):
        return replace(gain, _slower=redesign)
    design, change = slowed(gain, redesign, _disk_margin)
    if change is None:
        return replace(gain, _slower=redesign)
    return replace(
        design,
        weights=f"{design.weights}; {change}",
        _slower=partial(redesign, before=change.factor),
    )


def _disk_margin(gain: Gain) -> float | None:
    lin = gain._lin
    assert lin is not None  # since the gain was just designed
    return disk_margin_of(gain, lin)


def _slower(
    factor: float,
    lin: LinearModel,
    weights: Rule | None,
    wheel_speeds: bool | None,
    integral_action: Integrated | None,
    before: float = 1.0,
) -> Gain:
    """Return a regulator with default weights, whose bandwidth is divided by ``before * factor``.

    `before` is the factor of the regulator that is made slower. This regulator has already given
    all warnings.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FflinWarning)
        return regulator(
            lin,
            weights=weights,
            wheel_speeds=wheel_speeds,
            integral_action=integral_action,
            slower=before * factor,
        )


def _caution(gain: Gain) -> None:
    """Warn of a small disk margin at the inputs, and of negative thrust."""
    for text in cautions(gain):
        warnings.warn(text, FflinWarning, stacklevel=3)


def regulator(
    lin: LinearModel,
    Q: Weight | None = None,
    R: Weight | None = None,
    N: ArrayLike | None = None,
    *,
    weights: Rule | None = None,
    wheel_speeds: bool | None = None,
    integral_action: Integrated | None = None,
    slower: float = 1.0,
) -> Gain:
    """Return the same gain as `lqr`, without the warnings about margins and thrusters.

    Other designs contain such a gain as a part, for example as their terminal cost. The bandwidth
    of default weights is divided by `slower`; their margin with delays is not examined.
    """
    lin = at_fixed_point(lin)
    rule = "as given"
    if Q is None and R is None and N is None:
        nominal = pace_of(lin)._replace(slower=slower)
        Q, R, N, rule = rule_weights(lin, weights, nominal, wheel_speeds)
    elif weights is not None or Q is None or R is None:
        raise InputError(
            "give either both Q and R, or only weights='urdf' or 'identity'"
        )
    Q, R, cross = cost_weights(lin, Q, R, N)
    part = regulated_part(lin, wheel_speeds)
    if part is not lin:
        S = selection(part.state_names, lin.state_names)
        Q, cross = S @ Q @ S.T, S @ cross
    solution = _solve(part, Q, R, cross)
    if WITH_WHEEL_SPEEDS in rule:
        slowest = -float(rates_of(solution.poles, part.dt).real.max())
        rule += f"; the slowest mode of the loop decays at {slowest:.3g} 1/s"
    if integral_action is None:
        return make_gain(lin, part, solution, Q, R, cross, rule)
    action = integral.integral_action(lin, integral_action)
    S = selection(part.state_names, lin.state_names)
    H = _regulated_columns(lin, part, action)
    solution, Q_i, pace = integral.with_integrals(
        part, solution, (Q, R, cross), action, H
    )
    _warn_of_residual(solution)
    integrals = Integrals(
        action.state_names,
        action.state_units,
        *integral.extended(lin.A, lin.B, H @ S, lin.dt),
    )
    none = np.zeros((len(H), len(R)))
    gain = make_gain(
        lin,
        part,
        solution,
        block_diag(Q, Q_i),
        R,
        np.vstack((cross, none)),
        rule,
        integrals=integrals,
    )
    rates = np.abs(gain.integral_rates)
    least, most = f"{rates.min():.3g}", f"{rates.max():.3g}"
    decay = least if least == most else f"{least} to {most}"
    text = (
        f"the integrals of {listed(action.names)} decay at {decay} 1/s, the loop without them at "
        f"{pace:.3g} 1/s"
    )
    return replace(gain, weights=f"{rule}; {text}")


def _regulated_columns(
    lin: LinearModel, part: LinearModel, action: integral.IntegralAction
) -> Array:
    """Return H (k, nr) of the regulated states; raise an error if it contains other states."""
    S = selection(part.state_names, lin.state_names)
    H: Array = action.H @ S.T
    other = np.abs(action.H - H @ S) > 1e-12 * np.abs(action.H).max()
    if other.any():
        row, column = np.argwhere(other)[0]
        raise StabilizabilityError(
            f"integral action on {action.names[row]} is not possible, because it contains "
            f"{lin.state_names[column]}, which is not regulated; leave it out, or give inputs that "
            "control it"
        )
    return H


def acceleration_lqr(lin: LinearModel, Qp: Weight, Qv: Weight, Ra: Weight) -> Gain:
    r"""Return the linear quadratic regulator with weighted accelerations, in closed form.

    Let the accelerations :math:`a = L u` be the inputs, where L is the lower half of B. A model at
    rest then consists of one double integrator per coordinate, :math:`\ddot q_i = s_i a_i`, with
    s = 1/2 for attitude coordinates and s = 1 for all others. If the weights are diagonal, the
    coordinates are decoupled, and by (10.2) of docs/derivation.md the regulator is

    .. math:: k_p = \sqrt{q_p/r_a},\quad k_d = \sqrt{q_v/r_a + 2 s k_p},\quad
              u = u_0 - L^{-1} [\operatorname{diag} k_p, \operatorname{diag} k_d]\,(x - x_0),

    and its poles are the roots of :math:`\lambda^2 + k_d \lambda + s k_p`. The equivalent weight on
    u is :math:`L^T R_a L`. Since the gain is computed without this product, an ill-conditioned
    inertia does not reduce the accuracy of the gain. Wheel speeds are not regulated.

    Parameters
    ----------
    lin : LinearModel
        Continuous model at rest, without gravity, orbit, springs or dampers. Every coordinate that
        `lqr` regulates must be actuated. For a sampled regulator, pass the weights Q and R of the
        returned gain to `sampled_cost`.
    Qp, Qv, Ra : array_like (6 + n,) or float, or mapping
        Diagonal weights on the positions (q_b, r_b, q_m), the velocities and the accelerations.
        In a mapping {name: weight}, the names are positions for `Qp`, and velocities for `Qv` and
        `Ra`.

    Returns
    -------
    Gain
        The residual of the gain refers to the Riccati equation with the accelerations as inputs.

    Raises
    ------
    EquilibriumError
        If the operating point is not a fixed point.
    StabilizabilityError
        If a coordinate is not actuated.
    InputError
        If the model is sampled, its dynamics are not double integrators, or a weight is negative or
        not diagonal. Qp and Ra must be positive.
    ModelError
        If the robot's Pinocchio model (``robot.model``) was modified after the robot was created.

    Warns
    -----
    FflinWarning
        If the phase margin at the inputs is small, or the gain commands negative thrust.

    References
    ----------
    Y. Yang, Analytic LQR design for spacecraft control system based on quaternion model, J.
    Aerospace Engineering 25(3), 2012. The attitude regulator of this paper has the weight
    ``Ra = J R J``.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> gain = fflin.acceleration_lqr(lin, 1.0, 1.0, 1.0)
    >>> gain.method, round(float(gain.poles.real.max()), 3)
    ('closed form', -0.707)
    """
    lin = at_fixed_point(lin)
    if lin.dt:
        raise InputError(
            "lin is sampled, expected a continuous model; for a sampled regulator give the Q and R "
            "of the continuous gain to sampled_cost and lqr"
        )
    whole = lin
    lin = regulated_part(lin, wheel_speeds=False)
    m, half = len(lin.A) // 2, len(whole.A) // 2
    s = lin.A[:m, m:].diagonal()
    L = lin.B[m:]
    if not np.array_equal(lin.A, np.diag(s, m)) or lin.B[:m].any():
        raise InputError(
            "the model is not a set of double integrators, expected a model at rest without "
            "gravity, orbit, springs or dampers; use lqr for this model"
        )
    sizes = np.abs(L).max(axis=1, keepdims=True)
    if not sizes.all() or np.linalg.matrix_rank(L / sizes, tol=1e-10) < m:
        require_stabilizable(lin)
        raise StabilizabilityError(
            "the inputs do not accelerate every coordinate independently; use lqr"
        )
    positions, velocities = whole.state_names[:half], whole.state_names[half:]
    qp = _diagonal("Qp", Qp, positions, lin.state_names[:m], definite=True)
    qv = _diagonal("Qv", Qv, velocities, lin.state_names[m:], definite=False)
    ra = _diagonal("Ra", Ra, velocities, lin.state_names[m:], definite=True)
    Q = np.diag(np.concatenate((qp, qv)))
    with np.errstate(all="ignore"):
        kp = np.sqrt(qp / ra)
        kd = np.sqrt(qv / ra + 2.0 * s * kp)
        fast = -0.5 * (kd + np.sqrt((kd * kd - 4.0 * s * kp).astype(complex)))
        poles = np.concatenate((fast, s * kp / fast))
        P11, P12, P22 = (np.diag(x) for x in (kp * ra * kd / s, ra * kp, ra * kd))
        P = np.block([[P11, P12], [P12, P22]])
        inverse = np.linalg.inv(L) if L.shape == (m, m) else np.linalg.pinv(L)
        K = inverse @ np.hstack((np.diag(kp), np.diag(kd)))
        equation = Riccati(lin.A, np.eye(2 * m)[:, m:], Q, np.diag(ra), None, 0.0)
        try:
            residual = equation.trial(P).residual
        except np.linalg.LinAlgError:
            residual = np.inf
    if not (residual < np.inf and (poles.real < 0.0).all() and np.isfinite(K).all()):
        raise InputError(
            "the solution overflows with these weights; give Qp, Qv and Ra with similar magnitudes"
        )
    R = L.T @ (ra[:, None] * L)
    solution = solved(P, K, poles, residual, "closed form")
    gain = make_gain(whole, lin, solution, Q, 0.5 * R + 0.5 * R.T, np.zeros_like(lin.B))
    _caution(gain)
    return gain


def _diagonal(
    what: str,
    value: Weight,
    names: Sequence[str],
    kept: Sequence[str],
    *,
    definite: bool,
) -> Array:
    """Return the diagonal of a weight on the states `kept`, from a weight on all states `names`."""
    if not isinstance(value, Mapping) and dimension(what, value) == 2:
        raise InputError(
            f"{what} is a matrix, expected the diagonal of a weight; for a full weight matrix use "
            "lqr"
        )
    diagonal = weight(what, value, names).diagonal()[
        [names.index(name) for name in kept]
    ]
    return weight(what, diagonal, kept, definite=definite).diagonal()


def at_fixed_point(lin: LinearModel) -> LinearModel:
    """Return the model about a fixed point: `lin`, or the model with the inputs that hold it.

    Wheels may accelerate at the point. Raise `EquilibriumError` if the point is not a fixed point
    and no inputs hold the robot there. Raise `ModelError` if the robot's Pinocchio model was
    modified after the robot was created.
    """
    instance("lin", lin, LinearModel, "a fflin.LinearModel").require_unchanged()
    refuse_frozen(lin, "a design about a fixed point")
    refuse_fixed(lin, "a design")
    if is_held(lin):
        return lin
    advice = (
        "linearise about a fixed point, with the q and u of fflin.equilibrium (--equilibrium, in "
        "orbit --relative-equilibrium), or about a steady motion with moving=True"
    )
    if lin.moving:
        advice = (
            "the reference is not a steady motion; use fflin.tvlqr along its trajectory"
        )
        if lin._robot is not None and any(lin._robot.gravity):
            advice += "; in free fall, the errors move as without gravity: set gravity to zero"
    elif not lin.v.any():
        try:
            holding = held(lin)
        except EquilibriumError as error:
            advice = str(error)
        else:
            if holding is not lin:
                return holding
    rate = lin.rate
    # The message lists the largest rates first. Their magnitudes are rounded, because the last
    # digits differ between processors and would change the order of equal rates.
    sizes = [float(f"{size:.5g}") for size in np.abs(rate).tolist()]
    shown = [
        f"d {lin.state_names[i]}/dt = {rate[i]:.6g}"
        for i in np.argsort(-np.array(sizes), kind="stable")
        if lin.state_names[i] not in lin.ignorable and abs(rate[i]) > lin.bound(1e-9)
    ]
    raise EquilibriumError(f"the point is not a fixed point: {listed(shown)}; {advice}")


def _difference(a: Array, b: Array, c: Array) -> Array:
    """Return a - b c, with zeros in place of entries that are only rounding errors."""
    rounding = 1e3 * np.finfo(float).eps * (np.abs(a) + np.abs(b) @ np.abs(c))
    difference = a - b @ c
    return np.where(np.abs(difference) > rounding, difference, 0.0)


def _solve(lin: LinearModel, Q: Array, R: Array, N: Array) -> Solution:
    equation = Riccati(lin.A, lin.B, Q, R, N, lin.dt)
    start = structured(equation)
    if start is not None and is_reliable(start, lin.dt):
        return start
    # If a mode makes the problem unsolvable, these checks raise an error that names the mode. The
    # general solver would fail without naming it.
    require_stabilizable(lin)
    toward = np.linalg.solve(R, N.T)
    require_weighed(lin, _difference(lin.A, lin.B, toward), _difference(Q, N, toward))
    try:
        solution = best_solution(equation, start)
        if solution.residual > _USELESS:
            raise np.linalg.LinAlgError("the weights are too badly scaled")
    except np.linalg.LinAlgError as error:
        raise StabilizabilityError(
            f"no stabilising solution of the Riccati equation was found: {error}; scale the "
            "weights, for example with bryson, or use acceleration_lqr for double integrators"
        ) from None
    _warn_of_residual(solution)
    return solution


def _warn_of_residual(solution: Solution) -> None:
    """Warn if the residual of the Riccati equation is large."""
    if solution.residual > _COARSE:
        warnings.warn(
            f"the relative residual of the Riccati equation is {solution.residual:.0e}, so the "
            "gain is inaccurate: the weights are badly scaled; scale them, for example with bryson",
            FflinWarning,
            stacklevel=5,
        )
