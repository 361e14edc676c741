"""Checks that a model or design fits a robot: the signals must have the same names and units."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from fflin.base.errors import InputError, listed
from fflin.base.validation import Array, instance, vector
from fflin.dynamics.aba import Aba
from fflin.dynamics.outputs import Measuring, Sensing
from fflin.dynamics.state import Actuation, StateMap
from fflin.linear.model import LinearModel
from fflin.robot.outputs import FullState
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from fflin import Gain, GainBatch

Names: TypeAlias = tuple[str, ...]

# Names of signals, and their units in the same order.
Signals: TypeAlias = tuple[Names, Names]


def about_point(lin: object) -> LinearModel:
    """Return `lin` if it is a linear model with a fixed reference, else raise `InputError`."""
    model = instance("lin", lin, LinearModel, "a fflin.LinearModel")
    if model.moving:
        raise InputError(
            "the model has a moving reference, expected a fixed one; linearise with moving=False, "
            "or follow the moving reference with TrajectoryFeedback"
        )
    return model


def require_fit(
    lin: LinearModel,
    robot: Robot,
    state: StateMap,
    *,
    whole: bool = False,
    sensed: bool = False,
) -> None:
    """Raise `InputError` if a model does not have the states and inputs of the robot.

    If `sensed` is True, the model must also have the outputs of the robot. If `whole` is False, a
    reduced model, which lacks some states of the robot, is accepted.
    """
    made = f"the model was made for '{lin.robot}'"
    names = lin.robot_states
    require_same_constraints(
        made, robot, states=len(names), dependent=bool(lin.dependent)
    )
    require_same(
        made, state, "state", names, lin.state_units[: len(names)], part=not whole
    )
    require_same(made, state, "input", lin.input_names, lin.input_units)
    require_configuration_size(made, len(lin.q), robot)
    if sensed:
        require_same(made, state, "output", lin.output_names, lin.output_units)


def require_same_constraints(
    made: str, robot: Robot, *, states: int, dependent: bool
) -> None:
    """Raise `InputError` if only one of a design and a robot has constraints.

    `made` is the beginning of the message. `states` is the number of states of the design, and
    `dependent` whether constraints determine others.
    """
    if dependent and not robot.constraints:
        raise InputError(
            f"{made} with constraints and has {states} independent states, but the given robot "
            f"'{robot.name}' has no constraints; give the robot with its constraints, or make the "
            "model again for the free robot"
        )
    if robot.constraints and not dependent:
        raise InputError(
            f"{made} without constraints and has {states} states, but the given robot "
            f"'{robot.name}' has constraints and fewer independent states; make the model again "
            "for the given robot"
        )


def signals_of(state: StateMap, kind: str) -> Signals:
    """Return the names and units of a robot's signals; `kind` is "state", "input" or "output"."""
    source: StateMap | Actuation | Sensing = state
    if kind == "input":
        source = Actuation(state)
    elif kind == "output" and state.robot.outputs != (FullState(),):
        source = Sensing(state, state.robot.outputs)
    return source.names, source.units


def _counted(kind: str, names: list[str]) -> str:
    """Return the names of signals after a singular or plural noun, such as "states x, y"."""
    noun = kind if len(names) == 1 else f"{kind}s"
    return f"{noun} {listed(names)}"


def require_same(
    made: str,
    state: StateMap,
    kind: str,
    names: Names,
    units: Names | None,
    *,
    part: bool = False,
) -> None:
    """Raise `InputError` if the robot's signals do not have the given names and units.

    `made` is the beginning of the message, such as "the model was made for 'arm'". The text before
    " was " must name the object. If `units` is None, only names are compared. If `part` is True,
    the robot may have further signals.
    """
    robot = state.robot
    # {name: unit} of the robot's signals, and of the expected signals
    actual = dict(zip(*signals_of(state, kind), strict=True))
    if part and names != tuple(actual):
        actual = {name: actual[name] for name in names if name in actual}
    if names == tuple(actual) and units in (None, tuple(actual.values())):
        return
    expected = dict(zip(names, units or map(actual.get, names), strict=True))
    missing = [name for name in expected if name not in actual]
    extra = [name for name in actual if name not in expected]
    changed = [name for name in expected if expected[name] != actual.get(name)]
    if missing:
        difference = f"lacks the {_counted(kind, missing)}"
    elif extra:
        difference = f"also has the {_counted(kind, extra)}"
    elif changed:
        name = changed[0]
        difference = f"has its {kind} {name} in {actual[name]}, not {expected[name]}"
    else:
        difference = f"has its {kind}s in another order"
    subject = made.partition(" was ")[0]
    raise InputError(
        f"{made}, but the given robot '{robot.name}' {difference}; make {subject} again for the "
        "given robot, or use Robot.replace to give the robot the same joints, inputs and outputs"
    )


