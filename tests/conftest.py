"""Fixtures that several test files share."""

import pytest

import fflin
from tests.support.robots import BUNDLED


@pytest.fixture(scope="session")
def robots():
    """Every bundled robot, loaded once."""
    return {name: fflin.load(name) for name in BUNDLED}
