"""Files and pictures: written whole or not at all, and one line for what cannot be done."""

import base64
import json
import os
import pickle
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fflin
from fflin.commands.cli import main
from fflin.view.pages import frame_indices
from fflin.view.visualize import tool_frame
from tests.support.browser import Watched
from tests.support.cards import Parsed
from tests.support.messages import hear_lines, says
from tests.support.motions import settling
from tests.support.patience import finished

ORBIT = fflin.CircularOrbit(500e3)


def test_nothing_is_left_behind_by_bad_input(robots, motion, tmp_path):
    robot = robots["planar_detumble"]
    other = robots["ets_vii"]
    page = tmp_path / "m.html"
    for error, match, arguments in (
        (fflin.FileError, "folder", {"html": tmp_path / "no" / "m.html"}),
        (fflin.FileError, ".html", {"html": tmp_path / "m.txt"}),
        (fflin.FileError, ".png", {"html": page, "png": tmp_path / "m.gif"}),
        (fflin.InputError, "'moon'", {"html": page, "scene": "moon"}),
        (fflin.InputError, "fps", {"html": page, "fps": 0}),
        (fflin.InputError, "speed", {"html": page, "speed": -1}),
        (fflin.InputError, "path", {"html": 3}),
        (fflin.UnknownNameError, "'tol'", {"html": page, "tool": "tol"}),
        (
            fflin.InputError,
            r"\(13,\)",
            {"html": page, "target": np.zeros(3)},
        ),
    ):
        with pytest.raises(error, match=match) as caught:
            fflin.visualize(robot, motion, **arguments)
        assert "\n" not in str(caught.value)
    with pytest.raises(fflin.InputError, match="'ets_vii'"):
        fflin.visualize(other, motion, html=page)
    alike = replace(motion, urdf_sha256="0" * 64, robot="another")
    with pytest.raises(fflin.InputError, match="'another'"):
        fflin.visualize(robot, alike, html=page)
    with pytest.raises(fflin.InputError, match="Motion"):
        fflin.visualize(robot, "motion", html=page)
    with pytest.raises(fflin.InputError, match=r"fflin\.Robot"):
        fflin.visualize("ets_vii", html=page)
    (tmp_path / "folder.html").mkdir()
    with pytest.raises(fflin.FileError, match="folder"):
        fflin.visualize(robot, motion, html=tmp_path / "folder.html")
    assert [path.name for path in tmp_path.iterdir()] == ["folder.html"]


@pytest.mark.parametrize("fields", [{}, {"gravity": (0, 0, -9.81)}, {"orbit": ORBIT}])
def test_a_robot_without_a_motion_rests_on_its_page(fields, tmp_path):
    robot = fflin.load("cubesat", **fields)
    made = fflin.visualize(robot, html=tmp_path / "still.html")
    assert made == tmp_path / "still.html" and "meshcat" in made.read_text(
        encoding="utf-8"
    )
    with pytest.raises(fflin.InputError, match="q"):
        fflin.visualize(robot, html=tmp_path / "other.html", q=np.zeros(3))


