"""Lags and flat plates in the kernel, uncompiled, agree with the Python engine."""

from dataclasses import replace

import numpy as np
import pytest

import fflin
from tests.kernel.test_advance import both, planned
from tests.support.marks import exhaustive
from tests.support.robots import free_body

SPIN = {"omega_b.x": 0.4, "omega_b.z": -0.7, "v_b.y": 0.2}
PLATES = [
    {
        "area": 0.3,
        "normal": (0, 3, 4),
        "position": (0.1, -0.4, 0.7),
        "two_sided": True,
        "density": 2e-4,
        "velocity": (100.0, 20.0, -30.0),
        "sun": (0.3, -0.5, 0.8),
        "solar_pressure": 2.0,
        "specular": 0.3,
        "diffuse": 0.4,
    },
    {"area": 0.2, "normal": (1, 0, 0), "sun": (1, 2, 3), "solar_pressure": 3.0},
]
SAMPLE = 0.2


def satellite(**fields):
    """Return a satellite whose actuators and sensors have different lags."""
    inputs = [fflin.BaseTorque(lag=0.3), fflin.BaseForce(lag=0.15)]
    outputs = [fflin.BasePose(lag=0.4), fflin.Gyroscope("base")]
    return fflin.load("cubesat", inputs=inputs, outputs=outputs, **fields)


def state_feedback(robot, lin):
    return fflin.StateFeedback(lin, fflin.lqr(lin, 1.0, 1.0))


def output_feedback(robot, lin):
    estimator = fflin.kalman(lin, 1e-4, 1e-4)
    return fflin.OutputFeedback(lin, fflin.lqg(fflin.lqr(lin, 1.0, 1.0), estimator))


def linear_controller(robot, lin):
    estimator = fflin.kalman(lin, 1e-4, 1e-4)
    return fflin.LinearController(fflin.lqg(fflin.lqr(lin, 1.0, 1.0), estimator), lin)


@pytest.mark.parametrize("lagging", [False, True])
@pytest.mark.parametrize(
    ("make", "sample"),
    [
        (state_feedback, 0.0),
        (linear_controller, 0.0),
        (state_feedback, SAMPLE),
        (output_feedback, SAMPLE),
        (linear_controller, SAMPLE),
    ],
)
def test_lags_agree_for_laws_that_know_them_or_not(make, sample, lagging):
    robot = satellite()
    lin = fflin.linearize(robot)
    if lagging:
        lin = lin.with_lags()
    if sample:
        lin = lin.discretize(sample)
    law = make(robot, lin)
    q0 = fflin.configuration(robot, rpy=(10, -20, 30))
    options = {"q0": q0, "v0": fflin.velocity(robot, SPIN)}
    dt = 0.05 if sample else 0.01
    plan = planned(robot, law, **options, dt=dt, duration=16 * dt)
    (_, _, u, *_), _ = both(plan, 1e-12)
    assert np.abs(u).max() > 1e-3


def multirate(lag):
    """Return a satellite with a slow sensor, and its multirate law."""
    tracker = fflin.BasePose(lag=lag, delay=0.1, sample=0.2)
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque(lag=0.2), fflin.BaseForce()],
        outputs=[tracker, fflin.Gyroscope("base", lag=lag)],
    )
    lin = fflin.linearize(robot).with_lags().discretize(0.1)
    estimator = fflin.kalman(lin, 1e-6, 1e-6)
    return robot, fflin.MultirateFeedback(
        lin, fflin.lqg(fflin.lqr(lin, 1.0, 1.0), estimator)
    )


def test_lags_agree_for_sensors_with_their_own_rates():
    robot, law = multirate(0.3)
    q0 = fflin.configuration(robot, rpy=(10, -20, 30))
    both(planned(robot, law, q0=q0, dt=0.05, duration=1.0), 1e-12)


def test_lags_agree_with_limits_delays_and_wheels():
    wheels = [
        fflin.ReactionWheel(
            axis, inertia=1e-5, name=f"wheel_{k}", max=2e-4, max_speed=9.0, lag=0.2
        )
        for k, axis in enumerate(np.eye(3))
    ]
    robot = fflin.load("cubesat", inputs=wheels)
    lin = fflin.linearize(robot).with_lags().discretize(0.2, delay=0.1)
    q0 = fflin.configuration(robot, rpy=(20, 0, 10))
    plan = planned(
        robot,
        state_feedback(robot, lin),
        q0=q0,
        dt=0.05,
        duration=1.5,
        delay=0.1,
        limits="urdf",
    )
    both(plan, 1e-12)


@pytest.mark.parametrize("orbit", [None, *exhaustive(500e3)])
def test_the_command_of_an_actuator_fault_is_the_lagging_input(orbit):
    robot = satellite(orbit=orbit)
    lin = fflin.linearize(robot).discretize(SAMPLE)
    plan = planned(robot, state_feedback(robot, lin), dt=0.05, duration=1.0)
    faults = plan.plant.faults._replace(
        gain=np.full(6, 0.7), bias=np.full(6, 1e-4), until=np.full(6, 0.63)
    )
    options = {"v0": fflin.velocity(robot, SPIN), "dt": 0.05, "duration": 1.0}
    both(planned(robot, state_feedback(robot, lin), faults, **options), 1e-12)


@pytest.mark.parametrize("orbit", [None, 500e3])
def test_flat_plates_agree(orbit):
    """The first plate has the default velocity in orbit, and the second one is inertial."""
    first, second = PLATES
    if orbit:
        first = {key: first[key] for key in first if key != "velocity"}
        first["density"] = 1e-9
        second = second | {"density": 1e-4, "velocity": (80.0, 10.0, 40.0)}
    robot = free_body((4.0, 5.0, 6.0)).replace(
        orbit=orbit,
        disturbance={"plate": [first, second], "tau_b": (0.02, -0.01, 0.03)},
    )
    options = {"v0": fflin.velocity(robot, SPIN), "dt": 0.1, "duration": 4.0}
    (q, *_), _ = both(planned(robot, **options), 1e-12)
    alone = planned(replace(robot, disturbance={}), **options)
    (free, *_), _ = both(alone, 1e-12)
    assert np.abs(q - free).max() > 1e-3
