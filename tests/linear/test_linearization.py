"""A and B: closed forms and laws first, then every robot by the routes of `check`."""

import pickle
import sys
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.base.rotation import skew
from tests.support.robots import (
    BUNDLED,
    FRAMES,
    mostly,
    random_point,
    random_pose,
    random_tree,
)


def blocks(lin, robot):
    """State groups of a model."""
    return fflin.StateMap(robot, frame=lin.frame).groups


@pytest.mark.parametrize("name", BUNDLED)
def test_fixed_point_has_the_structure_of_the_source(robots, name):
    robot = robots[name]
    rng = np.random.default_rng(1)
    q, _, _ = random_point(robot, rng)
    lin = fflin.linearize(robot, q)
    n, nv = robot.n, 6 + robot.n
    N = np.diag([0.5] * 3 + [1.0] * (3 + n))
    assert (
        lin.A == np.block([[np.zeros((nv, nv)), N], [np.zeros((nv, 2 * nv))]])
    ).all()
    assert not (lin.A @ lin.A).any()
    assert not lin.B[:nv].any()
    assert not lin.f0.any()
    assert lin.is_equilibrium()
    assert (lin.C == np.eye(2 * nv)).all() and not lin.D.any()
    # M B = E, and B's block is a symmetric positive definite inverse inertia.
    inverse = lin.B[nv:]
    scale = np.sqrt(lin.M.diagonal())
    residual = (lin.M @ inverse - np.eye(nv)) * scale / scale[:, None]
    assert np.abs(residual).max() < 1e-9
    assert (inverse == inverse.T).all()
    assert np.linalg.eigvalsh(inverse * scale * scale[:, None])[0] > 0


@pytest.mark.parametrize("name", BUNDLED)
def test_fixed_point_does_not_depend_on_frame_or_base_pose(robots, name):
    robot = robots[name]
    rng = np.random.default_rng(2)
    joints = {joint: rng.uniform(-2, 2) for joint in robot.joint_names}
    first = fflin.linearize(robot, fflin.configuration(robot, joints))
    for frame in FRAMES:
        base = random_pose(rng, 150.0)
        q = fflin.configuration(robot, joints, base)
        lin = fflin.linearize(robot, q, frame=frame)
        assert (lin.A == first.A).all()
        assert (lin.B == first.B).all()
        assert lin.reference.isApprox(base, 1e-14)


def test_inertia_matches_the_kinetic_energy(robots):
    """nu^T M nu / 2 in the frame's own velocities is Pinocchio's kinetic energy."""
    rng = np.random.default_rng(3)
    for name in BUNDLED:
        robot = robots[name]
        reference = random_pose(rng, 70.0)
        for frame in FRAMES:
            q, v, _ = random_point(robot, rng)
            state = fflin.StateMap(robot, frame=frame, reference=reference)
            nu = state.to_state(q, v)[6 + robot.n :]
            lin = fflin.linearize(robot, q, frame=frame, reference=reference)
            energy = pin.computeKineticEnergy(
                robot.model, robot.model.createData(), q, v
            )
            assert 0.5 * nu @ lin.M @ nu == pytest.approx(energy, rel=1e-12)


