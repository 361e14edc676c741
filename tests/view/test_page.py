"""The page of a motion in a real browser: it is whole, plays, and shows what Pinocchio says."""

import json
import os
import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.robot.joints import ROOT
from fflin.view.visualize import tool_frame
from tests.support.browser import Watched
from tests.support.marks import exhaustive
from tests.support.motions import HOME, led, settling

# Positions travel as 32-bit floats, of metres.
EXACT = 1e-5


@pytest.fixture(scope="module")
def settled(robots, tmp_path_factory):
    """A motion, its page, and the page open at its start."""
    robot = robots["servicer_7dof"]
    motion = settling(robot, duration=20.0)
    path = tmp_path_factory.mktemp("page") / "motion.html"
    assert fflin.visualize(robot, motion, html=path) == path
    return robot, motion, path


@pytest.fixture(scope="module")
def watched(settled, browser):
    with Watched(browser, settled[2].as_uri() + "#pause", painted=True) as watched:
        yield watched


def placements(robot, q):
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    # Copies: what the list holds dies with the data.
    return dict(zip(robot.model.names, map(pin.SE3, data.oMi.tolist()), strict=True))


def page_data(path):
    """Return what the scripts of a page are given."""
    (data,) = re.findall(
        r'<script type="application/json" id="data">(.*?)</script>', path.read_text()
    )
    return json.loads(data)


def largest_difference(watched, robot, q, node="robot"):
    worst = 0.0
    for name, placement in list(placements(robot, q).items())[ROOT:]:
        shown = pin.XYZQUATToSE3(np.array(watched.pose(["meshcat", node, name])))
        worst = max(worst, np.abs(shown.homogeneous - placement.homogeneous).max())
    return worst


@pytest.mark.exhaustive
@pytest.mark.sample
@pytest.mark.browser
@pytest.mark.exhaustive
def test_bodies_stand_where_forward_kinematics_puts_them(settled, watch):
    robot, motion, path = settled
    # not painted: drawing takes most of the time
    watched = watch(path.as_uri() + "#pause")
    for t in (0.0, 1.3, 5.0, 11.9, 20.0):
        watched.do(
            f"viewer.animator.pause(); viewer.animator.seek({t}); viewer.render()"
        )
        q = motion.q[np.argmin(np.abs(motion.t - t))]
        assert largest_difference(watched, robot, q) < EXACT, t
    # And they would not pass for those of another time.
    assert largest_difference(watched, robot, motion.q[0]) > 1e-2


@pytest.mark.browser
def test_pieces_stand_where_the_urdf_puts_them(settled, watched):
    from fflin.view.shapes import shapes

    robot, motion, _ = settled
    watched.do("fflin.seek(3)")
    placed = placements(robot, motion.q[np.argmin(np.abs(motion.t - 3.0))])
    names = list(robot.model.names)
    for index, shape in enumerate(shapes(robot)[0]):
        node = f"viewer.scene_tree.find(['meshcat', 'robot', '{names[shape.joint]}', '{index}_0'])"
        matrix = watched.do(f"""(() => {{
            viewer.scene.updateMatrixWorld(true);
            const m = {node}.children['<object>'].object;
            return {{matrix: m.matrixWorld.toArray(), kind: m.geometry.type}};
        }})()""")
        world = np.reshape(matrix["matrix"], (4, 4)).T
        upright = (
            np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
            @ world
        )
        expected = (placed[names[shape.joint]] * shape.placement).homogeneous
        if matrix["kind"] == "CylinderGeometry":  # along y there, along z in URDF
            upright = upright @ np.array(
                [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]]
            )
        np.testing.assert_allclose(upright, expected, atol=EXACT)


@pytest.mark.browser
def test_the_target_is_the_reference(settled, watched):
    robot, _, _ = settled
    goal = robot.neutral()
    goal[:7] = pin.SE3ToXYZQUAT(HOME)
    assert largest_difference(watched, robot, goal, "target") < EXACT


