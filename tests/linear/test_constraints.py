"""Linear models of robots with constraints: closed forms, independent computations, refusals."""

import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.aba import Aba
from fflin.dynamics.classical import Conditioning
from fflin.linear.constrained_check import ConstrainedReferences
from fflin.linear.files import given
from fflin.linear.nonlinear import TRUNCATION, jacobians
from tests.support.constrained import (
    Build,
    at,
    parallelogram,
    pendulum,
    random_constraints,
    strut,
)
from tests.support.marks import exhaustive
from tests.support.robots import FRAMES, LINKS, MIMIC, random_pose

INERTIA = np.array((0.2, 0.3, 0.4))


def frequencies(lin):
    """Angular frequencies of the oscillations, sorted, without those that are zero."""
    size = np.sort(np.abs(np.linalg.eigvals(lin.A).imag))
    return size[size > 1e-6][::2]


@pytest.mark.parametrize("frame", FRAMES)
def test_a_body_on_a_point_is_a_spherical_pendulum_in_every_frame(frame):
    """Also if the reference is turned by 50 deg, so that q_b is not zero."""
    mass, length = 3.0, 0.7
    robot = pendulum(mass, INERTIA, length)
    expected = np.sqrt(mass * 9.81 * length / (INERTIA[:2] + mass * length**2))
    fflin.closed(robot, robot.neutral())
    reference = random_pose(np.random.default_rng(1), 50.0)
    for lin in (
        fflin.linearize(robot, frame=frame),
        fflin.linearize(robot, frame=frame, reference=reference),
        fflin.linearize(robot, frame=frame, reference=reference, independent=["q_b"]),
    ):
        assert lin.rank == 3
        np.testing.assert_allclose(frequencies(lin), np.sort(expected), rtol=1e-9)


def test_attitudes_as_independent_coordinates_give_the_pendulum_directly():
    mass, length = 3.0, 0.7
    lin = fflin.linearize(pendulum(mass, INERTIA, length), independent=["q_b"])
    assert lin.state_names[:3] == ("q_b.x", "q_b.y", "q_b.z")
    assert lin.state_names[3:] == ("omega_b.x", "omega_b.y", "omega_b.z")
    assert lin.dependent[:3] == ("r_b.x", "r_b.y", "r_b.z")
    about_point = INERTIA + mass * length**2 * np.array((1.0, 1.0, 0.0))
    weight = mass * 9.81 * length * np.array((1.0, 1.0, 0.0))
    A = np.zeros((6, 6))
    A[:3, 3:] = 0.5 * np.eye(3)
    A[3:, :3] = -2.0 * np.diag(weight / about_point)
    np.testing.assert_allclose(lin.A, A, atol=1e-9)
    np.testing.assert_allclose(lin.M, np.diag(about_point), atol=1e-9)
    # a force on the base acts with the lever of the point
    np.testing.assert_allclose(lin.B[4, 3], -length / about_point[1], atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 0.4, -1.1])
def test_a_parallelogram_of_four_bars_swings_as_a_pendulum(angle):
    """Bars of masses m and M at length L: I = 2 m L^2/3 + M L^2, weight (m + M) g L sin(angle)."""
    crank, bar, length = 0.6, 1.5, 0.8
    robot = parallelogram(crank, bar, length, 1.1)
    guess = {"left": angle, "bar": -angle, "right": angle}
    q = fflin.closed(robot, fflin.configuration(robot, guess))
    inertia = 2.0 * crank * length**2 / 3.0 + bar * length**2
    weight = (crank + bar) * 9.81 * length
    u = fflin.effort(robot, {"left": weight * np.sin(angle)})
    lin = fflin.linearize(robot, q, u=u, independent=["left"])
    assert lin.rank == 8
    assert lin.state_names == ("q_m.left", "qdot_m.left")
    assert lin.is_equilibrium(1e-9)
    expected = -weight * np.cos(angle) / inertia
    np.testing.assert_allclose(lin.A, [[0.0, 1.0], [expected, 0.0]], atol=1e-9)
    torques = [
        lin.input_names.index(f"tau_m.{name}") for name in ("left", "bar", "right")
    ]
    # the bar does not turn: its torque acts on the crank alone, in the opposite direction
    np.testing.assert_allclose(
        lin.B[1, torques], np.array((1.0, -1.0, 1.0)) / inertia, atol=1e-9
    )


