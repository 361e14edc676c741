"""Messages and reports are coloured on terminals only, and as NO_COLOR and FORCE_COLOR say."""

import contextlib
import io
import os
import re
import subprocess
import sys
from argparse import Namespace

import numpy as np
import pytest

import fflin
from fflin.base import terminal
from fflin.base.figures import COLORS, joint_styles
from fflin.commands import builders
from fflin.simulation.plots import styles_of
from tests.support.commands import run
from tests.support.patience import finishing

VARIABLES = ("NO_COLOR", "FORCE_COLOR", "TERM", "COLORTERM")


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def environment(monkeypatch):
    """A function that sets the variables that control colours; all others of them are unset."""

    def given(**variables):
        for name in VARIABLES:
            monkeypatch.delenv(name, raising=False)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)

    given(TERM="xterm")
    return given


@pytest.mark.parametrize(
    ("variables", "on_terminal", "in_file"),
    [
        ({"TERM": "xterm"}, True, False),
        ({}, True, False),
        ({"TERM": "dumb"}, False, False),
        ({"NO_COLOR": "1", "TERM": "xterm"}, False, False),
        ({"NO_COLOR": "", "TERM": "xterm"}, True, False),
        ({"FORCE_COLOR": "1", "TERM": "dumb"}, True, True),
        ({"FORCE_COLOR": "1", "NO_COLOR": "1"}, False, False),
    ],
)
def test_colours_follow_the_terminal_and_the_environment(
    environment, variables, on_terminal, in_file
):
    environment(**variables)
    assert terminal.shows_colors(Terminal()) == on_terminal
    assert terminal.shows_colors(io.StringIO()) == in_file
    assert not terminal.shows_colors(None)


