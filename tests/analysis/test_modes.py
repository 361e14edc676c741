"""Natural modes: closed forms, the free-free pencil by another route, zeros, and bad input."""

import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import eigh
from scipy.optimize import linear_sum_assignment

import fflin
from fflin.analysis.modes import energies_of
from fflin.commands import cli
from fflin.commands.models import model_report
from tests.support.messages import hear_lines, says
from tests.support.robots import BUNDLED, FRAMES, random_point, random_pose

# Hub and panels of a published test case (AVSLab/basilisk, hinged rigid bodies): masses [kg],
# moments of inertia about y [kg m^2], hinge and panel arms [m].
HUB, HUB_Y, PANEL, PANEL_Y, HINGE, ARM = 750.0, 800.0, 100.0, 50.0, 0.5, 1.5


def two_panels(**fields):
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    com = np.array([0.0, 0.0, 1.0])
    hub = pin.Inertia(HUB, com, np.diag([900.0, HUB_Y, 600.0]))
    model.appendBodyToJoint(1, hub, pin.SE3.Identity())
    for name, side in (("left", -1.0), ("right", 1.0)):
        place = pin.SE3(np.eye(3), com + np.array([side * HINGE, 0.0, 0.0]))
        index = model.addJoint(1, pin.JointModelRY(), place, name)
        lever = np.array([side * ARM, 0.0, 0.0])
        panel = pin.Inertia(PANEL, lever, np.diag([100.0, PANEL_Y, 50.0]))
        model.appendBodyToJoint(index, panel, pin.SE3.Identity())
    return fflin.from_model(model, name="two_panels", **fields)


def felt_inertias():
    """What a panel feels at its hinge when both flap alike, and when one goes up, one down.

    About y the joint angles (a, -a) lift both tips by a ARM: the hub sinks. The angles (a, a) turn
    both one way: the hub turns the other. Of T = 1/2 m v^2 + ... the hub's rate is eliminated by
    the momentum that is conserved.
    """
    inertias = PANEL_Y + PANEL * ARM**2
    lifting = inertias - 2.0 * (PANEL * ARM) ** 2 / (HUB + 2.0 * PANEL)
    coupling = PANEL_Y + PANEL * ARM * (HINGE + ARM)
    total = HUB_Y + 2.0 * (PANEL_Y + PANEL * (HINGE + ARM) ** 2)
    turning = inertias - 2.0 * coupling**2 / total
    return lifting, turning


@pytest.mark.parametrize("frame", FRAMES)
def test_two_hinged_panels_have_the_frequencies_derived_by_hand(frame):
    k = 1562.0
    robot = two_panels(stiffness=k)
    q = fflin.configuration(robot, None, random_pose(np.random.default_rng(1), 130.0))
    result = fflin.modes(
        fflin.linearize(robot, q, frame=frame, reference=pin.SE3.Identity())
    )
    expected = np.sqrt(k / np.array(felt_inertias()))
    assert result.frequencies == pytest.approx(expected, rel=1e-13)
    assert result.frequencies == pytest.approx([2.61954, 3.45462], abs=5e-6)
    assert not result.damping_ratios.any() and not result.unstable
    assert result.rigid_body == 6 and result.zero_eigenvalues == 12
    lifting, turning = (
        dict(zip(result.state_names, m.shape, strict=True)) for m in result.modes
    )
    assert lifting["q_m.left"] == pytest.approx(-lifting["q_m.right"], rel=1e-12)
    assert turning["q_m.left"] == pytest.approx(turning["q_m.right"], rel=1e-12)


