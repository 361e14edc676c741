"""Sweeps: each of their models is the one that `linearize` makes."""

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.messages import says
from tests.support.robots import BUNDLED, random_pose, random_tree, singular_at
from tests.support.sweeps import assert_same, points


@pytest.mark.compiled
@pytest.mark.parametrize("name", BUNDLED)
def test_at_rest_every_model_matches_linearize(name, robots):
    robot = robots[name]
    q, _, _ = points(robot, 24)
    batch = fflin.sweep(robot, q)
    assert len(batch) == 24
    for lin, point in zip(batch, q, strict=True):
        expected = fflin.linearize(robot, point)
        assert_same(lin, expected, 1e-11)
        assert lin.M == pytest.approx(expected.M, rel=1e-14, abs=0.0)
        certificate = lin.certificate
        assert certificate.inertia_residual < 1e-14 * certificate.condition


@pytest.mark.parametrize("frame", ["hybrid", "local", "world"])
def test_at_operating_points_every_model_matches_linearize(frame, robots):
    robot = robots["servicer_7dof"]
    q, v, u = points(robot, 5)
    reference = random_pose(np.random.default_rng(3), 20.0)
    batch = fflin.sweep(robot, q, v, u, frame=frame, reference=reference, chunk=2)
    for index, point in enumerate(zip(q, v, u, strict=True)):
        assert_same(
            batch[index],
            fflin.linearize(robot, *point, frame=frame, reference=reference),
        )
    # One velocity and one input for all.
    batch = fflin.sweep(robot, q, v[0], u[0], frame=frame)
    assert_same(batch[3], fflin.linearize(robot, q[3], v[0], u[0], frame=frame))
    assert batch.v.strides[0] == batch.u0.strides[0] == 0


def equipped(robot):
    """The servicer with what makes its models unlike those at rest."""
    thruster = fflin.Thruster("tool", (0.0, 0.1, 0.1), (0.3, 0.0, -1.0))
    base = fflin.Thruster("base", (0.5, 0.0, 0.1), (0.0, 1.0, 0.0))
    yield robot.replace(inputs=[fflin.BaseTorque(), base, fflin.JointTorque("joint_2")])
    yield robot.replace(inputs=[thruster, fflin.BaseForce()])
    yield robot.replace(outputs=[fflin.FramePose("tool"), fflin.Accelerometer("base")])
    yield robot.replace(stiffness=3.0, damping=0.1)
    yield robot.replace(gravity=(0.0, 0.0, -9.81))
    yield robot.replace(inputs=[fflin.ReactionWheel((0.0, 0.0, 1.0), momentum=2.0)])
    yield robot.replace(inputs=[fflin.ReactionWheel((0.0, 1.0, 0.0), frame="tool")])


@pytest.mark.parametrize("case", range(7))
def test_inputs_outputs_springs_and_gravity(case, robots):
    robot = list(equipped(robots["servicer_7dof"]))[case]
    q, _, _ = points(robots["servicer_7dof"], 9)
    batch = fflin.sweep(robot, q, chunk=4)
    for index, point in enumerate(q):
        assert_same(batch[index], fflin.linearize(robot, point), 1e-11)
    moving = fflin.sweep(robot, q, moving=True)
    assert_same(moving[4], fflin.linearize(robot, q[4], moving=True))


@pytest.mark.compiled
def test_wheels_with_an_inertia_are_joints(robots):
    wheel = fflin.ReactionWheel((0.0, 0.0, 1.0), inertia=0.1)
    robot = robots["ets_vii"].replace(inputs=[fflin.BaseTorque(), wheel])
    batch = fflin.sweep(robot, fflin.random_configurations(robot, 20, seed=1))
    for lin in batch:
        assert_same(lin, fflin.linearize(robot, lin.q), 1e-11)
    moving = fflin.sweep(
        robot, batch.q, fflin.velocity(robot, {robot.joint_names[-1]: 50.0})
    )
    lin = fflin.linearize(robot, batch.q[3], moving.v[3])
    assert (
        moving[3].ignorable == lin.ignorable
        and f"q_m.{robot.joint_names[-1]}" in lin.ignorable
    )
    assert moving[3].is_equilibrium() == lin.is_equilibrium()


