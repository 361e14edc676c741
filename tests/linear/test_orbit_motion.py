"""Linear models over one orbit: periodic motions, multipliers, and the trajectories they make."""

import math

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.linear.floquet import multipliers
from tests.support.marks import exhaustive
from tests.support.orbits import N, in_ellipse, in_orbit
from tests.support.robots import free_body

BODY = (3.0, 5.0, 4.0)
TRANSLATION = np.r_[3:6, 9:12]


def monodromy(along):
    """The transition matrix over one period."""
    total = np.eye(len(along.state_names))
    for factor in along._monodromy_factors():
        total = factor @ total
    return total


@pytest.fixture(scope="module")
def held():
    return fflin.linearize_orbit(in_ellipse(free_body(BODY), 0.3), steps=40)


def test_the_transition_over_an_ellipse_preserves_volume(held):
    # Coriolis terms and gravity gradient have no divergence.
    whole = monodromy(held)
    assert abs(np.linalg.det(whole) - 1.0) < 1e-9
    translation = whole[np.ix_(TRANSLATION, TRANSLATION)]
    assert abs(np.linalg.det(translation) - 1.0) < 1e-9
    # Neighbouring orbits have the same period, except for their semi-major axis (one drift).
    scale = np.repeat((1.0, 1.0 / N), 3)
    drift = (translation - np.eye(6)) * scale[:, None] / scale
    values = np.linalg.svd(drift, compute_uv=False)
    assert values[1] < 1e-7 * values[0]


def test_the_models_at_the_knots_are_checked(held):
    for k in (0, 13):
        lin = held[k]
        assert lin.t == held.t[k]
        assert fflin.check(held.robot, lin).ok
    # A constant attitude of the base needs the torque of the frame's acceleration.
    now = held.robot.orbit.at(float(held.t[13]))
    # The gravity gradient exerts no torque on aligned axes.
    assert held.u[13, 1] == pytest.approx(-BODY[1] * now.rate_change, rel=1e-12)
    assert held.residual.max() < 1e-3


@pytest.mark.exhaustive
def test_check_passes_at_every_knot():
    along = fflin.linearize_orbit(in_ellipse(free_body(BODY), 0.3), steps=12)
    assert along.check().ok


def test_knots_repeat_after_the_period(held):
    late = held.period + 3.0
    A, B = held.matrices(3.0)
    again, _ = held.matrices(late)
    assert np.array_equal(again, A)
    q, v, u = held.point(late)
    for value, expected in zip((q, v, u), held.point(3.0), strict=True):
        assert np.array_equal(value, expected)
    assert np.array_equal(held.A[0], held.A[-1]) or np.allclose(
        held.A[0], held.A[-1], rtol=0.0, atol=1e-14
    )
    assert B.shape == (12, 6)


def test_in_a_circular_orbit_the_models_are_constant():
    robot = in_orbit(free_body(BODY))
    along = fflin.linearize_orbit(robot, steps=10)
    lin = fflin.linearize(robot, along.q[0], u=along.u[0], moving=True)
    assert lin.is_equilibrium()
    for A in along.A:
        assert np.array_equal(A, lin.A)
    assert along[3].t is None
    expected = np.exp(np.linalg.eigvals(lin.A) * along.period)
    # The multipliers of the translation are defective: sqrt(eps) of their distance is noise.
    found = np.sort(np.abs(along.multipliers))
    assert np.allclose(found, np.sort(np.abs(expected)), rtol=1e-6, atol=0.0)


