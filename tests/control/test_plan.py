"""Planned motions: closed forms of the least effort, limits, goals, and what is refused."""

import re

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import minimize

import fflin
from fflin.control import plan as planning
from fflin.control.optimal import plan_search
from fflin.control.optimal.floating_base import FloatingBase
from fflin.control.optimal.joint_loops import rotation_axes
from fflin.control.optimal.shooting import Shooting
from fflin.dynamics.impact import momentum_of
from tests.support.marks import exhaustive
from tests.support.messages import any_wording
from tests.support.speeds import between_knots, largest_speeds


def turned(robot, angle, axis=(0.0, 0.0, 1.0), joints=None, at=(0.0, 0.0, 0.0)):
    base = pin.SE3(pin.AngleAxis(angle, np.array(axis)).matrix(), np.array(at))
    return fflin.configuration(robot, joints, base)


def missed(robot, motion, q, v=None):
    v = np.zeros(robot.nv) if v is None else v
    way = pin.difference(robot.model, q, motion.q[-1])
    return max(np.abs(way).max(), np.abs(motion.v[-1] - v).max())


@pytest.fixture(scope="module")
def cube():
    robot = fflin.load(
        "cubesat", inputs=[fflin.BaseTorque(max=1e-3), fflin.BaseForce()]
    )
    return robot, fflin.linearize(robot).M[2, 2]


@pytest.mark.parametrize("angle", [np.pi, -2.0, *exhaustive(0.5, 3.0)])
def test_least_effort_about_an_axis_has_the_closed_form(cube, angle):
    """Held over steps of h, N of them: u = 6 J angle (N - 1 - 2 k) / (h^2 N (N^2 - 1)), which tends
    to 6 J angle (1 - 2 t / T) / T^2; a turn of pi is no edge."""
    robot, inertia = cube
    count, T = 40, 60.0
    goal = turned(robot, angle)
    motion = fflin.plan(robot, (goal, None), T, knots=count + 1)
    k = np.arange(count)
    h = T / count
    exact = (
        6.0 * inertia * angle * (count - 1 - 2 * k) / (h**2 * count * (count**2 - 1))
    )
    # A goal of pi may be reached either way round.
    u = motion.u[:-1, 2] * np.sign(motion.u[0, 2] * angle)
    size = np.abs(exact).max()
    assert u == pytest.approx(exact, abs=1e-6 * size)
    assert np.abs(np.delete(motion.u, 2, axis=1)).max() < 1e-8 * size
    assert missed(robot, motion, goal) < 1e-8 and motion.residual.max() < 1e-8
    assert (motion.hold, motion.frame) == ("previous", "local")
    limit = 6.0 * inertia * angle / T**2
    assert abs(exact[0] / limit - 1.0) == pytest.approx(1.0 / (count + 1), rel=1e-9)


def test_least_effort_of_linear_inputs_has_the_closed_form(cube):
    """Of inputs linear in between, u = c (s - T / 2), with s the time to go from where what an
    input adds has its centre: at its knot, or a third of a step inside at both ends."""
    robot, inertia = cube
    motion = fflin.plan(
        robot, (turned(robot, 1.0), None), 30.0, knots=31, hold="linear"
    )
    share, left = np.ones(31), 30.0 - motion.t
    share[[0, -1]] = 0.5
    left[[0, -1]] += (-1.0 / 3.0, 1.0 / 3.0)
    exact = inertia * (left - 15.0) / (share @ (left * (left - 15.0)))
    assert motion.u[:, 2] == pytest.approx(exact, abs=1e-6 * exact[0])
    assert motion.hold == "linear" and motion.residual.max() < 1e-8


@pytest.mark.exhaustive
def test_a_turn_in_the_least_time_takes_all_there_is(cube):
    """T = 2 sqrt(J angle / u_max) is the least time; what is less misses the goal."""
    robot, inertia = cube
    least = 2.0 * np.sqrt(inertia / 1e-3)
    goal = turned(robot, 1.0)
    motion = fflin.plan(robot, (goal, None), 1.001 * least, knots=41)
    u = motion.u[:-1, 2]
    assert np.abs(u).max() <= 1e-3
    assert (np.abs(u) >= 1e-3 * (1 - 1e-6)).sum() >= 36 and (
        np.diff(np.sign(u)) != 0
    ).sum() == 1
    assert missed(robot, motion, goal) < 1e-6
    with any_wording(), pytest.raises(fflin.InputError, match=r"omega_b.z .*0\.00\d+"):
        fflin.plan(robot, (goal, None), 0.99 * least, knots=21)
    # At half the time the turn that is reached is a quarter or less.
    with (
        any_wording(),
        pytest.raises(fflin.InputError, match=r"attitude about z .*0\.\d+"),
    ):
        fflin.plan(robot, (goal, None), 0.5 * least, knots=21)


DETUMBLE = {"omega_b.y": 0.1, "joint_1": -0.05, "joint_2": 0.08}


@pytest.fixture(scope="module")
def servicer():
    """A tumbling chain with damping, springs and gravity, and where it is to end."""
    robot = fflin.load(
        *("planar_detumble",),
        damping="urdf",
        stiffness={"joint_1": 0.5},
        gravity=(0.01, 0, 0.02),
    )
    return (
        robot,
        fflin.velocity(robot, DETUMBLE),
        turned(robot, 0.4, (0, 1, 0), {"joint_2": 0.9}),
    )


@pytest.mark.exhaustive
@pytest.mark.parametrize("hold", ["previous", "linear"])
def test_a_tumble_ends_within_limits(hold):
    robot = fflin.load(
        *("planar_detumble",),
        lock=["joint_3"],
        damping="urdf",
        stiffness={"joint_1": 0.5},
        gravity=(0.01, 0, 0.02),
    )
    v, goal = (
        fflin.velocity(robot, DETUMBLE),
        turned(robot, 0.4, (0, 1, 0), {"joint_2": 0.9}),
    )
    limits = {"tau_b": 5.0, "F_b": 3.5, "tau_m": 2.5}
    options = {"v0": v, "knots": 21, "hold": hold, "limits": limits}
    motion = fflin.plan(robot, (goal, None), 20.0, **options)
    assert missed(robot, motion, goal) < 1e-6
    assert (motion.q[0] == robot.neutral()).all() and (motion.v[0] == v).all()
    assert motion.residual.max() < 1e-6
    size = np.repeat([5.0, 3.5, 2.5], [3, 3, 2])
    assert (np.abs(motion.u) <= size).all() and (np.abs(motion.u) >= 0.999 * size).any()
    loose = fflin.plan(
        robot, (goal, None), 20.0, **options | {"limits": None, "R": size**-2.0}
    )
    assert (np.abs(loose.u) > 1.01 * size).any()
    effort = (np.square(motion.u / size).sum(), np.square(loose.u / size).sum())
    assert effort[0] >= 0.99 * effort[1]


