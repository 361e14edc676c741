"""The table of errors in docs/errors.md says what the code says."""

import re
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import fflin

DOCS = Path(__file__).parents[1] / "docs"
# What brings each error of docs/errors.md, in its order.
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
    'fflin.load("ets_vi")',
    'fflin.configuration(robot, {"joint_9": 0.1})',
    'fflin.bryson(lin, {"q_x": 0.1})',
    'fflin.linearize(robot.replace(outputs=[fflin.FramePose("tool")]))',
    'fflin.load("none.urdf")',
    'Path("a.urdf").write_text("<robot name=\'a\'/>"); fflin.load("a.urdf")',
    'Path("b.urdf").write_text("<robot name=\'b\'><link name=\'l\'>"); fflin.load("b.urdf")',
    'lin.save("model.txt")',
    'fflin.LinearModel.load(edited("c.json"))',
    'fflin.Gain.load("none.npz")',
    "fflin.from_model(pin.buildSampleModelManipulator())",
    'fflin.linearize(fflin.load("romeo"))',
    "robot.model.inertias[1] = pin.Inertia.FromSphere(9.0, 1.0); fflin.linearize(robot)",
    "fflin.ReactionWheel((0, 0, 0))",
    "fflin.linearize(robot, q=[0.0])",
    "fflin.linearize(robot, q=np.zeros(robot.nq))",
    "fflin.linearize(robot, fflin.configuration(robot, base=turned), reference=origin)",
    "fflin.equilibrium(falling, robot.neutral()); fflin.lqr(fflin.linearize(falling))",
    "fflin.lqr(fflin.linearize(arm))",
    "fflin.kalman(fflin.linearize(robot.replace(outputs=[fflin.Momentum()])), 1e-3, 1e-4)",
    "fflin.lqr(lin, -1.0, 1.0)",
    "fflin.StateFeedback(lin, np.zeros((3, 3)))",
    "fflin.acceleration_lqr(fflin.linearize(robot.replace(stiffness=10.0)), 1.0, 1.0, 1.0)",
    "fflin.simulate(robot, lambda t, q, v: np.zeros(3), duration=1.0)",
    "fflin.simulate(robot, fflin.StateFeedback(lin, K), duration=1.0, dt=0.1, sample=0.25)",
    "fflin.simulate(robot, fflin.StateFeedback(lin, 1e6 * K), duration=1.0, dt=0.5)",
    'fflin.simulate(fflin.load("ets_vii"), fflin.StateFeedback(lin, K), duration=1.0)',
    'fflin.monte_carlo(robot, None, {"tau_m": 0.1}, runs=2, duration=1.0)',
    'sys.modules["control"] = None; lin.to_control()',
]


def told_errors():
    """Yield class and message of each row of the table."""
    text = (DOCS / "errors.md").read_text(encoding="utf-8")
    for kind, words in re.findall(r"^\| `(\w+)`: (.*?) \| ", text, re.MULTILINE):
        yield kind, re.sub(r"\\([|<])", r"\1", words)


@pytest.mark.parametrize(("code", "told"), [*zip(ERRORS, told_errors(), strict=True)])
def test_an_error_of_the_table_reads_as_it_stands_there(code, told, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "control", sys.modules.get("control"))
    known = {"fflin": fflin, "np": np, "pin": pin, "Path": Path, "sys": sys}
    kind, words = told
    pattern = ".*".join(map(re.escape, re.split(r" ?\.\.\.", words)))
    exec(BEFORE, known)
    with pytest.raises(getattr(fflin, kind)) as caught:
        exec(code, known)
    assert type(caught.value).__name__ == kind
    assert re.fullmatch(pattern, str(caught.value)), str(caught.value)
