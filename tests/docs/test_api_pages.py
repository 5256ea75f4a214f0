"""The reference of Python in docs/api: every public name is there, and in an example that runs."""

import ast
import doctest
import importlib
import inspect
import re
import shutil
from contextlib import nullcontext
from functools import cache
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from test_public import PACKAGES

import kfgs
from kfgs import batch
from kfgs.batch.run import SceneResult
from kfgs.pipeline import true_labels
from kfgs.viz.plotter import trouble

RUN_BATCH = batch.run_batch

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


@cache
def entries():
    """The entries of all pages: full name to page."""
    found = {}
    for topic in TOPICS:
        text = (PAGES / f"{topic}.md").read_text(encoding="utf-8")
        for name in re.findall(r"^\.\. (?:auto\w+|py:data):: (kfgs\.[\w.]+)$", text, re.M):
            assert name not in found, f"{name} is on two pages: {topic} and {found[name]}"
            found[name] = topic
    return found


def value_of(name):
    """The object of a full name; of two things with one name, a module and what the package exports, the latter."""
    module, _, last = name.rpartition(".")
    return getattr(importlib.import_module(module), last)


def entry_of(name):
    """The entry of a public name, which may be that of the same object in another package: `kfgs.labels.Remove`."""
    if name in entries():
        return name
    value, last = value_of(name), name.rpartition(".")[2]
    same = [one for one in entries() if one.endswith(f".{last}") and value_of(one) is value]
    return same[0] if same else None


@cache
def shown():
    """The entries that the examples of some page import and use."""
    found = set()
    for topic in TOPICS:
        names = names_of_kfgs(ast.parse("".join(one.source for one in examples_of(topic).examples)))
        found |= {entry_of(name) for name in names if name.rpartition(".")[2] in words_of(topic)}
    return found


def has_example(entry):
    """Whether a page uses a name in its examples, or its docstring has one."""
    return entry in shown() or ">>>" in (inspect.getdoc(value_of(entry)) or "")


@pytest.mark.parametrize("name", kfgs.__all__)
def test_every_name_of_kfgs_is_on_a_page_and_in_an_example_of_that_page(name):
    assert f"kfgs.{name}" in entries()
    assert name in words_of(entries()[f"kfgs.{name}"])


@pytest.mark.parametrize("package", PACKAGES)
def test_every_name_of_a_public_package_is_on_a_page(package):
    names = importlib.import_module(package).__all__
    assert [name for name in names if entry_of(f"{package}.{name}") is None] == []


def test_an_entry_is_public_and_the_index_lists_its_package():
    index = (PAGES / "index.md").read_text(encoding="utf-8")
    assert set(re.findall(r"`(kfgs\.[\w.]+)`", index.split("Everything else")[0])) == set(PACKAGES)
    for name in entries():
        package, _, last = name.rpartition(".")
        assert package in ("kfgs", *PACKAGES), name
        assert last in importlib.import_module(package).__all__, name


