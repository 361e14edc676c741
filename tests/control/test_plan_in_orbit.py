"""Plans of robots in circular and elliptic orbits, relative to the orbital frame."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import fflin
from fflin.control.optimal.shooting import Shooting
from tests.support.orbits import N, in_ellipse, in_orbit
from tests.support.robots import free_body

MASS = 50.0  # kg, of `free_body`
INERTIA = (4.0, 6.0, 7.0)  # kg m^2


def orbiting(robot, eccentricity):
    """Return a robot in an orbit with an eccentricity."""
    return in_ellipse(robot, eccentricity) if eccentricity else in_orbit(robot)


def relative_motion(eccentricity, t, end):
    """Return Phi (6, 6) and Gamma (6, 3): the motion of a free mass in the axes lvlh over a time.

    Gamma is for unit accelerations that are constant in the axes of a body that turns freely, at
    rest at t = 0. The equations are Newton's in the rotating frame, with the gravity gradient; the
    orbit is integrated along with them.
    """
    mu = N**2 * 1e18
    parameter = 1e6 * (1.0 - eccentricity**2)
    momentum = np.sqrt(mu * parameter)
    normal = np.array((0.0, -1.0, 0.0))
    upward = np.array((0.0, 0.0, -1.0))
    turn = np.cross(normal, np.eye(3)).T  # the cross product with the orbit normal
    spin_at_start = momentum / (parameter / (1.0 + eccentricity)) ** 2

    def rate(time, y):
        anomaly, x = y[0], y[1:].reshape(6, 9)
        radius = parameter / (1.0 + eccentricity * np.cos(anomaly))
        climb = mu / momentum * eccentricity * np.sin(anomaly)
        spin = momentum / radius**2
        spin_change = -2.0 * spin * climb / radius
        gravity = mu / radius**3 * (3.0 * np.outer(upward, upward) - np.eye(3))
        pull = gravity - spin**2 * turn @ turn - spin_change * turn
        change = np.vstack((x[3:], pull @ x[:3] - 2.0 * spin * turn @ x[3:]))
        body = pin.exp3((time * spin_at_start - anomaly) * normal)
        change[3:, 6:] += body
        return np.append(spin, change.ravel())

    def anomaly_at(time):
        if not time:
            return 0.0
        start = np.append(0.0, np.zeros(54))
        return solve_ivp(rate, (0.0, time), start, rtol=1e-11, atol=1e-12).y[0, -1]

    begin = np.append(anomaly_at(t), np.eye(6, 9).ravel())
    found = solve_ivp(rate, (t, end), begin, rtol=1e-11, atol=1e-12).y[1:, -1]
    found = found.reshape(6, 9)
    return found[:, :6], found[:, 6:]


@pytest.mark.exhaustive
@pytest.mark.parametrize("eccentricity", [0.0, 0.3])
def test_a_transfer_has_the_least_effort_of_the_relative_motion(eccentricity):
    """Of all held forces that reach the goal, the plan has the least, which is a projection."""
    robot = free_body((5.0, 5.0, 5.0)).replace(inputs=[fflin.BaseForce()])
    robot = orbiting(robot, eccentricity)
    base = pin.SE3(np.eye(3), np.array((3.0, -1.0, 2.0)))
    start = fflin.configuration(robot, base=base)
    duration = 6.0  # rotates the orbital frame by more than 1.8 rad
    options = {"q0": start, "knots": 5, "free": ["q_b", "omega_b"]}
    motion = fflin.plan(robot, (None, None), duration, **options)
    effect = np.zeros((6, 0))
    state = np.r_[start[:3], np.zeros(3)]
    for t, end in zip(motion.t[:-1], motion.t[1:], strict=True):
        phi, gamma = relative_motion(eccentricity, t, end)
        effect = np.hstack((phi @ effect, gamma / MASS))
        state = phi @ state
    force = np.linalg.lstsq(effect, -state, rcond=None)[0].reshape(-1, 3)
    assert motion.u[:-1] == pytest.approx(force, abs=1e-5 * np.abs(force).max())


def test_derivatives_of_intervals_in_an_elliptic_orbit_match_the_flow():
    """The dynamics depend on time, so each interval must have its own time."""
    robot = in_ellipse(free_body(INERTIA), 0.3)
    t = np.array((0.0, 1.0, 2.0, 3.0))
    shooting = Shooting(robot, t, True)
    shooting.steps = 16
    random = np.random.default_rng(2)
    u = random.normal(size=(4, 6)) * np.array((1.0, 1.0, 1.0, 5.0, 5.0, 5.0))
    v = 0.1 * random.normal(size=6)
    q, v = shooting.flown((robot.neutral(), v), u)
    A, B, _ = np.split(shooting.jacobians(q, v, u)[0], (12, 18), axis=2)

    def ends(z, du):
        knots = shooting.moved(q, v, z)
        return shooting.missed(*knots, shooting.motions(*knots, u + du))[2]

    z = np.zeros((4, 12))
    du = np.zeros((4, 6))
    z[2], du[2] = 1e-4 * random.normal(size=12), 1e-3 * random.normal(size=6)
    change = 0.5 * (ends(z, du) - ends(-z, -du))
    expected = A[2] @ z[2] + B[2] @ du[2]
    assert change == pytest.approx(expected, abs=1e-3 * np.abs(expected).max())


def slew(robot, angles, knots):
    """Return the plan of a slew about all axes, and its goal."""
    robot = robot.replace(inputs=[fflin.BaseTorque()])
    goal = fflin.configuration(robot, rpy=angles)
    free = ["r_b", "v_b"]
    return fflin.plan(robot, (goal, None), 7.0, knots=knots, free=free), goal


@pytest.mark.exhaustive
@pytest.mark.parametrize("eccentricity", [0.0, 0.3])
def test_a_slew_in_orbit_flown_open_loop_ends_where_the_plan_says(eccentricity):
    """The slew takes a third of an orbit."""
    motion, goal = slew(orbiting(free_body(INERTIA), eccentricity), (40, -25, 60), 4)
    assert motion.optimality.stationarity < 1e-3
    robot = motion.robot
    h = motion.t[1]
    flown = fflin.simulate(
        robot,
        lambda t, q, v: motion.u[min(round(t / h), 3)],
        duration=7.0,
        sample=h,
        dt=h / 24,
        frame="local",
    )
    error = pin.difference(robot.model, goal, flown.q[-1])
    assert np.abs(error[3:]).max() < 1e-6
    assert np.abs(flown.v[-1, 3:]).max() < 1e-6


def test_a_law_follows_a_robot_that_is_held_in_orbit():
    """The reference torque balances the gravity gradient, so the feedback has nothing to do."""
    robot = in_orbit(free_body(INERTIA).replace(inputs=[fflin.BaseTorque()]))
    held = fflin.equilibrium(robot, fflin.configuration(robot, rpy=(30, 20, 10)))
    assert np.abs(held.u).max() > 0.1
    q, u = (np.tile(row, (2, 1)) for row in (held.q, held.u))
    trajectory = fflin.Trajectory(robot, [0.0, 1.0], q, np.zeros((2, 6)), u)
    model = fflin.linearize(robot).discretize(0.25)
    gain = np.zeros((3, 12))
    gain[:, :3], gain[:, 6:9] = 40.0 * np.eye(3), 15.0 * np.eye(3)
    policy = fflin.StateFeedback(model, gain).follow(trajectory)
    motion = fflin.simulate(robot, policy, duration=2.0, dt=0.05)
    assert np.radians(motion.attitude_error.max()) < 1e-9


@pytest.mark.exhaustive
def test_a_plan_in_a_slow_orbit_is_the_plan_without_an_orbit():
    free = free_body(INERTIA)
    slow, none = (
        slew(robot, (4, -3, 6), 4)[0].u for robot in (in_orbit(free, 1e-9), free)
    )
    assert slow == pytest.approx(none, abs=1e-6 * np.abs(none).max())


def test_magnetorquers_and_constraints_are_refused_in_orbit():
    body = free_body(INERTIA).replace(
        inputs=[fflin.Magnetorquer(axis=axis) for axis in np.eye(3)],
        orbit=fflin.CircularOrbit(5e5, field="dipole"),
    )
    with pytest.raises(fflin.InputError, match=r"magnetorquers.* give other inputs"):
        fflin.plan(body, (None, None), 10.0)
    mast = fflin.load("scissor_mast", orbit=5e5)
    with pytest.raises(fflin.InputError, match="robots with constraints are defined"):
        fflin.plan(mast, (None, None), 10.0)


def test_a_trajectory_in_hill_axes_is_refused():
    robot = in_orbit(free_body(INERTIA))
    q = np.tile(robot.neutral(), (2, 1))
    zero = np.zeros((2, 6))
    with pytest.raises(fflin.InputError, match="relative to the axes lvlh"):
        fflin.Trajectory(robot, [0.0, 1.0], q, zero, zero, frame="hill")


def test_a_trajectory_in_an_elliptic_orbit_is_flown_at_its_time():
    robot = in_ellipse(free_body(INERTIA), 0.3)
    q = np.tile(robot.neutral(), (2, 1))
    zero = np.zeros((2, 6))
    trajectory = fflin.Trajectory(robot, [1.0, 2.0], q, zero, zero)
    along = fflin.linearize_trajectory(robot, trajectory)
    with pytest.raises(fflin.EquilibriumError, match="would vary; give Q, R and Qf"):
        fflin.tvlqr(along, 1.0, 1.0, sample=0.5)
    schedule = fflin.tvlqr(along, 1.0, 1.0, np.eye(12), sample=0.5)
    policy = fflin.TrajectoryFeedback(along, schedule)
    with pytest.raises(fflin.InputError, match="begins at t = 1 s"):
        fflin.simulate(robot, policy)
