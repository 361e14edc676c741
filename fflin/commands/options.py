"""Options that are shared by several commands."""

from __future__ import annotations

import argparse
import warnings

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
    """Option under its former name; it sets the option of the new name and warns."""

    def __call__(
        self, _: object, given: argparse.Namespace, value: object, option: object = None
    ) -> None:
        new = f"--{self.dest.replace('_', '-')}"
        warnings.warn(
            f"{option} has the new name {new}; write {new} {value}", FflinWarning, stacklevel=2
        )
        setattr(given, self.dest, value)


def add_former_name(group: Group, name: str, new: str) -> None:
    """Add the former name of a time option."""
    text = f"former name of --{new}"
    group.add_argument(name, dest=new, type=number, metavar="H", action=_FormerName, help=text)


def add_robot(command: Command) -> None:
    """Add ROBOT and --lock."""
    what = "robot name listed by `fflin robots`, or path of a URDF or robot.toml"
    command.add_argument("robot", metavar="ROBOT", type=input_name, help=what)
    command.group(ROBOT).add(
        "--lock",
        "lock a joint at VALUE [rad|m]. Without VALUE, the joint is locked at its neutral "
        "position. In every option, NAME can also be a pattern such as 'hinge_*'",
        lock,
        repeatable=True,
    )


def add_point(command: Command) -> None:
    """Add the robot and the options of the operating point."""
    point = command.group(POINT)
    add_robot(command)
    add_pose(point)
    add_inputs_there(point)
    add_system(command)
    add_frame(point)
    add_reference(point)


def add_joint(group: Group) -> None:
    """Add --joint."""
    group.add(
        "--joint",
        "position of a joint [rad|m]. The default is the position in robot.toml or, if there is "
        "none, the neutral position",
        assignment,
        repeatable=True,
    )


def add_pose(group: Group) -> None:
    """Add the options for the configuration and velocity of the robot."""
    add_joint(group)
    _add_base(group, "--", "base")
    group.add(
        "--velocity",
        "velocity of a joint or wheel [rad/s|m/s], or a component of the base velocity in base "
        "axes (omega_b.x ... v_b.z)",
        assignment,
        repeatable=True,
    )


def add_target(group: Group) -> None:
    """Add the options for the configuration and velocity of the target."""
    group.add(
        "--target-joint",
        "target position of a joint [rad|m]. The default is the first of these that exists: the "
        "value in [target] of robot.toml, the value in [point], the neutral position",
        assignment,
        repeatable=True,
    )
    _add_base(group, "--target-", "target base")
    group.add(
        "--target-velocity",
        "target velocity, such as the speed of a wheel. In a simulation, the target velocity is "
        "also the initial velocity unless --velocity is given",
        assignment,
        repeatable=True,
    )


def _add_base(group: Group, prefix: str, base: str) -> None:
    rpy = f"{base} attitude: roll, pitch, yaw [deg] about fixed axes"
    group.add(f"{prefix}rpy", rpy, float, ("R", "P", "Y"))
    group.add(f"{prefix}position", f"{base} position [m]", float, ("X", "Y", "Z"))


def add_limits(group: Group) -> None:
    """Add --limits and --limit."""
    group.add(
        "--limits",
        "limits of the inputs. `urdf` (default) uses the limits of the robot and the limits of "
        "--limit; `none` uses only the limits of --limit. The limits of the robot are the joint "
        "efforts in the URDF, the min and max of its inputs, and the largest speeds of its wheels",
        choices=("urdf", "none"),
        default="urdf",
    )
    group.add(
        "--limit",
        "largest magnitude of an input, or of each input in a group or pattern such as tau_m. "
        "This limit replaces the limit of the robot",
        assignment,
        repeatable=True,
    )


def add_saturation(group: Group) -> None:
    """Add --limits with the default `none`."""
    group.add(
        "--limits",
        "saturate the inputs at the limits of the robot as `fflin simulate` does (urdf), or do "
        "not saturate them (none, default)",
        choices=("urdf", "none"),
        default="none",
    )


def add_step(group: Group) -> None:
    """Add --dt, and its former name --step."""
    group.add("--dt", "integration step [s]; chosen automatically by default", float, "H")
    group.add("--step", "former name of --dt", float, "H")


def settle_step(arguments: argparse.Namespace) -> None:
    """Set --dt and --sample from their former names, --step and --dt, with a warning."""
    if arguments.step is None:
        return
    said = "the integration step --step has the new name --dt"
    if arguments.dt is not None:
        said += ", and the sample time --dt has the new name --sample"
        arguments.sample = arguments.dt
    arguments.dt = arguments.step
    warnings.warn(said, FflinWarning, stacklevel=2)


