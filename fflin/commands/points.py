"""The robot and the point that a command's arguments speak of."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any

from fflin.errors import FflinError, InputError

if TYPE_CHECKING:
    from fflin.linear_model import LinearModel
    from fflin.model import Robot
    from fflin.validation import Array


def load_robot(arguments: argparse.Namespace) -> Robot:
    """Load the robot with the passive joints, inputs, outputs and gravity that are given."""
    from fflin.loading import load

    robot = load(arguments.robot, lock=once("--lock", arguments.lock))
    fields: dict[str, Any] = {}
    for name in ("stiffness", "damping"):
        values = getattr(arguments, name, [])
        for_all = [value for joint, value in values if joint is None]
        if for_all and len(values) > 1:
            raise InputError(f"--{name} is given for all joints and once more; give either")
        if values:
            fields[name] = for_all[0] if for_all else once(f"--{name}", values)
    if getattr(arguments, "gravity", None):
        fields["gravity"] = arguments.gravity
    if getattr(arguments, "inputs", None):
        from fflin.input_files import load_inputs

        inputs = load_inputs(arguments.inputs)
        try:
            robot = robot.replace(inputs=inputs)
        except FflinError as error:  # a name or an inertia that does not suit this robot
            raise type(error)(f"{arguments.inputs}: {error}") from None
    if getattr(arguments, "output", []):
        from fflin.output_specs import parse_output

        fields["outputs"] = [output for text in arguments.output for output in parse_output(text)]
    return robot.replace(**fields) if fields else robot


def once(option: str, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the pairs of a repeatable option; a name that is given twice is refused."""
    values = dict(pairs)
    if len(values) < len(pairs):
        raise InputError(f"{option} names a joint twice; give one value for each")
    return values


def configuration_of(robot: Robot, arguments: argparse.Namespace) -> Array:
    """Return the configuration (nq,) that --joint, --rpy and --position say."""
    import pinocchio as pin

    from fflin.model import configuration

    rotation = pin.rpy.rpyToMatrix(*(math.radians(angle) for angle in arguments.rpy))
    base = pin.SE3(rotation, pin.SE3.Identity().translation + arguments.position)
    return configuration(robot, once("--joint", arguments.joint), base)


def linear_model(arguments: argparse.Namespace) -> tuple[Robot, LinearModel]:
    """Return the robot, and its linear model about the point that is given."""
    import pinocchio as pin

    from fflin.linearization import linearize
    from fflin.points import effort, velocity

    robot = load_robot(arguments)
    q = configuration_of(robot, arguments)
    reference = pin.SE3.Identity() if arguments.reference == "world" else None
    v = velocity(robot, once("--velocity", arguments.velocity)) if arguments.velocity else None
    u = effort(robot, once("--effort", arguments.effort)) if arguments.effort else None
    if arguments.equilibrium:
        if arguments.effort:
            raise InputError(
                "--effort and --equilibrium both say the inputs at the point; give either"
            )
        from fflin.balance import equilibrium

        u = equilibrium(robot, q, v=v, frame=arguments.frame, reference=reference).u
    return robot, linearize(robot, q, v, u, frame=arguments.frame, reference=reference)
