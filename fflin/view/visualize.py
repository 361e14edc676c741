"""Robots and motions in meshcat: one file to send, pictures of it, or a live page."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from warnings import warn

from fflin.base.errors import FflinWarning, FileError, InputError
from fflin.base.validation import Array, instance, number, truth, whole
from fflin.base.writing import as_path, check_distinct, check_place, write_whole
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.points import start_of
from fflin.dynamics.state import StateMap
from fflin.robot.frames import find_frame
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from os import PathLike

    from fflin.analysis.modes import Modes
    from fflin.campaign.campaign import Campaign
    from fflin.campaign.reach import Funnel
    from fflin.simulation.motion import Motion
    from fflin.view.live import Live

SCENES = ("space", "lab")

# A picture with its panel, and one of several without.
_PICTURE, _STRIP, _GIF = (1280, 720), (640, 480), (640, 400)

# A motion that takes longer than this to watch is shown faster.
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
    cloud: Campaign | None = None,
    funnel: Funnel | None = None,
    q: Array | None = None,
    port: int = 0,
    frame: str | None = None,
) -> Live | Path | None:
    """Show a robot live, or a motion of it as one HTML file that needs no network.

    The page has the robot in its colours, triads at base and tool, the trails of the tool and of
    the centre of mass, arrows of force and torque on the base and plumes of thrusters as long as
    u(t), a translucent robot at the target and, where the motion has a linear prediction, another
    that follows it; a slider, and a panel with errors and inputs over time. Along a trajectory the
    reference moves beside the robot, with its paths of base and tool in dashes beside those that
    were flown, and pale under the joints' curves; a dotted line is where it comes to rest. Every
    body is a node ``meshcat/robot/JOINT`` of meshcat's scene whose pose is that of the joint's
    frame.

    Parameters
    ----------
    robot : Robot
    motion : Motion or Modes, optional
        Of `simulate`; or of `modes`, which the page plays one at a time, by their names and
        frequencies. Without it the robot is shown live, with a slider for each joint.
    html : path, optional
        File to write; a temporary one by default.
    png, gif : path, optional
        Pictures to write; Chromium takes them.
    times : sequence of float, optional
        When [s] pictures are taken: one is a picture with its panel, several are a strip. Four
        by default.
    open : bool, optional
        Whether to open a browser; by default where no file is named.
    scene : {"space", "lab"}, optional
        Sky and planet, or a floor with a grid; the latter by default where there is gravity. In
        orbit the planet is the body that it circles, in its true size and below, where it turns
        with the stars as the orbit goes on; the sun stays.
    fps : float
        Frames per second of watching.
    speed : float, optional
        Seconds of motion per second of watching; 1, or more for motions of over a minute. A
        simulation that is shown live waits for it.
    follow : bool, optional
        Whether the camera follows the base; by default where a motion goes so far that the robot
        would be a dot on its way.
    target : array_like (nq,), optional
        Configuration that errors are counted from; by default the one that the motion was steered
        to. Where there is none the change from the start is shown instead, and no ghost.
    tool : str, optional
        Frame whose trail is drawn; "tool" or the last link of the longest chain by default.
    cloud : Campaign, optional
        Of `monte_carlo`: the paths of base and tool in up to 240 of its runs, as thin lines. The
        motion may be a run of it, `Campaign.replay`, which is shown with the bodies that it drew.
    funnel : Funnel, optional
        Of the trajectory that the motion follows: where base and tool may be is drawn as a tube.
    q : array_like (nq,), optional
        Where a live robot stands first; by default at its `start`, or neutral.
    port : int
        Of the live page; a free one by default.
    frame : {"lvlh", "hill"}, optional
        Of a live robot in orbit, which of the orbit's frames its world is; lvlh by default.

    Returns
    -------
    Live, Path or None
        The live page; or the HTML file, None where only pictures were asked for.

    Raises
    ------
    InputError
        If the motion or modes are another robot's or of a reduced model, or a value is none; if
        no mode oscillates, or pictures of modes are asked for; if the port is taken.
    FileError
        If a file cannot be written. No file is left half written.
    UnknownNameError
        If there is no such frame.
    MissingPackageError
        If a picture is asked for and there is no Chromium.

    Warns
    -----
    FflinWarning
        Of what could not be drawn: missing meshes; boxes where there is no visual geometry.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> motion = fflin.simulate(robot, v0=fflin.velocity(robot, {"joint_1": 0.1}), duration=2.0)
    >>> fflin.visualize(robot, motion, html="motion.html").name
    'motion.html'
    """
    instance("robot", robot, Robot, "a fflin.Robot; fflin.load makes one")
    if scene is None:
        scene = "lab" if any(robot.gravity) else "space"
    if not isinstance(scene, str) or scene not in SCENES:
        raise InputError(f"scene is {scene!r}, expected one of {', '.join(SCENES)}")
    opened = None if open is None else truth("open", open)
    check_tool(robot, tool)
    from fflin.view.playback import default_tool

    tool = tool or default_tool(robot)
    if motion is None:
        if any(file is not None for file in (html, png, gif)):
            raise InputError("a file shows a motion; give one, as fflin.simulate makes it")
        port = whole("port", port, 0, 2**16 - 1)
        start = start_of(robot)[0] if q is None else _configuration(robot, "q", q)
        from fflin.view.live import Live

        how: Any = {"scene": scene, "tool": tool, "follow": bool(follow), "frame": frame}
        live = Live(robot, start, **how, speed=_speed(speed, 1.0), port=port)
        for note in live.notes:
            warn(note, FflinWarning, stacklevel=2)
        if opened is not False:
            live.open()
        return live
    outputs = check_outputs({".html": html, ".png": png, ".gif": gif})
    from fflin.analysis.modes import Modes

    contents: dict[Path, bytes] = {}
    if isinstance(motion, Modes):
        if {*outputs} - {".html"}:
            raise InputError("pictures are taken of a motion; modes are shown by a page, html")
        from fflin.view.mode_page import mode_page

        page, notes = mode_page(robot, motion, scene=scene, tool=tool)
    else:
        robot = _check_motion(robot, motion, cloud)
        fps, speed = check_rates(fps, speed, float(motion.t[-1] - motion.t[0]))
        from fflin.view.motion_page import motion_page

        goal = None if target is None else _configuration(robot, "target", target)
        how = {"scene": scene, "fps": fps, "speed": speed, "follow": follow, "target": goal}
        page, notes = motion_page(robot, motion, **how, tool=tool, cloud=cloud, funnel=funnel)
        contents = _pictures(page, outputs, motion, speed, times)
    for note in notes:
        warn(note, FflinWarning, stacklevel=2)
    shown = outputs.get(".html") if outputs else _temporary(robot.name)
    write_whole(contents | ({shown: page.encode()} if shown else {}))
    if shown and (not outputs if opened is None else opened):
        import webbrowser

        webbrowser.open(shown.resolve().as_uri())
    return shown


def _temporary(name: str) -> Path:
    safe = re.sub(r"\W+", "_", name, flags=re.ASCII)[:40]
    with tempfile.NamedTemporaryFile(
        "wb", prefix=f"fflin-{safe}-", suffix=".html", delete=False
    ) as file:
        return Path(file.name)


def check_outputs(files: dict[str, Any]) -> dict[str, Path]:
    """Return {ending: path} of the files that are named, or raise where one cannot be written."""
    outputs = {}
    for ending, file in files.items():
        if file is None:
            continue
        path = as_path(file)
        if path.suffix.lower() != ending:
            raise FileError(f"'{path}' ends in '{path.suffix}', expected {ending}")
        check_place(path)
        outputs[ending] = path
    check_distinct(*outputs.values())
    if ".png" in outputs or ".gif" in outputs:
        from fflin.view.capture import find_chromium

        find_chromium()
    return outputs


def check_tool(robot: Robot, tool: str | None) -> None:
    """Raise UnknownNameError where there is no such frame."""
    if tool is not None:
        find_frame(robot.model, tool)


def check_rates(fps: float, speed: float | None, duration: float) -> tuple[float, float]:
    """Return frames per second and speed, one that suits the duration [s] where it is None."""
    fps = number("fps", fps)
    if not 0.0 < fps <= 240.0:
        raise InputError(f"fps is {fps:g}, expected more than 0 and at most 240")
    nice = [1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1e3, 2e3, 5e3, 1e4, 1e5]
    return fps, _speed(speed, next((s for s in nice if duration <= s * _LONGEST), 1e6))


def _speed(speed: float | None, default: float) -> float:
    speed = number("speed", default if speed is None else speed)
    if not speed > 0.0:
        raise InputError(f"speed is {speed:g}, expected more than 0")
    return speed


def _check_motion(robot: Robot, motion: Motion, cloud: Any) -> Robot:
    """Return the robot that a motion is of."""
    from fflin.simulation.motion import require_motion

    require_motion(motion)
    if cloud is not None:
        from fflin.view.cloud import drawn_robot

        robot = drawn_robot(robot, cloud, motion)
    sizes = motion.q.shape[1], motion.u.shape[1]
    expected = robot.nq, len(Actuation(StateMap(robot)).names)
    if sizes != expected or motion.urdf_sha256 != robot.urdf_sha256:
        raise InputError(
            f"the motion is one of '{motion.robot}', not of '{robot.name}' as it is given; give "
            "the robot that it was simulated with"
        )
    return robot


def _configuration(robot: Robot, name: str, value: Array) -> Array:
    try:
        return robot.checked_configuration(value)
    except InputError as error:
        raise InputError(f"{name} is no configuration: {error}") from None


def check_times(times: Sequence[float], start: float, end: float) -> list[float]:
    """Return the times [s] of pictures, or raise where one is not in the motion."""
    times = [number("a time", time) for time in times]
    if not times or not all(start <= time <= end for time in times):
        raise InputError(f"times are {times}, expected some from {start:g} to {end:g} s")
    return times


def _pictures(
    page: str, outputs: dict[str, Path], motion: Motion, speed: float, times: Sequence[float] | None
) -> dict[Path, bytes]:
    if ".png" not in outputs and ".gif" not in outputs:
        return {}
    from fflin.view.capture import take_gif, take_png

    start, end = float(motion.t[0]), float(motion.t[-1])
    if times is None:
        # What settles moves most at first, what follows a trajectory all the time.
        shares = (0.0, 0.35, 0.7, 1.0) if motion.tracked else (0.0, 0.08, 0.25, 1.0)
        times = [start + share * (end - start) for share in shares]
    times = check_times(times, start, end)
    contents = {}
    with tempfile.TemporaryDirectory(prefix="fflin-") as folder:
        file = Path(folder, "page.html")
        file.write_text(page, encoding="utf-8")
        if ".png" in outputs:
            size = _PICTURE if len(times) == 1 else _STRIP
            contents[outputs[".png"]] = take_png(file, times, size)
        if ".gif" in outputs:
            contents[outputs[".gif"]] = take_gif(file, (start, end), speed, _GIF)
    return contents
