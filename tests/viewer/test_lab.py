"""The widget in JupyterLab, all cells run at once: query, gamma, lasso, the selection back in Python, edit, undo."""

import json
import os
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import contextmanager
from pathlib import Path

import cases_page
import pytest
from cases_web import SECONDS, needs_chromium

from kfgs.formats import write_splats

pytest.importorskip("jupyterlab")
nbformat = pytest.importorskip("nbformat")
anywidget = pytest.importorskip("anywidget")
pytestmark = needs_chromium

CELLS = [
    """
import warnings; warnings.simplefilter("error")
from kfgs import explore, read_splats
semantic, splat = read_splats("semantic.ply"), read_splats("color.ply")
viewer = explore(semantic, splat, distance=0.4, where="notebook")
viewer
""",
    """
viewer.ask("chair")
viewer.gamma = 0.5
viewer.hidden = ["odd"]
""",
    """len(viewer.selection)""",
    """pass""",
]
VIEWER = "document.querySelector('.kfgs').viewer"


@contextmanager
def jupyter(folder, kind="lab"):
    """A Jupyter server of its own: nothing of this machine's settings, and only for this test."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    places = {f"JUPYTER_{name}_DIR": str(folder / name) for name in ("CONFIG", "DATA", "RUNTIME")}
    shared = Path(anywidget.__file__).parents[4] / "share" / "jupyter"  # where its part for the browser was installed
    env = os.environ | places | {"JUPYTER_PATH": str(shared)}
    options = [
        f"--port={port}",
        f"--ServerApp.root_dir={folder}",
        "--no-browser",
        "--allow-root",
        "--IdentityProvider.token=",
    ]
    with open(folder / "log", "w") as log:
        server = subprocess.Popen([sys.executable, "-m", "jupyter", kind, *options], env=env, stdout=log, stderr=log)
    try:
        url, end = f"http://127.0.0.1:{port}", time.monotonic() + SECONDS
        while True:
            try:
                urllib.request.urlopen(f"{url}/api", timeout=5).close()
                break
            except OSError:
                assert time.monotonic() < end, (folder / "log").read_text()
                assert server.poll() is None, (folder / "log").read_text()
                time.sleep(0.2)
        yield url
    finally:
        server.terminate()
        server.wait(60)


class Lab:
    """A notebook in a tab, whose last cell runs what is typed into it."""

    def __init__(self, page, url):
        self.page = page
        page.set_default_timeout(1000 * SECONDS)
        page.goto(f"{url}/lab/tree/n.ipynb")
        page.wait_for_selector(".jp-NotebookPanel .jp-Cell")
        page.wait_for_selector("[data-status=idle]")

    def run_all(self):
        """Once the kernel answers: what is run while it starts is forgotten."""
        last, end = self.page.locator(".jp-CodeCell").last, time.monotonic() + SECONDS
        while "1" not in last.locator(".jp-InputPrompt").first.inner_text():
            assert time.monotonic() < end, "the kernel does not start"
            last.locator(".cm-content").click()
            self.page.keyboard.press("Control+Enter")
            self.page.wait_for_timeout(2000)
        self.page.click("text=Run >> nth=0")
        self.page.click("text=Run All Cells")
        self.page.wait_for_selector(".kfgs:not([aria-busy])")

    def python(self, code):
        """What an expression is in the kernel, as JSON."""
        marker = f"<{time.monotonic_ns()}>"
        cell = self.page.locator(".jp-CodeCell").last
        cell.locator(".cm-content").click()
        self.page.keyboard.press("Control+a")
        self.page.keyboard.insert_text(f"import json; print({marker!r} + json.dumps({code}) + {marker!r})")
        self.page.keyboard.press("Control+Enter")
        output = cell.locator(f".jp-OutputArea-output:has-text('{marker}')")
        output.wait_for()
        return json.loads(output.inner_text().split(marker)[1])

    def browser(self, code):
        return self.page.evaluate(f"(({{model, panes}}) => {code})({VIEWER})")

    def until(self, get, wanted):
        """The browser tells Python a moment later, and the other way round."""
        end = time.monotonic() + SECONDS
        while (value := get()) != wanted:
            assert time.monotonic() < end, (value, wanted)
            self.page.wait_for_timeout(200)


def test_the_widget_talks_back(browser, tmp_path):
    state = cases_page.exploration(("table", "chair", "odd"))
    for side in state.sides:
        splats = state.cloud(side)
        write_splats(splats.replace(names=state.meaning.names if side == "semantic" else ()), tmp_path / f"{side}.ply")
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3"}}
    cells = [nbformat.v4.new_code_cell(text.strip()) for text in CELLS]
    nbformat.write(nbformat.v4.new_notebook(cells=cells, metadata=kernel), tmp_path / "n.ipynb")
    state.ask("chair")
    state.set_gamma(0.5)
    page = browser.new_page(viewport={"width": 1300, "height": 1500})
    with jupyter(tmp_path) as url:
        lab = Lab(page, url)
        lab.run_all()
        # what cells set before there was a view: question, gamma, hidden classes
        lab.until(lambda: lab.browser("[model.words, model.gamma, [...model.hidden]]"), ["chair", 0.5, [2]])
        counts = [int(state.selected(side).sum()) for side in state.sides]
        assert lab.browser("['semantic', 'color'].map((side) => model.counts(side).selected)") == counts
        assert lab.python("len(viewer.selection)") == counts[1] > 0
        # a person types another gamma and searches for something else
        page.locator(".kfgs .slider:has(#gamma) input.number").fill("0.2")
        page.keyboard.press("Enter")
        lab.until(lambda: lab.python("viewer.gamma"), 0.2)
        page.fill(".kfgs #query", "table")
        page.keyboard.press("Enter")
        lab.until(lambda: lab.python("[viewer.question, viewer.state.asked.words]"), ["table", "table"])
        # a lasso is a selection in the next cell
        page.press(".kfgs .stage", "3")
        x, y, width, height = page.locator(".kfgs .stage").bounding_box().values()
        page.mouse.move(x + 0.15 * width, y + 0.2 * height)
        page.mouse.down()
        for across, down in ((0.6, 0.2), (0.6, 0.8), (0.15, 0.8)):
            page.mouse.move(x + across * width, y + down * height, steps=3)
        page.mouse.up()
        lasso = lab.browser("[...model.selected('color').keys()].filter((i) => model.selected('color')[i])")
        assert 0 < len(lasso) < 450
        lab.until(lambda: lab.python("viewer.selection.indices.tolist()"), lasso)
        assert lab.python("len(splat[viewer.selection])") == len(lasso)
        # an edit of the widget is an edit in Python; undo takes it back
        page.press(".kfgs .stage", "Delete")
        lab.until(lambda: lab.python("len(viewer.edits.apply(splat))"), 450 - len(lasso))
        page.press(".kfgs .stage", "Control+z")
        lab.until(lambda: lab.python("[len(viewer.edits), viewer.selection.indices.tolist()]"), [0, lasso])
        # Python sets a selection and an edit; a person undoes the edit
        lab.python("setattr(viewer, 'selection', splat.means[:, 0] > 0)")
        right = int((state.cloud("color").means[:, 0] > 0).sum())
        lab.until(lambda: lab.browser("model.counts('color').selected"), right)
        lab.python("setattr(viewer, 'edits', [__import__('kfgs').Remove(viewer.selection)])")
        lab.until(lambda: lab.browser("model.counts('color').total"), 450 - right)
        page.press(".kfgs .stage", "Control+z")
        lab.until(lambda: lab.browser("model.counts('color').total"), 450)
        lab.until(lambda: lab.python("len(viewer.edits)"), 0)
        # a thing that Python adds, and the tape
        lab.python("viewer.add('points', splat.means)")
        lab.until(lambda: lab.browser("panes.renderer.solids.map(({ points }) => points)"), [450])
        lab.python("setattr(viewer, 'tape', [[0, 0, 0], [3, 4, 0]])")
        lab.until(lambda: lab.browser("model.length"), 5)
        # the camera
        before = lab.python("viewer.camera.viewmat.tolist()")
        page.press(".kfgs .stage", "ArrowLeft")
        lab.until(lambda: lab.python("viewer.camera.viewmat.tolist()") == before, False)
    page.close()
