"""Uncertain robots: the exact fraction, samples, and the worst loop."""

import numpy as np
import pytest

import fflin
from tests.support.messages import says

CASES = {
    "cubesat": {
        "base.mass": 0.2,
        "base.com.x": (-0.01, 0.02),
        "base.com.y": (-0.01, 0.01),
        "base.inertia.xx": 0.2,
        "base.inertia.xy": (-1e-4, 1e-4),
    },
    "servicer_7dof": {
        "base.mass": 0.2,
        "link_3.density": 0.3,
        "link_7": {
            "com.x": (-0.05, 0.02),
            "com.z": (-0.2, -0.1),
            "mass": 0.1,
            "density": 0.1,
        },
        "link_7.inertia.xz": (-0.001, 0.001),
        "panel_left.stiffness": (80.0, 120.0),
        "panel_left.damping": (0.0, 1.0),
    },
    "planar_detumble": {
        "target": {"mass": 0.2, "density": 0.1, "com.x": (-0.1, 0.1)},
        "hand.mass": 0.5,
        "link_1.com.y": (-0.02, 0.01),
    },
    "inspector.toml": {
        "base.density": 0.1,
        "wheel_x.inertia": 0.2,
        "top_left_front.position.z": 0.1,
        "hinge_*.stiffness": 0.3,
        "gripper.inertia.zz": 0.1,
    },
}


def posed(robot, seed=0):
    """A configuration with joints that have no spring at random."""
    rng = np.random.default_rng(seed)
    free = [
        j.name
        for j in robot.joints
        if "panel" not in j.name and j.name not in robot.stiffness
    ]
    return fflin.configuration(robot, {name: rng.uniform(-2.0, 2.0) for name in free})


@pytest.mark.parametrize("name", CASES)
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_the_fraction_is_the_model_linearised_again(name):
    robot = fflin.load(name)
    if name == "servicer_7dof":
        robot = robot.replace(stiffness={"panel_right": 50.0})
    uncertain = fflin.uncertain(robot, CASES[name])
    q = posed(robot)
    lft = uncertain.lft(q)
    draws, _ = uncertain.draws(6, seed=1)
    for delta, made in zip(draws, uncertain.samples(6, seed=1), strict=True):
        lin = fflin.linearize(made, q)
        A, B, C, D = lft.at(uncertain.values(delta))
        assert np.abs(A - lin.A).max() < 1e-11 * np.abs(lin.A).max()
        assert np.abs(B - lin.B).max() < 1e-11 * np.abs(lin.B).max()
        assert (C == lin.C).all() and (D == lin.D).all()
    rows = lft.at(draws)
    assert np.allclose(rows[1][5], B, rtol=1e-12, atol=0.0) and rows[0].shape == (
        6,
        *A.shape,
    )


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_no_block_is_larger_than_the_rank_of_its_effect():
    robot = fflin.load("planar_detumble")
    q = posed(robot)
    S = fflin.sensitivity(fflin.linearize(robot, q))
    M = np.linalg.inv(S.lin.B[-9:])
    linear = ["link_2.mass", "link_2.inertia.yy", "link_2.inertia.xy", "hand.density"]
    for name in linear:
        ends = (-1e-4, 1e-4) if name.endswith("xy") else 0.1
        lft = fflin.uncertain(robot, {name: ends}).lft(q)
        M_p = -M @ S[name].dB[-9:] @ M
        sizes = np.linalg.svd(M_p, compute_uv=False)
        assert lft.repeats == [np.sum(sizes > 1e-9 * sizes[0])]
    # M is quadratic in a centre of mass: the order of the least realisation of d M1 + d^2 M2 is
    # the rank of [[M1, M2], [M2, 0]].
    uncertain = fflin.uncertain(robot, {"link_2.com.x": (-0.1, 0.1)})
    value = S.parameters["link_2.com.x"].value
    more, less, now = (
        np.linalg.inv(
            fflin.linearize(uncertain.at({"link_2.com.x": value + d}), q).B[-9:]
        )
        for d in (0.1, -0.1, 0.0)
    )
    M1, M2 = 0.5 * (more - less), 0.5 * (more + less) - now
    sizes = np.linalg.svd(np.block([[M1, M2], [M2, 0.0 * M2]]), compute_uv=False)
    assert uncertain.lft(q).repeats == [np.sum(sizes > 1e-9 * sizes[0])]


