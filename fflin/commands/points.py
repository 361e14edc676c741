"""Functions that build the robot, operating point and linear models of a command."""

from __future__ import annotations

import warnings
from argparse import Namespace
from collections.abc import Iterable, Mapping
from functools import reduce
from typing import TYPE_CHECKING, Any, TypeVar

import fflin
from fflin.base.errors import FflinWarning, InputError, located
from fflin.base.names import joints_by_name, rates_by_name

if TYPE_CHECKING:
    import pinocchio as pin

    from fflin.base.validation import Array
    from fflin.dynamics.state import Frame
    from fflin.robot.inputs import Input

T = TypeVar("T")


def load_robot(arguments: Namespace) -> fflin.Robot:
    """Load the robot, and apply the options that override its settings."""
    given = {
        name: value
        for name in ("passive", "gravity", "orbit", "stiffness", "damping")
        if (value := getattr(arguments, name, None))
    }
    # Give these settings to `load`, because its warnings depend on them.
    first = {"passive": given.pop("passive")} if "passive" in given else {}
    if given.get("damping") == [(None, "urdf")]:
        first["damping"] = "urdf"
    robot = fflin.load(arguments.robot, lock=once("--lock", arguments.lock), **first)
    for name in {"stiffness", "damping"} & {*given}:
        for_all = [value for joint, value in given[name] if joint is None]
        if for_all and len(given[name]) > 1:
            raise InputError(
                f"--{name} is given for all joints and for single joints; give only one of them"
            )
        given[name] = for_all[0] if for_all else once(f"--{name}", given[name])
    if getattr(arguments, "inputs", None) is not None:
        inputs = _inputs(robot, arguments.inputs)
        with located(arguments.inputs):  # a name or an inertia that this robot does not accept
            robot = robot.replace(inputs=inputs)
    if outputs := getattr(arguments, "output", None):
        given["outputs"] = outputs
    return robot.merged(given)


def _inputs(robot: fflin.Robot, name: str) -> tuple[Input, ...]:
    if name == "joints":
        if not robot.n:
            raise InputError(f"--inputs joints: '{robot.name}' has no joints")
        return (fflin.JointTorque("*"),)
    if name == "base":
        return fflin.BaseTorque(), fflin.BaseForce()
    return fflin.load_inputs(name)


def limits_of_options(
    arguments: Namespace,
) -> list[str | dict[str, float]] | dict[str, float] | None:
    """Return the limits that the options --limits and --limit define."""
    given = once("--limit", arguments.limit)
    return ["urdf", given] if arguments.limits == "urdf" else given or None


def refuse(arguments: Namespace, names: Iterable[str], why: str) -> None:
    """Raise an error if any option in `names` is given; `why` explains why it has no effect."""
    if given := [f"--{name.replace('_', '-')}" for name in names if getattr(arguments, name, None)]:
        raise InputError(f"{', '.join(given)}: {why}; remove {', '.join(given)}")


def once(option: str, pairs: list[tuple[str, T]]) -> dict[str, T]:
    """Return the values of a repeatable option by name; raise an error if a name is given twice."""
    values = dict(pairs)
    if len(values) < len(pairs):
        names = [name for name, _ in pairs]
        double = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{option} is given more than once for '{double}'; give it once")
    return values


