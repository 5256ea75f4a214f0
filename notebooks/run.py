"""Execute the notebooks: percent sources in, .ipynb with outputs out, and a word about whatever is wrong with one.

    python notebooks/run.py [N ...] [--out notebooks/built] [--pictures DIR]

`N_name.py` is what is written and reviewed, `N_name.ipynb` is what people open: the same cells with their outputs. Both are
committed, and tests/test_notebooks.py holds them in step. Each source runs from its first cell to its last (nbclient) in a
fresh kernel of this Python, in the sources' own folder. It is refused if a cell fails, if anything is written to stderr
(warnings are), if the executed file is larger than 1 MB, or if it shows no picture. What failed leaves no file behind. A
notebook that needs what is not there (example.py says so with a `MissingError`) is skipped, and its file stays.
Pictures are kept as JPEG where that is smaller. `--out notebooks` renews the committed ones.
"""

from __future__ import annotations

import argparse
import base64
import io
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

import jupytext
import nbformat
from jupyter_client.kernelspec import KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient
from nbclient.exceptions import CellControlSignal, CellExecutionError, DeadKernelError
from PIL import Image

HERE = Path(__file__).resolve().parent
LARGEST = 1_000_000  # bytes of an executed notebook: what a repository's web page still shows
SECONDS = 600  # for one cell: six times what a whole notebook may take on two idle cores
SUFFIXES = {"image/png": ".png", "image/jpeg": ".jpg", "image/gif": ".gif"}
QUALITY = 85  # of JPEG
MISSING = "MissingError"
COLORS = re.compile(r"\x1b\[[0-9;]*m")  # of a terminal, in tracebacks


@dataclass
class Outcome:
    """What came of one notebook."""

    source: Path
    seconds: float = 0.0
    size: int = 0  # bytes of the executed file
    pictures: dict[str, bytes] = field(default_factory=dict)  # file name to content, in order of appearance
    problems: list[str] = field(default_factory=list)
    skipped: str = ""  # what it needs and has not


def find_sources(folder: Path, numbers: Sequence[int] = ()) -> list[Path]:
    """The notebooks' sources in order of their numbers, all or those asked for.

    Raises:
        ValueError: if there is none of a number.
    """
    found = {int(path.name.split("_")[0]): path for path in folder.glob("[0-9]*_*.py")}
    missing = [number for number in numbers if number not in found]
    if missing or not found:
        what = ", ".join(map(str, missing)) or "nothing"
        raise ValueError(f"N: expected one of {sorted(found)} (from {folder}), got {what}; give a notebook's number")
    return [found[number] for number in sorted(set(numbers) or found)]


def run_notebook(source: Path, out: Path, *, largest: int = LARGEST, seconds: int = SECONDS) -> Outcome:
    """Execute one source and write `out/<stem>.ipynb`, unless a cell fails: then no file of that name is left."""
    outcome, target = Outcome(source), out / f"{source.stem}.ipynb"
    notebook = jupytext.read(source, fmt="py:percent")
    notebook.metadata = {
        "kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"},
        "language_info": {"name": "python", "file_extension": ".py", "mimetype": "text/x-python"},
    }
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number:02d}"  # the same in every run, so that a change shows only what changed
    start = time.perf_counter()
    failure, below = _execute(notebook, source.parent, seconds)
    outcome.seconds = time.perf_counter() - start
    if failure.startswith(MISSING):
        outcome.skipped = failure
        return outcome
    target.unlink(missing_ok=True)  # else an older run's would pass for this one's
    outcome.problems = [failure] if failure else []
    outcome.problems += list(_noise(notebook))
    outcome.problems += [f"the kernel writes to stderr: {below}"] if below else []
    _shrink(notebook)
    outcome.pictures = _pictures(notebook, source.stem)
    if not failure:
        text = nbformat.writes(notebook)
        outcome.size = len(text.encode())
        if outcome.size > largest:
            outcome.problems.append(f"{outcome.size:,} bytes, more than {largest:,}: make its pictures smaller")
        if not outcome.pictures:
            outcome.problems.append("no picture: a notebook is for looking")
        _write_whole(target, text.encode())
    return outcome


def _execute(notebook: Any, folder: Path, seconds: int) -> tuple[str, str]:
    """Run all cells, filling in their outputs; what went wrong, and what came on stderr from below Python."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as home:
        below = Path(home, "stderr.txt")
        with below.open("w", encoding="utf-8") as log:
            failure = _execute_in(notebook, folder, seconds, home=home, stderr=log)
        return failure, COLORS.sub("", below.read_text(encoding="utf-8", errors="replace")).strip()


def _execute_in(notebook: Any, folder: Path, seconds: int, *, home: str, stderr: TextIO) -> str:
    """What went wrong, or nothing. `home` keeps away the user's start-up files and history."""
    at: list[int] = []

    def note(cell: Any, cell_index: int, **_: Any) -> None:
        at.append(cell_index)

    manager = AsyncKernelManager(
        kernel_name="python3",
        kernel_spec_manager=KernelSpecManager(kernel_dirs=[]),  # python3 then is the Python that runs this
        transport="ipc" if os.name == "posix" else "tcp",  # others on the machine cannot listen
        connection_file=f"{home}/kernel.json",
    )
    resources = {"metadata": {"path": str(folder)}}
    client = NotebookClient(
        notebook, km=manager, timeout=seconds, resources=resources, on_cell_start=note, store_widget_state=False
    )
    environment = os.environ | {"IPYTHONDIR": home, "PYDEVD_DISABLE_FILE_VALIDATION": "1"}
    environment["PYVISTA_JUPYTER_BACKEND"] = "static"  # a live view would end with the kernel: a file keeps its picture
    try:
        client.execute(env=environment, stderr=stderr, cleanup_kc=True)
    except CellExecutionError as error:
        if error.ename == MISSING:
            return f"{MISSING}: {COLORS.sub('', error.evalue)}"
        where = _number(notebook, at[-1])
        return f"cell {where} fails: {error.ename}: {error.evalue}\n{_traceback(notebook, at[-1])}"
    except CellControlSignal as error:  # out of time
        return f"cell {_number(notebook, at[-1])} does not end: {error}"
    except DeadKernelError:
        where = f"cell {_number(notebook, at[-1])}" if at else "the start"
        return f"{where} ends Python: a crash, or out of memory"
    return ""