def test_an_almost_circular_orbit_gives_the_matrices_of_the_circular_one():
    along = fflin.linearize_orbit(in_ellipse(free_body(BODY), 0.0), steps=10)
    expected = fflin.linearize_orbit(in_orbit(free_body(BODY)), steps=10)
    assert np.allclose(along.A, expected.A, rtol=0.0, atol=1e-14)
    assert np.allclose(along.u, expected.u, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("e", exhaustive(1e-3, 1e-4))
def test_the_forced_pitch_motion_has_the_amplitude_of_the_closed_form(e):
    inertia = (5.0, 6.0, 2.0)  # along x, opposite to the normal y, nadir z
    K = (inertia[0] - inertia[2]) / inertia[1]
    robot = in_ellipse(free_body(inertia), e)
    along = fflin.linearize_orbit(robot, motion="free", steps=8)
    pitch = 2.0 * np.arcsin(along.q[:, 4])
    expected = 2.0 * e / (3.0 * K - 1.0)
    # The next term of the amplitude is of the order of e^2.
    assert np.abs(pitch).max() == pytest.approx(abs(expected), abs=20.0 * e**2)
    assert not along.u.any()
    assert along.residual.max() < 1e-3
    assert np.abs(np.abs(along.multipliers) - 1.0).max() < 1e-6


@pytest.mark.exhaustive
def test_a_free_motion_in_an_eccentric_orbit_repeats():
    robot = in_ellipse(free_body((5.0, 6.0, 2.0)), 0.05)
    along = fflin.linearize_orbit(robot, motion="free", steps=60)
    motion = fflin.simulate(
        robot,
        q0=along.q[0],
        v0=along.v[0],
        duration=along.period,
        dt=along.period / 960,
    )
    assert np.allclose(motion.q[-1], along.q[0], rtol=0.0, atol=1e-8)
    assert np.allclose(motion.q[480], along.q[30], rtol=0.0, atol=1e-8)


def test_multipliers_below_the_machine_precision_are_accurate():
    expected = np.array([1.0, 0.9, -0.5, 1e-10, 1e-30, 1e-60])
    rng = np.random.default_rng(0)
    axes = [np.linalg.qr(rng.normal(size=(6, 6)))[0] for _ in range(40)]
    axes.append(axes[0])
    root = np.abs(expected) ** (1.0 / 40.0)
    factors = []
    for k in range(40):
        signs = np.sign(expected) if k == 0 else np.ones(6)
        factors.append(axes[k + 1] @ np.diag(signs * root) @ axes[k].T)
    found = multipliers(np.array(factors))
    assert np.allclose(found, expected, rtol=1e-9, atol=0.0)


def test_complex_pairs_stay_pairs():
    turn = pin.exp3(np.array((0.0, 0.0, 0.4))) * 0.8
    found = multipliers(np.array([turn] * 3))
    expected = 0.8**3 * np.exp(1.2j * np.array((1.0, 0.0, -1.0)))
    by_angle = found[np.argsort(-found.imag)]
    assert np.allclose(by_angle, expected, rtol=0.0, atol=1e-12)
    assert by_angle[1].imag == 0.0


def test_wheels_carry_a_torque_that_has_no_mean():
    wheel = fflin.ReactionWheel((0, 1, 0), "base", inertia=1e-4)
    robot = fflin.load(
        "cubesat",
        inputs=[wheel],
        orbit=fflin.EllipticOrbit(perigee=500e3, eccentricity=0.1),
    )
    along = fflin.linearize_orbit(robot, steps=8)
    assert not along.v[:, :6].any()
    speeds = along.v[:, 6]
    orbit = robot.orbit
    # The wheel keeps the sum of its momentum and of the base's constant: I theta' + J (w - theta').
    inertia = pin.crba(robot.model, robot.create_data(), along.q[0])[4, 4]
    rates = np.array([orbit.at(t).rate for t in along.t.tolist()])
    momentum = 1e-4 * speeds - inertia * rates
    assert np.ptp(momentum) < 1e-3 * np.ptp(1e-4 * speeds)
    q = fflin.configuration(robot, rpy=(0, 20, 0))
    with pytest.raises(fflin.EquilibriumError, match="rad/s in every period"):
        fflin.linearize_orbit(robot, q, steps=8)
    q = fflin.configuration(robot, rpy=(20, 0, 0))
    with pytest.raises(fflin.EquilibriumError, match="nothing balances omega_b"):
        fflin.linearize_orbit(robot, q, steps=8)


@pytest.mark.exhaustive
def test_controllability_and_observability_over_a_period():
    stable = in_ellipse(free_body((5.0, 6.0, 2.0)), 0.05)
    robot = stable.replace(inputs=[fflin.BaseTorque()])
    along = fflin.linearize_orbit(robot, steps=40)
    found = fflin.controllability(along)
    assert found.dimension == 6
    assert "v_b.x" in found.uncontrollable
    robot = robot.replace(outputs=[fflin.BasePose()])
    assert fflin.observability(fflin.linearize_orbit(robot, steps=40)).dimension == 12


@pytest.mark.exhaustive
def test_a_file_keeps_the_period(held, tmp_path):
    held.save(tmp_path / "along.npz")
    back = fflin.LinearTrajectory.load(tmp_path / "along.npz", held.robot)
    assert back.period == held.period
    assert np.array_equal(back.A, held.A)
    assert "largest multiplier" in str(back)
    with pytest.raises(fflin.FileError, match="multiple of this period"):
        fflin.LinearTrajectory.load(
            tmp_path / "along.npz", in_ellipse(free_body(BODY), 0.3, n=0.2)
        )


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda _: fflin.linearize_orbit(free_body(BODY)), "not in orbit"),
        (lambda robot: fflin.linearize_orbit(robot, motion="fast"), "'held' or 'free'"),
        (lambda robot: fflin.linearize_orbit(robot, steps=3), "steps"),
        (
            lambda robot: fflin.linearize_orbit(
                fflin.load("inspector_flexible", orbit=robot.orbit),
                motion="free",
                steps=8,
            ),
            "lock the joints",
        ),
        (
            lambda robot: fflin.linearize_orbit(
                robot.replace(inputs=[fflin.BaseForce()]), steps=8
            ),
            "nothing balances omega_b.y",
        ),
    ],
)
def test_invalid_requests_are_refused(ask, words):
    with pytest.raises(fflin.FflinError, match=words) as refused:
        ask(fflin.load("cubesat", orbit={"perigee": 5e5, "eccentricity": 0.1}))
    assert "\n" not in str(refused.value)


