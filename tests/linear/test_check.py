"""`check` must be able to fail: an error planted in any block is found, by both routes.

Errors of random robots are in test_check_random.py.
"""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.linear import aba_route
from fflin.linear.aba_route import Route, _whole
from fflin.linear.check import References
from tests.support.random_robots import random_case
from tests.support.robots import mostly, random_point, random_pose

GROUPS = ("q_b", "r_b", "q_m", "omega_b", "v_b", "qdot_m")
INPUTS = {"tau_b": slice(0, 3), "F_b": slice(3, 6), "tau_m": slice(6, None)}


@pytest.fixture(scope="module", params=mostly(["hybrid", "local", "world"], "hybrid"))
def moving(request):
    robot = fflin.load("servicer_7dof")
    point = random_point(robot, np.random.default_rng(1), degrees=50.0)
    lin = fflin.linearize(
        robot, *point, frame=request.param, reference=pin.SE3.Identity()
    )
    return robot, lin, fflin.StateMap(robot, frame=request.param).groups._asdict()


def planted(lin, matrix, rows, columns):
    """The model with one entry of a block off by 1e-5 of the largest of its rows, or by 1e-5."""
    array = getattr(lin, matrix).copy()
    block = array[rows, columns]
    at = np.unravel_index(np.abs(block).argmax(), block.shape)
    size = np.abs(array[rows]).max() if block.any() else 1.0
    if block[at]:
        size = abs(block[at])
    block[at] += 1e-5 * size
    return replace(lin, **{matrix: array})


@pytest.mark.parametrize("column", (*GROUPS, *INPUTS))
@pytest.mark.parametrize("row", GROUPS)
def test_planted_error_is_detected_in_its_block(moving, row, column):
    robot, lin, groups = moving
    matrix = "A" if column in GROUPS else "B"
    columns = groups[column] if column in GROUPS else INPUTS[column]
    result = fflin.check(robot, planted(lin, matrix, groups[row], columns))
    block = f"{matrix}[{row}, {column}]"
    tests = {row.test for row in result.failures if row.block == block}
    assert {"ABA derivatives", "differences"} <= tests
    # Where B's block is wrong so is M^-1; no other block of A or B is accused.
    others = {
        r.block for r in result.failures if r.test in ("ABA derivatives", "differences")
    }
    assert others == {block}
    assert not result.ok
    assert f"{block} (" in str(result) and "FAILED" in str(result)


@pytest.mark.parametrize("matrix", ["A", "B"])
def test_flipped_sign_of_any_nonzero_block_is_detected(moving, matrix):
    robot, lin, groups = moving
    columns = groups if matrix == "A" else INPUTS
    flipped = 0
    for row in GROUPS:
        for column in columns:
            array = getattr(lin, matrix).copy()
            array[groups[row], columns[column]] *= -1.0
            if (array == getattr(lin, matrix)).all():
                continue
            result = fflin.check(robot, replace(lin, **{matrix: array}))
            assert f"{matrix}[{row}, {column}]" in {
                failure.block for failure in result.failures
            }
            flipped += 1
    assert flipped >= (10 if matrix == "A" else 9)


def test_wrong_point_is_detected():
    robot = fflin.load("ets_vii")
    lin = fflin.linearize(robot, *random_point(robot, np.random.default_rng(2)))
    for name in ("x0", "f0"):
        vector = getattr(lin, name).copy()
        vector[7] += 1e-6
        result = fflin.check(robot, replace(lin, **{name: vector}))
        assert {"x0": "x0", "f0": "f0[q_m]"}[name] in {
            row.block for row in result.failures
        }


def test_model_of_another_inertia_is_detected():
    """The matrices of one robot do not pass as those of another with the same joints."""
    robot = fflin.load("ets_vii")
    model = robot.model.copy()
    model.inertias[3] = model.inertias[3] + pin.Inertia(
        0.01, np.zeros(3), np.eye(3) * 1e-3
    )
    heavier = fflin.from_model(model, name="ets_vii")
    assert not fflin.check(heavier, fflin.linearize(robot)).ok


def test_own_m_of_a_model_does_not_loosen_the_check():
    robot = fflin.load("servicer_7dof")
    lin = fflin.linearize(robot)
    noise = np.random.default_rng(3).normal(size=(15, 15))
    nearly_singular = np.ones((15, 15)) + 1e-15 * noise @ noise.T
    wrong = replace(
        lin, A=1.5 * lin.A, B=1.3 * lin.B, _inertia=lambda _: nearly_singular
    )
    result = fflin.check(robot, wrong)
    assert {"M", "B[omega_b, tau_b]", "A[q_b, omega_b]"} <= {
        row.block for row in result.failures
    }
    assert max(row.tolerance for row in result.rows) < 1e-7


