"""Weights of a quadratic cost, given by the user or computed by a rule."""

import math
import warnings
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from fflin.analysis.ranks import null_space
from fflin.analysis.reduction import (
    ignorable_wheels,
    regulated_part,
    rigid_forces,
    without,
)
from fflin.base.errors import FflinWarning, InputError, listed, require_known, unknown
from fflin.base.names import by_name, input_keys, matching, stands_for_any
from fflin.base.validation import (
    Array,
    Indices,
    dimension,
    instance,
    number,
    numbers,
    positive,
    shaped,
)
from fflin.control.default_weights import Pace, default_weights
from fflin.dynamics.delays import HeldSystem, split
from fflin.dynamics.integrators import held_cost
from fflin.dynamics.state import selection
from fflin.linear.linear_trajectory import LinearTrajectory
from fflin.linear.model import Delay, LinearModel, delays_of
from fflin.robot.fields import require_chart, warn_of_degrees
from fflin.robot.rotors import motor_of

Weight: TypeAlias = ArrayLike | Mapping[str, float]

# Rule for the weights: its name, or a mapping with the keys of `weights` in `Robot.replace`.
Rule: TypeAlias = str | Mapping[str, object]

# A weight from the user, its name or pattern, and whether the user gave a largest value instead of
# the weight (Bryson's rule).
_Given: TypeAlias = tuple[float, str, bool]

# An asymmetry or a negative eigenvalue of a weight matrix counts as rounding error if its magnitude
# is at most this times the largest entry.
_ROUNDING = 1e-9

# Bandwidth for which wheel speeds are weighted, relative to the bandwidth of the loop.
_SPEEDS = 0.1

# Part of the description of default weights that also regulate wheel speeds.
WITH_WHEEL_SPEEDS = "wheel speeds are also regulated"


def bryson(lin: LinearModel | LinearTrajectory, largest: Mapping[str, float]) -> Array:
    r"""Return the diagonal of a weight by Bryson's rule: :math:`1/\text{largest}^2` per entry.

    With this weight, each signal contributes 1 to the cost at its largest acceptable deviation.

    Parameters
    ----------
    lin : LinearModel or LinearTrajectory
    largest : mapping
        Mapping {name: largest acceptable value}, for states or for inputs. A name is one of

        - a single name in ``lin.state_names`` or ``lin.input_names``;
        - a group such as ``q_b``, ``r_b``, ``q_m``, ``omega_b``, ``v_b``, ``qdot_m``, ``tau_b``,
          ``F_b``, ``tau_m``;
        - a pattern such as ``q_m.hinge_*``.

        A single name takes precedence over groups and patterns. Unnamed states have zero weight.
        Every input must be named.

    Returns
    -------
    ndarray (nx,) or (nu,)
        Diagonal of Q or of R, for `lqr`.

    Raises
    ------
    UnknownNameError
        If a name does not exist.
    InputError
        If `lin` is not a model, a value is not positive, or the names mix states and inputs.

    References
    ----------
    A. E. Bryson and Y.-C. Ho, Applied Optimal Control, 1975, section 5.2.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> Q = fflin.bryson(lin, {"q_b": 0.05, "r_b": 0.1, "q_m": 0.1})
    >>> R = fflin.bryson(lin, {"tau_b": 1.0, "F_b": 5.0, "tau_m": 2.0})
    >>> fflin.lqr(lin, Q, R).K.shape
    (9, 18)
    """
    instance(
        "lin",
        lin,
        (LinearModel, LinearTrajectory),
        "a LinearModel or a LinearTrajectory",
    )
    if not isinstance(largest, Mapping) or not largest:
        raise InputError(
            f"largest is {largest!r}, expected {{name: largest acceptable value}}"
        )
    keys = (*lin.state_names, *input_keys(lin))
    indices = {
        index for name in largest for index in matching("state or input", name, keys)
    }
    if len({index < len(lin.state_names) for index in indices}) > 1:
        raise InputError(
            f"largest has states and inputs ({', '.join(map(repr, largest))}); call bryson once "
            "for the states and once for the inputs"
        )
    of_inputs = min(indices) >= len(lin.state_names)
    names = input_keys(lin) if of_inputs else lin.state_names
    sizes = numbers("largest", largest, "name", "largest value of")
    for key, size in sizes.items():
        if key.startswith("q_b"):
            require_chart(f"largest value of '{key}'", size)
    _warn_of_degrees(lin, sizes)
    values = {
        key: inverse_square(f"largest value of '{key}'", x) for key, x in sizes.items()
    }
    return _diagonal("largest", values, names, complete=of_inputs)


