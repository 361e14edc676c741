"""The options of commands that simulate a loop, which `fflin.commands.loops` reads."""

from __future__ import annotations

import argparse

from fflin.commands.arguments import (
    Container,
    add_inputs_there,
    add_pose,
    add_robot,
    add_system,
    add_values,
    file_name,
    number,
)
from fflin.commands.regulator import add_weights
from fflin.commands.tracking import add_trajectory

_GROUPS = "where it starts", "where it is to be", "what regulates it", "the run", "the robot"


def add_loop(command: argparse.ArgumentParser) -> Container:
    """Add all that says the loop; return the group of the run's options."""
    add_robot(command)
    start, goal, law, run, system = map(command.add_argument_group, _GROUPS)
    add_system(system)
    add_pose(start)
    add_values(
        start,
        "--offset",
        "how far from the trajectory's start it starts, in the base's axes there: a state, group "
        "or pattern such as r_b.x, q_m, omega_b.z, or roll, pitch, yaw [deg]",
    )
    add_values(
        goal,
        "--target-joint",
        "where a joint is to go [rad|m]; the others go to neutral, the base to the world's origin",
    )
    add_values(
        goal,
        "--target-velocity",
        "a velocity of the target, such as the speed of a wheel that is to be held; it starts with "
        "it where --velocity does not say otherwise",
    )
    add_inputs_there(goal)
    add_trajectory(goal)
    add_weights(law)
    law.add_argument(
        "--schedule",
        metavar="FILE",
        type=file_name,
        help="follow the trajectory with these gains, as tvlqr saves them; without it they are "
        "designed",
    )
    law.add_argument(
        "--gain",
        metavar="FILE",
        type=file_name,
        help="regulate with this gain, as lqr saves it, about the point it was designed for",
    )
    law.add_argument(
        "--allocate",
        action=argparse.BooleanOptionalAction,
        help="whether to design with torque and force on the base, and let the thrusters, none of "
        "which pulls, give what comes nearest; by default where they push every way; else a "
        "thrust below zero is cut",
    )
    law.add_argument(
        "--free", action="store_true", help="let it move without a regulator or any input"
    )
    law.add_argument(
        "--limits",
        choices=("urdf", "none"),
        default="urdf",
        help="what cuts the inputs: efforts of the URDF, max and min of the inputs and speeds of "
        "wheels (urdf, default), or only what --limit says (none)",
    )
    add_values(
        law,
        "--limit",
        "largest magnitude of an input, a group of them such as tau_m, or a pattern; goes first",
    )
    law.add_argument(
        "--delay",
        metavar="T",
        type=number,
        default=0.0,
        help="time from a sample to its effect [s]",
    )
    run.add_argument(
        "--duration",
        metavar="T",
        type=number,
        help="time [s]; by default that of the trajectory, or from 60 to 600, what the linear loop "
        "takes to settle",
    )
    run.add_argument(
        "--step", metavar="H", type=number, help="step of the integration [s]; chosen by default"
    )
    run.add_argument("--method", default="cf4", help="cf4 (default), rkmk4 or semi_implicit_euler")
    return run
