"""The page in windows of any size: all can be read, nothing lies over anything, curves are data."""

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest

import fflin
from tests.support.browser import Watched
from tests.support.motions import led, settling

pytestmark = pytest.mark.browser

SIZES = [(800, 600), (1400, 900)]


def with_inputs(name):
    return fflin.load(name, inputs=fflin.load_inputs(name))


ROBOTS = {
    "cubesat": lambda: with_inputs("cubesat"),
    "servicer_7dof": lambda: with_inputs("servicer_7dof"),
    "canadarm2": lambda: fflin.load("canadarm2"),
    "talos": lambda: fflin.load("talos"),
    "along": lambda: with_inputs("servicer_7dof"),
}


@pytest.fixture(scope="module", params=ROBOTS)
def watched(request, browser, tmp_path_factory):
    """The page of a robot whose joints, thrusters and wheels all move."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        robot = ROBOTS[request.param]()
        motion = settling(robot, 20.0, predicted=True)
    motion = led(motion) if request.param == "along" else motion
    wheels = [motion.state_names.index(f"qdot_m.{name}") for name in robot.wheels]
    x = motion.x.copy()
    x[:, wheels] = np.sin(motion.t)[:, None] * 100.0
    path = tmp_path_factory.mktemp("layout") / "motion.html"
    fflin.visualize(robot, replace(motion, x=x), html=path)
    with Watched(browser, path.as_uri() + "#pause", size=SIZES[0]) as watched:
        watched.name, watched.led = request.param, motion.tracked
        watched.do("fflin.seek(7)")
        yield watched


def boxes(watched, selector):
    """Return left, top, right, bottom of what is to be seen of each element (N, 4)."""
    result = watched.do(f"""[...document.querySelectorAll({selector!r})].map((each) => {{
        const box = each.getBoundingClientRect();
        return [box.left, box.top, box.right, box.bottom];
    }}).filter(([left, top, right, bottom]) => right > left && bottom > top)""")
    return np.array(result).reshape(-1, 4)


def overlap(one, other):
    across = min(one[2], other[2]) - max(one[0], other[0])
    down = min(one[3], other[3]) - max(one[1], other[1])
    return across > 0.5 and down > 0.5


@pytest.mark.parametrize("size", SIZES)
def test_nothing_overlaps_is_clipped_or_wraps(watched, size):
    watched.resize(*size)
    parts = [
        boxes(watched, name)
        for name in ("header h1", "header p", "#panel", "#bar", "#legend")
    ]
    assert all(len(part) == 1 for part in parts)
    for one, other in itertools.combinations(np.concatenate(parts), 2):
        assert not overlap(one, other)
    for left, top, right, bottom in np.concatenate(parts):
        assert left >= 0 and top >= 0 and right <= size[0] and bottom <= size[1]
    inner = ".plot .name > *, .plot canvas"
    for selector in (
        ".readouts > *",
        ".plot > *",
        ".plot .keys > *",
        "#legend label",
        inner,
    ):
        for one, other in itertools.combinations(boxes(watched, selector), 2):
            assert not overlap(one, other), selector
    # Nothing is wider than its place: no scrollbar below, no dots for what is left out.
    wide = "(each) => each.scrollWidth > each.clientWidth + 1 && each.clientWidth > 0"
    for selector in (
        "html",
        "#panel",
        "#panel *",
        "#bar > *",
        "#legend label",
        "header *",
    ):
        assert (
            watched.do(f"[...document.querySelectorAll({selector!r})].some({wide})")
            is False
        )
    # Each label stands on one line.
    for selector in (
        ".readouts > *",
        ".plot .name",
        ".plot .keys > *",
        "#legend label",
        "#bar output",
    ):
        heights = np.diff(boxes(watched, selector)[:, 1::2])
        assert heights.max() < 1.6 * 14.0, selector
    sizes = watched.do("""[...document.querySelectorAll('#overlay *')]
        .filter((each) => each.textContent && !each.children.length)
        .map((each) => parseFloat(getComputedStyle(each).fontSize))""")
    assert min(sizes) >= 10.5


def test_its_scrollbar_is_as_dark_as_the_page(watched):
    assert (
        watched.do("getComputedStyle(document.documentElement).colorScheme") == "dark"
    )
    assert (
        watched.do("getComputedStyle(document.getElementById('panel')).scrollbarWidth")
        == "thin"
    )
    if watched.name == "canadarm2":  # where all of it has room there is none
        watched.resize(800, 900)
        panel = "document.getElementById('panel')"
        assert watched.do(f"{panel}.scrollHeight <= {panel}.clientHeight")


def test_every_curve_can_be_told(watched):
    """By its colour in the keys, or, of many, by its name where one points at it."""
    plots = watched.do("""fflin.plots.map(({ title, family, keys, lines }) => ({
        title, family, keys: keys || null,
        lines: lines.map(({ label, colour, values }) => [label, colour, [...values]]),
    }))""")
    families = {}
    for plot in plots:
        families.setdefault(plot["family"], []).append(plot)
    for kin in families.values():
        assert [bool(plot["keys"]) for plot in kin[1:]] == [False] * len(kin[1:])
        if not kin[0]["lines"][0][0]:
            continue  # an error, which is one line
        keys = {name: colour for name, colour, _ in kin[0]["keys"]}
        assert len({*keys.values()}) == len(keys) > 0
        names = {label for plot in kin for label, _, _ in plot["lines"]}
        assert (
            names == {*keys} if len(names) <= 8 else len(keys) == 8 and {*keys} < names
        )
        for plot in kin:
            for label, colour, _ in plot["lines"]:
                assert colour == keys.get(label, "#8a93a5")
            widest = max(plot["lines"], key=lambda line: np.ptp(line[2]))
            assert widest[0] in keys
    assert (
        watched.page.locator(".pale span").all_text_contents()
        == ["reference"] * watched.led
    )
    texts = watched.page.locator(".keys:not(.pale, .dashed) span").all_text_contents()
    assert texts == [
        name for kin in families.values() for name, *_ in kin[0]["keys"] or []
    ]
    swatches = watched.do("""
        [...document.querySelectorAll('.keys:not(.pale, .dashed) span')].map((each) =>
            each.style.getPropertyValue('--swatch'))""")
    assert swatches == [
        c for kin in families.values() for _, c, _ in kin[0]["keys"] or []
    ]
    # The line that lies highest at the last moment, by pointing above it.
    at = next(k for k, plot in enumerate(plots) if len(plot["lines"]) > 2)
    canvas = watched.page.locator(".plot canvas").nth(at)
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    watched.page.mouse.move(box["x"] + box["width"] - 30, box["y"] + 1)
    highest = max(plots[at]["lines"], key=lambda line: line[2][-1])
    messages = watched.page.locator(".plot .at").nth(at).text_content()
    assert messages.split()[0] == highest[0]
    assert float(messages.split()[1]) == pytest.approx(
        highest[2][-1], rel=6e-3, abs=1e-12
    )


def test_thrusters_are_named_by_the_colour_of_their_plume(watched):
    if watched.name not in ("cubesat", "servicer_7dof"):
        pytest.skip("it has no thrusters")
    tints = watched.do("""(() => {
        const tints = [];
        viewer.scene_tree.find(['meshcat', 'robot']).object.traverse((o) => {
            const tint = o.material && o.material.uniforms && o.material.uniforms.tint;
            if (tint) tints.push(`#${tint.value.clone().convertLinearToSRGB().getHexString()}`);
        });
        return tints;
    })()""")
    keys = watched.do("""fflin.plots.find(({ title }) => title === 'thrusters')
        .lines.map(({ label, colour }) => [label, colour])""")
    assert len(tints) == len(keys) == (12 if watched.name == "cubesat" else 4)
    # to the last digit of a byte
    for tint, (_, colour) in zip(tints, keys, strict=True):
        shown, named = (bytes.fromhex(item[1:]) for item in (tint, colour))
        np.testing.assert_allclose([*shown], [*named], atol=1)


@pytest.mark.parametrize("size", [(640, 480)])
def test_frames_of_a_strip_have_their_time_and_the_first_a_legend(watched, size):
    watched.resize(*size)
    try:
        watched.do("fflin.plain(true, true), fflin.seek(2.5)")
        watched.drawn()
        (stamp,) = boxes(watched, "#stamp")
        assert watched.page.locator("#stamp").text_content() == "t = 2.50 s"
        labels = boxes(watched, "#legend label")
        for one, other in itertools.combinations([stamp, *labels], 2):
            assert not overlap(one, other)
        assert labels[:, 2].max() <= size[0] and labels[:, 3].max() <= size[1]
        texts = watched.page.locator("#legend label").all_text_contents()
        named = watched.do("""fflin.plots.filter(({ title }) => title === 'thrusters')
            .flatMap(({ lines }) => lines.map(({ label }) => label))""")
        assert texts[-2 - len(named) :] == [
            "reference, at rest from 17.5 s" if watched.led else "target",
            *("linear model", *named),
        ]
        for hidden in ("#panel", "#bar", "header"):
            assert not len(boxes(watched, hidden))
        watched.do("fflin.plain(true, false)")
        assert watched.page.locator("#legend label").first.is_hidden()
        assert watched.page.locator("#stamp").is_visible()
    finally:
        watched.do("fflin.plain(false)")
    assert watched.page.locator("#stamp").is_hidden()
    assert watched.page.locator("#legend label.strip").count() == len(named)
    assert not watched.page.locator("#legend label.strip:visible").count()


def test_a_violation_links_to_its_time(watch, tmp_path):
    robot = fflin.load("ets_vii")
    motion = settling(robot, 20.0)
    names = ("tau_m.joint_1", "tau_m.joint_2")
    u = np.zeros_like(motion.u)
    at = [motion.input_names.index(name) for name in names]
    u[motion.t > 12.5, at[0]], u[motion.t > 3.0, at[1]] = 5.0, -9.0
    limits = np.array([[-4.0, 4.0], [-4.0, 4.0]])
    path = tmp_path / "m.html"
    fflin.visualize(
        robot, replace(motion, u=u, limit_names=names, limits=limits), html=path
    )
    watched = watch(path.as_uri() + "#pause", size=(800, 600))
    line = watched.page.locator(".passed")
    expected = "limit exceeded, worst of 2:\ntau_m.joint_2 -9 N m at 3.01 s, limit -4"
    assert line.text_content() == expected
    assert "tau_m.joint_1 5 N m at 12.5 s, limit 4" in line.get_attribute("title")
    line.click()
    assert watched.do("fflin.state.time") == pytest.approx(3.01)
    assert watched.do(
        "(({ scrollWidth, clientWidth }) => scrollWidth <= clientWidth)"
        "(document.querySelector('.passed'))"
    )


def rows_of(watched, at, colour, low, high, least=120):
    """Return {value: columns} where a plot has a colour, of values from its axis."""
    pixels, width, height = watched.do(f"""(() => {{
        const canvas = document.querySelectorAll('.plot canvas')[{at}];
        const {{ width, height }} = canvas, context = canvas.getContext('2d');
        return [[...context.getImageData(0, 0, width, height).data], width, height];
    }})()""")
    image = np.array(pixels, dtype=int).reshape(height, width, 4)[:, : width - 46]
    wanted = [int(part, 16) for part in re.findall("..", colour[1:])]
    near = (np.abs(image[..., :3] - wanted).max(axis=2) < 40) & (image[..., 3] > least)
    values = high - (np.arange(height) + 0.5 - 1.0) / (height - 2) * (high - low)
    return near, values, (high - low) / (height - 2)


def test_curves_and_limits_are_drawn_where_the_data_have_them(watch, tmp_path):
    robot = fflin.load("ets_vii")
    motion = settling(robot, 20.0)
    name = "tau_m.joint_1"
    at = motion.input_names.index(name)
    u = np.zeros_like(motion.u)
    u[:, at] = 6.0 * np.sin(motion.t / 3.0)
    limits = np.array([[-10.0, 12.0], [-1.0, 1.0]])
    motion = replace(motion, u=u, limit_names=(name, "tau_m.joint_2"), limits=limits)
    path = tmp_path / "m.html"
    fflin.visualize(robot, motion, html=path)
    watched = watch(path.as_uri() + "#pause", size=(1400, 900))
    watched.drawn()
    titles = watched.do("fflin.plots.map(({ title }) => title)")
    plot = titles.index("joint torques")
    (colour,) = watched.do(f"fflin.plots[{plot}].lines.map(({{ colour }}) => colour)")
    spare = 0.06 * 22.0
    near, values, step = rows_of(watched, plot, colour, -10.0 - spare, 12.0 + spare)
    columns = near.shape[1]
    for limit in (-10.0, 12.0):  # dashes: some of the row, not all
        row = np.argmin(np.abs(values - limit))
        share = near[row - 1 : row + 2].any(axis=0).mean()
        assert 0.4 < share < 0.8
    times = np.linspace(0.0, 20.0, columns + 1)
    for column in range(10, columns - 10, 12):
        expected = 6.0 * np.sin(times[column] / 3.0)
        seen = values[near[:, column] & (np.abs(values) < 8.0)]
        assert np.abs(seen - expected).min() < 2.0 * step
    assert not near[np.argmin(np.abs(values - 8.5))].any()


def test_a_reference_is_pale_under_its_curve_and_a_line_is_where_it_rests(
    watch, tmp_path
):
    robot = fflin.load("ets_vii")
    motion = settling(robot, 20.0)
    at = motion.state_names.index("q_m.joint_1")
    x = motion.x.copy()
    x[:, 6 : 6 + robot.n] = 0.0
    x[:, at] = 1.0 + 0.5 * np.sin(motion.t)
    target = x.copy()
    target[:, at] = -2.0 + 0.5 * np.cos(np.minimum(motion.t, 15.0))
    target[motion.t > 14.995, :6] = target[-1, :6]
    path = tmp_path / "m.html"
    fflin.visualize(robot, replace(motion, x=x, target=target), html=path)
    watched = watch(path.as_uri() + "#pause", size=(1400, 900))
    watched.drawn()
    titles = watched.do("fflin.plots.map(({ title }) => title)")
    assert titles[:3] == ["attitude error", "position error", "largest joint error"]
    plot = titles.index("joints")
    (colour,) = watched.do(f"fflin.plots[{plot}].lines.map(({{ colour }}) => colour)")
    low, high = (item + 0.06 * 4.0 * s for item, s in ((-2.5, -1), (1.5, 1)))
    near, values, _ = rows_of(watched, plot, colour, low, high, least=85)
    band, _, _ = rows_of(watched, plot, colour, low, high, least=30)
    full, _, _ = rows_of(watched, plot, colour, low, high, least=150)
    times = np.linspace(0.0, 20.0, near.shape[1] + 1)
    for column in range(10, near.shape[1] - 10, 12):
        t = times[column]
        pale = values[near[:, column] & (values < -1.0)]
        assert abs(pale.mean() + 2.0 - 0.5 * np.cos(min(t, 15.0))) < 0.12
        assert not full[values < -1.0, column].any()
        between = np.abs(values + 0.5) < 0.5  # the two are at least 1.5 apart
        assert band[between, column].mean() > 0.9 and not near[between, column].any()
        assert full[values > 0.3, column].any()
    assert near[values < -1.0].sum() > 1.5 * near[values > 0.3].sum()  # it is the wider
    assert watched.do(
        "JSON.parse(document.getElementById('data').textContent).rest"
    ) == pytest.approx(15.0)
    line, _, _ = rows_of(watched, plot, "#93a1ba", low, high, least=60)
    free = line[np.abs(values + 0.7) < 0.5]  # between the curves
    result = np.flatnonzero(free.mean(axis=0) > 0.2)
    assert len(result) and np.abs(times[result] - 15.0).max() < 0.2


@pytest.mark.parametrize("name", ["servicer_7dof", "talos"])
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_sliders_of_the_live_page_can_be_aimed_at(browser, name):
    with (
        fflin.visualize(fflin.load(name), open=False) as live,
        Watched(browser, live.url, size=(800, 600)) as watched,
    ):
        watched.wait("fflin.state !== null")
        sliders = boxes(watched, "#panel input[type=range]")
        assert len(sliders) == live.robot.n
        assert np.diff(sliders[:, ::2]).min() >= 60.0
        panel = "document.getElementById('panel')"
        assert watched.do(f"{panel}.scrollWidth <= {panel}.clientWidth")
        (box,) = boxes(watched, "#panel")
        assert box[1] >= 0 and box[3] <= 600
        for one, other in itertools.combinations(boxes(watched, ".slider > *"), 2):
            assert not overlap(one, other)
        clipped = "(each) => each.scrollWidth > each.clientWidth"
        clipped = watched.do(
            f"[...document.querySelectorAll('.slider span')].some({clipped})"
        )
        assert not clipped
