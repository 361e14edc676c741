"""What inputs reach in orbit, and what designs hold there, against closed forms."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.orbits import in_orbit
from tests.support.robots import free_body

LEO, GEO = 1.06e-3, 7.29e-5  # [rad/s]


def test_passive_panels_sag_next_to_motors_in_a_relative_equilibrium():
    robot = fflin.load("servicer_7dof", orbit=800e3, passive=["panel_*"])
    robot = robot.replace(stiffness={"panel_*": 40.0})
    q = fflin.relative_equilibria(robot, fflin.configuration(robot, {"joint_2": 0.5}))[
        0
    ].q
    about = pin.XYZQUATToSE3(q[:7])
    held = fflin.equilibrium(robot, q, reference=about)
    lin = fflin.linearize(robot, held.q, u=held.u, reference=about)
    assert held.sag.any() and fflin.modes(lin).equilibrium and not lin.x0[:6].any()


@pytest.mark.parametrize("n", [0.3, LEO, GEO])
def test_reachable_forces_of_thrusters_are_known(n):
    """Along the orbit all of the plane, away from the body all but one; askew, as the plane and
    what is across it have the poles +-jn alike, no more than four."""
    robot = in_orbit(free_body((3.0, 5.0, 4.0)), n)
    frame, center = robot.model.frames[-1].name, (0.0, 0.0, 0.0)
    expected = {
        (0.0, 1.0, 0.0): 4,
        (1.0, 0.0, 0.0): 3,
        (0.0, 0.0, 1.0): 2,
        (1.0, 1.0, 1.0): 4,
    }
    for direction, dimension in expected.items():
        thrust = robot.replace(inputs=[fflin.Thruster(frame, center, direction)])
        lin = fflin.linearize(thrust, frame="hill")
        result = fflin.controllability(lin)
        assert (result.dimension, result.stabilizable) == (dimension, False)
        assert not len(fflin.momentum_reduction(lin).momenta)
        assert fflin.observability(lin).dimension == 12
    # The drift of a radial thrust's orbit, dy/dt + 2 n x, is what it cannot change.
    radial = fflin.linearize(
        robot.replace(inputs=[fflin.Thruster(frame, center, (1.0, 0.0, 0.0))]),
        frame="hill",
    )
    row = np.zeros(12)
    row[[3, 10]] = 2.0 * n, 1.0
    rows = fflin.controllability(radial).rows
    assert (
        np.linalg.matrix_rank(
            np.vstack((rows, row)) / [*(6 * [n]), *(6 * [1.0])], tol=1e-9
        )
        == 9
    )


def test_joints_alone_turn_the_base_against_the_gradient():
    """Momentum is not conserved in orbit, so that attitude and joints are controllable."""
    robot = fflin.load("servicer_7dof", orbit=800e3)
    robot = robot.replace(
        inputs=[fflin.JointTorque(name) for name in robot.joint_names]
    )
    at = fflin.relative_equilibria(robot)[0].q
    about = {"reference": pin.XYZQUATToSE3(at[:7])}
    held = fflin.equilibrium(robot, at, **about).u
    lin = fflin.linearize(robot, at, u=held, **about)
    assert fflin.controllability(lin).dimension == 2 * (3 + robot.n)


@pytest.mark.parametrize("n", [LEO, GEO])
def test_regulators_hold_the_orbits_terms(n):
    robot = in_orbit(fflin.load("servicer_7dof"), n)
    lin = fflin.linearize(robot, u=fflin.equilibrium(robot).u)
    for model in (lin, lin.discretize(0.5)):
        gain = fflin.lqr(model)
        assert gain.residual < 1e-12
        A = model.A - model.B @ gain.K
        beyond = np.linalg.eigvals(A)
        assert (np.abs(beyond).max() < 1.0) if model.dt else (beyond.real.max() < 0.0)
    assert "joint damping is included" not in str(fflin.lqr(lin))
    # A design about the point without its inputs finds them itself.
    np.testing.assert_array_equal(fflin.lqr(fflin.linearize(robot)).K, fflin.lqr(lin).K)


def test_wheels_stay_in_a_design_since_their_carrier_turns():
    robot = in_orbit(fflin.load("cubesat"), LEO)
    robot = robot.replace(
        inputs=[
            fflin.BaseForce(),
            *(fflin.ReactionWheel(axis, inertia=1e-4) for axis in np.eye(3)),
        ]
    )
    at = fflin.relative_equilibria(robot)[0].q
    lin = fflin.linearize(robot, at, reference=pin.XYZQUATToSE3(at[:7]))
    reduced = fflin.momentum_reduction(lin)
    assert [name for name in reduced.state_names if name.startswith("qdot_m.")]


def test_springs_that_are_much_stiffer_than_the_orbit_are_reported():
    robot = fflin.load("servicer_7dof", orbit=800e3).replace(stiffness=1e9)
    with pytest.warns(fflin.FflinWarning, match="rounding"):
        fflin.modes(fflin.linearize(robot))


def wheeled(name, orbit, **fields):
    """A robot at rest in an orbit, with three wheels and motors in its joints."""
    wheels = [
        fflin.ReactionWheel(axis, inertia=0.005, max=0.05, name=f"w{letter}")
        for axis, letter in zip(np.eye(3), "xyz", strict=True)
    ]
    robot = fflin.load(name, orbit=orbit, **fields)
    if robot.n:
        return robot.replace(inputs=[*wheels, fflin.JointTorque("*")])
    return robot.replace(inputs=wheels)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:ets_vii. unphysical")
@pytest.mark.parametrize("eccentricity", [0.0, 0.1])
@pytest.mark.parametrize(
    ("name", "locked", "expected"),
    [("cubesat", (), 12), ("ets_vii", [f"joint_{k}" for k in range(2, 7)], 14)],
)
def test_an_orbit_counts_as_many_states_as_its_linear_model_in_a_circle(
    name, locked, expected, eccentricity
):
    """Wheels and joints set all but the base position: six of the states are out of reach.

    Errors of the attitude grow up to 10^6 times in a period, but not in a part of it.
    """
    circle = fflin.CircularOrbit(altitude=1200e3)
    robot = wheeled(name, circle, lock=locked)
    held = fflin.relative_equilibria(robot, robot.neutral())[0]
    constant = fflin.linearize_orbit(robot, held.q, steps=32)[0]
    assert fflin.controllability(constant).dimension == expected
    orbit = circle
    if eccentricity:
        orbit = fflin.EllipticOrbit(perigee=500e3, eccentricity=eccentricity)
    along = fflin.linearize_orbit(robot.replace(orbit=orbit), held.q, steps=32)
    reached = fflin.controllability(along)
    assert reached.dimension == expected == len(along.state_names) - 6
    assert reached.margin.kept > 20.0 and reached.margin.dropped < 1e-3
    # All states are measured.
    seen = fflin.observability(along)
    assert seen.dimension == len(along.state_names)
    assert seen.margin.kept > 1e4
