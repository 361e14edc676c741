"""Derivatives of models with lags, compared with finite differences of changed robots."""

import numpy as np
import pytest

import fflin

MATRICES = {"dA": "A", "dB": "B", "dC": "C", "dD": "D"}


def satellite():
    inputs = [fflin.BaseTorque(lag=0.4), fflin.BaseForce()]
    outputs = [
        fflin.BasePose(lag=0.3),
        fflin.Gyroscope("base"),
        fflin.Accelerometer("base", lag=0.2),
    ]
    return fflin.load("cubesat", inputs=inputs, outputs=outputs)


def model_of(robot, dt):
    lin = fflin.linearize(robot).with_lags()
    return lin.discretize(dt) if dt else lin


@pytest.mark.parametrize("dt", [0.0, 0.25])
@pytest.mark.parametrize("name", ["base.mass", "base.inertia.xz", "base.com.y"])
def test_derivatives_of_lagging_models_are_those_of_changed_robots(name, dt):
    robot = satellite()
    derivative = fflin.sensitivity(model_of(robot, dt))[name]
    size = 1e-3 * max(abs(derivative.value), 0.01)
    values = (derivative.value - size, derivative.value + size)
    model = fflin.uncertain(robot, {name: values})
    less, more = (model_of(model.at({name: value}), dt) for value in values)
    for key, matrix in MATRICES.items():
        expected = (getattr(more, matrix) - getattr(less, matrix)) / (2.0 * size)
        result = getattr(derivative, key)
        assert result.shape == expected.shape
        # Central differences of relative steps of 1e-3 have relative errors of about 1e-6.
        scale = np.abs(expected).max(initial=1e-6)
        np.testing.assert_allclose(result, expected, atol=1e-5 * scale)
    assert derivative.dA.any() or derivative.dB.any()


def test_poles_of_lagging_loops_have_derivatives():
    robot = satellite()
    lin = model_of(robot, 0.0)
    gain = fflin.lqr(lin)
    S = fflin.sensitivity(lin)
    poles, derivatives = S.poles(gain)
    assert len(poles) == len(lin.A) and derivatives.shape == (len(S.names), len(poles))
    at = S.names.index("base.inertia.zz")
    value = S["base.inertia.zz"].value
    changed = fflin.uncertain(
        robot, {"base.inertia.zz": (0.999 * value, 1.001 * value)}
    )
    ends = [
        np.linalg.eigvals(plant.A - plant.B @ gain.K)
        for plant in (
            model_of(changed.at({"base.inertia.zz": k * value}), 0.0)
            for k in (0.999, 1.001)
        )
    ]
    for pole, slope in zip(poles, derivatives[at], strict=True):
        if np.isfinite(slope) and abs(slope) > 1e-3 * abs(pole) / value:
            before, after = (x[np.abs(x - pole).argmin()] for x in ends)
            expected = (after - before) / (0.002 * value)
            assert slope == pytest.approx(expected, rel=1e-4)
