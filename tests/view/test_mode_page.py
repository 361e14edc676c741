"""Mode shapes as the page plays them: those of the eigenvectors, with the base that floats."""

import warnings

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import minimize_scalar

import fflin
from fflin.commands.cli import main
from fflin.robot.joints import ROOT
from tests.support.browser import Watched
from tests.support.messages import says

STIFF = {"panel_left": 100.0, "panel_right": 90.0, "joint_2": 500.0}


@pytest.fixture(scope="module")
def shown(browser, tmp_path_factory):
    """A robot that bends, its modes, and their page, which does not play yet."""
    robot = fflin.load("servicer_7dof", stiffness=STIFF, damping={"panel_left": 8.0})
    base = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 0.5), np.array([1.0, 2.0, 3.0]))
    q = fflin.configuration(robot, {"joint_4": 0.6}, base)
    result = fflin.modes(fflin.linearize(robot, q))
    path = tmp_path_factory.mktemp("modes") / "modes.html"
    assert fflin.visualize(robot, result, html=path) == path
    with Watched(browser, path.as_uri() + "#pause", painted=True) as watched:
        yield robot, result, watched


def poses(robot, q):
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    return np.array([placement.homogeneous for placement in data.oMi.tolist()[ROOT:]])


def drawn(watched, robot, mode, phase):
    """Return where the page has the bodies (k, 4, 4)."""
    watched.do(f"fflin.pick({mode}), fflin.seek({phase!r})")
    names = list(robot.model.names)[ROOT:]
    result = [watched.pose(["meshcat", "robot", name]) for name in names]
    return np.array([pin.XYZQUATToSE3(np.array(pose)).homogeneous for pose in result])


def deflected(robot, lin, mode, amplitude, phase):
    """Return where x0 + Re(amplitude shape exp(2 pi i phase)) has them."""
    state = fflin.StateMap(robot, reference=lin.reference, frame=lin.frame)
    x = lin.x0.copy()
    half = len(x) // 2
    x[:half] += amplitude * (mode.shape[:half] * np.exp(2j * np.pi * phase)).real
    return state.to_pinocchio(x)[0]


@pytest.mark.browser
def test_the_robot_swings_as_the_eigenvector_says(shown):
    robot, result, watched = shown
    rest = poses(robot, result.lin.q)
    assert len(result.vibrations) == 3
    for index, mode in enumerate(result.vibrations):
        at = drawn(watched, robot, index, 0.0)

        def away(amplitude, mode=mode, at=at):
            return np.abs(
                poses(robot, deflected(robot, result.lin, mode, amplitude, 0.0)) - at
            ).max()

        amplitude = minimize_scalar(away, bounds=(0.01, 1.0), options={"xatol": 1e-9}).x
        assert away(amplitude) < 1e-5
        assert np.abs(at - rest).max() > 0.05  # it is to be seen
        for phase in (0.25, 0.5, 0.75, 13 / 48):
            q = deflected(robot, result.lin, mode, amplitude, phase)
            np.testing.assert_allclose(
                drawn(watched, robot, index, phase), poses(robot, q), atol=1e-5
            )
        # Between the poses that are sent too.
        q = deflected(robot, result.lin, mode, amplitude, 0.3)
        moved = np.abs(at - rest).max()
        np.testing.assert_allclose(
            drawn(watched, robot, index, 0.3), poses(robot, q), atol=5e-3 * moved
        )


@pytest.mark.browser
def test_the_base_oscillates_against_the_flexible_mode(shown):
    """Nothing pushes from outside: the centre of mass stays while the base moves."""
    robot, result, watched = shown
    data = robot.model.createData()
    inertias = robot.model.inertias.tolist()[ROOT:]

    def centre(at):
        masses = [inertia.mass for inertia in inertias]
        points = [
            T[:3, :3] @ i.lever + T[:3, 3] for T, i in zip(at, inertias, strict=True)
        ]
        return np.average(points, axis=0, weights=masses)

    rest = poses(robot, result.lin.q)
    com = pin.centerOfMass(robot.model, data, result.lin.q)
    np.testing.assert_allclose(centre(rest), com, atol=1e-12)
    for index in range(len(result.vibrations)):
        expected_value, back = (
            drawn(watched, robot, index, phase) for phase in (0.0, 0.5)
        )
        # Half of there less back is the swing to the second order.
        swing = (expected_value - back) / 2.0
        held = rest + swing
        # as if the base did not move
        held[:] = np.linalg.inv(rest[0] + swing[0]) @ held
        way = np.linalg.norm(centre(rest + swing) - com)
        moved = np.linalg.norm(centre(rest[0] @ held) - com)
        assert way < 0.05 * moved  # sin x is x to the third order of half a radian
        assert moved > 1e-3 < np.abs(swing[0]).max()


