"""Fixtures that the tests of the view share."""

import contextlib

import pytest

from tests.support.browser import Watched
from tests.support.motions import settling


@pytest.fixture(scope="module")
def motion(robots):
    return settling(robots["planar_detumble"], duration=4.0)


@pytest.fixture
def watch(browser):
    """Open pages that are closed after the test, and must not have complained by then."""
    with contextlib.ExitStack() as pages:
        yield lambda *given, **options: pages.enter_context(
            Watched(browser, *given, **options)
        )
