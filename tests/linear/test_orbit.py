"""Linear models in a circular orbit: textbooks' matrices, and every route to them."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.linear.check import References
from fflin.linear.equilibrium import on_orbit
from tests.support.orbits import N, in_orbit
from tests.support.robots import free_body, random_pose

ROBOTS = ("ets_vii", "cubesat", "canadarm2", "servicer_7dof")

# Clohessy and Wiltshire's matrix over (x, y, z, dx, dy, dz) in Hill's axes; LVLH's axes in them.
CW = np.zeros((6, 6))
CW[:3, 3:] = np.eye(3)
CW[3:, :3] = np.diag((3.0 * N**2, 0.0, -(N**2)))
CW[3, 4], CW[4, 3] = 2.0 * N, -2.0 * N
HILL_OF = {
    "hill": np.eye(3),
    "lvlh": np.array(((0, 0, -1.0), (1.0, 0, 0), (0, -1.0, 0))),
}


def moved(robot, rng, speed=0.4, degrees=100.0):
    """A random point (q, v, u) of a robot."""
    joints = {joint.name: rng.uniform(-1.0, 1.0) for joint in robot.joints}
    q = fflin.configuration(robot, joints, random_pose(rng, degrees))
    nu = len(fflin.linearize(robot).input_names)
    return q, speed * rng.normal(size=robot.nv), speed * rng.uniform(0.0, 1.0, size=nu)


def translation(lin):
    """A over position and velocity of the base of a body."""
    rows = np.r_[3:6, 9:12]
    return lin.A[np.ix_(rows, rows)]


@pytest.mark.parametrize("frame", ["hill", "lvlh"])
@pytest.mark.parametrize("degrees", [0.0, 130.0])
def test_the_translation_of_a_body_is_clohessy_and_wiltshires(frame, degrees):
    robot = in_orbit(free_body((3.0, 5.0, 4.0)))
    q = fflin.configuration(robot, base=random_pose(np.random.default_rng(0), degrees))
    lin = fflin.linearize(robot, q, frame=frame)
    turn = np.kron(np.eye(2), HILL_OF[frame])
    assert np.abs(turn @ translation(lin) @ turn.T - CW).max() <= 1e-14 * N
    rows = np.r_[3:6, 9:12]
    others = np.setdiff1d(np.arange(12), rows)
    assert not lin.A[np.ix_(rows, others)].any()
    assert np.allclose(lin.B[9:, 3:], np.eye(3) / lin.M[3, 3], rtol=0, atol=1e-15)
    assert np.allclose(lin.x0[3:6], q[:3], rtol=0, atol=0)


def test_its_samples_are_the_closed_form_of_textbooks():
    lin = fflin.linearize(in_orbit(free_body((3.0, 5.0, 4.0))), frame="hill")
    h = 1.7
    s, c, t = math.sin(N * h), math.cos(N * h), N * h
    # Clohessy and Wiltshire 1960, as in Vallado, Fundamentals of Astrodynamics.
    expected = np.array(
        [
            [4 - 3 * c, 0, 0, s / N, 2 * (1 - c) / N, 0],
            [6 * (s - t), 1, 0, -2 * (1 - c) / N, (4 * s - 3 * t) / N, 0],
            [0, 0, c, 0, 0, s / N],
            [3 * N * s, 0, 0, c, 2 * s, 0],
            [-6 * N * (1 - c), 0, 0, -2 * s, 4 * c - 3, 0],
            [0, 0, -N * s, 0, 0, c],
        ]
    )
    assert (
        np.abs(translation(lin.discretize(h)) - expected).max()
        < 1e-14 * np.abs(expected).max()
    )


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("frame", ["hill", "lvlh"])
def test_every_route_agrees_at_any_point(name, frame):
    robot = in_orbit(fflin.load(name))
    rng = np.random.default_rng(1)
    for speed, reference in ((0.0, None), (0.4, None), (0.4, random_pose(rng, 30.0))):
        lin = fflin.linearize(
            robot, *moved(robot, rng, speed), frame=frame, reference=reference
        )
        result = fflin.check(robot, lin)
        assert result.ok, result


def test_and_with_springs_wheels_thrusters_and_sensors():
    robot, rng = fflin.load("servicer_7dof"), np.random.default_rng(2)
    tool = robot.model.frames[-1].name
    robot = in_orbit(robot).replace(
        stiffness=3.0,
        damping=0.5,
        rest={robot.joint_names[0]: 0.3},
        inputs=[
            *(fflin.BaseTorque(), fflin.BaseForce(), fflin.JointTorque("*")),
            fflin.Thruster(tool, (0.1, 0.2, 0.3), (1.0, 0.0, 0.0)),
            fflin.ReactionWheel((1.0, 0.0, 0.0), inertia=0.1),
            fflin.ReactionWheel((0.0, 1.0, 0.0), momentum=2.0),
        ],
        outputs=[
            fflin.Gyroscope(tool),
            fflin.FrameVelocity(tool),
            fflin.FramePose(tool),
        ],
    )
    for frame in ("hill", "lvlh"):
        lin = fflin.linearize(robot, *moved(robot, rng), frame=frame)
        result = fflin.check(robot, lin)
        assert result.ok, result
    # A gyroscope tells absolute rates; velocities of frames are relative.
    still = fflin.linearize(
        robot.replace(outputs=[fflin.Gyroscope("base"), fflin.FrameVelocity("base")])
    )
    assert np.allclose(still.y0, [0, -N, 0, 0, 0, 0, 0, 0, 0], rtol=0, atol=1e-16)


def test_large_objects_are_drawn_next_to_the_orbit_of_the_earth():
    """At a true orbit's rate, its terms are as exact as the others."""
    robot = fflin.load("servicer_7dof", orbit=800e3)
    lin = fflin.linearize(robot, *moved(robot, np.random.default_rng(3), 0.1))
    assert fflin.check(robot, lin).ok
    assert lin.mean_motion == pytest.approx(2 * math.pi / 6052.0, rel=1e-3)  # 100.9 min
    for change in (1.001, 0.999):
        other = robot.replace(
            orbit=fflin.CircularOrbit(mean_motion=change * robot.orbit.mean_motion)
        )
        assert not fflin.check(other, lin).ok


