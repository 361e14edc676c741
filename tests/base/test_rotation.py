"""Laws of the cross-product matrix and of the quaternion."""

import numpy as np
import pinocchio as pin
import pytest

from fflin.base.rotation import (
    conjugate,
    quaternion_product,
    rotation_matrix,
    rotation_vectors,
    skew,
)


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


def test_rotation_vectors_are_logarithms_of_rotations():
    pin.seed(2)
    rotations = [pin.SE3.Random().rotation for _ in range(20)]
    parts = []
    for R in rotations:
        quaternion = pin.Quaternion(R).coeffs()
        parts.append(quaternion[:3] * np.sign(quaternion[3]))
    vectors = rotation_vectors(np.array([*parts, np.zeros(3), [0.0, 1e-9, 0.0]]))
    for R, vector in zip(rotations, vectors, strict=False):
        # arcsin amplifies rounding near 180 deg by up to 1 / sqrt(eps).
        assert vector == pytest.approx(pin.log3(R), abs=1e-7)
    assert (vectors[-2] == 0.0).all()
    assert vectors[-1] == pytest.approx([0.0, 2e-9, 0.0], rel=1e-12)


def test_a_vector_part_longer_than_one_has_an_angle_above_180_degrees():
    (vector,) = rotation_vectors(np.array([[0.0, 0.0, 1.5]]))
    assert vector == pytest.approx([0.0, 0.0, 1.5 * np.pi])
