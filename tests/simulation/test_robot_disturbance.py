"""Disturbances of the robot: closed forms, momentum, order of the integrator, and both engines."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.kernel.test_advance import advanced, planned
from tests.support.robots import free_body, random_tree

INERTIA = (4.0, 5.0, 6.0)  # [kg m^2], of a body of 50 kg
BODY = free_body(INERTIA)
TORQUE, FORCE = (0.02, -0.01, 0.03), (0.3, -0.2, 0.1)
SPIN = {"omega_b.x": 0.4, "omega_b.z": -0.7, "v_b.y": 0.2}


def flown(robot, **options):
    v0 = fflin.velocity(robot, SPIN)
    options = {"v0": v0, "duration": 1.0, "dt": 0.02} | options
    return fflin.simulate(robot, **options)


def wave(amplitude, frequency, phase):
    return {"amplitude": amplitude, "frequency": frequency, "phase": phase}


@pytest.mark.parametrize("axis", range(3))
def test_a_constant_torque_rotates_a_body_by_half_its_acceleration_times_t_squared(
    axis,
):
    torque = 0.03 * np.eye(3)[axis]
    robot = BODY.replace(disturbance={"tau_b": torque})
    motion = fflin.simulate(robot, duration=4.0, dt=0.1)
    angle = 0.5 * 0.03 / INERTIA[axis] * motion.t**2
    quaternion = np.sin(0.5 * angle)[:, None] * np.eye(3)[axis]
    assert motion.q[:, 3:6] == pytest.approx(quaternion, abs=1e-13)


def forced(t, mass, amplitude, frequency, phase):
    """Return the position of a free mass, at rest at t = 0, under a periodic force."""
    w = 2.0 * np.pi * frequency
    speed = np.cos(phase) * t / w - (np.sin(w * t + phase) - np.sin(phase)) / w**2
    return np.outer(speed, amplitude) / mass


@pytest.mark.parametrize("project", [True, False])
def test_a_periodic_force_moves_a_rotating_body_by_its_closed_form_to_fourth_order(
    project,
):
    given = wave(FORCE, 0.5, 0.7)
    robot = BODY.replace(disturbance={"F_b": given})
    v0 = fflin.velocity(robot, {"omega_b.x": 0.3, "omega_b.y": -0.2})
    errors = []
    for dt in (0.2, 0.1, 0.05):
        motion = fflin.simulate(robot, v0=v0, duration=4.0, dt=dt, project=project)
        exact = forced(motion.t, robot.mass, *given.values())
        errors.append(np.abs(motion.q[:, :3] - exact).max())
    ratios = np.array(errors[:-1]) / errors[1:]
    assert (ratios > 14.0).all() and (ratios < 18.0).all()
    assert errors[-1] < 1e-7


def test_momentum_changes_by_the_impulse_of_force_and_torque():
    """dH/dt = R tau + (r_b - r_c) x F about the centre of mass, dp/dt = F."""
    robot = fflin.load("astrobee_arm").replace(
        disturbance={
            "tau_b": wave(TORQUE, 0.4, -0.3),
            "F_b": {"constant": FORCE} | wave((0.1, 0.2, -0.3), 0.8, 1.0),
        }
    )
    motion = flown(robot, dt=0.005)
    t, data = motion.t, robot.create_data()
    rates = np.empty((len(t), 6))
    for rate, time, q in zip(rates, t, motion.q, strict=True):
        torque = np.array(TORQUE) * np.sin(0.8 * np.pi * time - 0.3)
        force = FORCE + np.array((0.1, 0.2, -0.3)) * np.sin(1.6 * np.pi * time + 1.0)
        center = pin.centerOfMass(robot.model, data, q)
        turned = pin.Quaternion(q[3:7]).matrix() @ torque
        rate[:] = *(turned + np.cross(q[:3] - center, force)), *force
    # Simpson's rule over all steps
    weights = np.full(len(t), 2.0)
    weights[1::2] = 4.0
    weights[[0, -1]] = 1.0
    impulse = weights @ rates * 0.005 / 3.0
    gained = motion.momentum[-1] - motion.momentum[0]
    assert gained == pytest.approx(impulse, abs=1e-9)
    assert np.abs(impulse).min() > 1e-3
    assert motion.momentum_drift.max() < 1e-12


def test_responses_superpose():
    one, other = {"constant": FORCE}, wave((0.1, 0.0, -0.2), 0.3, 0.4)
    motions = [
        flown(BODY.replace(disturbance={"F_b": given}), v0=None)
        for given in (one, other, [one, other], one | other)
    ]
    first, second, both, merged = [motion.q[:, :3] for motion in motions]
    assert both == pytest.approx(first + second, abs=1e-14)
    assert np.array_equal(both, merged)


@pytest.mark.parametrize(
    "axes, names", [("base", ("local", "local")), ("inertial", ("world", "world"))]
)
def test_axes_are_those_of_an_input_of_this_frame(axes, names):
    """The same force as `simulate(disturbance=)`, whose axes are those of the frame."""
    robot = fflin.load("astrobee_arm")
    values = {"tau_b": TORQUE, "F_b": FORCE}
    given = {name: {"constant": value, "axes": axes} for name, value in values.items()}
    motion = flown(robot.replace(disturbance=given), frame=names[0])
    expected = flown(robot, disturbance=values, frame=names[0])
    assert motion.q == pytest.approx(expected.q, abs=1e-12)
    assert motion.v == pytest.approx(expected.v, abs=1e-12)


def test_default_axes_are_those_of_the_default_frame_and_both_disturbances_add():
    robot = fflin.load("astrobee_arm")
    values = {"tau_b": TORQUE, "F_b": FORCE}
    half = {name: 0.5 * np.array(value) for name, value in values.items()}
    expected = flown(robot, disturbance=values)
    motion = flown(robot.replace(disturbance=values))
    assert motion.v == pytest.approx(expected.v, abs=1e-12)
    motion = flown(robot.replace(disturbance=half), disturbance=half)
    assert motion.v == pytest.approx(expected.v, abs=1e-12)


@pytest.mark.exhaustive
def test_inertial_axes_rotate_in_the_orbital_frame():
    n = 0.5  # [rad/s]
    robot = BODY.replace(
        orbit=fflin.CircularOrbit(
            mean_motion=n, body="x", mu=n**2 * 7e6**3, body_radius=6e6
        )
    )
    options = {"duration": 4.0, "dt": 0.02, "frame": "hill"}

    def fixed(t, q, v):
        return {"F_b": (0.3 * np.cos(n * t), -0.3 * np.sin(n * t), 0.1)}

    expected = fflin.simulate(robot, disturbance=fixed, **options)
    given = {"constant": (0.3, 0.0, 0.1), "axes": "inertial"}
    motion = fflin.simulate(robot.replace(disturbance={"F_b": given}), **options)
    assert motion.q == pytest.approx(expected.q, abs=1e-12)
    by_default = robot.replace(disturbance={"F_b": (0.3, 0.0, 0.1)})
    turning = fflin.simulate(by_default, **options)
    held = fflin.simulate(robot, disturbance={"F_b": (0.3, 0.0, 0.1)}, **options)
    assert turning.q == pytest.approx(held.q, abs=1e-12)
    assert np.abs(turning.q - motion.q).max() > 1e-3
    assert turning.momentum_drift.max() < 1e-6


DISTURBANCE = {
    "tau_b": [TORQUE, {"axes": "inertial"} | wave((0.1, 0.0, -0.2), 1.5, 0.4)],
    "F_b": [FORCE, {"axes": "base", "constant": TORQUE} | wave(TORQUE, 0.2, -2.0)],
}


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), (0.1, -0.2, -1.6)])
def test_the_loop_of_the_compiled_engine_agrees_with_python(gravity):
    robot = random_tree(np.random.default_rng(3), 3)
    robot = robot.replace(disturbance=DISTURBANCE, gravity=gravity)
    v0 = fflin.velocity(robot, SPIN)
    plan = planned(robot, v0=v0, duration=0.2, dt=0.02)
    q, v, _, momentum, _ = advanced(plan)
    motion = fflin.simulate(robot, v0=v0, duration=0.2, dt=0.02, engine="python")
    assert q == pytest.approx(motion.q, abs=1e-12)
    assert v == pytest.approx(motion.v, abs=1e-12)
    assert np.ptp(momentum, axis=0).min() > 1e-3


def test_a_proportional_law_leaves_the_torque_divided_by_its_stiffness():
    robot = BODY.replace(inputs=[fflin.BaseTorque()])
    lin = fflin.linearize(robot)
    stiffness, damping = 20.0, 20.0
    K = np.zeros((3, lin.B.shape[0]))
    K[:, :3], K[:, 6:9] = stiffness * np.eye(3), damping * np.eye(3)
    true = robot.replace(disturbance={"tau_b": TORQUE})
    law = fflin.StateFeedback(lin, K)
    motion = fflin.simulate(true, law, duration=60.0, dt=0.05)
    assert motion.x[-1, :3] == pytest.approx(np.array(TORQUE) / stiffness, abs=1e-9)


def test_linear_models_and_gains_do_not_know_the_disturbance():
    robot = fflin.load("planar_detumble", gravity=(0.0, 0.0, -1.6))
    true = robot.replace(disturbance=DISTURBANCE)
    one, other = fflin.linearize(robot), fflin.linearize(true)
    for name in ("A", "B", "f0", "u0"):
        assert np.array_equal(getattr(one, name), getattr(other, name))
    assert np.array_equal(fflin.lqr(one).K, fflin.lqr(other).K)


def test_a_fast_periodic_disturbance_shortens_the_default_step():
    slow = fflin.simulate(BODY, duration=0.5)
    robot = BODY.replace(disturbance={"tau_b": wave(TORQUE, 40.0, 0.0)})
    fast = fflin.simulate(robot, duration=0.5)
    assert slow.step == 0.01
    assert fast.step < slow.step
    assert any("disturbance" in note for note in fast.notes)
    given = fflin.simulate(robot, duration=0.5, dt=0.01)
    assert any("disturbance" in note for note in given.notes)


def test_a_disturbed_motion_has_no_note_on_its_energy():
    robot = BODY.replace(disturbance={"tau_b": TORQUE})
    assert not any("energy" in note for note in flown(robot).notes)


@pytest.mark.compiled
def test_the_compiled_engine_gives_the_same_motion():
    pytest.importorskip("numba")
    robot = random_tree(np.random.default_rng(5), 4)
    robot = robot.replace(disturbance=DISTURBANCE, gravity=(0.1, -0.2, -1.6))
    motions = [
        flown(robot, duration=0.4, engine=engine) for engine in ("python", "compiled")
    ]
    assert motions[1].engine == "compiled"
    for name in ("q", "v", "momentum"):
        one, other = (getattr(motion, name) for motion in motions)
        assert other == pytest.approx(one, abs=1e-12)
    assert motions[1].momentum_drift.max() < 1e-12