def test_a_root_that_stands_askew_in_the_world_changes_nothing():
    rng = np.random.default_rng(8)
    model = fflin.load("servicer_7dof").model.copy()
    model.jointPlacements[1] = random_pose(rng, 70.0)
    robot = in_orbit(fflin.from_model(model))
    lin = fflin.linearize(robot, *moved(robot, rng))
    assert fflin.check(robot, lin).ok
    for one in fflin.relative_equilibria(robot)[::7]:
        about = model.jointPlacements[1] * pin.XYZQUATToSE3(one.q[:7])
        assert (
            np.abs(fflin.equilibrium(robot, one.q, reference=about).u[:6]).max() < 1e-12
        )


@pytest.mark.parametrize("frame", ["lvlh", "hill"])
def test_the_centre_of_mass_is_put_on_the_orbit_wherever_the_root_stands(frame):
    # The orbit passes the origin along x in lvlh, and along y in hill.
    rng = np.random.default_rng(6)
    model = fflin.load("ets_vii").model.copy()
    model.jointPlacements[1] = random_pose(rng, 70.0)
    robot = fflin.from_model(model, orbit=550e3)
    q = fflin.configuration(robot, base=random_pose(rng, 50.0))
    placed = on_orbit(robot, q, frame)
    before, center = (
        pin.centerOfMass(robot.model, robot.create_data(), point)
        for point in (q, placed)
    )
    along = ("lvlh", "hill").index(frame)
    expected = np.where(np.arange(3) == along, before, 0.0)
    assert np.abs(before).min() > 0.01
    assert center == pytest.approx(expected, abs=1e-13)
    assert np.array_equal(placed[3:], q[3:])


def test_a_base_that_flies_fast_is_seen_from_the_frame_that_turns():
    robot = in_orbit(fflin.load("cubesat"))
    v = fflin.velocity(robot, {"v_b.x": 150.0, "omega_b.y": 0.1})
    result = fflin.check(robot, fflin.linearize(robot, v=v))
    assert result.ok, result


def test_a_weak_field_is_one_too():
    """The gradient of a geostationary orbit is no rounding, though it is below 1e-9 rad/s^2."""
    robot = fflin.load("cubesat", orbit=35786e3)
    turned = fflin.configuration(robot, base=random_pose(np.random.default_rng(7), 0.5))
    turned[:3] = 0.0
    lin = fflin.linearize(robot, turned)
    assert 1e-13 < np.abs(lin.f0).max() < 1e-9
    assert not lin.is_equilibrium()
    assert lin.ignorable == ()
    held = fflin.linearize(robot, turned, u=fflin.equilibrium(robot, turned).u)
    assert held.is_equilibrium()