def add_effort(group: Group, where: str) -> None:
    """Add --effort."""
    text = f"value of an input {where}. NAME is the name of the input in u, such as tau_m.joint_1"
    group.add("--effort", text, assignment, repeatable=True)


def add_inputs_there(group: Group) -> None:
    """Add the options for the inputs at the operating point."""
    add_effort(group, "at the operating point")
    group.switch(
        "--equilibrium",
        "apply the minimum-norm inputs that make the operating point an equilibrium (or a steady "
        "motion) under springs and gravity. The springs of passive joints deflect until they "
        "balance the load. If no inputs can hold the robot at the operating point, the command "
        "reports an error",
    )
    group.add(
        "--relative-equilibrium",
        "for a robot in orbit: use the N-th of the 24 attitudes without gravity-gradient torque "
        "(1 by default), and the inputs that --equilibrium computes. The state measures attitude "
        "and position from this equilibrium pose",
        int,
        "N",
        nargs="?",
        const=1,
        choices=range(1, 25),
    )


def add_reference(group: Group) -> None:
    """Add the option for the origin of attitude and position."""
    group.add(
        "--reference",
        "pose from which the attitude and position in the state are measured: the base pose at "
        "the operating point (base, default), or the world frame (world)",
        choices=("base", "world"),
        default="base",
    )


def add_frame(group: Group) -> None:
    """Add the option for the axes of velocities and wrenches."""
    group.add(
        "--frame",
        "axes of base velocities and wrenches. `hybrid` (default) uses base axes for angular "
        "parts and reference axes for linear parts. `local` uses base axes for all parts, and "
        "`world` uses reference axes for all parts. For a robot in orbit, the axes are as in "
        "`hybrid`, but the world is an orbital frame, `lvlh` (default) or `hill`. In `lvlh`, x "
        "points along the orbit, y opposite to the orbit normal and z towards the central body. "
        "In `hill`, x points away from the central body, y along the orbit and z along the orbit "
        "normal",
        choices=("hybrid", "local", "world", "lvlh", "hill"),
    )


def add_orbit(group: Group) -> None:
    """Add --orbit."""
    group.add(
        "--orbit",
        "circular orbit at an altitude [m] above a central body: earth (default), moon, mars ... "
        "The world is then the orbital frame",
        orbit,
    )


def add_system(command: Command) -> None:
    """Add the options for forces, inputs and outputs, which robot.toml can also set."""
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
        "damping of a joint [N m s/rad|N s/m], or one value for all joints. With `urdf` as "
        "VALUE, the damping in the URDF is used",
        joint_or_all,
        repeatable=True,
    )
    gravity = "uniform gravity in world axes [m/s^2]; zero by default"
    group.add("--gravity", gravity, float, ("X", "Y", "Z"))
    group.add(
        "--passive",
        "joint without a motor: the default inputs do not include a torque at this joint",
        metavar="NAME",
        repeatable=True,
    )
    group.add(
        "--inputs",
        "inputs of the robot: a TOML file of inputs, a bundled name such as cubesat, `joints` "
        "(joint torques only) or `base` (base torque and force only). The default is the inputs "
        "in robot.toml or, if there are none, base torque, base force and all joint torques",
        input_name,
    )
    group.add(
        "--output",
        "outputs of the model: state (default), base, joints, rates, joints:NAME, rates:NAME (a "
        "joint or a pattern), com, momentum, frame:NAME (pose and velocity), pose:NAME, "
        "velocity:NAME, gyroscope:NAME, accelerometer:NAME, relative:NAME:TO (frame NAME relative "
        "to frame TO)",
        metavar="SPEC",
        repeatable=True,
    )


def add_output_file(
    group: Group, what: str, endings: OutputFile, *kinds: str, required: bool = False
) -> None:
    """Add -o FILE, and --force if `kinds` of results are given (see `require_own_kind`)."""
    group.add_argument(
        "-o",
        "--output-file",
        metavar="FILE",
        type=endings,
        required=required,
        help=f"save {what} to FILE: {endings}",
    )
    if kinds:
        group.switch(
            "--force",
            "replace the file of -o, whatever it contains. Without --force, -o replaces only a "
            "file that contains a result of the same kind",
        )
        group.set_defaults(kinds=kinds)


def add_figure(command: Command, what: str) -> None:
    """Add --plot FILE."""
    command.group(OUTPUT).add("--plot", f"plot {what} to FILE: {FIGURE}", FIGURE)