def test_mode_shapes_conserve_momentum():
    """Of the panels lifting by ARM each, the hub sinks by 2 m ARM / (M + 2 m)."""
    result = fflin.modes(fflin.linearize(two_panels(stiffness=50.0)))
    shape = dict(zip(result.state_names, result.modes[0].shape, strict=True))
    assert shape["q_m.left"] == pytest.approx(1.0, abs=1e-15) and shape[
        "q_b.y"
    ] == pytest.approx(0.0, abs=1e-14)
    sunk = -2.0 * PANEL * ARM / (HUB + 2.0 * PANEL)
    assert shape["r_b.z"] == pytest.approx(sunk, rel=1e-12)
    assert shape["v_b.z"] == pytest.approx(result.modes[0].pole * sunk, rel=1e-12)
    turned = dict(zip(result.state_names, result.modes[1].shape, strict=True))
    coupling = PANEL_Y + PANEL * ARM * (HINGE + ARM)
    total = HUB_Y + 2.0 * (PANEL_Y + PANEL * (HINGE + ARM) ** 2)
    # q_b is half the angle.
    assert turned["q_b.y"] == pytest.approx(-coupling / total, rel=1e-12)


def test_damping_ratios_have_the_closed_form():
    """J a'' + d a' + k a = 0: ratio d / (2 sqrt(k J)); beyond 1 two time constants."""
    k, d = 100.0, 7.0
    result = fflin.modes(fflin.linearize(two_panels(stiffness=k, damping=d)))
    J = np.array(felt_inertias())
    assert result.frequencies == pytest.approx(np.sqrt(k / J), rel=1e-12)
    assert result.damping_ratios == pytest.approx(d / 2.0 / np.sqrt(k * J), rel=1e-12)
    assert result.modes[0].time_constant == pytest.approx(2.0 * J[0] / d, rel=1e-12)
    d = 2e3
    result = fflin.modes(fflin.linearize(two_panels(stiffness=k, damping=d)))
    assert (
        not result.vibrations and result.zero_eigenvalues == 12 and not result.unstable
    )
    roots = np.concatenate([np.roots([inertia, d, k]) for inertia in J])
    times = sorted(mode.time_constant for mode in result.modes)
    assert times == pytest.approx(sorted(-1.0 / roots), rel=1e-10)
    assert {mode.damping_ratio for mode in result.modes} == {1.0}


def test_a_joint_that_only_drags_has_one_zero_and_one_time_constant():
    robot = two_panels(damping={"left": 3.0})
    lin = fflin.linearize(robot)
    result = fflin.modes(lin)
    (mode,) = result.modes
    assert mode.pole.real == pytest.approx(-3.0 * lin.B[-2, -2], rel=1e-13)
    assert (result.rigid_body, result.zero_eigenvalues) == (8, 15)
    assert result.poles.shape == (16,)


def matched(result, expected):
    """Largest distance between two sets of eigenvalues, paired."""
    distance = np.abs(result[:, None] - expected)
    return distance[linear_sum_assignment(distance)].max()


@pytest.mark.parametrize("damped", [False, True])
@pytest.mark.parametrize("name", BUNDLED)
def test_poles_are_the_eigenvalues(name, damped):
    rng = np.random.default_rng(4)
    bare = fflin.load(name)
    for share in (1.0, 0.5):
        some = [joint for joint in bare.joint_names if rng.random() < share]
        inertia = fflin.linearize(bare).M.diagonal()[6:]
        inertias = dict(zip(bare.joint_names, inertia, strict=True))
        robot = bare.replace(
            stiffness={j: inertias[j] * rng.uniform(1, 9) for j in some}
        )
        if damped:
            robot = robot.replace(
                damping={j: inertias[j] * rng.uniform(0.1, 2) for j in some}
            )
        q, _, _ = random_point(bare, rng)
        robot = robot.replace(
            rest={joint.name: joint.value(q) for joint in bare.joints}
        )
        lin = fflin.linearize(robot, q)
        result = fflin.modes(lin)
        expected = np.linalg.eigvals(lin.A)
        size = np.abs(expected).max(initial=1.0)
        # The zeros of eigvals, Jordan blocks of two, are off by the root of its round-off.
        assert matched(result.poles, expected) < 1e-6 * size
        nonzero = expected[np.abs(expected) > 1e-6 * size]
        assert len(nonzero) == 2 * len(some)
        mine = result.poles[np.abs(result.poles) > 0.0]
        if some:
            assert matched(mine, nonzero) < 1e-9 * size
        assert result.rigid_body == 6 + robot.n - len(some)
        assert result.zero_eigenvalues == 12 + 2 * (robot.n - len(some))
        assert not result.unstable and result.equilibrium
        assert result.residual < 1e-14 + 1e-16 * lin.certificate.condition
        if damped and some:
            # The joints alone, the base and the free joints floating, have no zeros to disturb.
            on = [6 + bare.joint_names.index(joint) for joint in some]
            inverse = fflin.linearize(bare, q).B[6 + robot.n :][np.ix_(on, on)]
            K, D = (
                [values[j] for j in some] for values in (robot.stiffness, robot.damping)
            )
            size = len(on)
            alone = np.block(
                [[np.zeros((size, size)), np.eye(size)], [-inverse * K, -inverse * D]]
            )
            expected = np.linalg.eigvals(alone)
            assert matched(np.log(mine), np.log(expected)) < 3e-13
        if not damped and some:
            # The free-free pencil over all joints, M* by the Schur complement of the base.
            M = fflin.linearize(bare, q).M
            M_star = M[6:, 6:] - M[6:, :6] @ np.linalg.solve(M[:6, :6], M[:6, 6:])
            squares = eigh(np.diag(robot.springs.stiffness), M_star, eigvals_only=True)
            expected = np.sqrt(squares[-len(some) :])
            assert result.frequencies == pytest.approx(expected, rel=1e-10)