def test_check_keeps_its_edge_at_orbital_speed():
    robot = fflin.load("servicer_7dof")
    q, v, u = random_point(robot, np.random.default_rng(4))
    v[:3] = 7.6e3, -200.0, 30.0
    for frame in ("hybrid", "local", "world"):
        lin = fflin.linearize(
            robot, q, v, 0.05 * u, frame=frame, reference=pin.SE3.Identity()
        )
        assert fflin.check(robot, lin).ok
        groups = fflin.StateMap(robot).groups
        A = lin.A.copy()
        A[groups.omega_b, groups.q_m] *= 1.0 + 1e-4
        result = fflin.check(robot, replace(lin, A=A))
        assert "A[omega_b, q_m]" in {row.block for row in result.failures}


def test_differences_by_the_velocity_of_the_base_are_exact_at_orbital_speed():
    # The rate of the position is a rotation of v_b, so only rounding errors are left: a few EPS of
    # the speed, divided by a step that is a tenth of the speed.
    robot = fflin.load("servicer_7dof")
    q, v, _ = random_point(robot, np.random.default_rng(4))
    v[:3] = 7.6e3, -200.0, 30.0
    lin = fflin.linearize(robot, q, v, frame="local", reference=pin.SE3.Identity())
    (row,) = [
        row
        for row in fflin.check(robot, lin).rows
        if (row.test, row.block) == ("differences", "A[r_b, v_b]")
    ]
    assert row.error < 1e2 * np.finfo(float).eps


def test_the_rounding_of_an_output_is_divided_by_the_step_of_each_state_it_depends_on():
    robot = fflin.load(
        "servicer_7dof", outputs=[fflin.Gyroscope("base"), fflin.JointVelocities()]
    )
    point = random_point(robot, np.random.default_rng(1), degrees=50.0)
    lin = fflin.linearize(robot, *point)
    outputs = References(robot, lin)._outputs
    steps = np.full(len(lin.x0), 0.1)
    C, rounding, _ = outputs._kinematics(steps)
    least = np.finfo(float).eps * np.abs(lin.y0)[:, None] / steps
    depends = np.abs(lin.C) > 1e-9
    assert depends.any() and (np.abs(C - lin.C) <= rounding)[depends].all()
    assert (rounding >= least)[depends].all()


def test_all_entries_of_a_base_block_have_the_magnitude_of_its_largest_entry():
    # The rounding error of a rotation matrix is relative to 1, not to its entry.
    nv = 8
    x = np.random.default_rng(3).normal(size=(2 * nv, 2 * nv))
    sizes = _whole(x, nv)
    expected = np.abs(x)
    for rows in np.split(np.r_[:6, nv : nv + 6], 4):
        for columns in np.split(np.r_[:6, nv : nv + 6], 4):
            block = np.ix_(rows, columns)
            expected[block] = expected[block].max()
    assert (sizes == expected).all()


def test_rounding_is_sampled_at_points_that_differ_in_every_coordinate(monkeypatch):
    monkeypatch.setattr(aba_route, "_NUDGE", 1e-3)
    robot = fflin.load("servicer_7dof")
    q, v, u = random_point(robot, np.random.default_rng(1), degrees=50.0)
    route = Route(robot, fflin.linearize(robot, q, v, u))
    other_q, other_v, other_u = route._nudged(np.random.default_rng(2))
    apart = pin.difference(robot.model, q, other_q)
    assert np.abs(apart) == pytest.approx(1e-3, rel=1e-6)
    assert np.abs(other_v / v - 1.0) == pytest.approx(1e-3, rel=1e-6)
    assert np.abs(other_u / route._u - 1.0) == pytest.approx(1e-3, rel=1e-6)


def test_far_joints_are_confirmed_as_far_as_m_is():
    model = fflin.load("dual_arm").model.copy()
    model.jointPlacements[4] = pin.SE3(np.eye(3), np.array([3e3, 0.0, 0.0]))
    robot = fflin.from_model(model)
    assert fflin.check(robot, fflin.linearize(robot)).ok


