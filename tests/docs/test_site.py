"""What the site adds to Sphinx (docs/_ext): commands, shapes, notebooks, and the check that nothing is loaded from elsewhere."""

import base64
import importlib
import inspect
import json
import sys
from pathlib import Path

import pytest

import kfgs
from kfgs import cli, labels

EXTENSIONS = Path(kfgs.__file__).parents[1] / "docs" / "_ext"
if not EXTENSIONS.is_dir():
    pytest.skip(f"no folder {EXTENSIONS}", allow_module_level=True)
pytest.importorskip("sphinx", reason='the site needs: pip install "kfgs[docs]"')


@pytest.fixture
def load(monkeypatch):
    """Imports an extension of the site."""
    monkeypatch.syspath_prepend(str(EXTENSIONS))
    yield importlib.import_module
    for name in [name for name in sys.modules if name.startswith("kfgs_")]:
        del sys.modules[name]


def test_what_a_page_or_a_style_sheet_would_load_from_elsewhere_is_found(load):
    page = """<script src="https://a.org/b.js"></script><link href="//a.org/b.css"><img src="http://a.org/b.png">
        <a href="https://a.org">a link is followed by a click</a><img src="_images/b.png">"""
    outside = ["<script> https://a.org/b.js", "<link> //a.org/b.css", "<img> http://a.org/b.png"]
    assert load("kfgs_offline").find_outside(page) == outside
    sheet = """@import 'https://a.org/b.css'; p { background: url(//a.org/b.png) }
        /* https://a.org */ p { background: url(b.png) url('data:image/svg+xml;//') }"""
    assert load("kfgs_offline").find_outside_style(sheet) == ["https://a.org/b.css", "//a.org/b.png"]


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_every_option_of_a_command_is_in_its_table(name, load):
    commands = load("kfgs_commands")
    command = cli.COMMANDS[name]
    written = commands.described(command) + commands.table(command)
    options = set(cli.shown_names(command).values())
    for option in (option for option in options if option.startswith("--")):
        assert f"`{option}" in written, option
    assert written.count("\n| `") == len(options)
    assert f"kfgs {name}" in written
    assert "None" not in written
    assert "%%" not in written


def test_shapes_beside_arguments_are_read_and_other_comments_are_not(load):
    shapes = load("kfgs_shapes").shapes_of

    def scored(
        means,  # [N, 3]
        names=(),
        *,
        mask=None,  # [N] bool
    ) -> object:  # [N]
        # a comment of the body
        return means

    assert shapes(scored) == ["``means`` [N, 3]", "``mask`` [N] bool", "returns [N]"]
    assert shapes(labels.nearest_labels)[1].startswith("``src_labels`` [S] int64")
    assert shapes(inspect.signature) == []


def notebook_of(title, *pictures, tagged=None):
    cells = [{"cell_type": "markdown", "metadata": {}, "source": [f"# {title}\n", "\n", "**What is\n", "it?** More."]}]
    for picture in pictures:
        tags = {"tags": ["thumbnail"]} if picture == tagged else {}
        data = {"image/png": base64.b64encode(picture).decode(), "text/plain": "<Image>"}
        cells.append({"cell_type": "code", "metadata": tags, "source": "x", "outputs": [{"data": data}]})
    return json.dumps({"cells": cells})


def test_notebooks_come_into_the_gallery_and_go_with_their_file(tmp_path, load):
    bring = load("kfgs_gallery").bring
    notebooks, pages = tmp_path / "notebooks", tmp_path / "gallery"
    notebooks.mkdir()
    pages.mkdir()
    assert bring(notebooks, pages) == []
    assert "{note}" in (pages / "list.inc").read_text()
    (notebooks / "2_b.ipynb").write_text(notebook_of("2. B", b"one", b"two", b"three", tagged=b"two"))
    (notebooks / "1_a.ipynb").write_text(notebook_of("1. A", b"one", b"two"))
    assert bring(notebooks, pages) == ["1_a", "2_b"]
    listed = (pages / "list.inc").read_text()
    assert listed.index(":::{grid-item-card} 1. A\n") < listed.index(":::{grid-item-card} 2. B\n")
    assert ":link: 2_b\n:link-type: doc\n:img-top: card_2_b.png\n:img-alt: 2. B\n\nWhat is it?\n:::" in listed
    assert "\n1_a\n2_b\n```" in listed
    assert (pages / "card_1_a.png").read_bytes() == (pages / "card_2_b.png").read_bytes() == b"two"
    (notebooks / "10_c.ipynb").write_text(notebook_of("10. C"))
    assert bring(notebooks, pages) == ["1_a", "2_b", "10_c"]
    (notebooks / "10_c.ipynb").unlink()
    (notebooks / "1_a.ipynb").unlink()
    assert bring(notebooks, pages) == ["2_b"]
    assert sorted(path.name for path in pages.iterdir()) == ["2_b.ipynb", "card_2_b.png", "list.inc"]