def test_only_rigid_body_modes_without_springs(robots):
    for name, robot in robots.items():
        result = fflin.modes(fflin.linearize(robot))
        assert result.rigid_body == 6 + robot.n and not result.modes, name
        assert not result.poles.any() and len(result.poles) == 12 + 2 * robot.n
        assert says(str(result), name, f"{6 + robot.n} rigid-body")


def test_chains_of_four_zeros_stay_zeros():
    """Hover: attitude, rate, velocity, position integrate one another; eigvals is off by 1e-4."""
    up = fflin.Thruster("base_link", (0, 0, 0), (0, 0, 1))
    robot = fflin.load("hector", gravity=(0, 0, -9.81), inputs=[up, fflin.BaseTorque()])
    lin = fflin.linearize(robot, u=fflin.equilibrium(robot).u)
    result = fflin.modes(lin)
    assert result.equilibrium and not result.modes
    # pitch and roll accelerate
    assert (result.rigid_body, result.zero_eigenvalues) == (4, 12)


def test_a_stiff_and_a_soft_spring():
    """1e8 apart in stiffness; the softer frequency is right to the rounding of the stiffer one."""
    J, k = 0.2, 1e-2
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(
        1, pin.Inertia(5.0, np.zeros(3), np.eye(3)), pin.SE3.Identity()
    )
    for name, joint in (("soft", pin.JointModelRX()), ("stiff", pin.JointModelRY())):
        index = model.addJoint(1, joint, pin.SE3.Identity(), name)
        rotor = pin.Inertia(1.0, np.zeros(3), J * np.eye(3))
        model.appendBodyToJoint(index, rotor, pin.SE3.Identity())
    robot = fflin.from_model(model, stiffness={"soft": k, "stiff": 1e8 * k})
    result = fflin.modes(fflin.linearize(robot))
    floating = 1.0 / (1.0 / J + 1.0 / (1.0 + J))  # the other rotor turns with the hub
    expected = np.sqrt(np.array([k, 1e8 * k]) / floating)
    assert result.frequencies == pytest.approx(expected, rel=1e-7)


def test_a_spinning_wheel_nutates():
    """Momentum h on a body of transverse inertia I: frequency h / I, neither damped nor growing."""
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(
        1, pin.Inertia(5.0, np.zeros(3), 2.0 * np.eye(3)), pin.SE3.Identity()
    )
    model.addJoint(1, pin.JointModelRZ(), pin.SE3.Identity(), "wheel")
    wheel = pin.Inertia(1.0, np.zeros(3), np.diag([0.3, 0.3, 0.5]))
    model.appendBodyToJoint(2, wheel, pin.SE3.Identity())
    robot = fflin.from_model(model)
    lin = fflin.linearize(robot, v=fflin.velocity(robot, {"wheel": 20.0}))
    result = fflin.modes(lin)
    (nutation,) = result.modes
    assert result.equilibrium
    assert nutation.pole == pytest.approx(1j * 0.5 * 20.0 / 2.3, rel=1e-12)
    assert nutation.damping_ratio == 0.0 and not nutation.unstable
    assert result.zero_eigenvalues == 12