MODEL = {
    "a design about a fixed point": fflin.lqr,
    "discretize": lambda lin: lin.discretize(0.1),
    "controllability": fflin.controllability,
    "observability": fflin.observability,
    "gramians": fflin.gramians,
    "modes": fflin.modes,
    "momentum_reduction": fflin.momentum_reduction,
    "sensitivity": fflin.sensitivity,
    "to_scipy": lambda lin: lin.to_scipy(),
    "to_control": lambda lin: lin.to_control(),
    "model predictive control": lambda lin: fflin.mpc(lin, 5, sample=1.0),
    "the analysis of a closed loop": lambda lin: fflin.margins(
        fflin.StateFeedback(lin, np.zeros((6, 12))), lin
    ),
    "the comparison of linear and nonlinear motions": lambda lin: fflin.validity(
        lin._robot, lin, np.zeros((6, 12))
    ),
    "a linear prediction": lambda lin: fflin.simulate(
        lin._robot, duration=1.0, linear=lin
    ),
}


@pytest.mark.parametrize("feature", MODEL)
def test_a_model_at_one_time_is_refused_where_all_times_count(feature):
    robot = fflin.load("cubesat", orbit={"perigee": 5e5, "eccentricity": 0.1})
    lin = fflin.linearize(robot, t=60.0)
    with pytest.raises(fflin.InputError, match=f"{feature}.*only at t = 60 s"):
        MODEL[feature](lin)


