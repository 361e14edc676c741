"""What acts on a robot: inputs, springs, dampers, gravity; laws and closed forms, then `check`."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.commands.models import model_report
from tests.support.robots import FRAMES, random_point, random_pose, random_tree

THRUSTERS = (
    fflin.Thruster("base", (0.4, 0.1, -0.2), (1.0, 0.2, 0.0)),
    fflin.Thruster(
        "link_3", (0.1, 0.0, 0.2), (0.0, -3.0, 0.0), name="on_the_arm", torque=0.5
    ),
    fflin.Thruster("tool", (0.0, 0.05, 0.0), (0.3, 0.1, -1.0)),
)


def mixed(robot, thrusters=THRUSTERS):
    """Inputs in an order of their own, and not on every joint."""
    torques = [fflin.JointTorque(name) for name in robot.joint_names[2:0:-1]]
    return (
        thrusters[1],
        fflin.BaseForce(),
        *torques,
        thrusters[0],
        fflin.BaseTorque(),
        thrusters[2],
    )


def flying(frame, seed, name="servicer_7dof", **fields):
    """A robot with everything that can act on it, at a random point."""
    rng = np.random.default_rng(seed)
    robot = fflin.load(name)
    fields.setdefault("inputs", mixed(robot))
    robot = robot.replace(
        stiffness={
            joint: 10.0 * (k + 1) for k, joint in enumerate(robot.joint_names[1::2])
        },
        damping={
            joint: 0.5 * (k + 1) for k, joint in enumerate(robot.joint_names[::2])
        },
        rest={robot.joint_names[1]: 0.3},
        gravity=(0.3, -1.0, -3.7),
        **fields,
    )
    q, v, _ = random_point(fflin.load(name), rng)
    u = 20.0 * rng.normal(size=len(fflin.linearize(robot).input_names))
    return robot, q, v, u


@pytest.mark.parametrize(
    "turned", [False, True], ids=["own reference", "turned reference"]
)
@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("name", ["servicer_7dof", "ets_vii", "canadarm2"])
def test_check_holds_with_all_that_acts(name, frame, turned):
    robot, q, v, u = flying(frame, 1, name)
    reference = random_pose(np.random.default_rng(2), 100.0) if turned else None
    lin = fflin.linearize(robot, q, v, u, frame=frame, reference=reference)
    result = fflin.check(robot, lin)
    assert result.ok, result
    assert {
        row.block.split(", ")[-1] for row in result.rows if row.block.startswith("B")
    } == {*("tau_b]", "F_b]", "tau_m]", "thrust]")}


@pytest.mark.parametrize("frame", FRAMES)
def test_check_holds_on_random_trees_with_thrusters(frame):
    rng = np.random.default_rng(3)
    robot = random_tree(rng, 7)
    for index in range(2, robot.model.njoints):
        robot.model.addJointFrame(index)
    thrusters = [
        fflin.Thruster(f"joint_{k}", rng.normal(size=3), rng.normal(size=3))
        for k in range(7)
    ]
    robot = robot.replace(
        inputs=thrusters, stiffness=3.0, damping=0.2, gravity=(0, 0, -9.81)
    )
    q, v, _ = random_point(random_tree(np.random.default_rng(3), 7), rng)
    result = fflin.check(
        robot, fflin.linearize(robot, q, v, rng.normal(size=7), frame=frame)
    )
    assert result.ok, result


def test_check_holds_where_joints_mimic_others():
    robot = fflin.load("panda")
    robot = robot.replace(
        stiffness=5.0,
        damping=0.1,
        gravity=(0, 0, -9.81),
        inputs=(
            fflin.Thruster("panda_rightfinger", (0, 0, 0.1), (1, 0, 0)),
            fflin.BaseTorque(),
        ),
    )
    q, v, _ = random_point(fflin.load("panda"), np.random.default_rng(4))
    for frame in FRAMES:
        result = fflin.check(
            robot, fflin.linearize(robot, q, v, [3.0, 1, 2, 3], frame=frame)
        )
        assert result.ok, result


@pytest.mark.parametrize("thruster", THRUSTERS)
def test_thruster_column_is_the_work_of_its_force(thruster):
    """Power of the force over the velocity of its point, and of the reaction torque."""
    rng = np.random.default_rng(5)
    robot = fflin.load("servicer_7dof", inputs=[thruster])
    q, v, _ = random_point(fflin.load("servicer_7dof"), rng)
    lin = fflin.linearize(robot, q)
    model, data = robot.model, robot.create_data()
    pin.forwardKinematics(model, data, q, v)
    frame = model.getFrameId(thruster.frame)
    velocity = pin.getFrameVelocity(model, data, frame, pin.ReferenceFrame.LOCAL)
    at_point = velocity.linear + np.cross(velocity.angular, thruster.position)
    nu = fflin.StateMap(robot, frame="local").to_state(q, v)[6 + robot.n :]
    generalised = lin.M @ lin.B[6 + robot.n :, 0]
    power = (at_point + thruster.torque * velocity.angular) @ thruster.direction
    assert generalised @ nu == pytest.approx(power, rel=1e-11)


def test_thrust_derivative_by_the_closed_form():
    """M^-1 sum dB/dq u, with dJ_j/dq_l = J_j x J_l for l on a deeper supporting joint, else 0."""
    robot = fflin.load("servicer_7dof", inputs=THRUSTERS[2:])
    bare = fflin.load("servicer_7dof")
    q, _, _ = random_point(bare, np.random.default_rng(6))
    force = 7.0
    model, data, n = robot.model, robot.create_data(), robot.n
    frame = model.frames[model.getFrameId("tool")]
    joint = frame.parentJoint
    direction = frame.placement.rotation @ THRUSTERS[2].direction
    point = frame.placement.act(np.array(THRUSTERS[2].position))
    wrench = np.concatenate((direction, np.cross(point, direction)))
    J = pin.computeJointJacobian(model, data, q, joint)
    order = [3, 4, 5, 0, 1, 2, *range(6, 6 + n)]
    depth = {
        j.idx_v: len(model.supports[model.getJointId(j.name)]) for j in robot.joints
    }
    depth |= dict.fromkeys(range(6), 0)
    slope = np.zeros((6 + n, n))
    for row, j in enumerate(order):
        for column in range(6, 6 + n):
            supports = J[:, column].any() and J[:, j].any()
            if supports and depth[column] > depth[j]:
                product = pin.Motion(J[:, j]).cross(pin.Motion(J[:, column]))
                slope[row, column - 6] = product.vector @ wrench * force
    # At rest the other share of d(nudot)/dq_m is that of M, -M^-1 dM a: by differences of M,
    # which leave eps |M a| / h, 1e-8 of the slope.
    lin = fflin.linearize(robot, q, None, [force])
    a = lin.f0[6 + n :]
    M = lin.M
    h = 1e-4
    for column in range(n):
        dq = np.zeros(6 + n)
        dq[6 + column] = h
        inertia = [
            fflin.linearize(bare, pin.integrate(model, q, k * dq)).M @ a
            for k in (1, -1, 2, -2)
        ]
        dMa = (8 * (inertia[0] - inertia[1]) - (inertia[2] - inertia[3])) / (12 * h)
        expected = np.linalg.solve(M, slope[:, column] - dMa)
        given = lin.A[6 + n :, 6 + column]
        assert given == pytest.approx(
            expected, rel=1e-8, abs=1e-8 * np.abs(expected).max()
        )


def test_null_space_thrust_is_a_fixed_point_and_can_be_unstable():
    """A rod pulled along itself at its tip swings; pushed towards its hinge it buckles."""
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.addFrame(pin.Frame("base", 1, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    model.appendBodyToJoint(
        1, pin.Inertia(10.0, np.zeros(3), np.eye(3)), pin.SE3.Identity()
    )
    place = pin.SE3(np.eye(3), np.array([0.5, 0.0, 0.0]))
    model.addJoint(1, pin.JointModelRZ(), place, "hinge")
    model.addFrame(pin.Frame("rod", 2, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    rod = pin.Inertia(1.0, np.array([0.5, 0.0, 0.0]), 0.1 * np.eye(3))
    model.appendBodyToJoint(2, rod, pin.SE3.Identity())
    poles = {}
    for sign in (1.0, -1.0):
        tip = fflin.Thruster("rod", (1, 0, 0), (sign, 0, 0))
        back = fflin.Thruster("base", (0, 0, 0), (-sign, 0, 0))
        robot = fflin.from_model(model, inputs=[tip, back])
        lin = fflin.linearize(robot, None, None, [5.0, 5.0])
        assert lin.is_equilibrium() and lin.u0.all()
        assert fflin.check(robot, lin).ok
        poles[sign] = [p for p in np.linalg.eigvals(lin.A) if abs(p) > 0.1]
        assert ("unstable" in model_report(lin)) == (sign < 0)
    assert np.sort(np.imag(poles[1.0])) == pytest.approx(
        np.sort(np.real(poles[-1.0])), rel=1e-9
    )
    assert np.abs(np.real(poles[1.0])).max() < 1e-9 < np.real(poles[-1.0]).max()


def test_springs_between_base_and_rotor_have_the_closed_form_frequency():
    """Two inertias about one axis and a spring: w^2 = k (1/J1 + 1/J2), damping d likewise."""
    J1, J2, k, d = 3.0, 0.5, 8.0, 0.2
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(
        1, pin.Inertia(5.0, np.zeros(3), J1 * np.eye(3)), pin.SE3.Identity()
    )
    model.addJoint(1, pin.JointModelRX(), pin.SE3.Identity(), "panel")
    model.appendBodyToJoint(
        2, pin.Inertia(1.0, np.zeros(3), J2 * np.eye(3)), pin.SE3.Identity()
    )
    robot = fflin.from_model(model, stiffness={"panel": k}, damping={"panel": d})
    poles = np.linalg.eigvals(fflin.linearize(robot).A)
    expected = np.roots([1.0, d * (1 / J1 + 1 / J2), k * (1 / J1 + 1 / J2)])
    fast = poles[np.abs(poles) > 0.1]
    assert np.sort_complex(fast) == pytest.approx(np.sort_complex(expected), rel=1e-12)


def test_two_panel_frequencies_of_a_free_hub():
    """Antisymmetric and symmetric bending of two equal panels, from the energies by hand."""
    m, J, a, k, hub, I = 4.0, 0.6, 1.2, 50.0, 30.0, 8.0
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(
        1, pin.Inertia(hub, np.zeros(3), I * np.eye(3)), pin.SE3.Identity()
    )
    for name, side in (("left", 1.0), ("right", -1.0)):
        place = pin.SE3(np.eye(3), np.array([0.0, side * 0.5, 0.0]))
        index = model.addJoint(1, pin.JointModelRX(), place, name)
        panel = pin.Inertia(m, np.array([0.0, side * a, 0.0]), J * np.eye(3))
        model.appendBodyToJoint(index, panel, pin.SE3.Identity())
    robot = fflin.from_model(model, stiffness=k)
    poles = np.linalg.eigvals(fflin.linearize(robot).A)
    result = np.unique(np.round(np.abs(poles.imag[poles.imag > 0.1]), 9))
    # Panel about its hinge: J + m a^2. Flapping together the hub moves against them along z,
    # turning together it rolls against them.
    panel_inertia = J + m * a**2
    flap = panel_inertia - 2 * (m * a) ** 2 / (hub + 2 * m)
    arm = 0.5 + a
    total = I + 2 * (J + m * arm**2)
    roll = panel_inertia - 2 * (J + m * a * arm) ** 2 / total
    assert result == pytest.approx(np.sort(np.sqrt([k / flap, k / roll])), rel=1e-9)


def test_urdf_damping_is_taken_when_asked_for():
    bare = fflin.load("planar_detumble")
    assert not bare.damping
    damped = bare.replace(damping="urdf")
    assert damped.damping == dict.fromkeys(bare.joint_names, 0.1)
    A = fflin.linearize(damped).A
    n = bare.n
    inverse = fflin.linearize(bare).B[6 + n :]
    assert A[6 + n :, 12 + n :] == pytest.approx(-inverse[:, 6:] * 0.1, rel=1e-14)


@pytest.mark.parametrize("frame", FRAMES)
def test_gravity_moves_the_base_and_nothing_against_it(frame):
    robot = fflin.load("dual_arm")
    q, v, u = random_point(robot, np.random.default_rng(8))
    pose = random_pose(np.random.default_rng(9), 70.0)
    heavy = robot.replace(gravity=(0.5, 0.0, -9.81))
    free, falling = (
        fflin.linearize(r, q, v, u, frame=frame, reference=pose) for r in (robot, heavy)
    )
    g = fflin.StateMap(robot).groups
    rate = falling.f0 - free.f0
    assert not rate[g.qdot_m].any() and not rate[g.omega_b].any()
    assert np.linalg.norm(rate[g.v_b]) == pytest.approx(np.hypot(0.5, 9.81), rel=1e-12)
    if frame != "local":
        assert rate[g.v_b] == pytest.approx(
            pose.rotation.T @ [0.5, 0.0, -9.81], abs=1e-12
        )
        assert (falling.A == free.A).all()
    assert fflin.check(heavy, falling).ok


def test_hovering_quadrotor_is_held_by_thrust():
    """A thrust m g along the body's z: A[v_b, q_b] = 2 g [e_z]x-like, the closed form of hover."""
    robot = fflin.load(
        "hector",
        gravity=(0, 0, -9.81),
        inputs=[fflin.Thruster("base_link", (0, 0, 0), (0, 0, 1)), fflin.BaseTorque()],
    )
    com = robot.model.inertias[1].lever
    m = robot.mass
    u = np.array([m * 9.81, *np.cross(com, [0, 0, m * 9.81])])
    lin = fflin.linearize(robot, None, None, u)
    assert lin.is_equilibrium(1e-12)
    assert not fflin.linearize(robot).is_equilibrium()
    expected = 2 * 9.81 * np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 0]])
    assert lin.A[9:12, :3] == pytest.approx(expected, abs=1e-12)
    assert fflin.check(robot, lin).ok


