"""Shapes of URDFs against Pinocchio's reader, inertia boxes, and where meshes are found."""

import numpy as np
import pinocchio as pin
import pytest
import umsgpack
from scipy.spatial import cKDTree

import fflin
from fflin.robot.catalog import find_mesh, find_robot
from fflin.view.shapes import shapes
from tests.support.marks import exhaustive
from tests.support.meshes import tetrahedron
from tests.support.motions import settling

URDF = """<robot name="r">
  <material name="red"><color rgba="1 0 0 0.5"/></material>
  <link name="base">
    <inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>
      <geometry><box size="1 2 3"/></geometry><material name="red"/></visual>
    <visual><geometry><mesh filename="{mesh}"/></geometry></visual>
    {more}
  </link>
</robot>"""


def write(folder, mesh="missing.stl", more=""):
    path = folder / "r.urdf"
    path.write_text(URDF.format(mesh=mesh, more=more))
    return path


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "name", ["ets_vii", "canadarm2", "dual_arm", *exhaustive("talos", "panda", "tiago")]
)
def test_shapes_are_at_the_placements_of_pinocchio(name):
    robot = fflin.load(name)
    result, notes = shapes(robot)
    file = find_robot(name)
    model = pin.buildModelFromUrdf(str(file.path), pin.JointModelFreeFlyer())
    geometry = pin.buildGeomFromUrdf(
        model,
        str(file.path),
        pin.GeometryType.VISUAL,
        [str(p) for p in file.package_dirs],
    )
    theirs = sorted(
        (model.names[g.parentJoint], *np.round(g.placement.homogeneous, 9).ravel())
        for g in geometry.geometryObjects
    )
    ours = sorted(
        (robot.model.names[s.joint], *np.round(s.placement.homogeneous, 9).ravel())
        for s in result
    )
    assert not notes
    assert [row[0] for row in ours] == [row[0] for row in theirs]
    differences = [np.subtract(a[1:], b[1:]) for a, b in zip(ours, theirs, strict=True)]
    assert np.abs(differences).max() < 1e-8


def test_locked_joints_carry_their_shapes_along():
    free = fflin.load("servicer_7dof")
    locked = fflin.load("servicer_7dof", lock={"joint_2": 0.4})
    q = fflin.configuration(free, {"joint_2": 0.4, "joint_3": -0.8})
    r = fflin.configuration(locked, {"joint_3": -0.8})

    def placed(robot, q):
        data = robot.model.createData()
        pin.forwardKinematics(robot.model, data, q)
        return [
            data.oMi[s.joint].act(s.placement).homogeneous for s in shapes(robot)[0]
        ]

    np.testing.assert_allclose(placed(free, q), placed(locked, r), atol=1e-12)


def test_inertia_boxes_have_the_inertia_of_the_bodies():
    """A uniform box of a body's mass at the box's place has the body's inertia."""
    rng = np.random.default_rng(1)
    root = pin.Model()
    joint = root.addJoint(
        0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint"
    )
    for k in range(4):
        box = pin.Inertia.FromBox(rng.uniform(1, 9), *rng.uniform(0.2, 2.0, 3))
        root.appendBodyToJoint(joint, box, pin.SE3.Random())
        if k < 3:
            joint = root.addJoint(joint, pin.JointModelRX(), pin.SE3.Random(), f"j{k}")
    robot = fflin.from_model(root, name="code")
    result, notes = shapes(robot)
    assert "geometry" in notes[0]
    assert [s.joint for s in result] == [1, 2, 3, 4]
    for shape in result:
        inertia = root.inertias[shape.joint]
        box = shape.placement.act(pin.Inertia.FromBox(inertia.mass, *shape.size))
        assert box.isApprox(inertia, 1e-9)
        assert np.linalg.det(shape.placement.rotation) == pytest.approx(1.0)


def test_a_material_gives_colour_and_opacity(tmp_path):
    mesh = tetrahedron(tmp_path / "m.stl")
    robot = fflin.load(write(tmp_path, mesh.name))
    (box, other), notes = shapes(robot)
    assert not notes
    assert box.color == (1.0, 0.0, 0.0, 0.5) and box.size == (1.0, 2.0, 3.0)
    np.testing.assert_allclose(box.placement.translation, [1, 2, 3])
    np.testing.assert_allclose(
        box.placement.rotation @ [1, 0, 0], [0, 1, 0], atol=1e-12
    )
    assert other.mesh == mesh and other.color is None


def test_a_quaternion_turns_a_visual_as_it_turns_a_link(tmp_path):
    more = (
        '<visual><origin xyz="1 0 0" quat_xyzw="0 0 0.6 0.8"/>'
        '<geometry><box size="1 1 1"/></geometry></visual>'
    )
    (_, turned), _ = shapes(fflin.load(write(tmp_path, more=more)))
    expected = pin.Quaternion(np.array([0.0, 0.0, 0.6, 0.8])).matrix()
    np.testing.assert_allclose(turned.placement.rotation, expected, atol=1e-15)
    np.testing.assert_allclose(turned.placement.translation, [1, 0, 0])


def test_a_missing_mesh_and_a_malformed_visual_leave_the_rest(tmp_path):
    more = "<visual><geometry><sphere radius='x'/></geometry></visual><visual/>"
    result, notes = shapes(fflin.load(write(tmp_path, "package://nowhere/a.stl", more)))
    assert [shape.kind for shape in result] == ["box"]
    assert len(notes) == 2
    assert "package://nowhere/a.stl" in notes[0] and "line 8, 8" in notes[1]


