"""What stands below the title of a page: the controller, the run, how it ends, missing meshes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fflin
from fflin.simulation.report import headline
from tests.support.motions import displaced, led, regulated, settling


@pytest.fixture(scope="module")
def flown():
    """A robot, its policy and a motion from 30 deg to rest."""
    robot, lin, gain = regulated("planar_detumble")
    policy = fflin.StateFeedback(lin, gain.K)
    motion = fflin.simulate(robot, policy, x0=displaced(lin), duration=60.0)
    return robot, policy, motion


def test_the_heading_states_controller_attitude_and_settling(flown):
    motion = flown[2]
    controller, attitude, settled = headline(motion).split(", ")
    assert controller == "state feedback"
    error = motion.attitude_error
    final = f"{error[-1]:.3g}" if error[-1] > 1e-4 * error.max() else "0"
    assert attitude == f"attitude {error[0]:.3g} deg to {final} deg"
    time = float(settled.removeprefix("settled after ").removesuffix(" s"))
    assert time > 0.0
    assert error[motion.t > time].max() <= 0.02 * error.max() + 1e-9


def test_the_heading_says_so_if_a_motion_does_not_settle(robots):
    robot = robots["planar_detumble"]
    motion = settling(robot, 2.0)
    assert "not settled" in headline(motion) and "settled after" not in headline(motion)
    assert headline(replace(motion, stopped="event")).endswith("stopped: event")
    resting = fflin.simulate(robot, None, duration=1.0)
    assert headline(resting) == "no control"


def test_errors_along_a_trajectory_are_in_deg_and_mm(robots):
    motion = led(settling(robots["planar_detumble"], 4.0), rows=900)
    motion = replace(motion, target=motion.target + 1e-3)
    _, _, text = headline(motion).partition("errors at the end: ")
    position, joints = (
        float(np.abs(motion.error[-1, part]).max())
        for part in (slice(3, 6), slice(6, 9))
    )
    assert f"position {1e3 * position:.2g} mm" in text
    assert f"joints {np.degrees(joints):.2g} deg" in text


@pytest.mark.exhaustive
def test_a_run_of_a_campaign_is_named(flown):
    robot, policy, _ = flown
    options = {"runs": 6, "seed": 3, "duration": 2.0, "dt": 0.005}
    campaign = fflin.monte_carlo(robot, policy, {"q_b": 0.1}, **options)
    worst = campaign.worst(1)[0]
    other = (worst + 1) % 6
    assert campaign.about.startswith("worst ")
    bounded = fflin.monte_carlo(
        robot, policy, {"q_b": 0.1}, goals=["attitude < 5"], **options
    )
    assert bounded.about == "attitude"
    first = bounded.worst(1)[0]
    assert ", worst attitude, seed 3" in headline(bounded.replay(first))
    start = f"run {worst} of 6, {campaign.about}, seed 3, state feedback"
    assert headline(campaign.replay(worst)).startswith(start)
    start = f"run {other} of 6, seed 3, state feedback"
    assert headline(campaign.replay(other)).startswith(start)


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_the_heading_is_in_the_file_before_any_script(flown, tmp_path):
    robot, _, motion = flown
    path = tmp_path / "motion.html"
    fflin.visualize(robot, motion, html=path)
    head = path.read_text().partition("<script>")[0]
    assert f"<h1>{robot.name}</h1>" in head
    assert headline(motion) in head


@pytest.mark.browser
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_the_page_says_which_drawings_are_missing(watch, tmp_path):
    text = Path(fflin.load("planar_detumble").urdf).read_text()
    at = text.index("<box")
    end = text.index("/>", at) + 2
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(text[:at] + '<mesh filename="lost.stl"/>' + text[end:])
    robot = fflin.load(urdf)
    path = tmp_path / "motion.html"
    fflin.visualize(robot, settling(robot, 1.0), html=path)
    watched = watch(path.as_uri() + "#pause")
    notes = watched.page.locator("#notes")
    assert "mesh file lost.stl (link base) not found" in notes.text_content().replace(
        "'", ""
    )
    assert notes.is_visible()
