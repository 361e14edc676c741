"""The bundled robots: published figures, physical consistency and appearance."""

import re
import xml.etree.ElementTree as ET
from math import pi

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.closure import redundancy
from fflin.robot.catalog import bundled_directory
from tests.support.marks import exhaustive

ROBOTS = bundled_directory()

# name: number of joints, total mass in kg, frames of tools or hands
SUMMARY = {
    "cubesat": (0, 3.5, []),
    "ets_vii": (6, 2550 + 35 + 22.5 + 21.9 + 16.5 + 26 + 18.5, ["tool"]),
    "planar_detumble": (3, 100 + 10 + 8 + 4 + 0.1 + 50, ["hand", "target"]),
    "canadarm2": (7, 2 * 243.66 + 4 * 105.98 + 314.88 + 279.2, ["tool"]),
    "astrobee_arm": (2, 9.58 + 0.25 + 0.2 + 0.13, ["tool"]),
    "servicer_7dof": (9, 800 + 2 * 24 + 12 + 10 + 9.5 + 8.5 + 6.5 + 5 + 6, ["tool"]),
    "inspector": (10, 424 + 4 * 6 + 6 + 9 + 7 + 3 + 3 + 4, ["tool"]),
    "dual_arm": (8, 240 + 2 * (4 + 5 + 3.8 + 2.4), ["tool_left", "tool_right"]),
    "grasped_target": (12, 240 + 2 * (4 + 5 + 4 + 3 * 2.5) + 410, ["tool_right"]),
    "berthed_stack": (
        7,
        14288 + 16500 + 2 * 243.66 + 4 * 105.98 + 314.88 + 279.2,
        ["tool"],
    ),
    "scissor_mast": (7, 180 + 4 * 0.6 + 2 * 0.8 + 12, ["foot", "knee", "head"]),
}
# Trees of the robot files with constraints: number of rows and rank of the constraints
CLOSED = {"grasped_target": (6, 6), "berthed_stack": (6, 6), "scissor_mast": (15, 6)}
# Frames of tools and of constraints, which have no mass
FRAMES = {"handle", "port", "foot", "knee", "head", "top"}
NAMES = sorted(SUMMARY)

# Published: link -> mass, centre of mass, (ixx, iyy, izz, ixy, ixz, iyz); absent products are zero
ZERO = (0, 0, 0)
BODIES = {
    "cubesat": {
        "base": (3.5, ZERO, (0.01520407970002, 0.01462135261765, 0.0062377583131))
    },
    "ets_vii": {
        "base": (2550, ZERO, (6200, 3540, 7090, 48.2, 78.5, -29.2)),
        "link_1": (35, ZERO, (0.25, 0.25, 1.69)),
        "link_2": (22.5, ZERO, (0.1, 1.31, 3.75)),
        "link_3": (21.9, ZERO, (0.1, 0.71, 2.53)),
        "link_4": (16.5, ZERO, (0.15, 0.15, 0.073)),
        "link_5": (26, ZERO, (0.15, 0.15, 0.13)),
        "link_6": (18.5, ZERO, (0.97, 0.97, 0.26)),
    },
    "planar_detumble": {
        "base": (100, ZERO, (66.66, 66.66, 66.66)),
        "link_1": (10, (0, 0, 0.45), (0.5396, 0.5396, 0.0125)),
        "link_2": (8, (0, 0, 0.35), (0.245, 0.245, 0.01)),
        "link_3": (4, (0, 0, 0.15), (0.01583, 0.01583, 0.005)),
        "target": (50, ZERO, (3, 3, 3)),
    },
    "canadarm2": {
        "base": (243.66, ZERO, (9.336, 44.413, 44.413)),
        "link_1": (105.98, ZERO, (12.19, 12.13, 3.061)),
        "link_2": (105.98, ZERO, (8.088, 3.061, 8.446)),
        "link_3": (314.88, ZERO, (15.41, 2094.71, 2103.19, 49.52)),
        "link_4": (279.2, ZERO, (9.522, 1966.28, 1966.28, -39.95)),
        "link_5": (105.98, ZERO, (8.305, 3.061, 8.0386)),
        "link_6": (105.98, ZERO, (12.13, 12.13, 3.061)),
        "link_7": (243.66, ZERO, (9.336, 44.41, 44.41)),
    },
    "astrobee_arm": {"base": (9.58, ZERO, (0.153, 0.143, 0.162))},
}

