"""Linear laws with a state: of measured outputs or states, with anti-windup, in both engines."""

from dataclasses import replace

import numpy as np
import pytest

import fflin
from fflin.control.policies import LinearLaw
from fflin.control.policy import System
from fflin.kernel.allocation import nearest_unbounded
from tests.support.motions import displaced
from tests.support.policies import JETS, coarse

LIMITS = {"tau_b": 0.4, "F_b": 0.3, "tau_m": 0.2}
H = 0.1


class Integrating(LinearLaw):
    """State feedback with a leaking integral of each position, and anti-windup."""

    def __init__(self, lin, dt, windup=True):
        self.lin = lin
        nx = len(lin.A)
        nz = nx // 2
        K = coarse(fflin.lqr(lin.discretize(dt) if dt else lin).K)
        picked = np.eye(nz, nx)
        leak = -0.02 * np.eye(nz)
        A, B = (leak, picked) if not dt else (np.eye(nz) + dt * leak, dt * picked)
        C = coarse(-0.3 * K[:, :nz])
        self.system = System(A, B, C, -K, dt, lin.state_names, lin.input_names)
        if windup:
            self.windup = coarse(-np.linalg.pinv(C) * (-1.0 if not dt else -0.2))


class FullState(Integrating):
    """The same law, whose measured values are the outputs of the robot."""

    senses_outputs = True


@pytest.fixture(scope="module")
def arm():
    robot = fflin.load("planar_detumble")
    return robot, fflin.linearize(robot)


def flown(robot, policy, lin, engine="python", **options):
    options = {"duration": 3.0, "dt": 0.02, "linear": False} | options
    return fflin.simulate(
        robot, policy, x0=displaced(lin, degrees=40.0), engine=engine, **options
    )


def apart(one, other):
    """Return the largest difference of two motions, relative to their size but at least 1."""
    return max(
        float((np.abs(a - b) / np.maximum(1.0, np.abs(a).max(axis=0))).max())
        for a, b in ((one.x, other.x), (one.u, other.u))
    )


def recursion(law, x, applied):
    """Return the limited commands of a sampled law for given states and applied inputs."""
    A, B, C, D, u0, y0, _, E = law.terms()
    z = np.zeros(len(A))
    rows = []
    for x_k, u_k in zip(x, applied, strict=True):
        command = u0 + C @ z + D @ (x_k - y0)
        rows.append(command)
        z = A @ z + B @ (x_k - y0)
        if E.size:
            z = z + E @ (u_k - command)
    return np.array(rows)


@pytest.mark.parametrize("windup", [True, False])
@pytest.mark.parametrize("kind", [Integrating, FullState])
def test_a_sampled_law_follows_its_recursion_with_the_applied_inputs(arm, kind, windup):
    robot, lin = arm
    law = kind(lin, H, windup)
    motion = flown(robot, law, lin, limits=LIMITS, every=5)
    commands = recursion(law, motion.x[:-1], motion.u[:-1])
    high = np.array([LIMITS[name.partition(".")[0]] for name in lin.input_names])
    assert np.abs(np.clip(commands, -high, high) - motion.u[:-1]).max() < 1e-12
    assert (np.abs(commands) > high).any()


@pytest.mark.exhaustive
def test_the_state_of_a_continuous_law_is_integrated_with_the_anti_windup(arm):
    robot, lin = arm
    law = Integrating(lin, 0.0)
    motion = flown(robot, law, lin, limits=LIMITS, dt=0.002)
    A, B, C, D, u0, y0, _, E = law.terms()
    high = np.array([LIMITS[name.partition(".")[0]] for name in lin.input_names])
    # classical Runge-Kutta steps over two steps of the simulation, with its states between
    z, errors = np.zeros(len(A)), []

    def rate(z, x):
        command = u0 + C @ z + D @ (x - y0)
        applied = np.clip(command, -high, high)
        return A @ z + B @ (x - y0) + E @ (applied - command), applied

    rows = (motion.x[:-2:2], motion.x[1:-1:2], motion.x[2::2], motion.u[:-2:2])
    for first, middle, last, u in zip(*rows, strict=True):
        k1, applied = rate(z, first)
        errors.append(np.abs(applied - u).max())
        k2, _ = rate(z + 0.002 * k1, middle)
        k3, _ = rate(z + 0.002 * k2, middle)
        k4, _ = rate(z + 0.004 * k3, last)
        z = z + 0.004 / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    assert max(errors) < 1e-6
    without = flown(robot, Integrating(lin, 0.0, windup=False), lin, limits=LIMITS)
    assert np.abs(without.x[-1] - motion.x[-1]).max() > 1e-3


@pytest.mark.parametrize("dt", [0.0, H])
def test_states_and_full_state_outputs_are_the_same_law(arm, dt):
    robot, lin = arm
    one, other = (
        flown(robot, kind(lin, dt), lin, limits=LIMITS)
        for kind in (Integrating, FullState)
    )
    assert apart(one, other) < 1e-12


