"""Pictures: what they show, and that the browser that takes them leaves nothing behind."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import fflin
from tests.support.motions import led
from tests.support.patience import finishing, wait_until

needs_chromium = pytest.mark.skipif(not shutil.which("chromium"), reason="no chromium")


@pytest.mark.browser
@needs_chromium
def test_pictures(robots, motion, tmp_path):
    robot = robots["planar_detumble"]
    strip, film = tmp_path / "m.png", tmp_path / "m.gif"
    assert fflin.visualize(robot, motion, png=strip, gif=film, speed=8) is None
    with Image.open(strip) as image:
        assert image.size == (4 * 640, 480)
        frames = np.split(np.asarray(image.convert("RGB"), dtype=int), 4, axis=1)
    for frame in frames:
        assert (frame.max(axis=2) > 90).mean() > 0.02
    assert (np.abs(frames[0] - frames[3]).max(axis=2) > 30).mean() > 0.01
    with Image.open(film) as image:
        assert image.n_frames == 6 and image.size == (640, 400)
    with pytest.raises(fflin.InputError, match="times"):
        fflin.visualize(robot, motion, png=strip, times=[9.0])


def test_times_of_pictures_do_not_concern_a_page(robots, motion, tmp_path):
    page = tmp_path / "m.html"
    fflin.visualize(
        robots["planar_detumble"], motion, html=page, times=[9.0], open=False
    )
    assert page.stat().st_size > 1000


def test_along_a_trajectory_pictures_are_taken_all_the_way(
    robots, motion, tmp_path, monkeypatch
):
    taken = []
    monkeypatch.setattr("fflin.view.capture.find_chromium", lambda: "")
    monkeypatch.setattr(
        "fflin.view.capture.take_png", lambda _, at: taken.append(at) or b""
    )
    for item in (motion, led(motion)):
        fflin.visualize(robots["planar_detumble"], item, png=tmp_path / "m.png")
    np.testing.assert_allclose(
        taken, np.array([[0, 0.08, 0.25, 1.0], [0, 0.35, 0.7, 1.0]]) * 4.0
    )


def test_without_chromium_one_line_says_how(robots, motion, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(
        fflin.MissingPackageError, match="apt install chromium"
    ) as caught:
        fflin.visualize(robots["planar_detumble"], motion, png=tmp_path / "m.png")
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())


def test_a_chromium_that_does_not_answer_is_one_line(
    robots, motion, tmp_path, monkeypatch
):
    program = tmp_path / "chromium"
    program.write_text("#!/bin/sh\nexec sleep 60\n")
    program.chmod(0o755)
    monkeypatch.setattr("fflin.view.capture.find_chromium", lambda: str(program))
    monkeypatch.setattr("fflin.view.capture._PATIENCE", 0.1)
    monkeypatch.setattr("fflin.view.capture._PER_PICTURE", 0.0)
    with pytest.raises(fflin.FileError, match="respond"):
        fflin.visualize(
            robots["planar_detumble"], motion, png=tmp_path / "m.png", times=[0.0]
        )
    assert not (tmp_path / "m.png").exists()


@pytest.mark.browser
@needs_chromium
def test_films(robots, motion, tmp_path, monkeypatch):
    """Whenever a motion begins all of it is shown, and nothing is left behind."""
    folder = tmp_path / "t"  # a longer path is too long for Chromium's sockets
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    monkeypatch.setenv("TMPDIR", str(folder))
    later = replace(motion, t=motion.t + 100.0)
    fflin.visualize(robots["planar_detumble"], later, gif=tmp_path / "m.gif", speed=8.0)
    with Image.open(tmp_path / "m.gif") as image:
        first = np.asarray(image.convert("RGB"), dtype=int)
        image.seek(image.n_frames - 1)
        last = np.asarray(image.convert("RGB"), dtype=int)
    assert (np.abs(first - last).max(axis=2) > 30).mean() > 0.01
    assert not list(folder.iterdir())


@pytest.mark.process
@pytest.mark.browser
@needs_chromium
@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_the_browser_ends_with_the_one_who_films(tmp_path, sent, code):
    """At once, and not when the film is done."""
    folder = Path(tempfile.mkdtemp(dir="/tmp"))  # Chromium's sockets need a short name
    # A film that takes minutes, so that a machine that is busy for seconds makes no difference.
    command = ["simulate", "cubesat", "--rpy", "10", "0", "0", "--duration", "300"]
    process = subprocess.Popen(
        [sys.executable, "-m", "fflin", *command, "--gif", str(tmp_path / "m.gif")],
        env={**os.environ, "TMPDIR": str(folder)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    browsing = f"--user-data-dir={folder}".encode()
    try:
        with finishing(process):
            wait_until(
                lambda: list(folder.glob("*/Default")), "the profile of Chromium"
            )
            assert running(browsing)
            process.send_signal(sent)
            _, error = process.communicate()
        assert process.returncode == code and "Traceback" not in error
        wait_until(lambda: not running(browsing), "the end of Chromium")
        assert not (tmp_path / "m.gif").exists()
        assert sent == signal.SIGKILL or not list(folder.iterdir())
    finally:
        process.kill()
        process.wait()
        process.stderr.close()
        # What dies of a signal may still write for a moment.
        wait_until(lambda: removed(folder), f"the end of what writes to {folder}")


def removed(folder):
    shutil.rmtree(folder, ignore_errors=True)
    return not folder.exists()


def running(argument):
    """Whether a process has an argument that begins so."""
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if any(
                item.startswith(argument) for item in file.read_bytes().split(b"\0")
            ):
                return True
    return False
