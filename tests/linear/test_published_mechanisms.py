"""Mechanisms with closed loops, compared with published numbers to the digits in print.

- Andrews' squeezing mechanism: seven bodies, initial accelerations and forces of E. Hairer and
  G. Wanner, Solving Ordinary Differential Equations II, section VII.7, and of the Test Set for
  Initial Value Problem Solvers, Bari.
- Four-bar linkage: R. L. Norton, Design of Machinery, examples 4-1, 6-7 and 7-1.
- Bennett linkage: G. T. Bennett, A new mechanism, Engineering 76, 1903.
"""

from math import cos, pi, sin

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.constrained import Build, at, rod
from tests.support.marks import exhaustive

PLANAR = ("force.x", "force.y")

# Positions beta, theta, gamma, phi, delta, Omega, epsilon [rad] at t = 0, where the crank stands
# with theta = 0.
SQUEEZER = {
    "beta": -0.0617138900142764496358948458001,
    "theta": 0.0,
    "gamma": 0.455279819163070380255912382449,
    "phi": 0.222668390165885884674473185609,
    "delta": 0.487364979543842550225598953530,
    "omega": -0.222668390165885884674473185609,
    "epsilon": 1.23054744454982119249735015568,
}


def body(mass, inertia, x, y):
    """A body of a planar mechanism; the moments in the plane have no effect."""
    spin = np.diag((inertia, inertia, inertia))
    return pin.Inertia(mass, np.array((x, y, 0.0)), spin)


def squeezer():
    """Andrews' squeezing mechanism, whose six hinges to the ground and between bodies close it."""
    xa, ya, xb, yb = -0.06934, -0.00227, -0.03635, 0.03273
    build = Build(body(1.0, 1.0, 0.0, 0.0))
    turning = pin.JointModelRZ
    crank = build.add(1, turning(), at(), "beta", body(0.04325, 2.194e-6, 0.92e-3, 0))
    # Body 2 points from the tip of the crank against its own x.
    rocker = build.add(
        crank, turning(), at(7e-3), "theta", body(0.00365, 4.410e-7, -11.5e-3, 0)
    )
    # Body 3 points along -y at gamma = 0, and body 7 at epsilon = 0.
    lever = body(0.02373, 5.255e-6, 10.43e-3, -18.74e-3)
    lever = build.add(1, turning(), at(xb, yb), "gamma", lever)
    arm = body(0.07050, 1.169e-5, 23.08e-3, 9.16e-3)
    arm = build.add(1, turning(), at(xa, ya), "delta", arm)
    fork = body(0.00706, 5.667e-7, 0.0, -(20e-3 - 14.21e-3))
    fork = build.add(arm, turning(), at(40e-3), "phi", fork)
    leg = body(0.05498, 1.912e-5, -4.49e-3, -12.28e-3)
    leg = build.add(1, turning(), at(xa, ya), "epsilon", leg)
    hand = body(0.00706, 5.667e-7, 20e-3 - 14.21e-3, 0.0)
    hand = build.add(leg, turning(), at(0.0, -40e-3), "omega", hand)
    build.frame("end", rocker, at(-28e-3))
    build.frame("lever_end", lever, at(0.0, -35e-3))
    build.frame("fork_end", fork, at(0.0, -20e-3))
    build.frame("hand_end", hand, at(20e-3))
    held = [
        fflin.Weld("base", placement=at()),
        fflin.Hinge("lever_end", "end", placement=at(), name="lever"),
        fflin.Hinge("fork_end", "end", placement=at(), name="fork"),
        fflin.Hinge("hand_end", "end", placement=at(), name="hand"),
    ]
    return build.robot("squeezer", constraints=held)


def squeezer_effort(robot):
    """The motor of 0.033 N m, and the torque of the spring from (xc, yc) on the lever."""
    gamma = SQUEEZER["gamma"]
    sc, sd = 18e-3, 20e-3
    x = sd * cos(gamma) + sc * sin(gamma) - 0.03635 - 0.014
    y = sd * sin(gamma) - sc * cos(gamma) + 0.03273 - 0.072
    length = np.hypot(x, y)
    force = 4530.0 * (length - 0.07785) / length
    along_x = sc * cos(gamma) - sd * sin(gamma)
    along_y = sd * cos(gamma) + sc * sin(gamma)
    torque = -force * (x * along_x + y * along_y)
    return fflin.effort(robot, {"tau_m.beta": 0.033, "tau_m.gamma": torque})


