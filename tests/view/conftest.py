"""Fixtures that the tests of the view share."""

import pytest

from tests.support.motions import settling


@pytest.fixture(scope="module")
def motion(robots):
    return settling(robots["planar_detumble"], duration=4.0)