@pytest.mark.exhaustive
def test_a_planned_motion_is_simulated(servicer, tmp_path, monkeypatch):
    """The simulator under the same inputs ends where the plan does; the file says hold and axes."""
    monkeypatch.setattr(plan_search, "_MOST", 5)  # it need not be a minimum
    robot, v, goal = servicer
    motion = fflin.plan(robot, (goal, None), 20.0, v0=v, knots=41, limits=None)
    dt = motion.t[1]

    def policy(t, q, v):
        return motion.u[min(int(t / dt + 1e-9), 39)]

    run = fflin.simulate(
        robot, policy, v0=v, duration=20.0, dt=dt / 20, sample=dt, frame="local"
    )
    assert missed(robot, motion, run.q[-1], run.v[-1]) < 1e-5
    motion.save(tmp_path / "plan.csv")
    header, first, *_ = (tmp_path / "plan.csv").read_text().splitlines()
    saved = dict(zip(header.split(","), first.split(","), strict=True))
    assert (saved["hold"], saved["frame"]) == ("previous", "local")
    assert header.endswith(",sha256")
    read = fflin.Trajectory.load(tmp_path / "plan.csv", robot)
    assert (read.u == motion.u).all() and (read.hold, read.frame) == (
        "previous",
        "local",
    )


@pytest.mark.exhaustive
def test_joints_keep_within_their_speeds_and_travels():
    moving = ("joint_1", "joint_4")
    locked = [f"joint_{i}" for i in range(1, 8) if f"joint_{i}" not in moving]
    robot = fflin.load("servicer_7dof", lock=["panel_*", *locked])
    goal = turned(robot, 0.5, (1, 0, 0), {"joint_1": 1.5, "joint_4": -1.0})
    options = {"knots": 11, "limits": ["urdf", {"tau_b": 60.0, "F_b": 40.0}]}
    motion = fflin.plan(robot, (goal, None), 10.0, **options)
    speeds = np.abs(motion.v[:, 6:])
    assert (speeds <= robot.model.velocityLimit[6:] + 1e-6).all()
    # Without the limit it would pass it.
    assert speeds[:, 0].max() == pytest.approx(0.2, abs=1e-6)
    assert missed(robot, motion, goal) < 1e-6
    with any_wording(), pytest.raises(fflin.InputError, match="limits"):
        fflin.plan(robot, (goal, None), 4.0, **options)


SPEEDS = {"qdot_m": 0.13, "tau_b": 20.0, "F_b": 20.0, "tau_m": 20.0}


@pytest.fixture(scope="module")
def one_joint():
    robot = fflin.load("planar_detumble", lock=["joint_2", "joint_3"])
    return robot, fflin.configuration(robot, {"joint_1": 1.0})


@pytest.mark.parametrize(("knots", "spin"), [(11, 0.2), *exhaustive((6, 0.0))])
@pytest.mark.exhaustive
def test_speeds_keep_within_limits_between_knots(one_joint, knots, spin):
    """Linear torques bend the speeds between knots, beyond limits that the knots keep."""
    (robot, goal), limit = one_joint, SPEEDS["qdot_m"]
    options = {"knots": knots, "hold": "linear", "limits": SPEEDS}
    v0 = fflin.velocity(robot, {"omega_b.z": spin})
    motion = fflin.plan(robot, (goal, None), 10.0, v0=v0, **options)
    # The same again, to the last bit.
    again = fflin.plan(robot, (goal, None), 10.0, v0=v0, **options)
    assert (again.u == motion.u).all() and (again.q == motion.q).all()
    largest = largest_speeds(motion)[0]
    assert 0.97 * limit < largest <= 1.01 * limit
    assert missed(robot, motion, goal) < 1e-6
    message = " ".join(str(motion).split())
    assert "integrated motion exceeds" in message
    if result := re.search(r"exceeds the limit of qdot_m\.joint_1 by (\S+) %", message):
        assert largest >= (1.0 + 0.009 * float(result[1])) * limit


@pytest.mark.exhaustive
def test_a_violation_that_is_left_is_printed_as_it_was_computed(one_joint, monkeypatch):
    """Of a motion whose limits hold at knots alone: with a warning, unless that much is allowed."""
    robot, goal = one_joint
    options = {"knots": 6, "hold": "linear", "limits": SPEEDS}
    monkeypatch.setattr("fflin.control.optimal.plan_search._LIMITED", np.inf)
    monkeypatch.setattr("fflin.control.plan._BETWEEN", 0.1)
    motion = fflin.plan(robot, (goal, None), 10.0, **options)
    result = re.search(
        r"exceeds the limit of qdot_m\.joint_1 by (\S+) %",
        " ".join(str(motion).split()),
    )
    ends = [[v[6] for _, v in between_knots(motion, k, 128)] for k in range(5)]
    fine = np.ravel(ends)[7::8]
    assert result and float(result[1]) > 3.0
    assert max(fine) / 0.13 - 1.0 == pytest.approx(0.01 * float(result[1]), rel=0.02)
    monkeypatch.setattr("fflin.control.plan._BETWEEN", 0.01)
    with pytest.warns(
        fflin.FflinWarning, match=r"qdot_m\.joint_1 by \S+ % at t = \S+ s"
    ):
        left = fflin.plan(robot, (goal, None), 10.0, **options)
    assert str(left) == str(motion)


def test_limits_that_cannot_hold_between_knots_hold_at_knots(one_joint):
    """Torques linear over 3.3 s cannot move the joint within 1.15 of its mean speed."""
    robot, goal = one_joint
    limits = SPEEDS | {"qdot_m": 0.115}
    with (
        any_wording(),
        pytest.warns(fflin.FflinWarning, match=r"qdot_m\.joint_1 by \S+ % at"),
    ):
        motion = fflin.plan(
            robot, (goal, None), 10.0, knots=4, hold="linear", limits=limits
        )
    assert np.abs(motion.v[:, 6]).max() <= 0.115 + 1e-6 < largest_speeds(motion).max()
    assert missed(robot, motion, goal) < 1e-6


@pytest.mark.parametrize("knots", [4, *exhaustive(5, 31)])
@pytest.mark.exhaustive
def test_few_knots_keep_limits_between_them(one_joint, knots):
    robot, goal = one_joint
    options = {"knots": knots, "hold": "linear", "limits": SPEEDS}
    motion = fflin.plan(robot, (goal, None), 10.0, **options)
    assert motion.t == pytest.approx(np.linspace(0.0, 10.0, knots), abs=1e-12)
    assert largest_speeds(motion).max() <= 1.01 * SPEEDS["qdot_m"]
    assert missed(robot, motion, goal) < 1e-6 and motion.residual.max() < 1e-6