@pytest.mark.parametrize("ending", ["npz", "mat", "json"])
def test_files_carry_the_orbit(tmp_path, ending):
    robot = in_orbit(fflin.load("cubesat"))
    lin = fflin.linearize(robot, frame="hill")
    lin.save(tmp_path / f"lin.{ending}")
    back = fflin.LinearModel.load(tmp_path / f"lin.{ending}")
    assert (back.frame, back.mean_motion) == ("hill", N)
    assert fflin.check(robot, back).ok


def test_a_sweep_has_the_same_models_and_its_file_the_orbit(tmp_path):
    robot = in_orbit(fflin.load("servicer_7dof"))
    batch = fflin.sweep(
        robot, fflin.grid(robot, {"joint_2": np.linspace(-1, 1, 20)}), frame="hill"
    )
    lin = fflin.linearize(robot, batch.q[3], frame="hill")
    for name in ("A", "B", "f0", "x0", "mean_motion"):
        assert np.array_equal(getattr(batch[3], name), getattr(lin, name))
    batch.save(tmp_path / "batch.npz")
    assert fflin.LinearBatch.load(tmp_path / "batch.npz")[3].mean_motion == N
    assert (
        fflin.LinearBatch.load(tmp_path / "batch.npz", robot)[3].certificate.route_A
        < 1e-10
    )
    with pytest.raises(fflin.InputError, match="'servicer_7dof'"):
        fflin.LinearBatch.load(tmp_path / "batch.npz", robot.replace(orbit=8e5))


def test_an_equilibrium_holds_against_the_gradient():
    robot = fflin.load("servicer_7dof", orbit=800e3)
    q = fflin.configuration(
        robot, {"joint_2": 0.7}, random_pose(np.random.default_rng(4), 40.0)
    )
    for frame in ("lvlh", "hill"):
        held = fflin.equilibrium(robot, q, frame=frame)
        lin = fflin.linearize(robot, q, u=held.u, frame=frame)
        assert lin.is_equilibrium()
        assert not fflin.linearize(robot, q, frame=frame).is_equilibrium()
        assert np.abs(lin.f0).max() < 1e-12 * robot.orbit.mean_motion
    with pytest.raises(fflin.EquilibriumError, match="frame"):
        fflin.equilibrium(robot, q, v=fflin.velocity(robot, {"omega_b.x": 0.1}))
    # In closed form of a body: 3 n^2 r x I r less what the frame's turning takes.
    body = in_orbit(free_body((3.0, 5.0, 4.0)))
    q = fflin.configuration(body, base=random_pose(np.random.default_rng(5), 50.0))
    R, I = pin.Quaternion(q[3:7]).matrix(), np.diag((3.0, 5.0, 4.0))
    r, z = R.T @ [1.0, 0, 0], R.T @ [0, 0, 1.0]
    expected = N**2 * (np.cross(z, I @ z) - 3.0 * np.cross(r, I @ r))
    got = fflin.equilibrium(body, q, frame="hill").u
    assert np.allclose(got[:3], expected, rtol=0, atol=1e-14)
    m = fflin.linearize(body).M[3, 3]
    assert np.allclose(got[3:], -m * CW[3:, :3] @ q[:3], rtol=0, atol=1e-12)


