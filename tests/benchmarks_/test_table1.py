import json
import sys

import pytest
import table1
import table1_report
import table1_rows
from small_room import ROOM
from small_task import MIB, cloud

from kfgs.formats import write_splats
from kfgs.toy.room_folder import make_toy_room


def result(key, seed=0, **changes):
    request = {"row": key, "seed": seed, "preset": "quick"}
    facts = {
        "dim": "8",
        "gaussians": 571_000,
        "storage": 18 * MIB,
        "disk": 20 * MIB,
        "stages": {"codes": 30.0, "field": 90.0},
    }
    scores = {"miou": 0.321, "accuracy": 0.7, "teacher_accuracy": 0.81, "teacher_iou7": 0.4}
    scores |= {"miou_nearest": 0.31, "miou_votes": 0.33, "codec_cosine": 0.912, "codec_same": 0.985}
    return {
        "request": request,
        **facts,
        **scores,
        "fps_maps": 77.0,
        "fps_labels": 7.0,
        "peak_fit": 2_500_000_000,
        **changes,
    }


ABOUT = {
    "command": "python table1.py", "preset": "quick", "machine": "m", "seconds": 600.0, "geometry_seconds": 120.0,
    "teacher": {"miou": 0.731, "accuracy": 0.903, "views": 30},
}  # fmt: skip


def test_table_puts_the_paper_beside():
    text = table1_report.table_text(ABOUT, [result("legaussians"), result("kfgs", packed=MIB)])
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(rows) == 3
    start = "| LEGaussians (frozen) | 8 | 32.1 | 31.0 / 33.0 | 70.0 | 81.0, 40.0 | 0.912, 98.5 | "
    assert rows[1].startswith(start + "2.00 (codes 30, field 90) | 571.0k | 18.00 |")
    assert rows[1].endswith("| 2.50 | 32.0, 28, 571.0k, 18.1, 77.7 |")
    assert "20.00 (packed 1.00)" in rows[2]
    assert "Teacher: mIoU 73.1, accuracy 90.3 over 30 views" in text


def test_published_figures_are_those_of_the_paper():
    paper = {key: row.paper["miou"] for key, row in table1_rows.ROWS.items() if row.paper}
    assert list(paper.values()) == [32.0, 58.5, 73.4, 73.9, 73.5, 77.9, 76.6]
    assert len(table1_rows.ROWS) == 13


def test_a_run_writes_table_and_pictures_and_resumes(tmp_path, monkeypatch, capsys):
    room = make_toy_room(tmp_path / "room", ROOM)
    splat = tmp_path / "splat.ply"
    means = cloud(300).means * 2
    write_splats(cloud(300).replace(means=means, sh=means[:, None, :].clone()), splat)
    out = tmp_path / "out"
    monkeypatch.setattr(
        sys, "argv",
        ["table1.py", *map(str, (room, room / "features", out)), "--splat", str(splat), "--quick", "--rows", "uplift",
         "--truth", "labels"],
    )  # fmt: skip
    table1.main()
    said = capsys.readouterr().out
    assert "| plain uplift |" in said
    report = json.loads((out / "table1.json").read_text())
    (row,) = report["rows"]
    assert row["request"]["config"] == {"pixels": 80_000, "keep": 0.995}
    assert row["peak"] > 10**8
    assert row["storage"] < row["disk"]
    for name in ("quality_storage", "quality_time", "labels"):
        assert (out / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    assert row["miou_nearest"] == row["miou"]  # its own rule
    assert 0 < row["miou_votes"] < 1
    assert 0.9 < row["codec_cosine"] <= 1
    assert len(row["teacher"]["rows"]) == row["views"]
    monkeypatch.setattr(table1.subprocess, "run", lambda *args, **kwargs: pytest.fail("made again"))
    table1.main()
    assert json.loads((out / "table1.json").read_text())["rows"] == report["rows"]
    (room / "features" / "more.txt").write_text("other data")
    with pytest.raises(pytest.fail.Exception, match="made again"):
        table1.main()
