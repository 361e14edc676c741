"""The reader gives the model that Pinocchio builds from the same file, where it builds one."""

import re
import sys
import warnings
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from example_robot_data.robots_loader import getModelPath

import fflin
from fflin.base.errors import FflinError
from fflin.robot.urdf.reader import describe
from tests.support.patience import finished
from tests.support.robots import mostly

BUNDLED = Path(__file__).parents[3] / "robots"
EXAMPLES = Path(getModelPath("talos_data/robots/talos_reduced.urdf")).resolve()
FILES = sorted(EXAMPLES.glob("**/*.urdf"))

# What the reader refuses, and the words of the reason. Pinocchio builds the first two of them.
REFUSED = {
    "alex_psyonic_hands.urdf": "'index_q1'",
    "romeo_laas_small.urdf": "-0.0213",
    "falcon.urdf": "'Z_propeller'",
    "ur3.urdf": "<link>",
}


def assert_same(model: pin.Model, expected: pin.Model) -> None:
    assert list(model.names) == list(expected.names)
    assert model.name == expected.name
    assert list(model.parents) == list(expected.parents)
    # Their text holds type, indices and axis.
    assert [str(joint) for joint in model.joints] == [
        str(joint) for joint in expected.joints
    ]
    for placement, other in zip(
        model.jointPlacements, expected.jointPlacements, strict=True
    ):
        assert np.array_equal(placement.homogeneous, other.homogeneous)
    for inertia, other in zip(model.inertias, expected.inertias, strict=True):
        assert np.array_equal(inertia.matrix(), other.matrix())
    for name in (
        "lowerPositionLimit",
        "upperPositionLimit",
        "effortLimit",
        "velocityLimit",
        "damping",
        "friction",
        "armature",
    ):
        assert np.array_equal(getattr(model, name), getattr(expected, name)), name
    assert len(model.frames) == len(expected.frames)
    for frame, other in zip(model.frames, expected.frames, strict=True):
        assert (frame.name, frame.type, frame.parentJoint) == (
            other.name,
            other.type,
            other.parentJoint,
        )
        assert np.array_equal(frame.placement.homogeneous, other.placement.homogeneous)


def test_all_files_are_there():
    assert len(FILES) == 77


READ = [p for p in FILES if p.name not in REFUSED] + sorted(BUNDLED.glob("*.urdf"))


@pytest.mark.parametrize(
    "path", mostly(READ, *READ[::4], *READ[-8:]), ids=lambda path: path.stem
)
def test_same_model_as_pinocchio(path):
    expected = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
    model = describe(path.read_bytes(), path).model
    assert_same(model, expected)
    assert not model.gravity.vector.any()


@pytest.mark.parametrize("name", REFUSED)
def test_refused_with_a_reason(name):
    path = next(p for p in FILES if p.name == name)
    with pytest.raises(
        fflin.UrdfError, match=rf"{name}:\d+: .*{re.escape(REFUSED[name])}"
    ):
        describe(path.read_bytes(), path)


CHAIN = """
import sys, threading
from pathlib import Path
from fflin.robot.urdf.reader import describe
link = '<link name="l{0}"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" \
iyz="0" izz="1"/></inertial></link>'
joint = '<joint name="j{0}" type="fixed"><parent link="l{0}"/><child link="l{1}"/></joint>'
text = "".join(link.format(i) for i in range(1000))
text += "".join(joint.format(i, i + 1) for i in range(999))
def run():
    robot = describe(f"<robot>{text}</robot>".encode(), Path("chain.urdf"))
    print(robot.model.inertias[1].mass)
threading.stack_size(512 * 1024)
thread = threading.Thread(target=run)
thread.start()
thread.join()
"""


@pytest.mark.process
def test_deep_chain_in_a_thread_of_small_stack():
    # Pinocchio itself overruns such a stack between 200 and 400 links.
    result = finished([sys.executable, "-c", CHAIN], capture_output=True, text=True)
    assert (result.stdout.strip(), result.stderr) == ("1000.0", "")


@pytest.mark.exhaustive
def test_every_named_robot_loads_or_says_why():
    reasons = {}
    for name in fflin.list_robots():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", fflin.FflinWarning)
            try:
                fflin.load(name)
            except FflinError as error:
                reasons[name] = str(error)
    assert set(reasons) == {"alex_psyonic_hands"}