@pytest.mark.parametrize("frame", FRAMES)
def test_rigid_body_closed_form(frame):
    """Euler's equation J wdot + w x J w = tau and m rddot = F, differentiated by hand."""
    robot = fflin.load("cubesat")
    rng = np.random.default_rng(4)
    inertia = robot.model.inertias[1]
    J, m = inertia.inertia, inertia.mass
    w, v, tau, F = rng.normal(size=(4, 3))
    q = fflin.configuration(robot, base=random_pose(rng, 80.0))
    lin = fflin.linearize(
        robot, q, np.concatenate((v, w)), np.concatenate((tau, F)), frame=frame
    )
    E, O = np.eye(3), np.zeros((3, 3))
    Jinv = np.linalg.inv(J)
    wdot = Jinv @ (tau - np.cross(w, J @ w))
    euler = Jinv @ (skew(J @ w) - skew(w) @ J)
    B = np.vstack((np.zeros((6, 6)), np.block([[Jinv, O], [O, E / m]])))
    # d theta = 2 d q_b at the reference attitude.
    expected = {
        "hybrid": [
            [-skew(w) / 2, O, E / 2, O],
            [O, O, O, E],
            [O, O, euler, O],
            [O, O, O, O],
        ],
        "local": [
            [-skew(w) / 2, O, E / 2, O],
            [-2 * skew(v), O, O, E],
            [O, O, euler, O],
            [O, O, skew(v), -skew(w)],
        ],
        # J turns with the body: d(R J R^T) = [theta]x J - J [theta]x.
        "world": [
            [skew(w) / 2, O, E / 2, O],
            [O, O, O, E],
            [
                2 * (Jinv @ skew(tau) + euler @ skew(w) - skew(wdot)),
                O,
                euler,
                O,
            ],
            [O, O, O, O],
        ],
    }[frame]
    assert lin.A == pytest.approx(np.block(expected), abs=1e-11 * np.abs(wdot).max())
    assert lin.B == pytest.approx(B, rel=1e-14)
    rate = {"local": F / m - np.cross(w, v)}.get(frame, F / m)
    assert lin.f0 == pytest.approx(np.concatenate((w / 2, v, wdot, rate)), rel=1e-12)


@pytest.mark.parametrize("name", BUNDLED)
def test_joint_torques_leave_the_momentum(robots, name):
    """L1 = [0, M_b] and L2 = [M_b N^-1, 0]: L1 A = 0, L2 A = L1, L1 B = (E, 0)."""
    robot = robots[name]
    lin = fflin.linearize(robot, random_point(robot, np.random.default_rng(5))[0])
    nv = 6 + robot.n
    zero = np.zeros((6, nv))
    L1 = np.hstack((zero, lin.M[:6]))
    L2 = np.hstack((lin.M[:6] / np.array([0.5] * 3 + [1.0] * (nv - 3)), zero))
    size = np.abs(lin.M[:6]).max()
    assert not (L1 @ lin.A).any()
    assert L2 @ lin.A == pytest.approx(L1, rel=1e-15)
    assert L1 @ lin.B == pytest.approx(np.eye(6, nv), abs=1e-12 * size)


@pytest.mark.parametrize("frame", FRAMES)
def test_orbit_loses_no_accuracy(frame):
    """Where the base is and how fast it flies changes no acceleration and no slope (Galilei)."""
    robot = fflin.load("servicer_7dof")
    q, v, u = random_point(robot, np.random.default_rng(6))
    orbit, boosted = q.copy(), v.copy()
    orbit[:3], boosted[:3] = (6.8e6, -2e5, 1e4), (-30.0, 7.6e3, 12.0)
    slow = fflin.linearize(robot, q, v, u, frame=frame)
    fast = fflin.linearize(robot, orbit, boosted, u, frame=frame)
    nv = 6 + robot.n
    g = blocks(slow, robot)
    turned = frame != "local"
    rows = slice(nv, None) if turned else slice(12 + robot.n, None)
    assert (slow.A[rows, g.qdot_m] == fast.A[rows, g.qdot_m]).all()
    assert (slow.A[rows, g.omega_b] == fast.A[rows, g.omega_b]).all()
    assert (slow.f0[rows] == fast.f0[rows]).all()
    if turned:
        assert not fast.A[nv:, g.v_b].any()
    assert fflin.check(robot, fast).ok


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize(
    "name", mostly(BUNDLED, "cubesat", "planar_detumble", "servicer_7dof")
)
def test_check_holds_at_random_points(robots, name, frame):
    robot = robots[name]
    rng = np.random.default_rng(7)
    for degrees in (1e-7, 60.0, 160.0):
        for reference in (None, pin.SE3.Identity()):
            q, v, u = random_point(robot, rng, degrees=degrees)
            lin = fflin.linearize(robot, q, v, u, frame=frame, reference=reference)
            result = fflin.check(robot, lin)
            assert result.ok, result
            aba = [row for row in result.rows if row.test == "ABA derivatives"]
            assert len(aba) == 54 - 6 * (robot.n == 0)
            assert max(row.error for row in aba) < 1e-9


