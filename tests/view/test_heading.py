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


def detumbling(law, duration, turns=0.0):
    """A motion of a cubesat that rotates about its axis z by `turns` orbital rates."""
    robot = fflin.load("cubesat_magnetic")
    n = robot.orbit.mean_motion
    v0 = fflin.velocity(robot, {"omega_b.z": turns * n})
    motion = fflin.simulate(robot, law, v0=v0, duration=10.0, dt=1.0)
    # The rates hardly change in 10 s, so later times give a slow motion that is known.
    return replace(motion, t=motion.t * (duration * robot.orbit.period / 10.0))


@pytest.mark.parametrize(
    ("law", "name"),
    [(fflin.BDot(1.0), "B-dot"), (fflin.RateDamping(1e-9), "rate damping")],
)
def test_the_heading_of_a_detumbling_law_is_about_the_rate(law, name):
    n = fflin.load("cubesat_magnetic").orbit.mean_motion
    # The frame rotates about an axis across the axis of rotation of the satellite.
    for turns, ending in ((3.0, "detumbled after"), (5.0, "not detumbled")):
        motion = detumbling(law, 1.5, turns)
        controller, rate, end = headline(motion).split(", ")
        assert controller == name
        size = np.degrees(n * np.hypot(turns, 1.0))
        assert (
            rate
            == f"rate {size:.3g} deg/s to {size:.2g} deg/s (mean of the last orbit)"
        )
        assert end.startswith(ending)
        assert str(motion).startswith(ending)
    short = detumbling(law, 0.5, 3.0)
    assert headline(short).endswith(", shorter than one orbit")
    assert str(short).startswith(
        "not detumbled: the run is shorter than one orbit (5677 s)"
    )
    stopped = headline(replace(short, stopped="event"))
    assert stopped == f"{name}, stopped: event"


def test_the_heading_of_two_phases_names_both_laws_and_not_the_detumbling_time():
    robot = fflin.load("cubesat_magnetic")
    options = {"duration": 10.0, "dt": 1.0}
    first = fflin.simulate(robot, fflin.BDot(1.0), **options)
    start = {"q0": first.q[-1], "v0": first.v[-1]}
    free = fflin.simulate(robot, **start, **options)
    assert headline(first.then(free)) == "B-dot, then no control"
    again = fflin.simulate(robot, fflin.BDot(1.0), **start, **options)
    assert headline(first.then(again)).endswith(", shorter than one orbit")


def test_a_target_does_not_change_the_verdict_of_a_detumbling_law():
    motion = detumbling(fflin.BDot(1.0), 1.5, 3.0)
    aimed = replace(motion, target=np.zeros(len(motion.state_names)))
    assert headline(aimed) == headline(motion)
    assert "settled" not in str(aimed).partition("\n\n")[0]


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