@pytest.mark.browser
def test_slider_play_speed_and_keys_work(settled, watched):
    page = watched.page
    slider = page.locator("#bar input[type=range]")
    slider.fill("7.5")
    assert watched.do("fflin.state.time") == 7.5 and not watched.do(
        "fflin.state.playing"
    )
    assert page.locator("#bar output").text_content().startswith("7.50 /")
    before = watched.pose(["meshcat", "robot", "root_joint"])
    watched.do("fflin.seek(0)")
    watched.do("window.clock = 0, performance.now = () => window.clock")
    page.get_by_label("speed").select_option("5")
    page.locator("#bar button.play").click()
    watched.do("window.clock = 600")  # ms
    watched.wait("fflin.state.time > 0")
    assert watched.do("[fflin.state.time, fflin.state.playing]") == [3.0, True]
    assert watched.pose(["meshcat", "robot", "root_joint"]) != before
    page.locator("#bar button.play").click()
    watched.do("window.clock = 900")
    watched.drawn()
    assert watched.do("fflin.state.time") == 3.0
    watched.do("delete performance.now")
    page.locator("h1").click(force=True)
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("End")
    assert watched.do("fflin.state.time") == 20.0
    # Played to its end it stops there, and begins anew when it is played again.
    watched.do("fflin.seek(19.9), fflin.play()")
    watched.wait("!fflin.state.playing")
    assert watched.do("fflin.state.time") == 20.0
    watched.do("fflin.play(), fflin.pause()")
    assert watched.do("fflin.state.time") < 1.0


@pytest.mark.browser
def test_the_panel_agrees_with_the_motion(settled, watched):
    _, motion, _ = settled
    for t in (0.0, 4.0):
        watched.do(f"fflin.seek({t})")
        q = motion.q[np.argmin(np.abs(motion.t - t))]
        base = HOME.actInv(pin.XYZQUATToSE3(q[:7]))
        values = watched.page.locator(".readouts b").all_text_contents()
        angle = np.degrees(np.linalg.norm(pin.log3(base.rotation)))
        assert float(values[0].split()[0]) == pytest.approx(angle, rel=6e-3)
        distance = np.linalg.norm(base.translation)
        assert float(values[1].split()[0]) == pytest.approx(
            1e3 * distance, rel=6e-3, abs=1e-6
        )
        units = [value.split()[1] for value in values]
        assert units == ["deg", "mm", "deg"]
    mark = watched.page.locator(".conserved")
    assert mark.text_content() == "✓ momentum conserved"
    assert "1.0e-13" in mark.get_attribute("title")
    plots = watched.page.locator(".plot .name").all_text_contents()
    assert plots[0].startswith("attitude error") and any(
        "joint torques" in p for p in plots
    )
    # The cursor moves with the slider, and a click moves the slider.
    canvas = watched.page.locator(".plot canvas").first
    for t in (2, 12):
        watched.do(f"fflin.seek({t})")
        column = watched.do("""(() => {
            const canvas = document.querySelector('.plot canvas'), { width, height } = canvas;
            const copy = new OffscreenCanvas(width, height);
            const context = copy.getContext('2d', { willReadFrequently: true });
            context.drawImage(canvas, 0, 0);
            const pixels = context.getImageData(0, 0, width, height).data;
            const bright = new Array(width).fill(0);
            for (let k = 0; k < width * height; k++) {
                const [r, g, b, a] = pixels.slice(4 * k, 4 * k + 4);
                if (Math.min(r, g, b) > 180 && a > 60) bright[k % width]++;
            }
            return bright.indexOf(Math.max(...bright)) / width;
        })()""")
        ruled = canvas.bounding_box()["width"] - 44  # figures stand in the rest
        assert column * canvas.bounding_box()["width"] == pytest.approx(
            t / 20.0 * ruled, abs=2.5
        )
    canvas.click(position={"x": ruled / 4, "y": 20})
    assert watched.do("fflin.state.time") == pytest.approx(5.0, abs=0.1)
    watched.page.keyboard.press("Escape")  # the click has enlarged the chart