def test_root_that_stands_elsewhere(robots):
    model = robots["ets_vii"].model.copy()
    model.jointPlacements[1] = random_pose(np.random.default_rng(5), 40.0)
    robot = fflin.from_model(model, name="elsewhere")
    q, _, _ = points(robot, 4)
    for lin, point in zip(fflin.sweep(robot, q), q, strict=True):
        assert_same(lin, fflin.linearize(robot, point), 1e-11)


@pytest.mark.compiled
def test_constant_arrays_are_stored_once(robots):
    import tracemalloc

    robot = robots["servicer_7dof"]
    q = fflin.random_configurations(robot, 10_000, seed=2).rows(0, 10_000)
    fflin.sweep(robot, q)
    tracemalloc.start()
    batch = fflin.sweep(robot, q)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1.2 * batch.B_lower.nbytes
    assert [batch.A.strides[0], batch.C.strides[0], batch.f0.strides[0]] == [0, 0, 0]
    assert batch.A[7] == pytest.approx(batch[7].A, abs=0.0)
    assert batch.B[3] == pytest.approx(batch[3].B, abs=0.0)


def test_slices_masks_and_joint_values(robots):
    robot = robots["servicer_7dof"]
    axes = {"joint_2": np.linspace(-1.0, 1.0, 5), "joint_4": [0.0, 0.5, 0.7]}
    configurations = fflin.grid(robot, axes, joints={"joint_1": 0.3})
    batch = fflin.sweep(robot, configurations)
    assert len(batch) == len(configurations) == 15
    expected = fflin.configuration(
        robot, {"joint_1": 0.3, "joint_2": -0.5, "joint_4": 0.5}
    )
    # the last joint varies fastest
    assert batch[4].q == pytest.approx(expected, abs=0.0)
    assert_same(batch[4:9][1], batch[5])
    assert_same(batch[-1], batch[14])
    assert_same(batch[np.arange(15) % 4 == 0][2], batch[8])
    assert_same(batch.nearest({"joint_2": 0.4, "joint_4": 0.59}), batch[10])
    chosen = batch.select({"joint_2": (-0.5, 0.5), "joint_4": 0.7})
    assert chosen.joint_positions[:, [2 - 1, 4 - 1]] == pytest.approx(
        np.array([[-0.5, 0.7], [0.0, 0.7], [0.5, 0.7]])
    )
    with pytest.raises(fflin.InputError, match="batch"):
        batch.select({"joint_4": 0.6})
    with pytest.raises(fflin.UnknownNameError, match="joint_2"):
        batch.nearest({"joint2": 0.6})
    with pytest.raises(IndexError):
        batch[15]


def test_a_continuous_joint_is_near_the_short_way_round():
    robot = random_tree(np.random.default_rng(4), 5)
    turning = next(joint for joint in robot.joints if joint.unbounded)
    values = np.linspace(-3.0, 3.0, 7)
    batch = fflin.sweep(robot, fflin.grid(robot, {turning.name: values}))
    lin = batch.nearest({turning.name: 3.4 + 2 * math.pi})
    assert turning.value(lin.q) == pytest.approx(-3.0)
    assert len(batch.select({turning.name: 2.0 + 4 * math.pi})) == 1


@pytest.mark.compiled
def test_random_configurations_keep_the_limits_and_do_not_depend_on_how_they_are_read(
    robots,
):
    robot = robots["servicer_7dof"]
    drawn = fflin.random_configurations(
        robot, 9000, seed=7, ranges={"joint_3": (0.1, 0.2)}
    )
    q = drawn.rows(0, 9000)
    assert np.array_equal(np.vstack([drawn.rows(0, 100), drawn.rows(100, 9000)]), q)
    batch = fflin.sweep(robot, drawn, chunk=512)
    assert np.array_equal(batch.q, q)
    lower, upper = robot.model.lowerPositionLimit, robot.model.upperPositionLimit
    for index, joint in enumerate(robot.joints):
        at = batch.joint_positions[:, index]
        if joint.name == "joint_3":
            assert at.min() >= 0.1 and at.max() <= 0.2
        elif not joint.unbounded:
            low, high = max(lower[joint.idx_q], -7), min(upper[joint.idx_q], 7)
            assert (
                at.min() >= low
                and at.max() <= high
                and np.ptp(at) > 0.95 * (high - low)
            )
    assert not np.array_equal(
        fflin.random_configurations(robot, 9, seed=8).rows(0, 9), q[:9]
    )


