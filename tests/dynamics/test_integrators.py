"""Integrators on vector spaces: their steps are those of their tableaus."""

import numpy as np
import pytest

from fflin.dynamics.integrators import (
    DEFAULT_INTEGRATOR,
    INTEGRATORS,
    CommutatorFree4,
    SemiImplicitEuler,
    integrator,
)
from fflin.dynamics.methods import DEFAULT_METHOD, METHODS


def test_each_name_has_a_class():
    assert tuple(INTEGRATORS) == METHODS
    assert integrator(DEFAULT_METHOD) is DEFAULT_INTEGRATOR


def test_a_step_of_a_linear_system_is_the_taylor_polynomial():
    rng = np.random.default_rng(3)
    A, B, u = rng.normal(size=(4, 4)), rng.normal(size=(4, 2)), rng.normal(size=2)
    z = rng.normal(size=4)
    step, held = CommutatorFree4.held(A, B, 0.3)
    after = CommutatorFree4.vector_step(lambda _, z: A @ z + B @ u, 0.3, z)
    np.testing.assert_allclose(after, step @ z + held @ u, rtol=1e-13)
    euler = SemiImplicitEuler.vector_step(lambda _, z: A @ z + B @ u, 0.3, z)
    np.testing.assert_allclose(euler, z + 0.3 * (A @ z + B @ u), rtol=1e-13)
    assert SemiImplicitEuler.held(A, B, 0.3) is None


@pytest.mark.parametrize(
    ("method", "order"), [(CommutatorFree4, 4), (SemiImplicitEuler, 1)]
)
def test_steps_of_a_system_that_changes_in_time_have_the_order_of_the_method(
    method, order
):
    """The solution of dz/dt = cos(t) z is exp(sin(t))."""

    def error(steps):
        h, z = 1.0 / steps, np.ones(1)
        for k in range(steps):
            z = method.vector_step(lambda c, z, t=k * h: np.cos(t + c * h) * z, h, z)
        return abs(z[0] - np.exp(np.sin(1.0)))

    # Halving the step divides the error by 2^order, up to terms of the next order.
    assert np.log2(error(40) / error(80)) == pytest.approx(order, abs=0.1)


def test_the_growth_of_cf4_is_the_taylor_polynomial_of_order_4():
    """A method of order 4 with 4 stages has R(z) = 1 + z + z^2/2 + z^3/6 + z^4/24."""
    z = np.array([-2.5, -1.0, -0.1, 0.3, 0.5j, -0.4 + 1.7j, 2.7j])
    expected = np.log(np.abs(1.0 + z + z**2 / 2.0 + z**3 / 6.0 + z**4 / 24.0))
    # Five terms of size 10 at most, divided by |R|, which is at least 0.1.
    np.testing.assert_allclose(CommutatorFree4.growth(z), expected, atol=1e-13)
