"""Robot and operating point that the arguments of a command define."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from fflin.base.errors import FflinWarning, InputError, located

if TYPE_CHECKING:
    import pinocchio as pin

    from fflin.base.validation import Array
    from fflin.dynamics.state import Frame
    from fflin.linear.model import LinearModel
    from fflin.robot.inputs import Input
    from fflin.robot.robot import Robot


def load_robot(arguments: argparse.Namespace) -> Robot:
    """Load the robot with the joints, inputs, outputs, gravity and orbit of the arguments."""
    from fflin.robot.loading import load

    lock, passive = once("--lock", arguments.lock), getattr(arguments, "passive", [])
    first: dict[str, Any] = {"passive": passive} if passive else {}
    if getattr(arguments, "damping", None) == [(None, "urdf")]:
        first["damping"] = "urdf"
    robot = load(arguments.robot, lock=lock, **first)
    given = {name: getattr(arguments, name, None) for name in ("gravity", "orbit")}
    fields: dict[str, object] = {name: value for name, value in given.items() if value}
    for name in ("stiffness", "damping"):
        values = getattr(arguments, name, [])
        for_all = [value for joint, value in values if joint is None]
        if for_all and len(values) > 1:
            raise InputError(
                f"--{name} is given for all joints and for single joints; give only one of them"
            )
        if values:
            fields[name] = for_all[0] if for_all else once(f"--{name}", values)
    if getattr(arguments, "inputs", None) is not None:
        inputs = _inputs(robot, arguments.inputs)
        with located(arguments.inputs):  # a name or an inertia that this robot does not accept
            robot = robot.replace(inputs=inputs)
    if getattr(arguments, "output", []):
        from fflin.robot.outputs import parse_output

        fields["outputs"] = [output for text in arguments.output for output in parse_output(text)]
    return robot.merged(fields)


def _inputs(robot: Robot, name: str) -> tuple[Input, ...]:
    from fflin.robot.inputs import BaseForce, BaseTorque, JointTorque

    if name == "joints":
        if not robot.n:
            raise InputError(f"--inputs joints: '{robot.name}' has no joints")
        return (JointTorque("*"),)
    if name == "base":
        return BaseTorque(), BaseForce()
    from fflin.robot.robot_files import load_inputs

    return load_inputs(name)


def limits_of_options(arguments: argparse.Namespace) -> Any:
    """Return the limits that --limits and --limit define."""
    given = once("--limit", arguments.limit)
    return ["urdf", given] if arguments.limits == "urdf" else given or None


def refuse(arguments: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Raise an error if options are given that have no effect in combination with others."""
    if given := [f"--{name.replace('_', '-')}" for name in names if getattr(arguments, name, None)]:
        raise InputError(f"{', '.join(given)}: {why}; remove {', '.join(given)}")


def once(option: str, pairs: list[tuple[str, object]]) -> dict[str, Any]:
    """Return {name: value} of a repeatable option; raise an error if a name is given twice."""
    values = dict(pairs)
    if len(values) < len(pairs):
        names = [name for name, _ in pairs]
        double = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{option} is given more than once for '{double}'; give it once")
    return values


def configuration_of(
    robot: Robot, arguments: argparse.Namespace, state: Mapping[str, Any], prefix: str = ""
) -> Array:
    """Return q (nq,) of a robot's state, overridden by --joint, --rpy and --position.

    The option names may have a prefix, such as ``target_``.
    """
    from fflin.dynamics.points import base_of

    given = {name: getattr(arguments, f"{prefix}{name}") for name in ("rpy", "position")}
    base = base_of({**state, **{name: x for name, x in given.items() if x is not None}})
    pairs = getattr(arguments, f"{prefix}joint")
    option = f"--{prefix}joint".replace("_", "-")
    return placed(robot, option, pairs, base, state.get("joints"))