@pytest.mark.parametrize(
    "limits, drawn_from",
    [
        ((7.0, 9.0), (7.0, 9.0)),
        ((-7.0, 5.0), (-7.0, 5.0)),
        ((-2.0 * np.pi, 2.0 * np.pi), (-np.pi, np.pi)),
        ((1.0, 100.0), (1.0, 1.0 + 2.0 * np.pi)),
        ((-100.0, -1.0), (-1.0 - 2.0 * np.pi, -1.0)),
    ],
)
def test_angles_are_drawn_within_the_limits_also_far_from_zero(
    limits, drawn_from, robots
):
    robot = robots["servicer_7dof"]
    model, at = robot.model.copy(), robot.joint("joint_1").idx_q
    model.lowerPositionLimit[at], model.upperPositionLimit[at] = limits
    drawn = fflin.random_configurations(fflin.from_model(model), 2000, seed=1)
    q, (low, high) = drawn.rows(0, 2000)[:, at], drawn_from
    assert low <= q.min() < low + 0.02 * (high - low)
    assert high - 0.02 * (high - low) < q.max() <= high


def test_mimic_joints_follow_on_a_grid():
    robot = fflin.load("panda")
    batch = fflin.sweep(
        robot, fflin.grid(robot, {"panda_finger_joint1": [0.0, 0.01, 0.04]})
    )
    for lin in batch:
        assert_same(lin, fflin.linearize(robot, lin.q), 1e-11)
    assert batch.joint_positions[:, -1] == pytest.approx([0.0, 0.01, 0.04])


def test_mimic_joints_follow_with_their_offset(tmp_path):
    body = (
        '<inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        "</inertial>"
    )
    links = "".join(f'<link name="l{i}">{body}</link>' for i in range(3))
    joint = (
        '<joint name="j{0}" type="{1}"><parent link="l{2}"/><child link="l{0}"/>'
        '<origin xyz="0 0 1"/><axis xyz="1 0 0"/>{3}<limit effort="9" velocity="9" lower="-3" '
        'upper="3"/></joint>'
    )
    mimic = '<mimic joint="j1" multiplier="-2" offset="0.3"/>'
    joints = joint.format(1, "revolute", 0, "") + joint.format(2, "revolute", 1, mimic)
    path = tmp_path / "mimic.urdf"
    path.write_text(f'<robot name="mimic">{links}{joints}</robot>')
    robot = fflin.load(path)
    values = [-0.5, 0.1, 0.7]
    rows = fflin.grid(robot, {"j1": values}).rows(0, 3)
    assert rows[:, 8] == pytest.approx([1.3, 0.1, -1.1])
    for row, value in zip(rows, values, strict=True):
        assert row == pytest.approx(fflin.configuration(robot, {"j1": value}))


def damaged(robot, row, column, value):
    q = np.tile(robot.neutral(), (40, 1))
    q[row, column] = value
    return q


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda r: {"q": damaged(r, 31, 9, np.nan)}, r"31.*q\[9\]"),
        (lambda r: {"q": damaged(r, 31, 6, 0.9)}, "31.*quaternion"),
        (lambda r: {"q": np.empty((0, r.nq))}, "rows"),
        (lambda r: {"q": r.neutral()}, r"\(16,\)"),
        (lambda r: {"q": [["a"]]}, "real"),
        (lambda r: {"q": damaged(r, 0, 7, 0.0), "v": np.zeros((3, r.nv))}, r"\(3, 15"),
        (
            lambda r: {"q": damaged(r, 0, 7, 0.0), "u": np.full((40, 15), np.inf)},
            r"row 0: u\[0\]",
        ),
        (lambda r: {"q": damaged(r, 0, 7, 0.0), "workers": 0}, "workers"),
        (lambda r: {"q": damaged(r, 0, 7, 0.0), "executor": 3}, "executor"),
        (lambda r: {"q": fflin.grid(fflin.load("cubesat"), {})}, "axes"),
        (lambda r: {"q": fflin.grid(r, {"joint_1": []})}, "joint_1'"),
        (lambda r: {"q": fflin.grid(r, {"joint_1": [1.0, 0.0]})}, "increase"),
        (lambda r: {"q": fflin.random_configurations(r, 0)}, "count"),
        (
            lambda r: {"q": fflin.grid(fflin.load("ur5"), {"elbow_joint": [1.0]})},
            "'ur5'",
        ),
        (
            lambda r: {
                "q": fflin.grid(r, {f"joint_{i}": range(10**4) for i in range(1, 7)})
            },
            "1,000,000,000,000,000,000,000,000",
        ),
        (lambda r: {"q": fflin.random_configurations(r, 10**20)}, "9,223"),
        (lambda r: {"q": fflin.random_configurations("ur5", 3)}, r"robot\b.*\bstr\b"),
        (lambda r: {"q": fflin.random_configurations(r, 3, ranges=[0, 1])}, "ranges"),
        (lambda r: {"q": fflin.random_configurations(r, 3), "progress": 3}, "progress"),
        (lambda r: {"q": fflin.random_configurations(r, 3), "workers": True}, "True"),
    ],
)
def test_invalid_input_is_one_line_that_names_the_row(make, message, robots, tmp_path):
    robot = robots["servicer_7dof"]
    with pytest.raises(fflin.InputError, match=message):
        fflin.sweep(robot, **make(robot), out=tmp_path / "x.npz")
    assert not list(tmp_path.iterdir())


