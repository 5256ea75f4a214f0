"""The reference of Python in docs/api: every public name is there, and in an example that runs."""

import ast
import doctest
import re
import shutil
from pathlib import Path

import pytest
from small_room import make_desk

import kfgs
from kfgs.scenes import load_cameras
from kfgs.viz import available

PAGES = Path(kfgs.__file__).parents[1] / "docs" / "api"
if not PAGES.is_dir():
    pytest.skip(f"no folder {PAGES}", allow_module_level=True)
TOPICS = sorted(path.stem for path in PAGES.glob("*.md") if path.stem != "index")
FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


def examples_of(topic):
    """The examples of a page as one doctest, with the line numbers of the page."""
    lines, inside = [], False
    for line in (PAGES / f"{topic}.md").read_text(encoding="utf-8").splitlines():
        fence = line.startswith("```")
        inside = line == "```pycon" if fence else inside
        lines.append(line if inside and not fence else "")
    return doctest.DocTestParser().get_doctest("\n".join(lines) + "\n", {}, topic, f"docs/api/{topic}.md", 0)


def words_of(topic):
    """The names that a page's examples use: not those of an import, which alone says nothing."""
    found = set()
    for example in examples_of(topic).examples:
        nodes = list(ast.walk(ast.parse(example.source)))
        found |= {node.id for node in nodes if isinstance(node, ast.Name)}
        found |= {node.attr for node in nodes if isinstance(node, ast.Attribute)}
    return found


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    return make_desk(tmp_path_factory.mktemp("desk"))


@pytest.mark.parametrize("name", kfgs.__all__)
def test_every_public_name_is_on_a_page_and_in_an_example_of_that_page(name):
    pages = [
        topic
        for topic in TOPICS
        if re.search(rf"^\.\. auto\w+:: kfgs\.{name}$", (PAGES / f"{topic}.md").read_text(), re.M)
    ]
    assert len(pages) == 1
    assert name in words_of(pages[0])


@pytest.mark.parametrize("topic", TOPICS)
def test_the_examples_of_a_page_run(topic, desk, tmp_path, monkeypatch):
    if topic == "view":
        for name in ("anywidget", "trimesh", "pxr"):
            pytest.importorskip(name)
        if not available():
            pytest.skip("nothing can be drawn here")
    shutil.copytree(desk, tmp_path / "desk")
    monkeypatch.chdir(tmp_path / "desk")
    said = []
    result = doctest.DocTestRunner(optionflags=FLAGS).run(examples_of(topic), out=said.append)
    assert result.attempted > 3
    assert result.failed == 0, "".join(said)


WITH_CODE = ["index", "concepts/field", "howto/teacher", "howto/remove", "howto/count", "howto/export", "quickstart"]


@pytest.mark.parametrize("page", WITH_CODE)
def test_the_python_of_other_pages_runs(page, desk, tmp_path, monkeypatch):
    if page == "howto/export":
        pytest.importorskip("trimesh")
    shutil.copytree(desk, tmp_path / "desk")
    monkeypatch.chdir(tmp_path / "desk")
    Path("kfgs_demo").symlink_to(".")
    kfgs.write_splats("labelled.ply", kfgs.attach(kfgs.SemanticField.load("run/field"), "my.ply").splats)
    blocks = re.findall(r"```python\n(.*?)```", (PAGES.parent / f"{page}.md").read_text(encoding="utf-8"), re.DOTALL)
    assert blocks
    known = {}
    for block in blocks:
        exec(block, known)


def test_the_file_of_cameras_on_the_page_of_export_can_be_read(tmp_path):
    (text,) = re.findall(
        r"```json\n(.*?)```", (PAGES.parent / "howto/export.md").read_text(encoding="utf-8"), re.DOTALL
    )
    (tmp_path / "my_cameras.json").write_text(text)
    first, second = load_cameras(tmp_path / "my_cameras.json")
    assert first.size == (480, 640)
    assert second.center.tolist() == pytest.approx([1.0, -2.0, 1.2])
    assert second.viewmat[1:3, :3].tolist() == [[0, 0, -1], [0, 1, 0]]  # down is -z, it looks along y


def test_no_page_has_python_that_no_test_runs():
    pages = [*PAGES.parent.glob("*.md"), *PAGES.parent.glob("[ch]o*/*.md")]
    others = {
        "recipes",
        "guide",
        "datasets",
        "protocols",
        "engines",
    }  # test_first_scripts, test_readme; others need data
    have = {
        path.relative_to(PAGES.parent).with_suffix("").as_posix() for path in pages if "```python\n" in path.read_text()
    }
    assert have == {*WITH_CODE, *others}


def test_every_page_is_listed_and_asks_a_question():
    index = (PAGES / "index.md").read_text(encoding="utf-8")
    for topic in TOPICS:
        question = re.search(r"^\*\*(.+\?)\*\*$", (PAGES / f"{topic}.md").read_text(encoding="utf-8"), re.M)[1]
        assert f"]({topic}.md) | {question} |" in index
