"""M and its inverse: accuracy, mimic joints, and the verdict on an M that is nearly singular."""

import warnings
from fractions import Fraction

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.rnea import STROKE, inertia_bounds
from tests.support.robots import BUNDLED, LINKS, MIMIC, mostly, random_tree


def chain(*inertias):
    """A robot of a base and revolute joints one after the other, all about z, 0.1 m apart."""
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(
        1, pin.Inertia(5.0, np.zeros(3), np.eye(3)), pin.SE3.Identity()
    )
    place = pin.SE3(np.eye(3), np.array([0.1, 0.0, 0.0]))
    for index, inertia in enumerate(inertias):
        joint = model.addJoint(index + 1, pin.JointModelRZ(), place, f"joint_{index}")
        model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
    return fflin.from_model(model, name="chain")


def exact_inverse(M):
    """The inverse in rational arithmetic, rounded once."""
    n = len(M)
    rows = [
        [Fraction(x) for x in row] + [Fraction(int(i == j)) for j in range(n)]
        for i, row in enumerate(M.tolist())
    ]
    for k in range(n):
        pivot = rows[k][k]
        rows[k] = [x / pivot for x in rows[k]]
        for i in range(n):
            if i != k and rows[i][k]:
                factor = rows[i][k]
                rows[i] = [
                    x - factor * y for x, y in zip(rows[i], rows[k], strict=True)
                ]
    return np.array([[float(x) for x in row[n:]] for row in rows])


@pytest.mark.parametrize("n", [1, 6, 10])
def test_inverse_is_as_right_as_the_conditioning_allows(n):
    robot = random_tree(np.random.default_rng(n), n)
    lin = fflin.linearize(robot)
    exact = exact_inverse(lin.M)
    mobility = np.sqrt(exact.diagonal())
    error = np.abs(lin.B[6 + n :] - exact) / np.outer(mobility, mobility)
    # A Cholesky factorisation is backward stable in the scaled M: 8 n eps is generous.
    assert error.max() < 8 * (6 + n) * np.finfo(float).eps * lin.certificate.condition


def test_scaling_m_beforehand_would_gain_nothing():
    """Where M is factored, its inverse by way of a scaled M is no nearer to the exact one."""
    lin = fflin.linearize(far_joint(1e3))
    exact = exact_inverse(lin.M)
    mobility = np.sqrt(exact.diagonal())
    scale = 1.0 / np.sqrt(lin.M.diagonal())
    factor = np.linalg.inv(np.linalg.cholesky(scale[:, None] * lin.M * scale))
    scaled = scale[:, None] * (factor.T @ factor) * scale
    errors = [
        np.abs((inverse - exact) / np.outer(mobility, mobility)).max()
        for inverse in (lin.B[12:], scaled)
    ]
    assert errors[0] < 4 * errors[1]


@pytest.mark.parametrize(
    "name",
    mostly(
        [*BUNDLED, "ur5", "tiago_no_hand", "double_pendulum"],
        *("cubesat", "planar_detumble", "ur5", "double_pendulum"),
    ),
)
def test_bound_on_rounding_holds(name):
    """Of M's diagonal at any configuration, and of the error of the quick way to M^-1."""
    robot = fflin.load(name)
    order = [3, 4, 5, 0, 1, 2, *(joint.idx_v for joint in robot.joints)]
    bounds = inertia_bounds(robot.model)[order]
    rng = np.random.default_rng(0)
    for _ in range(3):
        joints = {
            joint.name: rng.uniform(-STROKE, STROKE) * (1.0 if joint.prismatic else 3.0)
            for joint in robot.joints
        }
        lin = fflin.linearize(robot, fflin.configuration(robot, joints))
        assert (lin.M.diagonal() <= bounds * (1.0 + 1e-12)).all()
        exact = exact_inverse(lin.M)
        coupling = bounds @ exact.diagonal()
        mobility = np.sqrt(exact.diagonal())
        error = np.abs(lin.B[6 + robot.n :] - exact) / np.outer(mobility, mobility)
        assert error.max() < np.finfo(float).eps * coupling