@pytest.mark.parametrize("duration", [5.0, *exhaustive(3.0)])
@pytest.mark.exhaustive
def test_an_infeasible_plan_gives_up_and_names_the_limit(
    one_joint, monkeypatch, duration
):
    """A joint needs 1 rad / (0.13 rad/s) = 7.7 s; the search stops after ten iterations in vain."""
    jacobians, iterations = Shooting.jacobians, []

    def counted(*arguments):
        iterations.append(1)
        return jacobians(*arguments)

    monkeypatch.setattr(Shooting, "jacobians", counted)
    robot, goal = one_joint
    with (
        any_wording(),
        pytest.raises(fflin.InputError, match=r"joint_1.*longer duration"),
    ):
        fflin.plan(robot, (goal, None), duration, knots=21, limits=SPEEDS)
    assert len(iterations) <= 24  # with and without the points between knots


@pytest.mark.exhaustive
def test_the_values_nearest_to_their_limits_are_printed(one_joint):
    robot, goal = one_joint
    limits = {"qdot_m": 0.2, "tau_b": [-30.0, 20.0], "tau_m": 25.0}
    motion = fflin.plan(robot, (goal, None), 10.0, knots=5, limits=limits)
    *_, message = " ".join(str(motion).split()).partition(
        "nearest to their limits at the knots: "
    )
    names = fflin.linearize(robot).input_names
    u = dict(zip(names, motion.u.T, strict=True))
    torque = np.array([u[f"tau_b.{axis}"] for axis in "xyz"])
    share = np.where(torque > 0.0, torque / 20.0, -torque / 30.0)
    axis, at = np.unravel_index(share.argmax(), share.shape)
    limit = 20 if torque[axis, at] > 0.0 else 30
    assert message.split(", ") == [
        f"qdot_m.joint_1 {np.abs(motion.v[:, 6]).max():.3g} of 0.2 rad/s",
        f"tau_b.{'xyz'[axis]} {abs(torque[axis, at]):.3g} of {limit} N m",
        f"tau_m.joint_1 {np.abs(u['tau_m.joint_1']).max():.3g} of 25 N m",
    ]
    assert max(map(len, str(motion).splitlines())) <= 80
    assert "nearest" not in str(
        fflin.plan(robot, (goal, None), 10.0, knots=4, limits=None)
    )


@pytest.mark.exhaustive
def test_a_light_arm_keeps_its_speeds_between_knots(monkeypatch):
    """Held for 2 s, its torques take light joints far beyond their speeds and back."""
    monkeypatch.setattr(plan_search, "_MOST", 20)  # it need not be a minimum
    # The same slew with 41 knots is on the page of the guide about tracking.
    lock = ["panel_*", "joint_1", "joint_3", "joint_5"]
    robot = fflin.load("servicer_7dof", lock=lock, limits={"tau_b": 60.0, "F_b": 40.0})
    goal = turned(robot, 1.2, joints={"joint_2": 0.6, "joint_4": -1.1})
    motion = fflin.plan(robot, (goal, None), 60.0, knots=31)
    assert len(motion.t) == 31
    assert (largest_speeds(motion) <= 1.01 * robot.model.velocityLimit[6:]).all()
    assert missed(robot, motion, goal) < 1e-6 and motion.residual.max() < 1e-6


@pytest.mark.parametrize(
    ("end", "words"),
    [
        ({"q_m.joint_1": 1.2}, ("goal", "q_m.joint_1", "1.2 rad", "1 rad")),
        (
            {"qdot_m.joint_1": -0.3},
            ("goal", "qdot_m.joint_1", "-0.3 rad/s", "-0.2 rad/s"),
        ),
    ],
)
def test_a_start_or_goal_outside_a_limit_is_refused_before_planning(
    one_joint, monkeypatch, end, words
):
    robot, _ = one_joint
    state = fflin.StateMap(robot)
    x = np.zeros(state.nx)
    for name, value in end.items():
        x[state.names.index(name)] = value
    monkeypatch.setattr("fflin.control.plan.Search", None)  # the work
    limits = {"q_m": 1.0, "qdot_m": 0.2}
    with pytest.raises(fflin.InputError, match="limit") as messages:
        fflin.plan(robot, x, 10.0, limits=limits)
    assert all(word in str(messages.value) for word in words) and "\n" not in str(
        messages.value
    )
    with pytest.raises(fflin.InputError, match="start"):
        fflin.plan(robot, (None, None), 10.0, x0=x, limits=limits)


@pytest.mark.exhaustive
def test_wheels_rotate_a_body_and_may_keep_momentum(tmp_path):
    """Only wheels act, so that the turn's momentum is theirs, and angles of wheels are no goal."""
    wheels = [fflin.ReactionWheel(axis, inertia=1e-4, max=1e-3) for axis in np.eye(3)]
    robot = fflin.load("cubesat", inputs=wheels)
    v = fflin.velocity(robot, {"omega_b.z": 0.02, "wheel_1": 50.0})
    goal = turned(robot, 0.8, (0.6, 0.0, 0.8))
    free = ["r_b", "v_b"]
    motion = fflin.plan(robot, (goal, None), 30.0, v0=v, knots=31, free=free)
    assert np.abs(pin.difference(robot.model, goal, motion.q[-1])[3:6]).max() < 1e-6
    assert np.abs(motion.v[-1, 3:6]).max() < 1e-6 and motion.residual.max() < 1e-6
    with any_wording(), pytest.raises(fflin.InputError, match="`free`"):
        fflin.plan(robot, (goal, np.zeros(robot.nv)), 30.0, v0=v, knots=31, free=free)