def test_a_result_that_exceeds_the_memory_is_refused_before_the_computation(
    robots, tmp_path
):
    robot = robots["servicer_7dof"]
    many = fflin.random_configurations(robot, 10**15)
    for out in (None, tmp_path / "x.npz"):
        with pytest.raises(
            fflin.InputError, match=r"1,000,000,000,000,000 rows.*memory"
        ):
            fflin.sweep(robot, many, out=out)
    pytest.importorskip("h5py")
    with pytest.raises(fflin.FileError, match=r"x\.h5\.part"):
        fflin.sweep(robot, many, out=tmp_path / "x.h5")
    assert not list(tmp_path.iterdir())


@pytest.mark.compiled
@pytest.mark.parametrize("parallel", [False, True])
def test_a_singular_configuration_fails_its_chunk_and_the_rest_is_kept(parallel):
    robot = singular_at(0.5)
    configurations = fflin.grid(robot, {"slide": np.arange(64) / 64.0})
    with ThreadPoolExecutor(2) as pool, pytest.raises(fflin.SweepError) as caught:
        fflin.sweep(
            robot, configurations, chunk=10, executor=pool if parallel else None
        )
    error = caught.value
    assert says(str(error), "30 to 39", "32", "'singular'")
    assert [failure[:2] for failure in error.failed] == [(30, 40)]
    assert len(error.batch) == 54
    kept = [*range(30), *range(40, 64)]
    for index in (0, 29, 30, 53):
        q = configurations.rows(kept[index], kept[index] + 1)[0]
        assert_same(error.batch[index], fflin.linearize(robot, q), 1e-11)


@pytest.mark.compiled
def test_ill_conditioned_points_are_reported_once():
    model = fflin.load("ets_vii").model.copy()
    model.jointPlacements[4] = pin.SE3(np.eye(3), np.array([1e5, 0.0, 0.0]))
    robot = fflin.from_model(model, name="far")
    near = fflin.grid(robot, {"joint_5": np.linspace(0.0, 1.0, 19)})
    with pytest.warns(fflin.FflinWarning) as caught:
        fflin.sweep(robot, near)
    assert len(caught) == 1 and "18 more" in str(caught[0].message)


@pytest.mark.compiled
def test_progress_is_reported(robots):
    messages = []
    q = np.tile(robots["cubesat"].neutral(), (25, 1))
    fflin.sweep(
        robots["cubesat"], q, chunk=10, progress=lambda *counts: messages.append(counts)
    )
    assert messages == [(10, 25), (20, 25), (25, 25)]


def test_nothing_of_the_callers_is_changed_or_kept(robots):
    robot = robots["ets_vii"]
    q, _, _ = points(robot, 3)
    given = q.copy()
    batch = fflin.sweep(robot, given)
    assert np.array_equal(given, q) and given.flags.writeable
    given[:] = 0.0
    assert np.array_equal(batch.q, q)
    for array in (batch.A, batch.B_lower, batch.q, batch.x0):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_masked_values_are_refused_on_a_grid_and_as_an_index():
    robot = fflin.load("planar_detumble")
    values = np.ma.masked_array([-0.5, 0.0, 0.5], mask=[False, True, False])
    with pytest.raises(fflin.InputError, match="masked"):
        fflin.grid(robot, {"joint_1": values})
    batch = fflin.sweep(robot, [robot.neutral()] * 2)
    with pytest.raises(fflin.InputError, match="masked"):
        batch[np.ma.masked_array([0, 1], mask=[False, True])]
