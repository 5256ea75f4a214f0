"""What tests of a file share: a window."""

import cases_desktop
import pytest
from cases_window import an_explorer

from kfgs.viz import available, headless


@pytest.fixture(scope="module")
def driver():
    """Where nothing can be drawn, such a test has nothing to say."""
    if not available():
        pytest.skip(headless.probe().reason)


@pytest.fixture(scope="module")
def shared_explorer(driver):
    with an_explorer() as explorer:
        yield explorer


@pytest.fixture
def explorer(shared_explorer):
    """As if new, for tests that leave nothing behind."""
    shared_explorer.ask(None)
    shared_explorer.set_show("labels")
    shared_explorer.set_hidden([])
    shared_explorer.set_style("gaussians")
    shared_explorer.state.drop_pick()
    return shared_explorer


@pytest.fixture
def desktop(tmp_path):
    with cases_desktop.opened(tmp_path) as window:
        yield window