# Published: joint -> type, axis (None if fixed), xyz, rpy
X, Y, Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
JOINTS = {
    "ets_vii": {
        "joint_1": ("continuous", Z, (-0.79, -0.29, 1), (0, 0, pi)),
        "joint_2": ("continuous", Z, (0, -0.275, 0.35), (-pi / 2, 0, 0)),
        "joint_3": ("continuous", Z, (0, -0.87, 0), ZERO),
        "joint_4": ("continuous", Z, (-0.63, 0, 0), ZERO),
        "joint_5": ("continuous", Z, (0, 0, 0.26), (pi / 2, 0, 0)),
        "joint_6": ("continuous", Z, (0, 0, 0.28), (0, -pi / 2, 0)),
        "tool_fixed": ("fixed", None, (0, 0, 0.53), ZERO),
    },
    "planar_detumble": {
        "joint_1": ("continuous", Y, (0, 0, 1.05), ZERO),
        "joint_2": ("continuous", Y, (0, 0, 0.9), ZERO),
        "joint_3": ("continuous", Y, (0, 0, 0.7), ZERO),
        "hand_fixed": ("fixed", None, (0, 0, 0.3), ZERO),
        "target_fixed": ("fixed", None, (0, 0, 0.35), ZERO),
    },
    "canadarm2": {
        "joint_1": ("revolute", X, (1.3589, 0, 0), ZERO),
        "joint_2": ("revolute", Z, (0, 0, 0.7026), ZERO),
        "joint_3": ("revolute", Y, (0, -0.5692, 0), ZERO),
        "joint_4": ("revolute", Y, (7.11, -0.475, 0), ZERO),
        "joint_5": ("revolute", Y, (7.11, 0, 0), ZERO),
        "joint_6": ("revolute", Z, (0, -0.5692, 0), ZERO),
        "joint_7": ("revolute", X, (0, 0, -0.7026), ZERO),
        "tool_fixed": ("fixed", None, (1.3589, 0, 0), ZERO),
    },
}

# Kept as published although no real body has such moments
BREAK_TRIANGLE = {("ets_vii", "link_1"), ("ets_vii", "link_2"), ("ets_vii", "link_3")}


def path(name):
    folder = ROBOTS / "trees" if name in CLOSED else ROBOTS
    return folder / f"{name}.urdf"


def root(name):
    return ET.parse(path(name)).getroot()


def floats(element, key, default="0 0 0"):
    return tuple(map(float, element.get(key, default).split()))


def build(name):
    return pin.buildModelFromUrdf(str(path(name)), pin.JointModelFreeFlyer())


def inertia_matrix(figures):
    xx, yy, zz, xy, xz, yz = (*figures, 0, 0, 0)[:6]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], float)


def inertials(name):
    """link -> (mass, centre of mass, inertia matrix), as written in the file"""
    out = {}
    for link in root(name).iter("link"):
        inertial = link.find("inertial")
        if inertial is not None:
            tag = inertial.find("inertia")
            figures = [
                float(tag.get(k)) for k in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
            ]
            origin = inertial.find("origin")
            assert floats(origin, "rpy") == ZERO
            mass = float(inertial.find("mass").get("value"))
            out[link.get("name")] = mass, floats(origin, "xyz"), inertia_matrix(figures)
    return out


def test_exactly_these_robots():
    assert sorted(p.stem for p in ROBOTS.rglob("*.urdf")) == NAMES
    assert {p.stem for p in (ROBOTS / "trees").iterdir()} == set(CLOSED)


@pytest.mark.parametrize("name", NAMES)
def test_model(name):
    n, mass, frames = SUMMARY[name]
    model = build(name)
    assert model.nv == 6 + n
    assert pin.computeTotalMass(model) == pytest.approx(mass, rel=1e-12)
    for frame in frames:
        assert model.existFrame(frame, pin.FrameType.BODY), frame
    M = pin.crba(model, model.createData(), pin.neutral(model))
    M = np.triu(M) + np.triu(M, 1).T
    np.linalg.cholesky(M)
    assert np.linalg.cond(M) < 1e9


