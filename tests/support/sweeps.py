"""Points of sweeps, and how the models at them are compared."""

import dataclasses

import numpy as np

from tests.support.robots import random_point


def points(robot, count, seed=0):
    """Random (q, v, u) rows."""
    rng = np.random.default_rng(seed)
    return tuple(
        map(
            np.array,
            zip(*(random_point(robot, rng) for _ in range(count)), strict=True),
        )
    )


def assert_same(one, other, tolerance=0.0):
    """Two linear models agree in every field, arrays within a relative tolerance."""
    assert set(one.__dict__) >= {field.name for field in dataclasses.fields(one)}
    for field in dataclasses.fields(one):
        left, right = getattr(one, field.name), getattr(other, field.name)
        if isinstance(left, np.ndarray):
            assert left.shape == right.shape, field.name
            assert not left.flags.writeable, field.name
            scale = np.abs(right).max(initial=0.0)
            assert np.abs(left - right).max(initial=0.0) <= tolerance * scale, (
                field.name
            )
        elif field.name != "_robot" and not (callable(left) or callable(right)):
            assert left == right, field.name
