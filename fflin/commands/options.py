"""Options that several commands share."""

from __future__ import annotations

import argparse
import warnings
from typing import Any

from fflin.base.errors import FflinWarning
from fflin.commands.parser import (
    FIGURE,
    OUTPUT,
    POINT,
    ROBOT,
    Command,
    Group,
    OutputFile,
    assignment,
    input_name,
    joint_or_all,
    lock,
    number,
    orbit,
)


class _FormerName(argparse.Action):
    """Option under its former name, which warns of the new one."""

    def __call__(self, _: Any, given: argparse.Namespace, value: Any, option: Any = None) -> None:
        new = f"--{self.dest.replace('_', '-')}"
        warnings.warn(f"{option} is now {new}; write {new} {value}", FflinWarning, stacklevel=2)
        setattr(given, self.dest, value)


def add_former_name(group: Group, name: str, new: str) -> None:
    """Add the former name of an option for a time in seconds."""
    text = f"former name of --{new}"
    group.add_argument(name, dest=new, type=number, metavar="H", action=_FormerName, help=text)


def add_robot(command: Command) -> None:
    """Add ROBOT and --lock."""
    what = "name of a robot in `fflin robots`, or path of a URDF or of a robot.toml"
    command.add_argument("robot", metavar="ROBOT", type=input_name, help=what)
    command.group(ROBOT).add(
        "--lock",
        "lock a joint at VALUE [rad|m], or at its neutral position; NAME may be a pattern such as "
        "'hinge_*', here and in all other options",
        lock,
        repeatable=True,
    )


def add_point(command: Command) -> None:
    """Add the robot and the options of its operating point."""
    point = command.group(POINT)
    add_robot(command)
    add_pose(point)
    add_inputs_there(point)
    add_system(command)
    add_frame(point)
    add_reference(point)


def add_pose(group: Group) -> None:
    """Add the options for the configuration and velocity of the robot."""
    group.add(
        "--joint",
        "position of a joint [rad|m]; other joints are as in robot.toml, or at their neutral "
        "position",
        assignment,
        repeatable=True,
    )
    rpy = "base attitude: roll, pitch, yaw [deg] about fixed axes"
    group.add("--rpy", rpy, float, ("R", "P", "Y"))
    group.add("--position", "base position [m]", float, ("X", "Y", "Z"))
    group.add(
        "--velocity",
        "velocity of a joint or wheel [rad/s|m/s], or omega_b.x ... v_b.z of the base in base axes",
        assignment,
        repeatable=True,
    )


def add_target(group: Group) -> None:
    """Add the options for the configuration and velocity of the target."""
    group.add(
        "--target-joint",
        "target position of a joint [rad|m]; by default [target] of robot.toml, then its [point], "
        "then the neutral position",
        assignment,
        repeatable=True,
    )
    rpy = "target attitude of the base: roll, pitch, yaw [deg] about fixed axes"
    group.add("--target-rpy", rpy, float, ("R", "P", "Y"))
    group.add("--target-position", "target position of the base [m]", float, ("X", "Y", "Z"))
    group.add(
        "--target-velocity",
        "target velocity, such as the speed of a wheel. In a simulation it is also the initial "
        "velocity unless --velocity is given",
        assignment,
        repeatable=True,
    )


def add_limits(group: Group) -> None:
    """Add --limits and --limit."""
    group.add(
        "--limits",
        "limits of the inputs: urdf (default) uses the limits of the robot and of --limit, none "
        "uses --limit alone. The limits of the robot are the efforts of the URDF, max and min of "
        "the inputs, and the speeds of the wheels",
        choices=("urdf", "none"),
        default="urdf",
    )
    group.add(
        "--limit",
        "largest magnitude of an input, or of all inputs of a group such as tau_m or a pattern. "
        "This value takes precedence over --limits",
        assignment,
        repeatable=True,
    )


def add_step(group: Group) -> None:
    """Add --dt, and --step as it was called."""
    group.add("--dt", "integration step [s]; chosen automatically by default", float, "H")
    group.add("--step", "former name of --dt", float, "H")


def settle_step(arguments: argparse.Namespace) -> None:
    """Set --dt and --sample from their former names, --step and --dt, with a warning."""
    said = ""
    if arguments.step is not None:
        said = "--step is now --dt, the integration step"
        if arguments.dt is not None:
            said += ", and --dt is now --sample, the sample time of the controller"
            arguments.sample = arguments.dt
        arguments.dt = arguments.step
    elif arguments.dt is not None and arguments.sample is None:
        said = "--dt is the integration step; the sample time of the controller is --sample"
    if said:
        warnings.warn(said, FflinWarning, stacklevel=2)