@pytest.mark.parametrize("ending", ["stl", "obj", "dae"])
def test_where_no_mesh_can_be_read_there_are_boxes(ending, tmp_path):
    path = tmp_path / "r.urdf"
    text = URDF.format(mesh=f"m.{ending}", more="")
    start = text.index("<visual>")
    path.write_text(text[:start] + text[text.index("</visual>") + 9 :])
    (tmp_path / f"m.{ending}").write_bytes(b"garbage" * 20)
    robot = fflin.load(path)
    result, notes = shapes(robot)
    assert [shape.finish for shape in result] == ["inertia"]
    assert f"m.{ending}" in notes[0] and "read" in notes[0]
    assert "boxes" in notes[1]
    page = tmp_path / "m.html"
    with pytest.warns(fflin.FflinWarning, match="read"):
        fflin.visualize(robot, settling(robot, 1.0), html=page)
    assert page.stat().st_size > 1000
    with pytest.warns(fflin.FflinWarning, match="read"):
        fflin.visualize(robot, open=False).close()


def test_meshes_are_found_where_urdfs_say(tmp_path):
    package = tmp_path / "ws" / "pkg"
    (package / "urdf").mkdir(parents=True)
    mesh = tetrahedron(package / "m.stl")
    urdf = package / "urdf" / "r.urdf"
    for uri in ("../m.stl", mesh.as_uri(), str(mesh), "package://pkg/m.stl"):
        assert find_mesh(uri, urdf, ()).resolve() == mesh, uri
    assert find_mesh("package://pkg/none.stl", urdf, ()) is None
    elsewhere = tmp_path / "r.urdf"
    assert find_mesh("package://pkg/m.stl", elsewhere, ()) is None
    assert find_mesh("package://pkg/m.stl", elsewhere, (tmp_path / "ws",)) == mesh
    robot = fflin.load(
        write(tmp_path, "package://pkg/m.stl"), package_dirs=[tmp_path / "ws"]
    )
    assert not shapes(robot)[1]
    assert not shapes(fflin.load(robot.urdf, package_dirs=tmp_path / "ws"))[1]
    with pytest.raises(fflin.InputError, match="package_dirs"):
        fflin.load("cubesat", package_dirs=3)


def test_a_mesh_is_scaled_and_mirrored_and_then_placed(tmp_path):
    from fflin.view.page import Page

    tetrahedron(tmp_path / "t.stl")
    path = write(
        tmp_path,
        more='<visual><origin xyz="1 0 0" rpy="0.3 0.2 0.1"/>'
        '<geometry><mesh filename="t.stl" scale="0.5 -2 3"/></geometry></visual>',
    )
    placement = pin.SE3(pin.rpy.rpyToMatrix(0.3, 0.2, 0.1), np.array([1.0, 0, 0]))
    corners = np.array([[0, 0, 0], [0.5, 0, 0], [0, -2, 0], [0, 0, 3.0]])
    theirs = np.array([placement.act(corner) for corner in corners])

    robot = fflin.load(path)
    page = Page(robot, robot.neutral(), "space", None, None)
    pieces = [umsgpack.unpackb(item) for item in page.window.commands()]
    pieces = [item["object"] for item in pieces if item["type"] == "set_object"]
    (piece,) = (
        item for item in pieces if item["geometries"][0]["type"] == "BufferGeometry"
    )
    data = piece["geometries"][0]["data"]["attributes"]["position"]["array"].data
    vertices = np.frombuffer(data, dtype="<f4").reshape(-1, 3)
    matrix = np.reshape(piece["object"]["matrix"], (4, 4)).T
    ours = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(cKDTree(ours).query(theirs)[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(cKDTree(theirs).query(ours)[0], 0.0, atol=1e-6)


def test_a_captured_payload_is_drawn_at_its_grasp():
    robot, other = fflin.load("servicer_7dof"), fflin.load("ets_vii")
    at = pin.SE3(pin.rpy.rpyToMatrix(0.1, 0.2, 0.3), np.array([0.0, 0.1, 0.5]))
    whole = fflin.capture(robot, "tool", other, placement=at).robot
    count, theirs = len(shapes(robot)[0]), shapes(other)[0]
    result = shapes(whole)[0]
    assert len(result) == count + len(theirs)
    data, alone = whole.create_data(), other.create_data()
    pin.framesForwardKinematics(whole.model, data, whole.neutral())
    pin.forwardKinematics(other.model, alone, other.neutral())
    held = data.oMf[whole.model.getFrameId("tool")] * at
    for shape, before in zip(result[count:], theirs, strict=True):
        placement = data.oMi[shape.joint] * shape.placement
        assert placement.isApprox(
            held * alone.oMi[before.joint] * before.placement, 1e-9
        )
    body = pin.Inertia(5.0, np.zeros(3), np.eye(3))
    assert (
        shapes(fflin.capture(robot, "tool", body).robot)[0][count].finish == "inertia"
    )


def test_the_links_of_missing_meshes_are_named(tmp_path):
    (note,) = shapes(fflin.load(write(tmp_path)))[1]
    assert "'missing.stl (link base)'" in note and "not drawn" in note
