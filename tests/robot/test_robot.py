"""Loading, locking and configuring robots, and what is refused."""

import pickle
import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.robot.catalog import bundled_directory
from tests.support.robots import BUNDLED


def free_flyer(*joints):
    """A model of a free-flyer and one joint after the other."""
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(1, pin.Inertia.Random(), pin.SE3.Identity())
    for index, joint in enumerate(joints):
        parent = model.addJoint(index + 1, joint, pin.SE3.Random(), f"joint_{index}")
        model.appendBodyToJoint(parent, pin.Inertia.Random(), pin.SE3.Random())
    return model


def test_bundled_names_come_first():
    names = (
        *("astrobee_arm", "berthed_stack", "canadarm2", "cubesat", "cubesat_magnetic"),
        "dual_arm",
        *("ets_vii", "grasped_target", "inspector", "inspector_flexible"),
        *("planar_detumble", "scissor_mast", "servicer_7dof"),
    )
    assert fflin.list_robots()[: len(names)] == names
    closed = {"berthed_stack", "grasped_target", "scissor_mast"}
    assert (
        set(names) - set(BUNDLED)
        == {
            "inspector_flexible",
            "cubesat_magnetic",
        }
        | closed
    )


def test_a_bundled_robot_file_loads_by_its_name():
    robot = fflin.load("inspector_flexible")
    assert robot.name == "inspector_flexible"
    assert len(robot.modes) == 6


def test_a_urdf_has_the_name_before_a_robot_file():
    # inspector.toml has springs at its hinges, and the URDF has none.
    assert not fflin.load("inspector").stiffness
    assert fflin.load("inspector.toml").stiffness


def test_list_of_robots_ends_with_example_robot_data():
    assert "talos" in fflin.list_robots()


def test_name_and_path_give_the_same_robot():
    by_name = fflin.load("ets_vii")
    path = bundled_directory() / "ets_vii.urdf"
    for by_path in (fflin.load(path), fflin.load(str(path))):
        assert by_path.model == by_name.model
        assert by_path.urdf_sha256 == by_name.urdf_sha256
    assert by_name.n == 6 and by_name.joint_names == tuple(
        f"joint_{i}" for i in range(1, 7)
    )
    assert by_name.urdf == path
    assert not by_name.model.gravity.linear.any()
    assert by_name.mass == pytest.approx(2690.4)
    assert repr(by_name) == "Robot('ets_vii', n=6, mass=2690.4 kg)"


def test_example_robots_load_without_their_loaders_meshes():
    robot = fflin.load("panda")
    assert robot.model.joints[1].shortname() == "JointModelFreeFlyer"
    assert robot.urdf.name == "panda.urdf"


def test_configuration_places_joints_and_base():
    robot = fflin.load("ets_vii")
    base = pin.SE3(pin.rpy.rpyToMatrix(0.1, 0.2, 0.3), np.array([1.0, 2, 3]))
    q = fflin.configuration(robot, {"joint_2": 4.0}, base)
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    assert data.oMi[1].isApprox(base)
    joint = robot.joint("joint_2")
    assert q[joint.idx_q : joint.idx_q + 2] == pytest.approx([np.cos(4.0), np.sin(4.0)])
    assert (fflin.configuration(robot) == pin.neutral(robot.model)).all()
    with pytest.raises(fflin.UnknownNameError, match="joint_2"):
        robot.joint(["joint_2"])


def test_locked_joints_are_welded():
    robot = fflin.load("ets_vii")
    locked = fflin.load("ets_vii", lock={"joint_2": 0.7, "joint_5": None})
    assert locked.joint_names == ("joint_1", "joint_3", "joint_4", "joint_6")
    assert locked.mass == pytest.approx(robot.mass)
    full = fflin.linearize(robot, fflin.configuration(robot, {"joint_2": 0.7})).M
    keep = [0, 1, 2, 3, 4, 5, 6, 8, 9, 11]
    assert fflin.linearize(locked).M == pytest.approx(
        full[np.ix_(keep, keep)], rel=1e-12, abs=1e-9
    )
    assert fflin.load("ets_vii", lock=["joint_1"]).n == 5
    assert fflin.load("ets_vii", lock="joint_1").n == 5


