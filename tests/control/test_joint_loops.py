"""Loops of joints that rotate a floating base: area rule, closed form, and the initial guess."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.control.optimal import joint_loops
from fflin.control.optimal.floating_base import FloatingBase
from fflin.control.optimal.initial_guess import initial_guess
from fflin.control.optimal.joint_loops import (
    MOST_CIRCLES,
    STEPS,
    Loops,
    best_plane,
    curvature,
)
from fflin.control.optimal.shooting import Shooting
from tests.support.mechanisms import motors
from tests.support.robots import random_tree

# mass [kg] and inertia [kg m^2] of the hub, mass [kg]
HUB, INERTIA, POINT = 5.0, 0.8, 1.5


def polar_of(unit):
    """A hub with a point mass that turns about its centre of mass and slides radially.

    Masses and inertias are multiplied by `unit`.
    """
    model = pin.Model()
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    hub = pin.Inertia(unit * HUB, np.zeros(3), unit * INERTIA * np.eye(3))
    model.appendBodyToJoint(1, hub, pin.SE3.Identity())
    turn = model.addJoint(1, pin.JointModelRZ(), pin.SE3.Identity(), "turn")
    slide = model.addJoint(turn, pin.JointModelPX(), pin.SE3.Identity(), "slide")
    point = pin.Inertia(unit * POINT, np.zeros(3), np.zeros((3, 3)))
    model.appendBodyToJoint(slide, point, pin.SE3.Identity())
    return fflin.from_model(model, name="polar")


@pytest.fixture(scope="module")
def polar():
    return polar_of(1.0)


def base_at_rest(robot, q=None):
    state = fflin.StateMap(robot, frame="local")
    return FloatingBase(
        state, (robot.neutral() if q is None else q, np.zeros(robot.nv))
    )


def rotation_vector(base, joints):
    t = np.linspace(0.0, 1.0, len(joints))
    R = base.rotations(t, joints)
    return pin.log3(R[0].T @ R[-1])


def fraction(r):
    """Rotation of the hub per rotation of the point mass, at the distance r [m]."""
    reduced = HUB * POINT / (HUB + POINT)
    return reduced * r**2 / (INERTIA + reduced * r**2)


def test_a_loop_of_a_turn_and_a_slide_has_the_closed_form(polar):
    """Out at the angle 0, turn by alpha, in, turn back: -alpha (f(r_2) - f(r_1)), of any size."""
    alpha, inner, outer = 2.0, 0.4, 1.1
    corners = np.array(
        [(0, inner), (0, outer), (alpha, outer), (alpha, inner), (0, inner)]
    )
    joints = np.vstack([np.linspace(a, b, 9) for a, b in pairwise(corners)])
    turned = rotation_vector(base_at_rest(polar), joints)
    # The midpoint rule is exact here, because each leg changes one coordinate only.
    exact = -alpha * (fraction(outer) - fraction(inner))
    assert turned == pytest.approx([0.0, 0.0, exact], abs=1e-13)


def test_curvature_of_a_turn_and_a_slide_has_the_closed_form(polar):
    reduced, r = HUB * POINT / (HUB + POINT), 0.7
    F = curvature(base_at_rest(polar), np.array([0.3, r]))
    exact = 2.0 * reduced * r * INERTIA / (INERTIA + reduced * r**2) ** 2
    # Central differences with a step of 1e-4 have an error of 1e-8.
    assert F[0, 1] == pytest.approx([0.0, 0.0, exact], abs=1e-7)
    assert F[1, 0] == pytest.approx(-F[0, 1], abs=1e-15)


def test_the_area_rule_is_the_limit_of_small_loops():
    """In three dimensions, the error of the rule for a circle of radius e is of the order e^4."""
    rng = np.random.default_rng(3)
    robot = random_tree(rng, 4)
    base, centre = base_at_rest(robot), rng.uniform(-1.0, 1.0, 4)
    F = curvature(base, centre)
    a, b = np.linalg.qr(rng.normal(size=(4, 2)))[0].T
    phase = np.linspace(0.0, 2.0 * np.pi, 2001)[:, None]
    rule = np.pi * np.einsum("i,j,ijk", a, b, F)
    errors = []
    for e in (0.04, 0.02):
        circle = centre + e * (np.cos(phase) * a + np.sin(phase) * b)
        # The base turns by the joints on the way to the circle and back, in other axes.
        path = np.linspace(centre, circle[0], 101)
        loop = np.vstack((path, circle, path[::-1]))
        errors.append(np.abs(rotation_vector(base, loop) / e**2 - rule).max())
    assert errors[0] < 0.02 * np.abs(rule).max()
    assert errors[1] < 0.6 * errors[0]


def test_the_best_plane_rotates_more_than_any_other():
    rng = np.random.default_rng(4)
    F = rng.normal(size=(5, 5, 3))
    F = F - F.transpose(1, 0, 2)
    turn, scale = rng.normal(size=3), rng.uniform(0.2, 1.0, 5)
    a, b, most = best_plane(F, turn, scale)
    about = np.einsum("i,ijk,j,k", scale * a, F, scale * b, turn / np.linalg.norm(turn))
    assert about == pytest.approx(most, rel=1e-12)
    assert np.array((a @ a, b @ b, a @ b)) == pytest.approx([1.0, 1.0, 0.0], abs=1e-12)
    pairs = np.linalg.qr(rng.normal(size=(1000, 5, 2)))[0] * scale[:, None]
    others = np.einsum(
        "nia,ijk,njb,k->nab", pairs, F, pairs, turn / np.linalg.norm(turn)
    )
    assert np.abs(others).max() < most


def test_the_floating_base_moves_as_in_a_simulation():
    """With gravity, momentum and motors; the midpoint rule has an error of the order h^2."""
    robot = random_tree(np.random.default_rng(5), 3)
    robot = robot.replace(gravity=(0.1, -0.2, -0.5), inputs=motors(robot))
    rng = np.random.default_rng(6)
    pose = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))
    q0 = fflin.configuration(robot, {robot.joint_names[1]: 0.4}, pose)
    v0 = 0.3 * rng.normal(size=robot.nv)
    state = fflin.StateMap(robot, frame="local")
    run = fflin.simulate(robot, q0=q0, v0=v0, duration=1.0, dt=2e-3, sample=4e-3)
    _, q, v = fflin.StateMap(robot).points(run.x)
    joints, rates = state.joint_positions(q), state.velocities(v)[:, 6:]
    joints = np.unwrap(joints, axis=0)
    errors = []
    for every in (10, 5):
        t = run.t[::every]
        base = FloatingBase(state, (q0, v0))
        R = base.rotations(t, joints[::every])
        result = base.motion(t, joints[::every], rates[::every], R)
        pairs = zip(q[::every], result[0], strict=True)
        gaps = [pin.difference(robot.model, *pair) for pair in pairs]
        errors.append(max(np.abs(gaps).max(), np.abs(v[::every] - result[1]).max()))
    assert errors[0] < 1e-2 and errors[1] < 0.3 * errors[0]


def loops_of(robot, start, target, limits=None):
    base, n = base_at_rest(robot, start), robot.n
    joints = fflin.StateMap(robot).joint_positions(start)
    bounds = np.full((2, 2, n), np.inf) * np.array([[[-1.0]], [[1.0]]])
    if limits is not None:
        bounds[:, 0] = limits
    t = np.linspace(0.0, 10.0, STEPS * MOST_CIRCLES + 1)
    path, every = np.tile(joints, (len(t), 1)), np.full(3, True)
    return Loops(base, t, path, np.arange(n), target, every, bounds, np.ones(n))


@pytest.mark.exhaustive
@pytest.mark.parametrize("degrees", [-20.0, 5.0])
def test_loops_of_a_turn_and_a_slide_reach_an_attitude_within_limits(polar, degrees):
    start = fflin.configuration(polar, {"slide": 0.6})
    target = pin.exp3(np.deg2rad(degrees) * np.array([0.0, 0.0, 1.0]))
    limits = np.array([[-2.0, 0.3], [2.0, 1.0]])
    loops = loops_of(polar, start, target, limits)
    joints, error = loops.best(2)
    assert error < 0.01 and np.linalg.norm(loops.error(joints)) < 0.01
    # The violation of a limit is at most the error times the scale of the joint.
    assert (joints >= limits[0] - 0.01).all() and (joints <= limits[1] + 0.01).all()
    assert joints[0] == pytest.approx(loops.path[0], abs=1e-12)
    assert joints[-1] == pytest.approx(loops.path[0], abs=1e-12)


def test_loops_do_not_depend_on_the_unit_of_mass(monkeypatch):
    # The attitude depends on ratios of masses only, and torques are compared with the torques of
    # the first ellipse. So the first residuals are equal.
    residuals = []

    def recorded(function, start, **_):
        residuals.append(function(start))
        return SimpleNamespace(x=start)

    monkeypatch.setattr(joint_loops, "least_squares", recorded)
    target = pin.exp3(np.array([0.0, 0.0, 0.1]))
    for unit in (1.0, 1e3):
        robot = polar_of(unit)
        start = fflin.configuration(robot, {"slide": 0.6})
        loops = loops_of(robot, start, target)
        loops = replace(loops, t=loops.t[::20], path=loops.path[::20])
        next(loops.improved(1, np.array([[1.0, 0.0]])))
    assert np.abs(residuals[0]).max() > 1e-3
    assert residuals[1] == pytest.approx(residuals[0], rel=1e-6, abs=1e-9)


@pytest.mark.exhaustive
def test_more_circles_reach_an_attitude_that_one_circle_cannot(polar):
    start = fflin.configuration(polar, {"slide": 0.6})
    target = pin.exp3(np.deg2rad(20.0) * np.array([0.0, 0.0, 1.0]))
    limits = np.array([[-0.5, 0.3], [0.5, 0.9]])
    # No loop within the limits rotates the hub by more than its rectangle.
    most = 1.0 * (fraction(0.9) - fraction(0.3))
    assert most < np.deg2rad(25.0)
    loops = loops_of(polar, start, target, limits)
    assert loops.best(1)[1] > 0.02 and loops.best(4)[1] < 0.01


def test_many_knots_allow_no_more_circles_than_the_path_has_steps_for(monkeypatch):
    allowed = []

    def best(loops, most):
        allowed.append(most)
        return loops.path, 1.0

    monkeypatch.setattr(Loops, "best", best)
    robot = fflin.load("planar_detumble")
    robot = robot.replace(inputs=motors(robot))
    start = robot.neutral(), np.zeros(robot.nv)
    end = robot.neutral(), np.zeros(robot.nv)
    end[0][3:7] = [0.0, np.sin(0.1), 0.0, np.cos(0.1)]
    nx = 12 + 2 * robot.n
    for knots, most in ((20, 2), (150, MOST_CIRCLES)):
        shooting = Shooting(robot, np.linspace(0.0, 10.0, knots), held=True)
        bounds = np.full((2, nx), np.inf) * [[-1.0], [1.0]]
        initial_guess(
            shooting, None, start, end, np.full(nx, True), bounds, np.ones(robot.n)
        )
        assert allowed.pop() == most


@pytest.mark.exhaustive
@pytest.mark.parametrize("n", [2, 3, 5])
def test_loops_reach_attitudes_that_other_loops_reach(n):
    """Targets are the ends of random ellipses of all joints of random robots."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        robot = random_tree(rng, n, prismatic=False)
        phase = np.linspace(0.0, 2.0 * np.pi, 385)
        basis = np.array([1.0 - np.cos(phase), np.sin(phase)]).T
        known = basis @ rng.normal(scale=0.6, size=(2, n))
        target = pin.exp3(rotation_vector(base_at_rest(robot), known))
        loops = loops_of(robot, robot.neutral(), target)
        joints, error = loops.best(4)
        # Least squares leave less than 0.03 of the rotation, see `_NEAR`.
        assert error <= 0.03 * np.linalg.norm(pin.log3(target))
        assert np.linalg.norm(loops.error(joints)) == pytest.approx(error, rel=1e-6)
