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


@pytest.mark.skipif(bool(MISSING), reason=f"needs {', '.join(MISSING)}")
@pytest.mark.skipif(not available(), reason="needs a driver that draws")
def test_a_cell_shows_the_page_and_keeps_a_picture(tmp_path, monkeypatch):
    import nbclient
    import nbformat

    folders = [str(Path(cases_page.__file__).parent), str(Path(__file__).parents[3])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(folders))
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in (SHOW, LOOK, CHANGE)])
    nbclient.NotebookClient(
        book, timeout=120, kernel_name="python3", resources={"metadata": {"path": tmp_path}}
    ).execute()
    shown, looked, changed = (cell.outputs for cell in book.cells)
    assert [output.output_type for output in shown] == ["display_data"] * 2
    for output in shown:
        assert "data:image/jpeg;base64," in output.data["text/html"]
        assert output.data["text/plain"].startswith("the explorer is open at http://127.0.0.1:")
    urls = {output.data["text/plain"] for output in shown}
    assert len(urls) == 1  # shown twice, served once
    assert [output.text for output in looked] == ["200 image/png 403 1\n"]  # and nothing on standard error
    assert [output.text for output in changed] == ["both ways\n"]
    assert len(nbformat.writes(book)) < 150_000