def test_slide_beyond_its_bound_loses_no_accuracy():
    robot = fflin.load("tiago_no_hand")
    (slide,) = [joint.name for joint in robot.joints if joint.prismatic]
    lin = fflin.linearize(robot, fflin.configuration(robot, {slide: 50.0}))
    exact = exact_inverse(lin.M)
    mobility = np.sqrt(exact.diagonal())
    error = np.abs(lin.B[6 + robot.n :] - exact) / np.outer(mobility, mobility)
    assert (
        error.max() < 8 * len(exact) * np.finfo(float).eps * lin.certificate.condition
    )


def test_far_base_loses_no_accuracy():
    robot = fflin.load("servicer_7dof")
    orbit = pin.SE3(pin.exp3(np.array([0.3, -0.9, 0.4])), np.array([7e6, -2e6, 1e6]))
    far = fflin.linearize(robot, fflin.configuration(robot, {"joint_2": 0.4}, orbit))
    near = fflin.linearize(robot, fflin.configuration(robot, {"joint_2": 0.4}))
    assert (far.B == near.B).all()


@pytest.mark.parametrize("n", [10, 70])
def test_long_chain_is_inverted_as_right_by_every_way(n):
    """Beyond the quick way: by a sparse factor, and by a dense one."""
    link = pin.Inertia(1e3, np.array([0.05, 0.01, 0.0]), np.diag([4.0, 4.0, 4.0]))
    robot = chain(*[link] * (n - 1), pin.Inertia(1.0, np.zeros(3), 1e-6 * np.eye(3)))
    lin = fflin.linearize(robot)
    inverse = lin.B[6 + n :]
    mobility = np.sqrt(inverse.diagonal())
    assert inertia_bounds(robot.model)[6:] @ mobility[6:] ** 2 > 4.6e5
    scale = np.sqrt(lin.M.diagonal())
    residual = (lin.M @ inverse - np.eye(6 + n)) / scale[:, None] * scale
    assert (
        np.abs(residual).max()
        < 8 * (6 + n) * np.finfo(float).eps * lin.certificate.condition
    )
    assert (inverse == inverse.T).all()


def far_joint(distance):
    """ets_vii with its third joint far away: the base turns with nearly all of the arm."""
    model = fflin.load("ets_vii").model.copy()
    model.jointPlacements[4] = pin.SE3(np.eye(3), np.array([distance, 0.0, 0.0]))
    return fflin.from_model(model, name="far")


def test_nearly_singular_m_is_warned_of_with_the_error_to_expect():
    with pytest.warns(fflin.FflinWarning, match="1e-07.*'joint_2'"):
        lin = fflin.linearize(far_joint(1e5))
    exact = exact_inverse(lin.M)
    mobility = np.sqrt(exact.diagonal())
    error = np.abs(lin.B[12:] - exact) / np.outer(mobility, mobility)
    assert 1e-9 < error.max() < 1e-6


@pytest.mark.parametrize(
    "robot",
    [
        far_joint(1e9),
        chain(pin.Inertia(2.0, np.array([0.0, 0.0, 0.2]), np.zeros((3, 3)))),
    ],
    ids=["far", "on its axis"],
)
def test_singular_m_is_refused(robot):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(fflin.SingularInertiaError, match=r"'joint_[012]'"):
            fflin.linearize(robot)


def test_massless_base_is_refused_where_its_m_is_singular():
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    joint = model.addJoint(1, pin.JointModelRZ(), pin.SE3.Random(), "joint")
    model.appendBodyToJoint(joint, pin.Inertia.Random(), pin.SE3.Random())
    with pytest.raises(fflin.SingularInertiaError, match="'joint'"):
        fflin.linearize(fflin.from_model(model))