def test_a_robot_without_visuals_is_drawn_as_boxes_and_says_so(robots, tmp_path):
    robot = fflin.from_model(robots["planar_detumble"].model, name="bare")
    with pytest.warns(fflin.FflinWarning, match="bare"):
        fflin.visualize(robot, settling(robot, 1.0), html=tmp_path / "m.html")
    assert (tmp_path / "m.html").is_file()
    whole = robots["ets_vii"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fflin.visualize(whole, settling(whole, 1.0), html=tmp_path / "e.html")


def test_frames_are_samples_of_the_motion():
    t = np.linspace(0.0, 10.0, 1001)
    shown = frame_indices(t, 30.0, 1.0)
    assert shown[0] == 0 and shown[-1] == 1000 and len(shown) == 301
    assert np.diff(t[shown]).max() < 1.0 / 30.0 + 0.011
    assert len(frame_indices(t, 30.0, 10.0)) == 31
    # Uneven times: each frame is the sample nearest to it.
    rng = np.random.default_rng(0)
    uneven = np.sort(rng.uniform(0, 10, 300))
    for index, wanted in zip(
        frame_indices(uneven, 1.0, 1.0),
        np.linspace(uneven[0], uneven[-1], round(np.ptp(uneven)) + 1),
        strict=True,
    ):
        assert abs(uneven[index] - wanted) == np.abs(uneven - wanted).min()
    assert len(frame_indices(np.linspace(0, 36000, 360_001), 30, 1)) <= 3001
    assert frame_indices(np.zeros(1), 30, 1).tolist() == [0]


def test_the_tool_is_the_end_of_the_longest_chain(robots):
    assert tool_frame(robots["servicer_7dof"]) == "tool"
    assert tool_frame(robots["cubesat"]) is None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        panda = fflin.load("panda", lock=["panda_finger_joint1"])
    name = tool_frame(panda)
    assert (
        panda.model.frames[panda.model.getFrameId(name)].parentJoint
        == panda.model.njoints - 1
    )


def test_a_page_is_opened_where_no_file_is_named(robots, motion, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    path = fflin.visualize(robots["planar_detumble"], motion)
    assert opened == [path.as_uri()] and path.read_text().startswith("<!DOCTYPE html>")
    path.unlink()
    path = fflin.visualize(robots["planar_detumble"], motion, open=False)
    path.unlink()
    assert len(opened) == 1


def test_names_of_robots_and_links_do_no_harm(robots, motion, tmp_path):
    """A name with a script's end in it stays text."""
    import pinocchio as pin

    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "a/b </script><b>")
    model.appendBodyToJoint(1, pin.Inertia.Random(), pin.SE3.Identity())
    name = "</script><script>alert(1)</script>"
    robot = fflin.from_model(model, name=name)
    with pytest.warns(fflin.FflinWarning):
        fflin.visualize(robot, settling(robot, 1.0), html=tmp_path / "m.html")
    text = (tmp_path / "m.html").read_text()
    assert "<script>alert" not in text and text.count("</script>") == 4


def test_view_on_the_command_line(capsys, monkeypatch):
    waited = []
    monkeypatch.setattr(
        "fflin.view.live.Live.wait", lambda self: (waited.append(self), self.close())
    )
    code = main(["view", "cubesat", "--no-open", "--rpy", "10", "0", "0"])
    out, error = capsys.readouterr()
    assert code == 0 and says(out, "cubesat", "closed") and waited[0].url in error
    np.testing.assert_allclose(waited[0].q[3], np.sin(np.radians(5.0)))
    assert main(["view", "cubesat", "--no-open", "--port", "70000"]) == 2
    assert says(capsys.readouterr().err.splitlines()[-1], "fflin: error: ", "70000")
    assert main(["view", "cubesat", "--no-open", "--tool", "x"]) == 2


def test_simulate_on_the_command_line(capsys, tmp_path, monkeypatch):
    page = tmp_path / "loop.html"
    command = ["simulate", "cubesat", "--rpy", "30", "0", "0", "--duration", "5"]
    assert (
        main(
            [*command, "--html", str(page), "--scene", "lab", "--fps", "10", "--follow"]
        )
        == 0
    )
    assert f"wrote {page}: " in capsys.readouterr().out
    text = page.read_text()
    assert '<body class="lab motion">' in text and '"follow":true' in text
    data = json.loads(text.partition('id="data">')[2].partition("</script>")[0])
    times = np.frombuffer(base64.b64decode(data["t"]), dtype="<f4")
    np.testing.assert_allclose(times, np.linspace(0, 5, 51), atol=6e-3)
    assert data["target"] and data["linear"]
    # What cannot be written is told before anything is simulated.
    monkeypatch.setattr(
        "fflin.simulation.simulate.simulate", lambda *_, **__: pytest.fail("simulated")
    )
    assert main([*command, "--html", str(tmp_path / "no" / "m.html")]) == 2
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main([*command, "--png", str(tmp_path / "m.png")]) == 2
    lines = hear_lines(capsys.readouterr().err).splitlines()
    assert (
        len(lines) == 2 and "folder" in lines[0] and "apt install chromium" in lines[1]
    )
    page = ["--html", str(tmp_path / "m.html"), "-o", str(tmp_path / "m.npz")]
    (tmp_path / "folder.html").mkdir()
    for wrong, message in (
        (["--fps", "0"], "fps"),
        (["--fps", "1e6"], "fps"),
        (["--speed", "-1"], "speed"),
        (["--tool", "tol"], "'tol'"),
        (["--times", "9"], "9.0"),
        (["--html", str(tmp_path / "folder.html")], "folder"),
    ):
        assert main([*command, *page, *wrong]) == 2
        (line,) = hear_lines(capsys.readouterr().err).splitlines()
        assert message in line
    left = sorted(path.name for path in tmp_path.iterdir())
    assert left == ["folder.html", "loop.html"]


@pytest.mark.process
def test_files_are_written_even_if_stdout_is_closed(tmp_path):
    page = tmp_path / "m.html"
    command = ["simulate", "cubesat", "--rpy", "10", "0", "0", "--duration", "1"]
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "wb") as closed:
        done = finished(
            [sys.executable, "-u", "-m", "fflin", *command, "--html", str(page)],
            stdout=closed,
            stderr=subprocess.PIPE,
        )
    assert (done.returncode, done.stderr) == (0, b"") and page.is_file()


