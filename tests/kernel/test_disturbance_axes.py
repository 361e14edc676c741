"""Disturbances in all axes and both engines, compared with forces that are computed by hand."""

import itertools

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.kernel.test_advance import advanced, planned
from tests.support.marks import exhaustive
from tests.support.robots import free_body

RATE = 0.5  # [rad/s] mean motion of the orbit
BODY = free_body((4.0, 5.0, 6.0))
IN_ORBIT = BODY.replace(
    orbit=fflin.CircularOrbit(
        mean_motion=RATE, body="x", mu=RATE**2 * 7e6**3, body_radius=6e6
    )
)
# Orbit normal in the axes of each frame.
NORMALS = {"lvlh": (0.0, -1.0, 0.0), "hill": (0.0, 0.0, 1.0)}
VECTOR = np.array((0.03, -0.02, 0.05))
PARTS = {
    "constant": {"constant": VECTOR},
    "periodic": {"amplitude": VECTOR, "frequency": 0.3, "phase": 0.4},
}
SPIN = {"omega_b.x": 0.3, "omega_b.z": -0.4, "v_b.y": 0.2}


def value_at(part, t):
    """Return the vector of a part at time t, in its own axes."""
    if part == "constant":
        return VECTOR
    return VECTOR * np.sin(2.0 * np.pi * 0.3 * t + 0.4)


def by_hand(name, part, axes, normal):
    """Return a disturbance of (t, q, v), with torques in base axes and forces in world axes."""

    def disturbance(t, q, v):
        R = pin.Quaternion(q[3:7]).matrix()
        vector = value_at(part, t)
        if axes == "base":
            vector = R @ vector
        if axes == "inertial" and normal is not None:
            vector = pin.AngleAxis(-RATE * t, np.array(normal)).matrix() @ vector
        return {name: R.T @ vector if name == "tau_b" else vector}

    return disturbance


NAMES, FREE, ORBITAL = (
    ("tau_b", "F_b"),
    ("base", "inertial"),
    ("base", "inertial", "orbital"),
)
CASES = [
    *itertools.product(NAMES, PARTS, FREE, (None,)),
    *itertools.product(NAMES, ("periodic",), ORBITAL, ("lvlh",)),
    *exhaustive(*itertools.product(NAMES, ("constant",), ORBITAL, ("lvlh",))),
    *exhaustive(*itertools.product(NAMES, PARTS, ORBITAL, ("hill",))),
]


@pytest.mark.parametrize(("name", "part", "axes", "frame"), CASES)
def test_each_part_in_each_axes_is_the_force_by_hand(name, part, axes, frame):
    free = IN_ORBIT if frame else BODY
    robot = free.replace(disturbance={name: PARTS[part] | {"axes": axes}})
    options = {
        "v0": fflin.velocity(robot, SPIN),
        "duration": 0.5,
        "dt": 0.1,
        "every": 1,
    }
    if frame:
        options["frame"] = frame
    hand = by_hand(name, part, axes, NORMALS.get(frame))
    expected = fflin.simulate(free, disturbance=hand, **options)
    motion = fflin.simulate(robot, engine="python", **options)
    assert motion.q == pytest.approx(expected.q, abs=1e-12)
    assert motion.v == pytest.approx(expected.v, abs=1e-12)
    q, v, *_ = advanced(planned(robot, **options))
    assert q == pytest.approx(expected.q, abs=1e-12)
    assert v == pytest.approx(expected.v, abs=1e-12)
    undisturbed = fflin.simulate(free, **options)
    assert np.abs(expected.v - undisturbed.v).max() > 1e-4
