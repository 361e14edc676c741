"""The page of a motion of several phases: what is caught flies to the grasp, and is held."""

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.robot.joints import ROOT
from fflin.view.pages import _flight, payloads
from tests.support.phases import DEBRIS, TWIST, phases

# Positions travel as 32-bit floats, of metres.
EXACT = 1e-5


def frames(robot, q):
    data = robot.create_data()
    pin.framesForwardKinematics(robot.model, data, q)
    names = [frame.name for frame in robot.model.frames]
    return dict(zip(names, map(pin.SE3, data.oMf.tolist()), strict=True))


def shown(watched, *path):
    return pin.XYZQUATToSE3(np.array(watched.pose(["meshcat", *path])))


def apart(one, other):
    return np.abs(one.homogeneous - other.homogeneous).max()


def row_at(motion, t):
    return np.argmin(np.abs(motion.t - t))


@pytest.mark.browser
def test_a_body_flies_to_the_grasp_and_is_held(watch, tmp_path):
    flown = phases()
    path = tmp_path / "phases.html"
    fflin.visualize(flown.robot, flown.whole, html=path)
    watched = watch(path.as_uri() + "#pause", painted=True)
    grasp = frames(flown.robot, flown.approach.q[-1])["tool"]
    for t in (0.0, 1.5, 3.9):
        watched.do(f"fflin.seek({t})")
        body = shown(watched, "held", "payload", "root_joint")
        # A body of these moments that turns about one of its axes goes on to do so.
        turned = pin.Quaternion(pin.exp3(TWIST[3:] * (t - 4.0)))
        center = grasp.translation + grasp.rotation @ DEBRIS.lever
        spin = grasp.rotation @ (TWIST[:3] + np.cross(TWIST[3:], DEBRIS.lever))
        R = grasp.rotation @ turned.matrix()
        at = center + spin * (t - 4.0) - R @ DEBRIS.lever
        assert apart(body, pin.SE3(R, at)) < EXACT, t
        frames_now = frames(flown.robot, flown.approach.q[row_at(flown.approach, t)])
        assert apart(shown(watched, "robot", "joint_7"), frames_now["joint_7"]) < EXACT
    for part, start, t in (
        (flown.held, 4.0, 4.0),
        (flown.held, 4.0, 8.3),
        (flown.after, 10.0, 12.0),
    ):
        watched.do(f"fflin.seek({t})")
        frames_now = frames(part._robot, part.q[row_at(part, t - start)])
        assert (
            apart(
                shown(watched, "held", "payload", "root_joint"), frames_now["payload"]
            )
            < EXACT
        ), t
        for joint in ("joint_3", "joint_7"):  # jammed or not
            assert apart(shown(watched, "robot", joint), frames_now[joint]) < EXACT, (
                joint,
                t,
            )
    # The phases are named, the one at the time is marked, and each leads to its beginning.
    buttons = watched.page.locator(".phases button")
    assert buttons.all_text_contents() == [
        "servicer_7dof0 s",
        "payload of 500 kg caught4 s",
        "joint_3 jammed10 s",
    ]
    for k, time in enumerate((0.0, 4.0, 10.0)):
        buttons.nth(k).click()
        assert watched.do("fflin.state.time") == pytest.approx(time)
        pressed = [item.get_attribute("aria-pressed") for item in buttons.all()]
        assert pressed == [str(k == other).lower() for other in range(3)]
    assert "joint_3 jammed" in watched.page.locator("#stamp").text_content()
    # What flies is named and weighed, and what is caught has a colour of its own and edges.
    for t, name, kept in (
        (0.0, "servicer_7dof", 0.0),
        (4.5, "servicer_7dof + payload", 500.0),
    ):
        watched.do(f"fflin.seek({t})")
        message = [
            watched.page.locator(f"header {tag}").text_content() for tag in ("h1", "p")
        ]
        assert message[0] == name
        assert f", {flown.robot.mass + kept:.4g} kg, 13 s" in message[1]
        body, edges = watched.do(
            "(() => { const found = [], path = ['meshcat', 'held', 'payload'];"
            "viewer.scene_tree.find(path).object.traverse((x) => { if (x.material) "
            "found.push([x.type, x.material.opacity, x.material.color.getHex(), x.visible]); }); "
            "return found; })()"
        )
        assert (
            body[0] == "Mesh"
            and 0.2 < body[1] < 0.6  # the gripper is seen through it
            and edges[0] == "LineSegments"
            and edges[3]
        )
        red, green, blue = (body[2] >> shift & 255 for shift in (16, 8, 0))
        assert red > 1.2 * green > 1.2 * blue
    box = watched.page.get_by_label("payload", exact=True)
    box.uncheck(force=True)
    assert not watched.do(
        "viewer.scene_tree.find(['meshcat', 'held', 'payload']).object.visible"
    )
    assert "target" in watched.page.locator("#legend").text_content()