def test_a_flat_parallelogram_is_a_singular_posture():
    robot = parallelogram(0.6, 1.5, 0.8, 1.1)
    guess = {"left": np.pi / 2, "bar": -np.pi / 2, "right": np.pi / 2}
    q = fflin.configuration(robot, guess)
    with pytest.raises(fflin.ConstraintError, match="singular posture"):
        fflin.linearize(robot, q)


@pytest.mark.parametrize("ratio", [0.0, 0.5, 0.999, 1.001])
def test_a_strut_buckles_at_its_critical_load(ratio):
    mass, length, stiffness = 1.2, 0.9, 40.0
    robot = strut(mass, length, stiffness)
    critical = 2.0 * stiffness / length
    load = ratio * critical
    u = fflin.effort(robot, {"slide": load})
    lin = fflin.linearize(robot, u=u, independent=["knee"])
    inertia = 2.0 * mass * length**2 / 3.0
    expected = -2.0 * (2.0 * stiffness - load * length) / inertia
    scale = 4.0 * stiffness / inertia
    np.testing.assert_allclose(lin.A[1, 0] / scale, expected / scale, atol=1e-9)
    assert (np.linalg.eigvals(lin.A).real.max() > 1e-3) == (ratio > 1.0)


def test_two_points_on_the_axis_are_a_hinge():
    """Two points have 6 rows of rank 5, so one of their forces is not determinate."""
    rng = np.random.default_rng(2)
    robot, q, v, u = random_constraints(rng, count=0)
    model = robot.model.copy()
    joint = model.getJointId("joint_8")
    kind = pin.FrameType.OP_FRAME
    parent = model.getFrameId("joint_8")
    model.addFrame(pin.Frame("first", joint, parent, at(), kind))
    model.addFrame(pin.Frame("second", joint, parent, at(0.3, 0.1, -0.4), kind))
    robot = fflin.from_model(model, gravity=(1.0, 2.0, 3.0), stiffness=2.0)
    hinge = robot.replace(constraints=[fflin.Hinge("first", axis=(0.3, 0.1, -0.4))])
    points = robot.replace(
        constraints=[fflin.Spherical("first"), fflin.Spherical("second")]
    )
    q, v = fflin.closed(hinge, q, v)
    fflin.closed(points, q)
    one, two = (fflin.linearize(robot, q, v, u) for robot in (hinge, points))
    assert one.state_names == two.state_names
    assert one.rank == two.rank == 5
    for key in ("A", "B", "f0", "M"):
        size = np.abs(getattr(one, key)).max()
        np.testing.assert_allclose(
            getattr(two, key), getattr(one, key), atol=1e-12 * size
        )
    forces = points.replace(outputs=[fflin.ConstraintForce("first")])
    with pytest.raises(
        fflin.ConstraintError, match=r"first\.force\.x.* not determinate"
    ):
        fflin.linearize(forces, q, v, u)


def dual_arm_around_payload():
    robot = fflin.load("dual_arm", gravity=(0.3, -0.2, 0.5))
    payload = pin.Inertia(60.0, np.array((0.1, 0.0, 0.05)), np.diag((6.0, 8.0, 9.0)))
    rng = np.random.default_rng(4)
    joints = {name: rng.uniform(-0.8, 0.8) for name in robot.joint_names}
    q = fflin.configuration(robot, joints, random_pose(rng, 40.0))
    held = fflin.capture(robot, "tool_left", payload, q=q).robot
    held = held.replace(constraints=[fflin.Weld("tool_right", "tool_left")])
    q, v = fflin.closed(held, q, 0.3 * rng.normal(size=held.nv))
    return held, q, v, 5.0 * rng.normal(size=6 + held.n)


@pytest.mark.exhaustive
def test_two_arms_around_a_payload_agree_with_both_computations():
    robot, q, v, u = dual_arm_around_payload()
    lin = fflin.linearize(robot, q, v, u)
    assert lin.rank == 6
    assert len(lin.state_names) == 2 * (6 + robot.n - 6)
    assert all(name in lin.state_names for name in ("q_b.x", "r_b.z", "v_b.y"))
    check = fflin.check(robot, lin)
    assert check.ok, check
    assert check.max_error < 1e-8


@pytest.mark.exhaustive
def test_two_arms_about_a_moving_reference_agree_with_both_computations():
    robot, q, v, u = dual_arm_around_payload()
    moving = fflin.linearize(robot, q, v, u, moving=True)
    assert fflin.check(robot, moving).ok