def _warn_of_degrees(
    lin: LinearModel | LinearTrajectory, sizes: Mapping[str, float]
) -> None:
    """Warn of largest values {name or pattern: value} of joints that look like degrees."""
    robot = None
    if isinstance(lin, LinearModel):
        robot = lin._robot
    if isinstance(lin, LinearTrajectory):
        robot = lin.robot
    if robot is None:
        return
    keys = (*lin.state_names, *input_keys(lin))
    indices = by_name("state or input", sizes, keys)
    warn_of_degrees(robot, {keys[i]: size for i, size in indices.items()})


def inverse_square(what: str, size: float) -> float:
    """Return ``1 / size^2``, or raise `InputError` if `size` is not between 1e-150 and 1e150."""
    if not 1e-150 <= size <= 1e150:
        raise InputError(
            f"{what} is {size:g}, expected a positive number, 1e-150 to 1e150"
        )
    return size**-2


def weight(
    what: str, value: Weight, names: Sequence[str], *, definite: bool = False
) -> Array:
    """Return a weight (k, k) from a matrix, a diagonal, a number, or {name or pattern: number}."""
    size = len(names)
    rounding = 0.0
    if isinstance(value, Mapping):
        matrix = np.diag(_diagonal(what, value, names, complete=definite))
    elif (indices := dimension(what, value)) == 0:
        matrix = number(what, value) * np.eye(size)
    elif indices == 1:
        hint = f": one weight for each of {names[0]} to {names[-1]}"
        matrix = np.diag(shaped(what, value, (size,), hint))
    else:
        matrix = shaped(what, value, (size, size))
        rounding = _ROUNDING
        skew = np.abs(matrix - matrix.T)
        if skew.max() > rounding * np.abs(matrix).max():
            i, j = np.unravel_index(int(skew.argmax()), skew.shape)
            raise InputError(
                f"{what} is not symmetric: {what}[{i}, {j}] is {matrix[i, j]:g} and "
                f"{what}[{j}, {i}] is {matrix[j, i]:g}; give a symmetric matrix"
            )
        matrix = 0.5 * matrix + 0.5 * matrix.T
    require_semidefinite(what, matrix, names, rounding, definite)
    return matrix


def require_semidefinite(
    what: str,
    matrix: Array,
    names: Sequence[str],
    rounding: float,
    definite: bool = False,
) -> None:
    """Raise `InputError` if a matrix is not positive semidefinite.

    The message gives the lowest eigenvalue. A negative eigenvalue is permitted if its magnitude is
    at most `rounding` times the largest entry. If `definite` is True, the matrix must be positive
    definite.
    """
    try:
        np.linalg.cholesky(matrix)  # quicker than eigenvalues
    except np.linalg.LinAlgError:
        values, directions = np.linalg.eigh(matrix)
        if definite or values[0] < -rounding * np.abs(matrix).max(initial=0.0):
            kind = "definite" if definite else "semidefinite"
            raise InputError(
                f"{what} is not positive {kind}: it has the eigenvalue {values[0]:.6g} with an "
                f"eigenvector mainly along {names[int(np.abs(directions[:, 0]).argmax())]}; "
                "increase the weight there"
            ) from None


def robot_states(model: LinearModel | LinearTrajectory) -> tuple[str, ...]:
    """Return the names of the states of a model, without commands on their way."""
    if isinstance(model, LinearModel):
        return model.robot_states
    return model.state_names