@pytest.mark.parametrize("frame", FRAMES)
def test_check_holds_on_random_trees(frame):
    rng = np.random.default_rng(8)
    for n in (1, 5, 12):
        robot = random_tree(rng, n)
        lin = fflin.linearize(
            robot,
            *random_point(robot, rng),
            frame=frame,
            reference=random_pose(rng, 20.0),
        )
        result = fflin.check(robot, lin)
        assert result.ok, result


def test_armature_is_part_of_the_inertia():
    model = fflin.load("dual_arm").model.copy()
    model.armature = np.concatenate((np.zeros(6), np.linspace(0.1, 1.0, model.nv - 6)))
    robot = fflin.from_model(model)
    bare = fflin.linearize(fflin.load("dual_arm"))
    lin = fflin.linearize(robot)
    assert lin.M - bare.M == pytest.approx(np.diag(model.armature), abs=1e-12)
    q, v, u = random_point(robot, np.random.default_rng(9))
    assert fflin.check(robot, fflin.linearize(robot, q, v, u)).ok


def test_linear_model_predicts_the_nonlinear_one_to_second_order():
    """Halving a deviation divides the prediction error by four."""
    robot = fflin.load("canadarm2")
    rng = np.random.default_rng(10)
    q, v, u = random_point(robot, rng, degrees=40.0)
    lin = fflin.linearize(robot, q, v, u, reference=pin.SE3.Identity())
    dx, du = rng.normal(size=len(lin.x0)), rng.normal(size=len(u)) * np.abs(u)
    errors = []
    for scale in (1e-3, 5e-4):
        state = fflin.StateMap(robot, reference=lin.reference)
        q1, v1 = state.to_pinocchio(lin.x0 + scale * dx)
        f1 = fflin.linearize(robot, q1, v1, u + scale * du, reference=lin.reference).f0
        predicted = lin.f0 + scale * (lin.A @ dx + lin.B @ du)
        errors.append(np.abs(f1 - predicted).max())
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)


def test_prepared_linearizer_gives_the_same_and_keeps_earlier_results():
    robot = fflin.load("ets_vii")
    rng = np.random.default_rng(11)
    linearizer = fflin.Linearizer(robot)
    q1, v1, u1 = random_point(robot, rng)
    first, moving = linearizer(q1), linearizer(q1, v1, u1)
    kept = [array.copy() for array in (first.B, first.M, moving.A, moving.B)]
    linearizer(*random_point(robot, rng))
    linearizer(random_point(robot, rng)[0])
    for array, copy in zip((first.B, first.M, moving.A, moving.B), kept, strict=True):
        assert (array == copy).all()
    assert (fflin.linearize(robot, q1, v1, u1).A == moving.A).all()


def test_input_alone_is_not_dropped():
    robot = fflin.load("ets_vii")
    u = np.arange(12.0)
    assert (fflin.linearize(robot, None, None, u).u0 == u).all()
    assert fflin.linearize(robot, None, None, u).f0.any()


def test_linearizer_is_shared_copied_and_pickled():
    robot = fflin.load("dual_arm")
    linearizer = fflin.Linearizer(robot, frame="world", reference=pin.SE3.Identity())
    rng = np.random.default_rng(15)
    points = [random_point(robot, rng) for _ in range(40)]
    expected = [linearizer(*point) for point in points]
    for twin in (deepcopy(linearizer), pickle.loads(pickle.dumps(linearizer))):
        assert (twin(*points[0]).A == expected[0].A).all()
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            result = list(pool.map(lambda point: linearizer(*point), points * 5))
    finally:
        sys.setswitchinterval(interval)
    for lin, right in zip(result, expected * 5, strict=True):
        assert (lin.A == right.A).all() and (lin.B == right.B).all()