@pytest.mark.exhaustive
def test_andrews_squeezer_starts_with_the_published_accelerations():
    robot = squeezer()
    q = fflin.configuration(robot, SQUEEZER)
    u = squeezer_effort(robot)
    lin = fflin.linearize(robot, q, u=u, independent=["beta"])
    assert lin.rank == 12  # 6 of the ground and 2 of each loop
    rates = dict(zip(lin.state_names, lin.f0, strict=True))
    assert rates["qdot_m.beta"] == pytest.approx(14222.4439199541138706, rel=1e-10)
    # theta follows from beta: C has the ratio of the rates
    ratio = lin.C[lin.output_names.index("qdot_m.theta"), 1]
    acceleration = ratio * rates["qdot_m.beta"]
    assert acceleration == pytest.approx(-10666.8329399655854, rel=1e-10)
    for name in ("gamma", "phi", "delta", "omega", "epsilon"):
        # At theta = 0 the crank is stretched, and the other bodies are at rest.
        rest = lin.C[lin.output_names.index(f"qdot_m.{name}"), 1]
        assert abs(rest) < 1e-10
    assert fflin.check(robot, lin).ok


def test_andrews_squeezer_has_the_published_forces():
    robot = squeezer()
    outputs = [fflin.ConstraintForce(x, PLANAR) for x in ("lever", "fork", "hand")]
    robot = robot.replace(outputs=outputs)
    q = fflin.configuration(robot, SQUEEZER)
    lin = fflin.linearize(robot, q, u=squeezer_effort(robot), independent=["beta"])
    axes = pin.rpy.rpyToMatrix(0.0, 0.0, SQUEEZER["beta"] + SQUEEZER["theta"])
    forces = np.zeros((3, 3))
    forces[:, :2] = lin.y0.reshape(3, 2)
    # The multipliers are the forces on the crank's end in axes of the ground.
    multipliers = np.abs((forces @ axes.T)[:, :2])
    expected = [[98.5668703962410896, 6.12268834425566], [0, 0], [0, 0]]
    np.testing.assert_allclose(multipliers, expected, rtol=1e-10, atol=1e-9)


# Norton's linkage: lengths [mm] of ground, crank, coupler and rocker
GROUND, CRANK, COUPLER, ROCKER = 0.100, 0.040, 0.120, 0.080


def four_bar():
    """The linkage on a welded ground, with the open circuit at a crank angle of 40 deg."""
    build = Build(pin.Inertia(1.0, np.zeros(3), np.eye(3)))
    turning = pin.JointModelRZ
    crank = build.add(1, turning(), at(), "crank", rod(1.0, CRANK))
    coupler = build.add(crank, turning(), at(CRANK), "coupler", rod(1.0, COUPLER))
    rocker = build.add(1, turning(), at(GROUND), "rocker", rod(1.0, ROCKER))
    build.frame("coupler_end", coupler, at(COUPLER))
    build.frame("rocker_end", rocker, at(ROCKER))
    held = [
        fflin.Weld("base", placement=at()),
        fflin.Weld("crank", placement=pin.SE3(_about_z(40.0), np.zeros(3))),
        fflin.Spherical("coupler_end", "rocker_end", placement=at(), name="pin"),
    ]
    return build.robot("four_bar", constraints=held)


def _about_z(degrees):
    return pin.rpy.rpyToMatrix(0.0, 0.0, np.radians(degrees))


@pytest.mark.parametrize(
    ("circuit", "coupler", "rocker"),
    [("open", 20.30, 57.33), ("crossed", -60.98, -98.01)],
)
def test_nortons_four_bar_has_the_published_angles(circuit, coupler, rocker):
    robot = four_bar()
    near = {"crank": 0.7, "coupler": -0.3, "rocker": 1.1}
    if circuit == "crossed":
        near = {"crank": 0.7, "coupler": -1.7, "rocker": -1.7}
    q = fflin.closed(robot, fflin.configuration(robot, near))
    angles = {x.name: np.degrees(x.value(q)) for x in robot.joints}
    # The book rounds the coefficients of the equation before it solves it.
    assert angles["crank"] + angles["coupler"] == pytest.approx(coupler, abs=0.01)
    assert angles["rocker"] == pytest.approx(rocker, abs=0.01)


