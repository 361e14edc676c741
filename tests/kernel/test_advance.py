"""The kernel's loop, uncompiled, agrees with Pinocchio's mechanics and with closed forms.

Numba compiles the same functions. `tests.simulation.test_compiled` tests the machine code.
"""

import itertools

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.constraints import Constraints
from fflin.kernel import loop
from fflin.kernel.extension import EXTENSION
from fflin.kernel.forward import ActuatorFaults, kept_at
from fflin.kernel.tree import laid_out
from fflin.simulation.extension import extension_of, is_extended
from fflin.simulation.lanes import loop_name, noises, packed
from fflin.simulation.plan import Plan, SimulationOptions
from fflin.simulation.plant import Plant
from fflin.simulation.run import STOPS, go, stop_conditions, stop_of
from tests.simulation.test_constraints import turning
from tests.support.marks import exhaustive
from tests.support.motions import HOME, displaced
from tests.support.motions import motion as trajectory
from tests.support.policies import (
    POLICIES,
    SAMPLE,
    between_gains,
    controlled_in_samples,
    followed,
    followed_outputs,
    outputs,
    plain,
    shared,
)
from tests.support.robots import (
    FRAMES,
    free_body,
    random_point,
    random_pose,
    random_tree,
)
from tests.support.weights import unit_weights


def one_lane(value):
    """Return the same named tuples with arrays of one lane, as the uncompiled kernel needs them."""
    if isinstance(value, tuple):
        return type(value)._make(map(one_lane, value))
    laned = isinstance(value, np.ndarray) and value.ndim == 2 and value.dtype == float
    return value[:, 0].copy() if laned else value


def planned(robot, policy=None, faults=None, **options):
    plan = Plan(
        SimulationOptions(robot=robot, policy=policy, **{"linear": False} | options)
    )
    if faults is not None:
        plan = plan.replace(plant=Plant(plan.plant.state, faults=faults))
    return plan