@pytest.mark.parametrize("name", sorted(BODIES))
def test_published_bodies(name):
    written = inertials(name)
    for link, (mass, com, figures) in BODIES[name].items():
        assert written[link][:2] == (mass, com), link
        assert np.array_equal(written[link][2], inertia_matrix(figures)), link


@pytest.mark.parametrize("name", NAMES)
def test_model_carries_the_written_bodies(name):
    # pinocchio lumps links behind fixed joints into the joint before them
    model = build(name)
    lumped = [pin.Inertia.Zero() for _ in model.joints]
    for link, (mass, com, inertia) in inertials(name).items():
        frame = model.frames[model.getFrameId(link, pin.FrameType.BODY)]
        lumped[frame.parentJoint] += frame.placement * pin.Inertia(
            mass, np.array(com), inertia
        )
    for ours, theirs in zip(lumped[1:], list(model.inertias)[1:], strict=True):
        assert np.allclose(ours.matrix(), theirs.matrix(), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", sorted(JOINTS))
def test_published_joints(name):
    joints = {j.get("name"): j for j in root(name).iter("joint")}
    assert set(joints) == set(JOINTS[name])
    for key, (kind, axis, xyz, rpy) in JOINTS[name].items():
        joint = joints[key]
        assert joint.get("type") == kind, key
        assert floats(joint.find("origin"), "xyz") == xyz, key
        assert floats(joint.find("origin"), "rpy") == pytest.approx(rpy, abs=1e-15), key
        if axis:
            assert floats(joint.find("axis"), "xyz") == axis, key


def test_canadarm2_range():
    for joint in root("canadarm2").findall("joint[@type='revolute']"):
        limit = joint.find("limit")
        assert (limit.get("lower"), limit.get("upper")) == ("-4.712", "4.712")


def test_planar_detumble_damping():
    # the viscous damping is part of the published model and must reach pinocchio
    assert np.array_equal(build("planar_detumble").damping, [0] * 6 + [0.1] * 3)


@pytest.mark.parametrize("name", NAMES)
def test_physical_consistency(name):
    broken = set()
    for link, (mass, _, inertia) in inertials(name).items():
        moments = np.linalg.eigvalsh(inertia)
        assert mass > 0 and moments[0] > 0, link
        if not moments[0] + moments[1] > moments[2]:
            broken.add((name, link))
    assert broken == {b for b in BREAK_TRIANGLE if b[0] == name}


def test_cubesat_is_the_drawn_uniform_box():
    mass, _, inertia = inertials("cubesat")["base"]
    s = np.array(floats(root("cubesat").find("link/visual/geometry/box"), "size"))
    assert np.allclose(mass / 12 * (s @ s - s**2), np.diag(inertia), rtol=0.01)


def test_servicer_is_symmetric_and_not_singular():
    bodies = inertials("servicer_7dof")
    (m1, c1, I1), (m2, c2, I2) = bodies["panel_left_link"], bodies["panel_right_link"]
    assert m1 == m2 and c1 == (c2[0], -c2[1], c2[2]) and np.array_equal(I1, I2)
    model = build("servicer_7dof")
    data = model.createData()
    q = pin.neutral(model)
    for side in ("left", "right"):
        q[model.joints[model.getJointId(f"panel_{side}")].idx_q] = 0.1
    # equal angles: the centre of mass rises and stays in the plane of symmetry
    dz = pin.centerOfMass(model, data, q) - pin.centerOfMass(
        model, data, pin.neutral(model)
    )
    assert dz[2] > 1e-3 and abs(dz[1]) < 1e-12
    J = pin.computeFrameJacobian(
        model, data, pin.neutral(model), model.getFrameId("tool")
    )
    assert np.linalg.matrix_rank(J[:, 6:], tol=1e-3) == 6


def test_dual_arm_is_mirrored():
    model = build("dual_arm")
    data = model.createData()
    q = pin.neutral(model)
    for i, angle in enumerate((0.3, -0.4, 0.5, 0.7), 1):
        for side in ("left", "right"):
            q[model.joints[model.getJointId(f"{side}_{i}")].idx_q] = angle
    pin.framesForwardKinematics(model, data, q)
    left, right = (data.oMf[model.getFrameId(f"tool_{s}")] for s in ("left", "right"))
    mirror = np.diag([1, -1, 1])
    assert np.allclose(mirror @ left.translation, right.translation)
    assert np.allclose(mirror @ left.rotation @ mirror, right.rotation)


@pytest.mark.parametrize("name", NAMES)
def test_file_conventions(name):
    text = path(name).read_text(encoding="utf-8")
    comment = re.match(r"<\?xml [^>]*\?>\n<!--(.*?)-->", text, re.S)
    assert comment and "Source" in comment[1] and "Physical consistency:" in comment[1]
    assert "<mesh" not in text and "xacro" not in text
    robot = root(name)
    assert robot.get("name") == name
    children = {j.find("child").get("link") for j in robot.iter("joint")}
    assert [
        n for n in (e.get("name") for e in robot.iter("link")) if n not in children
    ] == ["base"]
    assert "floating" not in {j.get("type") for j in robot.iter("joint")}
    for link in robot.iter("link"):
        # only frames of tools and of constraints may be without mass
        frame = link.get("name").startswith("tool") or link.get("name") in FRAMES
        assert (link.find("inertial") is None) == frame


@pytest.mark.parametrize("name", NAMES)
def test_visuals(name):
    robot = root(name)
    colours = {
        m.get("name") for m in robot.findall("material") if m.find("color") is not None
    }
    visuals = list(robot.iter("visual"))
    assert len(visuals) > 10
    for visual in visuals:
        assert visual.find("material").get("name") in colours
        assert visual.find("geometry")[0].tag in {"box", "cylinder", "sphere"}
    shapes = pin.buildGeomFromUrdf(
        build(name), str(path(name)), pin.GeometryType.VISUAL
    )
    assert shapes.ngeoms == len(visuals)


@pytest.mark.parametrize("name", sorted(CLOSED))
def test_closed_robots_load_by_name_closed_at_the_neutral_configuration(name):
    robot = fflin.load(name)
    found = redundancy(robot, robot.neutral())
    assert (found.rows, found.rank) == CLOSED[name]
    assert found.free == 6 + robot.n - found.rank
    q = fflin.closed(robot, robot.neutral())
    assert np.abs(q - robot.neutral()).max() < 1e-10  # 12 digits in the file


@pytest.mark.parametrize("name", exhaustive(*sorted(CLOSED)))
def test_closed_robots_are_verified_and_regulated(name):
    robot = fflin.load(name)
    lin = fflin.linearize(robot)
    assert fflin.check(robot, lin).ok
    assert fflin.controllability(lin).controllable
    gain = fflin.lqr(lin)
    assert np.linalg.eigvals(lin.A - lin.B @ gain.K).real.max() < 0
    q0 = fflin.closed(robot, fflin.configuration(robot, rpy=(2, 0, 0)))
    policy = fflin.StateFeedback(lin, gain)
    motion = fflin.simulate(robot, policy, q0=q0, duration=0.2, dt=0.1)
    assert np.abs(motion.momentum_drift).max() < 1e-12


def test_scissor_mast_extends_as_its_bars_turn():
    # The bars of 1 m stand at asin(z) for a cell of height z; the carriage is at cos of it.
    robot = fflin.load("scissor_mast")
    robot = robot.replace(constraints=[*robot.constraints, fflin.Weld("base")])
    fflin.closed(robot, robot.neutral())
    model, data = robot.model, robot.create_data()
    for carriage in (-0.3, -0.1, 0.1):
        guess = fflin.configuration(robot, {"carriage": carriage})
        placement = pin.SE3(np.eye(3), np.array([0.4 + carriage, 0.0, 0.35]))
        held = robot.replace(
            constraints=[
                *robot.constraints,
                fflin.Weld("carriage_link", "base", placement=placement),
            ]
        )
        q = fflin.closed(held, guess)
        pin.framesForwardKinematics(model, data, q)
        height = data.oMf[model.getFrameId("platform_link")].translation[2] - 0.35
        width = 0.8 + carriage
        assert height == pytest.approx(2 * np.sqrt(1 - width**2), abs=1e-10)