def _number(notebook: Any, index: int) -> str:
    """Which cell, as a reader counts: the code cells from 1, and how it begins."""
    number = sum(cell.cell_type == "code" for cell in notebook.cells[: index + 1])
    lines = [line for line in notebook.cells[index].source.splitlines() if line.strip()]
    return f"{number} ({lines[0] if lines else 'empty'})"


def _traceback(notebook: Any, index: int) -> str:
    told = [output for output in notebook.cells[index].outputs if output.output_type == "error"]
    return COLORS.sub("", "\n".join(line for output in told for line in output.traceback)).strip()


def _noise(notebook: Any) -> Iterator[str]:
    """What each cell wrote to stderr."""
    for index, cell in enumerate(notebook.cells):
        outputs = cell.get("outputs", [])
        text = "".join(output.text for output in outputs if output.get("name") == "stderr").strip()
        if text:
            yield f"cell {_number(notebook, index)} writes to stderr: {COLORS.sub('', text)}"


def _shrink(notebook: Any) -> None:
    """Keep the smallest where a picture comes in several formats, and JPEG if that is smaller still; no times of cells."""
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/png" in data and "image/jpeg" not in data:
                data["image/jpeg"] = _as_jpeg(data["image/png"])
            kinds = sorted((kind for kind in SUFFIXES if kind in data), key=lambda kind: len(data[kind]))
            for kind in kinds[1:]:
                del data[kind]


def _as_jpeg(picture: str) -> str:
    """A picture in base64 as JPEG; what is transparent becomes white."""
    shown = Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGBA")
    flat = Image.new("RGB", shown.size, "white")
    flat.paste(shown, mask=shown.getchannel("A"))
    kept = io.BytesIO()
    flat.save(kept, "JPEG", quality=QUALITY, optimize=True, subsampling=0)
    return base64.b64encode(kept.getvalue()).decode()


def _pictures(notebook: Any, stem: str) -> dict[str, bytes]:
    """Every picture shown, named by the cell that shows it."""
    found: dict[str, bytes] = {}
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for number, cell in enumerate(code, start=1):
        for output in cell.outputs:
            for kind in SUFFIXES.keys() & output.get("data", {}).keys():
                name = f"{stem}_{number:02d}_{len(found) + 1:02d}{SUFFIXES[kind]}"
                found[name] = base64.b64decode(output.data[kind])
    return found


def _write_pictures(folder: Path, stem: str, pictures: dict[str, bytes]) -> None:
    """One notebook's pictures as files; those of its last run go."""
    for old in folder.glob(f"{stem}_[0-9][0-9]_[0-9][0-9].*"):
        old.unlink()
    for name, content in pictures.items():
        _write_whole(folder / name, content)


def _write_whole(path: Path, content: bytes) -> None:
    """Write beside the final name and move: a killed run leaves no half of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.write_bytes(content)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def main(arguments: Sequence[str] | None = None, say: Callable[[str], None] = print) -> int:
    """The command line; 1 if a notebook has a problem."""
    parser = argparse.ArgumentParser(description="Execute the notebooks and say what is wrong with any of them.")
    parser.add_argument("numbers", metavar="N", type=int, nargs="*", help="which notebooks (default: all, in order)")
    parser.add_argument("--out", type=Path, default=HERE / "built", help="folder for the executed .ipynb files")
    parser.add_argument("--pictures", type=Path, help="also write every picture shown into this folder")
    parser.add_argument("--sources", type=Path, default=HERE, help="folder of the percent sources")
    options = parser.parse_args(arguments)
    try:
        sources = find_sources(options.sources.resolve(), options.numbers)
    except ValueError as error:
        parser.error(str(error))
    bad = 0
    for source in sources:
        outcome = run_notebook(source, options.out)
        facts = f"{outcome.seconds:6.1f} s  {outcome.size / 1000:5.0f} kB  {len(outcome.pictures):2d} pictures"
        verdict = "skipped" if outcome.skipped else "PROBLEM" if outcome.problems else "ok"
        say(f"{source.stem:40s} {facts}  {verdict}")
        for problem in [outcome.skipped] if outcome.skipped else outcome.problems:
            say("    " + problem.replace("\n", "\n    "))
        if options.pictures:
            _write_pictures(options.pictures, source.stem, outcome.pictures)
        bad += bool(outcome.problems)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
