"""The page on a slow machine: the heading comes first, and slow frames are drawn with less."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

import fflin
from fflin.simulation.report import headline
from fflin.view.page import Page
from fflin.view.shapes import load_mesh, shapes
from tests.support.browser import Watched
from tests.support.motions import settling

# What stands on the page when the script of the viewer begins, and whether the browser has reported
# the first paint by then. The page also starts after a time, which a busy machine may exceed.
SPY = """
const later = window.setTimeout;
window.setTimeout = (act, delay = 0, ...given) => delay < 1000 ? later(act, delay, ...given) : 0;
const append = Element.prototype.append;
Element.prototype.append = function (...given) {
    if (given[0] instanceof HTMLScriptElement && !window.at_start) {
        const text = (id) => document.querySelector(id).textContent;
        const paints = performance.getEntriesByType("paint").map((entry) => entry.name);
        window.at_start = [text("h1"), text("#verdict"), paints, Boolean(window.MeshCat)];
    }
    return append.apply(this, given);
};"""


@pytest.fixture(scope="module")
def panda(tmp_path_factory):
    robot = fflin.load("panda")
    motion = settling(robot, 4.0, predicted=True)
    path = tmp_path_factory.mktemp("speed") / "motion.html"
    fflin.visualize(robot, motion, html=path)
    return robot, motion, path


class Spied:
    """A browser whose pages first run a script."""

    def __init__(self, browser, script):
        self.browser, self.script = browser, script

    def new_page(self, **options):
        page = self.browser.new_page(**options)
        page.add_init_script(self.script)
        return page


@pytest.mark.browser
def test_title_and_verdict_are_painted_before_the_viewer_begins(panda, browser):
    robot, motion, path = panda
    with Watched(Spied(browser, SPY), path.as_uri() + "#pause") as watched:
        title, verdict, paints, has_viewer = watched.do("window.at_start")
        assert (title, verdict) == (robot.name, headline(motion))
        assert "first-contentful-paint" in paints and not has_viewer
        assert not watched.page.locator("#wait").count()


@pytest.mark.browser
def test_a_page_that_is_not_painted_starts_all_the_same(panda, browser):
    unpainted = "PerformanceObserver.prototype.observe = () => {};"
    with Watched(Spied(browser, unpainted), panda[2].as_uri() + "#pause") as watched:
        assert watched.do("fflin.ready")


@pytest.mark.exhaustive
def test_coarse_meshes_are_few_triangles_near_the_fine_ones(panda):
    files = {shape.mesh for shape in shapes(panda[0])[0] if shape.mesh}
    counts = []
    for file in files:
        fine, coarse = load_mesh(file), load_mesh(file, coarse=True)
        assert len(fine) == len(coarse)
        extent = max(np.ptp(mesh.vertices, axis=0).max() for mesh in fine)
        for mesh, few in zip(fine, coarse, strict=True):
            away, _ = cKDTree(mesh.vertices).query(few.vertices)
            assert away.max() < 1e-6 * extent  # its vertices are vertices of the mesh
            back, _ = cKDTree(few.vertices).query(mesh.vertices)
            assert back.max() < 0.25 * extent
        sizes = [sum(len(mesh.faces) for mesh in part) for part in (fine, coarse)]
        counts.append(sizes)
    before, after = np.sum(counts, axis=0)
    assert after < 0.4 * before


@pytest.mark.exhaustive
def test_translucent_robots_share_their_meshes(panda):
    robot, motion, _ = panda
    from fflin.view.page import Drawing

    page = Page(robot, motion.q[0], "lab", None, None)
    Drawing(page, robot, "target", "ghost", coarse=True)
    sent = len(page.sent)
    Drawing(page, robot, "linear", "linear", coarse=True)
    assert len(page.sent) == sent


STATE = """(() => {
    const { renderer } = viewer;
    let triangles = 0;
    viewer.scene_tree.find(['meshcat', 'robot']).object.traverse((o) => {
        if (o.isMesh && o.userData.mesh) triangles += o.geometry.attributes.position.count / 3;
    });
    return [renderer.getPixelRatio(), renderer.shadowMap.autoUpdate, triangles];
})()"""

# Number of meshes of the robot whose materials reflect.
REFLECTING = """(() => {
    let count = 0;
    viewer.scene_tree.find(['meshcat', 'robot']).object.traverse((o) => {
        if (o.isMesh && o.material.isMeshStandardMaterial) count += 1;
    });
    return count;
})()"""


@pytest.mark.browser
def test_slow_frames_lower_the_quality_until_the_motion_stands_still(panda, watch):
    watched = watch(panda[2].as_uri() + "#pause", size=(480, 300))
    full = watched.do(STATE)
    shiny = watched.do(REFLECTING)
    assert full[:2] == [1, True] and full[2] > 30_000 and shiny > 5

    def frames(time, count):
        watched.do(f"for (let k = 0; k < {count}; k++) fflin.quality.measure({time})")
        return watched.do(STATE)

    assert frames(30, 200) == full
    lower = frames(400, 5)
    assert lower[0] < 1 and not lower[1] and lower[2] == full[2]
    assert watched.do(REFLECTING) == shiny
    lowest = frames(400, 50)
    assert lowest[0] < 0.5 and lowest[2] < 0.4 * full[2]
    assert watched.do(REFLECTING) == 0
    assert frames(30, 50) == lowest
    # Paused, it is drawn in full; played on, it is as quick as before.
    watched.do("fflin.play(), fflin.pause()")
    assert watched.do(STATE) == full and watched.do(REFLECTING) == shiny
    assert frames(30, 1) == lowest
    watched.do("fflin.play(), fflin.pause()")
    assert watched.do(STATE) == full


@pytest.mark.browser
def test_two_very_slow_frames_lower_the_quality_at_once(panda, watch):
    watched = watch(panda[2].as_uri() + "#pause", size=(480, 300))
    levels = "fflin.quality.state.level"
    watched.do("fflin.quality.measure(900)")
    assert watched.do(levels) == 0
    watched.do("fflin.quality.measure(900)")
    assert watched.do(levels) == 1
    watched.do("for (let k = 0; k < 4; k++) fflin.quality.measure(900)")
    assert watched.do(levels) == 3
