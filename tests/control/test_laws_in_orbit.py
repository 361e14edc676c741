"""Laws that are simulated in orbit, compared with loops by hand."""

from collections import deque

import numpy as np
import pytest

import fflin
from tests.support.orbits import in_orbit
from tests.support.robots import free_body

DT = 0.05
INERTIA = (4.0, 6.0, 7.0)  # kg m^2


def measured(outputs):
    """Return a body with torques and sensors in an orbit of 21 s."""
    body = free_body(INERTIA).replace(inputs=[fflin.BaseTorque()], outputs=outputs)
    return in_orbit(body)


@pytest.mark.exhaustive
def test_a_law_of_sensors_with_own_rates_flies_in_orbit_as_a_linear_loop_with_queues():
    """The star tracker is queued and used once, by hand; the gyroscope feels the orbital rate."""
    tracker = fflin.StarTracker(sample=0.25, delay=0.2)
    robot = measured([tracker, fflin.Gyroscope("base")])
    lin = fflin.linearize(robot).discretize(DT)
    noise = {"q_b": 1e-8, "gyroscope": 1e-10}
    estimator = fflin.kalman(lin, {"omega_b": 1e-4}, noise)
    states = [*range(3), *range(6, 9)]
    Q = np.zeros((12, 12))
    Q[states, states] = 1.0
    law = fflin.lqg(fflin.lqr(lin, Q, np.full(3, 1e-4)), estimator)
    policy = fflin.MultirateFeedback(lin, law)
    q0 = fflin.configuration(robot, rpy=(1e-3, -1e-3, 2e-3))
    motion = fflin.simulate(robot, policy, q0=q0, duration=2.0, dt=DT, noise=0.0)
    e = motion.x[0] - lin.x0
    z = np.zeros(law.A.shape[1])
    queue = deque([np.zeros(3)] * 4)
    errors = []
    for k, x in enumerate(motion.x):
        errors.append(np.abs(x - lin.x0 - e).max())
        y = lin.C @ e
        queue.append(y[:3])
        received = np.concatenate((queue.popleft(), y[3:]))
        u = law.C @ z
        z = law.A[k % 5] @ z + law.B[k % 5] @ received
        e = lin.A @ e + lin.B @ u
    moved = np.abs(motion.x - lin.x0).max()
    assert max(errors) < 1e-4 * moved


def couples():
    """Return thrusters of both signs in pairs, so that any torque is possible without a force."""
    places = [(0, 1, 0), (0, 0, 1), (1, 0, 0)]
    pushes = [(0, 0, 1), (1, 0, 0), (0, 1, 0)]
    return [
        fflin.Thruster(
            "base", side * np.array(place), sign * side * np.array(push), max=50
        )
        for place, push in zip(places, pushes, strict=True)
        for sign in (1.0, -1.0)
        for side in (1.0, -1.0)
    ]


def test_thrusters_fly_the_attitude_in_orbit_as_the_torques_that_they_replace():
    design = measured([fflin.FullState()])
    robot = design.replace(inputs=couples())
    lin = fflin.linearize(design).discretize(0.1)
    gain = np.zeros((3, 12))
    gain[:, :3], gain[:, 6:9] = 40.0 * np.eye(3), 15.0 * np.eye(3)
    law = fflin.StateFeedback(lin, gain)
    options = {
        "q0": fflin.configuration(design, rpy=(30, -20, 25)),
        "duration": 1.0,
        "dt": 0.1,
    }
    torques = fflin.simulate(design, law, **options)
    thrust = fflin.simulate(robot, fflin.Allocation(law, design), **options)
    assert thrust.u.max() > 5.0
    assert thrust.q == pytest.approx(torques.q, abs=1e-5)


def test_the_worst_loop_is_not_searched_in_orbit():
    """The gravity gradient depends on the inertia, so the model is no LFT of the masses."""
    robot = measured([fflin.FullState()])
    lin = fflin.linearize(robot).discretize(0.1)
    law = fflin.StateFeedback(lin, np.zeros((3, 12)))
    uncertain = fflin.uncertain(robot, {"base.inertia.xx": 0.1})
    with pytest.raises(fflin.InputError, match=r"an orbit.* each robot of samples"):
        uncertain.worst(law, samples=1)