def padded(values: ArrayLike, model: LinearModel | LinearTrajectory) -> ArrayLike:
    """Return an array (k, ..) with zero rows for the states that are not states of the robot.

    An array whose length is not the number of the robot's states is returned as it is.
    """
    own = len(robot_states(model))
    more = len(model.state_names) - own
    if not more or np.shape(values)[:1] != (own,):
        return values
    array = np.asarray(values, dtype=float)
    return np.concatenate((array, np.zeros((more, *array.shape[1:]))))


def state_weight(
    what: str, value: Weight, model: LinearModel | LinearTrajectory
) -> Array:
    """Return a weight (nx, nx) on the states of a model, as `weight` does.

    Commands on their way get no weight, unless the weight is a matrix or a diagonal that contains
    them.
    """
    names = robot_states(model)
    whole = model.state_names
    whole_given = (
        not isinstance(value, Mapping)
        and dimension(what, value) > 0
        and len(np.asarray(value)) == len(whole)
    )
    if names == whole or whole_given:
        return weight(what, value, whole)
    matrix: Array = np.zeros((len(whole), len(whole)))
    matrix[: len(names), : len(names)] = weight(what, value, names)
    return matrix


def cost_weights(
    model: LinearModel | LinearTrajectory, Q: Weight, R: Weight, N: ArrayLike | None
) -> tuple[Array, Array, Array]:
    """Check the weights Q, R and N, and return them as matrices; N is zero by default."""
    Q = state_weight("Q", Q, model)
    R = weight("R", R, input_keys(model), definite=True)
    cross: Array = np.zeros((len(Q), len(R)))
    if N is not None:
        cross = shaped("N", padded(N, model), cross.shape)
    if cross.any():
        with np.errstate(over="ignore", invalid="ignore"):
            reduced = Q - cross @ np.linalg.solve(R, cross.T)
        if not np.isfinite(reduced).all():
            raise InputError("N R^-1 N' overflows; give a smaller N or a larger R")
        require_semidefinite("Q - N R^-1 N'", reduced, model.state_names, _ROUNDING)
    return Q, R, cross


class SampledCost(NamedTuple):
    """Weights (Q, R, N) of a cost summed over samples, for ``lqr(lin.discretize(dt), *cost)``."""

    Q: Array
    R: Array
    N: Array


def sampled_cost(
    lin: LinearModel,
    dt: float,
    Q: Weight,
    R: Weight,
    N: ArrayLike | None = None,
    *,
    delay: Delay = 0.0,
) -> SampledCost:
    r"""Return discrete-time weights whose summed cost equals a continuous-time cost.

    The sum over the samples equals the integral if the inputs are held between samples.

    By (10.1) of docs/derivation.md, the weights are

    .. math:: \begin{bmatrix} Q_d & N_d \\ N_d^T & R_d \end{bmatrix} = \int_0^h e^{F^T t}
              \begin{bmatrix} Q & N \\ N^T & R \end{bmatrix} e^{F t}\,dt,\qquad
              F = \begin{bmatrix} A & B \\ 0 & 0 \end{bmatrix}

    At rest F^3 = 0, so the integral is a polynomial in h and is computed exactly. In motion, the
    integral is computed over a short step by van Loan's method, and the step is then doubled until
    it equals h.

    With a `delay`, the weights are for ``lin.discretize(dt, delay)``. The integral then contains
    the inputs that act, and Q_d also weights the commands on their way. The cost of the inputs
    themselves counts when they are commanded.

    Parameters
    ----------
    lin : LinearModel
        Continuous model.
    dt : float
        Sample time h [s].
    Q, R : see `lqr`
        Weights of the integral.
    N : array_like (nx, nu), optional
        Cross weight of the integral.
    delay : float or mapping, optional
        Delay of the inputs [s], as in `LinearModel.discretize`.

    Returns
    -------
    SampledCost
        Weights (Q, R, N) for `lqr`.

    Raises
    ------
    InputError
        If the model is already sampled, `dt` is not positive, or `lqr` would refuse a weight.

    References
    ----------
    C. F. van Loan, Computing integrals involving the matrix exponential, IEEE Trans. Automatic
    Control 23(3), 1978.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> cost = fflin.sampled_cost(lin, 0.1, 1.0, 1.0)
    >>> fflin.lqr(lin.discretize(0.1), *cost).dt
    0.1
    """
    if not isinstance(lin, LinearModel) or lin.dt:
        raise InputError(
            "lin must be a continuous LinearModel; give the model before it is sampled"
        )
    h = positive("dt", dt, "s")
    Q, R, cross = cost_weights(lin, Q, R, N)
    nx = len(Q)
    delays = np.array(delays_of(lin, delay, h))
    if any(split(each, h).samples for each in delays.tolist()):
        return _delayed_cost(HeldSystem(lin.A, lin.B, h, delays), Q, R, cross)
    W = np.block([[Q, cross], [cross.T, R]])
    F = np.zeros_like(W)
    F[:nx] = np.hstack((lin.A, lin.B))
    total = held_cost(F, W, h)
    if not np.isfinite(total).all():
        raise InputError(
            f"dt is {h:g} s, within which the model overflows; give a shorter dt"
        )
    return SampledCost(total[:nx, :nx], total[nx:, nx:], total[:nx, nx:])


