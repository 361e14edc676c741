"""The linear model along a motion."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import fflin
from tests.support.motions import motion


def test_knots_are_the_moving_models_and_errors_are_carried_along():
    robot = fflin.load("astrobee_arm", gravity=(0.0, 0.1, -0.2), damping=0.05)
    t, q, v, u = motion(robot)
    along = fflin.linearize_trajectory(robot, t, q, v, u)
    assert along.residual.max() < 1e-2 and len(along.residual) == len(t)
    lin = fflin.linearize(robot, q[30], v[30], u[30], moving=True)
    assert (along.A[30] == lin.A).all() and (along.B[30] == lin.B).all()
    assert along.state_names == lin.state_names

    # A second motion from a nearby start: its error is what the time-varying model carries.
    def error(knot, q1, v1):
        reference = pin.XYZQUATToSE3(q[knot][:7])
        relative = fflin.StateMap(robot, reference=reference, frame="local")
        return relative.to_state(q1, v1) - relative.to_state(q[knot], v[knot])

    dx = 1e-6 * np.random.default_rng(2).normal(size=len(lin.x0))
    first = fflin.StateMap(robot, reference=pin.XYZQUATToSE3(q[0][:7]), frame="local")
    q1, v1 = first.to_pinocchio(first.to_state(q[0], v[0]) + dx)
    _, q_near, v_near, _ = motion(robot, (q1, v1))
    solution = solve_ivp(
        lambda time, y: along.matrices(min(time, t[-1]))[0] @ y,
        (t[0], t[-1]),
        dx,
        rtol=1e-10,
        atol=1e-14,
    ).y[:, -1]
    # Matrices that are linear between knots leave 1e-5 of it, the second order in dx 1e-6.
    drift = error(-1, q_near[-1], v_near[-1])
    assert drift == pytest.approx(solution, abs=1e-4 * np.abs(solution).max())


def test_interpolation_is_on_the_manifold():
    robot = fflin.load("ets_vii")
    along = fflin.linearize_trajectory(robot, *motion(robot))
    middle = 0.5 * (along.t[3] + along.t[4])
    q, _, _ = along.point(middle)
    assert robot.checked_configuration(q) is not None
    assert np.linalg.norm(q[3:7]) == pytest.approx(1.0, abs=1e-14)
    # A motion of which every second knot is left out: order four.
    errors = []
    for knots in (21, 41):
        t, fine, speed, _ = motion(robot, knots=2 * knots - 1)
        coarse = fflin.Trajectory(robot, *(x[::2] for x in motion(robot, knots=2 * knots - 1)))
        apart = [
            np.r_[pin.difference(robot.model, coarse.point(at)[0], q), coarse.point(at)[1] - v]
            for at, q, v in zip(t[1::2], fine[1::2], speed[1::2], strict=True)
        ]
        errors.append(np.abs(apart).max())
    assert errors[1] < 1e-6 * np.abs(along.v).max()
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.3)
    assert (along.matrices(along.t[5])[0] == along.A[5]).all()
    assert (along.matrices(along.t[-1])[1] == along.B[-1]).all()
    with pytest.raises(fflin.InputError, match=r"t is 9 s, expected 0 to 0\.4 s"):
        along.point(9.0)
    with pytest.raises(ValueError, match="read-only"):
        along.A[0] = 0.0


def test_what_is_no_motion_is_told_with_the_time_and_refused_where_asked():
    robot = fflin.load("ets_vii")
    t, q, v, u = motion(robot)
    jump = q.copy()
    jump[40:, 0] += 0.1
    said = r"not quite a motion of 'ets_vii': from t = 0\.195 to 0\.2 s they miss it by \d"
    with pytest.raises(fflin.InputError, match=said):
        fflin.linearize_trajectory(robot, t, jump, v, u, strict=True)
    with pytest.warns(fflin.FflinWarning, match=said):
        along = fflin.linearize_trajectory(robot, t, jump, v, u)
    assert along.residual.argmax() == 39
    assert along.residual[39] > 10.0
    cases = {
        "each later than the one before": (t[::-1], q, v, u),
        r"q has shape \(80, 19\), expected \(81, 19\)": (t, q[:-1], v, u),
        r"v has shape \(81, 11\), expected \(81, 12\)": (t, q, v[:, 1:], u),
        r"u has shape \(81, 11\), expected \(81, 12\)": (t, q, v, u[:, 1:]),
        "u holds": (t, q, v, "none"),
        r"at t = 0\.01 s: v\[0\] is nan": (
            t,
            q,
            np.where(np.arange(81)[:, None] == 2, np.nan, v),
            u,
        ),
    }
    for words, arguments in cases.items():
        with pytest.raises(fflin.InputError, match=words):
            fflin.linearize_trajectory(robot, *arguments)
    with pytest.raises(fflin.InputError, match="the trajectory has q, v, u"):
        fflin.linearize_trajectory(robot, fflin.Trajectory(robot, t, q, v, u), hold="linear")


def test_an_orbit_and_a_fast_wheel_hide_nothing():
    wheel = fflin.ReactionWheel((0, 0, 1), inertia=0.01)
    robot = fflin.load("ets_vii", inputs=[fflin.BaseForce(), wheel])
    t = np.linspace(0.0, 1.0, 51)
    v = np.tile(fflin.velocity(robot, {"v_b.x": 7000.0, "wheel_1": 500.0}), (len(t), 1))
    q0 = fflin.configuration(robot, base=pin.SE3(np.eye(3), np.array([7e6, 0.0, 0.0])))
    q = np.array([pin.integrate(robot.model, q0, time * v[0]) for time in t])
    u = np.zeros((len(t), 4))
    assert fflin.linearize_trajectory(robot, t, q, v, u).residual.max() < 1e-9
    for column in (2, robot.joints[0].idx_v):  # along z; a joint of the arm
        step = 0.01 * np.eye(robot.nv)[column]
        jump = np.array([pin.integrate(robot.model, x, (k >= 25) * step) for k, x in enumerate(q)])
        with pytest.raises(fflin.InputError, match=r"from t = 0\.48 to 0\.5 s"):
            fflin.linearize_trajectory(robot, t, jump, v, u, strict=True)
    drifting = v.copy()
    drifting[:, robot.joints[0].idx_v] = 0.01
    with pytest.raises(fflin.InputError, match="not quite a motion"):
        fflin.linearize_trajectory(robot, t, q, drifting, u, strict=True)


def test_an_orbit_changes_no_residual():
    robot = fflin.load("ets_vii")
    t, q, v, u = motion(robot)
    still = fflin.linearize_trajectory(robot, t, q, v, u).residual
    q[:, :3] += np.outer(t, [0.0, 7000.0, 100.0])
    v[:, :3] += [pin.Quaternion(x[3:7]).matrix().T @ [0.0, 7000.0, 100.0] for x in q]
    orbit = fflin.linearize_trajectory(robot, t, q, v, u).residual
    assert orbit == pytest.approx(still, rel=1e-2)


def test_holding_still_in_gravity_is_a_motion():
    robot = fflin.load("servicer_7dof", gravity=(0.3, 0.2, -9.81), stiffness=20.0)
    q = fflin.configuration(robot, {"joint_2": 0.7, "joint_4": -0.4, "panel_left": 0.2})
    u = fflin.equilibrium(robot, q).u
    t = np.linspace(0.0, 1.0, 5)
    still = (np.tile(x, (len(t), 1)) for x in (q, np.zeros(robot.nv), u))
    assert fflin.linearize_trajectory(robot, t, *still).residual.max() < 1e-9
