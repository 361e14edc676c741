"""Command `view`, and the options of commands that display a motion."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fflin.commands import options, parser
from fflin.commands.points import configuration_of, load_robot
from fflin.commands.results import Report

if TYPE_CHECKING:
    from fflin.robot.robot import Robot
    from fflin.simulation.motion import Motion

_FILES, _SHOWN = ("html", "png", "gif"), ("scene", "follow", "tool")


def add_commands(commands: parser.Commands) -> None:
    """Add view."""
    view = parser.command(commands, _view)
    options.add_robot(view)
    options.add_pose(view.group(parser.POINT))
    options.add_orbit(view.group(parser.ROBOT))
    page = view.group(parser.OUTPUT)
    frames = "orbital frame used as the world; lvlh by default"
    page.add("--frame", frames, choices=("lvlh", "hill"))
    _add_scene(page)
    page.switch("--no-open", "do not open a browser; the address of the page is printed on stderr")
    port = "port on 127.0.0.1; a free port by default"
    page.add("--port", port, parser.whole, "N")


def add_pictures(command: parser.Command, page: str = "that plays the motion offline") -> None:
    """Add the options for pages, pictures and animations of a motion."""
    group = command.group(parser.OUTPUT)
    group.add("--html", f"write a page {page}", parser.PAGE)
    group.add(
        "--png",
        "write a picture that shows the motion as a strip of images at the times of --times "
        "(four images by default); requires Chromium",
        parser.PICTURE,
    )
    group.add("--gif", "write an animation; requires Chromium", parser.ANIMATION)
    group.add("--times", "times of the images in --png [s]", float, "T", nargs="+")
    _add_scene(group)
    group.add("--fps", "frames per second of playback", float, "FPS", default=30.0)
    speed = "playback speed, in seconds of motion per second; 1 by default"
    group.add("--speed", speed, float, "SPEED")


def _add_scene(group: parser.Group) -> None:
    group.add(
        "--scene",
        "background: sky and planet (space), or a floor with a grid (lab). The default is lab "
        "under uniform gravity, otherwise space",
        choices=("space", "lab"),
    )
    group.add("--tool", "draw the axes and the path of this frame", metavar="FRAME")
    group.yes_or_no(
        "--follow",
        "whether the camera follows the base. By default, the camera follows the base if the "
        "robot moves far compared with its size",
    )


def check_pictures(robot: Robot, arguments: argparse.Namespace) -> None:
    """Raise an error before the simulation if `pictures` would refuse the options."""
    from fflin.view.visualize import check_outputs, check_rates, check_times, check_tool

    if not check_outputs({f".{name}": getattr(arguments, name) for name in _FILES}):
        return
    check_tool(robot, arguments.tool)
    from fflin.simulation.plan import LONGEST

    duration = arguments.duration or LONGEST
    check_rates(arguments.fps, arguments.speed, duration)
    if arguments.times:
        check_times(arguments.times, 0.0, duration)


def pictures(
    robot: Robot,
    motion: Callable[[], Motion],
    arguments: argparse.Namespace,
) -> dict[Path | None, Callable[[Path], object]]:
    """Return {path: function that writes the file} for the options of `add_pictures`."""
    how = {name: getattr(arguments, name) for name in ("times", "fps", "speed", *_SHOWN)}

    def show(path: Path) -> None:
        from fflin.view.visualize import visualize

        kind: Any = {path.suffix.removeprefix("."): path}
        visualize(robot, motion(), **kind, **how)

    return {getattr(arguments, name): show for name in _FILES}


def _view(arguments: argparse.Namespace) -> Report:
    """Show a robot live in the browser with a slider for each joint.

    example: fflin view servicer_7dof --joint joint_2=0.4
    """
    from fflin.dynamics.points import combined
    from fflin.view.live import Live
    from fflin.view.visualize import visualize

    robot = load_robot(arguments)
    q = configuration_of(robot, arguments, combined(robot.point, robot.start))
    how: Any = {name: getattr(arguments, name) for name in (*_SHOWN, "frame")}
    how["port"] = arguments.port or 0
    live = visualize(robot, open=False, q=q, **how)
    assert isinstance(live, Live)  # since there is no motion
    print(f"fflin: {robot.name} at {live.url} (Ctrl-C ends)", file=sys.stderr, flush=True)
    if not arguments.no_open:
        live.open()
    live.wait()
    return Report(robot.name, {}, f"{robot.name}: the view is closed")
