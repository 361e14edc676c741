"""The command that shows a robot, and the options of those that show a motion."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from fflin.commands import DONE
from fflin.commands.arguments import (
    Commands,
    Container,
    add_pose,
    add_robot,
    command,
    file_name,
    number,
)
from fflin.commands.points import configuration_of, load_robot

if TYPE_CHECKING:
    from fflin.robot.robot import Robot
    from fflin.simulation.motion import Motion

_FILES = ("html", "png", "gif")


def add_commands(commands: Commands) -> None:
    """Add view."""
    view = command(
        commands,
        "view",
        _view,
        "show a robot live in the browser, with a slider for each joint",
        "fflin view servicer_7dof --joint joint_2=0.4",
    )
    add_robot(view)
    add_pose(view)
    _add_scene(view)
    view.add_argument(
        "--no-open", action="store_true", help="open no browser; the address is on stderr"
    )
    view.add_argument(
        "--port", type=int, default=0, metavar="N", help="port on 127.0.0.1; a free one by default"
    )


def add_pictures(command: Container) -> None:
    """Add the options of a command that makes a motion: files to show it in, and how."""
    command.add_argument(
        "--html",
        metavar="FILE",
        type=file_name,
        help="write a page that plays it without a network",
    )
    command.add_argument(
        "--png",
        metavar="FILE",
        type=file_name,
        help="write a picture (takes Chromium): a strip of four, or at the --times that are given",
    )
    command.add_argument(
        "--gif", metavar="FILE", type=file_name, help="write an animated picture (takes Chromium)"
    )
    command.add_argument(
        "--times", metavar="T", type=number, nargs="+", help="when [s] pictures are taken"
    )
    _add_scene(command)
    command.add_argument(
        "--fps", type=number, default=30.0, help="frames per second of watching (default 30)"
    )
    command.add_argument(
        "--speed", type=number, help="seconds of motion per second of watching (default 1)"
    )


def _add_scene(command: Container) -> None:
    command.add_argument(
        "--scene",
        choices=("space", "lab"),
        help="sky and planet, or a floor with a grid (default where there is gravity)",
    )
    command.add_argument("--tool", metavar="FRAME", help="frame whose axes and trail are drawn")
    command.add_argument(
        "--follow",
        action=argparse.BooleanOptionalAction,
        help="whether the camera follows the base (default: on a long way)",
    )


def add_figure(command: argparse.ArgumentParser, what: str) -> None:
    """Add --plot FILE."""
    command.add_argument(
        "--plot", metavar="FILE", type=file_name, help=f"{what} into FILE: .png, .pdf or .svg"
    )


def check_figure(path: Path | None) -> None:
    """Refuse a figure that cannot be drawn or written, before anything is done for it."""
    if path is None:
        return
    from fflin.base.figures import FORMATS, require_matplotlib
    from fflin.base.writing import check_place

    check_place(path, FORMATS)
    require_matplotlib()


def draw(path: Path | None, figure: str, drawn: object) -> None:
    """Draw what a public function of this name draws, where a path is given, and say so."""
    if path is not None:
        import fflin

        getattr(fflin, figure)(drawn, path)
        print(f"wrote {path}")


def check_pictures(robot: Robot, arguments: argparse.Namespace) -> None:
    """Refuse what `show_motion` would, before a motion is made for it."""
    from fflin.view.visualize import check_outputs, check_rates, check_times, check_tool

    if not check_outputs({f".{name}": getattr(arguments, name) for name in _FILES}):
        return
    check_tool(robot, arguments.tool)
    from fflin.simulation.times import LONGEST

    duration = arguments.duration or LONGEST
    check_rates(arguments.fps, arguments.speed, duration)
    if arguments.times:
        check_times(arguments.times, 0.0, duration)


def show_motion(robot: Robot, motion: Motion, arguments: argparse.Namespace) -> list[str]:
    """Write what the options of `add_pictures` ask for, and return a line for each file."""
    files = {name: path for name in _FILES if (path := getattr(arguments, name))}
    if not files:
        return []
    from fflin.view.visualize import visualize

    visualize(
        robot,
        motion,
        **files,
        times=arguments.times,
        scene=arguments.scene,
        fps=arguments.fps,
        speed=arguments.speed,
        follow=arguments.follow,
        tool=arguments.tool,
    )
    return [f"wrote {path}: {path.stat().st_size / 1e6:.2f} MB" for path in files.values()]


def _view(arguments: argparse.Namespace) -> int:
    from fflin.view.live import Live
    from fflin.view.visualize import visualize

    robot = load_robot(arguments)
    live = visualize(
        robot,
        open=False,
        scene=arguments.scene,
        follow=arguments.follow,
        tool=arguments.tool,
        q=configuration_of(robot, arguments, robot.start),
        port=arguments.port,
    )
    assert isinstance(live, Live)  # for there is no motion
    print(f"fflin: {robot.name} at {live.url} (Ctrl-C ends)", file=sys.stderr, flush=True)
    if not arguments.no_open:
        live.open()
    live.wait()
    return DONE