@pytest.mark.browser
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_a_payload_with_joints_comes_with_them(watch, tmp_path):
    other = fflin.load("ets_vii", stiffness=20.0, damping=2.0)
    v = np.r_[TWIST, 0.05, -0.02, 0.0, 0.0, 0.03, 0.0]
    flown = phases(other, v)
    path = tmp_path / "phases.html"
    fflin.visualize(flown.robot, flown.whole, html=path)
    watched = watch(path.as_uri() + "#pause")
    # Free motion without dampers is the same backwards.
    names = list(other.model.names)[ROOT:]
    watched.do("fflin.seek(0)")
    first = {name: shown(watched, "held", "payload", name) for name in names}
    watched.do("fflin.seek(4)")
    frames_now = frames(flown.caught.robot, flown.caught.q)
    for name in names[1:]:
        body = shown(watched, "held", "payload", name)
        assert apart(body, frames_now[f"payload.{name}"]) < EXACT
    undamped = other.replace(damping=0.0)
    back = fflin.simulate(
        undamped, None, q0=flown.caught.payload_q, v0=-v, duration=4.0
    )
    was = frames(undamped, back.q[-1])
    for name in names:
        assert apart(first[name], was[name]) < EXACT


@pytest.mark.parametrize("frame", ["lvlh", "hill"])
def test_in_orbit_a_payload_came_as_it_flies_there(frame):
    orbit = fflin.CircularOrbit(mean_motion=0.05, mu=1e9, body="rock", body_radius=1e3)
    payload = fflin.load("cubesat", orbit=orbit)
    q = fflin.configuration(
        payload, base=pin.SE3(np.eye(3), np.array([3.0, -2.0, 1.0]))
    )
    v = 0.1 * np.array([1.0, -2.0, 1.0, 0.5, 0.3, -0.4])
    flown = fflin.simulate(
        payload, None, q0=q, v0=v, duration=8.0, dt=0.05, frame=frame
    )
    end = payload, flown.q[-1], flown.v[-1]
    last, *_, first = _flight(*end, frame, np.array([-0.05, -4.0, -8.0]))
    assert first[0] == pytest.approx(q, abs=1e-6)
    assert last[0] == pytest.approx(flown.q[-2], abs=1e-9)
    other = {"lvlh": "hill", "hill": "lvlh"}[frame]
    assert np.abs(_flight(*end, other, np.array([-8.0]))[0][0] - q).max() > 0.1


def test_a_released_body_flies_on():
    robot = fflin.load("servicer_7dof")
    how = {"duration": 1.0, "dt": 0.1, "engine": "python"}
    v = fflin.velocity(robot, {"joint_3": 0.1, "omega_b.x": 0.05, "v_b.y": 0.02})
    first = fflin.simulate(robot, q0=robot.neutral(), v0=v, **how)
    end = {"q": first.q[-1], "v": first.v[-1]}
    caught = fflin.capture(robot, "tool", DEBRIS, **end, payload_v=TWIST)
    held = fflin.simulate(caught.robot, q0=caught.q, v0=caught.v, **how)
    free = fflin.simulate(robot, q0=held.q[-1], v0=held.v[-1], **how)
    whole = first.then(caught, held, free)
    rows = np.arange(len(whole.t))
    [(_, poses)] = payloads(whole, "hybrid", rows)
    assert len(poses) == len(rows)
    ends = np.cumsum([len(first.t), len(held.t)])
    before, after = ends[1] - 1, ends[1]
    assert poses[after] == pytest.approx(poses[before], abs=1e-12)
    released = pin.XYZQUATToSE3(poses[before, 0])
    frame = caught.robot.model.getFrameId("payload", pin.FrameType.BODY)
    data = caught.robot.create_data()
    model = caught.robot.model
    pin.forwardKinematics(model, data, held.q[-1], held.v[-1])
    twist = pin.getFrameVelocity(model, data, frame, pin.ReferenceFrame.WORLD)
    center = released.act(DEBRIS.lever)
    speed = twist.linear + np.cross(twist.angular, center)
    last = pin.XYZQUATToSE3(poses[-1, 0])
    assert np.linalg.norm(speed) > 1e-3
    assert last.act(DEBRIS.lever) == pytest.approx(center + speed, abs=1e-9)
    momentum = [
        pose.rotation @ DEBRIS.inertia @ pose.rotation.T @ rate
        for pose, rate in (
            (released, twist.angular),
            (last, _rate(poses[-3:, 0], how["dt"])),
        )
    ]
    # The rates are extrapolated from differences; their relative errors are of size (rate dt)^2.
    size = np.linalg.norm(momentum[0])
    assert momentum[1] == pytest.approx(momentum[0], abs=1e-4 * size)


def _rate(poses, dt):
    """Return the angular velocity at the last of three poses, in world axes."""
    turns = [pin.XYZQUATToSE3(pose).rotation for pose in poses]
    halfway = [pin.log3(b @ a.T) / dt for a, b in pairwise(turns)]
    return 1.5 * halfway[1] - 0.5 * halfway[0]