@pytest.mark.parametrize(
    ("seed", "frame"), exhaustive((0, "hybrid"), (1, "local"), (2, "world"))
)
def test_random_constraints_agree_with_both_computations(seed, frame):
    rng = np.random.default_rng(seed)
    robot, q, v, u = random_constraints(rng, count=1 + seed % 3)
    reference = random_pose(rng, 60.0)
    for options in ({"frame": frame, "reference": reference}, {"moving": True}):
        lin = fflin.linearize(robot, q, v, u, **options)
        check = fflin.check(robot, lin)
        assert check.ok, check


def test_the_check_closes_constraints_without_placement_at_the_point_of_the_model():
    robot = fflin.load("planar_detumble")
    held = [fflin.Spherical("hand")]
    q = fflin.configuration(robot, {"joint_2": 0.4})
    lin = fflin.linearize(robot.replace(constraints=held), q)
    assert fflin.check(robot.replace(constraints=held), lin).ok


@pytest.mark.parametrize("copies", [1, 2], ids=["independent", "redundant"])
def test_springs_at_rest_agree_with_both_computations(copies):
    # At rest, Pinocchio's solver does not iterate.
    held = [fflin.Weld("base", name=f"c{number}") for number in range(copies)]
    robot = fflin.load("planar_detumble", stiffness={"joint_*": 3.0}, constraints=held)
    check = fflin.check(robot, fflin.linearize(robot))
    assert check.ok, check
    route = [x.error for x in check.rows if x.test == "constrained derivatives"]
    assert max(route) < 1e-10


def test_the_check_sees_a_change_of_one_entry():
    """Of the largest entry of each array, by 1e-5 of it."""
    rng = np.random.default_rng(3)
    robot, q, v, u = random_constraints(rng, count=1, joints=4)
    robot = robot.replace(outputs=[fflin.Accelerometer("joint_2")])
    lin = fflin.linearize(robot, q, v, u)
    references = ConstrainedReferences(robot, lin)
    assert all(row.ok for row in references.rows(lin))
    for name in ("A", "B", "C", "D", "f0", "M", "x0", "y0"):
        array = getattr(lin, name).copy()
        index = np.unravel_index(np.abs(array).argmax(), array.shape)
        array[index] += 1e-5 * max(1.0, abs(array[index]))
        changed = {"_inertia": partial(given, array)} if name == "M" else {name: array}
        rows = references.rows(replace(lin, **changed))
        failed = [row.block for row in rows if not row.ok]
        assert failed, name


def in_orbit():
    weld = fflin.Weld("tool_left", "tool_right")
    return fflin.load("dual_arm", orbit=500e3, constraints=[weld])


def flexible():
    modes = {"translation": [[0], [0], [2.0]], "rotation": [[3.0], [0], [0]]}
    array = fflin.FlexibleAppendage("base", [0.3], **modes, name="array")
    held = [fflin.Spherical("tool_left"), fflin.Weld("tool_left", "tool_right")]
    return fflin.load("dual_arm", appendages=[array], constraints=held)


def with_wheels():
    """A wheel without inertia, a wheel that is a joint, and a thruster on an arm."""
    inputs = [
        fflin.ReactionWheel((0, 0, 1), momentum=3.0),
        fflin.ReactionWheel((1, 0, 0), inertia=0.02, name="wheel_x"),
        fflin.Thruster("tool_right", (0, 0, 0.1), (0, 1, 0)),
        fflin.JointTorque("*"),
    ]
    held = [fflin.Hinge("base", axis=(1, 2, 3))]
    return fflin.load("dual_arm", inputs=inputs, constraints=held)


def mimicking(tmp_path):
    mimic = '<mimic joint="b" multiplier="-0.7" offset="0.2"/>'
    kinds = {"a": "revolute", "b": "revolute", "parent": "base"}
    path = tmp_path / "gripper.urdf"
    path.write_text(MIMIC.format(links=LINKS, mimic=mimic, **kinds))
    return fflin.load(path, constraints=[fflin.Spherical("la")], gravity=(1, 2, 3))


def moving(make, tmp_path, rng):
    """Return a robot of one of the kinds above, with a point in motion and its inputs."""
    robot = make(tmp_path) if make is mimicking else make()
    joints = {name: 0.3 for name in robot.joint_names[:1]}
    q = fflin.configuration(robot, joints, rpy=(10, 20, 30))
    nu = 0.05 * rng.normal(size=6 + robot.n)
    q, v = fflin.closed(robot, q, fflin.StateMap(robot).spread(nu))
    u = rng.normal(size=len(fflin.linearize(robot, q).u0))
    return robot, q, v, u


