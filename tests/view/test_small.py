"""Small frames and phones: the robot has most of the frame, and fingers find what they press."""

import numpy as np
import pytest

import fflin
from tests.support.browser import Watched
from tests.support.motions import settling

pytestmark = pytest.mark.browser

FRAMES = [(390, 480), (832, 480), (640, 400)]


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    robot = fflin.load("servicer_7dof")
    path = tmp_path_factory.mktemp("small") / "motion.html"
    fflin.visualize(robot, settling(robot, 20.0, predicted=True), html=path)
    return path


@pytest.fixture(scope="module")
def small(path, browser):
    with Watched(browser, path.as_uri() + "#pause", size=FRAMES[0]) as watched:
        yield watched


def seen_points(watched):
    """Return where the points that the camera must show are seen, in CSS pixels (N, 2)."""
    return np.array(
        watched.do("""(() => {
            viewer.render();
            const { points } = JSON.parse(document.getElementById('data').textContent);
            return points.map(([x, y, z]) => {
                const p = new MeshCat.THREE.Vector3(x, z, -y).project(viewer.camera);
                return [(p.x + 1) / 2 * innerWidth, (1 - p.y) / 2 * innerHeight];
            });
        })()""")
    )


@pytest.mark.parametrize("size", FRAMES)
def test_the_robot_has_at_least_half_of_a_small_frame(small, size):
    small.resize(*size)
    page = small.page
    texts = page.locator(".readouts > *:visible").all_text_contents()
    assert texts[::2] == ["attitude error", "position error"] and len(texts) == 4
    for hidden in (".plot", ".conserved", "#legend"):
        assert not page.locator(f"{hidden}:visible").count()
    panel, bar, header = (
        page.locator(name).bounding_box() for name in ("#panel", "#bar", "header")
    )
    low, high = (
        f(axis=0) for f in map(seen_points(small).__getattribute__, ("min", "max"))
    )
    assert max((high - low) / size) >= 0.5
    assert low.min() > 0 and high[0] < size[0] and high[1] < bar["y"]
    if size[0] <= 700:
        assert high[1] < panel["y"] < bar["y"]
    else:
        assert low[1] > panel["y"] + panel["height"]
    # What is free between the texts and the controls is at least half of the frame.
    top = header["y"] + header["height"]
    bottom = panel["y"] if size[0] <= 700 else bar["y"]
    assert bottom - top >= 0.5 * size[1]


def test_the_panel_of_a_small_frame_opens(small):
    small.resize(390, 480)
    button = small.page.get_by_role("button", name="panel", exact=True)
    assert button.get_attribute("aria-pressed") == "false"
    button.click()
    try:
        assert small.page.locator(".conserved").is_visible()
        assert small.page.locator(".readouts > *:visible").count() > 4
    finally:
        button.click()
    assert not small.page.locator(".plot:visible").count()
    # In a larger window all of it is there again.
    small.resize(390, 844)
    assert small.page.locator("#legend").is_visible()
    small.wait(
        "document.querySelector('#bar .fold').getAttribute('aria-pressed') === 'true'"
    )
    assert small.page.locator(".plot").first.is_visible()


class Phone:
    """A browser whose pages are those of a phone."""

    def __init__(self, browser):
        self.browser = browser

    def new_page(self, **options):
        return self.browser.new_page(has_touch=True, is_mobile=True, **options)


@pytest.mark.parametrize("size", [(390, 844), (390, 480)])
def test_fingers_find_what_they_press(path, browser, size):
    with Watched(Phone(browser), path.as_uri() + "#pause", size=size) as watched:
        sizes = {}
        for name in ("#bar button", "#bar select", "#bar input", "#legend label"):
            found = [
                each.bounding_box()
                for each in watched.page.locator(f"{name}:visible").all()
            ]
            sizes[name] = found
        for name in ("#bar button", "#bar select"):
            for box in sizes[name]:
                assert min(box["width"], box["height"]) >= 44
                assert 0 <= box["x"] and box["x"] + box["width"] <= size[0]
        assert all(box["height"] >= 44 for box in sizes["#bar input"])
        assert all(box["height"] >= 32 for box in sizes["#legend label"])
        assert bool(sizes["#legend label"]) == (size[1] >= 520)
        help_button = watched.page.locator("#bar .help")
        if help_button.is_visible():
            help_button.tap()
            card = watched.page.locator("#help")
            box = card.bounding_box()
            assert box["x"] >= 0 and box["x"] + box["width"] <= size[0]
            assert box["y"] >= 0 and box["y"] + box["height"] <= size[1]
            words = card.locator("dt:visible").all_text_contents()
            assert words == ["one finger", "two fingers", "tap a link", "tap a chart"]