@pytest.mark.parametrize(("fraction", "ok"), [(0.7, True), (1.4, False)])
def test_the_error_allowed_in_m_inverse_is_100_rounding_errors_times_the_condition(
    fraction, ok
):
    """An inverse with the relative error e has the residual M M^-1 - I = e I.

    The error of the inverse before is below 2 % of the allowed one.
    """
    model = fflin.load("dual_arm").model.copy()
    model.jointPlacements[4] = pin.SE3(np.eye(3), np.array([3e3, 0.0, 0.0]))
    robot = fflin.from_model(model)
    lin = fflin.linearize(robot)
    allowed = 100.0 * np.finfo(float).eps * lin.certificate.condition
    assert 1e-9 < allowed < 1e-2
    assert lin.certificate.inertia_residual < 0.02 * allowed
    B = lin.B * (1.0 + fraction * allowed)
    rows = fflin.check(robot, replace(lin, B=B)).rows
    (row,) = [row for row in rows if row.block == "M M^-1 = I"]
    assert row.error == pytest.approx(fraction * allowed, rel=0.05)
    assert row.ok is ok


def test_not_a_number_is_not_ok():
    robot = fflin.load("cubesat")
    lin = fflin.linearize(robot)
    A = lin.A.copy()
    A[0, 6] = np.nan
    assert not fflin.check(robot, replace(lin, A=A)).ok


def test_an_unsupported_model_is_refused_by_check():
    robot = fflin.load("cubesat")
    lin = fflin.linearize(robot)
    with pytest.raises(fflin.InputError, match=r"0\.1"):
        fflin.check(robot, lin.discretize(0.1))
    with pytest.raises(fflin.InputError, match=r"'cubesat'.*'ets_vii'"):
        fflin.check(fflin.load("ets_vii"), lin)


def test_report_fits_80_columns():
    robot = fflin.load("tiago_dual")
    text = str(fflin.check(robot, fflin.linearize(robot)))
    assert max(map(len, text.splitlines())) <= 80
    assert (
        text.startswith("A and B of tiago_dual: verified, largest error")
        and "123 comparisons" in text
    )


def test_rounding_of_a_large_acceleration_is_not_a_failure():
    # Where an accelerometer sits at the pushed origin, its slopes vanish and only rounding is left.
    robot = fflin.load("cubesat")
    push = fflin.Thruster("base", (0.3, -1.1, 0.4), (1.0, 0.2, -0.5))
    robot = robot.replace(inputs=[push], outputs=[fflin.Accelerometer("base")])
    v = fflin.velocity(robot, {"omega_b.x": 1.3, "omega_b.y": -0.7, "v_b.z": 0.4})
    for thrust in (1.0, 3.3, 7.1):
        assert fflin.check(
            robot, fflin.linearize(robot, v=v, u=[thrust], moving=True)
        ).ok


@pytest.mark.parametrize("speed", [1e-6, 1e-9, 1e-12, 1e-15])
@pytest.mark.parametrize(
    "name", ["planar_detumble", "canadarm2", "dual_arm", "inspector"]
)
def test_a_motion_that_is_almost_at_rest_is_confirmed(name, speed):
    robot = fflin.load(name)
    v = speed * np.random.default_rng(0).standard_normal(robot.nv)
    lin = fflin.Linearizer(robot, moving=True)(robot.neutral(), v)
    assert fflin.check(robot, lin).ok
    # What is wrong by more than the rounding of a step is still found.
    A = lin.A.copy()
    rows, columns = slice(-6 - robot.n, -3 - robot.n), slice(-3 - robot.n, -robot.n)
    A[rows, columns] += 1e-9 * np.abs(lin.B[rows]).max()
    assert not fflin.check(robot, replace(lin, A=A)).ok


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("turn", [np.pi, -np.pi])
def test_a_continuous_joint_may_pass_half_a_turn(turn, moving):
    """Differences reach over the seam of the angle, on the turn of the point."""
    robot = fflin.load("ets_vii")
    rng = np.random.default_rng(5)
    groups = fflin.StateMap(robot).groups
    for distance in (0.0, 1e-9, 1e-4, 1e-2):
        joints = {joint: turn - np.sign(turn) * distance for joint in robot.joint_names}
        q = fflin.configuration(robot, joints, random_pose(rng, 70.0))
        v, u = rng.normal(size=robot.nv), rng.normal(size=robot.nv)
        lin = fflin.linearize(robot, q, v, u, moving=moving)
        assert fflin.check(robot, lin).ok
        A = lin.A.copy()
        A[groups.q_m, groups.qdot_m] *= -1.0
        result = fflin.check(robot, replace(lin, A=A))
        assert "A[q_m, qdot_m]" in {row.block for row in result.failures}