def placed(
    robot: Robot,
    option: str,
    pairs: list[tuple[str, object]],
    base: pin.SE3 | None = None,
    of_state: Mapping[str, float] | None = None,
) -> Array:
    """Return q (nq,) of a state's joints, overridden by an option; warn about exceeded limits."""
    from fflin.base.names import joints_by_name
    from fflin.dynamics.points import configuration

    joints = dict(of_state or {}) | joints_by_name(
        "joint", once(option, pairs), robot.joint_names, lambda name: robot.joint(name).name
    )
    q = configuration(robot, joints, base)
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
    return q


def linear_model(
    arguments: argparse.Namespace, robot: Robot | None = None
) -> tuple[Robot, LinearModel]:
    """Return the robot and its linear model about the operating point of the arguments."""
    from fflin.linear.linearization import linearize

    robot, q, v, reference = point_of(arguments, robot)
    q, u, reference = held_at(robot, q, v, arguments, reference)
    return robot, linearize(robot, q, v, u, frame=arguments.frame, reference=reference)


def point_of(
    arguments: argparse.Namespace, robot: Robot | None = None
) -> tuple[Robot, Array, Array | None, pin.SE3 | None]:
    """Return the robot, and q (nq,), v (nv,) and the reference of the operating point."""
    import pinocchio as pin

    robot = robot or load_robot(arguments)
    q = configuration_of(robot, arguments, robot.point)
    v = velocity_of(robot, arguments, robot.point, "velocity")
    refuse_pose(arguments)
    return robot, q, v, pin.SE3.Identity() if arguments.reference == "world" else None


def refuse_pose(arguments: argparse.Namespace, prefix: str = "") -> None:
    """Raise an error if --relative-equilibrium is combined with --rpy or --position."""
    if arguments.relative_equilibrium:
        names = (f"{prefix}rpy", f"{prefix}position")
        refuse(arguments, names, "--relative-equilibrium already sets the base pose")


def velocity_of(
    robot: Robot, arguments: argparse.Namespace, state: Mapping[str, Any], *options: str
) -> Array | None:
    """Return the velocity (nv,) of a robot's state; each option overrides the values before it."""
    from fflin.base.names import rates_by_name
    from fflin.dynamics.points import velocity

    values: dict[str, float] = dict(state.get("velocity", {}))
    for option in options:
        given = once(f"--{option.replace('_', '-')}", getattr(arguments, option))
        velocity(robot, given)  # raises an error if it is invalid
        values |= rates_by_name(robot.joint_names, given)
    return velocity(robot, values) if values else None


def held_at(
    robot: Robot,
    q: Array,
    v: Array | None,
    arguments: argparse.Namespace,
    reference: pin.SE3 | None = None,
) -> tuple[Array, Array | None, pin.SE3 | None]:
    """Return q, u (nu,) and the reference, with the inputs of --effort or of an equilibrium."""
    number = arguments.relative_equilibrium
    if not arguments.equilibrium and not number:
        from fflin.dynamics.points import effort

        given = once("--effort", arguments.effort)
        return q, effort(robot, given) if given else None, reference
    which = "--relative-equilibrium" if number else "--equilibrium"
    refuse(arguments, ("effort",), f"{which} already sets the inputs at the operating point")
    from fflin.linear.equilibrium import equilibrium

    if number:
        q, reference = attitude(robot, q, number, arguments.frame)
    held = equilibrium(robot, q, v=v, frame=arguments.frame, reference=reference)
    return held.q, held.u, reference


def attitude(robot: Robot, q: Array, number: int, frame: Frame) -> tuple[Array, pin.SE3]:
    """Return q (nq,) and the base placement of the relative equilibrium `number`, from 1 to 24."""
    import pinocchio as pin

    from fflin.analysis.relative_equilibria import relative_equilibria

    q = relative_equilibria(robot, q, frame=frame)[number - 1].q
    return q, pin.XYZQUATToSE3(q[:7])