def test_it_is_printed_and_saved(tmp_path):
    robot = fflin.load("cubesat")
    uncertain = fflin.uncertain(robot, CASES["cubesat"])
    lft = uncertain.lft()
    assert all(len(line) <= 80 for line in str(lft).splitlines())
    assert "Delta is 14 x 14" in str(lft)
    for ending in ("npz", "mat", "json"):
        lft.save(tmp_path / f"u.{ending}")
        again = fflin.LFT.load(tmp_path / f"u.{ending}")
        assert again.parameters == lft.parameters and (again.D11 == lft.D11).all()


@pytest.mark.exhaustive
def test_the_fraction_is_a_system_of_the_package_control():
    lft = fflin.uncertain(fflin.load("cubesat"), CASES["cubesat"]).lft()
    control = pytest.importorskip("control")
    plant = lft.to_control()
    assert plant.input_labels[0] == "w_base_mass_1" and plant.nstates == 12
    delta = np.array([0.5, -0.3, 0.2, 0.9, -0.7])
    of_w = np.diag(np.repeat(delta, lft.repeats.astype(int)))
    closed = control.ss(lft.A, np.hstack((lft.B1, lft.B2)), plant.C, plant.D)
    assert closed.ninputs == plant.ninputs
    A, *_ = lft.at(delta)
    within = np.linalg.inv(np.eye(14) - of_w @ plant.D[:14, :14])
    assert np.allclose(
        plant.A + plant.B[:, :14] @ within @ of_w @ plant.C[:14], A, atol=1e-12
    )


def test_samples_are_rigid_bodies():
    robot = fflin.load("servicer_7dof")
    uncertain = fflin.uncertain(robot, {"link_3.inertia.xx": 0.3, "link_3.mass": 0.3})
    draws, lost = uncertain.draws(30, seed=2)
    assert lost > 0 and (uncertain.draws(30, seed=2)[0] == draws).all()
    for made in uncertain.samples(5, seed=2):
        body = made.model.inertias[made.model.getJointId("joint_3")]
        second = 0.5 * np.trace(body.inertia) * np.eye(3) - body.inertia
        assert np.linalg.eigvalsh(second)[0] > -1e-9


@pytest.mark.exhaustive
def test_corners_that_are_no_rigid_bodies_are_counted():
    robot = fflin.load("servicer_7dof")
    uncertain = fflin.uncertain(robot, {"link_3.inertia.xx": 0.3, "link_3.mass": 0.3})
    # Corners by the triangle inequality of the moments; mass alone makes none impossible.
    body = robot.model.inertias[robot.model.getJointId("joint_3")]
    moments = np.linalg.eigvalsh(body.inertia)
    xx = uncertain.ranges[0].parameter.value
    others = np.delete(moments, np.abs(moments - xx).argmin())
    bad = 2 * sum(
        2.0 * max(m) > sum(m) for m in ([*others, 0.7 * xx], [*others, 1.3 * xx])
    )
    worst = uncertain.worst(fflin.lqr(fflin.linearize(robot)), samples=20)
    assert bad and worst.tried == 20 + 4 - bad + 1
    assert worst.excluded == uncertain.draws(20)[1] + bad
    assert says(str(worst), f"{worst.excluded} samples and corners")


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_errors_are_one_line():
    robot = fflin.load("servicer_7dof")
    uncertain = fflin.uncertain(robot, {"base.mass": 0.2})
    cases = [
        (lambda: fflin.uncertain(robot, {}), "ranges"),
        (lambda: fflin.uncertain(robot, {"link_99.mass": 0.1}), "link_99"),
        (lambda: fflin.uncertain(robot, {"base.mass": (3.0, 2.0)}), "least < largest"),
        (lambda: fflin.uncertain(robot, {"link_1.com.y": 0.1}), "(least, largest)"),
        (lambda: fflin.uncertain(robot, {"base.mass": (-3.0, 2.0)}), "base.mass"),
        (lambda: fflin.uncertain(robot, {"base.inertia.xx": (1e-3, 2e-3)}), "robot"),
        (lambda: uncertain.at({"base.mass": -1.0}), "'base'"),
        (lambda: uncertain.worst(np.zeros((2, 2))), "(2, 2)"),
        (lambda: uncertain.worst(np.zeros((15, 30))), "unstable"),
        (lambda: uncertain.lft().at([0.0, 0.0]), "deltas"),
    ]
    for call, message in cases:
        with pytest.raises(fflin.FflinError) as error:
            call()
        assert message in str(error.value) and "\n" not in str(error.value)
    sprung = robot.replace(stiffness={"panel_left": 80.0}, gravity=(0.0, 0.0, -9.8))
    with pytest.raises(fflin.InputError, match="gravity"):
        fflin.uncertain(sprung, {"base.mass": 0.1}).lft()
    bent = fflin.configuration(robot, {"panel_left": 0.3})
    with pytest.raises(fflin.InputError, match="rest"):
        fflin.uncertain(robot, {"panel_left.stiffness": (80.0, 90.0)}).lft(bent)
    joined = fflin.load("planar_detumble")
    with pytest.raises(fflin.InputError, match="link"):
        fflin.uncertain(joined, {"joint_3.mass": 0.1, "hand.mass": 0.1})


