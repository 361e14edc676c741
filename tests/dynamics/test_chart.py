"""The chart's expressions, and those that a base at the reference is spared."""

import numpy as np
import pytest

from fflin.base.rotation import rotation_matrix, skew
from fflin.dynamics.coordinates import Chart, ReferenceChart

SHAPES = [(), (4,)]


def tilted(q_b):
    q0 = float(np.sqrt(1.0 - q_b @ q_b))
    return Chart(q_b, q0, rotation_matrix(np.array((*q_b, q0))))


@pytest.mark.parametrize("shape", SHAPES)
def test_a_base_at_the_reference_has_the_values_of_every_expression(shape):
    rng = np.random.default_rng(0)
    general = Chart(np.zeros((*shape, 3)), np.ones((*shape, 1)), np.eye(3))
    special = ReferenceChart(*shape)
    w, slopes = rng.normal(size=(*shape, 3)), rng.normal(size=(*shape, 8, 3))
    rows = rng.normal(size=(*shape, 8, 5))
    parts = (slice(0, 3), slice(3, 6))
    for one, other in (
        (special.q_b, general.q_b),
        (special.rate(w), general.rate(w)),
        (special.rate_over_q_b(w, skew(w)), general.rate_over_q_b(w, skew(w))),
        (special.over_q_b(slopes), general.over_q_b(slopes)),
        (special.to_reference(parts, rows), general.to_reference(parts, rows)),
        (special.to_base(parts, rows), general.to_base(parts, rows)),
    ):
        assert one.shape == other.shape and (one == other).all()
    for name in ("N", "J", "R"):
        matrices = getattr(general, name), getattr(special, name)
        assert (matrices[0] - matrices[1] == 0.0).all()


def test_derivative_of_the_quaternion_kinematics_by_complex_step():
    rng = np.random.default_rng(1)
    q_b, w = np.array([0.3, -0.5, 0.2]), rng.normal(size=3)
    result = tilted(q_b).rate_over_q_b(w, skew(w))
    for k in range(3):
        eps = q_b + 1e-30j * np.eye(3)[k]
        rate = 0.5 * (np.sqrt(1.0 - eps @ eps) * w + np.cross(eps, w))
        assert result[:, k] == pytest.approx(rate.imag / 1e-30, rel=1e-14)


def test_rows_are_rotated_in_place_and_back():
    chart = tilted(np.array([0.3, -0.5, 0.2]))
    x = np.arange(40.0).reshape(8, 5)
    parts = (slice(3, 6),)
    turned = chart.to_reference(parts, x)
    assert turned[3:6] == pytest.approx(chart.R @ x[3:6], rel=1e-14)
    assert (turned[[0, 1, 2, 6, 7]] == x[[0, 1, 2, 6, 7]]).all()
    assert chart.to_base(parts, turned) == pytest.approx(x, rel=1e-13)
    columns = x.T.copy()
    chart.turn_rows(parts, x)
    chart.turn_rows(parts, columns.T)
    assert (x == turned).all()
    assert columns == pytest.approx(turned.T, rel=1e-14)
