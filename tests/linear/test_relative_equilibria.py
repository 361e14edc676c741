"""Libration and relative equilibria in orbit, against closed forms."""

import math

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.marks import exhaustive
from tests.support.orbits import in_orbit
from tests.support.robots import free_body

LEO, GEO = 1.06e-3, 7.29e-5  # [rad/s]
BODIES = (
    (3.0, 5.0, 4.0),
    (0.0062, 0.0146, 0.0152),
    (2000.0, 1000.0, 2800.0),
    (5.0, 5.0, 3.0),
)


def matched(result, expected):
    """The largest distance of poles to those that are expected, one to one."""
    left, worst = list(result), 0.0
    assert len(left) == len(expected)
    for pole in expected:
        nearest = min(left, key=lambda other: abs(other - pole))
        left.remove(nearest)
        worst = max(worst, abs(nearest - pole))
    return worst


@pytest.mark.parametrize(
    ("frame", "n"),
    [
        ("lvlh", 0.3),
        ("hill", LEO),
        *exhaustive(("lvlh", LEO), ("lvlh", GEO), ("hill", 0.3), ("hill", GEO)),
    ],
)
def test_libration_has_the_poles_of_textbooks(n, frame):
    for moments in BODIES:
        robot = in_orbit(free_body(moments), n)
        result = fflin.relative_equilibria(robot, frame=frame)
        assert len(result) == 24
        for one in result:
            radial, along, normal = one.moments
            pitch = n * np.emath.sqrt(3.0 * (radial - along) / normal)
            k_a, k_r = (normal - radial) / along, (normal - along) / radial
            quartic = np.roots([1.0, 0.0, 1 + 3 * k_a + k_a * k_r, 0.0, 4 * k_a * k_r])
            about = pin.XYZQUATToSE3(one.q[:7])
            lin = fflin.linearize(robot, one.q, frame=frame, reference=about)
            assert np.abs(lin.f0).max() < 1e-15 * n
            seen = fflin.modes(lin)
            # Clohessy and Wiltshire's translation beside it.
            poles = [pitch, -pitch, *(n * quartic), 0, 0, *(2 * [n * 1j, -n * 1j])]
            # A quartic's double roots are known to half the digits.
            separate = abs(k_a * k_r) > 1e-12
            assert matched(seen.poles, [*one.poles, *poles[6:]]) < 1e-12 * n
            assert not separate or matched(one.poles, poles[:6]) < 1e-12 * n
            if one.stable is not None:
                assert one.stable is not bool(seen.unstable)
            assert (one.stable is None) == (abs(one.margin) <= 1.0)


def test_pitch_libration_of_a_stable_body_is_the_closed_form():
    x, y, z = 4.0, 5.0, 3.0  # along, normal, radial
    robot = in_orbit(free_body((x, y, z)), LEO)
    poles = fflin.modes(fflin.linearize(robot)).frequencies
    assert np.abs(poles - LEO * math.sqrt(3.0 * (x - z) / y)).min() < 1e-12 * LEO


def test_the_kinds_of_attitudes_are_reported_and_margins_decide():
    stable, *others = fflin.relative_equilibria(
        in_orbit(free_body((3.0, 5.0, 4.0)), LEO)
    )[::4]
    assert stable.stable and tuple(stable.moments) == pytest.approx((3.0, 4.0, 5.0))
    assert all(
        one.stable is False and one.poles.real.max() > 1e-5 * LEO for one in others
    )
    even = fflin.relative_equilibria(in_orbit(free_body((3.0, 3.0, 3.0)), LEO))
    assert all(one.stable is None for one in even)
    assert "undecided" in str(even) and "stable" not in str(even)
    # DeBra and Delp's: the least moment along the normal.
    beyond = fflin.relative_equilibria(in_orbit(free_body((1.0, 1.275, 0.9745)), LEO))
    kinds = [tuple(np.argsort(one.moments)) for one in beyond if one.stable]
    assert len(kinds) == 8


def test_models_without_such_attitudes_are_refused():
    robot = fflin.load("cubesat", orbit=700e3)
    wheel = fflin.ReactionWheel([0.0, 1.0, 0.0], momentum=0.02)
    with pytest.raises(fflin.InputError, match="momentum"):
        fflin.relative_equilibria(robot.replace(inputs=[wheel]))
    rod = free_body((1.0, 1.0, 0.0)).replace(orbit=700e3)
    with pytest.raises(fflin.SingularInertiaError, match="inertia"):
        fflin.relative_equilibria(rod)


def test_joints_hold_their_posture_in_a_relative_equilibrium():
    robot = fflin.load("servicer_7dof", orbit=800e3)
    robot = robot.replace(
        inputs=[fflin.JointTorque(name) for name in robot.joint_names]
    )
    q = fflin.configuration(robot, {"joint_2": 0.5, "joint_4": -0.8})
    for one in fflin.relative_equilibria(robot, q)[:8:3]:
        assert np.array_equal(one.q[7:], q[7:])
        held = fflin.equilibrium(robot, one.q, reference=pin.XYZQUATToSE3(one.q[:7]))
        assert held.u.any()
    stands = fflin.configuration(robot, {"joint_2": 0.5})
    with pytest.raises(fflin.EquilibriumError, match="balance"):
        fflin.equilibrium(robot, stands)
