"""The field of an orbit against sums over mass points, and its potential against its forces."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.aba import Aba
from fflin.dynamics.orbital import OrbitField
from fflin.dynamics.state import StateMap
from tests.support.robots import free_body, random_point, random_pose

N = 0.3  # so fast that it is seen beside the rest


def in_orbit(robot):
    return robot.replace(
        orbit=fflin.CircularOrbit(
            mean_motion=N, body="x", mu=N**2 * 1e12, body_radius=1.0
        )
    )


@pytest.mark.parametrize("frame", ["lvlh", "hill"])
def test_a_body_is_pulled_as_its_mass_points(frame):
    rng = np.random.default_rng(1)
    points, masses = rng.normal(size=(6, 3)), rng.uniform(1.0, 2.0, 6)
    flat, model = np.zeros((3, 3)), pin.Model()
    whole = pin.Inertia.Zero()
    for m, x in zip(masses, points, strict=True):
        whole += pin.Inertia(m, x, flat)
    model.appendBodyToJoint(
        model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root"),
        *(whole, pin.SE3.Identity()),
    )
    robot = in_orbit(fflin.from_model(model))
    q = fflin.configuration(robot, base=random_pose(rng, 70.0))
    field, data = OrbitField(robot, frame), robot.create_data()
    pin.forwardKinematics(robot.model, data, q)
    place, r = data.oMi[1], {"lvlh": [0, 0, -1.0], "hill": [1.0, 0, 0]}[frame]
    G = N**2 * (3.0 * np.outer(r, r) - np.eye(3))
    pulls = [
        place.rotation.T @ (m * G @ place.act(x))
        for m, x in zip(masses, points, strict=True)
    ]
    torque = sum(np.cross(x, pull) for x, pull in zip(points, pulls, strict=True))
    result = field.wrenches(data)[1]
    assert np.allclose(
        result.linear, sum(pulls), rtol=0, atol=1e-13 * np.abs(pulls).max()
    )
    assert np.allclose(result.angular, torque, rtol=0, atol=1e-13 * np.abs(pulls).max())


@pytest.mark.parametrize(
    ("frame", "radial", "along", "normal"),
    [("hill", (0, 1), (1, 1), (2, 1)), ("lvlh", (2, -1), (0, 1), (1, -1))],
)
def test_a_point_moves_as_clohessy_and_wiltshire_say(frame, radial, along, normal):
    robot = free_body((1.0, 1.0, 1.0))
    rng = np.random.default_rng(2)
    q, v, _ = random_point(robot, rng)
    state = StateMap(in_orbit(robot), frame=frame)
    a = Aba(state).acceleration(q, v, np.zeros(6))
    R = pin.Quaternion(q[3:7]).matrix()
    rate = R @ (a[:3] + np.cross(v[3:6], v[:3]))  # of the velocity in the frame's axes
    x, _, z = (sign * q[axis] for axis, sign in (radial, along, normal))
    speeds = R @ v[:3]
    dx, dy = (sign * speeds[axis] for axis, sign in (radial, along))
    expected = 3 * N**2 * x + 2 * N * dy, -2 * N * dx, -(N**2) * z
    got = [sign * rate[axis] for axis, sign in (radial, along, normal)]
    assert np.allclose(got, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", ["ets_vii", "cubesat", "canadarm2"])
@pytest.mark.parametrize("frame", ["lvlh", "hill"])
def test_a_free_motion_has_the_power_of_no_force(name, frame):
    """d/dt of the Jacobi integral is zero where nothing acts but the orbit."""
    robot = fflin.load(name)
    q, v, _ = random_point(robot, np.random.default_rng(3))
    state = StateMap(in_orbit(robot), frame=frame)
    aba, data = Aba(state), robot.create_data()
    a = aba.acceleration(q, v, np.zeros(len(aba.actuation.names)))

    def energies(t):
        place, speed = pin.integrate(robot.model, q, t * (v + 0.5 * t * a)), v + t * a
        pin.forwardKinematics(robot.model, data, place)
        potential = aba.field.potential(data)
        return np.array(
            [pin.computeKineticEnergy(robot.model, data, place, speed), potential]
        )

    h = 1e-4
    kinetic, potential = (energies(h) - energies(-h)) / (2.0 * h)
    assert abs(potential) > 1e-3 * abs(kinetic) > 0.0
    assert kinetic + potential == pytest.approx(0.0, abs=1e-6 * abs(potential))
