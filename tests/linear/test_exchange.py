"""Coordinates of other tools: the same robot, whatever they are called and in whatever order."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.aba import Aba
from fflin.linear.aba_route import scaled_condition
from fflin.linear.tool_coordinates import TOOLS
from tests.support.marks import exhaustive
from tests.support.robots import (
    BUNDLED,
    FRAMES,
    LINKS,
    MIMIC,
    free_body,
    mostly,
    random_point,
    random_pose,
    random_tree,
)

CASES = [
    *({"frame": frame} for frame in FRAMES),
    *({"frame": frame, "reference": "turned"} for frame in FRAMES),
    {"moving": True},
]


def ids(case):
    return "-".join(str(value) for value in case.values())


def point(robot, seed, case, degrees=70.0):
    """A random point in motion, and how it is linearised."""
    rng = np.random.default_rng(seed)
    q, v, u = random_point(robot, rng, degrees=degrees)
    how = dict(case)
    if "reference" in how:
        how["reference"] = random_pose(rng, 20.0)
    return q, v, u, how


def relative(a, b):
    return np.abs(a - b).max() / max(1.0, np.abs(b).max())


@pytest.mark.parametrize("case", CASES, ids=ids)
@pytest.mark.parametrize("name", mostly([*BUNDLED, "tree"], "cubesat", "tree"))
def test_round_trip_is_the_identity(name, case):
    robot = (
        random_tree(np.random.default_rng(3), 6) if name == "tree" else fflin.load(name)
    )
    q, v, u, how = point(robot, 7, case)
    lin, rng = fflin.linearize(robot, q, v, u, **how), np.random.default_rng(0)
    for tool in TOOLS:
        m = lin.to(tool)
        back = fflin.from_tool(robot, tool, m.q, m.v, m.u0, A=m.A, B=m.B, **how)
        assert back.frame == lin.frame and back.moving == lin.moving
        for key in ("A", "B", "f0", "v", "u0", "x0", "C", "D"):
            assert relative(getattr(back, key), getattr(lin, key)) < 1e-13, (tool, key)
        # A quaternion and its negative are one attitude.
        assert np.abs(pin.difference(robot.model, back.q, lin.q)).max() < 1e-13
        assert np.abs(m.T_left @ m.T - np.eye(len(lin.A))).max() < 1e-13
        assert relative(m.T_u @ lin.u0, m.u0) < 1e-15
        # What is not fflin's own takes the accelerations at the point, which rounding of the tool's
        # velocities changes by M's condition.
        least = max(1e-13, 0.1 * np.finfo(float).eps * scaled_condition(lin.M))
        # Other matrices than fflin's, by T alone; inputs are held, so that those of B count in A.
        X, Y = (rng.normal(size=item.shape) for item in (lin.A, lin.B))
        still = fflin.linearize(robot, q, v, **how)
        m = still.to(tool)
        A, B = m.A + m.T @ X @ m.T_left, m.B + m.T @ Y @ np.linalg.inv(m.T_u)
        back = fflin.from_tool(robot, tool, m.q, m.v, m.u0, A=A, B=B, **how)
        assert (
            relative(back.A, still.A + X) < least
            and relative(back.B, still.B + Y) < least
        )
        assert (
            len(m.state_names)
            == len(set(m.state_names))
            == len(m.state_units)
            == len(m.A)
        )
        assert len(m.A) == 12 + 2 * robot.n + (tool == "drake")


class Formulas:
    """What x of each tool is, and dx/dt, written down anew: from Pinocchio's q, v, a."""

    def __init__(self, robot, tool, q0):
        self.robot, self.tool, self.q0 = robot, tool, q0
        self.state = fflin.StateMap(robot)
        self.order = np.arange(robot.n)
        # none of these robots has a joint on two others
        if tool in ("drake", "mujoco", "spart"):
            at = [robot.file_joints.index(name) for name in robot.joint_names]
            self.order = np.argsort(at)
        link = next(
            (f.name for f in robot.model.frames if f.type == pin.FrameType.BODY), None
        )
        known = robot.links.get(link)
        body = pin.SE3(np.eye(3), robot.model.inertias[1].lever)
        self.centre = known.placement if known else body

    def vectors(self, q, v):
        """Pose and twist by tool, relative to q0 in tangents."""
        joints = self.state.joint_positions(q)[self.order]
        rates = self.state.velocities(v)[6:][self.order]
        base, R = pin.XYZQUATToSE3(q[:7]), pin.XYZQUATToSE3(q[:7]).rotation
        before = pin.XYZQUATToSE3(self.q0[:7])
        w, d = v[3:6], v[:3]
        apart = self.state.joints_apart(self.q0, q)[self.order]
        if self.tool == "drake":
            quaternion = np.array([q[6], *q[3:6]])
            return np.concatenate((quaternion, q[:3], joints, R @ w, R @ d, rates))
        if self.tool == "mujoco":
            turn = pin.log3(before.rotation.T @ R)
            return np.concatenate((q[:3] - self.q0[:3], turn, apart, R @ d, w, rates))
        if self.tool in ("pinocchio", "crocoddyl"):
            return np.concatenate((pin.log6(before.actInv(base)).vector, apart, v))
        if self.tool == "spart":
            C, c = self.centre.rotation, self.centre.translation
            turn = pin.log3(C.T @ before.rotation.T @ R @ C)
            shift = q[:3] + R @ c - self.q0[:3] - before.rotation @ c
            twist = (C.T @ w, R @ (d + np.cross(w, c)))
            return np.concatenate((turn, shift, apart, *twist, rates))
        angles = pin.rpy.matrixToRpy(R)
        if self.tool == "euler_rates":
            w = pin.rpy.computeRpyJacobianInverse(angles) @ w
        return np.concatenate((angles, q[:3], joints, w, R @ d, rates))

    def inputs(self, q, u):
        """Torque and force on the base's origin in base axes, and on joints, of the tool's u."""
        R, n = pin.XYZQUATToSE3(q[:7]).rotation, self.robot.n
        a, b, rest = u[:3], u[3:6], np.zeros(n)
        rest[self.order] = u[6 : 6 + n]
        if self.tool == "drake":
            return np.concatenate((R.T @ a, R.T @ b, rest))
        if self.tool == "mujoco":
            return np.concatenate((b, R.T @ a, rest))
        if self.tool in ("pinocchio", "crocoddyl"):
            return np.concatenate((b, a, rest))
        if self.tool == "spart":
            C, c = self.centre.rotation, self.centre.translation
            force = R.T @ b
            return np.concatenate((C @ a + np.cross(c, force), force, rest))
        return np.concatenate((a, R.T @ b, rest))