def test_a_name_that_is_not_a_files_name_does_no_harm(robots, monkeypatch):
    robot = fflin.from_model(robots["planar_detumble"].model, name="../a/b \u2603" * 99)
    with pytest.warns(fflin.FflinWarning, match="boxes"):
        path = fflin.visualize(robot, settling(robot, 1.0), open=False)
    path.unlink()
    assert path.name.startswith("fflin-_a_b_")


def test_assets_are_part_of_the_package():
    names = {
        path.name
        for path in Path(fflin.__file__).parent.joinpath("view", "assets").iterdir()
    }
    assert {"page.html", "style.css", "main.js", "sky.js"} <= names


def test_visualize_returns_a_path_that_notebooks_show_as_its_page(robots, tmp_path):
    robot = robots["planar_detumble"]
    file = tmp_path / "<b>.html"
    page = fflin.visualize(robot, html=file, open=False)
    assert isinstance(page, Path) and os.fspath(page) == str(page) == str(file)
    assert page == file and hash(page) == hash(file) and page.read_bytes()
    card = Parsed(page._repr_html_())
    (frame,) = card.frames
    assert frame["srcdoc"] == file.read_text("utf-8") and frame["title"] == "<b>.html"
    assert card.tags == {"iframe"}
    assert page.with_suffix(".png")._repr_html_() is None
    page.unlink()
    assert page._repr_html_() is None
    copied = pickle.loads(pickle.dumps(page))
    assert copied == page and type(copied) is type(page)


@pytest.mark.browser
def test_the_frame_of_a_notebook_plays_the_page(robots, browser, tmp_path):
    robot = robots["planar_detumble"]
    path = tmp_path / "motion.html"
    page = fflin.visualize(robot, settling(robot, 1.0), html=path, open=False)
    notebook = tmp_path / "notebook.html"
    card = f"<!doctype html><title>x</title><meta charset='utf-8'>{page._repr_html_()}"
    notebook.write_text(card, "utf-8")
    framed = "document.querySelector('iframe')"
    with Watched(browser, notebook.as_uri(), size=(900, 700), ready=framed) as watched:
        frame = watched.page.query_selector("iframe").content_frame()
        watched.wait("window.fflin && fflin.ready", frame)
        assert "planar_detumble" in frame.inner_text("body")
        # The page cannot reach the notebook.
        assert frame.evaluate("origin") == "null"