@pytest.mark.exhaustive
@pytest.mark.parametrize("make", [in_orbit, flexible, with_wheels, mimicking])
def test_constraints_agree_on_robots_of_every_kind(make, tmp_path):
    robot, q, v, u = moving(make, tmp_path, np.random.default_rng(5))
    check = fflin.check(robot, fflin.linearize(robot, q, v, u))
    assert check.ok, check


def clamped(**fields):
    build = Build(pin.Inertia(4.0, np.array((0.2, 0.0, 0.0)), np.eye(3)))
    held = fflin.Weld("base", name="clamp", placement=at())
    fields = {"gravity": (0.0, 0.0, -10.0), **fields}
    return build.robot("clamped", constraints=[held], **fields)


def test_the_force_of_a_clamp_carries_the_weight_and_the_inputs():
    robot = clamped(outputs=[fflin.ConstraintForce("clamp")])
    lin = fflin.linearize(robot)
    assert lin.state_names == ()
    assert lin.output_names[:2] == ("clamp.force.x", "clamp.force.y")
    np.testing.assert_allclose(lin.y0, [0, 0, 40.0, 0, -8.0, 0], atol=1e-12)
    # the inputs are a torque and a force on the base
    np.testing.assert_allclose(lin.D[:3, 3:], -np.eye(3), atol=1e-12)
    np.testing.assert_allclose(lin.D[3:, :3], -np.eye(3), atol=1e-12)


@pytest.mark.exhaustive
def test_forces_of_constraints_agree_with_differences():
    rng = np.random.default_rng(6)
    robot, q, v, u = random_constraints(rng, count=1, joints=3)
    robot = robot.replace(constraints=[fflin.Hinge("joint_2", name="pin")])
    q, v = fflin.closed(robot, q, v)
    robot = robot.replace(outputs=[fflin.ConstraintForce("pin"), "pose:joint_1"])
    reference = random_pose(rng, 30.0)
    lin = fflin.linearize(robot, q, v, u, reference=reference)
    assert np.abs(lin.y0[3:6]).max() > 0.1
    check = fflin.check(robot, lin)
    assert check.ok, check


def test_a_configuration_off_the_manifold_is_refused_with_its_distance():
    robot = clamped()
    q = fflin.configuration(robot, base=at(x=0.01))
    with pytest.raises(
        fflin.ConstraintError, match=r"constraint 'clamp' by 0\.01 m; close"
    ):
        fflin.linearize(robot, q)


def test_a_configuration_that_is_almost_closed_is_closed_with_a_warning():
    robot = clamped()
    q = fflin.configuration(robot, base=at(x=3e-7))
    with pytest.warns(fflin.FflinWarning, match="off constraint 'clamp' by 3e-07 m"):
        lin = fflin.linearize(robot, q)
    np.testing.assert_allclose(lin.q[:3], 0.0, atol=1e-12)


def test_a_velocity_that_opens_a_constraint_is_refused():
    robot = clamped()
    v = np.zeros(robot.nv)
    v[1] = 0.2
    with pytest.raises(fflin.ConstraintError, match=r"move apart at 0\.2 m/s"):
        fflin.linearize(robot, v=v)


def test_other_coordinates_than_the_motions_are_refused():
    robot = pendulum(3.0, INERTIA, 0.7)
    with pytest.raises(fflin.InputError, match="names 2 coordinates, expected 3"):
        fflin.linearize(robot, independent=["q_b.x", "q_b.y"])
    with pytest.raises(fflin.ConstraintError, match="do not determine the motion"):
        fflin.linearize(robot, independent=["r_b.z", "q_b.x", "q_b.y"])
    for text in ("q_b", 3):
        with pytest.raises(fflin.InputError, match="expected a list of coordinates"):
            fflin.linearize(robot, independent=text)
    free = fflin.load("planar_detumble")
    with pytest.raises(fflin.InputError, match="has no constraints"):
        fflin.linearize(free, independent=["joint_1"])


def test_a_linearizer_keeps_its_coordinates_at_all_points():
    robot = parallelogram(0.6, 1.5, 0.8, 1.1)
    linearizer = fflin.Linearizer(robot)
    names = set()
    for angle in (0.0, 0.7, -1.2):
        guess = {"left": angle, "bar": -angle, "right": angle}
        q = fflin.closed(robot, fflin.configuration(robot, guess))
        names.add(linearizer(q).state_names)
    assert len(names) == 1
    assert pickle.loads(pickle.dumps(linearizer))(q).state_names in names