@pytest.mark.parametrize(
    "name, rotor", [("canadarm2", "joint_7"), ("ets_vii", "joint_6")]
)
def test_a_conservative_system_neither_decays_nor_grows(name, rotor):
    """Springs and a spinning rotor: gyroscopic, so that every pole is imaginary; exactly so."""
    rng = np.random.default_rng(5)
    bare = fflin.load(name)
    q, _, _ = random_point(bare, rng)
    inertias = dict(
        zip(bare.joint_names, fflin.linearize(bare, q).M.diagonal()[6:], strict=True)
    )
    springs = {
        joint: inertias[joint] * rng.uniform(1, 9)
        for joint in inertias
        if joint != rotor
    }
    rest = {joint.name: joint.value(q) for joint in bare.joints}
    robot = bare.replace(stiffness=springs, rest=rest)
    lin = fflin.linearize(robot, q, fflin.velocity(robot, {rotor: 3.0}))
    assert lin.is_equilibrium() and lin.A[-len(lin.M) :, -len(lin.M) :].any()
    result = fflin.modes(lin)
    assert len(result.vibrations) == len(result.modes) >= len(springs)
    assert not result.damping_ratios.any() and not result.unstable
    assert (
        matched(result.poles, np.linalg.eigvals(lin.A)) < 1e-6 * result.frequencies[-1]
    )


def test_null_space_thrust_on_moving_links_is_seen_to_be_unstable(capsys):
    """Thrusters on arm and base that push against each other, the joints holding: B u = 0."""
    arm = fflin.load("ets_vii")
    tip = fflin.Thruster("link_6", (0.0, 0.0, 0.1), (0.3, -0.5, 1.0), name="tip")
    elbow = fflin.Thruster("link_3", (0.1, 0.0, 0.0), (0.0, 1.0, 0.2), name="elbow")
    robot = arm.replace(inputs=[tip, elbow, *arm.inputs])
    q = fflin.configuration(robot, {"joint_2": 0.6, "joint_4": -0.8, "joint_5": 0.5})
    thrust = np.array([12.0, 5.0])
    linearizer = fflin.Linearizer(robot)
    B = linearizer(q).M @ linearizer(q).B[6 + robot.n :]
    u = np.concatenate((thrust, -B[:, :2] @ thrust))
    lin = linearizer(q, None, u)
    assert np.abs(B @ u).max() < 1e-13 * np.abs(u).max() and lin.is_equilibrium()
    assert fflin.check(robot, lin).ok
    result = fflin.modes(lin)
    assert result.equilibrium and result.unstable
    expected = np.linalg.eigvals(lin.A)
    growing = expected[expected.real > 1e-2 * np.abs(expected).max()]
    mine = np.array([mode.pole for mode in result.unstable])
    assert matched(np.concatenate((mine, mine[mine.imag > 0].conj())), growing) < 1e-8
    assert result.residual < 1e-12
    for text in (model_report(lin), str(result)):
        assert says(text, "unstable")
        for mode in result.unstable:
            assert f"{mode.pole:.5g}" in " ".join(text.split())


