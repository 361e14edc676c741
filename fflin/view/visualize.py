"""Function `visualize`, which shows robots, motions and modes as a file or as a live page."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from warnings import warn

import numpy as np
import pinocchio as pin

from fflin.base.errors import FflinWarning, FileError, InputError
from fflin.base.html import in_notebook
from fflin.base.validation import Array, instance, number, positive, truth, whole
from fflin.base.writing import (
    as_path,
    check_distinct,
    check_output_path,
    write_atomically,
)
from fflin.dynamics.points import start_of
from fflin.dynamics.state import Actuation, StateMap
from fflin.robot.joints import ROOT, find_frame
from fflin.robot.robot import Robot
from fflin.view.html_page import HtmlPage

if TYPE_CHECKING:
    from os import PathLike

    from fflin.analysis.modes import Modes
    from fflin.simulation.motion import Motion
    from fflin.view.live import Live
    from fflin.view.page import Page

SCENES = ("space", "lab")

# Longest duration of an animation [s]; longer motions are shown faster.
_LONGEST = 60.0


def visualize(
    robot: Robot,
    motion: Motion | Modes | None = None,
    *,
    html: str | PathLike[str] | None = None,
    png: str | PathLike[str] | None = None,
    gif: str | PathLike[str] | None = None,
    times: Sequence[float] | None = None,
    open: bool | None = None,
    scene: str | None = None,
    fps: float = 30.0,
    speed: float | None = None,
    follow: bool | None = None,
    target: Array | None = None,
    tool: str | None = None,
    q: Array | None = None,
    port: int = 0,
    frame: str | None = None,
) -> Live | HtmlPage | None:
    """Show a robot live, or write a motion of a robot to one HTML file for offline use.

    The page of a motion shows

    - the robot in its colours, with axes at base and tool;
    - the paths of the tool and of the centre of mass;
    - arrows for force and torque on the base, with their scale in the legend;
    - thrusters, with plumes whose lengths are proportional to u(t), and wheels at their frames;
    - constraints, as a bolt for a weld, a ring for a hinge and a ball for a spherical constraint,
      while they act, and arrows for their forces and torques, each with one scale;
    - a translucent robot at the target, and the contour of the robot at the linear prediction.
      Both are shown only if they are more than 3 pixels away from the robot;
    - a time slider, camera views, and a panel with charts of errors and inputs over time. Angles
      are in deg and lengths in mm. On-off thrusters are drawn as strips with their duty.

    Dashed curves show the linear prediction. A strip below the time slider is coloured by its
    deviation from the robot, relative to the largest displacement: small up to 1 %, visible up to
    10 %, and beyond the validity of the linear model above.

    A click on a chart enlarges it, and a click on a link shows the link's mass and pose. The
    address ``motion.html#t=12.5`` leads to a time [s].

    If the robot follows a trajectory, a translucent robot moves with the reference, dashed lines
    show the reference paths of base and tool, and pale curves show the reference joint positions. A
    dotted line marks the time at which the reference comes to rest.

    For scripts that change meshcat's scene: every body is the node ``meshcat/robot/JOINT``, at the
    pose of the joint's frame.

    Parameters
    ----------
    robot : Robot
        Robot to show.
    motion : Motion or Modes, optional
        Motion from `simulate` or `Campaign.replay`, or modes from `modes`. For modes, the page
        lists their names and frequencies, and animates one of them. If `motion` is omitted, a live
        page shows the robot with a slider for each joint, or a file shows the robot at rest.
    html : path, optional
        HTML file to write; a temporary file by default.
    png, gif : path, optional
        Files for a picture (.png) and an animation (.gif); both need Chromium.
    times : sequence of float, optional
        Times [s] of the images in the picture `png`; four times by default. With one time, the
        picture shows one image with its panel. With several times, the picture is a strip of
        images.
    open : bool, optional
        Whether to open a browser. By default, a browser is opened if no output file is given, but
        not in a notebook, which shows the page itself.
    scene : {"space", "lab"}, optional
        "space" shows stars and a planet. "lab" shows a floor with a grid, and is the default under
        gravity. In orbit, the planet is the central body, below the robot and in its true size. The
        planet and the stars rotate with the orbital motion, but the sunlight keeps its direction in
        the view.
    fps : float
        Frames per second of playback.
    speed : float, optional
        Seconds of motion per second of playback. The default is 1, or more for motions longer than
        a minute. A live simulation is slowed down to this speed.
    follow : bool, optional
        Whether the camera follows the base. By default, the camera follows only if the path is so
        long that the robot would otherwise appear as a dot.
    target : array_like (nq,), optional
        Configuration from which errors are measured; by default the motion's target. If there is no
        target, the page shows the change from the start, and no translucent robot.
    tool : str, optional
        Frame whose path is drawn; by default "tool", or the last link of the longest chain.
    q : array_like (nq,), optional
        Configuration of a robot without a motion, which is initial if the robot is live; by default
        the robot's `start`, or the neutral configuration.
    port : int
        Port of the live page; a free port by default.
    frame : {"lvlh", "hill"}, optional
        Orbital frame used as the world of a robot in orbit on a live page; "lvlh" by default.

    Returns
    -------
    Live, HtmlPage or None
        The live page, or the path of the HTML file; None if only pictures were requested. The path
        is a `pathlib.Path`. A notebook shows the page instead of the path, and stores one copy.

    Raises
    ------
    InputError
        If one of these conditions is true:

        - the motion or modes belong to another robot, or the modes to a reduced model;
        - no mode oscillates;
        - `png` or `gif` is given for modes, which have no pictures;
        - an argument is invalid, or the port is in use.
    FileError
        If a file cannot be written. Files are written atomically.
    UnknownNameError
        If the frame `tool` is unknown.
    MissingPackageError
        If a picture is requested, but Chromium is not installed.

    Warns
    -----
    FflinWarning
        If meshes are missing, or boxes replace missing visual geometry.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> motion = fflin.simulate(robot, v0=fflin.velocity(robot, {"joint_1": 0.1}), duration=2.0)
    >>> fflin.visualize(robot, motion, html="motion.html").name
    'motion.html'
    """
    instance("robot", robot, Robot, "a fflin.Robot, as fflin.load returns it")
    if scene is None:
        scene = "lab" if any(robot.gravity) else "space"
    if not isinstance(scene, str) or scene not in SCENES:
        raise InputError(f"scene is {scene!r}, expected one of {', '.join(SCENES)}")
    opened = None if open is None else truth("open", open)
    tool = tool_frame(robot, tool)
    from fflin.view.page import Page

    if motion is None and any(file is not None for file in (html, png, gif)):
        robot = robot.replace(orbit=None)
        motion = _at_rest(robot, q)
    if motion is None:
        port = whole("port", port, 0, 2**16 - 1)
        q = start_of(robot)[0] if q is None else _configuration(robot, "q", q)
        pace = positive("speed", 1.0 if speed is None else speed)
        live = _live(Page(robot, q, scene, tool, frame), q, follow, pace, port)
        if _opens(opened, default=True):
            live.open()
        return live
    from fflin.analysis.modes import Modes
    from fflin.view.pages import mode_page, motion_page

    # This error comes before the error that Chromium is not installed, because modes never need it.
    if isinstance(motion, Modes) and (png is not None or gif is not None):
        raise InputError(
            "png or gif is given, but modes can be shown only in an HTML page; give html="
        )
    outputs = check_outputs({".html": html, ".png": png, ".gif": gif})
    contents: dict[Path, bytes] = {}
    if isinstance(motion, Modes):
        page_html, notes = mode_page(robot, motion, scene, tool)
    else:
        robot = _robot_of(robot, motion)
        start, end = float(motion.t[0]), float(motion.t[-1])
        times = times if png is not None else None
        fps, speed, times = check_playback(fps, speed, times, start, end)
        goal = None if target is None else _configuration(robot, "target", target)
        page = Page(robot, motion.q[0], scene, tool, motion.frame)
        page_html = motion_page(page, motion, fps, speed, follow, goal)
        contents = _pictures(page_html, outputs, motion, speed, times)
        notes = page.notes
    for note in notes:
        warn(note, FflinWarning, stacklevel=2)
    shown = outputs.get(".html") if outputs else _temporary(robot.name)
    if shown:
        contents[shown] = page_html.encode()
    write_atomically(contents)
    if shown and _opens(opened, default=not outputs):
        import webbrowser

        webbrowser.open(shown.resolve().as_uri())
    return None if shown is None else HtmlPage(shown)


def _live(page: Page, q: Array, follow: bool | None, speed: float, port: int) -> Live:
    """Return a live page, and warn of drawings that are missing."""
    from fflin.view.live import Live

    live = Live(page, q, follow=follow, speed=speed, port=port)
    for note in page.notes:
        warn(note, FflinWarning, stacklevel=3)
    return live


def _opens(asked: bool | None, *, default: bool) -> bool:
    """Return whether to open a browser; a notebook shows pages itself, unless `asked` is true."""
    if asked is None:
        return default and not in_notebook()
    return asked


def _at_rest(robot: Robot, q: Array | None) -> Motion:
    """Return a motion in which the robot stays at q (nq,), by default at its start."""
    from fflin.simulation.simulate import simulate

    q = start_of(robot)[0] if q is None else _configuration(robot, "q", q)
    still = robot.replace(gravity=(0.0, 0.0, 0.0), stiffness={})
    v = np.zeros(robot.nv)
    return simulate(still, q0=q, v0=v, duration=1.0, dt=0.5, progress=False)


def _temporary(name: str) -> Path:
    prefix = f"fflin-{re.sub(r'[^a-zA-Z0-9_]+', '_', name)[:40]}-"
    with tempfile.NamedTemporaryFile(
        prefix=prefix, suffix=".html", delete=False
    ) as file:
        return Path(file.name)


def check_outputs(files: Mapping[str, str | PathLike[str] | None]) -> dict[str, Path]:
    """Return {ending: path} of the requested files; raise an error if one cannot be written."""
    outputs = {
        ending: as_path(file) for ending, file in files.items() if file is not None
    }
    for ending, path in outputs.items():
        if path.suffix.lower() != ending:
            raise FileError(f"'{path}' ends in '{path.suffix}', expected {ending}")
        check_output_path(path)
    check_distinct(*outputs.values())
    if ".png" in outputs or ".gif" in outputs:
        from fflin.view.capture import find_chromium

        find_chromium()
    return outputs


def tool_frame(robot: Robot, tool: str | None = None) -> str | None:
    """Return the tool frame: by default "tool" if it exists, else the end of the longest chain.

    For a robot without joints, there is no default tool frame, and the result is None.
    """
    if tool is not None:
        find_frame(robot.model, tool)
        return tool
    model = robot.model
    if robot.n == 0:
        return None
    if model.existFrame("tool"):
        return "tool"
    deepest = max(
        range(ROOT, model.njoints), key=lambda joint: len(model.supports[joint])
    )
    links = [
        frame.name
        for frame in model.frames.tolist()
        if frame.parentJoint == deepest and frame.type == pin.FrameType.BODY
    ]
    return links[-1] if links else None


def check_playback(
    fps: float,
    speed: float | None,
    times: Sequence[float] | None,
    start: float,
    end: float,
) -> tuple[float, float, list[float] | None]:
    """Check the frame rate, speed and picture times [s] of a motion, and return them.

    `start` and `end` [s] are the first and the last time of the motion. If `speed` is None, choose
    a speed at which the animation takes at most _LONGEST seconds.
    """
    fps = number("fps", fps)
    if not 0.0 < fps <= 240.0:
        raise InputError(f"fps is {fps:g}, expected more than 0 and at most 240")
    nice = [
        1.0,
        2.0,
        5.0,
        10.0,
        20.0,
        50.0,
        100.0,
        200.0,
        500.0,
        1e3,
        2e3,
        5e3,
        1e4,
        1e5,
    ]
    if speed is None:
        speed = next((s for s in nice if end - start <= s * _LONGEST), 1e6)
    if times is not None:
        times = [number("a time", time) for time in times]
        if not times or not all(start <= time <= end for time in times):
            raise InputError(
                f"times are {times}, expected times from {start:g} to {end:g} s"
            )
    return fps, positive("speed", speed), times


def _robot_of(robot: Robot, motion: Motion) -> Robot:
    """Return the robot that a motion was simulated with.

    `robot` is the nominal robot. If the motion is a run of a campaign, return the perturbed robot
    of this run.
    """
    from fflin.simulation.motion import require_motion

    require_motion(motion)
    if motion._nominal == robot.urdf_sha256:
        robot = motion._robot or robot
    sizes = motion.q.shape[1], motion.u.shape[1]
    expected = robot.nq, len(Actuation(StateMap(robot)).names)
    if sizes != expected or motion.urdf_sha256 != robot.urdf_sha256:
        raise InputError(
            f"the motion of '{motion.robot}' was simulated with another robot than the given "
            f"'{robot.name}'; give the robot that it was simulated with"
        )
    return robot


def _configuration(robot: Robot, name: str, value: Array) -> Array:
    try:
        return robot.checked_configuration(value)
    except InputError as error:
        raise InputError(f"{name} is not a configuration: {error}") from None


def _pictures(
    page: str,
    outputs: dict[str, Path],
    motion: Motion,
    speed: float,
    times: Sequence[float] | None,
) -> dict[Path, bytes]:
    from fflin.view.capture import take_gif, take_png

    start, end = float(motion.t[0]), float(motion.t[-1])
    if times is None:
        # Most motions settle, and are fastest at the beginning, so the pictures are close together
        # there. If the motion tracks a moving target, the pictures are evenly spaced.
        fractions = (0.0, 0.35, 0.7, 1.0) if motion.tracked else (0.0, 0.08, 0.25, 1.0)
        times = [start + fraction * (end - start) for fraction in fractions]
    contents = {}
    if ".png" in outputs:
        contents[outputs[".png"]] = take_png(page, times)
    if ".gif" in outputs:
        contents[outputs[".gif"]] = take_gif(page, start, end, speed)
    return contents