CUBE_AXES = np.eye(3)
PYRAMID_AXES = np.array(
    [[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [-1.0, -1.0, 1.0], [1.0, -1.0, 1.0]]
)
FREE_OF_WHEELS = ["r_b", "v_b", "omega_b"]


def with_wheels(axes, inertia=2e-4, **options):
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    wheels = [fflin.ReactionWheel(axis, inertia=inertia, **options) for axis in axes]
    return fflin.load("cubesat", inputs=wheels), axes


@pytest.mark.parametrize(
    ("axes", "degrees"),
    [
        (PYRAMID_AXES, 30.0),
        *exhaustive((CUBE_AXES, 1.0), (CUBE_AXES, 30.0), (PYRAMID_AXES, 1.0)),
    ],
)
def test_a_slew_from_rest_with_wheels_alone_has_the_closed_form(axes, degrees):
    """About a principal axis, the motion is that of a double integrator. Its torque is that of the
    wheels, distributed with the least norm. The inertia of the rotors about their axes is not
    accelerated by the torque."""
    robot, axes = with_wheels(axes)
    angle = np.radians(degrees)
    goal = turned(robot, angle)
    count, T = 20, 60.0
    motion = fflin.plan(robot, (goal, None), T, knots=count + 1, free=FREE_OF_WHEELS)
    J = fflin.linearize(robot).M[2, 2] - 2e-4 * np.square(axes[:, 2]).sum()
    k = np.arange(count)
    h = T / count
    torque = 6.0 * J * angle * (count - 1 - 2 * k) / (h**2 * count * (count**2 - 1))
    exact = -np.outer(torque, np.linalg.pinv(axes.T)[:, 2])
    assert motion.u[:-1] == pytest.approx(exact, abs=1e-6 * np.abs(exact).max())
    assert np.abs(pin.difference(robot.model, goal, motion.q[-1])[3:6]).max() < 1e-8
    assert np.abs(motion.v[-1]).max() < 1e-9 and motion.residual.max() < 1e-8


@pytest.mark.parametrize("axes", [CUBE_AXES, *exhaustive(PYRAMID_AXES)])
def test_wheels_alone_slew_about_any_axis_within_limits(axes):
    """From rest to rest, the momentum of the body and its wheels stays zero."""
    robot, _ = with_wheels(axes, max=2.2e-5)
    base = pin.SE3(pin.rpy.rpyToMatrix(*np.radians((30.0, 20.0, -40.0))), np.zeros(3))
    goal = fflin.configuration(robot, base=base)
    motion = fflin.plan(robot, (goal, None), 40.0, knots=21, free=FREE_OF_WHEELS)
    assert np.abs(motion.u).max() == pytest.approx(2.2e-5, rel=1e-9)
    assert np.abs(pin.difference(robot.model, goal, motion.q[-1])[3:6]).max() < 1e-7
    assert np.abs(motion.v[-1]).max() < 1e-7 and motion.residual.max() < 1e-7
    data = robot.model.createData()
    stored = 2e-4 * np.abs(motion.v[:, 6:]).max()
    for q, v in zip(motion.q, motion.v, strict=True):
        pin.computeCentroidalMomentum(robot.model, data, q, v)
        assert np.abs(data.hg.angular).max() <= 1e-6 * stored


@pytest.mark.exhaustive
def test_a_regulator_tracks_a_plan_of_wheels_alone():
    """From an initial error of 1.7 deg, the tracked motion ends at the goal."""
    robot, _ = with_wheels(CUBE_AXES)
    base = pin.SE3(pin.rpy.rpyToMatrix(*np.radians((30.0, 20.0, -40.0))), np.zeros(3))
    goal = fflin.configuration(robot, base=base)
    motion = fflin.plan(robot, (goal, None), 60.0, knots=21, free=FREE_OF_WHEELS)
    schedule = fflin.tvlqr(fflin.linearize_trajectory(robot, motion), sample=0.5)
    q0 = turned(robot, 0.03, (1.0, 0.0, 0.0))
    flown = fflin.simulate(robot, schedule, q0=q0, duration=60.0)
    assert flown.attitude_error[0] > 1.0 and flown.attitude_error[-1] < 0.01


@pytest.mark.exhaustive
def test_starts_and_goals_are_given_in_every_form():
    robot = fflin.load("astrobee_arm", start={"joints": {"arm_proximal": 0.2}})
    q = fflin.configuration(robot, {"arm_proximal": -0.3})
    lin = fflin.linearize(robot, q)
    forms = [lin, (q, None), fflin.StateMap(robot).to_state(q, np.zeros(robot.nv))]
    result = [fflin.plan(robot, goal, 10.0, knots=11, limits=None) for goal in forms]
    for motion in result:
        assert missed(robot, motion, q) < 1e-6
        assert motion.u == pytest.approx(result[0].u, abs=1e-9)
    assert (result[0].q[0] == fflin.configuration(robot, {"arm_proximal": 0.2})).all()


@pytest.mark.exhaustive
@pytest.mark.parametrize("held", [True, False])
def test_derivatives_of_intervals_match_the_flow(servicer, held):
    robot, v, goal = servicer
    t = np.linspace(0.0, 8.0, 41)
    q, v, u = Shooting(robot, t, held).guess(
        (robot.neutral(), v), (goal, np.zeros(robot.nv))
    )
    u = u[:4]  # the start of the motion
    shooting = Shooting(robot, t[:4], held)
    shooting.steps = 64
    q, v = shooting.flown((q[0], v[0]), u)
    ends_by, inside = shooting.jacobians(q, v, u, 4)
    h, (_, nx, _) = 1e-5, ends_by.shape
    A, B, D = np.split(ends_by, (nx, nx + u.shape[1]), axis=2)

    def ends(z, du):
        knots = shooting.moved(q, v, z)
        return shooting.missed(*knots, shooting.motions(*knots, u + du))

    def third(z):
        """Return the third quarter's end of the second interval."""
        return tuple(
            item[1, 48] for item in shooting.motions(*shooting.moved(q, v, z), u)[:2]
        )

    for i in range(nx):
        z = np.zeros((4, nx))
        z[1, i] = h
        slope = (ends(z, 0.0) - ends(-z, 0.0))[1] / (2 * h)
        assert slope == pytest.approx(A[1][:, i], abs=1e-8)
        slope = shooting.between(third(-z), third(z)) / (2 * h)
        assert slope == pytest.approx(inside[1, 2, :, i], abs=1e-8)
    for i in range(u.shape[1]):
        for row, maps in ((1, B), (2, D)):
            du = np.zeros_like(u)
            du[row, i] = 1e-3
            slope = (ends(np.zeros((4, nx)), du) - ends(np.zeros((4, nx)), -du))[
                1
            ] / 2e-3
            assert slope == pytest.approx(maps[1][:, i], abs=1e-8)


@pytest.mark.parametrize("held", [True, False])
def test_limited_values_between_knots_match_finer_motions(servicer, held):
    """At the ends of 16 parts, by as many steps or more: errors fall with the fourth power."""
    robot, v, goal = servicer
    t = np.linspace(0.0, 4.0, 5)
    shooting = Shooting(robot, t, held)
    q, v, u = shooting.guess((robot.neutral(), v), (goal, np.zeros(robot.nv)))
    exact = shooting.limited_values(
        *(x[:, 16::16] for x in shooting.motions(q, v, u, 256))
    )
    size = np.abs(exact).max()
    errors = [
        np.abs(shooting.inside(shooting.motions(q, v, u, steps), 16) - exact).max()
        / size
        for steps in (16, 32, 64)
    ]
    assert (
        errors[0] < 1e-5 and errors[1] < errors[0] / 8.0 and errors[2] < errors[1] / 8.0
    )


def test_rows_of_motions_match_single_motions(servicer):
    """The motion flown from a start and the motions of its intervals are the same."""
    robot, v, goal = servicer
    shooting = Shooting(robot, np.linspace(0.0, 4.0, 5), False)
    q, v, u = shooting.guess((robot.neutral(), v), (goal, np.zeros(robot.nv)))
    q, v = shooting.flown((q[0], v[0]), u)
    assert np.abs(shooting.missed(q, v, shooting.motions(q, v, u))).max() < 1e-13
    motion = fflin.Trajectory(robot, shooting.t, q, v, u)
    for k in range(4):
        end = motion.end(k, 16, q[k], v[k])
        assert np.abs(shooting.between((q[k + 1], v[k + 1]), end)).max() < 1e-13


def test_a_plan_meets_the_conditions_of_optimality(cube):
    """Where inputs are free, the slopes of the effort are those of the goal times multipliers; at a
    limit they would have more."""
    robot, _ = cube
    goal = turned(robot, 1.0, np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0))
    motion = fflin.plan(robot, (goal, None), 6.0, knots=21)
    shooting = Shooting(robot, motion.t, True)
    shooting.steps = 16
    nx = shooting.state.nx
    A, B, _ = np.split(
        shooting.jacobians(motion.q, motion.v, motion.u)[0], (nx, nx + 6), axis=2
    )
    size, reach, maps = np.repeat([1e-3, 1.0], 3), np.eye(nx), []
    for k in range(19, -1, -1):
        maps.append((reach @ B[k] * size).T)
        reach = reach @ A[k]
    slopes, u = (
        np.array(maps[::-1]).reshape(-1, A.shape[1]),
        (motion.u[:-1] / size).ravel(),
    )
    free = np.abs(u) < 1.0 - 1e-5
    y = np.linalg.lstsq(slopes[free], u[free], rcond=1e-12)[0]
    left = u - slopes @ y
    assert np.abs(left[free]).max() < 1e-5 and (~free).sum() >= 3
    assert (left[~free] * u[~free] < -1e-3).all()


