"""The command `view`, and the options of commands that display a motion."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fflin.commands import DONE
from fflin.commands.arguments import (
    Commands,
    Container,
    add_options,
    add_orbit,
    add_pose,
    add_robot,
    command,
)
from fflin.commands.points import configuration_of, load_robot

if TYPE_CHECKING:
    from fflin.campaign.campaign import Campaign
    from fflin.robot.robot import Robot
    from fflin.simulation.motion import Motion

_FILES, _SHOWN = ("html", "png", "gif"), ("scene", "follow", "tool")


def add_commands(commands: Commands) -> None:
    """Add view."""
    view = command(
        *(commands, "view", _view),
        "show a robot live in the browser with a slider for each joint",
        "fflin view servicer_7dof --joint joint_2=0.4",
    )
    add_robot(view)
    add_pose(view)
    add_orbit(view)
    add_options(view, "--frame lvlh|hill: orbital frame used as the world; lvlh by default")
    _add_scene(view)
    add_options(view, "--no-open: do not open a browser; the address appears on stderr")
    add_options(view, "--port N = 0: port on 127.0.0.1; a free port by default", type=int)


def add_pictures(command: Container, page: str = "that plays the motion without a network") -> None:
    """Add the options of pages, pictures and animations of a motion."""
    add_options(
        command,
        f"""
        --html >FILE: write a page {page}
        --png >FILE: write a picture (needs Chromium): a strip of four images, or of images
            at the times of --times
        --gif >FILE: write an animation (needs Chromium)""",
    )
    add_options(command, "--times T: times of the pictures [s]", nargs="+")
    _add_scene(command)
    add_options(
        command,
        """
        --fps FPS = 30: frames per second of playback; 30 by default
        --speed SPEED: playback speed, in seconds of motion per second; 1 by default""",
    )


def _add_scene(command: Container) -> None:
    add_options(
        command,
        """
        --scene space|lab: show sky and planet (space), or a floor with a grid (lab, the default
            under gravity)
        --tool FRAME: draw the axes and the trail of this frame
        --[no-]follow: whether the camera follows the base; by default it does in long motions""",
    )


def add_figure(command: Container, what: str) -> None:
    """Add --plot FILE."""
    add_options(command, f"--plot >FILE: {what} to FILE: .png, .pdf or .svg")


def check_figure(path: Path | None) -> None:
    """Refuse a figure that cannot be drawn or written, before any computation."""
    if path is None:
        return
    from fflin.base.figures import FORMATS, require_matplotlib
    from fflin.base.writing import check_place

    check_place(path, FORMATS)
    require_matplotlib()


def draw(path: Path | None, figure: str, drawn: object) -> None:
    """Draw with the public function of this name and report the file, if a path is given."""
    if path is not None:
        import fflin

        getattr(fflin, figure)(drawn, path)
        print(f"wrote {path}")


def check_pictures(robot: Robot, arguments: argparse.Namespace) -> None:
    """Refuse the options that `show_motion` refuses, before the simulation."""
    from fflin.view.visualize import check_outputs, check_rates, check_times, check_tool

    if not check_outputs({f".{name}": getattr(arguments, name) for name in _FILES}):
        return
    check_tool(robot, arguments.tool)
    from fflin.simulation.times import LONGEST

    duration = arguments.duration or LONGEST
    check_rates(arguments.fps, arguments.speed, duration)
    if arguments.times:
        check_times(arguments.times, 0.0, duration)


def show_motion(
    robot: Robot, motion: Motion, arguments: argparse.Namespace, cloud: Campaign | None = None
) -> list[str]:
    """Write the files of the options of `add_pictures`; return a line for each."""
    files = {name: path for name in _FILES if (path := getattr(arguments, name))}
    if not files:
        return []
    from fflin.view.visualize import visualize

    how = {name: getattr(arguments, name) for name in ("times", "fps", "speed", *_SHOWN)}
    visualize(robot, motion, **files, **how, cloud=cloud)
    return [f"wrote {path}: {path.stat().st_size / 1e6:.2f} MB" for path in files.values()]


def _view(arguments: argparse.Namespace) -> int:
    from fflin.view.live import Live
    from fflin.view.visualize import visualize

    robot = load_robot(arguments)
    how: Any = {name: getattr(arguments, name) for name in (*_SHOWN, "port", "frame")}
    live = visualize(robot, open=False, q=configuration_of(robot, arguments, robot.start), **how)
    assert isinstance(live, Live)  # since there is no motion
    print(f"fflin: {robot.name} at {live.url} (Ctrl-C ends)", file=sys.stderr, flush=True)
    if not arguments.no_open:
        live.open()
    live.wait()
    return DONE