def require_configuration_size(made: str, size: int, robot: Robot) -> None:
    """Raise `InputError` if a configuration of the robot does not have `size` entries.

    For robots with the same joint names, the number of entries depends only on which joints are
    continuous: the angle of a continuous joint has two entries, its cosine and sine.

    `made` is the beginning of the message, as in `require_same`.
    """
    if size == robot.nq:
        return
    subject = made.partition(" was ")[0]
    raise InputError(
        f"{made}, but the given robot '{robot.name}' has other continuous joints, so that its "
        f"configuration has {robot.nq} entries instead of {size}; make {subject} again for the "
        "given robot"
    )


def outputs(
    robot: Robot,
    lin: LinearModel,
    q: Array,
    v: Array | None = None,
    u: Array | None = None,
) -> Array:
    """Return the outputs y of a robot in the coordinates of a linear model.

    - Attitudes are in the model's chart. Of the two quaternions of an attitude, the one with a
      scalar part q0 >= 0 is used.
    - Rotations of frames are relative to their attitudes at the operating point.
    - Angles of continuous joints are unwrapped to be nearest to their values at the operating
      point.

    Give ``y - lin.y0`` to a controller that was designed for the linear model.

    Parameters
    ----------
    robot : Robot
        Robot with the same states, inputs and outputs as the model. Its masses may differ from
        the masses with which the model was computed.
    lin : LinearModel
        Model that defines the reference and the operating point.
    q, v : array_like (nq,), (nv,)
        Configuration and velocity in Pinocchio's order; v is zero by default.
    u : array_like (nu,), optional
        Inputs; u0 by default. Only accelerometer outputs depend on u.

    Returns
    -------
    ndarray (ny,)
        Outputs in the order of ``lin.output_names``.

    Raises
    ------
    InputError
        If an argument has a wrong size, the model and the robot have different signals, or the
        model has a moving reference.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble", outputs=[fflin.JointPositions()])
    >>> lin = fflin.linearize(robot)
    >>> fflin.outputs(robot, lin, fflin.configuration(robot, {"joint_2": 0.4}))
    array([0. , 0.4, 0. ])
    """
    instance("robot", robot, Robot, "a fflin.Robot")
    reference = about_point(lin).reference
    state = StateMap(robot, reference=reference, frame=lin.frame, t=lin.time)
    require_fit(lin, robot, state, sensed=True)
    q = robot.checked_configuration(q)
    v = np.zeros(robot.nv) if v is None else robot.checked_velocity(v)
    u = lin.u0 if u is None else vector("u", u, len(lin.u0), "one for each input")
    a: Array = np.zeros(robot.nv)
    if any(output.FEELS_ACCELERATION for output in robot.outputs):
        aba = Aba(state)
        u_in_base_axes = aba.actuation.in_base_axes(state.unchecked_chart(q), u)
        a = aba.acceleration(q, v, u_in_base_axes)
    x = state.read(q, v, near=state.read(lin.q, lin.v))
    measure = Measuring(state, lin.q)
    return measure(x, q, v, a)


def line_up(gain: Gain | GainBatch, lin: LinearModel) -> Array:
    """Return the matrix K of a gain for another model, with states and inputs matched by name.

    Use `line_up` to keep a gain after a change of the robot, such as a jammed joint or a captured
    payload, which leaves most states the same. Columns of K belong to states, and rows to inputs.
    A state of the model that K does not have gets a zero column, and such an input a zero row.
    Columns and rows of K for states and inputs that the model does not have are dropped.

    Parameters
    ----------
    gain : Gain or GainBatch
        Gain or gains of the robot before the change.
    lin : LinearModel
        Model of the robot after the change.

    Returns
    -------
    ndarray (nu, nx) or (N, nu, nx)

    Raises
    ------
    InputError
        If gain and model have different frames or sample times, or if each of them has states or
        inputs that the other lacks, because they then belong to different robots.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> stuck = fflin.linearize(fflin.load("planar_detumble", lock=["joint_1"]))
    >>> fflin.line_up(fflin.lqr(lin), stuck).shape
    (8, 16)
    """
    if not hasattr(gain, "K") or not hasattr(gain, "state_names"):
        raise InputError(
            f"gain has type {type(gain).__name__}, expected a Gain or GainBatch"
        )
    instance("lin", lin, LinearModel, "a fflin.LinearModel")
    for key in ("frame", "dt"):
        gain_value, model_value = getattr(gain, key, lin.dt), getattr(lin, key)
        if gain_value != model_value:
            raise InputError(
                f"the {key} of the gain is {gain_value}, but the {key} of the model is "
                f"{model_value}; give both the same {key}"
            )
    selections = []
    for kind in ("input", "state"):
        gain_names = getattr(gain, f"{kind}_names")
        model_names = getattr(lin, f"{kind}_names")
        lacking = [n for n in gain_names if n not in model_names]
        beside = [n for n in model_names if n not in gain_names]
        if lacking and beside:
            raise InputError(
                f"the model of '{lin.robot}' lacks the {kind} {lacking[0]} of the gain of "
                f"'{gain.robot}', and the gain lacks the {kind} {beside[0]} of the model; either "
                f"the model or the gain must have all {kind}s of the other"
            )
        selections.append(
            np.array([[float(a == b) for b in gain_names] for a in model_names])
        )
    of_inputs, of_states = selections
    return np.asarray(of_inputs @ gain.K @ of_states.T)