def test_overflowing_values_are_refused():
    robot = fflin.load("ets_vii")
    q = fflin.configuration(robot)
    for v, u in ((np.full(12, 1e200), None), (None, np.full(12, 1e308))):
        with pytest.raises(fflin.InputError, match="finite"):
            fflin.linearize(robot, q, v, u)
    # Of a body alike about all axes the rates vanish, and the slopes do not.
    ball = fflin.load("cubesat")
    with pytest.raises(fflin.InputError, match="finite"):
        fflin.linearize(ball, v=fflin.velocity(ball, {"omega_b.x": 1e200}))
    with np.errstate(all="ignore"), pytest.raises(fflin.InputError, match="overflows"):
        fflin.linearize(robot).discretize(1e300)
    for bad in (np.diag([2.0, 1, 1]), np.diag([1.0, 1, -1]), np.full((3, 3), np.nan)):
        with pytest.raises(fflin.InputError, match="reference"):
            fflin.linearize(robot, reference=pin.SE3(bad, np.zeros(3)))
        with pytest.raises(fflin.InputError, match="base"):
            fflin.configuration(robot, base=pin.SE3(bad, np.zeros(3)))


def test_nothing_of_the_callers_is_changed_or_shared():
    robot = fflin.load("ets_vii")
    q, v, u = random_point(robot, np.random.default_rng(12))
    before = [array.copy() for array in (q, v, u)]
    lin = fflin.linearize(robot, q, v, u)
    for array, copy in zip((q, v, u), before, strict=True):
        assert (array == copy).all()
        array[:] = 0.0
    assert (
        (lin.q == before[0]).all()
        and (lin.v == before[1]).all()
        and (lin.u0 == before[2]).all()
    )
    for array in (lin.A, lin.B, lin.M, lin.x0, lin.f0, lin.q, lin.v, lin.u0):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_slightly_unnormalised_configuration_is_renormalised():
    robot = fflin.load("ets_vii")
    q = random_point(robot, np.random.default_rng(13))[0]
    rough = q.copy()
    rough[3:7] *= 1 + 3e-7
    rough[7:9] *= 1 - 3e-7
    assert fflin.linearize(robot, rough).B == pytest.approx(
        fflin.linearize(robot, q).B, rel=1e-12
    )


@pytest.mark.parametrize("dtype", [">f8", "f4", "O"])
def test_arrays_of_other_kinds_are_read_right_or_refused(dtype):
    robot = fflin.load("cubesat")
    q = np.array([0.5, 0, 0, 0, 0, 0, 1.0])
    expected = fflin.linearize(robot, q, np.ones(6))
    if dtype == "O":
        with pytest.raises(fflin.InputError, match="object"):
            fflin.linearize(robot, q.astype(dtype))
        return
    lin = fflin.linearize(robot, q.astype(dtype), np.ones(6).astype(dtype))
    assert (lin.A == expected.A).all() and (lin.f0 == expected.f0).all()


def test_certificate_tells_a_good_model():
    robot = fflin.load("canadarm2")
    certificate = fflin.linearize(
        robot, *random_point(robot, np.random.default_rng(14))
    ).certificate
    assert 1.0 < certificate.condition < 1e5
    assert 0.0 < certificate.inertia_residual < 1e-10
    assert 0.0 < certificate.route_A < 1e-10
    assert 0.0 < certificate.route_B < 1e-10
    assert certificate.f0 > 0.1
    assert fflin.linearize(robot).certificate.f0 == 0.0


def test_singular_inertia_names_the_joint():
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(1, pin.Inertia.Random(), pin.SE3.Identity())
    model.addJoint(1, pin.JointModelRZ(), pin.SE3.Random(), "ghost")
    robot = fflin.from_model(model)
    with pytest.raises(fflin.SingularInertiaError, match="'ghost'"):
        fflin.linearize(robot)
    assert fflin.linearize(fflin.from_model(model, lock=["ghost"])).B.shape == (12, 6)


def test_configuration_dependent_singularity_names_the_joints():
    # icub's head is a point mass, on whose place two of its neck's axes meet at neutral.
    robot = fflin.load("icub")
    with pytest.raises(fflin.SingularInertiaError, match=r"'neck_(roll|yaw)'"):
        fflin.linearize(robot)
    q = fflin.configuration(robot, {"neck_roll": 0.4, "neck_yaw": 0.3})
    assert fflin.check(robot, fflin.linearize(robot, q)).ok
