"""Robots with other masses: physically consistent, by name, and not taken for the first."""

import pickle

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.reader_corpus import INERTIA
from tests.support.robots import BUNDLED, random_tree

ROOT = 1


def pseudo_inertia(body):
    """[[Sigma, h], [h', m]] about the origin of the body's frame (Wensing, Kim and Slotine)."""
    h = body.mass * body.lever
    moments = body.inertia - body.mass * pin.skew(body.lever) @ pin.skew(body.lever)
    second = 0.5 * np.trace(moments) * np.eye(3) - moments
    return np.block([[second, h[:, None]], [h[None], np.array([[body.mass]])]])


def wheeled():
    return fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))


def test_a_mass_alone_scales_a_body_and_leaves_the_others():
    robot = fflin.load("ets_vii")
    heavy = robot.with_mass_properties({"joint_2": {"mass": 50.0}})
    index = robot.model.getJointId("joint_2")
    before, after = robot.model.inertias[index], heavy.model.inertias[index]
    assert after.mass == 50.0 != before.mass
    np.testing.assert_array_equal(after.lever, before.lever)
    np.testing.assert_allclose(
        after.inertia, before.inertia * 50.0 / before.mass, rtol=1e-14
    )
    others = [i for i in range(ROOT, robot.model.njoints) if i != index]
    assert all(heavy.model.inertias[i] == robot.model.inertias[i] for i in others)
    assert heavy.mass == pytest.approx(robot.mass + 50.0 - before.mass)


def test_centre_and_inertia_are_taken_as_given_or_as_pinocchios():
    robot = fflin.load("ets_vii")
    inertia = np.array([[3.0, 0.2, 0.0], [0.2, 4.0, 0.1], [0.0, 0.1, 5.0]])
    com = np.array([0.1, -0.2, 0.3])
    made = robot.with_mass_properties(
        {
            "base": {"com": com, "inertia": inertia},
            "joint_1": pin.Inertia(7.0, com, inertia),
        }
    )
    base, first = (
        made.model.inertias[ROOT],
        made.model.inertias[made.model.getJointId("joint_1")],
    )
    assert base.mass == robot.model.inertias[ROOT].mass and first.mass == 7.0
    for body in (base, first):
        np.testing.assert_array_equal(body.lever, com)
        np.testing.assert_allclose(body.inertia, inertia, rtol=1e-15)
    # About the centre of mass: what is far from the joint has more inertia about it.
    lin, lighter = fflin.linearize(made), fflin.linearize(robot)
    expected = made.mass
    assert lin.M[3, 3] == pytest.approx(expected) != lighter.M[3, 3]


def test_patterns_groups_of_names_and_links_are_bodies():
    robot = fflin.load("ets_vii")
    all_joints = robot.with_mass_properties({"joint_*": {"mass": 20.0}})
    joints = [robot.model.getJointId(name) for name in robot.joint_names]
    assert {all_joints.model.inertias[i].mass for i in joints} == {20.0}
    by_link = robot.with_mass_properties({"link_3": {"mass": 9.0}})
    assert by_link.model.inertias[robot.model.getJointId("joint_3")].mass == 9.0


def test_pictures_names_and_fields_stay_and_the_first_robot_too():
    robot = fflin.load("ets_vii", stiffness={"joint_1": 3.0}, gravity=(0, 0, -1.0))
    masses = [body.mass for body in robot.model.inertias]
    for other in (
        robot.with_mass_properties({"base": {"mass": 1.0}}),
        robot.perturbed(seed=3),
    ):
        for key in (
            "name",
            "urdf",
            "joints",
            "inputs",
            "stiffness",
            "gravity",
            "package_dirs",
        ):
            assert getattr(other, key) == getattr(robot, key), key
        assert other.urdf_sha256 != robot.urdf_sha256 and len(other.urdf_sha256) == 64
        assert pickle.loads(pickle.dumps(other)).mass == other.mass
    assert [body.mass for body in robot.model.inertias] == masses
    robot.require_unchanged()


def test_nothing_changed_is_the_same_robot():
    robot = fflin.load("ets_vii")
    body = robot.model.inertias[ROOT]
    for same in (
        robot.with_mass_properties({}),
        robot.with_mass_properties({"base": {"mass": body.mass, "com": body.lever}}),
        robot.perturbed(mass=0.0, com=0.0, inertia=0.0),
    ):
        assert same.urdf_sha256 == robot.urdf_sha256
        assert same.model == robot.model


