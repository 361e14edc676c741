"""Uncertain robots: the exact fraction, samples, and the worst loop."""

import numpy as np
import pytest

import fflin

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
        "link_7": {"com.x": (-0.05, 0.02), "com.z": (-0.2, -0.1), "mass": 0.1, "density": 0.1},
        "link_7.inertia.xz": (-0.001, 0.001),
        "panel_left.stiffness": (80.0, 120.0),
        "panel_left.damping": (0.0, 1.0),
    },
    "planar_detumble": {
        "target": {"mass": 0.2, "density": 0.1, "com.x": (-0.1, 0.1)},
        "hand.mass": 0.5,
        "link_1.com.y": (-0.02, 0.01),
    },
    "robots/inspector.toml": {
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
    free = [j.name for j in robot.joints if "panel" not in j.name and j.name not in robot.stiffness]
    return fflin.configuration(robot, {name: rng.uniform(-2.0, 2.0) for name in free})


@pytest.mark.parametrize("name", CASES)
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_the_fraction_is_the_model_linearised_again(name):
    robot = fflin.load(name)
    if name == "servicer_7dof":
        robot = robot.replace(stiffness={"panel_right": 50.0})
    of = fflin.uncertain(robot, CASES[name])
    q = posed(robot)
    lft = of.lft(q)
    draws, _ = of.draws(6, seed=1)
    for delta, made in zip(draws, of.samples(6, seed=1), strict=True):
        lin = fflin.linearize(made, q)
        A, B, C, D = lft.at(of.values(delta))
        assert np.abs(A - lin.A).max() < 1e-11 * np.abs(lin.A).max()
        assert np.abs(B - lin.B).max() < 1e-11 * np.abs(lin.B).max()
        assert (C == lin.C).all() and (D == lin.D).all()
    rows = lft.at(draws)
    assert np.allclose(rows[1][5], B, rtol=1e-12, atol=0.0) and rows[0].shape == (6, *A.shape)


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_no_block_is_larger_than_the_rank_of_what_it_changes():
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
    of = fflin.uncertain(robot, {"link_2.com.x": (-0.1, 0.1)})
    value = S.parameters["link_2.com.x"].value
    more, less, now = (
        np.linalg.inv(fflin.linearize(of.at({"link_2.com.x": value + d}), q).B[-9:])
        for d in (0.1, -0.1, 0.0)
    )
    M1, M2 = 0.5 * (more - less), 0.5 * (more + less) - now
    sizes = np.linalg.svd(np.block([[M1, M2], [M2, 0.0 * M2]]), compute_uv=False)
    assert of.lft(q).repeats == [np.sum(sizes > 1e-9 * sizes[0])]


def test_it_is_printed_saved_and_handed_on(tmp_path):
    robot = fflin.load("cubesat")
    of = fflin.uncertain(robot, CASES["cubesat"])
    lft = of.lft()
    for text in (str(of), str(lft)):
        assert all(len(line) <= 80 for line in text.splitlines())
    assert "in all" in str(lft) and str(lft).splitlines()[-1].endswith("14")
    for ending in ("npz", "mat", "json"):
        lft.save(tmp_path / f"u.{ending}")
        again = fflin.LFT.load(tmp_path / f"u.{ending}")
        assert again.parameters == lft.parameters and (again.D11 == lft.D11).all()
    control = pytest.importorskip("control")
    plant = lft.to_control()
    assert plant.input_labels[0] == "w_base_mass_1" and plant.nstates == 12
    delta = np.array([0.5, -0.3, 0.2, 0.9, -0.7])
    of_w = np.diag(np.repeat(delta, lft.repeats.astype(int)))
    closed = control.ss(lft.A, np.hstack((lft.B1, lft.B2)), plant.C, plant.D)
    assert closed.ninputs == plant.ninputs
    A, *_ = lft.at(delta)
    within = np.linalg.inv(np.eye(14) - of_w @ plant.D[:14, :14])
    assert np.allclose(plant.A + plant.B[:, :14] @ within @ of_w @ plant.C[:14], A, atol=1e-12)


def test_samples_are_rigid_bodies_and_corners_that_are_none_are_counted():
    robot = fflin.load("servicer_7dof")
    of = fflin.uncertain(robot, {"link_3.inertia.xx": 0.3, "link_3.mass": 0.3})
    draws, lost = of.draws(30, seed=2)
    assert lost > 0 and (of.draws(30, seed=2)[0] == draws).all()
    for made in of.samples(5, seed=2):
        body = made.model.inertias[made.model.getJointId("joint_3")]
        second = 0.5 * np.trace(body.inertia) * np.eye(3) - body.inertia
        assert np.linalg.eigvalsh(second)[0] > -1e-9
    # Corners by the triangle inequality of the moments; mass alone makes none impossible.
    body = robot.model.inertias[robot.model.getJointId("joint_3")]
    moments = np.linalg.eigvalsh(body.inertia)
    xx = of.ranges[0].parameter.value
    others = np.delete(moments, np.abs(moments - xx).argmin())
    bad = 2 * sum(2.0 * max(m) > sum(m) for m in ([*others, 0.7 * xx], [*others, 1.3 * xx]))
    worst = of.worst(fflin.lqr(fflin.linearize(robot)), samples=20)
    assert bad and worst.tried == 20 + 4 - bad + 1
    assert worst.excluded == of.draws(20)[1] + bad
    assert f"{worst.excluded} draws and corners make no rigid bodies" in " ".join(
        str(worst).split()
    )


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_what_is_wrong_is_one_line():
    robot = fflin.load("servicer_7dof")
    of = fflin.uncertain(robot, {"base.mass": 0.2})
    cases = [
        (lambda: fflin.uncertain(robot, {}), "ranges is empty"),
        (lambda: fflin.uncertain(robot, {"link_99.mass": 0.1}), "no parameter"),
        (lambda: fflin.uncertain(robot, {"base.mass": (3.0, 2.0)}), "expected less and more"),
        (lambda: fflin.uncertain(robot, {"link_1.com.y": 0.1}), "give (least, largest)"),
        (lambda: fflin.uncertain(robot, {"base.mass": (-3.0, 2.0)}), "expected more than 0"),
        (lambda: fflin.uncertain(robot, {"base.inertia.xx": (1e-3, 2e-3)}), "is no robot"),
        (lambda: of.at({"base.mass": -1.0}), "the mass of 'base' is -1 kg"),
        (lambda: of.worst(np.zeros((2, 2))), "gain has shape"),
        (lambda: of.worst(np.zeros((15, 30))), "unstable"),
        (lambda: of.lft().at([0.0, 0.0]), "deltas have shape"),
    ]
    for call, said in cases:
        with pytest.raises(fflin.FflinError) as error:
            call()
        assert said in str(error.value) and "\n" not in str(error.value)
    sprung = robot.replace(stiffness={"panel_left": 80.0}, gravity=(0.0, 0.0, -9.8))
    with pytest.raises(fflin.InputError, match="gravity"):
        fflin.uncertain(sprung, {"base.mass": 0.1}).lft()
    bent = fflin.configuration(robot, {"panel_left": 0.3})
    with pytest.raises(fflin.InputError, match="out of its rest"):
        fflin.uncertain(robot, {"panel_left.stiffness": (80.0, 90.0)}).lft(bent)
    joined = fflin.load("planar_detumble")
    with pytest.raises(fflin.InputError, match="is a link of the body"):
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
        said = str(error.value)
        least = "0 or more" if "hinge" in name else "more than 0"
        assert f"range of '{name}' is from {ends}" in said and f"expected {least};" in said
        assert "20 % is 0.2" in said and "LEAST:LARGEST" in said and "\n" not in said
    for name in ("stiffness", "damping"):
        fflin.uncertain(robot, {f"hinge_left_1.{name}": (0.0, 1.0)})
    of = fflin.uncertain(robot, {"base.inertia.xx": 0.9, "base.com.x": (-1.0, 1.0)})
    assert len(of.samples(3)) == 3 and of.draws(30)[1] > 0


def test_a_wheel_with_friction_is_no_thruster():
    wheel = fflin.ReactionWheel((0.0, 0.0, 1.0), inertia=1e-3, name="w")
    robot = fflin.load("servicer_7dof", inputs=[wheel])
    of = fflin.uncertain(robot, {"w.damping": (0.1, 0.3)})
    for delta, made in zip(of.draws(3)[0], of.samples(3), strict=True):
        lin, values = fflin.linearize(made), of.values(delta)
        assert made.damping["w"] == values["w.damping"]
        assert np.abs(of.lft().at(values)[0] - lin.A).max() < 1e-11 * np.abs(lin.A).max()


def test_rotors_count_in_the_fraction():
    model = fflin.load("ets_vii").model.copy()
    model.armature = np.linspace(0.1, 2.0, model.nv)
    of = fflin.uncertain(fflin.from_model(model), {"base.mass": 0.3, "joint_2.density": 0.3})
    delta = np.array([0.6, -0.8])
    lin, (A, B, *_) = fflin.linearize(of.at(of.values(delta))), of.lft().at(delta)
    assert np.abs(A - lin.A).max() <= 1e-11 and np.abs(B - lin.B).max() < 1e-11 * np.abs(B).max()


def test_a_wheel_too_large_for_its_carrier_is_no_robot():
    wheel = fflin.ReactionWheel((0.0, 0.0, 1.0), inertia=1e-3)
    robot = fflin.load("cubesat", inputs=[wheel])
    largest = robot._bare.model.inertias[1].inertia[2, 2]
    of = fflin.uncertain(robot, {"wheel_1.inertia": (1e-4, 1.5 * largest)})
    assert of.makes(np.array([-0.9])) and not of.makes(np.array([0.9]))
    with pytest.raises(fflin.InputError, match="the density of 'base' is -1"):
        of.at({"base.density": -1.0})


def test_a_range_that_leaves_hardly_any_robot_is_one_line():
    rod = {"inertia": np.diag([1.0, 1.0, 1e-9])}
    robot = fflin.load("cubesat").with_mass_properties({"base": rod})
    of = fflin.uncertain(robot, {"base.inertia.xx": 0.5, "base.inertia.yy": 0.5})
    for call in (lambda: of.samples(1), lambda: of.worst(fflin.lqr(fflin.linearize(robot)))):
        with pytest.raises(fflin.InputError, match=r"0 were physical.*no rigid body.*narrower"):
            call()


def test_stored_momentum_is_no_fixed_point():
    wheel = fflin.ReactionWheel((0.0, 0.0, 1.0), momentum=2.0)
    robot = fflin.load("cubesat", inputs=[wheel])
    with pytest.raises(fflin.InputError, match="stored momentum; take a point at rest"):
        fflin.uncertain(robot, {"base.mass": 0.1}).lft()


@pytest.mark.parametrize("output", [fflin.CenterOfMass(), fflin.Momentum()])
def test_an_output_that_weighs_the_robot_is_no_fraction(output):
    robot = fflin.load("cubesat", outputs=[output])
    with pytest.raises(fflin.InputError, match="weighs the robot; leave it out"):
        fflin.uncertain(robot, {"base.mass": 0.1}).lft()
