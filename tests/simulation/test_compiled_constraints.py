"""Constraints in the compiled engine: compared with the Python engine, campaigns, long runs."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.constraints import Constraints
from tests.simulation.test_compiled import both
from tests.simulation.test_constraints import GRIP, dual_arm, off, turning

pytestmark = pytest.mark.compiled

CASES = {
    "weld": (GRIP,),
    "hinge": (fflin.Hinge("tool_left", "tool_right", axis=(0, 1, 1)),),
    "spherical": (fflin.Spherical("tool_left", "tool_right"),),
    "inertial": (fflin.Weld("tool_left"),),
    "redundant": (GRIP, fflin.Weld("tool_left", "tool_right", name="again")),
    "two": (GRIP, fflin.Spherical("base")),
}


@pytest.mark.parametrize("case", CASES)
def test_both_engines_simulate_the_same_motion(case):
    robot, q, v = dual_arm(*CASES[case])
    robot = robot.replace(gravity=(0.0, 0.1, 0.0), stiffness=5.0, damping=0.1)
    motion = both(robot, q0=q, v0=v, duration=1.0)
    residual, rate = off(robot, motion)
    assert residual < 1e-12 and rate < 1e-12
    python = fflin.simulate(
        robot, q0=q, v0=v, duration=1.0, dt=0.01, engine="python", linear=False
    )
    size = np.abs(python.constraint_forces).max()
    # Rounding errors of 100 steps, multiplied by the condition number of J of at most 1e4.
    np.testing.assert_allclose(
        motion.constraint_forces, python.constraint_forces, atol=1e-9 * size
    )


ORBITS = {
    "circular": fflin.CircularOrbit(500e3),
    "elliptic": {"perigee": 500e3, "eccentricity": 0.1},
}


@pytest.mark.parametrize("case", [*ORBITS, "lags"])
def test_both_engines_simulate_a_loop_in_orbit(case):
    robot, q, v = dual_arm()
    robot = robot.replace(orbit=ORBITS.get(case, 500e3), stiffness=5.0, damping=0.1)
    policy = None
    if case == "lags":
        robot = robot.replace(
            inputs=[fflin.BaseTorque(lag=0.5), fflin.JointTorque("*", lag=0.2)]
        )
        lin = fflin.linearize(robot, q, frame="lvlh")
        policy = fflin.StateFeedback(lin, 0.1 * np.ones(lin.B.T.shape))
    times = {"duration": 20.0, "dt": 0.05}
    motion = both(robot, policy, q0=q, v0=0.2 * v, project=False, **times)
    residual, rate = off(robot, motion)
    assert residual < 1e-12 and rate < 1e-12
    # The Jacobi integral, whose error is of order 4 in the step.
    assert motion.momentum_drift.max() < 1e-6


def test_a_campaign_in_orbit_is_the_same_in_both_engines():
    robot, q, v = dual_arm()
    circling = robot.replace(orbit=500e3)
    options = {"runs": 9, "duration": 0.2, "dt": 0.05, "q0": q, "v0": v}
    python, compiled = (
        fflin.monte_carlo(circling, None, SPREADS, engine=engine, **options)
        for engine in ("python", "compiled")
    )
    np.testing.assert_allclose(compiled.x, python.x, rtol=0.0, atol=1e-11)


def test_both_engines_regulate_in_independent_coordinates():
    robot, q, _ = dual_arm()
    lin = fflin.linearize(robot, q)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    bent = pin.integrate(robot.model, q, 0.01 * np.ones(robot.nv))
    motion = both(robot, policy, q0=fflin.closed(robot, bent), duration=2.0)
    assert motion.u.any() and off(robot, motion)[0] < 1e-12


def test_the_compiled_engine_stops_at_a_singular_posture():
    robot, q, v = turning(0.1)
    motion = fflin.simulate(robot, q0=q, v0=v, duration=0.4, dt=0.05, engine="compiled")
    # All links are on one line after 0.1 s, as in the Python engine.
    assert motion.t[-1] < 0.101 and "singular" in motion.stopped


SPREADS = {"q_m.left_1": 0.02, "qdot_m.left_2": 0.02, "omega_b": 0.01, "*.mass": 0.05}


def test_a_campaign_closes_its_starts_and_keeps_the_drawn_coordinates():
    robot, q, v = dual_arm()
    options = {"runs": 11, "duration": 0.2, "dt": 0.05, "q0": q, "v0": v}
    python, compiled = (
        fflin.monte_carlo(robot, None, SPREADS, engine=engine, **options)
        for engine in ("python", "compiled")
    )
    np.testing.assert_allclose(compiled.x, python.x, rtol=0.0, atol=1e-11)
    rows = Constraints(robot)
    assert max(np.abs(rows.residual(q)).max() for q in compiled.q) < 1e-12
    again = compiled.replay(3)
    np.testing.assert_array_equal(again.q[-1], compiled.q[3])
    # The state at the start is the nominal one plus the drawn values, in drawn coordinates.
    nominal = fflin.StateMap(robot).to_state(q, v)
    for name in ("q_m.left_1", "qdot_m.left_2", "omega_b.y"):
        column = python.state_names.index(name)
        drawn = compiled.drawn[3, compiled.names.index(name)]
        assert again.x[0, column] == pytest.approx(nominal[column] + drawn, abs=1e-12)
    assert off(robot, again)[0] < 1e-12 and again.momentum_drift.max() < 1e-12


@pytest.mark.exhaustive
def test_a_loop_stays_closed_for_a_thousand_seconds():
    robot, q, v = dual_arm()
    motion = fflin.simulate(
        robot, q0=q, v0=v, duration=1000.0, dt=0.01, every=100, engine="compiled"
    )
    assert not motion.stopped
    residual, rate = off(robot, motion)
    assert residual < 1e-10 and rate < 1e-10
    assert motion.momentum_drift.max() < 1e-12
