"""Linear models in elliptic orbits: circular orbits as a limit, and Kepler's orbits."""

import math

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.orbits import N, ellipse, in_ellipse, in_orbit
from tests.support.robots import free_body, random_pose

BODY = (3.0, 5.0, 4.0)


def moved(robot, rng, speed=0.4, degrees=100.0):
    """A random point (q, v, u) of a robot."""
    joints = {joint.name: rng.uniform(-0.5, 0.5) for joint in robot.joints}
    q = fflin.configuration(robot, joints, random_pose(rng, degrees))
    nu = len(fflin.linearize(robot).input_names)
    return q, speed * rng.normal(size=robot.nv), speed * rng.uniform(0.0, 1.0, size=nu)


@pytest.mark.parametrize("frame", ["lvlh", "hill"])
def test_without_eccentricity_the_model_is_that_of_the_circular_orbit(frame):
    orbit = fflin.CircularOrbit(
        mean_motion=N, body="x", mu=N**2 * 1e18, body_radius=1.0
    )
    robot = fflin.load("cubesat").replace(orbit=orbit)
    round_ellipse = fflin.EllipticOrbit(
        perigee=orbit.altitude,
        eccentricity=0.0,
        body="x",
        mu=orbit.mu,
        body_radius=orbit.body_radius,
    )
    # The mean motion of this circular orbit is given, and the altitude follows from it.
    assert round_ellipse.mean_motion == pytest.approx(N, rel=1e-15)
    by_altitude = fflin.CircularOrbit(
        orbit.altitude, body="x", mu=orbit.mu, body_radius=orbit.body_radius
    )
    point = moved(robot, np.random.default_rng(0))
    expected = fflin.linearize(robot.replace(orbit=by_altitude), *point, frame=frame)
    other = robot.replace(orbit=round_ellipse)
    lin = fflin.linearize(other, *point, frame=frame, t=4.2)
    for name in ("A", "B", "f0", "x0"):
        assert np.array_equal(getattr(lin, name), getattr(expected, name))
    assert (lin.t, expected.t) == (4.2, None)


@pytest.mark.parametrize("options", [{"frame": "local"}, {"moving": True}])
def test_models_in_base_axes_are_checked_in_circular_and_elliptic_orbits(options):
    rng = np.random.default_rng(1)
    for place in (in_orbit, lambda robot: in_ellipse(robot, 0.3)):
        robot = place(fflin.load("cubesat"))
        lin = fflin.linearize(robot, *moved(robot, rng), t=3.0, **options)
        assert fflin.check(robot, lin).ok
        assert lin.frame == "local"


@pytest.mark.parametrize("frame", ["lvlh", "hill"])
def test_models_in_an_ellipse_are_checked(frame):
    robot = in_ellipse(fflin.load("servicer_7dof"), 0.3, anomaly=1.0)
    point = moved(robot, np.random.default_rng(2))
    lin = fflin.linearize(robot, *point, frame=frame, t=5.0)
    assert fflin.check(robot, lin).ok
    elsewhere = fflin.linearize(robot, *point, frame=frame, t=9.0)
    assert np.abs(lin.A - elsewhere.A).max() > 1e-3
    again = fflin.linearize(robot, *point, frame=frame, t=5.0 + robot.orbit.period)
    assert np.allclose(again.A, lin.A, rtol=0.0, atol=1e-12 * np.abs(lin.A).max())


def inertial(orbit, t):
    """Position and velocity (3,) on an orbit in inertial axes, and the axes (3, 3) of Hill."""
    now = orbit.at(t)
    cosine, sine = math.cos(now.angle), math.sin(now.angle)
    radial = np.array((cosine, sine, 0.0))
    along = np.array((-sine, cosine, 0.0))
    climb = -0.5 * now.rate_change / now.rate * now.radius
    position = now.radius * radial
    velocity = climb * radial + now.radius * now.rate * along
    return position, velocity, np.column_stack((radial, along, (0.0, 0.0, 1.0)))


def kepler(mu, r, v, t):
    """Position and velocity after t on the Kepler orbit through r and v, by universal variables."""
    r0 = np.linalg.norm(r)
    alpha = 2.0 / r0 - v @ v / mu
    radial = r @ v / math.sqrt(mu)
    root = math.sqrt(alpha)
    x = math.sqrt(mu) * alpha * t
    for _ in range(50):
        z = root * x
        c = (1.0 - math.cos(z)) / alpha
        s = (z - math.sin(z)) / (alpha * root)
        f = radial * c + (1.0 - alpha * r0) * s + r0 * x - math.sqrt(mu) * t
        slope = radial * math.sin(z) / root + (1.0 - alpha * r0) * c + r0
        step = f / slope
        x -= step
        if abs(step) <= 1e-16 * abs(x):
            break
    z = root * x
    c = (1.0 - math.cos(z)) / alpha
    s = (z - math.sin(z)) / (alpha * root)
    f = 1.0 - c / r0
    g = t - s / math.sqrt(mu)
    position = f * r + g * v
    radius = np.linalg.norm(position)
    f_rate = math.sqrt(mu) / (radius * r0) * (alpha * s - x)
    g_rate = 1.0 - c / radius
    return position, f_rate * r + g_rate * v