def test_a_tolerance_takes_the_place_of_every_figures_own():
    """As of a tool whose A and B are differences themselves."""
    robot = fflin.load("servicer_7dof")
    lin = fflin.linearize(
        robot, *random_point(robot, np.random.default_rng(3), degrees=30.0)
    )
    noise = 1e-7 * np.random.default_rng(4).uniform(-1.0, 1.0, lin.A.shape)
    near = replace(lin, A=lin.A * (1.0 + noise))
    default, loose = fflin.check(robot, near), fflin.check(robot, near, tolerance=1e-6)
    assert not default.ok and loose.ok and loose.max_error == default.max_error
    assert {row.tolerance for row in loose.rows} == {1e-6}
    assert "at most 1.0e-06" in loose.title
    assert not fflin.check(
        robot, planted(lin, "A", slice(6, 9), slice(9, 12)), tolerance=1e-6
    ).ok
    assert not fflin.check(robot, lin, tolerance=1e-20).ok
    for wrong in (0.0, -1e-6, 1.0, np.nan, np.inf, "much", True):
        with pytest.raises(fflin.InputError, match="tolerance"):
            fflin.check(robot, lin, tolerance=wrong)


def test_a_weak_mode_is_verified():
    """A unit amplitude of the second mode turns its body by 1,170 rad, so its step is small."""
    array = fflin.FlexibleAppendage(
        "panel_left_1",
        [0.25, 1.1],
        [[0, 0], [0, 0], [2.71, 5e-4]],
        [[4.27, 0], [0, 8.55e-4], [0, 0]],
    )
    robot = fflin.load("inspector", lock=["hinge_*"], appendages=[array])
    assert fflin.check(robot, fflin.linearize(robot)).ok


def test_the_momentum_of_a_weak_mode_is_not_lost_in_the_momentum_of_the_robot():
    """A unit amplitude of the mode moves the centre of mass of 350 kg by 3e-9 m."""
    array = fflin.FlexibleAppendage(
        "panel_left_1", 0.3, [[0], [0], [1e-6]], [[1e-6], [0], [0]]
    )
    robot = fflin.load("inspector", lock=["hinge_*"], appendages=[array])
    robot = robot.replace(outputs=[fflin.CenterOfMass(), fflin.Momentum()])
    q, v, _ = random_point(robot, np.random.default_rng(7), degrees=20.0)
    mode = robot.joint("panel_left_1_mode_1")
    mode.place(q, 0.2 / mode.scale)
    v[mode.idx_v] = 0.3
    lin = fflin.linearize(robot, q, v)
    assert fflin.check(robot, lin).ok
    # The scale of a row of C is the displacement or momentum for a unit of energy.
    mobility = np.sqrt(np.linalg.inv(lin.M).diagonal())
    column = lin.state_names.index(f"q_m.{mode.name}")
    for row in (1, 4, 7):
        C = lin.C.copy()
        C[row, column] += 1e-6 * np.abs(C[row, : len(mobility)] * mobility).max()
        assert not fflin.check(robot, replace(lin, C=C)).ok


def falling(frame="base"):
    gravity = (0.0, 0.0, -9.81)
    return fflin.load(
        "servicer_7dof", gravity=gravity, outputs=[fflin.Accelerometer(frame)]
    )


@pytest.mark.parametrize("frame", ["base", "tool"])
def test_an_accelerometer_in_free_fall_is_verified(frame):
    robot = falling(frame)
    lin = fflin.linearize(robot)
    result = fflin.check(robot, lin)
    assert result.ok
    assert str(result).startswith(
        "A, B, C and D of servicer_7dof: verified, largest error"
    )
    # An error of 1e-8 of gravity, which cancels in C, is found.
    C = lin.C.copy()
    C[1, 0] += 1e-8 * 9.81
    assert not fflin.check(robot, replace(lin, C=C)).ok


