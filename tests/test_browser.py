"""Pages of the tests: what they wait for, and what they paint."""

import pytest

from tests.support import browser as support
from tests.support.browser import Watched

pytestmark = pytest.mark.browser


def test_a_missing_message_is_named_with_the_messages_of_the_page(browser, monkeypatch):
    monkeypatch.setattr(support, "FRAMES", 3)
    page = "data:text/html,<script>console.log('nothing here')</script>"
    with (
        pytest.raises(AssertionError, match=r"window\.moon.*nothing here"),
        Watched(browser, page, ready="document.body") as watched,
    ):
        watched.wait("window.moon")


def test_a_page_that_complains_fails_where_it_is_closed(browser):
    page = "data:text/html,<script>console.error('no moon')</script>"
    with (
        pytest.raises(AssertionError, match="no moon"),
        Watched(browser, page, ready="document.body"),
    ):
        pass