ROBOT = {
    "sweeps": lambda robot: fflin.sweep(robot, robot.neutral()[None]),
    "equilibria": fflin.equilibrium,
    "relative equilibria": fflin.relative_equilibria,
    "uncertain models": lambda robot: fflin.uncertain(robot, {"base.mass": 0.1}),
    "captures": lambda robot: fflin.capture(
        robot, "base", pin.Inertia.FromSphere(1.0, 0.1)
    ),
}


@pytest.mark.parametrize("feature", ROBOT)
def test_features_without_time_refuse_elliptic_orbits(feature):
    robot = fflin.load("cubesat", orbit={"perigee": 5e5, "eccentricity": 0.1})
    with pytest.raises(fflin.InputError, match=f"{feature} do not support elliptic"):
        ROBOT[feature](robot)


def test_models_in_base_axes_in_orbit_have_the_poles_of_other_frames():
    robot = fflin.load("cubesat", orbit=5e5)
    models = [
        fflin.linearize(robot, frame="local"),
        fflin.linearize(robot, moving=True),
    ]
    expected = fflin.lqr(fflin.linearize(robot)).poles
    for lin in models:
        poles = fflin.lqr(lin).poles
        assert np.allclose(np.sort_complex(poles), np.sort_complex(expected), rtol=1e-9)
        with pytest.raises(fflin.InputError, match="in frame 'lvlh' or 'hill'"):
            fflin.sensitivity(lin)


def test_a_law_in_base_axes_knows_whether_it_was_designed_in_orbit():
    robot = fflin.load("cubesat", orbit=5e5)
    free = robot.replace(orbit=None)
    for design, flown in ((robot, free), (free, robot)):
        lin = fflin.linearize(design, frame="local")
        policy = fflin.StateFeedback(lin, np.zeros((6, 12)))
        with pytest.raises(fflin.InputError, match="design it for the robot"):
            fflin.simulate(flown, policy, duration=1.0)
        assert fflin.simulate(design, policy, duration=0.1, dt=0.1).frame == "local"


@pytest.mark.compiled
def test_models_in_base_axes_in_orbit_are_swept_in_python():
    robot = fflin.load("cubesat", orbit=5e5)
    batch = fflin.sweep(robot, robot.neutral()[None], moving=True)
    assert np.array_equal(batch[0].A, fflin.linearize(robot, moving=True).A)
    with pytest.raises(fflin.InputError, match="base axes"):
        fflin.sweep(robot, robot.neutral()[None], moving=True, engine="compiled")


def test_a_periodic_trajectory_must_close():
    robot = in_ellipse(free_body(BODY), 0.3)
    period = robot.orbit.period
    q = np.tile(robot.neutral(), (3, 1))
    v, u = np.zeros((3, 6)), np.zeros((3, 6))
    t = np.array((0.0, 0.5 * period, period))
    fflin.Trajectory(robot, t, q, v, u, period=period)
    with pytest.raises(fflin.InputError, match="expected the duration"):
        fflin.Trajectory(robot, t, q, v, u, period=2.0 * period)
    open_v = v.copy()
    open_v[-1, 3] = 0.1
    with pytest.raises(fflin.InputError, match="does not repeat"):
        fflin.Trajectory(robot, t, q, open_v, u, period=period)
    with pytest.raises(fflin.InputError, match="multiple of this period"):
        fflin.Trajectory(robot, t / math.pi, q, v, u, period=period / math.pi)
    free = free_body(BODY)
    made = fflin.Trajectory(free, t, q, v, u)
    with pytest.raises(fflin.InputError, match="no multipliers"):
        _ = fflin.linearize_trajectory(free, made).multipliers


@pytest.mark.exhaustive
def test_a_periodic_motion_with_too_few_knots_asks_for_more_of_them():
    orbit = fflin.EllipticOrbit(perigee=500e3, eccentricity=0.5)
    robot = fflin.load("servicer_7dof", orbit=orbit)
    along = fflin.linearize_orbit(robot, steps=8)
    assert "give more knots, with steps= of linearize_orbit" in " ".join(
        str(along).split()
    )
