"""Charts, links, views, keys and the panel of a motion's page, as a reader uses them."""

import csv
import io
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.browser import Watched
from tests.support.motions import settling

pytestmark = pytest.mark.browser

SIZES = [(1280, 720), (390, 844)]
CHART = "joints"


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A servicer with thrusters and two wheels, one of which spins; its motion, and the page."""
    wheels = [
        fflin.ReactionWheel((0, 1, 0), inertia=0.05, name="wheel_y"),
        fflin.ReactionWheel((0, 0, 1), name="wheel_z"),
    ]
    robot = fflin.load("servicer_7dof", inputs=fflin.load_inputs("servicer_7dof"))
    robot = robot.replace(inputs=[*robot.inputs, *wheels])
    motion = settling(robot, 20.0)
    q = motion.q.copy()
    for row, t in zip(q, motion.t, strict=True):
        robot.joint("wheel_y").place(row, 0.3 * t)
    motion = replace(motion, q=q)
    path = tmp_path_factory.mktemp("inspection") / "motion.html"
    fflin.visualize(robot, motion, html=path)
    return robot, motion, path


@pytest.fixture(params=SIZES, ids=lambda size: str(size[0]))
def watched(request, flown, browser):
    with Watched(browser, flown[2].as_uri() + "#pause", size=request.param) as watched:
        watched.do("fflin.seek(4)")
        yield watched


def plot_of(watched, title):
    return watched.do("fflin.plots.map(({ title }) => title)").index(title)


def enlarge(watched, title):
    """Click a chart at a quarter of its time, and return where the large canvas is."""
    small = watched.page.locator(".plot canvas").nth(plot_of(watched, title))
    small.scroll_into_view_if_needed()
    assert watched.page.locator("#large").is_hidden()
    small.click(position={"x": (small.bounding_box()["width"] - 44) / 4, "y": 20})
    assert watched.page.locator("#large").is_visible()
    assert watched.do("fflin.state.time") == pytest.approx(5.0, abs=0.1)
    return watched.page.locator("#large canvas").bounding_box()


def read(watched):
    """Return {curve: (value, whether it is shown)} of the legend of the large chart."""
    rows = watched.page.locator("#large .curves button").all()
    return {
        row.locator("span").text_content(): (
            float(row.locator("output").text_content()),
            row.get_attribute("aria-pressed") == "true",
        )
        for row in rows
    }


def column(flown, joint, t):
    _, motion, _ = flown
    at = motion.state_names.index(f"q_m.{joint}")
    return np.degrees(motion.x[np.argmin(np.abs(motion.t - t)), at])


def colours(watched, colour):
    """Return how many pixels of the large chart have a colour."""
    red, green, blue = bytes.fromhex(colour[1:])
    return watched.do(f"""(() => {{
        const {{ width, height }} = document.querySelector('#large canvas');
        const copy = new OffscreenCanvas(width, height)
            .getContext('2d', {{ willReadFrequently: true }});
        copy.drawImage(document.querySelector('#large canvas'), 0, 0);
        const pixels = copy.getImageData(0, 0, width, height).data;
        let found = 0;
        for (let k = 0; k < pixels.length; k += 4) {{
            const away = [{red}, {green}, {blue}].map((each, c) => Math.abs(each - pixels[k + c]));
            found += Math.max(...away) < 30 && pixels[k + 3] > 120;
        }}
        return found;
    }})()""")


def test_a_chart_enlarges_and_its_cursor_reads_all_curves(flown, watched):
    robot, _, _ = flown
    width, height = watched.do("[innerWidth, innerHeight]")
    box = enlarge(watched, CHART)
    assert (
        box["height"] > 0.5 * height
        and box["x"] >= 0
        and box["x"] + box["width"] <= width
    )
    joints = [name for name in robot.joint_names if name not in robot.wheels]
    for share in (0.0, 0.4, 0.9):
        x = box["x"] + share * (box["width"] - 52)
        watched.page.mouse.move(x, box["y"] + box["height"] / 2)
        values = read(watched)
        assert set(values) == set(joints)
        for joint in joints:
            expected = column(flown, joint, 20.0 * share)
            near = pytest.approx(expected, rel=0.02, abs=np.degrees(2e-3))
            assert values[joint][0] == near
        clock = watched.page.locator("#large .head output").text_content()
        assert float(clock.split()[2]) == pytest.approx(20.0 * share, abs=0.1)
    # Without the pointer it reads the time of the motion.
    watched.page.mouse.move(1, 1)
    watched.do("fflin.seek(12)")
    assert read(watched)["joint_1"][0] == pytest.approx(
        column(flown, "joint_1", 12.0), rel=2e-3
    )
    watched.page.keyboard.press("Escape")
    assert watched.page.locator("#large").is_hidden()


def test_a_hidden_curve_leaves_the_chart_and_its_csv(flown, watched):
    enlarge(watched, CHART)
    lines = watched.do(
        f"fflin.plots[{plot_of(watched, CHART)}].lines.map((l) => [l.label, l.colour])"
    )
    colour = dict(lines)["joint_2"]
    watched.page.mouse.move(1, 1)
    before = colours(watched, colour)
    watched.page.locator("#large .curves button", has_text="joint_2").click()
    watched.page.mouse.move(1, 1)
    assert before > 100 and colours(watched, colour) < 0.1 * before
    assert [name for name, (_, shown) in read(watched).items() if not shown] == [
        "joint_2"
    ]
    with watched.page.expect_download() as saved:
        watched.page.locator("#large .head button", has_text=".csv").click()
    assert saved.value.suggested_filename == "servicer_7dof_joints.csv"
    head, *rows = csv.reader(io.StringIO(saved.value.path().read_text()))
    shown = [name for name, _ in lines if name != "joint_2"]
    assert head == ["t [s]", *(f"{name} [deg]" for name in shown)]
    values = np.array(rows, dtype=float)
    assert values[0, 0] == 0.0 and values[-1, 0] == pytest.approx(20.0)
    for t, *row in values[:: len(values) // 5]:
        expected = [column(flown, name, t) for name in shown]
        np.testing.assert_allclose(row, expected, rtol=1e-5, atol=1e-6)
    watched.page.get_by_role("button", name="all", exact=True).click()
    assert all(shown for _, shown in read(watched).values())


def test_the_bar_keeps_its_rows_while_the_motion_plays(watched):
    def tops():
        return [
            item.bounding_box()["y"] for item in watched.page.locator("#bar > *").all()
        ]

    result = []
    for time in (0.0, 9.99, 20.0):
        watched.do(f"fflin.seek({time})")
        result.append(tops())
    assert result[0] == result[1] == result[2]
    button, slider, clock, speed = watched.page.locator("#bar > *").all()[:4]
    one_row = [item.bounding_box() for item in (button, slider, clock, speed)]
    middles = [box["y"] + box["height"] / 2 for box in one_row]
    assert max(middles) - min(middles) < 4.0


def test_a_large_window_has_charts_that_can_be_read(flown, browser):
    with Watched(browser, flown[2].as_uri() + "#pause", size=(1600, 900)) as watched:
        tall = [
            item.bounding_box() for item in watched.page.locator(".plot canvas").all()
        ]
        assert min(box["height"] for box in tall) > 46.0
        panel = watched.page.locator("#panel").bounding_box()
        assert panel["width"] < 0.3 * 1600
        # The panel scrolls to each of them.
        for canvas in watched.page.locator(".plot canvas").all():
            canvas.scroll_into_view_if_needed()
            box = canvas.bounding_box()
            assert panel["y"] <= box["y"]
            assert box["y"] + box["height"] <= panel["y"] + panel["height"]


def screen(watched, point):
    """Return the CSS pixel of a point of the world."""
    x, y, z = np.asarray(point).tolist()
    return watched.do(f"""(() => {{
        viewer.render();
        viewer.scene.updateMatrixWorld(true);
        const p = new MeshCat.THREE.Vector3({x}, {z}, {-y}).project(viewer.camera);
        return [(1 + p.x) / 2 * innerWidth, (1 - p.y) / 2 * innerHeight];
    }})()""")


def test_a_link_is_named_on_hover_and_a_click_shows_its_mass_and_pose(flown, watched):
    robot, motion, _ = flown
    q = motion.q[np.argmin(np.abs(motion.t - 4.0))]
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    panel = robot.model.getFrameId("panel_left_link")
    middle = data.oMf[panel].act(np.array([0.0, 2.1, 0.0]))
    watched.page.mouse.move(*screen(watched, middle))
    watched.wait("!document.getElementById('hover').hidden")
    assert watched.page.locator("#hover").text_content() == "panel_left_link"
    watched.page.mouse.click(*screen(watched, middle))
    card = watched.page.locator("#link")
    assert card.locator("b").text_content() == "panel_left_link"
    for t in (4.0, 9.0):  # the card goes with the motion
        watched.do(f"fflin.seek({t})")
        q = motion.q[np.argmin(np.abs(motion.t - t))]
        pin.framesForwardKinematics(robot.model, data, q)
        mass, place, angles = card.locator("dd").all_text_contents()
        assert mass == "24.00 kg"
        place = [float(item) for item in place.removesuffix(" m").split(",")]
        np.testing.assert_allclose(place, data.oMf[panel].translation, atol=1e-3)
        angles = [float(item) for item in angles.removesuffix("°").split(",")]
        expected = np.degrees(pin.rpy.matrixToRpy(data.oMf[panel].rotation))
        np.testing.assert_allclose(angles, expected, atol=0.06)
    watched.page.mouse.click(20, 250)  # the sky
    assert card.is_hidden()


def test_the_panel_folds_and_leaves_the_scene_free(flown, watched):
    width, height = watched.do("[innerWidth, innerHeight]")
    panel = watched.page.locator("#panel")
    box = panel.bounding_box()
    if width < 700:  # under the scene, and every chart can be scrolled to
        assert box["y"] > 0.4 * height and box["width"] > 0.9 * width
        last = watched.page.locator(".plot canvas").last
        last.scroll_into_view_if_needed()
        assert last.bounding_box()["y"] + 30 < box["y"] + box["height"]
    middle = "viewer.camera.view.offsetX, viewer.camera.view.offsetY"
    before = watched.do(f"[{middle}]")
    watched.page.get_by_role("button", name="panel").click()
    assert panel.is_hidden()
    after = watched.do(f"[{middle}]")
    assert after[0] == 0.0 and sum(map(abs, after)) < 0.5 * sum(map(abs, before))
    watched.page.keyboard.press("p")
    assert panel.is_visible()
    assert watched.do(f"[{middle}]") == pytest.approx(before, abs=1.0)


def test_views_keys_and_their_help(flown, watched):
    robot, motion, _ = flown
    view = watched.page.get_by_label("view")
    back = "viewer.camera.position.clone().sub(viewer.controls.target).normalize().toArray()"
    for key, name, expected in (
        ("1", "front", (1, 0, 0)),
        ("2", "side", (0, 0, 1)),
        ("3", "top", (0, 1, 0)),
    ):
        watched.page.keyboard.press(key)
        assert view.input_value() == name
        np.testing.assert_allclose(watched.do(back), expected, atol=2e-3)
    view.select_option("tool")
    for t in (4.0, 11.0):  # the camera goes with the tool
        watched.do(f"fflin.seek({t})")
        data = robot.model.createData()
        pin.framesForwardKinematics(
            robot.model, data, motion.q[np.argmin(np.abs(motion.t - t))]
        )
        x, y, z = data.oMf[robot.model.getFrameId("tool")].translation
        target = watched.do("viewer.controls.target.toArray()")
        np.testing.assert_allclose(target, [x, z, -y], atol=1e-4)
    watched.page.evaluate("document.activeElement.blur()")
    watched.page.keyboard.press("f")
    follow = watched.page.get_by_role("button", name="follow")
    assert follow.get_attribute("aria-pressed") == "true"
    watched.do("fflin.seek(4)")
    for key, time in (
        ("ArrowRight", 4.2),
        ("ArrowLeft", 4.0),
        ("End", 20.0),
        ("Home", 0.0),
    ):
        watched.page.keyboard.press(key)
        assert watched.do("fflin.state.time") == pytest.approx(time)
    watched.page.keyboard.press("Space")
    assert watched.do("fflin.state.playing")
    watched.page.keyboard.press("Space")
    assert not watched.do("fflin.state.playing")
    help_ = watched.page.locator("#help")
    watched.page.keyboard.press("?")
    assert help_.is_visible()
    named = help_.locator("dt").all_text_contents()
    assert {"space", "→", "←", "1", "4", "F", "P", "?", "Esc"} <= set(named)
    watched.page.keyboard.press("Escape")
    assert help_.is_hidden()
    watched.page.locator("#bar .help").click()
    assert help_.is_visible()


def marks(watched, path):
    """Return position and quaternion in the world (z up) of a mark on a body."""
    return watched.do(f"""(() => {{
        const [body, name] = {list(path)!r}, T = MeshCat.THREE;
        viewer.scene.updateMatrixWorld(true);
        const mark = viewer.scene_tree.find(['meshcat', 'robot', body, name]).object.children[0];
        const p = new T.Vector3(), q = new T.Quaternion();
        const turned = new T.Quaternion(Math.SQRT1_2, 0, 0, Math.SQRT1_2);
        mark.getWorldPosition(p); mark.getWorldQuaternion(q);
        p.applyQuaternion(turned); q.premultiply(turned);
        return [...p.toArray(), ...q.toArray()];
    }})()""")


def test_thrusters_and_wheels_are_drawn_where_they_are(flown, watched):
    robot, motion, _ = flown
    thrusters = [item for item in robot.inputs if isinstance(item, fflin.Thruster)]
    for t in (2.0, 7.0):
        watched.do(f"fflin.seek({t})")
        q = motion.q[np.argmin(np.abs(motion.t - t))]
        base = pin.XYZQUATToSE3(q[:7])
        for k, thruster in enumerate(thrusters):
            shown = pin.XYZQUATToSE3(
                np.array(marks(watched, ("root_joint", f"nozzle {k}")))
            )
            np.testing.assert_allclose(
                shown.translation, base.act(np.array(thruster.position)), atol=1e-5
            )
            np.testing.assert_allclose(
                shown.rotation[:, 1],
                base.rotation @ np.array(thruster.direction),
                atol=1e-5,
            )
        size = watched.do(
            "JSON.parse(document.getElementById('data').textContent).size"
        )
        for k, axis in enumerate(np.eye(3)[1:]):
            shown = pin.XYZQUATToSE3(
                np.array(marks(watched, ("root_joint", f"wheel {k}")))
            )
            np.testing.assert_allclose(
                shown.translation, base.act(0.1 * size * axis), atol=1e-5
            )
            np.testing.assert_allclose(
                shown.rotation[:, 2], base.rotation @ axis, atol=1e-5
            )
            if axis[1]:  # it turns as its joint does
                data = robot.model.createData()
                pin.forwardKinematics(robot.model, data, q)
                rotor = data.oMi[robot.model.getJointId("wheel_y")]
                np.testing.assert_allclose(shown.rotation, rotor.rotation, atol=1e-5)