def reduced_gradient(robot, motion, held):
    """Return the gradient of the effort that no multipliers of the goal cancel, relative to the
    gradient of the effort. All inputs have the same weight, and none is limited."""
    shooting = Shooting(robot, motion.t, held)
    shooting.steps = 64
    nx, nu = shooting.state.nx, motion.u.shape[1]
    ends = shooting.jacobians(motion.q, motion.v, motion.u)[0]
    reach = np.zeros((nx, len(motion.t), nu))
    for k, (A, B, D) in enumerate(np.split(end, (nx, nx + nu), axis=1) for end in ends):
        reach = np.tensordot(A, reach, 1)
        reach[:, k] += B
        reach[:, k + 1] += D
    share = np.ones(len(motion.t))
    share[[0, -1]] = (1.0, 0.0) if held else (0.5, 0.5)
    root = np.sqrt(share[share > 0.0])[:, None]
    maps = (reach[:, share > 0.0] / root).reshape(nx, -1).T
    u = (root * motion.u[share > 0.0]).ravel()
    left = u - maps @ np.linalg.lstsq(maps, u, rcond=1e-12)[0]
    return np.linalg.norm(left) / np.linalg.norm(u)


def test_a_plan_whose_quadratic_programs_are_not_solved_is_refused(
    one_joint, monkeypatch
):
    monkeypatch.setattr(plan_search.Search, "_step", lambda *_, **__: None)
    robot, goal = one_joint
    with pytest.raises(fflin.InputError, match="no motion"):
        fflin.plan(robot, (goal, None), 10.0, knots=11)


@pytest.mark.parametrize("hold", ["previous", *exhaustive("linear")])
def test_a_search_that_stops_early_states_its_gradient(one_joint, monkeypatch, hold):
    robot, goal = one_joint
    options = {"knots": 11, "limits": None, "hold": hold}
    monkeypatch.setattr(plan_search, "_MOST", 1)
    with (
        any_wording(),
        pytest.warns(fflin.FflinWarning, match="not a minimum of the effort"),
    ):
        motion = fflin.plan(robot, (goal, None), 10.0, **options)
    result = motion.optimality
    left = reduced_gradient(robot, motion, hold == "previous")
    assert left > 0.02 and result.stationarity == pytest.approx(left, rel=1e-4)
    assert (
        not result.stationary
        and result.iterations == 1
        and result.complementarity < 1e-9
    )
    share = np.ones(11)
    share[[0, -1]] = (1.0, 0.0) if hold == "previous" else (0.5, 0.5)
    assert result.effort == pytest.approx(
        share @ np.square(motion.u).sum(axis=1), rel=1e-9
    )
    assert f"stationarity {result.stationarity:.1e}" in " ".join(str(motion).split())
    assert motion.resampled(0.5).optimality is None


def test_a_plan_of_the_closed_form_is_stationary(cube):
    """The KKT residuals of a rotation about a principal axis, with and without active limits."""
    robot, _ = cube
    for duration in (60.0, 4.0):
        motion = fflin.plan(robot, (turned(robot, 0.5), None), duration, knots=21)
        result = motion.optimality
        assert result.stationary and result.stationarity < 1e-5
        assert result.feasibility < 1e-8 and result.complementarity < 1e-6
        assert (np.abs(motion.u[:, 2]).max() > 1e-3 * (1.0 - 1e-9)) == (duration < 10.0)


@pytest.fixture(scope="module")
def loop():
    """Two hinged bodies whose joints moved in a loop, and this motion."""
    inputs = [fflin.JointTorque("joint_1"), fflin.JointTorque("joint_2")]
    robot = fflin.load("planar_detumble", lock=["joint_3"], inputs=inputs, damping={})

    def torques(t, q, v):
        phase = 2.0 * np.pi * t / 10.0
        return np.array([2.0 * np.sin(phase), 0.6 * np.cos(phase)])

    run = fflin.simulate(robot, torques, duration=10.0, dt=0.02, sample=0.5)
    return robot, run.trajectory()


FREE_OF_JOINTS = ["r_b", "v_b", "omega_b"]


@pytest.mark.exhaustive
def test_a_guess_of_joints_that_move_in_loops_rotates_the_base(loop):
    robot, known = loop
    goal = (known.q[-1], known.v[-1])
    options = {"knots": 21, "free": FREE_OF_JOINTS, "limits": None}
    assert np.abs(pin.log3(pin.Quaternion(goal[0][3:7]).matrix())).max() > 0.02
    with any_wording():
        motion = fflin.plan(robot, goal, 10.0, guess=known, **options)
    assert np.abs(pin.difference(robot.model, goal[0], motion.q[-1])[3:]).max() < 1e-6
    assert (
        np.abs(motion.v[-1] - goal[1])[6:].max() < 1e-6 and motion.residual.max() < 1e-6
    )
    assert motion.optimality.effort < 0.9 * 0.5 * np.square(known.u[:-1]).sum()
    other = fflin.load("planar_detumble")
    with any_wording(), pytest.raises(fflin.InputError, match="other joints or inputs"):
        fflin.plan(other, (None, None), 10.0, guess=known, knots=21)
    with any_wording(), pytest.raises(fflin.InputError, match="guess"):
        fflin.plan(robot, goal, 10.0, guess=known.q, knots=21)


@pytest.mark.exhaustive
def test_a_failed_plan_of_joint_torques_advises_to_move_joints_in_loops(
    loop, monkeypatch
):
    robot, _ = loop
    monkeypatch.setattr(plan_search, "_MOST", 3)
    goal = turned(robot, 0.5, (0.0, 1.0, 0.0))
    options = {"knots": 6, "free": FREE_OF_JOINTS, "limits": {"q_m": 0.1}}
    with any_wording(), pytest.raises(fflin.InputError, match="move in loops"):
        fflin.plan(robot, (goal, None), 5.0, **options)