def test_a_model_in_reduced_states_is_restored_from_its_file(tmp_path):
    lin = fflin.linearize(pendulum(3.0, INERTIA, 0.7))
    for ending in ("npz", "mat", "json"):
        path = tmp_path / f"model.{ending}"
        lin.save(path)
        read = fflin.LinearModel.load(path)
        assert read.rank == 3
        assert read.dependent == lin.dependent
        assert read.state_names == lin.state_names
        np.testing.assert_array_equal(read.A, lin.A)
        np.testing.assert_array_equal(read.M, lin.M)


def test_the_truncation_error_of_the_differences_is_estimated_in_full():
    # sixth-order differences of exp(x) with large steps
    steps, curved = np.array([0.3]), np.array([True])
    value, again = jacobians(np.exp, np.zeros(1), steps, curved)
    error = abs(value[0, 0] - 1.0)
    estimate = TRUNCATION * max(abs(x[0, 0] - value[0, 0]) for x in again)
    # The next term of the error is smaller by about the square of the step.
    assert error == pytest.approx(estimate, rel=0.3**2)
    assert max(abs(x[0, 0] - value[0, 0]) for x in again) < 0.95 * error


def nearly_flat(angle):
    """A parallelogram at an angle [rad] from its flat posture, at rest with a holding torque."""
    robot = parallelogram(0.6, 1.5, 0.8, 1.1)
    left = np.pi / 2 - angle
    guess = {"left": left, "bar": -left, "right": left}
    q = fflin.closed(robot, fflin.configuration(robot, guess))
    torque = (0.6 + 1.5) * 9.81 * 0.8 * np.sin(left)
    return robot, q, fflin.effort(robot, {"left": torque})


@pytest.mark.parametrize("angle", exhaustive(1e-2, 1e-3, 1e-4, 3e-5, 1e-5))
def test_check_agrees_with_linearize_near_a_flat_posture(angle):
    robot, q, u = nearly_flat(angle)
    lin = fflin.linearize(robot, q, u=u, independent=["left"])
    inertia = 2.0 * 0.6 * 0.8**2 / 3.0 + 1.5 * 0.8**2
    stiffness = (0.6 + 1.5) * 9.81 * 0.8 * np.sin(angle)
    # The constraints fix the posture to a rounding error that grows with the inverse of the angle.
    assert lin.A[1, 0] == pytest.approx(
        -stiffness / inertia, abs=max(1e-9, 1e-13 / angle)
    )
    check = fflin.check(robot, lin)
    assert check.ok, check
    if angle != 1e-3:  # there, the rounding error is about the limit
        assert bool(check.remarks) == (angle < 1e-3)
    moved = replace(lin, A=lin.A + np.array(((0.0, 0.0), (0.1, 0.0))) * stiffness)
    if angle > 1e-3:
        assert not fflin.check(robot, moved).ok
    floating = robot.replace(constraints=[robot.constraints[1]])
    v = fflin.velocity(floating, {"left": 0.3, "bar": -0.3, "right": 0.3})
    q, v = fflin.closed(floating, q, v)
    check = fflin.check(floating, fflin.linearize(floating, q, v))
    assert check.ok, check


@pytest.mark.exhaustive
def test_check_states_which_errors_it_cannot_detect_near_a_flat_posture():
    robot, q, u = nearly_flat(1e-4)
    lin = fflin.linearize(robot, q, u=u, independent=["left"])
    check = fflin.check(robot, lin)
    assert "near a singular posture" in check.remarks[0]
    assert "are not detected" in " ".join(str(check).split())
    assert "are not detected" in check._repr_html_()


def test_the_condition_of_the_constraints_is_inverse_to_the_angle_from_a_flat_posture():
    """Also where the square of the smallest singular value is a rounding error."""
    conditions = []
    for angle in (1e-2, 1e-5):
        robot, q, _ = nearly_flat(angle)
        constraints = Aba(fflin.StateMap(robot))
        conditions.append(constraints.conditioning(q, np.zeros(robot.nv)).condition)
    assert conditions[1] / conditions[0] == pytest.approx(1e3, rel=1e-3)


def test_the_regularisation_of_the_check_balances_its_two_errors():
    """The error of fourth order equals the rounding error of the solver."""
    at_point = Conditioning(least=0.3, condition=50.0)
    rounding = 8.0 * np.finfo(float).eps * 50.0**2 / at_point.regularisation
    assert at_point.regularisation**4 / 64.0 == pytest.approx(rounding, rel=1e-12)
    assert at_point.error == pytest.approx(2.0 * rounding, rel=1e-12)