def test_the_headline_names_the_block_that_failed():
    robot = falling()
    lin = fflin.linearize(robot)
    C, A = lin.C.copy(), lin.A.copy()
    C[1, 0] += 1e-3
    A[13, 7] += 1e-3
    result = fflin.check(robot, replace(lin, C=C))
    assert str(result).startswith(
        "C (accelerometer) is not verified: 1 of 123 comparisons FAILED"
    )
    result = fflin.check(robot, replace(lin, A=A, C=C))
    first = " ".join(str(result).split("\n\n")[0].split())
    assert first == (
        "A[r_b, q_m] (ABA derivatives, differences), C (accelerometer) are not verified: "
        "3 of 123 comparisons FAILED"
    ).replace("r_b, q_m", "q_m, q_m")


def scaled(robot, length, mass):
    """The same robot in other units of length and mass; its joints must be revolute."""
    model = robot.model.copy()
    for k, body in enumerate(model.inertias.tolist()):
        model.inertias[k] = pin.Inertia(
            mass * body.mass, length * body.lever, mass * length**2 * body.inertia
        )
        place = model.jointPlacements[k]
        model.jointPlacements[k] = pin.SE3(place.rotation, length * place.translation)
    return fflin.from_model(model, name="scaled")


def test_errors_do_not_depend_on_units():
    """An error of 1 % of an entry has the same size in m and kg as in mm and t."""
    robot = fflin.load("servicer_7dof")
    q, v, _ = random_point(robot, np.random.default_rng(5), degrees=40.0)
    errors = []
    for length, mass in ((1.0, 1.0), (1e3, 1e-3), (1e-2, 30.0)):
        other = scaled(robot, length, mass)
        at_q, at_v = q.copy(), v.copy()
        at_q[:3] *= length
        at_v[:3] *= length
        lin = fflin.linearize(other, at_q, at_v)
        A, B = lin.A.copy(), lin.B.copy()
        A[lin.A.shape[0] // 2 :] *= 1.01
        B *= 1.01
        result = fflin.check(other, replace(lin, A=A, B=B))
        errors.append(
            {r.block: r.error for r in result.rows if r.test == "ABA derivatives"}
        )
    planted = [block for block, error in errors[0].items() if error > 1e-6]
    assert len(planted) > 12
    for other in errors[1:]:
        for block in planted:
            assert other[block] == pytest.approx(errors[0][block], rel=1e-6), block


def test_a_larger_error_does_not_loosen_the_check():
    """The scales come from the independent computations alone."""
    robot = fflin.load("ets_vii")
    lin = fflin.linearize(robot, *random_point(robot, np.random.default_rng(6)))
    errors = []
    for factor in (1e-3, 1e9):
        A, B = lin.A.copy(), lin.B.copy()
        A[-1, -1] += factor
        B[-1, -1] += factor
        rows = fflin.check(robot, replace(lin, A=A, B=B)).rows
        blocks = "A[qdot_m, qdot_m]", "B[qdot_m, tau_m]"
        errors.append([row.error for row in rows if row.block in blocks])
    assert np.array(errors[1]) == pytest.approx(1e12 * np.array(errors[0]), rel=1e-6)


def test_a_robot_far_from_the_origin_is_verified():
    robot = fflin.load("dual_arm")
    q, v, u = random_point(robot, np.random.default_rng(8))
    q[:3] = 4e6, -2e6, 5e6
    lin = fflin.linearize(robot, q, v, u, reference=pin.SE3(np.eye(3), q[:3].copy()))
    assert fflin.check(robot, lin).ok


@pytest.mark.parametrize("seed", [42, 135, 293])
def test_aba_of_light_links_with_mimic_joints_is_accurate(seed):
    """The inertias differ by up to 1e10. Without scaling, the inverse would lose three digits."""
    case = random_case(seed)
    assert case.robot.followers
    lin = case.linearize()
    route = Route(case.robot, lin)
    rows = slice(len(route.M), None)
    units = np.outer(route.mobility, route.input_mobility)
    assert np.abs((route.B.value - lin.B)[rows] / units).max() < 1e-13


def test_a_velocity_that_is_zero_but_for_rounding_is_not_a_scale():
    robot = fflin.load("servicer_7dof")
    tug = robot.replace(
        stiffness={"panel_left": 100.0, "panel_right": 100.0}, damping=0.5
    )
    q = fflin.configuration(tug, {"joint_2": 0.4, "joint_4": -1.1})
    v = fflin.velocity(tug, {"joint_1": 0.1, "omega_b.z": 0.02})
    lin = fflin.linearize(tug, q, v, fflin.effort(tug, {"tau_m.joint_1": 2.0}))
    assert fflin.check(tug, lin).ok
