"""The notebooks as sources, without running them, and run.py on tiny notebooks made here."""

import ast
import importlib
import importlib.util
import json
import re
import sys
from pathlib import Path

import pytest

jupytext, *_ = [
    pytest.importorskip(name, reason='the notebooks need: pip install "kfgs[notebook]"')
    for name in ("jupytext", "nbclient", "ipykernel")
]

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
if not (NOTEBOOKS / "run.py").is_file():  # a source distribution comes without them
    pytest.skip(f"no folder {NOTEBOOKS}", allow_module_level=True)
SOURCES = sorted(NOTEBOOKS.glob("[0-9]*_*.py"), key=lambda path: int(path.name.split("_")[0]))
OWN_DATA = "# your own data"


@pytest.fixture(scope="module")
def runner():
    spec = importlib.util.spec_from_file_location("notebooks_run", NOTEBOOKS / "run.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look there
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.fixture(params=SOURCES, ids=lambda path: path.stem)
def source(request):
    return request.param


def code_cells(source):
    return [cell.source for cell in jupytext.read(source, fmt="py:percent").cells if cell.cell_type == "code"]


def test_the_committed_notebook_has_the_cells_of_its_source_and_their_outputs(source, runner):
    """If this fails: `python notebooks/run.py N --out notebooks`."""
    committed = source.with_suffix(".ipynb")
    assert committed.stat().st_size < runner.LARGEST
    text = committed.read_text(encoding="utf-8")
    assert not re.search(r"/(tmp|home|root|Users|var|work)/", text), "no path of the machine that ran it"
    cells = json.loads(text)["cells"]
    written = jupytext.read(source, fmt="py:percent").cells
    assert [(c["cell_type"], "".join(c["source"])) for c in cells] == [(c.cell_type, c.source) for c in written]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    kinds = {kind for cell in code for output in cell["outputs"] for kind in output.get("data", {})}
    assert kinds & {"image/jpeg", "image/png", "image/gif"}
    assert f"]({source.stem}.ipynb)" in (NOTEBOOKS / "README.md").read_text(encoding="utf-8")


def test_a_notebook_has_at_most_100_lines_of_code(source):
    lines = [line.strip() for cell in code_cells(source) for line in cell.splitlines()]
    assert len([line for line in lines if line and line[0] != "#"]) <= 100


def test_one_cell_is_for_your_own_data_and_it_is_among_the_first(source):
    """A comment says so; only cells of imports may come before it."""
    cells = code_cells(source)
    [meant] = [i for i, cell in enumerate(cells) for line in cell.lower().splitlines() if line.startswith(OWN_DATA)]
    for cell in cells[:meant]:
        assert all(isinstance(node, ast.Import | ast.ImportFrom) for node in ast.parse(cell).body)


PICTURE = "from PIL import Image\n\nImage.new('RGB', (8, 8), (255, 0, 0))"


def write_source(folder, *cells, name="1_tiny.py"):
    text = "# %% [markdown]\n# # 1. Tiny\n\n" + "\n\n".join(f"# %%\n{cell}" for cell in cells) + "\n"
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def test_a_good_notebook_is_written_with_its_outputs(runner, tmp_path, capsys):
    write_source(tmp_path, "from pathlib import Path\nimport sys\nprint(Path.cwd().name, sys.executable)", PICTURE)
    out, pictures = tmp_path / "built", tmp_path / "pictures"
    assert runner.main(["--sources", str(tmp_path), "--out", str(out), "--pictures", str(pictures)]) == 0
    assert "1 pictures  ok" in capsys.readouterr().out
    cells = json.loads((out / "1_tiny.ipynb").read_text())["cells"]
    assert "".join(cells[1]["outputs"][0]["text"]).split() == [tmp_path.name, sys.executable]
    [shown] = cells[2]["outputs"]
    assert len([kind for kind in shown["data"] if kind.startswith("image/")]) == 1  # Pillow gives PNG and JPEG
    [picture] = pictures.iterdir()
    assert picture.name.startswith("1_tiny_02_01.")
    assert picture.read_bytes()[:4] in (b"\x89PNG", b"\xff\xd8\xff\xe0")


def test_a_failing_cell_is_named_and_leaves_no_file(runner, tmp_path):
    source, out = write_source(tmp_path, PICTURE, "seven = 7\n1 / (seven - 7)", "print('never')"), tmp_path / "built"
    out.mkdir()
    (out / "1_tiny.ipynb").write_text("an older run's")
    outcome = runner.run_notebook(source, out)
    [problem] = outcome.problems
    assert problem.startswith("cell 2 (seven = 7) fails: ZeroDivisionError: division by zero")
    assert "1 / (seven - 7)" in problem
    assert list(out.iterdir()) == []


def test_a_notebook_whose_photos_are_missing_is_skipped_and_its_file_stays(runner, tmp_path, capsys):
    write_source(tmp_path, "class MissingError(FileNotFoundError): ...\n\nraise MissingError('photos: none')")
    (tmp_path / "1_tiny.ipynb").write_text("an older run's")
    assert runner.main(["--sources", str(tmp_path), "--out", str(tmp_path)]) == 0
    assert "skipped\n    MissingError: photos: none\n" in capsys.readouterr().out
    assert (tmp_path / "1_tiny.ipynb").read_text() == "an older run's"