@pytest.mark.browser
def test_the_picture_is_not_blank_and_changes(settled, watched):
    watched.do("fflin.seek(0)")
    first = watched.picture()
    watched.do("fflin.seek(6)")
    second = watched.picture()
    assert (np.abs(first - second).max(axis=2) > 30).mean() > 0.01
    # The robot is in the middle, before a dark sky.
    assert np.median(first[:40]) < 20
    height, width, _ = first.shape
    middle = first[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3]
    assert (middle.max(axis=2) > 90).mean() > 0.1
    assert len(np.unique(middle.reshape(-1, 3), axis=0)) > 500


def on_screen(watched, points):
    """Return where points (N, 3) of the world are seen, in CSS pixels (N, 2)."""
    width, height = watched.do("[innerWidth, innerHeight]")
    seen = watched.do(f"""(() => {{
        viewer.render();
        return {np.asarray(points).tolist()}.map(([x, y, z]) => {{
            const p = new MeshCat.THREE.Vector3(x, z, -y).project(viewer.camera);
            return [p.x, p.y];
        }});
    }})()""")
    return (np.array(seen) * (1, -1) + 1) / 2 * (width, height)


@pytest.mark.browser
@pytest.mark.parametrize(("width", "height"), [(400, 800), (1024, 700), (1280, 720)])
def test_all_of_the_motion_is_within_the_view(settled, watched, width, height):
    """Robot, target and tips of forces lie in what the panels leave free, and fill it well."""
    _, motion, _ = settled
    watched.resize(width, height)
    points = watched.do(
        "JSON.parse(document.getElementById('data').textContent).points"
    )
    seen = on_screen(watched, points)
    panel, bar = (
        watched.page.locator(name).bounding_box() for name in ("#panel", "#bar")
    )
    low, high = seen.min(axis=0), seen.max(axis=0)
    assert bar["x"] >= 0 and bar["x"] + bar["width"] <= width
    for item in watched.page.locator("#bar > *").all():
        box = item.bounding_box()
        assert (
            box["x"] >= bar["x"] and box["x"] + box["width"] <= bar["x"] + bar["width"]
        )
    assert low.min() > 0 and high[0] < width and high[1] < bar["y"]
    assert high[0] < panel["x"] or high[1] < panel["y"]  # beside the panel, or above it
    assert (high - low).max() > 0.4 * min(width, height)
    # The pieces of the robot are among these points, at any time.
    body = on_screen(watched, motion.q[::200, :3])
    assert (body > low).all() and (body < high).all()


@pytest.mark.browser
def test_a_camera_that_was_taken_stays_where_it_was_put(settled, watch):
    watched = watch(settled[2].as_uri() + "#pause", size=(960, 600))
    at = "viewer.camera.position.toArray()"
    framed = watched.do(at)
    watched.resize(500, 600)
    assert not np.allclose(watched.do(at), framed)
    watched.page.mouse.move(250, 130)  # on the scene, above the panel
    watched.page.mouse.down()
    watched.page.mouse.move(320, 150, steps=3)
    watched.page.mouse.up()
    put = watched.do(at)
    watched.resize(960, 600)
    np.testing.assert_allclose(watched.do(at), put, atol=1e-6)