def test_a_range_that_no_robot_has_is_refused():
    """Twenty for 20 %, above all; a link whose centre or inertia may be no body's stays."""
    wheel = fflin.ReactionWheel((0.0, 0.0, 1.0), inertia=1e-3, name="w")
    robot = fflin.load("inspector", inputs=[wheel], stiffness={"hinge_left_1": 10.0})
    for name, value, ends in (
        ("base.mass", 20, "-"),
        ("base.mass", 1.5, "-"),
        ("base.mass", (0.0, 2.0), "0 to 2"),
        ("base.density", 1.0, "0 to 2"),
        ("w.inertia", 1.0, "0 to 0.002"),
        ("hinge_left_1.stiffness", 20, "-190 to 210"),
        ("hinge_left_1.damping", (-0.1, 0.1), "-0.1 to 0.1"),
    ):
        with pytest.raises(fflin.InputError) as error:
            fflin.uncertain(robot, {name: value})
        message = str(error.value)
        least = "0 or more" if "hinge" in name else "above 0"
        assert f"'{name}' is {ends}" in message and f"{least};" in message
        assert (
            "0.2 for 20 %" in message
            and "LEAST:LARGEST" in message
            and "\n" not in message
        )
    for name in ("stiffness", "damping"):
        fflin.uncertain(robot, {f"hinge_left_1.{name}": (0.0, 1.0)})
    uncertain = fflin.uncertain(
        robot, {"base.inertia.xx": 0.9, "base.com.x": (-1.0, 1.0)}
    )
    assert len(uncertain.samples(3)) == 3 and uncertain.draws(30)[1] > 0


def test_a_wheel_with_friction_is_not_a_thruster():
    wheel = fflin.ReactionWheel((0.0, 0.0, 1.0), inertia=1e-3, name="w")
    robot = fflin.load("servicer_7dof", inputs=[wheel])
    uncertain = fflin.uncertain(robot, {"w.damping": (0.1, 0.3)})
    for delta, made in zip(uncertain.draws(3)[0], uncertain.samples(3), strict=True):
        lin, values = fflin.linearize(made), uncertain.values(delta)
        assert made.damping["w"] == values["w.damping"]
        assert (
            np.abs(uncertain.lft().at(values)[0] - lin.A).max()
            < 1e-11 * np.abs(lin.A).max()
        )


