import re
import sys
from pathlib import Path

import leaderboard
import pytest

from kfgs._files import write_json

DOCS = Path(leaderboard.__file__).resolve().parents[1] / "docs"
MIB = 2**20


def row(key, seed, miou):
    request = {
        "row": key, "seed": seed, "preset": "quick", "steps": None, "scene": "/secret/room_0", "features": "/secret/maps",
        "truth": "labels_scored", "every": 3, "splat": "/secret/color.ply", "given": True,
        "digests": {"code": "c", "maps": "m", "scene": "s", "splat": "p"},
    }  # fmt: skip
    scores = {
        "miou": miou,
        "miou_nearest": miou,
        "miou_votes": 0.8,
        "accuracy": 0.9,
        "teacher_iou7": 0.7,
        "fps_maps": 30.0,
        "fps_labels": 12.5,
    }
    facts = {
        "dim": "17",
        "gaussians": 30_000,
        "storage": 3 * MIB,
        "disk": 4 * MIB,
        "stages": {"uplift": 60.0, "merge": 30.0},
    }
    return {"request": request, **scores, **facts, "history": [{"loss": 1.0}], "pooled": {"confusion": [[1]]}}


@pytest.fixture
def out(tmp_path):
    teacher = {"miou": 0.724, "accuracy": 0.9, "views": 30}
    rows = [row("occam", 0, 0.816), *(row("kfgs", seed, miou) for seed, miou in enumerate((0.843, 0.842, 0.847)))]
    table = {"machine": "a machine, 2 threads", "preset": "quick", "teacher": teacher, "rows": rows}
    write_json(tmp_path / "out" / "table1.json", table)
    return tmp_path / "out"


def run(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["leaderboard.py", *map(str, words)])
    leaderboard.main()


def test_a_row_has_mean_and_spread(out, tmp_path, monkeypatch):
    runs, page = tmp_path / "runs", tmp_path / "page.md"
    run(monkeypatch, runs, page, "--add", out, "--name", "room_0-quick", "--about", "The real teacher.")
    text = page.read_text()
    kfgs, occam = (line for line in text.splitlines() if re.match(r"\| \d", line))
    assert (
        kfgs
        == "| 1 | **kfgs default** | 84.4 (84.2 to 84.7) | 84.4 / 80.0 | 90.0 | 70.0 | 1.50 | 3.00 | 12.5 | `kfgs` |"
    )
    assert "`python benchmarks/table1.py ROOM_0 MAPS OUT --splat COLOR/color.ply --quick --rows ROW`; a machine" in text
    assert "| 2 | Occam's LGS | 81.6 | " in occam
    assert "The real teacher." in text
    assert "mIoU 72.4 %" in text
    kept = (runs / "room_0-quick.json").read_text()
    assert "secret" not in kept + text
    assert "history" not in kept
    assert "confusion" not in kept
    run(monkeypatch, runs, page, "--check")


def test_the_page_in_the_docs_is_that_of_its_runs(monkeypatch):
    if not (DOCS / "leaderboard.md").is_file():
        pytest.skip("kfgs is installed without its repository")
    run(monkeypatch, DOCS / "runs", DOCS / "leaderboard.md", "--check")
