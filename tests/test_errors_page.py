"""The table of errors in docs/errors.md says what the code says."""

import re
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support import errors_page
from tests.support.messages import COMMAND

# What brings each error of docs/errors.md, in its order, and a word of its sentence.
BEFORE = """robot = fflin.load("planar_detumble")
lin = fflin.linearize(robot)
arm = fflin.load("planar_detumble", inputs=[fflin.JointTorque("joint_1")])
falling = fflin.load("planar_detumble", gravity=(0, 0, -9.81))
origin = pin.SE3.Identity()
turned = pin.SE3(pin.rpy.rpyToMatrix(np.pi, 0, 0), np.zeros(3))
K = fflin.lqr(lin).K
def edited(name):
    lin.save(name)
    Path(name).write_text(Path(name).read_text().replace("18", "19", 1))
    return name"""
ERRORS = [
    ('fflin.load("ets_vi")', "ets_vi"),
    ('fflin.configuration(robot, {"joint_9": 0.1})', "joint_9"),
    ('fflin.bryson(lin, {"q_x": 0.1})', "q_x"),
    ('fflin.linearize(robot.replace(outputs=[fflin.FramePose("tool")]))', "tool"),
    ('fflin.load("none.urdf")', "none.urdf"),
    (
        'Path("a.urdf").write_text("<robot name=\'a\'/>"); fflin.load("a.urdf")',
        "<link>",
    ),
    (
        'Path("b.urdf").write_text("<robot name=\'b\'><link name=\'l\'>"); fflin.load("b.urdf")',
        "b.urdf",
    ),
    ('lin.save("model.txt")', "'.txt'"),
    ('fflin.LinearModel.load(edited("c.json"))', "sha256"),
    ('fflin.Gain.load("none.npz")', "none.npz"),
    ("fflin.from_model(pin.buildSampleModelManipulator())", "JointModelRX"),
    ('fflin.linearize(fflin.load("romeo"))', "'LHand'"),
    (
        "robot.model.inertias[1] = pin.Inertia.FromSphere(9.0, 1.0); fflin.linearize(robot)",
        "root_joint",
    ),
    ("fflin.ReactionWheel((0, 0, 0))", "axis"),
    ("fflin.linearize(robot, q=[0.0])", "(13,)"),
    ("fflin.linearize(robot, q=np.zeros(robot.nq))", "q[3:7]"),
    (
        "fflin.linearize(robot, fflin.configuration(robot, base=turned), reference=origin)",
        "180 deg",
    ),
    ("fflin.lqr(fflin.linearize(arm.replace(gravity=(0, 0, -9.81))))", "v_b.z"),
    ("fflin.lqr(fflin.linearize(arm))", "momentum of joint_2"),
    (
        "fflin.kalman(fflin.linearize(robot.replace(outputs=[fflin.Momentum()])), 1e-3, 1e-4)",
        "q_b.x",
    ),
    ("fflin.lqr(lin, -1.0, 1.0)", "q_b.x"),
    ("fflin.StateFeedback(lin, np.zeros((3, 3)))", "(9, 18)"),
    (
        "fflin.acceleration_lqr(fflin.linearize(robot.replace(stiffness=10.0)), 1.0, 1.0, 1.0)",
        "lqr",
    ),
    ("fflin.simulate(robot, lambda t, q, v: np.zeros(3), duration=1.0)", "(9,)"),
    (
        "fflin.simulate(robot, fflin.StateFeedback(lin, K), duration=1.0, dt=0.1, sample=0.25)",
        "sample",
    ),
    (
        "fflin.simulate(robot, fflin.StateFeedback(lin, 1e6 * K), duration=1.0, dt=0.5)",
        "dt",
    ),
    (
        'fflin.simulate(fflin.load("ets_vii"), fflin.StateFeedback(lin, K), duration=1.0)',
        "planar_detumble",
    ),
    ('fflin.monte_carlo(robot, None, {"tau_m": 0.1}, runs=2, duration=1.0)', "tau_m"),
    ('sys.modules["control"] = None; lin.to_control()', "fflin[control]"),
]


@pytest.mark.parametrize("k", range(len(ERRORS)), ids="row_{:02d}".format)
def test_an_error_of_the_table_reads_as_it_stands_there(
    k, tmp_path, monkeypatch, request
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "control", sys.modules.get("control"))
    known = {"fflin": fflin, "np": np, "pin": pin, "Path": Path, "sys": sys}
    row = errors_page.rows()[k]
    code, keyword = ERRORS[k]
    exec(BEFORE, known)
    with pytest.raises(getattr(fflin, row[0]), match=re.escape(keyword)) as caught:
        exec(code, known)
    message = type(caught.value).__name__, str(caught.value)
    if not (
        errors_page.agrees(row, *message) or request.config.getoption("write_messages")
    ):
        pytest.fail(
            f"`{COMMAND}` writes to docs/errors.md: {': '.join(message)}", pytrace=False
        )


def test_every_error_of_the_table_is_tried():
    assert len(errors_page.rows()) == len(ERRORS)