def advanced(plan, about=None, every=1, cuts=()):
    """Return rows of q, v, u, momentum and centre of mass: at multiples of `every`, and at the end.

    Angular momentum and centre of mass are relative to the point `about` (3,). By default, this
    point is the initial position of the base. The loop is called again at the steps `cuts`.
    """
    parts = one_lane(laid_out(packed(plan, stop_conditions(plan)), loop.ARGUMENTS)[0])
    words, forces = parts, ()
    if is_extended(plan):
        extension = one_lane(laid_out(extension_of(plan), EXTENSION)[0])
        words = loop.ExtendedArguments(parts, extension)
        forces = extension.constraints.forces
    advance = getattr(loop, loop_name(plan, lanes=8))
    point, kept, robot, times = parts.point, parts.reference, parts.robot, plan.times
    mass = plan.plant.robot.mass
    kept.per_mass[0], kept.weight[:] = 1.0 / mass, mass * robot.gravity
    kept.start[9:] = point.q[:3] if about is None else about
    if plan.noise:
        size = len(parts.law.y)
        at, values = noises(plan, size, 0, times.steps)
        parts.law.added.reshape(-1, size)[at] = values
    width = len(point.q) + len(point.nu) + len(point.u) + 9 + len(forces)
    clock, pieces = np.zeros(1, dtype=int), []
    for last in (*cuts, times.steps):
        rows, first = np.zeros((times.steps, width)), clock[0]
        advance(
            words, clock, last, every, rows.ravel(), np.zeros(robot.tree.offsets.size)
        )
        count = -(-clock[0] // every) - -(-first // every) if every else 0
        assert not rows[count:].any()
        pieces.append(rows[:count])
    rows = np.concatenate(pieces)
    ends = np.cumsum([len(point.q), len(point.nu), len(point.u), 6, 3])
    q, nu, u, momentum, center, _ = np.split(rows, ends, axis=1)
    (linear, angular), last = kept_at(kept, clock[0] * times.dt)
    ending = point.q, point.nu, parts.method.u, (*linear, *angular), last
    pairs = zip((q, nu, u, momentum, center), ending, strict=True)
    q, nu, u, momentum, center = (np.vstack(pair) for pair in pairs)
    return q, plan.plant.state.spread(nu), u, momentum, center


def both(plan, tolerance=1e-10):
    """Compare the kernel's loop with the loop in Python, whose mechanics are Pinocchio's."""
    plan = plan.replace(times=plan.times._replace(every=1))
    expected, result = go(plan), advanced(plan)
    if expected.stopped.startswith("diverged"):
        # the end of a diverged run is not recorded
        result = [rows[:-1] for rows in result]
    names = ("q", "v", "u", "momentum", "center")
    if plan.plant.field:
        names = names[:-1]  # the centre of mass is not predicted in orbit
    for name, value in zip(names, result, strict=False):
        other = getattr(expected, name)
        assert value.shape == other.shape, name
        size = np.maximum(1.0, np.abs(other).max(axis=0))
        # Thrusters with the same effect differ only in rows of 1e-7, which amplify rounding errors.
        limit = 1e-8 if name == "u" and tolerance > 1e-10 else tolerance
        assert (np.abs(value - other) <= limit * size).all(), name
    return result, expected.stopped


@pytest.mark.parametrize(
    "make",
    [
        *(item for item in POLICIES if item is not followed_outputs),
        *exhaustive(followed_outputs),
    ],
    ids=lambda make: make.__name__,
)
def test_the_mechanics_match_pinocchio_under_every_policy(robots, make):
    robot, policy, options = make(plain(robots["ets_vii"]))
    x0 = displaced(fflin.linearize(robot), degrees=20.0)
    options = {"x0": x0, "dt": 0.02} | options
    plan = planned(robot, policy, **options, duration=24 * options["dt"])
    (_, _, u, *_), _ = both(plan, 1e-9 if make is shared else 1e-10)
    assert np.abs(u).max() > 1e-3


@pytest.mark.parametrize(
    "make", [outputs, controlled_in_samples, *exhaustive(followed_outputs)]
)
def test_samples_of_one_step_agree_with_pinocchio(robots, make):
    robot, policy, options = make(plain(robots["ets_vii"]))
    x0 = displaced(fflin.linearize(robot), degrees=20.0)
    both(
        planned(robot, policy, **{"x0": x0} | options | {"dt": SAMPLE, "duration": 2.5})
    )


@pytest.mark.parametrize(
    ("make", "dt"),
    [
        (followed, 0.4),
        pytest.param(followed_outputs, SAMPLE, marks=pytest.mark.exhaustive),
    ],
)
@pytest.mark.exhaustive
def test_a_trajectory_that_ends_before_the_run_agrees_with_pinocchio(robots, make, dt):
    robot, policy, options = make(plain(robots["ets_vii"]))
    both(planned(robot, policy, **options, dt=dt, duration=9.2))


@pytest.mark.parametrize("count", [8, 9])
def test_inputs_that_are_held_between_knots_agree_with_pinocchio(robots, count):
    """With one input less than knots, the inputs are held; else they are linear in time."""
    robot = robots["astrobee_arm"]
    t, q, v, u = trajectory(robot, duration=0.4, knots=9)
    along = fflin.linearize_trajectory(robot, t, q, v, u[:count])
    gains = fflin.tvlqr(along, *unit_weights(fflin.linearize(robot, q[0])), sample=0.05)
    both(planned(robot, gains, q0=q[0], v0=1.1 * v[0], dt=0.01, duration=0.4))


def test_gains_between_grid_points_agree_with_pinocchio_in_all_cells_and_outside(
    robots,
):
    robot, policy, _ = between_gains(plain(robots["planar_detumble"]))
    x0 = displaced(policy.lin)
    for x0[6], x0[7] in itertools.product(
        (-0.5, -0.1, 0.1, 0.15, 0.3, 0.6), (-0.4, 0.1, 0.5)
    ):
        (_, _, u, *_), _ = both(planned(robot, policy, x0=x0, dt=0.02, duration=0.04))
        assert np.abs(u).max() > 1e-3


def test_a_gyroscope_measures_the_rotation_in_the_axes_of_its_frame():
    """The command is D omega, with omega in the axes of a frame that is turned in its link."""
    rng = np.random.default_rng(1)
    model = random_tree(rng, 3).model.copy()
    frame = pin.Frame("sensor", 3, random_pose(rng, 100.0), pin.FrameType.OP_FRAME)
    sensor = model.addFrame(frame)
    robot = plain(fflin.from_model(model, name="tree")).replace(
        outputs=[fflin.Gyroscope("sensor")]
    )
    lin = fflin.linearize(robot)
    D = rng.normal(size=(lin.B.shape[1], 3))
    q0, v0, _ = random_point(robot, rng, degrees=40.0, speed=0.1)
    policy = fflin.LinearController(D, lin)
    (q, v, u, *_), _ = both(
        planned(robot, policy, q0=q0, v0=v0, dt=0.001, duration=0.002)
    )
    data = robot.create_data()
    pin.forwardKinematics(robot.model, data, q[0], v[0])
    omega = pin.getFrameVelocity(robot.model, data, sensor, pin.LOCAL).angular
    assert u[0] == pytest.approx(D @ omega, rel=1e-11, abs=1e-12)


@pytest.mark.parametrize("angle", [3.0, -3.0])
def test_the_angle_of_a_continuous_joint_is_read_on_the_turn_of_the_target(
    robots, angle
):
    robot = plain(robots["planar_detumble"])
    targets = {"joint_1": angle, "joint_2": -angle}
    lin = fflin.linearize(robot, fflin.configuration(robot, targets))
    policy, x0 = fflin.StateFeedback(lin, fflin.lqr(lin).K), lin.x0.copy()
    x0[6:8] += np.copysign(0.5, (angle, -angle))
    (_, _, u, *_), _ = both(planned(robot, policy, x0=x0, dt=0.02, duration=0.2))
    assert u[0] == pytest.approx(
        lin.u0 - policy.K @ (x0 - lin.x0), rel=1e-10, abs=1e-12
    )


@pytest.mark.parametrize("every", [0, 1, 3])
def test_a_run_does_not_depend_on_its_slices_and_on_the_rows_that_are_recorded(
    robots, every
):
    robot, policy, options = outputs(plain(robots["planar_detumble"]))
    x0 = displaced(fflin.linearize(robot))
    plan = planned(robot, policy, x0=x0, duration=0.35, **options)
    whole = advanced(plan)
    for rows, expected in zip(
        advanced(plan, None, every, (1, 9, 20)), whole, strict=True
    ):
        kept = expected[:-1:every] if every else expected[:0]
        assert np.array_equal(rows, np.vstack((kept, expected[-1:])))


@pytest.mark.parametrize("delay", [0.0, 0.06, 0.22])
@pytest.mark.parametrize("frame", FRAMES)
def test_inputs_are_the_clipped_commands_of_the_sample_that_is_delayed(frame, delay):
    """The inputs are clip(-K (x - x0)), with x at the sample that the delay has let through."""
    robot = plain(fflin.load("planar_detumble"))
    lin = fflin.linearize(robot, frame=frame, reference=HOME)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    x0 = displaced(lin, degrees=60.0)
    limits = {"tau_b": (-0.02, 0.03)}
    options = {
        "dt": 0.02,
        "sample": 0.1,
        "delay": delay,
        "duration": 0.6,
        "limits": limits,
    }
    plan = planned(robot, policy, x0=x0, **options)
    (q, v, u, *_), _ = both(plan)
    late, low, high = round(delay / 0.02), *np.tile([[-np.inf], [np.inf]], u.shape[1])
    low[:3], high[:3] = limits["tau_b"]
    expected = np.zeros_like(u)
    for step in range(late, len(u) - 1):
        at = (step - late) // 5 * 5
        x = plan.plant.state.to_state(q[at], v[at])
        expected[step] = np.clip(-policy.K @ (x - lin.x0), low, high)
    expected[-1] = expected[-2]  # the last row is the end of the last step
    assert u == pytest.approx(expected, abs=1e-11)
    assert {*low[:3], *high[:3]} <= {*u[:, :3].ravel()}


def test_modal_amplitudes_that_are_scaled_agree_with_pinocchio():
    robot = fflin.load("inspector_flexible.toml")
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    x0 = displaced(lin, degrees=20.0, spread=0.01)
    both(planned(robot, policy, x0=x0, dt=0.01, duration=0.1))
    assert any(joint.scale != 1.0 for joint in robot.joints)


@pytest.mark.parametrize("method", ["cf4", "semi_implicit_euler"])
def test_springs_gravity_wheels_and_faulty_actuators_agree_with_pinocchio(method):
    rng = np.random.default_rng(4)
    wheel = fflin.ReactionWheel((1, 2, 2), name="storing", momentum=3.0)
    jet = fflin.Thruster("link_3", (0.2, 0.1, 0.0), (1.0, 0.5, 0.2), "jet")
    joints = [fflin.JointTorque(f"joint_{k}") for k in range(1, 8)]
    robot = fflin.load(
        "canadarm2",
        gravity=(0.3, -0.2, -1.0),
        stiffness={"joint_*": 20.0},
        damping={"joint_*": 5.0},
        rest={"joint_2": 0.4, "joint_5": -0.7},
        inputs=[fflin.BaseTorque(), fflin.BaseForce(), *joints, jet, wheel],
    )
    lin = fflin.linearize(robot, reference=HOME)
    size = lin.B.shape[1]
    policy = fflin.StateFeedback(lin, 0.05 * rng.normal(size=lin.B.shape[::-1]))
    turn = np.concatenate(
        [pin.exp3(0.1 * rng.normal(size=3)).ravel("F") for _ in range(2)]
    )
    gain, bias = 1.0 + 0.1 * rng.normal(size=size), 0.1 * rng.normal(size=size)
    until = np.where(np.arange(size) % 4 == 3, 0.1, np.inf)
    faults = ActuatorFaults(gain, bias, until, turn)
    q, v, _ = random_point(robot, rng, degrees=40.0, speed=0.2)
    options = {"dt": 0.02, "duration": 0.3, "method": method}
    for project in (True, False):
        both(planned(robot, policy, faults, q0=q, v0=v, project=project, **options))


ORBITS = {
    "none": None,
    "circular": 500e3,
    "elliptic": {"perigee": 500e3, "eccentricity": 0.1},
}


@pytest.mark.parametrize("lag", [None, 0.2], ids=["direct", "lag"])
@pytest.mark.parametrize("orbit", ORBITS)
def test_closed_loops_agree_with_pinocchio_in_orbit_and_with_lags(orbit, lag):
    weld = fflin.Weld("tool_left", "tool_right")
    robot = fflin.load("dual_arm", orbit=ORBITS[orbit], constraints=[weld])
    inputs = [fflin.BaseTorque(lag=lag), fflin.JointTorque("*", lag=lag)]
    robot = robot.replace(inputs=inputs, stiffness=5.0, damping=0.1)
    joints = {"left_1": 0.4, "left_2": 0.7, "right_1": -0.3, "right_2": -0.6}
    q = fflin.configuration(robot, joints, rpy=(20.0, 10.0, 5.0))
    frame = "lvlh" if orbit != "none" else None
    lin = fflin.linearize(robot, q, frame=frame)
    policy = fflin.StateFeedback(lin, 0.1 * np.ones(lin.B.T.shape))
    rates = 0.1 * np.random.default_rng(0).normal(size=robot.nv)
    q, v = fflin.closed(robot, q, rates)
    result, _ = both(planned(robot, policy, q0=q, v0=v, duration=0.15, dt=0.05))
    rows = Constraints(robot)
    assert np.abs(rows.residual(result[0][-1])).max() < 1e-12
    assert np.abs(rows.jacobian(q) @ result[1][0]).max() < 1e-12
    assert np.abs(result[2]).max() > 0.01


@pytest.mark.parametrize("start", [0.1, 0.2])
def test_a_row_that_vanishes_as_a_whole_ends_the_run(start):
    # When all links are on one line, the row along them has only rounding errors.
    robot, q, v = turning(start)
    q, *_ = advanced(planned(robot, q0=q, v0=v, duration=0.4, dt=0.05))
    # The initial state, and the steps to the line.
    assert len(q) == 1 + round(start / 0.05)


def test_a_body_moves_by_newtons_law_until_its_thrust_fails():
    """The centre of mass accelerates by g + F / m until the failure, and then by g."""
    robot = free_body((2.0, 3.0, 4.0)).replace(
        inputs=[fflin.BaseForce()], gravity=(0.1, 0.2, -0.3)
    )
    m, g, until, dt = robot.mass, np.array(robot.gravity), 0.2, 0.02
    force, start = np.array([5.0, -7.0, 11.0]), np.array([0.3, -0.2, 0.1])
    faults = ActuatorFaults(np.ones(3), force, np.full(3, until), np.eye(3).ravel())
    q0 = np.array(
        [1.0, 2.0, 3.0, *np.sin(0.3) * np.array([0.6, 0.0, 0.8]), np.cos(0.3)]
    )
    v0 = np.zeros(6)
    R = pin.Quaternion(q0[3:]).matrix()
    v0[:3] = R.T @ start
    for project in (True, False):
        # A method with one stage: other methods have a stage at the end of the step before the
        # failure, at which the thrust has failed already.
        options = {"dt": dt, "duration": 0.6, "method": "semi_implicit_euler"}
        plan = planned(robot, None, faults, q0=q0, v0=v0, project=project, **options)
        q, v, _, momentum, center = advanced(plan)
        t = dt * np.arange(len(q))
        given = R @ force if not plan.plant.actuation.held else force
        speed = start + np.outer(t, g) + np.outer(np.minimum(t, until), given / m)
        assert v[:, :3] @ R.T == pytest.approx(speed, abs=1e-12)
        assert momentum[:, :3] == pytest.approx(m * speed, abs=1e-11)
        # Semi-implicit Euler moves with the speed at the end of each step.
        path = np.vstack((np.zeros(3), dt * speed[1:].cumsum(axis=0)))
        assert center == pytest.approx(path, abs=1e-12)
        assert q[:, :3] == pytest.approx(q0[:3] + path, abs=1e-12)


def left(lin):
    """Return a start that leaves the chart, and a factor of the gain."""
    x0 = displaced(lin, degrees=120.0)
    half = len(x0) // 2
    x0[half : half + 3] = 0.5 * x0[:3]
    return x0, 0.0


def diverged(lin):
    return displaced(lin), -3.0


# An unstable loop amplifies rounding errors.
ENDS = [(left, "left the chart", 1e-10), (diverged, "diverged", 1e-6)]


@pytest.mark.parametrize(("how", "message", "tolerance"), ENDS)
def test_a_run_ends_at_the_same_step_as_in_the_python_engine(how, message, tolerance):
    robot = plain(fflin.load("planar_detumble"))
    lin = fflin.linearize(robot)
    x0, gain = how(lin)
    policy = fflin.StateFeedback(lin, gain * fflin.lqr(lin).K)
    plan = planned(robot, policy, x0=x0, dt=0.05, duration=20.0).replace(
        within_chart=True
    )
    (q, *_), stopped = both(plan, tolerance)
    assert stopped.startswith(message) and 3 < len(q) < 400


@pytest.mark.parametrize("sign", [1.0, *exhaustive(-1.0)])
def test_a_free_spin_leaves_the_chart_at_half_a_turn(sign):
    """A body at the angle a with the rate w is at a + w t, up to 180 deg from the reference."""
    robot = free_body((2.0, 3.0, 4.0)).replace(
        inputs=[fflin.BaseTorque(), fflin.BaseForce()]
    )
    lin = fflin.linearize(robot, reference=HOME)
    policy = fflin.StateFeedback(lin, np.zeros(lin.B.shape[::-1]))
    a, w, dt = 1.0, sign * 0.7, 0.05
    for scalar in (1.0, -1.0):  # of the quaternion, whose sign does not matter
        turn = pin.Quaternion(HOME.rotation @ pin.exp3(np.array([0.0, 0.0, a])))
        q0 = np.append(HOME.translation, scalar * turn.coeffs())
        v0 = np.array([0.0, 0.0, 0.0, 0.0, 0.0, w])
        plan = planned(robot, policy, q0=q0, v0=v0, dt=dt, duration=10.0)
        (q, *_), stopped = both(plan)
        assert len(q) == 201 and not stopped  # a policy is defined beyond half a turn
        (q, *_), stopped = both(plan.replace(within_chart=True))
        steps = np.ceil((np.pi - sign * a) / (abs(w) * dt))
        assert len(q) == steps + 1 and stopped.startswith("left the chart")


@pytest.mark.parametrize("axis", range(3))
def test_a_run_diverges_at_the_rotation_per_step_that_is_too_large(axis):
    """A constant torque T turns a body at T t / I, up to 1 rad in a step."""
    robot = free_body((2.0, 2.0, 2.0)).replace(inputs=[fflin.BaseTorque()])
    torque = -8.1 * np.eye(3)[axis]
    faults = ActuatorFaults(np.ones(3), torque, np.full(3, 9.0), np.eye(3).ravel())
    plan = planned(robot, None, faults, dt=0.05, duration=9.0)
    (_, v, *_), stopped = both(plan)
    # 1 rad / 0.05 s is reached at 4.94 s
    assert stopped.startswith("diverged at t = 4.95 s")
    assert "rotates by 1 rad per step" in stopped
    assert v[:, 3 + axis] == pytest.approx(-4.05 * 0.05 * np.arange(99), rel=1e-12)


def test_the_message_of_an_end_has_the_index_of_its_reason():
    messages = (
        "",
        "diverged at t = 1 s",
        "left the chart at t = 1 s",
        "event at t = 1 s",
    )
    assert [STOPS[stop_of(message)] for message in messages] == list(STOPS)


@pytest.mark.parametrize("seed", range(3))
def test_momentum_is_constant_and_the_centre_of_mass_moves_along_a_line(seed):
    rng = np.random.default_rng(seed)
    robot = random_tree(rng, 4)
    q0, v0, _ = random_point(robot, rng, speed=0.3)
    both(planned(robot, q0=q0, v0=v0, dt=0.02, duration=0.2, project=False))
    about = rng.normal(size=3)
    plan = planned(robot, q0=q0, v0=v0, dt=0.02, duration=0.2)
    q, v, _, momentum, relative = advanced(plan, about)
    data, kept, center = robot.create_data(), [], []
    for point in zip(q, v, strict=True):
        kept.append(
            pin.computeCentroidalMomentum(robot.model, data, *point).vector.copy()
        )
        center.append(data.com[0].copy())
    line = center[0] + np.outer(0.02 * np.arange(len(q)), kept[0][:3] / robot.mass)
    assert np.array(center) == pytest.approx(line, abs=1e-12)
    assert np.array(kept) == pytest.approx(
        np.tile(kept[0], (len(q), 1)), rel=1e-12, abs=1e-11
    )
    assert relative == pytest.approx(np.array(center) - about, abs=1e-12)
    kept[0][3:] += np.cross(center[0] - about, kept[0][:3])
    assert momentum == pytest.approx(
        np.tile(kept[0], (len(q), 1)), rel=1e-12, abs=1e-11
    )