def circle(t):
    """Positions of two joints that move in a circle within 10 s, from and to rest."""
    s = t / 10.0
    phase = 2.0 * np.pi * s**2 * (3.0 - 2.0 * s)
    return 1.2 * np.array([1.0 - np.cos(phase), np.sin(phase)])


@pytest.fixture(scope="module")
def pitched(loop):
    """A configuration that the joints reach by a circle; the base has rotated by 7 deg."""
    robot, _ = loop
    state, t = fflin.StateMap(robot, frame="local"), np.linspace(0.0, 10.0, 401)
    joints = circle(t).T
    base = FloatingBase(state, (robot.neutral(), np.zeros(robot.nv)))
    R = base.rotations(t, joints)
    q, _ = base.motion(t, joints, 0.0 * joints, R)
    assert np.abs(pin.log3(R[-1])).max() > np.deg2rad(7.0)
    return q[-1]


def largest_change_of_momentum(robot, motion):
    """Return how much the momentum may change, if each interval has an error of 1e-6 m/s."""
    return 1e-6 * (len(motion.t) - 1) * pin.computeTotalMass(robot.model)


@pytest.mark.exhaustive
@pytest.mark.parametrize("free", [FREE_OF_JOINTS, []])
def test_a_plan_of_joint_torques_finds_loops_that_rotate_the_base(
    loop, pitched, free, monkeypatch
):
    monkeypatch.setattr(plan_search, "_MOST", 15)  # it need not be a minimum
    robot, _ = loop
    with any_wording():
        motion = fflin.plan(
            robot, (pitched, None), 10.0, knots=11, free=free, limits=None
        )
    assert missed(robot, motion, pitched) < 1e-6 and motion.residual.max() < 1e-6
    momenta = [
        momentum_of(robot, q, v) for q, v in zip(motion.q, motion.v, strict=True)
    ]
    assert np.abs(momenta).max() < largest_change_of_momentum(robot, motion)


@pytest.mark.exhaustive
def test_loops_add_to_the_rotation_by_the_conserved_momentum(loop, monkeypatch):
    monkeypatch.setattr(plan_search, "_MOST", 15)  # it need not be a minimum
    robot, _ = loop
    v0 = fflin.velocity(robot, {"omega_b.y": 0.02, "joint_1": 0.05})
    goal = turned(robot, -0.2, (0.0, 1.0, 0.0))
    options = {"v0": v0, "knots": 11, "free": FREE_OF_JOINTS, "limits": None}
    with any_wording():
        motion = fflin.plan(robot, (goal, None), 10.0, **options)
    assert np.abs(pin.difference(robot.model, goal, motion.q[-1])[3:]).max() < 1e-6
    assert motion.residual.max() < 1e-6
    momenta = [
        momentum_of(robot, q, v) for q, v in zip(motion.q, motion.v, strict=True)
    ]
    change = np.abs(np.subtract(momenta, momenta[0])).max()
    assert np.abs(momenta[0]).max() > 1.0 and change < largest_change_of_momentum(
        robot, motion
    )


@pytest.mark.exhaustive
def test_joints_reorient_a_legged_robot_in_flight():
    robot = fflin.load("solo12", lock=["*_HAA"], inputs=[fflin.JointTorque("*")])
    legs = {"*_HFE": 0.8, "*_KFE": -1.6}
    start, goal = (
        fflin.configuration(robot, legs),
        turned(robot, 0.17, (0.0, 1.0, 0.0), legs),
    )
    with any_wording():
        motion = fflin.plan(
            robot, (goal, None), 1.0, q0=start, knots=11, free=FREE_OF_JOINTS
        )
    assert np.abs(pin.difference(robot.model, goal, motion.q[-1])[3:]).max() < 1e-6
    assert np.abs(motion.v[-1][6:]).max() < 1e-6 and motion.residual.max() < 1e-6


@pytest.fixture
def first_guess(monkeypatch):
    """Return a function that plans, and returns the knots q, v and the inputs of the guess."""

    def guessed(robot, *args, **options):
        guesses = []

        def record(search, guess):
            guesses.append(guess)
            raise fflin.InputError("the guess is known")

        monkeypatch.setattr("fflin.control.plan._least", record)
        with any_wording(), pytest.raises(fflin.InputError, match="guess is known"):
            fflin.plan(robot, *args, **options)
        return guesses[0]

    return guessed


def test_a_function_is_a_guess_whose_base_conserves_momentum(
    loop, pitched, first_guess
):
    robot, _ = loop
    options = {"knots": 21, "free": FREE_OF_JOINTS, "limits": None, "hold": "linear"}
    q, v, u = first_guess(robot, (pitched, None), 10.0, guess=circle, **options)
    state = fflin.StateMap(robot)
    t = np.linspace(0.0, 10.0, 21)
    assert state.joint_positions(q) == pytest.approx(circle(t).T, abs=1e-12)
    # The joint motion is integrated in 400 steps both here and in `pitched`.
    assert np.abs(pin.difference(robot.model, pitched, q[-1])).max() < 1e-9
    momenta = [momentum_of(robot, *point) for point in zip(q, v, strict=True)]
    assert np.abs(momenta).max() < 1e-9
    # The inputs are from differences of the rates and linear between knots, so that the gaps are of
    # the order h^3.
    fine = first_guess(
        robot, (pitched, None), 10.0, guess=circle, **options | {"knots": 41}
    )
    gaps = []
    for knots in ((q, v, u), fine):
        shooting = Shooting(robot, np.linspace(0.0, 10.0, len(knots[0])), held=False)
        gaps.append(np.abs(shooting.missed(*knots[:2], shooting.motions(*knots))).max())
    assert gaps[1] < 0.3 * gaps[0]


def test_a_function_may_name_joints(loop, pitched, first_guess):
    robot, _ = loop
    goal = fflin.configuration(robot, {"joint_1": 0.4})
    options = {"knots": 5, "free": FREE_OF_JOINTS, "limits": None}
    q, *_ = first_guess(
        robot, (goal, None), 2.0, guess=lambda t: {"joint_2": 3.5 * t}, **options
    )
    joints = fflin.StateMap(robot).joint_positions(q)
    by_name = dict(zip(robot.joint_names, joints.T, strict=True))
    s = np.linspace(0.0, 1.0, 5)
    assert by_name["joint_1"] == pytest.approx(0.4 * s**2 * (3.0 - 2.0 * s), abs=1e-12)
    assert np.unwrap(by_name["joint_2"]) == pytest.approx(7.0 * s, abs=1e-12)


