"""What the site adds to Sphinx (docs/_ext): tables of commands, and the check that nothing is loaded from elsewhere."""

import importlib
import sys
from pathlib import Path

import pytest

import kfgs
from kfgs import cli

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


def test_a_notebook_shows_the_viewer_live_in_place_of_its_still_picture(load, tmp_path):
    pages = tmp_path / "gallery"
    pages.mkdir()
    load("kfgs_gallery").bring(EXTENSIONS.parents[1] / "notebooks", pages)
    live = [path.name for path in pages.glob("*.ipynb") if "../_static/live.html" in path.read_text(encoding="utf-8")]
    assert live == ["5_two_clouds_and_their_labels.ipynb"]


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
