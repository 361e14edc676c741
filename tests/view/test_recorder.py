"""What the recorder keeps of a scene."""

import importlib

import numpy as np
import pinocchio as pin
import umsgpack


def test_the_recorder_keeps_the_last_value_of_a_property_per_path():
    from fflin.view.page import Recorder, Visualizer

    # after fflin.scene, which quiets it
    g = importlib.import_module("meshcat.geometry")

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