@pytest.mark.parametrize("f", [5.0, 40.0])
def test_a_rod_that_buckles_has_the_rate_derived_by_hand(f):
    """Thrust f at the tip of a rod towards its hinge, and as much on the base against it.

    The base, mass M, does not turn. Across the rod (M + m) y'' + m l a'' = -f a, and about the
    hinge (J + m l^2) a'' + m l y'' = -k a: so (J + m l^2 - m^2 l^2 / (M + m)) a'' =
    (m l f / (M + m) - k) a.
    """
    M, m, l, J, k = 10.0, 2.0, 0.5, 0.1, 2.0
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.addFrame(pin.Frame("base", 1, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    turns_not = pin.Inertia(M, np.zeros(3), 1e13 * np.eye(3))
    model.appendBodyToJoint(1, turns_not, pin.SE3.Identity())
    model.addJoint(1, pin.JointModelRZ(), pin.SE3.Identity(), "hinge")
    model.addFrame(pin.Frame("rod", 2, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    rod = pin.Inertia(m, np.array([l, 0.0, 0.0]), J * np.eye(3))
    model.appendBodyToJoint(2, rod, pin.SE3.Identity())
    inputs = [
        fflin.Thruster("rod", (1, 0, 0), (-1, 0, 0)),
        fflin.Thruster("base", (0, 0, 0), (1, 0, 0)),
    ]
    robot = fflin.from_model(model, inputs=inputs, stiffness={"hinge": k})
    result = fflin.modes(fflin.linearize(robot, u=[f, f]))
    square = (m * l * f / (M + m) - k) / (J + m * l**2 - (m * l) ** 2 / (M + m))
    assert result.equilibrium and result.zero_eigenvalues == 12
    if square < 0.0:
        assert result.frequencies == pytest.approx([np.sqrt(-square)], rel=1e-9)
        assert not result.damping_ratios.any() and not result.unstable
    else:
        assert [mode.pole for mode in result.unstable] == pytest.approx(
            [np.sqrt(square)], rel=1e-9
        )
        assert len(result.modes) == 2 and result.unstable[0].damping_ratio == -1.0


def test_models_from_files_and_in_other_hands(tmp_path):
    robot = two_panels(stiffness=5.0)
    lin = fflin.linearize(robot)
    for ending in (".npz", ".mat", ".json"):
        lin.save(tmp_path / f"m{ending}")
        loaded = fflin.modes(fflin.LinearModel.load(tmp_path / f"m{ending}"))
        assert (loaded.frequencies == fflin.modes(lin).frequencies).all()
    with pytest.raises(fflin.InputError, match=r"0\.1"):
        fflin.modes(lin.discretize(0.1))
    with pytest.raises(fflin.InputError, match="LinearModel"):
        fflin.modes(lin.A)
    with pytest.raises(ValueError, match="read-only"):
        fflin.modes(lin).modes[0].shape[0] = 1.0


def test_tables_fit_in_80_columns(robots):
    for robot in robots.values():
        sprung = robot.replace(stiffness=3.0, damping=0.2)
        for lin in (fflin.linearize(sprung), fflin.linearize(robot)):
            assert max(map(len, str(fflin.modes(lin)).splitlines())) <= 80


def test_command_line(capsys):
    springs = ["--stiffness", "panel_left=100", "--stiffness", "panel_right=100"]
    assert cli.main(["modes", "servicer_7dof", *springs]) == 0
    out = capsys.readouterr().out
    assert says(out, "13 rigid-body", "26", "2 vibrations")
    robot = fflin.load(
        "servicer_7dof", stiffness={"panel_left": 100.0, "panel_right": 100.0}
    )
    for frequency in fflin.modes(fflin.linearize(robot)).frequencies:
        assert f"{frequency:.6g}" in out


def test_command_line_takes_an_equilibrium(capsys):
    point = [
        "--joint",
        "panel_left=0.3",
        "--rpy",
        "30",
        "0",
        "20",
        "--gravity",
        "0",
        "0",
        "-1",
    ]
    point += ["--reference", "world", "--stiffness", "panel_left=100"]
    assert cli.main(["linearize", "servicer_7dof", *point, "--equilibrium"]) == 0
    out = capsys.readouterr().out
    assert "a fixed point" in out and "not a fixed point" not in out
    assert (
        cli.main(
            ["check", "servicer_7dof", *point, "--equilibrium", "--frame", "world"]
        )
        == 0
    )
    assert cli.main(["modes", "servicer_7dof", *point]) == 0
    assert "not an equilibrium" in capsys.readouterr().out
    assert cli.main(["modes", "servicer_7dof", *point, "--equilibrium"]) == 0
    assert "not an equilibrium" not in capsys.readouterr().out
    assert cli.main(["linearize", "canadarm2", "--velocity", "joint_7=1"]) == 0
    assert "a relative equilibrium" in capsys.readouterr().out
    for options, words in {
        ("--effort", "F_b.x=1"): "--effort",
        ("--inputs", "servicer_7dof"): "tau_m.panel_right",
        ("--velocity", "joint_1=1"): "rotors",
    }.items():
        assert (
            cli.main(["modes", "servicer_7dof", *point, "--equilibrium", *options]) == 2
        )
        err = hear_lines(capsys.readouterr().err).splitlines()
        assert len(err) == 1 and err[0].startswith("fflin: error: ") and words in err[0]


def test_inputs_that_cancel_leave_no_mode():
    robot = fflin.load("servicer_7dof")
    pair = [fflin.Thruster("panel_left", (0, 0, 0.3), (x, 0, 0)) for x in (1, -1)]
    robot = robot.replace(inputs=[*pair, *robot.inputs])
    q = fflin.configuration(robot, {"joint_2": 0.4, "panel_left": 0.3})
    lin = fflin.linearize(
        robot, q, u=fflin.effort(robot, {"thruster_1": 5, "thruster_2": 5})
    )
    result = fflin.modes(lin)
    assert lin.is_equilibrium() and not result.modes and result.zero_eigenvalues == 30


@pytest.mark.parametrize("thrust", [1e-3, 1.0])
def test_a_weak_asymmetry_is_not_taken_for_a_spring(thrust):
    robot = fflin.load(
        "servicer_7dof", stiffness={"panel_left": 100.0, "panel_right": 50.0}
    )
    pair = [
        fflin.Thruster("panel_left", (0, 0.2, 0.3), (1, 0, 0)),
        fflin.Thruster("panel_right", (0, 0.1, 0.3), (-1, 0, 0)),
    ]
    robot = robot.replace(inputs=pair)
    lin = fflin.linearize(
        robot, fflin.configuration(robot, {"joint_2": 0.4}), u=[thrust] * 2
    )
    result = fflin.modes(lin)
    expected = np.linalg.eigvals(lin.A)
    expected = expected[np.abs(expected) > 1e-4 * thrust**0.5]
    poles = result.poles[np.abs(result.poles) > 1e-4 * thrust**0.5]
    assert len(poles) == len(expected)
    distance = np.abs(poles[:, None] - expected).min(axis=1)
    assert (distance <= 1e-5 * np.abs(poles)).all()
    growing = (expected.real > 1e-6) & (expected.imag >= 0.0)
    assert len(result.unstable) == growing.sum() > 0


@pytest.mark.parametrize(
    ("growth", "doubtful"), [(1e-9, False), (1.0, True), (1e3, False)]
)
def test_growth_within_rounding_is_reported(robots, growth, doubtful):
    """A pole that turns and grows by so many times its rounding, beside a damper."""
    lin = fflin.linearize(robots["planar_detumble"].replace(stiffness=9.0, damping=0.1))
    (first, *_) = (mode for mode in fflin.modes(lin).modes if mode.oscillates)
    error = abs(first.pole.real / first.margin)
    changed = replace(first, margin=growth, unstable=growth > 1.0)
    assert (
        error < 1e-10 * first.frequency and first.margin < -1e3 and not first.unstable
    )
    result = replace(fflin.modes(lin), modes=(changed,))
    assert bool(result.notes) == doubtful
    assert ("undecided" in str(result)) == doubtful
    assert not fflin.modes(lin).notes


def spun(robot, frame="hybrid", moving=False):
    rng = np.random.default_rng(3)
    q, _, _ = random_point(robot, rng)
    robot = robot.replace(rest={joint.name: joint.value(q) for joint in robot.joints})
    reference = None if moving else pin.SE3.Identity()
    return fflin.linearize(robot, q, frame=frame, moving=moving, reference=reference)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("name", ["servicer_7dof", "dual_arm", "canadarm2"])
def test_energies_of_bodies_match_the_velocities(name, frame):
    """The fractions are not negative, sum to 1, and the base has what its velocities say."""
    robot = fflin.load(name, stiffness=20.0)
    lin = spun(robot.replace(damping={robot.joint_names[1]: 30.0}), frame)
    result, robot = fflin.modes(lin), lin._robot
    assert max(np.abs(mode.shape[6:12].imag).max() for mode in result.vibrations) > 0.1
    state = fflin.StateMap(robot, reference=lin.reference, frame=frame)
    half = len(lin.M)
    for mode in result.vibrations:
        parts = np.array(list(mode.energy.values()))
        assert (parts >= 0.0).all() and parts.sum() == pytest.approx(1.0, rel=1e-12)
        assert (np.diff(parts) <= 1e-9).all() and len(parts) == robot.model.njoints - 1
        of_base = 0.0
        for part in (mode.shape[half:].real, mode.shape[half:].imag):
            x = np.concatenate((lin.x0[:half], part))
            _, v = state.to_pinocchio(x)
            of_base += robot.model.inertias[1].vtiv(pin.Motion(v[:6]))
        velocity = mode.shape[half:]
        whole = (velocity.conj() @ lin.M @ velocity).real
        assert mode.energy["base"] == pytest.approx(
            of_base / whole, rel=1e-8, abs=1e-12
        )


def test_energy_does_not_depend_on_the_frame_of_the_base_or_the_scale():
    given = fflin.modes(spun(fflin.load("servicer_7dof", stiffness=20.0)))
    moved = fflin.modes(
        spun(fflin.load("servicer_7dof", stiffness=20.0), "local", moving=True)
    )
    joints = [fflin.JointTorque(f"joint_{i}") for i in range(1, 8)]
    lin = spun(fflin.load("servicer_7dof", stiffness=20.0, inputs=joints))
    reduced = fflin.modes(fflin.momentum_reduction(lin))
    for other in (moved, reduced):
        for mode, same in zip(given.modes, other.modes, strict=True):
            assert same.energy == pytest.approx(mode.energy, abs=1e-9)
    lin = given.lin
    shapes = np.array([(2.0 - 3.0j) * mode.shape for mode in given.modes])
    energies = energies_of(lin._robot, lin, shapes)
    for mode, (same, _) in zip(given.modes, energies, strict=True):
        assert same == pytest.approx(mode.energy, abs=1e-14)


def two_bodies(shift, turned=False, k=7.0):
    """Rods on a hinge about y, the base frame away from the hinge; either may be the base."""
    rods = {
        "a": pin.Inertia(3.0, np.array([0.4, 0.0, 0.1]), np.diag([0.5, 0.6, 0.7])),
        "b": pin.Inertia(1.0, np.array([-0.9, 0.0, 0.2]), np.diag([0.2, 0.3, 0.4])),
    }
    names = ("b", "a") if turned else ("a", "b")
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(1, shift.act(rods[names[0]]), pin.SE3.Identity())
    model.addJoint(1, pin.JointModelRY(), shift, "hinge")
    model.appendBodyToJoint(2, rods[names[1]], pin.SE3.Identity())
    return fflin.from_model(model, stiffness={"hinge": k}), rods


def test_two_bodies_on_a_spring_share_the_energy_as_derived_by_hand():
    """Of two rotors on one axis through both centres, the energies are as J_b to J_a."""
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(
        1, pin.Inertia(5.0, np.zeros(3), 3.0 * np.eye(3)), pin.SE3.Identity()
    )
    model.addJoint(1, pin.JointModelRZ(), pin.SE3.Identity(), "rotor")
    model.appendBodyToJoint(
        2, pin.Inertia(1.0, np.zeros(3), 0.5 * np.eye(3)), pin.SE3.Identity()
    )
    (mode,) = fflin.modes(
        fflin.linearize(fflin.from_model(model, stiffness={"rotor": 2.0}))
    ).modes
    assert list(mode.energy) == ["rotor", "base"]
    assert mode.energy["rotor"] == pytest.approx(3.0 / 3.5, rel=1e-12)


def test_energy_does_not_depend_on_which_body_is_the_base():
    rng = np.random.default_rng(9)
    result = {}
    for turned in (False, True):
        for shift in (pin.SE3.Identity(), random_pose(rng, 170.0)):
            robot, _ = two_bodies(shift, turned)
            (mode,) = fflin.modes(fflin.linearize(robot)).modes
            a = mode.energy["hinge" if turned else "base"]
            result[turned, shift] = (mode.frequency, a)
    figures = np.array(list(result.values()))
    np.testing.assert_allclose(figures, figures[[0]].repeat(4, axis=0), rtol=1e-10)
    assert 0.05 < figures[0, 1] < 0.95


def test_panels_that_move_most_are_named_first_with_percentages():
    """Not the joints of an arm that swings along with less mass."""
    robot = fflin.load(
        "servicer_7dof", stiffness={"panel_left": 100.0, "panel_right": 100.0}
    )
    result = fflin.modes(fflin.linearize(robot))
    rows = str(result).splitlines()[3:]
    assert "panel_left_link 48 %" in rows[0]
    for mode, row in zip(result.modes, rows, strict=True):
        numbers = [int(item) for item in re.findall(r"(\d+) %", row)]
        named = len(numbers) - ("more" in row)
        expected = [100.0 * part for part in list(mode.energy.values())[:named]]
        assert numbers[:named] == pytest.approx(expected, abs=0.51)
        assert sum(numbers) == pytest.approx(100.0, abs=0.51 * len(numbers) + 1.0)


def test_models_from_files_say_that_bodies_are_not_known(tmp_path):
    lin = fflin.linearize(two_panels(stiffness=5.0))
    lin.save(tmp_path / "m.npz")
    result = fflin.modes(fflin.LinearModel.load(tmp_path / "m.npz"))
    assert not any(mode.energy for mode in result.modes)
    assert "file" in result.notes[-1] and not fflin.modes(lin).notes
    assert f"{result.frequencies[0]:.6g}" in str(result)
    assert fflin.plot_modes(result).axes[0].patches


def test_terms_of_a_combination_that_are_left_out_are_counted():
    from fflin.analysis.mechanics import combination

    weights = np.array([1.0, -0.5, 0.25, 0.2, 0.0, 1e-9, 0.1])
    shown = combination(weights, tuple("abcdefg"), np.ones(7))
    assert shown == "a - 0.5 b + 0.25 c + 2 more"


@pytest.mark.parametrize("slosh", [False, True])
def test_modes_build_as_many_data_for_many_modes_as_for_one(monkeypatch, slosh):
    """A pin.Data of n joints costs n^3, so one for each mode costs n^4."""
    built = []
    create = fflin.Robot.create_data
    monkeypatch.setattr(
        fflin.Robot, "create_data", lambda self: built.append(1) or create(self)
    )

    def count(modes):
        tanks = [
            fflin.Slosh(
                "base", 1.0, (0.0, 0.0, 0.1), frequency=0.2 + 0.01 * i, name=f"tank_{i}"
            )
            for i in range(modes if slosh else 0)
        ]
        springs = {f"joint_{i + 1}": 20.0 for i in range(0 if slosh else modes)}
        robot = fflin.load("canadarm2", appendages=tanks, stiffness=springs)
        lin = fflin.linearize(robot)
        built.clear()
        result = fflin.modes(lin)
        assert len(result.vibrations) == modes * (2 if slosh else 1)
        return len(built)

    assert count(1) == count(6)


def test_motions_in_orbit_are_not_listed_as_modes_of_appendages():
    robot = fflin.load("inspector_flexible.toml", lock=["arm_*"], orbit=550e3)
    result = fflin.modes(fflin.linearize(robot))
    assert len(result.vibrations) > len(robot.modes)
    _, after = str(result).split("the link that carries them free and clamped\n")
    table, _ = after.split("\n\n")
    listed = [float(row.split()[0]) for row in table.splitlines()[1:]]
    assert len(listed) == len(robot.modes)
    lowest = min(robot.stiffness[joint.name] ** 0.5 for joint in robot.modes)
    assert min(listed) >= lowest