def test_nortons_four_bar_has_the_published_rates_and_accelerations():
    robot = four_bar()
    near = {"crank": 0.7, "coupler": -0.3, "rocker": 1.1}
    q = fflin.closed(robot, fflin.configuration(robot, near))
    free = [item for item in robot.constraints if item.title != "crank"]
    robot = robot.replace(constraints=free)
    v = fflin.velocity(robot, {"crank": 25.0, "coupler": -29.0, "rocker": 7.0})
    q, v = fflin.closed(robot, q, v)
    v *= 25.0 / v[6]
    lin = fflin.linearize(robot, q, v, independent=["crank"])
    rates = {x.name: float(v[x.idx_v]) for x in robot.joints}
    assert round(rates["crank"] + rates["coupler"], 3) == -4.121
    assert round(rates["rocker"], 3) == 6.998
    # A change of the crank's angle and of its rate changes the other rates.
    changes = {
        name: lin.C[lin.output_names.index(f"qdot_m.{name}")] @ (25.0, 15.0)
        for name in ("crank", "coupler", "rocker")
    }
    assert round(changes["crank"] + changes["coupler"], 3) == 296.089
    assert round(changes["rocker"], 3) == 470.134
    assert fflin.check(robot, lin).ok


def bennett(a, alpha, beta, theta):
    """A Bennett linkage: twists alpha, beta, and sides a, a sin(beta) / sin(alpha), alternating.

    Each link turns about z of its joint, and carries the next joint at its side along x, twisted
    about x. Bennett's condition is a / sin(alpha) = b / sin(beta).
    """
    b = a * sin(beta) / sin(alpha)
    build = Build(pin.Inertia(1.0, np.zeros(3), np.eye(3)))

    def next_joint(side, twist):
        return pin.SE3(pin.rpy.rpyToMatrix(twist, 0.0, 0.0), np.array((side, 0.0, 0.0)))

    turning, links = pin.JointModelRZ, []
    parent, placement = 1, next_joint(a, alpha)
    for index, (side, twist) in enumerate([(b, beta), (a, alpha), (b, beta)]):
        inertia = rod(1.0, side)
        parent = build.add(parent, turning(), placement, f"joint_{index + 1}", inertia)
        placement = next_joint(side, twist)
        links.append(parent)
    build.frame("last", parent, placement)
    build.frame("first", build.base, at())
    hinge = fflin.Hinge("last", "first", axis=(0, 0, 1), placement=at(), name="joint_4")
    robot = build.robot("bennett", constraints=[hinge])
    # Bennett's equation, for angles that both count in the sense of the twists.
    product = sin((beta + alpha) / 2) / sin((beta - alpha) / 2)
    phi = -2.0 * np.arctan2(product, np.tan(theta / 2.0))
    return robot, phi


@pytest.mark.parametrize("theta", [0.7, *exhaustive(1.5, 2.6)])
def test_a_bennett_linkage_moves_though_it_is_overconstrained(theta):
    a, alpha, beta = 0.8, 0.5, 1.1
    robot, phi = bennett(a, alpha, beta, theta)
    angles = {"joint_1": theta, "joint_2": phi, "joint_3": 2 * pi - theta}
    q = fflin.configuration(robot, angles)
    # The four hinges have 24 - 20 = 4 velocities less than bodies, yet one remains.
    closed = fflin.closed(robot, q)
    np.testing.assert_allclose(closed, q, atol=1e-10)
    lin = fflin.linearize(robot, q, independent=["q_b", "r_b", "joint_1"])
    assert (lin.rank, len(lin.state_names)) == (2, 14)
    assert fflin.check(robot, lin).ok
    # tan(theta / 2) tan(phi / 2) is constant, so that dphi / dtheta = - sin(phi) / sin(theta).
    column = lin.state_names.index("qdot_m.joint_1")
    ratio = lin.C[lin.output_names.index("qdot_m.joint_2"), column]
    assert ratio == pytest.approx(-sin(phi) / sin(theta), abs=1e-9)