def test_with_a_base_torque_the_base_of_a_guess_moves_to_the_goal(first_guess):
    robot = fflin.load("planar_detumble")
    goal = turned(robot, 0.5, (0.0, 1.0, 0.0), at=(0.3, 0.0, 0.0))
    options = {"knots": 7, "limits": None}
    q, v, u = first_guess(robot, (goal, None), 4.0, **options)
    bent = first_guess(
        robot, (goal, None), 4.0, guess=lambda t: 0.1 * t * np.ones(3), **options
    )
    assert np.array_equal(bent[0][:, :7], q[:, :7])
    joints = fflin.StateMap(robot).joint_positions(bent[0])
    assert joints == pytest.approx(
        0.1 * np.linspace(0.0, 4.0, 7)[:, None] * np.ones(3), abs=1e-12
    )
    assert bent[1][1:, 6:] == pytest.approx(0.1 * np.ones((6, 3)), abs=1e-9)
    assert not np.allclose(bent[2], u) and (v[:, 6:] == 0.0).all()


@pytest.mark.parametrize(
    ("guess", "words"),
    [
        (lambda t: np.zeros(3), r"guess\(0\) has shape \(3,\), expected \(2,\)"),
        (lambda t: [t, np.inf if t > 1.0 else 0.0], r"guess\(1.*\)\[1\] is inf"),
        (lambda t: {"joint_9": t}, "joint_9"),
        (lambda t: {"joint_1": "far"}, r"guess\(0\) of joint"),
        (lambda t, q: np.zeros(2), r"expected a function of \(t\)"),
        (3.0, "guess has type float"),
    ],
)
def test_a_guess_that_is_not_a_motion_of_the_joints_is_refused(loop, guess, words):
    robot, _ = loop
    with pytest.raises(fflin.FflinError, match=words):
        fflin.plan(robot, (None, None), 5.0, knots=5, guess=guess)


ARM = {"tau_b": 6.0, "F_b": 3.5, "tau_m": 3.0}


@pytest.mark.exhaustive
def test_long_steps_are_corrected(monkeypatch):
    """From the same iterations, a search without second-order corrections needs more effort."""
    robot = fflin.load("planar_detumble", lock=["joint_3"])
    goal = fflin.configuration(robot, {"joint_1": 0.3})
    monkeypatch.setattr(plan_search, "_MOST", 10)
    options = {"knots": 11, "limits": ARM}
    with any_wording():
        corrected = fflin.plan(robot, (goal, None), 20.0, **options)
        monkeypatch.setattr(plan_search, "_MOST_CORRECTIONS", 0)
        short = fflin.plan(robot, (goal, None), 20.0, **options)
    assert corrected.optimality.effort < 0.95 * short.optimality.effort


@pytest.mark.exhaustive
def test_a_plan_is_a_minimum_for_another_optimiser():
    """From a perturbed plan, SLSQP with its own simulation finds no motion of less effort.

    The motion is planar: the torque about y, the forces along x and z, and two joints.
    """
    robot = fflin.load("planar_detumble", lock=["joint_3"])
    model = robot.model
    goal = fflin.configuration(robot, {"joint_1": 0.3})
    motion = fflin.plan(robot, (goal, None), 20.0, knots=11, limits=ARM)
    acting, size = [1, 3, 5, 6, 7], np.array([6.0, 3.5, 3.5, 3.0, 3.0])
    assert np.abs(np.delete(motion.u, acting, axis=1)).max() < 1e-6
    data, h, steps = model.createData(), 2.0, 8

    def rate(q, v, u):
        force = np.array([u[1], 0.0, u[2], 0.0, u[0], 0.0, u[3], u[4]])
        return pin.aba(model, data, q, v, force)

    def end(w):
        q, v = robot.neutral(), np.zeros(robot.nv)
        for u in w.reshape(10, 5) * size:
            for _ in range(steps):
                dt = h / steps
                half = v + 0.5 * dt * rate(q, v, u)
                middle = pin.integrate(model, q, 0.5 * dt * v)
                mean = v + 0.5 * dt * rate(middle, half, u)
                again = pin.integrate(model, q, 0.5 * dt * half)
                slope = rate(again, mean, u)
                q = pin.integrate(model, q, dt * mean)
                v = v + dt * slope
        miss = np.concatenate((pin.difference(model, goal, q), v))
        return miss[[0, 2, 4, 6, 7, 8, 10, 12, 14, 15]]

    w = (motion.u[:-1][:, acting] / size).ravel()
    start = w + 0.01 * np.random.default_rng(5).normal(size=w.size)
    result = minimize(
        lambda w: 0.5 * w @ w,
        start,
        jac=lambda w: w,
        method="SLSQP",
        bounds=[(-1.0, 1.0)] * w.size,
        constraints={"type": "eq", "fun": end},
        options={"maxiter": 400, "ftol": 1e-8},
    )
    assert result.success and np.abs(end(result.x)).max() < 1e-6
    # The midpoint rule of this simulation has an error of up to 1e-3.
    assert 0.5 * w @ w < (1.0 + 1e-3) * result.fun


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"knots": 1}, "knots"),
        ({"hold": "next"}, "'next'"),
        ({"duration": 0.0}, "duration"),
        ({"free": "r_b.x"}, "free"),
        ({"R": np.ones((6, 6)) + np.eye(6)}, "diagonal"),
        ({"goal": np.zeros(3)}, r"\(3,\)"),
        ({"x0": np.zeros(12), "q0": np.zeros(7)}, "x0"),
    ],
)
def test_an_invalid_plan_is_refused(cube, wrong, message):
    robot, _ = cube
    with pytest.raises(fflin.FflinError, match=message):
        fflin.plan(robot, **{"goal": (None, None), "duration": 1.0} | wrong)


def test_a_lower_limit_above_the_upper_is_named():
    """A least torque beyond the effort of the URDF; `simulate` and `mpc` say it too."""
    robot = fflin.load("servicer_7dof")
    effort = fflin.linearize(robot).limits["tau_m.joint_1"]
    inputs = [fflin.BaseTorque(), fflin.JointTorque("joint_1", min=2.0 * effort)]
    robot, words = (
        robot.replace(inputs=inputs),
        rf"tau_m\.joint_1 is {2.0 * effort:g}, above",
    )
    with pytest.raises(fflin.InputError, match=words):
        fflin.plan(robot, (None, None), 1.0)
    with pytest.raises(fflin.InputError, match=words):
        fflin.mpc(fflin.linearize(robot), 1.0, 1.0, dt=0.1)
    with pytest.raises(fflin.InputError, match=words):
        fflin.simulate(robot, duration=1.0, limits="urdf")


@pytest.fixture(scope="module")
def free_floating():
    inputs = [fflin.JointTorque(f"joint_{i}") for i in (1, 2, 3)]
    robot = fflin.load("planar_detumble", inputs=inputs, damping={})
    return robot, fflin.configuration(robot, {"joint_1": 0.3})