@pytest.mark.parametrize("tool", TOOLS)
@pytest.mark.parametrize("name", ["inspector", *exhaustive("servicer_7dof")])
def test_derivatives_match_the_rates_in_the_tools_coordinates(name, tool):
    """A, B and f0 by differences of dx/dt: x by formulas, the motion by ABA."""
    robot = fflin.load(name).replace(
        gravity=(0.3, -0.2, 0.5), stiffness=3.0, damping=0.2
    )
    q, v, u, _ = point(robot, 5, {}, degrees=60.0)
    lin = fflin.linearize(robot, q, v, u / np.abs(u).max())
    m = lin.to(tool)
    now, aba = Formulas(robot, tool, q), Aba(fflin.StateMap(robot, frame="local"))
    n = robot.nv

    def rate(q, v, u):
        a = aba.acceleration(q, v, now.inputs(q, u)).copy()
        return differences(
            lambda t: now.vectors(pin.integrate(robot.model, q, t * v), v + t * a)
        )

    assert relative(now.vectors(q, v), m.x0) < 1e-13
    assert relative(rate(q, v, m.u0), m.f0) < 1e-9
    for e in np.eye(2 * n):

        def moved(t, e=e):
            return pin.integrate(robot.model, q, t * e[:n]), v + t * e[n:]

        dx = differences(lambda t: now.vectors(*moved(t)))
        assert relative(m.A @ dx, differences(lambda t: rate(*moved(t), m.u0))) < 1e-7
    for e in np.eye(len(u)):
        by_u = differences(lambda t, e=e: rate(q, v, m.u0 + 50.0 * t * e)) / 50.0
        assert relative(m.B @ e, by_u) < 1e-8