@pytest.mark.parametrize("name", BUNDLED)
def test_perturbed_bodies_are_rigid_bodies_within_the_spread(name):
    robot = fflin.load(name)
    spread = {"mass": 0.3, "com": 0.2, "inertia": 0.5}
    for seed in range(20):
        other = robot.perturbed(**spread, seed=seed)
        for i in range(ROOT, robot.model.njoints):
            before, after = robot.model.inertias[i], other.model.inertias[i]
            if before.mass == 0.0:
                assert after.mass == 0.0
                continue
            assert abs(after.mass / before.mass - 1.0) <= 0.3
            was, now = (
                np.linalg.eigvalsh(pseudo_inertia(item)) for item in (before, after)
            )
            # Consistent where it was, beyond rounding.
            if was[0] >= -1e-12 * was[-1]:
                assert now[0] >= -1e-12 * now[-1]
            ratio = (
                np.diag(after.inertia)
                / after.mass
                / (np.diag(before.inertia) / before.mass)
            )
            assert (np.abs(ratio - 1.0) <= 0.5 + 1e-12).all()
            radii = np.sqrt(
                np.abs(0.5 * np.trace(before.inertia) - np.diag(before.inertia))
            )
            shift = np.abs(after.lever - before.lever)
            assert (shift <= 0.2 * radii / np.sqrt(before.mass) + 1e-12).all()


def test_the_spreads_are_reached_and_the_seed_decides():
    robot = fflin.load("ets_vii")
    others = [
        robot.perturbed(mass=0.1, com=0.0, inertia=0.0, seed=s) for s in range(50)
    ]
    ratios = np.array(
        [[b.mass for b in o.model.inertias.tolist()[ROOT:]] for o in others]
    )
    ratios /= [body.mass for body in robot.model.inertias.tolist()[ROOT:]]
    assert 0.095 < np.abs(ratios - 1.0).max() <= 0.1 and abs(ratios.mean() - 1.0) < 0.01
    again = robot.perturbed(mass=0.1, com=0.0, inertia=0.0, seed=7)
    assert again.model == others[7].model and again.urdf_sha256 == others[7].urdf_sha256
    assert again.urdf_sha256 != others[8].urdf_sha256
    # Each spread turns its own knob: the mass is drawn the same whatever the others are.
    full = robot.perturbed(mass=0.1, com=0.1, inertia=0.1, seed=7)
    for i in range(ROOT, robot.model.njoints):
        assert full.model.inertias[i].mass == again.model.inertias[i].mass
        assert not np.array_equal(
            full.model.inertias[i].lever, again.model.inertias[i].lever
        )


def test_bodies_are_shifted_either_way_and_a_plate_is_a_body():
    robot = fflin.load("ets_vii")
    before = robot.model.inertias[ROOT].lever
    shifts = [
        robot.perturbed(com=0.1, seed=k).model.inertias[ROOT].lever for k in range(20)
    ]
    signs = np.sign(np.array(shifts) - before)
    assert (signs.min(axis=0) == -1.0).all() and (signs.max(axis=0) == 1.0).all()
    assert robot.with_mass_properties({"base": {"inertia": np.diag([1.0, 1.0, 2.0])}})


def test_every_route_works_on_them():
    rng = np.random.default_rng(0)
    for robot in (fflin.load("servicer_7dof"), wheeled(), random_tree(rng, 4)):
        other = robot.perturbed(seed=1)
        lin = fflin.linearize(other)
        assert fflin.check(other, lin).ok
        # The first robot's model is none of the other's, and the figures say so.
        assert not fflin.check(other, fflin.linearize(robot)).ok
        motion = fflin.simulate(other, v0=0.01 * np.ones(other.nv), duration=0.2)
        assert motion.momentum_drift.max() < 1e-12
        assert motion.urdf_sha256 == other.urdf_sha256 == lin.urdf_sha256


def test_wheels_remain_part_of_their_carrier():
    robot = wheeled()
    heavy = robot.with_mass_properties({"base": {"mass": 7.0}})
    assert heavy.wheels == robot.wheels and heavy.joint_names == robot.joint_names
    bare = fflin.load("cubesat").with_mass_properties({"base": {"mass": 7.0}})
    whole = bare.replace(inputs=robot.inputs)
    assert whole.model == heavy.model
    # Welded, the wheels are counted once.
    without = heavy.replace(inputs=[fflin.BaseTorque()])
    assert without.model.inertias[ROOT] == bare.model.inertias[ROOT]
    assert without.urdf_sha256 == heavy.urdf_sha256
    inertia = 1e-9 * np.eye(3)
    with pytest.raises(fflin.InputError, match="link that carries it"):
        robot.with_mass_properties({"base": {"inertia": inertia}})