@pytest.mark.browser
def test_a_mode_is_picked_by_name_and_frequency(shown):
    _, result, watched = shown
    rows = watched.page.locator(".choices button")
    assert rows.count() == 3
    assert watched.page.locator(".figures").first.locator(
        "span"
    ).all_text_contents() == [
        *("rad/s", "Hz", "damping"),
    ]
    for index, mode in enumerate(result.vibrations):
        row = rows.nth(index)
        row.click()
        assert watched.do("fflin.state.mode") == index
        assert row.get_attribute("aria-pressed") == "true"
        figures = [float(text) for text in row.locator("span").all_text_contents()]
        expected = [mode.frequency, mode.frequency / (2.0 * np.pi), mode.damping_ratio]
        np.testing.assert_allclose(figures, expected, rtol=6e-3, atol=1e-9)
        half = len(mode.shape) // 2
        largest = result.state_names[int(np.abs(mode.shape[:half]).argmax())]
        body, part = next(iter(mode.energy.items()))
        assert (
            row.locator("b")
            .text_content()
            .startswith(f"{body} {100.0 * part:.0f}\u00a0%")
        )
        shape = watched.page.locator(".shape span").first.text_content()
        assert shape == largest
    watched.page.keyboard.press("ArrowUp")
    assert watched.do("fflin.state.mode") == 1


@pytest.mark.browser
def test_it_plays_at_a_rate_to_be_watched(shown):
    _, _, watched = shown
    watched.do("window.clock = 0, performance.now = () => window.clock, fflin.seek(0)")
    watched.page.locator("#bar button.play").click()
    watched.do("window.clock = 500")  # ms
    watched.wait("fflin.state.phase > 0")
    assert watched.do("[fflin.state.phase, fflin.state.playing]") == [0.25, True]
    watched.page.locator("#bar button.play").click()
    watched.do("window.clock = 900")
    watched.drawn()
    assert watched.do("fflin.state.phase") == 0.25
    watched.do("delete performance.now")
    slider = watched.page.locator("#bar input[type=range]")
    slider.fill("0.6")
    assert watched.do("fflin.state.phase") == pytest.approx(0.6)
    text = watched.page.locator("#bar output").text_content()
    assert text.startswith("shown at 0.50 Hz, ")


def test_an_invalid_animation_gives_a_one_line_error_and_no_file(
    robots, tmp_path, monkeypatch
):
    # without Chromium the reasons are the same
    monkeypatch.setenv("PATH", str(tmp_path))
    page, bent = tmp_path / "m.html", fflin.load("servicer_7dof", stiffness=STIFF)
    rigid = robots["ets_vii"]
    result = fflin.modes(fflin.linearize(bent))
    reduced = fflin.modes(
        fflin.momentum_reduction(
            fflin.linearize(bent.replace(inputs=[fflin.JointTorque("joint_1")]))
        )
    )
    for robot, given, match, files in (
        (rigid, fflin.modes(fflin.linearize(rigid)), "vibration", {"html": page}),
        (rigid, result, "'ets_vii'", {"html": page}),
        (bent, reduced, "'servicer_7dof'", {"html": page}),
        (bent, result, "modes", {"png": tmp_path / "m.png"}),
    ):
        with pytest.raises(fflin.InputError, match=match) as caught:
            fflin.visualize(robot, given, **files)
        assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_modes_on_the_command_line(tmp_path, capsys, monkeypatch):
    page = tmp_path / "modes.html"
    command = ["modes", "servicer_7dof", "--stiffness", "panel_*=100"]
    assert main([*command, "--html", str(page)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith(f"wrote {page}: ") and page.stat().st_size < 2e6
    assert main(["modes", "cubesat", "--html", str(tmp_path / "c.html")]) == 2
    out, error = capsys.readouterr()
    assert says(out, "cubesat", "6 rigid-body")
    assert says(error, "fflin: error: ", "'cubesat'")
    assert not (tmp_path / "c.html").exists()
    # What cannot be written is told before anything is computed.
    monkeypatch.setattr("fflin.analysis.modes.modes", lambda _: pytest.fail("computed"))
    assert main([*command, "--html", str(tmp_path / "no" / "m.html")]) == 2
    assert main([*command, "--html", str(tmp_path / "m.txt")]) == 2


@pytest.mark.exhaustive
def test_every_bundled_robot_that_bends_can_be_shown(robots, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, robot in robots.items():
            if robot.n == 0:
                continue
            bent = robot.replace(stiffness=10.0)
            result = fflin.modes(fflin.linearize(bent))
            fflin.visualize(bent, result, html=tmp_path / f"{name}.html")
            assert (tmp_path / f"{name}.html").stat().st_size < 5e6