@pytest.mark.parametrize("tool", TOOLS)
def test_a_moving_reference_changes_tangents_alone(tool):
    """Flat coordinates have one A; a tangent that moves along turns by what it moves."""
    robot = fflin.load("servicer_7dof")
    q, v, u, _ = point(robot, 2, {})
    local = fflin.linearize(robot, q, v, u, frame="local")
    fixed, moving = (
        local.to(tool),
        fflin.linearize(robot, q, v, u, moving=True).to(tool),
    )
    assert moving.reference == "moving" and not moving.f0.any() and fixed.f0.any()
    assert relative(moving.B, fixed.B) < 1e-13
    expected, nv = np.zeros(fixed.A.shape), robot.nv
    if tool in ("pinocchio", "crocoddyl"):
        # Pinocchio's own transport of tangents, over a time of 0
        ahead, behind = (
            pin.dIntegrate(robot.model, q, h * v)[0] for h in (1e-4, -1e-4)
        )
        expected[:nv, :nv] = 0.5 * (ahead - behind) / 2e-4
    elif tool in ("mujoco", "spart"):
        at = slice(3, 6) if tool == "mujoco" else slice(0, 3)
        expected[at, at] = -0.5 * pin.skew(fixed.f0[at])
    assert relative(moving.A - fixed.A, expected) < 1e-7


def differences(f, step=2e-3):
    """df/dt at 0, of order six."""
    weights = (45.0 / 60.0, -9.0 / 60.0, 1.0 / 60.0)
    return (
        sum(w * (f(k * step) - f(-k * step)) for k, w in enumerate(weights, 1)) / step
    )


def test_four_numbers_of_a_quaternion_have_a_direction_that_nothing_moves():
    """n = (quaternion, 0): a left inverse sees none of it, and A n is the rate of n (15.5)."""
    robot = fflin.load("servicer_7dof")
    q, v, u, _ = point(robot, 4, {})
    m = fflin.linearize(robot, q, v, u).to("drake")
    n = np.concatenate((m.q[:4], np.zeros(len(m.A) - 4)))
    assert np.abs(m.T_left @ n).max() < 1e-15
    assert (
        np.abs(m.A @ n - np.concatenate((m.f0[:4], np.zeros(len(m.A) - 4)))).max()
        < 1e-13
    )
    # d(n' dx)/dt = 0 as the point moves, and no input pushes along n.
    moving = np.concatenate((m.f0[:4], np.zeros(len(m.A) - 4)))
    assert np.abs(n @ m.A + moving).max() < 1e-12 * np.abs(m.A).max()
    assert np.abs(n @ m.B).max() < 1e-15
    # At rest it is an eigenvector with eigenvalue 0, one more than fflin's state has.
    rest = fflin.linearize(robot, q).to("drake")
    assert not (rest.A @ n).any() and np.abs(n @ rest.A).max() < 1e-15


def test_outputs_and_the_feedback_of_a_gain_are_the_same():
    sensors = [
        fflin.Accelerometer("base"),
        fflin.FrameVelocity("tool"),
        fflin.JointPositions(),
    ]
    robot = fflin.load("servicer_7dof").replace(
        outputs=sensors, gravity=(0.0, 0.0, -1.0)
    )
    q, v, u, how = point(robot, 8, CASES[3])
    lin = fflin.linearize(robot, q, v, u, **how)
    for tool in TOOLS:
        m = lin.to(tool)
        assert (
            m.output_names == lin.output_names and relative(m.D @ m.T_u, lin.D) < 1e-13
        )
        # By way of a model whose inputs are held in other axes.
        other = fflin.from_tool(
            robot, tool, m.q, m.v, m.u0, **how | {"frame": "world"}
        ).to(tool)
        assert relative(other.C, m.C) < 1e-12 and relative(other.D, m.D) < 1e-12
        assert relative(other.A, m.A) < 1e-12
    rest = fflin.linearize(robot.replace(gravity=(0.0, 0.0, 0.0)), q)
    m, gain = rest.to("mujoco"), fflin.lqr(rest, 1.0, 1.0)
    closed = m.A - m.B @ m.T_u @ gain.K @ m.T_left
    assert np.abs(np.sort(np.linalg.eigvals(closed)) - np.sort(gain.poles)).max() < 1e-6