def _delayed_cost(held: HeldSystem, Q: Array, R: Array, N: Array) -> SampledCost:
    """Return the weights (10.1) for a model (10.9) whose inputs arrive after delays.

    Between the times at which commands arrive, the inputs are constant.
    """
    nx, nu = N.shape
    h, size = held.h, held.size
    W = np.block([[Q, N], [N.T, np.zeros_like(R)]])
    F = np.zeros_like(W)
    F[:nx] = np.hstack((held.A, held.B))
    total: Array = np.zeros((size + nu, size + nu))
    total[size:, size:] = h * R
    rests = [delay.rest for delay in held.delays if delay.samples]
    for begin, end in pairwise(sorted({0.0, *rests, h})):
        start = np.vstack(
            (np.hstack(held.after(begin)), np.hstack(held.applied(begin)))
        )
        total += start.T @ held_cost(F, W, end - begin) @ start
    if not np.isfinite(total).all():
        raise InputError(
            f"dt is {h:g} s, within which the model overflows; give a shorter dt"
        )
    total = 0.5 * (total + total.T)
    return SampledCost(total[:size, :size], total[size:, size:], total[:size, size:])


def _diagonal(
    what: str, values: Mapping[str, float], names: Sequence[str], *, complete: bool
) -> Array:
    checked = numbers(what, values, "name", "weight of")
    value_at = by_name(f"entry of {what}", checked, names)
    if complete and len(value_at) < len(names):
        missing = next(
            name for index, name in enumerate(names) if index not in value_at
        )
        raise InputError(
            f"{what} has no value for {missing}; give a value for every entry of {what}"
        )
    return np.array([value_at.get(index, 0.0) for index in range(len(names))])


def rule_weights(
    lin: LinearModel, given: Rule | None, pace: Pace, wheel_speeds: bool | None = None
) -> tuple[Array, Array, Array | None, str]:
    """Return Q, R and N by a rule, and a description of the rule.

    Single weights in `given` replace the weights of the rule. If `given` names no rule, the rule
    and the single weights in `Robot.weights` apply too, but `given` takes precedence.
    """
    # If a sampled model has a known continuous model, the rule gives a cost for the continuous
    # model. This cost is then converted to a sampled cost with held inputs. If neither `given` nor
    # the robot names a rule, the rule is "urdf".
    whole = lin.generator or lin.undelayed
    source = whole.undelayed
    if not isinstance(given, Mapping):
        given = {"rule": given}
    require_known("part of weights", given, ("rule", "q", "r", "bryson", "integral"))
    robot_weights = lin.weights if given.get("rule") is None else {}
    name = robot_weights.get("rule", given.get("rule"))
    terms: Array = np.zeros(sum(source.B.shape))
    if name is None or name == "urdf":
        Q, R, rule, terms = _of_regulated(source, pace, wheel_speeds)
    elif name == "identity":
        nx, nu = source.B.shape
        Q = np.eye(nx)
        R = np.eye(nu)
        rule = "1 for every state and every input (identity)"
    else:
        raise unknown("rule of weights", str(name), ("urdf", "identity"))
    if weights := _weights_of(source, robot_weights, of_robot=True) | _weights_of(
        source, given
    ):
        # By Bryson's rule, each signal with a largest value from the user costs 1 at this value.
        # To match this scale, Q and R of the rule are multiplied by a common factor, which does not
        # change the gain of the rule. With this factor, the geometric mean of the costs of the same
        # signals is 1 at the largest values of the rule.
        costs = [
            terms[i] for i, (_, _, largest) in weights.items() if largest and terms[i]
        ]
        scale = 1.0
        if costs:
            scale = math.exp(-np.log(costs).mean())
        Q, R = scale * Q, scale * R
        for index, (value, *_) in weights.items():
            matrix, at = (Q, index) if index < len(Q) else (R, index - len(Q))
            matrix[at] = 0.0
            matrix[:, at] = 0.0
            matrix[at, at] = value
        named = dict.fromkeys(key for _, key, _ in weights.values())
        rule = f"{', '.join(named)} as given; all other weights: {rule}"
        if terms.any():
            rule += " (these figures are for this rule alone)"
    if source.dt == lin.dt:
        return state_weight("Q", Q, lin), R, None, rule
    delays = dict(zip(input_keys(lin), lin.delay.tolist(), strict=True))
    return (*sampled_cost(whole, lin.dt, Q, R, delay=delays), rule)