def test_results_of_the_one_are_not_taken_for_the_others(tmp_path):
    robot = fflin.load("planar_detumble")
    other = robot.perturbed(seed=2)
    fflin.sweep(robot, [robot.neutral()]).save(tmp_path / "b.npz")
    with pytest.raises(fflin.InputError, match="batch"):
        fflin.LinearBatch.load(tmp_path / "b.npz", other)
    motion = fflin.simulate(robot, duration=0.05)
    with pytest.raises(fflin.InputError, match="robot"):
        fflin.visualize(other, motion, html=tmp_path / "a.html", open=False)
    # Runs of a campaign are drawn with their own bodies.
    drawn = {"base.density": (0.1, 0.2)}
    policy = lambda t, q, v: np.zeros(9)  # noqa: E731
    made = fflin.monte_carlo(robot, policy, drawn, runs=1, duration=0.02, dt=0.01)
    fflin.visualize(robot, made.replay(0), html=tmp_path / "b.html", open=False)
    with pytest.raises(fflin.InputError, match="another robot"):
        fflin.visualize(other, made.replay(0), html=tmp_path / "c.html", open=False)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"joint_9": {"mass": 1.0}}, "'joint_9'"),
        ({"base": {"mass": 0.0}}, "mass .*0 kg"),
        ({"base": {"mass": -1.0}}, "mass .*-1 kg"),
        ({"base": {"mass": "x"}}, "mass .*'x'"),
        ({"base": {"com": [1.0, 2.0]}}, "com"),
        ({"base": {"inertia": np.ones(3)}}, r"\(3,\)"),
        ({"base": {"inertia": np.triu(np.ones((3, 3)))}}, "symmetric"),
        ({"base": {"inertia": np.diag([1.0, 1.0, 3.0])}}, "sum"),
        ({"base": {"inertia": np.diag([1.0, 1.0, 2.1])}}, "sum"),
        ({"base": {"inertia": np.diag([1.0, 1.0, -1.0])}}, "moments of 0 or more"),
        ({"base": {"masses": 1.0}}, "'masses'"),
        ({"base": 3.0}, "float"),
        ({"base": pin.Inertia.Zero()}, "mass .*0 kg"),
        (
            {"joint_1": {"mass": 1.0}, "link_1": {"mass": 2.0}},
            "'joint_1'",
        ),
        ({"link_*": {"mass": 1.0}}, "'link_6'"),
        (3, "bodies"),
    ],
)
def test_an_invalid_body_is_refused_in_one_line(given, message):
    with pytest.raises(fflin.FflinError, match=message) as caught:
        fflin.load("ets_vii").with_mass_properties(given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"mass": 1.0}, "mass"),
        ({"com": -0.1}, "-0.1"),
        ({"inertia": np.nan}, "inertia"),
        ({"seed": 0.5}, "seed"),
    ],
)
def test_invalid_spreads_are_refused(given, message):
    with pytest.raises(fflin.InputError, match=message):
        fflin.load("ets_vii").perturbed(**given)


def test_virtual_joints_of_a_floating_base_are_advised_to_be_locked(tmp_path):
    axes = ("1 0 0", "0 1 0", "0 0 1")
    chain = [(kind, axis) for kind in ("prismatic", "revolute") for axis in axes]
    parts = ['<link name="world_link"/>']
    parent = "world_link"
    for index, (kind, axis) in enumerate(chain):
        body = f'<inertial><mass value="10"/>{INERTIA}</inertial>' if index == 5 else ""
        parts.append(
            f'<link name="l{index}">{body}</link>'
            f'<joint name="v{index}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="l{index}"/><axis xyz="{axis}"/>'
            '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        )
        parent = f"l{index}"
    path = tmp_path / "virtual.urdf"
    path.write_text(f'<robot name="virtual">{"".join(parts)}</robot>')
    joints = [f"v{index}" for index in range(6)]
    with pytest.raises(fflin.SingularInertiaError, match=r"lock=\['v0', 'v1'"):
        fflin.linearize(fflin.load(path))
    locked = fflin.load(path, lock=joints)
    assert locked.n == 0
    assert fflin.linearize(locked).M[3, 3] == pytest.approx(10.0)