@pytest.mark.parametrize(
    ("joint", "kind"),
    [
        (pin.JointModelSpherical(), "Spherical of 3"),
        (pin.JointModelSphericalZYX(), "SphericalZYX of 3"),
        (pin.JointModelPlanar(), "Planar of 3"),
        (pin.JointModelFreeFlyer(), "FreeFlyer of 6"),
        (pin.JointModelTranslation(), "Translation of 3"),
    ],
)
def test_joints_of_more_freedom_are_refused_unless_locked(joint, kind):
    model = free_flyer(pin.JointModelRX(), joint)
    with pytest.raises(fflin.ModelError, match=f"'joint_1'.*{kind}"):
        fflin.from_model(model)
    robot = fflin.from_model(model, lock=["joint_1"])
    assert robot.joint_names == ("joint_0",)
    assert fflin.check(robot, fflin.linearize(robot)).ok


def test_from_model_takes_a_copy():
    model = free_flyer(pin.JointModelRX())
    model.gravity.linear = np.array([0, 0, -9.81])
    before = model.copy()
    robot = fflin.from_model(model, name="mine")
    assert robot.name == "mine" and robot.urdf is None
    assert not robot.model.gravity.linear.any()
    assert model == before


def test_mjcf_is_taken_as_a_model(tmp_path):
    document = """<mujoco><worldbody><body name="base"><freejoint/>
      <inertial pos="0 0 0" mass="3" diaginertia="1 1 1"/>
      <body name="arm" pos="0 0 1"><joint name="hinge" type="hinge" axis="0 1 0"/>
        <inertial pos="0 0 .5" mass="2" diaginertia=".1 .1 .1"/></body>
    </body></worldbody></mujoco>"""
    (tmp_path / "r.xml").write_text(document)
    robot = fflin.from_model(pin.buildModelFromMJCF(str(tmp_path / "r.xml")))
    assert robot.joint_names == ("hinge",) and robot.mass == 5.0
    assert fflin.check(robot, fflin.linearize(robot)).ok