@pytest.mark.browser
def test_forces_trails_and_the_legend(settled, watched):
    robot, motion, _ = settled
    for kind, part in (("torque", ".children[0]"), ("force", "")):
        node = f"viewer.scene_tree.find(['meshcat', 'wrench', '{kind}']).object.children[0]{part}"
        lengths = []
        for t in (0.0, 1.0):
            watched.do(f"fflin.seek({t})")
            # The tip of the arrow: of its cone, whose middle lies half its height below.
            tip = watched.do(f"""(() => {{
                viewer.scene.updateMatrixWorld(true);
                const head = {node}.children[1];
                const tip = new MeshCat.THREE.Vector3(0, 0.5 * head.geometry.parameters.height, 0);
                head.localToWorld(tip);
                return [tip.x, -tip.z, tip.y];
            }})()""")
            index = np.argmin(np.abs(motion.t - t))
            base = pin.XYZQUATToSE3(motion.q[index, :7])
            # In the hybrid frame torques stand in the base's axes, forces in the reference's.
            if kind == "torque":
                pushed = base.rotation @ motion.u[index, :3]
            else:
                pushed = HOME.rotation @ motion.u[index, 3:6]
            arrow = np.array(tip) - base.translation
            lengths.append(np.linalg.norm(arrow) / np.linalg.norm(pushed))
            np.testing.assert_allclose(
                arrow / lengths[-1], pushed, rtol=1e-4, atol=1e-3
            )
        assert lengths[0] == pytest.approx(lengths[1], rel=1e-4)
    # Trails are drawn as far as tool and centre of mass have come, and by a line's width exact.
    model, data = robot.model, robot.model.createData()
    for t in (2.0, 9.0):
        watched.do(f"fflin.seek({t})")
        q = motion.q[np.argmin(np.abs(motion.t - t))]
        com = pin.centerOfMass(model, data, q).copy()
        pin.framesForwardKinematics(model, data, q)
        tool = data.oMf[model.getFrameId("tool")].translation
        for name, expected in (("tool", tool), ("centre of mass", com)):
            end = watched.do(f"""(() => {{
                const trail = viewer.scene_tree.find(['meshcat', 'trails', '{name}']).object;
                const tube = trail.children[0].children[1].geometry, around = 6;
                const ring = tube.drawRange.count / (6 * around), at = tube.attributes.position;
                const sum = new MeshCat.THREE.Vector3(), p = new MeshCat.THREE.Vector3();
                for (let k = 0; k < around; k++) {{
                    sum.add(p.fromBufferAttribute(at, ring * (around + 1) + k));
                }}
                return sum.divideScalar(around).toArray();
            }})()""")
            np.testing.assert_allclose(end, expected, atol=0.01)
    box = watched.page.get_by_label("path of the tool")
    trail = "viewer.scene_tree.find(['meshcat', 'trails', 'tool']).object.visible"
    assert watched.do(trail)
    box.uncheck(force=True)
    assert not watched.do(trail)
    box.check(force=True)
    assert watched.do(trail)


@pytest.mark.browser
def test_the_camera_follows_the_base_on_request(settled, watched):
    target = "viewer.controls.target.toArray()"
    watched.do("fflin.seek(0)")
    fixed = watched.do(target)
    watched.do("fflin.seek(8)")
    assert watched.do(target) == fixed
    button = watched.page.get_by_role("button", name="follow", exact=True)
    button.click()
    assert button.get_attribute("aria-pressed") == "true"
    before = watched.pose(["meshcat", "robot", "root_joint"])
    watched.do("fflin.seek(0)")
    after = watched.pose(["meshcat", "robot", "root_joint"])
    moved = np.subtract(after, before)[:3]
    shift = np.subtract(watched.do(target), fixed)
    np.testing.assert_allclose(shift, [moved[0], moved[2], -moved[1]], atol=1e-9)
    button.click()
    assert button.get_attribute("aria-pressed") == "false"


@pytest.mark.browser
def test_no_complaint_and_no_request(settled, watched):
    """Last, when all of the above has been done on the page."""
    assert watched.errors == []
    assert watched.requests == [settled[2].as_uri()]
    text = settled[2].read_text()
    assert "connect-src 'none'" in text
    assert not re.search(r"""(src|href)=["']?(https?:)?//""", text.split("<script>")[0])