def test_sampled_models_are_sampled_in_the_tools_coordinates(tmp_path):
    robot = fflin.load("planar_detumble")
    q, v, u, _ = point(robot, 9, {})
    lin = fflin.linearize(robot, q)
    h = 0.1
    for tool in TOOLS:
        m = lin.discretize(h).to(tool)
        assert m.dt == h and relative(m.A @ m.T, m.T @ lin.discretize(h).A) < 1e-13
        assert relative(m.B @ m.T_u, m.T @ lin.discretize(h).B) < 1e-13
    moving = fflin.linearize(robot, q, v, u)
    m, sampled = moving.to("mujoco"), moving.discretize(h).to("mujoco")
    from scipy.linalg import expm

    assert relative(sampled.A, expm(h * m.A)) < 1e-12
    moving.discretize(h).save(tmp_path / "a.npz")
    loaded = fflin.LinearModel.load(tmp_path / "a.npz")
    with pytest.raises(fflin.InputError, match="sampled"):
        fflin.transform(robot, loaded, "drake")
    with pytest.raises(fflin.InputError, match=r"fflin.transform"):
        loaded.to("drake")


def test_the_step_of_mujoco_comes_back():
    robot = fflin.load("servicer_7dof")
    q, v, u, _ = point(robot, 6, CASES[0])
    lin = fflin.linearize(robot, q, v, u)
    m = lin.to("mujoco", dt=2e-3)
    back = fflin.from_tool(robot, "mujoco", m.q, m.v, m.u0, A=m.A, B=m.B, dt=2e-3)
    assert relative(back.A, lin.A) < 1e-12 and relative(back.B, lin.B) < 1e-13
    changed = lin.A.copy()
    changed[-robot.nv :] *= 1.1  # of rates
    other = replace(lin, A=changed, B=1.1 * lin.B).to("mujoco", dt=2e-3)
    back = fflin.from_tool(
        robot, "mujoco", m.q, m.v, m.u0, A=other.A, B=other.B, dt=2e-3
    )
    assert relative(back.A, changed) < 1e-11 and relative(back.B, 1.1 * lin.B) < 1e-11
    only = fflin.from_tool(robot, "mujoco", m.q, m.v, m.u0, B=m.B, dt=2e-3)
    assert relative(only.A, lin.A) < 1e-13 and relative(only.B, lin.B) < 1e-13


def test_a_step_of_mujoco_rotates_the_errors_of_a_spinning_sphere():
    # Its angular velocity w is constant, so a step rotates the base by exp(h w). An error of its
    # attitude, in base axes, is then rotated back, and an error of w adds h times Jexp(h w).
    h, v = 0.2, np.array((0.3, -0.2, 0.1, 1.0, -2.0, 0.5))
    sphere = free_body((3.0, 3.0, 3.0))
    lin = fflin.linearize(sphere, v=v)
    m = lin.to("mujoco", dt=h)
    w = v[3:]
    assert m.A[3:6, 3:6] == pytest.approx(pin.exp3(-h * w), abs=1e-14)
    assert m.A[3:6, 9:12] == pytest.approx(h * pin.Jexp3(h * w), abs=1e-14)
    # The world-frame velocity of the base is constant, too.
    assert m.A[:3] == pytest.approx(np.eye(3, 12) + h * np.eye(3, 12, 6), abs=1e-14)


def test_wrong_matrices_are_detected():
    robot = fflin.load("servicer_7dof")
    q, v, u, _ = point(robot, 6, {})
    m = fflin.linearize(robot, q, v, u).to("drake")
    right = fflin.from_tool(robot, "drake", m.q, m.v, m.u0, A=m.A, B=m.B)
    assert fflin.check(robot, right).ok and right.certificate.route_A < 1e-9
    A = m.A.copy()
    A[-1, 0] += 1.0
    wrong = fflin.from_tool(robot, "drake", m.q, m.v, m.u0, A=A, B=m.B)
    assert not fflin.check(robot, wrong).ok and wrong.certificate.route_A > 1e-6