def test_invalid_fields_are_reported():
    robot = fflin.load("servicer_7dof")
    cases = {
        "'tol'": {"inputs": [fflin.Thruster("tol", (0, 0, 0), (1, 0, 0))]},
        "'tom'": {"outputs": [fflin.FramePose("tom")]},
        "'joint_8'": {"inputs": [fflin.JointTorque("joint_8")]},
        "inputs": {"inputs": []},
        "input": {"inputs": ["thruster"]},
        "'thruster_2'": {
            "inputs": [replace(THRUSTERS[0], name="thruster_2"), THRUSTERS[0]]
        },
        "twice": {"inputs": [fflin.BaseForce(), fflin.BaseForce()]},
        "'panel_left'": {"stiffness": {"panel_left": -1}},
        "'panel'": {"damping": {"panel": 1}},
        "'urdf'": {"damping": "yes"},
        "gravity": {"gravity": 9.81},
        "rest has": {"rest": 1.0},
        "'friction'": {"friction": "urdf"},
        "'stifness'": {"stifness": 1},
    }
    for words, fields in cases.items():
        with pytest.raises(fflin.FflinError, match=words):
            changed = robot.replace(**fields)
            assert "thruster_2" in words, "told too late"
            fflin.linearize(changed)
    with pytest.raises(fflin.InputError, match="direction"):
        fflin.Thruster("base", (0, 0, 0), (0, 0, 0))
    with pytest.raises(fflin.InputError, match="three"):
        fflin.Thruster("base", (0, 0), (0, 0, 1))
    with pytest.raises(fflin.InputError, match=r"\(15,\)"):
        fflin.linearize(robot.replace(inputs=THRUSTERS[:1]), None, None, np.zeros(15))


def test_points_by_name():
    robot = fflin.load("servicer_7dof")
    v = fflin.velocity(robot, {"joint_3": 0.2, "omega_b.y": -0.1, "v_b.z": 2.0})
    state = fflin.StateMap(robot, frame="local").to_state(fflin.configuration(robot), v)
    named = dict(zip(fflin.StateMap(robot).names, state, strict=True))
    assert (named["qdot_m.joint_3"], named["omega_b.y"], named["v_b.z"]) == (
        0.2,
        -0.1,
        2.0,
    )
    u = fflin.effort(robot, {"tau_m.joint_3": 4.0})
    assert u[8] == 4.0 and np.count_nonzero(u) == 1
    with pytest.raises(fflin.UnknownNameError, match="'joint_33'"):
        fflin.effort(robot, {"joint_33": 4.0})
    with pytest.raises(fflin.UnknownNameError, match="'omega'"):
        fflin.velocity(robot, {"omega": 4.0})
