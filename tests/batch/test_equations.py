"""Models about many operating points at once, against the one about each."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.batch.sweep import ChunkJob
from fflin.kernel import limits
from fflin.kernel.compiled import kernel
from tests.support.orbits import in_orbit
from tests.support.robots import BUNDLED, LINKS, MIMIC, random_tree

pytest.importorskip("numba")

pytestmark = pytest.mark.compiled

TILTED = pin.SE3(pin.exp3(np.array([0.3, 0.5, -0.2])), np.array([1.0, 2.0, 3.0]))
CASES = {
    **{frame: {"frame": frame} for frame in ("hybrid", "local", "world")},
    **{
        f"{frame}, tilted": {"frame": frame, "reference": TILTED}
        for frame in ("hybrid", "world")
    },
    "local, tilted": {"frame": "local", "reference": TILTED},
    "moving": {"moving": True},
}


def operating_points(robot, count, seed=0):
    """Random configurations, velocities and inputs, about a mass and length of one."""
    rng = np.random.default_rng(seed)
    q, v = np.empty((count, robot.nq)), np.empty((count, robot.nv))
    state = fflin.StateMap(robot)
    for row, rate in zip(q, v, strict=True):
        joints = {joint.name: rng.uniform(-2.0, 2.0) for joint in robot.joints}
        pose = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))
        row[:] = fflin.configuration(robot, joints, pose)
        rate[:] = state.spread(rng.normal(size=6 + robot.n))
    return q, v, rng.normal(size=(count, len(fflin.linearize(robot).input_names)))


def agreement(robot, count=11, **options):
    """Largest difference of kernel and loop, over the largest and cond(M)."""
    linearizer = fflin.Linearizer(robot, **options)
    q, v, u = operating_points(robot, count)
    nv, nx, nu = 6 + robot.n, 12 + 2 * robot.n, u.shape[1]
    shapes = {"A": (nx, nx), "B_lower": (nv, nu), "f0": (nx,), "_x0": (nx,)}
    if options.get("moving"):
        shapes["_drift"] = (nx,)
    out = {key: np.full((count, *shape), np.nan) for key, shape in shapes.items()}
    job = ChunkJob(linearizer, at_rest=False)
    assert not len(job.write({"q": q, "v": v, "u0": u}, out))
    worst = 0.0
    for row in range(count):
        lin = linearizer(q[row], v[row], u[row])
        condition = lin.certificate.condition
        expected = {"A": lin.A, "B_lower": lin.B[nv:], "f0": lin.f0, "_x0": lin.x0}
        expected["_drift"] = lin.drift
        for key, array in out.items():
            scale = max(1e-3, np.abs(expected[key]).max(initial=0.0)) * condition
            worst = max(
                worst, np.abs(array[row] - expected[key]).max(initial=0.0) / scale
            )
    return worst


@pytest.mark.parametrize("name", BUNDLED)
def test_kernel_agrees_with_the_linearizer_on_every_bundled_robot(name, robots):
    assert agreement(robots[name], 21) < 1e-13


@pytest.mark.parametrize("case", CASES)
def test_kernel_agrees_in_every_frame_and_chart(case, robots):
    assert agreement(robots["servicer_7dof"], **CASES[case]) < 1e-13


@pytest.mark.parametrize("n", [1, 2, 7, 20])
def test_kernel_agrees_on_random_trees_of_every_joint_type(n):
    assert agreement(random_tree(np.random.default_rng(n), n)) < 1e-13


@pytest.mark.parametrize("case", CASES)
def test_kernel_knows_springs_gravity_thrusters_and_wheels(case, robots):
    robot = robots["servicer_7dof"]
    inputs = [
        fflin.JointTorque("joint_3"),
        fflin.Thruster("link_3", (0.1, 0.2, 0.3), (0.3, 0.5, 1.0)),
        fflin.BaseForce(),
        fflin.ReactionWheel((0.0, 1.0, 1.0), frame="link_4", momentum=3.0),
        fflin.Thruster("tool", (-0.2, 0.1, 0.0), (0.0, 1.0, 0.5)),
        fflin.BaseTorque(),
        fflin.ReactionWheel((1.0, 0.0, 1.0), momentum=-2.0),
        fflin.ReactionWheel((0.0, 1.0, 1.0), frame="link_2", inertia=0.05),
    ]
    robot = robot.replace(
        inputs=inputs,
        stiffness=2.0,
        damping=0.3,
        rest={"joint_2": 0.4},
        gravity=(1.0, 2.0, -9.81),
    )
    assert agreement(robot, **CASES[case]) < 1e-13


@pytest.mark.parametrize("case", ["hill", "lvlh", "lvlh, tilted"])
def test_kernel_knows_the_gravity_gradient(case, robots):
    options = CASES["hybrid, tilted"] if "tilted" in case else {}
    robot = in_orbit(robots["servicer_7dof"].replace(stiffness=2.0, damping=0.1))
    options = options | {"frame": case.partition(",")[0]}
    assert agreement(robot, **options) < 1e-13


def test_kernel_counts_rotors(robots):
    model = robots["servicer_7dof"].model.copy()
    model.armature = np.linspace(0.1, 2.0, model.nv)
    assert agreement(fflin.from_model(model)) < 1e-13


@pytest.mark.parametrize(
    "types", [("revolute", "revolute"), ("prismatic", "continuous")]
)
def test_the_kernel_supports_joints_with_rotors_that_rotate_against_others(
    types, tmp_path
):
    mimic = '<mimic joint="b" multiplier="-2" offset="0.3"/>'
    document = MIMIC.format(
        links=LINKS, a=types[0], b=types[1], parent="la", mimic=mimic
    )
    (tmp_path / "r.urdf").write_text(document)
    robot = fflin.load(tmp_path / "r.urdf")
    model = robot.model.copy()
    model.armature = np.linspace(0.1, 2.0, model.nv)
    assert agreement(replace(robot, model=model)) < 1e-13


def test_the_kernel_supports_mimic_joints_on_another_branch(
    tmp_path,
):
    """c on b mimics a; d, on b too, is not moved by a, and yet its row of the inverse is."""
    more = "".join(
        f"""<link name="l{name}"><inertial><origin xyz=".1 .2 .3"/><mass value="0.9"/>
        <inertia ixx=".2" ixy="0" ixz="0" iyy=".3" iyz="0" izz=".4"/></inertial></link>
        <joint name="{name}" type="continuous"><parent link="lb"/><child link="l{name}"/>
        <origin xyz=".3 -.2 .1"/><axis xyz="{axis}"/>{mimic}</joint>"""
        for name, axis, mimic in (
            ("c", "1 0 0", '<mimic joint="a" multiplier="-0.7"/>'),
            ("d", "0 1 0", ""),
        )
    )
    document = MIMIC.format(
        links=LINKS, a="revolute", b="revolute", parent="base", mimic=""
    )
    (tmp_path / "r.urdf").write_text(document.replace("</robot>", f"{more}</robot>"))
    robot = fflin.load(tmp_path / "r.urdf")
    assert robot.joint_names == ("a", "b", "d")
    assert agreement(robot) < 1e-13


@pytest.mark.parametrize("name", ["panda", "tiago"])
def test_kernel_agrees_where_joints_mimic_others_and_turn_without_end(name):
    pytest.importorskip("example_robot_data")
    with pytest.warns(fflin.FflinWarning):
        robot = fflin.load(name)
    assert agreement(robot) < 1e-13


def test_fewer_points_than_lanes_and_more_than_a_block(robots):
    for count in (1, 7, 8, 9, 300):
        assert (
            agreement(robots["planar_detumble"], count, frame="world", reference=TILTED)
            < 1e-13
        )


def test_a_sweep_uses_the_kernel_and_omits_points_that_the_linearizer_refuses(robots):
    robot = robots["servicer_7dof"]
    q, v, u = operating_points(robot, 40)
    batch = fflin.sweep(robot, q, v, u)
    for row in (0, 39):
        one = fflin.linearize(robot, q[row], v[row], u[row])
        for key in ("A", "B", "C", "D", "f0", "x0", "u0", "y0"):
            result, expected = getattr(batch[row], key), getattr(one, key)
            scale = max(1.0, np.abs(expected).max())
            assert np.abs(result - expected).max() < 1e-12 * scale, key
    # Turned by pi from the reference.
    q[17, 3:7] = 1.0, 0.0, 0.0, 0.0
    with pytest.raises(fflin.SweepError, match=r"17.*180 deg"):
        fflin.sweep(robot, q, v, u, reference=pin.SE3.Identity())
    # Beyond all numbers.
    v[5] = 1e160
    with pytest.raises(fflin.SweepError, match=r"\b5\b"):
        fflin.sweep(robot, q, v, u)


def test_angles_beyond_the_kernels_sines_are_left(robots):
    robot = robots["planar_detumble"]
    q, v, u = operating_points(robot, 20)
    q[3, 7] = 2e6
    nv, nx = 6 + robot.n, 12 + 2 * robot.n
    out = {"A": (nx, nx), "B_lower": (nv, u.shape[1]), "f0": (nx,), "_x0": (nx,)}
    arrays = {key: np.zeros((20, *shape)) for key, shape in out.items()}
    job = ChunkJob(fflin.Linearizer(robot), at_rest=False)
    assert job.write({"q": q, "v": v, "u0": u}, arrays).tolist() == [3]


def test_outputs_are_left_to_the_linearizer(robots):
    robot = robots["servicer_7dof"].replace(outputs=[fflin.FramePose("tool")])
    q, v, u = operating_points(robot, 20)
    batch = fflin.sweep(robot, q, v, u)
    expected = fflin.linearize(robot, q[4], v[4], u[4])
    assert (batch[4].C == expected.C).all() and (batch[4].A == expected.A).all()
    with pytest.raises(fflin.InputError, match=r"'compiled'.*outputs"):
        fflin.sweep(robot, q, v, u, engine="compiled")


def test_an_engine_may_be_chosen(robots, monkeypatch):
    robot = robots["planar_detumble"]
    q, v, u = operating_points(robot, 20)
    by_python = fflin.sweep(robot, q, v, u, engine="python")
    expected = fflin.linearize(robot, q[4], v[4], u[4])
    assert (by_python.A[4] == expected.A).all() and (
        by_python.B_lower[4] == expected.B[9:]
    ).all()
    compiled = fflin.sweep(robot, q, v, u, engine="compiled")
    assert compiled.A == pytest.approx(by_python.A, rel=1e-9, abs=1e-9)
    with pytest.raises(fflin.UnknownNameError, match="'fast'"):
        fflin.sweep(robot, q, engine="fast")
    monkeypatch.setattr(limits, "numba_is_there", lambda: False)
    assert (fflin.sweep(robot, q, v, u).A == by_python.A).all()
    with pytest.raises(fflin.InputError, match=r"'compiled'.*fflin\[fast"):
        fflin.sweep(robot, q, engine="compiled")


def test_one_set_of_machine_code_serves_every_robot_and_option(robots):
    derive = kernel("derivatives", "derive")
    thrusters = [
        fflin.Thruster("base", (0.1, 0.2, 0.3), (0.3, 0.5, 1.0)),
        fflin.BaseTorque(),
    ]
    for name in BUNDLED:
        robot = robots[name]
        variants = [
            robot,
            robot.replace(gravity=(0.0, 0.0, -9.81), stiffness=0.5, damping=0.1),
        ]
        if name == "servicer_7dof":
            variants.append(robot.replace(inputs=thrusters))
        for variant in variants:
            for case in CASES.values():
                q, v, u = operating_points(variant, 9)
                for point in ((q,), (q, v), (q, None, u), (q[:3], v[:3], u[:3])):
                    fflin.sweep(variant, *point, **case)
    assert len(derive.signatures) == 1
