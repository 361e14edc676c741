"""Laws of the cross-product matrix and of the quaternion."""

import numpy as np
import pinocchio as pin
import pytest

from fflin.base.rotation import conjugate, quaternion_product, rotation_matrix, skew


def test_skew_is_the_cross_product():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 3))
    assert skew(a) @ b == pytest.approx(np.cross(a, b), rel=1e-15)
    assert (skew(a) == -skew(a).T).all()


def test_quaternion_product_matches_rotations():
    pin.seed(1)
    a, b = pin.SE3.Random().rotation, pin.SE3.Random().rotation
    qa, qb = (pin.Quaternion(R).coeffs() for R in (a, b))
    assert rotation_matrix(quaternion_product(qa, qb)) == pytest.approx(
        a @ b, abs=1e-14
    )
    assert rotation_matrix(conjugate(qa)) == pytest.approx(a.T, abs=1e-14)
    assert quaternion_product(qa, conjugate(qa)) == pytest.approx(
        [0, 0, 0, 1], abs=1e-15
    )