@pytest.mark.browser
def test_a_lab_with_meshes_plumes_and_a_prediction(robots, watch, tmp_path):
    robot = fflin.load("panda")
    robot = robot.replace(
        inputs=[
            *robot.inputs,
            fflin.Thruster("panda_link0", (0.1, 0, 0), (0, 0, 1), "up"),
        ],
    )
    motion = settling(robot, duration=2.0, predicted=True)
    path = tmp_path / "panda.html"
    fflin.visualize(robot, motion, html=path, scene="lab", tool="panda_hand_tcp")
    watched = watch(path.as_uri() + "#pause", size=(480, 300), painted=True)
    watched.do("fflin.seek(1)")
    index = np.argmin(np.abs(motion.t - 1.0))
    assert largest_difference(watched, robot, motion.q[index]) < EXACT
    state = fflin.StateMap(robot, reference=motion.reference, frame=motion.frame)
    predicted = state.to_pinocchio(motion.linear[index])[0]
    assert largest_difference(watched, robot, predicted, "linear") < EXACT
    # Their normals are of length 1 and look outwards: the light is right.
    wrong = watched.do("""(() => {
        const V = MeshCat.THREE.Vector3, a = new V(), b = new V(), c = new V(), n = new V();
        let wrong = 0, all = 0;
        viewer.scene_tree.find(['meshcat', 'robot']).object.traverse((o) => {
            if (!o.isMesh || !o.userData.mesh) return;
            const { position, normal } = o.geometry.attributes;
            for (let i = 0; i < position.count; i += 3) {
                [a, b, c].forEach((v, k) => v.fromBufferAttribute(position, i + k));
                b.sub(a).cross(c.sub(a)).normalize();
                for (let k = 0; k < 3; k++) {
                    n.fromBufferAttribute(normal, i + k);
                    all++;
                    if (Math.abs(n.length() - 1) > 1e-3 || n.dot(b) < 0.6) wrong++;
                }
            }
        });
        return wrong / all;
    })()""")
    assert wrong < 1e-2
    # Meshes shared by the three robots are sent once, and drawn three times.
    drawn = watched.do("""(() => {
        const count = {};
        for (const robot of ['robot', 'target', 'linear']) {
            count[robot] = 0;
            viewer.scene_tree.find(['meshcat', robot]).object.traverse((o) => {
                if (!o.isMesh || !o.userData.look) return;
                count[robot] += o.geometry.attributes.position.count;
            });
        }
        return count;
    })()""")
    assert drawn["robot"] > 100_000
    assert drawn["target"] == drawn["linear"] < 0.4 * drawn["robot"]
    node = (
        "viewer.scene_tree.find(['meshcat', 'robot', 'root_joint', 'plume 0'])"
        ".object.children[0]"
    )
    assert watched.do(f"{node}.visible")
    # The gas leaves the thruster against its push.
    gas = watched.do(f"""(() => {{
        viewer.scene.updateMatrixWorld(true);
        const m = {node}.children[0].matrixWorld, V = MeshCat.THREE.Vector3;
        const [at, to] = [[0, 0, 0], [0, -1, 0]].map((p) => new V(...p).applyMatrix4(m));
        return [at, to].map((p) => [p.x, -p.z, p.y]);
    }})()""")
    link = placements(robot, motion.q[index])["root_joint"]
    link = link * robot.model.frames[robot.model.getFrameId("panda_link0")].placement
    np.testing.assert_allclose(gas[0], link.act(np.array([0.1, 0, 0])), atol=EXACT)
    away = np.subtract(gas[1], gas[0])
    np.testing.assert_allclose(
        away / np.linalg.norm(away), -link.rotation[:, 2], atol=EXACT
    )
    strong = watched.do(f"{node}.children[0].scale.y")
    watched.do("fflin.seek(2)")
    assert watched.do(f"{node}.children[0].scale.y") < strong
    assert np.median(watched.picture()[:40]) > 150


@pytest.mark.parametrize(
    ("name", "limit"), [("servicer_7dof", 3e6), *exhaustive(("talos", 8e6))]
)
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_the_files_are_small(name, limit, tmp_path):
    robot = fflin.load(name)
    path = tmp_path / "motion.html"
    fflin.visualize(
        robot, settling(robot, duration=20.0, predicted=True), html=path, fps=30
    )
    assert os.path.getsize(path) < limit