@pytest.mark.compiled
@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda robot: fflin.linearize(robot, frame="hybrid"), "lvlh or hill"),
        (
            lambda robot: fflin.linearize(fflin.load("cubesat"), frame="lvlh"),
            "orbit=...",
        ),
        (
            lambda robot: fflin.linearize(robot.replace(outputs=[fflin.Momentum()])),
            "output",
        ),
        (
            lambda robot: fflin.linearize(
                robot.replace(outputs=[fflin.Accelerometer("base")])
            ),
            "output",
        ),
        (lambda robot: fflin.uncertain(robot, {"base.mass": 0.1}).lft(), "orbit"),
        (lambda robot: fflin.capture(robot, "base", fflin.load("ets_vii")), "orbit"),
        (
            lambda robot: fflin.acceleration_lqr(fflin.linearize(robot), 1, 1, 1),
            "fixed point|lqr",
        ),
        (lambda robot: fflin.relative_equilibria(robot.replace(orbit=None)), "orbit"),
        (lambda robot: far(robot, 5000e3), "linear"),
    ],
)
def test_missing_orbit_fields_give_a_one_line_error(ask, words):
    with (
        pytest.raises(fflin.InputError, match=words) as refused,
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        ask(fflin.load("cubesat", orbit=800e3))
    assert "\n" not in str(refused.value)


def far(robot, distance):
    """The model at a distance along the orbit."""
    place = pin.SE3(np.eye(3), np.array([distance, 0.0, 0.0]))
    return fflin.linearize(robot, fflin.configuration(robot, base=place))


def test_far_from_its_point_the_field_is_reported_to_be_coarse():
    robot = fflin.load("cubesat", orbit=800e3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        far(robot, 20e3)
    with pytest.warns(fflin.FflinWarning, match="2.1 %"):
        far(robot, 100e3)


@pytest.mark.parametrize("name", ["servicer_7dof", "cubesat"])
def test_a_held_attitude_checks_though_its_inputs_are_rounding(name):
    locks = list(fflin.load(name).joint_names)
    robot = fflin.load(name, lock=locks, orbit=fflin.CircularOrbit(700e3))
    for attitude in fflin.relative_equilibria(robot)[::5]:
        about = pin.XYZQUATToSE3(attitude.q[:7])
        held = fflin.equilibrium(robot, attitude.q, reference=about)
        lin = fflin.linearize(robot, attitude.q, u=held.u, reference=about)
        assert fflin.check(robot, lin).ok
        # What does not balance is still found: a tenth of the gradient's torque.
        f0 = lin.f0.copy()
        f0[6] += 0.1 * robot.orbit.mean_motion**2
        assert not fflin.check(robot, replace(lin, f0=f0)).ok


def failed_blocks(references, lin):
    """The blocks in which a model differs from the independent computations."""
    return {row.block for row in references.rows(lin) if not row.ok}


def balanced_satellite():
    """A body with three wheels and two equal wings, with principal axes in the orbital axes."""
    axes = np.eye(3).tolist()
    wheels = [fflin.ReactionWheel(axis, inertia=0.012) for axis in axes]
    wings = [
        fflin.FlexibleAppendage(
            "base", [0.4], [[0], [0], [1.9]], [[side], [0], [0]], name=name
        )
        for name, side in (("left", 3.6), ("right", -3.6))
    ]
    body = free_body((48.0, 28.0, 55.0))
    return fflin.from_model(
        body.model, appendages=wings, inputs=wheels, orbit=fflin.CircularOrbit(550e3)
    )


def test_terms_of_an_orbit_that_cancel_are_compared_by_their_magnitudes():
    """By symmetry, the terms of the wheels and of the base at its orbit cancel to rounding."""
    robot = balanced_satellite()
    lin = fflin.linearize(robot)
    n2 = robot.orbit.mean_motion**2
    assert np.abs(lin.f0).max() < 1e-9 * n2
    references = References(robot, lin)
    errors = {row.block: row.error for row in references.rows(lin)}
    assert not failed_blocks(references, lin)
    assert max(errors["f0[v_b]"], errors["f0[omega_b]"]) < 1e-12
    # A part of 1e-6 of the terms of the orbit is detected in every block of accelerations.
    groups = fflin.StateMap(robot).groups._asdict()
    for row in ("omega_b", "v_b", "qdot_m"):
        f0 = lin.f0.copy()
        f0[groups[row]] += 1e-6 * n2
        assert failed_blocks(references, replace(lin, f0=f0)) == {f"f0[{row}]"}
    wheel = lin.state_names.index("qdot_m.wheel_2")
    A = lin.A.copy()
    A[wheel, lin.state_names.index("q_m.wheel_2")] += 1e-6 * n2
    assert failed_blocks(references, replace(lin, A=A)) == {"A[qdot_m, q_m]"}


def test_flipped_sign_of_the_gravity_gradient_is_detected():
    robot = balanced_satellite()
    q = fflin.configuration(robot, rpy=(4.0, -3.0, 5.0))
    lin = fflin.linearize(robot, q)
    free = fflin.linearize(robot.replace(orbit=None), q)
    groups = fflin.StateMap(robot).groups
    references = References(robot, lin)
    assert not failed_blocks(references, lin)
    gradient = (lin.A - free.A)[groups.omega_b, groups.q_b]
    A = lin.A.copy()
    A[groups.omega_b, groups.q_b] -= 2.0 * gradient
    assert failed_blocks(references, replace(lin, A=A)) == {"A[omega_b, q_b]"}
    f0 = lin.f0.copy()
    f0[groups.omega_b] *= -1.0
    assert failed_blocks(references, replace(lin, f0=f0)) == {"f0[omega_b]"}
