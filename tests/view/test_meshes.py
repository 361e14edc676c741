"""Mesh files: their triangles against Pinocchio's loader, colours, and what welding leaves."""

import os

import numpy as np
import pytest
from scipy.spatial import cKDTree

import fflin
from fflin.view.shapes import _colored, _triangles, load_mesh, shapes
from tests.support.meshes import tetrahedron


def area(vertices, faces):
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "robot",
    [pytest.param(name, marks=pytest.mark.exhaustive) for name in ("panda", "anymal")]
    + ["kinova"],
)
def test_collada_has_the_triangles_of_pinocchios_loader(robot):
    paths = {s.mesh for s in shapes(fflin.load(robot))[0] if s.mesh}
    assert paths
    for path in paths:
        parts = _colored(path)
        if path.name == "anymal_foot.dae":  # refers to a texture that it does not name
            assert not parts and load_mesh(path)
            continue
        vertices, faces = _triangles(path)
        corners = np.concatenate([v[f].reshape(-1, 3) for v, f, _ in parts])
        # Assimp leaves out triangles without area.
        assert len(corners) / 3 == pytest.approx(len(faces), rel=1e-3)
        for ours, theirs in (
            (corners.min(0), vertices.min(0)),
            (corners.max(0), vertices.max(0)),
        ):
            np.testing.assert_allclose(ours, theirs, atol=1e-6)
        if len(parts) == 1:  # of several, coal 3.0 mixes up the vertices
            whole = area(*parts[0][:2])
            assert whole == pytest.approx(area(vertices, faces), rel=1e-5), path
    assert any(color for path in paths for _, _, color in _colored(path))


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
    ((vertices, faces, color),) = _colored(path)
    assert color == pytest.approx((1.0, 0.5, 0.0, 1.0), abs=1 / 255) and len(faces) == 3
    # Pinocchio's loader pays no heed to the unit either
    theirs = 0.01 * _triangles(path)[0]
    assert {tuple(x) for x in np.round(vertices, 6)} == {
        tuple(x) for x in np.round(theirs, 6)
    }


def test_a_mesh_that_is_mended_is_read_again(tmp_path):
    path = tmp_path / "m.stl"
    path.write_text("garbage")
    with pytest.raises(ValueError, match="read"):
        load_mesh(path)
    for length in (1, 2):
        tetrahedron(path, length)
        (mesh,) = load_mesh(path)
        assert np.ptp(mesh.vertices, axis=0).max() == length
        os.utime(path, (length, length))  # however coarse the clock of the disk is
    path.unlink()
    with pytest.raises(ValueError, match="No such file"):
        load_mesh(path)


def test_dust_is_not_a_mesh(tmp_path):
    path = tmp_path / "m.obj"
    corners = ("0 0 0", "1e-4 0 0", "0 1e-4 0", "1 1 1", "1.0001 1 1", "1 1.0001 1")
    path.write_text(
        "".join(f"v {corner}\n" for corner in corners) + "f 1 2 3\nf 4 5 6\n"
    )
    with pytest.raises(ValueError, match="triangle"):
        load_mesh(path)


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


NODES = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset/><library_nodes>{}</library_nodes></COLLADA>"""


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ('<node id="a"><instance_node url="#a"/></node>', "contains itself"),
        (
            '<node id="a"><node id="b"><instance_node url="#c"/></node></node>'
            '<node id="c"><instance_node url="#a"/></node>',
            "contains itself",
        ),
        (
            "".join(
                f'<node id="n{k}">'
                + 2 * f'<instance_node url="#n{k + 1}"/>'
                + "</node>"
                for k in range(40)
            ),
            "nodes",
        ),
    ],
)
def test_nodes_that_would_be_drawn_without_end_are_refused(nodes, message, tmp_path):
    path = tmp_path / "a.dae"
    path.write_text(NODES.format(nodes))
    with pytest.raises(ValueError, match=message):
        load_mesh(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes")
def test_meshes_do_not_wait_for_pipes(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    (tmp_path / "a.obj").write_text(f"mtllib pipe\n{triangle}")
    buffers = (
        '{"asset": {"version": "2.0"}, "buffers": [{"uri": "pip%65", "byteLength": 9}]}'
    )
    (tmp_path / "a.gltf").write_text(buffers)
    for name in ("a.obj", "a.gltf"):
        with pytest.raises(ValueError, match="not a regular file"):
            load_mesh(tmp_path / name)
    (tmp_path / "b.obj").write_text(f"mtllib nosuch.mtl\n{triangle}")
    assert len(load_mesh(tmp_path / "b.obj")[0].faces) == 1


@pytest.mark.filterwarnings("ignore")
def test_a_mesh_of_an_impossible_unit_is_refused(tmp_path):
    path = tmp_path / "a.dae"
    path.write_text(COLLADA.replace('name="centimeter" meter="0.01"', 'meter="1e300"'))
    with pytest.raises(ValueError, match="check its unit"):
        load_mesh(path)