def test_rotors_count_in_the_fraction():
    model = fflin.load("ets_vii").model.copy()
    model.armature = np.linspace(0.1, 2.0, model.nv)
    uncertain = fflin.uncertain(
        fflin.from_model(model), {"base.mass": 0.3, "joint_2.density": 0.3}
    )
    delta = np.array([0.6, -0.8])
    lin, (A, B, *_) = (
        fflin.linearize(uncertain.at(uncertain.values(delta))),
        uncertain.lft().at(delta),
    )
    assert (
        np.abs(A - lin.A).max() <= 1e-11
        and np.abs(B - lin.B).max() < 1e-11 * np.abs(B).max()
    )


def test_a_wheel_too_large_for_its_carrier_is_not_a_robot():
    wheel = fflin.ReactionWheel((0.0, 0.0, 1.0), inertia=1e-3)
    robot = fflin.load("cubesat", inputs=[wheel])
    largest = robot._bare.model.inertias[1].inertia[2, 2]
    uncertain = fflin.uncertain(robot, {"wheel_1.inertia": (1e-4, 1.5 * largest)})
    assert not uncertain.refusal(np.array([-0.9])) and uncertain.refusal(
        np.array([0.9])
    )
    with pytest.raises(fflin.InputError, match=r"density .*'base'"):
        uncertain.at({"base.density": -1.0})


def test_a_range_that_leaves_hardly_any_robot_is_one_line():
    rod = {"inertia": np.diag([1.0, 1.0, 1e-9])}
    robot = fflin.load("cubesat").with_mass_properties({"base": rod})
    uncertain = fflin.uncertain(robot, {"base.inertia.xx": 0.5, "base.inertia.yy": 0.5})
    for call in (
        lambda: uncertain.samples(1),
        lambda: uncertain.worst(fflin.lqr(fflin.linearize(robot))),
    ):
        with pytest.raises(fflin.InputError, match="physical"):
            call()


def test_stored_momentum_is_not_a_fixed_point():
    wheel = fflin.ReactionWheel((0.0, 0.0, 1.0), momentum=2.0)
    robot = fflin.load("cubesat", inputs=[wheel])
    with pytest.raises(fflin.InputError, match="momentum"):
        fflin.uncertain(robot, {"base.mass": 0.1}).lft()


@pytest.mark.parametrize("output", [fflin.CenterOfMass(), fflin.Momentum()])
def test_an_output_that_weighs_the_robot_is_not_a_fraction(output):
    robot = fflin.load("cubesat", outputs=[output])
    with pytest.raises(fflin.InputError, match="masses"):
        fflin.uncertain(robot, {"base.mass": 0.1}).lft()


SLOSH = """<robot name="tank">
  <link name="tank"><inertial><mass value="100"/>
    <inertia ixx="20" iyy="25" izz="30" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="fuel"><inertial><origin xyz="0 0 0.1"/><mass value="8"/>
    <inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="slosh" type="prismatic"><parent link="tank"/><child link="fuel"/>
    <origin xyz="0.2 0 0.5"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="10" velocity="1"/></joint>
</robot>"""


def test_a_point_mass_that_moves_is_a_body(tmp_path):
    (tmp_path / "tank.urdf").write_text(SLOSH)
    robot = fflin.load(tmp_path / "tank.urdf", stiffness={"slosh": 4.0})
    parts = {"mass": 0.3, "density": 0.2, "com.z": (0.0, 0.2)}
    uncertain = fflin.uncertain(robot, {"fuel": parts, "slosh.stiffness": 0.2})
    draws, lost = uncertain.draws(5, seed=1)
    assert not lost
    for delta, made in zip(draws, uncertain.samples(5, seed=1), strict=True):
        lin, (A, B, *_) = fflin.linearize(made), uncertain.lft().at(delta)
        assert np.abs(A - lin.A).max() < 1e-12 and np.abs(B - lin.B).max() < 1e-12
    # Its mass may not be none, and an inertia about one axis alone is no body's.
    with pytest.raises(fflin.InputError, match="mass of 'fuel'"):
        uncertain.at({"fuel.mass": 0.0})
    with pytest.raises(fflin.InputError, match="realisable"):
        fflin.uncertain(robot, {"fuel.inertia.xx": (1e-3, 2e-3)})