def are_default(lin: LinearModel, given: Rule | None) -> bool:
    """Return whether the rule "urdf" sets all weights: neither `given` nor the robot sets any."""
    if not isinstance(given, Mapping):
        given = {"rule": given}
    sources = [given]
    if given.get("rule") is None:
        sources.append(lin.weights)
    rules = {source["rule"] for source in sources if source.get("rule")}
    single = ("q", "r", "bryson")
    return rules <= {"urdf"} and not any(
        source.get(part) for source in sources for part in single
    )


def integrated(lin: LinearModel, given: Rule | None) -> Any:
    """Return the integrated signals of `given` or of the robot's weights, or None."""
    own = given.get("integral") if isinstance(given, Mapping) else None
    if own is None and isinstance(lin, LinearModel):
        own = lin.weights.get("integral")
    return own


def warn_of_integral(
    lin: LinearModel, cost: tuple[object, ...], given: Rule | None, design: str
) -> None:
    """Warn that a design without integral action ignores the integrals in the weights.

    `cost` are the weights Q and R from the user, with which the weights of the robot have no
    effect.
    """
    if all(matrix is None for matrix in cost) and integrated(lin, given):
        warnings.warn(
            f"{design} has no integral action, so the entry integral of the weights is ignored, "
            "and a constant disturbance leaves an error",
            FflinWarning,
            stacklevel=4,
        )


def _limited_wheels(lin: LinearModel, wheels: Indices) -> Indices:
    """Return the indices (k,) of the wheels with a motor and a speed limit."""
    limited = list[int]()
    for i in wheels:
        motor = motor_of(lin.input_names, lin.state_names[i].removeprefix("q_m."))
        if motor is not None and lin.state_names[i + len(lin.M)] in lin.limits:
            limited.append(i)
    return np.array(limited, dtype=np.intp)


def _of_regulated(
    lin: LinearModel, pace: Pace, wheel_speeds: bool | None
) -> tuple[Array, Array, str, Array]:
    """Return Q (nx, nx), R, the rule and the costs (nx + nu,), for a model that may have wheels.

    The costs are the contributions of the states and inputs to the cost function at their largest
    values. The cost is 0 for states and inputs without a largest value in the rule.
    """
    # `lin` contains all states, and `part` the regulated states, which may include wheel speeds.
    # `body` contains the regulated states of the robot without its ignorable wheels. The default
    # weights are computed for `body`, and the wheel speeds of `part` get their weight afterwards.
    part = regulated_part(lin, wheel_speeds)
    wheels, _ = ignorable_wheels(lin)
    body = lin
    if part is not lin:
        body = regulated_part(without(lin, wheels))
    momenta, beyond = _momenta_left(lin, wheels)
    Q, R, rule, bandwidth, terms = default_weights(body, pace, momenta)
    if beyond:
        rule += (
            "; wheel speeds already at or beyond the URDF limit at the operating point: "
            f"{listed(beyond)}"
        )
    to_body = selection(body.state_names, lin.state_names)
    nx = len(body.state_names)
    Q = to_body.T @ Q @ to_body
    terms = np.append(terms[:nx] @ to_body, terms[nx:])
    if speeds := [name for name in part.state_names if name not in body.state_names]:
        Q += _wheel_speed_cost(lin, wheels, speeds, R, _SPEEDS * bandwidth)
        rule = f"{rule}; {WITH_WHEEL_SPEEDS}"
    return Q, R, rule, terms