def test_pinocchios_own_mimic_joints_are_refused_with_the_way_out():
    urdf = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/>
      <joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>
      <joint name="k" type="continuous"><parent link="a"/><child link="c"/>
      <mimic joint="j"/></joint></robot>"""
    model = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer(), True)
    with pytest.raises(fflin.ModelError, match=r"'k'.*JointModelMimic"):
        fflin.from_model(model)


def test_an_invalid_robot_is_refused():
    lin = fflin.linearize(fflin.load("cubesat"))
    for call in (
        lambda: fflin.linearize("cubesat"),
        lambda: fflin.configuration("cubesat"),
        lambda: fflin.StateMap(None),
        lambda: fflin.check("cubesat", lin),
        lambda: fflin.check(fflin.load("cubesat"), lin.A),
        lambda: fflin.configuration(fflin.load("cubesat"), base=np.eye(4)),
    ):
        with pytest.raises(
            fflin.InputError, match=r"\b(str|NoneType|LinearModel|ndarray)\b"
        ):
            call()
    with pytest.raises(fflin.ModelError, match="pin"):
        fflin.from_model("cubesat")


def test_arguments_of_the_wrong_kind_are_reported():
    robot = fflin.load("ets_vii")
    for call in (
        lambda: fflin.load(None),
        lambda: fflin.load(3),
        lambda: fflin.load(b"ets_vii"),
        lambda: fflin.load("ets_vii", lock=3),
        lambda: fflin.load("ets_vii", lock=[3]),
        lambda: fflin.load("ets_vii", lock=""),
        lambda: fflin.load("ets_vii", lock=["universe"]),
        lambda: fflin.load("ets_vii", lock=["root_joint"]),
        lambda: fflin.configuration(robot, [0.1] * 6),
        lambda: fflin.configuration(robot, {3: 1.0}),
        lambda: fflin.configuration(robot, {"joint_1": 10**400}),
        lambda: fflin.linearize(robot, frame=np.array("hybrid")),
        lambda: fflin.linearize(robot).is_equilibrium("a"),
    ):
        with pytest.raises(fflin.FflinError):
            call()


def test_locked_joints_are_on_record(tmp_path):
    robot = fflin.load("ets_vii", lock={"joint_1": 0.7, "joint_4": None})
    assert robot.locked == ("joint_1=0.7", "joint_4=0.0")
    lin = fflin.linearize(robot)
    for ending in (".npz", ".mat", ".json"):
        lin.save(tmp_path / f"m{ending}")
        assert fflin.LinearModel.load(tmp_path / f"m{ending}").locked == robot.locked
    with pytest.raises(fflin.InputError, match="'joint_1'"):
        fflin.configuration(robot, {"joint_1": 0.1})


def test_model_without_a_free_flyer_is_refused():
    fixed = pin.Model()
    fixed.addJoint(0, pin.JointModelRX(), pin.SE3.Identity(), "joint")
    with pytest.raises(fflin.ModelError, match="JointModelRX"):
        fflin.from_model(fixed)
    with pytest.raises(fflin.ModelError, match="root joint"):
        fflin.from_model(pin.Model())
    two = free_flyer()
    two.addJoint(0, pin.JointModelRX(), pin.SE3.Identity(), "stray")
    with pytest.raises(fflin.ModelError, match="'stray'"):
        fflin.from_model(two)


def test_joints_out_of_depth_first_order_are_refused():
    model = free_flyer(pin.JointModelRX())
    for parent, name in ((1, "other"), (2, "late")):
        index = model.addJoint(parent, pin.JointModelRX(), pin.SE3.Random(), name)
        model.appendBodyToJoint(index, pin.Inertia.Random(), pin.SE3.Random())
    with pytest.raises(fflin.ModelError, match="depth-first"):
        fflin.from_model(model)


def _set_parent(model):
    model.parents[3] = 5


def _set_mass(model):
    model.inertias[3] = pin.Inertia(-1.0, np.zeros(3), np.eye(3))


def _set_nan_mass(model):
    model.inertias[3] = pin.Inertia(np.nan, np.zeros(3), np.eye(3))


def _set_lever(model):
    model.inertias[3] = pin.Inertia(1.0, np.array([0.0, np.inf, 0.0]), np.eye(3))


def _set_inertia(model):
    moments = np.array((1.0, 0, 0, 0, 1.0, 0, 1.0, 0, 0, -0.5))
    model.inertias[3] = pin.Inertia.FromDynamicParameters(moments)


def _set_armature(model):
    armature = model.armature.copy()
    armature[model.joints[3].idx_v] = -1.0
    model.armature = armature


def _set_translation(model):
    model.jointPlacements[3] = pin.SE3(np.eye(3), np.array([np.nan, 0.0, 0.0]))


def _set_rotation(model):
    model.jointPlacements[3] = pin.SE3(np.diag((1.0, 1.0, -1.0)), np.zeros(3))


def _set_scaled_rotation(model):
    model.jointPlacements[3] = pin.SE3(1.01 * np.eye(3), np.zeros(3))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_set_parent, "parent 5"),
        (_set_mass, "-1 kg"),
        (_set_nan_mass, "finite"),
        (_set_lever, "finite"),
        (_set_inertia, "-0.5, 1, 1"),
        (_set_armature, "armature"),
        (_set_translation, "finite"),
        (_set_rotation, "rotation"),
        (_set_scaled_rotation, "rotation"),
    ],
)
def test_unknown_names_are_refused(robots, spoil, words):
    model = robots["dual_arm"].model.copy()
    spoil(model)
    with pytest.raises(fflin.ModelError, match=re.escape(words)) as caught:
        fflin.from_model(model)
    assert f"joint '{model.names[3]}'" in str(caught.value)


def test_too_large_a_robot_is_refused():
    model = free_flyer(*[pin.JointModelRX() for _ in range(320)])
    with pytest.raises(fflin.ModelError, match=r"320 joints.*1\.0 GiB"):
        fflin.from_model(model)


def test_unknown_names_list_the_near_ones():
    with pytest.raises(fflin.UnknownNameError, match="'etsvii'"):
        fflin.load("etsvii")
    robot = fflin.load("ets_vii")
    with pytest.raises(fflin.UnknownNameError, match="'joint_7'"):
        fflin.configuration(robot, {"joint_7": 1.0})
    with pytest.raises(fflin.UnknownNameError, match="'panel'"):
        fflin.load("ets_vii", lock=["panel"])
    with pytest.raises(fflin.InputError, match="'joint_1'"):
        fflin.configuration(robot, {"joint_1": float("nan")})


def test_unreadable_and_malformed_files(tmp_path: Path):
    with pytest.raises(fflin.FileError, match="no file"):
        fflin.load(tmp_path / "none.urdf")
    with pytest.raises(fflin.FileError, match="folder"):
        fflin.load(tmp_path)
    for text, message in {
        "": "not well-formed",
        "<robot>": "not well-formed|no element found|unclosed",
        "<model/>": "<model>",
        "<robot name='r'><link name='a'/><link name='b'/></robot>": "bad.urdf.*(root|link)",
    }.items():
        path = tmp_path / "bad.urdf"
        path.write_text(text)
        with pytest.raises(fflin.UrdfError, match=message):
            fflin.load(path)


def test_robot_is_picklable_for_workers():
    robot = fflin.load("dual_arm")
    again = pickle.loads(pickle.dumps(robot))
    assert again.joint_names == robot.joint_names
    assert (fflin.linearize(again).B == fflin.linearize(robot).B).all()
    lin = pickle.loads(pickle.dumps(fflin.linearize(robot)))
    assert lin.certificate.route_B < 1e-10