@pytest.mark.exhaustive
def test_progress_shows_iterations_cost_and_violation(cube, capsys):
    robot, _ = cube
    goal = turned(robot, 0.5)
    fflin.plan(robot, (goal, None), 60.0, knots=11)
    assert capsys.readouterr().err == ""
    fflin.plan(robot, (goal, None), 60.0, knots=11, progress=True)
    shown = capsys.readouterr().err
    assert "iteration 1: cost 1 of the guess, largest violation" in shown
    assert shown.endswith("\r\x1b[2K")


def test_a_file_with_other_inputs_names_the_difference(free_floating, tmp_path):
    robot, _ = free_floating
    whole = fflin.load("planar_detumble")
    path = tmp_path / "plan.npz"
    fflin.plan(whole, (None, None), 20.0, knots=4, limits=None).save(path)
    assert fflin.Trajectory.load(path, whole).u.shape == (4, 9)
    with pytest.raises(fflin.InputError, match=r"other inputs tau_b\.x.*F_b\.z"):
        fflin.Trajectory.load(path, robot)
    speeds = np.zeros((2, robot.nv))
    fflin.Trajectory(
        robot, [0.0, 1.0], [robot.neutral()] * 2, speeds, np.zeros((2, 3))
    ).save(path)
    with pytest.raises(fflin.InputError, match=r"lacks the inputs tau_b\.x"):
        fflin.Trajectory.load(path, whole)


@pytest.mark.exhaustive
def test_a_failed_plan_of_internal_inputs_advises_to_free_the_base_velocities():
    """Joint torques conserve the momentum: an end value of omega_b and v_b is no choice."""
    robot = fflin.load("planar_detumble").replace(inputs=[fflin.JointTorque("*")])
    goal = fflin.configuration(
        robot, {"joint_1": 0.2}, base=pin.SE3(np.eye(3), np.ones(3))
    )
    with any_wording(), pytest.raises(fflin.InputError, match="omega_b and v_b"):
        fflin.plan(robot, (goal, None), 5.0, knots=4)


def rolled(robot, angle, axis):
    """Return the neutral configuration with the base rotated by an angle [rad] about an axis."""
    q = robot.neutral().copy()
    rotation = pin.exp3(angle * np.array(axis))
    q[3:7] = pin.Quaternion(rotation).coeffs()
    return q


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
def test_an_attitude_that_no_loop_of_the_joints_reaches_is_unreachable(axis):
    robot = fflin.load("planar_detumble", inputs=[fflin.JointTorque("*")])
    goal = (rolled(robot, 0.4, axis), None)
    options = {"knots": 11, "free": FREE_OF_JOINTS}
    shown = "".join(f"{x:g}, " for x in axis).rstrip(", ")
    with pytest.raises(fflin.InputError) as told:
        fflin.plan(robot, goal, 20.0, **options)
    message = str(told.value)
    assert f"rotates the base about ({shown})" in message
    assert "only about the axis (0, 1, 0)" in message and "in loops" not in message


@pytest.mark.parametrize(
    ("name", "count"), [("planar_detumble", 1), ("servicer_7dof", 3)]
)
def test_the_axes_of_rotation_are_those_of_the_joints(name, count):
    robot = fflin.load(name)
    state = fflin.StateMap(robot, frame="local")
    base = FloatingBase(state, (robot.neutral(), np.zeros(robot.nv)))
    postures = np.random.default_rng(0).uniform(-1.0, 1.0, (20, robot.n))
    axes = rotation_axes(base, postures)
    assert axes @ axes.T == pytest.approx(np.eye(count), abs=1e-12)
    if count == 1:
        assert np.abs(axes) == pytest.approx(np.array([[0.0, 1.0, 0.0]]), abs=1e-9)


@pytest.mark.exhaustive
@pytest.mark.parametrize("missed", ["q_m.panel_left", "q_m.joint_1"])
def test_a_plan_that_misses_the_end_of_sprung_wings_advises_to_free_it(missed):
    wings = ["panel_left", "panel_right"]
    robot = fflin.load(
        "servicer_7dof", passive=wings, stiffness=dict.fromkeys(wings, 40.0)
    )
    state = fflin.StateMap(robot)
    shooting = Shooting(robot, np.linspace(0.0, 2.0, 5), True, ())
    zeros = np.zeros((5, state.nx))
    far = np.where(np.array(state.names) == missed, 0.5, 0.0)
    made = planning._Made(zeros, zeros, zeros, far, zeros[0], zeros[:, None], 0.0, None)
    message = str(planning._failure(shooting, made, np.full(state.nx, True), 2.0))
    assert f"misses {missed} by 0.5 rad" in message
    advised = "free=['q_m.panel_left', 'qdot_m.panel_left']" in message
    assert advised == (missed == "q_m.panel_left")


@pytest.mark.parametrize("error", [1e6, np.nan, np.inf])
def test_a_diverged_trial_has_no_figures_in_the_message(one_joint, monkeypatch, error):
    robot, _ = one_joint
    state = fflin.StateMap(robot)
    shooting = Shooting(robot, np.linspace(0.0, 5.0, 6), True, ())
    zeros = np.zeros((6, state.nx))
    missed = np.full(state.nx, error)
    made = planning._Made(
        zeros, zeros, zeros, missed, zeros[0], zeros[:, None], 0.0, None
    )
    message = str(planning._failure(shooting, made, np.full(state.nx, True), 5.0))
    assert "the last trial diverges;" in message and "misses" not in message
    near = made._replace(missed=np.full(state.nx, 0.5))
    message = str(planning._failure(shooting, near, np.full(state.nx, True), 5.0))
    assert "misses the attitude about x by 0.5 rad" in message


def test_a_guess_that_names_an_unknown_joint_says_what_a_guess_may_be(loop):
    robot, _ = loop
    with pytest.raises(fflin.UnknownNameError, match=r"joint_9.*function of the time"):
        fflin.plan(robot, (None, None), 5.0, knots=5, guess=lambda t: {"joint_9": 0.1})
    with pytest.raises(fflin.InputError, match=r"a mapping, expected a function guess"):
        fflin.plan(robot, (None, None), 5.0, knots=5, guess={"joint_1": 0.1})


@pytest.mark.parametrize("ending", ["npz", "mat", "json", "csv"])
def test_a_file_of_a_plan_keeps_its_residuals(tmp_path, ending):
    robot = fflin.load("planar_detumble", lock=["joint_2", "joint_3"])
    goal = fflin.configuration(robot, {"joint_1": 0.1})
    motion = fflin.plan(robot, (goal, None), 20.0, knots=5, limits=None)
    path = tmp_path / f"plan.{ending}"
    motion.save(path)
    back = fflin.Trajectory.load(path, robot)
    assert back.optimality == motion.optimality and back.verified
    assert str(motion.optimality) in " ".join(str(back).split())
    assert back.resampled(1.0).optimality is None
    plain = motion.resampled(1.0)
    plain.save(path)
    assert fflin.Trajectory.load(path, robot).optimality is None