def read_code(path):
    """The Python of a script, or of the blocks of a page."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        return [text]
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    sessions = re.findall(r"```pycon\n(.*?)```", text, re.DOTALL)
    return blocks + ["".join(one.source for one in doctest.DocTestParser().get_examples(code)) for code in sessions]


def names_of_kfgs(tree):
    """What some code takes from kfgs, by full name: by imports, and as an attribute of what it imported."""
    known = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            known |= {one.asname or one.name: one.name for one in node.names if re.match(r"kfgs\b", one.name)}
        elif isinstance(node, ast.ImportFrom) and re.match(r"kfgs\b", node.module or ""):
            known |= {one.asname or one.name: f"{node.module}.{one.name}" for one in node.names}
    used = {
        f"{known[node.value.id]}.{node.attr}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in known
    }
    modules = {name for name in known.values() if name == "kfgs" or isinstance(value_of(name), ModuleType)}
    return (set(known.values()) - modules) | {name for name in used if name.rpartition(".")[0] in modules}


ROOT = PAGES.parents[1]
READ = [ROOT / "README.md", *sorted(PAGES.parent.rglob("*.md")), *sorted((ROOT / "notebooks").glob("*_*.py"))]
READ = [path for path in READ if path.is_file() and any("kfgs" in code for code in read_code(path))]


@pytest.mark.parametrize("path", READ, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_users_are_shown_to_import_is_on_a_page_with_an_example(path):
    names = set().union(*(names_of_kfgs(ast.parse(code)) for code in read_code(path)))
    assert names
    for name in sorted(names):
        if name.rpartition(".")[0] not in ("kfgs", *PACKAGES):  # rarely needed: from its module, which may change
            assert callable(value_of(name))
            assert "._" not in name, f"{name} is private"
            continue
        entry = entry_of(name)
        assert entry is not None, f"{name}: no entry on an API page"
        assert has_example(entry), f"{name}: no example"


@pytest.mark.parametrize("topic", TOPICS)
def test_the_examples_of_a_page_run(topic, request):
    if topic == "view":
        pytest.importorskip("anywidget")
        if trouble():
            pytest.skip("nothing can be drawn here")
    request.getfixturevalue("inside")
    said = []
    result = doctest.DocTestRunner(optionflags=FLAGS).run(examples_of(topic), out=said.append)
    assert result.attempted > 3
    assert result.failed == 0, "".join(said)


def blocks_of(page):
    """The Python of a page that has no prompts."""
    blocks = re.findall(r"```python\n(.*?)```", (PAGES.parent / f"{page}.md").read_text(encoding="utf-8"), re.DOTALL)
    assert blocks
    return blocks


@pytest.fixture
def inside(desk, tmp_path, monkeypatch):
    """Work in a copy of the desk."""
    shutil.copytree(desk, tmp_path / "desk")
    monkeypatch.chdir(tmp_path / "desk")


@pytest.fixture
def encode():
    """A text encoder that knows the classes of the room; other words are like the wall."""
    words = kfgs.SemanticField.load("run/field.kfgs").classes
    return lambda texts: words.embeddings[[words.names.index(text) if text in words.names else 0 for text in texts]]


AS_THEY_STAND = ["index", "howto/teacher", "howto/edit", "howto/export", "howto/pyvista", "howto/kornia", "quickstart"]
ELSEWHERE = {"guide": "test_readme.py"}
WITH_DATA = {"protocols", "howto/batch"}  # the two tests below


@pytest.mark.parametrize("page", AS_THEY_STAND)
def test_the_python_of_other_pages_runs(page, inside):
    if page == "howto/export":
        pytest.importorskip("trimesh")
    Path("kfgs_demo").symlink_to(".")
    kfgs.write_splats(kfgs.attach(kfgs.SemanticField.load("run/field.kfgs"), "my.ply").gaussians, "labelled.ply")
    known = {}
    for block in blocks_of(page):
        exec(block, known)


def test_the_python_of_protocols_runs(inside, encode, capsys):
    Path("room").symlink_to("scene")
    scene = kfgs.load_scene("room")
    names = kfgs.SemanticField.load("run/field.kfgs").classes.names
    teacher = SimpleNamespace(encode_text=encode)
    known = {"names": names, "maps": true_labels(scene, "room/labels", "test"), "teacher": teacher}
    [block] = blocks_of("protocols")
    exec(block, known)
    said = capsys.readouterr().out
    assert re.match(r"mIoU 0\.\d{3}, accuracy 0\.\d{3} \(kfgs-pooled/1\)\n", said)


def test_the_python_of_many_scenes_runs(inside, monkeypatch):
    """Without processes; tests/batch makes the fields, here only the calls are checked."""
    called = []
    result = SceneResult("kitchen", value={"miou": 0.5})
    monkeypatch.setattr(batch, "open_client", lambda workers: nullcontext())
    monkeypatch.setattr(batch, "run_batch", lambda *args, **kwargs: called.append((args, kwargs)) or [result])
    Path("kitchen").symlink_to("scene")
    Path("scenes.txt").write_text("kitchen\n")
    join, several = blocks_of("howto/batch")
    exec(several, {"__name__": "__main__"})
    [(arguments, named)] = called
    inspect.signature(inspect.unwrap(RUN_BATCH)).bind(*arguments, **named)
    assert "join_blocks(" in join


def test_no_page_has_python_that_no_test_runs():
    pages = [path for path in PAGES.parent.rglob("*.md") if not {"_build", "_ext"} & set(path.parts)]
    pages = [path for path in pages if "```python\n" in path.read_text()]
    have = {path.relative_to(PAGES.parent).with_suffix("").as_posix() for path in pages}
    assert have == {*AS_THEY_STAND, *ELSEWHERE, *WITH_DATA}


def test_values_on_the_pages_are_those_of_the_code():
    named = [
        found
        for page in PAGES.glob("*.md")
        for found in re.findall(r"py:data:: (\S+)\n +:value: ([\d({].*)", page.read_text())
    ]
    assert named
    for name, value in named:
        module, _, constant = name.rpartition(".")
        assert eval(value) == getattr(importlib.import_module(module), constant), name
