"""One Chromium for all tests of the explorer's page, and a server for each file of them."""

import cases_browser
import pytest


@pytest.fixture(scope="session")
def browser():
    with cases_browser.chromium() as opened:
        yield opened


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with cases_browser.served(tmp_path_factory.mktemp("page")) as started:
        yield started