def relative(orbit, t, r, v):
    """State (6,) in Hill's axes, relative to the orbit, of a point with inertial r and v."""
    centre, speed, axes = inertial(orbit, t)
    spin = orbit.at(t).rate * np.array((0.0, 0.0, 1.0))
    apart = axes.T @ (r - centre)
    return np.concatenate((apart, axes.T @ (v - speed) - np.cross(spin, apart)))


def kepler_transition(orbit, t, step=10.0):
    """Transition (6, 6) from 0 to t by central differences of two Kepler orbits."""
    centre, speed, axes = inertial(orbit, 0.0)
    spin = orbit.at(0.0).rate * np.array((0.0, 0.0, 1.0))
    columns = []
    for unit in np.eye(6):
        ends = []
        # Fourth-order differences with steps of 1e-5 of the semi-major axis.
        for weight in (1.0, -1.0, 2.0, -2.0):
            apart, rate = np.split(weight * step * unit * np.repeat((1.0, N), 3), 2)
            r = centre + axes @ apart
            v = speed + axes @ (rate + np.cross(spin, apart))
            ends.append(relative(orbit, t, *kepler(orbit.mu, r, v, t)))
        near, far = ends[0] - ends[1], ends[2] - ends[3]
        columns.append((8.0 * near - far) / 12.0 / step)
    return np.column_stack(columns) / np.repeat((1.0, N), 3)


def test_the_transition_over_part_of_an_ellipse_is_that_of_two_kepler_orbits():
    orbit = ellipse(0.3, anomaly=0.4)
    robot = free_body(BODY).replace(orbit=orbit)
    duration = 0.7 * orbit.period
    rows = np.r_[3:6, 9:12]
    linearizer = fflin.Linearizer(robot, frame="hill")

    def rate(t, state):
        A = linearizer(t=t).A[np.ix_(rows, rows)]
        return (A @ state.reshape(6, 6)).ravel()

    from scipy.integrate import solve_ivp

    start = np.eye(6).ravel()
    span = (0.0, duration)
    end = solve_ivp(rate, span, start, method="DOP853", rtol=1e-12, atol=1e-12)
    transition = end.y[:, -1].reshape(6, 6)
    expected = kepler_transition(orbit, duration)
    scale = np.repeat((1.0, 1.0 / N), 3)
    error = (transition - expected) * scale / scale[:, None]
    assert np.abs(error).max() < 1e-9 * np.abs(expected * scale / scale[:, None]).max()


def test_files_keep_the_time_of_a_model(tmp_path):
    robot = in_ellipse(fflin.load("cubesat"), 0.3)
    lin = fflin.linearize(robot, frame="hill", t=2.5)
    for ending in ("npz", "mat", "json"):
        lin.save(tmp_path / f"lin.{ending}")
        back = fflin.LinearModel.load(tmp_path / f"lin.{ending}")
        assert back.t == 2.5
        assert fflin.check(robot, back).ok


def test_gravity_gradient_turns_a_body_at_perigee_by_the_closed_form():
    robot = in_ellipse(free_body(BODY), 0.3)
    R = pin.exp3(np.array((0.3, -0.2, 0.5)))
    q = fflin.configuration(robot, base=pin.SE3(R, np.zeros(3)))
    now = robot.orbit.at(3.0)
    lin = fflin.linearize(robot, q, frame="hill", t=3.0)
    I = np.diag(BODY)
    r = R.T @ [1.0, 0.0, 0.0]
    z = R.T @ [0.0, 0.0, 1.0]
    torque = 3.0 * now.gradient * np.cross(r, I @ r)
    spin = now.rate * z
    expected = np.linalg.solve(I, torque - np.cross(spin, I @ spin))
    expected -= now.rate_change * z
    assert np.allclose(lin.f0[6:9], expected, rtol=0.0, atol=1e-14)


def test_constrained_robots_have_models_at_a_time_but_not_over_an_orbit():
    orbit = fflin.EllipticOrbit(perigee=500e3, apogee=1900e3)
    weld = fflin.Weld("tool_left", "tool_right")
    robot = fflin.load("dual_arm", constraints=[weld], orbit=orbit)
    q = fflin.closed(robot, robot.neutral())
    lin = fflin.linearize(robot, q, t=100.0)
    assert lin.t == 100.0
    with pytest.raises(fflin.InputError, match="does not depend on time"):
        fflin.lqr(lin)
    with pytest.raises(fflin.InputError, match="over one orbit do not support constr"):
        fflin.linearize_orbit(robot, q)
