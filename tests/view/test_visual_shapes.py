"""Shapes of URDFs against Pinocchio's reader, inertia boxes, meshes, and the recorder."""

import importlib

import numpy as np
import pinocchio as pin
import pytest
import umsgpack
from scipy.spatial import cKDTree

import fflin
from fflin.robot.catalog import find_robot
from fflin.view.collada import read_collada
from fflin.view.meshes import _triangles, load_mesh
from fflin.view.shapes import find_mesh, shapes

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


def tetrahedron(path):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    lines = ["solid t"]
    for face in faces:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += ["vertex {} {} {}".format(*corners[i]) for i in face]
        lines += ["endloop", "endfacet"]
    path.write_text("\n".join([*lines, "endsolid t", ""]))
    return path


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["ets_vii", "canadarm2", "dual_arm", "talos", "panda", "tiago"])
def test_shapes_stand_where_pinocchio_puts_them(name):
    robot = fflin.load(name)
    found, notes = shapes(robot)
    file = find_robot(name)
    model = pin.buildModelFromUrdf(str(file.path), pin.JointModelFreeFlyer())
    geometry = pin.buildGeomFromUrdf(
        model, str(file.path), pin.GeometryType.VISUAL, [str(p) for p in file.package_dirs]
    )
    theirs = sorted(
        (model.names[g.parentJoint], *np.round(g.placement.homogeneous, 9).ravel())
        for g in geometry.geometryObjects
    )
    ours = sorted(
        (robot.model.names[s.joint], *np.round(s.placement.homogeneous, 9).ravel()) for s in found
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
        return [data.oMi[s.joint].act(s.placement).homogeneous for s in shapes(robot)[0]]

    np.testing.assert_allclose(placed(free, q), placed(locked, r), atol=1e-12)


def test_inertia_boxes_have_the_inertia_of_the_bodies():
    """A uniform box of a body's mass at the box's place has the body's inertia."""
    rng = np.random.default_rng(1)
    root = pin.Model()
    joint = root.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint")
    for k in range(4):
        box = pin.Inertia.FromBox(rng.uniform(1, 9), *rng.uniform(0.2, 2.0, 3))
        root.appendBodyToJoint(joint, box, pin.SE3.Random())
        if k < 3:
            joint = root.addJoint(joint, pin.JointModelRX(), pin.SE3.Random(), f"j{k}")
    robot = fflin.from_model(root, name="code")
    found, notes = shapes(robot)
    assert "no visual geometry" in notes[0]
    assert [s.joint for s in found] == [1, 2, 3, 4]
    for shape in found:
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
    np.testing.assert_allclose(box.placement.rotation @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    assert other.mesh == mesh and other.color is None


def test_a_missing_mesh_and_a_malformed_visual_leave_the_rest(tmp_path):
    more = "<visual><geometry><sphere radius='x'/></geometry></visual><visual/>"
    found, notes = shapes(fflin.load(write(tmp_path, "package://nowhere/a.stl", more)))
    assert [shape.kind for shape in found] == ["box"]
    assert len(notes) == 2
    assert "package://nowhere/a.stl" in notes[0] and "line 8, 8" in notes[1]


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
    robot = fflin.load(write(tmp_path, "package://pkg/m.stl"), package_dirs=[tmp_path / "ws"])
    assert not shapes(robot)[1]
    with pytest.raises(fflin.InputError, match="package_dirs is"):
        fflin.load("cubesat", package_dirs="meshes")


def area(vertices, faces):
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("robot", ["panda", "anymal", "kinova"])
def test_collada_has_the_triangles_of_pinocchios_loader(robot):
    paths = {s.mesh for s in shapes(fflin.load(robot))[0] if s.mesh}
    assert paths
    for path in paths:
        parts = read_collada(path)
        assert parts is not None, path
        vertices, faces = _triangles(path)
        corners = np.concatenate([v[f].reshape(-1, 3) for v, f, _ in parts])
        # Assimp leaves out triangles without area.
        assert len(corners) / 3 == pytest.approx(len(faces), rel=1e-3)
        for ours, theirs in ((corners.min(0), vertices.min(0)), (corners.max(0), vertices.max(0))):
            np.testing.assert_allclose(ours, theirs, atol=1e-6)
        if len(parts) == 1:  # of several, coal 3.0 mixes up the vertices
            whole = area(*parts[0][:2])
            assert whole == pytest.approx(area(vertices, faces), rel=1e-5), path
    assert any(color for path in paths for _, _, color in read_collada(path))


COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="centimeter" meter="0.01"/><up_axis>Y_UP</up_axis></asset>
<library_effects><effect id="e"><profile_COMMON><technique sid="t"><phong>
<diffuse><color>1 0.5 0 1</color></diffuse></phong></technique></profile_COMMON></effect>
</library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">0 0 0 1 0 0 0 2 0 0 0 3</float_array>
<technique_common><accessor source="#a" count="4" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<polylist material="s" count="2"><input semantic="VERTEX" source="#v" offset="0"/>
<vcount>3 4</vcount><p>0 2 1 0 1 2 3</p></polylist></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="w"><node id="n1">
<translate>1 2 3</translate><rotate>0 0 1 90</rotate><node id="n2"><rotate>1 0 0 30</rotate>
<scale>1 2 3</scale><instance_geometry url="#g"><bind_material><technique_common>
<instance_material symbol="s" target="#m"/></technique_common></bind_material>
</instance_geometry></node></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#w"/></scene></COLLADA>"""


def test_collada_composes_the_transforms_of_its_nodes(tmp_path):
    path = tmp_path / "m.dae"
    path.write_text(COLLADA)
    ((vertices, faces, color),) = read_collada(path)
    assert color == (1.0, 0.5, 0.0, 1.0) and len(faces) == 3
    theirs = 0.01 * _triangles(path)[0]  # Pinocchio's loader pays no heed to the unit either
    assert {tuple(x) for x in np.round(vertices, 6)} == {tuple(x) for x in np.round(theirs, 6)}


def test_welding_keeps_a_mesh_within_its_grid():
    path = next(s.mesh for s in shapes(fflin.load("solo12"))[0] if s.mesh)
    vertices, faces = _triangles(path)
    (mesh,) = load_mesh(path)
    extent = np.ptp(vertices, axis=0).max()
    distance, _ = cKDTree(mesh.vertices).query(vertices[np.unique(faces)])
    assert distance.max() < extent / 400.0 * np.sqrt(3.0)
    assert 0 < len(mesh.faces) <= len(faces)
    assert area(mesh.vertices.astype(float), mesh.faces) == pytest.approx(
        area(vertices, faces), rel=0.03
    )


def test_a_mesh_is_scaled_and_mirrored_and_then_placed(tmp_path):
    from fflin.view.recorder import Recorder
    from fflin.view.scene import Drawing, Visualizer

    tetrahedron(tmp_path / "t.stl")
    path = write(
        tmp_path,
        more='<visual><origin xyz="1 0 0" rpy="0.3 0.2 0.1"/>'
        '<geometry><mesh filename="t.stl" scale="0.5 -2 3"/></geometry></visual>',
    )
    placement = pin.SE3(pin.rpy.rpyToMatrix(0.3, 0.2, 0.1), np.array([1.0, 0, 0]))
    corners = np.array([[0, 0, 0], [0.5, 0, 0], [0, -2, 0], [0, 0, 3.0]])
    theirs = np.array([placement.act(corner) for corner in corners])

    window = Recorder()
    Drawing(fflin.load(path), Visualizer(window=window)["robot"])
    pieces = [umsgpack.unpackb(each) for each in window.commands()]
    pieces = [each["object"] for each in pieces if each["type"] == "set_object"]
    (piece,) = (each for each in pieces if each["geometries"][0]["type"] == "BufferGeometry")
    data = piece["geometries"][0]["data"]["attributes"]["position"]["array"].data
    vertices = np.frombuffer(data, dtype="<f4").reshape(-1, 3)
    matrix = np.reshape(piece["object"]["matrix"], (4, 4)).T
    ours = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(cKDTree(ours).query(theirs)[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(cKDTree(theirs).query(ours)[0], 0.0, atol=1e-6)


def test_the_recorder_keeps_the_last_value_of_a_property_per_path():
    from fflin.view.recorder import Recorder
    from fflin.view.scene import Visualizer

    g = importlib.import_module("meshcat.geometry")  # after fflin.scene, which quiets it

    forwarded = []
    window = Recorder(forwarded.append)
    scene = Visualizer(window=window)
    for shift in range(5):
        scene["a"].set_transform(pin.SE3(np.eye(3), np.full(3, shift)).homogeneous)
        scene["a"].set_property("visible", bool(shift % 2))
        scene["a"].set_object(g.Box([1, 1, shift + 1]))
        scene["b/c"].set_object(g.Sphere(1))
    kept = [umsgpack.unpackb(command) for command in window.commands()]
    assert [(c["type"], c["path"]) for c in kept] == [
        ("set_object", "/meshcat/a"),
        ("set_transform", "/meshcat/a"),
        ("set_property", "/meshcat/a"),
        ("set_object", "/meshcat/b/c"),
    ]
    assert kept[0]["object"]["geometries"][0]["depth"] == 5
    assert kept[1]["matrix"][12:15] == [4, 4, 4] and kept[2]["value"] is False
    assert len(forwarded) == 20
    scene["b"].delete()
    assert len(list(window.commands())) == 3
