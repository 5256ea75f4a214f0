"""The explorer in a Jupyter kernel: the cell keeps a small picture, and the kernel serves the page."""

import importlib.util
import os
from pathlib import Path

import cases_page
import pytest

from kfgs.viz import available

MISSING = [name for name in ("trame", "nbclient", "ipykernel") if importlib.util.find_spec(name) is None]

SHOW = """
import cases_page
from kfgs.viz.explorer import show_in_notebook
view = cases_page.explorer("out")
show_in_notebook(view)
show_in_notebook(view)
"""
MAKE = """
import cases_page
from kfgs.gaussians import Gaussians
from kfgs.viz import explore
from kfgs.viz.explorer import ExploreOptions
from kfgs.formats import SplatFile
state = cases_page.exploration()
file = SplatFile(state.cloud("semantic"), classes=cases_page.NAMES)
options = ExploreOptions(style="points")
"""
EXPLORE = "explore(file, options=options)"
AGAIN = "view = _; view"
COUNT = """
import asyncio, gc, weakref, aiohttp
from kfgs.viz.explorer import notebook
while len(notebook._open) > 1 or not notebook._open[view][0].page._loop:
    await asyncio.sleep(0.02)
import pyvista
print(len(notebook._open), len(notebook._made), len(pyvista.plotting.plotter._ALL_PLOTTERS))
"""
CLOSE = """
url, port = notebook._open[view][0].url, notebook._open[view][0]._port
view.close()
while notebook._open:
    await asyncio.sleep(0.02)
try:
    await asyncio.open_connection("127.0.0.1", port)
except ConnectionRefusedError:
    print("nobody listens")
"""
CLOSED = "view"
LOOK = """
import asyncio, aiohttp
from kfgs.viz.explorer import notebook
url = notebook._open[view][0].url
async with aiohttp.ClientSession() as session:
    for _ in range(600):
        try:
            answer = await session.get(url)
            break
        except aiohttp.ClientConnectionError:
            await asyncio.sleep(0.1)
    picture = await session.get(url.replace("index.html", "logo.png"))
    refused = await session.get(url.replace("index.html", "logo.png"), headers={"Origin": "http://evil.example"})
print(answer.status, picture.content_type, refused.status, len(notebook._open))
"""
CHANGE = """
view.ask("chair")
page = notebook._open[view][0].page
while page.server.state.asked != "chair":
    await asyncio.sleep(0.05)
page._on_ask("table")
while view.state.asked.words != "table":
    await asyncio.sleep(0.05)
print("both ways")
"""


pytestmark = [
    pytest.mark.skipif(bool(MISSING), reason=f"needs {', '.join(MISSING)}"),
    pytest.mark.skipif(not available(), reason="needs a driver that draws"),
]


@pytest.fixture(scope="module")
def notebook(tmp_path_factory):
    """What each cell puts out, by its source (a list where one is run several times), and the notebook as it would be saved."""
    import nbclient
    import nbformat

    cells = (MAKE, EXPLORE, EXPLORE, EXPLORE, AGAIN, COUNT, CLOSE, CLOSED, SHOW, LOOK, CHANGE)
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source.strip()) for source in cells])
    folders = [str(Path(cases_page.__file__).parent), str(Path(__file__).parents[3])]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(folders))
        place = {"metadata": {"path": tmp_path_factory.mktemp("notebook")}}
        nbclient.NotebookClient(book, timeout=600, kernel_name="python3", resources=place).execute()
    outputs = {}
    for cell in book.cells:
        outputs.setdefault(cell.source, []).append(cell.outputs)
    return outputs, sum(len(nbformat.writes(nbformat.v4.new_notebook(cells=[cell]))) for cell in book.cells[-3:])


def test_a_cell_shows_the_page_and_keeps_a_picture(notebook):
    outputs, saved = notebook
    [shown], [looked], [changed] = (outputs[source.strip()] for source in (SHOW, LOOK, CHANGE))
    assert [output.output_type for output in shown] == ["display_data"] * 2
    for output in shown:
        assert "data:image/jpeg;base64," in output.data["text/html"]
        assert output.data["text/plain"].startswith("the explorer is open at http://127.0.0.1:")
    urls = {output.data["text/plain"] for output in shown}
    assert len(urls) == 1  # shown twice, served once
    assert [output.text for output in looked] == ["200 image/png 403 1\n"]  # and nothing on standard error
    assert [output.text for output in changed] == ["both ways\n"]
    assert saved < 150_000


def test_explore_as_the_last_line_shows_once_and_run_again_leaves_one_open(notebook):
    outputs, _ = notebook
    shown = outputs[EXPLORE]
    [again], [counted], [closed], [after] = (outputs[source.strip()] for source in (AGAIN, COUNT, CLOSE, CLOSED))
    for given in shown:  # the page, and no second picture below it
        assert [output.output_type for output in given] == ["display_data"]
        assert "<script>" in given[0].data["text/html"]
    assert len({given[0].data["text/plain"] for given in shown}) == 3
    assert [output.data["text/plain"] for output in again] == [shown[-1][0].data["text/plain"]]  # the page once more
    assert [output.text for output in counted] == ["1 1 1\n"]
    assert [output.text for output in closed] == ["nobody listens\n"]
    assert [set(output.data) for output in after] == [{"text/plain"}]
