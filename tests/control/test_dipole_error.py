"""Prediction of the attitude error that a residual dipole causes under a slow magnetic law."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fflin
from fflin.base.rotation import skew
from fflin.control.dipole_error import note_on_dipole, steady_error
from fflin.dynamics.orbital import OrbitField

DIPOLE = np.array([1e-3, 0.0, 5e-4])


@pytest.fixture(scope="module")
def slow():
    """The cubesat, the model of its base torque, and the slow gain of its robot file."""
    robot = fflin.load("cubesat_magnetic")
    design = robot.replace(inputs=[fflin.BaseTorque()])
    lin = fflin.linearize(design)
    return robot, design, lin, fflin.lqr(lin).K


@pytest.mark.exhaustive
@pytest.mark.parametrize("dipole", [DIPOLE, np.array([0.0, 2e-4, 0.0])])
def test_the_error_is_that_of_the_integrated_linear_loop(slow, dipole):
    robot, _, lin, K = slow
    field = OrbitField(robot, "lvlh").magnetic
    states = [0, 1, 2, 6, 7, 8]
    assert [lin.state_names[i] for i in states[::3]] == ["q_b.x", "omega_b.x"]
    A, B, gain = lin.A[np.ix_(states, states)], lin.B[states], K[:, states]
    root = np.linalg.cholesky(np.linalg.inv(B[3:]))

    def rate(t, x):
        b = field.at(t)
        # The moments whose torque is nearest in the norm of the inverse inertia.
        columns = np.linalg.solve(root, -skew(b))
        moments = -np.linalg.pinv(columns, 1e-9) @ np.linalg.solve(root, gain @ x)
        return A @ x + B @ np.cross(moments + dipole, b)

    period = robot.orbit.period
    run = solve_ivp(
        rate, (0.0, 8.0 * period), np.zeros(6), rtol=1e-6, atol=1e-9, max_step=200.0
    )
    last = run.y[:3, run.t > 7.0 * period]
    largest = np.degrees(2.0 * np.arcsin(np.linalg.norm(last, axis=0).max()))
    assert largest > 10.0
    assert steady_error(robot, lin, K, dipole) == pytest.approx(largest, rel=0.01)
    sampled = lin.discretize(10.0)
    assert steady_error(robot, sampled, K, DIPOLE) == steady_error(
        robot, lin, K, DIPOLE
    )


def test_an_unstable_loop_has_no_steady_error(slow):
    robot, _, lin, K = slow
    assert steady_error(robot, lin, 0.0 * K, DIPOLE) is None
    assert steady_error(robot, lin, K, 1e3 * DIPOLE) == 180.0


def test_a_note_of_a_run_states_a_large_error(slow):
    robot, design, lin, K = slow
    law = fflin.Allocation(fflin.StateFeedback(lin, K), design)

    def notes(dipole):
        disturbed = robot.replace(disturbance={"residual_dipole": list(dipole)})
        motion = fflin.simulate(disturbed, law, duration=10.0, dt=10.0)
        return [note for note in motion.notes if "dipole of" in note]

    (note,) = notes(DIPOLE)
    error = steady_error(robot, lin, K, DIPOLE)
    assert f"steady attitude error is {error:.2g} deg" in note
    (note,) = notes(4.0 * DIPOLE)
    assert "more than 90 deg" in note
    assert notes(0.1 * DIPOLE) == []
    wheel = fflin.ReactionWheel((0, 0, 1), "base", inertia=1e-5)
    disturbed = robot.replace(
        inputs=[*robot.inputs, wheel], disturbance={"residual_dipole": list(DIPOLE)}
    )
    assert note_on_dipole(disturbed, lin, K) == ()


@pytest.mark.compiled
@pytest.mark.exhaustive
def test_the_prediction_is_close_to_the_simulated_error_and_the_periodic_law_holds(
    slow,
):
    robot, design, lin, K = slow
    period = robot.orbit.period
    real = robot.replace(disturbance={"residual_dipole": list(DIPOLE)})
    options = {"v0": np.zeros(6), "limits": "urdf", "engine": "compiled"}
    law = fflin.Allocation(fflin.StateFeedback(lin, K), design)
    motion = fflin.simulate(real, law, duration=30000.0, dt=10.0, **options)
    largest = motion.attitude_error[motion.t > 30000.0 - period].max()
    assert steady_error(robot, lin, K, DIPOLE) == pytest.approx(largest, rel=0.1)
    assert largest > 30.0
    # The default weights of the periodic regulator use the limits of the magnetorquers.
    satellite = robot.replace(weights={})
    h = period / 64.0
    along = fflin.linearize_orbit(satellite, steps=32)
    regulator = fflin.tvlqr(along, Qf="periodic", sample=h)
    disturbed = satellite.replace(disturbance={"residual_dipole": list(2.0 * DIPOLE)})
    motion = fflin.simulate(
        disturbed, regulator, duration=5.0 * period, dt=h / 8.0, **options
    )
    assert motion.attitude_error[motion.t > 4.0 * period].max() < 6.0
