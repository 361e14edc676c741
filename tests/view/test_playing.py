"""How a page begins, ends and is addressed; the top view; the pose of a live page as code."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.browser import Watched
from tests.support.motions import settling

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def url(robots, tmp_path_factory):
    robot = robots["planar_detumble"]
    path = tmp_path_factory.mktemp("playing") / "motion.html"
    fflin.visualize(robot, settling(robot, 9.0), html=path)
    return path.as_uri()


class Calm:
    """A browser of somebody who asked for little motion."""

    def __init__(self, browser):
        self.browser = browser

    def new_page(self, **options):
        return self.browser.new_page(reduced_motion="reduce", **options)


def test_a_page_plays_by_itself_unless_motion_is_to_be_reduced(url, browser, watch):
    assert watch(url).do("fflin.state.playing || fflin.state.time === fflin.last")
    with Watched(Calm(browser), url) as watched:
        assert watched.do("[fflin.state.playing, fflin.state.time]") == [False, 0]
        watched.do("fflin.play()")
        assert watched.do("fflin.state.playing")


def test_the_address_leads_to_a_time_and_keeps_it(url, watch):
    watched = watch(url + "#t=2.5")
    assert watched.do("[fflin.state.playing, fflin.state.time]") == [False, 2.5]
    watched.do("location.hash = '#t=4'")
    watched.wait("fflin.state.time === 4")
    # Where it is stopped, a link to that moment stands in the address.
    watched.do("fflin.play(), fflin.seek(6.25), fflin.pause()")
    assert watched.do("location.hash") == "#t=6.25"
    watched.page.reload()
    watched.wait("window.fflin && fflin.ready")
    assert watched.do("[fflin.state.playing, fflin.state.time]") == [False, 6.25]


def test_a_loop_begins_anew_at_its_end(url, watch):
    watched = watch(url + "#pause")
    watched.do("window.clock = 0, performance.now = () => window.clock")
    button = watched.page.get_by_role("button", name="loop")
    assert button.get_attribute("aria-pressed") == "false"
    watched.page.keyboard.press("l")
    assert button.get_attribute("aria-pressed") == "true"
    watched.do("fflin.seek(8.5), fflin.play(), window.clock = 600")
    watched.wait("fflin.state.time < 8")
    assert watched.do("fflin.state.playing")
    button.click()
    watched.do("fflin.seek(8.5), window.clock += 600")
    watched.wait("!fflin.state.playing")
    assert watched.do("fflin.state.time") == 9


def test_the_ground_is_dim_in_the_top_view(url, watch):
    watched = watch(url + "#pause", size=(500, 540))

    def corners():
        picture = watched.picture()
        return np.median([picture[-40:, :60].mean(), picture[-40:, -60:].mean()])

    watched.do("fflin.seek(9)")
    overview = corners()
    watched.page.keyboard.press("3")
    dim = corners()
    # Without its veil the ground is bright.
    watched.do("""viewer.scene.traverse((o) => {
        if (o.material?.uniforms?.opacity && o.renderOrder === -5) o.visible = false;
    })""")
    bare = corners()
    assert dim < 0.6 * bare
    watched.page.keyboard.press("0")
    # the picture of the overview has no veil
    assert corners() == pytest.approx(overview, abs=0.5)


def test_the_legend_stands_on_glass_as_the_panel_does(url, watch):
    watched = watch(url + "#pause")
    for key in ("backgroundColor", "borderRadius", "borderTopColor", "backdropFilter"):
        panel, legend = (
            watched.do(f"getComputedStyle(document.getElementById('{name}')).{key}")
            for name in ("panel", "legend")
        )
        assert legend == panel, key
    watched.do("fflin.plain(true, true)")
    style = "getComputedStyle(document.getElementById('legend')).backgroundColor"
    assert watched.do(style) == "rgba(0, 0, 0, 0)"


def test_a_live_page_gives_its_pose_as_code(browser):
    robot = fflin.load("planar_detumble")
    rng = np.random.default_rng(0)
    base = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))
    angles = dict(zip(robot.joint_names, (0.3, -0.2, 0.1), strict=True))
    with (
        fflin.visualize(robot, open=False) as live,
        Watched(browser, live.url) as watched,
    ):
        watched.wait("fflin.state !== null")
        for q in (
            fflin.configuration(robot, angles),
            fflin.configuration(robot, angles, base),
        ):
            expected = list(q)
            before = watched.do("fflin.messages")
            live.show(q)
            watched.wait(f"fflin.messages > {before}")
            code = watched.page.locator("#code")
            if not code.is_visible():
                watched.page.get_by_role("button", name="code").click()
            names = {}
            exec(code.text_content(), names)
            np.testing.assert_allclose(names["q"], expected, atol=2e-6)
