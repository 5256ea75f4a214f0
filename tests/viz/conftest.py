import pytest
from cases_viz import some_plotter


@pytest.fixture
def plotter():
    """A small plotter, drawn off-screen on black."""
    with some_plotter() as plotter:
        yield plotter
