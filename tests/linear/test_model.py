"""Sampling and hand-over to other libraries."""

import copy
import pickle
import sys
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import expm

import fflin
from tests.support.robots import random_point


@pytest.fixture(scope="module")
def rest():
    return fflin.linearize(fflin.load("ets_vii"))


@pytest.fixture(scope="module")
def moving():
    robot = fflin.load("ets_vii")
    return fflin.linearize(robot, *random_point(robot, np.random.default_rng(1)))


def test_hold_at_rest_is_the_closed_form(rest):
    h = 0.25
    sampled = rest.discretize(h)
    assert (sampled.A == np.eye(24) + rest.A * h).all()
    assert sampled.B == pytest.approx(
        rest.B * h + rest.A @ rest.B * h**2 / 2, rel=1e-15
    )
    assert sampled.dt == h and not sampled.f0.any()


def test_hold_is_exact_anywhere(moving):
    """Two steps of h are one of 2h under the same input, and a small step is the derivative."""
    h = 0.05
    one, two = moving.discretize(h), moving.discretize(2 * h)
    assert one.A @ one.A == pytest.approx(two.A, rel=1e-9, abs=1e-9)
    assert one.A @ one.B + one.B == pytest.approx(two.B, rel=1e-9, abs=1e-9)
    assert one.A @ one.f0 + one.f0 == pytest.approx(two.f0, rel=1e-9, abs=1e-9)
    assert one.A == pytest.approx(expm(moving.A * h), rel=1e-12, abs=1e-12)
    tiny = moving.discretize(1e-6)
    assert (tiny.A - np.eye(24)) / 1e-6 == pytest.approx(moving.A, abs=1e-4)
    assert tiny.f0 / 1e-6 == pytest.approx(moving.f0, rel=1e-4, abs=1e-4)


def test_invalid_sampling_times(rest):
    for dt in (0.0, -0.1):
        with pytest.raises(fflin.InputError, match="expected more than 0"):
            rest.discretize(dt)
    for dt in (np.nan, "fast"):
        with pytest.raises(fflin.InputError, match="dt"):
            rest.discretize(dt)
    with pytest.raises(fflin.InputError, match="True"):
        rest.discretize(True)
    with pytest.raises(fflin.InputError, match="sampled"):
        rest.discretize(0.1).discretize(0.1)


def test_scipy_and_control_take_it(rest):
    for dt in (0.0, 0.1):
        lin = rest.discretize(dt) if dt else rest
        for system in (lin.to_scipy(), lin.to_control()):
            assert (system.A == lin.A).all() and (system.B == lin.B).all()
            assert (system.C == lin.C).all() and (system.D == lin.D).all()
        assert lin.to_scipy().dt == (dt or None)
        system = lin.to_control()
        assert system.dt == dt
        assert system.state_labels[0] == "q_b_x"
        assert system.input_labels[-1] == "tau_m_joint_6"


def test_missing_control_says_how_to_get_it(rest, monkeypatch):
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(fflin.MissingPackageError, match=r"'fflin\[control\]'"):
        rest.to_control()


def test_equilibrium_is_distinguished_from_motion(rest, moving):
    assert rest.is_equilibrium() and not moving.is_equilibrium()


def test_repr_names_the_class_and_its_contents(rest):
    assert (
        repr(rest)
        == "LinearModel('ets_vii', nx=24, nu=12, ny=24, frame='hybrid', continuous)"
    )
    assert "dt=0.1 s" in repr(rest.discretize(0.1))


def test_lazily_computed_results_survive_copies_and_pickles(robots):
    robot = robots["servicer_7dof"]
    q = fflin.configuration(
        robot, {"joint_2": 0.4}, pin.SE3(np.eye(3), np.array([1.0, 2.0, 3.0]))
    )
    expected = np.zeros(30)
    expected[6 + robot.joint_names.index("joint_2")] = 0.4
    for again in (
        copy.copy,
        copy.deepcopy,
        replace,
        lambda lin: pickle.loads(pickle.dumps(lin)),
    ):
        lin = again(fflin.linearize(robot, q))
        for name in ("x0", "y0"):
            assert getattr(lin, name) == pytest.approx(expected, abs=1e-15)
            assert getattr(lin, name) is getattr(lin, name)
            assert not getattr(lin, name).flags.writeable
        assert lin.reference.translation == pytest.approx([1.0, 2.0, 3.0])
        with pytest.raises(AttributeError, match="'x1'"):
            lin.x1  # noqa: B018 - the access raises


def test_a_changed_model_copies_the_array_that_it_is_given(rest):
    A = rest.A.copy()
    changed = replace(rest, A=A)
    A[0, 0] = 7.0
    assert changed.A[0, 0] == rest.A[0, 0] and not changed.A.flags.writeable
    with pytest.raises(FrozenInstanceError):
        changed.A = A