def state_of(
    robot: fflin.Robot, arguments: Namespace, *states: Mapping[str, Any], prefix: str = ""
) -> tuple[Array, Array | None]:
    """Combine states of a robot and the options of a command; return q (nq,) and v (nv,).

    Later states override earlier states, and options override all states.

    The options are --joint, --rpy, --position and --velocity. Their names may have a prefix, such
    as ``target_``. A joint outside its limits causes a warning.
    """
    from fflin.dynamics.points import base_of, combined

    state = reduce(combined, states)
    given = {
        name: value
        for name in ("rpy", "position", "joint", "velocity")
        if (value := getattr(arguments, f"{prefix}{name}", None)) is not None
    }
    option = f"--{prefix}".replace("_", "-")
    values = once(f"{option}joint", given.pop("joint"))
    rates = once(f"{option}velocity", given.pop("velocity", []))
    named = joints_by_name("joint", values, robot.joint_names, lambda key: robot.joint(key).name)
    joints = {**state.get("joints", {}), **named}
    q = fflin.configuration(robot, joints, base_of({**state, **given}))
    model = robot.model
    for joint in robot.joints:
        if joint.name not in joints or joint.unbounded:
            continue
        low, high = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
        value, unit = joints[joint.name], "m" if joint.prismatic else "rad"
        if not low <= value <= high:
            warnings.warn(
                f"joint '{joint.name}' at {value:g} {unit} is outside {low:g} to {high:g} {unit}",
                FflinWarning,
                stacklevel=2,
            )
    fflin.velocity(robot, rates)  # raises an error if it is invalid
    rates = {**state.get("velocity", {}), **rates_by_name(robot.joint_names, rates)}
    return q, fflin.velocity(robot, rates) if rates else None


def point_of(
    robot: fflin.Robot, arguments: Namespace, *states: Mapping[str, Any], prefix: str = ""
) -> tuple[Array, Array | None, pin.SE3 | None]:
    """Return q (nq,), v (nv,) and the reference of an operating point; see `state_of`.

    With --relative-equilibrium, the base pose is the pose of that equilibrium, which is also the
    reference.
    """
    number = getattr(arguments, "relative_equilibrium", None)
    if number:
        names = (f"{prefix}rpy", f"{prefix}position")
        refuse(arguments, names, "--relative-equilibrium already sets the base pose")
    q, v = state_of(robot, arguments, *states, prefix=prefix)
    if not number:
        return q, v, reference_of(arguments)
    q, reference = attitude(robot, q, number, arguments.frame)
    return q, v, reference


def reference_of(arguments: Namespace) -> pin.SE3 | None:
    """Return the reference from --reference; None is the base pose at the operating point."""
    import pinocchio as pin

    return pin.SE3.Identity() if getattr(arguments, "reference", None) == "world" else None


def linear_model(
    arguments: Namespace, robot: fflin.Robot | None = None
) -> tuple[fflin.Robot, fflin.LinearModel]:
    """Return the robot and its linear model about the operating point of the arguments."""
    robot = robot or load_robot(arguments)
    return robot, model_about(robot, arguments, *point_of(robot, arguments, robot.point))


def model_about(
    robot: fflin.Robot, arguments: Namespace, q: Array, v: Array | None, reference: pin.SE3 | None
) -> fflin.LinearModel:
    """Linearise about q (nq,) and v (nv,), with inputs from --effort or --equilibrium."""
    axes = {"frame": arguments.frame, "reference": reference}
    if arguments.relative_equilibrium or arguments.equilibrium:
        by = "--relative-equilibrium" if arguments.relative_equilibrium else "--equilibrium"
        refuse(arguments, ("effort",), f"{by} already sets the inputs at the operating point")
        held = fflin.equilibrium(robot, q, v=v, **axes)
        return fflin.linearize(robot, held.q, v, held.u, **axes)
    given = once("--effort", arguments.effort)
    return fflin.linearize(robot, q, v, fflin.effort(robot, given) if given else None, **axes)


def attitude(robot: fflin.Robot, q: Array, number: int, frame: Frame) -> tuple[Array, pin.SE3]:
    """Return q (nq,) and the base placement of the relative equilibrium `number`, from 1 to 24."""
    import pinocchio as pin

    q = fflin.relative_equilibria(robot, q, frame=frame)[number - 1].q
    return q, pin.XYZQUATToSE3(q[:7])


def models_along(arguments: Namespace, robot: fflin.Robot | None = None) -> fflin.LinearTrajectory:
    """Return the linear models along the trajectory in the arguments."""
    point = ("joint", "velocity", "effort", "equilibrium", "rpy", "position")
    refuse(arguments, point, "with --trajectory, the models are about the points of the trajectory")
    robot = robot or load_robot(arguments)
    settings = {"hold": arguments.hold, "frame": arguments.frame}
    motion = fflin.Trajectory.load(arguments.trajectory, robot, **settings)
    return fflin.linearize_trajectory(robot, motion, strict=arguments.strict)