def test_the_labels_of_messages_are_coloured(environment, monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    error = terminal.color_message("fflin: error: no robot named 'error'")
    assert error == "fflin: \x1b[1;31merror\x1b[0m: no robot named 'error'"
    warning = terminal.color_message("fflin: warning: fflin: error: twice")
    assert warning == "fflin: \x1b[1;33mwarning\x1b[0m: fflin: error: twice"
    assert terminal.color_message("fflin: stopped") == "fflin: stopped"


def test_verdicts_are_coloured_and_zeros_are_dimmed(environment, monkeypatch):
    monkeypatch.setattr(sys, "stdout", Terminal())
    for text, colored in {
        "A and B are verified: 1e-9": "A and B are \x1b[1;32mverified\x1b[0m: 1e-9",
        "A is not\n  verified": "A is \x1b[1;31mnot\n  verified\x1b[0m",
        "3 comparisons FAILED": "3 comparisons \x1b[1;31mFAILED\x1b[0m",
        "wrote verified.npz": "wrote verified.npz",
        "unverified": "unverified",
        "x  .  1\ny  2  .": "x  \x1b[2m.\x1b[0m  1\ny  2  \x1b[2m.\x1b[0m",
        "An end.  A start": "An end.  A start",
    }.items():
        assert terminal.color_report(text) == colored
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    assert terminal.color_report("verified  .") == "verified  ."


RED, BLUE = "38;2;255;255;255;48;2;212;0;7", "38;2;0;0;0;48;2;112;184;253"


def test_names_of_joints_stand_on_their_colours(environment, monkeypatch):
    environment(TERM="xterm", COLORTERM="truecolor")
    monkeypatch.setattr(sys, "stdout", Terminal())
    colors = {"arm": "#d40007", "arm_2": "#70b8fd"}
    for text, colored in {
        "joint  type\n  arm  free": f"joint  type\n  \x1b[{RED}marm\x1b[0m  free",
        "arm_2     1": f"\x1b[{BLUE}marm_2\x1b[0m     1",
        "qdot_m.arm  1": f"qdot_m.\x1b[{RED}marm\x1b[0m  1",
        "0.1 deg in q_m.arm_2, at": f"0.1 deg in q_m.\x1b[{BLUE}marm_2\x1b[0m, at",
        "x  tau_m.arm": f"x  tau_m.\x1b[{RED}marm\x1b[0m",
        "an arm, arm by arm": None,  # a sentence is no table
        "arm.npz  left_arm  arm_3  q_m.arm_3  link.arm": None,
    }.items():
        assert terminal.color_report(text, colors) == (colored or text)
    verified = terminal.color_report("verified  arm", colors)
    assert verified == f"\x1b[1;32mverified\x1b[0m  \x1b[{RED}marm\x1b[0m"
    environment(TERM="xterm")  # of a terminal with 256 colours
    assert (
        terminal.color_report("  arm", colors) == "  \x1b[38;5;231;48;5;160marm\x1b[0m"
    )
    environment(TERM="xterm", NO_COLOR="1")
    assert terminal.color_report("  arm", colors) == "  arm"


def luminance(color):
    """Relative luminance of a colour "#rrggbb", as WCAG 2 defines it."""
    levels = np.array([*bytes.fromhex(color[1:])]) / 255.0
    linear = np.where(
        levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4
    )
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_names_of_joints_can_be_read_on_their_colours(environment):
    cube = (0, 95, 135, 175, 215, 255)
    seen = set()
    for color in COLORS:
        environment(TERM="xterm")
        ink, ground = map(int, re.findall(r"8;5;(\d+)", terminal._on_ground(color)))
        red, green, blue = (
            (ground - 16) // 36,
            (ground - 16) // 6 % 6,
            (ground - 16) % 6,
        )
        nearest = f"#{cube[red]:02x}{cube[green]:02x}{cube[blue]:02x}"
        seen.add(nearest)
        for letters, shown in (
            (terminal.ink_on(color), color),
            ({16: "#000000", 231: "#ffffff"}[ink], nearest),
        ):
            # 4.5 is the contrast that WCAG asks of text
            low, high = sorted((luminance(letters), luminance(shown)))
            assert (high + 0.05) / (low + 0.05) >= 4.5
    assert len(seen) == len(COLORS)


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
@pytest.mark.parametrize(
    "name", ["planar_detumble", "cubesat", "inspector_flexible", "canadarm2", "panda"]
)
def test_joints_have_the_colours_of_figures_and_pages(name, robots):
    robot = robots[name] if name in robots else fflin.load(name)
    arguments = Namespace(robot=name, lock=[], xacro=[])
    loaded = builders.load_robot(arguments)
    rng = np.random.default_rng(0)
    speeds = {joint: 0.01 * rng.uniform(0.1, 1.0) for joint in robot.joint_names}
    v0 = fflin.velocity(robot, speeds)
    motion = fflin.simulate(loaded, v0=v0, duration=0.02, dt=0.01)
    in_figures = styles_of(motion).get("q_m", {})
    if len(in_figures) > len(COLORS):
        assert not arguments.joint_colors
        return
    assert arguments.joint_colors == {
        joint: style.color for joint, style in in_figures.items()
    }


def test_of_many_joints_none_has_a_colour_without_a_motion():
    units = {f"joint_{k}": "rad" for k in range(len(COLORS))}
    assert [style.color for style in joint_styles(units).values()] == list(COLORS)
    assert joint_styles({**units, "one_more": "m"}) == {}


def on_terminal(*arguments, **variables):
    """Run fflin with a pseudo-terminal as stdout and stderr; return what it shows."""
    import pty

    ours, theirs = pty.openpty()
    kept = {name: x for name, x in os.environ.items() if name not in VARIABLES}
    command = [sys.executable, "-m", "fflin", *arguments]
    streams = {"stdin": subprocess.DEVNULL, "stdout": theirs, "stderr": theirs}
    with (
        subprocess.Popen(command, env={**kept, **variables}, **streams) as process,
        finishing(process),
    ):
        os.close(theirs)
        shown = b""
        with contextlib.suppress(OSError):  # how Linux reports the end
            while more := os.read(ours, 4096):
                shown += more
    os.close(ours)
    return shown.decode()


@pytest.mark.process
@pytest.mark.skipif(os.name != "posix", reason="no pseudo-terminal")
def test_a_terminal_shows_colours_and_a_pipe_does_not(tmp_path):
    shown = on_terminal("check", "cubesat", TERM="xterm")
    assert re.search(r"\x1b\[1;32mverified\x1b\[0m", shown)
    assert "\x1b[1;31merror\x1b[0m: no robot" in on_terminal("info", "x1", TERM="xterm")
    assert "\x1b[2m.\x1b[0m" in on_terminal("linearize", "cubesat", TERM="xterm")
    full = {"TERM": "xterm", "COLORTERM": "truecolor"}
    joint = f"\x1b[{RED}mjoint_1\x1b[0m"
    assert f"  {joint}  " in on_terminal("info", "planar_detumble", **full)
    path = tmp_path / "model.csv"
    on_terminal("linearize", "cubesat", "-o", str(path), TERM="xterm")
    tables = [table.read_text() for table in tmp_path.glob("*.csv")]
    assert len(tables) > 1 and "\x1b" not in "".join(tables)
    for variables in ({"TERM": "dumb"}, {"TERM": "xterm", "NO_COLOR": "1"}):
        assert "\x1b" not in on_terminal("check", "cubesat", **variables)
    assert "\x1b" not in on_terminal("check", "cubesat", "--json", TERM="xterm")
    code, out, _ = run("check", "cubesat")
    assert code == 0 and "verified" in out and "\x1b" not in out
