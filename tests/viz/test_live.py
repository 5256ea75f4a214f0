"""`plotter.show()` in a cell of Jupyter is live: a browser turns the scene, and moves the slider for lambda."""

import os
import re
import time
from importlib.util import find_spec
from pathlib import Path

import pytest
from cases_web import SECONDS, needs_chromium, software_chromium

pytest.importorskip("ipykernel", reason='needs: pip install "kfgs[notebook]"')
LIVE = pytest.mark.skipif(find_spec("trame_pyvista") is None, reason="needs pyvista[jupyter]")
pytestmark = [*needs_chromium, LIVE]

CELL = """
from cases_viz import some_gaussians
from kfgs import viz
plotter = viz.show_transfer(some_gaussians(80, 1), some_gaussians(50, 2), 0.3, height=400)
shown = plotter.show(return_viewer=True)
print(shown.src)
"""
STATE = "print(plotter.camera.position, plotter.actors['transfer'].mapper.dataset.n_cells)"


@pytest.fixture
def ask():
    """Run code in a kernel of Jupyter; what it prints comes back."""
    from jupyter_client.manager import start_new_kernel

    tests = str(Path(__file__).parents[1])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([tests, os.environ.get("PYTHONPATH", "")])}
    manager, client = start_new_kernel(startup_timeout=SECONDS, env=environment)

    def run(code):
        printed, failed = [], []

        def hear(message):
            content = message["content"]
            printed.append(content.get("text", ""))
            failed.extend(content.get("traceback", ()))

        client.execute_interactive(code, output_hook=hear, timeout=SECONDS)
        assert not failed, "\n".join(failed)
        return "".join(printed)

    yield run
    client.stop_channels()
    manager.shutdown_kernel(now=True)


def test_a_cell_shows_a_transfer_that_can_be_turned_and_whose_slider_moves_lambda(ask):
    address = re.search(r"http://\S+", ask(CELL)).group()
    before = ask(STATE)
    with software_chromium() as browser:
        page = browser.new_page(viewport={"width": 600, "height": 600})
        page.goto(address)
        page.wait_for_selector("img, canvas", timeout=1000 * SECONDS)
        turned = until(lambda: drag(page, (300, 250), (390, 280)), lambda: ask(STATE), before)
        assert turned.split(")")[1] == before.split(")")[1]  # as many lines
        knob = 0.62 + 0.35 / 3
        moved = until(lambda: drag(page, (600 * knob, 552), (600 * 0.69, 552)), lambda: ask(STATE), turned)
        assert int(moved.split(")")[1]) < int(turned.split(")")[1])


def drag(page, start, end):
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=5)
    page.mouse.up()


def until(act, state, before):
    """Act until the state is another one: the page may not listen yet."""
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        act()
        time.sleep(1)
        if (now := state()) != before:
            return now
    raise AssertionError(f"still {before}")