@pytest.mark.parametrize("parent", ["base", "la"])
@pytest.mark.parametrize(
    "types", [("revolute", "revolute"), ("prismatic", "continuous")]
)
def test_mimic_joints_leave_one_degree_of_freedom(types, parent, tmp_path):
    """Joint a = -2 b + 0.3, before its leader: M_r = S^T M S, and the motion obeys it."""
    document = MIMIC.format(
        links=LINKS,
        a=types[0],
        b=types[1],
        parent=parent,
        mimic='<mimic joint="b" multiplier="-2" offset="0.3"/>',
    )
    (tmp_path / "r.urdf").write_text(document)
    robot = fflin.load(tmp_path / "r.urdf")
    assert robot.joint_names == ("b",) and robot.n == 1 and robot.nv == 8
    q = fflin.configuration(robot, {"b": 0.4})
    leader, follower = robot.joints[0], robot.followers[0].joint
    assert follower.value(q) == pytest.approx(-2 * 0.4 + 0.3)
    full = pin.crba(robot.model, robot.model.createData(), q)
    S = np.zeros((8, 7))
    S[[3, 4, 5, 0, 1, 2], range(6)] = 1.0
    S[leader.idx_v, 6], S[follower.idx_v, 6] = 1.0, -2.0
    lin = fflin.linearize(robot, q)
    assert lin.M == pytest.approx(S.T @ full @ S, rel=1e-14, abs=1e-14)
    rng = np.random.default_rng(1)
    for frame in ("hybrid", "local", "world"):
        v = S @ rng.normal(size=7)
        moving = fflin.linearize(robot, q, v, rng.normal(size=7), frame=frame)
        result = fflin.check(robot, moving)
        assert result.ok, result
        # Kinetic energy of the independent velocities is that of all.
        nu = moving.x0[7:]
        energy = pin.computeKineticEnergy(robot.model, robot.model.createData(), q, v)
        assert 0.5 * nu @ moving.M @ nu == pytest.approx(energy, rel=1e-13)


def test_an_invalid_mimic_joint_is_refused():
    robot = fflin.load("panda")
    q = robot.neutral()
    follower = robot.followers[0].joint
    q[follower.idx_q] += 0.01
    with pytest.raises(fflin.InputError, match=r"'panda_finger_joint2'.*0\.01"):
        fflin.linearize(robot, q)
    v = np.zeros(robot.nv)
    v[follower.idx_v] = 0.1
    with pytest.raises(fflin.InputError, match=r"'panda_finger_joint2'.*0\.1"):
        fflin.linearize(robot, None, v)
    with pytest.raises(fflin.InputError, match="'panda_finger_joint1'"):
        fflin.configuration(robot, {"panda_finger_joint2": 0.01})


def test_singular_m_of_mimic_joints_is_refused():
    with pytest.raises(fflin.SingularInertiaError, match=r"'LHand'.*'RHand'"):
        fflin.linearize(fflin.load("romeo"))


def test_mimic_joints_of_a_locked_leader_are_welded(tmp_path):
    document = MIMIC.format(
        links=LINKS,
        a="revolute",
        b="revolute",
        parent="base",
        mimic='<mimic joint="b" multiplier="-2" offset="0.3"/>',
    )
    (tmp_path / "r.urdf").write_text(document)
    free = fflin.load(tmp_path / "r.urdf")
    for lock, at in (({"b": 0.4}, 0.4), ({"b": None}, 0.0)):
        robot = fflin.load(tmp_path / "r.urdf", lock=lock)
        assert robot.n == 0 and not robot.followers
        M = fflin.linearize(free, fflin.configuration(free, {"b": at})).M[:6, :6]
        assert fflin.linearize(robot).M == pytest.approx(M, rel=1e-13, abs=1e-13)
    # A follower that is locked alone stays at its offset.
    robot = fflin.load(tmp_path / "r.urdf", lock=["a"])
    assert robot.joint_names == ("b",) and robot.locked == ("a=0.3",)


def test_locking_a_leader_locks_its_followers():
    robot = fflin.load("panda", lock={"panda_finger_joint1": 0.02})
    assert not robot.followers and robot.n == 7
    free = fflin.load("panda")
    q = fflin.configuration(free, {"panda_finger_joint1": 0.02})
    M = fflin.linearize(free, q).M[:13, :13]
    assert fflin.linearize(robot).M == pytest.approx(M, rel=1e-12, abs=1e-12)
    # A follower that is locked leaves its leader free.
    robot = fflin.load("panda", lock=["panda_finger_joint2"])
    assert not robot.followers and robot.n == 8
