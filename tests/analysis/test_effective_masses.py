"""Effective masses: closed forms, their sum, and what no change of the base frame changes."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.commands import cli
from tests.support.robots import FRAMES, random_point, random_pose

# A hub and panels on hinges about y: masses [kg], moments of inertia about y [kg m^2], lengths [m].
HUB, PANEL, PANEL_Y, HINGE, ARM = 750.0, 100.0, 50.0, 0.5, 1.5


def panels(k=100.0, base=None, sides=(-1.0, 1.0)):
    base = pin.SE3.Identity() if base is None else base
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    hub = pin.Inertia(HUB, np.zeros(3), np.diag([900.0, 800.0, 600.0]))
    model.appendBodyToJoint(1, hub, base)
    for i, side in enumerate(sides):
        place = base * pin.SE3(np.eye(3), np.array([side * HINGE, 0.0, 0.0]))
        index = model.addJoint(1, pin.JointModelRY(), place, f"panel_{i}")
        lever = np.array([side * ARM, 0.0, 0.0])
        panel = pin.Inertia(PANEL, lever, np.diag([100.0, PANEL_Y, 50.0]))
        model.appendBodyToJoint(index, panel, pin.SE3.Identity())
    return fflin.from_model(model, name="panels", stiffness=k)


def masses(robot, q=None, **options):
    return fflin.effective_masses(fflin.linearize(robot, q, **options))


def test_one_panel_on_a_spring_has_the_closed_form():
    """J = I + m a^2 about its hinge: w^2 = k / J, m_z = (m a)^2 / J, I_y = (I + m a (a + h))^2 / J.

    Over all: m_z and what is left are the mass.
    """
    k = 37.0
    result = masses(panels(k, sides=(1.0,)))
    J, pull = PANEL_Y + PANEL * ARM**2, PANEL * ARM
    turn = PANEL_Y + PANEL * ARM * (ARM + HINGE)
    assert result.frequencies == pytest.approx([np.sqrt(k / J)], rel=1e-12)
    np.testing.assert_allclose(result.masses, [[0.0, 0.0, pull**2 / J]], rtol=1e-12)
    np.testing.assert_allclose(result.inertias, [[0.0, turn**2 / J, 0.0]], rtol=1e-12)
    assert result.residual[2, 2] == pytest.approx(HUB + PANEL - pull**2 / J, rel=1e-12)
    assert not result.free.any()
    # A panel up and towards the base's -z turns it about -y: L L^T has the product.
    assert result.participation[2] * result.participation[4] == pytest.approx(
        -pull * turn / J
    )


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.3, -0.2, 1.0)])
def test_of_a_symmetric_pair_one_mode_alone_has_mass(shift):
    """Clamped, both have one frequency; the other turns the base and does not shift it."""
    base = pin.SE3(np.eye(3), np.array(shift))
    result = masses(panels(base=base))
    J, pull = PANEL_Y + PANEL * ARM**2, PANEL * ARM
    turn = PANEL_Y + PANEL * ARM * (ARM + HINGE)
    lifting, turning = result.masses
    np.testing.assert_allclose(
        lifting, [0.0, 0.0, 2.0 * pull**2 / J], rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(turning, np.zeros(3), atol=1e-12)
    np.testing.assert_allclose(
        result.inertias[1], [0.0, 2.0 * turn**2 / J, 0.0], atol=1e-9
    )
    # In the floating robot too, one mode lifts the base and one turns it.
    slow, fast = fflin.modes(fflin.linearize(panels(base=base))).modes
    sunk = 2.0 * pull / (HUB + 2.0 * PANEL)
    parts = np.array([2.0 * (PANEL_Y + PANEL * (ARM - sunk) ** 2), HUB * sunk**2])
    assert slow.energy["base"] == pytest.approx(parts[1] / parts.sum(), rel=1e-9)
    assert fast.energy["panel_0"] == pytest.approx(fast.energy["panel_1"], rel=1e-9)


def cross_of_panels(mass):
    """Four equal panels around a hub of `mass` [kg], on hinges along its edges.

    The frames of the hinges are rotated at random, so that the panels differ by rounding errors.
    """
    rng = np.random.default_rng(3)
    tilted = random_pose(rng, 60.0).rotation
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    hub = pin.Inertia(mass, np.zeros(3), mass * np.eye(3))
    model.appendBodyToJoint(1, hub, pin.SE3.Identity())
    lever = np.array([ARM, 0.0, 0.0])
    panel = pin.Inertia(mass, lever, mass * np.diag([0.2, 0.5, 0.6]))
    for i in range(4):
        turn = tilted @ pin.utils.rotate("z", 0.5 * np.pi * i)
        place = pin.SE3(turn, turn @ np.array([HINGE, 0.0, 0.0]))
        own = pin.SE3(random_pose(rng, 90.0).rotation, np.zeros(3))
        hinge = pin.JointModelRevoluteUnaligned(own.rotation.T @ np.eye(3)[1])
        index = model.addJoint(1, hinge, place * own, f"panel_{i}")
        model.appendBodyToJoint(index, panel, own.inverse())
    return fflin.from_model(model, name="cross", stiffness=mass)


@pytest.mark.parametrize("mass", [1e-9, 1.0, 1e6])
def test_modes_of_equal_frequency_are_separated_whatever_the_mass_is(mass):
    # One mode lifts the base, two rotate it about axes in the plane, and one does neither.
    result = masses(cross_of_panels(mass))
    J, pull, turn = 0.5 + ARM**2, ARM, 0.5 + ARM * (ARM + HINGE)
    moved, rotated = 4.0 * mass * pull**2 / J, 2.0 * mass * turn**2 / J
    close = {"rtol": 1e-12, "atol": 1e-12 * mass}
    np.testing.assert_allclose(result.masses.sum(axis=1), [moved, 0, 0, 0], **close)
    about = result.inertias.sum(axis=1)
    np.testing.assert_allclose(about, [0, rotated, rotated, 0], **close)


@pytest.mark.parametrize("name", ["servicer_7dof", "dual_arm", "talos"])
def test_effective_masses_and_the_residual_sum_to_the_mass_and_inertia(name):
    rng = np.random.default_rng(2)
    robot = fflin.load(name)
    q, _, _ = random_point(robot, rng)
    some = {
        joint: rng.uniform(1.0, 9.0)
        for joint in robot.joint_names
        if rng.random() < 0.6
    }
    result = masses(robot.replace(stiffness=some), q)
    L = result.participation
    assert L.shape == (6, len(some)) and result.free.any()
    whole = L @ L.T + result.free + result.residual
    np.testing.assert_allclose(
        whole, result.total, atol=1e-10 * np.abs(result.total).max()
    )
    for part in (result.free, result.residual):
        assert np.linalg.eigvalsh(part).min() > -1e-10 * np.abs(result.total).max()
    # The total is the rigid robot's: mass, and inertia about the base frame's origin.
    data = robot.model.createData()
    pin.crba(robot.model, data, q)
    rigid = data.Ycrb[1].matrix()
    np.testing.assert_allclose(result.total, rigid, atol=1e-10 * np.abs(rigid).max())
    assert result.total[:3, :3] == pytest.approx(
        robot.mass * np.eye(3), abs=1e-9 * robot.mass
    )
    # The residual does not depend on which joints have springs.
    sprung = masses(robot.replace(stiffness=3.0), q)
    np.testing.assert_allclose(
        sprung.residual, result.residual, atol=1e-9 * np.abs(rigid).max()
    )
    assert not sprung.free.any()


def test_frequencies_match_a_robot_on_a_base_that_hardly_moves():
    light = fflin.load("servicer_7dof", stiffness=20.0)
    model = light.model.copy()
    model.inertias[1] = pin.Inertia(1e9, np.zeros(3), 1e9 * np.eye(3))
    heavy = fflin.from_model(model, stiffness=20.0, rest={"joint_2": 0.4})
    q = fflin.configuration(heavy, {"joint_2": 0.4})
    free = fflin.modes(fflin.linearize(heavy, q)).frequencies
    assert masses(light, q).frequencies == pytest.approx(free, rel=1e-5)


@pytest.mark.parametrize("frame", FRAMES)
def test_the_base_s_axes_are_meant_wherever_it_stands(frame):
    robot = fflin.load("servicer_7dof", stiffness={"panel_left": 9.0, "joint_2": 4.0})
    joints = {"joint_2": 0.4, "panel_left": 0.2}
    expected = masses(robot, fflin.configuration(robot, joints))
    q = fflin.configuration(robot, joints, random_pose(np.random.default_rng(4), 140.0))
    for reference in (None, pin.SE3.Identity()):
        result = masses(robot, q, frame=frame, reference=reference)
        np.testing.assert_allclose(result.masses, expected.masses, atol=1e-9)
        np.testing.assert_allclose(result.inertias, expected.inertias, atol=1e-9)
        np.testing.assert_allclose(result.total, expected.total, atol=1e-9)


def test_masses_turn_with_the_base_frame_and_do_not_change_with_its_origin():
    rng = np.random.default_rng(7)
    base = random_pose(rng, 100.0)
    expected, result = masses(panels(80.0)), masses(panels(80.0, base=base))
    turned = base.rotation @ expected.participation[:3]
    np.testing.assert_allclose(result.participation[:3] ** 2, turned**2, atol=1e-9)
    X = pin.SE3(base).toDualActionMatrix()
    np.testing.assert_allclose(result.residual, X @ expected.residual @ X.T, atol=1e-8)


def test_soft_modes_next_to_stiff_ones_keep_their_accuracy():
    soft, stiff = 1e-4, 1e8
    robot = fflin.load(
        "servicer_7dof", stiffness={"panel_left": soft, "joint_7": stiff}
    )
    alone = fflin.load(
        "servicer_7dof", lock=["joint_7"], stiffness={"panel_left": soft}
    )
    result, expected = masses(robot), masses(alone)
    assert result.frequencies[0] == pytest.approx(expected.frequencies[0], rel=1e-12)
    np.testing.assert_allclose(result.masses[0], expected.masses[0], atol=1e-11)


def test_reports_and_command_line(capsys):
    springs = ["--stiffness", "panel_left=100", "--stiffness", "panel_right=100"]
    assert cli.main(["modes", "servicer_7dof", *springs]) == 0
    out = capsys.readouterr().out
    robot = fflin.load(
        "servicer_7dof", stiffness={"panel_left": 100.0, "panel_right": 100.0}
    )
    result = masses(robot)
    assert str(result) in out and max(map(len, out.splitlines())) <= 80
    row = next(
        line
        for line in str(result).splitlines()
        if f"{result.frequencies[0]:.6g}" in line
    )
    heavy = result.masses[0, 2]
    assert row.split()[-2:] == [f"{heavy:.4g}", f"{100.0 * heavy / robot.mass:.1f}"]
    assert cli.main(["modes", "servicer_7dof"]) == 0
    assert "clamped" not in capsys.readouterr().out
    assert not masses(fflin.load("cubesat")).frequencies.size
    assert "0 modes" in str(masses(fflin.load("cubesat")))


def test_models_without_the_springs_are_refused(tmp_path):
    motors = [fflin.JointTorque(f"joint_{i}") for i in (1, 2, 3)]
    lin = fflin.linearize(fflin.load("planar_detumble", stiffness=2.0, inputs=motors))
    lin.save(tmp_path / "m.npz")
    for given in (
        fflin.LinearModel.load(tmp_path / "m.npz"),
        fflin.momentum_reduction(lin),
        lin.A,
    ):
        with pytest.raises(fflin.InputError, match=r"expected a|reduced"):
            fflin.effective_masses(given)
    robot = fflin.load("planar_detumble", stiffness=2.0)
    lin = fflin.linearize(robot)
    robot.model.inertias[1] = pin.Inertia.Random()
    for function in (fflin.effective_masses, fflin.modes):
        with pytest.raises(fflin.ModelError, match="changed"):
            function(lin)