def _momenta_left(
    lin: LinearModel, wheels: Indices
) -> tuple[dict[str, float], list[str]]:
    """Return {wheel speed: largest momentum [N m s] that the motor may add to the wheel}.

    `wheels` are the indices of the ignorable wheels. The momentum of wheel i is the difference
    between its speed limit and its present speed, divided by (M^-1)_ii. The second result contains
    the names of the wheel speeds that are at or beyond their limits. The momentum of such a wheel
    is computed as if the wheel were at rest.
    """
    limited = _limited_wheels(lin, wheels)
    names = [lin.state_names[i + len(lin.M)] for i in limited]
    speeds = np.abs(lin.x0[limited + len(lin.M)])
    limits = np.array([lin.limits[name] for name in names])
    speeds_left = np.where(speeds < limits, limits - speeds, limits)
    momenta = speeds_left / np.linalg.inv(lin.M).diagonal()[limited]
    beyond = [
        name
        for name, speed, limit in zip(names, speeds, limits, strict=True)
        if speed >= limit > 0.0
    ]
    return dict(zip(names, momenta, strict=True)), beyond


def _wheel_speed_cost(
    lin: LinearModel, wheels: Indices, speeds: list[str], R: Array, bandwidth: float
) -> Array:
    """Return the weight w^2 S' (X X')^+ S (nx, nx) that regulates wheel speeds.

    S selects the wheel speeds named `speeds`, and w [rad/s] is `bandwidth`. X maps combinations of
    inputs to the accelerations of these wheels. The combinations are orthonormal with respect to R,
    and exert no force on the rigid motions of the robot without the ignorable `wheels`.
    """
    S = selection(speeds, lin.state_names)
    root, forces = np.sqrt(R.diagonal()), rigid_forces(without(lin, wheels))
    forceless, _ = null_space(forces @ np.diag(1.0 / root))
    X = S @ lin.B / root @ forceless / (lin.dt or 1.0)
    inverse = np.linalg.pinv(X @ X.T, 1e-9, hermitian=True)
    cost: Array = bandwidth**2 * S.T @ inverse @ S
    return cost


def _weights_of(
    lin: LinearModel, given: Mapping[str, object], *, of_robot: bool = False
) -> dict[int, _Given]:
    """Return {index: given weight}. The indices of the inputs follow the indices of the states."""
    states = lin.state_names
    inputs = input_keys(lin)
    given_weights = dict[int, _Given]()
    every = (*states, *inputs)
    kinds = (
        ("q", "state", states),
        ("r", "input", inputs),
        ("bryson", "state or input", every),
    )
    for part, kind, known in kinds:
        values = dict[str, _Given]()
        sizes = numbers(part, given.get(part, {}), "name", f"{part} of")
        if part == "bryson" and not of_robot:
            _warn_of_degrees(lin, sizes)
        for key, value in sizes.items():
            if of_robot and not stands_for_any(key, known):
                # a reduced model may lack states that the robot's weights name
                continue
            label = f"largest value of '{key}' (--bryson)"
            largest = part == "bryson"
            if largest and key.startswith("q_b"):
                require_chart(label, value)
            cost = value
            if largest:
                cost = inverse_square(label, value)
            values[key] = cost, key, largest
        first = len(states) if part == "r" else 0
        at = {first + i: x for i, x in by_name(kind, values, known).items()}
        if both := given_weights.keys() & at.keys():
            raise InputError(
                f"'{every[min(both)]}' has both a weight and a largest value "
                "(bryson); give only one of them"
            )
        given_weights |= at
    return given_weights