def add_inputs_there(group: Group) -> None:
    """Add the options for the inputs at the operating point."""
    group.add(
        "--effort",
        "input at the operating point, by its name in u, such as tau_m.joint_1",
        assignment,
        repeatable=True,
    )
    group.switch(
        "--equilibrium",
        "apply the minimum-norm inputs that balance springs, gravity and the inertial forces of a "
        "steady motion at the operating point. Passive joints sag on their springs. If no inputs "
        "hold the point, the command reports an error",
    )
    group.add(
        "--relative-equilibrium",
        "in orbit, use the N-th (default: first) of the 24 attitudes without gravity-gradient "
        "torque, and the inputs that --equilibrium computes. Attitude and position in the state "
        "are relative to this pose",
        int,
        "N",
        nargs="?",
        const=1,
        choices=range(1, 25),
    )


def add_reference(group: Group) -> None:
    """Add the option for the reference of attitude and position."""
    group.add(
        "--reference",
        "reference of attitude and position in the state: the base pose of the operating point "
        "(default), or the world",
        choices=("base", "world"),
        default="base",
    )


def add_frame(group: Group) -> None:
    """Add the option for the axes of velocities and wrenches."""
    group.add(
        "--frame",
        "axes of velocities and wrenches. hybrid (default): angular parts in base axes, linear "
        "parts in reference axes; local: all in base axes; world: all in reference axes. For a "
        "robot in orbit, the axes are as in hybrid, and the orbital frame is the world. lvlh "
        "(default): x along the orbit, y opposite to the orbit normal, z towards the central body; "
        "hill: x away from the central body, y along the orbit, z along the orbit normal",
        choices=("hybrid", "local", "world", "lvlh", "hill"),
    )


def add_orbit(group: Group) -> None:
    """Add --orbit."""
    group.add(
        "--orbit",
        "circular orbit at an altitude [m] above the earth (default), moon, mars ...; the world is "
        "then the frame of the orbit",
        orbit,
    )


def add_system(command: Command) -> None:
    """Add the options for forces, inputs and outputs, which robot.toml may set too."""
    group = command.group(ROBOT)
    add_orbit(group)
    group.add(
        "--stiffness",
        "stiffness of a joint [N m/rad|N/m], or one value for all joints",
        joint_or_all,
        repeatable=True,
    )
    group.add(
        "--damping",
        "damping of a joint [N m s/rad|N s/m], or one value for all joints; `urdf` uses the "
        "damping in the URDF",
        joint_or_all,
        repeatable=True,
    )
    gravity = "uniform gravity in world axes [m/s^2]; zero by default"
    group.add("--gravity", gravity, float, ("X", "Y", "Z"))
    group.add(
        "--passive",
        "treat this joint as having no motor: the default inputs omit its torque",
        metavar="NAME",
        repeatable=True,
    )
    group.add(
        "--inputs",
        "inputs of the robot: a file for fflin.load_inputs, a bundled name, `joints` (joint "
        "torques only) or `base` (base torque and force only). The default is the inputs of "
        "robot.toml, or base torque, base force and all joint torques",
        input_name,
    )
    group.add(
        "--output",
        "outputs of the model: state (default), base, joints, rates, joints:NAME, rates:NAME (a "
        "joint or a pattern), com, momentum, frame:NAME (pose and velocity), pose:NAME, "
        "velocity:NAME, gyroscope:NAME, accelerometer:NAME, relative:NAME:TO (NAME relative to "
        "frame TO)",
        metavar="SPEC",
        repeatable=True,
    )


def add_output_file(
    group: Group, what: str, endings: OutputFile, *kinds: str, force: str = ""
) -> None:
    """Add -o FILE.

    With the `kinds` of results that are written there, add --force too; see `require_own_kind`.
    """
    what = f"save {what} to FILE: {endings}"
    group.add_argument("-o", "--output-file", metavar="FILE", type=endings, help=what)
    if kinds:
        force = "allow -o to replace a file that does not contain the same kind of result"
        group.set_defaults(kinds=kinds)
    group.switch("--force", force)


def add_figure(command: Command, what: str) -> None:
    """Add --plot FILE."""
    command.group(OUTPUT).add("--plot", f"plot {what} to FILE: {FIGURE}", FIGURE)
