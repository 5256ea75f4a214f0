import re
import sys
from pathlib import Path

import leaderboard
import pytest

from kfgs._files import read_json, write_json

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


def test_a_row_has_mean_spread_seeds_machine_and_command(out, tmp_path, monkeypatch):
    runs, page = tmp_path / "runs", tmp_path / "page.md"
    run(monkeypatch, runs, page, "--add", out, "--name", "room_0-quick", "--about", "The real teacher.")
    text = page.read_text()
    kfgs, occam = (line for line in text.splitlines() if re.match(r"\| \d", line))
    assert kfgs.startswith(
        "| 1 | **kfgs default** | 84.4 (84.2 to 84.7) | 84.4 / 80.0 | 90.0 | 70.0 | 1.50 | 3.00 | 12.5 | 0, 1, 2 | a machine"
    )
    assert kfgs.endswith(
        "`python benchmarks/table1.py ROOM_0 MAPS OUT --splat COLOR/color.ply --quick --rows kfgs --seeds 0 1 2` |"
    )
    assert "| 2 | Occam's LGS | 81.6 | " in occam
    assert "The real teacher." in text
    assert "mIoU 72.4 %" in text
    kept = (runs / "room_0-quick.json").read_text()
    assert "secret" not in kept + text
    assert "history" not in kept
    assert "confusion" not in kept
    run(monkeypatch, runs, page, "--check")


def test_check_fails_on_a_changed_digit(out, tmp_path, monkeypatch):
    runs, page = tmp_path / "runs", tmp_path / "page.md"
    run(monkeypatch, runs, page, "--add", out, "--name", "room_0-quick")
    page.write_text(page.read_text().replace("81.6", "81.9"))
    with pytest.raises(SystemExit, match=r"(?s)differs from the runs.*not in the runs: 81.9.*\+.*81.6"):
        run(monkeypatch, runs, page, "--check")
    page.unlink()
    with pytest.raises(SystemExit, match="differs from the runs"):
        run(monkeypatch, runs, page, "--check")


def test_maps_of_the_scene_s_own_folder_are_named_so(out):
    request = row("occam", 0, 0.8)["request"] | {
        "scene": "/secret/toy",
        "features": "/secret/toy/features",
        "truth": "labels",
    }
    said = leaderboard.command(request | {"every": 1, "given": False})
    assert said == (
        "python benchmarks/table1.py TOY TOY/features OUT --quick --every 1 --truth labels --rows occam --seeds 0"
    )


def test_rows_of_several_tables_are_joined(out, tmp_path, monkeypatch):
    table = read_json(out / "table1.json")
    write_json(
        tmp_path / "more" / "table1.json",
        table | {"machine": "other", "rows": [row("kfgs", 2, 0.9), row("cf3", 0, 0.5)]},
    )
    found = leaderboard.join([table, read_json(tmp_path / "more" / "table1.json")])
    assert [(one["row"], one["seed"], one["miou"]) for one in found["rows"]] == [
        ("cf3", 0, 0.5), ("kfgs", 0, 0.843), ("kfgs", 1, 0.842), ("kfgs", 2, 0.9), ("occam", 0, 0.816),
    ]  # fmt: skip
    with pytest.raises(SystemExit, match="expected runs of one preset, got cpu, quick"):
        leaderboard.join([table, table | {"preset": "cpu"}])
    other = row("occam", 1, 0.8)
    other["request"]["config"] = {"steps": 7, "seed": 1}
    with pytest.raises(SystemExit, match="expected one configuration of occam, got several"):
        leaderboard.join([table, table | {"rows": [other]}])
    for part in ("maps", "scene", "splat"):
        other = row("occam", 1, 0.8)
        other["request"]["digests"][part] = "x"
        with pytest.raises(SystemExit, match=f"expected runs of one {part}, got 2"):
            leaderboard.join([table, table | {"rows": [other]}])
    for part, value in (("truth", "labels"), ("every", 1)):
        other = row("occam", 1, 0.8)
        other["request"][part] = value
        with pytest.raises(SystemExit, match=f"expected runs of one --{part}, got .*{value}"):
            leaderboard.join([table, table | {"rows": [other]}])
    with pytest.raises(SystemExit, match="are their views the same"):
        leaderboard.join([table, table | {"teacher": None}])
    with pytest.raises(SystemExit, match="--name"):
        run(monkeypatch, tmp_path / "runs", tmp_path / "page.md", "--add", out)
    with pytest.raises(SystemExit, match="expected JSON files of runs"):
        run(monkeypatch, tmp_path / "runs", tmp_path / "page.md")


def test_the_page_in_the_docs_is_that_of_its_runs(monkeypatch):
    if not (DOCS / "leaderboard.md").is_file():
        pytest.skip("kfgs is installed without its repository")
    run(monkeypatch, DOCS / "runs", DOCS / "leaderboard.md", "--check")


def test_the_shared_gaussians_of_a_later_table_are_named(out):
    later = read_json(out / "table1.json")
    none = {
        **row("adc", 0, 0.7)["request"],
        "given": False,
        "digests": {"code": "c", "maps": "m", "scene": "s", "splat": ""},
    }
    first = {**later, "rows": [{**row("adc", 0, 0.7), "request": none}]}
    for tables in ([first, later], [later, first], [{**later, "rows": []}, later]):
        assert leaderboard.join(tables)["digests"] == {"maps": "m", "scene": "s", "splat": "p"}
    with pytest.raises(SystemExit, match="expected finished rows, got none"):
        leaderboard.join([{**later, "rows": []}])