def test_mimic_joints_are_joints_to_tools(tmp_path):
    """x has them, and moves as their leaders make them; what breaks that is not seen."""
    path = tmp_path / "gripper.urdf"
    mimic = '<mimic joint="b" multiplier="-2" offset="0.3"/>'
    path.write_text(
        MIMIC.format(
            links=LINKS, a="revolute", b="continuous", parent="base", mimic=mimic
        )
    )
    robot = fflin.load(path)
    q = fflin.configuration(
        robot, {"b": 0.7}, random_pose(np.random.default_rng(0), 50.0)
    )
    v = fflin.velocity(robot, {"b": 0.4, "omega_b.x": 0.3, "v_b.y": 0.2})
    lin = fflin.linearize(robot, q, v)
    for tool in TOOLS:
        m = lin.to(tool)
        a, b = (m.state_names.index(f"q_m.{name}") for name in "ab")
        assert np.array_equal(m.T[a], -2.0 * m.T[b])
        # A model that moves as they do: x' dot = A' x' for all x' = T x.
        assert relative(m.T_left @ m.T, np.eye(len(lin.A))) < 1e-14
        if tool not in ("pinocchio", "crocoddyl"):
            assert m.q[-2:] == pytest.approx([-2.0 * 0.7 + 0.3, 0.7])
        back = fflin.from_tool(robot, tool, m.q, m.v, m.u0, A=m.A, B=m.B)
        assert relative(back.A, lin.A) < 1e-13 and relative(back.B, lin.B) < 1e-13
    q = m.q.copy()
    q[-2] += 0.1
    with pytest.raises(fflin.InputError, match="'b'"):
        fflin.from_tool(robot, "euler_rates", q, m.v)


def test_inputs_and_joints_stand_in_the_tools_order():
    robot = fflin.load("servicer_7dof")
    lin = fflin.linearize(robot)
    # Siblings as the file has them, panels first; by name in Pinocchio.
    order = ("panel_left", "panel_right", *robot.joint_names[:7])
    for tool in TOOLS:
        m, joint_names = lin.to(tool), robot.joint_names
        names = joint_names if tool[:3] in ("pin", "cro", "eul") else order
        assert tuple(m.input_names[6:]) == tuple(f"tau_m.{name}" for name in names)
        joints = [name[4:] for name in m.state_names if name.startswith("q_m.")]
        assert (
            joints
            == [name[7:] for name in m.state_names if name[:7] == "qdot_m."]
            == [*names]
        )
    m = lin.to("mujoco")
    assert m.input_names[:6] == (
        "F_b.x",
        "F_b.y",
        "F_b.z",
        "tau_b.x",
        "tau_b.y",
        "tau_b.z",
    )
    assert m.state_units[:6] == ("m",) * 3 + ("rad",) * 3
    few = robot.replace(inputs=[fflin.JointTorque("joint_2"), fflin.BaseForce()])
    assert fflin.linearize(few).to("drake").input_names == (
        "tau_m.joint_2",
        "F_b.x",
        "F_b.y",
        "F_b.z",
    )


def refused(match, function, *arguments, kind=fflin.InputError, **options):
    with pytest.raises(kind, match=match) as caught:
        function(*arguments, **options)
    assert "\n" not in str(caught.value)


