"""Growth of the integrators' steps on linear systems, compared with the polynomial of Taylor."""

import numpy as np

from fflin.dynamics.integrators import CommutatorFree4


def test_the_growth_of_cf4_is_the_taylor_polynomial_of_order_4():
    """A method of order 4 with 4 stages has R(z) = 1 + z + z^2/2 + z^3/6 + z^4/24."""
    z = np.array([-2.5, -1.0, -0.1, 0.3, 0.5j, -0.4 + 1.7j, 2.7j])
    expected = np.log(np.abs(1.0 + z + z**2 / 2.0 + z**3 / 6.0 + z**4 / 24.0))
    # Five terms of size 10 at most, divided by |R|, which is at least 0.1.
    np.testing.assert_allclose(CommutatorFree4.growth(z), expected, atol=1e-13)
