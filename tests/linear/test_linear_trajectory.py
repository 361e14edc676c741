"""The linear model along a motion."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import fflin
from fflin.linear import linear_trajectory
from tests.support.motions import motion
from tests.support.robots import mostly, random_point


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
        coarse = fflin.Trajectory(
            robot, *(x[::2] for x in motion(robot, knots=2 * knots - 1))
        )
        apart = [
            np.r_[
                pin.difference(robot.model, coarse.point(at)[0], q),
                coarse.point(at)[1] - v,
            ]
            for at, q, v in zip(t[1::2], fine[1::2], speed[1::2], strict=True)
        ]
        errors.append(np.abs(apart).max())
    assert errors[1] < 1e-6 * np.abs(along.v).max()
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.3)
    assert (along.matrices(along.t[5])[0] == along.A[5]).all()
    assert (along.matrices(along.t[-1])[1] == along.B[-1]).all()
    with pytest.raises(fflin.InputError, match=r"9 s.* 0\.4 s"):
        along.point(9.0)
    with pytest.raises(ValueError, match="read-only"):
        along.A[0] = 0.0


def test_an_inconsistent_motion_is_reported_with_its_time_and_refused_on_request():
    robot = fflin.load("ets_vii")
    t, q, v, u = motion(robot, knots=17)
    jump = q.copy()
    jump[8:, 0] += 0.1
    message = r"not a motion of 'ets_vii': from t = 0\.175 to 0\.2 s the error is \d"
    with pytest.raises(fflin.InputError, match=message):
        fflin.linearize_trajectory(robot, t, jump, v, u, strict=True)
    with pytest.warns(fflin.FflinWarning, match=message):
        along = fflin.linearize_trajectory(robot, t, jump, v, u)
    assert along.residual.argmax() == 7
    assert along.residual[7] > 1.0
    cases = {
        r"t\[1\] is .* s, after .* s; expected increasing": (t[::-1], q, v, u),
        r"q has shape \(16, 19\), expected \(17, 19\)": (t, q[:-1], v, u),
        r"v has shape \(17, 11\), expected \(17, 12\)": (t, q, v[:, 1:], u),
        r"u has shape \(17, 11\), expected \(17, 12\)": (t, q, v, u[:, 1:]),
        "u contains": (t, q, v, "none"),
        r"at t = 0\.05 s: v\[0\] is nan": (
            t,
            q,
            np.where(np.arange(17)[:, None] == 2, np.nan, v),
            u,
        ),
    }
    for words, arguments in cases.items():
        with pytest.raises(fflin.InputError, match=words):
            fflin.linearize_trajectory(robot, *arguments)
    with pytest.raises(fflin.InputError, match="q, v, u"):
        fflin.linearize_trajectory(
            robot, fflin.Trajectory(robot, t, q, v, u), hold="linear"
        )


def test_an_orbit_and_a_fast_wheel_hide_nothing():
    wheel = fflin.ReactionWheel((0, 0, 1), inertia=0.01)
    robot = fflin.load("ets_vii", inputs=[fflin.BaseForce(), wheel])
    t = np.linspace(0.0, 0.1, 6)
    v = np.tile(fflin.velocity(robot, {"v_b.x": 7000.0, "wheel_1": 500.0}), (len(t), 1))
    q0 = fflin.configuration(robot, base=pin.SE3(np.eye(3), np.array([7e6, 0.0, 0.0])))
    q = np.array([pin.integrate(robot.model, q0, time * v[0]) for time in t])
    u = np.zeros((len(t), 4))
    assert fflin.linearize_trajectory(robot, t, q, v, u).residual.max() < 1e-9
    for column in (2, robot.joints[0].idx_v):  # along z; a joint of the arm
        step = 0.01 * np.eye(robot.nv)[column]
        jump = np.array(
            [pin.integrate(robot.model, x, (k >= 3) * step) for k, x in enumerate(q)]
        )
        with pytest.raises(fflin.InputError, match=r"0\.04 to 0\.06 s"):
            fflin.linearize_trajectory(robot, t, jump, v, u, strict=True)
    drifting = v.copy()
    drifting[:, robot.joints[0].idx_v] = 0.01
    with pytest.raises(fflin.InputError, match="motion"):
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


def held_motion(robot, **options):
    """A motion under inputs that are held for 0.1 s each."""
    u = 0.3 * np.random.default_rng(4).normal(size=(4, 6 + robot.n))
    u[:, 6:] *= 0.1
    q0, v0, _ = random_point(robot, np.random.default_rng(1))
    run = fflin.simulate(
        *(robot, lambda t, q, v: u[min(int(10.0 * t + 1e-9), 3)]),
        **{
            "q0": q0,
            "v0": 0.3 * v0,
            "duration": 0.4,
            "dt": 0.002,
            "sample": 0.1,
            "every": 10,
        },
        **options,
    )
    return run.trajectory()


def transition(along, start, end):
    """What the variational equation makes of the error and of a held du, by DOP853."""
    linearizer = fflin.Linearizer(along.robot, moving=True)
    nx, nu = along.B.shape[1:]
    y = np.eye(nx, nx + nu).ravel()
    inner = along.t[(along.t > start + 1e-9) & (along.t < end - 1e-9)]
    for first, last in pairwise([start, *inner, end]):

        def rate(t, y, last=last):
            lin = linearizer(*along.point(min(t, last - 1e-12)))
            held = np.eye(nx + nu)[nx:] + 0.0
            return (lin.A @ y.reshape(nx, -1) + lin.B @ held).ravel()

        y = solve_ivp(
            rate, (first, last), y, method="DOP853", rtol=1e-12, atol=1e-14
        ).y[:, -1]
    return y.reshape(nx, -1)


@pytest.fixture(scope="module", params=["held", "linear"])
def along(request):
    robot = fflin.load("astrobee_arm", gravity=(0.0, 0.1, -0.2), damping=0.05)
    linear = request.param == "linear"
    given = (
        fflin.Trajectory(robot, *motion(robot))
        if linear
        else held_motion(robot, frame="hybrid")
    )
    return fflin.linearize_trajectory(robot, given, strict=True)


@pytest.mark.parametrize("dt", mostly((0.2, 0.05, 0.01), 0.05))
def test_samples_match_the_variational_equation(along, dt):
    sampled = along.discretize(dt)
    count = round(0.4 / dt)
    assert (sampled.dt, len(sampled), len(sampled.t)) == (dt, count, count + 1)
    for k in (0, count // 2, count - 1):
        expected = transition(along, sampled.t[k], sampled.t[k + 1])
        result = np.column_stack((sampled.A[k], sampled.B[k]))
        size = np.abs(expected).max(axis=0)
        assert (np.abs(result - expected) / size).max() < 1e-8
        assert (sampled[k].A == sampled.A[k]).all()
        assert sampled[k].dt == dt
        assert (
            sampled.matrices(float(sampled.t[k]) + 0.3 * dt)[1] == sampled.B[k]
        ).all()


def test_periods_that_do_not_fit_and_sampled_models_are_refused(along):
    sampled = along.discretize(0.1)
    with pytest.raises(fflin.InputError, match=r"0\.3 s"):
        along.discretize(0.3)
    with pytest.raises(fflin.InputError, match=r"0\.1 s"):
        sampled.discretize(0.1)
    with pytest.raises(fflin.InputError, match="sample="):
        fflin.tvlqr(sampled, 1.0, 1.0, 1.0)


def test_a_step_of_the_transition_is_of_order_four(monkeypatch):
    robot = fflin.load("ets_vii")
    t, q, v, u = motion(robot, knots=3)
    along = fflin.linearize_trajectory(robot, fflin.Trajectory(robot, t, q, v, u))
    exact = transition(along, 0.0, 0.2)
    errors = []
    for parts in (1, 2, 4):
        monkeypatch.setattr(linear_trajectory, "_MOST_PARTS", parts)
        result = next(linear_trajectory.transitions(along, 0.2))[1]
        errors.append(np.abs(result - exact).max())
    assert np.log2(np.divide(errors[:-1], errors[1:])) == pytest.approx(
        [4.0, 4.0], abs=0.5
    )


def test_at_rest_samples_match_one_model():
    robot = fflin.load("ets_vii")
    t = np.linspace(0.0, 1.0, 3)
    q = np.tile(robot.neutral(), (3, 1))
    along = fflin.linearize_trajectory(
        robot, t, q, np.zeros((3, 12)), np.zeros((3, 12))
    )
    sampled, lin = (
        along.discretize(0.25),
        fflin.linearize(robot, moving=True).discretize(0.25),
    )
    for k in range(4):
        assert sampled.A[k] == pytest.approx(lin.A, abs=1e-15)
        assert sampled.B[k] == pytest.approx(lin.B, abs=1e-15)


@pytest.fixture(scope="module")
def watched():
    robot = fflin.load(
        "planar_detumble", outputs=[fflin.Gyroscope("base"), fflin.JointPositions()]
    )
    return robot, fflin.linearize_trajectory(robot, held_motion(robot))


def test_its_items_are_the_models_at_the_knots(watched):
    robot, along = watched
    assert (len(along), along.output_names) == (21, along[0].output_names)
    lin = fflin.linearize(robot, along.q[3], along.v[3], along.u_base[3], moving=True)
    for name in "ABCD":
        assert (getattr(along, name)[3] == getattr(lin, name)).all()
    assert (along.y[3] == lin.y0).all()
    assert (
        [model.fingerprint for model in along][3]
        == lin.fingerprint
        == along[3].fingerprint
    )
    assert along[-1].fingerprint == along[20].fingerprint
    with pytest.raises(IndexError):
        along[21]
    assert fflin.check(robot, along[7]).ok


def test_a_check_goes_along_it(watched):
    robot, along = watched
    short = fflin.linearize_trajectory(
        robot, along.t[:4], along.q[:4], along.v[:4], along.u[:3], frame="hybrid"
    )
    result = short.check()
    assert result.ok
    assert "planar_detumble, 4 knots" in str(result)
    item = [fflin.check(robot, lin) for lin in short]
    assert result.max_error == max(check.max_error for check in item)
    wrong = short.A.copy()
    wrong[2, 12, 10] *= 1.0 + 1e-6
    result = replace(short, A=wrong).check()
    assert {(row.test, row.block) for row in result.failures} == {
        ("ABA derivatives", "A[v_b, omega_b]"),
        ("differences", "A[v_b, omega_b]"),
    }
    loose = replace(short, A=wrong).check(tolerance=1e-5)
    assert loose.ok and {row.tolerance for row in loose.rows} == {1e-5}
    assert "4 knots, each error at most 1.0e-05" in str(loose)


@pytest.mark.parametrize("ending", ["npz", "mat", "json"])
def test_it_is_saved_and_loaded(watched, tmp_path, ending):
    robot, along = watched
    for thing in (along, along.discretize(0.05)):
        thing.save(tmp_path / f"ltv.{ending}")
        again = fflin.LinearTrajectory.load(tmp_path / f"ltv.{ending}", robot)
        for name in ("t", "q", "v", "u", "A", "B", "C", "D", "y", "residual"):
            assert (getattr(again, name) == getattr(thing, name)).all()
        assert (again.hold, again.frame, again.dt) == ("previous", "hybrid", thing.dt)
        assert again.verified
        assert again[2].fingerprint == thing[2].fingerprint
    with pytest.raises(fflin.FflinError):
        fflin.LinearTrajectory.load(tmp_path / f"ltv.{ending}", fflin.load("ets_vii"))
    fflin.linearize(robot).save(tmp_path / f"lin.{ending}")
    with pytest.raises(fflin.FileError, match="LinearTrajectory"):
        fflin.LinearTrajectory.load(tmp_path / f"lin.{ending}", robot)
    with pytest.raises(fflin.FileError, match=r"'\.csv'"):
        along.save(tmp_path / "ltv.csv")