def test_an_invalid_point_of_a_tool_is_refused_in_one_line():
    robot, rng = fflin.load("planar_detumble"), np.random.default_rng(0)
    lin, n = fflin.linearize(robot), robot.n
    to, back = fflin.transform, fflin.from_tool
    refused(
        r"no tool named 'drak'; did you mean drake",
        to,
        robot,
        lin,
        "drak",
        kind=LookupError,
    )
    refused("tool has type NoneType", back, robot, None, np.zeros(3))
    refused(r"q has shape \(3,\), expected", back, robot, "drake", np.zeros(3))
    q = lin.to("drake").q.copy()
    refused(r"v has shape", back, robot, "drake", q, np.zeros(3))
    refused(r"u has shape", back, robot, "drake", q, None, np.zeros(3))
    refused(r"A has shape", back, robot, "drake", q, A=np.eye(3))
    refused(
        r"A\[0, 0\] is nan; .* finite",
        back,
        robot,
        "drake",
        q,
        A=np.full((13 + 2 * n,) * 2, np.nan),
    )
    q[:4] *= 1.1
    refused(r"w, x, y, z has length 1.1, expected 1", back, robot, "drake", q)
    q = lin.to("spart").q.copy()
    q[0] = -1.0
    refused(
        r"R0 \(q\[:9\] by columns\) is not a rotation matrix", back, robot, "spart", q
    )
    up = fflin.configuration(
        robot, {}, pin.SE3(pin.rpy.rpyToMatrix(0.3, np.pi / 2, 0.0), np.zeros(3))
    )
    refused(
        r"the pitch is 90 deg",
        fflin.linearize(robot, up).to,
        "euler",
        kind=fflin.ChartError,
    )
    q = lin.to("euler").q.copy()
    q[1] = np.pi / 2
    refused(
        r"the pitch is 90 deg",
        back,
        robot,
        "euler",
        q,
        lin.v,
        A=lin.A,
        kind=fflin.ChartError,
    )
    refused(r"dt is 0.1 s for drake", to, robot, lin, "drake", dt=0.1)
    refused(r"dt is -1 s for mujoco", to, robot, lin, "mujoco", dt=-1.0)
    refused(r"sampled", to, robot, lin.discretize(0.1), "mujoco", dt=0.1)
    refused(r"the given robot 'cubesat' lacks", to, fflin.load("cubesat"), lin, "drake")
    arm = robot.replace(inputs=[fflin.JointTorque("*")])
    reduced = fflin.momentum_reduction(fflin.linearize(arm))
    refused(r"lin lacks some states", to, arm, reduced, "drake")
    servicer = fflin.load("servicer_7dof").replace(inputs=[fflin.BaseForce()])
    if np.abs(Formulas(servicer, "spart", servicer.neutral()).centre.translation).max():
        refused(
            r"a BaseForce needs a BaseTorque", fflin.linearize(servicer).to, "spart"
        )
    assert rng and free_body((1.0, 2.0, 3.0)).n == 0


def test_a_body_without_joints_and_files(tmp_path):
    body = free_body((1.0, 2.0, 3.0))
    for tool in TOOLS:
        m = fflin.linearize(body).to(tool)
        m.save(tmp_path / f"{tool}.mat")
        loaded = fflin.ToolModel.load(tmp_path / f"{tool}.mat")
        for key in ("A", "B", "T", "T_left", "T_u", "q", "v", "x0"):
            assert np.array_equal(getattr(loaded, key), getattr(m, key)), key
        assert (
            loaded.state_names == m.state_names
            and loaded.tool == tool
            and "nx=1" in repr(m)
        )


def test_an_orbit_has_angles_and_no_other_tool():
    """Roll, pitch and yaw are those from the orbit's frame, which no other tool's world is."""
    orbit = fflin.CircularOrbit(mean_motion=1e-3)
    robot = fflin.load("servicer_7dof").replace(orbit=orbit)
    q, v, *_ = point(robot, 3, {}, degrees=40.0)
    lin = fflin.linearize(robot, q, v)
    for tool in ("euler", "euler_rates"):
        m = lin.to(tool)
        back = fflin.from_tool(robot, tool, m.q, m.v, A=m.A, B=m.B)
        assert relative(back.A, lin.A) < 1e-13 and back.frame == lin.frame == "lvlh"
    n = len(m.A) // 2
    assert relative(m.A[:n], np.eye(n, 2 * n, n)) < 1e-13  # coordinates and their rates
    for tool in ("drake", "mujoco", "pinocchio", "crocoddyl", "spart"):
        refused(r"is in orbit; remove the orbit", lin.to, tool)