@pytest.mark.exhaustive
def test_the_floor_lies_below_all_of_the_motion_and_the_target(tmp_path):
    robot = fflin.load("ur5").replace(gravity=(0.0, 0.0, -9.81))
    start = fflin.configuration(
        robot, base=pin.SE3(np.eye(3), np.array([0.5, 0.0, 2.0]))
    )
    motion = fflin.simulate(robot, None, q0=start, duration=0.2)
    path = tmp_path / "high.html"
    fflin.visualize(robot, motion, html=path, target=robot.neutral())
    shown = page_data(path)
    assert shown["scene"] == "lab" and shown["floor"][2] < 0.1
    assert min(z for _, _, z in shown["points"]) == pytest.approx(
        shown["floor"][2], abs=1e-4
    )
    assert not shown["follow"]


def test_on_a_long_way_the_camera_follows_unless_switched_off(robots, tmp_path):
    robot = robots["servicer_7dof"]
    v0 = fflin.velocity(robot, {"v_b.x": 1000.0})
    motion = fflin.simulate(robot, None, v0=v0, duration=10.0, dt=0.1)
    path = tmp_path / "away.html"
    for messages, expected in ((None, True), (False, False), (True, True)):
        fflin.visualize(robot, motion, html=path, follow=messages)
        shown = page_data(path)
        assert shown["follow"] is expected
        assert (np.ptp(shown["points"], axis=0).max() > 5e3) is not expected


@pytest.mark.exhaustive
def test_two_minutes_at_2048_rows_a_second_are_below_5_megabytes(robots, tmp_path):
    robot = robots["servicer_7dof"]
    motion = settling(robot, duration=120.0, predicted=True)
    rows = np.arange(120 * 2048 + 1) * (len(motion.t) - 1) // (120 * 2048)
    fields = ("q", "v", "x", "u", "energy", "momentum", "momentum_drift", "prediction")
    many = {name: getattr(motion, name)[rows] for name in fields}
    motion = replace(motion, t=np.linspace(0.0, 120.0, len(rows)), **many)
    path = tmp_path / "long.html"
    fflin.visualize(robot, motion, html=path)
    assert path.stat().st_size < 5e6


@pytest.mark.browser
def test_without_a_target_no_ghost_is_drawn(robots, watch, tmp_path):
    robot = robots["planar_detumble"]
    motion = replace(settling(robot, duration=2.0), target=np.zeros(0))
    path = tmp_path / "free.html"
    fflin.visualize(robot, motion, html=path)
    watched = watch(path.as_uri() + "#pause")
    assert "target" not in watched.page.locator("#legend").text_content()
    assert "error" not in watched.page.locator("#overlay").text_content()
    children = watched.do("Object.keys(viewer.scene_tree.find(['meshcat']).children)")
    assert "robot" in children and "target" not in children
    # One that is asked for is there again.
    fflin.visualize(robot, motion, html=path, target=robot.neutral())
    watched.page.reload()
    watched.wait("window.fflin && fflin.ready")
    assert "target" in watched.page.locator("#legend").text_content()
    assert largest_difference(watched, robot, robot.neutral(), "target") < EXACT


@pytest.fixture(scope="module")
def led_page(robots, browser, tmp_path_factory):
    """A motion that follows another, and its page."""
    robot = robots["planar_detumble"]
    motion = led(settling(robot, duration=4.0))
    path = tmp_path_factory.mktemp("led") / "along.html"
    fflin.visualize(robot, motion, html=path)
    with Watched(browser, path.as_uri() + "#pause") as watched:
        yield robot, motion, watched, page_data(path)