PANELS = {"panel_left": 60.0, "panel_right": 80.0}


def test_tied_parameters_have_one_delta():
    robot = fflin.load("servicer_7dof", stiffness=PANELS)
    tied = {"panel_*.stiffness": {"range": 0.2, "tied": True}, "base.mass": 0.1}
    uncertain = fflin.uncertain(robot, tied)
    lft, apart = (
        uncertain.lft(),
        fflin.uncertain(robot, {"panel_*.stiffness": 0.2, "base.mass": 0.1}),
    )
    assert uncertain.names == lft.parameters == ("base.mass", "panel_*.stiffness")
    assert lft.repeats.tolist() == [3.0, 2.0] and len(apart.names) == 3
    assert lft.units == ("kg", "1") and (lft.middle[1], lft.half[1]) == (1.0, 0.2)
    for delta, made in zip(
        uncertain.draws(5, seed=3)[0], uncertain.samples(5, seed=3), strict=True
    ):
        factor = 1.0 + 0.2 * delta[1]
        assert made.stiffness == pytest.approx(
            {name: factor * k for name, k in PANELS.items()}
        )
        lin = fflin.linearize(made)
        # By deltas, by the names of the set, and by the same delta for each of them.
        for A, B, *_ in (
            lft.at(delta),
            lft.at(uncertain.values(delta)),
            apart.lft().at(delta[[1, 1, 0]]),
        ):
            assert np.abs(A - lin.A).max() < 1e-11 * np.abs(lin.A).max()
            assert np.abs(B - lin.B).max() < 1e-11 * np.abs(lin.B).max()
    assert uncertain.at({"panel_left.stiffness": 5.0}).stiffness["panel_left"] == 5.0


@pytest.mark.exhaustive
def test_tied_parameters_share_a_value_between_ends_and_the_worst_names_it():
    robot = fflin.load("servicer_7dof", stiffness=PANELS)
    uncertain = fflin.uncertain(
        robot, {"panel_*.stiffness": {"range": (50.0, 90.0), "tied": True}}
    )
    assert uncertain.lft().units == ("N m/rad",)
    for made in uncertain.samples(3):
        left, right = made.stiffness.values()
        assert left == right and 50.0 <= left <= 90.0
    worst = uncertain.worst(fflin.lqr(fflin.linearize(robot)), samples=3)
    assert (
        list(worst.gain.parameters) == ["panel_*.stiffness"]
        and worst.tried == 3 + 2 + 1
    )


def test_a_tied_fraction_moves_negative_values_away_from_zero():
    robot = fflin.load("cubesat")
    robot = robot.with_mass_properties({"base": {"com": [0.01, -0.02, 0.03]}})
    uncertain = fflin.uncertain(robot, {"base.com.*": {"range": 0.5, "tied": True}})
    more = uncertain.at({"base.com.*": 1.5})._bare.model.inertias[1].lever
    assert more == pytest.approx([0.015, -0.03, 0.045]) and not uncertain.refusal(
        np.array([1.0])
    )
    lin, (_, B, *_) = (
        fflin.linearize(uncertain.at({"base.com.*": 1.5})),
        uncertain.lft().at([1.0]),
    )
    assert np.abs(B - lin.B).max() < 1e-11 * np.abs(B).max()


def test_a_tie_that_is_unclear_is_refused():
    robot = fflin.load("servicer_7dof", stiffness=PANELS)
    pattern = "panel_*.stiffness"
    for given, message in (
        ({pattern: {"range": 0.2}}, "tied"),
        ({pattern: {"range": 0.2, "tied": "yes"}}, "tied"),
        (
            {pattern: {"range": 0.2, "tied": True}, "panel_left.stiffness": 0.1},
            "tied to other",
        ),
        ({"link_3.*": {"range": (1.0, 2.0), "tied": True}}, "units"),
    ):
        with pytest.raises(fflin.InputError, match=message):
            fflin.uncertain(robot, given)
    loose = fflin.uncertain(robot, {pattern: {"range": 0.2, "tied": False}})
    assert len(loose.names) == 2