@pytest.mark.parametrize("dt", [0.0, H])
def test_the_prediction_contains_the_memory_and_the_anti_windup(arm, dt):
    robot, lin = arm
    law = Integrating(lin, dt)
    x0 = lin.x0 + 1e-3 * displaced(lin, degrees=40.0)
    limits = {name: 1e-3 * most for name, most in LIMITS.items()}
    options = {"x0": x0, "duration": 3.0, "limits": limits, "dt": 0.02}
    motion = fflin.simulate(robot, law, **options)
    assert np.abs(motion.prediction - motion.x).max() < 2e-3 * np.abs(x0).max()
    law = Integrating(lin, dt, windup=False)
    other = fflin.simulate(robot, law, **options)
    assert np.abs(other.x - motion.x).max() > 2e-2 * np.abs(x0).max()
    assert np.abs(other.prediction - other.x).max() < 2e-3 * np.abs(x0).max()


def test_a_held_law_has_the_anti_windup_of_its_exact_hold(arm):
    _, lin = arm
    law = Integrating(lin, 0.0)
    held = law.sampled(0.5)
    scaled = (1.0 - np.exp(-0.02 * 0.5)) / 0.02
    assert held.sample_time == 0.5
    assert np.abs(held.windup - scaled * law.windup).max() < 1e-12
    assert np.abs(held.system.B - scaled * law.system.B).max() < 1e-12


@pytest.mark.compiled
@pytest.mark.parametrize("dt", [0.0, H])
@pytest.mark.parametrize("limits", [None, LIMITS])
@pytest.mark.parametrize("kind", [Integrating, FullState])
def test_both_engines_agree(arm, kind, limits, dt):
    pytest.importorskip("numba")
    robot, lin = arm
    law = kind(lin, dt)
    one, other = (
        flown(robot, law, lin, engine, limits=limits, duration=10.0)
        for engine in ("python", "compiled")
    )
    assert apart(one, other) < 1e-12


def allocated(dt, most=2e-2):
    """Return a robot with thrusters, and the allocation of an integrating law to them."""
    jets = [replace(jet, max=most) for jet in JETS]
    robot = fflin.load("cubesat", inputs=jets)
    design = robot.replace(inputs=[fflin.BaseTorque(), fflin.BaseForce()])
    lin = fflin.linearize(design)
    return robot, fflin.Allocation(Integrating(lin, dt), design), lin


@pytest.mark.exhaustive
def test_an_allocation_corrects_its_law_by_the_force_that_is_achieved():
    robot, policy, lin = allocated(H)
    motion = flown(robot, policy, lin, every=5, duration=30.0)
    actuated = fflin.linearize(robot)
    # the wrench of the inputs, which both models map to the same accelerations
    nv = len(lin.M)
    wrench = (lin.M @ actuated.B[nv:] @ motion.u[:-1].T).T
    rotated = motion.x[:-1, :3]
    for row, q_b in zip(wrench, rotated, strict=True):
        w = np.sqrt(1.0 - q_b @ q_b)
        turn = np.cross(q_b, np.eye(3)).T  # [q]x
        R = np.eye(3) + 2.0 * w * turn + 2.0 * turn @ turn
        row[3:6] = R @ row[3:6]  # forces on the base are in reference axes
    commands = recursion(policy.policy, motion.x[:-1], wrench)
    lack = np.abs(commands - wrench)
    assert (lack > 1e-3).any()
    reached = (lack < 1e-8).all(axis=1)
    assert reached.any()
    assert not reached[:5].any()
    # what the law commands at the end depends on all corrections before
    other = Integrating(lin, H, windup=False)
    without = recursion(other, motion.x[:-1], wrench)
    assert np.abs(without - wrench)[reached].max() > 1e-3


@pytest.mark.compiled
@pytest.mark.parametrize("dt", [0.0, H])
def test_both_engines_allocate_a_law_with_memory_equally(dt):
    pytest.importorskip("numba")
    robot, policy, lin = allocated(dt)
    one, other = (
        flown(robot, policy, lin, engine, duration=6.0)
        for engine in ("python", "compiled")
    )
    assert np.abs(one.x - other.x).max() < 1e-10


@pytest.mark.parametrize("seed", range(4))
def test_the_nearest_inputs_without_bounds_are_those_of_the_pseudoinverse(seed):
    """Also if inputs depend on each other, with forces of any size."""
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(2, 9, 2)
    A = rng.normal(size=(rows, columns))[:, rng.integers(0, columns, columns)]
    b = 1e-6 * rng.normal(size=rows)
    expected = np.linalg.pinv(A) @ b
    found = nearest_unbounded(A, b)
    assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()
    assert not nearest_unbounded(A, 0.0 * b).any()
    assert np.isnan(nearest_unbounded(A, np.nan * b)).all()