@pytest.mark.browser
def test_a_reference_moves_and_is_shown_where_it_is(led_page):
    robot, motion, watched, _ = led_page
    state = fflin.StateMap(robot, reference=motion.reference, frame=motion.frame)
    for t in (0.0, 1.7, 4.0):
        watched.do(f"fflin.seek({t})")
        index = np.argmin(np.abs(motion.t - t))
        target = state.to_pinocchio(motion.target[index])[0]
        # between two frames
        assert largest_difference(watched, robot, target, "target") < 2e-3
        base, to = (pin.XYZQUATToSE3(q[:7]) for q in (motion.q[index], target))
        angle = np.degrees(np.linalg.norm(pin.log3(to.actInv(base).rotation)))
        value = watched.page.locator(".readouts b").first.text_content()
        assert float(value.split()[0]) == pytest.approx(angle, rel=3e-2, abs=1e-3)


def middle_of(watched, *path, mesh):
    """Return the points (N, 3) that a tube runs along, and the share of it that is drawn."""
    points, share = watched.do(f"""(() => {{
        const trail = viewer.scene_tree.find(['meshcat', ...{list(path)!r}]).object.children[0];
        const {{ attributes, index }} = trail.children[{mesh}].geometry, points = [];
        for (let k = 0; k < attributes.position.count; k += 7) {{
            const sum = new MeshCat.THREE.Vector3(), p = new MeshCat.THREE.Vector3();
            for (let j = k; j < k + 6; j++) sum.add(p.fromBufferAttribute(attributes.position, j));
            points.push(sum.divideScalar(6).toArray());
        }}
        return [points, index.count / 36 / (points.length - 1)];
    }})()""")
    return np.array(points), share


@pytest.mark.browser
def test_the_paths_of_the_reference_are_dashed_next_to_those_flown(led_page):
    robot, motion, watched, _ = led_page
    state = fflin.StateMap(robot, reference=motion.reference, frame=motion.frame)
    data, tool = robot.model.createData(), robot.model.getFrameId(tool_frame(robot))

    def course(q):
        ends = []
        for item in q:
            pin.framesForwardKinematics(robot.model, data, item)
            ends.append(data.oMf[tool].translation.copy())
        return {"base": q[:, :3], "tool": np.array(ends)}

    followed = course(np.array([state.to_pinocchio(x)[0] for x in motion.target]))
    flown = course(motion.q)
    for k, name in enumerate(("base", "tool")):
        reference, share = middle_of(watched, "target", f"path {k}", mesh=0)
        assert 0.2 < share < 0.9  # gaps between
        middle, whole = middle_of(watched, "trails", name, mesh=1)
        assert whole == 1.0
        for points, expected in ((reference, followed[name]), (middle, flown[name])):
            away = np.linalg.norm(points[:, None] - expected, axis=2)
            assert away.min(axis=1).max() < 4e-3
            assert away[0, 0] < EXACT < 4e-3 < np.linalg.norm(reference[0] - middle[0])
            assert away[-1, -1] < 4e-3
    # They are named, and the reference's go with its ghost.
    named = watched.page.locator("#legend label").all_text_contents()
    assert named[:2] == ["path of the tool", "path of the base"]
    box = watched.page.get_by_label("reference, at rest from 3.5 s")
    shown = "viewer.scene_tree.find(['meshcat', 'target']).object.visible"
    for check, expected in ((box.uncheck, False), (box.check, True)):
        check(force=True)
        assert watched.do(shown) is expected
    assert watched.page.locator("#legend i.dashed").count() == 1


@pytest.mark.browser
def test_a_reference_adds_little_to_the_page(led_page):
    _, motion, _, shown = led_page
    rows = len(shown["t"]) * 3 / 16
    assert rows < 130 < len(motion.t)
    added = sum(len(item["points"]) for item in shown["followed"])
    added += sum(
        len(line["reference"]) for plot in shown["plots"] for line in plot["lines"]
    )
    # Two paths of three single floats and three joints, in base64.
    assert added <= 16 / 3 * rows * (2 * 3 + 3) + 40
